"""Layers come out of files as they went in, in names and values that each format can hold."""

import datetime as dt
import json
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow as pa
import pyogrio
import pyproj
import pytest
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from polymerge_core.crs import LOCAL_CRS, is_local
from polymerge_core.errors import OutputError
from polymerge_core.io import (
    LayerWarning,
    fields,
    layer_targets,
    list_layers,
    read_layers,
    read_local_maps,
    read_table,
    write_layers,
)
from tests.core.layers import BIG, EXTENSIONS, LINES, SQUARE, UTM, digest, layer, only, temporaries


def empty(crs=UTM):
    return gpd.GeoDataFrame({"a": pd.Series([], dtype="int64")}, geometry=gpd.GeoSeries([], crs=crs))


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
    areas = layer([SQUARE], element_id=[3])
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
        "elements_areas": layer([SQUARE]),
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
        ([SQUARE, "MULTIPOLYGON (((0 0, 1 0, 1 1, 0 0)))"], "MultiPolygon"),
        ([LINES[0], SQUARE], "Unknown"),
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
    fitted = fields.fit_names(names, kind, "a layer")
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
        ("gpkg", np.array([1, 2**63], dtype="uint64"), "too long a number"),
    ],
    ids=["nul", "surrogate", "long text", "unsigned"],
)
def test_values_that_would_be_damaged_are_refused(tmp_path, extension, values, message):
    frame = layer()
    frame["v"] = values
    with pytest.raises(OutputError, match=message):
        write_layers(tmp_path / f"a.{extension}", {"a": frame})
    assert list(tmp_path.iterdir()) == []


def test_nanoseconds_go_to_a_shapefile_as_text_with_a_warning(tmp_path):
    frame = layer()
    frame["timestamp"] = [1_700_000_000_000_000_001, 1_700_000_000_000_000_002]
    with pytest.warns(LayerWarning, match="more than 18 digits are written as text"):
        write_layers(tmp_path / "a.shp", {"a": frame})
    assert only(tmp_path / "a.shp")["timestamp"].tolist() == ["1700000000000000001", "1700000000000000002"]


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
    polygon = SQUARE
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


# -- areas of an older map


def map_of(*, areas):
    lines = {"elements": layer(element_id=[1, 2], surface=["tar", "sand"])}
    return lines | ({"elements_areas": layer([SQUARE], element_id=[3], surface=["tar"])} if areas else {})


@pytest.mark.parametrize("extension", ["shp", "geojson", "fgb", "parquet"])
def test_areas_of_an_older_map_do_not_pass_for_those_of_a_new_one(tmp_path, extension):
    path, areas = tmp_path / f"m.{extension}", tmp_path / f"m_areas.{extension}"
    write_layers(path, map_of(areas=True))
    written = write_layers(path, map_of(areas=False), overwrite=True)
    assert written.paths == [path, areas]
    assert len(only(areas)) == 0
    assert [maps.source for maps in read_local_maps([path])] == ["m"]
    if extension in {"shp", "fgb"}:
        assert list_layers(areas)[0].geometry_type == "Polygon"
    write_layers(path, map_of(areas=True), overwrite=True)
    assert len(only(areas)) == 1


def test_areas_of_an_older_map_are_replaced_with_permission_only(tmp_path):
    write_layers(tmp_path / "m.fgb", map_of(areas=True))
    (tmp_path / "m.fgb").unlink()
    before = digest(tmp_path / "m_areas.fgb")
    with pytest.raises(OutputError, match=r"m_areas\.fgb exists: overwrite it"):
        write_layers(tmp_path / "m.fgb", map_of(areas=False))
    with pytest.raises(OutputError, match=r"m_areas\.fgb is an input"):
        write_layers(tmp_path / "m.fgb", map_of(areas=False), overwrite=True, inputs=[tmp_path / "m_areas.fgb"])
    assert digest(tmp_path / "m_areas.fgb") == before
    assert [path.name for path in tmp_path.iterdir()] == ["m_areas.fgb"]


@pytest.mark.parametrize(
    ("older", "new"),
    [
        (layer([SQUARE], parcel=[3]), map_of(areas=False)),
        (layer([SQUARE], element_id=[3]), {"elements": layer()}),
        (layer([SQUARE], element_id=[3]), {"local_maps": layer()}),
    ],
    ids=["older file without ids", "new map without ids", "no map"],
)
def test_a_file_that_would_not_be_taken_for_areas_is_left_alone(tmp_path, older, new):
    write_layers(tmp_path / "m_areas.fgb", {"a": older})
    before = digest(tmp_path / "m_areas.fgb")
    assert write_layers(tmp_path / "m.fgb", new, overwrite=True).paths == [tmp_path / "m.fgb"]
    assert digest(tmp_path / "m_areas.fgb") == before


def test_areas_that_cannot_be_told_apart_are_refused(tmp_path):
    (tmp_path / "m_areas.shp").write_bytes(b"garbage")
    with pytest.raises(OutputError, match=r"m_areas\.shp cannot be told from areas that belong to .*m\.shp; remove it"):
        write_layers(tmp_path / "m.shp", map_of(areas=False), overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["m_areas.shp"]


def test_what_is_read_with_an_input_is_not_replaced_either(tmp_path):
    write_layers(tmp_path / "m.shp", map_of(areas=True))
    with pytest.raises(OutputError, match=r"m_areas\.shp is an input of this run"):
        write_layers(tmp_path / "m_areas.shp", {"a": layer()}, overwrite=True, inputs=[tmp_path / "m.shp"])


# -- another reader

# A second GDAL in one process clashes with the first; so the other reader gets a process of its own.
OTHER_READER = """
import json, sys
import fiona
for path in sys.argv[1:]:
    for name in fiona.listlayers(path):
        with fiona.open(path, layer=name) as rows:
            shapes = [{"type": row.geometry.type, "coordinates": row.geometry.coordinates} for row in rows]
            numbers = [row.properties["a"] for row in rows]
            print(json.dumps([name, len(rows), rows.crs.to_epsg(), rows.schema["geometry"], numbers, shapes]))
"""


@pytest.mark.parametrize("extension", ["gpkg", "shp", "geojson", "fgb"])
def test_another_gdal_finds_the_same_layers_in_the_files(tmp_path, extension):
    lines = layer(a=[1, 2])
    areas = layer([SQUARE, "POLYGON ((5 5, 9 5, 9 9, 5 5), (7 6, 8 6, 8 7, 7 6))"], a=[3, 4])
    written = write_layers(tmp_path / f"m.{extension}", {"elements": lines, "elements_areas": areas})
    command = [sys.executable, "-c", OTHER_READER, *map(str, written.paths)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    found = [json.loads(line) for line in done.stdout.splitlines()]
    names = ["m", "m_areas"] if extension == "shp" else ["elements", "elements_areas"]
    assert [name for name, *_ in found] == names
    for (_, count, epsg, kind, numbers, shapes), frame in zip(found, (lines, areas), strict=True):
        assert count == len(shapes) == 2
        assert epsg == 25833
        assert kind == frame.geom_type.iloc[0]
        by_number = dict(zip(numbers, map(shapely.geometry.shape, shapes), strict=True))
        # Shapefile and GeoJSON each turn rings round in their own way.
        there = shapely.normalize([by_number[number] for number in frame.a])
        assert shapely.equals_exact(there, shapely.normalize(frame.geometry.to_numpy()), 0).all()
