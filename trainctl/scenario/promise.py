"""What protection relies on, train by train: the conditions of its promise, computed from the scenario.

The promise: with ``[supervisor] mode = "on"`` no law makes a train touch another, pass a place it must not pass, or exceed a speed
limit, *if* every train can do what ``Assumed`` says of it. Running resistance is not counted on: it helps to brake, but not surely.

Symbols
-------
b, given    full braking that is ordered; what brakes, slope and faults leave of it [m/s2]
w1, w2, w3  maximum disturbance of position [m], speed [m/s] and input [m/s2]; T step [s]
e R         maximum error of the running resistance at the line's own speed [m/s2]
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from trainctl.davis import resistance
from trainctl.plants import disturbance, shared
from trainctl.railway import along, authority, signs, supervisor
from trainctl.railway.supervisor import Assumed
from trainctl.railway.ways import ways
from trainctl.signals import GRAVITY, POSITION, SPEED, Floats, Ints

if TYPE_CHECKING:
    from trainctl.scenario.model import Model

#: What has no bound is counted as this many standard deviations: exceeded once in 5e8 draws.
DEVIATIONS = 6.0

#: Trains that cannot be relied on to brake with at least this [m/s2] are not protected.
LEAST_BRAKING = 0.02


class Parts(NamedTuple):
    """Where the numbers of ``Assumed`` come from, shape (n,) each."""

    top: Floats  # m/s, the highest speed its line allows it
    fall: Floats  # m/s2, of gravity on the steepest descent of its route
    climb: Floats  # m/s2, on the steepest ascent
    given: Floats  # m/s2, what brakes and slope leave of full braking, with all faults
    pull: Floats  # m/s2, maximum force per mass at its top speed
    input: Floats  # m/s2, w3, and a bias of faulty actuators
    speed: Floats  # m/s2, w2 / T
    resistance: Floats  # m/s2, e R
    noise: Floats  # m/s2, of the plant
    position: Floats  # m, w1 of a step
    measured: Floats  # m, error of the position
    lag: Floats  # s


def top_speed(p: Model) -> Floats:
    """Highest speed the line allows every train anywhere on its route, or that it starts with [m/s], shape (n,)."""
    start = p.own[p.leading, SPEED]
    if p.placed:
        highest: Floats = np.maximum(float(p.line.speed_mps.max()), start)
        return highest
    limit, index = signs.highest(p.signs, p.rails.speed_mps), p.line.index
    routes = [float(limit[[index[e] for e in route]].max()) for route in p.roster.whole_routes]
    highest = np.array(routes) if not p.rerouted else np.full(len(routes), limit.max())  # a reroute may lead anywhere
    found: Floats = np.maximum(p.roster.speed_factor * highest, start)
    return found


def _slopes(p: Model) -> tuple[Floats, Floats]:
    """Steepest descent and ascent of every train's route, rise / run >= 0, shape (n,)."""
    if p.placed:
        breaks, slope = p.line.gradient.breaks, p.line.gradient.slope
        rear = p.own[p.leading, POSITION] - p.consists.train_length()
        first = np.maximum(np.searchsorted(breaks, rear, side="right") - 1, 0)
        ahead = [slope[k:] for k in first.tolist()]
    elif p.rerouted or not p.rails.slope.any():
        ahead = [p.rails.slope] * len(p.roster.routes)
    else:
        ahead = [p.rails.slope[[p.line.index[e] for e in route]] for route in p.roster.whole_routes]
    down, up = (np.array([max(float((sign * s).max()), 0.0) for s in ahead]) for sign in (-1.0, 1.0))
    return down, up


def parts(p: Model) -> Parts:
    """Numbers behind ``assume``, for every train of a scenario."""
    n, c, run, b = len(p.scenario.ids), p.consists, p.scenario.run, p.supervision.emergency_mps2
    top, (down, up) = top_speed(p), _slopes(p)
    maximum = np.zeros((len(disturbance.CHANNELS), n))
    for entry in p.scenario.disturbance:
        maximum += entry.maximum(p.scenario.ids, DEVIATIONS)
    error = maximum[disturbance.RESISTANCE] * resistance(top, c.train_davis())
    fall = GRAVITY * down
    sure = p.plant.relied_on(p.plant_params, c, p.scenario.fault, p.scenario.ids, b, top, fall, DEVIATIONS)
    given = np.minimum(sure.braking, -p.clamps.input_lower - fall)
    pull = np.minimum(sure.pull, p.clamps.input_upper)
    return Parts(
        top=top, fall=fall, climb=GRAVITY * up, given=given, pull=pull, input=maximum[disturbance.INPUT] + sure.bias,
        speed=maximum[disturbance.SPEED] / run.step_s, resistance=error + sure.late, noise=sure.noise,
        position=maximum[disturbance.POSITION], measured=maximum[disturbance.MEASUREMENT], lag=sure.lag,
    )  # fmt: skip


