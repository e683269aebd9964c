"""The worker is on its own: what is meant for QGIS or lies about does not reach it, and nothing of it stays behind."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.cli.layers import UTM, draw, noisy_copies
from tests.qgis.process.comparing import assert_same_merge, command_line, destinations, table
from tests.qgis.process.running import Qgis

#: What the worker needs, and what QGIS itself can do without.
LIBRARIES = ("shapely", "pyproj", "geopandas", "pandas", "pyogrio", "click", "networkx")


@pytest.fixture(scope="module")
def roads(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Looks at one road, in a file without a CRS, as QGIS knows none when its PROJ is led astray."""
    return draw(tmp_path_factory.mktemp("roads") / "roads.shp", noisy_copies(4, 8), crs=None)


@pytest.fixture(scope="module")
def traps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with modules that fail when they are imported."""
    folder = tmp_path_factory.mktemp("traps")
    for name in LIBRARIES:
        (folder / f"{name}.py").write_text(f"raise ImportError('this is no {name}')", encoding="utf-8")
    return folder


@pytest.mark.parametrize(
    ("declared", "names"),
    [
        ({"CRS": UTM}, ["PYTHONPATH", "GDAL_DATA", "GDAL_DRIVER_PATH", "LD_LIBRARY_PATH"]),
        ({"LOCAL_CRS": 1}, ["PYTHONPATH", "GDAL_DATA", "PROJ_LIB", "PROJ_DATA"]),
    ],
    ids=["of Python and GDAL", "of PROJ, without which QGIS knows no CRS"],
)
def test_nonsense_in_the_variables_of_the_host_has_no_effect(
    qgis: Qgis,
    copied: Callable[[Qgis], Qgis],
    roads: Path,
    traps: Path,
    tmp_path: Path,
    declared: dict[str, object],
    names: list[str],
) -> None:
    mine, python, seen, expected = copied(qgis), tmp_path / "python", tmp_path / "seen", tmp_path / "expected.gpkg"
    python.write_text(f'#!/bin/sh\nenv > "{seen}"\nexec "{sys.executable}" "$@"\n', encoding="utf-8")
    python.chmod(0o755)
    mine.choose_interpreter(python)
    command_line("merge", roads, "--crs", declared.get("CRS", "local"), "-o", expected)
    nonsense = dict.fromkeys(names, str(traps))

    parameters = {"LOCAL_MAPS": roads, **declared, **destinations(tmp_path / "out")}
    done = mine.run("polymerge:mergelocalmaps", parameters, **nonsense)

    assert_same_merge(done.results, expected)
    arrived = dict(line.partition("=")[::2] for line in seen.read_text(encoding="utf-8").splitlines())
    assert arrived["PYTHONPATH"] == str(mine.plugin)
    assert str(traps) not in arrived.values()


def test_modules_in_the_current_folder_are_not_taken_for_libraries(
    qgis: Qgis, roads: Path, traps: Path, tmp_path: Path
) -> None:
    parameters = {"LOCAL_MAPS": roads, "CRS": UTM, "OUTPUT": tmp_path / "merged.gpkg"}

    done = qgis.run("polymerge:mergelocalmaps", parameters, cwd=traps)

    assert done.code == 0, done.err
    assert len(table(tmp_path / "merged.gpkg")) == 1


def test_files_may_be_named_from_the_current_folder(qgis: Qgis, sample_folder: Path, tmp_path: Path) -> None:
    files = {"PREDICTIONS": "predictions.json", "POSES": "poses.csv", "OUTPUT": tmp_path / "local.gpkg"}

    done = qgis.run("polymerge:projectlocalmaps", {**files, "CRS": UTM}, cwd=sample_folder)

    assert done.results["N_OBSERVATIONS"] == 197
    assert set(table(tmp_path / "local.gpkg")["drive"]) == {"predictions"}


@pytest.mark.parametrize(
    ("aggregate", "code"), [("first", 0), ("no such function", 1)], ids=["went well", "failed in the worker"]
)
def test_no_temporary_file_stays_when_a_run(qgis: Qgis, roads: Path, tmp_path: Path, aggregate: str, code: int) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    parameters = {"LOCAL_MAPS": roads, "CRS": UTM, "AGGREGATE": aggregate, "OUTPUT": tmp_path / "merged.gpkg"}

    done = qgis.run("polymerge:mergelocalmaps", parameters, TMPDIR=str(temporary))

    assert done.code == code, done.err
    assert [path for path in temporary.rglob("*") if "polymerge" in path.name or path.is_file()] == []
    assert {path.name for path in tmp_path.iterdir()} == ({"temporary", "merged.gpkg"} if code == 0 else {"temporary"})
