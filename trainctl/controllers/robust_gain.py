"""The unsaturated loop of robust_constrained, eq. (9): its l1 gain, its worst disturbance and its steady state.

None of this is in the paper; it is what can be proved of the final error where Theorem 1 cannot (``robust_theory``).

Symbols
-------
phat, vbar   position and speed error of a train in the moving formation [m], [m/s]
L, a_ij      Laplacian and weights [1/s2]
h, T         feedback gain [1/s], step [s]
w1, w2, w3   disturbances of position [m], speed [m/s] and input [m/s2] in one step
s, pi        common drift of the formation per step [m]; left null vector of L, sum 1
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csgraph

from trainctl.davis import resistance
from trainctl.signals import Floats, Ints, Links, Scene, leader_at

#: Largest formation with a bound for every pair; beyond, only linked pairs and the ends have one.
ALL_PAIRS = 12

#: Largest formation with an l1 bound. On a line the work grows with n^5: slowest time constant n^2, one step n^3.
BOUNDED = 24

#: Largest formation with any dense matrix.
DENSE = 200

#: The tail of an l1 sum that is bounded instead of summed, relative.
TAIL = 1e-6

#: Rows of an amplitude array of shape (5, n), those of ``plants.disturbance``; RESISTANCE is a relative error.
W1, W2, W3, RESISTANCE, MEASUREMENT = range(5)


def laplacian(n: int, links: Links) -> Floats:
    """L of the weighted directed graph, shape (n, n) [1/s2]: train i receives from j with weight -L[i, j]."""
    out = np.zeros((n, n))
    np.add.at(out, (links.receiver, links.sender), -links.weight)
    np.add.at(out, (links.receiver, links.receiver), links.weight)
    return out


def heads(scene: Scene) -> Floats:
    """State of the first unit of every train, shape (n, 2 or 3)."""
    return scene.own[scene.consists.first[:-1]]


def train_resistance(scene: Scene, speed: Floats) -> Floats:
    """Resistance of every train at these speeds, the mean of its units weighted by mass [m/s2], shape (n,)."""
    return resistance(speed, scene.consists.train_davis())


def greatest_resistance(scene: Scene) -> Floats:
    """Resistance at the maximum admissible speed [m/s2], shape (n,); inf without one."""
    upper = scene.bounds.speed_upper
    return np.where(np.isfinite(upper), train_resistance(scene, np.where(np.isfinite(upper), upper, 0.0)), np.inf)


def reference_speed(scene: Scene) -> float:
    """v0 at the time of the scene [m/s]."""
    leader = np.zeros(4)
    leader_at(scene.reference, scene.time, scene.time, leader)
    return float(leader[1])


def graph(n: int, links: Links) -> coo_array:
    """Who receives from whom as a sparse matrix, sender to receiver."""
    return coo_array((np.ones(len(links.sender)), (links.sender, links.receiver)), shape=(n, n))


def formations(scene: Scene) -> list[Ints]:
    """Trains that links join in any direction, formation by formation: a train alone on its track is one of its own."""
    count, part = csgraph.connected_components(graph(len(scene.trains), scene.links), connection="weak")
    return [np.flatnonzero(part == k).astype(np.int64) for k in range(count)]


def potentials(n: int, links: Links) -> Floats:
    """Slots d_i that the desired spacings give along a tree of links, 0 for the first train of every part [m], shape (n,)."""
    wanted = {(int(s), int(r)): float(d) for s, r, d in zip(links.sender, links.receiver, links.desired, strict=True)}
    wanted |= {(r, s): -d for (s, r), d in wanted.items() if (r, s) not in wanted}
    out, seen = np.zeros(n), np.zeros(n, bool)
    sparse = graph(n, links).tocsr()
    for root in range(n):
        if seen[root]:
            continue
        order, before = csgraph.breadth_first_order(sparse, root, directed=False)
        for i in order[1:]:
            out[i] = out[before[i]] + wanted[int(i), int(before[i])]
        seen[order] = True
    return out


def pair_rows(n: int, links: Links) -> list[tuple[int, int]]:
    """Pairs whose error is bounded: all of them, in a long formation the linked ones and the ends."""
    if n <= ALL_PAIRS:
        return [(i, j) for i in range(n) for j in range(i + 1, n)]
    linked = {(min(s, r), max(s, r)) for s, r in zip(links.sender.tolist(), links.receiver.tolist(), strict=True)}
    return sorted(linked | {(0, n - 1)})


class Loop(NamedTuple):
    """The unsaturated loop (9) over one simulator step, with the acceleration held over ``held`` steps.

    State, shape (3n - 1): phat_i - phat_1 for all but the first train, vbar, held acceleration. The common position is left out:
    it is the one mode that disturbances carry away for ever.
    """

    n: int
    held: int  # steps per control period
    step: float  # T of the plant [s]
    law: Floats  # a step at whose start the law is evaluated
    hold: Floats  # any other step
    kick: Floats  # (3n - 1, 3n) of w1, w2, w3 in any step
    noise: Floats  # (3n - 1, n) of the measured positions, in a step of the law
    output: Floats  # (n, 3n - 1) u_c at a control instant
    laplacian: Floats


def loop(h: Floats, scene: Scene) -> Loop:
    """Matrices of the unsaturated loop of this scene.

    Parameters
    ----------
    h : ndarray, shape (n,)
        Feedback gains [1/s].
    scene : Scene
        Links, steps and the lead of its plant.

    Notes
    -----
    The position moves with ``v + theta (v+ - v)`` over one step, theta = 0 in the paper, 1/2 for plants that integrate exactly.
    """
    n, step = len(scene.trains), scene.step
    held = round(scene.control_period / step)
    theta = held * scene.lead - (held - 1) / 2.0
    big, eye = laplacian(n, scene.links), np.eye(n)
    difference = np.hstack((-np.ones((n - 1, 1)), np.eye(n - 1)))
    lift = np.vstack((np.zeros((1, n - 1)), np.eye(n - 1)))
    zero = np.zeros((n, n - 1))
    hold = np.block([
        [np.eye(n - 1), step * difference, theta * step**2 * difference],
        [zero, eye, step * eye],
        [zero, 0.0 * eye, eye],
    ])  # fmt: skip
    output = np.hstack((-big @ lift, -np.diag(h), 0.0 * eye))
    law = hold @ np.vstack((np.eye(2 * n - 1, 3 * n - 1), output))
    w1 = np.vstack((difference, 0.0 * eye, 0.0 * eye))
    w2 = np.vstack((theta * step * difference, eye, 0.0 * eye))
    noise = hold[:, 2 * n - 1 :] @ -big
    return Loop(n, held, step, law, hold, np.hstack((w1, w2, step * w2)), noise, output, big)


def radius(loop: Loop) -> float:
    """Spectral radius of one control period, the common position left out."""
    period = np.linalg.matrix_power(loop.hold, loop.held - 1) @ loop.law
    return float(np.abs(np.linalg.eigvals(period)).max())


def _responses(loop: Loop, steps: int) -> tuple[Floats, Floats]:
    """Responses of the state at the end of ``steps`` steps to each disturbance in them, last step first, and the state transition.

    The first of the steps is one of the law, no other is. Shapes (3n - 1, 4n steps) and (3n - 1, 3n - 1).
    """
    n, parts, power = loop.n, [], np.eye(len(loop.law))
    for k in range(steps):
        first = k == steps - 1
        parts.append(np.hstack((power @ loop.kick, power @ loop.noise if first else np.zeros((len(power), n)))))
        power = power @ (loop.law if first else loop.hold)
    return np.hstack(parts), power


def l1_gain(loop: Loop, rows: Floats, amplitude: Floats) -> tuple[Floats, Floats]:
    """Maximum value of ``rows @ state`` that disturbances within their amplitudes can ever cause, from the formation.

    Parameters
    ----------
    loop : Loop
        With spectral radius below 1.
    rows : ndarray, shape (P, 3n - 1)
        Outputs.
    amplitude : ndarray, shape (4, n)
        Maximum magnitude of w1 [m], w2 [m/s], w3 [m/s2] and of the measurement [m] in any step, any signal.

    Returns
    -------
    bound : ndarray, shape (P,)
        ``sum over the past of |rows A^k B| amplitude``; an upper bound, attained by ``worst_signs``.
    tail : ndarray, shape (P,)
        The part of it that stands for the remote past, bounded instead of summed.

    Notes
    -----
    The tail is rigorous: over a block of periods that halves every row in the 1-norm, it shrinks at least by that factor.
    """
    one_period, period = _responses(loop, loop.held)
    periods, shrink = 1, period
    while np.abs(shrink).sum(axis=1).max() > 0.5:
        periods, shrink = 2 * periods, shrink @ shrink
    factor = float(np.abs(shrink).sum(axis=1).max())
    together = min(periods, 64)
    responses = np.hstack([np.linalg.matrix_power(period, k) @ one_period for k in range(together)])
    jump = np.linalg.matrix_power(period, together)
    weights = np.tile(amplitude.reshape(-1), loop.held * together)
    per_norm = float((np.abs(responses) @ weights).max())
    best, left = np.zeros(len(rows)), np.zeros(len(rows))
    for phase in range(loop.held):  # of the instant of the maximum value within the control period
        total, row = np.zeros(len(rows)), rows
        if phase:
            first, transition = _responses(loop, phase)
            total, row = np.abs(row @ first) @ np.tile(amplitude.reshape(-1), phase), row @ transition
        tail, going = np.full(len(rows), np.inf), np.arange(len(rows))
        while len(going):
            norms = np.zeros(len(going))
            for _ in range(periods // together):
                norms += np.abs(row).sum(axis=1)
                total[going] += np.abs(row @ responses) @ weights
                row = row @ jump
            tail[going] = per_norm * norms * factor / (1.0 - factor)
            open_ = tail[going] > TAIL * total[going]
            going, row = going[open_], row[open_]
        grows = total + tail > best
        best, left = np.where(grows, total + tail, best), np.where(grows, tail, left)
    return best, left


def pair_row(n: int, plus: int, minus: int) -> Floats:
    """Output phat_plus - phat_minus of ``Loop``'s state, shape (3n - 1,)."""
    row = np.zeros(3 * n - 1)
    for i, sign in ((plus, 1.0), (minus, -1.0)):
        if i > 0:
            row[i - 1] += sign
    return row


