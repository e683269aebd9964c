"""How long each stage takes, against reading and writing the same layers with geopandas in the same run.

    python benchmarks/speed.py [--sizes 1000,10000,100000] [--hub 300,1000,3000] [--evaluate 1000,10000,100000]
        [-o speed.json]

Three cases. *Groups*: polylines of 20 vertices in independent groups of 15 looks at one line, so that the work grows
with the number of groups. *Hub*: all polylines in one connected component, where the published method inserts every
vertex into one base that keeps growing. *Evaluate*: as many elements as reference lines, against reading both layers.
Each size runs in a process of its own, whose peak memory is that of the whole run. Ratios and growth exponents are
what to compare; seconds depend on the machine.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

import polymerge_core as pm
from polymerge_core.options import Options
from polymerge_core.sets import find_network, order_sets

VERTICES = 20
LOOKS = 15
CRS = "EPSG:32632"
STAGES = ("read", "network", "merge", "write")


def looks_at_lines(count: int, *, lines: int) -> gpd.GeoDataFrame:
    """Draw looks at parallel lines 50 m apart, each look with noise of its own.

    Parameters
    ----------
    count : int
        Number of polylines.
    lines : int
        Number of true lines that they are looks at.

    Returns
    -------
    GeoDataFrame
        `class`, `drive`, `instance` (the number of the look), `score`, and LineStrings of `VERTICES` vertices.
    """
    rng = np.random.default_rng(0)
    line, look = np.arange(count) % lines, np.arange(count) // lines
    x = np.linspace(0, 30, VERTICES) + rng.normal(0, 0.05, (count, VERTICES)) + 100.0 * (line % 100)[:, None]
    y = rng.normal(0, 0.3, (count, VERTICES)) + 50.0 * (line // 100)[:, None]
    vertices = np.stack([x + 500_000, y + 5_400_000], axis=2)
    columns = {"class": "divider", "drive": "a", "instance": look, "score": rng.uniform(0.5, 1, count)}
    return gpd.GeoDataFrame(pd.DataFrame(columns), geometry=shapely.linestrings(vertices), crs=CRS)


def measure(count: int, *, lines: int) -> dict[str, float]:
    """Time the stages for one size, in seconds, with the peak memory of this process in megabytes."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        layer = looks_at_lines(count, lines=lines)
        # The yardstick: the same layer, read and written by geopandas alone. The first write loads the libraries.
        layer.head(1).to_file(folder / "warm.gpkg", layer="local_maps")
        gpd.read_file(folder / "warm.gpkg", use_arrow=True)
        pm.merge(layer.head(30), method="polymerge")
        start = time.perf_counter()
        layer.to_file(folder / "local.gpkg", layer="local_maps", VERSION="1.3")
        gpd.read_file(folder / "local.gpkg", use_arrow=True)
        yardstick = time.perf_counter() - start
        del layer

        clock = [time.perf_counter()]
        local = pm.read_local_maps([folder / "local.gpkg"])
        clock.append(time.perf_counter())
        order_sets(find_network(local, None, Options(), lambda *_: None, distances=False))
        clock.append(time.perf_counter())
        result = pm.merge(local, method="polymerge")
        clock.append(time.perf_counter())
        pm.write_layers(folder / "merged.gpkg", result.layers())
        clock.append(time.perf_counter())
        seconds = dict(zip(STAGES, np.diff(clock).tolist(), strict=True))
        # merge() finds the network again; what is left is the merging of shapes and the tables.
        seconds["merge"] -= seconds["network"]
    sizes = {"polylines": count, "elements": len(result.elements)}
    return sizes | {"yardstick": yardstick, **seconds, "peak_mb": peak_mb()}


