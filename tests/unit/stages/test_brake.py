"""Orders to brake: under every kind of law and plant, to a stand, for a time, and what of them is a mistake."""

from __future__ import annotations

import json

import numpy as np
import pytest

from trainctl.errors import InputError
from trainctl.scenario.build import open_scenario
from trainctl.signals import SPEED

SHORT = {"run.duration_s": 60, "run.sub_step_s": 0.1}


def brake(**more):
    return {"event": [{"kind": "brake", "train": "1", "time_s": 10.0, "deceleration_mps2": 0.5, **more}]}


def speeds(run, train="1"):
    rows = run.trains[run.trains["train"] == train]
    return dict(zip(rows["time_s"], rows["speed_mps"], strict=True))


def events(run, *kinds):
    lines = map(json.loads, (run.folder / "events.jsonl").read_text().splitlines())
    return [(e["time_s"], e["kind"], e.get("train")) for e in lines if e["kind"] in kinds]


def test_a_point_train_brakes_as_ordered_and_the_law_has_it_back(finished):
    """The clamped speed of the law's own model does not matter: who brakes, brakes."""
    run = finished("robust_constrained_undisturbed", "numeric", **{"run.duration_s": 40}, **brake(until_s=20.0))
    v, step = speeds(run), 0.8
    starts = min(t for t in v if t >= 10.0 - 1e-9)
    np.testing.assert_allclose(v[round(starts + 5 * step, 9)], v[round(starts, 9)] - 0.5 * 5 * step, atol=1e-9)
    ends = min(t for t in v if t >= 20.0 - 1e-9)
    assert v[round(ends + 2 * step, 9)] > v[round(ends, 9)]
    assert events(run, "brake", "brake_released") == [(round(starts, 9), "brake", "1"), (round(ends, 9), "brake_released", "1")]


@pytest.mark.parametrize("law", ["relative_braking", "model_predictive", "time_headway"])
def test_a_train_of_units_stops_and_stands_for_good(finished, law):
    run = finished(law, "numeric", **{**SHORT, "run.duration_s": 150}, **brake(deceleration_mps2=0.8))
    v = speeds(run)
    np.testing.assert_allclose([v[11.0], v[20.0]], [v[10.0] - 0.8, v[10.0] - 8.0], atol=1e-6)
    assert v[90.0] == 0.0 == v[150.0]
    rows = run.trains[run.trains["train"] == "1"]
    assert np.ptp(rows[rows["time_s"] >= 90.0]["position_m"]) == 0.0
    assert events(run, "limit") == [] and (run.trains["gap_m"].dropna() > 5.0).all()


def test_the_reference_of_the_others_does_not_change(finished):
    """Without messages they know nothing of it, and run on."""
    quiet = {**SHORT, "topology.loss": 0.999999, "run.seed": 1}
    run = finished("time_headway", "numeric", **quiet, **brake())
    calm = finished("time_headway", "numeric", **quiet)
    assert speeds(run)[60.0] < 40.0 and speeds(calm)[60.0] > 59.0
    assert speeds(run, "2") == speeds(calm, "2")


def test_brakes_give_what_they_have(finished):
    """5 m/s2 are ordered, 64 kN of 80 t and the running resistance brake."""
    v = speeds(finished("time_headway", "numeric", **SHORT, **brake(deceleration_mps2=5.0)))
    assert 0.8 < v[10.0] - v[11.0] < 1.0


def test_without_a_number_it_is_full_braking(finished):
    p = open_scenario("time_headway", brake(deceleration_mps2=None))
    v = speeds(finished("time_headway", "numeric", **SHORT, **brake(deceleration_mps2=None)))
    np.testing.assert_allclose(v[20.0] - v[30.0], 10.0 * p.supervision.emergency_mps2, atol=1e-6)


def test_a_train_under_a_continuous_law_brakes_too(finished):
    run = finished("emu_finite_time", "numeric", **{"run.duration_s": 30}, **brake(train="1", deceleration_mps2=0.3))
    v = speeds(run)
    np.testing.assert_allclose(v[12.0] - v[20.0], 8.0 * 0.3, atol=0.05)  # couplers swing
    assert events(run, "brake") == [(10.0, "brake", "1")]


def test_of_two_orders_the_harder_one_acts(finished):
    two = [
        {"kind": "brake", "train": "1", "time_s": 10.0, "deceleration_mps2": b, "until_s": t} for b, t in ((0.5, 20.0), (0.2, 30.0))
    ]
    v = speeds(finished("time_headway", "numeric", **SHORT, event=two))
    np.testing.assert_allclose([v[10.0] - v[20.0], v[20.0] - v[30.0]], [5.0, 2.0], atol=1e-6)


@pytest.mark.parametrize(
    ("more", "line"),
    [
        ({"until_s": 10.0}, "event[1]: until_s = 10: must be after time_s = 10"),
        ({"to_track": "3"}, "event[1]: to_track: not with kind = brake"),
        ({"deceleration_mps2": 0.0}, "event[1].deceleration_mps2 = 0.0: input should be greater than 0"),
        ({"train": "9"}, "event[1].train = 9: no such train; there are: 1, 2, 3, 4, 5, 6"),
        ({"kind": "reroute", "to_track": "3"}, "event[1]: deceleration_mps2: not with kind = reroute"),
    ],
)
def test_bad_input(more, line):
    with pytest.raises(InputError) as told:
        open_scenario("time_headway", brake(**more))
    assert len(told.value.mistakes) == 1 and told.value.mistakes[0].endswith(line), told.value.mistakes


def test_sumo_s_own_trains_take_no_orders_to_brake():
    with pytest.raises(InputError, match=r"event\[1\].kind = brake: SUMO's own trains brake by SUMO's rules alone"):
        open_scenario("time_headway", {**brake(), "controller.law": "sumo"})


def test_the_loop_s_state_has_what_acts(finished):
    """A run that is resumed brakes on."""
    from staged import started

    loop, _ = started(open_scenario("time_headway", {**SHORT, **brake()}))
    while loop.time < 12.0:
        loop.step()
    assert loop.state.orders.acting == (1,) and loop.state.own[0, SPEED] < 59.5
