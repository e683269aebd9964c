"""Layers come out as they went in, and bad files are refused with a sentence."""

import datetime as dt
import hashlib
import http.server
import pickle
import resource
import shutil
import sqlite3
import struct
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pyogrio
import pyproj
import pytest
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from polymerge_core import io
from polymerge_core.crs import LOCAL_CRS, is_local
from polymerge_core.errors import CrsError, InputError, OutputError
from polymerge_core.io import (
    LayerWarning,
    layer_targets,
    list_layers,
    read_layers,
    read_local_maps,
    read_table,
    split_source,
    stage_layers,
    write_layers,
)
from polymerge_core.outputs import StagedOutputs

UTM = "EPSG:25833"
EXTENSIONS = ["gpkg", "shp", "geojson", "fgb", "parquet"]
LINES = ["LINESTRING (0.123456789012 1, 2 3)", "LINESTRING (10 10, 20 20, 30 10)"]
BIG = 2**53 + 1


def layer(wkt=LINES, *, crs=UTM, **columns):
    return gpd.GeoDataFrame(columns, geometry=gpd.GeoSeries.from_wkt(list(wkt), crs=crs))


def empty(crs=UTM):
    return gpd.GeoDataFrame({"a": pd.Series([], dtype="int64")}, geometry=gpd.GeoSeries([], crs=crs))


def only(path, **options):
    (frame,) = read_layers(path, **options).values()
    return frame


def digest(path):
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def temporaries(folder):
    return [entry.name for entry in Path(folder).iterdir() if entry.name.startswith(".polymerge-")]


@pytest.fixture
def gpkg(tmp_path):
    path = tmp_path / "roads.gpkg"
    write_layers(path, {"roads": layer(a=[1, 2])})
    return path


# -- round trips


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_a_layer_comes_back_as_it_was(tmp_path, extension):
    path = tmp_path / f"roads.{extension}"
    frame = layer(
        ["LINESTRING (0.123456789012 1, 2 3)", "MULTILINESTRING ((10 10, 20 20), (30 10, 40 40))"],
        number=pd.array([BIG, None], dtype="Int64"),
        share=[0.1, np.nan],
        name=["Straße ملخص", None],
        yes=pd.array([True, None], dtype="boolean"),
        day=[dt.date(2020, 2, 29), None],
    )
    before = frame.copy(deep=True)
    assert write_layers(path, {"roads": frame}) == ([path], {})
    back = only(path).sort_values("number")
    assert back.index.name == "fid"
    assert back.crs == frame.crs
    assert back.number.tolist()[0] == BIG
    assert back.number.isna().tolist() == [False, True]
    assert back.share.tolist()[0] == 0.1
    assert back.name.tolist()[0] == "Straße ملخص"
    assert back.name.isna().tolist() == back.yes.isna().tolist() == back.day.isna().tolist() == [False, True]
    assert back.yes.tolist()[0] is True
    # FlatGeobuf has no dates, only times.
    assert pd.Timestamp(back.day.tolist()[0]) == pd.Timestamp(2020, 2, 29)
    assert extension == "fgb" or isinstance(back.day.tolist()[0], dt.date)
    parts = shapely.get_parts(back.geometry.to_numpy())
    expected = shapely.get_parts(frame.geometry.to_numpy())
    assert shapely.equals_exact(parts, expected, 0).all()
    pd.testing.assert_frame_equal(frame, before)


@pytest.mark.parametrize("extension", ["gpkg", "geojson", "fgb", "parquet"])
@pytest.mark.parametrize("zone", [None, "UTC", "Europe/Berlin"])
def test_times_keep_their_instant(tmp_path, extension, zone):
    path = tmp_path / f"roads.{extension}"
    times = pd.Series(pd.to_datetime(["2020-01-01T10:00:00.123", "2020-07-01T10:00:00.123"])).dt.tz_localize(zone)
    write_layers(path, {"roads": layer(at=times)})
    back = only(path)["at"]
    assert pd.to_datetime(back, utc=True).sort_values().tolist() == pd.to_datetime(times, utc=True).tolist()


def test_times_finer_than_a_millisecond_are_told(tmp_path):
    frame = layer(at=pd.to_datetime(["2020-01-01T00:00:00.123456789", "2020-01-01T00:00:00.000000000"]))
    with pytest.warns(LayerWarning, match="column at: times are kept to the millisecond"):
        write_layers(tmp_path / "roads.gpkg", {"roads": frame})


def test_shapefile_gets_times_as_text(tmp_path):
    write_layers(tmp_path / "roads.shp", {"roads": layer(at=pd.to_datetime(["2020-01-01T10:00:00.5", None]))})
    assert only(tmp_path / "roads.shp")["at"].tolist()[0] == "2020-01-01T10:00:00.500000"


def test_many_layers_and_tables_share_one_geopackage(tmp_path):
    path = tmp_path / "merged.gpkg"
    areas = layer(["POLYGON ((0 0, 1 0, 1 1, 0 0))"], element_id=[3])
    table = pd.DataFrame({"old_id": [4, 5], "element_id": [1, 2]})
    written = write_layers(
        path, {"elements": layer(), "elements_areas": areas, "id_aliases": table, "nothing": table.iloc[:0]}
    )
    assert written.paths == [path]
    assert list(read_layers(path)) == ["elements", "elements_areas"]
    assert [each.name for each in list_layers(path)] == [
        "elements",
        "elements_areas",
        "id_aliases",
        "nothing",
    ]
    back = read_table(path, "id_aliases")
    assert back.to_dict("list") == table.to_dict("list")
    assert list(read_table(path, "nothing").columns) == ["old_id", "element_id"]
    with sqlite3.connect(path) as database:
        assert database.execute("PRAGMA user_version").fetchone() == (10300,)
        kinds = dict(database.execute("SELECT table_name, data_type FROM gpkg_contents").fetchall())
    database.close()
    assert kinds["id_aliases"] == "attributes"


