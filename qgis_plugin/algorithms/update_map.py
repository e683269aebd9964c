"""`polymerge:updatemap`: a stored map is fed local maps, and made where there is none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingOutputFile,
    QgsProcessingOutputVectorLayer,
    QgsProcessingParameterDefinition,
    QgsVectorLayer,
)

from ..destinations import Place, same_file
from ..parameters import absolute_file, column_parameters, footprint_parameter, layers_parameter, stored_map_parameters
from ..progress import Part
from ..staging import file_of
from ..stored_map import address, edited, kinds_of, layers_of, map_fault, refresh, show, style_of
from ..translation import mark, tr
from .base import Parameters, Staged
from .layers import READING_OPTIONS, LayerAlgorithm


class UpdateMap(LayerAlgorithm):
    """Feed a stored map local maps."""

    NAME = "updatemap"
    TITLE = mark("Update map")
    GROUP = mark("Stored map")
    ICON = "update"
    TAGS = mark("update,map,maintain,change,revision,history,incremental,merge,drive,HD map,survey,temporal")
    SUMMARY = mark("Adds the local maps of new drives or surveys to a map that is kept in a file, and draws it anew.")
    HELP = mark(
        "The map is a GeoPackage that remembers what it was made from and all that ever changed. Only what the new "
        "local maps looked at is drawn anew; ids stay. Local maps that it knows already, by drive and instance, are "
        "skipped with a warning. Either all of a run is in the file afterwards or nothing. Layers of the map that are "
        "in the project show the new state; its lines and areas are loaded where they are not. They know when each "
        "element was first and last seen, so that the temporal controller of QGIS can play it."
    )
    COMMAND = "update"
    LAYERS_OPTION = ""
    OPTIONS = (*(each for each in READING_OPTIONS if each != "OUT_CRS"), "CREATE")
    NUMBERS = (
        ("REVISION", mark("Revision")),
        ("ADDED", mark("Number of elements added")),
        ("CHANGED", mark("Number of elements changed")),
        ("MOVED", mark("Number of elements moved")),
        ("RETIRED", mark("Number of elements retired")),
        ("MERGED", mark("Number of elements merged into others")),
        ("ELEMENTS", mark("Number of elements of the map")),
        ("SKIPPED", mark("Number of local maps known already")),
    )

    def __init__(self) -> None:
        super().__init__()
        self._map = ""
        self._kinds: list[str] = []

    def initAlgorithm(self, configuration: dict[str, Any] | None = None) -> None:
        """Declare the parameters, the file and its layers."""
        super().initAlgorithm(configuration)
        self.addOutput(QgsProcessingOutputFile("MAP", tr("Map")))
        self.addOutput(QgsProcessingOutputVectorLayer("OUTPUT", tr("Lines of the map")))
        self.addOutput(QgsProcessingOutputVectorLayer("AREAS", tr("Areas of the map")))

    def inputs(self) -> list[QgsProcessingParameterDefinition]:
        """Return the map, the layers and their columns, and what holds for a map that is made."""
        rare = stored_map_parameters()
        return [
            *rare[:1],
            *layers_parameter(),
            footprint_parameter(),
            *rare[1:],
            *column_parameters(),
        ]

    def fault(self, parameters: Parameters, context: QgsProcessingContext) -> str:
        """Return what is wrong with the map or the layers, as far as QGIS can know."""
        file = absolute_file(self, parameters, "MAP", context)
        create = self.parameterAsBoolean(parameters, "CREATE", context)
        return (
            map_fault(file, create=create)
            or edited(layers_of(context.project(), file))
            or self._of_the_map(file, parameters, context)
            or super().fault(parameters, context)
        )

    def _of_the_map(self, file: str, parameters: Parameters, context: QgsProcessingContext) -> str:
        """Name a layer that is a part of the map: it would be taken for something that was seen."""
        for layer in self.parameterAsLayerList(parameters, "LOCAL_MAPS", context):
            if isinstance(layer, QgsVectorLayer) and file_of(layer) and same_file(file_of(layer), file):
                return tr("Layer “{}” is a part of the map: choose the layers of new local maps.").format(layer.name())
        return ""

    def places_read(self, parameters: Parameters, context: QgsProcessingContext) -> list[Place]:
        """Return the map too, which the report must not overwrite."""
        return [*super().places_read(parameters, context), Place(absolute_file(self, parameters, "MAP", context))]

    def stage(self, parameters: Parameters, context: QgsProcessingContext, folder: Path, part: Part) -> Staged:
        """Name the map before the layers."""
        staged = super().stage(parameters, context, folder, part)
        return staged._replace(inputs=[absolute_file(self, parameters, "MAP", context), *staged.inputs])

    def processAlgorithm(
        self, parameters: Parameters, context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        """Run the worker on the map itself."""
        done = super().processAlgorithm(parameters, context, feedback)
        self._map = absolute_file(self, parameters, "MAP", context)
        self._kinds = kinds_of(self._map)
        names = {"line": "OUTPUT", "polygon": "AREAS"}
        return {**done, "MAP": self._map, **{names[kind]: address(self._map, kind) for kind in self._kinds}}

    def postProcessAlgorithm(self, context: QgsProcessingContext, feedback: QgsProcessingFeedback) -> dict[str, Any]:
        """Have the project show the new state; this runs in its thread."""
        if context.project() is None or not self._map:
            return {}
        shown = layers_of(context.project(), self._map)
        if edited(shown):  # since the run began
            feedback.pushWarning(
                tr("A layer of the map is being edited, and shows the map as it was: open it again after that.")
            )
        refresh([layer for layer in shown if not layer.isEditable()])
        provider = self.provider()
        show(
            self._map, self._kinds, shown, context, [provider.style(style_of(kind), grows=True) for kind in self._kinds]
        )
        return {}

    def numbers(self, report: dict[str, Any]) -> dict[str, float]:
        """Count what became of the elements."""
        return {name: report[name.lower()] for name, _ in self.NUMBERS}
