"""How fast runs side by side are, set-up and metrics included: ``python tools/bench.py --ensembles``.

==============  ================================================================================================================
plain           a compiled loop that only moves trains: what the arithmetic alone costs
sampled         formations of six trains under ``fully_distributed``, 600 steps, nothing random
monte_carlo     the same with the errors and losses of the sweep ``monte_carlo``
set_up          the models of ``monte_carlo`` and their stack, alone
two_at_once     ``monte_carlo`` in two processes; ``to one`` is how many times one process they do together
finite_time     ``emu_finite_time`` (3 trains x 4 units), 10 runs of 100 s; ``..._1000``: 334 runs, some 1000 trains
fault_tolerant  the same with ``fault_tolerant`` (3 trains x 3 units)
single          one run of ``sampled`` through the whole loop, tables and metrics included
==============  ================================================================================================================

``M/s`` are million train-steps per second of processor time of one core, the median of the repeats, each of which takes one case
after the other; ``to plain`` is the median of their ratios, ``to 1000`` that of the time a train-step takes against ``..._1000``.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

STEPS, TRAINS = 600, 6
UNITS = {"finite_time": "emu_finite_time", "fault_tolerant": "fault_tolerant"}
FEW, MANY, SECONDS = 10, 334, 100.0


@njit(error_model="numpy")
def _plain(position: Any, speed: Any, runs: int, steps: int) -> None:
    """Six trains per run that follow each other by springs, one run after the other."""
    for r in range(runs):
        for _ in range(steps):
            for i in range(6 * r, 6 * r + 6):
                a = 0.0
                if i > 6 * r:
                    a += 0.01 * (position[i - 1] - position[i] - 100.0)
                if i < 6 * r + 5:
                    a -= 0.01 * (position[i] - position[i + 1] - 100.0)
                position[i] += speed[i]
                speed[i] += min(max(a, -1.0), 1.0)


def plain(runs: int) -> int:
    """Train-steps of the plain loop."""
    _plain(np.arange(6.0 * runs) * -100.0, np.ones(6 * runs), runs, STEPS)
    return runs * TRAINS * STEPS


def models(runs: int, loss: float, errors: bool) -> list[Any]:
    """Runs of the sweep ``monte_carlo``, its measurement errors left out on demand."""
    from trainctl.studies.jobs import job_model
    from trainctl.studies.sweep import SweepPlan, batches, ready_made

    made = ready_made("monte_carlo")
    assert made is not None
    settings = {"topology.loss": [loss], "run.duration_s": [float(STEPS)], **({} if errors else {"disturbance": [[]]})}
    (batch,) = batches(SweepPlan(made.scenario, settings, range(runs), made.jitter, "numeric"))
    found: list[Any] = []
    for job in batch.each():
        found.append(job_model(job, like=found[0] if found else None))
    return found


def together(found: list[Any]) -> int:
    """Drive runs side by side; their train-steps."""
    from trainctl.ensemble.stack import stacked
    from trainctl.ensemble.steps import simulated

    done = simulated(stacked(found))
    assert set(done.why_alone) == {None}
    run = found[0].scenario.run
    return len(found) * len(found[0].scenario.ids) * int(run.steps)


def of_units(name: str, runs: int, seconds: float) -> list[Any]:
    """The same run many times, for trains of units."""
    from trainctl.scenario.build import open_scenario

    return [open_scenario(name, {"run.duration_s": seconds, "run.seed": 1})] * runs


def single() -> int:
    """One run by the whole loop."""
    from trainctl import runner

    (p,) = models(1, 0.0, False)
    with tempfile.TemporaryDirectory(prefix="trainctl-bench-") as root:
        runner.run(p, Path(root) / "run", "numeric")
    return TRAINS * STEPS


def spent(function: Callable[[], int]) -> tuple[float, int]:
    """Processor time [s] and train-steps."""
    began = time.process_time()
    steps = function()
    return time.process_time() - began, steps


def _a_process(runs: int) -> float:
    """Train-steps per second of the clock in this process, from its second turn on."""
    together(models(8, 0.2, True))
    found = models(runs, 0.2, True)
    began = time.perf_counter()
    steps = together(found)
    return steps / (time.perf_counter() - began)


def two_at_once(runs: int) -> float:
    """How many times the rate of one process two at once reach."""
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        alone = pool.submit(_a_process, runs).result()
        both = sum(future.result() for future in [pool.submit(_a_process, runs) for _ in range(2)])
    return both / alone


def ensembles(runs: int, repeats: int) -> list[dict[str, Any]]:
    """Rows of all cases."""
    prepared = {"sampled": models(runs, 0.0, False), "monte_carlo": models(runs, 0.2, True)}
    for case, name in UNITS.items():
        prepared |= {case: of_units(name, FEW, SECONDS), f"{case}_1000": of_units(name, MANY, SECONDS)}

    def set_up() -> int:
        from trainctl.ensemble.stack import stacked

        stacked(models(runs, 0.2, True))
        return runs * TRAINS * STEPS

    cases: dict[str, Callable[[], int]] = {"plain": lambda: plain(20 * runs), "set_up": set_up, "single": single}
    cases |= {case: (lambda found=found: together(found)) for case, found in prepared.items()}
    for function in cases.values():
        function()  # compiled, and its tables read
    rates: dict[str, list[float]] = {case: [] for case in cases}
    for _ in range(repeats):
        for case, function in cases.items():
            seconds, steps = spent(function)
            rates[case].append(steps / seconds / 1e6)
    rows = [
        {
            "case": case, "runs": 1 if case == "single" else len(prepared.get(case, [None] * runs)),
            "million_per_s": round(statistics.median(each), 3), "us_per_train_step": round(1.0 / statistics.median(each), 4),
            "to_plain": round(statistics.median(a / b for a, b in zip(each, rates["plain"], strict=True)), 5),
            **(
                {"to_1000": round(statistics.median(b / a for a, b in zip(each, rates[f"{case}_1000"], strict=True)), 3)}
                if case in UNITS else {}
            ),
        }
        for case, each in rates.items()
    ]  # fmt: skip
    return [*rows, {"case": "two_at_once", "runs": 2 * runs, "to_one": round(two_at_once(runs), 2)}]


def table(rows: list[dict[str, Any]]) -> str:
    """Rows in columns."""
    keys = {"million_per_s": "M/s", "us_per_train_step": "us/train-step", "to_plain": "to plain", "to_1000": "to 1000"}
    lines = [f"{'case':<20} {'runs':>6}" + "".join(f" {title:>13}" for title in keys.values())]
    for r in rows[:-1]:
        lines.append((f"{r['case']:<20} {r['runs']:>6}" + "".join(f" {r.get(key, ''):>13}" for key in keys)).rstrip())
    return "\n".join([*lines, f"two processes at once do {rows[-1]['to_one']} times what one does"])
