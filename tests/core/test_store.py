"""The stored map: what an update makes of it, what it remembers, and what it survives."""

from __future__ import annotations

import contextlib
import json
import shutil
import sqlite3
import warnings

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import pytest
import shapely
from geopandas.testing import assert_geodataframe_equal
from pandas.testing import assert_frame_equal
from shapely import LineString, MultiLineString, box

import polymerge_core as pm
from benchmarks.scenarios import town
from polymerge_core import MapStore
from polymerge_core.crs import LOCAL_CRS
from polymerge_core.store import shapes
from polymerge_core.store.beliefs import DENIED, Judgement
from polymerge_core.store.element_table import displacement
from polymerge_core.store.geopackage import connect
from tests.core.layers import read_only
from tests.core.test_consensus import apart, level, looks
from tests.core.test_consensus_state import distances, some

LAYERS = ("elements", "changes", "instances", "observations", "renewed")
TABLES = ("lineage", "left_out", "id_aliases", "revisions", "map_settings")
UTM = "EPSG:32632"
EAST, NORTH = 400_000.0, 6_000_000.0
ROAD = box(-5, -10, 105, 30)


def frame(number, *shapes, around=ROAD, crs=LOCAL_CRS, drive="a", cls="divider", timestamp=True):
    """One local map of a vehicle in the middle of the road, and what it looked at."""
    seen = looks(level(0), *shapes, cls=cls, crs=crs, drive=drive, instance=number).iloc[1:].reset_index(drop=True)
    columns = {"drive": [drive], "instance": [number], "x": [50.0], "y": [0.0], "heading": [90.0]}
    # A second apart, from midnight of the second of January 2024 on.
    columns["timestamp_ns"] = [(1_704_153_600 + number) * 10**9] if timestamp else [None]
    return pm.LocalMaps(seen, gpd.GeoDataFrame(columns, geometry=[around], crs=crs), source=drive)


def on_earth(*local):
    """Carry local maps to a corner of UTM zone 32."""
    found = []
    for maps in local:
        layers = [
            gpd.GeoDataFrame(
                each.drop(columns="geometry"), geometry=np.asarray(each.geometry.translate(EAST, NORTH)), crs=UTM
            )
            for each in (maps.observations, maps.instances)
        ]
        layers[1]["x"] += EAST
        layers[1]["y"] += NORTH
        found.append(pm.LocalMaps(*layers, source=maps.source))
    return found


def read(store, query):
    with contextlib.closing(sqlite3.connect(store.path)) as connection:
        return connection.execute(query).fetchall()


def dump(store):
    """Return all that is in the file."""
    with contextlib.closing(sqlite3.connect(store.path)) as connection:
        return list(connection.iterdump())


@pytest.fixture
def store(tmp_path):
    """A map that is not made yet."""
    return MapStore(tmp_path / "map.gpkg", create=True, crs=LOCAL_CRS)


def in_turn(store, local, order=None, **options):
    """Feed a map the frames of a drive one by one."""
    for row in np.arange(len(local.instances)) if order is None else order:
        store.update(some(local, np.array([row])), **options)
    return store


@pytest.fixture(scope="module")
def drive():
    (local,) = town(1).local
    return local


@pytest.fixture(scope="module")
def once(drive):
    return pm.merge(drive).elements


@pytest.fixture(scope="module")
def told(tmp_path_factory, drive):
    """A map that was fed a drive frame by frame, and the elements that it had after each."""
    store = MapStore(tmp_path_factory.mktemp("told") / "map.gpkg", create=True)
    elements = []
    for row in range(len(drive.instances)):
        store.update(some(drive, np.array([row])))
        elements.append(store.elements())
    return store, elements


@pytest.fixture
def fed(told, tmp_path):
    """A copy of such a map, to do with as one likes."""
    return MapStore(shutil.copy(told[0].path, tmp_path / "fed.gpkg"))


class TestTheSameMap:
    def test_comes_of_all_at_once_as_of_a_merge(self, tmp_path, drive, once):
        store = MapStore(tmp_path / "map.gpkg", create=True)
        update = store.update(drive)
        elements = store.elements()
        assert_geodataframe_equal(elements[once.columns.tolist()], once, check_dtype=False)
        assert shapely.to_wkb(elements.geometry).tolist() == shapely.to_wkb(once.geometry).tolist()
        assert (update.added, update.elements, update.instances) == (len(once), len(once), len(drive.instances))
        assert update.observations == len(drive.observations)
        assert store.verify() == []

    def test_comes_of_frames_one_by_one(self, told, once):
        elements = told[0].elements()
        far = distances(elements, once)
        assert len(elements) == len(once)
        assert np.median(far) <= 0.05
        assert np.quantile(far, 0.95) <= 0.2

    def test_comes_of_frames_in_another_order(self, tmp_path, told, drive):
        order = np.random.default_rng(5).permutation(10)
        mixed = in_turn(MapStore(tmp_path / "map.gpkg", create=True), drive, order)
        elements, expected = mixed.elements(), told[1][9]
        assert np.median(distances(elements, expected)) <= 0.05
        assert abs(len(elements) - len(expected)) <= 1
        assert mixed.verify() == []

    def test_comes_of_drawing_late(self, tmp_path, drive, once):
        store = in_turn(MapStore(tmp_path / "map.gpkg", create=True), drive, draw=False)
        assert len(store.elements()) == 0
        assert store.verify() == []
        update = store.draw()
        assert (update.added, update.instances, update.observations) == (len(once), 0, 0)
        assert shapely.to_wkb(store.elements().geometry).tolist() == shapely.to_wkb(once.geometry).tolist()
        assert store.verify() == []
        assert store.draw() is None

    def test_comes_of_the_same_input_to_the_last_bit(self, tmp_path, drive):
        first, second = (
            in_turn(MapStore(tmp_path / name, create=True), drive, range(4)).elements() for name in ("a", "b")
        )
        assert_geodataframe_equal(first, second)
        assert shapely.to_wkb(first.geometry).tolist() == shapely.to_wkb(second.geometry).tolist()

    def test_is_drawn_of_what_waits_with_the_next_update_that_draws(self, store):
        store.update(frame(0, level(0, 0, 100)), draw=False)
        update = store.update(frame(1, level(10, 0, 100)))
        assert update.added == 2
        assert store.history()["added"].tolist() == [0, 2]


