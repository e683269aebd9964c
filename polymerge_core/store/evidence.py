"""What local maps say, as the stored map keeps it: who looked where, and what they saw."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import pyproj
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from polymerge_core.columns import NO_TIMESTAMP
from polymerge_core.consensus.alongside import REACH
from polymerge_core.consensus.instances import known_instances
from polymerge_core.crs import crs_name
from polymerge_core.curves import Array, Curves, Index
from polymerge_core.errors import CrsError
from polymerge_core.observations import as_lines, observe
from polymerge_core.options import Options
from polymerge_core.schema import LocalMaps
from polymerge_core.store import geopackage
from polymerge_core.store.drive_order import came_before, order_drives, read_drives
from polymerge_core.store.stitching import stretches_of
from polymerge_core.store.tables import Settings

_NAMES = ["drive", "instance"]

#: Where very many looked, so many drives are heard in a square of so many proximities, and so many frames of each.
_DRIVES, _FRAMES, _SQUARE = 16, 64, 30.0


class Evidence(NamedTuple):
    """Local maps, in the CRS of the map.

    Parameters
    ----------
    instances : DataFrame
        One row a local map: `drive`, `instance`, `timestamp_ns` (None where unknown), `x`, `y`, `heading` (degrees
        clockwise from north), `has_footprint`, `shape` (what it looked at; where that is not known the box of what it
        saw, or None).
    observations : DataFrame
        One row an observation: `at` (its row in instances), `class`, `score`, `is_area`, `source`, `source_fid`,
        `from_m`, `to_m`, `shape`.
    left_out : DataFrame
        What cannot be used, with reasons.
    warnings : list of str
        What reading them had to say.
    """

    instances: pd.DataFrame
    observations: pd.DataFrame
    left_out: pd.DataFrame
    warnings: list[str]


def read_evidence(
    local_maps: Sequence[LocalMaps], options: Options, crs: pyproj.CRS | None
) -> tuple[Evidence, pyproj.CRS]:
    """Bring local maps into the terms of the stored map.

    Parameters
    ----------
    local_maps : sequence of LocalMaps
        One or more.
    options : Options
        Columns, classes and CRS.
    crs : pyproj.CRS, optional
        Of the map; that in which a merge would work where there is no map yet.

    Returns
    -------
    Evidence
        What they say.
    pyproj.CRS
        The CRS that it is in.

    Raises
    ------
    CrsError
        If the map's CRS is not true to scale where the local maps are.
    SchemaError, InputError
        If a layer cannot be used.
    """
    seen = observe(list(local_maps), [], options, crs)
    if crs is not None and seen.crs != crs:
        raise CrsError(
            f"the map is in {crs_name(crs)}, which is not true to scale (0.1 %) where the local maps are; keep another "
            "map for them"
        )
    table = seen.table
    known = pd.concat(
        [known_instances(maps, each, seen.crs) for maps, each in zip(local_maps, seen.layer_crs, strict=True)],
        ignore_index=True,
    )
    unseen = seen.left_out[seen.left_out["instance"] != ""]
    names = [np.concatenate([_texts(each[name]) for each in (table, known, unseen)]) for name in _NAMES]
    code, first = _numbered(*names)
    at, whose = code[: len(table)], code[len(table) : len(table) + len(known)]
    shape = table["shape"].to_numpy(dtype=object)
    observations = pd.DataFrame(
        {
            "at": at,
            **{name: table[name].to_numpy() for name in ("class", "score", "is_area", "source", "from_m", "to_m")},
            "source_fid": _texts(table["source_fid"]),
            "shape": np.where(table["is_area"] & ~table["as_polygon"], as_lines(shape), shape),
        }
    )
    # What is told of a local map more than once is taken as it is told first.
    owner, row = np.unique(whose, return_index=True)
    position = np.full((len(first), 3), np.nan)
    position[owner] = known[["x", "y", "heading"]].to_numpy(dtype=float)[row]
    footprint, time = (np.full(len(first), None, dtype=object) for _ in range(2))
    footprint[owner] = known["footprint"].to_numpy(dtype=object)[row]
    earliest = np.full(len(first), NO_TIMESTAMP)
    np.minimum.at(earliest, at, table["timestamp_ns"].to_numpy(dtype=np.int64))
    time[earliest < NO_TIMESTAMP] = earliest[earliest < NO_TIMESTAMP]
    own = known["timestamp_ns"].to_numpy(dtype=object)[row]
    time[owner] = np.where(pd.isna(own), time[owner], own)
    instances = pd.DataFrame(
        {
            **{name: texts[first] for name, texts in zip(_NAMES, names, strict=True)},
            "timestamp_ns": pd.Series([None if value is None else int(value) for value in time], dtype=object),
            "x": position[:, 0],
            "y": position[:, 1],
            "heading": np.mod(90.0 - np.degrees(position[:, 2]), 360.0),
            "has_footprint": ~pd.isna(footprint),
        }
    )
    instances["shape"] = np.where(instances["has_footprint"], footprint, _boxes(shape, at, len(first)))
    return Evidence(instances, observations, seen.left_out, seen.notes["warnings"]), seen.crs


def _texts(column: pd.Series[Any]) -> NDArray[np.object_]:
    """Return values as text."""
    return column.astype(str).to_numpy(dtype=object)


def _numbered(drive: NDArray[np.object_], instance: NDArray[np.object_]) -> tuple[Index, Index]:
    """Return a number for each pair of names, the same for the same, and the row in which each number comes first."""
    drives, (instances, known) = pd.factorize(drive)[0], pd.factorize(instance)
    code = pd.factorize(drives * len(known) + instances)[0]
    return code, np.unique(code, return_index=True)[1]


def _boxes(shapes: NDArray[np.object_], owner: Index, count: int) -> NDArray[np.object_]:
    """Return the box of the shapes of each owner, None of those that have none."""
    found = np.full(count, None, dtype=object)
    if len(shapes):
        bounds = pd.DataFrame(shapely.bounds(shapes)).groupby(owner).agg({0: "min", 1: "min", 2: "max", 3: "max"})
        found[bounds.index] = shapely.box(*bounds.to_numpy().T)
    return found


def without_known(connection: sqlite3.Connection, evidence: Evidence) -> tuple[Evidence, int]:
    """Leave away the local maps that the map knows; return how many those are."""
    instances = evidence.instances
    with geopackage.pairs(connection, instances["drive"], instances["instance"]) as these:
        rows = connection.execute(
            f"SELECT p.id FROM {these} p JOIN instances i ON i.drive = p.one AND i.instance = p.other"
        ).fetchall()
    known = np.zeros(len(instances), dtype=bool)
    known[[row[0] for row in rows]] = True
    if not known.any():
        return evidence, 0
    number = np.cumsum(~known) - 1
    new = evidence.observations[~known[evidence.observations["at"]]]
    pairs = pd.MultiIndex.from_frame(instances.loc[known, _NAMES])
    own = pd.MultiIndex.from_frame(evidence.left_out[_NAMES].astype(str)).isin(pairs)
    left = Evidence(
        instances[~known].reset_index(drop=True),
        new.assign(at=number[new["at"]]).reset_index(drop=True),
        evidence.left_out[~own],
        evidence.warnings,
    )
    return left, int(known.sum())


def add(connection: sqlite3.Connection, settings: Settings, evidence: Evidence, revision: int) -> tuple[Index, Index]:
    """Keep what local maps say; return the numbers of the local maps and of the observations in the file."""
    first = [geopackage.next_id(connection, table) for table in ("instances", "observations")]
    instances, observations = evidence.instances, evidence.observations
    instance_fid = first[0] + np.arange(len(instances))
    observation_fid = first[1] + np.arange(len(observations))
    shapes = instances["shape"].to_numpy(dtype=object)
    counts = np.bincount(observations["at"], minlength=len(instances))
    geopackage.insert(
        connection,
        "instances",
        {
            "fid": instance_fid,
            "geom": geopackage.to_blobs(shapes, settings.srs_id),
            **{name: instances[name] for name in ("drive", "instance", "timestamp_ns", "x", "y", "heading")},
            "n_observations": counts,
            "has_footprint": instances["has_footprint"].astype(int),
            "revision": [revision] * len(instances),
        },
    )
    shapes = observations["shape"].to_numpy(dtype=object)
    geopackage.insert(
        connection,
        "observations",
        {
            "fid": observation_fid,
            "geom": geopackage.to_blobs(shapes, settings.srs_id),
            "instance_fid": instance_fid[observations["at"]],
            "is_area": observations["is_area"].astype(int),
            **{name: observations[name] for name in ("class", "score", "source", "source_fid", "from_m", "to_m")},
        },
    )
    left_out = evidence.left_out
    columns = {name: left_out[name].astype(object) for name in left_out.columns}
    geopackage.insert(connection, "left_out", columns | {"source_fid": left_out["source_fid"].astype(str)})
    geopackage.touched(connection, "instances", instances["shape"].to_numpy(dtype=object))
    geopackage.touched(connection, "observations", shapes)
    return instance_fid, observation_fid


def place_of(
    connection: sqlite3.Connection, settings: Settings, which: str, values: Sequence[Any] = ()
) -> BaseGeometry:
    """Return what some local maps may say anything of: what they looked at, and what they saw.

    Parameters
    ----------
    connection : sqlite3.Connection
        Of a stored map.
    settings : Settings
        Of the map.
    which : str
        SQL that chooses local maps, ``i``.
    values : sequence
        Of the marks in it.
    """
    looked = f"SELECT geom FROM instances i WHERE {which} AND has_footprint ORDER BY fid"
    seen = f"SELECT o.geom FROM observations o JOIN instances i ON i.fid = o.instance_fid WHERE {which} ORDER BY o.fid"
    areas, lines = (
        geopackage.from_blobs([row[0] for row in connection.execute(query, values)]) for query in (looked, seen)
    )
    return shapely.union_all(np.concatenate([areas, shapely.buffer(lines, REACH * settings.proximity, quad_segs=2)]))


class Context(NamedTuple):
    """All that is known of a place.

    Parameters
    ----------
    instances : GeoDataFrame
        The local maps that looked there, by `fid`: `drive`, `instance`, `timestamp_ns`, `x`, `y`, `heading`,
        `has_footprint`, `revision`; geometry is what they looked at.
    observations : GeoDataFrame
        All that they saw, also elsewhere, by `fid`: `instance_fid`, `class`, `score`, `is_area`, and where they came
        from.
    renewed : GeoDataFrame
        Where the road changed: `class`, and the drive that saw it first, `since_drive`, `since_revision`.
    drives : DataFrame
        From `read_drives`, of all these.
    """

    instances: gpd.GeoDataFrame
    observations: gpd.GeoDataFrame
    renewed: gpd.GeoDataFrame
    drives: pd.DataFrame


def read_context(connection: sqlite3.Connection, settings: Settings, place: BaseGeometry) -> Context:
    """Read what the local maps that looked at a place saw there and elsewhere."""
    shapely.prepare(place)
    near = geopackage.ids_near(connection, "instances", shapely.bounds(place))
    instances = _read(connection, settings, "instances", _INSTANCE, near, "fid")
    instances = instances[shapely.intersects(place, instances.geometry.to_numpy())]
    drives = read_drives(connection, instances.groupby("drive")["revision"].min())
    instances = instances[_heard(instances, drives, settings.proximity)]
    observations = _read(connection, settings, "observations", _OBSERVATION, instances.index.to_numpy(), "instance_fid")
    nothing = _read(connection, settings, "renewed", _RENEWED, np.empty(0, np.intp), "fid")
    return with_renewed(connection, settings, Context(instances, observations, nothing, drives))


def with_renewed(connection: sqlite3.Connection, settings: Settings, context: Context) -> Context:
    """Read where the road changed among all that is seen."""
    shapes = np.concatenate([context.instances.geometry.to_numpy(), context.observations.geometry.to_numpy()])
    near = np.empty(0, np.intp)
    if len(shapes):
        near = geopackage.ids_near(connection, "renewed", shapely.total_bounds(shapes))
    renewed = _read(connection, settings, "renewed", _RENEWED, near, "fid")
    told = renewed.groupby("since_drive")["since_revision"].min()
    others = read_drives(connection, told[~told.index.isin(context.drives.index)])
    return context._replace(renewed=renewed, drives=pd.concat([context.drives, others]))


def _heard(instances: gpd.GeoDataFrame, drives: pd.DataFrame, unit: float) -> NDArray[np.bool_]:
    """Choose who is heard where very many looked: of each square the newest drives, of each drive some frames by lot.

    The lot is the same at all times, so that a place is drawn from the same frames whoever draws it.
    """
    if instances.empty:
        return np.empty(0, dtype=bool)
    drive = order_drives(instances, drives).drive
    middle = np.floor(shapely.get_coordinates(shapely.centroid(instances.geometry.to_numpy())) / (_SQUARE * unit))
    lot = pd.util.hash_pandas_object(instances["drive"] + "\n" + instances["instance"], index=False).to_numpy()
    held = pd.DataFrame({"x": middle[:, 0], "y": middle[:, 1], "drive": drive, "lot": lot})
    among_frames = held.groupby(["x", "y", "drive"])["lot"].rank(method="first")
    square = held.groupby(["x", "y"])["drive"]
    newer = square.transform(lambda drives: drives.rank(method="dense", ascending=False))
    return np.asarray((among_frames <= _FRAMES) & (newer <= _DRIVES))


_INSTANCE = ("drive", "instance", "timestamp_ns", "x", "y", "heading", "has_footprint", "revision")
_OBSERVATION = ("instance_fid", "class", "score", "is_area", "source", "source_fid", "from_m", "to_m")
_RENEWED = ("class", "since_drive", "since_revision")


def _read(
    connection: sqlite3.Connection, settings: Settings, table: str, columns: tuple[str, ...], ids: Index, by: str
) -> gpd.GeoDataFrame:
    names = ", ".join(f'"{name}"' for name in columns)
    with geopackage.chosen(connection, ids) as these:
        rows = connection.execute(
            f'SELECT fid, geom, {names} FROM "{table}" WHERE "{by}" IN {these} ORDER BY fid'
        ).fetchall()
    held: list[list[Any]] = [list(column) for column in zip(*rows, strict=True)] or [
        [] for _ in range(len(columns) + 2)
    ]
    index = pd.Index(held[0], dtype="int64", name="fid")
    # Numbers of 64 bits that may be missing: as floats they would lose their last digits.
    whole = {
        name: pd.array(values, dtype="Int64") for name, values in zip(columns, held[2:], strict=True) if name in _WHOLE
    }
    frame = pd.DataFrame(dict(zip(columns, held[2:], strict=True)) | whole, index=index)
    return gpd.GeoDataFrame(frame, geometry=geopackage.from_blobs(held[1]), crs=settings.crs)


_WHOLE = ("timestamp_ns",)


class Pieces(NamedTuple):
    """What of the observations still says something of the road.

    Parameters
    ----------
    local_maps : LocalMaps
        The pieces as one source of local maps, by their position.
    footprints : ndarray of shapely geometries, shape (k,)
        What of that which the local maps of the context looked at still says something.
    observation : ndarray of int, shape (n,)
        The `fid` of the observation that each is of.
    offset : ndarray of float, shape (n,)
        Where it begins there, metres.
    lost : DataFrame
        The rest: `observation_fid`, `from_m`, `to_m`, metres along the observation.
    """

    local_maps: LocalMaps
    footprints: NDArray[np.object_]
    observation: Index
    offset: Array
    lost: pd.DataFrame


def still_valid(context: Context) -> Pieces:
    """Take away what was seen of a class, and looked at, where the road has changed since."""
    instances, seen = context.instances, context.observations
    shapes = seen.geometry.to_numpy()
    rows, lines = np.arange(len(seen)), shapes.copy()
    offset = np.zeros(len(seen))
    footprints = instances.geometry.to_numpy().copy()
    cut: dict[int, BaseGeometry] = {}
    for zone in context.renewed.itertuples():
        before = came_before(instances, context.drives, zone.since_drive)
        near = before & shapely.intersects(footprints, zone.geometry)
        footprints[near] = shapely.difference(footprints[near], zone.geometry)
        own = before[instances.index.get_indexer(seen["instance_fid"])] & (seen["class"] == zone[1]).to_numpy()
        for row in np.flatnonzero(own & shapely.intersects(shapes, zone.geometry)).tolist():
            cut[row] = shapely.union(cut[row], zone.geometry) if row in cut else zone.geometry
    lost: list[tuple[int, float, float]] = []
    if cut:
        kept = np.setdiff1d(rows, list(cut))
        area = seen["is_area"].to_numpy(dtype=bool)
        parts = [_rest(shapes[row], zone, is_area=bool(area[row])) for row, zone in sorted(cut.items())]
        whose = np.repeat(sorted(cut), [len(part) for part in parts]).astype(np.intp)
        bounds = np.array([bound for part in parts for bound in part], dtype=np.float64).reshape(-1, 2)
        whole = area[whose]
        pieces = shapes[whose].copy()
        if (~whole).any():
            curves = Curves(shapes[whose[~whole]])
            every = np.arange(len(curves))
            pieces[~whole] = curves.stretches(every, *bounds[~whole].T)
        rows, lines = np.concatenate([kept, whose]), np.concatenate([shapes[kept], pieces])
        offset = np.concatenate([np.zeros(len(kept)), bounds[:, 0]])
        lost = [
            (int(seen.index[row]), *gap)
            for row, part in zip(sorted(cut), parts, strict=True)
            for gap in _gaps(part, float(as_lines(shapes[row : row + 1])[0].length))
        ]
    own = seen.iloc[rows]
    whose = instances.index.get_indexer(own["instance_fid"])
    columns = {name: instances[name].to_numpy(dtype=object)[whose] for name in _NAMES}
    columns |= {"class": own["class"].to_numpy(dtype=object), "score": own["score"].to_numpy(dtype=float)}
    time = instances["timestamp_ns"]
    if not time.isna().any():
        columns["timestamp"] = time.to_numpy(dtype=np.int64)[whose]
    observations = gpd.GeoDataFrame(columns, geometry=lines, crs=seen.crs)
    known = instances.assign(geometry=footprints)[(instances["has_footprint"] == 1).to_numpy()]
    table = pd.DataFrame(lost, columns=["observation_fid", "from_m", "to_m"])
    return Pieces(LocalMaps(observations, known, source="map"), footprints, own.index.to_numpy(), offset, table)


def as_area(shape: BaseGeometry) -> BaseGeometry:
    """Return the area of an element of an area class, which may be drawn as a line."""
    ring = as_lines(np.array([shape], dtype=object))[0]
    return shapely.make_valid(shapely.polygons(shapely.get_coordinates(ring)))


def _rest(shape: BaseGeometry, zone: BaseGeometry, *, is_area: bool) -> list[tuple[float, float]]:
    """Return the stretches of a line outside of a zone; an area is in it for the most part, or not at all."""
    if is_area:
        area = as_area(shape)
        inside = shapely.area(shapely.intersection(area, zone)) > shapely.area(area) / 2
        return [] if inside else [(0.0, float(as_lines(np.array([shape], dtype=object))[0].length))]
    return [(each.start, each.stop) for each in stretches_of(shape, zone, inside=False)]


def _gaps(parts: list[tuple[float, float]], length: float) -> list[tuple[float, float]]:
    """Return what lies between the parts of a line."""
    edges = [0.0, *(bound for part in parts for bound in part), length]
    return [(start, stop) for start, stop in zip(edges[::2], edges[1::2], strict=True) if stop > start]
