"""One class on its way: from looks to the lines that they show, and what each look is part of."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from polymerge_core.consensus.alongside import Pairs, pairs_alongside
from polymerge_core.consensus.association import associate
from polymerge_core.consensus.fusion import Fit, Noise, fuse
from polymerge_core.consensus.layout import first_axes
from polymerge_core.consensus.looks import Looks
from polymerge_core.consensus.membership import settle
from polymerge_core.consensus.registration import corrected
from polymerge_core.curves import Array, Index

#: Looks are given to the lines anew at most so often; by then they have settled.
_ROUNDS = 3


class State(NamedTuple):
    """Looks at one class, and the lines fitted to them."""

    looks: Looks
    #: The line of each look.
    group: Index
    fit: Fit


def trace(looks: Looks, kind: Index, advance: Callable[[float], object] = lambda _share: None) -> State:
    """Find the lines that looks show.

    Parameters
    ----------
    looks : Looks
        Of one class.
    kind : ndarray of int, shape (n,)
        Only looks of one kind can show the same line.
    advance : callable, optional
        Called with the share done.

    Returns
    -------
    State
        The line of each look, and the lines.
    """
    advance(0.0)
    pairs = pairs_alongside(looks, kind)
    advance(0.2)
    group = _connected(looks, pairs, associate(looks, pairs))
    advance(0.5)
    state = _begin(looks, pairs, group, Noise.unknown(looks))
    for number in range(_ROUNDS):
        advance(0.6 + 0.4 * number / _ROUNDS)
        group = _connected(looks, pairs, settle(looks, state.group, state.fit, kind))
        if np.array_equal(group, state.group):
            break
        state = _begin(looks, pairs, group, Noise(state.fit.sigma, state.fit.drive_sigma))
    return state


def _begin(looks: Looks, pairs: Pairs, group: Index, noise: Noise) -> State:
    weight = looks.weight[looks.owner] * looks.metres / noise.sigma**2
    return State(looks, group, fuse(looks, group, first_axes(looks, pairs, group, weight), noise))


def moved(state: State, step: Array, centre: Array) -> State:
    """Move the local maps, and fit the lines anew."""
    looks = corrected(state.looks, step, centre)
    noise = Noise(state.fit.sigma, state.fit.drive_sigma)
    return State(
        looks, state.group, fuse(looks, state.group, state.fit.axes, noise, rounds=1, near=state.fit.feet.station)
    )


def _connected(looks: Looks, pairs: Pairs, group: Index) -> Index:
    """Take groups apart that no pairs of looks alongside each other hold together; number them by their first look."""
    own = (group[pairs.short] == group[pairs.long]) & (pairs.overlap > 0)
    joined = (np.ones(int(own.sum())), (pairs.short[own], pairs.long[own]))
    _, part = connected_components(coo_array(joined, shape=(len(looks), len(looks))), directed=False)
    return pd.factorize(part)[0]
