"""Layers out: any layer that QGIS can read becomes a GeoPackage that the worker can read.

Filters, selections, edits that are not saved yet, joins, layers in memory and in databases all come through, because
QGIS itself reads the features. Nothing is reprojected: the worker does all work on coordinates.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

from qgis.core import (
    NULL,
    QgsCoordinateReferenceSystem,
    QgsCoordinateTransformContext,
    QgsFeature,
    QgsFeatureIterator,
    QgsFeatureRequest,
    QgsFeatureSink,
    QgsFeedback,
    QgsField,
    QgsFields,
    QgsProcessingException,
    QgsProviderRegistry,
    QgsVectorFileWriter,
    QgsVectorLayer,
    QgsVectorLayerFeatureSource,
    QgsWkbTypes,
)
from qgis.PyQt.QtCore import QCoreApplication, QDateTime, Qt, QTime

from .compat import DATE_AND_TIME, INTEGER, PLAIN_TYPES, TEXT
from .destinations import Place
from .progress import Part
from .translation import tr

#: Features that are handed over at once; a cancel is looked for in between.
_CHUNK = 2000

#: Characters that file systems or the worker would take for something else than a part of a name.
_NOT_IN_NAMES = re.compile(r'[\x00-\x1f/\\:*?"<>|!;]')

#: In bytes; file systems allow 255, of which SQLite's journals need some.
_LONGEST_NAME = 160

# The worker knows a feature by the id it has here, so that it becomes the id in the GeoPackage; neither column may
# bear a name that one of the user's could have.
_ID_COLUMN, _GEOMETRY_COLUMN = "polymerge_feature_id", "polymerge_geometry"

_LONGEST_REASON = 200


@dataclass(frozen=True)
class Input:
    """A layer that is to go to the worker; its features may be read in any thread."""

    #: What the user calls it.
    title: str
    crs: QgsCoordinateReferenceSystem
    fields: QgsFields
    read: Callable[[QgsFeatureRequest], QgsFeatureIterator]
    count: int
    #: The column that holds nothing but the feature ids of its file; empty where there is none.
    id_column: str = ""


def layer_inputs(layers: Sequence[QgsVectorLayer], *, selected_only: bool = False) -> list[Input]:
    """Take layers as they are now; call this in their thread.

    Layers of one file that bear the file's name, as ``qgis_process`` opens them, get their own names.
    """
    files = [file_of(layer) for layer in layers]
    taken = []
    for layer, file in zip(layers, files):
        given = layer_input(layer, selected_only=selected_only)
        if files.count(file) > 1 and layer.name() == Path(file).stem:
            parts = QgsProviderRegistry.instance().decodeUri(layer.providerType(), layer.source())
            given = replace(given, title=parts.get("layerName") or layer.name())
        taken.append(given)
    return taken


def file_of(layer: QgsVectorLayer) -> str:
    """Return the file that a layer lies in; empty for a layer that lies in none."""
    return str(QgsProviderRegistry.instance().decodeUri(layer.providerType(), layer.source()).get("path", ""))


def place_of_layer(layer: QgsVectorLayer) -> Place:
    """Return where a layer lies in its file."""
    providers = QgsProviderRegistry.instance()
    table = providers.decodeUri(layer.providerType(), layer.source()).get("layerName")
    if not table and layer.providerType() == "ogr":  # QGIS takes the first one
        found = providers.providerMetadata("ogr").querySublayers(file_of(layer))
        table = found[0].name() if found else ""
    return Place(file_of(layer), table or "")


def layer_input(layer: QgsVectorLayer, *, selected_only: bool = False) -> Input:
    """Take a layer as it is now, or its selected features where it has some; call this in the layer's thread."""
    snapshot = QgsVectorLayerFeatureSource(layer)
    chosen = list(layer.selectedFeatureIds()) if selected_only else []

    def read(request: QgsFeatureRequest) -> QgsFeatureIterator:
        return snapshot.getFeatures(request.setFilterFids(chosen) if chosen else request)

    count = len(chosen) or layer.featureCount()
    return Input(layer.name(), crs_of(layer), layer.fields(), read, count, id_column(layer))


def crs_of(layer: QgsVectorLayer) -> QgsCoordinateReferenceSystem:
    """Return the CRS of a layer.

    QGIS takes an empty layer of a file that allows any kind of geometry for a table, which has none; asked for lines
    it finds the CRS.
    """
    if layer.geometryType() != QgsWkbTypes.GeometryType.NullGeometry or layer.providerType() != "ogr":
        return layer.crs()
    return QgsVectorLayer(f"{layer.source()}|geometrytype=LineString", layer.name(), "ogr").crs()


def id_column(layer: QgsVectorLayer) -> str:
    """Return the name of the column that a file made up for its feature ids; empty where there is none."""
    keys = layer.primaryKeyAttributes() if layer.providerType() == "ogr" else []
    return str(layer.fields()[keys[0]].name()) if keys else ""


def file_names(titles: Sequence[str]) -> list[str]:
    """Return a name for each layer's file, each its own, as near to what the user calls it as a file name can be.

    The worker names the sources in its tables and messages by them.
    """
    names: list[str] = []
    for title in titles:
        plain = _NOT_IN_NAMES.sub("_", title).strip(" .").encode()[:_LONGEST_NAME].decode(errors="ignore") or "layer"
        name, number = plain, 1
        while name.casefold() in {other.casefold() for other in names}:
            number += 1
            name = f"{plain} ({number})"
        names.append(name)
    return names


