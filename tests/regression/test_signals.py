"""Rail signals obeyed by our trains, alone and beside trains of SUMO's own; the same files in plain SUMO are the measure."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import nets
import pytest
import tomli_w
from beside import OPEN, plain

from trainctl.errors import InputError
from trainctl.runner import opened, resume, run
from trainctl.runs.run import Run
from trainctl.scenario.build import open_scenario
from trainctl.sumo.signal_box import Box

#: What must never be told of trains that obey.
AMISS = ("violation", "red_passed", "green_withdrawn", "gridlock", "sumo_warning", "not_entered")


def ran(folder: Path, duration: float, order: list[Any] | None = None, out: str = "out", **driving: Any) -> Run:
    made = nets.scenario("robust_constrained", duration, traffic={"cooperate": [], **driving})
    made |= {"order": order} if order else {}
    (folder / "s.toml").write_text(tomli_w.dumps(made))
    return run(open_scenario(str(folder / "s.toml")), folder / out, force=True)


def at(found: Run, kind: str) -> dict[str, float]:
    """When each train had its first event of a kind [s]."""
    return {e["train"]: e["time_s"] for e in reversed(found.events) if e["kind"] == kind}


def order_of(times: dict[str, float]) -> list[str]:
    return sorted(times, key=lambda name: times[name])


def amiss(found: Run) -> list[dict[str, Any]]:
    return [e for e in found.events if e["kind"] in AMISS]


def also(folder: Path, additional: str, options: str = "") -> None:
    """Give the configuration of a folder an additional file, and options."""
    (folder / "b.add.xml").write_text(f"<additional>{additional}</additional>")
    path = folder / "a.sumocfg"
    path.write_text(path.read_text().replace(OPEN, f'{OPEN}<additional-files value="b.add.xml"/>{options}'))


def join(folder: Path, body: str, signals: str = "wsmx") -> None:
    """Two lines that merge, with a signal wherever tracks meet or part and between."""
    net = {
        "west0": ("w0", "w"), "west": ("w", "m"), "south0": ("s0", "s"), "south": ("s", "m"), "main": ("m", "x"), "east": ("x", "e"),
    }  # fmt: skip
    places = {"w0": (-3000, 0), "w": (0, 0), "s0": (-3000, -3000), "s": (0, -3000), "m": (4000, 0), "x": (6000, 0), "e": (12000, 0)}
    nets.net(folder, places, net, signals=signals)
    nets.traffic(folder, body)


WEST, SOUTH = "west0 west main east", "south0 south main east"
PARKED = '<stop lane="west_0" endPos="1500" duration="10" parking="true"/>'


def constraint(signal: str, kind: str, train: str, at: str, foe: str) -> str:
    inside = f'<{kind} tripId="{train}" tl="{at}" foes="{foe}"/>'
    return f'<railSignalConstraints id="{signal}">{inside}</railSignalConstraints>'


def test_trains_that_obey_pass_a_join_one_after_the_other_and_are_told_why_they_wait(tmp_path):
    join(tmp_path, nets.flow("w", WEST, 3, 60) + nets.flow("s", SOUTH, 3, 60, 30))
    found = ran(tmp_path, 1700, signals="obey")
    assert len(at(found, "arrive")) == 6 and not amiss(found) and found.ok
    held = [e for e in found.events if e["kind"] == "signal"]
    assert held and all(e["other"] not in (None, e["train"]) and e["signal"] in "wsmx" for e in held)
    rows = found.trains.astype({"train": str, "edge": str})
    on = rows[rows.edge == "main"].groupby("time_s").train.nunique()
    assert on.max() == 1  # one train between two signals


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (nets.train("a", WEST, 0) + nets.train("b", SOUTH, 60), constraint("m", "predecessor", "a", "m", "b")),
        (nets.train("a", WEST, 0) + nets.train("b", SOUTH, 60), constraint("w", "predecessor", "a", "x", "b")),
        (nets.train("a", WEST, 0) + nets.train("b", SOUTH, 60), constraint("w", "insertionPredecessor", "a", "s", "b")),
        (nets.train("a", WEST, 0) + nets.train("b", SOUTH, 60), constraint("w", "insertionOrder", "a", "s", "b")),
        (nets.train("a", WEST, 0) + nets.train("b", WEST, 60), constraint("w", "insertionPredecessor", "a", "w", "b")),
        (nets.train("a", WEST, 0) + nets.train("b", WEST, 60), constraint("w", "insertionOrder", "a", "w", "b")),
        (nets.train("a", WEST, 0, PARKED) + nets.train("b", SOUTH, 200), constraint("m", "insertionPredecessor", "a", "m", "b")),
        (nets.train("a", WEST, 0) + nets.train("b", SOUTH, 200), constraint("m", "foeInsertion", "a", "s", "b")),
        (nets.train("a", WEST, 0, "<param key='tripId' value='first'/>") + nets.train("b", SOUTH, 60),
         constraint("m", "predecessor", "first", "m", "b")),
        (nets.train("up", nets.UP, 0) + nets.train("down", nets.DOWN, 100), constraint("2", "predecessor", "up", "3", "down")),
        (nets.train("up", nets.UP, 0) + nets.train("down", nets.DOWN, 100), constraint("2", "bidiPredecessor", "up", "3", "down")),
    ],
    ids=["predecessor", "far", "insertionPredecessor", "insertionOrder", "same_edge", "order_on_same_edge", "parked",
         "foeInsertion", "trip", "single_track", "bidiPredecessor"],
)  # fmt: skip
def test_constraints_are_kept_as_in_plain_sumo(tmp_path, body, said):
    if "west0" in body:
        join(tmp_path, body)
    else:
        nets.single_track(tmp_path, body, signals="1234")
    free = {row["id"]: float(row["arrival"]) for row in plain(tmp_path, "tripinfo")}
    also(tmp_path, said, '<processing><eager-insert value="true"/></processing>')
    theirs = {row["id"]: float(row["arrival"]) for row in plain(tmp_path, "tripinfo")}
    found = ran(tmp_path, 1150, signals="obey")
    assert order_of(at(found, "arrive")) == order_of(theirs) and len(theirs) == 2 and not amiss(found)
    if "foeInsertion" in said:  # it waits until the other one has come
        assert theirs["a"] > free["a"] + 60.0 and passed(found, "a", "main") > at(found, "depart")["b"] > 199.0
    else:
        assert order_of(theirs) != order_of(free)


def passed(found: Run, train: str, edge: str) -> float:
    """When a train came to an edge [s]."""
    rows = found.trains.astype({"train": str, "edge": str})
    return float(rows[(rows.train == train) & (rows.edge == edge)].time_s.min())


def test_orders_of_the_scenario_are_handed_to_the_signals(tmp_path):
    join(tmp_path, nets.train("a", WEST, 0) + nets.train("b", SOUTH, 60) + nets.train("c", WEST, 120))
    free = ran(tmp_path, 1500, signals="obey")
    assert order_of(at(free, "arrive"))[0] == "a"
    found = ran(tmp_path, 1500, [{"edge": "main", "trains": ["b", "a"]}], signals="obey")
    assert order_of(at(found, "arrive")) == ["b", "a", "c"] and not amiss(found)
    with pytest.raises(InputError, match=r"order\[1\].trains: d: no rail signal on its route before edge main"):
        join(tmp_path, nets.train("a", WEST, 0) + nets.train("d", "main east", 60, departPos=200))
        ran(tmp_path, 1500, [{"edge": "main", "trains": ["d", "a"]}], signals="obey")


def test_a_train_at_its_platform_asks_for_no_signal(tmp_path):
    """It stands before the single track for 400 s; one that comes the other way meanwhile has it."""
    halt = '<stop lane="up1_0" endPos="1990" duration="400"/>'
    arrived = {}
    for name, body in (("alone", ""), ("both", nets.train("up", nets.UP, 0, halt))):
        (tmp_path / name).mkdir()
        nets.single_track(tmp_path / name, body + nets.train("down", nets.DOWN, 200), signals="1234")
        found = ran(tmp_path / name, 1400, signals="obey")
        arrived[name] = at(found, "arrive")
        assert not amiss(found)
    assert abs(arrived["both"]["down"] - arrived["alone"]["down"]) < 5.0
    assert at(found, "stop_left")["up"] - at(found, "stop_reached")["up"] == 400.0


def line(folder: Path, trains: int, ours: int, spacing: float = 100.0) -> list[str]:
    """Trains of SUMO's Rail model on a line with a signal every 2 km and a station; every so many-th is ours: which."""
    nodes = {f"n{k}": (2000.0 * k, 0.0) for k in range(9)}
    edges = {f"e{k}": (f"n{k}", f"n{k + 1}") for k in range(8)}
    nets.net(folder, nodes, edges, signals=[f"n{k}" for k in range(1, 8)])
    kind = '<vType id="rail" vClass="rail" carFollowModel="Rail" trainType="RB425" maxSpeed="40"/>'
    stop = '<stop lane="e4_0" endPos="1900" duration="30"/>'
    names = [f"{'ours' if k % ours == ours - 1 else 'sumo'}.{k}" for k in range(trains)]
    body = "".join(nets.train(name, " ".join(edges), spacing * k, stop, type="rail") for k, name in enumerate(names))
    nets.traffic(folder, body, kind)
    return [name for name in names if name.startswith("ours")]


