"""Trains that turn back: where and when they do, on both backends alike, with every law; who waits for whom; and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nets
import numpy as np
import pandas as pd
import pytest
import tomli_w
from beside import plain

from trainctl.errors import InputError
from trainctl.loop import Loop
from trainctl.monitors.outcome import GAP, LIMIT
from trainctl.runner import opened, resume, run
from trainctl.runs.run import Run
from trainctl.scenario.build import open_scenario
from trainctl.scenario.model import Model

LAWS = Path(__file__).parent.parent / "laws"
#: Units of one train, all of them unlike each other.
UNLIKE = {"unit_length_m": [30.0, 25.0, 20.0, 25.0], "unit_mass_kg": [8e4, 6e4, 4e4, 5e4]}


def halts(*edges: str, duration: float = 20.0) -> str:
    """A stop at the end of each edge."""
    return "".join(f'<stop lane="{edge}_0" duration="{duration}"/>' for edge in edges)


def opened_in(folder: Path, law: str, duration: float, **changes: Any) -> Model:
    (folder / "s.toml").write_text(tomli_w.dumps(nets.scenario(law, duration, **changes)))
    return open_scenario(str(folder / "s.toml"))


def both(p: Model, folder: Path) -> Run:
    """The run in SUMO, which has the same positions as one without."""
    runs = [run(p, folder / backend, backend) for backend in ("sumo", "numeric")]  # type: ignore[arg-type]
    one, two = (found.trains for found in runs)
    assert len(one) == len(two) and (one.edge.astype(str).to_numpy() == two.edge.astype(str).to_numpy()).all()
    assert np.max(np.abs(one.position_m - two.position_m)) < 1e-6
    for found in runs:
        assert not [e for e in found.events if e["kind"] in ("violation", "sumo_warning", "gridlock", "limit")]
    return runs[0]


def told(found: Run, kind: str) -> list[dict[str, Any]]:
    return [e for e in found.events if e["kind"] == kind]


def shuttle(turns: int) -> tuple[str, str]:
    """A route to and fro with so many turns, and a stop before each."""
    legs = [("ab", "bc") if k % 2 == 0 else ("-bc", "-ab") for k in range(turns + 1)]
    return " ".join(edge for leg in legs for edge in leg), halts(*(leg[1] for leg in legs[:-1]))


def test_a_shuttle_turns_at_both_ends_where_it_stops(tmp_path):
    route, stops = shuttle(5)
    nets.terminals(tmp_path, nets.train("v", route, 0, stops), scale=0.5)
    found = both(opened_in(tmp_path, "robust_constrained", 1200), tmp_path)
    assert [(e["from_edge"], e["to_edge"]) for e in told(found, "turn")] == [("bc", "-bc"), ("-ab", "ab")] * 2 + [("bc", "-bc")]
    assert [e["time_s"] for e in told(found, "turn")] == [e["time_s"] for e in told(found, "stop_left")]
    [arrived], stood = told(found, "arrive"), plain(tmp_path, "stop")
    assert len(stood) == 5 and [row["lane"] for row in stood] == [f"{e}_0" for e in ["bc", "-ab"] * 2 + ["bc"]]
    assert abs(found.metrics["run.train_km"] - 6 * (3.5 - 0.1)) < 0.11
    # where it stands: as far from the end as it came from it, and a train's length
    rows = found.trains[found.trains.time_s.isin([told(found, "turn")[0]["time_s"] + k for k in (0.0, 1.0)])]
    length = plain_length(tmp_path, "bc")
    lane = [length - 0.2, 0.2 + 100.0]
    start = open_scenario(str(tmp_path / "s.toml")).rails
    assert np.allclose([x - (start.start_m[start.index[str(e)]]) for x, e in zip(rows.position_m, rows.edge, strict=True)], lane)
    assert (rows.speed_mps == 0.0).all() and arrived["time_s"] < 1200.0


def plain_length(folder: Path, edge: str) -> float:
    rails = open_scenario(str(folder / "s.toml")).rails
    return float(rails.length_m[rails.index[edge]])


def test_without_a_stop_it_brakes_as_soon_as_all_of_it_is_on_the_track_it_runs_back_over(tmp_path):
    nets.terminals(tmp_path, nets.train("v", "ab bc -bc -ab", 0))
    p = opened_in(tmp_path, "robust_constrained", 600)
    found = both(p, tmp_path)
    [turned] = told(found, "turn")
    trains = found.trains
    begin = float(p.rails.length_m[p.rails.index["ab"]]) + 6.2
    braking = 0.5 * 35.0**2 / p.driver_rules.service_mps2
    stands = float(trains[trains.time_s == turned["time_s"]].position_m.iloc[0])
    assert begin + 100.0 + braking - 1.0 < stands < begin + 100.0 + braking + 2.0 * 35.0
    rates = np.diff(trains[trains.time_s <= turned["time_s"]].speed_mps)
    assert rates.min() > -p.driver_rules.service_mps2 - 1e-9


@pytest.mark.parametrize("law", ["emu_finite_time", "fault_tolerant"])
def test_units_run_on_in_the_new_order(law, tmp_path):
    """Weights, couplers, estimates and what is written of every unit stay with it; energies balance, or there would be a violation."""
    route, stops = shuttle(1)
    nets.terminals(tmp_path, nets.train("v", route, 0, stops), scale=0.25)
    kind = nets.LAWS[law]["train_type"] | UNLIKE
    kind |= {"coupler_stiffness_n_per_m": [1.6e5, 2.6e5, 3.6e5]}
    more = {"controller": {"weighted_by_mass": True}} if law == "emu_finite_time" else {}
    found = both(opened_in(tmp_path, law, 200, train_type={"emu": kind}, **more), tmp_path)
    [turned] = told(found, "turn")
    units = found.units.set_index(["time_s", "unit"]).position_m.unstack()
    before, after = units.loc[turned["time_s"]], units.loc[turned["time_s"] + 1.0]
    fronts, lengths = before.to_numpy(), np.array(UNLIKE["unit_length_m"])
    rears = fronts - lengths
    assert np.allclose(after.to_numpy() - after.iloc[-1], rears[-1] - rears, atol=1e-9)  # mirrored, with couplers as they were
    assert after.iloc[-1] == found.trains[found.trains.time_s == turned["time_s"] + 1.0].position_m.iloc[0]
    later = found.trains[found.trains.time_s > turned["time_s"] + 30.0]
    assert later.speed_mps.max() > 10.0


def test_what_is_known_of_units_turns_with_the_train(tmp_path):
    nets.terminals(tmp_path, nets.train("v", "ab bc -bc", 0) + nets.train("w", "ab bd", 5), scale=0.25)
    faults = [{"train": "v", "unit": 1, "kind": "effectiveness", "effectiveness": 0.5}]
    kind = nets.LAWS["fault_tolerant"]["train_type"] | UNLIKE
    tables = nets.scenario("fault_tolerant", 10, train_type={"emu": kind}) | {"fault": faults}
    (tmp_path / "s.toml").write_text(tomli_w.dumps(tables))
    p = open_scenario(str(tmp_path / "s.toml"))
    there = p.turned(np.array([True, False]))
    assert there.consists.mass.tolist() == [5e4, 4e4, 6e4, 8e4, 8e4, 6e4, 4e4, 5e4]
    assert there.unit.tolist() == [4, 3, 2, 1, 1, 2, 3, 4] and p.unit.tolist() == [1, 2, 3, 4] * 2
    assert [(f.train, f.unit) for f in there.scenario.fault] == [("v", 4)]
    assert there.turned(np.array([True, False])).consists.mass.tolist() == p.consists.mass.tolist()
    assert p.turned(np.array([False, False])) is p and p.consists.mass.tolist() == [8e4, 6e4, 4e4, 5e4] * 2


@pytest.mark.parametrize(("backend", "law"), [("sumo", "robust_constrained"), ("numeric", "fault_tolerant")])
def test_a_run_with_turns_resumes_as_if_it_had_not_been_interrupted(backend, law, tmp_path):
    route, stops = shuttle(3)
    nets.terminals(tmp_path, nets.train("v", route, 0, stops), scale=0.25)
    kind = nets.LAWS[law]["train_type"] | ({} if law == "robust_constrained" else UNLIKE)
    p = opened_in(tmp_path, law, 460, train_type={"emu": kind})
    whole = run(p, tmp_path / "whole", backend, checkpoint_every_s=50.0)
    turns = [e["time_s"] for e in told(whole, "turn")]
    assert len(turns) == 3

    def killed(sim: Loop) -> None:
        while sim.time < turns[1] + 20.0:
            sim.step()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), opened(p, tmp_path / "out", backend, checkpoint_every_s=50.0) as sim:
        killed(sim)
    done, since = resume(tmp_path / "out")
    assert since is not None and turns[0] < since
    for name in ("trains.parquet", "events.jsonl", "metrics.json", *(["units.parquet"] if p.has_units else [])):
        assert (done.folder / name).read_bytes() == (whole.folder / name).read_bytes(), name
    if backend == "sumo":
        logs = [pd.read_parquet(found.folder / "sumo" / "fcd.parquet") for found in (done, whole)]
        pd.testing.assert_frame_equal(*logs, check_exact=True)


def test_it_leaves_where_it_is_to_arrive_on_its_last_leg_only(tmp_path):
    nets.terminals(tmp_path, nets.train("v", "ab bc -bc -ab", 0, halts("bc"), arrivalPos=300), scale=0.25)
    found = both(opened_in(tmp_path, "robust_constrained", 300), tmp_path)
    [arrived] = told(found, "arrive")
    last = found.trains.iloc[-1]
    assert str(last.edge) == "-ab" and arrived["time_s"] == last.time_s + 1.0
    [reached] = told(found, "stop_reached")
    assert reached["time_s"] < arrived["time_s"] - 20.0


@pytest.mark.parametrize("options", [(), ("--no-internal-links",)])
def test_a_train_longer_than_the_edge_turns_on_the_edges_it_runs_back_over(options, tmp_path):
    types = nets.EMU.replace('length="100"', 'length="700"')
    stop = '<stop lane="bc_0" endPos="400" duration="10"/>'
    nets.terminals(tmp_path, nets.train("v", "ab bc -bc -ab ab", 0, stop), *options, scale=0.5, types=types)
    kind = nets.LAWS["robust_constrained"]["train_type"] | {"unit_length_m": 700.0}
    p = opened_in(tmp_path, "robust_constrained", 500, train_type={"emu": kind})
    found = both(p, tmp_path)
    first, second = told(found, "turn")
    rows = found.trains.set_index("time_s")
    assert str(rows.edge[first["time_s"]]) == "bc"
    if options:  # where it stops: its rear is on the edge before
        assert first["time_s"] == told(found, "stop_left")[0]["time_s"] and str(rows.edge[first["time_s"] + 1.0]) == "-ab"
    else:  # too few edges to run back over for SUMO to turn it there
        assert first["time_s"] > told(found, "stop_left")[0]["time_s"] and str(rows.edge[first["time_s"] + 1.0]) == "-bc"
    assert second["from_edge"] == "-ab"


def test_a_train_turns_with_a_junction_under_it(tmp_path):
    """SUMO leaves out the junctions under a train that turns; it is where it should be all the same, with either backend."""
    nodes = {"a": (0, 0), "b": (1500, 0), "c": (2500, 0), "d": (3000, 0)}
    edges = {**nets.both_ways("ab", "a", "b"), **nets.both_ways("bc", "b", "c"), **nets.both_ways("cd", "c", "d")}
    branch = {"x": (2000, 500)}
    nets.net(tmp_path, nodes | branch, edges | nets.both_ways("xc", "x", "c"), nets.TERMINALS)
    types = nets.EMU.replace('length="100"', 'length="700"')
    stop = '<stop lane="cd_0" endPos="400" duration="10"/>'
    nets.traffic(tmp_path, nets.train("v", "ab bc cd -cd -bc -ab", 0, stop), types)
    kind = nets.LAWS["robust_constrained"]["train_type"] | {"unit_length_m": 700.0}
    p = opened_in(tmp_path, "robust_constrained", 400, train_type={"emu": kind})
    assert p.rails.length_m[[p.rails.index[e] for e in (":c_0", ":c_1")]].max() > 1.0
    found = both(p, tmp_path)
    [turned], [left] = told(found, "turn"), told(found, "stop_left")
    rows = found.trains.set_index("time_s")
    assert turned["time_s"] == left["time_s"] and str(rows.edge[turned["time_s"] + 1.0]) == "-bc"


@pytest.mark.parametrize(("said", "length"), [('duration="10"', 700.0), ('speed="5"', 100.0), ('speed="5"', 700.0)])
def test_a_stop_beyond_where_it_may_turn_is_made_where_it_may(said, length, tmp_path):
    """At the very end of an edge, with a junction under the train or not, and for a place it only passes."""
    nodes = {"a": (0, 0), "b": (1500, 0), "c": (2500, 0), "d": (3000, 0)}
    edges = {**nets.both_ways("ab", "a", "b"), **nets.both_ways("bc", "b", "c"), **nets.both_ways("cd", "c", "d")}
    nets.net(tmp_path, nodes | {"x": (2000, 500)}, edges | nets.both_ways("xc", "x", "c"), nets.TERMINALS)
    types = nets.EMU.replace('length="100"', f'length="{length}"')
    nets.traffic(tmp_path, nets.train("v", "ab bc cd -cd -bc -ab", 0, f'<stop lane="cd_0" {said}/>'), types)
    kind = nets.LAWS["robust_constrained"]["train_type"] | {"unit_length_m": length}
    found = both(opened_in(tmp_path, "robust_constrained", 300, train_type={"emu": kind}), tmp_path)
    [reached], [turned], [_] = (told(found, kind) for kind in ("stop_reached" if "dur" in said else "waypoint", "turn", "arrive"))
    assert 80.0 < reached["time_s"] < turned["time_s"] < 140.0
    assert reached.get("short_m", 0.0) == pytest.approx(0.0 if "speed" in said or length == 100.0 else 7.34, abs=1e-6)


@pytest.mark.parametrize(
    ("net", "others"),
    [
        ("platforms", "driven"),
        ("terminals", "sumo"),
        pytest.param("terminals", "driven", marks=pytest.mark.campaign),
        pytest.param("platforms", "sumo", marks=pytest.mark.campaign),
    ],
)
def test_signals_let_trains_turn_one_after_the_other_as_in_plain_sumo(net, others, tmp_path):
    """Two shuttles on one track, and five trains into a terminal of two platforms; with trains of SUMO's own among them."""
    if net == "terminals":
        ways = {name: f"ab {e} -{e} -ab ab {e} -{e} -ab" for name, e in (("A", "bc"), ("B", "bd"))}
        stops = {name: halts(e, "-ab", e, duration=10) for name, e in (("A", "bc"), ("B", "bd"))}
    else:
        ways = {f"t{k}": f"up p{k % 2 + 1} -p{k % 2 + 1} down" for k in range(5)}
        stops = {f"t{k}": halts(f"p{k % 2 + 1}", duration=5) for k in range(5)}
    body = "".join(nets.train(name, ways[name], 60 * k, stops[name]) for k, name in enumerate(ways))
    if net == "terminals":
        nets.terminals(tmp_path, body, scale=0.5, signals="b")
    else:
        nets.platforms(tmp_path, body, signals="s")
    ours = list(ways) if others == "driven" else list(ways)[1:2]
    p = opened_in(
        tmp_path,
        "robust_constrained",
        2000,
        traffic={"signals": "obey", "others": others, "cooperate": ours, "below_limit_mps": 0.0},
    )
    with opened(p, tmp_path / "out") as sim:
        while not sim.over:
            sim.step()
            bodies = under(p, sim) if others == "driven" else []
            for i, e, a, b in bodies:
                assert not [(i, j) for j, f, c, d in bodies if j != i and f == e and min(b, d) - max(a, c) > 1e-6], sim.time
        sim.end()
    found = Run(tmp_path / "out")
    assert not [e for e in found.events if e["kind"] in ("violation", "sumo_warning", "gridlock", "red_passed", "green_withdrawn")]
    theirs = {row["id"]: float(row["arrival"]) for row in plain(tmp_path, "tripinfo")}
    stops_made = sorted(e["train"] for e in told(found, "stop_reached"))
    assert stops_made == sorted(row["id"] for row in plain(tmp_path, "stop"))
    here = {e["train"]: e["time_s"] for e in told(found, "arrive")}
    assert sorted(here, key=here.__getitem__) == sorted(theirs, key=theirs.__getitem__)
    assert len(told(found, "turn")) == sum(stops[name].count("<stop") for name in ours)
    held = told(found, "signal")
    assert (held or others == "sumo") and all(e["other"] not in (None, e["train"]) for e in held)


