"""Any SUMO rail net as a graph: nets made by netconvert, trains driven by SUMO."""

from __future__ import annotations

import re
import subprocess
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import libsumo
import numpy as np
import pytest
from nets import HILLY, NO_NETS, refused

import sumo_net
from sumo_net import Line, LineError, Rails, build, parse_spec, read_spec
from sumo_net.build import netconvert
from sumo_net.rails import potential

Nodes = dict[str, tuple[float, ...]]
Edges = dict[str, str]  # id: "from to", further words are attributes

FORK: Nodes = {"a": (0, 100), "b": (0, -150), "m": (1000, 0), "s": (2000, 0), "l": (3000, 100), "r": (3000, -100)}
FORK_EDGES: Edges = {"am": "a m", "bm": "b m", "ms": "m s", "sl": "s l", "sr": "s r"}
#: A single track with a passing loop, every track in both directions.
LOOP: Nodes = {"w": (0, 0), "p": (1000, 0), "k": (1500, 60), "q": (2000, 0), "e": (3000, 0)}
LOOP_EDGES: Edges = {
    name + way: f'{" ".join(ends[::step])} spreadType="center"'
    for name, ends in {"west": ("w", "p"), "main": ("p", "q"), "side": ("p", "k"), "edis": ("k", "q"), "east": ("q", "e")}.items()
    for way, step in (("+", 1), ("-", -1))
}
DIAMOND: Nodes = {"c": (0, 0), "w": (-500, 0), "e": (500, 0), "s": (-300, -200), "n": (300, 200)}
DIAMOND_EDGES: Edges = {"wc": "w c", "ce": "c e", "sc": "s c", "cn": "c n"}
#: No rise, then 10 and 20 m on 1000 m of a shape.
HILLS: Nodes = {"a": (0, 0, 5), "b": (1000, 0, 5), "c": (2000, 0, 15), "d": (3000, 0, -5)}


@pytest.fixture
def convert(tmp_path: Path) -> Callable[..., Path]:
    """netconvert over plain XML: nodes, edges, and the connections as pairs (without them every one netconvert finds)."""

    def make(nodes: Nodes, edges: Edges, connections: str = "", *options: str, kind: str = "priority", lane: str = "") -> Path:
        rows = [
            f'<node id="{n}" type="{kind}" ' + " ".join(f'{k}="{v}"' for k, v in zip("xyz", at, strict=False)) + "/>"
            for n, at in nodes.items()
        ]
        (tmp_path / "n.xml").write_text("<nodes>" + "".join(rows) + "</nodes>")
        lane = lane or 'allow="rail" numLanes="1" speed="30"'
        parts = {e: words.split(maxsplit=2) for e, words in edges.items()}
        rows = [f'<edge id="{e}" from="{p[0]}" to="{p[1]}" {lane} {" ".join(p[2:])}/>' for e, p in parts.items()]
        (tmp_path / "e.xml").write_text("<edges>" + "".join(rows) + "</edges>")
        rows = [f'<connection from="{a}" to="{b}"/>' for a, b in (pair.split(">") for pair in connections.split())]
        (tmp_path / "c.xml").write_text("<connections>" + "".join(rows) + "</connections>")
        return run("n.xml", "e.xml", *(["-x", "c.xml"] if rows else []), *options)

    def run(nodes: str, edges: str, *options: str) -> Path:
        program, environment = netconvert()
        command = [str(program), "-n", nodes, "-e", edges, *options, "-o", "x.net.xml"]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return tmp_path / "x.net.xml"

    return make


def generate(folder: Path, kind: str) -> Path:
    """A net of netgenerate on which trains turn in every direction."""
    program, environment = netconvert()
    command = [str(program.with_name("netgenerate")), *f"{kind} --default.allow rail --no-turnarounds -o any.net.xml".split()]
    subprocess.run(command, cwd=folder, env=environment, check=True, capture_output=True)
    return folder / "any.net.xml"


def wheel_net() -> Path:
    from sumo import SUMO_HOME

    return Path(SUMO_HOME) / "tools" / "game" / "rail" / "net.net.xml"


def names(rails: Rails, numbers: object) -> list[str]:
    return [rails.edges[k] for k in numbers]  # type: ignore[attr-defined]


def leads(rails: Rails) -> dict[str, set[str]]:
    """Where every normal edge leads, over the internal ones."""
    found: dict[str, set[str]] = {e: set() for e, inside in zip(rails.edges, rails.internal, strict=True) if not inside}
    for a, b in rails.chains:
        found[rails.edges[a]].add(rails.edges[b])
    return found


