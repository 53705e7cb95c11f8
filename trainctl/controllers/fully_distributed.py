"""Fully distributed control of constrained discrete-time trains [1]_: spacing, speed and input bounds kept at every step.

Each train receives only from its neighbours. It predicts where it will be one period ahead, moves towards the mean of its links'
errors, and clips that move s to half of the room its links leave, to the room of its speed and to that of its input. The law is
a deadbeat speed command, ``v_i(k+1) = v_r + s_i / T``.

Symbols
-------
========================  ==================================================================================================
i, j, N_i                 a train, one of its neighbours, all of them (``Links`` rows received by i)
x, v                      front position [m], speed [m/s]
x_r, v_r                  position [m] and speed [m/s] of the virtual leader
T                         control period [s]
theta                     lead of the plant: ``x(k+1) = x + ((1 - theta) v(k) + theta v(k+1)) T``; 0 in the paper
z                         ``x + (1 - theta) v T - x_r`` [m], what a train sends; ``z_ji = z_j - z_i``
d, gamma, Gamma           desired spacing, its lower and upper bound [m], here of ``z_ji``: x_j - x_i
rho, Rho, mu, Mu          lower and upper bounds of speed [m/s] and input [m/s2]
f, F                      minimum and maximum running resistance on [rho, Rho] [m/s2]
alpha, beta, eta          how far back the links, the speed and the input let a train move in the moving frame [m], eq. (10)
Alpha, Beta, Eta          how far forward
G, s                      wanted and admitted move [m], eqs. (10), (12)
========================  ==================================================================================================

Departures from [1]_, each shown in ``tests/paper/test_fully_distributed.py``
-------------------------------------------------------------------------------
* The paper says that relative positions suffice. ``ybar_ij(k+1)`` needs the neighbours' speeds too; a train therefore sends
  ``z``. With theta = 0 this is the paper's prediction ``x + v T``; for other plants the same proof holds for ``z``.
* The start condition (13) bounds ``x_ij(1)`` only. ``x_ij(0)`` is checked as well.
* Existence of d_i needs the desired spacings to sum to zero around *every* cycle; on triangles alone is not enough.
* (10) prints two lower ``beta_i``: the second is the upper one.
* ``join = "ratchet"``: a link that violates (13) works with ``min(gamma, z_ji)`` and ``max(Gamma, z_ji)``, so that s = 0 stays
  admissible. The printed law (``"strict"``) then meets delta > Delta and breaks links that were sound.
* ``eta = "own_speed"``: the input room at the train's own speed instead of the worst one in the band.
* A train that misses any message of the period keeps the reference speed, s = 0. Leaving the neighbour out is not safe.

References
----------
.. [1] Zhang, Chen, Fang, "Cooperative Control of Constrained Discrete-Time Multi-Train Systems: A Fully Distributed Approach".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from trainctl.contracts import SampledLaw
from trainctl.controllers import stated
from trainctl.davis import resistance, resistance_of
from trainctl.kernels import bare
from trainctl.signals import POSITION, SPEED, Bools, Demand, Floats, Links, Reference, Scene, Table, Trains, leader_at

if TYPE_CHECKING:
    from trainctl.controllers import fully_distributed

    module: SampledLaw = fully_distributed

CLOCK: Literal["sampled"] = "sampled"

#: Assumption 2.4 asks for room of the input in the whole band of speeds: the control period must not be too short.
BANDED = True

#: Figures -> their numbers in the paper.
FIGURES = {"positions": "fig3", "spacing": "fig4", "speeds": "fig5", "inputs": "fig6"}

#: Rows of a comparison -> the keys of [controller] that make them.
COMPARED: dict[str, dict[str, Any]] = {"fully_distributed": {}}

#: What a train is told in `trainctl compare spacing`, and why its spacing is what it is there.
IN_STOPS = (
    "neighbours say where they will be a period ahead. Its speeds must be reached within one period, so it cannot "
    "stop: another law must"
)

#: A start on a bound is inside; sums of positions are good to about 1e-9.
ROUNDING = 1e-6


class Params(Table):
    """Keys of ``[controller]`` with ``law = "fully_distributed"``. All bounds and distances are those of trains and links."""

    eta: Literal["printed", "own_speed"] = Field(
        default="printed", description="input room [m]: at the worst speed of the band (eq. 10) or at the train's own"
    )
    join: Literal["ratchet", "strict"] = Field(
        default="ratchet", description="links outside eq. (13): widen their bounds to what is, or use them as printed"
    )


class Constants(NamedTuple):
    """The law's constants; arrays have shape (n,), ``davis`` (n, 3)."""

    period: float  # T [s]
    theta: float
    rho: Floats
    Rho: Floats
    mu: Floats
    Mu: Floats
    f: Floats
    F: Floats
    davis: Floats
    held: bool  # the acceleration is held while the resistance changes
    own_speed: bool
    ratchet: bool


