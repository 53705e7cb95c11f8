"""Railways nobody here laid out: trains come, join, part, stop, meet and leave, under every law, and nothing breaks."""

from __future__ import annotations

import gzip
from collections import Counter
from pathlib import Path
from typing import Any

import nets
import numpy as np
import pytest
import tomli_w
from sumo import SUMO_HOME

from trainctl.diff.runs import EXACT, diff
from trainctl.errors import InputError
from trainctl.runner import run
from trainctl.runs.run import Run
from trainctl.scenario.build import open_scenario


def go(folder: Path, tables: dict[str, Any], backend: str = "sumo") -> Run:
    """Run the configuration in ``folder``."""
    (folder / "s.toml").write_text(tomli_w.dumps(tables))
    return run(open_scenario(str(folder / "s.toml")), folder / f"out_{backend}", backend)  # type: ignore[arg-type]


def kinds(run: Run) -> Counter[str]:
    return Counter(e["kind"] for e in run.events)


def unharmed(run: Run, arrive: bool = True) -> None:
    """No collision, no teleport, no word from SUMO, no bound violated, no emergency, and every train arrives."""
    sumo = run.folder / "sumo"
    assert "<collision " not in (sumo / "collisions.xml").read_text()
    assert 'teleports total="0"' in (sumo / "statistics.xml").read_text()
    assert [e for e in run.events if e["kind"] in ("sumo_warning", "violation", "gridlock")] == []
    assert [e for e in run.events if e["kind"] == "supervisor" and (e["emergency"] or e["reason"] != "limit")] == []
    if arrive:
        trains = {e["train"] for e in run.events if e["kind"] == "depart"}
        assert trains == {e["train"] for e in run.events if e["kind"] == "arrive"}


def order_at(run: Run, edge: str) -> list[str]:
    """Trains in the order in which they came onto an edge."""
    rows = run.trains[run.trains.edge.astype(str) == edge]
    return rows.groupby("train", observed=True).time_s.min().sort_values(kind="stable").index.astype(str).tolist()


@pytest.mark.parametrize("law", nets.LAWS)
def test_trains_of_two_branches_join_in_one_formation(tmp_path, law):
    nets.branches(tmp_path, number=1)
    found = go(tmp_path, nets.scenario(law, 400))
    unharmed(found, arrive=False)
    [couple] = [e for e in found.events if e["kind"] == "couple"]
    assert (couple["train"], couple["ahead"]) == ("s.0", "w.0")
    assert couple["time_s"] < 200  # before the join, which the first reaches at 229 s
    assert order_at(found, "main") == ["w.0", "s.0"]
    links = found.links[found.links.sender.astype(str) == "w.0"]
    assert (links.time_s > 229).any()
    assert np.abs(links.spacing_m.iloc[-1] - 1200.0) < 1.0


@pytest.mark.parametrize("options", [(), ("--no-internal-links",)], ids=["internal", "plain"])
def test_joins_and_branchings_with_and_without_internal_edges(tmp_path, options):
    nets.branches(tmp_path, *options)
    found = go(tmp_path, nets.scenario("robust_constrained", 1700))
    unharmed(found)
    assert kinds(found)["couple"] >= 3
    assert order_at(found, "main") == ["w.0", "s.0", "w.1", "s.1", "w.2", "s.2"]


def test_a_net_may_be_gzipped(tmp_path, typed):
    """SUMO's often are: everything is as with the same net unpacked, which is what the run folder keeps."""
    nets.branches(tmp_path, number=1)
    plain = go(tmp_path, nets.scenario("robust_constrained", 60))
    (tmp_path / "a.net.xml.gz").write_bytes(gzip.compress((tmp_path / "a.net.xml").read_bytes()))
    (tmp_path / "a.sumocfg").write_text((tmp_path / "a.sumocfg").read_text().replace("a.net.xml", "a.net.xml.gz"))
    packed = run(open_scenario(str(tmp_path / "s.toml")), tmp_path / "packed", "sumo")
    assert diff(plain.folder, packed.folder, EXACT).lines() == []
    assert (packed.folder / "sumo" / "a.net.xml").read_bytes() == (tmp_path / "a.net.xml").read_bytes()
    assert typed("net", "show", "a.net.xml.gz", "--out", "a.png") == (0, [])
    (tmp_path / "a.net.xml.gz").write_bytes((tmp_path / "a.net.xml.gz").read_bytes()[:-100])
    code, words = typed("net", "show", "a.net.xml.gz", "--out", "b.png")
    assert code == 2
    assert len(words) == 1
    assert "a.net.xml.gz: damaged gzip: " in words[0]


