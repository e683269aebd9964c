"""GeoPackages through sqlite3 alone are those of GDAL: it reads and edits what we write, and we read what it writes."""

from __future__ import annotations

import contextlib
import re
import sqlite3
import struct

import fiona
import geopandas as gpd
import numpy as np
import pyogrio
import pyproj
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj.crs.coordinate_operation import TransverseMercatorConversion
from shapely import LineString, Point, box, from_wkt

from polymerge_core.crs import LOCAL_CRS, is_local, parse_crs
from polymerge_core.store import geopackage

UTM = 32632
COLUMNS = {"class": "TEXT", "number": "INTEGER", "score": "REAL"}

SHAPES = {
    "point": "POINT (3 4)",
    "line": "LINESTRING (0 0, 10 5)",
    "area with a hole": "POLYGON ((0 0, 9 0, 9 9, 0 9, 0 0), (2 2, 4 2, 4 4, 2 2))",
    "several lines": "MULTILINESTRING ((0 0, 1 1), (5 5, 6 7))",
    "several areas": "MULTIPOLYGON (((0 0, 1 0, 1 1, 0 0)), ((5 5, 6 5, 6 6, 5 5)))",
    "collection": "GEOMETRYCOLLECTION (POINT (1 2), LINESTRING (0 0, 3 3))",
    "line with heights": "LINESTRING Z (0 0 7, 10 5 8)",
    "nothing": "LINESTRING EMPTY",
    "no area": "POLYGON EMPTY",
}


def array(*shapes):
    held = np.empty(len(shapes), dtype=object)
    held[:] = [from_wkt(shape) if isinstance(shape, str) else shape for shape in shapes]
    return held


def opened(path):
    return geopackage.connect(path, 0.01)


def made(path, crs=UTM, *, shapes=(), layer="things"):
    """Make a file with a layer, and return a connection to it."""
    crs = parse_crs(crs)
    path.touch()
    connection = opened(path)
    with geopackage.transaction(connection):
        number = geopackage.create(connection, crs)
        geopackage.create_layer(connection, layer, "fid", COLUMNS, "GEOMETRY", number)
        put(connection, shapes, number, layer)
    return connection


def put(connection, shapes, srs_id=UTM, layer="things"):
    shapes = array(*shapes)
    count = len(shapes)
    columns = {"class": ["a"] * count, "number": np.arange(count), "score": np.linspace(0, 1, count)}
    geopackage.insert(connection, layer, {"geom": geopackage.to_blobs(shapes, srs_id), **columns})
    geopackage.touched(connection, layer, shapes)


@pytest.fixture
def file(tmp_path):
    return tmp_path / "our.gpkg"


def features(connection, layer="things"):
    return connection.execute(f'SELECT fid, geom FROM "{layer}" ORDER BY fid').fetchall()


def check_whole(connection, layer="things"):
    """Hold the spatial index and the count against the features."""
    __tracebackhide__ = True
    rows = [(fid, blob) for fid, blob in features(connection, layer) if blob is not None]
    shapes = geopackage.from_blobs([blob for _, blob in rows])
    there = ~shapely.is_empty(shapes)
    index = geopackage.boxes(connection, layer)
    assert index[:, 0].tolist() == [fid for (fid, _), held in zip(rows, there, strict=True) if held]
    # The index is of single precision, rounded outwards.
    np.testing.assert_allclose(index[:, [1, 3, 2, 4]], shapely.bounds(shapes[there]).reshape(-1, 4), rtol=2e-7)
    query = "SELECT feature_count FROM gpkg_ogr_contents WHERE table_name = ?"
    assert connection.execute(query, (layer,)).fetchone() == (len(features(connection, layer)),)


def bounds_noted(connection, layer="things"):
    query = "SELECT min_x, min_y, max_x, max_y FROM gpkg_contents WHERE table_name = ?"
    return connection.execute(query, (layer,)).fetchone()


