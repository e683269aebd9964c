"""`evaluate` on lines one can draw on paper: each measure against its known answer, and what may be given to it."""

from __future__ import annotations

import json
import math

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from geopandas.testing import assert_geodataframe_equal
from pandas.testing import assert_frame_equal
from shapely import LineString, MultiLineString, box

import polymerge_core as pm
from polymerge_core.evaluation.result import MEASURE_COLUMNS

UTM, DEGREES = "EPSG:32633", "EPSG:4326"
EAST, NORTH = 5e5, 5.3e6

MEASURES = [
    "frechet_best",
    "frechet_check",
    "pcm_best",
    "pcm_check",
    "pcm_raw_best",
    "pcm_raw_check",
    "iou",
    "corner_error",
    "frechet_before",
    "frechet_after",
    "after_better",
    "chamfer",
    "ap_0.5",
    "ap_1.0",
    "ap_1.5",
    "ap",
    "precision_0.5",
    "recall_0.5",
    "f1_0.5",
    "precision_1.0",
    "recall_1.0",
    "f1_1.0",
    "duplication",
    "fragments",
    "zigzag",
    "zigzag_reference",
    "lateral",
    "lateral_median",
    "lateral_rms",
    "lateral_p95",
    "lateral_beyond",
]
PAIRED = ["frechet_before", "frechet_after", "after_better"]


def layer(*shapes, cls="line", crs=None, **columns):
    """Make a layer of one class, of lists of points or of shapes."""
    shapes = [shape if isinstance(shape, shapely.Geometry) else LineString(shape) for shape in shapes]
    return gpd.GeoDataFrame({"class": [cls] * len(shapes), **columns}, geometry=list(shapes), crs=crs)


def level(y, start=0.0, stop=100.0):
    """Draw a line along x."""
    return LineString([(start, y), (stop, y)])


def moved(frame):
    """Put a layer where its numbers are those of a UTM zone."""
    return frame.set_geometry(frame.geometry.translate(EAST, NORTH)).set_crs(UTM)


def judge(merged, reference, **options):
    return pm.evaluate(merged, reference, **{"crs": "local", **options})


def row(result, measure, cls="line"):
    table = result.table
    (found,) = table[(table["class"] == cls) & (table["measure"] == measure)].to_dict("records")
    return found


def spread(result, measure, cls="line"):
    found = row(result, measure, cls)
    return found["n"], pytest.approx((found["value"], found["min"], found["max"], found["std"]), nan_ok=True)


def f1(precision, recall):
    return 2 * precision * recall / (precision + recall)


# Known answers: distances


def test_parallel_lines_are_their_distance_apart():
    result = judge(layer(level(0.3, 10, 50)), layer(level(0, 0, 90)))
    for measure in ("frechet_best", "frechet_check", "lateral"):
        assert row(result, measure)["value"] == pytest.approx(0.3)
        assert row(result, measure)["min"] == pytest.approx(0.3)
        assert row(result, measure)["max"] == pytest.approx(0.3)
        assert row(result, measure)["std"] == pytest.approx(0, abs=1e-9)
    assert row(result, "frechet_best")["n"] == 1
    for measure in ("lateral_median", "lateral_rms", "lateral_p95"):
        assert result.value("line", measure) == pytest.approx(0.3)
    assert result.value("line", "lateral_beyond") == 0
    assert result.value("line", "precision_0.5") == 1
    # 40 m are drawn; pieces of the reference have their middles at 0.25, 0.75, ..., within 0.4 or 0.95 m past the ends.
    assert result.value("line", "recall_0.5") == pytest.approx(41 / 90)
    assert result.value("line", "recall_1.0") == pytest.approx(42 / 90)
    assert result.value("line", "f1_0.5") == pytest.approx(f1(1, 41 / 90))
    assert result.value("line", "duplication") == pytest.approx(1)
    assert result.value("line", "fragments") == 1
    assert result.value("line", "zigzag") == 0


@pytest.mark.parametrize("distance", [0.05, 0.4, 0.95])
@pytest.mark.parametrize("degrees", [0, 30, 45, 90, 137, 180, 300])
def test_a_straight_line_shifted_perpendicularly_is_that_far_off(distance, degrees):
    angle = math.radians(degrees)
    along, across = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
    truth = np.array([-20 * along, 3 * along, 60 * along])
    drawn = np.array([1.1 * along, 33.3 * along]) + distance * across
    assert judge(layer(drawn), layer(truth)).value("line", "frechet_best") == pytest.approx(distance, abs=1e-9)