def stub(folder: Path, signals: str = "ad", number: int = 2) -> None:
    """A way in over ``a`` and a way out, single track behind them with a signal in ``d``, and a terminal: trains turn there."""
    nodes = {
        "i": (-400, 0),
        "a": (0, 0),
        "b": (300, 0),
        "c": (600, 0),
        "d": (900, 0),
        "e": (1300, 0),
        "o": (0, 80),
        "q": (-400, 80),
    }
    track = {key: value for one, two in ("bc", "cd", "de") for key, value in nets.both_ways(one + two, one, two).items()}
    ways = {"ia": ("i", "a"), "ab": ("a", "b"), "bo": ("b", "o"), "oq": ("o", "q")}
    nets.net(folder, nodes, track | ways, nets.TERMINALS, signals=signals)
    way = "ia ab bc cd de -de -cd -bc bo oq"
    trains = [nets.train(f"t{k}", way, 30 * k, halts("de", duration=10), departSpeed=0) for k in range(number)]
    nets.traffic(folder, "".join(trains))


def test_a_train_that_is_alone_needs_no_signal_before_its_own_way_back(tmp_path):
    stub(tmp_path, "d", 1)
    assert opened_in(tmp_path, "robust_constrained", 100, traffic={"signals": "obey", "cooperate": []}).obeys
    stub(tmp_path, "d", 2)
    with pytest.raises(InputError, match=r"there is no rail signal before edge :b_.* for train t0 and 1 more"):
        opened_in(tmp_path, "robust_constrained", 100, traffic={"signals": "obey", "cooperate": []})


