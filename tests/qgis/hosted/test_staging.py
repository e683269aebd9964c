"""Layers out: whatever QGIS can read reaches the worker, feature by feature; read back here with QGIS."""

from __future__ import annotations

import json

import pytest
from qgis.core import (
    NULL,
    QgsCoordinateReferenceSystem,
    QgsFeature,
    QgsFeedback,
    QgsField,
    QgsGeometry,
    QgsProcessingException,
    QgsVectorLayer,
    QgsVectorLayerJoinInfo,
    QgsWkbTypes,
)
from qgis.PyQt.QtCore import QByteArray, QDate, QDateTime, QTime, QVariant

from qgis_plugin.parameters import is_known
from qgis_plugin.progress import Part
from qgis_plugin.staging import crs_of, file_names, id_column, layer_input, stage_layer

from .layers import EAST, NORTH, add_features, file_layer, memory_layer, plain, shapes, track

ID = "polymerge_feature_id"


@pytest.fixture
def stage(tmp_path):
    """Return a function that stages what is given and opens what came of it."""
    count = iter(range(100))

    def go(given, *, part=None, spatial=True):
        file = tmp_path / f"staged{next(count)}" / "layer.gpkg"
        stage_layer(given, file, "features", part or Part(QgsFeedback()), spatial=spatial)
        layer = QgsVectorLayer(f"{file}|layername=features", "staged", "ogr")
        # QGIS takes a layer that may hold any geometry for one of the kind that it meets first.
        assert layer.isValid()
        return layer

    return go


def content(layer):
    """Return geometry and columns by feature id."""
    found = {}
    for feature in layer.getFeatures():
        columns = {name: plain(feature[name]) for name in layer.fields().names() if name != ID}
        found[feature.id()] = (feature.geometry().asWkt(3), columns)
    return found


@pytest.fixture
def tracks():
    return memory_layer(
        [track(n) for n in range(5)],
        columns="field=name:string&field=score:double",
        rows=[(f"t{n}", n / 10) for n in range(5)],
    )


class TestSources:
    def test_a_layer_in_memory_keeps_shapes_columns_ids_and_crs(self, stage, tracks):
        staged = stage(layer_input(tracks))
        assert content(staged) == content(tracks)
        assert staged.crs().authid() == "EPSG:32632"

    def test_a_geopackage_keeps_its_ids_and_does_not_repeat_them_as_a_column(self, stage, tracks, tmp_path):
        layer = file_layer(tracks, tmp_path / "a.gpkg")
        layer.dataProvider().deleteFeatures([1, 3])
        staged = stage(layer_input(layer))
        assert sorted(content(staged)) == [2, 4, 5]
        assert staged.fields().names() == [ID, "name", "score"]
        assert shapes(staged) == shapes(layer)

    @pytest.mark.parametrize(
        ("driver", "name"), [("ESRI Shapefile", "a.shp"), ("GeoJSON", "a.geojson"), ("FlatGeobuf", "a.fgb")]
    )
    def test_a_file_that_counts_from_0_keeps_that(self, stage, tracks, tmp_path, driver, name):
        layer = file_layer(tracks, tmp_path / name, driver)
        staged = stage(layer_input(layer))
        assert sorted(content(staged)) == [0, 1, 2, 3, 4]
        assert content(staged) == content(layer)

    def test_a_layer_of_delimited_text(self, stage, tmp_path):
        (tmp_path / "a.csv").write_text(f'name;shape\none;"{track()}"\ntwo;"{track(1)}"\n')
        uri = f"file://{tmp_path}/a.csv?delimiter=;&wktField=shape&crs=EPSG:32632"
        layer = QgsVectorLayer(uri, "text", "delimitedtext")
        assert layer.featureCount() == 2
        staged = stage(layer_input(layer))
        assert [columns["name"] for _, columns in content(staged).values()] == ["one", "two"]
        assert shapes(staged) == shapes(layer)

    def test_a_virtual_layer(self, stage, tracks, context):
        context.project().addMapLayer(tracks, False)
        query = "?query=select name, geometry from tracks where score > 0.25&geometry=geometry:2:32632"
        layer = QgsVectorLayer(query, "virtual", "virtual")
        assert layer.isValid()
        staged = stage(layer_input(layer))
        assert [columns["name"] for _, columns in content(staged).values()] == ["t3", "t4"]
        assert sorted(shapes(staged).values()) == sorted(shapes(layer).values())

    def test_a_subset_filter(self, stage, tracks, tmp_path):
        layer = file_layer(tracks, tmp_path / "a.gpkg")
        layer.setSubsetString("\"name\" in ('t1', 't4')")
        staged = stage(layer_input(layer))
        assert [columns["name"] for _, columns in content(staged).values()] == ["t1", "t4"]
        assert sorted(content(staged)) == [2, 5]

    def test_a_join_and_a_virtual_field(self, stage, tracks, context):
        table = memory_layer(
            [None, None],
            kind="None",
            name="owners",
            columns="field=track:string&field=owner:string",
            rows=[("t1", "Ada"), ("t2", "Bob")],
        )
        context.project().addMapLayers([tracks, table], False)
        join = QgsVectorLayerJoinInfo()
        join.setJoinLayer(table)
        join.setJoinFieldName("track")
        join.setTargetFieldName("name")
        join.setUsingMemoryCache(True)
        assert tracks.addJoin(join)
        tracks.addExpressionField('"score" * 10', QgsField("tenfold", QVariant.Int))
        staged = content(stage(layer_input(tracks)))
        assert [columns["owners_owner"] for _, columns in staged.values()] == [None, "Ada", "Bob", None, None]
        assert [columns["tenfold"] for _, columns in staged.values()] == [0, 1, 2, 3, 4]

    def test_a_view_of_a_file_without_a_key(self, stage, tracks, tmp_path):
        layer = file_layer(tracks, tmp_path / "a.gpkg")
        layer = QgsVectorLayer(f"{tmp_path / 'a.gpkg'}|subset=select name, geom from a", "query", "ogr")
        assert layer.isValid()
        staged = stage(layer_input(layer))
        assert sorted(content(staged)) == sorted(feature.id() for feature in layer.getFeatures())
        assert sorted(shapes(staged).values()) == sorted(shapes(tracks).values())


