"""What is remembered of differences while two logs stream by: figures of every train and column, and some rows as evidence.

Memory is bounded by trains times columns, and by ``EVIDENCE_BYTES`` for the rows.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa

from trainctl.diff.columns import Compared
from trainctl.signals import Bools, Floats, Ints

#: Rows of trains that differ are kept for a closer look: at most so many of one train, and bytes in all, of each log.
TRAIN_ROWS = 20_000
EVIDENCE_BYTES = 1 << 26

#: Figures of a column of numbers and what they begin with. ``rows``: rows since the first difference, differing or not; ``shift_*``
#: and ``scale_*``: the constants c and k for which b = a + c, b = k a in all of these within the precision of the last decimals.
FIGURES = {
    "count": 0.0, "rows": 0.0, "sum": 0.0, "sum_abs": 0.0, "size": 0.0,
    "first_s": np.inf, "first_a": np.nan, "first_b": np.nan, "first_gap": np.nan,
    "most_s": np.inf, "most_a": np.nan, "most_b": np.nan, "most_gap": -1.0, "low": np.nan, "high": np.nan,
    "shift_low": -np.inf, "shift_high": np.inf, "scale_low": -np.inf, "scale_high": np.inf,
}  # fmt: skip
#: Two computations of one number may differ by this share of it.
ROUNDING = 1e-9


@dataclass
class Tally:
    """Differences of one column, by number of the train."""

    figures: dict[str, Floats] = field(default_factory=lambda: {name: np.empty(0) for name in FIGURES})
    #: First pair of texts that differ, by number of the train; empty for numbers.
    texts: dict[int, tuple[str | None, str | None]] = field(default_factory=dict)
    numbers: bool = True

    def grow(self, size: int) -> None:
        """Make room for more trains."""
        more = size - len(self.figures["count"])
        if more > 0:
            room = max(more, len(self.figures["count"]))
            self.figures = {n: np.concatenate([old, np.full(room, FIGURES[n])]) for n, old in self.figures.items()}

    def trains(self) -> Ints:
        """Numbers of the trains that differ."""
        return np.flatnonzero(self.figures["count"])

    def add(self, train: Ints, time: Floats, found: Compared, cut: tuple[Floats, Floats] | None = None) -> None:
        """Enter compared rows, ascending in time; ``cut`` are the tube's ends."""
        with np.errstate(over="ignore", invalid="ignore"):  # a damaged log may hold any number
            self._add(train, time, found, cut)

    def _add(self, train: Ints, time: Floats, found: Compared, cut: tuple[Floats, Floats] | None) -> None:
        bad = found.bad
        if not bad.any() and not len(self.figures["count"]):
            return
        self.grow(int(train.max(initial=-1)) + 1)
        f = self.figures
        which = np.flatnonzero(bad)
        who, at = train[which], time[which]
        new, place = np.unique(who, return_index=True)
        fresh = f["first_s"][new] > at[place]
        new, place = new[fresh], which[place[fresh]]
        f["first_s"][new] = time[place]
        np.add.at(f["count"], who, 1.0)
        if found.a is None or found.b is None or found.difference is None or found.allowed is None:
            self.numbers = False
            return
        a, b, gap = found.a, found.b, found.difference
        f["first_a"][new], f["first_b"][new], f["first_gap"][new] = a[place], b[place], gap[place]
        order = np.lexsort((-time[which], gap[which], who))
        last = order[np.flatnonzero(np.append(np.diff(who[order]) != 0, len(order) > 0))] if len(order) else order
        worst, row = who[last], which[last]
        more = gap[row] > f["most_gap"][worst]
        worst, row = worst[more], row[more]
        f["most_s"][worst], f["most_a"][worst], f["most_b"][worst], f["most_gap"][worst] = time[row], a[row], b[row], gap[row]
        if cut is not None:
            f["low"][worst], f["high"][worst] = cut[0][row], cut[1][row]
        signed = np.nan_to_num((b - a)[which], posinf=0.0, neginf=0.0)
        np.add.at(f["sum"], who, signed)
        np.add.at(f["sum_abs"], who, np.abs(signed))
        self._constants(train, time, a, b, found.allowed, found.decimal)

    def _constants(self, train: Ints, time: Floats, a: Floats, b: Floats, allowed: Floats, decimal: float) -> None:
        """Narrow down by what constant a column is shifted or scaled."""
        f = self.figures
        since = np.flatnonzero(time >= f["first_s"][train])
        if not len(since):
            return
        who, a, b = train[since], a[since], b[since]
        np.add.at(f["rows"], who, 1.0)
        with np.errstate(all="ignore"):
            np.fmax.at(f["size"], who, np.abs(a))
            slack = np.maximum(np.maximum(allowed[since], decimal), ROUNDING * np.maximum(np.abs(a), np.abs(b)))
            gap = b - a
            gap = np.where(np.isfinite(gap), gap, np.where(np.isnan(a) & np.isnan(b), np.nan, np.inf))
            np.fmax.at(f["shift_low"], who, gap - slack)
            np.fmin.at(f["shift_high"], who, gap + slack)
            slack = slack * (1.0 + np.abs(b / a))
            ends = np.sort(np.stack([(b - slack) / a, (b + slack) / a]), axis=0)
            nought = np.abs(a) <= decimal
            impossible = (nought & (np.abs(b) > 100 * slack + decimal)) | ~np.isfinite(b)
            np.fmax.at(f["scale_low"], who, np.where(nought, np.where(impossible & nought, np.inf, -np.inf), ends[0]))
            np.fmin.at(f["scale_high"], who, np.where(nought, np.inf, ends[1]))


