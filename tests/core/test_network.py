"""Alg. 1: who is merged with whom, against pairs one can draw and against all pairs looped over."""

from __future__ import annotations

from itertools import pairwise

import networkx as nx
import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from polymerge_core import network
from polymerge_core.errors import InputError
from polymerge_core.network import Edges, breadth_first_depth, components, merge_edges, polyline_merge_check
from tests import reference

BASE = [(0, 0), (10, 0)]
NEAR_THE_THRESHOLD = 1e-9


def array(points):
    return np.array(points, dtype=float)


def lines_from(*points):
    return np.array([shapely.LineString(line) for line in points], dtype=object)


def edges_from(*pairs):
    pairs = np.array(sorted(pairs), dtype=np.intp).reshape(-1, 2)
    return Edges(pairs[:, 0], pairs[:, 1], np.zeros(len(pairs)))


def pairs_of(edges):
    return list(zip(edges.first.tolist(), edges.second.tolist(), strict=True))


def none_is_main(lines):
    return np.zeros(len(lines), dtype=bool)


def distances_of_all_pairs(lines, is_main):
    """Every pair that Alg. 1 looks at, with the distance that decides."""
    points = [[tuple(vertex) for vertex in shapely.get_coordinates(line).tolist()] for line in lines]
    return {
        (i, j): reference.check_distance(points[i], points[j])
        for i in range(len(points))
        for j in range(i + 1, len(points))
        if not (is_main[i] and is_main[j])
    }


def assert_edges_of_the_reference(edges, lines, is_main, proximity):
    __tracebackhide__ = True
    found = dict(zip(pairs_of(edges), edges.distance.tolist(), strict=True))
    for pair, distance in distances_of_all_pairs(lines, is_main).items():
        if abs(distance - proximity) > NEAR_THE_THRESHOLD:
            assert (pair in found) == (distance < proximity), f"{pair} at {distance}, proximity {proximity}"
        if pair in found:
            assert found.pop(pair) == pytest.approx(distance, abs=1e-9)
    assert not found


def random_lines(rng, count, *, extent, largest=8):
    starts = rng.uniform(0, extent, (count, 1, 2))
    steps = np.cumsum(rng.normal(0, 2, (count, largest, 2)), axis=1)
    lengths = rng.integers(2, largest + 1, count)
    return lines_from(*[(starts[k] + steps[k])[: lengths[k]] for k in range(count)])


@st.composite
def line_arrays(draw):
    free = st.floats(-20, 20, allow_nan=False).map(lambda value: round(value, 7))
    grid = st.integers(-4, 4).map(lambda value: value / 2)
    coordinates = draw(st.sampled_from([free, grid]))
    line = st.lists(st.tuples(coordinates, coordinates), min_size=2, max_size=5)
    clean = line.map(reference.remove_short_segments).filter(lambda points: len(points) >= 2)
    lines = draw(st.lists(clean, min_size=1, max_size=8))
    is_main = draw(st.lists(st.booleans(), min_size=len(lines), max_size=len(lines)))
    return lines_from(*lines), np.array(is_main)


@st.composite
def graphs(draw):
    count = draw(st.integers(1, 15))
    node = st.integers(0, count - 1)
    pairs = draw(st.sets(st.tuples(node, node).filter(lambda pair: pair[0] < pair[1]), max_size=25))
    return count, pairs


