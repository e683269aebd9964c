"""Layers in and out: GeoPackage, ESRI Shapefile, GeoJSON, FlatGeobuf and GeoParquet.

Files are read by what they hold, not by what they are called, and never changed by being read; nothing is
fetched over a network. Outputs are written by `polymerge_core.outputs`, read back and checked before they
replace anything, and come out byte for byte the same for the same layers.
"""

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
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import date, datetime
from datetime import time as clock_time
from pathlib import Path
from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pyogrio
import shapely
from pyproj.exceptions import CRSError as PyprojCrsError
from shapely.errors import ShapelyError

from polymerge_core.crs import LOCAL_CRS, is_local
from polymerge_core.errors import CrsError, InputError, OutputError
from polymerge_core.outputs import StagedOutputs, write_error
from polymerge_core.schema import AREAS_LAYER, ELEMENTS_LAYER, INSTANCES_LAYER, LOCAL_MAPS_LAYER, LocalMaps

#: Outputs are known by their extension.
FORMATS = {
    ".gpkg": "GPKG",
    ".shp": "ESRI Shapefile",
    ".geojson": "GeoJSON",
    ".fgb": "FlatGeobuf",
    ".parquet": "Parquet",
    ".geoparquet": "Parquet",
}

#: Table of what was left out before, beside the layer `local_maps`.
LEFT_OUT_TABLE = "left_out"

#: Shapefile cuts column names at 10 bytes; these are the contract's names for it.
SHAPEFILE_NAMES = {"element_id": "elem_id", "n_observations": "n_obs", "n_instances": "n_inst"}

# Integers and booleans with gaps keep their exact values only in pandas' nullable types.
_EXACT = {
    pa.int8(): pd.Int8Dtype(),
    pa.int16(): pd.Int16Dtype(),
    pa.int32(): pd.Int32Dtype(),
    pa.int64(): pd.Int64Dtype(),
    pa.uint8(): pd.UInt8Dtype(),
    pa.uint16(): pd.UInt16Dtype(),
    pa.uint32(): pd.UInt32Dtype(),
    pa.uint64(): pd.UInt64Dtype(),
    pa.bool_(): pd.BooleanDtype(),
}
_READ_ERRORS = (
    RuntimeError,
    OSError,
    ValueError,
    LookupError,
    pa.ArrowException,
    ShapelyError,
    PyprojCrsError,
)
_LOCK_SECONDS = 2.0
_ROOM_BYTES = 256 * 1024
_SHAPEFILE_TEXT_BYTES = 254
_PART_HEAD_BYTES = 32
_COLLECTION = 7  # shapely's type id; curves have higher ones
_OPTION = re.compile(
    r"\|(?=(?:layername|layerid|subset|geometrytype|uniquegeometrytype|authcfg|option:[^=|]*)=)",
    re.IGNORECASE,
)


class LayerWarning(UserWarning):
    """Something about a file that the user should know, and that does not stop the run."""


class Written(NamedTuple):
    """What was written where.

    Parameters
    ----------
    paths : list of Path
        The files, in the order in which they were written.
    renamed : dict
        For each layer whose columns had to be renamed for the format: old name to new name.
    """

    paths: list[Path]
    renamed: dict[str, dict[str, str]]


class LayerInfo(NamedTuple):
    """What a file says about one of its layers.

    Parameters
    ----------
    name : str
        The layer.
    geometry_type : str or None
        ``LineString``, ``Polygon`` and so on; ``Unknown`` where it holds any; None for a table.
    fields : tuple of str
        Its columns.
    features : int
        How many features it says it has; -1 where it does not say.
    encoding : str
        Of its text.
    """

    name: str
    geometry_type: str | None
    fields: tuple[str, ...] = ()
    features: int = -1
    encoding: str = "UTF-8"

    @property
    def is_points(self) -> bool:
        """Whether the layer is declared to hold points."""
        return self.geometry_type is not None and "point" in self.geometry_type.lower()


# -- reading ---------------------------------------------------------------------------------------


def read_layers(path: str | os.PathLike[str], *, layer: str | None = None) -> dict[str, gpd.GeoDataFrame]:
    """Read the line and polygon layers of a file.

    Parameters
    ----------
    path : path
        A file, or ``FILE|layername=LAYER`` as QGIS writes it. GeoPackage, ESRI Shapefile, GeoJSON, FlatGeobuf
        and GeoParquet are told apart by their content.
    layer : str, optional
        The one layer to read; all line and polygon layers by default. Layers of points are skipped with a
        `LayerWarning`, tables without geometry silently.

    Returns
    -------
    dict of str to GeoDataFrame
        By layer name, in the file's order. The index is the feature id and is called ``fid``. Integers with
        gaps come in pandas' nullable types, curves as lines. A geometry that cannot be decoded is None, with
        a `LayerWarning`. The CRS is the file's; None where it has none; `polymerge_core.crs.LOCAL_CRS` for
        plain metric coordinates.

    Raises
    ------
    InputError
        If the file is missing, remote, damaged, locked, of another format, has no such layer, or has layers
        of points only.
    CrsError
        If the file has plain coordinates in another unit than the metre.
    """
    file, named = split_source(path)
    with _opened(file) as (readable, kind):
        known = _list_layers(readable, kind, file)
        return _read_chosen(readable, kind, _choose(known, layer or named, file), file)


