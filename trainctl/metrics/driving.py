"""Metrics of how the trains are driven: couplers and unit forces, energy, comfort."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from trainctl.metrics.values import Values, at_least, at_most, put_worst
from trainctl.runs.known import Facts
from trainctl.runs.series import Series, advance, turns
from trainctl.signals import Bools, Floats

JOULES_PER_KWH = 3.6e6
#: Below this speed electric brakes give way to friction [m/s] (10 km/h).
ELECTRIC_BRAKE_FROM_MPS = 10 / 3.6

DEFINITIONS: dict[str, tuple[str, str]] = {
    "units.coupler_min_m": ("m", "Maximum compression of a coupler over all sub-steps, negative."),
    "units.coupler_max_m": ("m", "Maximum stretch of a coupler over all sub-steps."),
    "units.coupler_stroke_m": ("m", "Largest difference between maximum stretch and maximum compression of one coupler."),
    "units.coupler_force_min_n": ("N", "Maximum pushing coupler force at the recorded instants, negative."),
    "units.coupler_force_max_n": ("N", "Maximum pulling coupler force at the recorded instants."),
    "units.force_min_n": ("N", "Maximum braking force of a unit over all sub-steps, negative."),
    "units.force_max_n": ("N", "Maximum tractive force of a unit over all sub-steps."),
    "units.power_traction_max_w": ("W", "Maximum force times speed of a unit at the recorded instants."),
    "units.power_braking_max_w": ("W", "Maximum braking force times speed of a unit at the recorded instants."),
    "units.saturated_share": ("1", "Share of recorded train steps in which the law or a unit limit was saturated."),
    "energy.source": (
        "text", "Where the forces come from: integrated over the sub-steps; unit forces held between rows; input times mass held "
        "between rows; input per mass (no mass known: then per tonne)."),
    "energy.traction_kwh": ("kWh", "Work of tractive forces at the wheel."),
    "energy.braking_kwh": ("kWh", "Work of braking forces at the wheel, positive."),
    "energy.regenerable_kwh": ("kWh", "Part of the braking work done above 10 km/h, where electric brakes act; before losses."),
    "energy.net_kwh": ("kWh", "Traction minus regenerable: the minimum that the supply would give."),
    "energy.traction_kwh_per_train_km": ("kWh/km", "Traction over distance covered by all trains."),
    "energy.net_kwh_per_train_km": ("kWh/km", "Net over distance covered by all trains."),
    "energy.traction_kwh_per_t": ("kWh/t", "As traction_kwh, per mass, where no mass is known."),
    "energy.braking_kwh_per_t": ("kWh/t", "As braking_kwh, per mass, where no mass is known."),
    "comfort.acceleration_min_mps2": ("m/s2", "Strongest deceleration, from differences of the recorded speeds."),
    "comfort.acceleration_max_mps2": ("m/s2", "Strongest acceleration, from differences of the recorded speeds."),
    "comfort.jerk_max_mps3": ("m/s3", "Largest absolute jerk, from second differences of the recorded speeds."),
    "comfort.jerk_rms_mps3": ("m/s3", "Root mean square over time of that jerk."),
}  # fmt: skip


def distance(trains: Series, rows: slice, turned: Bools) -> float:
    """Distance between the first and the last row of a series [m]; see ``runs.series.turns`` for ``turned``."""
    position = trains.column("position_m")[rows]
    over = np.flatnonzero(turned[rows])
    jumps = float((position[over + 1] - position[over]).sum())
    return float(position[-1] - position[0]) - jumps + float(advance(trains, turned)[rows][over].sum() if len(over) else 0.0)


def of_units(trains: Series, units: Series) -> Values:
    """Couplers, unit forces and powers, share of saturated steps."""
    values: Values = {}
    if trains.names:
        values["units.saturated_share"] = float(trains.column("saturated").mean())
    if not units.names:
        return values
    lowest, highest = at_most(units, "coupler_min_m", "coupler_m"), at_least(units, "coupler_max_m", "coupler_m")
    put_worst(values, "units.coupler_min_m", units, lowest, np.minimum)
    put_worst(values, "units.coupler_max_m", units, highest, np.maximum)
    strokes = [float(np.nanmax(highest[k]) - np.nanmin(lowest[k])) for _, k in units.slices() if not np.isnan(highest[k]).all()]
    if strokes:
        values["units.coupler_stroke_m"] = max(strokes)
    force, power = units.column("force_n"), units.column("force_n") * units.column("speed_mps")
    put_worst(values, "units.coupler_force_min_n", units, units.column("coupler_force_n"), np.minimum)
    put_worst(values, "units.coupler_force_max_n", units, units.column("coupler_force_n"), np.maximum)
    put_worst(values, "units.force_min_n", units, at_most(units, "force_min_n", "force_n"), np.minimum)
    put_worst(values, "units.force_max_n", units, at_least(units, "force_max_n", "force_n"), np.maximum)
    put_worst(values, "units.power_traction_max_w", units, np.where(force > 0, power, 0.0 * force), np.maximum)
    put_worst(values, "units.power_braking_max_w", units, np.where(force < 0, -power, 0.0 * force), np.maximum)
    return values


def of_energy(trains: Series, units: Series, known: Facts, events: Sequence[Mapping[str, Any]]) -> Values:
    """Work at the wheel: traction, braking, what could be regenerated, per train-km; ``events`` tell of turns."""
    if not trains.names:
        return {}
    values: Values = {}
    suffix, turned = "", turns(trains, events)
    if {"traction_j", "braking_j"} <= set(trains.numbers):
        source = "integrated over the sub-steps"
        electric = trains.column("speed_mps") > ELECTRIC_BRAKE_FROM_MPS
        traction, braking = np.nan_to_num(trains.column("traction_j")), np.nan_to_num(trains.column("braking_j"))
    elif units.names:
        source = "unit forces held between rows"
        traction, braking, electric = _works(units, units.column("force_n"), turns(units, events))
    elif set(trains.names) <= set(known.mass_kg):
        source = "input times mass held between rows"
        mass = np.repeat([sum(known.mass_kg[name]) for name in trains.names], np.diff(trains.first))
        traction, braking, electric = _works(trains, trains.column("input_mps2") * mass, turned)
    else:
        source, suffix = "input per mass", "_per_t"
        traction, braking, electric = _works(trains, trains.column("input_mps2") * 1000.0, turned)
    values["energy.source"] = source
    values[f"energy.traction_kwh{suffix}"] = spent = float(traction.sum()) / JOULES_PER_KWH
    values[f"energy.braking_kwh{suffix}"] = float(braking.sum()) / JOULES_PER_KWH
    if suffix:
        return values
    values["energy.regenerable_kwh"] = back = float(braking[electric].sum()) / JOULES_PER_KWH
    values["energy.net_kwh"] = spent - back
    kilometres = sum(distance(trains, rows, turned) for _, rows in trains.slices()) / 1000
    if kilometres > 0:
        values["energy.traction_kwh_per_train_km"] = spent / kilometres
        values["energy.net_kwh_per_train_km"] = (spent - back) / kilometres
    split = trains if len(traction) == len(trains) else units
    for item, rows in split.slices():
        values[f"energy.traction_kwh/{item}"] = float(traction[rows].sum()) / JOULES_PER_KWH
        values[f"energy.braking_kwh/{item}"] = float(braking[rows].sum()) / JOULES_PER_KWH
    return values


def _works(split: Series, force: Floats, turned: Bools) -> tuple[Floats, Floats, np.ndarray]:
    """Traction and braking work [J] of each row until the next one, exact for a held force, and where it is above 10 km/h."""
    speed = split.column("speed_mps")
    work = np.nan_to_num(force) * advance(split, turned)
    return np.maximum(work, 0.0), np.maximum(-work, 0.0), speed > ELECTRIC_BRAKE_FROM_MPS


def of_comfort(trains: Series) -> Values:
    """Acceleration and jerk from differences of the recorded speeds."""
    if not trains.names:
        return {}
    values: Values = {}
    time, speed, follows = trains.column("time_s"), trains.column("speed_mps"), trains.follows()
    dt = np.full(len(time), np.nan)
    dt[1:] = np.where(follows[1:], np.diff(time), np.nan)
    acceleration = np.full(len(time), np.nan)  # over the step that ends at this row
    acceleration[1:] = np.diff(speed) / dt[1:]
    middle = np.full(len(time), np.nan)  # from the middle of the step before to the middle of this one
    middle[1:] = 0.5 * (dt[1:] + dt[:-1])
    jerk = np.full(len(time), np.nan)
    jerk[1:] = np.diff(acceleration) / middle[1:]
    put_worst(values, "comfort.acceleration_min_mps2", trains, acceleration, np.minimum)
    put_worst(values, "comfort.acceleration_max_mps2", trains, acceleration, np.maximum)
    put_worst(values, "comfort.jerk_max_mps3", trains, np.abs(jerk), np.maximum)
    known = np.isfinite(jerk)
    if known.any():
        values["comfort.jerk_rms_mps3"] = float(np.sqrt(np.sum(jerk[known] ** 2 * middle[known]) / np.sum(middle[known])))
    return values
