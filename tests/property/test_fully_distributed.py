"""Fully distributed law on random connected graphs with unequal bounds: O1 and O2 at every step, joins, losses, leads.

All cases of a batch are one scene: thousands of formations without a link between them, so a step of all is one evaluation.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from trainctl.controllers import fully_distributed as law
from trainctl.plants import point
from trainctl.signals import POSITION, SPEED, Bounds, Consists, Floats, Ints, Links, Reference, Scene, Trains

#: Rounding of positions around 1e5 m, over some hundred steps.
ROUNDING = 1e-9
V_R = 60.0


class Edges(NamedTuple):
    """Undirected edges of all cases: x_a - x_b within [lower, upper]."""

    a: Ints
    b: Ints
    desired: Floats
    lower: Floats
    upper: Floats
    case: Ints


class Batch(NamedTuple):
    scene: Scene
    edges: Edges
    case: Ints  # (n,) the formation of each train
    slot: Floats  # (n,) m


def random_graph(rng: np.random.Generator, n: int, tree_only: bool) -> list[tuple[int, int]]:
    order = rng.permutation(n)
    edges = {tuple(sorted((int(order[i]), int(order[rng.integers(i)])))) for i in range(1, n)}
    if not tree_only:
        edges |= {(i, j) for i in range(n) for j in range(i + 1, n) if rng.random() < 0.25}
    return sorted(edges)


def links_of(n: int, e: Edges) -> Links:
    receiver, sender = np.concatenate([e.b, e.a]), np.concatenate([e.a, e.b])
    k = np.lexsort((sender, receiver))
    receiver = receiver[k]
    return Links(
        sender=sender[k], receiver=receiver, first=np.searchsorted(receiver, np.arange(n + 1)),
        desired=np.concatenate([e.desired, -e.desired])[k],
        lower=np.concatenate([e.lower, -e.upper])[k], upper=np.concatenate([e.upper, -e.lower])[k],
        weight=np.ones(len(k)), heard=np.ones(len(k), bool), slot=np.full(n, np.nan), order=np.arange(n),
    )  # fmt: skip


def points(rng: np.random.Generator, n: int, period: float) -> tuple[Consists, Bounds]:
    """Trains with their own resistance and bounds; input bounds from 1 % to three times above what Assumption 2.4 asks for."""
    davis = np.array([1.176e-2, 7.7616e-4, 1.6e-5]) * rng.uniform(0.5, 2.0, (n, 3))
    o, inf = np.zeros(n), np.full(n, np.inf)
    rho, Rho = V_R - rng.uniform(0.5, 8.0, n), V_R + rng.uniform(0.5, 8.0, n)
    f, F = point.resistance(rho, davis), point.resistance(Rho, davis)
    spare = 1.0 + 10.0 ** rng.uniform(-2.0, 0.5, (2, n))
    bounds = Bounds(rho, Rho, f - (Rho - V_R) / period * spare[0], F + (V_R - rho) / period * spare[1])
    return Consists(np.arange(n + 1), o, o + 1, o + 1, davis, o, o, inf, inf, inf, inf, o), bounds


def share(rng: np.random.Generator, cases: int) -> Floats:
    """How far out a start lies: 1 (on a bound) in three cases of ten."""
    return np.where(rng.random(cases) < 0.3, 1.0, rng.random(cases))


def batch(
    seed: int, cases: int, *, theta: float = 0.0, held: int = 1, period: float = 1.0, slack: tuple[float, float] = (0.0, 3.5),
    tree_only: bool = False, trains: tuple[int, int] = (2, 12),
) -> Batch:  # fmt: skip
    """Random formations that satisfy every assumption and the start conditions, many of them exactly on their bounds."""
    rng = np.random.default_rng(seed)
    rows, n = [], 0
    for c in range(cases):
        size = int(rng.integers(trains[0], trains[1] + 1))
        rows += [(n + i, n + j, c) for i, j in random_graph(rng, size, tree_only)]
        n += size
    a, b, edge_case = np.array(rows, np.int64).T.copy()
    case = np.zeros(n, np.int64)
    case[a] = case[b] = edge_case
    slot = rng.uniform(0.0, 5e4, n)
    under, over = 10.0 ** rng.uniform(*slack, (2, len(a)))
    desired = slot[a] - slot[b]
    edges = Edges(a, b, desired, desired - under, desired + over, edge_case)

    consists, bounds = points(rng, n, period)
    rho, Rho = bounds.speed_lower, bounds.speed_upper

    # errors of z up to the first edge's bound, then speeds as far from v_r as the errors of x allow
    def room(shift: Floats, move: Floats) -> Floats:
        e, m = shift[a] - shift[b], move[a] - move[b]
        reach = np.where(m > 0, over - e, under + e)
        minimum = np.full(cases, np.inf)
        np.minimum.at(minimum, edge_case, np.maximum(reach, 0.0) / np.maximum(np.abs(m), 1e-300))
        return minimum

    wish = rng.normal(size=n)
    z_error = wish * (share(rng, cases) * room(np.zeros(n), wish))[case]
    band = np.where(rng.random(n) < 0.3, rng.integers(0, 2, n), rng.random(n))
    vbar = rho + (Rho - rho) * band - V_R
    back = (1.0 - theta) * period * vbar
    vbar *= (share(rng, cases) * np.minimum(1.0, room(z_error, -back)))[case]
    x = slot + z_error - (1.0 - theta) * period * vbar
    scene = Scene(
        trains=[str(i) for i in range(n)], consists=consists, own=np.column_stack((x, V_R + vbar)), links=links_of(n, edges),
        bounds=bounds, reference=Reference(np.array([0.0, 1e6]), np.array([[0.0, V_R]])), time=0.0, step=period / held,
        control_period=period, lead=theta, sub_step=period / held,
    )  # fmt: skip
    return Batch(scene, edges, case, slot)


class Extremes(NamedTuple):
    """Largest amount beyond a bound over the whole run (negative: all inside), and what happened."""

    edges: Floats  # (E,) m
    speed: Floats  # (n,) m/s
    input: Floats  # (n,) m/s2
    bound: dict[str, int]  # train-steps in which alpha, beta, eta was what limited s
    own: Floats
    error: Floats  # (E,) m, maximum |x_ab - d_ab| of the last 50 periods
    ripple: Floats  # (n,) m/s, maximum |v - v_r| of the last 50 periods


def beyond(value: Floats, lower: Floats, upper: Floats) -> Floats:
    return np.maximum(lower - value, value - upper)


def run(
    scene: Scene, edges: Edges, periods: int, params: law.Params | None = None, *, held: int = 1, plant: str = "euler",
    loss: float = 0.0, ignore: bool = False, delay: int = 0, count: bool = False, seed: int = 0,
) -> Extremes:  # fmt: skip
    """Closed loop on the point plant (``euler``), exactly integrated held acceleration or SUMO's update (x moves with new v)."""
    constants = law.constants(params or law.Params(), scene)
    plant_constants = point.constants(point.Params(), scene.consists)
    b, T, n = scene.bounds, scene.control_period, len(scene.trains)
    kick, rng = point.Kick.none(n), np.random.default_rng(seed)
    own, sent, bound = scene.own.copy(), [], {"alpha": 0, "beta": 0, "eta": 0}

    def spacing() -> Floats:
        return own[edges.a, POSITION] - own[edges.b, POSITION]

    worst_edge = beyond(spacing(), edges.lower, edges.upper)
    worst_speed, worst_input = np.full(n, -np.inf), np.full(n, -np.inf)
    error, ripple = np.zeros(len(edges.a)), np.zeros(n)
    for k in range(periods):
        leader = np.array([V_R * k * T, V_R, 0.0, 0.0])
        trains = Trains(own[:, POSITION], own[:, SPEED], point.resistance(own[:, SPEED], plant_constants.davis))
        sent = [law.message(constants, trains, leader), *sent][: delay + 1]
        links, told = scene.links, sent[-1]
        if loss:
            links = links._replace(heard=rng.random(len(links.sender)) >= loss)
            if ignore:
                links = without_missing(links)
        demand = law.demand(constants, trains, leader, links, told[links.sender])
        if count:
            for name, hits in binding(scene, constants.own_speed, trains, demand.acceleration).items():
                bound[name] += hits
        for _ in range(held):
            h = T / held
            if plant == "euler":
                moved = point.advance(plant_constants, own, demand.acceleration, h, kick)
                own, u = moved.own, moved.input
            else:
                u = point.resistance(own[:, SPEED], plant_constants.davis) + demand.acceleration
                v = own[:, SPEED] + demand.acceleration * h
                mean = (own[:, SPEED] + v) / 2 if plant == "exact" else v
                own = np.column_stack((own[:, POSITION] + mean * h, v))
            worst_input = np.maximum(worst_input, beyond(u, b.input_lower, b.input_upper))
            worst_speed = np.maximum(worst_speed, beyond(own[:, SPEED], b.speed_lower, b.speed_upper))
            worst_edge = np.maximum(worst_edge, beyond(spacing(), edges.lower, edges.upper))
        if k >= periods - 50:
            error = np.maximum(error, np.abs(spacing() - edges.desired))
            ripple = np.maximum(ripple, np.abs(own[:, SPEED] - V_R))
    return Extremes(worst_edge, worst_speed, worst_input, bound, own, error, ripple)


