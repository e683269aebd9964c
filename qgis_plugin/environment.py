"""The Python that the worker runs in: an environment in the user's profile, or an interpreter that the user named.

The libraries that PolyMerge needs must not be loaded into QGIS: their own copies of GEOS, PROJ and GDAL would bind to
those of QGIS, and geometry would go wrong without a word. So they live in a Python of their own.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from processing.core.ProcessingConfig import ProcessingConfig
from qgis.core import QgsApplication

from .layout import REQUIREMENTS
from .translation import tr

#: Name of the Processing setting that holds an interpreter that the user named.
SETTING = "POLYMERGE_PYTHON"

_NEWEST_FIRST = ("python3.14", "python3.13", "python3.12", "python3.11", "python3.10", "python3")


class EnvironmentMissing(Exception):  # noqa: N818 - it is a state that the user mends, with a sentence of what to do
    """There is no Python for the worker; the message says what to do."""


def worker_python() -> str:
    """Return the interpreter that the worker is to run in.

    Raises
    ------
    EnvironmentMissing
        If the interpreter of the settings is not there, or no environment has been made, or it was made for a
        version of the plugin that needed other libraries.
    """
    named = str(ProcessingConfig.getSetting(SETTING) or "")
    if named:
        if not is_program(named):
            raise EnvironmentMissing(
                tr("{} is not there, the Python that the Processing options name: run “Set up PolyMerge”.").format(
                    named
                )
            )
        return named
    made = _made()
    python = interpreter_of(environments() / str(made.get("folder")))
    if not is_program(python):
        raise EnvironmentMissing(
            tr("PolyMerge has no Python environment yet: run “Set up PolyMerge” in the Processing toolbox.")
        )
    if not is_program(str(made.get("made_with", python))):  # its environment cannot start without it
        raise EnvironmentMissing(
            tr(
                "{} is gone, which the Python environment of PolyMerge was made with: run “Set up PolyMerge” again."
            ).format(made["made_with"])
        )
    if made.get("requirements") != requirements():
        raise EnvironmentMissing(
            tr("The Python environment of PolyMerge was made for another version of it: run “Set up PolyMerge” again.")
        )
    return python


def use_interpreter(python: str) -> None:
    """Have the worker run in an interpreter from now on; an empty name stands for the environment in the profile."""
    ProcessingConfig.setSettingValue(SETTING, python)


@contextmanager
def new_environment(made_with: str) -> Iterator[Path]:
    """Give a folder for a new environment, which replaces the old one when nothing went wrong.

    Until then the old one stays, and is used.

    Parameters
    ----------
    made_with : str
        The interpreter that it is made with, and cannot do without.
    """
    home = environments()
    home.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="environment_", dir=home))
    try:
        yield folder
        note = home / "made.json.new"
        made = {"folder": folder.name, "requirements": requirements(), "made_with": made_with}
        note.write_text(json.dumps(made), encoding="utf-8")
        note.replace(home / "made.json")
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    for old in home.glob("environment_*"):
        if old != folder:
            shutil.rmtree(old, ignore_errors=True)  # on Windows one that is running just now stays until the next time


def environments() -> Path:
    """Return the folder in the user's profile that holds the environment."""
    # Not in the plugin's folder, which a new version of the plugin replaces.
    return Path(QgsApplication.qgisSettingsDirPath()) / "polymerge"


def interpreter_of(folder: Path) -> str:
    """Return the interpreter of an environment."""
    return str(folder / "Scripts" / "python.exe" if os.name == "nt" else folder / "bin" / "python")


def is_program(path: str) -> bool:
    """Whether there is a program at a path."""
    return Path(path).is_file() and os.access(path, os.X_OK)


def requirements() -> list[str]:
    """Return what the worker's Python needs, as pip takes it."""
    return REQUIREMENTS.read_text(encoding="utf-8").split()


def likely_python() -> str:
    """Return a Python that can probably make an environment, for the user to confirm; empty if none is found."""
    # `sys.executable` is QGIS itself, or anything; the interpreter that belongs to its Python lies in its prefix.
    prefix = Path(sys.exec_prefix)
    own = prefix / "python.exe" if os.name == "nt" else prefix / "bin" / f"python3.{sys.version_info.minor}"
    if sys.version_info >= (3, 10) and is_program(str(own)):
        return str(own)
    return next((found for name in _NEWEST_FIRST if (found := shutil.which(name))), "")


def _made() -> dict[str, object]:
    """Return what is written about the environment in the profile; nothing where there is none."""
    try:
        return dict(json.loads((environments() / "made.json").read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return {}
