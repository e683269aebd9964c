"""One line from all looks at it: robust, weighted by what is known of the noise, smooth.

At every station of a line its looks say how far to the left of it the true line lies. What the looks of one drive say
is put together first, then the drives, because the frames of one drive share its errors of calibration and position.
Looks that disagree with the others count less (iteratively reweighted least squares with Cauchy's weights), and how
much noise there is, near the vehicle and far from it, is estimated from the looks themselves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polymerge_core.consensus.alongside import REACH
from polymerge_core.consensus.axes import Axes, Feet
from polymerge_core.consensus.looks import DRIVES, Looks
from polymerge_core.curves import Array, Index

#: The errors along a look are alike over this many proximities, so that it counts as one measurement over each of them.
CORRELATION = 20.0

#: A residual of so many standard deviations counts half: for normal errors a mean weighted so is 95 % efficient.
HALF_WEIGHT = 2.385

#: Median absolute deviation to standard deviation, for normal errors.
MAD = 1.4826

#: Noise is taken to be at least this many proximities: less is told apart by nobody, and weights stay finite.
_LEAST = 0.01

#: Noise before any is known, proximities.
FIRST_NOISE = 0.4

#: What all looks of a drive have in common never shows between them, such as a camera that draws everything near the
#: vehicle too far left. It is taken to be this much, proximities, so that no look counts far more than all others.
SHARED = 0.4

_TINY = float(np.finfo(float).tiny)
_BINS = 6
_FEW = 30


class Fit(NamedTuple):
    """Lines fitted to looks.

    Parameters
    ----------
    axes : Axes
        The lines.
    feet : Feet
        Where each point of the looks falls on its line.
    used : ndarray of bool, shape (p,)
        Which points lie beside their line.
    sigma : ndarray of float, shape (p,)
        Standard deviation of a look's lateral error at each point, metres.
    drive_sigma : float
        Standard deviation of the lateral error that all looks of a drive share, metres.
    knowledge : ndarray of float, shape (s,)
        How much the looks say of each station: 1 / variance, 1 / m2, but for what drives share.
    error : ndarray of float, shape (s,)
        Standard error of each station, metres.
    """

    axes: Axes
    feet: Feet
    used: NDArray[np.bool_]
    sigma: Array
    drive_sigma: float
    knowledge: Array
    error: Array


@dataclass(frozen=True)
class Noise:
    """What is known of the looks' errors: `sigma` of each point and `drive_sigma`, metres."""

    sigma: Array
    drive_sigma: float = 0.0

    @classmethod
    def unknown(cls, looks: Looks) -> Noise:
        """Return the noise to begin with."""
        return cls(np.full(len(looks.points), FIRST_NOISE * looks.unit))


def fuse(looks: Looks, group: Index, axes: Axes, noise: Noise, *, rounds: int = 2, near: Index | None = None) -> Fit:
    """Fit lines to their looks.

    Parameters
    ----------
    looks : Looks
        Of one class.
    group : ndarray of int, shape (n,)
        The line of each look.
    axes : Axes
        The lines to begin with.
    noise : Noise
        What is known of the errors.
    rounds : int, default 2
        How often the lines are moved and the looks projected onto them anew.
    near : ndarray of int, shape (p,), optional
        A station of its line that is near each point, where that is known already.

    Returns
    -------
    Fit
        The noise in it is estimated anew from the residuals.
    """
    line = group[looks.owner]
    knowledge = error = np.empty(0)
    feet = axes.feet(looks.points, line, looks.unit, near)
    used = np.zeros(len(line), dtype=bool)
    for _ in range(rounds):
        even = axes.reaching(feet, line).spaced(looks.unit)
        feet, used = _feet(looks, even, line, even.again(axes, feet.station))
        axes = even
        offset, weight, error, knowledge = map(axes.around, _offsets(looks, feet, used, noise, len(axes.line)))
        # Rounding must not open a ring.
        moved = axes.around(axes.stations + offset[:, None] * axes.normal)
        axes = Axes(moved, axes.line).smoothed(weight)
        feet, used = _feet(looks, axes, line, feet.station)
    sigma = _noise_by_distance(looks, group, feet, used)
    return Fit(axes, feet, used, sigma, _noise_of_drives(looks, feet, used, sigma), knowledge, error)


def _feet(looks: Looks, axes: Axes, line: Index, near: Index) -> tuple[Feet, NDArray[np.bool_]]:
    feet = axes.feet(looks.points, line, looks.unit, near)
    return feet, feet.beside & (np.abs(feet.lateral) <= 2 * REACH * looks.unit)


