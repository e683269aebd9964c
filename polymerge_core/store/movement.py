"""Whether a line lies elsewhere since one of the drives: by a step in what drives say of its offset."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from polymerge_core.consensus.alongside import REACH
from polymerge_core.consensus.fusion import CORRELATION, HALF_WEIGHT, MAD
from polymerge_core.curves import Array, Index
from polymerge_core.observations import as_lines
from polymerge_core.store.drive_order import DriveOrder
from polymerge_core.store.places import STEP, Places

#: Whether a line lies elsewhere is judged over so many proximities.
_WINDOW = 40.0

#: How much more or less a drive is off in a square of so many proximities than as a whole: so many, usually.
_LOCAL, _DRIFT = 100.0, 0.3

#: Drives are taken to be at least this far apart in what they say of a line, proximities.
_LEAST = 0.1

#: That drives differ as usual is as sure as if so many had said so.
_USUAL_DRIVES = 6.0


def likelier_moved(
    places: Places,
    elements: gpd.GeoDataFrame,
    seen: pd.DataFrame,
    observations: gpd.GeoDataFrame,
    order: DriveOrder,
    unit: float,
    cost: float,
) -> Array | None:
    """Return how much likelier it is that a line lies elsewhere from a drive on than that it stays; None of no lines.

    Parameters
    ----------
    places : Places
        Along the elements.
    elements, observations : GeoDataFrame
        `class` and the shape of each.
    seen : DataFrame
        `place`, `observation`, `instance`, `own`: who saw what.
    order : DriveOrder
        Of the drives of the local maps.
    unit : float
        The proximity, metres.
    cost : float
        How unlikely a change is, log-odds.

    Returns
    -------
    ndarray of float, shape (places, drives - 1)
        Log-odds before each drive but the first, -inf where nothing can be told.
    """
    own = seen[seen["own"] & np.isfinite(places.normal[seen["place"], 0])]
    if own.empty:
        return None
    place = own["place"].to_numpy()
    lines = as_lines(observations.geometry.to_numpy()[own["observation"]])
    points = shapely.points(places.points[place])
    foot = shapely.get_coordinates(shapely.line_interpolate_point(lines, shapely.line_locate_point(lines, points)))
    away = foot - places.points[place]
    aside = (away * places.normal[place]).sum(axis=1)
    beside = np.hypot(*away.T) - np.abs(aside) < 0.5 * unit
    drives = len(order.first)
    cell = place[beside] * drives + order.drive[own["instance"].to_numpy()[beside]]
    many = np.bincount(cell, minlength=len(places.points) * drives).reshape(-1, drives)
    sums = np.bincount(cell, aside[beside], minlength=many.size).reshape(many.shape)
    offset = np.where(many > 0, sums / np.maximum(many, 1), np.nan)
    within = aside[beside] - offset.ravel()[cell]
    cls = elements["class"].to_numpy()[places.element]
    of_drive, of_looks = _variance(offset, many, within, cell // drives, cls, unit)
    offset = _without_shift(offset, of_drive + of_looks, places, unit)

    half = int(_WINDOW / STEP / 2)
    every = np.arange(len(places.points))
    begin = np.searchsorted(places.element, places.element)
    end = np.searchsorted(places.element, places.element, side="right") - 1
    around = _together(offset, of_drive, of_looks, np.maximum(every - half, begin), np.minimum(every + half, end))
    return _steps(*around, unit, cost)


def _together(offset: Array, of_drive: Array, of_looks: Array, first: Index, last: Index) -> tuple[Array, Array]:
    """Return what drives say of stretches of places, first to last, in the mean, and the variance of that.

    What a drive errs is the same all along; the errors of looks are alike over `CORRELATION` proximities.
    """
    known = np.isfinite(offset)
    sums = []
    for values in (known, np.where(known, offset, 0.0), np.where(known, of_looks, 0.0)):
        total = np.concatenate([np.zeros((1, offset.shape[1])), np.cumsum(values, axis=0)])
        sums.append(total[last + 1] - total[first])
    count, total, looks = sums
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    apart = np.maximum(1.0, count * STEP / CORRELATION)
    return mean, of_drive[first] + looks / np.maximum(count, 1) / apart


def _steps(offset: Array, variance: Array, unit: float, cost: float) -> Array:
    """Return how much likelier a step is than none, before each drive but the first: log-odds, -inf where none can be.

    One drive may be wrong in itself: two must agree on either side.
    """
    gain = np.full((len(offset), offset.shape[1] - 1), -np.inf)
    there = np.isfinite(offset)
    value, spread = np.where(there, offset, 0.0), np.where(there, variance, 0.0)
    for number in range(2, offset.shape[1] - 1):
        sides = (slice(None, number), slice(number, None))
        count = [there[:, side].sum(axis=1) for side in sides]
        enough = (count[0] >= 2) & (count[1] >= 2)
        means = [value[enough, side].sum(axis=1) / n[enough] for side, n in zip(sides, count, strict=True)]
        error = np.sqrt(
            sum(spread[enough, side].sum(axis=1) / n[enough] ** 2 for side, n in zip(sides, count, strict=True))
        )
        # Where drives differ more than usual on either side, a step is less sure.
        apart = sum(
            np.where(there, (value - mean[:, None]) ** 2 / np.where(there, spread, 1.0), 0.0).sum(axis=1)
            for value, there, spread, mean in (
                (value[enough, side], there[enough, side], spread[enough, side], mean)
                for side, mean in zip(sides, means, strict=True)
            )
        )
        free = count[0][enough] + count[1][enough] - 2
        error *= np.sqrt(np.maximum(1.0, (_USUAL_DRIVES + apart) / (_USUAL_DRIVES + free)))
        # Against a step of any size within reach (Occam's factor).
        size = np.log(np.sqrt(2 * np.pi) * error / (2 * REACH * unit))
        gain[enough, number - 1] = 0.5 * ((means[1] - means[0]) / error) ** 2 + size - cost
    return gain


def _without_shift(offset: Array, variance: Array, places: Places, unit: float) -> Array:
    """Take away what a drive is off as a whole, and by how much more or less in each square.

    What all lines share is the vehicle's position, which drifts along its way. In a square a line says one thing.
    """
    known = np.isfinite(offset)
    usual = np.nanmedian(np.where(known.any(axis=1, keepdims=True), offset, 0.0), axis=1, keepdims=True)
    row, drive = np.nonzero(known)
    deviation = np.sqrt(variance[row, drive])
    across = places.normal[row] / deviation[:, None]
    said = (offset - usual)[row, drive] / deviation
    said -= (across * _shift(drive, across, said, np.ones(len(row)), 1.0)).sum(axis=1)
    _, square = np.unique(np.floor(places.points / (_LOCAL * unit)), axis=0, return_inverse=True)
    group = np.unique(np.column_stack([square.ravel()[row], drive]), axis=0, return_inverse=True)[1].ravel()
    _, line, times = np.unique(
        np.column_stack([group, places.element[row]]), axis=0, return_inverse=True, return_counts=True
    )
    said -= (across * _shift(group, across, said, 1.0 / times[line.ravel()], _DRIFT * unit)).sum(axis=1)
    left = offset.copy()
    left[row, drive] = said * deviation + usual[row, 0]
    return left


def _shift(group: Index, across: Array, said: Array, weight: Array, usual: float) -> Array:
    """Return for each row the shift that the rows of its group say together, robustly; of usual size before they do."""
    held = weight.copy()
    shift = np.zeros((group.max(initial=-1) + 1, 2))
    for _ in range(10):
        sums = np.zeros((len(shift), 2, 3))
        np.add.at(sums, group, (held[:, None] * across)[:, :, None] * np.column_stack([across, said])[:, None, :])
        shift = np.linalg.solve(sums[:, :, :2] + np.eye(2) / usual**2, sums[:, :, 2:])[:, :, 0]
        # Cauchy's weights: what moved does not count.
        held = weight / (1 + ((said - (across * shift[group]).sum(axis=1)) / HALF_WEIGHT) ** 2)
    # Two places say what two numbers are.
    shift[np.bincount(group, minlength=len(shift)) < 3] = 0.0
    return shift[group]


def _variance(
    offset: Array, many: Index, within: Array, place: Index, cls: NDArray[np.object_], unit: float
) -> tuple[Array, Array]:
    """Return the variance of what each drive says of each place: its own, and that of its looks over their number."""
    least = (_LEAST * unit) ** 2
    of_drive, of_looks = np.full((len(offset), 1), least), np.zeros(offset.shape)
    for name in np.unique(cls.astype(str)):
        rows = cls == name
        single = rows[place] & (within != 0)
        look = (MAD * float(np.median(np.abs(within[single])))) ** 2 if single.any() else (0.3 * unit) ** 2
        # From one drive to the next; where the road changes between two of them their difference is large.
        steps = [step[np.isfinite(step)] for step in np.diff(offset[rows], axis=1).T]
        spread = [(MAD * float(np.median(np.abs(step)))) ** 2 for step in steps if len(step)]
        own = float(np.median(spread)) / 2 if spread else least
        usual = float(np.mean(1.0 / many[rows][many[rows] > 0])) if (many[rows] > 0).any() else 1.0
        of_drive[rows] = max(least, own - look * usual)
        of_looks[rows] = look / np.maximum(many[rows], 1)
    return of_drive, of_looks
