"""Constant time gap: adaptive cruise control [1]_, [2]_, and with the acceleration of the train ahead the cooperative one [3]_.

Symbols
-------
x, v     front position [m], speed [m/s]; _l: of the train ahead, with its acceleration a_l [m/s2]
h        time gap [s]
r        spacing at standstill, front to front [m]
e        spacing error ``x_l - x - (r + h v)`` [m]
lambda   gain of the spacing error [1/s]
k_a      share of the acceleration of the train ahead that is passed on, 0 <= k_a < 1
u        acceleration asked for [m/s2]
tau      lag of the actuator [s], ``tau a' = u - a``

The law
-------
``u = k_a a_l + ((1 - k_a) (v_l - v) + lambda e) / h``. With k_a = 0 this is the law of [1]_ and [2]_: on-board sensors do.
Otherwise it is that of [3]_, with the gains k_v = (1 - k_a) / h and k_p = lambda / h.

String stability: with lag tau the way from v_l to v has the gain ``(k_a s2 + k_v s + k_p) / (tau s3 + s2 + (k_v + h k_p) s +
k_p)``. With these gains its square below its denominator's at w is ``w4 (tau2 w4 + (1 - k_a2 - 2 tau (k_v + lambda)) w2 +
lambda2)``, which is never negative if and only if ``h >= 2 tau / (1 + k_a)``, whatever lambda: the conditions of [2]_ (k_a = 0)
and [3]_. A time gap below it is a warning of ``trainctl check``, where half a control period counts as a lag, for so late a held
acceleration acts.

Departures
----------
* The scenario states a desired spacing d at the speed of the reference v_r (its maximum, if it changes). Where ``time_gap_s`` is
  left out, h follows from d and ``standstill_m``; where it is given, r does. At other speeds links are not at their desired
  spacing.
* a_l is the mean acceleration of the control period before, as the train ahead measures it: what it asks for may not be what it
  gets.
* Old messages are carried forward, see ``ahead``. One that follows none takes the speed of the reference, and none runs faster than
  ``faster_mps`` above that to close up.

References
----------
.. [1] Ioannou, Chien, "Autonomous intelligent cruise control", IEEE Transactions on Vehicular Technology 42(4), 1993.
.. [2] Rajamani, "Vehicle Dynamics and Control", 2nd edition, Springer 2012, chapter 6.
.. [3] Darbha, Konduri, Pagilla, "Benefits of V2V Communication for Autonomous and Connected Vehicles", arXiv:1803.02900.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from trainctl.controllers import ahead, stated
from trainctl.signals import SPEED, Bounds, Demand, Floats, Links, Scene, Table, Trains

if TYPE_CHECKING:
    from trainctl.contracts import RememberingLaw
    from trainctl.controllers import time_headway

    module: RememberingLaw = time_headway

CLOCK: Literal["sampled"] = "sampled"

#: It listens to the nearest train ahead alone.
FOLLOWS = True

#: Rows of a comparison -> the keys of [controller] that make them.
COMPARED: dict[str, dict[str, Any]] = {"time_headway": {}, "time_headway_cooperative": {"acceleration_share": 0.8}}

#: What a train is told in `trainctl compare spacing`, and why its spacing is what it is there.
IN_STOPS = (
    "place, speed and, where it is cooperative, acceleration of the train ahead. What brakes scatter must be left at standstill"
)


class Params(Table):
    """Keys of ``[controller]`` with ``law = "time_headway"``."""

    time_gap_s: float | None = Field(
        None, gt=0.0, description="Time gap h [s]; default from desired spacing, speed of the reference and standstill_m."
    )
    standstill_m: float = Field(20.0, ge=0.0, description="Gap to the train ahead at standstill [m], without time_gap_s.")
    gain_per_s: float = Field(0.1, gt=0.0, description="Gain of the spacing error, lambda [1/s].")
    acceleration_share: float = Field(
        0.0, ge=0.0, lt=1.0, description="Share k_a of the acceleration of the train ahead that is passed on; 0: it is not sent."
    )
    acceleration_mps2: float = Field(0.5, gt=0.0, description="Maximum acceleration asked for [m/s2].")
    deceleration_mps2: float = Field(1.0, gt=0.0, description="Maximum deceleration asked for [m/s2].")
    faster_mps: float = Field(3.0, gt=0.0, description="At most so much faster than the reference, to close up [m/s].")


class Constants(NamedTuple):
    """Constants of the law; arrays have shape (n,)."""

    who: ahead.Followed
    h: Floats  # s
    r: Floats  # m, front to front
    gain: float  # 1/s
    k_a: float
    pulls: float  # m/s2
    brakes: Floats  # m/s2
    faster: float  # m/s
    bounds: Bounds
    period: float  # s


class State(NamedTuple):
    """What the law remembers."""

    speed: Floats  # (n,) m/s, a control period ago


def initial(params: Params, scene: Scene) -> State:
    """No train has accelerated yet."""
    return State(scene.own[scene.consists.first[:-1], SPEED].copy())


def constants(params: Params, scene: Scene) -> Constants:
    """Constants of the law; see ``SampledLaw``."""
    who = ahead.followed(scene)
    h, r = _gaps(params, scene, who)
    return Constants(
        who, np.maximum(h, scene.step * 1e-3), r, params.gain_per_s, params.acceleration_share, params.acceleration_mps2,
        np.full(len(h), params.deceleration_mps2), params.faster_mps, scene.bounds, scene.control_period,
    )  # fmt: skip


def _gaps(params: Params, scene: Scene, who: ahead.Followed) -> tuple[Floats, Floats]:
    """Time gap [s] and spacing at standstill [m] of every train, (n,); 1 s and 0 m of those that follow none."""
    top = ahead.fastest(scene.reference)
    d = np.where(who.follows, who.desired, top)
    if params.time_gap_s is not None:
        h = np.full(len(d), params.time_gap_s)
        return h, d - h * top
    r = np.where(who.follows, who.length + params.standstill_m, 0.0)
    return (d - r) / max(top, ahead.STANDS_MPS), r


def message(constants: Constants, own: Trains, leader: Floats, state: State) -> Floats:
    """Place relative to the reference, speed and mean acceleration since the last message, shape (n, 6): see ``ahead.said``."""
    acceleration = (own.speed - state.speed) / constants.period if constants.k_a > 0.0 else np.zeros_like(own.speed)
    return ahead.said(own, leader, acceleration, constants.brakes)


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
        Speeds at the instant before.

    Returns
    -------
    Demand
        Acceleration [m/s2], and whether one of the limits acted.
    State
        Speeds now.
    """
    c = constants
    other = ahead.seen(c.who, own, leader, links, heard)
    spacing = np.where(other.known, other.spacing, 0.0)
    e = spacing - (c.r + c.h * own.speed)
    asked = c.k_a * other.acceleration + ((1.0 - c.k_a) * (other.speed - own.speed) + c.gain * e) / c.h
    cruise = ahead.cruising(own, leader, c.who.follows, c.faster, c.bounds.speed_upper, c.period)
    given, limited = ahead.within(ahead.combined(asked, cruise, c.who.follows, other.known), c.brakes, c.pulls, c.bounds, own)
    return Demand(given, limited), State(own.speed.copy())