def stage_layer(given: Input, file: Path, layer: str, part: Part, *, spatial: bool = True) -> None:
    """Write a layer into a GeoPackage, beside the layers that are in it already.

    Parameters
    ----------
    given : Input
        The layer.
    file : Path
        The GeoPackage.
    layer : str
        Name of the layer in it.
    spatial : bool, default True
        Whether its features have geometries.
    part : Part
        The part of the run that this is; its feedback tells of a cancel.

    Raises
    ------
    QgsProcessingException
        If it cannot be written, or the user cancels.
    """
    kept = [n for n, field in enumerate(given.fields) if field.name() != given.id_column]
    precise = _with_fractions(given, kept, part.feedback)
    as_text = [n in precise or given.fields[n].type() not in PLAIN_TYPES for n in kept]
    fields = _fields([given.fields[n] for n in kept], as_text)
    file.parent.mkdir(exist_ok=True)
    writer = _writer(given, fields, file, layer, spatial=spatial)
    done = 0
    for chunk in in_chunks(given.read(QgsFeatureRequest())):
        QCoreApplication.processEvents()  # qgis_process hears Ctrl-C in its event loop only
        if part.feedback.isCanceled():
            raise QgsProcessingException(tr("Cancelled; nothing was written."))
        if not writer.addFeatures([_row(feature, fields, kept, as_text) for feature in chunk], _FAST):
            raise _cannot_be_written(given, writer)
        done += len(chunk)
        part.reached(done / max(given.count, done))
    del writer  # closes the file


_FAST = QgsFeatureSink.Flag.FastInsert


def _with_fractions(given: Input, columns: Sequence[int], feedback: QgsFeedback) -> set[int]:
    """Return the columns of times with fractions of a second, which QGIS would cut off; frames are ordered by them."""
    times = [n for n in columns if given.fields[n].type() == DATE_AND_TIME]
    found: set[int] = set()
    if times:
        bare = QgsFeatureRequest().setSubsetOfAttributes(times).setFlags(QgsFeatureRequest.Flag.NoGeometry)
        for feature in given.read(bare):
            if feedback.isCanceled():
                break
            values = feature.attributes()
            found |= {n for n in times if isinstance(values[n], QDateTime) and values[n].time().msec()}
    return found


def _fields(wanted: Sequence[QgsField], as_text: Sequence[bool]) -> QgsFields:
    """Return the columns of the GeoPackage: names that differ in more than case, no limits of length."""
    fields = QgsFields()
    fields.append(QgsField(_ID_COLUMN, INTEGER))
    used = {_ID_COLUMN, _GEOMETRY_COLUMN}
    for field, text in zip(wanted, as_text):
        name, number = field.name(), 0
        while name.casefold() in used:
            number += 1
            name = f"{field.name()}_{number}"
        used.add(name.casefold())
        fields.append(QgsField(name, TEXT if text else field.type()))
    return fields


def _writer(given: Input, fields: QgsFields, file: Path, layer: str, *, spatial: bool) -> QgsVectorFileWriter:
    options = QgsVectorFileWriter.SaveVectorOptions()
    options.driverName, options.layerName = "GPKG", layer
    options.layerOptions = [f"FID={_ID_COLUMN}", f"GEOMETRY_NAME={_GEOMETRY_COLUMN}"]
    if file.exists():
        options.actionOnExistingFile = QgsVectorFileWriter.ActionOnExistingFile.CreateOrOverwriteLayer
    # Layers say less of their features than is true: a layer of lines may hold curves and parts, and an
    # empty one may not know what it would hold.
    kind = QgsWkbTypes.Type.Unknown if spatial else QgsWkbTypes.Type.NoGeometry
    context = QgsCoordinateTransformContext()
    writer = QgsVectorFileWriter.create(str(file), fields, kind, given.crs, context, options)
    if writer.hasError() != QgsVectorFileWriter.WriterError.NoError:
        raise _cannot_be_written(given, writer)
    return writer


def _cannot_be_written(given: Input, writer: QgsVectorFileWriter) -> QgsProcessingException:
    why = next(iter(writer.errorMessage().splitlines()), "")[:_LONGEST_REASON]  # a database adds its whole SQL
    return QgsProcessingException(tr("Layer “{}” cannot be handed to the worker: {}").format(given.title, why))


def in_chunks(features: QgsFeatureIterator) -> Iterator[list[QgsFeature]]:
    """Give features several thousand at a time."""
    several = iter(features)
    while chunk := list(islice(several, _CHUNK)):
        yield chunk


def _row(feature: QgsFeature, fields: QgsFields, kept: Sequence[int], as_text: Sequence[bool]) -> QgsFeature:
    values = feature.attributes()
    row = QgsFeature(fields)
    row.setGeometry(feature.geometry())
    row.setAttributes([feature.id(), *(_text(values[n]) if text else values[n] for n, text in zip(kept, as_text))])
    return row


def _text(value: Any) -> Any:
    """Turn a list, a map, a time of day into text."""
    if value is None or value == NULL:
        return NULL
    if isinstance(value, (list, dict)):
        return json.dumps(value, ensure_ascii=False, default=str)
    if isinstance(value, (QDateTime, QTime)):
        clock = value if isinstance(value, QTime) else value.time()
        return value.toString(Qt.DateFormat.ISODateWithMs if clock.msec() else Qt.DateFormat.ISODate)
    return str(value)
