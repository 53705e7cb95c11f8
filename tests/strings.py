"""A string of point trains on one track, each behind the one before: for tests of laws that follow the train ahead."""

from __future__ import annotations

from typing import Any

import numpy as np

from trainctl.plants import point
from trainctl.scenario.reference import constant
from trainctl.signals import Bounds, Consists, Demand, Floats, Links, Scene, Trains

LENGTH_M = 200.0


def scene(
    n: int, spacing: float, speed: float = 40.0, period: float = 1.0, braking: Floats | float = 0.8, rate: float = 0.0
) -> Scene:
    """``n`` trains of 200 m at their desired spacing, who hear their neighbours both ways."""
    pairs = np.array(sorted([(k, k + 1) for k in range(n - 1)] + [(k + 1, k) for k in range(n - 1)], key=lambda e: e[::-1]))
    pairs = pairs.reshape(-1, 2)
    sender, receiver, m = pairs[:, 0].copy(), pairs[:, 1].copy(), len(pairs)
    slot, one, free = -spacing * np.arange(n), np.ones(n), np.full(n, np.inf)
    consists = Consists(
        np.arange(n + 1), LENGTH_M * one, 4e5 * one, one, np.zeros((n, 3)), 0 * one, 0 * one, free, free, 4e5 * braking * one, free,
        rate * one,
    )  # fmt: skip
    links = Links(
        sender, receiver, np.searchsorted(receiver, np.arange(n + 1)), slot[sender] - slot[receiver], np.full(m, -np.inf),
        np.full(m, np.inf), np.ones(m), np.ones(m, bool), slot, np.arange(n),
    )  # fmt: skip
    return Scene(
        [str(i + 1) for i in range(n)], consists, np.column_stack((slot, speed * one)), links,
        Bounds(0 * one, 1.2 * speed * one, -free, free), constant(speed, 0.0), 0.0, period, period, 0.0, period,
    )  # fmt: skip


def state(own: Floats) -> Trains:
    """What the trains know of themselves."""
    return Trains(own[:, 0].copy(), own[:, 1].copy(), np.zeros(len(own)))


class String:
    """The trains under one law, step by step; ``brakes`` orders decelerations that the law knows nothing of."""

    def __init__(self, law: Any, params: Any, sc: Scene) -> None:
        self.law, self.params, self.scene, self.own, self.t = law, params, sc, sc.own.copy(), 0.0
        self.constants = law.constants(params, sc)
        self.memory = [law.initial(params, sc)] if hasattr(law, "initial") else []
        self.plant = point.constants(point.Params(), sc.consists)
        self.heard: Floats | None = None

    def leader(self) -> Floats:
        speed = float(self.scene.reference.position[0, 1])
        return np.array([speed * self.t, speed, 0.0, 0.0])

    def step(self, ordered: Floats | None = None, arrives: Any = True, push: float = 0.0) -> Demand:
        """One control period; ``ordered`` (n,) stands for the law where it is not NaN, ``push`` [m/s2] nobody knows of."""
        T, links, trains = self.scene.control_period, self.scene.links, state(self.own)
        sent = self.law.message(self.constants, trains, self.leader(), *self.memory)[links.sender]
        if self.heard is None:
            self.heard = np.zeros_like(sent)
        self.heard = np.where(np.broadcast_to(arrives, len(sent))[:, None], sent, self.heard)
        found = self.law.demand(self.constants, trains, self.leader(), links, self.heard, *self.memory)
        if self.memory:
            found, *self.memory = found
        asked = found.acceleration if ordered is None else np.where(np.isnan(ordered), found.acceleration, ordered)
        asked = np.maximum(asked, -self.scene.consists.braking / self.scene.consists.mass) + push
        self.own = point.advance(self.plant, self.own, asked, T, point.Kick.none(len(self.own))).own
        self.t += T
        return found

    @property
    def spacing(self) -> Floats:
        return -np.diff(self.own[:, 0])


def first_brakes(n: int, deceleration: float) -> Floats:
    """Orders: the first of ``n`` trains brakes."""
    ordered = np.full(n, np.nan)
    ordered[0] = -deceleration
    return ordered
