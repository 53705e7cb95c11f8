"""The promise of the supervisor where a limit, a switch or a law is not what it was when the train was last looked at."""

from __future__ import annotations

import re
from pathlib import Path

import nets
import pytest
import tomli_w

import trainctl
from trainctl.runner import run
from trainctl.scenario.build import open_scenario

LAWS = Path(__file__).parents[1] / "laws"
SMOOTH = {"c0_n_per_kg": 0.0, "c1_ns_per_m_kg": 0.0, "c2_ns2_per_m2_kg": 0.0}
POINT = {"unit_mass_kg": 2e5, "unit_length_m": 100.0} | SMOOTH
LATE = SMOOTH | {
    "units": 2, "unit_length_m": 50.0, "unit_mass_kg": 5e4, "traction_n": 5e4, "braking_n": 6e4, "actuator_rate_per_s": 0.5,
    "coupler_stiffness_n_per_m": 1.6e5, "coupler_damping_ns_per_m": 2e4,
}  # fmt: skip


def scenario(folder: Path, steps: int, late: bool = False, **more: object) -> str:
    """All trains of ``a.sumocfg`` pull as hard as they can; ``late``: their actuators lag by 2 s."""
    tables = {
        "schema_version": 1, "title": "kept", "run": {"duration_s": float(steps)} | ({"sub_step_s": 0.05} if late else {}),
        "network": {"sumocfg": "a.sumocfg"}, "controller": {"law": str(LAWS / "hostile.py"), "style": "full"},
        "reference": {"speed_mps": 30.0}, "topology": {"spacing_m": 800.0, "upper_m": 20000.0, "lower_m": 50.0},
        "plant": {"kind": "actuated_units" if late else "point"}, "train_type": {"emu": LATE if late else POINT},
    } | more  # fmt: skip
    (folder / "s.toml").write_text(tomli_w.dumps(tables))
    return str(folder / "s.toml")


def driven(path: str, folder: Path) -> trainctl.Run:
    """The finished run."""
    return trainctl.open(run(open_scenario(path), folder, "numeric").folder)


@pytest.mark.parametrize("speed", ["max", "40"])
def test_a_train_enters_only_as_fast_as_the_limits_ahead_allow(speed, tmp_path):
    nets.net(
        tmp_path, {"a": (0, 0), "b": (300, 0), "c": (3000, 0)}, {"x": ("a", "b", {"speed": 40}), "y": ("b", "c", {"speed": 10})}
    )
    nets.traffic(tmp_path, nets.train("1", "x y", 0, departSpeed=speed))
    done = driven(scenario(tmp_path, 60), tmp_path / "run")
    assert done.ok and done.trains.speed_mps.iloc[0] == pytest.approx(17.0, abs=2.0)


def test_a_train_enters_a_descent_so_that_its_late_brakes_hold_it_below_the_limit(tmp_path):
    nets.net(tmp_path, {"a": (0, 0), "b": (6000, 0), "c": (12000, 0)}, {"x": ("a", "b"), "y": ("b", "c")})
    nodes = (tmp_path / "a.nod.xml").read_text()
    height = {"a": 300, "b": 90, "c": 90}
    (tmp_path / "a.nod.xml").write_text(re.sub(r'id="(\w+)"', lambda m: f'{m[0]} z="{height[m[1]]}"', nodes))
    nets.convert(tmp_path)
    nets.traffic(tmp_path, nets.train("1", "x y", 0, departSpeed="40"))
    rules = {"mode": "on", "emergency_mps2": 0.6, "service_mps2": 0.6}
    done = driven(scenario(tmp_path, 60, late=True, supervisor=rules), tmp_path / "run")
    assert done.ok and done.trains.speed_mps.max() < 40.0