class TestEditsNotSaved:
    @pytest.fixture(params=["memory", "file"])
    def edited(self, request, tracks, tmp_path):
        layer = tracks if request.param == "memory" else file_layer(tracks, tmp_path / "edited.gpkg")
        assert layer.startEditing()
        yield layer
        layer.rollBack()

    def test_added_features_come_with_their_negative_ids(self, stage, edited):
        extra = [None] * (len(edited.fields()) - 2)
        add_features(edited, [track(10), track(11)], [(*extra, "new", 0.5), (*extra, "newer", 0.6)])
        assert min(feature.id() for feature in edited.getFeatures()) < 0
        staged = stage(layer_input(edited))
        assert shapes(staged) == shapes(edited)
        assert len(shapes(staged)) == 7

    def test_changed_geometries_and_attributes_come_as_they_look(self, stage, edited):
        first = min(feature.id() for feature in edited.getFeatures())
        edited.changeGeometry(first, QgsGeometry.fromWkt(track(50)))
        edited.changeAttributeValue(first, edited.fields().lookupField("name"), "changed")
        staged = content(stage(layer_input(edited)))
        assert staged[first][0] == QgsGeometry.fromWkt(track(50)).asWkt(3)
        assert staged[first][1]["name"] == "changed"

    def test_deleted_features_do_not_come(self, stage, edited):
        gone = max(feature.id() for feature in edited.getFeatures())
        edited.deleteFeature(gone)
        assert gone not in content(stage(layer_input(edited)))
        assert len(content(stage(layer_input(edited)))) == 4

    def test_a_new_column_comes(self, stage, edited):
        edited.addAttribute(QgsField("note", QVariant.String))
        first = min(feature.id() for feature in edited.getFeatures())
        edited.changeAttributeValue(first, edited.fields().lookupField("note"), "hello")
        assert content(stage(layer_input(edited)))[first][1]["note"] == "hello"

    def test_what_is_edited_after_the_layer_was_taken_does_not_come(self, stage, edited):
        taken = layer_input(edited)
        edited.deleteFeature(max(feature.id() for feature in edited.getFeatures()))
        add_features(edited, [track(10)])
        assert len(content(stage(taken))) == 5
        assert min(content(stage(taken))) >= 0


