"""The package from Python."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import nets
import numpy as np
import pytest
import tomli_w

import trainctl
from trainctl.errors import InputError, SimulatorError
from trainctl.sumo.session import Sumo

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
    with pytest.raises(InputError, match="not a run folder: it is a file"):
        trainctl.open(run.folder / "run.json")


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


@pytest.fixture(scope="module")
def convoy(tmp_path_factory):
    """Trains of two branches that join: of each a first one, which couple."""
    folder = tmp_path_factory.mktemp("convoy")
    nets.branches(folder, number=1)
    (folder / "s.toml").write_text(tomli_w.dumps(nets.scenario("robust_constrained", 400)))
    return folder / "s.toml"


def test_a_train_in_no_formation_obeys_as_well(convoy):
    with trainctl.Simulation.open(convoy, backend="numeric") as sim:
        sim.step(20)
        i = sim.trains.index("w.0")
        assert sim.links.empty and sim.speed_mps[i] == 35.0
        sim.command({"w.0": -0.3})
        sim.step(10)
        assert sim.speed_mps[i] == pytest.approx(32.0)
        sim.release("w.0")
        sim.step(20)
        assert sim.speed_mps[i] > 33.0


def test_a_train_in_a_formation_obeys_as_well(convoy):
    with trainctl.Simulation.open(convoy, backend="numeric") as sim:
        while sim.links.empty:
            sim.step()
        sim.step(5)
        front, rear = (sim.trains.index(name) for name in ("w.0", "s.0"))
        before = sim.speed_mps
        sim.command({"s.0": -0.05})
        sim.step(4)
        assert sim.speed_mps[rear] == pytest.approx(before[rear] - 0.2)
        assert sim.speed_mps[front] != pytest.approx(before[front] - 0.2)


def test_every_train_has_the_reference_it_follows(convoy):
    with trainctl.Simulation.open(convoy, backend="numeric") as sim:
        with pytest.raises(InputError, match=r"reference_of"):
            _ = sim.reference
        sim.step(20)
        for k, name in enumerate(sim.trains):  # alone: itself
            assert sim.reference_of(name) == (sim.position_m[k], sim.speed_mps[k])
        while sim.links.empty:
            sim.step()
        sim.step(120)
        front, rear = (sim.trains.index(name) for name in ("w.0", "s.0"))
        x, v = sim.reference_of("w.0")
        assert x == pytest.approx(sim.position_m[front], abs=5.0) and v == pytest.approx(sim.speed_mps[front], abs=0.1)
        behind, same = sim.reference_of("s.0")
        assert same == v and behind - sim.position_m[rear] == pytest.approx(1200.0, abs=5.0)  # its slot, along its own way
        with pytest.raises(InputError, match="no such train"):
            sim.reference_of("nobody")


def test_what_can_be_read_agrees():
    with trainctl.Simulation.open("three_tracks", backend="numeric", **SHORT) as sim:
        assert sim.reference == sim.reference_of("5") == (24400.0, 80.0)
        sim.step(8)
        links, x = sim.links, dict(zip(sim.trains, sim.position_m, strict=True))
        row = links[(links["sender"] == "1") & (links["receiver"] == "2")].iloc[0]
        assert row["spacing_m"] == x["1"] - x["2"]
        leading = sim.units[sim.units["unit"] == 1]
        np.testing.assert_allclose(leading["position_m"], sim.position_m, atol=1e-9)
        assert "8 s" in repr(sim)
    with pytest.raises(InputError, match="ended"):
        sim.step()


def orders(folder):
    """What became of orders from outside, in their order: the switch taken, or the reason why not."""
    told = [e for e in trainctl.open(folder).events if e["kind"].startswith("reroute") and e["train"] == "1"]
    return [(e["time_s"], e.get("crossover") or e["reason"]) for e in told]


def test_a_train_is_rerouted_from_outside_over_the_next_switch_it_can_stop_before(tmp_path):
    settings = {"run.duration_s": 150, "supervisor.mode": "on"}
    with trainctl.Simulation.open("three_tracks", backend="numeric", out=tmp_path / "r", **settings) as sim:
        with pytest.raises(InputError, match="no such crossover"):
            sim.reroute("1", crossover="nix")
        with pytest.raises(InputError, match="exactly one of crossover, to_track, to_edge"):
            sim.reroute("1")
        with pytest.raises(InputError, match="no such track"):
            sim.reroute("1", to_track="9")
        with pytest.raises(InputError, match="no such edge"):
            sim.reroute("1", to_edge="nowhere")
        sim.reroute("1", to_track="3")  # at 25 km is one, but the train at 24.4 km needs 5 km to stop
        sim.step(137)
        assert sim.track[0] == "1" and sim.position_m[0] < 35000
        sim.step(10)
        assert sim.track[0] == "3"
        assert sim.speed_mps[0] < 44.444 + 0.01, "braked for the crossover"
        sim.step()
        assert "1" not in set(sim.links["sender"])
    assert orders(tmp_path / "r") == [(0.0, "x1-3_35000")]


#: Braking as no train can: switches are locked for 160 m only, and the trains run on.
STRONG = {"supervisor.emergency_mps2": 20.0, "supervisor.service_mps2": 20.0}


def test_an_order_waits_for_its_place_its_speed_and_its_gap(tmp_path):
    with trainctl.Simulation.open("three_tracks", backend="numeric", out=tmp_path / "r", **SHORT, **STRONG) as sim:
        sim.reroute("1", crossover="leave", position_m=25000.0)
        sim.reroute("2", crossover="leave", speed_below_mps=80.0)
        sim.reroute("1", crossover="leave", gap_below_m=1e6)  # it leads: there is no gap
        sim.reroute("3", crossover="leave", gap_below_m=7600.0)
        sim.step(48)
    trains = trainctl.open(tmp_path / "r").trains.astype({"train": str})
    one, two, three = (trains[trains["train"] == name].set_index("time_s") for name in "123")
    told = [(e["time_s"], e["train"]) for e in trainctl.open(tmp_path / "r").events if e["kind"] == "reroute" and e["time_s"] > 0]
    assert told == sorted([
        (one.index[one["position_m"] >= 25000.0][0], "1"), (two.index[two["speed_mps"] < 80.0][0], "2"),
        (three.index[three["gap_m"] < 7600.0][0], "3"),
    ])  # fmt: skip


def test_what_cannot_be_followed_is_told_with_the_reason_and_changes_nothing(tmp_path):
    with trainctl.Simulation.open("three_tracks", backend="numeric", out=tmp_path / "r", **SHORT) as sim:
        sim.reroute("1", crossover="x1-3_25000")
        sim.reroute("1", to_track="3")
        sim.reroute("1", to_track="1")
        sim.step(48)
        assert sim.track[0] == "1"
    (_, locked), (_, fast), (_, already) = orders(tmp_path / "r")
    assert locked.startswith("switch x1-3_25000 at 25000.0 m is locked: 600.0 m ahead, braking takes ")
    assert fast.startswith("crossover x1-3_35000 allows 44.444 m/s, the train runs at 85 m/s and nothing would brake it")
    assert already == "the train is on track 1 already"
    assert trainctl.open(tmp_path / "r").info["status"] == "complete"


def test_trains_of_a_configuration_step_by_step(tmp_path):
    with trainctl.Simulation.open("merging", backend="numeric", out=tmp_path / "r", **{"run.duration_s": 60}) as sim:
        assert sim.state["train"].tolist()[0] == "fast.0"
        sim.reroute("fast.0", to_edge="to_north")
        with pytest.raises(InputError, match="to_edge = to_south: no such edge"):
            sim.reroute("fast.0", to_edge="to_south")
        sim.step(60)
        assert sim.track[0] == "from_west"
    run = trainctl.open(tmp_path / "r")
    (event,) = [e for e in run.events if e["kind"] == "reroute"]
    assert event["to_edge"] == "to_north" and event["from_edge"] != "from_west"
    there = run.trains.groupby("train", observed=True)["time_s"].min()
    assert there["fast.0"] == 0.0 and 20.0 < there["branch.0"] < 40.0
    assert "fast.2" not in there, "rows are of trains that are there"


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


@pytest.mark.parametrize("backend", ["numeric", "sumo"])
def test_three_threads_run_at_once_or_are_told_and_the_next_run_is_as_ever(backend, tmp_path):
    """Without SUMO all of them run; SUMO holds one run per process, and who comes too early gets one error, always the same."""

    def run_in(name):
        try:
            done = trainctl.run("fully_distributed", backend=backend, out=tmp_path / name, **{"run.duration_s": 24})
            return done.trains.to_csv()
        except SimulatorError as error:
            return error

    alone = run_in("alone")
    assert isinstance(alone, str)
    with ThreadPoolExecutor(3) as threads:
        came = list(threads.map(run_in, "abc"))
    ran = [one for one in came if isinstance(one, str)]
    assert set(ran) == {alone} and len(ran) >= (3 if backend == "numeric" else 1)
    assert {str(one) for one in came if isinstance(one, SimulatorError)} <= {
        "SUMO already runs in this process; it can hold one simulation at a time"
    }
    assert run_in("after") == alone


def test_who_looked_for_sumo_before_another_run_began_does_not_take_it_away(tmp_path, monkeypatch):
    """Two threads may both find none running, and then start theirs one after the other."""
    with trainctl.Simulation.open("fully_distributed", out=tmp_path / "first", **{"run.duration_s": 24}) as first:
        first.step(3)
        looked = Sumo._ready
        seen: list[None] = []
        monkeypatch.setattr(Sumo, "_ready", lambda self: looked(self) if seen else seen.append(None))
        with pytest.raises(SimulatorError, match="already runs in this process"):
            trainctl.run("fully_distributed", out=tmp_path / "second", **{"run.duration_s": 24})
        first.step(21)
        assert first.done


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
