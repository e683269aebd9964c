"""From looks that overlap by pairs to positions along one line: where along its line each look begins, and which way.

Each pair says how a position along the one is a position along the other. The ways round are settled along a spanning
tree of the closest pairs, the positions by least squares over all pairs (synchronisation): no look is the first.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.sparse.linalg import cg

from polymerge_core.consensus.alongside import Pairs
from polymerge_core.consensus.axes import Axes
from polymerge_core.consensus.looks import Looks
from polymerge_core.curves import Array, Index
from polymerge_core.network import Edges, breadth_first_depth, components

#: Weight of a look's own zero against that of its pairs: enough to make the equations solvable, too little to matter.
_ANCHOR = 1e-6

#: Proximities by which steps along a line may be longer than one, all of them together.
_TRIFLE = 0.01

#: The least squares are solved (conjugate gradients) to this share of what the spanning tree leaves, in so many steps.
_EXACT, _STEPS = 1e-6, 100


def first_axes(looks: Looks, pairs: Pairs, group: Index, weight: Array) -> Axes:
    """Draw the first line of each group: the weighted mean of its looks at each position.

    Parameters
    ----------
    looks : Looks
        Of one class.
    pairs : Pairs
        From `pairs_alongside`.
    group : ndarray of int, shape (n,)
        The group of each look, 0, 1, ...; each group connected by pairs.
    weight : ndarray of float, shape (p,)
        Of each point.

    Returns
    -------
    Axes
        One line a group.
    """
    own = pairs.take((group[pairs.short] == group[pairs.long]) & (pairs.overlap > 0))
    sense, begin = _along_tree(len(looks), own)
    begin = _beginnings(len(looks), own, sense, begin)
    position = (sense[looks.owner] * looks.arc + begin[looks.owner]) / looks.unit
    of_point, count = group[looks.owner], int(group.max()) + 1
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, of_point, position)
    np.maximum.at(high, of_point, position)
    # Equal steps from end to end, so that both ends are alike; of one proximity, or little more, so that a line that
    # grew by a trifle is not cut into other steps than its looks.
    extent = np.maximum(high - low, np.finfo(float).tiny)
    steps = np.maximum(np.ceil(extent - _TRIFLE), 1).astype(np.intp)
    place = np.round((position - low[of_point]) / extent[of_point] * steps[of_point]).astype(np.intp)
    sizes = steps + 1
    station = (np.cumsum(sizes) - sizes)[of_point] + place
    total = np.bincount(station, weight, minlength=int(sizes.sum())).astype(float)
    sums = [np.bincount(station, weight * axis, minlength=len(total)) for axis in looks.points.T]
    mean = np.column_stack(sums) / np.where(total > 0, total, 1.0)[:, None]
    line = np.repeat(np.arange(count), sizes)
    mean[total == 0] = _mean_points(looks, of_point, count)[line[total == 0]]
    return _with_rings(looks, group, Axes(mean, line).smoothed(total))


def _with_rings(looks: Looks, group: Index, axes: Axes) -> Axes:
    """Take a look itself where a group's looks are rings for the most part: the one of middle length."""
    curves = looks.curves
    count = int(group.max()) + 1
    length = np.bincount(group, curves.length, minlength=count)
    closed = np.bincount(group, curves.length * curves.closed, minlength=count)
    chosen = np.flatnonzero(curves.closed & (closed > length / 2)[group])
    if len(chosen) == 0:
        return axes
    order = chosen[np.lexsort((curves.length[chosen], group[chosen]))]
    _, first, size = np.unique(group[order], return_index=True, return_counts=True)
    ring = order[first + size // 2]
    points, owner = curves.resampled(ring, np.zeros(len(ring)), curves.length[ring], looks.unit)
    stays = ~np.isin(axes.line, group[ring])
    line = np.concatenate([axes.line[stays], group[ring][owner]])
    rank = np.argsort(line, kind="stable")
    return Axes(np.concatenate([axes.stations[stays], points])[rank], line[rank])


def _mean_points(looks: Looks, of_point: Index, count: int) -> Array:
    sizes = np.bincount(of_point, minlength=count)
    return np.column_stack([np.bincount(of_point, axis, minlength=count) / sizes for axis in looks.points.T])


def _along_tree(count: int, pairs: Pairs) -> tuple[Array, Array]:
    """Lay looks end to end along a spanning tree of their group: which way round each runs, 1 or -1, and its beginning.

    Returns
    -------
    sense, begin : ndarray of float, shape (n,)
        ``sense * position on the look + begin`` is a position along the line, metres.
    """
    # The closest and longest overlaps are the surest; a spanning tree takes those first. Costs must not be zero.
    cost = (1.0 + pairs.square) / pairs.overlap
    graph = coo_array((cost, (pairs.short, pairs.long)), shape=(count, count))
    chosen = minimum_spanning_tree(graph.tocsr()).tocoo()
    first, second = chosen.row.astype(np.intp), chosen.col.astype(np.intp)
    name = pairs.short * count + pairs.long
    order = np.argsort(name)
    pair = order[np.searchsorted(name, first * count + second, sorter=order)]
    edges = Edges(first, second, np.zeros(len(first)))
    roots = np.unique(components(count, edges), return_index=True)[1]
    depth = breadth_first_depth(count, edges, roots)
    # In a tree each look but the root hangs from the one end of one edge: position on its parent from that on itself.
    from_long = depth[first] > depth[second]
    hung = np.where(from_long, first, second)
    parent, sense, begin = np.arange(count), np.ones(count), np.zeros(count)
    parent[hung], sense[hung] = first + second - hung, pairs.sense[pair]
    begin[hung] = np.where(from_long, pairs.shift[pair], -pairs.sense[pair] * pairs.shift[pair])
    # Each look takes its parent's place, then its parent's parent's, and so on, in steps twice as long each time.
    while not np.array_equal(parent, grandparent := parent[parent]):
        begin, sense = sense[parent] * begin + begin[parent], sense * sense[parent]
        parent = grandparent
    return sense, begin


def _beginnings(count: int, pairs: Pairs, sense: Array, begin: Array) -> Array:
    """Return where each look's position 0 lies along its line, metres, by least squares over all pairs."""
    agree = pairs.take(sense[pairs.long] == sense[pairs.short] * pairs.sense)
    short, long, weight = agree.short, agree.long, agree.overlap
    # sense_long * (sense * x + shift) + begin_long = sense_short * x + begin_short, for every x of the overlap.
    ahead = -sense[long] * agree.shift
    rows, columns = np.concatenate([short, long, short, long]), np.concatenate([short, long, long, short])
    values = np.concatenate([weight, weight, -weight, -weight])
    matrix = coo_array((values, (rows, columns)), shape=(count, count)) + diags_array(np.full(count, _ANCHOR))
    target = np.bincount(long, weight * ahead, minlength=count) - np.bincount(short, weight * ahead, minlength=count)
    # Where looks that overlap lie is settled in few steps. How a long line stretches as a whole is not, nor does it
    # matter.
    scale = diags_array(1.0 / matrix.diagonal())
    found, _ = cg(matrix.tocsr(), target, x0=begin, rtol=_EXACT, maxiter=_STEPS, M=scale)
    return np.asarray(found)
