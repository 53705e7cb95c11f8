"""How much a line carries: the same trains on the same stretch at the same top speed, under SUMO's blocks and under each law.

Every row is a run of its own on one line: a lead-in, the stretch that is measured, a run-out. What is counted, alike for all rows:

* **headway**: time between the fronts of two consecutive trains at the end of the stretch;
* **journey time**: from a train's front at the beginning of the stretch, or from where it enters there, to the end;
* **energy**: work of tractive forces at the wheel on the stretch;
* **collisions, gaps**: of trains whose front is on the stretch.

SUMO's own trains wait at the beginning of the stretch and enter as soon as SUMO lets them. In the rows ``fixed_block`` and
``moving_block`` that is at whatever speed is safe, as SUMO does by itself: they enter as densely as they can, and slow each other
down. In the rows ``..._at_speed`` they enter at the line's speed, and so far apart that none is ever held up. Cooperative trains
come from the lead-in as a formation at cruising speed, with small random errors. Their reference is slower than the line by
``reserve_mps``: a law needs room above its reference to close up, and no train may be faster than the line.

All trains are SUMO's ICE 3: 420 t, rotating mass factor 1.04, 200 m, 300 kN and 8 MW, brakes of 0.5 m/s2 (``MSCFModel_Rail.h`` of
SUMO). Its table of running resistance is fitted by a Davis form within 0.33 kN (0.5 %).
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import tomli_w

import sumo_net
from sumo_net import LineError
from trainctl.controllers.sumo import LONGEST_BLOCK_M
from trainctl.errors import InputError, TrainctlError
from trainctl.laws import compared
from trainctl.processes import ended_with, spawned

if TYPE_CHECKING:
    import pandas as pd

    from trainctl.runs.run import Run
    from trainctl.signals import Floats

#: SUMO's ICE 3 as a ``[train_type]``. Braking: 0.5 m/s2 of the inertia.
ICE3 = {
    "units": 1, "unit_length_m": 200.0, "unit_mass_kg": 420e3, "rotating_mass_factor": 1.04,
    "c0_n_per_kg": 1.761e-2, "c1_ns_per_m_kg": 1.236e-4, "c2_ns2_per_m2_kg": 2.071e-5,
    "traction_n": 300e3, "traction_power_w": 8e6, "braking_n": 218.4e3, "actuator_rate_per_s": 50.0,
}  # fmt: skip

#: Deceleration SUMO brakes an ICE 3 with [m/s2], and what it keeps to the train ahead under moving block [m].
SUMO_BRAKING_MPS2, SUMO_MARGIN_M = 0.5, 50.0

#: Coefficients of the running resistance, constant to square.
DAVIS = ("c0_n_per_kg", "c1_ns_per_m_kg", "c2_ns2_per_m2_kg")

#: Rows of the table.
SUMO_ROWS = ("fixed_block", "moving_block", "fixed_block_at_speed", "moving_block_at_speed")
LAW_ROWS = {row: law for row, law in compared().items() if hasattr(law, "on_a_line")}
ROWS = (*SUMO_ROWS, *LAW_ROWS)

#: What is measured of a row, see ``measure``.
MEASURED = (
    "headway_s", "headway_mean_s", "trains_per_hour", "journey_time_s", "energy_kwh_per_train_km", "collisions", "least_gap_m",
    "spacing_m", "speed_mean_mps", "speed_max_mps", "trains", "wall_time_s",
)  # fmt: skip

#: Columns of the printed table -> keys.
COLUMNS = {
    "row": "row", "headway [s]": "headway_s", "mean [s]": "headway_mean_s", "trains/h": "trains_per_hour",
    "journey [s]": "journey_time_s", "kWh/km": "energy_kwh_per_train_km", "collided": "collisions",
    "minimum gap [m]": "least_gap_m", "spacing [m]": "spacing_m", "wall time [s]": "wall_time_s",
}  # fmt: skip

LINE_FILE = "capacity.toml"

#: How much slower than the reference a train may be under the laws that bound its speed [m/s].
BAND_MPS = 0.5

#: Time after the last train should have passed [s].
SPARE_S = 120.0


class Found(NamedTuple):
    """The smallest safe spacing of a row, from `trainctl compare spacing`."""

    row: str
    spacing_m: float
    braking_mps2: tuple[float, float]  # full braking of the worst and of the best brakes


class CapacityPlan(NamedTuple):
    """What is compared."""

    trains: int = 40
    length_m: float = 100_000.0  # of the stretch that is measured
    speed_mps: float = 83.333  # of the line
    signals_m: float = 2000.0
    spacing_m: float = 3000.0  # of the formations, front to front
    reserve_mps: float = 1.0  # by which their reference is slower than the line
    position_error_m: float = 20.0  # of the formation at the start, uniform, either way
    speed_error_mps: float = 0.3
    seed: int = 1
    found: tuple[Found, ...] = ()  # rows whose formations keep the smallest safe spacing instead

    def found_of(self, row: str) -> Found | None:
        """What was found for a row, None if nothing was."""
        return next((found for found in self.found if found.row == row), None)

    def spacing_of(self, row: str) -> float:
        """Spacing of a row's formation [m]."""
        found = self.found_of(row)
        return self.spacing_m if found is None else found.spacing_m

    @property
    def begin_m(self) -> float:
        """Where the stretch begins: the formation stands before it. At a signal."""
        widest = max([self.spacing_m, *(found.spacing_m for found in self.found)])
        lead_in = (self.trains - 1) * widest + 2.0 * self.position_error_m + 1000.0
        return math.ceil(lead_in / self.signals_m) * self.signals_m

    @property
    def end_m(self) -> float:
        """Where the stretch ends."""
        return self.begin_m + self.length_m

    @property
    def cruise_mps(self) -> float:
        """Reference of the formations."""
        return self.speed_mps - self.reserve_mps


