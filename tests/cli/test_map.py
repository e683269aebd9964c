"""The commands of the stored map: what they write and print, their exit codes, and what they say of bad files."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import sqlite3

import geopandas as gpd
import numpy as np
import pytest
import shapely

import polymerge_core as pm
from polymerge_core.store.geopackage import connect
from polymerge_core.streaming import run_stream
from tests.cli.layers import EAST, NORTH, UTM, area, draw, line, look
from tests.core.layers import read_only

CRS = ("--crs", UTM)


def along(y, start=0, stop=100):
    return line(*((x, y) for x in range(start, stop + 1, 4)))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Three drives along one road."""
    folder = tmp_path_factory.mktemp("drives")
    return [
        draw(folder / f"{name}.gpkg", [along(y), along(10 + y)], instance=[0, 0], **{"class": ["divider", "boundary"]})
        for name, y in (("monday", 0.0), ("tuesday", 0.2), ("friday", 0.4))
    ]


@pytest.fixture(scope="module")
def made(tmp_path_factory, files):
    """A map of two revisions."""
    path = tmp_path_factory.mktemp("made") / "city.gpkg"
    store = pm.MapStore(path, create=True)
    for file in files[:2]:
        store.update(pm.read_local_maps([str(file)]))
    return path


@pytest.fixture
def city(made, tmp_path):
    """A copy of it."""
    return shutil.copy(made, tmp_path / "city.gpkg")


def message(number, *vectors, **changed):
    """A frame as a vehicle's pipeline sends it: it stands at x = 50 m of the road and looks east."""
    vectors = vectors or ([[-20, 0], [0, 0], [20, 0]],)
    pose = {"translation": [EAST + 50, NORTH, 0], "rotation": [1, 0, 0, 0]}
    frame = {"drive": "live", "instance": f"f{number}", "timestamp_ns": number * 10**9, "pose": pose}
    return frame | {"vectors": list(vectors), "labels": ["divider"] * len(vectors)} | changed


def lines_of(*messages):
    return "".join((each if isinstance(each, str) else json.dumps(each)) + "\n" for each in messages)


@pytest.fixture
def stream(run, monkeypatch):
    """Run a command that reads standard input."""

    def call(text, *arguments):
        monkeypatch.setattr("sys.stdin", io.StringIO(text))
        outcome = run(*arguments, "--stream")
        answers = [json.loads(each) for each in outcome.out.splitlines()]
        return outcome, answers

    return call


