"""With the supervisor on, whatever drives the trains and wherever they are sent, none runs into another one."""

from __future__ import annotations

import itertools
import json
from collections import Counter
from pathlib import Path

import nets
import numpy as np
import pytest
import tomli_w

import trainctl
from trainctl.runner import run
from trainctl.scenario.build import open_scenario

ORDERS = 25
LAWS = Path(__file__).parents[1] / "laws"

BROKEN_LAW = '''
"""A law that does not care: the first train always brakes, the others always pull."""

from numba import njit

from trainctl.controllers.emu_finite_time import *  # noqa: F403
from trainctl.controllers.emu_finite_time import CLOCK, MESSAGE, ORDER, WATCHED, Params, constants, message, watch  # noqa: F401


@njit(cache=False)
def demand(i, constants, leader, age, slot, own, estimate, correction, desired, heard, out):
    """Write full traction or full braking into ``out``."""
    for j in range(len(out)):
        out[j] = 1e6 if i > 0 else -1e6


def violations(params, scene):
    """None: it takes anything."""
    return []
'''


def events(folder):
    return [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]


def collisions(folder):
    told = [e for e in events(folder) if e["kind"] == "violation" and e["bound"] == "gap_m"]
    log = folder / "sumo" / "collisions.xml"
    return told + ([log.read_text()] if log.exists() and "<collision " in log.read_text() else [])


