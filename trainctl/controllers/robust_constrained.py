"""Robust constrained cooperative control under disturbances: Hu, Fan, Wei, Mathematics 2024, 12(13), 2003, eq. (6).

Sampled, train level, directed weighted graphs. The clamps and the disturbances of eq. (4) are the plant's (``plants.point``).
What can be said of the final error is in ``robust_theory`` (the paper's Theorem 1) and ``robust_gain`` (what holds instead).

Symbols
-------
p, v     position [m], speed [m/s]
v0       reference speed [m/s], known to all trains
h        feedback gain of the speed [1/s]
a_ij     weight with which train i receives from train j [1/s2]
d_ij     desired p_i - p_j [m]; a link carries the desired p_sender - p_receiver, which is -d_ij
T        control period [s]
u_c      demanded acceleration [m/s2]; the input is u_c plus the running resistance u_r, which the plant adds
theta_1  maximum speed [m/s]; theta_2 minimum and maximum input [m/s2]
kappa    how often the running resistance goes into the input, at least

Notes
-----
Departs from the paper:

* Every message is the position minus the reference's, so one that is one period old does not lag behind by v0 T per neighbour.
  Where all messages are fresh this is eq. (6).
* A lost message (the paper knows none): the last one is kept. In this frame that takes the silent neighbour to run on at v0, so
  the loop becomes one with a delay. Leaving the term out instead makes the loop weaker: in the paper's example with 70 % of the
  messages lost the maximum error of the ends is 15 m with the first rule (12.5 m without losses) and 45 m with the second. A
  neighbour that falls silent for good is safe with neither: see ``links.parquet`` for what was heard. A train that has never
  heard one of its neighbours does not accelerate.
* There is no spacing constraint: see ``warnings``.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

import numpy as np
from pydantic import Field
from scipy.sparse import csgraph

from trainctl.contracts import SampledLaw
from trainctl.controllers import robust_gain, robust_theory, stated
from trainctl.errors import InputError
from trainctl.signals import POSITION, SPEED, Bools, Demand, Floats, Links, Scene, Table, Trains, restrict

if TYPE_CHECKING:
    from trainctl.controllers import robust_constrained

    module: SampledLaw = robust_constrained

CLOCK: Literal["sampled"] = "sampled"

#: The model clamps speed and input, so a point plant must have the scenario's bounds as its clamps.
CLAMPED = True

#: Figures -> their numbers in the paper.
FIGURES = {"positions": "fig2", "speeds_and_inputs": "fig3", "spacing": "fig4", "spacing_errors": "fig5"}

#: Rows of a comparison -> the keys of [controller] that make them.
COMPARED: dict[str, dict[str, Any]] = {"robust_constrained": {"h_per_s": 0.3}}

#: What a train is told in `trainctl compare spacing`, and why its spacing is what it is there.
IN_STOPS = (
    "neighbours say where they are. The reference runs on at its speed; all trains behind push, and only metres "
    "times weight hold them"
)

#: Assumption 1: the input must exceed this many times the running resistance.
KAPPA = 10.0

#: Inconsistent desired spacings below this are rounding [m].
SPACING_ROUNDING = 1e-6

#: So many examples of one mistake are named.
MOST = 8


class Params(Table):
    """Keys of ``[controller]`` with ``law = "robust_constrained"``; the weights a_ij are those of the links."""

    h_per_s: float | tuple[float, ...] = Field(
        description="Feedback gain h_i of the speed error [1/s], one number or one per train; eq. (6), Assumption 2: 0 < h T < 1"
    )


class Constants(NamedTuple):
    """Constants of the law."""

    h: Floats  # (n,) 1/s


def gains(params: Params, trains: int) -> Floats:
    """Feedback gain of every train [1/s], shape (n,)."""
    return np.broadcast_to(np.asarray(params.h_per_s, float), trains).copy()


def constants(params: Params, scene: Scene) -> Constants:
    """Return the law's constants."""
    return Constants(h=gains(params, len(scene.trains)))


def message(constants: Constants, own: Trains, leader: Floats) -> Floats:
    """Every train sends its position relative to the reference [m] and a 1 that tells a message from silence, shape (n, 2)."""
    return np.column_stack((own.position - leader[0], np.ones_like(own.position)))