def crossings(rails: Rails) -> set[frozenset[tuple[str, str]]]:
    """The ways over a junction that cross, as pairs of (from, to)."""
    on = {k: (rails.edges[a], rails.edges[b]) for (a, b), chain in rails.chains.items() for k in chain}
    return {frozenset((on[a], on[b])) for a, row in enumerate(rails.crossing) for b in row}


def jumps(rails: Rails) -> list[tuple[str, str]]:
    """The connections over which the kilometrage does not run on."""
    end = rails.start_m + rails.length_m
    rows = ((a, b) for a, row in enumerate(rails.onward) for b in row)
    return [(rails.edges[a], rails.edges[b]) for a, b in rows if abs(end[a] - rails.start_m[b]) > 1e-6]


def whole(rails: Rails) -> None:
    """What holds of every net."""
    n = len(rails.edges)
    assert {
        len(getattr(rails, f))
        for f in ("internal", "length_m", "speed_mps", "start_m", "slope", "after", "before", "twin", "crossing")
    } == {n}
    assert {(a, b) for a, row in enumerate(rails.after) for b in row} == {(a, b) for b, row in enumerate(rails.before) for a in row}
    assert np.isfinite(rails.start_m).all() and (rails.length_m > 0).all()
    for k, edge in enumerate(rails.edges):
        assert rails.internal[k] == edge.startswith(":")
        assert list(rails.after[k]) == sorted(set(rails.after[k])) and list(rails.before[k]) == sorted(set(rails.before[k]))
        if rails.internal[k]:
            assert len(rails.after[k]) == len(rails.before[k]) == 1
        else:
            assert not rails.crossing[k]
        assert all(k in rails.crossing[other] and rails.internal[other] and other != k for other in rails.crossing[k])
        if (t := rails.twin[k]) >= 0:
            assert rails.twin[t] == k != t and rails.internal[t] == rails.internal[k]
            assert rails.length_m[t] == pytest.approx(rails.length_m[k], abs=0.011)
    for (a, b), chain in rails.chains.items():
        assert all(second in rails.after[first] for first, second in pairwise((a, *chain, b)))


def drive(net: Path, route: list[str], *, speed: float = 8.0, vehicle_class: str = "rail") -> list[tuple[str, float, float]]:
    """Run one train over a route in SUMO: edge, lane position and odometer at every step."""
    options = "--no-step-log --insertion-checks none --time-to-teleport -1 --default.speeddev 0 --duration-log.disable --no-warnings --step-length 0.5"
    libsumo.start(["sumo", "-n", str(net), *options.split()])
    try:
        libsumo.vehicletype.copy("DEFAULT_VEHTYPE", "emu")
        libsumo.vehicletype.setVehicleClass("emu", vehicle_class)
        libsumo.vehicletype.setLength("emu", 20.0)
        libsumo.route.add("way", route)
        libsumo.vehicle.add("a", "way", typeID="emu", departPos="0.25", departSpeed="0")
        seen = []
        for _ in range(4000):
            libsumo.simulationStep()
            if "a" not in libsumo.vehicle.getIDList():
                return seen
            libsumo.vehicle.setSpeedMode("a", 32)
            libsumo.vehicle.setSpeed("a", speed)
            seen.append((libsumo.vehicle.getRoadID("a"), libsumo.vehicle.getLanePosition("a"), libsumo.vehicle.getDistance("a")))
        raise AssertionError("the train does not arrive")
    finally:
        libsumo.close()


def agrees(rails: Rails, net: Path, route: list[str], *, vehicle_class: str = "rail") -> None:
    """SUMO runs over the edges of the way in its order, and lengths and lane position add up to its odometer."""
    way = rails.way(route)
    seen = drive(net, route, vehicle_class=vehicle_class)
    before = np.concatenate(([0.0], np.cumsum(rails.length_m[way])))
    k, met = 0, set()
    for edge, position, run in seen:
        while rails.edges[way[k]] != edge:
            k += 1  # an IndexError here: SUMO is on an edge that does not come next on the way
        met.add(k)
        assert before[k] + position - 0.25 == pytest.approx(run, abs=1e-6)
    missed = [k for k in range(len(way)) if k not in met and k != len(way) - 1]
    assert all(rails.length_m[way[k]] < 4.0 + 1e-9 for k in missed), names(rails, way[missed])  # 4 m: one step


