from __future__ import annotations

import time

import numpy as np
import pytest
from pydantic import ValidationError

from trainctl.plants import point
from trainctl.railway import supervisor
from trainctl.railway.supervisor import END, KINDS, LIMIT, OPPOSING, STOP, SWITCH, TRAIN, Limits, Params, Targets

PARAMS = Params(mode="on")  # 1.0, 0.7, 20 m
NOBODY, NO_LIMIT = supervisor.no_targets(), supervisor.no_limits()
WAYS = [(0.0, 1.0), (0.5, 1.0), (0.0, 0.1), (0.5, 0.3), (0.25, 2.0)]


def target(room, speed=0.0, moving=False, kind=TRAIN, train=0):
    return Targets(np.array([train]), np.array([room]), np.array([speed]), np.array([moving]), np.array([kind]), np.array([-1]))


def judged(v, *targets, limits=NO_LIMIT, params=PARAMS, step=1.0, theta=0.5):
    together = Targets(*(np.concatenate(c) for c in zip(*targets, strict=True))) if targets else NOBODY
    return supervisor.verdict(params, np.atleast_1d(np.asarray(v, float)), together, limits, step, theta)


@pytest.mark.parametrize(("theta", "step"), WAYS)
def test_stopping_distance_is_the_way_braking_takes_in_steps_and_greatest_speed_its_inverse(theta, step):
    speed = np.random.default_rng(0).uniform(0.0, 90.0, 500)
    v, way = speed.copy(), np.zeros(500)
    while v.any():
        after = np.maximum(0.0, v - 0.8 * step)
        way, v = way + ((1.0 - theta) * v + theta * after) * step, after
    np.testing.assert_allclose(supervisor.stopping_distance(speed, 0.8, step, theta), way, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(supervisor.greatest_speed(way, 0.8, step, theta), speed, rtol=1e-9)
    assert supervisor.greatest_speed(np.array([-1.0, 0.0]), 0.8, step, theta).tolist() == [0.0, 0.0]


def test_curve_is_the_continuous_one():
    assert supervisor.curve(np.array([100.0, 0.0, -5.0]), np.array([10.0, 10.0, 0.0]), 0.5).tolist() == [200.0**0.5, 10.0, 0.0]


def test_a_train_alone_may_do_all_that_is_admitted():
    verdict = judged([0.0, 40.0])
    assert verdict.maximum.tolist() == [1.0, 1.0] and verdict.minimum.tolist() == [0.0, -1.0]
    assert verdict.reason.tolist() == verdict.target.tolist() == [-1, -1] and not verdict.emergency.any()


@pytest.mark.parametrize(("theta", "step"), WAYS)
def test_a_formation_of_one_speed_is_not_touched_from_one_step_of_way_beyond_the_margin(theta, step):
    v = 50.0
    for beyond, touched in ((1e-3, False), (-1e-3, True)):
        verdict = judged(v, target(20.0 + v * step + beyond, v, moving=True), step=step, theta=theta)
        _, intervened = supervisor.applied(verdict, np.zeros(1))
        assert bool(intervened[0]) is touched


def test_behind_a_moving_train_the_relative_curve_admits_what_the_absolute_does_not():
    ahead = target(300.0, 50.0, moving=True)
    assert judged(50.0, ahead).maximum[0] == 1.0
    assert judged(50.0, ahead, params=Params(curve="absolute")).emergency[0]
    assert judged(50.0, target(300.0, 50.0, moving=False)).emergency[0]  # that one does not move


def test_emergency_distance_holds_whatever_the_speeds():
    params = Params(emergency_distance_m=80.0)
    fleeing = target(79.0, 60.0, moving=True)
    assert judged(30.0, fleeing).maximum[0] == 1.0
    verdict = judged(30.0, fleeing, params=params)
    assert verdict.emergency[0] and verdict.maximum[0] == verdict.minimum[0] == -1.0
    assert judged(30.0, target(50.0, kind=SWITCH), params=params).maximum[0] == -1.0  # too late for it anyway
    assert judged(2.0, target(50.0, kind=SWITCH), params=params).maximum[0] == 1.0  # the distance is one between trains


def test_too_late_is_emergency_braking_down_to_a_stand_and_no_more():
    verdict = judged([30.0, 0.4, 0.0], *(target(5.0, kind=END, train=i) for i in range(3)))
    assert verdict.maximum.tolist() == verdict.minimum.tolist() == [-1.0, -0.4, 0.0]
    assert verdict.emergency.tolist() == [True, True, False]
    assert [KINDS[r] for r in verdict.reason] == ["end"] * 3


def test_the_nearest_bind_names_kind_and_row():
    far, near = target(900.0, kind=END), target(300.0, kind=SWITCH)
    limits = Limits(np.array([0, 1]), np.array([5000.0, -1.0]), np.array([10.0, 20.0]))
    verdict = judged([24.0, 20.0], far, near, limits=limits)
    assert verdict.reason.tolist() == [SWITCH, LIMIT] and verdict.target.tolist() == [1, 1]
    assert verdict.maximum[1] == 0.0
    assert judged(24.0, far, near, near).target[0] == 1  # of equals the first


def test_opposing_trains_share_what_is_left_of_the_way():
    both = supervisor.stopping_distance(np.array([20.0, 30.0]), 1.0, 1.0, 0.5).sum()
    each = [-1.0 + 5.0 / 20.0, -1.0 + 5.0 / 30.0]  # 5 m each, in 20 and 30 s of braking
    for left, expected in ((0.0, [-1.0, -1.0]), (10.0, each)):
        pair = [target(both + 20.0 + left, v, True, OPPOSING, i) for i, v in ((0, 30.0), (1, 20.0))]
        np.testing.assert_allclose(judged([20.0, 30.0], *pair).maximum, expected)


def test_a_stop_and_a_limit_are_braked_for_with_the_service_brake_until_the_emergency_brake_must():
    at = Limits(np.array([0]), np.array([0.0]), np.array([0.0]))
    for room in (800.0, 650.0):  # from 30 m/s 643 m with 0.7, 450 m with 1.0
        assert -0.7 < judged(30.0, target(room, kind=STOP)).maximum[0] <= 1.0
    assert (
        judged(30.0, target(550.0, kind=STOP)).maximum[0] == judged(30.0, limits=at._replace(distance=np.array([550.0]))).maximum[0]
    )
    assert judged(30.0, target(550.0, kind=STOP)).maximum[0] == -0.7
    assert judged(30.0, target(450.0, kind=STOP)).maximum[0] == pytest.approx(-1.0)
    assert judged(30.0, limits=at._replace(speed=np.array([28.0]))).emergency[0]  # in force and broken


def test_applied_keeps_the_verdict_and_says_where_it_changed_the_motion():
    verdict = judged([30.0, 30.0, 0.4, 30.0, 30.0])
    acceleration, intervened = supervisor.applied(verdict, np.array([0.5, 3.0, -0.9, -1.5, np.nan]))
    assert acceleration.tolist() == [0.5, 1.0, -0.4, -1.0, -1.0]
    assert intervened.tolist() == [False, True, False, True, True]


def test_point_trains_move_as_the_verdict_takes_them_to():
    """Driven at the verdict by their own plant, they come to stand at the margin and not beyond it."""
    davis = np.tile([0.01, 1e-4, 1e-5], (3, 1))
    constants = point.Constants(davis, *(np.full(3, c) for c in (1.0, -np.inf, np.inf, 0.0, np.inf)), np.zeros((0, 2)), np.zeros(3))
    own = np.array([[0.0, 40.0], [0.0, 13.3], [0.0, 0.0]])
    for _ in range(700):
        ahead = [target(2000.0 - x, kind=END, train=i) for i, x in enumerate(own[:, 0])]
        a, _ = supervisor.applied(judged(own[:, 1], *ahead, step=0.5, theta=0.0), np.full(3, 9.0))
        own = point.advance(constants, own, a, 0.5, point.Kick.none(3)).own
        assert own[:, 0].max() < 1980.0 + 1e-6
    assert own[:, 0].min() > 1979.9


def test_service_beyond_emergency_is_refused():
    with pytest.raises(ValidationError, match=r"service_mps2 = 0\.7: at most emergency_mps2 = 0\.5"):
        Params(emergency_mps2=0.5)


def test_ten_thousand_trains_are_judged_in_a_few_milliseconds():
    rng, n = np.random.default_rng(0), 10_000
    v = rng.uniform(0.0, 60.0, n)
    rows = np.arange(1, n)
    targets = Targets(rows, rng.uniform(100.0, 3000.0, n - 1), v[:-1], np.ones(n - 1, bool), np.full(n - 1, TRAIN), rows - 1)
    limits = Limits(np.repeat(np.arange(n), 3), rng.uniform(-100.0, 5000.0, 3 * n), rng.uniform(10.0, 80.0, 3 * n))
    took = []
    for _ in range(20):
        begin = time.process_time()
        supervisor.verdict(PARAMS, v, targets, limits, 0.5, 0.5)
        took.append(time.process_time() - begin)
    assert min(took) < 0.01  # s; 1.5 to 2 ms on a quiet core
