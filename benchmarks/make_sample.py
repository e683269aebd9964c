"""Write the sample: a simulated drive through the town junction, and its true map.

Run it from the project's folder, where the package is installed: ``python -m benchmarks.make_sample``
The same files come out of every run, bit for bit with the same libraries.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pyogrio

from benchmarks.simulate_drive import write_drive
from benchmarks.simulator import key_frames, simulate
from benchmarks.town import town_drive, town_truth

if TYPE_CHECKING:
    import geopandas as gpd

SAMPLE = Path(__file__).resolve().parents[1] / "resources" / "sample"
SEED = 7
FRAMES = 20


def make_sample(folder: Path) -> None:
    """Write predictions.json, poses.csv and reference.gpkg (layer ``ground_truth``) into a folder.

    Parameters
    ----------
    folder : Path
        Made where it is missing; files of these names are replaced.
    """
    truth = town_truth()
    poses = key_frames(town_drive(), FRAMES)
    poses = poses.assign(token=[f"town_{number:02d}" for number in range(len(poses))])
    write_drive(simulate(truth, poses, seed=SEED), folder)
    write_reference(truth, folder / "reference.gpkg")


def write_reference(truth: gpd.GeoDataFrame, path: Path) -> None:
    """Write the true map as a GeoPackage 1.3 without the time of writing."""
    path.unlink(missing_ok=True)
    before = pyogrio.get_gdal_config_option("OGR_CURRENT_DATE")
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": "2024-01-01T00:00:00.000Z"})
    try:
        truth.to_file(path, layer="ground_truth", driver="GPKG", engine="pyogrio", VERSION="1.3")
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": before})


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description="Write the sample of the town junction.")
    parser.add_argument("-o", "--output", type=Path, default=SAMPLE, help="folder (resources/sample)")
    make_sample(parser.parse_args(arguments).output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
