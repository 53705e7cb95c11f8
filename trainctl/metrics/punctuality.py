"""Metrics of who is late: at the entry, at stops, at the end of the way."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from trainctl.metrics.values import Values
from trainctl.signals import Floats

DEFINITIONS: dict[str, tuple[str, str]] = {
    "punctuality.entry_delay_mean_s": ("s", "Mean delay of the entries of trains that come and go (events `depart`)."),
    "punctuality.entry_delay_p95_s": ("s", "95th percentile of these delays."),
    "punctuality.entry_delay_max_s": ("s", "Maximum of these delays."),
}


def of_entries(events: Iterable[Mapping[str, Any]]) -> Values:
    """Delays of trains against the times at which they were to enter, as far as they entered."""
    return _of("punctuality.entry_delay", np.array([float(e["delay_s"]) for e in events if e["kind"] == "depart"]))


def _of(name: str, delay: Floats) -> Values:
    if not len(delay):
        return {}
    numbers = {"mean": np.mean(delay), "p95": np.percentile(delay, 95.0), "max": np.max(delay)}
    return {f"{name}_{what}_s": float(number) for what, number in numbers.items()}
