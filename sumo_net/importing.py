"""Lines and trains of other projects as our TOML: TTOBench (JSON) and railtoolkit (running paths, rolling stock; YAML).

What a file lacks is asked for by the name of the option that gives it. Nothing is made up: what is left out, or fitted, stands
as a comment in what is written.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from sumo_net.bounded import TooLong, reason, short_text
from sumo_net.spec import LineError, LineSpec, parse_spec, rounded, text

#: Factors to SI of the units the two formats use, per kind of quantity.
UNITS: dict[str, dict[str, float]] = {
    "length": {"m": 1.0, "km": 1e3},
    "speed": {"m/s": 1.0, "km/h": 1 / 3.6},
    "slope": {"permil": 1.0, "‰": 1.0, "%": 10.0},
    "mass": {"kg": 1.0, "t": 1e3},
    "share": {"%": 0.01, "-": 1.0},
    "force": {"N": 1.0, "kN": 1e3},
    "power": {"W": 1.0, "kW": 1e3, "MW": 1e6},
    "acceleration": {"m/s^2": 1.0},
    "force per speed": {"N/(m/s)": 1.0, "kN/(m/s)": 1e3, "N/(km/h)": 3.6, "kN/(km/h)": 3.6e3},
    "force per speed squared": {"N/(m/s)^2": 1.0, "kN/(m/s)^2": 1e3, "N/(km/h)^2": 3.6**2, "kN/(km/h)^2": 3.6**2 * 1e3},
}

STEEPEST_PERMIL = 50.0

SCHEMA = "https://railtoolkit.org/schema/"

#: What is read, for whoever hands in something else.
KNOWN = (
    "a TTOBench track or train (JSON), a railtoolkit running path or rolling stock"
    " (YAML with schema running-path.json or rolling-stock.json)"
)


@dataclass(frozen=True)
class Options:
    """What the user adds; None: not given."""

    name: str | None = None
    item: str | None = None  # which path or train of a file with several
    length_m: float | None = None
    tracks: int = 1
    before_m: float = 0.0
    after_m: float = 0.0
    units: int = 1
    load_share: float = 1.0
    deceleration_mps2: float | None = None
    coupler_stiffness_n_per_m: float | None = None
    coupler_damping_ns_per_m: float | None = None


@dataclass(frozen=True)
class Imported:
    """A TOML file to be: a line, or a ``[train_type.NAME]`` table."""

    kind: str  # "line" or "train"
    name: str
    toml: str
    notes: tuple[str, ...]  # what was fitted, assumed or left out


class Place:
    """A value in a file and where it stands: every access is checked, and a mistake tells the place."""

    def __init__(self, value: Any, file: str, key: str = "") -> None:
        self.value, self.file, self.key = value, file, key

    def wrong(self, rule: str, key: str | None = None) -> LineError:
        """The mistake, to be raised."""
        where = self.key if key is None else key
        return LineError([f"{self.file}: {where}: {rule}" if where else f"{self.file}: {rule}"])

    def has(self, key: str) -> bool:
        """Whether the table has this key."""
        return isinstance(self.value, Mapping) and self.value.get(key) is not None

    def __getitem__(self, key: str) -> Place:
        """The value of a key, which must be there."""
        inside = f"{self.key}.{key}" if self.key else key
        if not isinstance(self.value, Mapping):
            raise self.wrong("must be a table")
        if not self.has(key):
            raise self.wrong("missing", inside)
        return Place(self.value[key], self.file, inside)

    def items(self) -> list[Place]:
        """The items of a list, which must not be empty."""
        if not isinstance(self.value, list) or not self.value:
            raise self.wrong("must be a list with at least one item")
        return [Place(v, self.file, f"{self.key}[{k}]") for k, v in enumerate(self.value, 1)]

    def row(self, minimum: int) -> list[Place]:
        """The items of a list of at least this many."""
        found = self.items()
        if len(found) < minimum:
            raise self.wrong(f"must have {minimum} items, has {len(found)}")
        return found

    def number(self, above: float = -math.inf, minimum: float = -math.inf) -> float:
        """A finite number, above the one bound and not below the other."""
        if isinstance(self.value, bool) or not isinstance(self.value, int | float) or not math.isfinite(self.value):
            raise self.wrong(f"must be a number, is {str(self.value)[:40]}")
        if self.value <= above or self.value < minimum:
            rule = f"above {above:g}" if self.value <= above else f"at least {minimum:g}"
            raise self.wrong(f"must be {rule}, is {self.value:g}")
        return float(self.value)

    def text(self) -> str:
        """A word or a name."""
        if not isinstance(self.value, str | int | float) or isinstance(self.value, bool):
            raise self.wrong("must be text")
        return str(self.value)

    def factor(self, kind: str) -> float:
        """The factor to SI of the unit that stands here."""
        known = UNITS[kind]
        if self.text() not in known:
            raise self.wrong(f"unit {self.text()}: must be one of {', '.join(known)}")
        return known[self.text()]

    def quantity(self, kind: str, above: float = -math.inf, minimum: float = -math.inf) -> float:
        """``{"unit": ..., "value": ...}`` in SI."""
        return self["value"].number(above, minimum) * self["unit"].factor(kind)


def convert(path: str | Path, options: Options) -> Imported:
    """Read a file of either project.

    Parameters
    ----------
    path : str or Path
        The file.
    options : Options
        What the user adds.

    Returns
    -------
    Imported
        A line or a train type, checked by our own rules.

    Raises
    ------
    LineError
        If the file is of neither format, lacks something, or breaks a rule: one line per mistake.
    """
    from sumo_net import import_trains

    data = _load(Path(path))
    readers: tuple[tuple[Callable[[Place], bool], Callable[[Place, Options], Imported]], ...] = (
        (lambda d: d.has("metadata") and d.has("speed limits"), _ttobench_track),
        (lambda d: d.has("metadata") and d.has("rolling resistance r0"), import_trains.ttobench),
        (lambda d: d.has("schema") and d["schema"].value == f"{SCHEMA}running-path.json", _railtoolkit_path),
        (lambda d: d.has("schema") and d["schema"].value == f"{SCHEMA}rolling-stock.json", import_trains.railtoolkit),
    )
    for fits, reader in readers:
        if fits(data):
            return reader(data, options)
    raise data.wrong(f"neither format: known are {KNOWN}")


def _load(path: Path) -> Place:
    try:
        content = short_text(path)
    except FileNotFoundError:
        raise LineError([f"{path}: no such file"]) from None
    except OSError as error:
        raise LineError([f"{path}: cannot be read: {error.strerror}"]) from None
    except TooLong as error:
        raise LineError([f"{path}: neither format: {error}"]) from None
    except UnicodeDecodeError as error:
        raise LineError([f"{path}: neither format: not text: {error}"]) from None
    if content.lstrip().startswith("{"):
        try:
            return Place(json.loads(content), path.name)
        except (ValueError, RecursionError) as error:
            raise LineError([f"{path}: not JSON: {reason(error)}"]) from None
    import yaml

    try:
        data = yaml.safe_load(content)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        problem = " ".join(reason(error).split())[:200]
        raise LineError([f"{path}: neither JSON nor YAML: {problem}"]) from None
    if not isinstance(data, dict):
        raise LineError([f"{path}: neither format: known are {KNOWN}"])
    return Place(data, path.name)


def chosen(items: Sequence[Place], what: str, options: Options) -> Place:
    """The one item of a file, or the one asked for."""
    ids = [i["id"].text() for i in items]
    if options.item is not None:
        if options.item not in ids:
            raise items[0].wrong(f"--item {options.item}: no such {what}; there are: {', '.join(ids)}", "")
        return items[ids.index(options.item)]
    if len(items) > 1:
        raise items[0].wrong(f"has {len(items)} of them: name one with --item: {', '.join(ids)}", f"{what}s")
    return items[0]


def word(name: str) -> str:
    """A name as file name and key: letters, digits, _ and -."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_-") or "imported"


