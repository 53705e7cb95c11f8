"""What holds for every train and every state: momentum, energy, limits, held acceleration."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainctl.plants import coupled_units, shared
from trainctl.plants.coupled_units import DAMPING, INERTIA, PUSH, STIFFNESS, Params
from trainctl.signals import POSITION, SPEED, Consists, Floats


@st.composite
def trains(draw: st.DrawFn) -> tuple[Consists, Floats, np.random.Generator]:
    """Two trains of unequal units in motion, couplers near rest."""
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    sizes = [draw(st.integers(1, 9)), draw(st.integers(1, 9))]
    first = np.concatenate(([0], np.cumsum(sizes)))
    units = int(first[-1])
    coupled = np.ones(units)
    coupled[first[1:] - 1] = 0.0

    def some(low: float, high: float) -> Floats:
        return generator.uniform(low, high, units)

    consists = Consists(
        first, some(15.0, 90.0), some(2e4, 1e5), some(1.0, 1.2), generator.uniform(0.0, [0.03, 2e-3, 4e-5], (units, 3)),
        some(1e5, 1e7) * coupled, some(0.0, 1e4) * coupled, some(2e4, 6e4), some(1e6, 3e6), some(3e4, 9e4), some(2e6, 5e6),
        some(1.0, 50.0),
    )  # fmt: skip
    own = np.empty((units, 2))
    own[:, SPEED] = draw(st.floats(1.0, 90.0)) + some(-0.5, 0.5)
    for a, b in pairwise(first):
        own[a:b, POSITION] = 5e3 - np.concatenate(([0.0], np.cumsum(consists.length[a : b - 1] + some(-0.1, 0.1)[a : b - 1])))
    return consists, own, generator


def rates(constants: coupled_units.Constants, own: Floats, applied: Floats) -> tuple[Floats, Floats]:
    """Derivative of all units' states, powers of both trains."""
    out, power = np.empty_like(own), np.empty((2, 6))
    for i in range(2):
        rows = slice(constants.first[i], constants.first[i + 1])
        coupled_units.rate(i, constants, 0.0, 0.0, own[rows], applied[rows], out[rows], power[i])
    return out, power


@given(trains())
def test_coupler_forces_cancel_within_a_train(case: tuple[Consists, Floats, np.random.Generator]) -> None:
    consists, own, generator = case
    constants = coupled_units.constants(Params(), consists, None, np.zeros(len(own)))  # no resistance
    applied = generator.uniform(-5e4, 5e4, len(own))
    out, _ = rates(constants, own, applied)
    inertia = constants.units[:, INERTIA]
    momentum = np.add.reduceat(inertia * out[:, SPEED], consists.first[:-1])
    scale = np.add.reduceat(np.abs(inertia * out[:, SPEED]), consists.first[:-1])
    assert np.all(np.abs(momentum - np.add.reduceat(applied, consists.first[:-1])) < 1e-9 * (scale + 1.0))


@given(trains())
def test_energy_changes_by_the_powers(case: tuple[Consists, Floats, np.random.Generator]) -> None:
    """d/dt (kinetic + coupler energy) from the rates equals the sum of the six powers."""
    consists, own, generator = case
    slopes, factor = np.array([[4e3, 0.01], [4.8e3, -0.03]]), generator.uniform(0.5, 2.0, len(own))
    constants = coupled_units.constants(Params(), consists, slopes, factor)
    constants.units[:, PUSH] = generator.uniform(-0.2, 0.2, len(own))
    applied = generator.uniform(-5e4, 5e4, len(own))
    out, power = rates(constants, own, applied)
    for i in range(2):
        a, b = consists.first[i], consists.first[i + 1]
        kinetic = constants.units[a:b, INERTIA] * own[a:b, SPEED] * out[a:b, SPEED]
        stretch = own[a : b - 1, POSITION] - own[a + 1 : b, POSITION] - consists.length[a : b - 1]
        spring = constants.units[a : b - 1, STIFFNESS] * stretch * -np.diff(own[a:b, SPEED])
        supplied = power[i] @ [1.0, -1.0, -1.0, -1.0, -1.0, 1.0]
        scale = np.abs(kinetic).sum() + np.abs(spring).sum() + np.abs(power[i]).sum()
        assert abs(kinetic.sum() + spring.sum() - supplied) < 1e-11 * scale
        assert power[i, 3] == pytest.approx((constants.units[a : b - 1, DAMPING] * np.diff(own[a:b, SPEED]) ** 2).sum(), rel=1e-9)


