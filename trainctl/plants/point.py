"""Trains as points: the exact discrete maps of fully_distributed, eq. (1), and robust_constrained, eqs. (1) and (4).

Explicit Euler, as printed: the position moves with the *old* speed. Disturbances and clamps are those of robust_constrained;
without them both maps are the same one. The gradient, which neither paper has, is a force every train knows and makes up for:
it is in the input, and leaves the motion as it is unless the input is clamped.

Symbols: R running resistance, a demanded acceleration, u input, w1, w2, w3 disturbances, S_U and S_V clamps to the sets of
admissible inputs and speeds, T step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from trainctl.contracts import PointPlant
from trainctl.davis import resistance as resistance
from trainctl.davis import resistance_of
from trainctl.kernels import bare
from trainctl.plants import faults as actuators
from trainctl.plants.faults import Fault
from trainctl.signals import GRAVITY, POSITION, SPEED, Bools, Bounds, Consists, Floats, Reliance, Scene, Table

if TYPE_CHECKING:
    from trainctl.plants import point

    module: PointPlant = point

UNITS, STATES = False, 2
COLUMNS: tuple[str, ...] = ()
CLAMPS: tuple[str, ...] = ("input_lower_mps2", "input_upper_mps2", "speed_lower_mps", "speed_upper_mps")


class Params(Table):
    """Keys of ``[plant]`` with ``kind = "point"``: clamps that are part of the plant. None by default."""

    input_lower_mps2: float | None = Field(
        default=None, description="minimum applied input, end of U [m/s2]; robust_constrained eq. (4)"
    )
    input_upper_mps2: float | None = Field(
        default=None, description="maximum applied input, end of U [m/s2]; robust_constrained eq. (4)"
    )
    speed_lower_mps: float | None = Field(default=None, description="minimum speed, end of V [m/s]; robust_constrained eq. (4)")
    speed_upper_mps: float | None = Field(default=None, description="maximum speed, end of V [m/s]; robust_constrained eq. (4)")

    @field_validator("input_upper_mps2", "speed_upper_mps")
    @classmethod
    def _above_lower(cls, upper: float | None, info: ValidationInfo) -> float | None:
        key = str(info.field_name).replace("upper", "lower")
        lower = info.data.get(key)
        if upper is not None and lower is not None and upper <= lower:
            raise ValueError(f"must be above {key} = {lower:g}")
        return upper


class Constants(NamedTuple):
    """Data of all trains, ``davis`` (n, 3), everything else (n,)."""

    davis: Floats  # c0 [N/kg], c1 [N s/(m kg)], c2 [N s2/(m2 kg)] as the trains believe them
    resistance_factor: Floats  # true / believed resistance
    input_lower: Floats  # m/s2, -inf if there is no clamp
    input_upper: Floats  # m/s2
    speed_lower: Floats  # m/s
    speed_upper: Floats  # m/s
    gradient: Floats  # (G, 2) position where a slope begins [m], rise / run; the first reaches back without end
    slope: Floats  # (n,) rise / run under every train beside that; may be overwritten between steps


class Kick(NamedTuple):
    """Disturbances of one step, shape (n,)."""

    position: Floats  # w1 [m]
    speed: Floats  # w2 [m/s]
    input: Floats  # w3 [m/s2]

    @classmethod
    def none(cls, trains: int) -> Kick:
        """An undisturbed step."""
        return cls(np.zeros(trains), np.zeros(trains), np.zeros(trains))


class Mapped(NamedTuple):
    """One step of all trains."""

    own: Floats  # (n, 2) position [m] and speed [m/s] after the step
    input: Floats  # (n,) applied input S_U[u + w3] during the step [m/s2]
    displacement: Floats  # (n,) m, never negative
    limited: Bools  # (n,) a clamp on input or speed acted
    clipped: Bools  # (n,) the train would have moved backwards


def constants(
    params: Params, consists: Consists, resistance_factor: Floats | None = None, gradient: Floats | None = None,
    clamps: Bounds | None = None,
) -> Constants:  # fmt: skip
    """Arrays of the plant; a train of several units gets the mean of their Davis coefficients, weighted by mass.

    Parameters
    ----------
    params : Params
        Clamps, the same for all trains; see ``clamps``.
    consists : Consists
        Units of all trains.
    resistance_factor : ndarray, shape (n,), optional
        True over believed running resistance; 1 if left out.
    gradient : ndarray, shape (G, 2), optional
        Position where a slope begins [m], ascending, and its rise / run; flat if left out.
    clamps : Bounds, optional
        U_i and V_i of every train, infinite where nothing clamps, instead of those of ``params``.

    Returns
    -------
    Constants
    """
    n = len(consists.first) - 1

    def everywhere(value: float | None, otherwise: float) -> Floats:
        return np.full(n, otherwise if value is None else value)

    if clamps is None:
        clamps = Bounds(
            everywhere(params.speed_lower_mps, -np.inf), everywhere(params.speed_upper_mps, np.inf),
            everywhere(params.input_lower_mps2, -np.inf), everywhere(params.input_upper_mps2, np.inf),
        )  # fmt: skip
    return Constants(
        davis=consists.train_davis(),
        resistance_factor=np.ones(n) if resistance_factor is None else resistance_factor,
        input_lower=clamps.input_lower,
        input_upper=clamps.input_upper,
        speed_lower=clamps.speed_lower,
        speed_upper=clamps.speed_upper,
        gradient=np.zeros((0, 2)) if gradient is None else gradient,
        slope=np.zeros(n),
    )


def climbing(position: Floats, gradient: Floats) -> Floats:
    """Weight along the line per mass [N/kg], rising positive, of trains whose front is at ``position`` [m], shape (n,)."""
    if len(gradient) == 0:
        return np.zeros(len(position))
    where = np.maximum(np.searchsorted(gradient[:, 0], position, side="right") - 1, 0)
    force: Floats = GRAVITY * gradient[where, 1]
    return force


def lead(steps: int) -> float:
    """Theta of this plant when an acceleration is held for ``steps`` steps: ``(1 - 1/m) / 2``; 0 for the papers' m = 1.

    Theta is defined by ``x(k+1) = x + ((1 - theta) v(k) + theta v(k+1)) T_c``; m Euler steps of T_c / m under constant
    acceleration move ``v T_c + (1 - 1/m) / 2 (v(k+1) - v) T_c``.
    """
    return (1.0 - 1.0 / steps) / 2.0


def violations(params: Params, scene: Scene, faults: Sequence[Fault] = ()) -> list[str]:
    """Nothing but a fault can be wrong: points have no actuators."""
    return actuators.refused("point", faults)


def balanced(own: Floats, consists: Consists, gradient: Floats | None = None) -> Floats:
    """Forces are no state of points."""
    return own


def noise_hold(params: Params) -> None:
    """No noise of its own."""
    return


def room(consists: Consists, lower: Floats, upper: Floats) -> tuple[Floats, Floats]:
    """Points give what the law asks for, up to the clamps, which are bounds already."""
    return np.full(len(lower), -np.inf), np.full(len(lower), np.inf)


def sure_braking(params: Params, consists: Consists, top: Floats) -> Floats:
    """As much as the clamp leaves [m/s2], shape (n,), running resistance not counted on; infinite for free points."""
    clamp = params.input_lower_mps2
    return np.full(len(top), np.inf if clamp is None else -clamp)


def relied_on(
    params: Params, consists: Consists, faults: Sequence[Fault], trains: Sequence[str], braking: float, top: Floats, fall: Floats,
    deviations: float,
) -> Reliance:  # fmt: skip
    """As ``contracts.Plant`` says: points act at once."""
    upper, zero = params.input_upper_mps2, np.zeros(len(top))
    pull = np.full(len(top), np.inf if upper is None else upper)
    return Reliance(np.minimum(braking, sure_braking(params, consists, top) - fall), pull, zero, zero, zero, zero)


def advance(constants: Constants, own: Floats, acceleration: Floats, step: float, kick: Kick) -> Mapped:
    """One step of all trains: fully_distributed (1); with disturbances and clamps robust_constrained (4).

    Parameters
    ----------
    constants : Constants
        The plant.
    own : ndarray, shape (n, 2)
        Position [m] and speed [m/s].
    acceleration : ndarray, shape (n,)
        Demanded acceleration [m/s2]; the input asked for is this plus the resistance the train believes in.
    step : float
        T [s].
    kick : Kick
        Disturbances of this step.

    Returns
    -------
    Mapped

    Notes
    -----
    The order of (4): add w3, clamp the input, subtract the true resistance, add w2, clamp the speed. Departs from both papers
    in two things: the gradient, and standstill. Trains on a network do not run backwards, so neither a speed nor a displacement
    falls below 0.
    """
    moved = Mapped(np.empty_like(own), *np.empty((2, len(own))), *np.empty((2, len(own)), dtype=bool))
    _advance(constants, own, climbing(own[:, POSITION], constants.gradient), acceleration, step, kick, moved)
    return moved


def believed(constants: Constants, own: Floats) -> Floats:
    """Running resistance as the trains believe it, and gradient, at ``own`` (n, 2) [N/kg], shape (n,)."""
    force = climbing(own[:, POSITION], constants.gradient)
    _add_believed(constants.davis, constants.slope, own, force)
    return force


@bare(error_model="numpy")
def _add_believed(davis: Floats, slope: Floats, own: Floats, force: Floats) -> None:
    for i in range(len(own)):
        force[i] = resistance_of(i, own[i, SPEED], davis) + (force[i] + GRAVITY * slope[i])


@bare(error_model="numpy")
def _advance(
    constants: Constants, own: Floats, climb: Floats, acceleration: Floats, step: float, kick: Kick, moved: Mapped
) -> None:
    """Write the step of every train into ``moved``. ``min`` and ``max`` pass on a first number that is none."""
    c = constants
    for i in range(len(own)):
        v = own[i, SPEED]
        believed = resistance_of(i, v, c.davis)
        weight = climb[i] + GRAVITY * c.slope[i]
        asked = believed + weight + acceleration[i] + kick.input[i]
        applied = min(max(asked, c.input_lower[i]), c.input_upper[i])
        free = v + applied * step - (c.resistance_factor[i] * believed + weight) * step + kick.speed[i]
        v_next = min(max(max(free, c.speed_lower[i]), 0.0), c.speed_upper[i])
        distance = v * step + kick.position[i]
        displacement = max(distance, 0.0)
        moved.own[i, POSITION], moved.own[i, SPEED] = own[i, POSITION] + displacement, v_next
        moved.input[i], moved.displacement[i] = applied, displacement
        moved.limited[i] = applied != asked or v_next != free
        moved.clipped[i] = distance < 0.0
