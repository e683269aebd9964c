"""From a line followed at small steps to the few vertices on a grid that a predictor writes."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Half length and half width of what the predictor looks at, metres, ego frame.
BOX = np.array([30.0, 15.0])
GRID_M = 0.3
VERTICES = (5, 30)
#: Spacing at which lines are followed before they are thinned.
STEP_M = 0.25

_TANGENT_STEPS = 8  # directions are taken over 2 m each way, so that a sharp corner does not tear the line
_BEND_WEIGHT_M = 10.0  # a bend of 1 rad draws as many vertices as 10 m of straight line
_VERTEX_SPACING_M = (2.0, 5.0)
_MIN_LENGTH_M = 3.0
_MIN_AREA_M2 = 2.0
_SPLIT_GAP_M = 1.0


def stretches_inside(points: Array, *, closed: bool) -> list[NDArray[np.intp]]:
    """Return the indices of each unbroken run of points in the box; a ring's may pass its start."""
    inside = _in_box(points)
    order = np.arange(len(points))
    if closed and not inside.all():
        order = np.roll(order[:-1], -int(np.argmin(inside)))
    return [order[start:stop] for start, stop in _runs(inside[order])]


def cut(points: Array, ends_m: Array, gap_at: float | None) -> list[Array]:
    """Shorten a line and perhaps leave a gap in it.

    Parameters
    ----------
    points : ndarray of float, shape (n, 2)
        A line followed at small steps.
    ends_m : ndarray of float, shape (2,)
        Metres to take off at its start and its end.
    gap_at : float or None
        Where to split what is left, as a share of its length; None leaves it whole.

    Returns
    -------
    list of ndarray
        One or two lines, empty where nothing is left.
    """
    arc = arc_lengths(points)
    start, stop = ends_m[0], arc[-1] - ends_m[1]
    limits = [(start, stop)]
    if gap_at is not None:
        middle = start + gap_at * (stop - start)
        limits = [(start, middle - _SPLIT_GAP_M / 2), (middle + _SPLIT_GAP_M / 2, stop)]
    return [
        points_at(points, arc, np.concatenate([[low], arc[(arc > low) & (arc < high)], [high]]))
        for low, high in limits
        if low < high
    ]


def longest_inside(points: Array) -> Array:
    """Return the longest run of points in the box."""
    runs = _runs(_in_box(points))
    if len(runs) == 0:
        return points[:0]
    start, stop = runs[np.argmax(runs[:, 1] - runs[:, 0])]
    return points[start:stop]


def thin_out(points: Array, rng: np.random.Generator) -> Array | None:
    """Thin a line to a few vertices on the grid, more of them in bends.

    Parameters
    ----------
    points : ndarray of float, shape (n, 2)
        A line followed at small steps, metres, ego frame.
    rng : Generator
        Draws how many vertices (`VERTICES`) and where.

    Returns
    -------
    ndarray of float, shape (m, 2), or None
        None where the line is too short to be predicted.
    """
    if len(points) < 2 or (arc := arc_lengths(points))[-1] < _MIN_LENGTH_M:
        return None
    direction = tangents(points)
    turn = np.arccos(np.clip((direction[1:] * direction[:-1]).sum(axis=1), -1.0, 1.0))
    weight = arc + _BEND_WEIGHT_M * np.concatenate([[0.0], np.cumsum(turn)])
    low, high = VERTICES
    count = int(np.clip(np.round(arc[-1] / rng.uniform(*_VERTEX_SPACING_M)) + 1, low, high))
    inner = (np.arange(1, count - 1) + rng.uniform(-0.2, 0.2, count - 2)) / (count - 1)
    vertices = on_grid(points_at(points, weight, weight[-1] * np.concatenate([[0.0], inner, [1.0]])))
    return vertices if len(vertices) >= low else None


def visible_ring(corners: Array) -> Array | None:
    """Return the closed ring, on the grid, of what the box holds of a polygon; None for less than 2 m2."""
    seen = shapely.intersection(shapely.make_valid(shapely.Polygon(corners)), shapely.box(*-BOX, *BOX))
    parts = shapely.get_parts(seen)
    largest = parts[np.argmax(shapely.area(parts))] if len(parts) else shapely.Polygon()
    if shapely.area(largest) < _MIN_AREA_M2:
        return None
    # The first corner must not depend on how the geometry kernel happens to cut.
    return on_grid(shapely.get_coordinates(shapely.normalize(largest).exterior))


def on_grid(points: Array) -> Array:
    """Round to the grid and drop a vertex that falls on the one before it."""
    cells = np.round(points / GRID_M)
    new = np.concatenate([[True], (np.diff(cells, axis=0) != 0).any(axis=1)])
    # Adding 0 turns -0.0 into 0.0.
    return np.asarray(cells[new] * GRID_M + 0.0)


def tangents(points: Array) -> Array:
    """Return the unit direction of a line at each point, taken over 2 m each way; a ring has no ends."""
    index, last = np.arange(len(points)), len(points) - 1
    ahead, behind = index + _TANGENT_STEPS, index - _TANGENT_STEPS
    closed = np.array_equal(points[0], points[-1])
    ahead, behind = (step % last if closed else np.clip(step, 0, last) for step in (ahead, behind))
    chord = points[ahead] - points[behind]
    return np.asarray(chord / np.maximum(np.hypot(*chord.T), 1e-9)[:, None])


def _in_box(points: Array) -> NDArray[np.bool_]:
    return np.asarray((np.abs(points) <= BOX).all(axis=1))


def _runs(mask: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return start and stop of each run of true values, shape (n, 2)."""
    return np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8))).reshape(-1, 2)


def arc_lengths(points: Array) -> Array:
    """Return the distance of each point from the first, along the line."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def points_at(points: Array, measure: Array, wanted: Array) -> Array:
    """Return the points of a line at given values of a measure that rises along it."""
    return np.column_stack([np.interp(wanted, measure, axis) for axis in points.T])
