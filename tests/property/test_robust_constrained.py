"""The robust constrained loop on any strongly connected graph, any gains and any bounded disturbance."""

from __future__ import annotations

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from trainctl.controllers import robust_constrained as law
from trainctl.controllers import robust_gain
from trainctl.plants import disturbance, point
from trainctl.scenario.reference import constant
from trainctl.signals import POSITION, SPEED, Bounds, Consists, Floats, Links, Scene, Trains

V0, T = 80.0, 0.8
CLAMPS = point.Params(input_lower_mps2=-2.0, input_upper_mps2=2.0, speed_lower_mps=0.0, speed_upper_mps=85.0)


def scene_of(weight: Floats, own: Floats, steps: int) -> Scene:
    """``weight[i, j]`` is how much train i hears train j, 0 if not."""
    n = len(weight)
    receiver, sender = np.nonzero(weight)
    slot = -8000.0 * np.arange(n)
    one, free, m = np.ones(n), np.full(n, np.inf), len(sender)
    return Scene(
        trains=[str(i + 1) for i in range(n)],
        consists=Consists(
            np.arange(n + 1), 0 * one, 8e4 * one, one, np.tile([1.176e-2, 7.7616e-4, 1.6e-5], (n, 1)), 0 * one, 0 * one,
            free, free, free, free, 0 * one,
        ),
        own=own,
        links=Links(
            sender, receiver, np.searchsorted(receiver, np.arange(n + 1)), slot[sender] - slot[receiver],
            np.full(m, -np.inf), np.full(m, np.inf), weight[receiver, sender], np.ones(m, bool), slot, np.arange(n),
        ),
        bounds=Bounds(0 * one, 85.0 * one, -2.0 * one, 2.0 * one), reference=constant(V0, 0.0), time=0.0, step=T / steps,
        control_period=T, lead=point.lead(steps), sub_step=T / steps,
    )  # fmt: skip


@st.composite
def cases(draw: st.DrawFn) -> tuple[law.Params, Scene, np.random.Generator]:
    """A strongly connected graph: a random cycle through all trains and some more links; own gain of every train."""
    n, rng = draw(st.integers(2, 6)), np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    weight = rng.uniform(0.002, 0.02, (n, n)) * (rng.random((n, n)) < draw(st.floats(0.0, 1.0)))
    ring = rng.permutation(n)
    weight[ring, np.roll(ring, 1)] = rng.uniform(0.002, 0.02, n)
    np.fill_diagonal(weight, 0.0)
    formation = np.column_stack((-8000.0 * np.arange(n), np.full(n, V0)))
    params = law.Params(h_per_s=tuple(rng.uniform(0.25, 0.8, n).tolist()))
    return params, scene_of(weight, formation, draw(st.sampled_from([1, 1, 3]))), rng


def run(params: law.Params, scene: Scene, acting: Floats) -> tuple[Floats, Floats, Floats, bool]:
    """States and inputs under disturbances (steps, 5, n), and whether a clamp ever acted."""
    constants, plant, own = law.constants(params, scene), point.constants(CLAMPS, scene.consists), scene.own
    held = round(scene.control_period / scene.step)
    states, inputs, limited = [own], [], False
    demand = np.zeros(len(own))
    for k, (w1, w2, w3, share, measured) in enumerate(acting):
        leader = np.array([V0 * k * scene.step, V0, 0.0, 0.0])
        if k % held == 0:
            trains = Trains(own[:, POSITION] + measured, own[:, SPEED], np.zeros(len(own)))
            sent = law.message(constants, trains, leader)
            demand = law.demand(constants, trains, leader, scene.links, sent[scene.links.sender]).acceleration
        here = plant._replace(resistance_factor=1.0 + share)
        moved = point.advance(here, own, demand, scene.step, point.Kick(w1, w2, w3))
        own, limited = moved.own, limited or bool(moved.limited.any() or moved.clipped.any())
        states.append(own)
        inputs.append(moved.input)
    table = np.array(states)
    return table[:, :, POSITION], table[:, :, SPEED], np.array(inputs), limited


@settings(max_examples=40)
@given(cases(), st.sampled_from(["noise", "signs", "slow", "constant"]))
def test_no_disturbance_beats_the_l1_bound(case: tuple[law.Params, Scene, np.random.Generator], kind: str) -> None:
    params, scene, rng = case
    n = len(scene.trains)
    assume(not law.violations(params, scene))
    amplitude = rng.uniform(0, 1, (5, n)) * np.array([0.05, 0.05, 0.01, 0.05, 0.5])[:, None]
    steps = 400
    if kind == "slow":
        factor = np.sign(np.sin(np.arange(steps)[:, None, None] * rng.uniform(0.005, 0.3, (5, n)) + rng.uniform(0, 6, (5, n))))
    elif kind == "constant":
        factor = np.broadcast_to(rng.choice([-1.0, 1.0], (5, n)), (steps, 5, n))
    else:
        factor = rng.uniform(-1, 1, (steps, 5, n)) if kind == "noise" else rng.choice([-1.0, 1.0], (steps, 5, n))
    bound = robust_gain.gain(law.gains(params, n), scene, amplitude)
    position, _, _, limited = run(params, scene, factor * amplitude)
    if bound.unsaturated:
        assert not limited  # proved for starts from the formation
    assume(not limited)
    p = position + 8000.0 * np.arange(n)
    for (a, b), most in zip(bound.pairs, bound.error_m, strict=True):
        assert np.abs(p[:, int(a) - 1] - p[:, int(b) - 1]).max() <= most + 1e-6