class TestUpdating:
    def test_tells_what_it_did(self, store):
        first = store.update(frame(0, level(0, 0, 100), level(10, 0, 100)))
        expected = {"revision": 1, "instances": 1, "observations": 2, "skipped": 0, "elements": 2, "warnings": []}
        counts = {"added": 2, "changed": 0, "moved": 0, "retired": 0, "merged": 0, "left_out": {}}
        assert first.report() == expected | counts
        second = store.update(frame(1, level(0.1, 0, 100)))
        assert (second.revision, second.added, second.elements) == (2, 0, 2)
        assert second.changed == 2  # the score of what was not seen sinks
        json.dumps(second.report())

    def test_says_who_saw_an_element_and_when(self, store):
        for number in range(2):
            store.update(frame(number, level(0, 0, 100), *([level(10, 0, 100)] if number else [])))
        elements = store.elements().set_index("element_id")
        assert elements["n_instances"].tolist() == [2, 1]
        assert elements["n_observations"].tolist() == [2, 1]
        assert elements["state"].tolist() == ["confirmed", "tentative"]
        assert elements["first_seen"].tolist() == ["2024-01-02T00:00:00.000Z", "2024-01-02T00:00:01.000Z"]
        assert elements["last_seen"].tolist() == ["2024-01-02T00:00:01.000Z"] * 2
        assert elements["length_m"].tolist() == pytest.approx([100, 100])

    def test_knows_no_time_without_timestamps(self, store):
        store.update(frame(0, level(0, 0, 100), timestamp=False))
        assert store.elements()[["first_seen", "last_seen"]].isna().all(axis=None)

    def test_leaves_the_rest_of_the_map_as_it_was(self, store):
        store.update(
            [frame(0, level(0, 0, 100), around=ROAD), frame(1, level(500, 0, 100), around=box(0, 490, 100, 510))]
        )
        before = store.elements()
        store.update(frame(2, level(0.4, 0, 100)))
        after = store.elements()
        assert_geodataframe_equal(after.iloc[[1]], before.iloc[[1]])
        assert after["n_instances"].tolist() == [2, 1]
        assert store.changes(1)["element_id"].tolist() == [1]

    def test_skips_what_the_map_knows_and_makes_no_revision_of_it(self, store):
        store.update(frame(0, level(0, 0, 100)))
        before = dump(store)
        again = store.update(frame(0, level(0.4, 0, 100), level(9, 0, 100)))
        assert (again.revision, again.skipped, again.instances, again.observations) == (1, 1, 0, 0)
        assert again.warnings == ["1 local map was skipped: the map knows drive and instance already"]
        assert dump(store) == before

    def test_takes_what_is_new_beside_what_it_knows(self, store):
        store.update(frame(0, level(0, 0, 100)))
        both = store.update([frame(0, level(0, 0, 100)), frame(1, level(0.2, 0, 100))])
        assert (both.revision, both.skipped, both.instances) == (2, 1, 1)
        assert store.history()[["n_instances", "n_skipped"]].to_numpy().tolist() == [[1, 0], [1, 1]]
        assert store.verify() == []

    def test_tells_drives_apart_whose_frames_have_the_same_name(self, store):
        store.update(frame(0, level(0, 0, 100), drive="a"))
        assert store.update(frame(0, level(0.2, 0, 100), drive="b")).skipped == 0
        assert store.elements()["n_instances"].tolist() == [2]

    def test_of_frames_that_saw_nothing_makes_an_empty_map(self, store):
        update = store.update([frame(0), frame(1)])
        assert (update.instances, update.observations, update.elements) == (2, 0, 0)
        assert len(store.elements()) == len(store.changes()) == len(store.moves()) == 0
        assert store.verify() == []
        assert store.update(frame(1)).skipped == 1

    def test_keeps_the_time_of_every_frame_to_the_nanosecond(self, store):
        # The second saw nothing, and of the first nobody says when it was but its observations.
        seen = looks(level(0), crs=LOCAL_CRS, instance=[5]).assign(timestamp=[1_704_153_600_123_456_789])
        store.update([pm.LocalMaps(seen), frame(6)])
        assert read(store, "SELECT instance, timestamp_ns FROM instances ORDER BY instance") == [
            ("5", 1_704_153_600_123_456_789),
            ("6", 1_704_153_606_000_000_000),
        ]

    def test_of_no_local_maps_at_all_makes_an_empty_map_once(self, store):
        nothing = looks(level(0), crs=LOCAL_CRS).iloc[:0]
        assert store.update(nothing).revision == 1
        assert store.update(nothing).revision == 1
        assert store.verify() == []

    def test_does_without_footprints(self, store):
        layer = looks(*(level(0.1 * n, 0, 100) for n in range(4)), crs=LOCAL_CRS)
        store.update(layer.iloc[:2])
        store.update(layer.iloc[2:])
        elements = store.elements()
        assert elements["n_instances"].tolist() == [4]
        assert apart(elements, looks(level(0.15, 0, 100))) < 0.05
        assert read(store, "SELECT DISTINCT has_footprint FROM instances") == [(0,)]
        assert store.verify() == []

    def test_keeps_parts_of_a_feature_apart(self, store):
        store.update(looks(MultiLineString([level(0, 0, 50), level(10, 0, 50)]), level(0.1, 0, 50), crs=LOCAL_CRS))
        assert store.elements()["n_observations"].tolist() in ([1, 2], [2, 1])
        rows = read(store, "SELECT source_fid, SUM(to_m - from_m) FROM lineage GROUP BY source_fid ORDER BY source_fid")
        assert rows == [("0", pytest.approx(100)), ("1", pytest.approx(50))]
        assert store.verify() == []

    def test_keeps_areas(self, store):
        square = box(20, 0, 30, 4)
        for number in range(3):
            store.update(frame(number, shapely.affinity.translate(square, 0.1 * number), cls="ped_crossing"))
        (element,) = store.elements().itertuples()
        assert element.geometry.geom_type == "Polygon"
        assert shapely.hausdorff_distance(element.geometry, shapely.affinity.translate(square, 0.1)) < 0.1
        assert element.n_instances == 3
        assert store.verify() == []

    def test_takes_classes_that_are_areas_from_the_map(self, tmp_path):
        store = MapStore(tmp_path / "map.gpkg", create=True, crs=LOCAL_CRS, area="island")
        square = box(20, 0, 30, 4)
        store.update(frame(0, square, cls="island"))
        MapStore(store.path).update(frame(1, square, cls="island"))
        assert store.elements().geometry.geom_type.tolist() == ["Polygon"]
        assert store.verify() == []

    def test_says_what_it_left_out_and_why(self, store):
        update = store.update([frame(0, level(0, 0, 100), LineString([(7, 7), (7, 7)]))])
        ((reason, count),) = update.left_out.items()
        assert count == 1
        assert read(store, "SELECT reason, source_fid FROM left_out") == [(reason, "1")]
        assert store.verify() == []

    def test_is_strict_if_asked_to(self, store):
        with pytest.raises(pm.InputError):
            store.update([frame(0, level(0, 0, 100), LineString([(7, 7), (7, 7)]))], strict=True)
        assert not store.path.exists()

    def test_reads_local_maps_with_the_options_of_a_merge(self, store):
        layer = looks(level(0), level(10), crs=None).rename(columns={"class": "kind", "instance": "token"})
        layer["p"] = [0.9, 0.1]
        options = {"class_field": "kind", "instance_field": "token", "score_field": "p", "min_score": 0.5}
        update = store.update(layer, crs="local", **options)
        assert update.observations == 1
        assert store.elements()[["class", "score"]].to_numpy().tolist() == [["divider", 0.9]]

    @pytest.mark.parametrize("option", ["proximity", "area", "main_map", "out_crs", "no_such"])
    def test_has_no_options_that_the_map_decides(self, store, option):
        with pytest.raises(pm.OptionError, match=option):
            store.update(frame(0, level(0)), **{option: 1})
        assert not store.path.exists()

    def test_does_not_change_its_input(self, store):
        maps = frame(0, level(0, 0, 100), box(20, 0, 30, 4))
        kept = [each.copy(deep=True) for each in (maps.observations, maps.instances)]
        store.update(maps)
        assert_geodataframe_equal(maps.observations, kept[0])
        assert_geodataframe_equal(maps.instances, kept[1])


