"""Starts the desktop of QGIS on a screen of its own, with the plugin in an empty profile, and runs the session in it.

`python -m tests.qgis.desktop.desktop FOLDER` does so for the pictures of the documentation, which go to the folder.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from qgis_plugin import package

HERE = Path(__file__).parent
SCREEN = "1400x900x24"

#: The session takes about a minute; a desktop that asks something nobody answers would take for ever.
LONGEST_S = 150

#: No questions, no news, no network, and the same language and size everywhere.
SETTINGS = r"""
[PythonPlugins]
processing=true
polymerge=true

[app]
askToSaveMemoryLayers=false
projections\promptWhenMultipleTransformsExist=false

[core]
NewsFeed\httpsfeedqgisorg\disabled=true

[locale]
overrideFlag=true
userLocale=en_US

[migration]
firstRunVersionFlag=32200
settings=true

[plugins]
automatically-check-for-updates=false

[qgis]
askToSaveProjectChanges=false
checkVersion=false
enableMacros=Never
hideSplash=true
projOpenAtLaunch=3
showTips=false

[Processing]
Configuration\POLYMERGE_PYTHON={python}
"""


_CRASH = re.compile(r"died on signal|Segmentation fault|Aborted|Traceback")


class Ended(NamedTuple):
    """How a session ended."""

    #: Exit code of QGIS; None where it had to be killed.
    code: int | None
    #: What the session wrote down: `checks`, `pictures`, `errors`, `steps`.
    record: dict[str, list[Any]]
    #: What QGIS printed.
    output: str

    def faults(self) -> list[str]:
        """Return what was not as it should be."""
        checks = self.record.get("checks", [])
        found = [f"not so: {check['name']}; seen: {check['saw']}" for check in checks if not check["passed"]]
        found += self.record.get("errors", [])
        if self.code != 0 or _CRASH.search(self.output):
            steps = ", ".join(self.record.get("steps", []))
            found.append(f"QGIS ended with {self.code} after the steps {steps}; it said: {self.output}")
        return found


def missing() -> str:
    """Say what of QGIS and Xvfb is not installed; empty where all is there."""
    programs = {"QGIS": _qgis(), "Xvfb": shutil.which("Xvfb")}
    return ", ".join(name for name, path in programs.items() if not path)


def run_session(folder: Path, pictures: Path, python: str = sys.executable) -> Ended:
    """Run the session in the desktop of QGIS.

    Parameters
    ----------
    folder : Path
        An empty folder for the profile and all files.
    pictures : Path
        The folder that the pictures go to.
    python : str
        The Python that the plugin's worker is to run in.
    """
    home, record = folder / "home", folder / "record.json"
    _make_profile(home / ".local/share/QGIS/QGIS3/profiles/default", folder, python)
    for name in ("run", "data", "tmp"):
        (folder / name).mkdir(mode=0o700)
    orders = {"record": str(record), "pictures": str(pictures), "data": str(folder / "data"), "python": python}
    environment = {
        **{name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "QT_", "QGIS_"))},
        "HOME": str(home),
        "XDG_RUNTIME_DIR": str(folder / "run"),
        "TMPDIR": str(folder / "tmp"),
        "LC_ALL": "C.UTF-8",
        "QT_QPA_PLATFORM": "xcb",
        "PYTHONPATH": str(HERE),
        "PYTHONDONTWRITEBYTECODE": "1",
        "POLYMERGE_SESSION": json.dumps(orders),
    }
    output = folder / "output.txt"
    with _screen() as display, output.open("wb") as file:
        code = _run(
            [_qgis(), "--nologo", "--noversioncheck", "--code", str(HERE / "start.py")],
            {**environment, "DISPLAY": display},
            file,
        )
    found = json.loads(record.read_text(encoding="utf-8")) if record.exists() else {}
    return Ended(code, found, output.read_text(encoding="utf-8", errors="replace"))


def _qgis() -> str:
    # Debian's `qgis` is a script that adds options; what it starts is beside it.
    return shutil.which("qgis.bin") or shutil.which("qgis") or ""


def _make_profile(profile: Path, folder: Path, python: str) -> None:
    plugins = profile / "python" / "plugins"
    plugins.mkdir(parents=True)
    archive = folder / "polymerge.zip"
    package.write(archive, package.contents(package.ROOT))
    with zipfile.ZipFile(archive) as packed:
        packed.extractall(plugins)
    settings = profile / "QGIS" / "QGIS3.ini"
    settings.parent.mkdir()
    settings.write_text(SETTINGS.replace("{python}", python), encoding="utf-8")


@contextmanager
def _screen() -> Iterator[str]:
    """Start a screen that nobody sees, and give its name."""
    reading, writing = os.pipe()
    screen = subprocess.Popen(
        [shutil.which("Xvfb") or "Xvfb", "-displayfd", str(writing), "-screen", "0", SCREEN, "-nolisten", "tcp"],
        pass_fds=[writing],
        stderr=subprocess.DEVNULL,
    )
    os.close(writing)
    try:
        with os.fdopen(reading) as answer:
            number = answer.readline().strip()
        if not number:
            raise RuntimeError("Xvfb ended before it had a screen")
        yield f":{number}"
    finally:
        screen.terminate()
        screen.wait()


def _run(command: list[str], environment: dict[str, str], output: Any) -> int | None:
    """Run a program; None where it took too long, and was killed with all that it had started."""
    # A session of its own, so that the worker of a desktop that hangs is killed with it.
    process = subprocess.Popen(
        command, env=environment, stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
    )
    try:
        return process.wait(LONGEST_S)
    except subprocess.TimeoutExpired:
        return None
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def main(arguments: list[str] | None = None) -> int:
    """Make the pictures; return the exit status."""
    parser = argparse.ArgumentParser(description="Make the pictures of the plugin's user guide.")
    parser.add_argument("folder", type=Path, help="where they go")
    pictures: Path = parser.parse_args(arguments).folder
    with tempfile.TemporaryDirectory(prefix="polymerge-") as folder:
        ended = run_session(Path(folder), pictures.resolve())
    wrong = ended.faults()
    sys.stderr.write("".join(f"{each}\n" for each in wrong))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
