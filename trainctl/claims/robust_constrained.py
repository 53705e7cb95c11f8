"""Hu, Fan and Wei, robust constrained control: the example of section 4 in closed loop, and its claims.

Many cases at once are one scene of many formations without a link between them: a step of all is one evaluation of law and plant.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from trainctl.claims.claim import Claim, claim, span
from trainctl.controllers import robust_constrained as law
from trainctl.controllers import robust_gain, robust_theory
from trainctl.plants import disturbance, point
from trainctl.scenario.reference import constant
from trainctl.signals import POSITION, SPEED, Bounds, Consists, Disturbed, Floats, Links, Scene, Trains

T, V0, SPACING, N = 0.8, 80.0, 8000.0, 4
START = np.array([27000.0, 18500.0, 7500.0, 0.0])
FORMATION = 27000.0 - SPACING * np.arange(N)
DAVIS = (1.176e-2, 7.7616e-4, 1.6e-5)
PARAMS = law.Params(h_per_s=0.3)
H = np.full(N, 0.3)

Edges = Sequence[tuple[int, int]]  # (sender, receiver)


def both(edges: Edges) -> Edges:
    """Both directions."""
    return [*edges, *((b, a) for a, b in edges)]


LINE = both([(0, 1), (1, 2), (2, 3)])
CYCLE = [(0, 1), (1, 2), (2, 3), (3, 0)]
RING = both([(0, 1), (1, 2), (2, 3), (3, 0)])
GRAPHS = {"line": LINE, "cycle": CYCLE, "ring": RING}

#: Amplitudes of the example: w1 [m], w2 [m/s], w3 [m/s2], none of the resistance and the measurement.
AMPLITUDE = np.zeros((5, N))
AMPLITUDE[:3] = [[0.1] * 4, [0.1, 0.2, 0.1, 0.2], [0.01] * 4]
PRINTED: list[dict[str, object]] = [
    {"on": "position", "shape": "constant", "amplitude_m": 0.1},
    {"on": "speed", "shape": "constant", "amplitude_mps": [0.1, 0.2, 0.1, 0.2]},
    {"on": "input", "shape": "constant", "amplitude_mps2": 0.01},
]


def entries(tables: list[dict[str, object]]) -> list[disturbance.Disturbance]:
    """Entries of ``[[disturbance]]``."""
    return [disturbance.Disturbance.model_validate_json(json.dumps(t)) for t in tables]


def scene(
    graphs: Sequence[Edges], position: Floats, speed: Floats, *, n: int = N, weight: float = 0.01, steps: int = 1, period: float = T
) -> Scene:
    """One formation of ``n`` trains per graph."""
    pairs = np.array([(n * g + s, n * g + r) for g, edges in enumerate(graphs) for s, r in edges]).reshape(-1, 2)
    pairs = pairs[np.lexsort((pairs[:, 0], pairs[:, 1]))].astype(np.int64)
    sender, receiver = np.ascontiguousarray(pairs[:, 0]), np.ascontiguousarray(pairs[:, 1])
    m, links = n * len(graphs), len(pairs)
    slot = np.tile(-SPACING * np.arange(n), len(graphs))
    one, free = np.ones(m), np.full(m, np.inf)
    return Scene(
        trains=[str(i + 1) for i in range(m)],
        consists=Consists(
            np.arange(m + 1), 0 * one, 8e4 * one, one, np.tile(DAVIS, (m, 1)), 0 * one, 0 * one, free, free, free, free, 0 * one
        ),
        own=np.column_stack((np.tile(position, m // len(position)), np.tile(speed, m // len(speed)))).astype(float),
        links=Links(
            sender, receiver, np.searchsorted(receiver, np.arange(m + 1)), slot[sender] - slot[receiver],
            np.full(links, -np.inf), np.full(links, np.inf), np.full(links, weight), np.ones(links, bool), slot, np.arange(m),
        ),
        bounds=Bounds(0 * one, 85.0 * one, -2.0 * one, 2.0 * one),
        reference=constant(V0, 27000.0), time=0.0, step=period / steps, control_period=period, lead=point.lead(steps),
        sub_step=period / steps,
    )  # fmt: skip


Kicks = Callable[[int, Floats], Disturbed | None]


def quiet(k: int, position: Floats) -> None:
    """No disturbance."""
    return None


def printed(k: int, position: Floats) -> Disturbed:
    """The printed disturbances, constant."""
    return disturbance.at(SIGNALS, k, k * T, position)


SIGNALS = disturbance.signals(entries(PRINTED), ["1", "2", "3", "4"], T, None)


class Loop:
    """Law and plant, one step at a time, with fresh messages."""

    def __init__(self, start: Scene, kicks: Kicks = quiet) -> None:
        self.scene, self.kicks, self.k, self.own = start, kicks, 0, start.own.copy()
        self.constants = law.constants(PARAMS, start)
        clamps = point.Params(input_lower_mps2=-2.0, input_upper_mps2=2.0, speed_lower_mps=0.0, speed_upper_mps=85.0)
        self.plant = point.constants(clamps, start.consists)
        self.held = round(start.control_period / start.step)
        self.moved: point.Mapped | None = None

    def step(self) -> point.Mapped:
        """One step of law and plant."""
        n, t = len(self.own), self.k * self.scene.step
        d = self.kicks(self.k, self.own[:, POSITION])
        plant = self.plant if d is None else self.plant._replace(resistance_factor=d.resistance)
        kick = point.Kick.none(n) if d is None else point.Kick(d.position, d.speed, d.input)
        if self.k % self.held == 0:
            seen = self.own[:, POSITION] + (0.0 if d is None else d.measurement)
            leader = np.array([27000.0 + V0 * t, V0, 0.0, 0.0])
            trains = Trains(seen, self.own[:, SPEED], point.resistance(self.own[:, SPEED], self.plant.davis))
            sent = law.message(self.constants, trains, leader)
            self.demand = law.demand(self.constants, trains, leader, self.scene.links, sent[self.scene.links.sender])
        self.moved = point.advance(plant, self.own, self.demand.acceleration, self.scene.step, kick)
        self.own = self.moved.own
        self.k += 1
        return self.moved

    def error(self, n: int = N) -> Floats:
        """Position errors in the formation, less those of the first train of each: shape (copies, n)."""
        p = (self.own[:, POSITION] - self.scene.links.slot).reshape(-1, n)
        return p - p[:, :1]

    def spread(self, n: int = N) -> Floats:
        """Largest |p_i - p_j - d_ij| of each formation."""
        spread: Floats = np.ptp(self.error(n), axis=1)
        return spread


def pairs_of(error: Floats) -> Floats:
    """p_i - p_j - d_ij of all pairs, shape (copies, 6), in the order of ``robust_gain.pair_rows``."""
    return np.stack([error[:, i] - error[:, j] for i, j in itertools.combinations(range(N), 2)], axis=1)


def gain_of(graph: str, steps: int = 1) -> robust_gain.Gain:
    """The l1 bound of a graph under the printed amplitudes."""
    return robust_gain.gain(H, scene([GRAPHS[graph]], START, np.zeros(N), steps=steps), AMPLITUDE)


def strongly_connected_digraphs() -> list[Edges]:
    """All on 4 labelled nodes."""
    every = [(a, b) for a in range(N) for b in range(N) if a != b]
    chosen = (np.arange(2 ** len(every))[:, None] >> np.arange(len(every))) & 1
    reach = np.tile(np.eye(N, dtype=np.int64), (len(chosen), 1, 1))
    reach[:, [a for a, _ in every], [b for _, b in every]] = chosen
    for _ in range(2):
        reach = np.minimum(reach @ reach, 1)
    return [[e for e, c in zip(every, row, strict=True) if c] for row in chosen[reach.all(axis=(1, 2))]]


def settle(graphs: Sequence[Edges]) -> Floats:
    """Time after which all errors stay below 1 mm, within 1000 s [s]; inf if they do not."""
    loop = Loop(scene(graphs, START, np.zeros(N)))
    last = np.zeros(len(graphs))
    for _ in range(1250):
        loop.step()
        last[loop.spread() > 1e-3] = loop.k * T
    return np.where(loop.spread() > 1e-3, np.inf, last)


def theorem(graph: Edges = LINE, speed: float = 0.0, weight: float = 0.01) -> robust_theory.Theorem:
    """Theorem 1 for a graph, a common start speed and a weight."""
    return robust_theory.theorem_1(H, scene([graph], START, np.full(N, speed), weight=weight), AMPLITUDE[:3])


class Scaled(NamedTuple):
    """What the clamps leave along the undisturbed example, eqs. (10) to (12); 400 steps."""

    position: Floats  # (400, N) phat less the start of the slots [m]
    speed: Floats  # (400, N) vbar [m/s]
    rho1: Floats  # (400, N)
    rho2: Floats  # (400, N)
    laplacian: Floats  # (N, N) 1/s2

    def negative(self, c: float) -> tuple[int, float]:
        """Steps in which the system matrix (16) has a negative element for c [s], and the minimum element."""
        own = self.rho1 * (1 - self.rho2 * H * T)
        diagonal = np.arange(N)
        left = -c * T * (self.rho1 * self.rho2)[:, :, None] * self.laplacian
        left[:, diagonal, diagonal] += 1 - T / c - own
        minimum = np.minimum(left.min(axis=(1, 2)), np.minimum((T / c + own).min(axis=1), min(1 - T / c, T / c)))
        return int((minimum < -1e-12).sum()), float(minimum.min())

    def spreads(self, c: float) -> Floats:
        """Spread max - min of psi for c [s], shape (400,)."""
        return np.array([robust_theory.start_spread(p, v, np.full(N, c)) for p, v in zip(self.position, self.speed, strict=True)])


def along_the_example(graph: Edges = LINE) -> Scaled:
    """The example step by step: rho1 and rho2 of (10), (11), and that (12) holds with them."""
    loop = Loop(scene([graph], START, np.zeros(N)))
    big = robust_gain.laplacian(N, loop.scene.links)
    rows = []
    for _ in range(400):
        p = loop.own[:, POSITION] - loop.scene.links.slot - V0 * loop.k * T
        v = loop.own[:, SPEED] - V0
        r = point.resistance(loop.own[:, SPEED], loop.plant.davis)
        f2 = -H * v - big @ p
        cut = np.clip(f2, -2.0 - r, 2.0 - r)
        f1 = v + cut * T
        rho2 = np.divide(cut, f2, out=np.ones(N), where=f2 != 0.0)
        rho1 = np.divide(np.clip(f1, -V0, 5.0), f1, out=np.ones(N), where=f1 != 0.0)
        rows.append((p, v, rho1, rho2))
        loop.step()
        np.testing.assert_allclose(loop.own[:, SPEED] - V0, rho1 * (v + rho2 * f2 * T), atol=1e-9)  # (12)
    position, speed, rho1s, rho2s = np.array(rows).transpose(1, 0, 2)
    return Scaled(position, speed, rho1s, rho2s, big)


# --- claims ---------------------------------------------------------------------------------------------------------------------------


class History:
    """The example to its end."""

    def __init__(self, kicks: Kicks) -> None:
        loop = Loop(scene([LINE], START, np.zeros(N)), kicks)
        self.asked, moved = 0.0, []  # largest input the law wants [m/s2], before the clamps
        for _ in range(1250):
            resistance = point.resistance(loop.own[:, SPEED], loop.plant.davis)
            moved.append(loop.step())
            self.asked = max(self.asked, float(np.abs(loop.demand.acceleration + resistance).max()))
        self.input = np.array([m.input for m in moved])
        self.own = np.array([m.own for m in moved])  # (1250, 4, 2)
        p = self.own[..., POSITION] - loop.scene.links.slot
        self.spread = np.ptp(p, axis=1)
        self.neighbours = np.abs(np.diff(p, axis=1))
        self.distance = -np.diff(self.own[..., POSITION], axis=1)
        self.scene = loop.scene


class Runs:
    """Closed loops that several claims share."""

    @cached_property
    def quiet(self) -> History:
        """Without disturbance."""
        return History(quiet)

    @cached_property
    def printed(self) -> History:
        """Under the printed disturbances, constant."""
        return History(printed)

    @cached_property
    def scaled(self) -> dict[str, Scaled]:
        """What the clamps leave, on three graphs."""
        return {name: along_the_example(graph) for name, graph in GRAPHS.items()}

    @cached_property
    def settled(self) -> tuple[int, Floats]:
        """Number of strongly connected digraphs of four trains, and the time to 1 mm on every 64th [s]."""
        graphs = strongly_connected_digraphs()
        return len(graphs), settle(graphs[::64])

    @cached_property
    def bound(self) -> robust_gain.Gain:
        """The l1 bound on the line."""
        return gain_of("line")


def constraints(runs: Runs) -> Iterator[Claim]:
    """Fig. 3: speed and input sets."""
    u = np.concatenate([runs.quiet.input, runs.printed.input])
    v = np.concatenate([runs.quiet.own[..., SPEED], runs.printed.own[..., SPEED]])
    yield claim(
        "inputs stay in [-2, 2] m/s2, with and without disturbance (Fig. 3)", span(-2, 2), span(u.min(), u.max()), "m/s2",
        bool(np.abs(u).max() <= 2.0), f"the applied input; the law itself asks for up to {max(runs.quiet.asked, runs.printed.asked):.0f} m/s2 and is clamped",
    )  # fmt: skip
    yield claim("speeds stay in [0, 85] m/s (Fig. 3)", span(0, 85), span(v.min(), v.max()), "m/s", bool(v.min() >= 0.0 and v.max() <= 85.0),
                "the clamp is part of the plant (4)")  # fmt: skip
    kappa = theorem().kappa
    yield claim("Assumption 1: kappa > 10", "> 10", float(kappa), "1", kappa > 10.0)


def formation(runs: Runs) -> Iterator[Claim]:
    """Fig. 5."""
    calm, kicked = runs.quiet, runs.printed
    final = float(calm.spread[-1])
    settled = (int(np.flatnonzero(calm.spread > 1.0)[-1]) + 2) * T
    yield claim("without disturbance the desired formation is reached (Fig. 5b): error of the worst pair at 1000 s", 0, final, "m", final < 1e-3,
                f"within 1 m from {settled:.5g} s; the graph is drawn in Fig. 1 and not in the text: assumed: neighbours receive from each other")  # fmt: skip
    error, nearest = float(kicked.spread[-1]), float(kicked.neighbours[-1].max())
    steady = robust_gain.steady_state(H, kicked.scene, AMPLITUDE)
    predicted = float(np.abs(steady.error_m).max())
    yield claim(
        "with the printed disturbances the formation is kept with bounded errors (Fig. 5a): neighbours, worst pair at 1000 s", "bounded",
        f"{nearest:.5g}, {error:.5g}", "m", abs(error - predicted) < 1e-3, f"equal to the closed form, {predicted:.5g} m; the common speed is shifted to {kicked.own[-1, :, SPEED].mean():.5g} m/s",
    )  # fmt: skip
    graphs, times = runs.settled
    slowest = float(times.max())
    yield claim("any strongly connected graph will do (Theorem 1): slowest of a sample to 1 mm", "finite", slowest, "s", bool(np.isfinite(slowest)),
                f"every 64th of the {graphs} strongly connected digraphs of four trains")  # fmt: skip


def bound(runs: Runs) -> Iterator[Claim]:
    """The 7694 m."""
    t = theorem()
    usable = runs.bound
    near = max(e for pair, e in zip(usable.pairs, usable.error_m, strict=True) if int(pair[1]) - int(pair[0]) == 1)
    yield claim(
        "Theorem 1 bounds the error by 7694 m; the minimum its formula can give for any graph and eta", 7694.0, float(t.least_bound_m), "m",
        abs(t.least_bound_m - 7694.0) < 0.5, f"mubar would have to be {t.needed_mubar:.4f}, it is at most {max(t.h_t) / 2:.2f}; tried: every graph and eta at once (this is "
        f"the minimum over all), and the most charitable values for this line, eta2 = 1: {t.charitable_bound_m:.2g} m",
    )  # fmt: skip
    yield claim(
        "a bound on the error for any disturbance of these sizes: worst pair", 7694.0, float(usable.worst_m), "m", usable.worst_m < 7694.0,
        "l1 gain of the unsaturated loop instead of Theorem 1; a worst-case disturbance attains it", corrected=True,
    )  # fmt: skip
    most = runs.printed.distance.max()
    yield claim(
        "neighbours are in the end at most 8000 + 7694 m apart", 15694.0, SPACING + near, "m", SPACING + near < 15694.0,
        f"a limit for large times, by the l1 gain instead of Theorem 1; on the way, under the printed disturbances, up to {most:.0f} m", corrected=True,
    )  # fmt: skip
    alone = 2 * V0 * N * min(t.q) / H[0]  # n q max |psi_l(0) - psi_s(0)| eta2 >= n q v0 c eta2, c = 2 / (eta2 h)
    yield claim(
        "h = 0.3 and a_ij = 0.01 follow from Assumption 2: rules of Assumption 2 and Theorem 1 violated from rest", 0, len(t.violated), "1",
        not t.violated, f"Assumption 2 has no solution for eta2, whatever its 'B1 i T' is: 160 n q / h = {alone:.3g} m/s2 alone exceeds b2 = {t.b2_low[0]:.3g}; tried, too: eta2 = 1, "
        f"the most charitable, which gives {t.charitable_bound_m:.2g} m",
    )  # fmt: skip
    yield claim(
        "b2 = min(|th2 - c0|, |th2 - r_max|) bounds the saturated input from below", float(t.b2_low_printed[0]), float(t.b2_low[0]), "m/s2",
        bool(t.b2_low[0] < t.b2_low_printed[0]), "read as min(th2 - r_max, |th2| + c0)", corrected=True,
    )  # fmt: skip


def transients(runs: Runs) -> Iterator[Claim]:
    """Figs. 2 to 4 on the way."""
    calm, kicked = runs.quiet, runs.printed
    final = float(np.abs(calm.own[-1, :, SPEED] - V0).max())
    settled = (int(np.flatnonzero(np.abs(calm.own[..., SPEED] - V0).max(axis=1) > 0.01 * V0)[-1]) + 2) * T
    yield claim(
        "all speeds go from 0 to 80 m/s (Fig. 3): largest error at 1000 s", 0, final, "m/s", final < 1e-3,
        f"without disturbance; within 1 % from {settled:.5g} s, after a while at the bound of 85 m/s",
    )  # fmt: skip
    minimum, most = (float(f(h.distance)) for f, h in ((np.min, calm), (np.max, calm)))
    low, high = float(kicked.distance.min()), float(kicked.distance.max())
    yield claim(
        "positions and distances on the way (Figs. 2, 4): no train passes another, minimum and maximum", "> 0", span(minimum, most), "m", minimum > 0.0,
        f"distances from 8500, 11000, 7500 m; {span(low, high)} m under the printed disturbances; the figure's values are not in the text",
    )  # fmt: skip


def proof(runs: Runs) -> Iterator[Claim]:
    """What the proof rests on."""
    t, scaled = theorem(), runs.scaled
    eta1, least1 = min(t.eta1), min(float(s.rho1.min()) for s in scaled.values())
    yield claim(
        "Lemma 1: eta1 <= rho1 <= 1, minimum rho1 along the example", f">= {eta1:.4f}", least1, "1",
        bool(least1 >= eta1 and max(s.rho1.max() for s in scaled.values()) <= 1.0), f"on three graphs: {', '.join(scaled)}",
    )  # fmt: skip
    least2 = min(float(s.rho2.min()) for s in scaled.values())
    yield claim(
        "Lemma 1: eta2 <= rho2, minimum rho2 along the example", ">= eta2", least2, "1", t.eta2 is not None and least2 >= min(t.eta2),
        "no eta2 satisfies Assumption 2 here, see above; tried, too: eta2 = 1, the most charitable, which this rho2 is far from",
    )  # fmt: skip
    line = scaled["line"]
    negative, minimum = line.negative(2 / 0.3)
    fewest = min(s.negative(c)[0] for s in scaled.values() for c in np.geomspace(1.0, 500.0, 60))
    falls = all(np.all(np.diff(s.spreads(2 / 0.3)) <= 1e-9) for s in scaled.values())
    yield claim(
        "(16) is a product of stochastic matrices: steps of the example with a negative element", 0, negative, "1", fewest == 0,
        f"minimum element {minimum:.3f} with c = 2/h; tried: 60 values of c from 1 to 500 s on three graphs ({', '.join(scaled)}), at least {fewest} such steps with each. "
        f"The spread still {'falls in every step' if falls else 'does not fall in every step'} (c = 2/h)",
    )  # fmt: skip


MEASUREMENTS: tuple[Callable[[Runs], Iterator[Claim]], ...] = (constraints, formation, transients, bound, proof)
