"""Looking at what was written before it replaces anything."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pyarrow.parquet as pq
import pyogrio
import shapely

from polymerge_core.errors import OutputError
from polymerge_core.io.drivers import DRIVER_ERRORS, FORMATS, gdal_path
from polymerge_core.io.sources import check_shapefile
from polymerge_core.outputs import write_error


def verify(temporary: Path, target: Path, layers: Mapping[str, Any]) -> None:
    """Open what was written and count it: a driver may close an unfinished file without a word."""
    kind = FORMATS[target.suffix.lower()]
    try:
        if kind == "Parquet":
            counts = dict.fromkeys(layers, pq.read_metadata(temporary).num_rows)
        else:
            counts = {name: _count(temporary, kind, name) for name in layers}
        if kind == "ESRI Shapefile":
            check_shapefile(temporary, OutputError)
        whole = kind != "GPKG" or _is_sound(temporary, layers)
    except (*DRIVER_ERRORS, sqlite3.DatabaseError, OutputError) as error:
        broken = OutputError(f"it could not be read back, the disk may be full ({error})")
        raise write_error(broken, target) from error
    if not whole or counts != {name: len(frame) for name, frame in layers.items()}:
        short = OutputError("not all of it was there when it was read back, the disk may be full")
        raise write_error(short, target)


def _is_sound(temporary: Path, layers: Mapping[str, Any]) -> bool:
    """Check a GeoPackage's pages, and its spatial indexes, which GDAL leaves out when there is no room."""
    spatial = [name for name, frame in layers.items() if isinstance(frame, gpd.GeoDataFrame)]
    with contextlib.closing(sqlite3.connect(f"{temporary.as_uri()}?mode=ro", uri=True)) as database:
        sound = database.execute("PRAGMA integrity_check(1)").fetchone()[0] == "ok"
        tables = {row[0] for row in database.execute("SELECT name FROM sqlite_master")}
        for name in spatial:
            index = f"rtree_{name}_geom_rowid"
            quoted = index.replace('"', '""')
            geometry = layers[name].geometry.to_numpy()
            there = np.count_nonzero(~(shapely.is_missing(geometry) | shapely.is_empty(geometry)))
            count = f'SELECT count(*) FROM "{quoted}"'  # noqa: S608 - a table's name cannot be a parameter
            sound = sound and index in tables and database.execute(count).fetchone()[0] == there
    return sound


def _count(temporary: Path, kind: str, name: str) -> int:
    path = gdal_path(temporary, kind)
    if kind == "FlatGeobuf":  # says how many there should be; only reading tells how many there are
        return len(pyogrio.read_dataframe(path, columns=[], read_geometry=False, fid_as_index=True))
    layer = name if kind == "GPKG" else None
    return int(pyogrio.read_info(path, layer=layer, force_feature_count=True)["features"])
