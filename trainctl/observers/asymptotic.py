"""Asymptotic observer of acceleration and actuator fault from measured position and speed: eqs. (13), (14) of [1]_.

The fault model is a constant and any number of sinusoids, ``f' = S f``; the error then obeys a linear law with one chosen pole.
What the law reads is in ``correction``: the right-hand sides of (13) before the input, and the force that (5) holds in reserve.

Symbols
-------
=============  ===============================================================================================
x, v, w, f     position [m], speed [m/s], acceleration [m/s2], fault states; hats are estimates, e = hat - true
remembered     fault states of the unit when it last ran; what f goes back to while it is held
mu1, mu2, mu3  corrections of the estimates, eq. (14)
k1 .. k4       gains; k4 has one row per unit, one column per fault state
C              row that turns fault states into jerk [m/s3], E / m
S              blocks 0 and [[0, omega], [-omega, 0]]
B1, B2, B3     the model's coefficients of w_j, w_(j-1), w_(j+1), eq. (4)
u              jerk input [m/s3], eq. (5)
p              the observer's pole, n times
=============  ===============================================================================================

Departures from [1]_
--------------------
* (17) prints D1 without ``-r v``. Its derivative must be B1, which contains ``-r``: without it the observer is unstable.
* At standstill the resistance is zero, as in the plant, and a unit that the plant holds there is known to stand: its estimates
  settle on that with ``SETTLE``. What the law reads is the motion it would have if it were let go from there. Uncorrected
  measurements of a unit that does not follow its forces would wind the estimates up.
* The fault states of a unit that is held settle on what they were when it last ran, carried on as (3) says: ``remembered`` follows
  them with ``LEARN`` above ``RUNS`` only. A unit let go for less time than the observer needs (n / |p|) corrects its fault
  states in the wrong direction; kept from stop to stop, that grew without bound in a train that creeps by short pulls.

References
----------
.. [1] Zhang, Chen, "Asymptotical Cooperative Cruise Fault Tolerant Control for Multiple High-speed Trains with State
   Constraints".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
from pydantic import Field

from trainctl.carriages import Numbers, miscounted, spread
from trainctl.contracts import Observer
from trainctl.davis import running_resistance
from trainctl.kernels import inlined
from trainctl.signals import POSITION, SPEED, Bools, Consists, Floats, Ints, Scene, Table

if TYPE_CHECKING:
    from trainctl.observers import asymptotic

    module: Observer = asymptotic

CORRECTIONS = 5

#: Columns of ``estimate``; the fault states follow, then those remembered.
X, V, W, F = 0, 1, 2, 3

#: Columns of ``correction``: hat x', hat v', hat w' without the input, the part of the last one that the law leaves alone [m/s3],
#: and the force of (5) at u = 0 [N].
X_RATE, V_RATE, W_DRIFT, UNCOMPENSATED, STATIC = 0, 1, 2, 3, 4


Pole = Annotated[float, Field(lt=0)]
Poles = Pole | tuple[Pole, ...]

#: How fast estimates of a unit that is held settle on standstill [1/s].
SETTLE = 20.0

#: Speed above which a unit's fault states are remembered [m/s], and how fast [1/s]: no train gets there before they have settled.
RUNS, LEARN = 2.0, 0.5


class Params(Table):
    """Keys of ``[observer]`` with ``kind = "asymptotic"``. ``compensate = false`` is the paper's law without fault tolerance."""

    pole_per_s: Poles = Field(-3.0, description="The observer's pole, for all its states [1/s]; one number or one per carriage")
    fault_constant_n_per_s: Numbers = Field(
        2e5, description="upsilon, jerk force per unit of the constant fault state [N/s]; one number or one per carriage"
    )
    fault_sinusoids: tuple[Annotated[tuple[Numbers, Numbers], Field(strict=False)], ...] = Field(
        ((1.0, 2e5),), strict=False,
        description="[[omega_rad_per_s, nu_omega_n_per_s], ...]: sinusoids of the fault model; each one number or one per carriage",
    )  # fmt: skip
    compensate: bool = Field(True, description="false: the fault estimate is left out of the control")
    start_offset_position_m: float = Field(0.0, description="Error of the position estimates at the start [m]; 0: as measured")
    start_offset_speed_mps: float = Field(0.0, description="Error of the speed estimates at the start [m/s]; 0: as measured")


#: Columns of ``Train.units``. FRONT and REAR are B2 and B3 of eq. (4), b / m of the couplers before and behind [1/s].
LENGTH, MASS, C0, C1, C2, STIFFNESS, DAMPING, RATE, FRONT, REAR = range(10)


