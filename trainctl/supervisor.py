"""Protection: the greatest acceleration with which no train can come to reach what it must not reach, a function of data.

Whoever drives, ``verdict`` bounds each train's acceleration over the coming step and ``applied`` enforces the bounds. Trains move
in steps: ``v' = max(0, v + a T)``, ``x' = x + ((1 - theta) v + theta v') T``, 0 <= theta < 1; theta is 0 for point trains (they
move with the old speed) and 1/2 where the acceleration is held over the step.

Symbols
-------
T, theta    step [s], share of the new speed in a step's way
b, c        emergency and service deceleration [m/s2]
D(v)        way from speed v to a stand with full braking, in steps [m]
v, w        speed of the train and of the one ahead or opposite; after the step v', w' [m/s]
d           distance from the front to the point, less the margin [m]

Notes
-----
Why no train reaches its point, by induction over the steps. A state is *safe* if full braking of all trains from now on ends with
no margin touched: before a fixed point ``d >= D(v)``, behind a moving train ``d >= D(v) - D(w)``, against an opposing one
``d >= D(v) + D(w)``.

1. Full braking for one step takes ``D(v) - D(v')``, so a safe state stays safe under it, and there always is a safe choice.
   ``verdict`` takes the greatest v' that is safe after the step for the least the others can do: the train ahead brakes with b,
   it cannot brake harder (``least``); of two opposing trains each takes half of ``d - D(v) - D(w)`` for itself at most.
   Whatever more the train ahead does only adds, because its way and D(w') grow with w'. So a safe state stays safe, whatever
   is demanded.
2. Nothing is missed on the way to the end. Behind a train ahead with v' >= w', safety says ``d' >= D(v') - D(w') >= 0``. If
   v' < w' even when the train ahead brakes fully, then v < w too, because no train brakes harder than b: the lower speed before
   and after, so the gap grew. Hence no gap falls below the margin, and one that began below it does not shrink.

Holding the speed v behind a train of the same speed therefore needs v T beyond the margin: the train ahead may begin to brake
now, its follower learns of it one step later.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field, model_validator

from trainctl.signals import Bools, Floats, Ints, Table

#: What can bind a train; ``Targets.kind`` and ``Verdict.reason`` are places in it. "limit" is of ``Limits`` only.
KINDS = ("train", "opposing", "switch", "stop", "end", "limit")
TRAIN, OPPOSING, SWITCH, STOP, END, LIMIT = range(6)

#: Farther than anything here [m]: stands for no bound in the sums.
_FAR = 1e9

#: Rounding in lengths [m] and accelerations [m/s2].
_LENGTH, _RATE = 1e-6, 1e-9


class Params(Table):
    """Keys of the scenario's [supervisor] table."""

    mode: Literal["off", "monitor", "on"] = Field(
        "off", description="on: bounds every train's acceleration; monitor: reports what it would have done, without doing it."
    )
    curve: Literal["relative", "absolute"] = Field(
        "relative", description="A train ahead is taken to need its braking distance itself, or to stand where its rear is now."
    )
    emergency_mps2: float = Field(
        1.0, gt=0.0, description="Deceleration [m/s2] every train can give at any speed, and none is let exceed."
    )
    service_mps2: float = Field(
        0.7, gt=0.0, description="Deceleration [m/s2] planned with before lower speed limits and stops; at most emergency_mps2."
    )
    margin_m: float = Field(20.0, ge=0.0, description="Kept between a front and what it must not reach [m]; stops are reached.")
    greatest_mps2: float = Field(1.0, gt=0.0, description="Greatest acceleration admitted [m/s2].")
    emergency_distance_m: float = Field(
        0.0, ge=0.0, description="Gap to another train [m] below which emergency braking is ordered whatever the speeds."
    )

    @model_validator(mode="after")
    def _rates(self) -> Params:
        if self.service_mps2 > self.emergency_mps2:
            raise ValueError(f"service_mps2 = {self.service_mps2:g}: at most emergency_mps2 = {self.emergency_mps2:g}")
        return self


class Targets(NamedTuple):
    """What fronts must not reach, shape (k,); in any order, any number per train.

    An opposing train is in two rows, one for each of the pair, both with the whole distance between the fronts.
    """

    train: Ints  # whose target it is
    room: Floats  # m, front to the point now, margin not subtracted; rear of the train ahead, front of an opposing one
    speed: Floats  # m/s, of the point: along the way for a train ahead, towards us for an opposing one; >= 0
    moving: Bools  # False: the point stands; or will, as far as this train may rely on it
    kind: Ints  # place in KINDS
    other: Ints  # the other train, -1 if none


