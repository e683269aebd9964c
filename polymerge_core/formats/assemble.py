"""What the predictors' formats have in common: frames of vectors become one set of flat arrays."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polymerge_core.errors import InputError
from polymerge_core.formats.records import LeftOutVector, Predictions
from polymerge_core.formats.strict_json import number_array, require, require_key
from polymerge_core.formats.text import clean_name


class Frame(NamedTuple):
    """One frame as a format's module hands it over; the three sequences have one entry a vector."""

    token: str
    points: Sequence[Any]
    class_names: Sequence[str]
    scores: Sequence[Any]


def assemble(frames: Iterable[Frame], *, frame_kind: Literal["ego", "lidar"], source: str, where: str) -> Predictions:
    """Flatten frames into `Predictions`, leaving out the vectors that are no lines.

    Parameters
    ----------
    frames : iterable of Frame
        In file order; points and scores as they were parsed.
    frame_kind : {"ego", "lidar"}
        The frame in which the format's coordinates are.
    source : str
        Name of the source.
    where : str
        The file, for messages.

    Returns
    -------
    Predictions
        A vector of fewer than two points, with a coordinate (x or y) that is not finite, or with a score that
        is not in 0..1 is in its `left_out`.

    Raises
    ------
    InputError
        If a token occurs twice, or points are not lists of two or three numbers.
    """
    tokens: dict[str, int] = {}
    lines: list[NDArray[np.float64]] = []
    rows: list[tuple[int, int, str, float]] = []
    left_out: list[LeftOutVector] = []
    for frame in frames:
        place = f"{where}: frame {frame.token!r}"
        if clean_name(frame.token, place) in tokens:
            raise InputError(f"{place} stands twice in the file; keep one of the two")
        number = tokens.setdefault(frame.token, len(tokens))
        scores = number_array(list(frame.scores), f"{place}, scores")
        if scores.shape != (len(frame.points),):
            raise InputError(f"{place}, scores: expected one number for each vector")
        for index, (points, name) in enumerate(zip(frame.points, frame.class_names, strict=True)):
            line = _line(points, f"{place}, vector {index}")
            score = float(scores[index])
            reason = _fault(line, score)
            if reason is None:
                lines.append(line)
                rows.append((number, index, name, score))
            else:
                left_out.append(LeftOutVector(frame.token, index, _length(line), reason))
    number_of, index_of, name_of, score_of = zip(*rows, strict=True) if rows else ((), (), (), ())
    return Predictions(
        tokens=tuple(tokens),
        coordinates=np.concatenate([np.empty((0, 2)), *lines]),
        offsets=np.concatenate([[0], np.cumsum([len(line) for line in lines])]).astype(np.intp),
        frame=np.array(number_of, dtype=np.intp),
        index=np.array(index_of, dtype=np.intp),
        class_name=np.array(name_of, dtype=object),
        score=np.array(score_of, dtype=np.float64),
        frame_kind=frame_kind,
        left_out=tuple(left_out),
        source=source,
    )


def class_of(label: Any, class_names: Sequence[str], where: str) -> str:
    """Return the class that a label stands for.

    Parameters
    ----------
    label : str or int
        A name, which stands for itself, or a number.
    class_names : sequence of str
        The names of the numbers 0, 1, ...
    where : str
        File, frame and vector, for the message.

    Raises
    ------
    InputError
        If a number has no name.
    """
    if isinstance(label, str):
        return clean_name(label, where)
    whole = isinstance(label, int | float) and not isinstance(label, bool) and label == np.floor(label)
    if not whole or not 0 <= label < len(class_names):
        known = ", ".join(f"{number} {name}" for number, name in enumerate(class_names))
        raise InputError(
            f"{where}: the label {label!r} has no name (known are {known}); "
            "name the classes in the file's meta as class_names"
        )
    return class_names[int(label)]


def declared_classes(document: dict[str, Any], default: Sequence[str], where: str) -> Sequence[str]:
    """Return the class names that the file's meta declares, else the format's own order."""
    meta = document.get("meta")
    if not isinstance(meta, dict) or "class_names" not in meta:
        return default
    place = f"{where}: class_names in meta"
    names = require(meta["class_names"], list, place)
    return [clean_name(require(name, str, f"{place}, entry {number}"), place) for number, name in enumerate(names)]


def frame_of_records(token: str, vectors: Any, class_names: Sequence[str], where: str) -> Frame:
    """Read the vectors of a frame from records with points, class and confidence (MapTR, VectorMapNet).

    Parameters
    ----------
    token : str
        The frame's token.
    vectors : list of dict
        Records ``{"pts", "pts_num", "cls_name", "type", "confidence_level"}``; `cls_name` wins over `type`;
        without `pts_num` the points are not counted, without `confidence_level` the score is 1.
    class_names : sequence of str
        The names of the numbers in `type`.
    where : str
        The file, for messages.

    Raises
    ------
    InputError
        If a record is no record, has no points or class, or `pts_num` is not the number of its points.
    """
    place = f"{where}: frame {token!r}"
    points, names, scores = [], [], []
    for index, vector in enumerate(require(vectors, list, f"{place}, vectors")):
        spot = f"{place}, vector {index}"
        record = require(vector, dict, spot)
        pts = require(require_key(record, "pts", spot), list, f"{spot}, pts")
        if record.get("pts_num", len(pts)) != len(pts):
            raise InputError(f"{spot}: pts_num is {record['pts_num']!r}, but there are {len(pts)} points")
        label = record["cls_name"] if "cls_name" in record else require_key(record, "type", spot)
        points.append(pts)
        names.append(class_of(label, class_names, spot))
        scores.append(record.get("confidence_level", 1.0))
    return Frame(token, points, names, scores)


def _line(points: Any, where: str) -> NDArray[np.float64]:
    """Return the x and y of a vector's points; z, where there is one, is dropped (eq. 1 lifts to z = 0)."""
    line = number_array(require(points, list, where), where)
    if line.shape == (0,):
        return np.empty((0, 2))
    if line.ndim != 2 or line.shape[1] not in (2, 3):
        raise InputError(f"{where}: expected points [x, y] or [x, y, z], found an array of shape {line.shape}")
    return line[:, :2]


def _fault(line: NDArray[np.float64], score: float) -> str | None:
    """Say why a vector cannot be an observation; None where it can."""
    if len(line) < 2:
        return "fewer than 2 points"
    if not np.isfinite(line).all():
        return "a coordinate is not a number"
    if not np.isfinite(score):
        return "the score is not a number"
    if not 0.0 <= score <= 1.0:
        return "the score is not between 0 and 1"
    return None


def _length(line: NDArray[np.float64]) -> float:
    if not np.isfinite(line).all():
        return float("nan")
    with np.errstate(over="ignore"):
        return float(np.hypot(*np.diff(line, axis=0).T).sum())
