"""Whose turn it is: nobody waits for ever to enter, a train at its platform holds no track beyond, and no circles on single track."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import nets
import pytest
import tomli_w

from trainctl.runner import Backend, run
from trainctl.runs.run import Run
from trainctl.scenario.build import open_scenario


def ran(folder: Path, duration: float, backend: Backend, length: float = 100.0, order: Sequence[Any] = ()) -> Run:
    made = nets.scenario("robust_constrained", duration, traffic={"cooperate": []}) | ({"order": list(order)} if order else {})
    made["train_type"]["emu"] = {**made["train_type"]["emu"], "unit_length_m": length}
    (folder / "s.toml").write_text(tomli_w.dumps(made))
    return run(open_scenario(str(folder / "s.toml")), folder / f"out_{backend}_{duration:g}_{len(order)}", backend)


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


def kind_of_net(folder: Path, kind: str) -> None:
    """Two trains of 200 m each way over 4 km, due at once: where simple rules of others let them lock each other."""
    siding = {"siding": 500.0, "moving block": 500.0, "short siding": 150.0}.get(kind)
    ends = {"a": (0.0, 0.0), "b": (4000.0, 0.0), "a2": (0.0, -60.0), "b2": (4000.0, -60.0)}
    if siding is not None:  # single track with two tracks in the middle
        x, y = 2000.0 - siding / 2.0, 2000.0 + siding / 2.0
        nodes = ends | {"m": (x, 0.0), "n": (y, 0.0)}
        tracks = {
            name: (*between, {"shape": f"{u},0 2000,{side} {v},0"})
            for name, between, u, v, side in (("up", ("m", "n"), x, y, 10), ("down", ("n", "m"), y, x, -10))
        }
        edges = {**nets.both_ways("l", "a", "m"), **nets.both_ways("r", "n", "b"), **tracks}
        ways = ("l up r", "-r down -l")
    else:  # a station of two tracks at each end, and one or two tracks between
        nodes = ends | {"m": (1200.0, 0.0), "n": (2800.0, 0.0)}
        edges = {"in": ("a", "m"), "out": ("n", "b"), "in2": ("b2", "n"), "out2": ("m", "a2")}
        if kind == "one way":
            edges |= nets.both_ways("s", "m", "n")
        else:
            edges |= {"s": ("m", "n", {"shape": "1200,0 2000,10 2800,0"}), "-s": ("n", "m", {"shape": "2800,0 2000,-10 1200,0"})}
        ways = ("in s out", "in2 -s out2")
    nets.net(folder, nodes, edges)
    body = "".join(nets.train(f"{way}{n}", ways[way], 0, departPos=250) for way in (0, 1) for n in (1, 2))
    nets.traffic(folder, body, f'<vType id="emu" vClass="rail" length="200" maxSpeed="{5 if kind == "moving block" else 20}"/>')


@pytest.mark.parametrize("kind", ["one way", "two ways", "siding", "moving block", "short siding"])
def test_no_trains_lock_each_other_in_any_kind_of_net(tmp_path, kind):
    kind_of_net(tmp_path, kind)
    found = ran(tmp_path, 3600 if kind == "moving block" else 1400, "numeric", 200.0)
    assert len(at(found, "arrive")) == 4 and found.ok
    assert not [e for e in found.events if e["kind"] in ("violation", "gridlock", "waiting")]


ORDER = [{"edge": "main", "trains": ["s.0", "s.1", "w.0"]}, {"edge": "main", "trains": ["w.0", "s.2"]}]


@pytest.mark.parametrize("backend", ["numeric", "sumo"])
def test_trains_pass_an_edge_in_the_order_of_the_scenario(tmp_path, backend):
    """Against first come, first served, by which the first from the west would pass first."""
    nets.branches(tmp_path, number=3, period=60.0)
    passed = {}
    for name, orders in (("free", []), ("ordered", ORDER)):
        found = ran(tmp_path, 700, backend, order=orders)
        rows = found.trains[found.trains.edge.astype(str) == "main"].astype({"train": str})
        passed[name] = list(rows.groupby("train").time_s.min().sort_values().index)
        assert not [e for e in found.events if e["kind"] in ("violation", "gridlock")]
    assert passed["free"][0] == "w.0"
    assert passed["ordered"].index("s.0") < passed["ordered"].index("s.1") < passed["ordered"].index("w.0")
    assert passed["ordered"].index("w.0") < passed["ordered"].index("s.2") and len(passed["ordered"]) == 6


def test_an_order_on_single_track_is_kept_in_both_directions(tmp_path):
    """The one that goes first comes later, the other way: the other lets it pass in the loop."""
    nets.single_track(tmp_path, nets.train("up", nets.UP, 0) + nets.train("down", nets.DOWN, 300))
    free = at(ran(tmp_path, 1500, "numeric"), "arrive")
    assert free["up"] < free["down"]
    found = ran(tmp_path, 1500, "numeric", order=[{"edge": "middle", "trains": ["down", "up"]}])
    assert set(at(found, "arrive")) == {"up", "down"}
    rows = found.trains.astype({"train": str, "edge": str})
    passing = {name: rows[(rows.train == name) & rows.edge.isin(["middle", "-middle"])].time_s for name in free}
    assert passing["down"].max() < passing["up"].min()


@pytest.mark.parametrize(("length", "code"), [(1900.0, 0), (2100.0, 2)])
def test_orders_by_which_trains_meet_at_a_loop_that_is_too_short_have_no_solution(tmp_path, typed, length, code):
    """The one going up is to be first before the loop, the other one behind it: 2000 m, of which each needs its length and 30 m."""
    nets.single_track(tmp_path / "n", nets.train("up", "left up1 middle", 0) + nets.train("down", "-middle down1 -left", 0))
    made = nets.scenario("robust_constrained", 2000, traffic={"cooperate": []})
    made["train_type"]["emu"]["unit_length_m"] = length
    made["order"] = [{"edge": "left", "trains": ["up", "down"]}, {"edge": "middle", "trains": ["down", "up"]}]
    (tmp_path / "n" / "s.toml").write_text(tomli_w.dumps(made))
    said = typed("check", tmp_path / "n" / "s.toml")
    assert said[0] == code
    if code:
        assert said[1] == ["s.toml: order: no solution: up, down can never all get out if the orders are kept"]
        made["event"] = [{"kind": "reroute", "train": "up", "time_s": 100.0, "to_edge": "middle"}]
        (tmp_path / "n" / "s.toml").write_text(tomli_w.dumps(made))
        assert typed("check", tmp_path / "n" / "s.toml")[0] == 0
        notes = open_scenario(str(tmp_path / "n" / "s.toml")).roster.notes
        assert any("orders say is not decided: trains may be led another way" in note for note in notes)
        return
    found = run(open_scenario(str(tmp_path / "n" / "s.toml")), tmp_path / "out", "numeric")
    assert set(at(found, "arrive")) == {"up", "down"} and found.ok


def test_a_train_longer_than_its_loop_is_refused(tmp_path, typed):
    loop = {"t": (9000, 0), "u": (9300, 400), "v": (9300, -400)}
    edges = {**nets.both_ways("s", "a", "t"), "tu": ("t", "u"), "uv": ("u", "v"), "vt": ("v", "t")}
    nets.net(tmp_path / "n", {"a": (0, 0), **loop}, edges)
    nets.traffic(tmp_path / "n", nets.train("v", "s tu uv vt -s", 0))
    made = nets.scenario("robust_constrained", 900, traffic={"cooperate": []})
    for length, code in ((1500.0, 0), (2100.0, 2)):
        made["train_type"]["emu"]["unit_length_m"] = length
        (tmp_path / "n" / "s.toml").write_text(tomli_w.dumps(made))
        said = typed("check", tmp_path / "n" / "s.toml")
        assert said[0] == code and (not code or "train v: 2100 m long, meets itself on edge" in said[1][0])


@pytest.mark.parametrize(
    ("orders", "told"),
    [
        ([("main", ["w.0", "nobody"])], ["order[1].trains: nobody: no such train"]),
        ([("south", ["w.0", "s.0"])], ["order[1].trains: w.0: does not run over edge south"]),
        ([("main", ["w.1", "w.0"])], ["order[1]: w.1 before w.0 on edge main: w.0 enters first, over edge west"]),
        ([("main", ["w.0", "s.0"]), ("main", ["s.0", "w.0"])],
         ["order[2]: s.0 before w.0 on edge main: order[1] has w.0 before s.0, and they cannot change places"]),
        ([("nowhere", ["w.0", "s.0"])], ["w.0: does not run over edge nowhere", "s.0: does not run over edge nowhere"]),
    ],
)  # fmt: skip
def test_orders_that_contradict_each_other_or_the_routes_are_refused(tmp_path, typed, orders, told):
    nets.branches(tmp_path / "n")
    made = nets.scenario("robust_constrained", 500, traffic={"cooperate": []})
    made["order"] = [{"edge": edge, "trains": trains} for edge, trains in orders]
    (tmp_path / "n" / "s.toml").write_text(tomli_w.dumps(made))
    code, lines = typed("check", tmp_path / "n" / "s.toml")[:2]
    assert code == 2
    assert len(lines) >= len(told) and all(any(part in line for line in lines) for part in told), lines
