"""Point plant: the printed maps, the order of clamps and disturbances, the lead of held accelerations."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from trainctl.plants import point
from trainctl.signals import Consists, Floats

DAVIS = (1.176e-2, 7.7616e-4, 1.6e-5)
NONE = point.Kick.none(3)


def consists(units: tuple[int, ...], mass: list[float], davis: Floats) -> Consists:
    o, inf = np.zeros(len(mass)), np.full(len(mass), np.inf)
    first = np.concatenate([[0], np.cumsum(units)])
    return Consists(first, o, np.array(mass), o + 1, davis, o, o, inf, inf, inf, inf, o)


def plant(trains: int = 3, **clamps: float) -> point.Constants:
    return point.constants(point.Params(**clamps), consists((1,) * trains, [1.0] * trains, np.tile(DAVIS, (trains, 1))))


def test_undisturbed_step_is_equation_1() -> None:
    own = np.array([[24000.0, 85.0], [0.0, 0.0], [-50.0, 76.5]])
    a, T = np.array([-1.5, 0.25, 3.0]), 0.8
    moved = point.advance(plant(), own, a, T, NONE)
    for i, (x, v) in enumerate(own):
        f = DAVIS[0] + DAVIS[1] * v + DAVIS[2] * v**2
        u = f + a[i]
        assert moved.own[i, 0] == x + v * T
        assert moved.own[i, 1] == v + u * T - f * T
        assert moved.input[i] == u
        assert moved.displacement[i] == v * T
    assert not moved.limited.any()
    assert not moved.clipped.any()


def test_published_resistance() -> None:
    f = point.resistance(np.array([75.0, 80.0, 85.0]), np.tile(DAVIS, (3, 1)))
    np.testing.assert_allclose(f, [0.159972, 0.1762528, 0.1933336], atol=5e-8)


def test_clamps_and_disturbances_act_in_the_order_of_equation_4() -> None:
    p = plant(input_lower_mps2=-2.0, input_upper_mps2=2.0, speed_lower_mps=0.0, speed_upper_mps=85.0)
    own = np.array([[0.0, 80.0], [0.0, 84.9], [0.0, 0.05]])
    kick = point.Kick(np.array([0.1, 0.1, 0.1]), np.array([0.1, 0.2, -0.2]), np.array([0.01, 0.01, 0.01]))
    r = point.resistance(own[:, 1], p.davis)
    moved = point.advance(p, own, np.array([5.0, 1.0, 0.0]), 0.8, kick)
    # train 1: the input is clamped after w3 came in; drag and w2 come after the clamp
    assert moved.input[0] == 2.0
    assert moved.own[0, 1] == pytest.approx(80.0 + 0.8 * (2.0 - r[0]) + 0.1, abs=1e-12)
    # train 2: the speed is clamped last, the input applied stays what it is
    assert moved.input[1] == pytest.approx(r[1] + 1.0 + 0.01, abs=1e-12)
    assert moved.own[1, 1] == 85.0
    assert moved.own[2, 1] == 0.0
    np.testing.assert_allclose(moved.displacement, 0.8 * own[:, 1] + 0.1, atol=1e-12)
    assert moved.limited.tolist() == [True, True, True]
    assert not point.advance(p, own, np.zeros(3), 0.8, NONE).limited.any()


def test_a_wrong_belief_about_resistance_shows_in_the_speed_alone() -> None:
    units = consists((1, 1, 1), [1.0] * 3, np.tile(DAVIS, (3, 1)))
    p = point.constants(point.Params(), units, resistance_factor=np.array([1.0, 1.2, 0.8]))
    own = np.tile([0.0, 85.0], (3, 1))
    moved = point.advance(p, own, np.zeros(3), 1.0, NONE)
    np.testing.assert_allclose(moved.own[:, 1] - 85.0, [0.0, -0.2 * 0.1933336, 0.2 * 0.1933336], atol=1e-7)
    np.testing.assert_array_equal(moved.input, moved.input[0])


def test_a_train_never_moves_backwards() -> None:
    own = np.array([[10.0, -0.5], [10.0, 0.0], [10.0, 0.2]])
    kick = point.Kick(np.array([0.0, -0.1, -0.1]), np.zeros(3), np.zeros(3))
    moved = point.advance(plant(), own, np.zeros(3), 1.0, kick)
    np.testing.assert_allclose(moved.displacement, [0.0, 0.0, 0.1], atol=1e-15)
    np.testing.assert_allclose(moved.own[:, 0], [10.0, 10.0, 10.1])
    assert moved.clipped.tolist() == [True, True, False]


@pytest.mark.parametrize("steps", [1, 2, 5, 10, 50])
def test_lead_is_that_of_the_held_acceleration(steps: int) -> None:
    p, period, a = plant(1), 2.0, np.array([0.7])
    own = np.array([[100.0, 60.0]])
    for _ in range(steps):
        own = point.advance(p, own, a, period / steps, point.Kick.none(1)).own
    theta = point.lead(steps)
    assert own[0, 1] == pytest.approx(60.0 + 0.7 * period, abs=1e-12)
    assert own[0, 0] == pytest.approx(100.0 + ((1 - theta) * 60.0 + theta * own[0, 1]) * period, abs=1e-11)
    assert (theta == 0.0) == (steps == 1)


def test_units_of_a_train_weigh_in_by_mass() -> None:
    davis = np.array([[1.0, 0.0, 0.0], [4.0, 0.2, 0.0], [5.0, 0.0, 0.3]])
    p = point.constants(point.Params(), consists((2, 1), [3.0, 1.0, 7.0], davis))
    np.testing.assert_allclose(p.davis, [[1.75, 0.05, 0.0], [5.0, 0.0, 0.3]])
    assert np.isinf([p.input_lower, p.input_upper, p.speed_lower, p.speed_upper]).all()


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"speed_lower_mps": 85.0, "speed_upper_mps": 85.0}, "must be above speed_lower_mps = 85"),
        ({"input_lower_mps2": 1.0, "input_upper_mps2": -1.0}, "must be above input_lower_mps2 = 1"),
        ({"speed_top_mps": 85.0}, "Extra inputs"),
        ({"speed_upper_mps": "85"}, "valid number"),
        ({"speed_upper_mps": float("inf")}, "finite"),
    ],
)
def test_keys_are_checked(keys: dict[str, object], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        point.Params.model_validate(keys)
