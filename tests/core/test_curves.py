"""Polylines as flat arrays."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from polymerge_core.curves import Curves, distinct


@pytest.mark.parametrize("off", [-1e-12, 0.0, 1e-12])
def test_a_stretch_that_ends_at_a_vertex_but_for_rounding_has_it_once(off):
    ring = np.array([shapely.LinearRing([(0.1, 0.2), (3.3, 0.7), (2.9, 4.1)])], dtype=object)
    curves = Curves(shapely.linestrings(shapely.get_coordinates(ring), indices=np.zeros(4, dtype=np.intp)))
    (line,) = curves.stretches(np.array([0]), np.array([curves.arc[1] - off]), curves.length + off)
    steps = np.hypot(*np.diff(shapely.get_coordinates(line), axis=0).T)
    assert len(steps) == 2
    assert steps.min() > 1


def test_what_lies_beyond_an_end_falls_exactly_onto_it():
    # Lengths are sums over all lines before, so that they differ from each line's own by rounding.
    rng = np.random.default_rng(1)
    lines = shapely.linestrings(rng.uniform(0, 1e3, (200, 7, 2)))
    curves, every = Curves(lines), np.arange(200)
    for end, position in ((0, np.zeros(200)), (-1, curves.length)):
        ends = shapely.get_coordinates(shapely.get_point(lines, end))
        assert curves.locate(every, ends).tolist() == position.tolist()


@pytest.mark.filterwarnings("error")
def test_a_line_without_length_is_one_place():
    curves = Curves(shapely.linestrings([[(3, 4), (3, 4)], [(0, 0), (9, 0)]]))
    assert curves.points_at(np.array([0, 0, 1]), np.array([7.0, -7.0, 5.0])).tolist() == [[3, 4], [3, 4], [5, 0]]


def test_distinct_values_rise():
    assert distinct(np.array([3, 1, 3, 2, 1])).tolist() == [1, 2, 3]
    assert distinct(np.array([], dtype=np.intp)).tolist() == []
