"""How far trains may go before rail signals, and what is told of them: with a signal box that shows what the test says."""

from __future__ import annotations

import nets
import numpy as np
import pytest
from staged import prepared, started

from trainctl.railway import supervisor
from trainctl.railway.aspects import SETTLES, STANDS_BEFORE_M


class Box:
    """Signals that are green by number, and a train that is in the way of those that are red."""

    def __init__(self, by=-1):
        self.shown, self.by, self.asked = set(), by, []

    def green(self, signals):
        self.asked.append(signals.tolist())
        return np.array([int(s) in self.shown for s in signals], bool)

    def blocker(self, signal):
        return self.by

    def speeds(self):
        return np.full(2, np.nan)


class Line:
    """Two trains one after the other before the first signal of a single track that is obeyed."""

    def __init__(self, folder):
        nets.single_track(folder, nets.train("a", nets.UP, 0) + nets.train("b", nets.UP, 60), signals="1234")
        p = prepared(folder, "robust_constrained", traffic={"cooperate": [], "signals": "obey"})
        self.loop, self.told = started(p)
        self.told.clear()
        self.ways, self.box = self.loop.world.ways, Box()
        self.state, self.traffic = self.loop.signals.initial(), self.loop.state.traffic
        self.seen = self.loop.world.measure()._replace(present=np.ones(2, bool))
        self.first = next(k for k, s in enumerate(p.roster.signals) if (s.edge, s.onward) == ("left", "up1"))

    def step(self, *rooms, speed=20.0, standing=(False, False), **traffic):
        """What is said of trains that have so much way to the first signal."""
        begin = self.ways.start
        at = self.signal_at()
        position = np.array([at - r for r in rooms])
        assert (position > begin).all()
        rows = np.array([int(np.searchsorted(self.ways.begin[a:b], x, side="right")) - 1 + a for a, b, x in self.spans(position)])
        seen = self.seen._replace(position=position, row=rows, edge=self.ways.edge[rows])
        going = self.traffic._replace(came=np.ones(2, bool), stands_until=np.where(standing, 60.0, np.nan))._replace(**traffic)
        self.state, found = self.loop.signals.step(7.0, self.ways, seen, np.full(2, speed), going, self.box, self.state)
        return found

    def spans(self, position):
        return zip(self.ways.first[:-1].tolist(), self.ways.first[1:].tolist(), position, strict=True)

    def signal_at(self):
        """Where the first signal stands on the way of a train."""
        table = self.loop.signals._table(self.ways)
        return float(self.ways.begin[int(np.flatnonzero(table == self.first)[0])])


@pytest.fixture
def line(tmp_path):
    return Line(tmp_path)


def test_nobody_passes_a_signal_that_is_red_and_who_is_not_the_first_stops_there_too(line):
    found = line.step(300.0, 900.0)
    np.testing.assert_allclose(found.room, np.array([300.0, 900.0]) - STANDS_BEFORE_M)
    assert found.by.tolist() == [-1, 0]
    line.box.shown = set(range(len(line.loop.p.roster.signals)))
    for _ in range(SETTLES + 1):
        found = line.step(300.0, 900.0)
    assert found.room[0] == np.inf and found.room[1] == 900.0 - STANDS_BEFORE_M  # green is for the first alone
    assert line.told == []


def test_a_green_counts_once_it_has_been_there_for_some_steps(line):
    line.box.shown = set(range(len(line.loop.p.roster.signals)))
    rooms = [line.step(300.0 - k, 900.0).room[0] for k in range(SETTLES + 1)]
    assert all(np.isfinite(rooms[:-1])) and rooms[-1] == np.inf


def test_a_green_taken_back_inside_the_braking_distance_is_told_and_a_red_passed_too(line):
    line.box.shown = set(range(len(line.loop.p.roster.signals)))
    for _ in range(SETTLES + 1):
        line.step(300.0, 2900.0)
    line.box.shown = set()
    v, rules = np.array([20.0]), line.loop.signals
    braking = float(supervisor.stopping_distance(v, rules.rate[:1], 1.0, line.loop.p.step_theta)[0])
    line.step(0.5 * braking, 2900.0)
    [(kind, event)] = line.told
    assert (kind, event["train"], event["signal"]) == ("green_withdrawn", "a", "1")
    assert event["braking_m"] == pytest.approx(braking) and event["room_m"] == pytest.approx(0.5 * braking)
    line.told.clear()
    line.step(-5.0, 2900.0)
    assert line.told.kinds() == [("red_passed", "a")]


def test_nobody_comes_onto_the_track_behind_a_signal_that_a_train_can_stop_before_no_more(line):
    line.box.shown = set(range(len(line.loop.p.roster.signals)))
    parked, ahead = np.array([False, True]), -300.0  # train b, beyond the signal
    for _ in range(SETTLES + 1):
        found = line.step(1200.0, ahead, parked=parked)
    assert found.room[0] == np.inf and found.room[1] > 0.0  # train a can still stop
    found = line.step(100.0, ahead, parked=parked)
    assert line.state.aspects.claims == [[0, line.first]]
    assert (found.room[1], found.by[1]) == (0.0, 0)
    beyond = line.step(90.0, -6000.0, parked=parked)
    assert beyond.room[1] > 0.0  # behind the next signal


def test_a_green_set_while_another_came_onto_the_track_behind_the_signal_does_not_count(line):
    line.box.shown = set(range(len(line.loop.p.roster.signals)))
    come = {"entering": np.array([False, True])}
    for _ in range(SETTLES + 1):
        found = line.step(1200.0, -300.0, **come)
    assert found.room[0] == 1200.0 - STANDS_BEFORE_M
    back = line.step(1200.0, -300.0, stands_until=np.array([np.nan, 7.0]))  # comes back from where it was parked
    assert back.room[0] == 1200.0 - STANDS_BEFORE_M
    assert line.step(1200.0, -300.0).room[0] == np.inf
    line.step(100.0, -6000.0)
    assert line.state.aspects.claims == [[0, line.first]]
    assert line.step(90.0, -300.0, **come).room[0] == np.inf  # too late to take it for red


def test_who_stands_at_a_red_signal_is_told_once_with_the_reason(line):
    line.box.by = 1
    for _ in range(3):
        found = line.step(2.0, 900.0, speed=0.0)
    assert found.by[0] == 1 and line.told.kinds() == [("signal", "a")] and line.told[0][1]["other"] == "b"
    line.told.clear()
    line.step(2.0, 900.0, speed=0.0, standing=(True, False))  # it is at its stop
    assert line.told == []


def test_where_nobody_sets_signals_none_are_obeyed(line):
    assert line.loop.signals.step(0.0, line.ways, line.seen, np.zeros(2), line.traffic, None, line.state) == (line.state, None)
