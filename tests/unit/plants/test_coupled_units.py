from __future__ import annotations

import numpy as np
import pytest

from trainctl.plants import coupled_units, shared
from trainctl.plants.coupled_units import PUSH, Constants, Params
from trainctl.signals import GRAVITY, POWERS, Consists, Floats

DAVIS = (0.01176, 7.7616e-4, 1.6e-5)


def train(masses: tuple[float, ...] = (80e3, 80e3, 80e3, 80e3), rotating: float = 1.0, limits: bool = True) -> Consists:
    """One train, unit lengths 80, 81, ... m."""
    units = len(masses)
    one = np.ones(units)
    coupled = np.arange(units) < units - 1
    scale = 1.0 if limits else np.inf
    return Consists(
        np.array([0, units]), 80.0 + np.arange(units), np.array(masses), rotating * one, np.tile(DAVIS, (units, 1)),
        1.6e5 * coupled, 600.0 * coupled, 40e3 * scale * one, 2.4e6 * scale * one, 64e3 * scale * one, 5e6 * scale * one,
        np.inf * one,
    )  # fmt: skip


def at(consists: Consists, speed: float, head: float = 1000.0) -> Floats:
    """Couplers at rest, all units at one speed."""
    own = np.empty((len(consists.mass), 2))
    own[:, 0] = head - np.concatenate(([0.0], np.cumsum(consists.length[:-1])))
    own[:, 1] = speed
    return own


def rate(constants: Constants, own: Floats, applied: Floats) -> tuple[Floats, Floats]:
    """Derivative of the state and powers of train 0."""
    out, power = np.full_like(own, np.nan), np.full(len(POWERS), np.nan)
    coupled_units.rate(0, constants, 0.0, 0.0, own, applied, out, power)
    return out, power


def test_motion_is_that_of_equation_4() -> None:
    consists = train((80e3, 60e3, 50e3))
    own = np.array([[1000.0, 70.0], [919.95, 70.2], [838.97, 69.9]])
    u = np.array([30e3, -10e3, 5e3])
    f1 = 1.6e5 * (1000.0 - 919.95 - 80.0) + 600.0 * (70.0 - 70.2)
    f2 = 1.6e5 * (919.95 - 838.97 - 81.0) + 600.0 * (70.2 - 69.9)
    r = DAVIS[0] + DAVIS[1] * own[:, 1] + DAVIS[2] * own[:, 1] ** 2
    expected = (u + np.array([-f1, f1 - f2, f2])) / consists.mass - r
    out, _ = rate(coupled_units.constants(Params(), consists), own, u)
    assert out[:, 0] == pytest.approx(own[:, 1], abs=0.0)
    assert out[:, 1] == pytest.approx(expected, rel=1e-12)


def test_rotating_mass_slows_what_drives_and_what_brakes() -> None:
    light, heavy = train(), train(rotating=1.1)
    own, u = at(light, 50.0), np.full(4, 20e3)
    a, b = (rate(coupled_units.constants(Params(), c), own, u)[0][:, 1] for c in (light, heavy))
    assert 1.1 * b == pytest.approx(a, rel=1e-12)


def test_true_resistance_may_differ_from_the_nominal_one() -> None:
    consists = train()
    factor = np.array([1.2, 1.0, 0.8, 1.0])
    own, idle = at(consists, 80.0), np.zeros(4)
    nominal = rate(coupled_units.constants(Params(), consists), own, idle)[0][:, 1]
    true = rate(coupled_units.constants(Params(), consists, None, factor), own, idle)[0][:, 1]
    assert true == pytest.approx(factor * nominal, rel=1e-12)
    assert nominal == pytest.approx(-0.1762528, abs=1e-12)  # f(80) of the fully distributed paper


def test_a_push_written_between_steps_acts_per_mass() -> None:
    constants = coupled_units.constants(Params(), train())
    own, idle = at(train(), 80.0), np.zeros(4)
    before, _ = rate(constants, own, idle)
    constants.units[:, PUSH] = [0.1, 0.0, -0.2, 0.0]
    after, power = rate(constants, own, idle)
    assert (after - before)[:, 1] == pytest.approx([0.1, 0.0, -0.2, 0.0], abs=1e-15)
    assert power[POWERS.index("disturbance")] == pytest.approx(-0.1 * 80e3 * 80.0)


