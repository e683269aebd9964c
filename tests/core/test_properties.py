"""What the method promises whatever the data: order, hash seeds, place on the plane, identity, accounting."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from typing import NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from geopandas.testing import assert_geodataframe_equal
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from pandas.testing import assert_frame_equal

from polymerge_core import LocalMaps, merge
from polymerge_core.observations import MIN_SEGMENT_M
from tests.core.methods import consensus, every_method, published

pytestmark = every_method

CLASSES = ("divider", "boundary", "ped_crossing", "kerb")
UTM, DEGREES = "EPSG:32632", "EPSG:4326"
ORIGIN = (5e5, 5.3e6)

seeds = st.integers(0, 10_000)


def some(max_examples):
    """Run some examples; a seed has nothing to shrink."""
    return settings(max_examples=max_examples, phases=[Phase.explicit, Phase.generate])


def road(rng, *, length=30.0, spacing=4.0):
    """Draw a gently bent line."""
    count = int(length / spacing)
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.1, count))
    return rng.uniform(0, 60, 2) + spacing * np.cumsum(np.column_stack((np.cos(heading), np.sin(heading))), axis=0)


def roads_far_apart(seed):
    """Draw eight gently bent lines, 60 m apart."""
    rng = np.random.default_rng(seed)
    rows = [road(rng) for _ in range(8)]
    return [shapely.LineString(points - points.min(axis=0) + (0, 60 * k)) for k, points in enumerate(rows)]


def drawn_again(layer, direction):
    """Return the lines of a layer, 1 as they are, -1 from their other end."""
    copy = layer[["geometry"]].copy()
    copy["geometry"] = [line if direction == 1 else line.reverse() for line in layer.geometry]
    return copy


def crossing(rng):
    """Draw the corners of a crossing, 8 to 12 m by 3 to 4 m, anywhere, turned by any angle."""
    length, width, angle = rng.uniform(8, 12), rng.uniform(3, 4), rng.uniform(0, np.pi)
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (length / 2, width / 2)
    turn = np.array([(np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))])
    return corners @ turn + rng.uniform(0, 200, 2)


def observe(rng, things):
    """Look at roads and crossings: shifted, a little noisy, in either direction; kerbs are closed lines."""
    rows = []
    for cls, points in things:
        seen = points + rng.normal(0, 0.2, 2) + rng.normal(0, 0.05, points.shape)
        seen = seen[:: rng.choice([-1, 1])]
        if cls == "ped_crossing":
            shape = shapely.Polygon(seen) if rng.random() < 0.5 else shapely.LineString([*seen, seen[0]])
        elif cls == "kerb":
            shape = shapely.LineString([*seen, seen[0]])
        else:
            shape = shapely.LineString(seen)
        rows.append((cls, shape))
    return rows


def random_maps(seed, *, instances=4):
    """Draw a layer of several looks at some roads and crossings, without a CRS."""
    rng = np.random.default_rng(seed)
    things = [(cls, crossing(rng) if cls in ("ped_crossing", "kerb") else road(rng)) for cls in rng.choice(CLASSES, 8)]
    rows = []
    for instance in range(instances):
        kept = [thing for thing in things if rng.random() < 0.8]
        rows += [(cls, shape, f"frame {instance + 7}") for cls, shape in observe(rng, kept)]
    frame = pd.DataFrame(rows, columns=["class", "shape", "instance"])
    columns = {"score": rng.uniform(0, 1, len(frame)).round(3), "lanes": rng.integers(0, 3, len(frame))}
    return gpd.GeoDataFrame(frame.drop(columns="shape").assign(**columns), geometry=list(frame["shape"]))


def on_earth(layer, crs=UTM):
    """Put a layer near Munich."""
    return layer.set_geometry(layer.translate(*ORIGIN)).set_crs(UTM).to_crs(crs)


def wkb_of(elements):
    return elements.geometry.to_wkb().tolist()


def assert_same_bits(result, expected):
    __tracebackhide__ = True
    assert wkb_of(result) == wkb_of(expected)
    columns = [pd.DataFrame(elements).drop(columns="geometry") for elements in (result, expected)]
    assert_frame_equal(*columns, check_exact=True)


class MessyMap(NamedTuple):
    """A layer with whatever layers hold, and the length in metres of each feature."""

    layer: gpd.GeoDataFrame
    length: list[float]


def with_gaps(points):
    """Build a line whose first vertex is not a number."""
    with np.errstate(invalid="ignore"):
        return shapely.LineString([(np.nan, 1), *points])


def courtyard(points):
    corner = points[0]
    return shapely.box(*corner, *(corner + 3)).difference(shapely.box(*(corner + 1), *(corner + 2)))


#: Shapes of every kind that a layer holds, tidy or not, of a few points on a grid.
MESSY = {
    "none": lambda _: None,
    "empty line": lambda _: shapely.LineString(),
    "empty collection": lambda _: shapely.GeometryCollection(),
    "not a number": with_gaps,
    "zero length": lambda points: shapely.LineString(points[[0, 0]]),
    "parts": lambda points: shapely.MultiLineString([points, points + 3, points[[0, 0]], points[::-1]]),
    "with heights": lambda points: shapely.LineString(np.column_stack((points, np.arange(len(points))))),
    "closed": lambda points: shapely.LineString([*points, points[0]]),
    "box": lambda points: shapely.box(*points[0], *(points[0] + 2)),
    "hole": courtyard,
    "bow tie": lambda _: shapely.Polygon([(0, 0), (4, 4), (4, 0), (0, 4)]),
    "areas": lambda points: shapely.MultiPolygon([shapely.box(0, 0, 2, 2), courtyard(points + 20)]),
    "mixed": lambda points: shapely.GeometryCollection([shapely.Point(1, 1), shapely.LineString(points)]),
    "self-crossing": lambda _: shapely.LineString([(0, 0), (4, 4), (4, 0), (0, 4)]),
    "twice each": lambda points: shapely.LineString(np.repeat(points, 2, axis=0)),
    "line": shapely.LineString,
}


def messy_shape(rng):
    points = rng.integers(0, 12, (int(rng.integers(2, 6)), 2)) / 2.0
    return MESSY[rng.choice(list(MESSY))](points)


def expected_length(shape, *, closing):
    """Length of a feature: polygons by their perimeter, the lines of area classes closed."""
    if shape is None or not np.isfinite(shapely.get_coordinates(shape)).all():
        return 0.0
    pending, total = [shapely.force_2d(shape)], 0.0
    while pending:
        part = pending.pop()
        if part.is_empty:
            continue
        if hasattr(part, "geoms"):
            pending += part.geoms
        elif closing and part.geom_type == "LineString":
            distinct = shapely.get_num_coordinates(shapely.remove_repeated_points(part)) - part.is_closed
            closed = distinct >= 3
            total += shapely.LineString([*part.coords, part.coords[0]]).length if closed else part.length
        else:
            total += part.length
    return total


def messy_map(seed):
    rng = np.random.default_rng(seed)
    shapes = [messy_shape(rng) for _ in range(rng.integers(1, 25))]
    shapes += [shapes[k] for k in rng.integers(0, len(shapes), 3)]
    count = len(shapes)
    frame = gpd.GeoDataFrame(
        {
            "class": rng.choice([*CLASSES, "island"], count),
            "score": rng.choice([0.1, 0.6, 0.9, 1.2, np.nan], count, p=[0.1, 0.4, 0.3, 0.1, 0.1]),
            "instance": rng.integers(0, 3, count),
            "note": rng.choice(["a", "b", None], count),
        },
        geometry=shapes,
        index=rng.permutation(1000)[:count],
    )
    is_area = frame["class"] == "ped_crossing"
    return MessyMap(frame, [expected_length(shape, closing=area) for shape, area in zip(shapes, is_area, strict=True)])


class TestOrderOfTheInput:
    @some(12)
    @given(seeds, st.booleans())
    def test_of_the_features_does_not_matter(self, seed, named):
        layer = random_maps(seed)
        layer = layer if named else layer.drop(columns="instance")
        shuffled = layer.sample(frac=1, random_state=seed)
        result, again = merge(layer, crs="local"), merge(shuffled, crs="local")
        assert_same_bits(again.elements, result.elements)
        assert_frame_equal(again.lineage.drop(columns="source_fid"), result.lineage.drop(columns="source_fid"))

    @some(8)
    @given(seeds)
    def test_of_messy_features_does_not_matter(self, seed):
        layer = messy_map(seed).layer
        for columns in ([], ["instance"], ["instance", "score", "note"]):
            looks = layer.drop(columns=columns)
            shuffled = looks.sample(frac=1, random_state=seed)
            result, again = merge(looks, crs="local"), merge(shuffled, crs="local")
            assert_same_bits(again.elements, result.elements)
            assert_frame_equal(
                again.left_out.drop(columns="source_fid"), result.left_out.drop(columns="source_fid"), check_exact=True
            )

    @some(8)
    @given(seeds)
    def test_of_layers_does_not_matter(self, seed):
        rng = np.random.default_rng(seed)
        layer = random_maps(seed)
        layers = [part.drop(columns="instance") for _, part in layer.groupby(rng.integers(0, 4, len(layer)))]
        result, again = merge(layers, crs="local"), merge(layers[::-1], crs="local")
        assert_same_bits(again.elements, result.elements)

    @some(8)
    @given(seeds)
    def test_of_named_layers_does_not_matter(self, seed):
        rng = np.random.default_rng(seed)
        groups = random_maps(seed).groupby(rng.integers(0, 3, 1)[0] + rng.integers(0, 3, len(random_maps(seed))))
        layers = [LocalMaps(part, source=f"drive {number}") for number, part in groups]
        main = random_maps(seed + 1, instances=1).drop(columns="instance")
        result, again = merge(layers, main, crs="local"), merge(layers[::-1], main, crs="local")
        assert_same_bits(again.elements, result.elements)

    @some(6)
    @given(seeds)
    def test_of_twins_does_not_matter(self, seed):
        # Every line twice in two layers; some of the twins differ in a column only.
        rng = np.random.default_rng(seed)
        layer = random_maps(seed, instances=1).drop(columns=["instance", "score"])
        twin = layer.assign(lanes=np.where(rng.random(len(layer)) < 0.5, layer["lanes"], 9))
        for layers in ([layer, twin], [pd.concat([layer, twin], ignore_index=True)]):
            turned = [part.iloc[::-1] for part in layers[::-1]]
            result, again = merge(layers, crs="local"), merge(turned, crs="local")
            assert_same_bits(again.elements, result.elements)


HASH = """
import hashlib, sys
from polymerge_core import merge
from tests.core.test_properties import random_maps
digest = hashlib.sha256()
for seed in (1, 2, 3):
    into = random_maps(seed + 9, instances=1)
    elements = merge(random_maps(seed), into, crs="local", aggregate="mode", method=sys.argv[1]).elements
    for row in elements.drop(columns="geometry").itertuples(index=False):
        digest.update(repr(row).encode())
    digest.update(b"".join(elements.geometry.to_wkb()))
