"""The command line ``python -m polymerge_core``, run in a process of its own with progress and cancel."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from qgis.core import QgsProcessingException, QgsProcessingUtils

from .environment import EnvironmentMissing, worker_python
from .layout import ROOT
from .process import Ended, clean_environment, run_program
from .progress import Part
from .translation import tr

#: Last lines of what a worker said that was no message to a user: shown when it ends in an unforeseen way.
_LAST_WORDS = 3


@contextmanager
def workspace() -> Iterator[Path]:
    """Give a folder for the files that go to the worker and come back; it is gone afterwards."""
    folder = Path(tempfile.mkdtemp(prefix="polymerge_", dir=QgsProcessingUtils.tempFolder()))
    try:
        yield folder
    finally:
        # A file that a layer still holds open on Windows goes with QGIS's own temporary folder.
        shutil.rmtree(folder, ignore_errors=True)


def run_worker(command: str, arguments: Sequence[str], part: Part, *, shown_as: Mapping[str, str]) -> None:
    """Run one command of the command line.

    Parameters
    ----------
    command : str
        ``project``, ``merge`` or ``network``.
    arguments : sequence of str
        Its options and inputs.
    part : Part
        The part of the run that this is; its feedback gets messages and warnings, and tells of a cancel.
    shown_as : mapping of str to str
        What a message is to say in place of the paths of files that are gone when the user reads it.

    Raises
    ------
    QgsProcessingException
        If there is no environment, the worker reports an error, or the user cancels.
    """
    try:
        python = worker_python()
    except EnvironmentMissing as missing:
        raise QgsProcessingException(str(missing)) from missing
    listener = _Listener(part, shown_as)
    ended = run_program(
        python,
        ["-m", "polymerge_core", command, "--progress=json", "--watch-stdin", *arguments],
        environment=clean_environment(PYTHONPATH=str(ROOT)),
        feedback=part.feedback,
        on_line=listener.hear,
        folder=str(ROOT),  # an older Python looks for modules in the folder that it is started in
    )
    if part.feedback.isCanceled():  # Ctrl-C in a terminal may have reached the worker first
        raise QgsProcessingException(tr("Cancelled; nothing was written."))
    if not ended.well:
        raise QgsProcessingException(listener.error or _unforeseen(ended, python, listener.others))


class _Listener:
    """Passes the lines of the worker on to where QGIS shows them."""

    def __init__(self, part: Part, shown_as: Mapping[str, str]) -> None:
        self._part, self._feedback, self._shown_as = part, part.feedback, shown_as
        self._message = ""
        self.error = ""
        self.others: list[str] = []

    def hear(self, line: str) -> None:
        """Take one line of the worker."""
        if self._is_progress(line):
            return
        for path, title in self._shown_as.items():
            line = line.replace(path, title)
        kind, _, text = line.partition(": ")
        if self._feedback.isCanceled():
            return  # the user knows, and hears the end of it from us
        if kind == "error":
            self.error = text
        elif kind == "warning":
            self._feedback.pushWarning(text)
        else:
            self.others.append(line)
            self._feedback.pushInfo(line)

    def _is_progress(self, line: str) -> bool:
        if not line.startswith('{"fraction"'):
            return False
        try:
            news = json.loads(line)
        except ValueError:  # cut off by a crash
            return False
        self._part.reached(news["fraction"])
        if news["message"] != self._message:
            self._message = news["message"]
            self._feedback.setProgressText(self._message)
        return True


def _unforeseen(ended: Ended, python: str, said: Sequence[str]) -> str:
    if ended.not_started:
        return tr("{} cannot be started ({}): run “Set up PolyMerge”.").format(python, ended.not_started)
    last = said[-1] if said else ""
    if "ModuleNotFoundError" in last or "ImportError" in last:
        return tr("The Python environment of PolyMerge is not complete ({}): run “Set up PolyMerge”.").format(last)
    if ended.code is None:
        return tr("The worker was killed or crashed, perhaps for want of memory: merge the data in parts.")
    return tr("The worker ended with exit code {}: {}").format(ended.code, " | ".join(said[-_LAST_WORDS:]))
