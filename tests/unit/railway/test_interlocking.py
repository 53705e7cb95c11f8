from __future__ import annotations

import json
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from trainctl.railway import along, bodies, interlocking, zones
from trainctl.railway.ways import ways as laid

BRAKING = 0.8  # m/s2
TOP = 30.0  # m/s
MARGIN = 5.0  # m


def railway(edges, links, twins=(), crossings=()):
    """``edges`` name: length; links, twins, crossings: pairs of names."""
    names = list(edges)
    number = {name: k for k, name in enumerate(names)}
    twin = np.full(len(names), -1)
    before, crossing = [[] for _ in names], [[] for _ in names]
    for a, b in twins:
        twin[number[a]], twin[number[b]] = number[b], number[a]
    for a, b in links:
        before[number[b]].append(number[a])
    for a, b in crossings:
        crossing[number[a]].append(number[b])
        crossing[number[b]].append(number[a])
    length = np.array([float(v) for v in edges.values()])
    return SimpleNamespace(
        length_m=length, before=before, twin=twin, crossing=crossing, number=number,
        ways=lambda paths: laid(paths, np.zeros(len(names)), length),
    )  # fmt: skip


class Yard:
    """Trains placed by hand: (way, edge, m on it, length)."""

    def __init__(self, net, trains, clearance=0.0):
        self.net, self.clearance = net, clearance
        self.paths = [[net.number[e] for e in path.split()] for path, _, _, _ in trains]
        self.length = np.array([float(t[3]) for t in trains])
        self.at = [(net.number[e], x) for _, e, x, _ in trains]
        self.state = interlocking.none()
        self.reach = np.full(len(trains), 100.0)
        self.present = np.ones(len(trains), bool)

    def now(self, **more):
        ways = self.net.ways(self.paths)
        row = np.array([ways.first[i] + self.paths[i].index(e) for i, (e, _) in enumerate(self.at)])
        s = ways.begin[row] + [x for _, x in self.at]
        shared = zones.of(ways, along.net(self.net))
        old, before = self.state, json.dumps(self.state)
        arrays = (row, s, self.length, self.present)
        self.state, ends, said = interlocking.request(shared, old, *arrays, self.reach, self.clearance, **more)
        assert json.dumps(old) == before  # left as it was
        self.state = json.loads(json.dumps(self.state))  # as a checkpoint keeps it
        return ends, said

    def put(self, i, edge, x):
        self.at[i] = (self.net.number[edge], x)


SINGLE = railway(
    {"a": 1000, "s": 2000, "b": 1000, "c": 1000, "S": 2000, "d": 1000},
    [("a", "s"), ("s", "b"), ("c", "S"), ("S", "d")],
    twins=[("s", "S")],
)


def test_single_track_goes_to_who_comes_first_and_to_the_other_when_its_rear_has_left():
    yard = Yard(SINGLE, [("a s b", "a", 950, 200), ("c S d", "c", 910, 200), ("c S d", "c", 500, 100)])
    ends, said = yard.now()
    assert ends.room.tolist() == [np.inf, 90.0, np.inf]
    assert (ends.by[1], ends.zone[1]) == (0, SINGLE.number["S"])
    assert [(d.train, d.granted, d.by) for d in said] == [(0, True, -1), (1, False, 0)]
    yard.put(0, "b", 199.0)
    ends, said = yard.now()
    assert ends.room[1] == 90.0
    assert said == []
    yard.put(0, "b", 200.0)
    ends, said = yard.now()
    assert ends.room[1] == np.inf
    assert [(d.train, d.granted) for d in said] == [(1, True)]


def test_trains_of_one_direction_follow_but_not_past_one_who_waits_at_the_other_end():
    yard = Yard(SINGLE, [("a s b", "s", 500, 100), ("a s b", "a", 950, 100), ("c S d", "c", 100, 100), ("a s b", "a", 300, 100)])
    assert yard.now()[0].room.tolist() == [np.inf] * 4
    yard.put(2, "c", 950)
    assert yard.now()[0].by.tolist() == [-1, -1, 0, -1]
    yard.put(0, "b", 500)
    yard.put(1, "s", 900)
    yard.put(3, "a", 950)
    ends, _ = yard.now()
    assert ends.by.tolist() == [-1, -1, 1, 2]


