"""Bad luck while a stored map is updated: it is the old map or the new one, whole; one sentence says what happened."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest

from polymerge_core import MapStore
from polymerge_core.messages import read_message
from tests.cli.layers import EAST, NORTH, UTM, draw, line, noisy_copies

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals and permissions as on POSIX systems")

INTERRUPTED = 130
#: Of a map with what there is in `stored`.
FRAMES = 3


def frame(number: int, drive: str = "monday") -> str:
    """A look at two lines of a street, as a vehicle sends it; each is 10 m further along."""
    wave = 0.05 * (number % 7)
    return json.dumps(
        {
            "drive": drive,
            "instance": str(number),
            "timestamp_ns": number * 10**9,
            "pose": {"translation": [EAST + 10 * number, NORTH, 0], "rotation": [1, 0, 0, 0]},
            "vectors": [[[-30, y + wave], [-10, y], [10, y - wave], [30, y]] for y in (-4, 4)],
            "labels": ["divider", "boundary"],
        }
    )


@pytest.fixture(scope="module")
def stored_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("stored") / "map.gpkg"
    store = MapStore(path, create=True, crs=UTM)
    for number in range(FRAMES):
        store.update(read_message(frame(number), store.crs, "frame").local_maps)
    return path


@pytest.fixture
def stored(stored_once: Path, tmp_path: Path) -> Path:
    """A map, alone in its folder."""
    folder = tmp_path / "maps"
    folder.mkdir()
    return Path(shutil.copy(stored_once, folder / "map.gpkg"))


@pytest.fixture
def roads(tmp_path: Path) -> Path:
    """A local map of three lines."""
    names = {"drive": ["friday"] * 3, "instance": ["0"] * 3}
    return draw(tmp_path / "roads.gpkg", [line((0, y), (40, y)) for y in (0, 20, 40)], **names)


@pytest.fixture
def many_roads(tmp_path: Path) -> Path:
    """Local maps that take seconds to draw, and megabytes to keep."""
    lines = noisy_copies(60, 300)
    return draw(tmp_path / "many.gpkg", lines, drive=["friday"] * 60, instance=[str(row) for row in range(60)])


def instances(path: Path) -> list[tuple[str, str]]:
    with contextlib.closing(sqlite3.connect(path)) as database:
        return sorted(database.execute("SELECT drive, instance FROM instances").fetchall())


def assert_old(path: Path, before: bytes) -> None:
    """The map is the old one to the byte, and nothing is beside it."""
    assert MapStore(path).verify() == []
    assert path.read_bytes() == before
    assert [each.name for each in path.parent.iterdir()] == [path.name]


def assert_one_error(outcome: Any, *words: str, code: int = 1) -> None:
    assert outcome.code == code, outcome.err
    assert "Traceback" not in outcome.err
    assert "fault of PolyMerge" not in outcome.err
    assert len(outcome.errors) == 1, outcome.err
    for word in words:
        assert word in outcome.errors[0]


@contextlib.contextmanager
def started(*arguments: Any, program: str | None = None, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """The command line, or another program, in a process of its own."""
    words = ["-m", "polymerge_core"] if program is None else ["-c", program]
    with subprocess.Popen(
        [sys.executable, *words, *map(str, arguments)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    ) as child:
        watchdog = threading.Timer(60, child.kill)
        watchdog.start()
        try:
            yield child
        finally:
            watchdog.cancel()
            child.kill()


@contextlib.contextmanager
def held(path: Path, program: str) -> Iterator[subprocess.Popen[str]]:
    """Another program that has the map open until its standard input closes."""
    opened = f"import sqlite3, sys; database = sqlite3.connect(sys.argv[1], isolation_level=None); {program}"
    with started(path, program=f"{opened}; print('held', flush=True); sys.stdin.read()") as child:
        assert child.stdout.readline() == "held\n"
        yield child
        child.stdin.close()
        child.wait()


WRITING = "database.execute('BEGIN IMMEDIATE')"
READING = "rows = database.execute('SELECT * FROM observations'); rows.fetchone()"


# -- killed ----------------------------------------------------------------------------------------


def test_a_kill_at_any_moment_loses_no_frame_that_was_answered(tmp_path):
    path, rng, next_frame = tmp_path / "map.gpkg", np.random.default_rng(1), 0
    answered: set[tuple[str, str]] = set()
    for _ in range(8):
        with started("update", path, "--stream", "--create", "--crs", UTM, "--draw-every", 2) as child:
            for number in range(next_frame, next_frame + 30):
                child.stdin.write(frame(number) + "\n")
            child.stdin.flush()
            said = [child.stdout.readline()]
            time.sleep(rng.uniform(0.0, 0.4))
            child.kill()
            said += child.stdout.readlines()
        answers = [json.loads(text) for text in said if text.endswith("\n")]
        answered |= {(answer["drive"], answer["instance"]) for answer in answers}
        next_frame = len(answered)
        assert MapStore(path).verify() == []
        known = instances(path)
        assert len(known) == len(set(known))
        assert answered <= set(known)
        # At most the one frame that was being answered is there as well.
        assert len(known) <= len(answered) + 1


KILLED_WRITING = """
import contextlib, os, signal, sys
from polymerge_core.__main__ import main
from polymerge_core.store import map_file

