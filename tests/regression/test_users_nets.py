"""Configurations as users have them, of nets of three kinds: only the commands are typed, and plain SUMO runs the same files beside.

A tram line on streets with cars and traffic lights; a station with a branch of single track in a net of an old version, which pairs
the directions of a track by their shapes; and a mountain railway out of an extract of OpenStreetMap, with a loop and a terminal.
"""

from __future__ import annotations

import json
import re
import subprocess
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any

import nets
import pytest
from beside import plain

from sumo_net import Rails
from sumo_net.build import program
from trainctl.runs.run import Run
from trainctl.runs.sumo_logs import elements


def configured(folder: Path, routes: str, more: str, end: int) -> None:
    """Write the configuration of ``a.net.xml``."""
    (folder / "a.rou.xml").write_text(f"<routes>{routes}</routes>")
    (folder / "a.add.xml").write_text(f"<additional>{more}</additional>")
    (folder / "a.sumocfg").write_text(
        '<configuration><input><net-file value="a.net.xml"/><route-files value="a.rou.xml"/><additional-files value="a.add.xml"/>'
        f'</input><time><end value="{end}"/></time></configuration>'
    )


def ran(folder: Path, typed: Any, *options: str, code: int = 0) -> Run:
    """What a user gets who types the commands: a new scenario, its check, its run."""
    sumocfg, scenario = folder / "a.sumocfg", folder / "a.toml"
    if not scenario.exists():
        assert typed("new", "scenario", sumocfg, "--out", scenario) == (0, [])
    assert typed("check", scenario, *options)[0] == 0
    out = folder / f"out{len(list(folder.glob('out*')))}"
    said = typed("run", scenario, "--out", out, *options)
    assert said[0] == code, said
    return Run(out)


def at(found: Run, kind: str) -> dict[str, float]:
    return {e["train"]: e["time_s"] for e in found.events if e["kind"] == kind}


def beside(folder: Path, found: Run, trains: set[str], driven: bool = True) -> dict[str, float]:
    """Assert that all trains arrive, after the stops that they make in plain SUMO; by how much each is later there [s].

    What SUMO's own trains, that nobody has ``driven``, put into their motion is not ours to bound.
    """
    theirs = {row["id"]: float(row["arrival"]) for row in plain(folder, "tripinfo") if row["id"] in trains}
    halts = Counter((row["id"], row["lane"]) for row in plain(folder, "stop") if row["id"] in trains)
    log = [dict(at) for _, at in elements(found.folder / "sumo" / "tripinfo.xml", "tripinfos", {"tripinfo"})]
    here = at(found, "arrive")
    assert here.keys() == theirs.keys() == trains == {row["id"] for row in log} & trains
    assert len(log) == len(trains) or not driven
    made = Counter(str(e["train"]) for e in found.events if e["kind"] == "stop_reached")
    assert made == Counter(train for train, _ in halts.elements())
    assert "<collision " not in (found.folder / "sumo" / "collisions.xml").read_text()
    assert not [e for e in found.events if e["kind"] in ("gridlock", "red_passed") or (e["kind"] == "violation" and driven)]
    return {train: here[train] - theirs[train] for train in trains}


def told(found: Run) -> list[str]:
    return [str(e["what"]) for e in found.events if e["kind"] == "not_followed"]


# Trams on streets


