"""GeoPackages through sqlite3 alone: geometry as blobs, layers with a spatial index, safe transactions.

One SQLite in the process touches the file, because two copies of the library do not see each other's locks. The layers
are what GDAL would make (version 1.3, the extension ``gpkg_rtree_index``, the table ``gpkg_ogr_contents``), so that
GDAL, QGIS and geopandas read and edit them.

References
----------
OGC 12-128r17, "GeoPackage Encoding Standard" 1.3.1: clause 2.1.3 (geometry), annex F.3 (R-tree).
"""

from __future__ import annotations

import contextlib
import sqlite3
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from polymerge_core.crs import is_local
from polymerge_core.curves import Array, Index

#: "GPKG" as a number, and version 1.3: what the header of the file says.
APPLICATION_ID, USER_VERSION = 0x47504B47, 10300

#: The number of a CRS that no authority has one for, and that of plain metric coordinates.
_CUSTOM_SRS, _LOCAL_SRS = 100_000, -1

#: Magic, version, flags (little endian, envelope of x and y), CRS, envelope.
_HEADER = np.dtype([("magic", "S2"), ("version", "u1"), ("flags", "u1"), ("srs", "<i4"), ("envelope", "<f8", 4)])
_FLAGS, _EMPTY = 0b00000011, 0b00010000
#: Bytes of the envelope by its kind.
_ENVELOPES = (0, 32, 48, 48, 64)

_CORE = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY,
 organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
 description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
 min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
 CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_ogr_contents (table_name TEXT NOT NULL PRIMARY KEY, feature_count INTEGER DEFAULT NULL);
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL,
 geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
 CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name), CONSTRAINT uk_gc_table_name UNIQUE (table_name),
 CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
 CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id));
CREATE TABLE gpkg_extensions (table_name TEXT, column_name TEXT, extension_name TEXT NOT NULL,
 definition TEXT NOT NULL, scope TEXT NOT NULL, CONSTRAINT ge_tce UNIQUE (table_name, column_name, extension_name));
"""

_RTREE_DEFINITION = "http://www.geopackage.org/spec120/#extension_rtree"

_GONE = 'DELETE FROM "rtree_{t}_geom" WHERE id'
_PUT = (
    'INSERT OR REPLACE INTO "rtree_{t}_geom" VALUES (NEW."{k}", ST_MinX(NEW."geom"), ST_MaxX(NEW."geom"), '
    'ST_MinY(NEW."geom"), ST_MaxY(NEW."geom"))'
)
_SOMETHING, _NOTHING = (
    '(NEW."geom" NOTNULL AND NOT ST_IsEmpty(NEW."geom"))',
    '(NEW."geom" ISNULL OR ST_IsEmpty(NEW."geom"))',
)
#: The triggers of the extension by the end of their name: what they follow, when, and what they do.
_RTREE_TRIGGERS = {
    "insert": ('INSERT ON "{t}"', _SOMETHING, _PUT),
    "update1": ('UPDATE OF "geom" ON "{t}"', f'OLD."{{k}}" = NEW."{{k}}" AND {_SOMETHING}', _PUT),
    "update2": ('UPDATE OF "geom" ON "{t}"', f'OLD."{{k}}" = NEW."{{k}}" AND {_NOTHING}', f'{_GONE} = OLD."{{k}}"'),
    "update3": ('UPDATE ON "{t}"', f'OLD."{{k}}" != NEW."{{k}}" AND {_SOMETHING}', f'{_GONE} = OLD."{{k}}"; {_PUT}'),
    "update4": (
        'UPDATE ON "{t}"',
        f'OLD."{{k}}" != NEW."{{k}}" AND {_NOTHING}',
        f'{_GONE} IN (OLD."{{k}}", NEW."{{k}}")',
    ),
    "delete": ('DELETE ON "{t}"', 'OLD."geom" NOT NULL', f'{_GONE} = OLD."{{k}}"'),
}


class Connection(sqlite3.Connection):
    """A connection that remembers what went wrong in a function that SQLite called, as SQLite does not."""

    raised: BaseException | None = None

    def serve(self, name: str, function: Callable[[bytes | None], float | None]) -> None:
        """Let SQL call a function of one geometry."""

        def call(blob: bytes | None) -> float | None:
            try:
                return function(blob)
            except BaseException as error:
                self.raised = error
                raise

        self.create_function(name, 1, call, deterministic=True)


def connect(path: Path, patience_s: float) -> Connection:
    """Open a GeoPackage.

    Parameters
    ----------
    path : Path
        The file, which may be an empty one.
    patience_s : float
        Seconds to wait for somebody else who has it locked.

    Returns
    -------
    Connection
        Transactions are begun by hand. A commit is on the disk when it returns. The functions that the triggers of a
        GeoPackage call are there. Whoever only reads may write, too, where the file allows it: what a killed writer
        left must be rolled back before anything can be read.
    """
    uri = f"{path.absolute().as_uri()}?mode=rw"
    connection = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=patience_s, factory=Connection)
    connection.execute("PRAGMA synchronous = FULL")
    connection.execute("PRAGMA foreign_keys = OFF")
    for number, name in enumerate(("ST_MinX", "ST_MaxX", "ST_MinY", "ST_MaxY")):
        connection.serve(name, partial(_bound, at=number))
    connection.serve("ST_IsEmpty", _is_empty)
    return connection


@contextlib.contextmanager
def transaction(connection: Connection) -> Iterator[None]:
    """Do everything or nothing; nobody else writes meanwhile."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException as error:
        # A full disk may have rolled back already.
        if connection.in_transaction:
            connection.execute("ROLLBACK")
        if connection.raised is not None:
            raise connection.raised from error
        raise


