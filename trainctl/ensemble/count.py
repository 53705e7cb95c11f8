"""What is counted of stacked runs while they go on: extremes, sums and times of trains and pairs, and the bounds that are violated.

The rules are those of ``metrics`` (recorded instants) and ``monitors.bounds`` (every step); ``measures`` makes metrics of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trainctl.kernels import bare, keep_by_sources
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


class Instants(NamedTuple):
    """The recorded instants, (K,) each: what each is among the others."""

    t: Floats  # s
    dt: Floats  # s, since the one before; NaN: none
    middle: Floats  # s, between the middles of the two steps to it; NaN: none
    counts: Bools  # links are old enough for their bounds to count
    reference: Floats  # m/s
    level: Bools  # the reference keeps its speed
    fresh: Bools  # the first instant of that speed


class Passage(NamedTuple):
    """Some steps one after the other, M of them, counted together: train by train, each with what was counted of it at hand."""

    position: Floats  # (M, N) m
    speed: Floats  # (M, N) m/s
    force: Floats  # (M, N) m/s2, applied from then on
    saturated: Bools  # (M, N)
    moves: Bools  # (M,) ``force`` counts; not at the end
    number: Ints  # (M,) of the recorded instant, -1: it is none

    @classmethod
    def empty(cls, steps: int, trains: int) -> Passage:
        """Room for so many steps."""
        position, speed, force = np.empty((3, steps, trains))
        return cls(position, speed, force, np.empty((steps, trains), bool), np.empty(steps, bool), np.empty(steps, np.int64))

    def write(
        self, row: int, position: Floats, speed: Floats, force: Floats | None, saturated: Bools, number: int
    ) -> None:  # fmt: skip
        """Write a step; ``force`` is None at the end."""
        self.position[row], self.speed[row], self.saturated[row] = position, speed, saturated
        self.moves[row], self.number[row] = force is not None, number
        if force is not None:
            self.force[row] = force


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


@bare(error_model="numpy")
def count(fixed: Fixed, instants: Instants, passage: Passage, steps: int, counts: Counts) -> None:
    """Which bounds are violated, which runs cannot go on here, and what metrics are made of.

    Parameters
    ----------
    fixed : Fixed
        The trains.
    instants : Instants
        The recorded ones.
    passage : Passage
        What is counted, after all that came before.
    steps : int
        How many rows of it, from the first on.
    counts : Counts
        Updated.
    """
    known, kept, seen = fixed.known, fixed.kept, passage
    for i in range(seen.position.shape[1]):
        c, run, j = counts.train[i], fixed.run[i], fixed.ahead[i]
        bits, fate = 0, GOES_ON
        for k in range(steps):
            x, v, u, moves, number = seen.position[k, i], seen.speed[k, i], seen.force[k, i], seen.moves[k], seen.number[k]
            if v < kept.speed_lower[i] - ROUNDING:
                bits |= SLOW
            if v > kept.speed_upper[i] + ROUNDING:
                bits |= FAST
            if moves:
                if u < kept.input_lower[i] - ROUNDING:
                    bits |= BRAKES
                if u > kept.input_upper[i] + ROUNDING:
                    bits |= PULLS
            if not (abs(x) < np.inf and abs(v) < np.inf):
                fate = NOT_FINITE
            if j >= 0 and not seen.position[k, j] - fixed.length[j] - x > TOUCH_M:
                fate = max(fate, TOUCHES)
            if number < 0:
                continue
            if number == 0:
                c[START] = x
            else:
                dt, middle = instants.dt[number], instants.middle[number]
                acceleration = (v - c[SPEED]) / dt
                c[ACCELERATION_MIN] = min(c[ACCELERATION_MIN], acceleration)
                c[ACCELERATION_MAX] = max(c[ACCELERATION_MAX], acceleration)
                if middle == middle:
                    jerk = abs((acceleration - c[ACCELERATION]) / middle)
                    c[JERK_MAX] = max(c[JERK_MAX], jerk)
                    c[JERK_SUM] += jerk * jerk * middle
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
            if moves:
                c[INPUT] = u
                c[INPUT_MIN], c[INPUT_MAX] = min(c[INPUT_MIN], u), max(c[INPUT_MAX], u)
                violated = violated or u - known.input_lower[i] < -SLACK or known.input_upper[i] - u < -SLACK
            if violated and not counts.first[run] <= instants.t[number]:
                counts.first[run] = instants.t[number]
            if seen.saturated[k, i]:
                c[SATURATED] += 1.0
            if j >= 0:
                spacing = seen.position[k, j] - x
                c[SPACING_MIN] = min(c[SPACING_MIN], spacing)
                c[SPACING_SUM] += spacing
                if v > MOVING_MPS:
                    headway = spacing / v
                    c[HEADWAY_MIN] = min(c[HEADWAY_MIN], headway)
                    c[HEADWAY_SUM] += headway
                    c[HEADWAYS] += 1.0
            error = v - instants.reference[number]
            c[SPEED_ERROR] = abs(error)
            if instants.level[number]:
                if instants.fresh[number]:
                    c[SIDE] = error
                beyond = abs(error) if c[SIDE] == 0.0 else (-error if c[SIDE] > 0.0 else error)
                c[OVERSHOOT] = max(c[OVERSHOOT], beyond)
        counts.violated[i] |= bits
        counts.fate[run] = max(counts.fate[run], fate)
    _links(fixed, seen, steps, counts)
    _pairs(fixed, instants, seen, steps, counts)


@bare(error_model="numpy")
def _links(fixed: Fixed, seen: Passage, steps: int, counts: Counts) -> None:
    links = fixed.links
    for q in range(len(links.sender)):
        ahead, behind = links.sender[q], links.receiver[q]
        for k in range(steps):
            spacing = seen.position[k, ahead] - seen.position[k, behind]
            if spacing > 0.0:  # each pair once
                if spacing < links.lower[q] - ROUNDING:
                    counts.link[q] |= NEAR
                if spacing > links.upper[q] + ROUNDING:
                    counts.link[q] |= FAR


@bare(error_model="numpy")
def _pairs(fixed: Fixed, instants: Instants, seen: Passage, steps: int, counts: Counts) -> None:
    pairs = fixed.pairs
    for q in range(len(pairs.run)):
        c, r, ahead, behind = counts.pair[q], pairs.run[q], pairs.ahead[q], pairs.behind[q]
        for k in range(steps):
            number = seen.number[k]
            if number < 0:
                continue
            spacing = seen.position[k, ahead] - seen.position[k, behind]
            error = spacing - pairs.desired[q]
            size = abs(error)
            if instants.counts[number]:
                c[LOWEST], c[HIGHEST] = min(c[LOWEST], spacing), max(c[HIGHEST], spacing)
                violated = spacing - pairs.lower[q] < -SLACK or pairs.upper[q] - spacing < -SLACK
                if violated and not counts.first[r] <= instants.t[number]:
                    counts.first[r] = instants.t[number]
            if number == 0:
                c[ERROR_SIDE] = error
            beyond = size if c[ERROR_SIDE] == 0.0 else (-error if c[ERROR_SIDE] > 0.0 else error)
            c[ERROR_OVERSHOOT] = max(c[ERROR_OVERSHOOT], beyond)
            c[ERROR_MAX] = max(c[ERROR_MAX], size)
            c[ERROR_SQUARES] += error * error
            c[ERROR_LAST] = size
            if size > fixed.band:
                counts.outside[r] = max(counts.outside[r], number)
