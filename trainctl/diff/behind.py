"""The rows behind a finding, as far as they were kept."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa

from trainctl.diff.columns import differing
from trainctl.diff.findings import Finding
from trainctl.diff.rows import TableDiff
from trainctl.diff.tally import Evidence
from trainctl.diff.tolerance import Tolerances
from trainctl.signals import Ints


class Behind(NamedTuple):
    """A value that differs, or a row that only one log has (``column`` is empty then, and one of the values says "row")."""

    table: str
    time_s: float | None
    who: str
    column: str
    a: Any
    b: Any


def rows_behind(finding: Finding, tables: list[TableDiff], tolerances: Tolerances, most: int) -> list[Behind]:
    """The first rows behind a finding, in the order of time: at most so many of each log.

    Rows are kept of trains that differ from the piece of the log on in which they differ first, up to 20 000 of a train. With
    tolerances in time values are set against those of the same instant.
    """
    out = []
    for t in tables:
        if t.table in finding.codes:
            found = sorted(_of_table(finding, t, tolerances), key=lambda row: -np.inf if row.time_s is None else row.time_s)
            out += found[:most]
    return out


def _of_table(finding: Finding, t: TableDiff, tolerances: Tolerances) -> Iterator[Behind]:
    wanted = np.array(finding.codes[t.table], np.int64)
    (a, keys_a), (b, keys_b) = (_own(evidence, t, wanted) for evidence in (t.rows_a, t.rows_b))
    names = [name for name in keys_a.columns if name != "row"]
    pairs = keys_a.merge(keys_b, on=names, how="outer", suffixes=("_a", "_b"))
    only_a, only_b = pairs[pairs.row_b.isna()], pairs[pairs.row_a.isna()]
    if finding.rows:
        for only, said in ((only_a, ("row", None)), (only_b, (None, "row"))):
            for row in only.itertuples(index=False):
                yield Behind(t.table, _time(t, row), _who(t, row), "", *said)
    both = pairs.dropna(subset=["row_a", "row_b"])
    if not len(both):
        return
    left, right = a.take(pa.array(both.row_a.astype(int))), b.take(pa.array(both.row_b.astype(int)))
    for name in [c for c in finding.columns if c in left.column_names and c in right.column_names]:
        bad = differing(name, left[name], right[name], tolerances.of(t.table, name)).bad
        for k in np.flatnonzero(bad):
            pair = both.iloc[int(k)]
            yield Behind(t.table, _time(t, pair), _who(t, pair), name, left[name][int(k)].as_py(), right[name][int(k)].as_py())


def _own(evidence: Evidence, t: TableDiff, trains: Ints) -> tuple[pa.Table, pd.DataFrame]:
    """Kept rows of some trains, and what distinguishes each: time, train, other keys, how many times it occurred before."""
    table, time, train = evidence.rows()
    mine = np.isin(train, trains)
    part = table.filter(pa.array(mine)) if len(mine) else table
    keys = pd.DataFrame({"time": np.round(time[mine], 6), "train": train[mine]})
    for name in t.keys[1:]:
        keys[name] = part[name].cast(pa.string()).to_pylist() if name in part.column_names else ""
    keys["again"] = keys.groupby(list(keys.columns)).cumcount()
    keys["row"] = np.arange(len(keys))
    return part, keys


def _time(t: TableDiff, row: Any) -> float | None:
    return float(row.time) if t.time is not None else None


def _who(t: TableDiff, row: Any) -> str:
    names = [f"{t.keys[0]} {t.trains[int(row.train)]}"] if t.keys else []
    return ", ".join([*names, *(f"{name} {getattr(row, name)}" for name in t.keys[1:])])
