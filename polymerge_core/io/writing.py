"""Writing layers and tables, all of them or none, byte for byte the same for the same layers."""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import shapely

from polymerge_core.crs import is_local
from polymerge_core.errors import InputError, OutputError
from polymerge_core.io.drivers import DRIVER_ERRORS, FORMATS, is_news, warn
from polymerge_core.io.fields import fit
from polymerge_core.io.local_maps import is_merged_map, source_files
from polymerge_core.io.naming import companion_path, holds_one_layer, layer_targets
from polymerge_core.io.verifying import verify
from polymerge_core.outputs import StagedOutputs, write_error
from polymerge_core.schema import AREAS_LAYER, ELEMENTS_LAYER

_ROOM_BYTES = 256 * 1024


class Written(NamedTuple):
    """What was written where.

    Parameters
    ----------
    paths : list of Path
        The files, in the order in which they were written.
    renamed : dict
        For each layer whose columns had to be renamed for the format: old name to new name.
    """

    paths: list[Path]
    renamed: dict[str, dict[str, str]]


def write_layers(
    path: str | os.PathLike[str],
    layers: Mapping[str, gpd.GeoDataFrame | pd.DataFrame],
    *,
    overwrite: bool = False,
    inputs: Iterable[str | os.PathLike[str]] = (),
    tables_path: str | os.PathLike[str] | None = None,
    geometry_types: Mapping[str, str] | None = None,
) -> Written:
    """Write layers and tables, all of them or none.

    Parameters
    ----------
    path : path
        The output; its extension (.gpkg, .shp, .geojson, .fgb, .parquet) says the format. A GeoPackage takes
        everything. Of the others, which hold one layer, the main layer (``elements``, else the first) goes to
        `path`, ``elements_areas`` to ``<stem>_areas.<ext>``, another one to ``<stem>_<layer>.<ext>``, and the
        tables to the GeoPackage ``<stem>_tables.gpkg``.
    layers : mapping of str to GeoDataFrame or DataFrame
        By layer name. The index is not written.
    overwrite : bool, default False
        Whether existing files are replaced, as a whole: other layers of an old GeoPackage go with it, and
        areas of an older map in ``<stem>_areas.<ext>`` make way for an empty layer where the new map has none.
    inputs : iterable of path, optional
        Files that must not be written to.
    tables_path : path, optional
        Another GeoPackage for the tables.
    geometry_types : mapping of str to str, optional
        The type of a layer that may be empty; ``LineString`` by default, ``Polygon`` of ``elements_areas``.

    Returns
    -------
    Written
        The files, and the columns that had to be renamed.

    Raises
    ------
    OutputError
        If a file cannot be written, or the format cannot hold what a layer holds. Nothing has changed then.

    Notes
    -----
    Columns whose names differ in case only, or are ``fid``, ``geom`` or ``geometry``, are renamed. Lists and
    dictionaries become JSON text, bytes hexadecimal text, dates with a time ISO text where the format
    (Shapefile) has none; FlatGeobuf has no dates, so they become midnight. GDAL's formats keep times to the
    millisecond.
    """
    with StagedOutputs(overwrite=overwrite, inputs=chain.from_iterable(map(source_files, inputs))) as outputs:
        return stage_layers(outputs, path, layers, tables_path=tables_path, geometry_types=geometry_types)


