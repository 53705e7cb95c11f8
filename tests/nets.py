"""Railways nobody here laid out, made with netconvert for the tests: each function writes a net, its traffic and a configuration.

A net goes into ``folder`` as ``a.net.xml`` with ``a.rou.xml`` and ``a.sumocfg``; ``scenario`` gives the rest as a mapping.
"""

from __future__ import annotations

import copy
import math
import random
import subprocess
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from sumo_net import LineError
from sumo_net.build import program
from trainctl.traffic.files import is_time, seconds

#: A train that can brake and pull with some 1 m/s2.
TYPE = {
    "unit_mass_kg": 200000.0, "c0_n_per_kg": 1.176e-2, "c1_ns_per_m_kg": 7.7616e-4, "c2_ns2_per_m2_kg": 1.6e-5,
}  # fmt: skip
UNITS = TYPE | {
    "units": 4, "unit_length_m": 25.0, "unit_mass_kg": 50000.0, "coupler_stiffness_n_per_m": 1.6e5,
    "coupler_damping_ns_per_m": 600.0,
}  # fmt: skip

#: Among the options of ``convert``: trains turn back where a track ends.
TERMINALS = "terminals"

EMU = '<vType id="emu" vClass="rail" length="100" maxSpeed="45"/>'

#: What each law needs to run trains at 35 m/s, 1200 m apart.
LAWS: dict[str, dict[str, Any]] = {
    "fully_distributed": {
        "run": {"control_period_s": 5.0},
        "controller": {"law": "fully_distributed"},
        "bounds": {"speed_lower_mps": 31.0, "speed_upper_mps": 38.0, "input_lower_mps2": -1.0, "input_upper_mps2": 1.0},
        "topology": {"lower_m": 500.0, "upper_m": 1900.0},
        "train_type": TYPE | {"unit_length_m": 100.0},
    },
    "robust_constrained": {
        "controller": {"law": "robust_constrained", "h_per_s": 0.1},
        "plant": {
            "kind": "point", "speed_lower_mps": 0.0, "speed_upper_mps": 38.0, "input_lower_mps2": -1.0, "input_upper_mps2": 1.0
        },
        "bounds": {"speed_lower_mps": 0.0, "speed_upper_mps": 38.0, "input_lower_mps2": -1.0, "input_upper_mps2": 1.0},
        "topology": {"lower_m": 500.0, "upper_m": 1900.0, "weight": 0.001},
        "train_type": TYPE | {"unit_length_m": 100.0},
    },
    "emu_finite_time": {
        "run": {"sub_step_s": 0.01},
        "controller": {"law": "emu_finite_time", "emergency_distance_m": 400.0, "emergency_zone_m": 200.0, "range_m": 3000.0},
        "plant": {"kind": "coupled_units"},
        "bounds": {"coupler_lower_m": -0.1, "coupler_upper_m": 0.1},
        "topology": {"lower_m": 500.0},
        "train_type": UNITS,
    },
    "fault_tolerant": {
        "run": {"sub_step_s": 0.01},
        "controller": {
            "law": "fault_tolerant", "speed_error_lower_mps": -20.0, "speed_error_upper_mps": 20.0,
            "leader_error_lower_m": -700.0, "leader_error_upper_m": 700.0,
        },
        "observer": {"kind": "asymptotic"},
        "plant": {"kind": "actuated_units"},
        "topology": {"lower_m": 500.0, "upper_m": 1900.0},
        "train_type": UNITS | {"actuator_rate_per_s": 50.0},
    },
}  # fmt: skip


def net(
    folder: Path, nodes: Mapping[str, tuple[float, float]], edges: Mapping[str, Any], *options: str, signals: Collection[str] = ()
) -> None:
    """Write ``a.net.xml``: nodes are (x, y), edges (from, to) or (from, to, further attributes); rail signals stand at ``signals``."""
    folder.mkdir(parents=True, exist_ok=True)
    kind = {n: ' type="rail_signal"' if n in signals else "" for n in nodes}
    (folder / "a.nod.xml").write_text(
        "<nodes>" + "".join(f'<node id="{n}" x="{x}" y="{y}"{kind[n]}/>' for n, (x, y) in nodes.items()) + "</nodes>"
    )
    rows = []
    for name, (begin, end, *more) in edges.items():
        said = {"numLanes": 1, "speed": 40, "allow": "rail"} | (more[0] if more else {})
        rows.append(f'<edge id="{name}" from="{begin}" to="{end}" ' + " ".join(f'{k}="{v}"' for k, v in said.items()) + "/>")
    (folder / "a.edg.xml").write_text(f"<edges>{''.join(rows)}</edges>")
    convert(folder, *options)