def test_backends_agree_where_trains_come_join_and_leave(tmp_path):
    nets.branches(tmp_path)
    tables = nets.scenario("fully_distributed", 1500)
    coupled, numeric = go(tmp_path, tables).trains, go(tmp_path, tables, "numeric").trains
    assert len(coupled) == len(numeric)
    assert np.max(np.abs(coupled.position_m - numeric.position_m)) < 1e-6
    assert np.max(np.abs(coupled.speed_mps - numeric.speed_mps)) < 1e-9


def test_three_joins_one_after_the_other(tmp_path):
    nets.three_joins(tmp_path)
    found = go(tmp_path, nets.scenario("robust_constrained", 2150))
    unharmed(found)
    assert kinds(found)["couple"] >= 8
    pairs = [(e["train"], e["ahead"]) for e in found.events if e["kind"] == "couple"]
    assert len(set(pairs)) == len(pairs)  # nobody couples to the same train again and again


@pytest.mark.parametrize("period", [60, 240])
def test_opposing_trains_meet_in_passing_loops(tmp_path, period):
    up = nets.flow("up", nets.UP, 3, period, departSpeed="0")
    nets.single_track(tmp_path, up + nets.flow("down", nets.DOWN, 3, period, 20, departSpeed="0"))
    found = go(tmp_path, nets.scenario("robust_constrained", 2000))
    unharmed(found)
    assert any(e["kind"] == "conflict" and e["place"] == "single_track" for e in found.events)


def test_two_lines_cross_on_the_level(tmp_path):
    nets.diamond(tmp_path)
    found = go(tmp_path, nets.scenario("robust_constrained", 900))
    unharmed(found)
    assert kinds(found)["conflict"] > 0


def test_a_train_that_stops_leaves_its_formation_and_another_joins(tmp_path):
    nets.station(tmp_path)
    found = go(tmp_path, nets.scenario("robust_constrained", 1650))
    unharmed(found)
    stops = {e["train"]: e for e in found.events if e["kind"] == "stop_reached"}
    left = {e["train"]: e["time_s"] for e in found.events if e["kind"] == "stop_left"}
    assert set(stops) == set(left) == {"stops", "until"}
    assert all(abs(e["short_m"]) < 0.01 for e in stops.values())
    assert left["stops"] - stops["stops"]["time_s"] == 60.0
    assert left["until"] == max(650.0, stops["until"]["time_s"] + 10.0)
    assert kinds(found)["couple"] >= 2


@pytest.mark.parametrize(
    ("law", "rate", "within_m"),
    [
        ("fully_distributed", 0.0, 0.02),
        ("emu_finite_time", 0.0, 0.02),
        ("fault_tolerant", 50.0, 0.05),
        ("fault_tolerant", 3.0, 0.6),
    ],
)
def test_trains_stop_where_they_are_to(tmp_path, law, rate, within_m):
    """Also those of units, whose couplers give, and whose brakes act late, out of a cruise and while they still accelerate."""
    nets.station(tmp_path)
    stops = "".join(f'<stop lane="ab_0" endPos="{place}" duration="10"/>' for place in (250, 400, 1300, 6000))
    nets.traffic(tmp_path, nets.train("a", "ab bc", 0, stops))
    tables = nets.scenario(law, 520)
    tables["train_type"]["emu"] |= {"actuator_rate_per_s": rate} if rate else {}
    found = go(tmp_path, tables, "numeric")
    short = [e["short_m"] for e in found.events if e["kind"] == "stop_reached"]
    assert len(short) == 4
    assert np.abs(short).max() < within_m


