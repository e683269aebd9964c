"""Simulated drives: what a predictor such as VectorMapNet would have seen of a map that is known.

Any ground truth and a table of poses give one local map for each pose: lines cut by a box of 60 m x 30 m
around the vehicle, moved by correlated errors, split, missed, invented, thinned to a few vertices on a 0.3 m
grid. The defaults of `Noise` come near the single instances of the paper's table (section IV).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from benchmarks.digitise import (
    BOX,
    STEP_M,
    arc_lengths,
    cut,
    longest_inside,
    points_at,
    stretches_inside,
    tangents,
    thin_out,
    visible_ring,
)
from benchmarks.noise import CLASS_NAMES, Dice, Noise, Part, unit_noise
from polymerge_core.errors import InputError, SchemaError

if TYPE_CHECKING:
    from collections.abc import Iterator

    import geopandas as gpd

Array = NDArray[np.float64]
Vector = tuple[Array, int, float, Any]  # vertices (n, 2), label, score, id of the true element or None


_LONG_M = 15.0  # shorter lines are not split


@dataclass(frozen=True)
class SimulatedDrive:
    """What `simulate` returns.

    Attributes
    ----------
    predictions : dict
        The shape of ``submission_vector.json``: ``meta`` (with ``class_names``) and ``results``, which holds
        for each token the parallel lists ``vectors`` (ego frame, metres), ``scores``, ``labels`` and
        ``element_id`` (the true element behind each vector, None for a false detection). A frame that saw
        nothing has empty lists.
    poses : DataFrame
        The poses as the vehicle BELIEVES them: rows and columns of the input, moved by the pose error.
    """

    predictions: dict[str, Any]
    poses: pd.DataFrame


def key_frames(poses: pd.DataFrame, count: int = 15, spacing: float = 3.5, *, start: float = 0.0) -> pd.DataFrame:
    """Choose frames at even distances along a drive.

    Parameters
    ----------
    poses : DataFrame
        Columns ``tx_m`` and ``ty_m``, in the order of time.
    count : int, default 15
        How many frames.
    spacing : float, default 3.5
        Metres driven from one to the next.
    start : float, default 0.0
        Metres driven before the first.

    Returns
    -------
    DataFrame
        `count` rows of `poses`: for each distance the first row at or past it.

    Raises
    ------
    InputError
        If the drive is too short.
    """
    steps = np.hypot(*np.diff(poses[["tx_m", "ty_m"]].to_numpy(float), axis=0).T)
    driven = np.concatenate([[0.0], np.cumsum(steps)])
    wanted = start + spacing * np.arange(count)
    if wanted[-1] > driven[-1] + 1e-6:
        raise InputError(
            f"the drive is {driven[-1]:.1f} m long, too short for {count} frames {spacing:g} m apart from "
            f"{start:g} m on; ask for fewer frames or a smaller spacing"
        )
    rows = np.searchsorted(driven, wanted - 1e-6)
    chosen: pd.DataFrame = poses.iloc[rows].reset_index(drop=True)
    return chosen


def simulate(
    truth: gpd.GeoDataFrame,
    poses: pd.DataFrame,
    *,
    seed: int,
    noise: Noise | None = None,
    offset: tuple[float, float] = (0.0, 0.0),
) -> SimulatedDrive:
    """Drive through a true map and return what a predictor sees of it.

    The vectors are what the sensors saw from where the vehicle truly was; the pose error is in the poses that
    come back, as in a real drive: the box and the grid stay those of the vehicle, and whoever projects the
    vectors with these poses meets the whole error.

    Parameters
    ----------
    truth : GeoDataFrame
        LineStrings with a `class` of `CLASS_NAMES`, metres; crossings are closed rings. The column
        ``element_id`` (else the index) names the elements.
    poses : DataFrame
        True poses: ``timestamp_ns,qw,qx,qy,qz,tx_m,ty_m,tz_m`` and optionally ``token`` (else the timestamp).
    seed : int
        Same seed, same drive; another seed is another drive.
    noise : Noise, optional
        The calibrated model by default.
    offset : tuple of float, default (0, 0)
        Added to the poses' east and north it gives coordinates of the truth.

    Returns
    -------
    SimulatedDrive
        Predictions and believed poses; the poses stay in the frame in which they came.

    Raises
    ------
    SchemaError
        If the truth has another class, or a geometry that is not a line.
    """
    noise = noise or Noise()
    elements = _true_elements(truth)
    tokens = poses["token" if "token" in poses else "timestamp_ns"].astype(str)
    world_to_ego = np.linalg.inv(_plane_matrices(poses))
    positions = poses[["tx_m", "ty_m"]].to_numpy(float) + np.asarray(offset)
    results = {
        token: _local_map(elements, matrix, position, noise, Dice(seed, frame, noise.shape_drive_share))
        for frame, (token, matrix, position) in enumerate(zip(tokens, world_to_ego, positions, strict=True))
    }
    return SimulatedDrive({"meta": _meta(), "results": results}, _believed(poses, noise, seed))


def _meta() -> dict[str, Any]:
    uses = dict.fromkeys(("use_lidar", "use_radar", "use_map", "use_external"), False)
    return {"use_camera": True, **uses, "output_format": "vector", "class_names": list(CLASS_NAMES)}


@dataclass(frozen=True)
class _TrueElement:
    """A true line: a crossing by its corners, any other followed at even steps."""

    element_id: Any
    label: int
    points: Array  # (n, 2), world frame
    arc: Array  # (n,), metres from the first point

    @property
    def closed(self) -> bool:
        return bool(np.array_equal(self.points[0], self.points[-1]))


def _true_elements(truth: gpd.GeoDataFrame) -> list[_TrueElement]:
    if "class" not in truth:
        raise SchemaError(f"the truth has no column class, only {', '.join(truth.columns)}")
    labels = pd.Index(CLASS_NAMES).get_indexer(truth["class"])
    lines = truth.geometry.to_numpy()
    wrong = (labels < 0) | (shapely.get_type_id(lines) != shapely.GeometryType.LINESTRING) | shapely.is_empty(lines)
    if wrong.any():
        row = truth.iloc[int(np.argmax(wrong))]
        raise SchemaError(
            f"feature {row.name} of the truth has class {row['class']!r} and geometry "
            f"{getattr(row.geometry, 'geom_type', None)}; give lines of {', '.join(CLASS_NAMES)}"
        )
    ids = (truth["element_id"] if "element_id" in truth else truth.index.to_series()).tolist()
    return [
        _TrueElement(element_id, int(label), *_followed(shapely.get_coordinates(line), even=bool(label)))
        for element_id, label, line in zip(ids, labels, lines, strict=True)
    ]


def _followed(points: Array, *, even: bool) -> tuple[Array, Array]:
    """Return a line's points, at even steps where asked, and their distance along the line."""
    arc = arc_lengths(points)
    if not even:
        return points, arc
    steps = np.linspace(0.0, arc[-1], int(np.ceil(arc[-1] / STEP_M)) + 1)
    followed = points_at(points, arc, steps)
    followed[-1] = points[-1]
    return followed, steps