def test_a_line_with_a_third_of_our_trains_on_it(tmp_path):
    """Nobody touches anybody, all arrive, and trains of SUMO's ahead of all of ours move as in plain SUMO."""
    ours = line(tmp_path, 10, 3)
    made = {"cooperate": ["ours.*"], "others": "sumo"}
    (tmp_path / "s.toml").write_text(
        tomli_w.dumps(nets.scenario("robust_constrained", 2400, types=(), traffic=made, plant={"input_lower_mps2": -0.9}))
    )
    p = open_scenario(str(tmp_path / "s.toml"))
    assert p.roster.driven.sum() == 7 and p.obeys and p.scenario.traffic.signals == "obey"
    assert any("traffic.signals = obey: chosen since SUMO drives 7 of 10 trains" in note for note in p.roster.notes)
    found = run(p, tmp_path / "out")
    assert len(at(found, "arrive")) == 10 and not amiss(found) and found.ok
    assert {e["train"] for e in found.events if e["kind"] == "stop_reached"} == set(p.scenario.ids)
    plain(tmp_path, "fcd", "--precision", "9")
    rows = found.trains.astype({"train": str, "edge": str})
    positions = fcd(tmp_path / "plain.xml")
    ahead = [name for name in p.scenario.ids if int(name.split(".")[1]) < int(ours[0].split(".")[1])]
    assert ahead == ["sumo.0", "sumo.1"]
    begin = dict(zip(p.rails.edges, p.rails.start_m.tolist(), strict=True))
    for name in ahead:
        mine = rows[rows.train == name].set_index("time_s").position_m
        theirs = {t: begin[edge] + place for t, (edge, place) in positions[name].items()}
        assert len(mine) > 400 and set(mine.index) == set(theirs)
        assert max(abs(float(x) - theirs[t]) for t, x in mine.items()) < 1e-6
    inputs = rows.assign(theirs=~rows.train.isin(ours)).groupby("theirs").input_mps2
    assert inputs.count()[True] == 0 and inputs.count()[False] > 0  # what moves them nobody tells us


