"""Slopes of nets nobody here laid out: the one under every unit, by the way of its train."""

from __future__ import annotations

import nets
import numpy as np
import pytest
import tomli_w

from trainctl.railway.ways import under, ways
from trainctl.runner import run
from trainctl.scenario.build import open_scenario
from trainctl.signals import GRAVITY


def test_a_train_over_two_edges_has_a_slope_under_each_unit():
    slope = np.array([0.01, -0.02, 0.03])
    length = np.array([100.0, 200.0, 300.0])
    laid = ways([[0, 1, 2], [2]], np.zeros(3), length)
    row = np.array([1, 3])
    position = np.array([130.0, 105.0, 95.0, -5.0, 40.0])  # the last unit of the first train hangs out behind its way
    found = under(laid, slope, row, np.array([0, 4, 5]), position)
    assert found.tolist() == [-0.02, -0.02, 0.01, 0.01, 0.03]


@pytest.mark.parametrize("law", ["fully_distributed", "emu_finite_time"])
def test_the_weight_of_a_train_is_made_up_for_and_lifted(law, tmp_path):
    """One train up a hill of 60 m at constant speed: its input is greater by g times the slope, and its weight is lifted by 60 m."""
    nodes = {"a": (0, 0), "b": (4000, 0), "c": (8000, 0), "d": (12000, 0)}
    nets.net(tmp_path, nodes, {"flat": ("a", "b"), "hill": ("b", "c"), "top": ("c", "d")})
    sources = tmp_path / "a.nod.xml"
    for name in ("c", "d"):
        sources.write_text(sources.read_text().replace(f'id="{name}"', f'id="{name}" z="60"'))
    nets.convert(tmp_path)
    nets.traffic(tmp_path, nets.train("one", "flat hill top", 0, departSpeed="35"))
    (tmp_path / "s.toml").write_text(tomli_w.dumps(nets.scenario(law, 280)))
    done = run(open_scenario(str(tmp_path / "s.toml")), tmp_path / "run", "numeric")
    trains = done.trains.set_index("time_s")
    assert np.abs(trains.speed_mps - 35.0).max() < 0.05
    climbs, level = trains.loc[180.0], trains.loc[60.0]
    assert climbs.edge == "hill"
    assert climbs.input_mps2 - level.input_mps2 == pytest.approx(GRAVITY * 60.0 / np.hypot(4000.0, 60.0), rel=2e-3)
    if "gradient_j" in trains:
        assert trains.gradient_j.sum() == pytest.approx(200e3 * GRAVITY * 60.0, rel=2e-3)
    assert not [e for e in done.events if e["kind"] == "violation"]


@pytest.mark.parametrize("name", ["emu_finite_time", "fault_tolerant"])
def test_a_continuous_law_does_not_feel_a_slope(name, tmp_path):
    """What a law demands comes on top of what holds the units on the slope; its observer sees the rest."""
    runs = []
    for k, gradient in enumerate(("[]", "[[0.0, 8.0]]")):
        line = tmp_path / f"line{k}.toml"
        line.write_text(f'name = "hill"\ntracks = [1]\nlength_m = 400000.0\nspeed = [[0.0, 100.0]]\ngradient = {gradient}\n')
        settings = {"run.duration_s": 40, "network.line": str(line)}
        runs.append(run(open_scenario(name, settings), tmp_path / str(k), "numeric"))
    level, hill = (r.units for r in runs)
    assert np.abs(hill.position_m - level.position_m).max() < 1e-6
    assert np.abs(hill.speed_mps - level.speed_mps).max() < 1e-7
    last = hill.time_s == 30.0
    mass = open_scenario(name).consists.mass
    np.testing.assert_allclose((hill.force_n - level.force_n)[last], mass * GRAVITY * 0.008, rtol=1e-3)
