"""Whole runs with the real worker: layers in, map out; in the background, cancelled, and two at once."""

from __future__ import annotations

import json
import os
import threading
import time
from pathlib import Path

import pytest
from qgis.core import (
    QgsApplication,
    QgsCoordinateReferenceSystem,
    QgsProcessingAlgRunnerTask,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingOutputLayerDefinition,
    QgsProcessingUtils,
    QgsProject,
    QgsVectorLayer,
    QgsWkbTypes,
)
from qgis.PyQt.QtCore import QEventLoop, QTimer

from qgis_plugin import environment
from qgis_plugin.layout import ROOT

from .host import Recorder
from .layers import EAST, NORTH, add_features, file_layer, memory_layer, table, track

pytestmark = pytest.mark.usefixtures("ready")

SAMPLE = ROOT / "resources" / "sample"


def opened(results, name, context) -> QgsVectorLayer:
    layer = QgsProcessingUtils.mapLayerFromString(results[name], context)
    assert layer is not None, name
    return layer


def leftovers() -> list[Path]:
    return list(Path(QgsProcessingUtils.tempFolder()).glob("polymerge_*"))


@pytest.fixture(autouse=True)
def _leaves_no_file():
    yield
    assert leftovers() == []


@pytest.fixture
def tracks():
    """Looks at one path, a little apart."""
    return memory_layer([track(0.2 * n) for n in range(4)], columns="field=id:integer", rows=[(n,) for n in range(4)])


ALL = dict.fromkeys(("OUTPUT", "AREAS", "LINEAGE", "LEFT_OUT", "ID_ALIASES"), "memory:")