def test_a_reference_far_longer_than_the_estimate_is_compared_over_the_section_only():
    result = judge(layer(level(0.5, 2000, 2020)), layer(level(0, 0, 5000)))
    assert result.value("line", "frechet_best") == pytest.approx(0.5)


def test_a_bend_of_the_reference_outside_the_section_does_not_matter():
    truth = [(-30, 40), (0, 0), (60, 0), (60, 80)]
    assert judge(layer(level(0.2, 10, 50)), layer(truth)).value("line", "frechet_best") == pytest.approx(0.2)


def test_an_estimate_beyond_the_end_of_the_reference_is_compared_with_its_end():
    result = judge(layer(level(0, 91, 99)), layer(level(0, 0, 90.5)))
    assert result.value("line", "frechet_best") == pytest.approx(8.5)


def test_an_estimate_that_touches_the_reference_at_one_point_is_as_far_off_as_its_other_end():
    result = judge(layer([(0, 0), (0, 10)]), layer(level(0, -20, 20)), pcm=True)
    assert result.value("line", "frechet_best") == pytest.approx(10)
    assert math.isnan(result.value("line", "pcm_best"))
    assert row(result, "pcm_best")["n"] == 0


def test_the_check_pairs_all_near_references_and_the_best_takes_the_nearest():
    result = judge(layer(level(0, 10, 50)), layer(level(0.2), level(-0.7), level(1.2)))
    assert row(result, "frechet_best")["n"] == 1
    assert result.value("line", "frechet_best") == pytest.approx(0.2)
    both = row(result, "frechet_check")
    assert both["n"] == 2
    assert [both[name] for name in ("value", "min", "max", "std")] == pytest.approx([0.45, 0.2, 0.7, 0.25])


@pytest.mark.parametrize(
    ("merged", "reference"),
    [
        pytest.param(level(1.0, 10, 50), level(0), id="one metre away exactly"),
        pytest.param([(0, -5), (0, 5)], level(0, -50, 50), id="crossing, no vertex near"),
    ],
)
def test_lines_without_a_near_vertex_are_not_paired(merged, reference):
    result = judge(layer(merged), layer(reference))
    for measure in ("frechet_best", "frechet_check"):
        assert row(result, measure)["n"] == 0
        assert math.isnan(result.value("line", measure))


def test_a_vertex_of_the_reference_near_the_estimate_is_enough():
    result = judge(layer([(0, -5), (0, 5)]), layer([(-50, 0), (0.5, 0), (50, 0)]))
    assert row(result, "frechet_best")["n"] == 1


def test_distances_of_several_elements_have_their_mean_and_spread():
    merged = layer(level(0.1, 0, 20), level(0.3, 30, 50), level(0.8, 60, 80))
    found = row(judge(merged, layer(level(0))), "frechet_best")
    assert found["n"] == 3
    expected = [0.4, 0.1, 0.8, np.std([0.1, 0.3, 0.8])]
    assert [found[name] for name in ("value", "min", "max", "std")] == pytest.approx(expected)


def test_the_direction_of_digitisation_does_not_matter():
    merged, reference = [(0, 0.3), (20, -0.2), (40, 0.4), (41, 3)], [(-5, 0), (17, 0.1), (42, 0), (43, 9)]
    whole = judge(layer(merged), layer(reference)).table
    for first, second in ((merged[::-1], reference), (merged, reference[::-1]), (merged[::-1], reference[::-1])):
        assert_frame_equal(judge(layer(first), layer(second)).table, whole, rtol=0, atol=1e-9)


def test_partial_curve_mapping_does_not_depend_on_the_direction_of_digitisation():
    merged, reference = [(0, 0.3), (20, -0.2), (40, 0.9)], [(-5, 0), (17, 0.1), (42, 0), (43, 9)]
    values = [
        judge(layer(first), layer(second), pcm=True).value("line", "pcm_best")
        for first in (merged, merged[::-1])
        for second in (reference, reference[::-1])
    ]
    assert values == pytest.approx([values[0]] * 4, abs=1e-9)


@pytest.mark.parametrize("degrees", [30, 90, 200])
def test_turned_partial_curve_mapping_does_not_depend_on_how_the_map_lies(degrees):
    merged, reference = layer([(0, 0.3), (20, -0.2), (40, 0.9)]), layer([(-5, 0), (17, 0.1), (42, 0), (43, 9)])
    turned = [frame.set_geometry(frame.rotate(degrees, origin=(0, 0))) for frame in (merged, reference)]
    value = judge(merged, reference, pcm=True).value("line", "pcm_best")
    assert value > 0
    assert judge(*turned, pcm=True).value("line", "pcm_best") == pytest.approx(value, rel=1e-6)


