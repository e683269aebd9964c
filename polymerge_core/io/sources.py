"""The files that are read: told apart by what they hold, and checked before GDAL opens them."""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import re
import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from polymerge_core.errors import InputError, OutputError
from polymerge_core.io.drivers import gdal_path, warn

_LOCK_SECONDS = 2.0
_PART_HEAD_BYTES = 32
_OPTION = re.compile(
    r"\|(?=(?:layername|layerid|subset|geometrytype|uniquegeometrytype|authcfg|option:[^=|]*)=)",
    re.IGNORECASE,
)


class Source(NamedTuple):
    """An input file that GDAL may open without harm."""

    #: As the user named it, for messages.
    file: Path
    #: What is opened in its place: the file itself, or a copy of it.
    readable: Path
    #: Its format, one of the values of `FORMATS`.
    kind: str

    @property
    def gdal_path(self) -> str:
        """The path as GDAL is to be given it."""
        return gdal_path(self.readable, self.kind)


def split_source(source: str | os.PathLike[str]) -> tuple[Path, str | None]:
    """Split ``FILE|layername=LAYER`` into the file and the layer.

    Parameters
    ----------
    source : path
        As QGIS writes it, or as a user does.

    Returns
    -------
    tuple of Path and str or None
        The file, and the layer where one is named.

    Raises
    ------
    InputError
        If it is remote, or has parts that would choose features (``|subset=``, ``|geometrytype=``).
    """
    text = os.fspath(source)
    if re.match(r"/vsi|\\vsi|[a-z][a-z0-9+.-]+://|https?:|ftp:", text, re.IGNORECASE):
        raise InputError(f"{text} is not a file on this computer: download or unpack it first")
    file, *options = _OPTION.split(text)
    layer: str | None = None
    for option in options:
        key, _, value = option.partition("=")
        if key.lower() != "layername" or not value:
            raise InputError(
                f"{text}: only |layername=LAYER may follow a file, not |{option}; export what it selects to "
                "a layer of its own"
            )
        layer = value
    return Path(file), layer


@contextlib.contextmanager
def opened(file: Path) -> Iterator[Source]:
    """Give a file, known by its content and checked, to read from."""
    try:
        kind = _detect(file)
    except OSError as error:
        raise InputError(f"{file} cannot be read: {error.strerror}") from error
    readable = file.absolute()
    if any(mark in str(readable) for mark in "!;") and kind != "GeoJSON":
        # GDAL's bindings take these for parts of an archive's address and would open another file.
        raise InputError(f"{file}: a path with ! or ; in it cannot be read; rename the file or folder")
    if kind == "ESRI Shapefile":
        check_shapefile(readable, InputError)
    if kind == "GeoJSON":
        _check_geojson(readable)
    if kind != "GPKG":
        yield Source(file, readable, kind)
        return
    with contextlib.ExitStack() as stack:
        copy = _snapshot(readable, file, stack)
        _check_geopackage(copy, file)
        yield Source(file, copy, kind)


