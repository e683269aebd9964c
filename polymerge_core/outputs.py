"""Safe writes: outputs appear whole and together, or not at all.

Every output is written to a private temporary directory in its own folder, and moved into place at the very
end. A crash, a full disk or an interrupt leaves the old files as they were. The one limit: where a run has
several files (the parts of a Shapefile, a map and its report) they are moved one right after the other, so a
power cut between two of these moves can leave new files beside old ones, each of them whole.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import platform
import re
import shutil
import signal
import stat
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

from polymerge_core.errors import OutputError

#: What lies beside a ``.shp`` and belongs to it: its own parts, and indexes that a new one makes wrong.
SHAPEFILE_PARTS = (".shx", ".dbf", ".prj", ".cpg")
_SHAPEFILE_INDEXES = (".qix", ".sbn", ".sbx", ".qpj", ".idm", ".ind", ".fbn", ".fbx", ".ain", ".aih", ".ixs")

_NO_SPACE = {errno.ENOSPC, errno.EFBIG, errno.EDQUOT} if hasattr(errno, "EDQUOT") else {errno.ENOSPC, errno.EFBIG}
_TEMPORARY = re.compile(r"\.polymerge-(?P<host>[0-9a-f]{8})-(?P<pid>\d+)-")
_FOREIGN_TEMPORARY_SECONDS = 7 * 24 * 3600


class StagedOutputs:
    """Outputs of one run, which appear together when the ``with`` block ends without an error.

    Parameters
    ----------
    overwrite : bool, default False
        Whether existing outputs may be replaced.
    inputs : iterable of path, optional
        Files that the run reads. They are never replaced, whatever `overwrite` says.

    Raises
    ------
    OutputError
        On leaving the block, if the disk is full or a file cannot be moved into place. No output has changed
        then.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     target = Path(folder, "report.json")
    ...     with StagedOutputs() as outputs:
    ...         _ = outputs.stage(target).write_text("{}")
    ...     target.read_text()
    '{}'
    """

    def __init__(self, *, overwrite: bool = False, inputs: Iterable[str | os.PathLike[str]] = ()) -> None:
        self._overwrite = overwrite
        self._inputs = [part for path in inputs for part in _parts(Path(path))]
        self._staged: dict[Path, Path] = {}
        self._directories: dict[Path, Path] = {}
        self._size_limit_handler: Any = None

    def check(self, targets: Iterable[str | os.PathLike[str]]) -> None:
        """Refuse outputs that could not be written at the end, before any work is done.

        Parameters
        ----------
        targets : iterable of path
            All outputs of the run.

        Raises
        ------
        OutputError
            If a target exists and `overwrite` was not given, is an input or a folder, is named twice, is open
            in another program, or its folder is missing or cannot be written to.
        """
        seen: dict[Path, Path] = {}
        for given in targets:
            target = _resolve(given)
            self._check_one(target, seen)
            if target.parent not in self._directories:
                _make_directory(target.parent).rmdir()
            seen[target] = target

    def stage(self, target: str | os.PathLike[str]) -> Path:
        """Return the temporary path to write an output to.

        Parameters
        ----------
        target : path
            Where the output is to be in the end. A symbolic link is followed.

        Returns
        -------
        Path
            A path of the same file name, in a private directory in the target's folder.

        Raises
        ------
        OutputError
            As for `check`.
        """
        resolved = _resolve(target)
        self._check_one(resolved, self._staged)
        folder = resolved.parent
        if folder not in self._directories:
            _remove_leftovers(folder)
            with _interrupts_held():
                self._directories[folder] = _make_directory(folder)
        self._staged[resolved] = self._directories[folder] / resolved.name
        return self._staged[resolved]

    def __enter__(self) -> StagedOutputs:  # noqa: PYI034 - typing.Self is newer than Python 3.10
        # A file size limit must raise EFBIG, which can be reported, rather than end the process.
        if hasattr(signal, "SIGXFSZ") and threading.current_thread() is threading.main_thread():
            self._size_limit_handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                self._commit()
        except OSError as failure:
            raise write_error(failure, next(iter(self._staged), None)) from failure
        finally:
            with _interrupts_held():
                for directory in self._directories.values():
                    # The outputs are safe by now; what cannot be removed is removed by the next run.
                    shutil.rmtree(directory, ignore_errors=True)
                self._directories.clear()
                if self._size_limit_handler is not None:
                    signal.signal(signal.SIGXFSZ, self._size_limit_handler)
        if isinstance(error, OSError) and error.errno in _NO_SPACE:
            raise write_error(error, next(iter(self._staged), None)) from error

    def _check_one(self, target: Path, others: Iterable[Path]) -> None:
        try:
            _check_place(target)
            self._check_not_input(target)
            for other in others:
                if not {*_parts(target)}.isdisjoint(_parts(other)):
                    raise OutputError(
                        f"{target}: two outputs would be written to this file; name another for one of them"
                    )
            self._check_replaceable(target)
        except OSError as error:
            raise OutputError(f"{target} cannot be written: {error.strerror}") from error

    def _check_not_input(self, target: Path) -> None:
        for part in _parts(target):
            for source in self._inputs:
                if _same_file(part, source):
                    raise OutputError(f"{target} is an input of this run ({source}): name another output")

    def _check_replaceable(self, target: Path) -> None:
        for part in filter(Path.exists, _parts(target)):
            if not self._overwrite:
                raise OutputError(
                    f"{part} exists: overwrite it (--overwrite, or overwrite=True), or name another output"
                )
            if not os.access(part, os.W_OK):
                raise OutputError(f"{part} is read-only: make it writable, or name another output")
        if target.suffix.lower() != ".gpkg":
            return
        for suffix in ("-wal", "-journal"):
            log = target.with_name(target.name + suffix)
            if log.exists() and (suffix == "-wal" or log.stat().st_size > 0):
                raise OutputError(
                    f"{target} is open in another program, or a program crashed with it ({log.name} is "
                    "there): close it there, or open it once with that program, or name another output"
                )

    def _commit(self) -> None:
        moves = list(self._moves())
        for source, target in moves:
            if source is not None:
                if target.exists():
                    shutil.copymode(target, source)
                _sync(source)
        with _interrupts_held() as interrupted:
            backups: list[tuple[Path, Path | None]] = []
            try:
                for source, target in moves:
                    backups.append((target, self._back_up(target)))
                    _move(source, target)
                for folder in self._directories:
                    _sync(folder)
                _stop_if(interrupted())
            except BaseException:
                for target, backup in reversed(backups):
                    _move(backup, target)
                raise

    def _moves(self) -> Iterator[tuple[Path | None, Path]]:
        """Yield what goes where; nothing goes where an old part has no successor."""
        for target, staged in self._staged.items():
            if not staged.exists():
                raise OutputError(f"{target} was not written")
            for part in _parts(target):
                source = staged.with_name(part.name)
                if source.exists():
                    yield source, part
                elif part.exists():
                    yield None, part

    def _back_up(self, target: Path) -> Path | None:
        if not target.exists():
            return None
        backup = Path(tempfile.mkdtemp(dir=self._directories[target.parent]), target.name)
        try:
            os.link(target, backup)
        except OSError:  # a file system without hard links
            shutil.copy2(target, backup)
        return backup


def write_error(error: BaseException, target: Path | None) -> OutputError:
    """Say in one sentence why an output could not be written.

    Parameters
    ----------
    error : exception
        What the operating system or the file's driver said.
    target : Path, optional
        The output, for the message.

    Returns
    -------
    OutputError
        To be raised from `error`.
    """
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    text = " ".join(reason.split())
    full = isinstance(error, OSError) and error.errno in _NO_SPACE
    if full or re.search(r"disk (is )?full|no space left|file too large|quota exceeded", text, re.IGNORECASE):
        return OutputError(
            f"{target} cannot be written: disk full, or a file size limit or quota was reached; free some "
            "space or name an output elsewhere (existing files were left as they were)"
        )
    return OutputError(f"{target} cannot be written: {text} (existing files were left as they were)")


def _parts(target: Path) -> list[Path]:
    """Return the files that make up a data set."""
    if target.suffix.lower() != ".shp":
        return [target]
    beside = (*SHAPEFILE_PARTS, *_SHAPEFILE_INDEXES)
    return [target, *(target.with_suffix(suffix) for suffix in beside), *_upper_case_parts(target, beside)]


def _upper_case_parts(target: Path, beside: Iterable[str]) -> Iterator[Path]:
    for suffix in beside:
        part = target.with_suffix(suffix.upper())
        # Where upper and lower case are one file it is in the list already.
        if part.exists() and not target.with_suffix(suffix).exists():
            yield part


def _resolve(target: str | os.PathLike[str]) -> Path:
    try:
        return Path(target).resolve()
    except (OSError, ValueError, RuntimeError) as error:
        raise OutputError(f"{os.fspath(target)!r} is not a path that can be written to: {error}") from error


def _check_place(target: Path) -> None:
    folder = target.parent
    if not folder.exists():
        raise OutputError(f"{target} cannot be written: the folder {folder} does not exist; create it first")
    if not folder.is_dir():
        raise OutputError(f"{target} cannot be written: {folder} is a file, not a folder")
    if target.is_dir():
        raise OutputError(f"{target} is a folder: name a file in it")
    if target.exists() and not stat.S_ISREG(target.stat().st_mode):
        raise OutputError(f"{target} is a device or a pipe, not a file: name a file")


def _same_file(one: Path, other: Path) -> bool:
    with contextlib.suppress(OSError, RuntimeError):  # a loop of links is no file, so it is not the same one
        if one.exists() and other.exists():
            return one.samefile(other)
        return os.path.normcase(one) == os.path.normcase(other.resolve())
    return False


def _host() -> str:
    return hashlib.sha256(platform.node().encode()).hexdigest()[:8]


def _make_directory(folder: Path) -> Path:
    try:
        return Path(tempfile.mkdtemp(prefix=f".polymerge-{_host()}-{os.getpid()}-", dir=folder))
    except OSError as error:
        raise OutputError(
            f"the folder {folder} cannot be written to: {error.strerror}; name an output elsewhere"
        ) from error


def _remove_leftovers(folder: Path) -> None:
    """Remove the temporary directories of runs that were killed."""
    for entry in folder.glob(".polymerge-*"):
        name = _TEMPORARY.match(entry.name)
        if name is None or entry.is_symlink() or not entry.is_dir():
            continue
        # Whether a process of another computer lives, or on Windows any, cannot be asked: wait a week.
        if name["host"] == _host() and os.name == "posix":
            stale = not _is_running(int(name["pid"]))
        else:
            stale = time.time() - entry.stat().st_mtime > _FOREIGN_TEMPORARY_SECONDS
        if stale:
            # Another run may be removing it at the same time, which is just as well.
            shutil.rmtree(entry, ignore_errors=True)


def _is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def _sync(path: Path) -> None:
    """Ask the operating system to bring a file or a folder to the disk."""
    if os.name != "posix" and path.is_dir():
        return  # Windows cannot open folders
    descriptor = os.open(path, os.O_RDONLY if os.name == "posix" else os.O_RDWR)
    try:
        os.fsync(descriptor)
    except OSError as error:
        # Some network and FUSE file systems cannot sync folders; that is no reason to lose the result.
        if not (path.is_dir() and error.errno in {errno.EINVAL, errno.ENOTSUP}):
            raise
    finally:
        os.close(descriptor)


def _move(source: Path | None, target: Path) -> None:
    if source is None:
        target.unlink(missing_ok=True)
    else:
        source.replace(target)


def _stop_if(interrupted: bool) -> None:  # noqa: FBT001 - one flag, named in the function's name
    if interrupted:
        raise KeyboardInterrupt


@contextlib.contextmanager
def _interrupts_held() -> Iterator[Callable[[], bool]]:
    """Hold Ctrl-C back for the moment of moving files; gives a function that tells whether one came."""
    came: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        came.append(number)

    previous = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or previous is None:
        yield lambda: False
        return
    signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(came)
    finally:
        signal.signal(signal.SIGINT, previous)
    if came:
        signal.raise_signal(signal.SIGINT)
