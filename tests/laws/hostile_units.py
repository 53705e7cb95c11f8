"""hostile_units: a continuous law that does whatever harm it can with the forces of the units, as ``hostile`` does with trains."""

from __future__ import annotations

from typing import Literal, NamedTuple

from pydantic import Field

from trainctl.kernels import inlined
from trainctl.signals import POSITION, SPEED, Floats, Ints, Links, Scene, Table

CLOCK: Literal["continuous"] = "continuous"
ORDER: Literal["parallel"] = "parallel"
PLANTS = ("coupled_units", "actuated_units")
OBSERVERS = ("none", "asymptotic", "intermediate")
MESSAGE = 2
WATCHED: tuple[str, ...] = ()

#: Columns of an estimate, if there is one.
X, V, W = 0, 1, 2

STYLES = ("full", "bang", "attack", "late", "alternating", "apart", "noise", "huge", "first_brakes", "nan", "inching", "twitch",
          "neighbour")  # fmt: skip
FULL, BANG, ATTACK, LATE, ALTERNATING, APART, NOISE, HUGE, FIRST_BRAKES, NAN, INCHING, TWITCH, NEIGHBOUR = range(13)


class Params(Table):
    """Keys of ``[controller]``."""

    style: Literal[STYLES] = Field("full", description="Which harm.")  # type: ignore[valid-type]
    seed: int = Field(0, ge=0, description="Of everything drawn.")
    big_n: float = Field(1e6, gt=0.0, description="Force it asks of every unit, to and fro [N].")
    every_m: float = Field(500.0, gt=0.0, description="Way of the reference after which it draws anew [m].")


class Constants(NamedTuple):
    """The same as numbers."""

    style: int
    seed: float
    big: float
    every: float


def violations(params: Params, scene: Scene) -> list[str]:
    """None: it takes anything."""
    return []


def constants(params: Params, scene: Scene) -> Constants:
    """What the compiled functions get."""
    return Constants(STYLES.index(params.style), float(params.seed), params.big_n, params.every_m)


@inlined()
def chance(seed: float, a: float, b: float) -> float:
    """A number in [0, 1) that looks drawn."""
    x = (seed % 9973.0) * 0.6180339887 + a * 12.9898 + b * 78.233
    x = x - 6.283185307179586 * (x // 6.283185307179586)
    # a sine by its series around pi is not needed: any wild function will do
    y = 43758.5453 * x * (3.141592653589793 - x) * (1.0 + 0.37 * x)
    return y - y // 1.0


@inlined()
def demand(
    i: int, constants: Constants, leader: Floats, age: float, slot: float, own: Floats, estimate: Floats, correction: Floats,
    desired: Floats, heard: Floats, out: Floats,
) -> None:  # fmt: skip
    """Write the force of every unit [N] into ``out``."""
    c, big = constants, constants.big
    follows, gap, ahead = False, 1e9, 0.0
    for k in range(len(desired)):
        if desired[k] > 0.0:
            follows = True
            gap, ahead = min(gap, heard[k, 0] - own[0, POSITION]), heard[k, 1]
    count = leader[0] // c.every
    fast = leader[0] // 7.0
    even = count % 2.0 == 0.0
    for j in range(len(out)):
        f = big
        if c.style == BANG:
            f = -big if chance(c.seed, count, float(i)) < 0.5 else big
        elif c.style == ATTACK:
            f = big if follows or even else -big
        elif c.style == LATE:
            f = -0.05 * big if follows and gap < 400.0 else (big if follows or even else -big)
        elif c.style == ALTERNATING:
            f = big if ((i + count) % 2.0 == 0.0) else -big
        elif c.style == APART:  # the units of a train against each other
            f = big if ((j + count) % 2.0 == 0.0) else -big
        elif c.style == NOISE:
            f = big * (2.0 * chance(c.seed, fast, float(i)) - 1.0)
        elif c.style == HUGE:
            f = 1e300 if chance(c.seed, fast, float(i)) < 0.6 else -1e300
        elif c.style == FIRST_BRAKES:
            f = big if follows else -big
        elif c.style == INCHING:  # to a stand and on again within each stretch: the ends of steps need not show it
            f = big if follows and 0.05 < leader[0] % c.every / c.every < 0.25 else -big
        elif c.style == TWITCH:  # holds a round speed; pulls to the next as soon as anything in the step pushes it off
            f = -big if own[0, SPEED] % 1.0 < 0.02 else big
        elif c.style == NEIGHBOUR:  # goes for the one ahead while that one is slower, also when it is only now made to brake
            f = big if not follows or ahead < own[0, SPEED] else -big
        elif c.style == NAN and chance(c.seed, fast, float(i)) < 0.003:
            f = float("nan")
        out[j] = f


@inlined()
def message(
    i: int, constants: Constants, leader: Floats, slot: float, own: Floats, estimate: Floats, estimate_rate: Floats, out: Floats
) -> None:
    """Send place and speed of the head, shape (2,)."""
    out[0], out[1] = own[0, POSITION], own[0, SPEED]


@inlined()
def watch(i: int, constants: Constants, leader: Floats, first: Ints, own: Floats, links: Links, out: Floats) -> None:
    """Nothing is watched."""
