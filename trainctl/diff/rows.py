"""Comparing two streams of rows: matched by time and names, within tolerances, in memory that does not grow with the logs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa

from trainctl.diff.columns import Compared, differing, filled
from trainctl.diff.feed import Feed, repeats, windows
from trainctl.diff.in_time import InTime, Judged, Piece, Spans
from trainctl.diff.sources import Log
from trainctl.diff.tally import Evidence, Presence, Tally
from trainctl.diff.tolerance import CLOCKS, Tolerance, Tolerances
from trainctl.signals import Bools, Floats, Ints

#: Of so many trains the first texts that differ are kept.
NAMED_TEXTS = 1000
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
    #: Ends of the tube there, if the column has a tolerance in time.
    lower: float | None = None
    upper: float | None = None


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
    #: For a closer look: figures by column and train, rows by train that only one log has, the rows themselves.
    trains: list[str] = field(default_factory=list)
    tallies: dict[str, Tally] = field(default_factory=dict)
    all_a: Presence = field(default_factory=Presence)
    all_b: Presence = field(default_factory=Presence)
    only_a: Presence = field(default_factory=Presence)
    only_b: Presence = field(default_factory=Presence)
    rows_a: Evidence = field(default_factory=Evidence)
    rows_b: Evidence = field(default_factory=Evidence)
    keys: tuple[str, ...] = ()
    time: str | None = None

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
        self.keys = a.keys or b.keys
        self.out = TableDiff(a.name or b.name, keys=self.keys, time=a.time or b.time)
        self.timed = (a.time or b.time) is not None
        self.codes: dict[str, int] = {}
        self.pairs: dict[tuple[int, int], int] = {}
        self.seen_a: set[str] = set()
        self.seen_b: set[str] = set()
        self.filled: tuple[set[str], set[str]] = (set(), set())
        self.differ = np.zeros(0, np.bool_)  # trains, by code
        self.spans = Spans.of(a, tolerances)
        self.in_time: InTime | None = None
        if self.timed and tolerances.in_time(self.out.table):
            self.in_time = InTime(self.out.table, {*self.keys, a.time, b.time}, tolerances, self.spans, thinned)

    def run(self) -> TableDiff:
        feeds = Feed(self.a), Feed(self.b)
        for table_a, time_a, table_b, time_b in windows(*feeds):
            for known, table in zip(self.filled, (table_a, table_b), strict=True):
                known |= {n for n in table.column_names if n not in known and filled(table[n])}
            if self.tolerances.common:
                table_a, time_a = _shared(table_a, time_a, feeds[1])
                table_b, time_b = _shared(table_b, time_b, feeds[0])
            self.window(table_a, time_a, table_b, time_b)
        if self.in_time is not None:
            self.judge(self.in_time.rest())
        self.out.trains = list(self.codes)
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
        again = np.concatenate([repeats(out[:split]), repeats(out[split:])])
        if again.any():
            out = np.unique(out, return_inverse=True)[1] * (int(again.max()) + 1) + again
        return out[:split], out[split:]

    def curves(self, columns: list[Ints]) -> Ints:
        """One number per row for all its names."""
        out = columns[0]
        for level, column in enumerate(columns[1:]):
            packed, back = np.unique((out << 32) | column, return_inverse=True)
            out = np.array([self.pairs.setdefault((level, int(p)), len(self.pairs)) for p in packed], np.int64)[back]
        return out

    def window(self, ta: pa.Table, time_a: Ints, tb: pa.Table, time_b: Ints) -> None:
        """Match and compare the rows of some instants."""
        if self.thinned and self.in_time is None:
            wanted = np.isin(time_b, time_a)
            tb, time_b = tb.filter(pa.array(wanted)), time_b[wanted]
        times, split = np.concatenate([time_a, time_b]), len(time_a)
        for _ in range(2):
            columns = [np.full(len(times), self.code(""), np.int64)] if not self.keys else []
            for k, key in enumerate(self.keys):
                codes_a, texts_a = self.names(ta, key, False)
                codes_b, texts_b = self.names(tb, key, True)
                columns.append(np.concatenate([codes_a, codes_b]))
                if k == 0:
                    self.seen_a.update(texts_a)
                    self.seen_b.update(texts_b)
            packed_a, packed_b = self.matched(times, columns, split)
            if len(packed_a) == len(packed_b) and np.array_equal(packed_a, packed_b):
                rows_a = rows_b = np.arange(len(packed_a))
                only_a = only_b = np.zeros(0, np.int64)
                break
            _, rows_a, rows_b = np.intersect1d(packed_a, packed_b, return_indices=True)
            only_a = np.setdiff1d(np.arange(len(packed_a)), rows_a)
            only_b = np.setdiff1d(np.arange(len(packed_b)), rows_b)
            if self.in_time is not None or not self.found_renamed(ta, time_a, only_a, tb, time_b, only_b):
                break
        train_a, train_b = columns[0][:split], columns[0][split:]
        self.out.all_a.add(train_a, time_a / 1e6)
        self.out.all_b.add(train_b, time_b / 1e6)
        if self.in_time is not None:
            curves = self.curves(columns)
            piece_a, piece_b = Piece(ta, time_a, train_a, curves[:split]), Piece(tb, time_b, train_b, curves[split:])
            self.judge(self.in_time.add(piece_a, piece_b, int(times.max(initial=0))))
        else:
            if len(only_a) or len(only_b):
                curves = self.curves(columns)
                self.unmatched(self.out.missing, self.out.only_a, Piece(ta, time_a, train_a, curves[:split]), only_a)
                self.unmatched(self.out.extra, self.out.only_b, Piece(tb, time_b, train_b, curves[split:]), only_b)
            if len(rows_a):
                order = np.argsort(rows_a, kind="stable")
                self.values(ta, time_a, train_a, tb, rows_a[order], rows_b[order])
        for evidence, table, time, train in ((self.out.rows_a, ta, time_a, train_a), (self.out.rows_b, tb, time_b, train_b)):
            if self.differ.any():
                self.marked(train[:0], len(self.codes))
                evidence.add(table, time / 1e6, train, self.differ[train])

    def marked(self, train: Ints, size: int = 0) -> None:
        """Note trains that differ: their rows are kept from here on."""
        more = max(int(train.max(initial=-1)) + 1, size) - len(self.differ)
        if more > 0:
            self.differ = np.concatenate([self.differ, np.zeros(max(more, len(self.differ)), np.bool_)])
        self.differ[train] = True

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
            found = differing(column, a[column], b[column], tolerance, self.spans.of_column(column))
            numbers += found.difference is not None
            if found.bad.any() and str(a[column][0].as_py()).replace(name_a, name_b) != str(b[column][0].as_py()):
                return False
        return numbers > 0

    def unmatched(self, rows: Rows, presence: Presence, piece: Piece, which: Ints) -> None:
        if not len(which):
            return
        if not rows.count:
            row = int(which[0])
            rows.first_time_s, rows.first_who = self.at(piece.time, row), self.who(piece.table, row)
        rows.count += len(which)
        self.marked(piece.train[which])
        presence.add(piece.train[which], piece.time[which] / 1e6, piece.again()[which] > 0)

    def at(self, times: Ints, row: int) -> float | None:
        return float(times[row] / 1e6) if self.timed else None

    def who(self, table: pa.Table, row: int) -> str:
        """The names of a row in words."""
        names = {key: table[key][row].as_py() for key in self.keys if key in table.column_names}
        return ", ".join(f"{key} {value}" for key, value in names.items() if value is not None)

    def values(self, ta: pa.Table, times: Ints, train: Ints, tb: pa.Table, rows_a: Ints, rows_b: Ints) -> None:
        """Compare matched rows column by column."""
        self.out.rows += len(rows_a)
        if not np.array_equal(rows_a, np.arange(ta.num_rows)):
            ta, times, train = ta.take(pa.array(rows_a)), times[rows_a], train[rows_a]
        if not np.array_equal(rows_b, np.arange(tb.num_rows)):
            tb = tb.take(pa.array(rows_b))
        for column, tolerance in self.wanted(ta, tb):
            found = differing(column, ta[column], tb[column], tolerance, self.spans.of_column(column))
            if self.renamed and found.bad.any():
                found = found._replace(bad=self.but_names(found.bad, ta[column], tb[column]))
            self.enter(column, tolerance, found, times, train, ta, ta[column], tb[column])

    def wanted(self, ta: pa.Table, tb: pa.Table) -> Iterator[tuple[str, Tolerance]]:
        """Columns that are compared, and how."""
        skipped = {*self.keys, self.a.time, self.b.time}
        for column in [name for name in ta.column_names if name in tb.column_names and name not in skipped]:
            tolerance = self.tolerances.of(self.out.table, column)
            if column not in CLOCKS.get(self.out.table, ()):
                self.out.compared.add(column)
            if not tolerance.ignore:
                yield column, tolerance

    def enter(
        self, column: str, tolerance: Tolerance, found: Compared, times: Ints, train: Ints, rows: pa.Table,
        a: pa.ChunkedArray | None, b: pa.ChunkedArray, cut: tuple[Floats, Floats] | None = None,
    ) -> None:  # fmt: skip
        """Remember what differs in one column of some rows; ``a`` is None if the reference has no rows of its own there."""
        bad, difference = found.bad, found.difference
        tally = self.out.tallies.get(column)
        if not bad.any():
            if tally is not None:
                tally.add(train, times / 1e6, found)
            return
        tally = self.out.tallies.setdefault(column, Tally())
        tally.add(train, times / 1e6, found, cut)
        self.marked(np.unique(train[bad]))
        entry = self.out.columns.setdefault(column, ColumnDiff(column, tolerance))
        entry.differing += int(np.count_nonzero(bad))

        def place(row: int) -> Place:
            gap = None if difference is None else float(difference[row])
            if a is not None:
                left = _number(a[row].as_py(), gap)
            else:
                left = None if found.a is None else float(found.a[row])
            right = _number(b[row].as_py(), gap) if a is not None or found.b is None else float(found.b[row])
            lower, upper = (None, None) if cut is None else (float(cut[0][row]), float(cut[1][row]))
            return Place(self.at(times, row), self.who(rows, row), left, right, gap, lower, upper)

        first = int(np.argmax(bad))
        if entry.first is None or (entry.first.time_s is not None and entry.first.time_s > times[first] / 1e6):
            entry.first = place(first)
        if difference is None:
            for who, row in zip(*np.unique(train[bad], return_index=True), strict=True):
                if int(who) not in tally.texts and len(tally.texts) < NAMED_TEXTS:
                    at = int(np.flatnonzero(bad)[row])
                    tally.texts[int(who)] = (None if a is None else a[at].as_py(), b[at].as_py())
        if difference is not None:
            worst = int(np.argmax(np.where(bad, difference, -1.0)))
            if entry.largest is None or not entry.largest.difference or difference[worst] > entry.largest.difference:
                entry.largest = place(worst)

    def judge(self, judged: Judged) -> None:
        """Enter what was judged by tubes."""
        sides = ((self.out.missing, self.out.only_a, judged.missing), (self.out.extra, self.out.only_b, judged.extra))
        for rows, presence, parts in sides:
            for part, doubled in parts:
                if not rows.count:
                    rows.first_time_s, rows.first_who = self.at(part.time, 0), self.who(part.table, 0)
                rows.count += len(part.time)
                self.marked(part.train)
                presence.add(part.train, part.time / 1e6, doubled)
        self.out.rows += judged.rows
        for v in judged.values:
            if v.column not in CLOCKS.get(self.out.table, ()):
                self.out.compared.add(v.column)
            piece = v.piece
            b = v.piece.table[v.column] if v.b is None else v.b
            self.enter(v.column, v.tolerance, v.found, piece.time, piece.train, piece.table, v.a, b, v.cut)

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


def _shared(table: pa.Table, time: Ints, other: Feed) -> tuple[pa.Table, Ints]:
    """Rows within the time that the other log covers."""
    if other.first is None or other.last is None:
        return table.slice(0, 0), time[:0]
    begin = int(np.searchsorted(time, other.first))
    end = int(np.searchsorted(time, other.last, side="right")) if other.ended else len(time)
    return table.slice(begin, max(0, end - begin)), time[begin : max(begin, end)]


def _number(value: Any, difference: float | None) -> Any:
    if difference is None or value is None:
        return value
    return None if value == "" else float(value)
