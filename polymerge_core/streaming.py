"""A stored map at the end of a vehicle's pipeline: frames from standard input, answers to standard output.

A frame is answered when it is safe on the disk. The map is drawn anew every few frames, when nothing waits, and at the
end: that takes longer than the time between two frames, and the frames that come in meanwhile wait in the queue.
"""

from __future__ import annotations

import json
import queue
import sys
import threading
from collections.abc import Callable, Iterable
from typing import Any

from polymerge_core.console import say
from polymerge_core.errors import CrsError, InputError, PolymergeError, SchemaError
from polymerge_core.messages import read_message
from polymerge_core.store.map_store import MapStore, Update

#: So many lines are read ahead; whoever sends more waits.
_AHEAD = 1000


def run_stream(
    store: MapStore,
    lines: Iterable[str] | None = None,
    answer: Callable[[str], object] | None = None,
    *,
    draw_every: int,
) -> dict[str, Any]:
    """Feed a map frames until there are no more.

    Parameters
    ----------
    store : MapStore
        The map, which must be there or have a CRS.
    lines : iterable of str, optional
        One JSON object each, as `read_message` takes them; standard input by default.
    answer : callable, optional
        Called with a JSON object for each frame that is safe on the disk, ``{"drive", "instance", "revision"}``, or for
        a line that cannot be used, ``{"line", "error"}``; prints it by default.
    draw_every : int
        How many frames the map may lag behind.

    Returns
    -------
    dict
        What all updates did, ready for JSON.

    Raises
    ------
    InputError
        At the end, if any line could not be used.
    """
    reply, crs = answer or _print, store.crs
    total: dict[str, Any] = {}
    faults = waiting = number = 0
    for line in _ahead(sys.stdin if lines is None else lines):
        if line is None:
            waiting = _draw(store, total) if waiting else 0
            continue
        number += 1
        if not line.strip():
            continue
        try:
            message = read_message(line, crs, f"line {number}")
            done = store.update(message.local_maps, draw=False)
        except (InputError, SchemaError, CrsError) as error:
            faults += 1
            say(f"error: {error}")
            reply(json.dumps({"line": number, "error": str(error)}))
            continue
        _add_up(total, done)
        waiting += 1
        reply(json.dumps({"drive": message.drive, "instance": message.instance, "revision": done.revision}))
        if waiting >= draw_every:
            waiting = _draw(store, total)
    if waiting:
        _draw(store, total)
    if faults:
        raise InputError(f"{faults} of the lines could not be used; the others are in {store.path}")
    if not total:
        raise InputError("standard input held no frames; send one JSON object a line")
    return total


def _print(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _draw(store: MapStore, total: dict[str, Any]) -> int:
    done = store.draw()
    if done is not None:
        _add_up(total, done)
    return 0


def _add_up(total: dict[str, Any], done: Update) -> None:
    for name, value in done.report().items():
        if name in ("revision", "elements"):
            total[name] = value
        elif isinstance(value, dict):
            held = total.setdefault(name, {})
            for reason, count in value.items():
                held[reason] = held.get(reason, 0) + count
        else:
            total[name] = total[name] + value if name in total else value


def _ahead(lines: Iterable[str]) -> Iterable[str | None]:
    """Give lines as they come, and None whenever there is none yet."""
    held: queue.Queue[str | BaseException | None] = queue.Queue(_AHEAD)

    def read() -> None:
        try:
            for line in lines:
                held.put(line)
            held.put(None)
        except BaseException as error:  # noqa: BLE001 - raised again where the lines are used
            held.put(error)

    threading.Thread(target=read, daemon=True, name="read-stream").start()
    while True:
        try:
            line = held.get_nowait()
        except queue.Empty:
            yield None
            line = held.get()
        if line is None:
            return
        if isinstance(line, BaseException):
            raise PolymergeError(f"standard input cannot be read: {line}") from line
        yield line
