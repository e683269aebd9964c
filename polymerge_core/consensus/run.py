"""From observations to the merged map: the consensus of every class, and which piece of which observation is in it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from polymerge_core.consensus.areas import Areas
from polymerge_core.consensus.given import read_looks
from polymerge_core.consensus.lines import Lines, merge_lines
from polymerge_core.consensus.looks import Looks
from polymerge_core.consensus.meetings import met
from polymerge_core.consensus.registration import centres, corrected
from polymerge_core.consensus.support import succession
from polymerge_core.curves import Array, Curves, Index
from polymerge_core.observations import MIN_SEGMENT_M, Observations, list_left_out
from polymerge_core.options import Options
from polymerge_core.schema import LocalMaps
from polymerge_core.sets import ElementSets

#: Why a piece of an observation is in no element.
UNSUPPORTED = "seen by too few of the local maps that looked there"

#: What is less than this is nothing.
_ROUNDING = 1e-6

#: An observation is not cut into pieces shorter than this, proximities.
_PIECE = 2.0


@dataclass(frozen=True)
class Consensus:
    """The merged map in the terms of the observations.

    Parameters
    ----------
    observations : Observations
        One row a piece of an observation that went into an element; what went into none is in its `left_out`.
    sets : ElementSets
        Which pieces are which element.
    shapes : ndarray of shapely geometries, shape (m,)
        Of the elements, metres.
    columns : dict of ndarray
        `score` and `sigma_m` of the elements.
    corrections : ndarray of float, shape (k, 3)
        How each local map was moved: metres east and north, radians counter-clockwise.
    """

    observations: Observations
    sets: ElementSets
    shapes: NDArray[np.object_]
    columns: dict[str, Array]
    corrections: Array


class _Pieces(NamedTuple):
    """Pieces of observations: the observation, from where to where as shares of it, and its element (-1: none)."""

    row: Index
    start: Array
    stop: Array
    element: Index


def merge_by_consensus(
    observations: Observations, local_maps: Sequence[LocalMaps], options: Options, advance: Callable[[float], object]
) -> Consensus:
    """Merge all observations, class by class.

    Parameters
    ----------
    observations : Observations
        All of them, main map first.
    local_maps : sequence of LocalMaps
        Where they came from, with what is known of the local maps.
    options : Options
        The proximity.
    advance : callable
        Called with the share done.

    Returns
    -------
    Consensus
        Elements by class; lines before areas. Elements of the main map take part as what was known before.

    Raises
    ------
    InputError
        If the proximity is too small for so much length.
    """
    given = read_looks(observations, local_maps, options)
    looks = [given.looks_of(rows) for _, rows in given.lines]
    lines, corrections, drift = merge_lines(looks, lambda share: advance(0.9 * share))
    shapes = given.followed(looks, corrections, drift)
    found: list[Lines | Areas] = []
    pieces: list[_Pieces] = []
    for (_, rows), each, seen in zip(given.lines, lines, looks, strict=True):
        pieces.append(_pieces_of_lines(rows, each, seen, sum(len(one.shapes) for one in found), _PIECE))
        found.append(each)
    for _, rows in given.areas:
        area = given.merge_areas(shapes, rows)
        pieces.append(_pieces_of_areas(rows, area, sum(len(one.shapes) for one in found)))
        found.append(area)
    advance(1.0)
    moved = corrections[np.arange(len(corrections)) != given.instances.known]
    merged, used = _put_together(observations, found, _joined(pieces), moved)
    return replace(merged, shapes=_meeting(merged, used, lines, looks, corrections))


def _meeting(
    merged: Consensus, used: Index, lines: list[Lines], looks: list[Looks], corrections: Array
) -> NDArray[np.object_]:
    """Return the shapes, the lines of all classes drawn to what they meet; they come before the areas."""
    shapes = merged.shapes
    first = np.cumsum([0, *(len(each.shapes) for each in lines)])
    count = int(np.searchsorted(used, first[-1]))
    if count == 0:
        return shapes
    number = np.full(first[-1] + 1, -1)
    number[used[:count]] = np.arange(count)
    # What was left out, -1, has the last number, which is no element.
    element = [
        number[np.where(each.element < 0, -1, each.element + start)]
        for each, start in zip(lines, first[:-1], strict=True)
    ]
    alone = np.diff(merged.sets.bounds) == 1
    centre = centres(looks, len(corrections))
    moved = [corrected(each, corrections, centre) for each in looks]
    return np.concatenate([met(shapes[:count], moved, element, alone[:count]), shapes[count:]])


def _pieces_of_lines(rows: Index, lines: Lines, looks: Looks, first: int, shortest: float) -> _Pieces:
    """Cut observations where their points went into another element, or into none."""
    owner, arc, element = looks.owner, looks.arc, _steady(lines, looks, shortest)
    begins = (np.diff(owner, prepend=-1) != 0) | (np.diff(element, prepend=-2) != 0)
    run = np.flatnonzero(begins)
    length = looks.curves.length[owner[run]]
    # Halfway between the last point of one piece and the first of the next.
    before = np.where(run > 0, arc[run - 1], 0.0)
    opens = np.diff(owner[run], prepend=-1) != 0
    start = np.where(opens, 0.0, (before + arc[run]) / 2)
    stop = np.append(start[1:], 0.0)
    last = np.append(opens[1:], [True])
    number = element[run]
    where = np.where(number >= 0, number + first, -1)
    return _Pieces(rows[owner[run]], start / length, np.where(last, 1.0, stop / length), where)


def _steady(lines: Lines, looks: Looks, shortest: float) -> Index:
    """Give pieces too short to be told apart to the piece before them, or after, of the same observation."""
    owner, element = looks.owner, lines.element
    for _ in range(3):
        begins = np.flatnonzero((np.diff(owner, prepend=-1) != 0) | (np.diff(element, prepend=-2) != 0))
        size = np.diff(np.append(begins, len(owner)))
        metres = np.add.reduceat(looks.metres, begins) if len(begins) else np.empty(0)
        short = np.flatnonzero(metres < shortest * looks.unit)
        same_before = (short > 0) & (owner[begins[short]] == owner[begins[np.maximum(short - 1, 0)]])
        after = np.minimum(short + 1, len(begins) - 1)
        same_after = (short < len(begins) - 1) & (owner[begins[short]] == owner[begins[after]])
        taken = np.where(same_before, short - 1, np.where(same_after, after, short))
        # All at once: what is short on both sides takes the name that its neighbour had.
        element = np.repeat(_renamed(element[begins], short, taken), size)
    return element


def _renamed(values: Index, rows: Index, taken: Index) -> Index:
    renamed = values.copy()
    renamed[rows] = values[taken]
    return renamed


def _pieces_of_areas(rows: Index, areas: Areas, first: int) -> _Pieces:
    number = np.where(areas.element >= 0, areas.element + first, -1)
    return _Pieces(rows, np.zeros(len(rows)), np.ones(len(rows)), number)


def _joined(pieces: list[_Pieces]) -> _Pieces:
    if not pieces:
        none = np.empty(0, np.intp)
        return _Pieces(none, np.empty(0), np.empty(0), none)
    return _Pieces._make(np.concatenate(column) for column in zip(*pieces, strict=True))


def _put_together(
    observations: Observations, found: list[Lines | Areas], pieces: _Pieces, corrections: Array
) -> tuple[Consensus, Index]:
    """Make the tables of a merge from elements and pieces, and say which of the elements found are in it.

    An element that no piece is left of is none.
    """
    order = np.lexsort((pieces.start, pieces.row))
    pieces = _Pieces._make(column[order] for column in pieces)
    inside = pieces.element >= 0
    used = np.unique(pieces.element[inside])
    table = _piece_table(observations.table, pieces)
    component = np.searchsorted(used, pieces.element[inside])
    kept = table[inside].reset_index(drop=True)
    shapes, sigma, seen, expected = (
        np.concatenate([getattr(each, name) for each in found])[used] if found else np.empty(0, dtype=object)
        for name in ("shapes", "sigma", "seen", "expected")
    )
    left_out = list_left_out([observations.left_out, table[~inside].assign(reason=UNSUPPORTED)])
    chosen = replace(
        observations,
        table=kept,
        attributes=observations.attributes.iloc[pieces.row[inside]].reset_index(drop=True),
        left_out=left_out,
    )
    sets = _sets(kept, component, len(used))
    base = kept.iloc[sets.base]
    # What nothing was merged into stays as it is. A scribble that turns back on itself may average out to a point: it
    # is better told by its longest look.
    alone = np.diff(sets.bounds) == 1
    stay = alone | (shapely.length(shapes) <= MIN_SEGMENT_M)
    shapes = np.where(stay, base["shape"].to_numpy(dtype=object), shapes)
    known = base["sigma"].to_numpy(dtype=float)
    untouched = alone & base["is_main"].to_numpy(dtype=bool) & np.isfinite(known)
    columns = {
        "score": _scores(kept, component, seen.astype(float), expected.astype(float)),
        "sigma_m": np.where(untouched, known, sigma.astype(float)),
    }
    return Consensus(chosen, sets, shapes, columns, corrections), used


def _scores(pieces: pd.DataFrame, component: Index, seen: Array, expected: Array) -> Array:
    """Return how surely one that looks there sees each element: the mean score, times how often it was seen there."""
    count = len(seen)
    total = np.bincount(component, pieces["weight"], count)
    mean = np.bincount(component, pieces["weight"] * pieces["score"], count) / np.maximum(total, 1)
    # The score of a main map's element says already how surely it is seen: all that is asked is what is new.
    known = np.bincount(component, pieces["is_main"], count) > 0
    share = np.where(known, seen / np.maximum(expected, np.maximum(seen, 1.0)), succession(seen, expected))
    return np.asarray(np.where(expected > np.where(known, seen + _ROUNDING, 0.0), mean * share, mean))


def _piece_table(table: pd.DataFrame, pieces: _Pieces) -> pd.DataFrame:
    """Return one row a piece; only the first one of an observation in an element counts as an observation of it."""
    rows = table.iloc[pieces.row].reset_index(drop=True)
    whole = (pieces.start == 0.0) & (pieces.stop == 1.0)
    extent = rows["length_m"].to_numpy(dtype=float)
    begin = rows["from_m"].to_numpy(dtype=float)
    rows["to_m"] = np.where(pieces.stop == 1.0, rows["to_m"], begin + pieces.stop * extent)
    rows["from_m"] = begin + pieces.start * extent
    rows["length_m"] = (pieces.stop - pieces.start) * extent
    cut = np.flatnonzero(~whole)
    for column in ("shape", "original"):
        geometry = rows[column].to_numpy(dtype=object, copy=True)
        geometry[cut] = _substrings(geometry[cut], pieces.start[cut], pieces.stop[cut])
        rows[column] = geometry
    again = pd.DataFrame({"row": pieces.row, "element": pieces.element}).duplicated().to_numpy()
    rows.loc[again, ["weight", "looks"]] = 0
    return rows


def _substrings(lines: NDArray[np.object_], start: Array, stop: Array) -> NDArray[np.object_]:
    if len(lines) == 0:
        return lines
    curves = Curves(lines)
    return curves.stretches(np.arange(len(lines)), start * curves.length, stop * curves.length)


def _sets(table: pd.DataFrame, component: Index, count: int) -> ElementSets:
    """Return the elements as sets of pieces; the base is the main map's piece, else the longest."""
    position = np.arange(len(table))
    main = table["is_main"].to_numpy(dtype=bool)
    order = np.lexsort((position, -table["length_m"].round(6), ~main, component))
    bounds = np.append(0, np.cumsum(np.bincount(component, minlength=count)))
    return ElementSets(component, order[bounds[:-1]], order, bounds)


def describe_corrections(corrections: Array) -> dict[str, Any]:
    """Return how far the local maps were moved, ready for JSON."""
    if len(corrections) == 0:
        return {"shift_m_median": 0.0, "shift_m_max": 0.0, "turn_deg_max": 0.0}
    shift = np.hypot(corrections[:, 0], corrections[:, 1])
    return {
        "shift_m_median": round(float(np.median(shift)), 3),
        "shift_m_max": round(float(shift.max()), 3),
        "turn_deg_max": round(float(np.degrees(np.abs(corrections[:, 2]).max())), 3),
    }
