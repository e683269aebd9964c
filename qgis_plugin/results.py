"""Results in: the layers of the worker's GeoPackage go to where the user wants them, in any format QGIS can write."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
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
    QgsProcessingOutputLayerDefinition,
    QgsProcessingParameterFeatureSink,
    QgsProviderRegistry,
    QgsVectorLayer,
    QgsWkbTypes,
)

from .compat import INTEGER
from .parameters import explained
from .staging import crs_of
from .translation import tr

_CHUNK = 2000

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
    layer : str
        Name of the layer in the worker's GeoPackage.
    kind : {"line", "polygon", "table"}
        What its features are.
    help : str
        What is in it.
    style : str
        Name of the layer style.
    like : str
        The layer whose columns it has where the worker did not write it, because nothing belongs in it.
    optional : bool
        Whether the user may do without it.
    wanted : bool
        Whether it is made where the user does not say.
    shown_empty : bool
        Whether it is loaded into the project when there is nothing in it.
    """

    parameter: str
    title: str
    layer: str
    kind: str
    help: str
    style: str
    like: str = ""
    optional: bool = True
    wanted: bool = True
    shown_empty: bool = False

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
    is_there = result.layer in _layer_names(file)
    layer = _open(file, result.layer if is_there else result.like)
    kept = [n for n, field in enumerate(layer.fields()) if n not in layer.primaryKeyAttributes()]
    fields = _named_fields([layer.fields()[n] for n in kept], destination_text(parameters.get(result.parameter)))
    known = is_there and layer.wkbType() not in _SAYS_NOTHING
    kind = layer.wkbType() if known else _WKB_TYPES[result.kind]
    sink, destination = algorithm.parameterAsSink(parameters, result.parameter, context, fields, kind, crs_of(layer))
    if sink is None:
        if result.optional and not destination_text(parameters.get(result.parameter)):
            return {}
        raise QgsProcessingException(algorithm.invalidSinkError(parameters, result.parameter))
    if is_there:
        _copy(layer, sink, fields, kept, result)
    del sink  # closes a file
    _prepare_loading(result, destination, context, empty=not (is_there and layer.featureCount()), algorithm=algorithm)
    return {result.parameter: destination}


def _layer_names(file: Path) -> list[str]:
    metadata = QgsProviderRegistry.instance().providerMetadata("ogr")
    return [each.name() for each in metadata.querySublayers(str(file))]


def _open(file: Path, layer: str) -> QgsVectorLayer:
    options = QgsVectorLayer.LayerOptions()
    options.loadDefaultStyle = False
    return QgsVectorLayer(f"{file}|layername={layer}", layer, "ogr", options)


def destination_text(value: Any) -> str:
    """Return what the user gave as a destination: a file, a table of a database, or a word for a temporary layer."""
    if isinstance(value, QgsProcessingOutputLayerDefinition):
        value = value.sink.staticValue()
    return str(value or "")


def _named_fields(wanted: list[QgsField], destination: str) -> QgsFields:
    fields, shapefile = QgsFields(), destination.lower().endswith(".shp")
    for field in wanted:
        short = _SHAPEFILE_NAMES.get(field.name(), field.name()) if shapefile else field.name()
        # Without a length a Shapefile makes real numbers of whole ones.
        digits = _WHOLE_NUMBER_DIGITS if shapefile and field.type() == INTEGER else 0
        fields.append(QgsField(short, field.type(), "", digits))
    return fields


def _copy(layer: QgsVectorLayer, sink: QgsFeatureSink, fields: QgsFields, kept: list[int], result: Result) -> None:
    for chunk in _chunks(layer):
        rows = []
        for feature in chunk:
            values = feature.attributes()
            row = QgsFeature(fields)
            row.setGeometry(feature.geometry())
            row.setAttributes([values[n] for n in kept])
            rows.append(row)
        if not sink.addFeatures(rows, QgsFeatureSink.Flag.FastInsert):
            raise QgsProcessingException(tr("{} cannot be written: {}").format(result.title, sink.lastError()))


def _chunks(layer: QgsVectorLayer) -> Iterator[list[QgsFeature]]:
    several = layer.getFeatures()
    while chunk := list(islice(several, _CHUNK)):
        yield chunk


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
