"""SUMO's own trains through us and without us: the same traffic; blocks that hold; a record like any other run's."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sumo_net.build import netconvert
from trainctl import runner
from trainctl.errors import InputError, SimulatorError
from trainctl.runs.run import Run
from trainctl.scenario.build import open_scenario
from trainctl.scenario.reading import examine
from trainctl.signals import GRAVITY
from trainctl.studies import capacity
from trainctl.sumo.baseline import Baseline

SECTION = 24000.0
SCENARIOS = Path(__file__).parents[2] / "scenarios"


def scenario(folder: Path, *, trains: int = 6, line: Mapping[str, Any] | None = None, **controller: Any) -> Path:
    """A line of 30 km and trains that wait at its kilometre 1, in the order of their tables."""
    import tomli_w

    spec = {"name": "short", "tracks": ["1"], "length_m": 30000.0, "speed": [[0.0, 83.333]]} | dict(line or {})
    (folder / "short.toml").write_text(tomli_w.dumps(spec))
    tables = {
        "schema_version": 1, "title": "SUMO's own trains", "run": {"duration_s": 1500.0, "step_s": 1.0},
        "network": {"line": "short.toml"}, "controller": {"law": "sumo", "entry_m": 1000.0} | controller,
        "reference": {"speed_mps": 83.333}, "topology": {"spacing_m": 3000.0}, "bounds": {"speed_upper_mps": 83.333},
        "train_type": {"ice3": {
            "unit_length_m": 200.0, "unit_mass_kg": 420e3, "rotating_mass_factor": 1.04,
            "c0_n_per_kg": 0.0177, "c1_ns_per_m_kg": 3e-4, "c2_ns2_per_m2_kg": 1.85e-5,
        }},
        "train": [{"id": k + 1, "type": "ice3", "track": "1", "position_m": 25000.0 - 3000.0 * k, "speed_mps": 0.0}
                  for k in range(trains)],
    }  # fmt: skip
    path = folder / "short_scenario.toml"
    path.write_text(tomli_w.dumps(tables))
    return path


def run(path: Path, out: Path, **overrides: Any) -> Run:
    return runner.run(open_scenario(str(path), overrides), out)


def passages(frame: Any, at: float) -> np.ndarray:
    """Times at which fronts pass a kilometrage."""
    found = []
    for _, rows in frame.groupby("train", observed=True):
        x, t = rows["position_m"].to_numpy(), rows["time_s"].to_numpy()
        if x[0] < at <= x[-1]:
            found.append(np.interp(at, x, t))
    return np.sort(found)


def without_us(
    folder: Path, net: Path, moving: bool, trains: int = 6, entry: float = 1000.0, section: float = SECTION, until: int = 1500
) -> np.ndarray:
    """Passages at the section as a detector of SUMO's sees them, with routes of this test's own."""
    edges = [e.get("id") for e in ElementTree.parse(net).iter("edge") if e.get("function") != "internal"]
    edges.sort(key=lambda name: float(str(name).partition("_")[2]))
    on = next(e for e in reversed(edges) if float(e.partition("_")[2]) < section)
    first = next(e for e in reversed(edges) if float(e.partition("_")[2]) <= entry)
    at = entry - float(first.partition("_")[2])
    (folder / "own.rou.xml").write_text(
        '<routes><vType id="t" vClass="rail" carFollowModel="Rail" trainType="ICE3" maxSpeed="83.333" speedFactor="1" speedDev="0"/>'
        f'<route id="r" edges="{" ".join(edges[edges.index(first) :])}"/>'
        + "".join(f'<vehicle id="v{k}" type="t" route="r" depart="0" departPos="{at}"/>' for k in range(trains))
        + "</routes>"
    )
    at = section - float(on.partition("_")[2])
    (folder / "own.add.xml").write_text(
        f'<additional><instantInductionLoop id="d" lane="{on}_0" pos="{at}" file="own.det.xml"/></additional>'
    )
    program, environment = netconvert()
    command = [str(program.parent / "sumo"), "-n", str(net), "-r", "own.rou.xml", "-a", "own.add.xml", "-e", str(until)]
    command += ["--time-to-teleport", "-1", "--no-step-log", "--no-warnings", "--default.speeddev", "0", "--no-internal-links"]
    subprocess.run([*command, *(["--railsignal-moving-block"] if moving else [])], cwd=folder, env=environment, check=True)
    events = ElementTree.parse(folder / "own.det.xml").iter("instantOut")
    return np.sort([float(e.get("time", "nan")) for e in events if e.get("state") == "enter"])


@pytest.mark.parametrize(("block", "signals_m"), [("fixed", 2000.0), ("fixed", 5000.0), ("moving", 2000.0)])
def test_headways_are_those_of_sumo_without_us(tmp_path: Path, block: str, signals_m: float) -> None:
    ours = passages(run(scenario(tmp_path, block=block, signals_m=signals_m), tmp_path / "run").trains, SECTION)
    theirs = without_us(tmp_path, tmp_path / "run" / "sumo" / "short.net.xml", block == "moving")
    assert len(ours) == len(theirs) == 6
    print(block, signals_m, np.diff(ours).round(2), np.diff(theirs).round(2))
    np.testing.assert_allclose(np.diff(ours), np.diff(theirs), atol=1.0)


@pytest.mark.campaign
@pytest.mark.parametrize("block", ["fixed", "moving"])
def test_the_rows_of_the_capacity_table_are_those_of_sumo_without_us(tmp_path: Path, block: str) -> None:
    plan, row = capacity.CapacityPlan(), f"{block}_block"
    capacity.prepare_files(plan, tmp_path, [row])
    ours = capacity.one(tmp_path / f"{row}.toml", tmp_path / row, plan)
    net = tmp_path / row / "sumo" / "capacity.net.xml"
    theirs = np.diff(without_us(tmp_path, net, block == "moving", plan.trains, plan.begin_m, plan.end_m, 10_000))
    print(row, ours["headway_s"], np.median(theirs), ours["headway_mean_s"], theirs.mean())
    assert len(theirs) == plan.trains - 1
    assert abs(ours["headway_s"] - np.median(theirs)) < 1.0 and abs(ours["headway_mean_s"] - theirs.mean()) < 1.0


def test_a_block_holds_one_train_and_moving_block_does_not(tmp_path: Path) -> None:
    most = {}
    for block in ("fixed", "moving"):
        trains = run(scenario(tmp_path, block=block, signals_m=5000.0), tmp_path / block).trains
        front = np.floor(trains["position_m"] / 5000.0)
        most[block] = trains.assign(block=front).groupby(["time_s", "block"], observed=True).size().max()
    assert most["fixed"] == 1 and most["moving"] > 1, most


def test_energies_balance_with_the_kinetic_energy(tmp_path: Path) -> None:
    hilly = {"gradient": [[5000.0, 8.0], [9000.0, -6.0], [12000.0, 0.0]]}
    path = scenario(tmp_path, trains=2, block="moving", line=hilly)
    done = run(path, tmp_path / "run", **{"run.record_every_s": 7.0, "run.duration_s": 350.0})
    for _, rows in done.trains.groupby("train", observed=True):
        gained = 0.5 * 420e3 * 1.04 * (rows["speed_mps"].iloc[-1] ** 2 - rows["speed_mps"].iloc[0] ** 2)
        sums = rows[["traction_j", "braking_j", "resistance_j", "gradient_j"]].iloc[1:].sum()
        balance = sums["traction_j"] - sums["braking_j"] - sums["resistance_j"] - sums["gradient_j"]
        assert gained == pytest.approx(balance, rel=1e-9, abs=1.0)
        climbed = 420e3 * GRAVITY * (8e-3 * 4000.0 - 6e-3 * 3000.0)
        assert rows["position_m"].iloc[-1] > 12200.0
        assert sums["gradient_j"] == pytest.approx(climbed, abs=420e3 * GRAVITY * 8e-3 * 83.333)  # slopes change once per step


def test_the_resistance_and_traction_are_those_of_sumos_table(tmp_path: Path) -> None:
    """SUMO's ICE3 has 300 kN at first and resists with 7.4 kN; at 300 km/h it resists with 71.8 kN. 436.8 t with rotating mass."""
    trains = run(scenario(tmp_path, trains=1, block="moving", entry_speed_mps=0.0), tmp_path / "run").trains
    speed = trains["speed_mps"].to_numpy()
    force = 436.8e3 * np.diff(speed)
    assert force[0] == pytest.approx((300.0 - 7.4) * 1000.0, rel=1e-6)
    at = np.searchsorted(speed, 270.0 / 3.6) - 1
    expected = np.interp(speed[at] * 3.6, [260.0, 270.0], [111.0 - 56.6, 107.0 - 60.3]) * 1000.0
    assert force[at] == pytest.approx(expected, rel=1e-6)


