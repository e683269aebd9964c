"""Step 3 of the published method: merging polylines vertex by vertex (paper, section II-B.3).

A vertex A of the polyline being merged is projected onto the base polyline as it stands now (eq. 2); where
its projection B falls decides what happens to the base (the four scenarios). The base changes after every
vertex, so the loop over vertices is the method itself. The search for the nearest segment is not: it runs on
arrays, over blocks of neighbouring segments, so that a vertex costs much the same on a base of a hundred
vertices and on one of a hundred thousand.

All functions take and return coordinate arrays in metres, shape (n, 2). A line whose first and last vertex
are equal is closed and stays closed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: A block of the base is split into two of this many segments when it has grown to twice as many.
#: Measured on bases of 300 to 100,000 vertices: 64 to 256 cost the same, less and more cost more.
_BLOCK = 128

#: Distances in one matrix of `project_points`; more points are projected in several goes.
_MATRIX = 4_000_000


class Projection(NamedTuple):
    """Where points fall on a polyline (paper, eq. 2), one entry a point."""

    #: Index of the nearest segment, the lowest where several are equally near; int, shape (n,).
    segment: NDArray[np.intp]
    #: Position on that segment, 0 at its start and 1 at its end; float, shape (n,).
    parameter: Array
    #: The projections; float, shape (n, 2), metres.
    foot: Array
    #: Distance from each point to its projection; float, shape (n,), metres.
    distance: Array


def project_points(points: ArrayLike, line: ArrayLike) -> Projection:
    """Project points onto a polyline (paper, eq. 2).

    Parameters
    ----------
    points : array_like of float, shape (n, 2)
        Metres.
    line : array_like of float, shape (m, 2)
        Vertices of the polyline, m >= 2, without zero-length segments, metres.

    Returns
    -------
    Projection
        Nearest segment, position on it, foot and distance of every point.

    Raises
    ------
    ValueError
        If `points` or `line` is not an array of that shape.

    Examples
    --------
    >>> project_points([(1.0, 2.0)], [(0.0, 0.0), (4.0, 0.0)]).foot.tolist()
    [[1.0, 0.0]]
    """
    line = _as_line(line)
    points = _as_points(points)
    rows = max(1, _MATRIX // len(line))
    parts = [_project(points[start : start + rows], line) for start in range(0, max(len(points), 1), rows)]
    return Projection(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def merge_vertex(base: ArrayLike, point: ArrayLike) -> Array:
    """Merge one vertex into a base polyline by the four scenarios (paper, section II-B.3 and figure 4).

    With A the vertex, B its projection onto the base, CD the nearest segment:

    1. B inside CD: the midpoint of A and B is inserted between C and D.
    2. B at an inner vertex: the midpoint replaces that vertex.
    3. B at the first vertex: A becomes the new first vertex.
    4. B at the last vertex: A becomes the new last vertex.

    In 3 and 4 nothing happens where A is that vertex itself. A closed base has inner vertices only.

    Parameters
    ----------
    base : array_like of float, shape (m, 2)
        Metres, m >= 2.
    point : array_like of float, shape (2,)
        Metres.

    Returns
    -------
    ndarray of float, shape (m, 2) or (m + 1, 2)
        The new base; the input is not changed.

    Examples
    --------
    >>> merge_vertex([(0, 0), (4, 0)], (1, 2)).tolist()
    [[0.0, 0.0], [1.0, 1.0], [4.0, 0.0]]
    """
    return merge_polylines(base, [np.reshape(np.asarray(point, dtype=float), (1, 2))])


def merge_polyline(base: ArrayLike, polyline: ArrayLike) -> Array:
    """Merge a polyline into a base, vertex by vertex in the polyline's order (paper, section II-B.3).

    Parameters
    ----------
    base, polyline : array_like of float, shape (m, 2) and (n, 2)
        Metres.

    Returns
    -------
    ndarray of float, shape (k, 2), m <= k <= m + n
        The new base; the inputs are not changed.
    """
    return merge_polylines(base, [polyline])


def merge_polylines(
    base: ArrayLike, polylines: Iterable[ArrayLike], *, advance: Callable[[int], object] | None = None
) -> Array:
    """Merge polylines into a base, one after the other (paper, section II-B.3).

    Parameters
    ----------
    base : array_like of float, shape (m, 2)
        Metres.
    polylines : iterable of array_like of float, shape (n, 2) each
        In the order in which they are to be merged, metres.
    advance : callable, optional
        Called with the number of vertices merged after each polyline; may raise to stop the work.

    Returns
    -------
    ndarray of float, shape (k, 2)
        The merged polyline; the inputs are not changed.

    Raises
    ------
    ValueError
        If `base` has fewer than two vertices.
    """
    growing = _GrowingPolyline(_as_line(base))
    for polyline in polylines:
        vertices = _as_points(polyline)
        for x, y in vertices.tolist():
            growing.merge_vertex(x, y)
        if advance is not None:
            advance(len(vertices))
    return growing.coordinates()


def feet(points: Array, start: Array, end: Array) -> tuple[Array, Array, Array]:
    """Apply eq. 2 to points and segments of any shape.

    Parameters
    ----------
    points, start, end : ndarray of float, shape (2, ...)
        x and y are the first axis, the rest broadcasts; metres.

    Returns
    -------
    parameter, foot, squared : ndarray of float
        Position on each segment, its point nearest to the point, and the squared distance between them.
    """
    along = end - start
    inner = points - start
    inner *= along
    parameter = inner[0]
    parameter += inner[1]
    square = along * along
    length = square[0] + square[1]
    # Rounding can put a midpoint onto its neighbour: a segment of no length is its start.
    length[length == 0.0] = 1.0
    parameter /= length
    np.maximum(parameter, 0.0, out=parameter)
    np.minimum(parameter, 1.0, out=parameter)
    foot = parameter * along
    foot += start
    # B + 1 (C - B) need not be C in floating point; the scenarios ask whether the foot IS a vertex.
    np.copyto(foot, end, where=parameter == 1.0)
    off = points - foot
    off *= off
    return parameter, foot, off[0] + off[1]


class _GrowingPolyline:
    """A base polyline held in blocks of neighbouring segments.

    Each block keeps the vertices of its segments; the last vertex of a block is the first of the next. The
    bounding boxes of the blocks tell which blocks can hold the nearest segment.
    """

    def __init__(self, line: Array) -> None:
        self.closed = len(line) > 2 and bool((line[0] == line[-1]).all())
        starts = range(0, len(line) - 1, _BLOCK)
        self.blocks = [line[start : start + _BLOCK + 1].T.copy() for start in starts]
        self.boxes = np.column_stack([_box(block) for block in self.blocks])

    def coordinates(self) -> Array:
        """Return all vertices, shape (n, 2)."""
        parts = [block[:, :-1] for block in self.blocks] + [self.blocks[-1][:, -1:]]
        return np.ascontiguousarray(np.concatenate(parts, axis=1).T)

    def merge_vertex(self, x: float, y: float) -> None:
        """Apply the scenario that the projection of (x, y) asks for."""
        block, segment, parameter, foot = self._nearest(x, y)
        middle = ((x + foot[0]) / 2, (y + foot[1]) / 2)
        if 0 < parameter < 1:  # scenario 1
            self._insert(block, segment + 1, middle)
            return
        vertex = segment + int(parameter)
        first = block == 0 and vertex == 0
        end = (len(self.blocks) - 1, self.blocks[-1].shape[1] - 1)
        last = (block, vertex) == end
        if self.closed or not (first or last):  # scenario 2
            self._replace(block, vertex, middle)
            if first or last:
                other_block, other_vertex = end if first else (0, 0)
                self._replace(other_block, other_vertex, middle)
        elif (x, y) != foot:  # scenarios 3 and 4
            self._insert(block, vertex + int(last), (x, y))

    def _nearest(self, x: float, y: float) -> tuple[int, int, float, tuple[float, float]]:
        """Return block and segment nearest to (x, y), the parameter and the foot there (eq. 2)."""
        if len(self.blocks) == 1:
            return self._nearest_in(0, x, y)[1:]
        bound = self._least_squared_distance(x, y)
        best = self._nearest_in(int(bound.argmin()), x, y)
        for block in np.flatnonzero(bound <= best[0] * (1 + 1e-6) + 1e-12).tolist():
            # Equally near: the lower segment wins, whichever block was looked at first.
            best = min(best, self._nearest_in(block, x, y))
        return best[1:]

    def _nearest_in(self, block: int, x: float, y: float) -> tuple[float, int, int, float, tuple[float, float]]:
        vertices = self.blocks[block]
        parameter, foot, squared = feet(np.array(((x,), (y,))), vertices[:, :-1], vertices[:, 1:])
        segment = int(squared.argmin())
        foot_x, foot_y = foot[:, segment].tolist()
        return float(squared[segment]), block, segment, float(parameter[segment]), (foot_x, foot_y)

    def _least_squared_distance(self, x: float, y: float) -> Array:
        """Return how near each block's bounding box comes to (x, y), squared."""
        xmin, ymin, xmax, ymax = self.boxes
        beside_x = np.maximum(np.maximum(xmin - x, x - xmax), 0.0)
        beside_y = np.maximum(np.maximum(ymin - y, y - ymax), 0.0)
        squared: Array = beside_x * beside_x + beside_y * beside_y
        return squared

    def _insert(self, block: int, index: int, vertex: tuple[float, float]) -> None:
        """Put a vertex into a block before the one at `index`, and split the block when it is full."""
        old = self.blocks[block]
        new = np.empty((2, old.shape[1] + 1))
        new[:, :index], new[:, index], new[:, index + 1 :] = old[:, :index], vertex, old[:, index:]
        if new.shape[1] <= 2 * _BLOCK:
            self.blocks[block] = new
            self._extend_box(block, vertex)
            return
        halves = [new[:, : _BLOCK + 1].copy(), new[:, _BLOCK:].copy()]
        self.blocks[block : block + 1] = halves
        boxes = np.column_stack([_box(half) for half in halves])
        self.boxes = np.concatenate([self.boxes[:, :block], boxes, self.boxes[:, block + 1 :]], axis=1)

    def _replace(self, block: int, index: int, vertex: tuple[float, float]) -> None:
        """Move a vertex, in both blocks where two blocks share it."""
        self.blocks[block][:, index] = vertex
        self._extend_box(block, vertex)
        if index == 0 and block > 0:
            self.blocks[block - 1][:, -1] = vertex
            self._extend_box(block - 1, vertex)
        elif index == self.blocks[block].shape[1] - 1 and block < len(self.blocks) - 1:
            self.blocks[block + 1][:, 0] = vertex
            self._extend_box(block + 1, vertex)

    def _extend_box(self, block: int, vertex: tuple[float, float]) -> None:
        """Make a block's bounding box hold a vertex (a box that is too large costs time, not correctness)."""
        self.boxes[:2, block] = np.minimum(self.boxes[:2, block], vertex)
        self.boxes[2:, block] = np.maximum(self.boxes[2:, block], vertex)


def _project(points: Array, line: Array) -> Projection:
    parameter, foot, squared = feet(points.T[:, :, np.newaxis], line[:-1].T[:, np.newaxis], line[1:].T[:, np.newaxis])
    segment = squared.argmin(axis=1)
    row = np.arange(len(points))
    return Projection(segment, parameter[row, segment], foot[:, row, segment].T, np.sqrt(squared[row, segment]))


def _box(vertices: Array) -> Array:
    return np.concatenate([vertices.min(axis=1), vertices.max(axis=1)])


def _as_points(points: ArrayLike) -> Array:
    array = np.asarray(points, dtype=float)
    if array.ndim != 2 or array.shape[1] != 2:
        raise ValueError(f"points must be an array of shape (n, 2), not {array.shape}")
    return array


def _as_line(line: ArrayLike) -> Array:
    array = _as_points(line)
    if len(array) < 2:
        raise ValueError("a polyline needs at least two vertices")
    return array
