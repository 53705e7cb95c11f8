"""The flat table of metrics: ``group.name_unit`` and ``group.name_unit/item``."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from trainctl.runs.series import Series
from trainctl.signals import Floats

Values = dict[str, float | int | str | None]


def put_worst(values: Values, name: str, split: Series, numbers: Floats, worse: np.ufunc) -> None:
    """Enter the worst value of each series as ``name/item`` and of all as ``name``; what is not finite does not count."""
    empty = np.inf if worse is np.minimum else -np.inf
    if not split.names:
        return
    per_series = worse.reduceat(np.where(np.isfinite(numbers), numbers, empty), split.first[:-1])
    if not np.isfinite(per_series).any():
        return
    values[name] = float(worse.reduce(per_series))
    values |= {f"{name}/{item}": float(v) for item, v in zip(split.names, per_series, strict=True) if np.isfinite(v)}


def at_most(split: Series, *columns: str) -> Floats:
    """Smallest of some columns, whichever exist and are finite; NaN where none is."""
    return _folded(split, columns, np.fmin)


def at_least(split: Series, *columns: str) -> Floats:
    """Maximum of some columns, whichever exist and are finite; NaN where none is."""
    return _folded(split, columns, np.fmax)


def _folded(split: Series, columns: tuple[str, ...], fold: np.ufunc) -> Floats:
    out = np.full(len(split), np.nan)
    for name in columns:
        if name in split.numbers:
            value = split.column(name)
            out = fold(out, np.where(np.isfinite(value), value, np.nan))
    return out


def base(name: str) -> str:
    """Name of a metric without its item."""
    return name.partition("/")[0]


def overall(values: Mapping[str, float | int | str | None]) -> Values:
    """Only the metrics of the whole run, for a summary table."""
    return {name: value for name, value in values.items() if "/" not in name}