class TestCrs:
    def test_is_that_in_which_the_first_local_maps_are_merged(self, tmp_path):
        store = MapStore(tmp_path / "map.gpkg", create=True)
        store.update(on_earth(frame(0, level(0, 0, 100))))
        assert store.crs == UTM
        assert store.elements().crs == UTM

    def test_given_is_kept_and_local_maps_are_brought_into_it(self, tmp_path):
        store = MapStore(tmp_path / "map.gpkg", create=True, crs="EPSG:25832")
        assert store.crs == "EPSG:25832"
        (maps,) = on_earth(frame(0, level(0, 0, 100)))
        store.update(maps.observations.to_crs(4326))
        assert store.elements().crs == "EPSG:25832"
        assert apart(store.elements(), maps.observations) < 0.001

    def test_of_data_in_degrees_is_centred_on_it_and_stays(self, tmp_path):
        store = MapStore(tmp_path / "map.gpkg", create=True)
        for number in range(2):
            (maps,) = on_earth(frame(number, level(0.1 * number, 0, 100)))
            store.update(maps.observations.to_crs(4326))
        elements = store.elements()
        assert elements.crs.is_projected
        assert elements["n_instances"].tolist() == [2]
        # Metres on the ground: UTM is 0.03 % too short here.
        assert elements["length_m"].tolist() == [pytest.approx(100, abs=0.1)]
        assert gpd.read_file(store.path, layer="elements").crs == store.crs
        assert store.verify() == []

    def test_that_is_local_stays_local(self, store):
        store.update(looks(level(0)), crs="local")
        assert store.elements().crs == LOCAL_CRS
        assert MapStore(store.path).crs == LOCAL_CRS

    @pytest.mark.parametrize("options", [{}, {"crs": "local"}], ids=["none", "local"])
    def test_on_earth_takes_nothing_without_a_place(self, tmp_path, options):
        store = MapStore(tmp_path / "map.gpkg", create=True)
        store.update(on_earth(frame(0, level(0, 0, 100))))
        before = dump(store)
        with pytest.raises(pm.CrsError):
            store.update(frame(1, level(0), crs=None), **options)
        assert dump(store) == before

    def test_that_is_local_takes_nothing_that_has_a_place(self, store):
        store.update(frame(0, level(0, 0, 100)))
        with pytest.raises(pm.CrsError, match="local"):
            store.update(on_earth(frame(1, level(0))))

    def test_that_is_not_true_to_scale_where_local_maps_are_is_refused(self, tmp_path):
        store = MapStore(tmp_path / "map.gpkg", create=True, crs="EPSG:3035")
        lisbon = looks(LineString([(-9.15, 38.7), (-9.149, 38.7)]), crs=4326)
        with pytest.raises(pm.CrsError, match="true to scale"):
            store.update(lisbon)
        assert not store.path.exists()

    def test_in_degrees_is_refused(self, tmp_path):
        with pytest.raises(pm.CrsError, match="metres"):
            MapStore(tmp_path / "map.gpkg", create=True, crs=4326)

    def test_of_three_axes_can_be_kept(self, tmp_path):
        store = MapStore(tmp_path / "map.gpkg", create=True)
        (maps,) = on_earth(frame(0, level(0, 0, 100)))
        store.update(maps.observations.set_crs(gpd.GeoSeries(crs=UTM).crs.to_3d(), allow_override=True))
        assert gpd.read_file(store.path, layer="elements").crs.to_2d() == UTM
        assert store.verify() == []


