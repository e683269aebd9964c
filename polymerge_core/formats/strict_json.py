"""JSON read strictly: what the file says twice, half or in another type than it should is an error.

`json` itself takes the last of two equal keys, follows any depth until the stack ends and knows nothing of
what a value must be. Here each of these is an `InputError` that says where. The literals ``NaN`` and
``Infinity``, and ``null`` in place of a number, are read as numbers that are not finite: predictors write
them, and whoever asks for the number leaves out, with a reason, what has them.
"""

from __future__ import annotations

import json
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from polymerge_core.errors import InputError

_T = TypeVar("_T")

_JSON_NAMES: dict[type, str] = {
    dict: "an object",
    list: "a list",
    str: "text",
    bool: "true or false",
    int: "a number",
    float: "a number",
    type(None): "null",
}


def parse_json(text: str, where: str) -> Any:
    """Parse one JSON document.

    Parameters
    ----------
    text : str
        The whole document.
    where : str
        The file, for messages.

    Returns
    -------
    any
        Dictionaries, lists, text, numbers, booleans and None.

    Raises
    ------
    InputError
        With line and column where the syntax is wrong or something follows the document; where an object has
        the same key twice; where the nesting is deeper than the interpreter's stack.
    """

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        mapping = dict(pairs)
        if len(mapping) < len(pairs):
            keys = [key for key, _ in pairs]
            repeated = next(key for key in keys if keys.count(key) > 1)
            raise InputError(f"{where}: the key {repeated!r} stands twice in one object; keep one of the two")
        return mapping

    try:
        return json.loads(text, object_pairs_hook=unique)
    except InputError:
        raise
    except json.JSONDecodeError as error:
        raise InputError(
            f"{where}: not valid JSON at line {error.lineno}, column {error.colno} ({error.msg}); "
            "the file may be cut off or edited by hand"
        ) from error
    except RecursionError as error:
        raise InputError(f"{where}: the JSON is nested too deep to be a list of map elements or poses") from error
    except ValueError as error:  # a whole number of thousands of digits
        raise InputError(f"{where}: the JSON holds a number that cannot be read ({error})") from error


def require(value: Any, kind: type[_T], where: str) -> _T:
    """Return a JSON value, an `InputError` where it is of another kind.

    Parameters
    ----------
    value : any
        A parsed JSON value.
    kind : type
        ``dict``, ``list`` or ``str``.
    where : str
        File, place and name of the value, for the message.
    """
    if not isinstance(value, kind):
        raise InputError(f"{where} must be {_JSON_NAMES[kind]}, not {_JSON_NAMES[type(value)]}")
    return value


def require_key(mapping: dict[str, Any], key: str, where: str) -> Any:
    """Return the value of a key that must be there, else an `InputError` that lists those that are."""
    if key not in mapping:
        present = ", ".join(repr(name) for name in list(mapping)[:12]) or "none"
        raise InputError(f"{where} has no {key!r}; its keys are: {present}")
    return mapping[key]


def number_array(value: Any, where: str) -> NDArray[np.float64]:
    """Turn nested JSON lists of numbers into an array.

    Parameters
    ----------
    value : any
        A number, or lists of numbers of equal length; ``null`` stands for a missing number.
    where : str
        File, place and name of the value, for the message.

    Returns
    -------
    ndarray of float
        ``null`` becomes nan, a number too large for a float infinity.

    Raises
    ------
    InputError
        If lists differ in length or hold anything but numbers.
    """
    try:
        array = np.asarray(value)
    except ValueError as error:  # ragged, or deeper than arrays go
        raise InputError(f"{where}: expected lists of numbers of equal length") from error
    if array.dtype == object:
        array = _from_objects(array, where)
    if array.dtype.kind not in "iuf":
        raise InputError(f"{where}: expected numbers, found {array.ravel()[:1].tolist()!r}")
    return array.astype(np.float64, copy=False)


def _from_objects(array: NDArray[np.object_], where: str) -> NDArray[np.float64]:
    """Convert the rare array that holds null or a whole number beyond 64 bits."""
    numbers = np.empty(array.shape, dtype=np.float64)
    for place, item in np.ndenumerate(array):
        if item is not None and (isinstance(item, bool) or not isinstance(item, int | float)):
            raise InputError(f"{where}: expected numbers, found {item!r}")
        try:
            numbers[place] = np.nan if item is None else item
        except OverflowError:
            numbers[place] = np.inf
    return numbers
