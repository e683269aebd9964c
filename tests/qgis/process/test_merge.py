"""Merges in the real `qgis_process` give what the command line gives on the same files, feature for feature."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pytest
import shapely

from polymerge_core import MapStore
from tests.cli.layers import EAST, NORTH, UTM, area, draw, line, noisy_copies
from tests.qgis.process.comparing import assert_same, assert_same_merge, command_line, destinations, table
from tests.qgis.process.running import Qgis

COUNTS = ("N_ELEMENTS", "N_OBSERVATIONS", "N_LEFT_OUT")


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A GeoPackage with two layers: what three frames saw of two lines and of one crossing, and a bad guess."""
    path = tmp_path_factory.mktemp("frames") / "frames.gpkg"
    seen = [
        *(line((0, 0.1 * n), (20, 0.2 * n), (40, 0.1 * n)) for n in range(3)),
        *(line((0, 6 - 0.1 * n), (40, 6.2)) for n in range(3)),
        line((0, 0), (0, 0)),
    ]
    draw(
        path,
        seen,
        layer="lines",
        **{
            "class": ["divider"] * 3 + ["boundary"] * 4,
            "instance": ["a", "b", "c", "a", "b", "c", "c"],
            "score": [0.9, 0.8, 0.2, 0.7, 0.6, 0.5, 0.4],
            "paint": ["white", None, "yellow", "", "é ü", "x", "y"],
        },
    )
    crossings = [area((50, 0), (54 + 0.1 * n, 0), (54, 8), (50, 8 + 0.1 * n)) for n in range(3)]
    draw(path, crossings, layer="crossings", **{"class": ["ped_crossing"] * 3, "instance": ["a", "b", "c"]})
    return path


