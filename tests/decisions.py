"""Random single track and trains that only decisions of the interlocking move: no time, no driving, as fast as can be tried."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from trainctl.railway import along, bodies, interlocking, zones
from trainctl.railway.ways import ways as laid

#: What a standing train needs beyond its length, and how near it comes to what is ahead [m].
CLEARANCE, MARGIN = 15.0, 5.0


class Railway(NamedTuple):
    """A net as ``along.Railway`` reads it, and the names of its edges."""

    length_m: np.ndarray[Any, Any]
    before: list[list[int]]
    twin: np.ndarray[Any, Any]
    crossing: list[list[int]]
    number: dict[str, int]


class Plan(NamedTuple):
    """Trains on a net."""

    railway: Railway
    paths: list[list[int]]
    length: np.ndarray[Any, Any]  # (n,) m
    due: np.ndarray[Any, Any]  # (n,) round in which each may come first
    orders: Sequence[tuple[str, int, int]] = ()  # edge, the train that passes it first, and the one that comes next


def railway(lengths: dict[str, float], links: Sequence[tuple[str, str]], twins: Sequence[tuple[str, str]]) -> Railway:
    """``lengths`` of edges [m]; pairs of edges of which one leads to the other; pairs that are one track."""
    number = {name: k for k, name in enumerate(lengths)}
    twin = np.full(len(number), -1)
    before: list[list[int]] = [[] for _ in number]
    for a, b in twins:
        twin[number[a]], twin[number[b]] = number[b], number[a]
    for a, b in links:
        before[number[b]].append(number[a])
    return Railway(np.array(list(lengths.values()), float), before, twin, [[] for _ in number], number)


def at_random(seed: int) -> Plan:
    """A line of single track and stations of one to three tracks, perhaps with a branch; 2 to 20 trains from its ends."""
    rng = np.random.default_rng(seed)
    stations = int(rng.integers(1, 6))
    lengths: dict[str, float] = {}
    links: list[tuple[str, str]] = []
    twins: list[tuple[str, str]] = []

    def track(name: str, metres: float) -> None:
        lengths[name], lengths[f"-{name}"] = metres, metres
        twins.append((name, f"-{name}"))

    def join(a: str, b: str) -> None:
        links.extend([(a, b), (f"-{b}", f"-{a}")])

    for k in range(stations + 1):
        track(f"s{k}", float(rng.uniform(800, 4000)) if k in (0, stations) else float(rng.uniform(200, 4000)))
    platforms = []
    for k in range(stations):
        tracks = int(rng.integers(1, 4))
        platforms.append([f"p{k}.{t}" for t in range(tracks)])
        for name in platforms[-1]:
            track(name, float(rng.uniform(150, 1500)))
            join(f"s{k}", name)
            join(name, f"s{k + 1}")
    at = int(rng.integers(0, stations)) if rng.random() < 0.4 else -1  # a branch joins before this station
    if at >= 0:
        track("branch", float(rng.uniform(800, 3000)))
        for name in platforms[at]:
            join("branch", name)
    one_way = rng.random() < 0.5  # loops with a direction, where there are two tracks
    n = int(rng.integers(2, 21))
    paths = []
    for _ in range(n):
        up, over = bool(rng.integers(2)), at >= 0 and rng.random() < 0.3
        path = ["branch" if over else "s0"]
        for k in range(at if over else 0, stations):
            names = platforms[k]
            if one_way and len(names) == 2:
                names = names[:1] if up else names[1:]
            path += [*([f"s{k}"] if k > (at if over else 0) else []), str(rng.choice(names))]
        path.append(f"s{stations}")
        if not up:
            path = [f"-{name}" for name in reversed(path)]
        paths.append(path)
    made = railway(lengths, links, twins)
    return Plan(
        made, [[made.number[e] for e in path] for path in paths], rng.uniform(40.0, 700.0, n), np.sort(rng.integers(0, 4 * n, n))
    )


def played(plan: Plan, seed: int, reach: float = 300.0, rounds: int = 4000) -> int:
    """Let the trains of a plan move at random as far as they may, until all have left; the rounds that took.

    Fails if two meet or overlap, or if there is a round in which nobody can move though all have asked.
    """
    rng = np.random.default_rng(seed)
    ways = laid(plan.paths, np.zeros(len(plan.railway.length_m)), plan.railway.length_m)
    net = along.net(plan.railway)
    shared, n, length = zones.of(ways, net), len(plan.paths), plan.length
    end = ways.begin[ways.first[1:] - 1] + net.length[ways.edge[ways.first[1:] - 1]]
    row, s = ways.first[:-1].copy(), length.copy()
    present, left = np.zeros(n, bool), np.zeros(n, bool)
    state, idle, orders = interlocking.none(), 0, in_order(plan, ways)
    for step in range(rounds):
        first: dict[int, int] = {}
        for i in np.flatnonzero(~present & ~left & (plan.due <= step)).tolist():
            first.setdefault(int(ways.edge[ways.first[i]]), i)
        entering = np.zeros(n, bool)
        entering[list(first.values())] = True
        state, ends, _ = interlocking.request(
            shared, state, row, s, length, present, np.full(n, reach), CLEARANCE, entering,
            ordered=[o for o in orders if not (left[o.first] or (present[o.first] and row[o.first] >= o.at))],
        )  # fmt: skip
        moved = False
        for e, i in first.items():
            rears = [s[j] - length[j] - ways.begin[row[j]] for j in np.flatnonzero(present) if ways.edge[row[j]] == e]
            tails = [1 for j in np.flatnonzero(present) for f, _ in under(ways, row, s, length, int(j)) if f == e]
            clear = min(rears, default=np.inf) > length[i] + CLEARANCE if rears else not tails
            if ends.room[i] > 0.0 and clear:
                present[i] = moved = True
        here = along.places(ways, net, row, s, length, present, 20000.0, interlocking.order(state))
        room = np.minimum(bodies.obstacles(here, virtual=False).room, ends.room) - MARGIN
        for i in np.flatnonzero(present & (rng.random(n) < 0.7) & (room > 0.5)).tolist():
            if entering[i]:
                continue
            s[i] += min(room[i], 0.8 * reach) * (1.0 if rng.random() < 0.5 else rng.random())
            moved = True
            while row[i] + 1 < ways.first[i + 1] and ways.begin[row[i] + 1] <= s[i]:
                row[i] += 1
        gone = present & (s >= end)
        present &= ~gone
        left |= gone
        _apart(plan, ways, row, s, length, present, (seed, step))
        if left.all():
            return step
        idle = 0 if moved or (plan.due > step).any() else idle + 1
        if idle > 30:
            break
    where = {
        i: (_names(plan)[ways.edge[row[i]]], round(float(s[i] - ways.begin[row[i]]), 1), float(length[i]))
        for i in np.flatnonzero(present)
    }
    raise AssertionError(f"seed {seed}: {np.flatnonzero(~left).tolist()} never arrive: {where}, {state}, {ends}")


def in_order(plan: Plan, ways: Any) -> list[zones.Ordered]:
    """The orders of a plan, as rows of ways."""
    net, found = plan.railway, []
    for name, first, then in plan.orders:
        here = {net.number[name], int(net.twin[net.number[name]])}
        at, row = (int(ways.first[i]) + next(k for k, e in enumerate(plan.paths[i]) if e in here) for i in (first, then))
        found.append(zones.Ordered(then, row, first, at))
    return found


def _names(plan: Plan) -> list[str]:
    return list(plan.railway.number)


def under(ways: Any, row: Any, s: Any, length: Any, i: int) -> list[tuple[int, float]]:
    """Edges under a train, and how deep its front is on them."""
    k, found = int(row[i]), []
    while True:
        found.append((int(ways.edge[k]), float(s[i] - ways.begin[k])))
        if k == ways.first[i] or ways.begin[k] <= s[i] - length[i]:
            return found
        k -= 1


def _apart(plan: Plan, ways: Any, row: Any, s: Any, length: Any, present: Any, when: Any) -> None:
    """Nobody is inside another, or on the same track in the other direction."""
    on: dict[int, list[tuple[float, float, int]]] = {}
    for i in np.flatnonzero(present).tolist():
        for e, depth in under(ways, row, s, length, i):
            on.setdefault(e, []).append((depth, depth - length[i], i))
    for e, trains in on.items():
        trains.sort()
        assert all(a[0] < b[1] for a, b in pairwise(trains)), ("overlap", when, trains)
        assert int(plan.railway.twin[e]) not in on, ("foe", when, e)
