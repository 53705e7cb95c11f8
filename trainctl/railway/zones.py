"""What is exclusive along the ways of trains, and where the trains are on them: what the interlocking decides on."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from trainctl.kernels import keep_by_sources
from trainctl.railway import deadlock
from trainctl.railway.along import Net
from trainctl.railway.ways import Ways
from trainctl.signals import Bools, Floats, Ints

keep_by_sources()  # before anything below is decorated

#: Rounding of places [m].
TOUCH_M = 1e-6


class Zones(NamedTuple):
    """What is exclusive along every way; to be made anew when ways change. W rows as in ``ways``."""

    ways: Ways
    net: Net
    begins: Ints  # (W,) first row of the stretch this row is in, -1: in none
    ends: Ints  # (W,) last row of it, -1
    following: Ints  # (W,) first row of the next stretch after this row's, -1: none


def of(ways: Ways, net: Net, later: Sequence[int] | Ints = ()) -> Zones:
    """Find the stretches along all ways: edges whose twin, or an edge across them, is on any way as well.

    ``later`` are further edges that trains come to run over: those they turn back over.
    """
    used = np.zeros(len(net.length), bool)
    used[ways.edge] = True
    used[np.asarray(later, np.int64)] = True
    across = np.repeat(np.arange(len(used)), np.diff(net.cross_first))
    shared = (net.twin >= 0) & used[net.twin]
    shared |= np.bincount(across, weights=used[net.cross], minlength=len(used)) > 0
    return Zones(ways, net, *_stretches(ways, shared))


def short_of_junctions(ways: Ways, net: Net, internal: Bools, train: Ints, row: Ints, s: Floats, room: Floats) -> Floats:
    """Room (k,) [m] up to what trains must not enter yet, but not onto a junction on which another track comes in beside theirs.

    Parameters
    ----------
    ways, net : Ways, Net
        Of all trains.
    internal : ndarray of bool, shape (E,)
        Edges inside junctions.
    row, s : ndarray, shape (n,)
        Where the fronts are.
    train, room : ndarray, shape (k,)
        Trains, and the room from their fronts to the beginning of an edge [m]; inf: none.
    """
    return _short_of_junctions(ways, net.joins, internal, train, row, s, room)


@njit(cache=True)
def _short_of_junctions(ways: Ways, joins: Bools, internal: Bools, train: Ints, row: Ints, s: Floats, room: Floats) -> Floats:
    found = room.copy()
    for q in range(len(room)):
        if not 0.0 < room[q] < np.inf:
            continue
        i = train[q]
        a, b = row[i], ways.first[i + 1]
        k = a + np.searchsorted(ways.begin[a:b], s[i] + room[q] - TOUCH_M)
        if k < b and joins[ways.edge[k]]:
            while k > a and internal[ways.edge[k - 1]]:
                k -= 1
            found[q] = max(ways.begin[k] - s[i], 0.0)
    return found


class Ordered(NamedTuple):
    """A train that must not enter row ``row`` of its way before another one has entered row ``at`` of its own."""

    train: int
    row: int
    first: int
    at: int


def passes_first(
    pairs: Iterable[tuple[int, int, int]], net: Net, ways: Ways, row: Ints, came: Bools, never: Bools
) -> list[Ordered]:  # fmt: skip
    """Trains that must let another one pass an edge first.

    Parameters
    ----------
    pairs : iterable of tuple
        Edge, the train that passes first, and the next one.
    net, ways : Net, Ways
        Of all n trains.
    row : ndarray, shape (n,)
        Where their fronts are.
    came, never : ndarray of bool, shape (n,)
        Trains that have entered, and those that do not pass any more.
    """
    found = []
    for edge, first, then in pairs:
        here = [edge] if net.twin[edge] < 0 else [edge, net.twin[edge]]
        rows = [ways.first[i] + np.flatnonzero(np.isin(ways.edge[ways.first[i] : ways.first[i + 1]], here)) for i in (first, then)]
        if not all(map(len, rows)) or never[first]:
            continue
        if not (came[first] and row[first] >= rows[0][0]) and not (came[then] and row[then] >= rows[1][0]):
            found.append(Ordered(then, int(rows[1][0]), first, int(rows[0][0])))
    return found


class Trains(NamedTuple):
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

    def before(self, queues: dict[int, list[int]]) -> deadlock.Before:
        """Who comes before whom, see ``deadlock.Before``; each is worked out once, though it is asked for many times."""
        known: dict[tuple[int, int, int, int], bool] = {}

        def asked(j: int, m: int, i: int, k: int) -> bool:
            if (found := known.get((j, m, i, k))) is None:
                found = known[j, m, i, k] = self.goes_before(j, m, i, k, queues)
            return found

        return asked

    def track(self, i: int, k: int) -> int:
        """Edge over which ``i`` comes to that of row k; -1: it begins there."""
        return int(self.zones.ways.edge[k - 1]) if k > self.zones.ways.first[i] else -1

    def distance(self, i: int, k: int) -> float:
        """From the front of a train to its row k [m]."""
        return float(self.zones.ways.begin[k] - self.s[i])

    def goes_before(self, i: int, k: int, j: int, m: int, queues: dict[int, list[int]]) -> bool:
        """Whether ``i`` comes before ``j`` to the edge at their rows k and m, by where they are or by their turns before it."""
        edge, back, last = self.zones.ways.edge, 0, min(k - int(self.row[i]), m - int(self.row[j]))
        while back < last:
            if edge[k - back - 1] != edge[m - back - 1]:
                turns = queues.get(int(edge[k - back]), [])
                if i in turns and j in turns:
                    return turns.index(i) < turns.index(j)
                if i in turns or j in turns:
                    return i in turns
                break
            back += 1
        return (self.distance(i, k), i) < (self.distance(j, m), j)


class Index:
    """Which trains request each edge, and how far their rears are on it [m], below 0: not yet."""

    def __init__(self, zones: Zones, trains: Trains) -> None:
        self.zones, self.trains, self.on = zones, trains, dict[int, list[tuple[int, float]]]()

    def add(self, i: int, rows: Iterable[int]) -> None:
        """Put in train ``i`` on what its rear has not left of the stretches that begin at these rows."""
        ways = self.zones.ways
        rear = self.trains.s[i] - self.trains.length[i]
        for k in rows:
            for r in range(k, self.zones.ends[k] + 1):
                if ways.begin[r] + self.zones.net.length[ways.edge[r]] > rear:
                    self.on.setdefault(int(ways.edge[r]), []).append((i, float(rear - ways.begin[r])))

    def blocker(self, i: int, rows: Iterable[int]) -> int:
        """A train that requests the twin of, or what is across, an edge of the stretches of ``i`` at these rows; -1: none.

        Who runs the other way on one track and has its rear behind that of ``i`` goes away from it: one of the two has turned.
        """
        net, edge, begin = self.zones.net, self.zones.ways.edge, self.zones.ways.begin
        rear = self.trains.s[i] - self.trains.length[i]
        for k in rows:
            for r in range(k, self.zones.ends[k] + 1):
                e = int(edge[r])
                for f in (int(net.twin[e]), *net.cross[net.cross_first[e] : net.cross_first[e + 1]].tolist()):
                    for j, inside in self.on.get(f, ()):
                        if j != i and not (
                            f == net.twin[e] and deadlock.goes_away(float(rear - begin[r]), inside, float(net.length[e]))
                        ):
                            return j
        return -1


def coming(zones: Zones, row: Ints, present: Bools) -> tuple[Ints, Ints]:
    """Edges over which trains enter their next stretch, ascending, and those trains."""
    train = np.flatnonzero(present)
    train = train[zones.following[row[train]] >= 0]
    entry = zones.ways.edge[zones.following[row[train]]]
    by_edge = np.argsort(entry, kind="stable")
    return entry[by_edge], train[by_edge]


def under(ways: Ways, row: Ints, s: Floats, length: Floats, i: int) -> Iterable[int]:
    """Rows of the edges under a train, from its front to its rear, as far as its way goes back."""
    k = int(row[i])
    yield k
    while k > ways.first[i] and ways.begin[k] > s[i] - length[i]:
        k -= 1
        yield k


def in_place_of(trains: Trains, present: Bools, outside: list[int], clearance: float) -> dict[int, int]:
    """Trains that are to enter where another one is: which."""
    ways, row, s, length = trains.zones.ways, trains.row, trains.s, trains.length
    on: dict[int, list[tuple[int, float]]] = {}
    for j in np.flatnonzero(present).tolist() if outside else ():
        for k in under(ways, row, s, length, j):
            on.setdefault(int(ways.edge[k]), []).append((j, s[j] - ways.begin[k]))
    found = {}
    for i in outside:
        for k in under(ways, row, s, length, i):
            depth = s[i] - ways.begin[k]
            for j, other in on.get(int(ways.edge[k]), ()):
                if other - length[j] < depth + clearance and other > depth - length[i]:
                    found[i] = j
    return found


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
def near(
    zones: Zones, joining: Bools, row: Ints, s: Floats, length: Floats, on: Bools, outside: Bools, until: Floats
) -> tuple[Ints, Ints, Bools]:
    """What every train has to request, from its rear up to ``until``: train, row, whether it is a join (or a stretch)."""
    ways, begins = zones.ways, zones.begins
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
                if joining[ways.edge[k]] and (outside[i] if k == first else ways.begin[k] > rear):
                    if again:
                        train[count], at[count], is_join[count] = i, k, True
                    count += 1
    return train, at, is_join
