"""How far two logs may lie apart, per column: in value and in time, each absolute, relative to the value, relative to the range.

The widest of the three holds, in value and in time: ``max(absolute, relative |value|, range (max - min))``. The value is the
reference's, the range that of the column in the whole reference; in time the value is the clock [s] and the range the reference's
duration. Without a tolerance in time rows are compared at their own instant; with one, a value must lie in the tube that
``trainctl.diff.tube`` defines. Nothing else widens a stated tolerance: no floor for small signals, no factor.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from sumo_net.bounded import reason, short_text
from trainctl.errors import InputError
from trainctl.runs.kinds import KINDS


class Tolerance(NamedTuple):
    """How far a value may lie from the reference: see above."""

    absolute: float
    #: times the reference's value
    relative: float = 0.0
    ignore: bool = False
    #: Said by the user: not widened to the decimals of a log.
    stated: bool = False
    #: times the range of the column in the reference
    range: float = 0.0
    time_s: float = 0.0
    #: times the clock
    time_relative: float = 0.0
    #: times the duration of the reference
    time_range: float = 0.0

    @property
    def in_time(self) -> bool:
        """Whether it has a tolerance in time."""
        return max(self.time_s, self.time_relative, self.time_range) > 0

    @property
    def of_range(self) -> bool:
        """Whether the range of the reference must be known first."""
        return max(self.range, self.time_range) > 0

    def told(self) -> str:
        """The tolerance in words."""
        value = [f"{self.absolute:g}"] * (self.absolute > 0 or not (self.relative or self.range))
        value += [f"{self.relative:g} of the value"] * (self.relative > 0) + [f"{self.range:g} of the range"] * (self.range > 0)
        time = [f"{self.time_s:g} s"] * (self.time_s > 0) + [f"{self.time_relative:g} of the clock"] * (self.time_relative > 0)
        time += [f"{self.time_range:g} of the duration"] * (self.time_range > 0)
        return " or ".join(value) + (f", within {' or '.join(time)}" if time else "")


#: Positions come back from the simulator exact to 3e-10 m; what two builds of a library may change is below this: 1e-9 in each.
DEFAULT = Tolerance(1e-6, 2e-9)

#: ending of a column of ours -> tolerance: forces and energies are large numbers
ENDINGS = {"_n": Tolerance(1e-3, 1e-9), "_j": Tolerance(1.0, 1e-6)}

#: Clocks of the machine, in SUMO's summary and statistics.
CLOCKS = {
    "summary": {"duration"},
    "personsummary": {"duration"},
    "statistics": {
        "performance_clockBegin", "performance_clockEnd", "performance_clockDuration", "performance_traciDuration",
        "performance_realTimeFactor", "performance_vehicleUpdatesPerSecond", "performance_personUpdatesPerSecond",
    },
}  # fmt: skip

#: Keys of one tolerance in a file: in value, in time.
VALUES = ("absolute", "relative", "range")
TIMES = ("time_s", "time_relative", "time_range")
#: A tolerance relative to the clock is less than this: else the tube would have no end.
MOST_OF_THE_CLOCK = 0.5

NO_TIME = Tolerance(0.0)

#: Names that may stand before a column.
TABLES = ("trains", "units", "links", "calls", "events", *(kind.name for kind in KINDS))


@dataclass(frozen=True)
class Tolerances:
    """Defaults and what the user said instead; ``columns`` maps ``column`` or ``table.column`` to a tolerance."""

    everywhere: Tolerance | None = None
    columns: Mapping[str, Tolerance] = field(default_factory=dict)
    #: Of rows: one that only one log has is no difference if the other has one of the same train within this [s]; and of every
    #: column that states none of its own.
    time: Tolerance = NO_TIME
    #: Whether only the time both logs cover is compared.
    common: bool = False

    def of(self, table: str, column: str) -> Tolerance:
        """Tolerance of one column: that of ``table.column``, of ``column``, of everything, the default."""
        stated = self.columns.get(f"{table}.{column}", self.columns.get(column))
        if stated is not None:
            return stated
        if column in CLOCKS.get(table, ()):
            return Tolerance(0.0, 0.0, ignore=True)
        found = self.everywhere
        if found is None:
            found = next((t for ending, t in ENDINGS.items() if column.endswith(ending)), DEFAULT)
        return found._replace(**{name: getattr(self.time, name) for name in TIMES})

    def in_time(self, table: str) -> bool:
        """Whether rows or any column of a table have a tolerance in time."""
        of_table = [t for name, t in self.columns.items() if "." not in name or name.startswith(f"{table}.")]
        return any(t.in_time for t in (self.time, *of_table))

    @property
    def of_range(self) -> bool:
        """Whether the range of the reference must be known before anything is compared."""
        return any(t.of_range for t in (self.time, *self.columns.values(), *([self.everywhere] if self.everywhere else [])))

    def unused(self, met: set[tuple[str, str]]) -> list[str]:
        """Names of ``columns`` that are none of the compared ones (pairs of table and column)."""
        names = {column for _, column in met} | {f"{table}.{column}" for table, column in met}
        return [name for name in self.columns if name not in names]


EXACT = Tolerances(Tolerance(0.0, 0.0, stated=True))


def read_tolerances(path: Path | str) -> Tolerances:
    """Tolerances from a TOML file.

    ::

        absolute = 1e-6                                   # of every column
        relative = 1e-9                                   # times the value
        range = 0.001                                     # times the range of the column in the reference
        time_s = 1.0                                      # of every column and of rows; also time_relative, time_range
        ends = "common"                                   # compare only the time both cover; default "same"
        [columns]
        speed = 0.01                                      # in every table: absolute
        distance = { absolute = 0.1, relative = 1e-6 }
        pos = { range = 0.01, time_s = 0.0 }
        trains.input_mps2 = 1e-4                          # in one table
        fcd.angle = "ignore"

    Raises
    ------
    InputError
        With one line per mistake.
    """
    try:
        data = tomllib.loads(short_text(Path(path)))
    except (ValueError, RecursionError) as error:  # not TOML, not text, a number of 5000 digits
        raise InputError(f"{path}: not a TOML file: {reason(error)}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    return parse_tolerances(data, str(path))


def parse_tolerances(data: Mapping[str, Any], file: str = "tolerances") -> Tolerances:
    """Tolerances from the tables of such a file."""
    found: list[str] = []
    columns: dict[str, Tolerance] = {}
    known = (*VALUES, *TIMES, "ends", "columns")
    found += [f"{file}: {key}: unknown key; known: {', '.join(known)}" for key in data if key not in known]
    whole = {key: data[key] for key in (*VALUES, *TIMES) if key in data}
    everywhere = _one(whole, file, "", found, Tolerance(0.0)) or Tolerance(0.0)
    if data.get("ends", "same") not in ("same", "common"):
        found.append(f'{file}: ends = {data["ends"]}: must be "same" or "common"')
    table = data.get("columns", {})
    if isinstance(table, Mapping):
        for name, value in table.items():
            inner = isinstance(value, Mapping) and name in TABLES
            for key, item in ((f"{name}.{k}", v) for k, v in value.items()) if inner else ((name, value),):
                tolerance = _one(item, file, f"columns.{key}", found, everywhere)
                if tolerance is not None:
                    columns[key] = tolerance
    else:
        found.append(f"{file}: columns = {table}: must be a table")
    if found:
        raise InputError(found)
    stated = any(key in data for key in VALUES)
    return Tolerances(everywhere if stated else None, columns, everywhere, data.get("ends") == "common")


def _one(value: Any, file: str, key: str, found: list[str], time: Tolerance) -> Tolerance | None:
    """One tolerance: a number, "ignore", or a table; without a word on time that of every column holds."""
    before = len(found)
    if value == "ignore":
        return Tolerance(0.0, 0.0, ignore=True, stated=True)
    stated = value if isinstance(value, Mapping) else {"absolute": value}
    times = {name: getattr(time, name) for name in TIMES} if not any(name in stated for name in TIMES) else {}
    numbers = dict.fromkeys((*VALUES, *TIMES), 0.0) | times
    for name, item in stated.items():
        label = f"{file}: {key}.{name}" if key and isinstance(value, Mapping) else f"{file}: {key or name}"
        if name == "ignore" and isinstance(item, bool):
            continue
        if name not in numbers:
            found.append(f"{label} = {item}: must be {', '.join(numbers)} or ignore = true")
        elif isinstance(item, bool) or not isinstance(item, int | float) or not (math.isfinite(item) and item >= 0):
            found.append(f'{label} = {item}: must be a number, at least 0, or "ignore"')
        elif name == "time_relative" and item > MOST_OF_THE_CLOCK:
            found.append(f"{label} = {item}: must be at most {MOST_OF_THE_CLOCK}")
        else:
            numbers[name] = float(item)
    if len(found) > before:
        return None
    return Tolerance(ignore=bool(stated.get("ignore", False)), stated=True, **numbers)
