"""Layers that the session makes up: GPS tracks of one path, and more lines than are merged in a moment."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable
from pathlib import Path

from qgis.core import (
    QgsCoordinateReferenceSystem,
    QgsCoordinateTransformContext,
    QgsFeature,
    QgsFeatureSink,
    QgsField,
    QgsFields,
    QgsGeometry,
    QgsLineString,
    QgsVectorFileWriter,
    QgsWkbTypes,
)
from qgis.PyQt.QtCore import QVariant

#: Where the made-up path begins, and metres per degree there.
_WEST, _SOUTH = 11.57, 48.15
_M_PER_DEGREE_E, _M_PER_DEGREE_N = 74_250.0, 111_200.0


def write_tracks(path: Path, count: int = 10) -> None:
    """Write GPS-like tracks of one winding path: a Shapefile in degrees, with an id and nothing else."""
    chance = random.Random(7)
    write_lines(path, "ESRI Shapefile", "EPSG:4326", (_track(chance) for _ in range(count)))


def _track(chance: random.Random, length: int = 200) -> list[tuple[float, float]]:
    """Return one walk along the path; the error drifts, as that of a receiver does."""
    points, east, north = [], chance.gauss(0, 4), chance.gauss(0, 4)
    x = chance.uniform(0, 12)
    while x < length - chance.uniform(0, 12):
        east, north = 0.85 * east + chance.gauss(0, 1.2), 0.85 * north + chance.gauss(0, 1.2)
        y = 45 * math.sin(x / 35) + 0.2 * x
        points.append((_WEST + (x + east) / _M_PER_DEGREE_E, _SOUTH + (y + north) / _M_PER_DEGREE_N))
        x += chance.uniform(7, 11)
    return points


def write_many(path: Path, rows: int = 250, columns: int = 400) -> None:
    """Write a hundred thousand short lines, rows of two that belong together, as a GeoPackage."""
    lines = (
        [(10.0 * column, 4.0 * row + 3.5 * (row % 2)), (10.0 * column + 8, 4.0 * row + 3.5 * (row % 2) + 0.1)]
        for row in range(rows)
        for column in range(columns)
    )
    write_lines(path, "GPKG", "EPSG:32632", lines)


def write_lines(path: Path, driver: str, crs: str, lines: Iterable[list[tuple[float, float]]]) -> None:
    """Write lines with the column `id` into a file."""
    fields = QgsFields()
    fields.append(QgsField("id", QVariant.Int))
    options = QgsVectorFileWriter.SaveVectorOptions()
    options.driverName, options.layerName = driver, path.stem
    writer = QgsVectorFileWriter.create(
        str(path),
        fields,
        QgsWkbTypes.Type.LineString,
        QgsCoordinateReferenceSystem(crs),
        QgsCoordinateTransformContext(),
        options,
    )
    if writer.hasError() != QgsVectorFileWriter.WriterError.NoError:
        raise OSError(writer.errorMessage())
    for number, line in enumerate(lines, 1):
        feature = QgsFeature()
        feature.setAttributes([number])
        feature.setGeometry(QgsGeometry(QgsLineString([x for x, _ in line], [y for _, y in line])))
        writer.addFeature(feature, QgsFeatureSink.Flag.FastInsert)
    del writer  # closes the file
