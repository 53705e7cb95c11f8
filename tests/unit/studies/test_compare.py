"""Runs side by side, and one traffic under every law."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

import trainctl
from trainctl.cli.program import app
from trainctl.figures.overlay import QUANTITIES, overlay, scale
from trainctl.figures.trains import drawable
from trainctl.laws import find_law, laws
from trainctl.runs.run import Run
from trainctl.scenario.build import model_of
from trainctl.scenario.reading import examine, find, read
from trainctl.studies.compare import alternatives, figures, latex, names, others, table


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


def test_a_figure_per_quantity(runs, tmp_path):
    written = figures(runs, ["a", "b"], tmp_path)
    assert [path.name for path in written] == [f"compare_{name}.png" for name in QUANTITIES]
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
    assert any("SUMO drives the trains itself" in reason for reason in told["left_out"]["sumo_fixed_block"])
    assert (tmp_path / "fully_distributed" / "run.json").is_file()
    assert (tmp_path / "compare_speeds.png").is_file()
    assert "fully" in (tmp_path / "compare.tex").read_text() and told["latex"] == str(tmp_path / "compare.tex")


def test_sumos_own_trains_are_rows_of_the_comparison(tmp_path, monkeypatch):
    monkeypatch.setattr("trainctl.laws.laws", lambda: ["fully_distributed", "sumo"])
    typed = ["compare", "three_tracks", "--controllers", "all", "--set", "run.duration_s=40", "--json", "--out", str(tmp_path)]
    done = CliRunner().invoke(app, typed, catch_exceptions=False)
    told = json.loads(done.stdout)
    assert told["runs"] == ["fully_distributed", "sumo_fixed_block", "sumo_moving_block"] and told["left_out"] == {}
    rows = {row["metric"]: row["values"] for row in told["rows"]}
    assert rows["energy.traction_kwh"][2] > 0.0
    assert [value is None for value in rows["formation.final_error_m"]] == [False, True, True]


def test_all_runs_stand_in_one_axis_each_in_its_colour(runs):
    drawn = [drawable(run) for run in runs]
    for what in QUANTITIES:
        (axes,) = overlay(drawn, ["one", "other_one"], what).axes
        colours = {str(line.get_label()): line.get_color() for line in axes.lines}
        assert {"one", "other one"} <= set(colours) and colours["one"] != colours["other one"]
        assert {"one", "other one"} <= {text.get_text() for text in axes.texts}, what
        assert not [text for text in axes.texts if text.get_gid() == "clipped"], what


def test_outliers_are_clipped_and_said(finished, runs, tmp_path):
    folder = tmp_path / "wild"
    shutil.copytree(runs[1].folder, folder)
    trains = pq.read_table(folder / "trains.parquet")
    value = trains["input_mps2"].to_numpy().copy()
    value[np.flatnonzero(trains["time_s"].to_numpy() == 30.0)[1]] = -67.0
    place = trains.column_names.index("input_mps2")
    pq.write_table(trains.set_column(place, "input_mps2", pa.array(value)), folder / "trains.parquet")
    (axes,) = overlay([drawable(runs[0]), drawable(Run(folder))], ["tame", "wild"], "inputs").axes
    (said,) = [text.get_text() for text in axes.texts if text.get_gid() == "clipped"]
    assert axes.get_ylim()[0] > -10.0
    assert said.startswith("beyond the scale:\n") and "wild down to -67" in said


def test_scale_follows_most_values_of_most_runs():
    calm = np.linspace(-1.0, 1.0, 400)
    low, high = scale([calm, calm, 1000.0 * calm])
    assert (low, high) == pytest.approx((-1.08, 1.08), rel=0.02)
    assert scale([calm, 3.0 * calm]) == pytest.approx((-3.36, 3.36))  # nothing of it squeezes the other
    assert scale([calm, np.append(calm, 50.0)])[1] < 1.2
    assert scale([np.zeros(5)]) == (0.0, 0.0)


def test_the_table_in_latex(runs):
    text = latex([
        {"metric": "a_b", "unit": "m/s2", "values": [0.012345, None]}, {"metric": "c", "unit": "1", "values": [18631.0, 3.0e-9]},
    ], ["x_1", "50 %"])  # fmt: skip
    assert text.splitlines()[1:] == [
        r"\begin{tabular}{llrr}", r"\toprule", r"metric & unit & x\_1 & 50 \% \\", r"\midrule",
        r"a\_b & m/s$^2$ & $0.0123$ & -- \\", r"c &  & $18\,600$ & $3.00 \cdot 10^{-9}$ \\", r"\bottomrule", r"\end{tabular}",
    ]  # fmt: skip
    assert len(latex(table(runs), ["a", "b"]).splitlines()) == len(table(runs)) + 7


OWN = """extends = "time_headway"
title = "A law of its own, and gains for others"

