"""The canonical order of instances and observations, and duplicates.

Nothing may depend on where a feature stands in a file. Instances are ordered by the first timestamp of their
drive, drive, timestamp and instance; those without names of their own (a whole layer, a single feature) by
their content. Observations of one instance are ordered by their normalised WKB.
"""

from __future__ import annotations

import re
from collections.abc import Hashable
from typing import Any

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

_DIGITS = re.compile(r"(\d+)")


def canonical_order(parts: pd.DataFrame, attributes: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Sort observations by content and find the ones that occur twice.

    Parameters
    ----------
    parts : DataFrame
        Usable observations with the columns of `polymerge_core.observations.Observations.table`.
    attributes : DataFrame
        The user's columns, by the number in ``parts["feature"]``: the last resort where all else is equal.

    Returns
    -------
    table : DataFrame
        The observations, main map first, with the columns `group` (0, 1, ... for the local maps in order, -1 for
        the main map) and `key` (rank of the normalised WKB) added; the index is the canonical position.
    duplicates : DataFrame
        Observations that repeat class and geometry of another one of the same local map, with a reason.
    """
    shapes = parts["shape"].to_numpy()
    # The normalised form forgets the direction of digitisation, the raw one settles equal forms.
    _, key = np.unique(shapely.to_wkb(shapely.normalize(shapes)), return_inverse=True)
    _, exact = np.unique(shapely.to_wkb(shapes), return_inverse=True)
    parts = parts.assign(key=key, exact=exact)
    parts["tie"] = _tie_break(parts, attributes)
    parts["content"] = parts.groupby(["key", "class", "exact", "tie"]).ngroup()
    parts["rank"] = _instance_rank(parts)
    parts = parts.sort_values(["rank", "content", "from_m"], kind="stable").reset_index(drop=True)
    twice = parts.duplicated(["is_main", "drive", "instance", "class", "key"]) & ~parts["is_main"]
    duplicates = parts[twice].assign(reason="duplicate")
    table = parts[~twice].reset_index(drop=True)
    table["group"] = _group_in_order(table)
    return table.drop(columns=["rank", "content", "exact", "tie"]), duplicates


def natural_key(text: str) -> tuple[tuple[int, int, str], ...]:
    """Return a sort key that puts ``frame 9`` before ``frame 10``.

    Examples
    --------
    >>> sorted(["b2", "b10", "a3"], key=natural_key)
    ['a3', 'b2', 'b10']
    """
    pieces = [piece for piece in _DIGITS.split(text) if piece]
    # A number is its length without zeros in front, then its digits: as int() would order it, at any length.
    keys = ((0, len(piece.lstrip("0")), piece.lstrip("0")) if piece.isdecimal() else (1, 0, piece) for piece in pieces)
    # The text itself comes last, so that "01" and "1" differ; the -1 puts "a" before "a1".
    return (*keys, (-1, 0, text))


def _instance_rank(parts: pd.DataFrame) -> NDArray[np.intp]:
    """Rank the local maps; equal content without a name has equal rank, the main map rank -1."""
    names = ["is_main", "instance_kind", "drive", "instance"]
    if _all_alike(parts, names):
        return np.full(len(parts), -1 if parts["is_main"].iloc[0] else 0, dtype=np.intp)
    group = parts.groupby(names, sort=False).ngroup().to_numpy()
    drive_start = parts.groupby("drive")["timestamp_ns"].transform("min").to_numpy()
    first = pd.DataFrame(
        {
            "drive_start": drive_start,
            "kind": parts["instance_kind"],
            "drive": parts["drive"],
            "time": parts["timestamp_ns"],
            "instance": parts["instance"],
            "is_main": parts["is_main"],
        }
    )
    instances = first.groupby(group).agg(
        {
            "drive_start": "first",
            "kind": "first",
            "drive": "first",
            "time": "min",
            "instance": "first",
            "is_main": "first",
        }
    )
    if len(instances) == len(parts) and not (instances["kind"] == "column").any():
        # Features that are a local map each: the same keys as below, without a loop over all of them.
        keyed = parts[["timestamp_ns", "key", "content"]].assign(local=~parts["is_main"], start=drive_start)
        return keyed.groupby(["local", "start", "timestamp_ns", "key", "content"]).ngroup().to_numpy()
    if (instances["kind"] == "column").all():
        ranked = instances.assign(local=~instances["is_main"].astype(bool))
        for name in ("drive", "instance"):
            ranked[name] = natural_rank(instances[name])
        keyed = ranked.groupby(["local", "drive_start", "drive", "time", "instance"])
        return keyed.ngroup().to_numpy()[group]
    # The normalised WKB of all observations first; where it is the same, class, direction and columns.
    content = zip(_sorted_by(group, parts["key"]), _sorted_by(group, parts["content"]), strict=True)
    keys: list[tuple[Any, ...]] = []
    for row, own in zip(instances.itertuples(index=False), content, strict=True):
        named = row.kind == "column"
        drive = natural_key(row.drive) if named else ()
        instance: Hashable = natural_key(row.instance) if named else own
        keys.append((not row.is_main, row.drive_start, not named, drive, row.time, instance))
    ranks = {key: rank for rank, key in enumerate(sorted(set(keys)))}
    rank = np.array([ranks[key] for key in keys], dtype=np.intp)
    return rank[group] if len(rank) else np.empty(0, np.intp)


def _all_alike(table: pd.DataFrame, names: list[str]) -> bool:
    """Whether all rows have the same values in some columns, as those of a single local map have."""
    columns = (table[name].to_numpy(dtype=object) for name in names)
    return len(table) > 0 and all((column == column[0]).all() for column in columns)


def natural_rank(texts: pd.Series[str]) -> NDArray[np.intp]:
    """Rank texts as `natural_key` orders them."""
    codes, names = pd.factorize(texts)
    if all(map(str.isdecimal, names)):
        bare = [name.lstrip("0") for name in names]
        size = np.array([len(name) for name in bare], dtype=np.intp)
        order = np.lexsort((np.array(names, dtype=str), np.array(bare, dtype=str), size))
    else:
        order = np.array(sorted(range(len(names)), key=lambda number: natural_key(names[number])), dtype=np.intp)
    rank = np.empty(len(names), np.intp)
    rank[order] = np.arange(len(names))
    return rank[codes]


def _sorted_by(group: NDArray[np.intp], values: pd.Series[int]) -> list[tuple[int, ...]]:
    """Return the values of each group, sorted."""
    order = np.lexsort((values, group))
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    return [tuple(part.tolist()) for part in np.split(values.to_numpy()[order], starts[1:])] if len(group) else []


def _tie_break(parts: pd.DataFrame, attributes: pd.DataFrame) -> NDArray[np.object_]:
    """Return a text that tells apart observations whose class and geometry are the same."""
    tie = np.full(len(parts), "", dtype=object)
    same = parts.duplicated(["class", "exact"], keep=False).to_numpy()
    if not same.any():
        return tie
    own = parts.loc[same, ["as_polygon", "score", "main_id", "weight", "looks"]].to_numpy(dtype=object).tolist()
    values = attributes.iloc[parts.loc[same, "feature"]].itertuples(index=False, name=None)
    tie[same] = [repr((*row, *map(str, theirs))) for row, theirs in zip(own, values, strict=True)]
    return tie


def _group_in_order(table: pd.DataFrame) -> NDArray[np.intp]:
    """Give each local map the number of its first observation, -1 to the main map."""
    if _all_alike(table, ["is_main", "drive", "instance", "instance_kind"]):
        return np.full(len(table), -1 if table["is_main"].iloc[0] else 0, dtype=np.intp)
    local = table[~table["is_main"]]
    codes = local.groupby(["drive", "instance", "instance_kind"], sort=False).ngroup()
    group = np.full(len(table), -1, dtype=np.intp)
    group[codes.index] = codes.to_numpy()
    return group