def line(plan: CapacityPlan) -> dict[str, Any]:
    """The line's description; its run-out is as long as the lead-in, so that a whole formation leaves the stretch."""
    return {
        "name": "capacity", "tracks": ["1"], "length_m": plan.end_m + plan.begin_m + SPARE_S * plan.speed_mps + 5000.0,
        "max_edge_m": 10_000.0, "signals_m": plan.signals_m, "speed": [[0.0, plan.speed_mps]],
    }  # fmt: skip


def scenario(plan: CapacityPlan, row: str) -> dict[str, Any]:
    """Tables of a row's scenario, but for ``network``."""
    n, spacing = plan.trains, plan.spacing_of(row)
    errors = np.random.default_rng(plan.seed).uniform(-1.0, 1.0, (n, 2)) * (plan.position_error_m, plan.speed_error_mps)
    first = plan.begin_m - 2.0 * plan.position_error_m
    trains = [
        {"id": i + 1, "type": "ice3", "track": 1, "position_m": first - i * spacing + float(errors[i, 0]),
         "speed_mps": plan.cruise_mps + float(errors[i, 1])}
        for i in range(n)
    ]  # fmt: skip
    way = (n - 1) * spacing + plan.length_m
    tables: dict[str, Any] = {
        "schema_version": 1,
        "title": f"{n} trains over {plan.length_m / 1000:g} km: {row.replace('_', ' ')}",
        "run": {"duration_s": math.ceil(way / plan.cruise_mps + SPARE_S), "step_s": 1.0, "sub_step_s": 0.1, "seed": plan.seed},
        "plant": {"kind": "coupled_units"},
        "reference": {"speed_mps": plan.cruise_mps, "position_m": first},
        "bounds": {"speed_upper_mps": plan.speed_mps},
        "topology": {"spacing_m": spacing, "lower_m": 0.5 * spacing, "upper_m": 1.5 * spacing},
        "train_type": {"ice3": ICE3},
        "train": trains,
    }
    if row in SUMO_ROWS:
        return {**tables, **_sumo(plan, row, tables)}
    law = LAW_ROWS[row]
    tables["controller"] = {"law": law.__name__.rpartition(".")[2], **law.COMPARED[row]}
    found = plan.found_of(row)
    if found is not None and hasattr(law, "in_stops"):  # with the gains it was found with
        return {**tables, **law.in_stops(tables, _band(plan), found.braking_mps2)}
    return {**tables, **law.on_a_line(tables, _band(plan))}


def _sumo(plan: CapacityPlan, row: str, tables: dict[str, Any]) -> dict[str, Any]:
    """Tables of one of SUMO's rows."""
    block = row.partition("_")[0]
    controller = {"law": "sumo", "block": block, "entry_m": plan.begin_m, "top_speed_mps": plan.speed_mps}
    if row.endswith("at_speed"):
        controller |= {"entry_speed_mps": plan.speed_mps, "entry_every_s": math.ceil(headway_bound(plan, block))}
    return {"controller": controller, "run": {**tables["run"], "duration_s": math.ceil(sumo_duration(plan))}}


