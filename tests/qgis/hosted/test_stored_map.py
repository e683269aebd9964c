"""A stored map in QGIS: fed by the real worker while the project shows it, played by time, and its changes."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path

import pytest
from qgis.core import (
    Qgis,
    QgsDateTimeRange,
    QgsFeature,
    QgsFeatureRequest,
    QgsGeometry,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingUtils,
    QgsProject,
    QgsRenderContext,
    QgsTemporalUtils,
    QgsVectorLayer,
    QgsVectorLayerTemporalContext,
    QgsWkbTypes,
)
from qgis.PyQt.QtCore import QDateTime, Qt

from qgis_plugin import stored_map
from qgis_plugin.algorithms.update_map import UpdateMap
from qgis_plugin.layout import ROOT

from .host import Recorder
from .layers import EAST, NORTH, file_layer, memory_layer, table, track

COLUMNS = "field=class:string&field=drive:string&field=instance:string&field=timestamp:datetime"

MARCH, APRIL = "2024-03-01T10:00:00Z", "2024-04-01T10:00:00Z"


def looks(drive, *offsets, time=MARCH, kind="divider", name=""):
    """Return three looks of one drive at lines, each look a local map."""
    pairs = [(offset + 0.02 * n, n) for n in range(3) for offset in offsets]
    return memory_layer(
        [track(offset) for offset, _ in pairs],
        name=name or drive,
        columns=COLUMNS,
        rows=[(kind, drive, f"f{n}", QDateTime.fromString(time, Qt.DateFormat.ISODate)) for _, n in pairs],
    )


def footprints(drive):
    """Return what those local maps looked at: 40 m around the lines."""
    box = f"POLYGON(({EAST - 9} {NORTH - 20}, {EAST + 40} {NORTH - 20}, {EAST + 40} {NORTH + 20}, "
    box += f"{EAST - 9} {NORTH + 20}, {EAST - 9} {NORTH - 20}))"
    columns = "field=drive:string&field=instance:string"
    return memory_layer([box] * 3, kind="Polygon", columns=columns, rows=[(drive, f"f{n}") for n in range(3)])


def add_area(file):
    """Put an area into a map, as one that is drawn; it lies 60 m to the north."""
    y = NORTH + 60
    shape = f"POLYGON(({EAST} {y}, {EAST + 5} {y}, {EAST + 5} {y + 5}, {EAST} {y + 5}, {EAST} {y}))"
    rows = {"elements": {"element_id": 77}, "changes": {"element_id": 77, "revision": 1, "kind": "added"}}
    for name, row in rows.items():
        layer = QgsVectorLayer(f"{file}|layername={name}|geometrytype=Polygon", name, "ogr")
        feature = QgsFeature(layer.fields())
        feature.setGeometry(QgsGeometry.fromWkt(shape))
        for column, value in {**row, "class": "island", "n_observations": 1}.items():
            feature[column] = value
        assert layer.dataProvider().addFeatures([feature])[0]


def call_it_moved(file):
    """Have the changes of the second revision be moves."""
    layer = QgsVectorLayer(f"{file}|layername=changes|geometrytype=LineString", "changes", "ogr")
    column = layer.fields().lookupField("kind")
    moved = {each.id(): {column: "moved"} for each in layer.getFeatures() if each["revision"] == 2}
    assert layer.dataProvider().changeAttributeValues(moved)


@pytest.fixture
def file(tmp_path) -> str:
    return str(tmp_path / "town.gpkg")


@pytest.fixture
def update(run, ready, file):
    """Return a function that feeds the map layers."""

    def go(*layers, **parameters):
        return run("updatemap", **{"MAP": file, "LOCAL_MAPS": list(layers), **parameters})

    return go


@pytest.fixture
def lines(update, file, context):
    """The lines of a map of one revision, as a layer of the project."""
    update(looks("march", 0.0, 6.0))
    layer = QgsVectorLayer(stored_map.address(file, "line"), "my map", "ogr")
    assert context.project().addMapLayer(layer, False) is layer
    assert layer.featureCount() == 2
    context.setLayersToLoadOnCompletion({})
    return layer


def loaded(context) -> dict[str, QgsProcessingContext.LayerDetails]:
    return context.layersToLoadOnCompletion()


def load(context, feedback) -> list[QgsVectorLayer]:
    """Load what a run leaves to be loaded, as the toolbox does."""
    layers = []
    for source, details in loaded(context).items():
        layer = QgsProcessingUtils.mapLayerFromString(source, context, typeHint=details.layerTypeHint)
        layer.setName(details.name)
        details.project.addMapLayer(context.temporaryLayerStore().takeMapLayer(layer), False)
        details.postProcessor().postProcessLayer(layer, context, feedback)
        layers.append(layer)
    context.setLayersToLoadOnCompletion({})
    return layers


class TestUpdating:
    def test_makes_a_map_and_says_what_is_in_it(self, update, file, feedback):
        results = update(looks("march", 0.0, 6.0))
        assert results["MAP"] == file
        assert results["OUTPUT"] == f"{file}|layername=elements|geometrytype=LineString"
        assert "AREAS" not in results
        assert (results["REVISION"], results["ADDED"], results["ELEMENTS"]) == (1, 2, 2)
        assert [results[each] for each in ("CHANGED", "MOVED", "RETIRED", "MERGED", "SKIPPED")] == [0] * 5
        assert feedback.warnings == []
        assert feedback.progresses[-1] == 100

    def test_goes_on_where_it_was(self, update):
        first, second = update(looks("march", 0.0)), update(looks("april", 0.0, 9.0, time=APRIL))
        assert (first["REVISION"], second["REVISION"]) == (1, 2)
        assert (second["ADDED"], second["ELEMENTS"]) == (1, 2)
        assert second["CHANGED"] + second["MOVED"] == 1

    def test_of_what_it_knows_is_skipped_and_told(self, update, feedback):
        update(looks("march", 0.0))
        results = update(looks("march", 0.0))
        assert (results["REVISION"], results["SKIPPED"]) == (1, 3)
        assert any("3 local maps were skipped" in each for each in feedback.warnings)

    def test_with_footprints_retires_what_is_not_seen_any_more(self, update):
        update(looks("march", 0.0, 6.0), INSTANCES=footprints("march"))
        later = [
            update(looks(drive, 0.0, time=APRIL), INSTANCES=footprints(drive))
            for drive in ("april", "may", "june", "july")
        ]
        assert sum(each["RETIRED"] for each in later) == 1
        assert later[-1]["ELEMENTS"] == 1

    def test_takes_the_columns_the_classes_of_areas_the_proximity_and_the_crs_of_a_new_map(
        self, update, file, tmp_path
    ):
        layer = memory_layer([track(), track(0.1)], columns="field=kind:string", rows=[("kerb",), ("kerb",)])
        report = tmp_path / "report.json"
        more = {"CLASS_FIELD": "kind", "PROXIMITY": 2.5, "AREA": "island,lawn", "CRS": "EPSG:25832"}
        results = update(layer, **more, REPORT=str(report))
        (row,) = table(QgsVectorLayer(results["OUTPUT"], "m", "ogr"))
        assert row["class"] == "kerb"
        settings = dict(sqlite3.connect(file).execute("SELECT name, value FROM map_settings").fetchall())
        assert (json.loads(settings["proximity"]), json.loads(settings["area"])) == (
            2.5,
            ["island", "lawn", "ped_crossing"],
        )
        assert QgsVectorLayer(results["OUTPUT"], "m", "ogr").crs().authid() == "EPSG:25832"
        assert json.loads(report.read_text())["revision"] == 1
        again = update(looks("march", 0.0))
        assert again["REVISION"] == 2

    def test_names_sources_as_the_layers_are(self, update, file):
        update(looks("march", 0.0, name="First drive"))
        connection = sqlite3.connect(file)
        assert connection.execute("SELECT DISTINCT source FROM observations").fetchall() == [("First drive",)]
        assert connection.execute("SELECT source FROM revisions").fetchall() == [("First drive",)]

    def test_runs_the_core_of_this_tree(self, update, file, interpreter):
        update(looks("march", 0.0))
        assert Path(stored_map.__file__).is_relative_to(ROOT)
        assert interpreter


class TestFaults:
    def test_a_map_that_is_not_there_is_made_only_where_that_is_wanted(self, update, file):
        with pytest.raises(QgsProcessingException, match=r"There is no map .*town\.gpkg"):
            update(looks("march", 0.0), CREATE=False)
        assert not Path(file).exists()

    def test_another_geopackage_is_no_map_and_stays_as_it_is(self, update, tmp_path):
        other = file_layer(memory_layer([track()]), tmp_path / "tracks.gpkg").source().split("|")[0]
        before = Path(other).read_bytes()
        with pytest.raises(QgsProcessingException, match=r"tracks\.gpkg is no stored map"):
            update(looks("march", 0.0), MAP=other)
        assert Path(other).read_bytes() == before

    def test_a_new_map_is_a_geopackage(self, update, tmp_path):
        with pytest.raises(QgsProcessingException, match=r"ends in \.gpkg, not town\.shp"):
            update(looks("march", 0.0), MAP=str(tmp_path / "town.shp"))

    def test_a_folder_that_is_not_there_is_told(self, update, tmp_path):
        with pytest.raises(QgsProcessingException, match="there is no such folder"):
            update(looks("march", 0.0), MAP=str(tmp_path / "no" / "town.gpkg"))

    def test_the_map_itself_is_nothing_that_was_seen(self, update, lines):
        with pytest.raises(QgsProcessingException, match="“my map” is a part of the map"):
            update(lines)

    def test_the_report_does_not_overwrite_the_map(self, update, lines, file):
        with pytest.raises(QgsProcessingException, match="Report would overwrite"):
            update(looks("april", 0.0), REPORT=file)

    def test_another_proximity_than_the_map_s_is_refused_with_the_reason(self, update, lines):
        with pytest.raises(QgsProcessingException, match="was made with a proximity of 1 m"):
            update(looks("april", 0.0), PROXIMITY=3)

    def test_a_bad_feature_leaves_the_map_as_it_was_where_it_is_strict(self, update, lines, file):
        bad = looks("april", 0.0)
        bad.dataProvider().changeGeometryValues({1: memory_layer(["LINESTRING EMPTY"]).getFeature(1).geometry()})
        before = table(QgsVectorLayer(stored_map.address(file, "line"), "m", "ogr"))
        with pytest.raises(QgsProcessingException, match="april"):
            update(bad, STRICT=True)
        assert table(QgsVectorLayer(stored_map.address(file, "line"), "m", "ogr")) == before


class TestCancel:
    def cancel(self, feedback):
        feedback.on_text = lambda text: feedback.cancel() if text == "updating the map" else None

    def test_leaves_the_map_as_it_was(self, update, lines, file, feedback):
        self.cancel(feedback)
        with pytest.raises(QgsProcessingException, match=r"^Cancelled; nothing was written\.$"):
            update(looks("april", 40.0, time=APRIL))
        assert sqlite3.connect(file).execute("SELECT COUNT(*) FROM revisions").fetchone() == (1,)
        lines.reload()
        assert lines.featureCount() == 2

    def test_of_the_first_run_leaves_nothing_that_the_next_one_stumbles_over(
        self, run, ready, file, feedback, provider
    ):
        self.cancel(feedback)
        given = {"MAP": file, "LOCAL_MAPS": [looks("march", 0.0)]}
        with pytest.raises(QgsProcessingException, match="Cancelled"):
            run("updatemap", **given)
        results, fine = provider.algorithm("updatemap").run(given, QgsProcessingContext(), Recorder())
        assert fine
        assert results["REVISION"] == 1


class TestWhileTheProjectShowsIt:
    def test_layers_show_the_new_revision_and_none_is_added(self, update, lines, context):
        assert len(list(lines.getFeatures())) == 2
        results = update(looks("april", 0.0, 6.0, 40.0, time=APRIL))
        assert results["REVISION"] == 2
        assert lines.featureCount() == len(list(lines.getFeatures())) == 3
        assert lines.extent().yMaximum() > NORTH + 39
        assert max(row["n_observations"] for row in table(lines)) == 6
        assert loaded(context) == {}
        assert list(context.project().mapLayers().values()) == [lines]

    def test_it_can_be_read_in_the_middle(self, update, lines):
        reading = lines.getFeatures()
        next(reading)
        assert update(looks("april", 0.0, 40.0, time=APRIL))["REVISION"] == 2
        assert len(list(reading)) == 1
        assert lines.featureCount() == 3

    def test_its_other_layers_are_refreshed_too(self, update, lines, file, context):
        changes = QgsVectorLayer(f"{file}|layername=changes|geometrytype=LineString", "history", "ogr")
        context.project().addMapLayer(changes, False)
        before = changes.featureCount()
        update(looks("april", 0.0, 40.0, time=APRIL))
        assert changes.featureCount() > before

    def test_is_found_by_another_name_of_its_file(self, update, lines, file, context, tmp_path):
        link = tmp_path / "link.gpkg"
        link.symlink_to(file)
        update(looks("april", 40.0, time=APRIL), MAP=str(link))
        assert lines.featureCount() == 3
        assert loaded(context) == {}

    def test_while_it_is_edited_nothing_is_written_and_a_sentence_says_what_to_do(self, update, lines, file):
        assert lines.startEditing()
        with pytest.raises(QgsProcessingException) as told:
            update(looks("april", 40.0, time=APRIL))
        assert str(told.value).splitlines()[-1] == (
            "Layer “my map” of this map is being edited: save or discard the edits, and run it again."
        )
        lines.rollBack()
        assert update(looks("april", 40.0, time=APRIL))["REVISION"] == 2
        assert lines.featureCount() == 3

    def test_edits_that_begin_during_the_run_are_kept_and_told(self, update, lines, feedback):
        feedback.on_text = lambda text: lines.isEditable() or (text == "updating the map" and lines.startEditing())
        column = lines.fields().lookupField("class")
        assert update(looks("april", 40.0, time=APRIL))["REVISION"] == 2
        assert lines.isEditable()
        assert any("is being edited, and shows the map as it was" in each for each in feedback.warnings)
        assert lines.changeAttributeValue(next(lines.getFeatures()).id(), column, "kerb")
        assert lines.commitChanges(), lines.commitErrors()
        lines.reload()
        assert lines.featureCount() == 3
        assert "kerb" in {row["class"] for row in table(lines)}

    def test_areas_that_are_new_are_loaded_beside_lines_that_are_there(self, update, lines, file, context):
        add_area(file)
        results = update(looks("april", 0.0, time=APRIL))
        assert set(loaded(context)) == {results["AREAS"]}

    def test_a_map_of_another_file_is_left_alone(self, update, lines, context, tmp_path):
        results = update(looks("march", 0.0), MAP=str(tmp_path / "other.gpkg"))
        assert lines.featureCount() == 2
        assert set(loaded(context)) == {results["OUTPUT"]}

    def test_without_a_project_nothing_is_loaded(self, provider, ready, file, feedback):
        bare = QgsProcessingContext()
        given = {"MAP": file, "LOCAL_MAPS": [looks("march", 0.0)]}
        results, fine = UpdateMap.run(provider.algorithm("updatemap"), given, bare, feedback)
        assert fine
        assert results["REVISION"] == 1
        assert loaded(bare) == {}


class TestLoading:
    def test_lines_and_areas_are_two_layers_styled_and_named_by_the_file(self, update, file, context, feedback):
        update(looks("march", 0.0))
        add_area(file)
        results = update(looks("april", 0.0))
        assert set(loaded(context)) == {results["OUTPUT"], results["AREAS"]}
        layers = {layer.name(): layer for layer in load(context, feedback)}
        assert set(layers) == {"Map town", "Map town, areas"}
        kinds = {name: layer.geometryType() for name, layer in layers.items()}
        assert kinds["Map town"] == QgsWkbTypes.GeometryType.LineGeometry
        assert kinds["Map town, areas"] == QgsWkbTypes.GeometryType.PolygonGeometry
        assert all(layer.featureCount() == 1 for layer in layers.values())
        assert {layer.renderer().classAttribute() for layer in layers.values()} == {"class"}
        assert "island" in [each.value() for each in layers["Map town, areas"].renderer().categories()]
        assert feedback.warnings == []

    def test_classes_that_come_later_are_drawn(self, update, context, feedback):
        update(looks("march", 0.0))
        (layer,) = load(context, feedback)
        update(looks("april", 30.0, kind="boundary"), looks("april", 60.0, kind="fence", name="fences"))
        render, renderer = QgsRenderContext(), layer.renderer().clone()
        renderer.startRender(render, layer.fields())
        drawn = [renderer.symbolForFeature(feature, render) is not None for feature in layer.getFeatures()]
        renderer.stopRender(render)
        assert drawn == [True] * 3

    def test_a_map_without_elements_is_a_layer_all_the_same(self, update, context, feedback):
        update(memory_layer([], name="nothing"))
        (layer,) = load(context, feedback)
        assert (layer.featureCount(), layer.geometryType()) == (0, QgsWkbTypes.GeometryType.LineGeometry)


class TestTime:
    @pytest.fixture
    def layer(self, update, context, feedback):
        update(looks("march", 0.0, 30.0))
        update(looks("april", 0.0, 60.0, time=APRIL))
        (layer,) = load(context, feedback)
        return layer

    def test_the_layer_knows_when_each_element_was_seen(self, layer):
        properties = layer.temporalProperties()
        assert properties.isActive()
        assert properties.mode() == Qgis.VectorTemporalMode.FeatureDateTimeStartAndEndFromFields
        assert (properties.startField(), properties.endField()) == ("first_seen", "last_seen")

    @pytest.mark.parametrize(
        ("begin", "end", "seen"),
        [
            ("2024-02-01", "2024-02-28", []),
            ("2024-02-25", "2024-03-05", [0, 30]),
            ("2024-03-10", "2024-03-20", [0]),
            ("2024-03-28", "2024-04-05", [0, 60]),
            ("2024-04-10", "2024-05-01", []),
        ],
    )
    def test_the_temporal_controller_shows_what_was_seen_around_then(self, layer, begin, end, seen):
        when = QgsDateTimeRange(*(QDateTime.fromString(day, Qt.DateFormat.ISODate) for day in (begin, end)))
        asked = QgsVectorLayerTemporalContext()
        asked.setLayer(layer)
        wanted = QgsFeatureRequest().setFilterExpression(layer.temporalProperties().createFilterString(asked, when))
        found = [feature.geometry().boundingBox().yMinimum() - NORTH for feature in layer.getFeatures(wanted)]
        assert sorted(round(each) for each in found) == seen

    def test_the_controller_finds_its_range(self, layer, context):
        assert layer.id() in context.project().mapLayers()
        extent = QgsTemporalUtils.calculateTemporalRangeForProject(context.project())
        assert extent.begin().toUTC().toString(Qt.DateFormat.ISODate) == MARCH
        assert extent.end().toUTC().toString(Qt.DateFormat.ISODate) == APRIL


class TestUndoing:
    def test_takes_an_update_back_and_layers_show_it(self, update, run, ready, lines, file, context):
        update(looks("april", 40.0, time=APRIL))
        assert lines.featureCount() == 3
        results = run("undoupdate", MAP=file, REVISION=2)
        assert (results["NEW_REVISION"], results["ELEMENTS"], results["RETIRED"]) == (3, 2, 1)
        assert lines.featureCount() == 2
        assert not loaded(context)
        assert results["OUTPUT"] == stored_map.address(file, "line")

    def test_takes_several_back(self, update, run, ready, lines, file):
        update(looks("april", 40.0, time=APRIL))
        assert run("undoupdate", MAP=file, REVISION=1, UNTIL=2)["ELEMENTS"] == 0

    @pytest.mark.parametrize(("revision", "said"), [(7, "no revision 7"), (None, "Revision to take back")])
    def test_says_what_cannot_be_taken_back(self, run, ready, lines, file, revision, said):
        before = Path(file).read_bytes()
        with pytest.raises(QgsProcessingException, match=said):
            run("undoupdate", MAP=file, REVISION=revision)
        assert Path(file).read_bytes() == before

    def test_needs_a_map_that_is_there(self, run, ready, tmp_path):
        with pytest.raises(QgsProcessingException, match="There is no map"):
            run("undoupdate", MAP=str(tmp_path / "nowhere.gpkg"), REVISION=1)

    def test_leaves_a_map_alone_that_is_edited(self, run, ready, lines, file):
        lines.startEditing()
        with pytest.raises(QgsProcessingException, match="is being edited"):
            run("undoupdate", MAP=file, REVISION=1)
        lines.rollBack()


SINKS = dict.fromkeys(("CHANGES", "CHANGES_AREAS", "MOVES"), "memory:")


class TestChanges:
    @pytest.fixture
    def changes(self, run, ready, file, context):
        """Return a function that gives the numbers and the layers of the changes of the map."""

        def go(**parameters):
            results = run("mapchanges", **{"MAP": file, **SINKS, **parameters})
            return results, {
                name: QgsProcessingUtils.mapLayerFromString(results[name], context) for name in SINKS if name in results
            }

        return go

    def test_since_the_empty_map_are_all_elements(self, update, changes):
        update(looks("march", 0.0, 6.0))
        results, layers = changes()
        assert (results["ADDED"], results["MOVED"], results["RETIRED"]) == (2, 0, 0)
        assert [row["kind"] for row in table(layers["CHANGES"])] == ["added", "added"]
        assert layers["MOVES"].featureCount() == layers["CHANGES_AREAS"].featureCount() == 0

    def test_since_a_revision_are_those_of_what_came_later(self, update, changes):
        update(looks("march", 0.0, 6.0))
        update(looks("april", 40.0, time=APRIL))
        results, layers = changes(SINCE=1)
        assert results["ADDED"] == 1
        assert {row["kind"]: row["revision"] for row in table(layers["CHANGES"])} == {"added": 2}
        assert changes(SINCE=2)[1]["CHANGES"].featureCount() == 0

    def test_of_lines_and_areas_come_apart(self, update, file, changes):
        update(looks("march", 0.0))
        add_area(file)
        _, layers = changes()
        assert [row["class"] for row in table(layers["CHANGES"])] == ["divider"]
        assert [row["class"] for row in table(layers["CHANGES_AREAS"])] == ["island"]
        assert layers["CHANGES_AREAS"].geometryType() == QgsWkbTypes.GeometryType.PolygonGeometry

    def test_what_moved_has_an_arrow_to_where_it_is(self, update, changes, file):
        update(looks("march", 0.0))
        results = update(looks("april", 0.6, time=APRIL))
        assert results["MOVED"] + results["CHANGED"] == 1
        _, layers = changes(SINCE=1)
        (row,) = table(layers["CHANGES"])
        assert 0 < row["moved_m"] < 0.7
        if row["kind"] != "moved":
            call_it_moved(file)
            _, layers = changes(SINCE=1)
        (arrow,) = layers["MOVES"].getFeatures()
        start, *_, end = arrow.geometry().asPolyline()
        assert end.y() > start.y()
        assert arrow["moved_m"] == pytest.approx(row["moved_m"])

    def test_can_be_asked_for_while_the_project_shows_the_map(self, lines, changes):
        reading = lines.getFeatures()
        next(reading)
        assert changes()[0]["ADDED"] == 2

    def test_a_revision_that_is_not_there_is_told(self, lines, changes):
        with pytest.raises(QgsProcessingException, match="has no revision 7; it has 1 to 1"):
            changes(SINCE=7)

    def test_a_file_that_is_no_map_is_told(self, changes, tmp_path):
        with pytest.raises(QgsProcessingException, match="There is no map"):
            changes(MAP=str(tmp_path / "nowhere.gpkg"))

    @pytest.mark.parametrize("where", ["{0}", "ogr:dbname='{0}' table=\"changes\" (geom)"])
    def test_do_not_overwrite_the_map(self, lines, changes, file, where):
        before = Path(file).read_bytes()
        with pytest.raises(QgsProcessingException, match="Changes would overwrite"):
            changes(CHANGES=where.format(file))
        assert Path(file).read_bytes() == before


def test_the_project_is_empty_again():
    assert QgsProject.instance().mapLayers() == {}