@given(trains())
def test_limits_contain_and_only_ever_reduce(case: tuple[Consists, Floats, np.random.Generator]) -> None:
    consists, own, generator = case
    constants = coupled_units.constants(Params(), consists)
    asked = generator.uniform(-2e5, 2e5, len(own))
    given_ = asked.copy()
    for i in range(2):
        rows = slice(consists.first[i], consists.first[i + 1])
        acted = coupled_units.limit(i, constants, own[rows], given_[rows])
        assert bool(acted) == bool(np.any(given_[rows] != asked[rows]))
    v = own[:, SPEED]
    assert np.all(given_ <= np.minimum(consists.traction, consists.traction_power / v))
    assert np.all(-given_ <= np.minimum(consists.braking, consists.braking_power / v))
    assert np.all(np.abs(given_) <= np.abs(asked))
    assert np.all(given_ * asked >= 0.0)


@given(trains(), st.floats(-0.3, 0.2))
def test_shared_forces_sum_to_the_train_s_and_keep_the_limits(
    case: tuple[Consists, Floats, np.random.Generator], acceleration: float
) -> None:
    consists, own, _ = case
    held, plant = shared.constants(Params(), consists), coupled_units.constants(Params(), consists)
    held.acceleration[:] = acceleration
    row, table = np.zeros(0), np.zeros((0, 0))
    v = own[:, SPEED]
    base = consists.mass * (
        consists.rotating * acceleration + consists.davis[:, 0] + consists.davis[:, 1] * v + consists.davis[:, 2] * v**2
    )
    most = np.minimum(consists.traction, consists.traction_power / v)
    minimum = -np.minimum(consists.braking, consists.braking_power / v)
    for i in range(2):
        rows = slice(consists.first[i], consists.first[i + 1])
        out = np.empty(rows.stop - rows.start)
        shared.demand(i, held, np.zeros(4), 0.0, 0.0, own[rows], table, table, row, table, out)
        assert out.sum() == pytest.approx(base[rows].sum(), rel=1e-9, abs=1e-6 * np.abs(out).sum())
        if np.all((base[rows] <= most[rows]) & (base[rows] >= minimum[rows])):
            assert not coupled_units.limit(i, plant, own[rows], out)


@given(trains(), st.floats(-0.3, 0.3))
def test_couplers_at_rest_stay_at_rest_under_a_held_acceleration(
    case: tuple[Consists, Floats, np.random.Generator], acceleration: float
) -> None:
    consists, own, _ = case
    slopes = np.array([[4e3, 0.01], [4.8e3, -0.03]])
    held, plant = shared.constants(Params(), consists, slopes), coupled_units.constants(Params(), consists, slopes)
    held.acceleration[:] = acceleration
    own[:, SPEED] = own[0, SPEED]
    for a, b in pairwise(consists.first):
        own[a:b, POSITION] = 5e3 - np.concatenate(([0.0], np.cumsum(consists.length[a : b - 1])))
    applied, row, table = np.empty(len(own)), np.zeros(0), np.zeros((0, 0))
    for i in range(2):
        rows = slice(consists.first[i], consists.first[i + 1])
        shared.demand(i, held, np.zeros(4), 0.0, 0.0, own[rows], table, table, row, table, applied[rows])
    out, _ = rates(plant, own, applied)
    assert np.abs(out[:, SPEED] - acceleration).max() < 1e-9
