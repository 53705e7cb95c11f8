"""Reading a SUMO configuration: what duarouter makes of it, against what SUMO itself does with the same files."""

from __future__ import annotations

import gzip
import json
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import nets
import numpy as np
import pytest

from sumo_net.build import program
from trainctl.errors import InputError
from trainctl.scenario.tables import TrainType
from trainctl.scenario.train_types import fitted, train_type
from trainctl.traffic.kinds import RAIL_MODEL, Kind
from trainctl.traffic.read import Configuration, read_traffic

NODES = """<nodes><node id="a" x="0" y="0"/><node id="b" x="2000" y="0"/><node id="c" x="4000" y="0"/><node id="d" x="7000" y="0"/>
<node id="x" x="500" y="600"/><node id="z" x="500" y="900"/></nodes>"""
EDGES = """<edges><edge id="ab" from="a" to="b" speed="40" allow="rail rail_fast"/><edge id="bc" from="b" to="c" speed="40"
allow="rail rail_fast"/><edge id="cd" from="c" to="d" speed="40" allow="rail rail_fast"/><edge id="xb" from="x" to="b" speed="30"
allow="rail rail_fast"/><edge id="zx" from="z" to="x" speed="30" allow="passenger"/></edges>"""
STOPS = """<additional><trainStop id="west" lane="ab_0" startPos="100" endPos="300"/><trainStop id="mid" lane="bc_0" startPos="400"
endPos="-100"/><busStop id="east" lane="cd_0" startPos="10" endPos="900.5"/></additional>"""
CUSTOM = """<vType id="t" vClass="rail" length="100" speedFactor="0.9" sigma="0" maxSpeed="60" carFollowModel="Rail" trainType="custom"
maxPower="2350" maxTraction="150" resCoef_quadratic="0.01" resCoef_linear="0.02" resCoef_constant="1.67" mass="90000" massFactor="1.08"
decel="0.8"><param key="who" value="me"/></vType>"""
V = '<vehicle id="v" type="t" depart="0"'
ROUTE = '<route id="main" edges="ab bc cd"/>'
SUMOCFG = """<configuration><input><net-file value="n.net.xml"/><route-files value="{routes}"/><additional-files value="{more}"/></input>
<time><begin value="{begin}"/>{end}<step-length value="0.5"/></time></configuration>"""


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("net")
    (folder / "n.nod.xml").write_text(NODES)
    (folder / "n.edg.xml").write_text(EDGES)
    netconvert, environment = program("netconvert")
    subprocess.run([netconvert, "-n", "n.nod.xml", "-e", "n.edg.xml", "-o", "n.net.xml"], cwd=folder, env=environment, check=True,
                   capture_output=True)  # fmt: skip
    return folder / "n.net.xml"


class Files:
    """A configuration in a folder of its own."""

    def __init__(self, folder: Path, net: Path) -> None:
        self.folder = folder
        self.sumocfg = folder / "run.sumocfg"
        (folder / "n.net.xml").write_bytes(net.read_bytes())

    def write(self, demand: str, begin: float = 0, end: str = "", stops: str = STOPS) -> Files:
        (self.folder / "r.rou.xml").write_text(f"<routes>{CUSTOM}{ROUTE}{demand}</routes>")
        (self.folder / "s.add.xml").write_text(stops)
        self.sumocfg.write_text(SUMOCFG.format(routes="r.rou.xml", more="s.add.xml", begin=begin, end=end))
        return self

    def read(self, demand: str, **options: Any) -> Configuration:
        return read_traffic(self.write(demand, **options).sumocfg, self.folder / "work")

    def mistakes(self, demand: str, **options: Any) -> list[str]:
        with pytest.raises(InputError) as caught:
            self.read(demand, **options)
        return caught.value.mistakes


@pytest.fixture
def files(tmp_path: Path, net: Path) -> Files:
    return Files(tmp_path, net)


def in_sumo(folder: Path, script: str) -> Any:
    """What a script with libsumo prints as JSON, in a process of its own."""
    code = f"import json, libsumo\nout = []\n{script}\nprint('>' + json.dumps(out))"
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.rpartition(">")[2])


def test_flows_become_trains(files: Files) -> None:
    traffic = files.read(
        '<flow id="p" type="t" begin="0" period="30" end="100" route="main"/>'
        '<flow id="q" type="t" begin="0" number="2" period="7.25" route="main"/>'
        '<flow id="h" type="t" begin="5" vehsPerHour="120" end="100" from="ab" to="cd"/>'
        '<flow id="n" type="t" begin="20" number="3" end="50" route="main"/>'
    )
    times = {name: [d.depart_s for d in traffic.departures if d.id.startswith(f"{name}.")] for name in "nphq"}
    assert times == {"n": [20, 30, 40], "p": [0, 30, 60, 90], "h": [5, 35, 65, 95], "q": [0, 7.25]}
    assert all(d.edges == ("ab", "bc", "cd") and d.kind == "t" for d in traffic.departures)
    assert [d.id for d in traffic.departures[:2]] == ["p.0", "q.0"]  # by time, then as in the file