class TestOpening:
    def test_a_file_that_is_not_there(self, tmp_path):
        with pytest.raises(pm.InputError, match=r"none\.gpkg does not exist.*--create"):
            MapStore(tmp_path / "none.gpkg")

    @pytest.mark.parametrize("ask", ["elements", "history", "changes", "moves", "verify", "draw"])
    def test_asking_of_a_map_that_is_not_made_yet(self, store, ask):
        with pytest.raises(pm.InputError, match="does not exist yet"):
            getattr(store, ask)()
        assert not store.path.exists()

    def test_a_crs_that_nobody_knows_yet(self, tmp_path):
        with pytest.raises(pm.InputError, match="--crs"):
            _ = MapStore(tmp_path / "none.gpkg", create=True).crs

    def test_a_folder(self, tmp_path):
        with pytest.raises(pm.InputError, match="is a folder"):
            MapStore(tmp_path, create=True)

    def test_a_file_of_something_else(self, tmp_path):
        path = tmp_path / "map.gpkg"
        path.write_text("a letter to the mayor\n" * 100)
        with pytest.raises(pm.InputError, match="no GeoPackage"):
            MapStore(path, create=True)

    def test_a_geopackage_of_something_else(self, tmp_path):
        looks(level(0), crs=UTM).to_file(tmp_path / "map.gpkg")
        before = (tmp_path / "map.gpkg").read_bytes()
        with pytest.raises(pm.InputError, match="no stored map"):
            MapStore(tmp_path / "map.gpkg", create=True)
        assert (tmp_path / "map.gpkg").read_bytes() == before

    def test_a_map_of_a_later_version(self, fed):
        with contextlib.closing(sqlite3.connect(fed.path)) as connection, connection:
            connection.execute("UPDATE map_settings SET value = '2' WHERE name = 'format'")
        with pytest.raises(pm.InputError, match=r"later version.*update PolyMerge"):
            MapStore(fed.path)
        with pytest.raises(pm.InputError, match="later version"):
            fed.update(frame(0))

    @pytest.mark.parametrize("share", [0.05, 0.5, 0.9])
    def test_a_file_whose_copying_stopped(self, told, tmp_path, share):
        whole = told[0].path.read_bytes()
        path = tmp_path / "part.gpkg"
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(pm.InputError, match="damaged"):
            MapStore(path).verify()

    @pytest.mark.parametrize("option", [{"proximity": 2.0}, {"crs": "EPSG:3035"}, {"area": "island"}])
    def test_a_map_that_was_made_with_other_options(self, fed, option):
        with pytest.raises(pm.OptionError, match=f"leave {min(option)} away"):
            MapStore(fed.path, **option)

    def test_a_map_with_the_options_that_it_was_made_with(self, fed):
        again = MapStore(fed.path, create=True, proximity=1.0, crs=UTM, area="ped_crossing")
        assert len(again.elements()) == len(fed.elements())

    def test_an_empty_file_is_one_that_is_not_there(self, store):
        store.path.touch()
        store.update(frame(0, level(0, 0, 100)))
        assert len(MapStore(store.path).elements()) == 1


