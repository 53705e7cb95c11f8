"""Rows of a log as one time series per train, unit or link: sorted arrays and where each series begins."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from trainctl.signals import Bools, Floats, Ints

#: Two times of one log are the same instant below this [s]; SUMO counts milliseconds.
INSTANT = 1e-6


class Names(NamedTuple):
    """A column of names, by numbers."""

    codes: Ints  # (rows,) -1: missing
    names: list[str]

    def each(self) -> NDArray[np.object_]:
        """The name in each row, "nan" where it is missing."""
        return np.array([*self.names, "nan"], dtype=object)[self.codes]

    def taken(self) -> list[str]:
        """The names that some row has, in their order."""
        return [self.names[code] for code in np.unique(self.codes).tolist() if code >= 0]


@dataclass(frozen=True)
class Series:
    """A table sorted by series, then time. Series ``k`` is the rows ``first[k]:first[k + 1]``."""

    names: list[str]
    first: Ints  # (len(names) + 1,)
    numbers: Mapping[str, NDArray[Any]]  # columns (rows,)
    words: Mapping[str, Names] = field(default_factory=dict)

    def __len__(self) -> int:
        """Number of rows."""
        return int(self.first[-1])

    def column(self, name: str) -> Floats:
        """A column of all series, one after the other."""
        return np.asarray(self.numbers[name], dtype=np.float64)

    def follows(self) -> Bools:
        """True where a row has a predecessor in its own series, shape (rows,)."""
        out = np.ones(len(self), dtype=np.bool_)
        out[self.first[:-1]] = False
        return out

    def labels(self) -> NDArray[np.intp]:
        """Number of the series of each row."""
        return np.repeat(np.arange(len(self.names)), np.diff(self.first))

    def slices(self) -> list[tuple[str, slice]]:
        """Name and rows of each series."""
        return [(name, slice(int(a), int(b))) for name, a, b in zip(self.names, self.first[:-1], self.first[1:], strict=True)]


def in_numpy(column: pa.ChunkedArray) -> NDArray[Any]:
    """Numbers or truth values (rows,), not to be written into.

    The same as ``column.to_numpy()``, which imports pandas and takes longer for that than all metrics of a short run.
    """
    plain = pa.types.is_floating(column.type) or pa.types.is_integer(column.type) or pa.types.is_boolean(column.type)
    if not plain or column.null_count:
        return column.to_numpy()  # type: ignore[no-any-return]
    parts = [_values(part) for part in column.chunks]
    return parts[0] if len(parts) == 1 else np.concatenate([np.zeros(0, _dtype(column.type)), *parts])


def _values(part: pa.Array) -> NDArray[Any]:
    rows, data = slice(part.offset, part.offset + len(part)), part.buffers()[1]
    if data is None:
        return np.zeros(0, _dtype(part.type))
    if pa.types.is_boolean(part.type):
        return np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little")[rows].astype(np.bool_)
    return np.frombuffer(data, _dtype(part.type))[rows]


def _dtype(kind: pa.DataType) -> np.dtype[Any]:
    """Numpy's type of numbers of pyarrow's: both call them by the same names but for these."""
    return np.dtype({"float": "f4", "double": "f8"}.get(str(kind), str(kind)))


def coded(column: pa.ChunkedArray) -> Names:
    """A column of names; of numbers, their texts in ascending order."""
    if not pa.types.is_dictionary(column.type):
        return _numbered(np.array(column.to_pylist()) if pa.types.is_string(column.type) else in_numpy(column))
    whole = column.combine_chunks()
    codes = _values(whole.indices).astype(np.int64)
    if whole.null_count:
        codes[~np.asarray(whole.is_valid().to_pylist())] = -1
    return Names(codes, [str(name) for name in whole.dictionary.to_pylist()])


def _numbered(whole: NDArray[Any]) -> Names:
    found, codes = np.unique(whole, return_inverse=True)
    return Names(codes.astype(np.int64), [str(value) for value in found.tolist()])


def series(table: pa.Table, *keys: str) -> Series:
    """Split a table by the values of ``keys`` (joined by a dot in the names) and sort each part by time."""
    numbers, words = dict[str, NDArray[Any]](), dict[str, Names]()
    for name in table.column_names:
        kind = table[name].type
        if pa.types.is_dictionary(kind) or pa.types.is_string(kind):
            words[name] = coded(table[name])
        else:
            numbers[name] = in_numpy(table[name])
    if not table.num_rows:
        return Series([], np.zeros(1, dtype=np.int64), numbers, words)
    return _split(numbers, words, [words[key] if key in words else coded(table[key]) for key in keys])


def _split(numbers: Mapping[str, NDArray[Any]], words: Mapping[str, Names], keys: Sequence[Names]) -> Series:
    """Columns, one row or more, as one series for each combination of ``keys``."""
    code = np.zeros(len(numbers["time_s"]), dtype=np.int64)
    for key in keys:
        code = code * (len(key.names) + 1) + key.codes
    order = np.lexsort((numbers["time_s"], code))
    code = code[order]
    first = np.concatenate([[0], np.flatnonzero(np.diff(code)) + 1, [len(code)]]).astype(np.int64)
    names = []
    for value in code[first[:-1]]:
        parts = []
        for key in reversed(keys):
            value, part = divmod(int(value), len(key.names) + 1)
            parts.append([*key.names, "?"][part])
        names.append(".".join(reversed(parts)))
    return Series(
        names, first, {name: column[order] for name, column in numbers.items()},
        {name: column._replace(codes=column.codes[order]) for name, column in words.items()},
    )  # fmt: skip


def turns(split: Series, events: Iterable[Mapping[str, Any]]) -> Bools:
    """Rows after which a train turned back before its next one, shape (rows,): there its positions begin anew."""
    found, time = np.zeros(len(split), dtype=np.bool_), split.column("time_s") if split.names else np.zeros(0)
    told: dict[str, list[float]] = {}
    for event in events:
        if event["kind"] == "turn":
            told.setdefault(str(event["train"]), []).append(float(event["time_s"]))
    train = split.words["train"].each() if told and split.names else np.zeros(0)
    for _, rows in split.slices() if told else ():
        for at in told.get(train[rows.start], ()):
            k = rows.start + int(np.searchsorted(time[rows], at + INSTANT, side="right")) - 1
            if rows.start <= k < rows.stop - 1:
                found[k] = True
    return found


def advance(split: Series, turned: Bools) -> Floats:
    """Way from every row to the next one of its series [m], 0 from the last, (rows,); over a turn it is what the speeds say."""
    position, speed, time = (split.column(name) for name in ("position_m", "speed_mps", "time_s"))
    ahead, over = np.diff(position), turned[:-1]
    ahead[over] = (0.5 * (speed[:-1] + speed[1:]) * np.diff(time))[over]
    return np.append(np.where(split.follows()[1:], ahead, 0.0), 0.0)


@dataclass(frozen=True)
class Pairs(Series):
    """One series per pair of trains, the one ahead first."""

    ends: list[tuple[str, str]] = field(default_factory=list)


#: The columns of ``pairs``.
PAIRED = ("time_s", "spacing_m", "desired_m", "lower_m", "upper_m", "error_m", "age_s")


def pairs(links: pa.Table) -> Pairs:
    """Links as one series per pair ``ahead-behind``, whichever receives from which.

    A pair that receives from each other stands twice in the log with opposite signs; here the train that is to be ahead comes first
    and the tighter bound of both rows counts. Columns: ``time_s, spacing_m, desired_m, lower_m, upper_m, error_m`` and
    ``age_s``, the time since the link was made or its desired spacing or bounds were changed.
    """
    if not links.num_rows:
        return Pairs([], np.zeros(1, dtype=np.int64), dict.fromkeys(PAIRED, np.zeros(0)))
    stated = {name: in_numpy(links[name]) for name in ("time_s", "spacing_m", "desired_m", "lower_m", "upper_m")}
    flip = stated["desired_m"] < 0
    sign = np.where(flip, -1.0, 1.0)
    ends = [coded(links[key]) for key in ("sender", "receiver")]
    names = sorted({text for end in ends for text in end.names})
    place = {text: code for code, text in enumerate(names)}
    sender, receiver = (np.array([place[text] for text in end.names])[end.codes] for end in ends)
    pair = np.where(flip, receiver, sender) * len(names) + np.where(flip, sender, receiver)
    split = _split({
        "time_s": stated["time_s"],
        "spacing_m": sign * stated["spacing_m"],
        "desired_m": sign * stated["desired_m"],
        "lower_m": np.where(flip, -stated["upper_m"], stated["lower_m"]),
        "upper_m": np.where(flip, -stated["lower_m"], stated["upper_m"]),
    }, {}, [_numbered(pair)])  # fmt: skip
    time, label = split.column("time_s"), split.labels()
    start = np.flatnonzero(np.concatenate([[True], (np.diff(time) > INSTANT) | (np.diff(label) > 0)]))
    single = {name: split.column(name)[start] for name in ("time_s", "spacing_m", "desired_m")}
    single["lower_m"] = np.maximum.reduceat(split.column("lower_m"), start)
    single["upper_m"] = np.minimum.reduceat(split.column("upper_m"), start)
    single["error_m"] = single["spacing_m"] - single["desired_m"]
    first = np.searchsorted(label[start], np.arange(len(split.names) + 1))
    ends_of = [(names[int(pair) // len(names)], names[int(pair) % len(names)]) for pair in split.names]
    out = Pairs([f"{a}-{b}" for a, b in ends_of], first.astype(np.int64), single, ends=ends_of)
    single["age_s"] = out.column("time_s") - _since(out, stated["time_s"])
    return out


def _since(split: Series, all_times: Floats) -> Floats:
    """When the link of each row was made: the first row after a gap in the log or a changed number."""
    time = split.column("time_s")
    instants = np.unique(np.round(all_times / INSTANT))
    index = np.searchsorted(instants, np.round(time / INSTANT))
    new = ~split.follows()
    new[1:] |= np.diff(index) > 1
    for name in ("desired_m", "lower_m", "upper_m"):
        value = split.column(name)
        new[1:] |= value[1:] != value[:-1]
    begin = np.flatnonzero(new)
    return np.repeat(time[begin], np.diff([*begin, len(time)]))
