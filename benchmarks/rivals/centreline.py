"""The usual recipe of a GIS: buffer, dissolve, and draw the centre lines of what comes out."""

from __future__ import annotations

import math

import geopandas as gpd
import numpy as np
import shapely

from benchmarks.rivals.layers import PROXIMITY_M, Shapes, dissolved_areas, draw_by_class

#: Half the proximity: buffers touch where the lines are nearer than the proximity.
RADIUS_M = PROXIMITY_M / 2
#: Holes smaller than the buffer of a point are slivers between lines that are nearly the same.
_FILLED_M2 = math.pi * RADIUS_M**2
_BOUNDARY_STEP_M = RADIUS_M / 2
#: Takes out the zigzag of the Voronoi edges.
_SIMPLIFIED_M = RADIUS_M / 5
_GRID_M = 0.001
_PASSES = 3


def buffer_centreline(observations: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Draw the centre lines of the dissolved buffers of lines; dissolve areas."""
    return draw_by_class(observations, _centrelines, dissolved_areas)


def _centrelines(observations: gpd.GeoDataFrame) -> Shapes:
    buffers = shapely.get_parts(shapely.union_all(shapely.buffer(observations.geometry.to_numpy(), RADIUS_M)))
    return np.concatenate([centreline(_without_slivers(polygon)) for polygon in buffers])


def _without_slivers(polygon: shapely.Polygon) -> shapely.Polygon:
    holes = [hole for hole in polygon.interiors if shapely.Polygon(hole).area >= _FILLED_M2]
    return shapely.Polygon(polygon.exterior, holes)


def centreline(polygon: shapely.Polygon) -> Shapes:
    """Return the centre lines of a polygon: the Voronoi edges of its boundary that are inside, less short branches."""
    shapely.prepare(polygon)
    points = shapely.MultiPoint(shapely.get_coordinates(shapely.segmentize(polygon.boundary, _BOUNDARY_STEP_M)))
    edges = shapely.get_parts(shapely.voronoi_polygons(points, only_edges=True))
    # Where many boundary points are equally near, the same Voronoi vertex comes out more than once.
    edges = shapely.get_parts(shapely.union_all(edges[shapely.contains_properly(polygon, edges)], grid_size=_GRID_M))
    lines = _merged(edges)
    for _ in range(_PASSES):
        lines = _merged(lines[~_is_whisker(lines, polygon.boundary)])
    return np.asarray(shapely.simplify(lines, _SIMPLIFIED_M))


def _merged(lines: Shapes) -> Shapes:
    """Join lines at their common ends into the longest lines that do not branch."""
    return np.asarray(shapely.get_parts(shapely.line_merge(shapely.multilinestrings(list(lines)))))


def _is_whisker(lines: Shapes, boundary: shapely.Geometry) -> Shapes:
    """Tell which lines end freely at one end only, and hardly come out of the largest disc round the other."""
    if len(lines) == 0:
        return np.empty(0, dtype=bool)
    ends = shapely.get_point(lines, [[0], [-1]])
    _, node, count = np.unique(shapely.get_coordinates(ends), axis=0, return_inverse=True, return_counts=True)
    free = (count[node.ravel()] == 1).reshape(2, -1).sum(axis=0)
    disc = shapely.distance(ends, boundary).max(axis=0)
    return np.asarray((free == 1) & (shapely.length(lines) < disc + RADIUS_M))
