"""Distances between two curves: discrete Frechet (DF) and partial curve mapping (PCM); paper, section IV."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import similaritymeasures
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: Cells of one antidiagonal that are worked on at once: what the processor keeps at hand.
_CELLS = 64_000

#: A section shorter than this (metres) is a point, and has no direction to turn by.
_POINT_M = 1e-9


def frechet_distances(first: Sequence[ArrayLike], second: Sequence[ArrayLike]) -> Array:
    """Return the discrete Frechet distance of each pair of curves.

    Parameters
    ----------
    first, second : sequence of array_like of float, shape (n, 2) each
        The curves by their points, metres; equally many curves.

    Returns
    -------
    ndarray of float, shape (m,)
        Metres; the same as `similaritymeasures.frechet_dist` of each pair.

    Examples
    --------
    >>> frechet_distances([[(0, 0), (4, 0)]], [[(0, 3), (4, 3)]]).tolist()
    [3.0]
    """
    sides = []
    for curves in (first, second):
        points = [np.asarray(curve, dtype=float) for curve in curves]
        bounds = np.cumsum([0, *map(len, points)])
        sides.append((np.concatenate(points) if points else np.empty((0, 2)), bounds))
    (one, bounds), (other, others) = sides
    return frechet_of_flat(one, bounds, other, others)


def frechet_of_flat(first: Array, bounds: NDArray[np.intp], second: Array, others: NDArray[np.intp]) -> Array:
    """Return the discrete Frechet distance of pairs of curves that are given one after the other.

    Pairs of like size are worked through side by side, one antidiagonal of the table of coupled points at a time. (GEOS
    has the measure too, but takes a second for two curves of a thousand points that do not lie along each other.)

    Parameters
    ----------
    first, second : ndarray of float, shape (k, 2) and (l, 2)
        Points of all curves, metres.
    bounds, others : ndarray of int, shape (m + 1,)
        Where each curve starts in them, and the end.

    Returns
    -------
    ndarray of float, shape (m,)
        Metres.
    """
    n, m = np.diff(bounds), np.diff(others)
    found = np.empty(len(n))
    order = np.lexsort((m, n))
    start = 0
    while start < len(order):
        # The shorter ones are lengthened by their last point, which changes nothing, so sizes must be alike.
        like = np.searchsorted(n[order], 1.1 * n[order[start]] + 4, side="right")
        stop = min(like, start + max(1, _CELLS // int(n[order[start]])))
        rows = order[start:stop]
        rows = rows[np.argsort(m[rows], kind="stable")]
        found[rows] = _side_by_side(_padded(first, bounds, rows), _padded(second, others, rows))
        start = stop
    return found


def _padded(points: Array, bounds: NDArray[np.intp], rows: NDArray[np.intp]) -> Array:
    """Return the points of some curves, shape (2, longest, len(rows)), the shorter ones staying at their last point."""
    size = np.diff(bounds)[rows]
    index = bounds[rows] + np.minimum(np.arange(size.max())[:, None], size - 1)
    return np.ascontiguousarray(np.moveaxis(points[index], -1, 0))


def _side_by_side(one: Array, other: Array) -> Array:
    (x, y), (u, v) = one, np.ascontiguousarray(other[:, ::-1])
    n, m = len(x), len(u)
    # Row i of the table at index i + 1; what was never reached is infinitely far.
    older, newer = np.full((2, n + 1, x.shape[1]), np.inf)
    older[0] = 0.0
    for diagonal in range(n + m - 1):
        low, high = max(0, diagonal - m + 1), min(n, diagonal + 1)
        there = slice(low + m - 1 - diagonal, high + m - 1 - diagonal)
        dx, dy = x[low:high] - u[there], y[low:high] - v[there]
        dx *= dx
        dy *= dy
        dx += dy
        reached = np.minimum(newer[low + 1 : high + 1], newer[low:high])
        np.minimum(reached, older[low:high], out=reached)
        np.maximum(reached, dx, out=older[low + 1 : high + 1])
        if diagonal == 0:
            older[0] = np.inf
        older, newer = newer, older
    return np.sqrt(newer[n])


def partial_curve_mapping(reference: Array, estimate: Array) -> float:
    """Return the PCM of two curves in a frame turned so that the reference's chord lies at 45 degrees.

    As it is defined (Witowski and Stander 2012, as `similaritymeasures` computes it), it is normalised by the bounding
    box: undefined for a horizontal line, and many times larger for the same pair in another direction.

    Parameters
    ----------
    reference, estimate : ndarray of float, shape (n, 2) and (m, 2)
        Metres.

    Returns
    -------
    float
        The smallest over both directions of both curves; NaN where the reference is a point.
    """
    chord = reference[-1] - reference[0]
    if np.hypot(*chord) < _POINT_M:
        # A ring has no chord: its longest diameter from its first vertex serves.
        # In regular shapes several are as long, and rounding errors must not choose among them.
        far = reference[np.argmax(np.round(np.hypot(*(reference - reference[0]).T), 9))]
        chord = far - reference[0]
    angle = np.pi / 4 - np.arctan2(chord[1], chord[0])
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.array([[cosine, sine], [-sine, cosine]])
    return raw_partial_curve_mapping((reference - reference[0]) @ turn, (estimate - reference[0]) @ turn)


def raw_partial_curve_mapping(reference: Array, estimate: Array) -> float:
    """Return the PCM of two curves as they lie, the smallest over both directions of both; NaN where undefined.

    The measure weighs errors by how far along the curves they are, so each of the four differs.
    """
    if np.ptp(reference, axis=0).max() < _POINT_M:
        return np.nan
    directions = itertools.product((reference, reference[::-1]), (estimate, estimate[::-1]))
    with np.errstate(all="ignore"):
        found = [similaritymeasures.pcm(curve, other) for curve, other in directions]
    known = [value for value in found if np.isfinite(value)]
    return float(min(known)) if known else np.nan