def test_couplers_of_trains_that_are_driven_rest_however_late_the_actuators_are(tmp_path):
    """An active stiffness would swing them up: forces come a second late."""
    nets.station(tmp_path)
    tables = nets.scenario("fault_tolerant", 330)
    tables["train_type"]["emu"] |= {"actuator_rate_per_s": 1.0}
    units = go(tmp_path, tables, "numeric").units
    assert max(-units.coupler_min_m.min(), units.coupler_max_m.max()) < 1e-6


def test_nobody_enters_faster_than_it_may(tmp_path):
    """A departure speed is given for the limit, of which the train keeps to a share."""
    nets.limits(tmp_path)
    slow = nets.EMU.replace("/>", ' speedFactor="0.8"/>')
    nets.traffic(tmp_path, nets.train("a", "de ef", 0, departSpeed=19), slow)
    found = go(tmp_path, nets.scenario("robust_constrained", 20))
    unharmed(found, arrive=False)
    assert [e["speed_mps"] for e in found.events if e["kind"] == "depart"] == [16.0]
    native = nets.scenario("robust_constrained", 20) | {"controller": {"law": "sumo", "block": "moving"}}
    (tmp_path / "native.toml").write_text(tomli_w.dumps(native))
    # SUMO itself refuses such a train.
    with pytest.raises(InputError, match=r"native.toml: network.sumocfg: SUMO.* Departure speed for vehicle 'a' is too high"):
        run(open_scenario(str(tmp_path / "native.toml")), tmp_path / "native", "sumo")


def test_trains_run_round_a_ring_twice(tmp_path):
    nets.ring(tmp_path)
    found = go(tmp_path, nets.scenario("robust_constrained", 2800))
    unharmed(found)
    rows = found.trains[found.trains.edge.astype(str) == "cd"]
    for _, times in rows.groupby("train", observed=True).time_s:
        assert (times.diff() > 1.0).sum() == 1  # away from there just once: twice there


@pytest.mark.parametrize("law", ["fully_distributed", "robust_constrained"])
def test_a_formation_follows_the_limits_as_long_as_its_law_can(tmp_path, law):
    nets.limits(tmp_path)
    found = go(tmp_path, nets.scenario(law, 2200))
    unharmed(found)
    for edge, limit in (("bc", 34.5), ("de", 20.0)):
        rows = found.trains[found.trains.edge.astype(str) == edge]
        assert rows.speed_mps.max() < limit + 1e-9
    reasons = {e["reason"] for e in found.events if e["kind"] == "uncouple"}
    assert ("the reference falls below what the law can hold" in reasons) == (law == "fully_distributed")


def test_a_speed_factor_holds_on_every_edge(tmp_path):
    """A train of 0.8 keeps to 0.8 of each limit, the one before it to all of it."""
    nets.limits(tmp_path)
    slow = nets.EMU.replace('"emu"', '"slow"').replace("/>", ' speedFactor="0.8"/>')
    trains = "".join(nets.train(t, "ab bc cd de ef", at, type=t[:-1]) for t, at in (("emu1", 0), ("slow1", 60)))
    nets.traffic(tmp_path, trains, nets.EMU + slow)
    found = go(tmp_path, nets.scenario("robust_constrained", 1700, ("emu", "slow")))
    unharmed(found, arrive=False)
    fastest = found.trains.astype({"train": str, "edge": str}).groupby(["train", "edge"]).speed_mps.max()
    for edge, limit in (("bc", 34.5), ("de", 20.0)):
        assert limit - 2.0 < fastest["emu1", edge] < limit + 1e-9
        assert 0.8 * limit - 2.0 < fastest["slow1", edge] < 0.8 * limit + 1e-9


def test_lines_that_have_nothing_to_do_with_each_other(tmp_path):
    nets.separate(tmp_path)
    found = go(tmp_path, nets.scenario("robust_constrained", 1100))
    unharmed(found)
    assert kinds(found)["couple"] >= 4
    assert all(e["train"][0] == e["ahead"][0] for e in found.events if e["kind"] == "couple")