def join(b: Batch, seed: int) -> tuple[Batch, Edges]:
    """To every formation comes one train anywhere near its slot, on one to three new edges; its speed is within its band.

    Also returned: what the ratchet promises, bounds widened on the new edges to the spacings at the join.
    """
    rng, sc = np.random.default_rng(seed), b.scene
    n, cases = len(b.case), int(b.case.max()) + 1
    members = [np.flatnonzero(b.case == c) for c in range(cases)]
    new = np.array([(n + c, i) for c, m in enumerate(members) for i in rng.permutation(m)[: rng.integers(1, 4)]])
    slot = np.concatenate([b.slot, rng.uniform(0.0, 5e4, cases)])
    under, over = 10.0 ** rng.uniform(0.0, 2.5, (2, len(new)))
    desired = slot[new[:, 0]] - slot[new[:, 1]]
    edges = Edges(
        np.concatenate([b.edges.a, new[:, 0]]), np.concatenate([b.edges.b, new[:, 1]]), np.concatenate([b.edges.desired, desired]),
        np.concatenate([b.edges.lower, desired - under]), np.concatenate([b.edges.upper, desired + over]),
        np.concatenate([b.edges.case, new[:, 0] - n]),
    )  # fmt: skip
    more, bounds = points(rng, cases, sc.control_period)
    # where the formation is now, so that the joiner comes near its slot in it
    base = np.array([np.mean(sc.own[m, POSITION] - b.slot[m]) for m in members])
    x = base + slot[n:] + rng.normal(size=cases) * 10.0 ** rng.uniform(0.0, 2.5, cases)
    v = rng.uniform(bounds.speed_lower, bounds.speed_upper)
    o, inf = np.zeros(n + cases), np.full(n + cases, np.inf)
    scene = sc._replace(
        trains=[str(i) for i in range(n + cases)], own=np.concatenate([sc.own, np.column_stack((x, v))]),
        consists=Consists(
            np.arange(n + cases + 1), o, o + 1, o + 1, np.concatenate([sc.consists.davis, more.davis]), o, o, inf, inf, inf, inf, o
        ),
        bounds=Bounds(*(np.concatenate(both) for both in zip(sc.bounds, bounds, strict=True))), links=links_of(n + cases, edges),
    )  # fmt: skip
    z = scene.own[:, POSITION] + (1 - sc.lead) * scene.own[:, SPEED] * sc.control_period
    now, ahead = (q[edges.a] - q[edges.b] for q in (scene.own[:, POSITION], z))
    minimum, most = np.minimum(now, ahead), np.maximum(now, ahead)
    promised = edges._replace(lower=np.minimum(edges.lower, minimum), upper=np.maximum(edges.upper, most))
    return Batch(scene, edges, np.concatenate([b.case, np.arange(cases)]), slot), promised