class TestMerging:
    def test_tracks_without_any_column_become_one_line(self, run, context, tracks, feedback, tmp_path):
        results = run("mergelocalmaps", LOCAL_MAPS=[tracks], REPORT=str(tmp_path / "report.json"), **ALL)
        elements = opened(results, "OUTPUT", context)
        assert elements.featureCount() == 1
        assert elements.crs().authid() == "EPSG:32632"
        assert elements.fields().names()[:2] == ["element_id", "class"]
        assert (results["N_ELEMENTS"], results["N_OBSERVATIONS"], results["N_LEFT_OUT"]) == (1, 4, 0)
        lineage = table(opened(results, "LINEAGE", context))
        assert {int(row["source_fid"]) for row in lineage} == {1, 2, 3, 4}
        assert {row["source"] for row in lineage} == {"tracks"}
        assert json.loads((tmp_path / "report.json").read_text())["elements"] == 1
        assert results["REPORT"] == str(tmp_path / "report.json")
        assert opened(results, "AREAS", context).featureCount() == 0
        assert opened(results, "LEFT_OUT", context).fields().names()[-1] == "reason"
        assert opened(results, "ID_ALIASES", context).fields().names() == ["old_id", "element_id"]
        assert feedback.progresses == sorted(feedback.progresses)
        assert feedback.progresses[-1] == 100
        assert len(set(feedback.progresses)) > 5
        assert feedback.infos == ["4 observations of 4 local maps became 1 element"]

    def test_layers_of_odd_names_and_kinds_all_come(self, run, context, feedback):
        names = [
            "a/b: *?",
            "道路",
            "x" * 300,
            "s3:bucket",
            "tracks.zip",
            "tracks",
            "Tracks",
            "-o",
            "a|b",
            "50 % + &",
            "x.gpkg",
        ]
        layers = [memory_layer([track(0.1 * n)], name=name) for n, name in enumerate(names)]
        results = run("mergelocalmaps", LOCAL_MAPS=layers, OUTPUT="memory:", LINEAGE="memory:")
        lineage = table(opened(results, "LINEAGE", context))
        assert len({row["source"] for row in lineage}) == len(names)
        assert {"道路", "tracks", "tracks.zip", "-o", "50 % + &"} <= {row["source"] for row in lineage}
        assert results["N_ELEMENTS"] == 1
        assert not any(QgsProcessingUtils.tempFolder() in each for each in feedback.everything)

    def test_features_not_saved_yet_are_known_by_their_ids(self, run, context, tracks):
        tracks.startEditing()
        add_features(tracks, [track(0.9)], [(9,)])
        tracks.deleteFeature(1)
        results = run("mergelocalmaps", LOCAL_MAPS=[tracks], OUTPUT="memory:", LINEAGE="memory:")
        ids = {int(row["source_fid"]) for row in table(opened(results, "LINEAGE", context))}
        assert ids == {feature.id() for feature in tracks.getFeatures()}
        assert min(ids) < 0
        tracks.rollBack()

    def test_selected_features_only(self, run, context, tracks):
        tracks.selectByIds([1, 2])
        results = run("mergelocalmaps", LOCAL_MAPS=[tracks], SELECTED_ONLY=True, OUTPUT="memory:")
        assert results["N_OBSERVATIONS"] == 2

    def test_curves_multiparts_and_bad_geometries_are_merged_or_accounted_for(self, run, context):
        x, y = EAST, NORTH
        layers = [
            memory_layer(
                [f"CIRCULARSTRING({x} {y}, {x + 10} {y + 0.2}, {x + 20} {y})"], kind="CompoundCurve", name="curve"
            ),
            memory_layer(
                [f"MULTILINESTRINGZ(({x} {y} 1, {x + 20} {y} 2), ({x} {y + 50} 1, {x + 20} {y + 50} 2))"],
                kind="MultiLineStringZ",
                name="multi",
            ),
            memory_layer([None, "LINESTRING EMPTY", f"LINESTRING({x} {y}, {x} {y})", track(0.1)], name="bad"),
        ]
        results = run("mergelocalmaps", LOCAL_MAPS=layers, OUTPUT="memory:", LINEAGE="memory:", LEFT_OUT="memory:")
        left_out = table(opened(results, "LEFT_OUT", context))
        lineage = table(opened(results, "LINEAGE", context))
        assert {row["source"] for row in lineage} == {"curve", "multi", "bad"}
        assert sorted(int(row["source_fid"]) for row in left_out if row["source"] == "bad") == [1, 2, 3]
        assert all(row["reason"] for row in left_out)
        assert results["N_LEFT_OUT"] == len(left_out)
        assert opened(results, "OUTPUT", context).featureCount() == results["N_ELEMENTS"] == 2

    def test_columns_of_every_type_are_carried(self, run, context):
        given = memory_layer(
            [track(), track(0.2)],
            columns="field=name:string&field=day:date&field=at:time&field=tags:string[]&field=ok:bool&field=raw:binary&field=fid:integer&field=geom:string",
            rows=[("ü", None, None, ["a"], True, None, 5, "g"), ("o", None, None, [], False, None, 6, "h")],
        )
        results = run("mergelocalmaps", LOCAL_MAPS=[given], OUTPUT=QgsProcessingUtils.generateTempFilename("out.gpkg"))
        (row,) = table(opened(results, "OUTPUT", context))
        assert {"name", "tags", "ok"} <= set(row)
        assert row["name"] in {"ü", "o"}

    def test_lines_and_areas_come_apart(self, run, context):
        square = (
            f"POLYGON(({EAST} {NORTH}, {EAST + 5} {NORTH}, {EAST + 5} {NORTH + 5}, {EAST} {NORTH + 5}, {EAST} {NORTH}))"
        )
        areas = memory_layer([square], kind="Polygon", name="squares", columns="field=class:string", rows=[("island",)])
        results = run(
            "mergelocalmaps", LOCAL_MAPS=[memory_layer([track(40)]), areas], OUTPUT="memory:", AREAS="memory:"
        )
        assert opened(results, "OUTPUT", context).geometryType() == QgsWkbTypes.GeometryType.LineGeometry
        assert [row["class"] for row in table(opened(results, "AREAS", context))] == ["island"]

    def test_a_layer_without_features_gives_an_empty_map_of_lines_and_a_warning(self, run, context, feedback):
        results = run("mergelocalmaps", LOCAL_MAPS=[memory_layer([], name="nothing")], **ALL)
        layer = opened(results, "OUTPUT", context)
        assert layer.featureCount() == 0
        assert layer.wkbType() == QgsWkbTypes.Type.LineString
        assert layer.crs().authid() == "EPSG:32632"
        assert "element_id" in layer.fields().names()
        areas = opened(results, "AREAS", context)
        assert (areas.wkbType(), areas.crs().authid()) == (QgsWkbTypes.Type.Polygon, "EPSG:32632")
        assert any("nothing" in each for each in feedback.warnings)

    def test_a_layer_without_a_crs_in_plain_metres(self, run, context, tmp_path):
        given = file_layer(
            memory_layer(["LINESTRING(0 0, 9 0)", "LINESTRING(0 0.2, 9 0.2)"], crs=""), tmp_path / "plain.gpkg"
        )
        results = run("mergelocalmaps", LOCAL_MAPS=[given], LOCAL_CRS=True, OUTPUT="memory:")
        layer = opened(results, "OUTPUT", context)
        assert layer.featureCount() == 1
        assert layer.crs().authid() == ""

    def test_a_crs_of_the_user_s_own_making_for_layers_without_one(self, run, context):
        own = QgsCoordinateReferenceSystem.fromProj(
            "+proj=tmerc +lat_0=51 +lon_0=9 +k=1 +x_0=0 +y_0=0 +ellps=GRS80 +units=m"
        )
        given = memory_layer(["LINESTRING(0 0, 9 0)", "LINESTRING(0 0.2, 9 0.2)"], crs="")
        results = run("mergelocalmaps", LOCAL_MAPS=[given], CRS=own, OUT_CRS="EPSG:4326", OUTPUT="memory:")
        layer = opened(results, "OUTPUT", context)
        assert layer.crs().authid() == "EPSG:4326"
        assert abs(layer.extent().xMinimum() - 9) < 1e-6


