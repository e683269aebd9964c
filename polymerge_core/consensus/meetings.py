"""Lines that meet in the evidence meet in the map: ends drawn to the common point, or onto the line they end at.

Looks are averaged line by line, so that lines which one local map drew to one point end near each other and not there.
Where most local maps that saw the end of a line saw it touch another one, it is drawn to it: ends that touch ends to
their mean, an end that touches a line elsewhere onto that line, which gets a vertex there. The last few proximities of
a line follow its end, so that it has no kink.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from polymerge_core.consensus.alongside import REACH, boxes_of_kinds
from polymerge_core.consensus.looks import Looks
from polymerge_core.curves import Array, Curves, Index, best_of_each, distinct

#: Looks of one local map nearer than this touch, proximities.
_TOUCH = 0.01

#: This share of the local maps that saw the end of a line must have seen it touch the other one.
_MOST = 0.5

#: Over so many proximities a line follows its end.
_FOLLOWING = 5.0


class _Touches(NamedTuple):
    """Looks whose end touches another look of the same local map, one entry a touch."""

    #: The end of a merged line, two for each: twice its number, and one more for its last vertex.
    end: Index
    #: The merged line that it touches, and the end of that line that it touches, -1 where it is none.
    line: Index
    other: Index


def met(
    shapes: NDArray[np.object_], looks: list[Looks], element: list[Index], alone: NDArray[np.bool_]
) -> NDArray[np.object_]:
    """Draw the ends of merged lines to what they meet.

    Parameters
    ----------
    shapes : ndarray of LineString, shape (m,)
        The merged lines of all classes, metres.
    looks : list of Looks
        Of each class.
    element : list of ndarray of int, shape (p,)
        The merged line that each point of the looks went into, -1 for none.
    alone : ndarray of bool, shape (m,)
        Which lines are one look, as it is: two of them meet as they do, or do not.

    Returns
    -------
    ndarray of LineString, shape (m,)
    """
    if len(shapes) == 0:
        return shapes
    unit = looks[0].unit
    touches = _touches(shapes, looks, element, alone, unit)
    if len(touches.end) == 0:
        return shapes
    # Ends that touch ends are one place.
    ends = shapely.get_coordinates(shapely.get_point(np.repeat(shapes, 2), np.tile([0, -1], len(shapes))))
    joined = touches.other >= 0
    graph = coo_array(
        (np.ones(int(joined.sum())), (touches.end[joined], touches.other[joined])), shape=(len(ends),) * 2
    )
    _, place = connected_components(graph, directed=False)
    size = np.bincount(place)
    middle = np.column_stack([np.bincount(place, axis) / size for axis in ends.T])
    common = (size > 1)[place]
    shapes = _drawn_to(shapes, np.flatnonzero(common), middle[place[common]], unit)
    # An end that touches a line elsewhere takes its whole place along; of several lines to the nearest.
    end, line = touches.end[~joined], touches.line[~joined]
    away = shapely.distance(shapely.points(middle[place[end]]), shapes[line])
    best = best_of_each(place[end], -away, line)
    target = np.full(len(size), -1)
    target[place[end[best]]] = line[best]
    moving = np.flatnonzero((target[place] >= 0) & (np.arange(len(ends)) // 2 != target[place]))
    onto = target[place[moving]]
    for _ in range(2):
        # A line that another one ends at may be drawn somewhere itself.
        curves = Curves(shapes)
        feet = curves.points_at(onto, curves.locate(onto, middle[place[moving]]))
        shapes = _drawn_to(shapes, moving, feet, unit)
    return _with_vertices(shapes, onto, feet)


def _touches(
    shapes: NDArray[np.object_], looks: list[Looks], element: list[Index], alone: NDArray[np.bool_], unit: float
) -> _Touches:
    curves = [each.curves for each in looks]
    lines = np.concatenate([each.lines for each in curves])
    closed = np.concatenate([each.closed for each in curves])
    instance = np.concatenate([each.instance for each in looks])
    # Of each look the first of its points, and how many there are.
    counts = np.concatenate([np.bincount(each.owner, minlength=len(each)) for each in looks])
    first, went = np.cumsum(counts) - counts, np.concatenate(element)
    open_looks = np.flatnonzero(~closed)
    look = np.repeat(open_looks, 2)
    last = np.tile([False, True], len(open_looks))
    point = np.where(last, first[look] + counts[look] - 1, first[look])
    own = went[point]
    # Local maps touch as they were seen; where that is in the map, their points say, which were moved.
    there = shapely.points(np.concatenate([each.points for each in looks])[point])
    tips = shapely.get_point(lines[look], np.where(last, -1, 0))
    # Local map by local map: where many looked, each end has thousands of others about it.
    tree, around = boxes_of_kinds(lines, instance, tips, instance[look], _TOUCH * unit)
    tip, other = tree.query(around)
    kept = (look[tip] != other) & (own[tip] >= 0) & shapely.dwithin(tips[tip], lines[other], _TOUCH * unit)
    tip, other = tip[kept], other[kept]
    length = shapely.length(lines[other])
    along = shapely.line_locate_point(lines[other], tips[tip])
    line = went[first[other] + np.round(along / length * (counts[other] - 1)).astype(np.intp)]
    seen_end = _nearest_end(shapes, own, there, unit)
    at_end = ~closed[other] & (np.minimum(along, length - along) <= _TOUCH * unit)
    far = _nearest_end(shapes, np.where(at_end, line, -1), there[tip], unit)
    kept = (line >= 0) & (line != own[tip]) & (seen_end[tip] >= 0)
    kept &= ~(alone[np.maximum(own[tip], 0)] & alone[np.maximum(line, 0)])
    kept &= shapely.dwithin(there[tip], shapes[np.maximum(line, 0)], REACH * unit)
    tip, line, far = tip[kept], line[kept], far[kept]
    touches = _Touches(seen_end[tip], line, far)
    # Local maps that saw the end, and those that saw it touch that line.
    width = int(instance.max(initial=0)) + 1
    some = seen_end >= 0
    seen = np.bincount(distinct(seen_end[some] * width + instance[look[some]]) // width, minlength=2 * len(shapes))
    pair = touches.end * len(shapes) + touches.line
    said = distinct(pair * width + instance[look[tip]]) // width
    names, times = np.unique(said, return_counts=True)
    often = times[np.searchsorted(names, pair)] >= _MOST * seen[touches.end]
    return _Touches._make(column[often] for column in touches)


def _nearest_end(shapes: NDArray[np.object_], line: Index, points: NDArray[np.object_], unit: float) -> Index:
    """Return the end of its line that each point is at, -1 where it is near none, or there is no line."""
    known = np.maximum(line, 0)
    away = np.column_stack([shapely.distance(shapely.get_point(shapes[known], end), points) for end in (0, -1)])
    near = (line >= 0) & ~shapely.is_closed(shapes[known]) & (away.min(axis=1) <= REACH * unit)
    return np.where(near, 2 * known + away.argmin(axis=1), -1)


def _drawn_to(shapes: NDArray[np.object_], ends: Index, points: Array, unit: float) -> NDArray[np.object_]:
    """Draw ends of lines to points, not farther than lines are ever compared, and the lines after them."""
    curves = Curves(shapes)
    vertex = np.where(ends % 2 == 1, curves.bounds[ends // 2 + 1] - 1, curves.bounds[ends // 2])
    step = np.zeros((2 * len(shapes), 2))
    step[ends] = points - curves.vertices[vertex]
    step[np.hypot(*step.T) > REACH * unit] = 0.0
    line, arc, length = curves.owner, curves.arc, curves.length[curves.owner]
    moved = curves.vertices.copy()
    reach = np.minimum(_FOLLOWING * unit, length / 2)
    for which, away in ((0, arc), (1, length - arc)):
        moved += step[2 * line + which] * np.clip(1 - away / reach, 0.0, 1.0)[:, None]
    # Sums round: an end is exactly where it is drawn to.
    reached = (step[ends] != 0.0).any(axis=1)
    moved[vertex[reached]] = points[reached]
    return np.asarray(shapely.linestrings(moved, indices=line))


def _with_vertices(shapes: NDArray[np.object_], line: Index, points: Array) -> NDArray[np.object_]:
    """Return lines with vertices at points on them."""
    curves = Curves(shapes)
    place = curves.locate(line, points)
    new = (place > 0) & (place < curves.length[line])
    owner = np.concatenate([curves.owner, line[new]])
    order = np.lexsort((np.concatenate([curves.arc, place[new]]), owner))
    every = np.concatenate([curves.vertices, points[new]])[order]
    drawn = shapely.linestrings(every, indices=owner[order])
    return np.asarray(shapely.remove_repeated_points(drawn, 0.0))
