"""Small layers that a test can draw: metres from a corner of UTM zone 32, or plain ones."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import shapely
from shapely import LineString, Polygon

UTM = "EPSG:32632"
EAST, NORTH = 400_000.0, 6_000_000.0


def line(*points: tuple[float, float]) -> LineString:
    """A line through points in metres from the corner."""
    with np.errstate(invalid="ignore"):
        return LineString([(EAST + x, NORTH + y) for x, y in points])


def area(*points: tuple[float, float]) -> Polygon:
    """A polygon with corners in metres from the corner."""
    return Polygon([(EAST + x, NORTH + y) for x, y in points])


def noisy_copies(count: int, vertices: int, seed: int = 1) -> np.ndarray:
    """The same bent road, digitised again and again with errors of a few decimetres."""
    rng = np.random.default_rng(seed)
    x = np.linspace(0.0, 3.0 * vertices, vertices)
    return np.array(
        [
            shapely.linestrings(
                EAST + x + rng.uniform(-0.5, 0.5),
                NORTH + 10 * np.sin(x / 15) + rng.normal(0.0, 0.15, vertices),
            )
            for _ in range(count)
        ]
    )


def draw(path: Path, geometries: Any, *, crs: Any = UTM, layer: str | None = None, **columns: Any) -> Path:
    """Write a layer with an independent library, and return its path."""
    columns = columns or {"id": np.arange(len(geometries))}
    frame = gpd.GeoDataFrame(columns, geometry=list(geometries), crs=crs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # geopandas warns of what the tests are about: no CRS, no number
        if path.suffix == ".parquet":
            frame.to_parquet(path)
        else:
            frame.to_file(path, engine="pyogrio", layer=layer or path.stem, mode="a" if layer else "w")
    return path


def look(path: Path, layer: str | None = None) -> gpd.GeoDataFrame:
    """Read a layer or table with an independent library."""
    if path.suffix == ".parquet":
        return gpd.read_parquet(path)
    return gpd.read_file(path, layer=layer) if layer else gpd.read_file(path)


def coordinates(elements: gpd.GeoDataFrame) -> list[list[list[float]]]:
    """Vertices of each element."""
    return [shapely.get_coordinates(shape).tolist() for shape in elements.geometry]
