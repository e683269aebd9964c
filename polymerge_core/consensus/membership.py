"""Which line each look belongs to, asked again once the lines are known.

Association compares looks by pairs; a look that happens to lie close to the wrong one is found out by the lines. A look
counts for a line only where others saw it too, so that it cannot speak for itself.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polymerge_core.consensus.alongside import ANGLE_DEG, REACH
from polymerge_core.consensus.axes import Axes
from polymerge_core.consensus.fusion import Fit
from polymerge_core.consensus.looks import Looks, cross, dot
from polymerge_core.curves import Array, Index, among, best_of_each, distinct

#: Stations of lines that are looked at for each point.
_NEAREST = 8

#: Points whose neighbourhood is looked at as one, to see whether there is any other line.
_PIECE = 16

#: So many other looks say as much about a line as any more.
_ENOUGH = 3


class Beside(NamedTuple):
    """Points and the lines that they run beside, one entry a point and line."""

    point: Index
    station: Index
    line: Index
    #: Metres to the left of the line.
    lateral: Array


def points_beside(looks: Looks, axes: Axes, own: Index | None = None) -> Beside:
    """Find the lines that each point of the looks runs beside, within reach and in their direction.

    Parameters
    ----------
    looks : Looks
        Of one class.
    axes : Axes
        The lines.
    own : ndarray of int, shape (p,), optional
        The nearest station of the line that each point is part of: it saves looking for it where there is no other.
    """
    far = (REACH + 0.5) * looks.unit
    every = np.arange(len(looks.points))
    crowded = every if own is None else _near_others(looks, axes, own, far)
    tree = cKDTree(axes.stations)
    nearest = np.arange(1, min(_NEAREST, len(axes.stations)) + 1)
    distance, station = tree.query(looks.points[crowded], k=nearest, distance_upper_bound=far, workers=-1)
    point, rank = np.nonzero(np.isfinite(distance))
    found, ahead = _beside(looks, axes, crowded[point], station[point, rank])
    # Of the stations of one line the one that the point lies beside.
    key = found.point * len(axes.counts) + found.line
    one = best_of_each(key, -ahead, found.station)
    found = Beside._make(column[one] for column in found)
    if own is None:
        return found
    alone = np.delete(every, crowded)
    lone, _ = _beside(looks, axes, alone, own[alone])
    return Beside._make(np.concatenate(columns) for columns in zip(found, lone, strict=True))


def _beside(looks: Looks, axes: Axes, point: Index, station: Index) -> tuple[Beside, Array]:
    """Return the points that lie beside stations, and how far before or behind them, metres."""
    tangent = axes.tangent[station]
    offset = looks.points[point] - axes.stations[station]
    lateral, ahead = cross(tangent, offset), np.abs(dot(tangent, offset))
    straight = np.abs(dot(tangent, looks.tangent[point])) > np.cos(np.radians(ANGLE_DEG))
    kept = straight & (np.abs(lateral) <= REACH * looks.unit) & (ahead <= 0.75 * looks.unit)
    station = axes.alone[station[kept]]
    return Beside(point[kept], station, axes.line[station], lateral[kept]), ahead[kept]


def _near_others(looks: Looks, axes: Axes, own: Index, far: float) -> Index:
    """Return the points that may be within reach of another line than their own."""
    line = axes.line[own]
    mine, _, first = _boxes(looks.points, looks.owner, far)
    theirs, whose, _ = _boxes(axes.stations, axes.line, 0.0)
    piece, other = shapely.STRtree(theirs).query(mine)
    near = np.zeros(len(mine), dtype=bool)
    near[piece[line[first[piece]] != whose[other]]] = True
    return np.flatnonzero(np.repeat(near, np.diff(np.append(first, len(line)))))


def _boxes(points: Array, owner: Index, margin: float) -> tuple[NDArray[np.object_], Index, Index]:
    """Return boxes with a margin about every few points of each owner, whose they are, and the first point in each."""
    number = np.arange(len(owner)) - np.searchsorted(owner, owner)
    first = np.flatnonzero(number % _PIECE == 0)
    if len(first) == 0:
        return np.empty(0, dtype=object), first, first
    low, high = np.minimum.reduceat(points, first) - margin, np.maximum.reduceat(points, first) + margin
    return shapely.box(*low.T, *high.T), owner[first], first


def sightings(looks: Looks, group: Index, beside: Beside) -> tuple[Index, Index]:
    """Return the stations of the lines and the local maps whose looks at that line run beside them, each pair once."""
    own = beside.line == group[looks.owner[beside.point]]
    instances = len(looks.instances)
    pairs = distinct(beside.station[own] * instances + looks.point_instance[beside.point[own]])
    return pairs // instances, pairs % instances


def line_along(looks: Looks, axes: Axes) -> Index:
    """Return the line that most of each look runs along, -1 where it runs along none, shape (n,)."""
    beside = points_beside(looks, axes)
    owner = looks.owner[beside.point]
    metres = looks.metres[beside.point]
    key, place = np.unique(owner * len(axes.counts) + beside.line, return_inverse=True)
    agrees = np.bincount(place, (1 - (beside.lateral / _limit(looks)) ** 2) * metres)
    much = (np.bincount(place, metres) > looks.curves.length[key // len(axes.counts)] / 2) & (agrees > 0)
    key, agrees = key[much], agrees[much]
    look = key // len(axes.counts)
    best = best_of_each(look, agrees, key)
    found = np.full(len(looks), -1)
    found[look[best]] = key[best] % len(axes.counts)
    return found


def _limit(looks: Looks) -> float:
    """Return how far beside a line a look may lie, metres."""
    return looks.unit * (REACH if looks.instances.footprint is not None else 1.0)


def settle(looks: Looks, group: Index, fit: Fit, kind: Index) -> Index:
    """Give each look to the line that it agrees with over the greatest length.

    Parameters
    ----------
    looks : Looks
        Of one class.
    group : ndarray of int, shape (n,)
        The line of each look so far.
    fit : Fit
        These lines.
    kind : ndarray of int, shape (n,)
        A look stays among those of its kind.

    Returns
    -------
    ndarray of int, shape (n,)
        The line of each look.
    """
    axes = fit.axes
    beside = points_beside(looks, axes, fit.feet.station)
    seen = np.bincount(sightings(looks, group, beside)[0], minlength=len(axes.line))
    owner = looks.owner[beside.point]
    own = beside.line == group[owner]
    others = np.clip(seen[beside.station] - own, 0, _ENOUGH) / _ENOUGH
    limit = _limit(looks)
    of_line = np.zeros(int(axes.line.max(initial=0)) + 1, np.intp)
    of_line[group] = kind
    alike = of_line[beside.line] == kind[owner]
    agreement = (1 - (beside.lateral / limit) ** 2) * others
    # What its local map saw of the line in another look is not what it shows.
    agreement = np.where(_taken(looks, beside, own), -1.0, agreement)
    agrees = alike * agreement * looks.metres[beside.point]
    lines = len(of_line)
    key, place = np.unique(owner * lines + beside.line, return_inverse=True)
    total = np.bincount(place, agrees)
    look, line = key // lines, key % lines
    best = best_of_each(look, total, line != group[look])
    best = best[total[best] > 0]
    settled = group.copy()
    settled[look[best]] = line[best]
    return settled


def _taken(looks: Looks, beside: Beside, own: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Tell where a look runs beside a line that another look of its local map, which is of that line, shows there."""
    foreign = np.flatnonzero(~own)
    found = np.zeros(len(own), dtype=bool)
    if len(foreign) in (0, len(own)):
        return found
    step = len(looks.instances)
    place = beside.station * step + looks.instance[looks.owner[beside.point]]
    there = distinct(place[own])
    # Points are as far apart as stations, so that a neighbour may be the one that the other look has.
    for shift in (-step, 0, step):
        found[foreign] |= among(place[foreign] + shift, there)
    return found
