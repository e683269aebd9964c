"""Small layers, and ways to look at files, that the tests of reading and writing share."""

import hashlib
from pathlib import Path

import geopandas as gpd
import numpy as np

from polymerge_core.io import read_layers
from polymerge_core.store.geopackage import connect

UTM = "EPSG:25833"
EXTENSIONS = ["gpkg", "shp", "geojson", "fgb", "parquet"]
LINES = ["LINESTRING (0.123456789012 1, 2 3)", "LINESTRING (10 10, 20 20, 30 10)"]
SQUARE = "POLYGON ((0 0, 1 0, 1 1, 0 0))"
BIG = 2**53 + 1


def layer(wkt=LINES, *, crs=UTM, **columns):
    return gpd.GeoDataFrame(columns, geometry=gpd.GeoSeries.from_wkt(list(wkt), crs=crs))


def big(rows=3000):
    text = np.random.default_rng(0).bytes(20 * rows).hex()
    words = [text[40 * n : 40 * n + 40] for n in range(rows)]
    return layer([f"LINESTRING ({n} 0, {n} 1, {n} 2)" for n in range(rows)], a=range(rows), b=words)


def only(path, **options):
    (frame,) = read_layers(path, **options).values()
    return frame


def digest(path):
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def temporaries(folder):
    return [entry.name for entry in Path(folder).iterdir() if entry.name.startswith(".polymerge-")]


def read_only(path, patience_s):
    """Open a GeoPackage that cannot be written: as without permission, which root has all the same."""
    connection = connect(path, patience_s)
    connection.execute("PRAGMA query_only = ON")
    return connection
