"""Which looks show the same line: average linkage of lateral distances, under what one local map saw side by side.

Looks that run closest together are put together first, and groups go on being put together while the root mean square
distance between their looks is below a limit. Two lines that one local map saw side by side are different lines
(cannot-link; Wagstaff et al. 2001, "Constrained k-means clustering with background knowledge"): groups are kept apart
where many local maps saw both.
"""

from __future__ import annotations

import heapq
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from polymerge_core.consensus.alongside import REACH, Pairs
from polymerge_core.consensus.looks import Looks
from polymerge_core.curves import Array, Index

#: Groups that more than this share of the local maps of the smaller one saw side by side are different lines. Fewer
#: only drew one twice, or invented one beside it. A local map that saw them so over half their length counts half.
SIDE_BY_SIDE = 0.4

_Link = tuple[float, float, float, float]


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
    linkage = _Linkage(instance.tolist(), size.tolist(), unit)
    values = zip(*(column.tolist() for column in links[2:]), strict=True)
    for first, second, link in zip(links.first.tolist(), links.second.tolist(), values, strict=True):
        linkage.link(first, second, link)
    return linkage.run()


class _Linkage:
    """Groups of looks, the links between them, and which two are to be put together next."""

    def __init__(self, instance: list[int], size: list[float], unit: float) -> None:
        #: How much of each group each local map saw.
        self._seen = [{one: length} for one, length in zip(instance, size, strict=True)]
        self._links: list[dict[int, _Link]] = [{} for _ in size]
        self._into = list(range(len(size)))
        self._heap: list[tuple[float, int, int]] = []
        self._square = unit**2

    def link(self, first: int, second: int, link: _Link) -> None:
        self._links[first][second] = self._links[second][first] = link
        self._offer(first, second, link)

    def _offer(self, first: int, second: int, link: _Link) -> None:
        cost = self._cost(first, second, link)
        if cost < 1.0:
            self._heap.append((cost, min(first, second), max(first, second)))

    def _cost(self, first: int, second: int, link: _Link) -> float:
        """Return the mean square distance of groups as a share of the limit; infinite where they must stay apart."""
        square, metres, covisible, side_by_side = link
        if metres <= 0 or (side_by_side > 0 and self._apart(first, second, side_by_side)):
            return np.inf
        return square / metres / (self._square * (1 + (REACH**2 - 1) * covisible / metres))

    def _apart(self, first: int, second: int, side_by_side: float) -> bool:
        """Tell whether too many local maps saw both groups, side by side over much of what they saw."""
        one, other = self._seen[first], self._seen[second]
        few, many = (one, other) if len(one) <= len(other) else (other, one)
        both = few.keys() & many.keys()
        length = sum(min(few[instance], many[instance]) for instance in sorted(both))
        return min(1.0, side_by_side / length) * len(both) > SIDE_BY_SIDE * len(few)

    def run(self) -> Index:
        """Put groups together, the closest first, while any two are close enough."""
        heapq.heapify(self._heap)
        while self._heap:
            cost, first, second = heapq.heappop(self._heap)
            link = self._links[first].get(second)
            if link is not None and self._cost(first, second, link) == cost:
                self._join(first, second)
        roots = np.array([self._root(number) for number in range(len(self._into))], dtype=np.intp)
        return pd.factorize(roots)[0]

    def _join(self, first: int, second: int) -> None:
        if len(self._links[first]) < len(self._links[second]):
            first, second = second, first
        links = self._links
        for instance, length in self._seen[second].items():
            self._seen[first][instance] = self._seen[first].get(instance, 0.0) + length
        self._seen[second] = {}
        self._into[second] = first
        del links[first][second]
        for other, link in links[second].items():
            if other != first:
                del links[other][second]
                before = links[first].get(other)
                joined = link if before is None else _sum(before, link)
                links[first][other] = links[other][first] = joined
        links[second] = {}
        for other, link in links[first].items():
            cost = self._cost(first, other, link)
            if cost < 1.0:
                heapq.heappush(self._heap, (cost, min(first, other), max(first, other)))

    def _root(self, number: int) -> int:
        while self._into[number] != number:
            number = self._into[number]
        return number


def _sum(one: _Link, other: _Link) -> _Link:
    return (one[0] + other[0], one[1] + other[1], one[2] + other[2], one[3] + other[3])
