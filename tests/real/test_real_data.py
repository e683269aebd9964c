"""The command line on real maps, real drives and real predictions: it ends, and nothing is lost."""

from __future__ import annotations

import json

import geopandas as gpd
import numpy as np
import pytest
import shapely

import polymerge_core as pm
from benchmarks import simulate_drive
from benchmarks.dynamics import drives
from benchmarks.scenarios import PITTSBURGH, av2_road, av2_scenarios
from polymerge_core.__main__ import main
from polymerge_core.io import read_table
from tests.core.test_consensus_state import distances, some

AV2 = {
    "PIT": ("7fab2350-7eaf-3b7e-a39d-6937a4c1bede", "583710.0070,4477259.9998"),
    "MIA": ("3b3570b4-7b0b-3268-a571-b0889dbf40b6", "580560.0088,2850959.9999"),
}


def run(*arguments):
    """Run the command line and require success."""
    assert main([str(argument) for argument in arguments]) == 0


def assert_nothing_lost(local_maps, merged):
    """Every observation's length is covered exactly once by lineage and left_out."""
    tables = [read_table(merged, name) for name in ("lineage", "left_out")]
    covered = {}
    for table in tables:
        length = table["to_m"] - table["from_m"]
        for source, fid, metres in zip(table["source"], table["source_fid"], length, strict=True):
            covered[source, fid] = covered.get((source, fid), 0.0) + metres
    expected = {
        (maps.source, fid): metres
        for maps in pm.read_local_maps(local_maps)
        for fid, metres in maps.observations.length.items()
    }
    assert covered.keys() == expected.keys()
    assert max(abs(covered[key] - expected[key]) for key in expected) < 1e-6


@pytest.mark.parametrize("city", AV2)
def test_simulated_frames_of_a_real_drive_through_a_real_map(real_data, tmp_path, city):
    log, offset = AV2[city]
    folder = real_data / "av2" / log
    truth = gpd.read_file(folder / "ground_truth.gpkg")
    simulated = ["--truth", folder / "ground_truth.gpkg", "--poses", folder / "poses.csv", "--offset", offset]
    assert simulate_drive.main([*map(str, simulated), "--seed", "1", "-o", str(tmp_path)]) == 0
    local, merged = tmp_path / "local.gpkg", tmp_path / "merged.gpkg"
    pose = ["--pose-kind", "offset", "--pose-offset", offset, "--crs", "EPSG:32617"]
    run("project", tmp_path / "predictions.json", "--poses", tmp_path / "poses.csv", *pose, "-o", local)
    run("merge", local, "-o", merged, "--json", tmp_path / "report.json")

    observations, instances = pm.read_layers(local)["local_maps"], pm.read_layers(local)["instances"]
    assert len(instances) == 15
    # Positions, turns and the offset are right when dividers lie on the true ones, but for the simulated error.
    for data in (observations, pm.read_layers(merged)["elements"]):
        dividers = data[data["class"] == "divider"]
        points = shapely.points(shapely.get_coordinates(dividers.geometry.to_numpy()))
        distance = shapely.distance(points, truth[truth["class"] == "divider"].union_all())
        assert np.median(distance) < 0.5
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["observations"] == len(observations)
    assert 0 < report["elements"] < len(observations) / 4
    assert_nothing_lost([local], merged)


def test_predictions_of_persformer(real_data, tmp_path):
    folder = real_data / "openlane_persformer"
    local, merged = tmp_path / "local.gpkg", tmp_path / "merged.gpkg"
    poses = folder / "poses.csv"
    run("project", folder / "predictions.json", "--poses", poses, "--crs", "local", "-o", local)
    run("merge", local, "-o", merged)
    observations = pm.read_layers(local)["local_maps"]
    assert len(observations) == 474
    assert set(observations["class"]) == {"divider", "boundary"}
    reference = gpd.read_file(folder / "reference.gpkg")
    points = shapely.points(shapely.get_coordinates(observations.geometry.to_numpy()))
    assert np.median(shapely.distance(points, reference.union_all())) < 1.0
    assert_nothing_lost([local], merged)


def test_fourteen_drives_together(real_data, tmp_path, capsys):
    """One component holds most of the road under the published rule; it must end all the same."""
    files = []
    for drive in sorted((real_data / "deecamp").glob("*/predictions.json")):
        files.append(tmp_path / f"{drive.parent.name}.gpkg")
        run("project", drive, "--poses", drive.parent / "poses.csv", "--crs", "local", "-o", files[-1])
    assert len(files) == 14
    capsys.readouterr()
    merged = tmp_path / "merged.gpkg"
    told = ("--json", tmp_path / "report.json", "--progress", "json")
    run("merge", *files, "--method", "polymerge", "-o", merged, *told)
    fractions = [json.loads(line)["fraction"] for line in capsys.readouterr().err.splitlines() if line[0] == "{"]
    assert fractions == sorted(fractions)
    assert len(fractions) > 50
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["observations"] == 21679
    assert report["largest_set"] > 10000
    assert_nothing_lost(files, merged)


def test_phone_detections_in_utm(real_data, tmp_path):
    folder = real_data / "tehran_laneaf"
    local, merged = tmp_path / "local.gpkg", tmp_path / "merged.gpkg"
    poses = folder / "poses.csv"
    run("project", folder / "predictions.json", "--poses", poses, "--crs", "EPSG:32639", "-o", local)
    run("merge", local, "-o", merged)
    assert len(pm.read_layers(local)["instances"]) == 372
    assert pm.read_layers(merged)["elements"].crs.to_epsg() == 32639
    assert_nothing_lost([local], merged)


def test_three_sources_of_one_street_network(real_data, tmp_path):
    roads, merged = real_data / "multi_source_roads" / "washington_dc_roads.gpkg", tmp_path / "merged.gpkg"
    run("merge", roads, "--instance-field", "source", "--proximity", 5, "-o", merged)
    elements = pm.read_layers(merged)["elements"]
    assert 0 < len(elements) < 738
    assert {"highway", "name"} <= set(elements.columns)
    assert_nothing_lost([roads], merged)


def test_what_is_known_and_what_is_added_give_what_both_give_at_once(real_data):
    apart = []
    for scenario in [each for seed in (1, 2, 3) for each in av2_scenarios(real_data, seed=seed)]:
        (local,) = scenario.local
        half = len(local.instances) // 2
        parts = some(local, np.arange(half)), some(local, np.arange(half, len(local.instances)))
        together = pm.accumulate(list(parts)).elements()
        apart.append(distances(together, pm.accumulate(parts[1], pm.accumulate(parts[0])).elements()))
    assert np.median(np.concatenate(apart)) <= 0.05
    assert np.quantile(np.concatenate(apart), 0.95) <= 0.20


@pytest.mark.parametrize("last", [18, 45])
def test_sixteen_drives_past_a_fork_draw_each_divider_once(real_data, last):
    """A short divider runs into a long one; looks at either went to the other, and the long one was drawn twice."""
    road = av2_road(real_data, PITTSBURGH)
    local = [maps for drive in drives(road, road, 7, None, last)[-16:] for maps in drive.local]
    merged = pm.merge(local).elements
    result = pm.evaluate(merged, road.truth, local_maps=local[:1])
    assert result.value("divider", "duplication") <= 1.05
    assert result.value("divider", "fragments") <= 1.05
