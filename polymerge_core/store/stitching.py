"""A place of the map drawn anew, the rest left as it was: lines cut at the edge of the place, and put together there.

Inside the place the new lines count, outside the old ones. Where a new and an old one leave off at the edge near each
other, the old one is led over to the new one along a short way, so that no kink is left.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from polymerge_core.curves import Array, Curves, Index

#: An old line is led over to a new one along so many proximities.
_TRANSITION = 10.0

#: Ends of a new and an old line at the edge belong together up to so many proximities apart, as looks at one line do.
_JOINT = 2.5

#: Less than this along a line is nothing, metres.
_NOTHING = 1e-6


@dataclass(frozen=True)
class Piece:
    """A stretch of a line.

    Parameters
    ----------
    line : LineString
        Metres.
    of : int
        The row of the line that it is of, among the new or the old ones.
    new : bool
        Whether of a new one.
    cut : tuple of bool
        Whether the start and the end lie on the edge of the place.
    """

    line: BaseGeometry
    of: int
    new: bool
    cut: tuple[bool, bool]


class Chain(NamedTuple):
    """A line put together from pieces, in order."""

    line: BaseGeometry
    pieces: tuple[Piece, ...]


def cut_at(lines: NDArray[np.object_], place: BaseGeometry, *, inside: bool, new: bool) -> list[Piece]:
    """Return the pieces of lines that lie inside a place, or outside of it.

    Parameters
    ----------
    lines : ndarray of LineString, shape (n,)
        Open or closed.
    place : Polygon or MultiPolygon
        Prepared.
    inside : bool
        Which pieces to return.
    new : bool
        What the pieces are.
    """
    within = shapely.contains_properly(place, lines)
    apart = shapely.disjoint(place, lines)
    whole = within if inside else apart
    pieces = [Piece(lines[row], int(row), new, (False, False)) for row in np.flatnonzero(whole)]
    for row in np.flatnonzero(~within & ~apart):
        pieces += [Piece(line, int(row), new, ends) for line, ends in _cut(lines[row], place, inside=inside)]
    return pieces


class Stretch(NamedTuple):
    """A stretch of a line, metres from its start, and whether its ends lie on the edge of the place."""

    start: float
    stop: float
    cut: tuple[bool, bool]


def stretches_of(line: BaseGeometry, place: BaseGeometry, *, inside: bool) -> list[Stretch]:
    """Return the stretches of a line that lie inside a place, or outside of it; of a ring as of an open line."""
    crossings = shapely.points(shapely.get_coordinates(shapely.intersection(line, shapely.boundary(place))))
    length = float(line.length)
    places = np.concatenate([[0.0], np.sort(shapely.line_locate_point(line, crossings)), [length]])
    places = places[np.append(True, np.diff(places) > _NOTHING)]
    places[-1] = length
    if len(places) < 2:
        return []
    middle = shapely.line_interpolate_point(line, (places[:-1] + places[1:]) / 2)
    here = shapely.intersects(place, middle) == inside
    return [
        Stretch(float(places[first]), float(places[last + 1]), (first > 0, last < len(here) - 1))
        for first, last in _runs(here)
        if places[last + 1] - places[first] > _NOTHING
    ]


def _cut(line: BaseGeometry, place: BaseGeometry, *, inside: bool) -> list[tuple[BaseGeometry, tuple[bool, bool]]]:
    found = stretches_of(line, place, inside=inside)
    if not found:
        return []
    curves = Curves(np.array([line], dtype=object))
    start, stop = (np.array([getattr(each, name) for each in found]) for name in ("start", "stop"))
    lines = list(curves.stretches(np.zeros(len(found), np.intp), start, stop))
    ends = [list(each.cut) for each in found]
    whole = start[0] == 0.0, stop[-1] == curves.length[0]
    if not curves.closed[0]:
        edge = shapely.distance(shapely.boundary(place), shapely.get_point(line, [0, -1])) < _NOTHING
    elif all(whole) and len(found) > 1:
        # A ring goes on where it ends.
        joined = np.vstack([shapely.get_coordinates(lines[-1]), shapely.get_coordinates(lines[0])[1:]])
        lines, ends = [shapely.linestrings(joined), *lines[1:-1]], [[True, True], *ends[1:-1]]
        edge = np.zeros(2, dtype=bool)
    else:
        edge = np.full(2, not all(whole))
    ends[0][0] |= bool(whole[0] and edge[0])
    ends[-1][1] |= bool(whole[1] and edge[1])
    return [(piece, (cut[0], cut[1])) for piece, cut in zip(lines, ends, strict=True)]


def _runs(chosen: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first and the last of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], chosen.astype(np.int8), [0]])))
    return [(int(first), int(stop) - 1) for first, stop in zip(edges[::2], edges[1::2], strict=True)]


def put_together(pieces: list[Piece], unit: float) -> list[Chain]:
    """Join new pieces to old ones at the edge of the place.

    Parameters
    ----------
    pieces : list of Piece
        Of one class, those inside of new lines and those outside of old ones.
    unit : float
        The proximity, metres.

    Returns
    -------
    list of Chain
        Every piece is in one.
    """
    ends = [(row, side) for row, piece in enumerate(pieces) for side in (0, 1) if piece.cut[side]]
    partner = _partners(pieces, ends, _JOINT * unit)
    left = set(range(len(pieces)))
    chains = []
    # From the free ends on; what is left then are rings.
    starts = [(row, side) for row in range(len(pieces)) for side in (0, 1) if (row, side) not in partner]
    for row, side in [*starts, *((row, 0) for row in range(len(pieces)))]:
        if row in left:
            chains.append(_walk(pieces, partner, left, row, side, unit))
    return chains


def _partners(pieces: list[Piece], ends: list[tuple[int, int]], reach: float) -> dict[tuple[int, int], tuple[int, int]]:
    """Pair ends of new and of old pieces, the nearest first."""
    new = [end for end in ends if pieces[end[0]].new]
    old = [end for end in ends if not pieces[end[0]].new]
    partner: dict[tuple[int, int], tuple[int, int]] = {}
    if not new or not old:
        return partner
    here, there = (np.array([_end(pieces[row].line, side) for row, side in each]) for each in (new, old))
    distance = np.hypot(*(here[:, None] - there[None, :]).transpose(2, 0, 1))
    for number in np.argsort(distance, axis=None, kind="stable"):
        one, other = divmod(int(number), len(old))
        if distance[one, other] > reach:
            break
        if new[one] not in partner and old[other] not in partner:
            partner[new[one]], partner[old[other]] = old[other], new[one]
    return partner


def _end(line: BaseGeometry, side: int) -> Array:
    return np.asarray(shapely.get_coordinates(line)[-side])


def _walk(
    pieces: list[Piece],
    partner: dict[tuple[int, int], tuple[int, int]],
    left: set[int],
    row: int,
    side: int,
    unit: float,
) -> Chain:
    """Follow pieces from an end on."""
    members: list[Piece] = []
    points: list[Array] = []
    first = (row, side)
    while row in left:
        left.discard(row)
        line = shapely.get_coordinates(pieces[row].line)
        if not pieces[row].new:
            for end in (0, 1):
                joint = partner.get((row, end))
                if joint is not None:
                    line = _led_over(line, end, _end(pieces[joint[0]].line, joint[1]), unit)
        line = line if side == 0 else line[::-1]
        points.append(line if not points else line[1:])
        members.append(pieces[row])
        beyond = partner.get((row, 1 - side))
        if beyond is None:
            break
        row, side = beyond
    if len(members) == 1:
        # An area stays one, and a line as it is.
        return Chain(members[0].line, tuple(members))
    joined = np.vstack(points)
    if (row, side) == first:
        joined[-1] = joined[0]
    return Chain(shapely.linestrings(joined), tuple(members))


def _led_over(line: Array, end: int, target: Array, unit: float) -> Array:
    """Move an end of a line to a point, and what lies near it less and less."""
    line = line if end == 0 else line[::-1]
    far = _TRANSITION * unit
    curves = Curves(np.array([shapely.linestrings(line)], dtype=object))
    length = float(curves.length[0])
    step = np.arange(0.0, min(far, length), unit)
    arc = np.union1d(np.round(step, 9), curves.arc)
    arc = arc[np.append(True, np.diff(arc) > _NOTHING)]
    points = curves.points_at(np.zeros(len(arc), np.intp), arc)
    share = np.clip(1 - arc / min(far, length), 0.0, 1.0) if length > 0 else np.ones(len(arc))
    moved = points + share[:, None] * (target - points[0])
    return moved if end == 0 else moved[::-1]


def shares(chain: Chain) -> tuple[Index, NDArray[np.bool_], Array]:
    """Return which lines a chain is of, whether these are new, and the length of each piece."""
    of = np.array([piece.of for piece in chain.pieces], dtype=np.intp)
    new = np.array([piece.new for piece in chain.pieces], dtype=bool)
    return of, new, np.array([piece.line.length for piece in chain.pieces])
