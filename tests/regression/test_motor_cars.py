"""Motor cars and trailers: couplers carry what a trailer needs, all bounds hold, and what such trains cannot have is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from trainctl.errors import InputError
from trainctl.runner import run
from trainctl.scenario.build import open_scenario

CAR = "train_type.emu."


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return run(open_scenario("motor_cars", {"run.duration_s": 400}), tmp_path_factory.mktemp("motor_cars") / "r", "numeric")


def test_couplers_carry_what_a_trailer_needs_and_every_bound_holds(done: Any) -> None:
    units = done.units[done.units["time_s"] == 300.0]
    for _, cars in units.groupby("train", observed=True):
        first, middle, last = cars["coupler_force_n"].to_numpy()[:3]
        speed = float(cars["speed_mps"].mean())
        resistance = 1.176e-2 + 7.7616e-4 * speed + 1.6e-5 * speed**2
        assert first == pytest.approx(80e3 * resistance, rel=0.01)  # nobody speeds up there
        assert last == pytest.approx(-first, rel=1e-3) and abs(middle) < 1.0
        assert cars["force_n"].to_numpy() == pytest.approx(160e3 * resistance * np.array([1, 0, 0, 1]), rel=0.01)
    assert done.metrics["units.coupler_force_max_n"] > 25e3
    assert done.metrics["bounds.coupler_upper_margin_m"] < 0.5e-3, "they use half of their range"
    assert done.metrics["bounds.broken"] == 0


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({CAR + "force_share": "mass"}, "train_type.emu: traction_n = 0: must be above 0 (leave it out for no limit)"),
        ({CAR + "traction_n": 0}, "train_type.emu: traction_n = 0: must be above 0 (leave it out for no limit)"),
        ({CAR + "traction_n": [1, -1, 1, 1]}, "train_type.emu: traction_n = -1: must be above 0 (leave it out for no limit)"),
        ({CAR + "force_share": "weight"}, "train_type.emu.force_share = weight: input should be 'mass' or 'installed'"),
        (
            {"controller": {"law": "emu_finite_time"}},
            "train_type.emu.force_share = installed: law emu_finite_time gives every unit its own force",
        ),
    ],
)
def test_what_such_trains_cannot_have(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError) as refused:
        open_scenario("motor_cars", settings)
    assert said in "\n".join(refused.value.mistakes)
