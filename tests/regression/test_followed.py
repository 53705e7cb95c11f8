"""What SUMO's files say of a train is done: places, stops and speeds are those of plain SUMO, on both backends alike."""

from __future__ import annotations

import re
from itertools import pairwise
from typing import Any

import nets
import pandas as pd
import pytest
import tomli_w
from beside import followed, plain

from trainctl.errors import InputError
from trainctl.metrics.traffic import metrics_of_fcd
from trainctl.runner import resume, run
from trainctl.runs.logs import vehicles
from trainctl.runs.run import Run
from trainctl.scenario.build import open_scenario


@pytest.fixture
def folder(tmp_path):
    """A line of three edges of 3 km."""
    nodes = {name: (3000.0 * k, 0.0) for k, name in enumerate("abcd")}
    nets.net(tmp_path, nodes, {"ab": ("a", "b"), "bc": ("b", "c"), "cd": ("c", "d")})
    return tmp_path


@pytest.fixture
def ring(tmp_path):
    """A ring of four edges."""
    nodes = {"a": (0, 0), "b": (2000, 0), "c": (2000, 2000), "d": (0, 2000)}
    nets.net(tmp_path, nodes, {f"{x}{y}": (x, y) for x, y in ("ab", "bc", "cd", "da")})
    return tmp_path


def events(found: Run, kind: str) -> list[dict[str, Any]]:
    return [e for e in found.events if e["kind"] == kind]


def last_seen(found: Run) -> tuple[str, float]:
    """Edge and place on it where the only train was seen last."""
    row = found.trains.sort_values("time_s").iloc[-1]
    start = {"ab": 0.0, "bc": 3000.0, "cd": 6000.0}[str(row.edge)]
    return str(row.edge), float(row.position_m) - start


def test_a_train_leaves_where_it_is_to_arrive(folder):
    found = followed(folder, nets.train("v", "ab bc", 0, arrivalPos=1500), 200)
    [arrived] = events(found, "arrive")
    edge, place = last_seen(found)
    assert edge == "bc" and 1500.0 - 36.0 <= place <= 1500.0
    [trip] = plain(folder, "tripinfo")
    assert float(trip["arrivalPos"]) == 1500.0
    assert abs(arrived["time_s"] - 4400.0 / 35.0) < 10.0


def test_a_train_that_stops_beyond_its_arrival_leaves_there(folder):
    stop = '<stop lane="bc_0" endPos="2000" duration="20"/>'
    found = followed(folder, nets.train("v", "ab bc", 0, stop, arrivalPos=1500), 300)
    [reached] = events(found, "stop_reached")
    [halt] = plain(folder, "stop")
    assert float(halt["pos"]) == 2000.0 and 20.0 <= events(found, "arrive")[0]["time_s"] - reached["time_s"] < 30.0


def test_a_stop_at_the_end_of_the_way_is_made(folder):
    found = followed(folder, nets.train("v", "ab bc", 0, '<stop lane="bc_0" duration="40"/>'), 400)
    [reached], [left] = events(found, "stop_reached"), events(found, "stop_left")
    assert left["time_s"] - reached["time_s"] == 40.0 and reached["short_m"] < 1.0
    assert len(plain(folder, "stop")) == len(events(found, "arrive")) == 1


def test_departure_and_arrival_edges_cut_the_route(folder):
    found = followed(folder, nets.train("v", "ab bc cd", 0, departEdge=1, arrivalEdge=1), 200)
    assert set(found.trains.edge.astype(str)) == {"bc"}
    [route] = plain(folder, "tripinfo")
    assert route["departLane"] == route["arrivalLane"] == "bc_0"


def test_a_stop_of_a_repeated_route_is_made_once_a_lap(ring):
    route = '<route id="r" edges="ab bc cd da" repeat="2"><stop lane="bc_0" endPos="500" duration="10"/></route>'
    found = followed(ring, route + '<vehicle id="v" type="emu" depart="0" departSpeed="max" route="r"/>', 1700)
    at = [e["time_s"] for e in events(found, "stop_reached")]
    sumo = [float(row["started"]) for row in plain(ring, "stop")]
    assert len(at) == len(sumo) == 3
    # Plain SUMO drives 45 m/s for 35 m/s of ours, both slowly round the corners.
    assert all(614.0 < b - a < 614.0 * 1.2 for a, b in pairwise(at)) and sumo[1] - sumo[0] == 614.0