class TestSelection:
    def test_alone_is_taken(self, stage, tracks):
        tracks.selectByIds([2, 4])
        given = layer_input(tracks, selected_only=True)
        assert sorted(content(stage(given))) == [2, 4]
        assert given.count == 2

    def test_is_passed_over_where_it_is_not_asked_for(self, stage, tracks):
        tracks.selectByIds([2, 4])
        assert len(content(stage(layer_input(tracks)))) == 5

    def test_where_there_is_none_all_are_taken(self, stage, tracks):
        assert len(content(stage(layer_input(tracks, selected_only=True)))) == 5

    def test_of_features_not_saved_yet_is_taken(self, stage, tracks):
        tracks.startEditing()
        add_features(tracks, [track(10)])
        new = min(feature.id() for feature in tracks.getFeatures())
        tracks.selectByIds([new])
        assert list(content(stage(layer_input(tracks, selected_only=True)))) == [new]
        tracks.rollBack()

    def test_is_that_of_the_moment_when_the_layer_was_taken(self, stage, tracks):
        tracks.selectByIds([2])
        given = layer_input(tracks, selected_only=True)
        tracks.removeSelection()
        assert list(content(stage(given))) == [2]


class TestColumns:
    def one(self, columns, *values):
        return memory_layer([track()], columns=columns, rows=[values])

    def test_whose_names_differ_in_case_only_all_come(self, stage):
        given = self.one(
            "field=name:string&field=NAME:string&field=Name:string&field=name_1:string", "a", "b", "c", "d"
        )
        ((_, columns),) = content(stage(layer_input(given))).values()
        assert list(columns.values()) == ["a", "b", "c", "d"]
        assert next(iter(columns)) == "name"

    @pytest.mark.parametrize(
        "name",
        ["fid", "FID", "geom", "geometry", "ogc_fid", "id", "rowid", "polymerge_feature_id", "polymerge_geometry"],
    )
    def test_of_any_name_come_beside_the_id_and_the_geometry(self, stage, name):
        given = self.one(f"field=first:integer&field={name}:integer&field=last:integer", 1, 77, 3)
        staged = stage(layer_input(given))
        assert shapes(staged) == shapes(given)
        ((_, columns),) = content(staged).values()
        assert list(columns.values()) == [1, 77, 3]

    @pytest.mark.parametrize("name", ["ü 線", 'quo"te', "it's", "select", "a.b", "x" * 200, "ends ", "%s"])
    def test_of_odd_names_come_under_their_names(self, stage, name):
        given = memory_layer([])
        given.dataProvider().addAttributes([QgsField(name, QVariant.Int)])
        given.updateFields()
        add_features(given, [track()], [(5,)])
        ((_, columns),) = content(stage(layer_input(given))).values()
        assert columns == {name: 5}

    @pytest.mark.parametrize(
        ("kind", "value", "expected"),
        [
            ("integer", -7, -7),
            ("int8", 2**62, 2**62),
            ("double", 0.1, 0.1),
            ("string", "ü 線\nx", "ü 線\nx"),
            ("string", "", ""),
            ("bool", True, True),
            ("bool", False, False),
            ("date", QDate(2024, 2, 29), QDate(2024, 2, 29)),
            (
                "datetime",
                QDateTime(QDate(2024, 2, 29), QTime(12, 30, 1)),
                QDateTime(QDate(2024, 2, 29), QTime(12, 30, 1)),
            ),
            ("time", QTime(12, 30, 15), "12:30:15"),
            ("binary", QByteArray(b"\x00\xff"), QByteArray(b"\x00\xff")),
            ("string[]", ["a", "ü"], '["a", "ü"]'),
            ("integer[]", [1, 2], "[1, 2]"),
            ("double[]", [0.5, 2.0], "[0.5, 2.0]"),
        ],
        ids=lambda value: value if isinstance(value, str) and value.isascii() and "\n" not in value else None,
    )
    def test_of_each_type_come_as_they_are_or_as_text(self, stage, kind, value, expected):
        ((_, columns),) = content(stage(layer_input(self.one(f"field=it:{kind}", value)))).values()
        assert columns == {"it": expected}
        assert isinstance(columns["it"], type(expected))

    def test_fractions_of_a_second_are_kept_since_frames_are_ordered_by_them(self, stage):
        times = [QDateTime(QDate(2024, 2, 29), QTime(12, 30, 1, ms)) for ms in (750, 250)]
        given = memory_layer([track(), track(1)], columns="field=it:datetime", rows=[(time,) for time in times])
        staged = [columns["it"] for _, columns in content(stage(layer_input(given))).values()]
        assert staged[1] != staged[0]
        assert [str(time if isinstance(time, str) else time.toString("HH:mm:ss.zzz"))[-6:] for time in staged] == [
            "01.750",
            "01.250",
        ]

    def test_of_maps_come_as_json(self, stage):
        given = memory_layer([track()])
        given.addExpressionField("map('a', 1, 'b', array(2, 'ü'))", QgsField("it", QVariant.Map))
        ((_, columns),) = content(stage(layer_input(given))).values()
        assert json.loads(columns["it"]) == {"a": 1, "b": [2, "ü"]}

    @pytest.mark.parametrize(
        "kind", ["integer", "int8", "double", "string", "bool", "date", "datetime", "time", "binary", "string[]", "map"]
    )
    def test_null_stays_null(self, stage, kind):
        given = self.one(f"field=it:{kind}", NULL)
        ((_, columns),) = content(stage(layer_input(given))).values()
        assert columns == {"it": None}

    def test_a_number_with_few_decimals_is_not_rounded(self, stage):
        given = memory_layer([])
        given.dataProvider().addAttributes([QgsField("it", QVariant.Double, "", 5, 1)])
        given.updateFields()
        add_features(given, [track()], [(0.123456789,)])
        ((_, columns),) = content(stage(layer_input(given))).values()
        assert columns == {"it": 0.123456789}

    def test_none_at_all(self, stage):
        given = memory_layer([track()])
        assert content(stage(layer_input(given))) == content(given)


