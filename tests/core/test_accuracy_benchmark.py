"""What the consensus is held to: tables one can make up, in which each rule can fail, and a look one can draw."""

from __future__ import annotations

import json
import sys

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely

import polymerge_core as pm
from benchmarks import accuracy, peers
from benchmarks.rules import ORACLE, SINGLE, SUBJECT, Verdict, judge, judge_growth
from benchmarks.scenarios import Scenario, town_road

UTM, ORIGIN = "EPSG:32632", (5e5, 5.3e6)

CLEAN, BUSY = "longest", "concatenation"
#: A table in which every rule is met, the same for each class.
COLUMNS = ["DF", "PCM", "AP", "F1.5", "F1", "recall", "dupl", "fragm", "zigzag", "(true)", "IoU"]
GOOD = {
    SINGLE: [0.80, 0.6, 0.5, 0.7, 0.8, 0.8, 1.0, 1.0, 0.02, 0.01, 0.70],
    CLEAN: [0.60, 0.5, 0.6, 0.8, 0.8, 0.8, 1.2, 1.2, 0.02, 0.01, 0.60],
    BUSY: [0.50, 0.5, 0.9, 0.8, 0.8, 0.8, 6.0, 7.0, 0.02, 0.01, 0.80],
    SUBJECT: [0.40, 0.3, 0.8, 0.9, 0.9, 0.9, 1.0, 1.0, 0.015, 0.01, 0.85],
    ORACLE: [0.40, 0.3, 0.8, 0.9, 0.9, 0.9, 1.0, 1.0, 0.07, 0.01, 0.85],
}
CLASSES = ("ped_crossing", "divider", "boundary")
AREA, LINES = ("ped_crossing",), ("divider", "boundary")


def made_up(*changes):
    """The good table with (class, peer, column, value) changed."""
    rows = [
        {"run": 0, "class": name, "peer": peer, **dict(zip(COLUMNS, values, strict=True))}
        for name in CLASSES
        for peer, values in GOOD.items()
    ]
    table = pd.DataFrame(rows).set_index(["class", "peer"])
    for name, peer, column, value in changes:
        table.loc[(name, peer), column] = value
    return table.reset_index()


def failed(*changes, independent=True):
    return [str(each) for each in judge(made_up(*changes), independent=independent) if each.outcome != "met"]


# The rules


def test_a_good_table_meets_every_rule():
    verdicts = judge(made_up(), independent=True)
    # Nine rules for every class; two more for areas, two for lines, and one for dividers.
    assert len(verdicts) == 3 * 9 + 2 + 2 * 2 + 1
    assert failed() == []