def _scatter(found: Parts) -> Floats:
    """By how much an acceleration may miss what is ordered [m/s2], shape (n,)."""
    return found.input + found.speed + found.resistance + found.noise


def assume(p: Model) -> Assumed:
    """What the supervisor relies on of every train of a scenario; ``refusals`` says where that cannot be met."""
    found, rules, c = parts(p), p.supervision, p.consists
    scatter = _scatter(found)
    coasting = shared.mean_resistance(c, found.top) + found.resistance + found.climb - found.pull  # uphill it may slow by itself
    kicks = p.step_theta * found.speed * p.scenario.run.step_s  # where they come before it moves, not after
    return Assumed(
        braking=np.maximum(np.minimum(found.given, rules.emergency_mps2) - scatter, LEAST_BRAKING),
        hardest=np.maximum(rules.emergency_mps2 + scatter, coasting),
        scatter=scatter,
        drift=found.position / p.scenario.run.step_s + kicks + (rules.speed_uncertainty_mps or 0.0),
        lag=found.lag,
        surge=found.lag * (found.fall + found.climb),
        uncertainty=found.measured + (rules.position_uncertainty_m or 0.0),
        blur=rules.speed_uncertainty_mps or 0.0,
        within=bool(p.plant.UNITS),
    )


def planned(assumed: Assumed, rate: Floats) -> Assumed:
    """What a driver relies on who brakes every train with ``rate`` (n,) [m/s2]: he keeps away farther than the supervisor asks.

    Behind a train of the same speed he brakes for ``D(v) - D(w)`` with the rates below: its difference is at least that of the
    supervisor's rates. His positions are true ones, the supervisor's told room is less by up to the uncertainties.
    """
    braking = np.maximum(np.minimum(rate, assumed.braking + assumed.scatter) - assumed.scatter, LEAST_BRAKING)
    weakest = int(np.argmin(1.0 / braking - 1.0 / assumed.braking))
    ahead = braking[weakest] / (1.0 + braking[weakest] * (1.0 / assumed.hardest - 1.0 / assumed.braking[weakest]))
    return assumed._replace(braking=braking, hardest=ahead, uncertainty=3.0 * assumed.uncertainty)


def refusals(p: Model) -> list[str]:
    """What of the promise cannot be kept in a scenario with ``mode = "on"``, with the numbers that would do."""
    if p.supervision.mode != "on" or p.self_driven:
        return []
    if p.plant.violations(p.plant_params, p.first_scene, p.scenario.fault):
        return []  # told already; there are no numbers to rely on
    clamp = float(p.clamps.speed_lower.max())
    if clamp > 0.0:
        return [
            f"plant.speed_lower_mps = {clamp:g}: trains that cannot stand cannot be kept apart; with supervisor.mode = on it must"
            " be 0 or less"
        ]
    return _weak(p) or _lost(p)


def _weak(p: Model) -> list[str]:
    """Trains that cannot be relied on to brake."""
    found, assumed, b = parts(p), p.assumed, p.supervision.emergency_mps2
    surely = np.minimum(found.given, b) - assumed.scatter
    weak = np.flatnonzero(surely < LEAST_BRAKING)
    if len(weak):
        i = int(weak[np.argmin(surely[weak])])
        among = f" (and {len(weak) - 1} other trains)" if len(weak) > 1 else ""
        needed = assumed.scatter[i] + LEAST_BRAKING
        cures = f"brakes that leave {needed:.3g} m/s2 there"
        if b < needed:
            cures = f"supervisor.emergency_mps2 of at least {needed:.3g}, and " + cures
        return [
            f"supervisor.mode = on: train {p.scenario.ids[i]}{among} cannot be relied on to brake: {_why(p, found, i)}; it takes"
            f" {cures}"
        ]
    rate = p.driver_braking
    if not p.placed and np.any(rate - assumed.scatter < LEAST_BRAKING):
        i = int(np.argmin(rate - assumed.scatter))
        kind = p.scenario.train[i].type
        stated = p.scenario.train_type[kind].driven_deceleration_mps2
        key = "traffic.deceleration_mps2" if stated is None else f"train_type.{kind}.driven_deceleration_mps2"
        return [
            f"{key} = {rate[i]:g}: disturbances and faults take {assumed.scatter[i]:.3g} m/s2 of it from train"
            f" {p.scenario.ids[i]}; at least {assumed.scatter[i] + LEAST_BRAKING:.3g}"
        ]
    return []