def constants(params: Params, scene: Scene) -> Constants:
    """Constants of the law; see ``SampledLaw``."""
    davis = scene.consists.train_davis()
    f, F = _resistance_range(davis, scene.bounds.speed_lower, scene.bounds.speed_upper)
    return Constants(
        period=scene.control_period, theta=scene.lead,
        rho=scene.bounds.speed_lower, Rho=scene.bounds.speed_upper,
        mu=scene.bounds.input_lower, Mu=scene.bounds.input_upper,
        f=f, F=F, davis=davis,
        held=scene.control_period > scene.sub_step * 1.5,
        own_speed=params.eta == "own_speed", ratchet=params.join == "ratchet",
    )  # fmt: skip


def message(constants: Constants, own: Trains, leader: Floats) -> Floats:
    """Send where the train will be one period ahead, relative to the virtual leader now: ``z``, shape (n, 1) [m].

    In the moving frame a message that comes late is off by what its sender has moved against the formation, not by v_r T.
    """
    z = np.empty((len(own.speed), 1))
    _write_predictions(constants.theta, constants.period, own.position, own.speed, _each(leader[POSITION], own), z)
    return z


def demand(constants: Constants, own: Trains, leader: Floats, links: Links, heard: Floats) -> Demand:
    """Acceleration ubar_i of every train: eqs. (10), (11).

    Parameters
    ----------
    constants : Constants
        From ``constants()``.
    own : Trains
        What each train knows of itself.
    leader : ndarray, shape (4,)
        Position [m], speed [m/s], ... of the virtual leader.
    links : Links
        Who receives from whom, desired spacings and their bounds [m].
    heard : ndarray, shape (L, 1)
        The neighbours' ``z`` [m]. Rows not heard may hold anything.

    Returns
    -------
    Demand
        Acceleration [m/s2], and whether a saturation acted.

    Notes
    -----
    Departs from [1]_ as the module says. delta > Delta does occur by rounding when a train sits on a bound.
    """
    n = len(own.speed)
    acceleration, saturated = np.empty(n), np.empty(n, dtype=bool)
    place, wanted = (_each(leader[k], own) for k in (POSITION, SPEED))
    _admitted(constants, Trains(*map(np.ascontiguousarray, own)), place, wanted, links, heard[:, 0], acceleration, saturated)
    return Demand(acceleration, saturated)


def _each(value: Floats, own: Trains) -> Floats:
    """A number of the reference for every train; formations may have references of their own."""
    return value if np.ndim(value) else np.full(len(own.speed), value)


@bare(inline="always")
def _predicted(position: float, speed: float, theta: float, period: float, reference: float) -> float:
    """The z of one train."""
    return position + (1.0 - theta) * speed * period - reference


@bare(error_model="numpy")
def _write_predictions(theta: float, period: float, position: Floats, speed: Floats, reference: Floats, z: Floats) -> None:
    """Write what every train sends, (n, 1)."""
    for i in range(len(z)):
        z[i, 0] = _predicted(position[i], speed[i], theta, period, reference[i])