def test_signals_keep_others_out_of_where_a_train_comes_back_to(tmp_path):
    """SUMO must know all of its route for that: else the second follows to the inner signal, and both wait for ever."""
    stub(tmp_path)
    p = opened_in(tmp_path, "robust_constrained", 700, traffic={"signals": "obey", "cooperate": []})
    whole = run(p, tmp_path / "out", checkpoint_every_s=100.0)
    assert [e["train"] for e in told(whole, "arrive")] == ["t0", "t1"] and len(told(whole, "turn")) == 2
    assert not [e for e in whole.events if e["kind"] in ("violation", "gridlock", "red_passed", "sumo_warning")]
    held = [e for e in told(whole, "signal") if e["train"] == "t1"]
    assert {(e["signal"], e["other"]) for e in held} == {("a", "t0")}
    theirs = {row["id"]: float(row["arrival"]) for row in plain(tmp_path, "tripinfo")}
    assert sorted(theirs, key=theirs.__getitem__) == ["t0", "t1"]
    with pytest.raises(KeyboardInterrupt), opened(p, tmp_path / "cut", checkpoint_every_s=100.0) as sim:
        while sim.time < told(whole, "turn")[1]["time_s"] + 20.0:
            sim.step()
        raise KeyboardInterrupt
    again, since = resume(tmp_path / "cut")
    assert since is not None and since > told(whole, "turn")[0]["time_s"]
    for name in ("trains.parquet", "events.jsonl", "metrics.json"):
        assert (whole.folder / name).read_bytes() == (again.folder / name).read_bytes(), name


