"""What is known of lines and areas, place by place: all that is needed to go on with new observations.

Of a line that means its stations, and at each of them how much is known of it, who saw it and who should have. These
are sums over local maps, so that what is known from some is put together with what is known from others by fitting the
lines as one look that counts for all of them, and by adding.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polymerge_core.consensus.axes import Axes, told_apart
from polymerge_core.consensus.looks import PAST, Instances, Looks
from polymerge_core.consensus.support import Support, stretches_of
from polymerge_core.curves import Array, Index


class KnownLines(NamedTuple):
    """Lines of one class, whether seen often enough or not, by their stations; one entry a station."""

    #: Metres, line after line.
    stations: Array
    #: The line of each station, rising from 0; each has two or more.
    line: Index
    #: Shape (s, 5), what `PAST` names.
    past: Array

    def looks(self, instances: Instances, unit: float) -> Looks:
        """Return the lines as looks of the map that was known before."""
        lines = shapely.linestrings(self.stations, indices=self.line)
        looks = Looks.of(lines, np.full(len(lines), instances.known), np.ones(len(lines)), instances, unit)
        return remembering(looks, looks.owner, self.stations, self.line, self.past)


def remembering(looks: Looks, line: Index, places: Array, of_line: Index, past: Array) -> Looks:
    """Return looks whose points remember what is known of the nearest place of their line, `line` of each point."""
    _, nearest = cKDTree(told_apart(places, of_line)).query(told_apart(looks.points, line), workers=-1)
    return looks.remembering(past[nearest])


def known_lines(axes: Axes, knowledge: Array, support: Support) -> KnownLines:
    """Return what is known after a merge, without the stretches that nobody saw."""
    found = stretches_of(axes, support.seen > 0)
    rows, line = found.stations
    past = np.column_stack([knowledge, *support])
    return KnownLines(axes.stations[rows], line, past[rows])


class KnownAreas(NamedTuple):
    """Areas of one class, whether seen often enough or not; one entry an area."""

    #: Metres.
    polygons: NDArray[np.object_]
    #: Looks that it was made of, by their weights, and whether one of them held it whole.
    weight: Array
    whole: NDArray[np.bool_]
    #: Shape (n, 4), the last four of `PAST`.
    support: Array


def nothing_known() -> KnownAreas:
    """Return what is known of areas before any was seen."""
    return KnownAreas(np.empty(0, object), np.empty(0), np.empty(0, bool), np.empty((0, len(PAST) - 1)))