class TestPolylineMergeCheck:
    @pytest.mark.parametrize(
        ("other", "passes"),
        [
            pytest.param([(2, 0.9), (8, 0.9)], True, id="parallel and near"),
            pytest.param([(2, 1.1), (8, 1.1)], False, id="parallel and far"),
            pytest.param([(2, 1.0), (8, 1.0)], False, id="at exactly the threshold: strict"),
            pytest.param([(2, np.nextafter(1, 0)), (8, 5)], True, id="next number under the threshold"),
            pytest.param([(5, 0.5), (5, 50)], True, id="one vertex is enough"),
            pytest.param([(5, 50), (5, 0.5)], True, id="one vertex, the last, is enough"),
            pytest.param([(10.9, 0), (20, 0)], True, id="end to end"),
            pytest.param([(10.5, 0.8), (20, 0.8)], True, id="end to end, diagonally"),
            pytest.param([(10.8, 0.8), (20, 0.8)], False, id="end to end, too far diagonally"),
            pytest.param([(5, -5), (5, 5)], False, id="cross between vertices"),
            pytest.param([(-5, 0.5), (15, 0.5)], True, id="only the vertices of the first are near"),
            pytest.param([(-5, 0), (15, 0)], True, id="overlaps and reaches further on both sides"),
            pytest.param([(-5, 0), (-1.5, 0)], False, id="on the extension of the line"),
            pytest.param(BASE, True, id="copy"),
            pytest.param(BASE[::-1], True, id="reversed copy"),
        ],
    )
    def test_at_one_metre(self, other, passes):
        assert polyline_merge_check(array(BASE), array(other), 1.0) is passes
        assert polyline_merge_check(array(other), array(BASE), 1.0) is passes

    def test_is_strict_for_a_vertex_that_faces_an_end(self):
        assert not polyline_merge_check(array(BASE), array([(13, 4), (30, 4)]), 5.0)
        assert polyline_merge_check(array(BASE), array([(13, 4), (30, 4)]), 5.001)

    def test_of_closed_lines_looks_at_the_closing_segment(self):
        ring = [(0, 0), (10, 0), (10, 10), (0, 10), (0, 0)]
        assert polyline_merge_check(array(ring), array([(-0.5, 5), (-5, 5)]), 1.0)
        assert not polyline_merge_check(array(ring[:-1]), array([(-0.5, 5), (-5, 5)]), 1.0)

    def test_of_one_inside_a_closed_line_looks_at_the_line_only(self):
        ring = [(0, 0), (10, 0), (10, 10), (0, 10), (0, 0)]
        assert not polyline_merge_check(array(ring), array([(4, 4), (6, 6)]), 1.0)

    def test_changes_nothing(self):
        a, b = array(BASE), array([(2, 0.5), (8, 0.5)])
        a.flags.writeable = b.flags.writeable = False
        polyline_merge_check(a, b, 1.0)
        assert a.tolist() == array(BASE).tolist()

    @given(line_arrays(), st.sampled_from([0.25, 0.5, 1.0, 3.0]))
    def test_agrees_with_the_reference(self, drawn, proximity):
        lines, _ = drawn
        for a, b in pairwise(shapely.get_coordinates(line) for line in lines):
            points = [[tuple(vertex) for vertex in line.tolist()] for line in (a, b)]
            if abs(reference.check_distance(*points) - proximity) > NEAR_THE_THRESHOLD:
                expected = reference.polyline_merge_check(*points, proximity)
                assert polyline_merge_check(a, b, proximity) is expected


