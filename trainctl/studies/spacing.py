"""The smallest safe spacing of every law: found by bisection over emergency stops (``studies.stops``), checked, and measured."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomli_w

from trainctl.errors import InputError, TrainctlError, left_out
from trainctl.processes import processes
from trainctl.record.folder import write_json
from trainctl.signals import POSITION, SPEED, Trains
from trainctl.studies.capacity import LAW_ROWS
from trainctl.studies.stops import (
    ROWS,
    SAFE,
    Outcome,
    StopsPlan,
    has_sumo,
    line,
    prepared,
    reference_lines,
    scenario,
    stopped,
    unwatched,
    wrong,
)

if TYPE_CHECKING:
    from trainctl.runs.run import Run

#: What was found for a row, in its folder.
ROW = "row.json"

#: The found spacing is run with all stops at these shares of it.
SHARES = (0.95, 1.0, 1.05, 1.10)


class _Search:
    """Looks at spacings; what failed once is looked at again in every later one."""

    def __init__(self, plan: StopsPlan, row: str, out: Path) -> None:
        self.plan, self.row, self.out = plan, row, out
        self.stops, self.points = list(range(plan.searched)), list[Outcome]()

    def look(self, spacing: float) -> Outcome:
        """What comes of the stops that are searched with."""
        self.points.append(stopped(self.plan, self.row, spacing, self.stops, self.out)[0])
        return self.points[-1]

    def between(self, low: Outcome, high: Outcome) -> tuple[Outcome, Outcome]:
        """Halve until a safe spacing is no more than ``within`` above one that is not."""
        while high.spacing_m > low.spacing_m * (1.0 + self.plan.within):
            middle = self.look(math.sqrt(low.spacing_m * high.spacing_m))
            low, high = (low, middle) if middle.what == SAFE else (middle, high)
        return low, high

    def smallest(self) -> tuple[Outcome, Outcome]:
        """The smallest spacing that is safe in all stops, and the one below it that is not; the same one if there is none."""
        low, top = self.look(self.plan.from_m), self.look(self.plan.to_m)
        high = top
        while high.what != SAFE and high.spacing_m > 2.0 * low.spacing_m:  # some laws know an upper end as well
            high = self.look(0.5 * high.spacing_m)
        if low.what == SAFE or high.what != SAFE:
            return (low, low) if low.what == SAFE else (top, top)
        top = high
        low, high = self.between(low, high)
        while True:
            whole, _ = stopped(self.plan, self.row, high.spacing_m, range(self.plan.stops), self.out)
            self.points.append(whole)
            if whole.what == SAFE or whole.spacing_m >= top.spacing_m:
                return low, whole
            self.stops = sorted({*self.stops, *whole.failures})
            low, high = whole, whole
            while high.what != SAFE and high.spacing_m < top.spacing_m:
                high = self.look(min(1.1 * high.spacing_m, top.spacing_m))
            low, high = self.between(low, high) if high.what == SAFE else (high, high)


def found(plan: StopsPlan, row: str, out: Path, sumo: bool = False) -> dict[str, Any]:
    """Everything the table says of a row.

    Parameters
    ----------
    plan : StopsPlan
        What is asked.
    row : str
        One of ``ROWS``.
    out : Path
        Its folder: scenarios of the last points, the calm run.
    sumo : bool
        Whether the found spacing, and 95 % of it, are run in SUMO as well.

    Returns
    -------
    dict
        ``row``, ``spacing_m`` (None: there is none), ``below`` (what the next smaller spacing was), ``why``, ``points`` (all that
        were looked at), ``checked`` (found spacing and shares of it with all stops), ``others`` (as many other stops at the found
        spacing), ``in_sumo``, ``told`` and ``keys`` of the law, and what ``measured`` gives.
    """
    out.mkdir(parents=True, exist_ok=True)
    begun, search, law = time.perf_counter(), _Search(plan, row, out), LAW_ROWS[row]
    low, high = search.smallest()
    spacing = high.spacing_m if high.what == SAFE else None
    told: dict[str, Any] = {
        "row": row, "told": law.IN_STOPS, "keys": _keys(plan, row, high.spacing_m), "points": [o.plain() for o in search.points],
        "why": high.why or low.why, "spacing_m": spacing, "checked": [], "others": None, "in_sumo": [], **dict.fromkeys(MEASURED),
        "below": low.what if low is not high else high.what if spacing is None else "the smallest looked at",
    }  # fmt: skip
    if spacing is not None:
        for share in SHARES:  # of the spacing itself it is known already
            done = share == 1.0 and high.of == plan.stops
            outcome = high if done else stopped(plan, row, share * spacing, range(plan.stops), out)[0]
            told["checked"].append({"share": share, **outcome.plain()})
        told["others"] = stopped(plan, row, spacing, range(plan.stops, 2 * plan.stops), out)[0].plain()
        told |= measured(plan, row, spacing, out)
        told["law_ms_per_train"] = law_time(plan, row, spacing, out)
        if sumo:
            told["in_sumo"] = in_sumo(plan, row, spacing, out)
    return {**told, "wall_time_s": time.perf_counter() - begun}


def _keys(plan: StopsPlan, row: str, spacing: float) -> dict[str, Any]:
    """The law's gains in this scenario, and its periods."""
    tables = scenario(plan, row, spacing, [0])
    keys = {key: value for key, value in tables["controller"].items() if key != "law"}
    periods = {"control_period_s": tables["run"].get("control_period_s", 1.0), "delay_s": tables["topology"]["delay_s"]}
    return {**keys, "weight": tables["topology"].get("weight"), **periods}


