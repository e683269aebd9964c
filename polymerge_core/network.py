"""Step 2 of the published method: which polylines are to be merged (paper, Alg. 1 and eq. 2).

Two polylines of one class belong together when a vertex of either is nearer to the other than the proximity
threshold. The check looks at vertices: two lines that cross between their vertices do not pass it. The
connected components of the network are the sets that are merged into one element each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra

from polymerge_core.errors import InputError
from polymerge_core.polyline import project_points

#: Lines whose neighbours are looked for at once: bounds the memory where everything is near everything.
_CHUNK = 512

#: Lines of more vertices get an index of their segments.
_SHORT = 64

#: Vertices checked at once: a fraction of a second's work.
_VERTICES = 1_000_000

#: More pairs than this within the proximity are a mistake in the data or in the threshold (some 70 bytes each).
MAX_EDGES = 20_000_000


class Edges(NamedTuple):
    """Pairs of polylines to be merged; each pair once, ordered by first and second."""

    #: The lower position of the pair; int, shape (k,).
    first: NDArray[np.intp]
    #: The higher position of the pair; int, shape (k,).
    second: NDArray[np.intp]
    #: Smallest distance from a vertex of one to the other polyline, metres, nan where it was not measured;
    #: float, shape (k,).
    distance: NDArray[np.float64]

    @classmethod
    def none(cls) -> Edges:
        """Return a network without edges."""
        return cls(np.empty(0, np.intp), np.empty(0, np.intp), np.empty(0))


def polyline_merge_check(a: ArrayLike, b: ArrayLike, proximity: float) -> bool:
    """Whether two polylines of one class are to be merged (paper, Alg. 1).

    Parameters
    ----------
    a, b : array_like of float, shape (n, 2) and (m, 2)
        Vertices, metres.
    proximity : float
        Th_prox, metres. The comparison is strict: at exactly this distance they are not merged.

    Returns
    -------
    bool
        True if any vertex of one is nearer than `proximity` to the other polyline.

    Examples
    --------
    >>> polyline_merge_check([(0, 0), (4, 0)], [(4, 0.5), (8, 0.5)], 1.0)
    True
    >>> polyline_merge_check([(-4, 0), (4, 0)], [(0, -4), (0, 4)], 1.0)
    False
    """
    nearest = min(project_points(a, b).distance.min(), project_points(b, a).distance.min())
    return bool(nearest < proximity)


def merge_edges(
    lines: NDArray[np.object_],
    is_main: NDArray[np.bool_],
    proximity: float,
    *,
    distances: bool = True,
    advance: Callable[[int], object] | None = None,
) -> Edges:
    """Find all pairs that pass `polyline_merge_check` (paper, Alg. 1), for polylines of one class.

    Parameters
    ----------
    lines : ndarray of shapely LineString, shape (n,)
        Without zero-length segments, metres.
    is_main : ndarray of bool, shape (n,)
        Whether a polyline is the main map's (Lm = 1). Two of the main map get no edge.
    proximity : float
        Th_prox, metres.
    distances : bool, default True
        Whether to measure the distance of each pair; to merge, the pairs are enough.
    advance : callable, optional
        Called with the number of lines dealt with after each portion; may raise to stop the work.

    Returns
    -------
    Edges
        Pairs of positions in `lines`, with the distance that let them pass.

    Raises
    ------
    InputError
        If more than `MAX_EDGES` pairs pass.
    """
    if len(lines) == 0:
        return Edges.none()
    tree = shapely.STRtree(lines)
    check = _VertexCheck(lines, proximity)
    found = []
    count = 0
    for start in range(0, len(lines), _CHUNK):
        portion = lines[start : start + _CHUNK]
        first, second = tree.query(_boxes(portion, proximity))
        first += start
        wanted = (first < second) & ~(is_main[first] & is_main[second])
        for near in check.passing(first[wanted], second[wanted]):
            found.append(near)
            count += len(near[0])
            if count > MAX_EDGES:
                raise InputError(
                    f"more than {MAX_EDGES:,} pairs of polylines are within {proximity:g} m of each other; "
                    "choose a smaller proximity or a higher min_score, or merge the data in parts"
                )
            if advance is not None:
                advance(0)
        if advance is not None:
            advance(len(portion))
    first, second = (np.concatenate(column) for column in zip(*found, strict=True))
    order = np.lexsort((second, first))
    first, second = first[order], second[order]
    if not distances:
        return Edges(first, second, np.full(len(first), np.nan))
    there = shapely.distance(lines[second], check.vertices[first])
    back = shapely.distance(lines[first], check.vertices[second])
    return Edges(first, second, np.minimum(there, back))


def check_pairs(
    lines: NDArray[np.object_], others: NDArray[np.object_], proximity: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Find the pairs of a line and another one that pass `polyline_merge_check` (paper, Alg. 1).

    Parameters
    ----------
    lines, others : ndarray of LineString
        Metres.
    proximity : float
        Th_prox, metres.

    Returns
    -------
    first, second : ndarray of int, shape (m,)
        Positions in `lines` and in `others`, ordered by both.
    """
    first, second = shapely.STRtree(others).query(_boxes(lines, proximity))
    check = _VertexCheck(np.concatenate([lines, others]), proximity)
    found = list(check.passing(first, second + len(lines)))
    if not found:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    first, second = (np.concatenate(column) for column in zip(*found, strict=True))
    order = np.lexsort((second, first))
    return first[order], second[order] - len(lines)