def test_raw_partial_curve_mapping_of_a_level_line_is_left_out():
    result = judge(layer(level(0.3, 10, 50), [(10, 20.2), (40, 50)]), layer(level(0), [(0, 10), (60, 70)]), pcm=True)
    assert row(result, "pcm_best")["n"] == 2
    assert row(result, "pcm_raw_best")["n"] == 1
    assert result.report["pcm_pairs"] == 2


def test_partial_curve_mapping_of_the_section_itself_is_nothing():
    result = judge(layer([(5, 5), (20, 20)]), layer([(0, 0), (50, 50)]), pcm=True)
    assert result.value("line", "pcm_best") == pytest.approx(0, abs=1e-6)
    assert result.value("line", "pcm_raw_best") == pytest.approx(0, abs=1e-6)


def test_lateral_error_of_a_slowly_diverging_line():
    result = judge(layer([(0, 0), (100, 1)]), layer(level(0, -10, 110)))
    assert result.value("line", "lateral") == pytest.approx(0.5, abs=1e-6)
    assert result.value("line", "lateral_median") == pytest.approx(0.5, abs=1e-6)
    assert result.value("line", "lateral_rms") == pytest.approx(1 / math.sqrt(3), abs=1e-4)
    assert result.value("line", "lateral_p95") == pytest.approx(0.95, abs=3e-3)
    assert result.value("line", "lateral_beyond") == 0


def test_points_without_a_reference_near_are_beyond_and_not_in_the_mean():
    result = judge(layer(level(0.4, 0, 30), level(3, 0, 10)), layer(level(0)))
    assert result.value("line", "lateral") == pytest.approx(0.4)
    assert row(result, "lateral")["n"] == 60
    assert result.value("line", "lateral_beyond") == pytest.approx(0.25)


# Known answers: by length


def test_a_half_covered_line():
    result = judge(layer(level(0, 0, 50)), layer(level(0)))
    assert result.value("line", "frechet_best") == pytest.approx(0, abs=1e-9)
    assert result.value("line", "precision_0.5") == 1
    assert result.value("line", "recall_0.5") == pytest.approx(0.505)
    assert result.value("line", "recall_1.0") == pytest.approx(0.51)
    assert result.value("line", "f1_1.0") == pytest.approx(f1(1, 0.51))
    assert result.value("line", "duplication") == pytest.approx(1)


def test_precision_is_the_share_of_length_not_of_elements():
    result = judge(layer(level(0, 0, 60), level(0.7, 60, 80), level(9, 0, 20)), layer(level(0)))
    assert result.value("line", "precision_0.5") == pytest.approx(0.6)
    assert result.value("line", "precision_1.0") == pytest.approx(0.8)


@pytest.mark.parametrize(
    "second", [level(0), level(0.0, 100, 0), level(0.4)], ids=["the same", "the other way round", "beside"]
)
def test_a_doubled_line(second):
    result = judge(layer(level(0), second), layer(level(0)))
    assert result.value("line", "duplication") == pytest.approx(2)
    assert result.value("line", "fragments") == 2
    assert result.value("line", "precision_0.5") == 1
    assert result.value("line", "recall_0.5") == 1


def test_a_line_that_is_doubled_over_half_its_length():
    result = judge(layer(level(0), level(0.4, 20, 70)), layer(level(0)))
    # Lines are followed from the middle of their first piece to that of their last: half a metre less.
    assert result.value("line", "duplication") == pytest.approx((99.5 + 49.5) / 99.5)


@pytest.mark.parametrize(
    ("parts", "fragments"),
    [
        pytest.param([level(0, 20, 70)], 1, id="cut short"),
        pytest.param([level(0, 0, 50), level(0, 50, 100)], 2, id="in two halves"),
        pytest.param([level(0.2, 0, 30), level(-0.2, 40, 60), level(0, 70, 100)], 3, id="in three parts with gaps"),
        pytest.param([level(0), level(20, 0, 30)], 1, id="and something far away"),
    ],
)
def test_parts_of_a_line_are_not_duplicates(parts, fragments):
    result = judge(layer(*parts), layer(level(0)))
    assert result.value("line", "duplication") == pytest.approx(1)
    assert result.value("line", "fragments") == fragments


def test_fragments_are_counted_over_the_reference_lines_that_have_any():
    merged = layer(level(0, 0, 40), level(0, 50, 90), level(10), level(20, 0, 30))
    result = judge(merged, layer(level(0), level(10), level(20), level(30)))
    assert row(result, "fragments")["n"] == 3
    assert result.value("line", "fragments") == pytest.approx(4 / 3)


