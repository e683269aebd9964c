"""Running the real `qgis_process` with a profile that holds the plugin, as a user's does, and nothing else."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import zipfile
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from qgis_plugin import package

#: A run that goes on, killed when its context is left.
Started = AbstractContextManager[subprocess.Popen[str]]

#: A run that hangs must end; making an environment takes a minute and a half on a busy machine.
PATIENCE_S = 400

#: What would tell QGIS of another profile, another screen, or another Python than a user has.
_FOREIGN = ("COV", "DISPLAY", "PYTEST", "PYTHON", "QGIS_", "QT_", "VIRTUAL_ENV", "WAYLAND_DISPLAY", "XDG_")

#: Lines that QGIS, its own plugins and GDAL write beside what is the matter, and its heading over it.
_NOISE = (
    "<string>:1: DeprecationWarning",
    "Warning 1: ",
    "ERROR 4: ",
    "Caught signal: ",
    "ERROR:\tAn error was encountered while checking parameter values",
)


def program() -> str | None:
    """The real program, as Debian's wrapper around it hands it an option that it does not know; None if not there."""
    return shutil.which("/usr/bin/qgis_process.bin") or shutil.which("qgis_process")


def qgis_python() -> str:
    """The interpreter that has QGIS's modules."""
    return os.environ.get("QGIS_PYTHON", "/usr/bin/python3")


class Outcome(NamedTuple):
    """What a run of `qgis_process` leaves."""

    code: int
    out: str
    err: str

    @property
    def answer(self) -> dict[str, Any]:
        """All that it answered in JSON."""
        return json.loads(self.out)

    @property
    def results(self) -> dict[str, Any]:
        """The outputs; a run that failed has none."""
        assert self.code == 0, self.err
        return self.answer["results"]

    @property
    def messages(self) -> list[str]:
        """The messages of a run that went well, in the order of their kinds."""
        assert self.code == 0, self.err
        return [text for kind in self.answer.get("log", {}).values() for text in kind]

    @property
    def fault(self) -> str:
        """The sentence of a run that failed; it must be the only one."""
        assert self.code == 1, f"exit code {self.code}: {self.out} {self.err}"
        assert self.out.strip() == ""
        said = {text.strip() for text in self.err.splitlines() if text.strip() and not text.startswith(_NOISE)}
        assert len(said) == 1, self.err
        return said.pop()


class Qgis:
    """A home folder whose QGIS profile has the plugin.

    Parameters
    ----------
    home : Path
        The home folder.
    """

    def __init__(self, home: Path) -> None:
        self.home = home

    @property
    def profile(self) -> Path:
        """The folder of the profile."""
        return self.home / ".local" / "share" / "QGIS" / "QGIS3" / "profiles" / "default"

    @property
    def plugin(self) -> Path:
        """The plugin in it."""
        return self.profile / "python" / "plugins" / package.PLUGIN

    def install(self, archive: Path) -> None:
        """Unpack the zip into the empty profile, and switch the plugin on."""
        (self.home / "run").mkdir(parents=True, mode=0o700)
        self.plugin.parent.mkdir(parents=True)
        with zipfile.ZipFile(archive) as plugin:
            plugin.extractall(self.plugin.parent)
        done = self.call("plugins", "enable", package.PLUGIN)
        assert done.code == 0, done.err

    def choose_interpreter(self, python: Path) -> None:
        """Write the Processing option that names the worker's Python, as the desktop does."""
        settings = self.profile / "QGIS" / "QGIS3.ini"
        kept = settings.read_text(encoding="utf-8")
        settings.write_text(f"{kept}\n[Processing]\nConfiguration\\POLYMERGE_PYTHON={python}\n", encoding="utf-8")

    def copy(self, home: Path) -> Qgis:
        """Return the same in another folder."""
        shutil.copytree(self.home, home, symlinks=True)
        return Qgis(home)

    def environment(self, **more: str) -> dict[str, str]:
        """Return the environment to run in."""
        kept = {name: value for name, value in os.environ.items() if not name.startswith(_FOREIGN)}
        own = {"HOME": str(self.home), "XDG_RUNTIME_DIR": str(self.home / "run"), "QT_QPA_PLATFORM": "offscreen"}
        return {**kept, **own, "LC_ALL": "C.UTF-8", **more}

    def call(self, *arguments: str, cwd: Path | None = None, **more: str) -> Outcome:
        """Run it with any arguments, in a folder, with variables of the environment."""
        with self.started(*arguments, cwd=cwd, **more) as process:
            out, err = process.communicate(timeout=PATIENCE_S)
        return Outcome(process.returncode, out, err)

    def run(self, algorithm: str, parameters: dict[str, Any], **more: Any) -> Outcome:
        """Run an algorithm with parameters, several values for one in a list."""
        return self.call(*_command(algorithm, parameters), **more)

    def merge(self, *layers: object, **parameters: Any) -> Outcome:
        """Run a merge."""
        return self.run("polymerge:mergelocalmaps", {"LOCAL_MAPS": list(layers), **parameters})

    def start(self, algorithm: str, parameters: dict[str, Any], **more: Any) -> Started:
        """Start an algorithm that is not waited for; leaving the context kills it."""
        return self.started(*_command(algorithm, parameters), **more)

    @contextmanager
    def started(self, *arguments: str, cwd: Path | None = None, **more: str) -> Iterator[subprocess.Popen[str]]:
        """Start it, and see to it that it has ended afterwards."""
        with subprocess.Popen(
            [str(program()), *arguments],
            # Not where the tests are run: the library lies there, too, and the plugin must not find that one.
            cwd=cwd or self.home,
            env=self.environment(**more),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            start_new_session=True,  # as in a terminal of its own
        ) as process:
            try:
                yield process
            finally:
                process.kill()


def _command(algorithm: str, parameters: dict[str, Any]) -> list[str]:
    several = {name: value if isinstance(value, list) else [value] for name, value in parameters.items()}
    given = [f"--{name}={value}" for name, values in several.items() for value in values]
    return ["--json", "run", algorithm, *given]
