"""What is written of one instant; the last one is like any other."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import tomli_w
from staged import started

from trainctl.runner import run
from trainctl.scenario.build import open_scenario
from trainctl.signals import Extremes


def test_track_and_edge_of_a_row_are_of_one_place():
    """Where the world has the train now, not where it was sorted last."""
    p = open_scenario("fully_distributed")
    loop, told = started(p)
    loop.step()
    s, line = loop.state, p.line
    seen = loop.world.measure()
    other = next(t for t in line.track_ids if t != line.tracks[seen.edge[1]])
    seen.edge[1] = line.locate(other, float(seen.position[1]))[0]
    loop.record.step(1, 1.0, loop.world.ways, seen, seen, s.own, s.formed, s.demand, None, None, None, s.watch)
    row = told.row
    assert [line.track_ids[k] for k in row.track] == [line.tracks[e] for e in row.seen.edge]
    assert line.track_ids[row.track[1]] == other


def test_a_row_is_written_when_one_is_due_and_at_the_end():
    p = open_scenario("three_tracks", {"run.record_every_s": 5, "run.duration_s": 12})
    loop, told = started(p)
    assert [k for k in range(13) if loop.record.due(k)] == [0, 5, 10, 12]
    written = []
    for _ in range(12):
        told.row = None
        loop.step()
        written.append(told.row is not None)
    assert [k for k, w in enumerate(written) if w] == [0, 5, 10]
    told.row = None
    loop.end()
    assert told.row.time == 12.0 and told.row.motion is None


def test_an_alarm_is_raised_at_every_step_recorded_or_not_and_once():
    p = open_scenario("three_tracks", {"run.record_every_s": 5})
    loop, told = started(p)
    loop.step()
    s, seen = loop.state, loop.world.measure()
    own = s.own.copy()
    own[:, 1] = 100.0
    for k in (1, 2):
        loop.record.step(k, float(k), loop.world.ways, seen, seen, own, s.formed, s.demand, None, None, None, s.watch)
    alarms = [e for kind, e in told if kind == "violation" and e["bound"] == "speed_upper_mps"]
    assert [(e["time_s"], e["who"], e["value"]) for e in alarms] == [(1.0, i, 100.0) for i in p.scenario.ids]


def test_extremes_reach_the_row_and_begin_anew():
    p = open_scenario("three_tracks", {"run.record_every_s": 4, "run.duration_s": 9})
    loop, told = started(p)
    for k in range(1, 10):
        loop.step()
        x = loop.state.plant.extremes
        assert isinstance(x, Extremes) and np.isfinite(x.force_max).all()
        if k == 5:  # those of 0 .. 4 s have been taken
            assert told.row.time == 4.0
            assert (told.row.extremes.energy.sum(axis=1) > 2.0 * x.energy.sum(axis=1)).any()


@pytest.fixture(scope="module")
def whole(finished):
    return finished("merging", "numeric")


def told_of(run):
    return [(e["time_s"], e["kind"], e.get("train")) for e in run.events]


@pytest.mark.parametrize("what", ["track", "arrive", "couple", "uncouple"])
def test_the_last_row_is_that_of_a_longer_run(what, whole, tmp_path):
    """Also where a train changes track, leaves, couples or uncouples just then. What is applied from then on is missing."""
    trains = whole.trains.astype({"train": str, "track": str, "edge": str})
    if what == "track":
        rows = trains.sort_values(["train", "time_s"])
        changes = (rows.track != rows.track.shift()) & (rows.train == rows.train.shift())
        at = float(rows.time_s[changes].iloc[0])
    else:
        at = next(e["time_s"] for e in whole.events if e["kind"] == what)
    short = run(open_scenario("merging", {"run.duration_s": at}), tmp_path / "r", "numeric")
    last = short.trains.astype({"train": str, "track": str, "edge": str})
    known = [c for c in last.columns if c not in ("input_mps2", "saturated")]
    expected, found = (t[t.time_s == at][known].reset_index(drop=True) for t in (trains, last))
    pd.testing.assert_frame_equal(found, expected)
    links = [t[t.time_s == at].astype({"sender": str, "receiver": str}).reset_index(drop=True) for t in (short.links, whole.links)]
    pd.testing.assert_frame_equal(*links)
    usual = {"arrive", "couple", "uncouple", "topology", "stop_reached", "stop_left"}
    assert [e for e in told_of(short) if e[0] == at and e[1] in usual] == [
        e for e in told_of(whole) if e[0] == at and e[1] in usual
    ]
    assert what == "track" or any(e[:2] == (at, what) for e in told_of(short))


LENGTHS = {"1": 400.0, "2": 60.0, "3": 200.0}


def unequal(folder):
    """Three point trains of three lengths on one track."""
    train_type = {"unit_mass_kg": 320000.0, "c0_n_per_kg": 0.01, "c1_ns_per_m_kg": 0.0, "c2_ns2_per_m2_kg": 0.0}
    tables = {
        "schema_version": 1, "title": "Unequal trains", "run": {"duration_s": 3}, "network": {"line": "three_tracks"},
        "controller": {"law": "fully_distributed"}, "plant": {"kind": "point"}, "reference": {"speed_mps": 80.0},
        "bounds": {"speed_lower_mps": 75.0, "speed_upper_mps": 85.0, "input_lower_mps2": -11.0, "input_upper_mps2": 11.0},
        "topology": {"spacing_m": 2000.0, "lower_m": 500.0, "upper_m": 5000.0},
        "train_type": {name: train_type | {"unit_length_m": length} for name, length in LENGTHS.items()},
        "train": [
            {"id": int(name), "type": name, "track": 1, "position_m": 20000.0 - 2010.0 * k, "speed_mps": 80.0}
            for k, name in enumerate(LENGTHS)
        ],
    }  # fmt: skip
    (folder / "s.toml").write_text(tomli_w.dumps(tables))
    return open_scenario(str(folder / "s.toml"))


def test_the_gap_is_that_to_the_rear_of_the_train_ahead(tmp_path):
    trains = run(unequal(tmp_path), tmp_path / "run", "numeric").trains
    for _, row in trains.astype({"train": str}).groupby("time_s"):
        front, gap = row.set_index("train").position_m, row.set_index("train").gap_m
        assert np.isnan(gap["1"])
        np.testing.assert_allclose(
            [gap["2"], gap["3"]], [front["1"] - 400.0 - front["2"], front["2"] - 60.0 - front["3"]], atol=1e-9
        )
