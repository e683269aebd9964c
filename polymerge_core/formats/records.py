"""What a drive recorded: the predictions and the poses of its frames, as flat arrays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from polymerge_core.errors import InputError
from polymerge_core.formats.rotation import is_rigid

Array = NDArray[np.float64]


class LeftOutVector(NamedTuple):
    """A vector of a predictions file that is no observation."""

    #: Token of its frame.
    token: str
    #: Position in its frame, from 0.
    position: int
    #: Length in metres; nan where a coordinate is not finite.
    length_m: float
    reason: str


@dataclass(frozen=True, eq=False)
class Predictions:
    """What a predictor saw, as flat arrays: k frames with m vectors of n vertices in all.

    Parameters
    ----------
    tokens : sequence of str, length k
        The frames in file order, those that saw nothing included.
    coordinates : ndarray of float, shape (n, 2)
        x and y of all vertices, metres, in the frame that `frame_kind` names.
    offsets : ndarray of int, shape (m + 1,)
        The vertices of vector i are ``coordinates[offsets[i]:offsets[i + 1]]``, two at least.
    frame : ndarray of int, shape (m,)
        Index of the vector's frame in `tokens`.
    index : ndarray of int, shape (m,)
        Position of the vector in its frame, those left out counted.
    class_name : ndarray of str, shape (m,)
    score : ndarray of float, shape (m,)
        Within 0 and 1.
    frame_kind : {"ego", "lidar"}, default "ego"
        The vehicle's frame (x forward, y left) or the LiDAR's.
    left_out : sequence of LeftOutVector
        Vectors that are no lines.
    source : str, default "predictions"
        Name of the source, the default drive.
    """

    tokens: Sequence[str]
    coordinates: Array
    offsets: NDArray[np.intp]
    frame: NDArray[np.intp]
    index: NDArray[np.intp]
    class_name: NDArray[np.object_]
    score: Array
    frame_kind: Literal["ego", "lidar"] = "ego"
    left_out: Sequence[LeftOutVector] = ()
    source: str = "predictions"


@dataclass(frozen=True, eq=False)
class Poses:
    """Where the vehicle was, as arrays of length k.

    Parameters
    ----------
    timestamp_ns : ndarray of int64, shape (k,)
        Nanoseconds.
    token : ndarray of str, shape (k,), optional
        Names of the frames; without them a prediction's token is matched with the timestamp as text.
    rotation : ndarray of float, shape (k, 3, 3), optional
        Vehicle to world; for geodetic poses vehicle to the local east-north-up frame.
    translation : ndarray of float, shape (k, 3), optional
        Metres.
    lat, lon : ndarray of float, shape (k,), optional
        Degrees on WGS 84.
    height_m : ndarray of float, shape (k,), optional
        Metres above the ellipsoid, 0 where it is missing.
    heading_deg : ndarray of float, shape (k,), optional
        Degrees clockwise from true north.
    source : str, default "poses"
        The file, for messages.

    Raises
    ------
    InputError
        If shapes do not fit, a rotation is not rigid, or a token or a timestamp has two different poses.
    """

    timestamp_ns: NDArray[np.int64]
    token: NDArray[np.object_] | None = None
    rotation: Array | None = None
    translation: Array | None = None
    lat: Array | None = None
    lon: Array | None = None
    height_m: Array | None = None
    heading_deg: Array | None = None
    source: str = "poses"

    def __post_init__(self) -> None:
        arrays: dict[str, NDArray[Any]]
        arrays = {name: value for name, value in self._arrays().items() if value is not None}
        of_one = {"rotation": (3, 3), "translation": (3,)}
        for name, value in arrays.items():
            expected = (len(self.timestamp_ns), *of_one.get(name, ()))
            if np.shape(value) != expected:
                raise InputError(f"{self.source}: {name} has the shape {np.shape(value)} instead of {expected}")
        if self.rotation is not None and not is_rigid(self.rotation).all():
            row = int((~is_rigid(self.rotation)).argmax())
            raise InputError(f"{self.source}: the rotation of pose {row} is not rigid")
        self._check_repeats(arrays)

    def take(self, rows: NDArray[np.intp]) -> Poses:
        """Return the poses of these rows, in this order."""
        taken: dict[str, Any]
        taken = {name: value if value is None else value[rows] for name, value in self._arrays().items()}
        return replace(self, **taken)

    def _check_repeats(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Refuse two poses of one token or moment; the same pose given twice does no harm."""
        if len(self.timestamp_ns) < 2:
            return
        flat = {
            f"{name} {column}": values
            for name, value in arrays.items()
            for column, values in enumerate(value.reshape(len(value), math.prod(value.shape[1:])).T)
        }
        different = pd.DataFrame(flat).drop_duplicates()
        unnamed = different.drop(columns="token 0", errors="ignore").drop_duplicates()
        for name, keys in (("token", different.get("token 0")), ("timestamp", unnamed["timestamp_ns 0"])):
            repeated = [] if keys is None else keys[keys.duplicated()].tolist()
            if repeated:
                raise InputError(f"{self.source}: the {name} {repeated[0]} has two different poses; keep one")

    def _arrays(self) -> dict[str, Any]:
        return {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.name != "source"}
