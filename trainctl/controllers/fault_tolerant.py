"""Asymptotical cooperative cruise fault-tolerant control with barrier functions: eqs. (29)-(39) of [1]_.

The head of each train follows the tail of the train ahead inside given bounds of distance and speed difference (first train: the
virtual leader at its slot); every further carriage follows the one in front of it. The law is evaluated together with an observer
(``asymptotic`` or ``intermediate``), whose right-hand sides it cancels: it reads only ``estimate`` columns x, v, w and
``correction``, so any observer of that form serves.

Symbols
-------
=====================  =======================================================================================================
x0, v0, w0, u0         the virtual leader: position [m], speed [m/s], acceleration [m/s2], jerk [m/s3]
xt, vt, wt             x tilde, v tilde [m, m/s] from measurements and w tilde [m/s2] from estimates: predecessor minus self
rho1, rho2             R2: -rho2 < xt < rho1 [m]
sigma1, sigma2         R3: -sigma2 < vt < sigma1 [m/s]
qt                     vt + ell1 xt [m/s]
varrho1, varrho2       R3': -varrho2 < qt < varrho1 [m/s]
phi, psi, Phi, Psi     barrier functions of xt, qt, eqs. (34), (35)
beta1, beta2, G        eqs. (36), (37); G is what the predecessor's tail sends, w_hat'
z1, z2, z3, l1, l2, l3 errors and gains of the carriages behind the head, eqs. (29)-(32); kappa = l1 + 1
ell1 .. ell4           gains of the heads
u                      jerk input [m/s3], eq. (5); the demand is the force varpi / r [N]
=====================  =======================================================================================================

Departures from [1]_, each shown in ``tests/paper/test_fault_tolerant.py``
-------------------------------------------------------------------------------
* (37) prints ``- ell4 beta2``. beta2 holds predecessor minus self, so (54) needs ``+``.
* Section 5 swaps the values of varrho1 and varrho2; Remark 2.1 is used.
* A head sends its train's tail moved to where the tail says the head is: spacings stay front to front, and epsilon = spacing minus
  the length of the train ahead without its last carriage.
* Close to a bound of qt the barrier is stiffer than any integrator (Theorem 2 holds in continuous time only). Where
  ``(d beta1 / d vt)^2 h > 2`` it goes on with constant slope, so it stays finite there and outside; for h -> 0 it is the paper's.

References
----------
.. [1] Zhang, Chen, "Asymptotical Cooperative Cruise Fault Tolerant Control for Multiple High-speed Trains with State
   Constraints".
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from trainctl.carriages import miscounted, miscounted_trains, of_trains, spread
from trainctl.contracts import ContinuousLaw
from trainctl.controllers import stated
from trainctl.kernels import inlined
from trainctl.signals import POSITION, SPEED, Floats, Ints, Links, Scene, Table, leader_at

if TYPE_CHECKING:
    from trainctl.controllers import fault_tolerant

    module: ContinuousLaw = fault_tolerant

CLOCK: Literal["continuous"] = "continuous"
ORDER: Literal["parallel", "chain"] = "chain"
MESSAGE = 4
WORK: tuple[str, ...] = ()
WATCHED = ("spacing_error_m", "speed_error_mps", "q_error_mps")

#: A train is linked only once (39) holds: the barrier has no value outside.
JOIN: Literal["start_condition"] = "start_condition"
PLANTS = ("actuated_units",)
#: Observers whose ``estimate`` and ``correction`` have the columns below.
OBSERVERS = ("asymptotic", "intermediate")

#: Figures -> their numbers in the paper.
FIGURES = {
    "fault_estimates": "fig2", "acceleration_estimates": "fig3", "position_differences": "fig4", "speed_differences": "fig5",
    "unit_positions": "fig6", "unit_speeds": "fig7", "unit_forces": "fig8",
}  # fmt: skip

#: Rows of a comparison -> the keys of [controller] that make them.
COMPARED: dict[str, dict[str, Any]] = {"fault_tolerant": {}}

#: What a train is told in `trainctl compare spacing`, and why its spacing is what it is there.
IN_STOPS = (
    "neighbours' estimated places and speeds. Barriers on distances and speed differences grow without bound before trains touch"
)

#: Columns of ``estimate`` and ``correction``.
X, V, W = 0, 1, 2
X_RATE, V_RATE, W_DRIFT, UNCOMPENSATED, STATIC = 0, 1, 2, 3, 4

#: The jerk of an old message fades with this time [s], about that of beta2. Carried on unchanged it grows for a whole
#: communication period, and at 1 s the loop is lost; dropped at once it costs higher peaks of force.
FADE = 0.2

#: Keys that may be lists: one number per carriage, per train.
CARRIAGE, HEAD = ("carriage_l1", "carriage_l2", "carriage_l3"), ("head_l1_per_s", "head_l2", "head_l3", "head_l4")

#: Classic Runge-Kutta is stable to 2.78; the rest is margin.
STABLE = 2.5


Gain = Annotated[float, Field(gt=0)]
Gains = Gain | tuple[Gain, ...]


class Params(Table):
    """Keys of ``[controller]`` with ``law = "fault_tolerant"``. Bounds of distance are those of the links.

    Gains are one number, or lists: of carriages with one per carriage of a train or of all trains, of heads with one per train.
    """

    carriage_l1: Gains = Field(0.1, description="l1, carriages behind the leading one, eq. (29)")
    carriage_l2: Gains = Field(0.1, description="l2, eq. (30)")
    carriage_l3: Gains = Field(0.1, description="l3, eq. (31)")
    head_l1_per_s: Gains = Field(0.01, description="ell1 of the heads [1/s]: distances settle with this rate, R3'")
    head_l2: Gains = Field(2.1, description="ell2, eq. (36); above 2")
    head_l3: Gains = Field(4.3, description="ell3, eq. (36); above 2 + ell2^2 / 2")
    head_l4: Gains = Field(1.0, description="ell4, eq. (37); above 1/2")
    speed_error_lower_mps: float = Field(-50.0, lt=0, description="-sigma2: minimum speed difference to the train ahead [m/s], R3")
    speed_error_upper_mps: float = Field(50.0, gt=0, description="sigma1: maximum speed difference to the train ahead [m/s], R3")
    leader_error_lower_m: float = Field(-2351.0, lt=0, description="-rho2 of the train that follows the reference [m], R2")
    leader_error_upper_m: float = Field(1947.0, gt=0, description="rho1 of the train that follows the reference [m], R2")


class Constants(NamedTuple):
    """The law's constants. Lower bounds are signed (-rho2, ...)."""

    first: Ints  # (n + 1,)
    units: Floats  # (U, 5) d_p behind each unit [m], m / r [kg s], l1, l2, l3
    offset: Floats  # (n,) m, front of the head to front of the tail at rest
    distance: Floats  # (n, 4) m, -rho2, rho1, then the part between where the barrier is the printed one
    mixed: Floats  # (n, 4) m/s, -varrho2, varrho1, alike
    ell1: Floats  # (n,), and so on
    ell2: Floats
    ell3: Floats
    ell4: Floats


