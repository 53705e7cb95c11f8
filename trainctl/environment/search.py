"""A short example: two gains of a linear law, found by random search, do better than bad ones. ``python -m`` this module.

Every train accelerates in proportion to the mean spacing error of the links it receives on and to its speed error. All candidates
of a round drive the same starts, so the better one is better on them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from trainctl.environment.vector import VectorTrains
from trainctl.signals import Floats

#: Gains [1/s2] and [1/s] to begin with: trains hardly care for their spacings.
BAD = (1e-5, 0.01)


class Found(NamedTuple):
    """What the search came to: rewards per train and step, of starts it has not seen."""

    gains: tuple[float, float]
    before: float
    after: float


def linear(seen: Floats, columns: tuple[str, ...], gains: tuple[float, float]) -> Floats:
    """Accelerations [m/s2] of all agents, (N,)."""
    errors = [k for k, name in enumerate(columns) if name.endswith("error_m")]
    came = [k for k, name in enumerate(columns) if name.endswith("came")]
    heard = np.maximum(seen[:, came].sum(axis=1), 1.0)
    wanted: Floats = gains[0] * seen[:, errors].sum(axis=1) / heard - gains[1] * seen[:, columns.index("speed_error_mps")]
    return wanted


def returned(env: VectorTrains, gains: tuple[float, float], seed: int) -> float:
    """Mean reward per train and step of an episode."""
    seen, _ = env.reset(seed=seed)
    total, steps, truncated = 0.0, 0, False
    while not truncated:
        seen, reward, _, ended, _ = env.step(linear(seen.astype(np.float64), env.agents.columns, gains)[:, None])
        total, steps, truncated = total + float(reward.mean()), steps + 1, bool(ended.all())
    return total / steps


def improved(rounds: int = 30, runs: int = 20, seconds: float = 300.0, seed: int = 1) -> Found:
    """Vary the best gains so far by a random factor, and keep what is better."""
    settings: dict[str, Any] = {"event": [], "run.duration_s": seconds}
    env = VectorTrains("fully_distributed", runs=runs, jitter={"train.position_m": 300.0}, **settings)
    random, best = np.random.default_rng(seed), BAD
    reward = returned(env, best, seed)
    for _ in range(rounds):
        tried = best[0] * float(np.exp(random.normal())), best[1] * float(np.exp(random.normal()))
        if (now := returned(env, tried, seed)) > reward:
            best, reward = tried, now
    unseen = seed + 1
    return Found(best, returned(env, BAD, unseen), returned(env, best, unseen))


if __name__ == "__main__":
    found = improved()
    print(f"gains {BAD[0]:.2g} 1/s2, {BAD[1]:.2g} 1/s: {found.before:.4g} per train and step")
    print(f"gains {found.gains[0]:.2g} 1/s2, {found.gains[1]:.2g} 1/s: {found.after:.4g}")
