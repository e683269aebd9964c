"""Results in: the worker's layers in whatever sink the user wants, and how they look in a project."""

from __future__ import annotations

import json
import subprocess

import pytest
from qgis.core import (
    NULL,
    QgsCoordinateReferenceSystem,
    QgsCoordinateTransformContext,
    QgsFeature,
    QgsField,
    QgsFields,
    QgsGeometry,
    QgsProcessingAlgorithm,
    QgsProcessingException,
    QgsProcessingOutputLayerDefinition,
    QgsProcessingUtils,
    QgsRasterLayer,
    QgsRenderContext,
    QgsVectorFileWriter,
    QgsVectorLayer,
    QgsWkbTypes,
)
from qgis.PyQt.QtCore import QVariant

from qgis_plugin.algorithms.merge_local_maps import MergeLocalMaps
from qgis_plugin.layout import ROOT
from qgis_plugin.parameters import is_known
from qgis_plugin.results import _SHAPEFILE_NAMES, Result, deliver
from qgis_plugin.styling import Style, name_classes

from .layers import EAST, NORTH, memory_layer, plain, table, track

ELEMENT_COLUMNS = [
    ("element_id", QVariant.String),
    ("class", QVariant.String),
    ("n_observations", QVariant.LongLong),
    ("n_instances", QVariant.LongLong),
    ("length_m", QVariant.Double),
    ("note", QVariant.String),
]
ELEMENTS = [("a1", "divider", 3, 2, 20.5, NULL), ("b2", "stairs", 1, 1, 4.25, "ü 線")]
LINES = [f"LINESTRING({EAST} {NORTH}, {EAST + 5} {NORTH})", f"LINESTRING({EAST} {NORTH + 9}, {EAST + 5} {NORTH})"]

OUTPUT = Result(
    "OUTPUT", "Merged map", ("elements",), "line", "The map.", style="merged_map", optional=False, shown_empty=True
)
AREAS = Result(
    "AREAS", "Merged areas", ("elements_areas", "elements"), "polygon", "Areas.", style="merged_areas", precious=True
)
LINEAGE = Result("LINEAGE", "Lineage", ("lineage",), "table", "Who went where.", style="lineage", shown_empty=True)

pytestmark = pytest.mark.usefixtures("provider")


def write(file, layer, columns, rows, shapes=None, kind=QgsWkbTypes.Type.LineString, crs="EPSG:32632"):
    """Write a layer as the worker does."""
    fields = QgsFields()
    for name, type_ in columns:
        fields.append(QgsField(name, type_))
    options = QgsVectorFileWriter.SaveVectorOptions()
    options.driverName, options.layerName = "GPKG", layer
    if file.exists():
        options.actionOnExistingFile = QgsVectorFileWriter.ActionOnExistingFile.CreateOrOverwriteLayer
    system = QgsCoordinateReferenceSystem(crs)
    writer = QgsVectorFileWriter.create(str(file), fields, kind, system, QgsCoordinateTransformContext(), options)
    for number, row in enumerate(rows):
        feature = QgsFeature(fields)
        feature.setAttributes(list(row))
        if shapes:
            feature.setGeometry(QgsGeometry.fromWkt(shapes[number]))
        assert writer.addFeature(feature)
    del writer


@pytest.fixture
def file(tmp_path):
    """A file of the worker with elements and their lineage."""
    path = tmp_path / "result.gpkg"
    write(path, "elements", ELEMENT_COLUMNS, ELEMENTS, LINES)
    none = QgsWkbTypes.Type.NoGeometry
    write(path, "lineage", [("source", QVariant.String), ("weight", QVariant.Double)], [("one", 1.0)], kind=none)
    return path


@pytest.fixture
def send(context, provider, file, feedback):
    """Return a function that delivers a result, and opens it."""
    algorithm = provider.algorithm("mergelocalmaps").create()

    def go(result, destination, path=file):
        found = deliver(result, path, algorithm, {result.parameter: destination}, context, feedback)
        return found.get(result.parameter), QgsProcessingUtils.mapLayerFromString(
            found.get(result.parameter, ""), context
        )

    return go


