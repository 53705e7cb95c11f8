"""Intermediate estimator of acceleration and actuator fault, the paper's comparison: after Zhu et al. 2015 [1]_.

It assumes no fault model: ``xi = f' - kappa w`` is estimated in place of the fault, so that errors stay bounded by how fast the
fault moves over kappa, and do not vanish. The gains are not in the paper; several should be tried and named.

Symbols
-------
==========  =================================================================
x, v, w     position [m], speed [m/s], acceleration [m/s2]; hats are estimates
f'          fault as jerk [m/s3]
xi          f' - kappa w
L1, L2      gains of the speed error; the position error has gain 3
==========  =================================================================

References
----------
.. [1] Zhu, Yang, Wang, Wang, "Fault estimation for a class of nonlinear systems based on intermediate estimator",
   IEEE Transactions on Automatic Control 61(9), 2015.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from pydantic import Field

from trainctl.contracts import Observer
from trainctl.kernels import inlined
from trainctl.observers.asymptotic import (
    FRONT,
    MASS,
    RATE,
    REAR,
    SETTLE,
    STATIC,
    UNCOMPENSATED,
    V_RATE,
    W_DRIFT,
    X_RATE,
    Train,
    V,
    W,
    X,
    own_coefficient,
    static_force,
    train_of,
)
from trainctl.signals import POSITION, SPEED, Bools, Floats, Scene, Table

if TYPE_CHECKING:
    from trainctl.observers import intermediate

    module: Observer = intermediate

WIDTH = 4
CORRECTIONS = 5

XI = 3  # column of ``estimate`` after X, V, W


class Params(Table):
    """Keys of ``[observer]`` with ``kind = "intermediate"``."""

    position_gain_per_s: float = Field(3.0, gt=0, description="Gain of the position error [1/s]")
    L1_per_s: float = Field(6.0, gt=0, description="Gain of the speed error on the speed [1/s]")
    L2_per_s2: float = Field(9.0, gt=0, description="Gain of the speed error on the acceleration [1/s2]")
    kappa_per_s: float = Field(50.0, gt=0, description="How fast the fault estimate follows [1/s]")
    start_offset_position_m: float = Field(0.0, description="Error of the position estimates at the start [m]; 0: as measured")
    start_offset_speed_mps: float = Field(0.0, description="Error of the speed estimates at the start [m/s]; 0: as measured")


class Constants(NamedTuple):
    """The estimator's constants."""

    train: Train
    position_gain: float
    L1: float
    L2: float
    kappa: float


def width(params: Params) -> int:
    """Columns of ``estimate``."""
    return WIDTH


def tolerated_speed_offset(params: Params, scene: Scene) -> float:
    """Largest start error of the speed estimates that is let through [m/s]; 20 was survived on the paper's start."""
    return 10.0


def violations(params: Params, scene: Scene) -> list[str]:
    """Every reason for which the estimator cannot work here."""
    found = []
    stiff = (params.kappa_per_s + float(scene.consists.actuator_rate.max())) * scene.sub_step
    if stiff > 2.5:
        found.append(
            f"observer.kappa_per_s = {params.kappa_per_s:g}: too fast for a sub-step of {scene.sub_step:g} s, "
            f"{stiff:g} = (kappa + r) h must not exceed 2.5"
        )
    if abs(params.start_offset_speed_mps) > (most := tolerated_speed_offset(params, scene)):
        found.append(
            f"observer.start_offset_speed_mps = {params.start_offset_speed_mps:g}: the start may be wrong by at most {most:g} m/s"
        )
    return found


def constants(params: Params, scene: Scene) -> Constants:
    """Return gains and model of all trains; call again when the trains change."""
    return Constants(train_of(scene.consists), params.position_gain_per_s, params.L1_per_s, params.L2_per_s2, params.kappa_per_s)


def initial(params: Params, own: Floats) -> Floats:
    """Estimates at the start: measured positions and speeds with their offsets, no acceleration, no fault."""
    estimate = np.zeros((len(own), WIDTH))
    estimate[:, X] = own[:, POSITION] + params.start_offset_position_m
    estimate[:, V] = own[:, SPEED] + params.start_offset_speed_mps
    return estimate


def turned(params: Params, estimate: Floats, before: Floats, after: Floats) -> Floats:
    """Estimates of units that have turned round: as with ``asymptotic.turned``, the fault estimate xi + kappa w stays."""
    fault = estimate[:, XI] + params.kappa_per_s * estimate[:, W]
    estimate = estimate.copy()
    estimate[:, X] = after - (estimate[:, X] - before)
    estimate[:, V : W + 1] *= -1.0
    estimate[:, XI] = fault - params.kappa_per_s * estimate[:, W]
    return estimate


@inlined()
def correction(i: int, constants: Constants, own: Floats, estimate: Floats, held: Bools, out: Floats) -> None:
    """Write right-hand sides without the input, as ``asymptotic.correction`` does: mu1 = -3 e_x, mu2 = -L1 e_v, mu3 = -L2 e_v."""
    c, m = constants, constants.train
    first, last = m.first[i], len(own) - 1
    for j in range(last + 1):
        unit = m.units[first + j]
        wh, ev = estimate[j, W], estimate[j, V] - own[j, SPEED]
        model = own_coefficient(unit, own[j, SPEED]) * wh
        if j > 0:
            model += unit[FRONT] * estimate[j - 1, W]
        if j < last:
            model += unit[REAR] * estimate[j + 1, W]
        out[j, X_RATE] = estimate[j, V] - c.position_gain * (estimate[j, X] - own[j, POSITION])
        out[j, V_RATE] = -SETTLE * ev if held[j] else wh - c.L1 * ev
        out[j, W_DRIFT] = estimate[j, XI] + c.kappa * wh + (0.0 if held[j] else model - c.L2 * ev)
        out[j, UNCOMPENSATED] = 0.0
    static_force(i, m, own, out)


@inlined()
def rate(
    i: int, constants: Constants, own: Floats, estimate: Floats, held: Bools, correction: Floats, applied: Floats, out: Floats
) -> None:
    """d(estimate)/dt; the input is what was applied after the limits."""
    c, m = constants, constants.train
    for j in range(len(own)):
        unit = m.units[m.first[i] + j]
        ev = estimate[j, V] - own[j, SPEED]
        out[j, X] = correction[j, X_RATE]
        out[j, V] = correction[j, V_RATE]
        out[j, W] = correction[j, W_DRIFT] + unit[RATE] / unit[MASS] * (applied[j] - correction[j, STATIC])
        out[j, XI] = -c.kappa * (out[j, W] + c.L2 * ev)  # model + f_hat + u, without mu3
        if held[j]:
            out[j, W] = -SETTLE * estimate[j, W]
            out[j, XI] = -c.kappa * out[j, W]  # the fault estimate xi + kappa w stays


def fault_estimate(constants: Constants, estimate: Floats) -> Floats:
    """f'_hat of every unit [m/s3], for logs."""
    return estimate[:, XI] + constants.kappa * estimate[:, W]


def acceleration_estimate(constants: Constants, estimate: Floats) -> Floats:
    """Estimated acceleration of every unit [m/s2], for logs."""
    return estimate[:, W]
