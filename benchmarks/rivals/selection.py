"""Rivals that choose among the observations and change none: all of them, or those that no better one suppresses."""

from __future__ import annotations

from collections.abc import Callable

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from benchmarks.rivals.layers import PROXIMITY_M, Shapes

Pairs = NDArray[np.intp]
Near = Callable[[Shapes], tuple[Pairs, Pairs]]

#: Map NMS of GlobalMapNet purges what comes within its buffer of this radius.
MAP_NMS_BUFFER_M = 0.5
_STEP_M = 0.5


def concatenate(observations: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Return all observations as they are."""
    return observations[["class", "score", "geometry"]].reset_index(drop=True)


def keep_best_score(observations: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Suppress, by falling score, what has a Chamfer distance below 1 m to an observation that was kept.

    This is non-maximum suppression with the distance by which MapTR and its kin match predictions to the truth.
    """
    return _suppressed(observations, observations["score"], pairs_by_chamfer)


def keep_longest(observations: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Suppress, by falling length, what comes within 0.5 m of an observation that was kept.

    References
    ----------
    Shi et al., "GlobalMapNet", Map NMS, with the defaults of its program: the longest first, a buffer of 0.5 m, and
    whatever touches that buffer is purged.
    """
    return _suppressed(observations, observations.length, pairs_within)


def _suppressed(observations: gpd.GeoDataFrame, rank: pd.Series, near: Near) -> gpd.GeoDataFrame:
    kept = []
    for _, rows in sorted(observations.groupby("class", sort=True).indices.items()):
        shapes = observations.geometry.to_numpy()[rows]
        kept.append(rows[survivors(rank.to_numpy(float)[rows], *near(shapes))])
    chosen = np.sort(np.concatenate(kept)) if kept else np.empty(0, np.intp)
    return concatenate(observations.iloc[chosen])


def survivors(rank: NDArray[np.float64], first: Pairs, second: Pairs) -> NDArray[np.bool_]:
    """Tell who is kept when each of falling rank that is kept suppresses whom it is paired with.

    Parameters
    ----------
    rank : ndarray of float, shape (n,)
        The higher the earlier; of equal ones the first comes first.
    first, second : ndarray of int, shape (m,)
        Pairs, each in both orders.

    Examples
    --------
    >>> survivors(np.array([0.5, 0.9, 0.7]), np.array([0, 1, 0, 2]), np.array([1, 0, 2, 0])).tolist()
    [False, True, True]
    """
    left = np.ones(len(rank), dtype=bool)
    for row in np.argsort(-rank, kind="stable"):
        if left[row]:
            others = second[first == row]
            left[others[others != row]] = False
    return left


def pairs_within(shapes: Shapes) -> tuple[Pairs, Pairs]:
    """Return the pairs of lines that come within the buffer of each other anywhere."""
    first, second = shapely.STRtree(shapes).query(shapes, predicate="dwithin", distance=MAP_NMS_BUFFER_M)
    return first, second


def pairs_by_chamfer(shapes: Shapes) -> tuple[Pairs, Pairs]:
    """Return the pairs of lines whose Chamfer distance is below the proximity."""
    first, second = shapely.STRtree(shapes).query(shapes, predicate="dwithin", distance=PROXIMITY_M)
    points = [_points_along(shape) for shape in shapes]
    there = np.array([_mean_distance(points[a], shapes[b]) for a, b in zip(first, second, strict=True)])
    back = np.array([_mean_distance(points[b], shapes[a]) for a, b in zip(first, second, strict=True)])
    close = (there + back) / 2 < PROXIMITY_M
    return first[close], second[close]


def _points_along(shape: shapely.Geometry) -> Shapes:
    count = max(2, int(np.ceil(shape.length / _STEP_M)) + 1)
    return np.asarray(shapely.line_interpolate_point(shape, np.linspace(0.0, 1.0, count), normalized=True))


def _mean_distance(points: Shapes, shape: shapely.Geometry) -> float:
    return float(shapely.distance(points, shape).mean())
