"""What must hold of the file of a stored map, whatever happened to it."""

from __future__ import annotations

import sqlite3

import numpy as np
import shapely

from polymerge_core.store import geopackage
from polymerge_core.store.tables import ELEMENT

#: Lengths that are equal but for rounding are not further apart, metres.
_EXACT = 1e-6

_LAYERS = ("elements", "changes", "instances", "observations", "renewed")
_TABLES = (*_LAYERS, "lineage", "left_out", "id_aliases", "revisions", "map_settings")

#: A question with no answers where all is right, and what the answers are.
_QUESTIONS = {
    "lineage names elements that are not there": (
        "SELECT DISTINCT element_id FROM lineage WHERE element_id NOT IN (SELECT element_id FROM elements)"
    ),
    "elements have no lineage": (
        "SELECT element_id FROM elements WHERE element_id NOT IN (SELECT element_id FROM lineage)"
    ),
    "elements have another feature id than their own": "SELECT element_id FROM elements WHERE fid IS NOT element_id",
    "lineage names observations that are not there": (
        "SELECT DISTINCT observation_fid FROM lineage WHERE observation_fid NOT IN (SELECT fid FROM observations)"
    ),
    "observations are of no local map": (
        "SELECT fid FROM observations WHERE instance_fid NOT IN (SELECT fid FROM instances)"
    ),
    "ids that became another one are still there": (
        "SELECT old_id FROM id_aliases WHERE old_id IN (SELECT element_id FROM elements)"
    ),
    "ids became elements that are not there": (
        "SELECT old_id FROM id_aliases WHERE element_id != -1 AND element_id NOT IN (SELECT element_id FROM elements)"
    ),
    "local maps are of no revision": ("SELECT fid FROM instances WHERE revision NOT IN (SELECT number FROM revisions)"),
    "changes are of no revision": "SELECT fid FROM changes WHERE revision NOT IN (SELECT number FROM revisions)",
    "revisions count other local maps than there are": (
        "SELECT number FROM revisions WHERE CASE WHEN undone IS NULL THEN n_instances ELSE 0 END != "
        "(SELECT COUNT(*) FROM instances WHERE revision = number)"
    ),
    "local maps count other observations than there are": (
        "SELECT fid FROM instances WHERE n_observations != "
        "(SELECT COUNT(*) FROM observations WHERE instance_fid = instances.fid)"
    ),
    "elements count other observations than their lineage": (
        "SELECT e.element_id FROM elements e JOIN (SELECT element_id, COUNT(DISTINCT observation_fid) AS n "
        "FROM lineage GROUP BY element_id) l ON l.element_id = e.element_id WHERE l.n != e.n_observations"
    ),
    "elements are not as their last change says": (
        "SELECT e.element_id FROM elements e LEFT JOIN (SELECT element_id, MAX(fid) AS last FROM changes GROUP BY "
        "element_id) l ON l.element_id = e.element_id LEFT JOIN changes c ON c.fid = l.last WHERE "
        f"c.kind IN ('retired', 'merged') OR {' OR '.join(f'c.{name} IS NOT e.{name}' for name in ('geom', *ELEMENT))}"
    ),
    "elements that are no more have not been retired": (
        "SELECT c.element_id FROM changes c JOIN "
        "(SELECT element_id, MAX(fid) AS last FROM changes GROUP BY element_id) l "
        "ON c.fid = l.last WHERE c.kind NOT IN ('retired', 'merged') AND c.element_id NOT IN "
        "(SELECT element_id FROM elements)"
    ),
}


