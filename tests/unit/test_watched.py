"""Trains that drive themselves, here from a list: what is told of them, and what their motion costs."""

from __future__ import annotations

import json
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
import tomli_w

from trainctl.railway.ways import rerouted, ways
from trainctl.scenario.build import open_scenario
from trainctl.signals import GRAVITY, Observed, Seen
from trainctl.stages.record import Journal
from trainctl.watched import Watched

MASS, ROTATING, DAVIS, SLOPE = 400e3, 1.05, (0.01, 2e-4, 1e-5), 5e-3

#: The simulator sees the train ahead by so much nearer than positions along the ways tell, as where ways of unequal length meet [m].
NEARER = 7.0


class Listed:
    """A simulator whose trains are where a list says: position and speed of every train at every instant, NaN: not there."""

    def __init__(self, p, instants, planned=(0.0, 0.0), standing=(), parked=(False, False)):
        self.standing, self.parked = dict(standing), np.array(parked)
        self.line, self.instants, self.k, self.planned, self.routed = p.line, np.array(instants, float), 0, np.array(planned), []
        routes = [[p.line.index[e] for e in route] for route in p.roster.routes]
        self.ways = ways(routes, p.line.start_m, p.line.length_m)

    @property
    def stops(self):
        return self.standing.get(self.k, ("", ""))

    @property
    def over(self):
        return self.k >= len(self.instants) - 1

    def start(self):
        """It has started."""

    def measure(self):
        position, speed = self.instants[self.k].T
        present, first = ~np.isnan(position), self.ways.first
        row = first[:-1].copy()
        for i in np.flatnonzero(present):
            row[i] += np.searchsorted(self.ways.begin[first[i] : first[i + 1]], position[i], side="right") - 1
        together = present.all()
        ahead = np.array([-1, 0 if together else -1])
        spacing = np.array([np.nan, position[0] - position[1] - NEARER])
        return Observed(Seen(np.nan_to_num(position), self.ways.edge[row], row, present), speed, ahead, spacing)

    def route(self, train, edges):
        self.routed.append((self.k, train, edges))
        numbers = [self.line.index[e] for e in edges]
        self.ways = rerouted(self.ways, train, int(self.measure().seen.row[train]), numbers, self.line.start_m, self.line.length_m)

    def step(self):
        self.k += 1

    def close(self):
        """It has ended."""

    def messages(self):
        return []

    def collisions(self):
        return []


@pytest.fixture
def prepared(tmp_path):
    def of(extra="", **run):
        over = {"id": "over", "from": "1", "to": "2", "position_m": 15_000.0, "length_m": 500.0, "speed_mps": 20.0}
        line = {"name": "climb", "tracks": ["1", "2"], "length_m": 20_000.0, "speed": [[0.0, 40.0]], "crossover": [over]}
        (tmp_path / "climb.toml").write_text(tomli_w.dumps(line | {"gradient": [[0.0, 1000.0 * SLOPE]]}))
        kind = dict(zip(("c0_n_per_kg", "c1_ns_per_m_kg", "c2_ns2_per_m2_kg"), DAVIS, strict=True))
        tables = {
            "schema_version": 1, "title": "They drive", "run": {"duration_s": 4.0, "step_s": 1.0} | run, "network": {"line": "climb.toml"},
            "controller": {"law": "sumo", "block": "moving"}, "plant": {"kind": "coupled_units"}, "reference": {"speed_mps": 30.0},
            "topology": {"spacing_m": 1000.0}, "bounds": {"speed_upper_mps": 32.0, "input_upper_mps2": 2.5},
            "train_type": {"t": kind | {
                "units": 2, "unit_length_m": 50.0, "unit_mass_kg": MASS / 2, "rotating_mass_factor": ROTATING,
                "coupler_stiffness_n_per_m": 1e6,
            }},
            "train": [{"id": k + 1, "type": "t", "track": "1", "position_m": x, "speed_mps": 30.0} for k, x in enumerate((3000.0, 2000.0))],
        }  # fmt: skip
        (tmp_path / "s.toml").write_text(tomli_w.dumps(tables) + extra)
        return open_scenario(str(tmp_path / "s.toml"))

    return of