class TestUpdate:
    def test_makes_a_map(self, run, tmp_path, files):
        outcome = run("update", tmp_path / "city.gpkg", files[0], "--create")
        assert (outcome.code, outcome.out) == (0, "")
        assert outcome.err == (
            "2 observations of 1 local map; 2 elements (2 added, 0 changed, 0 moved, 0 retired, 0 merged) -> "
            f"{tmp_path / 'city.gpkg'}, revision 1\n"
        )
        elements = look(tmp_path / "city.gpkg", "elements")
        assert elements.crs == UTM
        assert sorted(elements["class"]) == ["boundary", "divider"]

    def test_goes_on_with_a_map(self, run, city, files):
        outcome = run("update", city, files[2])
        assert outcome.code == 0, outcome.err
        assert "revision 3" in outcome.err
        elements = look(city, "elements")
        assert elements["n_instances"].tolist() == [3, 3]
        assert elements["state"].tolist() == ["confirmed", "confirmed"]
        assert shapely.hausdorff_distance(elements.set_index("class").geometry["divider"], along(0.2)) < 0.05

    def test_takes_several_files_as_one_revision(self, run, tmp_path, files):
        outcome = run("update", tmp_path / "city.gpkg", *files, "--create")
        assert outcome.code == 0, outcome.err
        assert look(tmp_path / "city.gpkg", "elements")["n_instances"].tolist() == [3, 3]
        assert "revision 1" in outcome.err

    def test_warns_of_what_the_map_knows(self, run, city, files):
        before = city.read_bytes()
        outcome = run("update", city, files[0])
        assert outcome.code == 0
        assert outcome.warnings == ["warning: 1 local map was skipped: the map knows drive and instance already"]
        assert "revision 2" in outcome.err
        assert city.read_bytes() == before

    def test_creates_nothing_unless_told(self, run, tmp_path, files):
        outcome = run("update", tmp_path / "none.gpkg", files[0])
        assert outcome.code == 1
        (error,) = outcome.errors
        assert "none.gpkg does not exist" in error
        assert "--create" in error
        assert list(tmp_path.iterdir()) == []

    def test_create_goes_on_with_a_map_that_is_there(self, run, city, files):
        assert run("update", city, files[2], "--create", *CRS).code == 0
        assert len(pm.MapStore(city).history()) == 3

    def test_makes_a_map_in_the_crs_and_with_the_proximity_it_is_told(self, run, tmp_path, files):
        more = ("--crs", "EPSG:25832", "--proximity", "0.5", "--area", "island")
        assert run("update", tmp_path / "city.gpkg", files[0], "--create", *more).code == 0
        assert look(tmp_path / "city.gpkg", "elements").crs == "EPSG:25832"
        outcome = run("update", tmp_path / "city.gpkg", files[1], "--proximity", 2)
        assert outcome.code == 2
        assert "proximity of 0.5 m" in outcome.err

    def test_reads_layers_without_a_crs(self, run, tmp_path):
        for number in range(2):
            plain = draw(tmp_path / f"plain{number}.gpkg", [along(0)], crs=None)
            outcome = run("update", tmp_path / "city.gpkg", plain, "--create", *CRS)
            assert outcome.code == 0, outcome.err
        assert look(tmp_path / "city.gpkg", "elements")["n_instances"].tolist() == [2]

    def test_reports_as_json(self, run, tmp_path, files):
        outcome = run("update", tmp_path / "city.gpkg", files[0], "--create", "--json", "-")
        report = json.loads(outcome.out)
        assert (report["revision"], report["added"], report["instances"], report["left_out"]) == (1, 2, 1, {})

    def test_passes_on_how_layers_are_read(self, run, tmp_path):
        columns = {"kind": ["a", "b"], "p": [0.9, 0.2]}
        source = draw(tmp_path / "drive.gpkg", [along(0), along(10)], **columns)
        more = ("--class-field", "kind", "--score-field", "p", "--min-score", "0.5")
        assert run("update", tmp_path / "city.gpkg", source, "--create", *more).code == 0
        assert look(tmp_path / "city.gpkg", "elements")["class"].tolist() == ["a"]

    @pytest.mark.parametrize(
        ("arguments", "said"),
        [
            ([], "give local maps"),
            (["a.gpkg", "--stream"], "give local maps"),
            (["--stream", "--watch-stdin"], "--watch-stdin does not go with --stream"),
            (["--stream", "--draw-every", "0"], "--draw-every"),
            (["a.gpkg", "--crs", "EPSG:99999"], "99999"),
            (["a.gpkg", "--create", "--proximity", "-1"], "proximity cannot be -1"),
        ],
    )
    def test_says_what_is_wrong_with_its_options(self, run, tmp_path, arguments, said):
        outcome = run("update", tmp_path / "city.gpkg", *arguments)
        assert outcome.code == 2
        (error,) = outcome.errors
        assert said in error
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize("create", [[], ["--create"]])
    def test_with_a_bad_file_among_good_ones_changes_nothing(self, run, city, files, tmp_path, create):
        (tmp_path / "bad.gpkg").write_text("no layer")
        before = city.read_bytes()
        outcome = run("update", city, files[2], tmp_path / "bad.gpkg", *create)
        assert outcome.code == 1
        assert len(outcome.err.splitlines()) == 1
        assert "bad.gpkg" in outcome.errors[0]
        assert city.read_bytes() == before


