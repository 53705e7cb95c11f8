"""How much a line carries: what is measured, what is asked, every row run."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from trainctl.cli.program import app
from trainctl.errors import InputError
from trainctl.studies import capacity
from trainctl.studies.capacity import CapacityPlan

SMALL = CapacityPlan(trains=3, length_m=5000.0)


def made_up(*, headway: float = 40.0, speed: float = 80.0, entry: float | None = None, gap: float = 3000.0) -> pd.DataFrame:
    """Trains at one speed; the force is such that every metre takes 100 kJ. ``entry``: they enter there."""
    frames = []
    for k in range(SMALL.trains):
        time = np.arange(0.0, 400.0)
        position = SMALL.begin_m - 500.0 + speed * (time - headway * k)
        begin = position[0] if entry is None else entry
        on = (position >= begin) & (position < SMALL.end_m + 500.0)
        frames.append(pd.DataFrame({
            "time_s": time[on], "train": str(k), "position_m": position[on], "speed_mps": speed, "traction_j": 1e5 * speed,
            "spacing_m": np.nan if k == 0 else headway * speed, "gap_m": np.nan if k == 0 else gap,
        }))  # fmt: skip
    return pd.concat(frames)


def measured(frame: pd.DataFrame) -> dict[str, Any]:
    return capacity.measure(SimpleNamespace(trains=frame, info={"wall_time_s": 1.5}), SMALL)  # type: ignore[arg-type]


def test_what_is_measured_of_trains_at_one_speed():
    row = measured(made_up())
    assert row["headway_s"] == row["headway_mean_s"] == pytest.approx(40.0)
    assert row["trains_per_hour"] == pytest.approx(90.0)
    assert row["journey_time_s"] == pytest.approx(5000.0 / 80.0)
    assert row["energy_kwh_per_train_km"] == pytest.approx(1e8 / 3.6e6)
    assert (row["spacing_m"], row["least_gap_m"], row["trains"], row["collisions"]) == (pytest.approx(3200.0), 3000.0, 3, 0)
    assert tuple(row) == capacity.MEASURED


def test_trains_that_enter_at_the_stretch_are_measured_from_there():
    row = measured(made_up(entry=SMALL.begin_m + 20.0))
    assert row["journey_time_s"] == pytest.approx(4980.0 / 80.0, abs=1.0)
    assert row["energy_kwh_per_train_km"] == pytest.approx(1e8 / 3.6e6)


def test_trains_inside_one_another_are_counted_once_each_and_on_the_stretch_only():
    frame = made_up()
    on = frame["position_m"].between(SMALL.begin_m, SMALL.end_m)
    frame.loc[~on, "gap_m"] = -5.0
    assert measured(frame)["collisions"] == 0
    frame.loc[on & (frame["train"] == "2"), "gap_m"] = -1.0
    assert (measured(frame)["collisions"], measured(frame)["least_gap_m"]) == (1, -1.0)


def test_where_no_train_arrives_nothing_is_claimed():
    frame = made_up()
    row = measured(frame[frame["position_m"] < SMALL.end_m - 1.0])
    assert row["trains"] == 0
    assert [row[key] for key in ("headway_s", "trains_per_hour", "journey_time_s", "energy_kwh_per_train_km")] == [None] * 4


def as_they_should(rows: dict[str, dict[str, Any]], plan: CapacityPlan) -> None:
    """Every train arrives, none too fast or too close; headways follow from blocks and spacings."""
    assert all(row["error"] is None and row["trains"] == plan.trains and row["collisions"] == 0 for row in rows.values())
    assert all(row["speed_max_mps"] <= plan.speed_mps + 1e-6 and row["least_gap_m"] > 0.0 for row in rows.values())
    for name, row in rows.items():
        if name in capacity.LAW_ROWS:
            assert row["headway_s"] == pytest.approx(plan.spacing_m / plan.cruise_mps, abs=0.3)
            assert row["journey_time_s"] == pytest.approx(plan.length_m / plan.cruise_mps, rel=2e-3)
        elif name.endswith("at_speed"):
            assert row["journey_time_s"] == pytest.approx(plan.length_m / plan.speed_mps, abs=0.01)
            assert 0.0 <= row["headway_s"] - capacity.headway_bound(plan, name.partition("_")[0]) < 1.0
        else:  # as many as SUMO lets in, which is more than can run at the line's speed
            assert row["headway_s"] < capacity.headway_bound(plan, name.partition("_")[0])
            assert row["journey_time_s"] > plan.length_m / plan.speed_mps


def test_rows_in_processes_of_their_own(tmp_path: Path):
    seen: list[tuple[int, int]] = []
    chosen = ("moving_block", "fixed_block_at_speed", "robust_constrained", "fault_tolerant")
    table = capacity.compare(SMALL, tmp_path, chosen, workers=2, progress=lambda done, rows: seen.append((done, rows)))
    assert seen == [(k, 4) for k in range(5)]
    assert [row["row"] for row in table] == list(chosen)
    as_they_should({row["row"]: row for row in table}, SMALL)
    assert capacity.figure(table, SMALL, tmp_path / "capacity")[0].stat().st_size > 20_000


@pytest.mark.campaign
def test_the_whole_table(tmp_path: Path):
    """40 trains, 100 km, every row in one call, as `trainctl compare capacity` does by default."""
    done = CliRunner().invoke(app, ["compare", "capacity", "--out", str(tmp_path), "--json"], catch_exceptions=False)
    assert done.exit_code == 0, done.stderr
    rows = {row["row"]: row for row in json.loads(done.stdout)}
    assert tuple(rows) == capacity.ROWS
    as_they_should(rows, CapacityPlan())
    for name, row in rows.items():
        print(name, {key: row[key] if row[key] is None else round(row[key], 3) for key in capacity.MEASURED})


def test_a_row_that_fails_is_told_and_the_others_stand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(capacity, "ROWS", ("moving_block", "fully_distributed"))
    monkeypatch.setattr(capacity.compare, "__defaults__", (capacity.ROWS, 2, None))
    monkeypatch.setattr(capacity, "BAND_MPS", 2.0)  # Assumption 2.4: 8 MW cannot give that in one period
    typed = ["compare", "capacity", "--trains", "2", "--length-km", "2", "--out", str(tmp_path)]
    done = CliRunner().invoke(app, [*typed, "--json"], catch_exceptions=False)
    assert done.exit_code == 3
    assert "fully_distributed: fully_distributed.toml: bounds.input_upper_mps2" in done.stderr
    moving, failed = json.loads(done.stdout)
    assert moving["error"] is None and "Assumption 2.4" in failed["error"] and failed["headway_s"] is None


@pytest.mark.parametrize(
    ("plan", "line"),
    [
        ({"trains": 1}, "--trains: must be at least 2"),
        ({"length_m": 0.0}, "--length-km: must be above 0"),
        ({"speed_mps": 1.0}, "--speed-mps: must be above 1.5, at most 200"),
        ({"signals_m": 30e3}, "--signals-m: must be 10 .. 20000"),
        ({"spacing_m": 100.0}, "--spacing-m: must be above 500"),
        ({"length_m": 1e8}, "compare capacity: length_m = "),
    ],
)
def test_what_makes_no_line_is_one_line(tmp_path: Path, plan: dict[str, float], line: str):
    with pytest.raises(InputError) as caught:
        capacity.compare(CapacityPlan(**plan), tmp_path)  # type: ignore[arg-type]
    assert any(mistake.startswith(line) for mistake in caught.value.mistakes), caught.value.mistakes


def test_a_folder_named_capacity_and_options_of_capacity(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "capacity").mkdir()
    for typed, line in (
        (["./capacity"], "capacity: not a run folder: it has no run.json"),
        (["./capacity", "--trains", "3"], "--trains: only with `trainctl compare capacity`"),
        (["capacity", "--set", "run.step_s=0.5"], "capacity: takes no --set"),
        (["capacity", "--backend", "numeric"], "capacity: takes no --set and no --backend"),
    ):
        with pytest.raises(InputError, match=line):
            CliRunner().invoke(app, ["compare", *typed], catch_exceptions=False, standalone_mode=False)


def test_laws_keep_the_spacings_that_were_found(tmp_path):
    told = {"plan": {"brake_scatter": 0.1}, "rows": [
        {"row": "sliding_mode", "spacing_m": 900.0}, {"row": "relative_braking", "spacing_m": 5000.0}, {"row": "fault_tolerant", "spacing_m": None},
    ]}  # fmt: skip
    (tmp_path / "spacing.json").write_text(json.dumps(told))
    plan = SMALL._replace(found=capacity.found_in(tmp_path / "spacing.json"))
    made = {row: capacity.scenario(plan, row) for row in ("sliding_mode", "relative_braking", "fault_tolerant", "moving_block")}
    assert {row: m["topology"]["spacing_m"] for row, m in made.items()} == {
        "sliding_mode": 900.0, "relative_braking": 5000.0, "fault_tolerant": 3000.0, "moving_block": 3000.0,
    }  # fmt: skip
    apart = {row: m["train"][0]["position_m"] - m["train"][2]["position_m"] for row, m in made.items()}
    assert apart["sliding_mode"] == pytest.approx(1800.0, abs=80.0) and apart["relative_braking"] == pytest.approx(
        10_000.0, abs=80.0
    )
    assert min(t["position_m"] for m in made.values() for t in m["train"]) > 0.0
    assert made["relative_braking"]["controller"]["braking_mps2"] == pytest.approx(0.9 * 218.4 / 436.8)
    assert capacity.ideal(plan, "sliding_mode")["headway_s"] == pytest.approx(900.0 / plan.cruise_mps)
    for text, rule in ((None, "No such file or directory"), ("{}", "must be a spacing.json of `trainctl compare spacing`")):
        file = tmp_path / "other.json"
        if text is not None:
            file.write_text(text)
        with pytest.raises(InputError, match=rule):
            capacity.found_in(file)
