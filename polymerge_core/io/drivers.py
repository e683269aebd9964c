"""What reading and writing share about the formats: their drivers, types, errors and warnings."""

from __future__ import annotations

import warnings
from pathlib import Path

import pandas as pd
import pyarrow as pa
from pyproj.exceptions import CRSError as PyprojCrsError
from shapely.errors import ShapelyError

#: Outputs are known by their extension.
FORMATS = {
    ".gpkg": "GPKG",
    ".shp": "ESRI Shapefile",
    ".geojson": "GeoJSON",
    ".fgb": "FlatGeobuf",
    ".parquet": "Parquet",
    ".geoparquet": "Parquet",
}

#: Integers and booleans with gaps keep their exact values only in pandas' nullable types.
EXACT_TYPES = {
    pa.int8(): pd.Int8Dtype(),
    pa.int16(): pd.Int16Dtype(),
    pa.int32(): pd.Int32Dtype(),
    pa.int64(): pd.Int64Dtype(),
    pa.uint8(): pd.UInt8Dtype(),
    pa.uint16(): pd.UInt16Dtype(),
    pa.uint32(): pd.UInt32Dtype(),
    pa.uint64(): pd.UInt64Dtype(),
    pa.bool_(): pd.BooleanDtype(),
}

#: What the drivers raise when a file is damaged, or does not take what is written to it.
DRIVER_ERRORS = (
    RuntimeError,
    OSError,
    ValueError,
    LookupError,
    pa.ArrowException,
    ShapelyError,
    PyprojCrsError,
)


class LayerWarning(UserWarning):
    """Something about a file that the user should know, and that does not stop the run."""


def warn(message: str) -> None:
    """Issue a `LayerWarning`."""
    warnings.warn(message, LayerWarning, stacklevel=3)


def is_news(category: type[Warning]) -> bool:
    """Whether a warning is about the file and not about a library's future; GEOS's have no category."""
    return category is Warning or issubclass(category, (RuntimeWarning, UserWarning))


def gdal_path(path: Path, kind: str) -> str:
    """Return the path as GDAL is to be given it."""
    # The prefix keeps other drivers that live in JSON files, some of which open addresses, out of it.
    return f"GeoJSON:{path}" if kind == "GeoJSON" else str(path)
