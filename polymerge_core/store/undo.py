"""Local maps taken out of a stored map again, as if it had never been told of them."""

from __future__ import annotations

import sqlite3
from typing import NamedTuple

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from polymerge_core.curves import Index
from polymerge_core.store import geopackage
from polymerge_core.store.evidence import place_of
from polymerge_core.store.tables import Settings


class TakenOut(NamedTuple):
    """What was taken out.

    Parameters
    ----------
    place : Polygon or MultiPolygon
        What may be another now, metres.
    elements : ndarray of int
        The elements that it was part of.
    """

    place: BaseGeometry
    elements: Index


def take_out(connection: sqlite3.Connection, settings: Settings, first: int, last: int) -> TakenOut:
    """Take out what came with some revisions, and where the road was found to have changed since then there."""
    these = "i.revision BETWEEN ? AND ?"
    place = place_of(connection, settings, these, (first, last))
    theirs = f"SELECT o.fid FROM observations o JOIN instances i ON i.fid = o.instance_fid WHERE {these}"
    part_of = f"SELECT DISTINCT element_id FROM lineage WHERE observation_fid IN ({theirs}) ORDER BY element_id"
    elements = np.array([row[0] for row in connection.execute(part_of, (first, last))], dtype=np.intp)
    for table in ("lineage", "left_out"):
        connection.execute(f"DELETE FROM {table} WHERE observation_fid IN ({theirs})", (first, last))
    # What could not be used was no observation.
    connection.execute(
        "DELETE FROM left_out WHERE observation_fid IS NULL AND (drive, instance) IN "
        f"(SELECT drive, instance FROM instances i WHERE {these})",
        (first, last),
    )
    connection.execute(f"DELETE FROM observations WHERE fid IN ({theirs})", (first, last))
    connection.execute(f"DELETE FROM instances AS i WHERE {these}", (first, last))
    # They are found again where the others say so.
    near = geopackage.ids_near(connection, "renewed", shapely.bounds(place)) if not place.is_empty else ()
    connection.executemany(
        "DELETE FROM renewed WHERE fid = ? AND revision >= ?", [(int(number), first) for number in near]
    )
    for table in ("instances", "observations", "renewed"):
        geopackage.touched(connection, table)
    return TakenOut(place, elements)
