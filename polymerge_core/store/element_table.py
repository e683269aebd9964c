"""The elements of a stored map: read, counted and written."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from polymerge_core.curves import Array, Index
from polymerge_core.schema import NO_ELEMENT
from polymerge_core.store import geopackage
from polymerge_core.store.beliefs import SURE_OF
from polymerge_core.store.tables import ELEMENT, Settings


@dataclass
class Counts:
    """What an update did to elements."""

    added: int = 0
    changed: int = 0
    moved: int = 0
    retired: int = 0
    merged: int = 0


def read_elements(connection: sqlite3.Connection, settings: Settings, ids: Index | None = None) -> gpd.GeoDataFrame:
    """Return elements of the map, all or those of some ids, by their id."""
    names = ", ".join(f'"{name}"' for name in ELEMENT)
    query = f"SELECT element_id, geom, {names} FROM elements"
    if ids is None:
        rows = connection.execute(f"{query} ORDER BY element_id").fetchall()
    else:
        with geopackage.chosen(connection, ids) as these:
            rows = connection.execute(f"{query} WHERE element_id IN {these} ORDER BY element_id").fetchall()
    return as_elements(rows, settings)


def as_elements(rows: list[tuple[object, ...]], settings: Settings) -> gpd.GeoDataFrame:
    """Return rows of id, geometry and attributes as elements, by their id."""
    held = [list(column) for column in zip(*rows, strict=True)] or [[] for _ in range(len(ELEMENT) + 2)]
    frame = pd.DataFrame(
        dict(zip(ELEMENT, held[2:], strict=True)), index=pd.Index(held[0], dtype="int64", name="element_id")
    )
    numbers = [name for name, kind in ELEMENT.items() if kind == "REAL"]
    frame = frame.astype(dict.fromkeys(numbers, np.float64))
    return gpd.GeoDataFrame(frame, geometry=geopackage.from_blobs(held[1]), crs=settings.crs)


def count_looks(connection: sqlite3.Connection, elements: gpd.GeoDataFrame) -> None:
    """Say of elements who saw them and when, in place."""
    with geopackage.chosen(connection, elements.index.to_numpy()) as these:
        rows = connection.execute(
            "SELECT l.element_id, COUNT(DISTINCT l.observation_fid), COUNT(DISTINCT o.instance_fid), "
            "MIN(i.timestamp_ns), MAX(i.timestamp_ns) FROM lineage l JOIN observations o ON o.fid = "
            "l.observation_fid JOIN instances i ON i.fid = o.instance_fid "
            f"WHERE l.element_id IN {these} GROUP BY l.element_id"
        ).fetchall()
    names = ["element_id", "n_observations", "n_instances", "first_seen", "last_seen"]
    counted = pd.DataFrame(rows, columns=names).set_index("element_id").reindex(elements.index)
    for name in ("n_observations", "n_instances"):
        elements[name] = counted[name].fillna(0).to_numpy(dtype=np.int64)
    for name in ("first_seen", "last_seen"):
        elements[name] = _as_time(counted[name])
    elements["state"] = np.where(elements["evidence"].astype(float) >= SURE_OF, "confirmed", "tentative")


def write_elements(
    connection: sqlite3.Connection,
    settings: Settings,
    revision: int,
    now: gpd.GeoDataFrame,
    was: gpd.GeoDataFrame,
    gone: dict[int, int],
    moved: Callable[[str, BaseGeometry, BaseGeometry], float],
) -> Counts:
    """Write the elements that changed, and what changed.

    Parameters
    ----------
    connection : sqlite3.Connection
        Within a transaction.
    settings : Settings
        Of the map.
    revision : int
        What is written becomes part of it.
    now, was : GeoDataFrame
        Elements as they are to be and as they were, by their id.
    gone : dict of int to int
        Ids that are no more, and what each is part of.
    moved : callable
        Says of a class, the shape as it was and as it is how far it moved, metres.
    """
    new = ~now.index.isin(was.index)
    changed = new | ~_same(now, was)
    # Not as one upsert: its conflict clause would overrule that of the triggers.
    for write, chosen in ((geopackage.insert, new), (geopackage.replace, changed & ~new)):
        held = now[chosen]
        blobs = geopackage.to_blobs(held.geometry.to_numpy(), settings.srs_id)
        attributes = {name: held[name] for name in ELEMENT}
        write(connection, "elements", {"fid": held.index, "element_id": held.index, "geom": blobs, **attributes})
    written = now[changed]
    kind = np.where(new[changed], "added", "changed").astype(object)
    by = np.zeros(len(written))
    for row in np.flatnonzero(~new[changed]):
        by[row] = moved(written["class"].iloc[row], was.geometry.loc[written.index[row]], written.geometry.iloc[row])
    kind[by > 0] = "moved"
    _note(connection, settings, revision, written, kind, by)
    lost = was.loc[sorted(gone)]
    connection.executemany("DELETE FROM elements WHERE element_id = ?", [(int(old),) for old in lost.index])
    ends = np.array([gone[int(old)] for old in lost.index], dtype=np.int64)
    _note(connection, settings, revision, lost, np.where(ends == NO_ELEMENT, "retired", "merged"), np.zeros(len(lost)))
    geopackage.insert(
        connection,
        "id_aliases",
        {"old_id": lost.index, "element_id": ends, "revision": [revision] * len(lost)},
    )
    connection.executemany(
        "UPDATE id_aliases SET element_id = ?1 WHERE element_id = ?2",
        [(int(end), int(old)) for old, end in zip(lost.index, ends, strict=True)],
    )
    for table in ("elements", "changes"):
        geopackage.touched(connection, table, written.geometry.to_numpy())
    movements = int((kind == "moved").sum())
    retired = int((ends == NO_ELEMENT).sum())
    return Counts(
        added=int(new.sum()),
        changed=int((changed & ~new).sum()) - movements,
        moved=movements,
        retired=retired,
        merged=len(ends) - retired,
    )


def displacement(old: BaseGeometry, new: BaseGeometry) -> float:
    """Return the median distance from points along what is new to what was, metres."""
    old, new = (shape.boundary if shape.geom_type.endswith("Polygon") else shape for shape in (old, new))
    parts = shapely.get_parts(shapely.segmentize(new, max(new.length / 20, 1e-3)))
    return float(np.median(shapely.distance(old, shapely.points(shapely.get_coordinates(parts)))))


def _note(
    connection: sqlite3.Connection,
    settings: Settings,
    revision: int,
    elements: gpd.GeoDataFrame,
    kind: Iterable[str],
    moved_m: Array,
) -> None:
    """Put down what changed; nothing of it is ever changed again."""
    geopackage.insert(
        connection,
        "changes",
        {
            "geom": geopackage.to_blobs(elements.geometry.to_numpy(), settings.srs_id),
            "revision": [revision] * len(elements),
            "element_id": elements.index,
            "kind": list(kind),
            "moved_m": moved_m,
            **{name: elements[name] for name in ELEMENT},
        },
    )


def _as_time(nanoseconds: pd.Series[float]) -> list[str | None]:
    """Return times as GeoPackage has them, None where there is none."""
    return [
        None
        if value is None or value != value  # noqa: PLR0124 - NaN
        else str(np.datetime64(int(value), "ns").astype("datetime64[ms]")) + "Z"
        for value in nanoseconds.astype(object)
    ]


def _same(now: gpd.GeoDataFrame, was: gpd.GeoDataFrame) -> NDArray[np.bool_]:
    """Tell which elements are just as they were."""
    was = was.reindex(now.index)
    there = was["class"].notna().to_numpy()
    same = there.copy()
    same[there] = shapely.equals_identical(now.geometry.to_numpy()[there], was.geometry.to_numpy()[there])
    for name in ELEMENT:
        one, other = now[name].to_numpy(dtype=object), was[name].to_numpy(dtype=object)
        same &= (one == other) | (pd.isna(one) & pd.isna(other))
    return same
