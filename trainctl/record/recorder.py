"""Streaming writer of a run folder: column arrays in, Parquet files of fixed-size row groups out, bounded memory.

In short::

    info = about_run(scenario_text, seed, sys.argv)
    partial = open_partial(out)                                     # DIR.partial, or InputError
    write_info(partial, info)
    with Recorder(partial, standard_tables(trains, tracks, edges)) as recorder:
        recorder.write("trains", time_s=t, train=codes, position_m=x, ...)   # every step
        recorder.event(t, "topology", links=[[1, 3], [3, 4]])
    write_info(partial, {**info, "status": "complete", "steps": n, "wall_time_s": w})
    finish(out)                                              # DIR.partial -> DIR

Until ``close`` the rows lie in closed segments (``segments/trains-00000.parquet``), because a Parquet file that was not closed
cannot be read: a run that is killed, or whose disk is full, keeps all but its last segment. ``recorder.cut()`` begins a new one
at any time (say every ten seconds of wall time); the final files do not depend on where the segments were cut. What ``cut``
returns has a check sum of everything written until then: a recording that is resumed verifies it first.
"""

from __future__ import annotations

import errno
import json
import os
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import ArrayLike, NDArray

from trainctl.record import columns
from trainctl.record.folder import SCHEMA_VERSION, plain, remove
from trainctl.record.sums import Sum, sum_of, verify
from trainctl.signals import POWERS

#: A column: a number, or one of a fixed list of names (written as integer codes into that list; -1 is "none").
Column = Literal["float", "int", "bool"] | Sequence[str]
Columns = Mapping[str, Column]

EVENTS = "events.jsonl"
GROUP_ROWS = 65_536
SEGMENT_GROUPS = 16

#: Optional columns of trains.parquet: energies [J] since the train's last row, one per entry of ``signals.POWERS``.
ENERGIES = tuple(f"{power}_j" for power in POWERS)

_DTYPES = {"float": np.float64, "int": np.int32, "bool": np.bool_}


def standard_tables(
    trains: Sequence[str],
    tracks: Sequence[str],
    edges: Sequence[str],
    *,
    units: bool = True,
    stops: Sequence[str] = (),
    watched: Sequence[str] = (),
    train_extras: Sequence[str] = (),
    unit_extras: Sequence[str] = (),
) -> dict[str, Columns]:
    """The tables of a run folder: trains, links and, if wanted, units.

    Parameters
    ----------
    trains, tracks, edges : sequence of str
        The names that the codes in ``train`` (``sender``, ``receiver``), ``track`` and ``edge`` stand for.
    units : bool
        Whether there is a units table.
    stops : sequence of str
        Names of the places at which trains stop; none: no stops table.
    watched : sequence of str
        The law's ``WATCHED``: each gives two columns of trains, ``<watched>_min`` and ``<watched>_max``.
    train_extras, unit_extras : sequence of str
        Further columns of numbers: ``ENERGIES``, disturbances; the plant's ``COLUMNS``.
    """
    tables: dict[str, Columns] = {
        "trains": {
            "time_s": "float", "train": trains, "track": tracks, "edge": edges,
            **_floats(columns.TRAINS), "saturated": "bool",
            **_floats(f"{name}_{end}" for name in watched for end in ("min", "max")),
            **_floats(train_extras),
        },
        "links": {
            "time_s": "float", "sender": trains, "receiver": trains,
            **_floats(columns.LINKS), "heard": "bool",
        },
    }  # fmt: skip
    if stops:
        tables["stops"] = {
            "train": trains, "stop": stops, "platform": edges, "number": "int",
            **_floats(name for name in columns.STOPS if name != "number"),
        }  # fmt: skip
    if units:
        tables["units"] = {"time_s": "float", "train": trains, "unit": "int", **_floats((*columns.UNITS, *unit_extras))}
    return tables


def _floats(names: Iterable[str]) -> dict[str, Column]:
    return dict.fromkeys(names, "float")