def test_merge_and_branch(convert):
    net = convert(FORK, FORK_EDGES)
    rails = Rails.read(net)
    whole(rails)
    assert leads(rails) == {"am": {"ms"}, "bm": {"ms"}, "ms": {"sl", "sr"}, "sl": set(), "sr": set()}
    assert rails.internal.sum() == 4
    assert not crossings(rails)
    assert not jumps(rails)
    assert (rails.twin == -1).all()
    assert rails.start_m.min() == 0.0
    ahead = [rails.start_m[rails.index[e]] + rails.length_m[rails.index[e]] for e in ("am", "bm")]
    assert ahead == pytest.approx([rails.start_m[rails.before[rails.index["ms"]][0]]] * 2)
    assert rails.speed_mps.tolist() == [30.0] * 9
    for route in (["am", "ms", "sl"], ["bm", "ms", "sr"], ["ms", "sr"], ["bm"]):
        agrees(rails, net, route)


@pytest.mark.parametrize("kind", ["priority", "rail_signal", "right_before_left", "unregulated"])
def test_a_diamond_crossing_is_one_whatever_the_junction(convert, kind):
    rails = Rails.read(convert(DIAMOND, DIAMOND_EDGES, "wc>ce sc>cn", kind=kind))
    whole(rails)
    assert crossings(rails) == {frozenset([("wc", "ce"), ("sc", "cn")])}
    assert leads(rails) == {"wc": {"ce"}, "sc": {"cn"}, "ce": set(), "cn": set()}
    assert not jumps(rails)
    assert rails.start_m.tolist().count(0.0) == 2  # two tracks that are not connected: each has its own kilometrage


@pytest.mark.parametrize(
    ("foes", "pairs"),
    [
        (("000", "000", "000"), []),
        (("000", "100", "010"), [(1, 2)]),
        (("100", "000", "000"), [(0, 2)]),  # one of the two says so
        (("110", "101", "011"), [(0, 1), (0, 2), (1, 2)]),
    ],
)
def test_tracks_side_by_side_cross_only_where_the_net_calls_them_foes(convert, foes, pairs):
    nodes: Nodes = {"x": (0, 0)}
    edges: Edges = {}
    for y, track in zip((5, 0, -5), "abc", strict=True):
        nodes |= {f"{track}1": (-500, y), f"{track}2": (500, y)}
        edges[f"{track}s"] = f'{track}1 x shape="-500,{y} 0,{y}" spreadType="center"'
        edges[f"{track}e"] = f'x {track}2 shape="0,{y} 500,{y}" spreadType="center"'
    net = convert(nodes, edges, "as>ae bs>be cs>ce")
    words = net.read_text()
    assert words.count('foes="000"') == 3
    lanes = re.search(r'id="x" [^>]*intLanes="([^"]*)"', words)
    assert lanes is not None
    links = [re.search(rf'to="(.e)"[^>]*via="{lane}"', words)[1] for lane in lanes[1].split()]  # type: ignore[index]
    for row in foes:
        words = words.replace('foes="000"', f'foes=" {row}"', 1)
    net.write_text(words.replace('foes=" ', 'foes="'))
    found = {frozenset(to for _, to in pair) for pair in crossings(Rails.read(net))}
    assert found == {frozenset((links[i], links[j])) for i, j in pairs}


def test_tracks_that_only_touch_cross_although_the_net_calls_them_no_foes(convert):
    # Both bend at the node: their centre lines meet, and part again on the side they came from.
    nodes = {"c": (0, 0), "w": (-500, 200), "e": (500, 200), "s": (-500, -200), "n": (500, -200)}
    net = convert(nodes, {"wc": "w c", "ce": "c e", "sc": "s c", "cn": "c n"}, "wc>ce sc>cn", "--junctions.minimal-shape", "--default.spreadtype", "center")  # fmt: skip
    assert set(re.findall(r'foes="(\d+)"', net.read_text())) == {"00"}
    assert crossings(Rails.read(net)) == {frozenset([("wc", "ce"), ("sc", "cn")])}