def is_empty(connection: sqlite3.Connection) -> bool:
    """Tell whether a file holds nothing yet."""
    return connection.execute("SELECT 1 FROM sqlite_master").fetchone() is None


def create(connection: sqlite3.Connection, crs: pyproj.CRS) -> int:
    """Make an empty file a GeoPackage, within a transaction; return the number of its CRS."""
    # These too are undone with the transaction.
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    connection.execute(f"PRAGMA user_version = {USER_VERSION}")
    for statement in _CORE.split(";"):
        connection.execute(statement)
    wgs84 = pyproj.CRS.from_epsg(4326)
    number = _srs_id(crs)
    rows = [
        ("Undefined Cartesian SRS", _LOCAL_SRS, "NONE", _LOCAL_SRS, "undefined", "undefined Cartesian system"),
        ("Undefined geographic SRS", 0, "NONE", 0, "undefined", "undefined geographic system"),
        _srs_row(wgs84, 4326),
    ]
    if number not in (_LOCAL_SRS, 4326):
        rows.append(_srs_row(crs, number))
    connection.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)", rows)
    return number


def create_layer(
    connection: sqlite3.Connection, name: str, key: str, columns: Mapping[str, str], geometry: str, srs_id: int
) -> None:
    """Add an empty layer of features with a spatial index.

    Parameters
    ----------
    connection : sqlite3.Connection
        Of a GeoPackage.
    name, key : str
        The layer, and its column of feature ids.
    columns : mapping of str to str
        Name and type of the other columns but ``geom``.
    geometry : str
        Type of the geometries.
    srs_id : int
        Number of their CRS.
    """
    held = ", ".join(f'"{column}" {kind}' for column, kind in columns.items())
    connection.execute(
        f'CREATE TABLE "{name}" ("{key}" INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, "geom" {geometry}, {held})'
    )
    connection.execute(
        "INSERT INTO gpkg_contents (table_name, data_type, identifier, srs_id) VALUES (?, 'features', ?, ?)",
        (name, name, srs_id),
    )
    connection.execute("INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 0, 0)", (name, geometry, srs_id))
    connection.execute(
        "INSERT INTO gpkg_extensions VALUES (?, 'geom', 'gpkg_rtree_index', ?, 'write-only')",
        (name, _RTREE_DEFINITION),
    )
    connection.execute(f'CREATE VIRTUAL TABLE "rtree_{name}_geom" USING rtree(id, minx, maxx, miny, maxy)')
    for end, (event, when, action) in _RTREE_TRIGGERS.items():
        text = f'CREATE TRIGGER "rtree_{name}_geom_{end}" AFTER {event} WHEN {when} BEGIN {action}; END'
        connection.execute(text.format(t=name, k=key))
    _count_rows(connection, name)


