"""Neighbours along ways, by hand and against what SUMO sees itself."""

from __future__ import annotations

import subprocess
from types import SimpleNamespace

import libsumo
import numpy as np
import pytest

from sumo_net import Rails
from sumo_net.build import netconvert
from trainctl.railway import along
from trainctl.railway import bodies as in_the_way
from trainctl.railway.ways import ways as laid

#: a and b join, then branch off to l and r; numbered as written.
A, B, M, L, R = range(5)
FORK = SimpleNamespace(
    length_m=np.array([1000.0, 1200.0, 2000.0, 800.0, 800.0]),
    before=[[], [], [A, B], [M], [M]],
    twin=np.full(5, -1),
    crossing=[[]] * 5,
)


def seen(net, trains, horizon=5000.0, order=None):
    """``trains``: (way, row, m on the edge, length)."""
    ways = laid([way for way, _, _, _ in trains], np.zeros(len(net.length_m)), net.length_m)
    row = np.array([ways.first[i] + t[1] for i, t in enumerate(trains)])
    s, length = ways.begin[row] + [t[2] for t in trains], np.array([t[3] for t in trains], float)
    return along.places(ways, along.net(net), row, s, length, np.ones(len(trains), bool), horizon, order)


def test_a_train_over_the_other_track_is_ahead_if_it_is_nearer_to_the_join():
    here = seen(FORK, [((A, M, L), 0, 400, 100), ((B, M, R), 0, 700, 100), ((A, M, R), 1, 50, 100)])
    found = along.ahead(here)
    assert found.train.tolist() == [1, 2, -1]
    assert found.spacing.tolist() == [100.0, 550.0, np.inf]
    assert along.behind(found).train.tolist() == [-1, 0, 1]
    tails = in_the_way.obstacles(here)
    assert (tails.room.tolist(), tails.train.tolist()) == ([0.0, 450.0, np.inf], [1, 2, -1])
    clear = in_the_way.obstacles(here, virtual=False)
    # The tail of 2 hangs back onto a, so it stands in the way of 0 before the join, and at the join for 1.
    assert (clear.room.tolist(), clear.sense.tolist()) == ([550.0, 500.0, np.inf], [1, 0, 0])


def test_a_tail_that_has_not_left_the_way_is_in_it_and_one_that_has_is_not():
    def room(depth):
        return in_the_way.obstacles(seen(FORK, [((A, M, L), 1, 1000, 100), ((A, M, R), 2, depth, 300)])).room[0]

    assert room(100.0) == 800.0
    assert room(299.0) == 999.0
    assert room(300.0) == np.inf
    assert along.ahead(seen(FORK, [((A, M, L), 1, 1000, 100), ((A, M, R), 2, 100, 300)])).train[0] == -1


def test_behind_a_tail_that_branches_off_the_next_body_is_told_and_behind_one_that_stays_none():
    trains = [((A, M, L), 1, 1000, 100), ((A, M, R), 2, 100, 300), ((A, M, L), 2, 400, 100), ((A, M, L), 2, 700, 100)]
    found = in_the_way.bodies(seen(FORK, trains))
    assert found.other[found.train == 0].tolist() == [1, 2]
    assert found.room[found.train == 0].tolist() == [800.0, 1300.0]
    assert found.sense.tolist() == [1] * 3
    assert found.train.tolist() == [0, 0, 2]


def test_a_body_on_the_twin_comes_the_other_way_and_one_across_blocks_the_edge():
    net = SimpleNamespace(
        length_m=np.array([500.0, 400.0, 400.0, 30.0, 30.0]), before=[[], [0], [], [1], []],
        twin=np.array([-1, 2, 1, -1, -1]), crossing=[[], [], [], [4], [3]],
    )  # fmt: skip
    way = (0, 1, 3)
    opposing = in_the_way.obstacles(seen(net, [(way, 0, 450, 100), ((2,), 0, 150, 100)]))
    assert (opposing.room[0], opposing.train[0], opposing.sense[0]) == (50 + 400 - 150, 1, -1)
    across = in_the_way.obstacles(seen(net, [(way, 0, 450, 100), ((4,), 0, 20, 100)]))
    assert (across.room[0], across.train[0], across.sense[0]) == (450.0, 1, 0)
    both_in = in_the_way.obstacles(seen(net, [(way, 2, 5, 100), ((4,), 0, 20, 100)]))
    assert both_in.room.tolist() == [-5.0, np.inf]  # the one that is deeper in goes on


