"""Third-order units and their faults: actuator, couplers, energy, windows, what is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydantic import ValidationError

from trainctl import draws
from trainctl.plants import actuated_units as plant
from trainctl.plants.faults import Fault, breaks, effectiveness, fault_rate, tabulated, violations
from trainctl.signals import FORCE, POSITION, SPEED, Bounds, Consists, Links, Reference, Scene

INF = math.inf


def consists(**changes):
    """Two trains, of three unlike units and of one."""
    whole = Consists(
        first=np.array([0, 3, 4]), length=np.array([26.0, 24.0, 20.0, 18.0]), mass=np.array([8e4, 6e4, 7e4, 5e4]),
        rotating=np.array([1.1, 1.0, 1.05, 1.0]), davis=np.tile([0.01176, 0.00077616, 1.6e-5], (4, 1)),
        stiffness=np.array([1.6e5, 2e5, 0.0, 0.0]), damping=np.array([600.0, 900.0, 0.0, 0.0]),
        traction=np.full(4, INF), traction_power=np.full(4, INF), braking=np.full(4, INF), braking_power=np.full(4, INF),
        actuator_rate=np.array([50.0, 40.0, 50.0, 30.0]),
    )  # fmt: skip
    return whole._replace(**changes)


OWN = np.array([[1000.0, 20.0, 3e4], [973.5, 21.0, -2e4], [950.0, 19.5, 1e4], [500.0, 30.0, 5e3]])


def rates(constants, own, applied, t=0.0, inside=None):
    out, power = np.zeros_like(own), np.zeros((2, 6))
    for i, (a, b) in enumerate(((0, 3), (3, 4))):
        plant.rate(i, constants, t, t if inside is None else inside, own[a:b], applied[a:b], out[a:b], power[i])
    return out, power


def made(faults=(), **changes):
    return plant.constants(plant.Params(), consists(**changes), faults=faults, trains=("1", "2"))


def fault(**keys):
    return Fault(**({"train": 1, "unit": 2, "kind": "constant", "amplitude_n_per_s": 2e5, "start_s": 10.0, "end_s": 20.0} | keys))


def test_actuator_follows_its_demand_at_its_rate_and_faults_shift_it():
    faults = [fault(), fault(unit=3, kind="effectiveness", amplitude_n_per_s=None, effectiveness=0.25)]
    out, _ = rates(made(faults), OWN, np.array([4e4, 1e4, 2e4, 0.0]), t=15.0)
    np.testing.assert_allclose(out[:, FORCE], [50.0 * 1e4, 40.0 * 3e4 + 2e5, 50.0 * (0.25 * 2e4 - 1e4), -30.0 * 5e3])


def test_motion_is_that_of_equation_1_with_rotating_masses():
    c = consists()
    out, _ = rates(made(), OWN, np.zeros(4))
    e, de = OWN[0, POSITION] - OWN[1, POSITION] - 26.0, OWN[0, SPEED] - OWN[1, SPEED]
    R = 0.01176 + 0.00077616 * 20.0 + 1.6e-5 * 400.0
    assert out[0, SPEED] == pytest.approx((3e4 - 1.6e5 * e - 600.0 * de - 8e4 * R) / (8e4 * 1.1), rel=1e-13)
    np.testing.assert_array_equal(out[:, POSITION], OWN[:, SPEED])
    assert c.stiffness[2] == 0.0  # nothing behind the tail: the second train's speed is its own
    assert out[3, SPEED] == pytest.approx(5e3 / 5e4 - (0.01176 + 0.00077616 * 30.0 + 1.6e-5 * 900.0), rel=1e-13)


def test_powers_are_the_rate_of_kinetic_and_coupler_energy():
    c = consists()
    constants = plant.constants(plant.Params(), c, gradient=np.array([[0.0, 0.01], [960.0, -0.02]]))
    constants.units[:, plant.PUSH] = 0.03
    out, power = rates(constants, OWN, np.zeros(4))
    for i, (a, b) in enumerate(((0, 3), (3, 4))):
        kinetic = (c.mass * c.rotating * OWN[:, SPEED] * out[:, SPEED])[a:b].sum()
        stretch = OWN[a : b - 1, POSITION] - OWN[a + 1 : b, POSITION] - c.length[a : b - 1]
        coupler = (c.stiffness[a : b - 1] * stretch * -np.diff(OWN[a:b, SPEED])).sum()
        assert kinetic + coupler == pytest.approx(power[i] @ [1, -1, -1, -1, -1, 1], rel=1e-12)
        assert power[i, 0] > 0.0 and (power[i, [0, 1, 2, 3]] >= 0.0).all()


def test_balanced_forces_give_no_acceleration():
    own = plant.balanced(OWN[:, :2], consists())
    np.testing.assert_allclose(rates(made(), own, own[:, FORCE])[0][:, SPEED], 0.0, atol=1e-15)


def test_standstill_is_held_and_left_forward_only():
    own = plant.balanced(np.array([[1000.0, 0.0], [974.0, 0.0], [950.0, 0.0], [500.0, 0.0]]), consists())
    np.testing.assert_array_equal(own[:, FORCE], 0.0)
    own[3, FORCE] = -1e4
    assert rates(made(), own, np.zeros(4))[0][3, SPEED] == 0.0
    own[3, FORCE] = 1e4
    assert rates(made(), own, np.zeros(4))[0][3, SPEED] > 0.0


def test_limits_are_effort_and_power_of_each_unit():
    constants = made(
        traction=np.full(4, 8e4), braking=np.full(4, 6e4), traction_power=np.full(4, 1e6), braking_power=np.full(4, 9e5)
    )
    applied = np.array([9e4, -9e4, 4e4])
    assert plant.limit(0, constants, OWN[:3], applied)
    np.testing.assert_allclose(applied, [1e6 / 20.0, -9e5 / 21.0, 4e4])
    assert not plant.limit(0, constants, OWN[:3], applied)


def test_windows_are_open_as_within_the_step_and_the_phase_counts_from_time_zero():
    wave = fault(kind="sinusoid", omega_rad_per_s=2.0, phase_rad=0.5)
    table = tabulated([fault(), wave], ("1", "2"), consists())
    for inside, expected in ((9.9, 0.0), (10.1, 2e5 + 2e5 * math.cos(20.5)), (20.1, 0.0)):
        assert fault_rate(table, 1, 10.0, inside) == pytest.approx(expected)
    assert fault_rate(table, 0, 15.0, 15.0) == 0.0
    np.testing.assert_array_equal(breaks([fault(), fault(start_s=0.0, end_s=None), fault(start_s=4.0)]), [4.0, 10.0, 20.0])


def test_effectiveness_holds_in_its_window_and_what_is_lost_is_logged_as_a_fault():
    loss = {"kind": "effectiveness", "amplitude_n_per_s": None}
    table = tabulated(
        [fault(**loss, effectiveness=0.0), fault(**loss, effectiveness=0.5, start_s=20.0, end_s=30.0)], ("1", "2"), consists()
    )
    assert [effectiveness(table, 1, t) for t in (5.0, 15.0, 20.0, 30.0)] == [1.0, 0.0, 0.5, 1.0]
    lost = plant.fault(made([fault(**loss, effectiveness=0.0)]), 15.0, np.full(4, 1e4))
    np.testing.assert_allclose(lost, [0.0, -40.0 * 1e4 / 6e4, 0.0, 0.0])


def test_noise_is_a_pure_function_of_seed_and_sample():
    params = plant.Params(noise_variance_m2_per_s6=0.5)
    draws = np.array([plant.noise(params, 3, k, 9) for k in range(2000)])
    np.testing.assert_array_equal(plant.noise(params, 3, 1234, 9), draws[1234])
    assert (plant.noise(params, 4, 1234, 9) != draws[1234]).all()
    assert draws.var() == pytest.approx(0.5, rel=0.05)  # 18000 samples: standard error 1 %
    assert abs(draws.mean()) < 0.02
    assert abs(np.mean(draws[1:] * draws[:-1])) < 0.02
    constants = made()
    constants.units[:, plant.NOISE] = draws[0, :4]
    extra = rates(constants, OWN, np.zeros(4))[0] - rates(made(), OWN, np.zeros(4))[0]
    np.testing.assert_allclose(extra[:, FORCE], draws[0, :4] * consists().mass * consists().rotating)


def test_noise_is_independent_between_units_and_samples():
    """Any two of 12 carriages, lags 0 to 20: below 0.035 over 40 000 samples, seven standard errors."""
    names = plant.named(("a", "b", "c", "d"), np.array([0, 3, 6, 9, 12]))
    drawn = draws.normal(1, draws.NOISE, np.arange(40_000), names)
    np.testing.assert_array_equal(plant.noise(plant.Params(noise_variance_m2_per_s6=1.0), 1, 777, names), drawn[777])
    drawn = (drawn - drawn.mean(axis=0)) / drawn.std(axis=0)
    for lag in range(21):
        found = drawn[: len(drawn) - lag].T @ drawn[lag:] / (len(drawn) - lag)
        assert np.abs(found - (np.eye(12) if lag == 0 else 0.0)).max() < 0.035


def test_other_trains_and_their_order_change_nobody_s_noise():
    c = consists()
    one, other = (
        plant.constants(plant.Params(), c._replace(first=np.array(first)), trains=trains).names
        for first, trains in (([0, 2, 4], ("1", "2")), ([0, 1, 2, 4], ("2", "7", "1")))
    )
    assert {tuple(row) for row in one[:2]} <= {tuple(row) for row in other[2:]}
    assert tuple(one[2]) == tuple(other[0]) and len({tuple(row) for row in other}) == 4


@pytest.mark.parametrize(
    "keys, words",
    [
        ({"end_s": 10.0}, "window ends before it starts"),
        ({"amplitude_n_per_s": None}, "amplitude_n_per_s is missing"),
        ({"omega_rad_per_s": 1.0}, "omega_rad_per_s does not belong to constant"),
        ({"kind": "effectiveness", "amplitude_n_per_s": None, "effectiveness": 1.5}, "less than or equal to 1"),
        ({"kind": "stuck"}, "constant"),
        ({"unit": 0}, "greater than or equal to 1"),
    ],
)
def test_fault_refuses(keys, words):
    with pytest.raises(ValidationError, match=words):
        fault(**keys)


def test_violations_name_unknown_units_and_windows_that_overlap_themselves():
    faults = [
        fault(), fault(start_s=19.0, end_s=25.0), fault(start_s=20.0, end_s=22.0, train=9), fault(unit=4),
        fault(kind="sinusoid", omega_rad_per_s=1.0, phase_rad=0.0), fault(kind="sinusoid", omega_rad_per_s=2.0, phase_rad=0.0),
        fault(unit=1, end_s=None), fault(unit=1, start_s=1000.0, end_s=1001.0),
    ]  # fmt: skip
    found = violations(faults, ("1", "2"), consists())
    assert [line.split(":")[0] for line in found] == [
        "fault[3].train = 9", "fault[4].unit = 4", "fault[2].start_s = 19", "fault[8].start_s = 1000",
    ]  # fmt: skip
    assert "overlaps fault[1], 10 to 20 s" in found[2]
    assert violations([fault(), fault(start_s=20.0, end_s=30.0)], ("1", "2"), consists()) == []


def test_plant_needs_actuators_and_noise_on_the_integrators_grid():
    c = consists(actuator_rate=np.array([50.0, 0.0, 50.0, 30.0]))
    none = np.zeros(0)
    links = Links(none.astype(int), none.astype(int), np.zeros(3, int), none, none, none, none, none > 0, np.zeros(2), np.arange(2))
    b = np.full(2, INF)
    scene = Scene(
        ("1", "2"), c, OWN, links, Bounds(-b, b, -b, b), Reference(np.array([0.0, INF]), np.zeros((1, 2))), 0.0, 1.0, 1.0, 0.5, 0.03
    )
    found = plant.violations(plant.Params(noise_variance_m2_per_s6=0.5), scene, [fault()])
    assert len(found) == 3
    assert "has no actuator" in found[0] and "must be above 0 for train 1" in found[1] and "multiple" in found[2]


def test_units_without_limits_may_fail_altogether():
    """0 of an infinite force is none: train 1 still pulls with its others, train 2 has no other."""
    failed = [fault(kind="effectiveness", amplitude_n_per_s=None, effectiveness=0.0, unit=u, train=t) for t, u in ((1, 2), (2, 1))]
    found = plant.relied_on(plant.Params(), consists(), failed, ("1", "2"), 0.5, np.full(2, 30.0), np.zeros(2), 6.0)
    assert found.pull.tolist() == [INF, 0.0]
    assert 0.0 < found.braking[0] < 0.5 and found.braking[1] == 0.0
