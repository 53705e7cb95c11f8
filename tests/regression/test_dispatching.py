"""Whose turn it is: nobody waits for ever to enter, a train at its platform holds no track beyond, and no circles on single track."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nets
import pytest
import tomli_w

from trainctl.runner import Backend, run
from trainctl.runs.run import Run
from trainctl.scenario.build import open_scenario


def ran(folder: Path, duration: float, backend: Backend, length: float = 100.0, **tables: Any) -> Run:
    made = nets.scenario("robust_constrained", duration, traffic={"cooperate": []}, **tables)
    made["train_type"]["emu"] = {**made["train_type"]["emu"], "unit_length_m": length}
    (folder / "s.toml").write_text(tomli_w.dumps(made))
    return run(open_scenario(str(folder / "s.toml")), folder / f"out_{backend}_{duration:g}", backend)


def at(found: Run, kind: str) -> dict[str, float]:
    """When each train had its first event of a kind [s]."""
    return {e["train"]: e["time_s"] for e in reversed(found.events) if e["kind"] == kind}


def test_a_branch_train_enters_a_dense_line_in_its_turn(tmp_path):
    """Trains at the smallest headway the line takes; the one from the branch is due at 150 s, and so is one in the middle."""
    nets.net(
        tmp_path,
        {"a": (0, 0), "m": (2000, 0), "b": (5000, 0), "d": (12000, 0), "s": (4200, -300)},
        {"am": ("a", "m"), "mb": ("m", "b"), "bd": ("b", "d"), "sb": ("s", "b")},
    )
    dense = nets.flow("main", "am mb bd", 40, 8)
    nets.traffic(tmp_path, dense + nets.train("branch", "sb bd", 150) + nets.train("middle", "mb bd", 150))
    found = ran(tmp_path, 420, "numeric")
    entered = at(found, "depart")
    assert 150.0 <= entered["branch"] < 260.0 and 150.0 <= entered["middle"] < 300.0
    later = [t for name, t in entered.items() if name.startswith("main") and t > 300.0]
    assert later  # the flow goes on, and was dense all the time
    assert not [e for e in found.events if e["kind"] == "violation"]


@pytest.mark.parametrize("backend", ["numeric", "sumo"])
def test_a_train_at_its_platform_holds_no_single_track_beyond(tmp_path, backend):
    """It stands at the very end of its loop track for 400 s; one that comes the other way meanwhile is not delayed by it."""
    halt = '<stop lane="up1_0" endPos="1990" duration="400"/>'
    arrived = {}
    for name, body in (("alone", ""), ("both", nets.train("up", nets.UP, 0, halt))):
        (tmp_path / name).mkdir()
        nets.single_track(tmp_path / name, body + nets.train("down", nets.DOWN, 200))
        found = ran(tmp_path / name, 1400, backend)
        arrived[name] = at(found, "arrive")
        assert not [e for e in found.events if e["kind"] in ("violation", "gridlock")]
    assert abs(arrived["both"]["down"] - arrived["alone"]["down"]) < 5.0
    assert at(found, "stop_left")["up"] - at(found, "stop_reached")["up"] == 400.0
    assert arrived["both"]["up"] > arrived["both"]["down"]


@pytest.mark.parametrize("backend", ["numeric", "sumo"])
def test_trains_that_would_stand_in_a_circle_are_let_in_one_after_another(tmp_path, backend):
    """Four trains nearly as long as the loop's tracks, two each way, all due at once round it."""
    ways = {
        "A": ("left up1 middle", 3000), "B": ("up1 middle", 1700), "C": ("-middle down1 -left", 3000), "D": ("down1 -left", 1700),
    }  # fmt: skip
    nets.single_track(tmp_path, "".join(nets.train(n, way, 0, departSpeed=0, departPos=x) for n, (way, x) in ways.items()))
    found = ran(tmp_path, 2400, backend, length=1500.0)
    assert set(at(found, "arrive")) == set(ways)
    assert max(at(found, "depart").values()) > 100.0  # not all at once
    assert not [e for e in found.events if e["kind"] in ("gridlock", "violation")] and found.ok
