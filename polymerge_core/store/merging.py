"""All that was seen of a place, merged."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from polymerge_core.consensus.alongside import REACH
from polymerge_core.consensus.run import UNSUPPORTED
from polymerge_core.merge import merge
from polymerge_core.observations import as_lines
from polymerge_core.store.drive_order import order_drives
from polymerge_core.store.evidence import Context, Pieces, still_valid
from polymerge_core.store.tables import Settings

#: Why a piece of an observation is in no element.
RENEWED = "the road changed since"

#: From so many drives on the last two may be too few to be heard at once.
_MANY = 4


class Merged(NamedTuple):
    """What a merge of the place gives, in the terms of the file."""

    elements: gpd.GeoDataFrame
    #: `row` of the element, `piece`, `observation_fid`, and from where to where along the observation.
    lineage: pd.DataFrame
    left_out: pd.DataFrame
    pieces: Pieces


def merge_all(context: Context, settings: Settings) -> Merged:
    """Merge all that still says something of a place."""
    pieces = still_valid(context)
    result = merge(pieces.local_maps, proximity=settings.proximity, area=settings.area)
    tables = []
    for table in (result.lineage, result.left_out):
        row = table["source_fid"].to_numpy(dtype=np.intp)
        shift = pieces.offset[row]
        own = {"piece": row, "observation_fid": pieces.observation[row]}
        tables.append(table.assign(**own, from_m=table["from_m"] + shift, to_m=table["to_m"] + shift))
    lineage, left_out = tables
    lineage["row"] = np.searchsorted(result.elements["element_id"], lineage["element_id"])
    left_out = pd.concat([left_out, pieces.lost.assign(reason=RENEWED)], ignore_index=True)
    return Merged(result.elements, lineage, left_out, pieces)


def without(merged: Merged, chosen: NDArray[np.bool_]) -> Merged:
    """Leave elements out; what they were made of is in none."""
    if not chosen.any():
        return merged
    elements = merged.elements[~chosen].reset_index(drop=True)
    lost = chosen[merged.lineage["row"]]
    lineage = merged.lineage[~lost].assign(row=(np.cumsum(~chosen) - 1)[merged.lineage["row"][~lost]])
    left_out = pd.concat([merged.left_out, merged.lineage[lost].assign(reason=UNSUPPORTED)], ignore_index=True)
    return merged._replace(elements=elements, lineage=lineage, left_out=left_out)


def newest(context: Context, merged: Merged, settings: Settings) -> tuple[gpd.GeoDataFrame, pd.DataFrame]:
    """Return what the last two drives see and nobody saw before them, who are too many to be outvoted by two.

    Returns
    -------
    elements : GeoDataFrame
        `class`, and the shape.
    lineage : DataFrame
        `element` (row), `observation` (row of the pieces).
    """
    drive, first, _ = order_drives(context.instances, context.drives)
    maps = merged.pieces.local_maps
    nothing = (
        merged.elements[["class", "geometry"]].iloc[:0],
        pd.DataFrame({"element": [], "observation": []}, dtype=int),
    )
    if len(first) < _MANY or maps.instances is None:
        return nothing
    late = context.instances.index[drive >= len(first) - 2]
    unsupported = merged.left_out.loc[merged.left_out["reason"] == UNSUPPORTED, "observation_fid"]
    if not context.observations["instance_fid"].reindex(unsupported).isin(late).any():
        return nothing
    whose = context.observations["instance_fid"].reindex(merged.pieces.observation)
    rows = np.flatnonzero(whose.isin(late))
    theirs = replace(
        maps,
        observations=maps.observations.iloc[rows].reset_index(drop=True),
        instances=maps.instances[maps.instances.index.isin(late)],
    )
    result = merge(theirs, proximity=settings.proximity, area=settings.area)
    new = np.ones(len(result.elements), dtype=bool)
    for cls, own in result.elements.groupby("class"):
        known = merged.elements.geometry[merged.elements["class"] == cls].to_numpy()
        middle = shapely.line_interpolate_point(as_lines(own.geometry.to_numpy()), 0.5, normalized=True)
        if len(known):
            far = shapely.distance(shapely.union_all(as_lines(known)), middle)
            new[own.index] = far > REACH * settings.proximity
    number = np.cumsum(new) - 1
    row = np.searchsorted(result.elements["element_id"], result.lineage["element_id"])
    lineage = pd.DataFrame({"element": number[row], "observation": rows[result.lineage["source_fid"]]})[new[row]]
    return result.elements.loc[new, ["class", "geometry"]], lineage
