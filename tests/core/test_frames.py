"""Step 1, eq. 1: from the vehicle's frame to the map's, against positions known in closed form."""

import numpy as np
import pyproj
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from polymerge_core.crs import LOCAL_CRS
from polymerge_core.errors import CrsError, InputError, OptionError
from polymerge_core.formats.records import LeftOutVector, Poses, Predictions
from polymerge_core.formats.rotation import is_rigid, is_rigid_motion
from polymerge_core.frames import ego_to_world, project, quaternion_to_matrix
from polymerge_core.schema import LEFT_OUT_COLUMNS

S = 0.5**0.5
FACING = {"east": [1, 0, 0, 0], "north": [S, 0, 0, S], "west": [0, 0, 0, 1]}
RING = [(1.0, 0.0), (3.0, 0.0), (3.0, 2.0), (1.0, 2.0), (1.0, 0.0)]

WGS84_A, WGS84_E2 = 6378137.0, 0.0066943799901413165


def seen(*frames, **changes):
    """Predictions of frames given as lists of lines."""
    lines = [line for frame in frames for line in frame]
    fields = {
        "tokens": tuple(str(i) for i in range(len(frames))),
        "coordinates": np.array([vertex for line in lines for vertex in line], dtype=float).reshape(-1, 2),
        "offsets": np.cumsum([0] + [len(line) for line in lines]),
        "frame": np.array([i for i, frame in enumerate(frames) for _ in frame], dtype=int),
        "index": np.array([i for frame in frames for i, _ in enumerate(frame)], dtype=int),
        "class_name": np.array(["divider"] * len(lines), dtype=object),
        "score": np.full(len(lines), 0.75),
        "source": "drive",
    }
    return Predictions(**fields | changes)


def at(*positions, facing="east", **changes):
    """Poses in metres, at timestamps 0, 1, ..."""
    k = len(positions)
    fields = {
        "timestamp_ns": np.arange(k),
        "rotation": np.repeat(quaternion_to_matrix([FACING[facing]]), k, axis=0),
        "translation": np.array([(*p, 0.0)[:3] for p in positions], dtype=float).reshape(-1, 3),
        "source": "poses.csv",
    }
    return Poses(**fields | changes)


def on_earth(lat, lon, heading, height=0.0):
    values = {"lat": lat, "lon": lon, "heading_deg": heading, "height_m": height}
    return Poses(np.array([0]), **{name: np.array([float(value)]) for name, value in values.items()})


def vector(line):
    """Last vertex seen from the first."""
    xy = shapely.get_coordinates(line)
    return xy[-1] - xy[0]


def axis_radii(lat):
    """Radii of curvature of WGS 84 along the meridian and across it."""
    w = 1 - WGS84_E2 * np.sin(np.radians(lat)) ** 2
    return WGS84_A * (1 - WGS84_E2) / w**1.5, WGS84_A / w**0.5


FORWARD_30 = [[(0.0, 0.0), (30.0, 0.0)]]
LEFT_10 = [[(0.0, 0.0), (0.0, 10.0)]]

# --- eq. 1 on arrays


@pytest.mark.parametrize(
    ("quaternion", "vertex", "expected"),
    [
        ([1, 0, 0, 0], (1, 2, 3), (1, 2, 3)),
        ([S, 0, 0, S], (1, 0, 0), (0, 1, 0)),
        ([S, 0, 0, S], (0, 1, 0), (-1, 0, 0)),
        ([S, 0, 0, -S], (1, 0, 0), (0, -1, 0)),
        ([S, S, 0, 0], (0, 1, 0), (0, 0, 1)),
        ([S, 0, S, 0], (0, 0, 1), (1, 0, 0)),
        ([0.5, 0.5, 0.5, 0.5], (1, 2, 3), (3, 1, 2)),
        ([-0.5, -0.5, -0.5, -0.5], (1, 2, 3), (3, 1, 2)),
    ],
    ids=["identity", "yaw x", "yaw y", "yaw right", "roll", "pitch", "axes in a ring", "opposite sign"],
)
def test_quaternions_are_scalar_first_and_turn_anticlockwise(quaternion, vertex, expected):
    np.testing.assert_allclose(quaternion_to_matrix([quaternion])[0] @ vertex, expected, atol=1e-15)