def test_formats_of_one_layer_get_files_beside_it(tmp_path):
    frames = {
        "lineage": pd.DataFrame({"weight": [0.5]}),
        "elements": layer(element_id=[1, 2]),
        "elements_areas": layer(["POLYGON ((0 0, 1 0, 1 1, 0 0))"]),
        "network": layer(),
    }
    written = write_layers(tmp_path / "m.shp", frames)
    names = {path.name for path in written.paths}
    assert names == {"m.shp", "m_areas.shp", "m_network.shp", "m_tables.gpkg"}
    assert written.renamed == {"elements": {"element_id": "elem_id"}}
    assert only(tmp_path / "m_areas.shp").geom_type.tolist() == ["Polygon"]
    assert read_table(tmp_path / "m_tables.gpkg", "lineage").weight.tolist() == [0.5]
    assert temporaries(tmp_path) == []


def test_targets_can_be_asked_for_before_the_work():
    frames = {"edges": layer(), "observations": layer(), "t": pd.DataFrame()}
    targets = layer_targets("out/net.fgb", frames, tables_path="out/t.gpkg")
    assert targets == {
        "edges": Path("out/net.fgb"),
        "observations": Path("out/net_observations.fgb"),
        "t": Path("out/t.gpkg"),
    }


@pytest.mark.parametrize("extension", ["gpkg", "shp", "fgb", "parquet"])
@pytest.mark.parametrize("kind", ["LineString", "Polygon"])
def test_an_empty_layer_keeps_its_type_and_crs(tmp_path, extension, kind):
    path = tmp_path / f"none.{extension}"
    write_layers(path, {"none": empty()}, geometry_types={"none": kind})
    back = only(path)
    assert len(back) == 0
    assert back.crs == UTM
    assert "a" in back
    if extension != "parquet":
        assert list_layers(path)[0].geometry_type == kind


@pytest.mark.parametrize(
    ("wkt", "kind"),
    [
        (LINES, "LineString"),
        ([LINES[0], "MULTILINESTRING ((0 0, 1 1))"], "MultiLineString"),
        (["POLYGON ((0 0, 1 0, 1 1, 0 0))", "MULTIPOLYGON (((0 0, 1 0, 1 1, 0 0)))"], "MultiPolygon"),
        ([LINES[0], "POLYGON ((0 0, 1 0, 1 1, 0 0))"], "Unknown"),
        (["LINESTRING Z (0 0 1, 1 1 2)"], "LineString Z"),
        (["LINEARRING (0 0, 1 0, 1 1, 0 0)"], "LineString"),
        ([LINES[0], None], "LineString"),
    ],
    ids=["single", "mixed lines", "mixed polygons", "lines and polygons", "heights", "ring", "no geometry"],
)
def test_the_layer_type_fits_what_is_in_it(tmp_path, wkt, kind):
    write_layers(tmp_path / "a.gpkg", {"a": layer(wkt)})
    assert list_layers(tmp_path / "a.gpkg")[0].geometry_type == kind
    assert len(only(tmp_path / "a.gpkg")) == len(wkt)


def test_m_values_are_dropped_with_a_warning_and_heights_kept(tmp_path):
    with pytest.warns(LayerWarning, match="M values are not written"):
        write_layers(
            tmp_path / "a.gpkg",
            {"a": layer(["LINESTRING ZM (0 0 1 7, 1 1 2 8)", "LINESTRING Z (0 0 1, 1 1 2)"])},
        )
    assert only(tmp_path / "a.gpkg").to_wkt().geometry.tolist() == ["LINESTRING Z (0 0 1, 1 1 2)"] * 2


# -- coordinate reference systems


@pytest.mark.parametrize("extension", ["gpkg", "shp", "fgb", "parquet"])
def test_plain_coordinates_stay_plain(tmp_path, extension):
    path = tmp_path / f"local.{extension}"
    write_layers(path, {"local": layer(crs=LOCAL_CRS)})
    back = only(path)
    assert is_local(back.crs)
    assert back.crs == LOCAL_CRS
    if extension == "gpkg":
        with sqlite3.connect(path) as database:
            assert database.execute("SELECT srs_id FROM gpkg_geometry_columns").fetchall() == [(-1,)]
        database.close()


def test_geojson_refuses_a_crs_that_it_cannot_name(tmp_path):
    own = pyproj.CRS.from_proj4("+proj=tmerc +lat_0=10 +lon_0=11.123 +k=1 +ellps=GRS80 +units=m")
    for crs in (LOCAL_CRS, None, own):
        with pytest.raises(OutputError, match="GeoJSON cannot say"):
            write_layers(tmp_path / "a.geojson", {"a": layer(crs=crs)})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("extension", ["gpkg", "shp", "fgb", "parquet"])
def test_no_crs_stays_none(tmp_path, extension):
    write_layers(tmp_path / f"a.{extension}", {"a": layer(crs=None)})
    assert only(tmp_path / f"a.{extension}").crs is None


def test_a_geopackage_of_undefined_geographic_crs_has_none(gpkg):
    with sqlite3.connect(gpkg) as database:
        database.execute("UPDATE gpkg_geometry_columns SET srs_id = 0")
        database.execute("UPDATE gpkg_contents SET srs_id = 0")
    database.close()
    assert only(gpkg).crs is None