@pytest.mark.parametrize(
    ("classes", "peer", "column", "value", "rule"),
    [
        pytest.param(CLASSES, SINGLE, "AP", 0.8, "AP above the single", id="AP no better than one look"),
        pytest.param(CLASSES, CLEAN, "AP", 0.8, "AP above every peer", id="AP no better than a clean peer"),
        pytest.param(CLASSES, ORACLE, "AP", 0.83, "AP at most 0.02 under", id="AP under the oracle"),
        pytest.param(CLASSES, SUBJECT, "F1.5", 0.87, "F1.5 at most 0.02 under", id="F1 at half a metre"),
        pytest.param(CLASSES, SUBJECT, "F1", 0.87, "F1 at most 0.02 under", id="F1 at a metre"),
        pytest.param(CLASSES, SUBJECT, "recall", 0.87, "recall at most 0.02 under", id="recall"),
        pytest.param(CLASSES, ORACLE, "DF", 0.37, "DF at most 1.05 of the oracle", id="DF beyond the oracle"),
        pytest.param(("divider",), SINGLE, "DF", 0.72, "DF at most 0.55 of the single", id="DF of averaged dividers"),
        pytest.param(AREA, ORACLE, "IoU", 0.86, "IoU not under the oracle", id="IoU under the oracle"),
        pytest.param(AREA, SINGLE, "IoU", 0.85, "IoU above the single", id="IoU no better than one look"),
        pytest.param(LINES, SINGLE, "PCM", 0.3, "PCM under the single", id="PCM no better than one look"),
        pytest.param(CLASSES, SUBJECT, "dupl", 1.06, "duplication", id="drawn more than once"),
        pytest.param(CLASSES, SUBJECT, "fragm", 1.06, "fragments", id="in pieces"),
        pytest.param(LINES, SUBJECT, "zigzag", 0.021, "zigzag", id="a zigzag"),
    ],
)
def test_each_rule_can_fail_by_itself(classes, peer, column, value, rule):
    for name in CLASSES:
        found = failed((name, peer, column, value))
        assert len(found) == (name in classes)
        for line in found:
            assert line.startswith(f"{name} {rule}")
            assert line.endswith(": not met")


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param([(SUBJECT, "dupl", 1.12), (ORACLE, "dupl", 1.1)], id="the oracle draws as often"),
        pytest.param([(SUBJECT, "fragm", 2.02), (ORACLE, "fragm", 2.0)], id="so does the oracle break"),
        pytest.param([(SUBJECT, "zigzag", 0.05), (SUBJECT, "(true)", 0.04)], id="the true lines turn as much"),
        pytest.param([(SUBJECT, "F1", 0.88)], id="just 0.02 under the oracle"),
        pytest.param([(CLEAN, "AP", np.nan), (BUSY, "AP", 0.7), (BUSY, "dupl", 1.0)], id="a peer without a map"),
    ],
)
def test_limits_that_a_true_map_or_the_oracle_moves(changes):
    assert failed(*(("divider", *change) for change in changes)) == []


def test_a_peer_that_draws_too_often_is_told_of_and_not_compared():
    (line,) = [str(each) for each in judge(made_up(), independent=True) if each.rule.startswith("divider AP above ev")]
    assert line == (
        "divider AP above every peer that draws a place at most 1.2 times, the best being longest "
        "(not compared: concatenation 6.00): 0.800 vs > 0.600: met"
    )


def test_without_a_peer_to_compare_with_nothing_is_judged():
    (line,) = failed(("divider", CLEAN, "dupl", 1.21))
    assert line.endswith("0.800 vs > nan: not judged")


def test_what_the_consensus_does_not_draw_at_all_fails():
    assert failed(("boundary", SUBJECT, "DF", np.nan)) == [
        "boundary DF at most 1.05 of the oracle's: nan vs <= 0.420: not met"
    ]


def test_errors_that_frames_have_in_common_need_not_be_averaged_away():
    assert failed(("divider", SINGLE, "DF", 0.72), independent=False) == []


def test_means_over_the_runs_are_judged():
    worse = made_up(("divider", SUBJECT, "recall", 0.87)).assign(run=1)
    better = made_up(("divider", SUBJECT, "recall", 0.91)).assign(run=2)
    assert all(each.outcome == "met" for each in judge(pd.concat([worse, better]), independent=True))


def test_the_sum_of_a_limit_does_not_fail_by_its_last_bit():
    assert Verdict("sum", 0.3, ">=", 0.1 + 0.2).outcome == "met"
    assert Verdict("sum", 0.3, "<", 0.1 + 0.2).outcome == "not met"


def test_growth_is_judged_road_by_road_over_the_seeds():
    columns = {"road": ["a", "a", "b"], "way": "ten drives", "seed": [1, 2, 1], "few": [10, 10, 10]}
    first, second = judge_growth(pd.DataFrame({**columns, "many": [14, 12, 14]}))
    assert str(first) == "a, elements of ten drives over those of 15 frames (14/10, 12/10): 1.300 vs <= 1.300: met"
    assert second.outcome == "not met"


# A single instance


