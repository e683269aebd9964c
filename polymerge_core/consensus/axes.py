"""The lines that are being fused, as stations one proximity apart, and how they are smoothed.

All lines of a class are held in one array, line after line, so that every step is one operation on all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.spatial import cKDTree

from polymerge_core.consensus.looks import cross, direction_at, dot
from polymerge_core.curves import Array, Curves, Index, count_up

#: Weight of the smoothing, in proximities to the sixth power: what is shorter than some ten proximities is taken
#: for noise. Third differences leave parabolas, and so all gentle bends, as they are, up to their ends.
SMOOTHING = 20.0

#: Coefficients of the differences that the smoothing keeps small.
_DIFFERENCE = (-1.0, 3.0, -3.0, 1.0)

#: A station counts at most so many times as much as the middle one of all: where few looked, what they saw holds too.
_MOST = 3.0

#: Metres between two lines on the axis that tells them apart: more than any map is wide.
_APART = 1e9

#: Stations of a ring that are smoothed with it once more at either end.
_AROUND = 30

#: The share of its size that smoothing may take off a ring: a small one is little but roundness.
_SHRUNK = 0.01


class Feet(NamedTuple):
    """Where points fall on their own line, one entry a point."""

    #: The nearest station of the line.
    station: Index
    #: Distance to the left of the line, metres.
    lateral: Array
    #: Direction of the line there, shape (p, 2).
    tangent: Array
    #: How far ahead of its station the point lies, metres.
    ahead: Array
    #: Whether the point lies beside the line, not beyond an end of it.
    beside: NDArray[np.bool_]


@dataclass(frozen=True)
class Axes:
    """Lines by their stations.

    Parameters
    ----------
    stations : ndarray of float, shape (s, 2)
        Metres, line after line.
    line : ndarray of int, shape (s,)
        The line of each station, rising from 0; each line has two or more.
    """

    stations: Array
    line: Index

    @cached_property
    def curves(self) -> Curves:
        """The lines."""
        return Curves(shapely.linestrings(self.stations, indices=self.line))

    @cached_property
    def first(self) -> Index:
        """The first station of each line."""
        return np.flatnonzero(np.diff(self.line, prepend=-1))

    @cached_property
    def counts(self) -> Index:
        """How many stations each line has."""
        return np.bincount(self.line)

    @cached_property
    def last(self) -> Index:
        """The last station of each line."""
        return self.first + self.counts - 1

    @cached_property
    def alone(self) -> Index:
        """The stations, the last one of a ring called by its first, which is the same."""
        station, ring = np.arange(len(self.line)), self.curves.closed
        station[self.last[ring]] = self.first[ring]
        return station

    @cached_property
    def tangent(self) -> Array:
        """Direction of the line at each station, shape (s, 2)."""
        curves = self.curves
        half = np.median(curves.length / np.maximum(self.counts - 1, 1)) if len(curves) else 1.0
        return direction_at(curves, self.line, curves.arc, 1.5 * float(half))

    @property
    def normal(self) -> Array:
        """Direction to the left of the line at each station, shape (s, 2)."""
        return np.column_stack([-self.tangent[:, 1], self.tangent[:, 0]])

    def spaced(self, step: float) -> Axes:
        """Return the same lines with even stations at most a step apart."""
        every = np.arange(len(self.curves))
        points, owner = self.curves.resampled(every, np.zeros(len(every)), self.curves.length, step)
        return Axes(points, owner)

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(told_apart(self.stations, self.line), balanced_tree=False, compact_nodes=False)

    def nearest(self, points: Array, line: Index) -> Index:
        """Return the station of each point's line that is nearest to it."""
        _, station = self._tree.query(told_apart(points, line), workers=-1)
        return np.asarray(station, dtype=np.intp)

    def walked(self, points: Array, station: Index) -> Index:
        """Return the stations to which one comes from given ones by going along the line ever nearer to each point."""
        station = station.copy()
        x, y = self._columns
        east, north = np.ascontiguousarray(points.T)
        nearest = (x[station] - east) ** 2 + (y[station] - north) ** 2
        for neighbour in self._neighbours:
            there = neighbour[station]
            far = (x[there] - east) ** 2 + (y[there] - north) ** 2
            rows = np.flatnonzero(far < nearest)
            there, far = there[rows], far[rows]
            while len(rows):
                station[rows], nearest[rows] = there, far
                there = neighbour[there]
                far = (x[there] - east[rows]) ** 2 + (y[there] - north[rows]) ** 2
                nearer = far < nearest[rows]
                rows, there, far = rows[nearer], there[nearer], far[nearer]
        return station

    def feet(self, points: Array, line: Index, unit: float, near: Index | None = None) -> Feet:
        """Project points onto given lines: to the segment before or after the nearest station.

        Parameters
        ----------
        points : ndarray of float, shape (p, 2)
            Metres.
        line : ndarray of int, shape (p,)
            The line of each.
        unit : float
            The proximity, metres.
        near : ndarray of int, shape (p,), optional
            A station of the line of each that is near it, where that is known already.
        """
        station = self.nearest(points, line) if near is None else self.walked(points, near)
        offset, tangent = points - self.stations[station], self.tangent[station]
        ahead = dot(tangent, offset)
        # Along the chord to the next station or to the one before, whichever way the point lies.
        way = station + np.where(ahead >= 0, 0, len(self.stations))
        chord, square = self._chords
        chord, square = chord[way], square[way]
        share = np.clip(dot(chord, offset) / np.maximum(square, np.finfo(float).tiny), 0.0, 1.0)
        lateral = cross(tangent, offset) - share * cross(tangent, chord)
        beside = (square > 0) | (np.abs(ahead) <= 0.5 * unit)
        return Feet(self.alone[station], lateral, tangent, ahead, beside)

    @cached_property
    def _columns(self) -> Array:
        """The stations' coordinates, each in one piece, which is read much faster."""
        return np.ascontiguousarray(self.stations.T)

    @cached_property
    def _neighbours(self) -> tuple[Index, Index]:
        """The station after each and the one before it; a ring goes on past its end, and an open line does not."""
        every, last = np.arange(len(self.line)), self.last
        after = np.minimum(every + 1, last[self.line])
        before = np.maximum(every - 1, self.first[self.line])
        ring = self.curves.closed
        # The last station of a ring is its first one.
        after[last[ring]], before[self.first[ring]] = self.first[ring] + 1, last[ring] - 1
        return after, before

    @cached_property
    def _chords(self) -> tuple[Array, Array]:
        """The way from each station to the one after it, then from each to the one before, and the squared lengths."""
        chord = np.concatenate([self.stations[neighbour] - self.stations for neighbour in self._neighbours])
        return chord, dot(chord, chord)

    def around(self, values: Any) -> Any:
        """Return values of stations with that of the first station of a ring given to its last, which is the same."""
        ring = np.flatnonzero(self.curves.closed)
        alike = values.copy()
        alike[self.last[ring]] = values[self.first[ring]]
        return alike

    def again(self, axes: Axes, station: Index) -> Index:
        """Return the stations that lie where stations of the same lines, drawn with other steps, lie."""
        line = axes.line[station]
        share = (station - axes.first[line]) / np.maximum(axes.counts[line] - 1, 1)
        return self.first[line] + np.round(share * (self.counts[line] - 1)).astype(np.intp)

    def reaching(self, feet: Feet, line: Index) -> Axes:
        """Return the lines drawn out, or back, to where the first and the last of their points lie."""
        lengthened = self.stations.copy()
        for ends, sign in ((self.first, -1.0), (self.last, 1.0)):
            here = np.flatnonzero(feet.station == ends[line])
            far = np.full(len(ends), -np.inf)
            np.maximum.at(far, line[here], sign * feet.ahead[here])
            # No farther than a step: what lies beyond is reached in the next round.
            step = np.hypot(*(self.stations[ends] - self.stations[ends - int(sign)]).T)
            moved = np.where(np.isfinite(far) & ~self.curves.closed, np.clip(far, -0.4 * step, step), 0.0)
            lengthened[ends] += (sign * moved)[:, None] * self.tangent[ends]
        return Axes(lengthened, self.line)

    def smoothed(self, weight: Array) -> Axes:
        """Return the lines drawn as smoothly as their stations' weights allow.

        Parameters
        ----------
        weight : ndarray of float, shape (s,)
            How well each station is known; 0 where nothing was seen.
        """
        known = weight[weight > 0]
        usual = float(np.median(known)) if len(known) else 1.0
        # Held down before it is divided: where most looks have a score of 0, the usual weight is next to nothing.
        relative = np.minimum(weight, _MOST * usual) / usual if len(known) else np.ones(len(weight))
        # A ring goes on where it ends: it is smoothed with a piece of its own to either side.
        order, series, middle = self._unrolled()
        drawn = smooth(self.stations[order], relative[order], series, self._smoothing[series])[middle]
        return Axes(self.around(drawn), self.line)

    @property
    def _smoothing(self) -> Array:
        """How strongly each line is smoothed: a ring no more than leaves it its size."""
        # Going around once is a wave that the penalty takes this much off, and the data hold with their weight of 1.
        once = 2 * np.sin(np.pi / np.maximum(self.counts - 1, 2))
        return np.where(self.curves.closed, np.minimum(SMOOTHING, _SHRUNK / once**6), SMOOTHING)

    def _unrolled(self) -> tuple[Index, Index, Index]:
        """Return the stations to smooth (of rings some once more), their lines, and where each station lies there."""
        ring = self.curves.closed
        if not ring.any():
            every = np.arange(len(self.stations))
            return every, self.line, every
        # The last station of a ring is its first one.
        around = self.counts - 1
        more = np.where(ring, np.minimum(_AROUND, around), 0)
        sizes = self.counts + 2 * more
        owner, number = count_up(sizes)
        place = number - more[owner]
        wrapped = np.where(ring[owner], place % around[owner], place)
        middle = (np.cumsum(sizes) - sizes + more)[self.line] + np.arange(len(self.line)) - self.first[self.line]
        return self.first[owner] + wrapped, owner, middle


