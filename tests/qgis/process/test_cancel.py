"""Stopped in the middle of 100,000 lines: the worker is gone within a second, and there is nothing half-written."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import shapely

from tests.cli.layers import EAST, NORTH, draw
from tests.qgis.process.running import PATIENCE_S, Qgis, Started

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks for the worker in /proc")

LINES = 100_000
OLD = b"the map of last year"

#: What a user is promised. It is measured in time of the processor, which other tests on the machine do not use up.
AT_ONCE_S = 1.0


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten looks at each of ten thousand roads."""
    rng = np.random.default_rng(1)
    road = np.arange(LINES) // 10
    x = EAST + (road % 100)[:, None] * 60.0 + [0.0, 20.0, 40.0] + rng.uniform(-1, 1, (LINES, 3))
    y = NORTH + (road // 100)[:, None] * 30.0 + rng.normal(0, 0.3, (LINES, 3))
    return draw(tmp_path_factory.mktemp("city") / "city.gpkg", shapely.linestrings(np.stack([x, y], axis=-1)))


@pytest.fixture
def temporary(tmp_path: Path) -> Path:
    """Where QGIS keeps its temporary files."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    return folder


@pytest.fixture
def old_map(tmp_path: Path) -> Path:
    """An output of an earlier run."""
    (tmp_path / "out").mkdir()
    path = tmp_path / "out" / "map.gpkg"
    path.write_bytes(OLD)
    return path


@pytest.mark.parametrize("stop", [os.kill, os.killpg], ids=["QGIS is told", "all in the terminal are told"])
def test_a_cancel_in_the_middle_ends_the_worker_at_once(
    qgis: Qgis, city: Path, old_map: Path, temporary: Path, stop: Callable[[int, int], None]
) -> None:
    with started(qgis, city, old_map, temporary) as process:
        worker = working(process)

        stop(process.pid, signal.SIGINT)

        assert seconds_until_end(worker) < AT_ONCE_S
        assert seconds_until_end(process.pid) < AT_ONCE_S
        out, err = process.communicate()
    assert (process.returncode, out.strip()) == (1, "")
    assert {text for text in err.splitlines() if "ancel" in text} == {"Cancelled; nothing was written."}
    assert_nothing_left(old_map, temporary)


def test_a_cancel_while_layers_are_handed_over_comes_through_at_once(
    qgis: Qgis, city: Path, old_map: Path, temporary: Path
) -> None:
    with started(qgis, city, old_map, temporary) as process:
        assert wait(lambda: any(temporary.rglob("city.gpkg"))), "nothing is handed over"

        process.send_signal(signal.SIGINT)

        assert seconds_until_end(process.pid) < AT_ONCE_S
        _, err = process.communicate()
    assert process.returncode == 1
    assert "Cancelled; nothing was written." in err
    assert_nothing_left(old_map, temporary)


def test_a_worker_ends_by_itself_when_qgis_is_killed(qgis: Qgis, city: Path, old_map: Path, temporary: Path) -> None:
    with started(qgis, city, old_map, temporary) as process:
        worker = working(process)

        process.kill()

        assert seconds_until_end(worker) < AT_ONCE_S
    assert {path.name: path.read_bytes() for path in old_map.parent.iterdir()} == {"map.gpkg": OLD}
    assert not any(temporary.rglob("result*"))


def started(qgis: Qgis, layer: Path, output: Path, temporary: Path) -> Started:
    """Start a merge that takes far longer than the test waits for it."""
    parameters = {"LOCAL_MAPS": layer, "OUTPUT": output}
    return qgis.start("polymerge:mergelocalmaps", parameters, TMPDIR=str(temporary))


def working(process: subprocess.Popen[str]) -> int:
    """Wait until the worker is long past its start, and return its number."""
    assert wait(lambda: bool(children(process.pid))), "there is no worker"
    (worker,) = children(process.pid)
    assert wait(lambda: seconds_of(worker) > 3), "the worker does nothing"
    assert not has_ended(worker)
    return worker


def children(parent: int) -> list[int]:
    """Processes that a process started."""
    running = [int(each.name) for each in Path("/proc").iterdir() if each.name.isdigit()]
    return [process for process in running if status(process)[1:2] == [str(parent)]]


def status(process: int) -> list[str]:
    """What the system knows of a process, from its state on; nothing where it has gone."""
    try:
        return Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    except OSError:
        return []


def has_ended(process: int) -> bool:
    """Whether a process runs no more; its parent may not have taken note of it yet."""
    return not status(process) or status(process)[0] in "ZX"


def seconds_of(process: int) -> float:
    """Time of the processor that a process has used."""
    ticks = status(process)[11:13]
    return sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")


def seconds_until_end(process: int) -> float:
    """Time of the processor that a process still uses before it ends."""
    used = [seconds_of(process)]

    def ended() -> bool:
        used.append(max(used[-1], seconds_of(process)))
        return has_ended(process)

    assert wait(ended), "it went on"
    return used[-1] - used[0]


def wait(condition: Callable[[], bool]) -> bool:
    """Wait until something is so; whether it came to that."""
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        if condition():
            return True
        time.sleep(0.02)
    return condition()


def assert_nothing_left(old_map: Path, temporary: Path) -> None:
    """The earlier output is as it was, and nothing lies beside it or among the temporary files."""
    assert {path.name: path.read_bytes() for path in old_map.parent.iterdir()} == {"map.gpkg": OLD}
    assert [path for path in temporary.rglob("*") if "polymerge" in path.name or path.is_file()] == []
