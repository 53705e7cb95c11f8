"""Columns of numbers that every run has, each once: its name, and its values from an instant of the loop.

``Recorder.standard_tables`` puts the names of trains, tracks and edges before them; what only some runs have comes behind them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from trainctl.scenario.roster import Stop
from trainctl.signals import POSITION, SPEED, Bools, Consists, Disturbed, Extremes, Floats, Ints, Row

#: An array of what is not there, and extremes of what has no sub-steps.
NOTHING, NEVER = np.zeros(0), Extremes.fresh(0, 0, 0)


class Instant(NamedTuple):
    """What columns are computed from. Of K instants together every field has a leading axis, ``length`` aside."""

    time: float | Floats  # s
    present: Bools  # (n,)
    edge: Ints  # (n,)
    track: Ints  # (n,)
    ahead: Ints  # (n,) -1: none
    position: Floats  # (n,) m
    speed: Floats  # (n,) m/s
    input: Floats  # (n,) m/s2, NaN at the end
    spacing: Floats  # (n,) m, front to front to the train ahead in the formation, NaN for the first; (0,): see ``placed``
    saturated: Bools  # (n,)
    led: Bools  # (n,)
    disturbed: Floats  # (5, n), as ``signals.Disturbed``
    energy: Floats  # (n, 6) J
    watched_min: Floats  # (n, q)
    watched_max: Floats  # (n, q)
    sender: Ints  # (L,)
    receiver: Ints  # (L,)
    desired: Floats  # (L,) m
    lower: Floats  # (L,) m
    upper: Floats  # (L,) m
    heard: Bools  # (L,)
    own: Floats  # (U, s)
    force: Floats  # (U,) N, NaN at the end
    coupler_min: Floats  # (U,) m, over the sub-steps since the last row
    coupler_max: Floats  # (U,) m
    force_min: Floats  # (U,) N
    force_max: Floats  # (U,) N
    extras: Floats  # (c, U), the plant's ``COLUMNS``
    length: Floats = np.zeros(0)  # (n,) m


class Units(NamedTuple):
    """An instant of all units, or several."""

    now: Instant
    consists: Consists
    stretch: Floats  # (U,) m, of the coupler behind each unit, NaN for the last of a train
    rate: Floats  # (U,) m/s


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
    "position_m": lambda now: now.position,
    "speed_mps": lambda now: now.speed,
    "input_mps2": lambda now: now.input,
    "spacing_m": lambda now: now.spacing,
    "gap_m": lambda now: now.spacing - now.length[now.ahead],
}

#: links.parquet, values (L,); ``heard`` comes behind them.
LINKS: dict[str, Callable[[Instant], Floats]] = {
    "spacing_m": lambda now: _of(now.position, now.sender) - _of(now.position, now.receiver),
    "desired_m": lambda now: now.desired,
    "lower_m": lambda now: now.lower,
    "upper_m": lambda now: now.upper,
}

#: units.parquet, values (U,). Extremes are over the sub-steps since the last row, this instant included.
UNITS: dict[str, Callable[[Units], Floats]] = {
    "position_m": lambda units: units.now.own[..., POSITION],
    "speed_mps": lambda units: units.now.own[..., SPEED],
    "force_n": lambda units: units.now.force,
    "coupler_m": lambda units: units.stretch,
    "coupler_force_n": lambda units: units.consists.stiffness * units.stretch + units.consists.damping * units.rate,
    "coupler_min_m": lambda units: np.fmin(finite(units.now.coupler_min), units.stretch),
    "coupler_max_m": lambda units: np.fmax(finite(units.now.coupler_max), units.stretch),
    "force_min_n": lambda units: np.fmin(finite(units.now.force_min), units.now.force),
    "force_max_n": lambda units: np.fmax(finite(units.now.force_max), units.now.force),
}


def instant(row: Row, disturbed: bool = False) -> Instant:
    """What the columns are computed from, in the arrays of ``row``; ``disturbed``: also what disturbs, which is NaN at the end."""
    seen, links, motion, x = row.seen, row.links, row.motion, NEVER if row.extremes is None else row.extremes
    n, units = len(row.speed), len(row.own)
    acting = np.full((len(Disturbed._fields), n if disturbed else 0), np.nan)
    if disturbed and row.disturbed is not None:
        acting[:] = row.disturbed
    return Instant(
        row.time, seen.present, seen.edge, row.track, row.ahead, seen.position, row.speed,
        np.full(n, np.nan) if motion is None else motion.input, NOTHING if row.spacing is None else row.spacing, row.saturated,
        row.led, acting, x.energy, x.watched_min, x.watched_max,
        links.sender, links.receiver, links.desired, links.lower, links.upper, links.heard,
        row.own, np.full(units, np.nan) if motion is None or motion.force is None else motion.force,
        x.coupler_min, x.coupler_max, x.force_min, x.force_max,
        NOTHING if motion is None or not motion.extras else np.array([*motion.extras.values()]),
    )  # fmt: skip


def kept(now: Instant) -> Instant:
    """The same in arrays of its own: stages may reuse theirs."""
    return Instant._make([now.time, *(part.copy() for part in now[1:])])


def alike(one: Instant, other: Instant) -> bool:
    """Whether these are of as many links, and have the same columns."""
    return one.sender.shape == other.sender.shape and one.extras.shape == other.extras.shape


def together(instants: Sequence[Instant]) -> Instant:
    """Several instants that are ``alike`` as one with a leading axis."""
    if len(instants) == 1:  # of many trains, which need not be copied
        return Instant._make(np.asarray(part)[None] for part in instants[0])
    return Instant._make(map(np.array, zip(*instants, strict=True)))


def placed(now: Instant, length: Floats) -> Instant:
    """The same with the ``length`` of the trains (n,) [m] and, where the simulator has not said them, the spacings."""
    spacing = now.spacing
    if not spacing.size:
        spacing = np.where(now.ahead >= 0, _of(now.position, now.ahead) - now.position, np.nan)
    return now._replace(spacing=spacing, length=length)


def units(now: Instant, consists: Consists) -> Units:
    """Gather what the columns of units are computed from."""
    own, joined = now.own, np.ones(now.own.shape[-2], bool)
    joined[consists.first[1:] - 1] = False
    between = np.flatnonzero(joined)
    stretch, rate = np.full(own.shape[:-1], np.nan), np.full(own.shape[:-1], np.nan)
    stretch[..., between] = own[..., between, POSITION] - own[..., between + 1, POSITION] - consists.length[between]
    rate[..., between] = own[..., between, SPEED] - own[..., between + 1, SPEED]
    return Units(now, consists, stretch, rate)


def _of(values: Floats, trains: Ints) -> Floats:
    """Values (K, n) of these trains (K, m), at every instant; any value where a train is -1."""
    begin = values.shape[1] * np.arange(len(values))[:, None]
    return values.reshape(-1)[trains + begin if len(values) > 1 else trains]


def finite(values: Floats) -> Floats:
    """The same with NaN where nothing was seen."""
    return np.where(np.isfinite(values), values, np.nan)