def read_local_maps(sources: Iterable[str | os.PathLike[str]]) -> list[LocalMaps]:
    """Read local maps by the layer contract.

    Parameters
    ----------
    sources : iterable of path
        Files, or ``FILE|layername=LAYER``. A file without a layer means its layer ``local_maps`` (with the
        layer ``instances`` and the table ``left_out`` beside it) where there is one, else its layer
        ``elements`` (and ``elements_areas``), else all its line and polygon layers.

    Returns
    -------
    list of LocalMaps
        One for each layer, in the order given. Its source is the file's stem, or the layer's name where a
        file gives several; where two would be called the same, the shortest end of their paths that tells them
        apart (``monday/track``). The same layer given twice keeps its one name.

    Raises
    ------
    InputError
        As for `read_layers`.
    CrsError
        As for `read_layers`.
    """
    found: list[tuple[Path, str, LocalMaps]] = []
    for source in sources:
        file, layer = split_source(source)
        with _opened(file) as (readable, kind):
            known = _list_layers(readable, kind, file)
            chosen = _choose(known, layer or _contract_layer(known), file)
            if layer is None and chosen[0].name == ELEMENTS_LAYER:
                chosen += [each for each in known if each.name == AREAS_LAYER]
            frames = _read_chosen(readable, kind, chosen, file)
            beside = {}
            if LOCAL_MAPS_LAYER in frames:
                beside = {each.name: each for each in known if each.name in {INSTANCES_LAYER, LEFT_OUT_TABLE}}
            instances = (
                _read_layer(readable, kind, beside[INSTANCES_LAYER], file)
                if INSTANCES_LAYER in beside
                else None
            )
            left_out = (
                _read_columns(readable, kind, beside[LEFT_OUT_TABLE], file)
                if LEFT_OUT_TABLE in beside
                else None
            )
        for name, frame in frames.items():
            mine = name == LOCAL_MAPS_LAYER
            maps = LocalMaps(frame, instances if mine else None, left_out=left_out if mine else None)
            found.append((file, name, maps))
    titles = _source_names([(file, name) for file, name, _ in found])
    return [replace(maps, source=title) for title, (_, _, maps) in zip(titles, found, strict=True)]


def read_table(path: str | os.PathLike[str], layer: str) -> pd.DataFrame:
    """Read one layer of a file without its geometry.

    Parameters
    ----------
    path : path
        The file.
    layer : str
        The layer or table.

    Returns
    -------
    DataFrame
        The attributes; the index is the feature id.

    Raises
    ------
    InputError
        As for `read_layers`.
    """
    file, _ = split_source(path)
    with _opened(file) as (readable, kind):
        known = {each.name: each for each in _list_layers(readable, kind, file)}
        if layer not in known:
            raise InputError(_unknown_layer(file, layer, known))
        table: pd.DataFrame = _read_columns(readable, kind, known[layer], file)
    return table


def list_layers(path: str | os.PathLike[str]) -> list[LayerInfo]:
    """List the layers of a file.

    Parameters
    ----------
    path : path
        The file.

    Returns
    -------
    list of LayerInfo
        In the file's order, tables included.

    Raises
    ------
    InputError
        If the file cannot be opened.
    """
    file, _ = split_source(path)
    with _opened(file) as (readable, kind):
        return _list_layers(readable, kind, file)


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


def _contract_layer(known: Sequence[LayerInfo]) -> str | None:
    names = [each.name for each in known]
    return next((name for name in (LOCAL_MAPS_LAYER, ELEMENTS_LAYER) if name in names), None)


def _source_names(layers: Sequence[tuple[Path, str]]) -> list[str]:
    """Name each layer by the shortest end of its path that no other layer has."""
    spelled: dict[tuple[Path, str], Path] = {}
    keys = [(file.resolve(), name) for file, name in layers]
    for key, (file, _) in zip(keys, layers, strict=True):
        spelled[key] = min(spelled.get(key, file.absolute()), file.absolute())
    several = {file for file, _ in spelled if sum(other == file for other, _ in spelled) > 1}
    tails: dict[tuple[Path, str], tuple[str, ...]] = {}
    for key, path in spelled.items():
        tails[key] = (*path.parts[:-1], path.stem, *([key[1]] if key[0] in several else []))
    alike = [
        key for key in tails if list(tails.values()).count(tails[key]) > 1
    ]  # track.shp beside track.gpkg
    for key in alike:
        stem_at = len(spelled[key].parts) - 1
        tails[key] = (*tails[key][:stem_at], spelled[key].name, *tails[key][stem_at + 1 :])
    titles = {}
    for key, tail in tails.items():
        others = [other for unlike, other in tails.items() if unlike != key]
        lengths = range(1, len(tail) + 1)
        length = next((n for n in lengths if all(other[-n:] != tail[-n:] for other in others)), len(tail))
        titles[key] = "/".join(tail[-length:])
    return [titles[key] for key in keys]


@contextlib.contextmanager
def _opened(file: Path) -> Iterator[tuple[Path, str]]:
    """Give a path that GDAL may open without harm, and the format of the file."""
    try:
        kind = _detect(file)
    except OSError as error:
        raise InputError(f"{file} cannot be read: {error.strerror}") from error
    readable = file.absolute()
    if any(mark in str(readable) for mark in "!;") and kind != "GeoJSON":
        # GDAL's bindings take these for parts of an archive's address and would open another file.
        raise InputError(f"{file}: a path with ! or ; in it cannot be read; rename the file or folder")
    if kind == "ESRI Shapefile":
        _check_shapefile(readable, InputError)
    if kind == "GeoJSON":
        _check_geojson(readable)
    if kind != "GPKG":
        yield readable, kind
        return
    with contextlib.ExitStack() as stack:
        copy = _snapshot(readable, file, stack)
        _check_geopackage(copy, file)
        yield copy, kind