def constants(params: Params, scene: Scene) -> Constants:
    """Constants of the law; see ``ContinuousLaw``."""
    c, links = scene.consists, scene.links
    n = len(scene.trains)
    carriages = [spread(value, c) for value in (params.carriage_l1, params.carriage_l2, params.carriage_l3)]
    distance, mixed = np.empty((n, 4)), np.empty((n, 4))
    for i in range(n):
        rows = slice(links.first[i], links.first[i + 1])
        k = ahead(links.desired[rows])
        if k < 0:
            bounds = params.leader_error_lower_m, params.leader_error_upper_m
        else:
            bounds = links.lower[rows][k] - links.desired[rows][k], links.upper[rows][k] - links.desired[rows][k]
        distance[i] = *bounds, 0.999 * bounds[0], 0.999 * bounds[1]
        bounds = mixed_bounds(params, *bounds, i)
        mixed[i] = *bounds, *resolved(params, *bounds, scene.sub_step, i)
    return Constants(
        first=c.first, units=np.column_stack([c.length, c.mass * c.rotating / c.actuator_rate, *carriages]),
        offset=c.train_length() - c.length[c.first[1:] - 1], distance=distance, mixed=mixed,
        ell1=of_trains(params.head_l1_per_s, n), ell2=of_trains(params.head_l2, n), ell3=of_trains(params.head_l3, n),
        ell4=of_trains(params.head_l4, n),
    )  # fmt: skip


def of_train(gains: Gains, train: int) -> float:
    """The gain of one train's head."""
    return gains[train] if isinstance(gains, tuple) else gains


