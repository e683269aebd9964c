"""The consensus of areas: as many corners as the evidence has, each at the mean of what was seen of it.

Looks at one area overlap; two areas that one local map saw side by side are different. The looks that hold their area
whole (those that do not end at the edge of what their local map looked at) say which areas there are and how many
corners each has; every corner is the robust mean of what was seen of it, so that a skewed crossing stays skewed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from polymerge_core.consensus.association import SIDE_BY_SIDE, Links, link_groups
from polymerge_core.consensus.fusion import HALF_WEIGHT
from polymerge_core.consensus.known import KnownAreas, nothing_known
from polymerge_core.consensus.looks import Instances
from polymerge_core.consensus.support import Support, judge
from polymerge_core.curves import Array, Index, distinct

#: Looks belong together where they have this share of the smaller one in common, in the mean.
OVERLAP = 0.5

#: An area that has this share in common with another one, in the mean of the looks at both, which so many times as many
#: local maps saw and hardly any beside it, is that other one seen badly: who saw it looked there, and did not see two.
_SHADOW, _MANY = 0.25, 3

#: What is left of one that was cut off may lie so many proximities beside the area: it may be narrower than errors are.
_BESIDE = 0.5

#: A corner that leaves the outline where it is within this many proximities is none.
_STRAIGHT = 0.15

#: A look that comes so near to the edge of what its local map looked at may have been cut off there, proximities.
_EDGE = 0.5

#: Corners of two looks so many proximities apart may be the same.
_SAME_CORNER = 2.0

#: Median distance to standard deviation along each axis, for normal errors in the plane.
_RAYLEIGH = 1.1774


class Areas(NamedTuple):
    """The merged areas of one class.

    Parameters
    ----------
    shapes : ndarray of Polygon, shape (m,)
        Metres.
    sigma : ndarray of float, shape (m,)
        Standard error of the corners, metres; NaN where one look tells nothing of it.
    seen, expected : ndarray of float, shape (m,)
        Local maps that saw each, and that should have; 0 where footprints are not known.
    element : ndarray of int, shape (n,)
        The merged area of each look, what was known before last; -1 where it was left out.
    known : KnownAreas
        What is known of all areas, also of those that too few saw so far.
    """

    shapes: NDArray[np.object_]
    sigma: Array
    seen: Array
    expected: Array
    element: Index
    known: KnownAreas


def merge_looks_at_areas(
    polygons: NDArray[np.object_],
    instance: Index,
    weight: Array,
    instances: Instances,
    unit: float,
    before: KnownAreas | None = None,
) -> Areas:
    """Merge the looks at areas of one class.

    Parameters
    ----------
    polygons : ndarray of Polygon, shape (n,)
        Metres.
    instance : ndarray of int, shape (n,)
        The local map of each.
    weight : ndarray of float, shape (n,)
        How much each counts.
    instances : Instances
        The local maps.
    unit : float
        The proximity, metres.
    before : KnownAreas, optional
        What was known before.

    Returns
    -------
    Areas
        In the order of their first looks; what was known before comes last.
    """
    count = len(polygons)
    before = before or nothing_known()
    polygons = np.concatenate([polygons, before.polygons])
    instance = np.concatenate([instance, np.full(len(before.polygons), instances.known)])
    weight = np.concatenate([weight, before.weight])
    edges = _edges(instance, instances)
    edges[count:] = None
    whole = np.append(held_whole(polygons[:count], edges[:count], unit), before.whole)
    links = _links(polygons, instance)
    group = group_areas(polygons, instance, links, whole, unit)
    order = np.argsort(group, kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(group[order])) + 1) if count + len(before.weight) else []
    fused = [fuse_areas(polygons[row], weight[row], edges[row], whole[row], unit) for row in members]
    shapes = np.array([shape for shape, _ in fused], dtype=object)
    sigma = np.array([error for _, error in fused])
    pairs = distinct(group * len(instances) + instance)
    places = shapely.get_coordinates(shapely.centroid(shapes))
    support = judge(places, pairs, instances, unit)
    past = np.zeros((len(shapes), len(Support._fields)))
    np.add.at(past, group[count:], before.support)
    support = Support._make(new + old for new, old in zip(support, past.T, strict=True))
    kept = support.enough & ~_shadows(polygons, instance, instances, links, group, whole)
    number = np.where(kept, np.cumsum(kept) - 1, -1)
    known = KnownAreas(
        shapes,
        np.bincount(group, weight).astype(np.float64),
        np.bincount(group, whole) > 0,
        np.column_stack([*support]).astype(np.float64),
    )
    return Areas(
        shapes[kept],
        sigma[kept],
        support.seen[kept].astype(np.float64),
        support.expected[kept],
        number[group],
        known,
    )


def _links(polygons: NDArray[np.object_], instance: Index) -> Links:
    """Return what looks that overlap have in common: as with lines, a cost over a length, 0 of one local map."""
    first, second = shapely.STRtree(polygons).query(polygons, predicate="intersects")
    once = first < second
    first, second = first[once], second[once]
    common = shapely.area(shapely.intersection(polygons[first], polygons[second]))
    area = shapely.area(polygons)
    share = common / np.minimum(area[first], area[second])
    same = instance[first] == instance[second]
    # How little they have in common, against how little they may.
    cost = np.where(same, 0.0, (1.0 - share) / (1.0 - OVERLAP))
    return Links(first, second, cost, np.where(same, 0.0, 1.0), np.zeros(len(first)), same.astype(float))


def group_areas(
    polygons: NDArray[np.object_], instance: Index, links: Links, whole: NDArray[np.bool_], unit: float
) -> Index:
    """Group looks at the same area, numbered from 0 in the order of their first looks.

    Looks that hold their area whole say which areas there are. One that was cut off has a share of any of them that
    it reaches into: it joins the one that it has most in common with; those that join none are grouped by themselves.
    """
    alike = whole[links.first] == whole[links.second]
    group = link_groups(instance, np.ones(len(polygons)), links.take(alike), 1.0)
    joined = _join_cut(polygons, links.take(~alike), group, whole, unit)
    return np.asarray(pd.factorize(joined)[0], dtype=np.intp)


def _shadows(
    polygons: NDArray[np.object_],
    instance: Index,
    instances: Instances,
    links: Links,
    group: Index,
    whole: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Tell which areas are no areas of their own, but others seen badly.

    None where footprints are not known, nor of what was known before; how far goes what all saw cut off nobody knows.
    """
    size = np.bincount(group)
    found = np.zeros(len(size), dtype=bool)
    if instances.footprint is None or len(links.first) == 0:
        return found
    ends = np.column_stack([group[links.first], group[links.second]])
    few, many = np.where((size[ends[:, 0]] < size[ends[:, 1]])[:, None], ends, ends[:, ::-1]).T
    middle = shapely.centroid(polygons)
    looked = shapely.contains(instances.footprint[instance[links.first]], middle[links.second])
    looked &= shapely.contains(instances.footprint[instance[links.second]], middle[links.first])
    share = np.where(looked & (links.metres > 0), 1.0 - (1.0 - OVERLAP) * links.square, 0.0)
    table = pd.DataFrame({"few": few, "many": many, "share": share, "both": links.side_by_side})
    table = table.groupby(["few", "many"], sort=True).sum().reset_index()
    one, other = size[table["few"]], size[table["many"]]
    shadow = (table["share"] >= _SHADOW * one * other) & (other >= _MANY * one) & (table["both"] <= SIDE_BY_SIDE * one)
    found[table["few"][shadow]] = True
    found &= np.bincount(group, whole) > 0
    found[group[instance == instances.known]] = False
    return found