def test_a_waypoint_is_passed_slowly_without_a_stand(folder):
    found = followed(folder, nets.train("v", "ab bc", 0, '<stop lane="ab_0" endPos="2500" speed="10"/>'), 400)
    [passed] = events(found, "waypoint")
    assert 8.0 < passed["speed_mps"] <= 10.0 + 1e-6 and not events(found, "stop_reached")
    before = found.trains[found.trains.position_m < 1500.0]
    assert before.speed_mps.max() > 30.0 and found.trains.speed_mps.min() > 8.0


def test_no_duration_but_a_time_and_the_times_stops_ended(folder):
    halts = '<stop lane="ab_0" endPos="1000" duration="-1" until="90"/><stop lane="bc_0" endPos="1000" duration="5" ended="300"/>'
    found = followed(folder, nets.train("v", "ab bc", 0, halts), 400, '<use-stop-ended value="true"/>')
    assert [e["time_s"] for e in events(found, "stop_left")] == [90.0, 300.0]
    assert [float(row["ended"]) for row in plain(folder, "stop")] == [90.0, 300.0]


@pytest.mark.parametrize(("option", "speed"), [('<default.departspeed value="0"/>', 0.0), ("", 35.0)])
def test_the_configuration_says_how_fast_trains_begin_else_sumo(folder, option, speed):
    body = '<vehicle id="v" type="emu" depart="0"><route edges="ab"/></vehicle>'
    found = followed(folder, body, 50, option, ("sumo",))
    [came] = events(found, "depart")
    assert came["speed_mps"] == speed
    [trip] = plain(folder, "tripinfo")
    assert (float(trip["departSpeed"]) == 0.0) == (speed == 0.0)


@pytest.mark.parametrize(("word", "speed"), [("avg", 7.5), ("last", 5.0)])
def test_a_train_begins_no_faster_than_those_on_its_edge(folder, word, speed):
    """Two trains of other types run ahead at their top speeds."""
    types = nets.EMU + "".join(
        f'<vType id="{n}" vClass="rail" length="20" maxSpeed="{v}"/>' for n, v in (("quick", 10), ("slow", 5))
    )
    body = nets.train("q", "ab bc", 0, type="quick", departPos=2700) + nets.train("s", "ab bc", 1, type="slow", departPos=1400)
    nets.traffic(folder, body + nets.train("v", "ab bc", 20, departSpeed=word), types)
    (folder / "s.toml").write_text(tomli_w.dumps(nets.scenario("robust_constrained", 30, ("emu", "quick", "slow"))))
    found = run(open_scenario(str(folder / "s.toml")), folder / "out", "numeric")
    [came] = [e for e in events(found, "depart") if e["train"] == "v"]
    assert came["speed_mps"] == pytest.approx(speed, abs=0.5)
    [trip] = [row for row in plain(folder, "tripinfo", "--railsignal-moving-block") if row["id"] == "v"]
    assert float(trip["departSpeed"]) == pytest.approx(speed, abs=0.5)


def test_demand_is_scaled(folder):
    flow = nets.flow("f", "ab", 2, 200)
    found = followed(folder, flow + nets.train("v", "cd", 5), 700, '<scale value="2"/>', ("sumo",))
    came = {e["train"] for e in events(found, "depart")}
    assert came == {row["id"] for row in plain(folder, "tripinfo")} == {"f.0", "f.1", "f.2", "f.3", "v", "v.1"}


def test_who_waits_too_long_does_not_come(folder):
    body = nets.train("v", "ab", 0, departSpeed=0) + "".join(nets.train(n, "ab", 1) for n in "wx")
    found = followed(folder, body, 200, '<max-depart-delay value="20"/>', ("numeric",))
    given_up = [e["train"] for e in events(found, "given_up")]
    assert given_up and {e["train"] for e in events(found, "depart")} | set(given_up) == {"v", "w", "x"}
    assert events(found, "not_entered")[0]["trains"] == given_up
    assert all(e["delay_s"] <= 20.0 for e in events(found, "depart"))


def test_trains_may_stand_in_additional_files_alone(folder):
    nets.traffic(folder, nets.train("v", "ab", 0))
    text = (folder / "a.sumocfg").read_text().replace("route-files", "additional-files")
    (folder / "a.sumocfg").write_text(text)
    (folder / "s.toml").write_text(tomli_w.dumps(nets.scenario("robust_constrained", 20)))
    assert open_scenario(str(folder / "s.toml")).scenario.ids == ("v",)


