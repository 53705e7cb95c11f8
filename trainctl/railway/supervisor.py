"""Protection: the maximum acceleration with which no train can come to reach what it must not reach, a function of data.

Whoever drives, ``verdict`` bounds each train's acceleration over the coming step and ``applied`` enforces the bounds. Trains move
in steps: ``v' = max(0, v + a T)``, ``x' = x + ((1 - theta) v + theta v') T``, 0 <= theta < 1; theta is 0 for point trains (they
move with the old speed) and 1/2 where the acceleration is held over the step.

Symbols
-------
T, theta    step [s], share of the new speed in a step's distance
b, c        emergency and service deceleration [m/s2]
D(v)        distance from speed v to a standstill with full braking, in steps [m]
v, w        speed of the train and of the one ahead or opposite; after the step v', w' [m/s]
d           distance from the front to the point, less the margin [m]

Notes
-----
Why no train reaches its point, by induction over the steps. A state is *safe* if full braking of all trains from now on ends with
no margin touched: before a fixed point ``d >= D(v)``, behind a moving train ``d >= D(v) - D(w)``, against an opposing one
``d >= D(v) + D(w)``.

1. Full braking for one step takes ``D(v) - D(v')``, so a safe state stays safe under it, and there always is a safe choice.
   ``verdict`` takes the maximum v' that is safe after the step for the minimum the others can do: the train ahead brakes with b,
   it cannot brake harder (``minimum``); of two opposing trains each takes half of ``d - D(v) - D(w)`` for itself at most.
   Whatever more the train ahead does only adds, because its distance and D(w') grow with w'. So a safe state stays safe, whatever
   is demanded.
2. Nothing is missed on the way to the end. Behind a train ahead with v' >= w', safety says ``d' >= D(v') - D(w') >= 0``. If
   v' < w' even when the train ahead brakes fully, then v < w too, because no train brakes harder than b: the lower speed before
   and after, so the gap grew. Hence no gap falls below the margin, and one that began below it does not shrink.

3. What a train does is not what is ordered. ``Assumed`` says by how much, train by train: it brakes with ``braking`` at least
   and ``hardest`` at most, it gains ``scatter`` more speed than ordered, it advances by ``drift`` faster than its speed says. So D
   is taken at ``v + drift`` with the sure braking, D of the train ahead with the hardest, and ``scatter`` is taken off the
   maximum acceleration. A train that brakes more weakly than the one ahead comes nearest at the end or now (while the closing
   speed is positive it grows), so 2. holds with ``braking <= hardest``.
4. An actuator of lag r follows what is ordered late: ``a' = (u - a) / r``. Under full braking the speed ``v + r (a + braking +
   scatter)`` falls just as that of a train without lag, and is never below v, so it takes the place of v before points; before
   speed limits ``v + r max(a + scatter, 0)`` does, the speed reached once no more is ordered. The a of an actuator leaves out
   what acts beside it, up to ``scatter``; and v still rises while the one is negative and their sum is not. Where the slope
   changes by ds the force follows late too, which gives the speed ``r g ds``; over a whole route that is at most ``surge``.
   Couplers that swing may speed up the head by ``swing``, what their energy and that of the units against each other can give
   it.

Holding the speed v behind a train of the same speed therefore needs v T beyond the margin: the train ahead may begin to brake
now, its follower learns of it one step later.
"""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import BeforeValidator, Field, model_validator
from pydantic.json_schema import SkipJsonSchema
from pydantic_core import PydanticCustomError

from trainctl.signals import Bools, Floats, Ints, Table

#: What can bind a train; ``Targets.kind`` and ``Verdict.reason`` are places in it. "limit" is of ``Limits`` only.
KINDS = ("train", "opposing", "switch", "stop", "end", "signal", "limit")
TRAIN, OPPOSING, SWITCH, STOP, END, SIGNAL, LIMIT = range(7)

#: Farther than anything here [m]: means no bound in the sums.
_FAR = 1e9

#: Rounding in lengths [m] and accelerations [m/s2].
_LENGTH, _RATE = 1e-6, 1e-9


def _no_unit(value: object) -> None:
    raise PydanticCustomError("unit_missing", "the key must carry the unit: position_uncertainty_m or speed_uncertainty_mps")


