"""The merge network as the user sees it: a networkx graph, and layers for a GIS."""

from __future__ import annotations

from typing import Any

import geopandas as gpd
import networkx as nx
import numpy as np
import pandas as pd
import shapely

from polymerge_core.observations import as_lines
from polymerge_core.options import Options
from polymerge_core.sets import Input, Progress, find_network


def merge_network(
    local_maps: Input,
    main_map: Input | None = None,
    *,
    progress: Progress | None = None,
    **options: Any,
) -> nx.Graph:
    """Find which observations the published method merges with each other (paper, Alg. 1).

    The consensus has no such network: it does not merge all that hangs together (`merge`).

    Parameters
    ----------
    local_maps, main_map
        As in `merge`.
    progress : callable, optional
        Called with the fraction done and a message; may raise to stop the work.
    **options
        `proximity` (Th_prox), the columns and the CRS, as in `merge`.

    Returns
    -------
    networkx.Graph
        A node for each observation, in canonical order, with `source`, `source_fid`, `drive`, `instance`, `class`,
        `is_main`, `component` (number of the set that becomes one element) and `geometry` (in the output CRS,
        ``graph.graph["crs"]``); an edge for each pair to be merged, with its `distance` in metres.

    Raises
    ------
    OptionError, SchemaError, CrsError, InputError
        As in `merge`.
    """
    network = find_network(local_maps, main_map, Options.of(**options), progress or (lambda *_: None), distances=True)
    observations, edges = network.observations, network.edges
    table = observations.table
    columns = ["source", "source_fid", "drive", "instance", "class", "is_main"]
    geometry = observations.to_output(table["shape"].to_numpy())
    nodes = table[columns].assign(component=network.component, geometry=geometry)
    graph = nx.Graph(crs=observations.out_crs, left_out=observations.left_out)
    graph.add_nodes_from(zip(range(len(nodes)), nodes.to_dict("records"), strict=True))
    pairs = zip(edges.first.tolist(), edges.second.tolist(), edges.distance.tolist(), strict=True)
    graph.add_weighted_edges_from(pairs, weight="distance")
    return graph


def network_layers(graph: nx.Graph) -> dict[str, gpd.GeoDataFrame]:
    """Turn a merge network into layers that a GIS can show.

    Parameters
    ----------
    graph : networkx.Graph
        From `merge_network`.

    Returns
    -------
    dict of GeoDataFrame
        `edges`: a line between the middles of the two observations, with `from_observation`, `to_observation`,
        `class`, `component` and `distance_m`; `observations`: each as a line, with its `component`.
    """
    nodes = pd.DataFrame.from_dict(dict(graph.nodes(data=True)), orient="index")
    if nodes.empty:
        nodes = pd.DataFrame(columns=["source", "source_fid", "drive", "instance", "class", "component", "geometry"])
    lines = as_lines(nodes.pop("geometry").to_numpy(dtype=object))
    # In a part of a graph the nodes keep their names, which are no longer positions.
    ends = nodes.index.get_indexer(np.array(list(graph.edges()), dtype=np.intp).ravel()).reshape(-1, 2)
    nodes.insert(0, "observation", nodes.index.to_numpy())
    middle = shapely.get_coordinates(shapely.line_interpolate_point(lines, 0.5, normalized=True))
    edges = pd.DataFrame(
        {
            "from_observation": nodes["observation"].to_numpy()[ends[:, 0]],
            "to_observation": nodes["observation"].to_numpy()[ends[:, 1]],
            "class": nodes["class"].to_numpy()[ends[:, 0]],
            "component": nodes["component"].to_numpy()[ends[:, 0]],
            "distance_m": [distance for _, _, distance in graph.edges(data="distance")],
        }
    )
    crs = graph.graph["crs"]
    links = shapely.linestrings(middle[ends]) if len(ends) else []
    return {
        "edges": gpd.GeoDataFrame(edges, geometry=links, crs=crs),
        "observations": gpd.GeoDataFrame(nodes.drop(columns="is_main", errors="ignore"), geometry=lines, crs=crs),
    }
