"""What lies ahead of every train, for its driver and for the supervisor: other trains, switches that are not its own, limits."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from trainctl.kernels import keep_by_sources
from trainctl.railway import along
from trainctl.railway.along import Ahead
from trainctl.railway.bodies import Bodies, bodies, fouling
from trainctl.railway.supervisor import LIMIT, OPPOSING, SWITCH, TRAIN, Assumed, Limits, Params, Targets, Verdict, verdict
from trainctl.railway.ways import Ways
from trainctl.railway.zones import short_of_junctions
from trainctl.signals import Bools, Floats, Ints

keep_by_sources()  # before anything below is decorated


#: What the driver keeps clear beyond the supervisor's margin, so that the latter has nothing to do [m].
DRIVER_MARGIN_M = 10.0


class View(NamedTuple):
    """What is ahead of every train now."""

    ahead: Ahead
    targets: Targets  # a train that joins ahead counts as if it were on the own track already
    clear: Targets  # before a train that joins ahead the join itself is kept clear; a train needs to heed one of the two only
    limits: Limits
    room: Floats  # (n,) m, to the body on the own way that surely is there; inf: none
    body: Ints  # (n,) whose it is, -1: none
    fouling: Bools  # (n,) it lies on another train, where none came up to it, see ``railway.bodies``


def look(
    ways: Ways, net: along.Net, limit: Floats, falls: Bools, factor: Floats, row: Ints, s: Floats, speed: Floats, length: Floats,
    present: Bools, horizon: float, end: Floats, order: along.Order | None, internal: Bools, at: int = SWITCH,
    back: Bools | None = None,
) -> View:  # fmt: skip
    """Look ahead along the ways of all trains.

    Parameters
    ----------
    ways : Ways
        Of all n trains.
    net : Net
        Of the railway, see ``along.net``.
    limit : ndarray, shape (E,)
        Maximum speed on every edge [m/s].
    falls : ndarray of bool, shape (E,)
        Where that is about to fall: only half the distance is given, since half the braking is left for it.
    factor : ndarray, shape (n,)
        Share of that which every train keeps to.
    row, s, speed, length, present : ndarray, shape (n,)
        Row in the ways, front [m], speed [m/s], length [m], and whether it is on the net.
    horizon : float
        How far to look [m].
    end : ndarray, shape (n,)
        How far every front may go because what comes then is another train's turn [m]; inf: as far as it likes.
    order : Order, optional
        Turns that are decided, see ``interlocking.order``.
    internal : ndarray of bool, shape (E,)
        Edges inside junctions: whoever keeps a join clear stops before its junction.
    at : int
        What trains are held at: place in ``supervisor.KINDS``.
    back : ndarray of bool, shape (n,), optional
        Trains that are to come back from where they were parked, see ``bodies.fouling``.

    Returns
    -------
    View
        Targets are the bodies ahead and the places where trains are held, limits those of the edges under every train and ahead.
    """
    placed = along.places(ways, net, row, s, length, present, horizon, order)
    there = _short(bodies(placed, virtual=False), ways, net, internal, row, s)
    clear = _targets(there, end, speed, present, at)
    targets = _targets(bodies(placed), end, speed, present, at) if len(placed.join_train) else clear
    room, body = np.full(len(row), np.inf), np.full(len(row), -1, np.int64)
    far_first = np.argsort(-there.room)
    real = far_first[(there.sense[far_first] != 0) & there.sure[far_first]]
    room[there.train[real]], body[there.train[real]] = there.room[real], there.other[real]  # the nearest is written last
    limits = Limits(*_limits(ways, limit, falls, factor, row, s, length, present, horizon))
    return View(
        along.ahead(placed), targets, clear, limits, room, body, fouling(placed, np.zeros(len(row), bool) if back is None else back)
    )


def _short(there: Bodies, ways: Ways, net: along.Net, internal: Bools, row: Ints, s: Floats) -> Bodies:
    """Bodies with the room to what is to be kept clear, but not onto its junction."""
    if not internal.any() or not (clear := there.sense == 0).any():
        return there
    room = there.room.copy()
    room[clear] = short_of_junctions(ways, net, internal, there.train[clear], row, s, room[clear])
    return there._replace(room=room)


def _targets(body: Bodies, end: Floats, speed: Floats, present: Bools, at: int) -> Targets:
    """Bodies in the way, and the places where trains are held.

    Who comes the other way beyond the place where a train is held turns off before, or is held itself.
    """
    blocked = np.flatnonzero(present[body.train] & ((body.sense >= 0) | (body.room < end[body.train])))
    kind = np.where(body.sense > 0, TRAIN, np.where(body.sense < 0, OPPOSING, SWITCH))[blocked]
    waits = np.flatnonzero(np.isfinite(end) & present)
    return Targets(
        train=np.concatenate([body.train[blocked], waits]),
        room=np.concatenate([body.room[blocked], end[waits]]),
        speed=np.concatenate([np.where(kind == SWITCH, 0.0, speed[body.other[blocked]]), np.zeros(len(waits))]),
        moving=np.concatenate([kind != SWITCH, np.zeros(len(waits), bool)]),
        kind=np.concatenate([kind, np.full(len(waits), at)]).astype(np.int64),
        other=np.concatenate([body.other[blocked], np.full(len(waits), -1)]),
    )


def stop_before(ways: Ways, row: Ints, s: Floats, edge: int, place: float, can: Floats) -> tuple[Ints, Floats]:
    """Trains that come to a ``place`` [m] on an edge and ``can`` (n,) still stop in that way [m], and how far it is there [m].

    Other arguments are those of ``look``.
    """
    rows = np.flatnonzero(ways.edge == edge)
    train = np.searchsorted(ways.first, rows, side="right") - 1
    room = ways.begin[rows] + place - s[train]
    there = (rows >= row[train]) & (room > can[train])
    return train[there], room[there]


@njit(cache=True)
def _limits(
    ways: Ways, limit: Floats, falls: Bools, factor: Floats, row: Ints, s: Floats, length: Floats, present: Bools, horizon: float
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
                v, away = factor[i] * limit[ways.edge[k]], ways.begin[k] - s[i]
                sooner = away > 0.0 and falls[ways.edge[k]]
                if away <= 0.0 or v < last or sooner:  # one that is no lower than the one before adds nothing
                    if again:
                        train[count], distance[count], speed[count] = i, 0.5 * away if sooner else away, v
                    count += 1
                last = v
                k += 1
    return train, distance, speed


def with_targets(targets: Targets, train: Ints, room: Floats, kind: int) -> Targets:
    """Targets and points that lie ``room`` [m] ahead of the trains ``train``."""
    n = len(train)
    return Targets(
        train=np.concatenate([targets.train, train]),
        room=np.concatenate([targets.room, room]),
        speed=np.concatenate([targets.speed, np.zeros(n)]),
        moving=np.concatenate([targets.moving, np.zeros(n, bool)]),
        kind=np.concatenate([targets.kind, np.full(n, kind, np.int64)]),
        other=np.concatenate([targets.other, np.full(n, -1, np.int64)]),
    )


def judge(
    params: Params, speed: Floats, targets: Targets, clear: Targets, limits: Limits, step: float, theta: float, assumed: Assumed,
    acceleration: Floats, swing: Floats | None = None,
) -> Verdict:  # fmt: skip
    """What every train may do: following the one that joins ahead, or keeping the join clear, whichever leaves more.

    ``target`` of the verdict counts rows of ``clear`` on from those of ``targets``. Arguments as in ``supervisor.verdict``.
    """
    follows = verdict(params, speed, targets, limits, step, theta, assumed, acceleration, swing)
    if targets is clear:
        return follows
    waits = verdict(params, speed, clear, limits, step, theta, assumed, acceleration, swing)
    other = waits.maximum > follows.maximum
    waits = waits._replace(target=waits.target + np.where((waits.reason >= 0) & (waits.reason != LIMIT), len(targets.train), 0))
    return Verdict(
        maximum=np.where(other, waits.maximum, follows.maximum),
        minimum=follows.minimum,
        emergency=np.where(other, waits.emergency, follows.emergency),
        reason=np.where(other, waits.reason, follows.reason),
        target=np.where(other, waits.target, follows.target),
        strongest=follows.strongest,
    )


def measured(targets: Targets, limits: Limits, error: Floats) -> tuple[Targets, Limits]:
    """What trains know whose positions are measured with an ``error`` (n,), measured minus true position [m]."""
    if not error.any():
        return targets, limits
    other = np.where(targets.other >= 0, error[targets.other], 0.0)
    ways = np.where(targets.kind == OPPOSING, -other, other)  # the front of one that comes: an error of its own way
    room = targets.room + ways - error[targets.train]
    return targets._replace(room=room), limits._replace(distance=limits.distance - error[limits.train])


def of(targets: Targets, kept: Bools) -> Targets:
    """Those targets whose row is kept."""
    t = targets
    return Targets(t.train[kept], t.room[kept], t.speed[kept], t.moving[kept], t.kind[kept], t.other[kept])