#: What is measured of a row at its smallest safe spacing, see ``measured``.
MEASURED = (
    "headway_s", "trains_per_hour", "journey_time_s", "energy_kwh_per_train_km", "jerk_rms_mps3", "string_gain",
    "messages_per_train_s", "law_ms_per_train",
)  # fmt: skip


def in_sumo(plan: StopsPlan, row: str, spacing: float, out: Path) -> list[dict[str, Any]]:
    """What comes of the stops where SUMO moves the trains: all at 95 % of a spacing and at it, and as many others at it."""
    asked = ((0.95, range(plan.stops)), (1.0, range(plan.stops)), (1.0, range(plan.stops, 2 * plan.stops)))
    return [
        {"share": share, "first": stops[0], **stopped(plan, row, share * spacing, stops, out, True)[0].plain()}
        for share, stops in asked
    ]


def measured(plan: StopsPlan, row: str, spacing: float, out: Path) -> dict[str, Any]:
    """What a row costs at a spacing, from two calm runs: the first train slows down by 2 m/s for a while, and goes on.

    Returns
    -------
    dict
        ``headway_s`` and ``trains_per_hour`` of the spacing at the speed of the reference; ``journey_time_s`` over 100 km and
        ``energy_kwh_per_train_km``, means of all trains; ``jerk_rms_mps3``; ``messages_per_train_s``, sent; ``string_gain``, the
        largest L2 gain from link to link in a run where nothing else disturbs: what is random makes errors on every link, so
        their ratio would say nothing of how they pass on.
    """
    headway = spacing / plan.speed_mps
    numbers: dict[str, Any] = {**dict.fromkeys(MEASURED), "headway_s": headway, "trains_per_hour": 3600.0 / headway}
    if (run := _calm(plan, row, spacing, out)) is not None:
        values, trains = run.metrics, run.trains
        speed = float(trains.groupby("train", observed=True)["speed_mps"].mean().mean())
        numbers |= {
            "journey_time_s": 100_000.0 / speed, "energy_kwh_per_train_km": values.get("energy.traction_kwh_per_train_km"),
            "jerk_rms_mps3": values.get("comfort.jerk_rms_mps3"),
            "messages_per_train_s": run.info["messages_sent"] / plan.trains / run.scenario["run"]["duration_s"],
        }  # fmt: skip
    if (run := _calm(plan.undisturbed, row, spacing, out)) is not None:
        numbers["string_gain"] = run.metrics.get("string.l2_gain")
    return numbers


def _calm(plan: StopsPlan, row: str, spacing: float, out: Path) -> Run | None:
    """The calm run of a row; None if it does not start, or failed."""
    from trainctl import runner
    from trainctl.scenario.build import open_scenario

    duration = 400.0
    tables = scenario(plan, row, spacing, [0])
    period = tables["run"].get("control_period_s", 1.0)
    tables["run"] = {**tables["run"], "duration_s": math.ceil(duration / period) * period, "record_every_s": 1.0}
    tables["event"] = [{"kind": "brake", "train": "0.1", "time_s": 40.0, "until_s": 60.0, "deceleration_mps2": 0.1}]
    longer = {**line(plan, spacing, 1), "length_m": math.ceil(plan.trains * spacing + 2.0 * plan.line_mps * duration + 20_000.0)}
    name = "calm" if plan.measured_m > 0.0 else "undisturbed"
    (out / "calm_line.toml").write_text(tomli_w.dumps(longer), encoding="utf-8")
    file = out / f"{name}.toml"
    file.write_text(tomli_w.dumps({**tables, "network": {"line": "calm_line.toml"}}), encoding="utf-8")
    try:
        return runner.run(open_scenario(str(file)), out / name, "numeric", True)
    except TrainctlError:
        return None


