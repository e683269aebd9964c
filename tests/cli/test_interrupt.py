"""Stopped in the middle: Ctrl-C, a parent that hangs up, a kill. Old files stay whole, nothing is left behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from tests.cli.layers import draw, look, noisy_copies

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals as on POSIX systems")

OLD = b"the map of last year"
INTERRUPTED = 130


@pytest.fixture(scope="module")
def long_work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One set of many long lines, which takes several seconds to merge."""
    return draw(tmp_path_factory.mktemp("long") / "roads.gpkg", noisy_copies(400, 200))


@pytest.fixture(scope="module")
def roads_to_kill(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Work of a second or less."""
    return draw(tmp_path_factory.mktemp("short") / "roads.gpkg", noisy_copies(60, 60))


@pytest.fixture
def outputs(tmp_path: Path) -> Path:
    """A folder with an output of an earlier run."""
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "map.gpkg").write_bytes(OLD)
    return folder


@contextmanager
def started(roads: Path, outputs: Path, *options: str, ignoring: bool = False) -> Iterator[subprocess.Popen[str]]:
    """A merge in a process of its own, which tells how far it is."""
    command = [sys.executable, "-m", "polymerge_core", "merge", roads, "-o", outputs / "map.gpkg", "--overwrite"]

    def deaf() -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)

    with subprocess.Popen(
        [*map(str, command), "--progress", "json", *options],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=deaf if ignoring else None,  # noqa: PLW1509 - no thread runs when it starts
    ) as child:
        # A test that went wrong must not wait for the whole merge.
        watchdog = threading.Timer(60, child.kill)
        watchdog.start()
        try:
            yield child
        finally:
            watchdog.cancel()
            child.kill()


def wait_for(child: subprocess.Popen[str], reached: Callable[[dict[str, object]], bool]) -> None:
    """Wait until the progress says so."""
    for text in child.stderr:
        if text.startswith("{") and reached(json.loads(text)):
            return
    pytest.fail("the run ended before it was stopped")


def seconds_of(child: subprocess.Popen[str]) -> float:
    """Time that a run has used: of the processor where the system tells, as other tests may share it."""
    status = Path(f"/proc/{child.pid}/stat")
    if not status.exists():
        return time.monotonic()
    fields = status.read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def in_the_middle(progress: dict[str, object]) -> bool:
    return progress["message"] == "finding the consensus"


def contents(folder: Path) -> dict[str, bytes | None]:
    return {path.name: path.read_bytes() if path.is_file() else None for path in folder.iterdir()}


def assert_stopped_cleanly(child: subprocess.Popen[str], outputs: Path) -> None:
    said = [text for text in child.stderr.read().splitlines() if text and not text.startswith("{")]
    assert child.wait() == INTERRUPTED
    assert said == ["interrupted; nothing half-written was left behind"]
    assert child.stdout.read() == ""
    assert contents(outputs) == {"map.gpkg": OLD}


def test_ctrl_c_ends_with_130_and_leaves_nothing_behind(long_work, outputs):
    report = str(outputs / "report.json")
    with started(long_work, outputs, "--json", report) as child:
        wait_for(child, in_the_middle)
        child.send_signal(signal.SIGINT)
        assert_stopped_cleanly(child, outputs)


@pytest.mark.parametrize("ignoring", [False, True], ids=["", "where Ctrl-C is ignored, as in the background"])
def test_a_closed_standard_input_ends_it_within_a_second(long_work, outputs, ignoring):
    with started(long_work, outputs, "--watch-stdin", ignoring=ignoring) as child:
        child.stdin.write("what is written there does not matter\n")
        child.stdin.flush()
        wait_for(child, in_the_middle)
        assert child.poll() is None
        before = seconds_of(child)
        child.stdin.close()
        os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
        assert seconds_of(child) - before < 1.0
        assert_stopped_cleanly(child, outputs)


def test_without_watch_stdin_a_closed_standard_input_means_nothing(outputs, tmp_path):
    roads = draw(tmp_path / "roads.gpkg", noisy_copies(3, 6))
    with started(roads, outputs) as child:
        child.stdin.close()
        assert child.wait() == 0
    assert len(look(outputs / "map.gpkg", "elements")) == 1


def test_an_open_standard_input_does_not_hold_the_end_up(outputs, tmp_path):
    roads = draw(tmp_path / "roads.gpkg", noisy_copies(3, 6))
    with started(roads, outputs, "--watch-stdin") as child:
        assert child.wait() == 0
    assert len(look(outputs / "map.gpkg", "elements")) == 1


def test_a_standard_input_that_was_never_open_ends_it_at_once(outputs, tmp_path):
    roads = draw(tmp_path / "roads.gpkg", noisy_copies(400, 20))
    command = [sys.executable, "-m", "polymerge_core", "merge", roads, "-o", outputs / "map.gpkg", "--overwrite"]
    done = subprocess.run(
        [*command, "--watch-stdin"], stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == INTERRUPTED
    assert contents(outputs) == {"map.gpkg": OLD}


@pytest.mark.parametrize("message", ["reading the layers", "finding the consensus", "writing"])
def test_a_kill_leaves_the_old_output_whole(outputs, roads_to_kill, message):
    delay = np.random.default_rng(len(message)).uniform(0.0, 0.02)
    with started(roads_to_kill, outputs) as child:
        wait_for(child, lambda progress: progress["message"] == message)
        time.sleep(delay)
        child.kill()
        killed = child.wait() == -signal.SIGKILL
    # Whether the kill or the end came first: one of the two maps is there, whole.
    if (outputs / "map.gpkg").read_bytes() != OLD:
        assert message == "writing"
        assert len(look(outputs / "map.gpkg", "elements")) == 1
    else:
        assert killed


def test_what_a_killed_run_left_is_removed_by_the_next(outputs, roads_to_kill):
    with started(roads_to_kill, outputs) as child:
        wait_for(child, lambda progress: progress["message"] == "writing")
        while child.poll() is None and not any(outputs.glob(".*/map.gpkg")):
            time.sleep(0.001)
        child.kill()
    assert (outputs / "map.gpkg").read_bytes() == OLD
    assert len(contents(outputs)) == 2, "the kill came too late to test anything"
    with started(roads_to_kill, outputs) as child:
        assert child.wait() == 0
    assert contents(outputs).keys() == {"map.gpkg"}
    assert len(look(outputs / "map.gpkg", "elements")) == 1
