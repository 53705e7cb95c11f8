"""Laws in situations: what happens in each, that cells are the same however they are run, and the page."""

from __future__ import annotations

import json
import shutil

import pytest

from trainctl.errors import InputError
from trainctl.studies import suite, suite_shown
from trainctl.studies.stops import REFUSED
from trainctl.studies.suite import SITUATIONS, Cell, SuitePlan, cell, tables_of

PLAN = SuitePlan(runs=2, spacing_m=2000.0)


@pytest.mark.parametrize("situation", SITUATIONS)
def test_every_situation_is_a_scenario_without_mistakes(situation, tmp_path) -> None:
    """Under a law that refuses none of them; and something happens to every run."""
    found = cell(PLAN, "time_headway", situation, tmp_path)
    assert found.what == "run" and found.why == "" and found.of == 2 and found.gap_m > 100.0
    tables, _ = tables_of(PLAN, "time_headway", situation)
    ordered = {e["train"].partition(".")[0] for e in tables["event"] if e["train"] != "all"}
    assert ordered == (set() if situation in ("calm", "gradient") else {"0", "1"})


def test_a_train_that_joins_makes_six_of_five_and_one_that_leaves_five_of_six(tmp_path) -> None:
    """Told from what is left in the middle: joined trains are half a spacing apart at first, those behind a leaver two."""
    calm, join = (cell(PLAN, "relative_braking", name, tmp_path / name) for name in ("calm", "join"))
    assert calm.gap_m > 1700.0 and 500.0 < join.gap_m < 900.0
    assert cell(PLAN, "relative_braking", "leave", tmp_path / "leave").error_m > 1000.0 > calm.error_m


def test_an_outage_and_a_lost_unit_make_a_difference(tmp_path) -> None:
    stop, outage, lost = (cell(PLAN, "time_headway", name, tmp_path / name) for name in ("stop", "outage", "unit_lost"))
    assert outage.gap_m != stop.gap_m and lost.error_m > stop.error_m + 10.0


def test_masses_that_nobody_knows_make_a_difference(tmp_path) -> None:
    """Each train is 5 % off, either way, the same in every run of the suite; laws that say less ask for the same and get less."""
    stop, off = (cell(PLAN, "relative_braking", name, tmp_path / name) for name in ("stop", "mass_off"))
    assert off.gap_m != stop.gap_m
    tables, _ = tables_of(PLAN, "relative_braking", "mass_off")
    errors = {name: kind["mass_error_percent"] for name, kind in tables["train_type"].items()}
    assert set(errors.values()) == {-5.0, 5.0} and len(errors) == 12


def test_without_sumo_cells_are_run_all_the_same(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(suite, "has_sumo", lambda: False)
    found = cell(PLAN, "relative_braking", "calm", tmp_path)
    assert found.what == "run" and found.sumo_failed is None
    assert suite_shown.confirmed([found.plain()]) == "No cell was run in SUMO."


def test_sumo_moves_the_first_run_of_a_cell_as_it_is_moved_without(tmp_path) -> None:
    found = cell(PLAN, "relative_braking", "leave", tmp_path)
    assert found.sumo_failed is False and found.sumo_gap_m == pytest.approx(found.first_gap_m, abs=1e-6)
    assert not list(tmp_path.glob("sumo-*"))


@pytest.mark.parametrize("row", ["time_headway", "relative_braking", "sliding_mode", "model_predictive"])
@pytest.mark.parametrize("situation", ["stop", "gradient"])
def test_who_follows_the_train_ahead_is_not_faster_than_the_line(row, situation, tmp_path) -> None:
    """Though resistance is 20 % less than believed, slopes change within a step, and the observer held power for a force."""
    found = cell(PLAN._replace(runs=10 if row != "model_predictive" else 3), row, situation, tmp_path)
    assert found.failed == 0 and found.faster_mps < 0.0


def test_a_law_that_may_not_start_is_refused(tmp_path) -> None:
    found = cell(PLAN, "fully_distributed", "gradient", tmp_path)
    assert found.what == REFUSED and "10 per mil" in found.why and found.plain()["interval_95"] is None


def test_cells_are_the_same_with_one_and_two_workers_and_resumed(tmp_path, monkeypatch) -> None:
    rows, names = ("time_headway", "sliding_mode"), ("calm", "stop")
    one = suite.compare(PLAN, tmp_path / "one", rows, names, workers=1)
    suite.compare(PLAN, tmp_path / "two", rows, names, workers=2)
    for place in sorted((tmp_path / "one").rglob("*.json")):
        assert place.read_bytes() == (tmp_path / "two" / place.relative_to(tmp_path / "one")).read_bytes()
    assert [(c["row"], c["situation"]) for c in one] == [(row, name) for row in rows for name in names]
    kept = tmp_path / "two" / "cells" / "time_headway" / "calm" / "cell.json"
    kept.write_text(json.dumps({**json.loads(kept.read_text()), "failed": 1}))
    shutil.rmtree(tmp_path / "two" / "cells" / "sliding_mode" / "stop")
    again = suite.compare(PLAN, tmp_path / "two", rows, names, workers=1, resume=True)
    assert again[0]["failed"] == 1 and again[3] == one[3]  # what was done stays, the rest is run
    with pytest.raises(InputError, match="has another plan"):
        suite.compare(PLAN._replace(runs=3), tmp_path / "two", rows, names, resume=True)


CELLS = [
    Cell("time_headway", "calm", "run", "", 0, 20, 812.0, 1.5, 0.04, 0, -0.2, 812.5, 812.5, False).plain(),
    Cell("time_headway", "stop", "run", "", 3, 20, -2.0, 9.0, 0.05, 1, 0.034, 12.0, 12.25, False).plain(),
    Cell("fully_distributed", "calm", REFUSED, "a < b & c", 0, 20, None, None, None).plain(),
    Cell("fully_distributed", "stop", "run", "its numbers are no longer finite", 20, 20, None, None, None).plain(),
]


def test_the_page_has_a_cell_for_each_pair_and_says_why(tmp_path) -> None:
    page = suite_shown.page(CELLS, SuitePlan())
    assert page.count("<td") == 4 and "class='bad'>3 of 20 (5.2 .. 36 %)" in page and "class='good'>0 of 20 (0 .. 16 %)" in page
    assert "touched 1<br>0.034 m/s too fast" in page and page.count("touched 0") == 0
    assert "one run of each of 2 cells as well: minimum gaps differ by at most 0.25 m" in page
    assert "a &lt; b &amp; c" in page and "no longer finite" in page and "src=" not in page
    assert suite_shown.write_page(CELLS, SuitePlan(), tmp_path).read_text() == page


def test_the_command(typed) -> None:
    status, said = typed("compare", "suite", "--rows", "nobody")
    assert status == 2 and said[0].startswith("--rows nobody: no such row; there are: ")
    assert typed("compare", "suite", "--stops", "3") == (2, ["--stops: not with `trainctl compare suite`"])
    assert typed("compare", "suite", "--runs", "0") == (2, ["--runs: must be at least 1"])
    assert typed("compare", "spacing", "--runs", "3") == (2, ["--runs: not with `trainctl compare spacing`"])
    assert typed("compare", "a", "--resume")[0] == 2
    assert typed("compare", "a", "--runs", "3") == (2, ["--runs: only with `trainctl compare suite`"])
