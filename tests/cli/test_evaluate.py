"""The command `evaluate`: what it writes and prints, and what it says of bad input."""

from __future__ import annotations

import json

import geopandas as gpd
import pytest
from shapely import LineString, Point, box

import polymerge_core as pm

UTM = "EPSG:32632"
EAST, NORTH = 400_000.0, 6_000_000.0


def lines(path, *pieces, crs=UTM, **columns):
    """Write level lines (y, start, stop) in metres from the corner."""
    shapes = [LineString([(EAST + start, NORTH + y), (EAST + stop, NORTH + y)]) for y, start, stop in pieces]
    columns = {"class": ["divider"] * len(shapes)} | columns
    gpd.GeoDataFrame(columns, geometry=shapes, crs=UTM).to_crs(crs).to_file(path, layer="elements")
    return path


@pytest.fixture
def maps(tmp_path):
    """A map 0.3 m beside its reference, of which it has half."""
    return lines(tmp_path / "merged.gpkg", (0.3, 0, 50)), lines(tmp_path / "truth.gpkg", (0.0, 0, 100))


def files(folder):
    return sorted(path.name for path in folder.iterdir())


def test_the_figures_are_those_of_python(run, maps):
    merged, truth = maps
    done = run("evaluate", merged, "--reference", truth, "--json", "-")
    expected = pm.evaluate(gpd.read_file(merged), gpd.read_file(truth)).report
    assert done.code == 0
    assert json.loads(done.out)["measures"] == json.loads(json.dumps(expected["measures"]))


def test_without_a_report_the_table_is_printed(run, maps):
    merged, truth = maps
    done = run("evaluate", merged, "--reference", truth)
    assert done.code == 0
    assert any(row.split() == ["frechet_best", "m", "0.300", "-"] for row in done.out.splitlines())


def test_page_layers_and_report_appear_together(run, maps, tmp_path):
    merged, truth = maps
    targets = [tmp_path / name for name in ("page.html", "errors.gpkg", "report.json")]
    page, layers, report = targets
    done = run("evaluate", merged, "--reference", truth, "-o", page, "--layers", layers, "--json", report)
    assert done.code == 0
    assert page.read_text(encoding="utf-8").startswith("<!doctype html>")
    assert {"errors", "evaluated", "measures"} <= set(pm.read_layers(layers)) | {"measures"}
    assert json.loads(report.read_text())["elements"] == 1
    assert str(page) in done.err


def test_observations_give_the_paired_comparison(run, maps, tmp_path):
    merged, truth = maps
    local = lines(tmp_path / "local.gpkg", (0.5, 0, 50))
    done = run("evaluate", merged, "--reference", truth, "--local", local, "--json", "-")
    measures = json.loads(done.out)["measures"]["divider"]
    assert measures["frechet_before"]["value"] == pytest.approx(0.5, abs=1e-6)
    assert measures["frechet_after"]["value"] == pytest.approx(0.3, abs=1e-6)
    assert measures["recall_0.5"]["value"] == pytest.approx(50 / 51.9, abs=0.02)


def test_a_region_limits_what_counts(run, maps, tmp_path):
    merged, truth = maps
    region = tmp_path / "region.gpkg"
    gpd.GeoDataFrame(geometry=[box(EAST - 5, NORTH - 5, EAST + 50, NORTH + 5)], crs=UTM).to_file(region)
    done = run("evaluate", merged, "--reference", truth, "--region", region, "--json", "-")
    assert json.loads(done.out)["measures"]["divider"]["recall_0.5"]["value"] == 1
    whole = run("evaluate", merged, "--reference", truth, "--region", region, "--region-from", "all", "--json", "-")
    assert json.loads(whole.out)["measures"]["divider"]["recall_0.5"]["value"] == pytest.approx(0.505)


def test_partial_curve_mapping_is_worked_out_on_request(run, maps):
    merged, truth = maps
    assert "pcm_best" not in run("evaluate", merged, "--reference", truth).out
    assert "pcm_best" in run("evaluate", merged, "--reference", truth, "--pcm").out


def test_a_reference_in_another_crs_is_brought_to_the_map(run, maps, tmp_path):
    merged, _ = maps
    truth = lines(tmp_path / "degrees.gpkg", (0.0, 0, 100), crs="EPSG:4326")
    done = run("evaluate", merged, "--reference", truth, "--json", "-")
    assert json.loads(done.out)["measures"]["divider"]["frechet_best"]["value"] == pytest.approx(0.3, abs=1e-3)