def headway_bound(plan: CapacityPlan, block: str) -> float:
    """Minimum time between two trains [s] of which the second never brakes, if the first keeps the line's speed.

    It sees the absolute braking distance ahead of it free: up to the last signal before the train ahead, or up to 50 m from it. The
    step of 1 s in which SUMO decides comes on top.
    """
    braking = plan.speed_mps**2 / (2.0 * SUMO_BRAKING_MPS2)
    behind = plan.signals_m if block == "fixed" else SUMO_MARGIN_M
    return (braking + behind + float(ICE3["unit_length_m"])) / plan.speed_mps + 1.0


def sumo_duration(plan: CapacityPlan) -> float:
    """Time in which SUMO's trains are surely through [s]: all enter one after the other, each twice as slow as it should be."""
    braking = plan.speed_mps**2 / (2.0 * SUMO_BRAKING_MPS2)
    return 2.0 * (plan.trains * (braking + 2.0 * plan.signals_m) + plan.length_m) / plan.speed_mps + 1000.0


def _band(plan: CapacityPlan) -> dict[str, float]:
    """Speed bounds for the laws that have both."""
    return {"speed_lower_mps": plan.cruise_mps - BAND_MPS, "speed_upper_mps": plan.speed_mps}


def found_in(file: Path) -> tuple[Found, ...]:
    """The spacings that `trainctl compare spacing` wrote into ``file``, its ``spacing.json``.

    Raises
    ------
    InputError
        No such file, or not one of these.
    """
    from trainctl.studies.stops import StopsPlan

    try:
        told = json.loads(file.read_text(encoding="utf-8"))
        braking = StopsPlan(**told["plan"]).braking
        rows = [(str(row["row"]), row["spacing_m"]) for row in told["rows"]]
        return tuple(Found(row, float(spacing), braking) for row, spacing in rows if spacing is not None)
    except OSError as error:
        raise InputError(f"--spacings {file}: {error.strerror}") from None
    except (ValueError, TypeError, KeyError):
        raise InputError(f"--spacings {file}: must be a spacing.json of `trainctl compare spacing`") from None


# What is measured


def measure(run: Run, plan: CapacityPlan) -> dict[str, Any]:
    """A row of the table from a finished run, without its name.

    Parameters
    ----------
    run : Run
        A run of one of the ``ROWS``.
    plan : CapacityPlan
        What it was made from.

    Returns
    -------
    dict
        ``headway_s`` (median), ``headway_mean_s``, ``trains_per_hour``, ``journey_time_s`` and ``energy_kwh_per_train_km`` (means
        over the trains), ``collisions``, ``least_gap_m``, ``spacing_m`` (median at the end of the stretch), ``speed_mean_mps``,
        ``speed_max_mps``, ``trains`` (that passed the end), ``wall_time_s``; None where no train passed.
    """
    frame = run.trains
    on = frame["position_m"].between(plan.begin_m, plan.end_m)
    there = frame[on]
    journeys = [j for _, rows in frame.groupby("train", observed=True) if (j := journey(rows, plan)) is not None]
    left = np.sort([j.left_s for j in journeys])
    headways = np.diff(left)
    times, works = (np.array([getattr(j, key) for j in journeys]) for key in ("time_s", "traction_j"))
    way = np.array([j.way_m for j in journeys])
    spacings = np.array([j.spacing_m for j in journeys])
    inside = there[there["gap_m"] < 0.0]
    some = len(headways) > 0
    return {
        "headway_s": float(np.median(headways)) if some else None,
        "headway_mean_s": float(headways.mean()) if some else None,
        "trains_per_hour": float(3600.0 / headways.mean()) if some else None,
        "journey_time_s": float(times.mean()) if journeys else None,
        "energy_kwh_per_train_km": float(works.sum() / 3.6e6 / (way.sum() / 1000.0)) if journeys else None,
        "collisions": int(inside["train"].nunique()),
        "least_gap_m": _finite(there["gap_m"].min()),
        "spacing_m": _finite(np.nanmedian(spacings)) if np.isfinite(spacings).any() else None,
        "speed_mean_mps": float(way.sum() / times.sum()) if journeys else None,
        "speed_max_mps": _finite(there["speed_mps"].max()),
        "trains": len(journeys),
        "wall_time_s": float(run.info["wall_time_s"]),
    }