def test_plain_coordinates_in_feet_are_refused(tmp_path):
    feet = LOCAL_CRS.to_wkt().replace('"metre",1', '"foot",0.3048').replace("Undefined Cartesian SRS", "Site grid")
    write_layers(tmp_path / "a.parquet", {"a": layer(crs=feet)})
    with pytest.raises(CrsError, match="plain coordinates are in foot"):
        read_layers(tmp_path / "a.parquet")


# -- columns


def test_names_that_clash_are_renamed_and_told(tmp_path):
    frame = layer(cls=[1, 2], CLS=[3, 4], fid=[5, 6], geom=[7, 8])
    frame["Geometry"] = [9, 10]
    written = write_layers(tmp_path / "a.gpkg", {"a": frame})
    renames = {"CLS": "CLS_1", "fid": "fid_1", "geom": "geom_1", "Geometry": "Geometry_1"}
    assert written.renamed == {"a": renames}
    back = only(tmp_path / "a.gpkg")
    assert back[["cls", "CLS_1", "fid_1", "geom_1", "Geometry_1"]].iloc[0].tolist() == [1, 3, 5, 7, 9]


def test_long_shapefile_names_stay_apart(tmp_path):
    frame = layer(
        element_id=[1, 2],
        n_observations=[1, 2],
        surface_material=[1, 2],
        surface_marking=[3, 4],
        größenordnung=[5, 6],
    )
    written = write_layers(tmp_path / "a.shp", {"a": frame})
    assert written.renamed["a"] == {
        "element_id": "elem_id",
        "n_observations": "n_obs",
        "surface_material": "surface_ma",
        "surface_marking": "surface__1",
        "größenordnung": "größenor",
    }
    back = only(tmp_path / "a.shp")
    assert back[["surface_ma", "surface__1", "größenor"]].iloc[0].tolist() == [1, 3, 5]


@settings(max_examples=50, deadline=None)
@given(names=st.lists(st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=15), max_size=12))
@pytest.mark.parametrize("kind", ["GPKG", "ESRI Shapefile"])
def test_fitted_names_are_always_unique(kind, names):
    fitted = io._fit_names(names, kind, "a layer")
    folded = [name.casefold() for name in fitted]
    assert len(set(folded)) == len(names)
    assert not {"fid", "geom", "geometry", ""} & set(folded)
    assert kind == "GPKG" or all(len(name.encode()) <= 10 for name in fitted)


ODD = {
    "list": ([[1, "ü"], None], '[1, "ü"]'),
    "array": ([np.array([1, 2]), None], "[1, 2]"),
    "dict": (
        [{"a": {1}, "b": dt.date(2020, 1, 2), "c": np.int64(3)}, None],
        '{"a": [1], "b": "2020-01-02", "c": 3}',
    ),
    "bytes": ([b"\x00\xff", None], "00ff"),
    "mixed": ([1, "one"], "1"),
    "clock": ([dt.time(12, 30), None], "12:30:00"),
    "duration": (pd.to_timedelta(["90s", None]), "P0DT0H1M30S"),
    "period": (pd.PeriodIndex(["2020-01", "2020-02"], freq="M"), "2020-01"),
    "category": (pd.Categorical(["x", None]), "x"),
    "numbered category": (pd.Categorical([BIG, None]), BIG),
    "huge": ([2**70, 1], str(2**70)),
    "objects": (np.array([BIG, None], dtype=object), BIG),
    "arrow list": (pd.Series([[1], None], dtype=pd.ArrowDtype(pa.list_(pa.int64()))), "[1]"),
    "arrow number": (pd.Series([BIG, None], dtype="int64[pyarrow]"), BIG),
    "sparse": (pd.arrays.SparseArray([1.5, 2.0]), 1.5),
    "nothing": ([None, None], None),
}


@pytest.mark.parametrize("extension", ["gpkg", "shp", "parquet"])
@pytest.mark.parametrize("case", ODD)
def test_odd_values_are_written_in_a_documented_way(tmp_path, extension, case):
    values, expected = ODD[case]
    if extension == "shp" and expected == BIG:
        expected = BIG
    frame = layer()
    frame["v"] = values
    write_layers(tmp_path / f"a.{extension}", {"a": frame})
    got = only(tmp_path / f"a.{extension}")["v"].tolist()[0]
    assert got == expected or (expected is None and pd.isna(got))


def test_a_second_geometry_column_becomes_text(tmp_path):
    frame = layer()
    frame["centre"] = frame.centroid
    write_layers(tmp_path / "a.gpkg", {"a": frame})
    assert only(tmp_path / "a.gpkg").centre.tolist()[1] == "POINT (20 15)"


@pytest.mark.parametrize(
    ("extension", "values", "message"),
    [
        ("gpkg", ["a\0b", "c"], "column v, row 0: text with a NUL"),
        ("gpkg", pd.Series(["c", "\ud800"], dtype=object), "column v, row 1: text with half a character"),
        ("shp", ["c", "ü" * 128], "column v, row 1: Shapefile cuts text at 254 bytes"),
        ("shp", [1, 10**18], "1000000000000000000 is too long a number"),
        ("gpkg", np.array([1, 2**63], dtype="uint64"), "too long a number"),
    ],
    ids=["nul", "surrogate", "long text", "wide integer", "unsigned"],
)
def test_values_that_would_be_damaged_are_refused(tmp_path, extension, values, message):
    frame = layer()
    frame["v"] = values
    with pytest.raises(OutputError, match=message):
        write_layers(tmp_path / f"a.{extension}", {"a": frame})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["gpkg_x", "RTREE_a", "sqlite_b", "", "a\0b", "a\nb"])
def test_bad_layer_names_are_refused(tmp_path, name):
    with pytest.raises(OutputError, match="a layer cannot be called"):
        write_layers(tmp_path / "a.gpkg", {name: layer()})


