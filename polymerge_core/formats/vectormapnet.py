"""VectorMapNet's own dictionary, written as JSON (it writes a pickle, which is refused).

``{"meta": {...}, "results": {token: {"vectors": [{"pts", "pts_num", "type", "confidence_level"}, ...]}},
"groundTruth": {token: ...}}``, ego frame, metres.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from polymerge_core.formats.assemble import Frame, assemble, declared_classes, frame_of_records
from polymerge_core.formats.records import Predictions
from polymerge_core.formats.strict_json import require, require_key

#: What `type` 0, 1, 2 mean where the file does not say; not MapTR's order.
CLASS_NAMES = ("ped_crossing", "divider", "boundary")


def read_vectormapnet(document: dict[str, Any], *, source: str, where: str) -> Predictions:
    """Read VectorMapNet's parsed dictionary.

    Parameters
    ----------
    document : dict
        The parsed file.
    source : str
        Name of the source.
    where : str
        The file, for messages.

    Returns
    -------
    Predictions
        In the ego frame. VectorMapNet drops the tokens that saw nothing, so the frames are those of `results`
        and then those that only `groundTruth` has.

    Raises
    ------
    InputError
        If `pts_num` is not the number of points, or a class number has no name.
    """
    results = require(require_key(document, "results", where), dict, f"{where}: results")
    truth = require(document.get("groundTruth", {}), dict, f"{where}: groundTruth")
    names = declared_classes(document, CLASS_NAMES, where)

    def frames() -> Iterator[Frame]:
        for token, entry in results.items():
            place = f"{where}: frame {token!r}"
            record = require(entry, dict, place)
            yield frame_of_records(token, require_key(record, "vectors", place), names, where)
        for token in truth:
            if token not in results:
                yield Frame(token, (), (), ())

    return assemble(frames(), frame_kind="ego", source=source, where=where)
