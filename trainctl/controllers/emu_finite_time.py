"""Finite-time cooperative cruise of EMU groups: Wei, Ge and Wu, Control Theory & Applications 2022 (5).

Every power unit is an agent: it receives from its neighbours in the train, first and last units from the next
train, and every head knows the virtual leader. With ``alpha_1 = 1`` this is the ordinary consensus the paper compares with.

Symbols
-------
x, v         position of a unit's front [m], its speed [m/s]
xt, vt       position and speed relative to the desired ones (x, v with tilde), eq. (8)
e            stretch of a coupler [m], eq. (1): difference of xt between its units
s, ls, le    clear distance rear to front, its desired value, the emergency distance [m], eq. (9)
z            s - ls [m]: difference of xt between the tail ahead and the head behind
k_hat        coupler stiffness per mass [1/s2]
h1, h2       largest stretch and compression of a coupler [m]
w            barrier weight of a coupler; a = w - k_hat / p1 is the paper's in-train weight
b            weight between trains; beta the range of communication [m]
delta1, delta2, gamma1, gamma2   widths of the zones where w and b leave 1 [m]
zeta, beta_hat                   ls - le and beta - ls [m]
p1..p4, mu1, mu2                 gains of eq. (13)
alpha1, alpha2                   its exponents, alpha2 = 2 alpha1 / (1 + alpha1)

Corrections to the print: (8) counts the full length of the trains ahead and of the units ahead in the train; (9) has xt twice, so s
is the clear distance; the compression branch of w holds for both units of a pair, as Lemma 1 needs, and so does the branch b = 0;
weights are taken at most 1 mm inside the coupler's range and 1 m short of the emergency distance, where the print leaves them
undefined. Every head is pinned, as printed. ls belongs to each pair of trains: longer where a train left and its slot is kept.
Masses that differ within a train (``weighted_by_mass``): a coupler pulls both its units with one force, of the mass that keeps
their relative motion that of equal units, heads and tails pull as the mean unit does; V of (15) by mass falls.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numba import njit
from pydantic import Field

from trainctl.contracts import ContinuousLaw
from trainctl.controllers import emu_theory, stated
from trainctl.controllers.powers import BLOCK, signed_powers
from trainctl.davis import running_resistance
from trainctl.kernels import inlined
from trainctl.signals import POSITION, SPEED, Floats, Ints, Links, Scene, Table, leader_at

if TYPE_CHECKING:
    from trainctl.controllers import emu_finite_time

    module: ContinuousLaw = emu_finite_time

CLOCK: Literal["continuous"] = "continuous"
ORDER: Literal["parallel", "chain"] = "parallel"
JOIN: Literal["start_condition"] = "start_condition"
WATCHED = ("interval_m",)

#: Figures -> their numbers in the paper; rows of a comparison -> the keys of [controller] that make them.
FIGURES = {"unit_speeds": "fig3", "speed_over_position": "fig4", "couplers": "fig5", "gaps": "fig6"}
COMPARED: dict[str, dict[str, Any]] = {"emu_finite_time": {"alpha_1": 0.9}, "ordinary_consensus": {"alpha_1": 1.0}}

#: What a train is told in `trainctl compare spacing`, and why its spacing is what it is there.
IN_STOPS = (
    "first and last units of neighbours. The reference runs on at its speed; only a barrier brakes, from 90 % of the clear "
    "distance on to half of it"
)

#: Columns of a message: head and tail relative to the leader (the tail moved forward by the units ahead of it), train length.
HEAD, HEAD_SPEED, TAIL, TAIL_SPEED, LENGTH_OF_TRAIN = range(5)
MESSAGE = 5
WORK: tuple[str, ...] = ("terms",)

#: Columns of ``Constants.units``.
MASS, INERTIA, C0, C1, C2, LENGTH, K_HAT, PAIR, MEAN = range(9)

#: How near to the ends of their ranges the weights are evaluated [m].
COUPLER_MARGIN, INTERVAL_MARGIN = 1e-3, 1.0

#: Classic Runge-Kutta is stable for rates up to 2.785 over the step; somewhat less, since weights are only rehearsed.
RUNGE_KUTTA_LIMIT = 2.55

#: Speed differences [m/s] below which chatter is no matter: while a barrier acts, and settled.
CHATTER_AT_BARRIER, CHATTER_SETTLED = 1e-1, 1e-4

#: Step [s] for units with force limits: at a barrier the law chatters within them, and the paper's couplers are right to 0.4 mm.
BOUNDED_STEP = 0.02

#: How the start is rehearsed to see how stiff the law gets: step [s] and number of steps.
REHEARSAL_STEP, REHEARSAL_STEPS = 2e-3, 10_000


class Params(Table):
    """Keys of ``[controller]`` for ``emu_finite_time``; the defaults are the paper's."""

    alpha_1: float = Field(0.9, gt=0.0, le=1.0, description="Exponent of position terms, eq. (13); 1 is ordinary consensus")
    p_1: float = Field(20.0, gt=0.0, description="Gain on positions in the train, eq. (13) [m^(1-alpha_1)/s2]")
    p_2: float = Field(1e-4, gt=0.0, description="Gain on positions between trains, eq. (13) [m^(1-alpha_1)/s2]")
    p_3: float = Field(10.0, gt=0.0, description="Gain on speeds in the train, eq. (13) [(m/s)^(1-alpha_2)/s]")
    p_4: float = Field(1.0, gt=0.0, description="Gain on speeds between trains, eq. (13) [(m/s)^(1-alpha_2)/s]")
    mu_1: float = Field(0.05, gt=0.0, description="Gain of a leading unit on its position error, eq. (13) [m^(1-alpha_1)/s2]")
    mu_2: float = Field(0.1, gt=0.0, description="Gain of a leading unit on its speed error, eq. (13) [(m/s)^(1-alpha_2)/s]")
    weighted_by_mass: bool = Field(
        False, description="Units of one train may differ in mass: couplers pull both alike, beyond the paper"
    )
    coupler_stretch_m: float = Field(0.1, gt=COUPLER_MARGIN, description="h1, largest stretch of a coupler [m], eq. (11)")
    coupler_compression_m: float = Field(0.1, gt=COUPLER_MARGIN, description="h2, largest compression of a coupler [m], eq. (11)")
    stretch_zone_m: float = Field(0.05, gt=0.0, description="delta1, width of the barrier before h1 [m]")
    compression_zone_m: float = Field(0.03, gt=0.0, description="delta2, width of the barrier before h2 [m]")
    emergency_distance_m: float = Field(1500.0, gt=0.0, description="le, clear distance that triggers an emergency brake [m]")
    emergency_zone_m: float = Field(600.0, gt=0.0, description="gamma2, width of the barrier before the emergency distance [m]")
    range_m: float = Field(10000.0, gt=0.0, description="beta, clear distance beyond which messages do not reach [m]")
    range_zone_m: float = Field(1000.0, gt=0.0, description="gamma1, width over which the weight fades before the range [m]")


