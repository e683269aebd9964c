"""The rules that the consensus is held to: its figures beside those of one look, of the peers and of the oracle."""

from __future__ import annotations

import operator
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.scenarios import FRAMES
from polymerge_core.schema import AREA_CLASSES

#: Rows of the table that the rules speak of; all others are peers.
SUBJECT, ORACLE, SINGLE = "method consensus", "oracle average", "single instance"

#: A peer that draws places more often than this makes no map, and is not compared.
DRAWN_ONCE = 1.2
_SIGNS = {">": operator.gt, ">=": operator.ge, "<": operator.lt, "<=": operator.le}

#: The columns of one class, row by row.
Rows = Mapping[Any, Mapping[Any, float]]


@dataclass(frozen=True)
class Verdict:
    """A figure held against a limit by a sign of `_SIGNS`."""

    rule: str
    measured: float
    sign: str
    limit: float

    @property
    def outcome(self) -> str:
        """Met or not met; not judged where there is no limit, as where no peer can be compared."""
        if np.isnan(self.limit):
            return "not judged"
        # A limit that is a sum must not fail by its last bit.
        return "met" if _SIGNS[self.sign](round(self.measured, 9), round(self.limit, 9)) else "not met"

    def __str__(self) -> str:
        return f"{self.rule}: {self.measured:.3f} vs {self.sign} {self.limit:.3f}: {self.outcome}"


def judge(figures: pd.DataFrame, *, independent: bool) -> list[Verdict]:
    """Hold the consensus to the rules, class by class.

    Parameters
    ----------
    figures : DataFrame
        One row a run, peer and class: `class`, `peer` and the columns of the table. The means over the runs
        count.
    independent : bool
        Whether the errors of the frames have nothing in common, so that averaging must take them away.

    Returns
    -------
    list of Verdict
    """
    means = figures.groupby(["class", "peer"], sort=False).mean(numeric_only=True)
    found = []
    for name in means.index.unique("class"):
        rows = means.loc[name].to_dict("index")
        found += _above_peers(str(name), rows) + _beside_oracle(str(name), rows)
        found += _of_areas(str(name), rows) if name in AREA_CLASSES else _of_lines(str(name), rows)
        if name == "divider" and independent:
            limit = 0.55 * rows[SINGLE]["DF"]
            found.append(Verdict(f"{name} DF at most 0.55 of the {SINGLE}'s", rows[SUBJECT]["DF"], "<=", limit))
    return found


def _above_peers(name: str, rows: Rows) -> list[Verdict]:
    """Hold the average precision against one look, and against the best peer that draws each place once."""
    others = {peer: row for peer, row in rows.items() if peer not in (SUBJECT, ORACLE, SINGLE)}
    often = {peer: row["dupl"] for peer, row in others.items() if row["dupl"] > DRAWN_ONCE}
    precision = {peer: row["AP"] for peer, row in others.items() if peer not in often and not np.isnan(row["AP"])}
    best = max(precision, key=precision.__getitem__, default="none")
    left_out = ", ".join(f"{peer} {times:.2f}" for peer, times in often.items())
    rule = f"{name} AP above every peer that draws a place at most {DRAWN_ONCE} times, the best being {best}"
    rule += f" (not compared: {left_out})" if often else ""
    measured = rows[SUBJECT]["AP"]
    return [
        Verdict(f"{name} AP above the {SINGLE}'s", measured, ">", rows[SINGLE]["AP"]),
        Verdict(rule, measured, ">", precision.get(best, np.nan)),
    ]


def _beside_oracle(name: str, rows: Rows) -> list[Verdict]:
    ours, oracle = rows[SUBJECT], rows[ORACLE]
    return [
        *(
            Verdict(f"{name} {column} at most 0.02 under the oracle's", ours[column], ">=", oracle[column] - 0.02)
            for column in ("AP", "F1.5", "F1", "recall")
        ),
        Verdict(f"{name} DF at most 1.05 of the oracle's", ours["DF"], "<=", 1.05 * oracle["DF"]),
        *(
            # A NaN of the oracle's must stay one: there is nothing to hold the map against.
            Verdict(f"{name} {words}", ours[column], "<=", float(np.maximum(1.05, oracle[column] + 0.03)))
            for column, words in (("dupl", "duplication"), ("fragm", "fragments"))
        ),
    ]


def _of_areas(name: str, rows: Rows) -> list[Verdict]:
    measured = rows[SUBJECT]["IoU"]
    return [
        Verdict(f"{name} IoU not under the oracle's", measured, ">=", rows[ORACLE]["IoU"]),
        Verdict(f"{name} IoU above the {SINGLE}'s", measured, ">", rows[SINGLE]["IoU"]),
    ]


def _of_lines(name: str, rows: Rows) -> list[Verdict]:
    ours = rows[SUBJECT]
    return [
        Verdict(f"{name} PCM under the {SINGLE}'s", ours["PCM"], "<", rows[SINGLE]["PCM"]),
        Verdict(f"{name} zigzag", ours["zigzag"], "<=", float(np.maximum(1.5 * ours["(true)"], 0.02))),
    ]


def judge_growth(counts: pd.DataFrame) -> list[Verdict]:
    """Hold the counts from `growth` to the rule: the sum over the seeds, road by road and way by way."""
    found = []
    for (road, way), rows in counts.groupby(["road", "way"], sort=False):
        told = ", ".join(f"{many}/{few}" for many, few in zip(rows["many"], rows["few"], strict=True))
        rule = f"{road}, elements of {way} over those of {FRAMES} frames ({told})"
        found.append(Verdict(rule, rows["many"].sum() / rows["few"].sum(), "<=", 1.3))
    return found