def mixed_bounds(params: Params, lower: float, upper: float, train: int = 0) -> tuple[float, float]:
    """Bounds (-varrho2, varrho1) of qt [m/s] for bounds (-rho2, rho1) of xt [m]: Remark 2.1; ``train`` has the gains."""
    ell1 = of_train(params.head_l1_per_s, train)
    varrho1 = params.speed_error_upper_mps + ell1 * lower
    varrho2 = -params.speed_error_lower_mps - ell1 * upper
    return -varrho2, varrho1


def resolved(params: Params, lower: float, upper: float, step: float, train: int = 0) -> tuple[float, float]:
    """Part of (lower, upper) of qt in which a Runge-Kutta step [s] still resolves the barrier, ``(d beta1/d vt)^2 h <= 2``."""
    if not (lower < 0.0 < upper and math.isfinite(lower) and math.isfinite(upper)):
        return lower, upper
    kept, ell2, ell3 = [], of_train(params.head_l2, train), of_train(params.head_l3, train)
    for bound in (lower, upper):
        inside, outside = 0.0, 0.999
        for _ in range(40):
            share = 0.5 * (inside + outside)
            slope = ell2 + ell3 * barrier(share * bound, np.array([lower, upper, lower, upper]))[1]
            inside, outside = (share, outside) if slope * slope * step <= 2.0 else (inside, share)
        kept.append(inside * bound)
    return kept[0], kept[1]


@inlined()
def ahead(desired: Floats) -> int:
    """Row of the nearest train ahead among the links of one train, -1 if it receives from none ahead."""
    best = -1
    for k in range(len(desired)):
        if desired[k] > 0.0 and (best < 0 or desired[k] < desired[best]):
            best = k
    return best


@inlined()
def barrier(e: float, bounds: Floats) -> tuple[float, float]:
    """Product phi Phi of eqs. (34), (35) at ``e`` and its derivative, for one row of ``distance`` or ``mixed`` (4,)."""
    lower, upper = bounds[0], bounds[1]
    at = min(max(e, bounds[2]), bounds[3])
    below, above = at - lower, upper - at
    log = math.log((below / -lower) / (above / upper))
    both = 1.0 / below + 1.0 / above
    slope = both * both + log * (1.0 / (above * above) - 1.0 / (below * below))
    return log * both + slope * (e - at), slope


@inlined()
def demand(
    i: int, constants: Constants, leader: Floats, age: float, slot: float, own: Floats, estimate: Floats, correction: Floats,
    desired: Floats, heard: Floats, out: Floats,
) -> None:  # fmt: skip
    """Force of every carriage [N]: eqs. (29)-(37).

    ``heard`` (k, 4) is what ``message`` wrote, relative to the leader; with ``age`` > 0 position and speed are carried on with its
    acceleration, while its jerk fades.
    """
    c = constants
    ell1, ell2, ell3, ell4 = c.ell1[i], c.ell2[i], c.ell3[i], c.ell4[i]
    k = ahead(desired)
    if k < 0:
        x, v, w, G = leader[0] + slot, leader[1], leader[2], leader[3]
    else:
        dx, dv, dw, dG = heard[k, 0], heard[k, 1], heard[k, 2], heard[k, 3]
        fade = math.exp(-age / FADE) if age > 0.0 else 1.0
        x = leader[0] - desired[k] + dx + age * (dv + age * dw / 2.0)
        v = leader[1] + dv + age * dw
        w, G = leader[2] + dw + FADE * (1.0 - fade) * dG, leader[3] + fade * dG

    xt, vt, wt = x - own[0, POSITION], v - own[0, SPEED], w - estimate[0, W]
    qt = vt + ell1 * xt
    phi_Phi, dphi_Phi = barrier(xt, c.distance[i])
    psi_Psi, dpsi_Psi = barrier(qt, c.mixed[i])
    beta1 = -phi_Phi - ell2 * qt - ell3 * psi_Psi
    beta1_v = -ell2 - ell3 * dpsi_Psi
    beta1_x = -dphi_Phi + ell1 * beta1_v
    beta2 = wt + ell1 * vt - beta1
    # (37) prints -ell4 beta2; (54) needs +
    w_rate = G + ell1 * wt + ell1 * ell1 * beta2 - beta1_x * vt - beta1_v * wt + beta1_v * beta1_v * beta2 + qt + ell4 * beta2
    first = c.first[i]
    for j in range(len(out)):
        if j > 0:  # (29)-(32); w_rate is still that of the carriage in front
            kappa = c.units[first + j, 2] + 1.0
            damping = c.units[first + j, 3] + 1.0 + kappa**2
            z1 = estimate[j, X] - estimate[j - 1, X] + c.units[first + j - 1, 0]
            z2 = estimate[j, V] - estimate[j - 1, V] + kappa * z1
            alpha2 = -z1 - damping * z2 - kappa * (estimate[j, V] - estimate[j - 1, V]) + estimate[j - 1, W]
            z3 = estimate[j, W] - alpha2
            w_rate += (
                -c.units[first + j, 4] * z3 - z2
                - (1.0 + damping * kappa) * (correction[j, X_RATE] - correction[j - 1, X_RATE])
                - (damping + kappa) * (correction[j, V_RATE] - correction[j - 1, V_RATE])
            )  # fmt: skip
        u = w_rate - (correction[j, W_DRIFT] - correction[j, UNCOMPENSATED])  # (33), (37)
        out[j] = correction[j, STATIC] + c.units[first + j, 1] * u  # (5), over r
        w_rate += correction[j, UNCOMPENSATED]  # hat w' of (13) with this u


