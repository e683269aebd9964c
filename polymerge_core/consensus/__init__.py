"""The consensus merge: one smooth line from all looks at it, more exact than any of them."""

from polymerge_core.consensus.run import describe_corrections, merge_by_consensus

__all__ = ["describe_corrections", "merge_by_consensus"]
