"""MapTR and MapTRv2: `nuscmap_results.json`.

``{"meta": {...}, "results": [{"sample_token": token, "vectors": [{"pts", "pts_num", "cls_name", "type",
"confidence_level"}, ...]}, ...]}``, metres in the frame of the top LiDAR.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from polymerge_core.formats.assemble import Frame, assemble, declared_classes, frame_of_records
from polymerge_core.formats.records import Predictions
from polymerge_core.formats.strict_json import require, require_key

#: What `type` 0, 1, 2 mean where neither `cls_name` nor the file's meta says; not VectorMapNet's order.
CLASS_NAMES = ("divider", "ped_crossing", "boundary")


def read_maptr(document: dict[str, Any], *, source: str, where: str) -> Predictions:
    """Read a parsed `nuscmap_results.json`.

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
        In the LiDAR frame: `polymerge_core.project` needs `lidar_to_ego` unless the two frames are the same.

    Raises
    ------
    InputError
        If a sample occurs twice, `pts_num` is not the number of points, or a class number has no name.
    """
    results = require(require_key(document, "results", where), list, f"{where}: results")
    names = declared_classes(document, CLASS_NAMES, where)

    def frames() -> Iterator[Frame]:
        for number, entry in enumerate(results):
            place = f"{where}: results, entry {number}"
            record = require(entry, dict, place)
            token = require_key(record, "sample_token", place)
            # Argoverse 2 has timestamps for tokens, which some converters leave as numbers.
            if not isinstance(token, int) or isinstance(token, bool):
                require(token, str, f"{place}, sample_token")
            yield frame_of_records(str(token), require_key(record, "vectors", place), names, where)

    return assemble(frames(), frame_kind="lidar", source=source, where=where)
