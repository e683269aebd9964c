"""Step 1: from the vehicle's frame to the map's (paper, section II-B.1, eq. 1).

A vertex of a prediction is turned and shifted by the pose of its frame, ``v_world = q v_ego q^-1 + T``. Poses
come in four kinds. Those in metres of a CRS are eq. 1 as it stands. Those given as latitude, longitude and
heading, or as metres from a geographic origin, go through a topocentric frame (east, north, up at the point)
to Earth-centred coordinates and only then to the CRS, so that meridian convergence and scale come out right
in any projection; metres added to an easting are not exact in UTM and wrong in Web Mercator.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, get_args

import geopandas as gpd
import numpy as np
import pandas as pd
import pyproj
import shapely
from numpy.typing import ArrayLike, NDArray

from polymerge_core.crs import (
    SCALE_TOLERANCE,
    check_coordinates,
    is_local,
    is_metric,
    parse_crs,
    scale_error,
    transformer,
)
from polymerge_core.errors import CrsError, InputError, OptionError
from polymerge_core.formats.records import LeftOutVector, Poses, Predictions
from polymerge_core.formats.rotation import heading_to_matrix, is_rigid_motion, quaternion_to_matrix
from polymerge_core.schema import LEFT_OUT_COLUMNS, LocalMaps, empty_table

__all__ = ["Poses", "Predictions", "ego_to_world", "project", "quaternion_to_matrix"]

Array = NDArray[np.float64]
PoseKind = Literal["crs", "origin", "geodetic", "offset"]

#: The box that a predictor of 60 m x 30 m looks at: xmin, ymin, xmax, ymax in the vehicle's frame, metres.
DEFAULT_FOOTPRINT = (-30.0, -15.0, 30.0, 15.0)

#: Poses in metres of a CRS whose metre is further than this from a metre on the ground are refused.
MAX_SCALE_ERROR = 10 * SCALE_TOLERANCE

#: How far ahead of the vehicle the point is whose direction in the CRS is the heading, metres.
_AHEAD_M = 10.0

_GEOCENTRIC = pyproj.CRS.from_epsg(4978)
_GEODETIC_3D = pyproj.CRS.from_epsg(4979)
_GEODETIC = pyproj.CRS.from_epsg(4326)


def project(
    predictions: Predictions,
    poses: Poses,
    *,
    crs: Any,
    pose_kind: PoseKind = "crs",
    origin: tuple[float, float] | None = None,
    pose_offset: tuple[float, float] | None = None,
    lidar_to_ego: ArrayLike | None = None,
    footprint: tuple[float, float, float, float] = DEFAULT_FOOTPRINT,
    drive: str | None = None,
) -> LocalMaps:
    """Place predictions on the map (paper, eq. 1).

    Parameters
    ----------
    predictions : Predictions
        As `read_predictions` gives them.
    poses : Poses
        As `read_poses` gives them; a frame's token is matched with a pose's token, else with its timestamp.
    crs : any
        CRS of the result, in any form that pyproj takes, or ``"local"`` for plain metric coordinates.
    pose_kind : {"crs", "origin", "geodetic", "offset"}, default "crs"
        ``crs``: metres in `crs`; ``origin``: metres east, north (and up) of `origin` in the topocentric frame
        there; ``geodetic``: latitude, longitude and heading from true north, or the quaternion as attitude in
        the local east-north-up frame where there is no heading; ``offset``: grid metres to which
        `pose_offset` is added.
    origin : (float, float), optional
        Latitude and longitude of the map origin in degrees on WGS 84, for ``origin``.
    pose_offset : (float, float), optional
        Easting and northing in metres, for ``offset``.
    lidar_to_ego : array_like of float, shape (4, 4), optional
        Rigid transform from the LiDAR's frame to the vehicle's, for predictions in the LiDAR's frame.
        Identity by default: right only where the LiDAR's axes are the vehicle's (in nuScenes they are not:
        there x points right and y forward), so that a `UserWarning` says when it was taken for granted.
    footprint : (float, float, float, float), default (-30, -15, 30, 15)
        xmin, ymin, xmax, ymax of what the predictor looks at, in the vehicle's frame, metres.
    drive : str, optional
        Name of the drive, the source of the predictions by default.

    Returns
    -------
    LocalMaps
        Observations (`class`, `drive`, `instance`, `score`, `timestamp`) and instances, both in `crs`.
        `heading` is in degrees clockwise from grid north. Vectors that could not be placed are in its
        `left_out`, where `source_fid` is their position in their frame.

    Raises
    ------
    InputError
        If a frame has no pose, or the poses lack what their kind needs.
    CrsError
        If the CRS is unknown, or not one in which the poses can be, or far from where they lie.
    OptionError
        If an option has a value that it cannot have, or belongs to another kind of pose.

    Examples
    --------
    >>> import numpy as np
    >>> seen = Predictions(
    ...     tokens=["7"],
    ...     coordinates=np.array([[0.0, 2.0], [10.0, 2.0]]),
    ...     offsets=np.array([0, 2]),
    ...     frame=np.array([0]),
    ...     index=np.array([0]),
    ...     class_name=np.array(["divider"], dtype=object),
    ...     score=np.array([0.9]),
    ... )
    >>> facing_north = quaternion_to_matrix([[1.0, 0.0, 0.0, 1.0]])
    >>> poses = Poses(np.array([7]), rotation=facing_north, translation=np.array([[100.0, 200.0, 0.0]]))
    >>> print(shapely.set_precision(project(seen, poses, crs="local").observations.geometry[0], 0.001))
    LINESTRING (98 200, 98 210)
    """
    target = parse_crs(crs)
    box = _footprint_corners(footprint)
    _check_options(pose_kind, origin, pose_offset, target)
    sensor = _sensor_to_ego(lidar_to_ego, predictions)
    matched = poses.take(_match(predictions, poses))
    placing = _placing(matched, pose_kind, origin, pose_offset, target)

    k, n = len(predictions.tokens), len(predictions.coordinates)
    vertex_frame = np.repeat(predictions.frame, np.diff(predictions.offsets))
    marks = np.concatenate([[(0.0, 0.0), (_AHEAD_M, 0.0)], box])  # of every frame: position, a point ahead, the box
    seen = ego_to_world(
        predictions.coordinates,
        placing.rotation @ sensor[:3, :3],
        placing.rotation @ sensor[:3, 3] + placing.translation,
        frame=vertex_frame,
    )
    mark_frame = np.repeat(np.arange(k), len(marks))
    marked = ego_to_world(np.tile(marks, (k, 1)), placing.rotation, placing.translation, frame=mark_frame)
    plane = _to_plane(np.concatenate([seen, marked]), placing.space, target)
    marked_plane = plane[n:].reshape(k, len(marks), 2)
    _check_positions(marked_plane, matched, pose_kind, target)

    name = predictions.source if drive is None else drive
    observations, lost = _observations(predictions, plane[:n], matched, target, name)
    return LocalMaps(
        observations,
        _instances(predictions, observations, marked_plane, matched, target, name),
        source=predictions.source,
        left_out=_left_out([*predictions.left_out, *lost], predictions.source, name),
    )


def ego_to_world(
    vertices: ArrayLike, rotation: ArrayLike, translation: ArrayLike, *, frame: ArrayLike | None = None
) -> Array:
    """Turn and shift vertices by the pose of their frame (paper, eq. 1).

    Parameters
    ----------
    vertices : array_like of float, shape (n, 2) or (n, 3)
        Vehicle's frame, metres; two columns are lifted to z = 0.
    rotation : array_like of float, shape (k, 3, 3)
        Vehicle to world.
    translation : array_like of float, shape (k, 3)
        Metres.
    frame : array_like of int, shape (n,), optional
        The pose of each vertex; by default vertex i has pose i.

    Returns
    -------
    ndarray of float, shape (n, 3)
        World frame, metres. Equal vertices of one frame give equal results, so that closed lines stay closed.

    Examples
    --------
    >>> ego_to_world([[1.0, 0.0]], [[[0, -1, 0], [1, 0, 0], [0, 0, 1]]], [[5.0, 5.0, 0.0]]).tolist()
    [[5.0, 6.0, 0.0]]
    """
    points, turn = np.asarray(vertices, dtype=np.float64), np.asarray(rotation, dtype=np.float64)
    of_vertex = np.arange(len(points)) if frame is None else np.asarray(frame, dtype=np.intp)
    world: Array = np.asarray(translation, dtype=np.float64)[of_vertex]
    # Column by column: a third of the memory of an einsum, and no fused sums that depend on the position.
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is infinite: the caller leaves it out
        for axis in range(points.shape[1]):
            world += turn[:, :, axis][of_vertex] * points[:, axis, None]
    return world


# --- where the frames are -----------------------------------------------------------------------------------


class _Placing(NamedTuple):
    """Poses of the frames in one Cartesian space: that of the result's CRS, or the Earth-centred one."""

    rotation: Array
    translation: Array
    space: pyproj.CRS