def demand(constants: Constants, own: Trains, leader: Floats, links: Links, heard: Floats) -> Demand:
    """Acceleration asked for, eq. (6) without the resistance term u_r.

    Parameters
    ----------
    constants : Constants
        h.
    own : Trains
        Positions [m] and speeds [m/s], as measured.
    leader : ndarray, shape (4,)
        Position [m] and speed v0 [m/s] of the reference, and derivatives.
    links : Links
        ``desired`` is p_sender - p_receiver [m], ``weight`` a_ij [1/s2].
    heard : ndarray, shape (L, 2)
        The last message of each link, see ``message``; zeros where none has come yet.

    Returns
    -------
    Demand
        u_c [m/s2], shape (n,). The law has no saturation of its own.
    """
    n, i = len(own.speed), links.receiver
    said = heard[:, 1] > 0.0
    error = np.where(said, heard[:, 0] - (own.position - leader[0])[i] - links.desired, 0.0)  # p_j - p_i + d_ij
    u_c = -constants.h * (own.speed - leader[1]) + np.bincount(i, links.weight * error, minlength=n)
    waits = np.bincount(i[~said], minlength=n) > 0
    return Demand(acceleration=np.where(waits, np.minimum(u_c, 0.0), u_c), saturated=np.zeros(n, bool))


def violations(params: Params, scene: Scene) -> list[str]:
    """Every requirement of the law that the scene breaks, as ``key = value: rule``.

    Notes
    -----
    Assumption 1, and Assumption 2 beyond 0 < h T < 1, are not required: no EMU has ten times the force its resistance takes, and
    the paper's own example breaks the second and runs all the same. ``warnings`` and ``analysis`` say so.
    """
    n = len(scene.trains)
    loop_faults = _gain_violations(params, scene) + _graph_violations(scene)
    found = loop_faults + _clamp_violations(scene)
    for members in robust_gain.formations(scene) if not loop_faults else []:
        if 1 < len(members) <= robust_gain.DENSE:
            found += _unstable(gains(params, n)[members], restrict(scene, members))
    return found


def _unstable(h: Floats, scene: Scene) -> list[str]:
    radius = robust_gain.radius(robust_gain.loop(h, scene))
    if radius < 1.0:
        return []
    strongest = robust_gain.laplacian(len(h), scene.links).diagonal().max()
    return [
        f"topology.weight = {scene.links.weight.max():g}: unstable with h = {h.max():g} and T = {scene.control_period:g} s"
        f" (spectral radius {radius:.4f}); the weights of what one train receives add up to {strongest:g}, Assumption 2 needs less"
        f" than h^2/4 = {h.min() ** 2 / 4:.3g}"
    ]


def _gain_violations(params: Params, scene: Scene) -> list[str]:
    n, period = len(scene.trains), scene.control_period
    if isinstance(params.h_per_s, tuple) and len(params.h_per_s) != n:
        return [f"controller.h_per_s = {list(params.h_per_s)}: has {len(params.h_per_s)} values for {n} trains"]
    found = []
    given = params.h_per_s if isinstance(params.h_per_s, tuple) else (params.h_per_s,)
    for k, h in enumerate(given):
        key = f"controller.h_per_s[{k + 1}]" if isinstance(params.h_per_s, tuple) else "controller.h_per_s"
        if h <= 0.0:
            found.append(f"{key} = {h:g}: must be above 0")
        elif h * period >= 1.0:
            found.append(f"{key} = {h:g}: h T = {h * period:g} with T = {period:g} s; Assumption 2 needs 0 < h T < 1")
    return found


def _graph_violations(scene: Scene) -> list[str]:
    links, ids = scene.links, scene.trains
    found = [
        f"link[{ids[s]} > {ids[r]}].weight = {w:g}: must be above 0"
        for s, r, w in zip(links.sender, links.receiver, links.weight, strict=True)
        if not w > 0.0
    ]
    found += _not_connected(scene)
    slot = robust_gain.potentials(len(ids), links)
    error = links.desired - (slot[links.sender] - slot[links.receiver])
    for k in np.flatnonzero(np.abs(error) > SPACING_ROUNDING)[:MOST]:
        s, r = links.sender[k], links.receiver[k]
        found.append(
            f"link[{ids[s]} > {ids[r]}].desired_m = {links.desired[k]:g}: contradicts the other links, along which train {ids[s]} "
            f"is {slot[s] - slot[r]:g} m from train {ids[r]}; d_ij = d_i - d_j must hold around every cycle"
        )
    return found


