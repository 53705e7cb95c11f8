"""What stands ahead, against a slow reference that compares every train with every other."""

from __future__ import annotations

from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trainctl.railway import along
from trainctl.railway import bodies as in_the_way
from trainctl.railway.ways import ways as laid

HORIZONS = (40.0, 150.0, 1000.0)


def random_railway(rng, tree):
    """Merges towards one root, or any graph with loops; some edges have twins, some cross."""
    edges = int(rng.integers(2, 14))
    if tree:
        after = [[int(rng.integers(0, e))] if e else [] for e in range(edges)]
    else:
        after = [sorted({int(f) for f in rng.integers(0, edges, rng.integers(1, 4))} - {e}) for e in range(edges)]
    before = [[e for e in range(edges) if f in after[e]] for f in range(edges)]
    length = rng.integers(1, 120, edges) / 2.0
    twin = np.full(edges, -1)
    crossing = [set() for _ in range(edges)]
    shuffled = rng.permutation(edges)
    for a, b in shuffled[: 2 * (edges // 4)].reshape(-1, 2):
        twin[a], twin[b], length[b] = b, a, length[a]
    for a, b in rng.integers(0, edges, (rng.integers(0, 3), 2)).tolist():
        if a != b:
            crossing[a].add(b)
            crossing[b].add(a)
    return SimpleNamespace(length_m=length, after=after, before=before, twin=twin, crossing=crossing)


def random_traffic(rng, railway, n):
    paths = []
    for _ in range(n):
        path = [int(rng.integers(0, len(railway.after)))]
        while len(path) < 12 and railway.after[path[-1]]:
            path.append(int(rng.choice(railway.after[path[-1]])))
        paths.append(path)
    ways = laid(paths, np.zeros(len(railway.length_m)), railway.length_m)
    row = np.array([rng.integers(a, b) for a, b in zip(ways.first[:-1], ways.first[1:], strict=True)])
    s = ways.begin[row] + np.floor(rng.random(n) * (2.0 * railway.length_m[ways.edge[row]] + 1.0)) / 2.0
    order = along.Order(*(np.zeros(0, np.int64) for _ in range(3)))
    if rng.random() < 0.5:
        turns = [(e, int(i), r) for e in range(len(railway.after)) for r, i in enumerate(rng.permutation(n)[: rng.integers(0, n)])]
        order = along.Order(*np.array(turns, np.int64).reshape(-1, 3).T.copy())
    return (ways, row, s, rng.integers(2, 160, n) / 2.0, rng.random(n) < 0.9), order


def earlier(railway, traffic, order, horizon, i):
    """All passages of a join ahead of ``i`` that come before its own.

    Row of the join and own turn; whose they are and their turn; whether over the same track; whether neither stands on the way of
    the other before. A turn is (rank, distance, number), rank inf: undecided.
    """
    ways, row, s, _, present = traffic
    rank = {(int(e), int(j)): int(r) for e, j, r in zip(*order, strict=True)}

    def approaches(j):
        seen = set()
        for m in range(row[j] + 1, ways.first[j + 1]):
            e = int(ways.edge[m])
            if ways.begin[m] - s[j] <= horizon:
                yield m, e, (rank.get((e, j), np.inf) if e not in seen else np.inf, ways.begin[m] - s[j], j)
                seen.add(e)

    for k, e, turn in approaches(i):
        for j in set(np.flatnonzero(present).tolist()) - {i}:
            for m, f, other in approaches(j):
                apart = ways.edge[row[j]] not in ways.edge[row[i] : k] and ways.edge[row[i]] not in ways.edge[row[j] : m]
                if f == e and other < turn:
                    yield k, turn, j, other, ways.edge[k - 1] == ways.edge[m - 1], apart


def joining(railway, traffic, order, horizon, i):
    """Spacings of the trains that may be next ahead of ``i`` where they come over another track."""
    found = [one for one in earlier(railway, traffic, order, horizon, i) if one[4] or one[5]]
    for k, turn, _, other, same, _ in found:
        decided = [one[3] for one in found if one[0] == k and one[3][0] < np.inf]
        if not same and (other not in decided or other == max(decided)):
            yield turn[1] - other[1]


def nearest_ahead(railway, traffic, order, horizon, i):
    ways, row, s, _, present = traffic
    x = s - ways.begin[row]
    found = list(joining(railway, traffic, order, horizon, i))
    for k in range(row[i], ways.first[i + 1]):
        for j in np.flatnonzero(present & (ways.edge[row] == ways.edge[k])).tolist():
            spacing = ways.begin[k] + x[j] - s[i]
            if j != i and spacing <= horizon and (k > row[i] or (x[j], -j) > (x[i], -i)):
                found.append(spacing)
    return min(found, default=np.inf)


def bodies(railway, traffic, j):
    """Edges train ``j`` stands on, with how far its front is from their start, its row there (-1: behind), and whether it surely does.

    Behind the beginning of its way it is laid on every edge that leads there and keeps the direction, on each the shortest way.
    """
    ways, row, s, length, present = traffic
    k = row[j]
    while present[j]:
        yield int(ways.edge[k]), s[j] - ways.begin[k], k, True
        if ways.begin[k] <= s[j] - length[j]:
            return
        if k == ways.first[j]:
            break
        k -= 1
    if not present[j]:
        return
    tail, first = {}, (int(ways.edge[k]), s[j] - ways.begin[k], True)
    for _ in railway.after:  # as often as there are edges: then every shortest way is found
        for e, depth, sure in [first, *((e, *found) for e, found in tail.items())]:
            into = [b for b in railway.before[e] if railway.twin[b] != e] if depth < length[j] else []
            for b in into:
                further = depth + railway.length_m[b]
                if b not in tail or further < tail[b][0]:
                    tail[b] = further, sure and len(into) == 1
    for e, (depth, sure) in tail.items():
        yield e, depth, -1, sure


class Row(NamedTuple):
    """Something in the way of a train: what is compared, then where on the way it was found."""

    room: float
    other: int
    sense: int
    sure: bool
    row: int
    kind: str


def blocked(railway, traffic, order, horizon, virtual, i):
    """Everything in the way of ``i``, hidden or not."""
    ways, row, s, length, present = traffic
    x = s[i] - ways.begin[row[i]]
    for k in range(row[i], ways.first[i + 1]):
        e, away = int(ways.edge[k]), ways.begin[k] - s[i]
        here, size = k == row[i], railway.length_m[ways.edge[k]]
        if away > horizon:
            break
        for j in set(np.flatnonzero(present).tolist()) - {i}:
            for f, depth, _, sure in bodies(railway, traffic, j):
                rear = depth - length[j]
                deeper = not here or (depth, -j) > (x, -i)
                if f == e and deeper:
                    clipped = not virtual and rear < 0.0 and k > row[i]
                    yield Row(away + (rear if virtual else max(rear, 0.0)), j, 0 if clipped else 1, sure, k, "same")
                if railway.twin[e] == f and (not here or size - max(rear, 0.0) > x):
                    yield Row(away + size - min(depth, size), j, -1, sure, k, "opposing")
                if f in railway.crossing[e] and deeper:
                    yield Row(away, j, 0, sure, k, "across")
    for k, turn, j, other, same, apart in earlier(railway, traffic, order, horizon, i):
        if not same and (apart or other[0] < np.inf):
            yield Row(turn[1] - other[1] - length[j], j, 1, True, k, "join") if virtual else Row(turn[1], j, 0, True, k, "join")


def guards(railway, traffic, order, horizon, i):
    """Trains that run all the way of ``i`` from where they stand on it as far as it looks.

    How far the front of each is, and who passes a join before it, or is it: (train, row of the join in the way of ``i``).
    """
    ways, row, s, _, _ = traffic
    near = [k for k in range(row[i], ways.first[i + 1]) if ways.begin[k] - s[i] <= horizon]
    for j in range(len(row)):
        passed = earlier(railway, traffic, order, horizon, j)
        firsts = {(other, m) for m, _, other, _, _, _ in passed} | {(j, m) for m in range(row[j] + 1, ways.first[j + 1])}
        for k in near if j != i else ():
            for e, depth, r, _ in bodies(railway, traffic, j):
                to_run = ways.edge[k : near[-1] + 1].tolist()
                if r >= 0 and e == ways.edge[k] and ways.edge[r : ways.first[j + 1]].tolist()[: len(to_run)] == to_run:
                    yield ways.begin[k] - s[i] + depth, {(other, m - r + k) for other, m in firsts}


def is_covered(missing, told, guarded):
    """Whether something that is not told may be left out, by the notes of ``bodies``."""
    if missing.kind == "same" and any(t.kind == "same" and t.other == missing.other and t.room <= missing.room for t in told):
        return True  # a part of it is told that is nearer
    if missing.kind != "same" and any(t.kind == missing.kind and t.row == missing.row and t.room <= missing.room for t in told):
        return True  # of those that come the other way on one edge, lie across it, or come to one join, the nearest
    if missing.kind == "join":
        return any(front <= missing.room and (missing.other, missing.row) in firsts for front, firsts in guarded)
    return any(front < missing.room for front, _ in guarded)


@pytest.mark.parametrize("tree", [True, False])
@settings(max_examples=150, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 9), horizon=st.sampled_from(HORIZONS))
def test_ahead_and_obstacles_are_those_of_the_slow_reference(tree, seed, n, horizon):
    rng = np.random.default_rng(seed)
    railway = random_railway(rng, tree)
    traffic, order = random_traffic(rng, railway, n)
    here = along.places(traffic[0], along.net(railway), *traffic[1:], horizon, order)
    found = along.ahead(here)
    present = traffic[-1]
    for i in range(n):
        assert found.spacing[i] == (nearest_ahead(railway, traffic, order, horizon, i) if present[i] else np.inf)
        assert (found.train[i] < 0) == np.isinf(found.spacing[i])
    for virtual in (True, False):
        stands = in_the_way.obstacles(here, virtual)
        told = in_the_way.bodies(here, virtual)
        for i in range(n):
            every = [b for b in blocked(railway, traffic, order, horizon, virtual, i) if b.room <= horizon] if present[i] else []
            assert stands.room[i] == min((b.room for b in every), default=np.inf)
            assert not every or (stands.room[i], stands.train[i], stands.sense[i]) in [b[:3] for b in every]
            assert every or (stands.train[i], stands.sense[i]) == (-1, 0)
            parts = (part[told.train == i].tolist() for part in (told.room, told.other, told.sense, told.sure))
            mine = set(zip(*parts, strict=True))
            assert mine <= {b[:4] for b in every}
            shown = [b for b in every if b[:4] in mine]
            guarded = list(guards(railway, traffic, order, horizon, i)) if present[i] else []
            assert [b for b in every if b not in shown and not is_covered(b, shown, guarded)] == []


def occupied(railway, traffic, j):
    """Track that train ``j`` occupies or may occupy: edge, from, to [m], in both directions."""
    length = traffic[3][j]
    for e, depth, _, _ in bodies(railway, traffic, j):
        size = railway.length_m[e]
        begin, end = max(depth - length, 0.0), min(depth, size)
        yield e, begin, end
        if railway.twin[e] >= 0:
            yield int(railway.twin[e]), size - end, size - begin


@pytest.mark.parametrize("tree", [True, False])
@settings(max_examples=150, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 9), horizon=st.sampled_from(HORIZONS))
def test_no_track_that_a_train_occupies_is_nearer_than_what_is_told(tree, seed, n, horizon):
    rng = np.random.default_rng(seed)
    railway = random_railway(rng, tree)
    traffic, order = random_traffic(rng, railway, n)
    ways, row, s, _, present = traffic
    stands = in_the_way.obstacles(along.places(ways, along.net(railway), *traffic[1:], horizon, order), virtual=False)
    for i in np.flatnonzero(present).tolist():
        others = [piece for j in np.flatnonzero(present).tolist() if j != i for piece in occupied(railway, traffic, j)]
        for k in range(row[i], ways.first[i + 1]):
            start = max(s[i] - ways.begin[k], 0.0)  # only what lies before the front
            ends = [max(a, start) for e, a, b in others if e == ways.edge[k] and b > start + 1e-6]
            if ends and (nearest := ways.begin[k] + min(ends) - s[i]) <= horizon:
                assert stands.room[i] <= nearest + 1e-6
                break


