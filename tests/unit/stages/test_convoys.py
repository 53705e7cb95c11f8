"""Who couples and who does not, on scenarios that are prepared but not run."""

from __future__ import annotations

import nets
import numpy as np
import pytest
from staged import Told, around, chained, prepared, side_by_side, target, view

from trainctl.railway.supervisor import SWITCH, TRAIN, Limits
from trainctl.signals import POSITION, SPEED
from trainctl.stages.convoys import APART_S, ASK_AGAIN_S, Convoys, led
from trainctl.stages.traffic import Traffic


@pytest.fixture(scope="module")
def p(line):
    return prepared(line, "fully_distributed")


def test_a_formation_keeps_to_speeds_its_law_takes(p):
    """Assumption 2.4 of the fully distributed law, solved for the reference speed by hand."""
    period, bounds = 5.0, p.bounds
    resistance = p.consists.train_davis()[0]
    f, F = (float(resistance @ [1.0, v, v * v]) for v in (bounds.speed_lower[0], bounds.speed_upper[0]))
    assert p.band[0] == pytest.approx(38.0 - (f + 1.0) * period, abs=0.06)
    assert p.band[1] == pytest.approx(31.0 + (1.0 - F) * period, abs=0.06)


def test_a_law_without_least_speed_follows_down_to_a_stand(line):
    assert prepared(line, "emu_finite_time").band[0] == 0.0


def test_nothing_but_a_chain_counts_as_led():
    assert not led(np.full(4, -1)).any()
    assert led(np.array([-1, 0, -1, -1])).tolist() == [True, True, False, False]


class Pair:
    """The first two of p's trains one behind the other, and what becomes of them in one instant."""

    def __init__(self, p, spacing=1200.0, speed=35.0, **seen):
        self.p, self.told, self.spacing = p, Told(), spacing
        n = len(p.scenario.ids)
        self.rest = n - 2
        self.rule = Convoys(p, self.told)
        self.state, self.formed = self.rule.initial()
        self.traffic = Traffic(p, self.told).initial()
        self.seen, self.own = side_by_side(p, [spacing] + [9000.0] * (n - 2), speed)
        self.seen = self.seen._replace(**seen)

    def view(self, **more):
        return view([-1, 0] + [-1] * self.rest, [np.inf, self.spacing] + [np.inf] * self.rest, **more)

    def step(self, t=0.0, soon=None, **more):
        at = around(self.view(**more), soon=soon)
        self.state, self.formed, self.own, self.seen, links = self.rule.step(
            t, self.seen, self.own, at, self.traffic, self.state, self.formed
        )
        if links is not None:
            self.formed = self.formed._replace(links=links)  # as ``topology`` does
        return links


def test_trains_that_are_right_for_it_couple(p):
    pair, ids = Pair(p), p.scenario.ids
    links = pair.step()
    assert pair.told.kinds() == [("couple", ids[1])] and pair.told[0][1]["spacing_m"] == 1200.0
    assert pair.formed.ahead.tolist() == [-1, 0] + [-1] * pair.rest
    assert sorted(zip(links.sender.tolist(), links.receiver.tolist(), strict=True)) == [(0, 1), (1, 0)]
    assert links.desired[links.receiver == 1] == 1200.0
    assert pair.step() is None  # nothing has changed


