"""The other three papers and their variants on tracks, coupled to SUMO: what each run must show, read from its log."""

from __future__ import annotations

import numpy as np
import pytest

WITH_NUMERIC_TWIN = [
    "robust_constrained", "robust_constrained_undisturbed", "robust_constrained_cycle", "robust_constrained_worst",
    "robust_three_tracks", "emu_group_reroute", "fault_tolerant_reroute",
]  # fmt: skip


@pytest.mark.parametrize("name", WITH_NUMERIC_TWIN)
def test_sumo_and_numeric_runs_agree_at_every_step(finished, name):
    coupled, numeric = finished(name).trains, finished(name, "numeric").trains
    assert len(coupled) == len(numeric)
    assert np.max(np.abs(coupled.position_m - numeric.position_m)) < 1e-6
    assert (coupled.track.astype(str) == numeric.track.astype(str)).all()


def by_train(run, column):
    return run.trains.assign(train=run.trains.train.astype(str)).pivot(index="time_s", columns="train", values=column)


# Robust constrained


@pytest.mark.parametrize("name", ["robust_constrained", "robust_constrained_undisturbed", "robust_constrained_cycle"])
def test_robust_clamps_hold_at_every_step(finished, name):
    trains = finished(name).trains
    assert trains.input_mps2.min() >= -2.0
    assert trains.input_mps2.max() <= 2.0
    assert trains.speed_mps.min() >= 0.0
    assert trains.speed_mps.max() <= 85.0
    assert trains.input_mps2.max() == 2.0, "the start from rest drives the input into its clamp"


def test_robust_formation_without_disturbance(finished):
    assert finished("robust_constrained_undisturbed").metrics["formation.final_error_m"] < 1e-3


def test_robust_steady_state_is_the_closed_form(finished):
    """L phat = -h (s - w1) / T + w2 / T + w3 with drift s = pi (w1 + (w2 + w3 T) / h), pi uniform on an undirected graph."""
    run, h, T = finished("robust_constrained"), 0.3, 0.8
    w1, w2, w3 = np.full(4, 0.1), np.array([0.1, 0.2, 0.1, 0.2]), np.full(4, 0.01)
    s = np.mean(w1 + (w2 + w3 * T) / h)
    laplacian = 0.01 * np.array([[1, -1, 0, 0], [-1, 2, -1, 0], [0, -1, 2, -1], [0, 0, -1, 1.0]])
    phat = np.linalg.lstsq(laplacian, -h * (s - w1) / T + w2 / T + w3, rcond=None)[0]
    position = by_train(run, "position_m").iloc[-1].to_numpy()
    assert np.diff(position) == pytest.approx(np.diff(phat) - 8000.0, abs=1e-4)
    speed = by_train(run, "speed_mps").iloc[-1].to_numpy()
    assert speed == pytest.approx(80.0 + (s - w1) / T, abs=1e-4)


def test_robust_worst_disturbance_reaches_the_l1_bound(finished):
    position = by_train(finished("robust_constrained_worst"), "position_m")
    error = np.abs(position["1"] - position["4"] - 24000.0)
    assert 0.95 * 94.0 < error.iloc[-1] < 94.0 + 1e-3


def test_disturbances_are_in_the_log(finished):
    trains = finished("robust_constrained").trains
    assert trains.disturbance_position_m.dropna().eq(0.1).all()
    assert set(trains.disturbance_speed_mps.dropna()) == {0.1, 0.2}
    assert trains.disturbance_input_mps2.dropna().eq(0.01).all()


def test_robust_law_brings_emus_through_the_leave_and_the_join(finished):
    run = finished("robust_three_tracks")
    assert run.metrics["formation.final_error_m"] < 0.01
    assert [e for e in run.events if e["kind"] == "violation"] == []
    assert run.units.force_max_n.max() <= 40e3 + 1e-6
    assert run.units.force_min_n.min() >= -64e3 - 1e-6


# Finite-time EMU groups


def test_emu_group_in_sumo_for_4000_s(finished):
    run = finished("emu_finite_time")
    units, trains = run.units, run.trains
    assert trains.time_s.max() == 4000.0
    assert units.coupler_min_m.min() > -0.1
    assert units.coupler_max_m.max() < 0.1
    interval = trains.interval_m_min.replace([np.inf, -np.inf], np.nan).dropna()
    assert interval.min() > 1500.0
    gaps = by_train(run, "gap_m").iloc[-1].dropna()
    assert gaps.to_numpy() == pytest.approx([3000.0, 3000.0], abs=1e-3)
    speed = by_train(run, "speed_mps")
    for time, level in ((590.0, 316 / 3.6), (1990.0, 342 / 3.6), (4000.0, 324 / 3.6)):
        assert speed.loc[time].to_numpy() == pytest.approx(level, abs=0.02), time
    # Without force limits the start, and later the step of the reference, overshoot the line's 100 m/s; nothing else is violated.
    told = [e for e in run.events if e["kind"] in ("violation", "sumo_warning")]
    assert sorted((e["bound"], e["who"]) for e in told) == [("line_speed_mps", train) for train in "123"]
    assert told[0]["time_s"] == speed.index[(speed > 100.0).any(axis=1)][0]
    assert run.info["worst"]["line_speed_mps"]["value"] == speed.max().max() < 116.0


