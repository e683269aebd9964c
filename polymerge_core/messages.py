"""Local maps as a vehicle's pipeline sends them: one JSON object a line, one frame an object."""

from __future__ import annotations

from typing import Any, NamedTuple

import pyproj

from polymerge_core.errors import InputError
from polymerge_core.formats.assemble import Frame, assemble
from polymerge_core.formats.poses import parse_poses
from polymerge_core.formats.strict_json import number_array, parse_json, require, require_key
from polymerge_core.formats.text import clean_name
from polymerge_core.frames import DEFAULT_FOOTPRINT, project
from polymerge_core.schema import LocalMaps

_KEYS = ("drive", "instance", "timestamp_ns", "pose", "footprint", "vectors", "labels", "scores")


class Message(NamedTuple):
    """A frame, and who sent it."""

    drive: str
    instance: str
    local_maps: LocalMaps


def read_message(text: str, crs: pyproj.CRS, where: str) -> Message:
    """Read one line of a stream.

    Parameters
    ----------
    text : str
        ``{"drive", "instance", "timestamp_ns", "pose", "footprint", "vectors", "labels", "scores"}``: `pose` is
        ``{"translation", "rotation"}`` in metres of `crs` with a quaternion w, x, y, z or a 3x3 matrix, or
        ``{"matrix"}``; `footprint` is xmin, ymin, xmax, ymax in the vehicle's frame, -30, -15, 30, 15 where it is
        missing; `vectors` are lists of points in the vehicle's frame, metres; `labels` are names of classes; `scores`
        are 1 where they are missing.
    crs : pyproj.CRS
        Of the map.
    where : str
        The line, for messages.

    Raises
    ------
    InputError
        If the line is no such object.
    """
    document = require(parse_json(text, where), dict, where)
    unknown = sorted(set(document) - set(_KEYS))
    if unknown:
        raise InputError(f"{where}: there is no key {unknown[0]!r} here; the keys are {', '.join(_KEYS)}")
    drive, instance = (_name(document, key, where) for key in ("drive", "instance"))
    entry = {"token": instance, "timestamp_ns": require_key(document, "timestamp_ns", where)}
    pose = require(require_key(document, "pose", where), dict, f"{where}, pose")
    poses = parse_poses([entry | pose], where)
    vectors = require(require_key(document, "vectors", where), list, f"{where}, vectors")
    labels = require(require_key(document, "labels", where), list, f"{where}, labels")
    scores = require(document.get("scores", [1.0] * len(vectors)), list, f"{where}, scores")
    if not len(vectors) == len(labels) == len(scores):
        raise InputError(
            f"{where}: {len(vectors)} vectors, {len(labels)} labels and {len(scores)} scores; give each one"
        )
    names = [_name_of(label, f"{where}, label {number}") for number, label in enumerate(labels)]
    predictions = assemble([Frame(instance, vectors, names, scores)], frame_kind="ego", source=drive, where=where)
    box = number_array(document.get("footprint", list(DEFAULT_FOOTPRINT)), f"{where}, footprint")
    if box.shape != (4,):
        raise InputError(f"{where}, footprint: expected xmin, ymin, xmax, ymax")
    xmin, ymin, xmax, ymax = box.tolist()
    if not (xmin < xmax and ymin < ymax):
        raise InputError(f"{where}, footprint: xmin must be below xmax, ymin below ymax")
    local = project(predictions, poses, crs=crs, footprint=(xmin, ymin, xmax, ymax), drive=drive)
    return Message(drive, instance, local)


def _name_of(label: Any, where: str) -> str:
    if not isinstance(label, str):
        raise InputError(f"{where}: {label!r} is no text; the labels of a frame are names of classes")
    return clean_name(label, where)


def _name(document: dict[str, Any], key: str, where: str) -> str:
    value = require_key(document, key, where)
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise InputError(f"{where}: the {key} must be text or a whole number, not {value!r}")
    return clean_name(str(value), where)
