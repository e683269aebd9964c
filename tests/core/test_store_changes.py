"""What a stored map makes of a road that changes: lines that go, come and move, told by drives one after another."""

from __future__ import annotations

import shutil

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from shapely import LineString, box

import polymerge_core as pm
from polymerge_core.store.identity import gone_into_areas
from polymerge_core.store.movement import _steps
from polymerge_core.store.shapes import Shape

CRS = "EPSG:32632"
ORIGIN = np.array([500_000.0, 5_000_000.0])
DAY_NS = 86_400_000_000_000


def straight(y, start=0.0, stop=60.0):
    return LineString(
        ORIGIN + np.column_stack([np.arange(start, stop + 1, 4.0), np.full(len(np.arange(start, stop + 1, 4.0)), y)])
    )


def drive(number, *lines, frames=6, footprints=True, sigma=0.1, cls="divider"):
    """Return what a drive sees: in each frame all lines, shifted a little."""
    rng = np.random.default_rng(number)
    rows, looked = [], []
    shift = rng.normal(0, sigma, 2)
    for frame in range(frames):
        name = {"drive": f"d{number}", "instance": f"f{frame}"}
        time = number * DAY_NS + frame * 1_000_000_000
        for line in lines:
            by = shift + rng.normal(0, sigma, 2)
            seen = shapely.transform(line, lambda xy, by=by: xy + by)
            rows.append({**name, "class": cls, "score": 0.9, "timestamp": time, "geometry": seen})
        area = shapely.transform(box(-10, -20, 70, 20), lambda xy: xy + ORIGIN)
        looked.append(
            {**name, "timestamp_ns": time, "x": ORIGIN[0] + 30, "y": ORIGIN[1], "heading": 90.0, "geometry": area}
        )
    columns = ["drive", "instance", "class", "score", "timestamp", "geometry"]
    observations = gpd.GeoDataFrame(pd.DataFrame(rows, columns=columns), geometry="geometry", crs=CRS)
    instances = gpd.GeoDataFrame(looked, geometry="geometry", crs=CRS).assign(n_observations=len(lines))
    return pm.LocalMaps(observations, instances if footprints else None, source=f"d{number}")


@pytest.fixture
def store(tmp_path):
    return pm.MapStore(tmp_path / "map.gpkg", create=True, crs=CRS)


@pytest.fixture(scope="module")
def thrice(tmp_path_factory):
    """A map that three drives told of the road."""
    path = tmp_path_factory.mktemp("thrice") / "map.gpkg"
    store = pm.MapStore(path, create=True, crs=CRS)
    for number in range(3):
        store.update(drive(number, *ROAD))
    return path


@pytest.fixture
def known(thrice, tmp_path):
    """A copy of it."""
    return pm.MapStore(shutil.copy(thrice, tmp_path / "map.gpkg"))


def heights(elements):
    """Return how far to the north each element lies, from south to north."""
    return sorted(round(float(shape.centroid.y - ORIGIN[1]), 1) for shape in elements.geometry)


ROAD = (straight(-4), straight(0), straight(4))


def test_a_line_that_two_drives_looked_for_in_vain_is_retired_and_can_be_had_back(known):
    before = known.elements()
    first = known.update(drive(3, ROAD[0], ROAD[2]))
    assert heights(known.elements()) == pytest.approx([-4, 0, 4], abs=0.3)
    second = known.update(drive(4, ROAD[0], ROAD[2]))
    assert (first.retired, second.retired) == (0, 1)
    assert heights(known.elements()) == pytest.approx([-4, 4], abs=0.3)
    (gone,) = set(before["element_id"]) - set(known.elements()["element_id"])
    changes = known.changes(3).set_index("element_id")
    assert changes["kind"][gone] == "retired"
    pd.testing.assert_frame_equal(pd.DataFrame(known.elements(3)), pd.DataFrame(before))
    assert known.verify() == []


def test_what_it_was_seen_by_is_listed_with_the_reason(known):
    for number in (3, 4):
        known.update(drive(number, ROAD[0], ROAD[2]))
    left_out = pm.read_layers(known.path)["observations"]
    assert len(left_out) == 3 * 6 * 3 + 2 * 6 * 2
    with known._opened() as (connection, _):
        rows = connection.execute("SELECT reason, COUNT(*) FROM left_out GROUP BY reason").fetchall()
    assert dict(rows) == {"the road changed since": 18}


def test_nothing_is_retired_where_nobody_knows_who_looked(store):
    for number in range(3):
        store.update(drive(number, *ROAD, footprints=False))
    for number in range(3, 8):
        store.update(drive(number, ROAD[0], ROAD[2], footprints=False))
    assert heights(store.elements()) == pytest.approx([-4, 0, 4], abs=0.3)


