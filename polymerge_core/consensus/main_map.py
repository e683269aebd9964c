"""A main map in the terms of the consensus: what was known before the new local maps looked.

A map tells less than a `State` does: of each element how many observations and local maps are behind it, once for the
whole of its length. What is known of each of its places is estimated from that.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
import shapely

from polymerge_core.consensus.fusion import FIRST_NOISE, SHARED
from polymerge_core.consensus.looks import PAST
from polymerge_core.consensus.support import SURE
from polymerge_core.curves import Array, Index, distinct
from polymerge_core.observations import as_lines

#: So many observations are enough to tell how often a drive sees a place.
_COUNTED = 1000


def remembered(table: pd.DataFrame, instance: Index, drive: Index, unit: float) -> Array:
    """Return what is known of the main map's elements: what `PAST` names, the same all along each; NaN of observations.

    Parameters
    ----------
    table : DataFrame
        The observations, main map first.
    instance : ndarray of int, shape (n,)
        The local map of each observation.
    drive : ndarray of int, shape (k,)
        The drive of each local map.
    unit : float
        The proximity, metres.

    Returns
    -------
    ndarray of float, shape (n, 5)
        An element that does not say how many local maps saw it stands for three: whoever made the map was sure of it.
    """
    main = table["is_main"].to_numpy(dtype=bool)
    past = np.full((len(table), len(PAST)), np.nan)
    if not main.any():
        return past
    share = _seen_at_once(table)[main]
    old = table[main]
    looks = np.maximum(old["weight"].to_numpy(dtype=float) * share, 1.0) * old["score"].to_numpy(dtype=float)
    knowledge = looks / ((FIRST_NOISE**2 + SHARED**2) * unit**2)
    counted = old["looks"].to_numpy(dtype=float) * share
    seen = np.where(counted > 0, np.maximum(counted, 1.0), SURE)
    # One number for the whole map: elements that counted for different numbers of drives would be shifted differently.
    drives = np.full(len(old), float(SURE))
    if (counted > 0).any():
        looks_of_a_drive = _looks_of_a_drive(table[~main], instance[~main], drive, unit)
        drives[:] = max(1.0, float(np.median(counted[counted > 0])) / looks_of_a_drive)
    past[main] = np.column_stack([knowledge, seen, seen, drives, drives])
    return past


def _seen_at_once(table: pd.DataFrame) -> Array:
    """Return how much of each element a local map sees of it: of a line as much as is new of its class, in the mean."""
    new = table["length_m"].where(~table["is_main"])
    usual = new.groupby(table["class"]).transform("mean").fillna(np.inf)
    share = (usual / table["length_m"]).clip(upper=1.0)
    return np.asarray(share.where(~table["is_area"], 1.0), dtype=np.float64)


def _looks_of_a_drive(table: pd.DataFrame, instance: Index, drive: Index, unit: float) -> float:
    """Return how many local maps of one drive see a place that any of them sees, in the mean over places."""
    if table.empty:
        return 1.0
    shapes = table["shape"].to_numpy(dtype=object)
    chosen = np.linspace(0, len(table) - 1, min(_COUNTED, len(table))).astype(np.intp)
    middles = shapely.line_interpolate_point(as_lines(shapes[chosen]), 0.5, normalized=True)
    place, near = shapely.STRtree(shapes).query(middles, predicate="dwithin", distance=unit)
    here, there = instance[chosen[place]], instance[near]
    own = drive[here] == drive[there]
    pairs = distinct(place[own] * len(drive) + there[own])
    # A place that more of them saw has more observations: in the harmonic mean it counts once all the same.
    return float(len(chosen) / (1.0 / np.bincount(pairs // len(drive))).sum())
