"""Each command does what it says: the analyst's cases, options, formats, reports, progress."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest
import shapely
from shapely import LineString

import polymerge_core
from polymerge_core.options import METHODS
from tests.cli.layers import EAST, NORTH, UTM, area, coordinates, draw, line, look, noisy_copies

COMMANDS = ("project", "merge", "network", "demo", "env")
FORMATS = ("gpkg", "shp", "geojson", "fgb", "parquet")


# -- what it says of itself ------------------------------------------------------------------------


def test_help_lists_the_commands(run):
    outcome = run("--help")
    assert outcome.code == 0
    assert outcome.err == ""
    assert all(f"\n  {name} " in outcome.out for name in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_without_a_line_that_breaks_a_terminal(run, command):
    outcome = run(command, "--help")
    assert outcome.code == 0
    assert outcome.out.startswith(f"Usage: polymerge {command}")
    assert max(map(len, outcome.out.splitlines())) <= 110


def test_version(run):
    outcome = run("--version")
    assert (outcome.code, outcome.err) == (0, "")
    assert polymerge_core.__version__ in outcome.out


def test_env_names_the_libraries_that_decide_about_geometry(run):
    outcome = run("env")
    assert outcome.code == 0
    named = {text.split(" ")[0] for text in outcome.out.splitlines()}
    assert named >= {"polymerge_core", "Python", "shapely", "geopandas", "pyogrio", "GEOS", "PROJ", "GDAL"}


# -- the analyst's cases ---------------------------------------------------------------------------


def test_ten_copies_in_one_shapefile_give_one_line(run, tmp_path):
    copies = draw(tmp_path / "track.shp", noisy_copies(10, 20))
    outcome = run("merge", copies, "-o", tmp_path / "road.shp")
    assert outcome.code == 0, outcome.err
    road = look(tmp_path / "road.shp")
    assert road[["class", "n_obs", "n_inst", "id"]].to_numpy().tolist() == [["line", 10, 10, road["id"][0]]]
    assert road.crs == UTM
    x = np.linspace(0, 60, 400)
    truth = shapely.linestrings(EAST + x, NORTH + 10 * np.sin(x / 15))
    assert shapely.hausdorff_distance(road.geometry[0], truth) < 1.0


@pytest.mark.parametrize("method", METHODS)
def test_ten_shapefiles_with_one_copy_each_give_the_same_line(run, tmp_path, method):
    copies = noisy_copies(10, 20)
    one = draw(tmp_path / "track.shp", copies)
    # Names in another order than the copies: nothing may depend on it.
    each = [draw(tmp_path / f"walk_{7 * n % 10}.shp", copies[n : n + 1], id=[n]) for n in range(10)]
    assert run("merge", one, "--method", method, "-o", tmp_path / "one.gpkg").code == 0
    assert run("merge", *each, "--method", method, "-o", tmp_path / "each.gpkg").code == 0
    single, many = look(tmp_path / "one.gpkg", "elements"), look(tmp_path / "each.gpkg", "elements")
    if method == "polymerge":
        assert coordinates(many) == coordinates(single)
    # The consensus takes what came in files of their own for drives, each of which has an error of its own.
    along = shapely.line_interpolate_point(single.geometry[0], np.linspace(0, 1, 100), normalized=True)
    assert np.quantile(shapely.distance(along, many.geometry[0]), 0.95) < 0.05
    assert many["n_observations"].tolist() == [10]
    assert sorted(look(tmp_path / "each.gpkg", "lineage")["source"]) == [f"walk_{n}" for n in range(10)]


def test_degrees_come_back_in_degrees(run, tmp_path):
    metres = gpd.GeoSeries(list(noisy_copies(10, 20)), crs=UTM)
    # The order of instances must not hang on the digits of the coordinates.
    draw(tmp_path / "track.gpkg", metres.to_crs(4326), crs=4326, timestamp=range(10))
    draw(tmp_path / "metres.gpkg", metres, timestamp=range(10))
    assert run("merge", tmp_path / "track.gpkg", "-o", tmp_path / "road.gpkg").code == 0
    assert run("merge", tmp_path / "metres.gpkg", "-o", tmp_path / "expected.gpkg").code == 0
    road, expected = (look(tmp_path / name, "elements") for name in ("road.gpkg", "expected.gpkg"))
    assert road.crs == "EPSG:4326"
    assert len(road) == len(expected) == 1
    assert shapely.hausdorff_distance(road.to_crs(UTM).geometry[0], expected.geometry[0]) < 0.01
    assert road["length_m"][0] == pytest.approx(expected["length_m"][0], rel=1e-3)


def test_lines_and_polygons_of_one_geopackage_give_two_shapefiles(run, tmp_path):
    shapes = [
        line((0, 0), (10, 0)),
        line((1, 0.5), (9, 0.5)),
        area((0, 50), (10, 50), (10, 54), (0, 54)),
        area((0.2, 50), (10.2, 50), (10.2, 54), (0.2, 54)),
    ]
    mixed = draw(tmp_path / "mixed.gpkg", shapes)
    outcome = run("merge", mixed, "-o", tmp_path / "m.shp")
    assert outcome.code == 0, outcome.err
    assert {path.name for path in tmp_path.glob("m*.shp")} == {"m.shp", "m_areas.shp"}
    assert look(tmp_path / "m.shp").geom_type.tolist() == ["LineString"]
    assert look(tmp_path / "m_areas.shp").geom_type.tolist() == ["Polygon"]
    assert set(look(tmp_path / "m.shp")["elem_id"]).isdisjoint(look(tmp_path / "m_areas.shp")["elem_id"])
    assert len(look(tmp_path / "m_tables.gpkg", "lineage")) == 4
    assert "m.shp" in outcome.err
    assert "m_areas.shp" in outcome.err


@pytest.mark.parametrize(
    ("crs", "corner", "apart", "elements"),
    [
        pytest.param(2263, (980_000, 200_000), 3.2, 1, id="3.2 ft are under a metre"),
        pytest.param(2263, (980_000, 200_000), 3.4, 2, id="3.4 ft are over a metre"),
        pytest.param(3857, (1_000_000, 8_399_738), 1.5, 1, id="1.5 Mercator metres at 60 degrees are 0.75 m"),
        pytest.param(3857, (1_000_000, 8_399_738), 2.5, 2, id="2.5 Mercator metres at 60 degrees are 1.25 m"),
    ],
)
def test_the_proximity_is_metres_on_the_ground(run, tmp_path, crs, corner, apart, elements):
    east, north = corner
    pair = [LineString([(east, north + y), (east + 40, north + y)]) for y in (0.0, apart)]
    outcome = run("merge", draw(tmp_path / "pair.gpkg", pair, crs=crs), "-o", tmp_path / "out.gpkg")
    assert outcome.code == 0, outcome.err
    merged = look(tmp_path / "out.gpkg", "elements")
    assert len(merged) == elements
    assert merged.crs == crs
    assert shapely.hausdorff_distance(shapely.union_all(merged.geometry), shapely.union_all(pair)) < apart


# -- a main map ------------------------------------------------------------------------------------


def test_a_main_map_keeps_its_ids_and_tells_which_became_others(run, tmp_path):
    main_map = draw(
        tmp_path / "map.gpkg",
        [line((0, 0), (10, 0)), line((20, 0), (30, 0)), line((0, 90), (9, 90))],
        element_id=[7, 3, 5],
        name=["west", "east", "alone"],
    )
    bridge = draw(tmp_path / "new.gpkg", [line((5, 0.5), (25, 0.5)), line((0, 40), (9, 40))])
    outcome = run("merge", bridge, "--main-map", main_map, "-o", tmp_path / "out.gpkg")
    assert outcome.code == 0, outcome.err
    elements = look(tmp_path / "out.gpkg", "elements")
    assert elements["element_id"].tolist() == [3, 5, 8]
    assert elements["name"].tolist()[1] == "alone"
    assert coordinates(elements)[1] == [[EAST, NORTH + 90], [EAST + 9, NORTH + 90]]
    assert look(tmp_path / "out.gpkg", "id_aliases")[["old_id", "element_id"]].to_numpy().tolist() == [[7, 3]]


def test_the_result_of_a_merge_is_a_main_map_for_the_next(run, tmp_path):
    first = draw(tmp_path / "first.gpkg", noisy_copies(3, 8))
    second = draw(tmp_path / "second.gpkg", noisy_copies(3, 8, seed=2))
    assert run("merge", first, "-o", tmp_path / "map.gpkg").code == 0
    outcome = run("merge", second, "--main-map", tmp_path / "map.gpkg", "-o", tmp_path / "next.gpkg")
    assert outcome.code == 0, outcome.err
    elements = look(tmp_path / "next.gpkg", "elements")
    assert elements["element_id"].tolist() == look(tmp_path / "map.gpkg", "elements")["element_id"].tolist()
    assert elements["n_observations"].tolist() == [6]


# -- options ---------------------------------------------------------------------------------------


def test_class_field_keeps_classes_apart(run, tmp_path):
    pair = draw(tmp_path / "pair.gpkg", [line((0, 0), (9, 0)), line((0, 0.5), (9, 0.5))], kind=["kerb", "lane"])
    assert run("merge", pair, "--class-field", "kind", "-o", tmp_path / "two.gpkg").code == 0
    assert run("merge", pair, "--class-name", "edge", "-o", tmp_path / "one.gpkg").code == 0
    assert look(tmp_path / "two.gpkg", "elements")["class"].tolist() == ["kerb", "lane"]
    one = look(tmp_path / "one.gpkg", "elements")
    assert one["class"].tolist() == ["edge"]
    assert one["kind"].tolist()[0] in {"kerb", "lane"}


def test_min_score_leaves_out_what_is_under_it(run, tmp_path):
    seen = [line((0, y), (9, y)) for y in (0, 20, 40)]
    draw(tmp_path / "seen.gpkg", seen, score=[0.8, 0.79, 0.9])
    outcome = run("merge", tmp_path / "seen.gpkg", "--min-score", "0.8", "-o", tmp_path / "out.gpkg")
    assert outcome.code == 0
    assert sorted(look(tmp_path / "out.gpkg", "elements")["score"]) == [0.8, 0.9]
    left_out = look(tmp_path / "out.gpkg", "left_out")
    assert left_out[["source", "source_fid", "reason"]].to_numpy().tolist() == [
        ["seen", 2, "the score is under min_score (0.8)"]
    ]
    assert "1 left out (the score is under min_score (0.8): 1)" in outcome.err


def test_proximity_decides_who_is_merged(run, tmp_path):
    pair = draw(tmp_path / "pair.gpkg", [line((0, 0), (9, 0)), line((0, 1.5), (9, 1.5))])
    assert run("merge", pair, "-o", tmp_path / "near.gpkg").code == 0
    assert run("merge", pair, "--proximity", "2", "-o", tmp_path / "far.gpkg").code == 0
    assert [len(look(tmp_path / name, "elements")) for name in ("near.gpkg", "far.gpkg")] == [2, 1]


def test_area_declares_a_class_of_closed_lines_to_be_areas(run, tmp_path):
    def island(shift: float) -> LineString:
        return line((shift, 0), (shift + 8, 0), (shift + 8, 8), (shift, 8), (shift, 0))

    islands = draw(tmp_path / "i.gpkg", [island(0), island(0.4), island(0.2)], **{"class": ["island"] * 3})
    assert run("merge", islands, "--area", "island", "-o", tmp_path / "out.gpkg").code == 0
    (shape,) = look(tmp_path / "out.gpkg", "elements").geometry
    assert shape.geom_type == "LineString"  # as it came
    assert shape.is_closed
    assert len(shape.coords) == 5
    assert shapely.Polygon(shape).area == pytest.approx(64, rel=0.06)


@pytest.mark.parametrize(
    ("aggregate", "width", "name"),
    [
        pytest.param([], {2.0, 3.0, 7.0}, {"x", "y"}, id="first by default"),
        pytest.param(["--aggregate", "mode"], {2.0}, {"x"}, id="mode, the smallest of equals"),
        pytest.param(["--aggregate", "mean"], {4.0}, {"x", "y"}, id="mean of what holds numbers"),
        pytest.param(["--aggregate", "width=sum", "--aggregate", "name=max"], {12.0}, {"y"}, id="column by column"),
    ],
)
def test_aggregate_says_how_columns_are_carried(run, tmp_path, aggregate, width, name):
    looks = [line((0, y), (9, y)) for y in (0.0, 0.3, 0.6)]
    draw(tmp_path / "in.gpkg", looks, width=[2.0, 3.0, 7.0], name=["x", "y", "x"])
    outcome = run("merge", tmp_path / "in.gpkg", *aggregate, "-o", tmp_path / "out.gpkg")
    assert outcome.code == 0, outcome.err
    elements = look(tmp_path / "out.gpkg", "elements")
    assert len(elements) == 1
    assert elements["width"][0] in width
    assert elements["name"][0] in name


def test_out_crs_reprojects_the_result(run, tmp_path):
    road = draw(tmp_path / "road.gpkg", [line((0, 0), (90, 0))])
    assert run("merge", road, "--out-crs", "EPSG:4326", "-o", tmp_path / "out.gpkg").code == 0
    merged = look(tmp_path / "out.gpkg", "elements")
    assert merged.crs == 4326
    assert merged.total_bounds == pytest.approx([7.47, 54.14, 7.47, 54.14], abs=0.02)


def test_plain_coordinates_stay_plain(run, tmp_path):
    plain = draw(tmp_path / "plain.shp", [LineString([(0, 0), (9, 0)]), LineString([(0, 0.5), (9, 0.5)])], crs=None)
    assert run("merge", plain, "--crs", "local", "-o", tmp_path / "out.gpkg").code == 0
    merged = look(tmp_path / "out.gpkg", "elements")
    assert len(merged) == 1
    assert merged.crs is None or merged.crs.is_engineering


def test_layers_in_different_crs_meet_in_the_first_one(run, tmp_path):
    looks = gpd.GeoSeries([line((0, 0), (30, 0)), line((1, 0.5), (29, 0.5))], crs=UTM)
    one = draw(tmp_path / "one.gpkg", looks[:1])
    other = draw(tmp_path / "other.gpkg", looks[1:].to_crs(4326), crs=4326)
    alike = draw(tmp_path / "other.shp", looks[1:])
    assert run("merge", one, other, "-o", tmp_path / "out.gpkg").code == 0
    assert run("merge", one, alike, "-o", tmp_path / "expected.gpkg").code == 0
    (merged,), (expected,) = (look(tmp_path / name, "elements").geometry for name in ("out.gpkg", "expected.gpkg"))
    assert look(tmp_path / "out.gpkg", "elements").crs == UTM
    assert merged.hausdorff_distance(expected) < 1e-5
    # Halfway between the two.
    assert np.abs(np.subtract(merged.coords, (EAST, NORTH + 0.25))[:, 1]).max() < 0.1


def test_layers_in_different_crs_meet_in_the_first_one_by_the_published_method(run, tmp_path):
    looks = gpd.GeoSeries([line((0, 0), (30, 0)), line((1, 0.5), (29, 0.5))], crs=UTM)
    one = draw(tmp_path / "one.gpkg", looks[:1])
    other = draw(tmp_path / "other.gpkg", looks[1:].to_crs(4326), crs=4326)
    assert run("merge", one, other, "--method", "polymerge", "-o", tmp_path / "out.gpkg").code == 0
    merged = look(tmp_path / "out.gpkg", "elements")
    assert np.allclose(
        coordinates(merged)[0], np.add([[0, 0], [1, 0.25], [29, 0.25], [30, 0]], (EAST, NORTH)), atol=1e-6
    )


# -- reports and progress --------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["merge", "network"])
def test_a_report_on_standard_output_is_json_and_nothing_else(run, tmp_path, command):
    track = draw(tmp_path / "track.gpkg", [*noisy_copies(4, 6), None])
    outcome = run(command, track, "--json", "-", "-o", tmp_path / "out.gpkg")
    report = json.loads(outcome.out)
    assert outcome.code == 0
    assert report["observations"] == 4
    assert report["left_out"] == {"no geometry": 1}
    assert "1 left out (no geometry: 1)" in outcome.err


def test_a_report_on_standard_output_needs_no_letters_that_a_terminal_may_lack(run, tmp_path):
    road = draw(tmp_path / "road.gpkg", [line((0, 0), (9, 0))], **{"class": ["Straße"]})
    outcome = run("merge", road, "--json", "-", "-o", tmp_path / "out.gpkg")
    assert outcome.out.isascii()
    assert list(json.loads(outcome.out)["classes"]) == ["Straße"]


def test_a_report_goes_to_a_file(run, tmp_path):
    track = draw(tmp_path / "track.gpkg", noisy_copies(4, 6))
    outcome = run("merge", track, "--json", tmp_path / "r.json", "-o", tmp_path / "out.gpkg")
    report = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))
    assert (outcome.code, outcome.out) == (0, "")
    assert (report["elements"], report["working_crs"], report["instance_from"]) == (1, UTM, {"track": "feature"})


@pytest.mark.parametrize("command", ["merge", "network"])
def test_progress_for_programs_is_json_that_only_grows(run, tmp_path, command):
    track = draw(tmp_path / "track.gpkg", noisy_copies(60, 40))
    outcome = run(command, track, "--progress", "json", "-o", tmp_path / "out.gpkg")
    *lines, summary = outcome.err.splitlines()
    said = [json.loads(text) for text in lines]
    fractions = [each["fraction"] for each in said]
    assert fractions == sorted(fractions)
    assert (fractions[0], fractions[-1]) == (0.0, 1.0)
    assert all(set(each) == {"fraction", "message"} and each["message"] for each in said)
    assert "60 observations" in summary


@pytest.mark.parametrize("mode", [[], ["--progress", "none"]], ids=["auto", "none"])
def test_a_pipe_sees_one_line_and_no_progress(run, tmp_path, mode):
    track = draw(tmp_path / "track.gpkg", noisy_copies(30, 20))
    outcome = run("merge", track, *mode, "-o", tmp_path / "out.gpkg")
    assert outcome.out == ""
    assert outcome.err == f"30 observations of 30 local maps became 1 element -> {tmp_path / 'out.gpkg'}\n"


# -- network, project, demo ------------------------------------------------------------------------


def test_network_writes_edges_and_observations(run, tmp_path):
    looks = [line((0, 0), (10, 0)), line((0, 0.5), (10, 0.5)), line((0, 50), (10, 50))]
    outcome = run("network", draw(tmp_path / "in.gpkg", looks), "-o", tmp_path / "n.gpkg")
    assert outcome.code == 0, outcome.err
    edges, observations = look(tmp_path / "n.gpkg", "edges"), look(tmp_path / "n.gpkg", "observations")
    assert edges["distance_m"].tolist() == [0.5]
    assert coordinates(edges) == [[[EAST + 5, NORTH], [EAST + 5, NORTH + 0.5]]] or coordinates(edges) == [
        [[EAST + 5, NORTH + 0.5], [EAST + 5, NORTH]]
    ]
    assert sorted(observations["component"].value_counts()) == [1, 2]
    assert "3 observations, 1 edge, 2 components (the largest has 2)" in outcome.err


def test_project_then_merge_the_sample(run, tmp_path, sample_folder):
    local, merged = tmp_path / "local.gpkg", tmp_path / "merged.gpkg"
    predictions, poses = sample_folder / "predictions.json", sample_folder / "poses.csv"
    projected = run("project", predictions, "--poses", poses, "--crs", UTM, "-o", local, "--json", "-")
    assert projected.code == 0, projected.err
    report = json.loads(projected.out)
    observations, instances = look(local, "local_maps"), look(local, "instances")
    assert (len(observations), len(instances)) == (report["observations"], report["instances"])
    assert set(observations["drive"]) == {"local"}
    assert observations.crs == UTM
    outcome = run("merge", local, "-o", merged, "--json", "-")
    assert outcome.code == 0, outcome.err
    report = json.loads(outcome.out)
    assert report["instance_from"] == {"local": "column"}
    assert 0 < report["elements"] < report["observations"]
    used = set(look(merged, "lineage")["source_fid"]) | set(look(merged, "left_out")["source_fid"])
    assert used == set(range(1, len(observations) + 1))


def test_the_help_of_demo_names_the_folder_where_none_is_given(run):
    assert "polymerge_demo" in run("demo", "--help").out


@pytest.mark.parametrize("command", ["merge", "evaluate"])
def test_a_layer_is_named_in_quotes_in_the_help(run, command):
    assert '"FILE|layername=LAYER"' in run(command, "--help").out


def test_demo_writes_maps_and_a_picture_once(run, tmp_path):
    folder = tmp_path / "new" / "demo"
    outcome = run("demo", folder)
    assert outcome.code == 0, outcome.err
    assert {path.name for path in folder.iterdir()} == {"local_maps.gpkg", "merged.gpkg", "before_after.png"}
    assert (folder / "before_after.png").read_bytes().startswith(b"\x89PNG")
    assert all(name in outcome.out for name in ("divider", "boundary", "ped_crossing", "merged.gpkg"))
    before = {path: path.read_bytes() for path in folder.iterdir()}
    again = run("demo", folder)
    assert again.code == 1
    assert "exists: overwrite it" in again.err
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize("method", METHODS)
def test_demo_merges_by_the_method_that_is_asked_for(run, tmp_path, method):
    assert run("demo", tmp_path, "--method", method).code == 0
    assert ("sigma_m" in look(tmp_path / "merged.gpkg", "elements")) == (method == "consensus")


# -- formats ---------------------------------------------------------------------------------------


def binary_looks() -> list[LineString]:
    """Lines whose coordinates every format holds exactly."""
    return [line((0, 0), (8, 0.25), (16, 0)), line((1, 0.5), (15, 0.75)), line((0, 64), (8, 64))]


@pytest.mark.parametrize("extension", FORMATS)
def test_every_format_brings_the_same_layer(run, tmp_path, extension):
    source = draw(tmp_path / f"in.{extension}", binary_looks(), **{"class": ["a", "a", "b"]})
    outcome = run("merge", source, "-o", tmp_path / "out.gpkg")
    assert outcome.code == 0, outcome.err
    merged = look(tmp_path / "out.gpkg", "elements")
    assert merged["class"].tolist() == ["a", "b"]
    assert coordinates(merged) == coordinates(_reference(run, tmp_path))
    assert merged.crs == UTM


def _reference(run, tmp_path: Path) -> gpd.GeoDataFrame:
    source = draw(tmp_path / "reference.gpkg", binary_looks(), **{"class": ["a", "a", "b"]})
    assert run("merge", source, "-o", tmp_path / "expected.gpkg").code == 0
    return look(tmp_path / "expected.gpkg", "elements")


@pytest.mark.parametrize("extension", FORMATS)
def test_every_format_takes_the_same_elements(run, tmp_path, extension):
    expected = _reference(run, tmp_path)
    target = tmp_path / f"out.{extension}"
    outcome = run("merge", tmp_path / "reference.gpkg", "-o", target)
    assert outcome.code == 0, outcome.err
    ids = "elem_id" if extension == "shp" else "element_id"
    written = (look(target, "elements") if extension == "gpkg" else look(target)).sort_values(ids)
    assert written.crs == UTM
    assert coordinates(written) == coordinates(expected)
    assert written["class"].tolist() == expected["class"].tolist()
    assert written["score"].tolist() == [1.0, 1.0]
    tables = target if extension == "gpkg" else tmp_path / "out_tables.gpkg"
    assert len(look(tables, "lineage")) == 3
    # What was written can be read again as a main map.
    again = run("merge", tmp_path / "reference.gpkg", "--main-map", target, "-o", tmp_path / "again.gpkg")
    assert again.code == 0, again.err
    assert look(tmp_path / "again.gpkg", "elements")["n_observations"].tolist() == [4, 2]


def test_a_layer_is_named_as_qgis_names_it(run, tmp_path):
    file = draw(tmp_path / "both.gpkg", [line((0, 0), (9, 0))], layer="monday")
    draw(file, [line((0, 5), (9, 5)), line((0, 20), (9, 20))], layer="tuesday")
    assert run("merge", f"{file}|layername=tuesday", "-o", tmp_path / "one.gpkg").code == 0
    assert run("merge", file, "-o", tmp_path / "all.gpkg").code == 0
    assert len(look(tmp_path / "one.gpkg", "elements")) == 2
    assert set(look(tmp_path / "all.gpkg", "lineage")["source"]) == {"monday", "tuesday"}


def test_a_file_may_be_called_as_the_layer_that_project_writes(run, tmp_path):
    roads = draw(tmp_path / "local_maps.gpkg", noisy_copies(2, 4))
    assert run("merge", roads, "-o", tmp_path / "merged.gpkg").code == 0
    assert set(look(tmp_path / "merged.gpkg", "lineage")["source"]) == {"local_maps"}


def test_a_path_with_spaces_umlauts_and_quotes(run, tmp_path):
    folder = tmp_path / "Straße 'Mitte' (neu)"
    folder.mkdir()
    source = draw(folder / "größe & co.gpkg", noisy_copies(2, 4))
    outcome = run("merge", source, "-o", folder / "zusammengeführt.gpkg")
    assert outcome.code == 0, outcome.err
    assert len(look(folder / "zusammengeführt.gpkg", "elements")) == 1


# -- the same bytes --------------------------------------------------------------------------------


@pytest.mark.parametrize("extension", FORMATS)
def test_two_runs_give_the_same_bytes(run, tmp_path, extension):
    looks = [*noisy_copies(4, 8), *binary_looks()]
    source = draw(tmp_path / "in.gpkg", looks)
    written = []
    for name in ("first", "second"):
        folder = tmp_path / name
        folder.mkdir()
        assert run("merge", source, "-o", folder / f"out.{extension}", "--json", folder / "r.json").code == 0
        written.append({path.name: path.read_bytes() for path in folder.iterdir()})
    assert written[0].keys() == written[1].keys()
    assert [name for name in written[0] if written[0][name] != written[1][name]] == []


def test_hash_seeds_and_the_order_of_features_change_no_byte(run_alone, run, tmp_path, rng):
    looks = gpd.GeoDataFrame(
        {"class": [*["b"] * 6, *["a"] * 6], "name": [f"n{n}" for n in range(12)]},
        geometry=[*noisy_copies(6, 8), *noisy_copies(6, 8, seed=3)],
        crs=UTM,
    )
    columns = {"class": looks["class"], "name": looks["name"]}
    source = draw(tmp_path / "in.gpkg", looks.geometry, **columns)
    written = set()
    for seed in "0123":
        target = tmp_path / f"out_{seed}" / "merged.gpkg"
        target.parent.mkdir()
        outcome = run_alone("merge", source, "--aggregate", "mode", "-o", target, hash_seed=seed)
        assert outcome.code == 0, outcome.err
        written.add(target.read_bytes())
    assert len(written) == 1
    shuffled = looks.iloc[rng.permutation(12)]
    draw(source, shuffled.geometry, **{"class": shuffled["class"], "name": shuffled["name"]})
    assert run("merge", source, "--aggregate", "mode", "-o", tmp_path / "shuffled.gpkg").code == 0
    with sqlite3.connect(tmp_path / "shuffled.gpkg") as one, sqlite3.connect(tmp_path / "out_0/merged.gpkg") as other:
        query = "SELECT * FROM elements ORDER BY element_id"
        assert one.execute(query).fetchall() == other.execute(query).fetchall()


# -- as a user starts it ---------------------------------------------------------------------------


def test_the_module_runs_in_a_process_of_its_own(run_alone, tmp_path):
    track = draw(tmp_path / "track.gpkg", noisy_copies(3, 6))
    outcome = run_alone("merge", "track.gpkg", "-o", "road.gpkg", "--json", "-", cwd=tmp_path)
    assert outcome.code == 0, outcome.err
    assert json.loads(outcome.out)["elements"] == 1
    assert outcome.err == "3 observations of 3 local maps became 1 element -> road.gpkg\n"
    assert {path.name for path in tmp_path.iterdir()} == {track.name, "road.gpkg"}


def test_a_fault_in_a_process_of_its_own_is_one_line_and_an_exit_code(run_alone, tmp_path):
    outcome = run_alone("merge", "nowhere.gpkg", "-o", "road.gpkg", cwd=tmp_path)
    assert outcome == (1, "", "error: nowhere.gpkg: no such file\n")
    assert list(tmp_path.iterdir()) == []


def test_a_companion_that_exists_is_told_before_the_work(run, tmp_path, monkeypatch):
    draw(tmp_path / "roads.gpkg", noisy_copies(2, 5))
    (tmp_path / "m_tables.gpkg").write_bytes(b"kept")
    monkeypatch.setattr("polymerge_core.merge", lambda *_, **__: pytest.fail("the merge was run"))
    outcome = run("merge", tmp_path / "roads.gpkg", "-o", tmp_path / "m.shp")
    assert outcome.code == 1
    assert "m_tables.gpkg exists" in outcome.err
    assert (tmp_path / "m_tables.gpkg").read_bytes() == b"kept"


@pytest.fixture
def sample_local(run, tmp_path, sample_folder):
    """The local maps of the sample."""
    local = tmp_path / "local.gpkg"
    predictions, poses = sample_folder / "predictions.json", sample_folder / "poses.csv"
    assert run("project", predictions, "--poses", poses, "--crs", UTM, "-o", local).code == 0
    return local


@pytest.mark.parametrize("chosen", [[], ["--method", "consensus"]], ids=["by default", "by its name"])
def test_the_consensus_of_the_sample(run, tmp_path, sample_local, chosen):
    merged, report = tmp_path / "merged.gpkg", tmp_path / "report.json"
    assert run("merge", sample_local, *chosen, "-o", merged, "--json", report).code == 0
    elements = look(merged, "elements")
    assert elements["sigma_m"].notna().any()
    assert elements["score"].between(0, 1).all()
    assert set(look(merged, "lineage")["element_id"]) == set(elements["element_id"])
    assert "seen by too few" in " ".join(look(merged, "left_out")["reason"])
    told = json.loads(report.read_text())
    assert told["method"] == "consensus"
    assert told["corrections"]["shift_m_median"] > 0


def test_the_published_method_of_the_sample(run, tmp_path, sample_local):
    merged, report = tmp_path / "merged.gpkg", tmp_path / "report.json"
    assert run("merge", sample_local, "--method", "polymerge", "-o", merged, "--json", report).code == 0
    assert "sigma_m" not in look(merged, "elements")
    assert len(look(merged, "left_out")) == 0
    told = json.loads(report.read_text())
    assert told["method"] == "polymerge"
    assert "corrections" not in told


def test_help_names_the_default_method_first_and_what_belongs_to_one_method(run):
    text = " ".join(run("merge", "--help").out.split())
    assert "--method [consensus|polymerge]" in text
    assert "[default: consensus]" in text
    assert "Of polymerge, for area classes" in text
