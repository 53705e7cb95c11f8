"""Trains that are heavier than stated: the plant moves the true mass, law and train go by the stated one."""

from __future__ import annotations

import numpy as np
import pytest

from trainctl.errors import InputError
from trainctl.scenario.build import open_scenario

SHORT = {"run.duration_s": 30, "run.sub_step_s": 0.1}


def gained(run):
    """Speed that the first train gains within a second while it is ordered to brake [m/s]."""
    rows = run.trains[run.trains["train"] == "1"].set_index("time_s")
    return float(rows["speed_mps"][12.0] - rows["speed_mps"][11.0]), float(rows["speed_mps"][11.0])


@pytest.mark.parametrize("error", [10.0, -5.0])
def test_force_is_that_of_the_stated_mass(finished, error):
    """An order of -0.4 m/s2 is made of brakes b and resistance r, both per mass: b + r = 0.4; of the true mass it is b / (1 + e) + r."""
    order = {"event": [{"kind": "brake", "train": "1", "time_s": 10.0, "deceleration_mps2": 0.4}]}
    stated, _ = gained(finished("time_headway", "numeric", **SHORT, **order))
    true, v = gained(finished("time_headway", "numeric", **SHORT, **order, **{"train_type.emu.mass_error_percent": error}))
    assert stated == pytest.approx(-0.4, abs=1e-6)
    r = 1.176e-2 + 7.7616e-4 * v + 1.6e-5 * v**2
    assert true == pytest.approx(-(0.4 - r) / (1.0 + 0.01 * error) - r, abs=2e-3)
    assert np.sign(true - stated) == np.sign(error)


@pytest.mark.parametrize(
    ("name", "keys", "line"),
    [
        (
            "robust_constrained", {"train_type.point.mass_error_percent": 5.0},
            "robust_constrained.toml: train_type.point.mass_error_percent = 5: needs a plant with units",
        ),
        (
            "time_headway", {"train_type.emu.mass_error_percent": -60.0},
            "time_headway.toml: train_type.emu.mass_error_percent = -60.0: input should be greater than -50",
        ),
        (
            "time_headway", {"train_type.emu.mass_error_percent": 5.0, "supervisor.mode": "on"},
            "time_headway.toml: train_type.emu.mass_error_percent = 5: supervisor.mode must be off, since it relies on the stated"
            " masses",
        ),
    ],
)  # fmt: skip
def test_what_is_refused(name, keys, line):
    with pytest.raises(InputError) as told:
        open_scenario(name, keys)
    assert line in told.value.mistakes