def test_a_tail_behind_the_beginning_of_a_way_lies_on_the_edges_that_lead_there():
    follower, reaches_back = ((A, M, L), 1, 1000, 100), ((L,), 0, 50, 300)
    found = in_the_way.bodies(seen(FORK, [follower, reaches_back]), virtual=False)
    assert (found.train.tolist(), found.other.tolist(), found.room.tolist()) == ([0], [1], [2000 - 250 - 1000])
    assert (found.sense.tolist(), found.sure.tolist()) == ([1], [True])
    # Two lead to m: it may lie on a or on b, and counts on both.
    both = in_the_way.bodies(seen(FORK, [((A, M), 0, 400, 100), ((B, M), 0, 400, 100), ((M, L), 0, 50, 300)]), virtual=False)
    rows = list(zip(both.train.tolist(), both.other.tolist(), both.room.tolist(), both.sure.tolist(), strict=True))
    assert (0, 2, 1000 - 250 - 400, False) in rows
    assert (1, 2, 1200 - 250 - 400, False) in rows
    assert in_the_way.obstacles(seen(FORK, [((M, R), 0, 1500, 100), ((L,), 0, 50, 700)])).room[0] == 2000 - 650 - 1500
    longer = [((B, M), 0, 1100, 100), ((L,), 0, 50, 2200)]  # over m and back onto a or b
    assert in_the_way.obstacles(seen(FORK, longer)).room[0] == 1200 + 2000 + 50 - 2200 - 1100


def test_a_tail_behind_the_beginning_stands_in_the_way_of_those_who_come_and_who_cross():
    # 0 leads to 1, 3 is the other direction of 0, 4 crosses 0.
    net = SimpleNamespace(
        length_m=np.array([500.0, 400.0, 100.0, 500.0, 30.0]), before=[[], [0], [], [2], [2]], twin=np.array([3, -1, -1, 0, -1]),
        crossing=[[4], [], [], [], [0]],
    )  # fmt: skip
    hanging = ((1,), 0, 50, 300)
    found = in_the_way.bodies(seen(net, [((2, 3), 0, 80, 50), ((2, 4), 0, 30, 20), hanging]), virtual=False)
    assert found.train.tolist() == [0, 1, 1]
    assert (found.room[[0, 2]].tolist(), found.other[[0, 2]].tolist(), found.sense[[0, 2]].tolist()) == (
        [20.0, 70.0],
        [2, 2],
        [-1, 0],
    )


def test_at_a_join_one_who_passes_after_the_train_ahead_is_told_and_one_who_passes_before_it_is_not():
    trains = [((A, M, L), 0, 400, 100), ((A, M, L), 0, 700, 100), ((B, M, R), 0, 500, 100)]

    def told(*turns):
        order = along.Order(np.full(3, M), np.array(turns), np.arange(3))
        found = in_the_way.bodies(seen(FORK, trains, order=order), virtual=False)
        return {i: sorted(found.other[found.train == i].tolist()) for i in range(3)}

    assert told(1, 2, 0) == {0: [1, 2], 1: [], 2: [1]}
    assert told(2, 1, 0) == {0: [1], 1: [2], 2: []}


def test_a_decided_turn_counts_also_where_one_stands_on_the_way_of_the_other():
    # Two tracks, 1 and 2, from 0 to 3: the first train takes the longer and is to let the second pass.
    net = SimpleNamespace(
        length_m=np.array([2000.0, 500.0, 600.0, 900.0]), before=[[], [0], [0], [1, 2]], twin=np.full(4, -1), crossing=[[]] * 4
    )
    trains, order = [((0, 2, 3), 0, 1900, 100), ((0, 1, 3), 0, 1000, 100)], along.Order(*np.array([[3, 1, 0], [3, 0, 1]]).T.copy())
    found = in_the_way.bodies(seen(net, trains, order=order), virtual=False)
    assert found.room[found.train == 0].tolist() == [700.0]
    assert np.isinf(in_the_way.obstacles(seen(net, trains), virtual=False).room[0])


def test_what_lies_across_a_track_the_train_ahead_is_over_is_told():
    net = SimpleNamespace(
        length_m=np.array([500.0, 30.0, 900.0, 30.0]), before=[[], [0], [1], []], twin=np.full(4, -1), crossing=[[], [3], [], [1]]
    )
    way = (0, 1, 2)
    found = in_the_way.bodies(seen(net, [(way, 0, 100, 50), (way, 2, 20, 90), ((3,), 0, 5, 50)]), virtual=False)
    assert sorted(found.other[found.train == 0].tolist()) == [1, 2]
    beyond = in_the_way.bodies(seen(net, [(way, 0, 100, 50), (way, 0, 300, 90), ((3,), 0, 5, 50)]), virtual=False)
    assert beyond.other[beyond.train == 0].tolist() == [1]


def test_beyond_the_horizon_there_is_nothing():
    trains = [((A, M), 0, 0, 100), ((A, M), 1, 500, 100), ((B, M), 0, 300, 100)]
    assert along.ahead(seen(FORK, trains, 1500.0)).train.tolist() == [2, -1, 1]
    assert along.ahead(seen(FORK, trains, 999.0)).train.tolist() == [-1, -1, -1]
    assert np.isinf(in_the_way.obstacles(seen(FORK, trains, 599.0)).room).all()