def test_the_same_seed_draws_the_same(files: Files) -> None:
    demand = (
        '<vTypeDistribution id="mix"><vType id="m1" vClass="rail" length="50" probability="0.5"/>'
        '<vType id="m2" vClass="rail" length="60" probability="0.5"/></vTypeDistribution>'
        '<vTypeDistribution id="mix2" vTypes="t m1" probabilities="0.5 0.5"/>'
        '<routeDistribution id="rd"><route id="r1" edges="ab bc cd" probability="0.5"/><route id="r2" edges="xb bc"/></routeDistribution>'
        '<flow id="f" type="mix" begin="0" end="600" probability="0.2" route="rd"/>'
        '<flow id="g" type="mix2" begin="0" end="600" period="exp(0.1)" route="main"/>'
    )
    one, same = files.read(demand), files.read(demand)
    other = read_traffic(files.sumocfg, files.folder / "work", seed=7)
    assert one._replace(source=same.source) == same
    assert one.departures != other.departures
    assert {d.kind for d in one.departures} == {"m1", "m2", "t"} == set(one.kinds)
    assert {d.edges for d in one.departures} == {("ab", "bc", "cd"), ("xb", "bc")}
    assert 80 < sum(d.id.startswith("f.") for d in one.departures) < 160  # 120 expected


def test_what_is_random_of_a_train_is_drawn_for_each_by_its_name(files: Files) -> None:
    said = 'departPos="random" departSpeed="random" arrivalPos="random" departEdge="random" arrivalEdge="random"'
    vehicles = [f'<vehicle id="v{k}" type="t" depart="{k}" route="main" {said}/>' for k in range(60)]
    one = {d.id: d for d in files.read("".join(vehicles)).departures}
    few = files.read("".join(vehicles[7:9])).departures
    assert [one[d.id] for d in few] == list(few)  # whoever else there is
    length = {"ab": 2000.0, "bc": 2000.0, "cd": 3000.0}
    assert all(0.0 <= d.position_m <= length[d.edges[0]] and 0.0 <= d.arrival_m <= length[d.edges[-1]] for d in one.values())
    depth = sorted(d.position_m / length[d.edges[0]] for d in one.values())
    speeds = sorted(d.speed_mps for d in one.values())
    assert depth[15] < 0.4 and depth[45] > 0.6 and speeds[0] < 7.0 and 29.0 < speeds[-1] < 36.0  # 0.9 x 40 m/s
    assert {d.edges for d in one.values()} == {("ab", "bc", "cd"), ("ab", "bc"), ("ab",), ("bc", "cd"), ("bc",), ("cd",)}
    assert read_traffic(files.sumocfg, files.folder / "work", seed=7).departures != few


@pytest.mark.parametrize("scale", [0.3, 0.75, 1.5, 2.25])
def test_a_fraction_of_the_trains_comes_that_comes_in_sumo(files: Files, scale: float) -> None:
    files.write("".join(f'<vehicle id="v{k}" type="t" depart="{10 * k}" route="main"/>' for k in range(12)))
    files.sumocfg.write_text(files.sumocfg.read_text().replace("<time>", f'<scale value="{scale}"/><time>'))
    sumo, environment = program("sumo")
    options = ["--no-step-log", "--insertion-checks", "none", "--tripinfo-output", "t.xml"]
    subprocess.run([sumo, "-c", "run.sumocfg", *options], cwd=files.folder, env=environment, check=True, capture_output=True)
    theirs = set(re.findall(r'tripinfo id="([^"]*)"', (files.folder / "t.xml").read_text()))
    assert {d.id for d in read_traffic(files.sumocfg, files.folder / "work").departures} == theirs


def test_trains_out_of_order_in_a_route_file_do_not_come_as_in_sumo(files: Files) -> None:
    def v(name: str, depart: float, kind: str = 'type="t"') -> str:
        return f'<vehicle id="{name}" {kind} depart="{depart}"><route edges="ab bc cd"/></vehicle>'

    flow = '<flow id="f" type="t" begin="90" period="60" number="2" route="main"/>'
    body = v("a", 40) + v("b", 0) + v("c", 60) + f'<trip id="d" type="t" depart="50" from="ab" to="cd"/>{v("e", 100)}{flow}'
    own, of = '<vType id="o" vClass="rail"/>', 'type="o"'
    traffic = files.read(body, stops=STOPS.replace("</additional>", f"{own}{v('g', 30, of)}{v('h', 20, of)}</additional>"))
    sumo, environment = program("sumo")
    options = ["--no-step-log", "--insertion-checks", "none", "--tripinfo-output", "t.xml"]
    subprocess.run([sumo, "-c", "run.sumocfg", *options], cwd=files.folder, env=environment, check=True, capture_output=True)
    theirs = set(re.findall(r'tripinfo id="([^"]*)"', (files.folder / "t.xml").read_text()))
    assert {d.id for d in traffic.departures} == theirs == set("aceg") | {"h"}
    told = "3 vehicles, trips and flows left out, as in SUMO: a route file goes by departure times: b, d, f"
    assert told in traffic.notes


