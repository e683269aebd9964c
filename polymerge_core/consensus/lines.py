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
from numpy.typing import NDArray

from polymerge_core.consensus.drift import Drift, no_drift
from polymerge_core.consensus.drives import join_drives
from polymerge_core.consensus.fusion import Fit
from polymerge_core.consensus.known import KnownLines, known_lines
from polymerge_core.consensus.looks import PAST, Looks
from polymerge_core.consensus.registration import centres, corrections, equations
from polymerge_core.consensus.support import Support, means, shapes_of, stretch_of, support, supported_stretches
from polymerge_core.consensus.tracing import State, moved, trace
from polymerge_core.curves import Array, Index

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
    known : KnownLines
        What is known of all lines, also of those that too few saw so far.
    """

    shapes: NDArray[np.object_]
    sigma: Array
    seen: Array
    expected: Array
    element: Index
    known: KnownLines


def merge_lines(classes: list[Looks], advance: Callable[[float], object]) -> tuple[list[Lines], Array, Drift]:
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
    drift : Drift
        The part of it that is the drives'.
    """
    if not classes:
        return [], np.zeros((0, 3)), no_drift()
    instances, unit = classes[0].instances, classes[0].unit
    states = []
    done, every = 0, max(1, sum(len(looks.points) for looks in classes))
    for looks in classes:
        points = len(looks.points)

        def part(share: float, done: int = done, points: int = points) -> None:
            advance(0.6 * (done + share * points) / every)

        states.append(trace(looks, instances.drive[looks.instance], part))
        done += points
    advance(0.6)
    centre = centres(classes, len(instances))
    shifted, corrected = np.zeros((len(centre), 3)), np.zeros((len(centre), 3))
    drift = no_drift()
    if len(np.unique(instances.drive)) > 1:
        states, shifted[:, :2], drift = join_drives(states, centre)
    for number in range(_CORRECTIONS):
        total = equations(states[0].looks, states[0].fit, centre)
        for state in states[1:]:
            total = total.add(equations(state.looks, state.fit, centre))
        step = corrections(total, corrected, unit)
        if instances.known >= 0:
            # It has been shifted by its share, as the drives were.
            step[instances.known] = 0.0
        states = [moved(state, step, centre) for state in states]
        corrected += step
        advance(0.6 + 0.35 * (number + 1) / _CORRECTIONS)
    return [_finish(state) for state in states], shifted + corrected, drift


def _finish(state: State) -> Lines:
    """Trim the lines to what is supported, and say where each point of the looks went."""
    looks, fit = state.looks, state.fit
    found = _at_least_by_their_own(looks, fit, support(looks, state.group, fit))
    stretches = supported_stretches(fit.axes, found)
    shapes = shapes_of(fit.axes.stations, stretches, _TOLERANCE * looks.unit)
    element = stretch_of(stretches, fit.feet.station)
    known = known_lines(fit.axes, fit.knowledge, found)
    return Lines(shapes, *means(found, fit.error, stretches), element, known)


def _at_least_by_their_own(looks: Looks, fit: Fit, found: Support) -> Support:
    """Count each place as seen by those who say that it is there, also where smoothing took it out of their reach.

    A line that nobody missed is whole: nothing may be left out of it. Of others only what nobody could miss, and what
    was known before, counts so: where footprints tell who looked, what smoothing leaves behind is no evidence.
    """
    axes, past = fit.axes, np.nan_to_num(looks.past, nan=1.0)
    whole = np.bincount(axes.line, found.expected > found.seen)[axes.line] == 0
    least = {name: whole.astype(np.float64) for name in ("seen", "seen_drives")}
    told = np.isfinite(looks.knowledge) | (looks.instances.footprint is None)
    for name, seen in least.items():
        np.maximum.at(seen, fit.feet.station[told], past[told, PAST.index(name)])
    return found._replace(**{name: np.maximum(getattr(found, name), seen) for name, seen in least.items()})
