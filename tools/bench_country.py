"""What a day of a country costs: ``python tools/bench.py --country [HOURS]``, on the railway of ``country``.

=======  =======================================================================================================================
day      a roster of 36 000 trains in 24 h, for so many hours of it: time, memory, and what became of every train
long     a step of that roster at 0:45 in the morning, some 1000 trains on the railway
short    the same with the first 1200 trains of the roster only: the same ones are on the railway; ``long`` and ``short`` take turns
=======  =======================================================================================================================

Numeric backend, supervisor on, rows every 60 s. Times are those of the processor; ``open_s`` is from the file to the first step.
"""

from __future__ import annotations

import gc
import json
import os
import statistics
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import bench
import country

from trainctl.cli import GARBAGE

#: Of the short roster: its trains, and steps until all but the last of them have come; then so many steps are measured.
SHORT, BEFORE, STEPS = 1200, 2680, 160


class Day:
    """A run of the country, opened."""

    def __init__(self, folder: Path) -> None:
        from trainctl.in_service import loop_of
        from trainctl.numeric import Numeric
        from trainctl.scenario.build import open_scenario
        from trainctl.stages.record import Journal

        began = time.process_time()
        self.model = open_scenario(str(folder / "scenario.toml"))
        self.journal = Journal(folder, self.model)
        self.loop = loop_of(self.model, Numeric(self.model.line), self.journal)
        self.open_s = time.process_time() - began
        self.loop.step()  # compiles or loads what the kernels need

    def present(self) -> int:
        """Trains on the railway now."""
        return int(self.loop.world.measure().present.sum())


def whole(folder: Path) -> dict[str, Any]:
    """Run what is in ``folder`` to its end; one row."""
    day = Day(folder)
    began, present, cost = time.process_time(), 0, list[float]()
    while not day.loop.over:
        since = time.process_time()
        for _ in range(min(600, day.model.scenario.run.steps - day.loop.k)):
            day.loop.step()
        cost.append(time.process_time() - since)
        present = max(present, day.present())
        print(f"{day.loop.time / 3600:.1f} h, {day.present()} trains, {1e3 * cost[-1] / 600:.1f} ms per step", file=sys.stderr)
    day.loop.end()
    seconds = time.process_time() - began
    went = day.loop.state.traffic
    told = day.loop.outcome()
    day.journal.join()
    day.journal.close()
    lines = (json.loads(line) for line in (folder / "events.jsonl").read_text(encoding="utf-8").splitlines())
    events = [e for e in lines if e["kind"] in ("depart", "arrive", "stop_reached")]
    kinds, waited = Counter(e["kind"] for e in events), [e["delay_s"] for e in events if e["kind"] == "depart"]
    late = [e["delay_s"] for e in events if e["kind"] == "arrive" and "delay_s" in e]
    return {
        "case": "day", "roster": len(day.model.scenario.ids), "present": present, "hours": day.loop.time / 3600.0,
        "ms_per_step": round(1e3 * seconds / day.loop.k, 2), "times_real_time": round(day.loop.time / seconds, 1),
        "least_times": round(600.0 / max(cost), 1), "open_s": round(day.open_s, 1), "peak_mb": round(bench.peak_mb(), 0),
        "entered": kinds["depart"], "arrived": kinds["arrive"], "stops": kinds["stop_reached"],
        "waited_to_enter": sum(delay > 1.5 for delay in waited), "longest_wait_s": round(max(waited, default=0.0), 0),
        "late": sum(delay > 60.0 for delay in late), "on_the_way": int((went.came & ~went.left).sum()),
        "not_entered": told["not_entered"], "collisions": told["collisions"], "gridlocks": told["gridlocks"],
    }  # fmt: skip


def child(folder: Path) -> None:
    """A roster in a process of its own, which steps as it is told; see ``bench.child``."""
    day = Day(folder)
    while day.loop.k < BEFORE:
        day.loop.step()
    print("ready", flush=True)
    spent = 0.0
    for line in sys.stdin:
        began = time.process_time()
        for _ in range(int(line)):
            day.loop.step()
        spent += time.process_time() - began
        print("done", flush=True)
    print(json.dumps({"cpu": spent, "roster": len(day.model.scenario.ids), "present": day.present(), "open_s": day.open_s}))


def rosters(root: Path, repeats: int) -> list[dict[str, Any]]:
    """Rows of the long and the short roster, and how many times the step of the one takes that of the other."""
    for name, first in (("long", None), ("short", SHORT)):
        country.write(root / name, first=first)
    found = []
    for turn in range(repeats):
        print(f"long and short: {turn + 1} of {repeats}", file=sys.stderr)
        running = {name: bench.python("--roster", str(root / name)) for name in ("long", "short")}
        found.append(bench.by_turns(running, dict.fromkeys(running, STEPS)))
    ratio = statistics.median(one["long"]["cpu"] / one["short"]["cpu"] for one in found)
    return [
        {
            "case": name, "roster": found[0][name]["roster"], "present": found[0][name]["present"],
            "ms_per_step": round(statistics.median(1e3 * one[name]["cpu"] / STEPS for one in found), 2),
            "open_s": round(found[0][name]["open_s"], 1), **({"to_short": round(ratio, 3)} if name == "long" else {}),
        }
        for name in running
    ]  # fmt: skip


def rows(root: Path, hours: float, repeats: int) -> list[dict[str, Any]]:
    """Rows of all cases."""
    found = rosters(root, repeats)
    if hours > 0.0:
        country.write(root / "day", duration_s=round(3600.0 * hours))
        process = bench.python("--roster", str(root / "day"), "whole")
        said, _ = process.communicate()
        if process.returncode:
            raise SystemExit("the day failed")
        found.append(json.loads(said.splitlines()[-1]))
    return found


def table(found: list[dict[str, Any]]) -> str:
    """Rows, one value per line where a case has many."""
    return "\n".join(f"{r['case']}: " + ", ".join(f"{key} = {value}" for key, value in r.items() if key != "case") for r in found)


def of_roster(folder: Path, kind: list[str]) -> None:
    """What runs in a process of its own."""
    os.environ.setdefault("TRAINCTL_THREADS", "1")
    gc.set_threshold(GARBAGE)  # as in the program
    if kind:
        print(json.dumps(whole(folder)))
    else:
        child(folder)
