"""Every plant keeps the same contract, found by its ``relied_on``; those of units and those of points have one of their own besides."""

from __future__ import annotations

from copy import deepcopy
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from units import ROWS, TRAINS, arrays, at_rest, disturbed, modules, moved, others, rows

from trainctl import plants
from trainctl.plants import coupled_units, point
from trainctl.plants.faults import Fault
from trainctl.scenario.tables import BoundsTable
from trainctl.signals import FORCE, POSITION, POWERS, SPEED, Consists, Floats, Scene

ALL = modules(plants, "relied_on")
PLANTS = {name: module for name, module in ALL.items() if module.UNITS}


@pytest.fixture(params=sorted(PLANTS))
def plant(request: pytest.FixtureRequest) -> Any:
    return PLANTS[request.param]


def moving(plant: Any, scene: Scene, applied: Floats) -> tuple[Floats, Floats]:
    """Rates of the units and powers of the trains."""
    constants = plant.constants(plant.Params(), scene.consists)
    rate, power = np.zeros_like(scene.own), np.zeros((TRAINS, len(POWERS)))
    for i in range(TRAINS):
        plant.rate(i, constants, 0.0, 0.0, scene.own[rows(i)], applied[rows(i)], rate[rows(i)], power[i])
    return rate, power


def case(plant: Any) -> tuple[Scene, Floats]:
    """A disturbed scene and forces of either sign."""
    return disturbed(at_rest(plant.STATES)), np.random.default_rng(1).uniform(-3e4, 5e4, ROWS)


def acting(plant: Any, scene: Scene, applied: Floats) -> Floats:
    """Forces that move the units now, shape (U,)."""
    return scene.own[:, FORCE] if plant.STATES > FORCE else applied


def energy(scene: Scene) -> Floats:
    """Of motion and of couplers, shape (n,) [J]."""
    c, own = scene.consists, scene.own
    stretch = np.append(own[:-1, POSITION] - own[1:, POSITION], 0.0) - c.length
    per_unit = 0.5 * c.mass * c.rotating * own[:, SPEED] ** 2 + 0.5 * np.where(c.stiffness > 0.0, c.stiffness * stretch**2, 0.0)
    return np.add.reduceat(per_unit, c.first[:-1])


def test_there_are_plants() -> None:
    assert {"coupled_units", "actuated_units"} <= set(PLANTS) and "point" in set(ALL) - set(PLANTS)


def test_shapes_finite_and_no_objections(plant: Any) -> None:
    scene, applied = case(plant)
    assert plant.violations(plant.Params(), scene, ()) == []
    assert scene.own.shape == (ROWS, plant.STATES)
    assert all(np.isfinite(a).all() for a in moving(plant, scene, applied))
    still = scene._replace(own=scene.own * np.array([1.0, 0.0, 1.0])[: plant.STATES])
    assert all(np.isfinite(a).all() for a in moving(plant, still, applied))


def test_repeatable_and_inputs_untouched(plant: Any) -> None:
    given = case(plant)
    kept = deepcopy(given)
    one, two = moving(plant, *given), moving(plant, *given)
    for a, b in (*zip(arrays(one), arrays(two), strict=True), *zip(arrays(given), arrays(kept), strict=True)):
        assert a.tobytes() == b.tobytes()


def test_local(plant: Any) -> None:
    """Another train's state, mass and forces leave the motion of a train bit-identical."""
    scene, applied = case(plant)
    rate, power = moving(plant, scene, applied)
    for i in range(TRAINS):
        pushed = applied.copy()
        pushed[rows(i)] += 1e4
        after, spent = moving(plant, moved(scene, i), pushed)
        assert after[others(i)].tobytes() == rate[others(i)].tobytes()
        assert spent[np.arange(TRAINS) != i].tobytes() == power[np.arange(TRAINS) != i].tobytes()
        assert (after[rows(i)] != rate[rows(i)]).any()


def test_equilibrium_is_held(plant: Any) -> None:
    """Couplers at rest and each unit given what its running resistance takes: nothing is accelerated."""
    scene = at_rest(plant.STATES)
    c = scene.consists
    drag = c.mass * (c.davis @ [1.0, 80.0, 6400.0])
    rate, power = moving(plant, scene, drag)
    np.testing.assert_allclose(rate[:, POSITION], scene.own[:, SPEED], rtol=0.0)
    np.testing.assert_allclose(rate[:, SPEED], 0.0, atol=1e-12)
    np.testing.assert_allclose(rate[:, FORCE:] / c.mass[:, None], 0.0, atol=1e-9)
    np.testing.assert_allclose(power[:, 0], power[:, 2], rtol=1e-12)  # traction is what resistance takes
    np.testing.assert_allclose(power[:, [1, 3, 4, 5]], 0.0, atol=1e-6)