@pytest.mark.parametrize("name", ['o\'neil "x"; DROP', "ü ö", "x" * 100])
def test_unusual_layer_names_are_kept(tmp_path, name):
    write_layers(tmp_path / "a.gpkg", {name: layer()})
    assert list(read_layers(tmp_path / "a.gpkg")) == [name]


def test_a_layer_name_cannot_lead_elsewhere(tmp_path):
    with pytest.raises(OutputError, match="a layer cannot be called"):
        write_layers(tmp_path / "a.shp", {"elements": layer(), "../../x": layer()})


@pytest.mark.parametrize("target", ["a.xyz", "a", "a.json"])
def test_unknown_extensions_are_refused_with_the_known_ones(tmp_path, target):
    with pytest.raises(OutputError, match=r"must be one of \.gpkg, \.shp, \.geojson, \.fgb, \.parquet"):
        write_layers(tmp_path / target, {"a": layer()})


def test_what_a_format_cannot_hold_is_refused(tmp_path):
    polygon = "POLYGON ((0 0, 1 0, 1 1, 0 0))"
    with pytest.raises(OutputError, match="mixes LineString and Polygon"):
        write_layers(tmp_path / "a.shp", {"a": layer([LINES[0], polygon])})
    with pytest.raises(OutputError, match="with and without heights"):
        write_layers(tmp_path / "a.fgb", {"a": layer([LINES[0], "LINESTRING Z (0 0 1, 1 1 2)"])})
    with pytest.raises(OutputError, match="FlatGeobuf cannot hold a feature without geometry"):
        write_layers(tmp_path / "a.fgb", {"a": layer([LINES[0], None])})
    with pytest.raises(OutputError, match="no layer to write"):
        write_layers(tmp_path / "a.fgb", {"a": pd.DataFrame({"x": [1]})})
    with pytest.raises(OutputError, match="path with ! or ;"):
        write_layers(tmp_path / "a;b.gpkg", {"a": layer()})
    with pytest.raises(OutputError, match="tables are written to a GeoPackage"):
        write_layers(tmp_path / "a.fgb", {"a": layer()}, tables_path="t.csv")
    assert list(tmp_path.iterdir()) == []


# -- reading what others wrote


@pytest.mark.parametrize("extension", ["gpkg", "geojson", "fgb", "parquet"])
def test_files_are_known_by_their_content(tmp_path, extension):
    write_layers(tmp_path / f"a.{extension}", {"a": layer()})
    disguised = tmp_path / "a.dat"
    shutil.copy(tmp_path / f"a.{extension}", disguised)
    assert len(only(disguised)) == 2


@pytest.mark.parametrize("name", ["mit Leerzeichen ü ö.gpkg", "x" * 120 + ".gpkg", "100%20 #?.gpkg", "a|b.gpkg"])
@pytest.mark.parametrize("folder", [".", "tiefer/ordner mit ä" + "/lang" * 30], ids=["short", "long"])
def test_unusual_paths_work(tmp_path, name, folder):
    (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    path = tmp_path / folder / name
    write_layers(path, {"roads": layer()})
    assert len(only(path)) == 2
    assert len(only(f"{path}|layername=roads")) == 2


@pytest.mark.parametrize(
    ("text", "file", "name"),
    [
        ("a.gpkg", "a.gpkg", None),
        ("a.gpkg|layername=roads", "a.gpkg", "roads"),
        ("a.gpkg|LayerName=x|y", "a.gpkg", "x|y"),
        ("../a b.gpkg|layername=a=b", "../a b.gpkg", "a=b"),
        ("a|b.gpkg", "a|b.gpkg", None),
    ],
)
def test_a_source_is_split_as_qgis_writes_it(text, file, name):
    assert split_source(text) == (Path(file), name)


@pytest.mark.parametrize("option", ["subset=a=1", "layerid=0", "geometrytype=Polygon", "layername="])
def test_a_source_that_selects_features_is_refused(option):
    with pytest.raises(InputError, match=r"only \|layername=LAYER may follow"):
        split_source(f"a.gpkg|{option}")


@pytest.mark.parametrize(
    "source",
    ["/vsicurl/http://x/a.gpkg", "http://x/a.gpkg", "https://x/a", "s3://b/a.gpkg", "/vsizip/a.zip/a.shp"],
)
def test_remote_sources_are_refused(source):
    with pytest.raises(InputError, match="is not a file on this computer"):
        read_layers(source)


def test_nothing_is_fetched_over_the_network(tmp_path):
    asked = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            self.send_error(404)

        do_HEAD = do_GET  # noqa: N815 - the server's name for it

        def log_message(self, *_):
            pass

    with http.server.HTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}"
        for key, kind, address in (("crs", "link", "href"), ("\\u0063rs", "URL", "url")):
            path = tmp_path / "link.geojson"
            path.write_text(
                f'{{"type":"FeatureCollection","{key}":{{"type":"{kind}","properties":{{"{address}":"{url}/crs"}}}},'
                '"features":[{"type":"Feature","properties":{},"geometry":{"type":"LineString",'
                '"coordinates":[[0,0],[1,1]]}}]}'
            )
            with pytest.raises(InputError, match="link to the network"):
                read_layers(path)
        vrt = tmp_path / "v.gpkg"
        vrt.write_text(
            f'<OGRVRTDataSource><OGRVRTLayer name="a"><SrcDataSource>/vsicurl/{url}/a.gpkg</SrcDataSource>'
            "</OGRVRTLayer></OGRVRTDataSource>"
        )
        with pytest.raises(InputError, match="is not a GeoPackage"):
            read_layers(vrt)
        server.shutdown()
    assert asked == []