def test_a_train_with_its_rear_inside_a_junction_goes_on_before_it_turns(tmp_path):
    stop = '<stop lane="bc_0" endPos="98" duration="10"/>'
    nets.terminals(tmp_path, nets.train("v", "ab bc -bc -ab", 0, stop), scale=0.25)
    found = both(opened_in(tmp_path, "robust_constrained", 400), tmp_path)
    [left], [turned] = told(found, "stop_left"), told(found, "turn")
    rows = found.trains.set_index("time_s").position_m
    assert left["time_s"] < turned["time_s"] and 2.0 <= rows[turned["time_s"]] - rows[left["time_s"]] < 10.0


def test_who_turns_waits_for_its_way_back(tmp_path):
    """Two shuttles on one track, each to a terminal of its own: neither runs into the other, nor for ever waits."""
    runs = [
        nets.train(name, f"ab {e} -{e} -ab ab {e} -{e}", 30 * k, halts(e, "-ab", e))
        for k, (name, e) in enumerate((("A", "bc"), ("B", "bd")))
    ]
    nets.terminals(tmp_path, "".join(runs), scale=0.5)
    p = opened_in(tmp_path, "robust_constrained", 1500, traffic={"wait_limit_s": 60.0})
    found = both(p, tmp_path)
    assert {e["train"] for e in told(found, "arrive")} == {"A", "B"} and len(told(found, "turn")) == 6
    delayed = told(found, "turn_delayed")
    assert ("B", "bd", "A") in [(e["train"], e["edge"], e["other"]) for e in delayed]
    assert any(e["place"] == "turn" and e["train"] == "B" for e in told(found, "waiting"))
    first = delayed[0]["time_s"]
    assert all(e["time_s"] > first for e in told(found, "turn") if e["train"] == "B")


def under(p: Model, sim: Loop) -> list[tuple[int, int, float, float]]:
    """Train, edge (of a track's two the lower number) and from where to where on it, of all bodies now; told from the world alone."""
    seen, ways, found = sim.world.measure(), sim.world.ways, []
    lengths, rails = p.consists.train_length(), p.rails
    for i in np.flatnonzero(seen.present).tolist():
        k, low, high = int(seen.row[i]), float(seen.position[i] - lengths[i]), float(seen.position[i])
        while k >= ways.first[i]:
            e, begin = int(ways.edge[k]), float(ways.begin[k])
            size = float(rails.length_m[e])
            a, b = max(low - begin, 0.0), min(high - begin, size)
            if 0 <= rails.twin[e] < e:
                e, a, b = int(rails.twin[e]), size - b, size - a
            if b > a:
                found.append((i, e, a, b))
            if begin <= low:
                break
            k -= 1
    return found


@pytest.mark.parametrize("style", ["bang", "huge", "full"])
def test_no_law_causes_a_collision_where_trains_turn(style, tmp_path):
    """Formations run into a terminal of two platforms; the law is out to do harm, and the bodies are looked at here."""
    runs = [
        nets.train(f"t{k}", f"up p{k % 2 + 1} -p{k % 2 + 1} down", 36 * k, halts(f"p{k % 2 + 1}", duration=5)) for k in range(5)
    ]
    nets.platforms(tmp_path, "".join(runs))
    tables = nets.scenario("robust_constrained", 2400)
    tables["controller"] = {"law": str(LAWS / "hostile.py"), "style": style, "seed": 3, "big_mps2": 3.0}
    (tmp_path / "s.toml").write_text(tomli_w.dumps(tables))
    p = open_scenario(str(tmp_path / "s.toml"))
    with opened(p, tmp_path / "out", "numeric") as sim:
        while not sim.over:
            sim.step()
            bodies = under(p, sim)
            for i, e, a, b in bodies:
                assert not [(i, j) for j, f, c, d in bodies if j != i and f == e and min(b, d) - max(a, c) > 1e-6], sim.time
        sim.end()
    found = Run(tmp_path / "out")
    assert len(told(found, "turn")) == len(told(found, "arrive")) == 5 and told(found, "couple")
    assert not told(found, "gridlock") and not [e for e in told(found, "violation") if e["bound"] in (GAP, LIMIT)]