def test_powers_are_the_rate_of_energy(plant: Any) -> None:
    """Also of what couplers damp, here a thousand times as much as usual, or it would not be seen beside the rest."""
    scene, applied = case(plant)
    scene = scene._replace(consists=scene.consists._replace(damping=1e3 * scene.consists.damping))
    scene.own[:, SPEED] += np.random.default_rng(3).uniform(-0.5, 0.5, ROWS)
    rate, power = moving(plant, scene, applied)
    assert (power[:, 3] > 1e4).all()
    dt = 1e-5
    after, before = (energy(scene._replace(own=scene.own + sign * dt * rate)) for sign in (1.0, -1.0))
    np.testing.assert_allclose((after - before) / (2.0 * dt), power @ [1.0, -1.0, -1.0, -1.0, -1.0, 1.0], rtol=1e-5)
    force = np.add.reduceat(acting(plant, scene, applied) * scene.own[:, SPEED], scene.consists.first[:-1])
    np.testing.assert_allclose(power[:, 0] - power[:, 1], force, rtol=1e-12)


def test_limits_are_kept_once_and_for_all(plant: Any) -> None:
    """Within effort and power, told when one acts, and nothing is left to do a second time."""
    bound = {"traction": 4e4, "traction_power": 2.4e6, "braking": 6.4e4, "braking_power": 4e6}
    scene = at_rest(plant.STATES, **{name: np.full(ROWS, value) for name, value in bound.items()})
    constants = plant.constants(plant.Params(), scene.consists)
    kept = scene.own.copy()
    for i, asked in enumerate((1e5, -1e5, 2e4, 0.0)):
        force = np.full(ROWS // TRAINS, asked)
        assert plant.limit(i, constants, scene.own[rows(i)], force) is (abs(asked) > 9e4)
        expected = {1e5: 2.4e6 / 80.0, -1e5: -4e6 / 80.0}.get(asked, asked)
        np.testing.assert_allclose(force, expected, rtol=1e-12)
        again = force.copy()
        assert not plant.limit(i, constants, scene.own[rows(i)], again)
        assert again.tobytes() == force.tobytes()
    assert scene.own.tobytes() == kept.tobytes()


def test_a_plant_that_breaks_the_contract_is_found_out() -> None:
    def lighter(i: int, constants: Any, *rest: Any) -> None:
        coupled_units.rate(i, constants, *rest)
        rest[-2][0, SPEED] += 1e-12 * constants.units[:, 0].sum()

    def forgets(i: int, constants: Any, *rest: Any) -> None:
        coupled_units.rate(i, constants, *rest)
        rest[-1][3] = 0.0  # what couplers damp

    checks = ((lighter, test_local), (lighter, test_equilibrium_is_held), (forgets, test_powers_are_the_rate_of_energy))
    for rate, check in checks:
        with pytest.raises(AssertionError):
            check(SimpleNamespace(**{**vars(coupled_units), "rate": rate}))


# What every plant says of itself


@pytest.fixture(params=sorted(ALL))
def any_plant(request: pytest.FixtureRequest) -> Any:
    return ALL[request.param]


BRAKES = {
    "braking": np.full(ROWS, 4e4),
    "braking_power": np.full(ROWS, 2.4e6),
    "traction": np.full(ROWS, 3e4),
    "traction_power": np.full(ROWS, 1.2e6),
}
TOP = np.array([80.0, 40.0, 60.0, 20.0])


def clamped(plant: Any) -> Any:
    """Its keys, with clamps where it has some."""
    values = {"input_lower_mps2": -0.7, "input_upper_mps2": 0.6, "speed_lower_mps": 0.0, "speed_upper_mps": 90.0}
    return plant.Params(**{key: values[key] for key in plant.CLAMPS})


def test_clamps_are_keys_of_the_plant_and_of_the_bounds(any_plant: Any) -> None:
    assert set(any_plant.CLAMPS) <= any_plant.Params.model_fields.keys() & BoundsTable.model_fields.keys()


def test_faults_are_taken_or_refused(any_plant: Any) -> None:
    scene = at_rest(any_plant.STATES)
    fault = Fault(train=scene.trains[0], unit=2, kind="effectiveness", effectiveness=0.5)
    found = any_plant.violations(any_plant.Params(), scene, [fault])
    if any_plant.STATES > FORCE:
        assert found == []
        assert any_plant.violations(any_plant.Params(), scene, [fault.model_copy(update={"unit": 9})]) != []
    else:
        name = any_plant.__name__.rpartition(".")[2]
        assert found == [f"fault: the plant {name} has no actuators that fail; actuated_units has"]


def test_a_state_to_start_from_accelerates_nothing(any_plant: Any) -> None:
    scene = at_rest()
    own = any_plant.balanced(scene.own, scene.consists)
    assert own.shape == (ROWS, any_plant.STATES)
    np.testing.assert_array_equal(own[:, :2], scene.own)
    if any_plant.STATES > FORCE:
        rate, _ = moving(any_plant, scene._replace(own=own), own[:, FORCE])
        np.testing.assert_allclose(rate[:, SPEED], 0.0, atol=1e-12)


def test_its_lead_is_how_it_moves(any_plant: Any) -> None:
    """Theta of a held acceleration: m Euler steps of points, the exact parabola of units."""
    held, steps, step = 0.4, 5, 0.2
    if any_plant.UNITS:
        way = 0.5 * held * (steps * step) ** 2
    else:
        constants, own = any_plant.constants(any_plant.Params(), consists()), OWN.copy()
        for _ in range(steps):
            own = any_plant.advance(constants, own, np.full(TRAINS, held), step, kick(0.0)).own
        way = own[0, POSITION] - OWN[0, POSITION] - OWN[0, SPEED] * steps * step
    assert any_plant.lead(steps) * held * (steps * step) ** 2 == pytest.approx(way, rel=1e-9)


def test_it_can_brake_as_it_says(any_plant: Any) -> None:
    """Every unit braking with its own share at the maximum speed gives no less, and is not limited; a little more is."""
    scene, params = at_rest(any_plant.STATES, **BRAKES), clamped(any_plant)
    sure = any_plant.sure_braking(params, scene.consists, TOP)
    assert sure.shape == (TRAINS,) and (sure > 0.0).all()
    if not any_plant.UNITS:
        np.testing.assert_allclose(sure, 0.7)
        assert (any_plant.sure_braking(any_plant.Params(), scene.consists, TOP) == np.inf).all()
        return
    constants, own = any_plant.constants(params, scene.consists), scene.own.copy()
    own[:, SPEED] = np.repeat(TOP, ROWS // TRAINS)
    for i in range(TRAINS):
        for share, acts in ((0.999, False), (1.01, True)):
            c, speed = scene.consists, [1.0, TOP[i], TOP[i] ** 2]  # one Davis formula for all, so that is what each unit overcomes
            asked = c.mass[rows(i)] * (-share * sure[i] * c.rotating[rows(i)])
            assert np.ptp(c.davis[rows(i)] @ speed) == 0.0
            assert any_plant.limit(i, constants, own[rows(i)], asked) is acts


def test_what_protection_relies_on(any_plant: Any) -> None:
    scene, params, zero = at_rest(any_plant.STATES, **BRAKES), clamped(any_plant), np.zeros(TRAINS)

    def relied(order: float, fall: Floats, params: Any = params) -> Any:
        found = any_plant.relied_on(params, scene.consists, (), scene.trains, order, TOP, fall, 6.0)
        assert all(a.shape == (TRAINS,) and not np.isnan(a).any() for a in found)
        return found

    gentle, hard = relied(0.1, zero), relied(9.0, zero)
    np.testing.assert_allclose(gentle.braking, 0.1)  # what is ordered, where brakes give it
    assert (hard.braking < 9.0).all() and (hard.braking >= any_plant.sure_braking(params, scene.consists, TOP) - 1e-12).all()
    np.testing.assert_allclose(relied(9.0, zero + 0.2).braking, hard.braking - 0.2)  # descending takes from it
    assert (gentle.bias == 0.0).all() and (gentle.noise == 0.0).all()
    assert (gentle.lag > 0.0).all() == (any_plant.STATES > FORCE) == (gentle.late > 0.0).all()
    assert (gentle.pull > 0.0).all() and np.isfinite(gentle.pull).all()


def test_room_is_what_the_units_can_give(any_plant: Any) -> None:
    scene = at_rest(any_plant.STATES, **BRAKES)
    low, high = any_plant.room(scene.consists, 0.0 * TOP, TOP)
    assert (low < 0.0).all() and (high > 0.0).all() and np.isfinite(low).all() == any_plant.UNITS
    if any_plant.UNITS:  # less in a wider band
        wider = any_plant.room(scene.consists, 0.0 * TOP, 1.5 * TOP)
        assert (wider[0] >= low - 1e-12).all() and (wider[1] <= high + 1e-12).all()
        assert wider[0][0] > low[0] + 0.1 and wider[1][0] < high[0] - 0.05


def test_noise_is_drawn_again_alike_and_can_be_left_out(any_plant: Any) -> None:
    assert any_plant.noise_hold(any_plant.Params()) is None
    if "noise_variance_m2_per_s6" not in any_plant.Params.model_fields:
        return
    scene, params = at_rest(any_plant.STATES), any_plant.Params(noise_variance_m2_per_s6=0.5, noise_hold_s=0.2)
    assert any_plant.noise_hold(params) == 0.2
    constants = any_plant.constants(params, scene.consists)
    still = constants.units.copy()
    drawn = []
    for sample in (3, 4, 3):
        any_plant.make_noise(params, constants, 7, sample)
        drawn.append(constants.units.copy())
    assert (drawn[0] == drawn[2]).all() and (drawn[0] != drawn[1]).any()
    any_plant.make_noise(params, constants, 7, None)
    assert constants.units.tobytes() == still.tobytes()
    assert any_plant.relied_on(params, scene.consists, (), scene.trains, 0.1, TOP, 0.0 * TOP, 6.0).noise.min() > 0.0


def test_a_column_for_every_name(plant: Any) -> None:
    scene, applied = case(plant)
    constants, none = plant.constants(plant.Params(), scene.consists), np.full(ROWS, np.nan)
    found = plant.columns(constants, 0.0, scene.own, applied, none, none)
    assert len(found) == len(plant.COLUMNS) and all(column.shape == (ROWS,) for column in found)
    named = dict(zip(plant.COLUMNS, found, strict=True))
    if "acceleration_mps2" in named:
        np.testing.assert_array_equal(named["acceleration_mps2"], moving(plant, scene, applied)[0][:, SPEED])


# Point trains


def consists() -> Consists:
    """Four point trains of different masses and resistances."""
    o, inf = np.zeros(TRAINS), np.full(TRAINS, np.inf)
    davis = np.array([[0.01, 1e-4, 1e-5], [0.02, 2e-4, 2e-5], [0.015, 0.0, 3e-5], [0.01, 5e-4, 0.0]])
    return Consists(np.arange(TRAINS + 1), o + 100.0, o + 1e5, o + 1.0, davis, o, o, inf, inf, inf, inf, o)


def kick(size: float) -> point.Kick:
    rng = np.random.default_rng(2)
    return point.Kick(*(size * rng.uniform(-1.0, 1.0, (3, TRAINS))))


OWN = np.column_stack([[4000.0, 3000.0, 2000.0, 1000.0], [30.0, 0.0, 80.0, 0.5]])
ASKED = np.array([0.3, -0.2, -1.5, -2.0])


def test_point_trains_shapes_finite_repeatable_and_inputs_untouched() -> None:
    params = point.Params(input_lower_mps2=-1.0, input_upper_mps2=1.0, speed_lower_mps=0.0, speed_upper_mps=85.0)
    given = point.constants(params, consists()), OWN.copy(), ASKED.copy(), 1.0, kick(0.1)
    kept = deepcopy(given)
    one, two = point.advance(*given), point.advance(*given)
    assert one.own.shape == OWN.shape and all(a.shape == (TRAINS,) for a in one[1:])
    assert all(np.isfinite(a).all() for a in one) and (one.displacement >= 0.0).all()
    for a, b in (*zip(arrays(one), arrays(two), strict=True), *zip(arrays(given), arrays(kept), strict=True)):
        assert a.tobytes() == b.tobytes()


def test_point_trains_are_local_and_hold_their_equilibrium() -> None:
    constants = point.constants(point.Params(), consists())
    before = point.advance(constants, OWN, ASKED, 1.0, kick(0.1))
    for i in range(TRAINS):
        own, asked = OWN.copy(), ASKED.copy()
        own[i] += (-77.0, 3.3)
        asked[i] += 0.1
        after = point.advance(constants, own, asked, 1.0, kick(0.1))
        for a, b in zip(after, before, strict=True):
            assert np.delete(a, i, axis=0).tobytes() == np.delete(b, i, axis=0).tobytes()
        assert (after.own[i] != before.own[i]).all()
    held = point.advance(constants, OWN, np.zeros(TRAINS), 1.0, kick(0.0))
    np.testing.assert_allclose(held.own[:, SPEED], OWN[:, SPEED], atol=1e-13)
    np.testing.assert_allclose(held.displacement, OWN[:, SPEED], atol=1e-12)
    assert not held.limited.any() and not held.clipped.any()
