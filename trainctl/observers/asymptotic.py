"""Asymptotic observer of acceleration and actuator fault from measured position and speed: eqs. (13), (14) of [1]_.

The fault model is a constant and any number of sinusoids, ``f' = S f``; the error then obeys a linear law with one chosen pole.
What the law reads is in ``correction``: the right-hand sides of (13) before the input, and the force that (5) holds in reserve.

Symbols
-------
=============  ===============================================================================================
x, v, w, f     position [m], speed [m/s], acceleration [m/s2], fault states; hats are estimates, e = hat - true
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
* Backwards and at standstill the resistance is odd in v, as in the plant.

References
----------
.. [1] Zhang, Chen, "Asymptotical Cooperative Cruise Fault Tolerant Control for Multiple High-speed Trains with State
   Constraints".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np
from numba import njit
from pydantic import Field

from trainctl.signals import POSITION, SPEED, Floats, Ints, Scene, Table

WIDTH = 6  # with one sinusoid; see width()
CORRECTIONS = 5

#: Columns of ``estimate``; the fault states follow.
X, V, W, F = 0, 1, 2, 3

#: Columns of ``correction``: hat x', hat v', hat w' without the input, the part of the last one that the law leaves alone [m/s3],
#: and the force of (5) at u = 0 [N].
X_RATE, V_RATE, W_DRIFT, UNCOMPENSATED, STATIC = 0, 1, 2, 3, 4


class Params(Table):
    """Keys of ``[observer]`` with ``kind = "asymptotic"``. ``compensate = false`` is the paper's law without fault tolerance."""

    pole_per_s: float = Field(-3.0, lt=0, description="The observer's pole, for all its states [1/s]")
    fault_constant_n_per_s: float = Field(2e5, description="upsilon, jerk force per unit of the constant fault state [N/s]")
    fault_sinusoids: tuple[Annotated[tuple[float, float], Field(strict=False)], ...] = Field(
        ((1.0, 2e5),), strict=False, description="[[omega_rad_per_s, nu_omega_n_per_s], ...]: the sinusoids of the fault model"
    )
    compensate: bool = Field(True, description="false: the fault estimate is left out of the control")
    start_offset_position_m: float = Field(0.0, description="Error of the position estimates at the start [m]; 0: as measured")
    start_offset_speed_mps: float = Field(0.0, description="Error of the speed estimates at the start [m/s]; 0: as measured")


class Train(NamedTuple):
    """What the observer knows of the trains; (U,) but for ``first`` and ``davis`` (U, 3). Masses are inertias."""

    first: Ints
    length: Floats
    mass: Floats
    davis: Floats  # per inertia
    stiffness: Floats
    damping: Floats
    rate: Floats


class Constants(NamedTuple):
    """The observer's constants."""

    train: Train
    k1: float
    k2: float
    k3: float
    k4: Floats  # (U, m)
    C: Floats  # (U, m)
    omega: Floats  # of each sinusoid
    compensated: float  # 1 or 0


def width(params: Params) -> int:
    """Columns of ``estimate``: x, v, w, the constant and two per sinusoid."""
    return 4 + 2 * len(params.fault_sinusoids)


def gains(C: Sequence[float], omega: Sequence[float], pole: float) -> tuple[float, float, float, Floats]:
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
        k4[2 + 2 * q] = -residue.imag / C[2 + 2 * q]
    return -pole, k2, k3, k4


def fault_model(params: Params, mass: float) -> tuple[list[float], list[float]]:
    """C and omega of one unit with this inertia [kg]."""
    C = [params.fault_constant_n_per_s / mass]
    for _, gain in params.fault_sinusoids:
        C += [0.0, gain / mass]
    return C, [omega for omega, _ in params.fault_sinusoids]


def tolerated_speed_offset(params: Params, scene: Scene) -> float:
    """Largest start error of the speed estimates that the law survives [m/s]; ``violations`` refuses more.

    An error of the speed estimate enters the acceleration estimate r times (50 m/s2 per m/s in the paper's trains) for about
    1 / |p| seconds. Heads then swing by nearly ``r / |p|`` times the error; half a metre per second of room per pole is kept.
    """
    return 0.5 * abs(params.pole_per_s) / float(scene.consists.actuator_rate.max())


