"""Every shipped scenario gives the run it gave when its golden was kept: `python tools/update_golden.py` renews them."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

from trainctl.diff.runs import read_tolerances
from trainctl.prepare import open_scenario
from trainctl.reading import shipped
from trainctl.testing import assert_run_matches

GOLDENS = Path(__file__).parent / "goldens"
TOLERANCES = read_tolerances(GOLDENS / "tolerances.toml")


@pytest.mark.parametrize("name", sorted(shipped()))
def test_run_matches_its_golden(finished, name):
    report = assert_run_matches(finished(name), GOLDENS / name, TOLERANCES)
    rows = {t.table: t.rows for t in report.tables}
    assert min(rows[table] for table in ("trains", "fcd", "tripinfo", "statistics", "vehroute", "events")) > 0
    assert rows["trains"] >= 40, "a golden that holds next to nothing proves nothing"


def test_goldens_are_small_and_none_is_stale():
    assert {p.name for p in GOLDENS.iterdir() if p.is_dir()} == set(shipped())
    assert sum(p.stat().st_size for p in GOLDENS.rglob("*") if p.is_file()) < 2_000_000


def test_a_golden_does_not_match_another_run(finished):
    """The ratchet run starts otherwise than the paper's."""
    with pytest.raises(AssertionError, match="first: trains: ") as told:
        assert_run_matches(finished("fully_distributed_ratchet"), GOLDENS / "fully_distributed", TOLERANCES)
    assert "scenario." in str(told.value)


def test_updating_says_what_moved_and_by_how_much(tmp_path, monkeypatch, capsys):
    place = Path(__file__).resolve().parents[2] / "tools" / "update_golden.py"
    loader = importlib.util.spec_from_file_location("update_golden", place)
    tool = importlib.util.module_from_spec(loader)
    loader.loader.exec_module(tool)
    settings = {"run.duration_s": 40}
    monkeypatch.setattr(tool, "GOLDENS", tmp_path)
    monkeypatch.setattr(tool, "open_scenario", lambda name: open_scenario(name, settings))
    assert tool.update("robust_constrained_undisturbed", dry=False)
    assert not tool.update("robust_constrained_undisturbed", dry=False)
    settings["controller.h_per_s"] = 0.303
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    assert tool.update("robust_constrained_undisturbed", dry=True)
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before
    told = capsys.readouterr().out
    assert "nothing moved" in told
    assert re.search(r"trains\.position_m: \d+ of \d+ rows differ, most at \d+ s, train \d: .* \(by [\d.e-]+\)", told)
    assert "scenario.controller.h_per_s: 0.3 -> 0.303" in told
