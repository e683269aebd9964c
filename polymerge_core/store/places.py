"""Places along elements, at which these are judged."""

from __future__ import annotations

from typing import NamedTuple

import geopandas as gpd
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from polymerge_core.curves import Array, Curves, Index, count_up

#: Places along lines are judged at steps of so many proximities.
STEP = 2.0

_TINY = float(np.finfo(float).tiny)


class Places(NamedTuple):
    """Places along elements, at which these are judged; one entry a place, element by element."""

    element: Index
    points: Array
    #: Direction to the left of the element; NaN for areas, which have one place.
    normal: Array


def places_along(elements: gpd.GeoDataFrame, area: NDArray[np.bool_], place: BaseGeometry, unit: float) -> Places:
    """Return the places along elements inside a place; an area has one, its centre."""
    shapes = elements.geometry.to_numpy()
    rows = np.flatnonzero(~area)
    curves = Curves(shapes[rows])
    steps = np.maximum(np.round(curves.length / (STEP * unit)), 1).astype(np.intp)
    line, number = count_up(steps)
    position = (number + 0.5) * (curves.length / steps)[line]
    points = curves.points_at(line, position)
    half = 0.5 * unit
    chord = curves.points_at(line, position + half) - curves.points_at(line, position - half)
    chord /= np.maximum(np.hypot(*chord.T), _TINY)[:, None]
    centres = shapely.get_coordinates(shapely.centroid(shapes[area])).reshape(-1, 2)
    every = np.concatenate([points, centres])
    owner = np.concatenate([rows[line], np.flatnonzero(area)])
    normal = np.concatenate([np.column_stack([-chord[:, 1], chord[:, 0]]), np.full(centres.shape, np.nan)])
    inside = shapely.intersects(place, shapely.points(every)) if len(every) else np.empty(0, dtype=bool)
    order = np.flatnonzero(inside)[np.argsort(owner[inside], kind="stable")]
    return Places(owner[order], every[order], normal[order])
