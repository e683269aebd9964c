"""These tests need the Python of QGIS; elsewhere they do not exist, rather than being skipped."""

from __future__ import annotations

from importlib.util import find_spec

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
