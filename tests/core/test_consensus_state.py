"""Merging on: what is known from some local maps, and what others add to it."""

from __future__ import annotations

from dataclasses import replace

import geopandas as gpd
import numpy as np
import pytest
import shapely

import polymerge_core as pm
from benchmarks.scenarios import town
from polymerge_core.errors import CrsError, OptionError
from tests.core.test_consensus import level, looks


def some(local, chosen):
    names = set(local.instances["instance"].iloc[chosen])
    kept = (frame[frame["instance"].isin(names)] for frame in (local.observations, local.instances))
    return pm.LocalMaps(*kept, source=local.source)


def along(lines, step=1.0):
    """Return points every metre along lines."""
    steps = np.maximum(np.round(shapely.length(lines) / step), 1).astype(int)
    shares = np.concatenate([(np.arange(count) + 0.5) / count for count in steps])
    return shapely.line_interpolate_point(np.repeat(lines, steps), shares, normalized=True)


def distances(first, second):
    """Return how far points along either map are from the other one, class by class."""
    found = []
    for name in first["class"].unique():
        one, other = (frame.loc[frame["class"] == name].geometry.to_numpy() for frame in (first, second))
        found += [
            shapely.distance(along(a), shapely.multilinestrings(list(b))) for a, b in ((one, other), (other, one))
        ]
    return np.concatenate(found)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_one_half_and_then_the_other_give_what_both_give(seed):
    (local,) = town(seed).local
    half = len(local.instances) // 2
    first, second = some(local, np.arange(half)), some(local, np.arange(half, 2 * half))
    together = pm.accumulate([first, second]).elements()
    in_turn = pm.accumulate(second, pm.accumulate(first)).elements()
    apart = distances(together, in_turn)
    assert np.median(apart) <= 0.1
    assert np.quantile(apart, 0.9) <= 0.3


def test_what_is_known_alone_is_what_a_merge_gives():
    (local,) = town(1).local
    merged = pm.merge(local, method="consensus").elements
    known = pm.accumulate(local).elements()
    assert sorted(merged["class"]) == sorted(known["class"])
    # What one local map alone saw comes out of a merge as it went in.
    several = merged[merged["n_instances"] > 1]
    assert distances(several, known)[: len(along(several.geometry.to_numpy()))].max() < 0.02
    assert known.crs == merged.crs


def test_what_nobody_saw_again_stays():
    state = pm.accumulate(looks(level(0.0), level(0.1), level(50.0), instance=[0, 1, 0]), crs="local")
    later = pm.accumulate(looks(level(0.2), level(0.3), instance=[2, 3]), state, crs="local").elements()
    heights = sorted(float(np.mean(shape.xy[1])) for shape in later.geometry)
    assert heights == [pytest.approx(0.15, abs=0.02), pytest.approx(50.0, abs=0.05)]
    assert sorted(later["seen"]) == [pytest.approx(1), pytest.approx(4)]


def test_what_was_seen_too_seldom_comes_once_it_was_seen_again():
    instances = [gpd.GeoSeries([shapely.box(-5, -20, 45, 20)] * 5)] * 2
    seen = looks(*(level(0.02 * n) for n in range(5)), level(8.0), instance=[0, 1, 2, 3, 4, 2])
    again = looks(*(level(0.02 * n) for n in range(5)), *(level(8.0 + 0.1 * n) for n in range(4)))
    again["instance"] = [5, 6, 7, 8, 9, 5, 6, 7, 8]
    layers = [local(layer, areas) for layer, areas in zip((seen, again), instances, strict=True)]
    state = pm.accumulate(layers[0], crs="local")
    assert len(state.elements()) == 1
    assert len(pm.accumulate(layers[1], state, crs="local").elements()) == 2


def local(layer, footprints):
    names = sorted(layer["instance"].unique())
    columns = {"drive": "a", "instance": names, "timestamp_ns": 0, "x": 20.0, "y": 0.0, "heading": 90.0}
    return pm.LocalMaps(layer, gpd.GeoDataFrame(columns, geometry=list(footprints), crs=layer.crs))


def test_a_state_of_another_kind_is_refused():
    layer = looks(level(0.0), level(0.1))
    state = pm.accumulate(layer, crs="local")
    with pytest.raises(OptionError, match=r"version 9.* version 1"):
        pm.accumulate(layer, replace(state, version=9), crs="local")
    with pytest.raises(OptionError, match="proximity is 2 m; the state was made with 1 m"):
        pm.accumulate(layer, state, proximity=2.0, crs="local")
    with pytest.raises(CrsError, match="reproject the observations"):
        pm.accumulate(looks(np.add(level(0.0), [5e5, 4e6]), crs="EPSG:32617"), state)


def test_nothing_added_to_nothing_is_nothing():
    empty = looks(level(0.0)).iloc[:0]
    state = pm.accumulate(empty, crs="local")
    assert len(state.elements()) == 0
    assert len(pm.accumulate(looks(level(0.0)), state, crs="local").elements()) == 1
