"""Reading layers and tables of any file."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

from polymerge_core.errors import InputError
from polymerge_core.io.decoding import LayerInfo, known_layers, read_columns, read_layer
from polymerge_core.io.drivers import warn
from polymerge_core.io.sources import Source, opened, split_source


def read_layers(path: str | os.PathLike[str], *, layer: str | None = None) -> dict[str, gpd.GeoDataFrame]:
    """Read the line and polygon layers of a file.

    Parameters
    ----------
    path : path
        A file, or ``FILE|layername=LAYER`` as QGIS writes it. GeoPackage, ESRI Shapefile, GeoJSON, FlatGeobuf
        and GeoParquet are told apart by their content.
    layer : str, optional
        The one layer to read; all line and polygon layers by default. Layers of points are skipped with a
        `LayerWarning`, tables without geometry silently.

    Returns
    -------
    dict of str to GeoDataFrame
        By layer name, in the file's order. The index is the feature id and is called ``fid``. Integers with
        gaps come in pandas' nullable types, curves as lines. A geometry that cannot be decoded is None, with
        a `LayerWarning`. The CRS is the file's; None where it has none; `polymerge_core.crs.LOCAL_CRS` for
        plain metric coordinates.

    Raises
    ------
    InputError
        If the file is missing, remote, damaged, locked, of another format, has no such layer, or has layers
        of points only.
    CrsError
        If the file has plain coordinates in another unit than the metre.
    """
    file, named = split_source(path)
    with opened(file) as source:
        return read_chosen(source, choose_layers(source, known_layers(source), layer or named))


def read_table(path: str | os.PathLike[str], layer: str) -> pd.DataFrame:
    """Read one layer of a file without its geometry.

    Parameters
    ----------
    path : path
        The file.
    layer : str
        The layer or table.

    Returns
    -------
    DataFrame
        The attributes; the index is the feature id.

    Raises
    ------
    InputError
        As for `read_layers`.
    """
    file, _ = split_source(path)
    with opened(file) as source:
        known = {each.name: each for each in known_layers(source)}
        if layer not in known:
            raise InputError(_unknown_layer(file, layer, known))
        table: pd.DataFrame = read_columns(source, known[layer])
    return table


def list_layers(path: str | os.PathLike[str]) -> list[LayerInfo]:
    """List the layers of a file.

    Parameters
    ----------
    path : path
        The file.

    Returns
    -------
    list of LayerInfo
        In the file's order, tables included.

    Raises
    ------
    InputError
        If the file cannot be opened.
    """
    file, _ = split_source(path)
    with opened(file) as source:
        return known_layers(source)


def choose_layers(source: Source, known: Sequence[LayerInfo], wanted: str | None) -> list[LayerInfo]:
    """Choose the layer that is wanted, or all that hold lines or polygons."""
    file = source.file
    if wanted is not None:
        by_name = {each.name: each for each in known}
        if wanted not in by_name:
            raise InputError(_unknown_layer(file, wanted, by_name))
        if by_name[wanted].geometry_type is None:
            raise InputError(f"{file}: {wanted} is a table without geometry; name a layer of lines or polygons")
        if by_name[wanted].is_points:
            raise InputError(_points_message(file, wanted))
        return [by_name[wanted]]
    spatial = [each for each in known if each.geometry_type is not None]
    chosen = [each for each in spatial if not each.is_points]
    if not spatial:
        names = ", ".join(each.name for each in known)
        raise InputError(f"{file} holds no layer of lines or polygons, only tables ({names})")
    if not chosen:
        raise InputError(_points_message(file, spatial[0].name))
    for each in spatial:
        if each.is_points:
            warn(f"{_points_message(file, each.name)}; this layer is skipped")
    return chosen


def read_chosen(source: Source, chosen: Sequence[LayerInfo]) -> dict[str, gpd.GeoDataFrame]:
    """Read layers, and skip those that turn out to hold points only."""
    frames = {each.name: read_layer(source, each) for each in chosen}
    pointed = [name for name, frame in frames.items() if _all_points(frame)]
    if len(pointed) == len(frames):
        raise InputError(_points_message(source.file, pointed[0]))
    for name in pointed:
        warn(f"{_points_message(source.file, name)}; this layer is skipped")
        del frames[name]
    return frames


def _unknown_layer(file: Path, wanted: str, known: Iterable[str]) -> str:
    return f"{file} has no layer {wanted}; its layers are {', '.join(known)}"


def _points_message(file: Path, name: str) -> str:
    return f"{file}: layer {name} holds points; PolyMerge merges lines and polygons"


def _all_points(frame: gpd.GeoDataFrame) -> bool:
    types = shapely.get_type_id(frame.geometry.to_numpy())
    types = types[types >= 0]
    return bool(len(types)) and bool(np.isin(types, [0, 4]).all())
