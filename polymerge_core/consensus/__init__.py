"""The consensus merge: one smooth line from all looks at it, more exact than any of them."""

from polymerge_core.consensus.run import describe_corrections, merge_by_consensus
from polymerge_core.consensus.state import State, accumulate

__all__ = ["State", "accumulate", "describe_corrections", "merge_by_consensus"]