@pytest.mark.parametrize("falls", [184, 202, 214])
def test_a_limit_that_falls_while_a_train_comes_near_is_kept(falls, tmp_path):
    nets.net(tmp_path, {"a": (0, 0), "b": (6000, 0), "c": (30000, 0)}, {"x": ("a", "b"), "y": ("b", "c")})
    nets.traffic(tmp_path, nets.train("1", "x y", 0))
    sign = f'<variableSpeedSign id="v" lanes="y_0"><step time="{falls}" speed="5"/></variableSpeedSign>'
    (tmp_path / "a.add.xml").write_text(f"<additional>{sign}</additional>")
    config = tmp_path / "a.sumocfg"
    config.write_text(config.read_text().replace("</input>", '<additional-files value="a.add.xml"/></input>'))
    rules = {"mode": "on", "emergency_mps2": 0.7, "service_mps2": 0.7}
    done = driven(scenario(tmp_path, 240, supervisor=rules, traffic={"deceleration_mps2": 0.7}), tmp_path / "run")
    assert done.ok and done.info["overspeeds"] == 0
    assert done.trains.speed_mps.max() > 29.0  # it does not creep all the way


@pytest.mark.parametrize("place", [1180, 1230, 1280, 1330])
def test_nobody_enters_where_one_behind_will_be_by_then(place, tmp_path):
    """Within the step to its entry a train makes no way, and one of the same speed behind it 250 m."""
    nets.net(tmp_path, {"a": (0, 0), "b": (9000, 0)}, {"x": ("a", "b", {"speed": 25})})
    nets.traffic(tmp_path, nets.train("1", "x", 0, departSpeed=25) + nets.train("2", "x", 50, departPos=place, departSpeed=25))
    done = driven(scenario(tmp_path, 200, run={"duration_s": 200.0, "step_s": 10.0}), tmp_path / "run")
    assert done.ok


#: Just beyond the switch a train stands at its stop on the branch.
BRANCH = {"x": ("a", "b"), "y": ("b", "c"), "z": ("b", "d", {"speed": 15})}
STOP = '<stop lane="z_0" endPos="110" duration="900"/>'


@pytest.mark.parametrize("how", ["order", "closing", "late"])
def test_a_switch_is_turned_only_as_long_as_the_train_surely_stops_before_it(how, tmp_path):
    """Its brakes may be weaker than planned, or act late; the order comes after it could be followed, and is refused."""
    nets.net(tmp_path, {"a": (0, 0), "b": (8000, 0), "c": (30000, 0), "d": (30000, 1500), "e": (60000, 0)},
             BRANCH | {"y": ("b", "c"), "w": ("c", "e"), "z": ("b", "d", {"speed": 15}), "v": ("d", "e")})  # fmt: skip
    nets.traffic(tmp_path, nets.train("1", "x z", 0, STOP) + nets.train("2", "x y w", 200))
    more: dict[str, object] = {"event": [{"kind": "reroute", "train": "2", "to_edge": "z", "time_s": 210.0, "position_m": 7380.0}]}
    rules = {"mode": "on", "emergency_mps2": 0.8, "service_mps2": 0.8, "margin_m": 2.0}
    if how == "late":
        more["event"][0]["position_m"] = 7430.0  # type: ignore[index]
    else:
        more["disturbance"] = [{"on": "input", "shape": "constant", "amplitude_mps2": 0.25}]
    if how == "closing":
        more = {"disturbance": more["disturbance"]}
        closes = '<interval begin="440" end="900"><closingReroute id="y"/></interval>'
        (tmp_path / "a.add.xml").write_text(f'<additional><rerouter id="r" edges="x">{closes}</rerouter></additional>')
        config = tmp_path / "a.sumocfg"
        config.write_text(config.read_text().replace("</input>", '<additional-files value="a.add.xml"/></input>'))
    done = driven(scenario(tmp_path, 600, late=how == "late", supervisor=rules, **more), tmp_path / "run")
    assert done.ok
    [refused] = [e for e in done.events if e["kind"] == "reroute_refused"]
    assert ("cannot brake before the switch" if how == "closing" else "braking takes") in refused["reason"]


def test_an_order_from_outside_leads_nowhere_protection_does_not_count_on(tmp_path):
    """Orders of the file are counted on from the start; one that nobody knew of must not need more."""
    nets.net(
        tmp_path, {"a": (0, 0), "b": (8000, 0), "c": (30000, 0), "d": (30000, 1500)}, BRANCH | {"z": ("b", "d", {"speed": 60})}
    )
    nets.traffic(tmp_path, nets.train("1", "x y", 0))
    with trainctl.Simulation.open(scenario(tmp_path, 60), backend="numeric", out=tmp_path / "run") as sim:
        sim.reroute("1", to_edge="z")
        sim.step(3)
    [refused] = [e for e in trainctl.open(tmp_path / "run").events if e["kind"] == "reroute_refused"]
    assert "a limit of 60 m/s, where protection relies on 40 at most" in refused["reason"]


