"""How far two logs may lie apart: an absolute and a relative tolerance per column, and where they come from."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from trainctl.errors import InputError
from trainctl.runs.kinds import KINDS


class Tolerance(NamedTuple):
    """Two numbers agree if they differ by at most ``absolute`` or ``relative`` times the greater of them."""

    absolute: float
    relative: float = 0.0
    ignore: bool = False
    #: Said by the user: not widened to the decimals of a log.
    stated: bool = False


#: Positions come back from the simulator exact to 3e-10 m; what two builds of a library may change is below this.
DEFAULT = Tolerance(1e-6, 1e-9)

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

#: Names that may stand before a column.
TABLES = ("trains", "units", "links", "events", *(kind.name for kind in KINDS))


@dataclass(frozen=True)
class Tolerances:
    """Defaults and what the user said instead; ``columns`` maps ``column`` or ``table.column`` to a tolerance."""

    everywhere: Tolerance | None = None
    columns: Mapping[str, Tolerance] = field(default_factory=dict)

    def of(self, table: str, column: str) -> Tolerance:
        """Tolerance of one column: that of ``table.column``, of ``column``, of everything, the default."""
        stated = self.columns.get(f"{table}.{column}", self.columns.get(column))
        if stated is not None:
            return stated
        if column in CLOCKS.get(table, ()):
            return Tolerance(0.0, 0.0, ignore=True)
        if self.everywhere is not None:
            return self.everywhere
        return next((t for ending, t in ENDINGS.items() if column.endswith(ending)), DEFAULT)

    def unused(self, met: set[tuple[str, str]]) -> list[str]:
        """Names of ``columns`` that are none of the compared ones (pairs of table and column)."""
        names = {column for _, column in met} | {f"{table}.{column}" for table, column in met}
        return [name for name in self.columns if name not in names]


EXACT = Tolerances(Tolerance(0.0, 0.0, stated=True))


def read_tolerances(path: Path | str) -> Tolerances:
    """Tolerances from a TOML file.

    ::

        absolute = 1e-6                                   # of every column
        relative = 1e-9
        [columns]
        speed = 0.01                                      # in every table: absolute
        distance = { absolute = 0.1, relative = 1e-6 }
        trains.input_mps2 = 1e-4                          # in one table
        fcd.angle = "ignore"

    Raises
    ------
    InputError
        With one line per mistake.
    """
    try:
        data = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # not TOML, not text, a number of 5000 digits
        raise InputError(f"{path}: not a TOML file: {error}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    return parse_tolerances(data, str(path))


def parse_tolerances(data: Mapping[str, Any], file: str = "tolerances") -> Tolerances:
    """Tolerances from the tables of such a file."""
    found: list[str] = []
    columns: dict[str, Tolerance] = {}
    for key in data:
        if key not in ("absolute", "relative", "columns"):
            found.append(f"{file}: {key}: unknown key; known: absolute, relative, columns")
    everywhere = None
    if "absolute" in data or "relative" in data:
        stated = {key: data.get(key, 0.0) for key in ("absolute", "relative")}
        everywhere = _one(stated, file, "", found)
    table = data.get("columns", {})
    if isinstance(table, Mapping):
        for name, value in table.items():
            inner = isinstance(value, Mapping) and name in TABLES
            for key, item in ((f"{name}.{k}", v) for k, v in value.items()) if inner else ((name, value),):
                tolerance = _one(item, file, f"columns.{key}", found)
                if tolerance is not None:
                    columns[key] = tolerance
    else:
        found.append(f"{file}: columns = {table}: must be a table")
    if found:
        raise InputError(found)
    return Tolerances(everywhere, columns)


def _one(value: Any, file: str, key: str, found: list[str]) -> Tolerance | None:
    """One tolerance: a number, "ignore", or a table."""
    before = len(found)
    if value == "ignore":
        return Tolerance(0.0, 0.0, ignore=True, stated=True)
    stated = value if isinstance(value, Mapping) else {"absolute": value}
    numbers = {"absolute": 0.0, "relative": 0.0}
    for name, item in stated.items():
        label = f"{file}: {key}.{name}" if key and isinstance(value, Mapping) else f"{file}: {key or name}"
        if name == "ignore" and isinstance(item, bool):
            continue
        if name not in numbers:
            found.append(f"{label} = {item}: must be absolute, relative or ignore = true")
        elif isinstance(item, bool) or not isinstance(item, int | float) or not (math.isfinite(item) and item >= 0):
            found.append(f'{label} = {item}: must be a number, at least 0, or "ignore"')
        else:
            numbers[name] = float(item)
    if len(found) > before:
        return None
    return Tolerance(numbers["absolute"], numbers["relative"], bool(stated.get("ignore", False)), True)