def convert(folder: Path, *options: str) -> None:
    """Make the net of its sources: trains turn back nowhere, or with ``TERMINALS`` among the options where a track ends."""
    netconvert, environment = program("netconvert")
    files = ["-n", "a.nod.xml", "-e", "a.edg.xml", "-o", "a.net.xml", *([] if TERMINALS in options else ["--no-turnarounds"])]
    options = tuple(option for option in options if option != TERMINALS)
    subprocess.run([netconvert, *files, *options], cwd=folder, env=environment, check=True, capture_output=True)


def both_ways(name: str, begin: str, end: str, **more: Any) -> dict[str, Any]:
    """Single track: an edge and its twin, which netconvert recognises by the same place."""
    said = {"spreadType": "center"} | more
    return {name: (begin, end, said), f"-{name}": (end, begin, said)}


def traffic(folder: Path, body: str, types: str = EMU, end: int = 9000, begin: int = 0) -> None:
    """Write ``a.rou.xml``, sorted by departure times as SUMO wants it, and ``a.sumocfg``."""
    given = sorted(ElementTree.fromstring(f"<routes>{body}</routes>"), key=_departs)
    rows = "".join(ElementTree.tostring(element, "unicode") for element in given)
    (folder / "a.rou.xml").write_text(f"<routes>{types}{rows}</routes>")
    (folder / "a.sumocfg").write_text(
        '<configuration><input><net-file value="a.net.xml"/><route-files value="a.rou.xml"/></input>'
        f'<time><begin value="{begin}"/><end value="{end}"/></time></configuration>'
    )


def _departs(element: ElementTree.Element) -> float:
    """When a train or the first of a flow departs [s]; what else there is comes before."""
    said = element.get("depart", element.get("begin"))
    return seconds(said) if said is not None and is_time(said) else -math.inf  # no time: a mistake that a test wants


def flow(name: str, route: str, number: int, period: float, begin: float = 0.0, **more: Any) -> str:
    """Trains of one route, one every ``period`` [s]."""
    said = {"type": "emu", "departSpeed": "max"} | more
    rest = " ".join(f'{k}="{v}"' for k, v in said.items())
    return f'<flow id="{name}" begin="{begin}" number="{number}" period="{period}" {rest}><route edges="{route}"/></flow>'


def train(name: str, route: str, depart: float, stops: str = "", **more: Any) -> str:
    """One train."""
    said = {"type": "emu", "departSpeed": "max"} | more
    rest = " ".join(f'{k}="{v}"' for k, v in said.items())
    return f'<vehicle id="{name}" depart="{depart}" {rest}><route edges="{route}"/>{stops}</vehicle>'


def scenario(law: str, duration: float, types: tuple[str, ...] = ("emu",), **changes: Any) -> dict[str, Any]:
    """The scenario of ``a.sumocfg`` under a law of ``LAWS``; ``changes`` are tables to merge in."""
    tables: dict[str, Any] = {
        "schema_version": 1, "title": law, "run": {"duration_s": duration}, "network": {"sumocfg": "a.sumocfg"},
        "reference": {"speed_mps": 35.0}, "topology": {"spacing_m": 1200.0},
    }  # fmt: skip
    own = copy.deepcopy(LAWS[law])
    kind = own.pop("train_type")
    for table, keys in (*own.items(), ("train_type", dict.fromkeys(types, kind)), *changes.items()):
        tables[table] = {**tables.get(table, {}), **keys}
    return tables