def test_gradient_is_that_under_each_unit() -> None:
    slopes = np.array([[500.0, 0.01], [900.0, -0.02], [2000.0, 0.0]])
    constants = coupled_units.constants(Params(), train(), slopes)
    own, idle = at(train(), 80.0), np.zeros(4)  # units at 1000, 920, 839, 757 m
    flat, _ = rate(coupled_units.constants(Params(), train()), own, idle)
    hilly, power = rate(constants, own, idle)
    assert (hilly - flat)[:, 1] == pytest.approx(-GRAVITY * np.array([-0.02, -0.02, 0.01, 0.01]), abs=1e-14)
    assert power[POWERS.index("gradient")] == pytest.approx(-0.02 * GRAVITY * 80e3 * 80.0)


@pytest.mark.parametrize(
    ("x", "slope"), [(-1e9, 0.01), (500.0, 0.01), (899.9, 0.01), (900.0, -0.02), (1999.0, -0.02), (2000.0, 0.003), (1e9, 0.003)]
)
def test_slope_holds_from_where_it_begins(x: float, slope: float) -> None:
    assert coupled_units.slope_at(x, np.array([[500.0, 0.01], [900.0, -0.02], [2000.0, 0.003]])) == slope
    assert coupled_units.slope_at(x, np.zeros((0, 2))) == 0.0


@pytest.mark.parametrize(
    ("speed", "asked", "given", "acted"),
    [
        (50.0, 50e3, 40e3, True),  # force
        (80.0, 50e3, 30e3, True),  # power
        (80.0, 29e3, 29e3, False),
        (80.0, 30e3 * (1 + 1e-12), 30e3, False),  # meant to be just the limit
        (80.0, -70e3, -62.5e3, True),  # braking power
        (50.0, -70e3, -64e3, True),  # braking force
        (50.0, -64e3, -64e3, False),
        (0.0, 50e3, 40e3, True),
        (0.0, -70e3, -64e3, True),
    ],
)
def test_force_and_power_limit_traction_and_braking_apart(speed: float, asked: float, given: float, acted: bool) -> None:
    constants = coupled_units.constants(Params(), train())
    applied = np.full(4, asked)
    assert bool(coupled_units.limit(0, constants, at(train(), speed), applied)) is acted
    assert applied == pytest.approx(np.full(4, given), rel=1e-11)


def test_no_limits_where_none_are_stated() -> None:
    constants = coupled_units.constants(Params(), train(limits=False))
    applied = np.array([1e9, -1e9, 1e9, -1e9])
    assert not coupled_units.limit(0, constants, at(train(), 0.0), applied)
    assert not coupled_units.limit(0, constants, at(train(), 80.0), applied)
    assert applied.tolist() == [1e9, -1e9, 1e9, -1e9]


@pytest.mark.parametrize(("slope", "force"), [(0.0, 0.0), (0.03, 0.0), (-0.03, -30e3), (0.03, -30e3), (0.03, 20e3)])
def test_a_stopped_train_stays(slope: float, force: float) -> None:
    constants = coupled_units.constants(Params(), train(), np.array([[0.0, slope]]))
    out, power = rate(constants, at(train(), 0.0), np.full(4, force))
    assert out.tolist() == [[0.0, 0.0]] * 4
    assert power.tolist() == [0.0] * 6


def test_a_stopped_train_starts_when_driven_or_let_go_downhill() -> None:
    uphill, downhill = (coupled_units.constants(Params(), train(), np.array([[0.0, s]])) for s in (0.03, -0.03))
    assert rate(uphill, at(train(), 0.0), np.full(4, 30e3))[0][:, 1] == pytest.approx(np.full(4, 30e3 / 80e3 - 0.03 * GRAVITY))
    assert rate(downhill, at(train(), 0.0), np.zeros(4))[0][:, 1] == pytest.approx(np.full(4, 0.03 * GRAVITY))


@pytest.mark.parametrize("slope", [-0.02, 0.0, 0.02])
def test_braking_ends_at_standstill(slope: float) -> None:
    constants = coupled_units.constants(Params(), train(), np.array([[0.0, slope]]))
    own, brakes, h = at(train(), 2.0), np.full(4, -64e3), 0.01
    places = []
    for _ in range(1000):
        k1 = rate(constants, own, brakes)[0]
        k2 = rate(constants, own + 0.5 * h * k1, brakes)[0]
        k3 = rate(constants, own + 0.5 * h * k2, brakes)[0]
        k4 = rate(constants, own + h * k3, brakes)[0]
        own = own + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        places.append(own[0, 0])
    assert np.abs(own[:, 1]).max() < 1e-12
    assert max(places) - places[-1] < 1e-3  # what a sub-step overshoots
    assert places[-1] == places[-200]


