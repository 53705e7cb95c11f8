"""Zhang et al., fully distributed control: the example of the paper to 2400 s, its claims, and what breaks when it is left.

Trains carry the paper's numbers. The paper prints no table and its figures are not in its text: what is compared are its claims and
its parameters. Where the print is wrong the reading is named.
"""

from __future__ import annotations

import numpy as np
import pytest

from trainctl.claims.fully_distributed import (
    AFTER,
    BEFORE,
    END,
    SWITCH,
    TOPOLOGIES,
    V_R,
    Edge,
    History,
    N,
    next_to,
    run,
    scene,
    two_apart,
)
from trainctl.controllers import fully_distributed as law


@pytest.fixture(scope="module", params=list(TOPOLOGIES))
def example(request: pytest.FixtureRequest) -> tuple[list[Edge], list[Edge], History]:
    before, after = TOPOLOGIES[request.param]
    return before, after, run(before, after)


def test_assumptions_and_start_condition_hold_at_the_start_and_at_the_join(example: tuple[list[Edge], list[Edge], History]) -> None:
    before, after, h = example
    strict = law.Params(join="strict")
    assert law.violations(strict, scene(before)) == []
    joined = np.column_stack((h.x[SWITCH], h.v[SWITCH]))
    assert law.violations(strict, scene(after, joined, time=float(SWITCH))) == []


def test_o1_every_spacing_stays_within_its_bounds(example: tuple[list[Edge], list[Edge], History]) -> None:
    before, after, h = example
    assert max(h.beyond(e, 0, SWITCH) for e in before) == pytest.approx(-900.0)  # x_34(0) = 1000, lower bound 100: never closer
    # the nearest afterwards is the join itself: x_45 = 985.53 (985.69 with the extra edges)
    assert -886.0 < max(h.beyond(e, SWITCH, END) for e in after) < -885.0


def test_o2_speed_and_input_stay_within_their_bounds(example: tuple[list[Edge], list[Edge], History]) -> None:
    _, _, h = example
    assert h.v.min() == pytest.approx(75.0, abs=1e-9)
    assert h.v.max() == pytest.approx(85.0, abs=1e-9)
    np.testing.assert_allclose([h.u.min(), h.u.max()], [-6.81701, 9.16316], atol=1e-5)  # of -11 and 11


def test_o3_formation_is_reached_before_the_switch_and_again_after_it(example: tuple[list[Edge], list[Edge], History]) -> None:
    before, after, h = example
    # 420 s and 1420 s on the line, 417 s and 1419 s with the extra edges
    assert h.settled(before, 0, SWITCH) in (417, 420)
    assert h.settled(after, SWITCH, END) in (419, 420)
    np.testing.assert_allclose(h.v[[SWITCH - 1, END]], V_R, atol=1e-9)


def test_only_the_speed_bound_ever_acts_in_the_example(example: tuple[list[Edge], list[Edge], History]) -> None:
    _, _, h = example
    assert h.acted() == {"beta"}


def test_spacing_of_1_and_3_allows_the_switch_at_any_time(example: tuple[list[Edge], list[Edge], History]) -> None:
    """The edge (1,3) needs 5100 m, which the bounds of (1,2) and (2,3), 100 m each, do not give."""
    before, _, h = example
    x13 = h.spacing(1, 3)[: SWITCH + 1]
    assert x13.min() == pytest.approx(9960.0 if len(before) == 4 else 9980.0, abs=0.01)
    assert x13.max() == pytest.approx(11004.0, abs=1e-6)


def test_train_2_is_where_the_crossover_must_be(example: tuple[list[Edge], list[Edge], History]) -> None:
    before, _, h = example
    expected = [99905.531254, 99985.531254] if len(before) == 4 else [99905.689236, 99985.689236]
    np.testing.assert_allclose(h.x[[999, 1000], 1], expected, atol=1e-6)


def test_switching_one_period_later_changes_no_extreme() -> None:
    early, late = run(BEFORE, AFTER), run(BEFORE, AFTER, switch=SWITCH + 1, join=(89080.0, 80.0))
    for q in ("v", "u"):
        for extreme in (np.min, np.max):
            assert extreme(getattr(early, q)) == extreme(getattr(late, q))
    assert early.settled(AFTER, SWITCH, END - 1) == late.settled(AFTER, SWITCH + 1, END)