class TestBlobs:
    @pytest.mark.parametrize("wkt", SHAPES.values(), ids=SHAPES)
    def test_come_back_as_they_were(self, wkt):
        (back,) = geopackage.from_blobs(geopackage.to_blobs(array(wkt), UTM))
        assert shapely.equals_identical(back, from_wkt(wkt))

    @pytest.mark.parametrize("wkt", SHAPES.values(), ids=SHAPES)
    @pytest.mark.parametrize("engine", ["pyogrio", "fiona"])
    def test_are_what_gdal_reads(self, file, wkt, engine):
        made(file, shapes=[wkt]).close()
        (read,) = gpd.read_file(file, engine=engine).geometry
        assert shapely.equals_identical(read, from_wkt(wkt))

    @pytest.mark.parametrize("wkt", SHAPES.values(), ids=SHAPES)
    def test_of_gdal_are_read(self, file, wkt):
        gpd.GeoDataFrame(geometry=[from_wkt(wkt)], crs=UTM).to_file(file, layer="things")
        with contextlib.closing(opened(file)) as connection:
            ((_, blob),) = features(connection)
            (read,) = geopackage.from_blobs([blob])
            assert shapely.equals_identical(read, from_wkt(wkt))
            check_whole(connection)

    @pytest.mark.parametrize("order", ["<", ">"], ids=["little endian", "big endian"])
    @pytest.mark.parametrize("wkb_order", [0, 1], ids=["wkb big endian", "wkb little endian"])
    @pytest.mark.parametrize("kind", range(5), ids=["no envelope", "xy", "xyz", "xym", "xyzm"])
    def test_of_every_header_are_read(self, file, kind, order, wkb_order):
        line = LineString([(1, 2), (10, 5)])
        envelope = [1.0, 10.0, 2.0, 5.0, 0.0, 7.0, -1.0, 1.0][: [0, 4, 6, 6, 8][kind]]
        flags = kind << 1 | (order == "<")
        head = struct.pack(f"{order}2sBBi{len(envelope)}d", b"GP", 0, flags, UTM, *envelope)
        blob = head + shapely.to_wkb(line, byte_order=wkb_order)
        (read,) = geopackage.from_blobs([blob])
        assert shapely.equals_identical(read, line)
        file.touch()
        with contextlib.closing(opened(file)) as connection:
            names = ("ST_MinX", "ST_MaxX", "ST_MinY", "ST_MaxY", "ST_IsEmpty")
            found = connection.execute(f"SELECT {', '.join(f'{name}(?1)' for name in names)}", (blob,)).fetchone()
        assert found == (1, 10, 2, 5, 0)

    def test_begin_with_magic_crs_and_bounds(self):
        (blob,) = geopackage.to_blobs(array("LINESTRING (1 2, 10 5)"), 31467)
        assert struct.unpack_from("<2sBBi4d", blob) == (b"GP", 0, 0b011, 31467, 1, 10, 2, 5)

    def test_of_nothing_say_so_and_have_no_bounds(self):
        (blob,) = geopackage.to_blobs(array("LINESTRING EMPTY"), UTM)
        assert blob[:8] == struct.pack("<2sBBi", b"GP", 0, 0b10001, UTM)
        assert shapely.from_wkb(blob[8:]).is_empty

    def test_of_none_are_none(self):
        assert geopackage.to_blobs(array(), UTM) == []
        assert len(geopackage.from_blobs([])) == 0

    @settings(max_examples=50)
    @given(st.lists(st.tuples(*[st.floats(-1e8, 1e8)] * 2), min_size=2, max_size=6), st.integers(-1, 2**31 - 1))
    def test_keep_every_bit_of_every_coordinate(self, points, srs_id):
        line = LineString(points)
        blobs = geopackage.to_blobs(array(line), srs_id)
        assert shapely.to_wkb(geopackage.from_blobs(blobs)[0]) == shapely.to_wkb(line)
        assert struct.unpack_from("<i", blobs[0], 4) == (srs_id,)