def test_mistakes_in_signs_and_rerouters_are_told(files: Files) -> None:
    wrong = (
        '<variableSpeedSign id="s" lanes="nope_0"><step time="x" speed="y"/></variableSpeedSign><variableSpeedSign id="u"/>'
        '<rerouter id="r" edges="ab nope" probability="p"><interval begin="z"><closingReroute id="gone"/></interval></rerouter>'
    )
    told = files.mistakes(f'{V} route="main"/>', stops=STOPS.replace("</additional>", f"{wrong}</additional>"))
    assert told == [f"{files.sumocfg}: {line}" for line in (
        "variableSpeedSign s: lane nope_0: not in the net", "variableSpeedSign s: step time = x: must be a time",
        "variableSpeedSign s: step speed = y: must be a number", "variableSpeedSign u: no lanes",
        "rerouter r: edge nope: not in the net", "rerouter r: probability = p: must be a number, not negative",
        "rerouter r: interval z: must be a time", "rerouter r: closingReroute gone: not in the net",
    )]  # fmt: skip


def test_trips_become_the_routes_of_sumo(files: Files) -> None:
    traffic = files.read('<trip id="a" type="t" depart="0:01:01.5" from="ab" via="bc" to="cd"/>'
                         '<trip id="b" type="t" depart="70" from="xb" to="cd"><stop trainStop="mid" duration="60"/></trip>')  # fmt: skip
    a, b = traffic.departures
    assert (a.depart_s, a.edges) == (61.5, ("ab", "bc", "cd"))
    assert (b.depart_s, b.edges) == (70, ("xb", "bc", "cd"))


CASES = {
    "none": "", "base": 'departPos="base"', "stop": 'departPos="stop"', "end": 'departPos="-30"', "number": 'departPos="1234.5678901"',
    "zero": 'departPos="0" departSpeed="0"', "slow": 'departSpeed="12.3456789"', "max": 'departSpeed="max" departLane="best"',
    "line": 'line="S1" arrivalPos="-20" insertionChecks="none"',
}  # fmt: skip
HALTS = {"": "", "far": '<stop lane="ab_0" endPos="300" duration="10"/>', "near": '<stop trainStop="west" duration="5"/>',
         "short": '<stop lane="ab_0" endPos="60" duration="10" until="90"/><stop trainStop="mid" duration="10"/>'}  # fmt: skip


def test_departures_agree_with_sumo(files: Files) -> None:
    """Time, edges, position, speed and stops of every train as SUMO inserts it on an empty net."""
    cases = {f"{c}{h}": (a, s) for c, a in CASES.items() for h, s in HALTS.items() if not (h and c in ("end", "number", "slow"))}
    demand = "".join(
        f'<vehicle id="{name}" type="t" depart="{10 * k + 0.3}" {said}><route edges="ab bc cd"/>{stop}</vehicle>'
        for k, (name, (said, stop)) in enumerate(cases.items())
    )
    traffic = files.read(demand)
    script = """libsumo.start(["sumo", "-c", "run.sumocfg", "--no-step-log", "--no-warnings"])
for _ in range(900):
    libsumo.simulationStep()
    for v in libsumo.simulation.getDepartedIDList():
        V = libsumo.vehicle
        stops = [[s.lane, s.endPos, max(s.duration, 0), s.until] for s in V.getStops(v)]
        out.append([v, V.getDeparture(v), list(V.getRoute(v)), V.getRoadID(v), V.getLanePosition(v), V.getSpeed(v), stops])
        V.remove(v)
"""
    sumo = {row[0]: row[1:] for row in in_sumo(files.folder, script)}
    assert sumo.keys() == cases.keys() == {d.id for d in traffic.departures}
    for d in traffic.departures:
        at, route, edge, position, speed, stops = sumo[d.id]
        assert 0.0 <= at - d.depart_s < 0.5, d.id  # SUMO inserts at its next step
        assert (tuple(route), edge) == (d.edges, d.edges[0]), d.id
        assert position == pytest.approx(d.position_m, abs=1e-6), d.id
        if d.speed_mps is None:
            assert 0.0 < speed <= 36.0 + 1e-9, d.id  # speedFactor of the limit, less before a stop
        else:
            assert speed == pytest.approx(d.speed_mps, abs=1e-6), d.id
        ours = [[f"{s.edge}_0", s.position_m, s.duration_s, -1073741824.0 if s.until_s is None else s.until_s] for s in d.stops]
        assert ours == [[lane, pytest.approx(end), duration, until] for lane, end, duration, until in stops], d.id


def test_a_stop_is_called_by_the_name_of_its_place(files: Files) -> None:
    demand = '<vehicle id="v" type="t" depart="0" route="main"><stop trainStop="mid" duration="5"/><stop busStop="east"/></vehicle>'
    (train,) = files.read(demand, stops=STOPS.replace('id="mid"', 'id="mid" name="Midway"')).departures
    assert [stop.name for stop in train.stops] == ["Midway", "east"]


def test_a_train_with_a_line_is_not_lost(files: Files) -> None:
    (train,) = files.read('<vehicle id="v" type="t" depart="0" route="main" line="S1" arrivalPos="-20"><stop trainStop="mid" '
                          'duration="10" parking="true" tripId="z"/></vehicle>').departures  # fmt: skip
    assert (train.line, train.stops[0].name, train.stops[0].edge) == ("S1", "mid", "bc")
    length = files_length(files, "cd_0")
    assert train.arrival_m == pytest.approx(length - 20)
    assert train.stops[0].position_m == pytest.approx(files_length(files, "bc_0") - 100)


