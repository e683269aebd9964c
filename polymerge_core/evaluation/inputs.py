"""The layers of an evaluation in metres: the merged map, the reference, and the local maps where they are given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from polymerge_core.crs import is_local
from polymerge_core.errors import CrsError, InputError, SchemaError
from polymerge_core.observations import Observations, as_lines, observe
from polymerge_core.options import Options
from polymerge_core.schema import LocalMaps, find_column
from polymerge_core.sets import Input, as_local_maps

_MERGED, _REFERENCE, _LOCAL = range(3)
_POLYGON = (shapely.GeometryType.POLYGON, shapely.GeometryType.MULTIPOLYGON)


@dataclass(frozen=True)
class Role:
    """The shapes of one map.

    Parameters
    ----------
    table : DataFrame
        One row a line or area, in canonical order: `class`, `is_area`, `as_polygon`, `score`, `shape` (metres), `id`
        (of its feature).
    """

    table: pd.DataFrame

    def of(self, name: str) -> pd.DataFrame:
        """Return the rows of one class."""
        return self.table[self.table["class"] == name]


@dataclass(frozen=True)
class Maps:
    """All maps of an evaluation in one metric CRS."""

    merged: Role
    reference: Role
    local: Role | None
    #: Footprints of the local maps, polygons; empty where none are known.
    footprints: NDArray[np.object_]
    #: The footprint of each row of the local maps, by its number there; -1 where it is not known.
    footprint: NDArray[np.intp]
    #: Polygons of the region; None where no layer names one.
    region: NDArray[np.object_] | None
    observed: Observations

    def classes(self) -> list[str]:
        """Return the classes of the merged map and of the reference."""
        return sorted({*self.merged.table["class"], *self.reference.table["class"]})


def read_maps(merged: Input, reference: Input, local_maps: Input | None, region: Any, options: Options) -> Maps:
    """Bring the maps into one metric CRS.

    Parameters
    ----------
    merged, reference, local_maps, region
        As in `polymerge_core.evaluate`.
    options : Options
        Columns, areas and CRS.

    Returns
    -------
    Maps
        The merged map first in the choice of the CRS.

    Raises
    ------
    SchemaError, CrsError, InputError
        If a layer cannot be used.
    """
    given = {
        _MERGED: as_local_maps(merged, "merged"),
        _REFERENCE: as_local_maps(reference, "reference"),
        _LOCAL: [] if local_maps is None else as_local_maps(local_maps, "local_maps"),
    }
    layers = [(role, maps) for role, several in given.items() for maps in several]
    plain = [_plain(maps, number, options) for number, (_, maps) in enumerate(layers)]
    _check_class_field(plain, options)
    observed = observe(plain, [], Options.of(**_understood(options)))
    table = observed.table
    table["id"] = _ids([maps for _, maps in layers], table)
    roles = np.array([role for role, _ in layers])[table["layer"].to_numpy()]
    merged_role, reference_role, local_role = (
        Role(table[roles == role].reset_index(drop=True)) for role in (_MERGED, _REFERENCE, _LOCAL)
    )
    if reference_role.table.empty:
        raise InputError("the reference holds no line or polygon to compare with; give the layer of the true map")
    without = [maps.source for (role, maps), each in zip(layers, plain, strict=True) if role != _LOCAL and _lacks(each)]
    _check_common_class(merged_role, reference_role, without)
    footprints, footprint = _footprints([maps for _, maps in layers], local_role.table, observed)
    areas = None if region is None else _region(region, observed)
    local = None if local_maps is None else local_role
    return Maps(merged_role, reference_role, local, footprints, footprint, areas, observed)


def lines_of(table: pd.DataFrame) -> NDArray[np.object_]:
    """Return the shapes as lines, areas by their outer ring."""
    return as_lines(table["shape"].to_numpy(dtype=object))


def _plain(maps: LocalMaps, number: int, options: Options) -> LocalMaps:
    """Return a layer with class and score alone: what else it has says nothing about where its lines are."""
    data, where = maps.observations, f"layer {maps.source!r}"
    if not isinstance(data, gpd.GeoDataFrame) or data.active_geometry_name is None:
        return maps
    names = [column for column in data.columns if column != data.active_geometry_name]
    own = _find(names, options.class_field, "class", where)
    score = _find(names, options.score_field, "score", where)
    # The number keeps two layers of one name apart: the same line in both is not a duplicate.
    columns: dict[str, Any] = {"drive": np.full(len(data), str(number), dtype=object)}
    columns |= {} if own is None else {"class": data[own].to_numpy()}
    columns |= {} if score is None else {"score": data[score].to_numpy()}
    geometry = data.geometry.to_numpy()
    return replace(
        maps, observations=gpd.GeoDataFrame(columns, geometry=geometry, crs=data.crs), instances=None, left_out=None
    )


def _find(names: Sequence[Any], chosen: str | None, default: str, where: str) -> str | None:
    """Return the column that was named, where the layer has it, else the contract's own."""
    named = None if chosen is None else find_column(names, chosen, named=False, where=where)
    return named or find_column(names, default, named=False, where=where)


