"""Power units joined by couplers: the EMU of Wei, Ge and Wu (2022), with unit limits, gradient and rotating masses.

Unit ``j`` of a train moves under its own force, the couplers before and behind it, running resistance and gradient.

Symbols
-------
x_j, v_j    position of the front [m], speed [m/s] of unit j, head first
u_j         force of the unit [N], forward positive
m_j         mass [kg]; ``rotating`` times that is what accelerates
l_j         front of unit j to front of unit j + 1 with the coupler at rest [m]
e_j         stretch of the coupler behind unit j [m], eq. (1)
k, d        stiffness [N/m] and damping [N s/m] of a coupler, eq. (2)
c0, c1, c2  Davis coefficients per mass, eq. (3)

Departures from the paper: limits, gradient, rotating masses and disturbances, which it has not, and standstill: resistance is zero
there and no unit is driven backwards, as if its brakes held it. A train therefore stops and stays, on any gradient.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydantic import Field

from trainctl.contracts import UnitPlant
from trainctl.davis import resistance, running_resistance
from trainctl.kernels import inlined
from trainctl.plants import faults as actuators
from trainctl.plants.faults import Fault
from trainctl.signals import GRAVITY, POSITION, SPEED, Consists, Floats, Ints, Reliance, Scene, Table

if TYPE_CHECKING:
    from trainctl.plants import coupled_units

    module: UnitPlant = coupled_units

UNITS, STATES = True, 2
COLUMNS: tuple[str, ...] = ()
CLAMPS: tuple[str, ...] = ()

#: Columns of ``Constants.units``; PER_INERTIA is 1 / INERTIA, since divisions took half the time of ``rate``.
MASS, INERTIA, PER_INERTIA, C0, C1, C2, LENGTH, STIFFNESS, DAMPING = range(9)
TRACTION, TRACTION_POWER, BRAKING, BRAKING_POWER, PUSH, SLOPE = range(9, 15)

#: A unit that an integration step carried below standstill comes back to it at this rate [1/s].
HOLD = 20.0


class Params(Table):
    """Keys of ``[plant]`` for units with couplers. They act where whole trains are told an acceleration, see ``plants.shared``."""

    in_train_stiffness_per_s2: float = Field(
        6.0, ge=0.0, description="Active part of the coupler stiffness under a law for whole trains, per unit mass [1/s2]"
    )
    in_train_damping_per_s: float = Field(
        4.0, ge=0.0, description="Active part of the coupler damping under a law for whole trains, per unit mass [1/s]"
    )


def violations(params: Params, scene: Scene, faults: Sequence[Fault] = ()) -> list[str]:
    """Every rule about this plant that fails; it has no actuators that fail."""
    return [*actuators.refused("coupled_units", faults), *too_stiff(params, scene)]


def too_stiff(params: Params, scene: Scene) -> list[str]:
    """What the active part of couplers asks of the integrator.

    The relative motion of the units of a train of equal ones has modes ``s**2 + a (d s + k) = 0`` with ``0 < a < 4``; classic
    Runge-Kutta steps of ``h`` keep ``4 d h`` and ``2 sqrt(k) h`` below 2.78, here 2.5.
    """
    h, found = scene.sub_step, []
    for key, most in (("in_train_damping_per_s", 0.625 / h), ("in_train_stiffness_per_s2", (1.25 / h) ** 2)):
        if getattr(params, key) > most * (1.0 + 1e-9):
            found.append(f"plant.{key} = {getattr(params, key):g}: at most {most:.6g} with integration steps of {h:g} s")
    return found


class Constants(NamedTuple):
    """What the units are and what acts on them."""

    first: Ints  # (n + 1,) rows of each train
    units: Floats  # (U, 15) one column per constant named above
    gradient: Floats  # (G, 2) position where a slope begins [m], rise / run; the first reaches back without end


def constants(
    params: Params, consists: Consists, gradient: Floats | None = None, resistance_factor: Floats | None = None,
    faults: Sequence[Fault] = (), trains: Sequence[str] = (),
) -> Constants:  # fmt: skip
    """Pack the constants of all units into one table.

    Parameters
    ----------
    params : Params
        Not needed by the motion itself.
    consists : Consists
        Units of all trains.
    gradient : ndarray, shape (G, 2), optional
        Position where a slope begins [m], ascending, and its rise / run; flat if left out.
    resistance_factor : ndarray, shape (U,), optional
        True running resistance over the nominal one; 1 if left out.
    faults, trains
        Nothing here fails.

    Returns
    -------
    Constants
        The columns ``PUSH``, a disturbing force per mass [m/s2], and ``SLOPE``, rise / run besides that of ``gradient``,
        are 0 here; they may be overwritten between steps.
    """
    factor = np.ones(len(consists.mass)) if resistance_factor is None else resistance_factor
    inertia = consists.mass * consists.rotating
    units = np.column_stack([
        consists.mass, inertia, 1.0 / inertia, consists.davis * factor[:, None], consists.length, consists.stiffness,
        consists.damping, consists.traction, consists.traction_power, consists.braking, consists.braking_power,
        np.zeros(len(inertia)), np.zeros(len(inertia)),
    ])  # fmt: skip
    slopes = np.zeros((0, 2)) if gradient is None else np.ascontiguousarray(gradient, dtype=np.float64)
    return Constants(consists.first, np.ascontiguousarray(units, dtype=np.float64), slopes)


@inlined()
def slope_at(x: float, gradient: Floats) -> float:
    """Rise / run at position ``x``."""
    if len(gradient) == 0:
        return 0.0
    low, high = 0, len(gradient)
    while high - low > 1:
        middle = (low + high) // 2
        if gradient[middle, 0] <= x:
            low = middle
        else:
            high = middle
    return gradient[low, 1]  # type: ignore[no-any-return]


@inlined(inline="always")
def available(v: float, force: float, power: float) -> float:
    """Largest force at speed ``v`` [N] of a unit limited by ``force`` [N] and ``power`` [W]."""
    return power / v if v > 0.0 and v * force > power else force


@inlined()
def limit(i: int, constants: Constants, own: Floats, applied: Floats) -> bool:
    """Clip the forces of train ``i`` to force and power limits of its units, in place; True if one acted."""
    a = constants.first[i]
    units = constants.units
    acted = False
    for j in range(len(applied)):
        v, u = own[j, SPEED], applied[j]
        if u > 0.0:
            force, power, sign = units[a + j, TRACTION], units[a + j, TRACTION_POWER], 1.0
        else:
            force, power, sign = units[a + j, BRAKING], units[a + j, BRAKING_POWER], -1.0
        if sign * u > force or sign * u * v > power:  # a division only where a limit acts
            most = available(v, force, power)
            applied[j] = sign * most
            acted = acted or sign * u > most * (1.0 + 1e-9)  # a force meant to be just the limit is not cut
    return acted


@inlined()
def rate(i: int, constants: Constants, t: float, inside: float, own: Floats, applied: Floats, out: Floats, power: Floats) -> None:
    """Write speed and acceleration of every unit of train ``i`` into ``out``, the train's powers into ``power``: eqs. (1)-(4).

    Parameters
    ----------
    i : int
        The train.
    constants : Constants
        Of all trains.
    t, inside : float
        Time [s]; nothing here depends on it.
    own : ndarray, shape (units, 2)
        Position [m] and speed [m/s].
    applied : ndarray, shape (units,)
        Force of each unit [N], within its limits.
    out : ndarray, shape (units, 2)
        Speed [m/s] and acceleration [m/s2].
    power : ndarray, shape (6,)
        See ``signals.POWERS`` [W].

    Notes
    -----
    Departs from the paper: at standstill a unit is held unless what acts on it drives it forward.
    """
    a, last = constants.first[i], len(applied) - 1
    units, gradient = constants.units, constants.gradient
    traction = braking = resistance = damping = climb = disturbance = 0.0
    pull = 0.0  # f(e_{j-1}): the coupler before this unit, stretched positive
    for j in range(last + 1):  # slopes apart: their search would keep the loop below from being unrolled
        out[j, SPEED] = units[a + j, SLOPE] + slope_at(own[j, POSITION], gradient)
    for j in range(last + 1):
        row = a + j
        v, u, m = own[j, SPEED], applied[j], units[row, MASS]
        f = 0.0
        if j < last:
            e = own[j, POSITION] - own[j + 1, POSITION] - units[row, LENGTH]
            de = v - own[j + 1, SPEED]
            f = units[row, STIFFNESS] * e + units[row, DAMPING] * de
            damping += units[row, DAMPING] * de * de
        drag = m * running_resistance(v, units[row, C0], units[row, C1], units[row, C2])
        weight = m * GRAVITY * out[j, SPEED]
        push = m * units[row, PUSH]
        acceleration = (u + pull - f - drag - weight + push) * units[row, PER_INERTIA]
        out[j, POSITION] = v
        out[j, SPEED] = acceleration if v > 0.0 else max(acceleration, -HOLD * v)
        if u > 0.0:
            traction += u * v
        else:
            braking -= u * v
        resistance += drag * v
        climb += weight * v
        disturbance += push * v
        pull = f
    power[0] = traction
    power[1] = braking
    power[2] = resistance
    power[3] = damping
    power[4] = climb
    power[5] = disturbance


# What trains of units say of themselves


def lead(steps: int) -> float:
    """Theta: under a held acceleration the head moves exactly ``v T + a T**2 / 2``, however long it is held."""
    return 0.5


def balanced(own: Floats, consists: Consists, gradient: Floats | None = None) -> Floats:
    """Forces are no state here."""
    return own


def noise_hold(params: Params) -> None:
    """No noise of its own."""
    return


def make_noise(params: Params, constants: Constants, seed: int, sample: int | None) -> None:
    """No noise of its own."""


def columns(
    constants: Constants, t: float, own: Floats, applied: Floats, fault_estimate: Floats, acceleration_estimate: Floats
) -> tuple[Floats, ...]:
    """Nothing but what every plant of units has."""
    return ()


def room(consists: Consists, lower: Floats, upper: Floats) -> tuple[Floats, Floats]:
    """Input that every unit of a train can always give in a speed band, whatever the speed: mu and Mu of Assumption 2.4.

    Parameters
    ----------
    consists : Consists
        Units of all trains.
    lower, upper : ndarray, shape (n,)
        Speed band of each train, rho and Rho [m/s].

    Returns
    -------
    tuple of ndarray, each of shape (n,)
        Lower and upper bound of the input, acceleration plus the train's mean running resistance [m/s2]; infinite where the speed
        is unbounded, since nothing follows then.

    Notes
    -----
    Each unit carries its own mass's share, so the unit weakest per mass decides, traction at the speed where power leaves the
    minimum. Where rotating mass or Davis coefficients differ between units, their share of the input does too: it is taken at
    161 speeds of the band. Where the force is shared out by installed force the train gives all that its units have.
    """
    low, high = np.full(len(lower), -np.inf), np.full(len(lower), np.inf)
    together = consists.by_installed_force()
    for i, (a, b) in enumerate(pairwise(consists.first)):
        if not np.isfinite([lower[i], upper[i]]).all():
            continue
        speeds = np.linspace(max(lower[i], 0.0), upper[i], 161)[:, None]
        m, rotating = consists.mass[a:b], consists.rotating[a:b]
        r = resistance(speeds, consists.davis[a:b])
        mean = (r @ m / m.sum())[:, None]
        with np.errstate(divide="ignore"):
            traction = np.minimum(consists.traction[a:b], consists.traction_power[a:b] / speeds) / m
            braking = np.minimum(consists.braking[a:b], consists.braking_power[a:b] / speeds) / m
        if together[i]:
            inertia = float(m @ rotating)
            high[i] = (((traction - r) @ m)[:, None] / inertia + mean).min()
            low[i] = (((-braking - r) @ m)[:, None] / inertia + mean).max()
            continue
        high[i] = ((traction - r) / rotating + mean).min()
        low[i] = ((-braking - r) / rotating + mean).max()
    return low, high


def sure_braking(params: Any, consists: Consists, top: Floats) -> Floats:
    """Deceleration every train can give on the level at any speed up to ``top`` (n,) [m/s2], shape (n,)."""
    minimum, _ = room(consists, np.zeros_like(top), top)
    return -minimum


def relied_on(
    params: Params, consists: Consists, faults: Sequence[Fault], trains: Sequence[str], braking: float, top: Floats, fall: Floats,
    deviations: float,
) -> Reliance:  # fmt: skip
    """As ``contracts.Plant`` says: units act at once, each as far as its own brakes and faults let it."""
    share, bias = actuators.shares(faults, trains, consists)
    units, leading = np.diff(consists.first), consists.first[:-1]
    inertia = consists.mass * consists.rotating
    total = np.add.reduceat(inertia, leading)
    fastest = np.maximum(np.repeat(top, units), 1e-9)
    force = np.minimum(consists.braking, consists.braking_power / fastest)
    down, weight = np.repeat(fall, units), np.add.reduceat(consists.mass, leading)
    needed = inertia * braking + consists.mass * down
    all_of, every = np.add.reduceat(force, leading), np.add.reduceat(needed, leading)
    part = np.repeat(np.minimum(every / all_of, 1.0), units)  # of its force, by installed force; infinite ones give what is needed
    own_part = np.repeat(consists.by_installed_force(), units) & np.isfinite(force)
    give = np.where(own_part, np.where(np.isfinite(force), force, 0.0) * part, np.minimum(force, needed))
    given = np.add.reduceat(share * give, leading) - weight * fall
    strongest = np.minimum(consists.traction, consists.traction_power / fastest)  # may be infinite, and a share 0
    pull = np.add.reduceat(np.multiply(share, strongest, out=np.zeros_like(share), where=share > 0.0), leading)
    zero = np.zeros(len(top))
    return Reliance(given / total, pull / consists.train_mass(), np.add.reduceat(bias, leading) / total, zero, zero, zero)
