"""A place of the stored map drawn anew from all that is known of it; the rest of the map stays as it is.

What lies inside the place comes from one merge of all local maps that looked there (`merging`), what lies outside is
what it was (`shapes`, `stitching`). So the map is a function of what was seen, place by place: local maps fed one by
one draw the same map as all of them at once, and what an update costs depends on the place alone.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from shapely.geometry.base import BaseGeometry

from polymerge_core.consensus.alongside import REACH
from polymerge_core.curves import Index
from polymerge_core.schema import NO_ELEMENT
from polymerge_core.store import geopackage
from polymerge_core.store.beliefs import DENIED, Renewal, judge_elements
from polymerge_core.store.drive_order import order_drives
from polymerge_core.store.element_table import Counts, count_looks, displacement, read_elements, write_elements
from polymerge_core.store.evidence import Context, read_context, with_renewed
from polymerge_core.store.identity import assign_ids, count_votes, gone_into_areas
from polymerge_core.store.lineage import attribute, list_unheard, read_lineage, share_out
from polymerge_core.store.merging import Merged, merge_all, newest, without
from polymerge_core.store.shapes import as_table, assemble, is_area
from polymerge_core.store.tables import Settings

#: What lies less far from where it was has not moved, proximities.
_AS_IT_WAS = 0.25

#: Lines up to so many proximities long are drawn anew as a whole.
_SHORT = 30.0

#: The place is looked over so often for changes: what one hides may show then. What is left is found next time.
_RENEWALS = 2


def redraw(
    connection: sqlite3.Connection,
    settings: Settings,
    place: BaseGeometry,
    revision: int,
    affected: Index,
) -> Counts:
    """Draw a place anew, and write what changed.

    Parameters
    ----------
    connection : sqlite3.Connection
        Within a transaction.
    settings : Settings
        Of the map.
    place : Polygon or MultiPolygon
        Metres, in the map's CRS.
    revision : int
        What is written becomes part of it.
    affected : ndarray of int
        Ids of elements that count other observations than before, wherever they lie.

    Returns
    -------
    Counts
        What became of elements.
    """
    place = _with_whole(_elements_at(connection, settings, place), place, settings)
    shapely.prepare(place)
    stored = _elements_at(connection, settings, place)
    areas = stored.geometry.to_numpy()[is_area(stored, settings)]
    whole = shapely.union_all([place, *(shapely.box(*shapely.bounds(areas).T) if len(areas) else ())])
    context = read_context(connection, settings, whole)
    merged, renewals = _merged(connection, settings, context, place, revision)
    before = read_lineage(connection, context)
    shapes = assemble(merged.elements, stored, place, settings)
    votes = count_votes(merged.lineage, context, before)
    reach, first = REACH * settings.proximity, geopackage.next_id(connection, "elements")
    ids, gone = assign_ids(shapes, stored, votes, reach, first)
    gone |= gone_into_areas(shapes, ids, stored[is_area(stored, settings)], gone)
    attribute(connection, place, context, merged, stored, shapes, ids, votes, gone)
    share_out(connection, shapes, ids, stored)
    drawn = as_table(shapes, ids, merged.elements, stored, settings)
    # What is seen beyond the place may have gone over to what is drawn inside of it, or come from there.
    others = np.setdiff1d([*before["element_id"], *affected], [*ids, *stored.index])
    beyond = read_elements(connection, settings, others)
    now, was = pd.concat([drawn, beyond]), pd.concat([stored, beyond])
    count_looks(connection, now)
    lost = now.index[now["n_observations"] == 0]
    gone |= {int(own): NO_ELEMENT for own in lost if own in was.index}
    moved = _how_far(renewals, _AS_IT_WAS * settings.proximity)
    counts = write_elements(connection, settings, revision, now.drop(lost), was, gone, moved)
    list_unheard(connection)
    return counts


def _with_whole(stored: gpd.GeoDataFrame, place: BaseGeometry, settings: Settings) -> BaseGeometry:
    """Return a place with all around the short lines that reach into it: a rest of one outside is nothing by itself."""
    lines = stored.geometry.to_numpy()[~is_area(stored, settings)]
    short = lines[shapely.length(lines) <= _SHORT * settings.proximity]
    around = shapely.buffer(short, REACH * settings.proximity, quad_segs=2)
    return shapely.union_all([place, *around[~shapely.contains(place, around)]])


def _elements_at(connection: sqlite3.Connection, settings: Settings, place: BaseGeometry) -> gpd.GeoDataFrame:
    """Return the elements that meet a place, by their id."""
    near = geopackage.ids_near(connection, "elements", shapely.bounds(place))
    found = read_elements(connection, settings, near)
    return found[shapely.intersects(place, found.geometry.to_numpy())]


def _merged(
    connection: sqlite3.Connection, settings: Settings, context: Context, place: BaseGeometry, revision: int
) -> tuple[Merged, list[Renewal]]:
    """Merge what is known of a place, without what was seen before the road changed; return where it changed, too."""
    merged = merge_all(context, settings)
    found: list[Renewal] = []
    for last in (*[False] * _RENEWALS, True):
        new = _judge(context, merged, place, settings, hidden=not found)
        if last or not new:
            break
        _note(connection, settings, context, new, revision)
        found += new
        context = with_renewed(connection, settings, context)
        merged = merge_all(context, settings)
    return without(merged, merged.elements["evidence"].to_numpy(dtype=float) < DENIED), found


def _judge(context: Context, merged: Merged, place: BaseGeometry, settings: Settings, *, hidden: bool) -> list[Renewal]:
    """Say how sure elements are, in place, and return where the road changed.

    With `hidden`, what only the last drives see is judged, too.
    """
    seen = merged.pieces.local_maps.observations
    whose = context.observations["instance_fid"].reindex(merged.pieces.observation)
    observations = seen.assign(instance=context.instances.index.get_indexer(whose))
    instances = context.instances.assign(geometry=merged.pieces.footprints)
    lineage = merged.lineage[["row", "piece"]].rename(columns={"row": "element", "piece": "observation"})
    elements = merged.elements[["class", "geometry"]]
    if hidden:
        late, theirs = newest(context, merged, settings)
        lineage = pd.concat([lineage, theirs.assign(element=theirs["element"] + len(elements))], ignore_index=True)
        elements = pd.concat([elements, late], ignore_index=True)
    area = is_area(elements, settings)
    order = order_drives(context.instances, context.drives)
    judged = judge_elements(elements, area, lineage, observations, instances, order, place, settings.proximity)
    merged.elements["evidence"] = judged.evidence[: len(merged.elements)]
    return judged.renewals


def _note(
    connection: sqlite3.Connection, settings: Settings, context: Context, renewals: list[Renewal], revision: int
) -> None:
    """Put down where the road changed: what was seen there before says nothing of it now."""
    first = context.instances.iloc[[renewal.since for renewal in renewals]]
    shapes = np.array([renewal.zone for renewal in renewals], dtype=object)
    columns = {
        "geom": geopackage.to_blobs(shapes, settings.srs_id),
        "class": [renewal.cls for renewal in renewals],
        "kind": [renewal.kind for renewal in renewals],
        "since_drive": first["drive"],
        "since_revision": first["revision"],
        "revision": [revision] * len(shapes),
    }
    geopackage.insert(connection, "renewed", columns)
    geopackage.touched(connection, "renewed", shapes)


def _how_far(renewals: list[Renewal], least: float) -> Callable[[str, BaseGeometry, BaseGeometry], float]:
    """Return what says how far an element moved where the road changed, metres; 0 where it did not."""

    def moved(cls: str, was: BaseGeometry, now: BaseGeometry) -> float:
        zones = [renewal.zone for renewal in renewals if renewal.cls == cls]
        there = shapely.intersection(now, shapely.union_all(zones))
        by = 0.0 if there.is_empty else displacement(was, there)
        return by if by > least else 0.0

    return moved