def demand(constants: shared.Constants, own: Floats) -> Floats:
    """Unit forces train 0 asks for."""
    out, row, table = np.full(len(own), np.nan), np.zeros(0), np.zeros((0, 0))
    shared.demand(0, constants, np.zeros(4), 0.0, 0.0, own, table, table, row, table, out)
    return out


def test_shared_forces_give_every_unit_the_held_acceleration() -> None:
    consists = train((80e3, 60e3, 50e3), rotating=1.08, limits=False)
    slopes = np.array([[0.0, 0.01], [900.0, -0.02]])
    held = shared.constants(Params(), consists, slopes)
    held.acceleration[:] = 0.3
    own = at(consists, 70.0)
    out, _ = rate(coupled_units.constants(Params(), consists, slopes), own, demand(held, own))
    assert out[:, 1] == pytest.approx([0.3, 0.3, 0.3], abs=1e-14)


def test_pairs_of_forces_do_not_move_the_train() -> None:
    consists = train(limits=False)
    held = shared.constants(Params(), consists)
    own = at(consists, 70.0)
    rest = demand(held, own)
    own[1, 0] += 0.02
    own[3, 0] -= 0.05
    pulled = demand(held, own)
    assert np.abs(pulled - rest).max() > 1e3
    assert pulled.sum() == pytest.approx(rest.sum(), rel=1e-12)
    assert (pulled - rest)[3] == pytest.approx(80e3 * 6.0 * 0.05)  # towards the unit ahead


def test_pairs_give_way_to_the_limits() -> None:
    consists = train()
    held, plant = shared.constants(Params(), consists), coupled_units.constants(Params(), consists)
    held.acceleration[:] = 28e3 / 80e3 - 0.1762528  # of 30 kN at 80 m/s
    own = at(consists, 80.0)
    own[3, 0] -= 0.05
    out = demand(held, own)
    assert out.sum() == pytest.approx(4 * 28e3, rel=1e-12)
    assert out.max() == pytest.approx(30e3, rel=1e-12)
    assert not coupled_units.limit(0, plant, own, out)
    held.acceleration[:] = 0.5  # beyond what the units can do: no room for pairs at all
    assert demand(held, own) == pytest.approx(np.full(4, 80e3 * (0.5 + 0.1762528)))


def test_no_pairs_without_gains() -> None:
    consists = train()
    held = shared.constants(Params(in_train_stiffness_per_s2=0.0, in_train_damping_per_s=0.0), consists)
    own = at(consists, 80.0)
    own[3, 0] -= 0.05
    assert demand(held, own) == pytest.approx(np.full(4, 80e3 * 0.1762528))


def test_room_and_smallest_period_of_the_default_train() -> None:
    """Band 79 to 85 around 80 m/s, units of 80 t, 40 kN, 2.4 MW, 64 kN: 6.27 s."""
    one = np.ones(1)
    consists = train()._replace(braking_power=np.full(4, np.inf))
    mu, most = coupled_units.room(consists, 79.0 * one, 85.0 * one)
    assert mu == pytest.approx([-0.8])
    assert most == pytest.approx([2.4e6 / 85.0 / 80e3])
    period = shared.smallest_period(consists, 80.0 * one, 79.0 * one, 85.0 * one)
    assert period == pytest.approx([1.0 / (2.4e6 / 85.0 / 80e3 - 0.1933336)])
    assert period == pytest.approx([6.27], abs=5e-3)


def test_the_weakest_unit_decides() -> None:
    one = np.ones(1)
    consists = train((80e3, 80e3, 80e3, 90e3))
    _, most = coupled_units.room(consists, 79.0 * one, 85.0 * one)
    assert most == pytest.approx([2.4e6 / 85.0 / 90e3])
    consists.braking_power[1] = 64e3 * 40.0
    mu, _ = coupled_units.room(consists, 79.0 * one, 85.0 * one)
    assert mu == pytest.approx([-64e3 * 40.0 / 85.0 / 80e3])


