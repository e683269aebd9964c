"""What a user can choose, checked before any work starts.

One name everywhere: keyword in Python, option with dashes on the command line, parameter in capitals in QGIS.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from numbers import Real
from typing import Any

from polymerge_core.errors import OptionError
from polymerge_core.schema import AREA_CLASSES

#: How observations become elements, the default first.
METHODS = ("consensus", "polymerge")
INSTANCE_FROM = ("column", "layer", "feature")
AGGREGATES = ("first", "mode", "mean", "min", "max", "sum")

#: A proximity beyond this (metres) is a mistake of units.
MAX_PROXIMITY_M = 1000.0


@dataclass(frozen=True)
class Options:
    """Options of a merge, as `polymerge_core.merge` describes them.

    Raises
    ------
    OptionError
        If a value is one that the option cannot have.
    """

    class_field: str | None = None
    class_name: str = "line"
    drive_field: str | None = None
    instance_field: str | None = None
    instance_from: str | None = None
    score_field: str | None = None
    min_score: float = 0.0
    timestamp_field: str | None = None
    method: str = METHODS[0]
    proximity: float = 1.0
    coverage: float = 0.5
    area: frozenset[str] = AREA_CLASSES
    aggregate: Mapping[str, str] | str = field(default="first")
    crs: Any = None
    out_crs: Any = None
    strict: bool = False

    @classmethod
    def of(cls, **chosen: Any) -> Options:
        """Build options from keywords; an unknown keyword is an `OptionError` that suggests the right one."""
        known = [entry.name for entry in fields(cls)]
        for name in chosen:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=1)
                hint = f"; did you mean {near[0]}?" if near else f"; the options are {', '.join(known)}"
                raise OptionError(f"there is no option {name!r}{hint}")
        area = chosen.pop("area", None) or ()
        named = {area} if isinstance(area, str) else set(area) if isinstance(area, Iterable) else {area}
        if not all(isinstance(name, str) for name in named):
            raise OptionError(f"area cannot be {area!r}; it is the name of a class, or several")
        return cls(area=AREA_CLASSES | named, **chosen)

    def __post_init__(self) -> None:
        _one_of("method", self.method, METHODS)
        if not isinstance(self.class_name, str):
            raise OptionError(f"class_name cannot be {self.class_name!r}; it is a text")
        if self.instance_from is not None:
            _one_of("instance_from", self.instance_from, INSTANCE_FROM)
        _within("min_score", self.min_score, 0.0, 1.0)
        _within("coverage", self.coverage, 0.0, 1.0, open_low=True)
        _within("proximity", self.proximity, 0.0, MAX_PROXIMITY_M, open_low=True, unit=" m")
        if not isinstance(self.aggregate, (str, Mapping)):
            raise OptionError(f"aggregate cannot be {self.aggregate!r}; it is a function, or one for each column")
        chosen = [self.aggregate] if isinstance(self.aggregate, str) else self.aggregate.values()
        for function in chosen:
            _one_of("aggregate", function, AGGREGATES)


def _one_of(name: str, value: object, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise OptionError(f"{name} cannot be {value!r}; it is one of {', '.join(allowed)}")


def _within(name: str, value: object, low: float, high: float, *, open_low: bool = False, unit: str = "") -> None:
    number = not isinstance(value, bool) and isinstance(value, Real) and math.isfinite(value)
    if not (number and low <= float(value) <= high) or (open_low and float(value) == low):  # type: ignore[arg-type]
        bounds = f"above {low:g} and at most {high:g}" if open_low else f"from {low:g} to {high:g}"
        raise OptionError(f"{name} cannot be {value!r}; it is a number {bounds}{unit}")
