"""Where outputs go, and what they would overwrite there."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any, NamedTuple

from qgis.core import QgsProcessingContext, QgsProcessingOutputLayerDefinition, QgsProperty

#: How QGIS names a table in a GeoPackage that is to be added to.
_TABLE = re.compile(r"""ogr:\s*dbname='(?P<file>[^']+)'\s+table="(?P<table>[^"]+)\"""")

#: A database, or another address that is no file; one letter is a drive of Windows.
_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:")


class Place(NamedTuple):
    """A layer in a file, that is read or written."""

    file: str
    table: str = ""
    #: Whether writing it replaces the whole file.
    whole: bool = True

    def replaces(self, other: Place) -> bool:
        """Whether writing to this place destroys what is at the other one."""
        return same_file(self.file, other.file) and (self.whole or self.table == other.table)

    @property
    def folder_fault(self) -> str:
        """Why nothing can be written in its folder; empty where it can."""
        folder = Path(self.file).absolute().parent
        if not folder.is_dir():
            return "there is no such folder"
        return "" if os.access(folder, os.W_OK) else "its folder is not writable"


def same_file(one: str, other: str) -> bool:
    """Whether two paths lead to one file, which need not be there yet."""
    if os.path.realpath(one) == os.path.realpath(other):
        return True
    # A file system may take names for the same that are not.
    return Path(one).exists() and Path(other).exists() and Path(one).samefile(other)


def destination_text(value: Any, context: QgsProcessingContext) -> str:
    """Return what the user gave as a destination: a file, a table of a database, or a word for a temporary layer."""
    if isinstance(value, QgsProcessingOutputLayerDefinition):
        value = value.sink
    if isinstance(value, QgsProperty):
        value = value.valueAsString(context.expressionContext())[0]
    return str(value or "")


def place_of(value: Any, context: QgsProcessingContext) -> Place | None:
    """Return the file that a destination means; None for a temporary layer or a database."""
    text = destination_text(value, context)
    table = _TABLE.match(text)
    if table:
        return Place(table["file"], table["table"], whole=False)
    if not Path(text).suffix or _ADDRESS.match(text):
        return None
    return Place(text, Path(text).stem)