def drawn(rows, *, ids):
    """What two frames saw that look at the same 100 m x 20 m, from (instance, class, WKT)."""
    frames, classes, wkt = zip(*rows, strict=True)
    shapes = gpd.GeoSeries.from_wkt(list(wkt), crs=UTM).translate(*ORIGIN)
    seen = gpd.GeoDataFrame({"class": classes, "drive": "a", "instance": frames, "score": 0.9}, geometry=shapes)
    box = gpd.GeoSeries([shapely.box(0, 0, 100, 20)] * 2, crs=UTM).translate(*ORIGIN)
    instances = gpd.GeoDataFrame({"drive": "a", "instance": ["0", "1"]}, geometry=box)
    truth = {
        "divider": "LINESTRING (0 10, 100 10)",
        "ped_crossing": "LINESTRING (40 2, 44 2, 44 8, 40 8, 40 2)",
        "cut": "LINESTRING (96 2, 104 2, 104 8, 96 8, 96 2)",
    }
    lines = gpd.GeoSeries.from_wkt(list(truth.values()), crs=UTM).translate(*ORIGIN)
    columns = {"element_id": list(truth), "class": ["divider", "ped_crossing", "ped_crossing"]}
    return Scenario(
        "drawn",
        gpd.GeoDataFrame(columns, geometry=lines),
        [pm.LocalMaps(seen, instances)],
        pd.Series(ids, dtype=object),
    )


def test_a_single_instance_is_the_mean_over_the_frames_each_by_itself():
    looks = [("0", "divider", "LINESTRING (0 10.2, 50 10.2)"), ("1", "divider", "LINESTRING (0 10.4, 90 10.4)")]
    divider = accuracy.single_instances(drawn(looks, ids=["divider"] * 2))["divider"]
    assert divider["DF"] == pytest.approx(0.3)
    # Together they would be drawn twice over the first 50 m.
    assert [divider[column] for column in ("n", "AP", "dupl", "fragm")] == pytest.approx([1, 1, 1, 1])


def test_a_crossing_that_the_frame_cuts_off_counts_in_neither_df_nor_iou_of_a_single_instance():
    looks = [
        ("0", "ped_crossing", "LINESTRING (40 2, 44 2, 44 8, 40 8, 40 2)"),
        ("0", "ped_crossing", "LINESTRING (96 2, 100 2, 100 8, 96 8, 96 2)"),
        ("1", "divider", "LINESTRING (0 10, 90 10)"),
    ]
    crossing = accuracy.single_instances(drawn(looks, ids=["ped_crossing", "cut", "divider"]))["ped_crossing"]
    assert [crossing["DF"], crossing["IoU"]] == pytest.approx([0, 1])
    # Both frames count towards their number.
    assert crossing["n"] == 1


# The command


def test_the_command_prints_tables_and_verdicts_and_writes_them(tmp_path, capsys, monkeypatch):
    def short(seed, noise=None):
        return town_road().drive("town", seed=seed, noise=noise, count=2, start=40)

    monkeypatch.setattr(peers, "town", short)
    monkeypatch.setattr(accuracy, "MORE", 3)
    written = tmp_path / "accuracy.json"
    arguments = ["accuracy", "--seeds", "1", "--only", "raw concatenation", "longest (Map NMS)", "-o", str(written)]
    monkeypatch.setattr(sys, "argv", arguments)
    assert accuracy.main() == 0
    told = capsys.readouterr()
    # One table a class and noise model; the consensus and the oracle are always there.
    for peer in (SINGLE, "longest (Map NMS)", SUBJECT, ORACLE):
        assert sum(line.startswith(f"{peer:<20} ") for line in told.out.splitlines()) == 6
    assert "PCM" in told.out
    assert "town, elements of one drive of 45 frames over those of 15 frames" in told.out
    assert "town, elements of 3 drives of 15 frames over those of 15 frames" in told.out
    assert "measuring, town (1 of 1)" in told.err
    figures = json.loads(written.read_text(encoding="utf-8"))
    assert list(figures) == list(accuracy.NOISES)
    independent, common = (len(figures[noise]["verdicts"]) for noise in accuracy.NOISES)
    # With errors in common no share of a single instance's is asked for.
    assert independent == common + 1
    outcomes = {row["outcome"] for table in figures.values() for row in table["verdicts"]}
    assert outcomes <= {"met", "not met", "not judged"}
