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
from typing import NamedTuple

import numpy as np
from numba import njit
from pydantic import Field

from trainctl.plants.faults import Fault, Faults, effectiveness, fault_rate, tabulated
from trainctl.plants.faults import violations as fault_violations
from trainctl.signals import FORCE, POSITION, SPEED, Consists, Floats, Scene, Table

STATES = 3


class Params(Table):
    """Keys of ``[plant]`` with ``kind = "actuated_units"``."""

    noise_variance_m2_per_s6: float = Field(
        0.0, ge=0, description="Variance of Gaussian noise in the jerk of every unit [m2/s6]; 0.5 in the paper, needs [run] seed."
    )
    noise_hold_s: float = Field(0.1, gt=0, description="Time one sample of the noise is held [s].")


class Constants(NamedTuple):
    """The plant's constants. ``noise`` is overwritten in place whenever a new sample begins."""

    consists: Consists
    faults: Faults
    noise: Floats  # (U,) m/s3


def violations(params: Params, scene: Scene, faults: Sequence[Fault] = ()) -> list[str]:
    """Every rule about this plant that fails."""
    found = fault_violations(faults, scene.trains, scene.consists)
    first, rate = scene.consists.first, scene.consists.actuator_rate
    for i, train in enumerate(scene.trains):
        least = rate[first[i] : first[i + 1]].min()
        if least <= 0.0:
            found.append(f"actuator_rate_per_s = {least:g}: must be above 0 for train {train} in actuated_units")
    samples = params.noise_hold_s / scene.sub_step
    if params.noise_variance_m2_per_s6 > 0.0 and abs(samples - round(samples)) > 1e-6:
        found.append(
            f"plant.noise_hold_s = {params.noise_hold_s:g}: must be a multiple of the integrator's step, {scene.sub_step:g} s"
        )
    return found


def constants(params: Params, scene: Scene, faults: Sequence[Fault] = ()) -> Constants:
    """Return the plant's constants, with no noise yet."""
    table = tabulated(faults, scene.trains, scene.consists)
    return Constants(scene.consists, table, np.zeros(len(scene.consists.mass)))


def noise(params: Params, seed: int, sample: int, units: int) -> Floats:
    """Gaussian jerk of every unit in one holding interval, a pure function of seed and sample number.

    Parameters
    ----------
    params : Params
        Variance [m2/s6].
    seed : int
        Of the run.
    sample : int
        Number of the interval: its start is ``sample * noise_hold_s``.
    units : int
        Of all trains.

    Returns
    -------
    ndarray, shape (units,)
        [m/s3]

    Notes
    -----
    The paper says "Gaussian, mean 0, variance 0.5" and no more. Read as a jerk, held for 0.1 s: in newtons it would be invisible,
    in m/s2 or in the measured speed nothing would work.
    """
    draw = np.random.Generator(np.random.Philox(key=seed, counter=[sample, 0, 0, 0])).standard_normal(units)
    return math.sqrt(params.noise_variance_m2_per_s6) * draw


def balanced(own: Floats, consists: Consists) -> Floats:
    """Own states (U, 3) with the forces that hold the units' accelerations at 0 in this instant: tau(0) of the paper.

    Parameters
    ----------
    own : ndarray, shape (U, 2) or (U, 3)
        Positions [m] and speeds [m/s].
    consists : Consists
        Of all trains.
    """
    state = np.zeros((len(own), STATES))
    state[:, :FORCE] = own[:, :FORCE]
    table = tabulated([], [], consists)
    still = Constants(consists, table, np.zeros(len(own)))
    out, power = np.zeros_like(state), np.zeros(6)
    for i in range(len(consists.first) - 1):
        rows = slice(consists.first[i], consists.first[i + 1])
        rate(i, still, 0.0, 0.0, state[rows], np.zeros(rows.stop - rows.start), out[rows], power)
    state[:, FORCE] = -out[:, SPEED] * consists.mass * consists.rotating
    return state


@njit(cache=True)
def limit(i: int, constants: Constants, own: Floats, applied: Floats) -> bool:
    """Clip the demanded forces to effort and power of each unit; True if a limit acted."""
    c = constants.consists
    acted = False
    for j in range(len(applied)):
        u = c.first[i] + j
        v = max(abs(own[j, SPEED]), 1e-3)
        high, low = min(c.traction[u], c.traction_power[u] / v), -min(c.braking[u], c.braking_power[u] / v)
        if applied[j] > high:
            applied[j] = high
            acted = True
        elif applied[j] < low:
            applied[j] = low
            acted = True
    return acted


@njit(cache=True)
def rate(
    i: int, constants: Constants, t: float, inside: float, own: Floats, applied: Floats, out: Floats, power: Floats
) -> None:
    """d(own)/dt, eqs. (1), (2), and the train's powers [W]: see ``signals.Plant``.

    Faults and noise act on the force, so they are part of traction and braking power.
    """
    c = constants.consists
    for p in range(len(power)):
        power[p] = 0.0
    for j in range(len(applied)):
        u = c.first[i] + j
        v, tau = own[j, SPEED], own[j, FORCE]
        inertia = c.mass[u] * c.rotating[u]
        resistance = c.mass[u] * running_resistance(v, c.davis[u, 0], c.davis[u, 1], c.davis[u, 2])
        out[j, POSITION] = v
        out[j, SPEED] = tau - resistance
        fault = fault_rate(constants.faults, u, t, inside)
        share = effectiveness(constants.faults, u, inside)
        out[j, FORCE] = c.actuator_rate[u] * (share * applied[j] - tau) + fault + inertia * constants.noise[u]
        power[0] += max(tau * v, 0.0)
        power[1] += max(-tau * v, 0.0)
        power[2] += resistance * v
    for j in range(len(applied) - 1):
        u = c.first[i] + j
        closing = own[j, SPEED] - own[j + 1, SPEED]
        pull = c.stiffness[u] * (own[j, POSITION] - own[j + 1, POSITION] - c.length[u]) + c.damping[u] * closing
        out[j, SPEED] -= pull
        out[j + 1, SPEED] += pull
        power[3] += c.damping[u] * closing * closing
    for j in range(len(applied)):
        u = c.first[i] + j
        out[j, SPEED] /= c.mass[u] * c.rotating[u]


@njit(cache=True)
def running_resistance(v: float, c0: float, c1: float, c2: float) -> float:
    """Davis resistance [N/kg] against the motion. Departs from the paper at standstill and backwards, where it is odd."""
    if v == 0.0:
        return 0.0
    return (c0 if v > 0.0 else -c0) + c1 * v + c2 * v * abs(v)


@njit(cache=True)
def fault(constants: Constants, t: float, applied: Floats, out: Floats) -> None:
    """Write what the faults do to the jerk of every unit [m/s3] into ``out`` (U,), for logs: f' of the paper plus lost demand."""
    c = constants.consists
    for u in range(len(out)):
        lost = (1.0 - effectiveness(constants.faults, u, t)) * c.actuator_rate[u] * applied[u]
        out[u] = (fault_rate(constants.faults, u, t, t) - lost) / (c.mass[u] * c.rotating[u])
