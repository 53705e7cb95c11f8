"""Logs as streams of tables with the same column names whatever their format: SUMO's XML, CSV and Parquet, and our own.

A column is named as SUMO's XML names the attribute (``speed``, ``lane``); attributes of elements inside a row carry the name of
their element (``emissions_CO_abs``), as in SUMO's CSV. Nothing here trusts a file: no document types, bounded memory, one clear
line for whatever is wrong.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.csv as pc_csv
import pyarrow.parquet as pq

from trainctl.errors import InputError
from trainctl.record.run import Run
from trainctl.record.sumo_logs import ELEMENT_BYTES, elements, kind_of, opened

BATCH_ROWS = 1 << 15
#: A log with more columns than this is not one of SUMO's.
MOST_COLUMNS = 1000


class Kind(NamedTuple):
    """One of SUMO's logs."""

    name: str
    root: str
    rows: tuple[str, ...]  # elements that are rows
    step: str  # element that carries the time of the rows in it, if the rows do not
    time: str | None  # column with the time
    keys: tuple[str, ...]  # columns that tell rows of one instant apart
    prefixes: tuple[str, ...]  # of columns in CSV and Parquet
    mark: str  # a column only this kind has in CSV and Parquet


KINDS = (
    Kind("fcd", "fcd-export", ("vehicle", "person", "container"), "timestep", "time", ("id",), ("timestep_", "vehicle_"),
         "timestep_time"),
    Kind("tripinfo", "tripinfos", ("tripinfo", "personinfo", "containerinfo"), "", None, ("id",), ("tripinfo_",), "tripinfo_id"),
    Kind("summary", "summary", ("step",), "", "time", (), ("step_",), "step_time"),
    Kind("statistics", "statistics", ("statistics",), "", None, (), (), "safety_collisions"),
    Kind("collisions", "collisions", ("collision",), "", "time", ("collider", "victim"), ("collision_",), "collision_time"),
    Kind("vehroute", "routes", ("vType", "vehicle", "person", "container"), "", None, ("id",), ("vehicle_",), "route_edges"),
)  # fmt: skip

#: Columns that are names even where they look like numbers.
NAMES = frozenset((
    "id", "lane", "edge", "type", "vType", "track", "train", "sender", "receiver", "collider", "victim", "route_edges", "devices",
    "departLane", "arrivalLane", "departEdge", "arrivalEdge", "colliderType", "victimType", "line", "fromTaz", "toTaz", "kind",
))  # fmt: skip


@dataclass(frozen=True)
class Log:
    """One table of rows in time. ``batches`` begins anew at every call."""

    name: str
    path: str
    time: str | None
    keys: tuple[str, ...]
    batches: Callable[[], Iterator[pa.Table]]
    version: str | None = None


class _Everything(set[str]):
    def __contains__(self, _: object) -> bool:
        return True


def sumo_log(path: Path) -> Log | None:
    """A log of SUMO's as a stream; None if it is none that is known, a Log without a name if it is empty."""
    form = kind_of(path)
    if form == "xml":
        of_root, version = _xml_kind(path)
        if of_root is None:
            return None
        known = of_root
        return Log(known.name, str(path), known.time, known.keys, lambda: _xml(path, known), version)
    names = _csv_names(path)[1] if form == "csv" else _parquet_names(path)
    if not names:
        return Log("", str(path), None, (), lambda: iter(()))
    found = next((k for k in KINDS if k.mark in names), None)
    if found is None:
        return None
    kind = found
    read = _csv if form == "csv" else _parquet
    return Log(kind.name, str(path), kind.time, kind.keys, lambda: _canonical(read(path), path, kind))


def our_table(run: Run, table: str) -> Log:
    """A table of a run folder as a stream."""
    keys = {"trains": ("train",), "units": ("train", "unit"), "links": ("sender", "receiver")}[table]

    def batches() -> Iterator[pa.Table]:
        for path in run.files(table):
            for batch in _parquet(path):
                for name in ("time_s", *keys):
                    if name not in batch.column_names:
                        raise InputError(f"{path}: has no column {name}")
                yield batch

    return Log(table, str(run.folder / f"{table}.parquet"), "time_s", keys, batches)


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


def _xml_kind(path: Path) -> tuple[Kind | None, str | None]:
    """Kind from the root element, version of SUMO from the header."""
    with opened(path) as stream:
        head = stream.read(1 << 18).decode("utf-8", "replace")
    version = re.search(r"by Eclipse SUMO[^\n\"<>]{0,40}? (v?[0-9][\w.+-]{0,60})", head)
    body = re.sub(r"<!--.*?-->|<\?.*?\?>", "", head, flags=re.DOTALL)
    root = re.search(r"<\s*([A-Za-z_!][\w.:-]*)", body)
    if root is None or root[1].startswith("!"):
        # Not XML, or with a document type: the strict reader says so.
        for _ in elements(path, "fcd-export", set()):
            pass
        raise InputError(f"{path}: not a log of SUMO")
    return next((k for k in KINDS if k.root == root[1]), None), version[1] if version else None


class _Columns:
    """Rows of texts gathered column by column; attributes come and go."""

    def __init__(self, path: Path) -> None:
        self.path, self.count = path, 0
        self.texts: dict[str, list[str | None]] = {}

    def put(self, name: str, value: str) -> None:
        """A value of the row begun last."""
        column = self.texts.get(name)
        if column is None:
            if len(self.texts) >= MOST_COLUMNS:
                raise InputError(f"{self.path}: more than {MOST_COLUMNS} different attributes: not a log of SUMO")
            column = self.texts[name] = []
        missing = self.count - 1 - len(column)
        if missing < 0:  # stands twice in this row: route, route, ...
            stem = re.sub(r"\d+$", "", name)
            number = int(name[len(stem) :] or 1) if stem != name else 1
            self.put(f"{stem}{number + 1}", value)
            return
        if missing:
            column.extend([None] * missing)
        column.append(value or None)

    def table(self) -> pa.Table:
        """What was gathered."""
        for column in self.texts.values():
            column.extend([None] * (self.count - len(column)))
        made = pa.table({name: pa.array(column, pa.string()) for name, column in self.texts.items()})
        self.texts, self.count = {}, 0
        return made


