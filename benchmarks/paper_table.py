"""The paper's table on real maps and drives: single instances and merged maps, the paper's figures beside ours.

Run it from the project's folder: ``python -m benchmarks.paper_table --data FOLDER``. FOLDER holds Argoverse 2 logs and,
for real predictions, the sets ``deecamp`` and ``openlane_persformer``; without it the simulated town stands in for all.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

# Run as a file, the folder of the project is not where Python looks.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import polymerge_core as pm
from benchmarks.noise import CLASS_NAMES
from benchmarks.scenarios import Scenario, av2_scenarios, deecamp, held_whole, openlane, overlap, town
from polymerge_core.options import METHODS

#: Sayed, Perminov, Tsetserukou, "PolyMerge", section IV: PCM and DF (metres) of crossings, dividers, boundaries.
PAPER = {
    ("S1", "single"): (1.06, 0.20, 0.26, 1.30, 0.49, 1.65),
    ("S1", "merged"): (0.63, 0.77, 1.71, 0.91, 0.59, 1.21),
    ("S2", "single"): (1.33, 0.43, 0.23, 0.88, 0.27, 2.30),
    ("S2", "merged"): (1.26, 0.18, 0.53, 1.25, 0.35, 1.02),
    ("S3", "single"): (1.10, 0.08, 0.43, 0.76, 0.67, 1.21),
    ("S3", "merged"): (0.22, 0.58, 0.93, 1.03, 0.86, 1.43),
}
#: Confidence from which on the paper uses a detection.
MIN_SCORE = 0.8
PAIRINGS = ("best", "check")
COLUMNS = [f"{measure} {name}" for measure in ("PCM", "DF") for name in ("ped", "div", "bou")]
#: Measures of the table of real predictions.
REAL = (
    "frechet_best",
    "lateral_median",
    "lateral",
    "lateral_p95",
    "lateral_beyond",
    "duplication",
    "recall_0.5",
    "recall_1.0",
    "zigzag",
)


def paper_rows(scenario: Scenario, *, pcm: bool) -> dict[str, dict[str, list[float]]]:
    """Return PCM and DF of the single instances and of every method's map, by pairing.

    Parameters
    ----------
    scenario : Scenario
        Local maps over a true map.
    pcm : bool
        Whether to work out the PCM.

    Returns
    -------
    dict
        By row (``single``, without the crossings that the edge of the frame cuts, or a method) and pairing, the means
        in the order of `COLUMNS`.
    """
    seen = scenario.observations
    maps = {"single": seen[(seen["score"] >= MIN_SCORE) & held_whole(scenario)]}
    maps |= {method: pm.merge(scenario.local, method=method, min_score=MIN_SCORE).elements for method in METHODS}
    found: dict[str, dict[str, list[float]]] = {}
    for row, layer in maps.items():
        result = pm.evaluate(layer, scenario.truth, local_maps=scenario.local, pcm=pcm)
        found[row] = {pairing: _means(result, pairing, pcm=pcm) for pairing in PAIRINGS}
    return found


def _means(result: pm.Evaluation, pairing: str, *, pcm: bool) -> list[float]:
    frechet = [_known(result, name, f"frechet_{pairing}") for name in CLASS_NAMES]
    mapped = [_known(result, name, f"pcm_{pairing}") for name in CLASS_NAMES] if pcm else [np.nan] * 3
    return [*mapped, *frechet]


def _known(result: pm.Evaluation, name: str, measure: str) -> float:
    try:
        return result.value(name, measure)
    except KeyError:
        return np.nan


def paper_table(runs: list[list[Scenario]], *, pcm: bool) -> tuple[str, dict[str, Any]]:
    """Measure the scenarios of every seed and lay the table out, means over the seeds beside the paper's figures."""
    measured = [{scenario.name: paper_rows(scenario, pcm=pcm) for scenario in scenarios} for scenarios in runs]
    names = list(measured[0])
    rows: list[dict[str, Any]] = []
    for name in [*names, "mean"]:
        for row in ("single", *METHODS):
            known = PAPER if name == "mean" else {key: value for key, value in PAPER.items() if key[0] == name}
            theirs = [value for key, value in known.items() if key[1] == ("single" if row == "single" else "merged")]
            rows.append(_row(name, row, "paper", np.mean(theirs, axis=0) if theirs else [np.nan] * 6))
            for pairing in PAIRINGS:
                chosen = names if name == "mean" else [name]
                ours = np.array([[run[each][row][pairing] for each in chosen] for run in measured])
                rows.append(_row(name, row, f"ours, {pairing}", pd.DataFrame(ours.reshape(-1, 6)).mean()))
    table = pd.DataFrame(rows)
    single = table[(table["scenario"] == "mean") & (table["map"] == "single")].set_index("figures")[COLUMNS[3:]]
    ratio = single.loc["ours, best"] / single.loc["paper"]
    within = ", ".join(
        f"{name} {value:.2f} ({'yes' if abs(value - 1) <= 0.25 else 'no'})" for name, value in ratio.items()
    )
    per_seed = [
        np.nanmean([run[name]["single"]["best"][3:] for name in names], axis=0).round(2).tolist() for run in measured
    ]
    text = table.to_string(index=False, float_format="%.2f", na_rep="-")
    text += f"\n\nsingle instances, DF against the paper's mean (within 25 %): {within}"
    text += f"\nsingle instances, DF of each seed (ped, div, bou): {per_seed}"
    return text, {"paper": table.to_dict("records"), "single_seeds": per_seed}


