"""What of the ways matters at one instant: the edges under the bodies of trains, and the joins ahead of them."""

from __future__ import annotations

import numpy as np
from numba import njit

from trainctl.kernels import keep_by_sources
from trainctl.railway.ways import Ways
from trainctl.signals import Bools, Floats, Ints

keep_by_sources()  # before anything below is decorated

#: Instead of a row, where the rear of a train lies on an edge behind the beginning of its way: it does, or it may.
BEHIND, PERHAPS = -1, -2


@njit(cache=True)
def pieces(ways: Ways, row: Ints, s: Floats, length: Floats, present: Bools) -> tuple[Ints, Ints]:
    """Find every edge of its way a train's body is on.

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
def tails(
    ways: Ways, size: Floats, before_first: Ints, before: Ints, s: Floats, length: Floats, present: Bools
) -> tuple[Ints, Ints, Ints, Floats]:  # fmt: skip
    """Find every edge the rear of a train may be on behind the beginning of its way.

    Where one edge leads into the first the rear lies on that one, and so on back. Where several do it is not known on
    which it lies, and it counts on all of them: a rear too many costs a little time, one too few a collision.

    Parameters
    ----------
    size : ndarray, shape (E,)
        Length of every edge [m].
    before_first, before
        Edges that lead into each, as in ``along.Net``.
    ways, s, length, present
        As of ``along.places``.

    Returns
    -------
    train, at, edge : ndarray, shape (Q,)
        Train, ``BEHIND`` or ``PERHAPS``, and edge of each.
    depth : ndarray, shape (Q,)
        How far the front is from the start of that edge [m], on the shortest way.
    """
    found = [(0, 0, 0, 0.0) for _ in range(0)]
    minimum, sure = np.empty(0), np.empty(0, np.bool_)
    for i in range(len(s)):
        begin = ways.begin[ways.first[i]]
        if not present[i] or begin <= s[i] - length[i]:
            continue
        if not len(minimum):
            minimum, sure = np.full(len(size), np.inf), np.ones(len(size), np.bool_)
        to_do, reached, done = [(ways.edge[ways.first[i]], s[i] - begin, True)], [0 for _ in range(0)], 0
        while done < len(to_do):
            e, depth, certain = to_do[done]
            done += 1
            one = before_first[e + 1] - before_first[e] == 1
            for q in range(before_first[e], before_first[e + 1]):
                b = before[q]
                further = depth + size[b]
                if further < minimum[b]:
                    if np.isinf(minimum[b]):
                        reached.append(b)
                    minimum[b], sure[b] = further, certain and one
                    if further < length[i]:
                        to_do.append((b, further, sure[b]))
        for b in reached:
            found.append((i, BEHIND if sure[b] else PERHAPS, b, minimum[b]))
            minimum[b] = np.inf
    train, at, edge = np.empty(len(found), np.int64), np.empty(len(found), np.int64), np.empty(len(found), np.int64)
    depths = np.empty(len(found))
    for q in range(len(found)):
        train[q], at[q], edge[q], depths[q] = found[q]
    return train, at, edge, depths


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
