"""Watching over TraCI, with the program that has no window: the loop, the picture and the replay are the same."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import nets
import numpy as np
import pandas as pd
import pytest
import tomli_w

from trainctl.cli.program import main
from trainctl.errors import InputError, SimulatorError
from trainctl.runner import run
from trainctl.scenario.build import open_scenario
from trainctl.sumo import gui
from trainctl.sumo.replay import replay

#: Train 1 takes the crossover to track 3 at 99.945 km in the 7th second; braking is strong, so that it is not locked.
REROUTED = """extends = "three_tracks"
[run]
duration_s = 16
[supervisor]
emergency_mps2 = 20.0
service_mps2 = 20.0
[[event]]
kind = "reroute"
train = 1
to_track = 3
""" + "".join(
    f"[[train]]\nid = {k}\nposition_m = {x + 75000.0}\n"
    for k, x in enumerate((24400.0, 21400.0, 13400.0, 12400.0, 9400.0, 400.0), 1)
)


@pytest.fixture
def scenario(tmp_path):
    (tmp_path / "s.toml").write_text(REROUTED)
    return open_scenario(str(tmp_path / "s.toml"))


def test_a_watched_run_is_the_same_run(scenario, tmp_path, monkeypatch):
    colours, arcs = {}, []
    add, colour = gui.traci.polygon.add, gui.traci.vehicle.setColor
    monkeypatch.setattr(gui.traci.polygon, "add", lambda name, *a, **k: (arcs.append(name), add(name, *a, **k)))
    monkeypatch.setattr(gui.traci.vehicle, "setColor", lambda name, c: (colours.setdefault(name, []).append(c), colour(name, c)))
    watched = run(scenario, tmp_path / "watched", gui="sumo")
    plain = run(scenario, tmp_path / "plain")
    for name in ("trains", "units", "links"):
        assert (watched.folder / f"{name}.parquet").read_bytes() == (plain.folder / f"{name}.parquet").read_bytes()
    # train 1 leads until it leaves; then train 2 does
    assert (colours["1"][0], colours["1"][-1]) == (gui.FIRST, gui.ALONE)
    assert (colours["2"][0], colours["2"][-1]) == (gui.MEMBER, gui.FIRST)
    assert colours["5"][0] == gui.ALONE
    links = [a for a in arcs if a.startswith("link_")]
    assert {"link_1_2", "link_2_1", "link_4_6"} <= set(links)
    assert links.count("link_2_3") == 2  # drawn again when the links changed
    picture = ET.parse(watched.folder / "sumo" / "picture.add.xml").getroot()
    assert {"track_1", "track_2", "track_3", "crossover_leave"} <= {p.get("id") for p in picture}


def test_a_run_is_shown_again(scenario, tmp_path, monkeypatch):
    seen = []
    read = gui.Gui.move
    monkeypatch.setattr(gui.Gui, "move", lambda self, *a: (read(self, *a), seen.append(self.seen.position.copy())))
    for backend in ("sumo", "numeric"):
        seen.clear()
        done = run(scenario, tmp_path / backend, backend)
        assert replay(done, "sumo", from_s=2.0, delay_ms=0.0) == 14
        wanted = done.trains.pivot(index="time_s", columns="train", values="position_m").loc[3.0:].to_numpy()
        np.testing.assert_allclose(seen, wanted, atol=1e-6)


def test_a_run_recorded_seldom_is_shown_too(tmp_path):
    done = run(open_scenario("three_tracks", {"run.duration_s": 120, "run.record_every_s": 50}), tmp_path / "r", "numeric")
    assert replay(done, "sumo") == 2  # 0, 50, 100; the last row, at 120 s, is out of step
    with pytest.raises(InputError, match="fewer than two"):
        replay(done, "sumo", from_s=101.0)


def test_without_a_display_or_program_it_is_one_line(scenario, tmp_path, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(InputError, match="no display"):
        run(scenario, tmp_path / "r", gui="sumo-gui")
    with pytest.raises(InputError, match="no such program"):
        run(scenario, tmp_path / "r", gui="no-such-sumo")
    assert not list(tmp_path.glob("r*"))


def test_a_window_that_is_closed_ends_the_run(scenario, tmp_path, monkeypatch):
    def closed(self):
        raise gui.traci.FatalTraCIError("connection closed")

    monkeypatch.setattr(gui.Gui, "_draw", closed)
    with pytest.raises(SimulatorError, match="was its window closed"):
        run(scenario, tmp_path / "r", gui="sumo")
    assert (tmp_path / "r.partial" / "run.json").is_file()
    monkeypatch.undo()
    assert run(scenario, tmp_path / "r", gui="sumo").info["status"] == "complete"  # the next one starts


def test_from_the_command_line(tmp_path, monkeypatch, capsys):
    def typed(*words):
        monkeypatch.setattr("sys.argv", ["trainctl", *words])
        with pytest.raises(SystemExit) as end:
            main()
        return end.value.code

    monkeypatch.chdir(tmp_path)
    watch = ("run", "fully_distributed", "--gui", "--gui-program", "sumo", "--set", "run.duration_s=5", "-q", "--out", "r")
    assert typed(*watch) == 0
    assert typed("replay", "r", "--gui-program", "sumo") == 0
    assert capsys.readouterr().out.strip() == "5 steps shown"
    assert typed(*watch, "--backend", "numeric") == 2
    assert "--gui: " in capsys.readouterr().err
    assert typed("replay", "r", "--from-s", "-1") == 2


@pytest.mark.parametrize(
    ("law", "length", "until"), [("robust_constrained", 100.0, 330), ("robust_constrained", 700.0, 96), ("sumo", 100.0, 330)]
)
def test_trains_that_turn_back_are_shown_again(law, length, until, tmp_path, monkeypatch):
    """Edge by edge, to and fro; the long one turns on two edges in the last step but one, before it has run over any of them."""
    stops = "".join(f'<stop lane="{e}_0" endPos="{x}" duration="10"/>' for e, x in (("bc", 400), ("-ab", 900)))
    types = nets.EMU.replace('length="100"', f'length="{length}"')
    internal = () if length < 400.0 else ("--no-internal-links",)
    nets.terminals(tmp_path, nets.train("v", "ab bc -bc -ab ab bc", 0, stops), *internal, scale=0.5, types=types)
    if law == "sumo":
        tables = nets.scenario("robust_constrained", until) | {"controller": {"law": "sumo"}}
        tables = {k: v for k, v in tables.items() if k not in ("plant", "bounds", "topology")}
        tables["topology"] = {"spacing_m": 1200.0}
    else:
        kind = nets.LAWS["robust_constrained"]["train_type"] | {"unit_length_m": length}
        tables = nets.scenario(law, until, train_type={"emu": kind})
    (tmp_path / "s.toml").write_text(tomli_w.dumps(tables))
    done = run(open_scenario(str(tmp_path / "s.toml")), tmp_path / "out")
    shown = {}
    move = gui.Gui.move

    def moved(self, *arguments):
        move(self, *arguments)
        if "v" in self.api.vehicle.getIDList():
            shown[self.now()] = (self.api.vehicle.getRoadID("v"), self.api.vehicle.getLanePosition("v"))

    monkeypatch.setattr(gui.Gui, "move", moved)
    assert replay(done, "sumo", delay_ms=0.0) > 0.9 * until
    log = pd.read_parquet(done.folder / "sumo" / "fcd.parquet").set_index("timestep_time")
    assert len(shown) >= len(log) - 2
    near = 1.0 if law == "sumo" else 0.05  # SUMO's own train still moves in the step in which it turns
    for t, (edge, place) in shown.items():
        row = log.loc[t]
        assert row.vehicle_lane.rpartition("_")[0] == edge or place < near, t
        assert abs(row.vehicle_pos - place) < near or row.vehicle_lane.rpartition("_")[0] != edge, t
    assert {edge for edge, _ in shown.values()} >= ({"-ab", "ab", "bc", "-bc"} if length < 400.0 else {"bc", "-ab"})