def hamilton(p, q):
    w = p[0] * q[0] - p[1:] @ q[1:]
    return np.array([w, *(p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:]))])


finite = st.floats(-1e3, 1e3)


@given(arrays(float, 4, elements=st.floats(-1, 1)), arrays(float, 3, elements=finite))
def test_the_matrix_is_the_sandwich_product_of_eq_1(q, v):
    if np.linalg.norm(q) < 0.1:
        q = np.array([1.0, 0.0, 0.0, 0.0])
    q = q / np.linalg.norm(q)
    expected = hamilton(hamilton(q, np.array([0.0, *v])), q * [1, -1, -1, -1])[1:]
    matrix = quaternion_to_matrix([q])
    np.testing.assert_allclose(matrix[0] @ v, expected, atol=1e-9)
    assert is_rigid(matrix).all()


def test_vertices_take_the_pose_of_their_frame_and_are_lifted_to_the_ground():
    rotation = quaternion_to_matrix([FACING["east"], FACING["north"]])
    world = ego_to_world([(1, 2), (1, 2), (0, 0)], rotation, [(10, 0, 5), (0, 10, 6)], frame=[1, 0, 1])
    np.testing.assert_allclose(world, [(-2, 11, 6), (11, 2, 5), (0, 10, 6)], atol=1e-15)


def test_vertices_with_a_height_keep_it():
    pitched = quaternion_to_matrix([[S, 0, S, 0]])
    np.testing.assert_allclose(ego_to_world([(0, 0, 2)], pitched, [(1, 1, 1)]), [(3, 1, 1)], atol=1e-15)


@settings(max_examples=30)
@given(
    arrays(float, (5, 2), elements=finite),
    st.floats(-np.pi, np.pi),
    arrays(float, 2, elements=st.floats(-1e4, 1e4)),
)
def test_projecting_in_the_plane_keeps_distances(line, yaw, position):
    poses = at(position, rotation=quaternion_to_matrix([[np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]]))
    world = shapely.get_coordinates(project(seen([line]), poses, crs="local").observations.geometry)
    before, after = (np.linalg.norm(xy[:, None] - xy, axis=2) for xy in (line, world))
    np.testing.assert_allclose(after, before, atol=1e-8)


# --- poses in metres of the CRS


def test_each_frame_is_placed_by_its_own_pose():
    predictions = seen(LEFT_10, [[(2, 0), (4, 0)], [(0, 1), (0, 2)]])
    maps = project(predictions, at((100, 200), (50, 60), facing="north"), crs="EPSG:32632")
    expected = ["LINESTRING (100 200, 90 200)", "LINESTRING (50 62, 50 64)", "LINESTRING (49 60, 48 60)"]
    assert shapely.equals_exact(maps.observations.geometry, shapely.from_wkt(expected), 1e-9).all()
    assert maps.observations.crs == pyproj.CRS("EPSG:32632")


def test_the_columns_of_observations_and_instances():
    poses = at((100, 200), (50, 60), facing="north", timestamp_ns=np.array([7, 315966253572412943]))
    predictions = seen(LEFT_10, [], tokens=("7", "315966253572412943"))
    maps = project(predictions, poses, crs="local", drive="tuesday")
    row = maps.observations.drop(columns="geometry").iloc[0].to_dict()
    assert row == {"class": "divider", "drive": "tuesday", "instance": "7", "score": 0.75, "timestamp": 7}
    assert maps.observations.index.tolist() == [0]
    assert maps.instances.columns.tolist() == [
        "drive", "instance", "timestamp_ns", "x", "y", "heading", "n_observations", "geometry",
    ]  # fmt: skip
    assert maps.instances["n_observations"].tolist() == [1, 0]
    assert maps.instances["timestamp_ns"].tolist() == [7, 315966253572412943]
    assert maps.instances[["x", "y"]].to_numpy().tolist() == [[100, 200], [50, 60]]
    assert maps.instances.crs == LOCAL_CRS
    assert maps.source == "drive"