def test_what_is_not_followed_is_in_the_events_and_on_the_page(folder):
    found = followed(folder, nets.train("v", "ab", 0, flavour="sweet"), 20, "", ("numeric",))
    said, cruise = events(found, "not_followed")
    assert cruise["what"] == "1 trains could run up to 40 m/s by their types and tracks: they cruise at reference.speed_mps = 35"
    assert said["what"] == "1 x <vehicle flavour>: not followed: it is not known here"
    from trainctl.report.page import page

    told = page(found)
    assert "1 x &lt;vehicle flavour&gt;: not followed" in told
    assert "<vehicle>: 1 x depart, 1 x type, 1 x departSpeed" in [e["what"] for e in events(found, "followed")]
    assert "&lt;vehicle&gt;: 1 x depart, 1 x type, 1 x departSpeed" in told


PARKED = '<stop lane="bc_0" endPos="1000" duration="200" parking="true"/>'


def test_a_train_that_parks_lets_others_pass(folder):
    found = followed(folder, nets.train("x", "ab bc cd", 0, PARKED) + nets.train("y", "ab bc cd", 60), 600)
    arrived = {e["train"]: e["time_s"] for e in events(found, "arrive")}
    [left] = events(found, "stop_left")
    assert arrived["y"] < left["time_s"] < arrived["x"]
    # SUMO's log has the parked train on its lane all the time.
    assert metrics_of_fcd(found.folder / "sumo" / "fcd.parquet")["fcd.spacing_min_m"] > 100.0
    assert found.metrics.get("traffic.gap_min_m", 1e9) > 0.0
    logs = ("--fcd-output", "fcd.xml", "--railsignal-moving-block")
    plain(folder, "stop", *logs)
    beside = folder / "with"
    beside.mkdir()
    for name, other in (("fcd.xml", "fcd.xml"), ("plain.xml", "stop.xml")):
        (beside / other).write_bytes((folder / name).read_bytes())
    assert metrics_of_fcd(beside / "fcd.xml")["fcd.spacing_min_m"] > 100.0 > metrics_of_fcd(folder / "fcd.xml")["fcd.spacing_min_m"]
    assert (found.folder / "sumo" / "collisions.xml").read_text().count("<collision ") == 0
    sumo = {row["id"]: float(row["arrival"]) for row in plain(folder, "tripinfo", "--railsignal-moving-block")}
    assert sumo["y"] < sumo["x"]


def test_a_parked_train_comes_back_when_nobody_is_in_its_place(folder):
    """The other one stands in its place when its time is over."""
    other = '<stop lane="bc_0" endPos="1010" duration="300"/>'
    found = followed(folder, nets.train("x", "ab bc cd", 0, PARKED) + nets.train("y", "ab bc cd", 60, other), 750)
    left = {e["train"]: e["time_s"] for e in events(found, "stop_left")}
    assert left["x"] > left["y"] > 400.0
    assert {e["train"] for e in events(found, "arrive")} == {"x", "y"}


def test_a_run_goes_on_from_a_checkpoint_while_a_train_is_parked(folder):
    nets.traffic(folder, nets.train("x", "ab bc cd", 0, PARKED) + nets.train("y", "ab bc cd", 60))
    (folder / "s.toml").write_text(tomli_w.dumps(nets.scenario("robust_constrained", 350)))
    p = open_scenario(str(folder / "s.toml"))
    whole = run(p, folder / "whole")

    def dies(steps: int, _: int) -> None:
        if steps >= 260:
            raise RuntimeError("killed")

    with pytest.raises(RuntimeError):
        run(p, folder / "cut", progress=dies, checkpoint_every_s=50.0)
    again, since = resume(folder / "cut")
    assert since == 250.0
    assert again.trains.equals(whole.trains) and again.events == whole.events


ADDITIONAL = '<additional-files value="s.add.xml"/>'
SIGN = '<variableSpeedSign id="s" lanes="bc_0"><step time="100" speed="10"/><step time="300" speed="-1"/></variableSpeedSign>'


