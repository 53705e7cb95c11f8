"""How fast agents step: ``python tools/bench.py --environment``.

==============  ================================================================================================================
vector          Gymnasium: formations of six trains under ``fully_distributed``, actions on top of the law, nothing random
vector_random   the same with measurement errors and losses
parallel        PettingZoo, as ``vector``
reset           as ``vector``, a new start of all runs and 600 steps counted together
loop            one run of six trains in SUMO by itself, step by step from Python
sumo_vector     the same run through Gymnasium; ``to loop`` is its rate against that
sumo_parallel   the same run through PettingZoo
==============  ================================================================================================================

``M/s`` are million agent-steps per second of processor time of one core, the median of the repeats.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

TRAINS, STEPS, IN_SUMO = 6, 100, 400
QUIET: dict[str, Any] = {"event": [], "run.duration_s": 600.0}
RANDOM = {**QUIET, "topology.loss": 0.2, "disturbance": [{"on": "measurement", "shape": "gaussian", "std_m": 5.0}]}
JITTER = {"train.position_m": 300.0}


def vector(runs: int, settings: dict[str, Any], resets: bool = False) -> float:
    """Agent-steps per second [million] of Gymnasium's."""
    from trainctl.environment.vector import VectorTrains

    env = VectorTrains("fully_distributed", runs=runs, acts="on_top", jitter=JITTER, **settings)
    given, steps = np.zeros((env.num_envs, 1), np.float32), 600 if resets else STEPS
    env.reset(seed=1)
    return rate(lambda: env.step(given), env.num_envs, steps, (lambda: env.reset(seed=2)) if resets else None)


def parallel(runs: int) -> float:
    """Agent-steps per second [million] of PettingZoo's."""
    from trainctl.environment.parallel import ParallelTrains

    env = ParallelTrains("fully_distributed", runs=runs, acts="on_top", jitter=JITTER, **QUIET)
    env.reset(seed=1)
    given = {name: np.zeros(1, np.float32) for name in env.possible_agents}
    return rate(lambda: env.step(given), len(given), STEPS, None)


def rate(step: Callable[[], Any], agents: int, steps: int, before: Callable[[], Any] | None) -> float:
    """Million agent-steps per second of processor time; the first step compiles and does not count."""
    if before is None:
        step()
    began = time.process_time()
    if before is not None:
        before()
    for _ in range(steps):
        step()
    return agents * steps / (time.process_time() - began) / 1e6


def in_sumo(kind: str) -> float:
    """Agent-steps per second [million] of one run in SUMO, by itself or as an environment."""
    import trainctl
    from trainctl.environment.parallel import ParallelTrains
    from trainctl.environment.vector import VectorTrains

    if kind == "loop":
        with trainctl.Simulation.open("fully_distributed", **QUIET) as sim:
            return rate(sim.step, TRAINS, IN_SUMO, None)
    env: Any = (VectorTrains if kind == "sumo_vector" else ParallelTrains)(
        "fully_distributed", backend="sumo", acts="on_top", **QUIET
    )  # fmt: skip
    env.reset(seed=1)
    one = np.zeros(1, np.float32)
    given = np.zeros((TRAINS, 1), np.float32) if kind == "sumo_vector" else dict.fromkeys(env.possible_agents, one)
    found = rate(lambda: env.step(given), TRAINS, IN_SUMO, None)
    env.close()
    return found


def environment(runs: int, repeats: int) -> list[dict[str, Any]]:
    """Rows of all cases."""
    cases: dict[str, Callable[[], float]] = {
        "vector": lambda: vector(runs, QUIET), "vector_random": lambda: vector(runs, RANDOM), "parallel": lambda: parallel(runs),
        "reset": lambda: vector(runs, QUIET, resets=True),
    }  # fmt: skip
    sumo = ("loop", "sumo_vector", "sumo_parallel")
    cases |= {kind: (lambda kind=kind: in_sumo(kind)) for kind in sumo}
    rates: dict[str, list[float]] = {case: [] for case in cases}
    for _ in range(repeats):
        for case, function in cases.items():
            rates[case].append(function())
    rows: list[dict[str, Any]] = []
    for case, each in rates.items():
        to_loop = statistics.median(a / b for a, b in zip(each, rates["loop"], strict=True))
        row = {"case": case, "runs": 1 if case in sumo else runs, "million_per_s": round(statistics.median(each), 4)}
        rows.append({**row, "to_loop": round(to_loop, 3) if case in sumo else None})
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """Rows in columns."""
    lines = [f"{'case':<14} {'runs':>6} {'M/s':>9} {'to loop':>8}"]
    return "\n".join([*lines, *(f"{r['case']:<14} {r['runs']:>6} {r['million_per_s']:>9} {r['to_loop'] or '':>8}" for r in rows)])
