"""Poses from files: CSV and JSON, exact timestamps, and what a file can have wrong."""

import json
import pickle

import numpy as np
import pytest

from polymerge_core.errors import InputError
from polymerge_core.formats import read_poses
from polymerge_core.formats.records import Poses
from polymerge_core.formats.rotation import is_rigid

HEADER = "timestamp_ns,qw,qx,qy,qz,tx_m,ty_m,tz_m"
STAMP = 315966253572412943  # not a float: the nearest one is ...944
QUARTER_LEFT = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
S = 0.7071067811865476


@pytest.fixture
def write(tmp_path):
    def _write(content, name="poses.csv"):
        path = tmp_path / name
        if isinstance(content, list):
            content = json.dumps(content)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return _write


def csv_of(*rows, header=HEADER):
    return "\n".join([header, *rows]) + "\n"


ROW = f"{STAMP},{S},0,0,{S},10.5,20.25,-1.5"


def entry(**changes):
    pose = {"token": "a", "timestamp_ns": STAMP, "translation": [10.5, 20.25, -1.5], "rotation": [S, 0, 0, S]}
    return {key: value for key, value in (pose | changes).items() if value is not None}


def check_the_one_pose(poses, atol=1e-15):
    assert poses.timestamp_ns.tolist() == [STAMP]
    assert poses.timestamp_ns.dtype == np.int64
    np.testing.assert_allclose(poses.rotation, [QUARTER_LEFT], atol=atol)
    np.testing.assert_array_equal(poses.translation, [[10.5, 20.25, -1.5]])


# --- CSV


@pytest.mark.parametrize(
    "content",
    [
        csv_of(ROW),
        csv_of(ROW).replace("\n", "\r\n"),
        "\ufeff" + csv_of(ROW),
        csv_of(ROW).rstrip(),
        csv_of(ROW, "", " , , ,,,,,"),
        csv_of(ROW).replace(",", ", "),
        csv_of(ROW).replace(",", ";"),
        csv_of(ROW).replace(",", "\t"),
        csv_of(ROW.replace(",", ";").replace(".", ","), header=HEADER.replace(",", ";")),
        csv_of(f"x,{ROW},", header=f"camera,{HEADER},"),
    ],
    ids=[
        "plain", "CRLF", "byte order mark", "no last line end", "blank rows", "spaces", "semicolons", "tabs",
        "decimal commas between semicolons", "further columns",
    ],
)  # fmt: skip
def test_a_csv_file_reads_the_same_however_it_was_saved(write, content):
    check_the_one_pose(read_poses(write(content)))


def test_columns_are_found_by_name_not_by_place(write):
    names, values = HEADER.split(","), ROW.split(",")
    content = csv_of(",".join(values[::-1]), header=",".join(names[::-1]))
    check_the_one_pose(read_poses(write(content)))


def test_tokens_are_read_as_text(write):
    poses = read_poses(write(csv_of(f"{ROW}, 007 ", header=f"{HEADER},token")))
    assert poses.token.tolist() == ["007"]


def test_without_a_height_the_translation_is_level(write):
    content = csv_of("5,1,0,0,0,10,20", header="timestamp_ns,qw,qx,qy,qz,tx_m,ty_m")
    assert read_poses(write(content)).translation.tolist() == [[10.0, 20.0, 0.0]]


def test_geodetic_columns(write):
    poses = read_poses(write(csv_of("5,48.5,11.25,90", header="timestamp_ns,lat,lon,heading_deg")))
    assert (poses.lat.tolist(), poses.lon.tolist(), poses.height_m.tolist()) == ([48.5], [11.25], [0.0])
    assert poses.heading_deg.tolist() == [90.0]
    assert poses.rotation is None
    assert poses.translation is None


def test_geodetic_columns_with_attitude_and_height(write):
    content = csv_of("5,48.5,11.25,510.5,1,0,0,0", header="timestamp_ns,lat,lon,height_m,qw,qx,qy,qz")
    poses = read_poses(write(content))
    assert poses.height_m.tolist() == [510.5]
    assert poses.heading_deg is None
    np.testing.assert_array_equal(poses.rotation, [np.eye(3)])