def test_a_single_track_with_a_passing_loop(convert):
    net = convert(LOOP, LOOP_EDGES, "", "--no-turnarounds")
    rails = Rails.read(net)
    whole(rails)
    assert leads(rails)["west+"] == {"main+", "side+"}
    assert leads(rails)["edis+"] == leads(rails)["main+"] == {"east+"}
    assert leads(rails)["side-"] == {"west-"}
    assert rails.reversal == frozenset()
    for a, b in rails.chains:
        twins = rails.twin[[b, a]]
        assert rails.edges[twins[1]] == rails.edges[a].translate(str.maketrans("+-", "-+"))
        assert names(rails, rails.twin[list(rails.chains[a, b])]) == names(rails, rails.chains[twins[0], twins[1]][::-1])
    # Head on at a switch, over different legs of it; on the same leg it is the same track.
    assert crossings(rails) == {
        frozenset(pair)
        for pair in [
            (("west+", "main+"), ("side-", "west-")), (("west+", "side+"), ("main-", "west-")),
            (("edis+", "east+"), ("east-", "main-")), (("main+", "east+"), ("east-", "edis-")),
        ]
    }  # fmt: skip
    # The loop is longer than the track: one jump for each direction.
    assert len(jumps(rails)) == 2
    agrees(rails, net, ["west+", "side+", "edis+", "east+"])
    agrees(rails, net, ["east-", "main-", "west-"])
    shortest = rails.path(rails.index["west+"], rails.index["east+"])
    assert shortest is not None
    np.testing.assert_array_equal(shortest, rails.way(["west+", "main+", "east+"]))


def test_twins_of_internal_edges_are_found_where_an_old_net_does_not_name_them(convert):
    net = convert(LOOP, LOOP_EDGES, "", "--no-turnarounds")
    named = Rails.read(net)
    words = net.read_text()
    old = re.sub(r'(<edge id=":[^>]*) bidi="[^"]*"', r"\1", words)
    assert old != words
    net.write_text(old)
    np.testing.assert_array_equal(Rails.read(net).twin, named.twin)
    assert (named.twin >= 0).all()


#: How a net of an old version may look -> its version, and what is written otherwise: pattern, replacement, how often.
OLD_NETS: dict[str, tuple[str, list[tuple[str, str, int]]]] = {
    "old": ("0.27", [(' bidi="[^"]*"', "", 0)]),
    "none": ("1.0", [(' bidi="[^"]*"', "", 0)]),
    "new": ("1.1", [(' bidi="[^"]*"', "", 0)]),
    "newest": ("1.20", [(' bidi="[^"]*"', "", 0)]),
    "some named": ("0.27", [(' bidi="[^"]*"', "", 11)]),
    "a hair beside": ("0.27", [(' bidi="[^"]*"', "", 0), (r'(<lane id="main\+_0"[^>]*shape="[^, "]*,[^, "]*)', r"\g<1>0001", 0)]),
    "another height": ("0.27", [(' bidi="[^"]*"', "", 0), (r'(<lane id="main\+_0"[^>]*shape="[^ "]*)', r"\1,1.00", 0)]),
    "height zero": ("0.27", [(' bidi="[^"]*"', "", 0), (r'(<lane id="main\+_0"[^>]*shape="[^ "]*)', r"\1,0.00", 0)]),
}  # fmt: skip


@pytest.mark.parametrize("kind", OLD_NETS)
def test_the_two_directions_of_a_track_are_paired_as_sumo_pairs_them(convert, kind):
    # A second main track on the very same place, a road of two lanes both ways, and one with fewer lanes back.
    edges = {
        **LOOP_EDGES, "again+": LOOP_EDGES["main+"], "again-": LOOP_EDGES["main-"],
        "road+": 'w k numLanes="2" spreadType="center"', "road-": 'k w numLanes="2" spreadType="center"',
        "wide+": 'k e numLanes="2" spreadType="center"', "wide-": 'e k spreadType="center"',
    }  # fmt: skip
    net = convert(LOOP, edges, "", "--no-turnarounds", lane='allow="rail" speed="30"')
    version, changes = OLD_NETS[kind]
    words = re.sub(r'<net version="[^"]*"', f'<net version="{version}"', net.read_text())
    for pattern, replacement, count in changes:
        words, changed = re.subn(pattern, replacement, words, count=count)
        assert changed
    net.write_text(words)
    rails = Rails.read(net)
    libsumo.start(["sumo", "-n", str(net), "--no-step-log", "--no-warnings"])
    try:
        theirs = {e: libsumo.edge.getBidiEdge(e) for e in rails.edges if not rails.internal[rails.index[e]]}
    finally:
        libsumo.close()
    ours = {e: rails.edges[t] if (t := rails.twin[rails.index[e]]) >= 0 else "" for e in theirs}
    assert ours == theirs
    paired = {e for e, twin in theirs.items() if twin}
    apart = {"main+"} if kind in ("a hair beside", "another height") else set()
    if kind != "some named":  # where netconvert names them lane by lane
        everyone = {f"{e}{way}" for e in ("west", "main", "again", "side", "edis", "east", "road") for way in "+-"}
        assert paired == (set() if kind.startswith("new") else everyone - apart)