def _placing(
    poses: Poses,
    pose_kind: PoseKind,
    origin: tuple[float, float] | None,
    pose_offset: tuple[float, float] | None,
    target: pyproj.CRS,
) -> _Placing:
    if pose_kind == "geodetic":
        lat, lon = _needed(poses, "lat", pose_kind), _needed(poses, "lon", pose_kind)
        height = np.zeros(len(lat)) if poses.height_m is None else poses.height_m
        heading = poses.heading_deg
        attitude = _needed(poses, "rotation", pose_kind) if heading is None else heading_to_matrix(heading)
        axes, centre = _topocentric(lat, lon, height)
        return _Placing(axes @ attitude, centre, _GEOCENTRIC)
    rotation, translation = _needed(poses, "rotation", pose_kind), _needed(poses, "translation", pose_kind)
    if origin is not None:
        axes, centre = _topocentric(np.array([origin[0]]), np.array([origin[1]]), np.zeros(1))
        return _Placing(axes @ rotation, translation @ axes[0].T + centre, _GEOCENTRIC)
    return _Placing(rotation, translation + np.array([*(pose_offset or (0.0, 0.0)), 0.0]), target)


def _topocentric(lat: Array, lon: Array, height_m: Array) -> tuple[Array, Array]:
    """Return the axes east, north, up as columns, and the origin, of topocentric frames in EPSG:4978."""
    phi, lam = np.radians(lat), np.radians(lon)
    zero = np.zeros_like(phi)
    east = np.column_stack([-np.sin(lam), np.cos(lam), zero])
    north = np.column_stack([-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)])
    up = np.column_stack([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])
    to_geocentric = pyproj.Transformer.from_crs(_GEODETIC_3D, _GEOCENTRIC, always_xy=True)
    return np.stack([east, north, up], axis=-1), np.column_stack(to_geocentric.transform(lon, lat, height_m))