class Recorder:
    """Writes the tables and the events of one run into a folder.

    Parameters
    ----------
    folder : Path
        An existing directory (``DIR.partial``).
    tables : mapping
        Columns of each table, see ``standard_tables``.
    metadata : mapping, optional
        Text that goes into every Parquet footer beside ``schema_version``. No clocks: the files must not differ between
        two runs of the same scenario.
    resume : mapping, optional
        What ``cut`` returned: everything recorded later is dropped and the recording goes on from there.

    Raises
    ------
    InputError
        What is to be resumed is damaged or cut short.
    """

    def __init__(
        self,
        folder: Path,
        tables: Mapping[str, Columns],
        metadata: Mapping[str, str] | None = None,
        *,
        resume: Mapping[str, Any] | None = None,
        group_rows: int = GROUP_ROWS,
        segment_groups: int = SEGMENT_GROUPS,
    ) -> None:
        self.folder = folder
        self._segments = folder / "segments"
        kept = dict(resume["segments"]) if resume else {}
        self._said: Sum = list(resume["events"]) if resume else [0, 0]
        if resume:
            verify(folder / EVENTS, self._said, beginning=True)
            for name in tables:
                _verified(self._segments, name, kept.get(name, []))
        self._segments.mkdir(exist_ok=True)
        self._tables = {
            name: _Segments(self._segments, name, columns, dict(metadata or {}), group_rows, segment_groups, kept.get(name, []))
            for name, columns in tables.items()
        }
        # unbuffered: a line that did not fit on the disk must not come back when the file is closed
        self._events = open(folder / EVENTS, "r+b" if resume else "wb", buffering=0)  # noqa: SIM115  closed by close()
        if resume:
            self._events.truncate(self._said[0])
            self._events.seek(0, os.SEEK_END)

    def write(self, table: str, **values: ArrayLike) -> None:
        """Append rows: one array per column, all of one length; a scalar stands for all rows. Names come as integer codes."""
        self._tables[table].append(values)

    def event(self, time_s: float, kind: str, **fields: Any) -> None:
        """Append a line to events.jsonl, at once."""
        line = json.dumps(plain({"time_s": time_s, "kind": kind, **fields}), separators=(",", ":")).encode() + b"\n"
        if self._events.write(line) < len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.folder / EVENTS))
        self._said = [self._said[0] + len(line), zlib.crc32(line, self._said[1])]

    def cut(self, synced: bool = False) -> dict[str, Any]:
        """Close the segments, so that all rows until now survive a kill; ``synced``: also a power failure.

        Returns
        -------
        dict
            What ``resume`` needs, plain JSON: length and check sum of every segment, and of the events.
        """
        for table in self._tables.values():
            table.cut()
        if synced:
            for table in self._tables.values():
                table.sync()
            sync(self._segments)
            os.fsync(self._events.fileno())
        return {"segments": {name: t.sums() for name, t in self._tables.items()}, "events": list(self._said)}

    def leave(self) -> None:
        """End without joining the segments: all rows until now are readable, and ``cut`` of before can be resumed."""
        if self._events.closed:
            return
        self._events.close()
        self._cut_all()

    def _cut_all(self) -> None:
        """Close the segments of all tables, also of those behind one whose segment did not fit on the disk."""
        failed = None
        for table in self._tables.values():
            try:
                table.cut()
            except OSError as error:
                failed = failed or error
        if failed is not None:
            raise failed

    def join(self) -> None:
        """Write ``<table>.parquet`` from the segments, which stay. If the disk is full they are what can be read.

        May be done again after a kill, by a recorder that resumes the last ``cut``.
        """
        if self._events.closed:
            return
        self._events.close()
        self._cut_all()
        for name, table in self._tables.items():
            table.join(self.folder / f"{name}.parquet")

    def close(self) -> None:
        """Write ``<table>.parquet`` from the segments and remove them."""
        if not self._events.closed:
            self.join()
            remove(self._segments)

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close, whatever happened; a disk full while closing does not hide an earlier error."""
        try:
            self.close()
        except OSError:
            if error is None:
                raise


def sync(folder: Path) -> None:
    """Have the names in a folder written to the disk."""
    at = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(at)
    finally:
        os.close(at)


def _segment(folder: Path, name: str, number: int) -> Path:
    return folder / f"{name}-{number:05d}.parquet"


def _verified(folder: Path, name: str, sums: Sequence[Sum]) -> None:
    """Whether the segments of a table are what they were. A single one may have become the table already."""
    whole = folder.parent / f"{name}.parquet"
    for number, expected in enumerate(sums):
        path = _segment(folder, name, number)
        verify(whole if len(sums) == 1 and not os.path.lexists(path) and whole.exists() else path, expected)


# ``pa.array`` imports pandas, which takes longer than all else that pyarrow does in a short run: these do without.


def _array(values: NDArray[Any], known: NDArray[np.bool_] | None = None) -> pa.Array:
    """The same as an array of pyarrow's; values that are not ``known`` are missing."""
    validity = None if known is None or known.all() else pa.py_buffer(np.packbits(known, bitorder="little"))
    data = np.packbits(values, bitorder="little") if values.dtype == np.bool_ else values
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [validity, pa.py_buffer(data)])