def test_the_shipped_traffic_runs_under_sumo_and_its_record_is_read(tmp_path: Path) -> None:
    done = runner.run(open_scenario("three_tracks", {"controller.law": "sumo", "controller.block": "moving"}), tmp_path / "run")
    assert done.info["status"] == "complete" and done.info["steps"] == 2400
    changes = {(e["train"], e["track"]) for e in done.events if e["kind"] == "join"}
    assert changes == {("2", "3"), ("5", "1")}
    assert done.metrics["traffic.collisions"] == 0 and done.metrics["traffic.gap_min_m"] > 0.0
    first = done.trains[done.trains["time_s"] == 0.0].set_index("train")
    assert first["position_m"].to_dict() == pytest.approx({t["id"]: t["position_m"] for t in done.scenario["train"]})
    from trainctl.figures.catalogue import plot
    from trainctl.report.page import report

    assert report(done, None).stat().st_size > 10_000
    assert len(plot(done, tmp_path / "figures", ("png",), "double")) >= 2


def test_trains_enter_when_and_how_they_are_told(tmp_path: Path) -> None:
    path = scenario(tmp_path, trains=3, block="moving", entry_speed_mps=60.0, entry_every_s=150.0)
    entered = [e for e in run(path, tmp_path / "run").events if e["kind"] == "depart"]
    told = {"kind": "depart", "delay_s": 0.0, "track": "1", "position_m": 1000.0, "speed_mps": 60.0}
    assert entered == [{"time_s": 150.0 * k, "planned_s": 150.0 * k, "train": str(k + 1), **told} for k in range(3)]


