"""Who stands for its turn, how far others go until they do, and who waits since its way back is another's."""

from __future__ import annotations

import nets
import numpy as np
import pytest
from staged import prepared, started

from trainctl.stages import turns


@pytest.fixture(scope="module")
def shuttle(tmp_path_factory):
    """A train that turns in the terminal, and one that ends there."""
    folder = tmp_path_factory.mktemp("shuttle")
    body = nets.train("v", "ab bc -bc -ab", 0) + nets.train("w", "ab bc", 90, departPos="0")
    nets.terminals(folder, body, scale=0.5)
    return prepared(folder, "robust_constrained")


class Yard:
    """The turns of that net, with its trains at places on their first ways."""

    def __init__(self, p):
        self.loop, self.told = started(p)
        self.told.clear()
        self.p, self.turns, self.ways = p, self.loop.traffic.turns, self.loop.world.ways
        self.known = (np.zeros(2, np.int64), np.full(2, np.nan), np.full(2, -1))
        self.turns.changed(self.ways, self.known[0])
        self.requests = self.loop.state.traffic.requests
        self.stop = turns.stopping(p)

    def seen(self, v, w=None):
        """Train v (and w, if it is there) so far behind the beginning of its way."""
        places = self.ways.start + np.array([v, 150.0 if w is None else w])
        spans = zip(self.ways.first[:-1], self.ways.first[1:], places, strict=True)
        row = np.array([a + np.searchsorted(self.ways.begin[a:b], x, side="right") - 1 for a, b, x in spans])
        return self.loop.world.measure()._replace(
            position=places, row=row, edge=self.ways.edge[row], present=np.array([True, w is not None])
        )

    def wanted(self, v, speed, free=True):
        return self.turns.wanted(
            self.seen(v), np.array([speed, 0.0]), np.array([free, False]), np.zeros(2, bool), self.stop, 0.05
        )  # fmt: skip

    def step(self, t, seen):
        ordered = lambda ways, row: []  # noqa: E731
        self.requests, self.known, made = self.turns.step(
            t, [0], self.ways, seen, np.full(2, 3000.0), np.zeros(2, bool), self.requests, self.known, ordered
        )  # fmt: skip
        return made


@pytest.fixture
def yard(shuttle):
    return Yard(shuttle)


def test_a_train_is_to_stand_where_all_of_it_may_turn(yard):
    places, begin = yard.turns.yards[0].places, float(yard.ways.start[0])
    assert set(yard.turns.yards) == {0} and yard.turns.last_place(0) == places[-1, 1] and yard.turns.last_place(1) == np.inf
    free = float(places[-1, 0]) - begin
    stand, [(train, room)] = yard.wanted(free - 500.0, 20.0)
    assert (stand, train) == ([], 0) and 500.0 <= room < 520.0 + float(yard.stop(np.array([0]), np.array([20.0]))[0])
    assert yard.wanted(free + 10.0, 0.0) == ([0], [])
    stand, [(_, room)] = yard.wanted(free + 10.0, 5.0)  # as soon as it can
    assert stand == [] and room == pytest.approx(float(yard.stop(np.array([0]), np.array([5.0]))[0]))
    assert yard.wanted(free + 10.0, 0.0, free=False) == ([], [])  # it has a stop left


def test_it_turns_and_is_on_its_next_leg_once_its_way_back_is_its_own(yard):
    at = float(yard.turns.yards[0].places[-1, 0] - yard.ways.start[0]) + 10.0
    [turn] = yard.step(50.0, yard.seen(at))
    assert turn.train == 0 and [e for e in turn.edges if e[0] != ":"] == ["-bc", "-ab"]
    assert yard.known[0].tolist() == [1, 0] and yard.told.kinds() == [("turn", "v")]


def test_it_waits_while_another_is_on_its_way_back_and_that_is_told_once(yard):
    at = float(yard.turns.yards[0].places[-1, 0] - yard.ways.start[0]) + 10.0
    there = yard.seen(at, 800.0)
    bc, nobody = int(there.edge[0]), yard.requests
    yard.requests = nobody | {"stretches": [(1, bc, True)], "until": {"1": 3000.0}}  # w was let in behind it
    assert yard.step(50.0, there) == () and yard.step(51.0, there) == ()
    assert yard.told.kinds() == [("turn_delayed", "v")] and yard.told[0][1]["other"] == "w"
    assert yard.known[0].tolist() == [0, 0] and yard.known[2][0] == 1
    yard.requests = nobody | {"stretches": []}
    [turn] = yard.step(52.0, yard.seen(at))
    assert turn.train == 0 and yard.known[2][0] == -1