def worst_signs(loop: Loop, plus: int, minus: int, steps: int) -> Floats:
    """Disturbance that drives phat_plus - phat_minus highest at the end of ``steps`` steps, in units of the amplitudes.

    Parameters
    ----------
    loop : Loop
        The loop.
    plus, minus : int
        The pair of trains.
    steps : int
        Simulator steps from the start; several of the loop's slowest time constants come close to the l1 bound.

    Returns
    -------
    ndarray, shape (5, steps, n)
        Signs of the impulse response, reversed in time; w1, w2, w3, resistance error, measurement. Between two control instants the
        measurement has no effect and keeps its sign.
    """
    n, row = loop.n, pair_row(loop.n, plus, minus)
    out = np.zeros((5, steps, n))
    for k in range(steps - 1, -1, -1):
        law = k % loop.held == 0
        out[[W1, W2, W3], k] = np.sign(row @ loop.kick).reshape(3, n)
        if law:
            out[MEASUREMENT, k : k + loop.held] = np.sign(row @ loop.noise)
        row = row @ (loop.law if law else loop.hold)
    out[RESISTANCE] = -out[W3]
    return out


@dataclass(frozen=True)
class Gain:
    """The l1 bound: no bounded disturbance within the amplitudes does worse, as long as no clamp acts."""

    pairs: list[tuple[str, str]]
    error_m: list[float]  # |p_i - p_j - d_ij| of every pair
    worst_pair: tuple[str, str]
    worst_m: float
    tail_m: float  # the part of worst_m that is bounded instead of summed
    speed_mps: float  # maximum |v_i - v0|
    speed_room_mps: float
    input_mps2: float  # maximum |u_c + w3|
    input_room_mps2: float
    unsaturated: bool  # started from the formation, no clamp can ever act: the bound is unconditional

    def lines(self) -> list[str]:
        """Text for the terminal."""
        shown = ", ".join(f"{a}-{b} {e:.1f}" for (a, b), e in zip(self.pairs[:15], self.error_m, strict=False))
        state = "never saturates" if self.unsaturated else "may saturate: then the bound is not proved"
        return [
            f"l1 bound of the unsaturated loop, any signal within the amplitudes: {self.worst_m:.1f} m "
            f"(trains {self.worst_pair[0]} and {self.worst_pair[1]})",
            f"  per pair [m]: {shown}" + (" ..." if len(self.pairs) > 15 else ""),
            f"  from the formation the loop {state}: speed error up to {self.speed_mps:.2f} of {self.speed_room_mps:.2f} m/s, "
            f"input up to {self.input_mps2:.2f} of {self.input_room_mps2:.2f} m/s2",
        ]