@pytest.mark.parametrize(("step", "control"), [(0.2, None), (0.2, 5.0), (1.0, 8.0)])
def test_other_steps_and_control_periods(tmp_path, step, control):
    nets.branches(tmp_path, number=1)
    law = "robust_constrained" if control is None else "fully_distributed"
    changed = {"run": {"step_s": step, "control_period_s": control}} if control else {"run": {"step_s": step}}
    if control is None:
        changed["controller"] = {"h_per_s": 0.1}
    found = go(tmp_path, nets.scenario(law, 320, **changed))
    unharmed(found, arrive=False)
    assert kinds(found)["couple"] == 1


def test_only_those_that_cooperate_couple(tmp_path):
    nets.branches(tmp_path)
    found = go(tmp_path, nets.scenario("robust_constrained", 900, traffic={"cooperate": ["w.*"]}))
    unharmed(found, arrive=False)
    assert {e["train"][0] + e["ahead"][0] for e in found.events if e["kind"] == "couple"} <= {"ww"}


def test_fifty_trains_of_two_lengths_couple_and_arrive(tmp_path):
    nets.crowd(tmp_path)
    tables = nets.scenario("robust_constrained", 3050, types=("emu", "long"))
    tables["train_type"]["long"] = tables["train_type"]["long"] | {"unit_length_m": 250.0}
    found = go(tmp_path, tables)
    unharmed(found)
    assert kinds(found)["couple"] >= 45


def of_the_game(duration: float, **types: Any) -> dict[str, Any]:
    """The rail example that ships with SUMO: stations, single track, trains of two types."""
    tables = nets.scenario(
        "robust_constrained", duration, types=("freightTrain", "passengerTrain"), run={"step_s": 0.2, "record_every_s": 1.0},
        network={"sumocfg": str(Path(SUMO_HOME) / "tools" / "game" / "rail.sumocfg")}, reference={"speed_mps": 20.0},
        topology={"spacing_m": 300.0, "lower_m": 120.0, "upper_m": 500.0}, traffic={"join_band_m": 10.0},
    )  # fmt: skip
    return tables | {"train_type": {k: v | {"unit_length_m": types[k]} for k, v in tables["train_type"].items() if k in types}}


def test_rail_example_of_sumo(tmp_path):
    found = go(tmp_path, of_the_game(230.0, freightTrain=72.0, passengerTrain=52.0))
    count = kinds(found)
    assert count["depart"] == count["stop_reached"] == count["stop_left"] == 3
    # Its rerouters are followed. They leave it to a player to set the signals: two trains are sent head on, stop and are told of.
    assert count["reroute"] == 6 and count["violation"] == count["arrive"] == 0
    (told,) = (e for e in found.events if e["kind"] == "gridlock")
    assert told["trains"] == ["trip_0", "trip_1"] and found.info["checks_failed"] == ["gridlock"]
    assert "<collision " not in (found.folder / "sumo" / "collisions.xml").read_text()
    said = [e["message"] for e in found.events if e["kind"] == "sumo_warning"]
    assert all("Missing yellow phase" in message for message in said)  # its own signals', whoever drives


def test_rail_example_of_sumo_without_data_of_its_trains(tmp_path):
    (tmp_path / "s.toml").write_text(tomli_w.dumps(of_the_game(230.0, freightTrain=72.0)))
    with pytest.raises(InputError, match=r"vType passengerTrain: no mass, .*: add \[train_type.passengerTrain\]"):
        open_scenario(str(tmp_path / "s.toml"))


@pytest.mark.campaign
@pytest.mark.parametrize("law", nets.LAWS)
@pytest.mark.parametrize("seed", range(20))
def test_nets_drawn_at_random(tmp_path, law, seed):
    """The law alone cannot always brake a formation as planned for: there the supervisor may act, short of an emergency."""
    nets.at_random(tmp_path, seed)
    found = go(tmp_path, nets.scenario(law, 3600))
    assert "<collision " not in (found.folder / "sumo" / "collisions.xml").read_text()
    assert [e for e in found.events if e["kind"] in ("sumo_warning", "violation", "gridlock")] == []
    assert [e for e in found.events if e["kind"] == "supervisor" and e["emergency"]] == []
    assert len([e for e in found.events if e["kind"] == "arrive"]) == len(found.trains.train.unique())
