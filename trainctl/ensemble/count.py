"""What is counted of stacked runs while they go on: extremes, sums and times of trains and pairs, and the bounds that are violated.

The rules are those of ``metrics`` (recorded instants) and ``monitors.bounds`` (every step); ``measures`` makes metrics of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from trainctl.kernels import keep_by_sources
from trainctl.metrics.driving import ELECTRIC_BRAKE_FROM_MPS
from trainctl.metrics.run import SLACK
from trainctl.metrics.traffic import MOVING_MPS
from trainctl.monitors.on_track import ROUNDING
from trainctl.signals import Bools, Bounds, Floats, Ints, Links

keep_by_sources()  # before anything below is decorated

#: Columns of ``Counts.train``: what was last, then extremes, then sums.
(
    POSITION, SPEED, ACCELERATION, INPUT,
    START, SPEED_MIN, SPEED_MAX, INPUT_MIN, INPUT_MAX, ACCELERATION_MIN, ACCELERATION_MAX, JERK_MAX, SPACING_MIN, HEADWAY_MIN,
    SPEED_SUM, SPACING_SUM, HEADWAY_SUM, HEADWAYS, JERK_SUM, TRACTION, BRAKING, ELECTRIC, SATURATED,
    SIDE, OVERSHOOT, SPEED_ERROR,
) = range(26)  # fmt: skip

#: Columns of ``Counts.pair``.
LOWEST, HIGHEST, ERROR_MAX, ERROR_SQUARES, ERROR_SIDE, ERROR_OVERSHOOT, ERROR_LAST = range(7)

#: Bits of ``Counts.violated``: bounds of a train. Those of a link have bits of their own.
SLOW, FAST, BRAKES, PULLS, ABOVE_LIMIT = 1, 2, 4, 8, 16
NEAR, FAR = 1, 2

#: Why a run cannot go on in a stack, ``Counts.fate``.
GOES_ON, TOUCHES, NOT_FINITE = range(3)

#: Trains nearer than this are looked at in a run of their own [m]: what is inside what is told by ``monitors.on_track``.
TOUCH_M = 0.01


class Pairs(NamedTuple):
    """Pairs of trains that receive from each other, Q in all runs, the one ahead first, as ``runs.series.pairs`` has them."""

    ahead: Ints  # (Q,)
    behind: Ints  # (Q,)
    desired: Floats  # (Q,) m
    lower: Floats  # (Q,) m
    upper: Floats  # (Q,) m
    run: Ints  # (Q,)


class Fixed(NamedTuple):
    """What does not change while runs go on, N trains."""

    run: Ints  # (N,)
    ahead: Ints  # (N,) -1: none
    length: Floats  # (N,) m
    mass: Floats  # (N,) kg
    known: Bounds  # (N,) as the metrics have them
    kept: Bounds  # (N,) as the alarms have them
    links: Links
    pairs: Pairs
    band: float  # m, within which a spacing has settled


class Instant(NamedTuple):
    """What a recorded instant is among the others."""

    t: float  # s
    dt: float  # s, since the one before; NaN: none
    middle: float  # s, between the middles of the two steps to it; NaN: none
    counts: bool  # links are old enough for their bounds to count
    reference: float  # m/s
    level: bool  # the reference keeps its speed
    fresh: bool  # the first instant of that speed
    number: int
    last: bool


class Counts(NamedTuple):
    """What was counted so far; overwritten in place."""

    train: Floats  # (N, 26)
    pair: Floats  # (Q, 7)
    violated: Ints  # (N,) bits
    link: Ints  # (L,) bits
    outside: Ints  # (R,) number of the last instant at which a spacing was outside of the band, -1: none
    first: Floats  # (R,) s, when a bound was violated for the first time, NaN: never
    fate: Ints  # (R,)


def nothing(fixed: Fixed, runs: int) -> Counts:
    """Nothing counted yet."""
    n, q = len(fixed.run), len(fixed.pairs.run)
    train, pair = np.zeros((n, 26)), np.zeros((q, 7))
    train[:, [SPEED_MIN, INPUT_MIN, ACCELERATION_MIN, SPACING_MIN, HEADWAY_MIN]] = np.inf
    train[:, [SPEED_MAX, INPUT_MAX, ACCELERATION_MAX, JERK_MAX]] = -np.inf
    pair[:, LOWEST], pair[:, HIGHEST] = np.inf, -np.inf
    return Counts(
        train, pair, np.zeros(n, np.int64), np.zeros(len(fixed.links.sender), np.int64), np.full(runs, -1), np.full(runs, np.nan),
        np.zeros(runs, np.int64),
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def watch(fixed: Fixed, position: Floats, speed: Floats, force: Floats, moves: bool, counts: Counts) -> None:
    """Which bounds are violated at an instant, and which runs cannot go on here.

    Parameters
    ----------
    fixed : Fixed
        The trains.
    position, speed, force : ndarray, shape (N,)
        Now [m], [m/s], [m/s2].
    moves : bool
        ``force`` is applied from now on; not at the end.
    counts : Counts
        Updated.
    """
    kept = fixed.kept
    for i in range(len(position)):
        x, v = position[i], speed[i]
        bits = 0
        if v < kept.speed_lower[i] - ROUNDING:
            bits |= SLOW
        if v > kept.speed_upper[i] + ROUNDING:
            bits |= FAST
        if moves:
            if force[i] < kept.input_lower[i] - ROUNDING:
                bits |= BRAKES
            if force[i] > kept.input_upper[i] + ROUNDING:
                bits |= PULLS
        if bits:
            counts.violated[i] |= bits
        if not (abs(x) < np.inf and abs(v) < np.inf):
            counts.fate[fixed.run[i]] = NOT_FINITE
        j = fixed.ahead[i]
        if j >= 0 and not position[j] - fixed.length[j] - x > TOUCH_M:
            counts.fate[fixed.run[i]] = max(counts.fate[fixed.run[i]], TOUCHES)
    links = fixed.links
    for k in range(len(links.sender)):
        spacing = position[links.sender[k]] - position[links.receiver[k]]
        if spacing > 0.0:  # each pair once
            if spacing < links.lower[k] - ROUNDING:
                counts.link[k] |= NEAR
            if spacing > links.upper[k] + ROUNDING:
                counts.link[k] |= FAR


@njit(cache=True, error_model="numpy")
def count(
    fixed: Fixed, now: Instant, position: Floats, speed: Floats, force: Floats, saturated: Bools, counts: Counts
) -> None:  # fmt: skip
    """Count a recorded instant; arguments as of ``watch``, ``saturated`` (N,)."""
    known, first = fixed.known, now.number == 0
    jerky = now.middle == now.middle
    for i in range(len(position)):
        c = counts.train[i]
        x, v = position[i], speed[i]
        if first:
            c[START] = x
        else:
            acceleration = (v - c[SPEED]) / now.dt
            c[ACCELERATION_MIN] = min(c[ACCELERATION_MIN], acceleration)
            c[ACCELERATION_MAX] = max(c[ACCELERATION_MAX], acceleration)
            if jerky:
                jerk = abs((acceleration - c[ACCELERATION]) / now.middle)
                c[JERK_MAX] = max(c[JERK_MAX], jerk)
                c[JERK_SUM] += jerk * jerk * now.middle
            c[ACCELERATION] = acceleration
            work = c[INPUT] * fixed.mass[i] * (x - c[POSITION])
            if work > 0.0:
                c[TRACTION] += work
            else:
                c[BRAKING] -= work
                if c[SPEED] > ELECTRIC_BRAKE_FROM_MPS:
                    c[ELECTRIC] -= work
        c[POSITION], c[SPEED] = x, v
        c[SPEED_MIN], c[SPEED_MAX] = min(c[SPEED_MIN], v), max(c[SPEED_MAX], v)
        c[SPEED_SUM] += v
        violated = v - known.speed_lower[i] < -SLACK or known.speed_upper[i] - v < -SLACK
        if not now.last:
            u = force[i]
            c[INPUT] = u
            c[INPUT_MIN], c[INPUT_MAX] = min(c[INPUT_MIN], u), max(c[INPUT_MAX], u)
            violated = violated or u - known.input_lower[i] < -SLACK or known.input_upper[i] - u < -SLACK
        if violated and not counts.first[fixed.run[i]] <= now.t:
            counts.first[fixed.run[i]] = now.t
        if saturated[i]:
            c[SATURATED] += 1.0
        j = fixed.ahead[i]
        if j >= 0:
            spacing = position[j] - x
            c[SPACING_MIN] = min(c[SPACING_MIN], spacing)
            c[SPACING_SUM] += spacing
            if v > MOVING_MPS:
                headway = spacing / v
                c[HEADWAY_MIN] = min(c[HEADWAY_MIN], headway)
                c[HEADWAY_SUM] += headway
                c[HEADWAYS] += 1.0
        error = v - now.reference
        c[SPEED_ERROR] = abs(error)
        if now.level:
            if now.fresh:
                c[SIDE] = error
            beyond = abs(error) if c[SIDE] == 0.0 else (-error if c[SIDE] > 0.0 else error)
            c[OVERSHOOT] = max(c[OVERSHOOT], beyond)
    _pairs(fixed, now, position, counts)


@njit(cache=True, error_model="numpy")
def _pairs(fixed: Fixed, now: Instant, position: Floats, counts: Counts) -> None:
    pairs, first = fixed.pairs, now.number == 0
    for q in range(len(pairs.run)):
        c, r = counts.pair[q], pairs.run[q]
        spacing = position[pairs.ahead[q]] - position[pairs.behind[q]]
        error = spacing - pairs.desired[q]
        size = abs(error)
        if now.counts:
            c[LOWEST], c[HIGHEST] = min(c[LOWEST], spacing), max(c[HIGHEST], spacing)
            violated = spacing - pairs.lower[q] < -SLACK or pairs.upper[q] - spacing < -SLACK
            if violated and not counts.first[r] <= now.t:
                counts.first[r] = now.t
        if first:
            c[ERROR_SIDE] = error
        beyond = size if c[ERROR_SIDE] == 0.0 else (-error if c[ERROR_SIDE] > 0.0 else error)
        c[ERROR_OVERSHOOT] = max(c[ERROR_OVERSHOOT], beyond)
        c[ERROR_MAX] = max(c[ERROR_MAX], size)
        c[ERROR_SQUARES] += error * error
        c[ERROR_LAST] = size
        if size > fixed.band:
            counts.outside[r] = now.number