sys.stdout.write(digest.hexdigest())
"""


def test_hash_seed_does_not_matter(method):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    program = [sys.executable, "-c", HASH, method]
    runs = [
        subprocess.Popen(program, env=environment | {"PYTHONHASHSEED": seed}, stdout=subprocess.PIPE, text=True)
        for seed in "0123"
    ]
    found = [run.communicate(timeout=300)[0] for run in runs]
    assert len(set(found)) == 1
    assert len(found[0]) == len(hashlib.sha256().hexdigest())


class TestPlaceOnThePlane:
    """Translated and mirrored with crs=local, where no component holds two observations of one instance."""

    TWO_CELLS = 0.2

    @staticmethod
    def moved(layer, matrix):
        return layer.set_geometry(layer.affine_transform(matrix))

    @staticmethod
    def one_look_of_each(seed):
        """Draw roads and crossings far from each other, so that each is one component."""
        rng = np.random.default_rng(seed)
        looks = []
        for number in range(6):
            cls = CLASSES[number % 4]
            points = crossing(rng) if cls in ("ped_crossing", "kerb") else road(rng)
            points = points - points.mean(axis=0) + (number * 100, 0)
            for instance in range(int(rng.integers(1, 5))):
                looks += [(cls, shape, instance) for _, shape in observe(rng, [(cls, points)])]
        frame = pd.DataFrame(looks, columns=["class", "shape", "instance"])
        return gpd.GeoDataFrame(frame.drop(columns="shape"), geometry=list(frame["shape"]))

    @some(12)
    @given(
        seeds,
        st.sampled_from(
            [
                (1, 0, 0, 1, 4321.25, -1234.5),
                (-1, 0, 0, 1, 0, 0),
                (1, 0, 0, -1, 0, 0),
                (0, 1, 1, 0, 0, 0),
                (-1, 0, 0, -1, 777.7, 3.3),
            ]
        ),
    )
    def test_does_not_matter(self, seed, matrix):
        layer = self.one_look_of_each(seed)
        expected = merge(layer, crs="local")
        result = merge(self.moved(layer, matrix), crs="local")
        assert len(result.elements) == len(expected.elements) == 6
        back = result.lineage[["source_fid", "element_id"]].merge(expected.lineage, on="source_fid")
        pairs = back[["element_id_x", "element_id_y"]].drop_duplicates().to_numpy()
        assert len(pairs) == 6
        ours = self.moved(expected.elements, matrix).set_index("element_id")
        theirs = result.elements.set_index("element_id")
        for there, here in pairs:
            a, b = theirs.geometry[there], ours.geometry[here]
            assert a.geom_type == b.geom_type
            if theirs["class"][there] == "ped_crossing":
                # Two cells along both sides of the grid.
                assert shapely.hausdorff_distance(a, b) <= self.TWO_CELLS * 2**0.5
            else:
                assert a.equals_exact(b, 1e-6)


class TestIdentity:
    @some(8)
    @given(seeds, st.sampled_from([UTM, DEGREES, "EPSG:3857"]))
    def test_of_a_main_map_merged_with_nothing(self, seed, crs):
        stored = merge(on_earth(random_maps(seed), crs)).elements
        again = merge([], stored)
        assert_geodataframe_equal(again.elements, stored)
        assert wkb_of(again.elements) == wkb_of(stored)
        assert len(again.id_aliases) == len(again.left_out) == 0

    @some(8)
    @given(seeds)
    def test_of_a_users_own_map_merged_with_nothing(self, seed):
        own = on_earth(random_maps(seed, instances=1).drop(columns="instance"), DEGREES)
        own.insert(0, "element_id", np.random.default_rng(seed).permutation(len(own)) + 40)
        result = merge(own.iloc[:0], own).elements
        by_id = own.sort_values("element_id").reset_index(drop=True)
        assert wkb_of(result) == wkb_of(by_id)
        columns = ["element_id", "class", "score", "lanes"]
        assert_frame_equal(pd.DataFrame(result[columns]), pd.DataFrame(by_id[columns]))

    @published
    @some(8)
    @given(seeds, st.sampled_from([1, -1]))
    def test_of_lines_twice_the_proximity_apart_merged_with_their_copy(self, seed, direction):
        lines = roads_far_apart(seed)
        lines.append(shapely.LineString([(0, -50), (9, -50), (9, -40), (0, -50)]))
        layer = gpd.GeoDataFrame({"element_id": range(1, 10)}, geometry=lines)
        copy = drawn_again(layer, direction)
        assert wkb_of(merge(copy, layer, crs="local").elements) == wkb_of(layer)
        both = pd.concat([layer[["geometry"]].assign(instance=1), copy.assign(instance=2)])
        elements = merge(both, crs="local").elements
        assert sorted(wkb_of(elements)) == sorted(wkb_of(layer))

    @consensus
    @some(8)
    @given(seeds, st.sampled_from([1, -1]))
    def test_of_gently_bent_lines_merged_with_their_copy_but_for_a_quarter_of_the_proximity(self, seed, direction):
        lines = roads_far_apart(seed)
        layer = gpd.GeoDataFrame({"element_id": range(1, 9)}, geometry=lines)
        copy = drawn_again(layer, direction)
        elements = merge(copy, layer, crs="local").elements
        assert elements["element_id"].tolist() == layer["element_id"].tolist()
        assert elements["n_observations"].tolist() == [2] * 8
        assert shapely.hausdorff_distance(elements.geometry, layer.geometry).max() < 0.25

    def test_of_parallel_lines_exactly_twice_the_proximity_apart_merged_with_their_copy(self, method):
        lines = [shapely.LineString([(0, 2.0 * k), (7, 2.0 * k), (15, 2.0 * k)]) for k in range(5)]
        layer = gpd.GeoDataFrame({"element_id": range(5)}, geometry=lines)
        elements = merge(layer[["geometry"]], layer, crs="local").elements
        assert elements["element_id"].tolist() == layer["element_id"].tolist()
        distance = shapely.hausdorff_distance(elements.geometry, layer.geometry)
        assert distance.max() < 1e-9
        assert method == "consensus" or wkb_of(elements) == wkb_of(layer)

    @some(6)
    @given(seeds)
    def test_of_what_lies_by_itself_in_another_crs_comes_back_within_a_micrometre(self, seed):
        layer = on_earth(random_maps(seed, instances=1))
        result = merge(layer.to_crs(DEGREES), out_crs=UTM).elements
        ours, theirs = layer.geometry.union_all(), result.geometry.union_all()
        if len(result) == len(layer):
            assert shapely.hausdorff_distance(ours, theirs) < 1e-6


class TestAccounting:
    """Every observation's length is in `lineage` and `left_out` exactly once."""

    @some(40)
    @given(seeds, st.sampled_from([0.0, 0.5]))
    def test_of_every_length(self, seed, min_score):
        layer, length = messy_map(seed)
        result = merge(LocalMaps(layer, source="messy"), crs="local", min_score=min_score)
        columns = ["source", "source_fid", "from_m", "to_m"]
        intervals = pd.concat([result.lineage[columns], result.left_out[columns]])
        assert set(intervals["source_fid"]) == set(layer.index)
        assert (intervals["to_m"] >= intervals["from_m"]).all()
        by_feature = dict(list(intervals.sort_values(["to_m", "from_m"]).groupby("source_fid")))
        for fid, expected in zip(layer.index, length, strict=True):
            rows = by_feature[fid]
            starts, ends = rows["from_m"].to_numpy(), rows["to_m"].to_numpy()
            assert starts[0] == 0.0
            np.testing.assert_allclose(starts[1:], ends[:-1], rtol=0, atol=1e-9)
            assert ends[-1] == pytest.approx(expected, abs=10 * MIN_SEGMENT_M)

    @some(15)
    @given(seeds)
    def test_of_every_observation(self, seed):
        layer = messy_map(seed).layer
        result = merge(layer, crs="local")
        weights = result.lineage.groupby("element_id")["weight"].sum()
        assert weights.index.tolist() == result.elements["element_id"].tolist()
        np.testing.assert_allclose(weights, 1.0)
        counts = result.lineage.groupby("element_id").size()
        assert result.elements["n_observations"].tolist() == counts.tolist()
        assert (result.elements["n_instances"] <= result.elements["n_observations"]).all()
        assert result.elements["score"].between(0, 1).all()
        assert not result.elements.geometry.is_empty.any()
        assert np.isfinite(result.elements.length).all()


@some(6)
@given(seeds)
def test_merge_into_a_map_gives_each_look_to_one_element(seed):
    stored = merge(random_maps(seed), crs="local").elements
    result = merge(random_maps(seed + 1), stored, crs="local")
    gone, kept = set(result.id_aliases["old_id"]), set(result.elements["element_id"])
    assert gone | (kept & set(stored["element_id"])) == set(stored["element_id"])
    assert not gone & kept
    assert set(result.id_aliases["element_id"]) <= kept
    local = result.lineage[result.lineage["source"] != "main_map"]
    assert local["source_fid"].is_unique
    assert result.elements["n_observations"].sum() == stored["n_observations"].sum() + len(local)