def _join_cut(
    polygons: NDArray[np.object_], links: Links, group: Index, whole: NDArray[np.bool_], unit: float
) -> Index:
    """Return the groups with looks that were cut off in those of whole looks that they have most in common with."""
    cut = np.where(whole[links.first], links.second, links.first)
    other = links.first + links.second - cut
    onto = group[other]
    near = shapely.buffer(polygons[other], _BESIDE * unit, join_style="mitre")
    share = shapely.area(shapely.intersection(polygons[cut], near)) / shapely.area(polygons[cut])
    table = pd.DataFrame({"cut": cut, "onto": onto, "share": share, "same": links.side_by_side})
    # In the mean of the looks of a group; what one local map saw beside one of them is not of that group.
    means = table.groupby(["cut", "onto"], sort=True).agg({"share": "sum", "same": "max"}).reset_index()
    means["share"] /= np.bincount(group)[means["onto"]]
    means = means[(means["share"] >= OVERLAP) & (means["same"] == 0)]
    best = means.sort_values("share", ascending=False, kind="stable").drop_duplicates("cut")
    joined = group.copy()
    joined[best["cut"]] = best["onto"]
    return joined


def held_whole(polygons: NDArray[np.object_], edges: NDArray[np.object_], unit: float) -> NDArray[np.bool_]:
    """Tell which looks do not end at the edge of what their local map looked at; all where that is not known."""
    return ~np.asarray(shapely.distance(edges, polygons) <= _EDGE * unit)


