"""What the library is compared with: known answers on maps one can draw on paper, and rows for what is not there."""

from __future__ import annotations

import shutil
import sys

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely

import polymerge_core as pm
from benchmarks import peers, rivals
from benchmarks.peers import PEERS, Drawn, Peer, draw, draw_all, measure, table
from benchmarks.rivals.centreline import centreline
from benchmarks.scenarios import Scenario
from polymerge_core.options import METHODS

UTM, ORIGIN = "EPSG:32632", (5e5, 5.3e6)


def seen(*rows, **columns):
    """Observations from (class, score, WKT)."""
    classes, scores, wkt = zip(*rows, strict=True)
    shapes = gpd.GeoSeries.from_wkt(list(wkt), crs=UTM)
    return gpd.GeoDataFrame({"class": classes, "score": scores, **columns}, geometry=shapes)


def divider(y, *, score=0.9, start=0, stop=40):
    return ("divider", score, f"LINESTRING ({start} {y}, {stop} {y})")


def backwards(row):
    return (*row[:2], shapely.from_wkt(row[2]).reverse().wkt)


def crossing(*, x=0.0, roll=0, turn=False, size=4.0):
    corners = np.roll([[x, 0], [x + size, 0], [x + size, 10], [x, 10]], roll, axis=0)
    ring = np.concatenate([corners, corners[:1]])
    return ("ped_crossing", 0.9, shapely.LineString(ring[::-1] if turn else ring).wkt)


def oracle(observations, truth, *, ids=None, whole=None):
    truth = truth.assign(element_id=range(len(truth)))
    ids = pd.Series(np.zeros(len(observations), int) if ids is None else ids, dtype=object)
    whole = pd.Series(np.full(len(observations), fill_value=True) if whole is None else whole)
    return rivals.average_true_groups(observations, ids, truth, whole)


@pytest.fixture
def scenario():
    """Two looks at a divider and a crossing, and a false divider."""
    looks = seen(divider(0.3), divider(-0.3), crossing(), crossing(x=0.2), divider(20, score=0.4))
    looks = looks.assign(drive="a", instance=[0, 1, 0, 1, 0])
    truth = seen(divider(0), crossing(x=0.1)).assign(element_id=[0, 1])
    looks, truth = (frame.set_geometry(frame.translate(*ORIGIN)) for frame in (looks, truth))
    frames = gpd.GeoDataFrame(
        {"drive": "a", "instance": [0, 1]}, geometry=[shapely.Point(ORIGIN).buffer(99)] * 2, crs=looks.crs
    )
    local = pm.LocalMaps(looks, frames)
    return Scenario("drawn", truth, [local], pd.Series([0, 0, 1, 1, None], dtype=object))


# Suppression


def test_concatenation_is_every_observation_as_it_is():
    looks = seen(divider(0), divider(0.3), crossing())
    made = rivals.concatenate(looks)
    assert made.geometry.geom_equals(looks.geometry).all()
    assert list(made.columns) == ["class", "score", "geometry"]


def test_of_two_copies_the_better_one_is_kept():
    made = rivals.keep_best_score(seen(divider(0, score=0.6), divider(0.3, score=0.8)))
    assert made["score"].tolist() == [0.8]


@pytest.mark.parametrize(
    "other",
    [
        pytest.param(divider(1.2), id="farther than 1 m"),
        pytest.param(("boundary", 0.9, "LINESTRING (0 0, 40 0)"), id="of another class"),
        pytest.param(divider(0, start=0, stop=4), id="a tenth of it"),
    ],
)
def test_who_is_no_copy_is_kept(other):
    assert len(rivals.keep_best_score(seen(divider(0), other))) == 2


def test_who_was_suppressed_suppresses_nobody():
    made = rivals.keep_best_score(seen(divider(0, score=0.9), divider(0.8, score=0.8), divider(1.6, score=0.7)))
    assert made["score"].tolist() == [0.9, 0.7]


def test_map_nms_keeps_the_longest_of_all_that_come_within_half_a_metre_anywhere():
    made = rivals.keep_longest(seen(divider(0, stop=40), divider(0.4, start=39, stop=60), divider(0.6, stop=20)))
    assert made.length.tolist() == [40, 20]


# The oracle


def test_the_average_of_three_shifted_copies_is_the_middle_one():
    looks = seen(divider(-0.4), backwards(divider(0)), divider(0.4))
    (made,) = oracle(looks, seen(divider(0.1))).geometry
    assert made.length == pytest.approx(40)
    assert shapely.hausdorff_distance(made, looks.geometry[1]) == pytest.approx(0, abs=1e-9)


def test_the_average_reaches_as_far_as_any_observation():
    looks = seen(divider(0, start=0, stop=20), divider(0, start=10, stop=30))
    (made,) = oracle(looks, seen(divider(0))).geometry
    assert made.bounds == pytest.approx((0, 0, 30, 0), abs=1e-9)


def test_where_nobody_looked_there_is_a_gap_and_a_false_detection_is_left_out():
    looks = seen(divider(0, stop=10, score=0.8), divider(0, start=20, stop=30, score=0.6), divider(9))
    made = oracle(looks, seen(divider(0)), ids=[0, 0, None])
    assert sorted(made.length.round(6)) == [10, 10]
    assert made["score"].tolist() == pytest.approx([0.7, 0.7])


