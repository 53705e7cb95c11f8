"""Sets U_i and V_i: every train keeps its own, the tightest of what is said acts, and `check` says what was said."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import tomli_w

from trainctl.runner import run
from trainctl.scenario.build import open_scenario
from trainctl.scenario.check import facts
from trainctl.scenario.model import Model


def written(
    folder: Path, plant: str = "point", own: dict[str, Any] | None = None, start_mps: float = 60.0, to_mps: float = 75.0, **clamps: float
) -> Model:  # fmt: skip
    """Three trains behind each other; the second one may have bounds of its own."""
    kind = {
        "units": 1 if plant == "point" else 2, "unit_length_m": 80.0, "unit_mass_kg": 8e4, "c0_n_per_kg": 0.01176,
        "c1_ns_per_m_kg": 0.00077616, "c2_ns2_per_m2_kg": 1.6e-05,
        **({} if plant == "point" else {"coupler_stiffness_n_per_m": 1.6e5, "coupler_damping_ns_per_m": 600.0}),
    }  # fmt: skip
    trains = [{"id": str(k), "type": "emu", "track": "1", "position_m": 31e3 - 6e3 * k, "speed_mps": start_mps} for k in (1, 2, 3)]
    trains[1] |= own or {}
    data = {
        "schema_version": 1, "title": "sets", "run": {"duration_s": 200.0, "step_s": 1.0, "control_period_s": 1.0, "sub_step_s": 0.01},
        "network": {"line": "three_tracks"}, "controller": {"law": "robust_constrained", "h_per_s": 0.3},
        "plant": {"kind": plant, **clamps}, "reference": {"speed_mps": to_mps},
        "bounds": {"speed_lower_mps": 0.0, "speed_upper_mps": 85.0, "input_lower_mps2": -0.8, "input_upper_mps2": 1.0},
        "topology": {"desired": "slots", "spacing_m": 5000.0, "weight": 0.01, "lower_m": 500.0, "upper_m": 20e3},
        "train_type": {"emu": kind}, "train": trains,
    }  # fmt: skip
    (folder / "s.toml").write_text(tomli_w.dumps(data))
    return open_scenario(str(folder / "s.toml"))


@pytest.mark.parametrize("plant", ["point", "coupled_units"])
def test_every_train_keeps_its_own_set(plant: str, tmp_path: Path) -> None:
    own = {"input_upper_mps2": 0.4, "input_lower_mps2": -0.1, "speed_upper_mps": 76.0}
    faster = run(written(tmp_path, plant, own), tmp_path / "faster", "numeric").trains.groupby("train", observed=True)
    assert faster.input_mps2.max()[["2", "3"]].to_list() == pytest.approx([0.4, 1.0], abs=1e-9)
    assert faster.speed_mps.max()["2"] <= 76.0 + 1e-9 < faster.speed_mps.max()["3"]
    slower = run(written(tmp_path, plant, own, start_mps=75.5, to_mps=40.0), tmp_path / "slower", "numeric").trains
    minimum = slower.groupby("train", observed=True).input_mps2.min()
    assert minimum["2"] == pytest.approx(-0.1, abs=1e-9)
    assert minimum["3"] < -0.3


def test_the_tighter_acts_and_check_says_what_was_said(tmp_path: Path) -> None:
    model = written(tmp_path, own={"input_upper_mps2": 1.2, "speed_upper_mps": 81.0}, input_upper_mps2=0.9)
    assert model.bounds.input_upper.tolist() == [0.9] * 3
    assert model.bounds.speed_upper.tolist() == [85.0, 81.0, 85.0]
    told = [line for line in facts(model)["warnings"] if "the tightest acts" in line]
    assert told == [
        "speed_upper_mps of train 2 = 81: 85 in [bounds], 81 in [[train]]; the tightest acts",
        "input_upper_mps2 of trains 1, 3 = 0.9: 1 in [bounds], 0.9 in [plant]; the tightest acts",
        "input_upper_mps2 of train 2 = 0.9: 1 in [bounds], 0.9 in [plant], 1.2 in [[train]]; the tightest acts",
    ]


def test_what_is_logged_is_what_was_written_and_gives_the_same_bounds(tmp_path: Path) -> None:
    model = written(tmp_path, own={"input_upper_mps2": 0.4})
    (tmp_path / "again.toml").write_text(model.scenario.toml())
    again = open_scenario(str(tmp_path / "again.toml"))
    assert again.bounds.input_upper.tolist() == model.bounds.input_upper.tolist() == [1.0, 0.4, 1.0]
    assert again.scenario == model.scenario
    assert [train.input_upper_mps2 for train in again.scenario.train] == [None, 0.4, None]
