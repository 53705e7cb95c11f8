"""Sliding mode behind the train ahead [1]_, with an extended state observer for what the model leaves out [2]_.

Symbols
-------
x, v     front position [m], speed [m/s]; _l: of the train ahead, with its acceleration a_l [m/s2]
d        desired spacing, front to front [m]
e        spacing error ``x_l - x - d`` [m]
S        sliding variable ``(v_l - v) + c e`` [m/s]
c        how fast e decays where S = 0 [1/s]
k, phi   reaching rate [m/s2], and the width of the layer in which it is proportional [m/s]
u        acceleration asked for [m/s2]
z1, z2   estimates of the speed [m/s] and of all accelerations the model leaves out [m/s2]
omega    bandwidth of the observer [1/s]
w        bound of z2 [m/s2]
T        control period [s]

The law
-------
The train obeys ``v' = u + f`` with an unknown f: errors of resistance, slope and mass, and what its actuators do
late. On S = 0 the spacing error decays with c, and ``S' = -k sat(S / phi)`` is what

    u = a_l + c (v_l - v) + k sat(S / phi) - z2

makes of it ([1]_, section IV, without its terms of the first train of the string: here only its follower receives that). The
observer is the linear one of [2]_ with both poles at -omega, over one period:

    z1+ = z1 + T (z2 + u + 2 omega (v - z1)),    z2+ = z2 + T omega2 (v - z1),

whose poles in discrete time are both ``1 - omega T``. Its u is what was asked for after all limits.

The speed has a ceiling, a part of the room between the reference and the maximum speed, and z2 may lower what leads there, but not
raise it: what the observer holds against the train does not take it past its maximum speed.

Departures
----------
* [1]_ has a sign function in a boundary layer as well, but no observer; the constant spacing it keeps with the first train's
  speed is string stable, and without that it is only as far as a_l comes in time: with a control period of T errors may grow by
  about a_l's delay. ``trainctl compare spacing`` shows by how much.
* z2 stays within -w .. w. An actuator at a limit the law does not know of, such as the power at high speed, is to the observer a
  force that brakes: without a bound it takes up whatever was asked for in vain, and pushes on for some 1 / omega after the end.
* a_l is the mean acceleration of the control period before, as the train ahead measures it.
* Old messages are carried forward, see ``ahead``. A train that follows none takes the speed of the reference.

References
----------
.. [1] Swaroop, Hedrick, "String stability of interconnected systems", IEEE Transactions on Automatic Control 41(3), 1996.
.. [2] Gao, "Scaling and bandwidth-parameterization based controller tuning", American Control Conference 2003.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from trainctl.controllers import ahead
from trainctl.signals import SPEED, Bounds, Demand, Floats, Links, Scene, Table, Trains

if TYPE_CHECKING:
    from trainctl.contracts import RememberingLaw
    from trainctl.controllers import sliding_mode

    module: RememberingLaw = sliding_mode

CLOCK: Literal["sampled"] = "sampled"

#: It listens to the nearest train ahead alone.
FOLLOWS = True

#: Rows of a comparison -> the keys of [controller] that make them.
COMPARED: dict[str, dict[str, Any]] = {"sliding_mode": {}}

#: What a train is told in `trainctl compare spacing`, and why its spacing is what it is there.
IN_STOPS = (
    "place, speed and acceleration of the train ahead. It brakes as that one does at once, and keeps the whole "
    "spacing for what scatters"
)


class Params(Table):
    """Keys of ``[controller]`` with ``law = "sliding_mode"``."""

    surface_per_s: float = Field(0.1, gt=0.0, description="How fast the spacing error decays on the surface, c [1/s].")
    reach_mps2: float = Field(0.3, gt=0.0, description="Reaching rate k [m/s2].")
    layer_mps: float = Field(1.0, gt=0.0, description="Width of the layer in which the reaching rate is proportional, phi [m/s].")
    observer_per_s: float = Field(0.2, gt=0.0, description="Bandwidth of the extended state observer, omega [1/s].")
    unknown_mps2: float = Field(0.15, ge=0.0, description="Most that the observer makes up for, w [m/s2].")
    acceleration_mps2: float = Field(0.5, gt=0.0, description="Maximum acceleration asked for [m/s2].")
    deceleration_mps2: float = Field(1.0, gt=0.0, description="Maximum deceleration asked for [m/s2].")
    faster_mps: float = Field(3.0, gt=0.0, description="At most so much faster than the reference, to close up [m/s].")


class Constants(NamedTuple):
    """Constants of the law; arrays have shape (n,)."""

    who: ahead.Followed
    d: Floats  # m
    c: float  # 1/s
    k: float  # m/s2
    phi: float  # m/s
    omega: float  # 1/s
    unknown: float  # m/s2
    pulls: float  # m/s2
    brakes: Floats  # m/s2
    faster: float  # m/s
    bounds: Bounds
    T: float  # s


class State(NamedTuple):
    """What the law remembers, shape (n,)."""

    speed: Floats  # m/s, a control period ago
    z1: Floats  # m/s
    z2: Floats  # m/s2


def initial(params: Params, scene: Scene) -> State:
    """Nothing is left out of the model yet."""
    v = scene.own[scene.consists.first[:-1], SPEED]
    return State(v.copy(), v.copy(), np.zeros_like(v))


def constants(params: Params, scene: Scene) -> Constants:
    """Constants of the law; see ``SampledLaw``."""
    who = ahead.followed(scene)
    return Constants(
        who, np.where(who.follows, who.desired, 0.0), params.surface_per_s, params.reach_mps2, params.layer_mps,
        params.observer_per_s, params.unknown_mps2, params.acceleration_mps2, np.full(len(who.row), params.deceleration_mps2),
        params.faster_mps, scene.bounds, scene.control_period,
    )  # fmt: skip


def message(constants: Constants, own: Trains, leader: Floats, state: State) -> Floats:
    """Place relative to the reference, speed and mean acceleration since the last message, shape (n, 6): see ``ahead.said``."""
    return ahead.said(own, leader, (own.speed - state.speed) / constants.T, constants.brakes)


def demand(constants: Constants, own: Trains, leader: Floats, links: Links, heard: Floats, state: State) -> tuple[Demand, State]:
    """Acceleration of every train, as the module says.

    Parameters
    ----------
    constants : Constants
        From ``constants()``.
    own : Trains
        What each train knows of itself.
    leader : ndarray, shape (4,)
        Position [m], speed [m/s], acceleration [m/s2], ... of the reference.
    links : Links
        Who receives from whom; only the nearest train ahead counts.
    heard : ndarray, shape (L, 6)
        The last message of each link, zeros where none has come yet.
    state : State
        Estimates, and speeds at the instant before.

    Returns
    -------
    Demand
        Acceleration [m/s2], and whether one of the limits acted.
    State
        A control period later.
    """
    c = constants
    other = ahead.seen(c.who, own, leader, links, heard)
    e = np.where(other.known, other.spacing - c.d, 0.0)
    S = (other.speed - own.speed) + c.c * e
    asked = other.acceleration + c.c * (other.speed - own.speed) + c.k * np.clip(S / c.phi, -1.0, 1.0) - state.z2
    cruise = ahead.cruising(own, leader, c.who.follows, c.faster, c.bounds.speed_upper, c.T)
    cruise -= np.where(c.who.follows, np.maximum(state.z2, 0.0), state.z2)
    wanted = ahead.combined(asked, cruise, c.who.follows, other.known)
    u, limited = ahead.within(wanted, c.brakes, c.pulls, c.bounds, own)
    wrong = own.speed - state.z1
    z1 = state.z1 + c.T * (state.z2 + u + 2.0 * c.omega * wrong)
    z2 = np.clip(state.z2 + c.T * c.omega**2 * wrong, -c.unknown, c.unknown)
    return Demand(u, limited), State(own.speed.copy(), z1, z2)


# What must hold before the law may be used


def violations(params: Params, scene: Scene) -> list[str]:
    """Stable in discrete time: the observer, and the law within its layer and on its surface; room for the train ahead."""
    T, who, omega = scene.control_period, ahead.followed(scene), params.observer_per_s
    c, reach = params.surface_per_s, params.reach_mps2 / params.layer_mps
    found = []
    if omega * T >= 1.0:
        found.append(
            f"controller.observer_per_s = {omega:g}: omega T = {omega * T:g} with a control period of {T:g} s; must be below 1"
        )
    if (radius := ahead.spectral_radius(scene, c * reach, c + reach)) >= 1.0:
        found.append(
            f"controller.reach_mps2 = {params.reach_mps2:g}: unstable with surface_per_s = {c:g}, layer_mps ="
            f" {params.layer_mps:g} and a control period of {T:g} s (spectral radius {radius:.4f})"
        )
    for i in np.flatnonzero(who.follows & (who.desired <= who.length)).tolist():
        found.append(
            f"{ahead.named(scene, who, i)}.desired_m = {who.desired[i]:.10g}: must be above {who.length[i]:.10g}, the length of the"
            " train ahead"
        )
    return found


# In comparisons


alternative, on_a_line = ahead.alternative, ahead.on_a_line
