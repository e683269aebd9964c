"""The consensus of areas: as many corners as the evidence has, each at the mean of what was seen of it.

Looks at one area overlap; two areas that one local map saw side by side are different. Of the looks that hold the area
whole (those that do not end at the edge of what their local map looked at) the corners are brought into one order and
averaged, robustly, so that a skewed crossing stays skewed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from polymerge_core.consensus.association import Links, link_groups
from polymerge_core.consensus.looks import Instances
from polymerge_core.consensus.support import SHARE, expected_sightings
from polymerge_core.curves import Array, Index

#: Looks belong together where they have this share of the smaller one in common, in the mean.
OVERLAP = 0.5

#: A corner that leaves the outline where it is within this many proximities is none.
_STRAIGHT = 0.15

#: A look that comes so near to the edge of what its local map looked at may have been cut off there, proximities.
_EDGE = 0.5

#: The largest looks, down to this share of the largest, are taken where none is held whole.
_LARGE = 0.8

#: Squares by which chances of a sighting are learned, proximities.
_SQUARE = 5.0


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
        The merged area of each look; -1 where it was left out.
    """

    shapes: NDArray[np.object_]
    sigma: Array
    seen: Array
    expected: Array
    element: Index


def merge_looks_at_areas(
    polygons: NDArray[np.object_], instance: Index, weight: Array, instances: Instances, unit: float
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

    Returns
    -------
    Areas
        In the order of their first looks.
    """
    group = group_areas(polygons, instance)
    whole = held_whole(polygons, instance, instances, unit)
    order = np.argsort(group, kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(group[order])) + 1)
    fused = [fuse_areas(polygons[rows], weight[rows], whole[rows], unit) for rows in members]
    shapes = np.array([shape for shape, _ in fused], dtype=object)
    sigma = np.array([error for _, error in fused])
    pairs = np.unique(group * len(instances) + instance)
    seen = np.bincount(pairs // len(instances), minlength=len(shapes))
    places = shapely.get_coordinates(shapely.centroid(shapes))
    expected = expected_sightings(places, pairs, seen, instances, _SQUARE * unit)
    kept = seen >= SHARE * np.sqrt(expected)
    number = np.where(kept, np.cumsum(kept) - 1, -1)
    return Areas(shapes[kept], sigma[kept], seen[kept].astype(float), expected[kept], number[group])


def group_areas(polygons: NDArray[np.object_], instance: Index) -> Index:
    """Group looks at the same area, numbered from 0 in the order of their first looks."""
    first, second = shapely.STRtree(polygons).query(polygons, predicate="intersects")
    once = first < second
    first, second = first[once], second[once]
    common = shapely.area(shapely.intersection(polygons[first], polygons[second]))
    area = shapely.area(polygons)
    share = common / np.minimum(area[first], area[second])
    same = instance[first] == instance[second]
    # As with lines, a cost over a length: how little they have in common, against how little they may.
    cost = np.where(same, 0.0, (1.0 - share) / (1.0 - OVERLAP))
    links = Links(first, second, cost, np.where(same, 0.0, 1.0), np.zeros(len(first)), same.astype(float))
    return link_groups(instance, links, 1.0)


def held_whole(polygons: NDArray[np.object_], instance: Index, instances: Instances, unit: float) -> NDArray[np.bool_]:
    """Tell which looks do not end at the edge of what their local map looked at; all where that is not known."""
    if instances.footprint is None:
        return np.ones(len(polygons), dtype=bool)
    edges = shapely.boundary(instances.footprint[instance])
    return np.asarray(shapely.distance(edges, polygons) > _EDGE * unit)


def fuse_areas(
    polygons: NDArray[np.object_], weight: Array, whole: NDArray[np.bool_], unit: float
) -> tuple[shapely.Polygon, float]:
    """Merge the looks at one area.

    Returns
    -------
    polygon : Polygon
        With the number of corners that most looks have.
    error : float
        Standard error of a corner, metres; NaN for a single look.
    """
    if len(polygons) == 1:
        return polygons[0], np.nan
    area = shapely.area(polygons)
    used = np.flatnonzero(whole) if whole.any() else np.flatnonzero(area >= _LARGE * area.max())
    corners = [_corners(polygon, unit) for polygon in polygons[used]]
    counts = np.array([len(each) for each in corners])
    votes = np.bincount(counts, weight[used])
    wanted = int(np.argmax(votes))
    chosen = np.flatnonzero(counts == wanted)
    largest = polygons[used[np.argmax(weight[used] * area[used])]]
    if len(chosen) < 2:
        return largest, np.nan
    stack = np.array([corners[number] for number in chosen])
    aligned = _aligned(stack)
    mean, spread = _robust_mean(aligned, weight[used[chosen]])
    polygon = shapely.Polygon(mean)
    if not polygon.is_valid:  # corners of looks that have little in common
        return largest, np.nan
    return polygon, spread / np.sqrt(len(chosen))


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


def _robust_mean(stack: Array, weight: Array) -> tuple[Array, float]:
    """Return the mean of rings corner by corner, looks that are far off counting less, and their spread, metres."""
    mean = np.median(stack, axis=0)
    spread = 0.0
    for _ in range(5):
        off = np.hypot(*np.moveaxis(stack - mean, -1, 0))
        spread = max(float(np.median(off)) / 1.1774, 1e-6)  # of a normal error in the plane
        robust = weight[:, None] / (1 + (off / (2 * spread)) ** 2)
        mean = (robust[..., None] * stack).sum(axis=0) / robust.sum(axis=0)[:, None]
    return mean, spread