def test_zigzag_is_turning_over_length_of_all_elements_together():
    corner = [(0, 0), (3, 0), (3, 3)]
    square = [(10, 0), (14, 0), (14, 4), (10, 4), (10, 0)]
    result = judge(layer(corner, square), layer(square, level(-20, 0, 10)))
    assert result.value("line", "zigzag") == pytest.approx((math.pi / 2 + 2 * math.pi) / (6 + 16))
    assert result.value("line", "zigzag_reference") == pytest.approx(2 * math.pi / (16 + 10))


def test_zigzag_adds_left_and_right_turns():
    swinging = [(number, number % 2) for number in range(9)]
    result = judge(layer(swinging), layer(level(0, 0, 8)))
    assert result.value("line", "zigzag") == pytest.approx(7 * (math.pi / 2) / (8 * math.sqrt(2)))
    assert result.value("line", "zigzag_reference") == 0


# Known answers: the paired comparison


def paired_case(merged, *observations):
    return judge(merged, layer(level(0)), local_maps=layer(*observations))


def test_observations_are_compared_with_the_map_over_the_same_stretch():
    result = paired_case(layer(level(0.1)), level(0.4, 10, 40), level(-0.6, 20, 60))
    before, after = row(result, "frechet_before"), row(result, "frechet_after")
    assert (before["n"], after["n"]) == (2, 2)
    assert [before[name] for name in ("value", "min", "max", "std")] == pytest.approx([0.5, 0.4, 0.6, 0.1])
    assert [after[name] for name in ("value", "min", "max", "std")] == pytest.approx([0.1, 0.1, 0.1, 0], abs=1e-9)
    assert result.value("line", "after_better") == 1


def test_what_is_wrong_outside_the_stretch_does_not_count_against_the_map():
    result = paired_case(layer([(0, 0.1), (60, 0.1), (80, 20), (100, 20)]), level(0.4, 10, 40))
    assert result.value("line", "frechet_after") == pytest.approx(0.1)


def test_a_map_that_is_cut_short_is_charged_for_it():
    result = paired_case(layer(level(0, 20, 40)), level(0.1, 10, 60))
    assert result.value("line", "frechet_before") == pytest.approx(0.1)
    assert result.value("line", "frechet_after") == pytest.approx(20)
    assert result.value("line", "after_better") == 0


def test_the_direction_of_an_observation_does_not_matter_to_the_paired_comparison():
    merged = layer([(0, 0.1), (30, 0.3), (100, -0.5)])
    observation = [(10, 0.4), (40, 0.2), (50, 0.6)]
    there, back = (paired_case(merged, points) for points in (observation, observation[::-1]))
    for measure in PAIRED:
        assert there.value("line", measure) == pytest.approx(back.value("line", measure))


def test_observations_without_a_reference_or_without_an_element_are_in_neither():
    result = paired_case(layer(level(0.1, 0, 50)), level(0.4, 10, 40), level(30, 0, 40), level(0.2, 70, 90))
    assert row(result, "frechet_before")["n"] == row(result, "frechet_after")["n"] == 1
    assert result.value("line", "frechet_before") == pytest.approx(0.4)


def test_an_open_look_at_a_ring_is_compared_over_what_it_saw():
    ring = [(0, 0), (20, 0), (20, 20), (0, 20), (0, 0)]
    merged = [(0, 0.2), (20, 0.2), (20, 25), (0, 25), (0, 0.2)]  # wrong on the far side only
    result = judge(layer(merged), layer(ring), local_maps=layer(level(-0.4, 5, 15)))
    assert result.value("line", "frechet_before") == pytest.approx(0.4)
    assert result.value("line", "frechet_after") == pytest.approx(0.2)


def test_there_is_no_paired_comparison_without_local_maps():
    assert not set(PAIRED) & set(judge(layer(level(0)), layer(level(0))).table["measure"])


# Which part counts


def test_only_what_lies_in_the_region_counts():
    merged = layer(level(0.2, 0, 50), level(30, 60, 100))
    region = gpd.GeoDataFrame(geometry=[box(-10, -10, 50, 40)])
    result = judge(merged, layer(level(0)), region=region)
    assert result.value("line", "precision_0.5") == 1
    assert result.value("line", "recall_0.5") == 1
    assert result.value("line", "lateral_beyond") == 0
    assert result.value("line", "ap_0.5") == 1
    whole = judge(merged, layer(level(0)), region=region, region_from="all")
    assert whole.value("line", "precision_0.5") == pytest.approx(50 / 90)
    assert whole.value("line", "recall_0.5") == pytest.approx(0.505)


