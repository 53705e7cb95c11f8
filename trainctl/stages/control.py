"""What the law asks for: messages exchanged and a sampled law evaluated; what is commanded from outside instead."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from trainctl.errors import LawError
from trainctl.scenario.model import Model
from trainctl.signals import POSITION, SPEED, Demand, Disturbed, Floats, Formed, Messages, Trains
from trainctl.topology import exchange
from trainctl.topology.exchange import Radio


class Control:
    """Sampled laws; continuous ones are evaluated inside the plant's step."""

    def __init__(self, p: Model, radio: Radio) -> None:
        self.p, self.radio = p, radio
        self.clamps = getattr(p.law, "CLAMPED", False) and not p.plant.CLAMPS  # else the plant does

    def initial(self) -> Demand:
        """Nothing asked yet."""
        n = len(self.p.scenario.ids)
        return Demand(np.zeros(n), np.zeros(n, bool))

    def step(
        self, k: int, t: float, own: Floats, resistance: Callable[[Floats], Floats], formed: Formed, messages: Messages,
        demand: Demand, memory: Any, commanded: Floats, disturbed: Disturbed,
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
        disturbed : Disturbed
            For the error of the measured positions.
        """
        run = self.p.scenario.run
        if self.p.sampled and k % run.held_steps == 0:
            believed = resistance(own)
            demand, formed, messages, memory = self.evaluated(k, t, own, believed, formed, messages, memory, disturbed)
            self._check(t, demand)
            demand = self.clamped(demand, own, believed)
        free = np.isnan(commanded)
        if not free.all():
            asked = Demand(np.where(free, demand.acceleration, commanded), demand.saturated & free)
            demand = self.clamped(asked, own, resistance(own))
        return demand, formed, messages, memory

    def evaluated(
        self, k: int, t: float, own: Floats, resistance: Floats, formed: Formed, messages: Messages, memory: Any,
        disturbed: Disturbed,
    ) -> tuple[Demand, Formed, Messages, Any]:  # fmt: skip
        """What the law asks for in the step ``k``, as it is; arguments as those of ``step``, ``resistance`` (n,) for ``own``."""
        assert formed.links is not None
        p, law, leading = self.p, self.p.law, own[self.p.leading]
        leader = formed.references.leader(t)
        trains = Trains(leading[:, POSITION] + disturbed.measurement, leading[:, SPEED], resistance)
        if p.remembers and k == 0:
            memory = law.initial(p.params, p.scene(own, formed.links, t))
        sent = law.message(formed.constants, trains, leader, *((memory,) if p.remembers else ()))
        number = k // p.scenario.run.held_steps
        messages, heard = exchange.deliver(
            self.radio, messages, sent, trains.position, formed.links, number, t, trains.position - leader[POSITION]
        )
        links = formed.links._replace(heard=heard)
        if p.remembers:
            demand, memory = law.demand(formed.constants, trains, leader, links, messages.heard, memory)
        else:
            demand = law.demand(formed.constants, trains, leader, links, messages.heard)
        return demand, formed._replace(links=links), messages, memory

    def _check(self, t: float, demand: Demand) -> None:
        wrong = np.flatnonzero(~np.isfinite(demand.acceleration))
        if len(wrong):
            names = ", ".join(self.p.scenario.ids[i] for i in wrong)
            raise LawError(f"law {self.p.scenario.controller.law} gave a number that is not finite for train {names} at {t:g} s")

    def clamped(self, demand: Demand, own: Floats, resistance: Floats) -> Demand:
        """Speed and input clamps of a law whose model has them, for trains of units."""
        if not self.clamps:
            return demand
        bounds, speed, asked = self.p.bounds, own[self.p.leading, SPEED], demand.acceleration
        period = self.p.scenario.run.control_period_s or self.p.scenario.run.step_s
        given = np.clip(asked, bounds.input_lower - resistance, bounds.input_upper - resistance)
        given = np.clip(given, (bounds.speed_lower - speed) / period, (bounds.speed_upper - speed) / period)
        return Demand(given, demand.saturated | (given != asked))
