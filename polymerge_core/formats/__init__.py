"""Predictions and poses from files: one module for each format, which is known by its shape."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Protocol

from polymerge_core.errors import InputError
from polymerge_core.formats.maptr import read_maptr
from polymerge_core.formats.matrix import read_matrix
from polymerge_core.formats.poses import read_poses
from polymerge_core.formats.records import Predictions
from polymerge_core.formats.strict_json import parse_json
from polymerge_core.formats.submission import read_submission
from polymerge_core.formats.text import read_text
from polymerge_core.formats.vectormapnet import read_vectormapnet

__all__ = ["read_matrix", "read_poses", "read_predictions"]


class _Reader(Protocol):
    def __call__(self, document: dict[str, Any], *, source: str, where: str) -> Predictions: ...


def read_predictions(path: str | os.PathLike[str]) -> Predictions:
    """Read a predictor's results.

    Parameters
    ----------
    path : path-like
        A JSON file of the `submission_vector.json` family, MapTR's `nuscmap_results.json`, or VectorMapNet's
        dictionary written as JSON. The name does not matter: the format is known by its shape.

    Returns
    -------
    Predictions
        All frames and their vectors, in the vehicle's or the LiDAR's frame, metres; frames that saw nothing
        included. Class names win over class numbers; a `class_names` list in the file's meta says what the
        numbers mean. Vectors that are no lines (fewer than 2 points, a coordinate that is not finite, a score
        outside 0..1) are in its `left_out`.

    Raises
    ------
    InputError
        If the file is a pickle or the like, is not strict JSON, has none of the shapes, or contradicts
        itself; the message names the frame's token and the vector's place in it.

    Examples
    --------
    >>> import json, pathlib, tempfile
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "drive.json"
    >>> frame = {"vectors": [[[0, 1.8], [30, 1.7]]], "scores": [0.9], "labels": [1]}
    >>> _ = file.write_text(json.dumps({"meta": {}, "results": {"a": frame}}))
    >>> predictions = read_predictions(file)
    >>> predictions.tokens, predictions.class_name.tolist(), predictions.coordinates.tolist()
    (('a',), ['divider'], [[0.0, 1.8], [30.0, 1.7]])
    """
    where = os.fspath(path)
    document = parse_json(read_text(path), where)
    reader = _reader_for(document, where)
    return reader(document, source=Path(path).stem, where=where)


def _reader_for(document: Any, where: str) -> _Reader:
    """Tell the format from the shape of the document."""
    results = document.get("results") if isinstance(document, dict) else None
    if isinstance(results, list):
        return read_maptr
    if isinstance(results, dict):
        entries = [entry for entry in results.values() if isinstance(entry, dict)]
        if any("labels" in entry or "scores" in entry for entry in entries):
            return read_submission
        first_vectors = [vector for entry in entries for vector in _as_list(entry.get("vectors"))[:1]]
        # Where no frame saw anything both formats say the same, but only one lists such frames elsewhere.
        only_records = all(isinstance(vector, dict) for vector in first_vectors)
        return read_vectormapnet if only_records else read_submission
    keys = f"an object with the keys {list(document)[:8]}" if isinstance(document, dict) else "no object"
    raise InputError(
        f"{where}: not a file of predictions, but {keys}; known are submission_vector.json "
        "(StreamMapNet, MapTracker), nuscmap_results.json (MapTR) and VectorMapNet's results as JSON, "
        "all of which have the key 'results'"
    )


def _as_list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []
