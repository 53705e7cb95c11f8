"""Trains that are placed form by tracks; who changes track leaves and joins."""

from __future__ import annotations

import numpy as np
from staged import started

from trainctl.scenario.build import open_scenario
from trainctl.stages.slots import State
from trainctl.stages.traffic import nothing
from trainctl.topology import graph


class Sorted:
    """Trains of a scenario where they start, and one instant after the other."""

    def __init__(self, name="three_tracks"):
        self.p = open_scenario(name)
        loop, self.told = started(self.p)
        self.loop, self.rule = loop, loop.topology.rule
        self.state, self.formed = self.rule.initial()
        self.seen = loop.world.measure()

    def step(self, t=0.0):
        n = len(self.p.scenario.ids)
        s, formed, own, seen, links = self.rule.step(
            t, self.seen, self.loop.state.own, nothing(n), self.loop.state.traffic, self.state, self.formed
        )
        assert own is self.loop.state.own and seen is self.seen  # nobody is moved
        self.state, self.formed = s, formed if links is None else formed._replace(links=links)
        return links

    def onto(self, train, track):
        """Put a train on another track at the same place."""
        line, i = self.p.line, self.p.scenario.ids.index(train)
        self.seen.edge[i] = line.locate(track, float(self.seen.position[i]))[0]

    def groups(self):
        links = self.formed.links
        found = graph.components(len(links.slot), links.sender, links.receiver)
        return sorted(sorted(self.p.scenario.ids[i] for i in g) for g in found)


def test_trains_of_one_track_form_once_and_then_stay():
    trains = Sorted()
    links = trains.step()
    assert trains.groups() == [["1", "2", "3", "4", "6"], ["5"]] and trains.told == []
    np.testing.assert_array_equal(links.sender, trains.p.first_links.sender)
    assert trains.step(1.0) is None


def test_who_changes_track_leaves_and_joins():
    trains = Sorted()
    trains.step()
    before = trains.formed.formation.copy()
    trains.onto("2", "3")
    trains.onto("5", "1")
    assert trains.step(5.0) is not None
    assert trains.groups() == [["1", "3", "4", "5", "6"], ["2"]]
    assert trains.told.kinds() == [("leave", "2"), ("leave", "5"), ("join", "2"), ("join", "5")]
    assert [e["track"] for _, e in trains.told] == ["1", "2", "3", "1"]
    assert isinstance(trains.state, State) and not np.array_equal(before, trains.formed.formation)
    assert trains.step(6.0) is None


def test_trains_that_overtake_are_sorted_anew():
    trains = Sorted()
    trains.step()
    trains.seen.position[[0, 1]] = trains.seen.position[[1, 0]]
    links = trains.step()
    assert [i for i in links.order.tolist() if i < 2] == [1, 0] and trains.told == []


def test_a_law_that_needs_its_start_condition_lets_a_train_join_only_then(monkeypatch):
    trains = Sorted("emu_group_reroute")
    assert trains.p.law.JOIN == "start_condition"
    trains.step()
    ids = trains.p.scenario.ids
    own = [trains.p.line.tracks[e] for e in trains.seen.edge]
    other = next(t for t in trains.p.line.track_ids if t in own and t != own[-1])
    objects = [True]

    def violations(params, scene):
        together = len({*scene.links.receiver.tolist()} & {len(ids) - 1})
        return ["too near"] if objects[0] and together else []

    monkeypatch.setattr(trains.p.law, "violations", violations)
    trains.onto(ids[-1], other)
    trains.step(1.0)
    assert trains.told.kinds() == [("leave", ids[-1]), ("join_delayed", ids[-1])]
    assert trains.told[1][1]["reasons"] == ["too near"] and [ids[-1]] in trains.groups()
    trains.step(2.0)
    assert len(trains.told) == 2  # told once
    objects[0] = False
    assert trains.step(3.0) is not None and trains.told.kinds()[2:] == [("join", ids[-1])]
    assert [ids[-1]] not in trains.groups()