class TestLayer:
    @pytest.fixture
    def both(self, tmp_path):
        """Our file and GDAL's, with the same layer."""
        shapes = array("LINESTRING (400000 6000000, 400010 6000005)", "POINT (400003 6000009)")
        made(tmp_path / "our.gpkg", shapes=shapes).close()
        columns = {"class": "a", "number": np.arange(2), "score": [0.0, 1.0]}
        pyogrio.write_dataframe(
            gpd.GeoDataFrame(columns, geometry=shapes, crs=UTM),
            tmp_path / "gdal.gpkg",
            layer="things",
            geometry_type="Unknown",
            dataset_options={"VERSION": "1.3"},
        )
        with contextlib.ExitStack() as stack:
            names = ("our.gpkg", "gdal.gpkg")
            yield [stack.enter_context(contextlib.closing(sqlite3.connect(tmp_path / name))) for name in names]

    @staticmethod
    def schema(connection):
        rows = connection.execute("SELECT name, sql FROM sqlite_master WHERE tbl_name NOT LIKE 'gpkg_tile%'")
        return {name: re.sub(r"\s+|(?<=\W)\s+", "", (sql or "").upper()).replace("NOTNULL", "") for name, sql in rows}

    def test_has_the_tables_indexes_and_triggers_of_gdal(self, both):
        our, gdal = map(self.schema, both)
        assert our == gdal

    @pytest.mark.parametrize(
        "query",
        [
            "SELECT table_name, data_type, identifier, description, srs_id FROM gpkg_contents",
            "SELECT min_x, min_y, max_x, max_y FROM gpkg_contents",
            "SELECT * FROM gpkg_geometry_columns",
            "SELECT * FROM gpkg_extensions",
            "SELECT * FROM gpkg_ogr_contents",
            "SELECT * FROM rtree_things_geom",
            "SELECT srs_id, organization, organization_coordsys_id FROM gpkg_spatial_ref_sys ORDER BY srs_id",
            "SELECT definition FROM gpkg_spatial_ref_sys WHERE srs_id = 32632",
            "SELECT fid, class, number, score FROM things",
            "PRAGMA application_id",
            "PRAGMA user_version",
        ],
    )
    def test_is_registered_as_gdal_does_it(self, both, query):
        our, gdal = (connection.execute(query).fetchall() for connection in both)
        assert our == gdal

    def test_is_read_by_gdal_with_types_ids_and_bounds(self, file):
        made(file, shapes=["LINESTRING (0 0, 10 5)", "POINT (3 40)"]).close()
        about = pyogrio.read_info(file, force_total_bounds=True)
        assert about["fields"].tolist() == ["class", "number", "score"]
        assert about["dtypes"].tolist() == ["object", "int64", "float64"]
        assert about["fid_column"] == "fid"
        assert about["geometry_name"] == "geom"
        assert about["features"] == 2
        assert about["total_bounds"] == (0, 0, 10, 40)
        assert about["capabilities"]["fast_spatial_filter"]

    def test_is_filtered_by_gdal_with_the_index(self, file):
        made(file, shapes=[Point(x, 0) for x in range(50)]).close()
        assert gpd.read_file(file, bbox=(9.5, -1, 12.5, 1))["number"].tolist() == [10, 11, 12]

    def test_without_geometry_is_a_table_of_attributes(self, file):
        with contextlib.closing(made(file)) as connection:
            geopackage.create_table(connection, "notes", "fid", {"text": "TEXT"})
            geopackage.insert(connection, "notes", {"text": ["a", None]})
        assert pyogrio.list_layers(file).tolist() == [["things", "Unknown"], ["notes", None]]
        assert pyogrio.read_dataframe(file, layer="notes")["text"].dropna().to_dict() == {0: "a"}
        assert pyogrio.read_info(file, layer="notes")["features"] == 2


