"""Circles of trains that wait for each other, and waits that grow long: each is told once."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from trainctl.monitors import waiting
from trainctl.monitors.outcome import Tally
from trainctl.monitors.waiting import LASTS_S, SIGNAL, SWITCH, TRAIN, Wait, Waiting, circles
from trainctl.railway import supervisor
from trainctl.railway.supervisor import Targets
from trainctl.signals import Seen


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


def test_what_keeps_a_train_from_starting():
    """Train 0 is held at a switch by 1, which stands behind 2; 2 has 500 m before it and goes; 3 stands at its stop behind 0."""
    train, room, other = [0, 1, 2, 3], [25.0, 20.0, 500.0, 20.0], [-1, 2, 0, 0]
    kind = np.where(np.array(other) < 0, supervisor.SWITCH, supervisor.TRAIN)
    targets = Targets(np.array(train), np.array(room), np.zeros(4), kind == supervisor.TRAIN, kind, np.array(other))
    view, held = (
        SimpleNamespace(targets=targets, clear=targets),
        SimpleNamespace(by=np.array([1, -1, -1, -1]), zone=np.array([7, -1, -1, -1])),
    )
    here = Seen(np.zeros(4), np.array([5, 5, 6, 5]), np.arange(4), np.ones(4, bool))
    rules, stops = supervisor.Params(mode="on", margin_m=30.0), np.array([False, False, False, True])

    def found(speed):
        return waiting.waits(view, held, here, np.array(speed), rules, supervisor.as_ordered(1.0, 4), 1.0, 0.5, stops)

    assert found([0.0, 0.0, 0.0, 0.0]) == [Wait(1, 2, 6, TRAIN), Wait(0, 1, 7, SWITCH)]
    assert found([3.0, 0.0, 0.0, 0.0]) == [Wait(1, 2, 6, TRAIN)]
    assert found([3.0, 1.0, 5.0, 0.0]) == []


def test_a_circle_is_told_once_and_another_one_too():
    watch = Waiting("ABCD", ("e",), 600.0)
    s, both = watch.initial(), waits((0, 1), (1, 0))
    (told,) = watch.new(5.0, both, {}, s)
    assert told == ("gridlock", {"trains": ["A", "B"], "waits": [
        {"train": "A", "other": "B", "edge": "e", "place": "switch"}, {"train": "B", "other": "A", "edge": "e", "place": "switch"},
    ]})  # fmt: skip
    assert list(watch.new(6.0, both, {}, s)) == []
    assert [kind for kind, _ in watch.new(8.0, both + waits((2, 3), (3, 2)), {}, s)] == ["gridlock"]
    assert s.counted["circles"] == [[0, 1], [2, 3]]


def test_a_circle_with_a_signal_in_it_is_told_once_it_lasts():
    """Red that has only just come may go again by itself; one that went and came back begins anew."""
    told, found = Waiting(["a", "b"], ["e"], 600.0), [Wait(0, 1, 0, TRAIN), Wait(1, 0, 0, SIGNAL)]
    s = told.initial()
    assert list(told.new(10.0, found, {}, s)) == [] and list(told.new(10.0 + LASTS_S - 1.0, found, {}, s)) == []
    assert list(told.new(75.0, found[:1], {}, s)) == [] and list(told.new(76.0, found, {}, s)) == []
    [(kind, event)] = told.new(76.0 + LASTS_S, found, {}, s)
    assert (kind, event["trains"]) == ("gridlock", ["a", "b"]) and s.counted["circles"] == [[0, 1]]
    assert list(told.new(400.0, found, {}, s)) == []


def test_a_long_wait_is_told_once_and_the_next_one_again():
    watch, wait = Waiting("AB", ("e", "f"), 100.0), [Wait(0, 1, 1, TRAIN)]
    s = watch.initial()
    told = [(t, kind, fields) for t in range(0, 400) for kind, fields in watch.new(float(t), wait if t != 150 else [], {}, s)]
    assert [(t, kind, fields["since_s"]) for t, kind, fields in told] == [(101, "waiting", 0.0), (252, "waiting", 151.0)]
    assert told[0][2] == {"train": "A", "other": "B", "edge": "f", "place": "train", "since_s": 0.0}
    assert s.counted["long"] == 2


def test_a_train_that_cannot_enter_waits_since_it_was_due():
    watch = Waiting("AB", ("e",), 100.0)
    s = watch.initial()
    told = [t for t in range(50, 300) for _ in watch.new(float(t), [Wait(1, -1, 0, "entry")], {1: 30.0}, s)]
    assert told == [131]


@pytest.mark.parametrize(
    ("supervised", "speeds", "gridlocks", "failed"),
    [(False, 1, 0, []), (True, 1, 0, ["overspeed"]), (True, 0, 0, []), (False, 0, 2, ["gridlock"])],
)
def test_what_fails_a_run(supervised, speeds, gridlocks, failed):
    tally = Tally.empty()
    for _ in range(speeds):
        list(tally.once(3.0, "line_speed_mps", "A", 41.0, 40.0, edge="e"))
    told = tally.outcome(supervised, {"gridlocks": gridlocks})
    assert (told["overspeeds"], told["violations"], told["checks_failed"]) == (speeds, speeds, failed)


def test_a_pair_is_told_once_whoever_counts_it():
    tally = Tally.empty()

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
