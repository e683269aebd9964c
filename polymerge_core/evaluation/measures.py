"""One figure of the table of measures: a value by itself, or the mean of many with their spread."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

METRES, SHARE, RADIANS_PER_METRE, NONE = "m", "share", "rad/m", ""


class Measure(NamedTuple):
    """A row of the table of measures, without its class."""

    measure: str
    unit: str
    n: int
    value: float
    min: float = np.nan
    max: float = np.nan
    std: float = np.nan


def mean_of(name: str, unit: str, values: NDArray[np.float64]) -> Measure:
    """Return the mean of values with their spread; NaNs are left out."""
    known = values[~np.isnan(values)]
    if len(known) == 0:
        return Measure(name, unit, 0, np.nan)
    spread = (float(known.mean()), float(known.min()), float(known.max()), float(known.std()))
    return Measure(name, unit, len(known), *spread)


def ratio(name: str, unit: str, part: float, whole: float, n: int) -> Measure:
    """Return a part of a whole; NaN where there is no whole."""
    return Measure(name, unit, n, float(part / whole) if whole > 0 else np.nan)