@settings(max_examples=15)
@given(cases())
def test_constant_disturbances_end_in_the_closed_form(case: tuple[law.Params, Scene, np.random.Generator]) -> None:
    params, scene, rng = case
    n = len(scene.trains)
    assume(not law.violations(params, scene))
    value = rng.uniform(-1, 1, (5, n)) * np.array([0.05, 0.05, 0.01, 0.05, 0.5])[:, None]
    h = law.gains(params, n)
    steady = robust_gain.steady_state(h, scene, value)
    assume(steady.unsaturated)
    loop = robust_gain.loop(h, scene)
    steps = min(int(25 * loop.held / -np.log(robust_gain.radius(loop))), 20000)
    position, speed, _, limited = run(params, scene, np.broadcast_to(value, (steps, 5, n)))
    assume(not limited)
    p = position[-1] + 8000.0 * np.arange(n)
    wanted = [p[int(a) - 1] - p[int(b) - 1] for a, b in steady.pairs]
    np.testing.assert_allclose(steady.error_m, wanted, atol=1e-4)
    np.testing.assert_allclose(speed[-1], steady.speed_mps, atol=1e-5)
    np.testing.assert_allclose((position[-1] - position[-2]) / scene.step, steady.moves_mps, atol=1e-5)


@settings(max_examples=40)
@given(cases(), st.floats(0.0, 20.0))
def test_inputs_and_speeds_stay_in_their_sets_from_anywhere(
    case: tuple[law.Params, Scene, np.random.Generator], size: float
) -> None:
    params, scene, rng = case
    n = len(scene.trains)
    start = np.column_stack((rng.uniform(-1e5, 1e5, n), rng.uniform(0, 85, n)))
    acting = rng.normal(size=(100, 5, n)) * np.array([1.0, 1.0, 1.0, 0.05, 10.0])[:, None] * size
    position, speed, applied, _ = run(params, scene._replace(own=start), acting)
    assert np.all(np.abs(applied) <= 2.0)
    assert np.all((speed >= 0.0) & (speed <= 85.0))
    assert np.all(np.diff(position, axis=0) >= 0.0)


@st.composite
def entries(draw: st.DrawFn) -> disturbance.Disturbance:
    shape = draw(st.sampled_from(["constant", "alternating", "sine", "square", "uniform", "gaussian", "step", "gust", "table"]))
    amplitude = draw(st.floats(0.0, 10.0))
    keys: dict[str, object] = {"on": "speed", "shape": shape, "amplitude_mps": amplitude}
    keys |= {"std_mps": amplitude} if shape == "gaussian" else {}
    keys |= {"period_s": draw(st.floats(0.1, 100.0)), "phase_rad": draw(st.floats(-9, 9))} if shape in ("sine", "square") else {}
    keys |= {"from_s": draw(st.floats(0.0, 100.0))} if shape == "step" or draw(st.booleans()) else {}
    keys |= {"from_m": -50.0, "to_m": draw(st.floats(-49.0, 50.0))} if shape == "gust" or draw(st.booleans()) else {}
    keys |= {"values": tuple(draw(st.lists(st.floats(-1, 1), min_size=1, max_size=20)))} if shape == "table" else {}
    return disturbance.Disturbance(**keys)  # type: ignore[arg-type]


@settings(max_examples=100)
@given(st.lists(entries(), max_size=4), st.integers(0, 2**63), st.integers(0, 500))
def test_a_disturbance_never_exceeds_what_it_says(found: list[disturbance.Disturbance], seed: int, k: int) -> None:
    ids = ["a", "b", "c"]
    signals = disturbance.signals(found, ids, 0.4, seed)
    where = np.array([-60.0, 0.0, 30.0])
    first, again = (disturbance.at(signals, k, 0.4 * k, where) for _ in range(2))
    most = sum((e.maximum(ids)[disturbance.SPEED] for e in found), np.zeros(3))
    assert np.all(np.abs(first.speed) <= most + 1e-9)
    np.testing.assert_array_equal(first.speed, again.speed)
    steady = [e.steady(ids) for e in found]
    if all(s is not None for s in steady):
        np.testing.assert_allclose(first.speed, sum((s[disturbance.SPEED] for s in steady if s is not None), np.zeros(3)))