@contextlib.contextmanager
def killed(connection):
    connection.execute("PRAGMA cache_size = 5")
    connection.execute("BEGIN IMMEDIATE")
    yield
    if sys.argv[1] == "committed":
        connection.execute("COMMIT")
    os.kill(os.getpid(), signal.SIGKILL)

map_file.transaction = killed
main(sys.argv[2:])
"""


def kill_writing(path: Path, roads: Path, *, when: str = "before the commit", options: tuple[str, ...] = ()) -> None:
    """Kill an update that has written to the file."""
    with started(when, "update", path, roads, *options, program=KILLED_WRITING) as child:
        assert child.wait() == -signal.SIGKILL


COMMANDS = {
    "verify": lambda path, _: ["verify", path],
    "history": lambda path, _: ["history", path],
    "changes": lambda path, folder: ["changes", path, "-o", folder / "changes.gpkg"],
    "restore": lambda path, folder: ["restore", path, "--revision", 1, "-o", folder / "old.gpkg"],
    "update": lambda path, folder: ["update", path, folder / "roads.gpkg"],
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("mode", ["delete", "wal"])
def test_what_a_killed_writer_left_is_undone_by_whoever_comes_next(run, stored, many_roads, roads, mode, command):
    with contextlib.closing(sqlite3.connect(stored)) as database:
        database.execute(f"PRAGMA journal_mode = {mode}")
    before = stored.read_bytes()
    kill_writing(stored, many_roads)
    left = stored.with_name(f"map.gpkg-{'journal' if mode == 'delete' else 'wal'}")
    assert left.stat().st_size > 0, "the kill came too early to test anything"
    assert (stored.read_bytes() == before) == (mode == "wal")
    outcome = run(*COMMANDS[command](stored, roads.parent))
    assert outcome.code == 0, outcome.err
    if command != "update":
        assert len(instances(stored)) == FRAMES
        if mode == "delete":
            assert_old(stored, before)
    assert MapStore(stored).verify() == []


def test_a_kill_after_the_commit_comes_too_late(stored, roads):
    kill_writing(stored, roads, when="committed")
    assert MapStore(stored).verify() == []
    assert ("friday", "0") in instances(stored)


def test_a_kill_while_the_map_is_made_leaves_one_that_can_be_made(run, tmp_path, many_roads):
    path = tmp_path / "maps" / "map.gpkg"
    path.parent.mkdir()
    kill_writing(path, many_roads, options=("--create",))
    assert path.stat().st_size > 0
    assert path.with_name("map.gpkg-journal").exists()
    assert run("update", path, many_roads, "--create").code == 0
    assert MapStore(path).verify() == []
    assert [each.name for each in path.parent.iterdir()] == ["map.gpkg"]


# -- no room, no permission --------------------------------------------------------------------------


@pytest.mark.parametrize("room", [4096, 100_000])
def test_a_full_disk_leaves_the_old_map(run_alone, stored, many_roads, room):
    before = stored.read_bytes()

    def little_room() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) + room, len(before) + room))

    outcome = run_alone("update", stored, many_roads, preexec_fn=little_room)
    assert_one_error(outcome, "map.gpkg", "the map is as it was")
    assert_old(stored, before)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of its own with little room."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = shutil.which("mount")
    options = ["-t", "tmpfs", "-o", "size=400k"]
    if mount is None or subprocess.run([mount, *options, "none", folder], capture_output=True, check=False).returncode:
        pytest.skip("only root can make a disk")
    yield folder
    subprocess.run(["umount", folder], check=True)


def test_a_disk_that_fills_up_leaves_the_old_map_and_takes_the_update_when_there_is_room(
    run, small_disk, stored, many_roads, roads
):
    path = Path(shutil.copy(stored, small_disk))
    before = path.read_bytes()
    outcome = run("update", path, many_roads)
    assert_one_error(outcome, "map.gpkg: the disk is full", "make room", "the map is as it was")
    assert_old(path, before)
    assert run("update", path, roads).code == 0
    assert MapStore(path).verify() == []


def test_a_disk_too_small_for_a_new_map_is_left_empty(run, small_disk, many_roads):
    assert_one_error(run("update", small_disk / "map.gpkg", many_roads, "--create"), "the disk is full")
    assert list(small_disk.iterdir()) == []


def without_privileges() -> None:
    """Be held to permissions even where the tests are run by root."""
    if os.geteuid() == 0:
        prctl, drop, override = ctypes.CDLL(None, use_errno=True).prctl, 24, 1
        if prctl(drop, override, 0, 0, 0):
            raise OSError(ctypes.get_errno(), "cannot give up privileges")


@pytest.mark.skipif(sys.platform != "linux", reason="privileges as on Linux")
@pytest.mark.parametrize("part", ["file", "folder"])
def test_a_map_that_may_not_be_written_stays_and_can_be_read(run_alone, stored, roads, part):
    before = stored.read_bytes()
    closed, mode = (stored, 0o444) if part == "file" else (stored.parent, 0o555)
    closed.chmod(mode)
    try:
        outcome = run_alone("update", stored, roads, preexec_fn=without_privileges)
        assert_one_error(outcome, "map.gpkg cannot be", "permissions", "the map is as it was")
        assert run_alone("verify", stored, preexec_fn=without_privileges).code == 0
    finally:
        closed.chmod(0o755)
    assert_old(stored, before)


@pytest.mark.skipif(sys.platform != "linux", reason="privileges as on Linux")
def test_a_new_map_in_a_folder_that_may_not_be_written(run_alone, tmp_path, roads):
    folder = tmp_path / "closed"
    folder.mkdir(mode=0o555)
    outcome = run_alone("update", folder / "map.gpkg", roads, "--create", preexec_fn=without_privileges)
    assert_one_error(outcome, "map.gpkg cannot be opened", "Permission denied")
    assert list(folder.iterdir()) == []


# -- somebody else has it ----------------------------------------------------------------------------


def test_a_map_that_another_program_is_writing_is_named_and_can_be_read(run, stored, roads):
    before = stored.read_bytes()
    with held(stored, WRITING):
        outcome = run("update", stored, roads, "--patience", 0.2)
        assert run("verify", stored).code == 0
    assert_one_error(outcome, "map.gpkg is locked by another program", "waited 0.2 s", "the map is as it was")
    assert_old(stored, before)


def test_an_update_waits_for_another_program(run, stored, roads):
    with held(stored, WRITING) as other:
        release = threading.Timer(0.5, other.stdin.close)
        release.start()
        assert run("update", stored, roads).code == 0
        release.join()
    assert ("friday", "0") in instances(stored)


def test_a_reader_in_the_middle_of_the_map_is_waited_for(run, stored, roads):
    before = stored.read_bytes()
    with held(stored, READING):
        assert_one_error(run("update", stored, roads, "--patience", 0.2), "locked by another program")
        assert stored.read_bytes() == before
    assert run("update", stored, roads).code == 0


def test_a_reader_of_a_map_with_a_write_ahead_log_is_not(run, stored, roads):
    # QGIS switches a GeoPackage to it while it is edited.
    with held(stored, f"database.execute('PRAGMA journal_mode = wal'); {READING}"):
        assert run("update", stored, roads, "--patience", 0.2).code == 0
        assert MapStore(stored).verify() == []
    assert ("friday", "0") in instances(stored)
    assert MapStore(stored).verify() == []


READER = """
import sys, pyogrio
known = 0
while True:
    now = len(pyogrio.read_dataframe(sys.argv[1], layer="instances"))
    assert now >= known
    if now > known:
        print(now, flush=True)
    known = now
