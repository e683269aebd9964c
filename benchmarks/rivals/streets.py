"""Simplifiers of street networks: neatnet, and parenx with its two methods.

Both make one line of the parallel lines of a street, know lines only (areas are left out), and have defaults for
streets, where lines up to 10 m (neatnet) or 16 m (parenx) apart are one. Here the proximity takes the place of
that distance, and every other length and area keeps its proportion to it.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import math
import warnings
from types import ModuleType
from typing import Any

import geopandas as gpd
import numpy as np
import shapely

from benchmarks.rivals.layers import PROXIMITY_M, NotInstalledError, RivalError, Shapes, draw_by_class

#: neatnet's consolidation tolerance and parenx's buffer radius for streets, metres.
_NEATNET_STREET_M, _PARENX_RADIUS_M = 10.0, 8.0

#: The defaults of `neatnet.neatify`, in proportion. The consolidation of nodes inside a face is left off: with it,
#: neatnet 0.1.6 raises on 10 of the 18 classes of lines of the Argoverse 2 scenarios, seeds 1 to 3.
_PART = PROXIMITY_M / _NEATNET_STREET_M
_NEATNET: dict[str, Any] = {
    "max_segment_length": 1 * _PART,
    "min_dangle_length": 20 * _PART,
    "clip_limit": 2 * _PART,
    "consolidation_tolerance": 0,
    "artifact_threshold_fallback": 7 + 2 * math.log(_PART),  # logarithm of an area
    "area_threshold_blocks": 1e5 * _PART**2,
    "area_threshold_circles": 5e4 * _PART**2,
}
#: The defaults of parenx's command line.
_SKELETON = {"simplify": 0.0, "buffer": _PARENX_RADIUS_M, "scale": 1.0, "knot": False, "segment": False}
_VORONOI = {"simplify": 0.0, "buffer": _PARENX_RADIUS_M, "scale": 5.0, "tolerance": 1.0}
#: parenx has constants in metres that no option reaches, so that the map is made larger and not the options smaller.
_PARENX_SCALE = 2 * _PARENX_RADIUS_M / PROXIMITY_M
#: parenx takes every layer for one in this CRS.
_PARENX_CRS = "EPSG:27700"

#: What comes out of the two packages where they meet a case that they do not know.
_FAULTS = (AttributeError, IndexError, KeyError, TypeError, ValueError)


def neatnet_streets(observations: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Simplify with `neatnet.neatify`; the lines are cut at their crossings first, which it takes for granted."""
    neatnet = _package("neatnet")
    return draw_by_class(observations, lambda group: _neatified(neatnet, group), None)


def _neatified(neatnet: ModuleType, observations: gpd.GeoDataFrame) -> Shapes:
    noded = list(shapely.get_parts(shapely.union_all(observations.geometry.to_numpy())))
    streets = gpd.GeoDataFrame(geometry=noded, crs=observations.crs)
    try:
        return _looped(neatnet, streets, 2)
    except RivalError:
        # The second loop raises, most often because the first left no face: then the lines of the first are the map.
        return _looped(neatnet, streets, 1)


def _looped(neatnet: ModuleType, streets: gpd.GeoDataFrame, loops: int) -> Shapes:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            simple = neatnet.neatify(streets, n_loops=loops, **_NEATNET)
    except _FAULTS as error:
        raise RivalError(f"neatnet failed: {type(error).__name__}") from error
    return np.asarray(shapely.get_parts(simple.geometry.to_numpy()))


def parenx_skeleton(observations: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Simplify with `parenx.skeletonize_frame`: the skeleton of the rasterised buffer."""
    parenx = _package("parenx")
    return draw_by_class(observations, lambda group: _scaled(parenx.skeletonize_frame, group, _SKELETON), None)


def parenx_voronoi(observations: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Simplify with `parenx.voronoi_frame`: the Voronoi edges inside the buffer."""
    parenx = _package("parenx")
    return draw_by_class(observations, lambda group: _scaled(parenx.voronoi_frame, group, _VORONOI), None)


def _scaled(simplify: Any, observations: gpd.GeoDataFrame, options: dict[str, Any]) -> Shapes:
    corner = np.floor(observations.total_bounds[:2])
    lines = shapely.transform(observations.geometry.to_numpy(), lambda xy: (xy - corner) * _PARENX_SCALE)
    try:
        # It tells its progress on standard output.
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            simple = simplify(gpd.GeoSeries(lines, crs=_PARENX_CRS), dict(options))
    except _FAULTS as error:
        raise RivalError(f"parenx failed: {type(error).__name__}") from error
    parts = shapely.get_parts(simple.geometry.to_numpy())
    parts = parts[shapely.length(parts) > 0]
    return np.asarray(shapely.transform(parts, lambda xy: xy / _PARENX_SCALE + corner))


def _package(name: str) -> ModuleType:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise NotInstalledError(f"not installed: pip install {name}") from error
