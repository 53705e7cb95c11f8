"""hostile: a sampled law that does whatever harm it can.

It remembers nothing: what it asks for follows from where its trains and its reference are, and from a seed. Where the reference is
stands for the time: every ``every_m`` of its way the law may think of something else.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from trainctl.signals import Demand, Floats, Links, Scene, Table, Trains

CLOCK: Literal["sampled"] = "sampled"
PLANTS = ("point", "coupled_units", "actuated_units")

STYLES = (
    "full", "bang", "attack", "late", "alternating", "wave", "noise", "huge", "first_brakes", "crawl", "nan",
)  # fmt: skip

#: Numbers that overflow when they are squared, added up or multiplied by a mass, and the smallest ones.
HUGE = np.array([1e300, -1e300, 1e308, -1e308, 1e-300, 0.0, -0.0])


class Params(Table):
    """Keys of ``[controller]``."""

    style: Literal[STYLES] = Field("full", description="Which harm.")  # type: ignore[valid-type]
    seed: int = Field(0, ge=0, description="Of everything drawn.")
    big_mps2: float = Field(10.0, gt=0.0, description="Acceleration it asks for, up and down [m/s2].")
    every_m: float = Field(500.0, gt=0.0, description="Way of the reference after which it draws anew [m].")


def violations(params: Params, scene: Scene) -> list[str]:
    """None: it takes anything."""
    return []


def constants(params: Params, scene: Scene) -> Params:
    """What ``demand`` gets."""
    return params


def message(constants: Params, own: Trains, leader: Floats) -> Floats:
    """Place and speed, shape (n, 2)."""
    return np.column_stack((own.position, own.speed))


def drawn(seed: int, stream: int, n: int, count: Floats) -> Floats:
    """Uniform numbers in [0, 1), one per train (n,), from the seed and whole numbers ``count`` (n,): splitmix64."""
    with np.errstate(over="ignore"):
        key = np.uint64(seed * 1000003 + stream * 7919) + np.arange(n, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        x = key + count.astype(np.int64).astype(np.uint64) * np.uint64(0xD1342543DE82EF95)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
            x = (x ^ (x >> np.uint64(shift))) * np.uint64(factor)
        x = x ^ (x >> np.uint64(31))
    found: Floats = (x >> np.uint64(11)).astype(np.float64) * 2.0**-53
    return found


def demand(constants: Params, own: Trains, leader: Floats, links: Links, heard: Floats) -> Demand:
    """Harm."""
    p, n, big = constants, len(own.speed), constants.big_mps2
    rank = np.empty(n, np.int64)
    rank[links.order] = np.arange(n)
    follows = np.zeros(n, bool)
    ahead = links.desired > 0.0
    follows[links.receiver[ahead]] = True
    count = np.floor(np.broadcast_to(leader[0], n) / p.every_m)  # trains that come and go have a reference each
    one, other = drawn(p.seed, 1, n, count), drawn(p.seed, 2, n, np.floor(np.broadcast_to(leader[0], n) / 7.0))
    stop_and_go = np.where(count % 2.0 == 0.0, big, -big)
    a = np.full(n, big)
    if p.style == "bang":
        a = np.where(one < 0.5, -big, big)
    elif p.style == "attack":  # the first stops and goes, all others go for the one ahead
        a = np.where(follows, big, stop_and_go)
    elif p.style == "late":  # pull until very near, then brake too late and too little
        gap = np.full(n, np.inf)
        np.minimum.at(gap, links.receiver[ahead], heard[ahead, 0] - own.position[links.receiver[ahead]])
        a = np.where(follows, np.where(gap < 400.0, -0.05, big), stop_and_go)
    elif p.style == "alternating":
        a = np.where((rank + count) % 2.0 == 0.0, big, -big)
    elif p.style == "wave":
        a = big * np.sin(leader[0] / p.every_m + rank)
    elif p.style == "noise":
        a = big * (2.0 * other - 1.0)
    elif p.style == "huge":
        a = HUGE[(other * len(HUGE)).astype(np.int64)]
    elif p.style == "first_brakes":
        a = np.where(follows, big, -big)
    elif p.style == "crawl":  # now fast, now hardly at all
        a = np.where(one < 0.5, big, 0.3 - own.speed)
    elif p.style == "nan":
        a = np.where(other < 0.02 / n, np.nan, a)
    return Demand(np.ascontiguousarray(a, np.float64), np.zeros(n, bool))
