"""Section II.B.3, pedestrian crossings: coverage of many polygons, its blur, and the rectangle that is left.

Where copies of a crossing are shifted along one of its sides, the blurred coverage across the other side is a
mean of normal distributions, so the place where it passes the threshold is known. Raster results are exact to
two cells.
"""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity

from polymerge_core.area import coverage_grid, merge_areas

CELL = 0.1
TWO_CELLS = 2 * CELL
SIGMA = 0.35


def polygons_from(*polygons):
    return np.array(polygons, dtype=object)


def crossing(length=12.0, width=4.0, *, skew=0.0, angle=0.0, shift=(0.0, 0.0)):
    """Build a parallelogram around the origin, shifted along its sides and then turned."""
    x, y = length / 2, width / 2
    lean = skew / 2
    corners = [(-x - lean, -y), (x - lean, -y), (x + lean, y), (-x + lean, y)]
    moved = affinity.translate(shapely.Polygon(corners), *shift)
    return affinity.rotate(moved, angle, origin=(0, 0))


def rectangle(xmin, ymin, xmax, ymax, *, angle=0.0):
    return affinity.rotate(shapely.box(xmin, ymin, xmax, ymax), angle, origin=(0, 0))


def edge_position(positions, coverage, sigma=SIGMA):
    """Where the blurred coverage of half planes that begin at the positions passes the threshold."""
    low, high = min(positions) - 6 * sigma, max(positions) + 6 * sigma
    for _ in range(60):
        middle = (low + high) / 2
        value = sum(NormalDist(position, sigma).cdf(middle) for position in positions) / len(positions)
        low, high = (low, middle) if value >= coverage else (middle, high)
    return high


def assert_same_rectangle(polygon, expected, tolerance=TWO_CELLS):
    """Compare corner by corner; each may be off by the tolerance along both sides."""
    __tracebackhide__ = True
    assert_is_rectangle(polygon)
    corners, expected_corners = (shapely.get_coordinates(p)[:4] for p in (polygon, expected))
    distances = np.linalg.norm(corners[:, None] - expected_corners[None], axis=2).min(axis=1)
    assert distances.max() <= tolerance * math.sqrt(2), f"{polygon.wkt} is not {expected.wkt}"
    assert polygon.intersection(expected).area > 0.5 * expected.area


def assert_is_rectangle(polygon):
    __tracebackhide__ = True
    assert isinstance(polygon, shapely.Polygon)
    assert polygon.is_valid
    ring = shapely.get_coordinates(polygon)
    assert len(ring) == 5
    sides = np.diff(ring, axis=0)
    assert (np.linalg.norm(sides, axis=1) > 0).all()
    assert np.abs((sides[:-1] * sides[1:]).sum(axis=1)).max() < 1e-6 * max(1.0, polygon.area)


@st.composite
def crossing_groups(draw):
    """Draw a few convex quadrilaterals that look at one crossing, anywhere within 100 m of the origin."""
    length, width = draw(st.floats(4, 15)), draw(st.floats(2, 6))
    angle, skew = draw(st.floats(0, 180)), draw(st.floats(-1, 1))
    x, y = draw(st.floats(-100, 100)), draw(st.floats(-100, 100))
    shifts = draw(st.lists(st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)), min_size=1, max_size=6))
    return [affinity.translate(crossing(length, width, skew=skew, angle=angle, shift=shift), x, y) for shift in shifts]