@inlined()
def message(
    i: int, constants: Constants, leader: Floats, slot: float, own: Floats, estimate: Floats, estimate_rate: Floats, out: Floats
) -> None:
    """Send the tail's x (moved to the head), v, w_hat and w_hat' = g, all relative to the leader, shape (4,)."""
    tail = len(own) - 1
    out[0] = own[tail, POSITION] + constants.offset[i] - leader[0]
    out[1] = own[tail, SPEED] - leader[1]
    out[2] = estimate[tail, W] - leader[2]
    out[3] = estimate_rate[tail, W] - leader[3]


@inlined()
def watch(i: int, constants: Constants, leader: Floats, first: Ints, own: Floats, links: Links, out: Floats) -> None:
    """Write xt, vt, qt of train ``i`` (3,)."""
    head, rows = first[i], slice(links.first[i], links.first[i + 1])
    k = ahead(links.desired[rows])
    if k < 0:
        out[0] = leader[0] + links.slot[i] - own[head, POSITION]
        out[1] = leader[1] - own[head, SPEED]
    else:
        j = links.sender[rows][k]
        tail = first[j + 1] - 1
        out[0] = own[tail, POSITION] + constants.offset[j] - own[head, POSITION] - links.desired[rows][k]
        out[1] = own[tail, SPEED] - own[head, SPEED]
    out[2] = out[1] + constants.ell1[i] * out[0]


def watched_bounds(params: Params, scene: Scene) -> tuple[Floats, Floats]:
    """Lower and upper bounds of what ``watch`` writes, each (n, 3): R2, R3 and R3'."""
    known = constants(params, scene)
    speed = np.tile([params.speed_error_lower_mps, params.speed_error_upper_mps], (len(scene.trains), 1))
    both = np.stack([known.distance[:, :2], speed, known.mixed[:, :2]], axis=1)
    return both[:, :, 0].copy(), both[:, :, 1].copy()


def inadmissible(params: Params, spacing_error: float, speed_error: float, lower: float, upper: float, train: int = 0) -> list[str]:
    """Reasons why a train may not begin to follow another now: start condition (39). Empty: it may.

    The rule for joining: a train that comes from another track is linked as soon as this is empty for it and the train ahead
    (``spacing_error`` and ``speed_error`` as ``errors`` gives them), and for the train behind and it. Until then it keeps its slot.

    Parameters
    ----------
    params : Params
        Of the law.
    spacing_error : float
        xt: spacing front to front, taken from the tail of the train ahead, minus the desired one [m].
    speed_error : float
        vt: speed of the tail of the train ahead minus own [m/s].
    lower, upper : float
        -rho2 and rho1: minimum and maximum spacing minus the desired one [m].
    train : int
        Its place among the trains, for gains of its own.
    """
    low, high = mixed_bounds(params, lower, upper, train)
    ell1 = of_train(params.head_l1_per_s, train)
    q = speed_error + ell1 * spacing_error
    found = []
    if not lower < spacing_error < upper:
        found.append(f"distance error {spacing_error:.6g} m is not between {lower:g} and {upper:g} m")
    if not low < q < high:
        found.append(
            f"q = {speed_error:.6g} m/s + {ell1:g}/s * {spacing_error:.6g} m = {q:.6g} m/s "
            f"is not between {low:.6g} and {high:.6g} m/s"
        )
    return found