def files_length(files: Files, lane: str) -> float:
    text = (files.folder / "n.net.xml").read_text().partition(f'<lane id="{lane}"')[2]
    return float(text.partition('length="')[2].partition('"')[0])


def test_the_schedule_of_a_route_counts_from_the_departure_as_in_sumo(files: Files) -> None:
    traffic = files.read(
        '<route id="timed" edges="ab bc cd"><stop lane="bc_0" endPos="500" until="500"/></route>'
        '<vehicle id="v" type="t" depart="20" route="timed"><stop busStop="east" until="900"/></vehicle>'
        '<flow id="g" type="t" begin="40" number="2" period="10"><route edges="ab bc cd"><stop lane="bc_0" endPos="500" until="500"/>'
        '</route><stop busStop="east" until="900" duration="7"/></flow>'
    )
    script = """libsumo.start(["sumo", "-c", "run.sumocfg", "--no-step-log", "--no-warnings"])
for _ in range(120):
    libsumo.simulationStep()
    for v in libsumo.simulation.getDepartedIDList():
        out.append([v, [s.until for s in libsumo.vehicle.getStops(v)]])
        libsumo.vehicle.remove(v)
"""
    assert in_sumo(files.folder, script) == [[d.id, [s.until_s for s in d.stops]] for d in traffic.departures]
    assert [s.until_s for s in traffic.departures[0].stops] == [520, 900]


def test_several_files_compressed_and_included_from_another_folder(tmp_path: Path, net: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "n.net.xml").write_bytes(net.read_bytes())
    (tmp_path / "in" / "more.add.xml.gz").write_bytes(gzip.compress(STOPS.encode()))
    (tmp_path / "in" / "types.add.xml").write_text(f"<additional>{CUSTOM}</additional>")
    (tmp_path / "in" / "one.rou.xml").write_text('<routes><include href="deep/part.rou.xml"/></routes>')
    (tmp_path / "in" / "deep").mkdir()
    (tmp_path / "in" / "deep" / "part.rou.xml").write_text(
        f'<routes>{ROUTE}<vehicle id="one" type="t" depart="9" route="main"/></routes>'
    )
    (tmp_path / "in" / "two.rou.xml").write_text(
        '<routes><vehicle id="two" type="t" depart="4" route="main"><stop trainStop="mid" duration="3"/></vehicle></routes>'
    )
    sumocfg = tmp_path / "in" / "run.sumocfg"
    sumocfg.write_text(SUMOCFG.format(routes="one.rou.xml, two.rou.xml", more="more.add.xml.gz,types.add.xml", begin=2, end='<end value="0:10:00"/>'))  # fmt: skip
    traffic = read_traffic(sumocfg, tmp_path / "work")
    assert [d.id for d in traffic.departures] == ["two", "one"]
    assert (traffic.begin_s, traffic.end_s, traffic.step_s) == (2, 600, 0.5)
    assert traffic.net == tmp_path / "in" / "n.net.xml"


def test_begin_and_end_bound_the_departures(files: Files) -> None:
    flow = '<flow id="f" type="t" begin="0" end="900" period="100" route="main"/>'
    assert [d.depart_s for d in files.read(flow, begin=200, end='<end value="500"/>').departures] == [200, 300, 400]
    files.write(flow)
    assert [d.depart_s for d in read_traffic(files.sumocfg, files.folder / "work", duration_s=250).departures] == [0, 100, 200]


def test_what_is_not_followed_is_told(files: Files) -> None:
    traffic = files.read(
        '<vType id="car"/><vType id="loose" vClass="rail" speedFactor="normc(0.8,0.1,0.2,1)"/>'
        '<vehicle id="c" type="car" depart="0"><route edges="zx"/></vehicle><vehicle id="nameless" depart="0"><route edges="zx"/></vehicle>'
        '<vehicle id="v" type="loose" depart="0" departPos="random" departSpeed="avg" arrivalSpeed="0" speedFactor="0.7"><route '
        'edges="ab bc"/><stop lane="bc_0" endPos="20" duration="3" triggered="true"/></vehicle>'
        '<person id="p" depart="0"><walk edges="zx"/></person><containerFlow id="k" begin="0" number="1" end="5"/>',
        stops=STOPS.replace("</additional>", '<calibrator id="r" edge="ab"/></additional>'),
    )
    assert [d.id for d in traffic.departures] == ["v"]
    assert set(traffic.kinds) == {"loose"} and traffic.kinds["loose"].speed_factor == 0.8
    assert traffic.notes == (
        "1 definitions of persons left out",
        "1 definitions of containers left out",
        "2 vehicles, trips and flows left out: not rail",
        '1 x departPos="random": drawn here, with random numbers other than SUMO\'s',
        "vType loose: speedFactor = normc(0.8,0.1,0.2,1): its mean 0.8 for every train",
        "option step-length = 0.5: not followed: the step is run.step_s of the scenario",
        "1 x <vehicle arrivalSpeed>: not followed: trains leave as fast as they come",
        "1 x <vehicle speedFactor>: not followed: that of the vType holds",
        "1 x <stop triggered>: not followed: no passengers board; a train stands as long as duration and until say",
        "1 x <calibrator>: not followed: no train is let in or taken out by it",
    )


