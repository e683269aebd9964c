"""The lines that drives saw, each for itself, put together: drives shifted to each other, their lines cut and joined.

Frames of one drive share their errors, so that they lie close together; and what a drive saw as a whole is long enough
to tell which of the other drives' lines it runs along. A line that a drive saw may change over from one true line to
the next, where its position jumped or it saw badly: it is cut where the other drives do not agree.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from polymerge_core.consensus.axes import Axes
from polymerge_core.consensus.drift import Drift, estimate_drift, no_drift, pulls
from polymerge_core.consensus.fusion import FIRST_NOISE, SHARED, Noise, fuse
from polymerge_core.consensus.known import remembering
from polymerge_core.consensus.looks import PAST, Instances, Looks
from polymerge_core.consensus.membership import line_along
from polymerge_core.consensus.support import shapes_of, stretch_of, support, supported_stretches
from polymerge_core.consensus.tracing import State, moved, trace
from polymerge_core.curves import Array, Index, best_of_each

#: How often the lines of the drives are put together, each time after the drives were shifted anew.
_DRIFTS = 3

#: A piece of a drive's line is longer than so many points.
_SHORT_TRACK = 3

#: Columns of `PAST` that tell of drives what the others tell of local maps.
_OF_DRIVES = [
    PAST.index(name) for name in ("seen_drives", "seen_drives", "expected_drives", "seen_drives", "expected_drives")
]


def join_drives(states: list[State], centre: Array) -> tuple[list[State], Array, Drift]:
    """Put the lines of the drives together, each drive shifted to where the drives together are.

    Parameters
    ----------
    states : list of State
        What each drive saw, one entry a class.
    centre : ndarray of float, shape (k, 2)
        Where each local map is, metres.

    Returns
    -------
    states : list of State
        The lines of all drives.
    shift : ndarray of float, shape (k, 2)
        How each local map was shifted, metres east and north.
    drift : Drift
        The shift of each drive at any place.
    """
    instances, unit = states[0].looks.instances, states[0].looks.unit
    drives = instances.by_drive()
    tracks = [_tracks(state, drives) for state in states]
    drift = no_drift()
    joined: list[State | None] = []
    for number in range(_DRIFTS):
        joined = [_traced(each, drift) for each in tracks]
        drift = estimate_drift([pulls(each.looks, each.fit, drift) for each in joined if each], unit)
        if number + 1 < _DRIFTS:
            tracks = [_cut(each, one) if one else each for each, one in zip(tracks, joined, strict=True)]
    shift = drift.at(instances.drive, centre)
    followed = [_follow(state, shift, drift) for state in states]
    found = [
        _of_all_drives(state, each, one) if one else moved(state, np.zeros((len(centre), 3)), centre)
        for state, each, one in zip(followed, tracks, joined, strict=True)
    ]
    return found, shift, drift


def _follow(state: State, shift: Array, drift: Drift) -> State:
    """Shift the looks: each local map as a whole, what was known before place by place."""
    looks = state.looks
    by = shift[looks.point_instance]
    known = np.flatnonzero(looks.point_instance == looks.instances.known)
    by[known] = drift.at(looks.instances.drive[looks.point_instance[known]], looks.points[known])
    return state._replace(looks=looks.moved(looks.points + by))


class _Tracks(NamedTuple):
    """The lines that the drives saw, each drive for itself."""

    #: As looks of the drives.
    looks: Looks
    #: The track of each station of the drives' lines, -1 where too few frames of the drive saw the line there, and
    #: which point of the track it is.
    track: Index
    point: Index


def _tracks(state: State, drives: Instances) -> _Tracks:
    axes = state.fit.axes
    drive = np.zeros(len(axes.counts), np.intp)
    drive[state.group] = state.looks.instances.drive[state.looks.instance]
    found = supported_stretches(axes, support(state.looks, state.group, state.fit, drive))
    track = stretch_of(found, np.arange(len(axes.line)))
    number = np.arange(len(axes.line)) - np.where(track >= 0, found.first[track], 0) if len(found.first) else track
    lines, line = shapes_of(axes.stations, found, 0.0), axes.line[found.first]
    tracks = _drawn(lines, drive[line], drives, state.looks.unit, track, number)
    old = np.flatnonzero(np.isfinite(state.looks.knowledge))
    if len(old) == 0 or len(lines) == 0:
        return tracks
    # What was known before goes along as what one drive saw.
    looks, group = tracks.looks, state.group[state.looks.owner[old]]
    known = looks.point_instance == drives.known
    # As much as so many other drives, of which each counts as one look.
    told = state.looks.past[old][:, _OF_DRIVES]
    told[:, 0] /= (FIRST_NOISE**2 + SHARED**2) * looks.unit**2
    remembered = remembering(looks, line[looks.owner], state.looks.points[old], group, told)
    past = np.where(known[:, None], remembered.past, looks.past)
    return tracks._replace(looks=looks.remembering(past))


def _drawn(
    lines: NDArray[np.object_], drive: Index, drives: Instances, unit: float, track: Index, number: Index
) -> _Tracks:
    """Return tracks from their lines; the numbers of the vertices become those of the points that answer to them."""
    looks = Looks.of(lines, drive, np.ones(len(lines)), drives, unit)
    last, points = shapely.get_num_coordinates(lines) - 1, np.bincount(looks.owner, minlength=len(lines))
    share = (points - 1) / np.maximum(last, 1)
    point = np.where(track >= 0, np.round(number * share[track]), -1).astype(np.intp) if len(lines) else track
    return _Tracks(looks, track, point)


def _cut(tracks: _Tracks, joined: State) -> _Tracks:
    """Cut the tracks where too few drives saw the line that they are part of: there they may change over to another."""
    looks, axes = joined.looks, joined.fit.axes
    found = supported_stretches(axes, support(looks, joined.group, joined.fit))
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
    place = np.where(there, start[tracks.track] + tracks.point, 0)
    track = np.where(there, name[run[place]], -1)
    number = np.where(track >= 0, place - first[run[place]], 0)
    inside = np.flatnonzero(name[run] >= 0)
    lines = shapely.linestrings(tracks.looks.points[inside], indices=name[run[inside]])
    drive = tracks.looks.instance[looks.owner[first[kept]]]
    pieces = _drawn(lines, drive, tracks.looks.instances, looks.unit, track, number)
    if np.isfinite(looks.knowledge).any() and len(lines):
        name_of = name[run[inside]]
        past = remembering(pieces.looks, pieces.looks.owner, tracks.looks.points[inside], name_of, looks.past[inside])
        pieces = pieces._replace(looks=past)
    return pieces


def _track_of_looks(state: State, tracks: _Tracks) -> Index:
    """Return the track that most of each look runs along, -1 for none."""
    looks = state.looks
    count = len(tracks.looks) + 1
    votes, place = np.unique(looks.owner * count + tracks.track[state.fit.feet.station] + 1, return_inverse=True)
    metres = np.bincount(place, looks.metres)
    best = best_of_each(votes // count, metres, votes)
    return np.asarray(votes[best] % count - 1)


def _traced(tracks: _Tracks, drift: Drift) -> State | None:
    """Return the lines that the tracks show where the drives were shifted; None where there are no tracks."""
    looks = tracks.looks
    if len(looks) == 0:
        return None
    points = looks.points + drift.at(looks.instances.drive[looks.point_instance], looks.points)
    return trace(looks.moved(points).redrawn(), np.zeros(len(looks), np.intp))


def _of_all_drives(state: State, tracks: _Tracks, joined: State) -> State:
    """Give the looks of the frames to the lines of all drives; what is on no track stays a line of its own."""
    looks = state.looks
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
    return State(looks, group, fit)