def town(folder: Path) -> None:
    """A street of four blocks with tracks in its inner lanes, a turning loop at either end, lights, cars and bicycles."""
    nodes = {"w": (0, 0), "1": (400, 0), "2": (800, 0), "3": (1200, 0), "e": (1600, 0), "n1": (400, 300), "s2": (800, -300),
             "n3": (1200, 300), "wl": (-120, 60), "wr": (-120, -60), "el": (1720, 60), "er": (1720, -60)}  # fmt: skip
    kinds = {"1": "traffic_light", "2": "priority", "3": "traffic_light"}
    lanes = '<lane index="0" allow="passenger bicycle"/><lane index="1" allow="tram passenger"/>'
    rows = []
    for a, b in pairwise("w123e"):
        rows += [f'<edge id="{x}{y}" from="{x}" to="{y}" numLanes="2" speed="13.89">{lanes}</edge>' for x, y in ((a, b), (b, a))]
    for a, b in (("1", "n1"), ("2", "s2"), ("3", "n3")):
        rows += [f'<edge id="{x}{y}" from="{x}" to="{y}" numLanes="1" speed="8.3"/>' for x, y in ((a, b), (b, a))]
    for loop in (("w", "wl", "wr", "w"), ("e", "er", "el", "e")):
        rows += [f'<edge id="{a}{b}" from="{a}" to="{b}" numLanes="1" speed="5" allow="tram"/>' for a, b in pairwise(loop)]
    folder.mkdir(exist_ok=True)
    (folder / "a.nod.xml").write_text(
        "<nodes>"
        + "".join(f'<node id="{n}" x="{x}" y="{y}" type="{kinds.get(n, "priority")}"/>' for n, (x, y) in nodes.items())
        + "</nodes>"
    )
    (folder / "a.edg.xml").write_text(f"<edges>{''.join(rows)}</edges>")
    nets.convert(folder)
    east, west = "w1 12 23 3e eer erel ele", "e3 32 21 1w wwl wlwr wrw"
    there = " ".join(f'<stop busStop="{p}" duration="20"/>' for p in ("market", "hospital"))
    back = '<stop busStop="loop" duration="30"/><stop busStop="hall" duration="20"/>'
    places = {"market": "12", "hospital": "3e", "loop": "erel", "hall": "32"}
    configured(
        folder,
        '<vType id="tram" vClass="tram" length="30" maxSpeed="15" accel="1" decel="1.2" sigma="0"/><vType id="car"/>'
        f'<route id="round" edges="{east} {west} w1">{there}{back}</route>'
        '<flow id="line1" type="tram" begin="0" number="4" period="150" route="round" departSpeed="0"/>'
        '<flow id="cars" type="car" begin="0" end="300" period="20"><route edges="n11 12 2s2"/></flow>',
        "".join(
            f'<busStop id="{p}" name="{p.title()}" lane="{e}_{1 if len(e) == 2 else 0}" startPos="20" endPos="60"/>'
            for p, e in places.items()
        ),
        2000,
    )


def test_trams_on_the_streets_of_a_town(tmp_path, typed):
    """They keep to the lanes with tracks, turn in loops and stop by name; cars and lights are named and left out."""
    town(tmp_path)
    found = ran(tmp_path, typed)
    trams = {f"line1.{k}" for k in range(4)}
    beside(tmp_path, found, trams)
    calls = [e["stop"] for e in found.events if e["kind"] == "stop_reached" and e["train"] == "line1.0"]
    assert calls == ["Market", "Hospital", "Loop", "Hall"]
    notes = told(found)
    for said in (
        "1 vehicles, trips and flows left out: not rail",
        "net: 2 x traffic lights: not",
    ):
        assert [line for line in notes if said in line], (said, notes)
    lanes = {
        at["id"]: {at["departLane"], at["arrivalLane"]}
        for _, at in elements(found.folder / "sumo" / "tripinfo.xml", "tripinfos", {"tripinfo"})
    }
    assert all(one == {"w1_1"} for one in lanes.values()), lanes
    own = ran(tmp_path, typed, "--set", "controller.law=sumo")  # the user's own simulation, cars and all
    late = beside(tmp_path, own, trams, False)
    assert max(map(abs, late.values())) <= 1.0, late


# A station in a net of an old version


