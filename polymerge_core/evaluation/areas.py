"""How well areas agree: intersection over union (IoU), and how far their corners are apart."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray

from polymerge_core.curves import Array, Curves, turning
from polymerge_core.evaluation.measures import METRES, NONE, Measure, mean_of

#: A vertex where a ring turns by less than this is no corner, radians.
_CORNER = np.radians(5.0)


def best_overlaps(polygons: NDArray[np.object_], others: NDArray[np.object_]) -> tuple[Array, NDArray[np.intp]]:
    """Return for each polygon its largest IoU with another one, and which; 0 and -1 where none overlaps it."""
    first, second = shapely.STRtree(others).query(polygons, predicate="intersects")
    common = shapely.area(shapely.intersection(polygons[first], others[second]))
    share = common / (shapely.area(polygons[first]) + shapely.area(others[second]) - common)
    order = np.lexsort((second, -share, first))
    best = order[np.diff(first[order], prepend=-1) > 0]
    best = best[share[best] > 0]
    overlap, partner = np.zeros(len(polygons)), np.full(len(polygons), -1)
    overlap[first[best]], partner[first[best]] = share[best], second[best]
    return overlap, partner


def area_measures(
    merged: NDArray[np.object_], reference: NDArray[np.object_], counted: NDArray[np.bool_]
) -> list[Measure]:
    """Return the mean best IoU of the reference areas that count, and the mean distance of their corners.

    Parameters
    ----------
    merged, reference : ndarray of Polygon
        Of one class, metres.
    counted : ndarray of bool
        Which reference areas count.

    Returns
    -------
    list of Measure
        `iou`, 0 for an area that no merged area overlaps; `corner_error`, metres, of the areas that one overlaps: mean
        over their corners of the distance to the nearest corner of the merged area.
    """
    overlap, partner = best_overlaps(reference[counted], merged)
    matched = partner >= 0
    errors = _corner_errors(reference[counted][matched], merged[partner[matched]])
    return [mean_of("iou", NONE, overlap), mean_of("corner_error", METRES, errors)]


def _corner_errors(reference: NDArray[np.object_], merged: NDArray[np.object_]) -> Array:
    if len(reference) == 0:
        return np.empty(0)
    corners, owner = _corners(reference)
    others, whose = _corners(merged)
    points = shapely.multipoints(others, indices=whose)
    distance = shapely.distance(shapely.points(corners), points[owner])
    mean: Array = np.bincount(owner, distance) / np.bincount(owner)
    return mean


def _corners(polygons: NDArray[np.object_]) -> tuple[Array, NDArray[np.intp]]:
    """Return the corners of the outer rings, and whose they are; a ring without any gives all its vertices."""
    rings = shapely.get_exterior_ring(polygons)
    curves = Curves(rings)
    last = np.zeros(len(curves.vertices), dtype=bool)
    last[curves.bounds[1:] - 1] = True
    corner = (turning(curves) >= _CORNER) & ~last
    smooth = np.bincount(curves.owner[corner], minlength=len(curves)) == 0
    corner |= smooth[curves.owner] & ~last
    return curves.vertices[corner], curves.owner[corner]
