"""Which reference lines an estimate is compared with, over which section, and how far apart they are (DF).

A reference line may be far longer than what was seen of it, so an estimate is compared with the section of the
reference between the projections of its two ends, both followed at steps of 0.25 m.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from polymerge_core.curves import Array, Curves, Index, count_up
from polymerge_core.evaluation.frechet import frechet_of_flat
from polymerge_core.network import check_pairs

#: Both lines are followed at steps of at most this, metres.
STEP_M = 0.25

#: An estimate and a reference line are compared where a vertex of one is nearer than this to the other, metres.
CHECK_M = 1.0

#: A ring is laid over another one from this many of its vertices, at most.
_STARTS = 8

#: Points held at once.
_POINTS = 2_000_000


@dataclass(frozen=True)
class Sections:
    """Pairs of an estimate and a reference line, over a stretch of each; one entry a pair."""

    estimate: Index
    reference: Index
    #: Stretch of the estimate, metres along it.
    start: Array
    stop: Array
    #: Stretch of the reference that answers to it, metres along it, in the estimate's direction.
    reference_start: Array
    reference_stop: Array
    #: Discrete Frechet distance, metres.
    frechet: Array

    def __len__(self) -> int:
        return len(self.estimate)

    def take(self, rows: Index | NDArray[np.bool_]) -> Sections:
        """Return some of the pairs."""
        return Sections(**{entry.name: getattr(self, entry.name)[rows] for entry in fields(self)})

    def best(self) -> Index:
        """Return the row of the smallest distance of each estimate that has any, in the order of the estimates."""
        order = np.lexsort((self.reference, self.frechet, self.estimate))
        first = np.diff(self.estimate[order], prepend=-1) > 0
        return order[first]


def match(estimates: Curves, references: Curves) -> Sections:
    """Compare estimates with the reference lines that pass the check of the paper (section II-B, Alg. 1).

    Parameters
    ----------
    estimates, references : Curves
        Of one class, metres.

    Returns
    -------
    Sections
        One entry a pair that passes, ordered by estimate, then reference.
    """
    estimate, reference = check_pairs(estimates.lines, references.lines, CHECK_M)
    return compare(estimates, references, estimate, reference)


def compare(estimates: Curves, references: Curves, estimate: Index, reference: Index) -> Sections:
    """Measure given pairs: the section of the reference, and DF, the smallest of both directions and a ring's starts.

    Parameters
    ----------
    estimates, references : Curves
        Metres.
    estimate, reference : ndarray of int, shape (m,)
        The pairs.

    Returns
    -------
    Sections
        In the order of the pairs.
    """
    pair, tried = _candidates(estimates, references, estimate, reference)
    tried = replace(tried, frechet=section_frechet(estimates, references, tried))
    # Starts of a ring are often equally good; rounding errors must not choose among them.
    order = np.lexsort((np.round(tried.frechet, 9), pair))
    return tried.take(order[np.diff(pair[order], prepend=-1) > 0])


def section_frechet(first: Curves, second: Curves, sections: Sections) -> Array:
    """Return DF of each pair of stretches, the smaller of both directions, shape (m,), metres."""
    found = np.empty(len(sections))
    size = np.abs(sections.stop - sections.start) + np.abs(sections.reference_stop - sections.reference_start)
    portion = np.cumsum(size / STEP_M + 4) // _POINTS
    for rows in np.split(np.arange(len(sections)), np.flatnonzero(np.diff(portion)) + 1):
        part = sections.take(rows)
        points, owner = first.resampled(part.estimate, part.start, part.stop, STEP_M)
        others, whose = second.resampled(part.reference, part.reference_start, part.reference_stop, STEP_M)
        found[rows] = _both_directions(points, owner, others, whose)
    return found


def _both_directions(points: Array, owner: Index, others: Array, whose: Index) -> Array:
    if len(points) == 0:
        return np.empty(0)
    count = int(owner[-1]) + 1
    bounds, limits = (np.append(0, np.cumsum(np.bincount(each, minlength=count))) for each in (owner, whose))
    distance = frechet_of_flat(points, bounds, others, limits)
    first, last, start, stop = points[bounds[:-1]], points[bounds[1:] - 1], others[limits[:-1]], others[limits[1:] - 1]
    # Both ends must be matched, so a direction whose ends are farther apart cannot be the better one.
    least = np.maximum(np.hypot(*(first - stop).T), np.hypot(*(last - start).T))
    rows = np.flatnonzero(least < distance)
    if len(rows):
        chosen = np.isin(owner, rows)
        backwards = points[bounds[owner] + bounds[owner + 1] - 1 - np.arange(len(points))][chosen]
        theirs = others[np.isin(whose, rows)]
        some, rest = (np.append(0, np.cumsum(np.diff(each)[rows])) for each in (bounds, limits))
        distance[rows] = np.minimum(distance[rows], frechet_of_flat(backwards, some, theirs, rest))
    return distance


def _candidates(estimates: Curves, references: Curves, estimate: Index, reference: Index) -> tuple[Index, Sections]:
    """Return the stretches to compare, and which pair each belongs to: rings leave a choice of start and way round."""
    ring, around = estimates.closed[estimate], references.closed[reference]
    open_pair, ring_pair = np.flatnonzero(~ring), np.flatnonzero(ring)
    both, both_sections = _open_candidates(estimates, references, estimate[open_pair], reference[open_pair])
    starts, ring_sections = _ring_candidates(
        estimates, references, estimate[ring_pair], reference[ring_pair], around[ring_pair]
    )
    parts = (both_sections, ring_sections)
    joined = [np.concatenate([getattr(part, entry.name) for part in parts]) for entry in fields(Sections)]
    return np.concatenate([open_pair[both], ring_pair[starts]]), Sections(*joined)


def _open_candidates(
    estimates: Curves, references: Curves, estimate: Index, reference: Index
) -> tuple[Index, Sections]:
    """Return the section between the projections of an open line's ends; on a ring, both ways round."""
    start, stop = np.zeros(len(estimate)), estimates.length[estimate]
    first = references.locate(reference, estimates.points_at(estimate, start))
    last = references.locate(reference, estimates.points_at(estimate, stop))
    around = references.closed[reference]
    length = references.length[reference]
    onward = np.where(around, first + (last - first) % length, last)
    back = first - (first - last) % length
    rows = np.concatenate([np.arange(len(estimate)), np.flatnonzero(around)])
    ends = np.concatenate([onward, back[around]])
    unknown = np.full(len(rows), np.nan)
    return rows, Sections(estimate[rows], reference[rows], start[rows], stop[rows], first[rows], ends, unknown)