def violations(params: Params, scene: Scene) -> list[str]:
    """Every reason for which the observer cannot work here."""
    found = []
    if params.fault_constant_n_per_s == 0.0:
        found.append("observer.fault_constant_n_per_s = 0: the constant fault is unobservable, upsilon must not be 0")
    for k, (omega, gain) in enumerate(params.fault_sinusoids, 1):
        if omega == 0.0 or gain == 0.0:
            found.append(f"observer.fault_sinusoids[{k}] = [{omega:g}, {gain:g}]: unobservable, neither may be 0")
        elif omega < 0.0:
            found.append(f"observer.fault_sinusoids[{k}] = [{omega:g}, {gain:g}]: omega must be above 0")
        if omega in [other for other, _ in params.fault_sinusoids[: k - 1]]:
            found.append(f"observer.fault_sinusoids[{k}] = [{omega:g}, {gain:g}]: unobservable, this omega stands twice")
    stiff = (3 + 2 * len(params.fault_sinusoids)) * -params.pole_per_s * scene.sub_step
    if stiff > 2.5:
        found.append(
            f"observer.pole_per_s = {params.pole_per_s:g}: too fast for a sub-step of {scene.sub_step:g} s, "
            f"{stiff:g} = n |p| h must not exceed 2.5"
        )
    most = tolerated_speed_offset(params, scene)
    if abs(params.start_offset_speed_mps) > most:
        found.append(f"observer.start_offset_speed_mps = {params.start_offset_speed_mps:g}: the law survives at most {most:g} m/s")
    return found


def train_of(scene: Scene) -> Train:
    """What the observer knows of the trains."""
    c = scene.consists
    return Train(
        c.first, c.length, c.mass * c.rotating, c.davis / c.rotating[:, None], c.stiffness, c.damping, c.actuator_rate
    )  # fmt: skip


def constants(params: Params, scene: Scene) -> Constants:
    """Return gains and model of all trains; call again when the trains change."""
    train = train_of(scene)
    models = [fault_model(params, m) for m in train.mass]
    solved = [gains(C, omega, params.pole_per_s) for C, omega in models]
    k1, k2, k3, _ = solved[0]
    return Constants(
        train, k1, k2, k3, np.array([k4 for *_, k4 in solved]), np.array([C for C, _ in models]),
        np.array([omega for omega, _ in params.fault_sinusoids], float), float(params.compensate),
    )  # fmt: skip


def initial(params: Params, own: Floats) -> Floats:
    """Estimates at the start: measured positions and speeds with their offsets, no acceleration, no fault."""
    estimate = np.zeros((len(own), width(params)))
    estimate[:, X] = own[:, POSITION] + params.start_offset_position_m
    estimate[:, V] = own[:, SPEED] + params.start_offset_speed_mps
    return estimate


