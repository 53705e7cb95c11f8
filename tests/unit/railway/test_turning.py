"""Where trains may turn, the way they have then, and who is in whose way when they do."""

from __future__ import annotations

import numpy as np
import pytest
from decisions import railway

from trainctl.railway import along, deadlock, interlocking, turning, zones
from trainctl.railway.turning import SHORT_M
from trainctl.railway.ways import turned
from trainctl.railway.ways import ways as laid

#: a, a junction of 6 m, b, and the same back.
LENGTH = np.array([300.0, 6.0, 200.0, 200.0, 6.0, 300.0])
TWIN = np.array([5, 4, 3, 2, 1, 0])
INTERNAL = np.array([False, True, False, False, True, False])
UP, DOWN = np.array([0, 1, 2]), np.array([3, 4, 5])


def yard(length: float, leg=UP, onward=DOWN, begin=1000.0) -> turning.Yard:
    begins = begin + np.concatenate([[0.0], np.cumsum(LENGTH[leg[:-1]])])
    return turning.yard(leg, begins, onward, TWIN, INTERNAL, LENGTH, length)


def test_a_way_is_cut_where_it_changes_its_direction():
    assert turning.legs([0, 1, 2, 3, 4, 5], {(2, 3)}) == [[0, 1, 2], [3, 4, 5]]
    assert turning.legs([2, 3, 2, 3], {(2, 3), (3, 2)}) == [[2], [3], [2], [3]]
    assert turning.legs([0, 1], {(2, 3)}) == [[0, 1]]


def test_all_of_a_train_is_on_track_it_runs_back_over():
    """On b; or with its rear on a, where the way back is long enough for SUMO; never with its rear inside the junction."""
    short = yard(50.0)
    assert short.places.shape == (1, 2) and short.places[0] == pytest.approx([1356.0, 1506.0 - SHORT_M])
    assert not short.holds(1355.0) and short.holds(1356.0) and short.holds(1500.0) and not short.holds(1506.0)
    ways = {"back": np.array([3, 4, 5, 0, 1]), "twins": TWIN.copy()}
    long = turning.yard(UP, np.array([1000.0, 1300.0, 1306.0]), ways["back"], TWIN, INTERNAL, LENGTH, 220.0)
    # Its front is on b and its rear cannot come there; it goes on by the 6 m of the junction before it turns.
    assert long.places == pytest.approx(np.array([[1306.01, 1499.99]])) and turning.SPARE_M == 0.01
    assert not len(yard(220.0).places)  # two edges back, and three under the train: SUMO would not turn it
    assert not len(yard(200.0).places)  # 0.2 m short of the end it does not fit
    assert turning.inside(DOWN, 150.0, INTERNAL, LENGTH) == 0.0 and turning.inside(DOWN, 260.0, INTERNAL, LENGTH) == 6.0
    gap = turning.yard(UP, np.array([1000.0, 1300.0, 1306.0]), ways["back"], TWIN, INTERNAL, LENGTH, 50.0)
    assert (
        gap.holds(1343.0)
        and not gap.holds(1345.0)
        and not gap.holds(1353.0)
        and gap.next(1353.0) == 1356.0
        and gap.next(1507.0) == np.inf
    )
    assert not len(yard(50.0, onward=np.array([5])).places)  # the way back is another track


def test_it_brakes_as_soon_as_it_may_turn_and_stands_before_the_end():
    found = yard(50.0)
    assert found.aim(1100.0, 80.0, 2.0) == 1356.0 + 80.0
    assert found.aim(1400.0, 30.0, 2.0) == 1430.0
    assert found.aim(1400.0, 0.0, 2.0) == 1400.0
    assert found.aim(1355.9, 0.0, 2.0) == 1358.0  # not on the very verge
    assert found.aim(1400.0, 500.0, 2.0) == found.last == found.aim(1505.99, 3.0, 2.0)