def junction_station(folder: Path) -> None:
    """Double track through a station of three platform tracks, from which a branch of single track leaves to a terminal.

    Signals stand at both throats. The net is of version 0.27, without a word of which edges are one track.
    """
    nodes = {"A": (0, 0), "a": (0, -8), "x": (4000, 0), "y": (4600, 0), "Z": (9000, 0), "z": (9000, -8), "T": (8000, 1500),
             "t": (5200, 200)}  # fmt: skip
    edges: dict[str, Any] = {"in_w": ("A", "x"), "out_w": ("x", "a"), "out_e": ("y", "Z"), "in_e": ("z", "y")}
    for k, side in ((1, 8), (2, 0), (3, -8)):
        shape = [(4000, 0), (4060, side), (4540, side), (4600, 0)]
        for name, ends, points in ((f"gl{k}", ("x", "y"), shape), (f"-gl{k}", ("y", "x"), shape[::-1])):
            said = {"shape": " ".join(f"{u},{v}" for u, v in points), "spreadType": "center", "speed": 22}
            edges[name] = (*ends, said)
    edges |= nets.both_ways("branch", "y", "t", speed=22) | nets.both_ways("valley", "t", "T", speed=22)
    nets.net(folder, nodes, edges, nets.TERMINALS, signals="xyt")
    net = folder / "a.net.xml"
    text = re.sub(r'<net version="[^"]*"', '<net version="0.27"', net.read_text())
    text, paired = re.subn(' bidi="[^"]*"', "", text)
    assert paired >= 10
    net.write_text(text)

    def calls(*places: tuple[str, int]) -> str:
        return "".join(f'<stop trainStop="{p}" duration="{t}"/>' for p, t in places)

    types = (
        '<vType id="RE" vClass="rail" carFollowModel="Rail" trainType="REDosto7" maxSpeed="44" speedDev="0"/>'
        '<vType id="RB" vClass="rail" carFollowModel="Rail" trainType="RB628" maxSpeed="33" speedDev="0"/>'
    )
    body = (
        nets.train("RE1", "in_w gl1 out_e", 0, calls(("Gleis 1", 60)), type="RE", departSpeed="20")
        + nets.train("RB7", "in_w gl3 branch valley -valley -branch -gl3 out_w", 150, calls(("Gleis 3", 30), ("Talheim", 60), ("Gleis 3b", 30)), type="RB", departSpeed="20")
        + nets.train("RE2", "in_e -gl2 out_w", 170, calls(("Gleis 2", 60)), type="RE", departSpeed="20")
        + nets.train("RE3", "in_w gl1 out_e", 420, calls(("Gleis 1", 60)), type="RE", departSpeed="20")
    )  # fmt: skip
    places = {"Gleis 1": "gl1", "Gleis 2": "-gl2", "Gleis 3": "gl3", "Gleis 3b": "-gl3", "Talheim": "valley"}
    more = "".join(f'<trainStop id="{p}" lane="{e}_0" startPos="100" endPos="-30"/>' for p, e in places.items())
    configured(folder, types + body, more, 2400)


@pytest.mark.parametrize("signals", ["ignore", "obey"])
def test_a_station_and_its_branch_in_an_old_net(tmp_path, typed, signals):
    """The two edges of a track are one: nobody meets another on it, and the local train turns where its route does."""
    junction_station(tmp_path)
    rails = Rails.read(tmp_path / "a.net.xml")
    assert rails.twin[rails.index["valley"]] == rails.index["-valley"] and rails.twin[rails.index["in_w"]] == -1
    trains = {"RE1", "RE2", "RE3", "RB7"}
    found = ran(tmp_path, typed, "--set", f"traffic.signals={signals}")
    late = beside(tmp_path, found, trains)
    # The driver starts and brakes with half of what SUMO's does; first come, first served holds an express for the local train.
    assert max(late.values()) < (300.0 if signals == "ignore" else 240.0), late
    assert [(e["train"], e["from_edge"]) for e in found.events if e["kind"] == "turn"] == [("RB7", "valley")]
    if signals == "obey":
        own = ran(tmp_path, typed, "--set", "controller.law=sumo")
        assert max(map(abs, beside(tmp_path, own, trains, False).values())) <= 1.0


# OpenStreetMap

STOP = '<tag k="railway" v="stop"/><tag k="public_transport" v="stop_position"/><tag k="train" v="yes"/><tag k="name" v="{}"/>'