class Params(Table):
    """Keys of the scenario's [supervisor] table."""

    mode: Literal["off", "monitor", "on"] = Field(
        "off", description="on: bounds every train's acceleration; monitor: reports what it would have done, without doing it."
    )
    curve: Literal["relative", "absolute"] = Field(
        "relative",
        description="relative: the train ahead needs its own braking distance; absolute: it may stop dead where its rear is now.",
    )
    emergency_mps2: float = Field(
        1.0,
        gt=0.0,
        description="Full braking [m/s2]: every train can give it on the level at any speed, and none may exceed it. What is"
        " relied on is less by slopes, faults and disturbances: see `trainctl check`.",
    )
    service_mps2: float = Field(
        0.7, gt=0.0, description="Deceleration [m/s2] planned with before lower speed limits and stops; at most emergency_mps2."
    )
    margin_m: float = Field(
        20.0, ge=0.0, description="Distance kept between a front and what it must not reach [m]; stops and signals may be reached."
    )
    greatest_mps2: float = Field(1.0, gt=0.0, description="Maximum acceleration admitted [m/s2].")
    emergency_distance_m: float = Field(
        0.0, ge=0.0, description="Gap to another train [m] below which emergency braking is ordered whatever the speeds."
    )
    position_uncertainty_m: float | None = Field(
        None, ge=0.0, description="Maximum error of a measured position [m], beside that of [[disturbance]]; widens the margin."
    )
    speed_uncertainty_mps: float | None = Field(
        None,
        ge=0.0,
        description="Maximum error of a measured speed [m/s]: a train may be faster, the one ahead slower than measured.",
    )
    uncertainty: SkipJsonSchema[Annotated[None, BeforeValidator(_no_unit)]] = None

    @model_validator(mode="after")
    def _rates(self) -> Params:
        if self.service_mps2 > self.emergency_mps2:
            raise ValueError(f"service_mps2 = {self.service_mps2:g}: at most emergency_mps2 = {self.emergency_mps2:g}")
        return self


class Assumed(NamedTuple):
    """What is relied on of every train, shape (n,): see note 3 of the module; ``scenario.promise`` makes it."""

    braking: Floats  # m/s2, > 0: what it gives for sure when full braking is ordered
    hardest: Floats  # m/s2, >= braking: it slows down no faster
    scatter: Floats  # m/s2, >= 0: its acceleration may exceed the ordered one by this
    drift: Floats  # m/s, >= 0: it may advance faster than its measured speed by this
    lag: Floats  # s, of its slowest actuator, 0: none
    surge: Floats  # m/s, >= 0: its speed may rise by this where the slope changes and its actuators follow late
    uncertainty: Floats  # m, >= 0, of its measured position
    blur: float  # m/s, of every measured speed
    within: bool = False  # trains may stop within a step and remain at a standstill for the rest of it, not at its end only


class Targets(NamedTuple):
    """What fronts must not reach, shape (k,); in any order, any number per train.

    An opposing train is in two rows, one for each of the pair, both with the whole distance between the fronts.
    """

    train: Ints  # whose target it is
    room: Floats  # m, front to the point now, margin not subtracted; rear of the train ahead, front of an opposing one
    speed: Floats  # m/s, of the point: along the way for a train ahead, towards us for an opposing one; >= 0
    moving: Bools  # False: the point is fixed; or will be, as far as this train may rely on it
    kind: Ints  # place in KINDS
    other: Ints  # the other train, -1 if none


class Limits(NamedTuple):
    """Maximum speeds, shape (k,); in any order, any number per train."""

    train: Ints
    distance: Floats  # m, front to where it begins; <= 0: in force
    speed: Floats  # m/s, inf: none


class Verdict(NamedTuple):
    """What every train may do over the coming step, shape (n,)."""

    maximum: Floats  # m/s2, >= minimum
    minimum: Floats  # m/s2, full emergency braking, but not backwards: a step ends at a standstill at worst
    emergency: Bools  # full emergency braking is ordered of a moving train
    reason: Ints  # place in KINDS of what binds, -1: nothing does
    target: Ints  # row of what binds, in Limits if the reason is "limit", otherwise in Targets; -1: none
    strongest: float | Floats  # m/s2, -emergency_mps2


def as_ordered(rate: float, trains: int) -> Assumed:
    """Assume that all trains do just what is ordered, and brake with ``rate`` [m/s2]."""
    full, none = np.full(trains, rate), np.zeros(trains)
    return Assumed(full, full, none, none, none, none, none, 0.0)


