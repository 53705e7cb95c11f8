"""watching: a continuous law of somebody else's that says what it watches, and does nothing to keep it."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from trainctl.kernels import inlined
from trainctl.signals import SPEED, Floats, Ints, Links, Scene, Table

CLOCK: Literal["continuous"] = "continuous"
ORDER: Literal["parallel"] = "parallel"
PLANTS = ("coupled_units", "actuated_units")
OBSERVERS = ("none", "asymptotic", "intermediate")
MESSAGE = 1
WATCHED = ("slip_mps", "unbounded_m")


class Params(Table):
    """Keys of ``[controller]``."""

    slip_upper_mps: float = 2.5
    push_n: float = 0.0


class Constants(NamedTuple):
    """The same as numbers."""

    push: float


def violations(params: Params, scene: Scene) -> list[str]:
    """None."""
    return []


def constants(params: Params, scene: Scene) -> Constants:
    """What the compiled functions get."""
    return Constants(params.push_n)


def watched_bounds(params: Params, scene: Scene) -> tuple[Floats, Floats]:
    """Of the slip above only."""
    n, free = len(scene.trains), np.inf
    return np.full((n, 2), -free), np.tile([params.slip_upper_mps, free], (n, 1))


@inlined()
def demand(
    i: int, constants: Constants, leader: Floats, age: float, slot: float, own: Floats, estimate: Floats, correction: Floats,
    desired: Floats, heard: Floats, out: Floats,
) -> None:  # fmt: skip
    """The same force everywhere."""
    for j in range(len(out)):
        out[j] = constants.push


@inlined()
def message(
    i: int, constants: Constants, leader: Floats, slot: float, own: Floats, estimate: Floats, estimate_rate: Floats, out: Floats
) -> None:
    """Nothing to say, shape (1,)."""
    out[0] = 0.0


@inlined()
def watch(i: int, constants: Constants, leader: Floats, first: Ints, own: Floats, links: Links, out: Floats) -> None:
    """How much faster than the reference the head is, and something without bounds."""
    out[0] = own[first[i], SPEED] - leader[1]
    out[1] = 0.0