class Journey(NamedTuple):
    """One train over the stretch."""

    left_s: float  # when its front passed the end
    time_s: float  # it took
    way_m: float  # from the beginning of the stretch, or from where it entered the net
    traction_j: float
    spacing_m: float  # to the train ahead as it left; NaN for the first


def journey(rows: pd.DataFrame, plan: CapacityPlan) -> Journey | None:
    """The journey of one train; None if it did not reach the end. Between two rows everything is taken to grow evenly."""
    position, time = rows["position_m"].to_numpy(), rows["time_s"].to_numpy()
    if position[0] >= plan.end_m or position[-1] < plan.end_m:
        return None
    begin = max(plan.begin_m, float(position[0]))
    work = np.cumsum(_traction(rows))
    entered, left = np.interp([begin, plan.end_m], position, time)
    spent = np.diff(np.interp([begin, plan.end_m], position, work))
    spacing = float(np.interp(plan.end_m, position, rows["spacing_m"].to_numpy()))
    return Journey(float(left), float(left - entered), plan.end_m - begin, float(spent[0]), spacing)


def _traction(rows: pd.DataFrame) -> Floats:
    """Traction work since the row before [J]; what came before the first row is none of it."""
    work: Floats = np.nan_to_num(rows["traction_j"].to_numpy(dtype=np.float64))
    work[:1] = 0.0
    return work


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


# Running all rows


def compare(
    plan: CapacityPlan,
    out: Path,
    rows: Sequence[str] = ROWS,
    workers: int | None = None,
    progress: Callable[[int, int], Any] | None = None,
) -> list[dict[str, Any]]:
    """Run all rows, each in a process of its own, and measure them.

    Parameters
    ----------
    plan : CapacityPlan
        What is compared.
    out : Path
        Receives the line (``capacity.toml``), the scenarios (``ROW.toml``) and the run folders (``ROW``).
    rows : sequence of str
        Some of ``ROWS``.
    workers : int, optional
        Runs at a time; default one per processor.
    progress : callable, optional
        Called with (rows done, rows).

    Returns
    -------
    list of dict
        One per row, in order: ``row``, what ``measure`` gives, ``error`` (None, or why the row has no numbers).

    Raises
    ------
    InputError
        The plan makes no line.
    """
    prepare_files(plan, out, rows)
    done: dict[str, dict[str, Any]] = {}
    if progress is not None:
        progress(0, len(rows))
    with ended_with(pool := ThreadPoolExecutor(workers or os.cpu_count() or 1)):
        waiting = {pool.submit(_alone, out / f"{row}.toml", out / row, plan): row for row in rows}
        for k, future in enumerate(as_completed(waiting), 1):
            done[waiting[future]] = future.result()
            if progress is not None:
                progress(k, len(rows))
    return [{"row": row, **done[row]} for row in rows]


def prepare_files(plan: CapacityPlan, out: Path, rows: Sequence[str]) -> None:
    """Write the line and the scenarios of the rows."""
    found = [f"--{key}: must be {rule}" for key, rule, holds in (
        ("trains", "at least 2", plan.trains >= 2),
        ("length-km", "above 0", plan.length_m > 0.0),
        ("speed-mps", f"above {plan.reserve_mps + BAND_MPS:g}, at most 200", plan.reserve_mps + BAND_MPS < plan.speed_mps <= 200.0),
        ("signals-m", f"10 .. {LONGEST_BLOCK_M:g}", 10.0 <= plan.signals_m <= LONGEST_BLOCK_M),
        ("spacing-m", "above 500", plan.spacing_m > 500.0),
    ) if not holds]  # fmt: skip
    if found:
        raise InputError(found)
    try:
        sumo_net.parse_spec(line(plan), "compare capacity")
    except LineError as error:
        raise InputError(error.mistakes) from None
    out.mkdir(parents=True, exist_ok=True)
    (out / LINE_FILE).write_text(tomli_w.dumps(line(plan)), encoding="utf-8")
    for row in rows:
        tables = {**scenario(plan, row), "network": {"line": LINE_FILE}}
        (out / f"{row}.toml").write_text(tomli_w.dumps(tables), encoding="utf-8")


