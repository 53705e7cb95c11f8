"""Model predictive control: constraints kept, plans sent, what is not feasible, and how long it takes."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from strings import LENGTH_M, String, first_brakes, scene, state

from trainctl.controllers import ahead
from trainctl.controllers import model_predictive as law
from trainctl.scenario.build import open_scenario

P = law.Params()
N = P.horizon
ROUNDING = 1e-6


def planned(string: String) -> np.ndarray:
    return string.memory[0].plan


def check_plan(string: String, own: np.ndarray, before: np.ndarray, sent: np.ndarray, i: int) -> None:
    """Every constraint of train ``i``'s plan, from the motion of a point step by step."""
    T, plan = string.scene.control_period, planned(string)[i]
    x, v, x_l, v_l = own[i, 0], own[i, 1], own[i - 1, 0], own[i - 1, 1]
    accelerations_l = sent[i - 1, ahead.SAID + 1 :]
    assert np.all(plan >= -0.8 - ROUNDING) and np.all(plan <= P.acceleration_mps2 + ROUNDING)
    assert np.all(np.abs(np.diff(np.concatenate(([before[i]], plan)))) <= P.jerk_mps3 * T + ROUNDING)
    free = own[i - 1, 1]
    for a, a_l in zip(plan, accelerations_l, strict=True):
        x, v = x + v * T, v + a * T
        x_l, free = x_l + v_l * T, free + a_l * T
        v_l = max(free, 0.0)
        assert x_l - x >= LENGTH_M + P.margin_m - ROUNDING
        assert -ROUNDING <= v <= string.scene.bounds.speed_upper[i] + ROUNDING
    v1 = own[i, 1] + plan[0] * T
    stops = own[i, 0] + own[i, 1] * T + v1 * P.reaction_s + v1**2 / 1.6
    assert own[i - 1, 0] + own[i - 1, 1] ** 2 / 1.6 - stops >= LENGTH_M + P.margin_m - ROUNDING


@settings(max_examples=60)
@given(
    spacing=st.floats(250.0, 900.0), v=st.floats(5.0, 48.0), v_l=st.floats(0.0, 48.0), steps=st.integers(0, 12),
    seed=st.integers(0, 2**31),
)  # fmt: skip
def test_a_feasible_plan_keeps_every_constraint(spacing, v, v_l, steps, seed) -> None:
    """From any start: three trains, the second wherever it is, speeds as they come; the first may brake without a word."""
    sc = scene(3, 400.0)
    rng = np.random.default_rng(seed)
    string = String(law, P, sc)
    string.own = np.array([[0.0, v_l], [-spacing, v], [-2.0 * spacing, v * rng.uniform(0.8, 1.0)]])
    string.memory = [string.memory[0]._replace(speed=string.own[:, 1].copy())]
    feasible = 0
    for k in range(steps + 1):
        own, memory = string.own.copy(), string.memory[0]
        off = np.abs((own[:, 1] - memory.speed) - memory.plan[:, 0]) > law.OFF_PLAN_MPS2
        before = np.where(off, own[:, 1] - memory.speed, memory.plan[:, 0])
        sent = law.message(string.constants, state(own), string.leader(), memory)
        found = string.step(first_brakes(3, 0.6) if k % 3 else None)
        for i in (1, 2):
            if found.saturated[i]:
                assert found.acceleration[i] == -min(1.0, own[i, 1])
            else:
                feasible += 1
                check_plan(string, own, before, sent, i)
    assume(feasible)


def test_the_margin_is_kept_over_the_whole_horizon() -> None:
    """A train that minds nothing but changes of its acceleration would run on; the one ahead has planned to brake."""
    lazy = law.Params(spacing_weight=1e-9, speed_weight=1e-9, acceleration_weight=1e-9, change_weight=1.0)
    string = String(law, lazy, scene(2, 400.0))
    string.own = np.array([[0.0, 10.0], [-260.0, 10.0]])
    memory = string.memory[0]._replace(speed=string.own[:, 1].copy())
    heard = law.message(string.constants, state(string.own), string.leader(), memory)[string.scene.links.sender]
    heard[string.constants.who.row[1], ahead.SAID + 1 :] = -0.3
    own, links = state(string.own), string.scene.links
    found, after = law.demand(string.constants, own, string.leader(), links, heard, memory)
    v, v_l = (10.0 + np.cumsum(a) for a in (after.plan[1], np.full(N, -0.3)))
    spacing = 260.0 + np.cumsum(np.concatenate(([10.0], v_l[:-1])) - np.concatenate(([10.0], v[:-1])))
    assert not found.saturated[1]
    assert spacing.min() == pytest.approx(LENGTH_M + lazy.margin_m, abs=1e-6)