def test_a_line_painted_aside_keeps_its_id_and_lies_where_it_is_now(store):
    wide = (straight(-8), *ROAD, straight(8))
    for number in range(3):
        store.update(drive(number, *wide))
    before = store.elements()
    for number in range(3, 6):
        store.update(drive(number, *wide[:2], straight(0.8), *wide[3:]))
    after = store.elements()
    assert after["element_id"].tolist() == before["element_id"].tolist()
    assert heights(after) == pytest.approx([-8, -4, 0.8, 4, 8], abs=0.2)
    changes = store.changes(3)
    moved = changes[changes["kind"] == "moved"]
    assert moved["moved_m"].tolist() == pytest.approx([0.8], abs=0.25)
    (arrow,) = store.moves(3).geometry
    assert arrow.length == pytest.approx(0.8, abs=0.25)
    start, end = arrow.coords
    assert end[1] > start[1]


def test_what_appears_is_there_however_many_drives_did_not_see_it(store):
    store.update([drive(number, ROAD[0], ROAD[2]) for number in range(10)])
    for number in (10, 11):
        store.update(drive(number, *ROAD))
    elements = store.elements()
    assert heights(elements) == pytest.approx([-4, 0, 4], abs=0.3)
    assert store.verify() == []


def test_a_line_that_appears_is_sure_only_when_two_drives_saw_it(store):
    for number in range(5):
        store.update(drive(number, ROAD[0], ROAD[2]))
    store.update(drive(5, *ROAD))
    first = store.elements().set_index(store.elements().centroid.y.round() - ORIGIN[1])["state"]
    assert first.get(0.0, "tentative") == "tentative"
    store.update(drive(6, *ROAD))
    second = store.elements()
    middle = second[(second.centroid.y - ORIGIN[1]).abs() < 1]
    assert middle["state"].tolist() == ["confirmed"]


def test_a_late_report_of_a_drive_before_the_change_brings_nothing_back(known):
    for number in (5, 6):
        known.update(drive(number, ROAD[0], ROAD[2]))
    known.update(drive(3, *ROAD))
    assert heights(known.elements()) == pytest.approx([-4, 4], abs=0.3)
    assert known.verify() == []


def test_a_line_that_vanished_comes_back_when_it_is_painted_again(known):
    for number in (3, 4, 5):
        known.update(drive(number, ROAD[0], ROAD[2]))
    ids = set(known.elements()["element_id"])
    for number in (6, 7):
        known.update(drive(number, *ROAD))
    elements = known.elements()
    assert heights(elements) == pytest.approx([-4, 0, 4], abs=0.3)
    (new,) = set(elements["element_id"]) - ids
    assert new > max(ids)


def test_part_of_a_line_vanishes_alone(known):
    left = straight(0, 0, 24)
    for number in (3, 4, 5):
        known.update(drive(number, ROAD[0], left, ROAD[2]))
    elements = known.elements()
    middle = elements[(elements.centroid.y - ORIGIN[1]).abs() < 1]
    assert middle.geometry.length.sum() == pytest.approx(24, abs=4)


@pytest.mark.parametrize("seed", range(3))
def test_a_road_that_stays_as_it_is_does_not_change(store, seed):
    for number in range(0, 10, 2):
        done = store.update([drive(100 * seed + each, *ROAD, sigma=0.2) for each in (number, number + 1)])
    assert len(store.elements()) == 3
    assert done.retired == done.moved == 0
    assert pm.read_layers(store.path).get("renewed", []) is not None
    with store._opened() as (connection, _):
        assert connection.execute("SELECT COUNT(*) FROM renewed").fetchone()[0] == 0


def test_a_place_that_very_many_looked_at_is_drawn_from_the_newest(store):
    store.update([drive(number, *ROAD, frames=2) for number in range(20)])
    assert heights(store.elements()) == pytest.approx([-4, 0, 4], abs=0.2)
    assert store.elements()["n_instances"].max() == 16 * 2
    with store._opened() as (connection, _):
        rows = connection.execute("SELECT reason, COUNT(*) FROM left_out GROUP BY reason").fetchall()
    assert dict(rows) == {"enough other local maps looked there": 4 * 2 * 3}
    assert store.verify() == []


def with_clock(local_maps, nanoseconds):
    """Return a drive whose frames have other timestamps, or none."""
    seen, looked = local_maps.observations.copy(), local_maps.instances.copy()
    if nanoseconds is None:
        return pm.LocalMaps(
            seen.drop(columns="timestamp"), looked.drop(columns="timestamp_ns"), source=local_maps.source
        )
    number = seen["instance"].str.removeprefix("f").astype(int)
    seen["timestamp"] = nanoseconds + number * 1_000_000_000
    looked["timestamp_ns"] = nanoseconds + looked["instance"].str.removeprefix("f").astype(int) * 1_000_000_000
    return pm.LocalMaps(seen, looked, source=local_maps.source)


