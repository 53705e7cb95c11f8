"""Who comes, stops and leaves, on scenarios that are prepared but not run."""

from __future__ import annotations

import nets
import numpy as np
import pytest
from staged import prepared, started

from trainctl.scenario.build import open_scenario
from trainctl.stages.traffic import SOON_S, Traffic


@pytest.fixture(scope="module")
def stops(tmp_path_factory):
    """One train that stops twice."""
    folder = tmp_path_factory.mktemp("stops")
    nets.net(folder, {"a": (0, 0), "b": (9000, 0)}, {"ab": ("a", "b")})
    halts = '<stop lane="ab_0" endPos="3000" duration="100"/><stop lane="ab_0" endPos="6000" duration="10" until="400"/>'
    nets.traffic(folder, nets.train("it", "ab", 0, halts))
    return prepared(folder, "robust_constrained")


def test_trains_that_are_placed_have_come_and_nobody_looks_where_nobody_protects():
    p = open_scenario("three_tracks")
    loop, told = started(p)
    s = loop.state.traffic
    assert s.came.all() and not s.left.any()
    speed = np.full(len(s.came), 80.0)
    s, at = loop.traffic.step(0.0, loop.world.ways, loop.world.measure(), speed, 0.0 * speed, s)
    assert at.view is None and at.entries == () and told == []


def test_trains_of_one_edge_come_one_by_one(line):
    p = prepared(line, "robust_constrained")
    traffic = Traffic(p, [])
    s, ids = traffic.initial(), p.scenario.ids
    assert [ids[i] for i in traffic.due(200.0, s)] == ["p.0", "q.0"]
    s.came[[ids.index("p.0"), ids.index("q.0")]] = True
    assert traffic.due(39.0, s) == []
    assert [ids[i] for i in traffic.due(40.0, s)] == ["p.1", "q.1"]
    assert traffic.missing(39.0, s) == [] and traffic.missing(80.0, s) == ["p.1", "q.1", "p.2", "q.2"]


def test_a_train_enters_when_the_one_before_has_gone_far_enough(line):
    p = prepared(line, "robust_constrained")
    loop, told = started(p)
    ids, leading = p.scenario.ids, p.leading
    first, second = ids.index("p.0"), ids.index("p.1")
    assert loop.state.traffic.came[first] and loop.state.traffic.entering[first]
    loop.step()
    assert told.kinds()[0] == ("depart", "p.0") and not loop.state.traffic.entering[first]
    for _ in range(2):  # the same question twice gets the same answer: nothing is remembered but in the state
        for metres, enters in ((300.0, False), (1300.0, True)):
            seen = loop.world.measure()
            seen.position[first] += metres
            told.clear()
            speed = loop.state.own[leading, 1].copy()
            before = loop.state.traffic
            s, at = loop.traffic.step(40.0, loop.world.ways, seen, speed, 0.0 * speed, before)
            assert (second in [i for i, _ in at.entries]) is enters is bool(s.came[second]), metres
            assert not before.came[second]
            assert bool(s.entering[second]) is enters and told == []
            if enters:
                assert dict(at.entries)[second] == speed[second] > 30.0
                seen.present[second] = True
                after = loop.traffic.departures(41.0, seen, speed, s)
                (_, event), *more = told
                assert (event["train"], event["delay_s"], event["speed_mps"]) == ("p.1", 1.0, speed[second]) and not more
                assert not after.entering[second]
            else:
                assert at.kept_out[second] == first


def test_a_train_that_is_gone_has_arrived_once(line):
    loop, told = started(prepared(line, "robust_constrained"))
    s, seen = loop.state.traffic, loop.world.measure()
    s = s._replace(entering=np.zeros_like(s.entering))  # they have been seen
    told.clear()
    came = np.flatnonzero(s.came)
    gone = seen._replace(present=np.zeros_like(seen.present))
    after = loop.traffic.arrivals(7.0, gone, s)
    assert [(kind, e["train"], e["time_s"]) for kind, e in told] == [("arrive", loop.p.scenario.ids[i], 7.0) for i in came]
    assert after.left.tolist() == s.came.tolist() and not s.left.any()
    assert loop.traffic.arrivals(8.0, gone, after) is after and len(told) == len(came)


def test_stops_are_reached_kept_and_left(stops):
    loop, told = started(stops)
    loop.step()  # SUMO and its stand-in have a train from the step after its entry
    told.clear()
    first, second = stops.roster.stops[0]

    def at(t, place, speed, s, overrun=0.0):
        seen = loop.world.measure()._replace(position=np.array([place]))
        return loop.traffic.step(t, loop.world.ways, seen, np.array([speed]), np.array([overrun]), s)

    braking, v = 0.5 * 20.0**2 / loop.p.driver_rules.service_mps2, 20.0
    s, far = at(10.0, first.place - 2500.0, v, loop.state.traffic)
    assert far.stops[0].tolist() == [0] and far.stops[1].tolist() == [2500.0] and not far.soon[0] and not s.stopping[0]
    _, near = at(10.0, first.place - 2500.0, v, loop.state.traffic, overrun=40.0)
    assert near.stops[1].tolist() == [2460.0]  # what acts late has less room
    s, near = at(20.0, first.place - braking - 0.9 * v * SOON_S, v, s)
    assert near.soon[0] and not s.stopping[0]
    s, _ = at(60.0, first.place - braking - 100.0, v, s)
    assert s.stopping[0] and told == []
    s, standing = at(90.0, first.place - 1.0, 0.0, s)
    assert s.standing[0] and s.stands_until[0] == 190.0 and standing.stops[0].tolist() == []
    before = s
    s, _ = at(189.0, first.place - 1.0, 0.0, s)
    assert s.standing[0] and told.kinds() == [("stop_reached", "it")]
    s, on = at(190.0, first.place - 1.0, 0.0, s)
    assert told.kinds()[1:] == [("stop_left", "it")] and s.next_stop[0] == 1 and not s.standing[0]
    assert on.stops[1].tolist() == [3001.0] and before.standing[0] and before.next_stop[0] == 0
    s, _ = at(300.0, second.place, 0.0, s)
    assert s.stands_until[0] == 400.0  # until is later than 10 s
    s, _ = at(400.0, second.place, 0.0, s)
    assert s.next_stop[0] == 2 and loop.traffic.stop_of(0, s) is None and not s.stopping[0]
    s, none = at(401.0, second.place, 0.0, s)
    assert none.stops[0].tolist() == []