@settings(max_examples=150, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 9))
def test_tails_behind_the_beginning_foul_what_they_would_lie_on_and_across(seed, n):
    rng = np.random.default_rng(seed)
    railway = random_railway(rng, False)
    traffic, _ = random_traffic(rng, railway, n)
    found = in_the_way.fouling(along.places(traffic[0], along.net(railway), *traffic[1:], 100.0), np.zeros(len(traffic[1]), bool))
    for i in range(n):
        tail = [(e, max(depth - traffic[3][i], 0.0)) for e, depth, k, _ in bodies(railway, traffic, i) if k < 0]
        others = [piece for j in set(range(n)) - {i} for piece in occupied(railway, traffic, j)]
        across = {e for j in set(range(n)) - {i} for f, *_ in bodies(railway, traffic, j) for e in railway.crossing[f]}
        lies_on = any(e == f and b > rear and a < railway.length_m[e] for e, rear in tail for f, a, b in others)
        assert found[i] == (lies_on or any(e in across for e, _ in tail))


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 12))
def test_on_a_tree_of_merges_trains_on_the_way_to_one_edge_are_one_chain(seed, n):
    rng = np.random.default_rng(seed)
    railway = random_railway(rng, True)
    traffic, _ = random_traffic(rng, railway, n)
    ways, row, s, length, _ = traffic
    here = along.places(ways, along.net(railway), row, s, length, np.ones(n, bool), 1e6)
    found = along.ahead(here)
    root = s - ways.begin[ways.first[1:] - 1] - railway.length_m[0]  # all ways end with edge 0
    order = np.lexsort((np.arange(n), -root))
    exact = [0.0, *np.diff(root[order])]
    assert found.train[order[0]] == -1
    for place in range(1, n):
        assert found.spacing[order[place]] == -exact[place]
    followers = along.behind(found)
    assert np.array_equal(np.sort(-followers.spacing[order[:-1]]), np.sort(exact[1:]))
