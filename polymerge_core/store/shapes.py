"""Elements as they come out of drawing a place anew: what is new inside, put together with what was there outside."""

from __future__ import annotations

from typing import NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from polymerge_core.curves import Array, Index
from polymerge_core.observations import as_lines
from polymerge_core.store.stitching import Chain, Piece, cut_at, put_together, shares
from polymerge_core.store.tables import ELEMENT, Settings

#: What cutting at the edge of a place leaves of a line, with nothing to join, is no line up to this long, proximities.
_REST = 3.0


class Shape(NamedTuple):
    """An element as it comes out, before it has an id."""

    cls: str
    line: BaseGeometry
    #: Rows of the merged elements in it, those of stored ones, and how long their pieces are.
    new: Index
    new_m: Array
    old: Index
    old_m: Array


def is_area(elements: gpd.GeoDataFrame, settings: Settings) -> NDArray[np.bool_]:
    """Tell which elements are areas, also where they are drawn as lines."""
    polygon = shapely.get_type_id(elements.geometry.to_numpy()) == shapely.GeometryType.POLYGON
    return np.asarray(polygon | elements["class"].isin(settings.area).to_numpy())


def assemble(
    merged: gpd.GeoDataFrame, stored: gpd.GeoDataFrame, place: BaseGeometry, settings: Settings
) -> list[Shape]:
    """Put what is new inside a place together with what was there outside of it.

    Parameters
    ----------
    merged, stored : GeoDataFrame
        Elements as merged, and those of the map that meet the place: `class` and the shape.
    place : Polygon or MultiPolygon
        Prepared.
    settings : Settings
        Of the map.
    """
    unit = settings.proximity
    new, old = merged.geometry.to_numpy(), stored.geometry.to_numpy()
    area, was_area = is_area(merged, settings), is_area(stored, settings)
    lines, was_lines = np.flatnonzero(~area), np.flatnonzero(~was_area)
    pieces = _renumbered(cut_at(new[lines], place, inside=True, new=True), lines)
    left = _renumbered(cut_at(old[was_lines], place, inside=False, new=False), was_lines)
    pieces += left
    pieces += [
        Piece(new[row], int(row), new=True, cut=(False, False))
        for row in np.flatnonzero(area & shapely.intersects(place, new))
    ]
    name = [str((merged if piece.new else stored)["class"].iloc[piece.of]) for piece in pieces]
    found = []
    for cls in sorted(set(name)):
        own = [piece for piece, its in zip(pieces, name, strict=True) if its == cls]
        chains = put_together(own, unit)
        found += [_shape(cls, chain) for chain in chains if chain.line.length > _REST * unit or not _is_rest(chain)]
    return found


def as_table(
    shapes: list[Shape],
    ids: NDArray[np.int64],
    merged: gpd.GeoDataFrame,
    stored: gpd.GeoDataFrame,
    settings: Settings,
) -> gpd.GeoDataFrame:
    """Return shapes as elements, by their ids."""
    lines = np.array([shape.line for shape in shapes], dtype=object)
    table = pd.DataFrame(index=pd.Index(ids, name="element_id"), columns=list(ELEMENT))
    table["class"] = [shape.cls for shape in shapes]
    table["length_m"] = shapely.length(lines)
    for name in ("score", "sigma_m", "evidence"):
        table[name] = [_value(shape, merged[name], stored[name]) for shape in shapes]
    return gpd.GeoDataFrame(table, geometry=lines, crs=settings.crs)


def by_piece(shapes: list[Shape], kind: str) -> pd.DataFrame:
    """Return `shape`, `row` and `length` of the pieces of all shapes."""
    sizes = [len(getattr(shape, kind)) for shape in shapes]
    rows = [getattr(shape, kind) for shape in shapes]
    length = [getattr(shape, f"{kind}_m") for shape in shapes]
    nothing = np.empty(0)
    return pd.DataFrame(
        {
            "shape": np.repeat(np.arange(len(shapes)), sizes),
            "row": np.concatenate([nothing.astype(np.intp), *rows]),
            "length": np.concatenate([nothing, *length]),
        }
    )


def nearest(shapes: list[Shape], rows: Index, points: NDArray[np.object_]) -> Index:
    """Return which of some shapes (rows) each point is nearest to."""
    far = [shapely.distance(shapes[row].line, points) for row in rows]
    return np.asarray(rows[np.argmin(np.round(far, 6), axis=0)])


def middles_of(observations: gpd.GeoDataFrame, intervals: pd.DataFrame) -> NDArray[np.object_]:
    """Return the point in the middle of each interval of an observation."""
    lines = as_lines(observations.geometry.reindex(intervals["observation_fid"]).to_numpy())
    at = (intervals["from_m"] + intervals["to_m"]).to_numpy(dtype=float) / 2
    points: NDArray[np.object_] = shapely.line_interpolate_point(lines, at)
    return points


def middle_of(shapes: NDArray[np.object_]) -> NDArray[np.object_]:
    """Return the point in the middle of each shape."""
    points: NDArray[np.object_] = shapely.line_interpolate_point(as_lines(shapes), 0.5, normalized=True)
    return points


def _renumbered(pieces: list[Piece], rows: Index) -> list[Piece]:
    """Return pieces of some lines as pieces of all."""
    return [Piece(piece.line, int(rows[piece.of]), piece.new, piece.cut) for piece in pieces]


def _is_rest(chain: Chain) -> bool:
    """Whether a chain is what cutting left of a line, with nothing to join."""
    return len(chain.pieces) == 1 and any(chain.pieces[0].cut)


def _shape(cls: str, chain: Chain) -> Shape:
    of, new, length = shares(chain)
    return Shape(cls, chain.line, of[new], length[new], of[~new], length[~new])


def _value(shape: Shape, new: pd.Series[float], old: pd.Series[float]) -> float:
    """Return what is known of a shape: of the longest new piece in it, else of the longest old one."""
    rows, length, held = (shape.new, shape.new_m, new) if len(shape.new) else (shape.old, shape.old_m, old)
    return float(held.iloc[int(rows[np.argmax(length)])])