@bare(error_model="numpy")
def _admitted(
    constants: Constants, own: Trains, place: Floats, wanted: Floats, links: Links, heard: Floats, acceleration: Floats,
    saturated: Bools,
) -> None:  # fmt: skip
    """Write what (10) to (12) give every train. What is not a number is passed on."""
    c, T = constants, constants.period
    for i in range(len(wanted)):
        v, v_r = own.speed[i], wanted[i]
        z = _predicted(own.position[i], v, c.theta, T, place[i])
        alpha, Alpha, total, hold = -np.inf, np.inf, 0.0, False
        begin, end = links.first[i], links.first[i + 1]
        for k in range(begin, end):
            z_ji, gamma, Gamma = links.desired[k], links.lower[k], links.upper[k]
            if links.heard[k]:
                z_ji = heard[k] - z
            else:
                hold = True
            if c.ratchet:
                gamma, Gamma = min(gamma, z_ji), max(Gamma, z_ji)
            alpha, Alpha = max(alpha, (z_ji - Gamma) / 2), min(Alpha, (z_ji - gamma) / 2)
            total += z_ji - links.desired[k]
        G = total / (2 * (end - begin)) if end > begin else 0.0

        beta, Beta = (c.rho[i] - v_r) * T, (c.Rho[i] - v_r) * T
        if c.own_speed:
            minimum = maximum = own.resistance[i]
            if c.held:  # the input is acceleration plus resistance, and the latter changes while the former is held
                now = resistance_of(i, v, c.davis)
                minimum, maximum = own.resistance[i] + (c.f[i] - now), own.resistance[i] + (c.F[i] - now)
            vbar = v - v_r
            eta, Eta = vbar * T + (c.mu[i] - minimum) * (T * T), vbar * T + (c.Mu[i] - maximum) * (T * T)
        else:
            eta = c.Rho[i] * T + (c.mu[i] - c.f[i]) * (T * T) - v_r * T
            Eta = c.rho[i] * T + (c.Mu[i] - c.F[i]) * (T * T) - v_r * T
        # Numpy's pass on what is not a number: a train without a resistance must not go on as if its input had no bounds.
        delta, Delta = np.maximum(alpha, np.maximum(beta, eta)), np.minimum(Alpha, np.minimum(Beta, Eta))
        s = Delta if Delta <= G else np.maximum(G, delta)
        saturated[i] = s != G and not hold
        if hold:
            s = 0.0
        acceleration[i] = (v_r + s / T - v) / T


def _resistance_range(davis: Floats, rho: Floats, Rho: Floats) -> tuple[Floats, Floats]:
    """Minimum and maximum resistance on [rho, Rho], (n,) each. No coefficient is negative, so it grows with the speed."""
    return resistance(rho, davis), resistance(Rho, davis)


# What must hold before the law may be used


def violations(params: Params, scene: Scene) -> list[str]:
    """Assumptions 2.2 to 2.4, the start condition (13), ``x_ij(0)`` and ``v_i(0)``: all that fails, in words and numbers.

    Connectedness (Assumption 2.1) is the topology's to report: a train without links follows the reference speed. With
    ``join = "ratchet"`` links outside their bounds are a mistake at time 0 only; later they are joins, which the ratchet admits.
    """
    found = [*_speed_violations(scene), *_link_violations(scene)]
    if params.join == "strict" or scene.time <= 0.0:
        found += _start_violations(scene)
    return found


def _per_train(scene: Scene, bad: Bools, text: Callable[[int], str]) -> Iterator[str]:
    """One line for all trains if they all fail alike, else one line per train; ``text`` is that of a train."""
    texts = {i: text(i) for i in np.flatnonzero(bad).tolist()}
    if 1 < len(texts) == len(bad) and len(set(texts.values())) == 1:
        yield f"bounds.{texts[0]}"
        return
    for i, words in texts.items():
        yield f"train[{scene.trains[i]}].{words}"


def _speed_violations(scene: Scene) -> Iterator[str]:
    """v_i(0) in its band, Assumptions 2.3 and 2.4."""
    rho, Rho = scene.bounds.speed_lower, scene.bounds.speed_upper

    def unbounded(key: str, value: Floats) -> Callable[[int], str]:
        return lambda i: f"{key} = {value[i]:g}: needs a finite bound (Assumption 2.3)"

    for key, value in (("speed_lower_mps", rho), ("speed_upper_mps", Rho)):
        yield from _per_train(scene, ~np.isfinite(value), unbounded(key, value))
    if not np.isfinite([rho, Rho]).all():
        return

    v = scene.own[scene.consists.first[:-1], SPEED]
    for i, name in enumerate(scene.trains):
        if v[i] < rho[i] - ROUNDING:
            yield f"train[{name}].speed_mps = {v[i]:.10g}: below speed_lower_mps = {rho[i]:.10g}"
        if v[i] > Rho[i] + ROUNDING:
            yield f"train[{name}].speed_mps = {v[i]:.10g}: above speed_upper_mps = {Rho[i]:.10g}"

    slow, fast = _speed_range(scene.reference, scene.time)

    def low(i: int) -> str:
        return f"speed_lower_mps = {rho[i]:.10g}: must be below the reference speed {slow:.10g} m/s (Assumption 2.3)"

    def high(i: int) -> str:
        return f"speed_upper_mps = {Rho[i]:.10g}: must be above the reference speed {fast:.10g} m/s (Assumption 2.3)"

    yield from _per_train(scene, rho >= slow, low)
    yield from _per_train(scene, Rho <= fast, high)
    yield from _input_violations(scene, slow, fast)


