"""What the agent of a train sees, what is judged of it, and the reward that is made of that."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from trainctl.kernels import keep_by_sources
from trainctl.signals import POSITION, SPEED, Bools, Floats, Ints, Links
from trainctl.stages.control import Exchanged

keep_by_sources()  # before anything below is decorated

#: What an agent sees of its own train; then come, for every link it receives on, ``of_links``.
OWN = ("place_m", "speed_error_mps", "speed_mps", "resistance_mps2")

#: Scales of the usual reward: a spacing error [m], a speed error [m/s] and an acceleration [m/s2] that cost 1 each.
ERROR_M, OFF_MPS, ACCELERATION_MPS2 = 100.0, 5.0, 1.0

#: What it costs the trains of a run when two of them touch.
TOUCH = 1000.0


class Judged(NamedTuple):
    """What a control period has come to, by true places, shape (N,); of links the trains receive on."""

    error_m: Floats  # root mean square of the spacing errors at its end; 0 without links
    speed_error_mps: Floats  # against the reference
    acceleration_mps2: Floats  # mean
    margin_m: Floats  # minimum margin of the spacings to their bounds, negative: violated; inf without links
    touches: Bools  # trains of its run have touched


def columns(places: int, words: int) -> tuple[str, ...]:
    """Names of what an agent sees, for so many links and messages of so many numbers."""
    each = [("came", "error_m", *(f"said_{c}" for c in range(1, words))) for _ in range(places)]
    return (*OWN, *(f"link_{j}_{name}" for j, names in enumerate(each) for name in names))


def seen(exchanged: Exchanged, width: int) -> Floats:
    """What every agent sees, (N, width), as ``columns`` names it.

    ``place_m`` is the measured place against that in its formation (against the reference, where there are no slots),
    ``resistance_mps2`` running resistance and gradient as the train believes them. Of a link: whether its message came in this
    instant; by how much that, less what the own train says, is off the desired spacing; the other numbers of the message, less
    what the own train says. A message is the law's own, as its module tells, and the last one stays until a newer one comes.
    """
    trains, leader, messages, links = exchanged.trains, exchanged.leader, exchanged.messages, exchanged.links
    out = np.empty((len(trains.speed), width))
    _see(
        trains.position - leader[POSITION], trains.speed, trains.speed - leader[SPEED], trains.resistance, exchanged.said,
        links.first, links.desired, links.slot, links.heard, messages.heard, messages.ever, out,
    )  # fmt: skip
    return out


@njit(cache=True)
def _see(
    place: Floats, speed: Floats, off: Floats, resistance: Floats, said: Floats, first: Ints, desired: Floats, slots: Floats,
    came: Bools, heard: Floats, ever: Bools, out: Floats,
) -> None:  # fmt: skip
    words, own = said.shape[1], 4
    places = (out.shape[1] - own) // (1 + words)
    for i in range(len(place)):
        slot = slots[i] if slots[i] == slots[i] else 0.0  # there are none
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = place[i] - slot, off[i], speed[i], resistance[i]
        for j in range(places):
            k, at = first[i] + j, own + j * (1 + words)
            if k < first[i + 1] and ever[k]:
                out[i, at] = 1.0 if came[k] else 0.0
                out[i, at + 1] = heard[k, 0] - said[i, 0] - desired[k]
                for c in range(1, words):
                    out[i, at + 1 + c] = heard[k, c] - said[i, c]
            else:
                for c in range(1 + words):
                    out[i, at + c] = 0.0


def judge(links: Links, position: Floats, over: Bools, run: Ints) -> tuple[Floats, Floats, Bools]:
    """Errors, margins and who touches, (N,) each, as in ``Judged``.

    ``over`` (R,) are the runs in which trains touched, ``run`` (N,) whose they are.
    """
    error, margin, touches = np.empty(len(run)), np.empty(len(run)), np.empty(len(run), bool)
    _judge(links.first, links.sender, links.desired, links.lower, links.upper, position, over, run, error, margin, touches)
    return error, margin, touches


@njit(cache=True)
def _judge(
    first: Ints, sender: Ints, desired: Floats, lower: Floats, upper: Floats, position: Floats, over: Bools, run: Ints,
    error: Floats, margin: Floats, touches: Bools,
) -> None:  # fmt: skip
    for i in range(len(position)):
        squares, least = 0.0, np.inf
        for k in range(first[i], first[i + 1]):
            spacing = position[sender[k]] - position[i]
            squares += (spacing - desired[k]) ** 2
            least = min(least, min(spacing - lower[k], upper[k] - spacing))
        count = first[i + 1] - first[i]
        error[i] = np.sqrt(squares / count) if count > 0 else 0.0
        margin[i], touches[i] = least, over[run[i]]


@njit(cache=True)
def cut(actions: Floats, limit: float, out: Floats) -> int:
    """Write ``actions`` (N,) into ``out``, cut off at plus and minus ``limit``; the first one that is not finite, -1: all are."""
    for i in range(len(actions)):
        if not abs(actions[i]) < np.inf:
            return i
        out[i] = min(max(actions[i], -limit), limit)
    return -1


@njit(cache=True)
def touch(position: Floats, ahead: Ints, length: Floats, run: Ints, over: Bools) -> None:
    """Write into ``over`` (R,) in which runs a train has touched the one ahead of it in its formation (N,), or is lost."""
    for i in range(len(position)):
        j = ahead[i]
        if (j >= 0 and position[j] - length[j] <= position[i]) or not abs(position[i]) < np.inf:
            over[run[i]] = True


def usual_reward(judged: Judged) -> Floats:
    """Minus the squares of spacing error, speed error and acceleration, each by its scale, and what touching costs, (N,)."""
    reward = np.empty(len(judged.error_m))
    _reward(judged, reward)
    return reward


@njit(cache=True)
def _reward(judged: Judged, reward: Floats) -> None:
    for i in range(len(reward)):
        e, v, a = judged.error_m[i] / ERROR_M, judged.speed_error_mps[i] / OFF_MPS, judged.acceleration_mps2[i] / ACCELERATION_MPS2
        reward[i] = -(e * e + v * v + a * a) - (TOUCH if judged.touches[i] else 0.0)