def no_targets() -> Targets:
    """No train has anything in its way."""
    none = np.zeros(0, np.int64)
    return Targets(none, np.zeros(0), np.zeros(0), np.zeros(0, bool), none, none)


def no_limits() -> Limits:
    """No speed limits."""
    return Limits(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))


def stopping_distance(speed: Floats, b: float | Floats, step: float, theta: float) -> Floats:
    """Distance [m] from ``speed`` [m/s] to a standstill, braking with ``b`` [m/s2] in steps of ``step`` [s]: D of the module.

    With ``v = (m + f) b T``, m whole, 0 <= f < 1: ``D = b T^2 ((m + 1)(m/2 + f) - theta (m + f))``. At least ``v^2 / 2b`` for
    theta <= 1/2, equal to it for theta = 1/2 and f = 0. Shape of ``speed``.
    """
    steps = speed / (b * step)
    m = np.floor(steps)
    f = steps - m
    way: Floats = b * step**2 * ((m + 1.0) * (0.5 * m + f) - theta * steps)
    return way


def greatest_speed(room: Floats, b: float | Floats, step: float, theta: float) -> Floats:
    """Maximum speed [m/s] with ``stopping_distance`` within ``room`` [m]; 0 where there is no room. Shape of ``room``."""
    s = np.maximum(room, 0.0) / (b * step**2)
    m = np.maximum(np.floor(theta - 0.5 + np.sqrt((theta - 0.5) ** 2 + 2.0 * s)), 0.0)
    f = (s - m * (0.5 * (m + 1.0) - theta)) / (m + 1.0 - theta)
    speed: Floats = b * step * (m + np.clip(f, 0.0, 1.0))
    return speed


def curve(room: Floats, target_speed: Floats, b: float) -> Floats:
    """Speed [m/s] from which braking with ``b`` [m/s2] over ``room`` [m] ends at ``target_speed`` [m/s]: the service curve."""
    speed: Floats = np.sqrt(target_speed**2 + 2.0 * b * np.maximum(room, 0.0))
    return speed