def test_a_file_without_rows_has_no_poses(write):
    assert len(read_poses(write(HEADER + "\n")).timestamp_ns) == 0
    assert len(read_poses(write([])).timestamp_ns) == 0


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (csv_of(ROW, '8,1,0,0,0,"10,5",0,0'), r"line 3, column tx_m: '10,5' is not a number.*decimal point"),
        (csv_of(ROW, "8,1,0,0,0,10,5,0,0"), r"line 3: 9 values for 8 columns.*decimal point"),
        (csv_of(ROW, "8,1,0,0"), r"line 3: 4 values for 8 columns.*cut off"),
        (csv_of(ROW, "8,1,0,0,0,ten,0,0"), r"line 3, column tx_m: 'ten' is not a number"),
        (csv_of(ROW, "8,1,0,0,0,,0,0"), r"line 3, column tx_m: '' is not a number"),
        (csv_of(ROW, "8,1,0,0,0,nan,0,0"), r"line 3, column tx_m: 'nan' is not a number"),
        (csv_of(ROW, "8,1,0,0,0,1_000,0,0"), r"line 3, column tx_m: '1_000' is not a number"),
        (csv_of(ROW, "8,1,0,0,0,1e999,0,0"), r"line 3: the translation is not finite"),
        (csv_of("8;1;0;0;0;1.234,5;0;0", header=HEADER.replace(",", ";")), r"line 2, column tx_m: '1.234,5'"),
        (csv_of("3.0,1,0,0,0,0,0,0"), r"line 2, column timestamp_ns: '3.0' is not a whole number"),
        (csv_of("1e18,1,0,0,0,0,0,0"), r"column timestamp_ns: '1e18' is not a whole number"),
        (csv_of("99999999999999999999,1,0,0,0,0,0,0"), r"line 2: the timestamp 9+ does not fit"),
        (csv_of(ROW, "8,1,0,0,1,0,0,0"), r"line 3: the quaternion has length 1\.41421, not 1"),
        (csv_of("8,0,0,0,0,0,0,0"), r"line 2: the quaternion has length 0, not 1"),
        (csv_of("8,1.0011,0,0,0,0,0,0"), r"line 2: the quaternion has length 1\.0011, not 1"),
        (csv_of("1,2", header="time,x"), r"no column 'timestamp_ns'; the columns are time, x"),
        (csv_of("1,2", header="timestamp_ns,lat"), r"no column 'lon'; the columns are timestamp_ns, lat"),
        (csv_of("1,2,3", header="timestamp_ns,lat,lon"), r"no column 'qw'"),
        (csv_of("1,2,3", header="timestamp_ns,tx_m,ty_m"), r"no column 'qw'"),
        (csv_of("1,2,3,4", header="timestamp_ns,tx_m,ty_m,heading_deg"), r"no column 'qw'"),
        (csv_of("1,1,0,0,0", header="timestamp_ns,qw,qx,qy,qz"), r"no column 'tx_m'"),
        (csv_of("1,1,0,0,3,4", header="timestamp_ns,qw,qx,qy,tx_m,ty_m"), r"no column 'qz'"),
        (csv_of(f"{ROW},1", header=f"{HEADER},qw"), r"column 'qw' stands twice"),
        (csv_of(f"{ROW},", header=f"{HEADER},token"), r"line 2: the name '' is empty"),
        (csv_of("1,91,11,0", header="timestamp_ns,lat,lon,heading_deg"), "line 2: lat 91, lon 11 are not"),
        (csv_of("1,4,1100,0", header="timestamp_ns,lat,lon,heading_deg"), "line 2: lat 4, lon 1100 are not"),
        (csv_of('1,1,0,0,0,"2,3'), r"not valid CSV"),
        (csv_of(ROW, "8,1,0,0,0,1,2,3", "8,1,0,0,0,1,2,4"), r"the timestamp 8 has two different poses"),
        (csv_of(f"{ROW},a", "8,1,0,0,0,1,2,3,a", header=f"{HEADER},token"), "the token a has two different"),
        ("", "is empty"),
        (pickle.dumps([1]), "pickle"),
    ],
)  # fmt: skip
def test_a_bad_csv_file_is_an_error_that_names_row_and_column(write, content, message):
    path = write(content)
    with pytest.raises(InputError, match=message) as caught:
        read_poses(path)
    assert str(path) in str(caught.value)


def test_the_same_pose_twice_does_no_harm(write):
    assert read_poses(write(csv_of(ROW, ROW))).timestamp_ns.tolist() == [STAMP, STAMP]