def test_a_ring_seen_all_round_comes_out_closed_and_the_sides_of_a_narrow_island_stay_apart():
    island = "LINESTRING (0 0, 40 0, 40 1.5, 0 1.5, 0 0)"
    parts = ["LINESTRING (30 -1, 40 -1, 40 0.5, 5 0.5)", "LINESTRING (39.5 1.5, 0 1.5, 0 0, 32 0)"]
    looks = seen(*(("boundary", 0.9, part) for part in parts))
    (made,) = oracle(looks, seen(("boundary", 1.0, island))).geometry
    assert made.is_closed
    # On the far side one look is 1 m too low, nearer to the near side than to its own.
    assert shapely.distance(made, shapely.Point(10, 1)) < 0.1


def test_corners_are_averaged_from_whichever_corner_and_way_round_they_start():
    looks = seen(crossing(), crossing(x=0.2, roll=1), crossing(x=0.4, roll=3, turn=True))
    (made,) = oracle(looks, seen(crossing())).geometry
    assert made.normalize().equals_exact(shapely.box(0.2, 0, 4.2, 10).normalize(), 1e-9)


def test_an_area_that_was_never_seen_whole_is_the_most_that_was_seen_of_it():
    looks = seen(crossing(size=2), crossing(size=3))
    (made,) = oracle(looks, seen(crossing()), whole=[False, False]).geometry
    assert made.area == pytest.approx(30)


# Centre lines


def test_the_centre_line_of_two_buffers_is_between_them_from_end_to_end():
    made = rivals.buffer_centreline(seen(divider(0, score=0.5), divider(0.6, score=0.7)))
    (line,) = made.geometry
    assert shapely.hausdorff_distance(line, shapely.LineString([(0, 0.3), (40, 0.3)])) < 0.5
    assert made["score"].tolist() == pytest.approx([0.6])


def test_a_fork_has_three_branches():
    fork = shapely.union_all(shapely.from_wkt(["LINESTRING (0 0, 20 0, 30 10)", "LINESTRING (20 0, 30 -10)"]))
    assert len(centreline(fork.buffer(0.5))) == 3


def test_areas_are_dissolved():
    made = rivals.buffer_centreline(seen(crossing(), crossing(x=2), crossing(x=20)))
    assert sorted(made.area) == [40, 60]


# Rows


def test_every_method_of_the_library_has_a_row():
    assert {f"method {method}" for method in METHODS} <= {peer.name for peer in PEERS}


@pytest.mark.parametrize(("name", "package"), [("neatnet", "neatnet"), ("parenx voronoi", "parenx")])
def test_a_package_that_is_missing_is_named_in_its_row(name, package, scenario, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    (peer,) = (peer for peer in PEERS if peer.name == name)
    made = {name: draw(peer, scenario)}
    assert f"{name:<20}  not installed: pip install {package}" in table(measure([scenario], [made]))


def test_a_qgis_that_is_missing_is_named_in_its_row(scenario, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda _: None)
    (peer,) = (peer for peer in PEERS if peer.name == "QGIS native tools")
    assert draw(peer, scenario).reason.startswith("not installed: ")


def test_the_figures_of_a_map_are_those_of_evaluate(scenario):
    (peer,) = (peer for peer in PEERS if peer.name == "oracle average")
    figures = measure([scenario], draw_all([scenario], [peer])).set_index("class")
    assert figures.loc["divider", ["n", "DF", "AP", "F1", "dupl"]].tolist() == pytest.approx([1, 0, 1, 1, 1])
    assert figures.loc["ped_crossing", "IoU"] == pytest.approx(1)
    assert figures["s"].gt(0).all()


def test_nothing_drawn_is_a_failure_but_for_areas_of_who_draws_lines_alone(scenario):
    nothing = scenario.observations.iloc[:1][["class", "score", "geometry"]]
    drawn = {"lines": Drawn(nothing, 1.0, areas=False), "all": Drawn(nothing, 1.0)}
    figures = measure([scenario], [drawn]).set_index(["peer", "class"])
    assert figures.loc[("all", "ped_crossing"), ["n", "AP"]].tolist() == [0, 0]
    assert np.isnan(figures.loc[("lines", "ped_crossing"), "AP"])
    assert "leaves areas out" in table(figures.reset_index())


def test_a_run_in_which_a_peer_fails_is_left_out_of_the_means_and_told(scenario):
    calls = iter([False, True])

    def sometimes(drawn):
        if next(calls):
            raise rivals.RivalError("it did not work")
        return rivals.concatenate(drawn.observations)

    maps = [{"now and then": draw(Peer("now and then", sometimes), scenario)} for _ in range(2)]
    assert "in 1 of 2 runs; it did not work" in table(measure([scenario, scenario], maps))


def test_the_command_prints_a_table_and_writes_the_figures(tmp_path, capsys, monkeypatch):
    arguments = ["peers", "--only", "raw concatenation", "longest (Map NMS)", "-o", str(tmp_path / "peers.json")]
    monkeypatch.setattr(sys, "argv", arguments)
    assert peers.main() == 0
    assert capsys.readouterr().out.count("longest (Map NMS)") == 3
    assert len(pd.read_json(tmp_path / "peers.json")) == 6
