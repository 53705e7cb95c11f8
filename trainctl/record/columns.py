"""Columns of numbers that every run has, each once: its name, and its values from an instant of the loop.

``Recorder.standard_tables`` puts the names of trains, tracks and edges before them; what only some runs have comes behind them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from trainctl.scenario.roster import Stop
from trainctl.signals import POSITION, SPEED, Consists, Extremes, Floats, Row


class Instant(NamedTuple):
    """An instant of all trains."""

    row: Row
    spacing: Floats  # (n,) m, front to front to the train ahead in the formation, NaN for the first
    length: Floats  # (n,) m


class Units(NamedTuple):
    """An instant of all units."""

    own: Floats  # (U, s)
    consists: Consists
    stretch: Floats  # (U,) m, of the coupler behind each unit, NaN for the last of a train
    rate: Floats  # (U,) m/s
    force: Floats  # (U,) N, NaN at the end
    extremes: Extremes


class Call(NamedTuple):
    """A train at one of its stops."""

    stop: Stop
    number: int  # from 1, along the way of the train
    arrival: float  # s, NaN: not yet
    departure: float  # s, NaN: not yet


#: stops.parquet, one row per train and stop: value, unit and meaning; ``train``, ``stop`` and ``platform`` come before them.
STOPS: dict[str, tuple[Callable[[Call], float], str, str]] = {
    "number": (lambda call: call.number, "1", "Number of the stop on the train's route, from 1."),
    "planned_arrival_s": (lambda call: call.stop.planned, "s", "SUMO's `arrival`; missing: none is planned."),
    "arrival_s": (lambda call: call.arrival, "s", "When the train stood, or passed a waypoint; missing: it did not come."),
    "planned_departure_s": (
        lambda call: call.stop.until if np.isfinite(call.stop.until) else np.nan, "s",
        "SUMO's `until`, before which the train does not leave; missing: none is planned.",
    ),
    "departure_s": (lambda call: call.departure, "s", "When it began to leave; missing: it did not."),
    "delay_s": (
        lambda call: call.stop.late(call.arrival, call.departure), "s",
        "Departure after the planned one; after the planned arrival where no departure is planned, or the train has not left.",
    ),
}  # fmt: skip

#: trains.parquet, values (n,); ``saturated`` comes behind them.
TRAINS: dict[str, Callable[[Instant], Floats]] = {
    "position_m": lambda now: now.row.seen.position,
    "speed_mps": lambda now: now.row.speed,
    "input_mps2": lambda now: np.full(len(now.spacing), np.nan) if now.row.motion is None else now.row.motion.input,
    "spacing_m": lambda now: now.spacing,
    "gap_m": lambda now: now.spacing - now.length[now.row.ahead],
}

#: links.parquet, values (L,); ``heard`` comes behind them.
LINKS: dict[str, Callable[[Row], Floats]] = {
    "spacing_m": lambda row: row.seen.position[row.links.sender] - row.seen.position[row.links.receiver],
    "desired_m": lambda row: row.links.desired,
    "lower_m": lambda row: row.links.lower,
    "upper_m": lambda row: row.links.upper,
}

#: units.parquet, values (U,). Extremes are over the sub-steps since the last row, this instant included.
UNITS: dict[str, Callable[[Units], Floats]] = {
    "position_m": lambda now: now.own[:, POSITION],
    "speed_mps": lambda now: now.own[:, SPEED],
    "force_n": lambda now: now.force,
    "coupler_m": lambda now: now.stretch,
    "coupler_force_n": lambda now: now.consists.stiffness * now.stretch + now.consists.damping * now.rate,
    "coupler_min_m": lambda now: np.fmin(finite(now.extremes.coupler_min), now.stretch),
    "coupler_max_m": lambda now: np.fmax(finite(now.extremes.coupler_max), now.stretch),
    "force_min_n": lambda now: np.fmin(finite(now.extremes.force_min), now.force),
    "force_max_n": lambda now: np.fmax(finite(now.extremes.force_max), now.force),
}


def trains(row: Row, length: Floats) -> Instant:
    """Gather what the columns of trains are taken from; ``length`` (n,) is that of the trains [m]."""
    position, spacing = row.seen.position, row.spacing
    if spacing is None:
        spacing = np.where(row.ahead >= 0, position[row.ahead] - position, np.nan)
    return Instant(row, spacing, length)


def units(row: Row, consists: Consists) -> Units:
    """Gather what the columns of units are taken from."""
    own, extremes = row.own, row.extremes
    assert extremes is not None
    missing = np.full(len(own), np.nan)
    stretch, rate = missing.copy(), missing.copy()
    joined = np.ones(len(own), bool)
    joined[consists.first[1:] - 1] = False
    stretch[joined] = own[:-1, POSITION][joined[:-1]] - own[1:, POSITION][joined[:-1]] - consists.length[joined]
    rate[joined] = own[:-1, SPEED][joined[:-1]] - own[1:, SPEED][joined[:-1]]
    force: Floats = missing if row.motion is None or row.motion.force is None else row.motion.force
    return Units(own, consists, stretch, rate, force, extremes)


def finite(values: Floats) -> Floats:
    """The same with NaN where nothing was seen."""
    return np.where(np.isfinite(values), values, np.nan)