class TestStream:
    def test_answers_each_frame_and_draws_the_map(self, stream, tmp_path):
        frames = lines_of(*(message(n) for n in range(3)))
        outcome, answers = stream(frames, "update", tmp_path / "city.gpkg", "--create", *CRS)
        assert outcome.code == 0, outcome.err
        assert [(each["drive"], each["instance"]) for each in answers] == [("live", f"f{n}") for n in range(3)]
        assert [each["revision"] for each in answers] == sorted({each["revision"] for each in answers})
        assert outcome.err.startswith("3 observations of 3 local maps; 1 element (")
        (element,) = look(tmp_path / "city.gpkg", "elements").itertuples()
        assert (element.n_instances, element.state) == (3, "confirmed")
        assert shapely.hausdorff_distance(element.geometry, along(0, 30, 70)) < 0.01
        assert pm.MapStore(tmp_path / "city.gpkg").verify() == []

    @pytest.mark.parametrize(
        ("bad", "said"),
        [
            ("not json", "JSON"),
            ("[1, 2]", "must be an object"),
            (message(9, colour="red"), "colour"),
            ({key: value for key, value in message(9).items() if key != "pose"}, "pose"),
            (message(9, labels=[]), "1 vectors, 0 labels"),
            (message(9, scores=[0.5, 0.5]), "2 scores"),
            (message(9, drive=True), "drive"),
            (message(9, footprint=[30, -15, -30, 15]), "xmin must be below xmax"),
            (message(9, footprint=[1, 2]), "footprint"),
            (message(9, vectors="road"), "vectors"),
            (message(9, [[0, 0], [1, "x"]]), "line 2"),
            (message(9, pose={"translation": [1, 2]}), "pose"),
            (message(9, pose={"translation": [1e12, 1e12, 0], "rotation": [1, 0, 0, 0]}), ""),
            (message(9, timestamp_ns="noon"), "timestamp"),
        ],
    )
    def test_answers_a_line_that_cannot_be_used_and_keeps_the_others(self, stream, tmp_path, bad, said):
        frames = lines_of(message(0), bad, message(1))
        outcome, answers = stream(frames, "update", tmp_path / "city.gpkg", "--create", *CRS)
        assert outcome.code == 1
        assert [answer.get("instance") for answer in answers] == ["f0", None, "f1"]
        assert answers[1].keys() == {"line", "error"}
        assert answers[1]["line"] == 2
        assert said in answers[1]["error"]
        # One line for the frame, what was done with the others, one for the run.
        assert len(outcome.err.splitlines()) == 3
        assert outcome.err.splitlines()[1].startswith("2 observations of 2 local maps; 1 element (")
        assert outcome.errors[1] == f"error: 1 line could not be used; all others are in {tmp_path / 'city.gpkg'}"
        assert look(tmp_path / "city.gpkg", "elements")["n_instances"].tolist() == [2]

    def test_numbers_lines_as_they_are_sent_empty_ones_too(self, stream, city):
        frames = lines_of(message(0), "", "no", "  ", message(1), "neither")
        outcome, answers = stream(frames, "update", city)
        assert [answer["line"] for answer in answers if "line" in answer] == [3, 6]
        assert outcome.errors[-1].startswith("error: 2 lines could not be used")

    def test_numbers_lines_rightly_where_they_come_slowly(self, city):
        def slowly():
            for number, text in enumerate(["no", json.dumps(message(0)), "neither"], 1):
                # The next line comes when the last one was answered: in between nothing waits.
                while len(answers) < number - 1:
                    pass
                yield text

        answers = []
        total = run_stream(pm.MapStore(city), slowly(), answers.append, draw_every=10)
        assert total["unusable_lines"] == 2
        assert [json.loads(each).get("line") for each in answers] == [1, None, 3]

    def test_draws_every_so_many_frames_and_at_the_end(self, city):
        drawn = []

        class Watched(pm.MapStore):
            def draw(self):
                drawn.append(len(answers))
                return super().draw()

        answers = []
        frames = [json.dumps(message(n)) for n in range(5)]
        total = run_stream(Watched(city), frames, answers.append, draw_every=2)
        # Where the reader is slower than the map there are more drawings than after two, four and five.
        assert max(np.diff([0, *drawn])) <= 2
        assert drawn[-1] == 5
        assert total["instances"] == 5
        assert total["elements"] == 2

    def test_of_a_frame_that_saw_nothing_is_answered_too(self, stream, tmp_path):
        nothing = message(0) | {"vectors": [], "labels": []}
        outcome, answers = stream(lines_of(nothing), "update", tmp_path / "city.gpkg", "--create", *CRS)
        assert outcome.code == 0, outcome.err
        assert answers[0]["instance"] == "f0"
        assert outcome.warnings == []

    def test_answers_a_frame_that_is_sent_again(self, stream, city):
        outcome, answers = stream(lines_of(message(0), message(0)), "update", city)
        assert outcome.code == 0
        assert [answer["instance"] for answer in answers] == ["f0", "f0"]
        assert [answer.get("known") for answer in answers] == [None, True]
        assert len(outcome.warnings) == 1
        assert "skipped" in outcome.warnings[0]

    def test_answers_what_of_a_frame_cannot_be_used(self, stream, city):
        lines = [[[-5, 0], [5, 0]], [[-5, 1], [5, 1]], [[0, 0]]]
        odd = message(0) | {"vectors": lines, "labels": ["divider"] * 3, "scores": [0.9, 93, 0.9]}
        outcome, answers = stream(lines_of(odd), "update", city)
        assert outcome.code == 0
        assert sum(answers[0]["left_out"].values()) == 2
        assert "2 left out" in outcome.err

    def test_is_strict_where_that_is_wanted(self, stream, city):
        odd = message(0) | {"vectors": [[[-5, 0], [5, 0]], [[0, 0]]], "labels": ["divider"] * 2}
        outcome, answers = stream(lines_of(odd, message(1)), "update", city, "--strict")
        assert outcome.code == 1
        assert [answer.keys() for answer in answers] == [{"line", "error"}, {"drive", "instance", "revision"}]

    def test_leaves_out_what_is_under_the_least_score(self, stream, city):
        _, answers = stream(lines_of(message(0, scores=[0.2])), "update", city, "--min-score", "0.5")
        assert answers[0]["left_out"] == {"the score is under min_score (0.5)": 1}

    def test_refuses_labels_that_are_numbers(self, stream, city):
        _, answers = stream(lines_of(message(0, labels=[1]), message(1)), "update", city)
        assert answers[0]["error"] == "line 1, label 0: 1 is no text; the labels of a frame are names of classes"

    def test_refuses_a_crs_that_is_not_the_maps(self, stream, city):
        before = city.read_bytes()
        outcome, answers = stream(lines_of(message(0)), "update", city, "--crs", "EPSG:25833")
        assert (outcome.code, answers) == (2, [])
        assert "leave crs away" in outcome.errors[0]
        assert city.read_bytes() == before

    def test_refuses_options_of_columns(self, stream, city):
        outcome, answers = stream(lines_of(message(0)), "update", city, "--class-field", "kind")
        assert (outcome.code, answers) == (2, [])
        assert "--class-field does not go with --stream" in outcome.errors[0]

    def test_reports_although_a_line_cannot_be_used(self, stream, city, tmp_path):
        outcome, _ = stream(lines_of(message(0), "no"), "update", city, "--json", tmp_path / "report.json")
        assert outcome.code == 1
        report = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
        assert (report["instances"], report["unusable_lines"]) == (1, 1)

    def test_makes_no_map_of_lines_that_cannot_be_used(self, stream, tmp_path):
        outcome, answers = stream(lines_of("no"), "update", tmp_path / "city.gpkg", "--create", *CRS)
        assert (outcome.code, len(answers)) == (1, 1)
        assert outcome.errors[-1].startswith("error: standard input held no line that could be used")
        assert list(tmp_path.iterdir()) == []

    def test_takes_matrices_scores_and_numbers_for_names(self, stream, city):
        pose = {"matrix": [[1, 0, 0, EAST + 50], [0, 1, 0, NORTH + 30], [0, 0, 1, 0], [0, 0, 0, 1]]}
        outcome, answers = stream(lines_of(message(0, pose=pose, scores=[0.5], instance=7)), "update", city)
        assert outcome.code == 0, outcome.err
        assert answers[0]["instance"] == "7"
        elements = look(city, "elements")
        assert elements["n_observations"].tolist() == [2, 2, 1]
        assert shapely.hausdorff_distance(elements.geometry.iloc[-1], along(30, 30, 70)) < 0.01

    def test_of_nothing_is_an_error(self, stream, city):
        outcome, answers = stream("\n\n", "update", city)
        assert (outcome.code, answers) == (1, [])
        assert "held no frames" in outcome.errors[0]

    def test_needs_a_crs_for_a_map_that_is_not_there(self, stream, tmp_path):
        outcome, _ = stream(lines_of(message(0)), "update", tmp_path / "city.gpkg", "--create")
        assert outcome.code == 1
        assert any("--crs" in error for error in outcome.errors)
        assert list(tmp_path.iterdir()) == []

    def test_runs_in_a_process_of_its_own(self, run_alone, city):
        outcome = run_alone("update", city, "--stream", input=lines_of(message(0), "no", message(1)))
        assert outcome.code == 1
        assert "Traceback" not in outcome.err
        assert [json.loads(each).get("line") for each in outcome.out.splitlines()] == [None, 2, None]
        assert len(look(city, "instances")) == 4