def _lacks(maps: LocalMaps) -> bool:
    """Whether features have no class column."""
    return len(maps.observations) > 0 and "class" not in maps.observations


def _check_class_field(layers: Sequence[LocalMaps], options: Options) -> None:
    """Refuse a class column that the user named and a layer lacks."""
    without = [maps.source for maps in layers if _lacks(maps)]
    if options.class_field is None or not without:
        return
    raise SchemaError(
        f"layer {without[0]!r}: there is no column {options.class_field!r}, so its lines cannot be compared class by "
        "class; name the column of the class (class_field), or rename it to class"
    )


def _check_common_class(merged: Role, reference: Role, without: Sequence[str]) -> None:
    """Refuse a map and a reference that have no class in common only because a layer names none."""
    ours, true = set(merged.table["class"]), set(reference.table["class"])
    if not without or not ours or ours & true:
        return
    listed = [", ".join(map(repr, sorted(classes))) for classes in (ours, true)]
    raise SchemaError(
        f"layer {without[0]!r} has no class column, and of the map's classes ({listed[0]}) the reference "
        f"({listed[1]}) has none, so nothing can be compared; name the class that the layer is of (class_name), or the "
        "column of the class (class_field)"
    )


def _understood(options: Options) -> dict[str, Any]:
    return {
        "class_name": options.class_name,
        "instance_from": "feature",
        "area": tuple(options.area),
        "crs": options.crs,
    }


def _ids(layers: Sequence[LocalMaps], table: pd.DataFrame) -> pd.Series:
    """Return the element_id of each row's feature, else its feature id."""
    found = []
    for maps in layers:
        data = maps.observations
        held = data["element_id"] if "element_id" in data else data.index.to_series()
        found.append(held.to_numpy(dtype=object))
    first = np.cumsum([0, *map(len, found)])[table["layer"].to_numpy()]
    values = np.concatenate(found)[first + table["source_fid"].to_numpy()] if len(table) else np.empty(0, object)
    return pd.Series(values, index=table.index, dtype=object)


def _footprints(
    layers: Sequence[LocalMaps], local: pd.DataFrame, observed: Observations
) -> tuple[NDArray[np.object_], NDArray[np.intp]]:
    """Return all footprints of the local maps in metres, and the one of each row of the local maps."""
    known: list[NDArray[np.object_]] = []
    number = np.full(len(local), -1)
    count = 0
    for layer, maps in enumerate(layers):
        frame, data = maps.instances, maps.observations
        if frame is None or not (local["layer"] == layer).any():
            continue
        known.append(_in_metres(frame, observed, f"instances of {maps.source!r}"))
        rows = np.flatnonzero(local["layer"] == layer)
        if {"drive", "instance"} <= set(frame) & set(data):
            names = pd.MultiIndex.from_frame(frame[["drive", "instance"]].astype(str))
            wanted = data[["drive", "instance"]].astype(str).iloc[local["source_fid"].iloc[rows].to_numpy()]
            if names.is_unique:
                place = names.get_indexer(pd.MultiIndex.from_frame(wanted))
                number[rows] = np.where(place >= 0, place + count, -1)
        count += len(frame)
    return (np.concatenate(known) if known else np.empty(0, dtype=object)), number


def _region(region: Any, observed: Observations) -> NDArray[np.object_]:
    if not isinstance(region, (gpd.GeoDataFrame, gpd.GeoSeries)):
        raise SchemaError(f"region cannot be a {type(region).__name__}; give a GeoDataFrame of polygons")
    polygons = _in_metres(region, observed, "the region")
    if len(polygons) == 0 or not np.isin(shapely.get_type_id(polygons), _POLYGON).all():
        raise InputError("the region is not a layer of polygons; draw the area that counts as polygons")
    return polygons


def _in_metres(frame: gpd.GeoDataFrame | gpd.GeoSeries, observed: Observations, where: str) -> NDArray[np.object_]:
    geometry = frame.geometry[~(frame.geometry.isna() | frame.geometry.is_empty)]
    if frame.crs is None or is_local(frame.crs) or is_local(observed.crs):
        if not is_local(observed.crs) or (frame.crs is not None and not is_local(frame.crs)):
            raise CrsError(f"{where}: its CRS and that of the maps do not go together; give both a CRS, or none")
        return shapely.make_valid(geometry.to_numpy())
    return shapely.make_valid(geometry.to_crs(observed.crs).to_numpy())