def _ring_candidates(
    estimates: Curves, references: Curves, estimate: Index, reference: Index, around: NDArray[np.bool_]
) -> tuple[Index, Sections]:
    """Return a ring from several of its vertices on: once round a ring, or over all that it reaches of an open line."""
    vertices = np.diff(estimates.bounds)[estimate] - 1
    tried = np.minimum(vertices, _STARTS)
    rows, number = count_up(tried)
    vertex = estimates.bounds[estimate][rows] + number * vertices[rows] // tried[rows]
    start = estimates.arc[vertex]
    length = references.length[reference]
    low, high = _reach(estimates, references, estimate, reference)
    first = np.where(around[rows], references.locate(reference[rows], estimates.vertices[vertex]), low[rows])
    last = np.where(around[rows], first + length[rows], high[rows])
    stop = start + estimates.length[estimate][rows]
    unknown = np.full(len(rows), np.nan)
    return rows, Sections(estimate[rows], reference[rows], start, stop, first, last, unknown)


def _reach(estimates: Curves, references: Curves, estimate: Index, reference: Index) -> tuple[Array, Array]:
    """Return the least and the greatest position on the reference that a vertex of the estimate falls on."""
    if len(estimate) == 0:
        return np.empty(0), np.empty(0)
    rows, number = count_up(np.diff(estimates.bounds)[estimate])
    position = references.locate(reference[rows], estimates.vertices[estimates.bounds[estimate][rows] + number])
    first = np.flatnonzero(np.diff(rows, prepend=-1))
    return np.minimum.reduceat(position, first), np.maximum.reduceat(position, first)
