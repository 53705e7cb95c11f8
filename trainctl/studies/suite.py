"""Every law in every situation: what happens to formations, in how many of some runs it goes wrong, with intervals, in one table.

The trains are those of ``studies.stops``: brakes, resistance, errors of the start, unknown forces and errors of
measurement differ from run to run, messages are late and some get lost. In each situation one thing happens besides. The runs of
a cell go side by side, each on a track of its own (with another one beside it where trains leave or join), in one closed loop
without a simulator.

A run fails if two trains touch or one is faster than the line. The first run of every cell is run in SUMO as well. What is random
in a run is a function of its number and of the seed.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import as_completed
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import tomli_w

from trainctl.errors import InputError, LawError
from trainctl.processes import processes
from trainctl.record.folder import write_json
from trainctl.signals import POSITION, SPEED
from trainctl.studies.capacity import BAND_MPS, LAW_ROWS
from trainctl.studies.results import wilson
from trainctl.studies.stops import REFUSED, ROUNDING_MPS, ROWS, StopsPlan, has_sumo, scenario, sumo, unwatched

if TYPE_CHECKING:
    from trainctl.loop import Loop
    from trainctl.scenario.model import Model
    from trainctl.signals import Bools, Floats

Tables = dict[str, Any]

#: When it happens, and how long a run lasts [s]. A switch locks a service braking distance ahead, so who takes one takes it later.
HAPPENS_S, SWITCHES_S, DURATION_S = 60.0, 120.0, 480.0

#: The train in the middle to which something happens: it leaves, or loses a part of its power.
MIDDLE = 3

#: Share of power and brakes a train has left that has lost one unit of four.
LEFT = 0.75

#: By how much masses are not as stated [%].
MASS_OFF = 5.0


class SuitePlan(NamedTuple):
    """What is asked."""

    runs: int = 20
    spacing_m: float = 3000.0
    stops: StopsPlan = StopsPlan()


class Cell(NamedTuple):
    """A law in a situation: numbers of all its runs."""

    row: str
    situation: str
    what: str  # "run", or REFUSED
    why: str
    failed: int
    of: int
    gap_m: float | None  # minimum of all
    error_m: float | None  # largest error of a spacing at the end: the median of the runs
    jerk_rms_mps3: float | None  # median of the runs
    contacts: int = 0  # of those that failed: trains touched
    faster_mps: float | None = None  # by how much the fastest train of all was faster than the line; below 0: nobody was
    first_gap_m: float | None = None  # minimum of the first run
    sumo_gap_m: float | None = None  # the same where SUMO moved the trains
    sumo_failed: bool | None = None  # whether the first run failed there; None: it was not run

    def plain(self) -> dict[str, Any]:
        """For machines, with the interval of the share that failed."""
        return {**self._asdict(), "interval_95": wilson(self.failed, self.of) if self.what != REFUSED else None}


# The situations: each changes the tables and the line of some runs


def _brakes(tables: Tables, line: Tables, runs: int, **more: Any) -> None:
    tables["event"] = [{"kind": "brake", "train": f"{k}.1", "time_s": HAPPENS_S, **more} for k in range(runs)]


def _calm(tables: Tables, line: Tables, runs: int) -> None:
    """Nothing happens."""


def _stop(tables: Tables, line: Tables, runs: int) -> None:
    """The first train brakes for 60 s as in service, and goes on."""
    _brakes(tables, line, runs, deceleration_mps2=0.3, until_s=HAPPENS_S + 60.0)


def _emergency_stop(tables: Tables, line: Tables, runs: int) -> None:
    """The first train brakes as hard as it can, to a stand."""
    _brakes(tables, line, runs, deceleration_mps2=5.0)


def _outage(tables: Tables, line: Tables, runs: int) -> None:
    """The first train brakes as in service, and for the first 6 s no radio works."""
    _stop(tables, line, runs)
    tables["event"].append({"kind": "outage", "train": "all", "time_s": HAPPENS_S, "until_s": HAPPENS_S + 6.0})


def _bursts(tables: Tables, line: Tables, runs: int) -> None:
    """The same with a channel that is bad for 10 s every 40 s in the mean."""
    _stop(tables, line, runs)
    tables["channel"] = {"good_s": 30.0, "bad_s": max(10.0, tables["run"].get("control_period_s", 1.0))}


def _gradient(tables: Tables, line: Tables, runs: int) -> None:
    """The line climbs and falls by 10 in a thousand."""
    first = float(tables["reference"]["position_m"])
    line["gradient"] = [[first + 3000.0, 10.0], [first + 9000.0, -10.0], [first + 15_000.0, 0.0]]


def _unit_lost(tables: Tables, line: Tables, runs: int) -> None:
    """The first train brakes as in service; one in the middle lacks a quarter of its power and brakes, and no law knows."""
    _stop(tables, line, runs)
    for name, kind in tables["train_type"].items():
        if name.endswith(f".{MIDDLE}"):
            kind |= {key: LEFT * kind[key] for key in ("traction_n", "traction_power_w", "braking_n")}


def _mass_off(tables: Tables, line: Tables, runs: int) -> None:
    """The first train brakes as in service; every train is 5 % heavier or lighter than stated, and no law knows."""
    _stop(tables, line, runs)
    for name, kind in tables["train_type"].items():
        k, i = (int(part) for part in name[1:].split("."))
        kind["mass_error_percent"] = float(np.random.default_rng([tables["run"]["seed"], k, i]).choice((-1.0, 1.0)) * MASS_OFF)


def _leave(tables: Tables, line: Tables, runs: int) -> None:
    """A train in the middle changes to a track beside, and those behind close up."""
    _beside(tables, line, runs, 1)
    train = {t["id"]: t for t in tables["train"]}
    tables["event"] = [
        {"kind": "reroute", "train": f"{k}.{MIDDLE}", "crossover": f"out{k}"} for k in range(runs) if f"{k}.{MIDDLE}" in train
    ]


def _join(tables: Tables, line: Tables, runs: int) -> None:
    """A train comes from a track beside into the middle of the formation, which makes room."""
    _beside(tables, line, runs, -1)
    spacing = float(tables["topology"]["spacing_m"])
    for train in tables["train"]:
        k, i = train["id"].split(".")
        if int(i) == MIDDLE:
            train["track"] = f"p{k}"
        elif int(i) > MIDDLE:
            train["position_m"] += 0.5 * spacing
    tables["event"] = [{"kind": "reroute", "train": f"{k}.{MIDDLE}", "crossover": f"in{k}"} for k in range(runs)]


def _beside(tables: Tables, line: Tables, runs: int, way: int) -> None:
    """A track beside that of every run, and a crossover to it, or from it, that is passed when it happens."""
    at = float(tables["reference"]["position_m"]) - (MIDDLE - 1) * float(tables["topology"]["spacing_m"])
    at += SWITCHES_S * float(tables["reference"]["speed_mps"])
    line["tracks"] = [track for k in range(runs) for track in (f"s{k}", f"p{k}")]
    ends = [("out", "s", "p"), ("in", "p", "s")][way < 0]
    line["crossover"] = [
        {"id": f"{ends[0]}{k}", "from": f"{ends[1]}{k}", "to": f"{ends[2]}{k}", "position_m": at, "length_m": 500.0,
         "speed_mps": float(line["speed"][0][1])}
        for k in range(runs)
    ]  # fmt: skip


SITUATIONS: Mapping[str, Callable[[Tables, Tables, int], None]] = {
    "calm": _calm, "join": _join, "leave": _leave, "stop": _stop, "emergency_stop": _emergency_stop, "outage": _outage,
    "bursts": _bursts, "gradient": _gradient, "mass_off": _mass_off, "unit_lost": _unit_lost,
}  # fmt: skip


def tables_of(plan: SuitePlan, row: str, situation: str) -> tuple[Tables, Tables]:
    """Tables of a cell's scenario, but for ``network``, and of its line."""
    law, stops = LAW_ROWS[row], plan.stops
    lower = stops.speed_mps - BAND_MPS if getattr(law, "BANDED", False) else 0.0
    tables = scenario(stops, row, plan.spacing_m, range(plan.runs), lower)
    tables["title"] = f"{situation.replace('_', ' ')} under {row.replace('_', ' ')}, {plan.runs} times"
    period = tables["run"].get("control_period_s", 1.0)
    tables["run"] = {**tables["run"], "duration_s": math.ceil(DURATION_S / period) * period}
    tables["event"] = []
    tables["topology"] = {**tables["topology"], "lower_m": 250.0}
    length = stops.trains * plan.spacing_m + 5000.0 + stops.line_mps * (DURATION_S + period) + 10_000.0
    line: Tables = {
        "name": "suite", "tracks": [f"s{k}" for k in range(plan.runs)], "length_m": math.ceil(length), "max_edge_m": 100_000.0,
        "speed": [[0.0, stops.line_mps]],
    }  # fmt: skip
    SITUATIONS[situation](tables, line, plan.runs)
    return tables, line