def fcd(path: Path) -> dict[str, dict[float, tuple[str, float]]]:
    """Edge and place on it [m] by train and time, of an FCD log."""
    return {
        name: {
            float(step.get("time", "nan")): (v.get("lane", "").rpartition("_")[0], float(v.get("pos", "nan"))) for step, v in rows
        }
        for name, rows in _rows(path).items()
    }


def _rows(path: Path) -> dict[str, list[tuple[Element, Element]]]:
    found: dict[str, list[tuple[Element, Element]]] = {}
    for step in ElementTree.parse(path).getroot():
        for vehicle in step:
            found.setdefault(vehicle.get("id", ""), []).append((step, vehicle))
    return found


#: SUMO's ICE3 as one unit: its forces fitted to the table, with brakes that surely give its 0.5 m/s2.
ICE3 = {
    "unit_length_m": 200.0, "unit_mass_kg": 420e3, "rotating_mass_factor": 1.04, "c0_n_per_kg": 7.414 / 420, "c1_ns_per_m_kg": 0.05191 / 420,
    "c2_ns2_per_m2_kg": 0.008664 / 420, "traction_n": 292e3, "traction_power_w": 7827.71e3, "braking_n": 0.51 * 420e3 * 1.04,
}  # fmt: skip


def test_the_undisturbed_headway_of_fixed_block_is_that_of_sumo(tmp_path):
    """Pairs of trains closer and closer: how close a follower may be that no red slows down, with SUMO's own forces and braking."""
    nodes = {f"n{k}": (2000.0 * k + (2000.0 if k else 0.0), 0.0) for k in range(6)}
    edges = {f"e{k}": (f"n{k}", f"n{k + 1}", {"speed": 50}) for k in range(5)}
    nets.net(tmp_path, nodes, edges, signals=[f"n{k}" for k in range(1, 5)])
    headways = (87, 89, 90, 91, 92, 93, 94)
    way = " ".join(edges)
    body = "".join(nets.train(f"a{h}", way, 500 * k) + nets.train(f"b{h}", way, 500 * k + h) for k, h in enumerate(headways))
    nets.traffic(tmp_path, body, '<vType id="emu" vClass="rail" carFollowModel="Rail" trainType="ICE3" maxSpeed="50"/>')
    duration = 500 * len(headways) + 100
    bounds = {"speed_upper_mps": 60.0, "input_lower_mps2": -0.5, "input_upper_mps2": 0.3}
    made = nets.scenario(
        "robust_constrained", duration, (), reference={"speed_mps": 50.0}, bounds=bounds, train_type={"emu": ICE3},
        supervisor={"margin_m": 0.0, "emergency_mps2": 0.5, "service_mps2": 0.5},
        traffic={"signals": "obey", "cooperate": [], "acceleration_mps2": 1.0, "deceleration_mps2": 0.5, "below_limit_mps": 0.0},
    )  # fmt: skip
    made["plant"] = {"kind": "coupled_units"}
    theirs = {key: made[key] for key in ("schema_version", "title", "run", "network", "reference", "topology")}
    free = {}
    for name, scenario in (("ours", made), ("sumo", {**theirs, "controller": {"law": "sumo"}})):
        (tmp_path / f"{name}.toml").write_text(tomli_w.dumps(scenario))
        found = run(open_scenario(str(tmp_path / f"{name}.toml")), tmp_path / name)
        left, came = at(found, "arrive"), at(found, "depart")
        late = {h: left[f"b{h}"] - came[f"b{h}"] - (left[f"a{h}"] - came[f"a{h}"]) for h in headways}
        assert late[headways[0]] > 0.0 and late[headways[-1]] == 0.0
        free[name] = min(h for h in headways if late[h] == 0.0)
    assert abs(free["ours"] - free["sumo"]) <= 2, free


