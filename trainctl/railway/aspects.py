"""Rail signals along the ways of trains: which are ahead of each, who is first before it, and how far each may go.

What a signal shows belongs to its track, not to a train: whoever follows another one sees the green of that one, and the red a step
or two after it has passed. So green counts for the first train before a signal alone, and for that one only once it has been the
first, and has asked, for ``SETTLES`` steps; all others stop before the signal.

Who sets the signals may think better of a green, even while a train can stop no more. So a train claims every signal that it will
not be able to stop before by the next step: until it has passed, nobody else gets what it needs, and no train of ours comes onto
the track behind the signal. A green that was set while another came there is none yet.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numba import njit

from trainctl.kernels import keep_by_sources
from trainctl.railway.along import Order
from trainctl.railway.interlocking import EndOfAuthority
from trainctl.railway.ways import SAME_M, Ways
from trainctl.signals import Bools, Floats, Ints

keep_by_sources()  # before anything below is decorated

#: So many steps a signal takes to show what it means to a train that has just come to be the first before it, or to ask.
SETTLES = 3

#: A train stops this far before a signal [m].
STANDS_BEFORE_M = 0.5


class Sighted(NamedTuple):
    """Signals ahead of trains within their horizon, one row for each train and signal; by train, nearest first."""

    train: Ints
    signal: Ints
    room: Floats  # m, from the front to the signal
    row: Ints  # of the edge behind the signal, in the ways


class State(NamedTuple):
    """What signals showed a step ago."""

    first: Ints  # (Q,) train that is the first before each signal, -1: none
    steps: Ints  # (Q,) for so many steps
    red: Ints  # (n,) signal before which each train had to stop, -1: none
    place: Floats  # (n,) m, where that is on its way
    behind: Ints  # (n,) the edge behind it, -1: none
    cleared: Floats  # (n,) m, up to where each train might go
    claims: list[list[int]]  # [train, signal], by train: green, and the train cannot stop any more by the next step


class Told(NamedTuple):
    """What has just come about at a signal."""

    train: int
    signal: int
    passed: bool  # it ran through red; else green was taken back
    room: float  # m, to the signal, not where it passed


def table(ways: Ways, internal: Bools, signals: Mapping[tuple[int, int], int]) -> Ints:
    """Number of the signal at the beginning of every row of the ways, -1: none; shape (W,).

    Parameters
    ----------
    ways : Ways
        Of all trains.
    internal : ndarray of bool, shape (E,)
        Edges that lie on junctions.
    signals : mapping
        Number of the signal at the end of an edge for trains that go on to another one, both normal edges.
    """
    found = np.full(len(ways.edge), -1, np.int64)
    if not signals:
        return found
    rows = np.flatnonzero(~internal[ways.edge])
    train = np.searchsorted(ways.first, rows, side="right") - 1
    follows = train[1:] == train[:-1]
    edge, onward = ways.edge[rows[:-1]][follows].tolist(), ways.edge[rows[1:]][follows].tolist()
    found[rows[:-1][follows] + 1] = [signals.get(pair, -1) for pair in zip(edge, onward, strict=True)]
    return found


def block(ways: Ways, at: Ints, k: int) -> Ints:
    """Edges from the signal at the beginning of row k up to the next one on that way, or its end; ``at`` (W,) from ``table``."""
    end = int(ways.first[np.searchsorted(ways.first, k, side="right")])
    signals = np.flatnonzero(at[k + 1 : end] >= 0)
    return ways.edge[k : k + 1 + int(signals[0]) if len(signals) else end]


def none(signals: int, trains: int) -> State:
    """Nothing seen yet."""
    return State(
        first=np.full(signals, -1), steps=np.zeros(signals, np.int64), red=np.full(trains, -1), place=np.full(trains, np.nan),
        behind=np.full(trains, -1), cleared=np.full(trains, -np.inf), claims=[],
    )  # fmt: skip


def sighted(ways: Ways, at: Ints, row: Ints, s: Floats, present: Bools, horizon: Floats) -> Sighted:
    """Find the signals ahead of all trains; ``at`` (W,) from ``table``, ``horizon`` (n,) how far each looks [m]."""
    return Sighted(*_sighted(ways, at, row, s, present, horizon))


def decide(
    ways: Ways, seen: Sighted, green: Bools, s: Floats, present: Bools, asks: Bools, braking: Floats, binding: Floats, before: State
) -> tuple[State, EndOfAuthority, list[Told]]:
    """How far every train may go.

    Parameters
    ----------
    ways : Ways
        Of all n trains.
    seen : Sighted
        Signals ahead of them, and of those that are not on the net yet.
    green : ndarray of bool, shape (V,)
        What the signal of every row of ``seen`` shows.
    s, present, asks : ndarray, shape (n,)
        Front of every train [m], whether it is on the net, and whether it asks for signals: not while it is at a stop.
    braking, binding : ndarray, shape (n,)
        Braking distance of every train [m]; the distance from here within which it stops for certain if it
        sees red one step later [m].
    before : State
        A step ago.

    Returns
    -------
    State
        Now.
    EndOfAuthority
        ``room`` up to the first signal that a train must not pass, less ``STANDS_BEFORE_M``; ``zone`` the edge behind it; ``by``
        the train that is first before it, -1 if it is the train itself.
    list of Told
        Trains that passed red in this step, and those that lost a green they could not stop before any more.
    """
    n, there = len(s), present[seen.train]
    first = np.full(len(before.first), -1)
    near_last = np.lexsort((-seen.train, -seen.room, seen.signal))
    near_last = near_last[there[near_last]]
    first[seen.signal[near_last]] = seen.train[near_last]  # the last one written is the nearest
    steps = np.where((first >= 0) & (first == before.first) & asks[first], before.steps + 1, 0)
    own = first[seen.signal] == seen.train
    free = green & own & (steps[seen.signal] >= SETTLES)
    room, zone, by = np.full(n, np.inf), np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    red, place = np.full(n, -1), np.full(n, np.nan)
    stops = np.flatnonzero(~free)[::-1]  # the nearest is written last
    train = seen.train[stops]
    room[train] = np.maximum(seen.room[stops] - STANDS_BEFORE_M, 0.0)
    zone[train], red[train], place[train] = ways.edge[seen.row[stops]], seen.signal[stops], s[train] + seen.room[stops]
    by[train] = np.where(own[stops], -1, first[seen.signal[stops]])
    red, place = np.where(present, red, -1), np.where(present, place, np.nan)
    bound = np.flatnonzero(free & (seen.room < np.fmin(binding, place - s)[seen.train]))
    claims = [[i, q] for i, q in zip(seen.train[bound].tolist(), seen.signal[bound].tolist(), strict=True)]
    cleared = np.where(present, np.where(red >= 0, place, np.inf), -np.inf)
    passed, lost = (before.red >= 0) & present & (s > before.place), (cleared < before.cleared) & (place - s < braking)
    for i in np.flatnonzero(passed).tolist():  # unless it has turned, or has been led another way
        passed[i] = _leads_past(ways, i, float(before.place[i]), int(before.behind[i]))
    told = [Told(i, int(before.red[i]), True, 0.0) for i in np.flatnonzero(passed).tolist()]
    told += [Told(i, int(red[i]), False, float(place[i] - s[i])) for i in np.flatnonzero(lost & ~passed).tolist()]
    return State(first, steps, red, place, np.where(red >= 0, zone, -1), cleared, claims), EndOfAuthority(room, zone, by), told


def _leads_past(ways: Ways, i: int, place: float, edge: int) -> bool:
    """Whether the way of a train enters this edge at this place [m]."""
    rows = slice(ways.first[i], ways.first[i + 1])
    return bool(np.any((ways.edge[rows] == edge) & (np.abs(ways.begin[rows] - place) < SAME_M)))


def order(ways: Ways, joins: Bools, row: Ints, s: Floats, present: Bools, horizon: float, room: Floats) -> Order:
    """Turns at joins as signals give them: who has none before the join that stops it goes first, the nearest of these first.

    Of a train that passes a join more than once they are those of the first time.
    """
    edge, train, away = _approaching(ways, joins, row, s, present, horizon, room)
    first = np.unique(edge * len(row) + train, return_index=True)[1]  # each train's are there from near to far
    edge, train, away = edge[first], train[first], away[first]
    by_edge = np.lexsort((train, away, edge))
    return Order(edge[by_edge], train[by_edge], np.arange(len(edge)))


@njit(cache=True)
def _sighted(ways: Ways, at: Ints, row: Ints, s: Floats, present: Bools, horizon: Floats) -> tuple[Ints, Ints, Floats, Ints]:
    """Rows of ``Sighted``."""
    count = 0
    for again in range(2):
        if again:
            train, signal = np.empty(count, np.int64), np.empty(count, np.int64)
            room, found = np.empty(count), np.empty(count, np.int64)
        count = 0
        for i in range(len(row)):
            if not present[i]:
                continue
            for k in range(row[i] + 1, ways.first[i + 1]):
                if ways.begin[k] - s[i] > horizon[i]:
                    break
                if at[k] >= 0:
                    if again:
                        train[count], signal[count], room[count], found[count] = i, at[k], ways.begin[k] - s[i], k
                    count += 1
    return train, signal, room, found


@njit(cache=True)
def _approaching(
    ways: Ways, joins: Bools, row: Ints, s: Floats, present: Bools, horizon: float, room: Floats
) -> tuple[Ints, Ints, Floats]:
    """Joins that trains may go on to: edge, train, and how far that is [m]."""
    count = 0
    for again in range(2):
        if again:
            edge, train, away = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count)
        count = 0
        for i in range(len(row)):
            if not present[i]:
                continue
            for k in range(row[i] + 1, ways.first[i + 1]):
                ahead = ways.begin[k] - s[i]
                if ahead > horizon or ahead > room[i]:
                    break
                if joins[ways.edge[k]]:
                    if again:
                        edge[count], train[count], away[count] = ways.edge[k], i, ahead
                    count += 1
    return edge, train, away