def test_reroutes_come_at_their_place_and_not_inside_the_braking_distance(tmp_path: Path) -> None:
    """From 60 m/s an ICE 3 stops within 3.6 km."""
    # Longer than two blocks: the way over it has fewer edges.
    over = {"id": "over", "from": "1", "to": "2", "position_m": 15000.0, "length_m": 5000.0, "speed_mps": 60.0}
    line = {"tracks": ["1", "2"], "crossover": [over]}
    path = scenario(tmp_path, trains=2, block="moving", line=line, entry_speed_mps=60.0, entry_every_s=200.0, top_speed_mps=60.0)
    orders = [("1", 5000.0), ("2", 14000.0)]
    events = "".join(f'[[event]]\nkind = "reroute"\ntrain = "{t}"\ncrossover = "over"\nposition_m = {x}\n' for t, x in orders)
    path.write_text(path.read_text().replace("25000.0", "1000.0").replace("22000.0", "500.0") + events)
    done = run(path, tmp_path / "run")
    told = [(e["kind"], e["train"]) for e in done.events if e["kind"] in ("reroute", "reroute_refused", "join")]
    assert told == [("reroute", "1"), ("join", "1"), ("reroute_refused", "2")]
    last = done.trains.groupby("train", observed=True).last()
    assert last["track"].to_dict() == {"1": "2", "2": "1"}
    moved = done.trains[done.trains["train"] == "1"]["position_m"].diff().dropna()
    assert moved.between(59.9, 60.1).all()


