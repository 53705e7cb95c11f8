"""Who hears whom: a pure function of positions, tracks and a rule.

A ``Plan`` is what the scenario says, fixed for the run; ``links`` turns it, with tracks and order, into the edge list the laws see.
Spacings are front to front.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
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
    """The scenario's rule, trains in formation order.

    ``desired``, ``lower``, ``upper`` (n - 1,) belong to consecutive trains; ``stated`` to (sender, receiver), mirrored where both
    hear each other; ``extra`` are pairs that hear each other whenever both are on one track, ``fixed`` the directed pairs of rule
    "links".
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

    @property
    def slot(self) -> Floats:
        """Wanted position of every train relative to the reference [m], shape (n,)."""
        return self.first_slot - np.concatenate([[0.0], np.cumsum(self.desired)])


class Gap(NamedTuple):
    """Desired spacing and bounds of one directed link [m]."""

    desired: float
    lower: float
    upper: float
    weight: float


def gap(plan: Plan, sender: int, receiver: int, ahead: bool) -> Gap:
    """Desired spacing x_sender - x_receiver and its bounds.

    What the scenario states, else the sums over the consecutive links between their slots: where a train left, the new link spans
    its hole. ``ahead`` says whether the sender runs ahead, for formations without slots.
    """
    a, b = min(sender, receiver), max(sender, receiver)
    span = slice(0, 1) if plan.equal else slice(a, b)
    desired, lower, upper = (float(s[span].sum()) for s in (plan.desired, plan.lower, plan.upper))
    if not (ahead if plan.equal else sender < receiver):
        desired, lower, upper = -desired, -upper, -lower
    said = plan.stated.get((sender, receiver), Stated(None, None, None, None))
    keep = (desired, lower, upper, plan.weight)
    return Gap(*(old if new is None else new for new, old in zip(said, keep, strict=True)))


def order_on_tracks(position: Floats, track: Ints) -> Ints:
    """All trains, track by track, front to rear, shape (n,)."""
    return np.lexsort((-position, track))


def in_order(order: Ints, position: Floats, track: Ints) -> bool:
    """Whether ``order`` still is that of positions and tracks."""
    p, t = position[order], track[order]
    same = t[1:] == t[:-1]
    return bool(np.all(t[1:] >= t[:-1]) and not np.any(same & (p[1:] > p[:-1])))


def pairs(plan: Plan, order: Ints, track: Ints) -> list[tuple[int, int]]:
    """Undirected edges (ahead, behind) of rule "same_track", front to rear."""
    near = [(int(a), int(b)) for a, b in pairwise(order) if track[a] == track[b]]
    known = set(near)
    more = [(a, b) for a, b in plan.extra if track[a] == track[b] and (a, b) not in known]
    return near + more


def links(plan: Plan, order: Ints, track: Ints) -> Links:
    """The directed edge list for trains on ``track`` (n,) in ``order`` (n,), from ``order_on_tracks``."""
    if plan.rule == "links":
        directed = list(plan.fixed)
    else:
        directed = [d for a, b in pairs(plan, order, track) for d in ((a, b), (b, a))]
    n = len(track)
    rank = np.empty(n, np.int64)
    rank[order] = np.arange(n)
    rows = [(receiver, sender, *gap(plan, sender, receiver, bool(rank[sender] < rank[receiver]))) for sender, receiver in directed]
    rows.sort(key=lambda r: (r[0], r[1]))
    table = np.array(rows, float).reshape(len(rows), 6)
    receiver = table[:, 0].astype(np.int64)
    return Links(
        sender=table[:, 1].astype(np.int64),
        receiver=receiver,
        first=np.searchsorted(receiver, np.arange(n + 1)).astype(np.int64),
        desired=table[:, 2].copy(),
        lower=table[:, 3].copy(),
        upper=table[:, 4].copy(),
        weight=table[:, 5].copy(),
        heard=np.ones(len(rows), bool),
        slot=plan.slot,
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
