"""One probe for each attribute of SUMO's files, beside plain SUMO: order, stops and places are equal, times as the driver explains.

The baseline, which is the user's own simulation, runs them too: there times are equal.

All probes run at once, each on a line of its own. The vTypes accelerate and brake as our driver does and run no faster than he
cruises, so that little is left to explain: a second or two where a train starts, and at every stop that he comes up to it slowly.
"""

from __future__ import annotations

from typing import NamedTuple

import nets
import pandas as pd
import pytest
import tomli_w
from beside import plain

from trainctl.runner import run
from trainctl.runs.logs import vehicles
from trainctl.runs.run import Run
from trainctl.runs.sumo_logs import elements
from trainctl.scenario.build import open_scenario

TYPES = (
    '<vType id="emu" vClass="rail" length="100" maxSpeed="30" accel="0.4" decel="0.5" sigma="0" speedDev="0"/>'
    '<vType id="long" vClass="rail" length="400" maxSpeed="30" accel="0.4" decel="0.5" sigma="0" speedDev="0"/>'
    '<vType id="slow" vClass="rail" length="100" maxSpeed="12" accel="0.4" decel="0.5" sigma="0" speedDev="0"/>'
    '<vType id="careful" vClass="rail" length="100" maxSpeed="30" speedFactor="0.5" accel="0.4" decel="0.5" sigma="0" speedDev="0"/>'
)

#: A start is explained by this, and a stop [s].
START_S, STOP_S = 1.0, 1.5


class Probe(NamedTuple):
    """What is written of the trains of one line; ``@`` stands for the line."""

    body: str
    more: str = ""  # in additional files
    named: str = ""  # what check says of it, where SUMO does something else


def vehicle(said: str = "", stops: str = "", edges: str = "@ab @bc @cd") -> Probe:
    return Probe(f'<vehicle id="@v" type="emu" depart="0" {said}><route edges="{edges}"/>{stops}</vehicle>')


def stop(said: str, more: str = "", **vehicles: str) -> Probe:
    return vehicle(stops=f"<stop {said}/>", **vehicles)._replace(more=more)


def place(tag: str) -> Probe:
    return stop(f'{tag}="@p" duration="30"', f'<{tag} id="@p" lane="@bc_0" startPos="700" endPos="1100"/>')


SIGN = '<variableSpeedSign id="@s" lanes="@bc_0"><step time="0" speed="15"/></variableSpeedSign>'

