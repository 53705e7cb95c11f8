"""Rows of trains.parquet, where trains differ."""

from __future__ import annotations

import numpy as np
import tomli_w

from trainctl.runner import run
from trainctl.scenario.build import open_scenario

LENGTHS = {"1": 400.0, "2": 60.0, "3": 200.0}


def unequal(folder):
    """Three point trains of three lengths on one track."""
    train_type = {"unit_mass_kg": 320000.0, "c0_n_per_kg": 0.01, "c1_ns_per_m_kg": 0.0, "c2_ns2_per_m2_kg": 0.0}
    tables = {
        "schema_version": 1, "title": "Unequal trains", "run": {"duration_s": 3}, "network": {"line": "three_tracks"},
        "controller": {"law": "fully_distributed"}, "plant": {"kind": "point"}, "reference": {"speed_mps": 80.0},
        "bounds": {"speed_lower_mps": 75.0, "speed_upper_mps": 85.0, "input_lower_mps2": -11.0, "input_upper_mps2": 11.0},
        "topology": {"spacing_m": 2000.0, "lower_m": 500.0, "upper_m": 5000.0},
        "train_type": {name: train_type | {"unit_length_m": length} for name, length in LENGTHS.items()},
        "train": [
            {"id": int(name), "type": name, "track": 1, "position_m": 20000.0 - 2010.0 * k, "speed_mps": 80.0}
            for k, name in enumerate(LENGTHS)
        ],
    }  # fmt: skip
    (folder / "s.toml").write_text(tomli_w.dumps(tables))
    return open_scenario(str(folder / "s.toml"))


def test_the_gap_is_that_to_the_rear_of_the_train_ahead(tmp_path):
    trains = run(unequal(tmp_path), tmp_path / "run", "numeric").trains
    for _, row in trains.astype({"train": str}).groupby("time_s"):
        front, gap = row.set_index("train").position_m, row.set_index("train").gap_m
        assert np.isnan(gap["1"])
        np.testing.assert_allclose(
            [gap["2"], gap["3"]], [front["1"] - 400.0 - front["2"], front["2"] - 60.0 - front["3"]], atol=1e-9
        )
