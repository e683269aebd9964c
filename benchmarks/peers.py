"""The same observations through what a user would otherwise take, and through the library's own methods.

    python -m benchmarks.peers [--data FOLDER] [--seeds N] [--only NAME ...] [-o peers.json]

FOLDER holds Argoverse 2 logs, through which three drives are simulated; without it the simulated town stands in. Each
peer makes a map of each scenario, which is measured against the true map and timed. The table has the means over
scenarios and seeds. A peer that is not installed has the way to install it in its row: all but QGIS come with
``pip install .[benchmarks]``.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd

# Run as a file, the folder of the project is not where Python looks.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import polymerge_core as pm
from benchmarks import rivals
from benchmarks.noise import CLASS_NAMES
from benchmarks.scenarios import Scenario, av2_scenarios, held_whole, town
from polymerge_core.options import METHODS
from polymerge_core.schema import AREA_CLASSES

#: Columns of the table, and the measures of `polymerge_core.evaluate` that are in them.
MEASURES = {
    "DF": "frechet_best",
    "AP": "ap",
    "AP.5": "ap_0.5",
    "AP1": "ap_1.0",
    "AP1.5": "ap_1.5",
    "F1.5": "f1_0.5",
    "F1": "f1_1.0",
    "recall": "recall_1.0",
    "dupl": "duplication",
    "fragm": "fragments",
    "zigzag": "zigzag",
    "(true)": "zigzag_reference",
    "lateral": "lateral_median",
    "IoU": "iou",
}
LEGEND = """\
n elements; DF discrete Frechet distance to the best match, m; AP mean average precision, and that at a Chamfer distance
of 0.5, 1.0 and 1.5 m; F1 by length within 0.5 m and 1.0 m, recall within 1.0 m; dupl times that a place is drawn; fragm
elements along one true element; zigzag turning, rad/m, and that of the true map; lateral median error, m; IoU of areas;
s seconds for all classes of a scenario. Means over the runs."""
COLUMNS = ("n", *MEASURES, "s")


@dataclass(frozen=True)
class Peer:
    """A way to make a map of a scenario's observations.

    Attributes
    ----------
    name : str
        What a table calls it.
    draw : callable
        Takes a scenario and gives a map: `class`, `score` and shapes. Only the oracle may look at the truth.
    areas : bool
        Whether it makes areas too.
    """

    name: str
    draw: Callable[[Scenario], gpd.GeoDataFrame]
    areas: bool = True


@dataclass(frozen=True)
class Drawn:
    """What came of a peer and a scenario: a map and the seconds that it took, or the reason why there is none."""

    map: gpd.GeoDataFrame | None
    seconds: float = np.nan
    reason: str = ""
    #: Whether a class of areas that is not in the map is missing there.
    areas: bool = True


def _of_observations(name: str, rival: Callable[[gpd.GeoDataFrame], gpd.GeoDataFrame], *, areas: bool = True) -> Peer:
    return Peer(name, lambda scenario: rival(scenario.observations), areas)


def _oracle(scenario: Scenario) -> gpd.GeoDataFrame:
    truth, whole = scenario.truth, held_whole(scenario)
    return rivals.average_true_groups(scenario.observations, scenario.true_ids, truth, whole)


def _merged(method: str, scenario: Scenario) -> gpd.GeoDataFrame:
    return pm.merge(scenario.local, method=method).elements


#: In the order of the table. A new method of the library appears by itself.
PEERS = (
    _of_observations("raw concatenation", rivals.concatenate),
    _of_observations("best score (NMS)", rivals.keep_best_score),
    _of_observations("longest (Map NMS)", rivals.keep_longest),
    _of_observations("buffer centreline", rivals.buffer_centreline),
    _of_observations("neatnet", rivals.neatnet_streets, areas=False),
    _of_observations("parenx skeleton", rivals.parenx_skeleton, areas=False),
    _of_observations("parenx voronoi", rivals.parenx_voronoi, areas=False),
    _of_observations("QGIS native tools", rivals.qgis_chain),
    *(Peer(f"method {method}", partial(_merged, method)) for method in METHODS),
    Peer("oracle average", _oracle),
)


def draw(peer: Peer, scenario: Scenario) -> Drawn:
    """Let a peer make its map of a scenario, with the time that it took."""
    start = time.perf_counter()
    try:
        made = peer.draw(scenario)
    except rivals.RivalError as error:
        return Drawn(None, reason=str(error))
    return Drawn(made, time.perf_counter() - start, areas=peer.areas)


def draw_all(scenarios: Iterable[Scenario], peers: Sequence[Peer] = PEERS) -> list[dict[str, Drawn]]:
    """Return what came of each peer, by its name, scenario by scenario."""
    found: list[dict[str, Drawn]] = []
    for scenario in scenarios:
        if not found:
            # The first use of a package loads it, which is not what is timed.
            missing = [peer.name for peer in peers if draw(peer, scenario).map is None]
            print(f"without a map: {', '.join(missing) or 'none'}", file=sys.stderr)
        found.append({peer.name: draw(peer, scenario) for peer in peers})
    return found


def measure(scenarios: Sequence[Scenario], maps: Sequence[Mapping[str, Drawn]]) -> pd.DataFrame:
    """Measure maps against the true maps.

    Parameters
    ----------
    scenarios : sequence of Scenario
        Local maps over true maps.
    maps : sequence of mapping
        For each scenario what came of each peer, by its name.

    Returns
    -------
    DataFrame
        One row a scenario, peer and class of the truth: `run` (number of the scenario), `scenario`, `peer`, `class`,
        `n`, the columns of `MEASURES`, `s`, `reason`. NaN where there is no map, or it leaves areas out.
    """
    rows = []
    for run, (scenario, drawn) in enumerate(zip(scenarios, maps, strict=True)):
        for peer, made in drawn.items():
            rows += [
                {"run": run, "scenario": scenario.name, "peer": peer, "class": name, **values}
                | {"s": made.seconds, "reason": made.reason}
                for name, values in _figures(scenario, made).items()
            ]
    figures: pd.DataFrame = pd.DataFrame(rows)
    return figures


def _figures(scenario: Scenario, made: Drawn) -> dict[str, dict[str, float]]:
    """Return the figures of a map for each class of the truth."""
    figures = {name: dict.fromkeys(["n", *MEASURES], np.nan) for name in CLASS_NAMES}
    figures = {name: values for name, values in figures.items() if (scenario.truth["class"] == name).any()}
    if made.map is None:
        return figures
    result = pm.evaluate(made.map, scenario.truth, local_maps=scenario.local)
    known = result.table.set_index(["class", "measure"])["value"].to_dict()
    for name, values in figures.items():
        if made.areas or name not in AREA_CLASSES:
            values["n"] = float((made.map["class"] == name).sum())
            values |= {column: float(known.get((name, measure), np.nan)) for column, measure in MEASURES.items()}
    return figures


def table(figures: pd.DataFrame) -> str:
    """Lay the means over all runs out, one table a class, one row a peer.

    Parameters
    ----------
    figures : DataFrame
        From `measure`.

    Returns
    -------
    str
        A peer without any map has the reason in its row; one without a map in some runs has their number there.
    """
    parts = []
    for name, rows in figures.groupby("class", sort=False):
        columns = [column for column in COLUMNS if rows[column].notna().any()]
        head = f"{'':<20}" + "".join(f"{column:>8}" for column in columns)
        lines = [f"{peer:<20}" + _row(runs, columns) for peer, runs in rows.groupby("peer", sort=False)]
        parts.append("\n".join([str(name), head, *lines]))
    return "\n\n".join(parts)


def _row(runs: pd.DataFrame, columns: list[str]) -> str:
    """Return the cells of one peer and class, from its rows of all runs."""
    without = runs["reason"] != ""
    reasons = " / ".join(sorted(set(runs.loc[without, "reason"])))
    if without.all():
        return f"  {reasons}"
    if runs["n"].isna().all():
        return "  leaves areas out"
    cells = "".join(_cell(column, value) for column, value in runs[columns].mean().items())
    return cells + (f"  in {(~without).sum()} of {len(runs)} runs; {reasons}" if without.any() else "")


def _cell(column: object, value: float) -> str:
    if np.isnan(value):
        return f"{'-':>8}"
    return f"{value:8.1f}" if column == "n" else f"{value:8.3f}" if value < 0.1 else f"{value:8.2f}"


def main() -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="folder of the real data; the simulated town without it")
    parser.add_argument("--seeds", type=int, help="how many seeds of the simulated errors (3 with --data, else 1)")
    parser.add_argument("--only", nargs="+", choices=[peer.name for peer in PEERS], help="these peers alone")
    parser.add_argument("-o", "--output", type=Path, help="JSON file for the figures of every run")
    chosen = parser.parse_args()
    seeds = range(1, 1 + (chosen.seeds or (1 if chosen.data is None else 3)))
    runs = [[town(seed)] if chosen.data is None else av2_scenarios(chosen.data, seed=seed) for seed in seeds]
    scenarios = [scenario for run in runs for scenario in run]
    peers = [peer for peer in PEERS if not chosen.only or peer.name in chosen.only]
    figures = measure(scenarios, draw_all(scenarios, peers))
    names = ", ".join(dict.fromkeys(scenario.name for scenario in scenarios))
    print(f"{names}; {len(seeds)} seeds; {len(scenarios)} runs\n{LEGEND}\n\n{table(figures)}")
    if chosen.output:
        known = figures.astype(object).where(figures.notna(), None)
        chosen.output.write_text(json.dumps(known.to_dict("records"), indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