def without_missing(links: Links) -> Links:
    """The tempting mistake: go on without the neighbour that was not heard."""
    keep = links.heard
    receiver = links.receiver[keep]
    return links._replace(
        sender=links.sender[keep], receiver=receiver, first=np.searchsorted(receiver, np.arange(len(links.first))),
        desired=links.desired[keep], lower=links.lower[keep], upper=links.upper[keep], weight=links.weight[keep],
        heard=np.ones(len(receiver), bool),
    )  # fmt: skip


def binding(scene: Scene, own_speed: bool, trains: Trains, acceleration: Floats) -> dict[str, int]:
    """How many trains were stopped short by their links, their speed or their input: the ends of (10), written out again."""
    T, links, b = scene.control_period, scene.links, scene.bounds
    s = (trains.speed + acceleration * T - V_R) * T
    z = trains.position + (1 - scene.lead) * trains.speed * T
    e = z[links.sender] - z[links.receiver]
    back, forth, wanted = np.full(len(s), -np.inf), np.full(len(s), np.inf), np.zeros(len(s))
    np.maximum.at(back, links.receiver, (e - links.upper) / 2)
    np.minimum.at(forth, links.receiver, (e - links.lower) / 2)
    np.add.at(wanted, links.receiver, e - links.desired)
    wanted /= 2 * np.diff(links.first)
    f, F = (point.resistance(v, scene.consists.davis) for v in (b.speed_lower, b.speed_upper))
    most, minimum = b.speed_upper, b.speed_lower
    if own_speed:
        f = F = trains.resistance
        most = minimum = trains.speed
    ends = {
        "alpha": (back, forth),
        "beta": ((b.speed_lower - V_R) * T, (b.speed_upper - V_R) * T),
        "eta": (most * T + (b.input_lower - f) * T**2 - V_R * T, minimum * T + (b.input_upper - F) * T**2 - V_R * T),
    }
    acted = (np.abs(s - wanted) > 1e-6) & (np.abs(s) > 1e-6)
    return {name: int(np.sum(acted & (np.minimum(np.abs(s - lo), np.abs(s - hi)) < 1e-9))) for name, (lo, hi) in ends.items()}