def test_front_and_rear_change_places():
    start = np.array([1000.0, 0.0, 0.0, 70.0, 0.0, 0.0])
    before = laid([[0, 1, 2], [0]], start, LENGTH)
    after, row, place = turned(before, 0, 2, 1400.0, 50.0, DOWN, start, LENGTH)
    assert after.edge.tolist() == [3, 4, 5, 0] and after.begin.tolist() == [70.0, 270.0, 276.0, 1000.0]
    assert (row, place) == (0, 1506.0 - 1400.0 + 50.0) and after.first.tolist() == [0, 3, 4]
    again, row, place = turned(after, 0, row, 70.0 + place, 50.0, [2], start, LENGTH)
    assert (row, place) == (0, 94.0) and again.first.tolist() == [0, 1, 2]  # where it stood: 94 m on b
    _, row, place = turned(before, 0, 2, 1400.0, 250.0, DOWN, start, LENGTH)
    assert row == 2 and place == pytest.approx(106.0 + 250.0 - 206.0)  # a train of 250 m reaches back to a


def placed(net, trains):
    """Ways, rows, fronts and lengths of trains (way, edge, m on it, length)."""
    paths = [[net.number[e] for e in way.split()] for way, _, _, _ in trains]
    ways = laid(paths, np.zeros(len(net.length_m)), net.length_m)
    row = np.array([ways.first[i] + paths[i].index(net.number[e]) for i, (_, e, _, _) in enumerate(trains)])
    return ways, row, ways.begin[row] + [x for _, _, x, _ in trains], np.array([float(x) for *_, x in trains])


#: Single track t from a to a terminal, and the way out.
STUB = railway({"a": 800.0, "t": 1000.0, "T": 1000.0, "A": 800.0}, [("a", "t"), ("T", "A")], [("t", "T")])


@pytest.mark.parametrize(("mine", "other", "granted"), [(600.0, 900.0, True), (600.0, 620.0, False), (600.0, 400.0, False)])
def test_the_way_back_is_free_of_who_stands_deeper_in_the_terminal(mine, other, granted):
    """The first train, 100 m long, has turned with its rear ``mine`` from the beginning of t; the front of the second is at ``other``."""
    trains = [("T A", "T", 1000.0 - mine + 100.0, 100.0), ("a t", "t", other, 100.0)]
    ways, row, s, length = placed(STUB, trains)
    shared = zones.of(ways, along.net(STUB))
    asks, present = np.array([True, False]), np.array([False, True])
    state, _, _ = interlocking.request(shared, interlocking.none(), row, s, length, present, np.full(2, 100.0))
    _, ends, _ = interlocking.request(shared, state, row, s, length, present, np.full(2, 2000.0), 10.0, asks)
    assert bool(ends.room[0] > 0.0) is granted


def test_a_train_that_turns_needs_who_may_stand_behind_it():
    ways, row, s, length = placed(STUB, [("a t", "t", 700.0, 100.0), ("a t", "a", 500.0, 100.0)])

    def before(j, m, i, k):
        return (ways.begin[m] - s[j], j) < (ways.begin[k] - s[i], i)

    back = {i: [STUB.number["T"], STUB.number["A"]] for i in (0, 1)}
    net = along.net(STUB)
    stays = deadlock.standing(ways, net, row, s, length, 10.0, {0: -1, 1: int(ways.first[1]) + 1}, (), before, back)
    assert list(deadlock.needs(stays, 0)) == [] and 0 in set(deadlock.needs(stays, 1))
    assert deadlock.in_a_circle(stays, 1) == -1
    enters = deadlock.standing(ways, net, row, s, length, 10.0, {0: -1, 1: -1}, (), before, back)
    assert set(deadlock.needs(enters, 0)) == {1} and deadlock.in_a_circle(enters, 1) == 0
    leaves = deadlock.standing(ways, net, row, s, length, 10.0, {0: -1, 1: -1}, (), before)  # at the end of their ways
    assert deadlock.in_a_circle(leaves, 1) == -1


def test_track_that_trains_turn_back_over_is_exclusive():
    ways, *_ = placed(STUB, [("a t", "a", 500.0, 100.0)])
    net = along.net(STUB)
    assert zones.of(ways, net).begins.tolist() == [-1, -1]
    assert zones.of(ways, net, [STUB.number["T"]]).begins.tolist() == [-1, 1]