@pytest.mark.parametrize("others", ["driven", "sumo"])
def test_a_run_with_signals_resumes_to_the_byte(tmp_path, others):
    join(tmp_path, nets.flow("w", WEST, 2, 60) + nets.flow("s", SOUTH, 2, 60, 30))
    made = nets.scenario("robust_constrained", 600, traffic={"cooperate": ["w.*"], "others": others, "signals": "obey"})
    (tmp_path / "s.toml").write_text(tomli_w.dumps(made))
    p = open_scenario(str(tmp_path / "s.toml"))
    whole = run(p, tmp_path / "whole")

    with pytest.raises(ConnectionError), opened(p, tmp_path / "cut", checkpoint_every_s=100.0) as simulation:
        for _ in range(450):
            simulation.step()
        raise ConnectionError
    again, since = resume(tmp_path / "cut")
    assert since == 400.0
    for name in ("trains.parquet", "events.jsonl", "metrics.json"):
        assert (whole.folder / name).read_bytes() == (again.folder / name).read_bytes(), name


@pytest.mark.parametrize(
    ("signals", "driving", "told"),
    [
        ("wsmx", {"signals": "stop"}, ["traffic.signals = stop: "]),
        (
            "",
            {"signals": "obey"},
            ["there is no rail signal before edge main for train a and 1 more", "the net has no rail signals"],
        ),
        ("", {"others": "sumo"}, ["traffic.others = sumo: there is no rail signal before edge main for train a and 1 more"]),
        ("wx", {"others": "sumo"}, ["there is no rail signal before edge main for train b"]),
        ("wsmx", {"signals": "obey", "constraint": "q"}, ["railSignalConstraints q: no such rail signal"]),
        ("wsmx", {"others": "sumo", "signals": "ignore"}, ['traffic.signals = ignore: not with others = "sumo"']),
    ],
)
def test_what_signals_cannot_decide_is_refused(tmp_path, typed, signals, driving, told):
    join(tmp_path / "n", nets.train("a", WEST, 0) + nets.train("b", SOUTH, 60), signals)
    if "constraint" in driving:
        also(tmp_path / "n", constraint(driving["constraint"], "predecessor", "a", "m", "b"))
    keys = {key: value for key, value in driving.items() if key != "constraint"}
    made = nets.scenario("robust_constrained", 500, traffic={"cooperate": ["a"], **keys})
    (tmp_path / "n" / "s.toml").write_text(tomli_w.dumps(made))
    code, lines = typed("check", tmp_path / "n" / "s.toml")[:2]
    assert code == 2
    assert len(lines) == len(told) and all(part in line for part, line in zip(told, lines, strict=True)), lines