def test_a_reversal_is_a_connection_to_the_twin_and_no_part_of_the_kilometrage(convert):
    nodes, edges = {"a": (0, 0), "b": (500, 0), "c": (900, 0)}, {"ab": "a b", "bc": "b c", "cb": "c b", "ba": "b a"}
    edges = {e: words + ' spreadType="center"' for e, words in edges.items()}
    rails = Rails.read(convert(nodes, edges, "ab>bc cb>ba bc>cb"))
    whole(rails)
    pairs = {(rails.edges[a], rails.edges[b]) for a, b in rails.reversal}
    assert ("bc", "cb") in pairs
    assert all(rails.twin[a] == b for a, b in rails.reversal)
    assert rails.index["cb"] in rails.after[rails.index["bc"]]
    assert rails.index["cb"] not in rails.onward[rails.index["bc"]]
    assert names(rails, rails.way(["bc", "cb"])) == ["bc", "cb"]
    assert rails.path(rails.index["ab"], rails.index["ba"]) is None
    assert not jumps(rails)
    assert rails.start_m[rails.index["ab"]] == rails.start_m[rails.index["cb"]] == 0.0


def test_a_net_without_internal_edges_leads_on_directly(convert):
    net = convert(FORK, FORK_EDGES, "", "--no-internal-links")
    rails = Rails.read(net)
    whole(rails)
    assert not rails.internal.any()
    assert leads(rails) == {"am": {"ms"}, "bm": {"ms"}, "ms": {"sl", "sr"}, "sl": set(), "sr": set()}
    assert [rails.edges[k] for k in rails.after[rails.index["ms"]]] == ["sl", "sr"]
    assert not jumps(rails)
    agrees(rails, net, ["bm", "ms", "sl"])


def test_a_place_to_wait_on_a_junction_makes_a_chain(convert):
    nodes = {"c": (0, 0), "w": (-300, 0), "e": (300, 0), "s": (0, -300), "n": (0, 300)}
    edges = {e: words for leg in "wesn" for e, words in ((f"{leg}c", f"{leg} c"), (f"c{leg}", f"c {leg}"))}
    net = convert(nodes, edges, "", kind="traffic_light", lane='allow="tram passenger" numLanes="1" speed="14"')
    rails = Rails.read(net)
    whole(rails)
    chain = rails.chains[rails.index["sc"], rails.index["cw"]]
    assert len(chain) == 2
    left, ahead = ("sc", "cw"), ("nc", "cs")
    assert frozenset([left, ahead]) in crossings(rails)
    assert frozenset([left, ("sc", "cn")]) not in crossings(rails)  # they branch
    assert frozenset([left, ("ec", "cw")]) not in crossings(rails)  # they merge
    agrees(rails, net, ["sc", "cw"], vehicle_class="tram")


@pytest.mark.parametrize("option", ["--no-turnarounds", "--no-internal-links"])
def test_roads_are_left_out_and_the_lane_for_trains_counts(convert, tmp_path, option):
    nodes = {"a": (0, 0), "b": (400, 0), "c": (800, 0), "d": (400, 300)}
    edges = {"ab": "a b", "bc": "b c", "bd": "b d"}
    net = convert(nodes, edges, "", lane='numLanes="2" allow="passenger bicycle"')
    with pytest.raises(LineError, match="has no rail edges"):
        Rails.read(net)
    lanes = '<lane index="0" allow="bicycle" speed="5"/><lane index="1" allow="tram bus" speed="15"/>'
    words = (tmp_path / "e.xml").read_text()
    for edge in ("ab", "bc"):
        words = re.sub(rf'(<edge id="{edge}"[^>]*) allow="passenger bicycle" */>', rf"\1>{lanes}</edge>", words)
    (tmp_path / "e.xml").write_text(words)
    program, environment = netconvert()
    command = [str(program), "-n", "n.xml", "-e", "e.xml", option, "-o", "x.net.xml"]
    subprocess.run(command, cwd=tmp_path, env=environment, check=True, capture_output=True)
    assert 'from="ab" to="bd"' in net.read_text()  # for bicycles
    rails = Rails.read(net)
    whole(rails)
    assert leads(rails) == {"ab": {"bc"}, "bc": set()}
    assert rails.speed_mps[:2].tolist() == [15.0, 15.0]
    with pytest.raises(ValueError, match="edge bd: not on this net, or not for trains"):
        rails.way(["ab", "bd"])


