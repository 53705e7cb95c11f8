"""Third-order trains: coupled units whose forces follow their demands through first-order actuators that can fail.

Eqs. (1), (2) of [1]_, with the demand as a force (``varpi / r`` there): limits are limits of force. Units, masses, couplers and
actuator rates may all differ; rotating masses add inertia. A loss of effectiveness and the total loss of an actuator go beyond
the paper.

Symbols
-------
=========  ===========================================================================================
x, v, tau  front position [m], speed [m/s] and actuator force [N] of a unit
m          inertia [kg]: mass times rotating-mass factor
B          force into the couplers [N]
R          running resistance [N/kg]
r          actuator rate [1/s]
E f        fault [N/s]; eta effectiveness
=========  ===========================================================================================

References
----------
.. [1] Zhang, Chen, "Asymptotical Cooperative Cruise Fault Tolerant Control for Multiple High-speed Trains with State
   Constraints".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from pydantic import Field

from trainctl import draws
from trainctl.contracts import UnitPlant
from trainctl.davis import running_resistance
from trainctl.kernels import bare, inlined
from trainctl.plants import coupled_units
from trainctl.plants.coupled_units import (
    BRAKING,
    BRAKING_POWER,
    C0,
    C1,
    C2,
    DAMPING,
    HOLD,
    INERTIA,
    LENGTH,
    MASS,
    PUSH,
    SLOPE,
    STIFFNESS,
    TRACTION,
    TRACTION_POWER,
    available,
    slope_at,
)
from trainctl.plants.coupled_units import lead as lead
from trainctl.plants.coupled_units import room as room
from trainctl.plants.coupled_units import sure_braking as sure_braking
from trainctl.plants.faults import Fault, Faults, effectiveness, fault_rate, tabulated
from trainctl.plants.faults import violations as fault_violations
from trainctl.signals import FORCE, GRAVITY, POSITION, SPEED, Consists, Floats, Ints, Reliance, Scene

if TYPE_CHECKING:
    from trainctl.plants import actuated_units

    module: UnitPlant = actuated_units

UNITS, STATES = True, 3
COLUMNS: tuple[str, ...] = (
    "law_input", "fault_mps3", "fault_estimate_mps3", "acceleration_mps2", "acceleration_estimate_mps2",
)  # fmt: skip
CLAMPS: tuple[str, ...] = ()

#: Columns of ``Constants.units`` behind those of ``coupled_units``: actuator rate [1/s], noise in the jerk [m/s3].
RATE, NOISE = SLOPE + 1, SLOPE + 2


class Params(coupled_units.Params):
    """Keys of ``[plant]`` with ``kind = "actuated_units"``, beside those of ``coupled_units``."""

    in_train_stiffness_per_s2: float = Field(
        0.0, ge=0.0, description="As in coupled_units; at most half the damping times the slowest actuator rate [1/s2]"
    )
    noise_variance_m2_per_s6: float = Field(
        0.0, ge=0, description="Variance of Gaussian noise in the jerk of every unit [m2/s6]; 0.5 in the paper, needs [run] seed."
    )
    noise_hold_s: float = Field(0.1, gt=0, description="Time one sample of the noise is held [s].")


class Constants(NamedTuple):
    """The plant's constants. Columns ``PUSH``, ``SLOPE`` and ``NOISE`` of ``units`` may be overwritten in place between steps."""

    first: Ints  # (n + 1,)
    units: Floats  # as in coupled_units, then RATE, NOISE
    gradient: Floats  # (G, 2) as in coupled_units
    faults: Faults
    names: Ints  # (U, 2) whose noise is whose: see ``named``


def violations(params: Params, scene: Scene, faults: Sequence[Fault] = ()) -> list[str]:
    """Every rule about this plant that fails."""
    found = [*coupled_units.too_stiff(params, scene), *fault_violations(faults, scene.trains, scene.consists)]
    first, rate = scene.consists.first, scene.consists.actuator_rate
    for i, train in enumerate(scene.trains):
        minimum = rate[first[i] : first[i + 1]].min()
        if minimum <= 0.0:
            found.append(f"actuator_rate_per_s = {minimum:g}: must be above 0 for train {train} in actuated_units")
    # Stiffness through a first-order lag swings up: s**3 + r s**2 + a r (d s + k) = 0 is stable for k < r d, whatever a > 0.
    most = 0.5 * params.in_train_damping_per_s * float(rate.min())
    if params.in_train_stiffness_per_s2 > most:
        found.append(
            f"plant.in_train_stiffness_per_s2 = {params.in_train_stiffness_per_s2:g}: at most {most:.6g}, half of"
            " in_train_damping_per_s times the slowest actuator rate: forces that come late make couplers swing"
        )
    samples = params.noise_hold_s / scene.sub_step
    if params.noise_variance_m2_per_s6 > 0.0 and abs(samples - round(samples)) > 1e-6:
        found.append(
            f"plant.noise_hold_s = {params.noise_hold_s:g}: must be a multiple of the integrator's step, {scene.sub_step:g} s"
        )
    return found


