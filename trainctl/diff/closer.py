"""A closer look at the rows of a train that differs.

Is it the same course, only later; on another way; or another train's? It works on the rows that were kept as evidence, and what it
says holds for all of these: a course is "late by X" only if every row from some time on is the reference's of X before, in every
column that says where the train is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from trainctl.diff.columns import floats, resolution
from trainctl.diff.sources import NAMES
from trainctl.diff.tally import Evidence
from trainctl.diff.tolerance import Tolerance
from trainctl.diff.tube import GAP_S
from trainctl.signals import Bools, Floats, Ints

#: Columns that say where a train is, the most telling first.
PLACES = ("position_m", "distance", "odometer", "x", "y", "pos")
SPEEDS = ("speed_mps", "speed")
#: A train slower than this is at a standstill [m/s].
STANDS = 0.1
#: ... if it is so slow in this share of the rows.
MOST = 0.6
#: Rows that must show a shift in time, and the share of the rows after the first difference.
FEWEST, SHARE = 5, 0.5
#: Shifts in time that are tried, and values by which they are sought.
TRIED, PROBES = 6, 24


@dataclass
class Course:
    """Rows of one train in one log, in time: numbers, and texts as codes that both logs share."""

    time: Floats
    numbers: dict[str, Floats]
    texts: dict[str, Ints]

    def take(self, rows: Ints | Bools) -> Course:
        """Some rows."""
        return Course(self.time[rows], {n: v[rows] for n, v in self.numbers.items()}, {n: v[rows] for n, v in self.texts.items()})

    @property
    def speed(self) -> Floats | None:
        """Its speeds [m/s], if the log has them."""
        return next((self.numbers[name] for name in SPEEDS if name in self.numbers), None)


@dataclass
class Kept:
    """The evidence of a table: courses by train and what else distinguishes rows of one instant."""

    a: dict[int, list[Course]]
    b: dict[int, list[Course]]
    words: dict[str, list[str]]  # texts by code
    decimals: dict[str, float]

    @classmethod
    def of(cls, one: Evidence, two: Evidence, keys: tuple[str, ...], time: str | None) -> Kept:
        """Sort the evidence of both logs by train."""
        (ta, time_a, train_a), (tb, time_b, train_b) = one.rows(), two.rows()
        numbers: tuple[dict[str, Floats], dict[str, Floats]] = ({}, {})
        texts: tuple[dict[str, Ints], dict[str, Ints]] = ({}, {})
        words: dict[str, list[str]] = {}
        decimals: dict[str, float] = {}
        for name in [n for n in ta.column_names or tb.column_names if n != time and n not in keys[:1]]:
            columns = [t[name] if name in t.column_names else pa.chunked_array([pa.nulls(t.num_rows)]) for t in (ta, tb)]
            x, y = (floats(c) if name not in NAMES and name not in keys else None for c in columns)
            if x is not None and y is not None:
                numbers[0][name], numbers[1][name] = x, y
                decimals[name] = max(resolution(c) for c in columns)
                continue
            chunks = [chunk.cast(pa.string()) for c in columns for chunk in c.chunks]
            coded = pa.chunked_array(chunks, pa.string()).combine_chunks().fill_null("").dictionary_encode()
            codes = coded.indices.to_numpy(zero_copy_only=False).astype(np.int64)
            texts[0][name], texts[1][name] = codes[: ta.num_rows], codes[ta.num_rows :]
            words[name] = coded.dictionary.to_pylist()
        sides = []
        for k, (times, train) in enumerate(((time_a, train_a), (time_b, train_b))):
            rest = [texts[k][key] for key in keys[1:] if key in texts[k]]
            whole = Course(times, numbers[k], {n: v for n, v in texts[k].items() if n not in keys})
            sides.append(_by_train(whole, train, rest))
        return cls(sides[0], sides[1], words, decimals)

    def pairs(self, train: int) -> list[tuple[Course, Course]]:
        """Courses of one train in both logs; a train with units or links has one for each."""
        a, b = self.a.get(train, []), self.b.get(train, [])
        return list(zip(a, b, strict=True)) if len(a) == len(b) else []


def _by_train(whole: Course, train: Ints, rest: list[Ints]) -> dict[int, list[Course]]:
    order = np.lexsort((whole.time, *rest, train))
    if not len(order):
        return {}
    sorted_ = np.stack([train[order], *(r[order] for r in rest)])
    cuts = np.flatnonzero(np.any(np.diff(sorted_, axis=1) != 0, axis=0)) + 1
    out: dict[int, list[Course]] = {}
    for rows in np.split(order, cuts):
        out.setdefault(int(train[rows[0]]), []).append(whole.take(rows))
    return out


def fits(a: Course, b: Course, by: float, tolerances: dict[str, Tolerance], decimals: dict[str, float]) -> dict[str, Floats]:
    """Whether each row of B is A's of ``by`` seconds before, by column: 1, 0, or NaN where A has no row near.

    Between two rows of A lies a straight line, and what the course can bend off it at most: half of what it bends at these rows.
    """
    out: dict[str, Floats] = {}
    if not len(a.time) or not len(b.time):
        return out
    at = b.time - by
    i = np.clip(np.searchsorted(a.time, at + 1e-7, side="right") - 1, 0, len(a.time) - 1)
    j = np.minimum(i + 1, len(a.time) - 1)
    gap = a.time[j] - a.time[i]
    share = np.clip(np.divide(at - a.time[i], gap, out=np.zeros(len(at)), where=gap > 0), 0.0, 1.0)
    share = np.where(share < 1e-6, 0.0, np.where(share > 1 - 1e-6, 1.0, share))
    known = (at >= a.time[0] - 1e-7) & (at <= a.time[-1] + 1e-7) & (gap <= GAP_S)
    between = (share > 0) & (share < 1)
    for name, y in a.numbers.items():
        told = tolerances.get(name, Tolerance(1e-6, 1e-9))
        bend = np.zeros(len(y))
        if len(y) > 2:
            with np.errstate(invalid="ignore"):
                bend[1:-1] = np.nan_to_num(np.abs(y[2:] - 2 * y[1:-1] + y[:-2]), posinf=0.0)
            bend = np.maximum(bend, np.maximum(np.append(bend[1:], 0.0), np.append(0.0, bend[:-1])))
        with np.errstate(invalid="ignore"):
            value = np.where(share == 0, y[i], y[i] + share * (y[j] - y[i]))
            slack = np.maximum(max(told.absolute, 1.01 * decimals.get(name, 0.0)), max(told.relative, 1e-9) * np.abs(value))
            slack = slack + np.where(between, 0.5 * np.maximum(bend[i], bend[j]) + slack, 0.0)
            good = (np.abs(b.numbers[name] - value) <= slack) | (np.isnan(value) & np.isnan(b.numbers[name]))
        out[name] = np.where(known, good.astype(float), np.nan)
    for name, code in a.texts.items():
        same = (b.texts[name] == code[i]) | (between & (b.texts[name] == code[j])) | ((share == 1) & (b.texts[name] == code[j]))
        out[name] = np.where(known, same.astype(float), np.nan)
    return out


@dataclass
class Shift:
    """A course that is another's, ``by_s`` later (earlier if negative), in these columns, from a time on."""

    by_s: float
    from_s: float
    columns: set[str]