def mountain(folder: Path) -> None:
    """Single track of a narrow valley up to a terminal, with a loop half-way, as OpenStreetMap has it; heights are in it, too."""
    place = {
        1: (47.000, 9.000, ""), 2: (47.000, 9.004, STOP.format("Tal")), 3: (47.004, 9.040, '<tag k="railway" v="switch"/>'),
        4: (47.0043, 9.0440, STOP.format("Mitte A")), 5: (47.004, 9.048, '<tag k="railway" v="switch"/>'),
        6: (47.0037, 9.0440, STOP.format("Mitte B")), 7: (47.012, 9.070, ""), 8: (47.018, 9.085, STOP.format("Berg")),
        9: (47.0185, 9.0862, '<tag k="railway" v="buffer_stop"/>'),
    }  # fmt: skip
    ways = {10: (1, 2, 3), 11: (3, 4, 5), 12: (3, 6, 5), 13: (5, 7, 8, 9)}
    rows = [f'<node id="{n}" lat="{lat}" lon="{lon}">{tags}</node>' for n, (lat, lon, tags) in place.items()]
    for name, refs in ways.items():
        inside = "".join(f'<nd ref="{n}"/>' for n in refs)
        speed = 60 if name in (10, 13) else 40
        rows.append(
            f'<way id="{name}">{inside}<tag k="railway" v="rail"/><tag k="maxspeed" v="{speed}"/><tag k="gauge" v="1000"/></way>'
        )
    road = '<way id="90"><nd ref="1"/><nd ref="9"/><tag k="highway" v="residential"/></way>'
    folder.mkdir(exist_ok=True)
    (folder / "a.osm.xml").write_text(f'<osm version="0.6">{"".join(rows)}{road}</osm>')
    netconvert, environment = program("netconvert")
    options = ["--osm-files", "a.osm.xml", "--keep-edges.by-vclass", "rail", "--railway.topology.all-bidi", "--railway.signal.guess.by-stops",
               "--geometry.remove", "-o", "a.net.xml"]  # fmt: skip
    subprocess.run([netconvert, *options], cwd=folder, env=environment, check=True, capture_output=True)
    names = set(re.findall(r'<edge id="([^:"][^"]*)"', (folder / "a.net.xml").read_text()))
    assert {"10", "-10", "11", "-11", "12", "-12", "13", "-13"} <= names, names

    def halts(*edges: str) -> str:
        return "".join(f'<stop lane="{e}_0" duration="40"/>' for e in edges)

    up, down = "10 11 13", "-13 -12 -10"
    body = (
        nets.train("up1", f"{up} {down}", 0, halts("11", "13", "-12"), type="rack")
        + nets.train("down1", "-13 -12 -10", 30, halts("-12"), type="rack")
        + nets.train("up2", up, 500, halts("11"), type="rack")
    )
    types = '<vType id="rack" vClass="rail" length="60" maxSpeed="16" accel="0.5" decel="0.6" sigma="0" speedDev="0"/>'
    configured(folder, types + body, "", 3000)


def test_a_mountain_railway_of_openstreetmap(tmp_path, typed):
    """Trains meet in the loop and turn at the top; none waits for another for ever."""
    mountain(tmp_path)
    found = ran(tmp_path, typed)
    beside(tmp_path, found, {"up1", "up2", "down1"})
    rows = found.trains.astype({"train": str, "edge": str})
    meets = {edge: set(rows[rows.edge == edge].train) for edge in ("11", "-12")}
    assert meets["11"] >= {"up1", "up2"} and meets["-12"] >= {"down1", "up1"}
    [turned] = [e for e in found.events if e["kind"] == "turn"]
    assert (turned["train"], turned["from_edge"], turned["to_edge"]) == ("up1", "13", "-13")
    assert json.loads((found.folder / "run.json").read_text())["status"] == "complete"
    own = ran(tmp_path, typed, "--set", "controller.law=sumo")
    assert max(map(abs, beside(tmp_path, own, {"up1", "up2", "down1"}, False).values())) <= 1.0
