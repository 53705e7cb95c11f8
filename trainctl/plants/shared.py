"""Unit forces under a train-level law: the acceleration it asks for, held over the control period and shared out to the units.

Every unit carries its own mass's share, so couplers at rest stay at rest and the head moves exactly ``v T + a T**2 / 2``. What a
coupler carries beyond that is damped by pairs of forces that cancel within the train. The functions have the shape of a continuous
law, to be integrated with ``plants.coupled_units``; they also serve trains that the supervisor, or a driver, takes from such a law.

By installed force, as motor cars and trailers do, every unit gives the same part of what it can give: the train as a whole moves by
``a``, couplers carry what a unit gives more than its own mass needs, and swing about that as their own stiffness and damping let
them. There are no pairs of forces then: a trailer has no motor to damp its couplers with.

Symbols
-------
a_i         acceleration train i holds [m/s2]; where orders replace a law, NaN leaves the train to the law
mu, Mu      lower and upper bound of the input, force per mass [m/s2]
f, F        minimum and largest running resistance over the speed band [m/s2]
rho, Rho    lower and upper speed bound [m/s]
T           control period [s]
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from trainctl.davis import resistance, running_resistance
from trainctl.kernels import inlined
from trainctl.plants import coupled_units
from trainctl.plants.coupled_units import (
    BRAKING,
    BRAKING_POWER,
    C0,
    C1,
    C2,
    INERTIA,
    LENGTH,
    MASS,
    SLOPE,
    TRACTION,
    TRACTION_POWER,
    available,
    room,
    slope_at,
)
from trainctl.signals import GRAVITY, POSITION, SPEED, Bools, Consists, Floats, Ints, Links

CLOCK: Literal["continuous"] = "continuous"
ORDER: Literal["parallel"] = "parallel"
MESSAGE = 0
WATCHED: tuple[str, ...] = ()


class Constants(NamedTuple):
    """What the units believe of themselves, and the acceleration they hold."""

    first: Ints  # (n + 1,)
    units: Floats  # (U, 15) as in coupled_units
    gradient: Floats  # (G, 2)
    acceleration: Floats  # (n,) m/s2, overwritten once per control period, or for orders per step of the simulator
    stiffness: float  # 1/s2
    damping: float  # 1/s
    installed: Bools  # (n,) by installed force, not by mass


#: Fields of the constants that are written into: none.
WORK: tuple[str, ...] = ()

#: No train.
NOBODY = Constants(
    np.zeros(1, dtype=np.int64), np.zeros((0, SLOPE + 1)), np.zeros((0, 2)), np.zeros(0), 0.0, 0.0, np.zeros(0, np.bool_)
)


def constants(params: coupled_units.Params, consists: Consists, gradient: Floats | None = None) -> Constants:
    """Constants for these trains, all holding acceleration 0; the units believe the nominal running resistance."""
    first, units, slopes = coupled_units.constants(params, consists, gradient)
    held = np.zeros(len(first) - 1)
    stiffness, damping = params.in_train_stiffness_per_s2, params.in_train_damping_per_s
    return Constants(first, units, slopes, held, stiffness, damping, consists.by_installed_force())


@inlined()
def demand(
    i: int, constants: Constants, leader: Floats, age: float, slot: float, own: Floats, estimate: Floats, correction: Floats,
    desired: Floats, heard: Floats, out: Floats,
) -> None:  # fmt: skip
    """Write the unit forces [N] of train ``i`` for its held acceleration into ``out``: F_ij = m_ij (a_i + R + g slope) + pairs.

    The pairs, one per coupler, are scaled by one factor per train so that no unit leaves its limits because of them.
    """
    if constants.installed[i]:
        by_installed_force(i, constants, own, out)
        return
    start, a_i = constants.first[i], constants.acceleration[i]
    units, gradient = constants.units, constants.gradient
    last = len(out) - 1
    scale = 1.0
    pull = 0.0
    for j in range(last + 1):
        row = start + j
        v, m = own[j, SPEED], units[row, MASS]
        f = pair(constants, row, own, j) if j < last else 0.0
        load = running_resistance(v, units[row, C0], units[row, C1], units[row, C2])
        load += GRAVITY * (units[row, SLOPE] + slope_at(own[j, POSITION], gradient))
        base, extra = units[row, INERTIA] * a_i + m * load, pull - f
        out[j] = base + extra
        # A division only where the sum of both would leave a limit.
        if extra > 0.0:
            force, power, sign = units[row, TRACTION], units[row, TRACTION_POWER], 1.0
        else:
            force, power, sign = units[row, BRAKING], units[row, BRAKING_POWER], -1.0
        wanted = sign * (base + extra)
        if wanted > force or wanted * v > power:
            room = available(v, force, power) - sign * base
            if abs(extra) > max(room, 0.0):
                scale = min(scale, max(room, 0.0) / abs(extra))
        pull = f
    if scale < 1.0:
        for j in range(last):
            f = (1.0 - scale) * pair(constants, start + j, own, j)
            out[j] += f
            out[j + 1] -= f


@inlined()
def by_installed_force(i: int, constants: Constants, own: Floats, out: Floats) -> None:
    """Write the same part of what each unit of train ``i`` can give [N] into ``out``, so that the train moves by a_i."""
    start, units = constants.first[i], constants.units
    wanted = 0.0
    for j in range(len(out)):
        row = start + j
        load = running_resistance(own[j, SPEED], units[row, C0], units[row, C1], units[row, C2])
        load += GRAVITY * (units[row, SLOPE] + slope_at(own[j, POSITION], constants.gradient))
        wanted += units[row, INERTIA] * constants.acceleration[i] + units[row, MASS] * load
    given = 0.0
    for j in range(len(out)):
        row = start + j
        if wanted > 0.0:
            out[j] = available(own[j, SPEED], units[row, TRACTION], units[row, TRACTION_POWER])
        else:
            out[j] = available(own[j, SPEED], units[row, BRAKING], units[row, BRAKING_POWER])
        given += out[j]
    for j in range(len(out)):
        out[j] *= wanted / given


@inlined(inline="always")
def pair(constants: Constants, row: int, own: Floats, j: int) -> float:
    """Force [N] the active part of the coupler behind unit ``j`` pulls its two units together with."""
    e = own[j, POSITION] - own[j + 1, POSITION] - constants.units[row, LENGTH]
    de = own[j, SPEED] - own[j + 1, SPEED]
    lighter = min(constants.units[row, MASS], constants.units[row + 1, MASS])
    return float(lighter * (constants.stiffness * e + constants.damping * de))


@inlined()
def message(
    i: int, constants: Constants, leader: Floats, slot: float, own: Floats, estimate: Floats, estimate_rate: Floats, out: Floats
) -> None:
    """Nothing to send: trains talk in the sampled law."""


@inlined()
def watch(i: int, constants: Constants, leader: Floats, first: Ints, own: Floats, links: Links, out: Floats) -> None:
    """Nothing to watch here."""


def smallest_period(consists: Consists, speed: Floats, lower: Floats, upper: Floats) -> Floats:
    """Control period above which Assumption 2.4 of the fully distributed law holds with the units' own limits.

    Parameters
    ----------
    consists : Consists
        Units of all trains.
    speed, lower, upper : ndarray, shape (n,)
        Reference speed v_r and speed bounds rho, Rho of each train [m/s], rho < v_r < Rho.

    Returns
    -------
    ndarray, shape (n,)
        T = max((Rho - v_r) / (f - mu), (v_r - rho) / (Mu - F)) [s]; infinite where the units cannot hold the band at all, or where
        the speed is unbounded.
    """
    banded = np.isfinite(lower) & np.isfinite(upper)
    lower, upper = np.where(banded, lower, speed), np.where(banded, upper, speed)
    mu, Mu = room(consists, lower, upper)
    f, F = mean_resistance(consists, lower), mean_resistance(consists, upper)
    with np.errstate(divide="ignore", invalid="ignore"):
        period = np.maximum((upper - speed) / (f - mu), (speed - lower) / (Mu - F))
    return np.where(banded & (mu < f) & (Mu > F), period, np.inf)


def mean_resistance(consists: Consists, speed: Floats) -> Floats:
    """Compute the running resistance per mass [N/kg] of whole trains at these speeds, shape (n,): eq. (3) weighted by mass."""
    v = np.repeat(speed, np.diff(consists.first))
    r = resistance(v, consists.davis)
    total = np.add.reduceat(consists.mass * r, consists.first[:-1])
    return total / consists.train_mass()