def test_elements_outside_the_region_have_no_distance():
    merged, reference = layer(level(0.2, 0, 40), level(10.8, 60, 100)), layer(level(0, 0, 40), level(10, 60, 100))
    result = judge(merged, reference, region=gpd.GeoDataFrame(geometry=[box(-5, -5, 45, 15)]))
    assert row(result, "frechet_best")["n"] == 1
    assert result.value("line", "frechet_best") == pytest.approx(0.2)


def test_turning_outside_the_region_does_not_count():
    merged = layer([(0, 0), (40, 0), (60, 0), (60, 10), (70, 10), (70, 0)])
    result = judge(merged, layer(level(0)), region=gpd.GeoDataFrame(geometry=[box(-5, -5, 40, 5)]))
    assert result.value("line", "zigzag") == 0


def test_the_reference_near_an_observation_of_its_class_counts():
    merged, local = layer(level(0, 0, 50)), layer(level(0.5, 0, 50))
    local = pd.concat([local, layer(level(0.5), cls="other")], ignore_index=True)
    seen = judge(merged, layer(level(0)), local_maps=local)
    # Seen is what lies within 2 m: 50 m and sqrt(4 - 0.25) m; found, half a metre beyond the end.
    assert seen.value("line", "recall_0.5") == pytest.approx(50.5 / 52)
    assert judge(merged, layer(level(0)), local_maps=local, region_from="all").value(
        "line", "recall_0.5"
    ) == pytest.approx(0.505)


def test_a_region_goes_before_observations():
    merged, region = layer(level(0, 0, 50)), gpd.GeoDataFrame(geometry=[box(0, -1, 40, 1)])
    given = {"local_maps": layer(level(0)), "region": region}
    assert judge(merged, layer(level(0)), **given).value("line", "recall_0.5") == 1
    assert judge(merged, layer(level(0)), **given, region_from="observations").value("line", "recall_0.5") < 0.6


def test_footprints_of_the_instances_are_a_region():
    instances = gpd.GeoDataFrame(
        {"drive": ["a"], "instance": ["0"], "n_observations": [1]}, geometry=[box(0, -5, 40, 5)]
    )
    observations = layer(level(0.1, 0, 40), drive=["a"], instance=["0"])
    local = pm.LocalMaps(observations, instances)
    result = judge(layer(level(0, 0, 60)), layer(level(0)), local_maps=local, region_from="footprints")
    assert result.value("line", "recall_0.5") == 1
    assert result.value("line", "precision_0.5") == 1


def test_a_region_may_be_in_another_crs():
    region = gpd.GeoSeries([box(0, -10, 50, 10)]).translate(EAST, NORTH).set_crs(UTM).to_crs(DEGREES)
    result = pm.evaluate(moved(layer(level(0, 0, 50))), moved(layer(level(0))), region=region.to_frame("geometry"))
    assert result.value("line", "recall_0.5") == 1


def test_a_region_that_holds_nothing_leaves_nothing_to_measure():
    region = gpd.GeoDataFrame(geometry=[box(0, 500, 10, 510)])
    result = judge(layer(level(0)), layer(level(0)), region=region)
    for measure in ("precision_0.5", "recall_0.5", "lateral", "duplication"):
        assert math.isnan(result.value("line", measure))


@pytest.mark.parametrize(
    "options", [{"region_from": "everything"}, {"region_from": "region"}, {"region_from": "observations"}]
)
def test_a_choice_of_region_that_cannot_be_is_refused(options):
    with pytest.raises(pm.OptionError, match="region_from"):
        judge(layer(level(0)), layer(level(0)), **options)


# What may be given


def test_an_empty_map_finds_nothing():
    empty = gpd.GeoDataFrame({"class": []}, geometry=[], crs=UTM)
    result = pm.evaluate(empty, moved(layer(level(0))), local_maps=moved(layer(level(0))), pcm=True)
    assert result.value("line", "recall_0.5") == 0
    assert result.value("line", "ap") == 0
    assert result.value("all", "ap") == 0
    for measure in ("frechet_best", "pcm_best", "precision_0.5", "lateral", "duplication", "zigzag", "frechet_after"):
        assert math.isnan(result.value("line", measure))
        assert row(result, measure)["n"] == 0
    assert len(result.elements) == len(result.errors) == len(result.lateral) == 0