def constants(
    params: Params, consists: Consists, gradient: Floats | None = None, resistance_factor: Floats | None = None,
    faults: Sequence[Fault] = (), trains: Sequence[str] = (),
) -> Constants:  # fmt: skip
    """Pack the constants of all units, with no noise yet.

    Parameters
    ----------
    params : Params
        Not needed by the motion itself.
    consists, gradient, resistance_factor
        As in ``coupled_units``.
    faults : sequence of Fault
        That ``violations`` has not refused.
    trains : sequence of str
        Ids that the faults name, and by which noise is drawn, in the order of ``consists``.
    """
    first, units, slopes = coupled_units.constants(params, consists, gradient, resistance_factor)
    units = np.column_stack([units, consists.actuator_rate, np.zeros(len(units))])
    return Constants(first, np.ascontiguousarray(units), slopes, tabulated(faults, trains, consists), named(trains, first))


def noise(params: Params, seed: int, sample: int, units: int | Ints) -> Floats:
    """Gaussian jerk of every unit in one holding interval, a pure function of seed, sample number and unit.

    Parameters
    ----------
    params : Params
        Variance [m2/s6].
    seed : int
        Of the run.
    sample : int
        Number of the interval: it begins at ``sample * noise_hold_s``.
    units : int or ndarray of int, shape (U, 2)
        ``Constants.names``: a word for the train and the unit's number in it. Or so many units of one nameless train.

    Returns
    -------
    ndarray, shape (U,)
        For the column ``NOISE`` of ``Constants.units`` [m/s3].

    Notes
    -----
    The paper says "Gaussian, mean 0, variance 0.5" and no more. Read as a jerk, held for 0.1 s: in newtons it would be invisible,
    in m/s2 or in the measured speed nothing would work.
    """
    names = named((), np.array([0, units])) if isinstance(units, int) else units
    draw: Floats = draws.normal(seed, draws.NOISE, np.array([sample]), names)[0]
    return math.sqrt(params.noise_variance_m2_per_s6) * draw


def named(trains: Sequence[str], first: Ints) -> Ints:
    """Two words for every unit, shape (U, 2): of its train, its place where ``trains`` is empty, and its number in the train."""
    words = [draws.word(name) for name in trains] or list(range(len(first) - 1))
    count = np.diff(first)
    return np.column_stack([np.repeat(np.array(words, np.int64), count), np.arange(first[-1]) - np.repeat(first[:-1], count)])


def noise_hold(params: Params) -> float | None:
    """Time one sample of the noise is held [s]; None without noise."""
    return params.noise_hold_s if params.noise_variance_m2_per_s6 > 0.0 else None


def make_noise(params: Params, constants: Constants, seed: int, sample: int | None) -> None:
    """Overwrite the column ``NOISE`` with the sample of that number, or with none."""
    constants.units[:, NOISE] = 0.0 if sample is None else noise(params, seed, sample, constants.names)


def balanced(own: Floats, consists: Consists, gradient: Floats | None = None) -> Floats:
    """Own states (U, 3) whose forces hold every unit's acceleration at 0 in this instant: tau(0) of the paper.

    Parameters
    ----------
    own : ndarray, shape (U, 2) or (U, 3)
        Positions [m] and speeds [m/s].
    consists, gradient
        As in ``constants``.
    """
    state = np.zeros((len(own), STATES))
    state[:, :FORCE] = own[:, :FORCE]
    still = constants(Params(), consists, gradient)
    out = np.zeros_like(state)
    _rates(still, 0.0, state, np.zeros(len(state)), out, np.zeros(6))
    state[:, FORCE] = np.where(state[:, SPEED] > 0.0, -out[:, SPEED] * consists.mass * consists.rotating, 0.0)
    return state


@inlined()
def limit(i: int, constants: Constants, own: Floats, applied: Floats) -> bool:
    """Clip the demanded forces to effort and power of each unit, in place; True if one acted."""
    acted = False
    for j in range(len(applied)):
        row = constants.units[constants.first[i] + j]
        high = available(own[j, SPEED], row[TRACTION], row[TRACTION_POWER])
        low = -available(own[j, SPEED], row[BRAKING], row[BRAKING_POWER])
        if applied[j] > high:
            applied[j] = high
            acted = True
        elif applied[j] < low:
            applied[j] = low
            acted = True
    return acted


