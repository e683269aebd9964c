"""Results in: the layers of the worker's GeoPackage go to where the user wants them, in any format QGIS can write."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from qgis.core import (
    QgsFeature,
    QgsFeatureSink,
    QgsField,
    QgsFields,
    QgsProcessing,
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingParameterFeatureSink,
    QgsProviderRegistry,
    QgsVectorLayer,
    QgsWkbTypes,
)

from .compat import INTEGER
from .destinations import destination_text
from .parameters import explained
from .staging import crs_of, in_chunks
from .translation import tr

#: A Shapefile cuts names of columns at ten characters; these are the names that the command line writes to it.
_SHAPEFILE_NAMES = {"element_id": "elem_id", "n_observations": "n_obs", "n_instances": "n_inst"}

_WHOLE_NUMBER_DIGITS = 18

_SOURCE_TYPES = {
    "line": QgsProcessing.SourceType.TypeVectorLine,
    "polygon": QgsProcessing.SourceType.TypeVectorPolygon,
    "table": QgsProcessing.SourceType.TypeVector,
}
_WKB_TYPES = {
    "line": QgsWkbTypes.Type.LineString,
    "polygon": QgsWkbTypes.Type.Polygon,
    "table": QgsWkbTypes.Type.NoGeometry,
}
_GEOMETRIES = {"line": "LineString", "polygon": "Polygon"}

#: QGIS takes an empty layer that may hold any kind of geometry for a table.
_SAYS_NOTHING = (QgsWkbTypes.Type.Unknown, QgsWkbTypes.Type.NoGeometry)


class Result(NamedTuple):
    """One layer that an algorithm makes.

    Parameters
    ----------
    parameter : str
        Name of the sink.
    title : str
        What it is called in the dialog and in the layer tree.
    layers : tuple of str
        Names that the layer may have in the worker's GeoPackage. Where there is none of them, because nothing belongs
        in it, it has the columns of the last one.
    kind : {"line", "polygon", "table"}
        What its features are.
    help : str
        What is in it.
    style : str
        Name of the layer style.
    optional : bool
        Whether the user may do without it.
    wanted : bool
        Whether it is made where the user does not say.
    shown_empty : bool
        Whether it is loaded into the project when there is nothing in it.
    precious : bool
        Whether the user is warned where there is something in it that is not kept.
    """

    parameter: str
    title: str
    layers: tuple[str, ...]
    kind: str
    help: str
    style: str
    optional: bool = True
    wanted: bool = True
    shown_empty: bool = False
    precious: bool = False

    def definition(self) -> QgsProcessingParameterFeatureSink:
        """Return the sink's definition."""
        sink = QgsProcessingParameterFeatureSink(
            self.parameter, self.title, _SOURCE_TYPES[self.kind], None, self.optional, self.wanted
        )
        return explained(sink, self.help, advanced=not self.wanted)


def deliver(
    result: Result,
    file: Path,
    algorithm: QgsProcessingAlgorithm,
    parameters: dict[str, Any],
    context: QgsProcessingContext,
    feedback: QgsProcessingFeedback,
) -> dict[str, str]:
    """Copy a layer of the worker into the sink that the user chose.

    Returns
    -------
    dict
        The sink's destination by its parameter; empty where the user does without it.

    Raises
    ------
    QgsProcessingException
        If the sink cannot be made or written to.
    """
    there = _layers_of(file, result)
    layer = _open(file, there[0] if there else result.layers[-1])
    kept = [n for n, field in enumerate(layer.fields()) if n not in layer.primaryKeyAttributes()]
    wanted = destination_text(parameters.get(result.parameter), context)
    fields = _named_fields([layer.fields()[n] for n in kept], wanted)
    kind = layer.wkbType() if there and layer.wkbType() not in _SAYS_NOTHING else _WKB_TYPES[result.kind]
    sink, destination = algorithm.parameterAsSink(parameters, result.parameter, context, fields, kind, crs_of(layer))
    if sink is None and result.optional and not wanted:
        if result.precious and there and layer.featureCount():
            message = tr("What belongs in “{}” is not kept ({} in number): name an output for it as {}.")
            feedback.pushWarning(message.format(result.title, layer.featureCount(), result.parameter))
        return {}
    if sink is None:
        raise QgsProcessingException(algorithm.invalidSinkError(parameters, result.parameter))
    if there:
        _copy(layer, sink, fields, kept, result)
    del sink  # closes a file
    _prepare_loading(result, destination, context, empty=not (there and layer.featureCount()), algorithm=algorithm)
    return {result.parameter: destination}


def _layers_of(file: Path, result: Result) -> list[str]:
    """Return the layers of the worker that hold what belongs in a result: areas alone are in its layer `elements`.

    Of a layer of lines and polygons those that belong in it are asked for as QGIS has it, ``NAME|geometrytype=KIND``.
    """
    metadata = QgsProviderRegistry.instance().providerMetadata("ogr")
    found = {each.name(): each for each in metadata.querySublayers(str(file))}
    areas = QgsWkbTypes.GeometryType.PolygonGeometry
    layers = []
    for name in result.layers:
        kind = found[name].wkbType() if name in found else None
        if kind == QgsWkbTypes.Type.Unknown and result.kind in _GEOMETRIES:
            layers.append(f"{name}|geometrytype={_GEOMETRIES[result.kind]}")
        elif kind is not None and (QgsWkbTypes.geometryType(kind) == areas) == (result.kind == "polygon"):
            layers.append(name)
    return layers


def _open(file: Path, layer: str) -> QgsVectorLayer:
    options = QgsVectorLayer.LayerOptions()
    options.loadDefaultStyle = False
    return QgsVectorLayer(f"{file}|layername={layer}", layer, "ogr", options)


def _named_fields(wanted: list[QgsField], destination: str) -> QgsFields:
    fields, shapefile = QgsFields(), destination.lower().endswith(".shp")
    for field in wanted:
        short = _SHAPEFILE_NAMES.get(field.name(), field.name()) if shapefile else field.name()
        # Without a length a Shapefile makes real numbers of whole ones.
        digits = _WHOLE_NUMBER_DIGITS if shapefile and field.type() == INTEGER else 0
        fields.append(QgsField(short, field.type(), "", digits))
    return fields


def _copy(layer: QgsVectorLayer, sink: QgsFeatureSink, fields: QgsFields, kept: list[int], result: Result) -> None:
    for chunk in in_chunks(layer.getFeatures()):
        rows = []
        for feature in chunk:
            values = feature.attributes()
            row = QgsFeature(fields)
            row.setGeometry(feature.geometry())
            row.setAttributes([values[n] for n in kept])
            rows.append(row)
        if not sink.addFeatures(rows, QgsFeatureSink.Flag.FastInsert):
            raise QgsProcessingException(tr("{} cannot be written: {}").format(result.title, sink.lastError()))


def _prepare_loading(
    result: Result, destination: str, context: QgsProcessingContext, *, empty: bool, algorithm: QgsProcessingAlgorithm
) -> None:
    """Have a layer that QGIS is going to load styled; an empty one beside the map itself would only be in the way."""
    if not context.willLoadLayerOnCompletion(destination):
        return
    if empty and not result.shown_empty:
        loaded = context.layersToLoadOnCompletion()
        loaded.pop(destination)
        context.setLayersToLoadOnCompletion(loaded)
        return
    provider = algorithm.provider()
    context.layerToLoadOnCompletionDetails(destination).setPostProcessor(provider.style(result.style))