class TestGeometries:
    @pytest.mark.parametrize(
        ("kind", "shape"),
        [
            ("MultiLineString", f"MULTILINESTRING(({EAST} {NORTH}, {EAST + 1} {NORTH}), ({EAST} 0, 1 1))"),
            ("LineStringZ", f"LineStringZ ({EAST} {NORTH} 5, {EAST + 1} {NORTH} 6)"),
            ("LineStringM", f"LineStringM ({EAST} {NORTH} 5, {EAST + 1} {NORTH} 6)"),
            ("LineStringZM", f"LineStringZM ({EAST} {NORTH} 5 1, {EAST + 1} {NORTH} 6 2)"),
            ("LineString25D", f"LineStringZ ({EAST} {NORTH} 5, {EAST + 1} {NORTH} 6)"),
            ("CompoundCurve", "COMPOUNDCURVE(CIRCULARSTRING(0 0, 1 1, 2 0), (2 0, 3 0))"),
            ("CircularString", "CIRCULARSTRING(0 0, 1 1, 2 0)"),
            ("MultiCurve", "MULTICURVE((0 0, 5 5), CIRCULARSTRING(4 0, 4 4, 8 4))"),
            ("Polygon", "POLYGON((0 0, 9 0, 9 9, 0 0), (4 1, 5 1, 5 2, 4 1))"),
            ("MultiPolygonZ", "MultiPolygonZ (((0 0 1, 9 0 1, 9 9 1, 0 0 1)))"),
            ("CurvePolygon", "CURVEPOLYGON(CIRCULARSTRING(0 0, 4 0, 4 4, 0 4, 0 0))"),
            ("LineString", "LINESTRING(1 1)"),
            ("LineString", "LINESTRING(1 1, 1 1)"),
        ],
    )
    def test_come_as_they_are_in_the_plane(self, stage, kind, shape):
        given = memory_layer([shape], kind=kind)
        geometry = next(given.getFeatures()).geometry()
        flat = geometry.get()
        flat.dropZValue()  # the worker has no use for heights and measures
        flat.dropMValue()
        assert not flat.isEmpty()
        ((staged, _),) = content(stage(layer_input(given))).values()
        assert staged == geometry.asWkt(3)

    def test_to_the_last_digit(self, stage):
        given = memory_layer([])
        feature = QgsFeature(given.fields())
        numbers = [(500000.1 + 1 / 3, 5600000.7 - 1 / 7), (500001 + 2**-30, 5600000 + 2**-29)]
        feature.setGeometry(QgsGeometry.fromWkt("LINESTRING(" + ", ".join(f"{x!r} {y!r}" for x, y in numbers) + ")"))
        given.dataProvider().addFeatures([feature])
        (staged,) = stage(layer_input(given)).getFeatures()
        assert [(point.x(), point.y()) for point in staged.geometry().vertices()] == numbers

    def test_none_and_empty_ones_are_features_all_the_same(self, stage):
        given = memory_layer([track(), None, "LINESTRING EMPTY", track(1)])
        staged = content(stage(layer_input(given)))
        assert sorted(staged) == [1, 2, 3, 4]
        assert staged[2][0] == ""
        assert "EMPTY" in staged[3][0].upper() or not staged[3][0]

    def test_kinds_may_be_mixed_in_one_layer(self, stage):
        given = memory_layer(
            [track(), f"MULTILINESTRING(({EAST} {NORTH}, {EAST + 1} {NORTH}))"], kind="MultiLineString"
        )
        assert shapes(stage(layer_input(given))) == shapes(given)

    @pytest.mark.parametrize("kind", ["LineString", "Polygon", "MultiCurveZ"])
    def test_a_layer_without_features_is_a_layer_with_its_crs(self, stage, kind):
        staged = stage(layer_input(memory_layer([], kind=kind, columns="field=name:string")))
        assert staged.featureCount() == 0
        assert staged.fields().names() == [ID, "name"]
        assert crs_of(staged).authid() == "EPSG:32632"

    def test_a_table_has_no_geometry(self, stage):
        given = memory_layer([None, None], kind="None", columns="field=old_id:string", rows=[("a",), ("b",)])
        staged = stage(layer_input(given), spatial=False)
        assert staged.wkbType() == QgsWkbTypes.Type.NoGeometry
        assert [columns["old_id"] for _, columns in content(staged).values()] == ["a", "b"]