@pytest.mark.parametrize(
    "empty", [gpd.GeoDataFrame({"class": []}, geometry=[], crs=UTM), layer(None, crs=UTM)], ids=["no row", "no shape"]
)
def test_an_empty_reference_is_refused_in_one_sentence(empty):
    with pytest.raises(pm.InputError, match="reference"):
        pm.evaluate(moved(layer(level(0))), empty)


def test_an_empty_layer_needs_no_class_column():
    with pytest.raises(pm.InputError, match="reference holds no line"):
        judge(layer(level(0)).drop(columns="class"), layer(level(0)).drop(columns="class").iloc[:0])


def test_degrees_are_measured_in_metres():
    merged, reference = moved(layer(level(0.5, 10, 90))), moved(layer(level(0)))
    result = pm.evaluate(merged.to_crs(DEGREES), reference.to_crs(DEGREES))
    assert result.value("line", "frechet_best") == pytest.approx(0.5, rel=2e-3)
    assert result.value("line", "lateral") == pytest.approx(0.5, rel=2e-3)
    assert result.elements.crs == result.errors.crs == result.reference.crs == DEGREES


@pytest.mark.parametrize("crs", [DEGREES, "EPSG:32632", "EPSG:3857"])
def test_a_reference_in_another_crs_is_the_same_reference(crs):
    merged, reference = moved(layer(level(0.5, 10, 90))), moved(layer(level(0)))
    result = pm.evaluate(merged, reference.to_crs(crs), local_maps=merged.to_crs(crs))
    assert result.value("line", "frechet_best") == pytest.approx(0.5, rel=2e-3)
    assert result.value("line", "frechet_before") == pytest.approx(0.5, rel=2e-3)
    assert result.elements.crs == result.reference.crs == result.observations.crs == UTM


def test_a_layer_without_a_crs_beside_one_with_a_crs_is_refused():
    with pytest.raises(pm.CrsError):
        pm.evaluate(moved(layer(level(0))), layer(level(0)))


def test_a_class_of_the_map_alone_is_wrong_all_over():
    merged = pd.concat([layer(level(0)), layer(level(0), cls="other")], ignore_index=True)
    result = judge(merged, layer(level(0)))
    assert result.value("other", "precision_1.0") == 0
    assert result.value("other", "lateral_beyond") == 1
    assert row(result, "frechet_best", "other")["n"] == 0
    assert math.isnan(result.value("other", "recall_1.0"))
    assert math.isnan(result.value("other", "ap"))
    assert result.value("all", "ap") == 1
    assert any("other" in warning for warning in result.report["warnings"])


def test_a_class_of_the_reference_alone_is_missed_all_over():
    reference = pd.concat([layer(level(0)), layer(level(10), cls="other")], ignore_index=True)
    result = judge(layer(level(0)), reference)
    assert result.value("other", "recall_1.0") == 0
    assert result.value("other", "ap") == 0
    assert result.value("all", "ap") == 0.5
    assert math.isnan(result.value("other", "precision_1.0"))
    assert any("other" in warning for warning in result.report["warnings"])


def test_other_classes_are_not_compared():
    result = judge(layer(level(0), cls="divider"), layer(level(0), cls="boundary"))
    assert row(result, "frechet_check", "divider")["n"] == 0
    assert result.value("divider", "precision_0.5") == 0
    assert result.value("boundary", "recall_0.5") == 0


def test_parts_of_a_feature_are_elements_of_their_own():
    parts = [level(0.1, 0, 20), level(0.5, 30, 60)]
    whole, apart = (judge(frame, layer(level(0))) for frame in (layer(MultiLineString(parts)), layer(*parts)))
    assert_frame_equal(whole.table, apart.table)
    assert row(whole, "frechet_best")["n"] == 2
    assert len(whole.elements) == 2


def test_a_multi_part_reference_is_as_good_as_its_parts():
    parts = [level(0, 0, 20), level(0, 30, 60)]
    merged = layer(level(0.1, 0, 60))
    whole, apart = (judge(merged, frame) for frame in (layer(MultiLineString(parts)), layer(*parts)))
    assert_frame_equal(whole.table, apart.table)


def test_repeated_vertices_and_missing_shapes_change_nothing():
    merged = layer(level(0.1, 0, 20), [(30, 0.2), (40, 0.3), (60, 0.2)])
    worse = layer(
        [(0, 0.1), (0, 0.1), (20, 0.1), (20, 0.1)], None, LineString(), [(30, 0.2), (40, 0.3), (40, 0.3), (60, 0.2)]
    )
    assert_frame_equal(judge(worse, layer(level(0))).table, judge(merged, layer(level(0))).table)


