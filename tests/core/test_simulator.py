"""The simulator: repeatable, exact where its errors are switched off, true to its settings where they are on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from geopandas.testing import assert_geodataframe_equal

from benchmarks.make_sample import make_sample
from benchmarks.noise import CLASS_NAMES, CrossingNoise, LineNoise, Noise, unit_noise
from benchmarks.simulate_drive import main
from benchmarks.simulator import key_frames, simulate
from benchmarks.town import town_drive, town_truth
from polymerge_core.errors import InputError, OptionError, SchemaError

SAMPLE = Path(__file__).resolve().parents[2] / "resources" / "sample"
#: A vertex may move by half a cell along each axis when it is put on the grid.
ROUNDING_M = 0.15 * np.sqrt(2) + 1e-6


def poses_at(x, heading_deg=0.0):
    """Poses at y = 0 and the given x."""
    x = np.atleast_1d(np.asarray(x, float))
    half = np.radians(heading_deg) / 2
    columns = {"timestamp_ns": np.arange(len(x)), "qw": np.cos(half), "qx": 0.0, "qy": 0.0, "qz": np.sin(half)}
    return pd.DataFrame({**columns, "tx_m": x, "ty_m": 0.0, "tz_m": 0.0})


def truth_of(*features):
    """A truth from (class, WKT)."""
    classes, wkt = zip(*features, strict=True)
    return gpd.GeoDataFrame({"class": classes}, geometry=gpd.GeoSeries.from_wkt(wkt))


FAR_AWAY = truth_of(("divider", "LINESTRING (5000 0, 5020 0)"))


def world_vectors(drive, *, offset=(0.0, 0.0)):
    """Project the vectors with the poses of the drive, by plane rotation: label, element, vertices, ego vertices."""
    rows = []
    for frame, pose in zip(drive.predictions["results"].values(), drive.poses.itertuples(), strict=True):
        yaw = 2 * np.arctan2(pose.qz, pose.qw)
        turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        for vector, label, element in zip(frame["vectors"], frame["labels"], frame["element_id"], strict=True):
            ego = np.array(vector)
            rows.append((label, element, ego @ turn + (pose.tx_m, pose.ty_m) + offset, ego))
    return rows


@pytest.fixture(scope="module")
def town():
    return town_truth()


@pytest.fixture(scope="module")
def frames():
    return key_frames(town_drive(), 18)


@pytest.fixture(scope="module")
def many(town, frames):
    """The drive repeated until its shares mean something."""
    return [simulate(town, frames, seed=seed) for seed in range(6)]


def test_same_seed_same_drive_and_another_seed_another(town, frames):
    first, again, other = (simulate(town, frames, seed=seed) for seed in (3, 3, 4))
    assert json.dumps(first.predictions) == json.dumps(again.predictions)
    pd.testing.assert_frame_equal(first.poses, again.poses)
    assert json.dumps(first.predictions) != json.dumps(other.predictions)


def test_inputs_are_left_alone(town, frames):
    truth, poses = town.copy(), frames.copy()
    simulate(truth, poses, seed=1)
    pd.testing.assert_frame_equal(poses, frames)
    assert_geodataframe_equal(truth, town)


def test_without_noise_every_vertex_lies_on_its_element_within_the_grid(town, frames):
    drive = simulate(town, frames, seed=1, noise=Noise.none())
    elements = town.set_index("element_id").geometry
    vectors = world_vectors(drive)
    assert len(vectors) > 100
    for label, element, world, ego in vectors:
        away = shapely.distance(shapely.points(world), elements[element])
        on_edge = (np.abs(np.abs(ego) - [30.0, 15.0]) < 1e-9).any(axis=1) & (label == 0)
        assert away[~on_edge].max(initial=0.0) <= ROUNDING_M


def test_without_noise_the_poses_are_true(town, frames):
    drive = simulate(town, frames, seed=1, noise=Noise.none())
    pd.testing.assert_frame_equal(drive.poses, frames)


def test_a_tilted_vehicle_is_projected_back_exactly_by_equation_1():
    truth = truth_of(("divider", "LINESTRING (-20 3, 20 3)"))
    pitch, yaw = np.radians(8.0) / 2, np.radians(30.0) / 2
    # yaw about z after pitch about y
    q = (
        np.cos(yaw) * np.cos(pitch),
        -np.sin(yaw) * np.sin(pitch),
        np.cos(yaw) * np.sin(pitch),
        np.sin(yaw) * np.cos(pitch),
    )
    poses = poses_at([0.0]).assign(**dict(zip(("qw", "qx", "qy", "qz"), q, strict=True)))
    (vector,) = simulate(truth, poses, seed=1, noise=Noise.none()).predictions["results"]["0"]["vectors"]
    w, x, y, z = q
    rotation = np.array(
        [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z)], [2 * (x * y + w * z), 1 - 2 * (x * x + z * z)]]
    )
    world = np.array(vector) @ rotation.T
    np.testing.assert_allclose(world[:, 1], 3.0, atol=ROUNDING_M)
    assert np.ptp(world[:, 0]) > 30


def test_offset_moves_the_poses_into_the_crs_of_the_truth(town, frames):
    offset = (399_000.0, 6_039_000.0)
    city = frames.assign(tx_m=frames["tx_m"] - offset[0], ty_m=frames["ty_m"] - offset[1])
    drive = simulate(town, city, seed=2, offset=offset)
    plain = simulate(town, frames, seed=2)
    assert drive.predictions == plain.predictions
    moved, expected = (each.poses[["tx_m", "ty_m"]].to_numpy() for each in (drive, plain))
    np.testing.assert_allclose(moved + offset, expected, atol=1e-6)


def test_a_part_switched_off_leaves_the_other_random_numbers_as_they_were(town, frames):
    full = simulate(town, frames, seed=5)
    exact_poses = simulate(town, frames, seed=5, noise=replace(Noise(), pose_m=0.0, pose_deg=0.0))
    assert exact_poses.predictions == full.predictions
    pd.testing.assert_frame_equal(exact_poses.poses, frames)
    no_false = simulate(town, frames, seed=5, noise=replace(Noise(), false=0.0))
    kept, given = (
        sorted(
            score
            for frame in drive.predictions["results"].values()
            for score, element in zip(frame["scores"], frame["element_id"], strict=True)
            if element is not None
        )
        for drive in (no_false, full)
    )
    assert kept == given


def test_pose_error_has_the_set_size():
    poses = poses_at(np.zeros(800)).assign(timestamp_ns=np.arange(800))
    drive = simulate(FAR_AWAY, poses, seed=1)
    error = drive.poses[["tx_m", "ty_m"]] - poses[["tx_m", "ty_m"]]
    yaw = np.degrees(2 * np.arctan2(drive.poses["qz"], drive.poses["qw"]))
    np.testing.assert_allclose(error.std(), 0.15, rtol=0.1)
    np.testing.assert_allclose(yaw.std(), 0.5, rtol=0.1)


@pytest.mark.parametrize(("share", "within"), [(0.0, 0.15), (1.0, 0.0), (0.5, 0.15 * np.sqrt(0.5))], ids=str)
def test_pose_error_is_split_between_frame_and_drive(share, within):
    poses = poses_at(np.zeros(400)).assign(timestamp_ns=np.arange(400))
    noise = replace(Noise(), pose_drive_share=share)
    spread, whole = [], []
    for seed in range(12):
        east = simulate(FAR_AWAY, poses, seed=seed, noise=noise).poses["tx_m"].to_numpy()
        spread.append(east.std())
        whole.append(east[0])
    assert np.mean(spread) == pytest.approx(within, rel=0.05, abs=1e-12)
    assert 0.06 < np.std(whole) < 0.25


def test_shape_error_of_the_drive_is_the_same_in_every_frame():
    truth = truth_of(("boundary", "LINESTRING (-28 6, 28 6)"))
    poses = poses_at(np.zeros(4)).assign(timestamp_ns=np.arange(4))
    sure = replace(Noise(), pose_m=0.0, pose_deg=0.0, missed=0.0, false=0.0, split=0.0)
    sure = replace(sure, boundary=replace(sure.boundary, cut_m=0.0))

    def lines(share):
        drive = simulate(truth, poses, seed=1, noise=replace(sure, shape_drive_share=share))
        return [shapely.LineString(world) for *_, world, _ in world_vectors(drive)]

    same, free = lines(1.0), lines(0.0)
    assert max(line.hausdorff_distance(same[0]) for line in same[1:]) < 0.75
    assert max(line.hausdorff_distance(free[0]) for line in free[1:]) > 1.0


def test_unit_noise_has_variance_1_and_the_set_correlation():
    arc = np.linspace(0.0, 60.0, 241)
    draws = np.array([unit_noise(np.random.default_rng(seed), arc, 12.0, periodic=False) for seed in range(1500)])
    assert draws.var() == pytest.approx(1.0, rel=0.08)
    correlation = (draws[:, 80] * draws[:, 128]).mean()  # 12 m apart
    assert correlation == pytest.approx(np.exp(-0.5), abs=0.08)


@pytest.mark.parametrize("perimeter", [9.0, 40.0, 200.0])
def test_unit_noise_of_a_ring_closes(perimeter):
    noise = unit_noise(np.random.default_rng(1), np.linspace(0.0, perimeter, 101), 12.0, periodic=True)
    assert noise[0] == pytest.approx(noise[-1])


@pytest.mark.parametrize("name", ["divider", "boundary"])
def test_lateral_error_grows_with_distance_as_set(name):
    truth = truth_of((name, "LINESTRING (-60 2, 60 2)"))
    kind = getattr(Noise(), name)
    sure = replace(Noise(), pose_m=0.0, pose_deg=0.0, missed=0.0, false=0.0, split=0.0, along=0.0)
    poses = poses_at(np.zeros(300)).assign(timestamp_ns=np.arange(300))
    vertices = np.concatenate([ego for *_, ego in world_vectors(simulate(truth, poses, seed=1, noise=sure))])
    distance, error = np.abs(vertices[:, 0]), vertices[:, 1] - 2.0
    bands = [(low, error[(distance >= low) & (distance < low + 6)]) for low in (0, 6, 12, 18)]
    spread = np.array([band.std() for _, band in bands])
    assert (np.diff([np.abs(band).mean() for _, band in bands]) > 0).all()
    expected = [np.hypot(kind.base_m + kind.slope * np.hypot(low + 3, 2), 0.3 / np.sqrt(12)) for low, _ in bands]
    np.testing.assert_allclose(spread, expected, rtol=0.15)


def test_scaled_noise_scales_errors_and_keeps_shares():
    noise = Noise().scaled(2.0)
    assert (noise.pose_m, noise.pose_deg) == (0.3, 1.0)
    assert (noise.boundary.base_m, noise.boundary.slope, noise.boundary.cut_m) == (0.84, 0.08, 4.4)
    assert noise.crossing.turn_deg == 4.0
    assert (noise.missed, noise.false, noise.correlation_m) == (0.2, 0.08, 12.0)


def test_lines_are_missed_at_the_set_share():
    truth = truth_of(("divider", "LINESTRING (-25 2, 25 2)"))
    poses = poses_at(np.zeros(400)).assign(timestamp_ns=np.arange(400))
    noise = replace(Noise.none(), missed=0.2)
    frames = simulate(truth, poses, seed=1, noise=noise).predictions["results"].values()
    assert np.mean([len(frame["vectors"]) == 0 for frame in frames]) == pytest.approx(0.2, abs=0.05)


def test_false_detections_come_at_the_set_share(many):
    ids = [e for drive in many for frame in drive.predictions["results"].values() for e in frame["element_id"]]
    assert len(ids) > 900
    assert np.mean([element is None for element in ids]) == pytest.approx(0.08, abs=0.025)


def test_long_lines_are_split_at_the_set_share():
    truth = truth_of(("divider", "LINESTRING (-25 2, 25 2)"), ("divider", "LINESTRING (-5 6, 5 6)"))
    poses = poses_at(np.zeros(400)).assign(timestamp_ns=np.arange(400))
    noise = replace(Noise.none(), split=0.1)
    ids = [f["element_id"] for f in simulate(truth, poses, seed=1, noise=noise).predictions["results"].values()]
    assert sum(each.count(0) == 2 for each in ids) / len(ids) == pytest.approx(0.1, abs=0.04)
    assert all(each.count(1) == 1 for each in ids)


def test_ends_are_cut_by_a_metre_or_so():
    truth = truth_of(("divider", "LINESTRING (-25 2, 25 2)"))
    poses = poses_at(np.zeros(400)).assign(timestamp_ns=np.arange(400))
    noise = replace(Noise.none(), divider=replace(Noise().divider, base_m=0.0, slope=0.0))
    vectors = world_vectors(simulate(truth, poses, seed=1, noise=noise))
    ends = np.concatenate([[25 + ego[:, 0].min(), 25 - ego[:, 0].max()] for *_, ego in vectors])
    assert ends.mean() == pytest.approx(np.sqrt(2 / np.pi), rel=0.1)


def test_half_of_the_lines_are_digitised_backwards():
    truth = truth_of(("divider", "LINESTRING (-25 2, 25 2)"))
    poses = poses_at(np.zeros(300)).assign(timestamp_ns=np.arange(300))
    vectors = world_vectors(simulate(truth, poses, seed=1))
    backwards = [ego[0, 0] > ego[-1, 0] for _, element, _, ego in vectors if element == 0]
    assert np.mean(backwards) == pytest.approx(0.5, abs=0.07)


def test_vectors_lie_in_the_box_on_the_grid_with_few_vertices(many):
    for drive in many:
        for label, _, _, ego in world_vectors(drive):
            assert (np.abs(ego) <= [30.0, 15.0]).all()
            np.testing.assert_allclose(ego / 0.3, np.round(ego / 0.3), atol=1e-6)
            assert (np.diff(ego, axis=0) != 0).any(axis=1).all()
            if CLASS_NAMES[label] == "ped_crossing":
                assert 4 <= len(ego) <= 9
                assert (ego[0] == ego[-1]).all()
            else:
                assert 5 <= len(ego) <= 30


def test_false_detections_score_lower(many):
    frames = [frame for drive in many for frame in drive.predictions["results"].values()]
    scores = np.concatenate([frame["scores"] for frame in frames])
    false = np.concatenate([[element is None for element in frame["element_id"]] for frame in frames])
    assert ((scores >= 0) & (scores <= 1)).all()
    assert scores[false].mean() < scores[~false].mean() - 0.15


def test_a_ring_that_passes_its_start_in_view_is_one_piece():
    # The start (0, 5) is in view, the far side is not.
    truth = truth_of(("boundary", "LINESTRING (0 5, 10 5, 10 40, -10 40, -10 5, 0 5)"))
    (frame,) = simulate(truth, poses_at([0.0]), seed=1, noise=Noise.none()).predictions["results"].values()
    (vector,) = frame["vectors"]
    assert shapely.LineString(vector).length == pytest.approx(40.0, abs=1.5)


def test_an_island_in_view_stays_closed(town, frames):
    drive = simulate(town, frames, seed=1, noise=Noise().scaled(0.3))
    islands = set(town.loc[(town["class"] == "boundary") & town.geometry.is_closed, "element_id"])
    assert len(islands) == 2
    closed = {
        element for _, element, _, ego in world_vectors(drive) if element in islands and (ego[0] == ego[-1]).all()
    }
    assert closed == islands


def test_a_frame_that_sees_nothing_has_empty_lists():
    truth = truth_of(("divider", "LINESTRING (500 0, 520 0)"))
    (frame,) = simulate(truth, poses_at([0.0]), seed=1).predictions["results"].values()
    assert frame == {"vectors": [], "scores": [], "labels": [], "element_id": []}


@pytest.mark.parametrize(
    "feature",
    [("kerb", "LINESTRING (0 0, 9 0)"), ("divider", "POINT (0 0)"), ("divider", "LINESTRING EMPTY")],
    ids=["unknown class", "point", "empty"],
)
def test_a_truth_that_cannot_be_driven_past_is_refused(feature):
    with pytest.raises(SchemaError, match="feature 0"):
        simulate(truth_of(feature), poses_at([0.0]), seed=1)


@pytest.mark.parametrize("change", [{"missed": 1.2}, {"false": 0.5}, {"correlation_m": 0.0}], ids=str)
def test_impossible_noise_is_refused(change):
    with pytest.raises(OptionError, match=next(iter(change))):
        Noise(**change)


def test_key_frames_are_evenly_spaced_from_the_start():
    poses = poses_at(np.arange(0.0, 30.0, 0.5))
    assert key_frames(poses, 5, 3.5, start=2.0)["tx_m"].tolist() == [2.0, 5.5, 9.0, 12.5, 16.0]


def test_key_frames_of_a_drive_too_short_are_refused():
    with pytest.raises(InputError, match=r"10\.0 m long"):
        key_frames(poses_at([0.0, 10.0]), 15, 3.5)


def test_town_is_what_the_readme_says(town):
    assert town["class"].value_counts().to_dict() == {"divider": 11, "boundary": 6, "ped_crossing": 4}
    assert town.geometry.is_simple.all()
    assert town.loc[town["class"] == "ped_crossing"].geometry.is_closed.all()
    dividers = town.loc[town["class"] == "divider"].geometry.to_numpy()
    gaps = shapely.distance(dividers[:, None], dividers)[np.triu_indices(len(dividers), 1)]
    assert np.isclose(gaps, 0.4, atol=0.02).sum() == 3


def test_town_corners_have_a_radius_of_6_m(town):
    kerb = town.loc[(town["class"] == "boundary") & ~town.geometry.is_closed].geometry.iloc[2]
    vertices = shapely.get_coordinates(kerb) - (400_000, 6_040_000)
    # Between the west kerb y = -7 and the south kerb x = -4 the arc is centred on (-10, -13).
    corner = vertices[(vertices[:, 0] > -9.9) & (vertices[:, 1] > -12.9)]
    assert len(corner) > 8
    np.testing.assert_allclose(np.hypot(*(corner - (-10, -13)).T), 6.0, atol=0.02)


def test_town_drive_turns_smoothly_and_follows_its_course():
    drive = town_drive()
    heading = np.unwrap(2 * np.arctan2(drive["qz"], drive["qw"]))
    assert np.abs(np.diff(heading)).max() < 0.02
    x, y = np.diff(drive[["tx_m", "ty_m"]].to_numpy(), axis=0).T
    off = np.angle(np.exp(1j * (np.arctan2(y, x) - heading[:-1])))
    assert np.abs(off).max() < 0.1
    np.testing.assert_allclose(np.hypot(x, y), 0.1, atol=0.01)


def test_the_committed_sample_is_what_make_sample_writes(tmp_path):
    make_sample(tmp_path)
    for name in ("predictions.json", "poses.csv"):
        assert (tmp_path / name).read_bytes() == (SAMPLE / name).read_bytes()
    fresh, kept = (gpd.read_file(folder / "reference.gpkg", layer="ground_truth") for folder in (tmp_path, SAMPLE))
    assert_geodataframe_equal(fresh, kept)
    assert list(kept.columns) == ["element_id", "class", "geometry"]
    assert kept.crs.to_epsg() == 32632
    assert sum(file.stat().st_size for file in SAMPLE.iterdir()) < 300_000


def test_the_reference_file_repeats_byte_for_byte(tmp_path):
    for name in ("a", "b"):
        make_sample(tmp_path / name)
    assert (tmp_path / "a" / "reference.gpkg").read_bytes() == (tmp_path / "b" / "reference.gpkg").read_bytes()


def test_the_sample_is_one_token_a_line_and_matches_its_poses():
    lines = (SAMPLE / "predictions.json").read_text().splitlines()
    results = json.loads("\n".join(lines))["results"]
    poses = pd.read_csv(SAMPLE / "poses.csv")
    assert list(results) == poses["token"].tolist()
    assert len(lines) == len(results) + 3
    assert list(poses) == ["timestamp_ns", "qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m", "token"]


def test_command_line_writes_a_drive_in_the_poses_own_frame(tmp_path, town):
    town.to_file(tmp_path / "truth.gpkg")
    drive = town_drive()
    drive.assign(tx_m=drive["tx_m"] - 399_000, ty_m=drive["ty_m"] - 6_039_000).to_csv(tmp_path / "p.csv", index=False)
    options = ["--truth", tmp_path / "truth.gpkg", "--poses", tmp_path / "p.csv", "--offset", "399000,6039000"]
    assert main([*map(str, options), "--frames", "6", "--seed", "2", "-o", str(tmp_path / "out")]) == 0
    poses = pd.read_csv(tmp_path / "out" / "poses.csv")
    results = json.loads((tmp_path / "out" / "predictions.json").read_text())["results"]
    assert list(results) == poses["timestamp_ns"].astype(str).tolist()
    assert len(poses) == 6
    assert poses["tx_m"].between(900, 1100).all()
    assert sum(len(frame["vectors"]) for frame in results.values()) > 20


def test_command_line_says_what_is_wrong_in_one_line(tmp_path, town, capsys):
    town.to_file(tmp_path / "truth.gpkg")
    (tmp_path / "p.csv").write_text("timestamp_ns,tx_m\n1,2\n")
    options = ["--truth", str(tmp_path / "truth.gpkg"), "--poses", str(tmp_path / "p.csv"), "-o", str(tmp_path / "out")]
    assert main(options) == 1
    message = capsys.readouterr().err
    assert "no column qw" in message
    assert message.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_the_noise_model_is_frozen():
    # Figures in the documentation rest on these numbers; a change of the method must not be bought by a change of them.
    assert Noise() == Noise(
        pose_m=0.15,
        pose_deg=0.5,
        divider=LineNoise(0.107, 0.0065, 1.0),
        boundary=LineNoise(0.42, 0.040, 2.2),
        crossing=CrossingNoise(base_m=0.20, slope=0.008, scale=0.06, turn_deg=2.0, corner_m=0.15),
        correlation_m=12.0,
        along=0.5,
        missed=0.20,
        split=0.10,
        reverse=0.5,
        false=0.08,
        score_true=(12.0, 2.0),
        score_false=(4.0, 3.0),
        pose_drive_share=0.0,
        shape_drive_share=0.0,
    )
