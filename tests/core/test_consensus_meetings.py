"""Lines that meet in the local maps meet in the map that is made of them, and others do not."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from shapely import LineString, Point

import polymerge_core as pm

CENTRE = np.array([50.0, 0.0])
WEST, NORTH, EAST = (np.array(point) for point in ((0.0, 0.0), (50.0, 40.0), (100.0, 10.0)))


def above(gap):
    return CENTRE + np.array([0.0, gap])


def surveys(streets, *, count=5, noise=0.3, classes=None):
    """Draw the same streets several times, each time with other errors, which touch where the true ones do."""
    rng, rows = np.random.default_rng(1), []
    for number in range(count):
        places = {}
        for which, street in enumerate(streets):
            moved = [places.setdefault(tuple(point), point + rng.normal(0, noise, 2)) for point in street]
            name = classes[which] if classes else "divider"
            rows.append((name, number, LineString(moved)))
    table = {"class": [row[0] for row in rows], "drive": "a", "instance": [row[1] for row in rows]}
    return gpd.GeoDataFrame(table, geometry=[row[2] for row in rows])


def merge(layer):
    return pm.merge(layer, method="consensus", crs="local")


def ends_at(elements, place, within):
    """Return the ends of the elements that are near a place."""
    ends = np.concatenate([shapely.get_coordinates(elements.boundary.explode())])
    return ends[np.hypot(*(ends - place).T) < within]


def test_streets_that_touch_end_at_one_point():
    result = merge(surveys([[WEST, CENTRE], [CENTRE, NORTH], [EAST, CENTRE]]))
    ends = ends_at(result.elements.geometry, CENTRE, 2.0)
    assert len(result.elements) == len(ends) == 3
    assert (ends == ends[0]).all()
    assert np.hypot(*(ends[0] - CENTRE)) < 0.5


def test_a_street_that_ends_at_another_ends_on_it_at_a_vertex():
    streets = [[WEST, CENTRE, EAST], [CENTRE, NORTH]]
    elements = merge(surveys(streets)).elements.geometry
    (end,) = ends_at(elements, CENTRE, 2.0)
    long = max(elements, key=lambda line: line.length)
    assert tuple(end) in set(long.coords)


def test_lines_of_two_classes_meet_too():
    streets = [[WEST, CENTRE, EAST], [CENTRE, NORTH]]
    elements = merge(surveys(streets, classes=["boundary", "divider"])).elements.set_index("class").geometry
    (end,) = ends_at(elements[["divider"]], CENTRE, 2.0)
    assert tuple(end) in set(elements["boundary"].coords)


def test_a_line_follows_its_end_without_a_kink():
    elements = merge(surveys([[WEST, CENTRE], [CENTRE, NORTH], [EAST, CENTRE]])).elements.geometry
    for line in elements:
        steps = np.diff(shapely.get_coordinates(line), axis=0)
        turn = np.degrees(np.diff(np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))))
        assert np.abs(turn).max(initial=0) < 20


@pytest.mark.parametrize("gap", [0.5, 1.5])
def test_lines_that_only_come_near_stay_apart(gap):
    streets = [[WEST, CENTRE, EAST], [above(gap), NORTH]]
    elements = merge(surveys(streets, noise=0.02)).elements.geometry
    (end,) = ends_at(elements, above(gap), 0.4)
    others = [line for line in elements if line.length > 60]
    assert Point(end).distance(others[0]) > gap / 2


def test_what_few_saw_touch_does_not_meet():
    apart = surveys([[WEST, CENTRE, EAST], [above(1.5), NORTH]], noise=0.02, count=6)
    corner = above(1.5)
    touching = surveys([[WEST, corner, EAST], [corner, NORTH]], noise=0.02, count=1).assign(instance=9)
    elements = merge(pd.concat([apart, touching], ignore_index=True)).elements.geometry
    short, long = sorted(elements, key=lambda line: line.length)
    assert short.distance(long) > 0.5


def test_a_ring_gets_a_vertex_where_a_line_ends_at_it():
    angle = np.linspace(0, 2 * np.pi, 60)
    ring = np.column_stack([20 * np.cos(angle), 20 * np.sin(angle)])
    ring[-1] = ring[0]
    spoke = [ring[10], 3 * ring[10]]
    elements = merge(surveys([list(ring), spoke], noise=0.1)).elements.geometry
    (closed,) = [line for line in elements if line.is_closed]
    (end,) = ends_at(elements[~elements.is_closed], ring[10], 2.0)
    assert tuple(end) in set(closed.coords)