def _alone(file: Path, out: Path, plan: CapacityPlan) -> dict[str, Any]:
    """Run a row in a process that ends with it: libsumo holds one simulation, and a crash is that row's only."""
    try:
        with spawned(1) as process:
            return process.submit(one, file, out, plan).result()
    except (BrokenProcessPool, OSError) as error:
        return {**dict.fromkeys(MEASURED), "error": str(error)}


def one(file: Path, out: Path, plan: CapacityPlan) -> dict[str, Any]:
    """Run and measure one row in this process; why it failed, if it did."""
    from trainctl import runner
    from trainctl.scenario.build import open_scenario

    try:
        done = runner.run(open_scenario(str(file)), out, command_line=["trainctl", "compare", "capacity"])
    except TrainctlError as error:
        return {**dict.fromkeys(MEASURED), "error": str(error).replace("\n", "; ")}
    return {**measure(done, plan), "error": None}


# The figure


#: Panels: key -> label.
PANELS = {
    "headway_s": "headway at\nthe end [s]", "trains_per_hour": "trains per\nhour [1/h]", "journey_time_s": "journey\ntime [s]",
    "energy_kwh_per_train_km": "traction energy\n[kWh per train-km]", "least_gap_m": "minimum gap [m]\n(collisions)",
}  # fmt: skip


def figure(table: Sequence[dict[str, Any]], plan: CapacityPlan, path: Path, formats: Sequence[str] = ("png",)) -> list[Path]:
    """Draw the table as bars, with what each row could reach at best dashed.

    Dashed is steady running that nothing hinders: in SUMO's rows at the speed of the line and the minimum headway without braking;
    in the laws' rows at cruising speed and the desired spacing.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from trainctl.figures import style

    with style.styled():
        drawn = Figure(figsize=(style.WIDTHS_MM["double"] / 25.4, (8.0 * len(table) + 26.0) / 25.4), layout="constrained")
        FigureCanvasAgg(drawn)
        places = np.arange(len(table))
        own = [row["row"] in SUMO_ROWS for row in table]
        for axes, (key, label) in zip(drawn.subplots(1, len(PANELS), sharey=True), PANELS.items(), strict=True):
            values = np.array([math.nan if row[key] is None else row[key] for row in table], dtype=np.float64)
            best = [ideal(plan, row["row"])[key] for row in table]
            for side, colour, name in ((True, style.COLOURS[0], "SUMO's own trains"), (False, style.COLOURS[4], "laws")):
                chosen = np.array(own) == side
                axes.barh(places[chosen], np.nan_to_num(values[chosen]), color=colour, height=0.7, label=name)
            axes.vlines(
                best, places - 0.45, places + 0.45, color="black", linestyle=(0, (2.5, 1.2)), label="unhindered at top speed"
            )
            axes.set_xlim(0.0, 1.05 * np.nanmax([*values, *best]))
            for place, value in enumerate(values.tolist()):
                words = " failed " if math.isnan(value) else f" {value:.4g} "
                if key == "least_gap_m" and not math.isnan(value):
                    words += f"({table[place]['collisions']}) "
                fits = value > 0.4 * axes.get_xlim()[1]
                axes.text(
                    0.0 if fits or math.isnan(value) else value, place, words, va="center", fontsize=6.0,
                    color="white" if fits and own[place] else "black",
                )  # fmt: skip
            axes.set_xlabel(label)
            axes.grid(visible=False, axis="y")
        drawn.axes[0].set_yticks(places, [row["row"].replace("_", " ") for row in table])
        drawn.axes[0].invert_yaxis()
        style.legend(drawn, "double")
        return style.save(drawn, path, formats)


def ideal(plan: CapacityPlan, row: str) -> dict[str, float]:
    """What a row could reach at best, by the keys of ``PANELS``."""
    own = row in SUMO_ROWS
    speed = plan.speed_mps if own else plan.cruise_mps
    headway = headway_bound(plan, row.partition("_")[0]) if own else plan.spacing_of(row) / speed
    force = ICE3["unit_mass_kg"] * sum(ICE3[key] * speed**k for k, key in enumerate(DAVIS))
    return {
        "headway_s": headway, "trains_per_hour": 3600.0 / headway, "journey_time_s": plan.length_m / speed,
        "energy_kwh_per_train_km": force * 1000.0 / 3.6e6, "least_gap_m": headway * speed - ICE3["unit_length_m"],
    }  # fmt: skip
