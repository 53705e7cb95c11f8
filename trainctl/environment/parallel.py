"""Trains as agents side by side for PettingZoo."""

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
    from pettingzoo import ParallelEnv
except ModuleNotFoundError as error:
    raise InputError("trainctl.environment.parallel: needs PettingZoo: pip install trainctl[environment]") from error

Observation = NDArray[np.float32]


class ParallelTrains(ParallelEnv[str, Observation, Observation]):  # type: ignore[misc]
    """Every train of every run is an agent, called by its id, with several runs RUN/ID.

    Arguments, what agents see and what they get are those of ``vector.VectorTrains``. An agent whose run is over, since trains
    touched, is terminated; all others are truncated at run.duration_s.
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
        self.metadata = {"name": f"trainctl/{Path(scenario).stem}", "render_modes": []}
        self.trains = Agents(
            Asked(scenario, runs, backend, acts, limit_mps2, jitter or {}, reward, neighbours, out, settings)
        )  # fmt: skip
        self.possible_agents = list(self.trains.names)
        self.agents: list[str] = []
        self.rows: NDArray[np.int64] = np.zeros(0, np.int64)  # of the agents
        self.seen_of = spaces.Box(-np.inf, np.inf, (len(self.trains.columns),), np.float32)
        self.act_of = {name: spaces.Box(-limit_mps2, limit_mps2, (1,), np.float32) for name in self.possible_agents}
        self.random = np.random.default_rng()

    def observation_space(self, agent: str) -> spaces.Box:
        """The same for all."""
        return self.seen_of

    def action_space(self, agent: str) -> spaces.Box:
        """Every agent has one of its own, which can be seeded."""
        return self.act_of[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:  # fmt: skip
        """Begin all runs anew; ``seed`` decides on starts, disturbances and losses of this and all further episodes."""
        if seed is not None:
            if seed < 0:
                raise InputError(f"seed = {seed}: must not be negative")
            self.random = np.random.default_rng(seed)
        now = self.trains.begin(self.random).astype(np.float32)
        self.agents, self.rows = list(self.possible_agents), np.arange(len(self.possible_agents))
        return dict(zip(self.agents, now, strict=True)), {name: {} for name in self.agents}

    def step(
        self, actions: dict[str, Observation]
    ) -> tuple[
        dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
    ]:  # fmt: skip
        """One control period of all runs, for the agents that are left."""
        agents, rows = self.agents, self.rows
        if not agents:
            raise InputError("step: the episode has ended, or none has begun: call reset")
        given = np.zeros(len(self.possible_agents))
        try:
            given[rows] = np.concatenate([actions[name] for name in agents])
        except KeyError as missing:
            raise InputError(f"actions: none of agent {missing.args[0]}") from None
        except ValueError:
            raise InputError("actions: every agent's must be of shape (1,)") from None
        done = self.trains.step(given)
        columns = done.seen.astype(np.float32), done.reward, done.terminated, done.truncated
        if len(rows) < len(self.possible_agents):
            columns = tuple(column[rows] for column in columns)  # type: ignore[assignment]
        sight, reward, terminated, truncated = columns
        ended = terminated | truncated
        if ended.any():
            self.rows = rows[~ended]
            self.agents = [self.possible_agents[i] for i in self.rows.tolist()]
        return (
            dict(zip(agents, sight, strict=True)), dict(zip(agents, reward.tolist(), strict=True)),
            dict(zip(agents, terminated.tolist(), strict=True)), dict(zip(agents, truncated.tolist(), strict=True)),
            {name: {} for name in agents},
        )  # fmt: skip

    def close(self) -> None:
        """End the run that goes on."""
        self.trains.course.close()
