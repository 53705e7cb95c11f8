"""The judge of hostile runs sees what it must see: it is told where trains are, and knows who lies upon whom."""

from __future__ import annotations

import nets
import numpy as np
import pytest
import tomli_w
from judge import Tracks, judge

from trainctl.scenario.build import open_scenario

LENGTH = 100.0


def prepared(folder, *routes):
    """Trains t0, t1, ... of 100 m on these routes of the net in ``folder``."""
    nets.traffic(folder, "".join(nets.train(f"t{k}", route, 0) for k, route in enumerate(routes)))
    (folder / "s.toml").write_text(tomli_w.dumps(nets.scenario("robust_constrained", 100)))
    return open_scenario(str(folder / "s.toml"))


def tracks(p, along, speed=0.0, step=1.0):
    """Fronts (K, n) [m] from the beginnings of the ways of the trains, at constant speed [m/s] for all."""
    place = np.array(along, float)
    speeds = np.full(place.shape, speed)
    ways = [np.array([p.rails.index[e] for e in route]) for route in p.roster.routes]
    return Tracks(np.arange(len(place)) * step, place, speeds, speeds, np.ones(place.shape, bool), ways, np.arange(len(ways)))


@pytest.mark.parametrize(("front", "overlaps"), [(400.0, False), (400.5, True), (450.0, True), (520.0, True), (600.5, False)])
def test_one_behind_the_other(tmp_path, front, overlaps):
    nets.station(tmp_path)
    p = prepared(tmp_path, "ab bc", "ab bc")
    found = judge(p, tracks(p, [[500.0, front]] * 2))
    assert bool(found.overlap) is overlaps
    assert found.overspeed is found.backwards is None


def test_a_train_that_runs_through_another_between_two_steps(tmp_path):
    nets.station(tmp_path)
    p = prepared(tmp_path, "ab bc", "ab bc")
    assert judge(p, tracks(p, [[500.0, 300.0], [500.0, 900.0]])).overlap
    assert judge(p, tracks(p, [[500.0, 300.0], [1300.0, 1150.0]])).overlap is None


def test_across_the_end_of_an_edge(tmp_path):
    nets.station(tmp_path)
    p = prepared(tmp_path, "ab bc", "ab bc")
    at = float(p.rails.length_m[p.rails.index["ab"]])
    assert judge(p, tracks(p, [[at + 50.0, at - 40.0]] * 2)).overlap
    assert judge(p, tracks(p, [[at + 50.0, at - 60.0]] * 2)).overlap is None


@pytest.mark.parametrize(("apart", "overlaps"), [(1.0, False), (-1.0, True)])
def test_a_train_that_turned_lies_where_it_lay_and_not_on_itself(tmp_path, apart, overlaps):
    nets.terminals(tmp_path, "")
    p = prepared(tmp_path, "ab bc", "ab bc")
    size = float(p.rails.length_m[p.rails.index["bc"]])
    begin = sum(float(p.rails.length_m[e]) for e in p.rails.way(["ab", "bc"])[:-1])
    out, back = (np.array(p.rails.way([edge])) for edge in ("bc", "-bc"))
    # the first one stands with 100 m .. 200 m of bc under it, and turns; the other one is behind it then
    along = np.array([[200.0, size - 100.0, begin + 100.0 - apart]] * 2)
    present = np.array([[True, False, True], [False, True, True]])
    speeds = np.zeros(along.shape)
    other = np.array(p.rails.way(["ab", "bc"]))
    found = judge(p, Tracks(np.arange(2.0), along, speeds, speeds, present, [out, back, other], np.array([0, 0, 1])))
    assert bool(found.overlap) is overlaps and found.backwards is None


@pytest.mark.parametrize(("apart", "overlaps"), [(1.0, False), (-1.0, True)])
def test_head_on_on_single_track(tmp_path, apart, overlaps):
    nets.single_track(tmp_path, "")
    p = prepared(tmp_path, nets.UP, nets.DOWN)
    size = float(p.rails.length_m[[p.rails.index[e] for e in p.roster.routes[1]]].sum())
    found = judge(p, tracks(p, [[3000.0, size - 3000.0 - apart]] * 2))
    assert bool(found.overlap) is overlaps


def test_on_the_level_crossing(tmp_path):
    nets.diamond(tmp_path)
    p = prepared(tmp_path, "w1 e1", "s1 n1")
    at = [float(p.rails.length_m[p.rails.index[e]]) + 5.0 for e in ("w1", "s1")]
    assert judge(p, tracks(p, [at] * 2)).overlap
    assert judge(p, tracks(p, [[at[0], at[1] - 50.0]] * 2)).overlap is None


def test_a_tail_behind_the_beginning_of_its_way(tmp_path):
    """It lies on the edge before, if there is one only."""
    nets.station(tmp_path)
    p = prepared(tmp_path, "bc", "ab bc")
    at = float(p.rails.length_m[p.rails.index["ab"]])
    assert judge(p, tracks(p, [[30.0, at - 50.0]] * 2)).overlap
    assert judge(p, tracks(p, [[30.0, at - 80.0]] * 2)).overlap is None


def test_overspeed_until_the_rear_has_left(tmp_path):
    nets.limits(tmp_path)
    p = prepared(tmp_path, "ab bc cd de ef")
    begin = float(p.rails.length_m[p.rails.index["ab"]])
    for front, speed, over in ((begin - 1.0, 39.0, False), (begin + 20.0, 34.55, False), (begin + 20.0, 34.65, True)):
        assert bool(judge(p, tracks(p, [[front]] * 2, speed)).overspeed) is over
    end = float(p.rails.length_m[[p.rails.index[e] for e in p.roster.routes[0][:3]]].sum())
    assert judge(p, tracks(p, [[end + 80.0]] * 2, 39.0)).overspeed
    assert judge(p, tracks(p, [[end + 120.0]] * 2, 39.0)).overspeed is None


def test_backwards(tmp_path):
    nets.station(tmp_path)
    p = prepared(tmp_path, "ab bc")
    assert judge(p, tracks(p, [[500.0], [499.9]])).backwards
    assert judge(p, tracks(p, [[500.0], [500.0]], -0.01)).backwards
    assert judge(p, tracks(p, [[500.0], [500.0]])).backwards is None