class TestSpatialIndexAndCount:
    SHAPES = ("LINESTRING (0 0, 10 5)", "POINT (3 4)", "LINESTRING EMPTY")

    @pytest.fixture
    def connection(self, file):
        with contextlib.closing(made(file, shapes=self.SHAPES)) as held:
            yield held

    def test_follow_inserts(self, connection):
        assert geopackage.boxes(connection, "things").tolist() == [[1, 0, 10, 0, 5], [2, 3, 3, 4, 4]]
        check_whole(connection)

    @pytest.mark.parametrize(
        "change",
        [
            "UPDATE things SET geom = (SELECT geom FROM things WHERE fid = 1) WHERE fid = 2",
            "UPDATE things SET geom = (SELECT geom FROM things WHERE fid = 3) WHERE fid = 1",
            "UPDATE things SET geom = (SELECT geom FROM things WHERE fid = 1) WHERE fid = 3",
            "UPDATE things SET geom = NULL WHERE fid = 1",
            "UPDATE things SET fid = 9 WHERE fid = 1",
            "UPDATE things SET fid = 9, geom = NULL WHERE fid = 1",
            "UPDATE things SET fid = 9 WHERE fid = 3",
            "UPDATE things SET score = 5",
            "DELETE FROM things WHERE fid = 1",
            "DELETE FROM things WHERE fid = 3",
            "DELETE FROM things",
            "INSERT INTO things (class) VALUES ('nowhere')",
        ],
    )
    def test_follow(self, connection, change):
        connection.execute(change)
        check_whole(connection)

    def test_follow_replacements(self, connection):
        blobs = geopackage.to_blobs(array("LINESTRING (90 90, 99 99)", "POINT (7 7)"), UTM)
        geopackage.replace(connection, "things", {"fid": [2, 1], "geom": blobs, "class": ["b", None]})
        check_whole(connection)
        assert geopackage.boxes(connection, "things").tolist() == [[1, 7, 7, 7, 7], [2, 90, 99, 90, 99]]
        query = "SELECT class, number FROM things ORDER BY fid"
        assert connection.execute(query).fetchall() == [(None, 0), ("b", 1), ("a", 2)]

    @pytest.mark.parametrize("engine", ["pyogrio", "fiona"])
    def test_follow_what_gdal_appends(self, file, connection, engine):
        row = {"class": ["new"], "number": [7], "score": [0.5]}
        more = gpd.GeoDataFrame(row, geometry=[Point(400, 500)], crs=UTM)
        more.to_file(file, layer="things", engine=engine, mode="a")
        check_whole(connection)
        assert geopackage.ids_near(connection, "things", (399, 499, 401, 501)).tolist() == [4]
        put(connection, [Point(-7, -8)])
        check_whole(connection)
        assert gpd.read_file(file)["class"].tolist() == ["a", "a", "a", "new", "a"]

    def test_follow_what_gdal_appends_without_geometry(self, file, connection):
        with fiona.open(file, "a", layer="things") as layer:
            layer.write({"type": "Feature", "geometry": None, "properties": dict.fromkeys(COLUMNS)})
        check_whole(connection)
        assert len(features(connection)) == 4

    @settings(max_examples=30)
    @given(
        st.lists(
            st.tuples(
                st.sampled_from(["insert", "delete", "move", "rename", "empty", "forget"]),
                st.integers(1, 6),
                st.integers(-9, 9),
            ),
            max_size=15,
        )
    )
    def test_follow_whatever_is_done(self, tmp_path_factory, steps):
        statements = {
            "insert": "INSERT INTO things (geom) VALUES (:here)",
            "delete": "DELETE FROM things WHERE fid = :fid",
            "move": "UPDATE things SET geom = :here WHERE fid = :fid",
            "rename": "UPDATE things SET fid = fid + 3 WHERE fid = :fid",
            "empty": "UPDATE things SET geom = :nowhere WHERE fid = :fid",
            "forget": "UPDATE things SET geom = NULL WHERE fid = :fid",
        }
        with contextlib.closing(made(tmp_path_factory.mktemp("map") / "a.gpkg")) as connection:
            put(connection, self.SHAPES)
            for what, fid, x in steps:
                here, nowhere = geopackage.to_blobs(array(Point(x, -x), "POINT EMPTY"), UTM)
                with contextlib.suppress(sqlite3.IntegrityError):  # of an id that is taken
                    connection.execute(statements[what], {"fid": fid, "here": here, "nowhere": nowhere})
                check_whole(connection)