"""


def test_a_reader_sees_the_old_map_or_the_new_one_while_frames_come_in(stored):
    with (
        started(stored, program=READER) as reader,
        started("update", stored, "--stream", "--draw-every", 100) as writer,
    ):
        assert reader.stdout.readline() == f"{FRAMES}\n"
        said, _ = writer.communicate("\n".join(frame(number) for number in range(FRAMES, 20)))
        assert writer.returncode == 0
        assert reader.poll() is None, reader.stderr.read()
        reader.kill()
        seen = [int(text) for text in reader.stdout.read().split()]
    assert len(said.splitlines()) == 20 - FRAMES
    assert seen == sorted(seen)
    assert len(pyogrio.read_dataframe(stored, layer="instances")) == 20


@pytest.mark.parametrize("new", [False, True], ids=["a map that is there", "a map that both make"])
def test_two_writers_at_once_come_one_after_the_other(tmp_path, stored, new):
    path = tmp_path / "new.gpkg" if new else stored
    drives = ("tuesday", "wednesday")
    with contextlib.ExitStack() as stack:
        options = ("--stream", "--draw-every", 3, "--create", "--crs", UTM, "--patience", 30)
        writers = [stack.enter_context(started("update", path, *options)) for _ in drives]
        for writer, drive in zip(writers, drives, strict=True):
            writer.stdin.write("\n".join(frame(number, drive) for number in range(6)))
            writer.stdin.close()
        said = [writer.stderr.read() for writer in writers]
        assert [writer.wait() for writer in writers] == [0, 0], said
    expected = [(drive, str(number)) for drive in drives for number in range(6)]
    assert [each for each in instances(path) if each[0] != "monday"] == expected
    assert MapStore(path).verify() == []


# -- interrupted -------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_ctrl_c_ends_with_130_and_the_old_map(stored, many_roads, seed):
    before = stored.read_bytes()
    with started("update", stored, many_roads, "--progress", "json") as child:
        for text in child.stderr:
            if json.loads(text)["message"] == "updating the map":
                break
        time.sleep(np.random.default_rng(seed).uniform(0.0, 0.5))
        child.send_signal(signal.SIGINT)
        said = [text for text in child.stderr.read().splitlines() if text and not text.startswith("{")]
        assert child.wait() == INTERRUPTED
    assert said == ["interrupted; nothing half-written was left behind"]
    assert_old(stored, before)


def test_ctrl_c_of_a_stream_that_waits_keeps_what_was_answered(stored):
    with started("update", stored, "--stream") as child:
        child.stdin.write(frame(7) + "\n")
        child.stdin.flush()
        assert json.loads(child.stdout.readline())["instance"] == "7"
        child.send_signal(signal.SIGINT)
        assert child.wait() == INTERRUPTED
    assert len(instances(stored)) == FRAMES + 1
    assert MapStore(stored).verify() == []


def test_ctrl_c_within_what_the_spatial_index_calls_is_ctrl_c(run, stored, roads, monkeypatch):
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    before = stored.read_bytes()
    monkeypatch.setattr("polymerge_core.store.geopackage._is_empty", interrupted)
    outcome = run("update", stored, roads)
    monkeypatch.undo()
    assert outcome.code == INTERRUPTED
    assert_old(stored, before)


# -- a file that is no map ---------------------------------------------------------------------------


def truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def overwritten(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[4096:40960] = np.random.default_rng(1).bytes(36864)
    path.write_bytes(content)


def of_a_later_version(path: Path) -> None:
    with sqlite3.connect(path) as database:
        database.execute("UPDATE map_settings SET value = '99' WHERE name = 'format'")


def without_settings(path: Path) -> None:
    with sqlite3.connect(path) as database:
        database.execute("DELETE FROM map_settings WHERE name = 'proximity'")


def a_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


NO_MAPS = {
    "half of it": (truncated, ["map.gpkg", "damaged"]),
    "bytes of something else in it": (overwritten, ["map.gpkg", "damaged"]),
    "garbage": (lambda path: path.write_bytes(b"the map of last year" * 500), ["map.gpkg is no GeoPackage"]),
    "of a later version": (of_a_later_version, ["map.gpkg was written by a later version", "update PolyMerge"]),
    "without a setting": (without_settings, ["map.gpkg is damaged", "proximity"]),
    "layers that are no stored map": (
        lambda path: path.unlink() or draw(path, [line((0, 0), (9, 0))]),
        ["map.gpkg is no stored map", "--create", "--main-map"],
    ),
    "a folder": (a_folder, ["map.gpkg is a folder"]),
    "nothing": (lambda path: path.unlink(), ["map.gpkg does not exist", "--create"]),
    "an empty file": (lambda path: path.write_bytes(b""), ["map.gpkg does not exist", "--create"]),
    "a link to nothing": (
        lambda path: path.unlink() or path.symlink_to("gone.gpkg"),
        ["map.gpkg does not exist", "--create"],
    ),
    "no folder": (lambda path: shutil.rmtree(path.parent), ["map.gpkg does not exist", "--create"]),
}


@pytest.mark.parametrize("command", ["verify", "history", "restore", "update"])
@pytest.mark.parametrize("case", NO_MAPS)
def test_what_is_no_map_is_refused_in_one_sentence(run, stored, roads, case, command):
    spoil, words = NO_MAPS[case]
    spoil(stored)
    before = stored.read_bytes() if stored.is_file() else None
    outcome = run(*COMMANDS[command](stored, roads.parent))
    if outcome.code == 0:
        assert case in ("half of it", "bytes of something else in it")
        assert command != "verify"
        return
    assert_one_error(outcome, *words)
    assert (stored.read_bytes() if stored.is_file() else None) == before
    assert not (roads.parent / "old.gpkg").exists()


@pytest.mark.parametrize("seed", range(12))
def test_a_flipped_bit_never_makes_more_than_a_sentence(run, stored, seed):
    rng = np.random.default_rng(seed)
    content = bytearray(stored.read_bytes())
    for at in rng.integers(0, len(content), 40):
        content[at] ^= 1 << int(rng.integers(8))
    stored.write_bytes(content)
    outcome = run("verify", stored)
    if outcome.code:
        assert_one_error(outcome, "map.gpkg")


def test_a_new_map_where_there_is_no_folder(run, tmp_path, roads):
    outcome = run("update", tmp_path / "gone" / "map.gpkg", roads, "--create")
    assert_one_error(outcome, "map.gpkg cannot be opened", "No such file or directory")
    assert not (tmp_path / "gone").exists()


def test_a_map_behind_a_link_is_updated_where_it_lies(run, stored, roads, tmp_path):
    link = tmp_path / "link.gpkg"
    link.symlink_to(stored)
    assert run("update", link, roads).code == 0
    assert link.is_symlink()
    assert ("friday", "0") in instances(stored)
    kill_writing(link, draw(tmp_path / "more.gpkg", [line((0, 60), (40, 60))], drive=["friday"], instance=["1"]))
    assert run("verify", link).code == 0


@pytest.mark.parametrize("create", [False, True])
def test_a_map_that_was_removed_is_not_made_again_in_silence(stored, create):
    store = MapStore(stored, create=create)
    stored.unlink()
    look = read_message(frame(9), UTM, "frame").local_maps
    with pytest.raises(ValueError, match=r"map\.gpkg does not exist"):
        store.update(look)
    assert not stored.exists()


def test_a_map_that_is_replaced_while_an_update_waits_for_it_is_no_place_to_write(stored, stored_once, roads):
    with held(stored, WRITING) as other, started("update", stored, roads, "--patience", 20) as child:
        time.sleep(4.0)
        Path(shutil.copy(stored_once, stored.with_name("copy.gpkg"))).replace(stored)
        other.stdin.close()
        said = child.stderr.read()
        assert child.wait() == 1
    assert "map.gpkg" in said
    assert "Traceback" not in said
    assert len(instances(stored)) == FRAMES
