"""Metrics of delays: at the entry, at stops, at the end of the route."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pyarrow as pa

from trainctl.metrics.values import Values
from trainctl.runs.series import coded, in_numpy
from trainctl.signals import Floats

DEFINITIONS: dict[str, tuple[str, str]] = {
    "punctuality.entry_delay_mean_s": ("s", "Mean delay of the entries of trains that come and go (events `depart`)."),
    "punctuality.entry_delay_p95_s": ("s", "95th percentile of these delays."),
    "punctuality.entry_delay_max_s": ("s", "Maximum of these delays."),
    "punctuality.stop_delay_mean_s": ("s", "Mean delay at stops with a plan (`delay_s` of stops.parquet)."),
    "punctuality.stop_delay_p95_s": ("s", "95th percentile of these delays."),
    "punctuality.stop_delay_max_s": ("s", "Maximum of these delays."),
    "punctuality.stop_within_60_s_share": (
        "1", "Share of planned stops whose delay is at most 60 s; one that was not made in time counts as late."),
    "punctuality.stop_within_180_s_share": ("1", "The same for 180 s."),
    "punctuality.stops_overdue": ("1", "Planned stops without a known delay although their time had passed when the run ended."),
    "punctuality.end_delay_mean_s": ("s", "Mean over the trains of the delay at the last planned stop they made (item: a train)."),
    "punctuality.end_delay_p95_s": ("s", "95th percentile of these delays."),
    "punctuality.end_delay_max_s": ("s", "Maximum of these delays."),
}  # fmt: skip

#: A train is in time up to these delays [s].
LIMITS_S = (60, 180)


def of_entries(events: Iterable[Mapping[str, Any]]) -> Values:
    """Delays of trains against the times at which they were to enter, as far as they entered."""
    return _of("punctuality.entry_delay", np.array([float(e["delay_s"]) for e in events if e["kind"] == "depart"]))


def of_stops(stops: pa.Table, end: float) -> Values:
    """Delays against the timetable, from stops.parquet; the run ended at ``end`` [s]."""
    if not stops.num_rows:
        return {}
    departure, arrival, delay, number = (
        in_numpy(stops[name]) for name in ("planned_departure_s", "planned_arrival_s", "delay_s", "number")
    )
    plan = np.where(np.isnan(departure), arrival, departure)
    known, overdue = np.isfinite(delay), np.isnan(delay) & (plan < end)
    values = _of("punctuality.stop_delay", delay[known])
    counted = np.where(overdue, end - plan, delay)  # at least
    for limit in LIMITS_S:
        if len(sure := counted[known | overdue & (counted > limit)]):
            values[f"punctuality.stop_within_{limit}_s_share"] = float(np.mean(sure <= limit))
    if np.isfinite(plan).any():
        values["punctuality.stops_overdue"] = int(overdue.sum())
    train = coded(stops["train"])
    rows = np.lexsort((number, train.codes))
    rows = rows[known[rows]]
    last = rows[np.flatnonzero(np.append(np.diff(train.codes[rows]), 1))[: len(rows)]]  # of every train
    values |= _of("punctuality.end_delay", delay[last])
    late = zip(train.each()[last].tolist(), delay[last].tolist(), strict=True)
    return values | {f"punctuality.end_delay_mean_s/{name}": seconds for name, seconds in late}


def _of(name: str, delay: Floats) -> Values:
    if not len(delay):
        return {}
    numbers = {"mean": np.mean(delay), "p95": np.percentile(delay, 95.0), "max": np.max(delay)}
    return {f"{name}_{what}_s": float(number) for what, number in numbers.items()}