class TestHistory:
    def test_tells_the_map_of_every_revision(self, told):
        store, elements = told
        assert len(store.history()) == len(elements)
        for revision, expected in enumerate(elements, 1):
            assert_geodataframe_equal(store.elements(revision), expected)
            found = store.elements(revision).geometry
            assert shapely.to_wkb(found).tolist() == shapely.to_wkb(expected.geometry).tolist()

    def test_counts(self, told):
        store, elements = told
        history = store.history()
        assert history["number"].tolist() == list(range(1, len(elements) + 1))
        assert history["elements"].tolist() == [len(each) for each in elements]
        assert (history["n_instances"] == 1).all()
        balance = history["added"] - history["retired"] - history["merged"]
        assert balance.cumsum().tolist() == history["elements"].tolist()
        assert history["time"].is_monotonic_increasing
        assert history["software"].str.contains("shapely").all()

    @pytest.mark.parametrize("revision", [-1, 0, 21])
    def test_has_no_other_revisions(self, told, revision):
        with pytest.raises(pm.OptionError, match="it has 1 to 20"):
            told[0].elements(revision)

    def test_never_gives_an_id_twice(self, told):
        store, elements = told
        seen, gone = set(), set()
        for each in elements:
            now = set(each["element_id"])
            assert not now & gone
            gone |= seen - now
            # What is new comes after all that was.
            assert min(now - seen, default=10**9) > max(seen, default=0)
            seen |= now
        assert {old for (old,) in read(store, "SELECT old_id FROM id_aliases")} == gone

    def test_knows_where_every_id_went(self, told):
        store, elements = told
        now = set(store.elements()["element_id"])
        aliases = dict(read(store, "SELECT old_id, element_id FROM id_aliases"))
        ever = {number for each in elements for number in each["element_id"]}
        assert {aliases.get(number, number) for number in ever} <= now | {-1}

    def test_of_ids_that_became_one_is_followed_to_the_end(self, store):
        whole = box(-5, -5, 205, 5)
        store.update(frame(0, level(0, 0, 40), level(0, 60, 100), level(0, 130, 200), around=whole))
        assert len(store.elements()) == 3
        for number, (start, stop) in enumerate([(20, 80), (20, 80), (80, 160), (80, 160)], 1):
            store.update(frame(number, level(0, start, stop), around=box(start - 3, -5, stop + 3, 5)))
        aliases = dict(read(store, "SELECT old_id, element_id FROM id_aliases"))
        (element,) = store.elements()["element_id"]
        assert set(aliases.values()) == {element}
        assert element == 1
        assert store.verify() == []

    def test_since_a_revision_is_the_difference_of_two_maps(self, told):
        store, elements = told
        for since in (0, 1, 7, 19, 20):
            changes = store.changes(since).set_index("element_id")
            before = (
                elements[since - 1].set_index("element_id") if since else elements[0].set_index("element_id").iloc[:0]
            )
            after = elements[-1].set_index("element_id")
            kinds = changes["kind"]
            assert set(kinds.index[kinds == "added"]) == set(after.index) - set(before.index)
            gone = set(kinds.index[kinds.isin(["retired", "merged"])])
            assert gone == set(before.index) - set(after.index)
            same = [
                number
                for number in set(before.index) & set(after.index)
                if shapely.to_wkb(before.geometry[number]) == shapely.to_wkb(after.geometry[number])
                and before.drop(columns="geometry").loc[number].equals(after.drop(columns="geometry").loc[number])
            ]
            assert not [number for number in set(after.index) - set(same) if number not in changes.index]
            assert (changes["revision"] > since).all()
            assert changes.index.is_unique

    def test_tells_by_how_much_an_element_moved(self, store):
        store.update(frame(0, level(0, 0, 100)))
        store.update(frame(1, level(0.4, 0, 100)))
        (change,) = store.changes(1).to_dict("records")
        assert change["element_id"] == 1
        assert change["moved_m"] == pytest.approx(0.2, abs=0.01)
        assert store.changes(2).empty

    def test_says_nothing_of_what_came_and_went(self, store):
        store.update(frame(0, level(20, 0, 100)))
        store.update(frame(1, level(0, 0, 100)))
        for number in range(2, 16):
            store.update(frame(number, level(20, 0, 100)), draw=False)
        store.draw()
        gone = {old for (old,) in read(store, "SELECT old_id FROM id_aliases WHERE element_id = -1")}
        assert gone == {2}
        assert store.changes(1)["element_id"].tolist() == [1]
        assert store.changes(2)["kind"].to_dict() == {0: "changed", 1: "retired"}
        assert store.changes(0)["kind"].tolist() == ["added"]
        assert store.verify() == []

    def test_moves_are_in_the_crs_of_the_map(self, told):
        moves = told[0].moves()
        assert moves.columns.tolist() == ["element_id", "moved_m", "geometry"]
        assert moves.crs == told[0].crs

    @pytest.mark.parametrize(
        ("old", "new", "expected"),
        [
            (LineString(level(0)), LineString(level(3)), 3),
            (LineString(level(0)), LineString(level(0, 10, 30)), 0),
            (box(0, 0, 4, 4), box(0, 0, 4, 4), 0),
            (box(0, 0, 40, 4), box(0, 1, 40, 5), 1),
        ],
    )
    def test_measures_moves_across_lines(self, old, new, expected):
        assert displacement(old, new) == pytest.approx(expected)


class TestLineage:
    def test_covers_every_observation_once(self, told):
        store, _ = told
        assert store.verify() == []
        tables = pd.concat(
            pyogrio.read_dataframe(store.path, layer=name)[["observation_fid", "from_m", "to_m"]]
            for name in ("lineage", "left_out")
        ).dropna()
        seen = gpd.read_file(store.path, layer="observations", fid_as_index=True)
        total = (tables["to_m"] - tables["from_m"]).groupby(tables["observation_fid"]).sum()
        np.testing.assert_allclose(total.reindex(seen.index), seen["to_m"] - seen["from_m"], atol=1e-6)
        ordered = tables.sort_values(["observation_fid", "from_m"])
        follows = ordered["observation_fid"].diff() == 0
        gap = ordered["from_m"] - ordered["to_m"].shift()
        np.testing.assert_allclose(gap[follows], 0, atol=1e-6)

    def test_names_the_features_of_the_source(self, store):
        store.update(frame(0, level(0, 0, 100), level(10, 0, 100), drive="monday"))
        rows = read(
            store, "SELECT source, source_fid, drive, instance, element_id, from_m, to_m FROM lineage ORDER BY 2"
        )
        ids = [row[4] for row in rows]
        assert sorted(ids) == [1, 2]
        expected = [("monday", str(n), "monday", "0", ids[n], 0, pytest.approx(100)) for n in range(2)]
        assert rows == expected


