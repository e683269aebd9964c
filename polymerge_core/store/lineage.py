"""What each observation went into: the table `lineage`, and `left_out` with the reason why it is in no element."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from polymerge_core.consensus.run import UNSUPPORTED
from polymerge_core.schema import NO_ELEMENT
from polymerge_core.store import geopackage
from polymerge_core.store.evidence import Context
from polymerge_core.store.merging import Merged
from polymerge_core.store.shapes import Shape, by_piece, middle_of, middles_of, nearest

#: Why all of an observation is in no element: its local map is one of too many.
UNHEARD = "enough other local maps looked there"


def read_lineage(connection: sqlite3.Connection, context: Context) -> pd.DataFrame:
    """Return which intervals of the observations of the context are in which element."""
    with geopackage.chosen(connection, context.observations.index.to_numpy()) as these:
        rows = connection.execute(
            "SELECT observation_fid, element_id, from_m, to_m FROM lineage "
            f"WHERE observation_fid IN {these} ORDER BY fid"
        ).fetchall()
    return pd.DataFrame(rows, columns=["observation_fid", "element_id", "from_m", "to_m"])


def attribute(
    connection: sqlite3.Connection,
    place: BaseGeometry,
    context: Context,
    merged: Merged,
    stored: gpd.GeoDataFrame,
    shapes: list[Shape],
    ids: NDArray[np.int64],
    votes: pd.DataFrame,
    gone: dict[int, int],
) -> None:
    """Write what the observations that meet a place went into."""
    held = context.observations
    drawn = by_piece(shapes, "new").drop_duplicates(["row", "shape"])
    meets = shapely.intersects(place, held.geometry.to_numpy())
    theirs = merged.lineage.loc[merged.lineage["row"].isin(drawn["row"]), "observation_fid"]
    here = held.index[meets | held.index.isin(theirs)]
    lineage = merged.lineage[merged.lineage["observation_fid"].isin(here)]
    # A merged element that is not drawn here is that stored one which it has most in common with.
    best = votes.sort_values(["length", "element_id"], ascending=[False, True]).drop_duplicates("row")
    stands_for = best.set_index("row")["element_id"].replace(gone)
    row = lineage["row"].to_numpy()
    element = pd.Series(row).map(stands_for).fillna(NO_ELEMENT).to_numpy(dtype=np.int64, copy=True)
    left = by_piece(shapes, "old")
    left["element_id"] = stored.index.to_numpy()[left["row"]]
    beside = votes.merge(left, on="element_id", suffixes=("", "_old"))[["row", "shape"]]
    places_of = pd.concat([drawn[["row", "shape"]], beside]).drop_duplicates()
    for number, several in places_of[places_of["row"].isin(drawn["row"])].groupby("row"):
        rows = np.flatnonzero(row == number)
        places = several["shape"].to_numpy()
        element[rows] = ids[nearest(shapes, places, middles_of(held, lineage.iloc[rows]))]
    lost = element == NO_ELEMENT
    left_out = merged.left_out[merged.left_out["observation_fid"].isin(here)]
    left_out = pd.concat([left_out, lineage[lost].assign(reason=UNSUPPORTED)], ignore_index=True)
    with geopackage.chosen(connection, here.to_numpy()) as these:
        for table in ("lineage", "left_out"):
            connection.execute(f"DELETE FROM {table} WHERE observation_fid IN {these}")
    kept = _intervals(context, lineage[~lost])
    geopackage.insert(connection, "lineage", kept | {"element_id": element[~lost], "weight": lineage["weight"][~lost]})
    geopackage.insert(connection, "left_out", _intervals(context, left_out) | {"reason": left_out["reason"]})
    for old, now in sorted(gone.items()):
        if now == NO_ELEMENT:
            names = "source, source_fid, drive, instance, from_m, to_m"
            connection.execute(
                f"INSERT INTO left_out ({names}, reason, observation_fid) SELECT {names}, ?, observation_fid "
                "FROM lineage WHERE element_id = ? ORDER BY fid",
                (UNSUPPORTED, old),
            )
            connection.execute("DELETE FROM lineage WHERE element_id = ?", (old,))
        else:
            connection.execute("UPDATE lineage SET element_id = ? WHERE element_id = ?", (now, old))


def share_out(
    connection: sqlite3.Connection, shapes: list[Shape], ids: NDArray[np.int64], stored: gpd.GeoDataFrame
) -> None:
    """Give what lies along the other parts of a stored element that is in several pieces now to these."""
    parts = by_piece(shapes, "old").drop_duplicates(["row", "shape"])
    for row, several in parts.groupby("row"):
        places = several["shape"].to_numpy()
        own = int(stored.index[row])
        if (ids[places] == own).all():
            continue
        rows = connection.execute(
            "SELECT l.fid, o.geom FROM lineage l JOIN observations o ON o.fid = l.observation_fid "
            "WHERE l.element_id = ? ORDER BY l.fid",
            (own,),
        ).fetchall()
        if not rows:
            continue
        seen = geopackage.from_blobs([blob for _, blob in rows])
        mine = np.flatnonzero(ids == own)
        now = ids[nearest(shapes, np.union1d(places, mine), middle_of(seen))]
        connection.executemany(
            "UPDATE lineage SET element_id = ? WHERE fid = ?",
            [(int(new), fid) for new, (fid, _) in zip(now, rows, strict=True) if new != own],
        )


def list_unheard(connection: sqlite3.Connection) -> None:
    """List what is new and was not heard, because enough others looked there."""
    connection.execute(
        "INSERT INTO left_out (source, source_fid, drive, instance, from_m, to_m, reason, observation_fid) "
        "SELECT o.source, o.source_fid, i.drive, i.instance, o.from_m, o.to_m, ?, o.fid FROM instances i JOIN "
        "observations o ON o.instance_fid = i.fid WHERE i.drawn IS NULL AND o.fid NOT IN (SELECT observation_fid "
        "FROM lineage WHERE observation_fid = o.fid) AND o.fid NOT IN (SELECT observation_fid FROM left_out WHERE "
        "observation_fid = o.fid) ORDER BY o.fid",
        (UNHEARD,),
    )


def _intervals(context: Context, intervals: pd.DataFrame) -> dict[str, Iterable[Any]]:
    """Return intervals of observations as intervals of the features that these came from."""
    fid = intervals["observation_fid"].to_numpy(dtype=np.int64)
    own = context.observations.loc[fid]
    whose = context.instances.loc[own["instance_fid"]]
    start = own["from_m"].to_numpy(dtype=float)
    return {
        "source": own["source"],
        "source_fid": own["source_fid"],
        "drive": whose["drive"],
        "instance": whose["instance"],
        "from_m": start + intervals["from_m"].to_numpy(dtype=float),
        "to_m": start + intervals["to_m"].to_numpy(dtype=float),
        "observation_fid": fid,
    }