def create_table(connection: sqlite3.Connection, name: str, key: str, columns: Mapping[str, str]) -> None:
    """Add an empty table without geometry, as `create_layer` adds a layer."""
    held = ", ".join(f'"{column}" {kind}' for column, kind in columns.items())
    connection.execute(f'CREATE TABLE "{name}" ("{key}" INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, {held})')
    connection.execute(
        "INSERT INTO gpkg_contents (table_name, data_type, identifier) VALUES (?, 'attributes', ?)", (name, name)
    )
    _count_rows(connection, name)


def _count_rows(connection: sqlite3.Connection, name: str) -> None:
    connection.execute("INSERT INTO gpkg_ogr_contents VALUES (?, 0)", (name,))
    for event, sign in (("insert", "+"), ("delete", "-")):
        connection.execute(
            f'CREATE TRIGGER "trigger_{event}_feature_count_{name}" AFTER {event} ON "{name}" BEGIN '
            f"UPDATE gpkg_ogr_contents SET feature_count = feature_count {sign} 1 "
            f"WHERE lower(table_name) = lower('{name}'); END"
        )


def insert(connection: sqlite3.Connection, table: str, columns: Mapping[str, Iterable[Any]]) -> None:
    """Insert rows, given by their columns."""
    rows = list(zip(*(_plain(values) for values in columns.values()), strict=True))
    names, marks = ", ".join(f'"{name}"' for name in columns), ", ".join("?" * len(columns))
    connection.executemany(f'INSERT INTO "{table}" ({names}) VALUES ({marks})', rows)


def _plain(values: Iterable[Any]) -> list[Any]:
    """Return what SQLite takes; what is missing as NULL."""
    held = [value.item() if isinstance(value, np.generic) else value for value in values]
    return [None if value is None or value != value else value for value in held]  # noqa: PLR0124 - NaN


def touched(connection: sqlite3.Connection, table: str, shapes: NDArray[np.object_] | None = None) -> None:
    """Note that a table changed, and that it holds these shapes: its bounds grow, as GDAL has it, and never shrink."""
    connection.execute(
        "UPDATE gpkg_contents SET last_change = strftime('%Y-%m-%dT%H:%M:%fZ', 'now') WHERE table_name = ?", (table,)
    )
    if shapes is None or (shapely.is_empty(shapes) | shapely.is_missing(shapes)).all():
        return
    bounds = [float(value) for value in shapely.total_bounds(shapes)]
    for column, value, larger in zip(("min_x", "min_y", "max_x", "max_y"), bounds, (0, 0, 1, 1), strict=True):
        keep = "max" if larger else "min"
        connection.execute(
            f"UPDATE gpkg_contents SET {column} = {keep}(ifnull({column}, ?1), ?1) WHERE table_name = ?2",
            (value, table),
        )


def ids_near(connection: sqlite3.Connection, layer: str, box: Sequence[float]) -> Index:
    """Return the ids of features whose boxes meet a box (xmin, ymin, xmax, ymax), by the spatial index; rising."""
    found = connection.execute(
        f'SELECT id FROM "rtree_{layer}_geom" WHERE maxx >= ? AND minx <= ? AND maxy >= ? AND miny <= ? ORDER BY id',
        (box[0], box[2], box[1], box[3]),
    )
    return np.array([row[0] for row in found], dtype=np.intp)


@contextlib.contextmanager
def chosen(connection: sqlite3.Connection, ids: Index) -> Iterator[str]:
    """Give SQL for the set of some ids, of any number."""
    connection.execute("CREATE TEMP TABLE IF NOT EXISTS chosen (id INTEGER PRIMARY KEY)")
    connection.execute("DELETE FROM chosen")
    connection.executemany("INSERT INTO chosen VALUES (?)", [(int(number),) for number in ids])
    yield "(SELECT id FROM chosen)"


@contextlib.contextmanager
def pairs(connection: sqlite3.Connection, one: Iterable[str], other: Iterable[str]) -> Iterator[str]:
    """Give SQL for a table of some pairs: ``id`` (0, 1, ...), ``one``, ``other``."""
    connection.execute("CREATE TEMP TABLE IF NOT EXISTS pairs (id INTEGER PRIMARY KEY, one TEXT, other TEXT)")
    connection.execute("DELETE FROM pairs")
    rows = ((number, *pair) for number, pair in enumerate(zip(one, other, strict=True)))
    connection.executemany("INSERT INTO pairs VALUES (?, ?, ?)", rows)
    yield "pairs"


