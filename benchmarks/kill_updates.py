"""Kill a program that feeds a stored map, again and again, and look whether the map lost or doubled anything.

    python -m benchmarks.kill_updates [--kills 500] [--seed 1] [--folder FOLDER]

A child feeds frames of simulated drives through the stream that ``polymerge update MAP --stream`` reads, and says when
a transaction has begun and when a frame was answered. The parent kills it with SIGKILL at a random moment, most often
within a transaction, verifies the map, and starts the next child with the first frame that was not answered. What a
killed child had answered must be in the map, once, and the map must be whole.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import json
import os
import signal
import sqlite3
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.frames import CRS, town_frames
from polymerge_core.store import MapStore, map_file
from polymerge_core.streaming import run_stream

#: Drives of one map, and their frames.
DRIVES, FRAMES = 6, 12
_APART_M = 400.0
#: How many kills are aimed at a transaction, and how many of these at the moments when it is written.
_AIMED, _AT_COMMIT = 0.85, 0.4
#: Pages that SQLite may keep from the file: every second child writes to it long before it commits.
_FEW_PAGES = 10
_DRAW_EVERY = 2


@dataclass
class Tally:
    """What the kills did."""

    kills: int = 0
    within: int = 0
    hot_journals: int = 0
    answered: int = 0
    maps: int = 0
    unverified: int = 0
    lost: int = 0
    doubled: int = 0
    faults: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        """Return it in words."""
        share = self.within / max(self.kills, 1)
        found = [
            f"{self.kills} kills, {self.within} of them within a transaction ({share:.0%})",
            f"{self.hot_journals} kills left a half-written map to roll back",
            f"{self.answered} frames answered, of {self.maps} maps",
            f"{self.unverified} maps not whole, {self.lost} answered frames lost, {self.doubled} doubled",
        ]
        return "\n".join(found + self.faults)


def feed(path: Path, frames: list[str], log: int, *, spill: bool) -> None:
    """Feed a map frames, and log what happens; `spill` writes to the file as soon as there is something to write."""

    def say(*words: str) -> None:
        os.write(log, (" ".join(words) + "\n").encode())

    plain = map_file.transaction

    @contextlib.contextmanager
    def told(connection: map_file.Connection) -> Iterator[None]:
        if spill:
            connection.execute(f"PRAGMA cache_size = {_FEW_PAGES}")
        with plain(connection):
            say("begun")
            yield
            say("writing")
        say("committed")

    map_file.transaction = told

    def answer(text: str) -> None:
        done = json.loads(text)
        say("answered", done["drive"], done["instance"])

    run_stream(MapStore(path, create=True, crs=CRS), frames, answer, draw_every=_DRAW_EVERY)


def run_and_kill(path: Path, frames: list[str], rng: np.random.Generator) -> tuple[list[list[str]], bool]:
    """Start a child and kill it; return what it said, and whether the kill came before its end."""
    reading, writing = os.pipe()
    spill = bool(rng.random() < 0.5)
    child = os.fork()
    if child == 0:
        os.close(reading)
        code = 1
        try:
            feed(path, frames, writing, spill=spill)
            code = 0
        finally:
            os._exit(code)
    os.close(writing)
    said = b""
    if rng.random() < _AIMED:
        at_commit = rng.random() < _AT_COMMIT
        # One of the first transactions, at any moment of it: they take 0.05 to 1 s, and writing some milliseconds.
        word, wanted = b"writing" if at_commit else b"begun", int(rng.integers(1, 5))
        while said.count(word) < wanted and (more := os.read(reading, 4096)):
            said += more
        time.sleep(rng.uniform(0.0, 0.01) if at_commit else rng.choice([rng.uniform(0, 0.15), rng.uniform(0, 0.6)]))
    else:
        time.sleep(rng.uniform(0.0, 1.0))
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    while more := os.read(reading, 65536):
        said += more
    os.close(reading)
    killed = os.WIFSIGNALED(status)
    if not killed and os.WEXITSTATUS(status):
        raise RuntimeError("the child failed")
    return [line.split() for line in said.decode().splitlines()], killed


def look_at(path: Path, sent: dict[tuple[str, str], int], answered: set[tuple[str, str]], tally: Tally) -> None:
    """Verify a map after a kill; `sent` says how many vectors each frame has."""
    if not path.exists():
        tally.lost += len(answered)
        return
    journal = path.with_name(f"{path.name}-journal")
    tally.hot_journals += journal.exists() and journal.read_bytes()[:8] == _HOT
    held: collections.Counter[tuple[str, str]] = collections.Counter()
    seen: collections.Counter[tuple[str, str]] = collections.Counter()
    try:
        # Whatever the kill left, verify is the first to open it.
        found = MapStore(path).verify()
    except ValueError as error:
        # A map that was never committed is no map.
        found = [str(error)] if answered else []
    if found:
        tally.unverified += 1
        tally.faults += found
    with contextlib.closing(sqlite3.connect(path)) as connection:
        if connection.execute("SELECT 1 FROM sqlite_master").fetchone() is not None:
            held.update(connection.execute("SELECT drive, instance FROM instances"))
            seen.update(connection.execute(_SEEN))
    tally.lost += len(answered - set(held)) + sum(seen[name] < sent[name] for name in held)
    tally.doubled += sum(held[name] > 1 or seen[name] > sent[name] for name in held)


#: What a journal begins with that is to be rolled back.
_HOT = bytes.fromhex("d9d505f920a163d7")

#: The frame of each vector, whether it became an observation or was left out at once.
_SEEN = """
SELECT i.drive, i.instance FROM observations o JOIN instances i ON i.fid = o.instance_fid
UNION ALL SELECT drive, instance FROM left_out WHERE observation_fid IS NULL
"""


def kill_updates(folder: Path, kills: int, seed: int, *, progress: bool = False) -> Tally:
    """Kill children until as many as asked for have been killed; return what became of the maps."""
    rng = np.random.default_rng(seed)
    tally = Tally()
    while tally.kills < kills:
        tally.maps += 1
        path = folder / f"map_{tally.maps:03d}.gpkg"
        frames = [_moved(text) for text in town_frames(DRIVES, FRAMES, first_seed=int(rng.integers(1_000_000)))]
        messages = [json.loads(text) for text in frames]
        sent = {(message["drive"], message["instance"]): len(message["vectors"]) for message in messages}
        names = list(sent)
        answered: set[tuple[str, str]] = set()
        while len(answered) < len(frames) and tally.kills < kills:
            first = next(row for row, name in enumerate(names) if name not in answered)
            said, killed = run_and_kill(path, frames[first:], rng)
            answered |= {(words[1], words[2]) for words in said if words[0] == "answered"}
            look_at(path, sent, answered, tally)
            tally.kills += killed
            tally.within += killed and bool(said) and said[-1][0] in ("begun", "writing")
            if progress and tally.kills % 20 == 0:
                print(f"{tally.kills} kills, map {tally.maps}, {len(answered)} frames answered", file=sys.stderr)
        tally.answered += len(answered)
    return tally


def _moved(text: str) -> str:
    """Put every third drive into the same junction, so that none grows crowded and drawing stays quick."""
    message = json.loads(text)
    message["pose"]["translation"][0] += _APART_M * (int(message["drive"][-3:]) % (DRIVES // 2))
    return json.dumps(message)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return 1 where anything was lost."""
    parser = argparse.ArgumentParser(description="Kill a program that feeds a stored map, and look at the map.")
    parser.add_argument("--kills", type=int, default=500, help="how many (500)")
    parser.add_argument("--seed", type=int, default=1, help="of the moments and of the drives (1)")
    parser.add_argument("--folder", type=Path, help="where the maps stay; a temporary one by default")
    options = parser.parse_args(arguments)
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as temporary:
        tally = kill_updates(options.folder or Path(temporary), options.kills, options.seed, progress=True)
    print(f"{tally}\n{time.monotonic() - start:.0f} s")
    return int(bool(tally.unverified or tally.lost or tally.doubled))


if __name__ == "__main__":
    sys.exit(main())