def test_variable_speed_signs_are_kept_to_from_their_time_on(folder):
    """One train is on the edge when the limit falls, the other comes later; both have slowed down in time."""
    (folder / "s.add.xml").write_text(f"<additional>{SIGN}</additional>")
    found = followed(folder, nets.train("x", "ab bc cd", 0) + nets.train("y", "ab bc cd", 90), 500, ADDITIONAL)
    on, t = found.trains.edge.astype(str) == "bc", found.trains.time_s
    while_low = found.trains[on & (t >= 100.0) & (t < 300.0)]
    assert while_low.speed_mps.max() <= 10.0 + 1e-9 and {"x", "y"} == set(while_low.train.astype(str))
    assert found.trains[on & (t > 330.0)].speed_mps.max() > 15.0
    assert not any(e["emergency"] for e in events(found, "supervisor"))
    arrived = {e["train"]: e["time_s"] for e in events(found, "arrive")}
    # SUMO's trains know nothing of a sign before its time, and then brake as hard as it takes; ours come to it slowed down.
    sumo = {row["id"]: float(row["arrival"]) for row in plain(folder, "tripinfo", "--railsignal-moving-block")}
    assert sumo["x"] < arrived["x"] <= sumo["x"] + 70.0 and sumo["y"] < arrived["y"] <= sumo["y"] + 40.0


def test_a_train_does_not_enter_faster_than_a_sign_will_let_it(folder):
    (folder / "steps.xml").write_text('<vss><step time="5" speed="5"/></vss>')
    sign = '<variableSpeedSign id="s" lanes="ab_0" file="steps.xml"/>'
    (folder / "s.add.xml").write_text(f"<additional>{sign}</additional>")
    found = followed(folder, sign + nets.train("x", "ab bc", 0, departSpeed="avg"), 30, ADDITIONAL, ("numeric",))
    assert "1 x <variableSpeedSign> in route files: not followed" in events(found, "not_followed")[0]["what"]
    assert events(found, "depart")[0]["speed_mps"] < 8.0


def test_a_train_enters_as_fast_as_a_sign_lets_it_at_once_and_later(tmp_path):
    """Faster than the net has it, where SUMO by itself refuses the train."""
    nets.net(tmp_path, {"a": (0, 0), "b": (6000, 0), "c": (12000, 0)}, {"ab": ("a", "b", {"speed": 20}), "bc": ("b", "c")})
    sign = '<variableSpeedSign id="s" lanes="ab_0"><step time="0" speed="35"/></variableSpeedSign>'
    (tmp_path / "s.add.xml").write_text(f"<additional>{sign}</additional>")
    found = followed(tmp_path, nets.train("x", "ab bc", 0, departPos=500) + nets.train("y", "ab bc", 60), 70, ADDITIONAL)
    assert [(e["train"], e["time_s"], e["speed_mps"]) for e in events(found, "depart")] == [("x", 0.0, 34.0), ("y", 60.0, 34.0)]


@pytest.mark.parametrize("lots", [1, 2])
def test_who_finds_no_place_in_a_parking_area_waits_before_it(folder, lots):
    area = f'<parkingArea id="p" lane="bc_0" startPos="500" endPos="1000" roadsideCapacity="{lots}"/>'
    (folder / "s.add.xml").write_text(f"<additional>{area}</additional>")
    stop = '<stop parkingArea="p" duration="200"/>'
    body = nets.train("x", "ab bc cd", 0, stop) + nets.train("y", "ab bc cd", 90, stop) + nets.train("z", "ab bc cd", 150)
    found = followed(folder, body, 900, ADDITIONAL)
    reached = {e["train"]: e["time_s"] for e in events(found, "stop_reached")}
    arrived = sorted((e["time_s"], e["train"]) for e in events(found, "arrive"))
    left = {e["train"]: e["time_s"] for e in events(found, "stop_left")}
    assert (reached["y"] > left["x"]) == (lots == 1)
    rows = plain(folder, "tripinfo", "--railsignal-moving-block")
    assert [name for _, name in arrived] == [row["id"] for row in sorted(rows, key=lambda row: float(row["arrival"]))]
    at = found.trains[(found.trains.train.astype(str) == "y") & (found.trains.time_s == left["x"] - 10.0)].position_m
    assert (at.iloc[0] == pytest.approx(3500.0, abs=2.5)) == (lots == 1)


@pytest.fixture
def bypass(tmp_path):
    """A line whose middle has a slower way round it, and a far way round that."""
    nodes = {"a": (0, 0), "b": (4000, 0), "c": (7000, 0), "d": (10000, 0), "e": (5500, 800), "f": (5500, 3000)}
    sides = {f"{x}{y}": (x, y) for x, y in ("ab", "bc", "cd", "be", "ec", "bf", "fc")}
    nets.net(tmp_path, nodes, sides)
    return tmp_path


def rerouter(inside: str, more: str = "", edges: str = "ab", times: str = 'begin="0" end="9999"') -> str:
    return f'<additional><rerouter id="r" edges="{edges}" {more}><interval {times}>{inside}</interval></rerouter></additional>'