def test_what_is_followed_is_listed(files: Files) -> None:
    traffic = files.read(
        f'{V} route="main" arrivalPos="40" color="red"><stop lane="bc_0" endPos="60" duration="3" parking="true" triggered="true"/></vehicle>',
        stops=STOPS.replace("</additional>", '<variableSpeedSign id="s" lanes="bc_0"><step time="0" speed="9"/></variableSpeedSign></additional>'),
    )  # fmt: skip
    said = dict(line.split(": ", 1) for line in traffic.followed)
    assert {"net-file", "route-files", "begin"} <= set(said["options"].split(", "))
    assert said["<vehicle>"] == "1 x type, 1 x depart, 1 x route, 1 x arrivalPos"
    assert said["<stop>"] == "1 x lane, 1 x endPos, 1 x duration, 1 x parking"  # nobody boards: that is named
    assert said["<variableSpeedSign>"] == "1"


def test_params_that_change_a_run_are_named_and_those_of_the_user_are_not(files: Files) -> None:
    params = '<param key="has.rerouting.device" value="true"/><param key="colour of the doors" value="red"/>'
    notes = files.read(f'{V} route="main">{params}</vehicle>').notes
    assert "1 x <param has.rerouting.device>: not followed: trains keep their routes" in notes
    assert not [note for note in notes if "doors" in note]


def test_places_drawn_in_a_parking_area_are_nothing_to_follow(files: Files) -> None:
    area = '<parkingArea id="yard" lane="bc_0" startPos="0" endPos="90"><space x="5" y="5"/></parkingArea></additional>'
    traffic = files.read(
        f'{V} route="main"><stop parkingArea="yard" duration="3"/></vehicle>', stops=STOPS.replace("</additional>", area)
    )
    assert traffic.departures[0].stops[0].parks
    assert "<parkingArea>: 1 x lane, 1 x startPos, 1 x endPos" in traffic.followed
    assert not [line for line in (*traffic.notes, *traffic.followed) if "space" in line]


def test_what_nobody_thought_of_is_named(files: Files) -> None:
    files.write(
        f'{V} route="main" flavour="sweet" color="red"><stop lane="bc_0" endPos="60" duration="3" mood="good"/><mystery/></vehicle>'
        '<riddle id="r"/><riddle id="s"/>'
    )
    said = files.sumocfg.read_text().replace(
        "<time>",
        '<slope-centered value="true"/><device.rerouting.period value="10"/><device.fcd.period value="3"/><fcd-output value="f.xml"/><verbose value="true"/><time>',
    )
    files.sumocfg.write_text(said)
    net = files.folder / "n.net.xml"
    net.write_text(net.read_text().replace('<edge id="ab"', '<edge id="ab" colour="blue"').replace("</net>", "<oddity/></net>"))
    notes = read_traffic(files.sumocfg, files.folder / "work").notes
    unknown = "not followed: it is not known here"
    assert [n for n in notes if "not known" in n] == [
        f"option slope-centered = true: {unknown}",
        f"1 x <vehicle flavour>, 1 x <stop mood>, 1 x <mystery>: {unknown}",
        f"2 x <riddle>: {unknown}",
        f"net: 1 x <edge colour>: {unknown}",
        f"net: 1 x <oddity>: {unknown}",
    ]
    assert "option device.rerouting.period = 10: not followed: trains keep their routes" in notes
    assert not [n for n in notes if "fcd" in n or "verbose" in n or "color" in n]


@pytest.mark.parametrize("key", ["split", "join", "jump"])
def test_what_cannot_be_followed_is_refused_with_the_reason(files: Files, key: str) -> None:
    (told,) = files.mistakes(f'{V} route="main"><stop lane="bc_0" endPos="60" duration="3" {key}="w"/></vehicle>')
    assert told.startswith(f"{files.sumocfg}: 1 x <stop {key}>: ")


