"""A country to run trains in: 60 corridors, one after the other, each with a branch, and a day's timetable.

A corridor is a double track with a station every 6 km. A single-track branch with passing loops joins it. The tracks of one
corridor lead on into those of the next, and some trains run through two or three. Everybody stops; some stops take longer than
planned, so trains are late, wait for each other at loops and joins, and keep out those that are to enter behind them.
"""

from __future__ import annotations

import random
import subprocess
from pathlib import Path

#: Corridors, their stations, the one where the branch joins, and the passing loops of a branch.
CORRIDORS, STATIONS, JOINS_AT, LOOPS = 60, 7, 3, 3
APART_M, LINK_M, PIECE_M, LOOP_M = 6000.0, 15_000.0, 5000.0, 1500.0

#: Timetable: speed with which running times are worked out, slack, stop; how often a stop takes longer, and by how much at most.
PLANNED_MPS, SLACK, STANDS_S = 33.0, 1.05, 40.0
OFTEN, LONGER_S = 0.08, 180.0

#: A day, and its trains: per corridor and hour so many of each kind; what is missing to the number asked for runs far.
DAY_S, RUNS = 86_400.0, 36_000
LOCAL, BRANCH = 15, 6

SCENARIO = """schema_version = 1
title = "A day of a country"
[run]
duration_s = {duration_s}
step_s = 1.0
record_every_s = {record_every_s}
[network]
sumocfg = "a.sumocfg"
[traffic]
cooperate = []
[controller]
law = "robust_constrained"
h_per_s = 0.1
[plant]
kind = "point"
speed_lower_mps = 0.0
speed_upper_mps = 38.0
input_lower_mps2 = -1.0
input_upper_mps2 = 1.0
[reference]
speed_mps = 35.0
[bounds]
speed_lower_mps = 0.0
speed_upper_mps = 38.0
input_lower_mps2 = -1.0
input_upper_mps2 = 1.0
[topology]
spacing_m = 1200.0
lower_m = 500.0
upper_m = 1900.0
weight = 0.001
[supervisor]
mode = "on"
[train_type.emu]
unit_length_m = 100.0
unit_mass_kg = 200000.0
c0_n_per_kg = 1.176e-2
c1_ns_per_m_kg = 7.7616e-4
c2_ns2_per_m2_kg = 1.6e-5
"""


class Plan:
    """Nodes and edges of the net, and the length of every edge [m]."""

    def __init__(self) -> None:
        self.nodes: dict[str, tuple[float, float]] = {}
        self.edges: list[str] = []
        self.length: dict[str, float] = {}

    def edge(self, name: str, begin: str, end: str, more: str = "") -> None:
        """Lay an edge between two nodes."""
        (x, y), (u, v) = self.nodes[begin], self.nodes[end]
        self.length[name] = float(((x - u) ** 2 + (y - v) ** 2) ** 0.5)
        self.edges.append(f'<edge id="{name}" from="{begin}" to="{end}" numLanes="1" speed="40" allow="rail"{more}/>')


def plan(corridors: int) -> Plan:
    """The net: of each corridor ``e`` and ``w`` edges by stations, of its branch ``s`` (and ``-s``), ``u`` and ``d``."""
    net = Plan()
    for r in range(corridors):
        y, way = r * LINK_M, 1 if r % 2 == 0 else -1
        at = 0.0 if way > 0 else STATIONS * APART_M
        for k in range(STATIONS + 1):
            net.nodes[f"e{r}.{k}"] = (at + way * APART_M * k, y)
            net.nodes[f"w{r}.{k}"] = (at + way * APART_M * k, y + 100.0)
        for k in range(STATIONS):
            net.edge(f"E{r}.{k}", f"e{r}.{k}", f"e{r}.{k + 1}")
            net.edge(f"W{r}.{k}", f"w{r}.{k + 1}", f"w{r}.{k}")
        if r:
            net.edge(f"EL{r}", f"e{r - 1}.{STATIONS}", f"e{r}.0")
            net.edge(f"WL{r}", f"w{r}.0", f"w{r - 1}.{STATIONS}")
        x = at + way * (APART_M * JOINS_AT - 4000.0)
        net.nodes[f"i{r}"], net.nodes[f"o{r}"] = (x - way * 24_000.0, y + 4950.0), (x - way * 24_000.0, y + 5050.0)
        for m in range(LOOPS + 1):
            there = x - way * ((LOOPS - m) * (PIECE_M + LOOP_M) + 500.0)
            net.nodes[f"a{r}.{m}"], net.nodes[f"b{r}.{m}"] = (there - way * PIECE_M, y + 5000.0), (there, y + 5000.0)
            both = ' spreadType="center"'
            net.edge(f"s{r}.{m}", f"a{r}.{m}", f"b{r}.{m}", both)
            net.edge(f"-s{r}.{m}", f"b{r}.{m}", f"a{r}.{m}", both)
        for m in range(LOOPS):
            (x0, at_y), (x1, _) = net.nodes[f"b{r}.{m}"], net.nodes[f"a{r}.{m + 1}"]
            for name, side in (("u", 20.0 * way), ("d", -20.0 * way)):
                ends = [(x0, at_y), (x0 + way * 200.0, at_y + side), (x1 - way * 200.0, at_y + side), (x1, at_y)]
                shape = " ".join(f"{a},{b}" for a, b in (ends if name == "u" else ends[::-1]))
                begin, end = (f"b{r}.{m}", f"a{r}.{m + 1}") if name == "u" else (f"a{r}.{m + 1}", f"b{r}.{m}")
                net.edge(f"{name}{r}.{m}", begin, end, f' shape="{shape}"')
        net.edge(f"in{r}", f"i{r}", f"a{r}.0")
        net.edge(f"out{r}", f"a{r}.0", f"o{r}")
        net.edge(f"ju{r}", f"b{r}.{LOOPS}", f"e{r}.{JOINS_AT}")
        net.edge(f"jd{r}", f"w{r}.{JOINS_AT}", f"b{r}.{LOOPS}")
    return net