class TestHistory:
    def test_lists_the_revisions(self, run, made):
        outcome = run("history", made)
        assert (outcome.code, outcome.err) == (0, "")
        head, *rows = outcome.out.splitlines()
        assert head.split()[:3] == ["number", "time", "source"]
        assert [row.split()[0] for row in rows] == ["1", "2"]
        assert [row.split()[2] for row in rows] == ["monday", "tuesday"]

    def test_goes_to_a_file_or_to_standard_output_as_json(self, run, made, tmp_path):
        assert run("history", made, "--json", tmp_path / "history.json").out == ""
        printed = json.loads(run("history", made, "--json", "-").out)
        assert printed == json.loads((tmp_path / "history.json").read_text())
        assert [row["added"] for row in printed["revisions"]] == [2, 0]
        assert "shapely" in printed["revisions"][0]["software"]


class TestChanges:
    def test_are_written_as_layers(self, run, made, tmp_path):
        outcome = run("changes", made, "-o", tmp_path / "diff.gpkg")
        assert outcome.code == 0, outcome.err
        assert outcome.err == f"2 added -> {tmp_path / 'diff.gpkg'}\n"
        changes = look(tmp_path / "diff.gpkg", "changes")
        assert changes["kind"].tolist() == ["added", "added"]
        assert changes.crs == UTM
        assert len(look(tmp_path / "diff.gpkg", "moves")) == 0

    def test_count_from_a_revision_on(self, run, made, tmp_path):
        outcome = run("changes", made, "--since", 1, "-o", tmp_path / "diff.gpkg", "--json", "-")
        assert json.loads(outcome.out) == {"since": 1, "changes": {"changed": 2}}
        np.testing.assert_allclose(look(tmp_path / "diff.gpkg", "changes")["moved_m"], 0.1, atol=0.02)

    def test_may_be_none(self, run, made, tmp_path):
        outcome = run("changes", made, "--since", 2, "-o", tmp_path / "diff.gpkg")
        assert (outcome.code, outcome.err) == (0, f"no changes -> {tmp_path / 'diff.gpkg'}\n")

    def test_replace_a_file_only_if_told(self, run, made, tmp_path):
        (tmp_path / "diff.gpkg").write_text("old")
        assert run("changes", made, "-o", tmp_path / "diff.gpkg").code == 1
        assert (tmp_path / "diff.gpkg").read_text() == "old"
        assert run("changes", made, "-o", tmp_path / "diff.gpkg", "--overwrite").code == 0

    @pytest.mark.parametrize(("since", "code"), [("3", 2), ("-1", 2), ("x", 2)])
    def test_of_a_revision_that_is_not_there(self, run, made, tmp_path, since, code):
        outcome = run("changes", made, "--since", since, "-o", tmp_path / "diff.gpkg")
        assert outcome.code == code
        assert len(outcome.errors) == len(outcome.err.splitlines()) == 1
        assert list(tmp_path.iterdir()) == []