class TestCoverageGrid:
    def test_of_one_polygon_is_1_inside_and_0_outside(self):
        grid = coverage_grid(polygons_from(crossing(4.03, 2.03, angle=45)))
        assert set(np.unique(grid.values)) == {0.0, 1.0}
        assert grid.cell == CELL

    def test_counts_the_share_of_the_polygons(self):
        shifted = [crossing(shift=(shift, 0)) for shift in (0.0, 0.0, 3.0, 6.0)]
        grid = coverage_grid(polygons_from(*shifted))
        assert set(np.unique(grid.values)) - {0.0} == {0.25, 0.5, 0.75, 1.0}

    @pytest.mark.parametrize("angle", [0, 33])
    def test_holds_the_mean_area_of_the_polygons(self, angle):
        polygons = [crossing(12.03, 4.03, angle=angle, shift=(shift, 0)) for shift in (0.0, 0.7, 1.9)]
        grid = coverage_grid(polygons_from(*polygons))
        # Half a cell along the outline at the most.
        assert grid.values.sum() * grid.cell**2 == pytest.approx(12.03 * 4.03, abs=32 * CELL / 2)

    def test_lies_where_the_polygons_lie_rows_upwards(self):
        # An L: x and y cannot be swapped, nor a direction turned round, without moving the centroid.
        shape = shapely.Polygon([(20, 50), (28, 50), (28, 52), (22, 52), (22, 56), (20, 56)])
        grid = coverage_grid(polygons_from(shape))
        rows, columns = np.nonzero(grid.values)
        assert grid.x0 + columns.mean() * CELL == pytest.approx(shape.centroid.x, abs=CELL)
        assert grid.y0 + rows.mean() * CELL == pytest.approx(shape.centroid.y, abs=CELL)

    def test_spans_the_bounding_box_of_the_union(self):
        grid = coverage_grid(polygons_from(rectangle(0, 0, 4, 2), rectangle(6, 5, 8, 9)))
        rows, columns = grid.values.shape
        assert columns * CELL == pytest.approx(8, abs=TWO_CELLS)
        assert rows * CELL == pytest.approx(9, abs=TWO_CELLS)

    def test_respects_holes(self):
        outline, hole = rectangle(0, 0, 10, 10), rectangle(3, 3, 7, 7)
        grid = coverage_grid(polygons_from(outline.difference(hole)))
        row, column = round((5 - grid.y0) / CELL), round((5 - grid.x0) / CELL)
        assert grid.values[row - 15 : row + 16, column - 15 : column + 16].max() == 0
        assert grid.values.sum() * CELL**2 == pytest.approx(84, abs=56 * CELL / 2)

    def test_cell_can_be_chosen(self):
        grid = coverage_grid(polygons_from(crossing()), cell=0.5)
        assert grid.cell == 0.5
        assert grid.values.shape == pytest.approx((8, 24), abs=2)

    @pytest.mark.parametrize("angle", [0, 40])
    def test_of_a_huge_polygon_has_coarser_cells(self, angle):
        grid = coverage_grid(polygons_from(crossing(500, 4, angle=angle)))
        assert grid.cell > CELL
        assert max(grid.values.shape) <= 2000
        assert min(grid.values.shape[1] * grid.cell, 500) >= 500 * math.cos(math.radians(angle)) - 1
        assert grid.values.max() == 1

    def test_at_the_limit_keeps_its_cell(self):
        assert coverage_grid(polygons_from(crossing(199, 4))).cell == CELL

    def test_of_polygons_in_another_order_is_the_same(self):
        polygons = [crossing(11.7, 3.9, angle=20 + k, shift=(0.3 * k, 0.1 * k)) for k in range(5)]
        first, second = coverage_grid(polygons_from(*polygons)), coverage_grid(polygons_from(*polygons[::-1]))
        assert np.array_equal(first.values, second.values)
        assert first[1:] == pytest.approx(second[1:], abs=1e-9)


