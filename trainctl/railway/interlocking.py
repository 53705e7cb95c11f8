"""First come, first served where ways meet: who goes first at joins, and who may enter what only one can use.

Two kinds of places. A *join* is an edge that two or more edges lead into: the trains get a turn there, nobody is held, and the
turns go to ``along.places``. A *stretch* is a longest run of edges on a train's way that others use as well, on the twin (single
track) or across: it is exclusive against those, while trains that go the same way may follow each other. A train requests what
lies within its reach, and keeps its request until its rear has left or its way no longer leads there. What it has passed is free
at once.

Deadlock: a train is let into a stretch only if behind it, before the next stretch, it finds room to stand with all who will stand
there, or else together with the next one. While it waits for that, later trains may overtake it; this is the only exception to
first come, first served.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, TypedDict

import numpy as np
from numba import njit

from trainctl.kernels import keep_by_sources
from trainctl.railway.along import Net, Order
from trainctl.railway.ways import Ways
from trainctl.signals import Bools, Floats, Ints

keep_by_sources()  # before anything below is decorated


class State(TypedDict):
    """All requests, in the plain types of JSON."""

    joins: dict[str, list[int]]  # edge number: trains in the order of their turns
    stretches: list[tuple[int, int, bool]]  # train, edge it enters over, granted; in the order of requesting
    until: dict[str, float]  # train number: position up to which it has requested [m]


class Zones(NamedTuple):
    """What is exclusive along every way; to be made anew when ways change. W rows as in ``ways``."""

    ways: Ways
    net: Net
    begins: Ints  # (W,) first row of the stretch this row is in, -1: in none
    ends: Ints  # (W,) last row of it, -1
    following: Ints  # (W,) first row of the next stretch after this row's, -1: none


class Held(NamedTuple):
    """How far each train may go."""

    room: Floats  # (n,) m from the front to a stretch it must not enter yet; inf: free
    zone: Ints  # (n,) edge over which it would enter, -1
    by: Ints  # (n,) train it waits for, -1


class Decision(NamedTuple):
    """One request decided: granted, or not because of train ``by``. At a join, not granted means after ``by``."""

    train: int
    zone: int
    granted: bool
    by: int  # -1: nobody
    join: bool  # whether ``zone``, an edge, is a join or the beginning of a stretch


def none() -> State:
    """No requests: the state to begin with."""
    return State(joins={}, stretches=[], until={})


def zones(ways: Ways, net: Net) -> Zones:
    """Find the stretches along all ways: edges whose twin, or an edge across them, is on any way as well."""
    used = np.zeros(len(net.length), bool)
    used[ways.edge] = True
    across = np.repeat(np.arange(len(used)), np.diff(net.cross_first))
    shared = (net.twin >= 0) & used[net.twin]
    shared |= np.bincount(across, weights=used[net.cross], minlength=len(used)) > 0
    return Zones(ways, net, *_stretches(ways, shared))


def order(state: State) -> Order:
    """Turns at joins as ``along.places`` takes them."""
    turns = [(int(edge), train, turn) for edge, queue in state["joins"].items() for turn, train in enumerate(queue)]
    return Order(*np.array(turns, np.int64).reshape(-1, 3).T.copy())


def request(
    zones: Zones, state: State, row: Ints, s: Floats, length: Floats, present: Bools, reach: Floats,
    clearance: float = 0.0, entering: Bools | None = None,
) -> tuple[State, Held, list[Decision]]:  # fmt: skip
    """Requests of all trains at one instant.

    Parameters
    ----------
    zones : Zones
        From ``zones``, of the ways the trains have now.
    state : State
        Requests so far; left as it is.
    row, s, length, present : ndarray, shape (n,)
        As in ``along.places``.
    reach : ndarray, shape (n,)
        How far ahead each train requests [m]: at least its braking distance.
    clearance : float
        Room one standing train needs beyond its length [m].
    entering : ndarray, shape (n,), optional
        Trains that are not on the net yet and ask to be, at ``row`` and ``s``: they may enter once their room is not 0.

    Returns
    -------
    State
        Requests now.
    Held
        How far each train may go.
    list of Decision
        Requests that were made or granted just now, in order.

    Notes
    -----
    A train whose front is in a stretch has it, as a fact. Turns at joins within a stretch come with it, and none beyond a stretch
    that is not granted: else one who waits for the stretch could be first where one who has it must pass. Trains on the way to one
    edge keep the order they stand in, or, where they come over different tracks, the order of their turns at the join.
    """
    outside = np.zeros(len(row), bool) if entering is None else entering
    until = s + reach
    for train, position in state["until"].items():
        until[int(train)] = max(until[int(train)], position)
    on = present | outside
    at, begin, edge = _near(zones, row, s, length, on, until), zones.ways.begin, zones.ways.edge
    joins: dict[tuple[int, int], int] = {}
    stretches: dict[tuple[int, int], int] = {}
    for i, k, is_join in zip(*(a.tolist() for a in at), strict=True):
        (joins if is_join else stretches).setdefault((i, int(edge[k])), k)
    trains = _Trains(zones, row, s, length, *_coming(zones, row, present))

    queues = {int(e): [i for i in queue if (i, int(e)) in joins] for e, queue in state["joins"].items()}
    leave = {(i, e): g for i, e, g in state["stretches"]}
    said = _turns(trains, queues, joins, _open(joins, stretches, leave))
    order, granted = _queue(trains, state["stretches"], stretches, queues)
    new = granted.keys() - {(i, e) for i, e, _ in state["stretches"]}
    held, waiting = _Index(zones, trains), _Index(zones, trains)
    for key in order:
        if granted[key] or (s[key[0]] > begin[stretches[key]] and not outside[key[0]]):
            if not granted[key]:
                said.append(Decision(*key, True, -1, False))
            granted[key] = True
            held.add(key[0], [stretches[key]])
    leading: dict[int, set[int]] = {}
    for key in order:
        if granted[key]:
            _lead(leading, zones, key[0], stretches[key])
    room, zone, by = np.full(len(row), np.inf), np.full(len(row), -1, np.int64), np.full(len(row), -1, np.int64)
    behind: dict[int, int] = {}
    for key in list(order):
        i, e = key
        k = stretches[key]
        if granted[key]:
            continue
        rest: list[int] = []
        blocker = behind.get(e, -1)
        if room[i] < np.inf:  # it does not even have the one before this one
            blocker = int(by[i])
        elif blocker < 0:
            rest, in_front = _needed_too(trains, i, k, clearance, leading, granted, queues)
            later = held.blocker(i, rest)
            later = in_front if later < 0 else later
            blocker = max(held.blocker(i, [k]), waiting.blocker(i, [k]), key=lambda j: j >= 0)
            if blocker < 0:
                blocker = later if later >= 0 else waiting.blocker(i, rest)
            if blocker >= 0 and later < 0:
                waiting.add(i, [k, *rest])
        if blocker >= 0:
            behind.setdefault(e, i)
            if key in new:
                said.append(Decision(i, e, False, blocker, False))
            if begin[k] - s[i] < room[i]:
                room[i], zone[i], by[i] = max(begin[k] - s[i], 0.0), e, blocker
            continue
        held.add(i, [k, *rest])
        for r in [k, *rest]:
            one = (i, int(edge[r]))
            if one not in granted:
                order.append(one)
                stretches[one] = r
            if not granted.get(one, False):
                said.append(Decision(*one, True, -1, False))
            granted[one] = True
            until[i] = max(until[i], begin[r])
            _lead(leading, zones, i, r)
    for (i, e), k in stretches.items():
        if granted[i, e]:  # with it go the turns within it
            last = int(zones.ends[k])
            until[i] = max(until[i], begin[last])
            for r in range(max(k, int(zones.ways.first[i]) + 1), last + 1):
                if zones.net.joins[edge[r]] and begin[r] > s[i] - length[i]:
                    joins.setdefault((i, int(edge[r])), r)
    said += _turns(trains, queues, joins, _open(joins, stretches, granted))
    now = State(
        joins={str(e): queue for e, queue in queues.items() if queue},
        stretches=[(i, e, granted[i, e]) for i, e in order],
        until={str(i): float(until[i]) for i in sorted({i for i, _ in (*joins, *stretches)})},
    )
    return now, Held(room, zone, by), said


class _Trains(NamedTuple):
    """Where the trains are."""

    zones: Zones
    row: Ints
    s: Floats
    length: Floats
    entry: Ints  # edges over which trains enter their next stretch, ascending
    comer: Ints  # those trains

    def coming(self, e: int) -> list[int]:
        """Trains whose next stretch begins with edge ``e``."""
        found: list[int] = self.comer[np.searchsorted(self.entry, e) : np.searchsorted(self.entry, e, side="right")].tolist()
        return found

    def distance(self, i: int, k: int) -> float:
        return float(self.zones.ways.begin[k] - self.s[i])

    def goes_before(self, i: int, k: int, j: int, m: int, queues: dict[int, list[int]]) -> bool:
        """Whether ``i`` comes before ``j`` to the edge at their rows k and m, by where they stand or by their turns before it."""
        edge = self.zones.ways.edge
        nearer = (self.distance(i, k), i) < (self.distance(j, m), j)
        while k > self.row[i] and m > self.row[j]:
            if edge[k - 1] != edge[m - 1]:
                turns = queues.get(int(edge[k]), [])
                if i in turns and j in turns:
                    return turns.index(i) < turns.index(j)
                return i in turns or (j not in turns and nearer)
            k, m = k - 1, m - 1
        return nearer


def _open(
    joins: dict[tuple[int, int], int], stretches: dict[tuple[int, int], int], granted: dict[tuple[int, int], bool]
) -> dict[tuple[int, int], int]:
    """Those joins that trains may take a turn at: no stretch they have not been granted contains them or lies before."""
    shut: dict[int, int] = {}
    for (i, e), k in stretches.items():
        if not granted.get((i, e), False):
            shut[i] = min(k, shut.get(i, k))
    return {(i, e): k for (i, e), k in joins.items() if i not in shut or k < shut[i]}


def _turns(
    trains: _Trains, queues: dict[int, list[int]], near: dict[tuple[int, int], int], new: dict[tuple[int, int], int]
) -> list[Decision]:
    """Put new trains into the queues at joins: last, unless they stand before another from the same track."""
    edge = trains.zones.ways.edge
    said = []
    for (i, e), k in sorted(new.items(), key=lambda item: (trains.distance(item[0][0], item[1]), item[0])):
        queue = queues.setdefault(e, [])
        if i in queue:
            continue
        same = (t for t, j in enumerate(queue) if edge[near[j, e] - 1] == edge[k - 1])
        turn = next((t for t in same if trains.goes_before(i, k, queue[t], near[queue[t], e], queues)), len(queue))
        queue.insert(turn, i)
        others = [j for j in queue[:turn] if edge[near[j, e] - 1] != edge[k - 1]]
        said.append(Decision(i, e, not others, others[-1] if others else -1, True))
    return said


def _queue(
    trains: _Trains, before: Iterable[tuple[int, int, bool]], near: dict[tuple[int, int], int], queues: dict[int, list[int]]
) -> tuple[list[tuple[int, int]], dict[tuple[int, int], bool]]:
    """Requests of stretches in order, and whether they are granted; new ones last, unless they go before another over that edge."""
    granted = {(i, e): bool(g) for i, e, g in before if (i, e) in near}
    order = list(granted)
    over: dict[int, list[int]] = {}  # trains in order, by edge
    for i, e in order:
        over.setdefault(e, []).append(i)
    for (i, e), k in sorted(near.items(), key=lambda item: (trains.distance(item[0][0], item[1]), item[0])):
        if (i, e) in granted:
            continue
        queue = over.setdefault(e, [])
        turn = next((t for t, j in enumerate(queue) if trains.goes_before(i, k, j, near[j, e], queues)), len(queue))
        order.insert(order.index((queue[turn], e)) if turn < len(queue) else len(order), (i, e))
        queue.insert(turn, i)
        granted[i, e] = False
    return order, granted


class _Index:
    """Which trains request each edge."""

    def __init__(self, zones: Zones, trains: _Trains) -> None:
        self.zones, self.trains, self.on = zones, trains, dict[int, list[int]]()

    def add(self, i: int, rows: Iterable[int]) -> None:
        """Put in train ``i`` on what its rear has not left of the stretches that begin at these rows."""
        ways = self.zones.ways
        rear = self.trains.s[i] - self.trains.length[i]
        for k in rows:
            for r in range(k, self.zones.ends[k] + 1):
                if ways.begin[r] + self.zones.net.length[ways.edge[r]] > rear:
                    self.on.setdefault(int(ways.edge[r]), []).append(i)

    def blocker(self, i: int, rows: Iterable[int]) -> int:
        """A train that requests the twin of, or what is across, an edge of the stretches of ``i`` at these rows; -1: none."""
        net, edge = self.zones.net, self.zones.ways.edge
        for k in rows:
            for r in range(k, self.zones.ends[k] + 1):
                e = int(edge[r])
                for f in (int(net.twin[e]), *net.cross[net.cross_first[e] : net.cross_first[e + 1]].tolist()):
                    for j in self.on.get(f, ()):
                        if j != i:
                            return j
        return -1


def _lead(leading: dict[int, set[int]], zones: Zones, i: int, k: int) -> None:
    """Note that train ``i`` was let into the stretch at row k, under the edge over which it enters the one after it."""
    after = zones.following[k]
    if after >= 0:
        leading.setdefault(int(zones.ways.edge[after]), set()).add(i)


def _coming(zones: Zones, row: Ints, present: Bools) -> tuple[Ints, Ints]:
    """Edges over which trains enter their next stretch, ascending, and those trains."""
    train = np.flatnonzero(present)
    train = train[zones.following[row[train]] >= 0]
    entry = zones.ways.edge[zones.following[row[train]]]
    by_edge = np.argsort(entry, kind="stable")
    return entry[by_edge], train[by_edge]


def _needed_too(
    trains: _Trains, i: int, k: int, clearance: float, leading: dict[int, set[int]], granted: dict[tuple[int, int], bool],
    queues: dict[int, list[int]],
) -> tuple[list[int], int]:  # fmt: skip
    """First rows of the stretches ``i`` needs together with that of row k, since it could not stand between them.

    Also a train that stands there before ``i`` and has no leave to go on, or -1.
    """
    zones = trains.zones
    begin, edge = zones.ways.begin, zones.ways.edge
    found: list[int] = []
    while (after := int(zones.following[k])) >= 0:
        e = int(edge[after])
        room = begin[after] - begin[zones.ends[k] + 1]
        between = [j for j in trains.coming(e) if trains.distance(j, int(zones.following[trains.row[j]])) <= room]
        standing = {j for j in {*between, *leading.get(e, ())} if j != i and not granted.get((j, e), False)}
        if sum(trains.length[j] + clearance for j in {i, *standing}) <= room or granted.get((i, e), False):
            break
        found.append(after)
        for j in sorted(standing):
            m = int(trains.row[j])
            while edge[m] != e:
                m += 1
            if trains.goes_before(j, m, i, after, queues):
                return found, j
        k = after
    return found, -1


@njit(cache=True)
def _stretches(ways: Ways, shared: Bools) -> tuple[Ints, Ints, Ints]:
    """First and last row of every row's stretch, and the first row of the next one, shape (W,) each; -1: none."""
    count = len(ways.edge)
    begins, ends, following = np.full(count, -1, np.int64), np.full(count, -1, np.int64), np.full(count, -1, np.int64)
    for i in range(len(ways.first) - 1):
        for k in range(ways.first[i], ways.first[i + 1]):
            if shared[ways.edge[k]]:
                begins[k] = begins[k - 1] if k > ways.first[i] and begins[k - 1] >= 0 else k
        for k in range(ways.first[i + 1] - 2, ways.first[i] - 1, -1):
            following[k] = begins[k + 1] if begins[k + 1] == k + 1 else following[k + 1]
        for k in range(ways.first[i + 1] - 1, ways.first[i] - 1, -1):
            if begins[k] >= 0:
                more = k + 1 < ways.first[i + 1] and begins[k + 1] >= 0
                ends[k] = ends[k + 1] if more else k
    return begins, ends, following


@njit(cache=True)
def _near(zones: Zones, row: Ints, s: Floats, length: Floats, on: Bools, until: Floats) -> tuple[Ints, Ints, Bools]:
    """What every train has to request, from its rear up to ``until``: train, row, whether it is a join (or a stretch)."""
    ways, net, begins = zones.ways, zones.net, zones.begins
    count = 0
    for again in range(2):
        if again:
            train, at, is_join = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count, np.bool_)
        count = 0
        for i in range(len(row)):
            if not on[i]:
                continue
            rear, first = s[i] - length[i], ways.first[i]
            back = row[i]
            while back > first and ways.begin[back] > rear:
                back -= 1
            for k in range(back, ways.first[i + 1]):
                if k > row[i] and ways.begin[k] > until[i]:
                    break
                if begins[k] >= 0 and (k == back or begins[k] == k):
                    if again:
                        train[count], at[count], is_join[count] = i, begins[k], False
                    count += 1
                if k > first and net.joins[ways.edge[k]] and ways.begin[k] > rear:
                    if again:
                        train[count], at[count], is_join[count] = i, k, True
                    count += 1
    return train, at, is_join