def test_without_a_drive_the_source_names_it():
    maps = project(seen(LEFT_10), at((0, 0)), crs="local")
    assert maps.observations["drive"].tolist() == maps.instances["drive"].tolist() == ["drive"]


@pytest.mark.parametrize(("facing", "heading"), [("north", 0), ("east", 90), ("west", 270)])
def test_heading_is_clockwise_from_grid_north(facing, heading):
    instances = project(seen([]), at((5, 5), facing=facing), crs="local").instances
    assert (instances["heading"].iloc[0] - heading + 180) % 360 - 180 == pytest.approx(0, abs=1e-9)
    assert 0 <= instances["heading"].iloc[0] < 360


def test_the_footprint_turns_with_the_vehicle():
    maps = project(seen([]), at((100, 200), facing="north"), crs="local", footprint=(-1, -2, 10, 3))
    assert maps.instances.geometry[0].equals(shapely.box(97, 199, 102, 210))


def test_closed_lines_stay_closed_and_lines_stay_lines():
    turn = quaternion_to_matrix([[0.9, 0.05, -0.1, 0.4]])
    maps = project(seen([RING] * 50), at((691234.5, 5334567.8), rotation=turn), crs="EPSG:32632")
    assert maps.observations.geometry.is_closed.all()
    assert set(maps.observations.geom_type) == {"LineString"}


def test_nothing_seen_gives_empty_layers_with_the_right_columns():
    maps = project(seen(), at(), crs="EPSG:32632")
    assert len(maps.observations) == len(maps.instances) == len(maps.left_out) == 0
    assert maps.observations.columns.tolist() == [
        "class",
        "drive",
        "instance",
        "score",
        "timestamp",
        "geometry",
    ]
    assert maps.observations.crs == maps.instances.crs == pyproj.CRS("EPSG:32632")
    full = project(seen(LEFT_10), at((0, 0)), crs="local")
    assert maps.observations.dtypes.equals(full.observations.dtypes)
    assert maps.left_out.dtypes.equals(project(seen([]), at((0, 0)), crs="local").left_out.dtypes)