def test_two_tokens_may_share_one_pose_but_not_one_moment_with_two(write):
    header = f"{HEADER},token"
    assert len(read_poses(write(csv_of(f"{ROW},a", f"{ROW},b", header=header))).token) == 2
    with pytest.raises(InputError, match=f"the timestamp {STAMP} has two different poses"):
        read_poses(write(csv_of(f"{ROW},a", f"{ROW[:-1]}6,b", header=header)))


def test_timestamps_one_nanosecond_apart_stay_apart(write):
    poses = read_poses(write(csv_of(ROW, ROW.replace(str(STAMP), str(STAMP + 1)))))
    assert poses.timestamp_ns.tolist() == [STAMP, STAMP + 1]


@pytest.mark.parametrize("length", [0.9991, 1.0009], ids=["short", "long"])
def test_a_quaternion_off_by_rounding_is_normalised(write, length):
    poses = read_poses(write(csv_of(f"{STAMP},{S * length},0,0,{S * length},10.5,20.25,-1.5")))
    check_the_one_pose(poses)


# --- JSON


def matrix(rotation=QUARTER_LEFT, translation=(10.5, 20.25, -1.5), last=(0, 0, 0, 1)):
    return [[*row, shift] for row, shift in zip(rotation, translation, strict=True)] + [list(last)]


@pytest.mark.parametrize(
    "pose",
    [
        entry(),
        entry(rotation=QUARTER_LEFT),
        entry(rotation=None, translation=None, matrix=matrix()),
        entry(timestamp_ns=str(STAMP)),
        entry(rotation=(1.0004 * np.array(QUARTER_LEFT)).tolist(), token=7),
    ],
    ids=["quaternion", "3x3", "4x4", "timestamp as text", "matrix off by rounding"],
)
def test_a_pose_reads_the_same_however_it_is_written(write, pose):
    check_the_one_pose(read_poses(write([pose], "poses.json")))


def test_json_is_known_by_its_content(write):
    check_the_one_pose(read_poses(write(b"\xef\xbb\xbf \n" + json.dumps([entry()]).encode(), "poses.txt")))


def test_quaternions_and_matrices_may_stand_in_one_file(write):
    turns = [[1, 0, 0, 0], QUARTER_LEFT, [0, 0, 0, 1]]
    poses = read_poses(write([entry(token=str(i), timestamp_ns=i, rotation=turn) for i, turn in enumerate(turns)]))
    np.testing.assert_allclose(poses.rotation[:, 0, 0], [1.0, 0.0, -1.0], atol=1e-15)
    np.testing.assert_allclose(poses.rotation[:, 1, 0], [0.0, 1.0, 0.0], atol=1e-15)


def test_nuscenes_timestamps_are_microseconds(write):
    poses = read_poses(write([entry(timestamp_ns=None, timestamp=1532402927647951)]))
    assert poses.timestamp_ns.tolist() == [1532402927647951000]


def test_timestamp_ns_wins_over_timestamp(write):
    assert read_poses(write([entry(timestamp=1)])).timestamp_ns.tolist() == [STAMP]


def test_a_flat_translation_is_level(write):
    assert read_poses(write([entry(translation=[1, 2])])).translation.tolist() == [[1.0, 2.0, 0.0]]