@njit(cache=True)
def correction(i: int, constants: Constants, own: Floats, estimate: Floats, out: Floats) -> None:
    """Right-hand sides of (13) with the corrections (14), without the input; then the force of (5) at u = 0."""
    c, m = constants, constants.train
    first, units = m.first[i], len(own)
    for j in range(units):  # mu1, mu2; D1(v) - D1(v_hat) and its neighbours' D2, D3
        u = first + j
        ev = estimate[j, V] - own[j, SPEED]
        v, vh = own[j, SPEED], estimate[j, V]
        b_front, b_rear = (m.damping[u - 1] if j > 0 else 0.0), m.damping[u]
        # (17) prints no -r v; dD1/dv = B1 needs it
        mu2 = ((b_front + b_rear) / m.mass[u] + m.davis[u, 1] + m.rate[u]) * ev + m.davis[u, 2] * (vh * abs(vh) - v * abs(v))
        mu2 += c.k2 * ev
        if j > 0:
            mu2 -= b_front / m.mass[u] * (estimate[j - 1, V] - own[j - 1, SPEED])
        if j + 1 < units:
            mu2 -= b_rear / m.mass[u] * (estimate[j + 1, V] - own[j + 1, SPEED])
        out[j, X_RATE] = estimate[j, V] - c.k1 * (estimate[j, X] - own[j, POSITION]) - ev
        out[j, V_RATE] = mu2
    for j in range(units):  # mu3 and the model; V_RATE still holds mu2
        u = first + j
        vh = estimate[j, V]
        b_front, b_rear = (m.damping[u - 1] if j > 0 else 0.0), m.damping[u]
        # B1(v) (w_hat + mu2) + (B1(v_hat) - B1(v)) (w_hat + mu2)
        drift = own_coefficient(m, u, b_front + b_rear, vh) * (estimate[j, W] + out[j, V_RATE]) + c.k3 * (vh - own[j, SPEED])
        if j > 0:
            drift += b_front / m.mass[u] * (estimate[j - 1, W] + out[j - 1, V_RATE])
        if j + 1 < units:
            drift += b_rear / m.mass[u] * (estimate[j + 1, W] + out[j + 1, V_RATE])
        fault = 0.0
        for q in range(c.C.shape[1]):
            fault += c.C[u, q] * estimate[j, F + q]
        out[j, W_DRIFT] = drift + fault
        out[j, UNCOMPENSATED] = (1.0 - c.compensated) * fault
        out[j, STATIC] = static_force(m, u, j, units, own)
    for j in range(units):
        out[j, V_RATE] += estimate[j, W]


@njit(cache=True)
def rate(
    i: int, constants: Constants, own: Floats, estimate: Floats, correction: Floats, applied: Floats, out: Floats
) -> None:
    """d(estimate)/dt of (13); the input is what was applied after the limits."""
    c, m = constants, constants.train
    for j in range(len(own)):
        u = m.first[i] + j
        out[j, X] = correction[j, X_RATE]
        out[j, V] = correction[j, V_RATE]
        out[j, W] = correction[j, W_DRIFT] + m.rate[u] / m.mass[u] * (applied[j] - correction[j, STATIC])
        ev = estimate[j, V] - own[j, SPEED]
        out[j, F] = c.k4[u, 0] * ev
        for q in range(len(c.omega)):
            sine, cosine = F + 1 + 2 * q, F + 2 + 2 * q
            out[j, sine] = c.omega[q] * estimate[j, cosine] + c.k4[u, 1 + 2 * q] * ev
            out[j, cosine] = -c.omega[q] * estimate[j, sine] + c.k4[u, 2 + 2 * q] * ev


def fault_estimate(constants: Constants, estimate: Floats) -> Floats:
    """C f_hat of every unit [m/s3], for logs."""
    total: Floats = (constants.C * estimate[:, F:]).sum(axis=1)
    return total


@njit(cache=True, inline="always")
def own_coefficient(m: Train, u: int, damping: float, v: float) -> float:
    """B1 of eq. (4): how the acceleration of unit ``u`` damps itself [1/s]."""
    B1: float = -damping / m.mass[u] - (m.davis[u, 1] + 2.0 * m.davis[u, 2] * abs(v)) - m.rate[u]
    return B1


@njit(cache=True)
def static_force(m: Train, u: int, j: int, units: int, own: Floats) -> float:
    """Demand (5) at u = 0, as a force: B + m R - m B4 / r [N]."""
    v = own[j, SPEED]
    sign = 1.0 if v > 0.0 else (-1.0 if v < 0.0 else 0.0)
    force: float = m.mass[u] * (sign * m.davis[u, 0] + m.davis[u, 1] * v + m.davis[u, 2] * v * abs(v))
    if j + 1 < units:
        closing = v - own[j + 1, SPEED]
        force += m.stiffness[u] * (own[j, POSITION] - own[j + 1, POSITION] - m.length[u])
        force += (m.damping[u] + m.stiffness[u] / m.rate[u]) * closing
    if j > 0:
        closing = own[j - 1, SPEED] - v
        force -= m.stiffness[u - 1] * (own[j - 1, POSITION] - own[j, POSITION] - m.length[u - 1])
        force -= (m.damping[u - 1] + m.stiffness[u - 1] / m.rate[u]) * closing
    return force