@dataclass(frozen=True)
class Steady:
    """Exact state in the long run under constant disturbances, no clamp acting: L phat = -h (s - w1)/T + w2/T + w3."""

    drift_m: float  # s, per step, beyond v0 T
    speed_mps: list[float]  # of the state
    moves_mps: float  # of the positions, w1 / T more: what SUMO's logs show as speed
    pairs: list[tuple[str, str]]
    error_m: list[float]  # p_i - p_j - d_ij
    input_mps2: list[float]  # u_c + w3
    unsaturated: bool

    def lines(self) -> list[str]:
        """Text for the terminal."""
        shown = ", ".join(f"{a}-{b} {e:+.4f}" for (a, b), e in zip(self.pairs[:15], self.error_m, strict=False))
        low, high = min(self.speed_mps), max(self.speed_mps)
        speed = f"{low:.4f}" if high - low < 5e-5 else f"{low:.4f} to {high:.4f}"
        return [
            f"steady state under the constant disturbances: speed {speed} m/s; they move {self.moves_mps:.4f} m/s, w1 / T more,"
            " which SUMO logs as speed",
            f"  errors p_i - p_j - d_ij [m]: {shown}" + (" ..." if len(self.pairs) > 15 else ""),
            *([] if self.unsaturated else ["  a clamp would act there: this state is not reached"]),
        ]


