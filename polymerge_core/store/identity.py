"""Which element is which: ids go from the elements of the map to the shapes that are drawn in their place."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from polymerge_core.schema import NO_ELEMENT
from polymerge_core.store.element_table import displacement
from polymerge_core.store.evidence import Context, as_area
from polymerge_core.store.shapes import Shape, by_piece


def count_votes(lineage: pd.DataFrame, context: Context, before: pd.DataFrame) -> pd.DataFrame:
    """Return how much each merged element (`row`) has in common with each stored one (`element_id`): `length`."""
    now = lineage[["observation_fid", "row"]]
    own = context.observations["from_m"].reindex(now["observation_fid"]).to_numpy(dtype=float)
    now = now.assign(start=lineage["from_m"] + own, stop=lineage["to_m"] + own)
    both = now.merge(before, on="observation_fid")
    length = np.minimum(both["stop"], both["to_m"]) - np.maximum(both["start"], both["from_m"])
    both = both.assign(length=length.astype(np.float64))[(length > 0).to_numpy()]
    found = both.groupby(["row", "element_id"], as_index=False)["length"].sum()
    return found.astype({"row": np.intp, "element_id": np.int64})


def assign_ids(
    shapes: list[Shape], stored: gpd.GeoDataFrame, votes: pd.DataFrame, reach: float, first: int
) -> tuple[NDArray[np.int64], dict[int, int]]:
    """Return the id of each shape, and what became of the ids that are no more.

    An id goes where most of its element went; of several in one shape the smallest stays.

    Parameters
    ----------
    shapes : list of Shape
        As they come out.
    stored : GeoDataFrame
        The elements of the map that met the place, by their id.
    votes : DataFrame
        From `count_votes`.
    reach : float
        How far aside a line is still the same line painted elsewhere, metres.
    first : int
        The first id that is free.
    """
    old, new = by_piece(shapes, "old"), by_piece(shapes, "new")
    old["element_id"] = stored.index.to_numpy()[old["row"]]
    own = votes[votes["element_id"].isin(stored.index)]
    share = own["length"] / own.groupby("row")["length"].transform("sum")
    new = new.merge(own.assign(share=share).drop(columns="length"), on="row")
    new["length"] *= new["share"]
    drawn = pd.concat([old, new], ignore_index=True)
    kept = drawn.groupby(["element_id", "shape"])["length"].sum().round(6).reset_index()
    kept = kept.sort_values(["length", "shape"], ascending=[False, True], kind="stable").drop_duplicates("element_id")
    kept = pd.concat([kept, _beside(shapes, kept, stored, reach)], ignore_index=True)
    ids = np.full(len(shapes), NO_ELEMENT, dtype=np.int64)
    smallest = kept.groupby("shape")["element_id"].min()
    ids[smallest.index.to_numpy(dtype=np.intp)] = smallest.to_numpy()
    fresh = np.flatnonzero(ids == NO_ELEMENT)
    key = [(shapes[row].cls, shapely.to_wkb(shapely.normalize(shapes[row].line))) for row in fresh]
    order = fresh[sorted(range(len(fresh)), key=key.__getitem__)]
    ids[order] = first + np.arange(len(order))
    into = dict(zip(kept["element_id"].tolist(), ids[kept["shape"].to_numpy(dtype=np.intp)].tolist(), strict=True))
    gone = {int(old): into.get(int(old), NO_ELEMENT) for old in stored.index}
    return ids, {old: now for old, now in gone.items() if old != now}


def gone_into_areas(
    shapes: list[Shape], ids: NDArray[np.int64], areas: gpd.GeoDataFrame, gone: dict[int, int]
) -> dict[int, int]:
    """Return areas that are no more, and that area in which most of each lies: there cannot be two at one place.

    Parameters
    ----------
    shapes : list of Shape
        As they come out.
    ids : ndarray of int
        Their ids.
    areas : GeoDataFrame
        The elements of the map that met the place and are areas, by their id.
    gone : dict of int to int
        From `assign_ids`.
    """
    found = {}
    for own in areas.index[[gone.get(int(old)) == NO_ELEMENT for old in areas.index]]:
        cls, polygon = areas.loc[own, "class"], as_area(areas.geometry[own])
        common = {
            int(ids[row]): float(shapely.area(shapely.intersection(polygon, as_area(shape.line))))
            for row, shape in enumerate(shapes)
            if shape.cls == cls and shapely.intersects(polygon, shape.line)
        }
        most = min(common, key=lambda other: (-round(common[other], 6), other), default=None)
        if most is not None and common[most] > shapely.area(polygon) / 2:
            found[int(own)] = most
    return found


def _beside(shapes: list[Shape], kept: pd.DataFrame, stored: gpd.GeoDataFrame, reach: float) -> pd.DataFrame:
    """Return stored elements that nothing was drawn of, and the new shape of their class that lies beside each.

    A line that was painted elsewhere is the same line elsewhere.
    """
    taken = set(kept["shape"])
    found = []
    for own in stored.index.difference(kept["element_id"]):
        element = stored.loc[own]
        apart = {
            row: displacement(element.geometry, shape.line)
            for row, shape in enumerate(shapes)
            if row not in taken and shape.cls == element["class"]
        }
        nearest = min(apart, key=lambda row: (round(apart[row], 6), row), default=None)
        if nearest is not None and apart[nearest] <= reach:
            taken.add(nearest)
            found.append((int(own), nearest, 0.0))
    return pd.DataFrame(found, columns=["element_id", "shape", "length"]).astype({"element_id": int, "shape": int})
