"""Step 3 for many sets of polylines at once.

Within one set the vertices must be merged one after the other; between sets nothing is shared. So the k-th
vertices of many sets are merged in one array operation. The result is, bit for bit, that of
`polymerge_core.polyline.merge_polylines` on each set; `tests/core/test_batch.py` holds the two together.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polymerge_core.polyline import Array, feet, merge_polylines

#: Sets of more vertices go through `merge_polylines`, where the cost of a vertex does not grow with the base.
LONG = 1500

#: Vertices held in one batch: what fits into a processor's cache. Measured: half or twice as many cost
#: a third more.
_BATCH = 32_000


class PolylineSets(NamedTuple):
    """Sets of polylines, flat: vertex k of set i is ``vertices[bounds[i] + k]``."""

    #: Base first, then the others in the order of merging; float, shape (n, 2), metres.
    vertices: Array
    #: Where each set starts, and the end; int, shape (m + 1,).
    bounds: NDArray[np.intp]
    #: How many vertices of each set are its base; int, shape (m,).
    base_size: NDArray[np.intp]


def merge_sets(sets: PolylineSets, *, advance: Callable[[int], object] | None = None) -> list[Array]:
    """Merge each set of polylines into its base by the four scenarios (paper, section II-B.3).

    Parameters
    ----------
    sets : PolylineSets
        Each base with at least two vertices and without zero-length segments.
    advance : callable, optional
        Called with the number of vertices merged now and then; may raise to stop the work.

    Returns
    -------
    list of ndarray of float, shape (k, 2)
        The merged polyline of each set.
    """
    size = np.diff(sets.bounds)
    merged: list[Array] = [np.empty((0, 2))] * len(size)
    report = advance or (lambda _count: None)
    for number in np.flatnonzero(size > LONG).tolist():
        first, last = sets.bounds[number], sets.bounds[number + 1]
        base, rest = np.split(sets.vertices[first:last], [sets.base_size[number]])
        # In portions, so that progress is seen within one set.
        merged[number] = merge_polylines(base, np.split(rest, range(LONG, len(rest), LONG)), advance=report)
    # Sets of like size share a batch: little of its rectangle stays empty.
    order = np.lexsort((size - sets.base_size, size))
    order = order[size[order] <= LONG]
    while len(order):
        largest_first = order[::-1]
        rows = largest_first[: max(1, _BATCH // int(size[largest_first[0]]))]
        order = order[: len(order) - len(rows)]
        for number, line in zip(rows.tolist(), _merge_batch(sets, rows), strict=True):
            merged[number] = line
        report(int(size[rows].sum()))
    return merged


def _merge_batch(sets: PolylineSets, rows: NDArray[np.intp]) -> list[Array]:
    """Merge the sets of some rows side by side, one vertex of each at a time."""
    count = (np.diff(sets.bounds) - sets.base_size)[rows]
    rows_back = np.argsort(np.argsort(-count, kind="stable"), kind="stable")
    rows = rows[np.argsort(-count, kind="stable")]
    start, base_size = sets.bounds[rows], sets.base_size[rows]
    count = np.sort(count)[::-1]
    capacity = int((base_size + count).max()) + 1
    base = np.zeros((2, len(rows), capacity))
    for row, (first, size) in enumerate(zip(start.tolist(), base_size.tolist(), strict=True)):
        base[:, row, :size] = sets.vertices[first : first + size].T
    state = _Batch(base, base_size.copy())
    for step in range(int(count[0]) if len(count) else 0):
        # Sorted by how many vertices they have left, the sets still at work are the first ones.
        active = int(np.searchsorted(-count, -step, side="left"))
        state.merge(sets.vertices[start[:active] + base_size[:active] + step].T)
    lines = [state.base[:, row, :size].T.copy() for row, size in enumerate(state.size.tolist())]
    return [lines[row] for row in rows_back.tolist()]


class _Batch:
    """The bases of a batch in one rectangle of vertices, shape (2, sets, capacity)."""

    def __init__(self, base: Array, size: NDArray[np.intp]) -> None:
        row = np.arange(len(size))
        self.base, self.size = base, size
        self.closed = (size > 2) & (base[:, row, 0] == base[:, row, size - 1]).all(axis=0)

    def merge(self, points: Array) -> None:
        """Merge one vertex into each of the first sets; `points` has shape (2, sets)."""
        active = points.shape[1]
        size, closed, row = self.size[:active], self.closed[:active], np.arange(active)
        width = int(size.max())
        segment, parameter, foot = self._nearest(points, width)
        inside = (parameter > 0) & (parameter < 1)
        vertex = segment + (parameter == 1)
        first, last = vertex == 0, vertex == size - 1
        at_edge = ~inside & ~closed & (first | last)
        replace = ~inside & ~at_edge
        insert = inside | (at_edge & (points != foot).any(axis=0))
        value = np.where(at_edge, points, (points + foot) / 2)
        self.base[:, row[replace], vertex[replace]] = value[:, replace]
        # The first vertex of a closed base is also its last.
        wrap = replace & (first | last)
        self.base[:, row[wrap], np.where(first, size - 1, 0)[wrap]] = value[:, wrap]
        index = np.where(inside, segment + 1, np.where(first, 0, size))
        self._insert(np.where(insert, index, width + 1), width, active)
        self.base[:, row[insert], index[insert]] = value[:, insert]
        size += insert

    def _nearest(self, points: Array, width: int) -> tuple[NDArray[np.intp], Array, Array]:
        """Return the nearest segment of each base, the parameter and the foot there (eq. 2)."""
        active = points.shape[1]
        held = self.base[:, :active, :width]
        parameter, foot, squared = feet(points[:, :, np.newaxis], held[:, :, :-1], held[:, :, 1:])
        squared[np.arange(width - 1) >= self.size[:active, np.newaxis] - 1] = np.inf
        segment = squared.argmin(axis=1)
        row = np.arange(active)
        return segment, parameter[row, segment], foot[:, row, segment]

    def _insert(self, index: NDArray[np.intp], width: int, active: int) -> None:
        """Make room before the vertex at `index` of each base."""
        held = self.base[:, :active, : width + 1]
        behind = np.arange(1, width + 1) > index[:, np.newaxis]
        np.copyto(held[:, :, 1:], held[:, :, :-1].copy(), where=behind)
