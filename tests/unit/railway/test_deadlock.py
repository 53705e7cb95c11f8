"""Who needs whom to go first, by hand, and how the time of the test grows."""

from __future__ import annotations

import numpy as np
import pytest
from decisions import Railway, railway

from trainctl.railway import along, deadlock
from trainctl.railway.ways import ways as laid

#: Single track s between two ways in and out, and a loop track beside each end.
LINE = railway(
    {"a": 500.0, "s": 1000.0, "b": 500.0, "c": 500.0, "S": 1000.0, "d": 500.0},
    [("a", "s"), ("s", "b"), ("c", "S"), ("S", "d")], [("s", "S")],
)  # fmt: skip


def standing(net: Railway, trains: list[tuple[str, str, float, float]], limits: list[str], turns=(), clearance=10.0):
    """Trains as (way, edge, m on it, length); ``limits`` name the edge each may not enter, "": it leaves."""
    paths = [[net.number[e] for e in way.split()] for way, _, _, _ in trains]
    ways = laid(paths, np.zeros(len(net.length_m)), net.length_m)
    row = np.array([ways.first[i] + paths[i].index(net.number[e]) for i, (_, e, _, _) in enumerate(trains)])
    s = ways.begin[row] + np.array([x for _, _, x, _ in trains])
    at = {i: -1 if not e else int(ways.first[i]) + paths[i].index(net.number[e]) for i, e in enumerate(limits)}
    rows = [(i, int(ways.first[i]) + paths[i].index(net.number[e]), others) for i, e, others in turns]

    def before(j, m, i, k):
        return (ways.begin[m] - s[j], j) < (ways.begin[k] - s[i], i)

    length = np.array([x for _, _, _, x in trains])
    return deadlock.standing(ways, along.net(net), row, s, length, clearance, at, rows, before)


def test_trains_that_stand_clear_of_each_other_need_nobody():
    here = standing(LINE, [("a s b", "a", 400, 100), ("c S d", "c", 400, 100)], ["s", "S"])
    assert not list(deadlock.needs(here, 0)) and not list(deadlock.needs(here, 1))
    assert deadlock.in_a_circle(here, 0) == -1


def test_a_tail_on_single_track_is_in_the_way_of_the_other_direction():
    trains = [("a s b", "s", 900, 100), ("c S d", "c", 400, 700)]
    here = standing(LINE, trains, ["", "S"])
    assert not list(deadlock.needs(here, 1))  # the first will leave
    net = railway(
        {"a": 500.0, "s": 1000.0, "b": 300.0, "t": 900.0, "e": 500.0, "c": 500.0, "T": 900.0, "f": 300.0, "S": 1000.0, "d": 500.0},
        [("a", "s"), ("s", "b"), ("b", "t"), ("t", "e"), ("c", "T"), ("T", "f"), ("f", "S"), ("S", "d")],
        [("s", "S"), ("t", "T")],
    )  # fmt: skip
    for length, shut in ((250.0, False), (350.0, True)):
        both = [("a s b t e", "s", 900, length), ("c T f S d", "c", 400, 100)]
        here = standing(net, both, ["t", "T"])
        assert (0 in set(deadlock.needs(here, 1))) is shut
        assert deadlock.in_a_circle(here, 0) == -1
        # The other one stands in the loop beside it with its tail on what the first needs: now each needs the other.
        both[1] = ("c T f S d", "T", 800, length)
        here = standing(net, both, ["t", "S"])
        assert (deadlock.in_a_circle(here, 0) == 1) is shut


def test_who_stands_behind_another_may_shut_what_lies_behind_it():
    net = railway(
        {"a": 500.0, "s": 1000.0, "b": 600.0, "t": 900.0, "c": 500.0, "S": 1000.0, "d": 500.0},
        [("a", "s"), ("s", "b"), ("b", "t"), ("c", "S"), ("S", "d")], [("s", "S")],
    )  # fmt: skip
    trains = [("a s b t", "b", 500, 300), ("a s b t", "s", 100, 400), ("c S d", "c", 400, 100)]
    here = standing(net, trains, ["t", "", "S"])  # the second has been let through, but the first has not
    assert set(deadlock.needs(here, 1)) == {0} and set(deadlock.needs(here, 2)) == {1}
    trains[1] = ("a s b t", "s", 100, 200)
    here = standing(net, trains, ["t", "", "S"])
    assert not set(deadlock.needs(here, 2))  # now it fits behind


def test_a_turn_at_a_join_is_a_need():
    net = railway({"a": 500.0, "b": 500.0, "m": 500.0}, [("a", "m"), ("b", "m")], [])
    here = standing(net, [("a m", "a", 400, 100), ("b m", "b", 300, 100)], ["", ""], [(0, "m", [1])])
    assert set(deadlock.needs(here, 0)) == {1} and not set(deadlock.needs(here, 1))
    here = standing(net, [("a m", "a", 400, 100), ("b m", "b", 300, 100)], ["", ""], [(0, "m", [1]), (1, "m", [0])])
    assert deadlock.in_a_circle(here, 0) == 1


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_trains_before_one_stretch_stand_behind_each_other(order):
    places = np.array([480.0, 350.0, 200.0])[list(order)]
    trains = [("a s b", "a", float(x), 100.0) for x in places]
    here = standing(LINE, trains, ["s"] * 3)
    last = int(np.argmin(places))
    assert len(set(deadlock.needs(here, last))) == 2 and not set(deadlock.needs(here, int(np.argmax(places))))