FIRST = "fid = (SELECT MIN(fid) FROM lineage)"
DAMAGE = {
    "a row of lineage is lost": f"DELETE FROM lineage WHERE {FIRST}",
    "a row of lineage is there twice": (
        "INSERT INTO lineage (element_id, observation_fid, from_m, to_m) "
        "SELECT element_id, observation_fid, from_m, to_m FROM lineage LIMIT 1"
    ),
    "lineage of an element that is not there": f"UPDATE lineage SET element_id = 999 WHERE {FIRST}",
    "lineage of an observation that is not there": f"UPDATE lineage SET observation_fid = 9999 WHERE {FIRST}",
    "an interval is shorter": f"UPDATE lineage SET to_m = to_m - 0.01 WHERE {FIRST}",
    "an observation is lost": "DELETE FROM observations WHERE fid = 3",
    "an observation of a local map that is not there": "UPDATE observations SET instance_fid = 999 WHERE fid = 3",
    "a local map is lost": "DELETE FROM instances WHERE fid = 3",
    "a local map of a revision that is not there": "UPDATE instances SET revision = 999 WHERE fid = 3",
    "a local map that counts wrongly": "UPDATE instances SET n_observations = n_observations + 1 WHERE fid = 3",
    "a revision is lost": "DELETE FROM revisions WHERE number = 3",
    "an element is lost": "DELETE FROM elements WHERE element_id = (SELECT MIN(element_id) FROM elements)",
    "an element is there twice": (
        "INSERT INTO elements (geom, class, n_observations) SELECT geom, class, n_observations FROM elements LIMIT 1"
    ),
    "an element lies elsewhere": (
        "UPDATE elements SET geom = (SELECT geom FROM observations LIMIT 1) "
        "WHERE element_id = (SELECT MIN(element_id) FROM elements)"
    ),
    "an element is nowhere": (
        "UPDATE elements SET geom = NULL WHERE element_id = (SELECT MIN(element_id) FROM elements)"
    ),
    "an element of another score": "UPDATE elements SET score = 0.123",
    "an element of another class": "UPDATE elements SET class = 'divided' WHERE class = 'divider'",
    "an element that counts wrongly": "UPDATE elements SET n_observations = n_observations + 1",
    "an element that counts local maps wrongly": "UPDATE elements SET n_instances = n_instances + 1",
    "a change is lost": "DELETE FROM changes WHERE fid = (SELECT MAX(fid) FROM changes)",
    "a change of a revision that is not there": "UPDATE changes SET revision = 999 WHERE fid = 1",
    "an alias of an element that is not there": (
        "INSERT INTO id_aliases (old_id, element_id, revision) VALUES (998, 999, 1)"
    ),
    "an alias of an id that is still there": (
        "INSERT INTO id_aliases (old_id, element_id, revision) SELECT element_id, -1, 1 FROM elements LIMIT 1"
    ),
    **{
        what.format(layer): query.format(layer)
        for layer in LAYERS[:4]
        for what, query in {
            "the count of {0} is wrong": "UPDATE gpkg_ogr_contents SET feature_count = 0 WHERE table_name = '{0}'",
            "the count of {0} is lost": "DELETE FROM gpkg_ogr_contents WHERE table_name = '{0}'",
            "a row of the spatial index of {0} is lost": (
                "DELETE FROM rtree_{0}_geom WHERE id = (SELECT MAX(id) FROM rtree_{0}_geom)"
            ),
            "a box of the spatial index of {0} is wrong": "UPDATE rtree_{0}_geom SET maxx = maxx + 5",
            "the spatial index of {0} is lost": "DROP TABLE rtree_{0}_geom",
            "the bounds of {0} are too small": "UPDATE gpkg_contents SET max_x = max_x - 9 WHERE table_name = '{0}'",
        }.items()
    },
    "the count of revisions is wrong": "UPDATE gpkg_ogr_contents SET feature_count = 0 WHERE table_name = 'revisions'",
    "the bounds of the elements are not known": "UPDATE gpkg_contents SET min_y = NULL WHERE table_name = 'elements'",
    "a table is lost": "DROP TABLE id_aliases",
    "a layer is lost": "DROP TABLE renewed",
    "a layer is not registered": "DELETE FROM gpkg_contents WHERE table_name = 'observations'",
}


class TestVerifying:
    def test_finds_nothing_wrong_with_a_map_that_is_whole(self, fed):
        assert fed.verify() == []

    @pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
    def test_finds(self, fed, damage):
        with contextlib.closing(sqlite3.connect(fed.path)) as connection, connection:
            # The triggers of the spatial index, that GDAL brings along.
            for name in ("ST_MinX", "ST_MaxX", "ST_MinY", "ST_MaxY"):
                at = ("ST_MinX", "ST_MaxX", "ST_MinY", "ST_MaxY").index(name)
                connection.create_function(
                    name, 1, lambda blob, at=at: np.frombuffer(blob, "<f8", 4, 8)[at], deterministic=True
                )
            connection.create_function("ST_IsEmpty", 1, lambda blob: None if blob is None else 0, deterministic=True)
            done = connection.execute(damage)
            assert done.rowcount != 0
        found = fed.verify()
        assert found
        assert all(isinstance(text, str) and text for text in found)

    def test_does_not_mind_what_others_keep_in_the_file(self, fed):
        looks(level(0), crs=UTM).to_file(fed.path, layer="notes", mode="a")
        assert fed.verify() == []