def speed_after(room: Floats, target_speed: Floats, speed: Floats, b: float | Floats, step: float, theta: float) -> Floats:
    """Maximum v' [m/s] after a step from which braking still ends at ``target_speed`` u, in whole steps, within ``room`` [m].

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


def verdict(
    params: Params, speed: Floats, targets: Targets, limits: Limits, step_s: float, theta: float,
    assumed: Assumed | None = None, acceleration: Floats | None = None, swing: Floats | None = None,
) -> Verdict:  # fmt: skip
    """Judge what every train may do over the coming step; the rule and its proof are in the notes of the module.

    Points are kept clear of by braking as hard as the train surely can. Lower limits and stops are braked for with
    ``service_mps2``; where that does not suffice any more, with up to full braking from the last moment on.

    Parameters
    ----------
    params : Params
        ``mode`` is the caller's business.
    speed : ndarray, shape (n,)
        Of every train [m/s], >= 0.
    targets, limits : Targets, Limits
        For the positions and speeds of now, as measured. A train ahead must be bound by the same ``params``, and the two of an
        opposing pair have a row each.
    step_s, theta : float
        T [s] and theta of the motion, 0 <= theta < 1.
    assumed : Assumed, optional
        What is relied on; trains that do as ordered if left out.
    acceleration : ndarray, shape (n,), optional
        Of every train now [m/s2]; needed where there is lag.
    swing : ndarray, shape (n,), optional
        By how much the couplers may still speed up its head [m/s]; counts before limits.

    Returns
    -------
    Verdict
        Where no acceleration is safe any more (not from a safe state): emergency braking.
    """
    b, n = params.emergency_mps2, len(speed)
    relied = as_ordered(b, n) if assumed is None else assumed
    now = np.zeros(n) if acceleration is None else acceleration
    minimum = np.where(relied.lag > 0.0, -b, np.maximum(-b, -(speed + relied.drift) / step_s - relied.scatter))
    rates = np.concatenate([
        _before_targets(params, relied, speed, now, targets, step_s, theta),
        _before_limits(params, relied, speed, now, 0.0 if swing is None else swing, limits, step_s, theta),
    ])  # fmt: skip
    train = np.concatenate([targets.train, limits.train])
    bound = np.full(n, params.greatest_mps2)
    np.minimum.at(bound, train, rates)
    reason, target = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    binds = np.flatnonzero((rates == bound[train]) & (rates < params.greatest_mps2))[::-1]  # of equals the first row counts
    target[train[binds]] = np.where(binds < len(targets.train), binds, binds - len(targets.train))
    reason[train[binds]] = np.concatenate([targets.kind, np.full(len(limits.train), LIMIT)])[binds]
    emergency = (bound <= _RATE - b) & (speed > 0.0)
    return Verdict(np.maximum(bound, minimum), minimum, emergency, reason, target, -b)


class _Braking(NamedTuple):
    """Braking for every target, shape (k,)."""

    room: Floats  # m, to the point less the margin
    to_stop: Floats  # m, that may pass until the train is at a standstill
    speed: Floats  # m/s, from which it brakes: what the train may be as fast as
    way: Floats  # m, it takes with full braking from now on


def _braking(params: Params, relied: Assumed, speed: Floats, now: Floats, targets: Targets, step: float, theta: float) -> _Braking:
    i, j = targets.train, targets.other
    a_train, opposing, stop = targets.kind == TRAIN, targets.kind == OPPOSING, targets.kind == STOP
    more = relied.drift + relied.surge + relied.lag * np.maximum(now + relied.braking + relied.scatter, 0.0)
    v, b = speed[i] + np.where(stop, relied.drift[i], more[i]), relied.braking[i]  # the room to a stop counts the lag already
    own = stopping_distance(v, b, step, theta)
    margin: Floats | float = np.where(targets.kind == SIGNAL, 0.0, params.margin_m)
    if relied.uncertainty.any():
        margin = margin + relied.uncertainty[i] + np.where(j >= 0, relied.uncertainty[j], 0.0)
    room = np.minimum(targets.room, _FAR) - np.where(stop, 0.0, margin)
    follows = a_train & targets.moving & (params.curve == "relative")
    slowest = np.maximum(targets.speed - relied.blur, 0.0)
    away = stopping_distance(slowest, relied.hardest[j], step, theta)
    if relied.within:
        away = np.minimum(away, 0.5 * slowest**2 / relied.hardest[j])
    to_stop = np.where(follows, room + away, room)
    if (meets := opposing & targets.moving).any():
        comes = stopping_distance(targets.speed + np.where(j >= 0, more[j], 0.0), relied.braking[j], step, theta)
        to_stop = np.where(meets, 0.5 * (room + own - comes), to_stop)
    return _Braking(room, to_stop, v, own)


def too_late(
    params: Params, assumed: Assumed, speed: Floats, targets: Targets, step_s: float, theta: float
) -> tuple[Bools, Floats]:
    """Say before which targets even full braking comes too late, and from which speed [m/s] it would not, shape (k,) each.

    Arguments are those of ``verdict``, for trains that hold their speeds.
    """
    found = _braking(params, assumed, speed, np.zeros(len(speed)), targets, step_s, theta)
    b = assumed.braking[targets.train]
    enough = greatest_speed(found.to_stop, b, step_s, theta) - (found.speed - speed[targets.train])
    return found.to_stop < found.way - _LENGTH, np.maximum(enough, 0.0)


def way_to_stop(params: Params, assumed: Assumed, speed: Floats, acceleration: Floats, step_s: float, theta: float) -> Floats:
    """Way [m] in which every train surely stops by braking as planned, or as hard as it surely can if that is less, shape (n,).

    A switch that is nearer must not be turned any more. Where none is protected braking counts as planned: nothing is relied on.
    Arguments are those of ``verdict``.
    """
    if params.mode != "on":
        return stopping_distance(np.maximum(speed, 0.0), params.service_mps2, step_s, theta)
    late = assumed.lag * np.maximum(acceleration + assumed.braking + assumed.scatter, 0.0)
    v = np.maximum(speed, 0.0) + assumed.drift + assumed.surge + late
    return stopping_distance(v, np.minimum(params.service_mps2, assumed.braking), step_s, theta) + assumed.uncertainty


def speed_for_limits(assumed: Assumed, speed: Floats, limits: Limits, braking: Floats, step_s: float, theta: float) -> Floats:
    """Maximum speed [m/s] from which each limit is kept to by braking with ``braking`` (n,) [m/s2], shape (k,).

    For trains that hold their speeds, which are at most ``speed`` (n,) [m/s]. Other arguments are those of ``verdict``.
    """
    i = limits.train
    lowered = np.maximum(limits.speed - assumed.surge[i], 0.0)
    slower = assumed.drift[i] * (np.maximum(speed[i] - lowered, 0.0) / braking[i] + 2.0 * step_s)
    room = limits.distance - assumed.uncertainty[i] - settles(assumed, braking)[i] * speed[i] - slower
    kept = speed_after(room + theta * step_s * lowered, lowered, np.zeros(len(i)), braking[i], step_s, theta)
    return np.maximum(kept - assumed.lag[i] * assumed.scatter[i], 0.0)


def settles(relied: Assumed, planned: Floats) -> Floats:
    """Time [s] in which the lag of every train's actuators dies away, from braking to a speed error of 5 cm/s; shape (n,)."""
    return relied.lag * np.log(np.maximum(relied.lag * planned / 0.05, 1.0))


