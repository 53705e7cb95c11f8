"""What lies ahead of every train, for its driver and for the supervisor: other trains, switches that are not its own, limits."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from trainctl.kernels import keep_by_sources
from trainctl.signals import Bools, Floats, Ints
from trainctl.supervisor import OPPOSING, SWITCH, TRAIN, Limits, Targets
from trainctl.topology import along
from trainctl.topology.along import Ahead
from trainctl.topology.ways import Ways

keep_by_sources()  # before anything below is decorated


class View(NamedTuple):
    """What is ahead of every train now."""

    ahead: Ahead
    targets: Targets
    limits: Limits
    room: Floats  # (n,) m, to the body ahead; inf: none
    body: Ints  # (n,) whose it is, -1: none


def look(
    ways: Ways, net: along.Net, limit: Floats, row: Ints, s: Floats, speed: Floats, length: Floats, present: Bools, horizon: float,
    held: Floats, order: along.Order | None,
) -> View:  # fmt: skip
    """Look ahead along the ways of all trains.

    Parameters
    ----------
    ways : Ways
        Of all n trains.
    net : Net
        Of the railway, see ``along.net``.
    limit : ndarray, shape (E,)
        Greatest speed on every edge [m/s].
    row, s, speed, length, present : ndarray, shape (n,)
        Row in the ways, front [m], speed [m/s], length [m], and whether it is on the net.
    horizon : float
        How far to look [m].
    held : ndarray, shape (n,)
        How far every front may go because what comes then is another train's turn [m]; inf: as far as it likes.
    order : Order, optional
        Turns that are decided, see ``topology.claims``.

    Returns
    -------
    View
        Targets are the bodies ahead and the places where trains are held, limits those of the edges under every train and ahead.
    """
    placed = along.places(ways, net, row, s, length, present, horizon, order)
    ahead, body = along.ahead(placed), along.obstacles(placed)
    blocked = np.flatnonzero((body.train >= 0) & present)
    kind = np.where(body.sense > 0, TRAIN, np.where(body.sense < 0, OPPOSING, SWITCH))[blocked]
    waits = np.flatnonzero(np.isfinite(held) & present)
    targets = Targets(
        train=np.concatenate([blocked, waits]),
        room=np.concatenate([body.room[blocked], held[waits]]),
        speed=np.concatenate([np.where(kind == SWITCH, 0.0, speed[body.train[blocked]]), np.zeros(len(waits))]),
        moving=np.concatenate([kind != SWITCH, np.zeros(len(waits), bool)]),
        kind=np.concatenate([kind, np.full(len(waits), SWITCH)]).astype(np.int64),
        other=np.concatenate([body.train[blocked], np.full(len(waits), -1)]),
    )
    return View(ahead, targets, Limits(*_limits(ways, limit, row, s, length, present, horizon)), body.room, body.train)


@njit(cache=True)
def _limits(
    ways: Ways, limit: Floats, row: Ints, s: Floats, length: Floats, present: Bools, horizon: float
) -> tuple[Ints, Floats, Floats]:
    """Train, distance and speed of the limits under every train and ahead of it within the horizon."""
    count = 0
    for again in range(2):
        if again:
            train, distance, speed = np.empty(count, np.int64), np.empty(count), np.empty(count)
        count = 0
        for i in range(len(row)):
            if not present[i]:
                continue
            k = row[i]
            while k > ways.first[i] and ways.begin[k] > s[i] - length[i]:
                k -= 1
            last = np.inf
            while k < ways.first[i + 1] and ways.begin[k] - s[i] < horizon:
                v = limit[ways.edge[k]]
                if ways.begin[k] <= s[i] or v < last:  # one that is no lower than the one before tells nothing new
                    if again:
                        train[count], distance[count], speed[count] = i, ways.begin[k] - s[i], v
                    count += 1
                last = v
                k += 1
    return train, distance, speed


def with_targets(targets: Targets, train: Ints, room: Floats, kind: int) -> Targets:
    """Targets and points that stand ``room`` [m] ahead of the trains ``train``."""
    n = len(train)
    return Targets(
        train=np.concatenate([targets.train, train]),
        room=np.concatenate([targets.room, room]),
        speed=np.concatenate([targets.speed, np.zeros(n)]),
        moving=np.concatenate([targets.moving, np.zeros(n, bool)]),
        kind=np.concatenate([targets.kind, np.full(n, kind, np.int64)]),
        other=np.concatenate([targets.other, np.full(n, -1, np.int64)]),
    )


def of(targets: Targets, kept: Bools) -> Targets:
    """Those targets whose row is kept."""
    t = targets
    return Targets(t.train[kept], t.room[kept], t.speed[kept], t.moving[kept], t.kind[kept], t.other[kept])