def number(value: float) -> str:
    """A number as TOML, to nine decimals, never an integer."""
    return repr(round(float(value), 9))


def remark(value: str) -> str:
    """Text from a file as part of a comment line."""
    return " ".join("".join(c if c.isprintable() else " " for c in value).split())


Steps = list[tuple[float, float]]


def _ttobench_track(data: Place, options: Options) -> Imported:
    meta = data["metadata"]
    name = meta["id"].text()
    stops: list[tuple[float, str]] = []
    if data.has("stops"):
        factor = data["stops"]["unit"].factor("length")
        stops = [(s.number(minimum=0.0) * factor, f"stop {k}") for k, s in enumerate(data["stops"]["values"].items(), 1)]
    length = options.length_m if options.length_m is not None else stops[-1][0] if stops else None
    if length is None:
        raise data.wrong("missing, so the length of the line is not known: give --length-m", "stops")
    speed = _steps(data["speed limits"], "velocity", "speed")
    gradient = _steps(data["gradients"], "slope", "slope") if data.has("gradients") else []
    notes = [f"{len(data[key]['values'].items())} {key} are left out" for key in ("curvatures", "tunnels") if data.has(key)]
    source = [f"{key}: {remark(meta[key].text())}" for key in ("id", "created by", "library version", "license") if meta.has(key)]
    return _line(data, name, [f"From TTOBench, {'; '.join(source)}."], length, speed, gradient, stops, notes, options)