BC = '<closingReroute id="bc"/>'
#: What is closed, the edges of both trains' ways (the second departs at 200 s).
CLOSED = {
    "always": (rerouter(BC), ["ab be ec cd"] * 2),
    "two edges": (rerouter(f'{BC}<closingReroute id="be"/>'), ["ab bf fc cd"] * 2),
    "for a time": (rerouter(BC, times='begin="0" end="100"'), ["ab be ec cd", "ab bc cd"]),
    "while on the edge": (rerouter(BC, times='begin="20" end="900"'), ["ab be ec cd"] * 2),
    "later": (rerouter(BC, times='begin="190" end="900"'), ["ab bc cd", "ab be ec cd"]),
    "for others": (rerouter('<closingReroute id="bc" allow="rail"/>'), ["ab bc cd"] * 2),
    "another type": (rerouter(BC, 'vTypes="none"'), ["ab bc cd"] * 2),
    "off": (rerouter(BC, 'off="true"'), ["ab bc cd"] * 2),
    "elsewhere": (rerouter(BC, edges="cd"), ["ab bc cd"] * 2),
}


@pytest.mark.parametrize("case", CLOSED)
def test_trains_are_led_round_closed_edges(bypass, case):
    """The stop behind the detour is made at its place."""
    text, ways = CLOSED[case]
    (bypass / "s.add.xml").write_text(text)
    stop = '<stop lane="cd_0" endPos="1000" duration="20"/>'
    body = nets.train("x", "ab bc cd", 0, stop) + nets.train("y", "ab bc cd", 200, stop)
    found = followed(bypass, body, 900, ADDITIONAL)
    trains = found.trains.astype({"train": str, "edge": str})
    run_over = [" ".join(e for e in trains[trains.train == n].edge.unique() if e[0] != ":") for n in "xy"]
    assert run_over == ways
    plain(bypass, "vehroute", "--railsignal-moving-block", "--vehroute-output.last-route")
    assert [row for row in re.findall(r'<route edges="([^"]*)"', (bypass / "plain.xml").read_text()) if row] == ways
    stood = trains[(trains.speed_mps < 0.01) & (trains.edge == "cd")].groupby("train").position_m.first()
    assert len(stood) == 2 and len(events(found, "stop_reached")) == 2
    logged = {row["id"]: float(row["pos"]) for row in plain(bypass, "stop")}
    fcd = metrics_of_stops(found)
    assert fcd == pytest.approx(logged, abs=0.5)


def metrics_of_stops(found: Run) -> dict[str, float]:
    """Where on its edge every train stands when it has reached its stop, as SUMO logged it."""
    rows = pd.concat(batch.to_pandas() for batch in vehicles(found.folder / "sumo" / "fcd.parquet")).astype({"id": str})
    at = rows.set_index(["id", "time"]).pos
    return {e["train"]: float(at[(e["train"], e["time_s"])]) for e in events(found, "stop_reached")}


def test_a_stop_on_a_closed_edge_is_dropped_and_what_else_a_rerouter_does_is_named(bypass):
    (bypass / "s.add.xml").write_text(rerouter(f'{BC}<closingLaneReroute id="bc_0"/>'))
    halts = '<stop lane="bc_0" endPos="1000" duration="20"/><stop lane="cd_0" endPos="1000" duration="20"/>'
    found = followed(bypass, nets.train("x", "ab bc cd", 0, halts), 600, ADDITIONAL)
    assert [e["stop"] for e in events(found, "stop_dropped")] == ["bc"]
    assert [e["stop"] for e in events(found, "stop_left")] == ["cd"]
    assert "rerouter r: <closingLaneReroute>: not followed: no lane is closed" in [e["what"] for e in events(found, "not_followed")]


#: What a rerouter lets trains draw from -> the edges of both trains' ways.
DRAWN = {
    "a destination": ('<destProbReroute id="fc"/>', ["ab bf fc"] * 2),
    "a route": ('<routeProbReroute id="round"/><destProbReroute id="fc"/>', ["ab bf fc cd"] * 2),
    "the one of weight": ('<destProbReroute id="fc" probability="0"/><destProbReroute id="ec" probability="2"/>', ["ab be ec"] * 2),
    "its own": ('<destProbReroute id="keepDestination"/>', ["ab bc cd"] * 2),
    "round what is closed": (f'{BC}<destProbReroute id="cd"/>', ["ab be ec cd"] * 2),
}