@pytest.mark.parametrize("branch", [False, True])
def test_a_train_turns_where_it_begins_though_it_hangs_out_behind(branch, tmp_path):
    """As in SUMO; beyond a switch nobody knows where its rear is."""
    nodes = {name: (x, 0) for name, x in zip("abcde", (0, 600, 1100, 1150, 1200), strict=True)} | {"x": (900, 300)}
    edges = {key: value for one, two in ("ab", "bc", "cd", "de") for key, value in nets.both_ways(one + two, one, two).items()}
    nets.net(tmp_path, nodes, edges | (nets.both_ways("xd", "x", "d") if branch else {}), nets.TERMINALS, "--no-internal-links")
    types = nets.EMU.replace('length="100"', 'length="130"')
    nets.traffic(tmp_path, nets.train("v", "de -de -cd -bc -ab", 0, departSpeed=0), types)
    kind = nets.LAWS["robust_constrained"]["train_type"] | {"unit_length_m": 130.0}
    if branch:
        with pytest.raises(InputError, match="cannot turn back from edge de to edge -de: its 130 m do not fit on the track"):
            opened_in(tmp_path, "robust_constrained", 300, train_type={"emu": kind})
        return
    found = both(opened_in(tmp_path, "robust_constrained", 300, train_type={"emu": kind}), tmp_path)
    [turned], [_] = told(found, "turn"), told(found, "arrive")
    assert (turned["time_s"], turned["from_edge"]) == (1.0, "de") and len(plain(tmp_path, "tripinfo")) == 1
    rows = found.trains.set_index("time_s")
    assert str(rows.edge[0.0]) == "de" and str(rows.edge[2.0]) == "-bc"


