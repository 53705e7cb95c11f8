"""What the loop does with the demands of a law before the plant gets them."""

from __future__ import annotations

import numpy as np

import trainctl

PERIOD, LOWER = 8.0, 79.0


def test_what_is_left_of_a_speed_bound_is_for_the_whole_control_period(tmp_path):
    """A law whose model clamps, on units: what it asks for is held for a control period, at whose end the bound must stand."""
    settings = {"run.control_period_s": PERIOD, "controller.h_per_s": 0.1, "topology.weight": 0.001, "run.duration_s": 8}
    with trainctl.Simulation.open("robust_three_tracks", backend="numeric", out=tmp_path / "run", **settings) as sim:
        before = sim.speed_mps.copy()
        sim.command(dict.fromkeys(sim.trains, -100.0))
        sim.step()
        change = sim.speed_mps - before
    assert before.min() == LOWER and before.max() == 85.0
    np.testing.assert_allclose(change, (LOWER - before) / PERIOD, atol=1e-9)  # m/s in a step of 1 s; the brakes could give more