class TestMergeEdges:
    def test_of_four_dividers(self):
        lines = lines_from(BASE, [(0, 0.4), (10, 0.4)], [(0, 1.2), (10, 1.2)], [(0, 9), (10, 9)])
        edges = merge_edges(lines, none_is_main(lines), 1.0)
        assert pairs_of(edges) == [(0, 1), (1, 2)]
        assert edges.distance.tolist() == pytest.approx([0.4, 0.8])

    def test_distance_is_the_one_that_the_check_compares(self):
        # The lines cross, but the nearest vertex is 0.6 from the other line.
        lines = lines_from(BASE, [(5, -0.6), (5, 3)])
        edges = merge_edges(lines, none_is_main(lines), 1.0)
        assert edges.distance.tolist() == pytest.approx([0.6])

    def test_distance_is_the_smaller_of_both_directions(self):
        lines = lines_from(BASE, [(-1, 0.2), (11, 0.2), (11, 0.7)])
        edges = merge_edges(lines, none_is_main(lines), 1.0)
        assert edges.distance.tolist() == pytest.approx([0.2])

    def test_is_strict_at_exactly_the_threshold(self):
        lines = lines_from(BASE, [(0, 1), (10, 1)], [(0, 2), (10, 2)])
        assert pairs_of(merge_edges(lines, none_is_main(lines), 1.0)) == []
        above = np.nextafter(1.0, 2.0)
        assert pairs_of(merge_edges(lines, none_is_main(lines), above)) == [(0, 1), (1, 2)]

    def test_is_strict_for_a_vertex_that_faces_an_inclined_segment(self):
        # (3, 4) is the unit normal times 5 of the segment (-4, 3)-(4, -3), exact in floating point.
        lines = lines_from([(-4, 3), (4, -3)], [(3, 4), (30, 40)])
        assert pairs_of(merge_edges(lines, none_is_main(lines), 5.0)) == []
        assert pairs_of(merge_edges(lines, none_is_main(lines), 5.001)) == [(0, 1)]

    def test_lines_that_cross_between_their_vertices_are_no_pair(self):
        lines = lines_from(BASE, [(5, -5), (5, 5)])
        assert pairs_of(merge_edges(lines, none_is_main(lines), 1.0)) == []

    def test_two_lines_of_the_main_map_are_no_pair(self):
        lines = lines_from(BASE, BASE, [(0, 0.3), (10, 0.3)])
        assert pairs_of(merge_edges(lines, np.array([True, True, False]), 1.0)) == [(0, 2), (1, 2)]
        assert pairs_of(merge_edges(lines, np.array([True, True, True]), 1.0)) == []

    def test_no_line_is_its_own_pair(self):
        lines = lines_from([(0, 0), (10, 0), (10, 10), (0, 10), (0, 0)])
        assert pairs_of(merge_edges(lines, none_is_main(lines), 100.0)) == []

    def test_of_no_lines_is_empty(self):
        edges = merge_edges(np.empty(0, dtype=object), np.empty(0, dtype=bool), 1.0)
        assert (len(edges.first), len(edges.second), len(edges.distance)) == (0, 0, 0)

    def test_order_of_the_lines_changes_the_numbers_only(self, rng):
        lines = random_lines(rng, 40, extent=30)
        shuffle = rng.permutation(40)
        straight = merge_edges(lines, none_is_main(lines), 1.0)
        shuffled = merge_edges(lines[shuffle], none_is_main(lines), 1.0)
        renamed = {tuple(sorted((int(shuffle[i]), int(shuffle[j])))) for i, j in pairs_of(shuffled)}
        assert renamed == set(pairs_of(straight))

    def test_lines_far_from_the_origin(self):
        lines = shapely.transform(
            lines_from(BASE, [(0, 0.75), (10, 0.75)], [(0, 2), (10, 2)]), lambda xy: xy + np.array([5e5, 5e6])
        )
        assert pairs_of(merge_edges(lines, none_is_main(lines), 1.0)) == [(0, 1)]

    @given(line_arrays(), st.sampled_from([0.25, 0.5, 1.0, 3.0]))
    def test_agrees_with_all_pairs_looped_over(self, drawn, proximity):
        lines, is_main = drawn
        edges = merge_edges(lines, is_main, proximity)
        pairs = pairs_of(edges)
        assert pairs == sorted(set(pairs))
        assert all(first < second for first, second in pairs)
        assert_edges_of_the_reference(edges, lines, is_main, proximity)

    @pytest.mark.parametrize("main_share", [0.0, 0.5], ids=["no main map", "half of the lines"])
    def test_of_a_dense_map_agrees_with_all_pairs_looped_over(self, rng, main_share):
        lines = random_lines(rng, 90, extent=40)
        is_main = rng.random(90) < main_share
        edges = merge_edges(lines, is_main, 1.0)
        assert 50 < len(edges.first) < 2000
        assert_edges_of_the_reference(edges, lines, is_main, 1.0)

    def test_without_distances_the_pairs_are_the_same(self, rng):
        lines = random_lines(rng, 90, extent=40)
        full = merge_edges(lines, none_is_main(lines), 1.0)
        bare = merge_edges(lines, none_is_main(lines), 1.0, distances=False)
        assert pairs_of(bare) == pairs_of(full)

    @pytest.mark.parametrize("chunk", [1, 3, 7, 64])
    @pytest.mark.parametrize("distances", [True, False], ids=["with distances", "pairs only"])
    def test_in_small_chunks_is_the_same(self, rng, monkeypatch, chunk, distances):
        lines = random_lines(rng, 90, extent=40)
        is_main = rng.random(90) < 0.3
        whole = merge_edges(lines, is_main, 1.0, distances=distances)
        monkeypatch.setattr(network, "_CHUNK", chunk)
        parts = merge_edges(lines, is_main, 1.0, distances=distances)
        assert pairs_of(parts) == pairs_of(whole)
        assert np.array_equal(parts.distance, whole.distance, equal_nan=True)

    def test_of_more_lines_than_a_chunk_holds(self):
        # Rows of 3 lines 0.5 m apart, 10 m to the next row: 2 edges a row.
        count = 3 * 700
        index = np.arange(count)
        y = index // 3 * 10 + index % 3 * 0.5
        lines = lines_from(*[[(0, height), (5, height)] for height in y])
        edges = merge_edges(lines, none_is_main(lines), 0.75)
        row = np.arange(0, count, 3)
        expected = sorted([*zip(row, row + 1, strict=True), *zip(row + 1, row + 2, strict=True)])
        assert pairs_of(edges) == expected

    def test_of_more_pairs_than_memory_is_meant_to_hold_is_refused(self, monkeypatch):
        lines = lines_from(*[[(0, 0.3 * k), (5, 0.3 * k)] for k in range(3)])
        monkeypatch.setattr(network, "MAX_EDGES", 3)
        assert len(pairs_of(merge_edges(lines, none_is_main(lines), 1.0))) == 3
        monkeypatch.setattr(network, "MAX_EDGES", 2)
        with pytest.raises(InputError, match="smaller proximity"):
            merge_edges(lines, none_is_main(lines), 1.0)


