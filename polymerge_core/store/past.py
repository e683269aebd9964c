"""What a map was at a revision, and what became of it since: read from its layer `changes`."""

from __future__ import annotations

import sqlite3

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

from polymerge_core.observations import as_lines
from polymerge_core.store.element_table import as_elements, displacement
from polymerge_core.store.tables import ELEMENT, Settings


def elements_at(connection: sqlite3.Connection, settings: Settings, revision: int) -> gpd.GeoDataFrame:
    """Return the elements of a revision, by their id; 0 is the empty map."""
    names = ", ".join(f'c."{name}"' for name in ELEMENT)
    rows = connection.execute(
        f"SELECT c.element_id, c.geom, {names} FROM changes c JOIN (SELECT element_id, MAX(fid) AS last FROM "
        "changes WHERE revision <= ? GROUP BY element_id) l ON c.fid = l.last "
        "WHERE c.kind NOT IN ('retired', 'merged') ORDER BY c.element_id",
        (revision,),
    ).fetchall()
    return as_elements(rows, settings)


def changes_since(connection: sqlite3.Connection, settings: Settings, since: int) -> gpd.GeoDataFrame:
    """Return what became of each element since a revision, as `MapStore.changes` does."""
    names = ", ".join(f'"{name}"' for name in ELEMENT)
    rows = connection.execute(
        f"SELECT c.element_id, geom, {names}, CASE WHEN l.moved AND c.kind = 'changed' THEN 'moved' "
        "ELSE c.kind END, c.revision FROM changes c JOIN "
        "(SELECT MAX(fid) AS last, MAX(kind = 'moved') AS moved FROM changes "
        "WHERE revision > ? GROUP BY element_id) l ON c.fid = l.last ORDER BY c.element_id",
        (since,),
    ).fetchall()
    now = as_elements([row[:-2] for row in rows], settings)
    kind = np.array([row[-2] for row in rows], dtype=object)
    now.insert(0, "kind", kind)
    now.insert(1, "revision", [row[-1] for row in rows])
    was = elements_at(connection, settings, since).geometry.reindex(now.index).to_numpy()
    there, gone = ~pd.isna(was), np.isin(kind, ("retired", "merged"))
    now.loc[~there & ~gone, "kind"] = "added"
    now["moved_m"] = [
        0.0 if one is None or lost else displacement(one, other)
        for one, other, lost in zip(was, now.geometry, gone, strict=True)
    ]
    # What came and went in between is no difference.
    return now[there | ~gone].reset_index()


def arrows(found: gpd.GeoDataFrame, before: gpd.GeoSeries) -> gpd.GeoDataFrame:
    """Return arrows from where elements were to where they are.

    Parameters
    ----------
    found : GeoDataFrame
        From `changes_since`.
    before : GeoSeries
        The shapes that elements had then, by their id.
    """
    found = found[found["kind"] == "moved"]
    old = before.reindex(found["element_id"]).to_numpy()
    start = shapely.line_interpolate_point(as_lines(found.geometry.to_numpy()), 0.5, normalized=True)
    shapes = shapely.reverse(shapely.shortest_line(start, as_lines(old)))
    columns = {"element_id": found["element_id"].to_numpy(), "moved_m": found["moved_m"].to_numpy()}
    return gpd.GeoDataFrame(columns, geometry=shapes, crs=found.crs)