class Train(NamedTuple):
    """What the observer knows of the trains. Masses are inertias, resistances are per inertia."""

    first: Ints  # (n + 1,)
    units: Floats  # (U, 10) one column per constant named above


class Constants(NamedTuple):
    """The observer's constants."""

    train: Train
    k1: Floats  # (U,)
    k2: Floats  # (U,)
    k3: Floats  # (U,)
    k4: Floats  # (U, m)
    C: Floats  # (U, m)
    omega: Floats  # (U, s) of each sinusoid
    compensated: float  # 1 or 0


def width(params: Params) -> int:
    """Columns of ``estimate``: x, v, w, then the constant and two per sinusoid, as estimated and as remembered."""
    return 3 + 2 * (1 + 2 * len(params.fault_sinusoids))


def gains(C: Sequence[float] | Floats, omega: Sequence[float] | Floats, pole: float) -> tuple[float, float, float, Floats]:
    """Gains that put every pole of the observer's error at ``pole``, for a constant and any number of sinusoids.

    Parameters
    ----------
    C : sequence of float, length 1 + 2 * len(omega)
        Jerk per fault state [m/s3]; the first of each sinusoid's pair is 0.
    omega : sequence of float
        Distinct angular frequencies above 0 [rad/s].
    pole : float
        Below 0 [1/s].

    Returns
    -------
    k1, k2, k3 : float
    k4 : ndarray, shape (1 + 2 * len(omega),)

    Notes
    -----
    The characteristic polynomial of (28) over that of S, ``d(s) = s prod(s^2 + omega^2)``, is
    ``s^2 - k2 s - k3 - C (s I - S)^-1 k4``. It has to equal ``(s - p)^n / d(s)``: k2 and k3 are the quotient, k4 the residues.
    No eigenvalues are computed, so the n-fold pole (a single Jordan block) does no harm.
    """
    n = 3 + 2 * len(omega)
    squares = np.square(omega)
    k2 = n * pole
    k3 = -(math.comb(n, 2) * pole**2 - float(squares.sum()))
    k4 = np.empty(1 + 2 * len(omega))
    k4[0] = -((-pole) ** n) / (C[0] * float(np.prod(squares)))
    for q, w in enumerate(omega):
        others = math.prod(float(o - w * w) for k, o in enumerate(squares) if k != q)
        residue = (1j * w - pole) ** n / (1j * w * others)
        k4[1 + 2 * q] = residue.real / (C[2 + 2 * q] * w)
        k4[2 + 2 * q] = -residue.imag / (C[2 + 2 * q] * w)
    return -pole, k2, k3, k4


def fault_model(params: Params, consists: Consists) -> tuple[Floats, Floats]:
    """C (U, m) and omega (U, s) of all units."""
    mass = consists.mass * consists.rotating
    count = len(params.fault_sinusoids)
    C, omega = np.zeros((len(mass), 1 + 2 * count)), np.empty((len(mass), count))
    C[:, 0] = spread(params.fault_constant_n_per_s, consists) / mass
    for q, (frequency, gain) in enumerate(params.fault_sinusoids):
        C[:, 2 + 2 * q] = spread(gain, consists) / mass
        omega[:, q] = spread(frequency, consists)
    return C, omega


def tolerated_speed_offset(params: Params, scene: Scene) -> float:
    """Largest start error of the speed estimates that is let through [m/s]: 0.5 with the paper's poles and actuators.

    An error of the speed estimate enters the acceleration estimate r times (50 m/s2 per m/s), and the law pushes the train the
    other way until it has gone. Measured on the paper's start, without force limits: with poles -1, -2, -3 and -6 this much keeps
    all bounds, with -3 twice as much fails within a second. Common errors of position do no harm: leading units measure theirs.
    """
    slowest = float(np.max(params.pole_per_s))
    return 0.5 * (slowest / 3.0) ** 2 * 50.0 / float(scene.consists.actuator_rate.max())