class TestDenied:
    def test_what_the_evidence_denies_is_in_no_element_and_is_listed(self, store, monkeypatch):
        def judged(elements, *_args):
            far = elements.geometry.centroid.y.to_numpy() > 5
            return Judgement(np.where(far, DENIED - 0.1, DENIED), [])

        monkeypatch.setattr("polymerge_core.store.redraw.judge_elements", judged)
        update = store.update([frame(number, level(0, 0, 100), level(10, 0, 100)) for number in range(2)])
        assert (update.added, len(store.elements())) == (1, 1)
        assert read(store, "SELECT DISTINCT element_id FROM lineage") == [(1,)]
        rows = read(store, "SELECT reason, COUNT(*) FROM left_out GROUP BY reason")
        assert rows == [("seen by too few of the local maps that looked there", 2)]
        assert store.verify() == []


class TestEditedByHand:
    def test_a_geometry_that_was_cleared_is_none_and_verify_says_so(self, store):
        """As an attribute form of QGIS leaves it."""
        store.update(frame(0, level(0, 0, 100), level(10, 0, 100)))
        with contextlib.closing(connect(store.path, 1.0)) as connection:
            connection.execute("UPDATE elements SET geom = NULL WHERE element_id = 1")
        assert store.elements().geometry.isna().tolist() == [True, False]
        assert any("not as their last change says" in fault for fault in store.verify())
        store.update(frame(1, level(0.1, 0, 100), level(10.1, 0, 100)))
        assert store.elements().geometry.notna().all()


class TestUndo:
    def test_takes_a_local_map_back_as_if_it_had_never_come(self, tmp_path):
        """What remains is what the others alone draw, wherever they looked."""
        frames = [
            frame(0, level(0, 0, 100), level(10, 0, 100)),
            frame(1, level(0.3, 0, 100), level(10.2, 0, 100)),
            frame(2, level(0.6, 0, 100), level(40, 0, 100), around=box(-5, -10, 105, 50)),
        ]
        fed, without = (pm.MapStore(tmp_path / name, create=True, crs=LOCAL_CRS) for name in ("all.gpkg", "some.gpkg"))
        for each in frames:
            fed.update(each)
        for each in (frames[0], frames[1]):
            without.update(each)
        done = fed.undo(3)
        assert (done.revision, done.retired) == (4, 1)
        for name in ("n_observations", "n_instances", "class", "state"):
            assert fed.elements()[name].tolist() == without.elements()[name].tolist()
        one, other = fed.elements().geometry, without.elements().geometry
        assert shapely.hausdorff_distance(one.to_numpy(), other.to_numpy()).max() < 1e-6
        assert fed.verify() == []
        history = fed.history()
        assert history["source"].iloc[-1] == "undo of revision 3"
        assert history["undone"].fillna(0).tolist() == [0, 0, 4, 0]

    def test_leaves_the_history_and_lets_it_come_again(self, store):
        for number in range(2):
            store.update(frame(number, level(0.2 * number, 0, 100), level(10, 0, 100)))
        before = [store.elements(number) for number in (1, 2)]
        store.undo(2)
        for number, elements in enumerate(before, 1):
            pd.testing.assert_frame_equal(pd.DataFrame(store.elements(number)), pd.DataFrame(elements))
        pd.testing.assert_frame_equal(
            pd.DataFrame(store.elements()).drop(columns="evidence"), pd.DataFrame(before[0]).drop(columns="evidence")
        )
        assert store.update(frame(1, level(0.2, 0, 100), level(10, 0, 100))).skipped == 0
        again = store.elements()
        assert shapely.hausdorff_distance(again.geometry.to_numpy(), before[1].geometry.to_numpy()).max() < 1e-6
        assert store.verify() == []

    def test_of_all_leaves_an_empty_map(self, store):
        for number in range(3):
            store.update(frame(number, level(0, 0, 100)), draw=number == 1)
        done = store.undo(1, 3)
        assert (done.elements, len(store.elements())) == (0, 0)
        assert store.draw() is None
        assert store.verify() == []

    def test_draws_what_waits(self, store):
        store.update(frame(0, level(0, 0, 100)))
        store.update(frame(1, level(20, 0, 100)), draw=False)
        store.undo(1)
        assert [round(shape.centroid.y) for shape in store.elements().geometry] == [20]
        assert store.verify() == []

    def test_says_so_where_there_is_nothing_to_take_back(self, store):
        store.update(frame(0, level(0, 0, 100)), draw=False)
        store.draw()
        with pytest.raises(pm.OptionError, match="no revision 7; it has 1 to 2"):
            store.undo(7)
        with pytest.raises(pm.OptionError, match="brought no local maps"):
            store.undo(2)
        store.undo(1)
        with pytest.raises(pm.OptionError, match="taken back already"):
            store.undo(1)
        assert store.verify() == []