def _edges(instance: Index, instances: Instances) -> NDArray[np.object_]:
    """Return the edge of what the local map of each look looked at; None where that is not known."""
    if instances.footprint is None:
        return np.full(len(instance), None, dtype=object)
    return np.asarray(shapely.boundary(instances.footprint[instance]), dtype=object)


def fuse_areas(
    polygons: NDArray[np.object_],
    weight: Array,
    edges: NDArray[np.object_],
    held: NDArray[np.bool_],
    unit: float,
) -> tuple[shapely.Polygon, float]:
    """Merge the looks at one area.

    Parameters
    ----------
    polygons : ndarray of Polygon, shape (n,)
        Metres.
    weight : ndarray of float, shape (n,)
        How much each counts.
    edges : ndarray of LineString, shape (n,)
        Edge of what the local map of each looked at: what lies there is no corner; None where it is not known.
    held : ndarray of bool, shape (n,)
        Whether each holds the area whole.
    unit : float
        The proximity, metres.

    Returns
    -------
    polygon : Polygon
        With the number of corners that most looks have that hold the area whole, or those of the largest look.
    error : float
        Standard error of a corner, metres; NaN for a single look.
    """
    if len(polygons) == 1:
        return polygons[0], np.nan
    corners = [_corners(polygon, unit) for polygon in polygons]
    # Distances to an edge that is not known are NaN. Of what was known before no corner is sure if it was cut off.
    true = [
        ~(shapely.distance(edge, shapely.points(each)) <= _EDGE * unit) & (all_of_it | (edge is not None))
        for edge, each, all_of_it in zip(edges, corners, held, strict=True)
    ]
    whole = np.array([each.all() for each in true])
    outline, cut = _outline(polygons, corners, true, weight, whole)
    seen = np.full((len(corners), len(outline), 2), np.nan)
    for row, (each, known) in enumerate(zip(corners, true, strict=True)):
        _put_corners(seen[row], outline, each[known], _SAME_CORNER * unit)
    mean, error = _robust_mean(seen, weight)
    known = np.isfinite(mean[:, 0]) & ~cut
    if not known.any():
        return shapely.Polygon(outline), np.nan
    # Where all looks were cut off, the outline goes along with the corners that are known.
    mean = np.where(known[:, None], mean, outline + (mean - outline)[known].mean(axis=0))
    polygon = shapely.Polygon(mean)
    # Corners of looks that have little in common may cross over.
    return (polygon, error) if polygon.is_valid else (shapely.Polygon(outline), np.nan)


