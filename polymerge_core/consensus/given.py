"""What a consensus starts from: observations and local maps in the terms of looks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from polymerge_core.consensus.areas import Areas, merge_looks_at_areas
from polymerge_core.consensus.drift import Drift
from polymerge_core.consensus.instances import read_instances
from polymerge_core.consensus.known import KnownAreas
from polymerge_core.consensus.looks import Instances, Looks
from polymerge_core.consensus.main_map import remembered
from polymerge_core.consensus.registration import centres, moved_by
from polymerge_core.curves import Array, Index
from polymerge_core.errors import InputError
from polymerge_core.observations import Observations
from polymerge_core.options import Options
from polymerge_core.schema import LocalMaps

#: More steps than this along all observations are a proximity that is too small for them (some 500 bytes each).
MOST_POINTS = 20_000_000

#: A score of 0 still counts this much, so that something comes of observations that all have it.
_LEAST_WEIGHT = 1e-3


@dataclass(frozen=True)
class Given:
    """Observations in the terms of looks.

    Parameters
    ----------
    table : DataFrame
        The observations.
    instances : Instances
        The local maps.
    instance, weight : ndarray, shape (n,)
        The local map of each observation, and how much it counts.
    lines, areas : list of (str, ndarray of int)
        The classes in order, and the observations of each.
    unit : float
        The proximity, metres.
    """

    table: pd.DataFrame
    instances: Instances
    instance: Index
    weight: Array
    lines: list[tuple[str, Index]]
    areas: list[tuple[str, Index]]
    unit: float
    past: Array

    def looks_of(self, rows: Index) -> Looks:
        """Return the looks of one class of lines."""
        shapes = self.table["shape"].to_numpy(dtype=object)
        looks = Looks.of(shapes[rows], self.instance[rows], self.weight[rows], self.instances, self.unit)
        return looks.remembering(self.past[rows][looks.owner])

    def followed(self, looks: list[Looks], corrections: Array, drift: Drift) -> NDArray[np.object_]:
        """Return the shapes of all observations, areas moved as the lines say that their local maps were off."""
        shapes = self.table["shape"].to_numpy(dtype=object, copy=True)
        rows = np.concatenate([rows for _, rows in self.areas]) if self.areas else np.empty(0, np.intp)
        if looks and len(rows):
            centre = centres(looks, len(self.instances))
            known = self._known(rows)
            new, old = rows[~known], rows[known]
            shapes[new] = moved_by(shapes[new], self.instance[new], corrections, centre)
            shapes[old] = drift.followed(shapes[old], self.instances.drive[self.instance[old]])
        return shapes

    def merge_areas(self, shapes: NDArray[np.object_], rows: Index, before: KnownAreas | None = None) -> Areas:
        """Merge one class of areas, given the shapes of all observations and, without a main map, what was known."""
        known = self._known(rows)
        new, old = rows[~known], rows[known]
        if len(old):
            before = KnownAreas(shapes[old], self.weight[old], np.ones(len(old), bool), self.past[old, 1:])
        areas = merge_looks_at_areas(
            shapes[new], self.instance[new], self.weight[new], self.instances, self.unit, before
        )
        element = np.empty(len(rows), np.intp)
        element[np.argsort(known, kind="stable")] = areas.element[: len(rows)]
        return areas._replace(element=element)

    def _known(self, rows: Index) -> NDArray[np.bool_]:
        """Tell elements of the main map from new observations."""
        return np.asarray(self.instance[rows] == self.instances.known)


def read_looks(observations: Observations, local_maps: Sequence[LocalMaps], options: Options) -> Given:
    """Put observations in the terms of looks.

    Parameters
    ----------
    observations : Observations
        All of them, main map first.
    local_maps : sequence of LocalMaps
        Where they came from, with what is known of the local maps.
    options : Options
        The proximity.

    Raises
    ------
    InputError
        If the proximity is too small for so much length.
    SchemaError
        If it cannot be told which local map a footprint is of.
    """
    table = observations.table
    points = float(table.loc[~table["is_area"], "length_m"].sum()) / options.proximity
    if points > MOST_POINTS:
        raise InputError(
            f"{points / 1e6:.0f} million steps of the proximity ({options.proximity:g} m) lie along the observations, "
            f"more than the {MOST_POINTS / 1e6:.0f} million that memory is sure to hold; choose a larger proximity, or "
            "merge the data in parts"
        )
    instances, instance = read_instances(observations, local_maps, options.proximity)
    weight = table["weight"].to_numpy(dtype=float) * np.maximum(table["score"].to_numpy(dtype=float), _LEAST_WEIGHT)
    is_area = table["is_area"].to_numpy(dtype=bool)
    lines, areas = (_by_class(table, np.flatnonzero(kind)) for kind in (~is_area, is_area))
    past = remembered(table, instance, instances.drive, options.proximity)
    return Given(table, instances, instance, weight, lines, areas, options.proximity, past)


def _by_class(table: pd.DataFrame, rows: Index) -> list[tuple[str, Index]]:
    """Return the classes of some observations in order, and which are of each."""
    groups = table.iloc[rows].groupby("class").indices
    return [(str(name), rows[np.asarray(members)]) for name, members in sorted(groups.items())]