@pytest.mark.parametrize("moving", [False, True])
def test_a_formation_holds_together_past_signals_with_moving_block_and_else_it_is_told(tmp_path, moving):
    nodes = {f"n{k}": (3000.0 * k, 0.0) for k in range(6)}
    nets.net(tmp_path, nodes, {f"e{k}": (f"n{k}", f"n{k + 1}") for k in range(5)}, signals=[f"n{k}" for k in range(1, 5)])
    nets.traffic(tmp_path, nets.flow("a", " ".join(f"e{k}" for k in range(5)), 2, 40))
    also(tmp_path, "", '<processing><railsignal-moving-block value="true"/></processing>' if moving else "")
    found = ran(tmp_path, 420, signals="obey", cooperate=["*"])
    rows = (
        found.trains[(found.trains.time_s > 200.0)]
        .astype({"train": str})
        .pivot(index="time_s", columns="train", values="position_m")
    )
    assert bool((rows["a.0"] - rows["a.1"]).max() < 1700.0) is moving
    told = [note for note in open_scenario(str(tmp_path / "s.toml")).roster.notes if "draws formations of the 2 trains" in note]
    assert len(told) == (0 if moving else 1)
    assert not amiss(found)


@pytest.mark.parametrize("internal", [True, False])
@pytest.mark.parametrize("moving", ["true", "false"])
def test_it_is_told_where_signals_of_moving_block_keep_nobody_apart_at_joins(tmp_path, internal, moving):
    places = {"w": (-3000, 0), "s": (-3000, -900), "m": (0, 0), "x": (2000, 0), "e": (6000, 0)}
    tracks = {"wm": ("w", "m"), "sm": ("s", "m"), "mx": ("m", "x"), "xe": ("x", "e")}
    nets.net(tmp_path, places, tracks, *([] if internal else ["--no-internal-links"]), signals="mx")
    nets.traffic(tmp_path, nets.train("a", "wm mx xe", 0) + nets.train("b", "sm mx xe", 0))
    also(tmp_path, "", f'<processing><railsignal-moving-block value="{moving}"/></processing>')
    made = nets.scenario("robust_constrained", 100, traffic={"cooperate": [], "signals": "obey"})
    (tmp_path / "s.toml").write_text(tomli_w.dumps(made))
    told = [note for note in open_scenario(str(tmp_path / "s.toml")).roster.notes if "past a join at once" in note]
    assert len(told) == (moving == "true" and not internal)


@pytest.mark.parametrize(("signals", "taken"), [("wsmx", True), ("sm", False)])
def test_no_train_is_rerouted_to_where_no_signal_would_hold_it(tmp_path, signals, taken):
    """A second way leaves at w and joins at x: only a signal at w holds trains before that."""
    net = {
        "west0": ("w0", "w"), "west": ("w", "m"), "south0": ("s0", "s"), "south": ("s", "m"), "main": ("m", "x"), "east": ("x", "e"),
        "over": ("w", "y"), "back": ("y", "v"), "last": ("v", "x"),
    }  # fmt: skip
    places = {"w0": (-3000, 0), "w": (0, 0), "s0": (-3000, -3000), "s": (0, -3000), "m": (4000, 0), "x": (6000, 0), "e": (12000, 0),
              "y": (2000, 900), "v": (4000, 900)}  # fmt: skip
    nets.net(tmp_path, places, net, signals=signals)
    nets.traffic(tmp_path, nets.train("a", WEST, 0) + nets.train("b", SOUTH, 60))
    made = nets.scenario("robust_constrained", 500, traffic={"cooperate": [], "signals": "obey"})
    made["event"] = [{"kind": "reroute", "train": "a", "time_s": 5.0, "to_edge": "back"}]
    (tmp_path / "s.toml").write_text(tomli_w.dumps(made))
    found = run(open_scenario(str(tmp_path / "s.toml")), tmp_path / "out")
    refused = [e["reason"] for e in found.events if e["kind"] == "reroute_refused"]
    rows = found.trains.astype({"train": str, "edge": str})
    assert bool((rows[rows.train == "a"].edge == "back").any()) is taken and not amiss(found)
    assert refused == ([] if taken else ["signals are obeyed, and the path to edge back has none before edge east for train a"])