def test_turns_that_cannot_be_are_refused_with_the_edges(tmp_path):
    nets.terminals(tmp_path, nets.train("v", "ab -ab", 0) + nets.train("w", "ab bc -bc", 10), scale=0.25)
    with pytest.raises(InputError) as refused:
        opened_in(tmp_path, "robust_constrained", 100)
    [line] = refused.value.mistakes
    assert "train v: cannot turn back from edge ab to edge -ab: the net has no connection there" in line
    nets.traffic(tmp_path, nets.train("w", "ab bc -bc", 10), nets.EMU.replace('length="100"', 'length="800"'))
    kind = nets.LAWS["robust_constrained"]["train_type"] | {"unit_length_m": 800.0}
    with pytest.raises(InputError) as refused:
        opened_in(tmp_path, "robust_constrained", 100, train_type={"emu": kind})
    [line] = refused.value.mistakes
    assert "train w: cannot turn back from edge bc to edge -bc: its 800 m do not fit" in line


def test_sumos_own_trains_turn_by_themselves(tmp_path):
    route, stops = shuttle(2)
    nets.terminals(tmp_path, nets.train("v", route, 0, stops), scale=0.25)
    tables = nets.scenario("robust_constrained", 400) | {"controller": {"law": "sumo"}}
    tables = {k: v for k, v in tables.items() if k not in ("plant", "bounds", "topology")}
    (tmp_path / "s.toml").write_text(tomli_w.dumps(tables | {"topology": {"spacing_m": 1200.0}}))
    found = run(open_scenario(str(tmp_path / "s.toml")), tmp_path / "out")
    assert len(told(found, "stop_reached")) == 2 and len(told(found, "arrive")) == 1 and not told(found, "violation")


@pytest.mark.campaign
@pytest.mark.parametrize("law", ["robust_constrained", "emu_finite_time", "fault_tolerant"])
@pytest.mark.parametrize("stops", [True, False])
def test_a_shuttle_of_two_hours(law, stops, tmp_path):
    route, halting = shuttle(40)
    nets.terminals(tmp_path, nets.train("v", route, 0, halting if stops else ""), scale=0.6)
    found = both(opened_in(tmp_path, law, 7200), tmp_path)
    assert len(told(found, "turn")) >= 24
