"""What a train may do where another one joins ahead: follow it, or keep the join clear, whichever leaves more."""

from __future__ import annotations

import numpy as np

from trainctl.railway import authority, supervisor
from trainctl.railway.supervisor import LIMIT, SWITCH, TRAIN, Limits, Params, Targets, as_ordered

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