class TestUndo:
    def test_takes_back_what_came_with_a_revision(self, run, city):
        before = look(city, "elements")
        outcome = run("undo", city, "--revision", 2, "--json", "-")
        assert outcome.code == 0, outcome.err
        assert outcome.err.startswith("revision 2 taken back; 2 elements (")
        assert json.loads(outcome.out)["revision"] == 3
        assert before["n_instances"].max() == 2
        assert look(city, "elements")["n_instances"].tolist() == [1, 1]
        assert "undo of revision 2" in run("history", city).out
        told = json.loads(run("history", city, "--json", "-").out)["revisions"]
        assert [each["undone"] for each in told] == [None, 3, None]
        assert pm.MapStore(city).verify() == []

    def test_takes_back_several_at_once(self, run, city):
        outcome = run("undo", city, "--revision", 1, "--until", 2)
        assert outcome.code == 0, outcome.err
        assert outcome.err.startswith("revision 1 to 2 taken back; 0 elements (")

    @pytest.mark.parametrize(("revision", "said"), [(9, "no revision 9"), (2, "taken back already")])
    def test_refuses_what_cannot_be_taken_back(self, run, city, revision, said):
        run("undo", city, "--revision", 2)
        before = city.read_bytes()
        outcome = run("undo", city, "--revision", revision)
        assert outcome.code == 2
        assert said in outcome.errors[0]
        assert city.read_bytes() == before