def gain(h: Floats, scene: Scene, amplitude: Floats) -> Gain:
    """l1 bound of every pair's error, and whether the loop can saturate at all when it starts from the formation.

    Parameters
    ----------
    h : ndarray, shape (n,)
        Feedback gains [1/s].
    scene : Scene
        Graph, clamps, steps; the start does not matter.
    amplitude : ndarray, shape (5, n)
        As of ``report``. The resistance error counts as a w3 of that share of the maximum resistance.
    """
    n = len(scene.trains)
    closed = loop(h, scene)
    pairs = pair_rows(n, scene.links)
    speeds = np.eye(n, 3 * n - 1, n - 1)
    extra = amplitude[RESISTANCE] * greatest_resistance(scene)
    acting = np.stack((amplitude[W1], amplitude[W2], amplitude[W3] + extra, amplitude[MEASUREMENT]))
    rows = np.vstack(([pair_row(n, i, j) for i, j in pairs], speeds, closed.output))
    bound, tail = l1_gain(closed, rows, acting)
    error, speed, asked = np.split(bound, [len(pairs), len(pairs) + n])
    asked = asked + amplitude[W3] + np.abs(closed.laplacian) @ amplitude[MEASUREMENT]
    v0 = reference_speed(scene)
    speed_room = np.minimum(v0 - scene.bounds.speed_lower, scene.bounds.speed_upper - v0)
    input_room = _input_room(scene)
    fast, hard = int(np.argmax(speed - speed_room)), int(np.argmax(asked - input_room))
    worst = int(np.argmax(error))
    named = [(scene.trains[i], scene.trains[j]) for i, j in pairs]
    return Gain(
        pairs=named, error_m=error.tolist(), worst_pair=named[worst], worst_m=float(error[worst]), tail_m=float(tail[worst]),
        speed_mps=float(speed[fast]), speed_room_mps=float(speed_room[fast]),
        input_mps2=float(asked[hard]), input_room_mps2=float(input_room[hard]),
        unsaturated=bool(np.all(speed <= speed_room) and np.all(asked <= input_room)),
    )  # fmt: skip