def _detect(file: Path) -> str:
    if not file.exists():
        raise InputError(f"{file}: no such file")
    if not file.is_file():
        raise InputError(
            f"{file} is not a file: name a GeoPackage, Shapefile, GeoJSON, FlatGeobuf or GeoParquet file"
        )
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
        return "GeoJSON"
    raise InputError(
        f"{file} is not a GeoPackage, Shapefile, GeoJSON, FlatGeobuf or GeoParquet file, or it is damaged at its "
        "beginning"
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
    _warn(
        f"{file} is open in another program, or a program crashed with it ({file.name}-wal lies beside it); what "
        "was saved so far is read"
    )
    with (
        contextlib.closing(
            sqlite3.connect(f"{readable.as_uri()}?mode=ro", uri=True, timeout=_LOCK_SECONDS)
        ) as live,
        contextlib.closing(sqlite3.connect(copy)) as still,
    ):
        try:
            live.backup(still)
        except sqlite3.DatabaseError as error:
            raise InputError(_sqlite_message(readable, file, error)) from error
    return copy


def _check_shapefile(path: Path, error: type[InputError | OutputError]) -> None:
    """Check that the parts of a Shapefile are there, complete, and speak of the same number of features."""
    if path.suffix.lower() != ".shp":
        raise error(
            f"{path} is a Shapefile but is not called so: rename it and its other parts to .shp, .shx, .dbf"
        )
    parts = {}
    for suffix in (".shx", ".dbf"):
        part = next(
            (p for p in (path.with_suffix(suffix), path.with_suffix(suffix.upper())) if p.is_file()), None
        )
        if part is None:
            raise error(
                f"{path}: its part {path.stem}{suffix} is missing; copy all parts of the Shapefile together"
            )
        parts[suffix] = part
    heads = {suffix: part.open("rb") for suffix, part in {".shp": path, **parts}.items()}
    with contextlib.ExitStack() as stack:
        read = {
            suffix: stack.enter_context(stream).read(_PART_HEAD_BYTES) for suffix, stream in heads.items()
        }
    sizes = {suffix: part.stat().st_size for suffix, part in {".shp": path, **parts}.items()}
    if any(len(head) < _PART_HEAD_BYTES for head in read.values()):
        raise error(f"{path} is damaged: one of its parts is too short")
    records, head_size, record_size = struct.unpack("<IHH", read[".dbf"][4:12])
    said = {suffix: 2 * struct.unpack(">I", read[suffix][24:28])[0] for suffix in (".shp", ".shx")}
    said[".dbf"] = head_size + records * record_size
    for suffix, size in said.items():
        if sizes[suffix] < size:
            raise error(
                f"{path.with_suffix(suffix)} is cut short ({sizes[suffix]} of {size} bytes): copy it again"
            )
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
                declared, _ = json.JSONDecoder().raw_decode(
                    text[member.end() : member.end() + 20_000].decode()
                )
            except (ValueError, RecursionError):
                continue  # not a CRS as GeoJSON has it; GDAL reports what is wrong with the file
            if str(declared.get("type", "")).lower() in {"link", "url"}:
                raise InputError(
                    f"{path}: its CRS is a link to the network; write the file again with a named CRS"
                )


def _gdal_path(readable: Path, kind: str) -> str:
    # The prefix keeps other drivers that live in JSON files, some of which open addresses, out of it.
    return f"GeoJSON:{readable}" if kind == "GeoJSON" else str(readable)


def _list_layers(readable: Path, kind: str, file: Path) -> list[LayerInfo]:
    with _gdal_speaks_of(file, None):
        if kind == "Parquet":
            schema = pq.read_schema(readable)
            return [LayerInfo(file.stem, "Unknown", tuple(schema.names))]
        path = _gdal_path(readable, kind)
        names = [name for name, _ in pyogrio.list_layers(path)] if kind == "GPKG" else [None]
        infos = [pyogrio.read_info(path, layer=name) for name in names]
        layers = [
            LayerInfo(
                info["layer_name"],
                info["geometry_type"],
                tuple(info["fields"]),
                info["features"],
                info["encoding"] or "UTF-8",
            )
            for info in infos
        ]
    if not layers:
        raise InputError(f"{file} holds no layers")
    return layers


def _choose(known: Sequence[LayerInfo], wanted: str | None, file: Path) -> list[LayerInfo]:
    if wanted is not None:
        by_name = {each.name: each for each in known}
        if wanted not in by_name:
            raise InputError(_unknown_layer(file, wanted, by_name))
        if by_name[wanted].geometry_type is None:
            raise InputError(
                f"{file}: {wanted} is a table without geometry; name a layer of lines or polygons"
            )
        if by_name[wanted].is_points:
            raise InputError(_points_message(file, wanted))
        return [by_name[wanted]]
    spatial = [each for each in known if each.geometry_type is not None]
    chosen = [each for each in spatial if not each.is_points]
    if not spatial:
        names = ", ".join(each.name for each in known)
        raise InputError(f"{file} holds no layer of lines or polygons, only tables ({names})")
    if not chosen:
        raise InputError(_points_message(file, spatial[0].name))
    for each in spatial:
        if each.is_points:
            _warn(f"{_points_message(file, each.name)}; this layer is skipped")
    return chosen


def _unknown_layer(file: Path, wanted: str, known: Iterable[str]) -> str:
    return f"{file} has no layer {wanted}; its layers are {', '.join(known)}"


def _points_message(file: Path, name: str) -> str:
    return f"{file}: layer {name} holds points; PolyMerge merges lines and polygons"


def _all_points(frame: gpd.GeoDataFrame) -> bool:
    types = shapely.get_type_id(frame.geometry.to_numpy())
    types = types[types >= 0]
    return bool(len(types)) and bool(np.isin(types, [0, 4]).all())


def _read_chosen(
    readable: Path, kind: str, chosen: Sequence[LayerInfo], file: Path
) -> dict[str, gpd.GeoDataFrame]:
    """Read layers, and skip those that turn out to hold points only."""
    frames = {each.name: _read_layer(readable, kind, each, file) for each in chosen}
    pointed = [name for name, frame in frames.items() if _all_points(frame)]
    if len(pointed) == len(frames):
        raise InputError(_points_message(file, pointed[0]))
    for name in pointed:
        _warn(f"{_points_message(file, name)}; this layer is skipped")
        del frames[name]
    return frames


def _read_layer(readable: Path, kind: str, layer: LayerInfo, file: Path) -> gpd.GeoDataFrame:
    with _gdal_speaks_of(file, layer.name):
        if kind == "Parquet":
            frame = _read_parquet(readable, file)
        else:
            frame = _read_gdal(_gdal_path(readable, kind), kind, layer)
            if len(frame) < layer.features:
                raise InputError(
                    f"{file}: layer {layer.name} is cut short ({len(frame)} of {layer.features} features are "
                    "there); copy the file again"
                )
        return _declare_crs(_plain_types(frame), file)


def _read_columns(readable: Path, kind: str, layer: LayerInfo, file: Path) -> Any:
    with _gdal_speaks_of(file, layer.name):
        if kind == "Parquet":
            frame = _read_parquet(readable, file)
            return pd.DataFrame(_plain_types(frame.drop(columns=frame.geometry.name)))
        return _plain_types(_read_arrow(_gdal_path(readable, kind), kind, layer, read_geometry=False))


def _read_gdal(path: str, kind: str, layer: LayerInfo) -> gpd.GeoDataFrame:
    # GDAL's Arrow reader crashes on a FlatGeobuf feature without geometry, and takes no curves, which the
    # other reader turns into lines; and an attribute called geometry would be lost.
    if kind != "FlatGeobuf" and "geometry" not in layer.fields:
        with contextlib.suppress(NotImplementedError):  # there are curves
            return _without_curves(_read_arrow(path, kind, layer, on_invalid="warn"))
    geometry = pyogrio.read_dataframe(
        path, layer=layer.name, use_arrow=False, columns=[], fid_as_index=True, on_invalid="warn"
    )
    columns = _read_arrow(path, kind, layer, read_geometry=False)
    columns = columns.rename(columns={"geometry": _free_name("geometry", layer.fields)})
    columns["geometry"] = geometry.geometry
    return _without_curves(gpd.GeoDataFrame(columns, geometry="geometry", crs=geometry.crs))


def _read_arrow(path: str, kind: str, layer: LayerInfo, **options: Any) -> Any:
    if kind == "ESRI Shapefile" and layer.encoding != "UTF-8":
        options["ENCODING"] = layer.encoding  # Arrow takes UTF-8 only, so GDAL has to convert
    exact = {"types_mapper": _EXACT.get}
    return pyogrio.read_dataframe(
        path, layer=layer.name, use_arrow=True, fid_as_index=True, arrow_to_pandas_kwargs=exact, **options
    )


def _read_parquet(readable: Path, file: Path) -> gpd.GeoDataFrame:
    if b"geo" not in (pq.read_schema(readable).metadata or {}):
        raise InputError(f"{file} is a Parquet file without geometry (GeoParquet names it in its metadata)")
    frame = gpd.read_parquet(readable, to_pandas_kwargs={"types_mapper": _EXACT.get})
    frame = frame.reset_index(drop=all(name is None for name in frame.index.names))
    if frame.geometry.name != "geometry":
        taken = {"geometry": _free_name("geometry", frame.columns)} if "geometry" in frame else {}
        frame = frame.rename(columns=taken).rename_geometry("geometry")
    frame.index.name = "fid"
    return frame


def _free_name(name: str, taken: Iterable[Any]) -> str:
    used = {str(each).casefold() for each in taken}
    return next(
        free for free in (f"{name}_{n}" for n in range(1, len(used) + 2)) if free.casefold() not in used
    )


def _plain_types(frame: Any) -> Any:
    """Use numpy's integers and booleans where there are no gaps; find text that is not UTF-8 now, not later."""
    for position, (name, dtype) in enumerate(frame.dtypes.items()):
        column = frame.iloc[:, position]
        if dtype in _EXACT.values() and not column.hasnans:
            frame[name] = column.astype(dtype.numpy_dtype)
        elif isinstance(dtype, pd.StringDtype):
            pa.chunked_array(pa.array(column)).validate(full=True)
    return frame


def _without_curves(frame: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Set geometries that hold curves inside a collection to None: nothing here can turn those into lines."""
    geometry = frame.geometry.to_numpy()
    collections = np.flatnonzero(shapely.get_type_id(geometry) >= _COLLECTION)
    curved = [
        row for row in collections if re.search("CURVE|CIRCULAR|SURFACE", shapely.to_wkt(geometry[row]))
    ]
    if curved:
        warnings.warn(
            f"{len(curved)} geometries hold curves inside a collection and are not read", stacklevel=2
        )
        frame = frame.copy()
        frame.iloc[curved, frame.columns.get_loc(frame.geometry.name)] = None
    return frame


def _declare_crs(frame: gpd.GeoDataFrame, file: Path) -> gpd.GeoDataFrame:
    crs = frame.crs
    if crs is None:
        return frame
    if crs.name.startswith("Undefined geographic"):  # a GeoPackage's word for no CRS
        return frame.set_crs(None, allow_override=True)
    if not is_local(crs):
        return frame
    if any(axis.unit_conversion_factor != 1 for axis in crs.axis_info):
        unit = crs.axis_info[0].unit_name
        raise CrsError(
            f"{file}: its plain coordinates are in {unit}; PolyMerge takes plain coordinates in metres only"
        )
    return frame.set_crs(LOCAL_CRS, allow_override=True)


@contextlib.contextmanager
def _gdal_speaks_of(file: Path, layer: str | None) -> Iterator[None]:
    """Turn what GDAL, Arrow and GEOS say into this module's errors and warnings, with the file's name."""
    where = f"{file}" if layer is None else f"{file}: layer {layer}"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            yield
        except (InputError, CrsError):
            raise
        except _READ_ERRORS as error:
            what = " ".join(str(error).split()).split(";")[0]
            raise InputError(f"{where} cannot be read, it is damaged or not complete ({what})") from error
    said: dict[str, int] = {}
    for warning in caught:
        if issubclass(warning.category, (RuntimeWarning, UserWarning)):
            said[str(warning.message)] = said.get(str(warning.message), 0) + 1
    for text in said:
        if "non conformant file extension" not in text:
            _warn(text if text.startswith(str(file)) else f"{where}: {' '.join(text.split())}")


def _warn(message: str) -> None:
    warnings.warn(message, LayerWarning, stacklevel=3)


# -- writing ---------------------------------------------------------------------------------------


def write_layers(
    path: str | os.PathLike[str],
    layers: Mapping[str, gpd.GeoDataFrame | pd.DataFrame],
    *,
    overwrite: bool = False,
    inputs: Iterable[str | os.PathLike[str]] = (),
    tables_path: str | os.PathLike[str] | None = None,
    geometry_types: Mapping[str, str] | None = None,
) -> Written:
    """Write layers and tables, all of them or none.

    Parameters
    ----------
    path : path
        The output; its extension (.gpkg, .shp, .geojson, .fgb, .parquet) says the format. A GeoPackage takes
        everything. Of the others, which hold one layer, the main layer (``elements``, else the first) goes to
        `path`, ``elements_areas`` to ``<stem>_areas.<ext>``, another one to ``<stem>_<layer>.<ext>``, and the
        tables to the GeoPackage ``<stem>_tables.gpkg``.
    layers : mapping of str to GeoDataFrame or DataFrame
        By layer name. The index is not written.
    overwrite : bool, default False
        Whether existing files are replaced, as a whole.
    inputs : iterable of path, optional
        Files that must not be written to.
    tables_path : path, optional
        Another GeoPackage for the tables.
    geometry_types : mapping of str to str, optional
        The type of a layer that may be empty; ``LineString`` by default.

    Returns
    -------
    Written
        The files, and the columns that had to be renamed.

    Raises
    ------
    OutputError
        If a file cannot be written, or the format cannot hold what a layer holds. Nothing has changed then.

    Notes
    -----
    Columns whose names differ in case only, or are ``fid``, ``geom`` or ``geometry``, are renamed. Lists and
    dictionaries become JSON text, bytes hexadecimal text, dates with a time ISO text where the format
    (Shapefile) has none. GDAL's formats keep times to the millisecond.
    """
    with StagedOutputs(overwrite=overwrite, inputs=[split_source(each)[0] for each in inputs]) as outputs:
        return stage_layers(outputs, path, layers, tables_path=tables_path, geometry_types=geometry_types)


def stage_layers(
    outputs: StagedOutputs,
    path: str | os.PathLike[str],
    layers: Mapping[str, gpd.GeoDataFrame | pd.DataFrame],
    *,
    tables_path: str | os.PathLike[str] | None = None,
    geometry_types: Mapping[str, str] | None = None,
) -> Written:
    """Write layers among other outputs that are to appear with them.

    Parameters
    ----------
    outputs : StagedOutputs
        The open outputs of the run.
    path, layers, tables_path, geometry_types
        As in `write_layers`.

    Returns
    -------
    Written
        As for `write_layers`; the files are there when `outputs` closes.

    Raises
    ------
    OutputError
        As for `write_layers`.
    """
    targets = layer_targets(path, layers, tables_path=tables_path)
    staged: dict[Path, Path] = {}
    renamed: dict[str, dict[str, str]] = {}
    with _repeatable_gdal():
        for name, frame in layers.items():
            target = targets[name]
            kind = FORMATS[target.suffix.lower()]
            fitted, renames = _fit(frame, kind, f"{target}: layer {name}")
            if renames:
                renamed[name] = renames
            first = target not in staged
            if first:
                staged[target] = outputs.stage(target)
            _write_one(
                fitted,
                staged[target],
                target,
                kind,
                name,
                (geometry_types or {}).get(name, "LineString"),
                first=first,
            )
    for target, temporary in staged.items():
        here = {name: len(frame) for name, frame in layers.items() if targets[name] == target}
        _verify(temporary, target, here)
    return Written(list(staged), renamed)


def layer_targets(
    path: str | os.PathLike[str],
    layers: Mapping[str, gpd.GeoDataFrame | pd.DataFrame],
    *,
    tables_path: str | os.PathLike[str] | None = None,
) -> dict[str, Path]:
    """Say which file each layer goes to.

    Parameters
    ----------
    path, layers, tables_path
        As in `write_layers`.

    Returns
    -------
    dict of str to Path
        By layer name.

    Raises
    ------
    OutputError
        If the extension is none of `FORMATS`, or there is nothing to write to `path`.
    """
    target = Path(path)
    if target.suffix.lower() not in FORMATS:
        raise OutputError(f"{target}: the extension must be one of {', '.join(FORMATS)}")
    if tables_path is not None and Path(tables_path).suffix.lower() != ".gpkg":
        raise OutputError(
            f"{tables_path}: tables are written to a GeoPackage; name a file that ends in .gpkg"
        )
    whole = FORMATS[target.suffix.lower()] == "GPKG"
    beside = Path(tables_path) if tables_path is not None else target.with_name(f"{target.stem}_tables.gpkg")
    spatial = [name for name, frame in layers.items() if isinstance(frame, gpd.GeoDataFrame)]
    if not spatial and not (whole and layers):
        raise OutputError(f"{target}: there is no layer to write to it")
    main = ELEMENTS_LAYER if ELEMENTS_LAYER in spatial else next(iter(spatial), "")
    targets = {}
    for name in layers:
        _check_layer_name(name, target, whole=whole)
        if name not in spatial:
            targets[name] = target if whole and tables_path is None else beside
        elif whole or name == main:
            targets[name] = target
        else:
            targets[name] = target.with_name(f"{target.stem}_{name.removeprefix(main + '_')}{target.suffix}")
    return targets


def _check_layer_name(name: str, target: Path, *, whole: bool) -> None:
    if not name or re.match(r"gpkg|rtree|sqlite", name, re.IGNORECASE):
        raise OutputError(
            f"{target}: a layer cannot be called {name!r}; GeoPackage keeps that name for itself"
        )
    if not name.isprintable() or not (whole or re.fullmatch(r"[^/\\:]+", name)):
        raise OutputError(f"{target}: a layer cannot be called {name!r}; use letters, digits and spaces")


@contextlib.contextmanager
def _repeatable_gdal() -> Iterator[None]:
    """Let GDAL write a fixed time instead of today's, so that equal layers give equal files."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    moment = time.gmtime(int(epoch) if epoch.isdecimal() else 946_684_800)  # 2000-01-01
    before = pyogrio.get_gdal_config_option("OGR_CURRENT_DATE")
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": time.strftime("%Y-%m-%dT%H:%M:%S.000Z", moment)})
    try:
        yield
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": before})


def _write_one(
    frame: Any, temporary: Path, target: Path, kind: str, name: str, empty_type: str, *, first: bool
) -> None:
    if any(mark in str(temporary) for mark in "!;") and kind != "Parquet":
        raise OutputError(f"{target}: a path with ! or ; in it cannot be written; name another output")
    spatial = isinstance(frame, gpd.GeoDataFrame)
    geometry_type = None
    if spatial:
        frame, geometry_type = _one_type(frame, kind, empty_type, f"{target}: layer {name}")
    options: dict[str, Any] = {"layer": name, "driver": kind, "use_arrow": True, "promote_to_multi": False}
    options |= {"geometry_type": geometry_type, **_driver_options(kind, first=first, spatial=spatial)}
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            if kind == "Parquet":
                frame.to_parquet(temporary, index=False)
            else:
                pyogrio.write_dataframe(frame, temporary, **options)
    except (*_READ_ERRORS, TypeError, OverflowError) as error:
        said = _no_room(temporary.parent) or error
        if isinstance(said, pyogrio.errors.DataSourceError | pyogrio.errors.DataLayerError):
            said = OutputError(f"{said}; the disk may be full")
        raise write_error(said, target) from error
    texts = {str(each.message) for each in caught if issubclass(each.category, (RuntimeWarning, UserWarning))}
    for text in sorted(text for text in texts if "'crs' was not provided" not in text):
        _warn(f"{target}: layer {name}: {' '.join(text.split())}")


def _no_room(folder: Path) -> OSError | None:
    """Find out whether a write failed for want of room, of which drivers speak in many ways or not at all."""
    largest = max((path.stat().st_size for path in folder.iterdir() if path.is_file()), default=0)
    try:
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(bytes(_ROOM_BYTES))
            probe.flush()
            probe.truncate(largest + _ROOM_BYTES)
    except OSError as error:
        return error
    return None


def _driver_options(kind: str, *, first: bool, spatial: bool) -> dict[str, Any]:
    if kind == "ESRI Shapefile":
        # dBase has a date of its own, which does not follow GDAL's.
        day = pyogrio.get_gdal_config_option("OGR_CURRENT_DATE")[:10]
        return {"layer_options": {"DBF_DATE_LAST_UPDATE": day, "ENCODING": "UTF-8", "2GB_LIMIT": "YES"}}
    if kind == "GPKG":
        options: dict[str, Any] = {"dataset_options": {"VERSION": "1.3"}} if first else {}
        if spatial:
            options["layer_options"] = {"GEOMETRY_NAME": "geom", "FID": "fid"}
        return options
    return {}


def _one_type(
    frame: gpd.GeoDataFrame, kind: str, empty_type: str, where: str
) -> tuple[gpd.GeoDataFrame, str]:
    """Bring the geometries to one type, and the CRS to one that the format can say."""
    if kind == "GeoJSON" and (frame.crs is None or is_local(frame.crs) or frame.crs.to_authority() is None):
        said = (
            "plain coordinates" if frame.crs is None or is_local(frame.crs) else f"the CRS {frame.crs.name}"
        )
        raise OutputError(
            f"{where}: GeoJSON cannot say that it has {said}; use GeoPackage, or another output CRS"
        )
    geometry = frame.geometry.to_numpy()
    if kind == "FlatGeobuf" and shapely.is_missing(geometry).any():
        raise OutputError(f"{where}: FlatGeobuf cannot hold a feature without geometry; use GeoPackage")
    if getattr(shapely, "has_m", shapely.is_missing)(geometry[~shapely.is_missing(geometry)]).any():
        _warn(f"{where}: M values are not written")
        # force_3d would set the heights of ZM geometries to 0.
        flat = shapely.force_2d(geometry)
        high = shapely.from_wkb(shapely.to_wkb(geometry, output_dimension=3, flavor="iso"))
        geometry = np.where(shapely.has_z(geometry), high, flat)
    there = geometry[~(shapely.is_missing(geometry) | shapely.is_empty(geometry))]
    types = {str(name).replace("LinearRing", "LineString") for name in gpd.GeoSeries(there).geom_type}
    singles = {name.removeprefix("Multi") for name in types}
    if len(types) > 1 and len(singles) == 1:
        geometry, types = _as_multi(geometry), {f"Multi{next(iter(singles))}"}
    has_z = shapely.has_z(there)
    if kind in {"FlatGeobuf", "ESRI Shapefile"}:
        if len(types) > 1:
            raise OutputError(
                f"{where} mixes {' and '.join(sorted(types))}; use GeoPackage, or write one kind a layer"
            )
        if has_z.any() and not has_z.all():
            raise OutputError(
                f"{where} mixes features with and without heights; use GeoPackage, which can hold both"
            )
    kept = "Unknown" if len(types) > 1 else next(iter(types), empty_type)
    if kept != "Unknown" and has_z.any():
        kept += " Z"
    return frame.set_geometry(gpd.GeoSeries(geometry, index=frame.index, crs=frame.crs)), kept


def _as_multi(geometry: Any) -> Any:
    multi = geometry.copy()
    makers = {1: shapely.multilinestrings, 2: shapely.multilinestrings, 3: shapely.multipolygons}
    types = shapely.get_type_id(geometry)
    for type_id, make in makers.items():
        rows = np.flatnonzero(types == type_id)
        if len(rows):
            multi[rows] = make(geometry[rows], indices=np.arange(len(rows)))
    return multi


def _verify(temporary: Path, target: Path, features: Mapping[str, int]) -> None:
    """Open what was written and count it: a driver may close an unfinished file without a word."""
    kind = FORMATS[target.suffix.lower()]
    try:
        if kind == "Parquet":
            counts = dict.fromkeys(features, pq.read_metadata(temporary).num_rows)
        else:
            counts = {name: _count(temporary, kind, name) for name in features}
        if kind == "ESRI Shapefile":
            _check_shapefile(temporary, OutputError)
        if kind == "GPKG":
            with contextlib.closing(sqlite3.connect(f"{temporary.as_uri()}?mode=ro", uri=True)) as database:
                damage = database.execute("PRAGMA integrity_check(1)").fetchone()[0]
            if damage != "ok":
                counts = {}
    except (*_READ_ERRORS, sqlite3.DatabaseError, OutputError) as error:
        raise write_error(
            OutputError(f"it could not be read back, the disk may be full ({error})"), target
        ) from error
    if counts != features:
        raise write_error(
            OutputError("not all of it was there when it was read back, the disk may be full"), target
        )


def _count(temporary: Path, kind: str, name: str) -> int:
    path = _gdal_path(temporary, kind)
    if kind == "FlatGeobuf":  # says how many there should be; only reading tells how many there are
        return len(pyogrio.read_dataframe(path, columns=[], read_geometry=False, fid_as_index=True))
    layer = name if kind == "GPKG" else None
    return int(pyogrio.read_info(path, layer=layer, force_feature_count=True)["features"])


# -- columns that every format can hold ------------------------------------------------------------


def _fit(frame: Any, kind: str, where: str) -> tuple[Any, dict[str, str]]:
    """Give the columns names and types that the format can hold; the input is not changed."""
    spatial = isinstance(frame, gpd.GeoDataFrame)
    geometry: Any = frame.geometry if spatial else None
    places = [n for n, name in enumerate(frame.columns) if not (spatial and name == geometry.name)]
    old = [str(frame.columns[n]) for n in places]
    new = _fit_names(old, kind, where)
    values = {
        name: _fit_values(frame.iloc[:, n].reset_index(drop=True), kind, f"{where}, column {title}")
        for name, title, n in zip(new, old, places, strict=True)
    }
    fitted = pd.DataFrame(values, index=pd.RangeIndex(len(frame)))
    renamed = {title: name for title, name in zip(old, new, strict=True) if title != name}
    if not spatial:
        return fitted, renamed
    return gpd.GeoDataFrame(fitted, geometry=geometry.to_numpy(), crs=frame.crs), renamed


def _fit_names(names: Sequence[str], kind: str, where: str) -> list[str]:
    limit = 10 if kind == "ESRI Shapefile" else None
    fitted: list[str] = []
    used = {"fid", "geom", "geometry"}
    # The names that can stay keep theirs, wherever they stand.
    plain = [SHAPEFILE_NAMES.get(name, name) if limit else name for name in names]
    for name in plain:
        if "\0" in name or not _encodable(name):
            raise OutputError(
                f"{where}: the column name {name!r} holds characters that no file can; rename it"
            )
    for name in plain:
        free = _shorten(name, limit) or "field"
        number = 0
        while free.casefold() in used:
            number += 1
            ending = f"_{number}"
            free = _shorten(name or "field", limit and limit - len(ending)) + ending
        used.add(free.casefold())
        fitted.append(free)
    return fitted


def _shorten(name: str, limit: int | None) -> str:
    return name if limit is None else name.encode()[:limit].decode(errors="ignore")


def _encodable(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _fit_values(column: Any, kind: str, where: str) -> Any:
    dtype = column.dtype
    if isinstance(dtype, gpd.array.GeometryDtype):
        column = pd.Series(shapely.to_wkt(column.to_numpy(), rounding_precision=-1))
    elif isinstance(dtype, pd.ArrowDtype):
        column = pd.Series(pa.array(column).to_pandas(types_mapper=_EXACT.get))
    elif isinstance(dtype, pd.CategoricalDtype):
        column = column.astype(object)
    if isinstance(column.dtype, pd.SparseDtype):
        column = column.sparse.to_dense()
    if column.dtype == object:
        column = _fit_objects(column)
    if pd.api.types.is_datetime64_any_dtype(column.dtype):
        return _fit_times(column, kind, where)
    if pd.api.types.is_integer_dtype(column.dtype):
        return _fit_integers(column, kind, where)
    if pd.api.types.is_string_dtype(column.dtype) or column.dtype == object:
        _check_text(column, kind, where)
        return column
    if pd.api.types.is_bool_dtype(column.dtype) or pd.api.types.is_float_dtype(column.dtype):
        return column
    return column.astype(object).map(_as_text, na_action="ignore")  # durations, periods, complex numbers


def _fit_objects(column: Any) -> Any:
    """Give a column of Python objects one type; text where it has none."""
    held = pd.api.types.infer_dtype(column, skipna=True)
    exact = {"integer": "Int64", "boolean": "boolean", "floating": "Float64"}
    if held in exact:
        try:
            fitted = column.astype(exact[held])
        except (OverflowError, TypeError, ValueError):
            return column.map(_as_text, na_action="ignore")
        return fitted.astype(float) if held == "floating" else fitted
    if held in {"string", "date", "datetime", "empty"} and not column.map(type).eq(bytes).any():
        return column
    return column.map(_as_text, na_action="ignore")


def _as_text(value: Any) -> str | None:
    if isinstance(value, str):
        return value
    if isinstance(value, (bytes, bytearray, memoryview)):
        return bytes(value).hex()
    if isinstance(value, (dict, list, tuple, set, frozenset, np.ndarray)):
        return json.dumps(value, default=_for_json, ensure_ascii=False)
    if isinstance(value, (datetime, date, clock_time, pd.Timedelta)):
        return str(value.isoformat())
    return str(value)


def _for_json(value: Any) -> Any:
    if isinstance(value, (set, frozenset)):
        return sorted(value, key=str)
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    return _as_text(value)


def _fit_times(column: Any, kind: str, where: str) -> Any:
    if kind == "ESRI Shapefile":
        return column.map(_as_text, na_action="ignore")
    fine = column.dt.floor("ms")
    if kind != "Parquet" and (fine != column)[column.notna()].any():
        _warn(f"{where}: times are kept to the millisecond only")
    return column


def _fit_integers(column: Any, kind: str, where: str) -> Any:
    limit = 10**18 if kind == "ESRI Shapefile" else 2**63
    held = column.dropna()
    low, high = (int(held.min()), int(held.max())) if len(held) else (0, 0)
    if kind != "Parquet" and (
        high >= limit or low < -limit or (kind == "ESRI Shapefile" and low <= -(limit // 10))
    ):
        raise OutputError(
            f"{where}: {high if high >= limit else low} is too long a number for {kind}; make it text"
        )
    return column


def _check_text(column: Any, kind: str, where: str) -> None:
    if pd.api.types.infer_dtype(column, skipna=True) in {"date", "datetime", "empty"}:
        return
    try:
        text = pa.array(column, type=pa.large_string(), from_pandas=True)
    except UnicodeEncodeError:
        row = next(n for n, value in enumerate(column) if isinstance(value, str) and not _encodable(value))
        raise OutputError(
            f"{where}, row {row}: text with half a character in it (a lone surrogate) cannot be written"
        ) from None
    nul = pc.index(pc.match_substring(text, "\0"), True).as_py()
    if nul >= 0:
        raise OutputError(f"{where}, row {nul}: text with a NUL character would be cut there; remove it")
    if kind == "ESRI Shapefile" and len(text):
        sizes = pc.binary_length(text)
        if (pc.max(sizes).as_py() or 0) > _SHAPEFILE_TEXT_BYTES:
            row = pc.index(pc.greater(sizes, _SHAPEFILE_TEXT_BYTES), True).as_py()
            raise OutputError(
                f"{where}, row {row}: Shapefile cuts text at {_SHAPEFILE_TEXT_BYTES} bytes; use GeoPackage"
            )