def peak_mb() -> float:
    """Return the most memory that this process has taken, megabytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure_evaluation(count: int) -> dict[str, float]:
    """Time reading a map and its reference of as many lines, and evaluating the one against the other."""
    with tempfile.TemporaryDirectory() as name:
        files = [Path(name) / "reference.gpkg", Path(name) / "merged.gpkg"]
        for file, shift in zip(files, (0.0, 0.3), strict=True):
            layer = looks_at_lines(count, lines=count)
            layer.set_geometry(layer.translate(0.0, shift)).to_file(file, layer="elements", VERSION="1.3")
        pm.evaluate(layer.head(30), layer.head(30))
        del layer
        clock = [time.perf_counter()]
        for file in files:
            gpd.read_file(file)
        clock.append(time.perf_counter())
        reference, merged = (pm.read_local_maps([file]) for file in files)
        clock.append(time.perf_counter())
        pm.evaluate(merged, reference)
        clock.append(time.perf_counter())
        geopandas, read, evaluate = np.diff(clock).tolist()
    return {"polylines": count, "geopandas": geopandas, "read": read, "evaluate": evaluate, "peak_mb": peak_mb()}


def evaluation_table(rows: list[dict[str, float]]) -> str:
    """Lay the figures of evaluations out: seconds, and their ratio to reading both layers."""
    lines = [f"{'elements':>10} {'geopandas reads':>16} {'PolyMerge reads':>16} {'evaluate':>10}   peak"]
    for row in rows:
        ratios = " and ".join(f"{row['evaluate'] / row[reader]:.0f} x" for reader in ("geopandas", "read"))
        lines.append(
            f"{row['polylines']:>10} {row['geopandas']:14.2f} s {row['read']:14.2f} s {row['evaluate']:8.2f} s "
            f"{row['peak_mb']:6.0f} MB   {ratios} reading"
        )
    return "\n".join(lines)


def measure_apart(case: str, count: int) -> dict[str, float]:
    """Run one measurement in a process of its own."""
    command = [sys.executable, __file__, "--one", case, str(count)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return json.loads(done.stdout)


def growth(rows: list[dict[str, Any]], stage: str) -> float:
    """Return the exponent of growth between the smallest and the largest size, by least squares in the logarithms."""
    sizes = [math.log(row["polylines"]) for row in rows]
    return float(np.polyfit(sizes, [math.log(max(row[stage], 1e-6)) for row in rows], 1)[0])


def table(rows: list[dict[str, float]]) -> str:
    """Lay the figures out: seconds, and their ratio to the yardstick."""
    lines = [f"{head(STAGES)}   peak"]
    lines += [f"{cells(row, STAGES)} {row['peak_mb']:6.0f} MB" for row in rows]
    if len(rows) > 1:
        lines.append(exponents(rows, STAGES))
    return "\n".join(lines)


def head(stages: tuple[str, ...]) -> str:
    """Return the names of the columns of `cells`."""
    return f"{'polylines':>10} {'elements':>9} {'geopandas':>10} " + "".join(f"{stage:>17}" for stage in stages)


def cells(row: dict[str, Any], stages: tuple[str, ...]) -> str:
    """Return one size's row: how many lines, seconds, and their ratio to the yardstick."""
    each = "".join(f"{row[stage]:8.2f} s {row[stage] / row['yardstick']:5.1f} x" for stage in stages)
    return f"{row['polylines']:>10} {row['elements']:>9} {row['yardstick']:8.2f} s{each}"


def exponents(rows: list[dict[str, Any]], stages: tuple[str, ...]) -> str:
    """Return the row of the growth exponents."""
    each = "".join(f"{growth(rows, stage):17.2f}" for stage in stages)
    return f"{'growth':>10} {'':>9} {growth(rows, 'yardstick'):10.2f}{each}"


def main() -> None:
    """Measure what the command line asks for and print it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", default="1000,10000,100000", help="polylines in groups of 15")
    parser.add_argument("--hub", default="300,1000,3000", help="polylines in one component")
    parser.add_argument("--evaluate", default="1000,10000,100000", help="elements against as many reference lines")
    parser.add_argument("-o", "--output", type=Path, help="JSON file for the figures")
    parser.add_argument("--one", nargs=2, metavar=("CASE", "COUNT"), help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.one:
        case, count = chosen.one[0], int(chosen.one[1])
        lines = 1 if case == "hub" else max(1, count // LOOKS)
        print(json.dumps(measure_evaluation(count) if case == "evaluate" else measure(count, lines=lines)))
        return
    figures = {}
    for case, sizes in (("groups", chosen.sizes), ("hub", chosen.hub), ("evaluate", chosen.evaluate)):
        figures[case] = [measure_apart(case, int(size)) for size in sizes.split(",") if size]
        layout = evaluation_table if case == "evaluate" else table
        if figures[case]:
            print(f"{case}\n{layout(figures[case])}\n")
    if chosen.output:
        chosen.output.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
