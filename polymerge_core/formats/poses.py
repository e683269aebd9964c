"""Poses: where the vehicle was, and which way it faced, at each frame.

A CSV file has the columns ``timestamp_ns, qw, qx, qy, qz, tx_m, ty_m, tz_m`` (quaternion scalar first,
vehicle to world), optionally `token`, and for geodetic poses ``lat, lon, height_m, heading_deg``. A JSON file
is a list of ``{token, timestamp_ns, translation, rotation}``.
"""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from polymerge_core.errors import InputError
from polymerge_core.formats.records import Poses
from polymerge_core.formats.rotation import RIGID_TOLERANCE, is_rigid, quaternion_to_matrix
from polymerge_core.formats.strict_json import number_array, parse_json, require, require_key
from polymerge_core.formats.text import clean_name, read_text

Array = NDArray[np.float64]

_QUATERNION = ("qw", "qx", "qy", "qz")
_POSITION = ("tx_m", "ty_m")
_GEODETIC = ("lat", "lon")
_NUMBER = r"\s*[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?\s*"
_WHOLE = r"\s*[+-]?[0-9]+\s*"


def read_poses(path: str | os.PathLike[str]) -> Poses:
    """Read poses from CSV or JSON.

    Parameters
    ----------
    path : path-like
        CSV with the columns ``timestamp_ns, qw, qx, qy, qz, tx_m, ty_m, tz_m`` (the quaternion scalar first,
        vehicle to world; `tz_m` may be absent) and optionally `token`; or ``timestamp_ns, lat, lon`` in
        degrees on WGS 84 with `heading_deg`, clockwise from true north, or the quaternion as attitude in the
        local east-north-up frame, and optionally `height_m`. Further columns are ignored; commas, semicolons
        or tabs separate; where it is not commas, numbers may have a decimal comma. Or JSON: a list of objects
        with `token`, `timestamp_ns` (or nuScenes' `timestamp` in microseconds), `translation` ``[x, y]`` or
        ``[x, y, z]``, `rotation` (a quaternion, scalar first, or a 3x3 matrix), or `matrix`, the 4x4 of both;
        or `lat`, `lon`, `height_m`, `heading_deg` as above.

    Returns
    -------
    Poses
        Quaternions and matrices that are off by no more than rounding (1e-3) are made exact rotations.

    Raises
    ------
    InputError
        Naming file, row and column, where a column is missing, a value is no number, a quaternion is not of
        unit length, a matrix is not rigid, or a token or timestamp has two different poses.

    Notes
    -----
    Gaps and jumps between poses are taken as they are: a frame is placed by its own pose alone.
    nuScenes' `ego_pose.json` has tokens of its own; give the token of the sample instead.
    """
    where = os.fspath(path)
    text = read_text(path)
    return _from_json(text, where) if text.lstrip()[:1] in ("[", "{") else _from_csv(text, where)


# --- CSV ----------------------------------------------------------------------------------------------------


class _Table(NamedTuple):
    columns: dict[str, pd.Series[str]]
    rows: list[str]
    where: str

    def text(self, name: str) -> pd.Series[str]:
        if name not in self.columns:
            raise InputError(f"{self.where}: there is no column {name!r}; the columns are {', '.join(self.columns)}")
        return self.columns[name]

    def numbers(self, name: str) -> Array:
        column = self.text(name)
        bad = ~column.str.fullmatch(_NUMBER).to_numpy(dtype=bool)
        if bad.any():
            row = int(bad.argmax())
            hint = "; write it with a decimal point" if re.fullmatch(r"\s*[+-]?[0-9]+,[0-9]+\s*", column[row]) else ""
            raise InputError(f"{self.rows[row]}, column {name}: {column[row]!r} is not a number{hint}")
        return column.to_numpy(dtype=np.float64)

    def group(self, names: Sequence[str], optional: Sequence[str] = ()) -> Array | None:
        """Return columns side by side, zeros for missing optional ones; None where all of `names` miss."""
        if not any(name in self.columns for name in names):
            return None
        columns = [self.numbers(name) for name in names]
        columns += [self.numbers(name) if name in self.columns else np.zeros(len(self.rows)) for name in optional]
        return np.column_stack(columns)