def _texts(names: Sequence[str]) -> pa.Array:
    """An array of texts."""
    encoded = [name.encode() for name in names]
    ends = np.cumsum([0, *map(len, encoded)], dtype=np.int32)
    return pa.StringArray.from_buffers(len(encoded), pa.py_buffer(ends), pa.py_buffer(b"".join(encoded)))


class _Segments:
    """One table as a row of closed files ``<name>-<number>.parquet``; the one being written ends in ``.open``."""

    def __init__(
        self,
        folder: Path,
        name: str,
        columns: Columns,
        metadata: dict[str, str],
        group_rows: int,
        segment_groups: int,
        kept: list[Sum],
    ) -> None:
        self.folder, self.name, self.columns, self.count = folder, name, columns, len(kept)
        self.known, self.synced = list(kept), len(kept)  # check sums of the first segments; how many are on the disk
        self.metadata = {"table": name, **metadata}
        self.group_rows, self.segment_rows = group_rows, group_rows * segment_groups
        self.stream: _Stream | None = None
        counted = {self.path(number) for number in range(self.count)}
        for path in folder.glob(f"{name}-*"):
            if path not in counted:
                remove(path)

    def path(self, number: int) -> Path:
        return _segment(self.folder, self.name, number)

    def open_path(self) -> Path:
        return self.path(self.count).with_suffix(".open")

    def append(self, values: Mapping[str, ArrayLike]) -> None:
        try:
            if self.stream is None:
                self.stream = _Stream(self.open_path(), self.columns, self.metadata, self.group_rows)
            self.stream.append(values)
        except OSError:
            self.drop()
            raise
        if self.stream.rows >= self.segment_rows:
            self.cut()

    def cut(self) -> None:
        if self.stream is None:
            return
        try:
            self.stream.close()
        except OSError:
            self.drop()
            raise
        self.stream = None
        os.replace(self.open_path(), self.path(self.count))
        self.count += 1

    def sums(self) -> list[Sum]:
        self.known += [sum_of(self.path(number)) for number in range(len(self.known), self.count)]
        return list(self.known)

    def sync(self) -> None:
        for number in range(self.synced, self.count):
            with self.path(number).open("rb") as file:
                os.fsync(file.fileno())
        self.synced = self.count

    def drop(self) -> None:
        """Give up the segment being written: without its end it cannot be read, and its room on the disk is needed."""
        self.stream = None
        remove(self.open_path())

    def join(self, target: Path) -> None:
        """One file of full row groups out of all segments, the same bytes wherever they were cut."""
        if self.count == 1:  # its groups are full already
            if self.path(0).exists():  # else it was moved before a kill
                os.replace(self.path(0), target)
            return
        unfinished = target.with_suffix(".open")
        try:
            stream = _Stream(unfinished, self.columns, self.metadata, self.group_rows)
            rest = stream.schema.empty_table()
            for number in range(self.count):
                with pq.ParquetFile(self.path(number)) as file:
                    for group in range(file.num_row_groups):
                        rest = stream.full_groups(pa.concat_tables([rest, file.read_row_group(group)]))
            if rest.num_rows:
                stream.writer.write_table(rest.combine_chunks())
            stream.close()
        except OSError:
            remove(unfinished)
            raise
        os.replace(unfinished, target)


