"""What a user would otherwise take to make one map of many observations, each as ``rival(observations) -> map``.

The observations are a layer of LineStrings with `class` and `score`, metres; crossings are closed rings. A map has the
same columns. Every length that a rival asks for is derived from the proximity of `polymerge_core.merge` (1 m), never
tuned on these data.
"""

from benchmarks.rivals.centreline import buffer_centreline
from benchmarks.rivals.layers import NotInstalledError, RivalError
from benchmarks.rivals.oracle import average_true_groups
from benchmarks.rivals.qgis_tools import qgis_chain
from benchmarks.rivals.selection import concatenate, keep_best_score, keep_longest
from benchmarks.rivals.streets import neatnet_streets, parenx_skeleton, parenx_voronoi

__all__ = [
    "NotInstalledError",
    "RivalError",
    "average_true_groups",
    "buffer_centreline",
    "concatenate",
    "keep_best_score",
    "keep_longest",
    "neatnet_streets",
    "parenx_skeleton",
    "parenx_voronoi",
    "qgis_chain",
]
