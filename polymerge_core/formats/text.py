"""Reading text that a stranger wrote: nothing in a file is ever run, unpacked or guessed at.

Predictors hand their results round as pickles, torch files and archives as often as JSON. Those are told
from their first bytes or their extension and refused with a sentence that says why and what to do instead.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

from polymerge_core.errors import InputError

#: Larger files are refused: parsed, they would fill the memory of most machines.
MAX_BYTES = 2 * 1024**3

_CONVERT = "convert it to JSON with the converter in the README, run in the environment of the predictor that wrote it"
_UNPACK = "unpack it and give the JSON or CSV file inside"


class _Refused(NamedTuple):
    reason: str
    remedy: str
    signatures: tuple[bytes, ...]
    extensions: frozenset[str]


_REFUSED = (
    _Refused(
        "is a pickle, and reading a pickle runs whatever code is in it",
        _CONVERT,
        (b"\x80", b"(dp", b"(lp", b"(d.", b"(l.", b"ccopy_reg", b"}q", b"]q"),
        frozenset({".pkl", ".pickle", ".p", ".joblib"}),
    ),
    _Refused(
        "is a torch file, which holds a pickle, and reading a pickle runs whatever code is in it",
        _CONVERT,
        (),
        frozenset({".pt", ".pth", ".ckpt"}),
    ),
    _Refused(
        "is a numpy file, which may hold pickled objects, and reading those runs whatever code is in them",
        _CONVERT,
        (b"\x93NUMPY",),
        frozenset({".npy", ".npz"}),
    ),
    _Refused(
        "is an archive: a small one can unpack to any size, and those that torch and numpy write hold "
        "pickles, which run code when they are read",
        _UNPACK + ", or, where it holds a pickle, " + _CONVERT,
        (b"PK\x03\x04", b"PK\x05\x06", b"7z\xbc\xaf\x27\x1c"),
        frozenset({".zip", ".7z", ".tar", ".tgz"}),
    ),
    _Refused(
        "is compressed, and a small compressed file can unpack to any size",
        _UNPACK,
        (b"\x1f\x8b", b"BZh", b"\xfd7zXZ\x00", b"\x28\xb5\x2f\xfd"),
        frozenset({".gz", ".bz2", ".xz", ".zst"}),
    ),
    _Refused(
        "is an Arrow or Parquet table, not text",
        "write it as CSV, for example with pandas.read_feather(...).to_csv(..., index=False)",
        (b"ARROW1", b"FEA1", b"PAR1"),
        frozenset({".feather", ".parquet", ".arrow"}),
    ),
)


def read_text(path: str | os.PathLike[str]) -> str:
    """Read a whole text file, UTF-8 with or without a byte order mark.

    Parameters
    ----------
    path : path-like
        A file on this machine.

    Returns
    -------
    str
        Its text; line ends are left as they are.

    Raises
    ------
    InputError
        If the file cannot be read, is larger than `MAX_BYTES`, is empty, is not UTF-8, or is a pickle, a
        torch or numpy file, an archive or any other form whose reading could run code or unpack without end.
    """
    path = Path(path)
    content = _read_bytes(path)
    refuse_unsafe(path, content[:8])
    if not content.strip():
        raise InputError(f"{path}: the file is empty; check the program that wrote it")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: byte {error.start} is not UTF-8; save the file as UTF-8 text") from error


def refuse_unsafe(path: Path, head: bytes) -> None:
    """Raise `InputError` where a file's first bytes or its extension say that it must not be read."""
    by_content = [kind for kind in _REFUSED if head.startswith(kind.signatures)]
    by_name = [kind for kind in _REFUSED if path.suffix.lower() in kind.extensions]
    for kind in by_content + by_name:
        raise InputError(f"{path}: this {kind.reason}; {kind.remedy}")


def clean_name(name: str, where: str) -> str:
    """Return a token or class name, refused where a layer could not hold it.

    Parameters
    ----------
    name : str
        The text as it came.
    where : str
        File and place, for the message.

    Raises
    ------
    InputError
        If it is empty, holds a NUL (GDAL would cut it there) or a lone surrogate (it has no UTF-8 form).
    """
    if not name or "\0" in name or any("\ud800" <= character <= "\udfff" for character in name):
        raise InputError(f"{where}: the name {name!r} is empty or holds a character that no layer can store")
    return name


def _read_bytes(path: Path) -> bytes:
    try:
        if path.is_dir():
            raise InputError(f"{path}: this is a folder; give a file in it")
        if not path.is_file():
            raise InputError(f"{path}: there is no such file")
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise InputError(
                f"{path}: the file is {size / 1024**3:.1f} GiB, the limit is {MAX_BYTES / 1024**3:g} GiB; "
                "split it by frames and merge the parts one after the other"
            )
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: the file cannot be read ({error.strerror or error})") from error