def shifted(
    pairs: list[tuple[Course, Course]], differ: set[str], since: float, tolerances: dict[str, Tolerance], decimals: dict[str, float]
) -> Shift | None:
    """By how much a train is late from its first difference on, None if that does not explain what differs.

    Parameters
    ----------
    pairs : list
        Its courses in A and B.
    differ : set
        Columns in which it differs.
    since : float
        Time of its first difference [s].
    tolerances, decimals : dict
        By column: how far values may lie apart, what their last decimals stand for.
    """
    place = next((n for n in PLACES if n in differ and all(n in a.numbers for a, _ in pairs)), None)
    alone = not differ
    if place is None and alone:
        place = next((n for n in PLACES if all(n in a.numbers for a, _ in pairs)), None)
    if place is None or not pairs:
        return None
    core = [n for n in PLACES if n in pairs[0][0].numbers]
    a, b = pairs[0]
    allowed = max(tolerances.get(place, Tolerance(1e-6)).absolute, decimals.get(place, 0.0))
    for by in candidates(a, b, place, since, allowed):
        found = _checked(pairs, by, core, since, tolerances, decimals)
        if found is not None:
            return found
    return None


def candidates(a: Course, b: Course, place: str, since: float, allowed: float) -> list[float]:
    """Shifts in time by which values of B stand in A, those that most values share first [s]."""
    known = np.isfinite(a.numbers[place])
    a, v = a.take(known), b.numbers[place]
    y = a.numbers[place]
    if len(a.time) < 3 or len(b.time) < 3:
        return []
    moves = np.isfinite(v) & (np.abs(np.gradient(v)) > 2 * allowed)
    rows = np.flatnonzero(moves & (b.time >= since))
    if not len(rows):
        return []
    steps = np.diff(a.time)
    if not (steps > 0).any():
        return []
    step = float(np.median(steps[steps > 0]))  # rows may stand twice
    votes: list[float] = []
    for row in rows[np.unique(np.linspace(0, len(rows) - 1, PROBES).astype(int))]:
        left, right = y[:-1] - v[row], y[1:] - v[row]
        crossed = np.flatnonzero((left * right <= 0) & (left != right))
        share = left[crossed] / (left[crossed] - right[crossed])
        votes += list(b.time[row] - (a.time[crossed] + share * (a.time[crossed + 1] - a.time[crossed])))
    seen = np.array(votes)
    seen = seen[np.isfinite(seen)]  # a damaged log may hold any number
    eps = 0.1 * step
    bins = np.round(seen / eps).astype(int)
    best: list[float] = []
    values, counts = np.unique(bins, return_counts=True)
    for value in values[np.lexsort((np.abs(values), -counts))][:TRIED]:
        by = float(np.median(seen[np.abs(bins - value) <= 1]))
        whole = round(by / step) * step
        by = whole if abs(by - whole) < 0.05 * step else float(round(by / step, 2) * step)
        if abs(by) > 1e-3 * step and all(abs(by - other) > 1e-9 for other in best):
            best.append(by)
    return best


