"""What the tests need of QGIS: the loaded plugin, a profile of its own, and a feedback that remembers."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from qgis.core import (
    QgsApplication,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProject,
    QgsSettings,
)
from qgis.PyQt.QtCore import QSettings

from qgis_plugin import classFactory, environment
from qgis_plugin.layout import ROOT

#: Names an interpreter that has the libraries of the core, where the checkout has no environment of its own.
INTERPRETER = "POLYMERGE_TEST_PYTHON"


class Recorder(QgsProcessingFeedback):
    """A feedback that remembers what it was told."""

    def __init__(self) -> None:
        super().__init__(False)
        self.texts: list[str] = []
        self.infos: list[str] = []
        self.console: list[str] = []
        self.warnings: list[str] = []
        self.errors: list[str] = []
        self.progresses: list[float] = []
        #: Called with each text of progress: for a test that wants to act in the middle of a run.
        self.on_text: Callable[[str], None] = lambda _text: None
        self.progressChanged.connect(self.progresses.append)

    @property
    def everything(self) -> list[str]:
        """All that a user could read."""
        return [*self.texts, *self.infos, *self.console, *self.warnings, *self.errors]

    def setProgressText(self, text):  # noqa: N802
        self.texts.append(text)
        self.on_text(text)

    def pushInfo(self, info):  # noqa: N802
        self.infos.append(info)

    def pushConsoleInfo(self, info):  # noqa: N802
        self.console.append(info)

    def pushWarning(self, warning):  # noqa: N802
        self.warnings.append(warning)

    def reportError(self, error, fatalError=False):  # noqa: N802
        self.errors.append(error)


@pytest.fixture(scope="session")
def own_settings(qgis_app, tmp_path_factory) -> None:
    """Keep settings apart from those of whoever tests, and from those of other processes that test."""
    folder = str(tmp_path_factory.mktemp("settings"))
    for kind in (QSettings.NativeFormat, QSettings.IniFormat):
        QSettings.setPath(kind, QSettings.UserScope, folder)


@pytest.fixture(scope="session")
def processing_plugin(own_settings) -> None:
    """Start QGIS's own Processing plugin, whose warnings are not ours."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from processing.core.Processing import Processing  # noqa: PLC0415 - it warns when it is imported

        Processing.initialize()


@pytest.fixture(autouse=True)
def own_profile(processing_plugin, monkeypatch, tmp_path) -> Iterator[Path]:
    """Give each test a place for environments of its own, and no setting of the one before."""
    setting = f"Processing/Configuration/{environment.SETTING}"
    home = tmp_path / "profile" / "polymerge"
    QgsSettings().remove(setting)
    with monkeypatch.context() as patch:
        patch.setattr(environment, "environments", lambda: home)
        yield home
    QgsSettings().remove(setting)


@pytest.fixture
def provider(own_profile):
    """Return the provider of the loaded plugin."""
    plugin = classFactory(None)
    plugin.initProcessing()
    yield QgsApplication.processingRegistry().providerById("polymerge")
    plugin.unload()


@pytest.fixture
def feedback() -> Recorder:
    return Recorder()


@pytest.fixture
def context() -> QgsProcessingContext:
    """Return a context with a project, as the toolbox makes it."""
    project = QgsProject.instance()
    project.clear()
    made = QgsProcessingContext()
    made.setProject(project)
    yield made
    project.clear()


@pytest.fixture(scope="session")
def interpreter() -> str:
    """Return a Python that has the libraries of the core."""
    own = ROOT / ".venv" / "bin" / "python"
    found = str(own) if own.exists() else os.environ.get(INTERPRETER, "")
    if not Path(found).is_file():
        pytest.fail(f"There is no Python with the core's libraries: make .venv/runtime, or name one in {INTERPRETER}.")
    return found


@pytest.fixture
def ready(provider, interpreter) -> str:
    """Have the worker run in that Python."""
    environment.use_interpreter(interpreter)
    return interpreter


@pytest.fixture
def script(tmp_path) -> Callable[..., str]:
    """Return a function that makes a program of lines of shell, to stand for a Python."""

    def make(text: str, name: str = "python") -> str:
        file = tmp_path / "programs" / name
        file.parent.mkdir(exist_ok=True)
        file.write_text(f"#!/bin/sh\n{text}\n")
        file.chmod(0o755)
        return str(file)

    return make


@pytest.fixture
def run(provider, context, feedback) -> Callable[..., dict[str, Any]]:
    """Return a function that runs an algorithm as QGIS does; what goes wrong is raised."""

    def go(name: str, **parameters: Any) -> dict[str, Any]:
        algorithm = QgsApplication.processingRegistry().algorithmById(f"polymerge:{name}")
        results, done = algorithm.run(parameters, context, feedback, {}, False)
        if not done:  # what goes wrong while it prepares is only said
            raise QgsProcessingException("\n".join(feedback.errors))
        return results

    return go