class TestBounds:
    def test_of_an_empty_layer_are_not_known(self, file):
        with contextlib.closing(made(file)) as connection:
            assert bounds_noted(connection) == (None,) * 4

    def test_grow_with_what_comes_and_do_not_shrink(self, file):
        with contextlib.closing(made(file, shapes=["LINESTRING (0 0, 10 5)"])) as connection:
            put(connection, [Point(-3, 7)])
            assert bounds_noted(connection) == (-3, 0, 10, 7)
            connection.execute("DELETE FROM things")
            geopackage.touched(connection, "things", array())
            assert bounds_noted(connection) == (-3, 0, 10, 7)

    @pytest.mark.parametrize("shapes", [["POINT EMPTY"], ["POINT EMPTY", "LINESTRING EMPTY"]])
    def test_are_not_those_of_nothing(self, file, shapes):
        with contextlib.closing(made(file, shapes=["LINESTRING (0 0, 10 5)"])) as connection:
            put(connection, shapes)
            assert bounds_noted(connection) == (0, 0, 10, 5)
            put(connection, ["POINT EMPTY", "POINT (20 0)"])
            assert bounds_noted(connection) == (0, 0, 20, 5)

    def test_say_when_they_changed(self, file):
        with contextlib.closing(made(file)) as connection:
            connection.execute("UPDATE gpkg_contents SET last_change = '2000-01-01T00:00:00.000Z'")
            geopackage.touched(connection, "things")
            (when,) = connection.execute("SELECT last_change FROM gpkg_contents").fetchone()
        assert re.fullmatch(r"20[2-9]\d-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z", when)


def custom():
    """A transverse Mercator that no authority has a number for, as a merge makes it."""
    conversion = TransverseMercatorConversion(latitude_natural_origin=51.1234, longitude_natural_origin=7.4321)
    return pyproj.crs.ProjectedCRS(conversion, name="Transverse Mercator centred on the data")


CRSS = {
    "UTM": (32632, 32632),
    "Gauss-Kruger, northing first": (31467, 31467),
    "state plane": ("ESRI:102003", 100000),
    "centred on the data": (custom(), 100000),
    "with heights": ("EPSG:25832+5783", 5555),
}


class TestCrs:
    @pytest.mark.parametrize(("crs", "number"), CRSS.values(), ids=CRSS)
    def test_comes_back_equal_from_geopandas(self, file, crs, number):
        made(file, crs, shapes=["LINESTRING (0 0, 10 5)"]).close()
        read = gpd.read_file(file)
        assert read.crs == parse_crs(crs)
        with contextlib.closing(sqlite3.connect(file)) as connection:
            assert connection.execute("SELECT srs_id FROM gpkg_geometry_columns").fetchall() == [(number,)]
            assert connection.execute("SELECT srs_id FROM gpkg_contents").fetchall() == [(number,)]
            known = {row[0] for row in connection.execute("SELECT srs_id FROM gpkg_spatial_ref_sys")}
        assert known == {-1, 0, 4326, number}

    def test_of_three_axes_is_kept_as_that_of_two(self, file):
        made(file, pyproj.CRS(UTM).to_3d(), shapes=["LINESTRING (0 0, 10 5)"]).close()
        assert gpd.read_file(file).crs.to_2d() == pyproj.CRS(UTM)

    def test_that_is_local_is_the_undefined_cartesian_one(self, file):
        made(file, LOCAL_CRS, shapes=["LINESTRING (0 0, 10 5)"]).close()
        read = gpd.read_file(file)
        assert is_local(read.crs)
        assert read.geometry[0].wkt == "LINESTRING (0 0, 10 5)"
        with contextlib.closing(sqlite3.connect(file)) as connection:
            assert connection.execute("SELECT srs_id FROM gpkg_geometry_columns").fetchall() == [(-1,)]