def test_a_connection_whose_lane_on_the_junction_is_not_for_trains_is_none(convert):
    net = convert(FORK, FORK_EDGES)
    words = net.read_text()
    for start, to in (("ms", "sr"), ("bm", "ms")):
        via = re.search(rf'from="{start}" to="{to}"[^>]*via="([^"]*)"', words)
        assert via is not None
        words = re.sub(rf'(<lane id="{via[1]}"[^>]*)allow="rail"', r'\1allow="bus"', words)
    net.write_text(words)
    rails = Rails.read(net)
    whole(rails)
    assert leads(rails) == {"am": {"ms"}, "bm": set(), "ms": {"sl"}, "sl": set(), "sr": set()}
    assert rails.internal.sum() == 2


def test_the_slope_is_rise_over_run_and_turns_with_the_direction(convert):
    edges = {
        e + way: f'{" ".join(e[::step])} spreadType="center"' for e in ("ab", "bc", "cd") for way, step in (("+", 1), ("-", -1))
    }
    rails = Rails.read(convert(HILLS, edges, "", "--no-turnarounds", "--junctions.minimal-shape"))
    slope = {e: rails.slope[rails.index[e]] for e in edges}
    assert slope == pytest.approx({"ab+": 0, "ab-": 0, "bc+": 0.01, "bc-": -0.01, "cd+": -0.02, "cd-": 0.02}, abs=1e-9)


@pytest.mark.parametrize("name", ["three_tracks", "single_track", "hilly"])
def test_a_line_of_ours_is_the_same_computed_and_read(tmp_path, name):
    spec = parse_spec(HILLY, "") if name == "hilly" else read_spec(sumo_net.shipped()[name])
    line = Line.of(spec)
    net = build(spec, tmp_path)
    for source in (line, Line.read(net)):
        rails, read = Rails.of(source), Rails.read(net)
        whole(rails)
        assert rails.edges == line.edges
        for field in ("edges", "after", "before", "crossing", "reversal"):
            assert getattr(read, field) == getattr(rails, field), field
        for field in ("internal", "length_m", "speed_mps", "start_m", "twin"):
            np.testing.assert_array_equal(getattr(read, field), getattr(rails, field), field)
        np.testing.assert_allclose(
            read.slope, rails.slope, rtol=0, atol=1e-8
        )  # a crossover over a change of gradient bends in the file
        np.testing.assert_array_equal(rails.start_m, line.start_m)
    assert not jumps(rails)
    assert rails.slope.any() == (name == "hilly")
    for c in line.crossovers[:5]:
        track = line.index[line.route(c.from_track, c.start_m)[0]]
        before = next(k for k in rails.before[track] if k not in (line.index[x.edge] for x in line.crossovers))
        way = rails.way(line.route_over(line.edges[before], c.id))
        assert line.index[c.edge] in rails.after[before]
        assert way.tolist() == [line.index[e] for e in line.route_over(line.edges[before], c.id)]


def test_a_line_of_ours_rebuilt_with_internal_edges_is_a_net_like_any(tmp_path):
    spec = parse_spec(HILLY, "")
    build(spec, tmp_path)
    program, environment = netconvert()
    files = [word for option, kind in (("-n", "nod"), ("-e", "edg"), ("-x", "con")) for word in (option, f"hilly.{kind}.xml")]
    command = [str(program), *files, "-o", "other.net.xml"]
    subprocess.run(command, cwd=tmp_path, env=environment, check=True, capture_output=True)
    rails, line = Rails.read(tmp_path / "other.net.xml"), Line.of(spec)
    whole(rails)
    assert rails.internal.any()
    route = line.route_over("left_250.5", "over")
    assert names(rails, [k for k in rails.way(route) if not rails.internal[k]]) == list(route)
    agrees(rails, tmp_path / "other.net.xml", list(route))


