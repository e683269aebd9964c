"""What the consensus costs, end to end and as it grows, beside reading and writing the same layers with geopandas.

    python benchmarks/speed_consensus.py [--groups 1000,10000,100000] [--road 150,1500,15000] [--data FOLDER]
        [--only CASE ...] [--memory GB] [-o speed_consensus.json]

Groups: independent groups of 15 looks at one line, each look from a local map of its own; without and with the
footprints of these local maps, and seen by 15 drives. Road: three lines 3.5 m apart, seen by frames that look 30 m to
either side; *longer* grows with the frames (one every 4 m), the others are 200 m seen ever more often, by one drive or
each time by another one. Drives: all real drives of the deecamp data in FOLDER. Each size runs in a process of its own,
which may take so much memory; of what needs more the error is shown. Ratios and growth exponents are what to compare;
where other work shares the machine, processor time grows more evenly than time.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

# Run as a file, the folder of the project is not where Python looks.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import polymerge_core as pm
from benchmarks.scenarios import deecamp
from benchmarks.speed import CRS, LOOKS, VERTICES, cells, exponents, growth, head, looks_at_lines, peak_mb
from polymerge_core.schema import INSTANCES_LAYER, LOCAL_MAPS_LAYER

STAGES = ("read", "merge", "write")

#: What a local map looks at: metres ahead and behind, and to either side.
AHEAD, ASIDE = 30.0, 15.0

#: The road: its lines, metres between two of them and between two frames, and the frames of the one that stays short.
LINES, LINE_SPACING, FRAME_SPACING, PLACES = 3, 3.5, 4.0, 50

#: What the merge is to need at most: times reading and writing, growth exponents, seconds for the real drives.
RATIO_GOAL, RATIO_LIMIT, GROUPS_GROWTH, ROAD_GROWTH, DRIVES_SECONDS = 10.0, 20.0, 1.1, 1.3, 60.0

Layers = dict[str, gpd.GeoDataFrame]
Figures = dict[str, Any]


class Case(NamedTuple):
    """One kind of input."""

    text: str
    #: Draws the layers of so many polylines.
    draw: Callable[[int], Layers]
    #: The growth exponent of the merge that is allowed.
    limit: float


def groups(count: int, *, footprints: bool, drives: int = 1) -> Layers:
    """Draw looks at lines far apart, `LOOKS` at each, every look from a local map of its own."""
    lines = max(1, count // LOOKS)
    layer = looks_at_lines(count, lines=lines)
    line, look = np.arange(count) % lines, np.arange(count) // lines
    layer = layer.assign(drive=(look % drives).astype(str), instance=np.arange(count))
    if not footprints:
        return {LOCAL_MAPS_LAYER: layer}
    x = 500_000 + 100.0 * (line % 100) + np.random.default_rng(1).uniform(5, 25, count)
    y = 5_400_000 + 50.0 * (line // 100) - 2.0
    return {LOCAL_MAPS_LAYER: layer, INSTANCES_LAYER: _instances(layer["drive"].to_numpy(), x, y)}


def road(count: int, *, again: bool, drives: bool = False) -> Layers:
    """Draw the looks of frames along one road at its lines: a road that grows, or the same one `again` and again."""
    rng = np.random.default_rng(0)
    frames = count // LINES
    frame = np.arange(frames)
    x = 500_000 + FRAME_SPACING * (frame % PLACES if again else frame) + rng.uniform(-2, 2, frames)
    y = np.full(frames, 5_400_000.0)
    names = (frame // PLACES if drives else np.zeros(frames, int)).astype(str)
    # Each frame errs as a whole, by a shift and a turn, and each vertex by itself.
    along = np.linspace(-AHEAD, AHEAD, VERTICES)
    shift, turn = rng.normal(0, 0.2, (2, frames, 1, 1)), np.radians(rng.normal(0, 0.3, (frames, 1, 1)))
    place = LINE_SPACING * (np.arange(LINES) - 1)[:, None]
    noise = rng.normal(0, 0.05, (2, frames, LINES, VERTICES))
    ahead, aside = along + shift[0] + noise[0], place + shift[1] + turn * along + noise[1]
    vertices = np.stack([x[:, None, None] + ahead, y[:, None, None] + aside], axis=3).reshape(-1, VERTICES, 2)
    seen_by = np.repeat(frame, LINES)
    columns = {"class": "divider", "drive": names[seen_by], "instance": seen_by}
    columns["score"] = rng.uniform(0.5, 1, len(seen_by))
    layer = gpd.GeoDataFrame(pd.DataFrame(columns), geometry=shapely.linestrings(vertices), crs=CRS)
    return {LOCAL_MAPS_LAYER: layer, INSTANCES_LAYER: _instances(names, x, y)}


def _instances(drive: NDArray[Any], x: NDArray[Any], y: NDArray[Any]) -> gpd.GeoDataFrame:
    """Return local maps that look east, numbered from 0."""
    columns = {"drive": drive, "instance": np.arange(len(x)), "x": x, "y": y, "heading": 90.0}
    boxes = shapely.box(x - AHEAD, y - ASIDE, x + AHEAD, y + ASIDE)
    return gpd.GeoDataFrame(pd.DataFrame(columns), geometry=boxes, crs=CRS)


CASES = {
    "groups": Case("groups of 15 looks", partial(groups, footprints=False), GROUPS_GROWTH),
    "groups-footprints": Case("the same with footprints", partial(groups, footprints=True), GROUPS_GROWTH),
    "groups-drives": Case("the same by 15 drives", partial(groups, footprints=True, drives=LOOKS), GROUPS_GROWTH),
    "road-longer": Case("one road, ever longer", partial(road, again=False), ROAD_GROWTH),
    "road-often": Case("the same 200 m, seen ever more often", partial(road, again=True), ROAD_GROWTH),
    "road-drives": Case("the same 200 m, by ever more drives", partial(road, again=True, drives=True), ROAD_GROWTH),
}


def measure(layers: Layers) -> Figures:
    """Time reading, merging and writing, in seconds, and geopandas writing and reading the same layers."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # What is done for the first time loads libraries.
        warm = {name: layer.head(30) for name, layer in layers.items()}
        _write_and_read(warm, folder / "warm.gpkg")
        pm.write_layers(folder / "warmed.gpkg", _merge(pm.read_local_maps([folder / "warm.gpkg"])).layers())
        load = os.getloadavg()[0]
        # The least of three: what disturbs it would flatter the merge.
        yardstick = min(_write_and_read(layers, folder / "local.gpkg") for _ in range(3))
        count = len(layers[LOCAL_MAPS_LAYER])
        clock = [time.perf_counter()]
        local = pm.read_local_maps([folder / "local.gpkg"])
        clock.append(time.perf_counter())
        busy = time.process_time()
        result = _merge(local)
        busy = time.process_time() - busy
        clock.append(time.perf_counter())
        pm.write_layers(folder / "merged.gpkg", result.layers())
        clock.append(time.perf_counter())
    seconds = dict(zip(STAGES, np.diff(clock).tolist(), strict=True))
    ratio = sum(seconds.values()) / yardstick
    sizes = {"polylines": count, "elements": len(result.elements)}
    more = {"yardstick": yardstick, "ratio": ratio, "merge_cpu": busy, "load": load, "peak_mb": peak_mb()}
    return sizes | seconds | more