class Limits(NamedTuple):
    """Greatest speeds, shape (k,); in any order, any number per train."""

    train: Ints
    distance: Floats  # m, front to where it begins; <= 0: in force
    speed: Floats  # m/s, inf: none


class Verdict(NamedTuple):
    """What every train may do over the coming step, shape (n,)."""

    greatest: Floats  # m/s2, >= least
    least: Floats  # m/s2, full emergency braking, but not backwards: a step ends at a stand at worst
    emergency: Bools  # full emergency braking is ordered of a moving train
    reason: Ints  # place in KINDS of what binds, -1: nothing does
    target: Ints  # row of what binds, in Limits if the reason is "limit", otherwise in Targets; -1: none
    strongest: float  # m/s2, -emergency_mps2


def no_targets() -> Targets:
    """Nothing in the way of anybody."""
    none = np.zeros(0, np.int64)
    return Targets(none, np.zeros(0), np.zeros(0), np.zeros(0, bool), none, none)


def no_limits() -> Limits:
    """No speed limits."""
    return Limits(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))


def stopping_distance(speed: Floats, b: float, step: float, theta: float) -> Floats:
    """Way [m] from ``speed`` [m/s] to a stand, braking with ``b`` [m/s2] in steps of ``step`` [s]: D of the module.

    With ``v = (m + f) b T``, m whole, 0 <= f < 1: ``D = b T^2 ((m + 1)(m/2 + f) - theta (m + f))``. At least ``v^2 / 2b`` for
    theta <= 1/2, equal to it for theta = 1/2 and f = 0. Shape of ``speed``.
    """
    steps = speed / (b * step)
    m = np.floor(steps)
    f = steps - m
    way: Floats = b * step**2 * ((m + 1.0) * (0.5 * m + f) - theta * steps)
    return way


def greatest_speed(room: Floats, b: float, step: float, theta: float) -> Floats:
    """Greatest speed [m/s] with ``stopping_distance`` within ``room`` [m]; 0 where there is no room. Shape of ``room``."""
    s = np.maximum(room, 0.0) / (b * step**2)
    m = np.maximum(np.floor(theta - 0.5 + np.sqrt((theta - 0.5) ** 2 + 2.0 * s)), 0.0)
    f = (s - m * (0.5 * (m + 1.0) - theta)) / (m + 1.0 - theta)
    speed: Floats = b * step * (m + np.clip(f, 0.0, 1.0))
    return speed


def curve(room: Floats, target_speed: Floats, b: float) -> Floats:
    """Speed [m/s] from which braking with ``b`` [m/s2] over ``room`` [m] ends at ``target_speed`` [m/s]: the service curve."""
    speed: Floats = np.sqrt(target_speed**2 + 2.0 * b * np.maximum(room, 0.0))
    return speed


def speed_after(room: Floats, target_speed: Floats, speed: Floats, b: float, step: float, theta: float) -> Floats:
    """Greatest v' [m/s] after a step from which braking still ends at ``target_speed`` u, in whole steps, within ``room`` [m].

    Reaching u from ``v' = u + e`` in N steps takes ``T (S - theta e) + N u T`` with S the sum of the excesses e, e - b T, ...
    down to 0; with the way of the step itself that is ``T S + (N + theta) u T + (1 - theta) v T``. For given N it is linear in e;
    where it jumps, from N to N + 1 steps, v' stays. Never below u: at u or slower there is nothing to brake for.
    """
    unit = b * step**2
    q = target_speed * step / unit
    s = np.maximum((room - step * ((1.0 - theta) * speed + theta * target_speed)) / unit, 0.0)
    n = np.floor(0.5 - q + np.sqrt((q - 0.5) ** 2 + 2.0 * s))
    f = np.clip(s / np.maximum(n, 1.0) - 0.5 * (n - 1.0) - q, 0.0, 1.0)
    after: Floats = target_speed + np.where(n >= 1.0, b * step * (n - 1.0 + f), 0.0)
    return after


