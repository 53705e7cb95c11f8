"""Trains whose tails lie behind the beginning of their ways: nobody runs into them, and none is put onto another."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import nets
import pytest
import tomli_w

import trainctl
from trainctl.runner import run
from trainctl.scenario.build import open_scenario

#: The first train brakes, the second pulls, whatever is ahead.
LAW = '''
import numpy as np
from trainctl.signals import Demand, Table

CLOCK = "sampled"


class Params(Table):
    """None."""


def violations(params, scene):
    return []


def constants(params, scene):
    return params


def message(constants, own, leader):
    return np.column_stack((own.position, own.speed))


def demand(constants, own, leader, links, heard):
    return Demand(np.where(np.arange(len(own.speed)) > 0, 1.0, -2.0), np.zeros(len(own.speed), bool))
'''


def scenario(folder: Path, mode: str) -> Path:
    """A train of 400 m stands 200 m beyond the beginning of an edge, where its way begins; another comes from behind at 50 m/s."""
    (folder / "law.py").write_text(LAW)
    kind = nets.TYPE | {"unit_length_m": 400.0}
    train = {"type": "emu", "track": "1"}
    tables: dict[str, Any] = {
        "schema_version": 1, "title": "a tail", "run": {"duration_s": 90.0}, "network": {"line": "single_track"},
        "controller": {"law": "law.py"}, "plant": {"kind": "point", "speed_lower_mps": 0.0}, "reference": {"speed_mps": 50.0},
        "topology": {"spacing_m": 1500.0}, "supervisor": {"mode": mode}, "train_type": {"emu": kind},
        "train": [
            train | {"id": "1", "position_m": 40200.0, "speed_mps": 0.0}, train | {"id": "2", "position_m": 37700.0, "speed_mps": 50.0}
        ],
    }  # fmt: skip
    (folder / "s.toml").write_text(tomli_w.dumps(tables))
    return folder / "s.toml"


@pytest.mark.parametrize("backend", ["numeric", "sumo"])
def test_a_train_stops_short_of_a_tail_behind_the_beginning_of_a_way(tmp_path, backend):
    with trainctl.Simulation.open(scenario(tmp_path, "on"), backend=backend, out=tmp_path / "run") as sim:
        while not sim.done:
            sim.step()
            assert sim.position_m[1] <= 39800.0 - 20.0 + 1e-6  # the margin
        assert sim.position_m[1] > 39700.0
    log = tmp_path / "run" / "sumo" / "collisions.xml"
    assert backend == "numeric" or "<collision " not in log.read_text()


def test_without_supervisor_it_runs_into_it_and_that_is_told(tmp_path):
    with trainctl.Simulation.open(scenario(tmp_path, "monitor"), backend="numeric", out=tmp_path / "run") as sim:
        while not sim.done:
            sim.step()
    told = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    assert any(e["kind"] == "violation" and e["bound"] == "gap_m" for e in told)


def test_a_train_whose_tail_would_lie_on_another_waits(tmp_path):
    """It starts on a passing loop, its tail on the single track behind, where another has just come off the loop the other way."""
    body = nets.train("down", "down1 -left", 0) + nets.train("up", "up1 middle up2 right", 56, departPos="0")
    nets.single_track(tmp_path, body)
    (tmp_path / "s.toml").write_text(tomli_w.dumps(nets.scenario("robust_constrained", 90, supervisor={"mode": "on"})))
    prepared = open_scenario(str(tmp_path / "s.toml"))
    found = run(prepared, tmp_path / "run", "numeric")
    [enters] = [e["time_s"] for e in found.events if e["kind"] == "depart" and e["train"] == "up"]
    way = prepared.rails.way(["down1", "-left"])
    begin = prepared.rails.start_m[way[0]] + prepared.rails.length_m[way[:-1]].sum()
    down = found.trains[found.trains.train.astype(str) == "down"].set_index("time_s").position_m - begin
    onto = prepared.rails.length_m[way[1]]  # the tail begins on the junction
    assert 0.0 < down[56.0] < 200.0 - onto
    assert enters > 56.0
    # 100 m of its own, 100 m of the other; it is let in one step before it is there
    assert down[enters - 2.0] < 200.0 - onto <= down[enters - 1.0]
