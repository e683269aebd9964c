"""Many polylines as flat arrays: points along them, pieces of even length, stretches.

Positions are metres along a line from its first vertex. On a closed line they go on past its length, so that a
stretch may run over the first vertex; a stretch whose end comes before its start runs backwards.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]

#: Places along lines nearer to each other than this are the same, metres.
_SAME = 1e-9

#: Nearer than this to an end of a line is at the end, metres.
_END = 1e-6

#: So many points are projected in a fraction of a second, also onto lines of thousands of vertices.
_AT_ONCE = 20_000


class Pieces(NamedTuple):
    """Lines cut into pieces of even length, one entry a piece, line by line."""

    line: Index
    #: Where each piece starts and ends, metres along its line.
    start: Array
    stop: Array

    @property
    def middle(self) -> Array:
        """Position of each piece's middle."""
        return (self.start + self.stop) / 2

    @property
    def length(self) -> Array:
        """Length of each piece, metres."""
        return self.stop - self.start


class Curves:
    """Polylines, with the distance of every vertex along its line.

    Parameters
    ----------
    lines : ndarray of LineString, shape (n,)
        Metres, without zero-length segments. A line whose first and last vertex are equal is closed.
    """

    def __init__(self, lines: NDArray[np.object_]) -> None:
        self.lines = lines
        self.vertices, self.owner = shapely.get_coordinates(lines, return_index=True)
        counts = shapely.get_num_coordinates(lines)
        #: Where each line's vertices start in `vertices`, and the end.
        self.bounds = np.append(0, np.cumsum(counts)).astype(np.intp)
        steps = np.hypot(*np.diff(self.vertices, axis=0, prepend=self.vertices[:1]).T)
        steps[self.bounds[:-1]] = 0.0
        #: Distance of each vertex along all lines laid end to end.
        self._laid = np.cumsum(steps)
        self._start = self._laid[self.bounds[:-1]]
        self.length = self._laid[self.bounds[1:] - 1] - self._start
        self.closed = shapely.is_closed(lines)

    def __len__(self) -> int:
        return len(self.lines)

    @property
    def arc(self) -> Array:
        """Distance of each vertex along its line, metres."""
        return self._laid - self._start[self.owner]

    def points_at(self, line: Index, position: Array) -> Array:
        """Return the points at positions along lines.

        Parameters
        ----------
        line : ndarray of int, shape (m,)
            Which line.
        position : ndarray of float, shape (m,)
            Metres along it; taken into the range of a closed line, clamped to that of an open one.

        Returns
        -------
        ndarray of float, shape (m, 2)
        """
        length = self.length[line]
        # Looks that cancel each other out can leave a line without length, around which there is no going.
        around = self.closed[line] & (length > _SAME)
        turns = np.floor(np.divide(position, length, out=np.zeros(len(line)), where=around))
        along = np.clip(position - turns * length, 0.0, length)
        laid = self._start[line] + along
        segment = np.searchsorted(self._laid, laid, side="right") - 1
        segment = np.clip(segment, self.bounds[line], self.bounds[line + 1] - 2)
        before, after = self._laid[segment], self._laid[segment + 1]
        share = np.clip((laid - before) / np.maximum(after - before, np.finfo(float).tiny), 0.0, 1.0)
        axes = (axis[segment] * (1 - share) + axis[segment + 1] * share for axis in self.vertices.T)
        return np.column_stack(tuple(axes))

    def locate(self, line: Index, points: Array) -> Array:
        """Return the positions of the projections of points onto lines (paper, eq. 2), shape (m,).

        What falls onto an end is exactly at it: 0, or the length.
        """
        found = np.empty(len(line))
        # By parts: an interrupt is not heard before shapely returns.
        for first in range(0, len(line), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            found[part] = shapely.line_locate_point(self.lines[line[part]], shapely.points(points[part]))
        length = self.length[line]
        # Both lengths are sums, which round differently.
        found = np.where(found > length - _END, length, found)
        return np.where(found < _END, 0.0, found)

    def pieces(self, step: float) -> Pieces:
        """Cut every line into equal pieces of at most `step` metres."""
        counts = np.maximum(np.ceil(self.length / step - 1e-9), 1).astype(np.intp)
        line, number = count_up(counts)
        width = (self.length / counts)[line]
        return Pieces(line, number * width, (number + 1) * width)

    def resampled(self, line: Index, start: Array, stop: Array, step: float) -> tuple[Array, Index]:
        """Follow stretches of lines at equal steps, both ends included.

        Parameters
        ----------
        line : ndarray of int, shape (m,)
            Which line.
        start, stop : ndarray of float, shape (m,)
            Stretch, metres along the line.
        step : float
            Longest step, metres.

        Returns
        -------
        points : ndarray of float, shape (k, 2)
        owner : ndarray of int, shape (k,)
            Which stretch each point is of; a stretch without length has its point twice.
        """
        steps = np.maximum(np.ceil(np.abs(stop - start) / step - 1e-9), 1).astype(np.intp)
        owner, number = count_up(steps + 1)
        position = start[owner] + (stop - start)[owner] * (number / steps[owner])
        return self.points_at(line[owner], position), owner

    def stretches(self, line: Index, start: Array, stop: Array) -> NDArray[np.object_]:
        """Return stretches (start < stop, within the line) as lines with all their vertices."""
        laid_start, laid_stop = self._start[line] + start, self._start[line] + stop
        # A vertex where the stretch begins or ends, but for rounding, is its end, and must not come twice.
        first = np.maximum(np.searchsorted(self._laid, laid_start + _SAME, side="right"), self.bounds[line])
        last = np.minimum(np.searchsorted(self._laid, laid_stop - _SAME, side="left"), self.bounds[line + 1])
        owner, number = count_up(np.maximum(last - first, 0))
        inner = self.vertices[first[owner] + number]
        every = np.arange(len(line))
        ends = [self.points_at(line, start), inner, self.points_at(line, stop)]
        place = np.concatenate([np.full(len(line), -1), number, np.full(len(line), len(self.vertices))])
        whose = np.concatenate([every, owner, every])
        order = np.lexsort((place, whose))
        lines: NDArray[np.object_] = shapely.linestrings(np.concatenate(ends)[order], indices=whose[order])
        return lines


def count_up(counts: Index) -> tuple[Index, Index]:
    """Return for each of ``counts.sum()`` items whose it is and its number there: [2, 1] gives [0, 0, 1], [0, 1, 0]."""
    owner = np.repeat(np.arange(len(counts)), counts)
    first = np.cumsum(counts) - counts
    return owner, np.arange(len(owner)) - first[owner]


def distinct(values: Index) -> Index:
    """Return the distinct values, rising: `numpy.unique` by sorting, which is several times faster for so many."""
    ordered = np.sort(values)
    return ordered[np.diff(ordered, prepend=ordered[:1] - 1) != 0]


def among(values: Index, ordered: Index) -> NDArray[np.bool_]:
    """Return which values are among others that rise: `numpy.isin`, without sorting these again."""
    if len(ordered) == 0:
        return np.zeros(len(values), dtype=bool)
    place = np.searchsorted(ordered, values)
    return np.asarray(ordered[np.minimum(place, len(ordered) - 1)] == values)


def best_of_each(owner: Index, score: NDArray[Any], tie: NDArray[Any]) -> Index:
    """Return the row of each owner with the highest score, of equal ones (to 1e-9) that with the least `tie`."""
    order = np.lexsort((tie, -np.round(score, 9), owner))
    return order[np.diff(owner[order], prepend=-1) != 0]


def turning(curves: Curves) -> Array:
    """Return how much each line turns at each vertex, radians, shape of `vertices`; ends of open lines do not turn."""
    steps = np.diff(curves.vertices, axis=0, append=curves.vertices[-1:])
    heading = np.arctan2(steps[:, 1], steps[:, 0])
    before = np.roll(heading, 1)
    first, last = curves.bounds[:-1], curves.bounds[1:] - 1
    # A closed line turns once at the vertex where it starts and ends.
    before[first] = heading[last - 1]
    turn = np.abs((heading - before + np.pi) % (2 * np.pi) - np.pi)
    turn[first] = np.where(curves.closed, turn[first], 0.0)
    turn[last] = 0.0
    return np.asarray(turn)
