"""Measures by length: how much of a map is right, how much of the reference is there, how often, in how many parts.

Both maps are cut into pieces of at most half a metre, and each piece asks for the nearest line of the other map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from polymerge_core.curves import Array, Curves, Index, Pieces, turning
from polymerge_core.evaluation.measures import METRES, NONE, RADIANS_PER_METRE, SHARE, Measure, mean_of, ratio
from polymerge_core.evaluation.nearest import Nearest, NearestLine
from polymerge_core.evaluation.region import Counts

#: Longest piece, metres.
STEP_M = 0.5

#: A line farther than this from every reference line has no lateral error: it is wrong, metres.
LATERAL_M = 1.5

#: Precision and recall are given at these distances, metres.
DISTANCES_M = (0.5, 1.0)

# A piece whose ends fall this many times its length apart has leapt from one part of a line to another.
_LEAP = 4.0

# Positions along a line are known to this, metres.
_ROUNDING_M = 1e-6


@dataclass(frozen=True)
class Followed:
    """A map followed piece by piece, and where each piece's middle falls on the other map."""

    curves: Curves
    pieces: Pieces
    #: Which pieces count.
    counts: NDArray[np.bool_]
    nearest: Nearest

    @property
    def length(self) -> float:
        """Length that counts, metres."""
        return float(self.pieces.length[self.counts].sum())

    def share_within(self, distance: float) -> float:
        """Length that counts and lies within a distance of the other map, metres."""
        near = self.counts & (self.nearest.distance <= distance)
        return float(self.pieces.length[near].sum())


def follow(curves: Curves, others: NearestLine, counts: Counts) -> Followed:
    """Cut a map into pieces and look up the nearest line of the other map for each."""
    pieces = curves.pieces(STEP_M)
    middles = curves.points_at(pieces.line, pieces.middle)
    return Followed(curves, pieces, counts(middles), others(middles))


def coverage_measures(merged: Followed, reference: Followed) -> list[Measure]:
    """Return precision, recall and F1 by length at each of `DISTANCES_M`."""
    found = []
    for distance in DISTANCES_M:
        precision = ratio(
            f"precision_{distance}", SHARE, merged.share_within(distance), merged.length, int(merged.counts.sum())
        )
        recall = ratio(
            f"recall_{distance}", SHARE, reference.share_within(distance), reference.length, int(reference.counts.sum())
        )
        both = precision.value + recall.value
        harmonic = 2 * precision.value * recall.value / both if both > 0 else both
        found += [precision, recall, Measure(f"f1_{distance}", SHARE, precision.n + recall.n, harmonic)]
    return found


def lateral_measures(merged: Followed) -> list[Measure]:
    """Return the lateral error of the points that have a reference within `LATERAL_M`, and the share that has none."""
    distance = merged.nearest.distance[merged.counts]
    error = distance[np.isfinite(distance)]
    known = len(error) > 0
    median, high = np.percentile(error, [50, 95]).tolist() if known else (np.nan, np.nan)
    rms = float(np.sqrt(np.mean(error**2))) if known else np.nan
    return [
        mean_of("lateral", METRES, error),
        Measure("lateral_median", METRES, len(error), median),
        Measure("lateral_rms", METRES, len(error), rms),
        Measure("lateral_p95", METRES, len(error), high),
        ratio("lateral_beyond", SHARE, len(distance) - len(error), len(distance), len(distance)),
    ]


def duplication(merged: Followed, reference: Curves) -> Measure:
    """Return the merged length over the reference length that it covers perpendicularly: 1 is right, 2 is doubled."""
    if len(reference) == 0:
        return ratio("duplication", NONE, 0.0, 0.0, 0)
    # From middle to middle: both must fall on one line, and not beyond its end.
    foot, pieces = merged.nearest, merged.pieces
    first = np.flatnonzero(pieces.line[:-1] == pieces.line[1:])
    length_m = pieces.length[first]
    line, start, stop = foot.line[first], foot.position[first], foot.position[first + 1]
    same = (line >= 0) & (line == foot.line[first + 1]) & merged.counts[first] & merged.counts[first + 1]
    # On a ring the shorter way counts, which may lead over its start.
    around, length = reference.closed[line], reference.length[line]
    stop = np.where(around, start + (stop - start + length / 2) % length - length / 2, stop)
    still = np.abs(stop - start) <= _ROUNDING_M
    at_end = (start <= _ROUNDING_M) | (start >= length - _ROUNDING_M)
    used = same & ~(~around & still & at_end) & (np.abs(stop - start) <= _LEAP * length_m)
    covered = _union(reference, line[used], np.minimum(start, stop)[used], np.maximum(start, stop)[used])
    return ratio("duplication", NONE, float(length_m[used].sum()), covered, int(used.sum()))


def _union(curves: Curves, line: Index, low: Array, high: Array) -> float:
    """Return the length that intervals of lines cover together; those of rings may lead over the start."""
    length = curves.length[line]
    before, after = np.flatnonzero(low < 0), np.flatnonzero(high > length)
    laid = (np.cumsum(curves.length) - curves.length)[line]
    low, high = (
        np.concatenate([laid + np.clip(low, 0, length), (laid + length + low)[before], laid[after]]),
        np.concatenate([laid + np.clip(high, 0, length), (laid + length)[before], (laid + high - length)[after]]),
    )
    order = np.argsort(low, kind="stable")
    low, high = low[order], high[order]
    reached = np.maximum.accumulate(high)
    before_it = np.concatenate([low[:1], reached[:-1]])
    return float(np.maximum(high - np.maximum(low, before_it), 0.0).sum())


def fragments(merged: Followed) -> Measure:
    """Return how many elements lie along a reference line, over the lines that have any: 1 is right."""
    used = merged.counts & (merged.nearest.line >= 0)
    table = pd.DataFrame(
        {"element": merged.pieces.line[used], "reference": merged.nearest.line[used], "m": merged.pieces.length[used]}
    )
    shared = table.groupby(["element", "reference"], as_index=False)["m"].sum()
    longest = shared.sort_values(["element", "m", "reference"], ascending=[True, False, True])
    own = longest.drop_duplicates("element")
    return mean_of("fragments", NONE, own["reference"].value_counts(sort=False).to_numpy(dtype=float))


def zigzag(name: str, followed: Followed, counts: Counts) -> Measure:
    """Return the absolute turning of what counts over its length."""
    curves = followed.curves
    turn = turning(curves)[counts(curves.vertices)].sum()
    return ratio(name, RADIANS_PER_METRE, float(turn), followed.length, len(curves))


def stretches_that_count(followed: Followed) -> tuple[Curves, Index]:
    """Return the stretches of a map that count, and the line of each; a line that counts as a whole stays as it is."""
    curves, pieces, counts = followed.curves, followed.pieces, followed.counts
    if counts.all():
        return curves, np.arange(len(curves))
    first = np.diff(pieces.line, prepend=-1) > 0
    begins = counts & (first | ~np.concatenate([[False], counts[:-1]]))
    run = np.cumsum(begins)[counts] - 1
    if len(run) == 0:
        return Curves(np.empty(0, dtype=object)), np.empty(0, np.intp)
    line = pieces.line[begins]
    ends = np.flatnonzero(np.diff(run, append=run[-1] + 1))
    start, stop = pieces.start[begins], pieces.stop[counts][ends]
    whole = (start == 0.0) & np.isclose(stop, curves.length[line])
    lines = curves.lines[line].copy()
    part = np.flatnonzero(~whole)
    lines[part] = curves.stretches(line[part], start[part], stop[part])
    return Curves(lines), line