def components(count: int, edges: Edges) -> NDArray[np.intp]:
    """Find the connected components of a network.

    Parameters
    ----------
    count : int
        Number of polylines.
    edges : Edges
        Pairs of positions below `count`.

    Returns
    -------
    ndarray of int, shape (count,)
        The component of each polyline; components are numbered in the order of their lowest member.
    """
    _, label = connected_components(_adjacency(count, edges), directed=False)
    _, lowest, label = np.unique(label, return_index=True, return_inverse=True)
    rank = np.empty(len(lowest), np.intp)
    rank[np.argsort(lowest)] = np.arange(len(lowest))
    numbered: NDArray[np.intp] = rank[label]
    return numbered


def breadth_first_depth(count: int, edges: Edges, roots: NDArray[np.intp]) -> NDArray[np.intp]:
    """Count the edges between each polyline and the root of its component.

    Parameters
    ----------
    count : int
        Number of polylines.
    edges : Edges
        Pairs of positions below `count`.
    roots : ndarray of int
        One polyline of each component.

    Returns
    -------
    ndarray of int, shape (count,)
        0 for the roots, 1 for their neighbours, and so on.

    Raises
    ------
    ValueError
        If a component has no root.
    """
    if count == 0:
        return np.empty(0, np.intp)
    # One more node that touches all roots turns many searches into one.
    joined = Edges(
        np.concatenate([edges.first, roots]),
        np.concatenate([edges.second, np.full(len(roots), count)]),
        np.concatenate([edges.distance, np.zeros(len(roots))]),
    )
    depth = dijkstra(_adjacency(count + 1, joined), directed=False, indices=count, unweighted=True)[:count]
    if not np.isfinite(depth).all():
        raise ValueError("a component of the network has no root")
    return depth.astype(np.intp) - 1


class _VertexCheck:
    """`polyline_merge_check` on arrays of pairs."""

    def __init__(self, lines: NDArray[np.object_], proximity: float) -> None:
        self.lines, self.vertices = lines, shapely.extract_unique_points(lines)
        # "At most the number just below" is "less than": the comparison of the paper is strict.
        self._within = np.nextafter(proximity, 0.0)
        self._size = shapely.get_num_coordinates(lines)
        # An index pays from here on; below, building it costs more than it saves.
        shapely.prepare(lines[self._size > _SHORT])

    def passing(
        self, first: NDArray[np.intp], second: NDArray[np.intp]
    ) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
        """Yield the pairs that pass, in portions of bounded work, so that a run can be stopped between two."""
        portion = np.cumsum(self._size[first] + self._size[second]) // _VERTICES
        for rows in np.split(np.arange(len(first)), np.flatnonzero(np.diff(portion)) + 1):
            one, other = first[rows], second[rows]
            near = shapely.dwithin(self.lines[other], self.vertices[one], self._within)
            near[~near] = shapely.dwithin(self.lines[one[~near]], self.vertices[other[~near]], self._within)
            yield one[near], other[near]


def _boxes(lines: NDArray[np.object_], margin: float) -> NDArray[np.object_]:
    """Return bounding boxes with a margin, and a micrometre more so that rounding loses no pair."""
    low_x, low_y, high_x, high_y = shapely.bounds(lines).T
    grown = margin + 1e-6
    boxes: NDArray[np.object_] = shapely.box(low_x - grown, low_y - grown, high_x + grown, high_y + grown)
    return boxes


def _adjacency(count: int, edges: Edges) -> coo_array:
    # A distance of 0 would read as "no edge" in a sparse matrix, so every edge weighs 1. Older scipy's graph
    # routines take 32-bit indices only.
    pairs = (edges.first.astype(np.int32), edges.second.astype(np.int32))
    return coo_array((np.ones(len(edges.first)), pairs), shape=(count, count)).tocsr()
