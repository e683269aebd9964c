"""`polymerge:evaluatemap`: how close a map is to a reference."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingParameterDefinition,
    QgsVectorLayer,
)

from ..destinations import Place
from ..parameters import compared_parameters, comparing_parameters, is_known
from ..progress import Part
from ..results import Result
from ..staging import Input, crs_of, file_names, file_of, layer_inputs, place_of_layer, stage_layer
from ..translation import mark, tr
from .base import OtherFile, Parameters, Staged, WorkerAlgorithm
from .layers import crs_contradiction, layer_fault, passed_over

#: The layers by what they are, with the option that names them; the map itself is the command's argument.
_ROLES = {"MERGED": "", "REFERENCE": "--reference", "LOCAL_MAPS": "--local", "REGION": "--region"}


class EvaluateMap(WorkerAlgorithm):
    """Measure how close a map is to a reference."""

    NAME = "evaluatemap"
    TITLE = mark("Evaluate map")
    GROUP = "Quality"
    ICON = "evaluate"
    TAGS = mark(
        "evaluate,quality,accuracy,error,compare,reference,ground truth,Frechet,Chamfer,precision,recall,HD map"
    )
    SUMMARY = mark("Measures how close a map is to a reference, and shows the error along its lines in colour.")
    HELP = mark(
        "Distances, average precision, precision and recall by length, duplication and zigzag, class by class. The "
        "report as a page has them with pictures and explanations."
    )
    COMMAND = "evaluate"
    LAYERS_OPTION = "--layers"
    OPTIONS = ("CLASS_FIELD", "CLASS_NAME", "SCORE_FIELD", "AREA", "REGION_FROM", "PCM", "CRS")
    NUMBERS = (
        ("AVERAGE_PRECISION", mark("Average precision, mean over classes")),
        ("N_ELEMENTS", mark("Number of elements")),
        ("N_REFERENCE", mark("Number of reference elements")),
    )

    def __init__(self) -> None:
        super().__init__()
        self._taken: dict[str, list[Input]] = {}

    def inputs(self) -> list[QgsProcessingParameterDefinition]:
        """Return the layers, and how they are compared."""
        return [*compared_parameters(), *comparing_parameters()]

    def results(self) -> list[Result]:
        """Return the errors along the lines, the elements with their figures, and the table of measures."""
        return [
            Result(
                "OUTPUT",
                tr("Errors along the map"),
                ("errors",),
                "line",
                tr("The map in pieces of two metres, each with its distance to the reference."),
                style="evaluation_errors",
                optional=False,
                shown_empty=True,
            ),
            Result(
                "EVALUATED",
                tr("Evaluated elements"),
                ("evaluated",),
                "line",
                tr("The elements of the map, each with its best match and its own figures."),
                style="evaluated",
            ),
            Result(
                "EVALUATED_AREAS",
                tr("Evaluated areas"),
                ("evaluated_areas", "evaluated"),
                "polygon",
                tr("The same of elements that are polygons."),
                style="evaluated_areas",
            ),
            Result(
                "MEASURES",
                tr("Measures"),
                ("measures",),
                "table",
                tr("One row for each class and measure: number, mean, smallest, largest, standard deviation."),
                style="measures",
                shown_empty=True,
            ),
        ]

    def files(self) -> list[OtherFile]:
        """Return the page."""
        text = tr("Tables, pictures and histograms as one page that any browser shows.")
        return [OtherFile("PAGE", tr("Report as a page"), "--output", "HTML (*.html)", ".html", text)]

    def prepareAlgorithm(
        self, parameters: Parameters, context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> bool:
        """Take the layers as they are now; this runs in the thread of the project."""
        super().prepareAlgorithm(parameters, context, feedback)
        for role in _ROLES:
            layers = self._layers(role, parameters, context)
            for warning in filter(None, map(passed_over, layers)):
                feedback.pushWarning(warning)
            self._taken[role] = layer_inputs(layers)
        return True

    def stage(self, parameters: Parameters, context: QgsProcessingContext, folder: Path, part: Part) -> Staged:
        """Write the layers into GeoPackages that bear their names, in a folder for each role."""
        del parameters, context
        pieces = iter(part.pieces(sum(map(len, self._taken.values()))))
        options, inputs, titles = [], [], {}
        for role, option in _ROLES.items():
            layers = self._taken[role]
            for name, given in zip(file_names([each.title for each in layers]), layers):
                file = folder / role.lower() / f"{name}.gpkg"
                stage_layer(given, file, "features", next(pieces))
                titles[str(file)] = f"“{given.title}”"
                if option:
                    options.append(f"{option}={file}")
                else:
                    inputs.append(str(file))
        return Staged(options, inputs, titles)

    def places_read(self, parameters: Parameters, context: QgsProcessingContext) -> list[Place]:
        """Return the files of the layers that lie in files."""
        layers = [layer for role in _ROLES for layer in self._layers(role, parameters, context)]
        return [place_of_layer(layer) for layer in layers if isinstance(layer, QgsVectorLayer) and file_of(layer)]

    def fault(self, parameters: Parameters, context: QgsProcessingContext) -> str:
        """Return what is wrong with the layers, as far as QGIS can know."""
        declared = self.parameterAsCrs(parameters, "CRS", context).isValid()
        plain = self.parameterAsBoolean(parameters, "LOCAL_CRS", context)
        known = super().fault(parameters, context) or crs_contradiction(declared=declared, plain=plain)
        faults = (self._role_fault(role, parameters, context, has_crs=declared or plain) for role in _ROLES)
        return known or next(filter(None, faults), "")

    def _role_fault(self, role: str, parameters: Parameters, context: QgsProcessingContext, *, has_crs: bool) -> str:
        layers, given = self._layers(role, parameters, context), parameters.get(role)
        wanted = len(given) if isinstance(given, (list, tuple)) else int(bool(given))
        if len(layers) < wanted or not all(isinstance(layer, QgsVectorLayer) for layer in layers):
            title = self.parameterDefinition(role).description()
            return tr("A layer that is given as {} ({}) cannot be opened: choose it again.").format(title, role)
        faults = (layer_fault(layer, has_crs=is_known(crs_of(layer)) or has_crs) for layer in layers)
        return next(filter(None, faults), "")

    def _layers(self, role: str, parameters: Parameters, context: QgsProcessingContext) -> list[Any]:
        if role != "REGION":
            return list(self.parameterAsLayerList(parameters, role, context))
        layer = self.parameterAsVectorLayer(parameters, role, context)
        return [] if layer is None else [layer]

    def numbers(self, report: dict[str, Any]) -> dict[str, float]:
        """Return the figure over all classes, and counts."""
        precision = report["measures"]["all"]["ap"]["value"]
        return {
            **({} if precision is None else {"AVERAGE_PRECISION": precision}),
            "N_ELEMENTS": report["elements"],
            "N_REFERENCE": report["reference"],
        }