def _from_csv(text: str, where: str) -> Poses:
    table = _read_table(text, where)
    stamps = table.text("timestamp_ns")
    bad = ~stamps.str.fullmatch(_WHOLE).to_numpy(dtype=bool)
    if bad.any():
        row = int(bad.argmax())
        raise InputError(f"{table.rows[row]}, column timestamp_ns: {stamps[row]!r} is not a whole number")
    tokens = None
    if "token" in table.columns:
        tokens = [clean_name(token.strip(), row) for token, row in zip(table.columns["token"], table.rows, strict=True)]
    geodetic = table.group(_GEODETIC, optional=("height_m",))
    heading = table.numbers("heading_deg") if "heading_deg" in table.columns else None
    translation = table.group(_POSITION, optional=("tz_m",))
    quaternion = table.group(_QUATERNION)
    if geodetic is None and translation is None:
        table.text(_POSITION[0])
    if quaternion is None and (heading is None or geodetic is None):
        table.text(_QUATERNION[0])
    rotation = None if quaternion is None else _from_quaternions(quaternion, table.rows)
    return _poses(
        table.rows,
        tokens,
        [int(stamp) for stamp in stamps],
        rotation,
        translation,
        geodetic,
        heading,
        where=where,
    )


def _read_table(text: str, where: str) -> _Table:
    """Split a CSV file into columns of text; each row keeps its line number for messages."""
    header_line = text.lstrip().split("\n", 1)[0]
    delimiter = max(",;\t", key=header_line.count)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
    records: list[list[str]] = []
    rows: list[str] = []
    try:
        for record in reader:
            if any(cell.strip() for cell in record):
                records.append(record)
                rows.append(f"{where}: line {reader.line_num}")
    except csv.Error as error:
        raise InputError(f"{where}: line {reader.line_num}: not valid CSV ({error})") from error
    header = [name.strip() for name in records[0]]
    repeated = sorted({name for name in header if header.count(name) > 1})
    if repeated:
        raise InputError(f"{where}: the column {repeated[0]!r} stands twice in the header; keep one of the two")
    for record, row in zip(records[1:], rows[1:], strict=True):
        if len(record) != len(header):
            raise InputError(
                f"{row}: {len(record)} values for {len(header)} columns; "
                "the line may be cut off, or have decimal commas: write numbers with a decimal point"
            )
    cells = pd.DataFrame(records[1:], columns=header, dtype="object")
    if delimiter != ",":  # where commas do not separate, a single one can only be a decimal comma
        cells = cells.apply(lambda column: column.str.replace(r"^(\s*[+-]?\d*),(\d+\S*\s*)$", r"\1.\2", regex=True))
    return _Table({name: cells[name] for name in header}, rows[1:], where)


# --- JSON ---------------------------------------------------------------------------------------------------


class _Entry(NamedTuple):
    token: str | None
    timestamp_ns: int
    rotation: Array | None
    translation: Array | None
    geodetic: Array | None
    heading: Array | None


def _from_json(text: str, where: str) -> Poses:
    return parse_poses(require(parse_json(text, where), list, f"{where}: the list of poses"), where)


def parse_poses(document: list[Any], where: str) -> Poses:
    """Read poses from the objects of a parsed JSON list.

    Parameters
    ----------
    document : list of dict
        ``{"token", "timestamp_ns", "translation", "rotation"}`` and the like.
    where : str
        The file, for messages.

    Raises
    ------
    InputError
        If an entry is no pose.
    """
    rows = [f"{where}: pose {number}" for number in range(len(document))]
    entries = [_entry(require(entry, dict, row), row) for entry, row in zip(document, rows, strict=True)]
    tokens = _all_or_none([entry.token for entry in entries], "token", rows)
    rotations = _all_or_none([entry.rotation for entry in entries], "rotation", rows)
    return _poses(
        rows,
        tokens,
        [entry.timestamp_ns for entry in entries],
        None if rotations is None else _from_mixed(rotations, rows),
        _stacked([entry.translation for entry in entries], "translation", rows, (3,)),
        _stacked([entry.geodetic for entry in entries], "lat and lon", rows, (3,)),
        _stacked([entry.heading for entry in entries], "heading_deg", rows, ()),
        where=where,
    )