def _plane_matrices(poses: pd.DataFrame) -> Array:
    """Return what eq. 1 does to the x and y of points at z = 0: the upper left 2 x 2 of each rotation."""
    q = poses[["qw", "qx", "qy", "qz"]].to_numpy(float)
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z)], [2 * (x * y + w * z), 1 - 2 * (x * x + z * z)]]
    return np.moveaxis(np.array(rows), -1, 0)


def _believed(poses: pd.DataFrame, noise: Noise, seed: int) -> pd.DataFrame:
    def draw(rng: np.random.Generator) -> Array:
        return rng.standard_normal(3)

    dice = (Dice(seed, frame, noise.pose_drive_share) for frame in range(len(poses)))
    units = np.array([each.mixed(draw, Part.POSE) for each in dice]).reshape(-1, 3)
    turn = np.radians(noise.pose_deg) * units[:, 2] / 2
    w, x, y, z = poses[["qw", "qx", "qy", "qz"]].to_numpy(float).T
    c, s = np.cos(turn), np.sin(turn)
    turned = {"qw": c * w - s * z, "qx": c * x - s * y, "qy": c * y + s * x, "qz": c * z + s * w}
    moved = {name: poses[name] + noise.pose_m * units[:, axis] for axis, name in enumerate(("tx_m", "ty_m"))}
    believed: pd.DataFrame = poses.assign(**turned, **moved)
    return believed


def _local_map(
    elements: list[_TrueElement], world_to_ego: Array, position: Array, noise: Noise, dice: Dice
) -> dict[str, list[Any]]:
    """Return one frame's entry of the predictions, the surest vector first."""
    seen: list[Vector] = []
    for row, element in enumerate(elements):
        points = (element.points - position) @ world_to_ego.T
        look = _look_at_crossing if element.label == 0 else _look_at_line
        for part, vertices in enumerate(look(points, element, row, noise, dice)):
            score = dice.rng(Part.SCORE, row, part).beta(*noise.score_true)
            seen.append((vertices, element.label, score, element.element_id))
    seen.extend(_false_detections(len(seen), noise, dice))
    seen.sort(key=lambda vector: -vector[2])
    backwards = [dice.rng(Part.REVERSE, number).random() < noise.reverse for number in range(len(seen))]
    return {
        "vectors": [
            np.round(vertices[:: -1 if back else 1], 3).tolist()
            for (vertices, *_), back in zip(seen, backwards, strict=True)
        ],
        "scores": [round(float(score), 3) for _, _, score, _ in seen],
        "labels": [label for _, label, _, _ in seen],
        "element_id": [element_id for *_, element_id in seen],
    }