@pytest.fixture(scope="module", params=["--no-internal-links=false", "--no-internal-links"])
def fork_of_sumo(request, tmp_path_factory):
    """Two tracks that join and branch again, trains on all four ways."""
    folder = tmp_path_factory.mktemp("fork")
    nodes = {"a": (0, 100), "b": (0, -150), "m": (1500, 0), "s": (4000, 0), "l": (6000, 100), "r": (6000, -100)}
    (folder / "n.xml").write_text(
        "<nodes>" + "".join(f'<node id="{k}" x="{x}" y="{y}" type="priority"/>' for k, (x, y) in nodes.items()) + "</nodes>"
    )
    edges = "".join(
        f'<edge id="{e}" from="{e[0]}" to="{e[1]}" numLanes="1" allow="rail" speed="40"/>' for e in ("am", "bm", "ms", "sl", "sr")
    )
    (folder / "e.xml").write_text(f"<edges>{edges}</edges>")
    program, environment = netconvert()
    command = [str(program), "-n", "n.xml", "-e", "e.xml", "-o", "f.net.xml", "--no-turnarounds", request.param]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    rng = np.random.default_rng(5)
    rows = []
    for k in range(16):
        rows.append(
            f'<vType id="t{k}" vClass="rail" carFollowModel="Krauss" length="{rng.integers(60, 400)}" minGap="{rng.integers(1, 9)}" '
            f'maxSpeed="{rng.integers(12, 40)}" sigma="0"/><vehicle id="{k}" type="t{k}" depart="{20 * k}" departPos="base" insertionChecks="none">'
            f'<route edges="{rng.choice(["am", "bm"])} ms {rng.choice(["sl", "sr"])}"/></vehicle>'
        )
    (folder / "r.xml").write_text(f"<routes>{''.join(rows)}</routes>")
    return folder


def test_where_sumo_sees_a_leader_it_is_ours_and_at_the_same_gap(fork_of_sumo):
    rails = Rails.read(fork_of_sumo / "f.net.xml")
    net = along.net(rails)
    files = ["-n", str(fork_of_sumo / "f.net.xml"), "-r", str(fork_of_sumo / "r.xml")]
    libsumo.start(["sumo", *files, "--no-step-log", "--time-to-teleport", "-1", "--step-length", "0.5"])
    compared, partly, overlapping, tails, joining = 0, 0, 0, 0, 0
    try:
        while libsumo.simulation.getMinExpectedNumber() > 0:
            libsumo.simulationStep()
            ids = libsumo.vehicle.getIDList()
            routes = [rails.way(libsumo.vehicle.getRoute(i)) for i in ids]
            ways = laid(routes, rails.start_m, rails.length_m)
            on = [rails.index[libsumo.vehicle.getRoadID(i)] for i in ids]
            row = np.array([ways.first[k] + routes[k].tolist().index(e) for k, e in enumerate(on)], np.int64)
            s = ways.begin[row] + np.array([libsumo.vehicle.getLanePosition(i) for i in ids])
            length = np.array([libsumo.vehicle.getLength(i) for i in ids])
            here = along.places(ways, net, row, s, length, np.ones(len(ids), bool), 10000.0)
            found, clear = along.ahead(here), in_the_way.obstacles(here, virtual=False)
            for k, i in enumerate(ids):
                leader = libsumo.vehicle.getLeader(i, 10000.0)
                name, gap = leader or ("", np.inf)
                room, nearest = gap + libsumo.vehicle.getMinGap(i), found.train[k]
                to_come = set(ways.edge[row[k] : ways.first[k + 1]].tolist())
                if nearest >= 0 and on[nearest] not in to_come:
                    # SUMO sees nothing that still is on another track, but on the junction it stops before where the tracks meet.
                    at_junction = name == ids[nearest] and rails.internal[on[nearest]]
                    assert not name or at_junction or found.spacing[k] < room + length[ids.index(name)]
                    assert not at_junction or room <= clear.room[k]
                    joining += 1
                elif nearest >= 0 and ids[nearest] == name:
                    rear = found.spacing[k] - length[nearest]
                    if clear.room[k] == pytest.approx(rear, abs=1e-6):
                        assert room == pytest.approx(rear, abs=1e-6)
                        compared += 1
                    elif clear.train[k] == nearest:  # its rear is still on the other track: there, or where the tracks meet
                        assert rear - 1e-3 <= room <= clear.room[k] + 1e-3
                        partly += 1
                    else:  # SUMO forgets who it has run into
                        assert clear.room[k] < 0.0
                        overlapping += 1
                elif name:  # the tail of one that has left the way is no train ahead, but stands in it
                    assert on[ids.index(name)] not in to_come
                    assert ids[clear.train[k]] == name
                    assert clear.room[k] == pytest.approx(room, abs=1e-6)
                    tails += 1
                else:
                    assert nearest < 0
    finally:
        libsumo.close()
    assert compared > 3000
    assert tails > 20
    assert joining > 100
