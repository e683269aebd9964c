"""Rotations as unit quaternions (scalar first) and as matrices."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: Departure from a unit quaternion or a rigid matrix that is taken for rounding in a file.
RIGID_TOLERANCE = 1e-3


def quaternion_to_matrix(quaternion: ArrayLike) -> Array:
    """Turn quaternions into rotation matrices, those of ``q v q^-1``.

    Parameters
    ----------
    quaternion : array_like of float, shape (k, 4)
        w, x, y, z: scalar first. They need not be of unit length, only not zero.

    Returns
    -------
    ndarray of float, shape (k, 3, 3)

    Examples
    --------
    >>> quaternion_to_matrix([[0.0, 0.0, 0.0, 1.0]])[0].tolist()
    [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    q = np.asarray(quaternion, dtype=np.float64).reshape(-1, 4)
    w, (x, y, z) = q[:, 0], q[:, 1:].T
    cross = np.zeros((len(q), 3, 3))  # the matrix of v -> (x, y, z) x v
    cross[:, (2, 0, 1), (1, 2, 0)] = np.column_stack([x, y, z])
    cross[:, (1, 2, 0), (2, 0, 1)] = -np.column_stack([x, y, z])
    scale = (2.0 / (q**2).sum(axis=1))[:, None, None]
    turned: Array = np.eye(3) + scale * (w[:, None, None] * cross + cross @ cross)
    return turned


def heading_to_matrix(heading_deg: ArrayLike) -> Array:
    """Turn headings into level attitudes in an east-north-up frame.

    Parameters
    ----------
    heading_deg : array_like of float, shape (k,)
        Degrees clockwise from north.

    Returns
    -------
    ndarray of float, shape (k, 3, 3)
        The columns are forward, left and up.

    Examples
    --------
    >>> heading_to_matrix([0.0])[0].tolist()
    [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    angle = np.radians(np.asarray(heading_deg, dtype=np.float64))
    attitude = np.zeros((len(angle), 3, 3))
    attitude[:, 0, 0] = attitude[:, 1, 1] = np.sin(angle)
    attitude[:, 1, 0] = np.cos(angle)
    attitude[:, 0, 1] = -np.cos(angle)
    attitude[:, 2, 2] = 1.0
    return attitude


def is_rigid(rotation: Array) -> NDArray[np.bool_]:
    """Say of 3x3 matrices, shape (k, 3, 3), which are rotations within `RIGID_TOLERANCE`, shape (k,)."""
    gram = np.swapaxes(rotation, -1, -2) @ rotation
    orthonormal = np.abs(gram - np.eye(3)).max(axis=(-1, -2), initial=0.0) <= RIGID_TOLERANCE
    return np.asarray(orthonormal & (np.linalg.det(rotation) > 0.0))


def is_rigid_motion(matrix: ArrayLike) -> bool:
    """Say whether this is one 4x4 matrix of a rotation, a translation, and 0, 0, 0, 1 below them."""
    try:
        motion = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError):  # no numbers, or rows that differ in length
        return False
    if motion.shape != (4, 4) or not np.isfinite(motion).all():
        return False
    last_row = np.allclose(motion[3], (0.0, 0.0, 0.0, 1.0), rtol=0.0, atol=RIGID_TOLERANCE)
    return bool(last_row and is_rigid(motion[None, :3, :3])[0])