def test_inputs_are_not_changed():
    predictions, poses = seen(FORWARD_30), at((100, 200), facing="north")
    before = [predictions.coordinates.copy(), poses.rotation.copy(), poses.translation.copy()]
    project(predictions, poses, crs="local")
    for array, copy in zip((predictions.coordinates, poses.rotation, poses.translation), before, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_offset_poses_are_shifted_by_the_offset():
    maps = project(seen(FORWARD_30), at((10, 20)), crs="EPSG:32617", pose_kind="offset", pose_offset=(583710, 4477259))
    np.testing.assert_allclose(shapely.get_coordinates(maps.observations.geometry[0])[0], (583720, 4477279))
    assert maps.instances["x"].tolist() == [583720]


# --- matching frames with poses


def test_a_token_is_matched_with_a_token_before_a_timestamp():
    poses = at((1, 0), (2, 0), (3, 0), token=np.array(["b", "0", "c"], dtype=object))
    maps = project(seen([], [], [], tokens=("0", "b", "2")), poses, crs="local")
    assert maps.instances["x"].tolist() == [2, 1, 3]  # "0" is a token, "2" the timestamp of "c"
    assert maps.instances["timestamp_ns"].tolist() == [1, 0, 2]


def test_19_digit_timestamps_one_apart_are_told_apart():
    stamps = 315966253572412943 + np.arange(3)
    maps = project(
        seen([], tokens=("315966253572412944",)), at((1, 0), (2, 0), (3, 0), timestamp_ns=stamps), crs="local"
    )
    assert maps.instances["x"].tolist() == [2]


def test_a_frame_without_a_pose_is_named_and_counted():
    with pytest.raises(InputError, match=r"drive: frame '1' has no pose in poses\.csv \(2 of 3 frames"):
        project(seen([], [], []), at((0, 0)), crs="local")


def test_no_poses_at_all_is_the_same_error():
    with pytest.raises(InputError, match="1 of 1 frames have none"):
        project(seen([]), at(), crs="local")


# --- the LiDAR's frame


def test_lidar_predictions_go_through_the_vehicle_frame():
    lidar_to_ego = np.array([[0, 1, 0, 0.9], [-1, 0, 0, 0], [0, 0, 1, 1.8], [0, 0, 0, 1]])  # x right, y forward
    predictions = seen([[(0, 0), (2, 10)]], frame_kind="lidar")
    maps = project(predictions, at((100, 200), facing="north"), crs="local", lidar_to_ego=lidar_to_ego)
    expected = shapely.from_wkt("LINESTRING (100 200.9, 102 210.9)")
    assert shapely.equals_exact(maps.observations.geometry[0], expected, 1e-9)
    assert maps.instances["y"].tolist() == [200]  # the footprint and position are the vehicle's
    assert maps.instances.geometry[0].equals_exact(shapely.box(85, 170, 115, 230), 1e-9, normalize=True)


def test_without_a_transform_the_lidar_frame_is_taken_for_the_vehicle_frame_with_a_warning():
    ego = project(seen(LEFT_10), at((1, 2)), crs="local")
    with pytest.warns(UserWarning, match="no lidar_to_ego was given"):
        lidar = project(seen(LEFT_10, frame_kind="lidar"), at((1, 2)), crs="local")
    assert lidar.observations.geometry[0].equals(ego.observations.geometry[0])


@pytest.mark.parametrize(
    "matrix",
    [
        np.eye(3),
        2 * np.eye(4),
        np.diag([1, 1, -1, 1]),
        np.full((4, 4), np.nan),
        "eye",
        [[1], [2, 3]],
        np.ones((4, 4)),
    ],
    ids=["3x3", "scaled", "mirror", "nan", "text", "ragged", "last row"],
)
def test_a_lidar_to_ego_that_is_not_rigid_is_a_bad_option(matrix):
    assert not is_rigid_motion(matrix)
    with pytest.raises(OptionError, match="rigid 4x4"):
        project(seen(LEFT_10, frame_kind="lidar"), at((0, 0)), crs="local", lidar_to_ego=matrix)


def test_a_lidar_to_ego_for_predictions_in_the_vehicle_frame_is_refused():
    with pytest.raises(OptionError, match="in the vehicle's frame; leave it out"):
        project(seen(LEFT_10), at((0, 0)), crs="local", lidar_to_ego=np.eye(4))


# --- poses on Earth


PLACES = [
    ("EPSG:32632", 59.91, 10.75),
    ("EPSG:32756", -33.86, 151.21),
    ("EPSG:32617", 40.44, -79.99),
    ("EPSG:27700", 57.1, -5.6),
    ("EPSG:2154", 43.3, 5.4),
    ("EPSG:31467", 48.1, 10.1),
    ("EPSG:2193", -41.3, 174.8),
]
ids_of_places = [f"{crs} at {lat:g},{lon:g}" for crs, lat, lon in PLACES]


@pytest.mark.parametrize(("crs", "lat", "lon"), PLACES, ids=ids_of_places)
@pytest.mark.parametrize("kind", ["geodetic", "origin"])
def test_30_m_ahead_are_scaled_by_k_and_turned_by_the_meridian_convergence(kind, crs, lat, lon):
    """Conformal projections: length times k, grid bearing = true bearing less the convergence."""
    headings = np.array([0.0, 37.0, 90.0, 200.0])
    half_yaw = np.radians(90 - headings) / 2
    zero = np.zeros(4)
    rotation = quaternion_to_matrix(np.column_stack([np.cos(half_yaw), zero, zero, np.sin(half_yaw)]))
    degrees = Poses(np.arange(4), lat=zero + lat, lon=zero + lon, heading_deg=headings)
    metres = Poses(np.arange(4), rotation=rotation, translation=np.zeros((4, 3)))
    poses, options = (degrees, {}) if kind == "geodetic" else (metres, {"origin": (lat, lon)})
    maps = project(seen(*[FORWARD_30] * 4), poses, crs=crs, pose_kind=kind, **options)

    factors = pyproj.Proj(crs).get_factors(lon, lat)
    east, north = np.array([vector(line) for line in maps.observations.geometry]).T
    expected = headings - factors.meridian_convergence
    # A datum shift turns and scales by parts in a million.
    np.testing.assert_allclose(np.hypot(east, north), 30 * factors.meridional_scale, atol=1e-3)
    for bearings in (np.degrees(np.arctan2(east, north)), maps.instances["heading"]):
        np.testing.assert_allclose((bearings - expected + 180) % 360 - 180, 0, atol=2e-3)


def test_on_the_central_meridian_of_utm_30_m_east_are_29_988():
    maps = project(seen(FORWARD_30), on_earth(48.0, 9.0, 90.0), crs="EPSG:32632", pose_kind="geodetic")
    xy = shapely.get_coordinates(maps.observations.geometry[0])
    assert xy[0, 0] == pytest.approx(500_000, abs=1e-6)
    assert xy[1, 0] - xy[0, 0] == pytest.approx(29.988, abs=1e-6)
    assert xy[1, 1] - xy[0, 1] == pytest.approx(0, abs=1e-4)  # 30 m along a great circle, not a parallel


@pytest.mark.parametrize("side", [-1, 1], ids=["west", "east"])
def test_the_convergence_has_the_sign_of_the_side_of_the_central_meridian(side):
    """East of it, north of the equator, true north leans left of grid north: tan g = tan(dlon) sin(lat)."""
    maps = project(seen([]), on_earth(48.0, 9.0 + 2.0 * side, 0.0), crs="EPSG:32632", pose_kind="geodetic")
    leaning = np.degrees(np.arctan(np.tan(np.radians(2.0)) * np.sin(np.radians(48.0))))
    heading = (maps.instances["heading"].iloc[0] + 180) % 360 - 180
    assert heading == pytest.approx(-side * leaning, abs=1e-3)


@pytest.mark.parametrize("lat", [0.0, 45.0, -60.0, 70.0])
def test_a_metre_on_the_ground_is_longer_in_web_mercator(lat):
    """A sphere's Mercator of ellipsoidal latitudes: a / (N cos lat) across, a / (M cos lat) along."""
    along, across = axis_radii(lat)
    for heading, radius, axis in ((90.0, across, 0), (0.0, along, 1)):
        maps = project(seen(FORWARD_30), on_earth(lat, 20.0, heading), crs="EPSG:3857", pose_kind="geodetic")
        expected = 30 * WGS84_A / (radius * np.cos(np.radians(lat)))
        assert vector(maps.observations.geometry[0])[axis] == pytest.approx(expected, rel=2e-5)


@pytest.mark.parametrize("crs", ["EPSG:32631", "EPSG:28992", "EPSG:3857"])
@pytest.mark.parametrize(("azimuth", "distance"), [(30.0, 100.0), (250.0, 2000.0)])
def test_metres_from_an_origin_land_where_the_geodesic_does(crs, azimuth, distance):
    lat, lon = 52.2, 5.3
    position = (distance * np.sin(np.radians(azimuth)), distance * np.cos(np.radians(azimuth)))
    maps = project(seen([]), at(position), crs=crs, pose_kind="origin", origin=(lat, lon))
    end_lon, end_lat, _ = pyproj.Geod(ellps="WGS84").fwd(lon, lat, azimuth, distance)
    x, y = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(end_lon, end_lat)
    assert maps.instances[["x", "y"]].to_numpy()[0] == pytest.approx((x, y), abs=1e-3)


def test_the_pose_itself_lands_where_every_gis_puts_its_degrees():
    for crs, lat, lon in PLACES:
        maps = project(seen([]), on_earth(lat, lon, 0.0, height=120.0), crs=crs, pose_kind="geodetic")
        expected = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat)
        assert maps.instances[["x", "y"]].to_numpy()[0] == pytest.approx(expected, abs=1e-6)