#: Two tracks that come together on a junction, over some 15 m each.
JOIN = {"a": (0, 0), "s": (0, -900), "b": (3000, 0), "c": (9000, 0)}
JOINED = {"x": ("a", "b"), "y": ("s", "b"), "z": ("b", "c")}


def in_sumo(path: str, folder: Path) -> trainctl.Run:
    """The finished run."""
    return trainctl.open(run(open_scenario(path), folder, "sumo").folder)


def test_who_waits_for_another_at_a_join_stands_before_the_junction(tmp_path):
    """On it the other one would pass beside its front, which is a collision to SUMO."""
    nets.net(tmp_path, JOIN, JOINED)
    nets.traffic(tmp_path, nets.train("1", "x z", 0) + nets.train("2", "y z", 300))
    more = {"order": [{"edge": "z", "trains": ["2", "1"]}], "supervisor": {"mode": "on", "margin_m": 2.0}}
    done = in_sumo(scenario(tmp_path, 500, **more), tmp_path / "run")
    assert done.ok and done.collisions == 0
    first = done.trains.astype({"train": str, "edge": str}).query("train == '1'")
    assert first[first.speed_mps < 0.1].edge.iloc[-1] == "x"
    assert first.edge.iloc[-1] == "z"


def test_a_train_is_sent_elsewhere_while_it_is_on_a_junction(tmp_path):
    nets.net(tmp_path, JOIN | {"d": (9000, 900)}, JOINED | {"w": ("b", "d")})
    nets.traffic(tmp_path, nets.train("1", "x z", 0))
    path = scenario(tmp_path, 200, run={"duration_s": 200.0, "step_s": 0.2})
    with trainctl.Simulation.open(path, backend="sumo", out=tmp_path / "run") as sim:
        while sim.position_m[0] < 3100.0:  # the junction lies from 3089 to 3124 m
            sim.step()
        sim.reroute("1", to_edge="z")  # where it goes already: all before is on its way too late
        sim.step(3)
    done = trainctl.open(tmp_path / "run")
    assert done.ok and [e["to_edge"] for e in done.events if e["kind"] == "reroute"] == ["z"]


def test_a_sign_may_show_more_than_the_net_where_a_train_enters(tmp_path):
    nets.net(tmp_path, {"a": (0, 0), "b": (9000, 0)}, {"x": ("a", "b", {"speed": 8})})
    nets.traffic(tmp_path, nets.train("1", "x", 50, departSpeed="speedLimit"))
    (tmp_path / "a.add.xml").write_text(
        '<additional><variableSpeedSign id="v" lanes="x_0"><step time="0" speed="30"/></variableSpeedSign></additional>'
    )
    config = tmp_path / "a.sumocfg"
    config.write_text(config.read_text().replace("</input>", '<additional-files value="a.add.xml"/></input>'))
    done = in_sumo(scenario(tmp_path, 90), tmp_path / "run")
    assert done.ok and done.trains.speed_mps.iloc[0] > 25.0


def test_two_that_were_parked_side_by_side_come_back_one_after_the_other(tmp_path):
    """Their platforms are apart, their rears are not: both lie on the track before."""
    halts = [f'<stop lane="p{k}_0" endPos="60" duration="10" until="600" parking="true"/>' for k in (1, 2)]
    body = "".join(nets.train(f"t{k}", f"up p{k} -p{k} down", 100 * k, halt) for k, halt in enumerate(halts, 1))
    nets.platforms(tmp_path, body)
    (tmp_path / "s.toml").write_text(tomli_w.dumps(nets.scenario("robust_constrained", 1300)))
    found = run(open_scenario(str(tmp_path / "s.toml")), tmp_path / "out", "numeric")
    left = {e["train"]: e["time_s"] for e in found.events if e["kind"] == "stop_left"}
    assert [e for e in found.events if e["kind"] == "violation"] == [] and found.ok
    arrived = [e["train"] for e in found.events if e["kind"] == "arrive"]
    assert sorted(arrived) == ["t1", "t2"] and len(left) == 2
