"""Findings: differences grouped by train and cause, so that one late train is one line and not ten thousand rows.

A finding names a cause, the trains and columns it is about, from when on, how many values and rows it explains, the first of them
and the largest. Causes are tried from the most telling to the least: whole columns in other units or shifted; a train missing or
under another name; another way; another order at a switch; late, early, a stop left out; rows dropped or doubled. What none of
these explains is one finding per column. Nothing is dropped: every value that differs belongs to a finding.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

from trainctl.diff.rows import Place
from trainctl.errors import printable

#: What a finding can say.
CAUSES = {
    "units": "a column equals the reference's times a constant",
    "shift": "a column equals the reference's plus a constant",
    "missing": "a train of the reference is missing",
    "added": "a train is not in the reference",
    "renamed": "a train has another name",
    "route": "a train takes another route or another track",
    "order": "trains pass a switch in another order",
    "late": "a train does the same, later",
    "early": "a train does the same, earlier",
    "stop": "a stop is left out",
    "ends": "a log or a train begins or ends at another time",
    "dropped": "single rows are missing",
    "doubled": "rows appear twice",
    "rows": "rows appear in one log only",
    "column": "a column is missing",
    "noise": "values scatter about the reference",
    "values": "values differ, in no pattern that is known here",
    "setting": "the scenarios or the ends of the runs differ",
    "file": "a log is missing",
}

#: Names of usual constants between units.
UNITS = {
    3.6: "m/s -> km/h", 1 / 3.6: "km/h -> m/s", 1000.0: "km -> m, s -> ms", 0.001: "m -> km, ms -> s",
    2.2369362920544: "m/s -> mph", 0.44704: "mph -> m/s", 57.29577951308232: "rad -> deg", 0.017453292519943295: "deg -> rad",
    60.0: "min -> s", 1 / 60: "s -> min", 3600.0: "h -> s", 1 / 3600: "s -> h", 100.0: "1 -> %", 0.01: "% -> 1",
    -1.0: "the sign is the other one", 9.80665: "g -> m/s2",
    0.3048: "ft -> m", 3.280839895: "m -> ft",
}  # fmt: skip

#: Trains that are named in a finding's words, and letters of each name.
NAMED, LETTERS = 4, 60


@dataclass
class Difference:
    """One value that differs, and its column."""

    column: str
    place: Place


@dataclass
class Finding:
    """Differences with one cause."""

    cause: str  # one of CAUSES
    words: str
    trains: list[str] = field(default_factory=list)
    tables: list[str] = field(default_factory=list)
    columns: list[str] = field(default_factory=list)
    from_s: float | None = None
    #: How much: seconds of ``late`` and ``early``, the constant of ``shift`` and ``units``.
    by: float | None = None
    values: int = 0  # that differ
    rows: int = 0  # that only one log has
    first: Difference | None = None
    largest: Difference | None = None
    #: Trains of each table, for ``rows behind``.
    codes: dict[str, list[int]] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Everything in what JSON knows."""
        out = asdict(self)
        del out["codes"]
        for key in ("first", "largest"):
            if out[key] is not None:
                out[key] = {"column": out[key]["column"], **out[key]["place"]}
        return out

    @property
    def where(self) -> str:
        """The tables and how much they hold of it, in words."""
        parts = [", ".join(self.tables)]
        parts += [counted(self.values, "value")] * (self.values > 0) + [counted(self.rows, "row")] * (self.rows > 0)
        return ": ".join(parts[:1]) + (f" ({', '.join(parts[1:])})" if parts[1:] else "")


def named(trains: Iterable[str], key: str = "train") -> str:
    """Trains in words."""
    if not key:  # the only row
        return ""
    every = list(trains)
    names = ", ".join(short(name) for name in every[:NAMED])
    if len(every) > NAMED:
        return f"{len(every)} trains ({names}, ...)"
    return f"{'train' if len(every) == 1 else 'trains'} {names}" if key in ("id", "train", "sender") else names


def short(name: str) -> str:
    """A name, or whatever is in a log, as a part of a line."""
    text = printable(name[: LETTERS + 1]) or '""'
    return text if len(text) <= LETTERS else f"{text[: LETTERS - 3]}..."


def counted(count: int, what: str) -> str:
    """A number of things in words."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def seconds(value: float) -> str:
    """A time or a difference of times in words."""
    return f"{value:.10g} s" if abs(value) >= 1e-3 else f"{value:.3g} s"


def since(time_s: float | None) -> str:
    """From when on, in words."""
    return "" if time_s is None or not math.isfinite(time_s) else f" from {seconds(time_s)} on"


def scaled(k: float) -> str:
    """A constant between units in words."""
    known = next((f": {words}" for factor, words in UNITS.items() if abs(k / factor - 1) < 2e-3), "")
    return f"times {k:.6g}{known}"


def merged(findings: list[Finding]) -> list[Finding]:
    """Findings of several tables with the same cause and trains are one."""
    out: list[Finding] = []
    alone = ("units", "shift", "noise", "values", "rows", "dropped", "doubled", "column", "setting", "file", "ends")
    for f in findings:
        same = next(
            (g for g in out if f.cause == g.cause and f.cause not in alone and f.trains == g.trains and _close(f.by, g.by)), None
        )
        if same is None:
            out.append(f)
            continue
        same.tables += [t for t in f.tables if t not in same.tables]
        same.columns += [c for c in f.columns if c not in same.columns]
        same.values, same.rows = same.values + f.values, same.rows + f.rows
        same.codes |= f.codes
        if f.from_s is not None and (same.from_s is None or f.from_s < same.from_s):
            same.from_s, same.words = f.from_s, f.words
        same.first = same.first or f.first
        same.largest = same.largest or f.largest
    first, last = ("setting", "file"), ("noise", "values", "column")
    return sorted(out, key=lambda f: ((f.cause in last) - (f.cause in first), math.inf if f.from_s is None else f.from_s))


def _close(x: float | None, y: float | None) -> bool:
    return (x is None) == (y is None) and (x is None or y is None or abs(x - y) <= 0.011 * max(1.0, abs(x)))
