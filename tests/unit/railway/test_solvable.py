"""Whether trains can all get out at all: what orders allow at sidings that are long enough and at shorter ones."""

from __future__ import annotations

import numpy as np
import pytest
from decisions import at_random, railway

from trainctl.railway import along
from trainctl.railway.solvable import Case, meets_itself, search
from trainctl.railway.ways import ways


def case(siding, lengths, orders=(), up=("l", "p", "r"), down=("-r", "q", "-l")):
    """A single track with a siding; trains ``u`` up and ``d`` down in turn; orders: edge, first, then."""
    made = railway(
        {"l": 2000.0, "-l": 2000.0, "p": siding, "q": siding, "r": 2000.0, "-r": 2000.0},
        [("l", "p"), ("p", "r"), ("-r", "q"), ("q", "-l")], [("l", "-l"), ("r", "-r")],
    )  # fmt: skip
    paths = [[made.number[e] for e in (up, down)[k % 2]] for k in range(len(lengths))]
    laid = ways(paths, np.zeros(6), made.length_m)
    rows = []
    for edge, first, then in orders:
        here = {made.number[edge], int(made.twin[made.number[edge]])}
        k, m = (laid.first[i] + next(r for r, e in enumerate(paths[i]) if e in here) for i in (then, first))
        rows.append((then, int(k), first, int(m)))
    length = np.array(lengths, float)
    return Case(laid, along.net(made), length.copy(), length, rows)


def test_without_orders_there_is_always_a_way():
    for siding in (600.0, 150.0):
        found = search(case(siding, [300.0, 320.0, 250.0, 300.0]))
        assert found.solution is True and found.left == ()


@pytest.mark.parametrize(("siding", "can"), [(600.0, True), (150.0, False), (320.0, True), (319.0, False)])
def test_who_is_to_meet_at_a_siding_must_fit_into_it(siding, can):
    """The one going up is to be first on the left, the other on the right: they must meet at the siding."""
    found = search(case(siding, [320.0, 320.0], [("l", 0, 1), ("r", 1, 0)]))
    assert found.solution is can
    assert found.left == (() if can else (0, 1))


def test_one_that_fits_is_enough_where_the_other_may_wait_outside():
    """Nobody needs to meet: the one that comes first on both sides runs through."""
    assert search(case(150.0, [320.0, 320.0], [("l", 1, 0), ("r", 1, 0)])).solution is True


def test_a_queue_may_reach_out_of_a_siding_while_the_one_ahead_can_still_leave():
    orders = [("l", 0, 1), ("l", 2, 1), ("r", 1, 0), ("r", 1, 2)]  # both going up are to wait for the one coming down
    for siding, can in ((700.0, True), (600.0, True), (319.0, False)):
        assert search(case(siding, [320.0, 320.0, 320.0], orders)).solution is can


def test_the_limit_of_effort_is_kept():
    crowd = case(700.0, [320.0] * 6, [("l", 0, 1), ("r", 1, 0), ("r", 3, 2), ("l", 2, 3)])
    whole = search(crowd)
    assert whole.solution is not None and whole.states > 3
    cut = search(crowd, 3)
    assert cut.solution is None and cut.states == 3 and cut.left


def test_a_train_longer_than_the_loop_it_turns_in_meets_itself():
    made = railway(
        {"s": 1000.0, "-s": 1000.0, "loop": 800.0, "x": 100.0}, [("s", "loop"), ("loop", "-s"), ("loop", "x")], [("s", "-s")]
    )
    laid = ways([[made.number[e] for e in way] for way in (["s", "loop", "-s"], ["s", "loop", "x"])], np.zeros(4), made.length_m)
    net = along.net(made)
    assert meets_itself(laid, net, np.array([900.0, 900.0])) == [(0, 2)]
    assert meets_itself(laid, net, np.array([799.0, 900.0])) == []


@pytest.mark.parametrize("seed", range(5))
def test_nets_of_chance_have_a_way_out(seed):
    plan = at_random(seed)
    laid = ways(plan.paths, np.zeros(len(plan.railway.length_m)), plan.railway.length_m)
    assert search(Case(laid, along.net(plan.railway), plan.length, plan.length, ())).solution is True
