"""A place of the stored map drawn anew from all that is known of it; the rest of the map stays as it is.

What lies inside the place comes from one merge of all local maps that looked there, what lies outside is what it was
(`stitching`). So the map is a function of what was seen, place by place: local maps fed one by one draw the same map as
all of them at once, and what an update costs depends on the place alone.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from polymerge_core.consensus.alongside import REACH
from polymerge_core.consensus.run import UNSUPPORTED
from polymerge_core.curves import Array, Index
from polymerge_core.merge import merge
from polymerge_core.observations import as_lines
from polymerge_core.schema import NO_ELEMENT
from polymerge_core.store import geopackage
from polymerge_core.store.beliefs import SURE_OF, Renewal, judge_elements
from polymerge_core.store.evidence import Context, Pieces, drives_in_order, read_context, still_valid
from polymerge_core.store.stitching import Chain, Piece, cut_at, put_together, shares
from polymerge_core.store.tables import ELEMENT, Settings

#: Why a piece of an observation is in no element.
RENEWED = "the road changed since"

#: Why all of an observation is in no element: its local map is one of too many.
UNHEARD = "enough other local maps looked there"

#: From so many drives on the last two may be too few to be heard at once.
_MANY = 4

#: What lies less far from where it was has not moved, proximities.
_AS_IT_WAS = 0.25

#: The place is looked over so often for changes: what one hides may show then.
_RENEWALS = 2

#: What cutting at the edge of a place leaves of a line, with nothing to join, is no line up to this long, proximities.
_REST = 3.0


@dataclass
class Counts:
    """What an update did to elements."""

    added: int = 0
    changed: int = 0
    moved: int = 0
    retired: int = 0
    merged: int = 0


class Merged(NamedTuple):
    """What a merge of the place gives, in the terms of the file."""

    elements: gpd.GeoDataFrame
    #: `row` of the element, `piece`, `observation_fid`, and from where to where along the observation.
    lineage: pd.DataFrame
    left_out: pd.DataFrame
    pieces: Pieces


class Shape(NamedTuple):
    """An element as it comes out, before it has an id."""

    cls: str
    line: BaseGeometry
    #: Rows of the merged elements in it, those of stored ones, and how long their pieces are.
    new: Index
    new_m: Array
    old: Index
    old_m: Array


@dataclass
class Redraw:
    """One place being drawn anew.

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
    """

    connection: sqlite3.Connection
    settings: Settings
    place: BaseGeometry
    revision: int
    counts: Counts = field(default_factory=Counts)
    #: Where the road is found to have changed.
    renewals: list[Renewal] = field(default_factory=list)

    def run(self) -> Counts:
        """Draw the place anew, and write what changed."""
        shapely.prepare(self.place)
        stored = self._stored()
        area = self._is_area(stored)
        whole = shapely.box(*shapely.bounds(stored.geometry.to_numpy()[area]).T) if area.any() else np.empty(0, object)
        context_place = shapely.union_all([self.place, *whole])
        context = read_context(self.connection, self.settings, context_place)
        merged = self._merge(context)
        rounds = 0
        while self._judge(context, merged) and rounds < _RENEWALS:
            rounds += 1
            context = read_context(self.connection, self.settings, context_place)
            merged = self._merge(context)
        before = self._lineage(context)
        shapes = self._shapes(merged.elements, stored)
        votes = _votes(merged, context, before)
        ids, gone = self._ids(shapes, stored, votes)
        self._attribute(context, merged, stored, shapes, ids, votes, gone)
        self._split(shapes, ids, stored)
        drawn = self._drawn(shapes, ids, merged.elements, stored)
        # What is seen beyond the place may have gone over to what is drawn inside of it, or come from there.
        others = np.setdiff1d(before["element_id"], [*ids, *stored.index])
        beyond = read_elements(self.connection, self.settings, others)
        now, was = pd.concat([drawn, beyond]), pd.concat([stored, beyond])
        self._count(now)
        lost = now.index[now["n_observations"] == 0]
        gone |= {int(own): NO_ELEMENT for own in lost if own in was.index}
        self._write(now.drop(lost), was, gone)
        self._list_unheard()
        return self.counts

    def _list_unheard(self) -> None:
        """List what is new and was not heard, because enough others looked there."""
        self.connection.execute(
            "INSERT INTO left_out (source, source_fid, drive, instance, from_m, to_m, reason, observation_fid) "
            "SELECT o.source, o.source_fid, i.drive, i.instance, o.from_m, o.to_m, ?, o.fid FROM instances i JOIN "
            "observations o ON o.instance_fid = i.fid WHERE i.drawn IS NULL AND o.fid NOT IN (SELECT observation_fid "
            "FROM lineage WHERE observation_fid = o.fid) AND o.fid NOT IN (SELECT observation_fid FROM left_out WHERE "
            "observation_fid = o.fid) ORDER BY o.fid",
            (UNHEARD,),
        )

    def _stored(self) -> gpd.GeoDataFrame:
        """Return the elements that meet the place, by their id."""
        near = geopackage.ids_near(self.connection, "elements", shapely.bounds(self.place))
        found = read_elements(self.connection, self.settings, near)
        return found[shapely.intersects(self.place, found.geometry.to_numpy())]

    def _is_area(self, elements: gpd.GeoDataFrame) -> NDArray[np.bool_]:
        polygon = shapely.get_type_id(elements.geometry.to_numpy()) == shapely.GeometryType.POLYGON
        return np.asarray(polygon | elements["class"].isin(self.settings.area).to_numpy())

    def _merge(self, context: Context) -> Merged:
        """Merge all that still says something of the place."""
        settings = self.settings
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

    def _judge(self, context: Context, merged: Merged) -> bool:
        """Say how sure elements are, and set aside what was known before where the road changed; tell if it did."""
        seen = merged.pieces.local_maps.observations
        whose = context.observations["instance_fid"].reindex(merged.pieces.observation)
        observations = seen.assign(instance=context.instances.index.get_indexer(whose))
        instances = context.instances.assign(geometry=merged.pieces.footprints)
        lineage = merged.lineage[["row", "piece"]].rename(columns={"row": "element", "piece": "observation"})
        elements = merged.elements[["class", "geometry"]]
        if not self.renewals:
            newest, theirs = self._newest(context, merged)
            lineage = pd.concat([lineage, theirs.assign(element=theirs["element"] + len(elements))], ignore_index=True)
            elements = pd.concat([elements, newest], ignore_index=True)
        judged = judge_elements(
            elements,
            self._is_area(elements),
            lineage,
            observations,
            instances,
            self.place,
            self.settings.proximity,
        )
        merged.elements["evidence"] = judged.evidence[: len(merged.elements)]
        self.renewals += judged.renewals
        if not judged.renewals:
            return False
        first = context.instances.iloc[[renewal.since for renewal in judged.renewals]]
        shapes = np.array([renewal.zone for renewal in judged.renewals], dtype=object)
        geopackage.insert(
            self.connection,
            "renewed",
            {
                "geom": geopackage.to_blobs(shapes, self.settings.srs_id),
                "class": [renewal.cls for renewal in judged.renewals],
                "kind": [renewal.kind for renewal in judged.renewals],
                "since_ns": [None if pd.isna(time) else int(time) for time in first["timestamp_ns"]],
                "since_revision": first["revision"],
                "revision": [self.revision] * len(shapes),
            },
        )
        geopackage.touched(self.connection, "renewed", shapes)
        return True

    def _newest(self, context: Context, merged: Merged) -> tuple[gpd.GeoDataFrame, pd.DataFrame]:
        """Return what the last two drives see and nobody saw before them, who are too many to be outvoted by two.

        Returns
        -------
        elements : GeoDataFrame
            `class`, and the shape.
        lineage : DataFrame
            `element` (row), `observation` (row of the pieces).
        """
        drive, first = drives_in_order(context.instances)
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
        result = merge(theirs, proximity=self.settings.proximity, area=self.settings.area)
        new = np.ones(len(result.elements), dtype=bool)
        for cls, own in result.elements.groupby("class"):
            known = merged.elements.geometry[merged.elements["class"] == cls].to_numpy()
            middle = shapely.line_interpolate_point(as_lines(own.geometry.to_numpy()), 0.5, normalized=True)
            if len(known):
                far = shapely.distance(shapely.union_all(as_lines(known)), middle)
                new[own.index] = far > REACH * self.settings.proximity
        number = np.cumsum(new) - 1
        row = np.searchsorted(result.elements["element_id"], result.lineage["element_id"])
        lineage = pd.DataFrame({"element": number[row], "observation": rows[result.lineage["source_fid"]]})[new[row]]
        return result.elements.loc[new, ["class", "geometry"]], lineage

    def _lineage(self, context: Context) -> pd.DataFrame:
        """Return which intervals of the observations of the context are in which element."""
        with geopackage.chosen(self.connection, context.observations.index.to_numpy()) as these:
            rows = self.connection.execute(
                "SELECT observation_fid, element_id, from_m, to_m FROM lineage "
                f"WHERE observation_fid IN {these} ORDER BY fid"
            ).fetchall()
        return pd.DataFrame(rows, columns=["observation_fid", "element_id", "from_m", "to_m"])

    def _shapes(self, merged: gpd.GeoDataFrame, stored: gpd.GeoDataFrame) -> list[Shape]:
        """Put what is new inside the place together with what was there outside of it."""
        unit = self.settings.proximity
        new, old = merged.geometry.to_numpy(), stored.geometry.to_numpy()
        area, was_area = self._is_area(merged), self._is_area(stored)
        lines, was_lines = np.flatnonzero(~area), np.flatnonzero(~was_area)
        pieces = _renumbered(cut_at(new[lines], self.place, inside=True, new=True), lines)
        left = _renumbered(cut_at(old[was_lines], self.place, inside=False, new=False), was_lines)
        pieces += left
        pieces += [
            Piece(new[row], int(row), new=True, cut=(False, False))
            for row in np.flatnonzero(area & shapely.intersects(self.place, new))
        ]
        name = [str((merged if piece.new else stored)["class"].iloc[piece.of]) for piece in pieces]
        found = []
        for cls in sorted(set(name)):
            own = [piece for piece, its in zip(pieces, name, strict=True) if its == cls]
            chains = put_together(own, unit)
            found += [_shape(cls, chain) for chain in chains if chain.line.length > _REST * unit or not _is_rest(chain)]
        return found

    def _ids(
        self, shapes: list[Shape], stored: gpd.GeoDataFrame, votes: pd.DataFrame
    ) -> tuple[NDArray[np.int64], dict[int, int]]:
        """Return the id of each shape, and what became of the ids that are no more.

        An id goes where most of its element went; of several in one shape the smallest stays.
        """
        old, new = _by_piece(shapes, "old"), _by_piece(shapes, "new")
        old["element_id"] = stored.index.to_numpy()[old["row"]]
        own = votes[votes["element_id"].isin(stored.index)]
        share = own["length"] / own.groupby("row")["length"].transform("sum")
        new = new.merge(own.assign(share=share).drop(columns="length"), on="row")
        new["length"] *= new["share"]
        drawn = pd.concat([old, new], ignore_index=True)
        kept = drawn.groupby(["element_id", "shape"])["length"].sum().round(6).reset_index()
        kept = kept.sort_values(["length", "shape"], ascending=[False, True], kind="stable").drop_duplicates(
            "element_id"
        )
        kept = pd.concat([kept, _beside(shapes, kept, stored, REACH * self.settings.proximity)], ignore_index=True)
        ids = np.full(len(shapes), NO_ELEMENT, dtype=np.int64)
        smallest = kept.groupby("shape")["element_id"].min()
        ids[smallest.index.to_numpy(dtype=np.intp)] = smallest.to_numpy()
        fresh = np.flatnonzero(ids == NO_ELEMENT)
        key = [(shapes[row].cls, shapely.to_wkb(shapely.normalize(shapes[row].line))) for row in fresh]
        order = fresh[sorted(range(len(fresh)), key=key.__getitem__)]
        ids[order] = geopackage.next_id(self.connection, "elements") + np.arange(len(order))
        into = dict(zip(kept["element_id"].tolist(), ids[kept["shape"].to_numpy(dtype=np.intp)].tolist(), strict=True))
        gone = {int(old): into.get(int(old), NO_ELEMENT) for old in stored.index}
        return ids, {old: now for old, now in gone.items() if old != now}

    def _attribute(
        self,
        context: Context,
        merged: Merged,
        stored: gpd.GeoDataFrame,
        shapes: list[Shape],
        ids: NDArray[np.int64],
        votes: pd.DataFrame,
        gone: dict[int, int],
    ) -> None:
        """Write what the observations that meet the place went into."""
        held = context.observations
        drawn = _by_piece(shapes, "new").drop_duplicates(["row", "shape"])
        meets = shapely.intersects(self.place, held.geometry.to_numpy())
        theirs = merged.lineage.loc[merged.lineage["row"].isin(drawn["row"]), "observation_fid"]
        here = held.index[meets | held.index.isin(theirs)]
        lineage = merged.lineage[merged.lineage["observation_fid"].isin(here)]
        # A merged element that is not drawn here is that stored one which it has most in common with.
        best = votes.sort_values(["length", "element_id"], ascending=[False, True]).drop_duplicates("row")
        stands_for = best.set_index("row")["element_id"].replace(gone)
        row = lineage["row"].to_numpy()
        element = pd.Series(row).map(stands_for).fillna(NO_ELEMENT).to_numpy(dtype=np.int64, copy=True)
        left = _by_piece(shapes, "old")
        left["element_id"] = stored.index.to_numpy()[left["row"]]
        beside = votes.merge(left, on="element_id", suffixes=("", "_old"))[["row", "shape"]]
        places_of = pd.concat([drawn[["row", "shape"]], beside]).drop_duplicates()
        for number, several in places_of[places_of["row"].isin(drawn["row"])].groupby("row"):
            rows = np.flatnonzero(row == number)
            places = several["shape"].to_numpy()
            element[rows] = ids[_nearest(shapes, places, _middles(held, lineage.iloc[rows]))]
        lost = element == NO_ELEMENT
        left_out = merged.left_out[merged.left_out["observation_fid"].isin(here)]
        left_out = pd.concat([left_out, lineage[lost].assign(reason=UNSUPPORTED)], ignore_index=True)
        with geopackage.chosen(self.connection, here.to_numpy()) as these:
            for table in ("lineage", "left_out"):
                self.connection.execute(f"DELETE FROM {table} WHERE observation_fid IN {these}")
        kept = _intervals(context, lineage[~lost])
        geopackage.insert(
            self.connection, "lineage", kept | {"element_id": element[~lost], "weight": lineage["weight"][~lost]}
        )
        geopackage.insert(self.connection, "left_out", _intervals(context, left_out) | {"reason": left_out["reason"]})
        for old, now in sorted(gone.items()):
            if now == NO_ELEMENT:
                names = "source, source_fid, drive, instance, from_m, to_m"
                self.connection.execute(
                    f"INSERT INTO left_out ({names}, reason, observation_fid) SELECT {names}, ?, observation_fid "
                    "FROM lineage WHERE element_id = ? ORDER BY fid",
                    (UNSUPPORTED, old),
                )
                self.connection.execute("DELETE FROM lineage WHERE element_id = ?", (old,))
            else:
                self.connection.execute("UPDATE lineage SET element_id = ? WHERE element_id = ?", (now, old))

    def _split(self, shapes: list[Shape], ids: NDArray[np.int64], stored: gpd.GeoDataFrame) -> None:
        """Give what lies along the other parts of a stored element that is in several pieces now to these."""
        parts = _by_piece(shapes, "old").drop_duplicates(["row", "shape"])
        for row, several in parts.groupby("row"):
            places = several["shape"].to_numpy()
            own = int(stored.index[row])
            if (ids[places] == own).all():
                continue
            rows = self.connection.execute(
                "SELECT l.fid, o.geom FROM lineage l JOIN observations o ON o.fid = l.observation_fid "
                "WHERE l.element_id = ? ORDER BY l.fid",
                (own,),
            ).fetchall()
            if not rows:
                continue
            seen = geopackage.from_blobs([blob for _, blob in rows])
            mine = np.flatnonzero(ids == own)
            nearest = ids[_nearest(shapes, np.union1d(places, mine), _middle(seen))]
            self.connection.executemany(
                "UPDATE lineage SET element_id = ? WHERE fid = ?",
                [(int(now), fid) for now, (fid, _) in zip(nearest, rows, strict=True) if now != own],
            )

    def _drawn(
        self, shapes: list[Shape], ids: NDArray[np.int64], merged: gpd.GeoDataFrame, stored: gpd.GeoDataFrame
    ) -> gpd.GeoDataFrame:
        """Return the shapes as elements."""
        lines = np.array([shape.line for shape in shapes], dtype=object)
        table = pd.DataFrame(index=pd.Index(ids, name="element_id"), columns=list(ELEMENT))
        table["class"] = [shape.cls for shape in shapes]
        table["length_m"] = shapely.length(lines)
        for name in ("score", "sigma_m", "evidence"):
            table[name] = [_value(shape, merged[name], stored[name]) for shape in shapes]
        return gpd.GeoDataFrame(table, geometry=lines, crs=self.settings.crs)

    def _count(self, elements: gpd.GeoDataFrame) -> None:
        """Say of elements who saw them and when, in place."""
        with geopackage.chosen(self.connection, elements.index.to_numpy()) as these:
            rows = self.connection.execute(
                "SELECT l.element_id, COUNT(DISTINCT l.observation_fid), COUNT(DISTINCT o.instance_fid), "
                "MIN(i.timestamp_ns), MAX(i.timestamp_ns) FROM lineage l JOIN observations o ON o.fid = "
                "l.observation_fid JOIN instances i ON i.fid = o.instance_fid "
                f"WHERE l.element_id IN {these} GROUP BY l.element_id"
            ).fetchall()
        names = ["element_id", "n_observations", "n_instances", "first_seen", "last_seen"]
        counted = pd.DataFrame(rows, columns=names).set_index("element_id").reindex(elements.index)
        for name in ("n_observations", "n_instances"):
            elements[name] = counted[name].fillna(0).to_numpy(dtype=np.int64)
        for name in ("first_seen", "last_seen"):
            elements[name] = as_time(counted[name])
        elements["state"] = np.where(elements["evidence"].astype(float) >= SURE_OF, "confirmed", "tentative")

    def _write(self, now: gpd.GeoDataFrame, was: gpd.GeoDataFrame, gone: dict[int, int]) -> None:
        """Write the elements that changed, and what changed."""
        new = ~now.index.isin(was.index)
        changed = new | ~_same(now, was)
        # Not as one upsert: its conflict clause would overrule that of the triggers.
        for write, chosen in ((geopackage.insert, new), (geopackage.replace, changed & ~new)):
            held = now[chosen]
            blobs = geopackage.to_blobs(held.geometry.to_numpy(), self.settings.srs_id)
            attributes = {name: held[name] for name in ELEMENT}
            write(
                self.connection, "elements", {"fid": held.index, "element_id": held.index, "geom": blobs, **attributes}
            )
        written = now[changed]
        kind = np.where(new[changed], "added", "changed").astype(object)
        by = np.zeros(len(written))
        for row in np.flatnonzero(~new[changed]):
            by[row] = self._moved(written.iloc[row], was.geometry.loc[written.index[row]])
        kind[by > 0] = "moved"
        self._note(written, kind, by)
        lost = was.loc[sorted(gone)]
        self.connection.executemany("DELETE FROM elements WHERE element_id = ?", [(int(old),) for old in lost.index])
        ends = np.array([gone[int(old)] for old in lost.index], dtype=np.int64)
        self._note(lost, np.where(ends == NO_ELEMENT, "retired", "merged"), np.zeros(len(lost)))
        geopackage.insert(
            self.connection,
            "id_aliases",
            {"old_id": lost.index, "element_id": ends, "revision": [self.revision] * len(lost)},
        )
        self.connection.executemany(
            "UPDATE id_aliases SET element_id = ?1 WHERE element_id = ?2",
            [(int(end), int(old)) for old, end in zip(lost.index, ends, strict=True)],
        )
        for table in ("elements", "changes"):
            geopackage.touched(self.connection, table, written.geometry.to_numpy())
        counts = self.counts
        counts.added, counts.moved = int(new.sum()), int((kind == "moved").sum())
        counts.changed = int((changed & ~new).sum()) - counts.moved
        counts.retired, counts.merged = int((ends == NO_ELEMENT).sum()), int((ends != NO_ELEMENT).sum())

    def _moved(self, element: pd.Series[Any], was: BaseGeometry) -> float:
        """Return how far an element moved where the road is found to have changed, metres; 0 where it did not."""
        zones = [renewal.zone for renewal in self.renewals if renewal.cls == element["class"]]
        if not zones:
            return 0.0
        there = shapely.intersection(element.geometry, shapely.union_all(zones))
        by = 0.0 if there.is_empty else displacement(was, there)
        return by if by > _AS_IT_WAS * self.settings.proximity else 0.0

    def _note(self, elements: gpd.GeoDataFrame, kind: Iterable[str], moved_m: Array) -> None:
        """Put down what changed; nothing of it is ever changed again."""
        geopackage.insert(
            self.connection,
            "changes",
            {
                "geom": geopackage.to_blobs(elements.geometry.to_numpy(), self.settings.srs_id),
                "revision": [self.revision] * len(elements),
                "element_id": elements.index,
                "kind": list(kind),
                "moved_m": moved_m,
                **{name: elements[name] for name in ELEMENT},
            },
        )


def read_elements(connection: sqlite3.Connection, settings: Settings, ids: Index | None = None) -> gpd.GeoDataFrame:
    """Return elements of the map, all or those of some ids, by their id."""
    names = ", ".join(f'"{name}"' for name in ELEMENT)
    query = f"SELECT element_id, geom, {names} FROM elements"
    if ids is None:
        rows = connection.execute(f"{query} ORDER BY element_id").fetchall()
    else:
        with geopackage.chosen(connection, ids) as these:
            rows = connection.execute(f"{query} WHERE element_id IN {these} ORDER BY element_id").fetchall()
    return as_elements(rows, settings)


def as_elements(rows: list[tuple[object, ...]], settings: Settings) -> gpd.GeoDataFrame:
    """Return rows of id, geometry and attributes as elements, by their id."""
    held = [list(column) for column in zip(*rows, strict=True)] or [[] for _ in range(len(ELEMENT) + 2)]
    frame = pd.DataFrame(
        dict(zip(ELEMENT, held[2:], strict=True)), index=pd.Index(held[0], dtype="int64", name="element_id")
    )
    numbers = [name for name, kind in ELEMENT.items() if kind == "REAL"]
    frame = frame.astype(dict.fromkeys(numbers, np.float64))
    return gpd.GeoDataFrame(frame, geometry=geopackage.from_blobs(held[1]), crs=settings.crs)


def as_time(nanoseconds: pd.Series[float]) -> list[str | None]:
    """Return times as GeoPackage has them, None where there is none."""
    return [
        None
        if value is None or value != value  # noqa: PLR0124 - NaN
        else str(np.datetime64(int(value), "ns").astype("datetime64[ms]")) + "Z"
        for value in nanoseconds.astype(object)
    ]


def displacement(old: BaseGeometry, new: BaseGeometry) -> float:
    """Return the median distance from points along what is new to what was, metres."""
    old, new = (shape.boundary if shape.geom_type.endswith("Polygon") else shape for shape in (old, new))
    parts = shapely.get_parts(shapely.segmentize(new, max(new.length / 20, 1e-3)))
    return float(np.median(shapely.distance(old, shapely.points(shapely.get_coordinates(parts)))))


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


def _renumbered(pieces: list[Piece], rows: Index) -> list[Piece]:
    """Return pieces of some lines as pieces of all."""
    return [Piece(piece.line, int(rows[piece.of]), piece.new, piece.cut) for piece in pieces]


def _is_rest(chain: Chain) -> bool:
    """Whether a chain is what cutting left of a line, with nothing to join."""
    return len(chain.pieces) == 1 and any(chain.pieces[0].cut)


def _shape(cls: str, chain: Chain) -> Shape:
    of, new, length = shares(chain)
    return Shape(cls, chain.line, of[new], length[new], of[~new], length[~new])


def _by_piece(shapes: list[Shape], kind: str) -> pd.DataFrame:
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


def _votes(merged: Merged, context: Context, before: pd.DataFrame) -> pd.DataFrame:
    """Return how much each merged element (`row`) has in common with each stored one (`element_id`): `length`."""
    now = merged.lineage[["observation_fid", "row"]]
    own = context.observations["from_m"].reindex(now["observation_fid"]).to_numpy(dtype=float)
    now = now.assign(start=merged.lineage["from_m"] + own, stop=merged.lineage["to_m"] + own)
    both = now.merge(before, on="observation_fid")
    length = np.minimum(both["stop"], both["to_m"]) - np.maximum(both["start"], both["from_m"])
    both = both.assign(length=length.astype(np.float64))[(length > 0).to_numpy()]
    found = both.groupby(["row", "element_id"], as_index=False)["length"].sum()
    return found.astype({"row": np.intp, "element_id": np.int64})


def _nearest(shapes: list[Shape], rows: Index, points: NDArray[np.object_]) -> Index:
    """Return which of some shapes (rows) each point is nearest to."""
    far = [shapely.distance(shapes[row].line, points) for row in rows]
    return np.asarray(rows[np.argmin(np.round(far, 6), axis=0)])


def _middles(observations: gpd.GeoDataFrame, intervals: pd.DataFrame) -> NDArray[np.object_]:
    """Return the point in the middle of each interval of an observation."""
    lines = as_lines(observations.geometry.reindex(intervals["observation_fid"]).to_numpy())
    at = (intervals["from_m"] + intervals["to_m"]).to_numpy(dtype=float) / 2
    points: NDArray[np.object_] = shapely.line_interpolate_point(lines, at)
    return points


def _middle(shapes: NDArray[np.object_]) -> NDArray[np.object_]:
    points: NDArray[np.object_] = shapely.line_interpolate_point(as_lines(shapes), 0.5, normalized=True)
    return points


def _intervals(context: Context, intervals: pd.DataFrame) -> dict[str, Iterable[Any]]:
    """Return intervals of observations as intervals of the features that these came from."""
    fid = intervals["observation_fid"].to_numpy(dtype=np.int64)
    own = context.observations.loc[fid]
    whose = context.instances.loc[own["instance_fid"]]
    start = own["from_m"].to_numpy(dtype=float)
    return {
        "source": own["source"],
        "source_fid": own["source_fid"],
        "drive": whose["drive"],
        "instance": whose["instance"],
        "from_m": start + intervals["from_m"].to_numpy(dtype=float),
        "to_m": start + intervals["to_m"].to_numpy(dtype=float),
        "observation_fid": fid,
    }


def _value(shape: Shape, new: pd.Series[float], old: pd.Series[float]) -> float:
    """Return what is known of a shape: of the longest new piece in it, else of the longest old one."""
    rows, length, held = (shape.new, shape.new_m, new) if len(shape.new) else (shape.old, shape.old_m, old)
    return float(held.iloc[int(rows[np.argmax(length)])])


def _same(now: gpd.GeoDataFrame, was: gpd.GeoDataFrame) -> NDArray[np.bool_]:
    """Tell which elements are just as they were."""
    was = was.reindex(now.index)
    there = was["class"].notna().to_numpy()
    same = there.copy()
    same[there] = shapely.equals_identical(now.geometry.to_numpy()[there], was.geometry.to_numpy()[there])
    for name in ELEMENT:
        one, other = now[name].to_numpy(dtype=object), was[name].to_numpy(dtype=object)
        same &= (one == other) | (pd.isna(one) & pd.isna(other))
    return same
