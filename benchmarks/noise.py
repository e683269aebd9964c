"""The noise model of the simulated predictor, and the random streams that it is drawn from.

Every random number comes from a stream of its own (seed, part, frame, element), so that a part that is
scaled or switched off leaves all the others as they were: two runs differ only in what was changed.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from polymerge_core.errors import OptionError

if TYPE_CHECKING:
    from collections.abc import Callable

Array = NDArray[np.float64]

CLASS_NAMES = ("ped_crossing", "divider", "boundary")


@dataclass(frozen=True)
class LineNoise:
    """Errors of one class of lines.

    Attributes
    ----------
    base_m, slope : float
        Standard deviation of the lateral error: ``base_m + slope * distance from the vehicle``, metres.
    cut_m : float
        Each end is cut by ``|N(0, 1)| * cut_m`` metres.
    """

    base_m: float
    slope: float
    cut_m: float


@dataclass(frozen=True)
class CrossingNoise:
    """Errors of pedestrian crossings, standard deviations.

    Attributes
    ----------
    base_m, slope : float
        Shift along each axis: ``base_m + slope * distance from the vehicle``, metres.
    scale : float
        Share by which the crossing grows or shrinks.
    turn_deg : float
        Turn about its centre, degrees.
    corner_m : float
        Shift of each corner along each axis, metres.
    """

    base_m: float = 0.20
    slope: float = 0.008
    scale: float = 0.06
    turn_deg: float = 2.0
    corner_m: float = 0.15


@dataclass(frozen=True)
class Noise:
    """The noise model; the defaults come near the single instances of the paper's table (section IV).

    There the mean discrete Frechet distance is 0.98, 0.48 and 1.72 m for crossings, dividers and boundaries.

    Attributes
    ----------
    pose_m, pose_deg : float
        Standard deviation of a believed pose: along each axis, metres, and of the heading, degrees.
    divider, boundary, crossing : LineNoise, LineNoise, CrossingNoise
        Errors of shape, by class.
    correlation_m : float
        Length over which the errors of a line are correlated: ``exp(-d**2 / (2 correlation_m**2))``.
    along : float
        Error along a line as a share of the lateral one.
    missed, split, reverse : float
        Shares of the true lines in view not seen, of the lines over 15 m seen in two pieces, of the vectors
        digitised backwards.
    false : float
        Share of the predicted vectors that answer to nothing.
    score_true, score_false : tuple of float
        Parameters of the beta distributions of the scores.
    pose_drive_share, shape_drive_share : float
        Share (0..1) of the variance of the pose errors, and of the errors of shape, that is the same in every
        frame of the drive: what averaging over the drive cannot remove.
    """

    pose_m: float = 0.15
    pose_deg: float = 0.5
    divider: LineNoise = LineNoise(0.107, 0.0065, 1.0)
    boundary: LineNoise = LineNoise(0.42, 0.040, 2.2)
    crossing: CrossingNoise = field(default_factory=CrossingNoise)
    correlation_m: float = 12.0
    along: float = 0.5
    missed: float = 0.20
    split: float = 0.10
    reverse: float = 0.5
    false: float = 0.08
    score_true: tuple[float, float] = (12.0, 2.0)
    score_false: tuple[float, float] = (4.0, 3.0)
    pose_drive_share: float = 0.0
    shape_drive_share: float = 0.0

    def __post_init__(self) -> None:
        for name in ("missed", "split", "reverse", "pose_drive_share", "shape_drive_share"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise OptionError(f"{name} is {getattr(self, name)}; it is a share from 0 to 1")
        if not 0.0 <= self.false < 0.5:
            raise OptionError(f"false is {self.false}; it is a share from 0 up to, but not including, 0.5")
        if not self.correlation_m > 0:
            raise OptionError(f"correlation_m is {self.correlation_m}; it is a length above 0 m")

    def of(self, label: int) -> Any:
        """Return the errors of shape of one class, named by its label (position in `CLASS_NAMES`)."""
        return (self.crossing, self.divider, self.boundary)[label]

    def scaled(self, factor: float) -> Noise:
        """Return the same model with every error of pose and shape multiplied; shares stay as they are."""

        def times(part: Any) -> Any:
            return replace(part, **{name: factor * value for name, value in vars(part).items()})

        return replace(
            self,
            pose_m=factor * self.pose_m,
            pose_deg=factor * self.pose_deg,
            divider=times(self.divider),
            boundary=times(self.boundary),
            crossing=times(self.crossing),
        )

    @classmethod
    def none(cls) -> Noise:
        """Return the model of a perfect predictor: only the box, the sparse vertices and the grid remain."""
        return replace(cls().scaled(0.0), missed=0.0, split=0.0, reverse=0.0, false=0.0)


class Part(IntEnum):
    """What a stream of random numbers is for."""

    POSE = 0
    LATERAL = 1
    ALONG = 2
    CROSSING = 3
    MISSED = 4
    SPLIT = 5
    CUT = 6
    VERTICES = 7
    REVERSE = 8
    SCORE = 9
    FALSE_COUNT = 10
    FALSE = 11


@dataclass(frozen=True)
class Dice:
    """Random streams of one frame, and those that all frames of the drive share."""

    seed: int
    frame: int
    drive_share: float

    def rng(self, part: Part, *key: int) -> np.random.Generator:
        """Return the stream of one part and one element (`key`) in this frame."""
        return np.random.default_rng((self.seed, part, self.frame + 1, *key))

    def mixed(self, draw: Callable[[np.random.Generator], Array], part: Part, *key: int) -> Array:
        """Return unit noise of which a share of the variance is the same in every frame."""
        common = np.random.default_rng((self.seed, part, 0, *key))
        own, shared = np.sqrt([1.0 - self.drive_share, self.drive_share])
        return np.asarray(own * draw(self.rng(part, *key)) + shared * draw(common))


def unit_noise(rng: np.random.Generator, arc: Array, correlation_m: float, *, periodic: bool) -> Array:
    """Return smooth Gaussian noise of mean 0 and variance 1 along a line.

    Parameters
    ----------
    rng : Generator
        Where the numbers come from; how many are drawn depends on the length and `correlation_m` alone.
    arc : ndarray of float, shape (n,)
        Distance of each point from the line's start, metres, rising from 0 to the length.
    correlation_m : float
        Correlation ``exp(-d**2 / (2 correlation_m**2))`` between points d metres apart.
    periodic : bool
        Whether the line is a ring, whose last point must get the value of its first.

    Returns
    -------
    ndarray of float, shape (n,)
    """
    # An open line is a stretch of a ring so long that its ends know nothing of each other.
    period = arc[-1] if periodic else arc[-1] + 6 * correlation_m
    count = int(np.ceil(4 * period / correlation_m))
    width = correlation_m * count / period / np.sqrt(2)
    impulse = np.zeros(count)
    impulse[0] = 1.0
    scale = np.linalg.norm(gaussian_filter1d(impulse, width, mode="wrap"))
    values = gaussian_filter1d(rng.standard_normal(count), width, mode="wrap") / scale
    return np.asarray(np.interp(arc, np.linspace(0.0, period, count, endpoint=False), values, period=period))