def to_blobs(shapes: NDArray[np.object_], srs_id: int) -> list[bytes | None]:
    """Encode geometries as GeoPackage has them: a header with their bounds, then WKB. None is NULL."""
    header = np.zeros(len(shapes), _HEADER)
    header["magic"], header["srs"] = b"GP", srs_id
    empty = shapely.is_empty(shapes)
    header["flags"] = np.where(empty, _EMPTY | 1, _FLAGS)
    header["envelope"] = shapely.bounds(shapes).reshape(-1, 4)[:, [0, 2, 1, 3]]
    bare = _HEADER.itemsize - _ENVELOPES[1]
    heads = [row.tobytes() for row in header]
    wkb = shapely.to_wkb(shapes, byte_order=1, flavor="iso")
    return [
        None if body is None else (head[:bare] if nothing else head) + body
        for head, body, nothing in zip(heads, wkb, empty.tolist(), strict=True)
    ]


def from_blobs(blobs: Sequence[bytes | None]) -> NDArray[np.object_]:
    """Decode geometries; the reverse of `to_blobs`, for every header that the standard allows. NULL is None."""
    wkb = np.empty(len(blobs), dtype=object)
    wkb[:] = [None if blob is None else blob[_body(blob) :] for blob in blobs]
    shapes: NDArray[np.object_] = shapely.from_wkb(wkb)
    return shapes


def _body(blob: bytes) -> int:
    """Return where the WKB begins."""
    return 8 + _ENVELOPES[(blob[3] >> 1) & 7]


def _is_empty(blob: bytes | None) -> bool | None:
    return None if blob is None else bool(blob[3] & _EMPTY)


def _bound(blob: bytes | None, at: int) -> float | None:
    """Return one bound of a geometry: minx, maxx, miny, maxy."""
    if blob is None or _is_empty(blob):
        return None
    if (blob[3] >> 1) & 7:
        order = "<" if blob[3] & 1 else ">"
        return float(struct.unpack_from(f"{order}d", blob, 8 + 8 * at)[0])
    xmin, ymin, xmax, ymax = shapely.bounds(shapely.from_wkb(blob[_body(blob) :])).tolist()
    return float((xmin, xmax, ymin, ymax)[at])


def _srs_id(crs: pyproj.CRS) -> int:
    if is_local(crs):
        return _LOCAL_SRS
    authority = crs.to_authority()
    return int(authority[1]) if authority and authority[0] == "EPSG" else _CUSTOM_SRS


def _srs_row(crs: pyproj.CRS, number: int) -> tuple[Any, ...]:
    organization = "NONE" if number == _CUSTOM_SRS else "EPSG"
    # This WKT knows no third axis but that of a vertical CRS.
    flat = crs.to_2d() if len(crs.axis_info) > 2 and not crs.is_compound else crs
    return (crs.name, number, organization, number, flat.to_wkt("WKT1_GDAL"), None)


def boxes(connection: sqlite3.Connection, layer: str) -> Array:
    """Return what the spatial index holds: id, minx, maxx, miny, maxy; by id."""
    rows = connection.execute(f'SELECT id, minx, maxx, miny, maxy FROM "rtree_{layer}_geom" ORDER BY id').fetchall()
    return np.array(rows, dtype=np.float64).reshape(-1, 5)


def replace(connection: sqlite3.Connection, layer: str, columns: Mapping[str, Iterable[Any]]) -> None:
    """Give features other values; the first column is the id."""
    names = list(columns)
    rows = zip(*(_plain(values) for values in columns.values()), strict=True)
    listed = ", ".join(f'"{name}" = ?' for name in names[1:])
    connection.executemany(
        f'UPDATE "{layer}" SET {listed} WHERE "{names[0]}" = ?', [(*row[1:], row[0]) for row in rows]
    )


def next_id(connection: sqlite3.Connection, table: str) -> int:
    """Return the next id of a table, which was never given before."""
    query = "SELECT ifnull((SELECT seq FROM sqlite_sequence WHERE name = ?), 0)"
    (highest,) = connection.execute(query, (table,)).fetchone()
    return int(highest) + 1