#: A line of ours with slopes, limits and crossovers at odd places.
HILLY = {
    "name": "hilly", "tracks": ["left", "right"], "length_m": 12000.0, "start_m": 250.5, "max_edge_m": 20000.0,
    "speed": [[250.5, 83.333333333333], [4000.0, 40.0]],
    "gradient": [[1000.0, 50.0], [2000.5, -50.0], [3000.0, 0.0], [5000.0, 12.5], [6100.123, -33.3]],
    "crossover": [
        {"id": "over", "from": "left", "to": "right", "position_m": 5800.123456, "length_m": 400.7, "speed_mps": 40.0},
        {"id": "on", "from": "right", "to": "left", "position_m": 6200.823456, "length_m": 200.0, "speed_mps": 40.0},
    ],
}  # fmt: skip


#: What is in a file that is no rail net -> what is told of it, whoever reads it; None: there is no file.
NO_NETS = [
    (None, "no such net file"),
    ("", "not XML: no element found"),
    ("name = 1", "not XML: "),
    ("<net><edge></net>", "not XML: mismatched tag"),
    ("<routes/>", "not a SUMO net: its root element is <routes>, not <net>"),
    ("<net/>", "has no rail edges"),
    ('<net><edge id="e"><lane id="e_0" length="5" speed="9" shape="0,0 5,0"/></edge></net>', "has no rail edges"),
    ('<net><edge id="e"><lane id="e_0" allow="bus bicycle"/></edge></net>', "has no rail edges"),
    ('<net><edge id=":e" function="internal"><lane allow="rail"/></edge></net>', "has no rail edges"),
    ('<!DOCTYPE net [<!ENTITY a "aa"><!ENTITY b "&a;&a;">]><net>&b;</net>', "not a SUMO net: it declares XML entities"),
]


def refused(read: Callable[[Path], Any], path: Path, content: str | None) -> str:
    """The one line with which a file of this content is refused, without the path it begins with."""
    if content is not None:
        path.write_text(content)
    with pytest.raises(LineError) as caught:
        read(path)
    (line,) = caught.value.mistakes
    assert line.startswith(f"{path}: ")
    return line.removeprefix(f"{path}: ")


# Nets


def branches(folder: Path, *options: str, number: int = 3, period: float = 120.0) -> None:
    """Two branches that join, run together and part again; flows from both, one local train."""
    net(
        folder,
        {"w": (0, 0), "m": (8000, 0), "e": (30000, 0), "s": (0, -2000), "n": (40000, 3000), "z": (45000, 0)},
        {"west": ("w", "m"), "south": ("s", "m"), "main": ("m", "e"), "north": ("e", "n"), "east": ("e", "z")},
        *options,
    )
    traffic(folder, flow("w", "west main east", number, period) + flow("s", "south main north", number, period, 30.0))


def three_joins(folder: Path) -> None:
    """Three joins one after the other, then two branchings."""
    net(
        folder,
        {"a": (0, 0), "b": (8000, -1500), "c": (14000, 1500), "d": (0, -2500), "1": (9000, 0), "2": (16000, 0), "3": (23000, 0),
         "4": (38000, 0), "5": (44000, 0), "x": (55000, 0), "y": (48000, 2000), "z": (52000, -2500)},
        {"a1": ("a", "1"), "d1": ("d", "1"), "12": ("1", "2"), "b2": ("b", "2"), "23": ("2", "3"), "c3": ("c", "3"),
         "34": ("3", "4"), "4y": ("4", "y"), "45": ("4", "5"), "5x": ("5", "x"), "5z": ("5", "z")},
    )  # fmt: skip
    traffic(
        folder,
        flow("a", "a1 12 23 34 45 5x", 4, 160)
        + flow("b", "b2 23 34 4y", 3, 210, 240)
        + flow("c", "c3 34 45 5z", 3, 230, 450)
        + flow("d", "d1 12 23 34 45 5z", 3, 200, 40),
    )


