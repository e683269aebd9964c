"""Eq. 2 and the four scenarios of section II.B.3, on lines one can draw on paper."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from polymerge_core import polyline
from polymerge_core.polyline import merge_polyline, merge_polylines, merge_vertex, project_points
from tests import reference

STRAIGHT = [(0, 0), (10, 0)]
BENT = [(0, 0), (10, 0), (10, 10)]
TWO_SEGMENTS = [(0, 0), (10, 0), (20, 0)]
SQUARE = [(0, 0), (10, 0), (10, 10), (0, 10), (0, 0)]


def array(points):
    return np.array(points, dtype=float).reshape(-1, 2)


def free_coordinates():
    """Any position within 10 km, to a tenth of a micrometre: no segment is shorter than 1e-9 m by chance."""
    return st.floats(-9999, 9999, allow_nan=False).map(lambda value: round(value, 7))


def grid_coordinates():
    """A coarse grid, on which ties, coincident vertices, collinear and closed lines are frequent."""
    return st.integers(-4, 4).map(lambda value: value / 2)


def lines_over(coordinates, *, smallest=2, largest=7):
    points = st.tuples(coordinates, coordinates)
    lines = st.lists(points, min_size=smallest, max_size=largest)
    closed = lines.map(lambda line: [*line, line[0]])
    return st.one_of(lines, closed).map(reference.remove_short_segments).filter(lambda line: len(line) >= 2)


@st.composite
def line_groups(draw):
    coordinates = draw(st.sampled_from([free_coordinates(), grid_coordinates()]))
    return draw(st.lists(lines_over(coordinates), min_size=2, max_size=4))


def assert_same_line(result, expected):
    __tracebackhide__ = True
    expected = array(expected)
    assert result.shape == expected.shape, f"{result.tolist()} is not {expected.tolist()}"
    np.testing.assert_allclose(result, expected, rtol=0, atol=1e-9)


class TestProjection:
    @pytest.mark.parametrize(
        ("point", "line", "segment", "parameter", "foot", "distance"),
        [
            pytest.param((4, 3), STRAIGHT, 0, 0.4, (4, 0), 3, id="inside the segment"),
            pytest.param((-3, 4), STRAIGHT, 0, 0, (0, 0), 5, id="clamped to the first vertex"),
            pytest.param((13, 4), STRAIGHT, 0, 1, (10, 0), 5, id="clamped to the last vertex"),
            pytest.param((4, 0), STRAIGHT, 0, 0.4, (4, 0), 0, id="on the line"),
            pytest.param((-2, 0), STRAIGHT, 0, 0, (0, 0), 2, id="on the line's extension"),
            pytest.param((7, 4), BENT, 1, 0.4, (10, 4), 3, id="nearest segment is the second"),
            pytest.param((8, 2), BENT, 0, 0.8, (8, 0), 2, id="equally near inside two segments: the first"),
            pytest.param((13, -4), BENT, 0, 1, (10, 0), 5, id="outside the corner: end of the first segment"),
            pytest.param((10, 0), BENT, 0, 1, (10, 0), 0, id="on the corner: end of the first segment"),
            pytest.param((10, 7), TWO_SEGMENTS, 0, 1, (10, 0), 7, id="beside an inner vertex"),
            pytest.param((-1, -1), SQUARE, 0, 0, (0, 0), 2**0.5, id="at the start of a closed line"),
            pytest.param((5, 5), SQUARE, 0, 0.5, (5, 0), 5, id="centre of a square: four equally near"),
        ],
    )
    def test_of_one_point(self, point, line, segment, parameter, foot, distance):
        result = project_points(array([point]), array(line))
        assert result.segment.tolist() == [segment]
        assert result.parameter.tolist() == pytest.approx([parameter], abs=1e-12)
        np.testing.assert_allclose(result.foot, [foot], rtol=0, atol=1e-12)
        assert result.distance.tolist() == pytest.approx([distance], abs=1e-12)

    def test_parameter_of_a_clamped_point_is_exactly_0_or_1(self):
        result = project_points(array([(-1e-3, -1e-3), (0.3 + 1e-3, 0.9)]), array([(0, 0), (0.3, 0.9)]))
        assert result.parameter.tolist() == [0.0, 1.0]

    def test_foot_at_the_end_of_a_segment_is_that_vertex_exactly(self):
        end = (0.1 + 0.2, 1 / 3)
        result = project_points(array([(5, 5)]), array([(0.7, -1234.1), end]))
        assert result.parameter.tolist() == [1.0]
        assert tuple(result.foot[0]) == end

    def test_many_points_at_once_are_as_one_by_one(self, rng):
        points, line = rng.uniform(0, 100, (200, 2)), rng.uniform(0, 100, (30, 2))
        together = project_points(points, line)
        for index, point in enumerate(points):
            alone = project_points(point[None], line)
            assert together.segment[index] == alone.segment[0]
            assert together.parameter[index] == alone.parameter[0]
            assert together.foot[index].tolist() == alone.foot[0].tolist()
            assert together.distance[index] == alone.distance[0]

    def test_of_no_points_is_empty(self):
        result = project_points(np.empty((0, 2)), array(STRAIGHT))
        assert (len(result.segment), len(result.parameter), len(result.distance)) == (0, 0, 0)
        assert result.foot.shape == (0, 2)

    def test_long_line_and_many_points_are_as_the_reference(self, rng):
        line = np.cumsum(rng.normal(0, 1, (2500, 2)), axis=0)
        points = line[rng.integers(0, 2500, 40)] + rng.normal(0, 2, (40, 2))
        result = project_points(points, line)
        expected_line = [tuple(vertex) for vertex in line.tolist()]
        for index, point in enumerate(points.tolist()):
            expected = reference.project(tuple(point), expected_line)
            assert result.segment[index] == expected.segment
            assert result.parameter[index] == pytest.approx(expected.parameter, abs=1e-12)
            assert result.distance[index] == pytest.approx(expected.distance, abs=1e-12)

    @given(line_groups())
    def test_agrees_with_the_reference(self, lines):
        line, *others = lines
        points = [point for other in others for point in other]
        result = project_points(array(points), array(line))
        for index, point in enumerate(points):
            expected = reference.project(point, line)
            assert result.segment[index] == expected.segment
            assert result.parameter[index] == pytest.approx(expected.parameter, abs=1e-12)
            assert result.foot[index].tolist() == pytest.approx(list(expected.point), abs=1e-9)
            assert result.distance[index] == pytest.approx(expected.distance, abs=1e-9)


class TestFourScenarios:
    @pytest.mark.parametrize(
        ("base", "point", "expected"),
        [
            pytest.param(STRAIGHT, (4, 2), [(0, 0), (4, 1), (10, 0)], id="1: midpoint inserted"),
            pytest.param(BENT, (8, 5), [(0, 0), (10, 0), (9, 5), (10, 10)], id="1: in the second segment"),
            pytest.param(STRAIGHT, (4, 0), [(0, 0), (4, 0), (10, 0)], id="1: point on the base itself"),
            pytest.param(BENT, (12, -2), [(0, 0), (11, -1), (10, 10)], id="2: outside a corner"),
            pytest.param(TWO_SEGMENTS, (10, 4), [(0, 0), (10, 2), (20, 0)], id="2: straight beside an inner vertex"),
            pytest.param(TWO_SEGMENTS, (10, 0), TWO_SEGMENTS, id="2: point equals the inner vertex"),
            pytest.param(STRAIGHT, (-2, 1), [(-2, 1), (0, 0), (10, 0)], id="3: before the first vertex"),
            pytest.param(STRAIGHT, (0, 1), [(0, 1), (0, 0), (10, 0)], id="3: beside the first vertex"),
            pytest.param(STRAIGHT, (0, 0), STRAIGHT, id="3: point equals the first vertex"),
            pytest.param(STRAIGHT, (12, 1), [(0, 0), (10, 0), (12, 1)], id="4: behind the last vertex"),
            pytest.param(STRAIGHT, (10, 1), [(0, 0), (10, 0), (10, 1)], id="4: beside the last vertex"),
            pytest.param(STRAIGHT, (10, 0), STRAIGHT, id="4: point equals the last vertex"),
        ],
    )
    def test_open_base(self, base, point, expected):
        assert merge_vertex(array(base), array(point)[0]).tolist() == array(expected).tolist()

    @pytest.mark.parametrize(
        ("point", "expected"),
        [
            pytest.param((-2, -4), [(-1, -2), (10, 0), (10, 10), (0, 10), (-1, -2)], id="2: both copies of the start"),
            pytest.param((0, 0), SQUARE, id="2: point equals the start"),
            pytest.param((12, 14), [(0, 0), (10, 0), (11, 12), (0, 10), (0, 0)], id="2: another corner"),
            pytest.param((5, -2), [(0, 0), (5, -1), (10, 0), (10, 10), (0, 10), (0, 0)], id="1: first side"),
            pytest.param((-2, 5), [(0, 0), (10, 0), (10, 10), (0, 10), (-1, 5), (0, 0)], id="1: last side"),
        ],
    )
    def test_closed_base_stays_closed(self, point, expected):
        assert merge_vertex(array(SQUARE), array(point)[0]).tolist() == array(expected).tolist()

    def test_line_that_ends_where_another_vertex_lies_is_not_closed(self):
        lasso = [(0, 0), (10, 0), (10, 10), (10, 0)]
        result = merge_vertex(array(lasso), array((11, -1))[0])
        assert result.tolist() == [[0, 0], [10.5, -0.5], [10, 10], [10, 0]]

    def test_of_equally_near_segments_the_first_gets_the_midpoint(self):
        hairpin = [(0, 0), (10, 0), (10, 2), (0, 2)]
        result = merge_vertex(array(hairpin), array((4, 1))[0])
        assert result.tolist() == [[0, 0], [4, 0.5], [10, 0], [10, 2], [0, 2]]

    def test_parameter_next_to_the_end_is_still_inside_the_segment(self):
        point = (np.nextafter(10.0, 0.0), 2.0)
        result = merge_vertex(array(STRAIGHT), np.array(point))
        assert result.tolist() == [[0, 0], [point[0], 1], [10, 0]]

    def test_base_is_not_changed(self):
        base = array(SQUARE)
        for point in [(5, -1), (-1, -1), (11, 11)]:
            merge_vertex(base, np.array(point, dtype=float))
        assert base.tolist() == array(SQUARE).tolist()

    def test_result_does_not_share_memory_with_the_base_when_nothing_is_inserted(self):
        base = array(STRAIGHT)
        result = merge_vertex(base, base[0])
        result[:] = -1
        assert base.tolist() == array(STRAIGHT).tolist()

    @given(line_groups())
    def test_agree_with_the_reference(self, lines):
        base, *others = lines
        for other in others:
            result = merge_vertex(array(base), array(other)[0])
            assert_same_line(result, reference.merge_vertex(base, other[0]))


class TestMergePolyline:
    def test_goes_vertex_by_vertex_in_the_order_of_the_polyline(self):
        base, first, second = array(STRAIGHT), (4, 2), (12, 1)
        one_by_one = merge_vertex(merge_vertex(base, np.array(first, float)), np.array(second, float))
        result = merge_polyline(base, array([first, second]))
        assert result.tolist() == one_by_one.tolist() == [[0, 0], [4, 1], [10, 0], [12, 1]]

    def test_each_vertex_sees_the_base_as_the_one_before_left_it(self):
        # (4, 2) makes the vertex (4, 1), to which (4, 3) projects: on the base as given it would be (4, 0).
        result = merge_polyline(array(STRAIGHT), array([(4, 2), (4, 3)]))
        assert result.tolist() == [[0, 0], [4, 2], [10, 0]]

    def test_extends_the_base_along_its_direction(self):
        result = merge_polyline(array(STRAIGHT), array([(11, 0), (15, 0), (20, 1)]))
        assert result.tolist() == [[0, 0], [10, 0], [11, 0], [15, 0], [20, 1]]

    def test_of_the_opposite_direction_extends_the_start(self):
        result = merge_polyline(array(STRAIGHT), array([(-1, 0), (-5, 1)]))
        assert result.tolist() == [[-5, 1], [-1, 0], [0, 0], [10, 0]]

    def test_that_arrives_from_afar_runs_back_and_forth_as_published(self):
        # (20, 1) becomes the new end first; (15, 0) is then inserted before it, and so is (11, 0).
        result = merge_polyline(array(STRAIGHT), array([(20, 0), (15, 0), (11, 0)]))
        assert result.tolist() == [[0, 0], [10, 0], [11, 0], [15, 0], [20, 0]]

    @pytest.mark.parametrize(
        "line",
        [
            pytest.param(STRAIGHT, id="straight"),
            pytest.param(BENT, id="bent"),
            pytest.param(SQUARE, id="closed"),
            pytest.param([(0.1, 0.7), (1 / 3, 2 / 3), (5.3, 9.9), (7.7, 1.1)], id="not on a grid"),
            pytest.param([(0, 0), (4, 4), (4, 0), (0, 4)], id="self-crossing"),
        ],
    )
    @pytest.mark.parametrize("step", [pytest.param(1, id="copy"), pytest.param(-1, id="reversed copy")])
    def test_with_a_copy_of_itself_is_itself(self, line, step):
        assert merge_polyline(array(line), array(line)[::step]).tolist() == array(line).tolist()

    def test_with_a_copy_that_starts_elsewhere_on_the_ring_is_itself(self):
        rotated = [*SQUARE[2:-1], *SQUARE[:3]]
        assert merge_polyline(array(SQUARE), array(rotated)).tolist() == array(SQUARE).tolist()

    def test_vertex_that_faces_the_end_may_project_before_it_once_the_base_is_tilted(self):
        # (10, 1) lifts the inner vertex to (10, 0.5), and (20, 1) then falls inside the tilted segment.
        base, other = [(0, 0), (10, 0), (20, 0)], [(0, 1), (10, 1), (20, 1)]
        t = (10 * 10 + 0.5 * -0.5) / (10**2 + 0.5**2)
        inserted = ((10 + 10 * t + 20) / 2, (0.5 - 0.5 * t + 1) / 2)
        assert_same_line(merge_polyline(array(base), array(other)), [(0, 1), (0, 0), (10, 0.5), inserted, (20, 0)])

    def test_inputs_are_not_changed(self):
        base, other = array(BENT), array([(4, 2), (12, -2), (11, 12)])
        base.flags.writeable = other.flags.writeable = False
        merge_polyline(base, other)
        merge_polylines(base, [other, other])
        assert base.tolist() == array(BENT).tolist()
        assert other.tolist() == [[4, 2], [12, -2], [11, 12]]

    def test_many_lines_go_one_after_the_other(self):
        base, first, second = array(STRAIGHT), array([(4, 2), (12, 1)]), array([(4, 3), (-1, 0)])
        expected = merge_polyline(merge_polyline(base, first), second)
        assert merge_polylines(base, [first, second]).tolist() == expected.tolist()
        assert expected.tolist() == [[-1, 0], [0, 0], [4, 2], [10, 0], [12, 1]]

    def test_no_lines_leave_the_base(self):
        assert merge_polylines(array(BENT), []).tolist() == array(BENT).tolist()

    @given(line_groups())
    def test_agrees_with_the_reference(self, lines):
        base, *others = lines
        result = merge_polyline(array(base), array(others[0]))
        assert_same_line(result, reference.merge_polyline(base, others[0]))

    @given(line_groups())
    def test_of_several_lines_agrees_with_the_reference(self, lines):
        base, *others = lines
        expected = base
        for other in others:
            expected = reference.merge_polyline(expected, other)
        assert_same_line(merge_polylines(array(base), [array(other) for other in others]), expected)

    @given(line_groups())
    def test_closed_base_stays_closed_and_an_open_one_open(self, lines):
        base, *others = lines
        result = merge_polylines(array(base), [array(other) for other in others])
        assert (result[0].tolist() == result[-1].tolist()) == (base[0] == base[-1])

    @given(line_groups(), st.integers(0, 3))
    def test_quarter_turns_turn_the_result(self, lines, turns):
        # Multiples of 90 degrees are exact in floating point, so that no tie is decided another way.
        turn = np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), turns)
        base, *others = [array(line) for line in lines]
        expected = merge_polylines(base, others) @ turn
        assert_same_line(merge_polylines(base @ turn, [other @ turn for other in others]), expected)


class TestLongBase:
    """A base of a thousand and more vertices, where an implementation may not look at all of them."""

    @pytest.fixture
    def winding(self, rng):
        heading = np.cumsum(rng.normal(0, 0.2, 1500))
        return np.cumsum(np.column_stack((np.cos(heading), np.sin(heading))), axis=0)

    @staticmethod
    def by_reference(base, others):
        line = [tuple(vertex) for vertex in base.tolist()]
        for other in others:
            line = reference.merge_polyline(line, [tuple(vertex) for vertex in other.tolist()])
        return line

    def test_near_observations_of_its_parts(self, winding, rng):
        starts = rng.integers(0, 1400, 10)
        others = [winding[start : start + 60 : 5] + rng.normal(0, 0.3, (12, 2)) for start in starts]
        expected = self.by_reference(winding, others)
        assert len(expected) > len(winding) + 50
        assert_same_line(merge_polylines(winding, others), expected)

    def test_far_points_and_extensions_at_both_ends(self, winding, rng):
        others = [
            winding[0] + np.array([(-5.0, 1), (-9, 2), (-30, 5)]),
            winding[-1] + np.array([(3.0, 1), (8, -2), (30, 5)]),
            rng.uniform(-200, 200, (20, 2)),
        ]
        assert_same_line(merge_polylines(winding, others), self.by_reference(winding, others))

    def test_closed(self, rng):
        angle = np.linspace(0, 2 * np.pi, 1200)
        ring = 100 * np.column_stack((np.cos(angle), np.sin(angle)))
        ring[-1] = ring[0]
        others = [ring[[0, 1, 500, 1198]] * 1.01, rng.uniform(-150, 150, (20, 2)), ring[::-7] * 0.99]
        result = merge_polylines(ring, others)
        assert result[0].tolist() == result[-1].tolist()
        assert_same_line(result, self.by_reference(ring, others))

    def test_ties_between_far_apart_parts_go_to_the_first(self):
        # A comb of 600 teeth: every point of the line y = 10 is as near to two neighbouring teeth.
        x = np.arange(1200) // 2 * 2.0
        comb = np.column_stack((x, np.tile([0.0, 20.0, 20.0, 0.0], 300)))
        others = [np.column_stack((np.arange(1.0, 1199, 6), np.full(200, 10.0)))]
        assert_same_line(merge_polylines(comb, others), self.by_reference(comb, others))

    @pytest.mark.parametrize("x", [588.5, 428.5, 308.5, 148.5, 28.5])
    def test_tie_with_a_far_later_part_that_reaches_nearer_elsewhere(self, x):
        # A long U whose way back, 20 m above, bulges towards the point 10 m beside it; both legs are 10 m away.
        there = np.column_stack((np.arange(600.0), np.zeros(600)))
        turn = np.column_stack((np.full(300, 700.0), np.linspace(0, 20, 300)))
        back = np.column_stack((np.arange(599.0, -1, -1), np.where(np.arange(600) % 20 == 0, 15.0, 20.0)))
        base = np.vstack((there, turn, back))
        expected = np.insert(base, int(x) + 1, (x, 5), axis=0)
        assert_same_line(merge_polylines(base, [np.array([(x, 10.0)])]), expected)

    def test_many_points_in_one_place(self, winding, rng):
        others = [winding[700] + rng.normal(0, 0.5, (400, 2))]
        assert_same_line(merge_polylines(winding, others), self.by_reference(winding, others))

    def test_base_that_grows_long_while_it_is_merged(self, rng):
        others = [np.column_stack((np.sort(rng.uniform(0, 100, 60)), rng.normal(0, 0.3, 60))) for _ in range(20)]
        base = array([(0, 0), (50, 0), (100, 0)])
        assert_same_line(merge_polylines(base, others), self.by_reference(base, others))

    @pytest.mark.parametrize("count", [2, 3, 63, 64, 65, 127, 128, 129, 130, 255, 256, 257, 258, 1023, 1025])
    def test_of_any_length(self, count, rng):
        heading = np.cumsum(rng.normal(0, 0.2, count))
        base = np.cumsum(np.column_stack((np.cos(heading), np.sin(heading))), axis=0)
        others = [
            base[rng.integers(0, count, 12)] + rng.normal(0, 0.5, (12, 2)),
            base[-1] + np.array([(0.5, 0.1), (2, 1)]),
            base[0] - np.array([(0.5, 0.1), (2, 1)]),
        ]
        assert_same_line(merge_polylines(base, others), self.by_reference(base, others))

    def test_vertices_drawn_far_out_are_found_there_from_both_sides(self):
        # Each spike makes a vertex leave the surroundings of its neighbours: (x, 0) becomes (x, 20).
        base = np.column_stack((10.0 * np.arange(1500), np.zeros(1500)))
        others = [np.array([(x, 40), (x + 1.5, 18), (x - 1.5, 18)]) for x in base[8:-8:8, 0]]
        assert_same_line(merge_polylines(base, others), self.by_windows(base, others))

    def test_vertices_reached_by_the_segment_behind_them(self, rng):
        # By rounding, the foot on the segment before a corner may lie farther off than the corner itself.
        zigzag = np.column_stack((10.0 * np.arange(1500), np.tile([-3.0, 3.0], 750)))
        base = zigzag + rng.normal(0, 0.5, zigzag.shape)
        others = []
        for index in range(8, 1492, 4):
            corner, around = base[index], [tuple(vertex) for vertex in base[index - 3 : index + 4].tolist()]
            for point in beside_the_end(rng, *base[index - 1 : index + 2], count=60):
                foot = reference.project(tuple(point), around)
                if (foot.segment, foot.parameter) == (3, 0.0):
                    spike = (corner + point) / 2
                    others.append(np.vstack((point, np.add(spike, [(-1.5, 0.5), (1.5, 0.5)]))))
                    break
        assert len(others) > 300
        assert_same_line(merge_polylines(base, others), self.by_windows(base, others))

    @staticmethod
    def by_windows(base, others):
        """Merge by the reference lines that lie along x, each with the part of the base within 60 m."""
        line = [tuple(vertex) for vertex in base.tolist()]
        for other in others:
            near = [index for index, vertex in enumerate(line) if abs(vertex[0] - other[0, 0]) < 60]
            part = line[near[0] : near[-1] + 1]
            line[near[0] : near[-1] + 1] = reference.merge_polyline(part, [tuple(v) for v in other.tolist()])
        return line


def beside_the_end(rng, before, end, after, *, count):
    """Points on the perpendicular to the segment before-end at its end, on the side away from `after`."""
    along = (end - before) / np.linalg.norm(end - before)
    normal = np.array([-along[1], along[0]])
    outwards = normal if normal @ (end - after) > 0 else -normal
    return end + outwards * rng.uniform(0.1, 15, (count, 1))


@pytest.mark.parametrize("count", [0, 1500], ids=["a few vertices", "many vertices"])
def test_start_of_a_closed_base_reached_by_its_last_segment(rng, count):
    # By rounding, the foot on the first segment may lie farther off than the start itself.
    found = 0
    for _ in range(2000):
        if found == 3:
            break
        second, start, last = rng.uniform(0, 100, (3, 2))
        way_round = np.column_stack((np.linspace(second[0], last[0], count + 3)[1:-1], np.full(count + 1, -200)))
        ring = np.vstack((start, second, way_round, last, start))
        (point,) = beside_the_end(rng, second, start, last, count=1)
        line = [tuple(vertex) for vertex in ring.tolist()]
        foot = reference.project(tuple(point), line)
        if (foot.segment, foot.parameter) == (len(ring) - 2, 1.0):
            found += 1
            other = np.vstack((point, np.add(start, [(0.3, 0.2), (-0.3, 0.2), (0.1, -0.4)])))
            result = merge_polylines(ring, [other])
            assert result[0].tolist() == result[-1].tolist()
            assert_same_line(result, reference.merge_polyline(line, [tuple(v) for v in other.tolist()]))
    assert found > 0


def test_projection_of_many_points_in_small_portions_is_the_same(rng, monkeypatch):
    points, line = rng.uniform(0, 100, (200, 2)), rng.uniform(0, 100, (30, 2))
    whole = project_points(points, line)
    monkeypatch.setattr(polyline, "_MATRIX", 100)
    for part, expected in zip(project_points(points, line), whole, strict=True):
        assert part.tolist() == expected.tolist()