class TestCrs:
    @pytest.mark.parametrize("code", ["EPSG:4326", "EPSG:25832", "ESRI:54009", "EPSG:3857"])
    def test_of_the_layer_comes_with_it(self, stage, code):
        staged = stage(layer_input(memory_layer(["LINESTRING(1 2, 3 4)"], crs=code)))
        assert staged.crs() == QgsCoordinateReferenceSystem(code)
        assert shapes(staged) == {1: "LineString (1 2, 3 4)"}

    def test_of_the_user_s_own_making_comes_with_it(self, stage):
        given = memory_layer([track()])
        own = QgsCoordinateReferenceSystem.fromProj(
            "+proj=tmerc +lat_0=51.3 +lon_0=9.7 +k=1 +x_0=1000 +y_0=0 +ellps=GRS80 +units=m"
        )
        given.setCrs(own)
        assert "51.3" in stage(layer_input(given)).crs().toProj()

    def test_that_is_none_stays_none(self, stage):
        staged = stage(layer_input(memory_layer([track()], crs="")))
        assert not is_known(crs_of(staged))

    def test_of_an_undefined_one_in_a_geopackage_stays_undefined(self, stage, tmp_path):
        layer = file_layer(memory_layer([track()], crs=""), tmp_path / "lost.gpkg")
        assert not is_known(crs_of(layer))
        assert not is_known(crs_of(stage(layer_input(layer))))


