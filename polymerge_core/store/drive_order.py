"""Which drive came before which: the order in which the road is known to have been seen.

Clocks tell it where drives were at different times. Drives at the same time, or whose clocks begin with each drive, are
in the order in which the map was told of them; of those that it was told of at once without a time nobody knows.
"""

from __future__ import annotations

import sqlite3
from typing import NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from polymerge_core.curves import Index

_UNKNOWN = np.iinfo(np.int64).max


class DriveOrder(NamedTuple):
    """Drives in order.

    Parameters
    ----------
    drive : ndarray of int, shape (n,)
        The place in the order of the drive of each local map.
    first : ndarray of int, shape (d,)
        The first local map (row) of each drive, in order.
    known : ndarray of bool, shape (d - 1,)
        Whether the next drive is known to have come after each.
    """

    drive: Index
    first: Index
    known: NDArray[np.bool_]


def read_drives(connection: sqlite3.Connection, told: pd.Series[int]) -> pd.DataFrame:
    """Return when drives began and ended.

    Parameters
    ----------
    connection : sqlite3.Connection
        Of a stored map.
    told : Series
        By the name of the drive: the revision in which the map was told of it.

    Returns
    -------
    DataFrame
        By name: `begin`, `end` (nanoseconds, the largest number where unknown), `revision`.
    """
    times = {}
    # One by one: the index answers the least and the greatest, but not both at once.
    for column, ends in (("begin", "MIN"), ("end", "MAX")):
        query = f"SELECT ifnull({ends}(timestamp_ns), {_UNKNOWN}) FROM instances WHERE drive = ?"
        found = [connection.execute(query, (str(name),)).fetchone()[0] for name in told.index]
        times[column] = np.array(found, dtype=np.int64)
    return pd.DataFrame({**times, "revision": told.to_numpy(dtype=np.int64)}, index=told.index)


def order_drives(instances: gpd.GeoDataFrame, drives: pd.DataFrame) -> DriveOrder:
    """Put the drives of local maps in order.

    Parameters
    ----------
    instances : GeoDataFrame
        Local maps: `drive`, `timestamp_ns`.
    drives : DataFrame
        From `read_drives`.
    """
    by_time = drives.loc[pd.unique(instances["drive"])].sort_values(["begin", "end"], kind="stable")
    # Drives that were under way at the same time, one after another.
    latest = by_time["end"].cummax().shift(fill_value=-1)
    period = (by_time["begin"] > latest).cumsum()
    ranked = by_time.assign(period=period, name=by_time.index).sort_values(["period", "revision", "begin", "name"])
    known = (ranked[["period", "revision"]].diff().iloc[1:] != 0).any(axis=1).to_numpy(dtype=bool)
    number = pd.Series(np.arange(len(ranked)), index=ranked.index)
    drive = number.reindex(instances["drive"]).to_numpy(dtype=np.intp)
    time = instances["timestamp_ns"].fillna(_UNKNOWN).to_numpy(dtype=np.int64)
    rows = np.lexsort((np.arange(len(time)), time, drive))
    first = rows[np.flatnonzero(np.diff(drive[rows], prepend=-1))]
    return DriveOrder(drive, first, known)


def came_before(instances: gpd.GeoDataFrame, drives: pd.DataFrame, since: str) -> NDArray[np.bool_]:
    """Tell which local maps are of drives before one.

    Parameters
    ----------
    instances : GeoDataFrame
        Local maps: `drive`.
    drives : DataFrame
        From `read_drives`.
    since : str
        The name of the one.
    """
    one = drives.loc[since]
    earlier, later = drives["end"] < one["begin"], drives["begin"] > one["end"]
    before = earlier | (~later & (drives["revision"] < one["revision"]))
    return before.reindex(instances["drive"]).to_numpy(dtype=bool)
