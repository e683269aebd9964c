"""Bad input and bad luck: one line that says what is wrong, where and what to do; no output is touched."""

from __future__ import annotations

import json
import resource
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pytest
from shapely import GeometryCollection, LineString, MultiLineString, MultiPolygon, Point, from_wkt

from tests.cli.layers import EAST, NORTH, UTM, area, coordinates, draw, line, look, noisy_copies

PAIR = (line((0, 0), (10, 0)), line((1, 0.5), (9, 0.5)))
HEADER = "timestamp_ns,qw,qx,qy,qz,tx_m,ty_m,tz_m,token\n"
POSE = "1700000000000000000,1,0,0,0,400000,6000000,0,a\n"
OLD = b"the map of last year"


# -- a layer, a file or an option that cannot be used -----------------------------------------------


class Folder:
    """Makes the input files of one case."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def layer(self, name: str = "roads.gpkg", geometries: Any = PAIR, **options: Any) -> Path:
        return draw(self.path / name, geometries, **options)

    def file(self, name: str, content: bytes | str) -> Path:
        data = content if isinstance(content, bytes) else content.encode()
        (self.path / name).write_bytes(data)
        return self.path / name

    def part(self, name: str, share: float) -> Path:
        """A file whose copying stopped on the way."""
        whole = self.layer().read_bytes()
        return self.file(name, whole[: int(share * len(whole))])

    def swapped(self, geometries: Any) -> list[LineString]:
        return [LineString([(y, x) for x, y in shape.coords]) for shape in geometries]

    def columns(self, **columns: Any) -> Path:
        """GeoParquet, which can hold columns that a GeoPackage cannot."""
        return draw(self.path / "roads.parquet", PAIR, **columns)

    def project(self, poses: str = HEADER + POSE, predictions: Any = None, *more: str, crs: str = UTM) -> list[Any]:
        return ["project", self.predictions(predictions), "--poses", self.file("poses.csv", poses), "--crs", crs, *more]

    def predictions(self, frames: Any = None) -> Path:
        known = {"a": {"vectors": [[[0, 1.8], [20, 1.7]]], "scores": [0.9], "labels": [1]}}
        return self.file("drive.json", json.dumps({"meta": {}, "results": known if frames is None else frames}))

    def into_degrees(self, geometries: Any) -> gpd.GeoSeries:
        return gpd.GeoSeries(list(geometries), crs=UTM).to_crs(4326)


def merge(*arguments: Any) -> list[Any]:
    return ["merge", *arguments]


BAD = {
    # coordinate reference systems
    "no CRS": (lambda f: merge(f.layer(crs=None)), 1, ["layer 'roads'", "EPSG:32632", "crs=local"]),
    "one layer of two without a CRS": (
        lambda f: merge(f.layer(), f.layer("bare.gpkg", crs=None)),
        1,
        ["layer 'bare'", "no coordinate reference system"],
    ),
    "degrees said to be UTM": (
        lambda f: merge(f.layer(geometries=f.into_degrees(PAIR).to_numpy())),
        1,
        ["layer 'roads'", "look like degrees", "UTM zone 32N", "check the CRS"],
    ),
    "UTM said to be degrees": (
        lambda f: merge(f.layer(crs=4326)),
        1,
        ["layer 'roads'", "are not degrees of longitude and latitude", "check the CRS"],
    ),
    "latitude before longitude": (
        lambda f: merge(f.layer(geometries=[LineString([(-33, 151), (-33, 151.001)])], crs=4326)),
        1,
        ["layer 'roads'", "the order of the axes"],
    ),
    "northing before easting": (
        lambda f: merge(f.layer(geometries=f.swapped(PAIR))),
        1,
        ["layer 'roads'", "far from", "the order of the axes"],
    ),
    "feet said to be metres": (
        lambda f: merge(f.layer(geometries=[LineString([(980_000, 200_000), (980_050, 200_000)])], crs=28992)),
        1,
        ["layer 'roads'", "far from", "check the CRS"],
    ),
    "both sides of the antimeridian": (
        lambda f: merge(f.layer(geometries=[LineString([(179.999, 10), (-179.999, 10)])], crs=4326)),
        1,
        ["layer 'roads'", "antimeridian", "reproject"],
    ),
    "plain coordinates beside a CRS": (
        lambda f: merge(f.layer("plain.gpkg", crs=None), f.layer(), "--crs", "local"),
        1,
        ["layer 'plain'", "layer 'roads'", "give all layers a CRS, or none"],
    ),
    "a place on Earth for plain coordinates": (
        lambda f: merge(f.layer(crs=None), "--crs", "local", "--out-crs", UTM),
        1,
        ["out_crs", "crs=local"],
    ),
    "an output CRS of another continent": (
        lambda f: merge(f.layer(), "--out-crs", "EPSG:32755"),
        1,
        ["the result", "far from", "UTM zone 55S"],
    ),
    "a main map on another continent": (
        lambda f: merge(f.layer(geometries=[PAIR[0]], crs="EPSG:32755"), "--main-map", f.layer("map.gpkg")),
        1,
        ["the result", "far from", "UTM zone 32N"],
    ),
    "an output CRS that ends in the middle of the data": (
        lambda f: merge(
            f.layer(geometries=[LineString([(3_324_000, 0), (3_364_000, 0)])], crs=3832), "--out-crs", "EPSG:4326"
        ),
        1,
        ["the result", "both sides of the antimeridian", "a projected out_crs"],
    ),
    "an output CRS that is no plane": (
        lambda f: merge(f.layer(), "--out-crs", "EPSG:4978"),
        1,
        ["the result", "Geocentric CRS", "easting and northing"],
    ),
    "coordinates from the middle of the Earth": (
        lambda f: merge(f.layer("roads.parquet", crs=4978)),
        1,
        ["layer 'roads'", "Geocentric CRS", "reproject the layer"],
    ),
    # columns
    "a named class column that is absent": (
        lambda f: merge(f.layer(), "--class-field", "klass"),
        1,
        ["layer 'roads'", "no column 'klass'", "the columns are id"],
    ),
    "a named column without a name": (
        lambda f: merge(f.layer(), "--class-field", ""),
        1,
        ["layer 'roads'", "no column ''", "the columns are id"],
    ),
    "a named column that only one layer has": (
        lambda f: merge(f.layer("a.gpkg", kind=["x", "y"]), f.layer("b.gpkg"), "--class-field", "kind"),
        1,
        ["layer 'b'", "no column 'kind'"],
    ),
    "instances from a column that is absent": (
        lambda f: merge(f.layer(), "--instance-from", "column"),
        1,
        ["layer 'roads'", "no column 'instance'"],
    ),
    "columns that differ in case": (
        lambda f: merge(f.columns(Class=["a", "b"], CLASS=["c", "d"])),
        1,
        ["layer 'roads'", "Class, CLASS differ in case", "name one"],
    ),
    "a timestamp that is none": (
        lambda f: merge(f.layer(timestamp=["yesterday", "2020-01-01"])),
        1,
        ["layer 'roads'", "column timestamp", "yesterday is not a timestamp"],
    ),
    "a timestamp in parts of a second": (
        lambda f: merge(f.layer(timestamp=[1.5, 2.0])),
        1,
        ["layer 'roads'", "1.5 is not a timestamp", "integer nanoseconds"],
    ),
    "a timestamp of the year 9999": (
        lambda f: merge(f.layer(timestamp=["9999-12-31", "2020-01-01"])),
        1,
        ["layer 'roads'", "9999-12-31 is not a timestamp"],
    ),
    "an element_id twice in the main map": (
        lambda f: merge(f.layer(), "--main-map", f.layer("old.gpkg", element_id=[4, 4])),
        1,
        ["main map 'old'", "element_id 4 occurs more than once"],
    ),
    "an element_id that is text": (
        lambda f: merge(f.layer(), "--main-map", f.layer("old.gpkg", element_id=["p", "q"])),
        1,
        ["main map 'old'", "element_id", "whole numbers"],
    ),
    # files
    "a file that is not there": (lambda f: merge(f.path / "gone.gpkg"), 1, ["gone.gpkg", "no such file"]),
    "a main map that is not there": (
        lambda f: merge(f.layer(), "--main-map", f.path / "gone.gpkg"),
        1,
        ["gone.gpkg", "no such file"],
    ),
    "a folder": (lambda f: merge(f.path), 1, ["is not a file", "name a GeoPackage"]),
    "zero bytes": (lambda f: merge(f.file("z.gpkg", b"")), 1, ["z.gpkg", "0 bytes", "make it again"]),
    "a GeoPackage cut off in its middle": (
        lambda f: merge(f.part("cut.gpkg", 0.5)),
        1,
        ["cut.gpkg", "damaged or not complete", "restore a copy"],
    ),
    "a GeoPackage cut off in its head": (lambda f: merge(f.part("cut.gpkg", 0.001)), 1, ["cut.gpkg", "damaged"]),
    "GeoJSON cut off": (
        lambda f: merge(f.file("c.geojson", '{"type":"FeatureCollection","features":[{"type":"Feat')),
        1,
        ["c.geojson", "damaged or not complete"],
    ),
    "a Shapefile without its .dbf": (
        lambda f: [(f.layer("s.shp"), (f.path / "s.dbf").unlink())[0]] and merge(f.path / "s.shp"),
        1,
        ["s.shp", "s.dbf is missing", "copy all parts"],
    ),
    "garbage": (lambda f: merge(f.file("g.shp", "hello world")), 1, ["g.shp", "is not a GeoPackage, Shapefile"]),
    "a database that is no GeoPackage": (
        lambda f: merge(_database(f.path / "d.gpkg")),
        1,
        ["d.gpkg", "SQLite database, but not a GeoPackage"],
    ),
    "a pickle": (
        lambda f: merge(f.file("p.gpkg", b"\x80\x04cos\nsystem\n.")),
        1,
        ["p.gpkg", "pickle", "can run any program", "convert it"],
    ),
    "an address": (lambda f: merge("https://example.org/a.gpkg"), 1, ["not a file on this computer", "download"]),
    "an archive's inside": (lambda f: merge("/vsizip/a.zip/a.shp"), 1, ["not a file on this computer", "unpack"]),
    "an unknown layer": (
        lambda f: merge(f"{f.layer()}|layername=lanes"),
        1,
        ["roads.gpkg", "no layer lanes", "its layers are roads"],
    ),
    "a choice of features behind the file": (
        lambda f: merge(f"{f.layer()}|subset=id=1"),
        1,
        ["only |layername=LAYER", "export"],
    ),
    "points": (
        lambda f: merge(f.layer("poles.gpkg", [Point(EAST, NORTH)])),
        1,
        ["poles.gpkg", "layer poles", "points", "lines and polygons"],
    ),
    # predictions and poses
    "predictions as a pickle": (
        lambda f: ["project", f.file("p.pkl", b"\x80\x04N."), "--poses", f.file("q.csv", HEADER), "--crs", UTM],
        1,
        ["p.pkl", "pickle", "runs whatever code", "convert it to JSON"],
    ),
    "a pickle that is called JSON": (
        lambda f: ["project", f.file("p.json", b"\x80\x04N."), "--poses", f.file("q.csv", HEADER), "--crs", UTM],
        1,
        ["p.json", "pickle", "convert it to JSON"],
    ),
    "predictions cut off": (
        lambda f: [
            "project",
            f.file("drive.json", f.predictions().read_bytes()[:-9]),
            "--poses",
            f.file("q.csv", HEADER + POSE),
            "--crs",
            UTM,
        ],
        1,
        ["drive.json", "not valid JSON at line 1", "cut off"],
    ),
    "a key twice": (
        lambda f: ["project", f.file("k.json", '{"results": {}, "results": {}}'), "--poses", "q.csv", "--crs", UTM],
        1,
        ["k.json", "'results' stands twice"],
    ),
    "lists of unequal length": (
        lambda f: f.project(predictions={"a": {"vectors": [[[0, 0], [1, 0]]], "scores": [], "labels": [1]}}),
        1,
        ["drive.json", "frame 'a'", "1 vectors, 0 scores"],
    ),
    "a class number without a name": (
        lambda f: f.project(predictions={"a": {"vectors": [[[0, 0], [1, 0]]], "scores": [1], "labels": [9]}}),
        1,
        ["drive.json", "frame 'a', vector 0", "label 9", "class_names"],
    ),
    "a frame without a pose": (
        lambda f: f.project(predictions={"b": {"vectors": [], "scores": [], "labels": []}}),
        1,
        ["frame 'b' has no pose", "poses.csv", "token or timestamp_ns"],
    ),
    "two poses for one token": (
        lambda f: f.project(HEADER + POSE + POSE.replace("400000", "400001")),
        1,
        ["poses.csv", "has two different poses", "keep one"],
    ),
    "a quaternion that is not of unit length": (
        lambda f: f.project(HEADER + POSE.replace(",1,0,0,0,", ",1,1,0,0,")),
        1,
        ["poses.csv: line 2", "quaternion has length 1.41421", "unit quaternion, scalar first"],
    ),
    "a decimal comma between commas": (
        lambda f: f.project(HEADER + POSE.replace("400000", '"400000,5"')),
        1,
        ["poses.csv: line 2", "column tx_m", "'400000,5'", "decimal point"],
    ),
    "a decimal comma that makes a column more": (
        lambda f: f.project(HEADER + POSE.replace("400000", "400000,5")),
        1,
        ["poses.csv: line 2", "10 values for 9 columns", "decimal comma"],
    ),
    "poses in degrees for a CRS in metres": (
        lambda f: f.project(HEADER + POSE.replace("400000,6000000", "7.47,54.14")),
        1,
        ["poses.csv", "look like degrees"],
    ),
    "a CRS in degrees for poses in metres": (
        lambda f: f.project(crs="EPSG:4326"),
        1,
        ["WGS 84 is not projected in metres", "give the CRS that the poses are in"],
    ),
    "poses without columns": (
        lambda f: f.project("a,b\n1,2\n"),
        1,
        ["poses.csv", "no column 'timestamp_ns'", "the columns are a, b"],
    ),
    # options
    "no operand": (lambda _: merge(), 2, ["LOCAL", "--help"]),
    "an operand without a name": (lambda _: merge(""), 2, ["the name of an input is empty"]),
    "a main map without a name": (lambda f: merge(f.layer(), "--main-map", ""), 2, ["the name of an input is empty"]),
    "an unknown command": (lambda f: ["merg", f.layer()], 2, ["merg", "merge", "--help"]),
    "an unknown option": (lambda f: merge(f.layer(), "--proximty", "2"), 2, ["--proximty", "--proximity"]),
    "an unknown CRS": (lambda _: merge("gone.gpkg", "--crs", "EPSG:1"), 2, ["EPSG:1", "such as EPSG:32632", "local"]),
    "an unknown CRS of the output": (lambda _: merge("gone.gpkg", "--out-crs", "utm"), 2, ["'utm'", "EPSG:32632"]),
    "an unknown CRS to project to": (lambda f: f.project(crs="utm 32"), 2, ["'utm 32'", "EPSG:32632"]),
    "a proximity of nothing": (lambda _: merge("gone.gpkg", "--proximity", "0"), 2, ["proximity cannot be 0", "above"]),
    "a proximity under nothing": (lambda _: merge("gone.gpkg", "--proximity=-1"), 2, ["proximity cannot be -1"]),
    "a proximity that is no number": (lambda _: merge("gone.gpkg", "--proximity", "nan"), 2, ["proximity", "nan"]),
    "a proximity of kilometres": (lambda _: merge("gone.gpkg", "--proximity", "5000"), 2, ["at most 1000 m"]),
    "a decimal comma in an option": (lambda _: merge("gone.gpkg", "--proximity", "1,5"), 2, ["--proximity", "1,5"]),
    "a score in per cent": (lambda _: merge("gone.gpkg", "--min-score", "80"), 2, ["min_score", "from 0 to 1"]),
    "a coverage of nothing": (lambda _: merge("gone.gpkg", "--coverage", "0"), 2, ["coverage cannot be 0"]),
    "an unknown method": (lambda _: merge("gone.gpkg", "--method", "best"), 2, ["--method", "best", "polymerge"]),
    "an unknown way to carry columns": (
        lambda _: merge("gone.gpkg", "--aggregate", "median"),
        2,
        ["aggregate cannot be 'median'", "first, mode, mean"],
    ),
    "two ways to carry all columns": (
        lambda _: merge("gone.gpkg", "--aggregate", "mean", "--aggregate", "max"),
        2,
        ["one function for all columns, or COLUMN=FUNCTION"],
    ),
    "a way to carry a column that is absent": (
        lambda f: merge(f.layer(), "--aggregate", "width=mean"),
        2,
        ["column 'width'", "the columns are id"],
    ),
    "an origin of one number": (
        lambda f: f.project(HEADER + POSE, None, "--pose-kind", "origin", "--origin", "54.1"),
        2,
        ["--origin is '54.1'", "LAT,LON"],
    ),
    "an origin that is missing": (
        lambda f: f.project(HEADER + POSE, None, "--pose-kind", "origin"),
        2,
        ["pose_kind=origin needs origin"],
    ),
    "a footprint with decimal commas": (
        lambda f: f.project(HEADER + POSE, None, "--footprint", "-30,0,-15,0,30,0,15,0"),
        2,
        ["--footprint", "4 numbers", "XMIN,YMIN,XMAX,YMAX"],
    ),
    "a footprint inside out": (
        lambda f: f.project(HEADER + POSE, None, "--footprint", "30,15,-30,-15"),
        2,
        ["footprint cannot be", "XMIN,YMIN,XMAX,YMAX"],
    ),
}


def _database(path: Path) -> Path:
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE t (x)")
    database.close()
    return path


def _assert_one_error(outcome, code: int, *said: str) -> None:
    assert len(outcome.errors) == 1, outcome.err
    (error,) = outcome.errors
    assert outcome.err.splitlines()[-1] == error
    missing = [text for text in said if text not in error]
    assert missing == [], error
    assert outcome.code == code
    assert outcome.out == ""
    assert "Traceback" not in outcome.err
    assert "this is a fault of PolyMerge" not in outcome.err


@pytest.mark.parametrize(("make", "code", "said"), BAD.values(), ids=BAD)
def test_what_cannot_be_used_is_said_in_one_line_and_no_output_is_touched(run, tmp_path, make, code, said):
    inputs, outputs = tmp_path / "in", tmp_path / "out"
    inputs.mkdir()
    outputs.mkdir()
    (outputs / "map.gpkg").write_bytes(OLD)
    arguments = make(Folder(inputs))
    before = {path: path.read_bytes() for path in inputs.iterdir()}
    outcome = run(*arguments, "-o", outputs / "map.gpkg", "--overwrite", "--json", outputs / "report.json")
    _assert_one_error(outcome, code, *said)
    assert {path.name: path.read_bytes() for path in outputs.iterdir()} == {"map.gpkg": OLD}
    assert {path: path.read_bytes() for path in inputs.iterdir()} == before


def test_no_command_is_wrong_usage(run):
    _assert_one_error(run(), 2, "Missing command", "--help")


def test_no_output_is_wrong_usage(run, tmp_path):
    _assert_one_error(run("merge", draw(tmp_path / "roads.gpkg", PAIR)), 2, "--output")


# -- features that are left out --------------------------------------------------------------------

UNUSABLE = {
    "a vertex that is no number": ([line((0, 20), (np.nan, 21), (5, 20))], {}, "a coordinate is not a number"),
    "an infinite vertex": ([line((0, 20), (np.inf, 21), (5, 20))], {}, "a coordinate is not a number"),
    "a vertex beyond all maps": ([line((0, 20), (1e13, 21))], {}, "a coordinate is too large"),
    "no geometry": ([None], {}, "no geometry"),
    "an empty geometry": ([LineString()], {}, "empty geometry"),
    "a point among lines": ([Point(EAST, NORTH)], {}, "neither a line nor a polygon"),
    "a line of one place": ([line((3, 3), (3, 3))], {}, "zero length"),
    "a line shorter than a nanometre": ([line((3, 3), (3, 3 + 1e-12))], {}, "zero length"),
    "a ring that crosses itself": (
        [area((0, 20), (4, 24), (4, 20), (0, 24))],
        {},
        "the ring of an area touches or crosses itself",
    ),
    "a line of two vertices of an area class": (
        [line((0, 20), (9, 20))],
        {"class": ["divider", "divider", "ped_crossing"]},
        "an open line of two vertices encloses no area",
    ),
    "no class": ([line((0, 20), (9, 20))], {"class": ["a", "a", None]}, "no class"),
    "no instance": ([line((0, 20), (9, 20))], {"instance": ["1", "2", None]}, "no instance"),
    "a score that is no number": ([line((0, 20), (9, 20))], {"score": [1, 1, np.nan]}, "the score is not a number"),
    "a score that is text": ([line((0, 20), (9, 20))], {"score": ["1", "1", "0,9"]}, "the score is not a number"),
    "a score over 1": ([line((0, 20), (9, 20))], {"score": [1, 1, 1.01]}, "the score is not between 0 and 1"),
    "a score under 0": ([line((0, 20), (9, 20))], {"score": [1, 1, -0.01]}, "the score is not between 0 and 1"),
}


@pytest.mark.parametrize(("shapes", "columns", "reason"), UNUSABLE.values(), ids=UNUSABLE)
def test_a_feature_that_cannot_be_used_is_left_out_with_a_reason(run, tmp_path, shapes, columns, reason):
    roads = draw(tmp_path / "roads.gpkg", [*PAIR, *shapes], **columns)
    out = tmp_path / "out.gpkg"
    outcome = run("merge", roads, "-o", out, "--json", "-")
    assert outcome.code == 0, outcome.err
    assert look(out, "left_out")[["source", "source_fid", "reason"]].to_numpy().tolist() == [["roads", 3, reason]]
    assert json.loads(outcome.out)["left_out"] == {reason: 1}
    assert f"1 left out ({reason}: 1)" in outcome.err
    # The others came out as if it had never been there.
    assert coordinates(look(out, "elements")) == coordinates(_merged(run, tmp_path, PAIR))


@pytest.mark.parametrize(("shapes", "columns", "reason"), UNUSABLE.values(), ids=UNUSABLE)
def test_strict_makes_it_an_error_that_names_the_feature(run, tmp_path, shapes, columns, reason):
    roads = draw(tmp_path / "roads.gpkg", [*PAIR, *shapes], **columns)
    outcome = run("merge", roads, "-o", tmp_path / "out.gpkg", "--strict")
    _assert_one_error(outcome, 1, "layer 'roads': feature 3", reason, "mend the layer")
    assert not (tmp_path / "out.gpkg").exists()


def _merged(run, tmp_path: Path, shapes: Any) -> gpd.GeoDataFrame:
    sound = draw(tmp_path / "sound.gpkg", shapes)
    assert run("merge", sound, "-o", tmp_path / "sound_out.gpkg").code == 0
    return look(tmp_path / "sound_out.gpkg", "elements")


def test_bad_vectors_of_a_prediction_are_left_out(run, tmp_path):
    vectors = [[[0, 1.8], [20, 1.7]], [[0, 0], [float("nan"), 0]], [[0, 0]], [[0, 5], [9, 5]]]
    frame = {"vectors": vectors, "scores": [0.9, 0.9, 0.9, float("nan")], "labels": [1, 1, 1, 1]}
    outcome = run(*Folder(tmp_path).project(predictions={"a": frame}), "-o", tmp_path / "local.gpkg", "--json", "-")
    assert outcome.code == 0, outcome.err
    report = json.loads(outcome.out)
    assert report["observations"] == 1
    assert sum(report["left_out"].values()) == 3
    assert len(look(tmp_path / "local.gpkg", "left_out")) == 3
    # The list goes with the data to its end.
    merged = run("merge", tmp_path / "local.gpkg", "-o", tmp_path / "out.gpkg", "--json", "-")
    assert json.loads(merged.out)["left_out"] == report["left_out"]


# -- features that look odd and are fine -----------------------------------------------------------

ODD = {
    "multi-part lines": ([MultiLineString(PAIR)], 2),
    "multi-part polygons": (
        [MultiPolygon([area((0, 0), (9, 0), (9, 4), (0, 4)), area((0, 50), (9, 50), (9, 54), (0, 54))])],
        2,
    ),
    "a collection": ([GeometryCollection([PAIR[0], line((0, 30), (9, 30))]), PAIR[1]], 2),
    "heights": (from_wkt([f"LINESTRING Z ({EAST} {NORTH} 7, {EAST + 9} {NORTH} 8)"]), 1),
    "heights that are no numbers": (from_wkt([f"LINESTRING Z ({EAST} {NORTH} nan, {EAST + 9} {NORTH} 8)"]), 1),
    "measures": (from_wkt([f"LINESTRING M ({EAST} {NORTH} 7, {EAST + 9} {NORTH} 8)"]), 1),
    "heights and measures": (from_wkt([f"LINESTRING ZM ({EAST} {NORTH} 7 1, {EAST + 9} {NORTH} 8 2)"]), 1),
    "a vertex three times": ([line((0, 0), (4, 0), (4, 0), (4, 0), (9, 0))], 1),
    "a line that crosses itself": ([line((0, 0), (9, 9), (9, 0), (0, 9))], 1),
    "a closed line": ([line((0, 0), (9, 0), (9, 9), (0, 0))], 1),
}


@pytest.mark.parametrize(("shapes", "elements"), ODD.values(), ids=ODD)
def test_odd_geometry_is_used(run, tmp_path, shapes, elements):
    roads = draw(tmp_path / "roads.parquet", shapes)
    outcome = run("merge", roads, "-o", tmp_path / "out.gpkg", "--strict")
    assert outcome.code == 0, outcome.err
    merged = look(tmp_path / "out.gpkg", "elements")
    assert len(merged) == elements
    assert not merged.has_z.any()
    assert np.isfinite(np.concatenate(coordinates(merged))).all()


def test_the_same_layer_twice_counts_once_and_is_listed(run, tmp_path):
    roads = draw(tmp_path / "roads.gpkg", [PAIR[0]])
    outcome = run("merge", roads, roads, "-o", tmp_path / "out.gpkg")
    assert outcome.code == 0, outcome.err
    assert look(tmp_path / "out.gpkg", "elements")["n_observations"].tolist() == [1]
    assert look(tmp_path / "out.gpkg", "left_out")["reason"].tolist() == ["duplicate"]


def test_classes_that_differ_in_case_are_kept_apart_and_told(run, tmp_path):
    roads = draw(tmp_path / "roads.gpkg", PAIR, **{"class": ["Kerb", "kerb"]})
    outcome = run("merge", roads, "-o", tmp_path / "out.gpkg")
    assert outcome.code == 0
    assert len(look(tmp_path / "out.gpkg", "elements")) == 2
    assert outcome.warnings == ["warning: the classes 'Kerb', 'kerb' are not merged with each other"]


def test_a_column_that_differs_in_case_is_found(run, tmp_path):
    roads = draw(tmp_path / "roads.gpkg", PAIR, Class=["kerb", "lane"])
    assert run("merge", roads, "-o", tmp_path / "out.gpkg").code == 0
    assert look(tmp_path / "out.gpkg", "elements")["class"].tolist() == ["kerb", "lane"]


def test_a_layer_of_points_beside_lines_is_skipped_and_told(run, tmp_path):
    file = draw(tmp_path / "survey.gpkg", [Point(EAST, NORTH)], layer="poles")
    draw(file, PAIR, layer="kerbs")
    outcome = run("merge", file, "-o", tmp_path / "out.gpkg")
    assert outcome.code == 0
    assert "layer poles holds points" in outcome.warnings[0]


def test_an_extension_does_not_decide_what_a_file_is(run, tmp_path):
    shutil.copy(draw(tmp_path / "roads.gpkg", PAIR), tmp_path / "roads.json")
    assert run("merge", tmp_path / "roads.json", "-o", tmp_path / "out.gpkg").code == 0
    assert len(look(tmp_path / "out.gpkg", "elements")) == 1


def test_a_crs_that_is_not_needed_is_told(run, tmp_path):
    outcome = run("merge", draw(tmp_path / "r.gpkg", PAIR), "--crs", "EPSG:25832", "-o", tmp_path / "out.gpkg")
    assert outcome.code == 0
    assert outcome.warnings == ["warning: crs was not used: every layer has a CRS of its own"]
    assert look(tmp_path / "out.gpkg", "elements").crs == UTM


def test_decimal_commas_between_semicolons_are_read(run, tmp_path):
    poses = (HEADER + POSE.replace("400000", "400000.5")).replace(",", ";").replace(".", ",")
    outcome = run(*Folder(tmp_path).project(poses), "-o", tmp_path / "local.gpkg")
    assert outcome.code == 0, outcome.err
    assert look(tmp_path / "local.gpkg", "instances")["x"].tolist() == [EAST + 0.5]


def test_windows_line_ends_and_a_byte_order_mark_are_read(run, tmp_path):
    poses = "\ufeff" + (HEADER + POSE).replace("\n", "\r\n")
    assert run(*Folder(tmp_path).project(poses), "-o", tmp_path / "local.gpkg").code == 0


# -- nothing to merge ------------------------------------------------------------------------------


@pytest.mark.parametrize("extension", ["gpkg", "shp", "geojson", "fgb", "parquet"])
def test_empty_layers_give_an_empty_map_with_its_columns_and_crs(run, tmp_path, extension):
    empty = [draw(tmp_path / f"{name}.gpkg", []) for name in ("one", "two")]
    outcome = run("merge", *empty, "-o", tmp_path / f"out.{extension}", "--json", "-")
    assert outcome.code == 0, outcome.err
    assert json.loads(outcome.out)["elements"] == 0
    written = look(tmp_path / f"out.{extension}", "elements" if extension == "gpkg" else None)
    assert len(written) == 0
    assert written.crs == UTM
    if extension != "geojson":  # which has no columns but those of its features
        assert {"class", "score", "length_m"} < set(written.columns)
    assert [text for text in outcome.warnings if "holds no features" in text] == [
        "warning: layer 'one' holds no features",
        "warning: layer 'two' holds no features",
    ]


def test_a_network_of_nothing(run, tmp_path):
    outcome = run("network", draw(tmp_path / "none.gpkg", []), "-o", tmp_path / "out.gpkg")
    assert outcome.code == 0, outcome.err
    assert len(look(tmp_path / "out.gpkg", "edges")) == len(look(tmp_path / "out.gpkg", "observations")) == 0


def test_an_empty_layer_beside_others_is_told(run, tmp_path):
    empty = draw(tmp_path / "empty.gpkg", [], crs=None)
    outcome = run("merge", empty, draw(tmp_path / "roads.gpkg", PAIR), "-o", tmp_path / "out.gpkg")
    assert outcome.code == 0
    assert outcome.warnings == ["warning: layer 'empty' holds no features"]
    assert len(look(tmp_path / "out.gpkg", "lineage")) == 2


def test_a_main_map_merged_with_nothing_is_itself(run, tmp_path):
    main_map = draw(tmp_path / "map.gpkg", [line((0, 0), (9, 0)), line((0, 0.5), (9, 0.5))], element_id=[4, 2])
    outcome = run("merge", draw(tmp_path / "none.gpkg", []), "--main-map", main_map, "-o", tmp_path / "out.gpkg")
    assert outcome.code == 0, outcome.err
    elements = look(tmp_path / "out.gpkg", "elements")
    assert elements["element_id"].tolist() == [2, 4]
    assert coordinates(elements) == [
        [[EAST, NORTH + 0.5], [EAST + 9, NORTH + 0.5]],
        [[EAST, NORTH], [EAST + 9, NORTH]],
    ]


# -- outputs ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["merge", "network"])
def test_an_existing_output_is_refused_then_replaced(run, tmp_path, command):
    roads, out = draw(tmp_path / "roads.gpkg", PAIR), tmp_path / "out.gpkg"
    out.write_bytes(OLD)
    _assert_one_error(run(command, roads, "-o", out), 1, "out.gpkg exists", "--overwrite")
    assert out.read_bytes() == OLD
    assert run(command, roads, "-o", out, "--overwrite").code == 0
    assert out.read_bytes() != OLD


def test_an_existing_report_is_refused(run, tmp_path):
    (tmp_path / "r.json").write_bytes(OLD)
    outcome = run(
        "merge", draw(tmp_path / "roads.gpkg", PAIR), "-o", tmp_path / "out.gpkg", "--json", tmp_path / "r.json"
    )
    _assert_one_error(outcome, 1, "r.json exists", "--overwrite")
    assert not (tmp_path / "out.gpkg").exists()


@pytest.mark.parametrize("beside", ["out_areas.shp", "out_tables.gpkg", "out.dbf"])
def test_an_existing_part_of_the_output_is_refused(run, tmp_path, beside):
    roads = draw(tmp_path / "roads.gpkg", [*PAIR, area((0, 50), (9, 50), (9, 54), (0, 54))])
    (tmp_path / beside).write_bytes(OLD)
    _assert_one_error(run("merge", roads, "-o", tmp_path / "out.shp"), 1, f"{beside} exists", "--overwrite")
    assert {path.name for path in tmp_path.iterdir()} == {"roads.gpkg", beside}
    assert (tmp_path / beside).read_bytes() == OLD


@pytest.mark.parametrize("role", ["local map", "main map", "part of a Shapefile", "symbolic link"])
def test_an_input_is_never_replaced(run, tmp_path, role):
    roads, main_map = draw(tmp_path / "roads.shp", PAIR), draw(tmp_path / "map.gpkg", PAIR)
    (tmp_path / "link.gpkg").symlink_to(main_map)
    out, report = {
        "local map": (roads, tmp_path / "r.json"),
        "main map": (main_map, tmp_path / "r.json"),
        "part of a Shapefile": (tmp_path / "out.gpkg", tmp_path / "roads.dbf"),
        "symbolic link": (tmp_path / "link.gpkg", tmp_path / "r.json"),
    }[role]
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    outcome = run("merge", roads, "--main-map", main_map, "-o", out, "--json", report, "--overwrite")
    _assert_one_error(outcome, 1, "is an input of this run", "name another output")
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    ("target", "code", "said"),
    [
        pytest.param("gone/out.gpkg", 1, ["does not exist", "create it first"], id="a folder that is missing"),
        pytest.param("folder.gpkg", 1, ["is a folder", "name a file in it"], id="a folder"),
        pytest.param("roads.gpkg/out.gpkg", 1, ["is a file, not a folder"], id="a file as folder"),
        pytest.param("out.txt", 1, ["out.txt", "extension", ".gpkg"], id="an unknown extension"),
        pytest.param("out", 1, ["extension", ".gpkg"], id="no extension"),
    ],
)
def test_an_output_that_cannot_be_is_told_before_anything_is_read(run, tmp_path, target, code, said):
    draw(tmp_path / "roads.gpkg", PAIR)
    (tmp_path / "folder.gpkg").mkdir()
    outcome = run("merge", tmp_path / "gone.gpkg", "-o", tmp_path / target, "--overwrite")
    _assert_one_error(outcome, code, *said)
    assert {path.name for path in tmp_path.iterdir()} == {"roads.gpkg", "folder.gpkg"}


def test_a_report_to_the_output_is_refused(run, tmp_path):
    roads, out = draw(tmp_path / "roads.gpkg", PAIR), tmp_path / "out.gpkg"
    _assert_one_error(run("merge", roads, "-o", out, "--json", out), 1, "two outputs", "name another")
    assert not out.exists()


def test_an_output_that_another_program_is_writing_is_refused(run, tmp_path):
    roads, out = draw(tmp_path / "roads.gpkg", PAIR), draw(tmp_path / "out.gpkg", PAIR)
    (tmp_path / "out.gpkg-wal").write_bytes(b"what was not saved yet")
    before = out.read_bytes()
    outcome = run("merge", roads, "-o", out, "--overwrite")
    _assert_one_error(outcome, 1, "out.gpkg is open in another program", "out.gpkg-wal")
    assert out.read_bytes() == before


# -- bad luck --------------------------------------------------------------------------------------


def test_a_file_that_another_process_has_locked(run, tmp_path):
    roads = draw(tmp_path / "roads.gpkg", PAIR)
    holding = (
        "import sqlite3, sys; database = sqlite3.connect(sys.argv[1]); database.execute('BEGIN EXCLUSIVE'); "
        "print('held', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", holding, roads], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout.readline() == "held\n"
        outcome = run("merge", roads, "-o", tmp_path / "out.gpkg")
        other.stdin.close()
    _assert_one_error(outcome, 1, "roads.gpkg is locked", "another program is writing to it")
    assert not (tmp_path / "out.gpkg").exists()
    assert run("merge", roads, "-o", tmp_path / "out.gpkg").code == 0


@pytest.mark.parametrize("extension", ["gpkg", "shp", "parquet"])
def test_a_full_disk_leaves_the_old_output_whole(run_alone, tmp_path, extension):
    inputs, outputs = tmp_path / "in", tmp_path / "out"
    inputs.mkdir()
    outputs.mkdir()
    roads = draw(
        inputs / "roads.gpkg", noisy_copies(30, 2000)[:, None].ravel(), **{"class": [f"c{n}" for n in range(30)]}
    )
    out = outputs / f"map.{extension}"
    out.write_bytes(OLD)

    def little_room() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))

    outcome = run_alone("merge", roads, "-o", out, "--overwrite", preexec_fn=little_room)
    _assert_one_error(outcome, 1, f"map.{extension} cannot be written", "disk full", "free some space")
    assert {path.name: path.read_bytes() for path in outputs.iterdir()} == {out.name: OLD}


def test_a_crash_of_the_programs_own_is_one_line_too(run, tmp_path, monkeypatch):
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("two\nlines")

    monkeypatch.setattr("polymerge_core.merge", broken)
    roads = draw(tmp_path / "roads.gpkg", PAIR)
    outcome = run("merge", roads, "-o", tmp_path / "out.gpkg")
    assert (outcome.code, outcome.out) == (1, "")
    assert outcome.err.startswith("error: ZeroDivisionError: two lines; this is a fault of PolyMerge")
    assert outcome.err.count("\n") == 1
    monkeypatch.setenv("POLYMERGE_TRACEBACK", "1")
    with pytest.raises(ZeroDivisionError):
        run("merge", roads, "-o", tmp_path / "out.gpkg")
    assert {path.name for path in tmp_path.iterdir()} == {"roads.gpkg"}


def test_too_little_memory_is_one_line_too(run, tmp_path, monkeypatch):
    def greedy(*_: object, **__: object) -> None:
        raise MemoryError

    monkeypatch.setattr("polymerge_core.merge", greedy)
    outcome = run("merge", draw(tmp_path / "roads.gpkg", PAIR), "-o", tmp_path / "out.gpkg")
    _assert_one_error(outcome, 1, "not enough memory", "in parts")


def test_a_reader_of_the_report_that_leaves_is_no_fault(tmp_path):
    roads = draw(tmp_path / "roads.gpkg", PAIR)
    command = [sys.executable, "-m", "polymerge_core", "merge", roads, "-o", tmp_path / "out.gpkg", "--json", "-"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
        child.stdout.close()
        said = child.stderr.read()
    assert "Traceback" not in said
    assert "Exception ignored" not in said
    # The map was complete before anyone was told of it.
    assert len(look(tmp_path / "out.gpkg", "elements")) == 1
