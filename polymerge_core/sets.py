"""From layers to the sets that become one element each, and the order in which each is merged.

This is what every merge method starts from: the observations, the network between them (paper, Alg. 1), its
connected components, and in each the base polyline with the others breadth-first behind it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import Any, TypeAlias

import geopandas as gpd
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from polymerge_core.errors import SchemaError
from polymerge_core.network import Edges, breadth_first_depth, components, merge_edges
from polymerge_core.observations import Observations, as_lines, observe
from polymerge_core.options import Options
from polymerge_core.schema import LocalMaps

#: Features of the first layer that are looked at for the warning that they stay apart.
_LOOKED_AT = 1000

#: Called with the fraction done (0 to 1) and what is being done; may raise to stop the work.
Progress = Callable[[float, str], object]

#: What the public functions take as local maps and as a main map.
Input: TypeAlias = gpd.GeoDataFrame | LocalMaps | Sequence[gpd.GeoDataFrame | LocalMaps]


@dataclass(frozen=True)
class Network:
    """Who is to be merged with whom.

    Parameters
    ----------
    observations : Observations
        The nodes, by their position in the table.
    edges : Edges
        Pairs of positions.
    component : ndarray of int, shape (n,)
        The set of each observation.
    """

    observations: Observations
    edges: Edges
    component: NDArray[np.intp]


@dataclass(frozen=True)
class ElementSets:
    """The components, with the order in which their members are merged."""

    #: Component of each observation.
    component: NDArray[np.intp]
    #: Base observation of each component.
    base: NDArray[np.intp]
    #: All observations, component by component, each in the order of merging (the base first).
    order: NDArray[np.intp]
    #: Where each component starts in `order`, and the end.
    bounds: NDArray[np.intp]


def find_network(
    local_maps: Input,
    main_map: Input | None,
    options: Options,
    progress: Progress,
    *,
    distances: bool,
) -> Network:
    """Read layers and find the pairs to be merged (paper, Alg. 1), one class at a time.

    Parameters
    ----------
    local_maps, main_map
        As in `polymerge_core.merge`.
    options : Options
        Columns, classes, CRS and proximity.
    progress : callable
        Called with fractions from 0 to 0.4.
    distances : bool
        Whether to measure the distance of each pair.

    Returns
    -------
    Network
        Observations, edges and components.

    Raises
    ------
    SchemaError, CrsError, InputError
        If a layer cannot be used.
    """
    progress(0.0, "reading the layers")
    main: list[LocalMaps] = [] if main_map is None else as_local_maps(main_map, "main_map")
    observations = observe(as_local_maps(local_maps, "local_maps"), main, options)
    progress(0.1, "looking for neighbours")
    edges = _edges(observations, options, progress, distances=distances)
    note_layers_apart(observations, options)
    return Network(observations, edges, components(len(observations.table), edges))


def order_sets(network: Network) -> ElementSets:
    """Choose the base of every component and the order in which the rest is merged into it.

    The base is the main map's polyline (of the first instance, where there is no main map), the longest where
    there are several; where there is none, the longest of the earliest instance. The rest follows breadth-first,
    by instance, then by normalised WKB.

    Parameters
    ----------
    network : Network
        From `find_network`.

    Returns
    -------
    ElementSets
        One set for each component.
    """
    table, component = network.observations.table, network.component
    position = np.arange(len(table))
    # The earliest instance's longest observation; the main map comes before all instances. Rounding keeps
    # equally long lines equally long wherever the map lies.
    preference = np.lexsort((position, -table["length_m"].round(6), table["group"], component))
    _, starts = np.unique(component[preference], return_index=True)
    base = preference[starts]
    depth = breadth_first_depth(len(table), network.edges, base)
    # Positions are in the order of instances, then of normalised WKB.
    order = np.lexsort((position, depth, component))
    return ElementSets(component, base, order, np.append(starts, len(table)).astype(np.intp))


def note_layers_apart(observations: Observations, options: Options) -> None:
    """Say when features of one layer stay apart only because the layer was taken for one local map.

    Parameters
    ----------
    observations : Observations
        The warning is added to their notes.
    options : Options
        Whether the user chose so, and the proximity.
    """
    table = observations.table
    if options.instance_from is not None or table.empty:
        return
    first = table["group"] == table["group"].min()
    rows = table[first & (table["instance_kind"] == "layer") & ~table["is_main"]]
    # A look at the start of the layer is enough to tell, and it must cost little beside the merge.
    rows = rows.head(_LOOKED_AT)
    lines = as_lines(rows["shape"].to_numpy())
    apart = 0
    for members in rows.reset_index(drop=True).groupby(["class", "is_area"], sort=True).indices.values():
        none = np.zeros(len(members), dtype=bool)
        apart += len(merge_edges(lines[members], none, options.proximity, distances=False).first)
    if apart:
        source = rows["source"].iloc[0]
        observations.notes["warnings"].append(
            f"{apart} pairs of features within layer {source!r} are near each other and got no edge, because each "
            "layer counts as one local map where there are several; instance_from=feature takes each feature for one"
        )


def _edges(observations: Observations, options: Options, progress: Progress, *, distances: bool) -> Edges:
    """Find the pairs to merge, one class at a time, as positions in the table."""
    table, lines = observations.table, observations.lines
    # The first instance in time is the main map where none is given (paper, section II-B).
    is_main = (table["group"] == table["group"].min()).to_numpy()
    done = 0

    def advance(count: int) -> None:
        nonlocal done
        done += count
        progress(0.1 + 0.3 * done / len(table), "looking for neighbours")

    found = [Edges.none()]
    for _, group in table.groupby(["class", "is_area"], sort=True):
        rows: NDArray[np.intp] = group.index.to_numpy(dtype=np.intp)
        edges = merge_edges(lines[rows], is_main[rows], options.proximity, distances=distances, advance=advance)
        found.append(Edges(rows[edges.first], rows[edges.second], edges.distance))
    return Edges(*(np.concatenate(column) for column in zip(*found, strict=True)))


def as_local_maps(layers: Any, name: str) -> list[LocalMaps]:
    """Return one GeoDataFrame, GeoSeries or LocalMaps, or several, as a list of LocalMaps.

    Parameters
    ----------
    layers : GeoDataFrame, GeoSeries, LocalMaps, or iterable of them
        What a public function was given.
    name : str
        Source of a layer that has no name of its own; numbered where there are several.

    Returns
    -------
    list of LocalMaps
        The layers themselves are not copied.

    Raises
    ------
    SchemaError
        If one is something else.
    """
    if isinstance(layers, (gpd.GeoDataFrame, gpd.GeoSeries, LocalMaps)):
        return [_as_one(layers, name)]
    if isinstance(layers, (str, bytes, Mapping, pd.DataFrame)) or not isinstance(layers, Iterable):
        raise _not_a_layer(layers, name)
    return [_as_one(layer, f"{name}_{number}") for number, layer in enumerate(layers, start=1)]


def _as_one(layer: Any, name: str) -> LocalMaps:
    if isinstance(layer, LocalMaps):
        # Without a name of its own it must not pass for another one without a name.
        return replace(layer, source=name) if not layer.source else layer
    if isinstance(layer, gpd.GeoSeries):
        return LocalMaps(layer.to_frame("geometry"), source=name)
    if isinstance(layer, gpd.GeoDataFrame):
        return LocalMaps(layer, source=name)
    raise _not_a_layer(layer, name)


def _not_a_layer(given: Any, name: str) -> SchemaError:
    """Return the error for what is no layer, with what to give instead."""
    advice = "give a GeoDataFrame, LocalMaps, or a list of them"
    if hasattr(given, "as_main_map"):
        advice = "give its .as_main_map() as main map, or its .elements as any other layer"
    elif isinstance(given, Mapping):
        advice = "give one of its layers, or a list of them"
    elif isinstance(given, pd.DataFrame):
        advice = "it has no geometry; give a GeoDataFrame"
    elif isinstance(given, (str, bytes, PurePath)):
        advice = "read it with read_local_maps"
    return SchemaError(f"{name} is a {type(given).__name__}; {advice}")
