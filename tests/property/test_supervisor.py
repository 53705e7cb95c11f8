"""Whatever is demanded, supervised trains do not reach what they must not reach; unsupervised ones do."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from trainctl.railway import supervisor
from trainctl.railway.supervisor import END, KINDS, OPPOSING, STOP, SWITCH, TRAIN, Limits, Params, Targets

PER_COLUMN = 6
DRIVERS = ("random", "bang-bang", "full traction", "against the follower", "no numbers")
ROUNDING = 1e-6


class World(NamedTuple):
    """Columns one beside the other, each PER_COLUMN trains front to rear; fronts and rears along the column's own way."""

    columns: int
    length: np.ndarray
    limit_from: np.ndarray  # (columns, 8) m
    limit: np.ndarray  # (columns, 8) m/s
    end: np.ndarray  # (columns,) m, where the way ends

    @property
    def first(self) -> np.ndarray:
        return np.arange(self.columns * PER_COLUMN) % PER_COLUMN == 0


def behind(world: World, x: np.ndarray, v: np.ndarray) -> Targets:
    """Each train's target: the rear of the train ahead of it."""
    rows = np.flatnonzero(~world.first)
    ahead = rows - 1
    room = x[ahead] - world.length[ahead] - x[rows]
    return Targets(rows, room, v[ahead], np.ones(len(rows), bool), np.full(len(rows), TRAIN), ahead)


def fixed(rows: np.ndarray, room: np.ndarray, kind: int) -> Targets:
    return Targets(rows, room, np.zeros(len(rows)), np.zeros(len(rows), bool), np.full(len(rows), kind), np.full(len(rows), -1))


def facing(rows: np.ndarray, others: np.ndarray, room: np.ndarray, v: np.ndarray) -> Targets:
    return Targets(
        np.concatenate([rows, others]), np.concatenate([room, room]), np.concatenate([v[others], v[rows]]),
        np.ones(2 * len(rows), bool), np.full(2 * len(rows), OPPOSING), np.concatenate([others, rows]),
    )  # fmt: skip