def _entry(entry: dict[str, Any], row: str) -> _Entry:
    """Read one pose of a JSON list; rotations stay quaternions or matrices."""
    named = entry.get("token")
    if named is not None and (isinstance(named, bool) or not isinstance(named, str | int)):
        raise InputError(f"{row}: the token must be text, not {named!r}")
    token = None if named is None else clean_name(str(named), row)
    place = row if token is None else f"{row} (token {token!r})"
    rotation, translation = _rigid_motion(entry, place)
    geodetic = heading = None
    if "lat" in entry or "lon" in entry:
        values = [require_key(entry, key, place) for key in _GEODETIC] + [entry.get("height_m", 0.0)]
        geodetic = _shaped(values, ((3,),), f"{place}, lat, lon, height_m")
    if "heading_deg" in entry:
        heading = _shaped(entry["heading_deg"], ((),), f"{place}, heading_deg")
    if translation is None and geodetic is None:
        require_key(entry, "translation", place)
    if rotation is None and (heading is None or geodetic is None):
        require_key(entry, "rotation", place)
    return _Entry(token, _timestamp(entry, place), rotation, translation, geodetic, heading)


def _rigid_motion(entry: dict[str, Any], place: str) -> tuple[Array | None, Array | None]:
    """Return rotation (quaternion or 3x3) and translation, each None where the entry has none."""
    rotation = translation = None
    if "matrix" in entry:
        if "rotation" in entry or "translation" in entry:
            raise InputError(f"{place} has both 'matrix' and 'rotation' or 'translation'; keep one of the two")
        matrix = _shaped(entry["matrix"], ((4, 4),), f"{place}, matrix")
        if not np.allclose(matrix[3], (0, 0, 0, 1), rtol=0, atol=RIGID_TOLERANCE):
            raise InputError(f"{place}: the last row of the matrix must be 0, 0, 0, 1")
        rotation, translation = matrix[:3, :3], matrix[:3, 3]
    if "translation" in entry:
        given = _shaped(entry["translation"], ((2,), (3,)), f"{place}, translation")
        translation = np.append(given, 0.0)[:3]
    if "rotation" in entry:
        rotation = _shaped(entry["rotation"], ((4,), (3, 3)), f"{place}, rotation")
    return rotation, translation


def _timestamp(entry: dict[str, Any], place: str) -> int:
    """Return nanoseconds, exactly: a float could not hold them."""
    in_microseconds = "timestamp" in entry and "timestamp_ns" not in entry
    key = "timestamp" if in_microseconds else "timestamp_ns"
    stamp = require_key(entry, key, place)
    if isinstance(stamp, str) and re.fullmatch(_WHOLE, stamp):
        stamp = int(stamp)
    if isinstance(stamp, bool) or not isinstance(stamp, int):
        raise InputError(f"{place}: the {key} must be a whole number, not {stamp!r}")
    return stamp * (1000 if in_microseconds else 1)


def _shaped(value: Any, shapes: tuple[tuple[int, ...], ...], where: str) -> Array:
    array = number_array(value, where)
    if array.shape not in shapes:
        known = " or ".join("x".join(map(str, shape)) or "one" for shape in shapes)
        raise InputError(f"{where}: expected {known} numbers, found an array of shape {array.shape}")
    return array