def _to_plane(points: Array, space: pyproj.CRS, target: pyproj.CRS) -> Array:
    """Bring Cartesian points to x and y of the target; infinite where a point has no place in it."""
    if space is target or not len(points):
        return points[:, :2]
    to_degrees = pyproj.Transformer.from_crs(_GEOCENTRIC, _GEODETIC_3D, always_xy=True)
    lon, lat, _ = to_degrees.transform(*points.T)
    # Not in one step: from longitude and latitude PROJ takes the way that every GIS takes.
    to_target = pyproj.Transformer.from_crs(_GEODETIC, target, always_xy=True)
    return np.column_stack(to_target.transform(lon, lat))


def _match(predictions: Predictions, poses: Poses) -> NDArray[np.intp]:
    """Return the row of each frame's pose: the one with its token, else the one with its timestamp."""
    wanted = np.array(predictions.tokens, dtype=object)
    rows = _first_rows(poses.timestamp_ns.astype(str).astype(object), wanted)
    if poses.token is not None:
        named = _first_rows(poses.token, wanted)
        rows = np.where(named >= 0, named, rows)
    lacking = np.flatnonzero(rows < 0)
    if len(lacking):
        raise InputError(
            f"{predictions.source}: frame {wanted[lacking[0]]!r} has no pose in {poses.source} "
            f"({len(lacking)} of {len(wanted)} frames have none); name its pose by token or timestamp_ns"
        )
    return rows