def test_where_nothing_is_feasible_a_train_brakes_fully_and_says_so() -> None:
    string = String(law, P, scene(2, 400.0))
    string.own[1, 0] = -(LENGTH_M + 5.0)  # within the margin already
    found = string.step()
    assert found.saturated.tolist() == [False, True]
    assert found.acceleration[1] == -1.0


def test_a_train_that_is_braked_by_somebody_else_sends_that_it_brakes() -> None:
    string = String(law, P, scene(2, 400.0))
    string.step(first_brakes(2, 0.6))
    sent = law.message(string.constants, state(string.own), string.leader(), string.memory[0])
    np.testing.assert_allclose(sent[0, ahead.SAID + 1 :], -0.6)
    np.testing.assert_array_equal(sent[1, ahead.SAID + 1 :], [*planned(string)[1, 1:], 0.0])


def test_behind_a_first_train_that_stops_nobody_comes_within_the_margin() -> None:
    string = String(law, P, scene(4, 300.0))
    for k in range(300):
        string.step(first_brakes(4, 0.8) if k > 5 else None)
        assert np.all(string.spacing >= LENGTH_M + P.margin_m - ROUNDING)
    assert np.all(string.own[:, 1] < 0.1)


def test_what_pushes_does_not_take_it_past_its_maximum_speed() -> None:
    """A force nobody knows of, with the train ahead far away: a bound that gave way each time would let the speed grow for ever."""
    string, fast = String(law, P, scene(2, 400.0)), []
    string.own[1, 0] -= 3000.0
    for _ in range(300):
        string.step(push=0.05)
        fast.append(float(string.own[1, 1]))
    assert max(fast) == pytest.approx(40.0 + 0.6 * 8.0 + 0.05, abs=1e-3)  # the part of the room, and what a period's push adds
    string.own[1, 1] = 50.0  # above the bound: it comes back
    for _ in range(60):
        string.step()
    assert string.own[1, 1] <= 40.0 + 0.6 * 8.0 + ROUNDING


def test_it_takes_at_most_0_3_ms_per_train_and_step() -> None:
    """Six trains that close up and brake: the median over the steps."""
    string, took = String(law, P, scene(6, 350.0)), []
    string.own[:, 0] *= 1.1
    for k in range(200):
        begun = time.perf_counter()
        string.step(first_brakes(6, 0.5) if 60 < k < 90 else None)
        took.append((time.perf_counter() - begun) / 6)
    assert np.median(took) < 0.3e-3


def test_it_goes_on_from_its_state_alone() -> None:
    """The solver keeps nothing between two steps: with fresh constants the same comes out, to the last bit."""
    strings = [String(law, P, scene(5, 350.0)) for _ in range(2)]
    for string in strings:
        string.own[:, 0] *= 1.07
    for k in range(60):
        ordered = first_brakes(5, 0.5) if k > 20 else None
        strings[1].constants = law.constants(P, strings[1].scene)
        a, b = (string.step(ordered) for string in strings)
        assert a.acceleration.tobytes() == b.acceleration.tobytes()


def test_what_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert law.violations(P, scene(2, 400.0)) == []
    assert law.violations(P, scene(2, 280.0)) == [
        "link[1,2].desired_m = 280: must be at least 290 at 40 m/s: one control period and reaction, the difference of braking"
        " distances, the train ahead 200, margin_m 10"
    ]
    monkeypatch.setattr(law, "daqp", None)
    assert law.violations(P, scene(2, 400.0)) == [
        "controller.law = model_predictive: needs the solver DAQP: pip install trainctl[mpc]"
    ]


def test_a_horizon_longer_than_the_run_is_refused() -> None:
    from trainctl.errors import InputError

    with pytest.raises(InputError) as told:
        open_scenario("model_predictive", {"run.duration_s": 15, "controller.horizon": 16})
    assert told.value.mistakes == [
        "model_predictive.toml: controller.horizon = 16: looks 16 s ahead, and the run lasts run.duration_s = 15"
    ]