class TestMergeAreas:
    @pytest.mark.parametrize("angle", [pytest.param(0, id="along the axes"), pytest.param(33, id="turned")])
    @pytest.mark.parametrize(
        ("shifts", "coverage"),
        [
            pytest.param([0], 0.5, id="one crossing, median"),
            pytest.param([0], 0.1, id="one crossing, large"),
            pytest.param([0], 0.95, id="one crossing, small"),
            pytest.param([0, 1], 0.5, id="two copies: halfway"),
            pytest.param([0, 1, 2], 0.5, id="three copies: the middle one"),
            pytest.param([0, 0, 3], 0.5, id="two of three in one place"),
            pytest.param([0, 3], 0.4, id="two copies far apart: union"),
            pytest.param([0, 3], 0.6, id="two copies far apart: intersection"),
            pytest.param([0, 0.2, 0.5, 0.9, 1.4, 2.0, 2.7], 0.25, id="seven copies, large"),
            pytest.param([0, 0.2, 0.5, 0.9, 1.4, 2.0, 2.7], 0.75, id="seven copies, small"),
        ],
    )
    def test_straight_crossing_of_known_coverage(self, shifts, coverage, angle):
        length, width = 12.03, 4.07
        copies = [crossing(length, width, angle=angle, shift=(shift, 0)) for shift in shifts]
        left = edge_position([shift - length / 2 for shift in shifts], coverage)
        right = -edge_position([-shift - length / 2 for shift in shifts], coverage)
        side = edge_position([-width / 2], coverage)
        result = merge_areas(polygons_from(*copies), coverage=coverage)
        assert_same_rectangle(result.polygon, rectangle(left, side, right, -side, angle=angle))
        assert (result.threshold, result.lowered) == (coverage, False)

    @pytest.mark.parametrize("angle", [0, 27, 90, 160])
    @pytest.mark.parametrize("skew", [0.8, -1.5])
    def test_skewed_crossing_becomes_the_rectangle_around_the_median_copy(self, skew, angle):
        shifts = [(-0.8, 0.2), (0, 0), (0.8, -0.2)]
        copies = [crossing(12, 3, skew=skew, angle=angle, shift=shift) for shift in shifts]
        expected = crossing(12, 3, skew=skew, angle=angle).minimum_rotated_rectangle
        sharp = merge_areas(polygons_from(*copies), sigma=0.1)
        assert_same_rectangle(sharp.polygon, expected)
        # The default blur takes up to 0.35 m off the sharp corners at both ends.
        assert_same_rectangle(merge_areas(polygons_from(*copies)).polygon, expected, tolerance=0.35)

    def test_three_identical_squares_are_that_square(self):
        square = rectangle(0, 0, 5, 5)
        result = merge_areas(polygons_from(square, square, square))
        assert_same_rectangle(result.polygon, square)

    @pytest.mark.parametrize("sigma", [0.2, 0.6])
    def test_blur_has_the_standard_deviation_asked_for(self, sigma):
        inset = sigma * NormalDist().inv_cdf(0.9)
        result = merge_areas(polygons_from(crossing(12, 6)), coverage=0.9, sigma=sigma)
        assert_same_rectangle(result.polygon, rectangle(-6 + inset, -3 + inset, 6 - inset, 3 - inset))

    def test_blur_is_not_distorted_at_the_edge_of_the_grid(self):
        # Blurred on a grid that ends at the bounding box, the crossing would grow no further than that box.
        outset = SIGMA * NormalDist().inv_cdf(0.95)
        result = merge_areas(polygons_from(crossing(12, 4)), coverage=0.05)
        assert_same_rectangle(
            result.polygon, rectangle(-6 - outset, -2 - outset, 6 + outset, 2 + outset), tolerance=CELL
        )

    def test_lower_coverage_gives_a_larger_area(self):
        copies = polygons_from(*[crossing(angle=20, shift=(0.5 * k, 0.2 * k)) for k in range(6)])
        large, median, small = (merge_areas(copies, coverage=coverage) for coverage in (0.1, 0.5, 0.95))
        assert large.polygon.area > median.polygon.area + 5 > small.polygon.area + 10
        assert large.polygon.contains(median.polygon)
        assert median.polygon.contains(small.polygon)

    def test_threshold_is_lowered_to_the_largest_value_present(self):
        squares = polygons_from(rectangle(0, 0, 5, 5), rectangle(20, 0, 25, 5))
        result = merge_areas(squares, coverage=0.9)
        assert result.lowered
        assert result.threshold == pytest.approx(0.5, abs=0.01)
        assert_is_rectangle(result.polygon)
        assert any(square.buffer(CELL).contains(result.polygon) for square in squares)

    def test_threshold_that_is_reached_is_not_lowered(self):
        result = merge_areas(polygons_from(crossing(), crossing(shift=(0.5, 0))), coverage=0.9)
        assert not result.lowered
        assert result.threshold == 0.9

    @pytest.mark.parametrize("turn", [1, -1], ids=["large one first", "large one last"])
    def test_of_several_parts_the_largest_wins(self, turn):
        parts = [rectangle(0, 0, 8, 8), rectangle(20, 0, 25, 5), rectangle(40, 20, 44, 24)]
        result = merge_areas(polygons_from(*parts[::turn]), coverage=0.3)
        inset = SIGMA * NormalDist().inv_cdf(0.9)
        assert_same_rectangle(result.polygon, rectangle(inset, inset, 8 - inset, 8 - inset))
        assert not result.lowered

    def test_parts_that_touch_at_a_corner_only_are_judged_by_what_the_blur_leaves(self):
        # At the shared corner the coverage of 1/2 falls to 1/4: at 0.4 they are two parts.
        corner = polygons_from(rectangle(0, 0, 4, 4), rectangle(4, 4, 10, 10))
        result = merge_areas(corner, coverage=0.4)
        inset = SIGMA * NormalDist().inv_cdf(0.8)
        assert_same_rectangle(result.polygon, rectangle(4 + inset, 4 + inset, 10 - inset, 10 - inset))

    def test_polygon_with_a_hole_gives_the_rectangle_around_it(self):
        ring = rectangle(0, 0, 10, 10).difference(rectangle(3, 3, 7, 7))
        assert_same_rectangle(merge_areas(polygons_from(ring)).polygon, rectangle(0, 0, 10, 10))

    def test_order_of_the_input_does_not_matter(self, rng):
        copies = [crossing(11.9, angle=15 + k, shift=tuple(rng.normal(0, 0.4, 2))) for k in range(7)]
        expected = merge_areas(polygons_from(*copies))
        for _ in range(3):
            rng.shuffle(copies)
            result = merge_areas(polygons_from(*copies))
            assert result.polygon.normalize().equals_exact(expected.polygon.normalize(), 1e-9)
            assert result[1:] == expected[1:]

    @pytest.mark.parametrize("offset", [(5e6, 5e6), (-5e6, 3.3), (0.05, 0.03)])
    def test_translated_is_translated(self, offset):
        copies = [crossing(11.9, 3.9, angle=17 + k, shift=(0.3 * k, 0.1 * k)) for k in range(4)]
        expected = affinity.translate(merge_areas(polygons_from(*copies)).polygon, *offset)
        moved = polygons_from(*[affinity.translate(copy, *offset) for copy in copies])
        assert_same_rectangle(merge_areas(moved).polygon, expected)

    @pytest.mark.parametrize(("length", "width"), [(500, 6), (5000, 60)])
    def test_of_a_huge_crossing_is_exact_to_two_of_its_coarser_cells(self, length, width):
        # With cells of 0.1 m, the larger of the two would take 10 GB.
        copies = polygons_from(*[crossing(length, width, angle=40, shift=(0, 0.1 * k)) for k in range(3)])
        expected = crossing(length, width, angle=40, shift=(0, 0.1))
        assert_same_rectangle(merge_areas(copies).polygon, expected, tolerance=2 * length / 2000)

    @pytest.mark.parametrize(("length", "width"), [(0.04, 0.03), (8, 0.03), (0.9, 0.6)])
    def test_of_a_crossing_smaller_than_the_blur_is_still_a_rectangle_there(self, length, width):
        small = affinity.translate(crossing(length, width, angle=10), 33.3, 44.4)
        result = merge_areas(polygons_from(small))
        assert_is_rectangle(result.polygon)
        assert result.lowered
        assert small.buffer(TWO_CELLS).contains(result.polygon)

    def test_inputs_are_not_changed(self):
        polygons = polygons_from(crossing(), crossing(shift=(1, 0)))
        before = [polygon.wkb for polygon in polygons]
        polygons.flags.writeable = False
        merge_areas(polygons)
        assert [polygon.wkb for polygon in polygons] == before

    @settings(max_examples=30)
    @given(crossing_groups(), st.sampled_from([0.1, 0.5, 0.9]))
    def test_is_a_rectangle_near_the_crossings_whatever_their_order(self, copies, coverage):
        result = merge_areas(polygons_from(*copies), coverage=coverage)
        assert_is_rectangle(result.polygon)
        assert result.lowered == (result.threshold < coverage)
        # Half a plane is the most that a convex crossing covers: no cell beyond the outset is kept.
        outset = max(0.0, SIGMA * NormalDist().inv_cdf(1 - coverage)) + TWO_CELLS
        reach = shapely.union_all(copies).convex_hull.buffer(outset)
        assert result.polygon.area <= reach.minimum_rotated_rectangle.area * 1.0001
        ring = shapely.get_coordinates(result.polygon)
        sides = shapely.linestrings(np.stack((ring[:-1], ring[1:]), axis=1))
        assert shapely.intersects(sides, reach).all()
        reverse = merge_areas(polygons_from(*copies[::-1]), coverage=coverage)
        assert reverse.polygon.normalize().equals_exact(result.polygon.normalize(), 1e-6)
