"""Which looks run alongside each other, over how long, and how far apart: what association starts from.

Alongside is more than near: two lines that touch end to end, cross or fork are near each other without being the same.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from polymerge_core.consensus.looks import Looks, cross, direction_at, dot
from polymerge_core.curves import Array, Index, count_up

#: Looks farther apart than this many proximities are never compared.
REACH = 2.5

#: Lines whose directions differ by more than this do not run alongside, degrees.
ANGLE_DEG = 35.0

#: A pair is looked at every two proximities along the shorter one, at most so often.
_STATIONS = 12


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
    curves, unit = looks.curves, looks.unit
    first, second = curves.within(2 * REACH * unit)
    alike = kind[first] == kind[second]
    first, second = first[alike], second[alike]
    shorter = curves.length[first] <= curves.length[second]
    short, long = np.where(shorter, first, second), np.where(shorter, second, first)
    counts = np.clip(np.ceil(curves.length[short] / (2 * unit)), 2, _STATIONS).astype(np.intp)
    pair, number = count_up(counts)
    mine, theirs = short[pair], long[pair]
    position = (number + 0.5) / counts[pair] * curves.length[mine]
    place = curves.points_at(mine, position)
    foot = curves.locate(theirs, place)
    there = curves.points_at(theirs, foot)
    tangent = direction_at(curves, theirs, foot, unit)
    offset = place - there
    lateral, ahead = cross(tangent, offset), dot(tangent, offset)
    cosine = dot(direction_at(curves, mine, position, unit), tangent)
    at_end = ~curves.closed[theirs] & ((foot <= 0.0) | (foot >= curves.length[theirs]))
    beyond = at_end & (np.abs(ahead) > 0.3 * unit)
    straight = np.abs(cosine) > np.cos(np.radians(ANGLE_DEG))
    beside = ~beyond & straight & (np.abs(lateral) <= REACH * unit)

    def total(values: Array) -> Array:
        return np.bincount(pair, values, minlength=len(short)).astype(float)

    seen = np.maximum(total(beside), 1)
    sense = np.where(total(np.where(beside, cosine, 0.0)) < 0, -1.0, 1.0)
    step = curves.length[short] / counts
    found = Pairs(
        short,
        long,
        total(beside) * step,
        total(~beside & ~beyond) * step,
        total(straight & ~beyond) * step,
        total(np.where(beside, lateral**2, 0.0)) / seen,
        sense,
        total(np.where(beside, foot - sense[pair] * position, 0.0)) / seen,
        total(beside & _both_looked(looks, mine, theirs, place, there)) / seen,
    )
    return found.take(found.overlap + found.apart >= np.minimum(2 * unit, 0.5 * curves.length[short]))


def _both_looked(looks: Looks, mine: Index, theirs: Index, place: Array, there: Array) -> NDArray[np.bool_]:
    """Tell whether the local map of each of two looks looked at the place of the other one."""
    areas = looks.instances.footprint
    if areas is None:
        return np.zeros(len(mine), dtype=bool)
    first, second = areas[looks.instance[mine]], areas[looks.instance[theirs]]
    return np.asarray(shapely.contains_xy(first, *there.T) & shapely.contains_xy(second, *place.T))
