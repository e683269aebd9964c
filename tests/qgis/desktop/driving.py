"""Driving the desktop from inside: waiting, dialogs that hold the caller, pictures, and what is written down.

Runs in the Python of QGIS; nothing of the library's environment is here.
"""

from __future__ import annotations

import json
import os
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from qgis.PyQt.QtCore import QEventLoop, Qt, QTimer
from qgis.PyQt.QtGui import QImage
from qgis.PyQt.QtWidgets import QApplication, QDialog, QMessageBox, QWidget

_GLANCE_MS = 20


class Record:
    """What was checked and what went wrong; it is in the file at any time, whatever becomes of QGIS."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._content: dict[str, list[Any]] = {"checks": [], "pictures": [], "errors": [], "steps": []}

    def check(self, name: str, passed: bool, saw: Any = "") -> None:
        """Write down whether something is as it should be, and what was seen."""
        self._add("checks", {"name": name, "passed": bool(passed), "saw": repr(saw)})

    def picture(self, name: str) -> None:
        """Write down that a picture was taken."""
        self._add("pictures", name)

    def step(self, name: str, seconds: float) -> None:
        """Write down that a step is over."""
        self._add("steps", f"{name}: {seconds:.1f} s")

    def error(self, text: str) -> None:
        """Write down what went wrong outside the checks."""
        self._add("errors", text)

    def _add(self, kind: str, entry: Any) -> None:
        self._content[kind].append(entry)
        self._path.write_text(json.dumps(self._content, indent=1), encoding="utf-8")


def wait_until(condition: Callable[[], Any], what: str, seconds: float = 30) -> None:
    """Let QGIS go on with its work until a condition holds.

    Raises
    ------
    TimeoutError
        If it takes too long.
    """
    loop, glance, patience = QEventLoop(), QTimer(), QTimer()
    glance.timeout.connect(loop.quit)
    glance.start(_GLANCE_MS)
    patience.setSingleShot(True)
    patience.start(int(seconds * 1000))
    while not condition():
        if not patience.isActive():
            raise TimeoutError(f"{what}: not within {seconds} s{_open_question()}")
        loop.exec()


def _open_dialogs() -> list[QDialog]:
    # Not `activeModalWidget`: the dialogs of algorithms are shown first, and then wait without being modal.
    return [each for each in QApplication.topLevelWidgets() if isinstance(each, QDialog) and each.isVisible()]


def _open_question() -> str:
    return "".join(f"; QGIS asks: {each.text()}" for each in _open_dialogs() if isinstance(each, QMessageBox))


def settle() -> None:
    """Let everything that is waiting to be laid out and drawn be so."""
    for _ in range(3):
        QApplication.processEvents(QEventLoop.ProcessEventsFlag.AllEvents)


def in_dialog(start: Callable[[], Any], use: Callable[[Any], None]) -> None:
    """Start something that opens a dialog and holds its caller, use the dialog, and close it.

    Parameters
    ----------
    start : callable
        Returns when the dialog is closed.
    use : callable
        Is given the dialog.
    """
    outcome: list[BaseException | None] = []
    # Looks for the dialog and does not wait for it: a dialog may let timers run while it is still being made.
    glance = QTimer()

    def attend() -> None:
        dialogs = _open_dialogs()
        if not dialogs:
            return
        glance.stop()
        try:
            use(dialogs[0])
            outcome.append(None)
        except BaseException as failure:  # noqa: BLE001 - raised again when the dialog is closed
            outcome.append(failure)
        finally:
            # A question that lies over the dialog has to go first.
            for each in sorted(_open_dialogs(), key=lambda each: not isinstance(each, QMessageBox)):
                each.close()

    glance.timeout.connect(attend)
    glance.start(_GLANCE_MS)
    start()
    glance.stop()
    if not outcome:
        raise LookupError("no dialog was opened")
    if outcome[0] is not None:
        raise outcome[0]


def save_picture(widget: QWidget, path: Path) -> None:
    """Save what a widget looks like, as a PNG of few colours."""
    settle()
    few = widget.grab().toImage().convertToFormat(QImage.Format.Format_Indexed8, Qt.ImageConversionFlag.ThresholdDither)
    if not few.save(str(path), "PNG", 0):
        raise OSError(f"{path} cannot be written")


def running(words: str) -> list[int]:
    """Return the processes that this one started whose command line has these words."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
        except (OSError, ValueError, IndexError):
            continue  # no process, or one that has just ended
        if parent == os.getpid() and words in command:
            found.append(int(entry.name))
    return found


def describe(failure: BaseException) -> str:
    """Return a failure with the way to it."""
    return "".join(traceback.format_exception(type(failure), failure, failure.__traceback__))
