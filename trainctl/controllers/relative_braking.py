"""Virtual coupling by relative braking distance: as fast as a train may be that can still stop behind the train ahead [1]_.

Symbols
-------
x, v     front position [m], speed [m/s]; _l: of the train ahead
b        full braking [m/s2]; b_l: of the train ahead, which it sends
t_r      reaction time [s]: no train brakes before
M        spacing that is left when both stand, front to front [m]: length of the train ahead and margin
S        relative braking distance ``v t_r + v2 / (2 b) - v_l2 / (2 b_l)`` [m]
w        maximum safe speed [m/s]
u        acceleration asked for [m/s2]

The law
-------
[1]_ keeps virtually coupled trains apart by the difference of their braking distances, the way in the reaction time and a margin:
``x_l - x >= M + S``. At the limit this is an equation for the speed,

    w = -b t_r + sqrt(b2 t_r2 + 2 b (x_l - x - M + v_l2 / (2 b_l))),

and the train is driven to it: ``u = (w - v) / t_f``. With t_f at most ``t_r (2 + q) / (2 + 2 q)``, q = b t_r / v, speed errors do
not grow from train to train where both brake alike; the default t_f = t_r / 2 always is.

Departures
----------
* [1]_ is a multi-state model for the analysis of capacity: it switches between running, coupling, coupled running and decoupling,
  and moves trains by their equations of motion. Here the state *coupled running* is a feedback law. It is the one of Gipps for
  road traffic, with rail brakes and what the train ahead sends for its speed and braking.
* M follows from the scenario's desired spacing at the speed of the reference (its maximum, if it changes). A spacing that leaves
  less than the train ahead and ``margin_m`` is refused. At other speeds links are not at their desired spacing.
* Old messages are carried forward, see ``ahead``: a train that braked when last heard is taken to brake on.

References
----------
.. [1] Quaglietta, Wang, Goverde, "A multi-state train-following model for the analysis of virtual coupling railway operations",
   Journal of Rail Transport Planning & Management 15, 2020, 100195.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from trainctl.controllers import ahead, stated
from trainctl.signals import Bounds, Demand, Floats, Links, Scene, Table, Trains

if TYPE_CHECKING:
    from trainctl.contracts import SampledLaw
    from trainctl.controllers import relative_braking

    module: SampledLaw = relative_braking

CLOCK: Literal["sampled"] = "sampled"

#: It listens to the nearest train ahead alone.
FOLLOWS = True

#: Rows of a comparison -> the keys of [controller] that make them.
COMPARED: dict[str, dict[str, Any]] = {"relative_braking": {}}

#: What a train is told in `trainctl compare spacing`, and why its spacing is what it is there.
IN_STOPS = (
    "place and speed of the train ahead. Brakes plan with what every train is sure of; a better brake ahead takes from the margin"
)


class Params(Table):
    """Keys of ``[controller]`` with ``law = "relative_braking"``."""

    braking_mps2: float | None = Field(
        None,
        gt=0.0,
        description="Full braking every train is sure of, b [m/s2]; default from braking_n and the input's bound.",
    )
    reaction_s: float = Field(2.0, gt=0.0, description="Reaction time t_r [s], at least one control period.")
    follow_s: float | None = Field(
        None, gt=0.0, description="Time t_f in which the safe speed is taken up [s]; default half the reaction time."
    )
    margin_m: float = Field(10.0, ge=0.0, description="Gap that must be left at standstill [m].")
    acceleration_mps2: float = Field(0.5, gt=0.0, description="Maximum acceleration asked for [m/s2].")
    deceleration_mps2: float = Field(
        1.0, gt=0.0, description="Maximum deceleration asked for [m/s2]; full braking, if that is more."
    )
    faster_mps: float = Field(3.0, gt=0.0, description="At most so much faster than the reference, to close up [m/s].")


class Constants(NamedTuple):
    """Constants of the law; arrays have shape (n,)."""

    who: ahead.Followed
    b: Floats  # m/s2
    t_r: float  # s
    t_f: float  # s
    M: Floats  # m
    pulls: float  # m/s2
    brakes: Floats  # m/s2
    faster: float  # m/s
    bounds: Bounds
    T: float  # s, control period


def constants(params: Params, scene: Scene) -> Constants:
    """Constants of the law; see ``SampledLaw``."""
    who, b = ahead.followed(scene), ahead.full_braking(scene, params.braking_mps2)
    return Constants(
        who, b, params.reaction_s, _follow_s(params), _margins(params, scene, who, b), params.acceleration_mps2,
        np.maximum(b, params.deceleration_mps2), params.faster_mps,
        scene.bounds, scene.control_period,
    )  # fmt: skip


def _follow_s(params: Params) -> float:
    return 0.5 * params.reaction_s if params.follow_s is None else params.follow_s


def distance(v: Floats | float, b: Floats, v_l: Floats | float, b_l: Floats, t_r: float) -> Floats:
    """Relative braking distance S [m] of a train at speed ``v`` behind one at ``v_l`` [m/s], with full braking ``b``, ``b_l``."""
    found: Floats = v * t_r + 0.5 * np.square(v) / b - 0.5 * np.square(v_l) / b_l
    return found


def _margins(params: Params, scene: Scene, who: ahead.Followed, b: Floats) -> Floats:
    """Spacing that is left at standstill [m], (n,)."""
    top = ahead.fastest(scene.reference)
    b_l = np.where(who.follows, b[scene.links.sender[who.row]] if len(scene.links.sender) else b, b)
    left: Floats = np.where(who.follows, who.desired, 0.0) - distance(top, b, top, b_l, params.reaction_s)
    return left


def message(constants: Constants, own: Trains, leader: Floats) -> Floats:
    """Place relative to the reference, speed and full braking, shape (n, 6): see ``ahead.said``."""
    return ahead.said(own, leader, np.zeros_like(own.speed), constants.b)


def demand(constants: Constants, own: Trains, leader: Floats, links: Links, heard: Floats) -> Demand:
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

    Returns
    -------
    Demand
        Acceleration [m/s2], and whether one of the limits acted.
    """
    c = constants
    other = ahead.seen(c.who, own, leader, links, heard)
    stops = 0.5 * np.square(other.speed) / np.where(other.known, other.braking, c.b)  # the train ahead, from where it is
    room = np.where(other.known, other.spacing - c.M, 0.0) + stops
    w = np.sqrt(np.maximum(np.square(c.b * c.t_r) + 2.0 * c.b * room, 0.0)) - c.b * c.t_r
    asked = (np.maximum(w, 0.0) - own.speed) / c.t_f
    cruise = ahead.cruising(own, leader, c.who.follows, c.faster, c.bounds.speed_upper, c.T)
    return Demand(*ahead.within(ahead.combined(asked, cruise, c.who.follows, other.known), c.brakes, c.pulls, c.bounds, own))


