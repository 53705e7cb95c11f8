"""Who is led round what is closed, who is not, and what is remembered of both."""

from __future__ import annotations

import nets
import numpy as np
import pytest
from staged import prepared, started

CLOSED = '<interval begin="100" end="200"><closingReroute id="bc"/></interval>'


@pytest.fixture(scope="module")
def closing(tmp_path_factory):
    """Two trains on a line whose middle is closed for a while; a slower way leads round it."""
    folder = tmp_path_factory.mktemp("closing")
    nodes = {"a": (0, 0), "b": (4000, 0), "c": (7000, 0), "d": (10000, 0), "e": (5500, 800)}
    nets.net(folder, nodes, {f"{x}{y}": (x, y) for x, y in ("ab", "bc", "cd", "be", "ec")})
    nets.traffic(folder, nets.train("x", "ab bc cd", 0) + nets.train("y", "ab bc cd", 60))
    (folder / "r.add.xml").write_text(f'<additional><rerouter id="r" edges="ab">{CLOSED}</rerouter></additional>')
    path, opens = folder / "a.sumocfg", "<input>"
    path.write_text(path.read_text().replace(opens, f'{opens}<additional-files value="r.add.xml"/>'))
    return prepared(folder, "robust_constrained")


class Asking:
    """The rerouters of that line, and train x so far along it."""

    def __init__(self, p):
        self.loop, self.told = started(p)
        self.told.clear()
        self.state, self.calls = self.loop.rerouters.initial(), 0

    def at(self, t, metres=1000.0, lock=500.0, busy=(), present=True):
        ways, seen = self.loop.world.ways, self.loop.world.measure()
        a, b = int(ways.first[0]), int(ways.first[1])
        row = a + int(np.searchsorted(ways.begin[a:b], ways.begin[a] + metres, side="right")) - 1
        position, rows = seen.position.copy(), seen.row.copy()
        position[0], rows[0] = ways.begin[a] + metres, row
        seen = seen._replace(position=position, row=rows, edge=ways.edge[rows], present=np.array([present, False]))

        def stops_in():
            self.calls += 1
            return np.full(2, lock)

        self.state, routes = self.loop.rerouters.step(t, seen, ways, np.full(2, 30.0), stops_in, self.state, busy)
        return [(i, [e for e in edges if e[0] != ":"]) for i, edges in routes]


@pytest.fixture
def asking(closing):
    return Asking(closing)


def test_a_train_is_led_round_while_the_edge_is_closed_and_not_before_or_after(asking):
    assert asking.at(99.0) == [] and asking.at(200.0) == [] and asking.told == []
    assert asking.at(100.0) == [(0, ["ab", "be", "ec", "cd"])]
    assert asking.told.kinds() == [("reroute", "x")] and asking.told[0][1]["closed"] == "bc"


def test_who_cannot_brake_before_the_switch_any_more_is_told_once_and_stays(asking):
    for t in (150.0, 151.0, 152.0):
        assert asking.at(t, metres=3800.0) == []
    assert asking.told.kinds() == [("reroute_refused", "x")] and "brake" in asking.told[0][1]["reason"]
    assert asking.at(153.0, metres=4800.0) == [] and asking.state.refused[0] == -1  # on another edge that is forgotten


def test_who_has_just_been_led_elsewhere_or_is_not_there_is_left_alone(asking):
    assert asking.at(150.0, busy=(0,)) == [] and asking.at(150.0, present=False) == [] and asking.told == []


def test_the_way_to_a_stand_is_asked_for_only_where_somebody_is_over_a_rerouter(asking):
    asking.at(150.0, metres=4800.0)
    assert asking.calls == 0
    asking.at(150.0)
    assert asking.calls > 0
