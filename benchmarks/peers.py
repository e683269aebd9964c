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
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd

# Run as a file, the folder of the project is not where Python looks.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import polymerge_core as pm
from benchmarks import rivals
from benchmarks.noise import CLASS_NAMES, Noise
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
#: Takes seconds a map, so that only who asks for it gets it.
PCM = {"PCM": "pcm_best"}
COLUMNS = ("n", *MEASURES, *PCM, "s")


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


def measure(scenarios: Iterable[Scenario], maps: Sequence[Mapping[str, Drawn]], *, pcm: bool = False) -> pd.DataFrame:
    """Measure maps against the true maps.

    Parameters
    ----------
    scenarios : iterable of Scenario
        Local maps over true maps.
    maps : sequence of mapping
        For each scenario what came of each peer, by its name.
    pcm : bool, default False
        Whether to work out the partial curve mapping too.

    Returns
    -------
    DataFrame
        One row a scenario, peer and class of the truth: `run` (number of the scenario), `scenario`, `peer`, `class`,
        `n`, the columns of `MEASURES`, and of `PCM` where asked, `s`, `reason`. NaN where there is no map, or it leaves
        areas out.
    """
    rows = []
    for run, (scenario, drawn) in enumerate(zip(scenarios, maps, strict=True)):
        for peer, made in drawn.items():
            rows += [
                {"run": run, "scenario": scenario.name, "peer": peer, "class": name, **values}
                | {"s": made.seconds, "reason": made.reason}
                for name, values in _figures(scenario, made, pcm=pcm).items()
            ]
    figures: pd.DataFrame = pd.DataFrame(rows)
    return figures


def _figures(scenario: Scenario, made: Drawn, *, pcm: bool) -> dict[str, dict[str, float]]:
    """Return the figures of a map for each class of the truth."""
    if made.map is None:
        return {name: dict.fromkeys(["n", *MEASURES], np.nan) for name in _classes(scenario.truth)}
    figures = figures_of(made.map, scenario.truth, scenario.local, pcm=pcm)
    for name, values in figures.items():
        if name in AREA_CLASSES and not made.areas:
            values.update(dict.fromkeys(values, np.nan))
    return figures


def figures_of(
    layer: gpd.GeoDataFrame, truth: gpd.GeoDataFrame, local: list[pm.LocalMaps], *, pcm: bool = False
) -> dict[str, dict[str, float]]:
    """Measure one map against the true map, where the local maps looked.

    Parameters
    ----------
    layer, truth : GeoDataFrame
        The map and the true map.
    local : list of LocalMaps
        What was seen.
    pcm : bool, default False
        Whether to work out the partial curve mapping.

    Returns
    -------
    dict
        For each class of the truth `n` and the columns of `MEASURES`, and of `PCM` where asked.
    """
    result = pm.evaluate(layer, truth, local_maps=local, pcm=pcm)
    known = result.table.set_index(["class", "measure"])["value"].to_dict()
    measures = MEASURES | (PCM if pcm else {})
    return {
        name: {"n": float((layer["class"] == name).sum())}
        | {column: float(known.get((name, measure), np.nan)) for column, measure in measures.items()}
        for name in _classes(truth)
    }


def _classes(truth: gpd.GeoDataFrame) -> list[str]:
    return [name for name in CLASS_NAMES if (truth["class"] == name).any()]


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
        columns = [column for column in COLUMNS if column in rows and rows[column].notna().any()]
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


def command_line(description: str, names: Sequence[str]) -> argparse.ArgumentParser:
    """Return the command line of a comparison of some peers, by name."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--data", type=Path, help="folder of the real data; the simulated town without it")
    parser.add_argument("--seeds", type=int, help="how many seeds of the simulated errors (3 with --data, else 1)")
    parser.add_argument("--only", nargs="+", choices=names, help="of the peers these alone")
    parser.add_argument("-o", "--output", type=Path, help="JSON file for the figures of every run")
    return parser


def seeds_of(chosen: argparse.Namespace) -> range:
    """Return the seeds of the simulated errors that the command line asks for."""
    return range(1, 1 + (chosen.seeds or (1 if chosen.data is None else 3)))


def simulated(data: Path | None, seeds: Iterable[int], noise: Noise | None = None) -> list[Scenario]:
    """Return the scenarios of all seeds: those in the folder of the real data, or the town where none is given."""
    runs = [[town(seed, noise)] if data is None else av2_scenarios(data, seed=seed, noise=noise) for seed in seeds]
    return [scenario for run in runs for scenario in run]


def described(scenarios: Sequence[Scenario], seeds: Sequence[int]) -> str:
    """Say what the means are over."""
    names = ", ".join(dict.fromkeys(scenario.name for scenario in scenarios))
    return f"{names}; {len(seeds)} seeds; {len(scenarios)} runs"


def records(figures: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows of a table ready for JSON, which knows no NaN."""
    known = figures.astype(object).where(figures.notna(), None).to_dict("records")
    return [{str(column): value for column, value in row.items()} for row in known]


def main() -> int:
    """Run the command line; return the exit status."""
    chosen = command_line(__doc__.splitlines()[0], [peer.name for peer in PEERS]).parse_args()
    seeds = seeds_of(chosen)
    scenarios = simulated(chosen.data, seeds)
    peers = [peer for peer in PEERS if not chosen.only or peer.name in chosen.only]
    figures = measure(scenarios, draw_all(scenarios, peers))
    print(f"{described(scenarios, seeds)}\n{LEGEND}\n\n{table(figures)}")
    if chosen.output:
        chosen.output.write_text(json.dumps(records(figures), indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
