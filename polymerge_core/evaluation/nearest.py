"""The nearest place on any of many lines, exactly, for many points at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from polymerge_core.curves import Array, Curves, Index, count_up

#: Segments are cut so that none is longer than this, metres: a piece's middle then tells where the piece is.
_PIECE_M = 2.0

#: Points looked up at once.
_CHUNK = 200_000


class Nearest(NamedTuple):
    """Where points fall on the nearest of many lines, one entry a point."""

    #: Metres; infinite where no line is within the limit.
    distance: Array
    #: Which line; -1 where none is.
    line: Index
    #: Metres along that line; 0 where none is.
    position: Array


class NearestLine:
    """Looks up the nearest line within a limit.

    Parameters
    ----------
    curves : Curves
        The lines, metres.
    limit : float
        Lines farther than this are not looked for, metres.
    """

    def __init__(self, curves: Curves, limit: float) -> None:
        self._limit = limit
        inner = np.ones(len(curves.vertices), dtype=bool)
        inner[curves.bounds[1:] - 1] = False
        first = np.flatnonzero(inner)
        x, y = curves.vertices.T
        length = curves.arc[first + 1] - curves.arc[first]
        counts = np.maximum(np.ceil(length / _PIECE_M), 1).astype(np.intp)
        segment, number = count_up(counts)
        vertex = first[segment]
        width = (length / counts)[segment]
        # Axis by axis, as unit direction and length: what is asked millions of times.
        self._ux, self._uy = (((axis[first + 1] - axis[first]) / length)[segment] for axis in (x, y))
        self._x = x[vertex] + number * width * self._ux
        self._y = y[vertex] + number * width * self._uy
        self._length = width
        self._line: Index = curves.owner[vertex]
        self._from = curves.arc[vertex] + number * width
        middles = [start + width / 2 * unit for start, unit in ((self._x, self._ux), (self._y, self._uy))]
        self._tree = cKDTree(np.column_stack(middles), balanced_tree=False, compact_nodes=False)

    def __call__(self, points: Array) -> Nearest:
        """Look up points, shape (n, 2), metres."""
        found = Nearest(np.full(len(points), np.inf), np.full(len(points), -1), np.zeros(len(points)))
        for start in range(0, len(points) if len(self._line) else 0, _CHUNK):
            self._look_up(points, np.arange(start, min(start + _CHUNK, len(points))), found)
        return found

    def _look_up(self, points: Array, rows: Index, found: Nearest) -> None:
        """Fill in the rows; a middle lies at most half a piece beyond its piece, so some must be asked again."""
        count = 3
        every = len(self._line)
        near = self._limit + _PIECE_M / 2
        while len(rows):
            asked = points[rows]
            middle, piece = self._tree.query(
                asked, k=np.arange(1, min(count, every) + 1), distance_upper_bound=near, workers=-1
            )
            distance, along = self._measure(asked, np.minimum(piece, every - 1))
            distance[~np.isfinite(middle)] = np.inf
            best = np.argmin(distance, axis=1)
            pick = (np.arange(len(rows)), best)
            closest, chosen = distance[pick], piece[pick]
            hit = closest <= self._limit
            found.distance[rows[hit]] = closest[hit]
            found.line[rows[hit]] = self._line[chosen[hit]]
            found.position[rows[hit]] = self._from[chosen[hit]] + along[pick][hit]
            # Pieces that were not looked at have a middle at least as far as the last one that was.
            settled = (middle[:, -1] - _PIECE_M / 2 >= np.minimum(closest, self._limit)) | (count >= every)
            rows, count = rows[~settled], 4 * count

    def _measure(self, points: Array, piece: Index) -> tuple[Array, Array]:
        """Return the distance to pieces, and how far along them the foot lies, metres, both of the shape of `piece`."""
        dx, dy = points[:, :1] - self._x[piece], points[:, 1:] - self._y[piece]
        ux, uy = self._ux[piece], self._uy[piece]
        along = np.clip(dx * ux + dy * uy, 0.0, self._length[piece])
        return np.hypot(dx - along * ux, dy - along * uy), along
