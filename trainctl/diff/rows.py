"""Comparing two streams of rows: matched by time and names, within tolerances, in memory that does not grow with the logs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from trainctl.diff.sources import NAMES, Log
from trainctl.diff.tolerance import CLOCKS, Tolerance, Tolerances
from trainctl.errors import InputError
from trainctl.signals import Bools, Floats, Ints

#: Rows of one instant, or of a log without times, may not need more than this [bytes].
INSTANT_BYTES = 1 << 27
#: So many new names of one instant are tried for being an old one's.
CANDIDATES = 100


@dataclass
class Place:
    """One value that differs."""

    time_s: float | None
    who: str
    a: float | str | None
    b: float | str | None
    difference: float | None  # None for texts


@dataclass
class ColumnDiff:
    """All differences of one column."""

    column: str
    tolerance: Tolerance
    differing: int = 0
    first: Place | None = None
    largest: Place | None = None


@dataclass
class Rows:
    """Rows that one log has and the other has not."""

    count: int = 0
    first_time_s: float | None = None
    first_who: str = ""


@dataclass
class TableDiff:
    """What differs between two logs of one kind."""

    table: str
    rows: int = 0  # compared
    missing: Rows = field(default_factory=Rows)  # only in A
    extra: Rows = field(default_factory=Rows)  # only in B
    columns: dict[str, ColumnDiff] = field(default_factory=dict)  # those that differ
    lost_columns: list[str] = field(default_factory=list)  # only in A
    new_columns: list[str] = field(default_factory=list)  # only in B
    compared: set[str] = field(default_factory=set)

    @property
    def same(self) -> bool:
        """Whether nothing differs (a new column is not a difference)."""
        return not (self.missing.count or self.extra.count or self.columns or self.lost_columns)

    @property
    def first(self) -> tuple[float, str, ColumnDiff | None] | None:
        """Time (infinite in a log without times), description and column of the first difference."""
        found: list[tuple[float, str, ColumnDiff | None]] = []
        for c in self.columns.values():
            if c.first is not None:
                found.append((math.inf if c.first.time_s is None else c.first.time_s, c.first.who, c))
        for rows, words in ((self.missing, "row only in A"), (self.extra, "row only in B")):
            if rows.count:
                time = math.inf if rows.first_time_s is None else rows.first_time_s
                found.append((time, f"{rows.first_who}: {words}".removeprefix(": "), None))
        return min(found, key=lambda item: item[0], default=None)


class _Feed:
    """A stream of rows in ascending time, taken in pieces up to a time."""

    def __init__(self, log: Log) -> None:
        self.log, self.batches = log, log.batches()
        self.table: pa.Table | None = None
        self.time: Ints = np.zeros(0, np.int64)  # us
        self.ended = False

    def more(self) -> None:
        """One batch more."""
        batch = next(self.batches, None)
        if batch is None:
            self.ended = True
            return
        if not batch.num_rows:
            return
        time = self._times(batch)
        last = self.time[-1:] if len(self.time) else time[:1]
        if np.any(np.diff(np.concatenate([last, time])) < 0):
            raise InputError(f"{self.log.path}: time does not ascend near {time[0] / 1e6:g} s")
        rest = None if self.table is None or not self.table.num_rows else self.table
        try:
            self.table = batch if rest is None else pa.concat_tables([rest, batch], promote_options="permissive")
        except pa.ArrowException as error:
            raise InputError(f"{self.log.path}: its parts do not fit together: {str(error).partition(chr(10))[0]:.200}") from None
        self.time = np.concatenate([self.time, time])
        if self.time[0] == self.time[-1] and self.table.nbytes > INSTANT_BYTES:
            what = "one instant" if self.log.time else "a log without times"
            raise InputError(f"{self.log.path}: more than {INSTANT_BYTES >> 20} MiB of rows of {what}")

    def _times(self, batch: pa.Table) -> Ints:
        if self.log.time is None:
            return np.zeros(batch.num_rows, np.int64)
        if self.log.time not in batch.column_names:
            raise InputError(f"{self.log.path}: has rows without {self.log.time}")
        time = _floats(batch[self.log.time])
        if time is None or not np.all(np.abs(time) < 1e12):
            raise InputError(f"{self.log.path}: a time is missing or not a finite number")
        return np.round(time * 1e6).astype(np.int64)

    def take(self, limit: int | None) -> tuple[pa.Table, Ints]:
        """Remove and return the rows before a time; None: all."""
        count = len(self.time) if limit is None else int(np.searchsorted(self.time, limit))
        table = self.table if self.table is not None else pa.table({})
        part, times = table.slice(0, count), self.time[:count]
        self.table, self.time = table.slice(count), self.time[count:]
        return part, times


def _windows(a: _Feed, b: _Feed) -> Iterator[tuple[pa.Table, Ints, pa.Table, Ints]]:
    """Pieces of both streams that hold the same instants, each instant whole."""
    while True:
        for feed in (a, b):
            while not feed.ended and not len(feed.time):
                feed.more()
        if a.ended and b.ended and not len(a.time) and not len(b.time):
            return
        open_ends = [int(feed.time[-1]) for feed in (a, b) if not feed.ended]
        limit = min(open_ends) if open_ends else None
        if limit is not None and all(not len(f.time) or f.time[0] >= limit for f in (a, b)):
            for feed in (a, b):
                if not feed.ended and feed.time[-1] == limit:
                    feed.more()
            continue
        (table_a, time_a), (table_b, time_b) = a.take(limit), b.take(limit)
        yield table_a, time_a, table_b, time_b


def compare(a: Log, b: Log, tolerances: Tolerances, renamed: dict[str, str], thinned: bool = False) -> TableDiff:
    """Differences of two logs of one kind.

    Parameters
    ----------
    a, b : Log
        The reference and the other one.
    tolerances : Tolerances
        How far values may lie apart.
    renamed : dict
        Names of trains in B -> in A, as far as they are known; those found here are entered.
    thinned : bool
        Whether A holds only some instants: rows of B between them are not extra.
    """
    return _Comparison(a, b, tolerances, renamed, thinned).run()


class _Comparison:
    def __init__(self, a: Log, b: Log, tolerances: Tolerances, renamed: dict[str, str], thinned: bool) -> None:
        self.a, self.b, self.tolerances, self.renamed, self.thinned = a, b, tolerances, renamed, thinned
        self.out = TableDiff(a.name or b.name)
        self.keys = a.keys or b.keys
        self.timed = (a.time or b.time) is not None
        self.codes: dict[str, int] = {}
        self.seen_a: set[str] = set()
        self.seen_b: set[str] = set()
        self.filled: tuple[set[str], set[str]] = (set(), set())

    def run(self) -> TableDiff:
        for table_a, time_a, table_b, time_b in _windows(_Feed(self.a), _Feed(self.b)):
            for filled, table in zip(self.filled, (table_a, table_b), strict=True):
                filled |= {n for n in table.column_names if n not in filled and _filled(table[n])}
            self.window(table_a, time_a, table_b, time_b)
        skipped = {self.a.time, self.b.time, *self.keys}
        in_a, in_b = ({n for n in filled if n not in skipped} for filled in self.filled)
        if self.out.rows:  # without rows nothing is known about columns
            ignored = {n for n in in_a ^ in_b if self.tolerances.of(self.out.table, n).ignore}
            self.out.lost_columns = sorted(in_a - in_b - ignored - self.out.columns.keys())
            self.out.new_columns = sorted(in_b - in_a - ignored - self.out.columns.keys())
        return self.out

    def names(self, table: pa.Table, key: str, other: bool) -> tuple[Ints, list[str]]:
        """A key column as codes that both logs share, and the different names in it."""
        if key not in table.column_names:
            return np.full(table.num_rows, self.code(""), np.int64), [""]
        column = table[key].combine_chunks() if isinstance(table[key], pa.ChunkedArray) else table[key]
        packed = column.cast(pa.string()).fill_null("").dictionary_encode()
        texts = packed.dictionary.to_pylist()
        if other:
            texts = [self.renamed.get(text, text) for text in texts]
        codes = np.array([self.code(text) for text in texts] or [0], np.int64)
        return codes[packed.indices.to_numpy(zero_copy_only=False)], texts

    def code(self, text: str) -> int:
        return self.codes.setdefault(text, len(self.codes))

    def matched(self, times: Ints, columns: list[Ints], split: int) -> tuple[Ints, Ints]:
        """One number per row of A (the first ``split`` rows) and B for its time and names; a second such row gets another one."""
        out = np.unique(times, return_inverse=True)[1].astype(np.int64)
        for column in columns:
            if int(out.max(initial=0)) >= (1 << 62) // (len(self.codes) + 1):
                out = np.unique(out, return_inverse=True)[1].astype(np.int64)
            out = out * (len(self.codes) + 1) + column
        repeats = np.concatenate([_repeats(out[:split]), _repeats(out[split:])])
        if repeats.any():
            out = np.unique(out, return_inverse=True)[1] * (int(repeats.max()) + 1) + repeats
        return out[:split], out[split:]

    def window(self, ta: pa.Table, time_a: Ints, tb: pa.Table, time_b: Ints) -> None:
        """Match and compare the rows of some instants."""
        if self.thinned:
            wanted = np.isin(time_b, time_a)
            tb, time_b = tb.filter(pa.array(wanted)), time_b[wanted]
        times = np.concatenate([time_a, time_b])
        for _ in range(2):
            columns = []
            for k, key in enumerate(self.keys):
                codes_a, texts_a = self.names(ta, key, False)
                codes_b, texts_b = self.names(tb, key, True)
                columns.append(np.concatenate([codes_a, codes_b]))
                if k == 0:
                    self.seen_a.update(texts_a)
                    self.seen_b.update(texts_b)
            packed_a, packed_b = self.matched(times, columns, len(time_a))
            if len(packed_a) == len(packed_b) and np.array_equal(packed_a, packed_b):
                rows_a = rows_b = np.arange(len(packed_a))
                only_a = only_b = np.zeros(0, np.int64)
                break
            _, rows_a, rows_b = np.intersect1d(packed_a, packed_b, return_indices=True)
            only_a = np.setdiff1d(np.arange(len(packed_a)), rows_a)
            only_b = np.setdiff1d(np.arange(len(packed_b)), rows_b)
            if not self.found_renamed(ta, time_a, only_a, tb, time_b, only_b):
                break
        self.unmatched(self.out.missing, ta, time_a, only_a)
        self.unmatched(self.out.extra, tb, time_b, only_b)
        if not len(rows_a):
            return
        self.out.rows += len(rows_a)
        order = np.argsort(rows_a, kind="stable")
        rows_a, rows_b = rows_a[order], rows_b[order]
        if not np.array_equal(rows_a, np.arange(ta.num_rows)):
            ta, time_a = ta.take(pa.array(rows_a)), time_a[rows_a]
        if not np.array_equal(rows_b, np.arange(tb.num_rows)):
            tb = tb.take(pa.array(rows_b))
        self.values(ta, time_a, tb)

    def found_renamed(self, ta: pa.Table, time_a: Ints, only_a: Ints, tb: pa.Table, time_b: Ints, only_b: Ints) -> bool:
        """Names of B that stand for others of A: new in B, with a row that is otherwise that of a train missing in B."""
        if len(self.keys) != 1 or not len(only_a) or not len(only_b):
            return False
        key = self.keys[0]
        names_a, names_b = (t[key].cast(pa.string()).to_pylist() if key in t.column_names else [] for t in (ta, tb))
        if not names_a or not names_b:
            return False

        def first_rows(rows: Ints, names: list[str | None], others: set[str]) -> dict[str, int]:
            found: dict[str, int] = {}
            for row in rows:
                name = names[row]
                if name is not None and name not in others and name not in found:
                    found[name] = int(row)
                if len(found) >= CANDIDATES:
                    break
            return found

        news = first_rows(only_b, names_b, self.seen_a)
        gone = first_rows(only_a, names_a, self.seen_b)
        done = False
        for name_b, row_b in news.items():
            for name_a, row_a in list(gone.items()):
                if time_a[row_a] == time_b[row_b] and self.same_row(ta.slice(row_a, 1), tb.slice(row_b, 1), name_a, name_b):
                    self.renamed[name_b] = name_a
                    self.seen_b.discard(name_b)
                    del gone[name_a]
                    done = True
                    break
        return done

    def same_row(self, a: pa.Table, b: pa.Table, name_a: str, name_b: str) -> bool:
        numbers = 0
        for column in set(a.column_names) & set(b.column_names) - {*self.keys, self.a.time, self.b.time}:
            tolerance = self.tolerances.of(self.out.table, column)
            if tolerance.ignore:
                continue
            bad, difference = _differing(column, a[column], b[column], tolerance)
            numbers += difference is not None
            if bad.any() and str(a[column][0].as_py()).replace(name_a, name_b) != str(b[column][0].as_py()):
                return False
        return numbers > 0

    def unmatched(self, rows: Rows, table: pa.Table, times: Ints, which: Ints) -> None:
        if not len(which):
            return
        if not rows.count:
            row = int(which[0])
            rows.first_time_s, rows.first_who = self.at(times, row), self.who(table, row)
        rows.count += len(which)

    def at(self, times: Ints, row: int) -> float | None:
        return float(times[row] / 1e6) if self.timed else None

    def who(self, table: pa.Table, row: int) -> str:
        """The names of a row in words."""
        names = {key: table[key][row].as_py() for key in self.keys if key in table.column_names}
        return ", ".join(f"{key} {value}" for key, value in names.items() if value is not None)

    def values(self, ta: pa.Table, times: Ints, tb: pa.Table) -> None:
        """Compare matched rows column by column."""
        skipped = {*self.keys, self.a.time, self.b.time}
        for column in [name for name in ta.column_names if name in tb.column_names and name not in skipped]:
            tolerance = self.tolerances.of(self.out.table, column)
            if column not in CLOCKS.get(self.out.table, ()):
                self.out.compared.add(column)
            if tolerance.ignore:
                continue
            bad, difference = _differing(column, ta[column], tb[column], tolerance)
            if self.renamed and bad.any():
                bad = self.but_names(bad, ta[column], tb[column])
            if not bad.any():
                continue
            entry = self.out.columns.setdefault(column, ColumnDiff(column, tolerance))
            entry.differing += int(np.count_nonzero(bad))

            def place(row: int, column: str = column, difference: Floats | None = difference) -> Place:
                a, b = ta[column][row].as_py(), tb[column][row].as_py()
                gap = None if difference is None else float(difference[row])
                return Place(self.at(times, row), self.who(ta, row), _number(a, gap), _number(b, gap), gap)

            entry.first = entry.first or place(int(np.argmax(bad)))
            if difference is not None:
                worst = int(np.argmax(np.where(bad, difference, -1.0)))
                if entry.largest is None or not entry.largest.difference or difference[worst] > entry.largest.difference:
                    entry.largest = place(worst)

    def but_names(self, bad: Bools, a: pa.ChunkedArray, b: pa.ChunkedArray) -> Bools:
        """Texts that differ in the name of a renamed train alone do not differ."""
        if not all(pa.types.is_string(column.type) for column in (a, b)):
            return bad
        out = bad.copy()
        for row in np.flatnonzero(bad):
            text = b[int(row)].as_py() or ""
            for new, old in self.renamed.items():
                text = text.replace(new, old)
            out[row] = text != (a[int(row)].as_py() or "")
        return out


def _repeats(keys: Ints) -> Ints:
    """How many rows with the same key stand before each row."""
    order = np.argsort(keys, kind="stable")
    same = np.zeros(len(keys), np.bool_)
    same[1:] = keys[order][1:] == keys[order][:-1]
    out = np.zeros(len(keys), np.int64)
    if same.any():
        start = np.where(same, 0, np.arange(len(keys)))
        out[order] = np.arange(len(keys)) - np.maximum.accumulate(start)
    return out


def _number(value: Any, difference: float | None) -> Any:
    if difference is None or value is None:
        return value
    return None if value == "" else float(value)


def _floats(column: pa.ChunkedArray) -> Floats | None:
    """A column as numbers, NaN where nothing stands; None if it holds other texts."""
    if pa.types.is_null(column.type):
        return np.full(len(column), np.nan)
    try:
        numbers = column.cast(pa.float64(), safe=False)
    except pa.ArrowException:
        if not pa.types.is_string(column.type) or not pc.any(pc.equal(column, "")).as_py():
            return None
        return _floats(pa.chunked_array([pa.array([text or None for text in column.to_pylist()], pa.string())]))
    out: Floats = numbers.to_numpy().astype(np.float64, copy=False)
    return out


def _filled(column: pa.ChunkedArray) -> bool:
    """Whether anything stands in a column; SUMO writes an empty text where it has nothing to say."""
    if pa.types.is_string(column.type):
        return bool(pc.any(pc.not_equal(column, "")).as_py())
    return bool(column.null_count < len(column))


def _resolution(column: pa.ChunkedArray) -> float:
    """What the last decimal of a column of texts stands for; 0 if it is unknown."""
    if not pa.types.is_string(column.type):
        return 0.0
    for text in column.slice(0, 64).to_pylist():
        _, dot, decimals = (text or "").partition(".")
        if dot and decimals.isdigit():
            return float(10.0 ** -len(decimals))
    return 0.0


def _differing(name: str, a: pa.ChunkedArray, b: pa.ChunkedArray, tolerance: Tolerance) -> tuple[Bools, Floats | None]:
    """Rows that differ by more than the tolerance, and by how much (None for texts)."""
    numbers_a = numbers_b = None
    if name not in NAMES:
        numbers_a, numbers_b = _floats(a), _floats(b)
    if numbers_a is None or numbers_b is None:
        texts_a, texts_b = (pc.fill_null(column.cast(pa.string()), "") for column in (a, b))
        equal: Bools = pc.equal(texts_a, texts_b).to_numpy()
        bad = ~equal
        if name not in NAMES:
            for row in np.flatnonzero(bad):
                bad[row] = not alike(texts_a[int(row)].as_py(), texts_b[int(row)].as_py(), tolerance)
        return bad, None
    absolute, relative = tolerance.absolute, tolerance.relative
    if not tolerance.stated:
        absolute = max(absolute, 1.01 * _resolution(a), 1.01 * _resolution(b))
        if any(pa.types.is_float32(column.type) for column in (a, b)):
            relative = max(relative, 2.5e-7)
    with np.errstate(invalid="ignore", over="ignore"):
        difference = np.abs(numbers_a - numbers_b)
        allowed = np.maximum(absolute, relative * np.maximum(np.abs(numbers_a), np.abs(numbers_b)))
        same = (numbers_a == numbers_b) | (np.isnan(numbers_a) & np.isnan(numbers_b))
        close = np.isfinite(difference) & (difference <= allowed)
    difference = np.where(same, 0.0, np.where(np.isfinite(difference), difference, np.inf))
    return ~(same | close), difference


def alike(a: str, b: str, tolerance: Tolerance) -> bool:
    """Whether two texts differ by no more than the numbers in them, each within the tolerance."""
    if len(a) > 1 << 20 or len(b) > 1 << 20:
        return False
    words_a, words_b = a.replace(",", " ").split(), b.replace(",", " ").split()
    if len(words_a) != len(words_b):
        return False
    return all(x == y or _close(x, y, tolerance) for x, y in zip(words_a, words_b, strict=True))


def _close(a: str, b: str, tolerance: Tolerance) -> bool:
    try:
        x, y = float(a.strip("[]()\"'{}")), float(b.strip("[]()\"'{}"))
    except ValueError:
        return False
    if not (math.isfinite(x) and math.isfinite(y)) or "_" in a or "_" in b:
        return False
    absolute = tolerance.absolute
    if not tolerance.stated:
        decimals = min((len(text.partition(".")[2]) for text in (a, b) if "." in text), default=0)
        absolute = max(absolute, 1.01 * 10.0**-decimals if decimals else 0.0)
    return abs(x - y) <= max(absolute, tolerance.relative * max(abs(x), abs(y)))
