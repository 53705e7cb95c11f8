"""Rows of the ways that matter at one instant: the edges under the bodies of trains, and the joins ahead of them."""

from __future__ import annotations

import numpy as np
from numba import njit

from trainctl.kernels import keep_by_sources
from trainctl.railway.ways import Ways
from trainctl.signals import Bools, Floats, Ints

keep_by_sources()  # before anything below is decorated


@njit(cache=True)
def pieces(ways: Ways, row: Ints, s: Floats, length: Floats, present: Bools) -> tuple[Ints, Ints]:
    """Find every edge a train's body is on.

    Parameters
    ----------
    ways, row, s, length, present
        As of ``along.places``.

    Returns
    -------
    train, at : ndarray, shape (P,)
        Train and row of each, by train, from the front back.
    """
    train, at = np.empty(len(ways.begin), np.int64), np.empty(len(ways.begin), np.int64)  # a row is in one way only
    count = 0
    for i in range(len(row)):
        if not present[i]:
            continue
        k = row[i]
        while True:
            train[count], at[count] = i, k
            count += 1
            if k == ways.first[i] or ways.begin[k] <= s[i] - length[i]:
                break
            k -= 1
    return train[:count], at[:count]


@njit(cache=True)
def approaches(ways: Ways, joins: Bools, row: Ints, s: Floats, present: Bools, horizon: float) -> tuple[Ints, Ints, Ints]:
    """Find the joins ahead of every train.

    Parameters
    ----------
    joins : ndarray, shape (E,)
        Edges that two or more edges lead into.
    ways, row, s, present, horizon
        As of ``along.places``.

    Returns
    -------
    first : ndarray, shape (n + 1,)
        Those of train ``i`` are ``first[i]:first[i + 1]`` of what follows.
    train, at : ndarray, shape (R,)
        Train and row of each, by train, nearest first.
    """
    first = np.zeros(len(row) + 1, np.int64)
    train, at = np.empty(len(ways.begin), np.int64), np.empty(len(ways.begin), np.int64)
    count = 0
    for i in range(len(row)):
        if present[i]:
            for k in range(row[i] + 1, ways.first[i + 1]):
                if ways.begin[k] - s[i] > horizon:
                    break
                if joins[ways.edge[k]]:
                    train[count], at[count] = i, k
                    count += 1
        first[i + 1] = count
    return first, train[:count], at[:count]