def test_what_sumo_would_die_of_is_refused_in_its_words(tmp_path, typed):
    """SUMO ends the process that loads such a file."""
    join(tmp_path / "n", nets.train("a", WEST, 0) + nets.train("b", SOUTH, 60, arrivalSpeed="fast"))
    made = nets.scenario("robust_constrained", 100, traffic={"cooperate": ["a"], "others": "sumo"})
    (tmp_path / "n" / "s.toml").write_text(tomli_w.dumps(made))
    code, lines = typed("run", tmp_path / "n" / "s.toml", "--out", tmp_path / "out")
    assert code == 2 and lines and lines[0].startswith("network.sumocfg: SUMO refuses it: "), lines
    assert not (tmp_path / "out").exists() and not (tmp_path / "out.partial").exists()


def test_signals_are_for_sumo_alone(tmp_path, typed):
    join(tmp_path / "n", nets.train("a", WEST, 0) + nets.train("b", SOUTH, 60))
    for driving, key in (({"signals": "obey"}, 'signals = "obey"'), ({"others": "sumo"}, 'others = "sumo"')):
        made = nets.scenario("robust_constrained", 500, traffic={"cooperate": ["a"], **driving})
        (tmp_path / "n" / "s.toml").write_text(tomli_w.dumps(made))
        code, lines = typed("run", tmp_path / "n" / "s.toml", "--backend", "numeric")
        assert code == 2 and [f"traffic.{key}: SUMO sets the signals: no --backend numeric, no --gui" in lines[0]] == [True], lines


@pytest.mark.parametrize(
    ("signals", "cooperate", "obeys", "said"),
    [
        ("wsmx", ["*"], False, "4 x rail signals: not obeyed"),
        ("wsmx", ["a"], True, "traffic.signals = obey: chosen since 1 of 2 trains do not cooperate"),
        (
            "wx",
            ["a"],
            False,
            "traffic.signals = ignore: chosen though not every train cooperates: there is no rail signal before edge main",
        ),
        ("", ["a"], False, None),
    ],
)
def test_what_is_chosen_is_said(tmp_path, signals, cooperate, obeys, said):
    join(tmp_path, nets.train("a", WEST, 0) + nets.train("b", SOUTH, 60), signals)
    (tmp_path / "s.toml").write_text(tomli_w.dumps(nets.scenario("robust_constrained", 500, traffic={"cooperate": cooperate})))
    p = open_scenario(str(tmp_path / "s.toml"))
    assert p.obeys is obeys
    assert any(said in note for note in p.roster.notes) if said else not any("signals" in note for note in p.roster.notes)
    assert any("rail signals" in line for line in p.roster.followed) is obeys


def bone(folder: Path, signals: str, rounds: int = 2) -> None:
    """Single track between two loops, round which one train runs twice, and another one so often."""
    places = {"a": (0, 0), "b": (3000, 0), "c": (4000, 600), "d": (4000, -600), "e": (-1000, -600), "f": (-1000, 600)}
    loops = {"bd": ("b", "d"), "dc": ("d", "c"), "cb": ("c", "b"), "af": ("a", "f"), "fe": ("f", "e"), "ea": ("e", "a")}
    nets.net(folder, places, {**nets.both_ways("ab", "a", "b"), **loops}, signals=signals)
    way = "dc cb -ab af fe ea ab bd"
    nets.traffic(folder, nets.train("x", f"{way} {way}", 0) + nets.train("y", " ".join([way] * rounds), 200))


@pytest.mark.parametrize(
    ("signals", "driving", "obeys", "said"),
    [
        ("abcdef", {}, True, "traffic.signals = obey: chosen since x and 1 more run more than once over single track"),
        ("abcdef", {"signals": "ignore"}, False, "x and 1 more run more than once over single track or a crossing: all rounds"),
        (
            "",
            {},
            False,
            "x and 1 more run more than once over single track or a crossing: all rounds of a train are counted at once",
        ),
        ("a", {}, False, "traffic.signals = ignore: chosen though 2 trains run several rounds: there is no rail signal before"),
    ],
)
def test_trains_that_run_round_over_single_track_obey_where_they_can(tmp_path, signals, driving, obeys, said):
    bone(tmp_path, signals)
    made = nets.scenario("robust_constrained", 2400, traffic={"cooperate": ["*"], **driving})
    (tmp_path / "s.toml").write_text(tomli_w.dumps(made))
    p = open_scenario(str(tmp_path / "s.toml"))
    assert p.obeys is obeys and any(said in note for note in p.roster.notes), p.roster.notes
    if obeys:
        found = run(p, tmp_path / "out")
        assert sorted(at(found, "arrive")) == ["x", "y"] and not amiss(found)