def _detect(file: Path) -> str:
    if not file.exists():
        hint = "; a layer is named by |layername=LAYER" if "|" in str(file) else ""
        raise InputError(f"{file}: no such file{hint}")
    if not file.is_file():
        raise InputError(f"{file} is not a file: name a GeoPackage, Shapefile, GeoJSON, FlatGeobuf or GeoParquet file")
    with file.open("rb") as stream:
        head = stream.read(512)
    if not head:
        raise InputError(f"{file} is empty (0 bytes): it was not written to the end; make it again")
    if re.match(rb"\x80[\x02-\x05]", head) or file.suffix.lower() in {".pkl", ".pickle"}:
        raise InputError(
            f"{file} is a Python pickle, which can run any program when it is opened: convert it to JSON or "
            "a GeoPackage in the environment that wrote it"
        )
    magics = {
        b"SQLite format 3\0": "GPKG",
        b"\0\0\x27\x0a": "ESRI Shapefile",
        b"fgb\x03fgb": "FlatGeobuf",
        b"PAR1": "Parquet",
    }
    for magic, kind in magics.items():
        if head.startswith(magic):
            return kind
    if head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{"):
        if re.search(rb'"(results|groundTruth)"\s*:', head) and b'"type"' not in head[:100]:
            raise InputError(f"{file} holds a predictor's results, no layer: run project on it first")
        return "GeoJSON"
    raise InputError(
        f"{file} is not a GeoPackage, Shapefile, GeoJSON, FlatGeobuf or GeoParquet file, or its beginning is damaged"
    )


def _check_geopackage(readable: Path, file: Path) -> None:
    """Open a GeoPackage by SQLite alone, which says what is wrong with it."""
    with contextlib.closing(
        sqlite3.connect(f"{readable.as_uri()}?mode=ro", uri=True, timeout=_LOCK_SECONDS)
    ) as database:
        try:
            tables = {row[0] for row in database.execute("SELECT name FROM sqlite_master")}
            damage = database.execute("PRAGMA quick_check(1)").fetchone()[0]
        except sqlite3.DatabaseError as error:
            raise InputError(_sqlite_message(readable, file, error)) from error
    if damage != "ok":
        raise InputError(f"{file} is damaged ({damage}): restore a copy, or repair it with ogr2ogr")
    if "gpkg_contents" not in tables:
        raise InputError(f"{file} is an SQLite database, but not a GeoPackage")


def _sqlite_message(readable: Path, file: Path, error: sqlite3.DatabaseError) -> str:
    if "locked" in str(error):
        return f"{file} is locked: another program is writing to it; let it finish, or close the file there"
    journal = readable.with_name(readable.name + "-journal")
    if isinstance(error, sqlite3.OperationalError) and journal.exists():
        return (
            f"{file}: a program crashed while writing to it ({journal.name} lies beside it); open it once "
            "with that program, or with QGIS, so that it is repaired"
        )
    return f"{file} is damaged or not complete ({error}): restore a copy, or write it again"


def _snapshot(readable: Path, file: Path, stack: contextlib.ExitStack) -> Path:
    """Return a copy of a GeoPackage in write-ahead mode, the file itself otherwise.

    GDAL merges a write-ahead log into the file when it closes it, even one that it only read.
    """
    with readable.open("rb") as stream:
        write_ahead = stream.read(20)[18:] == b"\x02\x02"
    if not write_ahead:
        return readable
    copy = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="polymerge-")), readable.name)
    if not readable.with_name(readable.name + "-wal").exists():
        shutil.copyfile(readable, copy)
        return copy
    warn(
        f"{file} is open in another program, or a program crashed with it ({file.name}-wal lies beside it); "
        "what was saved so far is read"
    )
    with (
        contextlib.closing(sqlite3.connect(f"{readable.as_uri()}?mode=ro", uri=True, timeout=_LOCK_SECONDS)) as live,
        contextlib.closing(sqlite3.connect(copy)) as still,
    ):
        try:
            live.backup(still)
        except sqlite3.DatabaseError as error:
            raise InputError(_sqlite_message(readable, file, error)) from error
    return copy


def check_shapefile(path: Path, error: type[InputError | OutputError]) -> None:
    """Check that the parts of a Shapefile are there, complete, and speak of the same number of features."""
    if path.suffix.lower() != ".shp":
        raise error(f"{path} is a Shapefile but is not called so: rename it and its other parts to .shp, .shx, .dbf")
    parts = {}
    for suffix in (".shx", ".dbf"):
        part = next((p for p in (path.with_suffix(suffix), path.with_suffix(suffix.upper())) if p.is_file()), None)
        if part is None:
            raise error(f"{path}: its part {path.stem}{suffix} is missing; copy all parts of the Shapefile together")
        parts[suffix] = part
    heads = {suffix: part.open("rb") for suffix, part in {".shp": path, **parts}.items()}
    with contextlib.ExitStack() as stack:
        read = {suffix: stack.enter_context(stream).read(_PART_HEAD_BYTES) for suffix, stream in heads.items()}
    sizes = {suffix: part.stat().st_size for suffix, part in {".shp": path, **parts}.items()}
    if any(len(head) < _PART_HEAD_BYTES for head in read.values()):
        raise error(f"{path} is damaged: one of its parts is too short")
    records, head_size, record_size = struct.unpack("<IHH", read[".dbf"][4:12])
    said = {suffix: 2 * struct.unpack(">I", read[suffix][24:28])[0] for suffix in (".shp", ".shx")}
    said[".dbf"] = head_size + records * record_size
    for suffix, size in said.items():
        if sizes[suffix] < size:
            raise error(f"{path.with_suffix(suffix)} is cut short ({sizes[suffix]} of {size} bytes): copy it again")
    shapes = (said[".shx"] - 100) // 8
    if shapes != records:
        raise error(f"{path}: its parts do not belong together ({shapes} shapes, {records} rows in the .dbf)")


def _check_geojson(path: Path) -> None:
    """Refuse a CRS given by a link, which GDAL would fetch from the network."""
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as text:
        for member in re.finditer(rb'"((?:[^"\\]|\\u00[0-9a-fA-F]{2}){3})"\s*:\s*(?=\{)', text):
            if json.loads(b'"' + member[1] + b'"').lower() != "crs":
                continue
            try:
                declared, _ = json.JSONDecoder().raw_decode(text[member.end() : member.end() + 20_000].decode())
            except (ValueError, RecursionError):
                continue  # not a CRS as GeoJSON has it; GDAL reports what is wrong with the file
            if str(declared.get("type", "")).lower() in {"link", "url"}:
                raise InputError(f"{path}: its CRS is a link to the network; write the file again with a named CRS")