def law_time(plan: StopsPlan, row: str, spacing: float, out: Path, periods: int = 60) -> float | None:
    """Median time of a sampled law for one train and period, messages included [ms], from just before the first train brakes on.

    None: it is evaluated inside the plant.
    """
    loop = unwatched(prepared(plan, row, spacing, [0], out))
    if not loop.p.sampled:
        return None
    p, trains, took = loop.p, len(loop.p.scenario.ids), list[float]()
    while not loop.over and len(took) < periods:
        s = loop.state
        if loop.time >= plan.brakes_s - 5.0 and loop.k % p.scenario.run.held_steps == 0:
            memory = (s.memory,) if p.remembers else ()
            own = s.own[p.leading]
            now = Trains(own[:, POSITION].copy(), own[:, SPEED].copy(), loop.plant.believed_resistance(s.own))
            leader = s.formed.references.leader(loop.time)
            begun = time.perf_counter()
            p.law.message(s.formed.constants, now, leader, *memory)
            p.law.demand(s.formed.constants, now, leader, s.formed.links, s.messages.heard, *memory)
            took.append((time.perf_counter() - begun) / trains)
        loop.step()
    return float(1000.0 * np.median(took))


def compare(
    plan: StopsPlan,
    out: Path,
    rows: Sequence[str] = ROWS,
    workers: int | None = None,
    sumo: bool = False,
    resume: bool = False,
    progress: Callable[[int, int], Any] | None = None,
) -> list[dict[str, Any]]:
    """Find the smallest safe spacing of every row, each in a process of its own.

    Parameters
    ----------
    plan : StopsPlan
        What is asked.
    out : Path
        Receives ``spacing.json`` and a folder per row with its scenarios and ``row.json``.
    rows : sequence of str
        Some of ``ROWS``.
    workers : int, optional
        Rows at a time; default one per processor.
    sumo : bool
        As in ``found``.
    resume : bool
        Rows in ``out`` that are done, and asked the same, stay.
    progress : callable, optional
        Called with (rows done, rows).

    Returns
    -------
    list of dict
        As ``found``, one per row, in order.

    Raises
    ------
    InputError
        A number of the plan that makes no sense.
    """
    if mistakes := [*wrong(plan), *([f"--in-sumo: {left_out('libsumo')}"] if sumo and not has_sumo() else [])]:
        raise InputError(mistakes)
    out.mkdir(parents=True, exist_ok=True)
    todo = [row for row in rows if not (resume and _asked_the_same(plan, out / row))]
    if progress is not None:
        progress(len(rows) - len(todo), len(rows))
    with processes(workers or os.cpu_count() or 1) as pool:
        longest_first = sorted(todo, key=lambda row: LAW_ROWS[row].CLOCK == "sampled")
        waiting = [pool.submit(_kept, plan, row, out / row, sumo) for row in longest_first]
        for k, future in enumerate(as_completed(waiting), len(rows) - len(todo) + 1):
            future.result()
            if progress is not None:
                progress(k, len(rows))
    table = [json.loads((out / row / ROW).read_text(encoding="utf-8"))["found"] for row in rows]
    write_json(out / "spacing.json", {"plan": plan._asdict(), "lines": reference_lines(plan), "rows": table})
    return table


def _kept(plan: StopsPlan, row: str, out: Path, sumo: bool) -> None:
    """Find a row and keep what was found."""
    told = found(plan, row, out, sumo)
    new = out / f"{ROW}.new"
    write_json(new, {"plan": plan._asdict(), "found": told})
    os.replace(new, out / ROW)


def _asked_the_same(plan: StopsPlan, out: Path) -> bool:
    """Whether a row that is done lies there."""
    place = out / ROW
    return place.is_file() and json.loads(place.read_text(encoding="utf-8"))["plan"] == json.loads(json.dumps(plan._asdict()))