def test_a_demonstration_can_be_evaluated(run, tmp_path, sample_folder):
    assert run("demo", tmp_path / "demo").code == 0
    merged, local = tmp_path / "demo" / "merged.gpkg", tmp_path / "demo" / "local_maps.gpkg"
    page = tmp_path / "page.html"
    reference = sample_folder / "reference.gpkg"
    done = run("evaluate", merged, "--reference", reference, "--local", local, "-o", page)
    assert done.code == 0
    assert "boundary" in page.read_text(encoding="utf-8")


def no_class(folder):
    path = folder / "plain.gpkg"
    gpd.GeoDataFrame({"name": ["a"]}, geometry=[LineString([(EAST, NORTH), (EAST + 9, NORTH)])], crs=UTM).to_file(path)
    return path


def test_a_merge_and_a_reference_without_a_class_column_are_compared(run, tmp_path):
    tracks = gpd.GeoDataFrame(
        geometry=[LineString([(EAST, NORTH + y), (EAST + 90, NORTH + y)]) for y in (0, 1)], crs=UTM
    )
    tracks.to_file(tmp_path / "tracks.gpkg")
    tracks.iloc[:1].to_file(tmp_path / "truth.gpkg")
    assert run("merge", tmp_path / "tracks.gpkg", "--proximity", 15, "-o", tmp_path / "path.shp").code == 0
    given = [tmp_path / "path.shp", "--reference", tmp_path / "truth.gpkg", "--local", tmp_path / "tracks.gpkg"]
    done = run("evaluate", *given, "--json", "-")
    assert done.code == 0
    assert done.warnings == []
    assert json.loads(done.out)["measures"]["line"]["frechet_best"]["value"] == pytest.approx(0.5, abs=1e-3)


def points(folder):
    path = folder / "points.gpkg"
    gpd.GeoDataFrame({"class": ["divider"]}, geometry=[Point(EAST, NORTH)], crs=UTM).to_file(path)
    return path


def nothing(folder):
    return lines(folder / "empty.gpkg", (0, 0, 9)).with_name("not_there.gpkg")


def region_of_lines(folder):
    return lines(folder / "region.gpkg", (0, 0, 9))


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        pytest.param(["--reference", no_class], 1, ["'plain'", "class"], id="a reference without classes"),
        pytest.param(["--reference", points], 1, ["points.gpkg", "line"], id="a reference of points"),
        pytest.param(["--reference", nothing], 1, ["not_there.gpkg"], id="no such reference"),
        pytest.param(["--region", region_of_lines], 1, ["region", "polygons"], id="a region of lines"),
        pytest.param(["--region-from", "region"], 2, ["region"], id="a region that is not given"),
        pytest.param(["--region-from", "footprints"], 2, ["local_maps"], id="footprints that are not given"),
        pytest.param(["-o", "page.pdf"], 2, ["page.pdf", ".html"], id="a page that is none"),
        pytest.param(["--layers", "errors.xyz"], 1, ["errors.xyz"], id="layers in an unknown format"),
        pytest.param(["--crs", "EPSG:999999"], 2, ["EPSG:999999"], id="an unknown CRS"),
        pytest.param(["--area", ""], 0, [], id="an area without a name"),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing(run, maps, tmp_path, arguments, code, words, monkeypatch):
    merged, truth = maps
    monkeypatch.chdir(tmp_path)
    given = [each(tmp_path) if callable(each) else each for each in arguments]
    rest = [] if "--reference" in given else ["--reference", truth]
    before = files(tmp_path)
    done = run("evaluate", merged, *given, *rest)
    assert done.code == code
    assert files(tmp_path) == before
    if code:
        (sentence,) = done.errors
        assert all(word in sentence for word in words)
        assert "Traceback" not in done.err


def test_an_output_that_is_there_is_kept(run, maps, tmp_path):
    merged, truth = maps
    page = tmp_path / "page.html"
    page.write_text("mine")
    done = run("evaluate", merged, "--reference", truth, "-o", page)
    assert done.code == 1
    assert "page.html" in done.errors[0]
    assert page.read_text() == "mine"
    assert run("evaluate", merged, "--reference", truth, "-o", page, "--overwrite").code == 0
    assert page.read_text(encoding="utf-8") != "mine"


def test_an_input_is_never_written_to(run, maps):
    merged, truth = maps
    done = run("evaluate", merged, "--reference", truth, "--layers", truth, "--overwrite")
    assert done.code == 1
    assert len(gpd.read_file(truth)) == 1


def test_progress_for_programs_only_grows(run, maps, tmp_path):
    merged, truth = maps
    done = run("evaluate", merged, "--reference", truth, "-o", tmp_path / "page.html", "--progress", "json")
    told = [json.loads(row)["fraction"] for row in done.err.splitlines() if row.startswith("{")]
    assert told == sorted(told)
    assert told[-1] == 1
