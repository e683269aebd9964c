"""What the consensus works on: the looks at one class of lines, as flat arrays.

A look is one observation: what one local map saw of one line. All lengths are in units of the proximity, which is the
only scale of the method: a look is followed at steps of one proximity, and so is a merged line.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from polymerge_core.curves import Array, Curves, Index, count_up

#: What is known of a place of a line: 1 / variance, 1 / m2, but for what drives share; the local maps that saw it, and
#: that should have; the drives that saw it, and that should have.
PAST = ("knowledge", "seen", "expected", "seen_drives", "expected_drives")

#: The column of the drives that saw it.
DRIVES = PAST.index("seen_drives")

#: Directions are taken over this many proximities to either side.
_HALF_CHORD = 1.5


@dataclass(frozen=True)
class Instances:
    """The local maps behind the looks, one entry a local map.

    Parameters
    ----------
    drive : ndarray of int, shape (k,)
        Which drive each belongs to.
    footprint : ndarray of Polygon, shape (k,), or None
        The area that each looked at, metres; None where it is not known.
    position : ndarray of float, shape (k, 2)
        Where each was taken, metres; NaN where it is not known.
    heading : ndarray of float, shape (k,)
        Direction of each, radians counter-clockwise from x; NaN where it is not known.
    known : int, optional
        The row that stands for the map that was known before, a drive of its own; -1 if there was none.
    """

    drive: Index
    footprint: NDArray[np.object_] | None
    position: Array
    heading: Array
    known: int = -1

    def __len__(self) -> int:
        return len(self.drive)

    def with_known(self, area: shapely.Geometry | None) -> Instances:
        """Return the local maps and, as the last one, the map that was known before; `area` is what it covers."""
        footprint = None
        if self.footprint is not None and area is not None:
            footprint = np.append(self.footprint, np.array([area], dtype=object))
            shapely.prepare(footprint)
        drive = np.append(self.drive, int(self.drive.max(initial=-1)) + 1)
        position = np.vstack([self.position, [np.nan, np.nan]])
        return Instances(drive, footprint, position, np.append(self.heading, np.nan), len(self))

    def by_drive(self) -> Instances:
        """Return the drives, each as one local map that looked wherever any of its frames did."""
        count = int(self.drive.max(initial=-1)) + 1
        footprint = None
        if self.footprint is not None:
            order = np.argsort(self.drive, kind="stable")
            parts = np.split(self.footprint[order], np.flatnonzero(np.diff(self.drive[order])) + 1)
            footprint = np.array([shapely.union_all(part) for part in parts], dtype=object)
            shapely.prepare(footprint)
        unknown = np.full(count, np.nan)
        known = -1 if self.known < 0 else int(self.drive[self.known])
        return Instances(np.arange(count), footprint, np.column_stack([unknown, unknown]), unknown, known)


@dataclass(frozen=True)
class Looks:
    """Looks at lines of one class, and points along them.

    Parameters
    ----------
    curves : Curves
        The looks, metres.
    instance : ndarray of int, shape (n,)
        The local map of each look.
    weight : ndarray of float, shape (n,)
        How much each counts: its score, times the observations that it stands for.
    instances : Instances
        The local maps.
    unit : float
        The proximity, metres.
    owner : ndarray of int, shape (p,)
        The look of each point.
    arc, metres : ndarray of float, shape (p,)
        Where each point lies along its look, and how much of it it stands for, metres.
    points, tangent : ndarray of float, shape (p, 2)
        The points, moved by what registration found, and the direction of their look there.
    past : ndarray of float, shape (p, 5)
        Of points of the map that was known before, what `PAST` names; NaN for all others.
    """

    curves: Curves
    instance: Index
    weight: Array
    instances: Instances
    unit: float
    owner: Index
    arc: Array
    metres: Array
    points: Array
    tangent: Array
    past: Array

    @classmethod
    def of(cls, lines: NDArray[np.object_], instance: Index, weight: Array, instances: Instances, unit: float) -> Looks:
        """Follow lines at steps of one proximity."""
        curves = Curves(lines)
        every = np.arange(len(curves))
        points, owner = curves.resampled(every, np.zeros(len(curves)), curves.length, unit)
        counts = np.bincount(owner, minlength=len(curves))
        _, number = count_up(counts)
        arc = number * (curves.length / (counts - 1))[owner]
        tangent = direction_at(curves, owner, arc, _HALF_CHORD * unit)
        metres = (curves.length / counts)[owner]
        unknown = np.broadcast_to(np.nan, (len(owner), len(PAST)))
        return cls(curves, instance, weight, instances, unit, owner, arc, metres, points, tangent, unknown)

    def __len__(self) -> int:
        return len(self.curves)

    @property
    def knowledge(self) -> Array:
        """How much was known of each point before, 1 / m2; NaN where it is new."""
        return self.past[:, 0]

    @property
    def point_instance(self) -> Index:
        """The local map of each point."""
        return self.instance[self.owner]

    @property
    def distance(self) -> Array:
        """How far each point was from where its local map was taken, metres; 0 where that is not known."""
        away = np.hypot(*(self.points - self.instances.position[self.point_instance]).T)
        return np.nan_to_num(away)

    def redrawn(self) -> Looks:
        """Return the looks as they lie now, through their points."""
        curves = Curves(shapely.linestrings(self.points, indices=self.owner))
        tangent = direction_at(curves, self.owner, curves.arc, _HALF_CHORD * self.unit)
        metres = (curves.length / np.bincount(self.owner, minlength=len(curves)))[self.owner]
        return replace(self, curves=curves, arc=curves.arc, metres=metres, tangent=tangent)

    def and_also(self, other: Looks) -> Looks:
        """Return these looks and others of the same local maps."""
        curves = Curves(np.concatenate([self.curves.lines, other.curves.lines]))
        owner = np.concatenate([self.owner, len(self) + other.owner])
        names = ("instance", "weight", "arc", "metres", "points", "tangent", "past")
        both = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in names}
        return Looks(curves=curves, instances=self.instances, unit=self.unit, owner=owner, **both)

    def remembering(self, past: Array) -> Looks:
        """Return the same looks with what is known of their points."""
        return replace(self, past=past)

    def moved(self, points: Array) -> Looks:
        """Return the same looks with their points elsewhere."""
        return replace(self, points=points)


def direction_at(curves: Curves, line: Index, position: Array, half: float) -> Array:
    """Return unit vectors along lines at positions, from the chord over `half` metres to either side."""
    around = curves.closed[line]
    low = np.where(around, position - half, np.maximum(position - half, 0.0))
    high = np.where(around, position + half, np.minimum(position + half, curves.length[line]))
    chord = curves.points_at(line, high) - curves.points_at(line, low)
    length = np.maximum(np.hypot(chord[:, 0], chord[:, 1]), np.finfo(float).tiny)
    return np.asarray(chord / length[:, None])


def cross(first: Array, second: Array) -> Array:
    """Return how far `second` lies to the left of unit vectors `first`."""
    return np.asarray(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])


def dot(first: Array, second: Array) -> Array:
    """Return how far `second` reaches along unit vectors `first`."""
    return np.asarray(first[:, 0] * second[:, 0] + first[:, 1] * second[:, 1])