def admissible(params: Params, spacing_error: float, speed_error: float, lower: float, upper: float) -> bool:
    """Whether ``inadmissible`` finds nothing."""
    return not inadmissible(params, spacing_error, speed_error, lower, upper)


def errors(constants: Constants, scene: Scene) -> Floats:
    """Xt [m], vt [m/s], qt [m/s] of every train now, shape (n, 3)."""
    leader, out = np.empty(4), np.empty((len(scene.trains), 3))
    leader_at(scene.reference, scene.time, scene.time + 0.5 * scene.sub_step, leader)
    for i in range(len(out)):
        watch(i, constants, leader, scene.consists.first, scene.own, scene.links, out[i])
    return out


def violations(params: Params, scene: Scene) -> list[str]:
    """Every assumption and start condition that fails: (38), (39), R3', links, the reference and the integrator's step."""
    return _counts(params, scene) or [*_gains(params), *_links(params, scene), *_reference(scene), *_start(params, scene)]


def _counts(params: Params, scene: Scene) -> list[str]:
    """Lists of gains that do not fit the trains."""
    carriages = [line for key in CARRIAGE for line in miscounted(f"controller.{key}", getattr(params, key), scene.consists)]
    return carriages + [line for key in HEAD for line in miscounted_trains(f"controller.{key}", getattr(params, key), scene.trains)]


def _gains(params: Params) -> Iterator[str]:
    """Conditions (38)."""
    pairs = np.broadcast_arrays(np.atleast_1d(params.head_l2), np.atleast_1d(params.head_l3))
    for l2, l3 in dict.fromkeys(zip(*(row.tolist() for row in pairs), strict=True)):
        minimum = 2.0 + 0.5 * l2**2
        if l2 <= 2.0:
            yield f"controller.head_l2 = {l2:g}: must be above 2, condition (38)"
        if l3 <= minimum:
            yield f"controller.head_l3 = {l3:g}: must be above 2 + head_l2^2 / 2 = {minimum:g}, condition (38)"
    if (l4 := float(np.min(params.head_l4))) <= 0.5:
        yield f"controller.head_l4 = {l4:g}: must be above 1/2, condition (38)"


def _links(params: Params, scene: Scene) -> Iterator[str]:
    """Bounds of every pair and R3': 0 < ell1 < min(sigma2 / rho1, sigma1 / rho2)."""
    links = scene.links
    for i, train in enumerate(scene.trains):
        rows = slice(links.first[i], links.first[i + 1])
        if any(scene.consists.actuator_rate[u] <= 0.0 for u in range(scene.consists.first[i], scene.consists.first[i + 1])):
            yield f"actuator_rate_per_s of train {train}: must be above 0, the law acts through the actuators"
        k = ahead(links.desired[rows])
        if k < 0:
            lower, upper, pair = params.leader_error_lower_m, params.leader_error_upper_m, f"train {train} and the reference"
            if math.isnan(links.slot[i]):
                yield f"topology.desired: train {train} receives from no train ahead and needs a slot behind the reference"
        else:
            desired = float(links.desired[rows][k])
            lower, upper = float(links.lower[rows][k]) - desired, float(links.upper[rows][k]) - desired
            pair = f"trains {scene.trains[links.sender[rows][k]]} and {train}"
            if not (math.isfinite(lower) and math.isfinite(upper) and lower < 0.0 < upper):
                yield (
                    f"lower_m, upper_m of {pair} = {links.lower[rows][k]:g}, {links.upper[rows][k]:g}: "
                    f"must be finite with the desired {desired:g} m between"
                )
                continue
        most = min(-params.speed_error_lower_mps / upper, params.speed_error_upper_mps / -lower)
        if (ell1 := of_train(params.head_l1_per_s, i)) >= most:
            yield (
                f"controller.head_l1_per_s = {ell1:g}: must be below min(sigma2 / rho1, sigma1 / rho2) = {most:.4g} for {pair}, R3'"
            )


def _reference(scene: Scene) -> Iterator[str]:
    """The law needs the leader's jerk: its speed must not step."""
    sides = np.empty((2, 4))
    for t in scene.reference.breaks[1:-1]:
        leader_at(scene.reference, t, t - 1e-6, sides[0])
        leader_at(scene.reference, t, t + 1e-6, sides[1])
        step = sides[1, SPEED] - sides[0, SPEED]
        if abs(step) > 1e-6:
            yield f"reference: its speed steps by {step:g} m/s at {t:g} s; this law follows only speeds without steps"


