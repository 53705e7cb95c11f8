"""Compile the kernels of every law, plant and observer that shipped scenarios combine, on all cores.

Set-up does it once (``python tools/compile_kernels.py``), so that nobody's first run of another law waits for the compiler, nor
ten runs side by side of a continuous one, whose many trains have code of their own. What is compiled already is only loaded.
"""

from __future__ import annotations

import math
import os
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from trainctl.errors import TrainctlError

#: How long a scenario is run, the shortest that it takes [s]: all kernels have been called after one control period.
SECONDS = (2.0, 30.0)

#: So many runs side by side.
ABREAST = 10


def combinations() -> dict[tuple[Any, ...], list[str]]:
    """Scenarios by what of them is compiled together; continuous laws, which take longest, first."""
    from trainctl.laws import find_law
    from trainctl.scenario.reading import examine, read, shipped

    found: dict[tuple[Any, ...], list[str]] = {}
    for name in shipped():
        tables, _ = read(name)
        scenario, _ = examine(tables)
        if scenario is None or scenario.controller.law == "sumo":
            continue
        law, exact = scenario.controller.law, scenario.topology.communication_period_s is None
        key = (
            find_law(law).CLOCK != "continuous", law, scenario.plant.kind, scenario.observer.kind, exact,
            bool(scenario.network.sumocfg),
        )  # fmt: skip
        found.setdefault(key, []).append(name)
    return dict(sorted(found.items(), key=lambda item: str(item[0])))


def compiled(names: list[str], abreast: bool) -> str | None:
    """Run the first of these scenarios that can be cut short, alone or ``abreast``; why none could be, in words."""
    from trainctl.scenario.build import open_scenario
    from trainctl.scenario.reading import read

    why: str | None = None
    for name in names:
        for seconds in SECONDS:
            try:
                run = read(name)[0]["run"]
                period = float(run.get("control_period_s", run.get("step_s", 1.0)))
                p = open_scenario(name, {"run.duration_s": math.ceil(seconds / period) * period})
                if (why := _side_by_side(p) if abreast else _run(p)) is None:
                    return None
                why = f"{name}: {why}"
            except TrainctlError as error:
                why = f"{name}: {error}".partition("\n")[0]
    return why


def _run(p: Any) -> None:
    """One run, by the whole loop."""
    from trainctl import runner

    with tempfile.TemporaryDirectory(prefix="trainctl-compile-") as root:
        runner.run(p, Path(root) / "run", "numeric")


def _side_by_side(p: Any) -> str | None:
    """Runs in a stack, or why they cannot be stacked."""
    from trainctl.ensemble.stack import alone, stacked
    from trainctl.ensemble.steps import simulated

    why = alone(p)
    if why is None:
        simulated(stacked([p] * ABREAST))
    return why


def main() -> None:
    """Compile all, and say how long it took."""
    began, together = time.perf_counter(), combinations()
    # Side by side every continuous law once, as its first scenario has it: with more, set-up would take long.
    abreast = {law: (names, True) for (sampled, law, *_), names in reversed(together.items()) if not sampled}
    jobs = [*abreast.values(), *((names, False) for names in together.values())]
    with ProcessPoolExecutor(os.cpu_count() or 1, get_context("spawn")) as pool:
        for why in pool.map(compiled, *zip(*jobs, strict=True)):
            if why is not None:
                print(f"not compiled: {why}")
    print(f"{len(together)} combinations of law, plant and observer compiled in {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
