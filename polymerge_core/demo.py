"""The demonstration: the sample's predictions and poses become local maps, a merged map and a picture."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import pandas as pd

from polymerge_core.errors import OutputError
from polymerge_core.figures import before_after
from polymerge_core.formats import read_poses, read_predictions
from polymerge_core.frames import project
from polymerge_core.io import read_layers, stage_layers
from polymerge_core.merge import merge
from polymerge_core.options import METHODS
from polymerge_core.outputs import StagedOutputs

#: The sample lies in the open North Sea, in this CRS.
CRS = "EPSG:32632"

#: A spot of the sample where the methods differ, metres in `CRS`.
ZOOM = (399975.0, 6039990.0, 400000.0, 6040005.0)


_TITLES = {"consensus": "consensus", "polymerge": "the published method"}


def sample_folder() -> Path:
    """Return the folder of the sample: beside the package in a checkout, in it when installed."""
    package = Path(str(files("polymerge_core")))
    installed = package / "sample"
    return installed if installed.is_dir() else package.parent / "resources" / "sample"


def run_demo(folder: Path, *, method: str = METHODS[0], overwrite: bool = False) -> str:
    """Project and merge the sample, draw before and after.

    Parameters
    ----------
    folder : Path
        Where `local_maps.gpkg`, `merged.gpkg` and `before_after.png` go; made if it is not there.
    method : {"consensus", "polymerge"}, default "consensus"
        As in `polymerge_core.merge`.
    overwrite : bool, default False
        Whether outputs of an earlier run are replaced.

    Returns
    -------
    str
        A table of what was done.

    Raises
    ------
    OutputError
        If an output exists already, or cannot be written.
    """
    sample = sample_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder} cannot be made: {error.strerror}; name another folder") from error
    targets = [folder / name for name in ("local_maps.gpkg", "merged.gpkg", "before_after.png")]
    with StagedOutputs(overwrite=overwrite) as outputs:
        outputs.check(targets)
        local = project(read_predictions(sample / "predictions.json"), read_poses(sample / "poses.csv"), crs=CRS)
        result = merge(local, method=method)
        reference = read_layers(sample / "reference.gpkg")["ground_truth"]
        stage_layers(outputs, targets[0], local.layers())
        stage_layers(outputs, targets[1], result.layers())
        picture = outputs.stage(targets[2])
        title = f"A town junction seen {result.report['instances']} times, merged by {_TITLES[method]}"
        before_after(local.observations, result.elements, picture, reference=reference, title=title, zoom=ZOOM)
    summary = pd.DataFrame(result.report["classes"]).T.rename_axis("class")
    summary = summary.astype({"observations": int, "elements": int}).round(1)
    lines = [summary.to_string(), "", *(f"wrote {target}" for target in targets)]
    return "\n".join(lines)
