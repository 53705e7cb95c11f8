"""Rows of a log as one time series per train, unit or link: sorted arrays and where each series begins."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from trainctl.signals import Bools, Floats, Ints

#: Two times of one log are the same instant below this [s]; SUMO counts milliseconds.
INSTANT = 1e-6


@dataclass(frozen=True)
class Series:
    """A table sorted by series, then time. Series ``k`` is the rows ``first[k]:first[k + 1]``."""

    names: list[str]
    first: Ints  # (len(names) + 1,)
    frame: pd.DataFrame

    def column(self, name: str) -> Floats:
        """A column of all series, one after the other."""
        return self.frame[name].to_numpy(dtype=np.float64)

    def follows(self) -> Bools:
        """True where a row has a predecessor in its own series, shape (rows,)."""
        out = np.ones(len(self.frame), dtype=np.bool_)
        out[self.first[:-1]] = False
        return out

    def labels(self) -> NDArray[np.intp]:
        """Number of the series of each row."""
        return np.repeat(np.arange(len(self.names)), np.diff(self.first))

    def slices(self) -> list[tuple[str, slice]]:
        """Name and rows of each series."""
        return [(name, slice(int(a), int(b))) for name, a, b in zip(self.names, self.first[:-1], self.first[1:], strict=True)]


def series(frame: pd.DataFrame, *keys: str) -> Series:
    """Split a table by the values of ``keys`` (joined by a dot in the names) and sort each part by time."""
    if frame.empty:
        return Series([], np.zeros(1, dtype=np.int64), frame)
    code = np.zeros(len(frame), dtype=np.int64)
    texts: list[list[str]] = []
    for key in keys:
        column = frame[key].astype("category") if not isinstance(frame[key].dtype, pd.CategoricalDtype) else frame[key]
        code = code * (len(column.cat.categories) + 1) + column.cat.codes.to_numpy()
        texts.append([str(text) for text in column.cat.categories] + ["?"])
    order = np.lexsort((frame["time_s"].to_numpy(), code))
    code = code[order]
    first = np.concatenate([[0], np.flatnonzero(np.diff(code)) + 1, [len(code)]]).astype(np.int64)
    names = []
    for value in code[first[:-1]]:
        parts = []
        for text in reversed(texts):
            value, part = divmod(int(value), len(text))
            parts.append(text[part])
        names.append(".".join(reversed(parts)))
    return Series(names, first, frame.iloc[order])


def turns(split: Series, events: Iterable[Mapping[str, Any]]) -> Bools:
    """Rows after which a train turned back before its next one, shape (rows,): there its positions begin anew."""
    found, time = np.zeros(len(split.frame), dtype=np.bool_), split.column("time_s") if split.names else np.zeros(0)
    told: dict[str, list[float]] = {}
    for event in events:
        if event["kind"] == "turn":
            told.setdefault(str(event["train"]), []).append(float(event["time_s"]))
    for _, rows in split.slices() if told else ():
        for at in told.get(str(split.frame["train"].iloc[rows.start]), ()):
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


def pairs(links: pd.DataFrame) -> Pairs:
    """Links as one series per pair ``ahead-behind``, whichever receives from which.

    A pair that receives from each other stands twice in the log with opposite signs; here the train that is to be ahead comes first
    and the tighter bound of both rows counts. Columns: ``time_s, spacing_m, desired_m, lower_m, upper_m, error_m`` and
    ``age_s``, the time since the link was made or its desired spacing or bounds were changed.
    """
    if links.empty:
        return Pairs([], np.zeros(1, dtype=np.int64), links)
    flip = links["desired_m"].to_numpy() < 0
    sign = np.where(flip, -1.0, 1.0)
    ends = [links[key].astype("category").cat for key in ("sender", "receiver")]
    names = sorted({str(text) for end in ends for text in end.categories})
    place = {text: code for code, text in enumerate(names)}
    sender, receiver = (np.array([place[str(text)] for text in end.categories])[end.codes.to_numpy()] for end in ends)
    lower, upper = links["lower_m"].to_numpy(), links["upper_m"].to_numpy()
    frame = pd.DataFrame({
        "time_s": links["time_s"].to_numpy(),
        "pair": np.where(flip, receiver, sender) * len(names) + np.where(flip, sender, receiver),
        "spacing_m": sign * links["spacing_m"].to_numpy(),
        "desired_m": sign * links["desired_m"].to_numpy(),
        "lower_m": np.where(flip, -upper, lower),
        "upper_m": np.where(flip, -lower, upper),
    })  # fmt: skip
    split = series(frame, "pair")
    time, label = split.column("time_s"), split.labels()
    start = np.flatnonzero(np.concatenate([[True], (np.diff(time) > INSTANT) | (np.diff(label) > 0)]))
    single = split.frame.iloc[start].copy()
    single["lower_m"] = np.maximum.reduceat(split.column("lower_m"), start)
    single["upper_m"] = np.minimum.reduceat(split.column("upper_m"), start)
    single["error_m"] = single["spacing_m"] - single["desired_m"]
    first = np.searchsorted(label[start], np.arange(len(split.names) + 1))
    ends_of = [(names[int(pair) // len(names)], names[int(pair) % len(names)]) for pair in split.names]
    out = Pairs([f"{a}-{b}" for a, b in ends_of], first.astype(np.int64), single, ends_of)
    single["age_s"] = out.column("time_s") - _since(out, links["time_s"].to_numpy())
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