def test_force_limits_break_a_coupler_with_the_printed_gains_and_not_retuned(finished):
    limited, retuned = finished("emu_force_limits"), finished("emu_retuned")
    worst = max(limited.units.coupler_max_m.max(), -limited.units.coupler_min_m.min())
    assert 0.105 < worst < 0.115
    located = [e for e in limited.events if e["kind"] == "violation" and e["bound"].startswith("coupler")]
    assert located
    assert located[0]["time_s"] < 60.0
    assert max(retuned.units.coupler_max_m.max(), -retuned.units.coupler_min_m.min()) < 0.06
    for run in (limited, retuned):
        assert run.units.force_max_n.max() <= 40e3 + 1e-6
        assert run.units.force_min_n.min() >= -64e3 - 1e-6


def test_emu_join_is_delayed_until_its_start_condition_holds(finished):
    run = finished("emu_group_reroute")
    kinds = [(e["kind"], e.get("train")) for e in run.events]
    assert kinds.index(("join_delayed", "4")) < kinds.index(("join", "4")) < kinds.index(("leave", "2"))
    (delayed,) = [e for e in run.events if e["kind"] == "join_delayed"]
    assert "must start above emergency_distance_m = 1500" in delayed["reasons"][0]
    assert run.metrics["formation.final_error_m"] < 1e-3
    assert run.units.coupler_min_m.min() > -0.1
    assert run.units.coupler_max_m.max() < 0.1
    # The train that joins catches up a little faster than the line's 100 m/s, which the law does not know.
    assert [(e["bound"], e["who"]) for e in run.events if e["kind"] == "violation"] == [("line_speed_mps", "4")]
    assert by_train(run, "speed_mps").max()["4"] < 101.0


# Fault-tolerant


def rear_distances(run):
    """Distances from the last carriage of a train to the head of the next at the end [m]."""
    last = run.units[run.units.time_s == run.units.time_s.max()].assign(train=lambda u: u.train.astype(str))
    x = last.pivot(index="train", columns="unit", values="position_m")
    return [x.loc[a, 3] - x.loc[b, 1] for a, b in (("1", "2"), ("2", "3"))], np.diff(x.to_numpy(), axis=1)


def test_fault_tolerant_bounds_hold_at_every_sub_step_for_2500_s(finished):
    run = finished("fault_tolerant")
    trains = run.trains
    assert trains.time_s.max() == 2500.0
    assert trains.spacing_error_m_min.min() > -2351.0
    assert trains.spacing_error_m_max.max() < 1947.0
    assert trains.speed_error_mps_min.min() > -50.0
    assert trains.speed_error_mps_max.max() < 50.0
    distances, carriages = rear_distances(run)
    assert distances == pytest.approx([7053.0, 7053.0], abs=0.01)
    assert carriages == pytest.approx(-26.0, abs=1e-5)
    assert [e for e in run.events if e["kind"] in ("violation", "sumo_warning")] == []


def test_fault_estimates_reach_the_truth_after_every_window_edge(finished):
    run = finished("fault_tolerant")
    units = run.units.dropna(subset=["fault_mps3"])
    edges = np.unique([t for f in run.scenario["fault"] for t in (f["start_s"], f.get("end_s", np.inf))])
    time = units.time_s.to_numpy()
    since = np.min(np.where(time[:, None] >= edges, time[:, None] - edges, np.inf), axis=1)
    settled = units[(since >= 30.0) & np.isfinite(since)]
    assert len(settled) > 0.5 * len(units)
    assert (settled.fault_mps3 - settled.fault_estimate_mps3).abs().max() < 1e-3


@pytest.mark.parametrize("name", ["fault_tolerant_noise", "fault_tolerant_force_limit", "fault_tolerant_total_failure"])
def test_fault_tolerant_variants_keep_their_bounds(finished, name):
    trains = finished(name).trains
    assert trains.spacing_error_m_min.min() > -2351.0
    assert trains.spacing_error_m_max.max() < 1947.0
    assert trains.speed_error_mps_max.abs().max() < 50.0


def test_fault_tolerant_join_is_delayed_until_its_start_condition_holds(finished):
    run = finished("fault_tolerant_reroute")
    (delayed,) = [e for e in run.events if e["kind"] == "join_delayed"]
    assert "start condition (39)" in delayed["reasons"][0]
    joined = next(e for e in run.events if e["kind"] == "join" and e["train"] == "4")
    assert joined["time_s"] > delayed["time_s"]
    assert run.metrics["formation.final_error_m"] < 0.1
    assert [e for e in run.events if e["kind"] == "violation"] == []