@pytest.mark.parametrize("case", DRAWN)
def test_trains_draw_routes_and_destinations(bypass, case):
    inside, ways = DRAWN[case]
    route = '<additional><route id="round" edges="ab bf fc cd"/>'  # SUMO wants it before
    (bypass / "s.add.xml").write_text(rerouter(inside).replace("<additional>", route))
    body = nets.train("x", "ab bc cd", 0) + nets.train("y", "ab bc cd", 60)
    found = followed(bypass, body, 900, ADDITIONAL)
    trains = found.trains.astype({"train": str, "edge": str})
    assert [" ".join(e for e in trains[trains.train == n].edge.unique() if e[0] != ":") for n in "xy"] == ways
    assert len(events(found, "arrive")) == 2 and len(events(found, "reroute")) == 2 * (case != "its own")
    plain(bypass, "vehroute", "--railsignal-moving-block", "--vehroute-output.last-route")
    assert [row for row in re.findall(r'<route edges="([^"]*)"', (bypass / "plain.xml").read_text()) if row] == ways


def test_what_trains_draw_goes_by_their_weights_and_their_names(bypass):
    (bypass / "s.add.xml").write_text(
        rerouter('<destProbReroute id="fc" probability="3"/><destProbReroute id="ec"/>', 'probability="0.9"')
    )
    body = nets.flow("f", "ab bc cd", 24, 40)
    found = followed(bypass, body, 1000, ADDITIONAL, backends=("numeric",))
    asked = [e["to_edge"] for e in events(found, "reroute")]
    assert {"fc", "ec"} == set(asked) and len(asked) < 24 and asked.count("fc") > asked.count("ec")
    said = [e["what"] for e in events(found, "not_followed")]
    assert "rerouter r: <destProbReroute>: drawn here, with random numbers other than SUMO's" in said


def test_mistakes_in_what_trains_draw_from_are_told(bypass):
    inside = '<destProbReroute id="nowhere"/><routeProbReroute id="none" probability="x"/>'
    (bypass / "s.add.xml").write_text(rerouter(inside))
    with pytest.raises(InputError) as refused:
        followed(bypass, nets.train("x", "ab bc cd", 0), 100, ADDITIONAL)
    words = "\n".join(refused.value.mistakes)
    assert "rerouter r: destProbReroute nowhere: edge nowhere: not in the net" in words
    assert "rerouter r: routeProbReroute none: no such route" in words
    assert "rerouter r: routeProbReroute none: probability = x: must be a number, not negative" in words


def test_who_cannot_leave_its_way_any_more_is_told(bypass):
    (bypass / "s.add.xml").write_text(rerouter(BC))
    found = followed(bypass, nets.train("x", "ab bc cd", 0, departPos=3700, departSpeed=30), 300, ADDITIONAL)
    [refused] = events(found, "reroute_refused")
    assert refused["reason"] == "edge bc is closed; it cannot brake before the switch any more"
    assert len(events(found, "arrive")) == 1


def test_a_run_goes_on_from_a_checkpoint_behind_a_detour(bypass):
    (bypass / "s.add.xml").write_text(rerouter(BC))
    nets.traffic(bypass, nets.train("x", "ab bc cd", 0, '<stop lane="cd_0" endPos="1000" duration="20"/>'))
    cfg = bypass / "a.sumocfg"
    cfg.write_text(cfg.read_text().replace("<configuration>", f"<configuration>{ADDITIONAL}"))
    (bypass / "s.toml").write_text(tomli_w.dumps(nets.scenario("robust_constrained", 420)))
    p = open_scenario(str(bypass / "s.toml"))
    whole = run(p, bypass / "whole")

    def dies(steps: int, _: int) -> None:
        if steps >= 60:
            raise RuntimeError("killed")

    with pytest.raises(RuntimeError):
        run(p, bypass / "cut", progress=dies, checkpoint_every_s=50.0)
    again, since = resume(bypass / "cut")
    assert since == 50.0 and len(events(again, "stop_left")) == 1
    assert again.trains.equals(whole.trains) and again.events == whole.events


def test_an_edge_is_closed_to_the_classes_named(bypass):
    """Where SUMO would end with an error: it closes the edge to trains that depart later, too."""
    (bypass / "s.add.xml").write_text(rerouter('<closingReroute id="bc" disallow="rail"/>'))
    found = followed(bypass, nets.train("x", "ab bc cd", 0), 400, ADDITIONAL)
    assert "be" in set(found.trains.edge.astype(str)) and events(found, "reroute")[0]["closed"] == "bc"
    assert [e for e in events(found, "not_followed") if "where SUMO ends with an error" in e["what"]]
