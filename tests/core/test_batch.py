"""Merging many sets side by side against merging each alone: the same bits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from polymerge_core import batch
from polymerge_core.batch import PolylineSets, merge_sets
from polymerge_core.polyline import merge_polylines
from tests import reference


def array(points):
    return np.array(points, dtype=float).reshape(-1, 2)


def flat(sets):
    """Lay sets of polylines, each with its base first, into flat arrays."""
    joined = [np.concatenate([array(line) for line in lines]) for lines in sets]
    bounds = np.append(0, np.cumsum([len(vertices) for vertices in joined])).astype(np.intp)
    base_size = np.array([len(lines[0]) for lines in sets], dtype=np.intp)
    return PolylineSets(np.concatenate([np.empty((0, 2)), *joined]), bounds, base_size)


def one_by_one(sets):
    return [merge_polylines(array(base), [array(line) for line in rest]) for base, *rest in sets]


def assert_same_bits(result, expected):
    __tracebackhide__ = True
    assert [line.tobytes() for line in result] == [line.tobytes() for line in expected]


def random_sets(rng, count, *, grid=0.0, largest=9):
    """Draw sets of lines along one another, a third of the bases closed."""
    sets = []
    for _ in range(count):
        bent = np.cumsum(rng.normal(1, 1, (largest, 2)), axis=0)
        lines = []
        for number in range(rng.integers(1, 6)):
            line = bent[: rng.integers(2, largest + 1)] + rng.normal(0, 0.3, 2)
            line = line[:: rng.choice([-1, 1])]
            if grid:
                line = np.round(line / grid) * grid
            points = reference.remove_short_segments([tuple(vertex) for vertex in line.tolist()])
            if number == 0 and rng.random() < 1 / 3:
                points = reference.remove_short_segments([*points, points[0]])
            if len(points) >= 2:
                lines.append(points)
        if lines:
            sets.append(lines)
    return sets


@st.composite
def drawn_sets(draw):
    grid = st.integers(-4, 4).map(lambda value: value / 2)
    coordinate = draw(st.sampled_from([grid, st.floats(-99, 99).map(lambda value: round(value, 6))]))
    points = st.lists(st.tuples(coordinate, coordinate), min_size=2, max_size=6)
    line = st.one_of(points, points.map(lambda line: [*line, line[0]]))
    clean = line.map(reference.remove_short_segments).filter(lambda line: len(line) >= 2)
    return draw(st.lists(st.lists(clean, min_size=1, max_size=4), min_size=1, max_size=6))


class TestMergeSets:
    def test_of_the_four_scenarios_side_by_side(self):
        base = [(0, 0), (10, 0), (10, 10)]
        vertices = [(4, 2), (12, -2), (-2, 1), (9, 12), (0, 0), (10, 10)]
        result = merge_sets(flat([[base, [vertex]] for vertex in vertices]))
        assert [line.tolist() for line in result] == [
            [[0, 0], [4, 1], [10, 0], [10, 10]],
            [[0, 0], [11, -1], [10, 10]],
            [[-2, 1], [0, 0], [10, 0], [10, 10]],
            [[0, 0], [10, 0], [10, 10], [9, 12]],
            [[0, 0], [10, 0], [10, 10]],
            [[0, 0], [10, 0], [10, 10]],
        ]

    def test_of_closed_bases_move_the_start_and_the_end_together(self):
        ring = [(0, 0), (10, 0), (10, 10), (0, 10), (0, 0)]
        vertices = [(-2, -4), (12, -2), (5, -2), (-2, 5)]
        result = merge_sets(flat([[ring, [vertex]] for vertex in vertices]))
        assert [line.tolist() for line in result] == [
            [[-1, -2], [10, 0], [10, 10], [0, 10], [-1, -2]],
            [[0, 0], [11, -1], [10, 10], [0, 10], [0, 0]],
            [[0, 0], [5, -1], [10, 0], [10, 10], [0, 10], [0, 0]],
            [[0, 0], [10, 0], [10, 10], [0, 10], [-1, 5], [0, 0]],
        ]

    def test_of_closed_bases_are_as_one_by_one_where_the_last_segment_reaches_the_start(self, rng):
        # By rounding, the foot on the first segment may lie farther off than the start itself.
        sets = []
        for second, start, last in rng.uniform(0, 100, (1000, 3, 2)):
            outwards = np.array([-1, 1]) * (second - start)[::-1]
            outwards *= np.sign(outwards @ (start - last)) * rng.uniform(0.1, 1)
            sets.append([[start, second, (50.0, -200.0), last, start], [start + outwards]])
        found = [reference.project(tuple(rest[0][0]), [tuple(v) for v in base]) for base, *rest in sets]
        assert sum((foot.segment, foot.parameter) == (3, 1.0) for foot in found) > 5
        result = merge_sets(flat(sets))
        assert_same_bits(result, one_by_one(sets))
        assert all((line[0] == line[-1]).all() for line in result)

    def test_of_equally_near_segments_the_first_gets_the_vertex(self):
        hairpin = [(0, 0), (10, 0), (10, 2), (0, 2)]
        (result,) = merge_sets(flat([[hairpin, [(4, 1)]]]))
        assert result.tolist() == [[0, 0], [4, 0.5], [10, 0], [10, 2], [0, 2]]

    def test_of_no_sets_is_nothing(self):
        assert merge_sets(flat([])) == []

    def test_of_bases_alone_are_the_bases(self):
        bases = [[(0, 0), (1, 0)], [(5, 5), (6, 7), (9, 9)]]
        assert_same_bits(merge_sets(flat([[base] for base in bases])), [array(base) for base in bases])

    def test_come_back_in_the_order_given_whatever_their_size(self):
        sets = [[[(x, 0), (x + 1, 0)], [(x, 1)] * count] for x, count in [(0, 3), (10, 1), (20, 7), (30, 0), (40, 2)]]
        assert [line[-1, 0] for line in merge_sets(flat(sets))] == [1, 11, 21, 31, 41]

    def test_do_not_change_the_input(self, rng):
        sets = flat(random_sets(rng, 20))
        before = sets.vertices.copy()
        sets.vertices.flags.writeable = False
        merge_sets(sets)
        assert np.array_equal(sets.vertices, before)

    @pytest.mark.parametrize("grid", [0.0, 0.5], ids=["free", "on a grid, where ties are many"])
    def test_are_as_one_by_one(self, rng, grid):
        sets = random_sets(rng, 400, grid=grid)
        assert_same_bits(merge_sets(flat(sets)), one_by_one(sets))

    @pytest.mark.parametrize("long", [0, 12, 1500], ids=lambda long: f"long from {long}")
    @pytest.mark.parametrize("size", [1, 40, 500], ids=lambda size: f"batches of {size}")
    def test_are_the_same_in_batches_of_any_size(self, rng, monkeypatch, long, size):
        sets = random_sets(rng, 120, grid=0.25)
        expected = one_by_one(sets)
        monkeypatch.setattr(batch, "LONG", max(long, 1))
        monkeypatch.setattr(batch, "_BATCH", size)
        assert_same_bits(merge_sets(flat(sets)), expected)

    def test_of_more_vertices_than_a_batch_are_as_one_by_one(self, rng):
        bent = np.cumsum(rng.normal(0, 1, (300, 2)), axis=0)
        sets = [[bent + rng.normal(0, 0.2, bent.shape) for _ in range(count)] for count in (2, 3, 9)]
        assert_same_bits(merge_sets(flat(sets)), one_by_one(sets))

    @settings(max_examples=60)
    @given(drawn_sets(), st.sampled_from([1, 20, 16_000]))
    def test_are_as_one_by_one_whatever_they_are(self, sets, size):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(batch, "_BATCH", size)
            assert_same_bits(merge_sets(flat(sets)), one_by_one(sets))

    def test_whose_vertices_differ_by_rounding_stay_finite(self, rng):
        # A vertex that is one rounding away from the base's can be inserted where that one is.
        sets = []
        for _ in range(200):
            base = np.add(np.cumsum(rng.uniform(0.5, 4, (6, 2)), axis=0), (5e5, 5.3e6))
            nudges = rng.integers(-2, 3, (2, *base.shape)) * np.spacing(base)
            sets.append([base, *(base + nudges)])
        result = merge_sets(flat(sets))
        assert all(np.isfinite(line).all() for line in result)
        assert_same_bits(result, one_by_one(sets))


class TestLongSets:
    """Sets that go vertex by vertex, where only a part of the base is looked at."""

    @staticmethod
    def assert_as_the_reference(monkeypatch, base, *others):
        __tracebackhide__ = True
        monkeypatch.setattr(batch, "LONG", 10)
        expected = [tuple(vertex) for vertex in base]
        for other in others:
            expected = reference.merge_polyline(expected, other)
        (result,) = merge_sets(flat([[base, *others]]))
        np.testing.assert_allclose(result, expected, rtol=0, atol=1e-9)

    @pytest.mark.parametrize("turn", [1, -1], ids=["the end", "the start"])
    def test_find_what_was_put_on(self, monkeypatch, turn):
        # The extension comes back above the base: (50, 40) is nearer to it than to the base below.
        base = [(float(x), 0.0) for x in range(200)]
        extension = [(199, 50), (150, 50), (100, 50), (50, 50), (0, 50)]
        self.assert_as_the_reference(monkeypatch, base[::turn], extension, [(50, 40), (120, 38)])

    def test_find_what_was_drawn_far_out(self, monkeypatch):
        # (150, 80) draws the vertex (150, 0) out to (150, 40); (20, 41) is nearest to nothing else there.
        base = [(10.0 * x, 0.0) for x in range(300)]
        self.assert_as_the_reference(monkeypatch, base, [(1500, 80)], [(1508, 39), (1492, 39)], [(1501, 60)])


class TestAdvance:
    @pytest.mark.parametrize("long", [5, 1500], ids=["all long", "all in batches"])
    def test_counts_vertices(self, rng, monkeypatch, long):
        sets = flat(random_sets(rng, 50))
        monkeypatch.setattr(batch, "LONG", long)
        monkeypatch.setattr(batch, "_BATCH", 100)
        counts = []
        merge_sets(sets, advance=counts.append)
        assert len(counts) > 5
        assert sum(counts) <= len(sets.vertices)
        assert sum(counts) >= len(sets.vertices) - sets.base_size.sum()

    def test_comes_in_portions_within_one_long_set(self):
        base, rest = [(0, 0), (1, 0)], [(x, 0.1) for x in range(4000)]
        counts = []
        merge_sets(flat([[base, rest]]), advance=counts.append)
        assert len(counts) > 1
        assert sum(counts) == 4000

    def test_that_raises_stops_the_work(self, rng):
        def stop(_count):
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            merge_sets(flat(random_sets(rng, 5)), advance=stop)
