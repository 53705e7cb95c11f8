"""What a sweep gave: its dataset, and the share of runs that broke a bound."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from trainctl.signals import Floats

if TYPE_CHECKING:
    import pandas as pd

#: The dataset in the folder of a sweep.
RESULTS = "results.parquet"

#: What every complete run counts, see run.json.
COUNTS = ("violations", "collisions", "overspeeds", "gridlocks")

#: Quantile of the normal distribution for an interval of 95 %.
Z_95 = 1.959963984540054


def wilson(hits: int, total: int, z: float = Z_95) -> tuple[float, float] | None:
    """Wilson's score interval of a share, ``hits`` of ``total``; None if there is nothing to share."""
    if total == 0:
        return None
    p, n = hits / total, float(total)
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    low = 0.0 if hits == 0 else max(0.0, centre - half)
    return low, 1.0 if hits == total else min(1.0, centre + half)


def percents(interval: Sequence[float]) -> str:
    """An interval of shares in per cent, in words."""
    low, high = (f"{100.0 * end:.2g}" if end < 0.995 else f"{100.0 * end:.3g}" for end in interval)
    return f"{low} .. {high} %"


class Part(NamedTuple):
    """Results of k runs, column by column."""

    parameters: Sequence[Mapping[str, Any]]
    status: Sequence[str]  # complete, failed, refused
    failure: Sequence[str | None]
    counts: Mapping[str, Floats]  # by ``COUNTS``, NaN of runs that are not complete
    metrics: Mapping[str, Floats]  # NaN: the run has none
    alone: Sequence[str | None]  # why a run was not stacked with others; None: it was, or that was not asked for

    def kept(self, which: Sequence[int]) -> Part:
        """These of its runs."""
        rows = list(which)

        def column(values: Sequence[Any]) -> list[Any]:
            return [values[k] for k in rows]

        return Part(
            column(self.parameters), column(self.status), column(self.failure),
            {key: c[rows] for key, c in self.counts.items()}, {key: c[rows] for key, c in self.metrics.items()},
            column(self.alone),
        )  # fmt: skip


def part(rows: Sequence[Mapping[str, Any]], alone: Sequence[str | None] | None = None) -> Part:
    """Rows of single runs as columns."""
    metrics = dict.fromkeys(key for row in rows for key in row.get("metrics") or {})

    def column(values: Sequence[Any]) -> Floats:
        return np.array([np.nan if value is None else value for value in values], float)

    return Part(
        [row["parameters"] for row in rows], [row["status"] for row in rows], [row.get("failure") for row in rows],
        {key: column([row.get(key) for row in rows]) for key in COUNTS},
        {key: column([(row.get("metrics") or {}).get(key) for row in rows]) for key in metrics},
        [None] * len(rows) if alone is None else list(alone),
    )  # fmt: skip


def joined(parts: Sequence[Part]) -> Part:
    """Parts one after the other."""

    def columns(which: Sequence[Mapping[str, Floats]], names: Iterable[str]) -> dict[str, Floats]:
        empty = [np.full(len(p.status), np.nan) for p in parts]
        return {key: np.concatenate([of.get(key, none) for of, none in zip(which, empty, strict=True)]) for key in names}

    def values(columns: Iterable[Sequence[Any]]) -> list[Any]:
        return [value for column in columns for value in column]

    return Part(
        values(p.parameters for p in parts), values(p.status for p in parts), values(p.failure for p in parts),
        columns([p.counts for p in parts], COUNTS) if parts else {key: np.zeros(0) for key in COUNTS},
        columns([p.metrics for p in parts], dict.fromkeys(key for p in parts for key in p.metrics)),
        values(p.alone for p in parts),
    )  # fmt: skip


