"""These tests need the Python of QGIS; elsewhere they do not exist, rather than being skipped."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec

import pytest

if find_spec("qgis") is None or find_spec("pytest_qgis") is None:
    collect_ignore_glob = ["*.py"]
else:
    from .host import (  # noqa: F401 - fixtures
        context,
        feedback,
        interpreter,
        own_profile,
        processing_plugin,
        provider,
        ready,
        run,
        script,
    )


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
