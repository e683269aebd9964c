"""Which looks run alongside each other, over how long, and how far apart: what association starts from.

Alongside is more than near: two lines that touch end to end, cross or fork are near each other without being the same.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from polymerge_core.consensus.axes import Axes
from polymerge_core.consensus.looks import Looks, dot
from polymerge_core.curves import Array, Index, best_of_each, count_up, distinct

#: Looks farther apart than this many proximities are never compared.
REACH = 2.5

#: Lines whose directions differ by more than this do not run alongside, degrees.
ANGLE_DEG = 35.0

#: A pair is looked at every two proximities along the shorter one, at most so often.
_STATIONS = 12

#: Where a pair first comes close is looked for at the first of every so many points of the longer look.
_COARSE = 8

#: Pairs that are measured at a time, so that what is worked out on the way stays small.
_BLOCK = 20_000

#: Looks whose neighbours are listed at a time, for the same reason.
_LOOKS = 2_000

#: Where more looks than this come near one, so many of them tell as much about it as all would.
_PARTNERS = 64


class Pairs(NamedTuple):
    """Pairs of looks that run alongside each other, one entry a pair; each pair once."""

    #: The shorter and the longer one.
    short: Index
    long: Index
    #: Over how much of the shorter one they run alongside, and over how much they run apart, metres.
    overlap: Array
    apart: Array
    #: Over how much of it they run in one direction, alongside or apart, metres.
    parallel: Array
    #: Mean square of their lateral distance where they run alongside, square metres.
    square: Array
    #: 1 where both were digitised in the same direction, -1 where not.
    sense: Array
    #: ``position on the longer = sense * position on the shorter + shift``, metres.
    shift: Array
    #: Share of the overlap that the local maps of both looked at; 0 where footprints are not known.
    covisible: Array

    def take(self, rows: NDArray[np.bool_]) -> Pairs:
        """Return some of the pairs."""
        return Pairs._make(column[rows] for column in self)


def pairs_alongside(looks: Looks, kind: Index) -> Pairs:
    """Find the pairs of looks that run alongside each other, or beside each other too far apart to be the same.

    Parameters
    ----------
    looks : Looks
        Of one class.
    kind : ndarray of int, shape (n,)
        Only looks of one kind are compared.

    Returns
    -------
    Pairs
        Those that run beside each other over two proximities, or over half of the shorter one.
    """
    first, second = _near(looks, kind)
    shorter = looks.curves.length[first] <= looks.curves.length[second]
    short, long = np.where(shorter, first, second), np.where(shorter, second, first)
    # The looks as lines of their points, which lie as close together as stations do.
    drawn = Axes(looks.points, looks.owner)
    blocks = np.array_split(np.arange(len(short)), max(1, len(short) // _BLOCK))
    parts = [_measured(looks, drawn, short[rows], long[rows]) for rows in blocks]
    return Pairs._make(np.concatenate(column) for column in zip(*parts, strict=True))


def _near(looks: Looks, kind: Index) -> tuple[Index, Index]:
    """Return the pairs of looks of one kind that come near each other, each once; the first comes before the second."""
    lines, distance = looks.curves.lines, 2 * REACH * looks.unit
    tree, around = boxes_of_kinds(lines, kind, lines, kind, distance)
    blocks = np.array_split(np.arange(len(lines)), 1 + len(lines) // _LOOKS)
    some = [_some(looks, rows, tree.query(around[rows])) for rows in blocks]
    pairs = distinct(np.concatenate(some))
    first, second = pairs // max(len(lines), 1), pairs % max(len(lines), 1)
    # By parts: an interrupt is not heard before shapely returns.
    parts = np.array_split(np.arange(len(pairs)), 1 + len(pairs) // _BLOCK)
    near = np.concatenate([shapely.dwithin(lines[first[rows]], lines[second[rows]], distance) for rows in parts])
    return first[near], second[near]


def boxes_of_kinds(
    shapes: NDArray[np.object_], kind: Index, others: NDArray[np.object_], other_kind: Index, distance: float
) -> tuple[shapely.STRtree, NDArray[np.object_]]:
    """Return a tree of boxes, and the boxes to ask it with for what of the same kind is within a distance of others.

    Boxes of two kinds are told apart by where they are: what is asked for is all that is found.
    """
    bounds, asked = shapely.bounds(shapes), shapely.bounds(others)
    apart = (np.ptp(bounds[:, ::2]) if len(shapes) else 0.0) + 2 * distance
    bounds[:, ::2] += (kind * apart)[:, None]
    asked[:, ::2] += (other_kind * apart)[:, None]
    asked += np.array([-distance, -distance, distance, distance])
    return shapely.STRtree(shapely.box(*bounds.T)), np.asarray(shapely.box(*asked.T))


def _some(looks: Looks, rows: Index, neighbours: Index) -> Index:
    """Choose the pairs of some looks that are looked at, ``first * number of looks + second``."""
    row, other = neighbours
    mine = rows[row]
    partners = np.bincount(row, minlength=len(rows))[row]
    first, second = np.minimum(mine, other), np.maximum(mine, other)
    # What one local map saw side by side tells lines apart: of that there is little, and all of it counts.
    kept = (looks.instance[mine] == looks.instance[other]) | (_drawn_lot(first, second) * partners < _PARTNERS)
    kept &= first < second
    return first[kept] * len(looks) + second[kept]


def _drawn_lot(first: Index, second: Index) -> Array:
    """Return a number from 0 to 1 for each pair that is as good as random, and always the same (splitmix64)."""
    mixed = first.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + second.astype(np.uint64)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
    return (mixed ^ (mixed >> np.uint64(31))) / 2.0**64


def _measured(looks: Looks, drawn: Axes, short: Index, long: Index) -> Pairs:
    """Measure pairs at some points of the shorter look against the longer one."""
    curves, unit = looks.curves, looks.unit
    points = drawn.counts[short]
    counts = np.clip(points // 2, 2, _STATIONS)
    pair, number = count_up(counts)
    mine, theirs = short[pair], long[pair]
    # Those of the second half mirror those of the first, so that the direction of digitisation does not matter.
    back = number > counts[pair] - 1 - number
    sample = (2 * np.where(back, counts[pair] - 1 - number, number) + 1) * points[pair] // (2 * counts[pair])
    at = drawn.first[mine] + np.where(back, points[pair] - 1 - sample, sample)
    place, position = drawn.stations[at], looks.arc[at]
    feet = drawn.feet(place, theirs, unit, _beside(drawn, at, theirs, number))
    foot = looks.arc[feet.station] + feet.ahead
    cosine = dot(looks.tangent[at], feet.tangent)
    before = (feet.station == drawn.first[theirs]) & (feet.ahead < -0.3 * unit)
    behind = (feet.station == drawn.last[theirs]) & (feet.ahead > 0.3 * unit)
    beyond = ~curves.closed[theirs] & (before | behind)
    straight = np.abs(cosine) > np.cos(np.radians(ANGLE_DEG))
    beside = ~beyond & straight & (np.abs(feet.lateral) <= REACH * unit)

    def total(values: Array) -> Array:
        return np.bincount(pair, values, minlength=len(short)).astype(float)

    seen = np.maximum(total(beside), 1)
    sense = np.where(total(np.where(beside, cosine, 0.0)) < 0, -1.0, 1.0)
    step = curves.length[short] / counts
    there = drawn.stations[feet.station] + feet.ahead[:, None] * feet.tangent
    found = Pairs(
        short,
        long,
        total(beside) * step,
        total(~beside & ~beyond) * step,
        total(straight & ~beyond) * step,
        total(np.where(beside, feet.lateral**2, 0.0)) / seen,
        sense,
        total(np.where(beside, foot - sense[pair] * position, 0.0)) / seen,
        total(beside & _both_looked(looks, mine, theirs, place, there)) / seen,
    )
    return found.take(found.overlap + found.apart >= np.minimum(2 * unit, 0.5 * curves.length[short]))


def _beside(drawn: Axes, at: Index, line: Index, number: Index) -> Index:
    """Return the station of another line that each station is nearest to: those of one look lead from each to the next.

    Parameters
    ----------
    drawn : Axes
        The looks.
    at : ndarray of int, shape (k,)
        Stations, those of one look and one other line after each other.
    line : ndarray of int, shape (k,)
        The other line.
    number : ndarray of int, shape (k,)
        0 for the first of each look, then 1, 2, ...
    """
    points, first, last = drawn.stations[at], drawn.first[line], drawn.last[line]
    found = np.empty(len(at), np.intp)
    rows = np.flatnonzero(number == 0)
    some, sample = count_up((last - first)[rows] // _COARSE + 1)
    tried = np.minimum(first[rows[some]] + sample * _COARSE, last[rows[some]])
    away = ((drawn.stations[tried] - points[rows[some]]) ** 2).sum(axis=1)
    near = tried[best_of_each(some, -away, tried)]
    while len(rows):
        found[rows] = drawn.walked(points[rows], near)
        rows = rows[rows + 1 < len(number)] + 1
        rows = rows[number[rows] > 0]
        # The next one is as far on, in either direction. From here one would not walk past a sharp corner.
        step, here = at[rows] - at[rows - 1], found[rows - 1]
        ways = np.clip(np.stack([here - step, here, here + step]), first[rows], last[rows])
        nearest = ((drawn.stations[ways] - points[rows]) ** 2).sum(axis=2).argmin(axis=0)
        near = ways[nearest, np.arange(len(rows))]
    return found


def _both_looked(looks: Looks, mine: Index, theirs: Index, place: Array, there: Array) -> NDArray[np.bool_]:
    """Tell whether the local map of each of two looks looked at the place of the other one."""
    areas = looks.instances.footprint
    if areas is None:
        return np.zeros(len(mine), dtype=bool)
    first, second = areas[looks.instance[mine]], areas[looks.instance[theirs]]
    return np.asarray(shapely.contains_xy(first, *there.T) & shapely.contains_xy(second, *place.T))
