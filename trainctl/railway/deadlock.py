"""Whether all trains can still get out if one is let in: the rule that no trains come to wait for each other in a circle.

Every train runs on by itself until it *stands*: before the first stretch ahead that it has not been granted, before a join where it
is another's turn, or behind a train that stands ahead of it; or it leaves the net. Trains that stand before one stretch stand
behind each other. Train i *needs* train j if j may stand where i still has to pass: ahead of it on its way, on the twin of an edge
of it, or across; or if j goes before it, at its turn or where both stand. Turns count wherever i comes to that join, be it far away
or beyond a stretch it has not been granted: who has its turn by now passes first, since i takes one later. A state is *safe* if no
train needs, directly or through others, itself. A stretch is granted, and a train let into the net, only if it does not need
itself afterwards. None is granted while another train may stand ahead on the way there: that would find the turns beyond taken by
one that cannot come by.

A train that turns stands at the end of its way, and needs besides those that may stand where it runs back: on its next leg, on the
twin of that or across, but for those ahead of it that it turns its rear to.

Orders are needs as well: who must let another train pass first needs that until it comes to a stand beyond the place only. They can
forbid every way out, which is looked for before a run (``solvable``); what the rule then grants is free of circles all the same.

Circles of joins alone, without single track or crossings, are not looked at (a roundabout that is full): those are reported, see
``monitors.waiting``.

Progress. In a safe state some train needs no other: a finite graph without a circle has a node without successors. When all stand,
its whole way is free, and none goes before it. If it is granted what it asks for next it still needs no other, so it is on no
circle then, and the rule lets it go. So whenever all stand some train is granted something, and every train has finitely many
stretches. What else could keep it: a request that waits bars later ones only while what it waits for clears by itself, that is, if
no train stands there; and one that is to enter has nothing that others could need.

The test is a search over edges of ways, and for trains behind each other over pairs of trains: polynomial in trains and edges.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from heapq import heappop, heappush
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from trainctl.railway.along import Net
from trainctl.railway.ways import Ways
from trainctl.signals import Bools, Floats, Ints

#: Whether train j comes before train i to an edge, at its row m of the one and k of the other: (j, m, i, k).
Before = Callable[[int, int, int, int], bool]

#: Trains that turn at the end of their ways: none.
NOBODY: Mapping[int, Sequence[int]] = MappingProxyType({})


class Standing(NamedTuple):
    """Where trains may come to stand if nothing more is granted."""

    ways: Ways
    net: Net
    row: Ints
    rear: Floats  # (n,) m, of every train now
    on: Mapping[int, Sequence[tuple[int, int, float]]]  # edge: trains that stand on it, its row in their ways, and their rears [m]
    near: Bools  # (E,) edges on which, on whose twins or across which trains stand
    before: Mapping[int, Sequence[int]]  # train: those that go before it, where it stands or at a join ahead
    back: Mapping[int, Sequence[int]]  # train that turns: the edges it runs over then
    goes_before: Before


def standing(
    ways: Ways, net: Net, row: Ints, s: Floats, length: Floats, clearance: float, limits: Mapping[int, int],
    turns: Iterable[tuple[int, int, Sequence[int]]], goes_before: Before, back: Mapping[int, Sequence[int]] = NOBODY,
) -> Standing:  # fmt: skip
    """Where trains may come to stand.

    Parameters
    ----------
    ways, net : Ways, Net
        Of all n trains.
    row, s, length : ndarray, shape (n,)
        As in ``along.places``.
    clearance : float
        Room one standing train needs beyond its length [m].
    limits : mapping
        Of every train on the net: first row that it may not enter, -1 if there is none.
    turns : iterable
        Train, row of a join it has yet to come to, and the trains that pass there before it. It stands before the join only if it
        may come so far.
    goes_before : callable
        See ``Before``.
    back : mapping, optional
        Of trains that turn at the end of their ways: the edges they run over then.
    """
    on: dict[int, list[tuple[int, int, float]]] = {}
    before: dict[int, list[int]] = {}
    stood: Bools = np.zeros(len(net.length), bool)  # edges in ``on``

    def stands(i: int, front: float, k: int, room: float) -> list[int]:
        """Train i stands with its front at ``front``, before the end of row k, or up to ``room`` - its length farther back.

        Returns the edges that nobody stood on before.
        """
        rear, new = front - room, []
        while k > ways.first[i] and ways.begin[k] >= front:
            k -= 1
        while True:
            e = int(ways.edge[k])
            if not stood[e]:
                stood[e] = True
                new.append(e)
            on.setdefault(e, []).append((i, k, rear))
            if k == ways.first[i] or ways.begin[k] <= rear:
                return new
            k -= 1

    at: dict[int, list[int]] = {}
    for i, k in limits.items():
        if k >= 0:
            at.setdefault(int(ways.edge[k]), []).append(i)
    for trains in at.values():
        trains.sort(key=lambda i: (ways.begin[limits[i]] - s[i], i))
        behind = 0.0
        for place, i in enumerate(trains):
            before.setdefault(i, []).extend(trains[:place])
            behind += length[i]
            stands(i, float(ways.begin[limits[i]]), limits[i], behind)
            behind += clearance
    for i, k in limits.items() if back else ():
        if k < 0 and i in back:
            last = int(ways.first[i + 1]) - 1
            stands(i, float(ways.begin[last] + net.length[ways.edge[last]]), last, float(length[i]))
    for i, k, others in turns:
        if others:
            before.setdefault(i, []).extend(others)
        if others and (limits[i] < 0 or k <= limits[i]):
            stands(i, float(ways.begin[k]), k, float(length[i]))
    known, fresh = set[tuple[int, int]](), True
    train, rows = _to_pass(ways, row, limits)
    edges = ways.edge[rows]
    while fresh:
        fresh = False
        places = np.flatnonzero(stood[edges]).tolist()  # ascending, so it is a heap
        while places:
            place = heappop(places)
            i, k = int(train[place]), int(rows[place])
            for j, m, rear in tuple(on[int(edges[place])]):
                if j != i and (i, j) not in known and goes_before(j, m, i, k):
                    known.add((i, j))
                    fresh = True
                    new = stands(i, float(ways.begin[k] + max(rear - ways.begin[m], 0.0) - clearance), k, float(length[i]))
                    for e in new:
                        for more in np.flatnonzero(edges[place + 1 :] == e).tolist():
                            heappush(places, place + 1 + more)
    near = stood | (net.twin >= 0) & stood[net.twin]
    near[np.repeat(np.arange(len(stood)), np.diff(net.cross_first))[stood[net.cross]]] = True
    return Standing(ways, net, row, s - length, on, near, before, back, goes_before)


def _to_pass(ways: Ways, row: Ints, limits: Mapping[int, int]) -> tuple[Ints, Ints]:
    """Rows that trains still have to pass up to their ``limits``, train by train as these name them: trains and rows."""
    trains, limit = np.array(list(limits), np.int64), np.array(list(limits.values()), np.int64)
    begin, end = row[trains], np.where(limit >= 0, limit, ways.first[trains + 1])
    count = np.maximum(end - begin, 0)
    skipped = np.repeat(begin - (np.cumsum(count) - count), count)
    return np.repeat(trains, count), np.arange(len(skipped)) + skipped


def rears(here: Standing) -> dict[int, float]:
    """How far back the rear of every train may come to stand [m]; who runs on to the end of its way is not in it."""
    found: dict[int, float] = {}
    for trains in here.on.values():
        for i, _, rear in trains:
            found[i] = min(rear, found.get(i, rear))
    return found


def needs(here: Standing, i: int) -> Iterable[int]:
    """Trains that must have gone before ``i`` can leave."""
    ways, row = here.ways, int(here.row[i])
    yield from here.before.get(i, ())
    for k in (row + np.flatnonzero(here.near[ways.edge[row : ways.first[i + 1]]])).tolist():  # few are, of long ways
        yield from against(here, i, k)
        for j, m, _ in here.on.get(int(ways.edge[k]), ()):
            if j != i and here.goes_before(j, m, i, k):
                yield j
    if i in here.back:
        yield from _behind(here, i)


def ahead(here: Standing, i: int, k: int) -> int:
    """A train that may stand ahead of ``i`` before row k of its way; -1: none."""
    for r in range(int(here.row[i]), k):
        for j, m, _ in here.on.get(int(here.ways.edge[r]), ()):
            if j != i and here.goes_before(j, m, i, r):
                return j
    return -1


def _behind(here: Standing, i: int) -> Iterable[int]:
    """Trains that must have gone before ``i`` can run back once it has turned."""
    net, ways = here.net, here.ways
    rows = {int(ways.edge[k]): k for k in range(int(ways.first[i]), int(ways.first[i + 1]))}
    for e in here.back[i]:
        yield from (j for j, _, _ in here.on.get(e, ()) if j != i)
        for f in (int(net.twin[e]), *net.cross[net.cross_first[e] : net.cross_first[e + 1]].tolist()):
            for j, m, _ in here.on.get(f, ()):
                if j != i and not (rows.get(f, -1) >= here.row[i] and here.goes_before(j, m, i, rows[f])):
                    yield j


def against(here: Standing, i: int, k: int) -> Iterable[int]:
    """Trains that stand on the twin of, or across, the edge at row k of the way of ``i``, and do not go away from it."""
    net, begin, e = here.net, here.ways.begin, int(here.ways.edge[k])
    for f in (int(net.twin[e]), *net.cross[net.cross_first[e] : net.cross_first[e + 1]].tolist()):
        for j, m, rear in here.on.get(f, ()):
            away = f == net.twin[e] and goes_away(float(here.rear[i] - begin[k]), rear - float(begin[m]), float(net.length[e]))
            if j != i and not away:
                yield j


def goes_away(rear: float, other: float, length: float) -> bool:
    """Whether two trains on one track turn their rears to each other: those are so far in from its two ends [m], < 0: not yet."""
    return rear + other >= length


def in_a_circle(here: Standing, i: int) -> int:
    """A train through which ``i`` needs itself, the first on the circle; -1: it does not."""
    begun: dict[int, int] = {}  # train: by which need of ``i`` it was found
    rest = [(j, j) for j in needs(here, i)]
    while rest:
        j, by = rest.pop()
        if j == i:
            return by
        if j not in begun:
            begun[j] = by
            rest += [(k, by) for k in needs(here, j)]
    return -1
