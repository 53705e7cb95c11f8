"""Trains as a vector of environments for Gymnasium, one agent per train."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trainctl.environment.agents import usual_reward
from trainctl.environment.courses import Acts, Agents, Asked, Backend, Reward
from trainctl.errors import InputError

try:
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    raise InputError("trainctl.environment.vector: needs Gymnasium: pip install trainctl[environment]") from error

Observations = NDArray[np.float32]


class VectorTrains(VectorEnv[Observations, Observations, NDArray[Any]]):
    """Every train of every run is an environment of its own: ``num_envs`` is runs times trains, a run's trains side by side.

    All runs begin and end together, so nothing is reset by itself (``AutoresetMode.DISABLED``): call ``reset`` when ``truncated``
    is true. A train whose run is over before, since trains touched, stays ``terminated``, with observation and reward 0.

    Parameters
    ----------
    scenario : str or Path
        Name of a shipped scenario, or path of a TOML: trains placed by [[train]], under a sampled law.
    runs : int
        Runs at once.
    backend : {"ensemble", "numeric", "sumo"}
        Many runs abreast without a simulator; one run by the whole loop, without or with SUMO (one per process).
    acts : {"acceleration", "on_top"}
        An action is the acceleration [m/s2], instead of the law's; or it is added to what the law asks for.
    limit_mps2 : float
        Actions are cut off at plus and minus this.
    jitter : mapping, optional
        Key of [[train]] to the half width of a uniform deviation at the start, as in `trainctl sweep --jitter`.
    reward : callable, optional
        Of ``agents.Judged``, gives (num_envs,); default ``agents.usual_reward``.
    neighbours : int, optional
        Links every agent sees; default 2, or as many as a train receives on at the start.
    out : str or Path, optional
        Run folder of the last episode, with "numeric" and "sumo"; default none.
    **settings
        Keys of the scenario to override.

    Raises
    ------
    InputError
        Everything that is wrong with it.
    """

    def __init__(
        self,
        scenario: str | Path,
        *,
        runs: int = 1,
        backend: Backend = "ensemble",
        acts: Acts = "acceleration",
        limit_mps2: float = 1.0,
        jitter: Mapping[str, float] | None = None,
        reward: Reward = usual_reward,
        neighbours: int | None = None,
        out: str | Path | None = None,
        **settings: Any,
    ) -> None:
        self.metadata = {"autoreset_mode": AutoresetMode.DISABLED}
        self.agents = Agents(
            Asked(scenario, runs, backend, acts, limit_mps2, jitter or {}, reward, neighbours, out, settings)
        )  # fmt: skip
        self.num_envs = len(self.agents.names)
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (len(self.agents.columns),), np.float32)
        self.single_action_space = spaces.Box(-limit_mps2, limit_mps2, (1,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.goes_on = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:  # fmt: skip
        """Begin all runs anew; ``seed`` decides on starts, disturbances and losses of this and all further episodes."""
        super().reset(seed=seed)
        mask = (options or {}).get("reset_mask")
        if mask is not None and not np.all(mask):
            raise InputError("reset_mask: all runs begin together: it must be true everywhere")
        now = self.agents.begin(self.np_random)
        self.goes_on = True
        return now.astype(np.float32), {}

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Observations, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:  # fmt: skip
        """One control period of all runs. ``info`` has ``agents.Judged`` by its names, (num_envs,) each."""
        if not self.goes_on:
            raise InputError("step: the episode has ended, or none has begun: call reset")
        given = np.asarray(actions, np.float64)
        if given.shape != (self.num_envs, 1):
            raise InputError(f"actions: shape {given.shape}: must be {(self.num_envs, 1)}")
        done = self.agents.step(given[:, 0])
        self.goes_on = not (self.agents.course.done or done.terminated.all())
        return done.seen.astype(np.float32), done.reward, done.terminated, done.truncated, done.judged._asdict()

    def close_extras(self, **kwargs: Any) -> None:
        """End the run that goes on."""
        self.agents.course.close()
