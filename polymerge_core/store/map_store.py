"""The stored map: one file, fed local maps for months, that can tell and undo every change."""

from __future__ import annotations

import contextlib
import datetime as dt
import os
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import pyproj
import shapely

from polymerge_core.crs import is_local, is_metric, parse_crs
from polymerge_core.errors import CrsError, InputError, OptionError
from polymerge_core.options import Options
from polymerge_core.sets import Input, as_local_maps
from polymerge_core.store import geopackage
from polymerge_core.store.element_table import Counts, read_elements
from polymerge_core.store.evidence import Evidence, add, place_of, read_evidence, without_known
from polymerge_core.store.geopackage import Connection, is_empty
from polymerge_core.store.map_file import PATIENCE_S, MapFile
from polymerge_core.store.past import arrows, changes_since, elements_at
from polymerge_core.store.redraw import redraw
from polymerge_core.store.tables import Settings, create_map, read_settings, software
from polymerge_core.store.undo import TakenOut, take_out
from polymerge_core.store.verify import faults


@dataclass(frozen=True)
class Update:
    """What an update did.

    Attributes
    ----------
    revision : int
        The revision that the map is at now.
    instances, observations : int
        Local maps and observations that are new.
    skipped : int
        Local maps that the map knew already.
    added, changed, moved, retired, merged : int
        Elements.
    elements : int
        Elements of the map now.
    left_out : dict of str to int
        Features that cannot be used, by reason.
    warnings : list of str
        What there is to say.
    """

    revision: int
    instances: int
    observations: int
    skipped: int
    added: int
    changed: int
    moved: int
    retired: int
    merged: int
    elements: int
    left_out: dict[str, int]
    warnings: list[str]

    def report(self) -> dict[str, Any]:
        """Return it ready for JSON."""
        return vars(self).copy()

    @classmethod
    def of(cls, revision: int, counts: Counts, elements: int, skipped: int, evidence: Evidence | None) -> Update:
        """Return what an update did, in numbers."""
        left_out, warnings, instances, observations = {}, [], 0, 0
        if evidence is not None:
            instances, observations = len(evidence.instances), len(evidence.observations)
            reasons = evidence.left_out["reason"].value_counts(sort=False)
            left_out = {str(reason): int(count) for reason, count in reasons.items()}
            warnings = list(evidence.warnings)
        if skipped:
            what = "1 local map was" if skipped == 1 else f"{skipped} local maps were"
            warnings.append(f"{what} skipped: the map knows drive and instance already")
        done = vars(counts) | {"elements": elements, "left_out": left_out, "warnings": warnings}
        return cls(revision, instances, observations, skipped, **done)


_NO_CHANGE = Counts()
_NOTHING = TakenOut(shapely.Polygon(), np.empty(0, np.intp))


