"""The nearest place on any of many lines, exactly, for many points at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from polymerge_core.evaluation.curves import Array, Curves, Index, count_up

#: Segments are cut so that none is longer than this, metres: a piece's middle then tells where the piece is.
_PIECE_M = 1.0

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
        self._pieces(curves)
        self._tree = cKDTree((self._start + self._stop) / 2)

    def _pieces(self, curves: Curves) -> None:
        inner = np.ones(len(curves.vertices), dtype=bool)
        inner[curves.bounds[1:] - 1] = False
        first = np.flatnonzero(inner)
        arc = curves.arc
        a, b = curves.vertices[first], curves.vertices[first + 1]
        counts = np.maximum(np.ceil((arc[first + 1] - arc[first]) / _PIECE_M), 1).astype(np.intp)
        segment, number = count_up(counts)
        low, high = (number / counts[segment])[:, None], ((number + 1) / counts[segment])[:, None]
        self._start = a[segment] * (1 - low) + b[segment] * low
        self._stop = a[segment] * (1 - high) + b[segment] * high
        self._line: Index = curves.owner[first][segment]
        self._from = arc[first][segment] + (arc[first + 1] - arc[first])[segment] * low[:, 0]

    def __call__(self, points: Array) -> Nearest:
        """Look up points, shape (n, 2), metres."""
        found = Nearest(np.full(len(points), np.inf), np.full(len(points), -1), np.zeros(len(points)))
        for start in range(0, len(points) if len(self._start) else 0, _CHUNK):
            self._look_up(points, np.arange(start, min(start + _CHUNK, len(points))), found)
        return found

    def _look_up(self, points: Array, rows: Index, found: Nearest) -> None:
        """Fill in the rows; a middle lies at most half a piece beyond its piece, so some must be asked again."""
        count = 4
        every = len(self._start)
        while len(rows):
            near = self._limit + _PIECE_M / 2
            middle, piece = self._tree.query(
                points[rows], k=np.arange(1, min(count, every) + 1), distance_upper_bound=near
            )
            distance, along = self._measure(points[rows], np.minimum(piece, every - 1))
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
        start = self._start[piece]
        direction = self._stop[piece] - start
        length = np.hypot(direction[..., 0], direction[..., 1])
        offset = points[:, None] - start
        along = np.clip((offset * direction).sum(axis=-1) / length, 0.0, length)
        foot = start + direction * (along / length)[..., None]
        return np.hypot(*np.moveaxis(points[:, None] - foot, -1, 0)), along