MISTAKES = {
    f'{V}><route edges="ab cd"/></vehicle>': ["train v: its route is not connected: no path from edge ab to edge cd"],
    '<flow id="u" type="t" begin="0" period="10" from="bc" to="ab"/>': ["flow u: no path from edge bc to edge ab"],
    f'{V}><route edges="ab nope"/></vehicle>': ["train v: edge nope: not in the net"],
    '<vehicle id="v" type="ghost" depart="0" route="main"/>': ["train v: type = ghost: no such vType"],
    f'{V} route="ghost"/>': ["train v: route = ghost: no such route"],
    '<trip id="v" type="t" depart="0" from="cd" to="ab"/><trip id="w" type="t" depart="3" from="bc" to="ab"/>': [
        "train v: no path from edge cd to edge ab",
        "train w: no path from edge bc to edge ab",
    ],
    '<trip id="v" type="t" depart="0" from="ab" to="nope"/>': ["train v: edge nope: not in the net"],
    f'{V}><route edges="ab bc"/><stop busStop="east" duration="3"/></vehicle>': ["train v: stop on edge cd: not on its route"],
    f'{V} route="main"><stop lane="bc_0" endPos="60" duration="3"/><stop lane="bc_0" endPos="20" duration="3"/></vehicle>': [
        "train v: stop on edge bc at 20 m: lies behind the stop before"
    ],
    f'{V} route="main"><stop trainStop="ghost" duration="3"/></vehicle>': ["train v: stop at trainStop ghost: no such trainStop"],
    f'{V} route="main"><stop lane="bc_0" endPos="20"/></vehicle>': ["train v: stop on edge bc: neither duration nor until"],
    f'{V} route="main"><stop lane="bc_0" endPos="x" duration="y"/></vehicle>': [
        "train v: stop on edge bc: duration = y, endPos = x: must be a number, a time not negative"
    ],
    '<vehicle id="v" type="t" depart="triggered" route="main"/>': [
        "train v: depart = triggered: must be a time; what a train is to wait for is not known before the run"
    ],
    '<flow id="u" type="t" begin="triggered" number="2" route="main"/>': [
        "flow u: depart = triggered: must be a time; what a train is to wait for is not known before the run"
    ],
    f'{V} route="main" departSpeed="-1"/>': ["train v: departSpeed = -1: must not be negative"],
    f"{V}/>": ["train v: no route"],
    f'{V}><route edges="zx"/></vehicle>': ["train v: duarouter finds no route; are all its edges open to its vClass?"],
    '<flow id="v" type="t" begin="0" end="9" number="2"><route edges="zx"/></flow>': [
        "flow v: duarouter finds no route; are all its edges open to its vClass?"
    ],
    f'{V} route="main"><stop duration="4"/></vehicle>': ["train v: a stop names neither a lane nor an edge nor a stopping place"],
    f'{V} route="main"/>{V} route="main"/>': ["train v: there are several of this id"],
    '<vType id="bad" vClass="rail" length="long"/>': ["vType bad: length = long: must be a number, not negative"],
    f'{V} route="ghost"/><vehicle id="w" type="ghost" depart="containerTriggered" route="main"/>': [
        "train v: route = ghost: no such route",
        "train w: type = ghost: no such vType",
        "train w: depart = containerTriggered: must be a time; what a train is to wait for is not known before the run",
    ],
}  # fmt: skip


@pytest.mark.parametrize("demand", MISTAKES, ids=range(len(MISTAKES)))
def test_mistakes_are_told_all_at_once(files: Files, demand: str) -> None:
    assert files.mistakes(demand) == MISTAKES[demand]


def test_two_things_of_one_name_are_a_mistake(files: Files) -> None:
    path = files.folder / "r.rou.xml"
    assert files.mistakes(f"{ROUTE}{CUSTOM}") == [f"{path}: route main: there are several of this id",
                                                  f"{path}: vType t: there are several of this id"]  # fmt: skip


def test_the_types_sumo_has_of_its_own(files: Files) -> None:
    assert (
        files.read('<vehicle id="v" type="DEFAULT_RAILTYPE" depart="0" route="main"/>').kinds["DEFAULT_RAILTYPE"].length_m == 135.0
    )
    traffic = files.read('<vType id="DEFAULT_VEHTYPE" vClass="rail" length="33"/><vehicle id="v" depart="0" route="main"/>')
    assert traffic.departures[0].position_m == pytest.approx(33.1)


def test_places_off_the_edge_are_mistakes(files: Files) -> None:
    (wrong,) = files.mistakes(f'{V} route="main"><stop lane="bc_0" endPos="9000" duration="3"/></vehicle>')
    assert wrong == f"train v: stop on edge bc: endPos = 9000: off the edge, which is {files_length(files, 'bc_0'):g} m long"
    (wrong,) = files.mistakes(f'{V} route="main" departPos="9000"/>')
    assert wrong == f"train v: departPos = 9000: off edge ab, which is {files_length(files, 'ab_0'):g} m long"
    (wrong,) = files.mistakes(f'{V} route="main" departPos="here"/>')
    assert wrong == "train v: departPos = here: must be a number or one of base, stop, random, free, random_free, last, splitFront"


def test_a_configuration_without_trains_is_a_mistake(files: Files) -> None:
    assert files.mistakes("")[0].startswith(f"{files.sumocfg}: no trains: no vehicle, trip or flow has a vType of a rail class")
    (wrong,) = files.mistakes('<vehicle id="v" type="t" depart="9" route="main"/>', begin=20)
    assert wrong == f"{files.sumocfg}: no train departs at begin = 20 or later"


