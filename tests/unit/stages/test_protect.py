"""What the supervisor lets through, what it tries it with, and what it tells."""

from __future__ import annotations

import numpy as np
import pytest
from staged import Told, prepared, target, view

from trainctl.railway.supervisor import OPPOSING, SWITCH, TRAIN, Limits
from trainctl.scenario.build import open_scenario
from trainctl.signals import SPEED, Disturbed, Extremes, Motion
from trainctl.stages import plant
from trainctl.stages.driver import Driven
from trainctl.stages.protect import Protect

N = 6


@pytest.mark.parametrize(("lower", "upper", "emergency", "maximum"), [(-1.0, 1.0, 1.065, 1.0), (-3.0, 2.0, 3.065, 2.0)])
def test_the_supervisor_leaves_a_law_what_its_bounds_allow(line, lower, upper, emergency, maximum):
    bounds = {"speed_lower_mps": 31.0, "speed_upper_mps": 38.0, "input_lower_mps2": lower, "input_upper_mps2": upper}
    rules = prepared(line, "fully_distributed", bounds=bounds).supervision
    assert rules.greatest_mps2 == maximum
    assert rules.emergency_mps2 == pytest.approx(emergency, abs=1e-3)


def test_no_braking_is_relied_on_that_the_plant_does_not_give(line):
    assert prepared(line, "robust_constrained").supervision.emergency_mps2 == 1.0
    weak = {"kind": "point", "speed_lower_mps": 0.0, "speed_upper_mps": 38.0, "input_lower_mps2": -0.6, "input_upper_mps2": 1.0}
    bounds = {k: v for k, v in weak.items() if k != "kind"}
    rules = prepared(line, "robust_constrained", plant=weak, bounds=bounds).supervision
    assert rules.emergency_mps2 == rules.service_mps2 == 0.6


def test_a_stated_limit_of_the_supervisor_stays(line):
    rules = prepared(
        line, "fully_distributed", supervisor={"emergency_mps2": 0.8, "greatest_mps2": 0.3, "service_mps2": 0.5}
    ).supervision
    assert (rules.mode, rules.emergency_mps2, rules.greatest_mps2) == ("on", 0.8, 0.3)


class Track:
    """Trains of which each does what it is ordered, else 0.1 m/s2, and a record of what was tried."""

    def __init__(self, mode="on", disturbing=False):
        self.p = open_scenario("three_tracks", {"supervisor.mode": mode})
        self.told, self.tried = Told(), []
        self.protect = Protect(self.p, self.told, disturbing)
        self.own, self.acting = self.p.own.copy(), np.zeros(N, bool)
        self.own[:, SPEED] = 80.0
        zero = np.zeros(N)
        self.disturbed = Disturbed(zero + 1.0, zero + 2.0, zero + 3.0, zero + 1.5, zero + 0.25)
        n = len(self.own)
        self.state = plant.State(np.zeros((n, 1)), Extremes.fresh(N, n, 0), (), (), np.zeros((0, 0)), 0.0, -1)
        self.stands = np.zeros(N, bool)

    def over_the_step(self, ordered, disturbed, state, calm):
        self.tried.append((ordered.copy(), disturbed, state, calm))
        state.extremes.limited[:] += 1.0  # a plant reuses its arrays
        zero, no = np.zeros(N), np.zeros(N, bool)
        asked = np.where(np.isnan(ordered), 0.1, ordered)
        return plant.Moved(self.own, Motion(zero, zero, asked, asked, no, no, None, {}), None, state)

    def step(self, at, t=0.0):
        self.tried.clear()
        driven = Driven(np.full(N, np.nan), np.zeros(N, bool))
        moved, self.acting = self.protect.step(
            t,
            at,
            self.own,
            np.zeros(N),
            np.zeros(N),
            driven,
            self.stands,
            self.disturbed,
            self.state,
            self.acting,
            self.over_the_step,
        )
        return moved.motion.asked


def ahead(**more):
    return view([-1] * N, [np.inf] * N, **more)


NEAR = target(2, 2000.0, 0.0, TRAIN, other=1)


@pytest.mark.parametrize("mode", ["off", "on"])
def test_where_nobody_looks_or_protects_the_step_is_taken_as_it_is(mode):
    track = Track(mode)
    np.testing.assert_allclose(track.step(ahead(targets=NEAR) if mode == "off" else None), 0.1)
    [(_, disturbed, state, calm)] = track.tried
    assert disturbed is track.disturbed and state is track.state and not calm


def test_a_step_is_tried_without_what_disturbs_it_and_without_a_trace():
    track = Track(disturbing=True)
    np.testing.assert_allclose(track.step(ahead()), 0.1)
    (_, known, copy, calm), (_, disturbed, state, noisy) = track.tried
    assert calm and not noisy and disturbed is track.disturbed and state is track.state
    assert not known.position.any() and not known.speed.any() and not known.input.any() and (known.resistance == 1.0).all()
    np.testing.assert_array_equal(known.measurement, 0.25)  # the error of a position it does know: as that position
    assert copy is not state and (state.extremes.limited == 1.0).all()  # once: the trial was on a copy
    assert not track.acting.any()


