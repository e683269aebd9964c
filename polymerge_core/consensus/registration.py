"""A small rigid correction for each local map, from all of its lines together.

A local map whose pose is wrong shows every line of it displaced alike. What its lines say together, against lines to
which the other local maps have contributed, is a shift and a turn; it is held to what an error of a pose can be.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from polymerge_core.consensus.fusion import CORRELATION, SHARED, Fit
from polymerge_core.consensus.looks import Looks, cross
from polymerge_core.curves import Array, Index

#: Standard deviations that are held likely for the pose of a local map: shift along each axis, proximities, and turn.
_SHIFT, _TURN_DEG = 0.3, 1.0


class Normal(NamedTuple):
    """Normal equations of the corrections (east, north, turn): `matrix` (k, 3, 3), `target` (k, 3), one a local map."""

    matrix: Array
    target: Array

    def add(self, other: Normal) -> Normal:
        """Return the equations of both."""
        return Normal(self.matrix + other.matrix, self.target + other.target)


def centres(looks: list[Looks], count: int) -> Array:
    """Return the place that each local map is turned about: where it was taken, else the middle of its looks."""
    owner = np.concatenate([each.point_instance for each in looks])
    points = np.concatenate([each.points for each in looks])
    size = np.maximum(np.bincount(owner, minlength=count), 1)
    middle = np.column_stack([np.bincount(owner, axis, minlength=count) / size for axis in points.T])
    known = looks[0].instances.position
    return np.where(np.isfinite(known), known, middle)


def equations(looks: Looks, fit: Fit, centre: Array) -> Normal:
    """Say what the lines of one class say of the corrections of all local maps.

    Parameters
    ----------
    looks : Looks
        Of one class.
    fit : Fit
        What was fitted to them.
    centre : ndarray of float, shape (k, 2)
        What each local map is turned about.
    """
    count = len(centre)
    rows = np.flatnonzero(fit.used)
    instance, tangent = looks.point_instance[rows], fit.feet.tangent[rows]
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    arm = looks.points[rows] - centre[instance]
    # How the distance to the left of the line changes with a shift east, a shift north, and a turn.
    change = np.column_stack([normal, cross(arm, normal)])
    residual, sigma = fit.feet.lateral[rows], np.hypot(fit.sigma[rows], SHARED * looks.unit)
    weight = looks.metres[rows] / (CORRELATION * looks.unit) / sigma**2 / (1 + (residual / (2 * sigma)) ** 2)
    matrix, target = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for row in range(3):
        target[:, row] = -np.bincount(instance, weight * change[:, row] * residual, minlength=count)
        for column in range(3):
            product = weight * change[:, row] * change[:, column]
            matrix[:, row, column] = np.bincount(instance, product, minlength=count)
    return Normal(matrix, target)


def corrections(equations: Normal, so_far: Array, unit: float) -> Array:
    """Solve for the corrections, held to small ones together with what was corrected before.

    Parameters
    ----------
    equations : Normal
        Of all classes.
    so_far : ndarray of float, shape (k, 3)
        Corrections already made: metres, metres, radians.
    unit : float
        The proximity, metres.

    Returns
    -------
    ndarray of float, shape (k, 3)
        What to correct on top of them.
    """
    likely = np.array([_SHIFT * unit, _SHIFT * unit, np.radians(_TURN_DEG)]) ** -2.0
    matrix = equations.matrix + np.diag(likely)
    target = equations.target - likely * so_far
    return np.asarray(np.linalg.solve(matrix, target[..., None])[..., 0], dtype=np.float64)


def corrected(looks: Looks, correction: Array, centre: Array) -> Looks:
    """Return the looks with their points moved by the corrections of their local maps."""
    moved = correction[looks.point_instance]
    arm = looks.points - centre[looks.point_instance]
    turned = moved[:, 2:] * np.column_stack([-arm[:, 1], arm[:, 0]])
    return looks.moved(looks.points + moved[:, :2] + turned)


def moved_by(shapes: NDArray[np.object_], instance: Index, correction: Array, centre: Array) -> NDArray[np.object_]:
    """Return geometries moved by the corrections of their local maps."""
    coordinates, owner = shapely.get_coordinates(shapes, return_index=True)
    which = instance[owner]
    arm = coordinates - centre[which]
    turned = correction[which, 2:] * np.column_stack([-arm[:, 1], arm[:, 0]])
    return np.asarray(shapely.set_coordinates(shapes.copy(), coordinates + correction[which, :2] + turned))