def measure_drives(folder: Path) -> Figures:
    """Time placing, merging and writing all real drives, in seconds."""
    with tempfile.TemporaryDirectory() as name:
        clock = [time.perf_counter()]
        scenario = deecamp(folder)
        clock.append(time.perf_counter())
        result = _merge(scenario.local)
        clock.append(time.perf_counter())
        pm.write_layers(Path(name) / "merged.gpkg", result.layers())
        clock.append(time.perf_counter())
    seconds = dict(zip(STAGES, np.diff(clock).tolist(), strict=True))
    sizes = {"drives": len(scenario.local), "polylines": len(scenario.observations), "elements": len(result.elements)}
    return sizes | seconds | {"peak_mb": peak_mb()}


def _merge(local: list[pm.LocalMaps]) -> pm.MergeResult:
    return pm.merge(local, method="consensus")


def _write_and_read(layers: Layers, file: Path) -> float:
    start = time.perf_counter()
    for name, layer in layers.items():
        layer.to_file(file, layer=name, VERSION="1.3")
    for name in layers:
        gpd.read_file(file, layer=name, use_arrow=True)
    return time.perf_counter() - start


def measure_apart(case: str, what: str, memory: float) -> Figures:
    """Run one measurement in a process of its own; one that failed has `error`, the last line that it wrote."""
    command = [sys.executable, __file__, "--memory", str(memory), "--one", case, what]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode == 0:
        figures: Figures = json.loads(done.stdout)
        return figures
    said = done.stderr.strip().splitlines() or [f"ended with {done.returncode}"]
    return {"polylines": what, "error": said[-1]}


