"""What is known of a map, as sums that new observations are added to: merging on without what was merged before.

A `State` holds the lines and areas of every class, also those that too few local maps saw so far, as `KnownLines` and
`KnownAreas` do: at every station of a line how much is known of it, how many local maps and drives saw it, and how many
should have. What is added to it and what is known are registered to each other, each shifted by its share: by the
number of drives behind it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import pyproj
import shapely

from polymerge_core.consensus.areas import Areas
from polymerge_core.consensus.axes import Axes
from polymerge_core.consensus.drift import Drift
from polymerge_core.consensus.given import Given, read_looks
from polymerge_core.consensus.known import KnownAreas, KnownLines
from polymerge_core.consensus.lines import merge_lines
from polymerge_core.consensus.looks import Looks
from polymerge_core.consensus.support import Support, means, shapes_of, succession, supported_stretches
from polymerge_core.errors import CrsError, OptionError
from polymerge_core.observations import as_lines, observe
from polymerge_core.options import Options
from polymerge_core.sets import Input, as_local_maps

#: Of the structure; a later one can read what an earlier one wrote, or says that it cannot.
VERSION = 1


@dataclass(frozen=True)
class State:
    """All that a consensus needs to go on with new observations.

    Attributes
    ----------
    crs : pyproj.CRS
        Projected, metres; of all coordinates in it.
    proximity : float
        The scale that the lines were merged at, metres.
    lines : mapping of str to KnownLines
        By class: stations one proximity apart, and what is known of each.
    areas : mapping of str to KnownAreas
        By class: outlines, and what is known of each.
    looked : shapely.Geometry or None
        What the local maps looked at; None where that is not known.
    version : int
        Of this structure.
    """

    crs: pyproj.CRS
    proximity: float
    lines: Mapping[str, KnownLines]
    areas: Mapping[str, KnownAreas]
    looked: shapely.Geometry | None
    version: int = VERSION

    def elements(self) -> gpd.GeoDataFrame:
        """Return the map: what was seen often enough.

        Returns
        -------
        GeoDataFrame
            `class`, `seen` and `expected` (local maps that saw it, and that should have, in the mean), `score` (how
            surely one that looks there sees it, by the rule of succession), `sigma_m` (median standard error; NaN of
            areas) and the shape: a LineString, closed for areas.
        """
        parts = [_line_elements(name, lines) for name, lines in sorted(self.lines.items())]
        parts += [_area_elements(name, areas) for name, areas in sorted(self.areas.items())]
        columns = ["class", "seen", "expected", "sigma_m", "geometry"]
        table = pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=columns)
        table["score"] = succession(*table[["seen", "expected"]].to_numpy(dtype=float).T)
        return gpd.GeoDataFrame(table, geometry="geometry", crs=self.crs)


def accumulate(local_maps: Input, state: State | None = None, **options: Any) -> State:
    """Merge local maps by consensus, onto what is known from others.

    Merging A and then adding B gives nearly what merging A and B at once gives: what B would have said of the poses of
    A is not heard any more.

    Parameters
    ----------
    local_maps : GeoDataFrame, LocalMaps or a list of them
        New observations; local maps that the state knows already are counted once more.
    state : State, optional
        What is known from others.
    **options
        As `polymerge_core.merge` takes them. The proximity is the state's, and the working CRS must be.

    Returns
    -------
    State
        A new one.

    Raises
    ------
    CrsError
        If the observations are worked on in another CRS than the state's.
    OptionError
        If the proximity is another one than the state's, or the state is of another version.
    """
    if state is not None and state.version != VERSION:
        raise OptionError(f"the state is of version {state.version}; this program goes on with version {VERSION}")
    chosen = Options.of(**({"proximity": state.proximity} if state else {}) | options)
    if state is not None and chosen.proximity != state.proximity:
        raise OptionError(f"proximity is {chosen.proximity:g} m; the state was made with {state.proximity:g} m")
    layers = as_local_maps(local_maps, "local_maps")
    observations = observe(layers, [], chosen)
    if state is not None and observations.crs != state.crs:
        raise CrsError(
            f"the new observations are merged in {observations.crs.name}, the state is in {state.crs.name}; "
            "reproject the observations to the CRS of the state"
        )
    return _added(read_looks(observations, layers, chosen), state, observations.crs)


def _added(given: Given, state: State | None, crs: pyproj.CRS) -> State:
    looked = None if given.instances.footprint is None else shapely.union_all(given.instances.footprint)
    if state is not None:
        given = replace(given, instances=given.instances.with_known(state.looked))
        looked = None if looked is None or state.looked is None else shapely.union(looked, state.looked)
    names, looks = _looks(given, state)
    lines, corrections, drift = merge_lines(looks, lambda _: None)
    shapes = given.followed(looks, corrections, drift)
    before = {} if state is None else {name: _shifted(areas, drift, given) for name, areas in state.areas.items()}
    new = dict(given.areas)
    nothing = np.empty(0, np.intp)
    areas: dict[str, Areas] = {
        name: given.merge_areas(shapes, new.get(name, nothing), before.get(name)) for name in sorted({*new, *before})
    }
    return State(
        crs,
        given.unit,
        {name: each.known for name, each in zip(names, lines, strict=True)},
        {name: each.known for name, each in areas.items()},
        looked,
    )


def _shifted(areas: KnownAreas, drift: Drift, given: Given) -> KnownAreas:
    """Return known areas shifted as the lines about them."""
    drive = np.full(len(areas.polygons), given.instances.drive[given.instances.known])
    return areas._replace(polygons=drift.followed(areas.polygons, drive))


def _looks(given: Given, state: State | None) -> tuple[list[str], list[Looks]]:
    """Return the classes of lines, new and known, and the looks at each; what is known comes last."""
    new, known = dict(given.lines), {} if state is None else state.lines
    names = sorted(name for name in {*new, *known} if name in new or len(known[name].line))
    found = []
    for name in names:
        parts = [given.looks_of(new[name])] if name in new else []
        if name in known and len(known[name].line):
            parts.append(known[name].looks(given.instances, given.unit))
        found.append(parts[0] if len(parts) == 1 else parts[0].and_also(parts[1]))
    return names, found


def _line_elements(name: str, known: KnownLines) -> pd.DataFrame:
    axes, support = Axes(known.stations, known.line), Support(*known.past[:, 1:].T)
    found = supported_stretches(axes, support)
    # A bridged gap has nothing that is known of it.
    error = 1 / np.sqrt(np.maximum(known.past[:, 0], np.finfo(float).tiny))
    sigma, seen, expected = means(support, error, found)
    columns = {"class": name, "seen": seen, "expected": expected, "sigma_m": sigma}
    return pd.DataFrame({**columns, "geometry": list(shapes_of(known.stations, found, 0.0))})


def _area_elements(name: str, known: KnownAreas) -> pd.DataFrame:
    support = Support(*known.support.T)
    rows = np.flatnonzero(support.enough)
    columns = {"class": name, "seen": support.seen[rows], "expected": support.expected[rows], "sigma_m": np.nan}
    return pd.DataFrame({**columns, "geometry": list(as_lines(known.polygons[rows]))})
