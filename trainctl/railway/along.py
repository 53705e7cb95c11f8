"""Neighbours along the ways trains take: where every train is, and which is next ahead.

A train's way is the list of edges it runs over from its departure until it leaves the net. On every edge its way is compared with
the trains that are there (sorted by how far their fronts are past the start of the edge), on every edge where tracks join also
with the trains that come over another track (sorted by their distance to that edge). Spacings are front to front. Obstacles
are in ``bodies``.

A train that reverses begins a new way.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numba import njit

from trainctl.kernels import keep_by_sources
from trainctl.railway.rows import approaches, pieces, tails
from trainctl.railway.ways import Ways
from trainctl.signals import Bools, Floats, Ints

keep_by_sources()  # before anything below is decorated

#: Rank of a train whose turn at a join is not decided.
UNDECIDED = np.iinfo(np.int64).max


class Railway(Protocol):
    """What is read of a net: lengths, what joins, opposite directions of one track, level crossings of tracks; E edges."""

    @property
    def length_m(self) -> Floats:
        """Length of every edge [m], shape (E,)."""

    @property
    def before(self) -> Sequence[Sequence[int]]:
        """Edges that lead into each edge."""

    @property
    def twin(self) -> Ints:
        """The same track in the other direction, shape (E,); -1: none."""

    @property
    def crossing(self) -> Sequence[Sequence[int]]:
        """Edges that physically cross each edge."""


class Net(NamedTuple):
    """A railway as arrays; edge e is crossed by cross[cross_first[e]:cross_first[e + 1]]."""

    length: Floats  # (E,) m
    joins: Bools  # (E,) two or more edges lead into it
    twin: Ints  # (E,) -1: none
    before_first: Ints  # (E + 1,) edge e is entered from before[before_first[e]:before_first[e + 1]] without a change of direction
    before: Ints  # (B,)
    cross_first: Ints  # (E + 1,)
    cross: Ints  # (C,)


class Order(NamedTuple):
    """Turns decided at joins, see ``interlocking``: train[q] is number rank[q] over edge[q]."""

    edge: Ints  # (Q,)
    train: Ints  # (Q,)
    rank: Ints  # (Q,)


class Places(NamedTuple):
    """Where all trains are, sorted per edge. Build it with ``places``; P pieces of trains on edges, R approaches to joins."""

    ways: Ways
    size: Floats  # (E,) m, length of every edge
    twin: Ints  # (E,)
    cross_first: Ints  # (E + 1,)
    cross: Ints  # (C,)
    row: Ints  # (n,)
    s: Floats  # (n,) m
    length: Floats  # (n,) m
    longest: float  # m
    horizon: float  # m
    piece_first: Ints  # (E + 1,) pieces on edge e: piece_first[e]:piece_first[e + 1], by depth
    piece_train: Ints  # (P,)
    piece_row: Ints  # (P,) row of that edge in the way of the train; behind its beginning BEHIND or PERHAPS, see ``rows``
    depth: Floats  # (P,) m from the start of the edge to the front of the train, more than its length if the front has left it
    front: Ints  # (n,) piece with the front of train i, -1 if it is not on the net
    own_first: Ints  # (n + 1,) approaches of train i: own[own_first[i]:own_first[i + 1]], nearest first
    own: Ints  # (R,) places of them in what follows
    join_first: Ints  # (E + 1,) approaches to edge e, first to pass first
    join_train: Ints  # (R,)
    join_row: Ints  # (R,) row of that edge in the way of the train
    rank: Ints  # (R,) UNDECIDED: by distance


class Ahead(NamedTuple):
    """The next train ahead of each."""

    train: Ints  # (n,) -1: none
    spacing: Floats  # (n,) m, front to front; inf: none


def net(railway: Railway) -> Net:
    """Arrays of a railway, to be made once per run."""
    crossing = [sorted(c) for c in railway.crossing]
    before = [[b for b in into if railway.twin[b] != e] for e, into in enumerate(railway.before)]
    return Net(
        length=np.ascontiguousarray(railway.length_m, np.float64),
        joins=np.array([len(b) > 1 for b in railway.before], bool),
        twin=np.ascontiguousarray(railway.twin, np.int64),
        before_first=_firsts(before),
        before=np.array([b for into in before for b in into], np.int64),
        cross_first=_firsts(crossing),
        cross=np.array([e for c in crossing for e in c], np.int64),
    )


def places(
    ways: Ways, net: Net, row: Ints, s: Floats, length: Floats, present: Bools, horizon: float, order: Order | None = None
) -> Places:
    """Sort the trains per edge, once per instant for ``ahead`` and ``bodies``.

    Parameters
    ----------
    ways : Ways
        Rows of all n trains.
    net : Net
        From ``net``.
    row : ndarray, shape (n,)
        Row in ``ways.edge`` of the edge the front is on; not read where the train is not present.
    s : ndarray, shape (n,)
        Front, from the beginning of the way [m].
    length : ndarray, shape (n,)
        Train lengths [m].
    present : ndarray, shape (n,)
        Who is on the net.
    horizon : float
        How far ahead is looked [m]; trains farther than this from a join do not count as approaching it.
    order : Order, optional
        Turns that are decided: they go before undecided trains, whatever the distances.

    Returns
    -------
    Places
        Input of ``ahead``, and of ``bodies`` of its module.
    """
    edges = len(net.length)
    train, at = pieces(ways, row, s, length, present)
    edge, depth = ways.edge[at], s[train] - ways.begin[at]
    behind = tails(ways, net.length, net.before_first, net.before, s, length, present)
    if len(behind[0]):
        train, at, edge, depth = (np.concatenate(pair) for pair in zip((train, at, edge, depth), behind, strict=True))
    by_depth = np.lexsort((-train, depth, edge))
    front = np.full(len(row), -1, np.int64)
    standing = np.flatnonzero(at[by_depth] == row[train[by_depth]])
    front[train[by_depth[standing]]] = standing
    own_first, comer, join_row = approaches(ways, net.joins, row, s, present, horizon)
    join = ways.edge[join_row]
    rank = np.full(len(comer), UNDECIDED, np.int64)
    if order is not None:
        _decided(order, own_first, join, rank)
    by_turn = np.lexsort((comer, ways.begin[join_row] - s[comer], rank, join))
    own = np.empty(len(comer), np.int64)
    own[by_turn] = np.arange(len(comer))
    return Places(
        ways=ways, size=net.length, twin=net.twin, cross_first=net.cross_first, cross=net.cross, row=row, s=s, length=length,
        longest=float(length[present].max(initial=0.0)), horizon=float(horizon),
        piece_first=_starts(edge, edges), piece_train=train[by_depth], piece_row=at[by_depth],
        depth=depth[by_depth], front=front,
        own_first=own_first, own=own, join_first=_starts(join, edges), join_train=comer[by_turn],
        join_row=join_row[by_turn], rank=rank[by_turn],
    )  # fmt: skip


def ahead(places: Places) -> Ahead:
    """Find the next train ahead on the way each train will take.

    Parameters
    ----------
    places : Places
        From ``places``.

    Returns
    -------
    Ahead
        ``train`` (n,) and ``spacing`` (n,) [m], front to front along the way; -1 and inf where there is none within the horizon,
        and for trains that are not on the net.

    Notes
    -----
    Ahead is a train whose front is on the way, also if its own way branches off later, and one that still comes over another track
    and joins: its distance to the edge where it joins is smaller (ties by number), or its turn was decided to be earlier. Its
    spacing is the difference of the distances, so it can be negative where the turn was decided against the distances. Where turns
    are decided, only the last before the own counts, not the nearest. Two trains of which one is on the way of the other before
    they part and join again keep their order.

    The train behind is the inverse where it is unique, see ``behind``: two trains may have the same one ahead, on two tracks before
    a join or where one ahead of both will branch off.
    """
    train, spacing = np.full(len(places.row), -1, np.int64), np.full(len(places.row), np.inf)
    _ahead(places, train, spacing)
    return Ahead(train, spacing)


def behind(ahead: Ahead) -> Ahead:
    """Find the train behind each: the nearest of those that have it ahead, ties by number."""
    train, spacing = np.full(len(ahead.train), -1, np.int64), np.full(len(ahead.train), np.inf)
    follower = np.flatnonzero(ahead.train >= 0)
    far_first = follower[np.lexsort((-follower, -ahead.spacing[follower]))]
    train[ahead.train[far_first]] = far_first  # the last write stays: the nearest
    spacing[ahead.train[far_first]] = ahead.spacing[far_first]
    return Ahead(train, spacing)


def _firsts(lists: Sequence[Sequence[int]]) -> Ints:
    """Where every list begins when they stand one after the other, and where the last ends."""
    return np.concatenate([[0], np.cumsum([len(one) for one in lists], dtype=np.int64)]).astype(np.int64)


def _starts(edge: Ints, edges: int) -> Ints:
    """Where the entries of every edge begin in a list sorted by edge, shape (E + 1,)."""
    return np.concatenate([[0], np.cumsum(np.bincount(edge, minlength=edges))]).astype(np.int64)


@njit(cache=True)
def _decided(order: Order, own_first: Ints, join: Ints, rank: Ints) -> None:
    """Write the turns into ``rank`` (R,): of a train that passes an edge more than once, they mean the first time."""
    for q in range(len(order.edge)):
        i = order.train[q]
        for r in range(own_first[i], own_first[i + 1]):
            if join[r] == order.edge[q]:
                rank[r] = order.rank[q]
                break


@njit(cache=True)
def comes_over_another_track(places: Places, i: int, k: int, j: int, m: int) -> bool:
    """Whether the ways of ``i`` and ``j`` join at their rows k and m, neither front standing on the way of the other before."""
    edge, row = places.ways.edge, places.row
    if edge[k - 1] == edge[m - 1]:
        return False
    for r in range(row[i], k):
        if edge[r] == edge[row[j]]:
            return False
    for r in range(row[j], m):  # noqa: SIM110, compiled
        if edge[r] == edge[row[i]]:
            return False
    return True


@njit(cache=True)
def _joining(places: Places, i: int, own: int, best: float) -> tuple[int, float]:
    """Nearest train that comes over another track and is ahead of ``i`` at the join of its approach ``own``, nearer than ``best``.

    Returns the train or -1 and its spacing [m].
    """
    begin, s = places.ways.begin, places.s
    found = -1
    k = places.join_row[own]
    distance = begin[k] - s[i]
    first = places.join_first[places.ways.edge[k]]
    decided = first
    while decided < own and places.rank[decided] != UNDECIDED:
        decided += 1
    # Decided turns come first and are few; the undecided ones before the own are in order of distance, from near to far.
    p = own - 1
    while p >= first:
        j, m = places.join_train[p], places.join_row[p]
        spacing = distance - (begin[m] - s[j])
        if p >= decided and spacing >= best:
            p = decided - 1
            continue
        over_another = j != i and comes_over_another_track(places, i, k, j, m)
        if over_another and spacing < best:
            found, best = j, spacing
        same_track = places.ways.edge[k - 1] == places.ways.edge[m - 1]
        if p < decided and j != i and (over_another or same_track):
            break  # the last turn before the own; who goes before that one is not the next ahead
        p -= 1
    return found, best


@njit(cache=True)
def _ahead(places: Places, train: Ints, spacing: Floats) -> None:
    ways, s = places.ways, places.s
    for i in range(len(train)):
        if places.front[i] < 0:
            continue
        found, best = -1, np.inf
        for k in range(places.row[i], ways.first[i + 1]):
            away = ways.begin[k] - s[i]
            if away > places.horizon:
                break
            e = ways.edge[k]
            p = places.front[i] + 1 if k == places.row[i] else places.piece_first[e]
            while p < places.piece_first[e + 1] and (places.piece_train[p] == i or places.front[places.piece_train[p]] != p):
                p += 1  # the rear of a train whose front has left the edge
            if p < places.piece_first[e + 1]:
                if away + places.depth[p] <= places.horizon:
                    found, best = places.piece_train[p], away + places.depth[p]
                break
        for q in range(places.own_first[i], places.own_first[i + 1]):
            j, value = _joining(places, i, places.own[q], best)
            if j >= 0:
                found, best = j, value
        train[i], spacing[i] = found, best
