"""What the interlocking asks of ``deadlock``: where all trains may come to stand, and after whom, if one gets what it asks for."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence

import numpy as np

from trainctl.railway import deadlock
from trainctl.railway.zones import Ordered, Trains
from trainctl.signals import Bools, Ints

#: A train this near to its own stop is at it [m].
AT_M = 1e-3


def limit(trains: Trains, granted: dict[tuple[int, int], bool], i: int, more: Container[tuple[int, int]] = ()) -> int:
    """First row that a train has not been granted; -1: all is. The stretch its front is in it has, as a fact."""
    edge, following = trains.zones.ways.edge, trains.zones.following
    k = int(following[trains.row[i]])
    while k >= 0 and (granted.get((i, int(edge[k])), False) or (i, int(edge[k])) in more):
        k = int(following[k])
    return k


def standing(
    trains: Trains, on: Bools, granted: dict[tuple[int, int], bool], i: int, rows: Sequence[int], clearance: float,
    queues: dict[int, list[int]], joins: dict[tuple[int, int], int], ordered: Sequence[Ordered],
    back: Mapping[int, Sequence[int]],
) -> deadlock.Standing:  # fmt: skip
    """Where all may come to stand if ``i`` gets the stretches at these rows."""
    zones, begin, edge = trains.zones, trains.zones.ways.begin, trains.zones.ways.edge
    more = {(i, int(edge[k])) for k in rows}
    known = {i, *np.flatnonzero(on).tolist()}
    following = dict(zip(known, zones.following[trains.row[list(known)]].tolist(), strict=True))
    limits = {j: k if k < 0 else limit(trains, granted, j, more) for j, k in following.items()}
    new = {int(edge[r]): r for r in joining(trains, i, rows[0], int(zones.ends[rows[-1]]))} if rows else {}
    then, turns = _turns_before(trains, limits, queues, joins, i, new)

    def stands(orders: Sequence[Ordered]) -> deadlock.Standing:
        # Who waits before a place in a stretch does not enter that.
        more = [(j, b if (b := int(zones.begins[k])) > trains.row[j] else k, [first]) for j, k, first, _ in orders]
        return deadlock.standing(
            zones.ways, zones.net, trains.row, trains.s, trains.length, clearance, limits, [*turns, *more], trains.before(then),
            back,
        )  # fmt: skip

    orders = [one for one in ordered if one.train in limits]
    here = stands(orders)
    if not orders:
        return here
    rear = deadlock.rears(here)  # who comes to a stand beyond the place only has passed it by then
    left = [o for o in orders if o.first not in limits or rear.get(o.first, np.inf) + trains.length[o.first] <= begin[o.at] + AT_M]
    return here if len(left) == len(orders) else stands(left)


def _turns_before(
    trains: Trains, limits: Iterable[int], queues: dict[int, list[int]], joins: Mapping[tuple[int, int], int],
    i: int, new: Mapping[int, int],
) -> tuple[dict[int, list[int]], list[tuple[int, int, list[int]]]]:  # fmt: skip
    """The queues if ``i`` gets ``new`` turns; and who comes to their joins, its row, and those that pass before it.

    Also who is far from the join, or has yet to be granted the track up to it, passes after those that have their turns by now.
    """
    first, edge = trains.zones.ways.first, trains.zones.ways.edge
    rows = {(i, e): r for e, r in new.items()} | dict(joins)
    then = {e: list(queue) for e, queue in queues.items()}
    for e, r in new.items():
        queue = then.setdefault(e, [])
        if i not in queue:
            queue.insert(turn_in(trains, queue, rows, i, r, then), i)
    if not then:
        return then, []
    queued: Bools = np.zeros(len(trains.zones.net.joins), bool)
    queued[list(then)] = True
    passed, train = np.flatnonzero(queued[edge]), np.fromiter(limits, np.int64)
    low, high = np.searchsorted(passed, trains.row[train] + 1), np.searchsorted(passed, first[train + 1])
    found = []
    for j, a, b in zip(train.tolist(), low.tolist(), high.tolist(), strict=True):
        for k in passed[a:b].tolist():
            e = int(edge[k])
            queue = then[e]
            if j in queue and rows[j, e] != k:  # round once more
                continue
            turn = queue.index(j) if j in queue else turn_in(trains, queue, rows, j, k, then)
            found.append((j, k, [m for m in queue[:turn] if m in limits and trains.track(m, rows[m, e]) != trains.track(j, k)]))
    return then, found


def joining(trains: Trains, i: int, k: int, last: int) -> list[int]:
    """Rows of joins from row k to ``last`` that the rear of ``i`` has not left."""
    ways, joins = trains.zones.ways, trains.zones.net.joins
    rear = trains.s[i] - trains.length[i]
    return [r for r in range(max(k, int(ways.first[i]) + 1), last + 1) if joins[ways.edge[r]] and ways.begin[r] > rear]


def turn_in(
    trains: Trains, queue: Sequence[int], near: Mapping[tuple[int, int], int], i: int, k: int, queues: dict[int, list[int]]
) -> int:  # fmt: skip
    """Place of a new train in a queue at the join of its row k: last, unless it stands before another from the same track."""
    e = int(trains.zones.ways.edge[k])
    same = (t for t, j in enumerate(queue) if trains.track(j, near[j, e]) == trains.track(i, k))
    return next((t for t in same if trains.goes_before(i, k, queue[t], near[queue[t], e], queues)), len(queue))


def stood_on(here: deadlock.Standing, ends: Ints, i: int, rows: Iterable[int]) -> bool:
    """Whether another may come to stand where it shuts the stretches at these rows to ``i``: they do not clear by themselves."""
    return any(True for k in rows for r in range(k, ends[k] + 1) for _ in deadlock.against(here, i, r))
