"""Runs side by side against each of them alone: states, extremes, times and counts to the last bit, sums to rounding."""

from __future__ import annotations

import numpy as np
import pytest

from trainctl.ensemble import units
from trainctl.ensemble.stack import alone, kind, stacked
from trainctl.ensemble.steps import simulated
from trainctl.runner import run
from trainctl.scenario.build import open_scenario

#: Metrics that are sums over rows: the order of the summands differs.
SUMS = ("l2_gain", "energy.", "jerk_rms", "_mean_")

#: Measured with errors, a fifth of the messages lost, links that are too long and too short, trains that are too fast.
DISTURBED = {
    "disturbance": [
        {"on": "measurement", "shape": "gaussian", "std_m": 2.0, "amplitude_m": 10.0},
        {"on": "input", "shape": "uniform", "amplitude_mps2": 0.05, "train": [2, 3]},
        {"on": "resistance", "shape": "gust", "error_percent": 20.0, "from_m": 13000.0, "to_m": 14000.0},
    ],
    "topology.loss": 0.2,
    "run.duration_s": 60,
}
CASES = {
    "fully_distributed": ("fully_distributed", DISTURBED),
    "slow_rows": ("fully_distributed", {**DISTURBED, "run.record_every_s": 7.0, "run.control_period_s": 2.0, "run.duration_s": 62}),
    "late": ("fully_distributed", {**DISTURBED, "topology.delay_s": 2.0, "topology.range_m": 9000.0}),
    "bursts": (
        "fully_distributed",
        {
            **DISTURBED,
            "channel": {"good_s": 9.0, "bad_s": 3.0, "delay_spread_s": 1.5, "delay_shape": "exponential"},
        },
    ),
    "seldom": ("robust_constrained", {"run.duration_s": 80, "run.seed": 1, "channel": {"send_beyond_m": 5.0, "send_every_s": 8.0}}),
    "outside": (
        "fully_distributed",
        {
            "disturbance": [
                {"on": "speed", "shape": "uniform", "amplitude_mps": 9.0},
                {"on": "input", "shape": "uniform", "amplitude_mps2": 9.0},
                {"on": "position", "shape": "constant", "amplitude_m": 9.0, "train": [2, 4]},
            ],
            "topology.lower_m": 970.0,
            "topology.upper_m": 8020.0,
            "link": [],
            "run.duration_s": 100,
        },
    ),
    "steps": ("fully_distributed", {"reference": {"table": [[0, 80.0], [20, 80.0], [30, 78.0]]}, "run.duration_s": 60}),
    "robust": ("robust_constrained", {"run.duration_s": 80, "topology.loss": 0.3}),
    "relative": ("robust_constrained", {"controller": {"law": "relative_braking"}, "run.duration_s": 80, "topology.loss": 0.2}),
    "headway": (
        "robust_constrained",
        {"controller": {"law": "time_headway", "acceleration_share": 0.8}, "run.duration_s": 80, "topology.loss": 0.2},
    ),
    "sliding": ("robust_constrained", {"controller": {"law": "sliding_mode"}, "run.duration_s": 80, "topology.loss": 0.2}),
    "predictive": ("robust_constrained", {"controller": {"law": "model_predictive"}, "run.duration_s": 16, "topology.loss": 0.2}),
    "finite_time": ("emu_finite_time", {"run.duration_s": 15}),
    "force_limits": ("emu_force_limits", {"run.duration_s": 10, "bounds.coupler_lower_m": -0.001, "bounds.coupler_upper_m": 0.001}),
    "fault_tolerant": ("fault_tolerant", {"run.duration_s": 12, "run.record_every_s": 2.0}),
    "intermediate": ("fault_tolerant_intermediate", {"run.duration_s": 8}),
    "shared": ("three_tracks", {**DISTURBED, "run.duration_s": 30}),
    "by_radio": ("emu_finite_time", {"run.duration_s": 10, "topology.communication_period_s": 0.5, "topology.loss": 0.3}),
    "cycle": ("robust_constrained_cycle", {"run.duration_s": 80}),
}


def models(name, overrides, count):
    """Runs with seeds of their own, every one from another start."""
    found = []
    for seed in range(count):
        base = open_scenario(name, {**overrides, "run.seed": seed})
        trains = [
            {
                **t.model_dump(exclude_none=True),
                "position_m": t.position_m + 7.3 * seed,
                "speed_mps": t.speed_mps - 0.1 * (seed % 2),
            }
            for t in base.scenario.train
        ]
        trains = [{**t, "speed_mps": max(t["speed_mps"], base.bounds.speed_lower.max())} for t in trains]
        found.append(open_scenario(name, {**overrides, "run.seed": seed, "train": trains}))
    return share(found)