class _Stream:
    """One Parquet file of row groups of ``group_rows`` rows, the last one shorter."""

    def __init__(self, path: Path, columns: Columns, metadata: Mapping[str, str], group_rows: int) -> None:
        self.path, self.columns, self.group_rows = path, columns, group_rows
        self.rows = self.filled = 0
        self.buffers: dict[str, NDArray[Any]] = {
            name: np.empty(group_rows, dtype=_DTYPES[column] if isinstance(column, str) else np.int32)
            for name, column in columns.items()
        }
        self.names = {name: _texts(column) for name, column in columns.items() if not isinstance(column, str)}
        self.schema = pa.schema(
            [pa.field(name, pa.dictionary(pa.int32(), pa.string())) if name in self.names
             else pa.field(name, pa.from_numpy_dtype(buffer.dtype), nullable=False)  # a missing number is NaN; a third faster
             for name, buffer in self.buffers.items()],
            metadata={"schema_version": str(SCHEMA_VERSION), **metadata},
        )  # fmt: skip
        floats = [name for name, column in columns.items() if column == "float"]
        self.writer = pq.ParquetWriter(
            path,
            self.schema,
            compression="zstd",
            use_dictionary=[name for name in columns if name not in floats],
            column_encoding=dict.fromkeys(floats, "BYTE_STREAM_SPLIT"),
            write_statistics=floats,  # minimum and maximum of names took a third of the writing
        )

    def append(self, values: Mapping[str, ArrayLike]) -> None:
        if values.keys() != self.columns.keys():
            raise ValueError(f"{self.path.name}: columns {sorted(values.keys() ^ self.columns.keys())} missing or unknown")
        arrays = {name: np.asarray(value) for name, value in values.items()}
        lengths = {len(array) for array in arrays.values() if array.ndim}
        if len(lengths) > 1:
            raise ValueError(f"{self.path.name}: columns of different lengths {sorted(lengths)}")
        count, done = lengths.pop() if lengths else 1, 0
        while done < count:
            fits = min(count - done, self.group_rows - self.filled)
            for name, array in arrays.items():
                self.buffers[name][self.filled : self.filled + fits] = array[done : done + fits] if array.ndim else array
            self.filled, done = self.filled + fits, done + fits
            if self.filled == self.group_rows:
                self.flush()
        self.rows += count

    def full_groups(self, table: pa.Table) -> pa.Table:
        """Write the full row groups of a table, as it is; returns the rows that are left."""
        full = table.num_rows - table.num_rows % self.group_rows
        for begin in range(0, full, self.group_rows):
            self.writer.write_table(table.slice(begin, self.group_rows).combine_chunks())
        return table.slice(full)

    def flush(self) -> None:
        """Write what is buffered as one row group."""
        if self.filled:
            table = pa.Table.from_arrays(list(self.arrays()), schema=self.schema)
            self.writer.write_table(table, row_group_size=self.group_rows)
        self.filled = 0

    def arrays(self) -> Iterable[pa.Array]:
        for name, buffer in self.buffers.items():
            part = buffer[: self.filled]
            if name in self.names:
                yield pa.DictionaryArray.from_arrays(_array(part, part >= 0), self.names[name])
            else:
                yield _array(part)

    def close(self) -> None:
        self.flush()
        self.writer.close()
