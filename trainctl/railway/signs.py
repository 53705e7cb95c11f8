"""Speed limits that change by the clock: variable speed signs, known before the run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from trainctl.signals import Bools, Floats, Ints


class Signs(NamedTuple):
    """What signs show from when on, by time; K changes."""

    time: Floats  # (K,) s
    edge: Ints  # (K,)
    speed: Floats  # (K,) m/s


def signs(changes: Sequence[tuple[float, str, float]], index: Mapping[str, int]) -> Signs:
    """Changes (time [s], edge, speed [m/s]) as arrays; ``index`` numbers the edges. Of changes at one time the last one holds."""
    rows = sorted(((t, index[edge], v) for t, edge, v in changes if edge in index), key=lambda row: row[0])
    return Signs(
        np.array([t for t, _, _ in rows]), np.array([e for _, e, _ in rows], np.int64), np.array([v for _, _, v in rows])
    )  # fmt: skip


def in_force(signs: Signs, base: Floats, t: float) -> Floats:
    """Limit of every edge at the time ``t`` [s], shape (E,) [m/s]; ``base`` (E,) where no sign has shown anything yet."""
    if not len(signs.time):
        return base
    shown = slice(int(np.searchsorted(signs.time, t + 1e-9, side="right")))
    limit = base.copy()
    limit[signs.edge[shown]] = signs.speed[shown]  # the last write stays
    return limit


def announced(signs: Signs, base: Floats, t: float, step: float, rate: float, early: float = 0.0) -> Floats:
    """Limit of every edge for a train that decides at ``t`` [s] on its next ``step`` [s], shape (E,) [m/s].

    A lower limit to come is approached with ``rate`` [m/s2] and reached ``early`` [s], so that who keeps to it has slowed down when
    it begins to hold.
    """
    if not len(signs.time):
        return base
    limit = _shown(signs, base, t, step)
    later = int(np.searchsorted(signs.time, t + step + 1e-9, side="right"))
    left = np.maximum(signs.time[later:] - t - step - early, 0.0)
    np.minimum.at(limit, signs.edge[later:], signs.speed[later:] + rate * left)
    return limit


def falling(signs: Signs, base: Floats, t: float, step: float, limit: Floats) -> Bools:
    """Edges (E,) whose ``limit`` is ``announced`` to fall: who comes near needs that rate beside its braking for the place."""
    if not len(signs.time):
        return np.zeros(len(base), bool)
    return limit < _shown(signs, base, t, step)


def _shown(signs: Signs, base: Floats, t: float, step: float) -> Floats:
    """Lowest limit of every edge over the step [m/s], (E,)."""
    return np.minimum(in_force(signs, base, t), in_force(signs, base, t + step))


def highest(signs: Signs, base: Floats) -> Floats:
    """Highest limit every edge ever has, shape (E,) [m/s]."""
    limit = base.copy()
    np.maximum.at(limit, signs.edge, signs.speed)
    return limit