def watched(p, world, folder):
    """The run, its rows and its events."""
    journal = Journal(folder, p)
    run = Watched(p, world, journal)
    run.run()
    journal.close()
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    return run, pd.read_parquet(folder / "trains.parquet").astype({"train": str}), events


def force(v, after):
    """Per mass [m/s2]: what moves a train from one speed to the other."""
    return ROTATING * (after - v) + DAVIS[0] + DAVIS[1] * v + DAVIS[2] * v**2 + GRAVITY * SLOPE


def test_stops_that_the_simulator_makes_are_told(prepared, tmp_path):
    p, instants = prepared(), [[(3000.0, 0.0), (2000.0, 0.0)]] * 5
    standing = {1: ("west", ""), 2: ("west", ""), 3: ("east", "mid")}
    _, _, events = watched(p, Listed(p, instants, standing=standing), tmp_path)
    told = [(e["time_s"], e["kind"], e["train"], e["stop"]) for e in events if e["kind"].startswith("stop_")]
    assert told == [
        (1.0, "stop_reached", "1", "west"), (3.0, "stop_left", "1", "west"), (3.0, "stop_reached", "1", "east"),
        (3.0, "stop_reached", "2", "mid"), (4.0, "stop_left", "1", "east"), (4.0, "stop_left", "2", "mid"),
    ]  # fmt: skip


def test_the_force_of_a_row_is_told_from_the_step_that_follows(prepared, tmp_path):
    speeds = [30.0, 31.0, 31.0, 29.0, 29.5]
    instants = [[(3000.0 + 30.0 * k, v), (2000.0 + 30.0 * k, 30.0)] for k, v in enumerate(speeds)]
    p = prepared()
    _, rows, _ = watched(p, Listed(p, instants), tmp_path)
    one = rows[rows["train"] == "1"]
    wanted = [force(a, b) for a, b in pairwise(speeds)]
    np.testing.assert_allclose(one["input_mps2"], [*wanted, np.nan], rtol=1e-12)
    assert one["speed_mps"].tolist() == speeds
    assert rows.loc[rows["train"] == "2", ["spacing_m", "gap_m"]].to_numpy().tolist() == [[1000.0 - NEARER, 900.0 - NEARER]] * 5
    assert not (tmp_path / "units.parquet").exists() and "in_formation" not in rows


@pytest.mark.parametrize("every", [1.0, 2.0, 3.0])
def test_energies_are_those_since_the_last_row_and_balance(prepared, tmp_path, every):
    speeds = np.array([30.0, 31.0, 31.0, 26.0, 29.5])
    instants = [[(3000.0 + 30.0 * k, v), (2000.0, 0.0)] for k, v in enumerate(speeds)]
    p = prepared(record_every_s=every)
    _, rows, _ = watched(p, Listed(p, instants), tmp_path)
    one = rows[rows["train"] == "1"]
    wanted = sorted({*np.arange(0.0, 5.0, every).tolist(), 4.0})
    assert one["time_s"].tolist() == wanted
    at = np.array(wanted, int)
    gained = 0.5 * ROTATING * MASS * np.diff(speeds[at] ** 2)
    balance = one["traction_j"] - one["braking_j"] - one["resistance_j"] - one["gradient_j"]
    np.testing.assert_allclose(balance.to_numpy()[1:], gained, rtol=1e-9)
    assert one["traction_j"].iloc[0] == 0.0 and one["braking_j"].sum() > 0.0