class TestComponents:
    @pytest.mark.parametrize(
        ("count", "pairs", "labels"),
        [
            pytest.param(4, [], [0, 1, 2, 3], id="no edges"),
            pytest.param(4, [(0, 1), (1, 2), (2, 3)], [0, 0, 0, 0], id="a chain"),
            pytest.param(5, [(0, 3), (1, 4)], [0, 1, 2, 0, 1], id="interleaved"),
            pytest.param(5, [(2, 4), (1, 3)], [0, 1, 2, 1, 2], id="numbered by the lowest member"),
            pytest.param(3, [(0, 1), (0, 2), (1, 2)], [0, 0, 0], id="a triangle"),
            pytest.param(0, [], [], id="nothing"),
        ],
    )
    def test_labels(self, count, pairs, labels):
        assert components(count, edges_from(*pairs)).tolist() == labels

    @given(graphs())
    def test_agree_with_networkx(self, drawn):
        count, pairs = drawn
        graph = nx.Graph(pairs)
        graph.add_nodes_from(range(count))
        expected = np.empty(count, dtype=int)
        for label, members in enumerate(sorted(nx.connected_components(graph), key=min)):
            expected[list(members)] = label
        assert components(count, edges_from(*pairs)).tolist() == expected.tolist()


class TestBreadthFirstDepth:
    @pytest.mark.parametrize(
        ("count", "pairs", "roots", "depths"),
        [
            pytest.param(4, [(0, 1), (1, 2), (2, 3)], [0], [0, 1, 2, 3], id="chain from its end"),
            pytest.param(4, [(0, 1), (1, 2), (2, 3)], [2], [2, 1, 0, 1], id="chain from within"),
            pytest.param(4, [(0, 1), (1, 2), (0, 3), (2, 3)], [0], [0, 1, 2, 1], id="cycle: the shorter way"),
            pytest.param(5, [(0, 3), (1, 4)], [3, 1, 2], [1, 0, 0, 0, 1], id="several components"),
            pytest.param(2, [], [0, 1], [0, 0], id="no edges"),
            pytest.param(0, [], [], [], id="nothing"),
        ],
    )
    def test_depths(self, count, pairs, roots, depths):
        result = breadth_first_depth(count, edges_from(*pairs), np.array(roots, dtype=np.intp))
        assert result.tolist() == depths

    def test_of_a_component_without_a_root_is_refused(self):
        with pytest.raises(ValueError, match="root"):
            breadth_first_depth(3, edges_from((0, 1)), np.array([0]))

    @given(graphs(), st.randoms(use_true_random=False))
    def test_agree_with_networkx(self, drawn, choice):
        count, pairs = drawn
        graph = nx.Graph(pairs)
        graph.add_nodes_from(range(count))
        roots = [choice.choice(sorted(members)) for members in nx.connected_components(graph)]
        expected = {}
        for root in roots:
            expected.update(nx.single_source_shortest_path_length(graph, root))
        result = breadth_first_depth(count, edges_from(*pairs), np.array(roots))
        assert dict(enumerate(result.tolist())) == expected
