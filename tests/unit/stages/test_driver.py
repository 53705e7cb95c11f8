"""What drivers order, and how fast the references of formations go."""

from __future__ import annotations

import nets
import numpy as np
import pytest
from staged import Told, around, chained, prepared, target, view

from trainctl.railway.supervisor import TRAIN, Limits
from trainctl.scenario.build import open_scenario
from trainctl.stages import driver
from trainctl.stages.convoys import Convoys
from trainctl.stages.driver import HASTE, ROOM_FOR_HASTE
from trainctl.stages.traffic import Traffic, nothing
from trainctl.topology.convoys import closing_speed


class Cab:
    """All trains far apart at one speed, with a driver each."""

    def __init__(self, p, speed=35.0):
        self.p, self.n = p, len(p.scenario.ids)
        self.driver, self.traffic = driver.of(p), Traffic(p, Told()).initial()
        self.formed = Convoys(p, Told()).initial()[1]
        self.v, self.nobody = np.full(self.n, speed), np.full(self.n, np.nan)

    def alone(self, **more):
        return view([-1] * self.n, [np.inf] * self.n, **more)

    def step(self, at=None, commanded=None, **stops):
        at = around(self.alone() if at is None else at, **stops)
        return self.driver.step(
            self.v, np.zeros(self.n), at, self.traffic, self.formed, self.nobody if commanded is None else commanded
        )


@pytest.fixture(scope="module")
def p(line):
    return prepared(line, "robust_constrained")


def test_trains_on_a_line_are_driven_by_their_law():
    p = open_scenario("three_tracks")
    n = len(p.scenario.ids)
    formed = object()
    driven, same = driver.of(p).step(np.full(n, 80.0), np.zeros(n), nothing(n), None, formed, np.full(n, 0.3))
    assert np.isnan(driven.ordered).all() and not driven.stands.any() and same is formed


def test_who_has_nothing_ahead_takes_up_the_cruising_speed(p):
    cab = Cab(p, 30.0)
    driven, _ = cab.step()
    np.testing.assert_allclose(driven.ordered, p.driving.acceleration_mps2)
    cab.v[:] = 36.0
    driven, _ = cab.step()
    np.testing.assert_allclose(driven.ordered, -p.driving.deceleration_mps2)
    cab.v[:] = 35.0
    np.testing.assert_allclose(cab.step()[0].ordered, 0.0)


def test_trains_are_driven_with_the_rates_of_their_types_and_a_formation_with_its_least(line):
    changes = {"train_type": {"emu": {**nets.LAWS["robust_constrained"]["train_type"], "driven_deceleration_mps2": 0.3}}}
    kinds = prepared(line, "robust_constrained", **changes)
    assert kinds.driver_braking.tolist() == [0.3] * len(kinds.scenario.ids)
    assert kinds.driver_acceleration.tolist() == [kinds.driving.acceleration_mps2] * len(kinds.scenario.ids)
    cab = Cab(kinds, 30.0)
    cab.driver.pulls = np.array([0.4, 0.1, 0.2] + [0.4] * (cab.n - 3))
    np.testing.assert_allclose(cab.step()[0].ordered, cab.driver.pulls)
    cab.formed = chained(cab.formed, [-1, 0] + [-1] * (cab.n - 2))
    cab.formed.references.pace.speed[:] = 30.0
    np.testing.assert_allclose(cab.step()[1].references.pace.acceleration[:2], 0.1)
    near = cab.alone(
        targets=target(2, kinds.driver_rules.margin_m, 0.0, TRAIN, other=0)
    )  # too near: braked as planned all the same
    assert cab.step(near)[0].ordered[2] == -0.3