def test_who_comes_late_leaves_early_or_never_comes_is_told(prepared, tmp_path):
    gone = (np.nan, np.nan)
    instants = [[(3000.0, 30.0), gone], [(3030.0, 30.0), (2000.0, 10.0)], [gone, (2010.0, 10.0)], [gone, gone]]
    p = prepared(duration_s=9.0)
    run, rows, events = watched(p, Listed(p, instants, planned=(0.0, 0.5)), tmp_path)
    assert [(e["time_s"], e["kind"], e["train"]) for e in events] == [
        (0.0, "depart", "1"), (1.0, "depart", "2"), (2.0, "arrive", "1"), (3.0, "arrive", "2"),
    ]  # fmt: skip
    assert events[1]["delay_s"] == 0.5 and run.k == 3  # nobody is left: it ends
    assert rows[["time_s", "train"]].to_numpy().tolist() == [[0.0, "1"], [1.0, "1"], [1.0, "2"], [2.0, "2"]]
    assert rows["input_mps2"].isna().tolist() == [False, True, False, True]  # nothing is known of a step that leads away
    other = tmp_path / "other"
    other.mkdir()
    run, _, events = watched(p, Listed(p, [[(3000.0, 30.0), gone]] * 3), other)
    assert events[-1] == {"time_s": 2.0, "kind": "not_entered", "trains": ["2"]} and run.outcome()["not_entered"] == 1


def test_bounds_and_bodies_are_watched_at_every_step(prepared, tmp_path):
    """Also at those that are not recorded."""
    second = [(2900.0 + 40.0 * k, v) for k, v in enumerate((29.0, 32.0, 33.0, 33.0, 33.0))]
    instants = [[(3000.0 + 30.0 * k, 30.0), at] for k, at in enumerate(second)]
    p = prepared(record_every_s=4.0)
    run, rows, events = watched(p, Listed(p, instants), tmp_path)
    told = [(e["time_s"], e["bound"], e["who"]) for e in events if e["kind"] == "violation"]
    assert told == [(0.0, "input_upper_mps2", "2"), (1.0, "gap_m", "1-2"), (2.0, "speed_upper_mps", "2")]
    assert sorted(set(rows["time_s"])) == [0.0, 4.0]
    outcome = run.outcome()
    assert (outcome["collisions"], outcome["checks_failed"]) == (1, ["collision"])
    assert set(outcome) == {
        "violations", "first_violation", "collisions", "overspeeds", "not_entered", "worst", "checks_failed",
    }  # fmt: skip


def test_a_reroute_is_ordered_where_its_switch_is_not_locked(prepared, tmp_path):
    """From 30 m/s these trains brake within 900 m and a step."""
    instants = [[(13_900.0 + 150.0 * k, 30.0), (12_000.0 + 150.0 * k, 30.0)] for k in range(5)]
    order = '[[event]]\nkind = "reroute"\ntrain = "{}"\ncrossover = "over"\ntime_s = {}\n'
    p = prepared(order.format(1, 2.0) + order.format(2, 1.0))
    world = Listed(p, instants)
    _, _, events = watched(p, world, tmp_path)
    told = [(e["time_s"], e["kind"], e["train"]) for e in events if e["kind"].startswith("reroute")]
    assert told == [(1.0, "reroute", "2"), (2.0, "reroute_refused", "1")]
    assert [(k, train) for k, train, _ in world.routed] == [(1, 1)]


@pytest.mark.parametrize("parked", [False, True])
def test_who_is_parked_is_in_nobodys_way(prepared, tmp_path, parked):
    """The rear of the train ahead at 2900 m, the one behind passes it."""
    p = prepared()
    instants = [[(3000.0, 0.0), (2860.0 + 30.0 * k, 30.0)] for k in range(5)]
    world = Listed(p, instants, standing=dict.fromkeys(range(1, 5), ("yard", "")), parked=(parked, False))
    _, _, events = watched(p, world, tmp_path)
    assert bool([e for e in events if e["kind"] == "violation" and e["bound"] == "gap_m"]) is not parked
    assert [e.get("parked", False) for e in events if e["kind"] == "stop_reached"] == [parked]