class TestMainMap:
    @pytest.fixture
    def old(self, context):
        """A merged map of two elements in the project."""
        columns = "field=element_id:int8&field=class:string&field=score:double&field=n_observations:int8"
        rows = [(11, "kerb", 1.0, 2), (12, "wall", 1.0, 1)]
        layer = memory_layer([track(), track(30)], name="old map", columns=columns, rows=rows)
        context.project().addMapLayer(layer, False)
        return layer

    def test_elements_of_a_file_keep_their_ids_and_bring_no_column_of_its_ids(self, run, context, old, tmp_path):
        file = file_layer(old, tmp_path / "map.gpkg")
        assert file.fields().names()[0] == "fid"
        new = memory_layer([track(0.2)], columns="field=class:string", rows=[("kerb",)])
        results = run("mergelocalmaps", LOCAL_MAPS=[new], MAIN_MAP=file, OUTPUT="memory:")
        layer = opened(results, "OUTPUT", context)
        assert {row["class"]: row["element_id"] for row in table(layer)} == {"kerb": 11, "wall": 12}
        assert not [name for name in layer.fields().names() if "fid" in name or "feature_id" in name]

    def test_areas_and_retired_ids_go_with_it(self, run, context, old):
        square = (
            f"POLYGON(({EAST} {NORTH + 60}, {EAST + 5} {NORTH + 60}, {EAST + 5} {NORTH + 65}, {EAST} {NORTH + 60}))"
        )
        areas = memory_layer(
            [square], kind="Polygon", columns="field=element_id:int8&field=class:string", rows=[(21, "island")]
        )
        retired = memory_layer([None], kind="None", columns="field=old_id:int8&field=element_id:int8", rows=[(5, 11)])
        new = memory_layer([track(90)])
        results = run(
            "mergelocalmaps", LOCAL_MAPS=[new], MAIN_MAP=old, MAIN_MAP_AREAS=areas, MAIN_MAP_ALIASES=retired, **ALL
        )
        assert [row["element_id"] for row in table(opened(results, "AREAS", context))] == [21]
        aliases = [(row["old_id"], row["element_id"]) for row in table(opened(results, "ID_ALIASES", context))]
        assert aliases == [(5, 11)]
        new_ids = {row["element_id"] for row in table(opened(results, "OUTPUT", context))} - {11, 12}
        assert not new_ids & {5, 21}
        assert len(new_ids) == 1


