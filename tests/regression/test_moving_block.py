"""A line with moving block that another simulator's tests state: trains of unlike rates behind each other, and two that meet.

railsim, the railway module of MATSim, has a single track of seven nodes on which a regional train, a freight train and a fast one run,
each with an acceleration and a braking of its own, and states when they arrive. Those are closed sums of ways and rates, but for who
waits. Ours keep a margin between trains that railsim does not: 10 m before what a train must not reach, and the station in the middle
is longer by as much as a train needs to stand clear there; the track before it is shorter by the same.
"""

from __future__ import annotations

import math
from pathlib import Path

import nets
import pytest
import tomli_w

from trainctl.runner import run
from trainctl.runs.run import Run
from trainctl.scenario.build import open_scenario

#: Links of the line: length [m], speed [m/s]. The station between n3 and n4 has a track for each direction, the rest is single track.
LINKS = {"12": (200, 100), "23": (50_000, 100), "34": (200, 100), "45": (25_000, 100), "56": (25_000, 60), "67": (200, 30)}

#: Trains: length [m], speed [m/s], acceleration and braking [m/s2].
TRAINS = {"regio": (500, 44, 0.5), "cargo": (1000, 33, 0.2), "sprinter": (200, 90, 0.7)}

#: By so much the station is longer [m].
MARGIN_M = 20.0

#: So far before the end of the line trains stop, so that they leave it after that [m].
SHORT_M = 0.2

#: Track behind the first node, on which the longest train stands before it starts [m].
BEFORE_M = 1000.0


def line(folder: Path, trains: list[tuple[str, str, float, bool]]) -> None:
    """The line, and trains: id, type, departure [s], whether they run from n2 to n7; else from n5 to n1."""
    length = {name: float(metres) for name, (metres, _) in LINKS.items()}
    length["12"] += BEFORE_M
    length["23"] -= MARGIN_M
    length["34"] += MARGIN_M
    nodes, edges, x = {"n1": (0.0, 0.0)}, {}, 0.0
    for name, metres in length.items():
        x += metres
        nodes[f"n{name[1]}"] = (x, 0.0)
        said = {"speed": LINKS[name][1], "length": metres}
        if name == "34":
            for edge, ends, side in (("34", ("n3", "n4"), -20.0), ("43", ("n4", "n3"), 20.0)):
                shape = [(x - metres, 0.0), (x - metres / 2, side), (x, 0.0)]
                text = " ".join(f"{u},{v}" for u, v in (shape if edge == "34" else shape[::-1]))
                edges[edge] = (*ends, said | {"shape": text})
        else:
            edges |= {name: (f"n{name[0]}", f"n{name[1]}", said | {"spreadType": "center"})}
            edges |= {name[::-1]: (f"n{name[1]}", f"n{name[0]}", said | {"spreadType": "center"})}
    nets.net(folder, nodes, edges, "--no-internal-links")
    ways = {True: list(length), False: [name[::-1] for name in reversed(length) if name != "67"]}
    body = ""
    for name, kind, due, up in trains:
        halt = f'<stop lane="{ways[up][-1]}_0" startPos="0" endPos="{200.0 - SHORT_M}" duration="0"/>'
        place = length[ways[up][0] if up else ways[up][0][::-1]]
        body += nets.train(name, " ".join(ways[up]), due, halt, type=kind, departSpeed=0, departPos=place)
    kinds = "".join(f'<vType id="{k}" vClass="rail" length="{x}" maxSpeed="{v}"/>' for k, (x, v, _) in TRAINS.items())
    nets.traffic(folder, body, kinds)


def came(folder: Path, trains: list[tuple[str, str, float, bool]], duration: float) -> tuple[dict[str, float], Run]:
    """When each train stood at its last stop [s], and the run."""
    line(folder, trains)
    made = nets.scenario(
        "robust_constrained", duration, tuple(TRAINS), reference={"speed_mps": 90.0},
        supervisor={"margin_m": 0.0},
        traffic={"cooperate": [], "below_limit_mps": 0.0},
    )  # fmt: skip
    made["plant"] = {"kind": "point"}
    made["bounds"] = {"speed_lower_mps": 0.0, "speed_upper_mps": 100.0, "input_lower_mps2": -1.0, "input_upper_mps2": 1.0}
    made["run"] |= {"step_s": 0.5}
    for name, (metres, _, rate) in TRAINS.items():
        own = {"unit_length_m": float(metres), "driven_acceleration_mps2": rate, "driven_deceleration_mps2": rate}
        made["train_type"][name] = nets.TYPE | own
    (folder / "s.toml").write_text(tomli_w.dumps(made))
    found = run(open_scenario(str(folder / "s.toml")), folder / "out", "numeric")
    return {e["train"]: e["time_s"] for e in found.events if e["kind"] == "stop_reached"}, found


def test_unlike_trains_behind_each_other(tmp_path):
    """Nobody holds up the first two, whose times are sums; the last one stands behind the second until that has arrived."""
    trains = [("regio", "regio", 0.0, True), ("cargo", "cargo", 60.0, True), ("sprinter", "sprinter", 120.0, True)]
    at, found = came(tmp_path, trains, 3400)
    whole = sum(metres for name, (metres, _) in LINKS.items() if name != "12")
    for name, due in (("regio", 0.0), ("cargo", 60.0)):
        _, speed, rate = TRAINS[name]
        assert at[name] == pytest.approx(due + whole / speed + speed / rate, abs=1.0)
    assert at["regio"] == pytest.approx(2370.0, abs=1.0) and at["cargo"] == pytest.approx(3268.0, abs=1.0)
    assert at["sprinter"] == pytest.approx(3345.0, abs=3.0)
    length, _, rate = TRAINS["cargo"][0], *TRAINS["sprinter"][1:]
    assert at["sprinter"] == pytest.approx(at["cargo"] + 2.0 * math.sqrt(length / rate), abs=3.0)
    assert not [e for e in found.events if e["kind"] in ("violation", "gridlock", "emergency_braking")] and found.ok


def test_two_fast_trains_meet_in_the_station(tmp_path):
    at, found = came(tmp_path, [("up", "sprinter", 0.0, True), ("down", "sprinter", 400.0, False)], 1700)
    assert at["down"] == pytest.approx(1368.0, abs=3.0)
    assert at["up"] == pytest.approx(1559.0, abs=3.0)
    assert not [e for e in found.events if e["kind"] in ("violation", "gridlock", "emergency_braking")] and found.ok