# What must hold before the law may be used


def violations(params: Params, scene: Scene) -> list[str]:
    """A time gap above 0, room for the train ahead at standstill, and a sampled loop that is stable."""
    who, found = ahead.followed(scene), list[str]()
    h, r = _gaps(params, scene, who)
    for i in np.flatnonzero(who.follows).tolist():
        name, needs = ahead.named(scene, who, i), who.length[i] + (params.standstill_m if params.time_gap_s is None else 0.0)
        if params.time_gap_s is None and h[i] <= 0.0:
            found.append(
                f"{name}.desired_m = {who.desired[i]:.10g}: leaves a time gap of {h[i]:.4g} s; must be above {needs:.10g}, the"
                " train ahead and standstill_m"
            )
        elif r[i] < needs:
            found.append(
                f"controller.time_gap_s = {h[i]:.10g}: at standstill leaves a spacing of {r[i]:.6g} m of the desired"
                f" {who.desired[i]:.10g} m on {name}, and the train ahead is {who.length[i]:.10g} m long"
            )
        elif (radius := _radius(params, float(h[i]), scene)) >= 1.0:
            found.append(
                f"controller.time_gap_s = {h[i]:.4g}: unstable with gain_per_s = {params.gain_per_s:g} and a control period of"
                f" {scene.control_period:g} s on {name} (spectral radius {radius:.4f})"
            )
    return found


def _radius(params: Params, h: float, scene: Scene) -> float:
    """Spectral radius of one train behind another that keeps its speed, over a control period."""
    return ahead.spectral_radius(scene, params.gain_per_s / h, (1.0 - params.acceleration_share) / h + params.gain_per_s)


def minimum_gap(lag: float, acceleration_share: float) -> float:
    """Time gap below which disturbances grow from train to train [s]: ``2 tau / (1 + k_a)`` of [2]_ and [3]_."""
    return 2.0 * lag / (1.0 + acceleration_share)


def warnings(params: Params, scene: Scene, tracks: Sequence[int] | None = None) -> list[str]:
    """Time gaps that are not string stable."""
    who = ahead.followed(scene)
    h, _ = _gaps(params, scene, who)
    rate = scene.consists.actuator_rate[scene.consists.first[:-1]]
    lag = 0.5 * scene.control_period + np.where(rate > 0.0, 1.0 / np.where(rate > 0.0, rate, 1.0), 0.0)
    short = np.flatnonzero(who.follows & (h < 2.0 * lag / (1.0 + params.acceleration_share)))
    if not len(short):
        return []
    i = int(short[np.argmin(h[short] / lag[short])])
    return [
        f"controller: not string stable: the time gap of train {scene.trains[i]} is {h[i]:.4g} s, and with a lag of {lag[i]:.4g} s"
        f" (half a control period included) it must be at least {minimum_gap(lag[i], params.acceleration_share):.4g} s"
    ]


def report(params: Params, scene: Scene, disturbances: Sequence[Any]) -> list[str]:
    """Time gap and spacing at standstill."""
    who = ahead.followed(scene)
    h, r = _gaps(params, scene, who)
    if not who.follows.any():
        return []
    h, r = h[who.follows], r[who.follows]
    kind = "cooperative" if params.acceleration_share > 0.0 else "on-board sensors"
    return [f"time gap {_span(h)} s, spacing at standstill {_span(r)} m ({kind})"]


def _span(values: Floats) -> str:
    low, high = float(values.min()), float(values.max())
    return f"{low:.4g}" if math.isclose(low, high) else f"{low:.4g} .. {high:.4g}"


# In comparisons


alternative, on_a_line = ahead.alternative, ahead.on_a_line


def in_stops(tables: stated.Tables, band: dict[str, float], braking: tuple[float, float]) -> dict[str, Any]:
    """Tables of its rows in `trainctl compare spacing`: 60 % of the clear distance are left at standstill, for brakes scatter.

    Tried were gains of 0.05 to 0.4 1/s and 3 to 75 % of the clear distance at one spacing: 500 m of 800 m came nearest.
    """
    left = 0.6 * (tables["topology"]["spacing_m"] - stated.longest(tables))
    return {**on_a_line(tables, band), "controller": {**tables["controller"], "gain_per_s": 0.2, "standstill_m": max(left, 0.0)}}
