"""Logs as tables from the start: CSV and Parquet, by SUMO, by its tools or by pandas, with the columns that the XML has."""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterator
from functools import reduce
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pc_csv
import pyarrow.parquet as pq

from trainctl.errors import InputError
from trainctl.runs.kinds import Kind
from trainctl.runs.sumo_logs import ELEMENT_BYTES, UTF16, opened
from trainctl.runs.xml_rows import BATCH_ROWS, BLOCK, MOST_COLUMNS, filled

#: Columns that pandas adds: the numbers of its rows.
INDEX = re.compile(r"__index_level_\d+__|Unnamed: 0|")
#: Kinds of which CSV and Parquet have a row for every element inside a row.
INNER = frozenset(("tripinfo", "vehroute", "ssm"))


def csv_names(path: Path) -> tuple[str, list[str]]:
    """Separator and column names; no names if the file is empty."""
    head = next(_lines(path), b"").partition(b"\n")[0]
    try:
        line = head.decode().strip("\r\n")
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a log of SUMO: not text") from None
    separator = next((s for s in ";,\t| " if s in line), ";")
    names = [name.strip().strip('"') for name in line.split(separator)] if line.strip() else []
    _check(path, names)
    if any(_number(name) for name in names):
        raise InputError(f"{path}: line 1 = {line[:60]}: a CSV log begins with the names of its columns, these are values")
    return separator, names


def _number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _check(path: Path, names: list[str]) -> None:
    if len(names) > MOST_COLUMNS:
        raise InputError(f"{path}: more than {MOST_COLUMNS} columns: not a log of SUMO")


def _lines(path: Path) -> Iterator[bytes]:
    """A text in pieces of whole lines, in UTF-8, without a byte order mark."""
    with opened(path) as stream:
        rest, decoder, begun = b"", None, False
        while chunk := stream.read(BLOCK):
            if not begun:
                begun, chunk = True, chunk.removeprefix(codecs.BOM_UTF8)
                decoder = codecs.getincrementaldecoder("utf-16")() if chunk.startswith(UTF16) else None
            if decoder is not None:
                chunk = _utf8(path, decoder, chunk)
            rest += chunk
            cut = rest.rfind(b"\n") + 1
            if cut:
                yield rest[:cut]
                rest = rest[cut:]
            elif len(rest) > ELEMENT_BYTES:
                raise InputError(f"{path}: not a log of SUMO: a line longer than {ELEMENT_BYTES >> 20} MiB")
        if decoder is not None:
            rest += _utf8(path, decoder, b"", last=True)
        if rest:
            yield rest


def _utf8(path: Path, decoder: codecs.IncrementalDecoder, chunk: bytes, last: bool = False) -> bytes:
    try:
        return decoder.decode(chunk, last).encode()
    except UnicodeError:
        raise InputError(f"{path}: not a log of SUMO: not text") from None


def csv_rows(path: Path) -> Iterator[pa.Table]:
    """A CSV file piece by piece, as texts; columns are called 0, 1, ..."""
    separator, names = csv_names(path)
    columns = [f"{k}" for k in range(len(names))]
    header = True
    for piece in _lines(path):
        if header:
            piece, header = piece.partition(b"\n")[2], False
        if not piece.strip():
            continue
        try:
            # From memory and in this thread: a reader that is still at work when the interpreter ends kills the process.
            yield pc_csv.read_csv(
                pa.py_buffer(piece),
                read_options=pc_csv.ReadOptions(use_threads=False, block_size=len(piece) + 1, column_names=columns),
                parse_options=pc_csv.ParseOptions(delimiter=separator),
                convert_options=pc_csv.ConvertOptions(
                    column_types=dict.fromkeys(columns, pa.string()), strings_can_be_null=True, null_values=[""]
                ),
            )
        except pa.ArrowException as error:
            raise InputError(f"{path}: not a CSV log: {str(error).partition(chr(10))[0]:.200}") from None


def parquet_names(path: Path) -> list[str]:
    """Column names of a Parquet file."""
    try:
        with pq.ParquetFile(path) as file:
            names = list(file.schema_arrow.names)
    except (pa.ArrowException, OSError, ValueError, TypeError) as error:
        raise InputError(f"{path}: not a complete Parquet file: {str(error).partition(chr(10))[0]:.200}") from None
    _check(path, names)
    return names


def parquet_rows(path: Path) -> Iterator[pa.Table]:
    """A Parquet file piece by piece; columns are called 0, 1, ..."""
    try:
        with pq.ParquetFile(path) as file:
            for batch in file.iter_batches(batch_size=BATCH_ROWS, use_threads=False):
                yield pa.table({f"{k}": simple(column) for k, column in enumerate(batch.columns)})
    except (pa.ArrowException, OSError, ValueError, TypeError) as error:
        raise InputError(f"{path}: damaged Parquet file: {str(error).partition(chr(10))[0]:.200}") from None