PROBES: dict[str, Probe] = {
    "depart": Probe('<vehicle id="@v" type="emu" depart="0:00:40"><route edges="@ab @bc"/></vehicle>'),
    "departPos number": vehicle('departPos="700"'),
    "departPos negative": vehicle('departPos="-300"'),
    "departPos base": vehicle('departPos="base"'),
    "departPos stop": vehicle('departPos="stop"', '<stop lane="@ab_0" endPos="900" duration="20"/>'),
    "departSpeed number": vehicle('departSpeed="12.5"'),
    "departSpeed 0": vehicle('departSpeed="0"'),
    "departSpeed max": vehicle('departSpeed="max"'),
    "departSpeed avg": vehicle('departSpeed="avg"'),
    "departSpeed desired": vehicle('departSpeed="desired"'),
    "departSpeed desired of a type": Probe(
        '<vehicle id="@v" type="careful" depart="0" departSpeed="desired"><route edges="@ab @bc"/></vehicle>'
    ),
    "departLane best": vehicle('departLane="best"'),
    "departLane number": vehicle('departLane="0"'),
    "departEdge": vehicle('departEdge="1"'),
    "arrivalEdge": vehicle('arrivalEdge="1"'),
    "arrivalPos number": vehicle('arrivalPos="600"'),
    "arrivalPos negative": vehicle('arrivalPos="-600"'),
    "arrivalPos center": vehicle('arrivalPos="center"'),
    "route by id": Probe('<route id="@r" edges="@ab @bc"/><vehicle id="@v" type="emu" depart="0" route="@r"/>'),
    "route stop": Probe(
        '<route id="@r" edges="@ab @bc"><stop lane="@bc_0" endPos="900" duration="30"/></route>'
        '<vehicle id="@v" type="emu" depart="0" route="@r"/>'
    ),
    "trip": Probe('<trip id="@v" type="emu" depart="0" from="@ab" to="@cd"/>'),
    "trip via": Probe('<trip id="@v" type="emu" depart="0" from="@ab" via="@bc" to="@cd"/>'),
    "flow period": Probe('<flow id="@f" type="emu" begin="0" end="250" period="120"><route edges="@ab @bc"/></flow>'),
    "flow number": Probe('<flow id="@f" type="emu" begin="0" end="300" number="3"><route edges="@ab @bc"/></flow>'),
    "flow perHour": Probe('<flow id="@f" type="emu" begin="0" end="300" vehsPerHour="30"><route edges="@ab @bc"/></flow>'),
    "type length": Probe('<vehicle id="@v" type="long" depart="0"><route edges="@ab @bc"/></vehicle>'),
    "type maxSpeed": Probe('<vehicle id="@v" type="slow" depart="0"><route edges="@ab @bc"/></vehicle>'),
    "type speedFactor": Probe('<vehicle id="@v" type="careful" depart="0"><route edges="@ab @bc"/></vehicle>'),
    "stop endPos": stop('lane="@bc_0" endPos="900" duration="30"'),
    "stop endPos negative": stop('lane="@bc_0" endPos="-900" duration="30"'),
    "stop endPos default": stop('lane="@bc_0" duration="30"'),
    "stop at the very end": stop('lane="@cd_0" duration="30"'),
    "stop friendlyPos": stop('lane="@bc_0" endPos="99999" friendlyPos="true" duration="30"'),
    "stop edge": stop('edge="@bc" endPos="900" duration="30"'),
    "stop until": stop('lane="@bc_0" endPos="900" until="200"'),
    "stop until and duration": stop('lane="@bc_0" endPos="900" duration="60" until="150"'),
    "stop duration -1": stop('lane="@bc_0" endPos="900" duration="-1" until="200"'),
    "stop ended": stop('lane="@bc_0" endPos="900" duration="30" ended="400"'),
    "stop arrival": stop('lane="@bc_0" endPos="900" duration="30" arrival="50"'),
    "stop speed": stop('lane="@bc_0" endPos="900" speed="10"'),
    "stop twice on an edge": vehicle(
        stops='<stop lane="@bc_0" endPos="400" duration="20"/><stop lane="@bc_0" endPos="1400" duration="20"/>'
    ),
    "stop parking": Probe(
        '<vehicle id="@v" type="emu" depart="0"><route edges="@ab @bc @cd"/><stop lane="@bc_0" endPos="900" duration="300"'
        ' parking="true"/></vehicle><vehicle id="@w" type="emu" depart="120"><route edges="@ab @bc @cd"/></vehicle>'
    ),
    "trainStop": place("trainStop"),
    "busStop": place("busStop"),
    "containerStop": place("containerStop"),
    "chargingStation": place("chargingStation"),
    "parkingArea": stop(
        'parkingArea="@p" duration="30"',
        '<parkingArea id="@p" lane="@bc_0" startPos="700" endPos="1100" roadsideCapacity="1"/>',
    ),
    "variable speed sign": vehicle()._replace(more=SIGN),
    "vehicle speedFactor": vehicle('speedFactor="0.6"')._replace(named="<vehicle speedFactor>: not followed: that of the vType holds"),
    "vehicle arrivalSpeed": vehicle('arrivalSpeed="5"')._replace(named="<vehicle arrivalSpeed>"),
    "vehicle insertionChecks": vehicle('insertionChecks="none"')._replace(named="<vehicle insertionChecks>"),
}  # fmt: skip
NUMBER = {name: f"p{k}." for k, name in enumerate(PROBES)}


class Seen(NamedTuple):
    """What was seen of all probes."""

    departs: dict[str, float]  # s
    arrivals: dict[str, float]  # s
    trips: dict[str, dict[str, str]]
    stops: dict[str, list[tuple[str, float]]]  # edge, place [m]
    named: list[str]