def test_one_train_that_runs_round_changes_nothing_and_who_chose_no_signals_is_told_the_way_out(tmp_path, typed):
    bone(tmp_path / "one", "abcdef", rounds=1)
    bone(tmp_path / "two", "abcdef")
    for folder in ("one", "two"):
        (tmp_path / folder / "s.toml").write_text(
            tomli_w.dumps(nets.scenario("robust_constrained", 300, traffic={"cooperate": ["*"]}))
        )
    p = open_scenario(str(tmp_path / "one" / "s.toml"))
    assert not p.obeys and not any("more than once" in note for note in p.roster.notes)
    code, lines = typed("run", tmp_path / "two" / "s.toml", "--backend", "numeric", "--out", tmp_path / "out")
    assert code == 2 and 'signals = "ignore" does without' in lines[-1], lines


@pytest.mark.parametrize(("driving", "turns"), [({"signals": "obey"}, 2), ({"others": "sumo", "cooperate": ["w"]}, 0)])
def test_trains_turn_back_where_signals_are_obeyed_ours_and_those_of_sumo(tmp_path, driving, turns):
    """A shuttle on a single track, and one that comes in from a branch."""
    nodes = {"a": (0, 0), "b": (2000, 0), "c": (3500, 0), "d": (3250, 450)}
    track = {**nets.both_ways("ab", "a", "b"), **nets.both_ways("bc", "b", "c"), **nets.both_ways("bd", "b", "d")}
    nets.net(tmp_path, nodes, track, nets.TERMINALS, signals="b")
    halts = "".join(f'<stop lane="{edge}_0" duration="20"/>' for edge in ("bc", "-ab"))
    nets.traffic(tmp_path, nets.train("v", "ab bc -bc -ab ab bc", 0, halts) + nets.train("w", "-bd -ab", 200))
    found = ran(tmp_path, 800, **driving)
    assert set(at(found, "arrive")) == {"v", "w"} and not amiss(found) and found.ok
    assert sum(e["kind"] == "turn" for e in found.events) == turns  # SUMO's turn without a word
    assert sum(e["kind"] == "stop_left" for e in found.events) == 2 == len(found.stops.dropna(subset=["departure_s"]))


@pytest.mark.parametrize("held", [True, False])
def test_a_green_that_can_no_longer_be_given_up_is_not_taken_back(tmp_path, monkeypatch, held):
    """With long steps SUMO thinks that a train can still stop that cannot, and prefers another one that comes to be earlier."""
    if not held:
        monkeypatch.setattr(Box, "hold", lambda self: None)
    join(tmp_path, nets.train("ours", WEST, 0) + nets.train("sumo", SOUTH, 130, departSpeed=0))
    made = nets.scenario(
        "robust_constrained", 1600, run={"step_s": 10.0}, controller={"h_per_s": 0.05}, reference={"speed_mps": 15.0},
        traffic={"cooperate": ["ours"], "others": "sumo"},
    )  # fmt: skip
    (tmp_path / "s.toml").write_text(tomli_w.dumps(made))
    found = run(open_scenario(str(tmp_path / "s.toml")), tmp_path / "out")
    told = [e["kind"] for e in found.events if e["kind"] in ("green_withdrawn", "red_passed", "violation")]
    assert told == ([] if held else ["green_withdrawn", "red_passed"])
    if held:  # and whoever was held for it goes on
        assert passed(found, "ours", "main") < passed(found, "sumo", "main")
        assert order_of(at(found, "arrive")) == ["ours", "sumo"]