class Constants(NamedTuple):
    """Units, gains and zones."""

    first: Ints  # (n + 1,)
    units: Floats  # (U, 9) one column per constant named above
    alpha1: float
    alpha2: float
    p1: float
    p2: float
    p3: float
    p4: float
    mu1: float
    mu2: float
    h1: float
    h2: float
    delta1: float
    delta2: float
    le: float
    gamma2: float
    beta: float
    gamma1: float
    terms: Floats  # (4, k) work space for the terms of one train, k >= units + links: differences [m], [m/s], and their powers


def constants(params: Params, scene: Scene) -> Constants:
    """Pack gains and units; of who receives from whom it takes the number of links only."""
    c = scene.consists
    most = int((np.diff(c.first) + np.diff(scene.links.first)).max(initial=0))
    terms = np.zeros((4, -(-most // BLOCK) * BLOCK))
    inertia = c.mass * c.rotating
    pair = emu_theory.pair_inertia(inertia)
    mean = np.repeat(np.add.reduceat(inertia, c.first[:-1]) / np.diff(c.first), np.diff(c.first))
    units = np.column_stack([c.mass, inertia, c.davis, c.length, c.stiffness / pair, pair, mean])
    p = params
    return Constants(
        c.first, np.ascontiguousarray(units, dtype=np.float64), p.alpha_1, 2.0 * p.alpha_1 / (1.0 + p.alpha_1), p.p_1, p.p_2, p.p_3,
        p.p_4, p.mu_1, p.mu_2, p.coupler_stretch_m, p.coupler_compression_m, p.stretch_zone_m, p.compression_zone_m,
        p.emergency_distance_m, p.emergency_zone_m, p.range_m, p.range_zone_m, terms,
    )  # fmt: skip


@inlined()
def coupler_weight(e: float, h1: float, h2: float, delta1: float, delta2: float) -> float:
    """Barrier weight w of a coupler at stretch ``e``: 1 inside, unbounded towards h1 and -h2."""
    if e > h1 - delta1:
        e = min(e, h1 - COUPLER_MARGIN)
        return (2.0 * h1 - delta1) * delta1 / ((h1 - e) * (h1 + e))
    if e < delta2 - h2:
        e = max(e, COUPLER_MARGIN - h2)
        return (delta2 / (h2 + e)) ** 2
    return 1.0


@inlined()
def train_weight(z: float, ls: float, le: float, beta: float, gamma1: float, gamma2: float) -> float:
    """Weight b between trains at clear distance ls + ``z``: 0 out of range, unbounded towards the emergency distance."""
    zeta, beta_hat = ls - le, beta - ls
    if z > beta_hat:
        return 0.0
    if z > beta_hat - gamma1:
        return (beta_hat - abs(z)) / gamma1
    if z <= gamma2 - zeta:
        z = max(z, INTERVAL_MARGIN - zeta)
        return (2.0 * zeta - gamma2) * gamma2 / ((zeta - z) * (zeta + z))
    return 1.0


@inlined()
def demand(
    i: int, constants: Constants, leader: Floats, age: float, slot: float, own: Floats, estimate: Floats, correction: Floats,
    desired: Floats, heard: Floats, out: Floats,
) -> None:  # fmt: skip
    """Write the force of each unit of train ``i`` [N] into ``out``: eq. (13) times mass.

    Parameters
    ----------
    i : int
        The train.
    constants : Constants
        Of all trains.
    leader : ndarray, shape (4,)
        Position, speed, ... of the virtual leader.
    slot : float
        Nominal position of the leading unit relative to the leader [m]; the offsets of eq. (8).
    age, estimate, correction : float, ndarray, ndarray
        Not used: held messages stay as they are, and there is no observer.
    own : ndarray, shape (units, 2)
        Position [m] and speed [m/s].
    desired : ndarray, shape (k,)
        Desired spacing of each link, front to front, positive if the sender is ahead [m].
    heard : ndarray, shape (k, 5)
        Messages.
    out : ndarray, shape (units,)
        Force [N].

    Notes
    -----
    The terms of a coupler are evaluated once and act on both its units. Where inertia is more than mass, inertia takes its place
    but in the resistance. All powers of a train are taken together: columns of ``terms`` are those of its couplers, of its head's
    own errors, of its links.
    """
    c, units = constants, constants.units
    e, dv, e_power, dv_power = c.terms[0], c.terms[1], c.terms[2], c.terms[3]
    start, last = c.first[i], len(out) - 1
    ahead = 0.0  # length of the units ahead in the train
    for j in range(last):
        row = start + j
        e[j] = own[j, POSITION] - own[j + 1, POSITION] - units[row, LENGTH]
        dv[j] = own[j, SPEED] - own[j + 1, SPEED]
        ahead += units[row, LENGTH]
    x_head, v_head = own[0, POSITION] - leader[0], own[0, SPEED] - leader[1]
    x_tail, v_tail = own[last, POSITION] + ahead - leader[0], own[last, SPEED] - leader[1]
    e[last], dv[last] = x_head - slot, v_head
    for k in range(len(desired)):
        z = last + 1 + k
        if desired[k] > 0.0:  # the tail of the train ahead
            e[z], dv[z] = heard[k, TAIL] - x_head - desired[k], heard[k, TAIL_SPEED] - v_head
        else:  # the head of the train behind
            e[z], dv[z] = x_tail - heard[k, HEAD] + desired[k], v_tail - heard[k, HEAD_SPEED]
    signed_powers(e, c.alpha1, e_power)
    signed_powers(dv, c.alpha2, dv_power)
    for j in range(last + 1):
        row = start + j
        v = own[j, SPEED]
        drag = running_resistance(v, units[row, C0], units[row, C1], units[row, C2])
        out[j] = units[row, MASS] * drag
    k_p1 = 1.0 / c.p1
    for j in range(last):
        row = start + j
        weight = coupler_weight(e[j], c.h1, c.h2, c.delta1, c.delta2) - k_p1 * units[row, K_HAT]
        pull = units[row, PAIR] * weight * (c.p1 * e_power[j] + c.p3 * dv_power[j])
        out[j] -= pull
        out[j + 1] += pull
    a_head = -(c.mu1 * e_power[last] + c.mu2 * dv_power[last])
    a_tail = 0.0
    for k in range(len(desired)):
        z = last + 1 + k
        if desired[k] > 0.0:
            ls = desired[k] - heard[k, LENGTH_OF_TRAIN]
            a_head += train_weight(e[z], ls, c.le, c.beta, c.gamma1, c.gamma2) * (c.p2 * e_power[z] + c.p4 * dv_power[z])
        else:
            ls = -desired[k] - ahead - units[start + last, LENGTH]
            a_tail -= train_weight(e[z], ls, c.le, c.beta, c.gamma1, c.gamma2) * (c.p2 * e_power[z] + c.p4 * dv_power[z])
    out[0] += units[start, MEAN] * a_head
    out[last] += units[start, MEAN] * a_tail


@inlined()
def message(
    i: int, constants: Constants, leader: Floats, slot: float, own: Floats, estimate: Floats, estimate_rate: Floats, out: Floats
) -> None:
    """Write what train ``i`` sends into ``out`` (5,): see ``HEAD`` and so on. All relative to the leader: old data do not lag."""
    start, last = constants.first[i], len(own) - 1
    ahead = 0.0
    for j in range(last):
        ahead += constants.units[start + j, LENGTH]
    out[HEAD] = own[0, POSITION] - leader[0]
    out[HEAD_SPEED] = own[0, SPEED] - leader[1]
    out[TAIL] = own[last, POSITION] + ahead - leader[0]
    out[TAIL_SPEED] = own[last, SPEED] - leader[1]
    out[LENGTH_OF_TRAIN] = ahead + constants.units[start + last, LENGTH]


@inlined()
def watch(i: int, constants: Constants, leader: Floats, first: Ints, own: Floats, links: Links, out: Floats) -> None:
    """Write the clear distance to the train ahead [m], eq. (9), into ``out`` (1,): NaN if train ``i`` receives from none."""
    out[0] = np.nan
    for k in range(links.first[i], links.first[i + 1]):
        if links.desired[k] > 0.0:
            tail = first[links.sender[k] + 1] - 1
            s = own[tail, POSITION] - constants.units[tail, LENGTH] - own[first[i], POSITION]
            if not s >= out[0]:  # the first one, or a nearer one
                out[0] = s


def watched_bounds(params: Params, scene: Scene) -> tuple[Floats, Floats]:
    """Lower and upper bounds of what ``watch`` writes, each (n, 1): the clear distance stays above the emergency distance le."""
    n = len(scene.trains)
    return np.full((n, 1), params.emergency_distance_m), np.full((n, 1), np.inf)


def violations(params: Params, scene: Scene) -> list[str]:
    """Say which hypotheses of Theorem 1, and which needs of the law, do not hold at the start."""
    found = emu_theory.violations(params, scene)
    return found or [*step_violations(params, scene)]  # the step is rehearsed from the start, which must be a sound one


def step_violations(params: Params, scene: Scene) -> list[str]:
    """Find a step that the in-train terms do not bear."""
    if np.isnan(scene.links.slot).any() or not np.isfinite(scene.own).all():
        return []
    most = largest_sub_step(params, scene)
    if scene.sub_step <= most:
        return []
    return [
        f"run.sub_step_s = {scene.sub_step:g}: at most {math.floor(most * 1e4) / 1e4:g} s, or the in-train terms of the law "
        "diverge (p_3 times the coupler weight this start leads to)"
    ]


def largest_sub_step(params: Params, scene: Scene) -> float:
    """Estimate the largest Runge-Kutta step [s] that carries the law from this start.

    Parameters
    ----------
    params : Params
        Gains.
    scene : Scene
        Start, links and unit limits.

    Returns
    -------
    float
        Step [s].

    Notes
    -----
    Ours, not the paper's. What stiffens the loop is p3 (w - k_hat / p1) sig(dv)^alpha2. The start is rehearsed with a short step
    to see which w its couplers reach. The largest eigenvalue of a train's Laplacian with these weights, times p3, times the slope
    of sig at a speed difference too small to matter, must stay below the limit of Runge-Kutta; so must w = 1 with the slope at a
    much smaller one, settled. Units with force limits cannot diverge: for them the barrier is left out, and ``BOUNDED_STEP`` holds.
    An estimate, no proof: of random starts and gains 1 to 2 in 100 need up to a tenth less, or run into a coupler's end anyway.
    """
    c, first, consists = constants(params, scene), scene.consists.first, scene.consists
    bounded = np.logical_and.reduceat(np.isfinite(consists.traction) & np.isfinite(consists.braking), first[:-1])
    several = np.diff(first) > 1
    w, fastest = np.ones(len(consists.mass)), 0.0
    if (several & ~bounded).any():  # else nothing would be asked of what is rehearsed, and that takes most of the time
        leader, links = np.zeros(4), scene.links
        leader_at(scene.reference, scene.time, scene.time, leader)
        limits = np.column_stack([consists.traction, consists.traction_power, consists.braking, consists.braking_power])
        own = np.ascontiguousarray(scene.own[:, :2])
        w = rehearse(c, limits, leader, links.slot, links.sender, links.first, links.desired, own, REHEARSAL_STEP, REHEARSAL_STEPS)
    for i in np.flatnonzero(several).tolist():
        a, b = first[i], first[i + 1]
        if bounded[i]:
            w[a:b] = 1.0
            fastest = max(fastest, RUNGE_KUTTA_LIMIT / BOUNDED_STEP)
        k_p1 = c.units[a : b - 1, K_HAT] / c.p1
        inertia = c.units[a:b, INERTIA]
        edges, heavy = np.diff(np.eye(b - a), axis=0) * np.sqrt(inertia[0] / inertia), c.units[a : b - 1, PAIR] / inertia[0]
        for weights, chatter in ((w[a : b - 1], CHATTER_AT_BARRIER), (np.ones(b - a - 1), CHATTER_SETTLED)):
            stiffest = np.linalg.eigvalsh(edges.T @ np.diag(heavy * (weights - k_p1)) @ edges)[-1]
            fastest = max(fastest, float(c.p3 * stiffest * c.alpha2 * chatter ** (c.alpha2 - 1.0)))
    return RUNGE_KUTTA_LIMIT / fastest if fastest > 0.0 else math.inf


@njit(cache=True, error_model="numpy")
def rehearse(
    constants: Constants, limits: Floats, leader: Floats, slot: Floats, sender: Ints, heard_from: Ints, desired: Floats,
    start: Floats, h: float, steps: int,
) -> Floats:  # fmt: skip
    """Integrate the closed loop (14) from ``start`` (U, 2); return each train's weights w when it was stiffest, shape (U,).

    ``limits`` (U, 4) are traction force and power, braking force and power; ``heard_from`` (n + 1,) the links of each train. The
    leader keeps its speed.
    """
    c, first, units = constants, constants.first, constants.units
    leader, n, none = leader.copy(), len(constants.first) - 1, np.zeros((0, 0))
    sent, heard = np.zeros((n, MESSAGE)), np.zeros((len(sender), MESSAGE))
    force, w, peak, stiffest = np.zeros(len(start)), np.ones(len(start)), np.ones(len(start)), np.zeros(n)
    own, base, rate, total = start.copy(), start.copy(), np.zeros_like(start), np.zeros_like(start)
    for _ in range(steps):
        base[:] = own
        total[:] = 0.0
        begin = leader[0]
        for s in range(4):
            ahead = 0.0 if s == 0 else (h if s == 3 else 0.5 * h)
            own[:] = base + ahead * rate
            leader[0] = begin + ahead * leader[1]
            for i in range(n):
                rows = own[first[i] : first[i + 1]]
                message(i, c, leader, slot[i], rows, none, none, sent[i])
            for k in range(len(sender)):
                heard[k] = sent[sender[k]]
            for i in range(n):
                a, b = first[i], first[i + 1]
                e, f = heard_from[i], heard_from[i + 1]
                demand(i, c, leader, 0.0, slot[i], own[a:b], none, none, desired[e:f], heard[e:f], force[a:b])
                pull = 0.0
                for u in range(a, b):
                    v = own[u, SPEED]
                    traction, power, braking, braking_power = limits[u]
                    given, fast = force[u], max(v, 1e-3)
                    if given > traction or given * fast > power:  # a division only where a limit acts
                        given = min(traction, power / fast)
                    elif -given > braking or -given * fast > braking_power:
                        given = -min(braking, braking_power / fast)
                    drag = units[u, MASS] * running_resistance(v, units[u, C0], units[u, C1], units[u, C2])
                    stretch = 0.0
                    if u + 1 < b:
                        stretch = own[u, POSITION] - own[u + 1, POSITION] - units[u, LENGTH]
                        w[u] = coupler_weight(stretch, c.h1, c.h2, c.delta1, c.delta2)
                    spring = units[u, K_HAT] * units[u, PAIR] * stretch
                    rate[u, POSITION] = v
                    rate[u, SPEED] = (given - drag + pull - spring) / units[u, INERTIA]
                    pull = spring
                stiffness = 0.0  # row sums of the Laplacian between couplers: no eigenvalue is larger
                for u in range(a, b - 1):
                    beside = (w[u - 1] if u > a else 0.0) + (w[u + 1] if u + 2 < b else 0.0)
                    stiffness = max(stiffness, 2.0 * w[u] + beside)
                if stiffness > stiffest[i]:
                    stiffest[i] = stiffness
                    peak[a:b] = w[a:b]
            total += (1.0 if s in (0, 3) else 2.0) / 6.0 * rate
        own[:] = base + h * total
        leader[0] = begin + h * leader[1]
    return peak


def numbered(controller: Mapping[str, Any], observer: str) -> dict[str, str]:
    """Figures of the paper that a run with these keys shows."""
    return {"unit_speeds": "fig7_ordinary_consensus"} if controller.get("alpha_1") == 1.0 else FIGURES


def alternative(tables: stated.Tables) -> dict[str, Any]:
    """Tables that put this law in front of the traffic of another."""
    (minimum, wanted, most), alpha = stated.clear_distances(tables), tables["controller"]["alpha_1"]
    zone = min(600.0, 0.4 * max(wanted - minimum, 1.0))
    own = {"law": "emu_finite_time", "emergency_distance_m": minimum, "emergency_zone_m": zone, "range_m": most, "alpha_1": alpha}
    return {"controller": own, "run": {**tables["run"], "sub_step_s": 0.0025 if alpha == 1.0 else 0.01}}


def on_a_line(tables: stated.Tables, band: dict[str, float]) -> dict[str, Any]:
    """Tables of its rows in `trainctl compare capacity`."""
    (minimum, wanted, _), spacing = stated.clear_distances(tables), tables["topology"]["spacing_m"]
    own = {"emergency_distance_m": minimum, "emergency_zone_m": 0.4 * (wanted - minimum), "range_m": max(10_000.0, 2.0 * spacing)}
    return {"controller": {**tables["controller"], **own}, "run": {**tables["run"], "sub_step_s": 0.02}}


def in_stops(tables: stated.Tables, band: dict[str, float], braking: tuple[float, float]) -> dict[str, Any]:
    """Tables of its rows in `trainctl compare spacing`: the emergency distance is half of the clear one, as in the paper's example.

    The zone before it begins as soon as the train ahead slows down: with the zones of other rows trains touch at any spacing.
    """
    made, wanted = on_a_line(tables, band), tables["topology"]["spacing_m"] - stated.longest(tables)
    return {**made, "controller": {**made["controller"], "emergency_distance_m": 0.5 * wanted, "emergency_zone_m": 0.4 * wanted}}
