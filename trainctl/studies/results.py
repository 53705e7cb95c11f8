"""What a sweep gave: its dataset, and the share of runs that broke a bound."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

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


def write_results(rows: Sequence[Mapping[str, Any]], path: Path) -> pd.DataFrame:
    """The dataset: one row per run, in the order of the plan. Nothing in it tells when, where or in which order runs were done."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    from trainctl.record.folder import SCHEMA_VERSION

    parameters = list(dict.fromkeys(key for row in rows for key in row["parameters"]))
    metrics = sorted({key for row in rows for key in row.get("metrics") or {}})
    columns: dict[str, list[Any]] = {"run": [row["run"] for row in rows]}
    columns |= {key: [_plain(row["parameters"].get(key)) for row in rows] for key in parameters}
    columns |= {key: [row.get(key) for row in rows] for key in ("status", "failure", *COUNTS)}
    columns |= {key: [(row.get("metrics") or {}).get(key) for row in rows] for key in metrics if key not in columns}
    arrays = {key: _column(column, pa.float64() if key in metrics else None) for key, column in columns.items()}
    table = pa.table(arrays).replace_schema_metadata({"schema_version": str(SCHEMA_VERSION), "table": "sweep"})
    new = path.with_suffix(".new")
    pq.write_table(table, new, compression="zstd")
    os.replace(new, path)
    frame: pd.DataFrame = table.to_pandas()
    return frame


def reasons(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The first few runs that gave nothing, and why."""
    without = [row for row in rows if row["status"] != "complete"]
    found = [f"run {row['run']} {row['status']}: {row['failure']}" for row in without[:5]]
    return found + ([f"and {len(without) - 5} more"] if len(without) > 5 else [])


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


def _column(column: list[Any], kind: Any) -> Any:
    import pyarrow as pa

    known = [value for value in column if value is not None]
    if kind is None and known and all(isinstance(value, int | float) and not isinstance(value, bool) for value in known):
        kind = pa.int64() if all(isinstance(value, int) for value in known) else pa.float64()
    if kind is None and not (known and all(isinstance(value, bool) for value in known)):
        kind, column = pa.string(), [value if value is None else str(value) for value in column]
    return pa.array(column, kind)