def stage_layers(
    outputs: StagedOutputs,
    path: str | os.PathLike[str],
    layers: Mapping[str, gpd.GeoDataFrame | pd.DataFrame],
    *,
    tables_path: str | os.PathLike[str] | None = None,
    geometry_types: Mapping[str, str] | None = None,
) -> Written:
    """Write layers among other outputs that are to appear with them.

    Parameters
    ----------
    outputs : StagedOutputs
        The open outputs of the run.
    path, layers, tables_path, geometry_types
        As in `write_layers`.

    Returns
    -------
    Written
        As for `write_layers`; the files are there when `outputs` closes.

    Raises
    ------
    OutputError
        As for `write_layers`.
    """
    layers = _emptying_old_areas(path, layers)
    targets = layer_targets(path, layers, tables_path=tables_path)
    types = {AREAS_LAYER: "Polygon"} | dict(geometry_types or {})
    staged: dict[Path, Path] = {}
    renamed: dict[str, dict[str, str]] = {}
    with _repeatable_gdal():
        for name, frame in layers.items():
            target = targets[name]
            kind = FORMATS[target.suffix.lower()]
            fitted, renames = fit(frame, kind, f"{target}: layer {name}")
            if renames:
                renamed[name] = renames
            first = target not in staged
            if first:
                staged[target] = outputs.stage(target)
            _write_one(
                fitted,
                staged[target],
                target,
                kind,
                name,
                types.get(name, "LineString"),
                first=first,
            )
    for target, temporary in staged.items():
        here = {name: frame for name, frame in layers.items() if targets[name] == target}
        verify(temporary, target, here)
    return Written(list(staged), renamed)


def _emptying_old_areas(
    path: str | os.PathLike[str], layers: Mapping[str, gpd.GeoDataFrame | pd.DataFrame]
) -> Mapping[str, gpd.GeoDataFrame | pd.DataFrame]:
    """Add an empty layer of areas where an older map's areas would be taken for those of this map."""
    elements = layers.get(ELEMENTS_LAYER)
    areas = companion_path(Path(path), AREAS_LAYER, ELEMENTS_LAYER)
    if AREAS_LAYER in layers or elements is None or "element_id" not in elements or not holds_one_layer(areas):
        return layers
    try:
        old = is_merged_map(areas)
    except InputError as error:
        raise OutputError(
            f"{areas} cannot be told from areas that belong to {path}; remove it, or name another output ({error})"
        ) from error
    return {**layers, AREAS_LAYER: elements.iloc[:0]} if old else layers