def test_the_quaternion_is_the_attitude_where_there_is_no_heading():
    level = {"lat": np.array([48.0]), "lon": np.array([9.0])}
    facing_north = Poses(np.array([0]), rotation=quaternion_to_matrix([FACING["north"]]), **level)
    both = Poses(np.array([0]), rotation=facing_north.rotation, heading_deg=np.array([90.0]), **level)
    headings = [
        project(seen([]), poses, crs="EPSG:32632", pose_kind="geodetic").instances["heading"].iloc[0]
        for poses in (facing_north, both)
    ]
    np.testing.assert_allclose(np.cos(np.radians(headings)), [1, 0], atol=1e-6)


def test_a_pitched_vehicle_sees_a_shorter_stretch_of_map():
    pitched = quaternion_to_matrix([[np.cos(0.05), 0, -np.sin(0.05), 0]])  # 0.1 rad nose up, facing east
    poses = Poses(np.array([0]), rotation=pitched, lat=np.array([48.0]), lon=np.array([9.0]))
    maps = project(seen(FORWARD_30), poses, crs="EPSG:32632", pose_kind="geodetic")
    assert vector(maps.observations.geometry[0])[0] == pytest.approx(29.988 * np.cos(0.1), abs=1e-4)


def test_closed_lines_stay_closed_through_the_ellipsoid():
    maps = project(seen([RING] * 50), on_earth(48.1, 11.6, 33.3, 500.0), crs="EPSG:32632", pose_kind="geodetic")
    assert maps.observations.geometry.is_closed.all()