[run]
duration_s = 20
sub_step_s = 0.1

[controller]
law = "{law}"

[alternative.time_headway]
gain_per_s = 0.2

[alternative.sliding_mode]
reach_mps2 = 5.0
"""


@pytest.fixture
def own(tmp_path):
    """A scenario with a law in a file beside it, and another law elsewhere that does not compile."""
    (tmp_path / "mine").mkdir()
    template = (Path(trainctl.__file__).parent / "templates" / "my_law.py").read_text()
    (tmp_path / "mine" / "my_law.py").write_text(template)
    (tmp_path / "slow_law.py").write_text(template.replace("0.02", "0.01"))
    (tmp_path / "broken.py").write_text("def violations(")
    (tmp_path / "mine" / "own.toml").write_text(OWN.replace("{law}", "my_law.py"))
    return tmp_path


def test_the_scenarios_own_law_laws_in_files_and_those_of_others_are_rows(own, monkeypatch):
    data, path = read(str(own / "mine" / "own.toml"))
    found, left_out = others(data, [*laws(), "installed"], path.parent, [str(own / "slow_law.py"), str(own / "broken.py")])
    assert list(found) == ["my_law", "slow_law"]
    assert found["my_law"] == data
    assert find_law(found["slow_law"]["controller"]["law"]).Params().k_per_s == 0.01
    assert "cannot be imported: SyntaxError" in left_out["broken"][0] and "no such law" in left_out["installed"][0]
    shippeds = alternatives(data, laws())
    assert shippeds["time_headway"]["controller"] == {"law": "time_headway", "gain_per_s": 0.2}
    assert shippeds["time_headway_cooperative"]["controller"] == {"law": "time_headway", "acceleration_share": 0.8}


def test_an_alternative_that_nobody_runs_is_a_mistake(own, typed):
    text = (own / "mine" / "own.toml").read_text().replace("[alternative.time_headway]", "[alternative.nobody]")
    (own / "mine" / "own.toml").write_text(text)
    status, said = typed("compare", own / "mine" / "own.toml", "--controllers", "all", "--backend", "numeric")
    assert status == 2 and len(said) == 1 and said[0].startswith("own.toml: alternative.nobody: no such row; there are: fully_")
    assert typed("compare", "a", "--law", "b.py") == (2, ["--law: only with --controllers all, which runs something"])


def test_gains_are_stated_and_who_is_left_out(own, monkeypatch, capsys):
    monkeypatch.setattr("trainctl.laws.laws", lambda: ["sliding_mode", "time_headway"])
    typed = ["compare", str(own / "mine" / "own.toml"), "--controllers", "all", "--backend", "numeric", "--out", str(own / "out")]
    done = CliRunner().invoke(app, [*typed, "--law", str(own / "slow_law.py")], catch_exceptions=False)
    assert done.exit_code == 0
    assert "time_headway: time_headway on coupled_units: gain_per_s = 0.2" in done.stdout
    assert "my_law: my_law.py on coupled_units" in done.stdout and "slow_law: " in done.stdout
    assert "sliding_mode is left out: own.toml: controller.reach_mps2 = 5: unstable" in done.stdout


def test_a_run_in_which_no_train_came_is_named(runs, tmp_path):
    folder = tmp_path / "nobody"
    shutil.copytree(runs[1].folder, folder)
    for table_of in ("trains", "links"):
        rows = pq.read_table(folder / f"{table_of}.parquet")
        pq.write_table(rows.slice(0, 0), folder / f"{table_of}.parquet")
    drawn = [drawable(runs[0]), drawable(Run(folder))]
    titles = {what: overlay(drawn, ["one", "nobody_there"], what).axes[0].get_title(loc="left") for what in QUANTITIES}
    assert titles["speeds"].endswith("no trains in nobody there") and titles["spacing_errors"].endswith("no links in nobody there")
