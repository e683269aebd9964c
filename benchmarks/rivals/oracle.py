"""What perfect association alone would give: the plain average of the observations of each true element.

The oracle is told which observations are of one true element, and nothing of where that element lies but which point
of it answers to which point of an observation: the true line serves to number places along it, and none of its
coordinates goes into the map. Where at least one observation is, the average of the points there is drawn, every
observation with the same weight; false detections are left out. Averages jump where an observation begins or ends.
"""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from benchmarks.rivals.layers import as_map
from polymerge_core.schema import AREA_CLASSES

Array = NDArray[np.float64]

STATION_M = 0.5
#: An observation is followed in steps of half a station, and may pass as many as two stations in a step.
_STEP_M, _MOVES = STATION_M / 2, 3


def average_true_groups(
    observations: gpd.GeoDataFrame, true_ids: pd.Series, truth: gpd.GeoDataFrame, whole: pd.Series
) -> gpd.GeoDataFrame:
    """Average the observations of each true element.

    Parameters
    ----------
    observations : GeoDataFrame
        `class`, `score` and LineStrings, metres.
    true_ids : Series
        The true element behind each observation, row by row; None for a false detection.
    truth : GeoDataFrame
        `element_id` and LineStrings, metres.
    whole : Series of bool
        Whether an observed area is all that there is of it, row by row.

    Returns
    -------
    GeoDataFrame
        `class`, `score` (the mean of the group) and the average: a line for each unbroken stretch that was seen.
    """
    lines = truth.set_index("element_id").geometry
    parts = [as_map("", [], [], observations.crs)]
    known = observations.assign(true_id=true_ids.to_numpy(), whole=whole.to_numpy()).dropna(subset="true_id")
    for (name, element), group in known.groupby(["class", "true_id"], sort=True):
        observed = [shapely.get_coordinates(shape) for shape in group.geometry]
        if name in AREA_CLASSES:
            shapes = [shapely.Polygon(average_rings(observed, group["whole"].to_numpy(bool)))]
        else:
            averages = average_lines(observed, shapely.get_coordinates(lines[element]))
            shapes = [shapely.LineString(line) for line in averages]
        parts.append(as_map(name, shapes, np.full(len(shapes), group["score"].mean()), observations.crs))
    return gpd.GeoDataFrame(pd.concat(parts, ignore_index=True), crs=observations.crs)


def average_lines(observed: list[Array], true: Array) -> list[Array]:
    """Average lines at equal places of the true line.

    Parameters
    ----------
    observed : list of ndarray of float, shape (n, 2)
        Observations of one true line, digitised either way; any stretch of it.
    true : ndarray of float, shape (m, 2)
        The true line; closed where its first and last vertex are equal.

    Returns
    -------
    list of ndarray of float, shape (k, 2)
        A line for each unbroken run of stations that some observation covers; closed where all of a ring are covered.
    """
    closed = bool(np.array_equal(true[0], true[-1]))
    stations = _evenly(true, STATION_M)
    stations = stations[:-1] if closed else stations
    # An observation may pass the start of a ring.
    unrolled = np.concatenate([stations, stations]) if closed else stations
    total, count = np.zeros_like(stations), np.zeros(len(stations))
    for line in observed:
        station, points = _points_at_stations(_evenly(line, _STEP_M), unrolled)
        np.add.at(total, station % len(stations), points)
        np.add.at(count, station % len(stations), 1.0)
    mean = total / np.maximum(count, 1.0)[:, None]
    return [mean[run] for run in _covered_runs(count > 0, closed=closed) if len(run) > 1]


def average_rings(rings: list[Array], whole: NDArray[np.bool_]) -> Array:
    """Average the corners of those areas that were seen whole and have the usual number of corners.

    Parameters
    ----------
    rings : list of ndarray of float, shape (n, 2)
        Closed rings, digitised either way from any corner.
    whole : ndarray of bool
        Whether an area was seen whole.

    Returns
    -------
    ndarray of float, shape (k, 2)
        The closed ring of the average; where none was seen whole, the largest that was seen, as it is.
    """
    corners = [_counter_clockwise(ring[:-1]) for ring, all_of_it in zip(rings, whole, strict=True) if all_of_it]
    if not corners:
        return rings[int(np.argmax([shapely.Polygon(ring).area for ring in rings]))]
    usual = np.bincount([len(ring) for ring in corners]).argmax()
    alike = [ring for ring in corners if len(ring) == usual]
    mean = np.mean([_rolled_onto(ring, alike[0]) for ring in alike], axis=0)
    return np.concatenate([mean, mean[:1]])


def _points_at_stations(points: Array, stations: Array) -> tuple[NDArray[np.intp], Array]:
    """Return the unbroken run of stations that a line covers, and the point of the line at each."""
    paths = [_follow(line, stations) for line in (points, points[::-1])]
    (path, _), line = min(zip(paths, (points, points[::-1]), strict=True), key=lambda found: found[0][1])
    covered = np.unique(path)
    place = covered - path[0]
    count = np.bincount(path - path[0])[place]
    means = np.column_stack([np.bincount(path - path[0], axis)[place] / count for axis in line.T])
    # A mean of several points would be short of the line's ends.
    means[[0, -1]] = line[[0, -1]]
    run = np.arange(path[0], path[-1] + 1)
    return run, np.column_stack([np.interp(run, covered, axis) for axis in means.T])


def _follow(points: Array, stations: Array) -> tuple[NDArray[np.intp], float]:
    """Return the stations, never falling, at the least sum of squared distances to the points in turn, and that sum.

    The nearest station of each point by itself would fall on the other side of a narrow island.
    """
    cost = cdist(points, stations, "sqeuclidean")
    moves = np.zeros(cost.shape, dtype=np.intp)
    total = cost[0]
    for row in range(1, len(points)):
        before = np.full((_MOVES, len(stations)), np.inf)
        for move in range(min(_MOVES, len(stations))):
            before[move, move:] = total[: len(stations) - move]
        moves[row] = before.argmin(axis=0)
        total = cost[row] + before.min(axis=0)
    path = np.empty(len(points), dtype=np.intp)
    path[-1] = total.argmin()
    for row in range(len(points) - 1, 0, -1):
        path[row - 1] = path[row] - moves[row, path[row]]
    return path, float(total.min())


def _covered_runs(covered: NDArray[np.bool_], *, closed: bool) -> list[NDArray[np.intp]]:
    """Return the indices of each unbroken run of covered stations; that of a whole ring ends where it starts."""
    order = np.arange(len(covered))
    if closed and covered.all():
        return [np.append(order, 0)]
    if closed:
        order = np.roll(order, -int(np.argmin(covered)))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], covered[order], [False]]).astype(int)))
    return [order[start:stop] for start, stop in edges.reshape(-1, 2)]


def _evenly(line: Array, step: float) -> Array:
    """Return points at even steps from the first vertex to the last."""
    shape = shapely.LineString(line)
    count = max(1, round(shape.length / step))
    places = np.linspace(0.0, 1.0, count + 1)
    return np.asarray(shapely.get_coordinates(shapely.line_interpolate_point(shape, places, normalized=True)))


def _counter_clockwise(corners: Array) -> Array:
    return corners[:: 1 if shapely.is_ccw(shapely.LinearRing(corners)) else -1]


def _rolled_onto(corners: Array, others: Array) -> Array:
    """Return corners in the same order, from the one that brings all nearest to the others."""
    rolled = [np.roll(corners, turn, axis=0) for turn in range(len(corners))]
    return rolled[int(np.argmin([((ring - others) ** 2).sum() for ring in rolled]))]
