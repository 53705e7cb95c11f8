"""Trains as agents: the checks of Gymnasium and PettingZoo, what agents see and do, seeds, and bad input."""

from __future__ import annotations

import numpy as np
import pytest

from trainctl import Simulation
from trainctl.environment.agents import Judged, usual_reward
from trainctl.environment.courses import Agents, Asked
from trainctl.environment.search import improved, linear
from trainctl.errors import InputError

pytest.importorskip("pettingzoo")
from gymnasium import Env
from gymnasium.utils import env_checker
from gymnasium.vector import AutoresetMode
from pettingzoo.test import parallel_api_test, parallel_seed_test

from trainctl.environment.parallel import ParallelTrains
from trainctl.environment.vector import VectorTrains

SHORT = {"event": [], "run.duration_s": 20}
NOISY = {
    **SHORT,
    "topology.loss": 0.3,
    "disturbance": [{"on": "measurement", "shape": "gaussian", "std_m": 5.0}],
}


def vector(scenario="fully_distributed", settings=SHORT, **more):
    return VectorTrains(scenario, **more, **settings)


def zeros(env):
    return np.zeros((env.num_envs, 1), np.float32)


@pytest.mark.parametrize("backend", ["ensemble", "numeric", "sumo"])
@pytest.mark.parametrize("acts", ["acceleration", "on_top"])
def test_gymnasium_s_own_checks(backend, acts):
    """Those of one environment that a vector of them has to stand as well."""
    env = vector(backend=backend, acts=acts, runs=3 if backend == "ensemble" else 1, settings=NOISY)
    assert env.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    env_checker.check_action_space(env.single_action_space)
    env_checker.check_observation_space(env.single_observation_space)
    env_checker.check_seed_deprecation(env)
    env_checker.check_reset_return_info_deprecation(env)
    env_checker.check_reset_return_type(env)
    env_checker.check_reset_options(env)
    env_checker.check_reset_seed_determinism(env)
    assert not isinstance(env, Env)
    obs, _ = env.reset(seed=1)
    assert obs in env.observation_space
    for k in range(20):
        before = obs
        obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert obs in env.observation_space
        assert reward.shape == terminated.shape == truncated.shape == (env.num_envs,)
        assert truncated.all() == (k == 19)
    assert set(info) == set(Judged._fields) and not np.shares_memory(obs, before)
    with pytest.raises(InputError, match="call reset"):
        env.step(zeros(env))
    env.close()


@pytest.mark.parametrize("backend", ["ensemble", "numeric", "sumo"])
def test_pettingzoo_s_own_checks(backend):
    runs = 2 if backend == "ensemble" else 1

    def made():
        return ParallelTrains("fully_distributed", runs=runs, backend=backend, **NOISY)

    env = made()
    assert env.possible_agents[:2] == (["0/1", "0/2"] if runs == 2 else ["1", "2"])
    parallel_api_test(env, num_cycles=30)
    env.close()
    if backend == "ensemble":  # it holds two at once
        parallel_seed_test(made)


def test_the_law_alone_gives_the_run_of_the_loop():
    """Nothing added: agents see the places and speeds of the same run by hand, in SUMO and abreast."""
    with Simulation.open("fully_distributed", backend="numeric", **SHORT) as sim:
        sim.step(20)
        speed = sim.speed_mps
    for backend in ("ensemble", "numeric", "sumo"):
        env = vector(backend=backend, acts="on_top")
        env.reset(seed=1)
        for _ in range(20):
            obs, *_ = env.step(zeros(env))
        np.testing.assert_allclose(obs[:, env.agents.columns.index("speed_mps")], speed, rtol=1e-7)
        env.close()