class TestNetwork:
    def test_shows_who_is_merged_with_whom(self, run, context):
        given = memory_layer([track(), track(0.2), track(50)])
        results = run("mergenetwork", LOCAL_MAPS=[given], OUTPUT="memory:", EDGES="memory:")
        observations = table(opened(results, "OUTPUT", context))
        assert len({row["component"] for row in observations}) == results["N_COMPONENTS"] == 2
        assert (results["N_OBSERVATIONS"], results["LARGEST_COMPONENT"]) == (3, 2)
        assert len(table(opened(results, "EDGES", context))) == 1

    def test_of_nothing_is_empty_layers_of_lines(self, run, context):
        results = run("mergenetwork", LOCAL_MAPS=[memory_layer([])], OUTPUT="memory:", EDGES="memory:")
        for name in ("OUTPUT", "EDGES"):
            layer = opened(results, name, context)
            assert (layer.featureCount(), layer.wkbType()) == (0, QgsWkbTypes.Type.LineString)


class TestEvaluation:
    def test_shows_the_error_along_the_map(self, run, context, tmp_path):
        merged, reference = memory_layer([track(0.5), track(90)]), memory_layer([track()])
        page = tmp_path / "page.html"
        wanted = dict.fromkeys(("OUTPUT", "EVALUATED", "MEASURES"), "memory:")
        results = run("evaluatemap", MERGED=[merged], REFERENCE=[reference], PAGE=str(page), **wanted)
        assert (results["N_ELEMENTS"], results["N_REFERENCE"]) == (2, 1)
        assert 0 < results["AVERAGE_PRECISION"] <= 1
        errors = table(opened(results, "OUTPUT", context))
        near = [row["error_m"] for row in errors if not row["beyond"]]
        assert near
        assert max(near) < 1.5
        assert any(row["beyond"] for row in errors)
        assert len(table(opened(results, "EVALUATED", context))) == 2
        measures = {row["measure"]: row["value"] for row in table(opened(results, "MEASURES", context))}
        assert measures["recall_1.0"] == pytest.approx(1)
        assert page.read_text(encoding="utf-8").startswith("<!doctype html>")
        assert results["PAGE"] == str(page)

    def test_counts_what_lies_in_the_region_only(self, run, context):
        merged, reference = memory_layer([track(0.5), track(90)]), memory_layer([track()])
        box = f"POLYGON(({EAST - 9} {NORTH - 9}, {EAST + 999} {NORTH - 9}, {EAST + 999} {NORTH + 40}, "
        region = memory_layer([box + f"{EAST - 9} {NORTH + 40}, {EAST - 9} {NORTH - 9}))"], kind="Polygon")
        results = run("evaluatemap", MERGED=[merged], REFERENCE=[reference], REGION=region, OUTPUT="memory:")
        assert not any(row["beyond"] for row in table(opened(results, "OUTPUT", context)))

    def test_of_observations_is_compared_with_them(self, run, context):
        roles = {"MERGED": 0.2, "REFERENCE": 0.0, "LOCAL_MAPS": 0.6}
        given = {role: [memory_layer([track(shift)])] for role, shift in roles.items()}
        results = run("evaluatemap", **given, OUTPUT="memory:", MEASURES="memory:")
        measures = {row["measure"]: row["value"] for row in table(opened(results, "MEASURES", context))}
        assert measures["frechet_after"] < measures["frechet_before"]

    def test_of_areas_puts_them_apart(self, run, context):
        square = "POLYGON(({0} {1}, {2} {1}, {2} {3}, {0} {3}, {0} {1}))".format(EAST, NORTH, EAST + 9, NORTH + 9)
        area = memory_layer([square], kind="Polygon")
        results = run("evaluatemap", MERGED=[area], REFERENCE=[area], OUTPUT="memory:", EVALUATED_AREAS="memory:")
        (row,) = table(opened(results, "EVALUATED_AREAS", context))
        assert row["iou"] == pytest.approx(1)

    @pytest.mark.parametrize(
        ("given", "words"),
        [
            ({"REFERENCE": lambda: [memory_layer([], kind="Point")]}, "holds points"),
            ({"REFERENCE": lambda: [memory_layer([])]}, "reference holds no line or polygon"),
            ({"REGION_FROM": lambda: "region"}, "region"),
        ],
        ids=["points", "an empty reference", "no region"],
    )
    def test_of_what_cannot_be_compared_is_a_sentence(self, run, given, words):
        layers = {"MERGED": [memory_layer([track()])], "REFERENCE": [memory_layer([track()])]}
        with pytest.raises(QgsProcessingException, match=words):
            run("evaluatemap", **{**layers, **{name: make() for name, make in given.items()}}, OUTPUT="memory:")


