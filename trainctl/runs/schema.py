"""What must be in the files of a run folder before anything is computed from them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from trainctl.errors import InputError
from trainctl.runs.series import coded, in_numpy

#: Columns every table has, as the recorder writes them.
KEYS = {"trains": ("train",), "units": ("train", "unit"), "links": ("sender", "receiver")}
NEEDED = {
    "trains": ("track", "edge", "position_m", "speed_mps", "input_mps2", "spacing_m", "gap_m", "saturated"),
    "units": (
        "position_m", "speed_mps", "force_n", "coupler_m", "coupler_force_n", "coupler_min_m", "coupler_max_m", "force_min_n",
        "force_max_n",
    ),
    "links": ("spacing_m", "desired_m", "lower_m", "upper_m", "heard"),
}  # fmt: skip
#: Columns of names, columns of yes or no, numbers that are never missing.
NAMES = ("train", "sender", "receiver", "track", "edge")
FLAGS = ("saturated", "heard")
STATES = ("time_s", "position_m", "speed_mps", "desired_m")

#: No number of a run is greater than this; its square can still be computed with.
GREATEST = 1e60


def check_table(name: str, table: pa.Table, place: Path) -> None:
    """Refuse a table that is not what the recorder writes.

    Raises
    ------
    InputError
        Naming the table and every column that is missing or wrong, or rows that stand twice or out of order.
    """
    if name not in KEYS:
        return
    columns, wrong = table.column_names, []
    if len(set(columns)) < len(columns):
        raise InputError(f"{place}: {name}: a column appears more than once")
    for column in ("time_s", *KEYS[name], *NEEDED[name]):
        if column not in columns:
            wrong.append(f"{place}: {name}: has no column {column}")
    for column in columns:
        rule = _column_rule(column, table[column], column in ("time_s", *KEYS[name]))
        if rule:
            wrong.append(f"{place}: {name}.{column!s:.60}: {rule}".replace("\n", " "))
    if wrong:
        raise InputError(wrong)
    time = in_numpy(table["time_s"])
    new = np.diff(time) > 0
    if np.any(np.diff(time) < 0):
        raise InputError(f"{place}: {name}: time does not ascend")
    code = np.concatenate([[0], np.cumsum(new)]) if len(time) else np.zeros(0, np.int64)
    for key in KEYS[name]:
        key_of = coded(table[key])
        code = code * (len(key_of.names) + 1) + key_of.codes
    if np.any(np.diff(code) <= 0) and len(np.unique(code)) < len(code):
        twice = np.setdiff1d(np.arange(len(code)), np.unique(code, return_index=True)[1])[0]
        raise InputError(f"{place}: {name}: two rows of one {' and '.join(KEYS[name])} at {time[twice]:g} s")


def _column_rule(name: str, column: pa.ChunkedArray, is_key: bool) -> str | None:
    """What is wrong with a column, None if nothing is."""
    kind = column.type
    if name in NAMES:
        text = pa.types.is_dictionary(kind) and pa.types.is_string(kind.value_type)
        if not text:
            return f"must be names, not {kind}"
        return "a name is missing" if is_key and column.null_count else None
    if name in FLAGS:
        return None if pa.types.is_boolean(kind) and not column.null_count else "must be true or false"
    if name == "unit":
        return None if pa.types.is_integer(kind) and not column.null_count else "must be a whole number"
    if pa.types.is_integer(kind) or pa.types.is_boolean(kind):
        return "a number is missing" if column.null_count else None
    if not pa.types.is_float64(kind):
        return f"must be numbers, not {kind}"
    if column.null_count:
        return "a number is missing"
    known = (numbers := in_numpy(column))[np.isfinite(numbers)]  # pyarrow.compute takes long to import
    if name in STATES and len(known) < len(numbers):
        return "a number is missing or not finite"
    if np.max(np.abs(known), initial=0.0) > GREATEST:
        return f"a number is beyond {GREATEST:g}"
    return None


def _text(value: Any) -> bool:
    return isinstance(value, str)


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _texts(value: Any) -> bool:
    return isinstance(value, list) and all(map(_text, value))


def _or_nothing(rule: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: value is None or rule(value)


def _table(**fields: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, dict) and all(key in value and rule(value[key]) for key, rule in fields.items())


def _lists(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, list) for item in value)


Rules = Mapping[str, Callable[[Any], bool]]

_EXTREME: Rules = {"who": _text, "value": _number, "limit": _number, "time_s": _number}

#: What readers rely on in run.json, where it is there.
INFO: Rules = {
    "status": _text, "backend": _text, "scenario_sha256": _text, "seed": _or_nothing(_number), "steps": _count,
    "wall_time_s": _number,
    "versions": lambda value: isinstance(value, dict) and all(map(_or_nothing(_text), value.values())),
    "checks_failed": _texts, "files": _texts, "first_violation": _or_nothing(_table(bound=_text, who=_text, time_s=_number)),
    "worst": lambda value: isinstance(value, dict) and all(map(_table(**_EXTREME), value.values())),
    **dict.fromkeys(("violations", "collisions", "overspeeds", "gridlocks", "waited_long", "not_entered"), _count),
}  # fmt: skip

#: What readers rely on in every event, where it is there.
ANY_EVENT: Rules = {
    "train": _text, "edges": _lists, "formations": _lists, "position_m": _number, "edge_m": _number, "track": _text, "edge": _text,
}  # fmt: skip

#: What an event of a kind must have for its readers.
EVENTS: Mapping[str, Rules] = {
    "violation": {"bound": _text, "who": _text, "value": _number},
    "depart": {"delay_s": _number},
    "gridlock": {
        "waits": lambda value: (
            isinstance(value, list) and all(map(_table(train=_text, other=_or_nothing(_text), place=_text, edge=_text), value))
        )
    },
    "waiting": {"train": _text, "other": _or_nothing(_text), "since_s": _number},
    "not_entered": {"trains": _texts},
    "followed": {"what": _text},
    "not_followed": {"what": _text},
    "stop_reached": {"train": _text, "stop": _text},
    "waypoint": {"train": _text, "stop": _text},
}


def wrong_fields(found: Mapping[str, Any], rules: Rules, needed: bool) -> list[str]:
    """Names of fields that are not what they must be; with ``needed`` also of those that are missing."""
    return [key for key, rule in rules.items() if (key in found or needed) and not rule(found.get(key))]


def is_event(found: Any) -> bool:
    """Whether a line of events.jsonl is an event that can be read."""
    if not (isinstance(found, dict) and _number(found.get("time_s")) and _text(found.get("kind"))):
        return False
    return not wrong_fields(found, EVENTS.get(found["kind"], {}), True) and not wrong_fields(found, ANY_EVENT, False)
