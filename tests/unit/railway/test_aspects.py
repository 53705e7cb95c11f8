"""How far trains may go before signals: who is first before one, and what its aspect means to whom."""

from __future__ import annotations

import numpy as np
import pytest

from trainctl.railway import aspects
from trainctl.railway.ways import ways

#: Two edges lead into a third one, which leads on to a fourth: 0, 1 -> 2 -> 3. Signals 0 and 1 before the join, 2 behind it.
LENGTH = np.array([1000.0, 1000.0, 500.0, 2000.0])
SIGNALS = {(0, 2): 0, (1, 2): 1, (2, 3): 2}
FAR = 3000.0


class Line:
    """Trains on it: the first two come over edge 0, the third over edge 1."""

    def __init__(self) -> None:
        self.ways = ways([[0, 2, 3], [0, 2, 3], [1, 2, 3]], np.zeros(4), LENGTH)
        self.at = aspects.table(self.ways, np.zeros(4, bool), SIGNALS)
        self.state = aspects.none(3, 3)

    def go(
        self, s: list[float], green: set[int], steps: int = 1, braking: float = 100.0, present: tuple[int, ...] = (0, 1, 2),
        stands: tuple[int, ...] = (),
    ):  # fmt: skip
        """So many instants with the trains at these places; the last decision."""
        there = np.isin(np.arange(3), present)
        place = np.array(s)
        begin = self.ways.begin.reshape(3, 3)
        row = self.ways.first[:-1] + (begin <= place[:, None]).sum(1) - 1
        for _ in range(steps):
            seen = aspects.sighted(self.ways, self.at, row, place, np.ones(3, bool), np.full(3, FAR))
            shown = np.isin(seen.signal, list(green))
            asks, way = ~np.isin(np.arange(3), stands), np.full(3, braking)
            self.state, ends, told = aspects.decide(self.ways, seen, shown, place, there, asks, way, 1.5 * way, self.state)
        return ends, told


@pytest.fixture
def line() -> Line:
    return Line()


def test_signals_stand_at_the_ends_of_edges_for_those_who_go_on(line):
    assert line.at.tolist() == [-1, 0, 2, -1, 0, 2, -1, 1, 2]
    inside = np.array([False, False, False, True])  # a junction between: its first edge has the signal
    over = ways([[0, 3, 2]], np.zeros(4), LENGTH)
    assert aspects.table(over, inside, SIGNALS).tolist() == [-1, 0, -1]


def test_green_counts_for_the_first_alone_once_it_has_been_that(line):
    ends, _ = line.go([800.0, 500.0, 300.0], {0, 2}, aspects.SETTLES)
    assert ends.room.tolist() == [199.5, 499.5, 699.5] and ends.by.tolist() == [-1, 0, -1]  # not yet settled
    ends, told = line.go([800.0, 500.0, 300.0], {0, 2})
    assert np.isinf(ends.room[0]) and ends.room[1:].tolist() == [499.5, 699.5] and not told
    assert ends.zone.tolist() == [-1, 2, 2] and ends.by.tolist() == [-1, 0, -1]
    ends, _ = line.go([1100.0, 500.0, 300.0], {0, 2})  # it has passed; what its follower sees is still its green
    assert ends.room[1] == 499.5 and ends.by[1] == -1
    ends, _ = line.go([1100.0, 500.0, 300.0], {0, 2}, aspects.SETTLES)
    assert ends.room[1] == 999.5 and ends.by[1] == 0  # up to the next signal, where the other one is the first


def test_the_first_red_ends_the_authority_whatever_is_behind_it(line):
    ends, _ = line.go([800.0, 500.0, 300.0], {2}, 5)
    assert ends.room.tolist() == [199.5, 499.5, 699.5] and line.state.red.tolist() == [0, 0, 1]


def test_a_green_that_is_taken_back_is_told_where_it_comes_too_late(line):
    for braking, tells in ((150.0, False), (250.0, True)):
        line.state = aspects.none(3, 3)
        line.go([800.0, 500.0, 300.0], {0, 2}, 5, braking)
        _, told = line.go([800.0, 500.0, 300.0], {2}, 1, braking)
        assert ([(one.train, one.signal, one.passed, one.room) for one in told] == [(0, 0, False, 200.0)]) is tells
        _, told = line.go([810.0, 500.0, 300.0], {2}, 1, braking)
        assert told == []  # once


