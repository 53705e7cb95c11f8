"""What the law asks for: messages exchanged and a sampled law evaluated; what is commanded from outside instead."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from trainctl.errors import LawError
from trainctl.scenario.model import Model
from trainctl.signals import POSITION, SPEED, Demand, Disturbed, Floats, Formed, Links, Messages, Trains
from trainctl.topology import exchange
from trainctl.topology.exchange import Radio


class Exchanged(NamedTuple):
    """What every train knows at a control instant, once messages have been exchanged."""

    trains: Trains  # of itself
    leader: Floats  # (4,) or (4, n) of its reference
    said: Floats  # (n, w) what it says
    links: Links  # with ``heard`` of this instant
    messages: Messages
    memory: Any


class Control:
    """Sampled laws; continuous ones are evaluated inside the plant's step.

    ``strict``: a number of the law's that is not finite is an error at once; else whoever steps looks at what comes of it.
    """

    def __init__(self, p: Model, radio: Radio, strict: bool = True) -> None:
        self.p, self.radio, self.strict = p, radio, strict
        self.clamps = getattr(p.law, "CLAMPED", False) and not p.plant.CLAMPS  # else the plant does

    def initial(self) -> Demand:
        """Nothing asked yet."""
        n = len(self.p.scenario.ids)
        return Demand(np.zeros(n), np.zeros(n, bool))

    def step(
        self, k: int, t: float, own: Floats, resistance: Callable[[Floats], Floats], formed: Formed, messages: Messages,
        demand: Demand, memory: Any, commanded: Floats, added: Floats, disturbed: Disturbed,
    ) -> tuple[Demand, Formed, Messages, Any]:  # fmt: skip
        """Demand of this step, held over the control period.

        Parameters
        ----------
        k : int
            Number of the step.
        t : float
            Now [s].
        own : ndarray, shape (U, s)
            State of all units.
        resistance : callable
            Running resistance and gradient (n,) as the trains believe them [N/kg], for ``own``.
        formed, messages, demand, memory
            Formations, messages under way, what was asked before, the law's own state.
        commanded : ndarray, shape (n,)
            Accelerations set from outside [m/s2], NaN where none: they take the place of the law's.
        added : ndarray, shape (n,)
            Added from outside to what the law asks for, at control instants [m/s2].
        disturbed : Disturbed
            For the error of the measured positions.
        """
        run = self.p.scenario.run
        if self.p.sampled and k % run.held_steps == 0:
            demand, formed, messages, memory = self.evaluated(k, t, own, resistance, formed, messages, memory, disturbed)
            if self.strict:
                self._check(t, demand)
            if added.any():
                demand = demand._replace(acceleration=demand.acceleration + added)
            demand = self.clamped(demand, own, resistance)
        free = np.isnan(commanded)
        if not free.all():
            asked = Demand(np.where(free, demand.acceleration, commanded), demand.saturated & free)
            demand = self.clamped(asked, own, resistance)
        return demand, formed, messages, memory

    def evaluated(
        self, k: int, t: float, own: Floats, resistance: Callable[[Floats], Floats], formed: Formed, messages: Messages,
        memory: Any, disturbed: Disturbed,
    ) -> tuple[Demand, Formed, Messages, Any]:  # fmt: skip
        """What the law asks for in the step ``k``, as it is; arguments as those of ``step``."""
        law = self.p.law
        trains, leader, _, links, messages, memory = self.exchanged(
            k, t, own, resistance, formed, messages, memory, disturbed
        )  # fmt: skip
        if self.p.remembers:
            demand, memory = law.demand(formed.constants, trains, leader, links, messages.heard, memory)
        else:
            demand = law.demand(formed.constants, trains, leader, links, messages.heard)
        return demand, formed._replace(links=links), messages, memory

    def exchanged(
        self, k: int, t: float, own: Floats, resistance: Callable[[Floats], Floats], formed: Formed, messages: Messages,
        memory: Any, disturbed: Disturbed,
    ) -> Exchanged:  # fmt: skip
        """What every train knows in the step ``k``; arguments as those of ``evaluated``."""
        assert formed.links is not None
        p, law = self.p, self.p.law
        leader = formed.references.leader(t)
        trains = Trains(p.fronts(own) + disturbed.measurement, p.speeds(own), resistance(own))
        if p.remembers and k == 0:
            memory = law.initial(p.params, p.scene(own, formed.links, t))
        said = law.message(formed.constants, trains, leader, *((memory,) if p.remembers else ()))
        number = k // p.scenario.run.held_steps
        arrived, heard = exchange.deliver(
            self.radio, messages, said, trains.position, formed.links, number, t, trains.position - leader[POSITION]
        )
        return Exchanged(trains, leader, said, formed.links._replace(heard=heard), arrived, memory)

    def _check(self, t: float, demand: Demand) -> None:
        wrong = np.flatnonzero(~np.isfinite(demand.acceleration))
        if len(wrong):
            names = ", ".join(self.p.scenario.ids[i] for i in wrong)
            raise LawError(f"law {self.p.scenario.controller.law} gave a number that is not finite for train {names} at {t:g} s")

    def clamped(self, demand: Demand, own: Floats, resistance: Callable[[Floats], Floats]) -> Demand:
        """Speed and input clamps of a law whose model has them, for trains of units."""
        if not self.clamps:
            return demand
        bounds, speed, asked = self.p.bounds, own[self.p.leading, SPEED], demand.acceleration
        period, believed = self.p.scenario.run.control_period_s or self.p.scenario.run.step_s, resistance(own)
        given = np.clip(asked, bounds.input_lower - believed, bounds.input_upper - believed)
        given = np.clip(given, (bounds.speed_lower - speed) / period, (bounds.speed_upper - speed) / period)
        return Demand(given, demand.saturated | (given != asked))