def test_traffic_of_a_sumo_configuration_runs_as_it_is(tmp_path: Path) -> None:
    """Trains depart, stop and arrive as their files say; the record is that of SUMO's own program on what we gave it."""
    done = runner.run(open_scenario("merging", {"controller.law": "sumo", "controller.block": "moving"}), tmp_path / "run")
    entered = {e["train"]: e for e in done.events if e["kind"] == "depart"}
    assert set(entered) == {"fast.0", "fast.1", "fast.2", "stopping", "branch.0", "branch.1"}
    assert [entered[f"fast.{k}"]["time_s"] for k in range(3)] == [0.0, 70.0, 140.0]
    assert {e["train"] for e in done.events if e["kind"] == "arrive"} >= {"fast.0", "fast.1", "fast.2"}
    trains = done.trains
    stood = trains[(trains["train"] == "stopping") & (trains["speed_mps"] == 0.0)]
    assert len(stood) >= 40 and stood["position_m"].nunique() == 1
    (halt,) = (s for s in ElementTree.parse(tmp_path / "run" / "sumo" / "stops.xml").iter("stopinfo"))
    assert (
        stood["time_s"].min() <= float(halt.get("started", "nan")) < float(halt.get("ended", "nan")) <= stood["time_s"].max() + 1.0
    )
    assert not (trains["gap_m"] < 0.0).any() and done.metrics["traffic.collisions"] == 0
    steps = trains.groupby("train", observed=True)["position_m"].diff().dropna()
    assert steps.min() >= 0.0 and steps.max() <= 45.0  # goes on without a jump from edge to edge
    program, environment = netconvert()
    assert {e["stop"] for e in done.events if e["kind"] == "stop_left"}
    own = [str(program.parent / "sumo"), "-c", str(SCENARIOS / "merging" / "merging.sumocfg"), "-e", "960", "--precision", "9",
           "--railsignal-moving-block", "--fcd-output", "own.xml", "--no-warnings"]  # fmt: skip
    subprocess.run(own, cwd=tmp_path / "run" / "sumo", env=environment, check=True)
    theirs = {
        (float(step.get("time", "nan")), v.get("id")): float(v.get("speed", "nan"))
        for step in ElementTree.parse(tmp_path / "run" / "sumo" / "own.xml").iter("timestep") for v in step
    }  # fmt: skip
    ours = {(row.time_s, row.train): row.speed_mps for row in trains.itertuples() if row.time_s < 960.0}
    assert ours == pytest.approx({key: theirs[key] for key in ours}, abs=1e-6) and len(ours) == len(theirs)


def test_trains_that_find_no_place_are_told(tmp_path: Path) -> None:
    done = run(scenario(tmp_path, signals_m=20000.0), tmp_path / "run", **{"run.duration_s": 60.0})
    assert [e["trains"] for e in done.events if e["kind"] == "not_entered"] == [["2", "3", "4", "5", "6"]]


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        ({"entry_m": 31000.0}, "controller.entry_m = 31000: off the line, 0 .. 30000 m"),
        ({"entry_m": None, "entry_speed_mps": 5.0}, "controller.entry_speed_mps = 5: only with entry_m"),
        ({"entry_m": None, "entry_every_s": 5.0}, "controller.entry_every_s = 5: only with entry_m"),
        ({"block": "half"}, "controller.block = half: input should be 'files', 'fixed' or 'moving'"),
        ({"train_type": "TGV"}, "controller.train_type = TGV: input should be 'Freight'"),
        ({"signals_m": 30000.0}, "controller.signals_m = 30000.0: input should be less than or equal to 20000"),
    ],
)
def test_mistakes_are_one_line(tmp_path: Path, keys: dict[str, Any], line: str) -> None:
    given = {key: value for key, value in ({"entry_m": 1000.0} | keys).items() if value is not None}
    path = scenario(tmp_path)
    data = open_scenario(str(path)).scenario.model_dump(mode="json", exclude_none=True)
    import tomli_w

    path.write_text(tomli_w.dumps(data | {"controller": {"law": "sumo"} | given, "network": {"line": "short.toml"}}))
    with pytest.raises(InputError) as caught:
        run(path, tmp_path / "run")
    assert any(line in mistake for mistake in caught.value.mistakes), caught.value.mistakes
    assert not (tmp_path / "run").exists() and not (tmp_path / "run.partial").exists()