class MapStore:
    """A map in a GeoPackage, kept up to date.

    QGIS, GDAL and geopandas open the file as it is: the layer `elements` is the map, beside it lie `changes` (all that
    ever changed), `instances` and `observations` (what the map was made from), and the tables `lineage`, `left_out`,
    `id_aliases` and `revisions`.

    Parameters
    ----------
    path : path
        The file.
    create : bool, default False
        Whether to make it where there is none, with the first update.
    crs : any, optional
        CRS of a map that is made: projected, in metres. By default that in which the first local maps are merged.
    proximity : float, optional
        Of a map that is made, as in `polymerge_core.merge`; 1 m by default.
    area : str or sequence of str, optional
        Of a map that is made, as in `polymerge_core.merge`.
    patience_s : float, default 10
        Seconds to wait for another program that has the file locked.

    Raises
    ------
    InputError
        If there is no such file and none is to be made, or it is no stored map, or one of a later version.
    OptionError, CrsError
        If an option has a value that it cannot have, or is another one than the map was made with.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        create: bool = False,
        crs: Any = None,
        proximity: float | None = None,
        area: str | Sequence[str] = (),
        patience_s: float = PATIENCE_S,
    ) -> None:
        self.path = Path(path)
        self._crs = None if crs is None else parse_crs(crs)
        self._proximity, self._area = proximity, area
        self._file = MapFile(self.path, create=create, patience_s=patience_s)
        if self._crs is not None and not is_local(self._crs) and not is_metric(self._crs):
            raise CrsError(f"a map is kept in metres, and {self._crs.name} is not; choose a projected CRS in metres")
        Options.of(area=area, **({} if proximity is None else {"proximity": proximity}))
        if self.path.is_dir():
            raise InputError(f"{self.path} is a folder; name the file of the map")
        if self._file.is_there():
            with self._opened() as (_, settings):
                self._agree(settings)

    def _agree(self, settings: Settings) -> None:
        """Raise an error where the map was made with other options."""
        if self._crs is not None and self._crs != settings.crs:
            raise OptionError(f"{self.path} is in {settings.crs.name}; leave crs away, or make another map")
        if self._proximity is not None and self._proximity != settings.proximity:
            raise OptionError(
                f"{self.path} was made with a proximity of {settings.proximity:g} m; leave proximity away, or make "
                "another map"
            )
        if self._area and Options.of(area=self._area).area != set(settings.area):
            raise OptionError(
                f"{self.path} was made with the area classes {', '.join(settings.area)}; leave area away, or make "
                "another map"
            )

    @property
    def crs(self) -> pyproj.CRS:
        """CRS of the map, or that which it will be made in.

        Raises
        ------
        InputError
            If there is no map yet, and no CRS was given.
        """
        if self._file.is_there():
            with self._opened() as (_, settings):
                return settings.crs
        if self._crs is None:
            raise InputError(f"{self.path} does not exist; give the CRS that it is to be made in (--crs)")
        return self._crs

    def update(self, local_maps: Input, *, draw: bool = True, **options: Any) -> Update:
        """Add local maps to the map, all of them or none.

        Local maps that the map knows already, by drive and instance, are skipped. What the new ones looked at is drawn
        anew from all that is known of it, the rest of the map stays as it is.

        Parameters
        ----------
        local_maps : GeoDataFrame, LocalMaps, or sequence of them
            As in `polymerge_core.merge`.
        draw : bool, default True
            Whether to draw the map anew. If not, the local maps are safe in the file, and wait there to be drawn with
            the next update that does, or with `draw`.
        **options
            Those of `polymerge_core.merge` that say how local maps are read: `class_field`, `class_name`,
            `drive_field`, `instance_field`, `instance_from`, `score_field`, `min_score`, `timestamp_field`, `crs`
            (of layers without one) and `strict`.

        Returns
        -------
        Update
            The revision, and what changed.

        Raises
        ------
        InputError, SchemaError, CrsError
            If a layer cannot be used.
        OptionError
            If an option has a value that it cannot have.
        OutputError
            If the map cannot be written; it is as it was then.
        """
        unknown = set(options) - _READING
        if unknown:
            raise OptionError(
                f"there is no option {min(unknown)!r} here; the options are {', '.join(sorted(_READING))}"
            )
        layers = as_local_maps(local_maps, "local_maps")
        with self._file.writing() as connection:
            settings = None if is_empty(connection) else read_settings(connection, self.path)
            if settings is not None:
                self._agree(settings)
            chosen = self._options(settings, options)
            crs = self._crs if settings is None else settings.crs
            evidence, crs = read_evidence(layers, chosen, crs)
            if settings is None:
                settings = create_map(connection, crs, chosen.proximity, tuple(sorted(chosen.area)))
            return self._add(connection, settings, evidence, ", ".join(maps.source for maps in layers), draw=draw)

    def draw(self) -> Update | None:
        """Draw what waits to be drawn; return what changed, None where nothing waits.

        Raises
        ------
        InputError
            If there is no map yet.
        OutputError
            If the map cannot be written; it is as it was then.
        """
        self._check_there()
        with self._file.writing() as connection:
            settings = read_settings(connection, self.path)
            if connection.execute("SELECT 1 FROM instances WHERE drawn IS NULL").fetchone() is None:
                return None
            return self._commit(connection, settings, None, "", 0, draw=True)

    def undo(self, revision: int, until: int | None = None) -> Update:
        """Take back what came with a revision, as if the map had never been told of it.

        Its local maps are taken out of the file, and what they looked at is drawn anew from all others. That is a
        revision, too; the history stays. The same local maps may come again.

        Parameters
        ----------
        revision : int
            Of `history`; one that brought local maps.
        until : int, optional
            With it all revisions from `revision` to this one, such as the frames of a stream.

        Returns
        -------
        Update
            The new revision, and what changed.

        Raises
        ------
        OptionError
            If there is no such revision, or nothing that can be taken back.
        OutputError
            If the map cannot be written; it is as it was then.
        """
        self._check_there()
        last = revision if until is None else until
        with self._file.writing() as connection:
            settings = read_settings(connection, self.path)
            for each in (revision, last):
                self._check_revision(connection, each)
            brought = "number BETWEEN ? AND ? AND n_instances > 0 AND undone IS NULL"
            query = f"SELECT COUNT(*) FROM revisions WHERE {brought}"
            if not connection.execute(query, (revision, last)).fetchone()[0]:
                raise OptionError(
                    f"there is nothing in revision {_span(revision, last)} of {self.path} that can be taken back: it "
                    "brought no local maps, or they were taken back already"
                )
            out = take_out(connection, settings, revision, last)
            source = f"undo of revision {_span(revision, last)}"
            done = self._commit(connection, settings, None, source, 0, draw=True, out=out)
            connection.execute(f"UPDATE revisions SET undone = ? WHERE {brought}", (done.revision, revision, last))
            return done

    def elements(self, revision: int | None = None) -> gpd.GeoDataFrame:
        """Return the map as it is, or as it was at a revision.

        Parameters
        ----------
        revision : int, optional
            Of `history`; the last one by default.

        Returns
        -------
        GeoDataFrame
            `element_id`, `class`, `score`, `n_observations`, `n_instances`, `length_m`, `sigma_m`, `first_seen`,
            `last_seen` (texts in UTC, None where no local map has a timestamp), `state`, `evidence`; by `element_id`.

        Raises
        ------
        OptionError
            If there is no such revision.
        """
        with self._opened() as (connection, settings):
            if revision is None:
                return read_elements(connection, settings).reset_index()
            self._check_revision(connection, revision)
            return elements_at(connection, settings, revision).reset_index()

    def history(self) -> pd.DataFrame:
        """Return the revisions: number, time, source, what was new and what changed, and who wrote it."""
        with self._opened() as (connection, _):
            found = pd.read_sql_query("SELECT * FROM revisions ORDER BY number", connection)
        return found.astype({"undone": "Int64"})

    def changes(self, since: int = 0) -> gpd.GeoDataFrame:
        """Return what became of each element since a revision.

        Parameters
        ----------
        since : int, default 0
            A revision; 0 is the empty map.

        Returns
        -------
        GeoDataFrame
            One row an element that is another now: `element_id`, `kind` (``added``, ``moved``, ``changed``,
            ``retired``, ``merged``), `revision` (of the last change), `moved_m` (median distance between what it was
            and what it is, metres), the attributes of an element, and the geometry: as it is now, or as it last was.
        """
        with self._opened() as (connection, settings):
            if since:
                self._check_revision(connection, since)
            return changes_since(connection, settings, since)

    def moves(self, since: int = 0) -> gpd.GeoDataFrame:
        """Return arrows from where elements were at a revision to where they are: `element_id`, `moved_m`.

        Parameters
        ----------
        since : int, default 0
            A revision.
        """
        found = self.changes(since)
        before = self.elements(since) if since else found
        return arrows(found, before.set_index("element_id").geometry)

    def verify(self) -> list[str]:
        """Check every invariant of the file.

        Returns
        -------
        list of str
            What is wrong, in sentences; none where all is right.
        """
        with self._opened() as (connection, _):
            return faults(connection)

    def _add(
        self, connection: sqlite3.Connection, settings: Settings, evidence: Evidence, source: str, *, draw: bool
    ) -> Update:
        evidence, skipped = without_known(connection, evidence)
        if len(evidence.instances):
            return self._commit(connection, settings, evidence, source, skipped, draw=draw)
        (last,) = connection.execute("SELECT ifnull(MAX(number), 0) FROM revisions").fetchone()
        if last == 0:
            return self._commit(connection, settings, None, source, skipped, draw=False)
        # Nothing is new: no revision either.
        return Update.of(last, _NO_CHANGE, _count(connection, "elements"), skipped, evidence)

    def _commit(
        self,
        connection: sqlite3.Connection,
        settings: Settings,
        evidence: Evidence | None,
        source: str,
        skipped: int,
        *,
        draw: bool,
        out: TakenOut = _NOTHING,
    ) -> Update:
        """Make a revision: of what is new, of what was taken out, of drawing."""
        revision = geopackage.next_id(connection, "revisions")
        if evidence is not None:
            add(connection, settings, evidence, revision)
        counts = _NO_CHANGE
        if draw:
            place = shapely.union_all([out.place, place_of(connection, settings, "i.drawn IS NULL")])
            if not place.is_empty:
                counts = redraw(connection, settings, place, revision, out.elements)
            connection.execute("UPDATE instances SET drawn = ? WHERE drawn IS NULL", (revision,))
        update = Update.of(revision, counts, _count(connection, "elements"), skipped, evidence)
        row = {
            "number": revision,
            "time": now(),
            "source": source,
            "n_instances": update.instances,
            "n_observations": update.observations,
            "n_skipped": skipped,
            **vars(counts),
            "elements": update.elements,
            "software": software(),
        }
        geopackage.insert(connection, "revisions", {name: [value] for name, value in row.items()})
        for table in ("revisions", "lineage", "left_out", "id_aliases"):
            geopackage.touched(connection, table)
        return update

    def _options(self, settings: Settings | None, options: dict[str, Any]) -> Options:
        if settings is not None:
            return Options.of(proximity=settings.proximity, area=settings.area, **options)
        given = {} if self._proximity is None else {"proximity": self._proximity}
        return Options.of(area=self._area, **given, **options)

    def _check_there(self) -> None:
        if not self._file.is_there():
            raise InputError(f"{self.path} does not exist yet; the first update makes it")

    @contextlib.contextmanager
    def _opened(self) -> Iterator[tuple[Connection, Settings]]:
        self._check_there()
        with self._file.reading() as connection:
            yield connection, read_settings(connection, self.path)

    def _check_revision(self, connection: sqlite3.Connection, revision: int) -> None:
        (last,) = connection.execute("SELECT ifnull(MAX(number), 0) FROM revisions").fetchone()
        if not 1 <= revision <= last:
            raise OptionError(f"{self.path} has no revision {revision}; it has 1 to {last}")


_READING = {
    "class_field",
    "class_name",
    "drive_field",
    "instance_field",
    "instance_from",
    "score_field",
    "min_score",
    "timestamp_field",
    "crs",
    "strict",
}


def _span(first: int, last: int) -> str:
    return str(first) if first == last else f"{first} to {last}"


def _count(connection: sqlite3.Connection, table: str) -> int:
    return int(
        connection.execute("SELECT feature_count FROM gpkg_ogr_contents WHERE table_name = ?", (table,)).fetchone()[0]
    )


def now() -> str:
    """Return the time as GeoPackage has it."""
    return dt.datetime.now(dt.timezone.utc).strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3] + "Z"