def single_track(folder: Path, body: str, signals: Collection[str] = ()) -> None:
    """Single track from ``a`` to ``b`` with two passing loops: ``UP`` and ``DOWN`` are the ways."""
    loops = {}
    for k, (begin, x) in enumerate((("1", 6000), ("3", 14000)), 1):
        end = str(int(begin) + 1)
        for name, ends, side in ((f"up{k}", (begin, end), 20), (f"down{k}", (end, begin), -20)):
            shape = [f"{x},0", f"{x + 200},{side}", f"{x + 1800},{side}", f"{x + 2000},0"]
            loops[name] = (*ends, {"shape": " ".join(shape if side > 0 else shape[::-1])})
    net(
        folder,
        {"a": (0, 0), "1": (6000, 0), "2": (8000, 0), "3": (14000, 0), "4": (16000, 0), "b": (22000, 0)},
        {**both_ways("left", "a", "1"), **both_ways("middle", "2", "3"), **both_ways("right", "4", "b"), **loops},
        signals=signals,
    )
    traffic(folder, body)


UP, DOWN = "left up1 middle up2 right", "-right down2 -middle down1 -left"


def terminals(
    folder: Path, body: str, *options: str, scale: float = 1.0, signals: Collection[str] = (), **more: Any
) -> None:  # fmt: skip
    """Single track from a terminal ``a`` over ``b``, where a branch to ``d`` leaves it, to one in ``c``; trains turn back in each."""
    nodes = {
        name: (scale * x, scale * y) for name, (x, y) in {"a": (0, 0), "b": (4000, 0), "c": (7000, 0), "d": (6500, 900)}.items()
    }
    edges = {**both_ways("ab", "a", "b"), **both_ways("bc", "b", "c"), **both_ways("bd", "b", "d")}
    net(folder, nodes, edges, TERMINALS, *options, signals=signals)
    traffic(folder, body, **more)


def platforms(folder: Path, body: str, signals: Collection[str] = ()) -> None:
    """A double track, ``up`` and ``down``, that ends in a terminal of two platforms, ``p1`` and ``p2``, in which trains turn back."""
    net(
        folder,
        {"a": (0, 0), "z": (0, -40), "s": (9000, 0), "t1": (10000, 40), "t2": (10000, -40)},
        {"up": ("a", "s"), "down": ("s", "z"), **both_ways("p1", "s", "t1"), **both_ways("p2", "s", "t2")},
        TERMINALS,
        signals=signals,
    )
    traffic(folder, body)


def diamond(folder: Path) -> None:
    """Two lines that cross on the level."""
    net(
        folder,
        {"w": (0, 0), "x": (8000, 0), "e": (16000, 0), "s": (8000, -8000), "n": (8000, 8000)},
        {"w1": ("w", "x"), "e1": ("x", "e"), "s1": ("s", "x"), "n1": ("x", "n")},
    )
    connections = '<connections><connection from="w1" to="e1"/><connection from="s1" to="n1"/></connections>'
    (folder / "a.con.xml").write_text(connections)
    convert(folder, "-x", "a.con.xml")
    traffic(folder, flow("we", "w1 e1", 5, 90) + flow("sn", "s1 n1", 5, 90, 10))


def station(folder: Path) -> None:
    """A line with a station: one train stops by duration, one until a time, two run through."""
    net(folder, {"a": (0, 0), "b": (12000, 0), "c": (40000, 0)}, {"ab": ("a", "b"), "bc": ("b", "c")})
    traffic(
        folder,
        train("through.0", "ab bc", 0)
        + train("stops", "ab bc", 50, '<stop lane="ab_0" endPos="9000" duration="60"/>')
        + train("through.1", "ab bc", 100)
        + train("until", "ab bc", 150, '<stop lane="bc_0" endPos="1000" duration="10" until="650"/>')
        + train("through.2", "ab bc", 200),
    )


def ring(folder: Path) -> None:
    """A ring with a way in; trains run round twice."""
    net(
        folder,
        {"i": (-6000, -3000), "a": (0, -3000), "b": (4000, 0), "c": (0, 3000), "d": (-4000, 0), "o": (8000, -5000)},
        {"in": ("i", "a"), "ab": ("a", "b"), "bc": ("b", "c"), "cd": ("c", "d"), "da": ("d", "a"), "out": ("a", "o")},
    )
    traffic(folder, flow("r", "in ab bc cd da ab bc cd da out", 5, 100))


