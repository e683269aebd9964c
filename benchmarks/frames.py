"""Frames of simulated drives through the town junction, as a vehicle sends them to a stored map: JSON, one a line."""

from __future__ import annotations

import json
from collections.abc import Iterator

from benchmarks.simulator import CLASS_NAMES, key_frames, simulate
from benchmarks.town import CRS, town_drive, town_truth

__all__ = ["CRS", "town_frames"]

_SECONDS_APART = 1_000


def town_frames(drives: int, frames: int = 15, *, apart_m: float = 0.0, first_seed: int = 1) -> Iterator[str]:
    """Drive through the junction again and again.

    Parameters
    ----------
    drives : int
        How many times.
    frames : int, default 15
        Of each drive.
    apart_m : float, default 0
        How far east of the one before each drive finds a junction of its own.
    first_seed : int, default 1
        Of the first drive; each other has the next one.

    Yields
    ------
    str
        A JSON object as `polymerge_core.messages.read_message` takes it, metres in `CRS`.
    """
    truth, poses = town_truth(), key_frames(town_drive(), frames)
    poses = poses.assign(token=[f"frame_{number:02d}" for number in range(frames)])
    for number in range(drives):
        drive = simulate(truth, poses, seed=first_seed + number)
        for pose in drive.poses.to_dict("records"):
            seen = drive.predictions["results"][pose["token"]]
            yield json.dumps(
                {
                    "drive": f"drive_{number:03d}",
                    "instance": pose["token"],
                    "timestamp_ns": pose["timestamp_ns"] + number * _SECONDS_APART * 10**9,
                    "pose": {
                        "translation": [pose["tx_m"] + number * apart_m, pose["ty_m"], pose["tz_m"]],
                        "rotation": [pose[name] for name in ("qw", "qx", "qy", "qz")],
                    },
                    "vectors": seen["vectors"],
                    "labels": [CLASS_NAMES[label] for label in seen["labels"]],
                    "scores": seen["scores"],
                }
            )
