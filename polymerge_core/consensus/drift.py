"""How each drive strays from where the drives together say the lines are: a smooth shift along its way.

Positioning and calibration put a whole drive beside the others, half a lane at worst, and what they are off changes
slowly along it. Only the lateral part can be told from lines. It is estimated as a Gaussian process: small, and alike
at places that are near each other (Rasmussen and Williams 2006, chapter 2; the kernel is Wendland's of 1995, which is
zero beyond its range, so that the equations stay sparse).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from polymerge_core.consensus.axes import told_apart
from polymerge_core.consensus.fusion import HALF_WEIGHT, Fit
from polymerge_core.consensus.looks import DRIVES, Looks, dot
from polymerge_core.curves import Array, Index

#: Standard deviation that is held likely of a drive's shift, proximities.
_SHIFT = 0.5

#: Places farther apart than this know nothing of each other, proximities.
_RANGE = 150.0

#: What lines say is gathered over so many proximities.
_STRETCH = 10.0


class Drift(NamedTuple):
    """The shift of each drive, as a sum of bumps about places along its lines."""

    drive: Index
    place: Array
    #: How far each bump shifts what lies at its place, metres east and north.
    push: Array
    reach: float

    def at(self, drive: Index, points: Array) -> Array:
        """Return the shifts of points of given drives, metres, shape (p, 2)."""
        if len(self.drive) == 0:
            return np.zeros((len(points), 2))
        return np.asarray(_kernel(drive, points, self.drive, self.place, self.reach) @ self.push)

    def followed(self, shapes: NDArray[np.object_], drive: Index) -> NDArray[np.object_]:
        """Return shapes of given drives, each shifted as a whole as its middle is."""
        shift = self.at(drive, shapely.get_coordinates(shapely.centroid(shapes)))
        points, owner = shapely.get_coordinates(shapes, return_index=True)
        return np.asarray(shapely.set_coordinates(shapes.copy(), points + shift[owner]))


def no_drift() -> Drift:
    """Return the drift before anything is known of it."""
    return Drift(np.empty(0, np.intp), np.empty((0, 2)), np.empty((0, 2)), 1.0)


class Pulls(NamedTuple):
    """What lines say of the drift, one entry a stretch of a drive's line."""

    drive: Index
    place: Array
    #: Direction to the left of the line.
    normal: Array
    #: How far to that side the drive should be shifted, metres, and the variance of that.
    by: Array
    variance: Array
    #: The drives that the line is the mean of: one, but for those of the map that was known before.
    drives: Array


def pulls(tracks: Looks, fit: Fit, drift: Drift) -> Pulls:
    """Say what the lines of one class say of the drift.

    Parameters
    ----------
    tracks : Looks
        The lines of each drive, shifted by what is known of the drift.
    fit : Fit
        The lines of all drives together.
    drift : Drift
        By what they were shifted.
    """
    rows = np.flatnonzero(fit.used)
    owner = tracks.owner[rows]
    count = np.maximum(np.round(tracks.curves.length / (_STRETCH * tracks.unit)), 1)
    share = tracks.arc[rows] / np.maximum(tracks.curves.length[owner], np.finfo(float).tiny)
    number = np.minimum(share * count[owner], count[owner] - 1).astype(np.intp)
    _, stretch = np.unique(owner * (int(count.max(initial=1)) + 1) + number, return_inverse=True)
    size = np.bincount(stretch)

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(stretch, values) / size)

    drive = np.zeros(len(size), np.intp)
    drive[stretch] = tracks.instances.drive[tracks.instance[owner]]
    tangent = fit.feet.tangent[rows]
    normal = np.column_stack([mean(-tangent[:, 1]), mean(tangent[:, 0])])
    normal /= np.maximum(np.hypot(*normal.T), np.finfo(float).tiny)[:, None]
    place = np.column_stack([mean(axis) for axis in tracks.points[rows].T])
    residual, sigma = mean(fit.feet.lateral[rows]), np.sqrt(mean(fit.sigma[rows] ** 2))
    before = dot(normal, drift.at(drive, place))
    variance = sigma**2 * (1 + (residual / (HALF_WEIGHT * sigma)) ** 2)
    drives = np.maximum(mean(np.nan_to_num(tracks.past[rows, DRIVES], nan=1.0)), 1.0)
    return Pulls(drive, place, normal, before - residual, variance, drives)


def estimate_drift(pulls: list[Pulls], unit: float) -> Drift:
    """Estimate the drift of all drives from the lines of all classes.

    Parameters
    ----------
    pulls : list of Pulls
        One entry a class.
    unit : float
        The proximity, metres.
    """
    if not any(len(each.drive) for each in pulls):
        return no_drift()
    every = Pulls._make(np.concatenate(column) for column in zip(*pulls, strict=True))
    reach = _RANGE * unit
    alike = _kernel(every.drive, every.place, every.drive, every.place, reach).tocoo()
    together = dot(every.normal[alike.row], every.normal[alike.col])
    # The mean of several drives strays less.
    likely = _SHIFT * unit / np.sqrt(every.drives)
    covariance = likely[alike.row] * likely[alike.col] * together * alike.data
    matrix = csr_array((covariance, (alike.row, alike.col)), shape=alike.shape)
    solved = np.atleast_1d(spsolve((matrix + diags_array(every.variance)).tocsc(), every.by))
    return Drift(every.drive, every.place, (likely**2 * solved)[:, None] * every.normal, reach)


def _kernel(drive: Index, points: Array, others: Index, places: Array, reach: float) -> csr_array:
    """Return how alike the shifts are at points and places of the same drive: 1 at no distance, 0 from `reach` on."""
    trees = [cKDTree(told_apart(where, which)) for where, which in ((points, drive), (places, others))]
    near = trees[0].sparse_distance_matrix(trees[1], reach, output_type="coo_matrix")
    share = near.data / reach
    value = (1 - share) ** 4 * (4 * share + 1)
    return csr_array((value, (near.row, near.col)), shape=near.shape)
