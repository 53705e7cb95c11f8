"""What is compared: SUMO's logs (``trainctl.runs`` reads them) and the tables of our own runs, as streams of one kind."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

from trainctl.errors import InputError
from trainctl.runs.kinds import KINDS, NAMES
from trainctl.runs.logs import Log, sumo_log
from trainctl.runs.run import Run
from trainctl.runs.tables import parquet_names, parquet_rows

__all__ = ["KINDS", "NAMES", "Log", "our_events", "our_table", "sumo_log", "sumo_logs_in"]


def our_table(run: Run, table: str) -> Log:
    """A table of a run folder as a stream; its stops are called calls, since a log of SUMO's has that name."""
    keys = {"trains": ("train",), "units": ("train", "unit"), "links": ("sender", "receiver"), "stops": ("train", "number")}[table]
    time = None if table == "stops" else "time_s"

    def batches() -> Iterator[pa.Table]:
        for path in run.files(table):
            names = parquet_names(path)
            if len(set(names)) < len(names):
                raise InputError(f"{path}: a column appears more than once")
            for batch in (rows.rename_columns(names) for rows in parquet_rows(path)):
                for name in (*([time] if time else []), *keys):
                    if name not in batch.column_names:
                        raise InputError(f"{path}: has no column {name}")
                yield batch

    return Log("calls" if table == "stops" else table, str(run.folder / f"{table}.parquet"), time, keys, batches)


def our_events(run: Run, renamed: Mapping[str, str]) -> Log:
    """The events of a run; ``renamed`` maps names of trains to those they are to be compared with."""

    def name(text: str) -> str:
        return "-".join(renamed.get(part, part) for part in text.split("-"))

    def known(value: Any) -> Any:
        if isinstance(value, str):
            return name(value)
        if isinstance(value, list):
            return [known(item) for item in value]
        return {key: known(item) for key, item in value.items()} if isinstance(value, dict) else value

    def batches() -> Iterator[pa.Table]:
        rows = []
        for event in run.events:
            row = {str(key): known(value) for key, value in event.items()}
            row["train"] = str(row.get("train", ""))
            rows.append({key: v if isinstance(v, str) else json.dumps(v) for key, v in row.items()})
        # A run that is resumed or stopped may log what happened at one instant in another order.
        rows.sort(key=lambda row: float(row["time_s"]))
        names = dict.fromkeys(key for row in rows for key in row)
        yield pa.table({key: pa.array([row.get(key) for row in rows], pa.string()) for key in names})

    return Log("events", str(run.folder / "events.jsonl"), "time_s", ("kind", "train"), batches)


def sumo_logs_in(folder: Path) -> dict[str, Path]:
    """Logs of a folder by kind; a folder with two of one kind is not unambiguous."""
    found: dict[str, Path] = {}
    if not folder.is_dir():
        return found
    for path in sorted(folder.iterdir()):
        words = path.name.lower().split(".")
        if not path.is_file() or not {"xml", "csv", "parquet"} & set(words[1:]):
            continue
        if {"net", "rou", "nod", "edg", "con", "add"} & set(words[1:]):
            continue
        log = sumo_log(path)
        if log is None:
            continue
        name = log.name or next((k.name for k in KINDS if words[0].startswith(k.name[:9])), "")
        if name in found:
            raise InputError(f"{folder}: {found[name].name} and {path.name} are both {name}: compare the files themselves")
        if name:
            found[name] = path
    return found
