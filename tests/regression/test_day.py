"""A day of a railway: 24 h, 500 trains with stops and a timetable. By hand: pytest -m campaign."""

from __future__ import annotations

import time
from pathlib import Path

import nets
import numpy as np
import pytest
import tomli_w

from trainctl.runner import Backend, run
from trainctl.runs.run import Run
from trainctl.scenario.build import open_scenario

DAY_S, TRAINS, STATIONS, APART_M = 86_400.0, 500, 25, 10_000.0
CRUISE_MPS, STANDS_S, SLACK = 35.0, 40.0, 1.06


def day(folder: Path, duration: float, trains: int) -> None:
    """Two tracks with a station every 10 km; in each direction slow trains stop at all of them, every third train at some."""
    nodes, edges = {}, {}
    for name, y, way in (("e", 0.0, 1), ("w", 60.0, -1)):
        for k in range(STATIONS + 1):
            nodes[f"{name}{k}n"] = (APART_M * (k if way > 0 else STATIONS - k), y)
        edges |= {f"{name}{k}": (f"{name}{k}n", f"{name}{k + 1}n") for k in range(STATIONS)}
    nets.net(folder, nodes, edges)
    body = ""
    for n in range(trains):
        track, fast = "ew"[n % 2], n // 2 % 3 == 2
        depart = duration * n / trains * 0.9
        until, stops = depart, ""
        for k in range(STATIONS):
            until += SLACK * APART_M / CRUISE_MPS
            if not fast or k % 5 == 4:
                until += STANDS_S + 60.0
                place = f'<stop lane="{track}{k}_0" endPos="{APART_M - 400.0}" duration="{STANDS_S}"'
                stops += f'{place} until="{until:.0f}" arrival="{until - STANDS_S:.0f}"/>'
        way = " ".join(f"{track}{k}" for k in range(STATIONS))
        body += nets.train(f"{'fast' if fast else 'slow'}.{n}", way, round(depart), stops)
    nets.traffic(folder, body, end=int(duration))


def ran(folder: Path, duration: float, trains: int, backend: Backend) -> tuple[Run, float]:
    """A day, and the time of the processor that it took [s]."""
    day(folder, duration, trains)
    made = nets.scenario("robust_constrained", duration, traffic={"cooperate": ["fast.*"]})
    made["run"]["record_every_s"] = 60.0
    (folder / "s.toml").write_text(tomli_w.dumps(made))
    p = open_scenario(str(folder / "s.toml"))
    began = time.process_time()
    return run(p, folder / "out", backend), time.process_time() - began


def checked(found: Run, trains: int) -> None:
    """Nobody is kept out or lost, and all delays stand in one table."""
    kinds = {e["kind"] for e in found.events}
    assert not kinds & {"violation", "gridlock", "not_entered", "stop_dropped", "sumo_warning"}, kinds
    assert sum(e["kind"] == "depart" for e in found.events) == trains
    rows = found.trains
    assert rows.groupby("time_s").train.nunique().max() <= 100
    stops = found.stops
    assert stops.train.nunique() == trains
    called = stops[~np.isnan(stops.departure_s)]
    assert (called.departure_s >= called.planned_departure_s - 1e-9).all()
    assert np.isfinite(called.delay_s).all() and len(called) > 0.8 * len(stops)


@pytest.mark.campaign
def test_campaign_a_day_with_five_hundred_trains(tmp_path):
    found, spent = ran(tmp_path, DAY_S, TRAINS, "sumo")
    checked(found, TRAINS)
    print(f"{spent:.0f} s of the processor: {DAY_S / spent:.0f} times real time")
    assert spent < DAY_S / 100.0
