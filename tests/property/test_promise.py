"""Trains that do not do what is ordered, within what is assumed of them, are kept apart all the same."""

from __future__ import annotations

import numpy as np
import pytest

from trainctl.railway import supervisor
from trainctl.railway.supervisor import TRAIN, Assumed, Limits, Params, Targets

PAIRS = 400
RULES = Params(mode="on", emergency_mps2=1.0, service_mps2=0.7, margin_m=20.0)
LIMIT = 60.0


def assumed(rng: np.random.Generator, step: float, *, disturbed: bool, lag: bool) -> Assumed:
    """Numbers of 2 x PAIRS trains: leaders, then followers; brakes weaker than ordered by up to a half."""
    n = 2 * PAIRS
    scatter = rng.uniform(0.0, 0.2, n) * disturbed
    given, blur = rng.uniform(0.5, 1.0, n), 0.5 * disturbed
    return Assumed(
        braking=given - scatter, hardest=1.0 + scatter, scatter=scatter, drift=blur + rng.uniform(0.0, 0.3, n) * disturbed,
        lag=rng.uniform(0.1, 3.0, n) * lag, surge=np.zeros(n), uncertainty=rng.uniform(0.0, 8.0, n) * disturbed, blur=blur,
    )  # fmt: skip


def least_gap(
    relied: Assumed, believed: Assumed, step: float, theta: float, seed: int, seconds: float = 250.0
) -> tuple[float, float]:
    """Minimum gap and maximum overspeed of pairs whose trains do the worst that ``relied`` allows, judged by what is ``believed``."""
    rng = np.random.default_rng(seed)
    n = 2 * PAIRS
    lead, follow = np.arange(PAIRS), np.arange(PAIRS, n)
    v = rng.uniform(0.0, 55.0, n)
    a = np.zeros(n)
    given = relied.braking + relied.scatter
    quick = v + relied.drift + relied.lag * relied.braking
    # Safe, and no more than that, for most.
    away = supervisor.stopping_distance(np.maximum(v - relied.blur, 0.0)[lead], relied.hardest[lead], step, theta)
    needed = supervisor.stopping_distance(quick[follow], relied.braking[follow], step, theta) - away
    slack = rng.choice([0.0, 0.0, 300.0], PAIRS)
    gap = RULES.margin_m + 2.0 * (relied.uncertainty[lead] + relied.uncertainty[follow]) + np.maximum(needed, 0.0) + slack
    minimum, over = np.inf, -np.inf
    for k in range(int(seconds / step)):
        error = rng.choice([-1.0, 1.0], n) * relied.uncertainty
        room = gap + error[lead] - error[follow]
        measured = np.maximum(v + rng.choice([-1.0, 1.0], n) * relied.blur, 0.0)
        targets = Targets(follow, room, measured[lead], np.ones(PAIRS, bool), np.full(PAIRS, TRAIN), lead)
        limits = Limits(np.arange(n), np.full(n, -1.0), np.full(n, LIMIT + relied.blur))
        verdict = supervisor.verdict(RULES, measured, targets, limits, step, theta, believed, a)
        # Leaders stop and go, followers press on; what disturbs them does so at the worst.
        wanted = np.where(np.arange(n) < PAIRS, np.where((k * step) // 40.0 % 2 == 0, -9.0, 9.0), 9.0)
        u, _ = supervisor.applied(verdict, wanted)
        ordered = np.maximum(u, -given)
        bias = np.where(np.arange(n) < PAIRS, -relied.scatter, relied.scatter)
        push = np.where(np.arange(n) < PAIRS, 0.0, relied.drift - relied.blur)
        if relied.lag.any():
            ways = np.zeros(n)
            for _ in range(20):  # the actuator within the step
                h = step / 20
                after = a + (ordered + bias - a) * (1.0 - np.exp(-h / np.maximum(relied.lag, 1e-9)))
                new = np.maximum(v + 0.5 * (a + after) * h, 0.0)
                ways += 0.5 * (v + new) * h
                v, a = new, np.where((new <= 0.0) & (after < 0.0), 0.0, after)
        else:
            after = np.maximum(v + (ordered + bias) * step, 0.0)
            ways, v = ((1.0 - theta) * v + theta * after) * step, after
        ways += np.where(v > 0.0, push * step, 0.0)
        gap = gap + ways[lead] - ways[follow]
        minimum, over = min(minimum, gap.min()), max(over, v.max() - LIMIT)
    return float(minimum), float(over)


CASES = [(0.0, 1.0, False), (0.5, 1.0, False), (0.5, 0.2, False), (0.0, 5.0, False), (0.5, 1.0, True), (0.5, 0.5, True)]


@pytest.mark.parametrize(("theta", "step", "lag"), CASES)
@pytest.mark.parametrize("disturbed", [False, True])
def test_what_is_assumed_is_enough(theta, step, lag, disturbed):
    relied = assumed(np.random.default_rng(7), step, disturbed=disturbed, lag=lag)
    minimum, over = least_gap(relied, relied, step, theta, 1)
    assert minimum > RULES.margin_m - 0.5 * lag - 1e-6
    assert over < 1e-6 + 0.1 * lag + 2.0 * relied.blur


@pytest.mark.parametrize("forgotten", ["braking", "hardest", "scatter", "drift", "lag", "uncertainty"])
def test_each_assumption_matters(forgotten):
    """The same trains, judged as if one of the assumptions were not there, come too near."""
    relied = assumed(np.random.default_rng(7), 1.0, disturbed=True, lag=True)
    perfect = supervisor.as_ordered(RULES.emergency_mps2, 2 * PAIRS)
    believed = relied._replace(**{forgotten: getattr(perfect, forgotten)})
    enough, _ = least_gap(relied, relied, 1.0, 0.5, 1)
    minimum, _ = least_gap(relied, believed, 1.0, 0.5, 1)
    assert enough > RULES.margin_m - 0.5 > minimum
