"""The truth of a small town junction, drawn for tests and demonstrations, and one drive through it.

Four arms meet. West and east is a main street with double centre lines 0.4 m apart and lane lines; the north
arm is set at an angle; the south arm is curved. The corners are rounded, two closed islands stand in the
road, two crossings are straight and two are skewed. It is no real place: it lies in the open North Sea.
"""

from __future__ import annotations

from dataclasses import dataclass

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

Array = NDArray[np.float64]

CRS = "EPSG:32632"
CENTRE = np.array([400_000.0, 6_040_000.0])

_ARM_M = 60.0
_CORNER_RADIUS_M = 6.0
_TURN_RADIUS_M = 11.0
_LANE_M = 3.5
_CROSSING_M = (11.0, 14.5)
_LINES_FROM_M = 17.0
_FIRST_TIMESTAMP_NS = 1_700_000_000_000_000_000
_SPEED_M_S = 7.0


@dataclass(frozen=True)
class _Arm:
    """A street that leaves the junction: straight for 15 m, then bent."""

    heading: float  # radians, outward, from east towards north
    half_width: float  # metres
    bend: float = 0.0  # curvature, 1/m, to the left
    skew: float = 0.0  # metres by which the left end of the crossing lies farther out than the right one

    def at(self, distance: Array | float, left: Array | float = 0.0) -> Array:
        """Return points at distances along the arm and to the left of its axis, shape (n, 2)."""
        distance, left = np.broadcast_arrays(np.atleast_1d(np.asarray(distance, float)), left)
        straight, bent = np.minimum(distance, 15.0), np.maximum(distance - 15.0, 0.0)
        chord = bent * np.sinc(self.bend * bent / (2 * np.pi))
        middle, end = self.heading + self.bend * bent / 2, self.heading + self.bend * bent
        return np.asarray(
            straight[:, None] * _direction(self.heading)
            + chord[:, None] * _direction(middle)
            + left[:, None] * _direction(end + np.pi / 2)
        )


_EAST = _Arm(0.0, 2 * _LANE_M, skew=2.0)
_NORTH = _Arm(np.radians(78.0), 4.5, skew=3.0)
_WEST = _Arm(np.pi, 2 * _LANE_M)
_SOUTH = _Arm(np.radians(-90.0), 4.0, bend=1 / 45)
_ARMS = (_EAST, _NORTH, _WEST, _SOUTH)


def town_truth() -> gpd.GeoDataFrame:
    """Draw the true map of the junction.

    Returns
    -------
    GeoDataFrame
        ``element_id`` (from 0), ``class`` (``ped_crossing``, ``divider``, ``boundary``) and LineStrings in
        `CRS`, to the millimetre; crossings and islands are closed. The same on every call.
    """
    lines = {"ped_crossing": _crossings(), "divider": _dividers(), "boundary": [*_kerbs(), *_islands()]}
    classes = [name for name, group in lines.items() for _ in group]
    geometry = [shapely.LineString(np.round(line + CENTRE, 3)) for group in lines.values() for line in group]
    columns = {"element_id": np.arange(len(classes)), "class": classes}
    return gpd.GeoDataFrame(columns, geometry=geometry, crs=CRS)


def town_drive() -> pd.DataFrame:
    """Drive up the curved south arm and turn left into the west arm, keeping to the right.

    Returns
    -------
    DataFrame
        True poses every 0.1 m at 7 m/s: ``timestamp_ns,qw,qx,qy,qz,tx_m,ty_m,tz_m``, metres in `CRS`.
    """
    approach = _SOUTH.at(np.arange(42.0, 0.0, -0.5), 2.0)
    leave = _WEST.at(np.arange(0.0, 45.0, 0.5), _LANE_M / 2)
    path = _joined(approach, leave, _TURN_RADIUS_M)
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    at = np.arange(0.0, arc[-1], 0.1)
    x, y = (np.interp(at, arc, axis) for axis in path.T)
    # A vehicle does not follow the corners of a polyline: its course is that over 2 m of way.
    ahead, behind = (np.column_stack([np.interp(at + step, arc, axis) for axis in path.T]) for step in (1.0, -1.0))
    half = np.arctan2(*(ahead - behind).T[::-1]) / 2
    zero = np.zeros_like(at)
    poses: pd.DataFrame = pd.DataFrame(
        {
            "timestamp_ns": _FIRST_TIMESTAMP_NS + np.round(at / _SPEED_M_S * 1e9).astype(np.int64),
            "qw": np.cos(half),
            "qx": zero,
            "qy": zero,
            "qz": np.sin(half),
            "tx_m": x + CENTRE[0],
            "ty_m": y + CENTRE[1],
            "tz_m": zero,
        }
    )
    return poses


