"""What laws that follow the train ahead have in common: whom they follow, what that one said, and where it is by now.

Symbols
-------
x, v, a   front position [m], speed [m/s] and acceleration [m/s2] of a train; _l: of the train it follows
x_r, v_r  position [m] and speed [m/s] of the reference
d         desired spacing at the speed of the reference, front to front [m]

Every train says ``(x - x_r, v, a, x_r, b)``, its full braking b and a 1 that tells a message from silence. Where a message is
old, the way of the reference since then tells how old, and the train ahead is taken to have gone on at its speed; if it braked,
to brake on.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from trainctl.controllers import stated
from trainctl.signals import POSITION, SPEED, Bools, Bounds, Floats, Ints, Links, Reference, Scene, Trains, leader_at

#: A reference slower than this does not tell the time [m/s].
STANDS_MPS = 0.1

#: Speed feedback of a train that follows none, and of all below the maximum speed [1/s]: while it is slower than it wants, and
#: faster, so that unknown forces do not take it past the maximum; the second is less with long control periods.
CRUISE_PER_S, TOO_FAST_PER_S = 0.1, 0.5

#: Share of the room between the speed of the reference and the maximum speed that closing up may use.
ROOM_TO_CLOSE_UP = 0.6

#: Columns of a message.
PLACE, SAID_SPEED, SAID_ACCELERATION, SAID_REFERENCE, SAID_BRAKING, SAID = range(6)


class Followed(NamedTuple):
    """The nearest train ahead that each train receives from, shape (n,)."""

    follows: Bools  # there is one
    row: Ints  # of the link; 0 where there is none
    desired: Floats  # m, d
    length: Floats  # m, of the train ahead


class Seen(NamedTuple):
    """What is known of the train ahead now, shape (n,); where there is none, or it never said a word, the reference itself."""

    known: Bools
    spacing: Floats  # m, front to front
    speed: Floats  # m/s
    acceleration: Floats  # m/s2
    braking: Floats  # m/s2, its full braking


def followed(scene: Scene) -> Followed:
    """Whom every train follows: of those ahead that it receives from the one with the smallest desired spacing."""
    links, n = scene.links, len(scene.trains)
    rows = np.flatnonzero(links.desired > 0.0)
    rows = rows[np.lexsort((links.desired[rows], links.receiver[rows]))]
    who, begins = np.unique(links.receiver[rows], return_index=True)
    row, follows = np.zeros(n, np.int64), np.zeros(n, bool)
    row[who], follows[who] = rows[begins], True
    desired, length = np.full(n, np.inf), np.zeros(n)
    desired[follows] = links.desired[row[follows]]
    length[follows] = scene.consists.train_length()[links.sender[row[follows]]]
    return Followed(follows, row, desired, length)


def said(own: Trains, leader: Floats, acceleration: Floats, braking: Floats) -> Floats:
    """What every train sends, shape (n, 6): see the columns above."""
    n = len(own.speed)
    at = np.broadcast_to(leader[POSITION], n)
    return np.column_stack((own.position - at, own.speed, acceleration, at, braking, np.ones(n)))


def seen(who: Followed, own: Trains, leader: Floats, links: Links, heard: Floats) -> Seen:
    """What is known of the train ahead, from the last message of its link ``heard`` (L, 6)."""
    n = len(own.speed)
    position, speed = (np.broadcast_to(leader[k], n) for k in (POSITION, SPEED))
    words = heard[who.row] if len(heard) else np.zeros((n, SAID + 1))
    known = who.follows & (words[:, SAID] > 0.0)
    v, a = words[:, SAID_SPEED], np.minimum(words[:, SAID_ACCELERATION], 0.0)
    since = position - words[:, SAID_REFERENCE]
    age = np.where(known & (speed > STANDS_MPS), np.maximum(since, 0.0) / np.maximum(speed, STANDS_MPS), 0.0)
    moves = np.minimum(age, np.where(a < 0.0, v / np.maximum(-a, 1e-12), np.inf))  # until it stands
    place = words[:, PLACE] - since + v * moves + 0.5 * a * moves**2
    now = np.maximum(v + a * moves, 0.0)
    stands = known & (moves < age)
    return Seen(
        known, np.where(known, place - (own.position - position), np.inf), np.where(known, now, speed),
        np.where(known & ~stands, words[:, SAID_ACCELERATION], 0.0), words[:, SAID_BRAKING],
    )  # fmt: skip


def cruising(own: Trains, leader: Floats, follows: Bools, faster: float, upper: Floats, period: float) -> Floats:
    """Acceleration that takes a train to the reference's speed; one that follows another to at most ``faster`` above it.

    A part of the room below the maximum speed ``upper`` (n,) [m/s] is left for what disturbs. ``period`` is the control period [s].
    """
    n = len(own.speed)
    reference = np.broadcast_to(leader[SPEED], n)
    room = ROOM_TO_CLOSE_UP * np.maximum(upper - reference, 0.0)
    speed = np.minimum(reference, upper) + np.where(follows, np.minimum(faster, room), 0.0)
    gain = np.where(own.speed > speed, max(min(TOO_FAST_PER_S, 0.5 / period), CRUISE_PER_S), CRUISE_PER_S)
    wanted: Floats = np.broadcast_to(leader[2], n) + gain * (speed - own.speed)
    return wanted


def combined(asked: Floats, cruise: Floats, follows: Bools, known: Bools) -> Floats:
    """Who follows does not run away from the train ahead; who has not heard of it does not accelerate; the others cruise."""
    following = np.where(known, np.minimum(asked, cruise), np.minimum(cruise, 0.0))
    return np.where(follows, following, cruise)


def within(asked: Floats, brakes: Floats, pulls: float, bounds: Bounds, own: Trains) -> tuple[Floats, Bools]:
    """Keep what is asked for to ``-brakes`` .. ``pulls`` [m/s2] and the input to its bounds; and whether that acted, (n,)."""
    lower = np.maximum(-brakes, bounds.input_lower - own.resistance)
    given = np.maximum(np.minimum(asked, np.minimum(pulls, bounds.input_upper - own.resistance)), lower)
    return given, given != asked


def full_braking(scene: Scene, stated: float | None) -> Floats:
    """Deceleration every train is sure of [m/s2], (n,): as stated, else what its brakes and the bound of its input give."""
    first = scene.consists.first[:-1]
    brakes = np.add.reduceat(scene.consists.braking, first) / np.add.reduceat(scene.consists.mass * scene.consists.rotating, first)
    found: Floats = np.minimum(brakes, -scene.bounds.input_lower)
    return found if stated is None else np.full(len(found), stated)


def fastest(reference: Reference) -> float:
    """Maximum speed of the reference, looked up at both ends of its pieces [m/s]."""
    out, speeds = np.empty(4), []
    for start, end in zip(reference.breaks[:-1], reference.breaks[1:], strict=True):
        for t in (start, end):
            if np.isfinite(t):
                leader_at(reference, t, start, out)
                speeds.append(out[SPEED])
    return float(max(speeds))


def named(scene: Scene, who: Followed, i: int) -> str:
    """The link on which train ``i`` receives from the one it follows, as mistakes name it."""
    return f"link[{scene.trains[scene.links.sender[who.row[i]]]},{scene.trains[i]}]"


def braking_violations(scene: Scene, brakes: Floats, key: str) -> Iterator[str]:
    """Trains whose braking is not stated."""
    for i in np.flatnonzero(~np.isfinite(brakes)).tolist():
        yield (f"{key}: missing; train {scene.trains[i]} has neither braking_n nor an input bound from which its braking follows")


def spectral_radius(scene: Scene, k_p: float, k_v: float) -> float:
    """Of one train behind another that keeps its speed, over a control period; gains of spacing [1/s2] and speed [1/s]."""
    T, theta = scene.control_period, scene.lead
    loop = np.array([[1.0 - theta * T * T * k_p, T - theta * T * T * k_v], [-T * k_p, 1.0 - T * k_v]])
    return float(np.abs(np.linalg.eigvals(loop)).max())


# In comparisons


def alternative(tables: stated.Tables) -> dict[str, Any]:
    """Tables that put this law in front of the traffic of another."""
    return {"run": {**tables["run"], "control_period_s": stated.periods(tables["run"], 1.0)}}


def on_a_line(tables: stated.Tables, band: dict[str, float]) -> dict[str, Any]:
    """Tables of its row in `trainctl compare capacity`."""
    return {**alternative(tables), "bounds": {"speed_upper_mps": band["speed_upper_mps"]}}