def test_layers_without_a_class_are_of_one_class():
    plain = [layer(level(y)).drop(columns="class") for y in (0.5, 0)]
    assert judge(*plain).value("line", "frechet_best") == pytest.approx(0.5)
    assert judge(*plain, class_name="kerb").value("kerb", "frechet_best") == pytest.approx(0.5)
    assert judge(*(frame.geometry for frame in plain)).value("line", "frechet_best") == pytest.approx(0.5)


def test_the_class_may_stand_in_another_column():
    merged, reference = (layer(level(y), cls="kerb").rename(columns={"class": "kind"}) for y in (0.5, 0))
    assert judge(merged, reference, class_field="kind").value("kerb", "frechet_best") == pytest.approx(0.5)


def test_a_class_column_that_was_named_must_be_there():
    plain = layer(level(0)).drop(columns="class")
    with pytest.raises(pm.SchemaError, match="kind"):
        judge(plain, plain, class_field="kind")


@pytest.mark.parametrize("cls", ["line", "kerb"])
@pytest.mark.parametrize("without", ["merged", "reference", "local_maps"])
def test_a_layer_without_a_class_column_is_of_the_one_class(without, cls):
    maps = {"merged": layer(level(0.5), cls=cls), "reference": layer(level(0), cls=cls)}
    maps["local_maps"] = layer(level(0.7), cls=cls)
    maps[without] = maps[without].drop(columns="class")
    result = judge(**maps, class_name=cls)
    assert result.value(cls, "frechet_best") == pytest.approx(0.5)
    assert result.value(cls, "frechet_before") == pytest.approx(0.7)
    assert result.report["warnings"] == []


@pytest.mark.parametrize("without", [0, 1], ids=["the map", "the reference"])
def test_no_class_in_common_for_want_of_a_class_column_is_refused(without):
    maps = [layer(level(0.5), cls="divider"), layer(level(0), cls="divider")]
    maps[without] = maps[without].drop(columns="class")
    with pytest.raises(pm.SchemaError, match=r"has no class column, .*'divider'.*class_name"):
        judge(*maps)


def test_observations_without_a_class_column_beside_other_classes_are_told():
    classed, plain = layer(level(0), cls="divider"), layer(level(0.5)).drop(columns="class")
    (warning,) = judge(classed, classed, local_maps=plain, region_from="all").report["warnings"]
    assert "'local_maps' has no class column" in warning
    assert "'divider'" in warning


@pytest.mark.parametrize(
    "wrong", [None, 3, "truth.gpkg", {"truth": layer(level(0))}, pd.DataFrame({"class": ["line"]})], ids=type
)
def test_what_is_no_layer_is_refused(wrong):
    with pytest.raises(pm.PolymergeError):
        judge(layer(level(0)), wrong)
    with pytest.raises(pm.PolymergeError):
        judge(wrong, layer(level(0)))


def test_points_are_refused_or_left_out():
    points = layer(level(0.5), shapely.Point(0, 0))
    try:
        result = judge(points, layer(level(0)))
    except pm.PolymergeError as error:
        assert "oint" in str(error)  # noqa: PT017
    else:
        assert len(result.elements) == 1
        assert sum(result.report["left_out"].values()) == 1


def test_several_layers_are_one_map():
    parts = [layer(level(0.1, 0, 20)), layer(level(0.5, 30, 60))]
    expected = judge(pd.concat(parts, ignore_index=True), layer(level(0), level(10))).table
    assert_frame_equal(judge(parts, [layer(level(0)), pm.LocalMaps(layer(level(10)))]).table, expected)


def test_inputs_are_not_changed():
    given = [moved(layer(level(y, 0, 90), score=[0.5])) for y in (0.5, 0, 0.3)]
    region = gpd.GeoDataFrame({"name": ["here"]}, geometry=[box(-10, -10, 80, 10)])
    region = moved(region)
    copies = [frame.copy(deep=True) for frame in (*given, region)]
    pm.evaluate(given[0], given[1], local_maps=given[2], region=region, pcm=True)
    for frame, copy in zip((*given, region), copies, strict=True):
        assert_geodataframe_equal(frame, copy)


def test_the_order_of_rows_and_their_index_do_not_matter():
    merged = layer(level(0.1, 0, 20), level(0.5, 30, 60), level(10.2), level(9.9), score=[0.5, 0.9, 0.5, 0.5])
    reference = layer(level(0), level(10), level(20))
    expected = judge(merged, reference, local_maps=merged).table
    shuffled = judge(merged.iloc[[3, 1, 0, 2]], reference.iloc[::-1], local_maps=merged.iloc[::-1]).table
    assert_frame_equal(shuffled, expected, rtol=0, atol=1e-12)


