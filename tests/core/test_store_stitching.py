"""A place drawn anew: new lines inside, old ones outside, led over to each other at the edge."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from shapely import LineString, MultiPolygon, box, from_wkt

from polymerge_core.store.stitching import cut_at, put_together, shares

#: From x = 0 to 100; the lines of the tests run from left to right.
PLACE = box(0, -20, 100, 20)


def lines_of(*wkt):
    held = np.empty(len(wkt), dtype=object)
    held[:] = [from_wkt(each) if isinstance(each, str) else each for each in wkt]
    return held


def level(y, start, stop, step=4.0):
    x = np.append(np.arange(start, stop, step), stop)
    return LineString(np.column_stack([x, np.full(len(x), y)]))


def inside(*wkt, place=PLACE):
    return cut_at(lines_of(*wkt), place, inside=True, new=True)


def outside(*wkt, place=PLACE):
    return cut_at(lines_of(*wkt), place, inside=False, new=False)


def redrawn(new, old, place=PLACE, unit=1.0):
    """Draw a place anew."""
    return put_together(inside(*new, place=place) + outside(*old, place=place), unit)


def texts(pieces):
    return sorted((shapely.to_wkt(piece.line, rounding_precision=9), piece.of, piece.cut) for piece in pieces)


def turns(line):
    """Return by how many degrees a line turns at each of its vertices."""
    steps = np.diff(shapely.get_coordinates(line), axis=0)
    heading = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    return np.degrees(np.abs(np.diff(heading)))


class TestCutting:
    def test_gives_the_part_inside_and_the_parts_outside(self):
        line = "LINESTRING (-10 0, 110 0)"
        assert texts(inside(line)) == [("LINESTRING (0 0, 100 0)", 0, (True, True))]
        assert texts(outside(line)) == [
            ("LINESTRING (-10 0, 0 0)", 0, (False, True)),
            ("LINESTRING (100 0, 110 0)", 0, (True, False)),
        ]

    def test_gives_what_lies_on_one_side_whole(self):
        within, apart = "LINESTRING (10 0, 20 5)", "LINESTRING (200 0, 210 5)"
        assert texts(inside(within, apart)) == [(within, 0, (False, False))]
        assert texts(outside(within, apart)) == [(apart, 1, (False, False))]

    def test_says_what_the_pieces_are(self):
        assert [piece.new for piece in inside("LINESTRING (-10 0, 110 0)")] == [True]
        assert [piece.new for piece in outside("LINESTRING (-10 0, 110 0)")] == [False, False]

    def test_follows_a_line_that_leaves_and_comes_back(self):
        line = "LINESTRING (10 0, 10 30, 50 30, 50 0)"
        assert texts(inside(line)) == [
            ("LINESTRING (10 0, 10 20)", 0, (False, True)),
            ("LINESTRING (50 20, 50 0)", 0, (True, False)),
        ]
        assert texts(outside(line)) == [("LINESTRING (10 20, 10 30, 50 30, 50 20)", 0, (True, True))]

    def test_takes_a_ring_on_over_its_first_vertex(self):
        # It begins inside, at x = 90.
        ring = "LINESTRING (90 10, 90 -10, 120 -10, 120 10, 90 10)"
        assert texts(inside(ring)) == [("LINESTRING (100 10, 90 10, 90 -10, 100 -10)", 0, (True, True))]
        assert texts(outside(ring)) == [("LINESTRING (100 -10, 120 -10, 120 10, 100 10)", 0, (True, True))]

    def test_cuts_a_ring_that_begins_on_the_edge_at_both_ends(self):
        ring = "LINESTRING (100 10, 90 10, 90 -10, 100 -10, 120 -10, 120 10, 100 10)"
        assert texts(inside(ring)) == [("LINESTRING (100 10, 90 10, 90 -10, 100 -10)", 0, (True, True))]
        assert texts(outside(ring)) == [("LINESTRING (100 -10, 120 -10, 120 10, 100 10)", 0, (True, True))]

    @pytest.mark.parametrize(
        "ring", ["LINESTRING (90 -5, 100 0, 90 5, 90 -5)", "LINESTRING (100 0, 90 5, 90 -5, 100 0)"]
    )
    def test_leaves_a_ring_whole_that_touches_the_edge_from_inside(self, ring):
        assert texts(inside(ring)) == [(ring, 0, (False, False))]
        assert outside(ring) == []

    def test_says_of_a_line_that_ends_on_the_edge_that_it_was_cut_there(self):
        assert texts(inside("LINESTRING (10 0, 100 0)")) == [("LINESTRING (10 0, 100 0)", 0, (False, True))]
        assert texts(outside("LINESTRING (100 0, 150 0)")) == [("LINESTRING (100 0, 150 0)", 0, (True, False))]

    def test_finds_nothing_inside_of_what_touches_the_edge_from_outside(self):
        line = "LINESTRING (50 30, 60 20, 70 30)"
        assert inside(line) == []
        assert sum(piece.line.length for piece in outside(line)) == pytest.approx(from_wkt(line).length)

    def test_takes_a_line_along_the_edge_for_inside(self):
        line = "LINESTRING (10 20, 60 20)"
        assert sum(piece.line.length for piece in inside(line)) == pytest.approx(50)
        assert outside(line) == []

    def test_knows_places_of_several_parts_and_with_holes(self):
        place = MultiPolygon([box(0, -5, 10, 5), box(20, -5, 60, 5).difference(box(30, -2, 40, 2))])
        line = "LINESTRING (-5 0, 70 0)"
        assert [text for text, _, _ in texts(inside(line, place=place))] == [
            "LINESTRING (0 0, 10 0)",
            "LINESTRING (20 0, 30 0)",
            "LINESTRING (40 0, 60 0)",
        ]
        assert [piece.line.length for piece in outside(line, place=place)] == pytest.approx([5, 10, 10, 10])

    def test_of_no_lines_gives_no_pieces(self):
        assert inside() == outside() == []

    @given(
        st.lists(st.tuples(st.integers(-9, 9), st.integers(-9, 9)), min_size=2, max_size=8, unique=True),
        st.booleans(),
        st.floats(0.1, 5.0),
        st.floats(-5.0, 5.0),
    )
    def test_gives_every_metre_to_one_side(self, points, ring, size, shift):
        # Corners of the place are no corners of the line.
        place = box(shift - size, shift / 3 - size, shift + size * 1.1, shift / 3 + size)
        line = LineString([*points, points[0]] if ring and len(points) > 2 else points)
        here, there = inside(line, place=place), outside(line, place=place)
        total = sum(piece.line.length for piece in here + there)
        assert total == pytest.approx(line.length, abs=1e-4)
        assert sum(piece.line.length for piece in here) == pytest.approx(place.intersection(line).length, abs=1e-4)
        grown = place.buffer(1e-5)
        assert all(grown.contains(piece.line) for piece in here)
        edge = place.boundary
        for piece in here + there:
            for end, cut in zip((0, -1), piece.cut, strict=True):
                assert not cut or edge.distance(shapely.get_point(piece.line, end)) < 1e-5


class TestPuttingTogether:
    def test_takes_the_new_line_inside_and_the_old_one_outside(self):
        (chain,) = redrawn([level(0, -50, 150)], [level(0.3, -50, 150)])
        line = chain.line
        within = line.intersection(box(0, -1, 100, 1))
        assert shapely.hausdorff_distance(within, level(0, 0, 100)) < 1e-9
        xy = shapely.get_coordinates(line)
        assert xy[0].tolist() == [-50, 0.3]
        assert xy[-1].tolist() == [150, 0.3]
        assert (np.diff(xy[:, 0]) > 0).all()

    def test_leads_the_old_line_over_without_a_kink(self):
        (chain,) = redrawn([level(0, -50, 150)], [level(0.3, -50, 150)])
        assert turns(chain.line).max() < 2
        # The way over is ten proximities long and falls all along.
        xy = shapely.get_coordinates(chain.line)
        over = xy[(xy[:, 0] > 100) & (xy[:, 0] < 110)]
        assert len(over) >= 9
        np.testing.assert_allclose(over[:, 1], 0.03 * (over[:, 0] - 100), atol=1e-9)

    def test_leaves_the_far_part_of_the_old_line_as_it_was(self):
        old = LineString([(100, 0.3), (112, 0.7), (115.5, -1), (140, 3)])
        (chain,) = redrawn([level(0, -50, 150)], [old])
        assert shapely.get_coordinates(chain.line)[-3:].tolist() == [[112, 0.7], [115.5, -1], [140, 3]]

    def test_leads_over_a_short_old_line_along_all_of_it(self):
        (chain,) = redrawn([level(0, 0, 150)], [LineString([(90, 0.5), (104, 0.5)])])
        xy = shapely.get_coordinates(chain.line)
        assert xy[-1].tolist() == [104, 0.5]
        np.testing.assert_allclose(xy[xy[:, 0] > 100][:, 1], 0.125 * (xy[xy[:, 0] > 100][:, 0] - 100), atol=1e-9)

    def test_leads_an_old_line_between_two_places_over_at_both_ends(self):
        place = MultiPolygon([box(0, -5, 40, 5), box(60, -5, 100, 5)])
        (chain,) = redrawn([level(0, 0, 100)], [level(0.4, 30, 70)], place)
        assert shapely.get_coordinates(chain.line)[[0, -1]].tolist() == [[0, 0], [100, 0]]
        assert chain.line.intersects(shapely.Point(50, 0.4).buffer(1e-6))
        assert [piece.new for piece in chain.pieces] == [True, False, True]
        assert turns(chain.line).max() < 5

    @pytest.mark.parametrize("flip_new", [False, True])
    @pytest.mark.parametrize("flip_old", [False, True])
    def test_does_not_mind_directions(self, flip_new, flip_old):
        new, old = level(0, -50, 150), level(0.3, -50, 150)
        (expected,) = redrawn([new], [old])
        (found,) = redrawn([new.reverse() if flip_new else new], [old.reverse() if flip_old else old])
        assert shapely.equals_exact(shapely.normalize(found.line), shapely.normalize(expected.line), 1e-9)

    def test_closes_a_ring_that_crosses_the_place(self):
        ring = "LINESTRING (90 10, 90 -10, 130 -10, 130 10, 90 10)"
        moved = "LINESTRING (90.5 10.5, 90.5 -9.5, 130.5 -9.5, 130.5 10.5, 90.5 10.5)"
        (chain,) = redrawn([moved], [ring])
        assert chain.line.is_closed
        assert chain.line.is_simple
        assert [piece.new for piece in chain.pieces].count(True) == 1
        assert shapely.hausdorff_distance(chain.line, from_wkt(ring)) < 0.8

    def test_joins_what_an_earlier_drawing_of_the_same_place_cut(self):
        left = [chain.line for chain in redrawn([], [level(0.3, -50, 150)])]
        (chain,) = redrawn([level(0, -50, 150)], left)
        assert shapely.get_coordinates(chain.line)[[0, -1]].tolist() == [[-50, 0.3], [150, 0.3]]

    def test_drawn_twice_the_same_place_keeps_a_ring_closed(self):
        ring = "LINESTRING (90 10, 90 -10, 130 -10, 130 10, 90 10)"
        (first,) = redrawn([ring], [ring])
        (again,) = redrawn([ring], [first.line])
        assert again.line.is_closed
        assert again.line.length == pytest.approx(120)

    def test_follows_a_line_that_leaves_and_comes_back(self):
        new = "LINESTRING (10 0.2, 10 30, 50.2 30, 50.2 0)"
        old = "LINESTRING (10.3 0, 10.3 30, 50 30, 50 0)"
        (chain,) = redrawn([new], [old])
        assert [piece.new for piece in chain.pieces] == [True, False, True]
        assert shapely.get_coordinates(chain.line)[[0, -1]].tolist() == [[10, 0.2], [50.2, 0]]

    def test_leaves_an_old_end_without_a_new_one_alone(self):
        chains = redrawn([], [level(0.3, -50, 150)])
        assert sorted(chain.line.bounds for chain in chains) == [(-50, 0.3, 0, 0.3), (100, 0.3, 150, 0.3)]

    def test_leaves_a_new_end_without_an_old_one_alone(self):
        (chain,) = redrawn([level(0, -50, 150)], [])
        assert chain.line.bounds == (0, 0, 100, 0)

    @pytest.mark.parametrize(("unit", "aside", "count"), [(1, 2.4, 1), (1, 2.6, 3), (0.5, 1.2, 1), (0.5, 1.3, 3)])
    def test_keeps_what_is_too_far_apart_apart(self, unit, aside, count):
        chains = redrawn([level(0, -50, 150)], [level(aside, -50, 150)], unit=unit)
        assert len(chains) == count
        if count == 3:
            assert sorted(chain.line.bounds[1] for chain in chains) == [0, aside, aside]

    def test_gives_each_end_to_the_nearest(self):
        chains = redrawn([level(0, -50, 150), level(1, -50, 150)], [level(0.4, -50, 150), level(1.4, -50, 150)])
        ends = sorted(shapely.get_coordinates(chain.line)[[0, -1], 1].tolist() for chain in chains)
        middles = sorted(shapely.get_coordinates(chain.line.intersection(PLACE))[0, 1] for chain in chains)
        assert ends == [[0.4, 0.4], [1.4, 1.4]]
        assert middles == pytest.approx([0, 1])

    def test_joins_an_end_once_though_two_are_near(self):
        chains = redrawn([level(0, -50, 150)], [level(0.4, 50, 150), level(-0.6, 50, 150)])
        assert len(chains) == 2
        assert sorted(len(chain.pieces) for chain in chains) == [1, 2]
        (alone,) = (chain for chain in chains if len(chain.pieces) == 1)
        assert alone.line.bounds == (100, -0.6, 150, -0.6)

    def test_does_not_join_ends_that_are_not_on_the_edge(self):
        chains = redrawn([level(0, 10, 99.5)], [level(0, 100.5, 150)])
        assert len(chains) == 2

    def test_tells_the_shares_of_lines(self):
        chains = redrawn([level(0, -50, 150)], [level(9, 300, 310), level(0.3, -50, 150)])
        of, new, length = shares(max(chains, key=lambda chain: chain.line.length))
        assert of.tolist() == [1, 0, 1]
        assert new.tolist() == [False, True, False]
        assert length.tolist() == [50, 100, 50]

    def test_of_nothing_is_nothing(self):
        assert put_together([], 1.0) == []

    @given(
        st.lists(st.tuples(st.floats(-15, 15), st.floats(-40, 60)), max_size=6),
        st.lists(st.tuples(st.floats(-15, 15), st.floats(-40, 60)), max_size=6),
        st.floats(0.2, 3.0),
    )
    def test_every_piece_is_in_one_chain_that_meets_exactly(self, new, old, unit):
        new = [level(y, start, start + 90) for y, start in new]
        old = [level(y, start, start + 90).reverse() for y, start in old]
        pieces = inside(*new) + outside(*old)
        chains = put_together(pieces, unit)
        used = [id(piece) for chain in chains for piece in chain.pieces]
        assert sorted(used) == sorted(map(id, pieces))
        for chain in chains:
            total = sum(piece.line.length for piece in chain.pieces)
            reach = 2.5 * unit * len(chain.pieces)
            assert total - 1e-6 <= chain.line.length <= total + reach
            # New pieces are in it as they are, to the last vertex.
            for piece in chain.pieces:
                if piece.new:
                    assert (
                        shapely.distance(shapely.points(shapely.get_coordinates(piece.line)), chain.line).max() < 1e-9
                    )
            # Pieces take turns.
            kinds = [piece.new for piece in chain.pieces]
            assert all(one != other for one, other in itertools.pairwise(kinds))

    @given(st.permutations(range(6)))
    def test_the_order_of_pieces_does_not_matter(self, order):
        new = [level(0, -50, 150), level(5, -50, 150)]
        old = [level(0.3, -50, 150), level(5.5, -50, 150)]
        pieces = inside(*new) + outside(*old)
        assert len(pieces) == 6
        expected, found = (
            sorted(shapely.to_wkt(shapely.normalize(chain.line)) for chain in put_together(each, 1.0))
            for each in (pieces, [pieces[row] for row in order])
        )
        assert found == expected
