"""Room at the place of a train that is to come: who is under it, and who would have to brake for it."""

from __future__ import annotations

import numpy as np
import pytest
from staged import target, view

from trainctl.railway.authority import View
from trainctl.railway.supervisor import TRAIN
from trainctl.scenario.build import open_scenario
from trainctl.signals import Floats
from trainctl.stages.places import Room

#: Train 0 is to come; train 1 is behind its place.
COMES, BEHIND = 0, 1


@pytest.fixture(scope="module")
def room():
    return Room(open_scenario("three_tracks", {"supervisor.mode": "on"}))


def behind(metres: float, other: int = COMES, v: float = 0.0) -> View:
    """What train 1 sees: the tail of another, so far ahead and so fast."""
    return view([-1] * 6, [np.inf] * 6, targets=target(BEHIND, metres, v, TRAIN, moving=v > 0.0, other=other))


def speeds(v: float) -> Floats:
    found = np.zeros(6)
    found[BEHIND] = v
    return found


def test_whoever_runs_on_until_it_comes_is_under_it(room):
    margin = room.rules.margin_m
    for v, metres, under in ((0.0, margin - 1.0, True), (0.0, margin + 2.0, False), (80.0, 81.0, True), (80.0, 200.0, False)):
        assert room.under(COMES, speeds(v), behind(metres), 1.0) is under, (v, metres)
    # the longer it takes to come, the farther they get
    assert not room.under(COMES, speeds(80.0), behind(200.0), 1.0) and room.under(COMES, speeds(80.0), behind(200.0), 3.0)


def test_who_stands_is_not_startled_and_who_runs_near_is(room):
    assert not room.startles(COMES, 0.0, speeds(0.0), behind(50.0))
    assert room.startles(COMES, 0.0, speeds(80.0), behind(50.0))
    assert not room.startles(COMES, 80.0, speeds(80.0), behind(2000.0, v=80.0))  # it runs as fast
    assert room.startles(COMES, 0.0, speeds(80.0), behind(2000.0, v=80.0))  # it was to, and comes at a stand
    assert not room.startles(COMES, 0.0, speeds(80.0), behind(50.0, other=2))  # that is another one's tail


def test_a_parked_train_comes_back_where_nobody_is(room):
    nobody = view([-1] * 6, [np.inf] * 6)
    assert room.returns(COMES, speeds(0.0), nobody)
    ahead = view([-1] * 6, [np.inf] * 6, targets=target(COMES, room.rules.margin_m - 0.5, 0.0, TRAIN, other=2))
    assert not room.returns(COMES, speeds(0.0), ahead)
    fouled = nobody._replace(fouling=np.arange(6) == COMES)
    assert not room.returns(COMES, speeds(0.0), fouled)
    beside = view([-1] * 6, [np.inf] * 6, targets=target(BEHIND, -1.0, 0.0, TRAIN, other=COMES))
    assert not room.returns(COMES, speeds(0.0), beside)
