"""The merge network as users see it: a graph, and layers for a GIS."""

from __future__ import annotations

import geopandas as gpd
import networkx as nx
import pytest
from shapely import LineString, Polygon

from polymerge_core import LocalMaps, OptionError, merge, merge_network, network_layers
from polymerge_core.crs import LOCAL_CRS


def line(y, length=10.0):
    return LineString([(0, y), (length, y)])


@pytest.fixture
def looks():
    """Three looks in a chain, one of another class beside them, one far away, one without a geometry."""
    return gpd.GeoDataFrame(
        {"class": ["divider"] * 3 + ["boundary", "divider", "divider"], "frame": range(6)},
        geometry=[line(0), line(0.75), line(1.25), line(0.1), line(50), None],
        index=range(10, 16),
    )


@pytest.fixture
def graph(looks):
    return merge_network(LocalMaps(looks, source="monday"), crs="local", instance_field="frame")


class TestMergeNetwork:
    def test_has_a_node_for_each_observation(self, graph):
        assert sorted(fid for _, fid in graph.nodes(data="source_fid")) == [10, 11, 12, 13, 14]
        assert list(graph.nodes) == [0, 1, 2, 3, 4]

    def test_has_an_edge_for_each_pair_with_its_distance(self, graph):
        fid = dict(graph.nodes(data="source_fid"))
        found = {tuple(sorted((fid[i], fid[j]))): d for i, j, d in graph.edges(data="distance")}
        assert found == {(10, 11): 0.75, (11, 12): 0.5}

    def test_nodes_tell_where_they_come_from(self, graph):
        node = next(data for _, data in graph.nodes(data=True) if data["source_fid"] == 13)
        assert {key: node[key] for key in ("source", "drive", "instance", "class", "is_main")} == {
            "source": "monday",
            "drive": "monday",
            "instance": "3",
            "class": "boundary",
            "is_main": False,
        }
        assert node["geometry"].equals_exact(line(0.1))

    def test_components_are_those_of_the_graph(self, graph):
        for members in nx.connected_components(graph):
            assert len({graph.nodes[member]["component"] for member in members}) == 1
        assert len({number for _, number in graph.nodes(data="component")}) == 3

    def test_components_are_the_elements_of_the_published_method(self, looks, graph):
        lineage = merge(looks, crs="local", instance_field="frame", method="polymerge").lineage
        merged = {frozenset(fids) for fids in lineage.groupby("element_id")["source_fid"].agg(list)}
        fid = dict(graph.nodes(data="source_fid"))
        assert {frozenset(fid[node] for node in members) for members in nx.connected_components(graph)} == merged

    def test_knows_its_crs_and_what_was_left_out(self, graph):
        assert graph.graph["crs"] == LOCAL_CRS
        assert graph.graph["left_out"]["reason"].tolist() == ["no geometry"]

    def test_elements_of_a_main_map_are_nodes_without_edges_among_them(self, looks):
        main = gpd.GeoDataFrame({"class": ["divider"] * 2}, geometry=[line(0), line(0.2)])
        graph = merge_network(looks.iloc[:1], main, crs="local")
        is_main = dict(graph.nodes(data="is_main"))
        assert sum(is_main.values()) == 2
        assert all(not (is_main[i] and is_main[j]) for i, j in graph.edges)
        assert graph.number_of_edges() == 2

    def test_distance_of_areas_is_that_of_their_rings(self):
        shapes = [Polygon([(x, 0), (x + 4, 0), (x + 4, 4), (x, 4)]) for x in (0, 4.5)]
        graph = merge_network(gpd.GeoDataFrame(geometry=shapes), crs="local")
        assert list(graph.edges(data="distance")) == [(0, 1, 0.5)]

    def test_proximity_can_be_chosen(self, looks):
        assert merge_network(looks, crs="local", instance_field="frame", proximity=0.6).number_of_edges() == 1

    def test_options_are_checked(self, looks):
        with pytest.raises(OptionError, match="did you mean proximity"):
            merge_network(looks, crs="local", proximty=2)

    def test_progress_can_stop_it(self, looks):
        def stop(_fraction, _message):
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            merge_network(looks, crs="local", progress=stop)


class TestNetworkLayers:
    def test_edges_run_from_middle_to_middle(self, graph):
        edges = network_layers(graph)["edges"]
        assert list(edges) == ["from_observation", "to_observation", "class", "component", "distance_m", "geometry"]
        assert sorted(edges["distance_m"]) == [0.5, 0.75]
        assert sorted(edges.geometry.to_wkt()) == ["LINESTRING (5 0, 5 0.75)", "LINESTRING (5 0.75, 5 1.25)"] or all(
            edge.length in (0.5, 0.75) for edge in edges.geometry
        )
        assert edges["class"].tolist() == ["divider", "divider"]
        assert edges["component"].nunique() == 1
        assert edges.crs == LOCAL_CRS

    def test_ends_of_the_edges_are_observations(self, graph):
        layers = network_layers(graph)
        observations = layers["observations"].set_index("observation")
        for edge in layers["edges"].itertuples():
            start, end = edge.geometry.coords
            assert start == observations.geometry[edge.from_observation].interpolate(0.5, normalized=True).coords[0]
            assert end == observations.geometry[edge.to_observation].interpolate(0.5, normalized=True).coords[0]

    def test_observations_have_the_number_of_their_component(self, graph):
        observations = network_layers(graph)["observations"].set_index("source_fid")
        assert observations["component"][10] == observations["component"][11] == observations["component"][12]
        assert observations["component"].nunique() == 3

    def test_areas_are_shown_as_their_rings(self):
        square = Polygon([(0, 0), (4, 0), (4, 4), (0, 4)])
        layers = network_layers(merge_network(gpd.GeoDataFrame(geometry=[square]), crs="local"))
        assert layers["observations"].geom_type.tolist() == ["LineString"]

    @pytest.mark.parametrize("count", [0, 1], ids=["no observations", "no edges"])
    def test_of_little_have_their_columns_all_the_same(self, looks, count):
        layers = network_layers(merge_network(looks.iloc[:count], crs="local"))
        assert len(layers["edges"]) == 0
        assert len(layers["observations"]) == count
        assert "distance_m" in layers["edges"]
        assert "component" in layers["observations"]
        assert layers["edges"].crs == LOCAL_CRS