def test_a_claim_is_kept_when_the_reach_shrinks_and_lost_when_the_way_leads_elsewhere():
    net = railway(
        {"a": 1000, "s": 2000, "b": 1000, "c": 1000, "S": 2000, "d": 1000, "e": 500},
        [("a", "s"), ("s", "b"), ("c", "S"), ("S", "d"), ("a", "e")], twins=[("s", "S")],
    )  # fmt: skip
    yard = Yard(net, [("a s b", "a", 920, 200), ("c S d", "c", 500, 200), ("c S d", "c", 0, 200), ("a s b", "a", 0, 100)])
    yard.now()
    yard.put(1, "c", 950)
    yard.reach[0] = 10.0
    assert yard.now()[0].by.tolist() == [-1, 0, -1, -1]
    yard.paths[0] = [net.number[e] for e in ("a", "e")]
    ends, said = yard.now()
    assert ends.by.tolist() == [-1, -1, -1, -1]
    assert [(d.train, d.granted) for d in said] == [(1, True)]


CROSS = railway({"a": 500, "x": 20, "b": 500, "c": 500, "y": 20, "d": 500}, [("a", "x"), ("x", "b"), ("c", "y"), ("y", "d")],
                crossings=[("x", "y")])  # fmt: skip


def test_a_crossing_is_kept_clear_from_the_first_claim_to_the_rear():
    yard = Yard(CROSS, [("a x b", "a", 450, 100), ("c y d", "c", 460, 50)])
    ends, _ = yard.now()
    assert ends.room.tolist() == [50.0, np.inf]  # both are new: the nearer one goes
    yard.put(1, "d", 49.0)
    assert yard.now()[0].room[0] == 50.0
    yard.put(1, "d", 50.0)
    assert yard.now()[0].room[0] == np.inf


MERGE = railway({"a": 1000, "b": 1000, "m": 1000}, [("a", "m"), ("b", "m")])


def test_turns_at_a_join_stay_and_those_of_one_track_keep_the_order_they_stand_in():
    trains = [("a m", "a", 800, 100), ("b m", "b", 700, 100), ("a m", "a", 890, 50), ("b m", "b", 600, 50)]
    yard = Yard(MERGE, trains)
    yard.reach = np.array([250.0, 310.0, 50.0, 10.0])
    ends, said = yard.now()
    assert np.isinf(ends.room).all()  # turns hold nobody
    assert [(d.train, d.granted, d.by) for d in said] == [(0, True, -1), (1, False, 0)]
    yard.put(2, "a", 960)  # stands before 0 but requests later
    yard.put(1, "b", 950)  # overtakes 0 by distance, but not its turn
    yard.now()
    m = str(MERGE.number["m"])
    assert yard.state["joins"] == {m: [2, 0, 1]}
    ways = MERGE.ways(yard.paths)
    row, s = ways.first[:-1], np.array([x for _, x in yard.at])
    here = along.places(ways, along.net(MERGE), row, s, yard.length, yard.present, 2000.0, interlocking.order(yard.state))
    found = along.ahead(here)
    assert found.train.tolist() == [2, 0, -1, 1]
    assert found.spacing.tolist() == [160.0, -150.0, np.inf, 350.0]
    yard.put(2, "m", 49.0)
    yard.now()
    assert yard.state["joins"] == {m: [2, 0, 1]}
    yard.put(2, "m", 50.0)
    yard.now()
    assert yard.state["joins"] == {m: [0, 1]}


def test_a_train_that_wants_to_enter_the_net_in_a_stretch_waits_for_it():
    yard = Yard(SINGLE, [("c S d", "S", 500, 100), ("s b", "s", 100, 100)])
    yard.present[1] = False
    entering = np.array([False, True])
    ends, said = yard.now(entering=entering)
    assert (ends.room[1], ends.by[1]) == (0.0, 0)
    yard.put(0, "d", 100)
    ends, said = yard.now(entering=entering)
    assert ends.room[1] == np.inf
    assert said[-1].train == 1


