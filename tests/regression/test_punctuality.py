"""Trains enter in time, and what is late is told: in tables, events, SUMO's own logs and metrics, on both backends and under SUMO."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import nets
import pandas as pd
import pytest
import tomli_w
from beside import followed

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