def test_geodetic_entries(write):
    pose = {"timestamp_ns": 1, "lat": 48.5, "lon": 11.25, "height_m": 500.0, "heading_deg": 45}
    poses = read_poses(write([pose, pose | {"timestamp_ns": 2, "heading_deg": 46.0}]))
    assert poses.token is None
    assert poses.heading_deg.tolist() == [45.0, 46.0]
    assert poses.height_m.tolist() == [500.0, 500.0]


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ([entry(rotation=[1.0, 0, 0, 0.1])], r"pose 0: the quaternion has length 1\.00499, not 1"),
        ([entry(), entry(token="b", rotation=[[2, 0, 0], [0, 2, 0], [0, 0, 2]])], "pose 1: .*not a rotation"),
        ([entry(rotation=[[1, 0.01, 0], [0, 1, 0], [0, 0, 1]])], r"pose 0: the matrix is not a rotation"),
        ([entry(rotation=[[1, 0, 0], [0, 1, 0], [0, 0, -1]])], r"pose 0: the matrix is not a rotation"),
        ([entry(rotation=[1, 0, 0])], r"\(token 'a'\), rotation: expected 4 or 3x3 numbers"),
        ([entry(rotation=[None, 0, 0, 1])], r"pose 0: the quaternion is not finite"),
        ([entry(rotation=None)], r"\(token 'a'\) has no 'rotation'; its keys are"),
        ([entry(rotation=None, heading_deg=3)], r"\(token 'a'\) has no 'rotation'"),
        ([entry(translation=None)], r"\(token 'a'\) has no 'translation'"),
        ([entry(translation=[1, 2, 3, 4])], r"translation: expected 2 or 3 numbers"),
        ([entry(translation=[1, "2", 3])], r"translation: expected numbers"),
        ([entry(matrix=matrix())], r"\(token 'a'\) has both 'matrix' and 'rotation'"),
        ([entry(rotation=None, translation=None, matrix=matrix(last=(0, 0, 1, 1)))], "last row of the"),
        ([entry(rotation=None, translation=None, matrix=QUARTER_LEFT)], r"matrix: expected 4x4 numbers"),
        ([entry(timestamp_ns=None)], r"\(token 'a'\) has no 'timestamp_ns'"),
        ([entry(timestamp_ns=1.5e18)], r"timestamp_ns must be a whole number"),
        ([entry(timestamp_ns=True)], r"timestamp_ns must be a whole number"),
        ([entry(timestamp_ns=None, timestamp=10**17)], r"pose 0: the timestamp 1\d+ does not fit"),
        ([entry(token=1.5)], r"pose 0: the token must be text"),
        ([entry(token="")], r"the name '' is empty"),
        ([entry(), entry(token=None, timestamp_ns=1)], r"pose 1 has no token, although others"),
        ([entry(), entry(token="b", lat=1, lon=2)], r"pose 0 has no lat and lon, although others"),
        ([entry(lat=1)], r"\(token 'a'\) has no 'lon'"),
        ([entry(lat=95, lon=2)], r"pose 0: lat 95, lon 2 are not degrees"),
        ([entry(), entry(translation=[0, 0, 0])], r"the token a has two different poses"),
        ([entry(), entry(token="b", translation=[0, 0, 0])], f"the timestamp {STAMP} has two"),
        ([3], r"pose 0 must be an object, not a number"),
        ('{"poses": []}', r"list of poses must be a list, not an object"),
        ('[{"token": "a", "token": "b"}]', r"the key 'token' stands twice"),
        ('[{"token": "a"', r"not valid JSON at line 1"),
    ],
)  # fmt: skip
def test_a_bad_json_file_is_an_error_that_names_the_pose(write, document, message):
    path = write(document, "poses.json")
    with pytest.raises(InputError, match=message) as caught:
        read_poses(path)
    assert str(path) in str(caught.value)


# --- poses made in Python


def test_poses_made_by_hand_are_checked_too():
    stamps = np.array([1, 2])
    with pytest.raises(InputError, match=r"translation has the shape \(3, 3\) instead of \(2, 3\)"):
        Poses(stamps, translation=np.zeros((3, 3)))
    with pytest.raises(InputError, match="pose 1 is not rigid"):
        Poses(stamps, rotation=np.stack([np.eye(3), 2 * np.eye(3)]))
    with pytest.raises(InputError, match="timestamp 1 has two"):
        Poses(np.array([1, 1]), lat=np.array([0.0, 1.0]))


def test_take_keeps_rows_together():
    poses = Poses(np.array([1, 2, 3]), lat=np.array([0.1, 0.2, 0.3]), source="x").take(np.array([2, 0, 2]))
    assert poses.timestamp_ns.tolist() == [3, 1, 3]
    assert poses.lat.tolist() == [0.3, 0.1, 0.3]
    assert poses.source == "x"


@pytest.mark.parametrize(
    ("matrix", "expected"),
    [
        (np.eye(3), True),
        (np.diag([1.0, -1.0, -1.0]), True),
        (np.diag([1.0, 1.0, -1.0]), False),
        (np.zeros((3, 3)), False),
    ],
    ids=["identity", "half turn", "mirror", "zero"],
)  # fmt: skip
def test_only_rotations_are_rigid(matrix, expected):
    assert is_rigid(matrix[None]).tolist() == [expected]