def test_what_a_step_was_given_stays_as_it_was(p):
    """State is a value."""
    pair = Pair(p)
    state, formed, own = pair.state, pair.formed, pair.own
    before = [a.copy() for a in (*state, formed.ahead, formed.offset, *formed.references.pace, own)]
    pair.step()
    for a, b in zip(before, (*state, formed.ahead, formed.offset, *formed.references.pace, own), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_formation_is_measured_along_one_way(p):
    """The second comes over another way, whose positions say nothing of the spacing."""
    pair = Pair(p)
    elsewhere = pair.own[p.leading[1] : p.leading[2], POSITION]
    elsewhere += 70_000.0
    pair.step()
    leading = pair.own[p.leading, POSITION]
    assert leading[0] - leading[1] == pytest.approx(1200.0) and pair.formed.offset[1] == pytest.approx(-70_000.0)
    assert pair.seen.position[1] == leading[1] and pair.formed.offset[0] == 0.0
    assert [part[1] for part in pair.formed.references.pace] == [part[0] for part in pair.formed.references.pace]  # one reference


@pytest.mark.parametrize("law", nets.LAWS)
def test_too_near_too_far_too_fast_do_not(line, law):
    p = prepared(line, law)
    far = p.driving.join_band_m + 1.0
    for spacing in (1200.0 - far, 1200.0 + far):
        pair = Pair(p, spacing)
        pair.step()
        assert pair.told == []
    pair = Pair(p)
    pair.own[p.leading[1] : p.leading[2], SPEED] += p.driving.join_band_mps + 0.1
    pair.step()
    assert pair.told == []


def test_trains_that_must_soon_run_slower_than_a_formation_can_do_not_couple(p):
    ids = p.scenario.ids
    for who in (0, 1):  # the one ahead, or the one that would couple
        for distance, speed, couples in ((500.0, 20.0, False), (2000.0, 20.0, False), (2200.0, 20.0, True), (500.0, 39.0, True)):
            pair = Pair(p)
            pair.step(limits=Limits(np.array([who]), np.array([distance]), np.array([speed])))  # 60 s ahead are 2100 m
            assert (pair.told.kinds() == [("couple", ids[1])]) is couples, (who, distance, speed)


def test_who_stops_soon_or_waits_does_not_couple(p):
    n = len(p.scenario.ids)
    for hinder in (
        lambda pair: pair.step(soon=np.arange(n) == 1),
        lambda pair: pair.step(targets=target(1, 500.0, 0.0, SWITCH)),
        lambda pair: pair.step(targets=target(0, 500.0, 0.0, SWITCH)),
    ):
        pair = Pair(p)
        hinder(pair)
        assert pair.told == []
    pair = Pair(p)
    pair.step(targets=target(1, 500.0, 30.0, TRAIN, moving=True, other=0))
    assert len(pair.told) == 1


def test_a_law_that_objects_is_asked_again_and_told_of_once(p, monkeypatch):
    monkeypatch.setattr(p.law, "violations", lambda params, scene: ["no"])
    pair, ids = Pair(p), p.scenario.ids
    for t in (0.0, 0.5 * ASK_AGAIN_S, ASK_AGAIN_S):
        pair.step(t)
    assert pair.told.kinds() == [("join_delayed", ids[1])] and pair.told[0][1]["reasons"] == ["no"]
    monkeypatch.undo()
    pair.step(1.5 * ASK_AGAIN_S)  # too early
    assert len(pair.told) == 1
    pair.step(2.0 * ASK_AGAIN_S)
    assert pair.told.kinds()[1:] == [("couple", ids[1])]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda pair: pair.seen.present.__setitem__(0, False), "the train ahead has left"),
        (lambda pair: setattr(pair, "view", lambda: view([-1] * (pair.rest + 2), [np.inf] * (pair.rest + 2))), "another way"),
        (lambda pair: pair.traffic.stopping.__setitem__(0, True), "one of the two stops or waits"),
        (lambda pair: setattr(pair, "view", lambda: view([-1, 2, -1] + [-1] * (pair.rest - 1), [np.inf, 600.0] + [np.inf] * pair.rest)),
         "another train is ahead now"),
        (lambda pair: pair.formed.references.pace.speed.__setitem__(slice(None), 32.0), "the reference falls below what the law can hold"),
    ],
)  # fmt: skip
def test_why_trains_part_and_that_they_stay_apart_for_a_while(p, change, why):
    pair, ids = Pair(p), p.scenario.ids
    pair.step()
    usual = pair.view
    change(pair)
    links = pair.step(10.0)
    assert pair.told.kinds() == [("couple", ids[1]), ("uncouple", ids[1])] and why in pair.told[1][1]["reason"]
    assert len(links.sender) == 0 and not pair.formed.led.any()
    pair.seen.present[:], pair.traffic.stopping[:], pair.view = True, False, usual
    pair.step(10.0 + APART_S - 1.0)
    assert len(pair.told) == 2
    pair.step(10.0 + APART_S)
    assert pair.told.kinds()[2:] == [("couple", ids[1])]


def test_a_train_alone_is_its_own_reference(p):
    pair = Pair(p, speed=36.5)
    n = len(p.scenario.ids)
    pair.formed = chained(pair.formed, [-1] * n)
    pair.view = lambda: view([-1] * n, [np.inf] * n)
    pair.step()
    np.testing.assert_array_equal(pair.formed.references.pace.speed, 36.5)
    np.testing.assert_array_equal(pair.formed.references.pace.position, pair.seen.position)
