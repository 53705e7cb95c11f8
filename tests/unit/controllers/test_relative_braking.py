"""Relative braking distance: the safe speed, what is left at standstill, what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strings import LENGTH_M, String, first_brakes, scene

from trainctl.controllers import relative_braking as law


def test_the_distance_is_that_of_the_difference_of_two_stops() -> None:
    found = law.distance(40.0, np.array([0.5]), 30.0, np.array([0.8]), 2.0)
    np.testing.assert_allclose(found, 80.0 + 1600.0 / 1.0 - 900.0 / 1.6)


def test_at_the_safe_speed_a_train_asks_for_nothing() -> None:
    """Wherever the train ahead is and whatever its speed: a distance of M + S gives u = 0."""
    sc = scene(2, 1500.0, braking=np.array([0.6, 0.9]))
    p = law.Params()
    constants, string = law.constants(p, sc), String(law, p, sc)
    for v_l, v in ((40.0, 40.0), (20.0, 33.0), (0.0, 15.0)):
        at = law.distance(v, np.array([0.9]), v_l, np.array([0.6]), p.reaction_s)[0] + constants.M[1]
        string.own = np.array([[0.0, v_l], [-at, v]])
        assert string.step().acceleration[1] == pytest.approx(0.0, abs=1e-9)


@settings(max_examples=30)
@given(
    first=st.floats(0.4, 1.2), others=st.floats(0.4, 1.2), more=st.floats(0.0, 300.0), when=st.integers(1, 60),
    reaction=st.floats(1.0, 4.0),
)  # fmt: skip
def test_nobody_is_touched_when_the_first_train_brakes_fully(first, others, more, when, reaction) -> None:
    """Whatever the brakes, from the minimum spacing on: the messages are fresh, so the reaction time is time enough."""
    n = 4
    braking = np.array([first, *[others] * (n - 1)])
    p, top = law.Params(reaction_s=reaction), 40.0
    minimum = LENGTH_M + p.margin_m + law.distance(top, np.array([others]), top, np.array([max(first, others)]), reaction)[0]
    sc = scene(n, max(minimum, LENGTH_M + p.margin_m + reaction * top) + 1e-6 + more, braking=braking)
    assert law.violations(p, sc) == []
    string = String(law, p, sc)
    for k in range(400):
        string.step(first_brakes(n, first) if k >= when else None)
        assert np.all(string.spacing > LENGTH_M), (k, string.spacing)
    assert np.all(string.own[:, 1] < 0.5)


def test_what_is_refused() -> None:
    sc = scene(2, 300.0)
    assert law.violations(law.Params(), sc) == []
    assert law.violations(law.Params(), scene(2, 280.0)) == [
        "link[1,2].desired_m = 280: must be at least 290 at 40 m/s: reaction and difference of braking distances 80, the train ahead"
        " 200, margin_m 10"
    ]
    assert law.violations(law.Params(reaction_s=0.5), sc) == [
        "controller.reaction_s = 0.5: must be at least one control period of 1 s",
        "controller.follow_s = 0.25: must be at least half a control period of 1 s",
    ]
    unknown = sc._replace(consists=sc.consists._replace(braking=np.full(2, np.inf)))
    assert law.violations(law.Params(), unknown)[0].startswith(
        "controller.braking_mps2: missing; train 1 has neither braking_n nor"
    )
    assert law.violations(law.Params(braking_mps2=0.5), unknown) == []
    assert law.report(law.Params(), sc, ()) == [
        "relative braking distance with reaction 80 m at 40 m/s; the absolute one is 1080 m"
    ]
