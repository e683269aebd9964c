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
    **options: Any,
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
        a line that cannot be used, ``{"line", "error"}``; prints it by default. A frame that the map knew already has
        ``"known": true``, too, and one of which not all can be used ``"left_out"``, the reasons and their counts.
    draw_every : int
        How many frames the map may lag behind.
    **options
        Those of `MapStore.update` that say how a frame is read.

    Returns
    -------
    dict
        What all updates did, ready for JSON; `unusable_lines` is how many lines could not be used.

    Raises
    ------
    InputError
        If there were no frames at all, or the map was not made because no line could be used.
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
            done = store.update(message.local_maps, draw=False, **options)
        except (InputError, SchemaError, CrsError) as error:
            faults += 1
            say(f"error: {error}")
            reply(json.dumps({"line": number, "error": str(error)}))
            continue
        _add_up(total, done)
        waiting += 1
        told: dict[str, Any] = {"drive": message.drive, "instance": message.instance, "revision": done.revision}
        if done.skipped:
            told["known"] = True
        if done.left_out:
            told["left_out"] = done.left_out
        reply(json.dumps(told))
        if waiting >= draw_every:
            waiting = _draw(store, total)
    if waiting:
        _draw(store, total)
    if not number - faults or not total:
        what = "no frames; send one JSON object a line" if not faults else "no line that could be used"
        raise InputError(f"standard input held {what}; nothing was written")
    return total | {"unusable_lines": faults}


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
        elif name == "warnings":
            # One for each frame would hide the others.
            total[name] = list(dict.fromkeys([*total.get(name, []), *value]))
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