def renewals(store):
    with store._opened() as (connection, _):
        return connection.execute("SELECT class, kind, since_drive FROM renewed ORDER BY fid").fetchall()


VANISHING = [ROAD, ROAD, ROAD, (ROAD[0], ROAD[2]), (ROAD[0], ROAD[2]), (ROAD[0], ROAD[2])]


@pytest.mark.parametrize("clock", [None, 0], ids=["no clock", "clocks begin with each drive"])
def test_without_a_common_clock_drives_are_in_the_order_in_which_the_map_was_told(store, clock):
    for number, lines in enumerate(VANISHING):
        store.update(with_clock(drive(number, *lines), clock))
    assert heights(store.elements()) == pytest.approx([-4, 4], abs=0.3)
    assert renewals(store) == [("divider", "vanished", "d3")]


@pytest.mark.parametrize("clock", [None, 0], ids=["no clock", "clocks begin with each drive"])
def test_nobody_knows_what_changed_between_drives_told_at_once_without_a_common_clock(store, clock):
    store.update([with_clock(drive(number, *lines), clock) for number, lines in enumerate(VANISHING)])
    assert renewals(store) == []


def test_the_clock_tells_the_order_of_drives_told_the_other_way_round(store):
    for number in reversed(range(6)):
        store.update(drive(number, *VANISHING[number]))
    assert heights(store.elements()) == pytest.approx([-4, 4], abs=0.3)
    assert renewals(store) == [("divider", "vanished", "d3")]


def test_where_drives_often_miss_a_line_two_that_do_are_not_enough(store):
    """A predictor that loses lines for whole drives says little by losing one once more."""
    flickering = (straight(-12), straight(-8), *ROAD, straight(8), straight(12))
    for number in range(8):
        seen = [line for at, line in enumerate(flickering) if (at + number) % 3]
        store.update(drive(number, *seen))
    always = [line for at, line in enumerate(flickering) if at != 3]
    for number in (8, 9):
        store.update(drive(number, *always))
    assert renewals(store) == []
    assert len(store.elements()) == 7


@pytest.mark.parametrize(("without", "noted"), [(5, []), (9, [("divider", "appeared", "d9")])])
def test_a_change_that_is_hardly_likelier_than_none_is_not_noted(store, without, noted):
    """Each drive that does not see a line says little here: five of them are no reason to take it for a new one."""
    flickering = (straight(-12), straight(-8), straight(-4), straight(4), straight(8), straight(12))
    for number in range(without):
        store.update(drive(number, *[line for at, line in enumerate(flickering) if (at + number) % 3], frames=5))
    for number in range(without, without + 2):
        store.update(drive(number, *flickering, straight(0), frames=5))
    assert renewals(store) == noted
    assert len(store.elements()) == 7


def test_a_drive_that_did_not_see_a_line_says_nothing_of_where_it_lies():
    """Also where the line lies far from where it was, for the other drives."""
    offset = np.array([[0.0, 0.1, 2.4, 2.3, 2.5]])
    told = _steps(offset, np.full((1, 5), 0.01), 1.0, 5.0)
    between = np.insert(offset, [1, 4], np.nan, axis=1)
    with_others = _steps(between, np.where(np.isnan(between), np.nan, 0.01), 1.0, 5.0)
    assert told[0, 1] > 100
    np.testing.assert_allclose(with_others[0, 2:4], told[0, 1:3])
    assert np.isneginf(np.delete(with_others[0], [2, 3])).all()


@pytest.mark.parametrize(("west", "into"), [(1.5, 7), (3.0, -1)], ids=["in another one", "beside it"])
def test_an_area_that_is_no_more_and_lies_in_another_one_went_into_that(west, into):
    nothing = np.empty(0, np.intp)
    rings = [
        LineString(box(*bounds).exterior.coords) for bounds in ((0, 0, 4, 12), (0, 20, 4, 32), (west, 0, west + 4, 12))
    ]
    shapes = [Shape("ped_crossing", ring, nothing, nothing, nothing, nothing) for ring in rings[:2]]
    shapes.append(Shape("divider", rings[2], nothing, nothing, nothing, nothing))
    stored = gpd.GeoDataFrame({"class": ["ped_crossing"] * 2}, geometry=[rings[2], rings[1]], index=[5, 6])
    gone = {5: -1, 6: 6}
    assert gone | gone_into_areas(shapes, np.array([7, 8, 9]), stored, gone) == {5: into, 6: 6}


def test_undoing_the_drives_that_saw_a_line_vanish_brings_it_back(known):
    for number in (3, 4):
        known.update(drive(number, ROAD[0], ROAD[2]))
    assert heights(known.elements()) == pytest.approx([-4, 4], abs=0.3)
    known.undo(4, 5)
    assert heights(known.elements()) == pytest.approx([-4, 0, 4], abs=0.3)
    assert renewals(known) == []
    assert known.verify() == []