def _not_connected(scene: Scene) -> list[str]:
    """Who of one formation cannot reach whom, one example per strongly connected part."""
    ids, heard = scene.trains, robust_gain.graph(len(scene.trains), scene.links).tocsr()
    cut: list[str] = []
    _, part = csgraph.connected_components(heard, connection="strong")
    for members in robust_gain.formations(scene):
        parts, one_each = np.unique(part[members], return_index=True)
        for i in members[one_each].tolist() if len(parts) > 1 else []:
            missed = np.setdiff1d(members, csgraph.breadth_first_order(heard, i, return_predecessors=False))
            if len(missed) and len(cut) <= MOST:
                lost = _some([f"train {ids[m]}" for m in missed.tolist()], ", ")
                cut.append(f"what train {ids[i]} sends does not reach {lost}")
    return [f"link: the graph must be strongly connected (Theorem 1): {_some(cut)}"] if cut else []


def _clamp_violations(scene: Scene) -> list[str]:
    bounds, speeds = scene.bounds, _speeds(scene)
    speed = robust_gain.heads(scene)[:, SPEED]
    slowest, fastest = np.min(speeds), np.max(speeds)
    found = []
    for field, row in bounds._asdict().items():
        key = f"bounds.{field}_{'mps2' if field.startswith('input') else 'mps'}"
        found += _violated(scene, f"{key} =", row, ~np.isfinite(row), "must be given, the model (4) clamps every speed and input")
        if field.endswith("upper"):
            found += _violated(scene, f"{key} =", row, row <= 0.0, "must be above 0")
    low, high = bounds.speed_lower, bounds.speed_upper
    found += _violated(scene, f"reference.speed_mps = {fastest:g}: must be below the maximum speed", high, fastest >= high, "m/s")
    found += _violated(scene, f"reference.speed_mps = {slowest:g}: must be above the minimum speed", low, slowest <= low, "m/s")
    found += _violated(scene, "bounds.speed_lower_mps =", low, np.isfinite(low) & (low < 0.0), "must not be negative")
    found += _violated(scene, "bounds.input_lower_mps2 =", bounds.input_lower, bounds.input_lower >= 0.0, "must be below 0")
    found += _violated(scene, "train.speed_mps =", speed, (speed < low) | (speed > high), "outside the admissible speeds")
    return found


def _violated(scene: Scene, key: str, value: Floats, violated: Bools, rule: str) -> list[str]:
    """One line per different value for all trains it concerns."""
    lines = []
    for v in np.unique(value[violated]):
        who = [scene.trains[i] for i in np.flatnonzero(violated & (value == v)).tolist()]
        names = "all trains" if len(who) == len(scene.trains) else f"train {_some(who, ', ')}"
        between = ": " if key.endswith("=") else " "
        lines.append(f"{key} {v:g}{between}{rule} ({names})")
    return lines


def _assumption_1(scene: Scene) -> list[str]:
    """Trains whose input is not ten times their resistance: the theorem then says nothing of them."""
    found: list[str] = []
    r = robust_gain.greatest_resistance(scene)
    for field, value in (("input_upper", scene.bounds.input_upper), ("input_lower", -scene.bounds.input_lower)):
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = value / r
        short = np.isfinite(ratio) & (value > 0.0) & (ratio <= KAPPA)
        rule = f"times the running resistance is all the input allows, Assumption 1 needs more than {KAPPA:g}"
        found += _violated(scene, f"bounds.{field}_mps2:", np.round(ratio, 2), short, rule)
    return found


