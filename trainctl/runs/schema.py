"""What must be in the tables of a run folder before anything is computed from them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from trainctl.errors import InputError

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
        raise InputError(f"{place}: {name}: a column stands more than once")
    for column in ("time_s", *KEYS[name], *NEEDED[name]):
        if column not in columns:
            wrong.append(f"{place}: {name}: has no column {column}")
    for column in columns:
        rule = _column_rule(column, table[column], column in ("time_s", *KEYS[name]))
        if rule:
            wrong.append(f"{place}: {name}.{column!s:.60}: {rule}".replace("\n", " "))
    if wrong:
        raise InputError(wrong)
    time = table["time_s"].to_numpy()
    new = np.diff(time) > 0
    if np.any(np.diff(time) < 0):
        raise InputError(f"{place}: {name}: time does not ascend")
    code = np.concatenate([[0], np.cumsum(new)]) if len(time) else np.zeros(0, np.int64)
    for key in KEYS[name]:
        column = table[key].combine_chunks()
        if key == "unit":
            column = column.dictionary_encode()
        code = code * (len(column.dictionary) + 1) + column.indices.to_numpy(zero_copy_only=False)
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
    known = column.filter(pc.is_finite(column))
    if name in STATES and len(known) < len(column):
        return "a number is missing or not finite"
    ends = pc.min_max(known)
    if len(known) and max(abs(ends["min"].as_py()), abs(ends["max"].as_py())) > GREATEST:
        return f"a number is beyond {GREATEST:g}"
    return None
