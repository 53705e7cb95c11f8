"""When orders are due, which way they take, and which are refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from staged import started

from trainctl.errors import InputError
from trainctl.railway import supervisor
from trainctl.scenario.build import open_scenario
from trainctl.scenario.events import Event
from trainctl.stages.orders import Orders, State


@pytest.fixture
def asked():
    """Orders of three_tracks, given one by one to trains anywhere."""
    return Asked()


class Asked:
    def __init__(self, supervised=True):
        self.p = open_scenario("three_tracks", {"supervisor.mode": "on"} if supervised else {})
        loop, self.told = started(self.p)
        self.orders, self.world = loop.orders, loop.world
        self.alone, self.line = np.full(6, -1), self.p.line

    def step(self, pending, t=0.0, speed=80.0, ahead=None, **where):
        seen = self.world.measure()._replace(**where)
        speeds, rules = np.full(6, speed), self.p.supervision
        stops_in = supervisor.way_to_stop(rules, self.p.assumed, speeds, np.zeros(6), 1.0, self.p.step_theta)
        return self.orders.step(t, seen, self.world.ways, speeds, lambda: stops_in, self.alone if ahead is None else ahead, pending)

    def order(self, **more):
        return self.orders.added(Event(kind="reroute", train="1", **more), State((), []))


def test_orders_of_the_scenario_come_by_time(asked):
    p = open_scenario("three_tracks")
    assert asked.orders.initial() == State((1, 2), [])
    late = tuple(e.model_copy(update={"time_s": t}) for e, t in zip(p.scenario.event, (50.0, 10.0), strict=True))
    later = replace(p, scenario=p.scenario.model_copy(update={"event": late}))
    assert Orders(later, asked.told).initial() == State((2, 1), [])
    with pytest.raises(ValueError, match="no such train"):
        asked.orders.added(Event(kind="reroute", train="9", to_track="3"), State((), []))


def test_orders_from_outside_lie_in_the_state(asked):
    """What a checkpoint holds is enough to follow them: numbers of the scenario's, tables of the others."""
    s = asked.orders.added(Event(kind="reroute", train="1", to_track="3", time_s=10.0), asked.orders.initial())
    assert s.pending == (1, 2, 3) and s.given == [{"kind": "reroute", "train": "1", "to_track": "3", "time_s": 10.0}]
    fresh = Asked()  # one that was never told
    s, [(train, _)] = fresh.step(State((3,), json.loads(json.dumps(s.given))), 10.0)
    assert (s.pending, train, fresh.told.kinds()) == ((), 0, [("reroute", "1")])


def test_time_place_gap_and_speed_are_waited_for(asked):
    front = float(asked.world.measure().position[0])
    number = asked.order(to_track="3", time_s=10.0)
    assert asked.step(number, 9.0) == (number, [])
    left, [(train, edges)] = asked.step(number, 10.0)
    assert (left.pending, train) == ((), 0) and edges[0] == asked.line.edges[asked.world.measure().edge[0]]
    assert asked.told.kinds() == [("reroute", "1")] and asked.told[0][1]["to_track"] == "3"
    for key, holds, fails in (
        ({"position_m": front + 1.0}, {"position": asked.world.measure().position + 1.0}, {}),
        ({"speed_below_mps": 80.0}, {"speed": 79.9}, {"speed": 80.0}),
    ):
        number = asked.order(to_track="3", **key)
        assert asked.step(number, **fails) == (number, [])
        assert asked.step(number, **holds)[0].pending == ()
    number, ahead = asked.order(to_track="3", gap_below_m=300.0), asked.alone.copy()
    assert asked.step(number) == (number, [])  # nobody is ahead
    ahead[0] = 1
    position, length = asked.world.measure().position, asked.p.consists.train_length()
    for gap, due in ((300.5, False), (299.5, True)):
        position[1] = position[0] + length[1] + gap
        assert (asked.step(number, ahead=ahead, position=position)[0].pending == ()) is due


def test_a_train_that_has_not_come_gets_no_order(asked):
    number = asked.order(to_track="3")
    assert asked.step(number, present=np.zeros(6, bool)) == (number, [])


def test_what_cannot_be_done_is_refused_once_with_the_reason(asked):
    crossover = asked.p.scenario.event[0].crossover
    start = asked.line.crossover[crossover].start_m
    seen = asked.world.measure()
    track = asked.line.tracks[int(seen.edge[0])]
    for key, move, words in (
        ({"to_track": track}, 0.0, "already"),
        ({"crossover": crossover}, start - 100.0 - seen.position[0], "is locked: 100.0 m ahead"),
    ):
        number = asked.order(**key)
        position = seen.position.copy()
        position[0] += move
        left, found = asked.step(number, position=position)
        assert (left.pending, found) == ((), [])
        kind, said = asked.told[-1]
        assert kind == "reroute_refused" and words in said["reason"] and said["order"] == number.pending[0]
    assert len(asked.told) == 2


def test_unsupervised_an_order_of_the_scenario_that_leads_nowhere_ends_the_run():
    asked = Asked(supervised=False)
    crossover, line = asked.p.scenario.event[0].crossover, asked.line
    beyond = line.crossover[crossover].start_m + 10_000.0
    seen = asked.world.measure()
    position, edge = seen.position.copy(), seen.edge.copy()
    for i in (0, 1):
        position[i], edge[i] = beyond, line.locate("1", beyond)[0]
    with pytest.raises(InputError, match=r"event\[1\]"):
        asked.step(State((1,), []), position=position, edge=edge)
    number = asked.order(crossover=crossover)
    left, found = asked.step(number, position=position, edge=edge)
    assert (left.pending, found) == ((), [])  # one from outside is refused
    assert asked.told.kinds() == [("reroute_refused", "1")]