class TestRestore:
    @pytest.mark.parametrize("name", ["old.gpkg", "old.geojson", "old.parquet", "old.fgb"])
    def test_writes_the_map_as_it_was(self, run, made, tmp_path, name):
        before = made.read_bytes()
        outcome = run("restore", made, "--revision", 1, "-o", tmp_path / name)
        assert outcome.code == 0, outcome.err
        assert outcome.err.startswith("2 elements of revision 1 -> ")
        elements = look(tmp_path / name).set_index("class").to_crs(UTM)
        assert shapely.hausdorff_distance(elements.geometry["divider"], along(0)) < 0.001
        assert elements["n_instances"].tolist() == [1, 1]
        assert made.read_bytes() == before

    def test_does_not_write_over_the_map(self, run, city):
        before = city.read_bytes()
        outcome = run("restore", city, "--revision", 1, "-o", city, "--overwrite")
        assert outcome.code != 0
        assert len(outcome.errors) == 1
        assert city.read_bytes() == before

    @pytest.mark.parametrize("revision", ["0", "3"])
    def test_of_a_revision_that_is_not_there(self, run, made, tmp_path, revision):
        outcome = run("restore", made, "--revision", revision, "-o", tmp_path / "old.gpkg")
        assert outcome.code == 2
        assert len(outcome.errors) == 1
        assert list(tmp_path.iterdir()) == []


class TestVerify:
    def test_says_that_a_map_is_whole(self, run, made):
        assert run("verify", made) == (0, "", f"{made} is whole\n")

    def test_says_what_is_wrong(self, run, city):
        with contextlib.closing(sqlite3.connect(city)) as connection, connection:
            connection.execute("DELETE FROM lineage WHERE fid = (SELECT MAX(fid) FROM lineage)")
        outcome = run("verify", city)
        assert outcome.code == 1
        (error,) = outcome.err.splitlines()
        assert error.startswith(f"error: {city} is damaged: ")
        assert "not covered exactly once" in error
        assert error.endswith("restore it from a copy")


def a_letter(path, _made):
    path.write_text("dear mayor\n" * 500)


def nothing(_path, _made):
    pass


def a_folder(path, _made):
    path.mkdir()


def another_geopackage(path, _made):
    draw(path, [along(0)])


def a_part(path, made):
    whole = made.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])


def the_head(path, made):
    path.write_bytes(made.read_bytes()[:5000])


def of_tomorrow(path, made):
    shutil.copy(made, path)
    with contextlib.closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("UPDATE map_settings SET value = '99' WHERE name = 'format'")


def without_settings(path, made):
    shutil.copy(made, path)
    with contextlib.closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("DELETE FROM map_settings")