def test_agents_see_what_the_law_hears():
    """Of the first agents at the start: own place and speed, and the spacing errors of their links one period ahead."""
    env = vector()
    obs, _ = env.reset(seed=1)
    seen = {name: obs[:, k] for k, name in enumerate(env.agents.columns)}
    np.testing.assert_allclose(seen["place_m"][[0, 1]], [0.0, 2000.0], atol=1e-3)  # at 21 km, 5 km behind 24 km
    np.testing.assert_allclose(seen["speed_error_mps"][:3], [5.0, 2.0, 1.0], atol=1e-5)
    assert seen["link_0_came"].tolist() == [1, 1, 1, 1, 0, 1]  # train 5 runs alone
    np.testing.assert_allclose(seen["link_0_error_m"][1], 24085 - 21082 - 5000, atol=1e-2)
    np.testing.assert_allclose(seen["link_1_error_m"][1], 13081 - 21082 + 5000, atol=1e-2)


def test_an_action_is_the_acceleration_or_is_added():
    given = np.linspace(-0.5, 0.5, 6)[:, None]
    bare, law, both = vector(), vector(acts="on_top"), vector(acts="on_top")
    for env in (bare, law, both):
        env.reset(seed=1)
    held, own = bare.step(given)[4]["acceleration_mps2"], law.step(zeros(law))[4]["acceleration_mps2"]
    np.testing.assert_allclose(held, given[:, 0], atol=1e-12)
    np.testing.assert_allclose(both.step(given)[4]["acceleration_mps2"], own + given[:, 0], atol=1e-12)
    assert np.abs(own).max() > 0.1
    np.testing.assert_allclose(bare.step(9.0 + zeros(bare))[4]["acceleration_mps2"], 1.0, atol=1e-12)  # cut off


@pytest.mark.parametrize("acts", ["acceleration", "on_top"])
def test_an_action_holds_for_a_control_period(acts):
    settings = {**SHORT, "run.control_period_s": 2.0}
    env = vector(acts=acts, settings=settings)
    env.reset(seed=1)
    for k in range(10):
        *_, truncated, info = env.step(0.1 + zeros(env))
        assert truncated.all() == (k == 9)
    if acts == "acceleration":
        np.testing.assert_allclose(info["acceleration_mps2"], 0.1, atol=1e-12)


def test_seeds_decide_on_everything_random():
    jitter = {"train.position_m": 50.0}

    def episode(seed, again=1):
        env = vector(runs=3, jitter=jitter, settings=NOISY)
        env.reset(seed=seed)
        for _ in range(again - 1):
            env.reset()
        return np.array([env.step(zeros(env))[0] for _ in range(5)])

    np.testing.assert_array_equal(episode(1), episode(1))
    assert (episode(1) != episode(2)).any() and (episode(1) != episode(1, again=2)).any()
    runs = episode(1).reshape(5, 3, 6, -1)
    assert (runs[:, 0] != runs[:, 1]).any()


def test_who_touches_is_terminated_and_the_others_go_on():
    env = ParallelTrains("fully_distributed", runs=2, limit_mps2=300.0, **SHORT)
    env.reset(seed=1)
    act = dict.fromkeys(env.agents, np.zeros(1, np.float32)) | {"0/4": np.array([300.0], np.float32)}  # runs into train 3
    ended, rewards = {}, {}
    for _ in range(20):
        _, rewards, terminated, _, _ = env.step({name: act[name] for name in env.agents})
        ended |= {name: rewards[name] for name, over in terminated.items() if over}
    assert set(ended) == {f"0/{i}" for i in range(1, 7)} and max(ended.values()) <= -1000.0
    assert set(rewards) == {f"1/{i}" for i in range(1, 7)} and not env.agents


def test_of_a_run_that_is_over_nothing_more_is_seen():
    env = vector(runs=2, limit_mps2=300.0)
    env.reset(seed=1)
    given = zeros(env)
    given[3] = 300.0
    for _ in range(20):
        obs, reward, terminated, _, _ = env.step(given)
    assert terminated.tolist() == [True] * 6 + [False] * 6
    assert not obs[:6].any() and not reward[:6].any() and obs[6:].any() and reward[6:].any()