def test_a_train_that_waits_to_enter_keeps_its_turn_at_the_join_and_who_comes_later_waits():
    yard = Yard(MERGE, [("a m", "a", 200, 100), ("b m", "b", 800, 100), ("a m", "a", 700, 100)], clearance=10.0)
    yard.present[1], entering = False, np.array([False, True, False])
    yard.reach = np.array([400.0, 300.0, 400.0])
    ends, _ = yard.now(entering=entering)
    assert ends.room.tolist() == [np.inf, np.inf, np.inf]  # the third could perhaps not wait any more, the first is far
    yard.put(0, "a", 650.0)
    yard.put(2, "m", 300.0)
    ends, said = yard.now(entering=entering)
    assert (ends.room[0], ends.by[0], ends.zone[0]) == (350.0, 1, MERGE.number["m"])
    assert [(d.train, d.by, d.join) for d in said] == [(0, 1, True)]
    # Unless one that stands keeps it out, which perhaps waits for it.
    assert np.isinf(yard.now(entering=entering, keeps=np.zeros(3, bool))[0].room[0])
    yard.present[1] = True
    assert np.isinf(yard.now()[0].room).all()  # it has come: the one behind follows


def test_who_is_to_enter_in_the_middle_of_a_line_gets_its_gap():
    net = railway({"a": 1000, "b": 1000}, [("a", "b")])
    yard = Yard(net, [("a b", "a", 500, 100), ("b", "b", 100, 100), ("a b", "a", 100, 100)])
    yard.present[1], entering = False, np.array([False, True, False])
    yard.reach = np.array([600.0, 100.0, 600.0])
    assert np.isinf(yard.now(entering=entering)[0].room).all()
    yard.put(0, "b", 300)
    yard.put(2, "a", 500)
    ends, _ = yard.now(entering=entering)
    assert (ends.room[2], ends.by[2]) == (500.0, 1) and np.isinf(ends.room[:2]).all()


def test_nobody_enters_where_another_one_is_and_it_bars_nobody():
    yard = Yard(SINGLE, [("a s b", "a", 950, 200), ("a s b", "a", 900, 100), ("c S d", "c", 950, 100)], clearance=10.0)
    yard.present[1], entering = False, np.array([False, True, False])
    yard.reach[0] = 10.0
    ends, _ = yard.now(entering=entering)
    assert (ends.room[1], ends.by[1]) == (0.0, 0) and np.isinf(ends.room[2])


def test_a_request_ends_at_the_own_stop_and_what_lies_ahead_of_a_stand_is_given_back():
    trains = [("a s b", "a", 700, 200), ("c S d", "c", 700, 100)]
    for place, capped in ((980.0, False), (900.0, True)):
        yard = Yard(SINGLE, trains, clearance=50.0)
        yard.reach[:] = 400.0
        stop = np.array([place, np.inf])
        ends, _ = yard.now(stop=stop)
        assert ends.room.tolist() == ([300.0, np.inf] if capped else [np.inf, 300.0])  # what it did not request is not its own
        yard.put(0, "a", place)
        ends, _ = yard.now(stop=stop, stands=np.array([True, False]))
        assert ends.room.tolist() == [1000.0 - place, np.inf]
        ends, _ = yard.now()
        assert ends.by.tolist() == [1, -1]  # now it comes in its turn
        yard.put(1, "d", 200)
        assert np.isinf(yard.now()[0].room).all()


def test_trains_that_stand_at_once_give_back_one_after_another():
    net = railway(
        {"a": 900, "e": 900, "m": 1000, "s": 900, "b": 900, "c": 900, "S": 900, "M": 1000, "d": 900},
        [("a", "m"), ("e", "m"), ("m", "s"), ("s", "b"), ("c", "S"), ("S", "M"), ("M", "d")], twins=[("s", "S"), ("m", "M")],
    )  # fmt: skip
    yard = Yard(net, [("a m s b", "a", 880, 100), ("e m s b", "e", 870, 100), ("c S M d", "c", 800, 100)], clearance=10.0)
    yard.reach[:2] = 300.0
    ends, _ = yard.now()
    assert np.isinf(ends.room[:2]).all() and yard.state["joins"] == {str(net.number["m"]): [0, 1]}
    yard.reach[2] = 300.0
    ends, _ = yard.now(stop=np.array([880.0, 870.0, np.inf]), stands=np.array([True, True, False]))
    assert np.isinf(ends.room[2]) and yard.state["joins"] == {}