def limits(folder: Path) -> None:
    """A line whose limit falls, rises and falls below what the laws can hold."""
    net(
        folder,
        {"a": (0, 0), "b": (15000, 0), "c": (22000, 0), "d": (38000, 0), "e": (40000, 0), "f": (60000, 0)},
        {"ab": ("a", "b"), "bc": ("b", "c", {"speed": 34.5}), "cd": ("c", "d"), "de": ("d", "e", {"speed": 20}), "ef": ("e", "f")},
    )
    traffic(folder, flow("t", "ab bc cd de ef", 5, 45))


def crowd(folder: Path, number: int = 50, period: float = 70.0) -> None:
    """Many trains of two types and lengths; pairs depart in one instant, now and then from the same edge."""
    net(
        folder,
        {"a": (0, 0), "b": (9000, 0), "c": (0, -2000), "d": (40000, 0)},
        {"ab": ("a", "b"), "cb": ("c", "b"), "bd": ("b", "d")},
    )
    types = "".join(f'<vType id="{k}" vClass="rail" length="{x}" maxSpeed="45"/>' for k, x in (("emu", 100), ("long", 250)))
    half = number // 2
    traffic(folder, flow("a", "ab bd", half, period) + flow("c", "cb bd", number - half, period, type="long"), types)


def separate(folder: Path) -> None:
    """Two lines that have nothing to do with each other, and a third piece of track nobody uses."""
    net(
        folder,
        {"a": (0, 0), "b": (30000, 0), "c": (0, 5000), "d": (30000, 5000), "e": (0, 9000), "f": (500, 9000)},
        {"ab": ("a", "b"), "dc": ("d", "c"), "ef": ("e", "f")},
    )
    traffic(folder, flow("p", "ab", 4, 40) + flow("q", "dc", 4, 40))


def at_random(folder: Path, seed: int) -> None:
    """A main line with branches that join and part, limits, stops and flows, all drawn."""
    draw = random.Random(seed)
    joins = draw.randint(2, 5)
    nodes, edges, body = {"j0": (0, 0)}, {}, ""
    for k in range(1, joins + 1):
        nodes[f"j{k}"] = (nodes[f"j{k - 1}"][0] + draw.randint(4000, 9000), draw.randint(-500, 500))
        edges[f"m{k}"] = (f"j{k - 1}", f"j{k}", {"speed": draw.choice([25, 33, 40, 40, 45])})
    nodes["z"] = (nodes[f"j{joins}"][0] + 8000, 0)
    edges["mz"] = (f"j{joins}", "z")
    for k in range(joins + 1):
        x, y = nodes[f"j{k}"]
        for name, chance, away in (("in", 0.8 if k else 1.0, -7000), ("out", 0.5 if k else 0.0, 7000)):
            if draw.random() < chance:
                nodes[f"{name}{k}"] = (x + away + draw.randint(0, 1000), y + draw.choice([-1, 1]) * draw.randint(800, 3000))
                edges[f"{name}{k}"] = (f"in{k}", f"j{k}") if name == "in" else (f"j{k}", f"out{k}")
    for k in [k for k in range(joins + 1) if f"in{k}" in edges]:
        for number in range(draw.randint(1, 2)):
            end = draw.choice([*(e for e in range(k + 1, joins + 1) if f"out{e}" in edges), None])
            middle = [f"m{e}" for e in range(k + 1, (joins if end is None else end) + 1)]
            way = [f"in{k}", *middle, "mz" if end is None else f"out{end}"]
            if draw.random() < 0.4:
                stop = f'<stop lane="{way[1]}_0" endPos="{draw.randint(500, 3000)}" duration="{draw.randint(5, 90)}"/>'
                body += train(f"stops{k}.{number}", " ".join(way), draw.randint(0, 400), stop)
            body += flow(f"f{k}.{number}", " ".join(way), draw.randint(2, 5), draw.randint(25, 200), draw.randint(0, 300))
    net(folder, nodes, edges, *draw.choice([(), ("--no-internal-links",)]))
    traffic(folder, body)
