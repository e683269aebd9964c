"""Is what QGIS wrote what the command line wrote? Columns, types, values, coordinates to the last bit, CRS."""

from __future__ import annotations

import warnings
from collections.abc import Collection
from pathlib import Path

import geopandas as gpd
import pandas as pd
import pyogrio
import shapely

from polymerge_core.__main__ import main

#: The parts of a merge by the names of the sinks in QGIS and of the layers in the command line's file.
PARTS = {
    "OUTPUT": "elements",
    "AREAS": "elements_areas",
    "LINEAGE": "lineage",
    "LEFT_OUT": "left_out",
    "ID_ALIASES": "id_aliases",
}


def command_line(*arguments: object) -> None:
    """Run the command line, which must do well."""
    assert main([*map(str, arguments), "--progress", "none"]) == 0


def table(file: Path | str, layer: str | None = None) -> pd.DataFrame:
    """Read a layer or table with a library that is not QGIS."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a layer without a CRS, or without features
        return pyogrio.read_dataframe(file, layer=layer)


def layer_names(file: Path) -> set[str]:
    """Names of the layers and tables in a file."""
    return set(pyogrio.list_layers(file)[:, 0])


def destinations(folder: Path) -> dict[str, str]:
    """A file for each part of a merge."""
    folder.mkdir(exist_ok=True)
    return {part: str(folder / f"{part.lower()}.gpkg") for part in PARTS}


def assert_same_merge(results: dict[str, str], expected: Path, but_for: Collection[str] = ()) -> None:
    """Compare all parts of a merge; a part that the command line did not write must be empty."""
    written = layer_names(expected)
    for part, layer in PARTS.items():
        if layer in written:
            assert_same(results[part], expected, layer, but_for)
        else:
            assert len(table(results[part])) == 0, part


def assert_same(file: Path | str, expected: Path, layer: str | None = None, but_for: Collection[str] = ()) -> None:
    """Compare a layer that QGIS wrote with one that the command line wrote, in the order of their features."""
    assert schema(file) == schema(expected, layer)
    found, wanted = table(file), table(expected, layer)
    columns = [name for name in wanted.columns if name not in {"geometry", *but_for}]
    pd.testing.assert_frame_equal(found[columns], wanted[columns], check_exact=True)
    assert isinstance(found, gpd.GeoDataFrame) == isinstance(wanted, gpd.GeoDataFrame)
    if isinstance(wanted, gpd.GeoDataFrame):
        assert found.crs == wanted.crs
        assert list(shapely.to_wkb(found.geometry)) == list(shapely.to_wkb(wanted.geometry))


def schema(file: Path | str, layer: str | None = None) -> dict[str, object]:
    """Columns with their types, and the kind of geometry."""
    info = pyogrio.read_info(file, layer=layer)
    columns = dict(zip(info["fields"], zip(info["ogr_types"], info["ogr_subtypes"], strict=True), strict=True))
    return {"columns": columns, "order": list(columns), "geometry": info["geometry_type"]}
