"""Merge many overlapping, imperfect digitisations of the same lines into one clean map."""

from polymerge_core.consensus import State, accumulate
from polymerge_core.errors import CrsError, InputError, OptionError, OutputError, PolymergeError, SchemaError
from polymerge_core.evaluation import Evaluation, evaluate
from polymerge_core.formats import read_poses, read_predictions
from polymerge_core.frames import project
from polymerge_core.graph import merge_network, network_layers
from polymerge_core.io import read_layers, read_local_maps, write_layers
from polymerge_core.merge import MergeResult, merge
from polymerge_core.schema import LocalMaps
from polymerge_core.store import MapStore, Update
from polymerge_core.version import __version__

__all__ = [
    "CrsError",
    "Evaluation",
    "InputError",
    "LocalMaps",
    "MapStore",
    "MergeResult",
    "OptionError",
    "OutputError",
    "PolymergeError",
    "SchemaError",
    "State",
    "Update",
    "__version__",
    "accumulate",
    "evaluate",
    "merge",
    "merge_network",
    "network_layers",
    "project",
    "read_layers",
    "read_local_maps",
    "read_poses",
    "read_predictions",
    "write_layers",
]