def _why(p: Model, found: Parts, i: int) -> str:
    """What leaves train ``i`` so little braking."""
    b = p.supervision.emergency_mps2
    told = [f"full braking {b:g} m/s2"]
    if found.given[i] < b - 1e-9:
        faults = " and faults" if p.scenario.fault else ""
        fall = f" on {1000.0 * found.fall[i] / GRAVITY:.3g} per mil downhill" if found.fall[i] > 0.0 else ""
        told.append(f"its brakes{faults} leave {found.given[i]:.3g}{fall} up to {found.top[i]:.4g} m/s")
    for name in ("input", "speed", "resistance", "noise"):
        share = float(getattr(found, name)[i])
        if share > 0.0:
            told.append(f"{_DISTURBED[name]} may take {share:.3g}")
    return ", ".join(told)


#: What of ``Parts`` takes from the braking, in words.
_DISTURBED = {
    "input": "disturbances of the input and faulty actuators",
    "speed": "disturbances of the speed",
    "resistance": "errors of the running resistance",
    "noise": "noise",
}


def _lost(p: Model) -> list[str]:
    """Starts from which a collision or an overspeed cannot be averted. Trains that come later enter only where it is safe."""
    if not p.placed:
        return []
    rules, speed, step = p.supervision, p.own[p.leading, SPEED], p.scenario.run.step_s
    laid = ways([[p.line.index[e] for e in route] for route in p.roster.routes], p.line.start_m, p.line.length_m)
    row, n = laid.first[:-1].copy(), len(speed)
    front = laid.begin[row] + p.roster.lane_position
    fastest = float(supervisor.stopping_distance(speed, float(p.assumed.braking.min()), step, p.step_theta).max())
    view = authority.look(
        laid, along.net(p.rails), p.rails.speed_mps, np.zeros(len(p.rails.speed_mps), bool), np.ones(n), row, front, speed,
        p.consists.train_length(), np.ones(n, bool),
        fastest + 1000.0, np.full(n, np.inf), None, p.rails.internal,
    )  # fmt: skip
    found = []
    late, enough = supervisor.too_late(rules, p.assumed, speed, view.targets, step, p.step_theta)
    for k in np.flatnonzero(late).tolist():
        i, j = int(view.targets.train[k]), int(view.targets.other[k])
        ahead = f"train {p.scenario.ids[j]} ({view.targets.speed[k]:.4g} m/s)" if j >= 0 else "what it must not reach"
        found.append(
            f"train[{p.scenario.ids[i]}].speed_mps = {speed[i]:.10g}: {view.targets.room[k]:.6g} m behind {ahead} it cannot be kept"
            f" apart by {rules.margin_m:g} m, whatever brakes; with braking of {p.assumed.braking[i]:.3g} m/s2 at most"
            f" {enough[k]:.4g} m/s, or supervisor.mode = off"
        )
    limits = view.limits
    loose = limits._replace(speed=limits.speed + 0.1)
    holds = p.assumed._replace(surge=np.zeros(n))  # its actuators begin with what holds its speed on the slope
    kept = supervisor.speed_for_limits(holds, speed, loose, p.assumed.braking, step, p.step_theta)
    for k in np.flatnonzero(speed[limits.train] > kept).tolist():
        i, room = int(limits.train[k]), float(limits.distance[k])
        where = f"in {room:.6g} m" if room > 0.0 else "where it starts"
        found.append(
            f"train[{p.scenario.ids[i]}].speed_mps = {speed[i]:.10g}: the line allows {limits.speed[k]:.6g} m/s {where}; with"
            f" braking of {p.assumed.braking[i]:.3g} m/s2 at most {max(kept[k] - 0.1, 0.0):.4g} m/s"
        )
    return found