def told_apart(points: Array, line: Index) -> Array:
    """Return points with a third axis, on which those of two lines are farther apart than anything on the plane."""
    return np.column_stack([points, _APART * line])


def smooth(values: Array, weight: Array, series: Index, strength: Array) -> Array:
    """Smooth many series at once: weighted least squares with a penalty on third differences.

    Parameters
    ----------
    values : ndarray of float, shape (n, k)
        Series after series, at even steps.
    weight : ndarray of float, shape (n,)
        Of each value; where it is 0 the series is continued from what is around.
    series : ndarray of int, shape (n,)
        The series of each value; rising.
    strength : ndarray of float, shape (n,)
        Weight of the penalty, that of its series at each value.

    Returns
    -------
    ndarray of float, shape (n, k)

    References
    ----------
    Whittaker 1923, "On a new method of graduation"; Eilers 2003, "A perfect smoother".
    """
    count, order = len(values), len(_DIFFERENCE) - 1
    if count <= order:
        return values
    penalty = strength[order:] * (series[order:] == series[:-order])
    # The penalty's matrix has few bands; the series do not touch in it, so all are solved as one.
    bands = np.zeros((order + 1, count))
    for row in range(order + 1):
        for column in range(row, order + 1):
            product = _DIFFERENCE[row] * _DIFFERENCE[column]
            bands[order - (column - row), column : column + count - order] += product * penalty
    # What nothing holds, such as a line of two stations without weight, stays where it is.
    held = weight + 1e-9
    bands[order] += held
    # Near the origin, so that large coordinates lose nothing.
    origin = values.mean(axis=0)
    solved: Array = solveh_banded(bands, held[:, None] * (values - origin)) + origin
    return solved