def share(found):
    """Runs of one sweep have one line."""
    from dataclasses import replace

    return [replace(p, line=found[0].line) for p in found]


@pytest.mark.parametrize("case", CASES)
def test_every_run_has_the_numbers_it_has_alone(case, tmp_path):
    runs = models(*CASES[case], 4)
    assert [alone(p) for p in runs] == [None] * 4
    assert len({repr(kind(p)) for p in runs}) == 1
    done = simulated(stacked(runs))
    units = len(runs[0].own)
    for r, p in enumerate(runs):
        one = run(p, tmp_path / str(r), "numeric")
        last = one.trains[one.trains["time_s"] == one.trains["time_s"].max()]
        assert np.array_equal(done.own[r * units + p.leading, 1], last["speed_mps"])
        assert done.why_alone[r] is None
        assert (done.violations[r], done.overspeeds[r]) == (one.info["violations"], one.info["overspeeds"])
        known = {k: v for k, v in one.metrics.items() if "/" not in k and isinstance(v, int | float)}
        found = {k: float(v[r]) for k, v in done.metrics.items() if not np.isnan(v[r])}
        assert found.keys() == known.keys()
        for key, value in known.items():
            if any(part in key for part in SUMS):
                assert found[key] == pytest.approx(value, rel=1e-12, abs=1e-12), key
            else:
                assert found[key] == value, key


def test_the_cases_violate_something_and_are_too_fast_somewhere():
    """Else the counts above would be compared where there are none."""
    done = simulated(stacked(models(*CASES["outside"], 4)))
    assert done.violations.min() >= 6
    assert done.overspeeds.max() >= 1
    assert max(done.metrics[f"bounds.spacing_{side}_margin_m"].min() for side in ("lower", "upper")) < 0.0


def test_a_run_with_numbers_that_no_log_may_have_is_run_alone(monkeypatch):
    """It is refused there; none of these is infinite, and no state is among them."""
    runs, count = models("emu_finite_time", {"run.duration_s": 3}, 4), units.count

    def spoilt(stack, fixed, row, tally, counts):
        row.extremes.energy[3, 2] = 1e61
        row.extremes.coupler_max[2 * 12] = 1e61
        row.extremes.watched_min[3 * 3 + 1, 0] = -1e61
        count(stack, fixed, row, tally, counts)

    monkeypatch.setattr(units, "count", spoilt)
    assert simulated(stacked(runs)).why_alone == (None, *["its numbers are no longer finite"] * 3)


def test_a_run_does_not_depend_on_those_beside_it():
    runs = models(*CASES["fully_distributed"], 5)
    many, few = simulated(stacked(runs)), simulated(stacked(runs[3:]))
    for key, value in few.metrics.items():
        assert np.array_equal(value, many.metrics[key][3:], equal_nan=True), key


@pytest.mark.parametrize(
    ("name", "overrides", "words"),
    [
        ("fully_distributed", {"supervisor.mode": "on"}, "supervisor.mode"),
        (
            "fully_distributed",
            {"event": [{"kind": "reroute", "train": 2, "crossover": "leave", "time_s": 9.0}]},
            "events during the run",
        ),
        ("fault_tolerant_noise", {}, "noise"),
        ("merging", {}, "come and go"),
    ],
)
def test_what_cannot_be_stacked_is_said(name, overrides, words):
    assert words in str(alone(open_scenario(name, overrides)))


def test_runs_that_leave_the_common_course_are_named():
    """One whose trains touch, one that changes track; the others keep their numbers."""
    calm = {"run.duration_s": 100, "disturbance": []}
    base = open_scenario("robust_constrained", calm)

    def with_second(position, speed):
        trains = [t.model_dump(exclude_none=True) for t in base.scenario.train]
        trains[1] |= {"position_m": position, "speed_mps": speed}
        return open_scenario("robust_constrained", {**calm, "train": trains})

    sound, rams = with_second(18500.0, 0.0), with_second(26800.0, 80.0)
    done = simulated(stacked(share([sound, rams, sound])))
    assert done.why_alone == (None, "trains touch or pass one another", None)
    assert np.array_equal(done.metrics["formation.overshoot_m"][0], done.metrics["formation.overshoot_m"][2])
    crossing = open_scenario("fully_distributed", {"run.duration_s": 1100})
    assert simulated(stacked([crossing])).why_alone == ("a train changes track",)
