"""What holds of every evaluation: equal maps agree, nothing depends on direction, start, place or how the map lies."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import LineString, Polygon, box

import polymerge_core as pm
from polymerge_core.evaluation.detection import average_precision
from tests import evaluation_reference as slow

SEEDS = st.integers(0, 2**32 - 1)
EXACT = 1e-6


def layer(shapes, cls="kerb", **columns):
    shapes = [shape if isinstance(shape, shapely.Geometry) else LineString(shape) for shape in shapes]
    return gpd.GeoDataFrame({"class": [cls] * len(shapes), **columns}, geometry=list(shapes))


def judge(merged, reference, **options):
    return pm.evaluate(merged, reference, crs="local", **options)


def drawn(seed):
    maps = slow.random_map(seed, roads=4)
    return layer(maps.merged, score=maps.scores), layer(maps.reference)


def assert_same(first, second, tolerance=EXACT):
    assert first.table[["class", "measure"]].equals(second.table[["class", "measure"]])
    # Where a point lies just at a threshold, rounding decides on which side.
    assert ((first.table["n"] - second.table["n"]).abs() <= 1 + 0.01 * first.table["n"]).all()
    np.testing.assert_allclose(first.table["value"], second.table["value"], rtol=0, atol=tolerance)


def roads_apart(seed):
    """Draw lines and a ring that are far from each other."""
    rng = np.random.default_rng(seed)
    lines = [slow.random_road(rng) for _ in range(3)] + [slow.random_ring(rng)]
    return layer([np.add(line, [200 * number, 0]) for number, line in enumerate(lines)])


@settings(max_examples=15, deadline=None)
@given(SEEDS)
def test_equal_maps_agree_in_everything(seed):
    truth = roads_apart(seed)
    result = judge(truth, truth)
    for measure in ("frechet_best", "chamfer", "lateral", "lateral_p95", "lateral_beyond"):
        assert result.value("kerb", measure) == pytest.approx(0, abs=EXACT)
    for measure in ("ap", "precision_0.5", "recall_0.5", "f1_1.0", "fragments"):
        assert result.value("kerb", measure) == pytest.approx(1, abs=EXACT)
    assert result.value("kerb", "duplication") == pytest.approx(1, abs=0.05)
    assert result.value("kerb", "zigzag") == pytest.approx(result.value("kerb", "zigzag_reference"))


@settings(max_examples=15, deadline=None)
@given(SEEDS)
def test_a_straight_map_against_itself_is_drawn_once(seed):
    rng = np.random.default_rng(seed)
    ends = np.add(rng.uniform(0, 100, (3, 2, 2)), [[[0, 0], [150, 0]]])
    truth = layer([np.add(line, [0, 300 * number]) for number, line in enumerate(ends)])
    assert judge(truth, truth).value("kerb", "duplication") == pytest.approx(1, abs=EXACT)


@settings(max_examples=15, deadline=None)
@given(SEEDS, st.booleans(), st.booleans())
def test_the_direction_of_digitisation_does_not_matter(seed, merged_too, reference_too):
    merged, reference = drawn(seed)
    turned = [
        frame.set_geometry(frame.geometry.reverse()) if chosen else frame
        for frame, chosen in ((merged, merged_too), (reference, reference_too))
    ]
    assert_same(judge(merged, reference), judge(*turned))


@settings(max_examples=15, deadline=None)
@given(SEEDS, st.floats(0, 360), st.tuples(st.floats(-1e5, 1e5), st.floats(-1e5, 1e5)))
def test_a_map_that_is_turned_and_moved_is_as_good(seed, degrees, shift):
    merged, reference = drawn(seed)
    moved = [
        frame.set_geometry(frame.geometry.rotate(degrees, origin=(0, 0)).translate(*shift))
        for frame in (merged, reference)
    ]
    assert_same(judge(merged, reference), judge(*moved), tolerance=0.02)


@settings(max_examples=15, deadline=None)
@given(SEEDS, st.floats(0.01, 0.95), st.floats(0, 360))
def test_a_straight_line_shifted_sideways_is_that_far_off(seed, distance, degrees):
    rng = np.random.default_rng(seed)
    start, stop = np.add(np.sort(rng.uniform(0, 80, 2)), [0, 5])
    truth = layer([[(-5, 0), (95, 0)]])
    merged = layer([[(start, distance), (stop, distance)]])
    turned = [frame.set_geometry(frame.geometry.rotate(degrees, origin=(0, 0))) for frame in (merged, truth)]
    assert judge(*turned).value("kerb", "frechet_best") == pytest.approx(distance, abs=EXACT)


@pytest.mark.parametrize("start", range(6))
def test_a_ring_that_starts_elsewhere_is_the_same_ring(start):
    corners = np.array([(0, 0), (12, 0), (15, 8), (9, 14), (2, 12), (-3, 5)], dtype=float)
    ring = np.vstack([corners, corners[:1]])
    other = np.roll(corners, -start, axis=0)
    for way in (1, -1):
        again = np.vstack([other, other[:1]])[::way]
        result = judge(layer([again]), layer([ring]), pcm=True)
        assert result.value("kerb", "frechet_best") == pytest.approx(0, abs=EXACT)
        assert result.value("kerb", "pcm_best") == pytest.approx(0, abs=1e-3)
        assert result.value("kerb", "ap") == 1


@pytest.mark.parametrize(
    ("hits", "references", "expected"),
    [
        pytest.param([1, 1], 2, 1.0, id="all found"),
        pytest.param([1, 0, 1], 2, 0.5 * 1 + 0.5 * 2 / 3, id="one false between"),
        pytest.param([0, 1], 1, 0.5, id="the surest is false"),
        pytest.param([0, 1, 1, 0], 4, 0.25 * 2 / 3 + 0.25 * 2 / 3, id="the envelope lifts the first"),
        pytest.param([0, 0], 3, 0.0, id="none"),
    ],
)
def test_average_precision_by_hand(hits, references, expected):
    assert average_precision(np.array(hits, dtype=bool), references) == pytest.approx(expected)


def test_average_precision_of_a_map_by_hand():
    # By falling score: a hit at 0.3 m, the same line again, one 0.8 m off, one that is nowhere.
    rows = [(0.3, 0), (0.4, 0), (20.8, 0), (50.0, 0)]
    merged = layer([[(0, y), (60, y)] for y, _ in rows], score=[0.9, 0.8, 0.7, 0.6])
    reference = layer([[(0, y), (60, y)] for y in (0, 20, 40)])
    result = judge(merged, reference)
    assert result.value("kerb", "ap_0.5") == pytest.approx(1 / 3)
    assert result.value("kerb", "ap_1.0") == pytest.approx(1 / 3 + 1 / 3 * 2 / 3)
    assert result.value("kerb", "ap_1.5") == pytest.approx(1 / 3 + 1 / 3 * 2 / 3)
    assert result.value("kerb", "ap") == pytest.approx(np.mean([1 / 3, 5 / 9, 5 / 9]))
    assert result.value("all", "ap") == result.value("kerb", "ap")


def test_areas_overlap_by_hand():
    reference = layer([box(0, 0, 10, 4), box(100, 0, 110, 4), box(200, 0, 210, 4)], cls="ped_crossing")
    merged = layer([box(0, 0, 10, 4), box(105, 0, 115, 4)], cls="ped_crossing")
    result = judge(merged, reference)
    row = result.table[(result.table["class"] == "ped_crossing") & (result.table["measure"] == "iou")].iloc[0]
    assert row["n"] == 3
    assert row["value"] == pytest.approx((1 + 1 / 3 + 0) / 3)
    assert result.value("ped_crossing", "corner_error") == pytest.approx((0 + 5) / 2)


def test_corners_are_where_a_ring_turns():
    square = Polygon([(0, 0), (5, 0), (10, 0), (10, 10), (0, 10)])
    bent = Polygon([(0.3, 0.4), (10, 0), (10, 10), (0, 10)])
    result = judge(layer([bent], cls="ped_crossing"), layer([square], cls="ped_crossing"))
    assert result.value("ped_crossing", "corner_error") == pytest.approx(0.5 / 4)