FILES = {"PREDICTIONS": str(SAMPLE / "predictions.json"), "POSES": str(SAMPLE / "poses.csv")}


class TestProjecting:
    def test_the_sample_becomes_local_maps_with_their_footprints(self, run, context):
        sinks = {"OUTPUT": "memory:", "INSTANCES": "memory:", "LEFT_OUT": "memory:"}
        results = run("projectlocalmaps", **FILES, CRS="EPSG:32617", **sinks)
        local = opened(results, "OUTPUT", context)
        assert local.featureCount() == results["N_OBSERVATIONS"] > 0
        assert opened(results, "INSTANCES", context).featureCount() == results["N_INSTANCES"] > 0
        assert opened(results, "LEFT_OUT", context).featureCount() == results["N_LEFT_OUT"]
        assert local.crs().authid() == "EPSG:32617"
        assert {row["drive"] for row in table(local)} == {"predictions"}

    def test_the_drive_can_be_named_and_the_crs_left_open(self, run, context):
        results = run("projectlocalmaps", **FILES, LOCAL_CRS=True, DRIVE="Monday", OUTPUT="memory:")
        local = opened(results, "OUTPUT", context)
        assert {row["drive"] for row in table(local)} == {"Monday"}
        assert local.crs().authid() == ""
        assert "INSTANCES" not in results

    def test_a_file_that_is_not_there_is_told_by_its_name(self, run):
        with pytest.raises(QgsProcessingException, match=r"/nowhere/p.json"):
            run(
                "projectlocalmaps",
                **{**FILES, "PREDICTIONS": "/nowhere/p.json"},
                CRS="EPSG:32617",
                OUTPUT="memory:",
            )


class TestFaults:
    def test_a_column_that_is_not_there_is_told_and_earlier_outputs_stay(self, run, tracks, feedback, tmp_path):
        file = tmp_path / "map.gpkg"
        file.write_bytes(b"an earlier result")
        with pytest.raises(QgsProcessingException) as told:
            run("mergelocalmaps", LOCAL_MAPS=[tracks], CLASS_FIELD="nope", OUTPUT=str(file))
        assert file.read_bytes() == b"an earlier result"
        assert "tracks" in str(told.value)
        assert "'nope'" in str(told.value)
        assert QgsProcessingUtils.tempFolder() not in " ".join([str(told.value), *feedback.everything])

    def test_strict_tells_the_feature_that_cannot_be_used(self, run):
        with pytest.raises(QgsProcessingException) as told:
            run(
                "mergelocalmaps",
                LOCAL_MAPS=[memory_layer([track(), None], name="holes")],
                STRICT=True,
                OUTPUT="memory:",
            )
        assert "holes" in str(told.value)
        assert QgsProcessingUtils.tempFolder() not in str(told.value)

    def test_a_report_in_a_folder_that_is_not_there_is_told_in_a_sentence(self, run, tracks, tmp_path):
        report = str(tmp_path / "no" / "report.json")
        with pytest.raises(QgsProcessingException) as told:
            run("mergelocalmaps", LOCAL_MAPS=[tracks], OUTPUT="memory:", REPORT=report)
        assert report in str(told.value)
        assert "Errno" not in str(told.value)

    def test_an_environment_without_the_libraries_is_told(self, run, tracks):
        environment.use_interpreter("/usr/bin/python3")
        with pytest.raises(QgsProcessingException, match=r"is not complete .*: run “Set up PolyMerge”"):
            run("mergelocalmaps", LOCAL_MAPS=[tracks], OUTPUT="memory:")