def adversary(style, rng, trains):
    """Accelerations [m/s2] without end: noise, bang-bang for 20 s each, everybody against the first, all by turns."""
    for k in itertools.count():
        if style == 0:
            yield rng.uniform(-5.0, 5.0, trains)
        elif style == 1:
            if k % 20 == 0:
                held = np.where(rng.random(trains) < 0.5, -10.0, 10.0)
            yield held
        elif style == 2:
            yield np.concatenate([[-5.0 if k % 90 < 45 else 5.0], np.full(trains - 1, 5.0)])
        else:
            yield np.where(np.arange(trains) % 2 == (k // 15) % 2, 8.0, -8.0)


def harassed(folder, seed, steps, backend="numeric", mode="on"):
    """A run in which an adversary drives every train and sends trains to other tracks."""
    rng = np.random.default_rng(seed)
    settings = {"run.duration_s": steps, "supervisor.mode": mode}
    with trainctl.Simulation.open("three_tracks", backend=backend, out=folder, **settings) as sim:
        for _, accelerations in zip(range(steps), adversary(seed % 4, rng, len(sim.trains)), strict=False):
            if rng.random() < 0.02:
                sim.reroute(str(rng.choice(sim.trains)), to_track=str(rng.integers(1, 4)))
            sim.command(dict(zip(sim.trains, accelerations.tolist(), strict=True)))
            sim.step()
    return folder


@pytest.mark.parametrize("seed", range(4))
def test_no_input_causes_a_collision(seed, tmp_path):
    folder = harassed(tmp_path / "run", seed, 250)
    assert collisions(folder) == []
    acted = [e for e in events(folder) if e["kind"] == "supervisor"]
    assert {e["reason"] for e in acted} & {"train", "acceleration", "switch"}


def test_in_sumo_too(tmp_path):
    assert collisions(harassed(tmp_path / "run", 1, 200, "sumo")) == []


@pytest.mark.parametrize("mode", ["off", "monitor"])
def test_without_it_the_same_inputs_collide(mode, tmp_path):
    folder = harassed(tmp_path / "run", 2, 250, mode=mode)
    assert collisions(folder)
    assert any(e["kind"] == "supervisor" for e in events(folder)) == (mode == "monitor")


def sent_about(folder, seed, orders=ORDERS, backend="numeric", steps=1000):
    """A run under its own law in which trains are sent anywhere: too late, over switches behind, onto one another."""
    rng = np.random.default_rng(seed)
    with trainctl.Simulation.open("three_tracks", backend=backend, out=folder, **{
        "run.duration_s": steps, "supervisor.mode": "on",
    }) as sim:  # fmt: skip
        line = open_scenario("three_tracks").line
        when = Counter(rng.integers(0, steps - 100, orders).tolist())
        for k in range(steps):
            for _ in range(when[k]):
                train = str(rng.choice(sim.trains))
                place = sim.position_m[sim.trains.index(train)]
                near = [c.id for c in line.crossovers if -2000.0 < c.start_m - place < 15_000.0]
                if rng.random() < 0.5 or not near:
                    sim.reroute(train, to_track=str(rng.integers(1, 4)))
                else:
                    sim.reroute(train, crossover=str(rng.choice(near)))
            sim.step()
    return folder


def judged(folder, orders):
    """What became of the orders, each explained; the run's own two events aside."""
    told = events(folder)
    refused = [e for e in told if e["kind"] == "reroute_refused"]
    followed = [e for e in told if e["kind"] == "reroute"]
    assert all(len(e["reason"]) > 10 for e in refused)
    assert len(refused) + len(followed) == orders + len(open_scenario("three_tracks").scenario.event)
    return Counter(e["reason"].split()[0] for e in refused), len(followed)


@pytest.mark.parametrize("seed", range(2))
def test_trains_may_be_sent_anywhere(seed, tmp_path):
    folder = sent_about(tmp_path / "run", seed)
    assert collisions(folder) == []
    refused, followed = judged(folder, ORDERS)
    assert refused
    assert followed > 2


def test_a_law_that_does_not_care(tmp_path):
    """A continuous law: the step is tried, and where it goes too far repeated with the forces the supervisor allows."""
    (tmp_path / "broken.py").write_text(BROKEN_LAW)
    law = str(tmp_path / "broken.py")
    settings = {"run.duration_s": 200, "controller": {"law": law}, "run.record_every_s": 10.0}
    for mode, safe in (("on", True), ("off", False)):
        prepared = open_scenario("emu_force_limits", {**settings, "supervisor.mode": mode})
        assert (collisions(run(prepared, tmp_path / mode, "numeric").folder) == []) is safe


@pytest.mark.campaign
def test_200_adversarial_runs(tmp_path):
    for seed in range(200):
        backend = "sumo" if seed % 20 == 0 else "numeric"
        assert collisions(harassed(tmp_path / str(seed), seed, 400, backend)) == [], seed


@pytest.mark.campaign
def test_1000_reroute_orders(tmp_path):
    total = Counter()
    for seed in range(1000 // ORDERS):
        folder = sent_about(tmp_path / str(seed), seed, backend="sumo" if seed % 5 == 0 else "numeric")
        assert collisions(folder) == [], seed
        refused, followed = judged(folder, ORDERS)
        total += refused + Counter(followed=followed)
    print(dict(total))


@pytest.mark.parametrize("plant", ["coupled_units", "actuated_units"])
def test_nobody_inches_forward_within_its_steps(tmp_path, plant):
    """A law that pulls and brakes within a step of 10 s shows no speed at its ends, and must not creep into the train ahead."""
    line = {"name": "one", "tracks": ["1"], "length_m": 30_000.0, "speed": [[0.0, 30.0]]}
    (tmp_path / "one.toml").write_text(tomli_w.dumps(line))
    machine = nets.TYPE | {"units": 2, "unit_length_m": 50.0, "c0_n_per_kg": 0.01}
    machine |= {"actuator_rate_per_s": 5.0} if plant == "actuated_units" else {}
    scenario = {
        "schema_version": 1, "title": "inching", "run": {"duration_s": 1500, "step_s": 10.0, "sub_step_s": 0.05},
        "network": {"line": "one.toml"}, "plant": {"kind": plant}, "reference": {"speed_mps": 10.0},
        "controller": {"law": str(LAWS / "hostile_units.py"), "style": "inching", "every_m": 100.0, "big_n": 1e6},
        "topology": {"spacing_m": 1000.0, "communication_period_s": 10.0},
        "supervisor": {"mode": "on", "margin_m": 20.0, "emergency_mps2": 0.5, "service_mps2": 0.4},
        "train_type": {"t": machine},
        "train": [{"id": str(k), "type": "t", "track": 1, "position_m": x, "speed_mps": 0.0} for k, x in ((1, 2000.0), (2, 1700.0))],
    }  # fmt: skip
    (tmp_path / "s.toml").write_text(tomli_w.dumps(scenario))
    done = run(open_scenario(str(tmp_path / "s.toml")), tmp_path / "out", "numeric")
    rows = done.trains[done.trains.train == "2"]
    assert rows.position_m.iloc[-1] > 1750.0  # it does come nearer, and is let do so
    assert rows.gap_m.min() > 19.9
    assert rows.position_m.iloc[-1] == pytest.approx(rows.position_m.iloc[-30], abs=1e-6)