def test_signals_that_cannot_stand_are_found_before_the_run(tmp_path: Path) -> None:
    over = {"id": "over", "from": "1", "to": "2", "position_m": 14000.004, "length_m": 100.0, "speed_mps": 60.0}
    path = scenario(tmp_path, line={"tracks": ["1", "2"], "crossover": [over]})
    with pytest.raises(
        InputError, match=r"short_scenario.toml: network: short: tracks = 1: the signal at 14000 m and the switch of over"
    ):
        open_scenario(str(path))  # 2 km apart by default
    line = open_scenario(str(path), {"controller.signals_m": 3000.0}).line
    assert {x for x in line.start_m.tolist() if x < 7000.0} == {0.0, 3000.0, 6000.0}


def test_what_sumo_would_not_feel_is_refused() -> None:
    from trainctl.scenario.build import model_of
    from trainctl.scenario.reading import read

    data, path = read("fault_tolerant")
    data["controller"] = {"law": "sumo"}
    checked, found = examine(data)
    assert checked is not None
    with pytest.raises(InputError, match="fault: SUMO's own trains take none"):
        model_of(checked, path.name, path.parent, found)


def test_a_net_has_the_signals_it_has() -> None:
    with pytest.raises(InputError) as caught:
        open_scenario("merging", {"controller.law": "sumo", "controller.signals_m": 500.0, "controller.entry_m": 5.0})
    assert "merging.toml: controller.entry_m: network.sumocfg says where and when its trains enter" in caught.value.mistakes
    assert any("controller.signals_m: a net has the signals it has" in line for line in caught.value.mistakes)


def test_fixed_block_needs_signals(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"controller.block = fixed: merging.net.xml has no rail signals"):
        runner.run(open_scenario("merging", {"controller.law": "sumo", "controller.block": "fixed"}), tmp_path / "run")
    assert not (tmp_path / "run.partial").exists()


@pytest.mark.parametrize(("how", "steps"), [("failed", 30), ("interrupted", 31)])
def test_what_was_recorded_stays_if_the_run_does_not_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str, steps: int
) -> None:
    """Whoever asks a run to stop is given the step that is under way, as in every run; ``resume`` begins again."""
    step = Baseline.step

    def trouble(self: Baseline) -> None:
        if self.now() == 30.0 and how == "interrupted":
            os.kill(os.getpid(), signal.SIGTERM)
        elif self.now() == 30.0:
            raise SimulatorError("it broke")
        step(self)

    path, whole = scenario(tmp_path, trains=2), {"run.duration_s": 60.0}
    with monkeypatch.context() as patch:
        patch.setattr(Baseline, "step", trouble)
        with pytest.raises(SimulatorError if how == "failed" else KeyboardInterrupt):
            run(path, tmp_path / "run", **whole)
    left = Run(tmp_path / "run.partial")
    assert (left.info["status"], left.info["steps"], left.info["failure"]["time_s"]) == (how, steps, float(steps))
    assert left.trains["time_s"].max() == steps - 1.0
    done, since = runner.resume(tmp_path / "run")
    run(path, tmp_path / "again", **whole)
    assert (done.info["status"], since) == ("complete", 0.0)
    for file in ("trains.parquet", "events.jsonl", "metrics.json"):
        assert (tmp_path / "run" / file).read_bytes() == (tmp_path / "again" / file).read_bytes()
    assert sorted(p.name for p in (tmp_path / "run").iterdir()) == sorted(p.name for p in (tmp_path / "again").iterdir())


def test_it_drives_by_itself(tmp_path: Path) -> None:
    p = open_scenario("three_tracks", {"controller.law": "sumo"})
    with pytest.raises(InputError, match="SUMO drives the trains itself"):
        runner.run(p, tmp_path / "run", backend="numeric")
    with pytest.raises(InputError, match="SUMO drives the trains itself"), runner.opened(p, tmp_path / "run"):
        pass


def test_the_same_run_gives_the_same_record(tmp_path: Path) -> None:
    path = scenario(tmp_path, trains=3)
    pieces = [run(path, tmp_path / name) for name in ("a", "b")]
    for file in ("trains.parquet", "events.jsonl"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    assert json.dumps(pieces[0].metrics) == json.dumps(pieces[1].metrics)
