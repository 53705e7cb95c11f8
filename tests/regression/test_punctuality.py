"""Trains enter in time, and what is late is told: in tables, events, SUMO's own logs and metrics, on both backends and under SUMO."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import nets
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
import tomli_w
from beside import followed, plain

from trainctl.errors import InputError
from trainctl.metrics import punctuality
from trainctl.runner import run
from trainctl.runs.run import Run
from trainctl.runs.sumo_logs import elements
from trainctl.scenario.build import open_scenario


def events(found: Run, kind: str) -> dict[str, dict[str, Any]]:
    """Events of a kind by train."""
    return {e["train"]: e for e in found.events if e["kind"] == kind}


def two_lines(folder: Path) -> dict[str, float]:
    """Trains at odd times on two lines; returns when each is to be there: at the first instant of the step length."""
    nets.net(folder, {"a": (0, 0), "b": (9000, 0), "c": (0, 800), "d": (9000, 800)}, {"ab": ("a", "b"), "cd": ("c", "d")})
    due = {"begin": 0.0, "first": 1.0, "odd": 40.4, "late": 70.0}
    way = {"begin": "ab", "first": "cd", "odd": "cd", "late": "ab"}
    nets.traffic(folder, "".join(nets.train(name, way[name], at) for name, at in due.items()))
    return {**due, "odd": 41.0}


@pytest.mark.parametrize("law", ["robust_constrained", "sumo"])
def test_trains_enter_at_the_second_they_are_due_in_all_logs(tmp_path, law):
    due = two_lines(tmp_path)
    made = nets.scenario("robust_constrained", 90)
    if law == "sumo":
        made |= {"controller": {"law": "sumo", "block": "moving"}, "bounds": {}}
        del made["plant"]
    (tmp_path / "s.toml").write_text(tomli_w.dumps(made))
    found = run(open_scenario(str(tmp_path / "s.toml")), tmp_path / "out")
    told = events(found, "depart")
    assert {name: e["time_s"] for name, e in told.items()} == due
    assert [told[name]["delay_s"] for name in ("begin", "first", "late")] == [0.0, 0.0, 0.0]
    assert told["odd"]["delay_s"] == pytest.approx(0.6)
    rows = found.trains.astype({"train": str}).groupby("train")
    assert rows.time_s.min().to_dict() == due
    fcd = pd.read_parquet(tmp_path / "out" / "sumo" / "fcd.parquet").groupby("vehicle_id").timestep_time.min()
    assert fcd.to_dict() == due
    trips = {
        t["id"]: float(t["depart"]) for _, t in elements(tmp_path / "out" / "sumo" / "tripinfo.xml", "tripinfos", {"tripinfo"})
    }
    assert trips == due
    assert found.metrics["punctuality.entry_delay_max_s"] == pytest.approx(0.6)
    assert found.metrics["punctuality.entry_delay_mean_s"] == pytest.approx(0.15)


def test_trains_that_wait_for_entry_are_late_and_means_of_sumo_count_arrivals_alone(tmp_path):
    nets.net(tmp_path, {"a": (0, 0), "b": (4000, 0)}, {"ab": ("a", "b")})
    found = followed(tmp_path, nets.flow("f", "ab", 4, 0), 150)
    delays = [e["delay_s"] for e in events(found, "depart").values()]
    assert len(delays) == 4 and delays[0] == 0.0 and all(20.0 < b - a < 60.0 for a, b in pairwise(delays))
    assert found.metrics["punctuality.entry_delay_mean_s"] == pytest.approx(sum(delays) / 4)
    assert found.metrics["punctuality.entry_delay_p95_s"] == pytest.approx(0.15 * delays[2] + 0.85 * delays[3])
    arrived = events(found, "arrive")
    assert found.metrics["traffic.sumo_trips"] == len(arrived) == 2
    journeys = [e["time_s"] - delays[k] for k, e in enumerate(arrived.values())]
    assert found.metrics["traffic.sumo_duration_mean_s"] == pytest.approx(sum(journeys) / 2, abs=1.0)


#: A timetable: kept by the first train, missed by the second, whose last stop it does not come to in time.
HALTS = (
    '<stop lane="ab_0" endPos="3000" arrival="120" duration="20" until="{}"/>'
    '<stop lane="bc_0" endPos="3000" duration="30"/><stop lane="bc_0" endPos="6000" arrival="{}" duration="20"/>'
)
COLUMNS = [
    "train", "stop", "platform", "number", "planned_arrival_s", "arrival_s", "planned_departure_s", "departure_s", "delay_s",
]  # fmt: skip


@pytest.fixture(scope="module")
def timetable(tmp_path_factory):
    """Two trains on one line, the second with a passage, and a run that ends early."""
    folder = tmp_path_factory.mktemp("timetable")
    nets.net(folder, {"a": (0, 0), "b": (6000, 0), "c": (15000, 0)}, {"ab": ("a", "b"), "bc": ("b", "c")})
    passes = '<stop lane="bc_0" endPos="500" speed="20" until="330"/>'
    late = HALTS.format(150, 400).replace('<stop lane="bc_0" endPos="3000"', passes + '<stop lane="bc_0" endPos="3000"')
    return followed(folder, nets.train("kept", "ab bc", 0, HALTS.format(200, 999)) + nets.train("late", "ab bc", 60, late), 620)


def test_every_stop_of_every_train_has_its_plan_and_what_became_of_it(timetable):
    stops = timetable.stops
    assert list(stops.columns) == COLUMNS
    found = {(str(r.train), r.number): r for r in stops.itertuples()}
    assert list(found) == [("kept", 1), ("late", 1), ("late", 2), ("kept", 2), ("late", 3), ("kept", 3), ("late", 4)]
    reached = [e for e in timetable.events if e["kind"] == "stop_reached"]
    left = {(e["train"], e["time_s"]): e for e in timetable.events if e["kind"] in ("stop_left", "waypoint")}
    assert [(e["train"], e["time_s"]) for e in reached] == [
        (k[0], r.arrival_s)
        for k, r in sorted(
            ((k, r) for k, r in found.items() if np.isfinite(r.arrival_s) and k != ("late", 2)), key=lambda kr: kr[1].arrival_s
        )
    ]
    for key, row in found.items():
        if np.isfinite(row.departure_s):
            told = left[key[0], row.departure_s]
            assert told.get("delay_s") == pytest.approx(row.delay_s) if np.isfinite(row.delay_s) else "delay_s" not in told
    first = found["kept", 1]
    assert (first.planned_arrival_s, first.planned_departure_s, first.departure_s, first.delay_s) == (120.0, 200.0, 200.0, 0.0)
    assert str(first.stop) == str(first.platform) == "ab" and str(found["kept", 2].platform) == "bc"
    second = found["late", 1]
    assert second.departure_s == second.arrival_s + 20.0 and second.delay_s == second.departure_s - 150.0 > 0.0
    assert np.isnan(found["kept", 2].delay_s) and found["kept", 2].departure_s == found["kept", 2].arrival_s + 30.0
    passed = found["late", 2]
    assert passed.arrival_s == passed.departure_s and passed.delay_s == passed.departure_s - 330.0
    assert np.isnan([found["late", 4].arrival_s, found["late", 4].delay_s]).all() and found["late", 4].planned_arrival_s == 400.0
    assert reached[0]["delay_s"] == reached[0]["time_s"] - 120.0


def test_plan_and_delay_are_those_of_sumo(timetable):
    """SUMO counts the delay at a departure, and at an arrival; its trains run by other rules, so their times are not ours."""
    rows = {(r["id"], r["lane"], float(r["pos"])): r for r in plain(timetable.folder.parent, "stop")}
    ours = {r.number: r for r in timetable.stops.itertuples() if r.train == "kept"}
    row = rows["kept", "ab_0", 3000.0]
    assert float(row["ended"]) - float(row["delay"]) == 200.0 == ours[1].planned_departure_s
    assert float(row["started"]) - float(row["arrivalDelay"]) == 120.0 == ours[1].planned_arrival_s
    row = rows["kept", "bc_0", 6000.0]
    assert float(row["started"]) - float(row["arrivalDelay"]) == 999.0 == ours[3].planned_arrival_s


def test_metrics_count_late_stops_and_those_not_made(timetable):
    found, delay = timetable.metrics, timetable.stops.delay_s.dropna()
    assert len(delay) == 3 and found["punctuality.stop_delay_mean_s"] == pytest.approx(delay.mean())
    assert found["punctuality.stops_overdue"] == 1  # 220 s late at least
    assert found["punctuality.stop_within_60_s_share"] == pytest.approx((delay <= 60.0).sum() / 4) == 0.25
    assert found["punctuality.stop_within_180_s_share"] == pytest.approx((delay <= 180.0).sum() / 4) == 0.75
    assert found["punctuality.end_delay_mean_s/late"] == delay.iloc[2] == 76.0


def test_shares_by_hand():
    made = pa.table({
        "train": ["a", "a", "b", "b", "c"], "number": [1, 2, 1, 2, 1], "planned_arrival_s": [np.nan] * 5,
        "planned_departure_s": [10.0, 20.0, 30.0, 900.0, 950.0], "delay_s": [0.0, 100.0, 200.0, np.nan, np.nan],
    })  # fmt: skip
    found = punctuality.of_stops(made, 1000.0)
    assert found["punctuality.stop_within_60_s_share"] == 1 / 4  # 100 s late at least; of the fifth nobody knows
    assert found["punctuality.stop_within_180_s_share"] == 2 / 3
    assert found["punctuality.stops_overdue"] == 2 and found["punctuality.stop_delay_p95_s"] == pytest.approx(190.0)
    assert (found["punctuality.end_delay_mean_s"], found["punctuality.end_delay_max_s"]) == (150.0, 200.0)


def test_stops_of_a_named_route_count_from_the_departure_in_both_times(tmp_path):
    nets.net(tmp_path, {"a": (0, 0), "b": (9000, 0)}, {"ab": ("a", "b")})
    halt = '<stop lane="ab_0" endPos="3000" arrival="110" duration="10" until="140"/>'
    route = f'<route id="r" edges="ab">{halt}</route>'
    own = nets.flow("own", "ab", 2, 100).replace("</flow>", f"{halt}</flow>")
    nets.traffic(tmp_path, f'{route}<flow id="f" type="emu" begin="50" number="2" period="100" route="r"/>{own}')
    (tmp_path / "s.toml").write_text(tomli_w.dumps(nets.scenario("robust_constrained", 500)))
    p = open_scenario(str(tmp_path / "s.toml"))
    planned = {name: (stops[0].planned, stops[0].until) for name, stops in zip(p.scenario.ids, p.roster.stops, strict=True)}
    assert planned == {"own.0": (110.0, 140.0), "own.1": (210.0, 240.0), "f.0": (160.0, 190.0), "f.1": (260.0, 290.0)}


@pytest.mark.parametrize(
    ("stops", "told"),
    [
        ('<stop lane="ab_0" endPos="3000" arrival="200" duration="9" until="140"/>', "until = 140 s: must not be before 200 s"),
        ('<stop lane="ab_0" endPos="3000" until="300"/><stop lane="ab_0" endPos="4000" arrival="250" duration="1"/>',
         "arrival = 250 s: must not be before 300 s"),
        ('<stop lane="ab_0" endPos="3000" duration="9" arrival="soon"/>', "arrival = soon: must be a number"),
    ],
)  # fmt: skip
def test_planned_times_that_run_backwards_are_refused(tmp_path, stops, told):
    nets.net(tmp_path, {"a": (0, 0), "b": (9000, 0)}, {"ab": ("a", "b")})
    nets.traffic(tmp_path, nets.train("v", "ab", 0, stops))
    (tmp_path / "s.toml").write_text(tomli_w.dumps(nets.scenario("robust_constrained", 500)))
    with pytest.raises(InputError) as wrong:
        open_scenario(str(tmp_path / "s.toml"))
    (line,) = wrong.value.mistakes
    assert told in line and "train v: stop on edge ab" in line