def _checked(
    pairs: list[tuple[Course, Course]], by: float, core: list[str], since: float, tolerances: dict[str, Tolerance],
    decimals: dict[str, float],
) -> Shift | None:  # fmt: skip
    begin, explained = -np.inf, set(pairs[0][0].numbers) | set(pairs[0][0].texts)
    for a, b in pairs:
        after = b.time >= since - 1e-7
        good = fits(a, b.take(after), by, tolerances, decimals)
        time = b.time[after]
        where = np.all([good[n] != 0 for n in core], axis=0) if core else np.zeros(len(time), bool)
        judged = ~np.isnan(good[core[0]]) if core and core[0] in good else np.zeros(len(time), bool)
        wrong = np.flatnonzero(~where)
        start = int(wrong[-1]) + 1 if len(wrong) else 0
        enough = int(judged[start:].sum())
        if enough < FEWEST or enough < SHARE * judged.sum():
            return None
        first = float(time[start])
        begin = max(begin, first)
        explained &= {n for n, values in good.items() if not np.any(values[start:] == 0)}
    # Not before the time by which it is late: it must have stood, or gone on, until then.
    if begin > since + max(by, 0.0) + max(60.0, abs(by)):
        return None
    return Shift(by, since, explained)


def stood(course: Course, begin: float, end: float) -> bool:
    """Whether a train is at a standstill through most of a time."""
    speed = course.speed
    inside = (course.time >= begin) & (course.time <= end)
    return speed is not None and bool(inside.any()) and float((speed[inside] <= STANDS).mean()) >= MOST


def way(course: Course, words: dict[str, list[str]], tracks: bool = False) -> list[tuple[str, float]]:
    """Edges (or lanes and tracks) a train goes over, in order, each with its first time [s]; without those inside of nodes."""
    names = ("lane", "track") if tracks else ("edge", "lane")
    name = next((n for n in names if n in course.texts), None)
    if name is None:
        return []
    codes = course.texts[name]
    begins = np.flatnonzero(np.append(True, codes[1:] != codes[:-1])[: len(codes)])
    out: list[tuple[str, float]] = []
    for row in begins:
        word = words[name][int(codes[row])]
        edge = word.rpartition("_")[0] if name == "lane" and not tracks else word
        if edge and not edge.startswith(":") and (not out or out[-1][0] != edge):
            out.append((edge, float(course.time[row])))
    return out


def alike(a: Course, b: Course, tolerances: dict[str, Tolerance], decimals: dict[str, float]) -> bool:
    """Whether two courses are the same, row by row."""
    if len(a.time) != len(b.time) or not len(a.time) or np.any(np.abs(a.time - b.time) > 1e-6):
        return False
    good = fits(a, b, 0.0, tolerances, decimals)
    return bool(a.numbers) and all(np.all(good[name] == 1) for name in a.numbers)