def test_files_that_are_not_what_they_should_be(files: Files) -> None:
    def told(sumocfg: str) -> list[str]:
        files.sumocfg.write_text(sumocfg)
        with pytest.raises(InputError) as caught:
            read_traffic(files.sumocfg, files.folder / "work")
        return [m.replace(str(files.folder), "F") for m in caught.value.mistakes]

    net = '<net-file value="n.net.xml"/>'
    (files.folder / "list.xml").write_text("<routes>")
    (files.folder / "bad.rou.xml.gz").write_bytes(b"\x1f\x8bnothing of the kind")
    assert told("not XML")[0].startswith("F/run.sumocfg: not XML: ")
    assert told("<net/>") == ["F/run.sumocfg: not a SUMO configuration: it begins with <net>, not <sumoConfiguration>"]
    (files.folder / "other.net.xml").write_text("<nodes/>")
    assert told('<configuration><net-file value="other.net.xml"/><route-files value="list.xml"/></configuration>') == [
        "F/other.net.xml: not a SUMO net: its root element is <nodes>, not <net>"
    ]
    assert told("<configuration/>") == [
        "F/run.sumocfg: no net-file",
        "F/run.sumocfg: no route-files, nor additional-files with trains in them",
    ]
    assert told(f'<configuration>{net}<route-files value="a.xml,b.xml"/><end value="soon"/></configuration>') == [
        "F/run.sumocfg: F/a.xml: no such file",
        "F/run.sumocfg: F/b.xml: no such file",
        "F/run.sumocfg: end = soon: must be a time",
    ]
    assert told(
        '<configuration><net-file value="list.xml"/><route-files value="list.xml"/><step-length value="0"/></configuration>'
    ) == ["F/run.sumocfg: step-length = 0: must be a time, above 0"]
    assert told(f'<configuration>{net}<route-files value="list.xml"/></configuration>')[0].startswith("F/list.xml: not XML: ")
    assert told(f'<configuration>{net}<route-files value="bad.rou.xml.gz"/></configuration>')[0].startswith(
        "F/bad.rou.xml.gz: not XML"
    )
    with pytest.raises(InputError, match=r"none\.sumocfg: no such file"):
        read_traffic(files.folder / "none.sumocfg", files.folder / "work")


def test_lengths_and_speeds_are_those_of_sumo(files: Files) -> None:
    classes = ("rail", "rail_electric", "rail_fast", "rail_urban", "tram", "subway", "cable_car")
    built = ("NGT400", "NGT400_16", "ICE1", "ICE3", "REDosto7", "RB425", "RB628", "Freight", "MireoPlusB", "MireoPlusH", "custom")
    curves = 'maxPower="1" maxTraction="1" resCoef_constant="1" resCoef_linear="0" resCoef_quadratic="0"'
    types = [f'<vType id="{c}" vClass="{c}"/>' for c in classes]
    types += [f'<vType id="{b}" vClass="rail" carFollowModel="Rail" trainType="{b}" {curves}/>' for b in built]
    trains = "".join(f'<vehicle id="v{t}" type="{t}" depart="0"><route edges="ab"/></vehicle>' for t in (*classes, *built))
    edges = EDGES.replace("rail rail_fast", " ".join(classes))
    (files.folder / "n.nod.xml").write_text(NODES)
    (files.folder / "n.edg.xml").write_text(edges)
    netconvert, environment = program("netconvert")
    subprocess.run([netconvert, "-n", "n.nod.xml", "-e", "n.edg.xml", "-o", "n.net.xml"], cwd=files.folder, env=environment,
                   check=True, capture_output=True)  # fmt: skip
    kinds = files.read("".join(types) + trains).kinds
    script = f"""libsumo.start(["sumo", "-c", "run.sumocfg", "--no-step-log", "--no-warnings"])
T = libsumo.vehicletype
out = {{t: [T.getLength(t), T.getMaxSpeed(t), T.getSpeedFactor(t), T.getMass(t), T.getDecel(t)] for t in {(*classes, *built)}}}
"""
    for name, (length, speed, factor, mass, decel) in in_sumo(files.folder, script).items():
        kind = kinds[name]
        assert (kind.length_m, kind.max_speed_mps, kind.speed_factor) == pytest.approx((length, speed, factor)), name
        if name in built and name != "custom":
            data = train_type(kind)
            assert isinstance(data, TrainType)
            assert data.unit_mass_kg == mass
            assert data.braking_n == pytest.approx(decel * mass * float(str(data.rotating_mass_factor)))


def test_the_physical_data_move_a_train_as_sumo_does(files: Files) -> None:
    """SUMO's own acceleration at every speed, so that the units are what they are taken for."""
    traffic = files.read('<vehicle id="v" type="t" depart="0" departSpeed="0" route="main"/>')
    data = train_type(traffic.kinds["t"])
    assert isinstance(data, TrainType)
    script = """libsumo.start(["sumo", "-c", "run.sumocfg", "--no-step-log", "--no-warnings"])
for _ in range(80):
    libsumo.simulationStep()
    out.append(libsumo.vehicle.getSpeed("v"))
"""
    speeds = in_sumo(files.folder, script)
    mass, factor = 90e3, 1.08
    assert (data.unit_mass_kg, data.rotating_mass_factor, data.unit_length_m) == (mass, factor, 100)
    assert data.braking_n == pytest.approx(0.8 * mass * factor)
    checked = 0
    for v, faster in pairwise(speeds):
        pull = min(150e3, float(str(data.traction_power_w)) / v if v else 1e9)
        assert data.traction_n == 150e3
        drag = float(str(data.c0_n_per_kg)) + float(str(data.c1_ns_per_m_kg)) * v + float(str(data.c2_ns2_per_m2_kg)) * v * v
        if faster < 35.9:
            assert (faster - v) / 0.5 == pytest.approx((pull / mass - drag) / factor, abs=1e-9)
            checked += v > 2350 / 150
    assert checked > 10  # in the range of constant power too


