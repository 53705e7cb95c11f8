"""Columns of two logs side by side: as numbers or texts, and where they differ by more than a tolerance."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from trainctl.diff.sources import NAMES
from trainctl.diff.tolerance import Tolerance
from trainctl.signals import Bools, Floats


def floats(column: pa.ChunkedArray) -> Floats | None:
    """A column as numbers, NaN where it is empty; None if it holds other texts."""
    if pa.types.is_null(column.type):
        return np.full(len(column), np.nan)
    try:
        numbers = column.cast(pa.float64(), safe=False)
    except pa.ArrowException:
        if not pa.types.is_string(column.type) or not pc.any(pc.equal(column, "")).as_py():
            return None
        return floats(pa.chunked_array([pa.array([text or None for text in column.to_pylist()], pa.string())]))
    out: Floats = numbers.to_numpy().astype(np.float64, copy=False)
    return out


def filled(column: pa.ChunkedArray) -> bool:
    """Whether a column has anything in it; SUMO writes an empty text where it has nothing to say."""
    if pa.types.is_string(column.type):
        return bool(pc.any(pc.not_equal(column, "")).as_py())
    return bool(column.null_count < len(column))


def resolution(column: pa.ChunkedArray) -> float:
    """The value of the last decimal of a column of texts; 0 if it is unknown."""
    if not pa.types.is_string(column.type):
        return 0.0
    for text in column.slice(0, 64).to_pylist():
        _, dot, decimals = (text or "").partition(".")
        if dot and decimals.isdigit():
            return float(10.0 ** -len(decimals))
    return 0.0


class Compared(NamedTuple):
    """Two columns row by row. Without numbers, of texts, only ``bad`` is known."""

    bad: Bools
    a: Floats | None = None
    b: Floats | None = None
    difference: Floats | None = None
    #: How far they may lie apart.
    allowed: Floats | None = None
    #: The value of the last decimal of either.
    decimal: float = 0.0


def widened(tolerance: Tolerance, a: pa.ChunkedArray, b: pa.ChunkedArray) -> Tolerance:
    """A tolerance that is not finer than what the columns can hold, unless it was stated."""
    if tolerance.stated:
        return tolerance
    absolute, relative = max(tolerance.absolute, 1.01 * resolution(a), 1.01 * resolution(b)), tolerance.relative
    if any(pa.types.is_float32(column.type) for column in (a, b)):
        relative = max(relative, 2.5e-7)
    return tolerance._replace(absolute=absolute, relative=relative)


def differing(name: str, a: pa.ChunkedArray, b: pa.ChunkedArray, tolerance: Tolerance, span: float = 0.0) -> Compared:
    """Rows of two columns of equal length that differ by more than the tolerance; ``span`` is the range of the reference."""
    numbers_a = numbers_b = None
    if name not in NAMES:
        numbers_a, numbers_b = floats(a), floats(b)
    if numbers_a is None or numbers_b is None:
        texts_a, texts_b = (pc.fill_null(column.cast(pa.string()), "") for column in (a, b))
        equal: Bools = pc.equal(texts_a, texts_b).to_numpy()
        bad = ~equal
        if name not in NAMES:
            for row in np.flatnonzero(bad):
                bad[row] = not alike(texts_a[int(row)].as_py(), texts_b[int(row)].as_py(), tolerance)
        return Compared(bad)
    wide = widened(tolerance, a, b)
    with np.errstate(invalid="ignore", over="ignore"):
        difference = np.abs(numbers_a - numbers_b)
        allowed = np.maximum(max(wide.absolute, wide.range * span), wide.relative * np.abs(numbers_a))
        same = (numbers_a == numbers_b) | (np.isnan(numbers_a) & np.isnan(numbers_b))
        close = np.isfinite(difference) & (difference <= allowed)
    difference = np.where(same, 0.0, np.where(np.isfinite(difference), difference, np.inf))
    return Compared(~(same | close), numbers_a, numbers_b, difference, allowed, max(resolution(a), resolution(b)))


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
