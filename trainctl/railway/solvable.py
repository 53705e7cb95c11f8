"""Whether trains can all get out at all, whoever decides: a search over where they may stop, with a stated limit of effort.

The interlocking never lets trains into a circle, so without orders there is always a way out: one train after the other. Orders can
forbid every one: where two trains are to meet at a siding that is shorter than they are, say. A *state* is where trains are: not
on the net yet, with the front at the end of an edge or behind another train, or gone. A *move* takes one train on to another such
place, over track on which no train is, or lets it in, or out. One at a time is enough, since whatever trains do at
once they can do in small moves, one after the other; and whoever can leave leaves, which obstructs no other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from trainctl.railway.along import Net
from trainctl.railway.ways import Ways
from trainctl.signals import Floats

#: States looked at before a case counts as not decided.
EFFORT = 5000

#: Shorter moves are none [m].
LEAST_M = 0.5

#: Positions of who is not on the net yet, and of who has left [m].
OUT, GONE = -np.inf, np.inf


class Case(NamedTuple):
    """Trains that are to get out."""

    ways: Ways
    net: Net
    start: Floats  # (n,) m, front at entry; who enters over one edge comes in the order of the numbers
    length: Floats  # (n,) m, room that each needs where it stops
    orders: Sequence[tuple[int, int, int, int]]  # train, row of its way it must not enter before another one, and the row of that


class Found(NamedTuple):
    """What the search came to."""

    solution: bool | None  # None: not decided
    states: int  # looked at
    left: tuple[int, ...]  # trains that were still there when as many as could had gone


def meets_itself(ways: Ways, net: Net, length: Floats) -> list[tuple[int, int]]:
    """Trains (n,) longer than a loop of their own ways, and the row over which each would run into its own rear."""
    found = []
    for i in range(len(length)):
        last: dict[int, float] = {}  # end of the last passage over an edge [m]
        for k in range(int(ways.first[i]), int(ways.first[i + 1])):
            e, begin = int(ways.edge[k]), float(ways.begin[k])
            if any(last.get(f, OUT) > begin - length[i] for f in (e, *_against(net, e))):
                found.append((i, k))
                break
            last[e] = begin + float(net.length[e])
    return found


def search(case: Case, effort: int = EFFORT) -> Found:
    """Look for a way by which everybody gets out, in at most ``effort`` states."""
    n = len(case.length)
    least, seen, rest = tuple(range(n)), set[tuple[float, ...]](), [(OUT,) * n]
    while rest:
        state = rest.pop()
        if state in seen:
            continue
        if len(seen) == effort:
            return Found(None, effort, least)
        seen.add(state)
        left = tuple(i for i, s in enumerate(state) if s < GONE)
        if not left:
            return Found(True, len(seen), ())
        least = min(least, left, key=len)
        rest += _next(case, state)
    return Found(False, len(seen), least)


def _next(case: Case, state: tuple[float, ...]) -> list[tuple[float, ...]]:
    """States one move on, the best last: whoever can leave leaves, whoever is on the net goes far, others come."""
    on = _stood(case, state)
    moves: list[tuple[float, int, float]] = []  # by how good it is
    waiting = set[int]()
    for i, s in enumerate(state):
        if s == OUT:
            edge = int(case.ways.edge[case.ways.first[i]])
            if edge not in waiting and _clear(case, i, on):
                moves.append((OUT, i, float(case.start[i])))
            waiting.add(edge)
        elif s < GONE:
            for to in _places(case, state, i, on):
                if to == GONE:
                    return [(*state[:i], GONE, *state[i + 1 :])]
                moves.append((to - s, i, to))
    return [(*state[:i], to, *state[i + 1 :]) for _, i, to in sorted(moves)]


def _under(case: Case, i: int, s: float) -> list[int]:
    """Rows under train ``i`` with its front at ``s`` [m], from the front on."""
    begin, first = case.ways.begin, int(case.ways.first[i])
    k = max(first + int(np.searchsorted(begin[first : case.ways.first[i + 1]], s)) - 1, first)
    rows = [k]
    while k > first and begin[k] > s - case.length[i]:
        k -= 1
        rows.append(k)
    return rows


def _stood(case: Case, state: tuple[float, ...]) -> dict[int, list[tuple[float, int]]]:
    """Edges with the trains on them: how far the rear of each is in [m], < 0: on the edge before; and who."""
    on: dict[int, list[tuple[float, int]]] = {}
    for i, s in enumerate(state):
        if OUT < s < GONE:
            for k in _under(case, i, s):
                on.setdefault(int(case.ways.edge[k]), []).append((float(s - case.length[i] - case.ways.begin[k]), i))
    return on


def _against(net: Net, e: int) -> list[int]:
    """Edges on which nobody may be while another one is on edge ``e``."""
    return [f for f in (int(net.twin[e]), *net.cross[net.cross_first[e] : net.cross_first[e + 1]].tolist()) if f >= 0]


def _clear(case: Case, i: int, on: dict[int, list[tuple[float, int]]]) -> bool:
    """Whether the place at which a train is to come is free."""
    start, ways = float(case.start[i]), case.ways
    for k in _under(case, i, start):
        e, front = int(ways.edge[k]), start - float(ways.begin[k])
        if any(f in on for f in _against(case.net, e)):
            return False
        if any(rear < front and rear + case.length[j] > front - case.length[i] for rear, j in on.get(e, ())):
            return False
    return True


def _places(case: Case, state: tuple[float, ...], i: int, on: dict[int, list[tuple[float, int]]]) -> list[float]:
    """Where a train that is on the net may go and stop next [m]; just ``GONE`` if it can leave."""
    ways, s, found = case.ways, state[i], list[float]()
    held = {k: (j, m) for train, k, j, m in case.orders if train == i}
    row = _under(case, i, s)[0]
    for k in range(row, int(ways.first[i + 1])):
        e, begin = int(ways.edge[k]), float(ways.begin[k])
        if k > row:
            found += [begin] if begin > s + LEAST_M else []
            if k in held and state[held[k][0]] <= ways.begin[held[k][1]]:
                return found
            if any(j != i for f in _against(case.net, e) for _, j in on.get(f, ())):
                return found
        ahead = [rear for rear, j in on.get(e, ()) if j != i and (k > row or rear > s - begin - LEAST_M)]
        if ahead:
            to = begin + min(ahead)
            return found + ([to] if to > max(begin, s + LEAST_M) else [])
    return [GONE]
