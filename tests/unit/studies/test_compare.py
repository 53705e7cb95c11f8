"""Runs side by side, and one traffic under every law."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from trainctl.cli.program import app
from trainctl.laws import laws
from trainctl.scenario.build import model_of
from trainctl.scenario.reading import examine, find, read
from trainctl.studies.compare import PANELS, alternatives, figures, names, table


@pytest.fixture(scope="module")
def runs(finished):
    short = {"run.duration_s": 60}
    return [finished("fully_distributed", "numeric", **short), finished("fully_distributed_loss", "numeric", **short)]


def test_a_row_has_one_value_per_run(runs):
    rows = {row["metric"]: row for row in table(runs)}
    assert rows["bounds.spacing_lower_margin_m"]["unit"] == "m"
    assert [len(row["values"]) for row in rows.values()] == [2] * len(rows)
    assert rows["formation.final_error_m"]["values"] == [run.metrics["formation.final_error_m"] for run in runs]


def test_names_tell_folders_apart(finished, runs):
    assert names(runs) == ["fully_distributed", "fully_distributed_loss"]
    twice = names([runs[0], finished("fully_distributed", "numeric", **{"run.duration_s": 61})])
    assert len(set(twice)) == 2
    assert len(set(names([runs[0], runs[0]]))) == 2


def test_figures_have_a_panel_per_run_on_one_scale(runs, tmp_path):
    written = figures(runs, ["a", "b"], tmp_path)
    assert [path.name for path in written] == [f"compare_{name}.png" for name in PANELS]
    assert all(path.stat().st_size > 5000 for path in written)


def test_every_law_can_be_put_in_front_of_three_tracks():
    data, path = read("three_tracks")
    found = alternatives(data, laws())
    assert list(found) == [
        "fully_distributed", "model_predictive", "relative_braking", "robust_constrained", "sliding_mode", "time_headway",
        "time_headway_cooperative", "emu_finite_time", "ordinary_consensus", "fault_tolerant", "sumo_fixed_block", "sumo_moving_block",
    ]  # fmt: skip
    assert found["fully_distributed"] == data
    for name, changed in found.items():
        assert [changed[key] for key in ("train", "event", "network", "reference", "bounds", "link")] == [
            data[key] for key in ("train", "event", "network", "reference", "bounds", "link")
        ], name
        scenario, mistakes = examine(changed)
        assert mistakes == [], name
        model_of(scenario, path.name, path.parent)
    assert found["ordinary_consensus"]["controller"]["alpha_1"] == 1.0
    assert found["sumo_moving_block"]["controller"] == {"law": "sumo", "block": "moving"}
    moving = {**data, "controller": {"law": "sumo", "block": "moving", "signals_m": 1000.0}}
    assert alternatives(moving, laws())["sumo_moving_block"] == moving
    assert alternatives(moving, laws())["sumo_fixed_block"]["controller"] == {"law": "sumo", "block": "fixed"}


def test_laws_that_cannot_drive_the_traffic_are_named_with_the_reason(tmp_path):
    typed = [
        "compare",
        str(find("fully_distributed")),
        "--controllers",
        "all",
        "--backend",
        "numeric",
        "--set",
        "run.duration_s=20",
        "--json",
    ]
    done = CliRunner().invoke(app, [*typed, "--out", str(tmp_path)], catch_exceptions=False)
    told = json.loads(done.stdout)
    assert {"fully_distributed", "robust_constrained"} <= set(told["runs"])
    assert any("runs on coupled_units" in reason for reason in told["left_out"]["emu_finite_time"])
    assert any("SUMO drives by itself" in reason for reason in told["left_out"]["sumo_fixed_block"])
    assert (tmp_path / "fully_distributed" / "run.json").is_file()
    assert (tmp_path / "compare_speeds.png").is_file()


def test_sumos_own_trains_are_rows_of_the_comparison(tmp_path, monkeypatch):
    monkeypatch.setattr("trainctl.laws.laws", lambda: ["fully_distributed", "sumo"])
    typed = ["compare", "three_tracks", "--controllers", "all", "--set", "run.duration_s=40", "--json", "--out", str(tmp_path)]
    done = CliRunner().invoke(app, typed, catch_exceptions=False)
    told = json.loads(done.stdout)
    assert told["runs"] == ["fully_distributed", "sumo_fixed_block", "sumo_moving_block"] and told["left_out"] == {}
    rows = {row["metric"]: row["values"] for row in told["rows"]}
    assert rows["energy.traction_kwh"][2] > 0.0
    assert [value is None for value in rows["formation.final_error_m"]] == [False, True, True]
