"""When a sampled law is asked, what it is given, and what somebody outside may order instead."""

from __future__ import annotations

import shutil
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from staged import started

from trainctl.errors import LawError
from trainctl.loop import Loop
from trainctl.numeric import Numeric
from trainctl.record import checkpoint
from trainctl.record.checkpoint import Tape
from trainctl.scenario.build import open_scenario
from trainctl.signals import Demand, Disturbed
from trainctl.stages.control import Control

COUNTING = Path(__file__).parents[2] / "laws" / "counting.py"
#: control_period_s of three_tracks is 8 s
PERIOD = 8


@pytest.fixture
def counting(tmp_path):
    """Six trains under a law that counts."""
    shutil.copy(COUNTING, tmp_path)
    tables = {"extends": "three_tracks", "title": "counted", "controller": {"law": "counting.py"}, "bounds": {}}
    (tmp_path / "s.toml").write_text(tomli_w.dumps(tables))
    return open_scenario(str(tmp_path / "s.toml"))


class Asked:
    """A control stage, and its state from one step to the next."""

    def __init__(self, p):
        loop, _ = started(p)
        loop.step()  # sorts the trains
        s = loop.state
        self.p, self.control, self.own, self.formed, self.messages = p, loop.control, s.own, s.formed, s.messages
        self.demand, self.memory = loop.control.initial(), ()
        self.added = np.zeros(len(p.scenario.ids))
        self.commanded, self.resistance = np.full(len(p.scenario.ids), np.nan), loop.plant.believed_resistance

    def step(self, k, error=0.0):
        n = len(self.commanded)
        zero = np.zeros(n)
        acting = Disturbed(zero, zero, zero, zero + 1.0, zero + error)
        self.demand, self.formed, self.messages, self.memory = self.control.step(
            k,
            float(k),
            self.own,
            self.resistance,
            self.formed,
            self.messages,
            self.demand,
            self.memory,
            self.commanded,
            self.added,
            acting,
        )
        return self.demand.acceleration


def test_what_a_law_asks_for_is_held_over_its_control_period():
    asked = Asked(open_scenario("three_tracks"))
    first = asked.step(0).copy()
    asked.own[:, 1] += 0.5
    for k in range(1, PERIOD):
        np.testing.assert_array_equal(asked.step(k), first)
    assert (asked.step(PERIOD) != first).any()


def test_an_error_of_the_measured_positions_reaches_the_law():
    asked, misled = (Asked(open_scenario("three_tracks")) for _ in range(2))
    error = np.array([5.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    asked.step(0)
    misled.step(0, error)
    np.testing.assert_array_equal(asked.messages.sent[-1][1:], misled.messages.sent[-1][1:])
    assert (asked.messages.sent[-1][0] != misled.messages.sent[-1][0]).any()


def test_a_commanded_acceleration_takes_the_place_of_the_law_until_it_is_taken_back():
    asked = Asked(open_scenario("three_tracks"))
    free = asked.step(0).copy()
    asked.commanded[1] = -0.02
    given = asked.step(1)
    assert given[1] == -0.02
    np.testing.assert_array_equal(np.delete(given, 1), np.delete(free, 1))
    asked.commanded[1] = np.nan
    assert asked.step(PERIOD)[1] != -0.02


def test_a_law_s_own_clamps_hold_for_what_is_commanded():
    """What is left of a speed bound is for the whole control period."""
    p = open_scenario("robust_three_tracks", {"run.control_period_s": PERIOD, "controller.h_per_s": 0.1, "topology.weight": 0.001})
    asked = Asked(p)
    assert asked.control.clamps
    asked.commanded[:] = -100.0
    given, speed = asked.step(1), asked.own[p.leading, 1]
    np.testing.assert_allclose(given, (p.bounds.speed_lower - speed) / PERIOD, atol=1e-12)
    assert asked.demand.saturated.all()


def test_a_number_that_is_not_finite_ends_the_run(monkeypatch):
    p = open_scenario("three_tracks")
    asked = Asked(p)
    none = np.zeros(6, bool)
    monkeypatch.setattr(p.law, "demand", lambda *given: Demand(np.where(np.arange(6) == 2, np.nan, 0.0), none))
    with pytest.raises(LawError, match="not finite for train 3 at 8 s"):
        asked.step(PERIOD)


def test_a_continuous_law_is_not_asked_here():
    p = open_scenario("emu_finite_time")
    control = Control(p, p.radio)
    demand = control.initial()
    same = control.step(
        0, 0.0, p.own, None, None, None, demand, (), np.full(len(p.scenario.ids), np.nan), np.zeros(len(p.scenario.ids)), None
    )
    assert same == (demand, None, None, ())


# A law's own state


def test_a_law_gets_back_the_state_it_gave(counting):
    asked = Asked(counting)
    assert counting.remembers and not open_scenario("three_tracks").remembers
    lag = 80.0 - asked.own[counting.leading, 1]
    gain = counting.params.gain
    for number in range(3):
        for k in range(PERIOD):
            given = asked.step(number * PERIOD + k)
            assert asked.memory.times == number + 1  # between its instants it stays
            np.testing.assert_allclose(given, gain * (number + 1) ** 2 * lag)
    np.testing.assert_allclose(asked.memory.total, 3.0 * lag)


def test_the_state_lies_in_the_loop_s_and_in_every_checkpoint(counting, tmp_path):
    with closing(Tape(Numeric(counting.line), tmp_path)) as tape:
        loop = Loop(counting, tape, started(counting)[1])
        for _ in range(PERIOD + 3):
            loop.step()
        assert loop.state.memory.times == 2
        checkpoint.write(tmp_path, loop, {**checkpoint.identity(counting), "tape": tape.save()})
    saved = checkpoint.read(tmp_path, counting)
    with closing(Tape(Numeric(counting.line), tmp_path, saved)) as tape:
        again = Loop(counting, tape, started(counting)[1])
        checkpoint.restore(again, tape, saved)
        assert again.state.memory.times == 2 and type(again.state.memory) is type(loop.state.memory)
        assert again.state.memory.total.tobytes() == loop.state.memory.total.tobytes()
        again.step()
    with closing(Tape(Numeric(counting.line), tmp_path)) as tape:
        straight = Loop(counting, tape, started(counting)[1])
        for _ in range(PERIOD + 4):
            straight.step()
    assert straight.state.own.tobytes() == again.state.own.tobytes()


def test_a_state_may_be_a_bare_array(counting, monkeypatch):
    law = counting.law
    monkeypatch.setattr(law, "initial", lambda params, scene: np.zeros(6))
    monkeypatch.setattr(law, "demand", lambda c, own, leader, links, heard, s: (Demand(s.copy(), s < 0.0), s + 1e-3))
    asked = Asked(counting)
    for number in range(3):
        np.testing.assert_allclose(asked.step(number * PERIOD), 1e-3 * number)


def test_the_checks_for_laws_take_one_with_a_state(counting):
    from trainctl.testing_laws import Example, asked, disturbed, heard, links, scene, trains
    from trainctl.testing_laws import run as driven

    x = Example(counting.law, counting.params, 1.0)
    own, hearing = disturbed(), links(x)
    constants = x.law.constants(x.params, scene(x, own))
    given = asked(x, constants, trains(own), np.array([0.0, 80.0, 0.0, 0.0]), hearing, heard(x, constants, own, hearing))
    np.testing.assert_allclose(given.acceleration, x.params.gain * (80.0 - own[:, 1]))
    assert np.isfinite(driven(x, own, 5)).all()