def joined(*parts: Targets) -> Targets:
    return Targets(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def demanded(rng: np.random.Generator, k: int, n: int) -> np.ndarray:
    """Acceleration of every train: the trains fall into equal shares, one for each driver."""
    i = np.arange(n)
    by = [
        rng.uniform(-3.0, 3.0, n),
        np.where(np.sin(0.01 * (1 + i % 17) * k + i) > -0.3, 9.0, -9.0),  # full traction or braking, held for some steps
        np.full(n, 9.0),
        np.where((i % 2 == 0) & (k // 150 % 2 == 1), -9.0, 9.0),  # every other train goes and stops dead, the rest press on
        rng.choice([np.nan, np.inf, np.inf, np.inf, -np.inf], n),
    ]
    return np.choose(shares(n), by)


def shares(n: int) -> np.ndarray:
    return np.arange(n) * len(DRIVERS) // n


def moved(x: np.ndarray, v: np.ndarray, a: np.ndarray, step: float, theta: float) -> tuple[np.ndarray, np.ndarray]:
    after = np.maximum(0.0, v + a * step)
    return x + ((1.0 - theta) * v + theta * after) * step, after


def limits_of(world: World, x: np.ndarray) -> Limits:
    rows = np.repeat(np.arange(len(x)), world.limit.shape[1])
    begin = world.limit_from[np.arange(len(x)) // PER_COLUMN].ravel()
    until = np.column_stack([world.limit_from[:, 1:], np.full(world.columns, np.inf)])[np.arange(len(x)) // PER_COLUMN].ravel()
    told = x[rows] < until
    return Limits(rows[told], (begin - x[rows])[told], world.limit[np.arange(len(x)) // PER_COLUMN].ravel()[told])


def start(
    rng: np.random.Generator, columns: int, params: Params, step: float, theta: float
) -> tuple[World, np.ndarray, np.ndarray]:
    """Columns packed as tightly as the speeds allow, or looser, on ways with limits that no train yet breaks."""
    n = columns * PER_COLUMN
    v = rng.uniform(0.0, 80.0, n) * (rng.random(n) < 0.85)
    length = rng.uniform(20.0, 400.0, n)
    way = supervisor.stopping_distance(v, params.emergency_mps2, step, theta)
    x = np.zeros(n)
    for i in range(n):
        if i % PER_COLUMN:
            ahead = way[i - 1] if params.curve == "relative" else 0.0
            slack = rng.choice([0.0, 0.0, rng.exponential(300.0)])
            x[i] = x[i - 1] - length[i - 1] - params.margin_m - max(0.0, way[i] - ahead) - slack
    top = np.maximum.reduceat(x + 1.6 * way, np.arange(0, n, PER_COLUMN))
    ahead = top[:, None] + 700.0 + np.cumsum(rng.exponential(900.0, (columns, 7)), 1)
    begin = np.column_stack([np.full(columns, -np.inf), ahead])
    limit = np.column_stack([np.full(columns, 85.0), rng.uniform(3.0, 85.0, (columns, 7))])
    # Far enough to brake for the first limit with 0.7 m/s2 from the fastest start in whole steps.
    begin[:, 1:] += 80.0**2 / (2 * params.service_mps2) + 85.0 * step * 2
    return World(columns, length, begin, limit, begin[:, -1] + rng.uniform(300.0, 3000.0, columns)), x, v


def ended(world: World, x: np.ndarray) -> Targets:
    leading = np.flatnonzero(world.first)
    return fixed(leading, world.end - x[leading], END)


CASES = [(0.0, 0.2), (0.5, 0.2), (0.0, 1.0), (0.5, 1.0), (0.0, 2.0), (0.5, 0.7), (0.25, 0.5)]


def driven(seed: int, columns: int, params: Params, step: float, theta: float, seconds: float) -> float:
    """Minimum distance to the train ahead in a run of all drivers; every step is checked."""
    rng = np.random.default_rng(seed)
    world, x, v = start(rng, columns, params, step, theta)
    rows, least_gap = np.flatnonzero(~world.first), np.inf
    for k in range(int(seconds / step)):
        targets, limits = joined(behind(world, x, v), ended(world, x)), limits_of(world, x)
        verdict = supervisor.verdict(params, v, targets, limits, step, theta)
        a, _ = supervisor.applied(verdict, demanded(rng, k, len(v)))
        assert np.all(verdict.minimum <= verdict.maximum) and np.all(verdict.minimum >= -params.emergency_mps2)
        assert np.all((a >= verdict.minimum) & (a <= verdict.maximum)) and np.all(a <= params.greatest_mps2)
        assert np.all(v + a * step >= -1e-12)  # never backwards
        x, v = moved(x, v, a, step, theta)
        gap = x[rows - 1] - world.length[rows - 1] - x[rows]
        least_gap = min(least_gap, gap.min())
        assert gap.min() > params.margin_m - ROUNDING, (k, DRIVERS[shares(len(v))[rows[gap.argmin()]]])
        assert np.all(world.end - x[world.first] > params.margin_m - ROUNDING)
        now = limits_of(world, x)
        forced = now.distance <= 0.0
        assert np.all(v[now.train[forced]] <= now.speed[forced] + ROUNDING), k
    return least_gap


@pytest.mark.parametrize("curve", ["relative", "absolute"])
@pytest.mark.parametrize(("theta", "step"), CASES)
def test_columns_under_any_driver_keep_the_margin_and_the_limits(theta, step, curve):
    params = Params(mode="on", curve=curve, emergency_mps2=1.1, service_mps2=0.7, margin_m=20.0)
    assert driven(1, 100, params, step, theta, 300.0) < params.margin_m + 1.0  # the drivers did press


@pytest.mark.parametrize(("theta", "step"), CASES)
def test_a_gap_that_begins_below_the_margin_behind_a_faster_train_does_not_shrink(theta, step):
    params, rng = Params(mode="on"), np.random.default_rng(2)
    v, w = rng.uniform(0.0, 30.0, 500), rng.uniform(30.0, 60.0, 500)
    gap = rng.uniform(0.0, 20.0, 500)
    minimum, rows = np.minimum(gap, 20.0), np.arange(500)
    enough = supervisor.stopping_distance(w, 1.0, step, theta) - supervisor.stopping_distance(v, 1.0, step, theta) + gap >= 20.0
    for k in range(int(150 / step)):
        ahead = Targets(rows, gap, w, np.ones(500, bool), np.full(500, TRAIN), np.full(500, -1))
        verdict = supervisor.verdict(params, v, ahead, supervisor.no_limits(), step, theta)
        a, _ = supervisor.applied(verdict, np.full(500, 9.0))
        its_way, w = moved(
            np.zeros(500), w, np.where(k > 20, -1.0, np.nan_to_num(demanded(rng, k, 500)).clip(-1.0, 1.0)), step, theta
        )
        own_way, v = moved(np.zeros(500), v, a, step, theta)
        gap = gap + its_way - own_way
        assert np.all((gap >= minimum - ROUNDING)[enough])
        minimum = np.maximum(minimum, np.minimum(gap, 20.0))


@pytest.mark.campaign
@pytest.mark.parametrize("curve", ["relative", "absolute"])
@pytest.mark.parametrize("seed", range(10))
def test_columns_keep_the_margin_in_long_runs(seed, curve):
    rng = np.random.default_rng(100 + seed)
    step, theta = float(rng.uniform(0.2, 2.0)), float(rng.choice([0.0, 0.5]))
    emergency = float(rng.uniform(0.4, 2.0))
    params = Params(
        mode="on", curve=curve, emergency_mps2=emergency, service_mps2=float(rng.uniform(0.3, 1.0)) * emergency,
        margin_m=float(rng.uniform(0.0, 40.0)), greatest_mps2=float(rng.uniform(0.3, 2.0)),
    )  # fmt: skip
    driven(seed, 1000, params, step, theta, 3000.0 * step)


@pytest.mark.parametrize(("theta", "step"), CASES)
def test_without_supervisor_the_same_drivers_collide(theta, step):
    params = Params(emergency_mps2=1.1)
    rng = np.random.default_rng(1)
    world, x, v = start(rng, 100, params, step, theta)
    rows, worst = np.flatnonzero(~world.first), np.full(len(v), np.inf)
    for k in range(int(200.0 / step)):
        a = np.clip(np.nan_to_num(demanded(rng, k, len(v))), -1.1, 1.0)
        x, v = moved(x, v, a, step, theta)
        worst[rows] = np.minimum(worst[rows], x[rows - 1] - world.length[rows - 1] - x[rows])
    for share, driver in enumerate(DRIVERS):
        assert worst[shares(len(v)) == share].min() < 0.0, driver


@pytest.mark.parametrize(("theta", "step"), CASES)
def test_opposing_trains_never_meet_and_come_as_near_as_they_may(theta, step):
    params = Params(mode="on", emergency_mps2=0.9, service_mps2=0.6, margin_m=15.0)
    rng = np.random.default_rng(0)
    pairs = np.arange(500)
    v = rng.uniform(0.0, 60.0, 1000)
    way = supervisor.stopping_distance(v, params.emergency_mps2, step, theta)
    apart = way[:500] + way[500:] + 15.0 + rng.choice([0.0, 1.0, 500.0], 500)
    drivers = np.argsort(np.tile(pairs, 2), kind="stable")  # a pair has one driver
    for k in range(int(400 / step)):
        verdict = supervisor.verdict(params, v, facing(pairs, pairs + 500, apart, v), supervisor.no_limits(), step, theta)
        wanted = np.empty(1000)
        wanted[drivers] = demanded(rng, k, 1000)
        a, _ = supervisor.applied(verdict, wanted)
        made, v = moved(np.zeros(1000), v, a, step, theta)
        apart = apart - made[:500] - made[500:]
        assert apart.min() > 15.0 - ROUNDING, k
    assert apart[DRIVERS.index("full traction") * 100 :][:100].max() < 16.0


@pytest.mark.parametrize(("theta", "step"), CASES)
def test_points_are_reached_and_not_passed_and_the_train_starts_again_when_they_go(theta, step):
    params = Params(mode="on")
    rng = np.random.default_rng(3)
    for kind in (STOP, SWITCH, END, TRAIN):
        v = rng.uniform(0.0, 80.0, 300)
        at = supervisor.stopping_distance(v, 0.7, step, theta) + rng.choice([0.0, 0.3, 2000.0], 300) + params.margin_m
        x, rows = np.zeros(300), np.arange(300)
        keeps = 0.0 if kind == STOP else params.margin_m
        hardest = 0.0
        for _ in range(int(400 / step)):
            verdict = supervisor.verdict(params, v, fixed(rows, at - x, kind), supervisor.no_limits(), step, theta)
            a, _ = supervisor.applied(verdict, np.full(300, 9.0))
            hardest = min(hardest, a.min())
            assert kind != STOP or not verdict.emergency.any()
            x, v = moved(x, v, a, step, theta)
            assert np.all(at - x > keeps - ROUNDING)
        assert np.all(v < 1e-6) and np.all(at - x < keeps + 1e-3), KINDS[kind]
        assert hardest > (-0.7 if kind == STOP else -1.0) - 1e-6
        verdict = supervisor.verdict(params, v, supervisor.no_targets(), supervisor.no_limits(), step, theta)
        assert np.all(verdict.maximum == params.greatest_mps2)


@pytest.mark.parametrize(("theta", "step"), CASES)
def test_a_lower_limit_is_reached_with_the_service_brake_at_its_begin(theta, step):
    params = Params(mode="on")
    rng = np.random.default_rng(4)
    u, v = rng.uniform(0.0, 60.0, 300), rng.uniform(0.0, 80.0, 300)
    x, rows, at = np.zeros(300), np.arange(300), 9000.0 + rng.uniform(0.0, 50.0, 300)
    passed = np.full(300, np.nan)
    for _ in range(int(1200 / step)):
        verdict = supervisor.verdict(params, v, supervisor.no_targets(), Limits(rows, at - x, u), step, theta)
        a, _ = supervisor.applied(verdict, np.full(300, 9.0))
        assert a.min() > -0.7 - 1e-6
        before, old = x, v
        x, v = moved(x, v, a, step, theta)
        crossing = (before <= at + ROUNDING) & (x > at + ROUNDING)
        assert np.all(old[crossing] <= u[crossing] + ROUNDING) and np.all(v[crossing] <= u[crossing] + ROUNDING)
        passed[crossing] = old[crossing]
    there = ~np.isnan(passed)
    assert there.mean() > 0.9 and np.all(passed[there] > u[there] - 0.7 * step - ROUNDING)  # not slower than it must be


@pytest.mark.parametrize(("theta", "step"), CASES)
def test_the_greatest_acceleration_is_the_greatest_that_is_safe(theta, step):
    """A little more, and full braking from then on ends within the margin, if the train ahead brakes now."""
    params = Params(mode="on", greatest_mps2=50.0)
    rng = np.random.default_rng(5)
    v, w = rng.uniform(0.0, 70.0, 4000), rng.uniform(0.0, 70.0, 4000) * (rng.random(4000) < 0.8)
    way = [supervisor.stopping_distance(s, 1.0, step, theta) for s in (v, w)]
    room = 20.0 + np.maximum(0.0, way[0] - way[1]) + rng.exponential(50.0, 4000)
    targets = Targets(np.arange(4000), room, w, np.ones(4000, bool), np.full(4000, TRAIN), np.full(4000, -1))
    maximum = supervisor.verdict(params, v, targets, supervisor.no_limits(), step, theta).maximum
    for extra, safe in ((0.0, True), (1e-3, False)):
        at, speed, rear, ahead = np.zeros(4000), v.copy(), room.copy(), w.copy()
        at, speed = moved(at, speed, maximum + extra, step, theta)
        rear, ahead = moved(rear, ahead, np.full(4000, -1.0), step, theta)
        minimum = rear - at
        for _ in range(int(400 / step)):
            at, speed = moved(at, speed, np.full(4000, -1.0), step, theta)
            rear, ahead = moved(rear, ahead, np.full(4000, -1.0), step, theta)
            minimum = np.minimum(minimum, rear - at)
        kept = minimum > 20.0 - 1e-7
        moves = (v + maximum * step > 0.0) & (maximum < 50.0)
        assert np.all(kept) if safe else not np.any(kept & moves & (theta > 0.0)) and np.mean(kept[moves]) < 0.05
