"""Setting up: an environment of its own in the profile, from a folder of wheels, and what happens when it fails."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.cli.layers import draw, noisy_copies
from tests.qgis.process.comparing import assert_same_merge, command_line, destinations
from tests.qgis.process.running import PATIENCE_S, Qgis

ROOT = Path(__file__).parents[3]


@pytest.fixture
def earlier(fresh: Qgis, copied: Callable[[Qgis], Qgis]) -> Qgis:
    """A profile with an environment that works: one that has the libraries of these tests."""
    mine = copied(fresh)
    folder = mine.profile / "polymerge" / "environment_earlier"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    site_packages = folder / "lib" / f"python3.{sys.version_info.minor}" / "site-packages"
    (site_packages / "libraries.pth").write_text(sysconfig.get_path("purelib"), encoding="utf-8")
    requirements = (mine.plugin / "qgis_plugin" / "requirements.txt").read_text(encoding="utf-8").split()
    note = {"folder": folder.name, "requirements": requirements}
    (mine.profile / "polymerge" / "made.json").write_text(json.dumps(note), encoding="utf-8")
    return mine


def environments(qgis: Qgis) -> list[str]:
    """Names of the environments in a profile."""
    return sorted(path.name for path in (qgis.profile / "polymerge").glob("environment_*"))


def make_wheels(folder: Path) -> Path:
    """Fill a folder with wheels as the help says."""
    pip = [sys.executable, "-m", "pip", "download", "--quiet", "--only-binary=:all:", "-d", str(folder)]
    done = subprocess.run(
        [*pip, "-r", "qgis_plugin/requirements.txt"], capture_output=True, text=True, check=False, cwd=ROOT
    )
    if done.returncode != 0 and os.environ.get("POLYMERGE_QGIS") != "required":
        pytest.skip(f"there are no wheels to install from: {done.stderr.strip()}")
    assert done.returncode == 0, done.stderr
    return folder


def test_set_up_can_make_environments_offline_in_place_of_the_earlier_one(earlier: Qgis, tmp_path: Path) -> None:
    wheels = make_wheels(tmp_path / "wheels")

    made = earlier.run("polymerge:setup", {"PYTHON": sys.executable, "WHEELS": wheels}, PIP_INDEX_URL="http://nowhere")

    (only,) = environments(earlier)
    assert only != "environment_earlier"
    assert Path(made.results["INTERPRETER"]).is_relative_to(earlier.profile / "polymerge" / only)
    roads, expected = draw(tmp_path / "roads.shp", noisy_copies(4, 8)), tmp_path / "expected.gpkg"
    command_line("merge", roads, "-o", expected)
    assert_same_merge(earlier.merge(roads, **destinations(tmp_path / "out")).results, expected)


def test_an_environment_that_cannot_be_made_leaves_the_earlier_one_in_use(earlier: Qgis, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()

    failed = earlier.run("polymerge:setup", {"PYTHON": sys.executable, "WHEELS": empty})

    assert "cannot install the libraries" in failed.fault
    assert environments(earlier) == ["environment_earlier"]
    checked = earlier.run("polymerge:setup", {"CHECK_ONLY": 1})
    assert "environment_earlier" in checked.results["INTERPRETER"]


def test_a_cancelled_set_up_leaves_the_earlier_environment_in_use(earlier: Qgis) -> None:
    with earlier.start("polymerge:setup", {"PYTHON": sys.executable}) as process:
        until = time.monotonic() + PATIENCE_S
        while not mentioning("ensurepip", earlier) and time.monotonic() < until:
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=PATIENCE_S)
        running = mentioning("", earlier)

    assert process.returncode == 1
    assert "Cancelled; the environment is as it was before." in err
    assert environments(earlier) == ["environment_earlier"]
    assert running == []


def mentioning(word: str, qgis: Qgis) -> list[str]:
    """The command lines that name a file in the environments of a profile, and a word."""
    found = []
    for process in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            found.append(process.read_bytes().decode(errors="replace").replace("\0", " "))
    return [line for line in found if str(qgis.profile / "polymerge") in line and word in line]


def test_an_environment_of_another_version_of_the_plugin_is_not_used(earlier: Qgis, tmp_path: Path) -> None:
    with (earlier.plugin / "qgis_plugin" / "requirements.txt").open("a", encoding="utf-8") as requirements:
        requirements.write("rasterio>=1.4\n")

    done = earlier.merge(draw(tmp_path / "roads.shp", noisy_copies(2, 8)), OUTPUT=tmp_path / "merged.gpkg")

    assert "another version" in done.fault
    assert not (tmp_path / "merged.gpkg").exists()


def test_a_python_that_is_not_there_is_named(fresh: Qgis, copied: Callable[[Qgis], Qgis]) -> None:
    mine = copied(fresh)

    done = mine.run("polymerge:setup", {"PYTHON": "/no/such/python"})

    assert "/no/such/python" in done.fault
    assert environments(mine) == []
