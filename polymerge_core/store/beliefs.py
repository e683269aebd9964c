"""What local maps say of an element over time: whether it is there, and whether the road has changed.

Each local map that looked at a place speaks for what it saw there and against what it did not see, as strongly as its
predictor is likely to see it from there and unlikely to imagine it (log-odds; Moravec and Elfes 1985). A drive is heard
once, however many frames it has: a parked van hides a line from all of them. Over the drives, in the order of time, the
likeliest story is chosen: it was always there, it never was, it came at one time, it went at one time; a change must
explain what was seen better by as much as changes are rare. What lies aside from what earlier drives saw is judged
alike: one line, or one before and another after.

References
----------
Moravec and Elfes 1985, "High resolution maps from wide angle sonar"; Page 1954, "Continuous inspection schemes".
"""

from __future__ import annotations

from typing import NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from polymerge_core.consensus.alongside import REACH
from polymerge_core.consensus.looks import Instances
from polymerge_core.consensus.support import SQUARE, SURE, chances
from polymerge_core.curves import Array, Curves, Index
from polymerge_core.observations import as_lines
from polymerge_core.store.drive_order import DriveOrder
from polymerge_core.store.movement import likelier_moved
from polymerge_core.store.places import STEP, Places, places_along

#: The chance that a local map shows something of a class at a place where there is nothing of it.
FALSE_ALARM = 0.05

#: The chance that a line is seen from where it should be is learned from the lines that are sure, within these bounds.
DETECTION = (0.2, 0.95)

#: The chance where it is not known what local maps look at.
_USUAL = 0.7

#: What all frames of a drive say together counts at most this much: log-odds, 33 to 1.
DRIVE = 3.5

#: The chance that a place changes between two drives.
CHANGE = 0.005

#: From these log-odds on a change is noted, 3 to 1: what was seen before is lost with it.
_LIKELY = float(np.log(3.0))

#: From these log-odds on an element is sure, 20 to 1.
SURE_OF = 3.0

#: Below these log-odds an element is not there: 20 to 1, and even if one drive was wrong.
DENIED = -(SURE_OF + DRIVE)

#: What changes is at least so many proximities long, or all of an element; what is shorter is a matter of its ends.
_SHORTEST = 8.0

#: Shorter gaps in what has changed are no gaps, proximities.
_BRIDGED = 6.0

#: That drives miss as little as is said above is as sure as if so many places of a drive had said so.
_USUAL_PLACES = 20.0

_COST = -np.log(CHANGE)


class Renewal(NamedTuple):
    """Somewhere the road changed."""

    cls: str
    #: ``vanished``, ``appeared`` or ``moved``.
    kind: str
    zone: BaseGeometry
    #: The first local map of the first drive that saw the change.
    since: int


class Judgement(NamedTuple):
    """What is known of elements.

    Parameters
    ----------
    evidence : ndarray of float, shape (m,)
        Log-odds that each is there; NaN where nobody looked.
    renewals : list of Renewal
        Where the road changed.
    """

    evidence: Array
    renewals: list[Renewal]


def judge_elements(
    elements: gpd.GeoDataFrame,
    is_area: NDArray[np.bool_],
    lineage: pd.DataFrame,
    observations: gpd.GeoDataFrame,
    instances: gpd.GeoDataFrame,
    order: DriveOrder,
    place: BaseGeometry,
    unit: float,
) -> Judgement:
    """Judge elements by all local maps that looked at a place.

    Parameters
    ----------
    elements : GeoDataFrame
        As merged: `class`.
    is_area : ndarray of bool, shape (m,)
        Which are areas, also where they are drawn as lines.
    lineage : DataFrame
        `element` (row), `observation` (row) of what was merged.
    observations : GeoDataFrame
        `instance` (row), `class`.
    instances : GeoDataFrame
        The local maps: `x`, `y`, `heading`, `has_footprint`; geometry is what they looked at, as far as that counts.
    order : DriveOrder
        Of their drives.
    place : Polygon or MultiPolygon
        Where all that looked is known.
    unit : float
        The proximity, metres.
    """
    places = places_along(elements, is_area, place, unit)
    seen = _sightings(places, elements, lineage, observations, unit)
    cls = elements["class"].to_numpy()[places.element]
    stories = _stories(places, cls, seen, instances, order.drive, len(order.first), unit)
    total = stories.sum(axis=1)
    evidence = pd.Series(total).groupby(places.element).median().reindex(range(len(elements))).to_numpy(dtype=float)
    if len(order.first) < 2:
        return Judgement(evidence, [])
    renewals = _came_or_went(places, elements, stories, order, unit)
    gain = likelier_moved(places, elements, seen, observations, order, unit, _COST)
    if gain is not None:
        renewals += _runs(places, elements, gain, "moved", order, unit)
    return Judgement(evidence, renewals)


