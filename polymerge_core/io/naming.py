"""Which file each layer goes to."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path

import geopandas as gpd
import pandas as pd

from polymerge_core.errors import OutputError
from polymerge_core.io.drivers import FORMATS
from polymerge_core.schema import ELEMENTS_LAYER


def layer_targets(
    path: str | os.PathLike[str],
    layers: Mapping[str, gpd.GeoDataFrame | pd.DataFrame],
    *,
    tables_path: str | os.PathLike[str] | None = None,
) -> dict[str, Path]:
    """Say which file each layer goes to.

    Parameters
    ----------
    path, layers, tables_path
        As in `write_layers`.

    Returns
    -------
    dict of str to Path
        By layer name.

    Raises
    ------
    OutputError
        If the extension is none of `FORMATS`, or there is nothing to write to `path`.
    """
    target = Path(path)
    if target.suffix.lower() not in FORMATS:
        raise OutputError(f"{target}: the extension must be one of {', '.join(FORMATS)}")
    if tables_path is not None and Path(tables_path).suffix.lower() != ".gpkg":
        raise OutputError(f"{tables_path}: tables are written to a GeoPackage; name a file that ends in .gpkg")
    whole = FORMATS[target.suffix.lower()] == "GPKG"
    beside = Path(tables_path) if tables_path is not None else tables_beside(target)
    spatial = [name for name, frame in layers.items() if isinstance(frame, gpd.GeoDataFrame)]
    if not spatial and not (whole and layers):
        raise OutputError(f"{target}: there is no layer to write to it")
    main = ELEMENTS_LAYER if ELEMENTS_LAYER in spatial else next(iter(spatial), "")
    targets = {}
    for name in layers:
        _check_layer_name(name, target, whole=whole)
        if name not in spatial:
            targets[name] = target if whole and tables_path is None else beside
        elif whole or name == main:
            targets[name] = target
        else:
            targets[name] = companion_path(target, name, main)
    return targets


def holds_one_layer(path: Path) -> bool:
    """Whether a file's extension is that of a format of one layer a file."""
    return FORMATS.get(path.suffix.lower(), "GPKG") != "GPKG"


def companion_path(target: Path, layer: str, main: str) -> Path:
    """Return the file for a layer beside the file of the main layer, in a format of one layer a file."""
    return target.with_name(f"{target.stem}_{layer.removeprefix(main + '_')}{target.suffix}")


def tables_beside(target: Path) -> Path:
    """Return the GeoPackage for the tables beside a file of another format."""
    return target.with_name(f"{target.stem}_tables.gpkg")


def _check_layer_name(name: str, target: Path, *, whole: bool) -> None:
    if not name or re.match(r"gpkg|rtree|sqlite", name, re.IGNORECASE):
        raise OutputError(f"{target}: a layer cannot be called {name!r}; GeoPackage keeps that name for itself")
    if not name.isprintable() or not (whole or re.fullmatch(r"[^/\\:]+", name)):
        raise OutputError(f"{target}: a layer cannot be called {name!r}; use letters, digits and spaces")