class TestIds:
    @pytest.mark.parametrize("count", [0, 1, 100, 40_000])
    def test_of_any_number_are_chosen(self, file, count):
        ids = np.arange(count) * 3
        with contextlib.closing(made(file)) as connection:
            connection.executemany("INSERT INTO things (fid, geom) VALUES (?, NULL)", [(n,) for n in range(1, 200)])
            with geopackage.chosen(connection, ids) as these:
                found = connection.execute(f"SELECT fid FROM things WHERE fid IN {these} ORDER BY fid").fetchall()
        assert [fid for (fid,) in found] == [n for n in range(1, 200) if n % 3 == 0 and n < 3 * count]

    def test_chosen_before_are_forgotten(self, file):
        made(file).close()
        with contextlib.closing(opened(file)) as connection:
            for ids in ([1, 2], [2, 3]):
                with geopackage.chosen(connection, np.array(ids)) as these:
                    assert connection.execute(f"SELECT * FROM {these}").fetchall() == [(number,) for number in ids]

    def test_near_a_box_are_those_whose_box_meets_it(self, file):
        shapes = [box(0, 0, 10, 10), Point(10, 10), Point(10.5, 10), "LINESTRING (-5 20, 20 -5)", "POINT EMPTY"]
        with contextlib.closing(made(file, shapes=shapes)) as connection:
            assert geopackage.ids_near(connection, "things", (10, 10, 10.25, 12)).tolist() == [1, 2, 4]
            assert geopackage.ids_near(connection, "things", (30, 30, 40, 40)).tolist() == []
            assert geopackage.ids_near(connection, "things", (np.nan,) * 4).tolist() == []

    def test_that_were_given_are_never_given_again(self, file):
        with contextlib.closing(made(file, shapes=[Point(0, 0), Point(1, 1)])) as connection:
            assert geopackage.next_id(connection, "things") == 3
            connection.execute("DELETE FROM things")
            assert geopackage.next_id(connection, "things") == 3
            put(connection, [Point(2, 2)])
            assert features(connection)[0][0] == 3
            assert geopackage.next_id(connection, "nothing of the kind") == 1


class TestValues:
    def test_that_are_missing_are_null(self, file):
        with contextlib.closing(made(file)) as connection:
            columns = {
                "class": ["a", None, np.nan],
                "number": np.array([1, 2, 3]),
                "score": [np.nan, 0.5, np.float64(1)],
            }
            geopackage.insert(connection, "things", columns)
            query = "SELECT class, number, score, typeof(number) FROM things"
            expected = [("a", 1, None, "integer"), (None, 2, 0.5, "integer"), (None, 3, 1.0, "integer")]
            assert connection.execute(query).fetchall() == expected

    def test_of_columns_that_are_not_equally_long_are_refused(self, file):
        with contextlib.closing(made(file)) as connection, pytest.raises(ValueError, match="zip"):
            geopackage.insert(connection, "things", {"class": ["a", "b"], "number": [1]})


class TestTransaction:
    @pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
    def test_does_nothing_where_it_fails(self, file, error):
        with contextlib.closing(made(file, shapes=[Point(0, 0)])) as connection:
            before = list(connection.iterdump())

            def fail():
                with geopackage.transaction(connection):
                    put(connection, [Point(5, 5)])
                    geopackage.create_layer(connection, "more", "fid", COLUMNS, "GEOMETRY", UTM)
                    raise error

            with pytest.raises(error):
                fail()
            assert list(connection.iterdump()) == before
            assert not connection.in_transaction

    def test_is_seen_by_others_at_its_end_alone(self, file):
        with contextlib.closing(made(file)) as connection, contextlib.closing(opened(file)) as other:
            with geopackage.transaction(connection):
                put(connection, [Point(0, 0)])
                assert features(other) == []
            assert len(features(other)) == 1

    def test_keeps_other_writers_away(self, file):
        with contextlib.closing(made(file)) as connection, contextlib.closing(opened(file)) as other:
            with (
                geopackage.transaction(connection),
                pytest.raises(sqlite3.OperationalError, match="locked"),
                geopackage.transaction(other),
            ):
                pass
            with geopackage.transaction(other):
                put(other, [Point(0, 0)])


class TestConnecting:
    def test_makes_no_file(self, file):
        with pytest.raises(sqlite3.OperationalError, match="unable to open"):
            opened(file)
        assert not file.exists()

    @pytest.mark.parametrize("name", ["with space.gpkg", "50% off#1?.gpkg", "straße 道.gpkg"])
    def test_takes_any_name(self, tmp_path, name):
        made(tmp_path / name, shapes=[Point(1, 2)]).close()
        assert [path.name for path in tmp_path.iterdir()] == [name]
        assert gpd.read_file(tmp_path / name).geometry[0] == Point(1, 2)
