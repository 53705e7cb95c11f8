"""Speed limits that change by the clock."""

from __future__ import annotations

import numpy as np

from trainctl.railway.signs import announced, falling, highest, in_force, signs

BASE = np.array([40.0, 30.0])
SIGNS = signs([(100.0, "a", 10.0), (200.0, "a", 40.0), (200.0, "b", 50.0), (50.0, "elsewhere", 1.0)], {"a": 0, "b": 1})


def test_a_sign_holds_from_its_time_on():
    assert in_force(SIGNS, BASE, 99.9).tolist() == [40.0, 30.0]
    assert in_force(SIGNS, BASE, 100.0).tolist() == [10.0, 30.0]
    assert in_force(SIGNS, BASE, 200.0).tolist() == [40.0, 50.0]
    assert highest(SIGNS, BASE).tolist() == [40.0, 50.0]


def test_who_keeps_to_what_is_announced_is_never_too_fast():
    step, rate, v = 0.5, 0.5, 40.0
    for k in range(600):
        t = k * step
        assert v <= in_force(SIGNS, BASE, t)[0] + 1e-9
        limit = announced(SIGNS, BASE, t, step, rate)[0]
        assert limit >= v - rate * step - 1e-9  # it need not brake harder
        v = min(v + 0.3 * step, limit)
    assert v > 39.9


def test_without_signs_the_net_holds():
    assert announced(signs([], {}), BASE, 0.0, 1.0, 0.5) is BASE


def test_an_edge_falls_while_a_lower_limit_is_approached_and_not_after():
    for t, falls in ((20.0, False), (50.0, True), (99.0, False), (150.0, False)):
        limit = announced(SIGNS, BASE, t, 1.0, 0.5)
        assert falling(SIGNS, BASE, t, 1.0, limit).tolist() == [falls, False]
    early = announced(SIGNS, BASE, 79.0, 1.0, 0.5, 10.0)
    assert early[0] == 10.0 + 0.5 * 10.0  # as if it came at 90 s
    assert not falling(signs([], {}), BASE, 0.0, 1.0, BASE).any()