def of_run(found: Run) -> Seen:
    """What was seen in a run."""
    stops: dict[str, list[tuple[str, float]]] = {}
    rows = pd.concat(batch.to_pandas() for batch in vehicles(found.folder / "sumo" / "fcd.parquet"))
    seen = rows.astype({"id": str, "lane": str}).set_index(["id", "time"])
    for e in found.events:
        if e["kind"] == "stop_reached":
            row = seen.loc[(e["train"], e["time_s"])]
            stops.setdefault(e["train"], []).append((row.lane.rpartition("_")[0], float(row.pos)))
    trips = {at["id"]: at for _, at in elements(found.folder / "sumo" / "tripinfo.xml", "tripinfos", {"tripinfo"})}
    times = [{e["train"]: e["time_s"] for e in found.events if e["kind"] == kind} for kind in ("depart", "arrive")]
    return Seen(*times, trips, stops, [e["what"] for e in found.events if e["kind"] == "not_followed"])


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> tuple[Seen, Seen, Seen]:
    """Ours, plain SUMO's and the baseline's."""
    folder = tmp_path_factory.mktemp("probes")
    nodes, edges, body, more = {}, {}, "", ""
    for k, (name, probe) in enumerate(PROBES.items()):
        at = NUMBER[name]
        nodes |= {f"{at}{n}": (2000.0 * j, 400.0 * k) for j, n in enumerate("abcd")}
        edges |= {f"{at}{x}{y}": (f"{at}{x}", f"{at}{y}") for x, y in ("ab", "bc", "cd")}
        body += probe.body.replace("@", at)
        more += probe.more.replace("@", at)
    nets.net(folder, nodes, edges)
    nets.traffic(folder, body, TYPES)
    (folder / "m.add.xml").write_text(f"<additional>{more}</additional>")
    cfg = folder / "a.sumocfg"
    cfg.write_text(cfg.read_text().replace("</input>", '<additional-files value="m.add.xml"/></input>'))
    tables = nets.scenario(
        "robust_constrained", 900, ("emu", "long", "slow", "careful"), traffic={"cooperate": [], "below_limit_mps": 0.0}
    )
    for kind, length in (("long", 400.0),):
        tables["train_type"][kind] = tables["train_type"][kind] | {"unit_length_m": length}
    tables["reference"] = {"speed_mps": 30.0}
    (folder / "s.toml").write_text(tomli_w.dumps(tables))
    p = open_scenario(str(folder / "s.toml"))
    ours = of_run(run(p, folder / "out"))
    own = {key: tables[key] for key in ("schema_version", "title", "run", "network", "reference", "train_type")}
    own |= {"controller": {"law": "sumo", "block": "moving"}, "topology": {"spacing_m": 1200.0}}
    (folder / "own.toml").write_text(tomli_w.dumps(own))
    baseline = of_run(run(open_scenario(str(folder / "own.toml")), folder / "own"))
    options = ("--railsignal-moving-block", "--tripinfo-output", "trips.xml", "--end", "900")
    halts: dict[str, list[tuple[str, float]]] = {}
    for row in plain(folder, "stop", *options):
        if row.get("state") != "waypoint":
            halts.setdefault(row["id"], []).append((row["lane"].rpartition("_")[0], float(row["pos"])))
    trips = {at["id"]: at for _, at in elements(folder / "trips.xml", "tripinfos", {"tripinfo"})}
    times = [{name: float(at[key]) for name, at in trips.items()} for key in ("depart", "arrival")]
    return ours, Seen(*times, trips, halts, []), baseline


def of_line(names: object, name: str) -> list[str]:
    return [one for one in names if one.startswith(NUMBER[name])]


@pytest.mark.parametrize("name", PROBES)
def test_a_probe_does_what_it_does_in_plain_sumo(seen, name):
    ours, theirs, _ = seen
    trains = of_line(theirs.trips, name)
    assert sorted(of_line(ours.trips, name)) == sorted(trains) and trains
    orders = [sorted(trains, key=lambda train: one.arrivals[train]) for one in (ours, theirs)]
    assert orders[0] == orders[1]
    for train in trains:
        here, there = ours.trips[train], theirs.trips[train]
        assert ours.departs[train] == theirs.departs[train]
        for key in ("departPos", "arrivalPos"):
            assert float(here[key]) == pytest.approx(float(there[key]), abs=0.11), key
        assert here["arrivalLane"] == there["arrivalLane"] and here["departLane"] == there["departLane"]
        stops, halts = ours.stops.get(train, []), theirs.stops.get(train, [])
        assert [edge for edge, _ in stops] == [edge for edge, _ in halts]
        assert [x for _, x in stops] == pytest.approx([x for _, x in halts], abs=0.5)
        late = ours.arrivals[train] - theirs.arrivals[train]
        said = PROBES[name].named
        if said:
            assert [line for line in ours.named if said in line]
        else:
            assert abs(late) <= START_S + STOP_S * len(halts), late


@pytest.mark.parametrize("name", PROBES)
def test_a_probe_does_the_same_in_the_baseline_to_the_second(seen, name):
    _, theirs, own = seen
    trains = of_line(theirs.trips, name)
    assert sorted(of_line(own.trips, name)) == sorted(trains) and trains
    for train in trains:
        here, there = own.trips[train], theirs.trips[train]
        for key in ("departPos", "arrivalPos"):
            assert float(here[key]) == pytest.approx(float(there[key]), abs=0.01), key
        assert here["arrivalLane"] == there["arrivalLane"] and here["departLane"] == there["departLane"]
        assert own.departs[train] == theirs.departs[train] and abs(own.arrivals[train] - theirs.arrivals[train]) <= 1.0
        stops, halts = own.stops.get(train, []), theirs.stops.get(train, [])
        assert [edge for edge, _ in stops] == [edge for edge, _ in halts]
        assert [x for _, x in stops] == pytest.approx([x for _, x in halts], abs=0.5)
