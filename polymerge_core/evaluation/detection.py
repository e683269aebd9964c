"""Chamfer distance and average precision, as VectorMapNet, MapTR and GlobalMapNet judge a map of elements.

Elements are taken by falling score; each is a true positive where its nearest reference element is within the threshold
(Chamfer distance) and was not found before. Average precision is the area under the envelope of precision over recall.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from polymerge_core.curves import Array, Curves, Index, count_up
from polymerge_core.evaluation.lengths import Followed
from polymerge_core.evaluation.measures import METRES, NONE, Measure, mean_of

#: Thresholds of the Chamfer distance, metres.
THRESHOLDS_M = (0.5, 1.0, 1.5)

#: Points held at once.
_POINTS = 1_000_000


class Found(NamedTuple):
    """The nearest reference element of each element by Chamfer distance, one entry an element."""

    #: -1 where none comes within the largest threshold anywhere.
    reference: Index
    #: Metres; infinite where there is none.
    distance: Array


def nearest_elements(merged: Followed, reference: Followed) -> Found:
    """Find for each element the reference element at the smallest Chamfer distance, among those near it.

    Parameters
    ----------
    merged, reference : Followed
        The elements, each map followed along the other.
    """
    lines, others = merged.curves.lines, reference.curves.lines
    first, second = shapely.STRtree(others).query(lines, predicate="dwithin", distance=THRESHOLDS_M[-1])
    distance = chamfer_distances(merged, reference, first, second)
    order = np.lexsort((second, distance, first))
    best = order[np.diff(first[order], prepend=-1) > 0]
    found = Found(np.full(len(lines), -1), np.full(len(lines), np.inf))
    found.reference[first[best]], found.distance[first[best]] = second[best], distance[best]
    return found


def chamfer_distances(merged: Followed, reference: Followed, first: Index, second: Index) -> Array:
    """Return the Chamfer distance of pairs, metres: the mean of the two ways' mean distance of points to the other."""
    there = _mean_distances(merged, reference.curves, first, second)
    back = _mean_distances(reference, merged.curves, second, first)
    return (there + back) / 2


def _mean_distances(followed: Followed, others: Curves, first: Index, second: Index) -> Array:
    curves, pieces, nearest = followed.curves, followed.pieces, followed.nearest
    counts = np.bincount(pieces.line, minlength=len(curves))
    starts = np.cumsum(counts) - counts
    means = np.empty(len(first))
    portion = np.cumsum(counts[first]) // _POINTS
    for rows in np.split(np.arange(len(first)), np.flatnonzero(np.diff(portion)) + 1):
        owner, number = count_up(counts[first[rows]])
        point, line = starts[first[rows]][owner] + number, second[rows][owner]
        # Most points are nearest to the very line that they are to be measured to.
        distance = nearest.distance[point]
        rest = np.flatnonzero(nearest.line[point] != line)
        middles = curves.points_at(pieces.line[point[rest]], pieces.middle[point[rest]])
        distance[rest] = shapely.distance(others.lines[line[rest]], shapely.points(middles))
        means[rows] = np.bincount(owner, distance, minlength=len(rows)) / counts[first[rows]]
    return means


def detection_measures(found: Found, score: Array, references: int) -> list[Measure]:
    """Return the Chamfer distance, the average precision at each of `THRESHOLDS_M`, and their mean.

    Parameters
    ----------
    found : Found
        From `nearest_elements`, in canonical order, which settles equal scores.
    score : ndarray of float, shape (n,)
        Of the elements.
    references : int
        How many reference elements there are to find.
    """
    order = np.argsort(-score, kind="stable")
    near = [_true_positives(found, order, threshold) for threshold in THRESHOLDS_M]
    precision = [average_precision(hits, references) for hits in near]
    chamfer = np.where(np.isfinite(found.distance), found.distance, np.nan)
    rows = [
        Measure(f"ap_{threshold}", NONE, references, value)
        for threshold, value in zip(THRESHOLDS_M, precision, strict=True)
    ]
    return [mean_of("chamfer", METRES, chamfer), *rows, Measure("ap", NONE, references, float(np.mean(precision)))]


def _true_positives(found: Found, order: Index, threshold: float) -> NDArray[np.bool_]:
    """Tell which elements, by falling score, are the first to come within the threshold of their reference element."""
    reference = found.reference[order]
    hit = np.flatnonzero(found.distance[order] <= threshold)
    _, first = np.unique(reference[hit], return_index=True)
    true = np.zeros(len(order), dtype=bool)
    true[hit[first]] = True
    return true


def average_precision(hits: NDArray[np.bool_], references: int) -> float:
    """Return the area under the envelope of precision over recall; NaN where there is nothing to find.

    Parameters
    ----------
    hits : ndarray of bool, shape (n,)
        Whether each detection is a true positive, by falling score.
    references : int
        How many there are to find.

    Examples
    --------
    >>> average_precision(np.array([True, False, True]), 2)
    0.8333333333333333
    """
    if references == 0:
        return np.nan
    true = np.cumsum(hits)
    precision = true / np.arange(1, len(hits) + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float((envelope * hits).sum() / references)
