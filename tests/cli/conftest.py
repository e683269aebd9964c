"""Running the command line: in this process for speed, in one of its own where signals and bytes matter."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from typing import NamedTuple

import pytest

from polymerge_core.__main__ import main


class Outcome(NamedTuple):
    """What a run of the command line leaves."""

    code: int
    out: str
    err: str

    @property
    def errors(self) -> list[str]:
        return [text for text in self.err.splitlines() if text.startswith("error:")]

    @property
    def warnings(self) -> list[str]:
        return [text for text in self.err.splitlines() if text.startswith("warning:")]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """Run a command in this process."""

    def call(*arguments: object) -> Outcome:
        capsys.readouterr()
        code = main([str(each) for each in arguments])
        return Outcome(code, *capsys.readouterr())

    return call


@pytest.fixture
def run_alone() -> Callable[..., Outcome]:
    """Run a command in a process of its own, as a user does."""

    def call(*arguments: object, hash_seed: str = "random", **options: object) -> Outcome:
        command = [sys.executable, "-m", "polymerge_core", *map(str, arguments)]
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
            env={**os.environ, "PYTHONHASHSEED": hash_seed},
            **options,
        )
        return Outcome(done.returncode, done.stdout, done.stderr)

    return call