def cell(plan: SuitePlan, row: str, situation: str, folder: Path) -> Cell:
    """Run a cell, and its first run in SUMO as well, if that is installed; its files lie in ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    try:
        p = _prepared(plan, row, situation, folder)
    except InputError as error:
        return Cell(row, situation, REFUSED, error.mistakes[0].partition(": ")[2], 0, plan.runs, None, None, None)
    try:
        ran = _ran(unwatched(p), plan)
    except (LawError, InputError) as error:
        return Cell(row, situation, "run", str(error), plan.runs, plan.runs, None, None, None)
    found = Cell(
        row, situation, "run", "", int(ran.failed.sum()), plan.runs, float(ran.gap.min()), float(np.median(ran.error)),
        float(np.median(ran.jerk)), int((ran.gap < 0.0).sum()), float(ran.faster.max()), float(ran.gap[0]),
    )  # fmt: skip
    if not has_sumo():
        return found
    first = _prepared(plan._replace(runs=1), row, situation, folder)
    with sumo(first, folder) as world:
        there = _ran(unwatched(first, world), plan._replace(runs=1))
    return found._replace(sumo_gap_m=float(there.gap[0]), sumo_failed=bool(there.failed[0]))


def _prepared(plan: SuitePlan, row: str, situation: str, folder: Path) -> Model:
    """The scenario of a cell, checked."""
    from trainctl.scenario.build import open_scenario

    tables, line = tables_of(plan, row, situation)
    name = "scenario" if plan.runs > 1 else "first"
    (folder / f"{name}_line.toml").write_text(tomli_w.dumps(line), encoding="utf-8")
    file = folder / f"{name}.toml"
    file.write_text(tomli_w.dumps({**tables, "network": {"line": f"{name}_line.toml"}}), encoding="utf-8")
    return open_scenario(str(file))


class Ran(NamedTuple):
    """What came of runs side by side, one number for each."""

    failed: Bools
    gap: Floats  # m, minimum
    faster: Floats  # m/s, the fastest train less the line's speed
    error: Floats  # m, largest of a spacing at the end
    jerk: Floats  # m/s3, root mean square


def _ran(loop: Loop, plan: SuitePlan) -> Ran:
    """Run a cell's loop to its end."""
    p = loop.p
    of = np.array([int(name.partition(".")[0]) for name in p.scenario.ids])
    gap, faster, speeds = np.full(plan.runs, np.inf), np.full(plan.runs, -np.inf), list[Any]()
    while not loop.over:
        loop.step()
        _take_in(loop, of, gap)
        np.maximum.at(faster, of, loop.state.own[p.leading, SPEED] - plan.stops.line_mps)
        speeds.append(loop.state.own[p.leading, SPEED].copy())
    jerk = np.square(np.diff(np.array(speeds), 2, axis=0) / p.scenario.run.step_s**2).mean(axis=0)
    failed = (gap < 0.0) | (faster > ROUNDING_MPS)
    return Ran(failed, gap, faster, _errors(loop, of), np.sqrt(np.bincount(of, jerk) / np.bincount(of)))


