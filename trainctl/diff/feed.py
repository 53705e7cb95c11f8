"""Two streams of rows read in step, so that each instant of both is at hand at once and memory does not grow with the logs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pyarrow as pa

from trainctl.diff.columns import floats
from trainctl.diff.sources import Log
from trainctl.errors import InputError
from trainctl.signals import Ints

#: Rows of one instant, or of a log without times, may not need more than this [bytes].
INSTANT_BYTES = 1 << 27
#: Times beyond this [s] are none.
MAXIMUM_S = 1e12


class Feed:
    """A stream of rows in ascending time, taken in pieces up to a time."""

    def __init__(self, log: Log) -> None:
        self.log, self.batches = log, log.batches()
        self.table: pa.Table | None = None
        self.time: Ints = np.zeros(0, np.int64)  # us
        self.ended = False
        self.first: int | None = None  # us
        self.last: int | None = None

    def more(self) -> None:
        """One batch more."""
        batch = next(self.batches, None)
        if batch is None:
            self.ended = True
            return
        if not batch.num_rows:
            return
        time = self._times(batch)
        steps = time if self.last is None else np.append(self.last, time)
        back = np.flatnonzero(np.diff(steps) < 0)
        if len(back):
            before, after = steps[back[0]] / 1e6, steps[back[0] + 1] / 1e6
            raise InputError(f"{self.log.path}: time does not ascend: {after:.10g} s after {before:.10g} s")
        self.first, self.last = int(time[0]) if self.first is None else self.first, int(time[-1])
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
        time = floats(batch[self.log.time])
        if time is None or not np.all(np.abs(time) < MAXIMUM_S):
            one_by_one = ((value, floats(pa.chunked_array([[value]]))) for value in batch[self.log.time].to_pylist())
            wrong = next(value for value, number in one_by_one if number is None or not abs(number[0]) < MAXIMUM_S)
            raise InputError(
                f"{self.log.path}: {self.log.time} = {'nothing' if wrong is None else wrong!s:.40}: must be a time in seconds"
            )
        return np.round(time * 1e6).astype(np.int64)

    def take(self, limit: int | None) -> tuple[pa.Table, Ints]:
        """Remove and return the rows before a time; None: all."""
        count = len(self.time) if limit is None else int(np.searchsorted(self.time, limit))
        table = self.table if self.table is not None else pa.table({})
        part, times = table.slice(0, count), self.time[:count]
        self.table, self.time = table.slice(count), self.time[count:]
        return part, times


def windows(a: Feed, b: Feed) -> Iterator[tuple[pa.Table, Ints, pa.Table, Ints]]:
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


def repeats(keys: Ints) -> Ints:
    """How many rows with the same key stand before each row."""
    order = np.argsort(keys, kind="stable")
    same = np.zeros(len(keys), np.bool_)
    same[1:] = keys[order][1:] == keys[order][:-1]
    out = np.zeros(len(keys), np.int64)
    if same.any():
        start = np.where(same, 0, np.arange(len(keys)))
        out[order] = np.arange(len(keys)) - np.maximum.accumulate(start)
    return out