def test_printed_upper_bound_of_1000_m_contradicts_assumption_2_2_and_13() -> None:
    as_printed = [*(next_to(i, i + 1, 1000.0) for i in (1, 2, 3)), two_apart(4, 6)]
    found = law.violations(law.Params(), scene(as_printed))
    assert sum("must be above desired_m = 5000" in line for line in found) == 3
    assert "link[1,2].upper_m = 1000: spacing one period ahead, eq. (13), is 3003 m, too large" in found
    assert "link[2,3].upper_m = 1000: spacing one period ahead, eq. (13), is 8001 m, too large" in found


def test_smallest_symmetric_input_bound_is_5_1933() -> None:
    assert law.violations(law.Params(), scene(BEFORE, inputs=5.19334)) == []
    assert law.violations(law.Params(), scene(BEFORE, inputs=5.19333)) != []


def test_an_input_bound_that_is_only_just_legal_leaves_no_room_under_printed_eta() -> None:
    """|u| <= 5.2: room 0.0067 m/s, 3267 m of error left after 2000 s. At its own speed a train has the whole 5 m/s."""
    printed = run(periods=2000, inputs=5.2)
    assert max(abs(printed.spacing(e[0], e[1])[-1] - e[2]) for e in BEFORE) == pytest.approx(3267.09, abs=0.01)
    own = run(periods=1000, inputs=5.2, params=law.Params(eta="own_speed"))
    assert own.settled(BEFORE, 0, 1000) == 420
    assert np.abs(own.u).max() < 5.2 + 1e-9


@pytest.mark.parametrize(("inputs", "through"), [(2.0, -11060.7), (1.0, -15058.7)])
def test_without_assumption_2_4_trains_run_through_each_other(inputs: float, through: float) -> None:
    h = run(periods=2000, inputs=inputs)
    assert min(h.spacing(e[0], e[1]).min() for e in BEFORE) == pytest.approx(through, abs=0.1)
    assert np.abs(h.u).max() > 4 * inputs - 1e-9
    assert law.violations(law.Params(), scene(BEFORE, inputs=inputs)) != []


@pytest.mark.parametrize("held", [1, 10])
def test_realistic_input_bound_with_a_control_period_of_10_s(held: int) -> None:
    """|u| <= 0.7 m/s2: 1340 s with printed eta, 730 s (held 10 steps: 720 s) with that of the own speed."""
    room = (law.Params(), law.Params(eta="own_speed"))
    printed, own = (run(periods=300, period=10.0, held=held, inputs=0.7, params=p) for p in room)
    assert 10 * printed.settled(BEFORE, 0, 300) == 1340
    assert 10 * own.settled(BEFORE, 0, 300) == (730 if held == 1 else 720)
    for h in (printed, own):
        assert np.abs(h.u).max() <= 0.7 + 1e-9
        assert max(h.beyond(e, 0, 300) for e in BEFORE) < 0.0


def test_positions_alone_oscillate_for_ever() -> None:
    """z = x: a period of 6 s, 1.4 m, 0.70 m/s. Relative positions are not enough, whatever the paper says."""
    h = run(periods=2000, lead=1.0)
    late = slice(-60, None)
    assert np.abs(h.v[late] - V_R).max() == pytest.approx(0.703, abs=1e-3)
    assert max(np.abs(h.spacing(e[0], e[1])[late] - e[2]).max() for e in BEFORE) == pytest.approx(1.406, abs=1e-3)
    np.testing.assert_allclose(h.v[-60:-6], h.v[-54:], atol=1e-9)


def test_printed_law_on_exactly_integrated_trains_ripples_for_ever() -> None:
    h = run(periods=2000, plant="exact", lead=0.0)
    assert np.abs(h.v[-50:] - V_R).max() == pytest.approx(0.117, abs=1e-3)
    np.testing.assert_allclose(h.v[-50:-2], h.v[-48:], atol=1e-9)


