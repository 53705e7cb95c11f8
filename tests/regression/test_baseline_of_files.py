"""The baseline of a SUMO configuration is the user's own simulation: its types, signals, rerouters and signs, to the second."""

from __future__ import annotations

from typing import Any

import nets
import pytest
import tomli_w
from beside import plain

from trainctl.errors import InputError
from trainctl.runner import run
from trainctl.runs.run import Run
from trainctl.scenario.build import open_scenario

RAIL = '<vType id="emu" vClass="rail" carFollowModel="Rail" trainType="RB425" length="80"/><vType id="car"/>'
STOP = '<stop lane="bc_0" endPos="1500" duration="60"/>'
CLOSED = '<rerouter id="r" edges="ab"><interval begin="0" end="9999"><closingReroute id="bc"/></interval></rerouter>'

#: Trains, additional files, options.
CASES: dict[str, tuple[str, str, str]] = {
    "alone": (nets.train("v", "ab bc cd", 7), "", ""),
    "stop": (nets.train("v", "ab bc cd", 0, STOP) + nets.train("w", "ab bc cd", 30), "", ""),
    "waypoint": (nets.train("v", "ab bc cd", 0, '<stop lane="bc_0" endPos="1500" speed="5"/>'), "", ""),
    "parking": (nets.train("v", "ab bc cd", 0, STOP.replace("/>", ' parking="true"/>')) + nets.train("w", "ab bc cd", 30), "", ""),
    "arrivalPos": (nets.train("v", "ab bc cd", 0, arrivalPos=500), "", ""),
    "departSpeed": (nets.train("v", "ab bc cd", 0, departSpeed=0), "", ""),
    "default departSpeed": ('<vehicle id="v" type="emu" depart="0"><route edges="ab bc"/></vehicle>', "",
                            '<default.departspeed value="3"/>'),
    "speed sign": (nets.train("v", "ab bc cd", 0),
                   '<variableSpeedSign id="s" lanes="bc_0"><step time="0" speed="8"/></variableSpeedSign>', ""),
    "closed edge": (nets.train("v", "ab bc cd", 0), CLOSED, ""),
    "flow": (nets.flow("f", "ab bc cd", 4, 90), "", ""),
    "scale": (nets.flow("f", "ab bc cd", 2, 200), "", '<scale value="2"/>'),
    "begin": (nets.train("v", "ab bc cd", 120), "", '<begin value="100"/>'),
    "repeat": ('<route id="r" edges="ab bc cd da" repeat="1"/><vehicle id="v" type="emu" depart="0" route="r"/>', "", ""),
}  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    """A ring with a bypass of its second side."""
    nodes = {"a": (0, 0), "b": (3000, 0), "c": (3000, 3000), "d": (0, 3000), "e": (5000, 1500)}
    sides = {f"{x}{y}": (x, y) for x, y in ("ab", "bc", "cd", "da", "be", "ec")}
    nets.net(tmp_path, nodes, sides)
    return tmp_path


def baseline(folder, body: str, more: str, options: str, end: int = 9000, **controller: Any) -> Run:
    nets.traffic(folder, body, RAIL, end=end)
    (folder / "s.add.xml").write_text(f"<additional>{more}</additional>")
    cfg = folder / "a.sumocfg"
    text = cfg.read_text()
    if "<begin" in options:
        text = text.replace('<begin value="0"/>', options)
    else:
        text = text.replace("<configuration>", f"<configuration>{options}")
    cfg.write_text(text.replace("</input>", '<additional-files value="s.add.xml"/></input>'))
    tables = nets.scenario("robust_constrained", 1500) | {"controller": {"law": "sumo"} | controller}
    (folder / "s.toml").write_text(tomli_w.dumps(tables))
    return run(open_scenario(str(folder / "s.toml")), folder / "out")


@pytest.mark.parametrize("case", CASES)
def test_every_train_arrives_when_it_does_in_plain_sumo(folder, case):
    body, more, options = CASES[case]
    found = baseline(folder, body, more, options)
    since = 100.0 if case == "begin" else 0.0
    ours = {e["train"]: e["time_s"] + since for e in found.events if e["kind"] == "arrive"}
    theirs = {row["id"]: float(row["arrival"]) for row in plain(folder, "tripinfo")}
    assert ours.keys() == theirs.keys() and ours
    assert all(ours[name] == pytest.approx(theirs[name], abs=1.0) for name in ours)
    stops = [e for e in found.events if e["kind"] == "stop_left"]
    assert len(stops) == len([row for row in plain(folder, "stop") if row.get("state") != "waypoint"])
    assert not [e for e in found.events if e["kind"] == "violation" and e["bound"] == "gap_m"]
    assert [e["what"] for e in found.events if e["kind"] == "not_followed"] == [
        "options time-to-teleport and collision.action: trains are never teleported, none is removed that collides"
    ]
    theirs = {(row["id"], float(row["started"]), float(row["ended"])) for row in plain(folder, "stop")}
    table = found.stops
    made = {(str(r.train), r.arrival_s + since, r.departure_s + since) for r in table.itertuples()}
    assert len(made) == len(theirs)
    if case != "waypoint":  # SUMO tells when the train was at its slowest there
        for (name, *ours), (other, *times) in zip(sorted(made), sorted(theirs), strict=True):
            assert name == other and ours == pytest.approx(times, abs=1.0)


def test_a_number_of_trains_is_spread_until_the_end_of_the_configuration(folder):
    body = '<flow id="f" type="emu" begin="0" number="3"><route edges="ab bc"/></flow>'
    found = baseline(folder, body, "", "", end=900)
    ours = [e["time_s"] for e in found.events if e["kind"] == "depart"]
    assert ours == [float(row["depart"]) for row in plain(folder, "tripinfo")] == [0.0, 300.0, 600.0]


def test_what_moving_block_changes_is_named(folder):
    found = baseline(folder, *CASES["flow"], block="moving")
    assert "option railsignal-moving-block: controller.block = moving instead" in [
        e["what"] for e in found.events if e["kind"] == "not_followed"
    ]
    theirs = {row["id"]: float(row["arrival"]) for row in plain(folder, "tripinfo", "--railsignal-moving-block")}
    assert {e["train"]: e["time_s"] for e in found.events if e["kind"] == "arrive"} == pytest.approx(theirs, abs=1.0)


def test_trains_that_sumo_draws_otherwise_are_told(folder):
    flow = '<flow id="f" type="emu" begin="0" end="900" probability="0.02"><route edges="ab bc"/></flow>'
    found = baseline(folder, flow, "", '<seed value="1"/>', block="moving")
    theirs = {row["id"] for row in plain(folder, "tripinfo", "--railsignal-moving-block")}
    ours = {e["train"] for e in found.events if e["kind"] == "depart"}
    told = [e["message"] for e in found.events if e["kind"] == "sumo_warning" and "not recorded" in e["message"]]
    assert ours < theirs and len(told) == 1 and told[0].startswith(f"{len(theirs - ours)} trains ")
    notes = [e["what"] for e in found.events if e["kind"] == "not_followed"]
    assert "flows f: SUMO draws the departures itself, so these trains have no planned time" in notes


def test_the_types_are_those_of_the_files(folder):
    with pytest.raises(InputError, match=r"controller.train_type: the vTypes of network.sumocfg say so"):
        baseline(folder, *CASES["alone"], train_type="ICE1")
