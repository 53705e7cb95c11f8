"""The package from Python."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import trainctl
from trainctl.errors import InputError, SimulatorError

SHORT = {"run.duration_s": 48}


def test_import_is_light():
    code = (
        "import sys, trainctl; heavy = {'numpy', 'numba', 'pandas', 'libsumo', 'matplotlib', 'pydantic'};"
        "print(sorted(heavy & set(sys.modules)), sorted({'run', 'open', 'Simulation', 'Run'} - set(dir(trainctl))))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[] []"
    with pytest.raises(AttributeError, match="nonsense"):
        _ = trainctl.nonsense


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return trainctl.run("three_tracks", backend="numeric", out=tmp_path_factory.mktemp("api") / "r", **SHORT)


def test_a_run_has_tables_metrics_and_figures(run):
    assert set(run.trains["train"].astype(str)) == {"1", "2", "3", "4", "5", "6"}
    assert run.trains["time_s"].max() == 48.0
    assert run.metrics["bounds.broken"] == 0
    assert {"spacing", "unit_forces"} <= set(dir(run.plot))
    assert run.plot.spacing(width="single")._repr_png_().startswith(b"\x89PNG")
    with pytest.raises(AttributeError, match="no figure nonsense"):
        run.plot.nonsense()


def test_a_run_tells_of_itself_and_can_be_opened_again(run):
    assert "fully_distributed on coupled_units, 6 trains" in run._repr_html_()
    assert "<td>complete</td>" in run._repr_html_()
    again = trainctl.open(run.folder)
    assert repr(again) == repr(run)
    with pytest.raises(InputError, match="no such directory"):
        trainctl.open(run.folder / "nothing")


def test_mistakes_come_all_at_once():
    with pytest.raises(InputError) as caught:
        trainctl.run("three_tracks", **{"run.duration_s": -1, "bounds.sped": 3})
    assert len(caught.value.mistakes) == 2


@pytest.mark.parametrize("backend", ["numeric", "sumo"])
def test_step_by_step_is_the_same_run(run, tmp_path, backend):
    with trainctl.Simulation.open("three_tracks", backend=backend, out=tmp_path / "r", **SHORT) as sim:
        assert sim.time == 0.0
        while not sim.done:
            sim.step()
        state = sim.state
    stepped = trainctl.open(tmp_path / "r")
    assert stepped.info["status"] == "complete"
    for column in ("position_m", "speed_mps", "input_mps2"):
        difference = stepped.trains[column].to_numpy() - run.trains[column].to_numpy()
        assert np.nanmax(np.abs(difference)) <= (0.0 if backend == "numeric" else 1e-7)
    last = stepped.trains[stepped.trains["time_s"] == 48.0]
    np.testing.assert_array_equal(state["position_m"], last["position_m"])


def test_trains_obey_a_command_from_outside_until_released():
    with trainctl.Simulation.open("fully_distributed", backend="numeric", **{"run.duration_s": 20}) as sim:
        before = sim.speed_mps
        sim.command({"3": 0.125})
        sim.step(4)
        assert sim.speed_mps[2] == before[2] + 4 * 0.125
        sim.release()
        sim.step()
        assert sim.speed_mps[2] != before[2] + 5 * 0.125
        for wrong in ({"9": 0.0}, {"3": float("nan")}):
            with pytest.raises(InputError):
                sim.command(wrong)


def test_what_can_be_read_agrees():
    with trainctl.Simulation.open("three_tracks", backend="numeric", **SHORT) as sim:
        assert sim.reference == (24400.0, 80.0)
        sim.step(8)
        links, x = sim.links, dict(zip(sim.trains, sim.position_m, strict=True))
        row = links[(links["sender"] == "1") & (links["receiver"] == "2")].iloc[0]
        assert row["spacing_m"] == x["1"] - x["2"]
        heads = sim.units[sim.units["unit"] == 1]
        np.testing.assert_allclose(heads["position_m"], sim.position_m, atol=1e-9)
        assert "8 s" in repr(sim)
    with pytest.raises(InputError, match="ended"):
        sim.step()


def test_a_train_is_rerouted_from_outside():
    with trainctl.Simulation.open("three_tracks", backend="numeric", **{"run.duration_s": 60}) as sim:
        with pytest.raises(InputError, match="no such crossover"):
            sim.reroute("1", crossover="nix")
        with pytest.raises(InputError, match="either"):
            sim.reroute("1")
        with pytest.raises(InputError, match="no such track"):
            sim.reroute("1", to_track="9")
        sim.reroute("1", to_track="3")  # at 25 km, the train is at 24.4 km
        sim.step(8)
        assert sim.track[0] == "3"
        sim.step()
        assert "1" not in set(sim.links["sender"])


def test_a_continuous_law_cannot_be_commanded():
    with (
        trainctl.Simulation.open("emu_finite_time", backend="numeric", **{"run.duration_s": 4}) as sim,
        pytest.raises(InputError, match="inside the integrator"),
    ):
        sim.command({"1": 0.0})


def test_one_simulation_of_sumo_at_a_time_and_the_second_leaves_nothing(tmp_path):
    with trainctl.Simulation.open("fully_distributed", **{"run.duration_s": 5}) as first:
        with pytest.raises(SimulatorError, match="one simulation at a time"):
            trainctl.Simulation.open("fully_distributed", **{"run.duration_s": 5})
        first.step()
    with trainctl.Simulation.open("fully_distributed", **{"run.duration_s": 5}) as second:
        second.step(5)
        assert second.done


def test_an_error_in_the_users_loop_marks_the_run_as_failed(tmp_path):
    with (
        pytest.raises(ZeroDivisionError),
        trainctl.Simulation.open("fully_distributed", backend="numeric", out=tmp_path / "r") as sim,
    ):
        sim.step(3)
        1 / 0  # noqa: B018
    assert not (tmp_path / "r").exists()
    left = trainctl.open(tmp_path / "r.partial")
    assert (left.info["status"], left.info["steps"]) == ("failed", 3)