def test_limits_stops_and_trains_ahead_are_braked_for(p):
    plan = p.driver_rules.service_mps2
    near = 0.5 * 35.0**2 / plan
    cab = Cab(p)
    for distance, brakes in ((near, True), (1.6 * near, False)):
        for driven, _ in (
            cab.step(cab.alone(limits=Limits(np.array([1]), np.array([distance - 20.0]), np.array([1.0])))),
            cab.step(stops=([1], [distance])),
            cab.step(cab.alone(targets=target(1, distance + p.driver_rules.margin_m, 0.0, TRAIN, other=0))),
        ):
            assert bool(driven.ordered[1] < -0.1) is brakes
            np.testing.assert_allclose(np.delete(driven.ordered, 1), 0.0)


def test_the_reference_of_a_formation_heeds_limits_of_all_and_what_is_ahead_of_its_first(p):
    cab = Cab(p)
    cab.formed = chained(cab.formed, [-1, 0] + [-1] * (cab.n - 2))
    cab.formed.references.pace.speed[:] = 35.0
    driven, formed = cab.step(cab.alone(limits=Limits(np.array([1]), np.array([0.0]), np.array([30.0]))))
    assert np.isnan(driven.ordered[:2]).all() and np.isfinite(driven.ordered[2:]).all()  # the law drives the two
    assert formed.references.pace.acceleration[0] == formed.references.pace.acceleration[1] < -0.1
    _, formed = cab.step(cab.alone(targets=target(1, 100.0, 35.0, TRAIN, moving=True, other=0)))  # the law looks after that
    np.testing.assert_allclose(formed.references.pace.acceleration, 0.0)


def test_a_train_that_stands_at_a_stop_is_held_and_so_is_one_that_may_not_go(p):
    cab = Cab(p, 0.0)
    cab.traffic.stands_until[1] = 50.0
    driven, _ = cab.step(cab.alone(targets=target(2, 0.0, 0.0, TRAIN, other=3)))
    assert driven.stands.tolist() == [False, True, True] + [False] * (cab.n - 3)
    assert driven.ordered[1] == 0.0 and driven.ordered[0] > 0.0


def test_a_train_in_no_formation_is_commanded_like_any_other(p):
    cab = Cab(p)
    wanted = np.full(cab.n, np.nan)
    wanted[3] = -0.3
    driven, _ = cab.step(commanded=wanted)
    assert driven.ordered[3] == -0.3
    np.testing.assert_allclose(np.delete(driven.ordered, 3), 0.0)
    cab = Cab(p, 0.0)  # before a train that stands: the driver would not go
    held = cab.alone(targets=target(3, 0.0, 0.0, TRAIN, other=2))
    assert cab.step(held)[0].stands[3]
    driven, _ = cab.step(held, -wanted)
    assert driven.ordered[3] == 0.3 and not driven.stands[3]


def test_a_train_catches_up_no_faster_than_it_is_told_to(line):
    """At most catch_up_mps above the cruising speed, half of that where one behind is nearer to joining, and within its bounds."""
    for most, room in ((1.0, 3.0), (3.0, 3.0)):
        p = prepared(line, "robust_constrained", traffic={"catch_up_mps": most})
        cab = Cab(p)
        n, v = cab.n, cab.v
        allowed = min(most, ROOM_FOR_HASTE * room)
        first, far, near = [-1, 0, 1] + [-1] * (n - 3), 9000.0, 1220.0
        nothing = [np.inf] * (n - 3)
        wish = cab.driver._wish(v, view(first, [np.inf, far, far, *nothing]), cab.traffic, cab.formed)
        np.testing.assert_allclose(wish[:3] - 35.0, [0.0, allowed, allowed], atol=1e-12)
        # the third is nearer to joining the second
        wish = cab.driver._wish(v, view(first, [np.inf, far, near, *nothing]), cab.traffic, cab.formed)
        closing = float(closing_speed(np.array([20.0]))[0])
        np.testing.assert_allclose(wish[:3] - 35.0, [0.0, min(HASTE * most, ROOM_FOR_HASTE * room), closing], atol=1e-12)
        assert HASTE * most < allowed or most == 3.0
