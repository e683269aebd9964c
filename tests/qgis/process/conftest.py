"""A QGIS profile with the plugin, made once by each worker of pytest, and the worker's Python set up in it."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from qgis_plugin import package
from tests.qgis.process.running import Qgis, program


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run what installs half a gigabyte first, so that other workers have something to do meanwhile."""
    items.sort(key=lambda item: "can_make_environments" not in item.name)


@pytest.fixture(scope="session")
def fresh(tmp_path_factory: pytest.TempPathFactory) -> Qgis:
    """A profile as it is after the zip was installed, before anything was set up. Copy it to change it."""
    if program() is None:
        why = "there is no qgis_process (Debian: apt-get install qgis python3-qgis)"
        if os.environ.get("POLYMERGE_QGIS") == "required":
            pytest.fail(why)
        pytest.skip(why)
    folder = tmp_path_factory.mktemp("qgis")
    archive = folder / "polymerge.zip"
    assert package.main(["-o", str(archive)]) == 0
    qgis = Qgis(folder / "home")
    qgis.install(archive)
    return qgis


@pytest.fixture(scope="session")
def qgis(fresh: Qgis, tmp_path_factory: pytest.TempPathFactory) -> Qgis:
    """A profile in which PolyMerge is set up with the Python of these tests. Copy it to change it."""
    ready = fresh.copy(tmp_path_factory.mktemp("ready") / "home")
    done = ready.run("polymerge:setup", {"PYTHON": sys.executable, "USE_AS_IS": 1})
    assert done.results == {"INTERPRETER": sys.executable}
    return ready


@pytest.fixture
def copied(tmp_path: Path) -> Callable[[Qgis], Qgis]:
    """Copy a profile, so that a test may change its settings."""
    return lambda qgis: qgis.copy(tmp_path / "home")
