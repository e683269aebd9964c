"""The native tools of QGIS, chained as a user would in the toolbox or a model, through qgis_process.

Lines: *Snap geometries to layer* (to themselves, within the proximity), *Dissolve*, *Merge lines*, *Multipart to
singleparts*. Areas: *Dissolve*, *Multipart to singleparts*. Every tool starts QGIS anew, which is part of its time.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from functools import partial
from pathlib import Path

import geopandas as gpd
import numpy as np
import shapely

from benchmarks.rivals.layers import PROXIMITY_M, NotInstalledError, RivalError, Shapes, draw_by_class

#: Debian's own qgis_process is a broken wrapper round the first.
_PROGRAMS = ("/usr/bin/qgis_process.bin", "qgis_process")
_LINES: tuple[tuple[str, ...], ...] = (
    ("snapgeometries", "--REFERENCE_LAYER={input}", f"--TOLERANCE={PROXIMITY_M}", "--BEHAVIOR=0"),
    ("dissolve",),
    ("mergelines",),
    ("multiparttosingleparts",),
)
_AREAS = (("dissolve",), ("multiparttosingleparts",))
_LONGEST_S = 300


def qgis_chain(observations: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Snap, dissolve and merge lines; dissolve areas."""
    program = next((found for name in _PROGRAMS if (found := shutil.which(name))), None)
    if program is None:
        raise NotInstalledError("not installed: https://qgis.org, or apt install qgis (with qgis_process)")
    with tempfile.TemporaryDirectory() as name:
        run = partial(_chain, program, Path(name))
        return draw_by_class(
            observations,
            lambda group: run(_LINES, group.geometry),
            lambda group: run(_AREAS, group.geometry.map(shapely.build_area)),
        )


def _chain(program: str, folder: Path, tools: tuple[tuple[str, ...], ...], shapes: gpd.GeoSeries) -> Shapes:
    layer = folder / "input.gpkg"
    # QGIS 3.22 does not know the newer version that is the default.
    shapes.reset_index(drop=True).to_frame("geometry").to_file(layer, VERSION="1.3")
    for number, (tool, *options) in enumerate(tools):
        output = folder / f"{number}_{tool}.gpkg"
        output.unlink(missing_ok=True)
        given = [option.format(input=layer) for option in options]
        _run([program, "run", f"native:{tool}", f"--INPUT={layer}", *given, f"--OUTPUT={output}"], folder)
        layer = output
    parts = shapely.get_parts(gpd.read_file(layer).geometry.to_numpy())
    return np.asarray(parts[shapely.length(parts) > 0])


def _run(command: list[str], home: Path) -> None:
    # Nothing of the user's QGIS or Python may change what the tools do.
    clean = {"PATH": os.defpath, "HOME": str(home), "XDG_RUNTIME_DIR": str(home), "QT_QPA_PLATFORM": "offscreen"}
    try:
        subprocess.run(command, env=clean, check=True, capture_output=True, text=True, timeout=_LONGEST_S)
    except subprocess.SubprocessError as error:
        said = str(getattr(error, "stderr", None) or error).strip().splitlines()[-1]
        raise RivalError(f"{command[2]} failed: {said}") from error