def table(case: Case, rows: list[Figures]) -> str:
    """Lay the figures of one case out: seconds, ratios to the yardstick, and growth against its limit."""
    lines = [f"{head(STAGES)}     all  merge's CPU   peak"]
    done = [row for row in rows if "error" not in row]
    for row in rows:
        if "error" in row:
            lines.append(f"{row['polylines']:>10} {row['error']}")
            continue
        rest = f"{row['ratio']:5.1f} x {row['merge_cpu']:10.2f} s {row['peak_mb']:6.0f} MB"
        lines.append(f"{cells(row, STAGES)} {rest}")
    if len(done) > 1:
        lines.append(exponents(done, STAGES))
        both = f"{growth(done, 'merge'):.2f}, its processor time with {growth(done, 'merge_cpu'):.2f}"
        lines.append(f"The merge grows with the power {both} (limit {case.limit}).")
    if done and case.limit == GROUPS_GROWTH:
        lines.append(f"All stages: {done[-1]['ratio']:.1f} x geopandas (goal {RATIO_GOAL:g}, limit {RATIO_LIMIT:g}).")
    return "\n".join(lines)


def main() -> None:
    """Measure what the command line asks for and print it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--groups", default="1000,10000,100000", help="polylines in groups of 15")
    parser.add_argument("--road", default="150,1500,15000", help="polylines along one road")
    parser.add_argument("--data", type=Path, help="folder of the real data; without it no real drives")
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES), help="cases to measure")
    parser.add_argument("--memory", type=float, default=16.0, help="gigabytes that a measurement may take (16)")
    parser.add_argument("-o", "--output", type=Path, help="JSON file for the figures")
    parser.add_argument("--one", nargs=2, metavar=("CASE", "COUNT"), help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.one:
        case, what = chosen.one
        resource.setrlimit(resource.RLIMIT_AS, (int(chosen.memory * 1e9),) * 2)
        print(json.dumps(measure_drives(Path(what)) if case == "drives" else measure(CASES[case].draw(int(what)))))
        return
    figures: dict[str, list[Figures]] = {}
    for name in chosen.only:
        sizes = chosen.groups if name.startswith("groups") else chosen.road
        figures[name] = [measure_apart(name, size, chosen.memory) for size in sizes.split(",") if size]
        print(f"{name}: {CASES[name].text}\n{table(CASES[name], figures[name])}\n", flush=True)
    if chosen.data is not None:
        figures["drives"] = [row := measure_apart("drives", str(chosen.data), chosen.memory)]
        seconds = row.get("error") or ", ".join(f"{stage} {row[stage]:.1f} s" for stage in STAGES)
        print(f"drives: {row.get('drives')} real drives: {seconds} (limit {DRIVES_SECONDS:g} s)")
    if chosen.output:
        chosen.output.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
