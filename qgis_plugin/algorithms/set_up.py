"""`polymerge:setup`: the Python environment that the worker runs in."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingOutputString,
)

from ..environment import (
    EnvironmentMissing,
    interpreter_of,
    likely_python,
    new_environment,
    use_interpreter,
    worker_python,
)
from ..layout import REQUIREMENTS, ROOT
from ..parameters import absolute_file, file_parameter, folder_parameter, switch_parameter
from ..process import clean_environment, run_program
from ..translation import mark, tr
from .base import Parameters, PolyMergeAlgorithm

_CHECK = str(ROOT / "qgis_plugin" / "check_python.py")
_OWN_GROUP = str(ROOT / "qgis_plugin" / "own_group.py")


class SetUp(PolyMergeAlgorithm):
    """Make or check the environment."""

    NAME = "setup"
    TITLE = mark("Set up PolyMerge")
    GROUP = mark("Set-up")
    ICON = "setup"
    TAGS = mark("install,environment,python,dependencies,pip,venv,shapely,geopandas,offline")
    SUMMARY = mark("Makes the Python environment that PolyMerge calculates in, or checks it.")
    HELP = mark(
        "PolyMerge needs libraries that must not be mixed with those of QGIS, so it keeps them in an environment of "
        "their own in your QGIS profile. Run this once, and again after an update of the plugin that asks for it. The "
        "libraries (several hundred megabytes) are downloaded from PyPI with pip, or taken from a folder of wheels. "
        "Nothing else of PolyMerge uses the network."
    )

    def initAlgorithm(self, configuration: dict[str, Any] | None = None) -> None:
        """Declare the parameters and outputs."""
        del configuration
        for definition in (
            file_parameter(
                "PYTHON",
                tr("Python"),
                tr("The interpreter, 3.10 or newer, that the environment is made with. Nothing in it is changed."),
                default=likely_python(),
                optional=True,
            ),
            switch_parameter(
                "USE_AS_IS",
                tr("Use this Python as it is"),
                tr(
                    "Make no environment; this Python already has what PolyMerge needs. The Processing options keep it."
                ),
                advanced=False,
            ),
            folder_parameter(
                "WHEELS",
                tr("Folder of wheels"),
                tr(
                    "Install from here, without the network. On a computer like this one fill it with: pip download -d "
                    "FOLDER -r requirements.txt (the file lies in the plugin's folder qgis_plugin)."
                ),
            ),
            switch_parameter(
                "CHECK_ONLY",
                tr("Only check"),
                tr("Look whether the environment that is used now is complete, and change nothing."),
                advanced=False,
            ),
        ):
            self.addParameter(definition)
        self.addOutput(QgsProcessingOutputString("INTERPRETER", tr("The Python that PolyMerge runs in")))

    def processAlgorithm(
        self, parameters: Parameters, context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        """Check, use or make an environment."""
        python, wheels = (absolute_file(self, parameters, name, context) for name in ("PYTHON", "WHEELS"))
        if self.parameterAsBoolean(parameters, "CHECK_ONLY", context):
            python = _present()
            _check(python, feedback)
        elif not python:
            raise QgsProcessingException(tr("No Python is named: choose an interpreter, 3.10 or newer, as PYTHON."))
        elif self.parameterAsBoolean(parameters, "USE_AS_IS", context):
            _check(python, feedback)
            use_interpreter(python)
        elif wheels and not Path(wheels).is_dir():
            raise QgsProcessingException(tr("There is no folder {}: choose the folder of wheels again.").format(wheels))
        else:
            python = _make(python, wheels, feedback)
            use_interpreter("")
        feedback.setProgress(100)
        feedback.pushInfo(tr("PolyMerge is ready. It runs in {}").format(python))
        return {"INTERPRETER": python}


def _present() -> str:
    try:
        return worker_python()
    except EnvironmentMissing as missing:
        raise QgsProcessingException(str(missing)) from missing


def _make(python: str, wheels: str, feedback: QgsProcessingFeedback) -> str:
    """Make an environment and return its interpreter."""
    source = ["--no-index", f"--find-links={wheels}"] if wheels else []
    with new_environment(python) as folder:
        _step(feedback, 0, tr("Looking at {}").format(python))
        unfit = tr("{} cannot make an environment ({}): choose another Python.")
        _run(python, [_CHECK], feedback, unfit, isolated=True)
        _step(feedback, 5, tr("Making an environment in {}").format(folder))
        failed = tr("{} cannot make an environment ({}).")
        _run(python, ["-m", "venv", str(folder)], feedback, failed, isolated=True)
        made = interpreter_of(folder)
        _step(feedback, 15, tr("Installing the libraries from {}").format(wheels or "PyPI"))
        quiet = ["--disable-pip-version-check", "--no-input", "--progress-bar=off"]
        _run(
            made,
            ["-m", "pip", "install", *quiet, "--only-binary=:all:", *source, f"--requirement={REQUIREMENTS}"],
            feedback,
            tr("{} cannot install the libraries ({}): check the network, or give a folder that holds all wheels."),
        )
        _step(feedback, 90, tr("Trying it"))
        _check(made, feedback)
    return made


def _check(python: str, feedback: QgsProcessingFeedback) -> None:
    """Check that a Python has the libraries, and that they work."""
    message = tr(
        "{} cannot run PolyMerge ({}): install what is missing, or let “Set up PolyMerge” make an environment."
    )
    _run(python, [_CHECK, str(REQUIREMENTS)], feedback, message)
    _run(python, ["-m", "polymerge_core", "env"], feedback, message)


def _step(feedback: QgsProcessingFeedback, percent: int, text: str) -> None:
    feedback.setProgress(percent)
    feedback.setProgressText(text)


def _run(
    python: str, arguments: list[str], feedback: QgsProcessingFeedback, failure: str, *, isolated: bool = False
) -> None:
    """Run a Python, perhaps without what its user added to it, and show what it says.

    The sentence `failure` has places for the Python and for the reason.
    """
    said: list[str] = []

    def hear(line: str) -> None:
        said.append(line)
        feedback.pushConsoleInfo(line)

    if not Path(python).is_file():
        raise QgsProcessingException(failure.format(python, tr("there is no such file")))
    ended = run_program(
        python,
        [
            *(["-I"] if isolated else []),
            _OWN_GROUP,
            *arguments,
        ],  # venv runs pip in further processes, which a cancel must end too
        environment=clean_environment(PYTHONPATH=str(ROOT)),
        feedback=feedback,
        on_line=hear,
        folder=str(ROOT),
        group=True,
    )
    if ended.cancelled:
        raise QgsProcessingException(tr("Cancelled; the environment is as it was before."))
    if not ended.well:
        errors = [line for line in said if line.startswith("ERROR: ")]  # pip says more after it
        raise QgsProcessingException(
            failure.format(python, ended.not_started or (errors or said or [tr("it says nothing")])[-1])
        )
