"""What all algorithms share: who they are, and how a run of the worker goes."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any, NamedTuple

from qgis.core import (
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingOutputNumber,
    QgsProcessingParameterDefinition,
    QgsProcessingParameterFileDestination,
)
from qgis.PyQt.QtGui import QIcon

from ..destinations import Place, place_of
from ..environment import EnvironmentMissing, worker_python
from ..layout import icon_path, metadata
from ..parameters import explained, option_arguments
from ..progress import Part
from ..results import Result, deliver
from ..translation import tr
from ..worker import run_worker, workspace

Parameters = dict[str, Any]

# How far a run is when its inputs are with the worker, and when the worker has done its work.
_STAGED, _WORKED = 0.1, 0.9


class PolyMergeAlgorithm(QgsProcessingAlgorithm):
    """An algorithm that says who it is in class attributes.

    Its texts are marked for translation where they are written, and translated where they are shown.
    """

    NAME = ""
    TITLE = ""
    GROUP = "Local maps"
    TAGS = ""
    SUMMARY = ""
    HELP = ""
    ICON = "polymerge"

    def createInstance(self) -> PolyMergeAlgorithm:
        """Return a fresh algorithm for a run."""
        return type(self)()

    def name(self) -> str:
        """Return the id in the provider; it never changes."""
        return self.NAME

    def displayName(self) -> str:
        """Return the name in the toolbox."""
        return tr(self.TITLE)

    def groupId(self) -> str:
        """Return the id of the group in the toolbox; it never changes."""
        return self.GROUP.replace(" ", "").lower()

    def group(self) -> str:
        """Return the group in the toolbox."""
        return tr(self.GROUP)

    def tags(self) -> list[str]:
        """Return the words by which the toolbox's search finds it."""
        return [tag.strip() for tag in tr(self.TAGS).split(",")]

    def shortDescription(self) -> str:
        """Return the tooltip."""
        return tr(self.SUMMARY)

    def shortHelpString(self) -> str:
        """Return the help beside the dialog: what it does, then each parameter."""
        explained = [each for each in self.parameterDefinitions() if each.help()]
        return "\n".join(
            [tr(self.SUMMARY), tr(self.HELP), *(f"<b>{each.description()}</b>: {each.help()}" for each in explained)]
        )

    def helpUrl(self) -> str:
        """Return the page of the user guide."""
        return f"{metadata('homepage')}/blob/main/docs/qgis.md"

    def icon(self) -> QIcon:
        """Return the icon in the toolbox."""
        return QIcon(icon_path(self.ICON))

    def svgIconPath(self) -> str:
        """Return the icon for models."""
        return icon_path(self.ICON)


class Staged(NamedTuple):
    """What the worker is to read."""

    #: Options that name files.
    options: list[str]
    #: The files themselves.
    inputs: list[str]
    #: What the user calls the files that were made for the worker, by their paths.
    shown_as: dict[str, str]


class OtherFile(NamedTuple):
    """A file that the worker writes beside its layers."""

    parameter: str
    title: str
    #: The option of the command that names it.
    option: str
    #: Such as ``HTML (*.html)``, and the ending of it.
    kinds: str
    suffix: str
    help: str


