"""The version of PolyMerge."""

__version__ = "0.1.0"
