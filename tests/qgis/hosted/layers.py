"""Small layers that one can draw on paper."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from qgis.core import NULL, QgsFeature, QgsGeometry, QgsProject, QgsVectorFileWriter, QgsVectorLayer

#: The south-west corner of what is drawn, in UTM zone 32.
EAST, NORTH = 500_000, 5_600_000
UTM = "EPSG:32632"


def track(offset: float = 0.0, *, length: float = 20.0, start: float = 0.0) -> str:
    """Return a line to the east, `offset` metres to the north."""
    y = NORTH + offset
    middle = EAST + start + length / 2
    return f"LINESTRING({EAST + start} {y}, {middle} {y + 0.1}, {EAST + start + length} {y})"


def memory_layer(
    shapes: Iterable[str | None],
    *,
    name: str = "tracks",
    kind: str = "LineString",
    crs: str = UTM,
    columns: str = "",
    rows: Sequence[Sequence[Any]] = (),
) -> QgsVectorLayer:
    """Return a layer in memory of shapes as WKT; `columns` is as in ``field=id:integer&field=name:string``."""
    layer = QgsVectorLayer(f"{kind}?crs={crs}&{columns}", name, "memory")
    assert layer.isValid()
    add_features(layer, shapes, rows)
    return layer


def add_features(layer: QgsVectorLayer, shapes: Iterable[str | None], rows: Sequence[Sequence[Any]] = ()) -> None:
    """Add features to a layer: to its edits where it is being edited, else for good."""
    features = []
    for number, shape in enumerate(shapes):
        feature = QgsFeature(layer.fields())
        if shape is not None:
            feature.setGeometry(QgsGeometry.fromWkt(shape))
        if rows:
            feature.setAttributes(list(rows[number]))
        features.append(feature)
    owner = layer if layer.isEditable() else layer.dataProvider()
    if features:
        added, _ = owner.addFeatures(features) if owner is not layer else (owner.addFeatures(features), None)
        assert added
    layer.updateExtents()


def file_layer(layer: QgsVectorLayer, path: Path, driver: str = "GPKG") -> QgsVectorLayer:
    """Save a layer as a file and open that."""
    options = QgsVectorFileWriter.SaveVectorOptions()
    options.driverName = driver
    error = QgsVectorFileWriter.writeAsVectorFormatV3(
        layer, str(path), QgsProject.instance().transformContext(), options
    )
    assert error[0] == QgsVectorFileWriter.WriterError.NoError, error
    opened = QgsVectorLayer(str(path), path.stem, "ogr")
    assert opened.isValid()
    return opened


def plain(value: Any) -> Any:
    """Return an attribute value, with None for the NULL of QGIS."""
    return None if value == NULL else value


def table(layer: QgsVectorLayer) -> list[dict[str, Any]]:
    """Return the attributes of all features."""
    return [{name: plain(feature[name]) for name in layer.fields().names()} for feature in layer.getFeatures()]


def shapes(layer: QgsVectorLayer) -> dict[int, str]:
    """Return the geometries as WKT by feature id; empty for a feature without one."""
    return {feature.id(): feature.geometry().asWkt(3) for feature in layer.getFeatures()}
