"""Whole runs in SUMO: it moves every train just where the plant says, and its own logs agree."""

from __future__ import annotations

import nets
import numpy as np
import pandas as pd
import pytest
import tomli_w

from trainctl.diff.runs import EXACT, diff
from trainctl.runner import run
from trainctl.scenario.build import open_scenario
from trainctl.sumo.session import Sumo

FULLY_DISTRIBUTED = [
    "fully_distributed",
    "fully_distributed_extra_links",
    "fully_distributed_ratchet",
    "fully_distributed_loss",
    "three_tracks",
]


@pytest.mark.parametrize("name", FULLY_DISTRIBUTED)
def test_sumo_and_numeric_runs_agree_at_every_step(finished, name):
    coupled, numeric = finished(name).trains, finished(name, "numeric").trains
    assert len(coupled) == len(numeric)
    assert np.max(np.abs(coupled.position_m - numeric.position_m)) < 1e-6
    assert np.max(np.abs(coupled.speed_mps - numeric.speed_mps)) < 1e-9
    assert (coupled.track.astype(str) == numeric.track.astype(str)).all()
    assert (coupled.edge.astype(str) == numeric.edge.astype(str)).all()


@pytest.mark.parametrize("name", ["fully_distributed", "three_tracks"])
def test_sumo_says_where_the_trains_end(finished, name):
    fcd = pd.read_parquet(finished(name).folder / "sumo" / "fcd.parquet")
    last = fcd[fcd.timestep_time == fcd.timestep_time.max()].set_index("vehicle_id")
    assert last.vehicle_lane["2"].startswith("3_")
    assert last.vehicle_lane["5"].startswith("1_")
    assert set(last.index) == {"1", "2", "3", "4", "5", "6"}


@pytest.mark.parametrize("name", ["fully_distributed", "three_tracks"])
def test_sumo_log_holds_the_same_positions_at_the_same_times(finished, name):
    run = finished(name)
    fcd = pd.read_parquet(run.folder / "sumo" / "fcd.parquet")
    ours = run.trains.assign(train=run.trains.train.astype(str))
    both = ours.merge(fcd, left_on=["time_s", "train"], right_on=["timestep_time", "vehicle_id"])
    assert len(both) == len(ours)
    assert np.max(np.abs(both.position_m - both.vehicle_distance)) < 1e-6


def test_rows_every_ten_seconds_are_those_of_every_step(finished, typed, tmp_path):
    every = finished("three_tracks", **{"run.duration_s": 125})
    assert typed("run", "three_tracks", "--record-every", "10", "--set", "run.duration_s=125", "--out", "r", "-q")[0] == 0
    for table, time, last in (("trains.parquet", "time_s", [125]), ("sumo/fcd.parquet", "timestep_time", [])):
        a, b = (pd.read_parquet(folder / table).dropna(subset=time) for folder in (every.folder, tmp_path / "r"))
        assert b[time].unique().tolist() == [*range(0, 130, 10)][:13] + last
        extremes = [c for c in b if c.endswith("_j")]  # energies since the last row
        kept = a[a[time].isin(b[time])].drop(columns=extremes).reset_index(drop=True)
        pd.testing.assert_frame_equal(kept, b.drop(columns=extremes).reset_index(drop=True))


def test_drivers_of_sumo_who_decide_nothing_change_no_log(finished, monkeypatch, tmp_path, capfd):
    """All they would decide is overruled: what SUMO writes is the same to the last bit, on lines and where trains come and go."""
    nets.three_joins(tmp_path)
    (tmp_path / "joins.toml").write_text(tomli_w.dumps(nets.scenario("robust_constrained", 800)))
    odd = nets.scenario("robust_constrained", 90, run={"step_s": 0.3})  # a million seconds are no whole number of steps
    (tmp_path / "odd.toml").write_text(tomli_w.dumps(odd))
    for k, name in enumerate(("fully_distributed", str(tmp_path / "joins.toml"), str(tmp_path / "odd.toml"))):
        idle = finished(name)
        with monkeypatch.context() as patch:
            patch.setattr(Sumo, "idle", False)
            planning = run(open_scenario(name), tmp_path / f"planning_{k}", "sumo")
        report = diff(planning.folder, idle.folder, EXACT)
        assert report.lines() == []
        assert {"fcd", "tripinfo", "summary", "statistics", "collisions", "vehroute"} <= {t.table for t in report.tables}
    assert capfd.readouterr().err == ""  # SUMO's remarks on such drivers concern nobody


def test_nothing_but_the_plant_moved_a_train(finished):
    """SUMO reports no collision, no teleport and no warning in the default scenario."""
    run = finished("three_tracks")
    assert [e for e in run.events if e["kind"] == "sumo_warning"] == []
    assert "<collision " not in (run.folder / "sumo" / "collisions.xml").read_text()
    assert 'teleports total="0"' in (run.folder / "sumo" / "statistics.xml").read_text()


def test_changing_tracks_changes_the_graph(finished):
    events = [e for e in finished("fully_distributed").events if e["kind"] == "topology"]
    assert [(e["time_s"], e["edges"]) for e in events] == [
        (0.0, [["1", "2"], ["2", "3"], ["3", "4"], ["4", "6"]]),
        (1000.0, [["1", "3"], ["3", "4"], ["4", "5"], ["5", "6"]]),
    ]


def test_bounds_hold_and_the_formation_settles(finished):
    run = finished("fully_distributed")
    values = run.metrics
    for bound in ("spacing_lower_margin_m", "spacing_upper_margin_m", "speed_lower_margin_mps", "speed_upper_margin_mps"):
        assert values[f"bounds.{bound}"] > -1e-9
    assert values["bounds.input_lower_margin_mps2"] > 0
    assert values["bounds.input_upper_margin_mps2"] > 0
    error = (run.links.spacing_m - run.links.desired_m).abs().groupby(run.links.time_s).max()
    assert error[(error.index < 1000) & (error > 1.0)].index.max() < 999
    assert error[error > 1.0].index.max() < 1499
    assert [e for e in run.events if e["kind"] == "violation"] == []


def test_ratchet_lets_nothing_get_worse(finished):
    run = finished("fully_distributed_ratchet")
    new = run.links[(run.links.sender.astype(str) == "4") & (run.links.receiver.astype(str) == "5")].spacing_m.to_numpy()
    assert new[0] < 100.0
    assert new.min() >= new[0] - 1e-9
    violated = {e["who"] for e in run.events if e["kind"] == "violation"}
    assert violated == {"4-5"}


def test_lost_messages_break_no_bound(finished):
    run = finished("fully_distributed_loss")
    share = 1.0 - run.links.heard.mean()
    assert 0.08 < share < 0.12
    assert [e for e in run.events if e["kind"] == "violation"] == []


def test_units_stay_inside_their_limits(finished):
    """The default scenario is physical: 40 kN, 2.4 MW, 64 kN braking, 1.2 m/s2, couplers within 0.1 m, at every sub-step."""
    run = finished("three_tracks")
    units, trains = run.units, run.trains
    assert units.force_max_n.max() <= 40e3 + 1e-6
    assert units.force_min_n.min() >= -64e3 - 1e-6
    driven = units.dropna(subset=["force_n"])
    assert (driven.force_n * driven.speed_mps).max() <= 2.4e6 * (1 + 1e-9)
    acceleration = trains.speed_mps.groupby(trains.train.astype(str)).diff()
    assert acceleration.abs().max() < 1.2
    assert units.coupler_max_m.max() < 0.1
    assert units.coupler_min_m.min() > -0.1
    assert [e for e in run.events if e["kind"] == "violation"] == []
