"""How exact the consensus is: against one look, the peers and the oracle, and whether its map grows with the looks.

    python benchmarks/accuracy.py [--data FOLDER] [--seeds N] [--only NAME ...] [-o accuracy.json]

FOLDER holds Argoverse 2 logs, through which drives are simulated; without it the simulated town stands in. There is one
table for each noise model, then the rules that the consensus is held to: ``rule: measured vs limit: met / not met``.
With --only the consensus and the oracle are measured all the same: the rules are about them.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

# Run as a file, the folder of the project is not where Python looks.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import polymerge_core as pm
from benchmarks import peers
from benchmarks.noise import Noise
from benchmarks.rules import ORACLE, SINGLE, SUBJECT, Verdict, judge, judge_growth
from benchmarks.scenarios import FRAMES, MIAMI, PITTSBURGH, SPACING_M, Road, Scenario, av2_road, held_whole, town_road
from polymerge_core.schema import AREA_CLASSES

NOISES = {
    "errors independent between frames": Noise(),
    "half of the error variance common to the drive": replace(Noise(), pose_drive_share=0.5, shape_drive_share=0.5),
}
LEGEND = f"""{peers.LEGEND}
PCM partial curve mapping, best match. {SINGLE}: each frame's observations by themselves, where that frame
observed something, means over the frames; DF and IoU of the crossings that the frame holds whole."""

#: How many times as many frames see the same road.
MORE = 10


def single_instances(scenario: Scenario) -> dict[str, dict[str, float]]:
    """Measure what one frame by itself gives.

    Parameters
    ----------
    scenario : Scenario
        One drive, with its true ids.

    Returns
    -------
    dict
        For each class the figures of `peers.figures_of` with the frame as the only local map, means over the frames.
    """
    (local,) = scenario.local
    frames = local.observations["instance"]
    # A crossing that the edge of the frame cuts off can be compared with no true ring.
    cut = ~held_whole(scenario)
    found = []
    for frame in frames.unique():
        here = frames == frame
        figures = _frame_figures(scenario, local, here, pcm=True)
        if (here & cut).any():
            whole = _frame_figures(scenario, local, here & ~cut, pcm=False)
            for name in AREA_CLASSES & set(figures):
                figures[name] |= {column: whole[name][column] for column in ("DF", "IoU")}
        found.append(figures)
    return {name: pd.DataFrame([figures[name] for figures in found]).mean().to_dict() for name in found[0]}


def _frame_figures(
    scenario: Scenario, local: pm.LocalMaps, rows: pd.Series, *, pcm: bool
) -> dict[str, dict[str, float]]:
    seen, instances = local.observations[rows], local.instances
    if instances is not None:
        instances = instances[instances["instance"].isin(seen["instance"])]
    alone = replace(local, observations=seen, instances=instances)
    return peers.figures_of(seen, scenario.truth, [alone], pcm=pcm)


def measure(scenarios: Sequence[Scenario], chosen: Sequence[peers.Peer], *, noise: str) -> pd.DataFrame:
    """Measure single instances and the maps of peers; rows as those of `peers.measure`, with the PCM of all."""
    singles = [
        {"run": run, "scenario": scenario.name, "peer": SINGLE, "class": name, **figures, "s": np.nan, "reason": ""}
        for run, scenario in enumerate(_told(scenarios, f"{noise}: {SINGLE}"))
        for name, figures in single_instances(scenario).items()
    ]
    maps = peers.draw_all(_told(scenarios, f"{noise}: drawing"), chosen)
    figures = peers.measure(_told(scenarios, f"{noise}: measuring"), maps, pcm=True)
    return pd.concat([pd.DataFrame(singles), figures], ignore_index=True)


def _told(scenarios: Sequence[Scenario], what: str) -> Iterator[Scenario]:
    """Give scenarios one by one, and tell of each where the work is."""
    for number, scenario in enumerate(scenarios, start=1):
        print(f"{what}, {scenario.name} ({number} of {len(scenarios)})", file=sys.stderr, flush=True)
        yield scenario


def growth(roads: Mapping[str, Road], seeds: Sequence[int], noise: Noise) -> pd.DataFrame:
    """Count what the consensus draws of ten times as many frames between the same start and end.

    Returns
    -------
    DataFrame
        One row a road, way to ten times the frames and seed: `road`, `way`, `seed`, and the elements from `few` and
        from `many` frames.
    """
    rows = []
    for road, seed in ((road, seed) for road in roads for seed in seeds):
        print(f"growth: {road}, seed {seed} of {len(seeds)}", file=sys.stderr, flush=True)
        drive = roads[road].drive
        # Passes differ in their errors alone; the first is the one that few frames are of.
        passes = [drive(f"pass {number}", seed=seed + 1000 * number, noise=noise) for number in range(MORE)]
        spacing = (FRAMES - 1) * SPACING_M / (MORE * FRAMES - 1)
        dense = drive("dense", seed=seed, noise=noise, count=MORE * FRAMES, spacing=spacing)
        few = _elements(passes[:1])
        ways = {f"one drive of {MORE * FRAMES} frames": [dense], f"{MORE} drives of {FRAMES} frames": passes}
        rows += [
            {"road": road, "way": way, "seed": seed, "few": few, "many": _elements(drives)}
            for way, drives in ways.items()
        ]
    return pd.DataFrame(rows)


def _elements(drives: Sequence[Scenario]) -> int:
    return len(pm.merge([maps for drive in drives for maps in drive.local], method="consensus").elements)


def main() -> int:
    """Run the command line; return the exit status."""
    kept = (SUBJECT, ORACLE)
    names = [peer.name for peer in peers.PEERS if peer.name not in kept]
    chosen = peers.command_line(__doc__.splitlines()[0], names).parse_args()
    compared = [peer for peer in peers.PEERS if not chosen.only or peer.name in (*chosen.only, *kept)]
    seeds = peers.seeds_of(chosen)
    logs = {} if chosen.data is None else {"Miami": MIAMI, "Pittsburgh": PITTSBURGH}
    roads = {name: av2_road(chosen.data, log) for name, log in logs.items()} or {"town": town_road()}
    verdicts: dict[str, list[Verdict]] = {}
    written: dict[str, dict[str, Any]] = {}
    print(f"{LEGEND}\n")
    for name, noise in NOISES.items():
        scenarios = peers.simulated(chosen.data, seeds, noise)
        figures = measure(scenarios, compared, noise=name)
        print(f"{name}: {peers.described(scenarios, seeds)}\n\n{peers.table(figures)}\n", flush=True)
        counts = growth(roads, seeds, noise)
        independent = noise.pose_drive_share == noise.shape_drive_share == 0
        rules, growing = judge(figures, independent=independent), judge_growth(counts)
        verdicts |= {f"rules, {name}": rules, f"growth, {name}": growing}
        judged = pd.DataFrame([{**vars(each), "outcome": each.outcome} for each in (*rules, *growing)])
        tables = {"figures": figures, "growth": counts, "verdicts": judged}
        written[name] = {table: peers.records(rows) for table, rows in tables.items()}
    for name, found in verdicts.items():
        outcomes = [each.outcome for each in found]
        tally = ", ".join(f"{outcomes.count(each)} {each}" for each in dict.fromkeys(outcomes))
        print("\n".join([f"{name}: {tally}", *map(str, found), ""]))
    if chosen.output:
        chosen.output.write_text(json.dumps(written, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
