"""The consensus merge on lines one can draw on paper, and what must hold of every merge by it."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import LineString, Point, Polygon, box
from shapely.ops import substring

import polymerge_core as pm
from benchmarks.scenarios import town
from polymerge_core.consensus.alongside import pairs_alongside
from polymerge_core.consensus.association import Links, associate, link_groups
from polymerge_core.consensus.axes import Axes, smooth
from polymerge_core.consensus.drift import estimate_drift
from polymerge_core.consensus.looks import Instances, Looks

CENTIMETRE = 0.01


def looks(*shapes, cls="divider", crs=None, **columns):
    """Make a layer of observations, each of a local map of its own unless told otherwise."""
    shapes = [shape if isinstance(shape, shapely.Geometry) else LineString(shape) for shape in shapes]
    columns = {"class": [cls] * len(shapes), "drive": "a", "instance": np.arange(len(shapes))} | columns
    return gpd.GeoDataFrame(columns, geometry=shapes, crs=crs)


def merge(layer, **options):
    return pm.merge(layer, **{"method": "consensus", "crs": "local", **options})


def level(y, start=0.0, stop=40.0, step=4.0):
    x = np.append(np.arange(start, stop, step), stop)
    return np.column_stack([x, np.full(len(x), y)])


def curve(start=0.0, stop=60.0, radius=40.0):
    """Follow a gentle arc."""
    angle = np.arange(start, stop, 0.5) / radius
    return np.column_stack([radius * np.sin(angle), radius * (1 - np.cos(angle))])


def noisy(rng, line, sigma=0.2):
    """Look at a line once more: shifted, bent a little, its ends cut, in either direction."""
    line = line[int(rng.integers(0, 5)) : len(line) - int(rng.integers(0, 5))]
    wave = np.sin(np.linspace(0, 2 * np.pi, len(line)) + rng.uniform(0, 6)) * sigma * rng.normal()
    heading = np.gradient(line, axis=0)
    normal = np.column_stack([-heading[:, 1], heading[:, 0]]) / np.hypot(*heading.T)[:, None]
    return (line + (wave + rng.normal(0, sigma))[:, None] * normal)[:: rng.choice([-1, 1])]


def apart(first, second):
    """Largest distance between the lines of two maps, metres."""
    one, other = (shapely.union_all(each.geometry.to_numpy()) for each in (first, second))
    return max(shapely.hausdorff_distance(one, other, 0.05), shapely.hausdorff_distance(other, one, 0.05))


# What comes out


def test_looks_beside_each_other_become_the_line_between_them():
    result = merge(looks(level(0.0), level(0.4), level(0.2)))
    (line,) = result.elements.geometry
    assert shapely.hausdorff_distance(line, LineString(level(0.2))) < 0.05
    assert result.elements[["n_observations", "n_instances"]].to_numpy().tolist() == [[3, 3]]
    assert result.elements["sigma_m"].between(0, 0.5).all()


def test_one_bad_look_does_not_bend_the_line():
    result = merge(looks(*(level(0.05 * (n % 3)) for n in range(14)), level(0.9)))
    (line,) = result.elements.geometry
    assert shapely.hausdorff_distance(line, LineString(level(0.05))) < 0.06


def test_many_looks_are_better_than_each():
    rng = np.random.default_rng(1)
    truth = curve()
    seen = [noisy(rng, truth) for _ in range(15)]
    (line,) = merge(looks(*seen)).elements.geometry
    truth_line = LineString(truth)

    def error(points):
        return np.median(shapely.distance(shapely.points(points), truth_line))

    assert error(shapely.get_coordinates(shapely.segmentize(line, 0.5))) < 0.5 * np.mean([error(one) for one in seen])


def test_without_noise_the_true_line_comes_back():
    truth = curve()
    parts = [truth[:80], truth[20:][::-1], truth[40:], truth]
    (line,) = merge(looks(*parts)).elements.geometry
    assert shapely.hausdorff_distance(line, LineString(truth), 0.05) < CENTIMETRE


def test_a_look_that_is_alone_stays_as_it_is():
    result = merge(looks(level(0.0), level(30.0)))
    assert result.elements.geometry.tolist() == [LineString(level(0.0)), LineString(level(30.0))]


def test_a_line_that_goes_on_is_followed_to_its_end():
    result = merge(looks(level(0, 0, 20), level(0.2, 10, 30), level(0.1, 20, 40), level(0, 30, 50)))
    (line,) = result.elements.geometry
    assert shapely.get_coordinates(line)[:, 0].min() == pytest.approx(0, abs=0.5)
    assert shapely.get_coordinates(line)[:, 0].max() == pytest.approx(50, abs=0.5)


def test_a_corner_is_not_cut():
    angle = np.radians(np.arange(0, 91, 5))
    arc = 6 * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
    truth = np.vstack([level(0, -20, -2), arc, [(6, y) for y in range(8, 26, 2)]])
    rng = np.random.default_rng(3)
    seen = [truth + rng.normal(0, 0.05, 2) for _ in range(15)]
    (line,) = merge(looks(*seen)).elements.geometry
    assert shapely.distance(shapely.points(arc), line).max() < 0.1


def test_a_ring_stays_a_ring():
    angle = np.linspace(0, 2 * np.pi, 40)
    ring = 10 * np.column_stack([np.cos(angle), np.sin(angle)])
    ring[-1] = ring[0]
    rng = np.random.default_rng(2)
    result = merge(looks(*(ring + rng.normal(0, 0.1, 2) for _ in range(5))))
    (line,) = result.elements.geometry
    assert line.is_closed
    assert shapely.hausdorff_distance(line, LineString(ring)) < 0.2


# Who belongs together


def test_lines_that_one_local_map_saw_side_by_side_stay_two():
    pairs = [(level(0.05 * n), level(0.8 + 0.05 * n)) for n in range(6)]
    layer = looks(*(line for pair in pairs for line in pair), instance=np.repeat(np.arange(6), 2))
    assert len(merge(layer).elements) == 2


@pytest.mark.parametrize(
    "other",
    [
        pytest.param(level(0.1, 40.2, 80), id="end to end"),
        pytest.param([(20, -20), (20, 20)], id="crossing"),
        pytest.param([(40, 0.2), (60, 30)], id="turning away at the end"),
        pytest.param(level(3.0), id="beside, too far away"),
    ],
)
def test_lines_that_do_not_run_alongside_stay_apart(other):
    assert len(merge(looks(level(0.0), level(0.1), other)).elements) == 2


def test_classes_are_not_mixed():
    layer = looks(level(0.0), level(0.1)).assign(**{"class": ["divider", "boundary"]})
    assert sorted(merge(layer).elements["class"]) == ["boundary", "divider"]


def test_the_proximity_is_the_scale():
    tracks = [1000 * np.asarray(level(y / 1000)) for y in (0, 6, 11)]
    assert len(merge(looks(*tracks), proximity=1).elements) == 3
    assert len(merge(looks(*tracks), proximity=15).elements) == 1


def test_a_look_at_the_wrong_line_is_found_out():
    # Two lines that draw near each other at one end; the last look at the first one ends up close to the second.
    first = [[(0, 5 + 0.02 * n), (40, 0.4 + 0.02 * n)] for n in range(6)]
    second = [[(20, 0.02 * n), (40, 0.02 * n)] for n in range(6)]
    layer = looks(*first, *second, instance=[*range(6), *range(6)])
    result = merge(layer)
    counts = sorted(result.elements["n_observations"])
    assert counts == [6, 6]


# How often it was seen


def local_maps(layer, footprints):
    count = len(footprints)
    columns = {"drive": "a", "instance": np.arange(count), "timestamp_ns": np.arange(count), "x": 20.0, "y": 0.0}
    frame = {**columns, "heading": 90.0, "n_observations": 1}
    return pm.LocalMaps(layer, gpd.GeoDataFrame(frame, geometry=footprints, crs=layer.crs), source="drive")


def test_what_one_saw_and_four_others_did_not_is_left_out_with_the_reason():
    layer = looks(*(level(0.05 * n) for n in range(5)), level(6.0), instance=[0, 1, 2, 3, 4, 2])
    result = merge(local_maps(layer, [box(-5, -10, 45, 10)] * 5))
    assert len(result.elements) == 1
    (row,) = result.left_out.to_dict("records")
    assert row["source_fid"] == 5
    assert "seen by too few" in row["reason"]
    assert row["to_m"] - row["from_m"] == pytest.approx(40)


def test_what_nobody_else_could_confirm_stays():
    layer = looks(*(level(0.05 * n) for n in range(5)), level(50.0), instance=[0, 1, 2, 3, 4, 2])
    areas = [box(-5, -10, 45, 10)] * 5
    areas[2] = box(-5, -10, 45, 60)
    assert len(merge(local_maps(layer, areas)).elements) == 2


def test_without_footprints_nothing_is_left_out():
    layer = looks(*(level(0.05 * n) for n in range(5)), level(6.0), instance=[0, 1, 2, 3, 4, 2])
    assert len(merge(layer).elements) == 2


def test_the_pose_of_a_local_map_is_corrected_by_all_of_its_lines():
    rng = np.random.default_rng(4)
    shapes, instance = [], []
    for number in range(10):
        wrong = np.array([0.0, 0.4 * (number == 0)])
        for y in (0, 10, 20):
            shapes.append(level(y) + wrong + [0, rng.normal(0, 0.02)])
            instance.append(number)
    result = merge(looks(*shapes, instance=instance))
    assert len(result.elements) == 3
    assert result.report["corrections"]["shift_m_max"] > 0.1


# Areas


def crossing(shift=(0.0, 0.0), skew=2.0):
    return Polygon(np.array([(0, 0), (4, 0), (4 + skew, 12), (skew, 12)]) + shift)


def test_a_skewed_crossing_stays_skewed():
    rng = np.random.default_rng(5)
    seen = [crossing(rng.normal(0, 0.2, 2)) for _ in range(12)]
    seen = [Polygon(np.roll(shapely.get_coordinates(one)[:-1], n % 4, axis=0)) for n, one in enumerate(seen)]
    (area,) = merge(looks(*seen, cls="ped_crossing")).elements.geometry
    true = crossing()
    assert len(area.exterior.coords) == 5
    assert area.intersection(true).area / area.union(true).area > 0.9


def test_crossings_of_one_local_map_stay_apart():
    layer = looks(crossing(), crossing((0.3, 0)), crossing((3.0, 11.0)), cls="ped_crossing", instance=[0, 1, 0])
    assert len(merge(layer).elements) == 2


def test_open_rings_of_an_area_class_come_back_as_lines():
    rings = [LineString(shapely.get_coordinates(crossing((0.1 * n, 0)))) for n in range(3)]
    (area,) = merge(looks(*rings, cls="ped_crossing")).elements.geometry
    assert area.geom_type == "LineString"
    assert area.is_closed


# What must always hold


def drawn(seed, count=8):
    rng = np.random.default_rng(seed)
    lines = [curve(), np.add(curve(), [0, 8]), level(-9.0, 0, 50, 0.5)]
    shapes, instance = [], []
    for number in range(count):
        for line in lines:
            if rng.random() < 0.85:
                shapes.append(noisy(rng, line, 0.15))
                instance.append(number)
    return looks(*shapes, instance=instance, score=rng.uniform(0.5, 1, len(shapes)))


SEEDS = st.integers(0, 10_000)


@settings(max_examples=12, deadline=None)
@given(SEEDS, st.floats(0, 360), st.booleans())
def test_a_map_that_lies_otherwise_is_merged_alike(seed, degrees, mirrored):
    layer = drawn(seed)
    expected = merge(layer).elements

    def moved(frame):
        turned = frame.geometry.scale(-1 if mirrored else 1, 1, origin=(0, 0)).rotate(degrees, origin=(0, 0))
        return frame.set_geometry(turned.translate(3e5, 5e6))

    found = merge(moved(layer)).elements
    assert len(found) == len(expected)
    assert apart(found, moved(expected)) < CENTIMETRE


@settings(max_examples=12, deadline=None)
@given(SEEDS)
def test_the_order_of_features_and_their_direction_do_not_matter(seed):
    layer = drawn(seed)
    rng = np.random.default_rng(seed)
    other = layer.sample(frac=1, random_state=seed)
    flip = rng.random(len(other)) < 0.5
    other = other.set_geometry(np.where(flip, other.geometry.reverse(), other.geometry))
    assert apart(merge(layer).elements, merge(other).elements) < CENTIMETRE


@settings(max_examples=8, deadline=None)
@given(SEEDS)
def test_everything_seen_twice_gives_the_same_map(seed):
    layer = drawn(seed)
    again = layer.assign(instance=layer["instance"] + 100)
    twice = merge(pd.concat([layer, again], ignore_index=True)).elements
    once = merge(layer).elements
    assert len(twice) == len(once)
    assert apart(once, twice) < CENTIMETRE


def test_an_exact_copy_counts_once():
    layer = drawn(7)
    result = merge(pd.concat([layer, layer.iloc[:3]], ignore_index=True))
    assert result.report["left_out"] == {"duplicate": 3}
    assert apart(merge(layer).elements, result.elements) < 1e-9


def test_the_same_input_gives_the_same_bits():
    first, second = (merge(drawn(9)).elements for _ in range(2))
    assert shapely.to_wkb(first.geometry).tolist() == shapely.to_wkb(second.geometry).tolist()


@pytest.mark.parametrize("seed", [1, 2])
def test_every_length_is_accounted_for_once(seed):
    scenario = town(seed)
    result = pm.merge(scenario.local, method="consensus")
    tables = pd.concat([result.lineage, result.left_out])
    total = (tables["to_m"] - tables["from_m"]).groupby(tables["source_fid"]).sum()
    seen = scenario.observations
    np.testing.assert_allclose(total.reindex(seen.index), seen.length, atol=1e-6)
    ordered = tables.sort_values(["source_fid", "from_m"])
    within = ordered["source_fid"].eq(ordered["source_fid"].shift())
    assert np.allclose(ordered["from_m"][within], ordered["to_m"].shift()[within])
    assert set(result.lineage["element_id"]) == set(result.elements["element_id"])


@pytest.mark.parametrize("seed", [1, 2])
def test_a_simulated_drive_is_drawn_once_smoothly_and_better_than_one_look(seed):
    scenario = town(seed)
    elements = pm.merge(scenario.local, method="consensus").elements
    merged = pm.evaluate(elements, scenario.truth, local_maps=scenario.local)
    single = pm.evaluate(scenario.observations, scenario.truth, local_maps=scenario.local)
    for name in ("divider", "boundary"):
        assert merged.value(name, "lateral_median") < 0.8 * single.value(name, "lateral_median")
        assert merged.value(name, "ap") > single.value(name, "ap")
        assert merged.value(name, "zigzag") < 0.1
        # One element a true line, and no more than one from false detections. (Of two true lines 0.4 m apart both
        # merged ones may lie nearer to the same, so that `duplication` says nothing of them.)
        seen = scenario.true_ids[(scenario.observations["class"] == name).to_numpy()].nunique()
        assert seen - 1 <= (elements["class"] == name).sum() <= seen + 1
    assert merged.value("boundary", "duplication") < 1.1
    assert merged.value("ped_crossing", "iou") > 0.8


def test_a_main_map_keeps_its_ids():
    main = looks(level(0.0), level(20.0), element_id=[7, 3]).drop(columns=["drive", "instance"])
    result = merge(looks(level(0.3), level(0.2)), main_map=main)
    assert sorted(result.elements["element_id"]) == [3, 7]
    assert result.elements.set_index("element_id").loc[7, "n_observations"] == 3


def test_columns_are_carried_and_degrees_come_back_in_degrees():
    layer = looks(level(0.0), level(0.4, 0, 60), name=["short", "long"]).set_crs("EPSG:32632")
    layer = layer.set_geometry(layer.translate(4e5, 6e6)).to_crs("EPSG:4326")
    elements = merge(layer, crs=None).elements
    assert elements["name"].tolist() == ["long"]
    assert elements.crs == "EPSG:4326"
    assert elements["length_m"].iloc[0] == pytest.approx(60, abs=0.5)


def test_nothing_comes_of_nothing():
    result = merge(looks(crs="EPSG:32632"), crs=None)
    assert len(result.elements) == 0
    assert {"score", "sigma_m"} <= set(result.elements)


def test_scores_of_zero_are_no_reason_to_fail():
    assert len(merge(looks(level(0), level(0.2), score=[0.0, 0.0])).elements) == 1


# Stages alone


def stage_looks(*lines, instance=None):
    lines = np.array([LineString(line) for line in lines], dtype=object)
    instance = np.arange(len(lines)) if instance is None else np.asarray(instance)
    count = int(instance.max()) + 1
    unknown = np.full((count, 2), np.nan)
    instances = Instances(np.zeros(count, dtype=np.intp), None, unknown, unknown[:, 0])
    return Looks.of(lines, instance, np.ones(len(lines)), instances, 1.0)


def test_pairs_say_where_the_one_lies_along_the_other():
    seen = stage_looks(level(0, 0, 30), level(0.5, 10, 20)[::-1])
    (pair,) = zip(*pairs_alongside(seen, np.zeros(2, dtype=np.intp)), strict=True)
    short, long, overlap, apart_m, parallel, square, sense, shift, _ = pair
    assert (short, long, sense) == (1, 0, -1)
    assert (overlap, apart_m, parallel) == (pytest.approx(10), 0, pytest.approx(10))
    assert square == pytest.approx(0.25)
    # Its start lies at 20 m of the longer one, and it runs backwards.
    assert shift == pytest.approx(20)


def test_association_puts_the_closest_together():
    seen = stage_looks(level(0), level(0.1), level(0.9), level(1.0), instance=[0, 1, 0, 1])
    group = associate(seen, pairs_alongside(seen, np.zeros(4, dtype=np.intp)))
    assert group.tolist() == [0, 0, 1, 1]


def grouped(size, instance, pairs):
    """Group looks of given lengths; `pairs` has the metres, the square distance, and the metres seen side by side."""
    keys = sorted(pairs)
    metres, square, side = np.array([pairs[key] for key in keys]).T
    first, second = np.array(keys).T
    links = Links(first, second, metres * square, metres, np.zeros(len(keys)), side)
    return link_groups(np.array(instance), np.array(size, dtype=float), links, 1.0)


def test_looks_at_a_line_that_went_to_the_group_of_its_branch_come_back():
    """Eight drives saw a line, six of them a short branch beside it, too; two looks lie nearest to the branches."""
    lines, branches = range(8), range(8, 14)
    size, instance = [60.0] * 8 + [12.0] * 6, [*range(8), *range(6)]
    pairs = {(one, other): (60.0, 0.04, 0.0) for one in lines for other in lines if one < other}
    pairs |= {(one, other): (60.0, 0.5, 0.0) for one in range(6) for other in (6, 7)}
    pairs |= {(one, other): (12.0, 0.01, 0.0) for one in branches for other in branches if one < other}
    pairs |= {(line, branch): (12.0, 0.6, 0.0) for line in range(6) for branch in branches if branch - 8 != line}
    pairs |= dict.fromkeys(zip(range(6), branches, strict=True), (0.0, 0.0, 12.0))
    pairs |= {(line, branch): (12.0, 0.02, 0.0) for line in (6, 7) for branch in branches}
    group = grouped(size, instance, pairs)
    assert len(set(group[:8].tolist())) == 1


def test_two_lines_that_most_local_maps_saw_side_by_side_stay_two_however_near_they_are():
    drives = range(8)
    pairs = {}
    for one in drives:
        for other in drives:
            if one < other:
                pairs |= {(one, other): (60.0, 0.04, 0.0), (8 + one, 8 + other): (60.0, 0.04, 0.0)}
            pairs[one, 8 + other] = (0.0, 0.0, 50.0) if one == other else (60.0, 0.05, 0.0)
    group = grouped([60.0] * 16, [*drives, *drives], pairs)
    assert group.tolist() == [0] * 8 + [1] * 8


def test_two_lines_that_fork_stay_two_where_one_local_map_saw_both():
    upper = [(6.8, 11.7), (8.1, 10.8), (10.0, 9.5), (11.9, 8.5), (13.2, 7.3)]
    lower = [(4.0, 10.4), (6.9, 9.2), (8.5, 8.3), (10.4, 7.0), (12.8, 5.6)]
    again = [(7.5, 7.8), (6.5, 8.5), (6.0, 8.9), (4.8, 9.3), (4.1, 9.8)]
    result = merge(local_maps(looks(upper, lower, again, instance=[0, 0, 1]), [box(-50, -50, 50, 50)] * 2))
    assert sorted(result.elements["n_observations"]) == [1, 2]


def test_smoothing_leaves_straight_lines_and_separate_series_alone():
    values = np.vstack([level(0, 0, 10, 1), level(50, 0, 10, 1)])
    series = np.repeat([0, 1], len(values) // 2)
    np.testing.assert_allclose(
        smooth(values, np.ones(len(values)), series, np.full(len(values), 10.0)), values, atol=1e-6
    )


@pytest.mark.parametrize("radius", [1.5, 2.0, 3.0, 6.0, 12.0])
def test_a_small_ring_keeps_its_size(radius):
    rng = np.random.default_rng(0)
    angle = np.linspace(0, 2 * np.pi, 41)
    ring = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    seen = []
    for number in range(15):
        turned = np.roll(ring[:-1], rng.integers(40), axis=0)
        seen.append((np.vstack([turned, turned[:1]]) + rng.normal(0, 0.2, 2))[:: 1 if number % 2 else -1])
    first = merge(looks(*seen))
    again = merge(looks(*seen, drive="b"), main_map=first.as_main_map())
    for result in (first, again):
        (element,) = result.elements.geometry
        assert element.is_ring
        assert element.length == pytest.approx(LineString(ring).length, rel=0.02)
        assert element.hausdorff_distance(LineString(ring)) < 0.25


def test_drives_of_which_none_saw_a_line_for_certain_stay_where_they_are():
    drift = estimate_drift([], 1.0)
    assert (drift.at(np.array([0, 1]), np.zeros((2, 2))) == 0).all()


def test_smoothing_bridges_what_has_no_weight():
    values = level(0, 0, 10, 1)
    values[4, 1] = 99.0
    weight = np.ones(len(values))
    weight[4] = 0.0
    assert smooth(values, weight, np.zeros(len(values), dtype=np.intp), np.ones(len(values)))[4, 1] == pytest.approx(
        0, abs=1e-3
    )


@pytest.mark.filterwarnings("error")
def test_weights_next_to_nothing_are_weights():
    stations = level(0, 0, 8, 1)
    stations[6, 1] = 1.0
    weight = np.where(np.arange(9) < 6, np.finfo(float).tiny, 30.0)
    smoothed = Axes(stations, np.zeros(9, dtype=np.intp)).smoothed(weight).stations
    assert np.isfinite(smoothed).all()
    assert 0 < smoothed[6, 1] < 1


# Bad and odd input


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("score", [0.0, 1.0])
def test_rings_far_smaller_than_the_proximity_are_merged_without_a_warning(score):
    rings = [Point(0, 0).buffer(radius, 2).exterior.coords for radius in (1, 3)]
    assert len(merge(looks(*rings, score=[score] * 2), proximity=10.0).elements) > 0


def test_a_proximity_too_small_for_the_data_is_refused():
    with pytest.raises(pm.InputError, match="larger proximity"):
        merge(looks([(0, 0), (3e5, 0)]), proximity=0.01)


@pytest.mark.parametrize(
    "shapes",
    [
        pytest.param([LineString([(0, 0), (0.05, 0)])] * 2, id="shorter than a step"),
        pytest.param([LineString([(0, 0), (1e-6, 0)]), LineString([(0, 0), (30, 0)])], id="a speck"),
        pytest.param([LineString([(0, 0), (5, 0), (0, 0)]), LineString([(0, 0), (5, 0)])], id="there and back"),
        pytest.param([LineString([(0, 0), (0.5, 0), (0.5, 0.5), (0, 0)])] * 3, id="tiny rings"),
        pytest.param([LineString([(0, 0), (50, 0)]), shapely.MultiLineString([[(0, 1), (20, 1)], [(30, 1), (50, 1)]])]),
        pytest.param([box(0, 0, 1e-3, 1e-3), box(0, 0, 1e-3, 1e-3)], id="tiny areas"),
        pytest.param([box(0, 0, 9, 9), LineString([(0, 0), (9, 0)]), Polygon(curve()[:, ::-1])], id="areas and lines"),
        pytest.param([Polygon(box(0, 0, 20, 20).exterior, [box(5, 5, 9, 9).exterior])] * 2, id="a hole"),
    ],
)
def test_odd_shapes_are_merged_or_left_out(shapes):
    layer = looks(*shapes, cls="kerb")
    result = merge(layer)
    tables = pd.concat([result.lineage, result.left_out])
    total = (tables["to_m"] - tables["from_m"]).groupby(tables["source_fid"]).sum()
    np.testing.assert_allclose(total.reindex(layer.index, fill_value=0), layer.length, atol=1e-6)
    assert np.isfinite(shapely.get_coordinates(result.elements.geometry)).all()
    assert result.elements.geometry.is_valid.all()


@pytest.mark.parametrize("seed", range(6))
def test_random_scribbles_are_accounted_for(seed):
    rng = np.random.default_rng(seed)
    shapes = [
        np.cumsum(rng.normal(0, rng.choice([0.3, 3, 20]), (int(rng.integers(2, 30)), 2)), axis=0) for _ in range(40)
    ]
    layer = looks(*shapes, instance=rng.integers(0, 8, 40), cls="kerb")
    result = merge(layer)
    tables = pd.concat([result.lineage, result.left_out])
    total = (tables["to_m"] - tables["from_m"]).groupby(tables["source_fid"]).sum()
    np.testing.assert_allclose(total.reindex(layer.index), layer.length, atol=1e-6)
    assert np.isfinite(shapely.get_coordinates(result.elements.geometry)).all()
    # Nobody knows where the local maps looked.
    assert result.left_out.empty


def test_a_ring_that_smoothing_would_lose_is_kept():
    island = Polygon(box(0, 0, 5, 5).exterior, [box(1, 1, 2, 2).exterior])
    assert sorted(merge(looks(island, cls="boundary")).elements["length_m"]) == [4, 20]


def test_what_is_left_out_is_listed_in_order():
    lines = [level(0.02 * n) for n in range(12)]
    layer = looks(*lines, level(6), None, level(-6), instance=[*range(12), 11, 2, 3])
    reasons = merge(local_maps(layer, [box(-5, -10, 45, 10)] * 12)).left_out
    assert reasons["instance"].tolist() == ["11", "2", "3"]
    assert reasons["source_fid"].tolist() == [12, 13, 14]


class TestFootprints:
    """`instances` as users have them: what is not known of them does no harm."""

    AREA = box(-5, -10, 45, 10)

    def left_out(self, change):
        """Return which features are left out of a layer with one stray line, when the instances are changed."""
        layer = looks(*(level(0.05 * n) for n in range(5)), level(6.0), instance=[0, 1, 2, 3, 4, 2])
        maps = local_maps(layer, [self.AREA] * 5)
        return set(merge(pm.LocalMaps(layer, change(maps.instances), source="drive")).left_out["source_fid"])

    @pytest.mark.parametrize(
        "change",
        [
            pytest.param(lambda frame: frame, id="all there"),
            pytest.param(lambda frame: frame[["drive", "instance", "geometry"]], id="no places"),
            pytest.param(lambda frame: frame.assign(x=None, y=None, heading=None), id="places not known"),
            pytest.param(lambda frame: frame.assign(instance=frame["instance"] + 0.0), id="numbers with a point"),
            pytest.param(lambda frame: frame.set_geometry(shapely.force_3d(frame.geometry)), id="heights"),
            pytest.param(lambda frame: pd.concat([frame, frame]), id="twice"),
            pytest.param(
                lambda frame: frame.set_geometry([Polygon([(-5, -9), (45, 9), (45, -9), (-5, 9)])] * 5), id="a bow"
            ),
        ],
    )
    def test_tell_what_nobody_else_saw(self, change):
        assert self.left_out(change) == {5}

    @pytest.mark.parametrize(
        "change",
        [
            pytest.param(lambda frame: frame.iloc[:4], id="one is missing"),
            pytest.param(lambda frame: frame.set_geometry([None, *frame.geometry[1:]]), id="one has none"),
            pytest.param(lambda frame: frame.set_geometry([Polygon(), *frame.geometry[1:]]), id="one is empty"),
            pytest.param(lambda frame: frame.assign(drive="b"), id="of another drive"),
        ],
    )
    def test_that_are_not_all_known_tell_nothing(self, change):
        assert self.left_out(change) == set()

    def test_without_names_are_refused(self):
        with pytest.raises(pm.SchemaError, match="'drive': its instances have no column 'instance'"):
            self.left_out(lambda frame: frame.drop(columns="instance"))

    def test_without_a_crs_are_in_the_layers(self):
        layer = looks(*(level(0.05 * n) for n in range(5)), level(6.0), instance=[0, 1, 2, 3, 4, 2])
        maps = local_maps(layer, [self.AREA] * 5)
        moved = [frame.set_geometry(frame.translate(4e5, 6e6)) for frame in (maps.observations, maps.instances)]
        away = pm.LocalMaps(moved[0].set_crs("EPSG:32632"), moved[1].assign(x=4e5 + 20, y=6e6), source="drive")
        elsewhere = looks(level(0), crs="EPSG:25832")
        elsewhere = elsewhere.set_geometry(elsewhere.translate(4e5, 6e6 + 50)).assign(drive="main")
        main = elsewhere.to_crs("EPSG:3857").assign(element_id=1)
        assert len(merge(away, main_map=main, crs=None).left_out) == 1


def test_a_crossing_cut_off_at_the_edge_of_what_was_looked_at_joins_the_whole_one():
    wide = [shapely.box(x, 0.0, x + 8.0, 4.0) for x in (0.0, 0.2, -0.2)]
    sliver = shapely.box(6.9, 0.4, 8.6, 4.4)
    footprints = [shapely.box(-20, -20, 20, 20)] * 3 + [shapely.box(6.9, -20, 40, 20)]
    result = merge_crossings([*wide, sliver], footprints)
    assert len(result.elements) == 1
    assert shapely.Polygon(result.elements.geometry.iloc[0]).area == pytest.approx(32.0, rel=0.03)


class TestACrossingThatFewSawBesideWhereManySawIt:
    MANY, FEW = 9, 3
    AREA = shapely.box(-20, -20, 20, 20)

    def merged(self, *more, footprints=True):
        """Return the merge of many looks at a crossing, few at one half beside it, and of `more`, by local map."""
        shapes = [shapely.box(0.0, 0.1 * n, 4.0, 12.0 + 0.1 * n) for n in range(self.MANY)]
        shapes += [shapely.box(2.6, 0.1 * n, 6.6, 12.0 + 0.1 * n) for n in range(self.FEW)]
        names = [*range(self.MANY + self.FEW), *(name for name, _ in more)]
        rings = [shape.exterior for shape in [*shapes, *(shape for _, shape in more)]]
        layer = looks(*rings, cls="ped_crossing", instance=names)
        return merge(local_maps(layer, [self.AREA] * (self.MANY + self.FEW)) if footprints else layer)

    def test_is_that_one_seen_badly(self):
        result = self.merged()
        assert len(result.elements) == 1
        assert result.elements.geometry.iloc[0].bounds == pytest.approx((0.0, 0.4, 4.0, 12.4), abs=0.1)
        assert result.left_out["reason"].tolist() == ["seen by too few of the local maps that looked there"] * self.FEW

    def test_is_another_one_where_they_saw_both(self):
        both = [(self.MANY + n, shapely.box(0.0, 0.1 * n, 4.0, 12.0 + 0.1 * n)) for n in range(2)]
        assert len(self.merged(*both).elements) == 2

    def test_is_another_one_where_nobody_knows_who_looked(self):
        assert len(self.merged(footprints=False).elements) == 2


def test_of_crossings_that_all_were_cut_off_the_corners_that_were_seen_are_averaged():
    seen = [shapely.box(0.0, y, 6.0 + number, 4.0 + y) for number, y in enumerate((0.3, -0.3, 0.0))]
    footprints = [shapely.box(-20, -20, 6.0 + number, 20) for number in range(3)]
    result = merge_crossings(seen, footprints)
    (x, low, _, high) = result.elements.geometry.iloc[0].bounds
    assert (x, low, high) == (pytest.approx(0, abs=0.02), pytest.approx(0, abs=0.02), pytest.approx(4, abs=0.02))


def merge_crossings(shapes, footprints):
    names = np.arange(len(shapes))
    layer = looks(*(shape.exterior for shape in shapes), cls="ped_crossing", instance=names)
    return merge(local_maps(layer, footprints))


@settings(max_examples=12, deadline=None)
@given(SEEDS, st.floats(0.2, 0.8))
def test_a_look_cut_in_two_leaves_the_map_as_it_was(seed, share):
    layer = drawn(seed)
    row = seed % len(layer)
    whole = layer.geometry.iloc[row]
    halves = layer.iloc[[row, row]].set_geometry([substring(whole, *ends, True) for ends in ((0, share), (share, 1))])
    cut = pd.concat([layer.drop(index=layer.index[row]), halves], ignore_index=True)
    expected, found = merge(layer).elements, merge(cut).elements
    assert len(found) == len(expected)
    # Its points lie elsewhere along it: a centimetre for most, a little more at an end now and then.
    assert apart(found, expected) < 5 * CENTIMETRE