def damaged(path, damage):
    whole = path.read_bytes()
    path.write_bytes(
        {
            "zero bytes": b"",
            "half": whole[: len(whole) // 2],
            "head": whole[:1000],
            "tail": whole[:-20],
            "garbage": b"garbage " * 100,
            "hole": whole[: len(whole) // 2] + b"\xff" * 400 + whole[len(whole) // 2 + 400 :],
        }[damage]
    )


@pytest.mark.parametrize("damage", ["zero bytes", "half", "head", "tail", "garbage", "hole"])
@pytest.mark.parametrize("extension", EXTENSIONS)
def test_damaged_files_are_refused_by_name(tmp_path, extension, damage):
    path = tmp_path / f"roads.{extension}"
    lines = [f"LINESTRING ({n} 0, {n} 1)" for n in range(200)]
    write_layers(path, {"roads": layer(lines, a=range(200), b=["some text"] * 200)})
    damaged(path, damage)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LayerWarning)
        if (extension, damage) in {("fgb", "hole"), ("shp", "hole"), ("gpkg", "hole")}:
            # Damage in the middle of a coordinate or an index cannot be told from data; it must not crash.
            try:
                read_layers(path)
            except InputError as error:
                assert "roads." in str(error)  # noqa: PT017 - may or may not be raised
        else:
            with pytest.raises(InputError, match=r"roads\."):
                read_layers(path)


@pytest.mark.parametrize("part", [".dbf", ".shx"])
def test_a_shapefile_without_a_part_or_with_a_cut_or_foreign_one_is_refused(tmp_path, part):
    write_layers(tmp_path / "one.shp", {"a": layer(LINES[:1] * 3, a=[1, 2, 3])})
    write_layers(tmp_path / "two.shp", {"a": layer(a=[1, 2])})
    (tmp_path / "one").with_suffix(part).unlink()
    with pytest.raises(InputError, match=rf"one\{part} is missing"):
        read_layers(tmp_path / "one.shp")
    shutil.copy(tmp_path / f"two{part}", tmp_path / f"one{part}")
    with pytest.raises(InputError, match="do not belong together"):
        read_layers(tmp_path / "one.shp")
    cut = (tmp_path / f"two{part}").read_bytes()
    (tmp_path / f"two{part}").write_bytes(cut[:-4])
    with pytest.raises(InputError, match="is cut short"):
        read_layers(tmp_path / "two.shp")


def test_pickles_are_refused_with_a_way_out(tmp_path):
    for name, content in (("a.gpkg", pickle.dumps([1])), ("a.pkl", b"(lp0\n.")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=r"Python pickle.*convert it"):
            read_layers(tmp_path / name)


def test_what_is_not_there_or_not_a_file_or_not_a_map_is_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_layers(tmp_path / "no.gpkg")
    with pytest.raises(InputError, match="is not a file"):
        read_layers(tmp_path)
    with sqlite3.connect(tmp_path / "a.db") as database:
        database.execute("CREATE TABLE a(b)")
    database.close()
    with pytest.raises(InputError, match="SQLite database, but not a GeoPackage"):
        read_layers(tmp_path / "a.db")
    pq.write_table(pa.table({"a": [1]}), tmp_path / "a.parquet")
    with pytest.raises(InputError, match="Parquet file without geometry"):
        read_layers(tmp_path / "a.parquet")
    (tmp_path / "a.geojson").write_text('{"vectors": []}')
    with pytest.raises(InputError, match=r"a\.geojson"):
        read_layers(tmp_path / "a.geojson")
    write_layers(tmp_path / "a;b.parquet", {"a": layer()})
    with pytest.raises(InputError, match="path with ! or ;"):
        read_layers(tmp_path / "a;b.parquet")
    write_layers(tmp_path / "s.shp", {"a": layer()})
    shutil.copy(tmp_path / "s.shp", tmp_path / "s.dat")
    with pytest.raises(InputError, match="is not called so"):
        read_layers(tmp_path / "s.dat")


def test_an_unknown_layer_is_refused_with_the_known_ones(tmp_path):
    write_layers(tmp_path / "a.gpkg", {"one": layer(), "two": layer(), "table": pd.DataFrame({"x": [1]})})
    with pytest.raises(InputError, match="has no layer three; its layers are one, two, table"):
        read_layers(f"{tmp_path / 'a.gpkg'}|layername=three")
    with pytest.raises(InputError, match="has no layer three; its layers are"):
        read_table(tmp_path / "a.gpkg", "three")
    with pytest.raises(InputError, match="table is a table without geometry"):
        read_layers(tmp_path / "a.gpkg", layer="table")


def test_a_file_of_tables_only_is_refused(tmp_path):
    write_layers(tmp_path / "a.gpkg", {"one": pd.DataFrame({"x": [1]})})
    with pytest.raises(InputError, match=r"no layer of lines or polygons, only tables \(one\)"):
        read_layers(tmp_path / "a.gpkg")


def test_points_are_refused_alone_and_skipped_among_others(tmp_path):
    points = layer(["POINT (0 0)", "POINT (1 1)"])
    write_layers(tmp_path / "p.gpkg", {"trees": points})
    with pytest.raises(InputError, match="layer trees holds points; PolyMerge merges lines and polygons"):
        read_layers(tmp_path / "p.gpkg")
    write_layers(tmp_path / "p.parquet", {"trees": points})
    with pytest.raises(InputError, match="holds points"):
        read_layers(tmp_path / "p.parquet")
    write_layers(tmp_path / "a.gpkg", {"trees": points, "roads": layer()})
    with pytest.raises(InputError, match="layer trees holds points"):
        read_layers(tmp_path / "a.gpkg", layer="trees")
    with pytest.warns(LayerWarning, match="layer trees holds points.*is skipped"):
        assert list(read_layers(tmp_path / "a.gpkg")) == ["roads"]


def test_points_in_a_layer_of_any_geometry_are_found_by_looking(tmp_path):
    write_layers(tmp_path / "a.gpkg", {"roads": layer()})
    pyogrio.write_dataframe(layer(["POINT (0 0)"]), tmp_path / "a.gpkg", layer="trees", geometry_type="Unknown")
    with pytest.warns(LayerWarning, match="trees holds points.*is skipped"):
        assert list(read_layers(tmp_path / "a.gpkg")) == ["roads"]


def set_geometry(path, wkb, fid=1):
    """Put any WKB in a GeoPackage, as another program would."""
    with sqlite3.connect(path) as database:
        blob = database.execute("SELECT geom FROM roads").fetchone()[0]
        envelope = {0: 0, 1: 32, 2: 48, 3: 48, 4: 64}[(blob[3] >> 1) & 7]
        for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
            database.execute(f'DROP TRIGGER "{name}"')
        database.execute("UPDATE roads SET geom = ? WHERE fid = ?", (blob[: 8 + envelope] + wkb, fid))
    database.close()


ARC = struct.pack("<BII6d", 1, 8, 3, 0, 0, 1, 1, 2, 0)


def test_curves_become_lines_and_integers_stay_exact(tmp_path):
    path = tmp_path / "roads.gpkg"
    write_layers(path, {"roads": layer(a=pd.array([BIG, None], dtype="Int64"))})
    set_geometry(path, ARC)
    back = only(path)
    assert back.geom_type.tolist() == ["LineString", "LineString"]
    assert back.geometry.iloc[0].length == pytest.approx(np.pi, rel=1e-3)
    assert back.a.tolist() == [BIG, pd.NA]


@pytest.mark.parametrize(
    "wkb",
    [struct.pack("<BIIBII6d", 1, 7, 1, 1, 8, 3, 0, 0, 1, 1, 2, 0), struct.pack("<BIIdd", 1, 2, 1, 0, 0)],
    ids=["curve in a collection", "line of one vertex"],
)
def test_a_geometry_that_cannot_be_decoded_is_none_with_a_warning(gpkg, wkb):
    set_geometry(gpkg, wkb)
    with pytest.warns(LayerWarning, match="layer roads"):
        back = only(gpkg)
    assert back.geometry.isna().tolist() == [True, False]


def test_a_flatgeobuf_feature_without_geometry_does_not_crash_the_reader(tmp_path):
    frame = layer([LINES[0], None], a=[1, 2])
    pyogrio.write_dataframe(frame, tmp_path / "a.fgb", SPATIAL_INDEX="NO", use_arrow=False)
    back = only(tmp_path / "a.fgb")
    assert back.geometry.isna().tolist() == [False, True]
    assert back.a.tolist() == [1, 2]


def test_an_attribute_called_geometry_is_kept_under_another_name(tmp_path):
    (tmp_path / "a.geojson").write_text(
        '{"type":"FeatureCollection","features":[{"type":"Feature","properties":{"geometry":"abc","fid":7},'
        '"geometry":{"type":"LineString","coordinates":[[0,0],[1,1]]}}]}'
    )
    back = only(tmp_path / "a.geojson")
    assert back.geometry_1.tolist() == ["abc"]
    assert back.fid.tolist() == [7]
    assert back.geom_type.tolist() == ["LineString"]


def test_a_shapefile_in_an_old_encoding_is_read(tmp_path):
    frame = layer(LINES[:1], name=["Straße"])
    pyogrio.write_dataframe(frame, tmp_path / "a.shp", encoding="ISO-8859-1")
    (tmp_path / "a.cpg").unlink()
    assert only(tmp_path / "a.shp").name.tolist() == ["Straße"]


def test_geoparquet_with_its_own_index_and_geometry_name(tmp_path):
    frame = layer(a=[1, 2]).rename_geometry("shape").set_index("a")
    frame.to_parquet(tmp_path / "a.parquet")
    back = only(tmp_path / "a.parquet")
    assert back.geometry.name == "geometry"
    assert back.a.tolist() == [1, 2]
    assert back.index.tolist() == [0, 1]


# -- locks, journals and logs of other programs


def child(code, *arguments):
    return subprocess.run([sys.executable, "-c", code, *map(str, arguments)], check=False, timeout=60)


def test_reading_changes_nothing(gpkg):
    before = digest(gpkg)
    names = sorted(path.name for path in gpkg.parent.iterdir())
    read_layers(gpkg)
    list_layers(gpkg)
    assert digest(gpkg) == before
    assert sorted(path.name for path in gpkg.parent.iterdir()) == names


def test_a_locked_geopackage_is_said_to_be_locked_soon(gpkg, monkeypatch):
    monkeypatch.setattr(io, "_LOCK_SECONDS", 0.3)
    code = (
        "import sqlite3, sys\ndatabase = sqlite3.connect(sys.argv[1], isolation_level=None)\n"
        "database.execute('BEGIN EXCLUSIVE')\nprint('locked', flush=True)\nsys.stdin.read()"
    )
    command = [sys.executable, "-c", code, str(gpkg)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"locked\n"
        started = time.monotonic()
        with pytest.raises(InputError, match=r"roads\.gpkg is locked: another program"):
            read_layers(gpkg)
        assert time.monotonic() - started < 3
        process.stdin.close()
    assert len(only(gpkg)) == 2


CRASH = """
import os, sqlite3, sys
database = sqlite3.connect(sys.argv[1], isolation_level=None)
database.execute(f"PRAGMA journal_mode = {sys.argv[2]}")
database.execute("PRAGMA cache_size = 1")
for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
    database.execute(f'DROP TRIGGER "{name}"')
database.execute("BEGIN")
database.execute("CREATE TABLE zz(a TEXT)")
database.executemany("INSERT INTO zz VALUES (?)", [("x" * 1000,)] * 1000)
database.execute("UPDATE roads SET a = 7 WHERE fid = 1")
if sys.argv[2] == "wal":
    database.execute("COMMIT")
os._exit(0)
"""


def test_a_hot_journal_is_told_and_kept(gpkg):
    child(CRASH, gpkg, "delete")
    before = digest(gpkg)
    journal = gpkg.with_name("roads.gpkg-journal")
    assert journal.stat().st_size > 0
    with pytest.raises(InputError, match="a program crashed while writing to it"):
        read_layers(gpkg)
    assert journal.exists()
    assert digest(gpkg) == before


def test_a_write_ahead_log_is_read_but_not_merged_into_the_file(gpkg):
    child(CRASH, gpkg, "wal")
    before = digest(gpkg)
    log = gpkg.with_name("roads.gpkg-wal")
    assert log.stat().st_size > 0
    with pytest.warns(LayerWarning, match="open in another program, or a program crashed"):
        assert only(gpkg).a.tolist() == [7, 2]
    assert log.stat().st_size > 0
    assert digest(gpkg) == before


def test_a_geopackage_in_write_ahead_mode_is_read_without_a_trace(gpkg):
    with sqlite3.connect(gpkg) as database:
        database.execute("PRAGMA journal_mode = wal")
    database.close()
    before = digest(gpkg)
    assert len(only(gpkg)) == 2
    assert digest(gpkg) == before
    assert sorted(path.name for path in gpkg.parent.iterdir()) == ["roads.gpkg"]


# -- local maps


def test_the_contract_says_which_layers_are_meant(tmp_path):
    footprint = layer(["POLYGON ((0 0, 1 0, 1 1, 0 0))"], n_observations=[0])
    left_out = pd.DataFrame({"reason": ["zero length"]})
    write_layers(
        tmp_path / "a.gpkg",
        {
            "local_maps": layer(),
            "instances": footprint,
            "left_out": left_out,
            "elements": layer(),
            "x": layer(),
        },
    )
    (maps,) = read_local_maps([tmp_path / "a.gpkg"])
    assert maps.source == "a"
    assert len(maps.observations) == 2
    assert maps.instances.n_observations.tolist() == [0]
    assert maps.left_out.reason.tolist() == ["zero length"]
    (named,) = read_local_maps([f"{tmp_path / 'a.gpkg'}|layername=x"])
    assert named.instances is None
    assert named.left_out is None


def test_a_merged_map_means_its_lines_and_areas(tmp_path):
    areas = layer(["POLYGON ((0 0, 1 0, 1 1, 0 0))"])
    write_layers(tmp_path / "m.gpkg", {"x": layer(), "elements": layer(), "elements_areas": areas})
    maps = read_local_maps([tmp_path / "m.gpkg"])
    assert [(each.source, len(each.observations)) for each in maps] == [
        ("elements", 2),
        ("elements_areas", 1),
    ]


def test_any_other_file_means_all_its_lines_and_polygons(tmp_path):
    write_layers(
        tmp_path / "a.gpkg",
        {"n": layer(), "s": layer(), "t": pd.DataFrame({"a": [1]}), "p": layer(["POINT (0 0)"])},
    )
    with pytest.warns(LayerWarning, match="layer p holds points"):
        assert [each.source for each in read_local_maps([tmp_path / "a.gpkg"])] == ["n", "s"]


def test_sources_are_named_by_the_shortest_end_of_their_paths(tmp_path):
    files = ["one/track.shp", "two/track.shp", "two/other.shp", "x/two/track.shp"]
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        write_layers(tmp_path / file, {"a": layer()})
    names = [maps.source for maps in read_local_maps(tmp_path / file for file in [*files, files[0]])]
    assert names == ["one/track", f"{tmp_path.name}/two/track", "other", "x/two/track", "one/track"]


def test_the_order_of_the_files_does_not_change_their_names(tmp_path):
    keys = [(tmp_path / folder / f"t.{ext}", "l") for folder in "ab" for ext in ("gpkg", "shp")]
    names = dict(zip(keys, io._source_names(keys), strict=True))
    assert sorted(names.values()) == ["a/t.gpkg", "a/t.shp", "b/t.gpkg", "b/t.shp"]
    assert dict(zip(keys[::-1], io._source_names(keys[::-1]), strict=True)) == names


def test_layers_of_the_same_name_in_two_files_are_told_apart(tmp_path):
    keys = [(tmp_path / file, name) for file in ("a.gpkg", "b.gpkg") for name in ("dividers", "boundaries")]
    assert io._source_names(keys) == ["a/dividers", "a/boundaries", "b/dividers", "b/boundaries"]


# -- safe writes


def test_an_output_cannot_be_an_input(gpkg):
    before = digest(gpkg)
    with pytest.raises(OutputError, match="is an input of this run"):
        write_layers(gpkg, {"a": layer()}, overwrite=True, inputs=[f"{gpkg}|layername=roads"])
    assert digest(gpkg) == before


def test_layers_and_a_report_appear_together(tmp_path):
    with pytest.raises(ZeroDivisionError), StagedOutputs() as outputs:  # noqa: PT012
        stage_layers(outputs, tmp_path / "a.gpkg", {"a": layer()})
        outputs.stage(tmp_path / "report.json").write_text("{}")
        1 / 0  # noqa: B018 - anything that fails late
    assert list(tmp_path.iterdir()) == []


def build(folder):
    folder.mkdir()
    times = pd.to_datetime(["2020-01-01", "2021-01-01"], utc=True)
    frame = layer(a=[1, 2], t=["x", "y"], at=times)
    for extension in EXTENSIONS:
        write_layers(folder / f"{extension}.{extension}", {"elements": frame, "table": pd.DataFrame({"x": [1]})})
    return {path.name: digest(path) for path in folder.iterdir()}


def test_the_same_layers_give_the_same_bytes(tmp_path, monkeypatch):
    before = pyogrio.get_gdal_config_option("OGR_CURRENT_DATE")
    first = build(tmp_path / "one")
    time.sleep(0.05)
    assert build(tmp_path / "two") == first
    assert pyogrio.get_gdal_config_option("OGR_CURRENT_DATE") == before
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    third = build(tmp_path / "three")
    assert third["gpkg.gpkg"] != first["gpkg.gpkg"]
    assert third["shp.dbf"] != first["shp.dbf"]


def big(rows=3000):
    text = np.random.default_rng(0).bytes(20 * rows).hex()
    words = [text[40 * n : 40 * n + 40] for n in range(rows)]
    return layer([f"LINESTRING ({n} 0, {n} 1, {n} 2)" for n in range(rows)], a=range(rows), b=words)


@pytest.mark.parametrize("extension", EXTENSIONS)
@pytest.mark.parametrize("share", [0.02, 0.5, 0.95])
def test_a_file_size_limit_leaves_the_old_file(tmp_path, extension, share):
    target = tmp_path / f"a.{extension}"
    write_layers(target, {"a": big()})
    size = target.stat().st_size
    write_layers(target, {"a": layer()}, overwrite=True)
    before = {path.name: digest(path) for path in tmp_path.iterdir()}
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(size * share), limits[1]))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LayerWarning)
            with pytest.raises(OutputError, match=r"a\.\w+ cannot be written.*disk"):
                write_layers(target, {"a": big()}, overwrite=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert {path.name: digest(path) for path in tmp_path.iterdir()} == before


FULL = """
import sys, warnings
sys.path.insert(0, sys.argv[1])
import test_io as t
from polymerge_core.errors import OutputError
warnings.simplefilter("ignore")
for extension in t.EXTENSIONS:
    target = t.Path(sys.argv[2], "a." + extension)
    t.write_layers(target, {"a": t.layer()})
    before = {path.name: t.digest(path) for path in target.parent.iterdir()}
    try:
        t.write_layers(target, {"a": t.big(20000)}, overwrite=True)
    except OutputError as error:
        assert "disk" in str(error), error
    else:
        raise SystemExit(extension + " was written to a full disk")
    assert {path.name: t.digest(path) for path in target.parent.iterdir()} == before
print("all refused")
"""


def test_a_full_disk_leaves_the_old_file(tmp_path):
    mount = 'mount -t tmpfs -o size=800k tmpfs "$0" && exec "$@"'
    probe = ["unshare", "-m", "sh", "-c", mount, str(tmp_path)]
    try:
        subprocess.run([*probe, "true"], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("a small file system can be mounted by root on Linux only")
    command = [*probe, sys.executable, "-c", FULL, str(Path(__file__).parent), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=100)
    assert done.stdout == "all refused\n", done.stderr


WRITER = """
import os, random, signal, sys, time
sys.path.insert(0, sys.argv[1])
import test_io as t
target, frame, moment = t.Path(sys.argv[2]), t.big(), random.Random(0)
left = 0
for _ in range(8):
    pid = os.fork()
    if pid == 0:
        while True:
            t.write_layers(target, {"a": frame, "b": frame}, overwrite=True)
    time.sleep(moment.uniform(0.05, 0.3))
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    left += len(t.temporaries(target.parent))
    database = t.sqlite3.connect(target)
    print(*(database.execute(f"SELECT count(*) FROM {name}").fetchone()[0] for name in "ab"))
    print(database.execute("PRAGMA integrity_check").fetchone()[0])
    database.close()
print(left > 0)
"""


def test_a_run_killed_at_any_moment_leaves_the_old_or_the_new_file(tmp_path):
    target = tmp_path / "a.gpkg"
    write_layers(target, {"a": layer(), "b": layer()})
    command = [sys.executable, "-W", "ignore", "-c", WRITER, str(Path(__file__).parent), str(target)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=100)
    *counts, killed_while_writing = done.stdout.splitlines()
    assert set(counts) <= {"2 2", "3000 3000", "ok"}
    assert killed_while_writing == "True"
    write_layers(target, {"a": layer()}, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["a.gpkg"]


texts = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=10)
coordinates = st.floats(-1e7, 1e7, allow_subnormal=False)


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    rows=st.lists(
        st.tuples(
            st.lists(st.tuples(coordinates, coordinates), min_size=2, max_size=4),
            st.none() | st.integers(-(2**63), 2**63 - 1),
            st.none() | texts,
        ),
        min_size=1,
        max_size=4,
    )
)
@pytest.mark.parametrize("extension", ["gpkg", "parquet", "fgb"])
def test_any_layer_comes_back_unchanged(tmp_path, extension, rows):
    lines, numbers, words = zip(*rows, strict=True)
    frame = gpd.GeoDataFrame(
        {
            "order": range(len(rows)),
            "number": pd.array(numbers, dtype="Int64"),
            "word": pd.Series(words, dtype=object),
        },
        geometry=[shapely.LineString(line) for line in lines],
        crs=UTM,
    )
    path = tmp_path / f"a.{extension}"
    write_layers(path, {"a": frame}, overwrite=True)
    back = only(path).sort_values("order")
    assert shapely.equals_exact(back.geometry.to_numpy(), frame.geometry.to_numpy(), 0).all()
    assert [None if pd.isna(value) else int(value) for value in back.number] == list(numbers)
    assert [None if pd.isna(value) else value for value in back.word] == list(words)
