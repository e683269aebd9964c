"""`polymerge:updatemap`: a stored map is fed local maps, and made where there is none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import QgsProcessingContext, QgsProcessingParameterDefinition, QgsVectorLayer

from ..destinations import same_file
from ..parameters import absolute_file, column_parameters, footprint_parameter, layers_parameter, stored_map_parameters
from ..progress import Part
from ..staging import file_of
from ..translation import mark, tr
from .base import Parameters, Staged
from .layers import READING_OPTIONS, LayerAlgorithm
from .writes_map import ELEMENT_NUMBERS, WritesMap


class UpdateMap(WritesMap, LayerAlgorithm):
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
    OPTIONS = (*(each for each in READING_OPTIONS if each != "OUT_CRS"), "CREATE")
    NUMBERS = (
        ("REVISION", mark("Revision")),
        *ELEMENT_NUMBERS,
        ("SKIPPED", mark("Number of local maps known already")),
    )

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

    def makes(self, parameters: Parameters, context: QgsProcessingContext) -> bool:
        """Say whether the map is made where there is none."""
        return self.parameterAsBoolean(parameters, "CREATE", context)

    def fault(self, parameters: Parameters, context: QgsProcessingContext) -> str:
        """Return what is wrong with the map or the layers, as far as QGIS can know."""
        file = absolute_file(self, parameters, "MAP", context)
        return self._of_the_map(file, parameters, context) or super().fault(parameters, context)

    def _of_the_map(self, file: str, parameters: Parameters, context: QgsProcessingContext) -> str:
        """Name a layer that is a part of the map: it would be taken for something that was seen."""
        for layer in self.parameterAsLayerList(parameters, "LOCAL_MAPS", context):
            if isinstance(layer, QgsVectorLayer) and file_of(layer) and same_file(file_of(layer), file):
                return tr("Layer “{}” is a part of the map: choose the layers of new local maps.").format(layer.name())
        return ""

    def stage(self, parameters: Parameters, context: QgsProcessingContext, folder: Path, part: Part) -> Staged:
        """Name the map before the layers."""
        staged = super().stage(parameters, context, folder, part)
        return staged._replace(inputs=[absolute_file(self, parameters, "MAP", context), *staged.inputs])

    def numbers(self, report: dict[str, Any]) -> dict[str, float]:
        """Count what became of the elements."""
        return {name: report[name.lower()] for name, _ in self.NUMBERS}