def _input_violations(scene: Scene, slow: float, fast: float) -> Iterator[str]:
    """Assumption 2.4 for reference speeds from ``slow`` to ``fast`` [m/s]."""
    rho, Rho, mu, Mu = scene.bounds
    T = scene.control_period
    f, F = _resistance_range(scene.consists.train_davis(), rho, Rho)
    brakes, pulls = mu < f, Mu > F
    cure = ""
    if brakes.all() and pulls.all():
        period = max(np.max((Rho - slow) / (f - mu)), np.max((fast - rho) / (Mu - F)))
        cure = f", or run.control_period_s above {period:.6g}"

    def to_brake(i: int) -> str:
        key = f"input_lower_mps2 = {mu[i]:.10g}"
        if not brakes[i]:
            return f"{key}: must be below the minimum running resistance, {f[i]:.6g} m/s2 at {rho[i]:.10g} m/s (Assumption 2.4)"
        need = f[i] - (Rho[i] - slow) / T
        span = f"from {Rho[i]:.10g} to {slow:.10g} m/s within one control period of {T:.10g} s"
        return f"{key}: must be below {need:.6g} to brake {span}{cure} (Assumption 2.4)"

    def to_pull(i: int) -> str:
        key = f"input_upper_mps2 = {Mu[i]:.10g}"
        if not pulls[i]:
            return f"{key}: must be above the maximum running resistance, {F[i]:.6g} m/s2 at {Rho[i]:.10g} m/s (Assumption 2.4)"
        need = F[i] + (fast - rho[i]) / T
        span = f"from {rho[i]:.10g} to {fast:.10g} m/s within one control period of {T:.10g} s"
        return f"{key}: must be above {need:.6g} to speed up {span}{cure} (Assumption 2.4)"

    yield from _per_train(scene, ~brakes | (Rho - slow >= (f - mu) * T), to_brake)
    yield from _per_train(scene, ~pulls | (fast - rho >= (Mu - F) * T), to_pull)


def _speed_range(reference: Reference, time: float) -> tuple[float, float]:
    """Minimum and maximum speed of the virtual leader from ``time`` on, looked up at both ends of its pieces [m/s]."""
    out, speeds = np.empty(4), []
    leader_at(reference, time, time, out)
    speeds.append(out[SPEED])
    for start, end in zip(reference.breaks[:-1], reference.breaks[1:], strict=True):
        for t in (start, end):
            if np.isfinite(t) and t > time:
                leader_at(reference, t, start, out)
                speeds.append(out[SPEED])
    return float(min(speeds)), float(max(speeds))


def _pairs(scene: Scene) -> list[int]:
    """One row per pair of trains, that with the train ahead as sender where both are there."""
    links, seen = scene.links, dict[tuple[int, int], int]()
    for row, (j, i) in enumerate(zip(links.sender.tolist(), links.receiver.tolist(), strict=True)):
        other = seen.get((min(i, j), max(i, j)))
        if other is None or links.desired[row] > links.desired[other]:
            seen[min(i, j), max(i, j)] = row
    return list(seen.values())


def _name(scene: Scene, row: int) -> str:
    links = scene.links
    return f"link[{scene.trains[links.sender[row]]},{scene.trains[links.receiver[row]]}]"


def _link_violations(scene: Scene) -> Iterator[str]:
    """Assumption 2.2, and trains that have a length."""
    links = scene.links
    rows = {(j, i): row for row, (j, i) in enumerate(zip(links.sender.tolist(), links.receiver.tolist(), strict=True))}
    length, mutual = scene.consists.train_length(), True
    for row in _pairs(scene):
        j, i = int(links.sender[row]), int(links.receiver[row])
        name, d, lower, upper = _name(scene, row), links.desired[row], links.lower[row], links.upper[row]
        back = rows.get((i, j))
        if back is None:
            mutual = False
            yield f"{name}: train {scene.trains[j]} must receive from train {scene.trains[i]} too, this law needs links both ways"
        elif not _close((d, lower, upper), (-links.desired[back], -links.upper[back], -links.lower[back])):
            yield f"{name}: desired_m, lower_m and upper_m must be the same both ways with the sign changed (Assumption 2.2)"
        if links.weight[row] != 1.0:
            yield f"{name}.weight = {links.weight[row]:.10g}: this law has no weights, only 1"
        if not lower < d:
            yield f"{name}.lower_m = {lower:.10g}: must be below desired_m = {d:.10g} (Assumption 2.2)"
        if not d < upper:
            yield f"{name}.upper_m = {upper:.10g}: must be above desired_m = {d:.10g} (Assumption 2.2)"
        if d > 0.0 and lower < length[j] and length[j] > 0.0:
            yield f"{name}.lower_m = {lower:.10g}: spacing is front to front, and train {scene.trains[j]} is {length[j]:.10g} m"
    if mutual:
        yield from _cycle_violations(scene)


