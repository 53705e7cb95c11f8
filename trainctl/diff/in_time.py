"""Comparing two streams with tolerances in time: rows need not stand at the same instants, values must lie in the reference's tube.

A row waits until the reference is known as far as it can matter: to the next sample of its train beyond the tolerance in time, or,
of a train that has no more rows, for ``GAP_S``. So memory is that of the rows within the tolerances, however long the logs are.

Of a reference that holds only some instants the tube would say nothing of what lies between; there its samples are judged by the
tube round the other log, which is the same question: whether the two come as near to each other as the tolerances say.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from trainctl.diff.columns import Compared, floats, resolution, widened
from trainctl.diff.sources import NAMES, Log
from trainctl.diff.tolerance import CLOCKS, Tolerance, Tolerances
from trainctl.diff.tube import GAP_S, half_widths, judged, met, number_between
from trainctl.signals import Bools, Floats, Ints


@dataclass
class Spans:
    """Range of every column of the reference, and its duration; known only if a tolerance asks for them."""

    columns: dict[str, tuple[float, float]] = field(default_factory=dict)
    time: tuple[float, float] | None = None

    @classmethod
    def of(cls, log: Log, tolerances: Tolerances) -> Spans:
        """Read the reference once, if need be."""
        spans = cls()
        for batch in log.batches() if tolerances.of_range else ():
            for name in batch.column_names:
                values = floats(batch[name]) if name not in NAMES else None
                known = values[np.isfinite(values)] if values is not None else np.empty(0)
                if len(known):
                    low, high = spans.columns.get(name, (np.inf, -np.inf))
                    spans.columns[name] = (min(low, float(known.min())), max(high, float(known.max())))
        spans.time = spans.columns.get(log.time or "")
        return spans

    def of_column(self, name: str) -> float:
        """Range of a column, 0 if it is not known."""
        low, high = self.columns.get(name, (0.0, 0.0))
        return high - low

    @property
    def duration_s(self) -> float:
        """Duration of the reference [s], 0 if it is not known."""
        return 0.0 if self.time is None else self.time[1] - self.time[0]


class Piece(NamedTuple):
    """Rows, their times [us], the numbers of their trains, and of their curves: train, unit; sender, receiver."""

    table: pa.Table
    time: Ints
    train: Ints
    curve: Ints

    def take(self, rows: Ints | Bools) -> Piece:
        """Some of the rows."""
        picked = np.flatnonzero(rows) if rows.dtype == np.bool_ else rows
        return Piece(self.table.take(pa.array(picked)), self.time[picked], self.train[picked], self.curve[picked])

    def again(self) -> Ints:
        """How many rows of the same curve and time stand before each row."""
        order = np.lexsort((self.time, self.curve))
        curve, time, count = self.curve[order], self.time[order], np.arange(len(order))
        same = np.zeros(len(order), np.bool_)
        same[1:] = (curve[1:] == curve[:-1]) & (time[1:] == time[:-1])
        out = np.zeros(len(order), np.int64)
        if same.any():
            out[order] = count - np.maximum.accumulate(np.where(same, 0, count))
        return out

    def and_(self, other: Piece) -> Piece:
        """Rows of both, in order of curve and time."""
        if not len(self.time):
            both = other
        elif not len(other.time):
            both = self
        else:
            table = pa.concat_tables([self.table, other.table], promote_options="permissive")
            both = Piece(table, *(np.concatenate(pair) for pair in zip(self[1:], other[1:], strict=True)))
        order = np.lexsort((both.time, both.curve))
        return both if np.array_equal(order, np.arange(len(order))) else both.take(order)


EMPTY = Piece(pa.table({}), *(np.zeros(0, np.int64) for _ in range(3)))


class Values(NamedTuple):
    """One column of rows that were judged."""

    column: str
    tolerance: Tolerance
    found: Compared
    piece: Piece
    cut: tuple[Floats, Floats] | None
    #: Texts of both logs: those that the reference holds at the time.
    a: pa.ChunkedArray | None = None
    b: pa.ChunkedArray | None = None


@dataclass
class Judged:
    """What has been decided: rows compared, their values, rows only one log has, and which of these are doubles."""

    rows: int = 0
    values: list[Values] = field(default_factory=list)
    missing: list[tuple[Piece, Bools]] = field(default_factory=list)
    extra: list[tuple[Piece, Bools]] = field(default_factory=list)


class InTime:
    """Rows of two logs that wait to be judged."""

    def __init__(self, table: str, keys: Set[str | None], tolerances: Tolerances, spans: Spans, swapped: bool) -> None:
        self.table, self.keys, self.tolerances, self.spans, self.swapped = table, keys, tolerances, spans, swapped
        whole = [] if tolerances.everywhere is None else [tolerances.everywhere]
        every = [tolerances.time, *tolerances.columns.values(), *whole]
        self.constant = max(max(t.time_s, t.time_range * spans.duration_s) for t in every)
        self.share = max(t.time_relative for t in every)
        # the reference (with the tube), what is judged; rows of either that wait
        self.reference, self.other = EMPTY, EMPTY
        self.open_reference, self.open_other = np.zeros(0, np.bool_), np.zeros(0, np.bool_)

    def width(self, tolerance: Tolerance, time: Floats) -> Floats:
        """Tolerance in time at given times [s]."""
        return half_widths(tolerance.time_s, tolerance.time_relative, tolerance.time_range, time, self.spans.duration_s)

    def reach(self, time: Floats) -> Floats:
        """Latest sample whose rectangle can reach a time [s]."""
        return np.maximum(time + self.constant, time / (1.0 - self.share))

    def add(self, a: Piece, b: Piece, known_us: int) -> Judged:
        """Take rows of both logs, which hold all rows up to a time [us]; what can be judged now."""
        one, two = (b, a) if self.swapped else (a, b)
        self.reference, self.open_reference = _joined(self.reference, self.open_reference, one)
        self.other, self.open_other = _joined(self.other, self.open_other, two)
        known = known_us / 1e6
        result = self._judge(self._decided(known), self._settled(known))
        self._forget(known)
        return result

    def rest(self) -> Judged:
        """The end of both logs: judge what still waits."""
        return self._judge(self.open_other, self.open_reference)

    def _starts(self, piece: Piece) -> tuple[Ints, Ints]:
        curves = max(int(self.reference.curve.max(initial=-1)), int(self.other.curve.max(initial=-1))) + 1
        count = np.bincount(piece.curve, minlength=curves).astype(np.int64)
        return np.concatenate([[0], np.cumsum(count)[:-1]]).astype(np.int64), count

    def _decided(self, known: float) -> Bools:
        """Rows whose tube no later sample can change."""
        first, count = self._starts(self.reference)
        time, at, curve = self.reference.time / 1e6, self.other.time / 1e6, self.other.curve
        reach = self.reach(at)
        before = number_between(first, count, time, curve, np.full(len(at), -np.inf), reach)
        later = before < count[curve]
        last = np.full(len(at), -np.inf)
        some = before > 0
        last[some] = time[(first[curve] + before - 1)[some]]
        waits = np.where(last + GAP_S > at, np.maximum(reach, last + GAP_S), reach)
        return self.open_other & (later | (known > waits))

    def _settled(self, known: float) -> Bools:
        """Rows of the reference for which all rows of the other log within the tolerance of rows are known."""
        time = self.reference.time / 1e6
        return self.open_reference & (time + self.width(self.tolerances.time, time) < known)

    def _judge(self, rows: Bools, own: Bools) -> Judged:
        out = Judged()
        one, two = self._starts(self.reference), self._starts(self.other)
        time, at = self.reference.time / 1e6, self.other.time / 1e6
        lonely = np.zeros(len(time), np.bool_)
        w = self.width(self.tolerances.time, time[own])
        lonely[own] = number_between(*two, at, self.reference.curve[own], time[own] - w, time[own] + w) == 0
        doubles = self._doubles(self.reference, two, at) & own
        piece = self.other.take(rows)
        when = at[rows]
        w = self.width(self.tolerances.time, when)
        met_by = number_between(*one, time, piece.curve, when - w, when + w)
        again = self._doubles(self.other, one, time)[rows]
        alone = (met_by == 0) | again
        gone, new = (out.extra, out.missing) if self.swapped else (out.missing, out.extra)
        if not self.swapped and (lonely | doubles).any():
            gone.append((self.reference.take(lonely | doubles), doubles[lonely | doubles]))
        if alone.any():
            new.append((piece.take(alone), again[alone]))
        self.open_reference &= ~own
        self.open_other &= ~rows
        piece, when = piece.take(~alone), when[~alone]
        out.rows = len(when)
        if len(when):
            out.values = list(self._values(one, time, piece, when))
        return out

    def _doubles(self, piece: Piece, other: tuple[Ints, Ints], time: Floats) -> Bools:
        """Rows that stand more often than in the other log."""
        number = piece.again()
        at = piece.time / 1e6
        return (number > 0) & (number >= number_between(*other, time, piece.curve, at, at))

    def _values(self, one: tuple[Ints, Ints], time: Floats, piece: Piece, when: Floats) -> list[Values]:
        out = []
        for name in [n for n in piece.table.column_names if n in self.reference.table.column_names and n not in self.keys]:
            tolerance = self.tolerances.of(self.table, name)
            if tolerance.ignore or name in CLOCKS.get(self.table, ()):
                continue
            w = self.width(tolerance, time)
            ours, theirs = self.reference.table[name], piece.table[name]
            y = value = None
            if name not in NAMES:
                y, value = floats(ours), floats(theirs)
            if y is None or value is None:
                both = pa.chunked_array([c.cast(pa.string()) for c in (*ours.chunks, *theirs.chunks)], pa.string()).combine_chunks()
                code = both.fill_null("").dictionary_encode().indices.to_numpy(zero_copy_only=False).astype(np.int64)
                good = met(*one, time, code[: len(time)], w, piece.curve, when, code[len(time) :])
                before = number_between(*one, time, piece.curve, np.full(len(when), -np.inf), when)
                held = ours.take(pa.array(one[0][piece.curve] + np.maximum(before - 1, 0)))
                pair = (theirs, held) if self.swapped else (held, theirs)
                out.append(Values(name, tolerance, Compared(~good), piece, None, *pair))
                continue
            wide = widened(tolerance, ours, theirs)
            h = half_widths(wide.absolute, wide.relative, wide.range, y, self.spans.of_column(name))
            good, spare = np.zeros(len(when), np.bool_), np.empty((3, len(when)))
            judged(*one, time, y, w, h, piece.curve, when, value, GAP_S, good, spare[0], spare[1], spare[2])
            with np.errstate(over="ignore", invalid="ignore"):
                gap = np.where(good, 0.0, np.abs(value - spare[0]))
            gap = np.where(np.isfinite(gap), gap, np.inf)
            near_by, b = (value, spare[0]) if self.swapped else (spare[0], value)
            allowed = half_widths(wide.absolute, wide.relative, wide.range, np.nan_to_num(spare[0]), self.spans.of_column(name))
            found = Compared(~good, near_by, b, gap, allowed, max(resolution(ours), resolution(theirs)))
            out.append(Values(name, tolerance, found, piece, (spare[1], spare[2])))
        return out

    def _forget(self, known: float) -> None:
        """Drop rows that no row, waiting or to come, can need: of each curve all but the last before what it waits for."""
        curves = max(int(self.reference.curve.max(initial=-1)), int(self.other.curve.max(initial=-1))) + 1
        kept = self._needed(self.reference, self.open_reference, self.other, self.open_other, known, curves)
        also = self._needed(self.other, self.open_other, self.reference, self.open_reference, known, curves)
        self.reference, self.open_reference = self.reference.take(kept), self.open_reference[kept]
        self.other, self.open_other = self.other.take(also), self.open_other[also]

    def _needed(self, piece: Piece, waiting: Bools, other: Piece, open_: Bools, known: float, curves: int) -> Bools:
        needed = np.full(curves, known)
        np.minimum.at(needed, other.curve[open_], other.time[open_] / 1e6)
        begin = np.minimum(needed - self.constant, needed / (1.0 + self.share))[piece.curve]
        time = piece.time / 1e6
        last = np.append((piece.curve[1:] != piece.curve[:-1]) | (time[1:] >= begin[1:]), True)[: len(time)]
        kept: Bools = waiting | (time >= begin) | (last & (time >= begin - GAP_S))
        return kept


def _joined(piece: Piece, waiting: Bools, more: Piece) -> tuple[Piece, Bools]:
    """Rows that were there, with their marks, and new ones, which all wait."""
    if not len(more.time):
        return piece, waiting
    marks = np.concatenate([waiting, np.ones(len(more.time), np.bool_)])
    order = np.lexsort((np.concatenate([piece.time, more.time]), np.concatenate([piece.curve, more.curve])))
    return piece.and_(more), marks[order]
