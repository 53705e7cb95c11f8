"""Circles of trains that wait for each other, and waits that grow long: each is told once."""

from __future__ import annotations

import pytest

from trainctl.monitors.outcome import Tally
from trainctl.monitors.waiting import SWITCH, TRAIN, Wait, Waiting, circles


def waits(*pairs):
    return [Wait(i, j, 0, SWITCH) for i, j in pairs]


@pytest.mark.parametrize(
    ("pairs", "expected"),
    [
        ([], []),
        ([(0, 1), (1, 2)], []),  # 2 can go
        ([(0, 1), (1, 0)], [[0, 1]]),
        ([(3, 0), (0, 1), (1, 2), (2, 0), (4, 3)], [[0, 1, 2]]),  # 3 and 4 wait for the circle, they are not in it
        ([(0, 1), (1, 0), (5, 6), (6, 7), (7, 5), (0, 5)], [[0, 1], [5, 6, 7]]),
        ([(0, 1), (0, 2), (2, 0)], [[0, 2]]),  # it needs both, and one of them needs it
        ([(0, 1), (1, 2), (2, 0), (1, 3), (3, 1)], [[0, 1, 2, 3]]),  # two that hang together
        ([(0, -1), (1, 0)], []),
    ],
)
def test_circles(pairs, expected):
    assert circles(waits(*pairs)) == expected


def test_a_circle_is_told_once_and_another_one_too():
    state = Waiting("ABCD", ("e",), 600.0)
    both = waits((0, 1), (1, 0))
    (told,) = state.new(5.0, both, {})
    assert told == ("gridlock", {"trains": ["A", "B"], "waits": [
        {"train": "A", "other": "B", "edge": "e", "place": "switch"}, {"train": "B", "other": "A", "edge": "e", "place": "switch"},
    ]})  # fmt: skip
    assert list(state.new(6.0, both, {})) == []
    again = Waiting("ABCD", ("e",), 600.0)
    again.restore(state.values(), state.arrays())
    assert list(again.new(7.0, both, {})) == []
    assert [kind for kind, _ in again.new(8.0, both + waits((2, 3), (3, 2)), {})] == ["gridlock"]
    assert (len(state.circles), len(again.circles)) == (1, 2)


def test_a_long_wait_is_told_once_and_the_next_one_again():
    state, wait = Waiting("AB", ("e", "f"), 100.0), [Wait(0, 1, 1, TRAIN)]
    told = [(t, kind, fields) for t in range(0, 400) for kind, fields in state.new(float(t), wait if t != 150 else [], {})]
    assert [(t, kind, fields["since_s"]) for t, kind, fields in told] == [(101, "waiting", 0.0), (252, "waiting", 151.0)]
    assert told[0][2] == {"train": "A", "other": "B", "edge": "f", "place": "train", "since_s": 0.0}
    assert state.long == 2


def test_a_train_that_cannot_enter_waits_since_it_was_due():
    state = Waiting("AB", ("e",), 100.0)
    told = [t for t in range(50, 300) for _ in state.new(float(t), [Wait(1, -1, 0, "entry")], {1: 30.0})]
    assert told == [131]


@pytest.mark.parametrize(
    ("supervised", "speeds", "gridlocks", "failed"),
    [(False, 1, 0, []), (True, 1, 0, ["overspeed"]), (True, 0, 0, []), (False, 0, 2, ["gridlock"])],
)
def test_what_fails_a_run(supervised, speeds, gridlocks, failed):
    tally = Tally()
    for _ in range(speeds):
        list(tally.once(3.0, "line_speed_mps", "A", 41.0, 40.0, edge="e"))
    told = tally.outcome(supervised, {"gridlocks": gridlocks})
    assert (told["overspeeds"], told["violations"], told["checks_failed"]) == (speeds, speeds, failed)


def test_a_pair_is_told_once_whoever_counts_it():
    tally = Tally()

    def ours(time, who, value):
        return list(tally.once(time, "gap_m", who, value, 0.0, trains=who.split("-")))

    assert len(ours(9.0, "A-B", -1.0)) == 1
    assert ours(10.0, "B-A", -7.0) == ours(11.0, "A-B", -2.0) == []
    counted = {"time_s": 8.0, "trains": ["B", "A"], "edge": "e", "edge_m": 1.0}
    assert list(tally.counted(8.0, counted)) == []
    (new,) = tally.counted(8.0, {**counted, "trains": ["C", "A"]})
    assert new == {
        "bound": "sumo_collision", "who": "C-A", "value": 1.0, "limit": 0.0, "trains": ["C", "A"], "edge": "e", "edge_m": 1.0
    }  # fmt: skip
    told = tally.outcome(False, {})
    assert (told["collisions"], told["checks_failed"], told["first_violation"]["who"]) == (2, ["collision"], "C-A")
    assert told["worst"]["gap_m"] == {"time_s": 10.0, "who": "B-A", "value": -7.0, "limit": 0.0}
    again = Tally()
    again.restore(tally.values())
    assert again.outcome(False, {}) == told