def test_printed_law_on_sumo_s_own_update_swings_between_the_speed_bounds_for_ever() -> None:
    """Handing the new speed to SUMO instead of the displacement: 75, 85, 75 ... m/s, spacings +-18 m."""
    h = run(periods=2000, plant="sumo", lead=0.0)
    assert [h.v[-50:, :4].min(), h.v[-50:, :4].max()] == pytest.approx([75.0, 85.0], abs=1e-9)
    assert np.abs(h.u[-50:]).max() == pytest.approx(10.16, abs=0.01)
    assert max(np.abs(h.spacing(e[0], e[1])[-50:] - e[2]).max() for e in BEFORE) == pytest.approx(18.4, abs=0.05)


@pytest.mark.parametrize(("plant", "held"), [("exact", 1), ("sumo", 1), ("sumo", 5), ("euler", 5)])
def test_lead_of_the_plant_mends_that(plant: str, held: int) -> None:
    h = run(periods=1000, plant=plant, held=held)
    assert h.settled(BEFORE, 0, 1000) in (419, 420, 421)
    np.testing.assert_allclose(h.v[-50:], V_R, atol=1e-9)


def test_desired_distances_must_close_around_a_cycle_without_chords() -> None:
    """Transitivity on triangles says nothing about a cycle of four: 1000 m too much leaves every edge 250 m off."""
    cycle = [next_to(1, 2), next_to(2, 3), next_to(3, 4), (1, 4, 16000.0, 100.0, 20000.0)]
    (found,) = law.violations(law.Params(), scene(cycle))
    assert "around the cycle" in found
    h = run(cycle, periods=1500)
    errors = [h.spacing(e[0], e[1])[-1] - e[2] for e in cycle]
    np.testing.assert_allclose(errors, [250.0, 250.0, 250.0, -250.0], atol=1e-6)


def test_a_wrong_drag_model_costs_little_and_does_not_accumulate() -> None:
    alike = run(periods=2000, factor=np.full(N, 1.2))
    np.testing.assert_allclose(alike.v[-1] - V_R, -0.035227, atol=1e-6)
    assert 75.0 - alike.v.min() == pytest.approx(0.0366, abs=1e-4)
    less = run(periods=2000, factor=np.full(N, 0.8))
    assert less.v.max() - 85.0 == pytest.approx(0.0387, abs=1e-4)  # 20 % of f(85), beyond the speed bound
    mixed = run(periods=2000, factor=np.array([1.2, 1.2, 0.8, 0.8, 1.0, 0.8]))
    assert max(abs(mixed.spacing(e[0], e[1])[-1] - e[2]) for e in BEFORE) == pytest.approx(0.264, abs=1e-3)


def test_a_join_35_m_behind_is_outside_13_and_the_ratchet_makes_it_no_worse() -> None:
    h = run(BEFORE, AFTER, periods=1500, join=(89950.0, 80.0))
    x45 = h.spacing(4, 5)[SWITCH:]
    assert x45.min() == x45[0] == pytest.approx(35.53, abs=0.01)
    assert np.sum(x45 < 100.0) == 8
    assert max(h.beyond(e, SWITCH, 1500) for e in AFTER if e[:2] != (4, 5)) < 0.0
    own = np.column_stack((h.x[SWITCH], h.v[SWITCH]))
    found = law.violations(law.Params(join="strict"), scene(AFTER, own, time=float(SWITCH)))
    assert any(line.startswith("link[4,5].lower_m = 100: spacing") for line in found)


def test_a_join_at_60_mps_needs_more_input_than_there_is() -> None:
    """Why a joiner must come within the speed band."""
    h = run(BEFORE, AFTER, periods=SWITCH + 1, join=(89000.0, 60.0))
    assert h.u[SWITCH, 4] == pytest.approx(15.1, abs=0.05)
    own = np.column_stack((h.x[SWITCH], h.v[SWITCH]))
    found = law.violations(law.Params(), scene(AFTER, own, time=float(SWITCH)))
    assert found == ["train[5].speed_mps = 60: below speed_lower_mps = 75"]