def _crossings() -> list[Array]:
    near, far = _CROSSING_M
    along, across = np.array([near, far, far, near, near]), np.array([-1, -1, 1, 1, -1])
    return [arm.at(along + across * arm.skew / 2, across * (arm.half_width - 0.5)) for arm in _ARMS]


def _dividers() -> list[Array]:
    along = np.arange(_LINES_FROM_M, _ARM_M + 0.1, 1.0)
    # In the west and south arm the centre line starts beyond the island.
    plan = [(arm, 9, left) for arm in (_WEST, _SOUTH) for left in (-0.2, 0.2)]
    plan += [(_EAST, 0, left) for left in (-0.2, 0.2)] + [(_NORTH, 0, 0.0)]
    plan += [(arm, 0, left) for arm in (_EAST, _WEST) for left in (-_LANE_M, _LANE_M)]
    return [_thinned(arm.at(along[skip:], left)) for arm, skip, left in plan]


def _kerbs() -> list[Array]:
    """Return the four kerbs, each from the left edge of one arm round the corner to the right of the next."""
    along = np.arange(_ARM_M, -0.1, -1.0)
    neighbours = zip(_ARMS, (*_ARMS[1:], _ARMS[0]), strict=True)
    return [
        _thinned(_joined(arm.at(along, arm.half_width), after.at(along[::-1], -after.half_width), _CORNER_RADIUS_M))
        for arm, after in neighbours
    ]


def _islands() -> list[Array]:
    """Return two islands with round ends in the middle of the west and the south arm."""
    angle = np.radians(np.arange(-90.0, 91.0, 15.0))
    half = 0.9
    along = np.concatenate([23.5 + half * np.cos(angle), 18.5 - half * np.cos(angle)])
    left = half * np.concatenate([np.sin(angle), -np.sin(angle)])
    return [arm.at(np.append(along, along[0]), np.append(left, left[0])) for arm in (_WEST, _SOUTH)]


def _joined(before: Array, after: Array, radius: float) -> Array:
    """Join two lines that are straight near their common corner by an arc that touches both."""
    ahead, onward = _unit(before[-1] - before[-2]), _unit(after[1] - after[0])
    corner = before[-1] + ahead * _cross(after[0] - before[-1], onward) / _cross(ahead, onward)
    turn = np.arctan2(_cross(ahead, onward), ahead @ onward)
    touch = radius * np.tan(abs(turn) / 2)
    course = np.arctan2(ahead[1], ahead[0]) + np.linspace(0.0, turn, 13)
    # A chord of an arc is 2 r sin(half its angle) long and points half-way between the courses at its ends.
    chord = 2 * radius * np.abs(np.sin((course - course[0]) / 2))
    arc = corner - touch * ahead + chord[:, None] * _direction((course + course[0]) / 2)
    start, end = (before - corner) @ ahead < -touch, (after - corner) @ onward > touch
    return np.concatenate([before[start], arc, after[end]])


def _thinned(line: Array) -> Array:
    return np.asarray(shapely.get_coordinates(shapely.simplify(shapely.LineString(line), 0.01)))


def _direction(heading: Array | float) -> Array:
    return np.stack([np.cos(heading), np.sin(heading)], axis=-1)


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.hypot(*vector))


def _cross(a: Array, b: Array) -> float:
    return float(a[0] * b[1] - a[1] * b[0])
