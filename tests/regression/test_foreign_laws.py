"""Laws of other people on plants and with observers they may never have been tried with."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import tomli_w

import trainctl
from trainctl.errors import InputError
from trainctl.figures import catalogue
from trainctl.figures import trains as figures_trains
from trainctl.runner import run
from trainctl.scenario.build import open_scenario

LAWS = Path(__file__).parents[1] / "laws"


def scenario(folder, law, **changes):
    """The six trains of three_tracks under a law in a file; the scenario's path."""
    shutil.copy(LAWS / law, folder)
    tables = {"extends": "three_tracks", "title": "foreign", "controller": {"law": law}, "run": {"duration_s": 20}}
    for table, keys in changes.items():
        tables[table] = tables.get(table, {}) | keys
    (folder / "s.toml").write_text(tomli_w.dumps(tables))
    return folder / "s.toml"


ACTUATED = {"plant": {"kind": "actuated_units"}, "train_type": {"emu": {"actuator_rate_per_s": 50.0}}}


@pytest.mark.parametrize("law", ["counting.py", "watching.py"])
def test_a_law_on_actuated_units_without_an_observer_runs(law, tmp_path):
    """Sampled or continuous: what nobody estimates is missing in the log, and no figure shows it."""
    done = run(open_scenario(str(scenario(tmp_path, law, **ACTUATED))), tmp_path / "r", "numeric")
    units = done.units
    assert units[["fault_estimate_mps3", "acceleration_estimate_mps2"]].isna().all(axis=None)
    at_work = units[units.time_s < 20.0]
    assert at_work[["law_input", "fault_mps3", "acceleration_mps2"]].notna().all(axis=None)
    figures = catalogue.applicable(figures_trains.drawable(trainctl.open(done.folder), "double"))
    assert "unit_forces" in figures and not [name for name in figures if name.endswith("_estimates")]


@pytest.mark.parametrize("kind", ["asymptotic", "intermediate"])
def test_with_an_observer_any_law_has_estimates(kind, tmp_path):
    path = scenario(tmp_path, "watching.py", observer={"kind": kind}, **ACTUATED)
    units = run(open_scenario(str(path)), tmp_path / "r", "numeric").units
    at_work = units[units.time_s < 20.0]
    assert at_work.acceleration_estimate_mps2.notna().all() and at_work.fault_estimate_mps3.notna().all()
    error = (at_work.acceleration_estimate_mps2 - at_work.acceleration_mps2).abs()
    assert error[at_work.time_s > 15.0].max() < 0.05


def test_an_observer_the_law_does_not_know_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"observer.kind = asymptotic: law counting\.py works with none"):
        open_scenario(str(scenario(tmp_path, "counting.py", observer={"kind": "asymptotic"}, **ACTUATED)))


def test_what_a_foreign_law_watches_has_its_alarms(tmp_path):
    """The first two trains of three_tracks are 5 and 2 m/s faster than the reference; 2.5 m/s is allowed."""
    path = scenario(tmp_path, "watching.py", bounds={"speed_upper_mps": 90.0})
    done = run(open_scenario(str(path)), tmp_path / "r", "numeric")
    alarms = [e for e in done.events if e["kind"] == "violation" and e["bound"].startswith(("slip", "unbounded"))]
    assert [(e["bound"], e["who"], e["limit"]) for e in alarms] == [("slip_upper_mps", "1", 2.5)]
    assert alarms[0]["value"] == pytest.approx(5.0, abs=0.2)
    trains = done.trains.astype({"train": str}).set_index("train")
    assert trains.slip_mps_max["1"].max() == pytest.approx(alarms[0]["value"], abs=0.1)
    assert np.nanmax(trains.slip_mps_max["2"]) < 2.5
