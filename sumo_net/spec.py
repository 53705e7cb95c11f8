"""What a line is: parallel tracks, crossovers, speed and gradient profiles, read from a TOML file.

A line has one kilometrage for all its tracks, increasing in the direction of travel and measured along the rail. The
README of this folder shows every key.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from sumo_net.bounded import reason, short_text

#: Distance between the centres of neighbouring tracks [m].
TRACK_SPACING_M = 4.5

#: No edge is shorter than this [m]: two switches, or a switch and a speed change, lie at one place or this far apart.
SHORTEST_EDGE_M = 1.0

#: A crossover is at least this much longer than it moves sideways: 1 in 7 is about the sharpest switch of a main line.
SHARPEST_SWITCH = 7.0

#: A line with more edges than this is a mistake in max_edge_m or every_m.
MOST_EDGES = 100_000


class LineError(Exception):
    """A line description or a net file is wrong. ``mistakes`` has one line each: ``file: key = value: rule``."""

    def __init__(self, mistakes: Sequence[str]) -> None:
        # One line each: what a file says is escaped.
        self.mistakes = ["".join(c if c.isprintable() else repr(c)[1:-1] for c in line) for line in mistakes]
        super().__init__("\n".join(self.mistakes))


def rounded(metres: float) -> float:
    """Positions and lengths are kept to a micrometre, so that what the net file says is exactly what we compute."""
    return round(metres, 6)


def text(number: float) -> str:
    """Shortest decimal notation to a micrometre: ids and attributes of the net."""
    return f"{number:.6f}".rstrip("0").rstrip(".")


def _word(value: Any) -> Any:
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _allowed(characters: str) -> AfterValidator:
    def check(value: str) -> str:
        if value and value[0] not in characters and all((c.isascii() and c.isalnum()) or c in characters for c in value):
            return value
        raise ValueError("must be letters, digits" + "".join(f" or {c}" for c in characters) + ", and begin with a letter or digit")

    return AfterValidator(check)


def _pair(value: Any) -> Any:
    if isinstance(value, list | tuple) and len(value) == 2:
        return tuple(value)
    raise ValueError("must be a pair [from_m, value]")


def _not_empty(value: tuple[Any, ...]) -> tuple[Any, ...]:
    if not value:
        raise ValueError("must have at least one item")
    return value


TrackId = Annotated[str, BeforeValidator(_word), _allowed(".")]
Word = Annotated[str, BeforeValidator(_word), _allowed("_-.")]
Speed = Annotated[float, Field(gt=0, le=200)]
SpeedFrom = Annotated[tuple[Annotated[float, Field(ge=0)], Speed], BeforeValidator(_pair)]
GradientFrom = Annotated[tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=-50, le=50)]], BeforeValidator(_pair)]


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


class Crossover(_Strict):
    """[[crossover]]: a one-way connection from one track to another, as long as the piece of track beside it."""

    id: Word | None = Field(None, description="Name for events and routes; default xFROM-TO_POSITION, the id of its edge.")
    from_track: TrackId = Field(alias="from", description="Track it leaves.")
    to_track: TrackId = Field(alias="to", description="Track it leads to, and belongs to.")
    position_m: float = Field(ge=0, description="Kilometrage of its switch on the track it leaves [m].")
    length_m: float = Field(gt=0, description="Kilometrage from the switch to where it joins the other track [m].")
    speed_mps: Speed = Field(description="Speed limit on it [m/s].")

    @property
    def edge(self) -> str:
        """Id of its edge in the net."""
        return f"x{self.from_track}-{self.to_track}_{text(self.position_m)}"

    @property
    def name(self) -> str:
        """Its id, or that of its edge."""
        return self.edge if self.id is None else self.id

    @property
    def start_m(self) -> float:
        """Where it begins on the kilometrage [m]."""
        return rounded(self.position_m)

    @property
    def end_m(self) -> float:
        """Where it ends on the kilometrage [m]."""
        return rounded(self.position_m + self.length_m)


class RegularCrossovers(_Strict):
    """[regular_crossovers]: both ways between all neighbouring tracks, at equal distances."""

    every_m: float = Field(gt=0, description="Distance from one place to the next [m].")
    first_m: float = Field(ge=0, description="Kilometrage of the first place [m].")
    length_m: float = Field(gt=0, description="As in [[crossover]] [m].")
    speed_mps: Speed = Field(description="Speed limit on them [m/s].")


class LineSpec(_Strict):
    """A line, as its TOML file describes it."""

    name: Word = Field(description="Name of the line; its files are called so.")
    tracks: Annotated[tuple[TrackId, ...], Field(strict=False), AfterValidator(_not_empty)] = Field(
        description="Track ids in lateral order, left to right in the direction of travel."
    )
    length_m: float = Field(gt=0, le=1e7, description="Length of the line [m].")
    start_m: float = Field(0.0, ge=0, le=1e7, description="Kilometrage of its beginning [m], not negative.")
    max_edge_m: float = Field(5000.0, ge=10, description="No edge of a track is longer than this [m].")
    signals_m: float | None = Field(
        None, ge=10, description="Distance of the rail signals of every track [m], the first this far from start_m; default none."
    )
    speed: Annotated[tuple[SpeedFrom, ...], Field(strict=False), AfterValidator(_not_empty)] = Field(
        description="Speed limit: pairs [from_m, speed_mps], the first at start_m."
    )
    gradient: Annotated[tuple[GradientFrom, ...], Field(strict=False)] = Field(
        (), description="Gradient: pairs [from_m, permil], rising positive, within 50 per mil; level before the first."
    )
    crossover: Annotated[tuple[Crossover, ...], Field(strict=False)] = Field((), description="Crossovers, one by one.")
    regular_crossovers: RegularCrossovers | None = Field(None, description="Crossovers at equal distances.")

    @property
    def begin_m(self) -> float:
        """Kilometrage of the beginning [m]."""
        return rounded(self.start_m)

    @property
    def end_m(self) -> float:
        """Kilometrage of the end [m]."""
        return rounded(self.start_m + self.length_m)

    def all_crossovers(self) -> list[Crossover]:
        """The crossovers of the list, then the regular ones, which end before the line does."""
        return [*self.crossover, *self._regular()]

    def _regular(self) -> Iterator[Crossover]:
        r = self.regular_crossovers
        if r is None:
            return
        pairs = [pair for a, b in pairwise(self.tracks) for pair in ((a, b), (b, a))]
        k = 0
        while (at := rounded(r.first_m + k * r.every_m)) + r.length_m <= self.end_m - SHORTEST_EDGE_M:
            for here, there in pairs:
                place = {"position_m": at, "length_m": r.length_m, "speed_mps": r.speed_mps}
                yield Crossover.model_validate({"from": here, "to": there} | place)
            k += 1

    def signals(self) -> list[float]:
        """Kilometrage of the signals [m]: edges end there, on every track."""
        if self.signals_m is None:
            return []
        last = math.floor((self.end_m - SHORTEST_EDGE_M - self.begin_m) / self.signals_m + 1e-9)
        return [rounded(self.begin_m + k * self.signals_m) for k in range(1, last + 1)]

    def cuts(self) -> dict[str, dict[float, str]]:
        """Where each track must be cut into edges, and why: ends of the line, signals, speed changes, both ends of crossovers."""
        common = {at: f"the signal at {text(at)} m" for at in self.signals()}
        common |= {rounded(at): f"the speed change at {text(at)} m" for at, _ in self.speed}
        common |= {self.begin_m: "the beginning of the line", self.end_m: "the end of the line"}
        found = {track: dict(common) for track in self.tracks}
        for c in self.all_crossovers():
            if c.from_track in found:
                found[c.from_track].setdefault(c.start_m, f"the switch of {c.name} at {text(c.start_m)} m")
            if c.to_track in found:
                found[c.to_track].setdefault(c.end_m, f"the end of {c.name} at {text(c.end_m)} m")
        return found


def read_spec(path: str | Path) -> LineSpec:
    """The line described by a TOML file.

    Raises
    ------
    LineError
        With every mistake in the file.
    """
    path = Path(path)
    try:
        data = tomllib.loads(short_text(path))
    except FileNotFoundError:
        raise LineError([f"{path}: no such file"]) from None
    except OSError as error:
        raise LineError([f"{path}: cannot be read: {error.strerror}"]) from None
    except (ValueError, RecursionError) as error:  # not TOML, not text, a number of 5000 digits
        raise LineError([f"{path}: not TOML: {reason(error)}"]) from None
    return parse_spec(data, str(path))


def parse_spec(data: dict[str, Any], file: str) -> LineSpec:
    """The line described by the tables of a TOML file; ``file`` is its name for messages."""
    found: list[str] = []
    spec: LineSpec | None
    numbers: Numbers = {}
    try:
        spec = LineSpec.model_validate(data)
    except ValidationError as error:
        found = _words(error)
        spec, numbers = _healthy_part(error, data)
    if spec is not None:
        found += violations(spec, numbers)
    if found or spec is None:
        raise LineError([f"{file}: {line}" for line in found])
    return spec


def _key(location: Sequence[int | str]) -> str:
    """Dotted key; items of lists by number from 1."""
    key = ""
    for part in location:
        key += f"[{part + 1}]" if isinstance(part, int) else f".{part}" if key else part
    return key


_TABLES: dict[str, type[BaseModel]] = {"crossover": Crossover, "regular_crossovers": RegularCrossovers}


def _words(error: ValidationError) -> list[str]:
    lines = []
    for e in error.errors(include_url=False):
        key, value = _key(e["loc"]), e["input"]
        if e["type"] == "extra_forbidden":
            table = _TABLES.get(str(e["loc"][0]), LineSpec)
            known = [f.alias or name for name, f in table.model_fields.items()]
            near = difflib.get_close_matches(str(e["loc"][-1]), known, n=1)
            lines.append(f"{key}: unknown key" + (f"; did you mean {near[0]}?" if near else "") + f"; known: {', '.join(known)}")
        elif e["type"] == "missing":
            lines.append(f"{key}: missing")
        else:
            rule = str(e["ctx"]["error"]) if e["type"] == "value_error" else e["msg"].replace("Input should", "must", 1)
            shown = "a table" if isinstance(value, dict) else value
            lines.append(f"{key} = {shown}: {rule[0].lower()}{rule[1:]}")
    return lines


#: For every list of a line, the numbers its items have in the file; absent where they are 1, 2, 3, ...
Numbers = Mapping[str, Sequence[int]]


def _healthy_part(error: ValidationError, data: dict[str, Any]) -> tuple[LineSpec | None, Numbers]:
    """The line without what is wrong in itself, so that mistakes between keys are found too; None if too little is left."""
    rest = dict(data)
    bad: dict[str, set[int]] = {}
    for e in error.errors(include_url=False):
        key, *inside = e["loc"]
        if key in ("speed", "gradient", "crossover") and inside and isinstance(inside[0], int):
            bad.setdefault(str(key), set()).add(inside[0])
        else:
            rest.pop(str(key), None)
    if "start_m" in data and "start_m" not in rest:
        return None, {}
    numbers = {}
    for key in bad.keys() & rest.keys():
        good = [k for k in range(len(data[key])) if k not in bad[key]]
        rest[key] = [data[key][k] for k in good]
        numbers[key] = [k + 1 for k in good]
    if not rest.get("speed"):
        rest["speed"], numbers["speed"] = [[rest.get("start_m", 0.0), 1.0]], [1]
    try:
        return LineSpec.model_validate({"name": "line"} | rest), numbers
    except ValidationError:
        return None, {}


def violations(spec: LineSpec, numbers: Numbers | None = None) -> list[str]:
    """Every mistake that lies between the keys of a line, as ``key = value: rule``."""
    numbers = numbers or {}
    found = [f"tracks = {t}: appears more than once" for t in dict.fromkeys(spec.tracks) if spec.tracks.count(t) > 1]
    found += _profile_violations(spec, numbers)
    found += (regular := _regular_violations(spec))
    for label, c in _labelled(spec, numbers):
        found += _crossover_violations(spec, label, c)
    if many := _too_many(spec):
        return found + many
    # What the regular crossovers would meet is worth a word only if they are right in themselves.
    rest = spec.model_copy(update={"regular_crossovers": None}) if regular else spec
    return found + _meeting_violations(rest, numbers) + _close_cuts(rest)


def _labelled(spec: LineSpec, numbers: Numbers) -> list[tuple[str, Crossover]]:
    counted = zip(numbers.get("crossover", range(1, len(spec.crossover) + 1)), spec.crossover, strict=True)
    return [(f"crossover[{number if c.id is None else c.id}]", c) for number, c in counted]


def _profile_violations(spec: LineSpec, numbers: Numbers) -> list[str]:
    found = []
    line = f"the line ({text(spec.begin_m)} to {text(spec.end_m)} m)"
    for key, profile in (("speed", spec.speed), ("gradient", spec.gradient)):
        counted = zip(numbers.get(key, range(1, len(profile) + 1)), profile, strict=True)
        before = -math.inf
        for number, (at, value) in counted:
            label = f"{key}[{number}] = [{text(at)}, {value:g}]"
            if key == "speed" and number == 1:
                if rounded(at) != spec.begin_m:
                    found.append(f"{label}: must begin where the line does, at start_m = {text(spec.begin_m)}")
            elif not spec.begin_m <= rounded(at) < spec.end_m:
                found.append(f"{label}: lies outside {line}")
            if at <= before:
                found.append(f"{label}: from_m must increase, the one before begins at {text(before)} m")
            before = at
    return found


def _regular_violations(spec: LineSpec) -> list[str]:
    r = spec.regular_crossovers
    if r is None:
        return []
    found = []
    if len(spec.tracks) < 2:
        found.append("regular_crossovers: a line of one track has none")
    if r.length_m < SHARPEST_SWITCH * TRACK_SPACING_M:
        found.append(f"regular_crossovers.length_m = {r.length_m:g}: must be at least {_sharpness(TRACK_SPACING_M)}")
    if r.every_m < r.length_m + SHORTEST_EDGE_M:
        rule = f"must be longer than length_m = {r.length_m:g} by {SHORTEST_EDGE_M:g} m"
        found.append(f"regular_crossovers.every_m = {r.every_m:g}: {rule}")
    if not spec.begin_m + SHORTEST_EDGE_M <= r.first_m <= spec.end_m - r.length_m - SHORTEST_EDGE_M:
        rule = f"the first does not lie wholly inside the line, {text(spec.begin_m)} to {text(spec.end_m)} m"
        found.append(f"regular_crossovers.first_m = {text(r.first_m)}: {rule}")
    return found


def _crossover_violations(spec: LineSpec, label: str, c: Crossover) -> list[str]:
    found = [
        f"{label}.{key} = {track}: no such track; there are: {', '.join(spec.tracks)}"
        for key, track in (("from", c.from_track), ("to", c.to_track))
        if track not in spec.tracks
    ]
    if c.from_track == c.to_track:
        found.append(f"{label}.to = {c.to_track}: leads from a track to itself")
    elif not found:
        sideways = TRACK_SPACING_M * abs(spec.tracks.index(c.from_track) - spec.tracks.index(c.to_track))
        if c.length_m < SHARPEST_SWITCH * sideways:
            found.append(f"{label}.length_m = {c.length_m:g}: must be at least {_sharpness(sideways)}")
    key = f"{label}.position_m = {text(c.position_m)}"
    if c.start_m < spec.begin_m + SHORTEST_EDGE_M:
        found.append(f"{key}: must lie inside the line, which begins at {text(spec.begin_m)} m")
    if c.end_m > spec.end_m - SHORTEST_EDGE_M:
        found.append(f"{key}: ends at {text(c.end_m)} m, must lie wholly inside the line, which ends at {text(spec.end_m)} m")
    return found


def _sharpness(sideways: float) -> str:
    return f"{SHARPEST_SWITCH * sideways:g} m to reach a track {sideways:g} m beside"


def _too_many(spec: LineSpec) -> list[str]:
    edges = len(spec.tracks) * math.ceil(spec.length_m / spec.max_edge_m)
    found = []
    if edges > MOST_EDGES:
        found.append(f"max_edge_m = {spec.max_edge_m:g}: cuts the line into {edges} edges, at most {MOST_EDGES}")
    if spec.signals_m is not None and (blocks := len(spec.tracks) * math.ceil(spec.length_m / spec.signals_m)) > MOST_EDGES:
        found.append(f"signals_m = {spec.signals_m:g}: cuts the line into {blocks} blocks, at most {MOST_EDGES}")
    if (r := spec.regular_crossovers) and (count := 2 * (len(spec.tracks) - 1) * spec.length_m / r.every_m) > MOST_EDGES:
        found.append(f"regular_crossovers.every_m = {r.every_m:g}: makes {count:.0f} crossovers, at most {MOST_EDGES}")
    return found


def _meeting_violations(spec: LineSpec, numbers: Numbers) -> list[str]:
    """Two crossovers with one name, or that lie on top of each other."""
    found = []
    listed = _labelled(spec, numbers)
    everything = listed + [(f"regular_crossovers ({c.name})", c) for c in spec._regular()]
    first: dict[str, tuple[str, Crossover]] = {}
    for label, c in everything:
        other, same = first.setdefault(c.name, (label, c))
        if same is not c and (c.id is not None or same.id is not None):
            found.append(f"{label}: its id {c.name} is already that of {other}")
    ways: dict[tuple[str, str], list[tuple[float, float, str]]] = {}
    for label, c in everything:
        ways.setdefault((c.from_track, c.to_track), []).append((c.start_m, c.end_m, label))
    for (here, there), pieces in ways.items():
        pieces.sort()
        for (start, end, label), (next_start, _, other) in pairwise(pieces):
            if next_start < end:
                what = "is the same as" if next_start == start else "overlaps"
                found.append(f"{other}: {what} {label}, also from {here} to {there}, at {text(start)} to {text(end)} m")
    return found


def _close_cuts(spec: LineSpec) -> list[str]:
    found = []
    for track, reasons in spec.cuts().items():
        for a, b in pairwise(sorted(reasons)):
            if rounded(b - a) < SHORTEST_EDGE_M:
                rule = f"must be one place or at least {SHORTEST_EDGE_M:g} m apart, not {text(b - a)} m"
                found.append(f"tracks = {track}: {reasons[a]} and {reasons[b]}: {rule}")
    return list(dict.fromkeys(found))
