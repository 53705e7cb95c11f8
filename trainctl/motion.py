"""The plant as the loop drives it: the exact map of point trains, or units integrated jointly with observer and law."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from trainctl.plants import actuated_units, coupled_units, faults, integrate, point, shared
from trainctl.plants.disturbance import Disturbed
from trainctl.prepare import Prepared
from trainctl.signals import FORCE, GRAVITY, POSITION, POWERS, SPEED, Bools, Demand, Floats, Links, Scene
from trainctl.topology.exchange import Exchange

#: A law may move a train within a step by so much [m] per second more or less than a held acceleration would.
WITHIN_M = 0.02


class Motion(NamedTuple):
    """One simulator step of all trains."""

    displacement: Floats  # (n,) m, what SUMO is told to do
    input: Floats  # (n,) m/s2, force of the whole train per mass at the beginning of the step
    acceleration: Floats  # (n,) m/s2, mean over the step
    asked: Floats  # (n,) m/s2, what drives the train, as the supervisor judges it
    limited: Bools  # (n,) a limit of the plant acted
    clipped: Bools  # (n,) the train would have moved backwards
    force: Floats | None  # (U,) N at the beginning of the step
    extras: dict[str, Floats]  # further columns of the units, (U,) each


def _slopes(p: Prepared) -> Floats:
    """Where the line's slopes begin [m] and their rise / run, shape (G, 2); (0, 2) on a level line."""
    slopes = np.column_stack([p.line.gradient.breaks, p.line.gradient.slope])
    return slopes if slopes[:, 1].any() else np.zeros((0, 2))


class Points:
    """Point trains under a sampled law."""

    def __init__(self, p: Prepared) -> None:
        self.step = p.scenario.run.step_s
        self.constants = point.constants(p.plant_params, p.consists, gradient=_slopes(p))

    def believed_resistance(self, own: Floats) -> Floats:
        """Running resistance and gradient at the present speed and place [N/kg], shape (n,)."""
        return point.resistance(own[:, SPEED], self.constants.davis) + self._climbing(own)

    def _climbing(self, own: Floats) -> Floats:
        return point.climbing(own[:, POSITION], self.constants.gradient) + GRAVITY * self.constants.slope

    def advance(
        self, k: int, t: float, own: Floats, demand: Demand, links: Links | None, exchange: Exchange, disturbed: Disturbed,
        ordered: Floats, pace: Floats | None, calm: bool = False,
    ) -> tuple[Floats, Motion]:  # fmt: skip
        """One exact step of the discrete map; ``ordered`` (n,) accelerations stand for the law's where they are not NaN."""
        constants = self.constants._replace(resistance_factor=disturbed.resistance)
        kick = point.Kick(disturbed.position, disturbed.speed, disturbed.input)
        asked = np.where(np.isnan(ordered), demand.acceleration, ordered)
        moved = point.advance(constants, own, asked, self.step, kick)
        mean = (moved.own[:, SPEED] - own[:, SPEED]) / self.step
        return moved.own, Motion(moved.displacement, moved.input, mean, mean, moved.limited, moved.clipped, None, {})

    def acceleration(self, own: Floats) -> Floats:
        """Nothing acts late here, so it does not matter."""
        return np.zeros(len(own))

    def overrun(self, own: Floats, braking: float) -> Floats:
        """Nothing acts late here."""
        return np.zeros(len(own))

    def climbs(self, slope: Floats) -> None:
        """Take the slope under every unit (U,), rise / run, for the coming step."""
        self.constants.slope[:] = slope

    def saved(self) -> None:
        """Nothing changes here from step to step."""

    def restore(self, saved: None) -> None:
        """Nothing to go back to."""