def test_one_step_is_enough_where_nothing_disturbs_and_nothing_is_ahead():
    track = Track()
    track.step(ahead())
    assert len(track.tried) == 1


def test_it_acts_on_whom_it_must_and_tells_when_it_begins_and_ends():
    track, ids = Track(), open_scenario("three_tracks").scenario.ids
    given = track.step(ahead(targets=NEAR))
    rules = track.p.supervision
    assert given[2] == pytest.approx(-rules.emergency_mps2) and track.acting.tolist() == [False, False, True] + 3 * [False]
    np.testing.assert_allclose(np.delete(given, 2), 0.1)
    ordered = track.tried[-1][0]
    assert np.isnan(np.delete(ordered, 2)).all()  # the others are left to their law
    [(kind, said)] = track.told
    assert (kind, said["train"], said["reason"], said["other"], said["mode"]) == ("supervisor", ids[2], "train", ids[1], "on")
    assert said["room_m"] == 2000.0 and said["speed_mps"] == 80.0 and said["emergency"]
    track.step(ahead(targets=NEAR), 1.0)
    assert len(track.told) == 1
    track.step(ahead(), 2.0)
    assert track.told.kinds()[1:] == [("supervisor_released", ids[2])]


@pytest.mark.parametrize(("kind", "word"), [(SWITCH, "switch"), (OPPOSING, "opposing")])
def test_the_reason_is_told(kind, word):
    track = Track()
    track.step(ahead(targets=target(0, 1000.0, 0.0, kind)))
    assert track.told[0][1]["reason"] == word
    track = Track()
    track.step(ahead(limits=Limits(np.array([4]), np.array([300.0]), np.array([20.0]))))
    said = track.told[0][1]
    assert (said["train"], said["reason"], said["limit_mps"], said["distance_m"]) == ("5", "limit", 20.0, 300.0)


def test_the_better_of_following_and_of_keeping_the_join_clear_decides():
    track = Track()
    far = target(2, 9000.0, 0.0, SWITCH)
    track.step(ahead(targets=NEAR, clear=far))
    assert not track.acting.any()
    track.step(ahead(targets=far, clear=NEAR))
    assert not track.acting.any()
    track.step(ahead(targets=NEAR, clear=NEAR))
    assert track.acting[2]


def test_a_monitor_tells_the_same_and_lets_the_step_be():
    track = Track("monitor")
    np.testing.assert_allclose(track.step(ahead(targets=NEAR)), 0.1)
    assert track.acting[2] and track.told[0][1]["mode"] == "monitor" and len(track.tried) == 1


def test_a_train_that_stands_where_it_is_held_is_not_acted_on():
    track = Track()
    track.stands[2] = True
    track.step(ahead(targets=NEAR))
    assert track.told == [] and not track.acting.any()


class Reacting(Track):
    """Trains under a law that is evaluated within the step: it asks for something else in the step than in the trial."""

    def __init__(self, asks, **more):
        super().__init__(**more)
        self.protect.reacts, self.asks = True, asks

    def over_the_step(self, ordered, disturbed, state, calm):
        moved = super().over_the_step(ordered, disturbed, state, calm)
        asked = np.where(np.isnan(ordered), self.asks(ordered, disturbed, calm), ordered)
        return moved._replace(motion=moved.motion._replace(asked=asked))


def test_a_law_that_answers_what_disturbs_its_train_is_bounded_all_the_same():
    track = Reacting(lambda ordered, disturbed, calm: np.full(N, 0.1 if calm else 7.0), disturbing=True)
    track.disturbed = track.disturbed._replace(speed=np.zeros(N))
    given = track.step(ahead())
    np.testing.assert_allclose(given, track.p.supervision.greatest_mps2)
    assert track.acting.all() and len(track.tried) == 3
    assert all(state is not track.state for _, _, state, _ in track.tried)  # each was taken from where the train is


def test_what_disturbs_a_train_is_not_taken_for_its_law():
    """The kick counts where it leads beyond what is relied on, not the law's own answer within that."""
    track = Reacting(lambda ordered, disturbed, calm: np.full(N, 0.1), disturbing=True)
    track.disturbed = track.disturbed._replace(speed=np.full(N, -0.2))
    np.testing.assert_allclose(track.step(ahead()), 0.1)
    assert not track.acting.any() and len(track.tried) == 2


def test_a_law_that_answers_what_is_ordered_of_another_train_is_bounded_all_the_same():
    """Each train pulls once the one ahead is ordered anything: bounds spread, and all are ordered in the end."""

    def asks(ordered, disturbed, calm):
        return np.where(np.roll(~np.isnan(ordered), 1), 7.0, 0.1)

    track = Reacting(asks)
    track.disturbed = track.disturbed._replace(speed=np.zeros(N))
    given = track.step(ahead(targets=NEAR))
    rules = track.p.supervision
    assert given[2] == pytest.approx(-rules.emergency_mps2) and given.max() <= rules.greatest_mps2 + 1e-9
    assert track.acting.tolist() == [False, False, True, True, True, False] and len(track.tried) == 4