def test_a_reward_of_one_s_own():
    env = vector(reward=lambda judged: judged.margin_m)
    env.reset(seed=1)
    *_, reward, _, _, info = (*env.step(zeros(env)),)[:5]
    np.testing.assert_array_equal(reward, info["margin_m"])
    zero = np.zeros(2)
    worse = usual_reward(Judged(zero + [0.0, 100.0], zero, zero, zero, np.array([False, False])))
    assert worse.tolist() == [0.0, -1.0]


def test_a_run_in_sumo_leaves_its_folder(tmp_path):
    env = vector(backend="sumo", out=tmp_path / "run", settings={"event": [], "run.duration_s": 3})
    env.reset(seed=1)
    for _ in range(3):
        env.step(zeros(env))
    env.close()
    assert (tmp_path / "run" / "metrics.json").is_file()


@pytest.mark.parametrize(
    ("arguments", "settings", "words"),
    [
        ({}, {}, "runs cannot go abreast: it has events"),
        ({"backend": "sumo"}, {"law": "x"}, "law: unknown"),
        ({"runs": 0}, SHORT, "runs = 0: must be a whole number"),
        ({"runs": 2.5}, SHORT, "runs = 2.5: must be a whole number"),
        ({"runs": 2, "backend": "numeric"}, SHORT, "several at once only with backend"),
        ({"limit_mps2": float("nan")}, SHORT, "limit_mps2 = nan"),
        ({"backend": "traci"}, SHORT, "backend = traci: must be one of ensemble, numeric, sumo"),
        ({"acts": "brake"}, SHORT, "acts = brake: must be one of acceleration, on_top"),
        ({"out": "x"}, SHORT, "leaves no run folder"),
        ({"jitter": {"train.nose_m": 1.0}}, SHORT, "has a number nose_m"),
        ({"neighbours": 1}, SHORT, "receives on 2 links, an agent sees 1"),
        ({"jitter": {"train.speed_mps": 1e6}}, SHORT, "starts can be"),
    ],
)
def test_bad_input_is_told_in_words(arguments, settings, words):
    with pytest.raises(InputError, match=words):
        vector(settings=settings, **arguments).reset(seed=1)


def test_a_law_within_the_integrator_has_no_agents():
    with pytest.raises(InputError, match="agents act beside sampled laws only"):
        vector("fault_tolerant", {})


def test_trains_that_come_and_go_are_no_agents():
    with pytest.raises(InputError, match="place them by"):
        vector("merging", {}, backend="sumo")


def test_actions_are_checked():
    env = vector()
    with pytest.raises(InputError, match="call reset"):
        env.step(zeros(env))
    env.reset(seed=1)
    with pytest.raises(InputError, match=r"shape \(6,\): must be \(6, 1\)"):
        env.step(np.zeros(6))
    with pytest.raises(InputError, match="agent 3 = nan: must be finite"):
        env.step(np.where(np.arange(6) == 2, np.nan, 0.0)[:, None])
    with pytest.raises(InputError, match="reset_mask"):
        env.reset(options={"reset_mask": np.arange(6) == 2})
    side = ParallelTrains("fully_distributed", **SHORT)
    with pytest.raises(InputError, match="seed = -1"):
        side.reset(seed=-1)
    side.reset(seed=1)
    with pytest.raises(InputError, match="none of agent 2"):
        side.step({"1": np.zeros(1, np.float32)})


def test_the_example_improves_on_a_bad_law():
    """Gains searched with one seed do better with another, too."""
    agents = Agents(Asked("fully_distributed", 8, "ensemble", "acceleration", 1.0, {}, usual_reward, None, None, SHORT))
    assert linear(np.ones((1, len(agents.columns))), agents.columns, (0.0, 0.0)).shape == (1,)
    found = improved(rounds=10, runs=4, seconds=300)
    assert found.after > 0.5 * found.before and found.before < found.after < 0.0
