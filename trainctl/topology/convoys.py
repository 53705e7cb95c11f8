"""Formations along routes: every train is coupled to the next one ahead on its route, or drives alone.

A formation is a chain of coupled trains. It forms link by link: a train whose route leads behind another one draws near until
the law may take over, then it couples; it uncouples when another train comes between, when its way branches off, and when it has
to stop. So the order at a join of tracks is that of the trains that come, and no train has to know the net.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trainctl.signals import Bools, Floats, Ints, Links, Pace, References

#: Reference of one train alone, m behind which it draws near with a speed in proportion to the distance [s].
APPROACH_S = 20.0

#: Deceleration with which a train that draws near comes down to the speed of the one ahead [m/s2].
APPROACH_MPS2 = 0.1


class Spacing(NamedTuple):
    """What every link of a formation along routes has."""

    desired: float  # m, front to front
    lower: float  # m
    upper: float  # m
    weight: float


def references(pace: Pace, t: float) -> References:
    """References of trains that go on at constant acceleration from ``t`` [s], each of its own; copies."""
    n = len(pace.position)
    breaks = np.column_stack([np.full(n, t), np.full(n, np.inf)])
    position = np.column_stack([pace.position, pace.speed, 0.5 * pace.acceleration])
    return References(breaks, position[:, None], np.arange(n))


def fronts(ahead: Ints) -> Ints:
    """First train of the formation of each, shape (n,); ``ahead`` (n,) is the train each is coupled to, -1 if none."""
    front = np.where(ahead >= 0, ahead, np.arange(len(ahead)))
    while True:
        further = front[front]
        if np.array_equal(further, front):
            return further
        front = further


def front_to_rear(ahead: Ints) -> Ints:
    """All trains, formation by formation, front to rear, shape (n,)."""
    depth = (ahead >= 0).astype(np.int64)
    front = np.where(ahead >= 0, ahead, np.arange(len(ahead)))
    while not np.array_equal(front[front], front):
        depth, front = depth + depth[front], front[front]
    return np.lexsort((depth, front))


def slots(ahead: Ints, order: Ints, desired: float, lead: Floats) -> Floats:
    """Wanted position of every train relative to its formation's reference [m], (n,); ``lead`` (n,) is that of first trains."""
    slot = lead.copy()
    for i in order.tolist():
        if ahead[i] >= 0:
            slot[i] = slot[ahead[i]] - desired
    return slot


def links(ahead: Ints, order: Ints, slot: Floats, spacing: Spacing) -> Links:
    """The edge list of all formations: every train and the one it is coupled to receive from each other."""
    n = len(ahead)
    behind = np.flatnonzero(ahead >= 0)
    sender, receiver = np.concatenate([ahead[behind], behind]), np.concatenate([behind, ahead[behind]])
    forward = np.repeat([True, False], len(behind))
    by_receiver = np.lexsort((sender, receiver))
    sender, receiver, forward = sender[by_receiver], receiver[by_receiver], forward[by_receiver]
    return Links(
        sender=sender.astype(np.int64),
        receiver=receiver.astype(np.int64),
        first=np.searchsorted(receiver, np.arange(n + 1)).astype(np.int64),
        desired=np.where(forward, spacing.desired, -spacing.desired),
        lower=np.where(forward, spacing.lower, -spacing.upper),
        upper=np.where(forward, spacing.upper, -spacing.lower),
        weight=np.full(len(sender), spacing.weight),
        heard=np.ones(len(sender), bool),
        slot=slot,
        order=order.astype(np.int64),
    )


def broken(ahead: Ints, next_ahead: Ints, willing: Bools) -> Ints:
    """Trains that must uncouple: another one is ahead now, or one of the two does not take part any more."""
    coupled = np.flatnonzero(ahead >= 0)
    lost = (next_ahead[coupled] != ahead[coupled]) | ~willing[coupled] | ~willing[ahead[coupled]]
    found: Ints = coupled[lost]
    return found


def candidates(ahead: Ints, next_ahead: Ints, next_behind: Ints, willing: Bools) -> Ints:
    """Trains that could couple to the next one ahead: both willing, and none nearer to it."""
    free = np.flatnonzero((ahead < 0) & (next_ahead >= 0) & willing)
    other = next_ahead[free]
    free = free[willing[other] & (next_behind[other] == free)]
    front = fronts(ahead)
    ring = front[next_ahead[free]] == front[free]  # on a ring line the first train may have the last one ahead
    found: Ints = free[~ring]
    return found


def closing_speed(error: Floats) -> Floats:
    """Speed relative to the train ahead with which a spacing ``error`` [m] too large is closed [m/s]; negative opens."""
    size = np.abs(error)
    speed: Floats = np.sign(error) * np.minimum(size / APPROACH_S, np.sqrt(2.0 * APPROACH_MPS2 * size))
    return speed