class Units:
    """Trains of units, integrated jointly with observer and law in sub-steps; a sampled law's acceleration is shared out to them.

    Holds what belongs to the integration: estimates, held messages, extremes since the last row.
    """

    def __init__(self, p: Prepared) -> None:
        self.p = p
        run = p.scenario.run
        self.step, self.sub_steps = run.step_s, run.sub_steps
        self.h = self.step / self.sub_steps
        self.law: Any = shared if p.sampled else p.law
        self.period = p.scenario.topology.communication_period_s
        self.estimate: Floats = p.observer.initial(p.observer_params, p.own)
        self.gradient = _slopes(p)
        self.plant: Any
        if p.scenario.plant.kind == "coupled_units":
            self.plant = coupled_units.constants(p.plant_params, p.consists, self.gradient)
        else:
            self.plant = actuated_units.constants(
                p.plant_params, p.consists, self.gradient, faults=p.scenario.fault, trains=p.scenario.ids
            )
        noisy = p.scenario.plant.kind == "actuated_units" and p.plant_params.noise_variance_m2_per_s6 > 0.0
        self.noise_hold = p.plant_params.noise_hold_s if noisy else None
        self.breaks = np.unique(
            np.concatenate([p.reference.breaks[np.isfinite(p.reference.breaks)], faults.breaks(p.scenario.fault)])
        )
        self.masses = p.consists.train_mass()
        self.lag = p.assumed.lag
        self.extremes = self._fresh()
        self.counted = -1  # number of the last exchange
        guided = p.roster is not None
        self.hilly = bool(len(self.gradient)) or (guided and bool(p.rails.slope.any()))
        ordered = guided or p.supervision.mode != "off"
        self.orders = integrate.Orders(
            held=shared.constants(p.plant_params, p.consists, self.gradient) if ordered and not p.sampled else shared.NOBODY,
            lift=np.zeros(len(p.own) if self.hilly and not p.sampled else 0),
            pace=np.zeros((len(self.masses) if guided else 0, 3)),
            since=0.0,
        )

    def believed_resistance(self, own: Floats) -> Floats:
        """Running resistance and gradient of whole trains per mass [N/kg], shape (n,)."""
        c, v = self.p.consists, own[:, SPEED]
        per_unit = c.davis[:, 0] + c.davis[:, 1] * v + c.davis[:, 2] * v**2 + self._climbing(own)
        total: Floats = np.add.reduceat(c.mass * per_unit, c.first[:-1]) / self.masses
        return total

    def taken(self) -> integrate.Extremes:
        """Extremes since they were last taken."""
        past, self.extremes = self.extremes, self._fresh()
        return past

    def _fresh(self) -> integrate.Extremes:
        return integrate.Extremes.fresh(len(self.masses), len(self.estimate), len(self.law.WATCHED))

    def relink(self, scene: Scene, constants: Any) -> None:
        """Take over a new edge list; ``constants`` are the law's own (a sampled law does not run here)."""
        p = self.p
        own_law = shared.constants(p.plant_params, p.consists, self.gradient) if p.sampled else constants
        self.loop = integrate.Loop(own_law, p.observer.constants(p.observer_params, scene), self.plant, self.orders)
        messages = len(scene.links.sender), self.law.MESSAGE
        self.air = integrate.Air(np.zeros(messages), self.period is None, self.law.ORDER == "chain", 0.0)
        self.work = integrate.scratch(p.own, self.estimate, len(self.masses), p.observer.CORRECTIONS, self.law.MESSAGE)
        self.counted = -1
        self.parts = integrate.compiled(
            self.law, p.observer, p.plant,
            (self.loop, p.consists.first, p.consists.length, scene.links, p.reference, self.air, 0.0, self.h, 1, self.breaks,
             p.own, self.estimate, self.work, self.extremes),
        )  # fmt: skip

    def advance(
        self, k: int, t: float, own: Floats, demand: Demand, links: Links | None, exchange: Exchange, disturbed: Disturbed,
        ordered: Floats, pace: Floats | None, calm: bool = False,
    ) -> tuple[Floats, Motion]:  # fmt: skip
        """Integrate over one simulator step; the displacement is that of the heads. ``calm``: without the plant's noise.

        Trains with an ``ordered`` (n,) acceleration, not NaN, hold that instead of what their law demands. ``pace`` (4, n) is where
        each train's own reference is now, where they have one.
        """
        assert links is not None
        p, first, heads = self.p, self.p.consists.first, self.p.heads
        if p.sampled:
            self.loop.law.acceleration[:] = np.where(np.isnan(ordered), demand.acceleration, ordered)
        elif len(self.orders.held.acceleration):
            self.orders.held.acceleration[:] = ordered
        if len(self.orders.lift):
            self.orders.lift[:] = p.consists.mass * self._climbing(own)
        if pace is not None and len(self.orders.pace):
            self.orders.pace[:] = pace[:3].T
            self.loop = self.loop._replace(orders=self.orders._replace(since=t))
        self._disturb(disturbed)
        moved = own.copy()
        moved[:, SPEED] += np.repeat(disturbed.speed, np.diff(first))
        limited, estimate = self.extremes.limited.copy(), self.estimate.copy()
        demanded = None
        for begin, sub_steps in self._pieces(t):
            self._exchange(begin, moved, links, exchange)
            self._make_noise(begin, calm)
            applied = integrate.advance(
                self.parts, self.loop, first, p.consists.length, links, p.reference, self.air, begin, self.h, sub_steps,
                self.breaks, moved, self.estimate, self.work, self.extremes,
            )  # fmt: skip
            demanded = applied if demanded is None else demanded
        assert demanded is not None
        extras = self._extras(t, own, estimate, demanded)
        force = own[:, FORCE].copy() if p.plant.STATES > FORCE else demanded
        displacement = moved[heads, POSITION] - own[heads, POSITION] + np.where(own[heads, SPEED] > 0.0, disturbed.position, 0.0)
        clipped = displacement < 0.0
        displacement[clipped] = 0.0
        shift = np.repeat(own[heads, POSITION] + displacement - moved[heads, POSITION], np.diff(first))
        moved[:, POSITION] += shift
        mean = (moved[heads, SPEED] - own[heads, SPEED]) / self.step
        return moved, Motion(
            displacement=displacement, input=np.add.reduceat(force, heads) / self.masses, acceleration=mean,
            asked=self._asked(own, moved, displacement, mean),
            limited=self.extremes.limited > limited, clipped=clipped, force=force, extras=extras,
        )  # fmt: skip

    def _climbing(self, own: Floats) -> Floats:
        """Weight along the track per mass [N/kg], (U,)."""
        force: Floats = point.climbing(own[:, POSITION], self.gradient) + GRAVITY * self.plant.units[:, coupled_units.SLOPE]
        return force

    def _asked(self, own: Floats, moved: Floats, displacement: Floats, mean: Floats) -> Floats:
        """Acceleration that drives every train over the step [m/s2], (n,).

        Where actuators lag it is what they approach; else the mean, or the one that explains the displacement where a law pulls
        first and brakes later within the step.
        """
        heads = self.p.heads
        v, after = own[heads, SPEED], moved[heads, SPEED]
        if self.p.plant.STATES > FORCE:
            gained = self.lag * (self.acceleration(moved) - self.acceleration(own)) / self.step
            return np.where(after > 0.0, mean + gained, mean)
        beyond = displacement - 0.5 * (v + after) * self.step
        explained = mean + 2.0 * beyond / self.step**2
        swings = (np.abs(beyond) > WITHIN_M * self.step) & (after > 0.0)
        return np.where(swings, explained, mean)

    def acceleration(self, own: Floats) -> Floats:
        """Acceleration of every train now, where actuators make it a state [m/s2], (n,)."""
        if self.p.plant.STATES <= FORCE:
            return np.zeros(len(self.masses))
        c, heads = self.p.consists, self.p.heads
        force = np.add.reduceat(own[:, FORCE], heads) - self.masses * self.believed_resistance(own)
        found: Floats = force / np.add.reduceat(c.mass * c.rotating, heads)
        return np.where(own[heads, SPEED] > 0.0, found, np.maximum(found, 0.0))

    def overrun(self, own: Floats, braking: float) -> Floats:
        """How much farther every train comes to a stand than by ``braking`` [m/s2] from now on, as actuators act late [m], (n,).

        Until its brakes act a train gains the speed (a + b) / r on the plan, and loses it only by braking to the end.
        """
        if self.p.plant.STATES <= FORCE:
            return np.zeros(len(self.masses))
        late = np.maximum(self.acceleration(own) / braking + 1.0, 0.0)
        found: Floats = self.lag * np.maximum(own[self.p.heads, SPEED], 0.0) * late
        return found

    def climbs(self, slope: Floats) -> None:
        """Take the slope under every unit (U,), rise / run, for the coming step."""
        self.plant.units[:, coupled_units.SLOPE] = slope
        if self.p.sampled:
            self.loop.law.units[:, coupled_units.SLOPE] = slope
        elif len(self.orders.held.acceleration):
            self.orders.held.units[:, coupled_units.SLOPE] = slope

    def saved(self) -> Any:
        """What a step changes here, to try one."""
        return self.estimate.copy(), integrate.Extremes(*(a.copy() for a in self.extremes)), self.counted, self.air

    def restore(self, saved: Any) -> None:
        """Go back to before a step that was tried."""
        estimate, extremes, self.counted, self.air = saved
        self.estimate[:] = estimate
        for now, then in zip(self.extremes, extremes, strict=True):
            now[:] = then

    def _extras(self, t: float, own: Floats, estimate: Floats, demanded: Floats) -> dict[str, Floats]:
        """What actuators, faults and observers do at ``t``, for the log."""
        if self.p.plant.STATES <= FORCE:
            return {}
        rate, power = np.empty_like(own), np.empty(len(POWERS))
        for i in range(len(self.masses)):
            rows = slice(self.p.consists.first[i], self.p.consists.first[i + 1])
            self.p.plant.rate(i, self.plant, t, t, own[rows], demanded[rows], rate[rows], power)
        return {
            "law_input": demanded,
            "fault_mps3": actuated_units.fault(self.plant, t, demanded),
            "fault_estimate_mps3": self.p.observer.fault_estimate(self.loop.observer, estimate),
            "acceleration_mps2": rate[:, SPEED],
            "acceleration_estimate_mps2": estimate[:, self.p.law.W],
        }

    def _pieces(self, t: float) -> list[tuple[float, int]]:
        """(start, sub-steps) of the stretches of one simulator step within which messages and noise are held."""
        cuts = {0}
        for period in (self.period, self.noise_hold):
            if period is not None and period < self.step:
                cuts |= set(range(0, self.sub_steps, round(period / self.h)))
        starts = sorted(cuts)
        return [(t + a * self.h, b - a) for a, b in pairwise([*starts, self.sub_steps])]

    def _exchange(self, t: float, own: Floats, links: Links, exchange: Exchange) -> None:
        """Send and hear, if an exchange is due at ``t``. A link opens with a message that arrives."""
        if self.period is None:
            return
        number = math.floor(t / self.period + 1e-6)
        if number == self.counted:
            return
        # On a new edge list nothing has been heard yet: the first messages are those of one common instant.
        air = self.air._replace(live=True) if self.counted < 0 else self.air
        self.counted = number
        first = self.p.consists.first
        integrate.exchange(self.parts, self.loop, first, links, self.p.reference, air, t, own, self.estimate, self.work)
        exchange.deliver(self.work.sent.copy(), own[self.p.heads, POSITION], links, number)
        fresh = ~exchange.ever
        exchange.heard[fresh] = self.work.sent[links.sender[fresh]]
        self.air = self.air._replace(heard=exchange.heard.copy(), sent_at=t)

    def _make_noise(self, t: float, calm: bool) -> None:
        """Overwrite the plant's noise with the sample at ``t``, or with none."""
        if self.noise_hold is None:
            return
        if calm:
            self.plant.units[:, actuated_units.NOISE] = 0.0
            return
        sample = math.floor(t / self.noise_hold + 1e-6)
        noise = actuated_units.noise(self.p.plant_params, self.p.scenario.run.seed or 0, sample, len(self.estimate))
        self.plant.units[:, actuated_units.NOISE] = noise

    def _disturb(self, disturbed: Disturbed) -> None:
        """Hand this step's disturbing forces and resistance errors to the plant."""
        units = np.diff(self.p.consists.first)
        table = self.plant.units
        table[:, coupled_units.PUSH] = np.repeat(disturbed.input, units)
        table[:, coupled_units.C0 : coupled_units.C2 + 1] = self.p.consists.davis * np.repeat(disturbed.resistance, units)[:, None]