def uncovered(p: Model, train: int, edges: Sequence[int] | Ints) -> str:
    """What of a new way over ``edges`` is not relied on for a train, in words; "": nothing. Orders of the file are counted on."""
    if p.supervision.mode != "on" or p.placed or p.rerouted:
        return ""
    top, (down, up) = top_speed(p)[train], _slopes(p)
    fastest = float(p.roster.speed_factor[train] * signs.highest(p.signs, p.rails.speed_mps)[edges].max())
    slope = p.rails.slope[edges]
    for what, value, most, unit in (
        ("a limit", fastest, float(top), "m/s"),
        ("a descent", -1000.0 * float(slope.min()), 1000.0 * float(down[train]), "per mil"),
        ("an ascent", 1000.0 * float(slope.max()), 1000.0 * float(up[train]), "per mil"),
    ):
        if value > most + 1e-9:
            return f"{what} of {value:.4g} {unit}, where protection relies on {most:.4g} at most; an [[event]] of the file counts"
    return ""


def told(p: Model) -> dict[str, Any]:
    """The promise and what it assumes, in numbers: for `check`, run.json and the report."""
    rules, found, assumed = p.supervision, parts(p), p.assumed
    i = int(np.argmin(assumed.braking))
    counted = {name: float(getattr(found, name).max()) for name in ("input", "speed", "resistance", "noise")}
    return {
        "mode": rules.mode,
        "curve": rules.curve,
        "full_braking_mps2": rules.emergency_mps2,
        "relied_on_mps2": float(assumed.braking[i]),
        "relied_on_of": p.scenario.ids[i],
        "brakes_and_slope_leave_mps2": float(min(found.given[i], rules.emergency_mps2)),
        "steepest_descent_permil": float(1000.0 * found.fall.max() / GRAVITY),
        "hardest_ahead_mps2": float(assumed.hardest.max()),
        "disturbances_mps2": {name: value for name, value in counted.items() if value > 0.0},
        "advance_beyond_speed_mps": float(assumed.drift.max()),
        "actuator_lag_s": float(assumed.lag.max()),
        "surge_mps": float(assumed.surge.max()),
        "margin_m": rules.margin_m,
        "position_uncertainty_m": float(assumed.uncertainty.max()),
        "speed_uncertainty_mps": assumed.blur,
        "deviations": DEVIATIONS if _unbounded(p) else None,
        "top_speed_mps": float(found.top.max()),
    }


def _unbounded(p: Model) -> bool:
    """Whether anything random has no bound, so that the promise holds with a probability only."""
    noisy = p.plant.noise_hold(p.plant_params) is not None
    return noisy or any(not np.isfinite(entry.maximum(p.scenario.ids)).all() for entry in p.scenario.disturbance)


def sentences(said: dict[str, Any]) -> list[str]:
    """What ``told`` found, as lines for people."""
    if said["mode"] == "off":
        return []
    lines = [
        "no law causes a collision, passes a held switch or exceeds the line's limits, as long as:"
        if said["mode"] == "on"
        else "monitored only, nothing is prevented; what would be assumed:",
        f"every train brakes with at least {said['relied_on_mps2']:.4g} m/s2 up to {said['top_speed_mps']:.4g} m/s (minimum: train"
        f" {said['relied_on_of']}; ordered {said['full_braking_mps2']:.4g}, brakes and slope leave"
        f" {said['brakes_and_slope_leave_mps2']:.4g})",
    ]
    if said["curve"] == "relative":
        lines.append(f"a train ahead slows down by at most {said['hardest_ahead_mps2']:.4g} m/s2")
    else:
        lines.append("a train ahead may stop dead where its rear is")
    if said["steepest_descent_permil"]:
        lines.append(f"descents are no steeper than {said['steepest_descent_permil']:.4g} per mil")
    for name, value in said["disturbances_mps2"].items():
        lines.append(f"{_DISTURBED[name]} change an acceleration by at most {value:.4g} m/s2")
    if said["advance_beyond_speed_mps"]:
        lines.append(f"a train advances by at most {said['advance_beyond_speed_mps']:.4g} m/s more than its measured speed")
    if said["actuator_lag_s"]:
        lines.append(f"actuators lag by at most {said['actuator_lag_s']:.4g} s")
    if said["surge_mps"]:
        lines.append(f"where the slope changes a speed rises by at most {said['surge_mps']:.4g} m/s until they follow")
    measured = (
        f"positions are measured to {said['position_uncertainty_m']:.4g} m, speeds to {said['speed_uncertainty_mps']:.4g} m/s"
    )
    lines.append(f"{measured}; the margin is {said['margin_m']:.4g} m beyond that")
    if said["deviations"]:
        lines.append(f"random errors without a bound stay within {said['deviations']:g} standard deviations")
    return lines