def test_what_a_type_lacks_is_told_in_one_line() -> None:
    def said(**attributes: str) -> list[str] | TrainType:
        return train_type(Kind("ICE", "rail", 200.0, 80.0, 1.0, attributes))

    constants = "mass, maxPower, maxTraction, resCoef_constant, resCoef_linear, resCoef_quadratic"
    cure = f'add [train_type.ICE] or, for all such types, [train_type."*"] to the scenario, or carFollowModel="Rail" trainType="custom" with {constants} to the vType'
    assert said() == [f"vType ICE: {', '.join(f'no {key}' for key in constants.split(', '))}: {cure}"]
    lacking = "no maxPower, no maxTraction, no resCoef_constant, no resCoef_linear, no resCoef_quadratic"
    assert said(maxPower="1", mass="80000") == [f"vType ICE: {lacking}: {cure}"]  # no other model takes notice of maxPower
    whole = dict.fromkeys(constants.split(", "), "1") | {"carFollowModel": "Rail", "trainType": "custom"}
    assert isinstance(said(**whole), TrainType)
    assert said(**whole | {"maxPower": "-3", "decel": "x"}) == [
        "vType ICE: decel = x: must be a number, not negative",
        "vType ICE: maxPower = -3: must be a number, not negative",
    ]
    assert said(**whole | {"mass": "0"}) == ["vType ICE: mass = 0: must be above 0"]


TRAIN_TYPES = sorted(RAIL_MODEL.keys() - {"custom"})


def test_train_types_of_sumo_move_as_in_sumo(tmp_path: Path) -> None:
    """The acceleration of each, at full effort up to its maximum speed, is SUMO's within the error stated, and comes near it."""
    nets.net(tmp_path, {"a": (0, 0), "b": (300000, 0)}, {"ab": ("a", "b", {"speed": 200})})
    types = "".join(
        f'<vType id="{t}" vClass="rail" carFollowModel="Rail" trainType="{t}" sigma="0" speedDev="0"/>' for t in TRAIN_TYPES
    )
    trains = "".join(
        f'<vehicle id="{t}" type="{t}" depart="0" departSpeed="0" departPos="{1e4 * (k + 1)}" insertionChecks="none">'
        '<route edges="ab"/></vehicle>'
        for k, t in enumerate(TRAIN_TYPES)
    )
    nets.traffic(tmp_path, trains, types)
    script = f"""libsumo.start(["sumo", "-c", "a.sumocfg", "--no-step-log", "--no-warnings", "--railsignal-moving-block"])
names = {TRAIN_TYPES}
libsumo.simulationStep()
for _ in range(250):
    out.append([libsumo.vehicle.getSpeed(name) for name in names])
    libsumo.simulationStep()
"""
    speeds = np.array(in_sumo(tmp_path, script))
    kinds = read_traffic(tmp_path / "a.sumocfg", tmp_path / "work").kinds
    for k, name in enumerate(TRAIN_TYPES):
        data, built = train_type(kinds[name]), RAIL_MODEL[name]
        assert isinstance(data, TrainType)
        v, gain = speeds[:-1, k], np.diff(speeds[:, k])
        free = (v + gain < built.speed_mps - 0.01) & (gain > 0.0)
        mass, factor = built.mass_kg, built.mass_factor
        pull = np.minimum(data.traction_n, data.traction_power_w / np.maximum(v, 1e-9)) / mass
        drag = data.c0_n_per_kg + data.c1_ns_per_m_kg * v + data.c2_ns2_per_m2_kg * v * v
        error = float(np.max(np.abs((pull - drag) / factor - gain)[free]))
        assert free.sum() > 30 and 0.3 * built.error_mps2 < error <= built.error_mps2, (name, error)
    assert len(fitted(kinds.values())[0].split("within")) == len(TRAIN_TYPES) + 1


def test_types_without_data_have_those_of_the_rest_with_what_they_state_themselves() -> None:
    rest = TrainType(unit_length_m=50.0, units=2, unit_mass_kg=40e3, c0_n_per_kg=0.01, c1_ns_per_m_kg=0.0, c2_ns2_per_m2_kg=0.0)
    plain = train_type(Kind("p", "rail", 90.0, 40.0, 1.0, {}), rest)
    assert isinstance(plain, TrainType) and (plain.unit_length_m, plain.unit_mass_kg, plain.braking_n) == (45.0, 40e3, None)
    heavy = train_type(Kind("h", "rail", 90.0, 40.0, 1.0, {"mass": "100000", "decel": "0.5"}), rest)
    assert isinstance(heavy, TrainType) and heavy.unit_mass_kg == (50e3, 50e3) and heavy.braking_n == (25e3, 25e3)
    assert train_type(Kind("w", "rail", 90.0, 40.0, 1.0, {"mass": "0"}), rest) == ["vType w: mass = 0: must be a number above 0"]


@pytest.mark.parametrize("name", ["rail", "rail_demo"])
def test_the_railways_in_the_wheel(name: str, tmp_path: Path) -> None:
    import sumo

    traffic = read_traffic(Path(sumo.SUMO_HOME) / "tools" / "game" / f"{name}.sumocfg", tmp_path)
    assert [d.kind for d in traffic.departures] == ["freightTrain", "passengerTrain", "passengerTrain"]
    for d in traffic.departures:
        assert (d.stops[0].edge, d.stops[0].position_m, d.speed_mps) == (d.edges[0], d.position_m, 0.0)
        assert d.line in ("line1", "line2")
    assert "2 definitions of persons left out" in traffic.notes