@contextlib.contextmanager
def _repeatable_gdal() -> Iterator[None]:
    """Let GDAL write a fixed time instead of today's, so that equal layers give equal files."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    moment = time.gmtime(int(epoch) if epoch.isdecimal() else 946_684_800)  # 2000-01-01
    before = pyogrio.get_gdal_config_option("OGR_CURRENT_DATE")
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": time.strftime("%Y-%m-%dT%H:%M:%S.000Z", moment)})
    try:
        yield
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": before})


def _write_one(
    frame: Any, temporary: Path, target: Path, kind: str, name: str, empty_type: str, *, first: bool
) -> None:
    if any(mark in str(temporary) for mark in "!;") and kind != "Parquet":
        raise OutputError(f"{target}: a path with ! or ; in it cannot be written; name another output")
    spatial = isinstance(frame, gpd.GeoDataFrame)
    geometry_type = None
    if spatial:
        frame, geometry_type = _one_type(frame, kind, empty_type, f"{target}: layer {name}")
    options: dict[str, Any] = {"layer": name, "driver": kind, "use_arrow": True, "promote_to_multi": False}
    options |= {"geometry_type": geometry_type, **_driver_options(kind, first=first, spatial=spatial)}
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            if kind == "Parquet":
                frame.to_parquet(temporary, index=False)
            else:
                pyogrio.write_dataframe(frame, temporary, **options)
    except (*DRIVER_ERRORS, TypeError, OverflowError) as error:
        said = _no_room(temporary.parent) or error
        if isinstance(said, pyogrio.errors.DataSourceError | pyogrio.errors.DataLayerError):
            said = OutputError(f"{said}; the disk may be full")
        raise write_error(said, target) from error
    texts = {str(each.message) for each in caught if is_news(each.category)}
    for text in sorted(text for text in texts if "'crs' was not provided" not in text):
        warn(f"{target}: layer {name}: {' '.join(text.split())}")


def _no_room(folder: Path) -> OSError | None:
    """Find out whether a write failed for want of room, of which drivers speak in many ways or not at all."""
    largest = max((path.stat().st_size for path in folder.iterdir() if path.is_file()), default=0)
    try:
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(bytes(_ROOM_BYTES))
            probe.flush()
            probe.truncate(largest + _ROOM_BYTES)
    except OSError as error:
        return error
    return None


def _driver_options(kind: str, *, first: bool, spatial: bool) -> dict[str, Any]:
    if kind == "ESRI Shapefile":
        # dBase has a date of its own, which does not follow GDAL's.
        day = pyogrio.get_gdal_config_option("OGR_CURRENT_DATE")[:10]
        return {"layer_options": {"DBF_DATE_LAST_UPDATE": day, "ENCODING": "UTF-8", "2GB_LIMIT": "YES"}}
    if kind == "GPKG":
        options: dict[str, Any] = {"dataset_options": {"VERSION": "1.3"}} if first else {}
        if spatial:
            options["layer_options"] = {"GEOMETRY_NAME": "geom", "FID": "fid"}
        return options
    return {}


def _one_type(frame: gpd.GeoDataFrame, kind: str, empty_type: str, where: str) -> tuple[gpd.GeoDataFrame, str]:
    """Bring the geometries to one type, and the CRS to one that the format can say."""
    if kind == "GeoJSON" and (frame.crs is None or is_local(frame.crs) or frame.crs.to_authority() is None):
        said = "plain coordinates" if frame.crs is None or is_local(frame.crs) else f"the CRS {frame.crs.name}"
        raise OutputError(f"{where}: GeoJSON cannot say that it has {said}; use GeoPackage, or another output CRS")
    geometry = frame.geometry.to_numpy()
    if kind == "FlatGeobuf" and shapely.is_missing(geometry).any():
        raise OutputError(f"{where}: FlatGeobuf cannot hold a feature without geometry; use GeoPackage")
    if getattr(shapely, "has_m", shapely.is_missing)(geometry[~shapely.is_missing(geometry)]).any():
        warn(f"{where}: M values are not written")
        # force_3d would set the heights of ZM geometries to 0.
        flat = shapely.force_2d(geometry)
        high = shapely.from_wkb(shapely.to_wkb(geometry, output_dimension=3, flavor="iso"))
        geometry = np.where(shapely.has_z(geometry), high, flat)
    there = geometry[~(shapely.is_missing(geometry) | shapely.is_empty(geometry))]
    types = {str(name).replace("LinearRing", "LineString") for name in gpd.GeoSeries(there).geom_type}
    singles = {name.removeprefix("Multi") for name in types}
    if len(types) > 1 and len(singles) == 1:
        geometry, types = _as_multi(geometry), {f"Multi{next(iter(singles))}"}
    has_z = shapely.has_z(there)
    if kind in {"FlatGeobuf", "ESRI Shapefile"}:
        if len(types) > 1:
            raise OutputError(f"{where} mixes {' and '.join(sorted(types))}; use GeoPackage, or write one kind a layer")
        if has_z.any() and not has_z.all():
            raise OutputError(f"{where} mixes features with and without heights; use GeoPackage, which can hold both")
    kept = "Unknown" if len(types) > 1 else next(iter(types), empty_type)
    if kept != "Unknown" and has_z.any():
        kept += " Z"
    return frame.set_geometry(gpd.GeoSeries(geometry, index=frame.index, crs=frame.crs)), kept


def _as_multi(geometry: Any) -> Any:
    multi = geometry.copy()
    makers = {1: shapely.multilinestrings, 2: shapely.multilinestrings, 3: shapely.multipolygons}
    types = shapely.get_type_id(geometry)
    for type_id, make in makers.items():
        rows = np.flatnonzero(types == type_id)
        if len(rows):
            multi[rows] = make(geometry[rows], indices=np.arange(len(rows)))
    return multi