def _steps(table: Place, key: str, kind: str) -> Steps:
    """Pairs (from_m, value in SI or per mil) of a profile."""
    units = table["units"]
    along, factor = units["position"].factor("length"), units[key].factor(kind)
    rows = [row.row(2) for row in table["values"].items()]
    return [(a.number(minimum=0.0) * along, b.number() * factor) for a, b, *_ in rows]


def _railtoolkit_path(data: Place, options: Options) -> Imported:
    path = chosen(data["paths"].items(), "path", options)
    name = path["id"].text()
    rows = [row.row(3) for row in path["characteristic_sections"].items()]
    if len(rows) < 2:
        raise path["characteristic_sections"].wrong("must have at least two rows: the last one says where the path ends")
    table = sorted((a.number(), b.number(above=0.0) / 3.6, c.number()) for a, b, c, *_ in rows)
    origin = table[0][0]
    stops: list[tuple[float, str]] = []
    if path.has("points_of_interest"):
        points = [row.row(2) for row in path["points_of_interest"].items()]
        stops = [(p[0].number() - origin, remark(p[1].text())) for p in points]
    speed = _changes([(at - origin, v) for at, v, _ in table[:-1]])
    gradient = _changes([(at - origin, slope) for at, _, slope in table[:-1]])
    notes = ["the path's specific resistance, gradient and curves in one, is taken for its gradient"]
    if origin != 0.0:
        notes.append(f"kilometrage 0 is station {origin:g} m of the file")
    source = f"From a railtoolkit running path, id: {remark(name)}; name: {remark(path['name'].text())}."
    length = table[-1][0] - origin if options.length_m is None else options.length_m
    return _line(data, name, [source], length, speed, gradient, stops, notes, options)


def _changes(steps: Steps) -> Steps:
    """The rows of a profile at which its value changes."""
    return steps[:1] + [b for a, b in pairwise(steps) if b[1] != a[1]]


def _line(
    data: Place, name: str, source: list[str], length: float, speed: Steps, gradient: Steps,
    stops: Sequence[tuple[float, str]], notes: list[str], options: Options,
) -> Imported:  # fmt: skip
    """A line description, checked; ``before_m`` shifts the kilometrage of the file."""
    steep = [
        f"{data.file}: gradient at {at:g} m = {slope:g} per mil: at most {STEEPEST_PERMIL:g}"
        for at, slope in gradient
        if abs(slope) > STEEPEST_PERMIL
    ]
    if steep:
        raise LineError(steep)
    before, after = options.before_m, options.after_m
    name = word(options.name or name)
    if before or after:
        notes.append(
            f"level track was added, {text(before)} m before the beginning and {text(after)} m beyond the end, with the first and"
            f" the last speed limit; kilometrage {text(before)} m is 0 m of the file"
        )
    speed_table = [[0.0, speed[0][1]]] + [[rounded(before + at), v] for at, v in speed[1:]]
    if speed[0][0] != 0.0:
        raise data.wrong(f"the first speed limit is at {speed[0][0]:g} m, must be at 0 m")
    slopes = [[rounded(before + at), s] for at, s in gradient]
    if after and slopes and slopes[-1][1] != 0.0:
        slopes.append([rounded(before + length), 0.0])
    tables: dict[str, Any] = {
        "name": name,
        "tracks": [str(k) for k in range(1, options.tracks + 1)],
        "length_m": rounded(before + length + after),
        "speed": [[at, round(v, 9)] for at, v in speed_table],
        "gradient": [[at, round(s, 9)] for at, s in slopes],
    }
    spec = parse_spec(tables, data.file)
    return Imported("line", name, _line_toml(spec, source, notes, [(before + at, said) for at, said in stops]), tuple(notes))


def _line_toml(spec: LineSpec, source: Sequence[str], notes: Sequence[str], stops: Sequence[tuple[float, str]]) -> str:
    lines = [f"# {s}" for s in source] + [f"# Note: {n}." for n in notes]
    lines += [
        f'name = "{spec.name}"',
        "tracks = [" + ", ".join(f'"{t}"' for t in spec.tracks) + "]",
        f"length_m = {number(spec.length_m)}",
    ]
    for key, profile in (("speed", spec.speed), ("gradient", spec.gradient)):
        if profile:
            lines += [f"{key} = [", *(f"    [{number(at)}, {number(value)}]," for at, value in profile), "]"]
    lines += [f"# {said}: {text(at)} m" for at, said in stops]
    return "\n".join(lines) + "\n"