def _offsets(
    looks: Looks, feet: Feet, used: NDArray[np.bool_], noise: Noise, count: int
) -> tuple[Array, Array, Array, Array]:
    """Return how far to the left of each station its looks lie, how much they count, its error, and what is known."""
    rows = np.flatnonzero(used)
    station, lateral, sigma = feet.station[rows], feet.lateral[rows], noise.sigma[rows]
    drive = looks.instances.drive[looks.point_instance[rows]]
    drives = int(drive.max(initial=0)) + 1
    cell, place = np.unique(station * drives + drive, return_inverse=True)
    of_cell = cell // drives
    share = looks.weight[looks.owner[rows]] * looks.metres[rows] / looks.unit
    information = share / (sigma**2 + (SHARED * looks.unit) ** 2)
    known = looks.knowledge[rows]
    before = np.isfinite(known)
    # What was known is the outcome of many looks, and of so many drives: no single one that could stray.
    information = np.where(before, known * looks.metres[rows] / looks.unit, information)
    sigma, share = np.where(before, 1.0, sigma), np.where(before, np.maximum(information, _TINY), share)
    points_before = np.bincount(place, before)
    drives_before = np.bincount(place, np.where(before, looks.past[rows, DRIVES], 0.0)) / np.maximum(points_before, 1)
    of_before = points_before > 0
    drive_sigma = noise.drive_sigma / np.sqrt(np.maximum(drives_before, 1.0))
    middle, scale = np.zeros(count), HALF_WEIGHT * sigma
    offset, weight, error, knowledge = middle, middle, middle, middle
    for _ in range(3):
        robust = information / (1 + np.where(before, 0.0, (lateral - middle[station]) / scale) ** 2)
        total = np.maximum(np.bincount(place, robust), _TINY)
        said = np.bincount(place, robust * lateral) / total
        own = np.bincount(place, robust**2 * sigma**2 / np.maximum(share, _TINY)) / total / total
        sure = 1.0 / (drive_sigma**2 + 1.0 / total)
        if noise.drive_sigma > 0:
            off = (said - middle[of_cell]) / (HALF_WEIGHT * 2 * noise.drive_sigma)
            sure /= 1 + np.where(of_before, 0.0, off) ** 2
        weight = np.bincount(of_cell, sure, minlength=count).astype(float)
        some = np.maximum(weight, _TINY)
        offset = middle = np.bincount(of_cell, sure * said, minlength=count) / some
        variance = np.bincount(of_cell, sure**2 * (drive_sigma**2 + own), minlength=count) / some / some
        error = np.where(weight > 0, np.sqrt(variance), np.inf)
        knowledge = np.bincount(of_cell, total, minlength=count).astype(float)
    return offset, weight, error, knowledge


def _noise_by_distance(looks: Looks, group: Index, feet: Feet, used: NDArray[np.bool_]) -> Array:
    """Estimate the standard deviation of the lateral error at each point, linear in the distance from the vehicle."""
    size = np.bincount(group)[group]
    judged = np.flatnonzero(used & (size >= 3)[looks.owner] & np.isnan(looks.knowledge))
    least = _LEAST * looks.unit
    if len(judged) < _FEW:
        return np.full(len(used), FIRST_NOISE * looks.unit)
    residual, distance = np.abs(feet.lateral[judged]), looks.distance
    edges = np.unique(np.quantile(distance[judged], np.linspace(0, 1, _BINS + 1)))
    if len(edges) < 3:
        return np.full(len(used), max(least, MAD * float(np.median(residual))))
    bin_of = np.clip(np.searchsorted(edges, distance[judged], side="right") - 1, 0, len(edges) - 2)
    where = np.array([distance[judged][bin_of == number].mean() for number in range(len(edges) - 1)])
    spread = np.array([MAD * np.median(residual[bin_of == number]) for number in range(len(edges) - 1)])
    slope = max(0.0, float(np.polyfit(where, spread, 1)[0]))
    base = max(0.2 * float(spread.mean()), float(spread.mean() - slope * where.mean()))
    return np.maximum(least, base + slope * distance)


def _noise_of_drives(looks: Looks, feet: Feet, used: NDArray[np.bool_], sigma: Array) -> float:
    """Estimate the standard deviation of the lateral error that the looks of a drive share; 0 where one drove alone."""
    rows = np.flatnonzero(used & np.isnan(looks.knowledge))
    drive = looks.instances.drive[looks.point_instance[rows]]
    drives = int(drive.max(initial=0)) + 1
    cell, place, number = np.unique(feet.station[rows] * drives + drive, return_inverse=True, return_counts=True)
    station, seen = np.unique(cell // drives, return_counts=True)
    judged = (seen >= 3)[np.searchsorted(station, cell // drives)]
    if not judged.any():
        return 0.0
    mean = np.bincount(place, feet.lateral[rows]) / number
    own = np.bincount(place, sigma[rows] ** 2) / number**2
    spread = MAD * float(np.median(np.abs(mean[judged])))
    return float(np.sqrt(max(0.0, spread**2 - float(np.median(own[judged])))))