def test_a_join_beyond_the_own_stop_is_not_requested():
    yard = Yard(MERGE, [("a m", "a", 700, 100), ("b m", "b", 600, 100)])
    yard.reach[:] = 500.0
    yard.now(stop=np.array([900.0, np.inf]))
    assert yard.state["joins"] == {str(MERGE.number["m"]): [1]}


def test_a_stand_keeps_what_nobody_could_get_out_without():
    """A train longer than its platform: its tail shuts the single track behind, so it keeps the one ahead."""
    net = railway(
        {"a": 1000, "s": 900, "p": 300, "t": 900, "b": 1000, "c": 1000, "T": 900, "q": 400, "S": 900, "d": 1000},
        [("a", "s"), ("s", "p"), ("p", "t"), ("t", "b"), ("c", "T"), ("T", "q"), ("q", "S"), ("S", "d")],
        twins=[("s", "S"), ("t", "T")],
    )  # fmt: skip
    yard = Yard(net, [("a s p t b", "p", 290, 500), ("c T q S d", "c", 950, 100)])
    ends, _ = yard.now(stop=np.array([2190.0, np.inf]), stands=np.array([True, False]))
    assert np.isinf(ends.room[0]) or ends.by[0] != 1
    yard.length[0] = 200.0
    ends, _ = yard.now(stop=np.array([2190.0, np.inf]), stands=np.array([True, False]))
    assert np.isinf(ends.room[1])  # a short one gives way


LINE = railway(
    {
        "w1": 1500, "w2": 1700, "j": 700, "x": 20, "r": 300, "s": 900, "t": 800, "A": 500, "u": 1200, "o": 900,
        "l": 1500, "U": 1200, "B": 450, "T": 800, "S": 900, "q": 900, "c": 1500, "y": 20, "d": 900,
    },
    [("w1", "j"), ("w2", "j"), ("j", "x"), ("x", "r"), ("r", "s"), ("s", "t"), ("t", "A"), ("A", "u"), ("u", "o"),
     ("l", "U"), ("U", "B"), ("B", "T"), ("T", "S"), ("S", "q"), ("c", "y"), ("y", "d")],
    twins=[("s", "S"), ("t", "T"), ("u", "U")], crossings=[("x", "y")],
)  # fmt: skip
LINE_WAYS = ("w1 j x r s t A u o", "w2 j x r s t A u o", "l U B T S q", "c y d")

#: Three single tracks with two passing loops, whose main track (m, M and n, N) trains of both directions use.
LOOPS = railway(
    {
        "w": 1200, "s": 900, "m": 600, "a": 640, "t": 1300, "n": 500, "b": 540, "u": 800, "o": 900,
        "l": 1200, "U": 800, "N": 500, "c": 540, "T": 1300, "M": 600, "d": 640, "S": 900, "q": 900,
    },
    [("w", "s"), ("s", "m"), ("s", "a"), ("m", "t"), ("a", "t"), ("t", "n"), ("t", "b"), ("n", "u"), ("b", "u"), ("u", "o"),
     ("l", "U"), ("U", "N"), ("U", "c"), ("N", "T"), ("c", "T"), ("T", "M"), ("T", "d"), ("M", "S"), ("d", "S"), ("S", "q")],
    twins=[("s", "S"), ("m", "M"), ("t", "T"), ("n", "N"), ("u", "U")],
)  # fmt: skip
LOOPS_WAYS = ("w s a t b u o", "w s m t b u o", "w s a t n u o", "l U c T d S q", "l U N T d S q", "l U c T M S q")


def occupied(ways, row, s, length, i):
    k = row[i]
    while True:
        yield int(ways.edge[k]), s[i] - ways.begin[k]
        if k == ways.first[i] or ways.begin[k] <= s[i] - length[i]:
            return
        k -= 1