class TestFiles:
    def test_several_layers_go_into_one_file(self, tmp_path):
        file = tmp_path / "map" / "old.gpkg"
        given = memory_layer([track()])
        for name in ("elements", "elements_areas"):
            stage_layer(layer_input(given), file, name, Part(QgsFeedback()))
        for name in ("elements", "elements_areas"):
            assert QgsVectorLayer(f"{file}|layername={name}", name, "ogr").featureCount() == 1

    def test_a_folder_that_cannot_be_written_to_is_told_with_the_layer_s_title(self, tmp_path):
        (tmp_path / "layer.gpkg").mkdir()
        with pytest.raises(QgsProcessingException, match="Layer “my tracks” cannot be handed to the worker: "):
            stage_layer(
                layer_input(memory_layer([track()], name="my tracks")),
                tmp_path / "layer.gpkg",
                "x",
                Part(QgsFeedback()),
            )

    @pytest.mark.parametrize(
        ("titles", "expected"),
        [
            (["roads"], ["roads"]),
            (["roads", "roads", "Roads"], ["roads", "roads (2)", "Roads (3)"]),
            (["roads (2)", "roads", "roads"], ["roads (2)", "roads", "roads (3)"]),
            (["a/b\\c", "a:b*c"], ["a_b_c", "a_b_c (2)"]),
            (["", "  ", "..."], ["layer", "layer (2)", "layer (3)"]),
            (["..", "../../etc/passwd"], ["layer", "_.._etc_passwd"]),
            (["Straße", "STRASSE"], ["Straße", "STRASSE (2)"]),
            (["道路 線"], ["道路 線"]),
            ([" x. "], ["x"]),
            (['a|b!c;d<e>f"g?h\ni'], ["a_b_c_d_e_f_g_h_i"]),
            (["-o"], ["-o"]),
        ],
        ids=str,
    )
    def test_are_named_as_the_layers_as_far_as_can_be(self, titles, expected):
        assert file_names(titles) == expected

    @pytest.mark.parametrize("letter", ["x", "線", "\N{GRINNING FACE}"], ids=["1 byte", "3 bytes", "4 bytes"])
    def test_of_very_long_names_can_be_written(self, tmp_path, letter):
        given = memory_layer([track()])
        names = file_names([letter * 300] * 12)
        assert len(set(names)) == 12
        for name in names:
            stage_layer(layer_input(given), tmp_path / "layers" / f"{name}.gpkg", "features", Part(QgsFeedback()))
        assert len(list((tmp_path / "layers").iterdir())) == 12


class TestProgressAndCancel:
    def test_progress_goes_from_start_to_end_of_its_part(self, stage, feedback):
        given = memory_layer([track(n) for n in range(5000)])
        stage(layer_input(given), part=Part(feedback, 0.2, 0.4))
        assert feedback.progresses == pytest.approx([20 + 20 * share for share in (0.4, 0.8, 1.0)])

    def test_a_layer_that_does_not_know_its_count_never_passes_the_end(self, stage, tracks, feedback):
        given = layer_input(tracks)
        object.__setattr__(given, "count", -1)
        stage(given, part=Part(feedback, 0.0, 0.5))
        assert feedback.progresses == [50.0]

    def test_a_cancel_stops_between_two_lots_of_features(self, tmp_path, feedback):
        read = []
        given = layer_input(memory_layer([track(n) for n in range(9000)]))

        class Counting:
            def __init__(self, features):
                self.features = features

            def __iter__(self):
                for feature in self.features:
                    read.append(feature.id())
                    if len(read) == 3000:
                        feedback.cancel()
                    yield feature

        reading = given.read
        object.__setattr__(given, "read", lambda request: Counting(reading(request)))
        with pytest.raises(QgsProcessingException, match=r"^Cancelled; nothing was written.$"):
            stage_layer(given, tmp_path / "x" / "layer.gpkg", "features", Part(feedback))
        assert 3000 <= len(read) < 9000

    def test_parts_cut_a_run_into_equal_pieces(self, feedback):
        pieces = Part(feedback, 0.1, 0.5).pieces(4)
        assert [(piece.start, piece.end) for piece in pieces] == [
            pytest.approx(each) for each in [(0.1, 0.2), (0.2, 0.3), (0.3, 0.4), (0.4, 0.5)]
        ]
        assert Part(feedback).pieces(0) == []


class TestIdColumn:
    def test_is_that_which_a_file_made_up(self, tracks, tmp_path):
        assert id_column(file_layer(tracks, tmp_path / "a.gpkg")) == "fid"
        assert id_column(file_layer(tracks, tmp_path / "a.shp", "ESRI Shapefile")) == ""
        assert id_column(tracks) == ""