def verdict(params: Params, speed: Floats, targets: Targets, limits: Limits, step_s: float, theta: float) -> Verdict:
    """Judge what every train may do over the coming step; the rule and its proof are in the notes of the module.

    Points are kept clear of by braking with ``emergency_mps2``. Lower limits and stops are braked for with ``service_mps2``;
    where that does not suffice any more, with up to ``emergency_mps2`` from the last moment on.

    Parameters
    ----------
    params : Params
        ``mode`` is the caller's business.
    speed : ndarray, shape (n,)
        Of every train [m/s], >= 0.
    targets, limits : Targets, Limits
        For the positions and speeds of now. A train ahead must be bound by the same ``params``, and the two of an opposing pair
        have a row each.
    step_s, theta : float
        T [s] and theta of the motion, 0 <= theta < 1.

    Returns
    -------
    Verdict
        Where no acceleration is safe any more (not from a safe state): emergency braking.
    """
    b = params.emergency_mps2
    least = np.maximum(-b, -speed / step_s)
    rates = np.concatenate(
        [_before_targets(params, speed, targets, step_s, theta), _before_limits(params, speed, limits, step_s, theta)]
    )
    train = np.concatenate([targets.train, limits.train])
    bound = np.full(len(speed), params.greatest_mps2)
    np.minimum.at(bound, train, rates)
    reason, target = np.full(len(speed), -1, np.int64), np.full(len(speed), -1, np.int64)
    binds = np.flatnonzero((rates == bound[train]) & (rates < params.greatest_mps2))[::-1]  # of equals the first row stands
    target[train[binds]] = np.where(binds < len(targets.train), binds, binds - len(targets.train))
    reason[train[binds]] = np.concatenate([targets.kind, np.full(len(limits.train), LIMIT)])[binds]
    emergency = (bound <= _RATE - b) & (speed > 0.0)
    return Verdict(np.maximum(bound, least), least, emergency, reason, target, -b)


def _before_targets(params: Params, speed: Floats, targets: Targets, step: float, theta: float) -> Floats:
    """Greatest acceleration each target leaves its train [m/s2], shape (k,); -inf: even full braking comes too late."""
    b = params.emergency_mps2
    v = speed[targets.train]
    own = stopping_distance(v, b, step, theta)
    other = stopping_distance(targets.speed, b, step, theta)
    a_train, opposing, stop = targets.kind == TRAIN, targets.kind == OPPOSING, targets.kind == STOP
    room = np.minimum(targets.room, _FAR) - np.where(stop, 0.0, params.margin_m)
    follows = a_train & targets.moving & (params.curve == "relative")
    to_stop = np.where(follows, room + other, np.where(opposing & targets.moving, 0.5 * (room + own - other), room))
    after = speed_after(to_stop, np.zeros(len(v)), v, b, step, theta)
    late = to_stop < own - _LENGTH
    late |= (a_train | opposing) & (targets.room < params.emergency_distance_m)

    rate = (after - v) / step
    if stop.any():
        service = speed_after(room[stop], np.zeros(int(stop.sum())), v[stop], params.service_mps2, step, theta)
        rate[stop] = _planned(rate[stop], (service - v[stop]) / step, params.service_mps2)
    return np.where(late, -np.inf, rate)


def _before_limits(params: Params, speed: Floats, limits: Limits, step: float, theta: float) -> Floats:
    """Greatest acceleration each limit leaves its train [m/s2], shape (k,)."""
    v, top = speed[limits.train], speed[limits.train] + params.greatest_mps2 * step
    rate = np.full(len(v), np.inf)
    # Most rows do not bind, and are told cheaply: the limit is not below any speed to come, or farther than any braking for it.
    near = np.flatnonzero((limits.speed < top) & (limits.distance < 0.5 * top**2 / params.service_mps2 + 4.0 * step * top))
    v, room, limit = v[near], limits.distance[near], limits.speed[near]
    emergency, service = (
        (speed_after(room, limit, v, b, step, theta) - v) / step for b in (params.emergency_mps2, params.service_mps2)
    )
    rate[near] = _planned(emergency, service, params.service_mps2)
    return rate


def _planned(emergency: Floats, service: Floats, service_mps2: float) -> Floats:
    """Greatest acceleration with the service brake as far as it goes, beyond it as late as the emergency brake allows."""
    return np.minimum(emergency, np.maximum(service, -service_mps2))


def applied(verdict: Verdict, demanded: Floats) -> tuple[Floats, Bools]:
    """Bring what is demanded within the verdict.

    Parameters
    ----------
    verdict : Verdict
        Of this step.
    demanded : ndarray, shape (n,)
        Acceleration [m/s2] by whoever drives; NaN counts as full braking.

    Returns
    -------
    acceleration : ndarray, shape (n,)
        Within ``least`` and ``greatest`` [m/s2].
    intervened : ndarray of bool, shape (n,)
        Where that changes the motion. A brake demanded that would outlast the stand is cut at it, which is no intervention.
    """
    wanted = np.where(np.isnan(demanded), -np.inf, demanded)
    intervened = (wanted > verdict.greatest + _RATE) | (wanted < verdict.strongest - _RATE) & (verdict.least <= verdict.strongest)
    return np.clip(wanted, verdict.least, verdict.greatest), intervened | np.isnan(demanded)