def _first_rows(keys: NDArray[np.object_], wanted: NDArray[np.object_]) -> NDArray[np.intp]:
    """Return where each wanted key stands first, -1 where it does not (a repeated key has equal poses)."""
    index = pd.Index(keys)
    first = np.append(np.flatnonzero(~index.duplicated()), -1)
    rows: NDArray[np.intp] = first[index.drop_duplicates().get_indexer(pd.Index(wanted))]
    return rows


def _needed(poses: Poses, name: str, pose_kind: str) -> Array:
    value: Array | None = getattr(poses, name)
    if value is None:
        hint = "; they are latitudes and longitudes: give pose_kind=geodetic" if poses.lat is not None else ""
        raise InputError(f"{poses.source}: the poses have no {name}, which pose_kind={pose_kind} needs{hint}")
    return value


# --- checks -------------------------------------------------------------------------------------------------


def _check_options(
    pose_kind: str,
    origin: tuple[float, float] | None,
    pose_offset: tuple[float, float] | None,
    target: pyproj.CRS,
) -> None:
    if pose_kind not in get_args(PoseKind):
        raise OptionError(f"pose_kind cannot be {pose_kind!r}; it is one of {', '.join(get_args(PoseKind))}")
    for name, pair, kind in (("origin", origin, "origin"), ("pose_offset", pose_offset, "offset")):
        if pair is None and pose_kind == kind:
            raise OptionError(f"pose_kind={kind} needs {name}: give it too")
        if pair is not None and pose_kind != kind:
            raise OptionError(f"{name} goes with pose_kind={kind}, not with pose_kind={pose_kind}")
        if pair is not None and not (np.shape(pair) == (2,) and np.isfinite(pair).all()):
            raise OptionError(f"{name} cannot be {pair!r}; it is two numbers")
    if origin is not None and not (abs(origin[0]) <= 90.0 and abs(origin[1]) <= 360.0):
        raise OptionError(f"origin cannot be {origin!r}; it is LAT,LON in degrees")
    on_earth = pose_kind in ("origin", "geodetic")
    if on_earth and (is_local(target) or not target.is_projected):
        raise CrsError(
            f"poses of the kind {pose_kind} cannot be placed in {target.name}; "
            "give a projected CRS, such as the UTM zone"
        )
    if not on_earth and not is_metric(target):
        raise CrsError(
            f"poses of the kind {pose_kind} are in metres of the CRS, but {target.name} is not projected in "
            "metres; give the CRS that the poses are in, or local for plain metric coordinates"
        )


def _footprint_corners(footprint: Sequence[float]) -> Array:
    """Return the four corners of the box, anticlockwise."""
    box = np.asarray(footprint, dtype=np.float64)
    if box.shape != (4,) or not np.isfinite(box).all() or box[0] >= box[2] or box[1] >= box[3]:
        raise OptionError(f"footprint cannot be {footprint!r}; it is XMIN,YMIN,XMAX,YMAX in metres")
    return box[[[0, 1], [2, 1], [2, 3], [0, 3]]]


def _sensor_to_ego(lidar_to_ego: ArrayLike | None, predictions: Predictions) -> Array:
    if lidar_to_ego is None:
        if predictions.frame_kind == "lidar":
            warnings.warn(
                f"{predictions.source}: the format is in the LiDAR's frame and no lidar_to_ego was given, so the "
                "LiDAR's axes are taken for the vehicle's; in nuScenes they are not, and everything comes out turned",
                UserWarning,
                stacklevel=3,
            )
        return np.eye(4)
    if predictions.frame_kind != "lidar":
        raise OptionError(
            f"lidar_to_ego was given, but the format of {predictions.source} is in the vehicle's frame; leave it out"
        )
    if not is_rigid_motion(lidar_to_ego):
        raise OptionError("lidar_to_ego must be a rigid 4x4 matrix: a rotation, a translation, and 0, 0, 0, 1 below")
    return np.asarray(lidar_to_ego, dtype=np.float64)


