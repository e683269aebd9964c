"""Which drive came before which, from clocks and from the order in which a map was told of them."""

from __future__ import annotations

import geopandas as gpd
import pandas as pd
import pytest
from shapely import Point

from polymerge_core.store.drive_order import came_before, order_drives

UNKNOWN = 2**63 - 1


def told(**drives):
    """Return drives by name: when they began and ended, and the revision that they came with."""
    columns = ["begin", "end", "revision"]
    return pd.DataFrame.from_dict(
        {name: [UNKNOWN if value is None else value for value in row] for name, row in drives.items()},
        orient="index",
        columns=columns,
    )


def frames(*rows):
    """Return local maps: drive and time."""
    table = pd.DataFrame(rows, columns=["drive", "timestamp_ns"]).astype({"timestamp_ns": "Int64"})
    return gpd.GeoDataFrame(table, geometry=[Point(0, 0)] * len(table))


def names(order, instances):
    return instances["drive"].iloc[order.first].tolist()


def test_clocks_tell_the_order_whatever_came_first():
    drives = told(late=(100, 200, 1), early=(0, 50, 2))
    instances = frames(("late", 150), ("early", 10), ("late", 120), ("early", 5))
    order = order_drives(instances, drives)
    assert names(order, instances) == ["early", "late"]
    assert order.first.tolist() == [3, 2]
    assert order.drive.tolist() == [1, 0, 1, 0]
    assert order.known.tolist() == [True]


@pytest.mark.parametrize("times", [(0, 60), (None, None)], ids=["clocks begin anew", "no clocks"])
def test_without_a_common_clock_the_map_was_told_of_them_in_order(times):
    drives = told(b=(*times, 1), a=(*times, 3), c=(*times, 3))
    instances = frames(*((name, times[0]) for name in "abc"))
    order = order_drives(instances, drives)
    assert names(order, instances) == ["b", "a", "c"]
    assert order.known.tolist() == [True, False]


def test_drives_at_the_same_time_are_together_one_after_another():
    drives = told(a=(0, 60, 4), b=(50, 90, 3), c=(80, 120, 2), d=(130, 140, 1))
    instances = frames(("a", 0), ("b", 50), ("c", 80), ("d", 130))
    assert names(order_drives(instances, drives), instances) == ["c", "b", "a", "d"]


def test_drives_without_a_time_come_after_those_that_have_one():
    drives = told(timeless=(None, None, 1), timed=(0, 60, 2))
    instances = frames(("timeless", None), ("timed", 0))
    order = order_drives(instances, drives)
    assert names(order, instances) == ["timed", "timeless"]
    assert order.known.tolist() == [True]


def test_times_are_told_apart_to_the_nanosecond():
    start = 1_700_000_000_000_000_001
    drives = told(second=(start + 1, start + 1, 1), first=(start, start, 1))
    instances = frames(("second", start + 1), ("first", start))
    order = order_drives(instances, drives)
    assert names(order, instances) == ["first", "second"]
    assert order.known.tolist() == [True]


def test_what_came_before_a_drive_is_told_by_clocks_else_by_revisions():
    drives = told(earlier=(0, 10, 9), later=(90, 99, 1), beside_old=(45, 70, 3), beside_new=(30, 60, 8), it=(40, 60, 5))
    instances = frames(*((name, None) for name in drives.index))
    assert came_before(instances, drives, "it").tolist() == [True, False, True, False, False]