def test_a_train_longer_than_its_block_keeps_its_green_from_one_that_comes_the_other_way(tmp_path):
    """SUMO gives no such block before single track to both; it knows only the ways of trains that came before, so one more does."""
    places = {"w0": (-3000, 0), "w": (0, 0), "m": (4000, 0), "p": (4300, 0), "q": (7300, 0), "e": (10300, 0), "o": (11300, 900),
              "o0": (14300, 900), "r": (2000, -900)}  # fmt: skip
    tracks = {
        "west0": ("w0", "w"), "west": ("w", "m"), "main": ("m", "p"), **nets.both_ways("one", "p", "q"), "east": ("q", "e"),
        "in0": ("o0", "o"), "in": ("o", "q"), "out": ("p", "r"),
    }  # fmt: skip
    nets.net(tmp_path, places, tracks, signals="wmpqo")
    against = nets.train("early", "in -one out", 0) + nets.train("sumo", "in0 in -one out", 265, departSpeed=0)
    nets.traffic(tmp_path, against + nets.train("ours", "west0 west main one east", 100), nets.EMU.replace("100", "600"))
    made = nets.scenario(
        "robust_constrained", 1400, run={"step_s": 10.0}, controller={"h_per_s": 0.05}, reference={"speed_mps": 15.0},
        traffic={"cooperate": ["ours"], "others": "sumo"}, train_type={"emu": {**nets.TYPE, "unit_length_m": 600.0}},
    )  # fmt: skip
    (tmp_path / "s.toml").write_text(tomli_w.dumps(made))
    found = run(open_scenario(str(tmp_path / "s.toml")), tmp_path / "out")
    told = [e["kind"] for e in found.events if e["kind"] in ("green_withdrawn", "red_passed", "violation", "gridlock")]
    assert not told and order_of(at(found, "arrive")) == ["early", "ours", "sumo"]


def test_a_train_that_sumo_kept_out_for_a_while_enters_so_that_it_can_stop_before_its_first_signal(tmp_path):
    """Its block is taken by a train that stands behind its place, and then passes it; the signal is red to it after that."""
    halt = '<stop lane="west0_0" endPos="1000" duration="60"/>'
    join(tmp_path, nets.train("first", WEST, 0, halt) + nets.train("near", WEST, 20, departPos=2850))
    found = ran(tmp_path, 700, signals="obey")
    (came,) = (e for e in found.events if e["kind"] == "depart" and e["train"] == "near")
    assert came["time_s"] > passed(found, "first", "west") and came["delay_s"] > 60.0
    assert 0.0 <= came["speed_mps"] ** 2 < 2.0 * 150.0 and not amiss(found)
    assert not [e for e in found.events if e["kind"] == "supervisor" and e["emergency"]]


def test_a_parked_train_that_sumo_does_not_let_back_waits_and_says_so(tmp_path):
    """Its block is taken by a train of SUMO's that has come by meanwhile."""
    halt = '<stop lane="west_0" endPos="1000" duration="40" parking="true"/>'
    join(tmp_path, nets.train("ours", WEST, 0, halt) + nets.train("sumo", WEST, 20, maxSpeed=25))
    found = ran(tmp_path, 900, cooperate=["ours"], others="sumo", wait_limit_s=20.0)
    left, reached = at(found, "stop_left")["ours"], at(found, "stop_reached")["ours"]
    (waits,) = (e for e in found.events if e["kind"] == "waiting" and e["train"] == "ours")
    assert waits["place"] == "parked" and waits["other"] is None and waits["time_s"] > waits["since_s"] + 20.0 > reached + 60.0
    assert passed(found, "sumo", "main") < left < passed(found, "sumo", "main") + 30.0 and left > reached + 60.0
    assert not amiss(found) and found.ok and order_of(at(found, "arrive")) == ["sumo", "ours"]


@pytest.mark.parametrize("end", [700, 740])
def test_a_train_of_sumos_is_parked_as_soon_as_sumo_says_so_though_it_still_moves(tmp_path, end):
    """SUMO takes it off its track at less than 0.1 m/s, as in the second case, and lets in who waits for its place in that step."""
    park = f'<stop lane="in_0" endPos="{end}" duration="60" parking="true"/>'
    nets.net(tmp_path, {"a": (0, 0), "b": (2000, 0), "c": (6000, 0)}, {"in": ("a", "b"), "out": ("b", "c")}, signals="b")
    body = nets.train("c", "out", 0) + nets.train("a", "in out", 0, park, departSpeed="max")
    slow = '<vType id="emu" vClass="rail" length="100" maxSpeed="15" decel="0.5" accel="0.4"/>'
    nets.traffic(tmp_path, body + nets.train("b", "in out", 1, departPos=end - 20), slow)
    found = ran(tmp_path, 120, signals="obey", others="sumo", cooperate=["c"])
    assert not amiss(found) and at(found, "stop_reached")["a"] == at(found, "depart")["b"]
