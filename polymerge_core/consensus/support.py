"""How often a line was seen against how often it could have been seen, and what is left of it then.

The footprint says where a local map looked; how likely a predictor is to see a line there depends on where it lies from
the vehicle, and is learned from the lines that are sure. What far fewer local maps saw than should have is left out;
where footprints are not known nothing is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polymerge_core.consensus.axes import Axes, told_apart
from polymerge_core.consensus.fusion import Fit
from polymerge_core.consensus.looks import Instances, Looks
from polymerge_core.consensus.membership import points_beside, sightings
from polymerge_core.curves import Array, Index, among, count_up, distinct

#: What is seen as often as expected is seen so by chance now and then: fewer than this times the square root of what is
#: expected is too few ...
_CHANCE = 0.6

#: ... and so is less than this share of it, however often it was seen: false detections pile up too.
_SHARE = 0.25

#: Lines that so many local maps saw tell how likely one is to be seen.
SURE = 3

#: Chances are learned by squares of this many proximities, in the vehicle's frame.
SQUARE = 5.0

#: Gaps up to this many proximities are bridged: a predictor draws one line in two pieces.
_BRIDGED = 5

#: What was known before counts at stations that its lines pass within so many proximities.
_NEAR = 1.5

#: What trimming leaves of a line must be this long, proximities.
_SHORT = 3


class Support(NamedTuple):
    """How well each place is supported, one entry a place."""

    #: Local maps that saw it.
    seen: Index
    #: Local maps that should have seen it; 0 where footprints are not known.
    expected: Array
    #: Drives that saw it, and that should have: a drive errs in all its frames alike.
    seen_drives: Index
    expected_drives: Array

    @property
    def enough(self) -> NDArray[np.bool_]:
        """Which places were seen often enough to be there."""
        return _enough(self.seen, self.expected) & _enough(self.seen_drives, self.expected_drives)


class Stretches(NamedTuple):
    """What is left of the lines, one entry a stretch: its first and its last station."""

    first: Index
    last: Index

    @property
    def size(self) -> Index:
        """How many stations each has."""
        return self.last - self.first + 1

    @property
    def stations(self) -> tuple[Index, Index]:
        """The stations of all, and the stretch that each is in."""
        owner, number = count_up(self.size)
        return self.first[owner] + number, owner


def support(looks: Looks, group: Index, fit: Fit, drive: Index | None = None) -> Support:
    """Count who saw each station, and who should have; of `drive` alone, the drive of each line, where it is given."""
    axes = fit.axes
    pairs = _sightings(looks, group, fit)
    of_station = None if drive is None else drive[axes.line]
    found = judge(axes.stations, pairs, looks.instances, looks.unit, of_station)
    before = _before(looks, group, axes)
    return Support._make(axes.around(new + old) for new, old in zip(found, before.T, strict=True))


def _before(looks: Looks, group: Index, axes: Axes) -> Array:
    """Return who saw each station of the map that was known before, and who should have, shape (s, 4)."""
    counts = np.zeros((len(axes.line), len(Support._fields)))
    rows = np.flatnonzero(np.isfinite(looks.knowledge))
    if len(rows) == 0:
        return counts
    tree = cKDTree(told_apart(looks.points[rows], group[looks.owner[rows]]))
    there, far = told_apart(axes.stations, axes.line), _NEAR * looks.unit
    distance, nearest = tree.query(there, distance_upper_bound=far, workers=-1)
    near = np.isfinite(distance)
    counts[near] = looks.past[rows[nearest[near]], 1:]
    return counts


def judge(places: Array, pairs: Index, instances: Instances, unit: float, drive: Index | None = None) -> Support:
    """Count who saw each place, and who should have.

    Parameters
    ----------
    places : ndarray of float, shape (s, 2)
        Metres.
    pairs : ndarray of int
        ``place * len(instances) + instance`` of every sighting; rising.
    instances : Instances
        The local maps.
    unit : float
        The proximity, metres.
    drive : ndarray of int, shape (s,), optional
        Only local maps of this drive are expected to see the place.
    """
    count, drives = len(instances), int(instances.drive.max(initial=-1)) + 1
    pairs = pairs[pairs % count != instances.known]
    seen = np.bincount(pairs // count, minlength=len(places)) if len(pairs) else np.zeros(len(places), np.intp)
    seen_by = distinct(pairs // count * drives + instances.drive[pairs % count])
    seen_drives = np.bincount(seen_by // drives, minlength=len(places)) if len(pairs) else seen
    if instances.footprint is None or len(places) == 0:
        return Support(seen, np.zeros(len(places)), seen_drives, np.zeros(len(places)))
    instance, place = shapely.STRtree(shapely.points(places)).query(instances.footprint, predicate="contains")
    instance, place = instance[instance != instances.known], place[instance != instances.known]
    if drive is not None:
        own = instances.drive[instance] == drive[place]
        instance, place = instance[own], place[own]
    saw = among(place * count + instance, pairs)
    chance = chances(places[place], instances, instance, saw, (seen >= SURE)[place], SQUARE * unit)
    expected = np.bincount(place, chance, minlength=len(places)).astype(float)
    # A drive should have seen what one of its local maps at least should have.
    passed, inverse = np.unique(place * drives + instances.drive[instance], return_inverse=True)
    passed = passed[np.bincount(inverse, chance) >= 1.0]
    sure = (seen_drives >= SURE)[passed // drives]
    share = among(passed, seen_by)[sure].mean() if sure.any() else 1.0
    passes = np.bincount(passed // drives, minlength=len(places)).astype(np.float64)
    return Support(seen, expected, seen_drives, share * passes)


def chances(
    places: Array, instances: Instances, instance: Index, saw: NDArray[np.bool_], sure: NDArray[np.bool_], square: float
) -> Array:
    """Return how likely each local map was to see each place, by where that lies from its vehicle."""
    offset = places - instances.position[instance]
    sine, cosine = np.sin(instances.heading[instance]), np.cos(instances.heading[instance])
    ahead = np.nan_to_num(cosine * offset[:, 0] + sine * offset[:, 1])
    aside = np.nan_to_num(cosine * offset[:, 1] - sine * offset[:, 0])
    row, column = (np.floor(along / square).astype(np.intp) for along in (ahead, aside))
    width = int(np.ptp(column)) + 1 if len(column) else 1
    _, cell = np.unique(row * width + column, return_inverse=True)
    overall = saw[sure].mean() if sure.any() else saw.mean() if len(saw) else 0.0
    # A square that few sure lines fell into takes after the others.
    chance = (np.bincount(cell, saw & sure) + overall) / (np.bincount(cell, sure) + 1.0)
    return np.asarray(chance[cell])


def succession(seen: Array, expected: Array) -> Array:
    """Return how surely one that looks there sees it, by the rule of succession."""
    return np.asarray((seen + 1) / (np.maximum(expected, seen) + 2), dtype=np.float64)


def means(support: Support, error: Array, stretches: Stretches) -> tuple[Array, Array, Array]:
    """Return of each stretch the median standard error, metres, and who saw it and should have, in the mean."""
    rows, owner = stretches.stations
    sigma = pd.Series(error[rows]).groupby(owner).median().to_numpy()
    totals = [np.concatenate([[0.0], np.cumsum(values)]) for values in (support.seen, support.expected)]
    seen, expected = ((total[stretches.last + 1] - total[stretches.first]) / stretches.size for total in totals)
    return sigma, seen, expected


def _enough(seen: Index, expected: Array) -> NDArray[np.bool_]:
    return np.asarray(seen >= np.maximum(_CHANCE * np.sqrt(expected), _SHARE * expected))


def _sightings(looks: Looks, group: Index, fit: Fit) -> Index:
    """Return ``station * number of local maps + local map`` of every sighting; rising."""
    axes = fit.axes
    stations, instances = len(axes.line), len(looks.instances)
    station, instance = sightings(looks, group, points_beside(looks, axes, fit.feet.station))
    found = np.sort(instance * stations + station)
    # Points are as far apart as stations, so that one falls between two of them now and then.
    skipped = found[:-1][np.diff(found) == 2] + 1
    station = skipped % stations
    inside = (station > 0) & (station < stations - 1)
    station, skipped = station[inside], skipped[inside]
    skipped = skipped[axes.line[station - 1] == axes.line[station + 1]]
    found = distinct(np.concatenate([found, skipped]))
    return np.sort((found % stations) * instances + found // stations)


def supported_stretches(axes: Axes, support: Support) -> Stretches:
    """Return the stretches of the lines that enough local maps saw, short gaps bridged."""
    return stretches_of(axes, (support.seen > 0) & support.enough)


def stretches_of(axes: Axes, kept: NDArray[np.bool_]) -> Stretches:
    """Return the stretches of the lines that are to be kept, short gaps bridged."""
    rows = np.flatnonzero(kept)
    if len(rows) == 0:
        empty = np.empty(0, np.intp)
        return Stretches(empty, empty)
    line = axes.line[rows]
    begins = (np.diff(line, prepend=-1) != 0) | (np.diff(rows, prepend=-1) > _BRIDGED + 1)
    first = rows[begins]
    last = rows[np.append(np.flatnonzero(begins)[1:], len(rows)) - 1]
    whole = (last - first + 1) == axes.counts[axes.line[first]]
    lasting = (whole | (last - first >= _SHORT)) & (last > first)
    return Stretches(first[lasting], last[lasting])


def stretch_of(stretches: Stretches, station: Index) -> NDArray[np.intp]:
    """Return the stretch that each station is in, -1 where in none."""
    if len(stretches.first) == 0:
        return np.full(len(station), -1)
    place = np.searchsorted(stretches.first, station, side="right") - 1
    inside = (place >= 0) & (station <= stretches.last[place])
    return np.where(inside, place, -1)


def shapes_of(stations: Array, stretches: Stretches, tolerance: float) -> NDArray[np.object_]:
    """Return stretches as lines without vertices that leave them where they are within a tolerance, metres."""
    rows, owner = stretches.stations
    if len(owner) == 0:
        return np.empty(0, dtype=object)
    drawn = shapely.linestrings(stations[rows], indices=owner)
    # Simplifying by nothing would still take the vertices out of straight lines.
    shapes: NDArray[np.object_] = shapely.simplify(drawn, tolerance) if tolerance > 0 else drawn
    return shapes
