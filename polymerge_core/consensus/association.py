"""Which looks show the same line: average linkage of lateral distances, under what one local map saw side by side.

Looks that run closest together are put together first, and groups go on being put together while the root mean square
distance between their looks is below a limit. Two lines that one local map saw side by side are different lines
(cannot-link; Wagstaff et al. 2001, "Constrained k-means clustering with background knowledge"): groups are kept apart
where many local maps saw both.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.sparse import csr_array

from polymerge_core.consensus.alongside import REACH, Pairs
from polymerge_core.consensus.looks import Looks
from polymerge_core.curves import Array, Index

#: Groups that more than this share of the local maps of the smaller one saw side by side are different lines. Fewer
#: only drew one twice, or invented one beside it. A local map that saw them so over half their length counts half. When
#: groups are complete it is the share of the metres of the shorter one.
SIDE_BY_SIDE = 0.4


def associate(looks: Looks, pairs: Pairs) -> Index:
    """Group looks at the same line.

    Parameters
    ----------
    looks : Looks
        Of one class.
    pairs : Pairs
        From `pairs_alongside`.

    Returns
    -------
    ndarray of int, shape (n,)
        The group of each look, numbered from 0 in the order of their first looks.

    Notes
    -----
    The limit is one proximity. Where the footprints say that both local maps looked at the place, and neither saw two
    lines, it rises to `REACH` proximities: that two lines were never seen together is evidence that they are one.
    """
    same = (looks.instance[pairs.short] == looks.instance[pairs.long]) & (pairs.parallel > 0)
    side_by_side = np.where(same, pairs.overlap + pairs.apart, 0.0)
    reach = REACH * looks.unit
    square = np.where(same, 0.0, pairs.overlap * pairs.square + pairs.apart * reach**2)
    metres = np.where(same, 0.0, pairs.overlap + pairs.apart)
    covisible = np.where(same, 0.0, pairs.covisible * pairs.overlap)
    links = Links(pairs.short, pairs.long, square, metres, covisible, side_by_side)
    return link_groups(looks.instance, looks.curves.length, links, looks.unit)


class Links(NamedTuple):
    """What is known of pairs, one entry a pair; of pairs of groups it is the sum of those of their members."""

    first: Index
    second: Index
    #: Square of the distance times the length over which it was measured, and that length.
    square: Array
    metres: Array
    #: Length of it that both local maps looked at.
    covisible: Array
    #: Length over which one local map saw both, side by side.
    side_by_side: Array

    def take(self, rows: NDArray[np.bool_]) -> Links:
        """Return some of the links."""
        return Links._make(column[rows] for column in self)


def link_groups(instance: Index, size: Array, links: Links, unit: float) -> Index:
    """Put together what is closest, until nothing is close enough.

    Parameters
    ----------
    instance : ndarray of int, shape (n,)
        The local map of each look.
    size : ndarray of float, shape (n,)
        Length of each look.
    links : Links
        Pairs of looks.
    unit : float
        The limit of the root mean square distance.

    Returns
    -------
    ndarray of int, shape (n,)
        The group of each look, numbered from 0 in the order of their first looks.
    """
    group = np.arange(len(instance))
    seen = csr_array((size, (group, instance)), shape=(len(group), int(instance.max(initial=0)) + 1))
    for apart in (_apart, _apart_at_length):
        while True:
            # What is too far apart with all that it has links with stays so: a mean lies between what it is made of.
            cost = _costs(links, unit)
            open_to = np.zeros(seen.shape[0], dtype=bool)
            for end in (links.first, links.second):
                open_to[end[cost < 1.0]] = True
            alive = open_to[links.first] & open_to[links.second]
            links, cost = links.take(alive), cost[alive]
            near = _mutually_nearest(links, np.where(apart(links, seen), np.inf, cost), seen.shape[0])
            if len(near) == 0:
                break
            into = np.arange(seen.shape[0])
            into[links.second[near]] = links.first[near]
            kept, new = np.unique(into, return_inverse=True)
            group, links = new[group], _joined(links, new)
            seen = csr_array((np.ones(len(new)), (new, np.arange(len(new)))), shape=(len(kept), len(new))) @ seen
    return pd.factorize(group)[0]


def _costs(links: Links, unit: float) -> Array:
    """Return the mean square distance of groups as a share of the limit; infinite where there is none."""
    limit = unit**2 * (links.metres + (REACH**2 - 1) * links.covisible)
    return np.divide(links.square, limit, out=np.full(len(limit), np.inf), where=limit > 0)


def _apart(links: Links, seen: csr_array) -> NDArray[np.bool_]:
    """Tell whether too many local maps saw both groups, side by side over much of what they saw."""
    found = np.zeros(len(links.first), dtype=bool)
    rows = np.flatnonzero(links.side_by_side > 0)
    if len(rows) == 0:
        return found
    first, second = links.first[rows], links.second[rows]
    both = seen[first].minimum(seen[second])
    count, length = np.diff(both.indptr), np.maximum(both.sum(axis=1), np.finfo(float).tiny)
    few = np.minimum(*(np.diff(seen.indptr)[end] for end in (first, second)))
    found[rows] = np.minimum(1.0, links.side_by_side[rows] / length) * count > SIDE_BY_SIDE * few
    return found


def _apart_at_length(links: Links, seen: csr_array) -> NDArray[np.bool_]:
    """Tell whether much of the shorter group, in metres, was seen side by side with the other.

    Where lines fork, looks at the one that runs on may have gone to the group of the short one that ends there, which
    many saw beside it: then two groups show the one that runs on, and hardly any of its metres were seen twice.
    """
    length = seen.sum(axis=1)
    return np.asarray(links.side_by_side > SIDE_BY_SIDE * np.minimum(length[links.first], length[links.second]))


def _mutually_nearest(links: Links, cost: Array, count: int) -> Index:
    """Return the links between two groups each of which has no nearer one within the limit."""
    rows = np.flatnonzero(cost < 1.0)
    order = rows[np.lexsort((links.second[rows], links.first[rows], cost[rows]))]
    rank, best = np.arange(len(order)), np.full(count, len(order))
    for end in (links.first, links.second):
        np.minimum.at(best, end[order], rank)
    return order[(best[links.first[order]] == rank) & (best[links.second[order]] == rank)]


def _joined(links: Links, new: Index) -> Links:
    """Return the links between groups of new names, those between the same two added up."""
    ends = np.sort(np.column_stack([new[links.first], new[links.second]]), axis=1)
    width = int(new.max(initial=0)) + 1
    key, place = np.unique(ends[:, 0] * width + ends[:, 1], return_inverse=True)
    sums = (np.bincount(place, column, minlength=len(key)).astype(float) for column in links[2:])
    joined = Links(key // width, key % width, *sums)
    return joined.take(joined.first != joined.second)