def _take_in(loop: Loop, of: Any, gap: Floats) -> None:
    """The present instant: gaps to the train ahead in each formation; of runs that touched nothing more."""
    own, ahead, length = loop.state.own[loop.p.leading], loop.state.formed.ahead, loop.p.consists.train_length()
    follows = np.flatnonzero(ahead >= 0)
    gaps = own[ahead[follows], POSITION] - length[ahead[follows]] - own[follows, POSITION]
    touched = gap < 0.0
    live = ~touched[of[follows]]
    np.minimum.at(gap, of[follows][live], gaps[live])


def _errors(loop: Loop, of: Any) -> Floats:
    """Largest error of a spacing in every run now [m]."""
    links, position = loop.state.formed.links, loop.state.own[loop.p.leading, POSITION]
    assert links is not None
    wrong = np.abs(position[links.sender] - position[links.receiver] - links.desired)
    found = np.zeros(int(of.max()) + 1)
    np.maximum.at(found, of[links.receiver], wrong)
    return found


def compare(
    plan: SuitePlan,
    out: Path,
    rows: Sequence[str] = ROWS,
    situations: Sequence[str] = tuple(SITUATIONS),
    workers: int | None = None,
    resume: bool = False,
    progress: Callable[[int, int], Any] | None = None,
) -> list[dict[str, Any]]:
    """Run every cell; those that are done already stay where ``resume`` says so.

    Parameters
    ----------
    plan : SuitePlan
        What is asked.
    out : Path
        Receives ``cells/ROW/SITUATION`` with the scenario and its ``cell.json``, and ``suite.json``.
    rows, situations : sequence of str
        Some of the laws and situations.
    workers : int, optional
        Cells at a time; default one per processor.
    resume : bool
        Go on with what is in ``out``.
    progress : callable, optional
        Called with (cells done, cells).

    Returns
    -------
    list of dict
        The cells, row by row: as ``Cell``, and ``interval_95`` of the share that failed. The same whatever ``workers`` is.

    Raises
    ------
    InputError
        The suite in ``out`` asks something else, or a number of the plan makes no sense.
    """
    if plan.runs < 1 or plan.spacing_m <= 300.0:
        raise InputError("--runs: must be at least 1" if plan.runs < 1 else "--spacing-m: must be above 300")
    asked = {"runs": plan.runs, "spacing_m": plan.spacing_m, "stops": plan.stops._asdict()}
    note = out / "plan.json"
    if resume and note.is_file() and json.loads(note.read_text(encoding="utf-8")) != json.loads(json.dumps(asked)):
        raise InputError(f"--resume: the suite in {out} has another plan: see its plan.json")
    out.mkdir(parents=True, exist_ok=True)
    write_json(note, asked)
    places = {(row, name): out / "cells" / row / name for row in rows for name in situations}
    todo = [key for key, place in places.items() if not (resume and (place / "cell.json").is_file())]
    if progress is not None:
        progress(len(places) - len(todo), len(places))
    with processes(workers or os.cpu_count() or 1) as pool:
        waiting = [pool.submit(_kept, plan, *key, places[key]) for key in todo]
        for k, future in enumerate(as_completed(waiting), len(places) - len(todo) + 1):
            future.result()
            if progress is not None:
                progress(k, len(places))
    cells = [json.loads((place / "cell.json").read_text(encoding="utf-8")) for place in places.values()]
    write_json(out / "suite.json", {"plan": asked, "cells": cells})
    return cells


def _kept(plan: SuitePlan, row: str, situation: str, place: Path) -> None:
    """Run a cell and keep what came of it; a cell that is not complete leaves no ``cell.json``."""
    found = cell(plan, row, situation, place).plain()
    new = place / "cell.json.new"
    write_json(new, found)
    os.replace(new, place / "cell.json")