def test_a_green_is_claimed_that_could_not_be_given_up_by_the_next_step(line):
    claimed = {}
    for braking in (150.0, 600.0):
        line.state = aspects.none(3, 3)
        line.go([800.0, 500.0, 300.0], {0, 1, 2}, aspects.SETTLES, braking)
        assert line.state.claims == []  # none is free yet
        line.go([800.0, 500.0, 300.0], {0, 1, 2}, 1, braking)
        claimed[braking] = line.state.claims
    assert claimed == {150.0: [[0, 0]], 600.0: [[0, 0], [0, 2], [2, 1]]}  # train 1 is not the first before its signal
    line.go([800.0, 500.0, 300.0], {1, 2}, 1, 600.0)
    assert line.state.claims == [[2, 1]]  # what lies behind a red is out of reach
    line.go([1100.0, 500.0, 1001.0], {0, 1}, 1, 600.0)
    assert line.state.claims == []


def test_who_stands_at_a_stop_asks_for_nothing_and_its_green_means_nothing(line):
    ends, _ = line.go([800.0, 500.0, 300.0], {0, 2}, 10, stands=(0,))
    assert ends.room[0] == 199.5 and line.state.claims == []
    ends, _ = line.go([800.0, 500.0, 300.0], {0, 2}, aspects.SETTLES - 1)
    assert ends.room[0] == 199.5
    ends, _ = line.go([800.0, 500.0, 300.0], {0, 2})
    assert np.isinf(ends.room[0])


def test_a_red_that_is_passed_is_told(line):
    line.go([999.0, 500.0, 300.0], {2}, 5)
    _, told = line.go([1003.0, 500.0, 300.0], {2})
    assert [(one.train, one.signal, one.passed) for one in told] == [(0, 0, True)]
    line.go([1003.0, 999.9, 300.0], {0, 2}, 5)
    _, told = line.go([1003.0, 1003.0, 300.0], {0, 2})
    assert not any(one.passed for one in told)  # that one had green


def test_a_train_that_turned_or_was_led_another_way_has_passed_nothing(line):
    for other in ([0, 2, 3], [0, 2, 3], [1, 2, 3]), ([0, 3], [0, 2, 3], [1, 2, 3]):
        line.state, line.ways = aspects.none(3, 3), Line().ways
        line.go([999.0, 500.0, 300.0], {2}, 5)
        passes = len(other[0]) == 3
        new = ways(other, np.zeros(4), LENGTH)
        seen = aspects.sighted(new, aspects.table(new, np.zeros(4, bool), SIGNALS), new.first[:-1] + [1, 0, 0],
                               np.array([1003.0, 500.0, 300.0]), np.ones(3, bool), np.full(3, FAR))  # fmt: skip
        told = aspects.decide(new, seen, np.zeros(len(seen.signal), bool), np.array([1003.0, 500.0, 300.0]), np.ones(3, bool),
                              np.ones(3, bool), np.zeros(3), np.zeros(3), line.state)[2]  # fmt: skip
        assert [one.passed for one in told] == [True] * passes


def test_who_is_not_there_may_go_to_its_first_signal_and_is_in_nobodys_way(line):
    ends, told = line.go([800.0, 500.0, 300.0], {0, 1, 2}, 5, 900.0, (1, 2))
    assert ends.room[0] == 199.5 and np.isinf(ends.room[1]) and not told  # train 1 is the first that is there
    ends, told = line.go([800.0, 500.0, 300.0], {0, 1, 2}, 1, 900.0)
    assert ends.room[0] == 199.5 and [(one.train, one.passed) for one in told] == [(1, False)]  # it has come just before train 1


def test_turns_at_joins_are_those_of_the_signals(line):
    joins = np.array([False, False, True, False])
    row, s, there = line.ways.first[:-1], np.array([800.0, 500.0, 900.0]), np.ones(3, bool)
    room = np.array([np.inf, 499.5, 99.5])  # the nearest one has red
    found = aspects.order(line.ways, joins, row, s, there, FAR, room)
    assert (found.edge.tolist(), found.train.tolist()) == ([2], [0])
    found = aspects.order(line.ways, joins, row, s, there, FAR, np.full(3, np.inf))
    assert found.train[np.argsort(found.rank)].tolist() == [2, 0, 1]


def test_a_train_that_passes_a_join_again_has_its_turn_of_the_first_time():
    """On a ring: the next time round comes after whoever is to join meanwhile."""
    way, length = [[0, 2, 0, 2], [1, 2]], np.array([1000.0, 1000.0, 1000.0])
    rows, joins = ways(way, np.zeros(3), length), np.array([True, False, True])
    row, s = rows.first[:-1], np.array([900.0, 500.0])
    found = aspects.order(rows, joins, row, s, np.ones(2, bool), FAR, np.full(2, np.inf))
    turns = sorted(zip(found.rank.tolist(), found.edge.tolist(), found.train.tolist(), strict=True))
    assert [(edge, train) for _, edge, train in turns] == [(0, 0), (2, 0), (2, 1)]
