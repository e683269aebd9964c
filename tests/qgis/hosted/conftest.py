"""These tests need the Python of QGIS; elsewhere they do not exist, rather than being skipped."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from importlib.util import find_spec

import pytest

_HERE = find_spec("qgis") is not None and find_spec("pytest_qgis") is not None
if not _HERE:
    collect_ignore_glob = ["*.py"]


@pytest.hookimpl(trylast=True)
def pytest_sessionstart(session: pytest.Session) -> None:
    """Have the fixtures where tests run: the process that only hands tests out to others has no QGIS."""
    config = session.config
    hands_out = config.getoption("dist", "no") != "no" and not hasattr(config, "workerinput")
    if _HERE and not hands_out:
        config.pluginmanager.register(import_module(".host", __package__))


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """Keep how the tests ended, for the end of the process."""
    session.config.stash[_STATUS] = int(exitstatus)


@pytest.hookimpl(tryfirst=True)
def pytest_unconfigure(config: pytest.Config) -> None:
    """Leave without freeing what is left: a layer that outlives a QGIS hosted by Python crashes it (not QGIS itself).

    That QGIS's own programs end well with the plugin is tested in `process` and `desktop`.
    """
    if _STATUS in config.stash:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(config.stash[_STATUS])


_STATUS = pytest.StashKey[int]()