# What comes out


def test_the_table_has_its_columns_and_the_measures_in_their_order():
    shapes = [frame.assign(**{"class": "ped_crossing"}) for frame in (layer(box(0, 0, 9, 4)), layer(box(0, 0, 9, 4)))]
    result = judge(shapes[0], shapes[1], local_maps=shapes[0], pcm=True)
    assert tuple(result.table.columns) == MEASURE_COLUMNS
    assert result.table.loc[result.table["class"] == "ped_crossing", "measure"].tolist() == MEASURES
    assert not result.table.duplicated(["class", "measure"]).any()
    assert set(result.table.loc[result.table["class"] == "all", "measure"]) >= {"ap_0.5", "ap_1.0", "ap_1.5", "ap"}


def test_lines_have_no_measures_of_areas_and_mapping_is_asked_for():
    measures = judge(layer(level(0)), layer(level(0))).table["measure"].tolist()
    optional = {"iou", "corner_error", *PAIRED, *(name for name in MEASURES if name.startswith("pcm"))}
    assert measures[: -len({"ap_0.5", "ap_1.0", "ap_1.5", "ap"})] == [name for name in MEASURES if name not in optional]


def test_a_measure_that_is_not_there_is_a_key_error():
    result = judge(layer(level(0)), layer(level(0)))
    with pytest.raises(KeyError, match="frechet"):
        result.value("line", "frechet")
    with pytest.raises(KeyError, match="kerb"):
        result.value("kerb", "frechet_best")


def test_elements_carry_their_own_figures():
    merged = layer(level(0.2, 0, 30), level(50, 0, 30), score=[0.9, 0.4], element_id=["a", "b"])
    elements = judge(merged, layer(level(0), element_id=["truth"])).elements.set_index("element_id")
    assert elements.loc["a", "reference_id"] == "truth"
    assert elements.loc["a", "frechet_m"] == pytest.approx(0.2)
    assert elements.loc["a", "lateral_median_m"] == pytest.approx(0.2)
    assert elements.loc["a", "beyond_share"] == 0
    assert elements.loc["a", "length_m"] == pytest.approx(30)
    assert pd.isna(elements.loc["b", "reference_id"])
    assert pd.isna(elements.loc["b", "frechet_m"])
    assert elements.loc["b", "beyond_share"] == 1
    assert elements["score"].to_dict() == {"a": 0.9, "b": 0.4}


def test_the_errors_layer_is_the_map_in_pieces_with_their_errors():
    errors = judge(layer(level(0.2, 0, 30), level(50, 0, 30)), layer(level(0))).errors
    assert errors.length.sum() == pytest.approx(60)
    assert errors.length.max() < 10
    near = errors[~errors["beyond"].astype(bool)]
    assert near.length.sum() == pytest.approx(30)
    assert near["error_m"].to_numpy() == pytest.approx(0.2)
    assert errors.loc[errors["beyond"].astype(bool), "error_m"].isna().all()


def test_the_lateral_table_holds_what_the_mean_is_of():
    result = judge(layer(level(0.2, 0, 30), [(40, 0), (90, 1)]), layer(level(0)))
    assert len(result.lateral) == row(result, "lateral")["n"]
    assert result.lateral["error_m"].mean() == pytest.approx(result.value("line", "lateral"))


def test_the_report_is_ready_for_json():
    local = layer(level(0.3, 0, 50))
    result = judge(layer(level(0.2, 0, 50), level(90)), layer(level(0)), local_maps=local, pcm=True)
    assert json.loads(json.dumps(result.report, allow_nan=False)) == result.report


def test_the_layers_can_be_written_and_read_again(tmp_path):
    result = pm.evaluate(moved(layer(level(0.2, 0, 50))), moved(layer(level(0))))
    pm.write_layers(tmp_path / "errors.gpkg", result.layers())
    found = pm.read_layers(tmp_path / "errors.gpkg")
    assert {"errors", "evaluated"} <= set(found)
    assert len(found["errors"]) == len(result.errors)


def test_progress_is_told_and_may_stop_the_work():
    told = []
    judge(layer(level(0)), layer(level(0)), pcm=True, progress=lambda share, text: told.append((share, text)))
    shares = [share for share, _ in told]
    assert shares == sorted(shares)
    assert shares[0] >= 0
    assert shares[-1] <= 1
    assert all(isinstance(text, str) for _, text in told)

    def stop(share, text):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        judge(layer(level(0)), layer(level(0)), progress=stop)
