"""What stands ahead, against a slow reference that compares every train with every other."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trainctl.railway import along
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


def joining(railway, traffic, order, horizon, i):
    """All trains over other tracks that are ahead of ``i``: train, spacing, distance to the join; whether it is the next."""
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
        found = []
        for j in set(np.flatnonzero(present).tolist()) - {i}:
            for m, f, other in approaches(j):
                same = ways.edge[k - 1] == ways.edge[m - 1]
                apart = ways.edge[row[j]] not in ways.edge[row[i] : k] and ways.edge[row[i]] not in ways.edge[row[j] : m]
                if f == e and other < turn and (same or apart):
                    found.append((other, not same, j))
        decided = [entry for entry in found if entry[0][0] < np.inf]
        for entry in found:
            other, comes_over_another, j = entry
            if comes_over_another:
                yield j, turn[1] - other[1], turn[1], entry not in decided or entry == max(decided)


def nearest_ahead(railway, traffic, order, horizon, i):
    ways, row, s, _, present = traffic
    x = s - ways.begin[row]
    found = [spacing for _, spacing, _, is_next in joining(railway, traffic, order, horizon, i) if is_next]
    for k in range(row[i], ways.first[i + 1]):
        for j in np.flatnonzero(present & (ways.edge[row] == ways.edge[k])).tolist():
            spacing = ways.begin[k] + x[j] - s[i]
            if j != i and spacing <= horizon and (k > row[i] or (x[j], -j) > (x[i], -i)):
                found.append(spacing)
    return min(found, default=np.inf)


def bodies(traffic, j):
    """Edges train ``j`` stands on, with how far its front is from their start."""
    ways, row, s, length, present = traffic
    k = row[j]
    while present[j]:
        yield int(ways.edge[k]), s[j] - ways.begin[k]
        if k == ways.first[j] or ways.begin[k] <= s[j] - length[j]:
            return
        k -= 1


def blocked(railway, traffic, order, horizon, virtual, i):
    """Room, train and sense of everything in the way of ``i``."""
    ways, row, s, length, present = traffic
    x = s[i] - ways.begin[row[i]]
    for k in range(row[i], ways.first[i + 1]):
        e, away = int(ways.edge[k]), ways.begin[k] - s[i]
        here, size = k == row[i], railway.length_m[ways.edge[k]]
        if away > horizon:
            break
        for j in set(np.flatnonzero(present).tolist()) - {i}:
            for f, depth in bodies(traffic, j):
                rear = depth - length[j]
                deeper = not here or (depth, -j) > (x, -i)
                if f == e and deeper:
                    clipped = not virtual and rear < 0.0 and k > row[i]
                    yield away + (rear if virtual else max(rear, 0.0)), j, 0 if clipped else 1
                if railway.twin[e] == f and (not here or size - max(rear, 0.0) > x):
                    yield away + size - min(depth, size), j, -1
                if f in railway.crossing[e] and deeper:
                    yield away, j, 0
    for j, spacing, distance, _ in joining(railway, traffic, order, horizon, i):
        yield (spacing - length[j], j, 1) if virtual else (distance, j, 0)


def runs_along(traffic, horizon, i, j):
    """Whether from the front of ``j`` on both run over the same edges as far as ``i`` looks, from any of its edges."""
    ways, row, s, _, _ = traffic
    near = [int(ways.edge[k]) for k in range(row[i], ways.first[i + 1]) if ways.begin[k] - s[i] <= horizon]
    whole = ways.edge[ways.first[j] : ways.first[j + 1]].tolist()
    return any(whole[b : b + len(near) - a] == near[a:] for a in range(len(near)) for b in range(len(whole)))


def standing(traffic, i):
    """Trains of which a piece is on the way of ``i``."""
    ways, row, _, _, _ = traffic
    to_come = set(ways.edge[row[i] : ways.first[i + 1]].tolist())
    return {j for j in range(len(row)) if to_come & {e for e, _ in bodies(traffic, j)}}


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
        stands = along.obstacles(here, virtual)
        for i in range(n):
            every = list(blocked(railway, traffic, order, horizon, virtual, i)) if present[i] else []
            every = [b for b in every if b[0] <= horizon]
            assert stands.room[i] == min((room for room, _, _ in every), default=np.inf)
            assert not every or (stands.room[i], stands.train[i], stands.sense[i]) in every
            assert every or (stands.train[i], stands.sense[i]) == (-1, 0)
        told = along.bodies(here, virtual)
        rows = list(zip(told.train.tolist(), told.room.tolist(), told.other.tolist(), told.sense.tolist(), strict=True))
        for i in range(n):
            every = set(blocked(railway, traffic, order, horizon, virtual, i)) if present[i] else set()
            mine = [row[1:] for row in rows if row[0] == i]
            assert set(mine) <= every
            on_the_way = [j for _, j, sense in mine if sense == 1 or (sense == 0 and j in standing(traffic, i))]
            hides = [j for j in on_the_way if runs_along(traffic, horizon, i, j)]
            if not hides:  # then every train that stands in the way is told
                same_way = {(j, sense) for room, j, sense in every if sense == 1 and room <= horizon and j in standing(traffic, i)}
                assert same_way <= {(j, sense) for _, j, sense in mine}


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