class TestFailing:
    @pytest.fixture
    def broken(self, monkeypatch):
        """Return a way to let a step of an update fail."""

        def let_fail(where, error):
            def fail(*_args, **_kwargs):
                raise error

            monkeypatch.setattr(where, fail)

        return let_fail

    STEPS = (
        "polymerge_core.store.map_store.read_evidence",
        "polymerge_core.store.map_store.add",
        "polymerge_core.store.map_store.place_of",
        "polymerge_core.store.merging.merge",
        "polymerge_core.store.shapes.put_together",
        "polymerge_core.store.redraw.count_looks",
        "polymerge_core.store.element_table._note",
        "polymerge_core.store.map_store.software",
    )

    @pytest.mark.parametrize(
        "error",
        [RuntimeError("no luck"), KeyboardInterrupt(), sqlite3.OperationalError("no luck")],
        ids=lambda error: type(error).__name__,
    )
    @pytest.mark.parametrize("step", STEPS)
    def test_leaves_the_map_as_it_was(self, store, broken, monkeypatch, step, error):
        store.update(frame(0, level(0, 0, 100), level(10, 0, 100)))
        before, content = dump(store), store.path.read_bytes()
        with monkeypatch.context():
            broken(step, error)
            expected = pm.OutputError if isinstance(error, sqlite3.Error) else type(error)
            with pytest.raises(expected):
                store.update(frame(1, level(0.3, 0, 100)))
        assert dump(store) == before
        assert store.path.read_bytes() == content
        assert [path.name for path in store.path.parent.iterdir()] == [store.path.name]

    @pytest.mark.parametrize("step", STEPS)
    def test_leaves_no_file_of_a_map_that_was_not_made(self, store, broken, step):
        broken(step, RuntimeError("no luck"))
        with pytest.raises(RuntimeError):
            store.update(frame(0, level(0, 0, 100)))
        assert list(store.path.parent.iterdir()) == []

    def test_can_be_tried_again(self, store, broken, monkeypatch):
        with monkeypatch.context() as context:
            context.setattr(shapes, "put_together", lambda *_args: 1 / 0)
            with pytest.raises(ZeroDivisionError):
                store.update(frame(0, level(0, 0, 100)))
        assert store.update(frame(0, level(0, 0, 100))).revision == 1
        assert store.verify() == []

    def test_says_so_where_another_program_writes(self, store, monkeypatch):
        store.update(frame(0, level(0, 0, 100)))
        monkeypatch.setattr("polymerge_core.store.map_file.connect", lambda path, _patience: connect(path, 0.01))
        with contextlib.closing(sqlite3.connect(store.path, isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            with pytest.raises(pm.OutputError, match=r"locked by another program.*as it was"):
                store.update(frame(1, level(0, 0, 100)))
            # Reading goes on.
            assert len(store.elements()) == 1

    def test_says_so_where_the_file_cannot_be_written(self, store, monkeypatch):
        store.update(frame(0, level(0, 0, 100)))
        # As of a file without permission, which root has all the same.
        monkeypatch.setattr("polymerge_core.store.map_file.connect", read_only)
        with pytest.raises(pm.OutputError, match="cannot be written"):
            store.update(frame(1, level(0, 0, 100)))

    def test_says_so_where_the_folder_is_not_there(self, tmp_path):
        store = MapStore(tmp_path / "no" / "map.gpkg", create=True)
        with pytest.raises(pm.OutputError, match="cannot be opened; check the folder"):
            store.update(frame(0, level(0)))


class TestOtherPrograms:
    def test_see_all_layers(self, told):
        store, _ = told
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            layers = {name: gpd.read_file(store.path, layer=name) for name in LAYERS}
            tables = {name: pyogrio.read_dataframe(store.path, layer=name) for name in TABLES}
        assert [name for name, _ in pyogrio.list_layers(store.path)] == [*LAYERS, *TABLES]
        assert all(layer.crs == store.crs for layer in layers.values())
        assert not any(isinstance(table, gpd.GeoDataFrame) for table in tables.values())
        counts = {name: len(held) for name, held in (layers | tables).items()}
        assert counts == dict(read(store, "SELECT table_name, feature_count FROM gpkg_ogr_contents"))

    def test_see_the_map(self, told):
        store, _ = told
        seen = gpd.read_file(store.path, layer="elements", fid_as_index=True)
        expected = store.elements().set_index("element_id")
        assert seen.index.tolist() == expected.index.tolist()
        assert shapely.to_wkb(seen.geometry).tolist() == shapely.to_wkb(expected.geometry).tolist()
        assert seen["first_seen"].dtype.kind == "M"
        assert_frame_equal(
            pd.DataFrame(seen[["class", "score", "n_instances"]]),
            pd.DataFrame(expected[["class", "score", "n_instances"]]),
            check_dtype=False,
            check_names=False,
        )

    @pytest.mark.parametrize("named", ["", "|layername=elements"])
    def test_may_merge_into_it_and_ids_stay(self, told, drive, named):
        store, _ = told
        (main,) = pm.read_local_maps([f"{store.path}{named}"])
        assert main.observations["element_id"].tolist() == store.elements()["element_id"].tolist()
        again = pm.merge(some(drive, np.arange(3)), main)
        there = {*again.elements["element_id"], *again.id_aliases["old_id"]}
        assert set(store.elements()["element_id"]) <= there
        # None of those that are no more is given again.
        new = set(again.elements["element_id"]) - set(store.elements()["element_id"])
        assert min(new, default=10**9) > max(store.elements()["element_id"])

    def test_may_append_and_the_spatial_index_follows(self, fed):
        more = gpd.read_file(fed.path, layer="elements").iloc[:1].to_crs(fed.crs)
        more = more.set_geometry(more.geometry.translate(900, 0)).assign(element_id=9999)
        pyogrio.write_dataframe(more, fed.path, layer="elements", append=True)
        found = fed.verify()
        assert found
        # That it came of no observation is all that is wrong with it.
        assert not [text for text in found if "index" in text or "counts" in text or "bounds" in text]

    def test_that_read_do_not_change_the_file(self, fed):
        before = fed.path.read_bytes()
        for name in LAYERS:
            gpd.read_file(fed.path, layer=name)
        fed.elements(), fed.history(), fed.changes(3), fed.moves(3), fed.verify()
        assert fed.path.read_bytes() == before