def violations(params: Params, scene: Scene) -> list[str]:
    """Every reason for which the observer cannot work here."""
    c = scene.consists
    lists = [("pole_per_s", params.pole_per_s), ("fault_constant_n_per_s", params.fault_constant_n_per_s)]
    lists += [(f"fault_sinusoids[{k}]", value) for k, pair in enumerate(params.fault_sinusoids, 1) for value in pair]
    found = [line for key, value in lists for line in miscounted(f"observer.{key}", value, c)]
    if found:
        return found
    if (spread(params.fault_constant_n_per_s, c) == 0.0).any():
        found.append("observer.fault_constant_n_per_s = 0: the constant fault is unobservable, upsilon must not be 0")
    omega = fault_model(params, c)[1]
    for k, (_, given) in enumerate(params.fault_sinusoids):
        gain, rule = spread(given, c), None
        if ((omega[:, k] == 0.0) | (gain == 0.0)).any():
            rule, u = "unobservable, neither may be 0", int(np.argmax((omega[:, k] == 0.0) | (gain == 0.0)))
        elif (omega[:, k] < 0.0).any():
            rule, u = "omega must be above 0", int(np.argmax(omega[:, k] < 0.0))
        if rule is not None:
            found.append(f"observer.fault_sinusoids[{k + 1}] = [{omega[u, k]:g}, {gain[u]:g}]: {rule}")
        twice = (omega[:, :k] == omega[:, k : k + 1]).any(axis=1)
        if twice.any():
            u = int(np.argmax(twice))
            found.append(
                f"observer.fault_sinusoids[{k + 1}] = [{omega[u, k]:g}, {gain[u]:g}]: unobservable, this omega appears twice"
            )
    fastest = float(np.min(params.pole_per_s))
    stiff = (3 + 2 * len(params.fault_sinusoids)) * -fastest * scene.sub_step
    if stiff > 2.5:
        found.append(
            f"observer.pole_per_s = {fastest:g}: too fast for a sub-step of {scene.sub_step:g} s, "
            f"{stiff:g} = n |p| h must not exceed 2.5"
        )
    most = tolerated_speed_offset(params, scene)
    if abs(params.start_offset_speed_mps) > most:
        found.append(
            f"observer.start_offset_speed_mps = {params.start_offset_speed_mps:g}: the start may be wrong by at most {most:g} m/s"
        )
    return found


def train_of(consists: Consists) -> Train:
    """What the observer knows of the trains. Slopes are not among it: ``plants.integrate`` makes up for the weight."""
    mass = consists.mass * consists.rotating
    before = np.concatenate([[0.0], consists.damping[:-1]])
    before[consists.first[:-1]] = 0.0
    davis = consists.davis / consists.rotating[:, None]
    units = np.column_stack([
        consists.length, mass, davis, consists.stiffness, consists.damping, consists.actuator_rate, before / mass,
        consists.damping / mass,
    ])  # fmt: skip
    return Train(consists.first, np.ascontiguousarray(units))


def constants(params: Params, scene: Scene) -> Constants:
    """Return gains and model of all trains; call again when the trains change."""
    C, omega = fault_model(params, scene.consists)
    poles = spread(params.pole_per_s, scene.consists)
    k1, k2, k3, k4 = zip(*(gains(*of_unit) for of_unit in zip(C, omega, poles, strict=True)), strict=True)
    return Constants(
        train_of(scene.consists), np.array(k1), np.array(k2), np.array(k3), np.array(k4), C, omega, float(params.compensate)
    )


def initial(params: Params, own: Floats) -> Floats:
    """Estimates at the start: measured positions and speeds with their offsets, no acceleration, no fault."""
    estimate = np.zeros((len(own), width(params)))
    estimate[:, X] = own[:, POSITION] + params.start_offset_position_m
    estimate[:, V] = own[:, SPEED] + params.start_offset_speed_mps
    return estimate


def turned(params: Params, estimate: Floats, before: Floats, after: Floats) -> Floats:
    """Estimates of units that have turned round: their errors of position and speed do, too, and what is held of faults stays."""
    estimate = estimate.copy()
    estimate[:, X] = after - (estimate[:, X] - before)
    estimate[:, V : W + 1] *= -1.0
    return estimate


@inlined()
def correction(i: int, constants: Constants, own: Floats, estimate: Floats, held: Bools, out: Floats) -> None:
    """Right-hand sides of (13) with the corrections (14), without the input; then the force of (5) at u = 0."""
    c, m = constants, constants.train
    first, last = m.first[i], len(own) - 1
    states = (estimate.shape[1] - F) // 2  # of the fault; the compiler knows this, but not the shape of C
    for j in range(last + 1):  # mu1, mu2: D1(v) - D1(v_hat) with its neighbours' D2, D3
        unit = m.units[first + j]
        v, vh = own[j, SPEED], estimate[j, V]
        ev = vh - v
        # (17) prints no -r v; dD1/dv = B1 needs it
        mu2 = (unit[FRONT] + unit[REAR] + unit[C1] + unit[RATE] + c.k2[first + j]) * ev + unit[C2] * (vh * abs(vh) - v * abs(v))
        if j > 0:
            mu2 -= unit[FRONT] * (estimate[j - 1, V] - own[j - 1, SPEED])
        if j < last:
            mu2 -= unit[REAR] * (estimate[j + 1, V] - own[j + 1, SPEED])
        out[j, X_RATE] = v - c.k1[first + j] * (estimate[j, X] - own[j, POSITION])
        out[j, V_RATE] = -SETTLE * ev if held[j] else estimate[j, W] + mu2
    for j in range(last + 1):  # mu3 and the model; the B1(v) w_hat of (13) and the three terms with B1 in mu3 add up to this
        unit = m.units[first + j]
        drift = 0.0
        if not held[j]:
            drift = own_coefficient(unit, estimate[j, V]) * out[j, V_RATE] + c.k3[first + j] * (estimate[j, V] - own[j, SPEED])
            if j > 0:
                drift += unit[FRONT] * out[j - 1, V_RATE]
            if j < last:
                drift += unit[REAR] * out[j + 1, V_RATE]
        fault = 0.0
        for q in range(states):
            fault += c.C[first + j, q] * estimate[j, F + q]
        out[j, W_DRIFT] = drift + fault
        out[j, UNCOMPENSATED] = (1.0 - c.compensated) * fault
    static_force(i, m, own, out)


