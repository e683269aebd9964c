"""What goes wrong ends in one sentence and exit code 1, and an output of an earlier run stays as it was."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from shapely import Point

from tests.cli.layers import UTM, area, draw, line
from tests.qgis.process.comparing import PARTS, destinations, table
from tests.qgis.process.running import Qgis

OLD = b"the map of last year"
SET_UP = "run “Set up PolyMerge”"


@pytest.fixture(scope="module")
def layers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Layers that are well, and layers that are not."""
    folder = tmp_path_factory.mktemp("layers")
    roads = [line((0, 0), (30, 0)), line((0, 0.5), (30, 0.5))]
    return {
        "roads": draw(folder / "roads.gpkg", roads, street=["a", "b"]),
        "nowhere": draw(folder / "nowhere.shp", roads, crs=None),
        "points": draw(folder / "points.gpkg", [Point(0, 0)]),
        "area": draw(folder / "area.gpkg", [area((0, 0), (4, 0), (4, 4))]),
    }


def assert_fails(qgis: Qgis, tmp_path: Path, *words: str, **parameters: Any) -> None:
    """Run a merge over an earlier result, and look at what it says and leaves."""
    output = tmp_path / "map.gpkg"
    output.write_bytes(OLD)

    done = qgis.run("polymerge:mergelocalmaps", {"OUTPUT": output, **parameters})

    assert [word for word in words if word not in done.fault] == [], done.fault
    assert "Traceback" not in done.fault
    assert {path.name: path.read_bytes() for path in tmp_path.glob("map*")} == {"map.gpkg": OLD}


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"LOCAL_MAPS": "roads", "CLASS_FIELD": "kind"}, ["roads", "kind", "street"]),
        ({"LOCAL_MAPS": "roads", "PROXIMITY": 5000}, ["PROXIMITY"]),
        ({"LOCAL_MAPS": "roads", "AGGREGATE": "median"}, ["median", "mean"]),
        ({"LOCAL_MAPS": "roads", "AGGREGATE": "width=mean"}, ["width"]),
        ({"LOCAL_MAPS": "nowhere"}, ["“nowhere”", "no CRS", "LOCAL_CRS"]),
        ({"LOCAL_MAPS": "nowhere", "CRS": UTM, "LOCAL_CRS": 1}, ["CRS or LOCAL_CRS, not both"]),
        ({"LOCAL_MAPS": "points"}, ["“points”", "choose layers of lines or polygons"]),
        ({"LOCAL_MAPS": "roads", "MAIN_MAP_AREAS": "area"}, ["no main map"]),
    ],
    ids=[
        "a column that is not there",
        "a proximity of kilometres",
        "an unknown aggregate",
        "an aggregate of a column that is not there",
        "no CRS",
        "two CRSs for layers without one",
        "points",
        "areas of no main map",
    ],
)
def test_a_merge_cannot_be_asked_for(
    qgis: Qgis, layers: dict[str, Path], tmp_path: Path, given: dict[str, Any], words: list[str]
) -> None:
    parameters = {name: layers.get(value, value) for name, value in given.items()}
    assert_fails(qgis, tmp_path, *words, **parameters)


def test_outputs_cannot_be_the_layer_that_is_read_or_each_other(
    qgis: Qgis, layers: dict[str, Path], tmp_path: Path
) -> None:
    roads, before = layers["roads"], layers["roads"].read_bytes()

    over_the_input = qgis.merge(f"{roads}|layername=roads", OUTPUT=roads)

    assert "roads.gpkg: choose another file" in over_the_input.fault
    assert roads.read_bytes() == before
    assert_fails(qgis, tmp_path, "map.gpkg: choose another file", LOCAL_MAPS=roads, LINEAGE=tmp_path / "map.gpkg")


def test_predictions_that_are_not_there_are_named(qgis: Qgis, sample_folder: Path, tmp_path: Path) -> None:
    output = tmp_path / "local.gpkg"
    output.write_bytes(OLD)
    files = {"PREDICTIONS": tmp_path / "gone.json", "POSES": sample_folder / "poses.csv"}

    done = qgis.run("polymerge:projectlocalmaps", {**files, "CRS": UTM, "OUTPUT": output})

    assert "gone.json" in done.fault
    assert output.read_bytes() == OLD


def test_without_an_environment_a_merge_and_a_check_say_what_to_do(
    fresh: Qgis, layers: dict[str, Path], tmp_path: Path
) -> None:
    assert_fails(fresh, tmp_path, "no Python environment", SET_UP, LOCAL_MAPS=layers["roads"])

    checked = fresh.run("polymerge:setup", {"CHECK_ONLY": 1})

    assert SET_UP in checked.fault


def test_an_interpreter_that_was_removed_is_named(
    fresh: Qgis, copied: Callable[[Qgis], Qgis], layers: dict[str, Path], tmp_path: Path
) -> None:
    mine, python = copied(fresh), tmp_path / "python"
    python.symlink_to(shutil.which("true"))
    mine.choose_interpreter(python)
    python.unlink()

    assert_fails(mine, tmp_path, str(python), "is not there", SET_UP, LOCAL_MAPS=layers["roads"])


def test_an_interpreter_without_the_libraries_is_refused_and_where_it_is_set_the_merge_says_what_to_do(
    fresh: Qgis, copied: Callable[[Qgis], Qgis], layers: dict[str, Path], tmp_path: Path
) -> None:
    mine, python = copied(fresh), tmp_path / "bare" / "bin" / "python"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "bare"], check=True)

    refused = mine.run("polymerge:setup", {"PYTHON": python, "USE_AS_IS": 1})
    mine.choose_interpreter(python)

    assert [word for word in (str(python), "geopandas is missing") if word not in refused.fault] == []
    assert_fails(mine, tmp_path, "not complete", SET_UP, LOCAL_MAPS=layers["roads"])


def test_a_program_that_cannot_be_started_is_named(
    fresh: Qgis, copied: Callable[[Qgis], Qgis], layers: dict[str, Path], tmp_path: Path
) -> None:
    mine, python = copied(fresh), tmp_path / "python"
    python.write_bytes(b"\x7fELF of another machine")
    python.chmod(0o755)
    mine.choose_interpreter(python)

    assert_fails(mine, tmp_path, str(python), "cannot be started", SET_UP, LOCAL_MAPS=layers["roads"])


def test_an_output_that_cannot_be_written_is_named(qgis: Qgis, layers: dict[str, Path], tmp_path: Path) -> None:
    done = qgis.merge(layers["roads"], OUTPUT=tmp_path / "no such folder" / "map.gpkg")

    assert "no such folder" in done.fault
    assert list(tmp_path.iterdir()) == []


def test_an_empty_layer_gives_empty_results_and_a_warning(qgis: Qgis, tmp_path: Path) -> None:
    empty = draw(tmp_path / "empty.shp", [line((0, 0), (1, 0))])
    frame = table(empty)
    frame.iloc[:0].to_file(empty, engine="pyogrio", geometry_type="LineString")

    done = qgis.merge(empty, **destinations(tmp_path / "out"))

    assert {part: len(table(done.results[part])) for part in PARTS} == dict.fromkeys(PARTS, 0)
    assert table(done.results["OUTPUT"]).crs == UTM
    assert list(table(done.results["OUTPUT"]).columns)[:2] == ["element_id", "class"]
    assert done.results["N_ELEMENTS"] == 0
    assert len([text for text in done.messages if "empty" in text]) == 1
