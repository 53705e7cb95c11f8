"""The search for gains: what it refuses, what it finds, that bounds come first."""

from __future__ import annotations

import dataclasses
import json

import pandas as pd
import pytest

from trainctl.errors import InputError
from trainctl.scenario.build import open_scenario
from trainctl.studies.tune import REFUSED, VIOLATED, Gain, TunePlan, gain, judged, objective, prepared, tune

PLAN = TunePlan(
    "robust_constrained",
    (Gain("h_per_s", 0.1, 1.0),),
    {"jerk": 1.0},
    {"run.duration_s": 160, "topology.loss": 0.3},
    range(3),
    {},
    16,
)


def test_ranges_and_objectives_as_they_are_typed():
    assert gain("h_per_s=0.1..0.9") == gain("controller.h_per_s=0.1..0.9") == Gain("h_per_s", 0.1, 0.9)
    assert gain("k=-1..2").wide is False
    assert objective("settling=2, jerk") == {"settling": 2.0, "jerk": 1.0}
    for wrong in ("h", "h=1", "h=2..1", "h=1..1", "=1..2", "h=a..b", "h=1..inf"):
        with pytest.raises(InputError, match="--gain"):
            gain(wrong)
    for wrong in ("", "speed", "jerk=0", "jerk=x", "jerk=-1"):
        with pytest.raises(InputError, match="--objective"):
            objective(wrong)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"scenario": "fully_distributed"}, "controller.law = fully_distributed: has no gains"),
        ({"gains": ()}, "--gain: missing; the numbers of law robust_constrained are h_per_s = 0.3"),
        ({"gains": (Gain("k", 0.0, 1.0),)}, "--gain k: not a number of law robust_constrained; there are: h_per_s"),
        ({"seeds": ()}, "--seeds: missing"),
        ({"evaluations": 5}, "--evaluations 5: at least"),
        ({"settings": {"supervisor.mode": "on"}}, "cannot be taken side by side: supervisor.mode is not off"),
        ({"settings": {"topology.los": 1}}, "topology.los: unknown key"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(change, words):
    with pytest.raises(InputError, match=words) as told:
        prepared(dataclasses.replace(PLAN, **change))
    assert len(told.value.mistakes) == 1


def test_the_best_gains_are_a_scenario_and_all_candidates_a_table(tmp_path):
    info = tune(PLAN, tmp_path / "a", workers=1)
    frame = pd.read_parquet(tmp_path / "a" / "search.parquet")
    assert len(frame) == info["candidates"] <= 16
    assert frame["h_per_s"].between(0.1, 1.0).all() and frame["h_per_s"].nunique() > 8
    assert frame["h_per_s"][0] == info["start"]["gains"]["h_per_s"] == 0.3
    assert info["bounds_kept"] and info["best"]["runs_violated"] == 0
    assert info["best"]["objective"] == frame["objective"].min() < 0.95 * info["start"]["objective"]
    tuned = open_scenario(str(tmp_path / "a" / "tuned.toml"))
    assert tuned.params.h_per_s == info["best"]["gains"]["h_per_s"]
    assert (tuned.scenario.topology.loss, tuned.scenario.run.duration_s) == (0.3, 160.0)
    assert (tmp_path / "a" / "search.png").stat().st_size > 5000
    with pytest.raises(InputError, match="exists"):
        tune(PLAN, tmp_path / "a", workers=1)
    again = tune(PLAN, tmp_path / "b", workers=1)
    assert (tmp_path / "a" / "search.parquet").read_bytes() == (tmp_path / "b" / "search.parquet").read_bytes()
    assert json.dumps(again["best"]) == json.dumps(info["best"])


def test_bounds_come_before_the_objective(tmp_path):
    """No gain keeps a spacing that is impossible; a gain that the law refuses is worse still."""
    wide = dataclasses.replace(PLAN, settings={**PLAN.settings, "topology.lower_m": 7900.0, "topology.upper_m": 8000.5})
    violated, refused = judged(wide, (0.5,)), judged(PLAN, (1.5,))
    assert (violated.violated, violated.value) == (3, VIOLATED)
    assert (refused.value, refused.violated) == (REFUSED, 3)
    assert "h T = 1.2" in refused.reason
    info = tune(wide, tmp_path / "a", workers=1)
    assert not info["bounds_kept"] and not (tmp_path / "a" / "tuned.toml").exists()
    assert info["best"]["objective"] is None


def test_the_command_says_what_it_found(tmp_path, typed):
    given = ["robust_constrained", "--gain", "h_per_s=0.2..0.8", "--seeds", "0..1", "--set", "run.duration_s=40", "--workers", "1"]
    code, _ = typed("tune", *given, "--objective", "energy", "--evaluations", "16", "--out", tmp_path / "t", "-q")
    assert code == 0
    code, lines = typed("tune", *given, "--objective", "speed")
    assert code == 2
    assert lines == ["--objective speed: no such objective; known: settling, margin, energy, jerk"]


def test_what_is_asked_twice_is_refused_and_what_cannot_run_is_told(tmp_path, typed):
    given = ["robust_constrained", "--seeds", "0..1", "--set", "run.duration_s=40", "--workers", "1", "--evaluations", "16"]
    twice = ["--gain", "h_per_s=0.2..0.8", "--gain", "controller.h_per_s=0.1..0.9"]
    code, lines = typed("tune", *given, *twice, "--objective", "energy", "--out", tmp_path / "a")
    assert (code, lines) == (2, ["--gain h_per_s: given more than once"])
    code, lines = typed("tune", *given, *twice[:2], "--objective", "energy,energy=2", "--out", tmp_path / "a")
    assert (code, lines) == (2, ["--objective energy: given twice"])
    info = tune(dataclasses.replace(PLAN, gains=(Gain("h_per_s", -5.0, -1.0),), evaluations=16), tmp_path / "b", workers=1)
    assert 0 < info["refused"] == info["candidates"] - 1 and "must be above 0" in info["refusal"]
