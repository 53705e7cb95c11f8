"""Distributed linear model predictive control: every train plans its accelerations behind what the train ahead has planned [1]_.

Symbols
-------
x, v, a  front position [m], speed [m/s] and acceleration [m/s2] of a train; _l: of the train ahead
j, N     period of the horizon, 1 .. N
T        control period [s]
theta    lead of the plant: ``x(j+1) = x(j) + ((1 - theta) v(j) + theta v(j+1)) T``
e        spacing error ``x_l - x - d`` [m], d the desired spacing
w        ``v_l - v`` [m/s]
b        full braking [m/s2]; b_l: of the train ahead, which it sends
m        margin [m], l length of the train ahead [m]

The law
-------
Every train sends its place and speed, and the accelerations it plans. Over a horizon of N periods each minimises

    sum over j of  q_e e(j)2 + q_v w(j)2 + q_a (a(j) - a_l(j))2 + q_j (a(j) - a(j-1))2

subject to, in every period, ``x_l - x >= l + m``, the bounds of speed, ``-b <= a <= a_max`` and those of the input, and ``|a(j) -
a(j-1)| <= jerk T``; and to a bound on the first acceleration, after which the train could still stop behind the train ahead if
that one braked fully from now on: ``x_l + v_l2 / (2 b_l) - x(1) - v(1) t_r - v(1)2 / (2 b) >= l + m``. The first acceleration is
applied, and the next period plans anew: [1]_ with linear dynamics (running resistance is made up for, as in all laws here), so
that the problem is a quadratic programme. DAQP [2]_ solves it by an active set: exactly, not up to a tolerance of the
constraints. It starts from the constraints that were active in the plan before.

What is not feasible
--------------------
Where no plan keeps all constraints (a train ahead that breaks its plan, a message that came too late), the train brakes fully, and
the column ``saturated`` tells so, in that period alone. A speed above its bound widens it to what it is, and must come back by
``RETURN_MPS2`` at least. Of the room between the reference and the maximum speed a part is left for what disturbs, as in ``ahead``.

Departures
----------
* [1]_ has a terminal set; here the bound on the first acceleration makes sure that a feasible plan exists in the next period as
  well.
* A train that does not do what it planned, since its brakes are ordered from elsewhere or its actuators are at their limits,
  sends that it goes on as it does: [1]_ leaves this open.
* Old messages are carried forward, see ``ahead``, and the plan in them with them. One that follows none plans behind the reference.

References
----------
.. [1] Liu, Liu, Wei, Xun, Tang, "Distributed Model Predictive Control Strategy for Constrained High-Speed Virtually Coupled Train
   Set", IEEE Transactions on Vehicular Technology 71(1), 2022.
.. [2] Arnstrom, Bemporad, Axehill, "A Dual Active-Set Solver for Embedded Quadratic Programming Using Recursive LDL^T Updates",
   IEEE Transactions on Automatic Control 67(8), 2022.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from trainctl.controllers import ahead, stated
from trainctl.signals import SPEED, Bools, Bounds, Demand, Floats, Ints, Links, Scene, Table, Trains

try:
    import daqp
except ModuleNotFoundError:  # an optional extra: without it the law is named, and refused
    daqp = None

if TYPE_CHECKING:
    from trainctl.contracts import RememberingLaw
    from trainctl.controllers import model_predictive

    module: RememberingLaw = model_predictive

CLOCK: Literal["sampled"] = "sampled"

#: It listens to the nearest train ahead alone.
FOLLOWS = True

#: Rows of a comparison -> the keys of [controller] that make them.
COMPARED: dict[str, dict[str, Any]] = {"model_predictive": {}}

#: What a train is told in `trainctl compare spacing`, and why its spacing is what it is there.
IN_STOPS = "place, speed and plan of the train ahead. It starts only where the best brake ahead leaves the worst one room"

#: Flags of DAQP: a constraint that is active, at its upper or at its lower bound.
ACTIVE_UPPER, ACTIVE_LOWER = 1, 3

#: A train that accelerates otherwise than it planned by more than this says so [m/s2].
OFF_PLAN_MPS2 = 0.05

#: A train above its speed bound comes back to it by at least this [m/s2]; more than unknown forces push it on.
RETURN_MPS2 = 0.1

#: No speed is below 0, and none is bounded above where the scenario says nothing [m/s].
UNBOUNDED_MPS = 1e3


class Params(Table):
    """Keys of ``[controller]`` with ``law = "model_predictive"``."""

    horizon: int = Field(20, ge=2, le=200, description="Periods of the horizon, N.")
    spacing_weight: float = Field(0.02, gt=0.0, description="Weight q_e of the spacing errors [1/m2].")
    speed_weight: float = Field(1.0, gt=0.0, description="Weight q_v of the speed differences [s2/m2].")
    acceleration_weight: float = Field(1.0, gt=0.0, description="Weight q_a of accelerations unlike those ahead [s4/m2].")
    change_weight: float = Field(2.0, ge=0.0, description="Weight q_j of changes of the acceleration [s4/m2].")
    acceleration_mps2: float = Field(0.5, gt=0.0, description="Maximum acceleration [m/s2].")
    braking_mps2: float | None = Field(
        None,
        gt=0.0,
        description="Full braking every train is sure of, b [m/s2]; default from braking_n and the input's bound.",
    )
    ahead_braking_mps2: float | None = Field(
        None, gt=0.0, description="Full braking that the train ahead is assumed to have, b_l [m/s2]; default what it sends."
    )
    deceleration_mps2: float = Field(
        1.0, gt=0.0, description="Deceleration asked for where no plan is feasible [m/s2]; full braking, if that is more."
    )
    jerk_mps3: float = Field(0.5, gt=0.0, description="Maximum jerk [m/s3].")
    margin_m: float = Field(10.0, ge=0.0, description="Gap that is always kept [m].")
    reaction_s: float = Field(1.0, ge=0.0, description="Time t_r that passes before a train brakes [s].")


class Constants(NamedTuple):
    """Constants of the law; arrays have shape (n,) unless they say so."""

    who: ahead.Followed
    d: Floats  # m
    b: Floats  # m/s2
    bounds: Bounds
    params: Params
    T: float  # s
    theta: float
    L: Floats  # (N, N) s, accelerations -> speeds
    M: Floats  # (N, N) s2, accelerations -> positions
    D: Floats  # (N, N) accelerations -> their changes
    solver: Any  # what is fixed of every train's programme, set up; each starts it from its own active set


class State(NamedTuple):
    """What the law remembers."""

    speed: Floats  # (n,) m/s, a control period ago
    plan: Floats  # (n, N) m/s2, accelerations planned then, the first one asked for
    active: Ints  # (n, 4 N) flags of the constraints


def initial(params: Params, scene: Scene) -> State:
    """Every train plans to go on as it does."""
    n, N = len(scene.trains), params.horizon
    v = scene.own[scene.consists.first[:-1], SPEED]
    return State(v.copy(), np.zeros((n, N)), np.zeros((n, 4 * N), np.int64))


def constants(params: Params, scene: Scene) -> Constants:
    """Constants of the law; see ``SampledLaw``."""
    who, N, T, theta = ahead.followed(scene), params.horizon, scene.control_period, scene.lead
    before = np.tri(N)
    L = T * before
    M = T * T * np.tril(np.subtract.outer(np.arange(N), np.arange(N)) + theta)
    D = np.eye(N) - np.eye(N, k=-1)
    H = params.spacing_weight * M.T @ M + params.speed_weight * L.T @ L
    H += params.acceleration_weight * np.eye(N) + params.change_weight * D.T @ D
    solver = daqp.Model()
    free = np.full(4 * N, 1e30)
    solver.setup(H, np.zeros(N), np.vstack((L, M, D)), free, -free, np.zeros(4 * N, np.int32))
    d = np.where(who.follows, who.desired, 0.0)
    return Constants(who, d, ahead.full_braking(scene, params.braking_mps2), scene.bounds, params, T, theta, L, M, D, solver)


def message(constants: Constants, own: Trains, leader: Floats, state: State) -> Floats:
    """What ``ahead.said`` says, and the accelerations of the horizon, shape (n, 6 + N)."""
    now = (own.speed - state.speed) / constants.T
    return np.column_stack((ahead.said(own, leader, now, constants.b), _going_on(now, state.plan)))


def _going_on(now: Floats, plan: Floats) -> Floats:
    """The plan of the period before, one period on; who is off his plan goes on as he does, (n, N)."""
    shifted = np.column_stack((plan[:, 1:], np.zeros(len(plan))))
    off = np.abs(now - plan[:, 0]) > OFF_PLAN_MPS2
    return np.where(off[:, None], now[:, None], shifted)


def demand(constants: Constants, own: Trains, leader: Floats, links: Links, heard: Floats, state: State) -> tuple[Demand, State]:
    """First acceleration of every train's plan, as the module says.

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
    heard : ndarray, shape (L, 6 + N)
        The last message of each link, zeros where none has come yet.
    state : State
        Plans and speeds of the instant before.

    Returns
    -------
    Demand
        Acceleration [m/s2], and whether no plan was feasible.
    State
        Plans and speeds now.
    """
    c, n, N = constants, len(own.speed), constants.params.horizon
    other = ahead.seen(c.who, own, leader, links, heard[:, : ahead.SAID + 1])
    planned = heard[c.who.row, ahead.SAID + 1 :] if len(heard) else np.zeros((n, N))
    cruise, reference = (np.broadcast_to(leader[k], n) for k in (SPEED, 2))
    fastest = np.minimum(c.bounds.speed_upper, UNBOUNDED_MPS)
    top = np.where(c.who.follows, np.minimum(fastest, cruise + ahead.ROOM_TO_CLOSE_UP * np.maximum(fastest - cruise, 0.0)), fastest)
    plan, active, infeasible = np.zeros((n, N)), np.zeros((n, 4 * N), np.int64), np.zeros(n, bool)
    before = np.where(_off(own, state, c.T), (own.speed - state.speed) / c.T, state.plan[:, 0])
    for i in range(n):
        if c.who.follows[i] and not other.known[i]:  # it has not heard of the train ahead: it does not accelerate
            plan[i] = np.minimum(state.plan[i], 0.0)
            continue
        a_l = planned[i] if other.known[i] else np.full(N, reference[i])
        spacing = other.spacing[i] if other.known[i] else c.d[i]
        solved = _solved(c, i, own, other, spacing, float(top[i]), a_l, float(before[i]), state.active[i])
        if solved is None:
            infeasible[i] = True
            plan[i] = -min(max(c.b[i], c.params.deceleration_mps2), own.speed[i] / c.T)
            plan[i, 1:] = np.where(own.speed[i] + c.T * np.cumsum(plan[i])[:-1] > 0.0, plan[i, 1:], 0.0)
        else:
            plan[i], active[i] = solved
    return Demand(plan[:, 0].copy(), infeasible), State(own.speed.copy(), plan, active)


def _off(own: Trains, state: State, T: float) -> Bools:
    off: Bools = np.abs((own.speed - state.speed) / T - state.plan[:, 0]) > OFF_PLAN_MPS2
    return off


def _solved(
    c: Constants, i: int, own: Trains, other: ahead.Seen, spacing: float, top: float, a_l: Floats, before: float, active: Ints
) -> tuple[Floats, Ints] | None:
    """The plan of train ``i`` (N,) and its active constraints (4 N,); None if there is none.

    ``spacing`` [m] is that to the train ahead now, ``top`` the maximum speed [m/s], ``a_l`` (N,) what the one ahead plans,
    ``before`` the acceleration a period ago.
    """
    p, N, T, v = c.params, c.params.horizon, c.T, float(own.speed[i])
    v_l = np.maximum(other.speed[i] + c.L @ a_l, 0.0)
    way = T * np.cumsum((1.0 - c.theta) * np.concatenate((other.speed[i : i + 1], v_l[:-1])) + c.theta * v_l)
    room = spacing + way - v * T * np.arange(1, N + 1)  # to the train ahead, were this one to keep its speed
    f = -p.spacing_weight * (c.M.T @ (room - c.d[i])) - p.speed_weight * (c.L.T @ (v_l - v)) - p.acceleration_weight * a_l
    f[0] -= p.change_weight * before
    known = bool(other.known[i])
    upper, lower = np.full(4 * N, 1e30), np.full(4 * N, -1e30)
    lower[:N] = max(-c.b[i], c.bounds.input_lower[i] - own.resistance[i])
    upper[:N] = min(p.acceleration_mps2, c.bounds.input_upper[i] - own.resistance[i])
    if known:
        upper[0] = min(upper[0], (_safe(c, i, v, spacing, other) - v) / T)
        upper[2 * N : 3 * N] = room - c.who.length[i] - p.margin_m
    lower[N : 2 * N] = min(max(c.bounds.speed_lower[i], 0.0), v) - v
    first = min(max(before - p.jerk_mps3 * T, -RETURN_MPS2), 0.0)  # from where it is the jerk may forbid more in one period
    upper[N : 2 * N] = np.maximum(top - v, T * (first - RETURN_MPS2 * np.arange(N)))
    lower[3 * N :], upper[3 * N :] = -p.jerk_mps3 * T, p.jerk_mps3 * T
    lower[3 * N] += before
    upper[3 * N] += before
    if (upper < lower).any():
        return None
    c.solver.update(f=f, bupper=upper, blower=lower, sense=active.astype(np.int32))
    plan, _, flag, told = c.solver.solve()
    if flag < 1:
        return None
    multiplier = np.asarray(told["lam"])
    flags = np.where(multiplier > 0.0, ACTIVE_UPPER, np.where(multiplier < 0.0, ACTIVE_LOWER, 0))
    return np.array(plan), flags.astype(np.int64)


def _safe(c: Constants, i: int, v: float, spacing: float, other: ahead.Seen) -> float:
    """Maximum speed a period from now [m/s] from which train ``i`` stops behind one that brakes from now on; -1: none."""
    p, b = c.params, float(c.b[i])
    b_l = p.ahead_braking_mps2 or float(other.braking[i])
    stands = spacing + 0.5 * float(other.speed[i]) ** 2 / b_l  # where that one stops, from here
    left = stands - c.who.length[i] - p.margin_m - (1.0 - c.theta) * v * c.T
    late = b * (c.theta * c.T + p.reaction_s)
    return float(np.sqrt(late**2 + 2.0 * b * left)) - late if left > 0.0 else -1.0


# What must hold before the law may be used


def horizon_s(params: Params, scene: Scene) -> float:
    """How far it looks ahead [s]."""
    return params.horizon * scene.control_period


def violations(params: Params, scene: Scene) -> list[str]:
    """The solver, known braking, and room for the relative braking distance at the speed of the reference."""
    if daqp is None:
        return ["controller.law = model_predictive: needs the solver DAQP: pip install trainctl[mpc]"]
    who, b, top = ahead.followed(scene), ahead.full_braking(scene, params.braking_mps2), ahead.fastest(scene.reference)
    found = list(ahead.braking_violations(scene, b, "controller.braking_mps2"))
    if found:
        return found
    for i in np.flatnonzero(who.follows).tolist():
        b_l = params.ahead_braking_mps2 or b[scene.links.sender[who.row[i]]]
        needed = float(who.length[i]) + params.margin_m + top * (scene.control_period + params.reaction_s)
        needed += max(0.5 * top**2 / float(b[i]) - 0.5 * top**2 / float(b_l), 0.0)
        if who.desired[i] < needed:
            found.append(
                f"{ahead.named(scene, who, i)}.desired_m = {who.desired[i]:.10g}: must be at least {needed:.6g} at {top:g} m/s: one"
                f" control period and reaction, the difference of braking distances, the train ahead {who.length[i]:.10g}, margin_m"
                f" {params.margin_m:g}"
            )
    return found


# In comparisons


alternative, on_a_line = ahead.alternative, ahead.on_a_line


def in_stops(tables: stated.Tables, band: dict[str, float], braking: tuple[float, float]) -> dict[str, Any]:
    """Tables of its row in `trainctl compare spacing`: its own brakes are the worst, those ahead the best."""
    sure, best = braking
    return {**on_a_line(tables, band), "controller": {**tables["controller"], "braking_mps2": sure, "ahead_braking_mps2": best}}