def _all_or_none(values: list[Any], name: str, rows: Sequence[str]) -> list[Any] | None:
    """Return what all poses have, None where none has it; some with and some without is an error."""
    lacking = [row for row, value in zip(rows, values, strict=True) if value is None]
    if lacking and len(lacking) < len(values):
        raise InputError(f"{lacking[0]} has no {name}, although others in the file have one")
    return None if lacking else values


def _stacked(values: list[Array | None], name: str, rows: Sequence[str], width: tuple[int, ...]) -> Array | None:
    present = _all_or_none(values, name, rows)
    return None if present is None else np.array(present, dtype=np.float64).reshape(len(values), *width)


# --- checks of both -----------------------------------------------------------------------------------------


def _from_mixed(rotations: list[Array], rows: Sequence[str]) -> Array:
    """Turn a list of quaternions and 3x3 matrices into matrices."""
    are_matrices = np.array([rotation.ndim == 2 for rotation in rotations], dtype=bool)
    matrices = np.empty((len(rotations), 3, 3))
    for kind, read in ((True, _from_matrices), (False, _from_quaternions)):
        members = np.flatnonzero(are_matrices == kind)
        if len(members):
            matrices[members] = read(np.array([rotations[i] for i in members]), [rows[int(i)] for i in members])
    return matrices


def _from_quaternions(quaternions: Array, rows: Sequence[str]) -> Array:
    _require_finite(quaternions, "the quaternion", rows)
    length = np.linalg.norm(quaternions, axis=1)
    bad = np.abs(length - 1.0) > RIGID_TOLERANCE
    if bad.any():
        row = int(bad.argmax())
        raise InputError(
            f"{rows[row]}: the quaternion has length {length[row]:.6g}, not 1; give a unit quaternion, scalar first"
        )
    return quaternion_to_matrix(quaternions)


def _from_matrices(matrices: Array, rows: Sequence[str]) -> Array:
    _require_finite(matrices, "the matrix", rows)
    bad = ~is_rigid(matrices)
    if bad.any():
        raise InputError(
            f"{rows[int(bad.argmax())]}: the matrix is not a rotation (it scales, shears or mirrors); "
            "give a rigid vehicle-to-world matrix"
        )
    left, _, right = np.linalg.svd(matrices)
    nearest: Array = left @ right  # what rounding in the file took from the rotation
    return nearest


def _require_finite(values: Array, name: str, rows: Sequence[str]) -> None:
    bad = ~np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    if bad.any():
        raise InputError(f"{rows[int(bad.argmax())]}: {name} is not finite; leave the pose out or mend it")


def _poses(
    rows: Sequence[str],
    tokens: list[str] | None,
    timestamps: list[int],
    rotation: Array | None,
    translation: Array | None,
    geodetic: Array | None,
    heading: Array | None,
    *,
    where: str,
) -> Poses:
    limits = np.iinfo(np.int64)
    for stamp, row in zip(timestamps, rows, strict=True):
        if not limits.min <= stamp <= limits.max:
            raise InputError(f"{row}: the timestamp {stamp} does not fit 64 bits; give nanoseconds")
    for values, name in (
        (translation, "the translation"),
        (geodetic, "lat, lon or height_m"),
        (heading, "heading_deg"),
    ):
        if values is not None:
            _require_finite(values, name, rows)
    if geodetic is not None:
        bad = (np.abs(geodetic[:, 0]) > 90.0) | (np.abs(geodetic[:, 1]) > 360.0)
        if bad.any():
            first = int(bad.argmax())
            raise InputError(
                f"{rows[first]}: lat {geodetic[first, 0]:g}, lon {geodetic[first, 1]:g} are not degrees on "
                "Earth; check their order and units"
            )
    lat, lon, height_m = (None, None, None) if geodetic is None else geodetic.T.copy()
    return Poses(
        timestamp_ns=np.array(timestamps, dtype=np.int64),
        token=None if tokens is None else np.array(tokens, dtype=object),
        rotation=rotation,
        translation=translation,
        lat=lat,
        lon=lon,
        height_m=height_m,
        heading_deg=heading,
        source=where,
    )