def test_the_railway_that_comes_with_sumo():
    rails = Rails.read(wheel_net())
    whole(rails)
    assert len(rails.edges) == 120 and rails.internal.sum() == 64
    assert (rails.twin >= 0).all()
    assert len(crossings(rails)) == 16  # eight switches, two ways to meet head on at each
    for begin, end in [("-E30.50", "E18"), ("E1", "-E17"), ("E2", "-E18")]:  # the trips that come with it
        way = rails.path(rails.index[begin], rails.index[end])
        assert way is not None
        agrees(rails, wheel_net(), [e for e in names(rails, way) if not e.startswith(":")])


def test_a_way_expands_routes_and_sumo_runs_over_it(tmp_path):
    net = generate(tmp_path, "--grid --grid.number 5 --grid.length 300")
    rails = Rails.read(net)
    whole(rails)
    rng = np.random.default_rng(1)
    for _ in range(6):
        here = int(rng.choice(np.flatnonzero(~rails.internal)))
        route = [here]
        while len(route) < 12:
            ahead = [b for a, b in rails.chains if a == route[-1]]
            route.append(int(rng.choice(ahead)))
        ids = names(rails, route)
        way = rails.way(ids)
        assert all(b in rails.after[a] for a, b in pairwise(way.tolist()))
        assert names(rails, way[~rails.internal[way]]) == ids
        agrees(rails, net, ids)


def test_the_shortest_path_is_that_of_all_pairs(tmp_path):
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    rails = Rails.read(generate(tmp_path, "--rand --rand.iterations 60 --seed 3"))
    links = np.array([(a, b) for a, row in enumerate(rails.after) for b in row])
    cost = dijkstra(csr_array((rails.length_m[links[:, 1]], links.T), shape=(len(rails.edges),) * 2))
    for a, b in np.random.default_rng(2).integers(0, len(rails.edges), (200, 2)).tolist():
        way = rails.path(a, b)
        assert (way is None) == np.isinf(cost[a, b])
        if way is not None:
            assert (way[0], way[-1]) == (a, b)
            assert all(later in rails.after[first] for first, later in pairwise(way.tolist()))
            assert rails.length_m[way[1:]].sum() == pytest.approx(cost[a, b])
    assert rails.path(3, 3).tolist() == [3]


@pytest.mark.parametrize(
    ("route", "why"),
    [
        ([], "the route has no edges"),
        (["am", "nowhere"], "edge nowhere: not on this net, or not for trains"),
        (["am", ":m_0", "ms"], "edge :m_0: not on this net, or not for trains"),
        (["am", "sl"], "the route is not connected from edge am to edge sl"),
        (["am", "ms", "am"], "the route is not connected from edge ms to edge am"),
        (["am", "am"], "the route is not connected from edge am to edge am"),
    ],
)
def test_a_route_that_is_none_is_said_in_words(convert, route, why):
    rails = Rails.read(convert(FORK, FORK_EDGES))
    with pytest.raises(ValueError, match=re.escape(why)):
        rails.way(route)


EDGE = '<edge id="e"><lane id="e_0" allow="rail" length="5" speed="9" shape="0,0 5,0"/></edge>'


@pytest.mark.parametrize(
    ("content", "why"),
    [
        *NO_NETS,
        (f"<net>{EDGE.replace('length', 'long')}</net>", "edge e: has no length"),
        (f"<net>{EDGE.replace('speed', 'fast')}</net>", "edge e: has no speed"),
        (f"<net>{EDGE.replace('shape', 'form')}</net>", "edge e: has no shape"),
        (f"<net>{EDGE.replace('0,0 ', '')}</net>", "edge e: shape = '5,0': two points at least"),
        (f"<net>{EDGE.replace('5,0', '5')}</net>", "edge e: shape = '0,0 5': two points at least"),
        (f"<net>{EDGE.replace('9', '-9')}</net>", "edge e: length = 5, speed = -9: must be positive"),
        (f"<net>{EDGE.replace('9', 'nan')}</net>", "edge e: length = 5, speed = nan: must be positive"),
        (f"<net>{EDGE.replace('9', 'x')}</net>", "edge e: could not convert string to float: 'x'"),
    ],
)
def test_a_file_that_is_no_rail_net_is_one_clear_line(tmp_path, content, why):
    assert refused(Rails.read, tmp_path / "x.net.xml", content).startswith(why)


def test_every_mistake_is_named_at_once(convert):
    net = convert(DIAMOND, DIAMOND_EDGES, "wc>ce sc>cn")
    words = net.read_text()
    net.write_text(re.sub(r'(<lane id="(?:wc|cn)_0"[^>]*) length="[^"]*"', r"\1", words))
    with pytest.raises(LineError) as caught:
        Rails.read(net)
    assert [m.removeprefix(f"{net}: ") for m in caught.value.mistakes] == ["edge cn: has no length", "edge wc: has no length"]
    net.write_text(words.replace('foes="10"', 'fees="10"'))
    with pytest.raises(LineError, match="junction c: its requests cannot be read"):
        Rails.read(net)