def children() -> list[str]:
    """Return the command lines of the workers that run as children of this process."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                parent = int((folder / "stat").read_text().rsplit(")", 1)[1].split()[1])
                command = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:
                continue
            if parent == os.getpid() and "polymerge_core" in command:
                found.append(command)
    return found


class Background:
    """A run as the desktop makes it: a task of the task manager, in a thread of its own."""

    def __init__(self, **parameters):
        self.parameters = parameters  # QGIS does not keep the layers in it alive
        self.context, self.feedback = QgsProcessingContext(), Recorder()
        self.context.setProject(QgsProject.instance())
        self.done: list[tuple[bool, dict]] = []
        self.finished_at = 0.0
        self.thread = None
        self.feedback.on_text = self.note
        algorithm = QgsApplication.processingRegistry().algorithmById("polymerge:mergelocalmaps").create()
        self.algorithm = algorithm
        self.task = QgsProcessingAlgRunnerTask(algorithm, parameters, self.context, self.feedback)
        self.task.executed.connect(self.executed)

    def note(self, _text):
        self.thread = threading.get_ident()

    def executed(self, fine, results):
        self.finished_at = time.monotonic()
        self.done.append((fine, results))

    def start(self):
        QgsApplication.taskManager().addTask(self.task)
        return self


def wait_for(condition, seconds=30):
    """Let QGIS work until something is so."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited too long"
        loop = QEventLoop()
        QTimer.singleShot(20, loop.quit)
        loop.exec()


def long_work():
    """Return a layer whose merge takes many seconds."""
    return memory_layer([track(0.001 * n, length=50) for n in range(3000)], name="long work")


class TestInTheBackground:
    def test_a_run_ends_with_styled_results_while_the_main_thread_stays_free(self, provider, context, tracks):
        beats = []
        timer = QTimer()
        timer.timeout.connect(lambda: beats.append(time.monotonic()))
        timer.start(50)
        destination = QgsProcessingOutputLayerDefinition("memory:", QgsProject.instance())
        run = Background(LOCAL_MAPS=[tracks], OUTPUT=destination, AREAS=destination, LINEAGE=destination).start()
        wait_for(lambda: run.done)
        timer.stop()
        ((fine, results),) = run.done
        assert fine
        assert results["N_ELEMENTS"] == 1
        assert run.thread != threading.get_ident()
        assert len(beats) > 5
        assert opened(results, "OUTPUT", run.context).featureCount() == 1
        loaded = run.context.layersToLoadOnCompletion()
        assert {details.name for details in loaded.values()} == {"Merged map", "Lineage"}
        assert all(details.postProcessor() is not None for details in loaded.values())

    def test_a_cancel_of_the_task_stops_the_worker_within_a_second_and_leaves_nothing(
        self, provider, context, tmp_path
    ):
        output = tmp_path / "map.gpkg"
        run = Background(LOCAL_MAPS=[long_work()], OUTPUT=str(output)).start()
        wait_for(lambda: any("reading" in text or "merg" in text for text in run.feedback.texts))
        assert len(children()) == 1
        cancelled_at = time.monotonic()
        run.task.cancel()
        wait_for(lambda: run.done)
        assert run.finished_at - cancelled_at < 1.5
        assert run.done[0][0] is False
        assert children() == []
        assert not output.exists()
        assert leftovers() == []

    def test_two_runs_at_once_do_not_disturb_each_other(self, provider, context):
        one = Background(LOCAL_MAPS=[memory_layer([track(), track(0.2)])], OUTPUT="memory:").start()
        two = Background(LOCAL_MAPS=[memory_layer([track(30), track(60), track(90)])], OUTPUT="memory:").start()
        most = []

        def both_done():
            most.append(len(children()))
            return one.done and two.done

        wait_for(both_done)
        assert [run.done[0][0] for run in (one, two)] == [True, True]
        assert [run.done[0][1]["N_ELEMENTS"] for run in (one, two)] == [1, 3]
        assert max(most) == 2


class TestCancelInTheForeground:
    def test_from_another_thread_stops_a_long_run_within_a_second(self, run, feedback, tmp_path):
        moments = []

        def cancel():
            moments.append(time.monotonic())
            feedback.cancel()

        feedback.on_text = lambda _text: threading.Timer(0.3, cancel).start() if not moments else None
        output = tmp_path / "map.gpkg"
        with pytest.raises(QgsProcessingException, match=r"^Cancelled; nothing was written.$"):
            run("mergelocalmaps", LOCAL_MAPS=[long_work()], OUTPUT=str(output))
        assert time.monotonic() - moments[0] < 1.5
        assert not output.exists()
        assert children() == []

    def test_before_the_start_does_nothing(self, run, feedback, tracks):
        feedback.cancel()
        with pytest.raises(QgsProcessingException, match="Cancelled"):
            run("mergelocalmaps", LOCAL_MAPS=[tracks], OUTPUT="memory:")
