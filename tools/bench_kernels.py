"""Trains of units on one core and on two: ``python tools/bench.py --kernels [TRAINS] [--against CHECKOUT]``.

======  ========================================================================================================================
before  one thread of the code in the checkout, if one is given: ``times before`` is against that
plain   one thread, and nothing known of the trains when the law is compiled, as for a few trains
one     one thread; compiled for the number of units that all trains have
two     the same on two threads, each with whole formations
======  ========================================================================================================================

Trains of four units in six formations, sub-steps of 10 ms, under a law for whole trains (``coupled_units``), ``emu_finite_time``
and ``fault_tolerant`` with its observer. Told is the time of the clock that the integration of one second takes [ms], all of them
in processes that take turns; medians, and medians of the ratios within a repeat.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import bench

CASES, KINDS, STEPS = ("coupled_units", "finite_time", "actuated_units"), ("plain", "one", "two"), 40


def child(case: str, folder: str, kind: str) -> None:
    """One case in a process of its own, which steps as it is told; see ``bench.child``."""
    os.environ["TRAINCTL_THREADS"] = "2" if kind == "two" else "1"
    from trainctl.plants import integrate

    if kind == "plain":
        from trainctl.plants import views

        views.WORTH = sys.maxsize
    bench.unrehearsed(case)
    run, spent, advance = bench.public(Path(folder), case), [0.0], integrate.advance

    def timed(*arguments: Any) -> Any:
        began = time.perf_counter()
        found = advance(*arguments)
        spent[0] += time.perf_counter() - began
        return found

    integrate.advance = timed
    print("ready", flush=True)
    for line in sys.stdin:
        for _ in range(int(line)):
            run.step()
        print("done", flush=True)
    run.close()
    print(json.dumps({"seconds": spent[0]}))


def rows(root: Path, trains: int, repeats: int, checkout: Path | None) -> list[dict[str, Any]]:
    """Rows of all cases."""
    found, kinds = [], KINDS if checkout is None else ("before", *KINDS)
    for case in CASES:
        folders = {}
        for kind in kinds:
            folders[kind] = root / f"{case}-{kind}"
            folders[kind].mkdir()
            text, line = bench.scenario(case, trains, STEPS + 4, tracks=6)
            (folders[kind] / "scenario.toml").write_text(text, encoding="utf-8")
            (folders[kind] / "line.toml").write_text(line, encoding="utf-8")
        took = []
        for turn in range(repeats):
            print(f"{case}: {turn + 1} of {repeats}", file=sys.stderr)
            running = {
                kind: bench.python("--kernel", case, str(folders[kind]), kind, checkout=checkout if kind == "before" else None)
                for kind in kinds
            }  # fmt: skip
            took.append(bench.by_turns(running, dict.fromkeys(kinds, STEPS)))
        found += [
            {
                "case": case, "kernel": kind, "trains": trains,
                "ms_per_s": round(statistics.median(1e3 * one[kind]["seconds"] / STEPS for one in took), 2),
                **{
                    f"times_{other}": round(statistics.median(one[other]["seconds"] / one[kind]["seconds"] for one in took), 2)
                    for other in ("plain", "before") if other in kinds
                },
            }
            for kind in kinds
        ]  # fmt: skip
        print(table(found[-len(kinds) :]), file=sys.stderr)
    return found


def table(found: list[dict[str, Any]]) -> str:
    """Rows in columns."""
    lines = [f"{'case':<16} {'kernel':<6} {'trains':>6} {'ms per s':>9} {'times plain':>12} {'times before':>13}"]
    for r in found:
        before = r.get("times_before", "-")
        lines.append(
            f"{r['case']:<16} {r['kernel']:<6} {r['trains']:>6} {r['ms_per_s']:>9} {r['times_plain']:>12} {before:>13}"
        )  # fmt: skip
    return "\n".join(lines)