def simple(column: pa.Array) -> pa.Array:
    """Texts as strings, truth values as texts, numbers as they are, spans of time in seconds."""
    if pa.types.is_dictionary(column.type):
        column = column.dictionary_decode()
    kind = column.type
    if pa.types.is_floating(kind) or pa.types.is_integer(kind):
        return column
    if pa.types.is_duration(kind):
        return pc.divide(column.cast(pa.duration("us"), safe=False).cast(pa.int64()).cast(pa.float64()), 1e6)
    if pa.types.is_decimal(kind):
        return column.cast(pa.float64())
    return filled(column if pa.types.is_string(kind) else column.cast(pa.string()))


def is_index(name: str) -> bool:
    """Whether a column is the numbers of rows that pandas writes."""
    return INDEX.fullmatch(name) is not None


def named(batches: Iterator[pa.Table], names: list[str], kind: Kind) -> Iterator[pa.Table]:
    """Rows of a kind, one per element.

    Parameters
    ----------
    batches : iterator of Table
        Columns called 0, 1, ...
    names : list of str
        What each of them is called here; "" for one that is not of the log. Of two of one name, one holds something.
    kind : Kind
        What the rows are.
    """
    pieces = (_renamed(batch, names) for batch in batches)
    if kind.name == "statistics":
        yield from _one_row(pieces)
    elif kind.name in INNER and any("_" in name for name in names):
        yield from _joined(pieces, [name for name in dict.fromkeys(names) if name and "_" not in name])
    else:
        for piece in pieces:
            if kind.step or kind.keys:
                piece = piece.filter(piece[kind.keys[-1]].is_valid())  # a step without vehicles is a row without one
            if piece.num_rows:
                yield piece


def _renamed(batch: pa.Table, names: list[str]) -> pa.Table:
    columns: dict[str, list[Any]] = {}
    for place, name in enumerate(names):
        if name:
            columns.setdefault(name, []).append(batch[f"{place}"])
    return pa.table({name: reduce(_either, several) for name, several in columns.items()})


def _either(a: pa.ChunkedArray, b: pa.ChunkedArray) -> pa.ChunkedArray:
    return pc.coalesce(a, b) if a.type == b.type else pc.coalesce(a.cast(pa.string()), b.cast(pa.string()))


def _one_row(pieces: Iterator[pa.Table]) -> Iterator[pa.Table]:
    """The first value of every column."""
    first: dict[str, pa.Array] = {}
    for piece in pieces:
        for name in piece.column_names:
            if name not in first or not first[name].is_valid()[0].as_py():
                values = piece[name].drop_null().slice(0, 1).cast(pa.string()).to_pylist()
                first[name] = pa.array(values or [None], pa.string())
    if first:
        yield pa.table(first)


def _joined(pieces: Iterator[pa.Table], own: list[str]) -> Iterator[pa.Table]:
    """Rows that repeat a row for every element in it as one row each."""
    held: pa.Table | None = None  # the last row may go on in the next piece
    for piece in pieces:
        if held is not None:
            piece = pa.concat_tables([held, piece], promote_options="permissive")
        name = piece[own[0]]
        if pc.any(pc.equal(name.slice(1), name.slice(0, max(len(name) - 1, 0)))).as_py() or name.null_count:
            piece = _one_each(piece, own)
        if len(piece) > 1:
            yield piece.slice(0, len(piece) - 1)
        held = piece.slice(max(len(piece) - 1, 0))
    if held is not None:
        yield held


def _one_each(piece: pa.Table, own: list[str]) -> pa.Table:
    rows: list[dict[str, Any]] = []
    last = None
    for row in piece.to_pylist():
        mine = [row[name] for name in own]
        if rows and mine == last and row != rows[-1]:
            _join(rows[-1], row, own)
        else:
            rows.append(row)
        last = mine
    names = dict.fromkeys(name for row in rows for name in row)
    types = {name: piece.schema.field(name).type for name in piece.column_names}
    kinds = {name: next(types[name[:k]] for k in range(len(name), 0, -1) if name[:k] in types) for name in names}  # pos, pos2
    return pa.table({name: pa.array([row.get(name) for row in rows], kinds[name]) for name in names})


def _join(row: dict[str, Any], more: dict[str, Any], own: list[str]) -> None:
    """Add what stands in another row of the same element; what is there already gets a number."""
    for name, value in more.items():
        if name in own or value is None:
            continue
        free, number = name, 1
        while row.get(free) is not None:
            number += 1
            free = f"{name}{number}"
        row[free] = value
