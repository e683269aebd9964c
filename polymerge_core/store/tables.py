"""The tables of a stored map, and their version."""

from __future__ import annotations

import json
import platform
import sqlite3
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pyproj

from polymerge_core.crs import is_local, parse_crs
from polymerge_core.environment import library_versions
from polymerge_core.errors import InputError
from polymerge_core.store import geopackage
from polymerge_core.store.geopackage import create, create_layer, create_table
from polymerge_core.version import __version__

#: Of the tables; what a later one wrote is refused.
FORMAT = 1

#: The attributes of an element, as a merge writes them and what time adds to them.
ELEMENT = {
    "class": "TEXT",
    "score": "REAL",
    "n_observations": "INTEGER",
    "n_instances": "INTEGER",
    "length_m": "REAL",
    "sigma_m": "REAL",
    "first_seen": "DATETIME",
    "last_seen": "DATETIME",
    "state": "TEXT",
    "evidence": "REAL",
}

_INTERVAL = {"source": "TEXT", "source_fid": "TEXT", "drive": "TEXT", "instance": "TEXT"}

_LAYERS = {
    # The feature id is the element's, too, which readers that hide feature ids would lose.
    "elements": ("fid", {"element_id": "INTEGER", **ELEMENT}, "GEOMETRY"),
    "changes": (
        "fid",
        {"revision": "INTEGER", "element_id": "INTEGER", "kind": "TEXT", "moved_m": "REAL", **ELEMENT},
        "GEOMETRY",
    ),
    "instances": (
        "fid",
        {
            "drive": "TEXT",
            "instance": "TEXT",
            "timestamp_ns": "INTEGER",
            "x": "REAL",
            "y": "REAL",
            "heading": "REAL",
            "n_observations": "INTEGER",
            "has_footprint": "BOOLEAN",
            "revision": "INTEGER",
            # The revision whose map this local map is in, NULL as long as it waits to be drawn.
            "drawn": "INTEGER",
        },
        "GEOMETRY",
    ),
    "observations": (
        "fid",
        {
            "instance_fid": "INTEGER",
            "class": "TEXT",
            "score": "REAL",
            "is_area": "BOOLEAN",
            "source": "TEXT",
            "source_fid": "TEXT",
            "from_m": "REAL",
            "to_m": "REAL",
        },
        "GEOMETRY",
    ),
    # Where the road is known to have changed: what was seen of the class there before says nothing of it now.
    "renewed": (
        "fid",
        {"class": "TEXT", "kind": "TEXT", "since_drive": "TEXT", "since_revision": "INTEGER", "revision": "INTEGER"},
        "GEOMETRY",
    ),
}

_TABLES = {
    "lineage": (
        "fid",
        {
            **_INTERVAL,
            "element_id": "INTEGER",
            "from_m": "REAL",
            "to_m": "REAL",
            "weight": "REAL",
            "observation_fid": "INTEGER",
        },
    ),
    "left_out": (
        "fid",
        {**_INTERVAL, "from_m": "REAL", "to_m": "REAL", "reason": "TEXT", "observation_fid": "INTEGER"},
    ),
    "id_aliases": ("fid", {"old_id": "INTEGER", "element_id": "INTEGER", "revision": "INTEGER"}),
    "revisions": (
        "number",
        {
            "time": "DATETIME",
            "source": "TEXT",
            "n_instances": "INTEGER",
            "n_observations": "INTEGER",
            "n_skipped": "INTEGER",
            "added": "INTEGER",
            "changed": "INTEGER",
            "moved": "INTEGER",
            "retired": "INTEGER",
            "merged": "INTEGER",
            "elements": "INTEGER",
            "software": "TEXT",
            # The revision that took back what came with this one, NULL as long as it is there.
            "undone": "INTEGER",
        },
    ),
    "map_settings": ("fid", {"name": "TEXT", "value": "TEXT"}),
}

_INDEXES = (
    ("instances", "drive, instance", True),
    ("instances", "drive, timestamp_ns", False),
    ("instances", "drawn", False),
    ("observations", "instance_fid", False),
    ("elements", "element_id", True),
    ("lineage", "element_id", False),
    ("lineage", "observation_fid", False),
    ("left_out", "observation_fid", False),
    ("changes", "element_id, revision", False),
    ("changes", "revision", False),
)


@dataclass(frozen=True)
class Settings:
    """What holds for the whole of a map: the working CRS, its number in the file, and the options it is drawn with."""

    crs: pyproj.CRS
    srs_id: int
    proximity: float
    area: tuple[str, ...]


def create_map(connection: sqlite3.Connection, crs: pyproj.CRS, proximity: float, area: tuple[str, ...]) -> Settings:
    """Make an empty file an empty map, within a transaction."""
    srs_id = create(connection, crs)
    for name, (key, columns, geometry) in _LAYERS.items():
        create_layer(connection, name, key, columns, geometry, srs_id)
    for name, (key, columns) in _TABLES.items():
        create_table(connection, name, key, columns)
    for table, listed, unique in _INDEXES:
        kind = "UNIQUE INDEX" if unique else "INDEX"
        name = f"{table}_by_{listed.replace(', ', '_')}"
        connection.execute(f'CREATE {kind} "{name}" ON "{table}" ({listed})')
    settings = Settings(crs, srs_id, proximity, area)
    held = asdict(settings) | {"crs": "local" if is_local(crs) else crs.to_wkt(), "format": FORMAT}
    geopackage.insert(
        connection, "map_settings", {"name": list(held), "value": [json.dumps(value) for value in held.values()]}
    )
    return settings


def read_settings(connection: sqlite3.Connection, path: Path) -> Settings:
    """Read what holds for a map.

    Raises
    ------
    InputError
        If the file is no stored map, or one of a later version, or damaged.
    """
    tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if "map_settings" not in tables:
        raise InputError(
            f"{path} is no stored map: it has no table map_settings; name another file, which update --create makes a "
            "map, or merge into this one with merge --main-map"
        )
    held = dict(connection.execute("SELECT name, value FROM map_settings").fetchall())

    def setting(name: str) -> Any:
        try:
            return json.loads(held[name])
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(f"{path} is damaged: its setting {name} cannot be read; restore it from a copy") from error

    number = setting("format")
    if number > FORMAT:
        raise InputError(
            f"{path} was written by a later version of PolyMerge (format {number}, this one knows {FORMAT}); "
            "update PolyMerge"
        )
    return Settings(parse_crs(setting("crs")), setting("srs_id"), setting("proximity"), tuple(setting("area")))


@cache
def software() -> str:
    """Return who writes: this program and the libraries whose version matters."""
    versions = library_versions() | {"PolyMerge": __version__, "Python": platform.python_version()}
    return ", ".join(f"{name} {versions[name]}" for name in sorted(versions))
