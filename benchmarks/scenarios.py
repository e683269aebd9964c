"""The inputs of the accuracy benchmarks: true maps, and local maps of drives through them.

The paper's experiment has three scenarios of 15 consecutive local maps. Here their frames are simulated on real drives
through real maps (Argoverse 2), on a town that anybody can simulate, and there are real predictions over known maps.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

import polymerge_core as pm
from benchmarks.simulate_drive import read_poses, write_drive
from benchmarks.simulator import SimulatedDrive, key_frames, simulate
from benchmarks.town import town_drive, town_truth

if TYPE_CHECKING:
    from benchmarks.noise import Noise

FRAMES, SPACING_M = 15, 3.5

#: Logs of Argoverse 2: folder, city offset (east, north) of the poses, CRS.
MIAMI = ("3b3570b4-7b0b-3268-a571-b0889dbf40b6", (580560.0088, 2850959.9999))
PITTSBURGH = ("7fab2350-7eaf-3b7e-a39d-6937a4c1bede", (583710.0070, 4477259.9998))
AV2_CRS = "EPSG:32617"


@dataclass(frozen=True)
class Scenario:
    """Local maps over a true map.

    Attributes
    ----------
    name : str
        What a table calls it.
    truth : GeoDataFrame
        The true map.
    local : list of LocalMaps
        What was seen, one entry a drive.
    true_ids : Series
        The true element behind each observation, row by row of all drives; None for a false detection, and where it is
        not known.
    """

    name: str
    truth: gpd.GeoDataFrame
    local: list[pm.LocalMaps]
    true_ids: pd.Series

    @property
    def observations(self) -> gpd.GeoDataFrame:
        """All observations as one layer."""
        frame = pd.concat([maps.observations for maps in self.local], ignore_index=True)
        return gpd.GeoDataFrame(frame, crs=self.truth.crs)


@dataclass(frozen=True)
class Road:
    """A true map and a way through it, on which frames can be simulated.

    Attributes
    ----------
    truth : GeoDataFrame
        The true map.
    poses : DataFrame
        True poses all along the way.
    place : dict
        Where the poses are: options of `polymerge_core.project`.
    """

    truth: gpd.GeoDataFrame
    poses: pd.DataFrame
    place: dict[str, Any]

    def drive(
        self,
        name: str,
        *,
        seed: int,
        noise: Noise | None = None,
        count: int = FRAMES,
        spacing: float = SPACING_M,
        start: float = 0.0,
    ) -> Scenario:
        """Simulate a drive: what `count` frames see, `spacing` metres apart from `start` metres along the way on."""
        poses = key_frames(self.poses, count, spacing, start=start)
        offset = self.place.get("pose_offset", (0.0, 0.0))
        drive = simulate(self.truth, poses, seed=seed, noise=noise, offset=offset)
        return simulated_scenario(name, self.truth, drive, self.place)


def held_whole(scenario: Scenario) -> pd.Series:
    """Tell of each observation whether it is a line, or a crossing that its frame's footprint holds whole.

    A crossing at the edge of the frame is cut off there: its ring can be compared with no ring of the true map.

    Parameters
    ----------
    scenario : Scenario
        One drive, with its true ids.

    Returns
    -------
    Series of bool
        In the order of `Scenario.observations`.
    """
    (local,) = scenario.local
    rings = scenario.truth.set_index("element_id").geometry
    footprints = local.instances.set_index("instance").geometry
    seen = local.observations
    known = scenario.true_ids.notna() & (seen["class"] == "ped_crossing")
    whole = pd.Series(np.full(len(seen), fill_value=True), index=seen.index)
    boxes = footprints.loc[seen.loc[known, "instance"]].to_numpy()
    whole[known] = shapely.covers(boxes, rings.loc[scenario.true_ids[known]].to_numpy())
    return whole


def av2_scenarios(folder: Path, *, seed: int, noise: Noise | None = None) -> list[Scenario]:
    """Return the three scenarios of 15 key frames 3.5 m apart: Miami, Pittsburgh from the start, Pittsburgh to the end.

    Parameters
    ----------
    folder : Path
        The folder that holds ``av2/<log>/{ground_truth.gpkg,poses.csv}``.
    seed : int
        Of the simulated errors.
    noise : Noise, optional
        The calibrated model by default.

    Returns
    -------
    list of Scenario
        Named S1, S2 and S3.
    """
    starts = {"S1": (MIAMI, 0.0), "S2": (PITTSBURGH, 0.0), "S3": (PITTSBURGH, last_start(folder))}
    return [
        av2_road(folder, log).drive(name, seed=seed, noise=noise, start=start) for name, (log, start) in starts.items()
    ]


def av2_road(folder: Path, log: tuple[str, tuple[float, float]]) -> Road:
    """Return the road of `MIAMI` or `PITTSBURGH`, from the folder that `av2_scenarios` reads."""
    name, offset = log
    truth = gpd.read_file(folder / "av2" / name / "ground_truth.gpkg")
    place = {"crs": AV2_CRS, "pose_kind": "offset", "pose_offset": offset}
    return Road(truth, read_poses(folder / "av2" / name / "poses.csv"), place)


def last_start(folder: Path) -> float:
    """Return the metres driven before the first of the last 15 key frames of the Pittsburgh log."""
    poses = read_poses(folder / "av2" / PITTSBURGH[0] / "poses.csv")
    driven = np.hypot(*np.diff(poses[["tx_m", "ty_m"]].to_numpy(float), axis=0).T).sum()
    return float(driven) - (FRAMES - 1) * SPACING_M


def overlap(folder: Path) -> float:
    """Return how much of their way, metres, the two Pittsburgh scenarios have in common."""
    return max(0.0, (FRAMES - 1) * SPACING_M - last_start(folder))


def town(seed: int, noise: Noise | None = None) -> Scenario:
    """Return 20 frames of a drive through the simulated town junction."""
    return town_road().drive("town", seed=seed, noise=noise, count=20)


def town_road() -> Road:
    """Return the simulated town junction and the drive through it."""
    truth = town_truth()
    return Road(truth, town_drive(), {"crs": str(truth.crs)})


def simulated_scenario(name: str, truth: gpd.GeoDataFrame, drive: SimulatedDrive, place: dict[str, Any]) -> Scenario:
    """Carry a simulated drive into the world through the files and functions that a user has.

    Parameters
    ----------
    name : str
        Of the scenario, and of the drive.
    truth : GeoDataFrame
        The true map.
    drive : SimulatedDrive
        What `simulate` returned.
    place : dict
        Where it is: options of `polymerge_core.project`.

    Returns
    -------
    Scenario
        With the true element behind each observation.
    """
    with tempfile.TemporaryDirectory() as folder:
        write_drive(drive, Path(folder))
        predictions = pm.read_predictions(Path(folder) / "predictions.json")
        poses = pm.read_poses(Path(folder) / "poses.csv")
    local = pm.project(predictions, poses, drive=name, **place)
    results = drive.predictions["results"]
    vectors = zip(predictions.frame, predictions.index, strict=True)
    ids = [results[predictions.tokens[frame]]["element_id"][index] for frame, index in vectors]
    return Scenario(name, truth, [local], pd.Series(ids, index=local.observations.index, dtype=object))


def deecamp(folder: Path) -> Scenario:
    """Return real lane detections of fourteen drives over one road with a map of its dividers."""
    drives = sorted((folder / "deecamp").glob("*/predictions.json"))
    return _predicted("deecamp", folder / "deecamp" / "ground_truth.gpkg", drives)


def openlane(folder: Path) -> Scenario:
    """Return real lane detections of one drive, and a reference voted from annotated lanes."""
    place = folder / "openlane_persformer"
    return _predicted("openlane", place / "reference.gpkg", [place / "predictions.json"])


def _predicted(name: str, truth: Path, drives: list[Path]) -> Scenario:
    local = [
        pm.project(
            pm.read_predictions(file), pm.read_poses(file.parent / "poses.csv"), crs="local", drive=file.parent.name
        )
        for file in drives
    ]
    count = sum(len(maps.observations) for maps in local)
    (layer,) = pm.read_layers(truth).values()
    return Scenario(name, layer, local, pd.Series([None] * count, dtype=object))