def _check_positions(marked: Array, poses: Poses, pose_kind: str, target: pyproj.CRS) -> None:
    """Refuse frames that came out nowhere, far from where the CRS is used, or in false metres."""
    if not len(marked):
        return
    lost = ~np.isfinite(marked).all(axis=(1, 2))
    if lost.any():
        stamp = poses.timestamp_ns[int(lost.argmax())]
        raise CrsError(f"{poses.source}: the pose of timestamp {stamp} has no place in {target.name}; check the CRS")
    low, high = marked.min(axis=(0, 1)), marked.max(axis=(0, 1))
    check_coordinates(target, (low[0], low[1], high[0], high[1]), poses.source)
    if is_local(target) or pose_kind not in ("crs", "offset"):
        return
    error = scale_error(target, *transformer(target, _GEODETIC).transform(*marked[:, 0].T))
    if error > MAX_SCALE_ERROR:
        raise CrsError(
            f"{poses.source}: a metre of {target.name} is {error:.0%} off a metre on the ground here, "
            "so metres of the vehicle's frame do not fit it; use pose_kind=geodetic, or a CRS true to scale"
        )


# --- the result ---------------------------------------------------------------------------------------------


def _observations(
    predictions: Predictions, plane: Array, poses: Poses, target: pyproj.CRS, drive: str
) -> tuple[gpd.GeoDataFrame, list[LeftOutVector]]:
    """Build one line a vector; those that have no place in the CRS are returned as left out."""
    sizes = np.diff(predictions.offsets)
    vector = np.repeat(np.arange(len(sizes)), sizes)
    outside = np.zeros(len(sizes), dtype=bool)
    outside[vector[~np.isfinite(plane).all(axis=1)]] = True
    tokens = np.array(predictions.tokens, dtype=object)
    reason = f"a coordinate has no place in {target.name}"
    lost = [
        LeftOutVector(tokens[predictions.frame[row]], int(predictions.index[row]), float("nan"), reason)
        for row in np.flatnonzero(outside)
    ]
    kept, inside = ~outside, ~outside[vector]
    frame = predictions.frame[kept]
    columns = {
        "class": predictions.class_name[kept],
        "drive": np.full(len(frame), drive, dtype=object),
        "instance": tokens[frame],
        "score": predictions.score[kept],
        "timestamp": poses.timestamp_ns[frame],
    }
    lines = shapely.linestrings(plane[inside], indices=(np.cumsum(kept) - 1)[vector[inside]])
    return _layer(columns, lines, target), lost


def _instances(
    predictions: Predictions,
    observations: gpd.GeoDataFrame,
    marked: Array,
    poses: Poses,
    target: pyproj.CRS,
    drive: str,
) -> gpd.GeoDataFrame:
    """Build one footprint a frame; `marked` has its position, the point ahead and the corners of the box."""
    position, corners = marked[:, 0], marked[:, 2:]
    ahead = marked[:, 1] - position
    seen = observations["instance"].value_counts()
    columns = {
        "drive": np.full(len(marked), drive, dtype=object),
        "instance": np.array(predictions.tokens, dtype=object),
        "timestamp_ns": poses.timestamp_ns,
        "x": position[:, 0],
        "y": position[:, 1],
        "heading": np.degrees(np.arctan2(ahead[:, 0], ahead[:, 1])) % 360.0 % 360.0,  # -1e-17 % 360 is 360
        "n_observations": seen.reindex(predictions.tokens, fill_value=0).to_numpy(dtype=np.int64),
    }
    return _layer(columns, shapely.polygons(corners), target)


def _layer(columns: dict[str, Any], geometry: NDArray[np.object_], target: pyproj.CRS) -> gpd.GeoDataFrame:
    texts = {name: pd.array(columns[name], dtype="str") for name in ("class", "drive", "instance") if name in columns}
    return gpd.GeoDataFrame(columns | texts, geometry=geometry, crs=target)


def _left_out(vectors: Sequence[LeftOutVector], source: str, drive: str) -> pd.DataFrame:
    if not vectors:
        return empty_table(LEFT_OUT_COLUMNS)
    rows = [(source, v.position, drive, v.token, 0.0, v.length_m, v.reason) for v in vectors]
    table = pd.DataFrame(rows, columns=list(LEFT_OUT_COLUMNS))
    typed: pd.DataFrame = table.astype(empty_table(LEFT_OUT_COLUMNS).dtypes.to_dict())
    return typed