def _sightings(
    places: Places, elements: gpd.GeoDataFrame, lineage: pd.DataFrame, observations: gpd.GeoDataFrame, unit: float
) -> pd.DataFrame:
    """Return who saw what: `place`, `observation`, `instance`, and whether it is of that element, `own`."""
    shapes = observations.geometry.to_numpy()
    points = shapely.points(places.points)
    tree = shapely.STRtree(points)
    row, place = tree.query(as_lines(shapes), predicate="dwithin", distance=REACH * unit)
    pairs = set(zip(lineage["observation"].tolist(), lineage["element"].tolist(), strict=True))
    own = np.array(
        [pair in pairs for pair in zip(row.tolist(), places.element[place].tolist(), strict=True)], dtype=bool
    )
    # Of areas that overlap each is seen by its own looks alone.
    line = np.isfinite(places.normal[place, 0])
    cls = line & (elements["class"].to_numpy()[places.element[place]] == observations["class"].to_numpy()[row])
    near = np.zeros(len(row), dtype=bool)
    near[cls] = shapely.dwithin(as_lines(shapes[row[cls]]), points[place[cls]], unit)
    kept = own | near
    found = pd.DataFrame({"place": place[kept], "observation": row[kept], "own": own[kept]})
    # An area is seen by whoever saw any of it.
    areas = np.flatnonzero(np.isnan(places.normal[:, 0]))
    whole = lineage.merge(pd.DataFrame({"element": places.element[areas], "place": areas}), on="element")
    found = pd.concat([found, whole[["place", "observation"]].assign(own=True)], ignore_index=True)
    found = found.sort_values("own", ascending=False, kind="stable").drop_duplicates(["place", "observation"])
    found["instance"] = observations["instance"].to_numpy()[found["observation"]]
    return found.astype({"place": np.intp, "observation": np.intp, "instance": np.intp})


def _stories(
    places: Places,
    cls: NDArray[np.object_],
    seen: pd.DataFrame,
    instances: gpd.GeoDataFrame,
    drive: Index,
    drives: int,
    unit: float,
) -> Array:
    """Return what each drive says of each place: log-odds, shape (places, drives)."""
    footprints = instances.geometry.to_numpy()
    known = instances["has_footprint"].to_numpy(dtype=bool)
    tree = shapely.STRtree(shapely.points(places.points))
    who = np.flatnonzero(known)
    shapely.prepare(footprints[who])
    row, looked_at = tree.query(footprints[who], predicate="contains")
    looked = pd.DataFrame({"place": looked_at, "instance": who[row]}).astype(np.intp)
    sightings = seen[["place", "instance"]].drop_duplicates()
    saw = pd.MultiIndex.from_frame(looked).isin(pd.MultiIndex.from_frame(sightings))
    position = instances[["x", "y"]].to_numpy(dtype=float)
    heading = np.radians(90.0 - instances["heading"].to_numpy(dtype=float))
    frames = Instances(drive, None, position, heading)
    times = np.bincount(looked["place"][saw], minlength=len(places.points))
    sure = (times >= SURE)[looked["place"]]
    points, frame = places.points[looked["place"]], looked["instance"].to_numpy()
    likely = np.empty(len(looked))
    whose = cls[looked["place"]]
    for name in np.unique(whose.astype(str)):
        own = np.flatnonzero(whose == name)
        likely[own] = chances(points[own], frames, frame[own], saw[own], sure[own], SQUARE * unit)
    # Some places are seen less often than others of their class, such as those near the end of a line.
    ratio = (times + 1.0) / (np.bincount(looked["place"], likely, minlength=len(times)) + 1.0)
    likely = np.clip(likely * np.minimum(ratio, 1.0)[looked["place"]], *DETECTION)
    said = np.where(saw, np.log(likely / FALSE_ALARM), np.log((1 - likely) / (1 - FALSE_ALARM)))
    total = np.zeros((len(places.points), drives))
    np.add.at(total, (looked["place"].to_numpy(), drive[looked["instance"]]), said)
    # Who saw it without being known to have looked.
    inside = pd.MultiIndex.from_frame(sightings).isin(pd.MultiIndex.from_frame(looked))
    others = sightings[~inside]
    np.add.at(total, (others["place"].to_numpy(), drive[others["instance"]]), np.log(_USUAL / FALSE_ALARM))
    return np.clip(total, -_surest_no(total, cls), DRIVE)


