"""What can go wrong, in words a user can act on.

Every message says what is wrong, where (file, layer, feature) and what to do about it. The command line
prints the message of a `PolymergeError` on one line and exits with 1, or with 2 for an `OptionError`.
"""


class PolymergeError(ValueError):
    """Base class of every error that PolyMerge raises on purpose."""


class InputError(PolymergeError):
    """A file cannot be read, or its content contradicts itself."""


class SchemaError(PolymergeError):
    """A layer lacks a column, or a column holds something other than what it must."""


class CrsError(PolymergeError):
    """A coordinate reference system is missing, unknown, or does not fit the coordinates."""


class OutputError(PolymergeError):
    """A result cannot be written where it was asked for."""


class OptionError(PolymergeError):
    """An option has a value that it cannot have."""