def _close(some: tuple[float, ...], others: tuple[float, ...]) -> bool:
    """Whether numbers are the same but for rounding; infinite ones may be."""
    return all(a == b or abs(a - b) <= ROUNDING for a, b in zip(some, others, strict=True))


def _cycle_violations(scene: Scene) -> Iterator[str]:
    """Assumption 2.2 on every cycle of links both ways: a spanning forest gives offsets, each link outside it closes a cycle."""
    links, n = scene.links, len(scene.trains)
    offset, parent, depth = np.full(n, np.nan), np.full(n, -1), np.zeros(n, dtype=int)
    for root in range(n):
        if not np.isnan(offset[root]):
            continue
        offset[root], queue = 0.0, [root]
        for i in queue:  # breadth first, so the cycles named are short
            for row in range(links.first[i], links.first[i + 1]):
                j = links.sender[row]
                if np.isnan(offset[j]):
                    offset[j], parent[j], depth[j] = offset[i] + links.desired[row], i, depth[i] + 1
                    queue.append(int(j))
    for row in _pairs(scene):
        j, i = int(links.sender[row]), int(links.receiver[row])
        around = links.desired[row] - (offset[j] - offset[i])
        if abs(around) > ROUNDING:
            ahead, behind = [j], [i]
            while ahead[-1] != behind[-1]:
                side = ahead if depth[ahead[-1]] >= depth[behind[-1]] else behind
                side.append(int(parent[side[-1]]))
            cycle = "-".join(scene.trains[k] for k in [i, *ahead, *behind[-2::-1]])
            yield (
                f"{_name(scene, row)}.desired_m = {links.desired[row]:.10g}: desired distances around the cycle {cycle} sum to "
                f"{around:.10g} m, must be 0 (Assumption 2.2)"
            )


def _start_violations(scene: Scene) -> Iterator[str]:
    """x_ij(0), and (13) for this plant: both within [gamma, Gamma]."""
    own = scene.own[scene.consists.first[:-1]]
    x = own[:, POSITION]
    z = x + (1.0 - scene.lead) * own[:, SPEED] * scene.control_period
    links = scene.links
    for row in _pairs(scene):
        j, i = links.sender[row], links.receiver[row]
        for spacing, when in ((x[j] - x[i], "at the start"), (z[j] - z[i], "one period ahead, eq. (13),")):
            if spacing < links.lower[row] - ROUNDING:
                yield f"{_name(scene, row)}.lower_m = {links.lower[row]:.10g}: spacing {when} is {spacing:.10g} m, too small"
            if spacing > links.upper[row] + ROUNDING:
                yield f"{_name(scene, row)}.upper_m = {links.upper[row]:.10g}: spacing {when} is {spacing:.10g} m, too large"


# In comparisons


def alternative(tables: stated.Tables) -> dict[str, Any]:
    """Tables that put this law in front of the traffic of another."""
    run = tables["run"]
    return {
        "controller": {**tables["controller"], "eta": "own_speed"},
        "run": {**run, "control_period_s": stated.periods(run, 8.0)},
    }


def on_a_line(tables: stated.Tables, band: dict[str, float]) -> dict[str, Any]:
    """Tables of its row in `trainctl compare capacity`."""
    period = 10.0  # what is left of 8 MW at this speed must do for a move within the band: Assumption 2.4
    run, duration = tables["run"], math.ceil(tables["run"]["duration_s"] / period) * period
    return {
        "controller": {**tables["controller"], "eta": "own_speed"}, "bounds": band,
        "run": {**run, "control_period_s": period, "duration_s": duration},
    }  # fmt: skip