def test_an_internal_edge_belongs_to_one_connection(convert):
    net = convert(DIAMOND, DIAMOND_EDGES, "wc>ce sc>cn")
    net.write_text(net.read_text().replace('via=":c_1_0"', 'via=":c_0_0"'))
    with pytest.raises(LineError, match="edge :c_0: lies on 2 connections between different edges"):
        Rails.read(net)


def test_a_chain_that_bites_its_tail_ends(convert):
    net = convert(DIAMOND, DIAMOND_EDGES, "wc>ce sc>cn")
    words = net.read_text()
    net.write_text(words.replace('<connection from=":c_0" ', '<connection from=":c_0" via=":c_0_0" '))
    assert net.read_text() != words
    assert Rails.read(net).chains == {(3, 0): (5,), (2, 1): (4,)}


def test_whatever_is_broken_in_a_net_it_is_read_or_refused_in_words(convert):
    whole_words = convert(DIAMOND, DIAMOND_EDGES, "wc>ce sc>cn").read_text()
    net = convert(DIAMOND, DIAMOND_EDGES)
    rng = np.random.default_rng(5)
    values = ["", "x", "-1", "nan", "1e400", "0", "0,0", "rail", ":c_0", ":c_0_0", "internal", "wc", "1"]
    outcome = {True: 0, False: 0}
    for _ in range(400):
        words = whole_words
        for _ in range(rng.integers(1, 6)):
            spots = list(re.finditer(r' \w+="([^"]*)"', words))
            spot = spots[rng.integers(len(spots))]
            if rng.random() < 0.4:
                words = words[: spot.start()] + words[spot.end() :]
            else:
                words = words[: spot.start(1)] + values[rng.integers(len(values))] + words[spot.end(1) :]
        net.write_text(words)
        try:
            rails = Rails.read(net)
            assert len(rails.start_m) == len(rails.edges) == len(rails.onward)
            assert rails.chains.keys() >= rails.reversal
            outcome[True] += 1
        except LineError as error:
            assert error.mistakes
            outcome[False] += 1
    assert min(outcome.values()) > 40


def test_the_kilometrage_runs_on_wherever_one_exists():
    """Any graph whose lengths come from places on a line has it, and every part of it begins at 0."""
    rng = np.random.default_rng(4)
    for _ in range(50):
        place = rng.uniform(0, 1e5, 30)
        ends = np.sort(place[rng.integers(0, 30, (40, 2))], axis=1)
        ends = ends[ends[:, 0] < ends[:, 1]]
        length = ends[:, 1] - ends[:, 0]
        onward = [tuple(np.flatnonzero(ends[:, 0] == end).tolist()) for end in ends[:, 1]]
        start = potential(length, onward)
        assert all(abs(start[a] + length[a] - start[b]) < 1e-9 for a, row in enumerate(onward) for b in row)
        part = np.arange(len(ends))
        for _ in range(len(ends)):
            for a, row in enumerate(onward):
                for b in row:
                    part[[a, b]] = min(part[a], part[b])
        assert all(start[part == p].min() == 0.0 for p in set(part.tolist()))


def test_the_time_of_reading_grows_with_the_edges_not_with_their_pairs(tmp_path):
    def line(name, length_m):
        spec = {"name": name, "tracks": ["a", "b", "c"], "length_m": length_m, "max_edge_m": 1000.0, "speed": [[0.0, 80.0]]}
        return build(parse_spec(spec, ""), tmp_path)

    def grid(number):
        (tmp_path / str(number)).mkdir()
        return generate(tmp_path / str(number), f"--grid --grid.number {number} --grid.length 300")

    def took(net):
        times = []
        for _ in range(2):
            began = time.process_time()
            edges = len(Rails.read(net).edges)
            times.append(time.process_time() - began)
        return edges, min(times)

    for nets in ((line("short", 0.85e6), line("long", 3.4e6)), (grid(7), grid(14))):
        (few, less), (many, more) = map(took, nets)
        assert 3.5 < many / few < 5.0
        assert more < 2.5 * many / few * less  # four times the edges; with their pairs it were 16 times the time
    assert many > 2500
