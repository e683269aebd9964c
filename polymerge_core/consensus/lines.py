"""The consensus of lines: association, fusion, registration, membership and support, in this order.

References
----------
Expectation maximisation for lane maps from fleet data: arXiv 2305.02080. Principal curves: Hastie and Stuetzle 1989.
Registration of what one pose saw as a whole: Besl and McKay 1992. Each module names its own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from polymerge_core.consensus.alongside import Pairs, pairs_alongside
from polymerge_core.consensus.association import associate
from polymerge_core.consensus.fusion import Fit, Noise, fuse
from polymerge_core.consensus.layout import first_axes
from polymerge_core.consensus.looks import Looks
from polymerge_core.consensus.membership import settle
from polymerge_core.consensus.registration import centres, corrected, corrections, equations
from polymerge_core.consensus.support import Stretches, Support, stretch_of, support, supported_stretches
from polymerge_core.curves import Array, Index

#: Looks are given to the lines anew at most so often; by then they have settled.
_ROUNDS = 3

#: How often the drives are corrected, and their lines put together anew.
_DRIVES = 2

#: How often the local maps are corrected, and the lines fitted anew.
_CORRECTIONS = 2

#: Vertices that leave the line where it is within this share of a proximity are left out of it.
_TOLERANCE = 0.005


class Lines(NamedTuple):
    """The merged lines of one class.

    Parameters
    ----------
    shapes : ndarray of LineString, shape (m,)
        Metres.
    sigma : ndarray of float, shape (m,)
        Median standard error along each, metres.
    seen, expected : ndarray of float, shape (m,)
        How many local maps saw a place of each, in the mean, and how many should have; expected is 0 where footprints
        are not known.
    element : ndarray of int, shape (p,)
        The merged line that each point went into; -1 where it was left out.
    """

    shapes: NDArray[np.object_]
    sigma: Array
    seen: Array
    expected: Array
    element: Index


class _State(NamedTuple):
    """One class on its way."""

    looks: Looks
    #: The line of each look.
    group: Index
    fit: Fit


def merge_lines(classes: list[Looks], advance: Callable[[float], object]) -> tuple[list[Lines], Array]:
    """Merge the looks at lines of all classes.

    Parameters
    ----------
    classes : list of Looks
        One entry a class; they share their instances.
    advance : callable
        Called with the share done.

    Returns
    -------
    lines : list of Lines
        One entry a class.
    correction : ndarray of float, shape (k, 3)
        How each local map was moved: metres east and north, radians counter-clockwise.
    """
    if not classes:
        return [], np.zeros((0, 3))
    states = []
    for number, looks in enumerate(classes):
        states.append(_trace_by_drive(looks))
        advance(0.6 * (number + 1) / len(classes))
    centre = centres(classes, len(classes[0].instances))
    moved = np.zeros((len(centre), 3))
    for number in range(_CORRECTIONS):
        states, step = _register(states, centre, moved)
        moved += step
        advance(0.6 + 0.35 * (number + 1) / _CORRECTIONS)
    return [_finish(state) for state in states], moved


def _trace_by_drive(looks: Looks) -> _State:
    """Put together what each drive saw, then what the drives saw.

    Frames of one drive share their errors, so that they lie close together; and what a drive saw as a whole is long
    enough to tell which of the other drives' lines it runs along.
    """
    drive = looks.instances.drive[looks.instance]
    state = trace(looks, drive)
    if len(np.unique(drive)) == 1:
        return state
    owner = np.zeros(len(state.fit.axes.curves), np.intp)
    owner[state.group] = drive
    tracks = Looks.of(state.fit.axes.curves.lines, owner, np.ones(len(owner)), looks.instances.by_drive(), looks.unit)
    every = np.zeros(len(tracks), np.intp)
    lines = trace(tracks, every)
    centre = centres([tracks], len(tracks.instances))
    moved = np.zeros((len(centre), 3))
    for _ in range(_DRIVES):
        for _ in range(_CORRECTIONS):
            (lines,), step = _register([lines], centre, moved)
            looks = corrected(looks, step[looks.instances.drive], centre[looks.instances.drive])
            moved += step
        lines = trace(lines.looks.redrawn(), every)
    group = lines.group[state.group]
    fit = fuse(looks, group, lines.fit.axes, Noise(state.fit.sigma, lines.fit.drive_sigma))
    return _State(looks, group, fit)


def trace(looks: Looks, kind: Index) -> _State:
    """Find the lines that looks show.

    Parameters
    ----------
    looks : Looks
        Of one class.
    kind : ndarray of int, shape (n,)
        Only looks of one kind can show the same line.

    Returns
    -------
    State
        The line of each look, and the lines.
    """
    pairs = pairs_alongside(looks, kind)
    group = _connected(looks, pairs, associate(looks, pairs))
    state = _begin(looks, pairs, group, Noise.unknown(looks))
    for _ in range(_ROUNDS):
        group = _connected(looks, pairs, settle(looks, state.fit.axes, state.group, kind))
        if np.array_equal(group, state.group):
            break
        state = _begin(looks, pairs, group, Noise(state.fit.sigma, state.fit.drive_sigma))
    return state


def _begin(looks: Looks, pairs: Pairs, group: Index, noise: Noise) -> _State:
    weight = looks.weight[looks.owner] * looks.metres / noise.sigma**2
    return _State(looks, group, fuse(looks, group, first_axes(looks, pairs, group, weight), noise))


def _register(states: list[_State], centre: Array, so_far: Array) -> tuple[list[_State], Array]:
    """Correct the local maps by the lines of all classes, and fit these anew."""
    total = equations(states[0].looks, states[0].fit, centre)
    for state in states[1:]:
        total = total.add(equations(state.looks, state.fit, centre))
    step = corrections(total, so_far, states[0].looks.unit)
    found = []
    for state in states:
        looks = corrected(state.looks, step, centre)
        noise = Noise(state.fit.sigma, state.fit.drive_sigma)
        found.append(_State(looks, state.group, fuse(looks, state.group, state.fit.axes, noise, rounds=1)))
    return found, step


def _connected(looks: Looks, pairs: Pairs, group: Index) -> Index:
    """Take groups apart that no pairs of looks alongside each other hold together; number them by their first look."""
    own = (group[pairs.short] == group[pairs.long]) & (pairs.overlap > 0)
    joined = (np.ones(int(own.sum())), (pairs.short[own], pairs.long[own]))
    _, part = connected_components(coo_array(joined, shape=(len(looks), len(looks))), directed=False)
    return pd.factorize(part)[0]


def _finish(state: _State) -> Lines:
    """Trim the lines to what is supported, and say where each point of the looks went."""
    looks, fit = state.looks, state.fit
    found = support(looks, state.group, fit.axes)
    stretches = supported_stretches(fit.axes, found)
    shapes = _shapes(fit.axes.stations, stretches, _TOLERANCE * looks.unit)
    element = stretch_of(stretches, fit.feet.station)
    return Lines(shapes, *_means(found, fit.error, stretches), element)


def _shapes(stations: Array, stretches: Stretches, tolerance: float) -> NDArray[np.object_]:
    size = stretches.last - stretches.first + 1
    owner = np.repeat(np.arange(len(size)), size)
    rows = np.arange(len(owner)) - np.repeat(np.cumsum(size) - size, size) + stretches.first[owner]
    if len(owner) == 0:
        return np.empty(0, dtype=object)
    drawn = shapely.linestrings(stations[rows], indices=owner)
    shapes: NDArray[np.object_] = shapely.simplify(drawn, tolerance)
    return shapes


def _means(found: Support, error: Array, stretches: Stretches) -> tuple[Array, Array, Array]:
    """Return the median standard error and the mean support of each stretch."""
    stretch = stretch_of(stretches, np.arange(len(error)))
    inside = stretch >= 0
    sigma = pd.Series(error[inside]).groupby(stretch[inside]).median().to_numpy()
    totals = [np.concatenate([[0.0], np.cumsum(values)]) for values in (found.seen, found.expected)]
    size = stretches.last - stretches.first + 1
    seen, expected = ((total[stretches.last + 1] - total[stretches.first]) / size for total in totals)
    return sigma, seen, expected
