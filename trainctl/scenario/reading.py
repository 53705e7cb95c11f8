"""Scenario files: finding, reading, merging, and the words in which a mistake is reported.

A mistake is one line, ``file: key = value: rule``; all mistakes of a file come at once. Rules that need more than the file
(the line, the law's start conditions) live in ``trainctl.scenario.build``.
"""

from __future__ import annotations

import difflib
import importlib.resources
import json
import math
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sumo_net.bounded import reason, short_text
from trainctl.errors import InputError
from trainctl.scenario.reference import FORMS
from trainctl.scenario.tables import Scenario

#: Letters of a list that a mistake shows whole.
SHOWN = 60


def shipped() -> dict[str, Path]:
    """Scenarios that come with the package: name -> file."""
    inside = Path(str(importlib.resources.files("trainctl"))) / "shipped_scenarios"  # in an installed wheel
    folder = inside if inside.is_dir() else Path(__file__).resolve().parent.parent.parent / "scenarios"
    return {p.stem: p for p in sorted(folder.glob("*.toml"))}


def find(name: str) -> Path:
    """The file of a shipped scenario's name or of a path."""
    path = Path(name)
    if path.suffix == ".toml" or path.exists():
        if not path.is_file():
            raise InputError(f"{name}: no such scenario file")
        if path.suffix in (".sumocfg", ".cfg"):
            cure = f"`trainctl new scenario {shlex.quote(name)}` writes one for its trains"
            raise InputError(f"{name}: a SUMO configuration is no scenario: {cure}")
        return path
    known = shipped()
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise InputError(f"{name}: no such scenario (see `trainctl list`) and no such file{hint}")
    return known[name]


def load(name: str, overrides: dict[str, Any] | None = None) -> tuple[Scenario, Path]:
    """Read a scenario by name or path, with ``{"run.duration_s": 60}``-like overrides.

    Raises
    ------
    InputError
        With one line per mistake.
    """
    data, path = read(name, overrides)
    scenario, found = examine(data)
    if scenario is None or found:
        raise InputError([f"{path.name}: {line}" for line in found])
    return scenario, path


def read(name: str, overrides: dict[str, Any] | None = None) -> tuple[dict[str, Any], Path]:
    """The tables of a scenario as they stand, and its file. With another law the keys of the file's law are left out."""
    path = find(name)
    data = _read(path)
    table, law = data.get("controller"), (overrides or {}).get("controller.law")
    if law is not None and isinstance(table, dict) and table.get("law") != law:
        data["controller"] = {}
    for key, value in (overrides or {}).items():
        _set(data, key, value)
    return data, path


