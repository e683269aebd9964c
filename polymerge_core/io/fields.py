"""Names and values of columns that every format can hold."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import date, datetime
from datetime import time as clock_time
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from polymerge_core.errors import OutputError
from polymerge_core.io.drivers import EXACT_TYPES, warn

#: Shapefile cuts column names at 10 bytes; these are the contract's names for it.
SHAPEFILE_NAMES = {"element_id": "elem_id", "n_observations": "n_obs", "n_instances": "n_inst"}

_SHAPEFILE_TEXT_BYTES = 254


def fit(frame: Any, kind: str, where: str) -> tuple[Any, dict[str, str]]:
    """Give the columns names and types that the format can hold; the input is not changed."""
    spatial = isinstance(frame, gpd.GeoDataFrame)
    geometry: Any = frame.geometry if spatial else None
    places = [n for n, name in enumerate(frame.columns) if not (spatial and name == geometry.name)]
    old = [str(frame.columns[n]) for n in places]
    new = fit_names(old, kind, where)
    values = {
        name: _fit_values(frame.iloc[:, n].reset_index(drop=True), kind, f"{where}, column {title}")
        for name, title, n in zip(new, old, places, strict=True)
    }
    fitted = pd.DataFrame(values, index=pd.RangeIndex(len(frame)))
    renamed = {title: name for title, name in zip(old, new, strict=True) if title != name}
    if not spatial:
        return fitted, renamed
    return gpd.GeoDataFrame(fitted, geometry=geometry.to_numpy(), crs=frame.crs), renamed


def fit_names(names: Sequence[str], kind: str, where: str) -> list[str]:
    """Give columns names that the format can hold, each its own."""
    limit = 10 if kind == "ESRI Shapefile" else None
    fitted: list[str] = []
    used = {"fid", "geom", "geometry"}
    # The names that can stay keep theirs, wherever they stand.
    plain = [SHAPEFILE_NAMES.get(name, name) if limit else name for name in names]
    for name in plain:
        if "\0" in name or not _encodable(name):
            raise OutputError(f"{where}: the column name {name!r} holds characters that no file can; rename it")
    for name in plain:
        free = _shorten(name, limit) or "field"
        number = 0
        while free.casefold() in used:
            number += 1
            ending = f"_{number}"
            free = _shorten(name or "field", limit and limit - len(ending)) + ending
        used.add(free.casefold())
        fitted.append(free)
    return fitted


def _shorten(name: str, limit: int | None) -> str:
    return name if limit is None else name.encode()[:limit].decode(errors="ignore")


def _encodable(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _fit_values(column: Any, kind: str, where: str) -> Any:
    dtype = column.dtype
    if isinstance(dtype, gpd.array.GeometryDtype):
        column = pd.Series(shapely.to_wkt(column.to_numpy(), rounding_precision=-1))
    elif isinstance(dtype, pd.ArrowDtype):
        column = pd.Series(pa.array(column).to_pandas(types_mapper=EXACT_TYPES.get))
    elif isinstance(dtype, pd.CategoricalDtype):
        column = column.astype(object)
    if isinstance(column.dtype, pd.SparseDtype):
        column = column.sparse.to_dense()
    if column.dtype == object:
        column = _fit_objects(column)
    if pd.api.types.is_datetime64_any_dtype(column.dtype):
        return _fit_times(column, kind, where)
    if pd.api.types.is_integer_dtype(column.dtype):
        return _fit_integers(column, kind, where)
    if pd.api.types.is_string_dtype(column.dtype) or column.dtype == object:
        _check_text(column, kind, where)
        return column
    if pd.api.types.is_bool_dtype(column.dtype) or pd.api.types.is_float_dtype(column.dtype):
        return column
    return column.astype(object).map(_as_text, na_action="ignore")  # durations, periods, complex numbers


def _fit_objects(column: Any) -> Any:
    """Give a column of Python objects one type; text where it has none."""
    held = pd.api.types.infer_dtype(column, skipna=True)
    exact = {"integer": "Int64", "boolean": "boolean", "floating": "Float64"}
    if held in exact:
        try:
            fitted = column.astype(exact[held])
        except (OverflowError, TypeError, ValueError):
            return column.map(_as_text, na_action="ignore")
        return fitted.astype(float) if held == "floating" else fitted
    if held in {"string", "date", "datetime", "empty"} and not column.map(type).eq(bytes).any():
        return column
    return column.map(_as_text, na_action="ignore")


def _as_text(value: Any) -> str | None:
    if isinstance(value, str):
        return value
    if isinstance(value, (bytes, bytearray, memoryview)):
        return bytes(value).hex()
    if isinstance(value, (dict, list, tuple, set, frozenset, np.ndarray)):
        return json.dumps(value, default=_for_json, ensure_ascii=False)
    if isinstance(value, (datetime, date, clock_time, pd.Timedelta)):
        return str(value.isoformat())
    return str(value)


def _for_json(value: Any) -> Any:
    if isinstance(value, (set, frozenset)):
        return sorted(value, key=str)
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    return _as_text(value)


def _fit_times(column: Any, kind: str, where: str) -> Any:
    if kind == "ESRI Shapefile":
        return column.map(_as_text, na_action="ignore")
    fine = column.dt.floor("ms")
    if kind != "Parquet" and (fine != column)[column.notna()].any():
        warn(f"{where}: times are kept to the millisecond only")
    return column


def _fit_integers(column: Any, kind: str, where: str) -> Any:
    """Keep whole numbers exact: what a dBase field cannot hold becomes text, what nothing can hold is refused."""
    held = column.dropna()
    low, high = (int(held.min()), int(held.max())) if len(held) else (0, 0)
    if kind == "ESRI Shapefile" and (high >= 10**18 or low <= -(10**17)):
        warn(f"{where}: numbers of more than 18 digits are written as text")
        return column.map(str, na_action="ignore").astype(object)
    if kind != "Parquet" and high >= 2**63:
        raise OutputError(f"{where}: {high} is too long a number for {kind}; make it text")
    return column


def _check_text(column: Any, kind: str, where: str) -> None:
    if pd.api.types.infer_dtype(column, skipna=True) in {"date", "datetime", "empty"}:
        return
    try:
        text = pa.array(column, type=pa.large_string(), from_pandas=True)
    except UnicodeEncodeError:
        row = next(n for n, value in enumerate(column) if isinstance(value, str) and not _encodable(value))
        raise OutputError(
            f"{where}, row {row}: text with half a character in it (a lone surrogate) cannot be written"
        ) from None
    nul = pc.index(pc.match_substring(text, "\0"), True).as_py()
    if nul >= 0:
        raise OutputError(f"{where}, row {nul}: text with a NUL character would be cut there; remove it")
    if kind == "ESRI Shapefile" and len(text):
        sizes = pc.binary_length(text)
        if (pc.max(sizes).as_py() or 0) > _SHAPEFILE_TEXT_BYTES:
            row = pc.index(pc.greater(sizes, _SHAPEFILE_TEXT_BYTES), True).as_py()
            raise OutputError(
                f"{where}, row {row}: Shapefile cuts text at {_SHAPEFILE_TEXT_BYTES} bytes; use GeoPackage"
            )