@inlined()
def rate(
    i: int, constants: Constants, own: Floats, estimate: Floats, held: Bools, correction: Floats, applied: Floats, out: Floats
) -> None:
    """d(estimate)/dt of (13); the input is what was applied after the limits."""
    c, m = constants, constants.train
    states = (estimate.shape[1] - F) // 2
    R = F + states  # the first remembered
    for j in range(len(own)):
        u = m.first[i] + j
        unit = m.units[u]
        out[j, X] = correction[j, X_RATE]
        out[j, V] = correction[j, V_RATE]
        out[j, W] = correction[j, W_DRIFT] + unit[RATE] / unit[MASS] * (applied[j] - correction[j, STATIC])
        ev = estimate[j, V] - own[j, SPEED]
        if held[j]:
            out[j, W], ev = -SETTLE * estimate[j, W], 0.0
        out[j, F] = c.k4[u, 0] * ev
        out[j, R] = 0.0
        for q in range(states // 2):
            sine, cosine = F + 1 + 2 * q, F + 2 + 2 * q
            out[j, sine] = c.omega[u, q] * estimate[j, cosine] + c.k4[u, 1 + 2 * q] * ev
            out[j, cosine] = -c.omega[u, q] * estimate[j, sine] + c.k4[u, 2 + 2 * q] * ev
            out[j, states + sine] = c.omega[u, q] * estimate[j, states + cosine]
            out[j, states + cosine] = -c.omega[u, q] * estimate[j, states + sine]
        if held[j]:
            for q in range(F, R):
                out[j, q] += SETTLE * (estimate[j, states + q] - estimate[j, q])
        elif own[j, SPEED] > RUNS:
            for q in range(F, R):
                out[j, states + q] += LEARN * (estimate[j, q] - estimate[j, states + q])


def fault_estimate(constants: Constants, estimate: Floats) -> Floats:
    """C f_hat of every unit [m/s3], for logs."""
    total: Floats = (constants.C * estimate[:, F : F + constants.C.shape[1]]).sum(axis=1)
    return total


def acceleration_estimate(constants: Constants, estimate: Floats) -> Floats:
    """Estimated acceleration of every unit [m/s2], for logs."""
    return estimate[:, W]


@inlined(inline="always")
def own_coefficient(unit: Floats, v: float) -> float:
    """B1 of eq. (4): how the acceleration of a unit damps itself at this speed [1/s]."""
    B1: float = -(unit[FRONT] + unit[REAR] + unit[C1] + 2.0 * unit[C2] * abs(v) + unit[RATE])
    return B1


@inlined()
def static_force(i: int, train: Train, own: Floats, out: Floats) -> None:
    """Write the demand (5) at u = 0 as a force, B + m R - m B4 / r [N], into the column STATIC of ``out``."""
    first, last = train.first[i], len(own) - 1
    stretched = closing = 0.0  # force of the coupler before this unit [N], and a times its speed [N/s]
    for j in range(last + 1):
        unit = train.units[first + j]
        v = own[j, SPEED]
        rear = rear_closing = 0.0
        if j < last:
            dv = v - own[j + 1, SPEED]
            rear = unit[STIFFNESS] * (own[j, POSITION] - own[j + 1, POSITION] - unit[LENGTH]) + unit[DAMPING] * dv
            rear_closing = unit[STIFFNESS] * dv
        resistance = running_resistance(v, unit[C0], unit[C1], unit[C2]) if v > 0.0 else unit[C0]  # that of moving off
        out[j, STATIC] = rear - stretched + unit[MASS] * resistance + (rear_closing - closing) / unit[RATE]
        stretched, closing = rear, rear_closing