def _read(path: Path, above: tuple[Path, ...] = ()) -> dict[str, Any]:
    """The tables of a file, laid over those of the scenario it extends."""
    try:
        data = tomllib.loads(short_text(path))
    except (ValueError, RecursionError) as error:  # not TOML, not text, a number of 5000 digits
        raise InputError(f"{path.name}: not a TOML file: {reason(error)}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    base = data.pop("extends", None)
    if base is None:
        return data
    try:
        beside = path.parent / str(base)
        under = beside if beside.is_file() else find(str(base))
    except InputError as error:
        raise InputError([f"{path.name}: extends = {m}" for m in error.mistakes]) from None
    if under.resolve() in above:
        raise InputError(f"{path.name}: extends = {base}: leads back to itself")
    return _over(_found_from(_read(under, (*above, path.resolve())), under.parent, path.parent), data)


def _found_from(data: dict[str, Any], here: Path, there: Path) -> dict[str, Any]:
    """The tables of a file in ``here`` for one in ``there``: files beside the former are named in full."""
    network = data.get("network")
    if here.resolve() == there.resolve() or not isinstance(network, dict):
        return data
    beside = {k: str(here.resolve() / v) for k, v in network.items() if isinstance(v, str) and (here / v).is_file()}
    return {**data, "network": {**network, **beside}} if beside else data


#: Keys that exclude each other: who states one of them drops the extended file's.
EXCLUSIVE = {"network": ("line", "net", "sumocfg"), "reference": FORMS}


def _over(base: dict[str, Any], data: dict[str, Any]) -> dict[str, Any]:
    """``data`` over ``base``: tables key by key, trains by id, everything else replaced."""
    merged = dict(base)
    for key, value in data.items():
        old = base.get(key)
        if isinstance(old, dict) and isinstance(value, dict):
            # Another law, plant or observer brings its own keys; the old one's would be unknown to it.
            other = any(k in value and k in old and value[k] != old[k] for k in ("law", "kind"))
            dropped = set(EXCLUSIVE.get(key, ())) if any(k in value for k in EXCLUSIVE.get(key, ())) else set()
            if key == "reference" and dropped and "s_curves" not in value:
                dropped.add("start_speed_mps")
            merged[key] = value if other else _over({k: v for k, v in old.items() if k not in dropped}, value)
        elif key == "train" and isinstance(old, list) and isinstance(value, list):
            merged[key] = _trains_over(old, value)
        else:
            merged[key] = value
    return merged


def _trains_over(base: list[Any], trains: list[Any]) -> list[Any]:
    news = {str(t.get("id")): t for t in trains if isinstance(t, dict)}
    known = {str(t.get("id")) for t in base if isinstance(t, dict)}
    changed = [{**t, **news.get(str(t.get("id")), {})} if isinstance(t, dict) else t for t in base]
    return [*changed, *(t for t in trains if not isinstance(t, dict) or str(t.get("id")) not in known)]


def _set(data: dict[str, Any], key: str, value: Any) -> None:
    *parents, last = key.split(".")
    table: Any = data
    for part in parents:
        table = table.setdefault(part, {}) if isinstance(table, dict) else table
    if not isinstance(table, dict):
        raise InputError(f"--set {key}: {'.'.join(parents)} is not a table")
    table[last] = value


def examine(data: dict[str, Any], resolved: bool = False) -> tuple[Scenario | None, list[str]]:
    """A scenario and all mistakes in its file.

    ``resolved`` says that it is the one of a run folder, which names the trains that were taken from ``network.sumocfg``.
    With mistakes, the scenario is what remains without the keys that are wrong, so that the others can still be checked; None if
    too little remains.
    """
    beyond = list(_beyond(data))
    found = [f"{_key(list(place), data)} = {value}: beyond {GREATEST:g}" for place, value in beyond]
    rest = _without(data, [place for place, _ in beyond]) if beyond else data
    for _ in range(3):
        try:
            # JSON has the same types as TOML but for dates, and lets arrays stand for tuples under strict rules.
            scenario = Scenario.model_validate_json(json.dumps(rest, default=str))
        except ValidationError as error:
            found += [line for line in mistakes(error, rest) if not (rest is not data and line.endswith(": missing"))]
            places = [e["loc"] for e in error.errors() if e["type"] != "missing"]
            if any(len(p) == 2 and p[0] in ("train", "link", "train_type") for p in places):
                break  # without one of its trains, links or types it is another scenario
            # Lists keep their numbers, or go as a whole.
            rest = _without(rest, [p[:1] if len(p) == 2 and isinstance(p[1], int) else p for p in places])
            if isinstance(rest.get("run"), dict):
                rest["run"].setdefault("duration_s", rest["run"].get("step_s", 1.0))  # nothing else is checked against it
        else:
            wrong = scenario.cross_references(resolved)
            return (None if wrong else scenario), list(dict.fromkeys([*found, *wrong]))
    return None, list(dict.fromkeys(found))


#: No quantity of a railway is greater in SI units; products of several still are finite.
GREATEST = 1e15


def _beyond(value: Any, place: tuple[int | str, ...] = ()) -> Iterator[tuple[tuple[int | str, ...], Any]]:
    """Places of numbers that are too great to compute with; seeds are no quantities."""
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _beyond(item, (*place, key))
    elif isinstance(value, int | float) and GREATEST < abs(value) < math.inf and place[-1] != "seed":
        yield place, value


def _without(data: Any, places: list[tuple[int | str, ...]]) -> Any:
    """A copy without the values at these places; places inside a union are cut where the data end."""
    doomed = [p for p in places if p]
    if isinstance(data, dict):
        kept = {k: v for k, v in data.items() if not any(p[0] == k and not _inside(v, p[1:]) for p in doomed)}
        return {k: _without(v, [p[1:] for p in doomed if p[0] == k]) for k, v in kept.items()}
    if isinstance(data, list):
        kept_items = [(k, v) for k, v in enumerate(data) if not any(p[0] == k and not _inside(v, p[1:]) for p in doomed)]
        return [_without(v, [p[1:] for p in doomed if p[0] == k]) for k, v in kept_items]
    return data


def _inside(value: Any, place: tuple[int | str, ...]) -> bool:
    """Whether the rest of a place leads further into the value."""
    if not place:
        return False
    if isinstance(value, dict):
        return place[0] in value
    return isinstance(value, list) and isinstance(place[0], int) and place[0] < len(value)


def mistakes(error: ValidationError, data: dict[str, Any], under: str = "", model: Any = Scenario) -> list[str]:
    """One line per mistake pydantic found: ``key = value: rule``."""
    lines = []
    for e in _of_the_member(error.errors(include_url=False)):
        loc = list(e["loc"])
        key = _key(loc, data)
        key = f"{under}.{key}" if under and key else under or key
        value = e["input"]
        if e["type"] == "extra_forbidden":
            known = _known(loc, model)
            near = difflib.get_close_matches(str(loc[-1]), known, n=1)
            rule = (
                "unknown key" + (f"; did you mean {near[0]}?" if near else "") + (f"; known: {', '.join(known)}" if known else "")
            )
            lines.append(f"{key}: {rule}")
        elif e["type"] == "missing":
            lines.append(f"{key}: missing")
        elif e["type"] == "value_error":
            rule = str(e["ctx"]["error"]) if "ctx" in e else e["msg"]
            lines += [f"{key}: {r}" for r in rule.split("; ")] if "; " in rule and "=" in rule else [f"{key}: {rule}"]
        else:
            lines.append(f"{key} = {_shown(value, e['type'])}: {e['msg'][0].lower()}{e['msg'][1:]}")
    return list(dict.fromkeys(lines))


def _shown(value: Any, mistake: str) -> str:
    """A value as it stands in the file, as far as that is short; a text in its quotes where they are the mistake."""
    if isinstance(value, list) and len(text := str(value)) <= SHOWN and "{" not in text:
        return text.replace("'", '"')
    if isinstance(value, dict | list):
        return "..."
    return f'"{value}"' if isinstance(value, str) and mistake in ("float_type", "int_type", "bool_type") else str(value)


_UNION_MEMBERS = {"int", "str", "float", "constrained-int", "constrained-float"}


def _of_the_member(errors: list[Any]) -> list[Any]:
    """Without what pydantic says of the other member where a value may be a number or a list: of a list, that it is no number."""

    def of_the_other(e: Any) -> bool:
        member = str(e["loc"][-1]) if e["loc"] else ""
        is_list = isinstance(e["input"], list)
        return member in _UNION_MEMBERS if is_list else member.startswith("tuple[")

    def told_better(e: Any) -> bool:
        place = e["loc"][:-1]
        return any(o is not e and o["loc"][: len(place)] == place and not of_the_other(o) for o in errors)

    return [e for e in errors if not (of_the_other(e) and told_better(e))]


def _key(loc: list[Any], data: Any) -> str:
    """Dotted key; trains by id, other lists by number from 1."""
    text, here = "", data
    for k, part in enumerate(loc):
        if isinstance(part, int):
            item = here[part] if isinstance(here, list) and part < len(here) else None
            name = item.get("id", part + 1) if isinstance(item, dict) and loc[k - 1] == "train" else part + 1
            text += f"[{name}]"
            here = item
        elif isinstance(here, dict) or here is None:
            if part in _UNION_MEMBERS or str(part).startswith(("tuple[", "function-")):
                continue
            text += ("." if text else "") + str(part)
            here = here.get(part) if isinstance(here, dict) else None
    return text


def _known(loc: list[Any], model: Any) -> list[str]:
    """Keys the table at ``loc[:-1]`` of ``model`` has."""
    for part in loc[:-1]:
        field = getattr(model, "model_fields", {}).get(part)
        if field is not None:
            inner = [a for a in getattr(field.annotation, "__args__", ()) if hasattr(a, "model_fields")]
            model = inner[0] if inner else field.annotation
    return list(getattr(model, "model_fields", {}))