def test_the_footprint_has_its_true_area_on_the_ground():
    maps = project(seen([]), on_earth(48.0, 9.0, 33.0), crs="EPSG:32632", pose_kind="geodetic")
    assert maps.instances.geometry[0].area == pytest.approx(60 * 30 * 0.9996**2, rel=1e-5)


def test_a_projected_crs_in_feet_gets_feet():
    maps = project(seen(FORWARD_30), on_earth(40.7, -74.0, 90.0), crs="EPSG:2263", pose_kind="geodetic")
    assert np.hypot(*vector(maps.observations.geometry[0])) == pytest.approx(30 / 0.3048006, rel=1e-4)


# --- what is left out


def test_vectors_left_out_by_the_reader_are_listed():
    lost = (
        LeftOutVector("0", 3, 5.0, "fewer than 2 points"),
        LeftOutVector("0", 4, np.nan, "a coordinate is not a number"),
    )
    maps = project(seen(LEFT_10, left_out=lost), at((0, 0)), crs="local", drive="tuesday")
    assert maps.left_out.columns.tolist() == list(LEFT_OUT_COLUMNS)
    assert maps.left_out.iloc[0].to_dict() == {
        "source": "drive", "source_fid": 3, "drive": "tuesday", "instance": "0",
        "from_m": 0.0, "to_m": 5.0, "reason": "fewer than 2 points",
    }  # fmt: skip


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1.5e308], ids=["nan", "infinite", "overflow"])
def test_a_vector_that_has_no_place_is_left_out_and_its_neighbours_stay(bad):
    lines = [[(0, 0), (1, 1)], [(0, 0), (bad, bad), (2, 2)], [(2, 2), (3, 3)]]
    half_left = quaternion_to_matrix([[np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)]])
    maps = project(seen(lines), at((0, 0), rotation=half_left), crs="local")
    assert maps.observations.index.tolist() == [0, 1]
    assert vector(maps.observations.geometry[1]) @ vector(maps.observations.geometry[1]) == pytest.approx(2)
    assert maps.left_out["source_fid"].tolist() == [1]
    assert "has no place" in maps.left_out["reason"].iloc[0]
    assert maps.instances["n_observations"].tolist() == [2]


