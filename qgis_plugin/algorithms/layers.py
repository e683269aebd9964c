"""Algorithms that read local maps from layers of the user."""

from __future__ import annotations

from pathlib import Path

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProviderRegistry,
    QgsVectorLayer,
    QgsWkbTypes,
)

from ..destinations import Place
from ..parameters import is_known
from ..progress import Part
from ..staging import Input, crs_of, file_names, file_of, layer_input, layer_inputs, place_of_layer, stage_layer
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

#: The layers that are meant where a file of PolyMerge is named without one; the command line takes them too.
_CONTRACT = frozenset({"local_maps", "elements"})
_MAIN_MAP = {"MAIN_MAP": "elements", "MAIN_MAP_AREAS": "elements_areas", "MAIN_MAP_ALIASES": _ALIASES}

#: What the local maps looked at; only a merge asks for it.
_INSTANCES = "INSTANCES"


class LayerAlgorithm(WorkerAlgorithm):
    """An algorithm whose inputs are the layers to merge, and perhaps a main map."""

    def __init__(self) -> None:
        super().__init__()
        self._layers: list[Input] = []
        self._main_map: dict[str, Input] = {}
        self._instances: Input | None = None

    def prepareAlgorithm(
        self, parameters: Parameters, context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> bool:
        """Take the layers as they are now; this runs in the thread of the project."""
        super().prepareAlgorithm(parameters, context, feedback)
        selected = self.parameterAsBoolean(parameters, "SELECTED_ONLY", context)
        layers = self.parameterAsLayerList(parameters, "LOCAL_MAPS", context)
        for warning in filter(None, map(passed_over, layers)):
            feedback.pushWarning(warning)
        self._layers = layer_inputs(layers, selected_only=selected)
        instances = self.parameterAsVectorLayer(parameters, _INSTANCES, context)
        self._instances = None if instances is None else layer_input(instances)
        for name, part in _MAIN_MAP.items():
            layer = self.parameterAsVectorLayer(parameters, name, context)
            if layer is not None:
                self._main_map[part] = layer_input(layer)
        return True

    def stage(self, parameters: Parameters, context: QgsProcessingContext, folder: Path, part: Part) -> Staged:
        """Write the layers into GeoPackages that bear their names."""
        del parameters, context
        # The worker reads the footprints that it finds beside a layer of this name.
        known = [] if self._instances is None else [self._instances]
        table = "local_maps" if known else "features"
        pieces = iter(part.pieces(len(self._layers) * (1 + len(known)) + len(self._main_map)))
        titles = {}
        for name, given in zip(file_names([each.title for each in self._layers]), self._layers):
            file = folder / "layers" / f"{name}.gpkg"
            stage_layer(given, file, table, next(pieces))
            for instances in known:
                stage_layer(instances, file, "instances", next(pieces))
            titles[str(file)] = f"“{given.title}”"
        inputs = list(titles)
        if not self._main_map:
            return Staged([], inputs, titles)
        title = next(iter(self._main_map.values())).title
        file = folder / "main_map" / f"{file_names([title])[0]}.gpkg"
        for layer, given in self._main_map.items():
            stage_layer(given, file, layer, next(pieces), spatial=layer != _ALIASES)
        return Staged([f"--main-map={file}"], inputs, {**titles, str(file): f"“{title}”"})

    def places_read(self, parameters: Parameters, context: QgsProcessingContext) -> list[Place]:
        """Return the files of the layers that lie in files."""
        layers = self.parameterAsLayerList(parameters, "LOCAL_MAPS", context)
        layers += [self.parameterAsVectorLayer(parameters, name, context) for name in (_INSTANCES, *_MAIN_MAP)]
        return [place_of_layer(layer) for layer in layers if isinstance(layer, QgsVectorLayer) and file_of(layer)]

    def fault(self, parameters: Parameters, context: QgsProcessingContext) -> str:
        """Return what is wrong with the layers, as far as QGIS can know."""
        return (
            super().fault(parameters, context)
            or self._contradiction(parameters, context)
            or self._unopened(parameters, context)
            or self._unfit(parameters, context)
        )

    def _unopened(self, parameters: Parameters, context: QgsProcessingContext) -> str:
        """Name a layer that Processing would pass over in silence."""
        given = parameters.get("LOCAL_MAPS")
        opened = self.parameterAsLayerList(parameters, "LOCAL_MAPS", context)
        if isinstance(given, (list, tuple)) and (
            len(opened) < len(given) or not all(isinstance(layer, QgsVectorLayer) for layer in opened)
        ):
            return tr("One of the layers to merge cannot be opened as a vector layer: choose the layers again.")
        for name in (_INSTANCES, *_MAIN_MAP):
            if parameters.get(name) and self.parameterAsVectorLayer(parameters, name, context) is None:
                title = self.parameterDefinition(name).description()
                return tr("The layer that is given as {} ({}) cannot be opened: choose it again.").format(title, name)
        aliases = self.parameterAsVectorLayer(parameters, "MAIN_MAP_ALIASES", context)
        if aliases is not None and _lacks(aliases, "old_id", "element_id"):
            return tr("Layer “{}” is no table of retired ids, which has the columns old_id and element_id.").format(
                aliases.name()
            )
        instances = self.parameterAsVectorLayer(parameters, _INSTANCES, context)
        if instances is not None and _lacks(instances, "drive", "instance"):
            return tr("Layer “{}” is none of footprints, which has the columns drive and instance.").format(
                instances.name()
            )
        return ""

    def _contradiction(self, parameters: Parameters, context: QgsProcessingContext) -> str:
        if not parameters.get("MAIN_MAP") and any(parameters.get(name) for name in _MAIN_MAP):
            return tr("Areas or retired ids of a main map are given, but no main map: choose it too.")
        declared = self.parameterAsCrs(parameters, "CRS", context).isValid()
        plain = self.parameterAsBoolean(parameters, "LOCAL_CRS", context)
        return crs_contradiction(declared=declared, plain=plain)

    def _unfit(self, parameters: Parameters, context: QgsProcessingContext) -> str:
        layers = self.parameterAsLayerList(parameters, "LOCAL_MAPS", context)
        main_map = self.parameterAsVectorLayer(parameters, "MAIN_MAP", context)
        declared = self.parameterAsCrs(parameters, "CRS", context).isValid()
        plain = self.parameterAsBoolean(parameters, "LOCAL_CRS", context)
        faults = (
            layer_fault(layer, has_crs=is_known(crs_of(layer)) or declared or plain)
            for layer in [*layers, *([] if main_map is None else [main_map])]
        )
        return next(filter(None, faults), "")


def _lacks(layer: QgsVectorLayer, *names: str) -> bool:
    return any(layer.fields().lookupField(name) < 0 for name in names)


def crs_contradiction(*, declared: bool, plain: bool) -> str:
    """Say that layers without a CRS cannot be in a CRS and in none; empty where they are not."""
    if not (declared and plain):
        return ""
    return tr("Layers without a CRS cannot be both in a CRS and in plain metres: give CRS or LOCAL_CRS, not both.")


def passed_over(layer: QgsVectorLayer) -> str:
    """Say which layer of a file is taken where none was named, as QGIS does without a word; empty where it is plain."""
    if layer.providerType() != "ogr" or "|" in layer.source():
        return ""
    metadata = QgsProviderRegistry.instance().providerMetadata("ogr")
    spatial = [
        each.name() for each in metadata.querySublayers(layer.source()) if each.wkbType() != QgsWkbTypes.Type.NoGeometry
    ]
    if len(spatial) < 2 or spatial[0] in _CONTRACT:
        return ""
    return tr(
        "{} holds several layers, of which the first is taken, {}: name the others as {}|layername=LAYER."
    ).format(Path(layer.source()).name, spatial[0], Path(layer.source()).name)


def layer_fault(layer: QgsVectorLayer, *, has_crs: bool) -> str:
    """Say what is wrong with a layer, as far as QGIS can know; empty where nothing is."""
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
