"""The local maps of a merge, and the main map beside them: who looked where."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
import pyproj
import shapely

from polymerge_core.columns import as_text
from polymerge_core.consensus.alongside import REACH
from polymerge_core.consensus.looks import Instances
from polymerge_core.crs import parse_crs, transform_coordinates
from polymerge_core.curves import Array, Index
from polymerge_core.errors import SchemaError
from polymerge_core.observations import Observations
from polymerge_core.schema import LocalMaps

_NAMES = ["drive", "instance"]


def read_instances(observations: Observations, local_maps: Sequence[LocalMaps], unit: float) -> tuple[Instances, Index]:
    """Bring the local maps of a merge together: those of the observations, those that saw nothing, the main map.

    Parameters
    ----------
    observations : Observations
        All of them.
    local_maps : sequence of LocalMaps
        Their layers, with `instances` where these are known; without the main map.
    unit : float
        The proximity, metres.

    Returns
    -------
    instances : Instances
        Footprints are known where they are of all local maps. The main map is what was known before.
    instance : ndarray of int
        The local map of each observation.

    Raises
    ------
    SchemaError
        If it cannot be told which local map a footprint is of.
    """
    table = observations.table
    main = table["is_main"].to_numpy(dtype=bool)
    layer_crs = observations.layer_crs[len(observations.layer_crs) - len(local_maps) :]
    known = [known_instances(maps, crs, observations.crs) for maps, crs in zip(local_maps, layer_crs, strict=True)]
    instances, codes = _together(table[~main], known)
    if not main.any():
        return instances, codes
    # A map covers the place that it is of: who looks there and sees what it does not show, sees something else.
    bounds = shapely.total_bounds(table["shape"].to_numpy(dtype=object)[main])
    instances = instances.with_known(shapely.buffer(shapely.box(*bounds), REACH * unit, join_style="mitre"))
    instance = np.full(len(table), instances.known)
    instance[~main] = codes
    return instances, instance


def _together(table: pd.DataFrame, known: list[pd.DataFrame]) -> tuple[Instances, Index]:
    """Return the local maps that observations are of, then those that saw nothing, and the one of each observation."""
    codes, groups = pd.factorize(table["group"])
    firsts = table.drop_duplicates("group").set_index("group").loc[groups]
    names = firsts[_NAMES].astype(str).reset_index(drop=True)
    found = pd.concat([names.iloc[:0], *known], ignore_index=True).drop_duplicates(_NAMES)
    every = pd.concat([names, found[_NAMES]], ignore_index=True)
    # Local maps that have observations come first, also where several go by one name.
    every = every[~(every.duplicated() & (np.arange(len(every)) >= len(names)))]
    rows = pd.MultiIndex.from_frame(found[_NAMES]).get_indexer(pd.MultiIndex.from_frame(every))
    position, heading, footprint = np.full((len(every), 2), np.nan), np.full(len(every), np.nan), None
    there = rows >= 0
    if there.any():
        position[there] = found[["x", "y"]].to_numpy(dtype=float)[rows[there]]
        heading[there] = found["heading"].to_numpy(dtype=float)[rows[there]]
    if there.all() and len(every):
        footprint = found["footprint"].to_numpy(dtype=object)[rows]
        shapely.prepare(footprint)
    return Instances(pd.factorize(every["drive"])[0], footprint, position, heading), codes


def known_instances(maps: LocalMaps, layer_crs: pyproj.CRS, crs: pyproj.CRS) -> pd.DataFrame:
    """Return what is known of the local maps of a source, where it is known what they looked at.

    Parameters
    ----------
    maps : LocalMaps
        The source.
    layer_crs, crs : pyproj.CRS
        Of its layer, and that to return coordinates in.

    Returns
    -------
    DataFrame
        `drive`, `instance`, `timestamp_ns` (NaN where unknown), `x`, `y`, `heading` (radians counter-clockwise from x)
        and `footprint`.

    Raises
    ------
    SchemaError
        If it cannot be told which local map a footprint is of.
    """
    columns = [*_NAMES, "timestamp_ns", "x", "y", "heading", "footprint"]
    frame = maps.instances
    if frame is None:
        return pd.DataFrame(columns=columns)
    missing = [name for name in _NAMES if name not in frame]
    if missing:
        raise SchemaError(
            f"layer {maps.source!r}: its instances have no column {missing[0]!r}, so that nobody can tell whose "
            "footprints they are; add the columns drive and instance, or leave the instances away"
        )
    # Where it is not known what a local map looked at, nothing is known of it.
    frame = frame[~(frame.geometry.isna() | frame.geometry.is_empty)]
    places = np.column_stack([_numbers(frame, "x"), _numbers(frame, "y")])
    areas = shapely.force_2d(frame.geometry.to_numpy())
    areas = np.where(shapely.is_valid(areas), areas, shapely.make_valid(areas))
    source = layer_crs if frame.crs is None else parse_crs(frame.crs)
    if source != crs:
        placed = np.isfinite(places).all(axis=1)
        places[placed] = transform_coordinates(places[placed], source, crs)
        areas = shapely.transform(areas, lambda xy: transform_coordinates(xy, source, crs))
    heading = np.radians(90.0 - _numbers(frame, "heading"))
    named = {name: as_text(frame[name]).astype(str).to_numpy() for name in _NAMES}
    time = frame["timestamp_ns"].to_numpy(dtype=object) if "timestamp_ns" in frame else None
    told = {"timestamp_ns": time, "x": places[:, 0], "y": places[:, 1], "heading": heading, "footprint": areas}
    return pd.DataFrame({**named, **told})


def _numbers(frame: pd.DataFrame, name: str) -> Array:
    """Return a column as numbers, NaN where it says nothing or is not there."""
    if name not in frame:
        return np.full(len(frame), np.nan)
    return np.asarray(pd.to_numeric(frame[name], errors="coerce"), dtype=np.float64)
