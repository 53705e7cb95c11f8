"""What obstructs trains bodily: bodies on their ways, the other way, across, and at joins. Room is front to body."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from trainctl.kernels import keep_by_sources
from trainctl.railway.along import UNDECIDED, Places, comes_over_another_track
from trainctl.railway.rows import PERHAPS
from trainctl.signals import Bools, Floats, Ints

keep_by_sources()  # before anything below is decorated


class Bodies(NamedTuple):
    """Everything in the way of trains that may matter, one row per train and body; sorted by train. See ``Obstacles``."""

    train: Ints  # (B,) whose way
    other: Ints  # (B,) whose body
    room: Floats  # (B,) m
    sense: Ints  # (B,)
    sure: Bools  # (B,) False: this part of it may lie elsewhere, behind the beginning of its way, see ``rows.tails``


class Obstacles(NamedTuple):
    """The nearest obstacle of each train."""

    room: Floats  # (n,) m from the front to it, negative: overlapping; inf: none
    train: Ints  # (n,) whose body it is, -1: none
    sense: Ints  # (n,) 1: it runs in the same direction, -1: it comes towards it, 0: across, or a join to be kept clear


def bodies(places: Places, virtual: bool = True) -> Bodies:
    """Find the obstacles of each train, from the nearest to what the others hide.

    The nearest alone does not decide how far a train may go: the rear of one that branches off is gone in a moment, and there
    may be another behind it.

    Parameters
    ----------
    places : Places
        From ``places``.
    virtual : bool
        A train that comes over another track and is ahead, see ``ahead``. True: its rear is taken to be its length behind its
        front on the own way, from the horizon until it has wholly joined, so trains sort themselves in before the join. False:
        only what is there counts: the join is to be kept clear (room to the start of that edge, sense 0) until its rear has come
        over it, then the body.

    Returns
    -------
    Bodies
        ``train``, ``other``, ``room`` [m], ``sense`` and ``sure`` (B,): the speed of the body along the way is ``sense`` times the
        speed of that train, 0 for one across. Of those that come the other way on one edge, or lie across it, the nearest; of
        those that come to one join the nearest, the nearest of those that pass after that one, and so on.

    Notes
    -----
    What is hidden. Let train j run all of the way of train i from where they meet as far as i looks. Then j hides from i what j
    must keep clear of itself: all beyond its *front*, but of those who come to a join over another track only who pass before *it*.
    That is safe, whatever becomes of j. As long as i can brake behind j, and j before k, D the braking distance,
    ``d_ij >= D(v_i) - D(v_j)`` and ``d_jk >= D(v_j) - D(v_k)``; so, in the sum, i before k: ``d_ik >= D(v_i) - D(v_k)``, and
    a length more. The same holds of a k that comes towards it or has stopped. So k is far enough away when it comes to sight,
    because j leaves the net or takes another way. What j need not heed no train keeps clear of for i, so that is said: who passes
    a join after j and before i, and what lies across a track that j is over already. Of several that come the other way on one
    edge the first hides the others by the same sum: they follow it.

    Bodies reach from the front back over the way they came; where a way began less than a length ago the rear lies on the edges
    that lead there, see ``rows.tails``. Bodies on the twin of an edge are mirrored. A body on an edge that crosses one of the way
    blocks it as a whole; a train that already is on a blocked edge is held only by trains that are deeper in. A train is no
    obstacle to itself.
    """
    return Bodies(*_bodies(places, virtual))


def obstacles(places: Places, virtual: bool = True) -> Obstacles:
    """Find the nearest occupied point on the way of each train: ``room``, ``train`` and ``sense`` (n,), see ``bodies``."""
    every = bodies(places, virtual)
    n = len(places.row)
    room, train, sense = np.full(n, np.inf), np.full(n, -1, np.int64), np.zeros(n, np.int64)
    first = np.lexsort((every.room, every.train))  # of a train's rows the nearest first
    nearest = first[np.flatnonzero(np.diff(every.train, prepend=-1))]
    i = every.train[nearest]
    room[i], train[i], sense[i] = every.room[nearest], every.other[nearest], every.sense[nearest]
    return Obstacles(room, train, sense)


def fouling(places: Places, back: Bools) -> Bools:
    """Whether the rear of each train lies, or may lie, on another or across its track, behind the beginning of its way; (n,).

    No train comes up to such a rear: its train was put there. So it is to be asked before a train is. Of trains that come ``back``
    (n,) from where they were parked all of the body counts, for the same reason.
    """
    found = np.zeros(len(places.row), bool)
    for p in np.flatnonzero((places.piece_row < 0) | back[places.piece_train]).tolist():
        i = places.piece_train[p]
        e = int(np.searchsorted(places.piece_first, p, side="right")) - 1
        begin, end = max(places.depth[p] - places.length[i], 0.0), min(places.depth[p], places.size[e])
        crossed = places.cross[places.cross_first[e] : places.cross_first[e + 1]].tolist()
        for f in (e, *crossed, *([int(places.twin[e])] if places.twin[e] >= 0 else [])):
            there = slice(places.piece_first[f], places.piece_first[f + 1])
            train, front = places.piece_train[there], np.minimum(places.depth[there], places.size[f])
            rear = np.maximum(places.depth[there] - places.length[train], 0.0)
            if f == e:
                meets = (rear < end) & (front > begin)
            elif f == places.twin[e]:
                meets = (end - front < end) & (end - rear > begin)
            else:
                meets = np.ones(len(train), bool)
            found[i] |= bool(np.any(meets & (train != i)))
    return found


@njit(cache=True)
def _first_to_join(places: Places, i: int, own: int, guard: int) -> int:
    """A train that passes the join of the approach ``own`` of ``i`` before it, over another track; -1: none.

    Those whose turn is not after that of the approach ``guard`` do not count; -1: all do.

    A decided turn counts also while one of the two is on the way of the other: else the one that comes later would learn of it
    only where they part, which may be just before the join.
    """
    k, edge = places.join_row[own], places.ways.edge
    for p in range(own - 1, max(places.join_first[edge[k]] - 1, guard), -1):
        j, m = places.join_train[p], places.join_row[p]
        if j == i or edge[m - 1] == edge[k - 1]:
            continue
        if places.rank[p] != UNDECIDED or comes_over_another_track(places, i, k, j, m):
            return int(j)
    return -1


@njit(cache=True)
def _nearest_to_join(places: Places, i: int, own: int, guard: int) -> tuple[int, float]:
    """Of the trains of ``_first_to_join`` the one whose rear is nearest: its approach, and how far that is [m]; -1 and inf: none.

    Rears are taken to be a length behind the fronts on the way of ``i``.
    """
    begin, edge, s = places.ways.begin, places.ways.edge, places.s
    found, best = -1, np.inf
    k = places.join_row[own]
    last = max(places.join_first[places.ways.edge[k]], guard + 1)
    decided = last
    while decided < own and places.rank[decided] != UNDECIDED:
        decided += 1
    # Decided turns come first and are few; the undecided ones before the own are in order of distance, from near to far.
    p = own - 1
    while p >= last:
        j, m = places.join_train[p], places.join_row[p]
        spacing = begin[k] - s[i] - (begin[m] - s[j])
        if p >= decided and spacing - places.longest >= best:
            p = decided - 1
            continue
        over_another = j != i and edge[m - 1] != edge[k - 1]
        if over_another and places.rank[p] == UNDECIDED:
            over_another = comes_over_another_track(places, i, k, j, m)
        if over_another and spacing - places.length[j] < best:
            found, best = p, spacing - places.length[j]
        p -= 1
    return found, best


@njit(cache=True)
def _approach(places: Places, j: int, row: int) -> int:
    """Approach of train ``j`` to the join at this row of its way, -1: its front is past it."""
    for q in range(places.own_first[j], places.own_first[j + 1]):
        if places.join_row[places.own[q]] == row:
            return int(places.own[q])
    return -1


@njit(cache=True)
def _bodies(places: Places, virtual: bool) -> tuple[Ints, Ints, Floats, Ints, Bools]:
    """Rows of ``Bodies``."""
    n = len(places.row)
    free, count = 2 * n + 16, 0
    train, other, room = np.empty(free, np.int64), np.empty(free, np.int64), np.empty(free)
    sense, sure = np.empty(free, np.int64), np.ones(free, np.bool_)
    for i in range(n):
        if places.front[i] < 0:
            continue
        begin = count
        count = _in_the_way(places, virtual, i, begin, other, room, sense, sure)
        if count > len(other):  # not all have found room
            more = 2 * count
            train, other, room = _longer(train, begin, more), _longer(other, begin, more), _longer(room, begin, more)
            sense, sure = _longer(sense, begin, more), _longer(sure, begin, more)
            _in_the_way(places, virtual, i, begin, other, room, sense, sure)
        train[begin:count] = i
    return train[:count].copy(), other[:count].copy(), room[:count].copy(), sense[:count].copy(), sure[:count].copy()


@njit(cache=True)
def _longer(values, kept, size):  # type: ignore[no-untyped-def]
    """The first ``kept`` values in an array of ``size``; for any type, so it states none."""
    longer = np.empty(size, values.dtype)
    longer[:kept] = values[:kept]
    return longer


@njit(cache=True)
def _in_the_way(
    places: Places, virtual: bool, i: int, count: int, other: Ints, room: Floats, sense: Ints, sure: Bools
) -> int:  # fmt: skip
    """Write what is in the way of ``i`` from row ``count`` on, as far as there are rows; the row after the last, there or not."""
    ways, size, s = places.ways, places.size, places.s
    inside = s[i] - ways.begin[places.row[i]]
    # What begins farther ahead is hidden, from the horizon on or by a train whose front is there; how many rows its way is shifted.
    hidden, hides, shift = places.horizon, -1, 0
    for k in range(places.row[i], ways.first[i + 1]):
        away = ways.begin[k] - s[i]
        if away > places.horizon or away - places.longest > hidden:
            break
        e = ways.edge[k]
        here = k == places.row[i]
        # The other way on the same track: the deepest is nearest.
        t = places.twin[e]
        if t >= 0:
            for p in range(places.piece_first[t + 1] - 1, places.piece_first[t] - 1, -1):
                j = places.piece_train[p]
                rear = max(places.depth[p] - places.length[j], 0.0)
                if j == i or (here and size[e] - rear <= inside):
                    continue
                value = away + size[e] - min(places.depth[p], size[e])
                if value <= hidden:
                    if count < len(other):
                        other[count], room[count], sense[count], sure[count] = j, value, -1, places.piece_row[p] != PERHAPS
                    count += 1
                break
        for q in range(places.cross_first[e], places.cross_first[e + 1]):
            c = places.cross[q]
            for p in range(places.piece_first[c + 1] - 1, places.piece_first[c] - 1, -1):
                j = places.piece_train[p]
                if j == i or (here and not _deeper(places.depth[p], j, inside, i)):
                    continue
                if away <= hidden:
                    if count < len(other):
                        other[count], room[count], sense[count], sure[count] = j, away, 0, places.piece_row[p] != PERHAPS
                    count += 1
                break
        # The same way: by depth, so once the longest train would be hidden all are.
        p = places.front[i] + 1 if here else places.piece_first[e]
        while p < places.piece_first[e + 1] and away + places.depth[p] - places.longest <= hidden:
            j, r = places.piece_train[p], places.piece_row[p]
            rear = places.depth[p] - places.length[j]
            value = away + (rear if virtual else max(rear, 0.0))
            if j != i and value <= hidden:
                told = not here and rear < 0.0 and _told(places, i, k, j, r, inside)
                if not told:
                    if count < len(other):
                        # While its rear still is on another track, its being ahead clears nothing here.
                        clipped = not virtual and not here and rear < 0.0
                        other[count], room[count], sense[count], sure[count] = j, value, 0 if clipped else 1, r != PERHAPS
                    count += 1
                front = away + places.depth[p]
                if r >= 0 and (not told or r == ways.first[j]) and front < hidden and _runs_along(places, i, k, j, r):
                    hidden, hides, shift = front, j, r - k
            p += 1
    for q in range(places.own_first[i], places.own_first[i + 1]):
        own = places.own[q]
        if not virtual:  # whoever it is, the join is to be kept clear
            value = ways.begin[places.join_row[own]] - s[i]
            guard = _approach(places, hides, places.join_row[own] + shift) if hides >= 0 and value > hidden else -1
            j = _first_to_join(places, i, own, guard)
            if j >= 0 and value <= places.horizon:
                if count < len(other):
                    other[count], room[count], sense[count], sure[count] = j, value, 0, True
                count += 1
            continue
        p, value = _nearest_to_join(places, i, own, -1)
        if p >= 0 and hides >= 0 and value > hidden:
            p, value = _nearest_to_join(places, i, own, _approach(places, hides, places.join_row[own] + shift))
        while p >= 0 and value <= places.horizon:  # each hides who passes before it, not who passes between it and i
            if count < len(other):
                other[count], room[count], sense[count], sure[count] = places.join_train[p], value, 1, True
            count += 1
            p, value = _nearest_to_join(places, i, own, p)
    return count


@njit(cache=True)
def _told(places: Places, i: int, k: int, j: int, r: int, inside: float) -> bool:
    """Whether the piece of ``j`` at row k of the way of ``i`` goes on back over the edge before, and was counted there."""
    ways = places.ways
    e, b = ways.edge[k], ways.edge[k - 1]
    if r > ways.first[j]:
        return ways.edge[r - 1] == b and (k - 1 > places.row[i] or _deeper(places.s[j] - ways.begin[r - 1], j, inside, i))
    if places.twin[b] == e:  # the rear of a train lies straight
        return False
    if k - 1 > places.row[i]:
        return True
    for p in range(places.front[i] + 1, places.piece_first[b + 1]):
        if places.piece_train[p] == j and places.piece_row[p] < 0:
            return True
    return False


@njit(cache=True)
def _runs_along(places: Places, i: int, k: int, j: int, r: int) -> bool:
    """Whether ``j`` runs the way of ``i`` from their rows r and k as far as ``i`` looks."""
    ways = places.ways
    while k + 1 < ways.first[i + 1] and ways.begin[k + 1] - places.s[i] <= places.horizon:
        k, r = k + 1, r + 1
        if r == ways.first[j + 1] or ways.edge[k] != ways.edge[r]:
            return False
    return True


@njit(cache=True)
def _deeper(depth: float, j: int, inside: float, i: int) -> bool:
    """Whether train ``j`` is farther in than train ``i``, ties by number."""
    return depth > inside or (depth == inside and j < i)
