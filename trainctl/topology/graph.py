"""Who receives from whom: a pure function of positions, tracks and a rule.

A ``Plan`` is what the scenario says, fixed for the run; ``links`` turns it, with tracks and order, into the edge list the laws see.
Spacings are front to front.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from trainctl.signals import Bools, Floats, Ints, Links


class Stated(NamedTuple):
    """What a [[link]] table states about one pair; None: from the slots."""

    desired: float | None
    lower: float | None
    upper: float | None
    weight: float | None


class Plan(NamedTuple):
    """The scenario's rule, trains as in its tables; ``place`` (n,) is which each is in the formation, 0 the first.

    ``desired``, ``lower``, ``upper`` (n - 1,) belong to consecutive places; ``stated`` to (sender, receiver), mirrored where both
    receive from each other; ``extra`` are such pairs that do so whenever both are on one track, ``fixed`` the directed pairs of
    rule "links".
    """

    rule: Literal["same_track", "links"]
    equal: bool
    first_slot: float
    desired: Floats
    lower: Floats
    upper: Floats
    weight: float
    stated: dict[tuple[int, int], Stated]
    extra: tuple[tuple[int, int], ...]
    fixed: tuple[tuple[int, int], ...]
    place: Ints

    @property
    def slot(self) -> Floats:
        """Wanted position of every train relative to the reference [m], shape (n,)."""
        slots: Floats = (self.first_slot - np.concatenate([[0.0], np.cumsum(self.desired)]))[self.place]
        return slots


def gaps(plan: Plan, sender: Ints, receiver: Ints, ahead: Bools) -> Floats:
    """Desired spacing x_sender - x_receiver, its bounds and the weight of directed links, shape (4, L).

    The sums over the consecutive links between their slots: where a train left, the new link spans its hole. ``ahead`` (L,) says
    whether the sender runs ahead, for formations without slots. What the scenario states comes on top, see ``links``.
    """
    if plan.equal:
        begin, end = np.zeros_like(sender), np.ones_like(sender)
    else:
        s, r = plan.place[sender], plan.place[receiver]
        begin, end, ahead = np.minimum(s, r), np.maximum(s, r), s < r
    bounds = np.column_stack([begin, end]).ravel()
    desired, lower, upper = (
        np.add.reduceat(np.append(row, 0.0), bounds)[::2] if len(bounds) else np.zeros(0)
        for row in (plan.desired, plan.lower, plan.upper)
    )
    rows = np.where(ahead, [desired, lower, upper], [-desired, -upper, -lower])
    return np.vstack([rows, np.full(len(sender), plan.weight)])


def order_on_tracks(position: Floats, track: Ints) -> Ints:
    """All trains, track by track, front to rear, shape (n,)."""
    return np.lexsort((-position, track))


def in_order(order: Ints, position: Floats, track: Ints) -> bool:
    """Whether ``order`` still is that of positions and tracks."""
    p, t = position[order], track[order]
    same = t[1:] == t[:-1]
    return bool((t[1:] >= t[:-1]).all() and not (same & (p[1:] > p[:-1])).any())


def pairs(plan: Plan, order: Ints, track: Ints) -> Ints:
    """Undirected edges (ahead, behind) of rule "same_track", shape (2, k): neighbours front to rear, then what is extra."""
    beside = track[order[:-1]] == track[order[1:]]
    near = np.stack([order[:-1][beside], order[1:][beside]])
    if not plan.extra:
        return near
    known = set(zip(*near.tolist(), strict=True))
    more = [(a, b) for a, b in plan.extra if track[a] == track[b] and (a, b) not in known]
    return np.hstack([near, np.array(more, np.int64).reshape(-1, 2).T])


def closed_up(plan: Plan, order: Ints, track: Ints) -> Floats:
    """Wanted position of every train relative to the reference [m], (n,), where the trains of each track keep equal spacings."""
    begins = np.flatnonzero(np.concatenate([[True], track[order[1:]] != track[order[:-1]]]))
    place = np.arange(len(order)) - np.repeat(begins, np.diff(np.append(begins, len(order))))
    slots = np.empty(len(order))
    slots[order] = plan.first_slot - (plan.desired[0] if len(plan.desired) else 0.0) * place
    return slots


def links(plan: Plan, order: Ints, track: Ints) -> Links:
    """The directed edge list for trains on ``track`` (n,) in ``order`` (n,), from ``order_on_tracks``."""
    n = len(track)
    if plan.rule == "links":
        sender, receiver = np.array(plan.fixed, np.int64).reshape(-1, 2).T
    else:
        edge = pairs(plan, order, track)
        sender, receiver = np.hstack([edge, edge[::-1]])
    by_receiver = np.lexsort((sender, receiver))
    sender, receiver = sender[by_receiver].copy(), receiver[by_receiver].copy()
    rank = np.empty(n, np.int64)
    rank[order] = np.arange(n)
    table = gaps(plan, sender, receiver, rank[sender] < rank[receiver])
    if plan.stated:
        key = receiver * n + sender
        for (s, r), said in plan.stated.items():
            for k in np.flatnonzero(key == r * n + s).tolist():
                table[:, k] = [old if new is None else new for new, old in zip(said, table[:, k], strict=True)]
    return Links(
        sender=sender,
        receiver=receiver,
        first=np.searchsorted(receiver, np.arange(n + 1)).astype(np.int64),
        desired=table[0].copy(),
        lower=table[1].copy(),
        upper=table[2].copy(),
        weight=table[3].copy(),
        heard=np.ones(len(sender), bool),
        slot=closed_up(plan, order, track) if plan.equal else plan.slot,
        order=np.asarray(order, np.int64).copy(),
    )


def components(n: int, sender: Ints, receiver: Ints) -> list[list[int]]:
    """Sets of trains that are joined by links, in either direction."""
    root = list(range(n))

    def find(i: int) -> int:
        while root[i] != i:
            root[i] = root[root[i]]
            i = root[i]
        return i

    for a, b in zip(sender, receiver, strict=True):
        root[find(int(a))] = find(int(b))
    groups: dict[int, list[int]] = {}
    for i in range(n):
        groups.setdefault(find(i), []).append(i)
    return list(groups.values())


def edges(now: Links, ids: Sequence[str]) -> list[list[str]]:
    """The edge list by names: undirected edges once with the train ahead first, one-way links as [sender, receiver]."""
    directed = {(int(s), int(r)): d for s, r, d in zip(now.sender, now.receiver, now.desired, strict=True)}
    rank = {int(i): k for k, i in enumerate(now.order)}
    seen = [(s, r) for s, r in directed if (r, s) not in directed or rank[s] < rank[r]]
    return [[ids[s], ids[r]] for s, r in sorted(seen, key=lambda e: (rank[e[0]], rank[e[1]]))]


def reach(position: Floats, now: Links, radius: float) -> Bools:
    """Which links are short enough for a message, shape (L,)."""
    return np.abs(position[now.sender] - position[now.receiver]) <= radius
