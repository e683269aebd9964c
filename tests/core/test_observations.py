"""From layers to one table of observations: parts, kinds, intervals, cleaning."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pytest
import shapely
from shapely import LineString, MultiLineString, MultiPolygon, Polygon

from polymerge_core.observations import as_lines, observe
from polymerge_core.options import Options
from polymerge_core.schema import LEFT_OUT_COLUMNS, LocalMaps

SQUARE = [(0, 0), (5, 0), (5, 5), (0, 5), (0, 0)]
HOLE = [(1, 1), (2, 1), (2, 2), (1, 2), (1, 1)]


def seen(*shapes, main=(), crs=None, options=None, **columns):
    data = gpd.GeoDataFrame(columns, geometry=list(shapes), crs=crs)
    main = [LocalMaps(gpd.GeoDataFrame(geometry=list(main), crs=crs), source="map")] if main else []
    chosen = ({} if crs else {"crs": "local"}) | (options or {})
    return observe([LocalMaps(data)], main, Options.of(**chosen))


def line(y=0.0, length=10.0):
    return LineString([(0, y), (length, y)])


class TestParts:
    @pytest.mark.parametrize(
        ("shape", "count"),
        [
            (line(), 1),
            (MultiLineString([line(), line(5)]), 2),
            (Polygon(SQUARE), 1),
            (MultiPolygon([Polygon(SQUARE), shapely.box(9, 9, 10, 10)]), 2),
            (shapely.GeometryCollection([line(), MultiLineString([line(3), line(5)])]), 3),
            (shapely.GeometryCollection([shapely.GeometryCollection([line(), Polygon(SQUARE)])]), 2),
            (shapely.LinearRing(SQUARE), 1),
        ],
        ids=lambda value: value.geom_type if hasattr(value, "geom_type") else str(value),
    )
    def test_of_a_feature_are_observations(self, shape, count):
        observations = seen(shape)
        assert len(observations.table) == count
        assert len(observations.left_out) == 0
        assert observations.table["source_fid"].tolist() == [0] * count

    def test_have_the_columns_of_their_feature(self):
        observations = seen(MultiLineString([line(), line(5)]), line(9), name=["a", "b"], score=[0.5, 0.7])
        assert sorted(observations.attributes["name"]) == ["a", "a", "b"]
        assert sorted(observations.table["score"]) == [0.5, 0.5, 0.7]
        together = observations.attributes.assign(fid=observations.table["source_fid"])
        assert sorted(map(tuple, together.to_numpy().tolist())) == [("a", 0), ("a", 0), ("b", 1)]

    def test_of_a_feature_are_one_instance(self):
        observations = seen(MultiLineString([line(), line(5)]), line(9))
        assert observations.table.groupby("source_fid")["group"].nunique().tolist() == [1, 1]

    def test_that_are_no_good_do_not_spoil_the_rest(self):
        point = shapely.GeometryCollection([line(), shapely.Point(1, 1), LineString([(2, 2), (2, 2)])])
        observations = seen(point)
        assert len(observations.table) == 1
        assert sorted(observations.left_out["reason"]) == ["neither a line nor a polygon", "zero length"]


class TestKinds:
    @pytest.mark.parametrize(
        ("cls", "shape", "is_area", "as_polygon", "kind"),
        [
            ("ped_crossing", Polygon(SQUARE), True, True, "Polygon"),
            ("ped_crossing", LineString(SQUARE), True, False, "Polygon"),
            ("ped_crossing", LineString(SQUARE[:-1]), True, False, "Polygon"),
            ("ped_crossing", LineString(SQUARE[:3]), True, False, "Polygon"),
            ("divider", Polygon(SQUARE), False, False, "LineString"),
            ("boundary", Polygon(SQUARE), False, False, "LineString"),
            ("divider", LineString(SQUARE), False, False, "LineString"),
            ("island", Polygon(SQUARE), True, True, "Polygon"),
            ("island", LineString(SQUARE), False, False, "LineString"),
        ],
    )
    def test_of_a_class_and_a_geometry(self, cls, shape, is_area, as_polygon, kind):
        table = seen(shape, **{"class": [cls]}).table
        assert table[["is_area", "as_polygon"]].to_numpy().tolist() == [[is_area, as_polygon]]
        assert table["shape"].iloc[0].geom_type == kind

    def test_area_is_closed_where_it_was_open(self):
        table = seen(LineString(SQUARE[:-1]), **{"class": ["ped_crossing"]}).table
        assert shapely.get_coordinates(table["shape"].iloc[0]).tolist() == [list(xy) for xy in SQUARE]

    @pytest.mark.parametrize(
        "points",
        [[(0, 0), (5, 0)], [(0, 0), (5, 0), (0, 0)], [(0, 0), (5, 0), (5, 0)]],
        ids=["two vertices", "there and back", "two and a repeated one"],
    )
    def test_line_that_encloses_nothing_is_no_area(self, points):
        observations = seen(LineString(points), **{"class": ["ped_crossing"]})
        assert observations.left_out["reason"].tolist() == ["an open line of two vertices encloses no area"]

    def test_lines_of_the_observations_are_lines_and_outer_rings(self):
        shapes = np.array([line(), Polygon(SQUARE, [HOLE])], dtype=object)
        lines = as_lines(shapes)
        assert lines[0].equals_exact(line())
        assert lines[1].equals_exact(LineString(SQUARE))
        assert shapes[1].geom_type == "Polygon"


class TestIntervals:
    def test_of_a_single_part_are_its_length(self):
        table = seen(line(length=7)).table
        assert table[["from_m", "to_m"]].to_numpy().tolist() == [[0, 7]]

    def test_of_parts_follow_each_other_in_the_order_of_the_feature(self):
        table = seen(MultiLineString([line(5, 3), line(0, 4), line(9, 2)])).table.sort_values("from_m")
        assert table["to_m"].tolist() == [3, 7, 9]
        assert [shape.length for shape in table["shape"]] == [3, 4, 2]

    def test_of_parts_left_out_count_too(self):
        observations = seen(shapely.GeometryCollection([line(length=3), Polygon(SQUARE, [HOLE]), line(5, 2)]))
        table = observations.table.sort_values("from_m")
        assert table[["from_m", "to_m"]].to_numpy().tolist() == [[0, 3], [3, 27], [27, 29]]

    def test_of_rings_of_one_polygon_follow_each_other(self):
        table = seen(Polygon(SQUARE, [HOLE]), **{"class": ["divider"]}).table.sort_values("from_m")
        assert table[["from_m", "to_m"]].to_numpy().tolist() == [[0, 20], [20, 24]]


class TestCleaning:
    def test_drops_vertices_that_repeat_and_counts_them(self):
        observations = seen(LineString([(0, 0), (0, 0), (3, 0), (3, 1e-10), (9, 0)]), line(5))
        assert sorted(shapely.get_num_coordinates(observations.table["shape"])) == [2, 3]
        assert observations.notes["cleaned_vertices"] == 2

    def test_keeps_the_ends(self):
        table = seen(LineString([(0, 0), (9, 0), (9, 1e-10)])).table
        assert shapely.get_coordinates(table["shape"].iloc[0])[-1].tolist() == [9, 1e-10]

    def test_keeps_segments_longer_than_a_nanometre(self):
        table = seen(LineString([(0, 0), (2e-9, 0), (9, 0)])).table
        assert shapely.get_num_coordinates(table["shape"].iloc[0]) == 3

    def test_keeps_closed_lines_closed(self):
        ring = LineString([*SQUARE[:-1], (1e-10, 0), (0, 0)])
        assert seen(ring).table["shape"].iloc[0].is_closed

    def test_keeps_the_original_in_the_crs_of_the_layer(self):
        degrees = LineString([(11.5, 48.1), (11.5001, 48.1), (11.5002, 48.1001)])
        table = seen(degrees, crs="EPSG:4326").table
        assert table["original"].iloc[0].wkb == degrees.wkb
        assert table["shape"].iloc[0].length == pytest.approx(20.8, abs=0.2)


class TestLeftOut:
    def test_is_in_canonical_order_with_the_columns_of_the_contract(self):
        shapes = [None, LineString(), None, line(), LineString([(1, 1), (1, 1)])]
        left_out = seen(*shapes, instance=["10", "9", "9", "1", "2"]).left_out
        assert tuple(left_out) == LEFT_OUT_COLUMNS
        back = seen(*shapes[::-1], instance=["10", "9", "9", "1", "2"][::-1]).left_out
        assert left_out.drop(columns="source_fid").equals(back.drop(columns="source_fid"))

    def test_gives_the_first_reason_only(self):
        left_out = seen(None, line(), **{"class": [None, "a"], "score": [2, 1]}).left_out
        assert left_out["reason"].tolist() == ["no class"]

    def test_names_features_by_their_index(self):
        data = gpd.GeoDataFrame(geometry=[line(), None], index=["a", "b"])
        assert observe([LocalMaps(data)], [], Options.of(crs="local")).left_out["source_fid"].tolist() == ["b"]


def test_main_map_comes_first():
    table = seen(line(), line(5), main=[line(9), line(7)]).table
    assert table["group"].tolist() == [-1, -1, 0, 1]
    assert table["is_main"].tolist() == [True, True, False, False]
    assert table.index.tolist() == [0, 1, 2, 3]