def _outline(
    polygons: NDArray[np.object_],
    corners: list[Array],
    true: list[NDArray[np.bool_]],
    weight: Array,
    whole: NDArray[np.bool_],
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the corners to begin with, and which of them are none: those of the largest of the usual looks."""
    counts = np.array([len(each) for each in corners])
    usual = np.flatnonzero(whole)
    if len(usual):
        usual = usual[counts[usual] == np.argmax(np.bincount(counts[usual], weight[usual]))]
        stack = np.array([corners[number] for number in usual])
        return _aligned(stack).mean(axis=0), np.zeros(stack.shape[1], bool)
    largest = int(np.argmax(shapely.area(polygons)))
    return corners[largest], ~true[largest]


def _put_corners(row: Array, outline: Array, corners: Array, far: float) -> None:
    """Put corners of a look where the nearest corner of the outline is, if each is the other's nearest."""
    if len(corners) == 0:
        return
    distance = np.hypot(*(corners[:, None] - outline[None]).T).T
    nearest = distance.argmin(axis=1)
    mutual = (distance.argmin(axis=0)[nearest] == np.arange(len(corners))) & (distance.min(axis=1) <= far)
    row[nearest[mutual]] = corners[mutual]


def _corners(polygon: shapely.Polygon, unit: float) -> Array:
    """Return the corners of the outer ring, counter-clockwise, from any of them on; straight vertices left out."""
    ring = shapely.get_coordinates(shapely.get_exterior_ring(shapely.orient_polygons(polygon)))[:-1]
    # The vertex farthest from the middle is a corner for certain; from it on the ring is an open line.
    start = int(np.argmax(np.round(np.hypot(*(ring - ring.mean(axis=0)).T), 9)))
    opened = np.vstack([np.roll(ring, -start, axis=0), ring[start]])
    return np.asarray(shapely.get_coordinates(shapely.simplify(shapely.LineString(opened), _STRAIGHT * unit))[:-1])


def _aligned(stack: Array) -> Array:
    """Turn each ring so that its corners answer to those of the ring that all are nearest to; shape (k, c, 2)."""
    count = stack.shape[1]
    turns = np.stack([np.roll(stack, -shift, axis=1) for shift in range(count)])
    # Distance of every ring in every turn from every other one.
    distance = ((turns[:, :, None] - stack[None, None]) ** 2).sum(axis=(3, 4))
    best = distance.min(axis=0)
    middle = int(np.argmin(np.round(best.sum(axis=0), 9)))
    turn = distance[:, :, middle].argmin(axis=0)
    return np.asarray(turns[turn, np.arange(len(stack))])


def _robust_mean(seen: Array, weight: Array) -> tuple[Array, float]:
    """Return the mean of looks corner by corner, those that are far off counting less, and its standard error, metres.

    Parameters
    ----------
    seen : ndarray of float, shape (n, c, 2)
        Corners; NaN where a look does not have one.
    weight : ndarray of float, shape (n,)
        How much each look counts.
    """
    there = np.isfinite(seen[..., 0])
    held = np.where(there[..., None], seen, 0.0)
    corners = zip(seen.swapaxes(0, 1), there.T, strict=True)
    # A corner that nobody saw has no mean.
    mean = np.array([np.median(each[known], axis=0) if known.any() else [np.nan] * 2 for each, known in corners])
    spread = 1e-6
    for _ in range(5 if there.any() else 0):
        off = np.hypot(*np.moveaxis(np.where(there[..., None], seen - mean, 0.0), -1, 0))
        spread = max(float(np.median(off[there])) / _RAYLEIGH, 1e-6)
        robust = np.where(there, weight[:, None] / (1 + (off / (HALF_WEIGHT * spread)) ** 2), 0.0)
        total = robust.sum(axis=0)[:, None]
        mean = np.where(total > 0, (robust[..., None] * held).sum(axis=0) / np.where(total > 0, total, 1.0), np.nan)
    looks = there.sum(axis=0)
    several = looks[looks > 1]
    return mean, spread / float(np.sqrt(several.mean())) if len(several) else np.nan