def write_part(found: Part, path: Path) -> None:
    """Keep results of stacked runs, whole or not at all."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns: dict[str, Any] = {"parameters": [json.dumps(p, default=str) for p in found.parameters]}
    columns |= {
        "status": found.status,
        "failure": pa.array(found.failure, pa.string()),
        "alone": pa.array(found.alone, pa.string()),
    }
    new = path.with_suffix(".new")
    pq.write_table(pa.table({**columns, **found.counts, **found.metrics}), new, compression="zstd")
    os.replace(new, path)


def read_part(path: Path) -> Part:
    """What ``write_part`` kept."""
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    numbers = {key: table[key].to_numpy() for key in table.column_names if key not in ("parameters", "status", "failure", "alone")}
    return Part(
        [json.loads(text) for text in table["parameters"].to_pylist()], table["status"].to_pylist(), table["failure"].to_pylist(),
        {key: numbers.pop(key) for key in COUNTS}, numbers, table["alone"].to_pylist(),
    )  # fmt: skip


def write_results(found: Part, numbers: Sequence[int], path: Path) -> pd.DataFrame:
    """The dataset: one row per run, in the order of the plan. Nothing in it tells when, where or in which order runs were done.

    Parameters
    ----------
    found : Part
        The runs in that order.
    numbers : sequence of int
        Their numbers in the plan.
    path : Path
        Of the dataset.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    from trainctl.record.folder import SCHEMA_VERSION

    columns: dict[str, Any] = {"run": pa.array(numbers, pa.int64())}
    for key in dict.fromkeys(key for parameters in found.parameters for key in parameters):
        columns[key] = _column([_plain(parameters.get(key)) for parameters in found.parameters])
    columns["status"], columns["failure"] = _column(list(found.status)), pa.array(found.failure, pa.string())
    columns |= {key: pa.array(found.counts[key], pa.int64(), from_pandas=True) for key in COUNTS}
    metrics = sorted(key for key, column in found.metrics.items() if key not in columns and not np.isnan(column).all())
    columns |= {key: pa.array(found.metrics[key], pa.float64(), from_pandas=True) for key in metrics}
    table = pa.table(columns).replace_schema_metadata({"schema_version": str(SCHEMA_VERSION), "table": "sweep"})
    new = path.with_suffix(".new")
    pq.write_table(table, new, compression="zstd")
    os.replace(new, path)
    frame: pd.DataFrame = table.to_pandas()
    return frame


def reasons(found: Part, numbers: Sequence[int]) -> list[str]:
    """The first few runs that gave nothing, and why."""
    without = [k for k, status in enumerate(found.status) if status != "complete"]
    told = [f"run {numbers[k]} {found.status[k]}: {found.failure[k]}" for k in without[:5]]
    return told + ([f"and {len(without) - 5} more"] if len(without) > 5 else [])


def shares(folder: Path, varied: Sequence[str]) -> list[dict[str, Any]]:
    """Share of complete runs with a violated bound for every combination of the settings ``varied``, seeds taken together."""
    import pandas as pd

    frame = pd.read_parquet(folder / RESULTS)
    done = frame[frame["status"] == "complete"]
    groups = done.groupby(list(varied), sort=False, dropna=False) if varied else [((), done)]
    found = []
    for values, part in groups:
        if len(part):
            hits, total = int((part["violations"] > 0).sum()), len(part)
            found.append(
                {"values": tuple(values), "runs": hits, "of": total, "share": hits / total, "interval_95": wilson(hits, total)}
            )
    return found


def not_settled(folder: Path) -> int:
    """Complete runs with links that did not stay within their band by the end."""
    import pandas as pd

    from trainctl.figures.sweep import not_settled as of

    frame = pd.read_parquet(folder / RESULTS)
    return int(of(frame[frame["status"] == "complete"]).sum())


def _plain(value: Any) -> Any:
    """Lists and tables as JSON text."""
    return json.dumps(value, default=str) if isinstance(value, list | dict) else value


def _column(column: list[Any]) -> Any:
    import pyarrow as pa

    known, kind = [value for value in column if value is not None], None
    if known and all(isinstance(value, int | float) and not isinstance(value, bool) for value in known):
        if all(isinstance(value, int) and -(2**63) <= value < 2**63 for value in known):
            kind = pa.int64()
        else:
            kind, column = pa.float64(), [value if value is None else float(value) for value in column]
    if kind is None and not (known and all(isinstance(value, bool) for value in known)):
        kind, column = pa.string(), [value if value is None else str(value) for value in column]
    return pa.array(column, kind)