def for_project(context, destination="memory:", name=""):
    """Return a destination whose layer is to be loaded, as the toolbox makes it."""
    return QgsProcessingOutputLayerDefinition(destination, context.project())


class TestSinks:
    @pytest.mark.parametrize("ending", ["memory:", "TEMPORARY_OUTPUT", ".gpkg", ".geojson", ".fgb"])
    def test_hold_all_features_with_their_columns_in_order(self, send, tmp_path, ending):
        destination = ending if not ending.startswith(".") else str(tmp_path / f"out{ending}")
        _, layer = send(OUTPUT, destination)
        names = [name for name, _ in ELEMENT_COLUMNS]
        assert [name for name in layer.fields().names() if name != "fid"] == names
        rows = sorted(tuple(row[name] for name in names) for row in table(layer))
        assert rows == [tuple(map(plain, row)) for row in ELEMENTS]
        assert sorted(each.geometry().asWkt(1) for each in layer.getFeatures()) == sorted(
            QgsGeometry.fromWkt(line).asWkt(1) for line in LINES
        )
        assert layer.crs().authid() == (
            "EPSG:4326" if ending == ".geojson" and layer.crs().authid() == "EPSG:4326" else "EPSG:32632"
        )

    def test_in_memory_have_no_id_column_of_the_file(self, send):
        assert send(OUTPUT, "memory:")[1].fields().names()[0] == "element_id"

    def test_keep_types_but_no_limits(self, send):
        _, layer = send(OUTPUT, "memory:")
        assert [field.type() for field in layer.fields()] == [type_ for _, type_ in ELEMENT_COLUMNS]

    def test_in_shapefiles_have_the_short_names_of_the_command_line(self, send, tmp_path):
        _, layer = send(OUTPUT, str(tmp_path / "out.shp"))
        assert layer.fields().names() == ["elem_id", "class", "n_obs", "n_inst", "length_m", "note"]
        assert sorted(each["elem_id"] for each in table(layer)) == ["a1", "b2"]

    def test_in_shapefiles_for_the_project_have_them_too(self, send, tmp_path, context):
        _, layer = send(OUTPUT, for_project(context, str(tmp_path / "out.shp")))
        assert layer.fields().names()[0] == "elem_id"

    def test_short_names_are_those_that_the_core_writes(self, interpreter):
        code = "import json; from polymerge_core.io.fields import SHAPEFILE_NAMES; print(json.dumps(SHAPEFILE_NAMES))"
        done = subprocess.run([interpreter, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
        assert json.loads(done.stdout) == _SHAPEFILE_NAMES

    def test_of_tables_have_no_geometry(self, send):
        _, layer = send(LINEAGE, "memory:")
        assert layer.wkbType() == QgsWkbTypes.Type.NoGeometry
        assert table(layer) == [{"source": "one", "weight": 1.0}]

    def test_without_a_crs_stay_without(self, send, tmp_path):
        path = tmp_path / "local.gpkg"
        write(path, "elements", ELEMENT_COLUMNS, ELEMENTS, LINES, crs="")
        assert not is_known(send(OUTPUT, "memory:", path)[1].crs())

    def test_hold_more_than_one_lot_of_features(self, send, tmp_path):
        path = tmp_path / "many.gpkg"
        rows = [(f"e{n}", "divider", 1, 1, 1.0, "") for n in range(4500)]
        write(path, "elements", ELEMENT_COLUMNS, rows, [track(n) for n in range(4500)])
        _, layer = send(OUTPUT, "memory:", path)
        assert layer.featureCount() == 4500
        assert len({row["element_id"] for row in table(layer)}) == 4500

    def test_two_can_go_into_one_geopackage(self, send, tmp_path):
        path = tmp_path / "both.gpkg"
        for result, layer in ((OUTPUT, "merged"), (LINEAGE, "who")):
            geometry = " (geom)" if result is OUTPUT else ""
            send(result, f"ogr:dbname='{path}' table=\"{layer}\"{geometry}")
        assert QgsVectorLayer(f"{path}|layername=merged", "m", "ogr").featureCount() == 2
        assert QgsVectorLayer(f"{path}|layername=who", "w", "ogr").featureCount() == 1


class TestWhatIsNotThere:
    def test_an_empty_layer_is_a_layer_all_the_same(self, send, tmp_path):
        path = tmp_path / "empty.gpkg"
        write(path, "elements", ELEMENT_COLUMNS, [])
        destination, layer = send(OUTPUT, str(tmp_path / "out.gpkg"), path)
        assert layer.isValid()
        assert layer.featureCount() == 0
        assert "element_id" in layer.fields().names()
        assert destination.startswith(str(tmp_path / "out.gpkg"))

    @pytest.mark.parametrize(
        ("result", "kind"),
        [(OUTPUT, QgsWkbTypes.Type.LineString), (OUTPUT._replace(kind="polygon"), QgsWkbTypes.Type.Polygon)],
    )
    def test_a_layer_that_does_not_know_its_kind_gets_that_of_the_result(self, send, tmp_path, result, kind):
        path = tmp_path / "unknown.gpkg"
        write(path, "elements", ELEMENT_COLUMNS, [], kind=QgsWkbTypes.Type.Unknown)
        assert send(result, "memory:", path)[1].wkbType() == kind

    def test_lines_and_areas_of_one_layer_come_apart(self, send, tmp_path):
        path = tmp_path / "mixed.gpkg"
        square = f"POLYGON(({EAST} {NORTH}, {EAST + 5} {NORTH}, {EAST + 5} {NORTH + 5}, {EAST} {NORTH}))"
        write(path, "elements", ELEMENT_COLUMNS, ELEMENTS, [LINES[0], square], kind=QgsWkbTypes.Type.Unknown)
        assert [row["element_id"] for row in table(send(OUTPUT, "memory:", path)[1])] == ["a1"]
        _, areas = send(AREAS, "memory:", path)
        assert [row["element_id"] for row in table(areas)] == ["b2"]
        assert areas.wkbType() == QgsWkbTypes.Type.Polygon

    def test_areas_alone_come_out_as_areas_and_leave_no_lines(self, send, tmp_path):
        path = tmp_path / "areas.gpkg"
        square = f"POLYGON(({EAST} {NORTH}, {EAST + 5} {NORTH}, {EAST + 5} {NORTH + 5}, {EAST} {NORTH}))"
        write(path, "elements", ELEMENT_COLUMNS, ELEMENTS[:1], [square], kind=QgsWkbTypes.Type.Polygon)
        _, areas = send(AREAS, "memory:", path)
        _, lines = send(OUTPUT, "memory:", path)
        assert (areas.featureCount(), areas.wkbType()) == (1, QgsWkbTypes.Type.Polygon)
        assert (lines.featureCount(), lines.wkbType()) == (0, QgsWkbTypes.Type.LineString)
        assert [field.name() for field in areas.fields()] == [field.name() for field in lines.fields()]

    def test_areas_that_nobody_asked_for_are_told(self, send, tmp_path, feedback):
        path = tmp_path / "areas.gpkg"
        square = f"POLYGON(({EAST} {NORTH}, {EAST + 5} {NORTH}, {EAST + 5} {NORTH + 5}, {EAST} {NORTH}))"
        write(path, "elements", ELEMENT_COLUMNS, ELEMENTS[:1], [square], kind=QgsWkbTypes.Type.Polygon)
        assert send(AREAS, None, path)[0] is None
        assert feedback.warnings == [
            "What belongs in “Merged areas” is not kept (1 in number): name an output for it as AREAS."
        ]

    def test_a_layer_that_the_worker_left_away_is_empty_with_the_columns_of_its_like(self, send):
        _, layer = send(AREAS, "memory:")
        assert layer.featureCount() == 0
        assert layer.wkbType() == QgsWkbTypes.Type.Polygon
        assert layer.fields().names() == [name for name, _ in ELEMENT_COLUMNS]
        assert layer.crs().authid() == "EPSG:32632"

    @pytest.mark.parametrize("destination", [None, ""])
    def test_an_optional_sink_that_nobody_wants_is_not_made(self, send, destination):
        assert send(LINEAGE, destination) == (None, None)


class TestFaults:
    @pytest.mark.parametrize("result", [OUTPUT, LINEAGE], ids=["required", "optional"])
    def test_a_folder_that_is_not_there_is_told(self, send, tmp_path, result):
        destination = str(tmp_path / "not" / "there" / "out.gpkg")
        with pytest.raises(QgsProcessingException) as told:
            send(result, destination)
        assert destination in str(told.value)

    def test_a_required_sink_that_is_missing_is_told(self, send):
        with pytest.raises(QgsProcessingException, match="OUTPUT"):
            send(OUTPUT, None)

    def test_a_sink_that_refuses_a_feature_is_told_with_the_result_s_title(self, send, monkeypatch):
        class Full:
            def addFeatures(self, *_rows):  # noqa: N802
                return False

            def lastError(self):  # noqa: N802
                return "the disk is full"

        monkeypatch.setattr(MergeLocalMaps, "parameterAsSink", lambda *_a: (Full(), "memory:x"), raising=False)
        with pytest.raises(QgsProcessingException, match=r"^Merged map cannot be written: the disk is full$"):
            send(OUTPUT, "memory:")


class TestLoading:
    def test_a_layer_for_the_project_is_loaded_with_its_style(self, send, context, feedback):
        destination, _ = send(OUTPUT, for_project(context))
        assert context.willLoadLayerOnCompletion(destination)
        style = context.layerToLoadOnCompletionDetails(destination).postProcessor()
        layer = memory_layer([track()], columns="field=class:string&field=element_id:integer", rows=[("divider", 1)])
        style.postProcessLayer(layer, context, feedback)
        assert classes(layer)[0][:2] == ("divider", "Divider")

    def test_one_that_is_not_for_the_project_is_not(self, send, context):
        send(OUTPUT, "memory:")
        assert context.layersToLoadOnCompletion() == {}

    @pytest.mark.parametrize(
        ("result", "loaded"), [(AREAS, False), (AREAS._replace(shown_empty=True), True)], ids=["as a rule", "the map"]
    )
    def test_an_empty_one_exists_but_is_not_loaded(self, send, context, result, loaded):
        first, _ = send(OUTPUT, for_project(context))
        destination, layer = send(result, for_project(context))
        assert layer.isValid()
        assert context.willLoadLayerOnCompletion(destination) == loaded
        assert context.willLoadLayerOnCompletion(first)

    def test_layers_are_called_by_their_titles(self, context, provider):
        algorithm = provider.algorithm("mergelocalmaps").create()
        assert isinstance(algorithm, QgsProcessingAlgorithm)
        titles = {each.parameter: each.title for each in algorithm.results()}
        assert titles["OUTPUT"] == "Merged map"
        assert len(set(titles.values())) == len(titles)


def classes(layer):
    """Return the categories of a layer: value, label and colour."""
    return [(each.value(), each.label(), each.symbol().color().name()) for each in layer.renderer().categories()]


def styled(feedback, values, style="merged_map", columns="field=class:string&field=element_id:string", **layer):
    given = memory_layer(
        [track(n) for n in range(len(values))],
        columns=columns,
        rows=[(value, f"e{n}") for n, value in enumerate(values)],
        **layer,
    )
    Style(style).postProcessLayer(given, None, feedback)
    return given


class TestStyle:
    def test_has_a_category_for_each_known_class_that_is_there_and_no_other(self, feedback):
        layer = styled(feedback, ["divider", "ped_crossing", "divider"])
        assert [(value, label) for value, label, _ in classes(layer)] == [
            ("ped_crossing", "Pedestrian crossing"),
            ("divider", "Divider"),
        ]
        assert feedback.everything == []

    def test_gives_each_unknown_class_its_own_colour_and_name(self, feedback):
        layer = styled(feedback, ["stairs", "divider", "kerb", "fence"])
        found = classes(layer)
        assert [value for value, _, _ in found] == ["divider", "fence", "kerb", "stairs"]
        assert [label for _, label, _ in found] == ["Divider", "fence", "kerb", "stairs"]
        assert len({colour for _, _, colour in found}) == 4

    def test_gives_the_same_classes_the_same_colours_whatever_their_order(self, feedback):
        assert classes(styled(feedback, ["b", "a", "c"])) == classes(styled(feedback, ["c", "b", "a"]))

    def test_gives_one_plain_class_a_category(self, feedback):
        assert [value for value, _, _ in classes(styled(feedback, ["line"]))] == ["line"]

    @pytest.mark.parametrize("nothing", ["", NULL], ids=["empty", "null"])
    def test_keeps_the_category_of_others_for_features_without_a_class(self, feedback, nothing):
        layer = styled(feedback, ["divider", nothing])
        assert [label for _, label, _ in classes(layer)] == ["Divider", "Other class"]

    @pytest.mark.parametrize("nothing", ["", NULL], ids=["empty", "null"])
    def test_draws_each_feature_whatever_its_class(self, feedback, nothing):
        layer = styled(feedback, ["divider", "stairs", nothing])
        render = QgsRenderContext()
        renderer = layer.renderer().clone()
        renderer.startRender(render, layer.fields())
        drawn = [renderer.symbolForFeature(feature, render) is not None for feature in layer.getFeatures()]
        renderer.stopRender(render)
        assert drawn == [True, True, True]

    @pytest.mark.parametrize(("count", "own"), [(24, True), (25, False)])
    def test_with_too_many_classes_stays_as_it_is(self, feedback, count, own):
        found = [value for value, _, _ in classes(styled(feedback, [f"c{n:02}" for n in range(count)]))]
        if own:
            assert found == [f"c{n:02}" for n in range(count)]
        else:
            assert found == ["ped_crossing", "divider", "boundary", ""]

    def test_of_a_layer_without_features_has_no_categories_to_be_wrong(self, feedback):
        assert classes(styled(feedback, [])) == []

    def test_names_the_columns_of_a_table_for_people(self, feedback):
        given = memory_layer([None], kind="None", columns="field=source:string&field=from_m:double&field=own:string")
        Style("lineage").postProcessLayer(given, None, feedback)
        assert [given.attributeDisplayName(n) for n in range(3)] == ["Source", "From (m)", "own"]

    def test_names_the_columns_of_the_map_and_keeps_those_of_the_user(self, feedback):
        layer = styled(feedback, ["divider"])
        assert layer.attributeDisplayName(layer.fields().lookupField("element_id")) == "Element"

    def test_of_a_layer_without_a_class_is_harmless(self, feedback):
        given = memory_layer([track()], columns="field=kind:string", rows=[("x",)])
        Style("merged_map").postProcessLayer(given, None, feedback)
        assert given.isValid()

    def test_of_single_symbols_is_left_alone(self):
        given = memory_layer([track()])
        before = given.renderer()
        name_classes(given)
        assert given.renderer() is before

    @pytest.mark.parametrize(
        "style",
        [
            "local_maps",
            "merged_areas",
            "instances",
            "network_edges",
            "network_observations",
            "left_out",
            "id_aliases",
            "evaluation_errors",
            "evaluated",
            "evaluated_areas",
            "measures",
            "stored_map",
            "stored_map_areas",
            "changes",
            "changes_areas",
            "moves",
        ],
    )
    def test_loads_without_a_word(self, feedback, style):
        polygons = ("merged_areas", "instances", "evaluated_areas", "stored_map_areas", "changes_areas")
        areas = dict.fromkeys(polygons, "Polygon")
        tables = dict.fromkeys(("left_out", "id_aliases", "measures"), "None")
        kind = (areas | tables).get(style, "LineString")
        given = memory_layer([], kind=kind, columns="field=class:string&field=component:integer")
        Style(style).postProcessLayer(given, None, feedback)
        assert feedback.everything == []

    def test_that_cannot_be_read_is_a_warning(self, feedback):
        Style("nothing_like_it").postProcessLayer(memory_layer([]), None, feedback)
        assert len(feedback.warnings) == 1

    def test_of_what_is_no_vector_layer_is_nothing(self, feedback, tmp_path):
        Style("merged_map").postProcessLayer(QgsRasterLayer(str(tmp_path / "x.tif"), "x"), None, feedback)
        Style("merged_map").postProcessLayer(None, None, feedback)
        assert feedback.everything == []