def assert_inside(seen: Extremes) -> None:
    assert seen.edges.max() < ROUNDING
    assert seen.speed.max() < ROUNDING
    assert seen.input.max() < ROUNDING


def broken_cases(seen: Extremes, edges: Edges) -> int:
    return len(np.unique(edges.case[seen.edges > 1e-6]))


def settled_cases(seen: Extremes, b: Batch) -> int:
    """Formations whose spacings and speeds have come to rest."""
    restless = np.union1d(b.edges.case[seen.error > 1.0], b.case[seen.ripple > 1e-4])
    return int(b.case.max()) + 1 - len(restless)


def spacings(scene: Scene, edges: Edges, ahead: float = 0.0) -> Floats:
    q = scene.own[:, POSITION] + ahead * scene.own[:, SPEED]
    return q[edges.a] - q[edges.b]


@pytest.mark.parametrize("cases", [2000, pytest.param(40000, marks=pytest.mark.campaign)])
@pytest.mark.parametrize("eta", ["printed", "own_speed"])
def test_spacing_speed_and_input_bounds_hold_at_every_step(eta: str, cases: int) -> None:
    b = batch(1, cases)
    scene, e = b.scene, b.edges
    if cases <= 2000:
        assert law.violations(law.Params(), scene) == []
    for ahead in (0.0, 1.0):  # the start is hard: x_ij(0) and x_ij(1) on their bounds, speeds too
        assert np.sum(beyond(spacings(scene, e, ahead), e.lower, e.upper) > -1e-6) > cases / 5
    assert np.sum(beyond(scene.own[:, SPEED], scene.bounds.speed_lower, scene.bounds.speed_upper) > -1e-9) > cases / 20

    seen = run(scene, e, 300, law.Params(eta=eta), count=True)

    assert_inside(seen)
    assert min(seen.bound.values()) > 500, f"each saturation must have been met: {seen.bound}"


PLANTS = [("euler", 1, 1.0, 0.0), ("exact", 1, 1.0, 0.5), ("sumo", 1, 1.0, 1.0)] + [
    ("euler", m, T, point.lead(m)) for m, T in ((2, 1.0), (5, 1.0), (10, 10.0))
]


@pytest.mark.parametrize(("plant", "held", "period", "theta"), PLANTS)
@pytest.mark.parametrize("eta", ["printed", "own_speed"])
def test_lead_of_the_plant_keeps_bounds_and_settles(eta: str, plant: str, held: int, period: float, theta: float) -> None:
    b = batch(2, 200, theta=theta, held=held, period=period, slack=(-1.0, 1.0))
    seen = run(b.scene, b.edges, 600, law.Params(eta=eta), held=held, plant=plant)
    assert_inside(seen)
    assert settled_cases(seen, b) == 200