@pytest.fixture(scope="module")
def surveys(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two Shapefiles of one street, with columns of several types."""
    folder = tmp_path_factory.mktemp("surveys")
    columns = {
        "street": ["Lange Straße", None],
        "lanes": [2, 4],
        "width": [6.25, np.nan],
        "surveyed": np.array(["2019-05-01", "2021-06-02"], dtype="datetime64[ms]"),
    }
    return [
        draw(
            folder / f"survey {year}.shp",
            [line((0, shift), (50, shift + 0.4), (90, shift)), line((0, 40), (90, 40 + shift))],
            **columns,
        )
        for year, shift in ((2019, 0.0), (2021, 0.5))
    ]


def test_shapefiles_merge_as_on_the_command_line(qgis: Qgis, surveys: list[Path], tmp_path: Path) -> None:
    expected = tmp_path / "expected.gpkg"
    command_line("merge", *surveys, "-o", expected)

    done = qgis.merge(*surveys, **destinations(tmp_path / "out"))

    assert_same_merge(done.results, expected)
    assert [done.results[name] for name in COUNTS] == [2, 4, 0]
    assert sorted(table(done.results["LINEAGE"])["source_fid"].unique()) == [0, 1]


@pytest.fixture(scope="module")
def merged_frames(qgis: Qgis, frames: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """The results of the frames in QGIS, and the file of the command line, each with a report beside it."""
    folder = tmp_path_factory.mktemp("merged_frames")
    layers = [f"{frames}|layername=lines", f"{frames}|layername=crossings"]
    expected = folder / "expected.gpkg"
    command_line("merge", *layers, "--min-score", 0.3, "-o", expected, "--json", folder / "expected.json")
    done = qgis.merge(*layers, MIN_SCORE=0.3, REPORT=folder / "report.json", **destinations(folder / "out"))
    return done.results, expected


def test_layers_of_a_geopackage_merge_as_on_the_command_line(merged_frames: tuple[dict[str, Any], Path]) -> None:
    results, expected = merged_frames

    assert_same_merge(results, expected, but_for=("source", "drive"))
    areas = table(results["AREAS"])
    assert list(areas["class"]) == ["ped_crossing"]
    assert list(areas["n_observations"]) == [3]
    assert len(table(results["LEFT_OUT"])) == 2
    assert [results[name] for name in COUNTS] == [3, 8, 2]


def test_layers_of_a_geopackage_are_told_apart_by_their_names(merged_frames: tuple[dict[str, Any], Path]) -> None:
    results, expected = merged_frames

    assert list(table(results["LINEAGE"])["source"]) == list(table(expected, "lineage")["source"])
    assert set(table(results["LINEAGE"])["source"]) == {"lines", "crossings"}


def test_the_report_is_that_of_the_command_line(merged_frames: tuple[dict[str, Any], Path]) -> None:
    results, expected = merged_frames
    reports = [
        json.loads(path.read_text(encoding="utf-8"))
        for path in (Path(results["REPORT"]), expected.with_suffix(".json"))
    ]

    for each in reports:
        for by_source in ("footprints", "instance_from"):
            each[by_source] = list(each[by_source].values())
    assert reports[0] == reports[1]
    assert reports[0]["elements"] == 3


def test_the_sample_is_projected_and_merged_as_on_the_command_line(
    qgis: Qgis, sample_folder: Path, tmp_path: Path
) -> None:
    predictions, poses = sample_folder / "predictions.json", sample_folder / "poses.csv"
    (tmp_path / "cli").mkdir()
    local, merged = tmp_path / "cli" / "local_maps.gpkg", tmp_path / "cli" / "merged.gpkg"
    command_line("project", predictions, "--poses", poses, "--crs", UTM, "--drive", "predictions", "-o", local)
    command_line("merge", f"{local}|layername=local_maps", "--min-score", 0.3, "-o", merged)
    ours = {"OUTPUT": tmp_path / "local_maps.gpkg", "INSTANCES": tmp_path / "i.gpkg", "LEFT_OUT": tmp_path / "l.gpkg"}

    projected = qgis.run(
        "polymerge:projectlocalmaps", {"PREDICTIONS": predictions, "POSES": poses, "CRS": UTM, **ours}
    ).results
    known = {"INSTANCES": projected["INSTANCES"], "MIN_SCORE": 0.3}
    done = qgis.merge(projected["OUTPUT"], **known, **destinations(tmp_path / "out"))

    assert_same(projected["OUTPUT"], local, "local_maps")
    assert_same(projected["INSTANCES"], local, "instances")
    assert (projected["N_OBSERVATIONS"], projected["N_INSTANCES"], projected["N_LEFT_OUT"]) == (197, 20, 0)
    assert_same_merge(done.results, merged)
    assert [done.results[name] for name in COUNTS] == [21, 196, len(table(merged, "left_out"))]
    assert set(table(done.results["LEFT_OUT"])["reason"]) == {
        "seen by too few of the local maps that looked there",
        "the score is under min_score (0.3)",
    }


def test_without_footprints_nothing_is_left_out_for_want_of_sightings(
    qgis: Qgis, sample_folder: Path, tmp_path: Path
) -> None:
    local, alone, merged = (tmp_path / f"{name}.gpkg" for name in ("local", "alone", "merged"))
    predictions, poses = sample_folder / "predictions.json", sample_folder / "poses.csv"
    command_line("project", predictions, "--poses", poses, "--crs", UTM, "-o", local)
    table(local, "local_maps").to_file(alone, layer="local_maps")
    command_line("merge", alone, "-o", merged)

    done = qgis.merge(f"{local}|layername=local_maps", **destinations(tmp_path / "out"))

    assert_same_merge(done.results, merged, but_for=("source",))
    assert done.results["N_LEFT_OUT"] == 0


def test_the_network_of_the_sample_is_that_of_the_command_line(qgis: Qgis, sample_folder: Path, tmp_path: Path) -> None:
    local, expected = tmp_path / "local_maps.gpkg", tmp_path / "expected.gpkg"
    predictions, poses = sample_folder / "predictions.json", sample_folder / "poses.csv"
    command_line("project", predictions, "--poses", poses, "--crs", UTM, "-o", local)
    command_line("network", local, "-o", expected)
    outputs = {"OUTPUT": tmp_path / "o.gpkg", "EDGES": tmp_path / "e.gpkg"}

    done = qgis.run("polymerge:mergenetwork", {"LOCAL_MAPS": f"{local}|layername=local_maps", **outputs}).results

    assert_same(done["OUTPUT"], expected, "observations")
    assert_same(done["EDGES"], expected, "edges")
    assert done["N_COMPONENTS"] == table(done["OUTPUT"])["component"].nunique()


def test_an_evaluation_of_the_sample_is_that_of_the_command_line(
    qgis: Qgis, sample_folder: Path, tmp_path: Path
) -> None:
    local, merged, expected = (tmp_path / f"{name}.gpkg" for name in ("local_maps", "merged", "expected"))
    predictions, poses = sample_folder / "predictions.json", sample_folder / "poses.csv"
    reference = f"{sample_folder / 'reference.gpkg'}|layername=ground_truth"
    command_line("project", predictions, "--poses", poses, "--crs", UTM, "-o", local)
    command_line("merge", local, "-o", merged)
    # QGIS hands layers over one by one, so that it has no footprints beside the observations.
    seen = tmp_path / "seen.gpkg"
    table(local, "local_maps").to_file(seen, layer="local_maps")
    command_line("evaluate", merged, "--reference", reference, "--local", seen, "--layers", expected)
    outputs = {name: tmp_path / f"{name}.gpkg" for name in ("OUTPUT", "EVALUATED", "MEASURES")}
    layers = {"MERGED": f"{merged}|layername=elements", "REFERENCE": reference}
    layers["LOCAL_MAPS"] = f"{seen}|layername=local_maps"

    done = qgis.run("polymerge:evaluatemap", {**layers, **outputs, "PAGE": tmp_path / "page.html"}).results

    assert_same(done["OUTPUT"], expected, "errors")
    assert_same(done["EVALUATED"], expected, "evaluated")
    assert_same(done["MEASURES"], expected, "measures")
    elements = len(table(merged, "elements"))
    assert (done["N_ELEMENTS"], done["N_REFERENCE"]) == (elements, len(table(sample_folder / "reference.gpkg")))
    assert "<h2>divider</h2>" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_a_stored_map_and_its_changes_are_those_of_the_command_line(
    qgis: Qgis, sample_folder: Path, tmp_path: Path
) -> None:
    local, expected, wanted = (tmp_path / f"{name}.gpkg" for name in ("local_maps", "expected", "wanted"))
    predictions, poses = sample_folder / "predictions.json", sample_folder / "poses.csv"
    command_line("project", predictions, "--poses", poses, "--crs", UTM, "-o", local)
    command_line("update", expected, local, "--create")
    command_line("changes", expected, "-o", wanted)
    stored, changes = tmp_path / "town.gpkg", tmp_path / "changes.gpkg"
    layers = {"LOCAL_MAPS": f"{local}|layername=local_maps", "INSTANCES": f"{local}|layername=instances"}

    done = qgis.run("polymerge:updatemap", {"MAP": stored, **layers}).results
    told = qgis.run("polymerge:mapchanges", {"MAP": stored, "CHANGES": changes}).results

    assert (done["MAP"], done["REVISION"]) == (str(stored), 1)
    assert table(stored, "elements").equals(table(expected, "elements"))
    assert_same(told["CHANGES"], wanted, "changes")
    assert done["ADDED"] == told["ADDED"] == len(table(expected, "elements"))
    assert MapStore(stored).verify() == []


@pytest.fixture(scope="module")
def two_systems(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """One road in metres and in degrees."""
    folder = tmp_path_factory.mktemp("systems")
    roads = gpd.GeoSeries(noisy_copies(2, 20), crs=UTM)
    return [draw(folder / "metres.gpkg", roads[:1]), draw(folder / "degrees.gpkg", roads[1:].to_crs(4326), crs=4326)]


@pytest.mark.parametrize(
    ("wanted", "crs"), [({}, UTM), ({"OUT_CRS": "EPSG:25832"}, "EPSG:25832")], ids=["the first layer's", "OUT_CRS"]
)
def test_layers_in_two_systems_become_one_line_in(
    qgis: Qgis, two_systems: list[Path], tmp_path: Path, wanted: dict[str, str], crs: str
) -> None:
    expected = tmp_path / "expected.gpkg"
    options = [f"--out-crs={value}" for value in wanted.values()]
    command_line("merge", *two_systems, *options, "--proximity", 3, "-o", expected)

    done = qgis.merge(*two_systems, PROXIMITY=3, **wanted, **destinations(tmp_path / "out"))

    assert_same_merge(done.results, expected)
    assert done.results["N_ELEMENTS"] == 1
    assert table(done.results["OUTPUT"]).crs == crs


def test_only_what_a_filter_lets_through_is_merged(qgis: Qgis, tmp_path: Path) -> None:
    roads, exported = tmp_path / "roads.gpkg", tmp_path / "exported"
    exported.mkdir()
    kinds = ["a", "b", "a", "b", "a", "b"]
    draw(roads, noisy_copies(6, 10), layer="x", kind=kinds)
    kept = table(roads)
    draw(exported / "roads.gpkg", kept.geometry[kept["kind"] == "a"], layer="x", kind=["a"] * 3)
    expected = tmp_path / "expected.gpkg"
    command_line("merge", exported / "roads.gpkg", "-o", expected)

    done = qgis.merge(f"{roads}|layername=x|subset=\"kind\" = 'a'", **destinations(tmp_path / "out"))

    assert_same(done.results["OUTPUT"], expected, "elements")
    assert sorted(table(done.results["LINEAGE"])["source_fid"]) == [1, 3, 5]
    assert done.results["N_OBSERVATIONS"] == 3


def test_merges_into_a_main_map_keep_its_ids_and_never_give_one_twice(qgis: Qgis, tmp_path: Path) -> None:
    first, second, third = (tmp_path / f"{name}.gpkg" for name in ("first", "second", "third"))
    pieces = [line((0, 0), (40, 0)), line((46, 0), (90, 0)), area((50, 20), (54, 20), (54, 28), (50, 28))]
    old = draw(tmp_path / "old.gpkg", pieces, **{"class": ["divider", "divider", "ped_crossing"]})
    command_line("merge", old, "-o", first)
    bridge = draw(tmp_path / "bridge.gpkg", [line((10, 0.5), (80, 0.5)), line((70, 50), (90, 50))])
    more = draw(tmp_path / "more.gpkg", [line((70, 51), (90, 51)), line((0, 90), (40, 90))])
    options = ["--class-name", "divider", "--proximity", 2]
    command_line("merge", bridge, "--main-map", first, *options, "-o", second)
    command_line("merge", more, "--main-map", second, *options, "-o", third)
    chosen = {"CLASS_NAME": "divider", "PROXIMITY": 2}

    into_first = qgis.merge(
        bridge,
        **chosen,
        MAIN_MAP=f"{first}|layername=elements",
        MAIN_MAP_AREAS=f"{first}|layername=elements_areas",
        **destinations(tmp_path / "second"),
    ).results
    into_second = qgis.merge(
        more,
        **chosen,
        MAIN_MAP=into_first["OUTPUT"],
        MAIN_MAP_AREAS=into_first["AREAS"],
        MAIN_MAP_ALIASES=into_first["ID_ALIASES"],
        **destinations(tmp_path / "third"),
    ).results

    assert_same_merge(into_first, second)
    assert_same_merge(into_second, third)
    assert len(table(into_first["ID_ALIASES"])) == 1
    known = {*table(into_first["OUTPUT"])["element_id"], *table(into_first["ID_ALIASES"])["old_id"]}
    elements = table(into_second["OUTPUT"])
    assert set(elements.loc[elements["n_observations"] == 1, "element_id"]).isdisjoint(known)
    assert set(table(into_second["AREAS"])["element_id"]) == set(table(first, "elements_areas")["element_id"])


def test_ten_noisy_tracks_with_an_id_alone_become_one_line(
    qgis: Qgis, rng: np.random.Generator, tmp_path: Path
) -> None:
    x = np.linspace(0.0, 400.0, 41)
    tracks = [
        shapely.linestrings(EAST + x, NORTH + 30 * np.sin(x / 90) + rng.normal(0, 2.5) + rng.normal(0, 1.5, x.size))
        for _ in range(10)
    ]
    path, expected = draw(tmp_path / "tracks.shp", tracks, id=np.arange(10)), tmp_path / "expected.gpkg"
    command_line("merge", path, "--proximity", 15, "-o", expected)

    done = qgis.merge(path, PROXIMITY=15, **destinations(tmp_path / "out"))

    assert_same_merge(done.results, expected)
    assert done.results["N_ELEMENTS"] == 1
    assert list(table(done.results["OUTPUT"])["n_observations"]) == [10]
