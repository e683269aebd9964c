"""Parts of a run that share one progress bar."""

from __future__ import annotations

from typing import NamedTuple

from qgis.core import QgsFeedback


class Part(NamedTuple):
    """A part of a run, between two fractions of the whole."""

    feedback: QgsFeedback
    start: float = 0.0
    end: float = 1.0

    def reached(self, fraction: float) -> None:
        """Say how far this part is."""
        self.feedback.setProgress(100.0 * (self.start + fraction * (self.end - self.start)))

    def pieces(self, count: int) -> list[Part]:
        """Cut it into equal parts."""
        cuts = [self.start + n * (self.end - self.start) / max(count, 1) for n in range(count + 1)]
        return [Part(self.feedback, start, end) for start, end in zip(cuts, cuts[1:])]