def _surest_no(stories: Array, cls: NDArray[np.object_]) -> Array:
    """Return how much a drive that sees nothing can count at most: log-odds, shape (places, 1).

    Where drives before and after it see something it was there, and a drive that sees nothing missed it, with all its
    frames. How often that happens is learned for each class: a drive in the next lane, or behind a lorry, misses much.
    """
    seen = stories > 0
    earlier: Index = np.cumsum(seen, axis=1) - seen
    later = seen.sum(axis=1, keepdims=True) - earlier - seen
    between = (earlier > 0) & (later > 0) & (stories != 0)
    names, code = np.unique(cls.astype(str), return_inverse=True)
    missed, asked = (np.bincount(code, (between & what).sum(axis=1), len(names)) for what in (~seen, True))
    chance = (missed + _USUAL_PLACES * np.exp(-DRIVE)) / (asked + _USUAL_PLACES)
    return np.minimum(DRIVE, -np.log(chance))[code][:, None]


def _came_or_went(
    places: Places, elements: gpd.GeoDataFrame, stories: Array, order: DriveOrder, unit: float
) -> list[Renewal]:
    before = np.cumsum(stories, axis=1)[:, :-1]
    total = stories.sum(axis=1)
    static = np.maximum(total, 0.0)[:, None]
    went, came = before - _COST - static, total[:, None] - before - _COST - static
    found = []
    for kind, gain in (("vanished", went), ("appeared", came)):
        found += _runs(places, elements, gain, kind, order, unit)
    return found


def _runs(
    places: Places,
    elements: gpd.GeoDataFrame,
    gain: Array,
    kind: str,
    order: DriveOrder,
    unit: float,
) -> list[Renewal]:
    """Return stretches of elements along which a change is the likeliest story, each with its likeliest time."""
    # Of drives in no order nobody can tell what came first.
    gain = np.where(order.known, gain, -np.inf)
    best = gain.max(axis=1, initial=-np.inf)
    found = []
    shapes = elements.geometry.to_numpy()
    # Few elements have any such place.
    for element in np.unique(places.element[best > _LIKELY]):
        rows = np.flatnonzero(places.element == element)
        # Where one place changed, that its neighbours did too is as likely as not: only what is seen of them counts.
        chosen = np.flatnonzero(best[rows] > _LIKELY - _COST)
        gaps = np.flatnonzero(np.diff(chosen) > max(1.0, _BRIDGED / STEP)) + 1
        for run in np.split(chosen, gaps):
            inside = rows[run[0] : run[-1] + 1]
            sure = inside[best[inside] > _LIKELY]
            whole = len(inside) >= 0.8 * len(rows)
            # A short line is there or not as a whole; where it lies is known of longer ones.
            enough = len(sure) * STEP >= _SHORTEST or (whole and kind != "moved")
            if len(sure) == 0 or not enough:
                continue
            zone = shapely.buffer(_along(shapes[element], places.points[inside], whole=whole, unit=unit), REACH * unit)
            since = int(order.first[int(np.argmax(gain[sure].sum(axis=0))) + 1])
            found.append(Renewal(str(elements["class"].iloc[element]), kind, zone, since))
    return found


def _along(shape: BaseGeometry, points: Array, *, whole: bool, unit: float) -> BaseGeometry:
    """Return the stretch of an element along some of its places."""
    if whole:
        return shapely.convex_hull(shape) if shape.is_ring else shape
    at = shapely.line_locate_point(shape, shapely.points(points))
    start, stop = max(0.0, float(at.min()) - STEP / 2 * unit), min(shape.length, float(at.max()) + STEP / 2 * unit)
    return Curves(np.array([shape], dtype=object)).stretches(np.zeros(1, np.intp), np.array([start]), np.array([stop]))[
        0
    ]