@inlined()
def rate(i: int, constants: Constants, t: float, inside: float, own: Floats, applied: Floats, out: Floats, power: Floats) -> None:
    """d(own)/dt, eqs. (1), (2), and the train's powers [W]: see ``contracts.Plant``.

    Faults and noise act on the force, so they are part of traction and braking power.

    Notes
    -----
    Departs from the paper: a unit that stands is held unless what acts on it overcomes the resistance of slow motion, c0.
    """
    a, last = constants.first[i], len(applied) - 1
    traction = braking = resistance = damping = climb = disturbance = 0.0
    pull = 0.0  # of the coupler before this unit
    for j in range(last + 1):  # slopes and faults apart: their searches would keep the loop below from being unrolled
        unit = constants.units[a + j]
        out[j, SPEED] = unit[SLOPE] + slope_at(own[j, POSITION], constants.gradient)
        fault = fault_rate(constants.faults, a + j, t, inside) + unit[INERTIA] * unit[NOISE]
        out[j, FORCE] = unit[RATE] * (effectiveness(constants.faults, a + j, inside) * applied[j] - own[j, FORCE]) + fault
    for j in range(last + 1):
        unit = constants.units[a + j]
        v, tau = own[j, SPEED], own[j, FORCE]
        rear = 0.0
        if j < last:
            closing = v - own[j + 1, SPEED]
            rear = unit[STIFFNESS] * (own[j, POSITION] - own[j + 1, POSITION] - unit[LENGTH]) + unit[DAMPING] * closing
            damping += unit[DAMPING] * closing * closing
        drag = unit[MASS] * running_resistance(v, unit[C0], unit[C1], unit[C2])
        weight = unit[MASS] * GRAVITY * out[j, SPEED]
        push = unit[MASS] * unit[PUSH]
        acceleration = (tau + pull - rear - drag - weight + push) / unit[INERTIA]
        out[j, POSITION] = v
        if v <= 0.0:  # whoever moves off meets the resistance of motion: without it a unit would start and stop for ever
            acceleration = max(acceleration - unit[MASS] * unit[C0] / unit[INERTIA], -HOLD * v)
        out[j, SPEED] = acceleration
        traction += max(tau * v, 0.0)
        braking += max(-tau * v, 0.0)
        resistance += drag * v
        climb += weight * v
        disturbance += push * v
        pull = rear
    power[0] = traction
    power[1] = braking
    power[2] = resistance
    power[3] = damping
    power[4] = climb
    power[5] = disturbance


def fault(constants: Constants, t: float, applied: Floats) -> Floats:
    """What the faults do to the jerk of every unit [m/s3], for logs: f' of the paper and the demand that is lost.

    Parameters
    ----------
    constants : Constants
        Of the plant.
    t : float
        Time [s].
    applied : ndarray, shape (U,)
        Demanded forces after the limits [N].
    """
    out = np.empty(len(applied))
    _faults(constants, t, applied, out)
    return out


@bare(error_model="numpy")
def _faults(constants: Constants, t: float, applied: Floats, out: Floats) -> None:
    for u in range(len(applied)):
        unit = constants.units[u]
        lost = (1.0 - effectiveness(constants.faults, u, t)) * unit[RATE] * applied[u]
        out[u] = (fault_rate(constants.faults, u, t, t) - lost) / unit[INERTIA]


@bare(error_model="numpy")
def _rates(constants: Constants, t: float, own: Floats, applied: Floats, out: Floats, power: Floats) -> None:
    """``rate`` of all trains; ``power`` (6,) is work space."""
    for i in range(len(constants.first) - 1):
        a, b = constants.first[i], constants.first[i + 1]
        rate(i, constants, t, t, own[a:b], applied[a:b], out[a:b], power)


def columns(
    constants: Constants, t: float, own: Floats, applied: Floats, fault_estimate: Floats, acceleration_estimate: Floats
) -> tuple[Floats, ...]:
    """Values of ``COLUMNS`` at ``t``, (U,) each."""
    out = np.empty_like(own)
    _rates(constants, t, own, applied, out, np.empty(6))
    return applied, fault(constants, t, applied), fault_estimate, out[:, SPEED], acceleration_estimate


def relied_on(
    params: Params, consists: Consists, faults: Sequence[Fault], trains: Sequence[str], braking: float, top: Floats, fall: Floats,
    deviations: float,
) -> Reliance:  # fmt: skip
    """As ``contracts.Plant`` says: what coupled units give comes late, and noise comes on top."""
    found = coupled_units.relied_on(params, consists, faults, trains, braking, top, fall, deviations)
    davis, lag = consists.train_davis(), np.maximum.reduceat(1.0 / consists.actuator_rate, consists.first[:-1])
    # Resistance falls as the train slows down, and the actuators follow late.
    late = lag * braking * (davis[:, 1] + 2.0 * davis[:, 2] * top)
    keeps = np.exp(-params.noise_hold_s / lag)
    noise = deviations * math.sqrt(params.noise_variance_m2_per_s6) * lag * np.sqrt((1.0 - keeps) / (1.0 + keeps))
    return found._replace(late=late, noise=noise, lag=lag)
