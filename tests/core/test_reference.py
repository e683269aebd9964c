"""The whole published method against its literal reference: random maps, and the sample of the package.

Asked for are the same edges, the same sets of observations, and for each set the same line: vertex count,
order, and coordinates within 1e-9 m. Pairs within 1e-9 m of the threshold would be excepted; there are none.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np
import pytest
import shapely

import polymerge_core
from tests import reference

CLASSES = ("divider", "boundary")
TOLERANCE_M = 1e-9


class RandomMap(NamedTuple):
    """A layer of local maps in random row order, a main map or none, and what the reference is to be fed."""

    local_maps: gpd.GeoDataFrame
    main_map: gpd.GeoDataFrame | None
    polylines: dict[int, reference.Polyline]
    proximity: float


def sort_key(points):
    """WKB of the line without its short segments: normalised, and as it is."""
    line = shapely.LineString(reference.remove_short_segments(points))
    return shapely.to_wkb(shapely.normalize(line)), shapely.to_wkb(line)


def true_line(rng):
    """Draw a gently bent road line of some 30 m, or an island of 4 to 7 corners."""
    centre = rng.uniform(0, 40, 2)
    if rng.random() < 0.2:
        corners = int(rng.integers(4, 8))
        angle = rng.uniform(0, 2 * np.pi) + np.arange(corners) * 2 * np.pi / corners
        ring = centre + rng.uniform(2, 8) * np.column_stack((np.cos(angle), np.sin(angle)))
        return np.vstack((ring, ring[:1]))
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.1, 31))
    return centre + np.cumsum(np.column_stack((np.cos(heading), np.sin(heading))), axis=0)


def observe(rng, line, grid):
    """One frame's view of a line: a part of it in 2 to 8 noisy vertices, some twice, in either direction."""
    count = int(rng.integers(2, 9))
    if (line[0] == line[-1]).all():
        corners = line[:-1] + rng.normal(0, 0.3, (len(line) - 1, 2))
        points = np.vstack((corners, corners[:1]))
        if rng.random() < 0.3:  # not every detection of an island is closed
            points = points[:-1]
    else:
        start, stop = np.sort(rng.uniform(0, 30, 2))
        where = np.sort(rng.uniform(start, max(stop, start + 1), count))
        points = np.column_stack([np.interp(where, np.arange(31), line[:, axis]) for axis in (0, 1)])
        points += rng.normal(0, 0.3, 2) + rng.normal(0, 0.15, (count, 2))
    if grid:
        points = np.round(points / grid) * grid
    if rng.random() < 0.5:
        points = points[::-1]
    if rng.random() < 0.2:
        points = np.repeat(points, rng.integers(1, 3, len(points)), axis=0)
    return [(x, y) for x, y in points.tolist()]


def instance_columns(rng, count):
    """Names, times and ranks of the instances, by one of the three ways in which they can be ordered."""
    ranks = rng.permutation(count)
    way = rng.integers(3)
    if way == 0:  # natural order of the numbers: 10 comes after 9
        numbers = np.sort(rng.choice(30, count, replace=False))
        return [{"instance": int(numbers[rank])} for rank in ranks], ranks
    if way == 1:  # natural order of the names
        numbers = np.sort(rng.choice(np.arange(5, 150), count, replace=False))
        return [{"instance": f"frame {numbers[rank]}"} for rank in ranks], ranks
    # The time of the drive's first frame, the drive, then the time of the frame; names say nothing.
    second_drive = int(rng.integers(1, count + 1))
    names = rng.permutation(count)
    return [
        {
            "drive": "b" if rank < second_drive else "a",
            "instance": int(names[rank]),
            "timestamp": int(1_700_000_000_000_000_000 + 500_000_000 * rank),
        }
        for rank in ranks
    ], ranks


def random_map(seed, *, grid=0.0):
    rng = np.random.default_rng(seed)
    lines = [(CLASSES[rng.integers(2)], true_line(rng)) for _ in range(rng.integers(2, 9))]
    columns, ranks = instance_columns(rng, int(rng.integers(1, 7)))
    has_main_map = rng.random() < 0.3
    rows: list[dict[str, Any]] = []
    polylines: dict[int, reference.Polyline] = {}
    seen = set()
    for _ in range(rng.integers(5, 41)):
        cls, line = lines[rng.integers(len(lines))]
        points = observe(rng, line, grid)
        instance = int(rng.integers(len(columns)))
        if len(reference.remove_short_segments(points)) < 2 or (cls, instance, tuple(points)) in seen:
            continue
        seen.add((cls, instance, tuple(points)))
        fid = 100 + 7 * len(rows)
        is_main = has_main_map and rng.random() < 0.3
        rank = -1 if is_main else int(ranks[instance])
        polylines[fid] = reference.Polyline(points, cls, rank, is_main, sort_key(points))
        rows.append({"fid": fid, "class": cls, "geometry": shapely.LineString(points), "main": is_main})
        rows[-1].update(columns[instance])
    frame = gpd.GeoDataFrame(rows).set_index("fid").iloc[rng.permutation(len(rows))]
    main_map = frame.loc[frame["main"], ["class", "geometry"]]
    local_maps = frame.loc[~frame["main"]].drop(columns="main")
    proximity = 1.0 if not grid else 0.9 * grid + 0.6
    return RandomMap(local_maps, main_map if len(main_map) else None, polylines, proximity)


