"""The consensus merged into a main map: what becomes of its elements, their ids, scores and places."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from geopandas.testing import assert_geodataframe_equal
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import LineString, MultiLineString, box

import polymerge_core as pm
from benchmarks.scenarios import town, town_road
from tests.core.test_consensus import CENTIMETRE, apart, drawn, level, local_maps, looks, merge
from tests.core.test_consensus_state import distances, some

SEEDS = st.integers(0, 10_000)


def stored(*shapes, **columns):
    """Make a map as somebody drew it: no counts, no scores."""
    ids = columns.pop("element_id", np.arange(1, len(shapes) + 1))
    return looks(*shapes, **columns).drop(columns=["drive", "instance"]).assign(element_id=ids)


def nothing(crs=None):
    return looks(level(0), crs=crs).iloc[:0]


def frames(count, *shapes, around, first=0):
    """Look at shapes from `count` local maps, all of which look at the area `around`; each look 1 cm off the last."""
    seen = [(np.add(shape, [0, 0.01 * n]), n) for n in range(count) for shape in shapes]
    layer = looks(*(shape for shape, _ in seen), instance=[n + first for _, n in seen])
    names = np.arange(first, first + count)
    columns = {"drive": "a", "instance": names, "timestamp_ns": names, "x": 50.0, "y": 0.0, "heading": 90.0}
    return pm.LocalMaps(layer, gpd.GeoDataFrame(columns, geometry=[around] * count, crs=layer.crs), source="drive")


def by_id(result):
    return result.elements.set_index("element_id")


def intervals(table, fid, source="main_map"):
    """Return the intervals of one feature in a table, rounded to metres."""
    rows = table[(table["source"] == source) & (table["source_fid"] == fid)].sort_values("from_m")
    return rows[["from_m", "to_m"]].round().to_numpy().tolist()


class TestIds:
    def test_stay_where_an_element_was_seen_again_and_where_it_was_not(self):
        result = merge(looks(level(0.2), level(0.1)), main_map=stored(level(0), level(20), element_id=[7, 3]))
        assert result.elements["element_id"].tolist() == [3, 7]
        assert by_id(result)["n_observations"].to_dict() == {3: 1, 7: 3}
        assert result.id_aliases.empty

    def test_of_those_that_become_one_the_smallest_wins_and_the_others_are_aliases(self):
        main = stored(level(0, 0, 40), level(0, 44, 90), level(0, 94, 130), element_id=[7, 3, 9])
        result = merge(looks(level(0.1, 20, 110), level(-0.1, 20, 110)), main_map=main)
        assert result.elements["element_id"].tolist() == [3]
        assert result.id_aliases.to_dict("list") == {"old_id": [7, 9], "element_id": [3, 3]}
        assert set(result.lineage["element_id"]) == {3}

    def test_of_what_is_new_follow_in_canonical_order(self):
        main = stored(level(500), element_id=[41], cls="line")
        result = merge(looks(level(50), level(0), level(100), **{"class": ["b", "b", "a"]}), main_map=main)
        assert result.elements["element_id"].tolist() == [41, 42, 43, 44]
        assert result.elements["class"].tolist() == ["line", "a", "b", "b"]
        keys = shapely.to_wkb(shapely.normalize(result.elements.geometry.to_numpy()[2:]))
        assert keys[0] < keys[1]

    def test_of_an_element_that_was_cut_in_two_stays_with_the_longest_and_lineage_tells(self):
        # The middle of element 7 was looked at by twelve local maps, which saw element 3 alone.
        main = stored(level(0, 0, 100), level(20, 0, 100), element_id=[7, 3])
        result = merge(frames(12, level(20, 32, 62), around=box(32, -10, 62, 30)), main_map=main)
        elements = by_id(result)
        assert sorted(elements.index) == [3, 7, 8]
        assert elements.loc[7, "length_m"] == pytest.approx(38, abs=2)
        assert elements.loc[8, "length_m"] == pytest.approx(32, abs=2)
        of_seven = result.lineage[(result.lineage["source"] == "main_map") & (result.lineage["source_fid"] == 0)]
        assert of_seven.set_index("element_id")["from_m"].round().to_dict() == {7: pytest.approx(62, abs=2), 8: 0}
        assert result.id_aliases.empty
        # What is left of it lies where it lay.
        assert shapely.distance(shapely.union_all(elements.loc[[7, 8]].geometry), LineString(level(0, 0, 100))) == 0

    def test_of_a_multipart_element_stays_with_the_longest_part(self):
        main = stored(MultiLineString([level(0, 0, 10), level(50, 0, 60)]), element_id=[5])
        result = merge(nothing(), main_map=main)
        assert by_id(result)["length_m"].to_dict() == {5: pytest.approx(60), 6: pytest.approx(10)}

    def test_of_what_was_left_out_are_on_record_and_never_given_again(self):
        main = stored(level(0, 0, 100), level(20, 0, 100), element_id=[9, 3])
        gone = merge(frames(12, level(20, 0, 100), around=box(-5, -10, 105, 30)), main_map=main)
        assert gone.elements["element_id"].tolist() == [3]
        assert gone.id_aliases.to_dict("list") == {"old_id": [9], "element_id": [-1]}
        later = merge(looks(level(80)), main_map=gone.as_main_map())
        assert later.elements["element_id"].tolist() == [3, 10]
        assert later.id_aliases.to_dict("list") == {"old_id": [9], "element_id": [-1]}

    def test_that_are_aliases_follow_an_element_that_is_left_out(self):
        main = pm.LocalMaps(
            stored(level(0, 0, 100), level(20, 0, 100), element_id=[9, 3]),
            id_aliases=pd.DataFrame({"old_id": [12], "element_id": [9]}),
        )
        result = merge(frames(12, level(20, 0, 100), around=box(-5, -10, 105, 30)), main_map=main)
        assert result.id_aliases.to_dict("list") == {"old_id": [9, 12], "element_id": [-1, -1]}


class TestNothingNew:
    @pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:4326", "EPSG:3857"])
    def test_leaves_a_map_that_was_merged_as_it_was(self, crs):
        first = pm.merge(town(1).local, method="consensus", out_crs=crs).elements
        again = pm.merge(nothing(crs), main_map=first, method="consensus")
        # Metres of the UTM zone, and of where the data lies: 0.04 % apart.
        assert again.elements["length_m"].to_numpy() == pytest.approx(first["length_m"].to_numpy(), rel=5e-4)
        assert_geodataframe_equal(again.elements.drop(columns="length_m"), first.drop(columns="length_m"))
        assert shapely.to_wkb(again.elements.geometry).tolist() == shapely.to_wkb(first.geometry).tolist()
        assert len(again.id_aliases) == len(again.left_out) == 0

    def test_leaves_a_map_that_somebody_drew_as_it_was(self):
        rng = np.random.default_rng(2)
        shapes = [np.cumsum(rng.normal(0, 4, (12, 2)), axis=0) for _ in range(12)]
        # One on the other, end to end, and closer to each other than the proximity.
        shapes += [level(0), level(0), level(0.4), level(0, 40, 80), [(90, 90), (99, 90), (99, 99), (90, 90)]]
        main = stored(*shapes, element_id=rng.permutation(len(shapes)) + 40, lanes=range(len(shapes)))
        result = merge(nothing(), main_map=main)
        expected = main.sort_values("element_id").reset_index(drop=True)
        assert shapely.to_wkb(result.elements.geometry).tolist() == shapely.to_wkb(expected.geometry).tolist()
        assert result.elements["lanes"].tolist() == expected["lanes"].tolist()
        assert (result.elements["score"] == 1).all()
        assert result.elements["length_m"].to_numpy() == pytest.approx(expected.length.to_numpy())

    def test_but_elsewhere_leaves_it_as_it_was(self):
        local = town(2).local
        first = pm.merge(local, method="consensus").elements
        away = local[0].observations.translate(5000, 0)
        moved = local[0].instances.translate(5000, 0)
        far = pm.LocalMaps(local[0].observations.set_geometry(away), local[0].instances.set_geometry(moved))
        far.instances["x"] += 5000
        again = pm.merge(far, main_map=first, method="consensus").elements
        here = again[again["element_id"].isin(first["element_id"])].reset_index(drop=True)
        assert_geodataframe_equal(here, first)
        assert again["element_id"].is_unique

    def test_seen_by_local_maps_leaves_it_as_it_was(self):
        main = stored(level(0), level(20))
        result = merge(local_maps(nothing(), [box(-5, -5, 45, 30)] * 9), main_map=main)
        assert apart(result.elements, main) == 0
        assert result.elements["element_id"].tolist() == [1, 2]


class TestLeavingOut:
    def test_nothing_of_the_map_without_footprints(self):
        main = stored(level(0), level(20))
        result = merge(looks(*(level(20 + 0.02 * n) for n in range(30))), main_map=main)
        assert result.elements["element_id"].tolist() == [1, 2]
        assert result.left_out.empty

    def test_nothing_that_nobody_looked_at(self):
        main = stored(level(0), level(40))
        result = merge(frames(30, level(0), around=box(-5, -10, 45, 10)), main_map=main)
        assert result.elements["element_id"].tolist() == [1, 2]
        assert apart(result.elements.iloc[[1]], main.iloc[[1]]) == 0

    @pytest.mark.parametrize(("count", "stays"), [(3, True), (6, True), (12, False)])
    def test_what_many_looked_at_and_did_not_see(self, count, stays):
        # Of an element without a count nobody knows how often it was seen: three times is taken for granted.
        main = stored(level(0), level(20))
        result = merge(frames(count, level(20), around=box(-5, -10, 45, 30)), main_map=main)
        assert (1 in by_id(result).index) == stays
        if not stays:
            (row,) = result.left_out.to_dict("records")
            assert (row["source"], row["source_fid"], row["from_m"], row["to_m"]) == ("main_map", 0, 0, 40)
            assert "seen by too few" in row["reason"]
            assert result.report["left_out"] == {row["reason"]: 1}

    def test_what_many_saw_takes_many_more(self):
        main = stored(level(0), level(20), n_observations=30, n_instances=30)
        result = merge(frames(12, level(20), around=box(-5, -10, 45, 30)), main_map=main)
        assert result.elements["element_id"].tolist() == [1, 2]

    def test_a_crossing_that_is_no_more(self):
        square = box(0, 0, 10, 4)
        main = pd.concat([stored(square, cls="ped_crossing"), stored(level(20), element_id=[2])], ignore_index=True)
        other = [np.array(box(20, 0, 30, 4).exterior.coords)] * 12
        seen = looks(*other, cls="ped_crossing", instance=range(12))
        lines = looks(*(level(20 + 0.01 * n) for n in range(12)))
        around = [box(-15, -20, 55, 40)] * 12
        result = merge(local_maps(pd.concat([seen, lines], ignore_index=True), around), main_map=main)
        assert result.elements["element_id"].tolist() == [2, 3]
        assert intervals(result.left_out, 0) == [[0, 28]]

    def test_strict_does_not_mind(self):
        main = stored(level(0), level(20))
        new = frames(12, level(20), around=box(-5, -10, 45, 30))
        assert len(merge(new, main_map=main, strict=True).left_out) == 1


class TestScores:
    def test_of_an_element_that_nobody_looked_at_stay(self):
        main = stored(level(0), level(40), score=[0.3, 0.7])
        result = merge(frames(5, level(0), around=box(-5, -10, 45, 10)), main_map=main)
        assert by_id(result).loc[2, "score"] == 0.7

    def test_sink_where_local_maps_looked_and_saw_nothing(self):
        main = stored(level(0), level(20), score=0.8, n_instances=20, n_observations=20)
        result = merge(frames(10, level(20), around=box(-5, -10, 45, 30)), main_map=main)
        # Ten of thirty did not see it; how likely each was to see it is learned, and not quite certain.
        assert by_id(result).loc[1, "score"] == pytest.approx(0.8 * 20 / 30, abs=0.03)
        assert by_id(result).loc[2, "score"] > 0.8

    def test_are_nearly_what_all_at_once_would_give(self):
        local = town(3).local[0]
        half = len(local.instances) // 2
        first, second = some(local, np.arange(half)), some(local, np.arange(half, 2 * half))
        once = pm.merge(local, method="consensus").elements
        turn = pm.merge(second, pm.merge(first, method="consensus").as_main_map(), method="consensus").elements
        assert turn["score"].median() == pytest.approx(once["score"].median(), abs=0.06)

    def test_are_means_where_footprints_are_not_known(self):
        main = stored(level(0), score=0.8, n_observations=2)
        result = merge(looks(level(0.1), level(-0.1), score=[0.4, 0.4]), main_map=main)
        assert result.elements["score"].tolist() == [pytest.approx(0.6)]


class TestPlaces:
    def test_a_map_of_many_looks_is_moved_little_by_one(self):
        main = stored(level(0), n_observations=15, n_instances=15)
        (line,) = merge(looks(level(0.8)), main_map=main).elements.geometry
        assert shapely.hausdorff_distance(line, LineString(level(0))) < 0.15

    def test_many_looks_outvote_a_map_of_one(self):
        main = stored(level(0), n_observations=1, n_instances=1)
        new = looks(*(level(0.8 + 0.01 * n) for n in range(12)))
        (line,) = merge(new, main_map=main).elements.geometry
        assert shapely.hausdorff_distance(line, LineString(level(0.85))) < 0.45

    def test_a_map_counts_for_the_surveys_behind_it(self):
        # Three surveys of one look each, then a fourth one: it is no more than one of four, and its pose is corrected.
        names = {"drive": "fourth", "instance": 0}
        result = merge(looks(level(0.8), **names), main_map=stored(level(0), n_observations=3, n_instances=3))
        (line,) = result.elements.geometry
        assert shapely.get_coordinates(line)[:, 1].mean() == pytest.approx(0.15, abs=0.07)

    def test_elements_that_lie_side_by_side_stay_two(self):
        main = stored(level(0), level(0.4))
        new = looks(level(0), level(0.4), level(0.02), level(0.42), instance=[0, 0, 1, 1])
        result = merge(new, main_map=main)
        assert by_id(result)["n_observations"].to_dict() == {1: 3, 2: 3}
        assert apart(result.elements, main) < 0.1

    def test_crossings_keep_their_corners_and_ids(self):
        main = stored(box(0, 0, 10, 4), box(0, 8, 10, 12), cls="ped_crossing", n_observations=10, n_instances=10)
        seen = looks(box(0.2, 0, 10.2, 4), box(0.1, 8.1, 10.1, 12.1), cls="ped_crossing", instance=[0, 0])
        result = merge(seen, main_map=main)
        assert by_id(result)["n_observations"].to_dict() == {1: 11, 2: 11}
        assert [len(shape.exterior.coords) for shape in result.elements.geometry] == [5, 5]
        assert apart(result.elements, main) < 0.05

    def test_lines_and_areas_of_the_map_may_come_as_two_layers(self):
        lines, areas = stored(level(20), element_id=[4]), stored(box(0, 0, 10, 4), cls="ped_crossing", element_id=[2])
        seen = pd.concat([looks(level(20.2)), looks(box(0, 0.1, 10, 4.1), cls="ped_crossing")], ignore_index=True)
        result = merge(seen, main_map=[lines, areas])
        assert by_id(result)["n_observations"].to_dict() == {2: 2, 4: 2}

    def test_the_report_tells_how_far_local_maps_were_moved_not_the_map(self):
        main = stored(level(0), level(10))
        assert merge(nothing(), main_map=main).report["corrections"]["shift_m_max"] == 0.0

    def test_columns_are_the_maps(self):
        main = stored(level(0, 5, 30), level(50), name=["map", "alone"])
        result = merge(looks(level(0.2), level(0.1), name=["look", "look"]), main_map=main)
        assert by_id(result)["name"].to_dict() == {1: "map", 2: "alone"}
        assert result.elements["sigma_m"].notna().all()


def test_one_half_and_then_the_other_give_nearly_what_both_give():
    apart_m, lateral = [], {"divider": [], "boundary": []}
    for seed in (2, 3, 4, 5):
        scenario = town(seed)
        (local,) = scenario.local
        half = len(local.instances) // 2
        first, second = some(local, np.arange(half)), some(local, np.arange(half, 2 * half))
        once = pm.merge(local, method="consensus").elements
        turn = pm.merge(second, pm.merge(first, method="consensus").as_main_map(), method="consensus").elements
        apart_m.append(np.median(distances(once, turn)))
        at_once, in_turn = (pm.evaluate(each, scenario.truth, local_maps=scenario.local) for each in (once, turn))
        for name, found in lateral.items():
            found.append([each.value(name, "lateral_median") for each in (at_once, in_turn)])
            assert in_turn.value(name, "duplication") < 1.25
    assert max(apart_m) <= 0.1
    # By how much one drive's half shifts the map of the other is chance: the mean over drives tells.
    for found in lateral.values():
        once, turn = np.mean(found, axis=0)
        assert turn < 1.3 * once


def test_four_drives_in_turn_are_drawn_once_and_no_worse_than_the_first():
    drives = [town_road().drive(f"d{number}", seed=100 + number, count=20) for number in range(4)]
    result = pm.merge(drives[0].local, method="consensus")
    first = pm.evaluate(result.elements, drives[0].truth, local_maps=drives[0].local)
    for drive in drives[1:]:
        before = set(result.elements["element_id"]) | set(result.id_aliases["old_id"])
        result = pm.merge(drive.local, result.as_main_map(), method="consensus")
        after = set(result.elements["element_id"]) | set(result.id_aliases["old_id"])
        assert before <= after
        assert result.elements["element_id"].is_unique
    last = pm.evaluate(result.elements, drives[0].truth, local_maps=[drive.local[0] for drive in drives])
    for name in ("divider", "boundary"):
        assert last.value(name, "duplication") < 1.3
        assert last.value(name, "lateral_median") < first.value(name, "lateral_median")


def test_the_same_drive_once_more_finds_what_is_in_the_map_small_islands_too(sample_folder):
    predictions = pm.read_predictions(sample_folder / "predictions.json")
    local = pm.project(predictions, pm.read_poses(sample_folder / "poses.csv"), crs="EPSG:32632")
    kerbs = pm.LocalMaps(local.observations[local.observations["class"] == "boundary"], local.instances)
    first = merge(kerbs, crs=None)
    again = merge(kerbs, main_map=first.as_main_map(), crs=None)
    assert again.elements["element_id"].tolist() == first.elements["element_id"].tolist()
    assert (again.elements["n_observations"] > 1.9 * first.elements["n_observations"]).all()
    assert (again.elements["score"] > first.elements["score"] - 0.1).all()
    assert apart(again.elements, first.elements) < 1.5


@settings(max_examples=15, deadline=None)
@given(SEEDS, st.booleans())
def test_every_length_is_accounted_for_and_every_id_has_its_place(seed, footprints):
    first = merge(drawn(seed, 4)).elements
    # Every other element says nothing of how often it was seen.
    first[["n_observations", "n_instances"]] = first[["n_observations", "n_instances"]].astype("Int64")
    first.loc[::2, ["n_observations", "n_instances"]] = None
    new = drawn(seed + 1, 9)
    areas = [box(*shape.buffer(3).bounds) for shape in new.dissolve("instance").geometry]
    result = merge(local_maps(new, areas) if footprints else pm.LocalMaps(new, source="drive"), main_map=first)
    tables = pd.concat([result.lineage, result.left_out])
    total = (tables["to_m"] - tables["from_m"]).groupby([tables["source"], tables["source_fid"]]).sum()
    np.testing.assert_allclose(total["main_map"].reindex(first.index), first.length, atol=1e-6)
    np.testing.assert_allclose(total["drive"].reindex(new.index), new.length, atol=1e-6)
    kept, gone = result.elements["element_id"], result.id_aliases.set_index("old_id")["element_id"]
    assert kept.is_unique
    assert set(first["element_id"]) == (set(kept) & set(first["element_id"])) | set(gone.index)
    assert set(gone) <= {*kept, -1}
    assert set(result.lineage["element_id"]) == set(kept)
    assert footprints or result.left_out.empty
    assert (result.elements["n_instances"] <= result.elements["n_observations"]).all()


@settings(max_examples=10, deadline=None)
@given(SEEDS)
def test_the_order_of_features_and_their_direction_do_not_matter(seed):
    first, new = merge(drawn(seed, 4)).elements, drawn(seed + 1, 5)
    expected = merge(new, main_map=first)
    rng = np.random.default_rng(seed)

    def mixed(frame):
        other = frame.sample(frac=1, random_state=seed).reset_index(drop=True)
        flip = rng.random(len(other)) < 0.5
        return other.set_geometry(np.where(flip, other.geometry.reverse(), other.geometry))

    found = merge(mixed(new), main_map=mixed(first))
    assert apart(found.elements, expected.elements) < CENTIMETRE
    assert found.elements["element_id"].tolist() == expected.elements["element_id"].tolist()
    assert found.id_aliases.to_numpy().tolist() == expected.id_aliases.to_numpy().tolist()


def test_the_same_input_gives_the_same_bits():
    first, new = merge(drawn(3, 4)).elements, drawn(4, 5)
    once, again = (merge(new, main_map=first).elements for _ in range(2))
    assert shapely.to_wkb(once.geometry).tolist() == shapely.to_wkb(again.geometry).tolist()