class WorkerAlgorithm(PolyMergeAlgorithm):
    """An algorithm whose work is one command of the command line.

    The layers go to the worker in files of a folder that is gone afterwards, its layers come back into the sinks. Sinks
    are made only when the worker has done its work: whatever goes wrong before, outputs of an earlier run stay as they
    are.
    """

    COMMAND = ""
    #: The parameters that are options of the command.
    OPTIONS: tuple[str, ...] = ()
    #: The option that names the file of layers; empty where the command writes none.
    LAYERS_OPTION = "--output"
    #: Outputs that are numbers, with the text that describes them.
    NUMBERS: tuple[tuple[str, str], ...] = ()

    def inputs(self) -> list[QgsProcessingParameterDefinition]:
        """Return the definitions of what goes in."""
        return []

    def results(self) -> list[Result]:
        """Return the layers that come out."""
        return []

    def files(self) -> list[OtherFile]:
        """Return the files that come out beside the layers and the report."""
        return []

    def places_read(self, parameters: Parameters, context: QgsProcessingContext) -> list[Place]:
        """Return the files that a run reads, and which layer of them."""
        del parameters, context
        return []

    def fault(self, parameters: Parameters, context: QgsProcessingContext) -> str:
        """Return what is wrong with the parameters, in a sentence; empty where nothing is."""
        for each in self.parameterDefinitions():
            given = parameters.get(each.name()) if each.type() == "crs" else None
            # An invalid CRS as an object is how a widget may say that none is wanted; a text is a name that is wrong.
            if isinstance(given, str) and given and not self.parameterAsCrs(parameters, each.name(), context).isValid():
                return tr("{} ({}) cannot be {}: QGIS knows no such CRS.").format(
                    each.description(), each.name(), given
                )
        taken = [(place, tr("a file that is read")) for place in self.places_read(parameters, context)]
        outputs = {result.parameter: result.title for result in self.results()} | {"REPORT": tr("Report")}
        outputs |= {each.parameter: each.title for each in self.files()}
        for name, title in outputs.items():
            place = place_of(parameters.get(name), context)
            if place is None:
                continue
            for other, what in taken:
                if place.replaces(other):
                    message = tr("{} would overwrite {}, {}: choose another file.")
                    return message.format(title, what, Path(place.file).name)
            if place.folder_fault:
                message = tr("{} cannot be written to {}: {}. Choose another folder.")
                return message.format(title, place.file, tr(place.folder_fault))
            taken.append((place, tr("the output {}").format(title)))
        return ""

    def checkParameterValues(self, parameters: Parameters, context: QgsProcessingContext) -> tuple[bool, str]:
        """Say what is wrong with the parameters before anything runs."""
        for each in self.parameterDefinitions():
            value = parameters.get(each.name(), each.defaultValue())
            if not each.checkValueIsAcceptable(value, context):  # QGIS would only say that it is incorrect
                return False, _unacceptable(each, value)
        fine, message = super().checkParameterValues(parameters, context)
        if fine:
            message = self.fault(parameters, context)
        return not message, message

    def prepareAlgorithm(
        self, parameters: Parameters, context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> bool:
        """Look at the parameters again: a model does not ask `checkParameterValues` of its steps."""
        message = self.fault(parameters, context)
        if message:
            raise QgsProcessingException(message)
        for name in parameters.keys() - {each.name() for each in self.parameterDefinitions()}:
            feedback.pushWarning(tr("There is no parameter {}, so it is not used.").format(name))
        return True

    def stage(self, parameters: Parameters, context: QgsProcessingContext, folder: Path, part: Part) -> Staged:
        """Put what the worker reads into a folder where it is not in files yet."""
        del parameters, context, folder, part
        return Staged([], [], {})

    def numbers(self, report: dict[str, Any]) -> dict[str, float]:
        """Return the outputs that are numbers, from the worker's report."""
        del report
        return {}

    def initAlgorithm(self, configuration: dict[str, Any] | None = None) -> None:
        """Declare the parameters and outputs."""
        del configuration
        for definition in self.inputs():
            self.addParameter(definition)
        for result in self.results():
            self.addParameter(result.definition())
        for each in self.files():
            file = QgsProcessingParameterFileDestination(
                each.parameter, each.title, fileFilter=each.kinds, optional=True, createByDefault=False
            )
            self.addParameter(explained(file, each.help))
        report = QgsProcessingParameterFileDestination(
            "REPORT", tr("Report"), fileFilter="JSON (*.json)", optional=True, createByDefault=False
        )
        self.addParameter(explained(report, tr("Counts and settings of the run as JSON."), advanced=True))
        for name, title in self.NUMBERS:
            self.addOutput(QgsProcessingOutputNumber(name, tr(title)))

    def canExecute(self) -> tuple[bool, str]:
        """Say whether there is an environment to run in; the toolbox asks before it opens the dialog."""
        try:
            worker_python()
        except EnvironmentMissing as missing:
            return False, str(missing)
        return True, ""

    def processAlgorithm(
        self, parameters: Parameters, context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        """Stage the inputs, run the worker, deliver its results."""
        ready, what_to_do = self.canExecute()  # qgis_process does not ask before
        if not ready:
            raise QgsProcessingException(what_to_do)
        with workspace() as folder:
            staged = self.stage(parameters, context, folder, Part(feedback, 0.0, _STAGED))
            options = option_arguments(self.OPTIONS, self, parameters, context)
            output, report = folder / "result.gpkg", folder / "report.json"
            copies = {"REPORT": report}
            for each in self.files():
                if self.parameterAsFileOutput(parameters, each.parameter, context):
                    copies[each.parameter] = folder / f"file{each.suffix}"
                    options.append(f"{each.option}={copies[each.parameter]}")
            targets = [*([f"{self.LAYERS_OPTION}={output}"] if self.LAYERS_OPTION else []), f"--json={report}"]
            arguments = [*options, *staged.options, *targets, "--", *staged.inputs]
            shown_as = {**staged.shown_as, f" -> {output}": ""}
            run_worker(self.COMMAND, arguments, Part(feedback, _STAGED, _WORKED), shown_as=shown_as)
            found = json.loads(report.read_text(encoding="utf-8"))
            done: dict[str, Any] = dict(self.numbers(found))
            for result in self.results():
                done.update(deliver(result, output, self, parameters, context, feedback))
            for name, file in copies.items():
                copy_to = self.parameterAsFileOutput(parameters, name, context)
                if copy_to:
                    _copy_file(file, copy_to)
                    done[name] = copy_to
        feedback.setProgress(100)
        return done


def _copy_file(file: Path, copy_to: str) -> None:
    try:
        shutil.copyfile(file, copy_to)
    except OSError as error:
        message = tr("The report {} cannot be written: {}").format(copy_to, error.strerror)
        raise QgsProcessingException(message) from error


def _unacceptable(definition: QgsProcessingParameterDefinition, value: Any) -> str:
    shown = ", ".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value or "")
    if shown and definition.type() in {"multilayer", "vector"}:
        message = tr("{} ({}): {} cannot be opened as a layer; look whether it is there.")
        return message.format(definition.description(), definition.name(), shown)
    message = tr("{} ({}) cannot be {}. {}")
    allowed = _allowed(definition) or definition.help()
    return message.format(definition.description(), definition.name(), shown or tr("empty"), allowed)


def _allowed(definition: QgsProcessingParameterDefinition) -> str:
    if definition.type() in {"number", "distance"}:
        return tr("It is a number from {:g} to {:g}.").format(definition.minimum(), definition.maximum())
    return tr("It is one of {}.").format(", ".join(definition.options())) if definition.type() == "enum" else ""
