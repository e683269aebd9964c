"""Partial curve mapping of a sample of pairs: it takes milliseconds a pair, too long for every pair of a large map."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from polymerge_core.curves import Curves
from polymerge_core.evaluation.frechet import partial_curve_mapping, raw_partial_curve_mapping
from polymerge_core.evaluation.matching import STEP_M, Sections
from polymerge_core.evaluation.measures import NONE, Measure, mean_of

#: At most so many pairs are mapped, of all classes together.
MAX_PAIRS = 2000

_KINDS = ("pcm_best", "pcm_check", "pcm_raw_best", "pcm_raw_check")


class PcmSample:
    """Pairs of each class, and their PCM.

    Parameters
    ----------
    classes : sequence of (Curves, Curves, Sections)
        Estimates, references and all pairs of each class.
    rows : list of ndarray of int
        The pairs of each class that are in the sample.
    """

    def __init__(self, classes: Sequence[tuple[Curves, Curves, Sections]], rows: list[NDArray[np.intp]]) -> None:
        self._classes, self._rows = classes, rows
        self._turned = [np.full(len(each), np.nan) for each in rows]
        self._raw = [np.full(len(each), np.nan) for each in rows]

    @property
    def count(self) -> int:
        """Number of pairs in the sample."""
        return sum(map(len, self._rows))

    def measure(self, advance: Callable[[float], object]) -> None:
        """Map all pairs of the sample; `advance` is called with the share done."""
        done = 0
        for number, (estimates, references, sections) in enumerate(self._classes):
            part = sections.take(self._rows[number])
            for row in range(len(part)):
                one = part.take(np.array([row]))
                drawn, _ = estimates.resampled(one.estimate, one.start, one.stop, STEP_M)
                true, _ = references.resampled(one.reference, one.reference_start, one.reference_stop, STEP_M)
                self._turned[number][row] = partial_curve_mapping(true, drawn)
                self._raw[number][row] = raw_partial_curve_mapping(true, drawn)
                done += 1
                advance(done / self.count)

    def measures(self, number: int) -> list[Measure]:
        """Return the measures of one class, by its number."""
        sections, rows = self._classes[number][2], self._rows[number]
        best = np.isin(rows, sections.best())
        turned, raw = self._turned[number], self._raw[number]
        values = (turned[best], turned, raw[best], raw)
        return [mean_of(name, NONE, each) for name, each in zip(_KINDS, values, strict=True)]


def sample_pairs(classes: Sequence[tuple[Curves, Curves, Sections]]) -> PcmSample:
    """Choose at most `MAX_PAIRS` pairs: of each class its share, spread evenly over small and large distances.

    Parameters
    ----------
    classes : sequence of (Curves, Curves, Sections)
        Estimates, references and all pairs of each class.

    Returns
    -------
    PcmSample
        All pairs where there are few enough.
    """
    total = sum(len(sections) for _, _, sections in classes)
    rows = []
    for _, _, sections in classes:
        wanted = len(sections) if total <= MAX_PAIRS else MAX_PAIRS * len(sections) // total
        # Best matches and others alternate in no order that a file could change: by distance within each kind.
        best = np.isin(np.arange(len(sections)), sections.best())
        order = np.lexsort((sections.frechet, best))
        picked = (np.arange(wanted) * len(sections)) // max(wanted, 1)
        rows.append(np.sort(order[picked]))
    return PcmSample(classes, rows)