def _xml(path: Path, kind: Kind) -> Iterator[pa.Table]:
    rows, time, inside = _Columns(path), None, False
    for tag, attributes in elements(path, kind.root, _Everything()):
        if tag == kind.step:
            time, inside = attributes.get("time"), False
        elif tag in kind.rows:
            if rows.count >= BATCH_ROWS:
                yield rows.table()
            rows.count, inside = rows.count + 1, True
            if kind.step:
                if time is None:
                    raise InputError(f"{path}: a {tag} outside any {kind.step} with a time")
                rows.put("time", time)
            for name, value in attributes.items():
                if not name.startswith(("xmlns", "xsi:")) and not (kind.step and name == "time"):
                    rows.put(name, value)
        elif inside:
            for name, value in attributes.items():
                rows.put(f"{tag}_{name}", value)
    if rows.count:
        yield rows.table()


def _csv_names(path: Path) -> tuple[str, list[str]]:
    """Separator and column names."""
    with opened(path) as stream:
        head = stream.readline(1 << 18)
    try:
        line = head.decode("utf-8-sig").strip()
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a log of SUMO: not text") from None
    separator = next((s for s in ";,\t" if s in line), ";")
    names = [name.strip().strip('"') for name in line.split(separator)] if line else []
    if len(set(names)) < len(names) or len(names) > MOST_COLUMNS:
        raise InputError(f"{path}: a column stands more than once, or more than {MOST_COLUMNS} columns: not a log of SUMO")
    return separator, names


def _csv(path: Path) -> Iterator[pa.Table]:
    separator, names = _csv_names(path)
    with opened(path) as stream:
        try:
            reader = pc_csv.open_csv(
                pa.PythonFile(stream, mode="r"),
                read_options=pc_csv.ReadOptions(use_threads=False, block_size=ELEMENT_BYTES, skip_rows=1, column_names=names),
                parse_options=pc_csv.ParseOptions(delimiter=separator),
                convert_options=pc_csv.ConvertOptions(
                    column_types=dict.fromkeys(names, pa.string()), strings_can_be_null=True, null_values=[""]
                ),
            )
            for batch in reader:
                yield pa.Table.from_batches([batch])
        except StopIteration:
            return
        except pa.ArrowException as error:
            if "Empty CSV" in str(error):  # a header and nothing else
                return
            raise InputError(f"{path}: not a CSV log: {str(error).partition(chr(10))[0]:.200}") from None


def _parquet_names(path: Path) -> list[str]:
    try:
        with pq.ParquetFile(path) as file:
            return list(file.schema_arrow.names)
    except (pa.ArrowException, OSError, ValueError, TypeError) as error:
        raise InputError(f"{path}: not a complete Parquet file: {str(error).partition(chr(10))[0]:.200}") from None


def _parquet(path: Path) -> Iterator[pa.Table]:
    try:
        with pq.ParquetFile(path) as file:
            names = file.schema_arrow.names
            if len(set(names)) < len(names) or len(names) > MOST_COLUMNS:
                raise InputError(f"{path}: a column stands more than once, or more than {MOST_COLUMNS} columns")
            for batch in file.iter_batches(batch_size=BATCH_ROWS):
                yield pa.table({name: _simple(column) for name, column in zip(names, batch.columns, strict=True)})
    except (pa.ArrowException, OSError, ValueError, TypeError) as error:
        raise InputError(f"{path}: damaged Parquet file: {str(error).partition(chr(10))[0]:.200}") from None


def _simple(column: pa.Array) -> pa.Array:
    """Texts as strings, truth values as texts, numbers as they are."""
    if pa.types.is_dictionary(column.type):
        column = column.dictionary_decode()
    kind = column.type
    if pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_string(kind):
        return column
    return column.cast(pa.string())


def _canonical(batches: Iterator[pa.Table], path: Path, kind: Kind) -> Iterator[pa.Table]:
    """Names as in XML; without rows that stand for a step without vehicles; statistics as one row."""
    pieces = []
    for batch in batches:
        names = [_stripped(name, kind) for name in batch.column_names]
        if len(set(names)) < len(names):
            raise InputError(f"{path}: a column stands more than once: not a log of SUMO")
        batch = batch.rename_columns(names)
        for name in (*([kind.time] if kind.time else []), *kind.keys):
            if name not in names:
                raise InputError(f"{path}: not a log of SUMO's kind {kind.name}: has no column {name}")
        if kind.name == "fcd":
            batch = batch.filter(batch["id"].is_valid())
        if kind.name == "statistics":
            pieces.append(batch)
        elif batch.num_rows:
            yield batch
    if pieces:
        yield _one_row(pa.concat_tables(pieces))


def _one_row(whole: pa.Table) -> pa.Table:
    """The first value of every column."""
    first = {name: whole[name].drop_null().slice(0, 1).cast(pa.string()).to_pylist() for name in whole.column_names}
    return pa.table({name: pa.array(texts or [None], pa.string()) for name, texts in first.items()})


def _stripped(name: str, kind: Kind) -> str:
    prefix = next((p for p in kind.prefixes if name.startswith(p)), "")
    return name.removeprefix(prefix)