def faults(connection: sqlite3.Connection) -> list[str]:
    """Return what is wrong with a stored map, in sentences.

    Parameters
    ----------
    connection : sqlite3.Connection
        Of the map.
    """
    found = [f"SQLite says: {row[0]}" for row in connection.execute("PRAGMA integrity_check") if row[0] != "ok"]
    if found:
        return found
    held = {row[0] for row in connection.execute("SELECT name FROM sqlite_master")}
    wanted = ("gpkg_contents", "gpkg_ogr_contents", *_TABLES, *(f"rtree_{layer}_geom" for layer in _LAYERS))
    found = [f"there is no table {table}" for table in wanted if table not in held]
    if found:
        return found
    for what, query in _QUESTIONS.items():
        rows = [row[0] for row in connection.execute(query)]
        if rows:
            found.append(f"{what}: {len(rows)}, the first {rows[0]}")
    found += _intervals(connection)
    for table in _TABLES:
        (count,) = connection.execute(f'SELECT COUNT(*) FROM "{table}"').fetchone()
        noted = connection.execute(
            "SELECT feature_count FROM gpkg_ogr_contents WHERE table_name = ?", (table,)
        ).fetchall()
        if noted != [(count,)]:
            told = noted[0][0] if noted else "no"
            found.append(f"gpkg_ogr_contents counts {told} rows of {table}, and there are {count}")
    for layer in _LAYERS:
        found += _layer(connection, layer)
    return found


def _intervals(connection: sqlite3.Connection) -> list[str]:
    """Check that each observation's length is in lineage and left-out exactly once."""
    rows = connection.execute(
        "SELECT o.fid, o.to_m - o.from_m, "
        "ifnull((SELECT SUM(to_m - from_m) FROM lineage WHERE observation_fid = o.fid), 0) + "
        "ifnull((SELECT SUM(to_m - from_m) FROM left_out WHERE observation_fid = o.fid), 0) "
        "FROM observations o JOIN instances i ON i.fid = o.instance_fid WHERE i.drawn IS NOT NULL"
    ).fetchall()
    table = np.array(rows, dtype=np.float64).reshape(-1, 3)
    wrong = np.flatnonzero(np.abs(table[:, 1] - table[:, 2]) > _EXACT * np.maximum(1.0, table[:, 1]))
    if len(wrong) == 0:
        return []
    fid, length, covered = table[wrong[0]]
    what = "observations are not covered exactly once by lineage and left_out"
    return [f"{what}: {len(wrong)}, the first {fid:.0f} ({covered:g} m of {length:g} m)"]


def _layer(connection: sqlite3.Connection, layer: str) -> list[str]:
    """Check geometries, the spatial index and the bounds of a layer."""
    rows = connection.execute(f'SELECT fid, geom FROM "{layer}" WHERE geom IS NOT NULL ORDER BY fid').fetchall()
    ids = np.array([row[0] for row in rows], dtype=np.float64)
    shapes = geopackage.from_blobs([row[1] for row in rows])
    found = []
    bad = shapely.is_empty(shapes) | ~np.isfinite(shapely.bounds(shapes).reshape(-1, 4)).all(axis=1)
    if layer in ("elements", "changes"):
        bad |= ~shapely.is_valid(shapes)
    if bad.any():
        found.append(f"geometries of {layer} are not valid: {int(bad.sum())}, the first {ids[bad][0]:.0f}")
    index = geopackage.boxes(connection, layer)
    box = shapely.bounds(shapes).reshape(-1, 4)[:, [0, 2, 1, 3]]
    # The index rounds outwards to single precision.
    rounding = 1e-6 * np.abs(box) + 1e-6
    if not np.array_equal(index[:, 0], ids):
        found.append(f"the spatial index of {layer} has other features than the layer")
    elif not (np.abs(index[:, 1:] - box) <= rounding).all():
        found.append(f"the spatial index of {layer} has other bounds than the layer")
    if len(box):
        bounds = connection.execute(
            "SELECT min_x, max_x, min_y, max_y FROM gpkg_contents WHERE table_name = ?", (layer,)
        ).fetchone()
        # GDAL writes 15 digits of them.
        noted = np.array(bounds or [np.nan] * 4, dtype=np.float64) + 1e-9 * np.abs(box).max(axis=0) * [-1, 1, -1, 1]
        if not ((box[:, [0, 2]] >= noted[[0, 2]]).all() and (box[:, [1, 3]] <= noted[[1, 3]]).all()):
            found.append(f"gpkg_contents has smaller bounds of {layer} than the layer")
    return found
