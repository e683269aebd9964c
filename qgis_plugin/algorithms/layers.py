"""Algorithms that read local maps from layers of the user."""

from __future__ import annotations

from pathlib import Path

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsVectorLayer,
    QgsWkbTypes,
)

from ..parameters import is_known
from ..progress import Part
from ..staging import Input, crs_of, file_names, layer_input, stage_layer
from ..translation import tr
from .base import Parameters, Staged, WorkerAlgorithm

#: The options of the command line that say how the layers are read.
READING_OPTIONS = (
    "CLASS_FIELD",
    "CLASS_NAME",
    "DRIVE_FIELD",
    "INSTANCE_FIELD",
    "INSTANCE_FROM",
    "SCORE_FIELD",
    "MIN_SCORE",
    "TIMESTAMP_FIELD",
    "PROXIMITY",
    "AREA",
    "CRS",
    "OUT_CRS",
    "STRICT",
)

#: The parts of a main map by the names that they have in the worker's file.
_ALIASES = "id_aliases"
_MAIN_MAP = {"MAIN_MAP": "elements", "MAIN_MAP_AREAS": "elements_areas", "MAIN_MAP_ALIASES": _ALIASES}


class LayerAlgorithm(WorkerAlgorithm):
    """An algorithm whose inputs are the layers to merge, and perhaps a main map."""

    def __init__(self) -> None:
        super().__init__()
        self._layers: list[Input] = []
        self._main_map: dict[str, Input] = {}

    def prepareAlgorithm(
        self, parameters: Parameters, context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> bool:
        """Take the layers as they are now; this runs in the thread of the project."""
        super().prepareAlgorithm(parameters, context, feedback)
        selected = self.parameterAsBoolean(parameters, "SELECTED_ONLY", context)
        layers = self.parameterAsLayerList(parameters, "LOCAL_MAPS", context)
        self._layers = [layer_input(layer, selected_only=selected) for layer in layers]
        for name, part in _MAIN_MAP.items():
            layer = self.parameterAsVectorLayer(parameters, name, context)
            if layer is not None:
                self._main_map[part] = layer_input(layer)
        return True

    def stage(self, parameters: Parameters, context: QgsProcessingContext, folder: Path, part: Part) -> Staged:
        """Write the layers into GeoPackages that bear their names."""
        del parameters, context
        pieces = iter(part.pieces(len(self._layers) + len(self._main_map)))
        titles = {}
        for name, given in zip(file_names([each.title for each in self._layers]), self._layers):
            file = folder / "layers" / f"{name}.gpkg"
            stage_layer(given, file, "features", next(pieces))
            titles[str(file)] = f"“{given.title}”"
        inputs = list(titles)
        if not self._main_map:
            return Staged([], inputs, titles)
        title = next(iter(self._main_map.values())).title
        file = folder / "main_map" / f"{file_names([title])[0]}.gpkg"
        for layer, given in self._main_map.items():
            stage_layer(given, file, layer, next(pieces), spatial=layer != _ALIASES)
        return Staged([f"--main-map={file}"], inputs, {**titles, str(file): f"“{title}”"})

    def files_read(self, parameters: Parameters, context: QgsProcessingContext) -> list[str]:
        """Return the files of the layers that lie in files."""
        layers = self.parameterAsLayerList(parameters, "LOCAL_MAPS", context)
        layers += [self.parameterAsVectorLayer(parameters, name, context) for name in _MAIN_MAP]
        return [layer.source().split("|")[0] for layer in layers if layer is not None]

    def fault(self, parameters: Parameters, context: QgsProcessingContext) -> str:
        """Return what is wrong with the layers, as far as QGIS can know."""
        fault = super().fault(parameters, context)
        if fault:
            return fault
        layers = self.parameterAsLayerList(parameters, "LOCAL_MAPS", context)
        given = parameters.get("LOCAL_MAPS")
        if isinstance(given, (list, tuple)) and len(layers) < len(given):
            return tr("One of the layers to merge cannot be opened: choose the layers again.")
        main_map = self.parameterAsVectorLayer(parameters, "MAIN_MAP", context)
        if main_map is None and any(parameters.get(name) for name in ("MAIN_MAP_AREAS", "MAIN_MAP_ALIASES")):
            return tr("Areas or retired ids of a main map are given, but no main map: choose it too.")
        declared = self.parameterAsCrs(parameters, "CRS", context).isValid()
        plain = self.parameterAsBoolean(parameters, "LOCAL_CRS", context)
        if declared and plain:
            return tr(
                "Layers without a CRS cannot be both in a CRS and in plain metres: give CRS or LOCAL_CRS, not both."
            )
        for layer in [*layers, *([] if main_map is None else [main_map])]:
            fault = _layer_fault(layer, has_crs=is_known(crs_of(layer)) or declared or plain)
            if fault:
                return fault
        return ""


def _layer_fault(layer: QgsVectorLayer, *, has_crs: bool) -> str:
    kind = layer.geometryType()
    if kind == QgsWkbTypes.GeometryType.PointGeometry:
        return tr("Layer “{}” holds points: choose layers of lines or polygons.").format(layer.name())
    if kind == QgsWkbTypes.GeometryType.NullGeometry and layer.featureCount() > 0:
        return tr("Layer “{}” is a table without geometry: choose layers of lines or polygons.").format(layer.name())
    if not has_crs:
        return tr(
            "Layer “{}” has no CRS: set it in the layer's properties, or choose “CRS of layers without one” (CRS), or "
            "tick “Layers without a CRS are in plain metres” (LOCAL_CRS)."
        ).format(layer.name())
    return ""
