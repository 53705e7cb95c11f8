"""Neighbours along the ways trains take: who is next ahead, and what stands bodily in the way.

A train's way is the list of edges it runs over from its departure until it leaves the net. On every edge its way is compared with
the trains that stand there (sorted by how far their fronts are past the start of the edge), on every edge where tracks join also
with the trains that come over another track (sorted by their distance to that edge). Spacings are front to front, room is front to
body.

A train that reverses begins a new way.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numba import njit

from trainctl.kernels import keep_by_sources
from trainctl.railway.rows import approaches, pieces
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
    cross_first: Ints  # (E + 1,)
    cross: Ints  # (C,)


class Order(NamedTuple):
    """Turns decided at joins, see ``claims``: train[q] is number rank[q] over edge[q]."""

    edge: Ints  # (Q,)
    train: Ints  # (Q,)
    rank: Ints  # (Q,)


class Places(NamedTuple):
    """Where all trains are, sorted per edge. Build it with ``places``; P pieces of trains on edges, R approaches to joins."""

    ways: Ways
    net: Net
    row: Ints  # (n,)
    s: Floats  # (n,) m
    length: Floats  # (n,) m
    longest: float  # m
    horizon: float  # m
    piece_first: Ints  # (E + 1,) pieces on edge e: piece_first[e]:piece_first[e + 1], by depth
    piece_train: Ints  # (P,)
    piece_row: Ints  # (P,) row of that edge in the way of the train
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


class Bodies(NamedTuple):
    """Everything in the way of trains that may matter, one row per train and body; sorted by train. See ``Obstacles``."""

    train: Ints  # (B,) whose way
    other: Ints  # (B,) whose body
    room: Floats  # (B,) m
    sense: Ints  # (B,)


class Obstacles(NamedTuple):
    """What stands nearest in the way of each train."""

    room: Floats  # (n,) m from the front to it, negative: overlapping; inf: none
    train: Ints  # (n,) whose body it is, -1: none
    sense: Ints  # (n,) 1: it runs the same way, -1: it comes the other way, 0: across, or a join to be kept clear


def net(railway: Railway) -> Net:
    """Arrays of a railway, to be made once per run."""
    crossing = [sorted(c) for c in railway.crossing]
    return Net(
        length=np.ascontiguousarray(railway.length_m, np.float64),
        joins=np.array([len(b) > 1 for b in railway.before], bool),
        twin=np.ascontiguousarray(railway.twin, np.int64),
        cross_first=np.concatenate([[0], np.cumsum([len(c) for c in crossing], dtype=np.int64)]).astype(np.int64),
        cross=np.array([e for c in crossing for e in c], np.int64),
    )


def places(
    ways: Ways, net: Net, row: Ints, s: Floats, length: Floats, present: Bools, horizon: float, order: Order | None = None
) -> Places:
    """Sort the trains per edge, once per instant for ``ahead`` and ``obstacles``.

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
        Input of ``ahead`` and ``obstacles``.
    """
    edges = len(net.length)
    train, at = pieces(ways, row, s, length, present)
    depth = s[train] - ways.begin[at]
    by_depth = np.lexsort((-train, depth, ways.edge[at]))
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
        ways=ways, net=net, row=row, s=s, length=length,
        longest=float(length[present].max(initial=0.0)), horizon=float(horizon),
        piece_first=_starts(ways.edge[at], edges), piece_train=train[by_depth], piece_row=at[by_depth],
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
    are decided, only the last before the own counts, not the nearest. Two trains of which one stands on the way of the other before
    they part and join again keep the order they stand in.

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


def bodies(places: Places, virtual: bool = True) -> Bodies:
    """Find what is in the way of each train, from the nearest to what the others hide.

    The nearest alone does not tell how far a train may go: the tail of one that branches off is gone in a moment, and there may be
    another behind it. A train that will run all the way with this one as far as the horizon hides what lies beyond it.

    Parameters
    ----------
    places : Places
        From ``places``.
    virtual : bool
        A train that comes over another track and is ahead, see ``ahead``. True: its rear is taken to be its length behind its
        front on the own way, from the horizon until it has wholly joined, so trains sort themselves in before the join. False:
        only what is there counts: the join is to be kept clear (room to the start of that edge, sense 0) until its rear has come
        over it, then the body.

    Returns
    -------
    Bodies
        ``train``, ``other``, ``room`` [m] and ``sense`` (B,): the speed of the body along the way is ``sense`` times the speed of
        that train, 0 for one across. Of those that come the other way on one edge, lie across it, or come to one join, the nearest.

    Notes
    -----
    Bodies reach from the front back over the way they came; where a way began less than a length ago the train hangs out behind
    the beginning. Bodies on the twin of an edge are mirrored. A body on an edge that crosses one of the way blocks it as a whole;
    a train that already is on a blocked edge is held only by trains that are deeper in. A train is no obstacle to itself.
    """
    return Bodies(*_bodies(places, virtual))


def obstacles(places: Places, virtual: bool = True) -> Obstacles:
    """Find the nearest occupied point on the way of each train: ``room``, ``train`` and ``sense`` (n,), see ``bodies``."""
    every = bodies(places, virtual)
    n = len(places.row)
    room, train, sense = np.full(n, np.inf), np.full(n, -1, np.int64), np.zeros(n, np.int64)
    first = np.lexsort((every.room, every.train))  # of a train's rows the nearest first
    nearest = first[np.flatnonzero(np.diff(every.train, prepend=-1))]
    i = every.train[nearest]
    room[i], train[i], sense[i] = every.room[nearest], every.other[nearest], every.sense[nearest]
    return Obstacles(room, train, sense)


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
def _comes_over_another_track(places: Places, i: int, k: int, j: int, m: int) -> bool:
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
def _joining(places: Places, i: int, own: int, best: float, lengths: bool) -> tuple[int, float]:
    """Nearest train that comes over another track and is ahead of ``i`` at the join of its approach ``own``, nearer than ``best``.

    Returns the train or -1 and its spacing [m]. With ``lengths`` the nearest rear, and the spacing less the length.
    """
    begin, s = places.ways.begin, places.s
    slack = places.longest if lengths else 0.0
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
        if p >= decided and spacing - slack >= best:
            p = decided - 1
            continue
        value = spacing - places.length[j] if lengths else spacing
        over_another = j != i and _comes_over_another_track(places, i, k, j, m)
        if over_another and value < best:
            found, best = j, value
        same_track = places.ways.edge[k - 1] == places.ways.edge[m - 1]
        if p < decided and j != i and not lengths and (over_another or same_track):
            break  # the last turn before the own; who goes before that one is not the next ahead
        p -= 1
    return found, best


@njit(cache=True)
def _first_to_join(places: Places, i: int, own: int) -> int:
    """A train that passes the join of the approach ``own`` of ``i`` before it, over another track; -1: none."""
    k = places.join_row[own]
    for p in range(own - 1, places.join_first[places.ways.edge[k]] - 1, -1):
        j = places.join_train[p]
        if j != i and _comes_over_another_track(places, i, k, j, places.join_row[p]):
            return int(j)
    return -1


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
            if p < places.piece_first[e + 1] and places.piece_train[p] == i:
                p += 1
            if p < places.piece_first[e + 1]:
                j = places.piece_train[p]
                if places.front[j] == p:  # not a tail whose front has left the edge
                    if away + places.depth[p] <= places.horizon:
                        found, best = j, away + places.depth[p]
                    break
        for q in range(places.own_first[i], places.own_first[i + 1]):
            j, value = _joining(places, i, places.own[q], best, False)
            if j >= 0:
                found, best = j, value
        train[i], spacing[i] = found, best


@njit(cache=True)
def _bodies(places: Places, virtual: bool) -> tuple[Ints, Ints, Floats, Ints]:
    """Rows of ``Bodies``, counted first."""
    n = len(places.row)
    count = 0
    for again in range(2):
        train, other = np.empty(count * again, np.int64), np.empty(count * again, np.int64)
        room, sense = np.empty(count * again), np.empty(count * again, np.int64)
        count = 0
        for i in range(n):
            if places.front[i] >= 0:
                begin = count
                count = _in_the_way(places, virtual, i, again == 1, count, other, room, sense)
                if again:
                    train[begin:count] = i
    return train, other, room, sense


@njit(cache=True)
def _in_the_way(
    places: Places, virtual: bool, i: int, write: bool, count: int, other: Ints, room: Floats, sense: Ints
) -> int:  # fmt: skip
    """Write what is in the way of ``i`` from row ``count`` on, if ``write``; the next free row."""
    ways, net, s = places.ways, places.net, places.s
    inside = s[i] - ways.begin[places.row[i]]
    hidden = places.horizon  # from there on nothing matters
    for k in range(places.row[i], ways.first[i + 1]):
        away = ways.begin[k] - s[i]
        if away > places.horizon or away - places.longest > hidden:
            break
        e = ways.edge[k]
        here = k == places.row[i]
        # The other way on the same track: the deepest is nearest.
        t = net.twin[e]
        if t >= 0:
            for p in range(places.piece_first[t + 1] - 1, places.piece_first[t] - 1, -1):
                j = places.piece_train[p]
                rear = max(places.depth[p] - places.length[j], 0.0)
                if j == i or (here and net.length[e] - rear <= inside):
                    continue
                value = away + net.length[e] - min(places.depth[p], net.length[e])
                if value <= hidden:
                    if write:
                        other[count], room[count], sense[count] = j, value, -1
                    count += 1
                break
        for q in range(net.cross_first[e], net.cross_first[e + 1]):
            c = net.cross[q]
            for p in range(places.piece_first[c + 1] - 1, places.piece_first[c] - 1, -1):
                j = places.piece_train[p]
                if j == i or (here and not _deeper(places.depth[p], j, inside, i)):
                    continue
                if away <= hidden:
                    if write:
                        other[count], room[count], sense[count] = j, away, 0
                    count += 1
                break
        # The same way: by depth, so once the longest train would be hidden all are.
        p = places.front[i] + 1 if here else places.piece_first[e]
        while p < places.piece_first[e + 1] and away + places.depth[p] - places.longest <= hidden:
            j, r = places.piece_train[p], places.piece_row[p]
            rear = places.depth[p] - places.length[j]
            value = away + (rear if virtual else max(rear, 0.0))
            told = not here and rear < 0.0 and r > ways.first[j] and ways.edge[r - 1] == ways.edge[k - 1]
            if told and k - 1 == places.row[i]:
                told = _deeper(s[j] - ways.begin[r - 1], j, inside, i)
            if j != i and not told and value <= hidden:
                if write:
                    # While its rear still is on another track, its being ahead clears nothing here.
                    clipped = not virtual and not here and rear < 0.0
                    other[count], room[count], sense[count] = j, value, 0 if clipped else 1
                count += 1
                if _runs_along(places, i, k, j, r):
                    hidden = value
            p += 1
    for q in range(places.own_first[i], places.own_first[i + 1]):
        own = places.own[q]
        if virtual:
            j, value = _joining(places, i, own, np.inf, True)
            way = 1
        else:
            j, value, way = _first_to_join(places, i, own), ways.begin[places.join_row[own]] - s[i], 0
        if j >= 0 and value <= hidden:
            if write:
                other[count], room[count], sense[count] = j, value, way
            count += 1
    return count


@njit(cache=True)
def _runs_along(places: Places, i: int, k: int, j: int, r: int) -> bool:
    """Whether ``j`` runs the way of ``i`` from their rows r and k as far as ``i`` looks."""
    ways = places.ways
    while k + 1 < ways.first[i + 1] and ways.begin[k + 1] - places.s[i] <= places.horizon:
        k, r = k + 1, r + 1
        if r == ways.first[j + 1] or ways.edge[k] != ways.edge[r]:
            return False
    return True


@njit(cache=True)
def _deeper(depth: float, j: int, inside: float, i: int) -> bool:
    """Whether train ``j`` is farther in than train ``i``, ties by number."""
    return depth > inside or (depth == inside and j < i)