def warnings(params: Params, scene: Scene, tracks: Sequence[int] | None = None) -> list[str]:
    """List what the law allows but the user should know, as ``key: warning``.

    Parameters
    ----------
    params : Params
        As of the law.
    scene : Scene
        The start, or the state after a change of topology.
    tracks : sequence of int, optional
        Track of each train; one track for all if left out.
    """
    found = []
    position = scene.own[scene.consists.first[:-1], POSITION]
    track = np.zeros(len(position), int) if tracks is None else np.asarray(tracks)
    hears = set(zip(scene.links.receiver.tolist(), scene.links.sender.tolist(), strict=True))
    order = np.lexsort((-position, track))
    deaf = [
        f"{scene.trains[b]} does not receive from {scene.trains[a]}"
        for a, b in pairwise(order.tolist())
        if track[a] == track[b] and (b, a) not in hears
    ]
    if deaf:
        found.append(
            f"link: the law has no spacing constraint and not every follower receives from its predecessor: {_some(deaf)}; "
            "such graphs can end in a collision from starts that braking would save"
        )
    found += _assumption_1(scene)
    speeds = _speeds(scene)
    if np.ptp(speeds) > 0.0:
        found.append(f"reference: its speed changes ({np.min(speeds):g} to {np.max(speeds):g} m/s); the paper's v0 is constant")
    return found


class Disturbing(Protocol):
    """What the analysis asks of an entry of the scenario's disturbances; see ``plants.disturbance``."""

    def maximum(self, trains: Sequence[str]) -> Floats:
        """Maximum magnitude on each channel of each train, shape (5, n)."""

    def steady(self, trains: Sequence[str]) -> Floats | None:
        """Value on each channel of each train, shape (5, n), if it never changes."""


def analysis(params: Params, scene: Scene, disturbances: Sequence[Disturbing]) -> robust_theory.Report:
    """Theorem 1, l1 bound and, under constant disturbances, the steady state: of the largest formation of the scene."""
    n, parts = len(scene.trains), robust_gain.formations(scene)
    members = max(parts, key=len)
    amplitude, constant = np.zeros((5, n)), np.zeros((5, n))
    changing = False
    for entry in disturbances:
        amplitude = amplitude + entry.maximum(scene.trains)
        value = entry.steady(scene.trains)
        changing |= value is None
        constant = constant + (0.0 if value is None else value)
    alone = restrict(scene, members)
    found = robust_theory.report(
        gains(params, n)[members], alone, amplitude[:, members], None if changing else constant[:, members]
    )
    if len(parts) > 1:
        found.notes.append(f"{len(parts)} separate formations: the report is of trains {_some(alone.trains, ', ')}")
    return found


def report(params: Params, scene: Scene, disturbances: Sequence[Disturbing]) -> list[str]:
    """Lines of ``analysis`` for the terminal."""
    return analysis(params, scene, disturbances).lines()


def worst(params: Params, scene: Scene, plus: int, minus: int, steps: int) -> Floats:
    """Signs (5, steps, n) of the disturbance that drives the error of trains ``plus`` and ``minus`` highest after ``steps`` steps.

    See ``robust_gain.worst_signs``; both trains must be of one formation, the trains of others are left alone.
    """
    members = next(m for m in robust_gain.formations(scene) if plus in m)
    if minus not in members:
        raise InputError(f"disturbance.pair = {[scene.trains[plus], scene.trains[minus]]}: the two are not in one formation")
    closed = robust_gain.loop(gains(params, len(scene.trains))[members], restrict(scene, members))
    place = {i: k for k, i in enumerate(members.tolist())}
    out = np.zeros((5, steps, len(scene.trains)))
    out[:, :, members] = robust_gain.worst_signs(closed, place[plus], place[minus], steps)
    return out


def _speeds(scene: Scene) -> Floats:
    """Speeds of the reference at the ends of its pieces [m/s]."""
    breaks, position = scene.reference.breaks, scene.reference.position
    found = []
    for k, piece in enumerate(position):
        length = breaks[k + 1] - breaks[k]
        rate = np.polynomial.polynomial.polyder(piece)
        found += [np.polynomial.polynomial.polyval(s, rate) for s in (0.0, length if np.isfinite(length) else 0.0)]
    return np.array(found)


def _some(words: Sequence[str], between: str = "; ") -> str:
    return between.join(words[:MOST]) + (f"{between}and {len(words) - MOST} more" if len(words) > MOST else "")


# In comparisons


def alternative(tables: stated.Tables) -> dict[str, Any]:
    """Tables that put this law in front of the traffic of another."""
    run = {**tables["run"], "control_period_s": stated.periods(tables["run"], 1.0)}
    return {"run": run, "topology": {**tables["topology"], "weight": 0.01}}


def on_a_line(tables: stated.Tables, band: dict[str, float]) -> dict[str, Any]:
    """Tables of its row in `trainctl compare capacity`."""
    return {**alternative(tables), "bounds": band}