def drive(net_of, routes, seed, n, limit=9000):
    """Trains that always can stop before what stands in their way and before what is not theirs; returns when all have left."""
    rng = np.random.default_rng(seed)
    kind = rng.integers(0, len(routes), n)
    ways = net_of.ways([[net_of.number[e] for e in routes[k].split()] for k in kind])
    net = along.net(net_of)
    shared = zones.of(ways, net)
    length = rng.uniform(40.0, 480.0, n)
    departs = np.sort(rng.uniform(0.0, 900.0, n))
    acceleration, top = rng.uniform(0.2, 0.8, n), rng.uniform(10.0, TOP, n)
    end = ways.begin[ways.first[1:] - 1] + net_of.length_m[ways.edge[ways.first[1:] - 1]]
    row, s, v = ways.first[:-1].copy(), np.zeros(n), np.zeros(n)
    present, left = np.zeros(n, bool), np.zeros(n, bool)
    state = interlocking.none()
    turns, passed = set(), {}
    for step in range(limit):
        for i in np.flatnonzero(~present & ~left & (departs <= step)).tolist():
            rest = [s[j] - length[j] for j in np.flatnonzero(present).tolist() if ways.edge[row[j]] == ways.edge[ways.first[i]]]
            if min(rest, default=np.inf) > length[i] + 20.0:
                present[i], s[i] = True, length[i]
        reach = v**2 / (2 * BRAKING) + 3 * v + 2 * MARGIN
        state, ends, _ = interlocking.request(shared, state, row, s, length, present, reach, 2 * MARGIN)
        here = along.places(ways, net, row, s, length, present, 3000.0, interlocking.order(state))
        room = np.minimum(bodies.obstacles(here, virtual=False).room, ends.room) - MARGIN
        wanted = np.minimum(v + acceleration, top)
        stops = -BRAKING + np.sqrt(BRAKING**2 + 2 * BRAKING * np.maximum(room, 0.0))  # v^2 / 2b + v <= room
        v = np.where(present, np.minimum(wanted, stops), 0.0)
        s = s + v
        for i in np.flatnonzero(present).tolist():
            while row[i] + 1 < ways.first[i + 1] and ways.begin[row[i] + 1] <= s[i]:
                row[i] += 1
                passed.setdefault(int(ways.edge[row[i]]), []).append(i)
        gone = present & (s >= end)
        present &= ~gone
        left |= gone
        on = {}
        for i in np.flatnonzero(present).tolist():
            for e, depth in occupied(ways, row, s, length, i):
                on.setdefault(e, []).append((depth, depth - length[i], i))
        for e, trains in on.items():
            trains.sort()
            assert all(a[0] < b[1] for a, b in pairwise(trains)), ("overlap", seed, step, e, trains)
            foes = [net_of.twin[e], *net_of.crossing[e]]
            assert not any(f in on for f in foes), ("foe", seed, step, e)
        turns |= {(int(e), a, b) for e, queue in state["joins"].items() for a, b in pairwise(queue)}
        if left.all():
            assert all(passed[e].index(a) < passed[e].index(b) for e, a, b in turns)
            return step
    raise AssertionError(f"seed {seed}: {np.flatnonzero(~left).tolist()} never arrive: {s}, {ways.edge[row]}, {state}, {ends}")


@pytest.mark.parametrize(("seed", "n"), [(0, 10), (1, 10), (2, 14), (1001, 18)])
def test_with_a_join_a_crossing_and_a_passing_loop_nobody_meets_and_everybody_arrives(seed, n):
    drive(LINE, LINE_WAYS, seed, n)


@pytest.mark.parametrize("seed", range(3))
def test_with_two_passing_loops_nobody_meets_and_everybody_arrives(seed):
    drive(LOOPS, LOOPS_WAYS, seed, 10)


@pytest.mark.campaign
@pytest.mark.parametrize(("net", "routes"), [(LINE, LINE_WAYS), (LOOPS, LOOPS_WAYS)], ids=["line", "loops"])
def test_campaign_two_hundred_days(net, routes):
    for seed in range(200):
        drive(net, routes, 1000 + seed, 18)


@pytest.mark.parametrize("kind", range(len(LINE_WAYS)))
def test_alone_nobody_is_held(kind):
    path = LINE_WAYS[kind].split()
    others = [(way, way.split()[0], 0, 50) for way in LINE_WAYS]  # their ways make the stretches
    yard = Yard(LINE, [*others, (LINE_WAYS[kind], path[0], 0, 480)])
    yard.present[:-1] = False
    for edge in path:
        for part in (0.0, 0.5, 1.0):
            yard.put(len(LINE_WAYS), edge, part * LINE.length_m[LINE.number[edge]])
            ends, said = yard.now()
            assert np.isinf(ends.room).all()
            assert all(d.granted for d in said)
