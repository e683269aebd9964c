"""How long an update of one frame takes, and how that grows with the map that it goes into.

    python -m benchmarks.speed_updates [--sizes 1000,10000,100000,1000000] [--frames 100] [--folder FOLDER]

The maps are made quickly: one block of a street, seen by three frames, is fed to a stored map as any frame is, and its
rows are copied over a grid of blocks. Then frames come in at random blocks, at random places within them, so that each
sees parts of up to four blocks. What is timed, on the clock and of the processor (its median), is all between a line of
text and the answer: reading it, reading the neighbourhood, drawing and the commit; and once more without drawing. Maps
stay in FOLDER and are not made again.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import shutil
import sqlite3
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from polymerge_core.messages import read_message
from polymerge_core.store import MapStore, geopackage
from polymerge_core.store.geopackage import connect

CRS = "EPSG:32632"
CENTRE = np.array([400_000.0, 5_600_000.0])
#: A block is as large as what a frame looks at, metres; the grid has at most so many blocks in a row.
BLOCK_M, COLUMNS = np.array([60.0, 30.0]), 200
LOOKS = 3
#: What an update may take at the largest size, seconds, and how much longer than at the smallest.
LIMIT_S, GROWTH = 0.1, 1.5

_NOISE_M, _STEP_M = 0.1, 5.0
_PATIENCE_S = 10.0
_AT_ONCE = 500
_KEYS: dict[str, str] = {}
_LAYERS = ("instances", "observations", "elements", "changes")
_TABLES = (*_LAYERS, "lineage", "left_out")
#: Columns that name a row of another table.
_REFERENCES = {"element_id": "elements", "observation_fid": "observations", "instance_fid": "instances"}


def street() -> list[tuple[str, shapely.Geometry]]:
    """Return what there is in a block, metres from its centre: 12 lines along it and 3 crossings."""
    along = [("boundary" if row in (0, 11) else "divider", -12.0 + 24 / 11 * row) for row in range(12)]
    lines = [(name, shapely.LineString([(-26, y), (0, y + 0.3), (26, y)])) for name, y in along]
    crossings = [("ped_crossing", shapely.box(x, -10, x + 4, 10).exterior) for x in (-24.0, -2.0, 20.0)]
    return lines + crossings


def frame(name: str, centre: np.ndarray, blocks: np.ndarray, rng: np.random.Generator) -> str:
    """Return what is seen of some blocks from a place, as a vehicle sends it."""
    box = shapely.box(*-BLOCK_M / 2, *BLOCK_M / 2)
    vectors, labels = [], []
    for block in blocks:
        for cls, line in street():
            seen = shapely.intersection(shapely.transform(line, lambda at, by=block - centre: at + by), box)
            for part in shapely.get_parts(shapely.line_merge(seen)):
                if part.length > _STEP_M:
                    at = shapely.get_coordinates(shapely.segmentize(part, _STEP_M))
                    vectors.append((at + rng.normal(0, _NOISE_M) + rng.normal(0, _NOISE_M / 3, at.shape)).tolist())
                    labels.append(cls)
    pose = {"translation": [*centre.tolist(), 0.0], "rotation": [1, 0, 0, 0]}
    message = {"drive": name, "instance": "0", "timestamp_ns": 1_700_000_000_000_000_000, "pose": pose}
    footprint = [*(-BLOCK_M / 2).tolist(), *(BLOCK_M / 2).tolist()]
    return json.dumps(message | {"footprint": footprint, "vectors": vectors, "labels": labels})


def columns_of(blocks: int) -> int:
    """Return how many blocks a row of the grid has."""
    return min(COLUMNS, math.isqrt(blocks))


def block_centre(number: int, columns: int) -> np.ndarray:
    """Return where a block lies."""
    return CENTRE + BLOCK_M * [number % columns, number // columns]


def make_map(path: Path, elements: int) -> int:
    """Make a map of at least so many elements; return the number of its blocks."""
    rng = np.random.default_rng(1)
    store = MapStore(path, create=True, crs=CRS)
    for look in range(LOOKS):
        text = frame(f"block_0_{look}", CENTRE, CENTRE[None], rng)
        store.update(read_message(text, store.crs, "frame").local_maps)
    blocks = -(-elements // len(store.elements()))
    with contextlib.closing(connect(path, _PATIENCE_S)) as connection:
        connection.execute("PRAGMA synchronous = OFF")
        connection.execute("PRAGMA cache_size = -1000000")
        connection.execute("BEGIN IMMEDIATE")
        steps = {table: geopackage.next_id(connection, table) - 1 for table in _TABLES}
        with _without_triggers(connection):
            for table in _TABLES:
                _copy(connection, table, blocks, steps)
        for name in ("n_instances", "n_observations", "elements", "added", "changed"):
            connection.execute(f"UPDATE revisions SET {name} = {name} * ?", (blocks,))
        connection.execute("COMMIT")
    return blocks


@contextlib.contextmanager
def _without_triggers(connection: sqlite3.Connection) -> Iterator[None]:
    triggers = connection.execute("SELECT name, sql FROM sqlite_master WHERE type = 'trigger'").fetchall()
    for name, _ in triggers:
        connection.execute(f'DROP TRIGGER "{name}"')
    yield
    for _, text in triggers:
        connection.execute(text)


def _copy(connection: sqlite3.Connection, table: str, blocks: int, steps: dict[str, int]) -> None:
    """Copy the rows of the first block to all others; ids of one block are followed by those of the next."""
    key = _KEYS.get(table, "fid")
    rows = connection.execute(f'SELECT * FROM "{table}"')
    names = [column[0] for column in rows.description]
    held = rows.fetchall()
    step = [steps[table] if name == key else steps.get(_REFERENCES.get(name, ""), 0) for name in names]
    marks = ", ".join("?" * len(names))
    drive = names.index("drive") if "drive" in names else None
    for first in range(1, blocks, _AT_ONCE):
        numbers = np.arange(first, min(first + _AT_ONCE, blocks))
        copies = [
            [value if value is None or not by else value + number * by for value, by in zip(row, step, strict=True)]
            for number in numbers.tolist()
            for row in held
        ]
        if drive is not None:
            for row, number in zip(copies, np.repeat(numbers, len(held)).tolist(), strict=True):
                row[drive] = row[drive].replace("_0_", f"_{number}_")
        if table in _LAYERS and held:
            far = np.vstack([block_centre(number, columns_of(blocks)) for number in numbers]) - CENTRE
            _move(connection, table, far, copies, (names.index(key), names.index("geom")))
        connection.executemany(f'INSERT INTO "{table}" VALUES ({marks})', copies)
    connection.execute(
        "UPDATE gpkg_ogr_contents SET feature_count = feature_count * ? WHERE table_name = ?", (blocks, table)
    )


def _move(
    connection: sqlite3.Connection, table: str, far: np.ndarray, copies: list[list[Any]], at: tuple[int, int]
) -> None:
    """Move the geometries of copies to their blocks, and put them into the spatial index and the bounds."""
    key, geom = at
    shapes = geopackage.from_blobs([row[geom] for row in copies])
    each = np.repeat(far, len(copies) // len(far), axis=0)
    shift = np.repeat(each, shapely.get_num_coordinates(shapes), axis=0)
    shapely.set_coordinates(shapes, shapely.get_coordinates(shapes) + shift)
    (srs_id,) = connection.execute("SELECT srs_id FROM gpkg_contents WHERE table_name = ?", (table,)).fetchone()
    for row, blob in zip(copies, geopackage.to_blobs(shapes, srs_id), strict=True):
        row[geom] = blob
    box = shapely.bounds(shapes)[:, [0, 2, 1, 3]].tolist()
    connection.executemany(
        f'INSERT INTO "rtree_{table}_geom" VALUES (?, ?, ?, ?, ?)',
        [(row[key], *bounds) for row, bounds in zip(copies, box, strict=True)],
    )
    geopackage.touched(connection, table, shapes)


def measure(path: Path, blocks: int, frames: int, *, draw: bool) -> tuple[np.ndarray, np.ndarray]:
    """Feed a map frames at random places; return the seconds that each took, on the clock and of the processor."""
    rng = np.random.default_rng(2)
    store = MapStore(path)
    crs, columns = store.crs, columns_of(blocks)
    taken = []
    for number in range(-3, frames):  # three to warm up
        # With all its neighbours, as most have them in a large map.
        column, row = rng.integers(1, columns - 1), rng.integers(1, blocks // columns - 1)
        block = int(column + columns * row)
        near = [block + right + columns * up for right in (-1, 0, 1) for up in (-1, 0, 1)]
        centre = np.round(block_centre(block, columns) + rng.uniform(-10, 10, 2), 2)
        name = f"{'drawn' if draw else 'kept'}_{number}"
        text = frame(name, centre, np.vstack([block_centre(each, columns) for each in near]), rng)
        start = time.perf_counter(), time.process_time()
        store.update(read_message(text, crs, "frame").local_maps, draw=draw)
        taken.append((time.perf_counter() - start[0], time.process_time() - start[1]))
    clock, processor = np.array(taken[3:]).T
    return clock, processor


def main(arguments: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="How long an update takes, by the size of the map.")
    parser.add_argument("--sizes", default="1000,10000,100000,1000000", help="elements of the maps")
    parser.add_argument("--frames", type=int, default=100, help="how many updates of each kind (100)")
    parser.add_argument("--folder", type=Path, help="where the maps are kept; a temporary one by default")
    parser.add_argument("--verify", type=int, default=10_000, help="up to this size the map is verified (10000)")
    options = parser.parse_args(arguments)
    medians: dict[bool, list[float]] = {True: [], False: []}
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        print(f"{'elements':>9} {'file':>8} {'':>10} {'median':>9} {'99 %':>9} {'maximum':>9} {'processor':>9}")
        for size in map(int, options.sizes.split(",")):
            made = folder / f"map_{size}.gpkg"
            if not made.exists():
                make_map(made, size)
            path = folder / "fed.gpkg"
            shutil.copy(made, path)
            with contextlib.closing(sqlite3.connect(path)) as connection:
                blocks = connection.execute("SELECT COUNT(*) FROM instances").fetchone()[0] // LOOKS
            for draw in (True, False):  # what is kept would be drawn with the next
                taken, used = measure(path, blocks, options.frames, draw=draw)
                medians[draw].append(float(np.median(taken)))
                told = [
                    f"{1000 * value:6.0f} ms"
                    for value in (np.median(taken), np.quantile(taken, 0.99), taken.max(), np.median(used))
                ]
                what = "drawn" if draw else "kept"
                print(f"{size:>9} {path.stat().st_size / 1e6:5.0f} MB {what:>10} {' '.join(told)}", flush=True)
            found = MapStore(path).verify() if size <= options.verify else []
            path.unlink()
            if found:
                print("; ".join(found))
                return 1
    for draw, what in ((True, "drawn"), (False, "kept")):
        growth, last = medians[draw][-1] / medians[draw][0], medians[draw][-1]
        print(f"{what}: growth {growth:.2f} x (at most {GROWTH}), {1000 * last:.0f} ms (at most {1000 * LIMIT_S:.0f})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
