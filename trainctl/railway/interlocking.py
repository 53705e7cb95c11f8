"""First come, first served where ways meet: who goes first at joins, and who may enter what only one can use.

Two kinds of places. A *join* is an edge that two or more edges lead into: the trains get a turn there, none is held, and the
turns go to ``along.places``. A *stretch* is a longest run of edges on a train's way that others use as well, on the twin (single
track) or across: it is exclusive against those, while trains that go the same way may follow each other. A train requests what
lies within its reach, and keeps its request until its rear has left or its way no longer leads there. What it has passed is free
at once.

Deadlock: a train is let into a stretch only if behind it, before the next stretch, it finds room to stand with all who will stand
there, or else together with the next one; and only if all trains can still get out then, see ``deadlock``. While it waits for that,
later trains may overtake it; this is the only exception to first come, first served. None enters the net that would overtake so.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, TypedDict

import numpy as np

from trainctl.railway import deadlock, outlook
from trainctl.railway.along import Order
from trainctl.railway.zones import Index, Ordered, Trains, Zones, coming, in_place_of, near
from trainctl.signals import Bools, Floats, Ints


class State(TypedDict):
    """All requests, in the plain types of JSON."""

    joins: dict[str, list[int]]  # edge number: trains in the order of their turns
    stretches: list[tuple[int, int, bool]]  # train, edge it enters over, granted; in the order of requesting
    until: dict[str, float]  # train number: position up to which it has requested [m]


class EndOfAuthority(NamedTuple):
    """Where the movement authority of each train ends."""

    room: Floats  # (n,) m from the front to a stretch it must not enter yet; inf: free
    zone: Ints  # (n,) edge over which it would enter, -1
    by: Ints  # (n,) train it waits for, -1


class Decision(NamedTuple):
    """One request decided: granted, or not because of train ``by``. At a join, not granted means after ``by``."""

    train: int
    zone: int
    granted: bool
    by: int  # -1: none
    join: bool  # whether ``zone``, an edge, is a join or the beginning of a stretch


def none() -> State:
    """No requests: the state to begin with."""
    return State(joins={}, stretches=[], until={})


def order(state: State) -> Order:
    """Turns at joins as ``along.places`` takes them."""
    turns = [(int(edge), train, turn) for edge, queue in state["joins"].items() for turn, train in enumerate(queue)]
    return Order(*np.array(turns, np.int64).reshape(-1, 3).T.copy())


def request(
    zones: Zones, state: State, row: Ints, s: Floats, length: Floats, present: Bools, reach: Floats,
    clearance: float = 0.0, entering: Bools | None = None, stop: Floats | None = None, stands: Bools | None = None,
    ordered: Sequence[Ordered] = (), keeps: Bools | None = None, back: Mapping[int, Sequence[int]] = deadlock.NOBODY,
) -> tuple[State, EndOfAuthority, list[Decision]]:  # fmt: skip
    """Requests of all trains at one instant.

    Parameters
    ----------
    zones : Zones
        From ``zones.of``, of the ways the trains have now.
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
    stop : ndarray, shape (n,), optional
        Where each train will stand next by its own plan [m], inf if nowhere: what lies well beyond it does not request.
    stands : ndarray, shape (n,), optional
        Trains that stand there and are not to go on yet.
    ordered : sequence of tuple
        Trains that must leave a place to another one first.
    keeps : ndarray, shape (n,), optional
        Of those that ask to enter, who keeps its place at joins and for stretches; default all.
    back : mapping, optional
        Of trains that turn at the end of their ways: the edges they run over then.

    Returns
    -------
    State
        Requests now.
    EndOfAuthority
        How far each train may go.
    list of Decision
        Requests that were made or granted just now, in order.

    Notes
    -----
    A train whose front is in a stretch has it, as a fact. Turns at joins within a stretch come with it, and none beyond a stretch
    that is not granted: else one who waits for the stretch could be first where one who has it must pass. Trains on the way to one
    edge keep the order they stand in, or, where they come over different tracks, the order of their turns at the join.

    A request ends at the train's own stop: who is to stand ``clearance`` or more before a stretch does not request it, and who
    stands gives back what lies ahead of it, if all can still get out then.

    A train that waits for nothing but a gap to enter keeps its turn at joins, and where it is to enter: whoever comes later over
    another track waits there until it has come.
    """
    nobody = np.zeros(len(row), bool)
    outside, stands = nobody if entering is None else entering, nobody if stands is None else stands
    begin, edge = zones.ways.begin, zones.ways.edge
    until = _until(zones, state, row, s, reach, clearance, stop, stands)
    on, joining = present | outside, zones.net.joins.copy()
    joining[edge[zones.ways.first[:-1][outside]]] = True
    at = near(zones, joining, row, s, length, on, outside, until)
    after = zones.following[row]
    nearing = present & (after >= 0) & (begin[after] - s < reach)
    room, zone, by = np.full(len(row), np.inf), np.full(len(row), -1, np.int64), np.full(len(row), -1, np.int64)
    if not (len(at[0]) or len(ordered) or outside.any() or nearing.any() or state["joins"] or state["stretches"]):
        return State(joins={}, stretches=[], until={}), EndOfAuthority(room, zone, by), []  # nobody is near anything to request
    joins: dict[tuple[int, int], int] = {}
    stretches: dict[tuple[int, int], int] = {}
    for i, k, is_join in zip(*(a.tolist() for a in at), strict=True):
        (joins if is_join else stretches).setdefault((i, int(edge[k])), k)
    trains = Trains(zones, row, s, length, *coming(zones, row, present))
    shut: dict[int, tuple[int, int]] = {}  # first row that a train must leave to another one, and that
    for i, k, first, _ in ordered:
        shut[i] = min((k, first), shut.get(i, (k, first)))
    for i, (k, first) in list(shut.items()):  # those behind it on its track wait with it
        for (j, e), m in joins.items():
            if (
                e == edge[k]
                and j not in shut
                and trains.track(j, m) == trains.track(i, k)
                and trains.distance(j, m) > begin[k] - s[i]
            ):
                shut[j] = (m, first)
    joins = {(i, e): k for (i, e), k in joins.items() if i not in shut or k < shut[i][0]}

    queues = {int(e): [i for i in queue if (i, int(e)) in joins] for e, queue in state["joins"].items()}
    leave = {(i, e): g for i, e, g in state["stretches"]}
    said = _turns(trains, queues, joins, _open(_inside(joins, outside), stretches, leave), outside)
    order, granted = _queue(trains, state["stretches"], stretches, queues)
    order = _let_by(trains, order, stretches, np.flatnonzero(outside).tolist(), present, clearance)
    in_place = in_place_of(trains, present, np.flatnonzero(outside).tolist(), clearance)
    granted |= {key: False for key in order if outside[key[0]]}  # it has its place in the queue only
    own = _by_train(stretches), _by_train(joins)
    for i in np.flatnonzero(stands & present).tolist():
        if _gives_back(trains, present, granted, own[0].get(i, ()), i, clearance, queues, joins, ordered, back):
            until[i] = s[i]
            for passed, found, keys in ((stretches, granted, own[0]), (joins, joins, own[1])):
                for key in [key for key in keys.get(i, ()) if passed[key] > row[i]]:
                    found.pop(key, None)
                    passed.pop(key, None)
            if i in own[1]:
                queues = {e: [j for j in queue if (j, e) in joins] for e, queue in queues.items()}
    order = [key for key in order if key in granted]
    if keeps is not None:  # who has lost its place asks after all others, or who keeps it out would wait for it
        order.sort(key=lambda key: bool(outside[key[0]] and not keeps[key[0]]))
    new = granted.keys() - {(i, e) for i, e, _ in state["stretches"]}
    given, waiting, stuck = Index(zones, trains), Index(zones, trains), Index(zones, trains)
    for key in order:
        if granted[key] or (s[key[0]] > begin[stretches[key]] and not outside[key[0]]):
            if not granted[key]:
                said.append(Decision(*key, True, -1, False))
            granted[key] = True
            given.add(key[0], [stretches[key]])
    leading: dict[int, set[int]] = {}
    for key in order:
        if granted[key]:
            _lead(leading, zones, key[0], stretches[key])
    behind: dict[int, int] = {}
    there = present.copy()  # and whoever is let in
    here: deadlock.Standing | None = None  # where trains on the net may come to stand, as long as nothing more is granted
    for key in list(order):
        i, e = key
        k = stretches[key]
        if granted[key]:
            continue
        rest: list[int] = []
        blocker = behind.get(e, -1)
        if room[i] < np.inf:  # it does not even have the one before this one
            blocker = int(by[i])
        elif i in in_place:
            blocker = in_place[i]
        elif i in shut and shut[i][0] <= zones.ends[k]:
            blocker = shut[i][1]
        elif blocker < 0:
            rest, in_front = _needed_too(trains, i, k, clearance, leading, granted, queues)
            later = given.blocker(i, rest)
            later = in_front if later < 0 else later
            blocker = max(given.blocker(i, [k]), waiting.blocker(i, [k]), key=lambda j: j >= 0)
            if blocker < 0:
                blocker = later if later >= 0 else waiting.blocker(i, rest)
            if blocker >= 0 and later < 0:
                if here is None or not there[i]:
                    here = outlook.standing(trains, there, granted, i, (), clearance, queues, joins, ordered, back)
                stuck_itself = any(True for _ in deadlock.needs(here, blocker))
                if not (stuck_itself or outlook.stood_on(here, zones.ends, i, [k, *rest])):
                    waiting.add(i, [k, *rest])
                here = here if there[i] else None
            if blocker < 0 and outside[i]:  # no train comes in before one that waits for the same, whatever for
                blocker = stuck.blocker(i, [k, *rest])
            if blocker < 0 and i in shut and rest and shut[i][0] <= zones.ends[rest[-1]]:
                blocker = shut[i][1]
            if blocker < 0:
                with_it = outlook.standing(trains, there, granted, i, [k, *rest], clearance, queues, joins, ordered, back)
                blocker = max(deadlock.ahead(with_it, i, k), deadlock.in_a_circle(with_it, i), key=lambda j: j >= 0)
        if blocker >= 0:
            stuck.add(i, [k, *rest])
            behind.setdefault(e, i)
            if key in new:
                said.append(Decision(i, e, False, blocker, False))
            if begin[k] - s[i] < room[i]:
                room[i], zone[i], by[i] = max(begin[k] - s[i], 0.0), e, blocker
            continue
        there[i], here = True, None
        given.add(i, [k, *rest])
        for r in [k, *rest]:
            one = (i, int(edge[r]))
            if one not in granted:
                order.append(one)
                stretches[one] = r
            if not leave.get(one, False):
                said.append(Decision(*one, True, -1, False))
            granted[one] = True
            until[i] = max(until[i], begin[r])
            _lead(leading, zones, i, r)
        # With it go the turns up to its end, at once: who is let in next comes after it.
        turns = {(i, int(edge[r])): r for r in outlook.joining(trains, i, k, int(zones.ends[rest[-1] if rest else k]))}
        joins |= turns
        said += _turns(trains, queues, joins, turns, outside)
    for i in np.flatnonzero(outside & (room > 0.0)).tolist():  # perhaps to stand before what it has not
        blocker = in_place.get(i, -1)
        if blocker < 0:
            here = outlook.standing(trains, there, granted, i, (), clearance, queues, joins, ordered, back)
            blocker = deadlock.in_a_circle(here, i)
        if blocker >= 0:
            room[i], zone[i], by[i] = 0.0, edge[row[i]], blocker
        there[i] = blocker < 0  # the next are judged without it
    for (i, e), k in stretches.items():
        if granted[i, e]:
            until[i] = max(until[i], begin[zones.ends[k]])
            for r in outlook.joining(trains, i, k, int(zones.ends[k])):
                joins.setdefault((i, int(edge[r])), r)
    for i, (k, first) in shut.items():
        if begin[k] - s[i] < min(reach[i], room[i]) and (present[i] or outside[i]):
            room[i], zone[i], by[i] = max(begin[k] - s[i], 0.0), edge[k], first
    barred = outside & (room <= 0.0)
    queues = {e: [i for i in queue if not barred[i]] for e, queue in queues.items()}
    said += _turns(trains, queues, joins, _open(_inside(joins, barred), stretches, granted), outside)
    _keep_places(trains, queues, joins, outside, outside if keeps is None else keeps, room, zone, by)
    for i in np.flatnonzero(nearing).tolist():  # not requested: it stands before
        k = outlook.limit(trains, granted, i)
        if k >= 0 and (i, int(edge[k])) not in granted and begin[k] - s[i] < min(reach[i], room[i]):
            room[i], zone[i], by[i] = max(begin[k] - s[i], 0.0), edge[k], -1
    now = State(
        joins={str(e): queue for e, queue in queues.items() if queue},
        stretches=[(i, e, granted[i, e]) for i, e in order],
        until={str(i): float(until[i]) for i in sorted({i for i, _ in (*joins, *stretches)})},
    )
    return now, EndOfAuthority(room, zone, by), said


def _until(
    zones: Zones, state: State, row: Ints, s: Floats, reach: Floats, clearance: float, stop: Floats | None, stands: Bools
) -> Floats:
    """Position up to which every train requests [m]: its reach, or its own stop, where there is room before what follows."""
    begin, begins = zones.ways.begin, zones.begins
    until: Floats = np.where(stands, s, s + reach)
    if stop is None:
        stop = np.full(len(s), np.inf)
    for i in np.flatnonzero((stop > s - outlook.AT_M) & (stop < until)).tolist():
        k = int(row[i])  # of the first stretch that begins at the stop or beyond
        while k < zones.ways.first[i + 1] and (begins[k] != k or begin[k] < stop[i] - outlook.AT_M):
            k += 1
        if k == zones.ways.first[i + 1] or begin[k] - stop[i] >= clearance:
            until[i] = max(stop[i] - outlook.AT_M, s[i])
    for train, position in state["until"].items():
        until[int(train)] = max(until[int(train)], position)
    return until


def _by_train(requests: Iterable[tuple[int, int]]) -> dict[int, list[tuple[int, int]]]:
    """Requests, trains with edges, by their trains."""
    found: dict[int, list[tuple[int, int]]] = {}
    for key in requests:
        found.setdefault(key[0], []).append(key)
    return found


def _gives_back(
    trains: Trains, present: Bools, granted: dict[tuple[int, int], bool], own: Iterable[tuple[int, int]], i: int, clearance: float,
    queues: dict[int, list[int]], joins: dict[tuple[int, int], int], ordered: Sequence[Ordered],
    back: Mapping[int, Sequence[int]],
) -> bool:  # fmt: skip
    """Whether all can still get out if ``i``, whose requests of stretches are its ``own``, does without what lies ahead of it."""
    if not any(granted.get(key, False) for key in own):
        return True
    ways = trains.zones.ways
    ahead = {int(e) for e in ways.edge[trains.row[i] + 1 : ways.first[i + 1]]}
    without = {key: g and not (key[0] == i and key[1] in ahead) for key, g in granted.items()}
    if without == granted:
        return True
    others = {e: [j for j in queue if j != i or e not in ahead] for e, queue in queues.items()}
    here = outlook.standing(trains, present, without, i, (), clearance, others, joins, ordered, back)
    return deadlock.in_a_circle(here, i) < 0


def _inside(joins: dict[tuple[int, int], int], without: Bools) -> dict[tuple[int, int], int]:
    """Those joins that are not of trains ``without``."""
    return {(i, e): k for (i, e), k in joins.items() if not without[i]}


def _keep_places(
    trains: Trains, queues: dict[int, list[int]], joins: dict[tuple[int, int], int], outside: Bools, keeps: Bools,
    room: Floats, zone: Ints, by: Ints,
) -> None:  # fmt: skip
    """Hold trains before the joins at which one that is to enter goes first."""
    for e, queue in queues.items():
        first: list[int] = []  # of those that are to enter
        for i in queue:
            k = joins[i, e]
            away = trains.distance(i, k)
            if outside[i]:
                first += [i] if keeps[i] else []
            elif 0.0 <= away < room[i]:
                before = [j for j in first if trains.track(j, joins[j, e]) != trains.track(i, k)]
                if before:
                    room[i], zone[i], by[i] = away, e, before[0]


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
    trains: Trains, queues: dict[int, list[int]], near: dict[tuple[int, int], int], new: dict[tuple[int, int], int],
    outside: Bools,
) -> list[Decision]:  # fmt: skip
    """Put new trains into the queues at joins."""
    said = []
    # Who is to enter comes after those that perhaps could not wait for it any more.
    for (i, e), k in sorted(new.items(), key=lambda item: (outside[item[0][0]], trains.distance(item[0][0], item[1]), item[0])):
        queue = queues.setdefault(e, [])
        if i in queue:
            continue
        turn = outlook.turn_in(trains, queue, near, i, k, queues)
        queue.insert(turn, i)
        others = [j for j in queue[:turn] if trains.track(j, near[j, e]) != trains.track(i, k)]
        said.append(Decision(i, e, not others, others[-1] if others else -1, True))
    return said


def _queue(
    trains: Trains, before: Iterable[tuple[int, int, bool]], near: dict[tuple[int, int], int], queues: dict[int, list[int]]
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


def _let_by(
    trains: Trains, order: list[tuple[int, int]], near: dict[tuple[int, int], int], outside: list[int], present: Bools,
    clearance: float,
) -> list[tuple[int, int]]:  # fmt: skip
    """The order with who is ``outside`` behind those on its track that are not behind its place: it waits until they are by."""
    for i, e in [key for key in order if key[0] in outside]:
        k, rest = near[i, e], [key for key in order if key != (i, e)]
        rear = trains.distance(i, k) + trains.length[i] + clearance
        there = [
            at for at, (j, f) in enumerate(rest)
            if f == e and present[j] and trains.track(j, near[j, e]) == trains.track(i, k) and trains.distance(j, near[j, e]) < rear
        ]  # fmt: skip
        if there and there[-1] >= order.index((i, e)):
            order = [*rest[: there[-1] + 1], (i, e), *rest[there[-1] + 1 :]]
    return order


def _lead(leading: dict[int, set[int]], zones: Zones, i: int, k: int) -> None:
    """Note that train ``i`` was let into the stretch at row k, under the edge over which it enters the one after it."""
    after = zones.following[k]
    if after >= 0:
        leading.setdefault(int(zones.ways.edge[after]), set()).add(i)


def _needed_too(
    trains: Trains, i: int, k: int, clearance: float, leading: dict[int, set[int]], granted: dict[tuple[int, int], bool],
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