def test_rotating_mass_takes_its_share_of_the_room() -> None:
    one = np.ones(1)
    consists = train(rotating=1.1)
    mu, most = coupled_units.room(consists, 79.0 * one, 85.0 * one)
    held, plant = shared.constants(Params(), consists), coupled_units.constants(Params(), consists)
    for speed in (79.0, 82.0, 85.0):
        own = at(consists, speed)
        for bound in (mu[0], most[0]):
            held.acceleration[:] = bound - shared.mean_resistance(consists, speed * one)
            assert not coupled_units.limit(0, plant, own, demand(held, own))
    assert demand(held, own) == pytest.approx(np.full(4, 2.4e6 / 85.0), rel=1e-12)  # and not less than there is


def test_no_period_where_the_units_cannot_hold_the_band() -> None:
    one = np.ones(1)
    consists = train()._replace(traction_power=np.full(4, 1.2e6))
    assert shared.smallest_period(consists, 80.0 * one, 79.0 * one, 85.0 * one).tolist() == [np.inf]
    assert np.isfinite(shared.smallest_period(consists, 60.0 * one, 59.0 * one, 62.0 * one)).all()


def test_unlimited_units_leave_no_smallest_period() -> None:
    one = np.ones(1)
    assert shared.smallest_period(train(limits=False), 80.0 * one, 79.0 * one, 85.0 * one).tolist() == [0.0]
    assert coupled_units.room(train(limits=False), 0.0 * one, 85.0 * one)[1].tolist() == [np.inf]


def test_unbounded_speed_leaves_nothing_to_say() -> None:
    one = np.ones(1)
    assert [bound.tolist() for bound in coupled_units.room(train(), -np.inf * one, np.inf * one)] == [[-np.inf], [np.inf]]
    assert shared.smallest_period(train(), 80.0 * one, 79.0 * one, np.inf * one).tolist() == [np.inf]


def motor_cars(**more: object) -> Consists:
    """Motor car, two trailers, motor car; brakes in every car, half as strong in the trailers."""
    ends = np.array([80e3, 0.0, 0.0, 80e3])
    return train()._replace(
        traction=ends,
        traction_power=4.8e6 * np.ones(4),
        braking=np.array([60e3, 30e3, 30e3, 60e3]),
        installed=np.ones(4, bool),
        **more,
    )


def demanded(consists: Consists, own: Floats, acceleration: float) -> Floats:
    constants, out = shared.constants(Params(), consists), np.full(len(own), np.nan)
    constants.acceleration[:] = acceleration
    nothing = np.zeros((0, 0))
    shared.demand(0, constants, np.zeros(4), 0.0, 0.0, own, nothing, nothing, np.zeros(0), nothing, out)
    return out


@pytest.mark.parametrize("acceleration", [0.2, -0.1, -0.5])
def test_by_installed_force_each_unit_gives_the_same_part_of_what_it_has(acceleration: float) -> None:
    consists = motor_cars()
    own = at(consists, 70.0)
    own[1, 0] += 0.03  # couplers that carry load change nothing: there are no pairs of forces
    force = demanded(consists, own, acceleration)
    r = DAVIS[0] + DAVIS[1] * 70.0 + DAVIS[2] * 70.0**2
    assert force.sum() == pytest.approx(consists.mass.sum() * (acceleration + r))
    parts = [0.5, 0.0, 0.0, 0.5] if acceleration + r > 0 else [1 / 3, 1 / 6, 1 / 6, 1 / 3]
    assert force / force.sum() == pytest.approx(parts)
    assert demanded(consists._replace(installed=np.zeros(4, bool)), at(consists, 70.0), acceleration) == pytest.approx(
        consists.mass * (acceleration + r)
    )  # by mass


def test_by_installed_force_a_train_gives_all_that_it_has() -> None:
    consists, band = motor_cars(), (np.array([60.0]), np.array([80.0]))
    low, high = coupled_units.room(consists, *band)
    assert high == pytest.approx(2 * 4.8e6 / 80.0 / 320e3)
    assert low == pytest.approx(-180e3 / 320e3)
    by_mass = coupled_units.room(consists._replace(installed=np.zeros(0, bool)), *band)
    assert by_mass[0] == pytest.approx(-30.0 / 80.0) and by_mass[1] < 0.1  # the weakest unit decides
    relied = [
        float(coupled_units.relied_on(Params(), c, (), ("1",), b, np.array([80.0]), np.zeros(1), 3.0).braking[0])
        for c in (consists, consists._replace(installed=np.zeros(0, bool))) for b in (0.3, 0.5, 0.9)
    ]  # fmt: skip
    assert relied == pytest.approx([0.3, 0.5, 180e3 / 320e3, 0.3, (2 * 40e3 + 2 * 30e3) / 320e3, 180e3 / 320e3])
