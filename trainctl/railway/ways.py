"""The way of every train: the edges it has run over since its departure and will run over, as one table of rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from trainctl.kernels import keep_by_sources
from trainctl.signals import Bools, Floats, Ints

keep_by_sources()  # before anything below is decorated

#: Two kilometrages of one place agree to rounding.
SAME_M = 1e-6


class Ways(NamedTuple):
    """Ways of n trains, one after the other: rows ``first[i]:first[i + 1]`` are those of train ``i``."""

    first: Ints  # (n + 1,)
    edge: Ints  # (W,) edge numbers in running order, internal edges included
    begin: Floats  # (W,) m, position at which the edge begins; grows along a way by the lengths of its edges

    @property
    def start(self) -> Floats:
        """Where every way begins [m], shape (n,)."""
        return self.begin[self.first[:-1]]


def ways(routes: Sequence[Sequence[int] | Ints], start_m: Floats, length_m: Floats) -> Ways:
    """Lay out ways along edges.

    Parameters
    ----------
    routes : sequence of sequence of int
        Edge numbers of each train's way, in running order.
    start_m, length_m : ndarray, shape (E,)
        Kilometrage at the beginning of every edge, and its length [m].

    Returns
    -------
    Ways
        Positions are the kilometrage of the first edge carried on along the way; where the kilometrage of a later edge agrees to
        rounding it is taken as it is, so that trains on one line have the very same positions.
    """
    parts = [np.asarray(route, np.int64) for route in routes]
    begins: dict[bytes, Floats] = {}  # many trains run over one route
    for part in parts:
        if (key := part.tobytes()) not in begins:
            begins[key] = _begins(part, float(start_m[part[0]]), start_m, length_m)
    return Ways(
        first=np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int64),
        edge=np.concatenate([*parts, np.zeros(0, np.int64)]),
        begin=np.concatenate([*(begins[part.tobytes()] for part in parts), np.zeros(0)]),
    )


def _begins(edges: Ints, begin: float, start_m: Floats, length_m: Floats) -> Floats:
    carried = begin + np.concatenate([[0.0], np.cumsum(length_m[edges[:-1]])])
    given = start_m[edges] + (begin - start_m[edges[0]])
    found: Floats = np.where(np.abs(given - carried) < SAME_M, given, carried)
    return found


def rerouted(old: Ways, train: int, row: int, edges: Sequence[int] | Ints, start_m: Floats, length_m: Floats) -> Ways:
    """Ways with another one for ``train`` from ``row`` on: ``edges`` begins with the edge of that row."""
    a, b = int(old.first[train]), int(old.first[train + 1])
    new = np.asarray(edges, np.int64)
    begins = _begins(new, float(old.begin[row]), start_m, length_m)
    longer = row - a + len(new) - (b - a)
    return Ways(
        first=old.first + np.where(np.arange(len(old.first)) > train, longer, 0),
        edge=np.concatenate([old.edge[:row], new, old.edge[b:]]),
        begin=np.concatenate([old.begin[:row], begins, old.begin[b:]]),
    )


def turned(
    old: Ways, train: int, row: int, s: float, length: float, edges: Sequence[int] | Ints, start_m: Floats, length_m: Floats
) -> tuple[Ways, int, float]:
    """Ways with the one back for a train that turns where it is.

    Parameters
    ----------
    old : Ways
        Before the turn.
    train, row : int
        The train, and the row of the edge its front is on.
    s, length : float
        Its front [m], and its length [m].
    edges : sequence of int
        Its way from the twin of that edge on.
    start_m, length_m : ndarray, shape (E,)
        As for ``ways``.

    Returns
    -------
    tuple of Ways, int and float
        The new ways, the row of the edge its front is on now, and how far it is on that [m]: its rear has become its front.
    """
    a, b = int(old.first[train]), int(old.first[train + 1])
    new = np.asarray(edges, np.int64)
    there = Ways(
        first=old.first + np.where(np.arange(len(old.first)) > train, len(new) - (b - a), 0),
        edge=np.concatenate([old.edge[:a], new, old.edge[b:]]),
        begin=np.concatenate([old.begin[:a], _begins(new, float(start_m[new[0]]), start_m, length_m), old.begin[b:]]),
    )
    place, k = float(old.begin[row] + length_m[old.edge[row]] - s) + length, 0
    while place > length_m[new[k]] and k < len(new) - 1:
        place -= float(length_m[new[k]])
        k += 1
    return there, a + k, place


def unchanged(old: Ways, new: Ways) -> Bools:
    """Trains whose ways lead over the same edges as before, shape (n,)."""
    same: Bools = np.diff(old.first) == np.diff(new.first)
    count = np.where(same, np.diff(old.first), 0)
    train, within = np.repeat(np.arange(len(same)), count), np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    other = old.edge[old.first[train] + within] != new.edge[new.first[train] + within]
    same[train[other]] = False
    return same


def moved(old: Ways, new: Ways, train: int, place: float) -> float:
    """Where a place on the old way of a train [m] lies on its new one: on the same passage of the same edge; NaN if on none."""
    a, b, c, d = old.first[train], old.first[train + 1], new.first[train], new.first[train + 1]
    if np.isnan(place) or (b - a == d - c and np.array_equal(old.edge[a:b], new.edge[c:d])):
        return place
    row = int(np.searchsorted(old.begin[a:b], place, side="left")) - 1
    edge = old.edge[a + max(row, 0)]
    passage = int((old.edge[a : a + max(row, 0)] == edge).sum())
    rows = np.flatnonzero(new.edge[c:d] == edge)
    if passage >= len(rows):
        return float("nan")
    return float(new.begin[c + rows[passage]] + (place - old.begin[a + max(row, 0)]))


@njit(cache=True)
def under(ways: Ways, of_edge: Floats, row: Ints, first: Ints, position: Floats) -> Floats:
    """Value of the edge under every unit, shape (U,).

    Parameters
    ----------
    ways : Ways
        Of all n trains.
    of_edge : ndarray, shape (E,)
        Value on every edge.
    row : ndarray, shape (n,)
        Row in the ways of the edge each train's front is on.
    first : ndarray, shape (n + 1,)
        Units of train i: ``first[i]:first[i + 1]``, front first.
    position : ndarray, shape (U,)
        Where every unit is, as the ways count [m].
    """
    out = np.empty(len(position))
    for i in range(len(row)):
        k = row[i]
        for u in range(first[i], first[i + 1]):
            while k > ways.first[i] and ways.begin[k] > position[u]:
                k -= 1
            out[u] = of_edge[ways.edge[k]]
    return out