def _before_targets(
    params: Params, relied: Assumed, speed: Floats, now: Floats, targets: Targets, step: float, theta: float
) -> Floats:
    """Maximum acceleration each target leaves its train [m/s2], shape (k,); -inf: even full braking comes too late."""
    i, stop = targets.train, targets.kind == STOP
    found = _braking(params, relied, speed, now, targets, step, theta)
    v, b = found.speed, relied.braking[i]
    after = speed_after(found.to_stop, np.zeros(len(v)), v, b, step, theta)
    late = found.to_stop < found.way - _LENGTH
    late |= ((targets.kind == TRAIN) | (targets.kind == OPPOSING)) & (targets.room < params.emergency_distance_m)

    rate = (after - v) / step
    if stop.any():
        planned = np.minimum(params.service_mps2, b[stop])
        service = speed_after(found.room[stop], np.zeros(int(stop.sum())), v[stop], planned, step, theta)
        rate[stop] = _planned(rate[stop], (service - v[stop]) / step, planned)
    return np.where(late, -np.inf, rate - relied.scatter[i])


def _before_limits(
    params: Params, relied: Assumed, speed: Floats, now: Floats, swing: Floats | float, limits: Limits, step: float, theta: float
) -> Floats:
    """Maximum acceleration each limit leaves its train [m/s2], shape (k,)."""
    settled = speed + swing + (relied.lag * np.maximum(now + relied.scatter, 0.0) if relied.lag.any() else 0.0)
    train = limits.train
    v, top = settled[train], settled[train] + (params.greatest_mps2 + relied.scatter[train]) * step
    rate = np.full(len(v), np.inf)
    # Most rows do not bind, and are found cheaply: the limit is not below any speed to come, or farther than any braking for it.
    planned = np.minimum(params.service_mps2, relied.braking)
    sooner = relied.uncertainty + settles(relied, planned) * np.maximum(speed, settled)
    far = (
        0.5 * top**2 / planned[train] + 4.0 * step * top + sooner[train] + relied.drift[train] * (top / planned[train] + 2.0 * step)
    )
    lowered = np.maximum(limits.speed - relied.surge[train], 0.0)
    near = np.flatnonzero((lowered < top) & (limits.distance < far))
    i, v, limit = train[near], v[near], lowered[near]
    slower = relied.drift[i] * (np.maximum(v - limit, 0.0) / planned[i] + 2.0 * step)
    room = limits.distance[near] - sooner[i] - slower
    emergency, service = ((speed_after(room, limit, v, b[i], step, theta) - v) / step for b in (relied.braking, planned))
    rate[near] = _planned(emergency, service, planned[i]) - relied.scatter[i]
    return rate


def _planned(emergency: Floats, service: Floats, planned: Floats) -> Floats:
    """Maximum acceleration with the planned braking as far as it goes, beyond it as late as full braking allows."""
    return np.minimum(emergency, np.maximum(service, -planned))


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
        Within ``minimum`` and ``maximum`` [m/s2].
    intervened : ndarray of bool, shape (n,)
        Where that changes the motion. A brake demanded that would outlast the stop is cut at it, which is no intervention.
    """
    wanted = np.where(np.isnan(demanded), -np.inf, demanded)
    intervened = (wanted > verdict.maximum + _RATE) | (wanted < verdict.strongest - _RATE) & (verdict.minimum <= verdict.strongest)
    return np.clip(wanted, verdict.minimum, verdict.maximum), intervened | np.isnan(demanded)