def _input_room(scene: Scene) -> Floats:
    """b2lo: what is left of the input at the worst admissible speed [m/s2], shape (n,)."""
    r_min, r_max = train_resistance(scene, scene.bounds.speed_lower), greatest_resistance(scene)
    room: Floats = np.minimum(scene.bounds.input_upper - r_max, r_min - scene.bounds.input_lower)
    return room


def steady_state(h: Floats, scene: Scene, constant: Floats) -> Steady:
    """Exact long-run state under constant disturbances: L phat = -h (s - w1)/T + w2/T + w3, phat drifting by s per step.

    Parameters
    ----------
    h : ndarray, shape (n,)
        Feedback gains [1/s].
    scene : Scene
        Graph, step and clamps; the start does not matter.
    constant : ndarray, shape (5, n)
        w1 [m], w2 [m/s], w3 [m/s2], relative error of the resistance, measured minus true position [m].

    Notes
    -----
    s = pi^T (h w1 + w2 + w3 T) / pi^T h; with one h that is pi^T (w1 + (w2 + w3 T)/h). T is the plant's step, not the control
    period: in the steady state the speed does not move within a period. The resistance error acts at the steady speed, which it
    shifts.
    """
    n, T, v0 = len(scene.trains), scene.step, reference_speed(scene)
    w1, w2, w3, share, measured = constant
    big = laplacian(n, scene.links)
    pi = np.linalg.lstsq(np.vstack((big.T, np.ones(n))), np.append(np.zeros(n), 1.0), rcond=None)[0]
    s, acting = 0.0, w3
    for _ in range(60):  # a contraction: the resistance changes by far less than h per m/s
        s = float(pi @ (h * w1 + w2 + acting * T) / (pi @ h))
        acting = w3 - share * train_resistance(scene, v0 + (s - w1) / T)
    vbar = (s - w1) / T
    wanted = -h * vbar + w2 / T + acting - big @ measured
    p = np.linalg.lstsq(np.vstack((big, np.eye(1, n))), np.append(wanted, 0.0), rcond=None)[0]
    asked = -(w2 / T + acting) + w3
    r = train_resistance(scene, v0 + vbar)
    inside = (asked + r >= scene.bounds.input_lower) & (asked + r <= scene.bounds.input_upper)
    inside &= (v0 + vbar >= scene.bounds.speed_lower) & (v0 + vbar <= scene.bounds.speed_upper)
    pairs = pair_rows(n, scene.links)
    return Steady(
        drift_m=s, speed_mps=(v0 + vbar).tolist(), moves_mps=v0 + s / T,
        pairs=[(scene.trains[i], scene.trains[j]) for i, j in pairs],
        error_m=[float(p[i] - p[j]) for i, j in pairs], input_mps2=asked.tolist(), unsaturated=bool(inside.all()),
    )  # fmt: skip
