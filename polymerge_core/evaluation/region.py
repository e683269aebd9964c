"""Which part of a map counts: only what was looked at can be right or wrong."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import shapely
from numpy.typing import NDArray

from polymerge_core.curves import Array, Curves
from polymerge_core.evaluation.nearest import NearestLine

#: The reference within this of an observation of its class was observed, metres.
OBSERVED_M = 2.0

#: Tells which points count, (n, 2) metres to (n,) of bool.
Counts = Callable[[Array], NDArray[np.bool_]]


def everywhere(points: Array) -> NDArray[np.bool_]:
    """Count every point."""
    return np.ones(len(points), dtype=bool)


def within(polygons: NDArray[np.object_]) -> Counts:
    """Count the points inside any of the polygons."""
    area = shapely.union_all(polygons)
    shapely.prepare(area)
    return lambda points: shapely.intersects_xy(area, points)


def near(observations: Curves) -> Counts:
    """Count the points within `OBSERVED_M` of any of the observations."""
    nearest = NearestLine(observations, OBSERVED_M)
    return lambda points: np.isfinite(nearest(points).distance)