# --- options and CRSs that do not go together


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"pose_kind": "utm"}, "pose_kind cannot be 'utm'; it is one of crs, origin, geodetic, offset"),
        ({"pose_kind": "origin", "crs": "EPSG:32632"}, "pose_kind=origin needs origin"),
        ({"origin": (1.0, 2.0)}, "origin goes with pose_kind=origin"),
        ({"pose_kind": "offset"}, "pose_kind=offset needs pose_offset"),
        ({"pose_offset": (0.0, 0.0)}, "pose_offset goes with pose_kind=offset"),
        ({"pose_kind": "origin", "origin": (95.0, 2.0)}, "it is LAT,LON in degrees"),
        ({"pose_kind": "origin", "origin": (float("nan"), 2.0)}, "it is two numbers"),
        ({"pose_kind": "offset", "pose_offset": (1.0,)}, "it is two numbers"),
        ({"footprint": (30, -15, -30, 15)}, "footprint cannot be"),
        ({"footprint": (0, 0, 1)}, "footprint cannot be"),
        ({"footprint": (0, 0, 1, float("inf"))}, "footprint cannot be"),
    ],
)
def test_bad_options_are_refused_before_any_work(options, message):
    with pytest.raises(OptionError, match=message):
        project(seen(LEFT_10), at((0, 0)), **{"crs": "local"} | options)


@pytest.mark.parametrize(
    ("crs", "kind", "message"),
    [
        ("EPSG:4326", "crs", "not projected in metres.*or local"),
        ("EPSG:2263", "crs", "not projected in metres"),
        ("EPSG:4326", "offset", "not projected in metres"),
        ("EPSG:4326", "geodetic", "give a projected CRS"),
        ("local", "geodetic", "give a projected CRS"),
        ("local", "origin", "give a projected CRS"),
        ("EPSG:99999", "crs", "EPSG:99999"),
    ],
)
def test_a_crs_that_does_not_fit_the_kind_of_pose_is_refused(crs, kind, message):
    extra = {"origin": {"origin": (48.0, 9.0)}, "offset": {"pose_offset": (0.0, 0.0)}}.get(kind, {})
    with pytest.raises(CrsError, match=message):
        project(seen(LEFT_10), at((0, 0)), crs=crs, pose_kind=kind, **extra)


def test_metres_are_not_added_to_web_mercator():
    with pytest.raises(CrsError, match=r"a metre of .*Pseudo-Mercator is .*% off a metre on the ground.*geodetic"):
        project(seen(LEFT_10), at((1_000_000, 6_600_000)), crs="EPSG:3857")


def test_a_pose_without_a_place_in_the_crs_is_named():
    with pytest.raises(CrsError, match=r"the pose of timestamp 0 has no place in .*Lambert-93"):
        project(seen([]), on_earth(-90.0, 3.0, 0.0), crs="EPSG:2154", pose_kind="geodetic")


def test_poses_far_from_where_the_crs_is_used_are_refused():
    with pytest.raises(CrsError, match=r"far from where"):
        project(seen(LEFT_10), on_earth(-33.9, 151.2, 0.0), crs="EPSG:2154", pose_kind="geodetic")


@pytest.mark.parametrize(
    ("poses", "kind", "lacking"),
    [
        (on_earth(48.0, 9.0, 0.0), "crs", "rotation"),
        (at((0, 0), translation=None), "crs", "translation"),
        (at((0, 0)), "geodetic", "lat"),
        (
            at((0, 0), translation=None, lat=np.zeros(1), lon=np.zeros(1), rotation=None),
            "geodetic",
            "rotation",
        ),
    ],
    ids=["degrees for metres", "no translation", "metres for degrees", "no attitude"],
)
def test_poses_that_lack_what_their_kind_needs_are_refused(poses, kind, lacking):
    with pytest.raises(InputError, match=f"the poses have no {lacking}, which pose_kind={kind} needs"):
        project(seen(LEFT_10), poses, crs="EPSG:32632", pose_kind=kind)
