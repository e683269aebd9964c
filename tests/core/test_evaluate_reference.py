"""`evaluate` against its literal reference, measure by measure, on random maps; DF on 500 random pairs."""

from __future__ import annotations

import functools
import math

import geopandas as gpd
import numpy as np
import pytest
import shapely
import similaritymeasures

import polymerge_core as pm
from polymerge_core.evaluation.frechet import frechet_distances
from tests import evaluation_reference as slow

SEEDS = range(4)
PRECISE = 1e-6


def layer(lines, **columns):
    shapes = [shapely.LineString(line) for line in lines]
    return gpd.GeoDataFrame({"class": ["kerb"] * len(shapes), **columns}, geometry=shapes)


@functools.cache
def drawn(seed):
    return slow.random_map(seed)


@functools.cache
def evaluated(seed):
    maps = drawn(seed)
    return pm.evaluate(
        layer(maps.merged, score=maps.scores),
        layer(maps.reference),
        local_maps=layer(maps.observations),
        region_from="all",
        pcm=True,
        crs="local",
    )


@functools.cache
def compared(seed):
    return slow.pairs(drawn(seed).merged, drawn(seed).reference)


def row(result, measure):
    table = result.table
    (found,) = table[(table["class"] == "kerb") & (table["measure"] == measure)].to_dict("records")
    return found


def assert_row(found, values):
    values = np.array(values)
    assert found["n"] == len(values)
    expected = (values.mean(), values.min(), values.max(), values.std())
    assert tuple(found[name] for name in ("value", "min", "max", "std")) == pytest.approx(expected, abs=PRECISE)


def test_batched_frechet_distances_are_those_of_similaritymeasures():
    rng = np.random.default_rng(7)
    first = [rng.normal(0, 5, (int(rng.integers(1, 30)), 2)).cumsum(axis=0) for _ in range(500)]
    second = [rng.normal(0, 5, (int(rng.integers(1, 30)), 2)).cumsum(axis=0) for _ in range(500)]
    expected = [similaritymeasures.frechet_dist(a, b) for a, b in zip(first, second, strict=True)]
    found = frechet_distances(first, second)
    assert isinstance(found, np.ndarray)
    assert found.shape == (500,)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def test_batched_frechet_distances_of_curves_of_very_different_length():
    rng = np.random.default_rng(8)
    first = [rng.normal(0, 1, (count, 2)) for count in (1, 200, 2, 90)]
    second = [rng.normal(0, 1, (count, 2)) for count in (150, 1, 2, 3)]
    expected = [similaritymeasures.frechet_dist(a, b) for a, b in zip(first, second, strict=True)]
    np.testing.assert_allclose(frechet_distances(first, second), expected, rtol=0, atol=1e-9)


def test_no_pairs_give_no_distances():
    assert frechet_distances([], []).shape == (0,)


@pytest.mark.parametrize("seed", SEEDS)
def test_frechet_of_every_pair_and_of_the_best(seed):
    assert len(compared(seed)) > len(slow.best_pairs(compared(seed))) >= 4
    assert_row(row(evaluated(seed), "frechet_check"), [pair.frechet for pair in compared(seed)])
    assert_row(row(evaluated(seed), "frechet_best"), [pair.frechet for pair in slow.best_pairs(compared(seed))])


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    ("measure", "best", "how"),
    [
        ("pcm_check", False, slow.mapping_turned),
        ("pcm_best", True, slow.mapping_turned),
        ("pcm_raw_check", False, slow.mapping),
        ("pcm_raw_best", True, slow.mapping),
    ],
)
def test_partial_curve_mapping(seed, measure, best, how):
    chosen = slow.best_pairs(compared(seed)) if best else compared(seed)
    values = [how(pair.section, pair.drawn) for pair in chosen]
    assert_row(row(evaluated(seed), measure), [value for value in values if not math.isnan(value)])


@pytest.mark.parametrize("seed", SEEDS)
def test_paired_comparison(seed):
    maps = drawn(seed)
    before, after = slow.paired(maps.observations, maps.merged, maps.reference)
    assert_row(row(evaluated(seed), "frechet_before"), before)
    assert_row(row(evaluated(seed), "frechet_after"), after)
    assert row(evaluated(seed), "after_better")["value"] == pytest.approx((after < before).mean())


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("threshold", [0.5, 1.0])
def test_precision_and_recall_by_length(seed, threshold):
    maps, result = drawn(seed), evaluated(seed)
    precision = slow.share_within(maps.merged, maps.reference, threshold)
    recall = slow.share_within(maps.reference, maps.merged, threshold)
    assert result.value("kerb", f"precision_{threshold}") == pytest.approx(precision, abs=PRECISE)
    assert result.value("kerb", f"recall_{threshold}") == pytest.approx(recall, abs=PRECISE)
    f1 = 2 * precision * recall / (precision + recall)
    assert result.value("kerb", f"f1_{threshold}") == pytest.approx(f1, abs=PRECISE)


@pytest.mark.parametrize("seed", SEEDS)
def test_lateral_error(seed):
    near, beyond = slow.lateral(drawn(seed).merged, drawn(seed).reference)
    result = evaluated(seed)
    assert 0 < beyond < 1
    assert_row(row(result, "lateral"), near)
    assert result.value("kerb", "lateral_median") == pytest.approx(np.median(near), abs=PRECISE)
    assert result.value("kerb", "lateral_rms") == pytest.approx(math.sqrt(np.mean(near**2)), abs=PRECISE)
    assert result.value("kerb", "lateral_p95") == pytest.approx(np.percentile(near, 95), abs=PRECISE)
    assert result.value("kerb", "lateral_beyond") == pytest.approx(beyond, abs=PRECISE)


@pytest.mark.parametrize("seed", SEEDS)
def test_duplication(seed):
    expected = slow.duplication(drawn(seed).merged, drawn(seed).reference)
    # A piece that runs over the start of a ring may be left out or not: it leaps from one end to the other.
    assert evaluated(seed).value("kerb", "duplication") == pytest.approx(expected, rel=5e-3)


@pytest.mark.parametrize("seed", SEEDS)
def test_zigzag(seed):
    result = evaluated(seed)
    assert result.value("kerb", "zigzag") == pytest.approx(slow.zigzag(drawn(seed).merged), abs=PRECISE)
    assert result.value("kerb", "zigzag_reference") == pytest.approx(slow.zigzag(drawn(seed).reference), abs=PRECISE)


@pytest.mark.parametrize("seed", SEEDS)
def test_average_precision(seed):
    maps, result = drawn(seed), evaluated(seed)
    expected = [slow.average_precision(maps.merged, maps.scores, maps.reference, t) for t in slow.THRESHOLDS_M]
    for threshold, value in zip(slow.THRESHOLDS_M, expected, strict=True):
        assert result.value("kerb", f"ap_{threshold}") == pytest.approx(value, abs=PRECISE)
    assert result.value("kerb", "ap") == pytest.approx(np.mean(expected), abs=PRECISE)
    assert result.value("all", "ap") == pytest.approx(np.mean(expected), abs=PRECISE)


@pytest.mark.parametrize("seed", SEEDS)
def test_chamfer_distance_to_the_best_match(seed):
    maps = drawn(seed)
    expected: dict[int, float] = {}
    for pair in compared(seed):
        distance = slow.chamfer(maps.merged[pair.estimate], maps.reference[pair.reference])
        expected[pair.estimate] = min(distance, expected.get(pair.estimate, math.inf))
    assert_row(row(evaluated(seed), "chamfer"), list(expected.values()))
