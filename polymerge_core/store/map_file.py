"""The file of a stored map: made, read and written so that it is always the old map or the new one.

The journal is SQLite's rollback journal: between two updates the map is one file, which may be copied. A file that
somebody else has switched to a write-ahead log stays so, and is as safe.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path

from polymerge_core.errors import InputError, OutputError
from polymerge_core.store.geopackage import Connection, connect, is_empty, transaction

#: Seconds to wait for somebody else who has the file locked.
PATIENCE_S = 10.0


class MapFile:
    """The file of a stored map.

    Parameters
    ----------
    path : Path
        Where it is.
    create : bool
        Whether to make it where there is none. Once there was a map it is not made again.
    patience_s : float
        Seconds to wait for another program that has it locked.
    """

    def __init__(self, path: Path, *, create: bool, patience_s: float) -> None:
        self._path, self._create, self._patience_s = path, create, patience_s

    def is_there(self) -> bool:
        """Tell whether there is a map; False means that one may be made.

        Raises
        ------
        InputError
            If there is none, and none may be made.
        """
        path = self._path
        with _told(path, self._patience_s):
            there = path.exists() and path.stat().st_size > 0
            if there and self._create and _journal(path).exists():
                # Of a map that was being made nothing is left when its killed writer is rolled back.
                with contextlib.closing(self._connected()) as connection:
                    there = not is_empty(connection)
        if not there and not self._create:
            raise InputError(f"{path} does not exist; the first update makes a map, with create (update --create)")
        self._create = not there
        return there

    @contextlib.contextmanager
    def reading(self) -> Iterator[Connection]:
        """Give the file, to read."""
        with _told(self._path, self._patience_s), contextlib.closing(self._connected()) as connection:
            yield connection

    @contextlib.contextmanager
    def writing(self) -> Iterator[Connection]:
        """Give the file within a transaction; a new file is gone again where anything fails."""
        new = not self.is_there()
        try:
            with _told(self._path, self._patience_s, writing=True):
                if new:
                    self._path.touch()
                opened = _identity(self._path)
                with contextlib.closing(self._connected()) as connection, transaction(connection):
                    if _identity(self._path) != opened:
                        # What is written to a file without a name is lost.
                        raise FileNotFoundError("it was replaced meanwhile")  # noqa: TRY301 - as the system tells it
                    yield connection
        except BaseException:
            if new:
                self._clear_away()
            raise
        self._create = False

    def _connected(self) -> Connection:
        return connect(self._path, self._patience_s)

    def _clear_away(self) -> None:
        """Remove a file that no map came of, unless somebody else is making one in it."""
        with contextlib.suppress(sqlite3.Error, OSError), contextlib.closing(connect(self._path, 0.0)) as alone:
            alone.execute("BEGIN EXCLUSIVE")
            if is_empty(alone):
                self._path.unlink()


def _journal(path: Path) -> Path:
    """Return where SQLite keeps what it needs to undo an update."""
    real = path.resolve()
    return real.with_name(f"{real.name}-journal")


def _identity(path: Path) -> tuple[int, int]:
    """Return what tells a file from another one of the same name."""
    found = path.stat()
    return found.st_dev, found.st_ino


@contextlib.contextmanager
def _told(path: Path, patience_s: float, *, writing: bool = False) -> Iterator[None]:
    """Tell what SQLite and the system have to say in the user's words."""
    kind = OutputError if writing else InputError
    whole = "; the map is as it was" if writing else ""
    try:
        yield
    except sqlite3.Error as error:
        raise kind(_explained(path, str(error), patience_s, writing=writing) + whole) from error
    except UnicodeDecodeError as error:
        raise kind(f"{path} is damaged: it holds text that is none; restore it from a copy{whole}") from error
    except OSError as error:
        why = error.strerror or error
        raise kind(f"{path} cannot be opened; check the folder and its permissions ({why}){whole}") from error


def _explained(path: Path, message: str, patience_s: float, *, writing: bool) -> str:
    locked = f"{path} is locked by another program (waited {patience_s:g} s); try again when that is done"
    read_only = (
        f"{path} cannot be written; check the permissions of file and folder"
        if writing
        else f"{path} was left in the middle of an update; make file and folder writable, so that it can be undone"
    )
    known = {
        "database is locked": locked,
        "database or disk is full": f"{path}: the disk is full; make room and try again",
        "attempt to write a readonly database": read_only,
        "unable to open database file": f"{path} cannot be opened; check the folder and its permissions",
        "file is not a database": f"{path} is no GeoPackage",
        "database disk image is malformed": f"{path} is damaged; restore it from a copy",
        "disk I/O error": f"{path}: the disk cannot be read or written, or a file may not grow so large",
    }
    return known.get(message, f"{path}: {message}")
