"""What the rivals share: how a map is put together from shapes, and the score of a shape that has none."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from polymerge_core.schema import AREA_CLASSES

Shapes = NDArray[np.object_]

#: The proximity of the merge, metres: what is nearer may be the same.
PROXIMITY_M = 1.0


class RivalError(Exception):
    """A rival could not make a map of these observations; the message says what went wrong."""


class NotInstalledError(RivalError):
    """What a rival needs is not there; the message says how to install it."""


def draw_by_class(
    observations: gpd.GeoDataFrame,
    lines: Callable[[gpd.GeoDataFrame], Any],
    areas: Callable[[gpd.GeoDataFrame], Any] | None,
) -> gpd.GeoDataFrame:
    """Make a map class by class of rivals that know neither classes nor scores.

    Parameters
    ----------
    observations : GeoDataFrame
        `class`, `score` and LineStrings, metres.
    lines, areas : callable
        Take the observations of one class and give its shapes. Without `areas`, areas are left out.

    Returns
    -------
    GeoDataFrame
        `class`, `score` (`nearby_scores`) and the shapes.
    """
    parts = [as_map("", [], [], observations.crs)]
    for name, group in observations.groupby("class", sort=True):
        draw = areas if name in AREA_CLASSES else lines
        if draw is not None:
            shapes = np.array(list(draw(group)), dtype=object)
            parts.append(as_map(name, shapes, nearby_scores(shapes, group), observations.crs))
    return gpd.GeoDataFrame(pd.concat(parts, ignore_index=True), crs=observations.crs)


def as_map(name: Any, shapes: Any, scores: Any, crs: Any) -> gpd.GeoDataFrame:
    """Return shapes of one class as a map."""
    classes = np.full(len(shapes), name, dtype=object)
    return gpd.GeoDataFrame({"class": classes, "score": np.asarray(scores, float)}, geometry=list(shapes), crs=crs)


def nearby_scores(shapes: Shapes, observations: gpd.GeoDataFrame) -> NDArray[np.float64]:
    """Return for each shape the mean score of the observations within the proximity, else that of the nearest one."""
    if len(shapes) == 0:
        return np.empty(0)
    tree = shapely.STRtree(observations.geometry.to_numpy())
    score = observations["score"].to_numpy(float)
    shape, near = tree.query(shapes, predicate="dwithin", distance=PROXIMITY_M)
    count = np.bincount(shape, minlength=len(shapes))
    mean = np.bincount(shape, score[near], minlength=len(shapes)) / np.maximum(count, 1)
    return np.where(count > 0, mean, score[tree.nearest(shapes)])


def dissolved_areas(observations: gpd.GeoDataFrame) -> Shapes:
    """Return the union of areas, part by part: what a user of a GIS does with overlapping polygons."""
    polygons = shapely.build_area(observations.geometry.to_numpy())
    return np.asarray(shapely.get_parts(shapely.union_all(polygons)))
