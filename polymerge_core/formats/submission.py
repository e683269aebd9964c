"""The `submission_vector.json` family: StreamMapNet, MapTracker, GlobalMapNet, the Online HD Map challenge.

``{"meta": {...}, "results": {token: {"vectors": [[[x, y], ...], ...], "scores": [...], "labels": [...]}}}``,
ego frame, metres. Further keys of a frame (`prop`, tracks, masks) are ignored.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from polymerge_core.errors import InputError
from polymerge_core.formats.assemble import Frame, assemble, class_of, declared_classes
from polymerge_core.formats.records import Predictions
from polymerge_core.formats.strict_json import require, require_key

#: What the labels 0, 1, 2 mean where the file's meta has no `class_names`.
CLASS_NAMES = ("ped_crossing", "divider", "boundary")


def read_submission(document: dict[str, Any], *, source: str, where: str) -> Predictions:
    """Read a parsed `submission_vector.json`.

    Parameters
    ----------
    document : dict
        The parsed file. `labels` may be numbers or names; without `scores` a frame's scores are 1.
    source : str
        Name of the source.
    where : str
        The file, for messages.

    Returns
    -------
    Predictions
        In the ego frame; a token without vectors is a frame that saw nothing.

    Raises
    ------
    InputError
        If the parallel lists of a frame differ in length, a label has no name, or points are not points.
    """
    results = require(require_key(document, "results", where), dict, f"{where}: results")
    names = declared_classes(document, CLASS_NAMES, where)

    def frames() -> Iterator[Frame]:
        for token, entry in results.items():
            yield _frame(token, entry, names, f"{where}: frame {token!r}")

    return assemble(frames(), frame_kind="ego", source=source, where=where)


def _frame(token: str, entry: Any, class_names: Sequence[str], place: str) -> Frame:
    record = require(entry, dict, place)
    vectors = require(require_key(record, "vectors", place), list, f"{place}, vectors")
    labels = require_key(record, "labels", place) if vectors else record.get("labels", [])
    require(labels, list, f"{place}, labels")
    scores = require(record.get("scores", [1.0] * len(vectors)), list, f"{place}, scores")
    if not len(vectors) == len(labels) == len(scores):
        raise InputError(
            f"{place} has {len(vectors)} vectors, {len(scores)} scores and {len(labels)} labels; "
            "each vector needs one of both"
        )
    named = [class_of(label, class_names, f"{place}, vector {index}") for index, label in enumerate(labels)]
    return Frame(token, vectors, named, scores)
