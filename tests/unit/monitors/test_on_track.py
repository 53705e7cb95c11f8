"""Bodies on the track: every overlap is found edge by edge, also of trains that ran through one another; and every limit."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from trainctl.monitors.on_track import Track, Watch, limits, overlaps, track
from trainctl.railway.signs import signs
from trainctl.railway.ways import ways
from trainctl.signals import Seen

#: a (0) and b (1) follow each other, c (2) is b in the other direction; d (3) branches off a.
LENGTH = np.array([100.0, 200.0, 200.0, 100.0])
TRACK = Track(LENGTH, np.array([-1, 2, 1, -1]), np.array([-1, 0, -1, 0]), np.array([30.0, 20.0, 20.0, 10.0]))


def found(routes, at, moved=None, net=TRACK):
    """Pairs (ahead, behind, depth); ``at`` has (edge of the route, place on it, length) of every train."""
    row, s, length = (np.array(column, float) for column in zip(*at, strict=True))
    laid = ways(routes, np.zeros(len(net.length)), net.length)
    row = laid.first[:-1] + row.astype(np.int64)
    moved = np.full(len(s), np.nan) if moved is None else np.array(moved, float)
    told = overlaps(net, laid, row, laid.begin[row] + s, length, np.ones(len(s), bool), moved)
    return [(int(a), int(b), float(d)) for a, b, d in zip(told.ahead, told.behind, told.depth, strict=True)]


@pytest.mark.parametrize(
    ("case", "routes", "at", "moved", "expected"),
    [
        ("apart", [[0], [0]], [(0, 50, 20), (0, 90, 30)], None, []),
        ("bumper to bumper", [[0], [0]], [(0, 50, 20), (0, 90, 40)], None, []),
        ("one edge", [[0], [0]], [(0, 50, 20), (0, 90, 50)], None, [(1, 0, 10.0)]),
        ("tail on the edge before", [[0, 1], [0]], [(1, 10, 50), (0, 70, 5)], None, [(0, 1, 5.0)]),
        ("over two edges", [[0, 1], [0, 1]], [(1, 10, 50), (1, 5, 60)], None, [(0, 1, 45.0)]),
        ("tail before the start of its way", [[1], [0]], [(0, 10, 50), (0, 70, 5)], None, [(0, 1, 5.0)]),
        ("head-on", [[1], [2]], [(0, 120, 50), (0, 90, 30)], None, [(0, 1, 10.0)]),
        ("head-on, apart", [[1], [2]], [(0, 120, 50), (0, 70, 30)], None, []),
        ("another branch", [[0, 1], [0, 3]], [(1, 10, 5), (1, 10, 5)], None, []),
        ("its tail is still on a", [[0, 1], [0, 3]], [(1, 50, 60), (1, 10, 20)], None, [(0, 1, 10.0)]),
        ("points side by side in turn", [[0], [0]], [(0, 60, 0), (0, 50, 0)], [30, 0], [(1, 0, 10.0)]),
        ("points that keep their order", [[0], [0]], [(0, 60, 0), (0, 50, 0)], [30, 25], []),
        ("points head-on through one another", [[1], [2]], [(0, 120, 0), (0, 100, 0)], [40, 40], [(1, 0, 20.0)]),
        ("through one another over an edge", [[0, 1], [0, 1]], [(1, 20, 10), (0, 95, 10)], [40, 5], [(1, 0, 35.0)]),
        ("it follows a train that turned off", [[0, 1], [0, 3]], [(1, 50, 10), (1, 5, 10)], [70, 30], []),
    ],
)  # fmt: skip
def test_overlaps(case, routes, at, moved, expected):
    assert found(routes, at, moved) == expected


def test_every_pair_is_found_once_as_by_comparing_all_with_all():
    """Random trains on a chain of short edges and its other direction, against intervals on one axis."""
    rng = np.random.default_rng(3)
    edges, count = 12, 0
    length = rng.uniform(10.0, 60.0, edges)
    net = Track(
        np.concatenate([length, length[::-1]]), np.arange(2 * edges)[::-1].copy(), np.arange(-1, 2 * edges - 1),
        np.full(2 * edges, 30.0),
    )  # fmt: skip
    start = np.concatenate([[0.0], np.cumsum(length)])
    for _ in range(200):
        n = 8
        way, train = rng.integers(0, 2, n), rng.uniform(1.0, 90.0, n)
        front = rng.uniform(100.0, start[-1], n)
        row = np.searchsorted(start, front) - 1
        routes = [list(range(edges)) if w == 0 else list(range(edges, 2 * edges)) for w in way]
        begins = [start if w == 0 else start[-1] - start[::-1] for w in way]
        row = [int(np.searchsorted(b, f) - 1) for b, f in zip(begins, front, strict=True)]
        at = [(r, f - b[r], t) for r, f, b, t in zip(row, front, begins, train, strict=True)]
        got = {(min(a, b), max(a, b)): d for a, b, d in found(routes, at, net=net)}
        low = np.where(way == 0, front - train, start[-1] - front)
        expected = {}
        for i in range(n):
            for j in range(i + 1, n):
                shared = min(low[i] + train[i], low[j] + train[j]) - max(low[i], low[j])
                if shared > 1e-6:
                    expected[i, j] = shared
        assert got == pytest.approx(expected, abs=1e-6)
        count += len(expected)
    assert count > 500


def test_the_lowest_limit_under_the_whole_train_counts():
    laid = ways([[0, 1], [0, 1], [0, 3]], np.zeros(4), LENGTH)
    row = laid.first[:-1] + 1
    s = laid.begin[row] + [50.0, 120.0, 5.0]
    limit, edge = limits(TRACK, laid, row, s, np.array([60.0, 20.0, 0.0]), np.array([True, True, True]))
    assert limit.tolist() == [20.0, 20.0, 10.0] and edge.tolist() == [1, 1, 3]
    slow_behind = TRACK._replace(limit=np.array([5.0, 20.0, 20.0, 10.0]))
    assert limits(slow_behind, laid, row, s, np.array([60.0, 20.0, 0.0]), np.ones(3, bool))[0].tolist() == [5.0, 20.0, 10.0]


def test_a_tail_is_not_guessed_where_tracks_join():
    rails = SimpleNamespace(
        edges=("a", "b", "c"),
        before=((), (), (0, 1)),
        twin=np.array([-1, -1, -1]),
        length_m=np.full(3, 10.0),
        speed_mps=np.full(3, 9.0),
    )
    assert track(rails).before.tolist() == [-1, -1, -1]
    assert track(rails, ("1", "2", "1")).before.tolist() == [-1, -1, 0]  # on a line of tracks the track goes straight on


def test_a_train_that_has_just_come_has_not_moved():
    """One enters where another has just been: nobody ran through anybody."""
    rails = SimpleNamespace(edges=("a",), before=((),), twin=np.array([-1]), length_m=np.array([100.0]), speed_mps=np.array([30.0]))
    line = SimpleNamespace(edges=("a",), tracks=("1",), start_m=np.array([1000.0]))
    watch = Watch(("A", "B"), np.zeros(2), np.ones(2), rails, line, net=False, signs=signs((), {}))
    laid = ways([[0], [0]], np.zeros(1), np.array([100.0]))
    seen, last = Seen(np.array([10.0, 20.0]), np.zeros(2, np.int64), laid.first[:-1], np.array([True, False])), watch.initial()
    assert list(watch.violated(0.0, laid, seen, np.full(2, 25.0), last)) == []
    seen = seen._replace(position=np.array([35.0, 20.0]), present=np.array([True, True]))
    assert list(watch.violated(0.0, laid, seen, np.full(2, 25.0), last)) == []
    seen = seen._replace(position=np.array([60.0, 80.0]))
    told, fast = watch.violated(0.0, laid, seen, np.array([25.0, 60.0]), last)
    assert fast == {"bound": "line_speed_mps", "who": "B", "value": 60.0, "limit": 30.0, "edge": "a"}
    assert told == {
        "bound": "gap_m", "who": "A-B", "value": -20.0, "limit": 0.0, "trains": ["A", "B"], "edge": "a", "edge_m": 80.0, "track": "1",
        "position_m": 1080.0,
    }  # fmt: skip