BAD = {
    "something else": (a_letter, "is no GeoPackage"),
    "missing": (nothing, "does not exist"),
    "a folder": (a_folder, "is a folder"),
    "another GeoPackage": (another_geopackage, "is no stored map"),
    "half of a map": (a_part, "is damaged"),
    "the head of a map": (the_head, "is damaged"),
    "a map of a later version": (of_tomorrow, "later version of PolyMerge"),
    "a map without settings": (without_settings, "is damaged"),
}


COMMANDS = {
    "update": lambda path, files, out: ["update", path, files[2]],
    "history": lambda path, files, out: ["history", path],
    "changes": lambda path, files, out: ["changes", path, "-o", out],
    "restore": lambda path, files, out: ["restore", path, "--revision", 1, "-o", out],
    "verify": lambda path, files, out: ["verify", path],
}


class TestBadFiles:
    @pytest.mark.parametrize(("make", "said"), BAD.values(), ids=BAD)
    @pytest.mark.parametrize("command", COMMANDS)
    def test_are_told_on_one_line(self, run, tmp_path, made, files, command, make, said):
        path, out = tmp_path / "city.gpkg", tmp_path / "out.gpkg"
        make(path, made)
        before = path.read_bytes() if path.is_file() else None
        outcome = run(*COMMANDS[command](path, files, out))
        assert (outcome.code, outcome.out) == (1, "")
        (error,) = outcome.err.splitlines()
        assert error.startswith("error: ")
        assert str(path) in error
        assert said in error
        assert not out.exists()
        assert (path.read_bytes() if path.is_file() else None) == before

    def test_that_cannot_be_written(self, run, city, files, monkeypatch):
        # As of a file without permission, which root has all the same.
        monkeypatch.setattr("polymerge_core.store.map_file.connect", read_only)
        outcome = run("update", city, files[2])
        assert outcome.code == 1
        (error,) = outcome.errors
        assert "cannot be written; check the permissions" in error

    def test_that_cannot_be_written_may_be_read(self, run, city):
        city.chmod(0o444)
        assert run("history", city).code == 0
        assert run("verify", city).code == 0

    def test_in_a_folder_that_is_not_there(self, run, tmp_path, files):
        outcome = run("update", tmp_path / "no" / "city.gpkg", files[0], "--create")
        assert outcome.code == 1
        (error,) = outcome.err.splitlines()
        assert "check the folder" in error

    def test_that_another_program_writes(self, run, city, files, monkeypatch):
        monkeypatch.setattr("polymerge_core.store.map_file.connect", lambda path, _patience: connect(path, 0.01))
        with contextlib.closing(sqlite3.connect(city, isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            outcome = run("update", city, files[2])
        assert outcome.code == 1
        (error,) = outcome.errors
        assert "locked by another program" in error
        assert pm.MapStore(city).verify() == []


def test_a_map_is_read_by_merge_as_a_main_map(run, made, files, tmp_path):
    outcome = run("merge", files[2], "--main-map", f"{made}|layername=elements", "-o", tmp_path / "merged.gpkg")
    assert outcome.code == 0, outcome.err
    merged = gpd.read_file(tmp_path / "merged.gpkg", layer="elements")
    assert sorted(merged["element_id"]) == [1, 2]
    assert merged["n_instances"].tolist() == [3, 3]


def test_lines_and_polygons_of_a_map_are_written_apart(run, tmp_path):
    crossing = area((40, -5), (44, -5), (44, 5), (40, 5))
    seen = {"instance": [0], "drive": ["monday"]}
    local = draw(tmp_path / "monday.gpkg", [along(0)], layer="lines", **seen, **{"class": ["divider"]})
    draw(local, [crossing], layer="areas", **seen, **{"class": ["ped_crossing"]})
    city = tmp_path / "city.gpkg"
    assert run("update", city, local, "--create").code == 0
    old, changes = tmp_path / "old.gpkg", tmp_path / "changes.gpkg"
    assert run("restore", city, "--revision", 1, "-o", old).code == 0
    assert run("changes", city, "-o", changes).code == 0
    for file, name in ((old, "elements"), (changes, "changes")):
        assert look(file, name).geom_type.tolist() == ["LineString"]
        assert look(file, f"{name}_areas").geom_type.tolist() == ["Polygon"]
    assert run("verify", city).code == 0
