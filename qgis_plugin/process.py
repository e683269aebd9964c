"""Running a program of its own: its lines as they come, and an end within a second when the user cancels."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from qgis.core import QgsFeedback
from qgis.PyQt.QtCore import QCoreApplication, QProcess, QProcessEnvironment

#: How often a cancel is looked for.
_GLANCE_MS = 100

#: How long a program that was asked to end may take before it is killed.
_PATIENCE_S = 0.7

#: What would lead another Python to the libraries of the one inside QGIS, or to the user's own.
_FOREIGN = (
    "PYTHON",
    "PYENV_",
    "VIRTUAL_ENV",
    "CONDA_",
    "PROJ_",
    "GDAL_",
    "OGR_",
    "GEOS_",
    "CPL_",
    "LD_LIBRARY_PATH",
    "LD_PRELOAD",
    "DYLD_",
    "QT_",
    "QML",
    "O4W_QT_",
    "PIP_USER",
    "PIP_TARGET",
    "PIP_PREFIX",
)


class Ended(NamedTuple):
    """How a program ended."""

    #: Exit code; a killed or crashed program has none.
    code: int | None
    #: Whether it was stopped because the user cancelled.
    cancelled: bool
    #: Why it could not be started; empty where it could.
    not_started: str = ""

    @property
    def well(self) -> bool:
        """Whether it did what it was asked to do."""
        return self.code == 0 and not self.cancelled


def clean_environment(**more: str) -> QProcessEnvironment:
    """Return the system's environment without what is meant for the Python, GDAL, PROJ and Qt of QGIS.

    Parameters
    ----------
    **more : str
        Variables to set.
    """
    environment = QProcessEnvironment.systemEnvironment()
    for name in environment.keys():  # noqa: SIM118 - not a dictionary
        if name.upper().startswith(_FOREIGN):
            environment.remove(name)
    environment.insert("PYTHONUTF8", "1")  # what it prints is read as UTF-8, whatever the system's code page
    environment.insert("PYTHONSAFEPATH", "1")  # nothing is imported from the folder that it is started in
    for name, value in more.items():
        environment.insert(name, value)
    return environment


def run_program(
    program: str,
    arguments: Sequence[str],
    *,
    environment: QProcessEnvironment,
    feedback: QgsFeedback,
    on_line: Callable[[str], None],
    folder: str = "",
    group: bool = False,
) -> Ended:
    """Run a program to its end, or until the user cancels.

    Its standard input stays open while it may run: a program that watches it ends by itself when the user cancels,
    or when QGIS is gone. One that has not ended 0.7 s later is killed.

    Parameters
    ----------
    program : str
        Path of the program.
    arguments : sequence of str
        Its arguments; no shell sees them.
    environment : QProcessEnvironment
        Its whole environment.
    feedback : QgsFeedback
        Asked ten times a second whether the user has cancelled.
    on_line : callable
        Called in this thread with each line of standard output and standard error.
    folder : str, optional
        The folder to run it in, QGIS's own by default.
    group : bool, default False
        Whether the program is a group of its own (see `own_group.py`), to be killed with all that it started.
    """
    process = QProcess()
    process.setWorkingDirectory(folder)
    process.setProcessEnvironment(environment)
    process.setProcessChannelMode(QProcess.ProcessChannelMode.MergedChannels)
    process.start(program, list(arguments))
    rest, give_up = b"", math.inf
    while process.state() != QProcess.ProcessState.NotRunning:
        # No QEventLoop: once QGIS is told to quit it returns at once, for ever, without looking at the process.
        process.waitForReadyRead(_GLANCE_MS)
        QCoreApplication.processEvents()
        rest = _pass_lines(rest + process.readAll().data(), on_line)
        if feedback.isCanceled() and give_up == math.inf:
            process.closeWriteChannel()
            give_up = time.monotonic() + _PATIENCE_S
        elif time.monotonic() > give_up:
            _kill(process, group=group)
    cancelled = give_up != math.inf
    _pass_lines(rest + process.readAll().data() + b"\n", on_line)
    if process.error() == QProcess.ProcessError.FailedToStart:
        return Ended(None, cancelled, process.errorString())
    crashed = process.exitStatus() != QProcess.ExitStatus.NormalExit
    return Ended(None if crashed else process.exitCode(), cancelled)


def _kill(process: QProcess, *, group: bool) -> None:
    leader = process.processId()
    if group and os.name == "posix" and leader > 0:  # it is 0 when it has ended by itself, and would mean our own group
        with contextlib.suppress(ProcessLookupError, PermissionError):  # not yet, or no longer, a group of its own
            os.killpg(leader, signal.SIGKILL)
    process.kill()


def _pass_lines(text: bytes, on_line: Callable[[str], None]) -> bytes:
    """Hand on the lines that are complete and return the rest."""
    *lines, rest = text.split(b"\n")
    for line in lines:
        readable = line.decode("utf-8", errors="replace").rstrip()
        if readable:
            on_line(readable)
    return rest