def routes(corridors: int) -> dict[str, list[list[str]]]:
    """Routes of each kind of train; those of ``local`` and ``branch`` are one per corridor and direction."""
    east = [[f"E{r}.{k}" for k in range(STATIONS)] for r in range(corridors)]
    west = [[f"W{r}.{k}" for k in reversed(range(STATIONS))] for r in range(corridors)]
    ups, downs = [], []
    for r in range(corridors):
        inside = [f"s{r}.0", *(e for m in range(LOOPS) for e in (f"u{r}.{m}", f"s{r}.{m + 1}"))]
        back = [f"-s{r}.{LOOPS}", *(e for m in reversed(range(LOOPS)) for e in (f"d{r}.{m}", f"-s{r}.{m}"))]
        ups.append([f"in{r}", *inside, f"ju{r}", *east[r][JOINS_AT:]])
        downs.append([*west[r][: STATIONS - JOINS_AT], f"jd{r}", *back, f"out{r}"])
    far = []
    for r in range(corridors - 1):
        last = min(r + 1 + r % 2, corridors - 1)
        there, home = list(east[r]), list(west[last])
        for m in range(r + 1, last + 1):
            there += [f"EL{m}", *east[m]]
        for m in range(last - 1, r - 1, -1):
            home += [f"WL{m + 1}", *west[m]]
        far += [there, home]
    return {"local": [way for pair in zip(east, west, strict=True) for way in pair],
            "branch": [way for pair in zip(ups, downs, strict=True) for way in pair], "far": far}  # fmt: skip


def timetable(net: Plan, corridors: int, runs: int, day_s: float, seed: int = 1) -> list[tuple[float, str]]:
    """Departure [s] and element of every train, ``runs`` of them spread over ``day_s``, in the order of departure."""
    draw, ways = random.Random(seed), routes(corridors)
    hours = day_s / 3600.0
    number = {"local": round(LOCAL * corridors * hours), "branch": round(BRANCH * corridors * hours)}
    number["far"] = max(runs - sum(number.values()), 0)
    found = []
    for kind, count in number.items():
        lines = ways[kind]
        for n in range(count):
            line, turn = n % len(lines), n // len(lines)
            apart = day_s / -(-count // len(lines))
            depart = turn * apart + apart * (line * 0.382 % 1.0)
            found.append((round(depart, 1), kind, line, turn))
    found.sort()
    rows = []
    for depart, kind, line, turn in found:
        way, clock, stops = ways[kind][line], depart, ""
        for k, edge in enumerate(way):
            clock += SLACK * net.length[edge] / PLANNED_MPS
            platform = edge[0] in "EWud" and not edge.startswith(("EL", "WL")) and k < len(way) - 1
            if not platform or (kind == "far" and k % 3 != 1):
                continue
            longer = draw.uniform(0.0, LONGER_S) if draw.random() < OFTEN else 0.0
            clock += STANDS_S + 60.0  # braking and pulling away
            place = net.length[edge] - 300.0
            stops += (
                f'<stop lane="{edge}_0" endPos="{place:.1f}" duration="{STANDS_S + longer:.0f}" '
                f'until="{clock:.0f}" arrival="{clock - STANDS_S:.0f}"/>'
            )
        body = f'<route edges="{" ".join(way)}"/>{stops}'
        rows.append((depart, f'<vehicle id="{kind}.{line}.{turn}" type="emu" depart="{depart}" departSpeed="max">{body}</vehicle>'))
    return rows[:runs]


def write(
    folder: Path, runs: int = RUNS, corridors: int = CORRIDORS, day_s: float = DAY_S, first: int | None = None,
    duration_s: float | None = None, record_every_s: float = 60.0,
) -> None:  # fmt: skip
    """Write net, trains and scenario into ``folder``: ``runs`` trains over ``day_s``, or the ``first`` of them only."""
    from sumo_net.build import program

    folder.mkdir(parents=True, exist_ok=True)
    net = plan(corridors)
    nodes = "".join(f'<node id="{name}" x="{x}" y="{y}"/>' for name, (x, y) in net.nodes.items())
    (folder / "a.nod.xml").write_text(f"<nodes>{nodes}</nodes>", encoding="utf-8")
    (folder / "a.edg.xml").write_text(f"<edges>{''.join(net.edges)}</edges>", encoding="utf-8")
    netconvert, environment = program("netconvert")
    files = ["-n", "a.nod.xml", "-e", "a.edg.xml", "-o", "a.net.xml", "--no-turnarounds"]
    subprocess.run([netconvert, *files], cwd=folder, env=environment, check=True, capture_output=True)
    kind = '<vType id="emu" vClass="rail" length="100" maxSpeed="45"/>'
    body = "".join(row for _, row in timetable(net, corridors, runs, day_s)[:first])
    (folder / "a.rou.xml").write_text(f"<routes>{kind}{body}</routes>", encoding="utf-8")
    end = day_s + 7200.0 if duration_s is None else duration_s
    (folder / "a.sumocfg").write_text(
        '<configuration><input><net-file value="a.net.xml"/><route-files value="a.rou.xml"/></input></configuration>',
        encoding="utf-8",
    )
    text = SCENARIO.format(duration_s=end, record_every_s=record_every_s)
    (folder / "scenario.toml").write_text(text, encoding="utf-8")
