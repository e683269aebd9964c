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
from polymerge_core.consensus.axes import Axes
from polymerge_core.consensus.drift import Drift, estimate_drift, no_drift, pulls
from polymerge_core.consensus.fusion import Fit, Noise, fuse
from polymerge_core.consensus.layout import first_axes
from polymerge_core.consensus.looks import Instances, Looks
from polymerge_core.consensus.membership import line_along, settle
from polymerge_core.consensus.registration import centres, corrected, corrections, equations
from polymerge_core.consensus.support import Stretches, Support, stretch_of, support, supported_stretches
from polymerge_core.curves import Array, Index

#: Looks are given to the lines anew at most so often; by then they have settled.
_ROUNDS = 3

#: How often the lines of the drives are put together, each time after the drives were shifted anew.
_DRIFTS = 3

#: A piece of a drive's line is longer than so many points.
_SHORT_TRACK = 3

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
        states.append(trace(looks, looks.instances.drive[looks.instance]))
        advance(0.6 * (number + 1) / len(classes))
    centre = centres(classes, len(classes[0].instances))
    moved = np.zeros((len(centre), 3))
    if len(np.unique(classes[0].instances.drive)) > 1:
        states, moved[:, :2] = _join_drives(states, centre)
    for number in range(_CORRECTIONS):
        states, step = _register(states, centre, moved)
        moved += step
        advance(0.6 + 0.35 * (number + 1) / _CORRECTIONS)
    return [_finish(state) for state in states], moved


def _join_drives(states: list[_State], centre: Array) -> tuple[list[_State], Array]:
    """Put the lines of the drives together, each drive shifted to where the drives together are.

    Frames of one drive share their errors, so that they lie close together; and what a drive saw as a whole is long
    enough to tell which of the other drives' lines it runs along.
    """
    instances, unit = states[0].looks.instances, states[0].looks.unit
    drives = instances.by_drive()
    tracks = [_tracks(state, drives) for state in states]
    drift = no_drift()
    joined: list[_State] = []
    for number in range(_DRIFTS):
        joined = [trace(_shifted(each.looks, drift), np.zeros(len(each.looks), np.intp)) for each in tracks]
        drift = estimate_drift([pulls(state.looks, state.fit, drift) for state in joined], unit)
        if number + 1 < _DRIFTS:
            tracks = [_cut(each, state) for each, state in zip(tracks, joined, strict=True)]
    correction = np.column_stack([drift.at(instances.drive, centre), np.zeros(len(centre))])
    parts = zip(states, tracks, joined, strict=True)
    return [_of_all_drives(*part, correction, centre) for part in parts], correction[:, :2]


class _Tracks(NamedTuple):
    """The lines that the drives saw, each drive for itself."""

    #: As looks of the drives.
    looks: Looks
    #: The track of each station of the drives' lines, -1 where too few frames of the drive saw the line there, and
    #: which point of the track it is.
    track: Index
    point: Index


def _tracks(state: _State, drives: Instances) -> _Tracks:
    axes = state.fit.axes
    drive = np.zeros(len(axes.counts), np.intp)
    drive[state.group] = state.looks.instances.drive[state.looks.instance]
    found = supported_stretches(axes, support(state.looks, state.group, axes, drive))
    track = stretch_of(found, np.arange(len(axes.line)))
    number = np.arange(len(axes.line)) - np.where(track >= 0, found.first[track], 0) if len(found.first) else track
    lines = _shapes(axes.stations, found, 0.0)
    return _drawn(lines, drive[axes.line[found.first]], drives, state.looks.unit, track, number)


def _drawn(
    lines: NDArray[np.object_], drive: Index, drives: Instances, unit: float, track: Index, number: Index
) -> _Tracks:
    """Return tracks from their lines; the numbers of the vertices become those of the points that answer to them."""
    looks = Looks.of(lines, drive, np.ones(len(lines)), drives, unit)
    last, points = shapely.get_num_coordinates(lines) - 1, np.bincount(looks.owner, minlength=len(lines))
    share = (points - 1) / np.maximum(last, 1)
    point = np.where(track >= 0, np.round(number * share[track]), -1).astype(np.intp) if len(lines) else track
    return _Tracks(looks, track, point)


def _cut(tracks: _Tracks, joined: _State) -> _Tracks:
    """Cut the tracks where too few drives saw the line that they are part of: there they may change over to another."""
    looks, axes = joined.looks, joined.fit.axes
    found = supported_stretches(axes, support(looks, joined.group, axes))
    piece = stretch_of(found, joined.fit.feet.station)
    begins = (np.diff(looks.owner, prepend=-1) != 0) | (np.diff(piece, prepend=-2) != 0)
    run = np.cumsum(begins) - 1
    first = np.flatnonzero(begins)
    size = np.diff(np.append(first, len(run)))
    kept = (piece[first] >= 0) & (size > _SHORT_TRACK)
    name = np.where(kept, np.cumsum(kept) - 1, -1)
    # The same points of the tracks as they were before they were shifted.
    start = np.flatnonzero(np.diff(tracks.looks.owner, prepend=-1))
    there = tracks.track >= 0
    place = np.where(there, start[tracks.track] + tracks.point, 0) if len(start) else tracks.track
    track = np.where(there, name[run[place]], -1)
    number = np.where(track >= 0, place - first[run[place]], 0)
    inside = np.flatnonzero(name[run] >= 0)
    lines = shapely.linestrings(tracks.looks.points[inside], indices=name[run[inside]])
    drive = tracks.looks.instance[looks.owner[first[kept]]]
    return _drawn(lines, drive, tracks.looks.instances, looks.unit, track, number)


def _track_of_looks(state: _State, tracks: _Tracks) -> Index:
    """Return the track that most of each look runs along, -1 for none."""
    looks = state.looks
    count = len(tracks.looks) + 1
    votes, place = np.unique(looks.owner * count + tracks.track[state.fit.feet.station] + 1, return_inverse=True)
    metres = np.bincount(place, looks.metres)
    order = np.lexsort((votes, -metres.round(9), votes // count))
    best = order[np.diff(votes[order] // count, prepend=-1) != 0]
    return np.asarray(votes[best] % count - 1)


def _shifted(tracks: Looks, drift: Drift) -> Looks:
    points = tracks.points + drift.at(tracks.instances.drive[tracks.point_instance], tracks.points)
    return tracks.moved(points).redrawn()


def _of_all_drives(state: _State, tracks: _Tracks, joined: _State, correction: Array, centre: Array) -> _State:
    """Give the looks of the frames to the lines of all drives; what is on no track stays a line of its own."""
    looks = corrected(state.looks, correction, centre)
    axes, track = joined.fit.axes, _track_of_looks(state, tracks)
    on_track = track >= 0
    group = line_along(looks, axes)
    group[on_track] = joined.group[track[on_track]]
    alone = group < 0
    left, own = np.unique(state.group[alone], return_inverse=True)
    group[alone] = len(axes.counts) + own
    before = state.fit.axes
    there = np.isin(before.line, left)
    line = np.concatenate([axes.line, len(axes.counts) + np.searchsorted(left, before.line[there])])
    every = Axes(np.concatenate([axes.stations, before.stations[there]]), line)
    fit = fuse(looks, group, every, Noise(state.fit.sigma, joined.fit.drive_sigma))
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