# What must hold before the law may be used


def violations(params: Params, scene: Scene) -> list[str]:
    """Known braking, a reaction time that lasts a control period, and room for the relative braking distance."""
    who, b = ahead.followed(scene), ahead.full_braking(scene, params.braking_mps2)
    found = list(ahead.braking_violations(scene, b, "controller.braking_mps2"))
    for key, value in (("reaction_s", params.reaction_s), ("follow_s", _follow_s(params))):
        if value < scene.control_period * (1.0 if key == "reaction_s" else 0.5):
            found.append(
                f"controller.{key} = {value:g}: must be at least {'one' if key == 'reaction_s' else 'half a'} control period of"
                f" {scene.control_period:g} s"
            )
    if found:
        return found
    top, left = ahead.fastest(scene.reference), _margins(params, scene, who, b)
    for i in np.flatnonzero(who.follows & (left < who.length + params.margin_m)).tolist():
        kept = who.desired[i] - left[i]
        found.append(
            f"{ahead.named(scene, who, i)}.desired_m = {who.desired[i]:.10g}: must be at least"
            f" {kept + who.length[i] + params.margin_m:.6g} at {top:g} m/s: reaction and difference of braking"
            f" distances {kept:.6g}, the train ahead {who.length[i]:.10g}, margin_m {params.margin_m:g}"
        )
    return found


def report(params: Params, scene: Scene, disturbances: Sequence[Any]) -> list[str]:
    """The distance kept at the speed of the reference, and the absolute braking distance beside it."""
    who, b, top = ahead.followed(scene), ahead.full_braking(scene, params.braking_mps2), ahead.fastest(scene.reference)
    if not who.follows.any():
        return []
    kept = float(np.max(who.desired[who.follows] - _margins(params, scene, who, b)[who.follows]))
    absolute = float(np.max(top * params.reaction_s + 0.5 * top**2 / b))
    return [f"relative braking distance with reaction {kept:.4g} m at {top:g} m/s; the absolute one is {absolute:.4g} m"]


# In comparisons


alternative, on_a_line = ahead.alternative, ahead.on_a_line


def in_stops(tables: stated.Tables, band: dict[str, float], braking: tuple[float, float]) -> dict[str, Any]:
    """Tables of its row in `trainctl compare spacing`: it plans with the braking every train is sure of."""
    sure, _ = braking
    return {**on_a_line(tables, band), "controller": {**tables["controller"], "braking_mps2": sure}}
