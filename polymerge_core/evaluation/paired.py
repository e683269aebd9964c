"""Is the merged map better than one look? Each observation against the merged element, over the same stretch."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray

from polymerge_core.curves import Array, Curves
from polymerge_core.evaluation.matching import Sections, compare, match, section_frechet
from polymerge_core.evaluation.measures import METRES, SHARE, Measure, mean_of, ratio


def paired_errors(
    observations: Curves, merged: Curves, reference: Curves, whole: NDArray[np.bool_] | None
) -> tuple[Array, Array]:
    """Measure observations and the merged map against the same stretches of the reference.

    Parameters
    ----------
    observations, merged, reference : Curves
        Of one class, metres.
    whole : ndarray of bool, optional
        Of areas: whether the local map of each observation holds its reference area whole can only be told by
        `holds_whole`; the observations to use.

    Returns
    -------
    before, after : ndarray of float, shape (m,)
        DF of each observation that has a reference line and a merged element near, and of that element over the same
        stretch, metres.
    """
    seen = match(observations, reference)
    seen = seen.take(seen.best())
    if whole is not None:
        seen = seen.take(whole[seen.estimate])
    drawn = match(observations, merged)
    drawn = drawn.take(drawn.best())
    _, mine, theirs = np.intersect1d(seen.estimate, drawn.estimate, return_indices=True)
    seen, drawn = seen.take(mine), drawn.take(theirs)
    after = _over_the_same_stretch(merged, reference, seen, drawn)
    # What was seen as a ring is compared as a ring: where the observation starts says nothing about the element.
    element, line = drawn.reference, seen.reference
    rings = np.flatnonzero(observations.closed[seen.estimate] & merged.closed[element] & reference.closed[line])
    after[rings] = compare(merged, reference, element[rings], line[rings]).frechet
    return seen.frechet, after


def _over_the_same_stretch(merged: Curves, reference: Curves, seen: Sections, drawn: Sections) -> Array:
    """Return DF between the stretch of the element and that of the reference that the same observation answers to."""
    stretch = Sections(
        drawn.reference,
        seen.reference,
        drawn.reference_start,
        drawn.reference_stop,
        seen.reference_start,
        seen.reference_stop,
        np.full(len(seen), np.nan),
    )
    return section_frechet(merged, reference, stretch)


def paired_measures(before: Array, after: Array) -> list[Measure]:
    """Return the means of both, and the share of observations that the merged map is better than."""
    better = int((after < before).sum())
    return [
        mean_of("frechet_before", METRES, before),
        mean_of("frechet_after", METRES, after),
        ratio("after_better", SHARE, better, len(before), len(before)),
    ]


def holds_whole(
    observations: Curves, reference: Curves, footprints: NDArray[np.object_], footprint: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Tell of each observation whether its footprint holds its best reference line whole; yes where none is known."""
    seen = match(observations, reference)
    seen = seen.take(seen.best())
    whole = np.ones(len(observations), dtype=bool)
    known = np.flatnonzero(footprint[seen.estimate] >= 0)
    areas = footprints[footprint[seen.estimate[known]]]
    whole[seen.estimate[known]] = shapely.covers(areas, reference.lines[seen.reference[known]])
    return whole
