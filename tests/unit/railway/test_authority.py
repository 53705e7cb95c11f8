"""What a train may do where another one joins ahead: follow it, or keep the join clear, whichever leaves more."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from trainctl.railway import along, authority, supervisor
from trainctl.railway.supervisor import LIMIT, SWITCH, TRAIN, Limits, Params, Targets, as_ordered
from trainctl.railway.ways import ways

PARAMS = Params(mode="on")  # 1.0, 0.7, 20 m
SPEED = np.array([30.0, 30.0, 30.0, 30.0])


def targets(*rows: tuple[int, float, float, bool, int]) -> Targets:
    """Of (train, room, speed, moving, kind)."""
    train, room, speed, moving, kind = zip(*rows, strict=True)
    return Targets(
        np.array(train), np.array(room), np.array(speed), np.array(moving), np.array(kind), (np.array(train) + 1) % len(SPEED)
    )  # fmt: skip


#: Ahead on the join: near and fast for train 0, near and slow for train 1; train 2 has nothing ahead but a limit.
FOLLOW = targets((0, 60.0, 30.0, True, TRAIN), (1, 30.0, 5.0, True, TRAIN), (3, 500.0, 0.0, False, TRAIN))
#: The join itself: too near for train 0 to stop there, far enough for train 1, a little nearer than what is behind it for train 3.
CLEAR = targets((0, 200.0, 0.0, False, SWITCH), (1, 490.0, 0.0, False, SWITCH), (3, 495.0, 0.0, False, SWITCH))
SLOW = Limits(np.array([2]), np.array([0.0]), np.array([30.0]))


def judged(one: Targets, other: Targets) -> supervisor.Verdict:
    return authority.judge(
        PARAMS, SPEED, one, other, SLOW, 1.0, 0.5, as_ordered(PARAMS.emergency_mps2, len(SPEED)), np.zeros(len(SPEED))
    )


def test_the_better_of_following_and_of_keeping_the_join_clear_holds():
    follows, waits = (supervisor.verdict(PARAMS, SPEED, t, SLOW, 1.0, 0.5) for t in (FOLLOW, CLEAR))
    assert follows.maximum[0] > waits.maximum[0] == -1.0  # the join is too near, the train ahead is fast
    assert waits.maximum[1] > follows.maximum[1] == -1.0  # the other way round
    both = judged(FOLLOW, CLEAR)
    np.testing.assert_array_equal(both.maximum, np.maximum(follows.maximum, waits.maximum))
    assert follows.emergency.tolist() == [False, True, False, False] and waits.emergency.tolist() == [True, False, False, False]
    assert not both.emergency.any()
    assert both.reason.tolist() == [TRAIN, SWITCH, LIMIT, TRAIN]
    assert both.target.tolist() == [0, len(FOLLOW.train) + 1, 0, 2]  # rows of CLEAR count on from those of FOLLOW


def test_without_a_join_ahead_one_verdict_is_enough():
    alone, expected = judged(FOLLOW, FOLLOW), supervisor.verdict(PARAMS, SPEED, FOLLOW, SLOW, 1.0, 0.5)
    for a, b in zip(alone, expected, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("inside", [True, False])
def test_who_keeps_a_join_clear_stands_before_its_junction(inside):
    """Two tracks come over 20 m and 30 m of a junction into a third one: edges a 0, b 1, m 2, and 3, 4 inside."""
    length = np.array([1000.0, 1000.0, 2000.0, 20.0, 30.0])
    net = SimpleNamespace(length_m=length, before=[[], [], [3, 4], [0], [1]], twin=np.full(5, -1), crossing=[[]] * 5)
    there = ways([[0, 3, 2], [1, 4, 2]], np.zeros(5), length)
    internal = np.array([False, False, False, True, True]) if inside else np.zeros(5, bool)
    for front, room in ((400.0, 600.0 if inside else 620.0), (1010.0, 0.0 if inside else 10.0)):
        row = there.first[:-1] + np.array([0 if front <= 1000.0 else 1, 1])
        seen = authority.look(
            there, along.net(net), np.full(5, 40.0), np.zeros(5, bool), np.ones(2), row, np.array([front, 1025.0]), np.zeros(2),
            np.full(2, 100.0), np.ones(2, bool), 5000.0, np.full(2, np.inf), None, internal,
        )  # fmt: skip
        assert [
            (int(k), float(r)) for i, k, r in zip(*seen.clear[:1], seen.clear.kind, seen.clear.room, strict=True) if i == 0
        ] == [(SWITCH, room)]
