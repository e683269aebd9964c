"""`polymerge:undoupdate`: what came with a revision of a stored map is taken back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import QgsProcessingContext, QgsProcessingParameterDefinition

from ..parameters import absolute_file, undo_parameters
from ..progress import Part
from ..translation import mark, tr
from .base import Parameters, Staged
from .writes_map import ELEMENT_NUMBERS, WritesMap


class UndoUpdate(WritesMap):
    """Take an update of a stored map back."""

    NAME = "undoupdate"
    TITLE = mark("Undo update of a map")
    GROUP = mark("Stored map")
    ICON = "undo"
    TAGS = mark("undo,revert,take back,remove,mistake,update,revision,history,map,HD map")
    SUMMARY = mark("Takes back what came with a revision of a stored map, as if the map had never been told of it.")
    HELP = mark(
        "The local maps that came with the revision are taken out of the file, and what they looked at is drawn anew "
        "from all others. That is a revision of its own: the history stays, and the same local maps may come again. "
        "The table revisions in the file of the map lists the revisions, with what each brought."
    )
    COMMAND = "undo"
    OPTIONS = ("REVISION", "UNTIL")
    NUMBERS = (("NEW_REVISION", mark("Revision")), *ELEMENT_NUMBERS)

    def inputs(self) -> list[QgsProcessingParameterDefinition]:
        """Return the map and the revision."""
        return undo_parameters()

    def fault(self, parameters: Parameters, context: QgsProcessingContext) -> str:
        """Return what is wrong with the map, or that the revision is missing."""
        if parameters.get("REVISION") is None:
            return tr("Revision to take back (REVISION) is empty: choose one of the table revisions of the map.")
        return super().fault(parameters, context)

    def stage(self, parameters: Parameters, context: QgsProcessingContext, folder: Path, part: Part) -> Staged:
        """Name the map, which the worker writes itself."""
        del folder, part
        return Staged([], [absolute_file(self, parameters, "MAP", context)], {})

    def numbers(self, report: dict[str, Any]) -> dict[str, float]:
        """Count what became of the elements."""
        return {"NEW_REVISION": report["revision"], **{name: report[name.lower()] for name, _ in ELEMENT_NUMBERS}}
