"""Simulate a predictor on a drive through a true map; write predictions.json and poses.csv.

Run it from the project's folder, where the package is installed:
``python -m benchmarks.simulate_drive --truth truth.gpkg --poses poses.csv --seed 1 -o OUTDIR``
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import geopandas as gpd
import pandas as pd

from benchmarks.noise import Noise
from benchmarks.simulator import SimulatedDrive, key_frames, simulate
from polymerge_core.errors import InputError, PolymergeError


def write_drive(drive: SimulatedDrive, folder: Path) -> None:
    """Write ``predictions.json``, one token a line, and ``poses.csv`` into a folder.

    Parameters
    ----------
    drive : SimulatedDrive
        What `simulate` returned.
    folder : Path
        Made where it is missing; files of these names are replaced.
    """
    folder.mkdir(parents=True, exist_ok=True)
    frames = ",\n".join(f"{json.dumps(token)}: {_compact(frame)}" for token, frame in _frames(drive))
    text = f'{{"meta": {_compact(drive.predictions["meta"])},\n"results": {{\n{frames}\n}}}}\n'
    (folder / "predictions.json").write_text(text, encoding="utf-8", newline="\n")
    decimals = {"qw": 12, "qx": 12, "qy": 12, "qz": 12, "tx_m": 4, "ty_m": 4, "tz_m": 4}
    drive.poses.round(decimals).to_csv(folder / "poses.csv", index=False, lineterminator="\n")


def read_poses(path: Path) -> pd.DataFrame:
    """Read a pose table; the token stays text.

    Raises
    ------
    InputError
        If the file cannot be read or lacks a column.
    """
    try:
        poses = pd.read_csv(path, dtype={"token": str})
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read as a table of poses: {error}") from error
    missing = [name for name in ("timestamp_ns", "qw", "qx", "qy", "qz", "tx_m", "ty_m") if name not in poses]
    if missing:
        raise InputError(f"{path} has no column {', '.join(missing)}, only {', '.join(poses.columns)}")
    return poses


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    options = _parser().parse_args(arguments)
    try:
        poses = key_frames(read_poses(options.poses), options.frames, options.spacing, start=options.start)
        noise = Noise().scaled(options.noise)
        truth = gpd.read_file(options.truth)
        drive = simulate(truth, poses, seed=options.seed, noise=noise, offset=options.offset)
        write_drive(drive, options.output)
    except PolymergeError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    seen = sum(len(frame["vectors"]) for _, frame in _frames(drive))
    print(f"{len(poses)} frames, {seen} vectors: {options.output}", file=sys.stderr)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description="Simulate a predictor on a drive through a true map.")
    parser.add_argument("--truth", type=Path, required=True, help="layer of true lines with a column class")
    parser.add_argument("--poses", type=Path, required=True, help="CSV of true poses")
    parser.add_argument(
        "--offset",
        type=_pair,
        default=(0.0, 0.0),
        metavar="E,N",
        help="poses plus this are in the truth's CRS",
    )
    parser.add_argument("--frames", type=int, default=15, help="number of key frames (15)")
    parser.add_argument("--spacing", type=float, default=3.5, help="metres between key frames (3.5)")
    parser.add_argument("--start", type=float, default=0.0, help="metres driven before the first (0)")
    parser.add_argument("--noise", type=float, default=1.0, help="factor on all errors of pose and shape (1)")
    parser.add_argument("--seed", type=int, default=1, help="same seed, same files (1)")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for the two files")
    return parser


def _pair(text: str) -> tuple[float, float]:
    east, north = text.split(",")
    return float(east), float(north)


def _frames(drive: SimulatedDrive) -> Any:
    return drive.predictions["results"].items()


def _compact(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"))


if __name__ == "__main__":
    sys.exit(main())