@pytest.mark.parametrize(("plant", "held", "period", "theta"), [p for p in PLANTS if p[3] > 0.0 and p[1] in (1, 10)])
def test_printed_lead_breaks_bounds_on_other_plants(plant: str, held: int, period: float, theta: float) -> None:
    b = batch(2, 300, theta=theta, held=held, period=period, slack=(-1.0, 1.0))
    seen = run(b.scene._replace(lead=0.0), b.edges, 600, held=held, plant=plant)
    assert broken_cases(seen, b.edges) > 0


@pytest.mark.parametrize(("plant", "theta"), [("exact", 0.5), ("sumo", 1.0)])
def test_printed_lead_never_settles_on_trees_of_other_plants(plant: str, theta: float) -> None:
    b = batch(3, 100, theta=theta, slack=(-1.0, 1.0), tree_only=True)
    assert settled_cases(run(b.scene._replace(lead=0.0), b.edges, 600, plant=plant), b) == 0
    assert settled_cases(run(b.scene, b.edges, 600, plant=plant), b) == 100


def test_own_speed_room_counts_the_resistance_that_changes_while_the_acceleration_is_held() -> None:
    b = batch(4, 200, theta=point.lead(10), held=10, period=10.0, slack=(1.0, 3.0))
    seen = run(b.scene, b.edges, 200, law.Params(eta="own_speed"), held=10)
    assert seen.input.max() < ROUNDING
    unaware = b.scene._replace(sub_step=b.scene.control_period)
    assert run(unaware, b.edges, 200, law.Params(eta="own_speed"), held=10).input.max() > 1e-4


@pytest.mark.parametrize("cases", [1000, pytest.param(20000, marks=pytest.mark.campaign)])
def test_ratchet_admits_any_join_without_breaking_a_sound_edge(cases: int) -> None:
    b = batch(5, cases, slack=(0.0, 2.5), trains=(2, 8))
    under_way = run(b.scene, b.edges, 15).own
    joined, promised = join(b._replace(scene=b.scene._replace(own=under_way, time=15.0)), 6)
    scene, e, old = joined.scene._replace(own=joined.scene.own - [V_R * 15, 0.0]), joined.edges, len(b.edges.a)
    outside = np.maximum(e.lower - promised.lower, promised.upper - e.upper) > ROUNDING
    assert not outside[:old].any()
    assert len(np.unique(e.case[outside])) > 0.6 * cases, "joins must violate (13)"
    if cases <= 1000:
        assert law.violations(law.Params(), scene) == []
        assert len(law.violations(law.Params(join="strict"), scene)) >= outside.sum()

    assert_inside(run(scene, promised, 300))
    seen = run(scene, promised, 1500, law.Params(eta="own_speed"))
    assert_inside(seen)
    assert np.max(beyond(spacings(scene._replace(own=seen.own), e), e.lower, e.upper)) < ROUNDING, "all end inside"

    literal = run(scene, promised, 300, law.Params(join="strict"))
    sound = literal.edges[:old] > 1e-6
    assert len(np.unique(e.case[:old][sound])) > 0.2 * cases
    assert literal.edges[:old].max() > 100.0
    assert literal.speed.max() > V_R, "beyond its band by more than the reference speed, though no train runs backwards"


def test_lost_messages_break_no_bound_if_the_train_holds() -> None:
    b = batch(7, 1000, slack=(-1.0, 2.0))
    assert_inside(run(b.scene, b.edges, 100, loss=0.1))
    seen = run(b.scene, b.edges, 600, law.Params(eta="own_speed"), loss=0.1)
    assert_inside(seen)
    assert settled_cases(seen, b) == 1000
    ignoring = run(b.scene, b.edges, 600, loss=0.1, ignore=True)
    assert broken_cases(ignoring, b.edges) > 10


def test_message_one_period_late_breaks_bounds_by_less_than_half_a_period_of_relative_motion() -> None:
    b = batch(8, 1000, slack=(-1.0, 2.0))
    seen = run(b.scene, b.edges, 600, delay=1)
    assert seen.speed.max() < ROUNDING
    assert seen.input.max() < ROUNDING
    assert broken_cases(seen, b.edges) > 20
    bounds, T = b.scene.bounds, b.scene.control_period
    band = bounds.speed_upper - bounds.speed_lower
    room = (band[b.edges.a] + band[b.edges.b]) * T
    assert np.max(seen.edges / room) < 0.5