def carriage_matrix(l1: float, l2: float, l3: float) -> Floats:
    """Matrix (3, 3) of dz/dt, z = (z1, z2, z3), of a carriage behind the head: (29)-(31) in closed loop."""
    kappa = l1 + 1.0
    return np.array([[-kappa, 1.0, 0.0], [-1.0, -(l2 + 1.0 + kappa**2), 1.0], [0.0, -1.0, -l3]])


def _start(params: Params, scene: Scene) -> Iterator[str]:
    """(39) for every train, then whether the integrator's step resolves the loop."""
    c, h = scene.consists, scene.sub_step
    known = constants(params, scene)
    rates = []
    for i, (xt, vt, qt) in enumerate(errors(known, scene)):
        for rule in inadmissible(params, float(xt), float(vt), float(known.distance[i, 0]), float(known.distance[i, 1]), i):
            yield f"train[{scene.trains[i]}] at {scene.time:g} s: {rule}, start condition (39)"
        if known.mixed[i, 0] < qt < known.mixed[i, 1]:
            slope = known.ell2[i] + known.ell3[i] * barrier(qt, known.mixed[i])[1]
            rates.append(float(known.ell1[i] ** 2 + slope * slope + known.ell4[i]))
    if rates and max(rates) * h > STABLE:
        yield f"run.sub_step_s = {h:g}: too large for this start, {max(rates):.3g} 1/s times the step must not exceed {STABLE:g}"
    behind = np.delete(known.units[:, 2:], known.first[:-1], axis=0)
    fastest = max(
        (float(np.abs(np.linalg.eigvals(carriage_matrix(*gains))).max()) for gains in np.unique(behind, axis=0)), default=0.0
    )
    if fastest * h > STABLE:
        yield (
            f"run.sub_step_s = {h:g}: too large for controller.carriage_l1, l2 and l3, whose loop has {fastest:.3g} 1/s: this "
            f"times the step must not exceed {STABLE:g} (step at most {STABLE / fastest:.3g} s)"
        )
    limited = np.isfinite(np.minimum(np.minimum(c.traction, c.traction_power), np.minimum(c.braking, c.braking_power)))
    r = float(c.actuator_rate[limited].max()) if limited.any() else 0.0
    if r * h > STABLE:
        yield (
            f"run.sub_step_s = {h:g}: too large where a force limit acts, r h = {r:g} * {h:g} = {r * h:g} must not exceed "
            f"{STABLE:g} (step at most {STABLE / r:g} s)"
        )


# Figures and comparisons


def numbered(controller: Mapping[str, Any], observer: str) -> dict[str, str]:
    """Figures of the paper that a run with these keys and this observer shows."""
    return {"unit_differences": "fig9_intermediate_estimator"} if observer == "intermediate" else FIGURES


def alternative(tables: stated.Tables) -> dict[str, Any]:
    """Tables that put this law in front of the traffic of another."""
    error = max((abs(value) for value in stated.errors_allowed(tables)), default=2351.0)
    types = {key: {"actuator_rate_per_s": 50.0, **kind} for key, kind in tables.get("train_type", {}).items()}
    # A train that follows the reference from another train's slot is far off.
    return {**_within(2.0 * error, 0.5, tables), "train_type": types}


def on_a_line(tables: stated.Tables, band: dict[str, float]) -> dict[str, Any]:
    """Tables of its row in `trainctl compare capacity`."""
    return _within(0.5 * tables["topology"]["spacing_m"], 0.4, tables)


def in_stops(tables: stated.Tables, band: dict[str, float], braking: tuple[float, float]) -> dict[str, Any]:
    """Tables of its row in `trainctl compare spacing`: steps twice as long, which changes gaps by millimetres there."""
    made = on_a_line(tables, band)
    return {**made, "run": {**made["run"], "sub_step_s": 0.02}}


def _within(far: float, share: float, tables: stated.Tables) -> dict[str, Any]:
    """Tables of a law that bounds the errors at ``far`` [m], with a ``share`` of the gain that R3' allows for these, or less."""
    own = {"leader_error_lower_m": -far, "leader_error_upper_m": far, "head_l1_per_s": min(0.01, share * 50.0 / far)}
    return {
        "controller": {**tables["controller"], **own}, "plant": {"kind": "actuated_units"}, "observer": {"kind": "asymptotic"},
        "run": {**tables["run"], "sub_step_s": 0.01},
    }  # fmt: skip