def assert_agrees(local_maps, main_map, polylines, proximity):
    """Compare network, sets and lines with the reference's."""
    __tracebackhide__ = True
    fids = list(polylines)
    expected = reference.merge_reference(list(polylines.values()), proximity)

    graph = polymerge_core.merge_network(local_maps, main_map, crs="local", proximity=proximity)
    fid_of = dict(graph.nodes(data="source_fid"))
    assert sorted(fid_of.values()) == sorted(fids)
    edges = {frozenset((fid_of[i], fid_of[j])) for i, j in graph.edges}
    assert edges == {frozenset(fids[i] for i in edge) for edge in expected.edges}
    clean = {fid: reference.remove_short_segments(polyline.points) for fid, polyline in polylines.items()}
    for i, j, distance in graph.edges(data="distance"):
        exact = reference.check_distance(clean[fid_of[i]], clean[fid_of[j]])
        assert distance == pytest.approx(exact, abs=TOLERANCE_M)

    result = polymerge_core.merge(local_maps, main_map, crs="local", method="polymerge", proximity=proximity)
    assert len(result.left_out) == 0
    elements = result.elements.set_index("element_id")
    groups = result.lineage.groupby("element_id")["source_fid"]
    merged = {frozenset(group.tolist()): elements.loc[element_id] for element_id, group in groups}
    assert len(merged) == len(elements)
    assert set(merged) == {frozenset(fids[i] for i in members) for members in expected.members}
    for members, line in zip(expected.members, expected.elements, strict=True):
        element = merged[frozenset(fids[i] for i in members)]
        assert element["class"] == polylines[fids[members[0]]].cls
        coordinates = shapely.get_coordinates(element["geometry"])
        assert coordinates.shape == (len(line), 2)
        np.testing.assert_allclose(coordinates, line, rtol=0, atol=TOLERANCE_M)
    return expected


@pytest.mark.parametrize("seed", range(200))
def test_random_map(seed):
    assert_agrees(*random_map(seed))


@pytest.mark.parametrize("seed", range(1000, 1040))
def test_random_map_on_a_grid_where_ties_and_shared_vertices_are_many(seed):
    assert_agrees(*random_map(seed, grid=0.5))


def test_random_maps_are_worth_comparing():
    sizes, closed, with_main_map, doubled = [], 0, 0, 0
    for seed in range(0, 200, 5):
        drawn = random_map(seed)
        merged = reference.merge_reference(list(drawn.polylines.values()), drawn.proximity)
        sizes.extend(len(members) for members in merged.members)
        closed += sum(line[0] == line[-1] for line in merged.elements)
        with_main_map += drawn.main_map is not None
        doubled += sum(
            len(reference.remove_short_segments(polyline.points)) < len(polyline.points)
            for polyline in drawn.polylines.values()
        )
    assert np.mean(np.array(sizes) > 1) > 0.3
    assert max(sizes) > 10
    assert min(closed, with_main_map, doubled) > 5


@pytest.fixture(scope="module")
def sample(sample_folder):
    """Lines of the sample's 20 frames, in metres from a point amid them."""
    predictions = polymerge_core.read_predictions(sample_folder / "predictions.json")
    poses = polymerge_core.read_poses(sample_folder / "poses.csv")
    local_maps = polymerge_core.project(predictions, poses, crs="EPSG:32632").observations
    lines = local_maps[local_maps["class"].isin(CLASSES)].set_crs(None, allow_override=True)
    middle = np.round(lines.total_bounds.reshape(2, 2).mean(axis=0))
    return lines.set_geometry(lines.geometry.translate(*-middle))


def polylines_of(layer, *, main_instance=None):
    """Make the reference's input of a layer whose instances follow each other in time."""
    order = layer.groupby("instance")["timestamp"].min().sort_values().index
    rank = {instance: position for position, instance in enumerate(order)}
    polylines = {}
    for fid, cls, instance, line in layer[["class", "instance", "geometry"]].itertuples():
        points = [tuple(vertex) for vertex in shapely.get_coordinates(line).tolist()]
        is_main = instance == main_instance
        polylines[fid] = reference.Polyline(points, cls, rank[instance], is_main, sort_key(points))
    return polylines


def test_sample(sample):
    expected = assert_agrees(sample, None, polylines_of(sample), 1.0)
    assert len(expected.members) < len(sample) / 2


def test_sample_into_one_of_its_frames_as_main_map(sample):
    main_instance = sample["instance"].iloc[len(sample) // 2]
    polylines = polylines_of(sample, main_instance=main_instance)
    is_main = sample["instance"] == main_instance
    assert_agrees(sample[~is_main], sample.loc[is_main, ["class", "geometry"]], polylines, 1.0)