@dataclass
class Evidence:
    """Rows of the trains that differ, of one log."""

    tables: list[pa.Table] = field(default_factory=list)
    times: list[Floats] = field(default_factory=list)
    trains: list[Ints] = field(default_factory=list)
    kept: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    bytes: int = 0
    #: Whether some rows were not kept.
    cut: bool = False

    def add(self, table: pa.Table, time: Floats, train: Ints, wanted: Bools) -> None:
        """Keep the wanted rows as far as there is room."""
        rows = np.flatnonzero(wanted)
        if not len(rows):
            return
        size = int(train.max()) + 1
        if len(self.kept) < size:
            self.kept = np.concatenate([self.kept, np.zeros(2 * size - len(self.kept), np.int64)])
        room = self.kept[train[rows]] < TRAIN_ROWS
        if self.bytes >= EVIDENCE_BYTES or not room.all():
            self.cut = True
            rows = rows[room] if self.bytes < EVIDENCE_BYTES else rows[:0]
        if not len(rows):
            return
        np.add.at(self.kept, train[rows], 1)
        part = table.take(pa.array(rows))
        self.bytes += part.nbytes
        self.tables.append(part)
        self.times.append(time[rows])
        self.trains.append(train[rows])

    def rows(self) -> tuple[pa.Table, Floats, Ints]:
        """All that was kept, its times [s] and trains."""
        if not self.tables:
            return pa.table({}), np.zeros(0), np.zeros(0, np.int64)
        return pa.concat_tables(self.tables, promote_options="permissive"), np.concatenate(self.times), np.concatenate(self.trains)


#: Rows of a train: how many, the first and the last, and how many of them are doubles of another row.
PRESENCE = {"count": 0.0, "first_s": np.inf, "last_s": -np.inf, "doubled": 0.0}


@dataclass
class Presence:
    """Some rows of each train, by number of the train: all in one log, or those that only one log has."""

    figures: dict[str, Floats] = field(default_factory=lambda: {name: np.empty(0) for name in PRESENCE})

    def add(self, train: Ints, time: Floats, doubled: Bools | None = None) -> None:
        """Enter rows."""
        if not len(train):
            return
        more = int(train.max()) + 1 - len(self.figures["count"])
        if more > 0:
            room = max(more, len(self.figures["count"]))
            self.figures = {n: np.concatenate([old, np.full(room, PRESENCE[n])]) for n, old in self.figures.items()}
        np.add.at(self.figures["count"], train, 1.0)
        if doubled is not None:
            np.add.at(self.figures["doubled"], train, doubled.astype(float))
        np.minimum.at(self.figures["first_s"], train, time)
        np.maximum.at(self.figures["last_s"], train, time)

    def of(self, name: str, train: int) -> float:
        """A figure of one train."""
        return float(self.figures[name][train]) if train < len(self.figures[name]) else PRESENCE[name]

    def trains(self) -> Ints:
        """Numbers of the trains with such rows."""
        return np.flatnonzero(self.figures["count"])
