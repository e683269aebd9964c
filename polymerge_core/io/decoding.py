"""One layer of an opened file as a table, with exact values, a plain index and its CRS."""

from __future__ import annotations

import contextlib
import re
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pyogrio
import shapely

from polymerge_core.crs import LOCAL_CRS, is_local
from polymerge_core.errors import CrsError, InputError
from polymerge_core.io.drivers import DRIVER_ERRORS, EXACT_TYPES, is_news, warn
from polymerge_core.io.sources import Source

_COLLECTION = 7  # shapely's type id; curves have higher ones


class LayerInfo(NamedTuple):
    """What a file says about one of its layers.

    Parameters
    ----------
    name : str
        The layer.
    geometry_type : str or None
        ``LineString``, ``Polygon`` and so on; ``Unknown`` where it holds any; None for a table.
    fields : tuple of str
        Its columns.
    features : int
        How many features it says it has; -1 where it does not say.
    encoding : str
        Of its text.
    id_column : str
        The column that feature ids come from, where they come from one; only GeoJSON has it among its fields too.
    """

    name: str
    geometry_type: str | None
    fields: tuple[str, ...] = ()
    features: int = -1
    encoding: str = "UTF-8"
    id_column: str = ""

    @property
    def is_points(self) -> bool:
        """Whether the layer is declared to hold points."""
        return self.geometry_type is not None and "point" in self.geometry_type.lower()


def known_layers(source: Source) -> list[LayerInfo]:
    """List the layers of an opened file, tables included."""
    with _gdal_speaks_of(source.file, None):
        if source.kind == "Parquet":
            schema = pq.read_schema(source.readable)
            return [LayerInfo(source.file.stem, "Unknown", tuple(schema.names))]
        path = source.gdal_path
        names = [name for name, _ in pyogrio.list_layers(path)] if source.kind == "GPKG" else [None]
        infos = [pyogrio.read_info(path, layer=name) for name in names]
        layers = [
            LayerInfo(
                info["layer_name"],
                info["geometry_type"],
                tuple(info["fields"]),
                info["features"],
                info["encoding"] or "UTF-8",
                info["fid_column"] or "",
            )
            for info in infos
        ]
    if not layers:
        raise InputError(f"{source.file} holds no layers")
    return layers


def read_layer(source: Source, layer: LayerInfo) -> gpd.GeoDataFrame:
    """Read a layer; the index is the feature id."""
    with _gdal_speaks_of(source.file, layer.name):
        if source.kind == "Parquet":
            frame = _read_parquet(source)
        else:
            frame = _read_gdal(source, layer)
            if len(frame) < layer.features:
                raise InputError(
                    f"{source.file}: layer {layer.name} is cut short ({len(frame)} of {layer.features} features are "
                    "there); copy the file again"
                )
        return _declare_crs(_plain_types(frame), source.file)


def read_columns(source: Source, layer: LayerInfo) -> Any:
    """Read a layer or table without its geometry."""
    with _gdal_speaks_of(source.file, layer.name):
        if source.kind == "Parquet":
            frame = _read_parquet(source)
            return pd.DataFrame(_plain_types(frame.drop(columns=frame.geometry.name)))
        return _plain_types(_read_arrow(source, layer, read_geometry=False))


def _read_gdal(source: Source, layer: LayerInfo) -> gpd.GeoDataFrame:
    # GDAL's Arrow reader crashes on a FlatGeobuf feature without geometry, and takes no curves, which the
    # other reader turns into lines; and an attribute called geometry would be lost.
    if source.kind != "FlatGeobuf" and "geometry" not in layer.fields:
        with contextlib.suppress(NotImplementedError):  # there are curves
            return _without_curves(_read_arrow(source, layer, on_invalid="warn"))
    geometry = pyogrio.read_dataframe(
        source.gdal_path, layer=layer.name, use_arrow=False, columns=[], fid_as_index=True, on_invalid="warn"
    )
    columns = _read_arrow(source, layer, read_geometry=False)
    columns = columns.rename(columns={"geometry": _free_name("geometry", layer.fields)})
    columns["geometry"] = geometry.geometry
    return _without_curves(gpd.GeoDataFrame(columns, geometry="geometry", crs=geometry.crs))