def _row(scenario: str, row: str, figures: str, values: Any) -> dict[str, Any]:
    return {"scenario": scenario, "map": row, "figures": figures, **dict(zip(COLUMNS, map(float, values), strict=True))}


def real_table(scenario: Scenario) -> tuple[str, list[dict[str, Any]]]:
    """Measure real predictions, raw and merged, against the known map, where they saw it."""
    rows = []
    maps = {"raw": scenario.observations}
    seconds = {"raw": 0.0}
    for method in METHODS:
        start = time.perf_counter()
        maps[method] = pm.merge(scenario.local, method=method).elements
        seconds[method] = time.perf_counter() - start
    for row, layer in maps.items():
        result = pm.evaluate(layer, scenario.truth, region=_observed(scenario), crs="local")
        for name in sorted(set(scenario.truth["class"])):
            values = {measure: _known(result, name, measure) for measure in REAL}
            rows.append(
                {"map": row, "class": name, "n": int((layer["class"] == name).sum()), **values, "merge_s": seconds[row]}
            )
    return pd.DataFrame(rows).to_string(index=False, float_format="%.2f", na_rep="-"), rows


def _observed(scenario: Scenario) -> Any:
    """Return the area within two metres of any observation."""
    return scenario.observations.geometry.buffer(2.0)


def main() -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="folder of the real data; the simulated town without it")
    parser.add_argument("--seeds", type=int, default=3, help="how many seeds of the simulated errors (3)")
    parser.add_argument("--no-pcm", action="store_true", help="leave the PCM out")
    parser.add_argument("--no-real-predictions", action="store_true", help="leave deecamp and openlane out")
    parser.add_argument("-o", "--output", type=Path, help="JSON file for the figures")
    chosen = parser.parse_args()
    seeds = range(1, chosen.seeds + 1)
    runs = [[town(seed)] if chosen.data is None else av2_scenarios(chosen.data, seed=seed) for seed in seeds]
    if chosen.data is not None:
        print(f"S2 and S3 have {overlap(chosen.data):.1f} m of their 49 m in common")
    text, figures = paper_table(runs, pcm=not chosen.no_pcm)
    print(text, flush=True)
    if chosen.data is not None and not chosen.no_real_predictions:
        for scenario in (openlane(chosen.data), deecamp(chosen.data)):
            text, figures[scenario.name] = real_table(scenario)
            print(
                f"\n{scenario.name}: {len(scenario.observations)} observations of {len(scenario.local)} drives\n{text}",
                flush=True,
            )
    if chosen.output:
        chosen.output.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