def _look_at_line(points: Array, element: _TrueElement, row: int, noise: Noise, dice: Dice) -> Iterator[Array]:
    """Yield what is predicted for the stretches of a line that the box holds."""
    stretches = stretches_inside(points, closed=element.closed)
    if not stretches:
        return
    moved = points + _line_error(points, element, row, noise, dice)
    for piece, stretch in enumerate(stretches):
        key = (row, piece)
        if dice.rng(Part.MISSED, *key).random() < noise.missed:
            continue
        whole_ring = element.closed and len(stretch) == len(points)
        parts = [moved[stretch]] if whole_ring else _cut(moved[stretch], element, key, noise, dice)
        for number, part in enumerate(parts):
            vertices = thin_out(longest_inside(part), dice.rng(Part.VERTICES, *key, number))
            if vertices is not None:
                yield vertices


def _cut(points: Array, element: _TrueElement, key: tuple[int, int], noise: Noise, dice: Dice) -> list[Array]:
    """Take a bit off both ends of a line and split a share of the long ones."""
    ends_m = noise.of(element.label).cut_m * np.abs(dice.rng(Part.CUT, *key).standard_normal(2))
    chance, where = dice.rng(Part.SPLIT, *key).random(2)
    split = chance < noise.split and STEP_M * len(points) > _LONG_M
    return cut(points, ends_m, 0.25 + 0.5 * where if split else None)


def _line_error(points: Array, element: _TrueElement, row: int, noise: Noise, dice: Dice) -> Array:
    """Return the displacement of each point of a line, shape (n, 2), ego frame, metres."""
    kind = noise.of(element.label)
    sigma = kind.base_m + kind.slope * np.hypot(*points.T)

    def draw(rng: np.random.Generator) -> Array:
        return unit_noise(rng, element.arc, noise.correlation_m, periodic=element.closed)

    lateral, along = (sigma * dice.mixed(draw, part, row) for part in (Part.LATERAL, Part.ALONG))
    if element.closed and element.arc[-1] < 4 * noise.correlation_m:
        # A small ring moves as a whole: errors across its sides would turn a narrow island inside out.
        return np.column_stack([along, lateral])
    tangent = tangents(points)
    normal = tangent[:, ::-1] * [-1.0, 1.0]
    return np.asarray(lateral[:, None] * normal + noise.along * along[:, None] * tangent)


def _look_at_crossing(points: Array, _element: _TrueElement, row: int, noise: Noise, dice: Dice) -> Iterator[Array]:
    """Yield what is predicted for a crossing, cut by the box."""
    corners = points[:-1]
    if dice.rng(Part.MISSED, row).random() < noise.missed:
        return

    def draw(rng: np.random.Generator) -> Array:
        return rng.standard_normal((len(corners) + 2, 2))

    unit = dice.mixed(draw, Part.CROSSING, row)
    kind, centre = noise.crossing, corners.mean(axis=0)
    shift = (kind.base_m + kind.slope * np.hypot(*centre)) * unit[0]
    turn = np.radians(kind.turn_deg) * unit[1, 0]
    cosine, sine = (1 + kind.scale * unit[1, 1]) * np.array([np.cos(turn), np.sin(turn)])
    moved = (corners - centre) @ np.array([[cosine, sine], [-sine, cosine]]) + centre + shift
    ring = visible_ring(moved + kind.corner_m * unit[2:])
    if ring is not None:
        yield ring


def _false_detections(seen: int, noise: Noise, dice: Dice) -> Iterator[Vector]:
    """Yield vectors that answer to nothing: bent lines roughly along the vehicle, and crossings."""
    count = dice.rng(Part.FALSE_COUNT).binomial(seen, noise.false / (1 - noise.false))
    for number in range(count):
        rng = dice.rng(Part.FALSE, number)
        label = int(rng.integers(len(CLASS_NAMES)))
        score = float(rng.beta(*noise.score_false))
        centre = rng.uniform(-1, 1, 2) * (BOX - 5)
        heading, bend, length = rng.normal(0.0, 0.5), rng.normal(0.0, 0.02), rng.uniform(6.0, 20.0)
        axes = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
        if label == 0:
            across = np.array([[-2, -1], [2, -1], [2, 1], [-2, 1]]) * [rng.uniform(0.7, 1.0), length / 3]
            vertices = visible_ring(centre + across @ axes)
        else:
            along = np.arange(-length / 2, length / 2, STEP_M)
            line = centre + np.column_stack([along, bend * along**2]) @ axes
            vertices = thin_out(longest_inside(line), rng)
        if vertices is not None:
            yield vertices, label, score, None