def _read_arrow(source: Source, layer: LayerInfo, **options: Any) -> Any:
    if source.kind == "ESRI Shapefile" and layer.encoding != "UTF-8":
        options["ENCODING"] = layer.encoding  # Arrow takes UTF-8 only, so GDAL has to convert
    exact = {"types_mapper": EXACT_TYPES.get}
    twice = layer.id_column if layer.id_column in layer.fields else ""
    if twice:  # Arrow would deliver it as a column and as the index, under one name
        options["columns"] = [name for name in layer.fields if name != twice]
    frame = pyogrio.read_dataframe(
        source.gdal_path, layer=layer.name, use_arrow=True, fid_as_index=True, arrow_to_pandas_kwargs=exact, **options
    )
    if twice:
        column = pyogrio.read_dataframe(
            source.gdal_path, layer=layer.name, columns=[twice], read_geometry=False, fid_as_index=True
        )
        frame.insert(layer.fields.index(twice), twice, column[twice])
    return frame


def _read_parquet(source: Source) -> gpd.GeoDataFrame:
    if b"geo" not in (pq.read_schema(source.readable).metadata or {}):
        raise InputError(f"{source.file} is a Parquet file without geometry (GeoParquet names it in its metadata)")
    frame = gpd.read_parquet(source.readable, to_pandas_kwargs={"types_mapper": EXACT_TYPES.get})
    frame = frame.reset_index(drop=all(name is None for name in frame.index.names))
    if frame.geometry.name != "geometry":
        taken = {"geometry": _free_name("geometry", frame.columns)} if "geometry" in frame else {}
        frame = frame.rename(columns=taken).rename_geometry("geometry")
    frame.index.name = "fid"
    return frame


def _free_name(name: str, taken: Iterable[Any]) -> str:
    used = {str(each).casefold() for each in taken}
    return next(free for free in (f"{name}_{n}" for n in range(1, len(used) + 2)) if free.casefold() not in used)


def _plain_types(frame: Any) -> Any:
    """Use numpy's integers and booleans where there are no gaps; find text that is not UTF-8 now, not later."""
    for position, (name, dtype) in enumerate(frame.dtypes.items()):
        column = frame.iloc[:, position]
        if dtype in EXACT_TYPES.values() and not column.hasnans:
            frame[name] = column.astype(dtype.numpy_dtype)
        elif isinstance(dtype, pd.StringDtype):
            pa.chunked_array(pa.array(column)).validate(full=True)
    return frame


def _without_curves(frame: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Set geometries that hold curves inside a collection to None: nothing here can turn those into lines."""
    geometry = frame.geometry.to_numpy()
    collections = np.flatnonzero(shapely.get_type_id(geometry) >= _COLLECTION)
    curved = [row for row in collections if re.search("CURVE|CIRCULAR|SURFACE", shapely.to_wkt(geometry[row]))]
    if curved:
        warnings.warn(f"{len(curved)} geometries hold curves inside a collection and are not read", stacklevel=2)
        frame = frame.copy()
        frame.iloc[curved, frame.columns.get_loc(frame.geometry.name)] = None
    return frame


def _declare_crs(frame: gpd.GeoDataFrame, file: Path) -> gpd.GeoDataFrame:
    crs = frame.crs
    if crs is None:
        return frame
    if crs.name.startswith("Undefined geographic"):  # a GeoPackage's word for no CRS
        return frame.set_crs(None, allow_override=True)
    if not is_local(crs):
        return frame
    if any(axis.unit_conversion_factor != 1 for axis in crs.axis_info):
        unit = crs.axis_info[0].unit_name
        raise CrsError(f"{file}: its plain coordinates are in {unit}; PolyMerge takes plain coordinates in metres only")
    return frame.set_crs(LOCAL_CRS, allow_override=True)


@contextlib.contextmanager
def _gdal_speaks_of(file: Path, layer: str | None) -> Iterator[None]:
    """Turn what GDAL, Arrow and GEOS say into this module's errors and warnings, with the file's name."""
    where = f"{file}" if layer is None else f"{file}: layer {layer}"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            yield
        except (InputError, CrsError):
            raise
        except DRIVER_ERRORS as error:
            what = " ".join(str(error).split()).split(";")[0]
            raise InputError(f"{where} cannot be read, it is damaged or not complete ({what})") from error
    said: dict[str, int] = {}
    for warning in caught:
        if is_news(warning.category):
            said[str(warning.message)] = said.get(str(warning.message), 0) + 1
    for text in said:
        # numpy's remark on a NaN coordinate: the feature is left out later, with that reason.
        if "non conformant file extension" not in text and "invalid value encountered" not in text:
            warn(text if text.startswith(str(file)) else f"{where}: {' '.join(text.split())}")
