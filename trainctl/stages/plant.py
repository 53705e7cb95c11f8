"""The plant over one step: the exact map of point trains, or units integrated jointly with observer and law."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any, NamedTuple, cast

import numpy as np

from trainctl.contracts import PointPlant, UnitPlant
from trainctl.davis import resistance
from trainctl.plants import coupled_units, faults, integrate, point, shared, threads
from trainctl.scenario.model import Model
from trainctl.signals import (
    FORCE,
    GRAVITY,
    POSITION,
    SPEED,
    Demand,
    Disturbed,
    Extremes,
    Floats,
    Formed,
    Links,
    Messages,
    Motion,
    References,
    Scene,
)
from trainctl.topology import exchange
from trainctl.topology.exchange import Radio

#: A law may move a train within a step by so much [m] per second more or less than a held acceleration would.
WITHIN_M = 0.02

#: Rounding in the position of a train at standstill [m].
CREEP_M = 1e-9


class State(NamedTuple):
    """What a plant of units remembers; of point trains every array is empty."""

    estimate: Floats  # (U, q) of the observer
    extremes: Extremes  # over the sub-steps since the last row
    observer: Any  # its constants, for the present links
    work: Any  # work space of the integrator
    heard: Floats  # (L, w) what each link brought last
    sent_at: float  # s, when that was sent
    counted: int  # number of the last exchange, -1: none on these links


class Moved(NamedTuple):
    """What a step makes of the trains."""

    own: Floats  # (U, s)
    motion: Motion
    messages: Messages
    state: State


def of(p: Model, radio: Radio) -> Points | Units:
    """The plant of a scenario; ``radio`` is how units that are controlled in continuous time exchange messages."""
    return Units(p, radio) if p.plant.UNITS else Points(p)


def _slopes(p: Model) -> Floats:
    """Where the line's slopes begin [m] and their rise / run, shape (G, 2); (0, 2) on a level line."""
    slopes = np.column_stack([p.line.gradient.breaks, p.line.gradient.slope])
    return slopes if slopes[:, 1].any() else np.zeros((0, 2))


class Points:
    """Point trains under a sampled law."""

    def __init__(self, p: Model) -> None:
        self.step_s = p.scenario.run.step_s
        self.noisy = p.plant.noise_hold(p.plant_params) is not None
        self.plant = cast(PointPlant, p.plant)
        self.constants = self.plant.constants(p.plant_params, p.consists, gradient=_slopes(p), clamps=p.clamps)

    def initial(self) -> State:
        """Nothing to remember."""
        return State(np.zeros((0, 0)), Extremes.fresh(0, 0, 0), (), (), np.zeros((0, 0)), 0.0, -1)

    def believed_resistance(self, own: Floats) -> Floats:
        """Running resistance and gradient at the present speed and place [N/kg], shape (n,)."""
        return point.believed(self.constants, own)

    def step(
        self, k: int, t: float, own: Floats, demand: Demand, ordered: Floats, formed: Formed, messages: Messages, state: State,
        disturbed: Disturbed, calm: bool = False,
    ) -> Moved:  # fmt: skip
        """One exact step of the discrete map; ``ordered`` (n,) accelerations stand for the law's where they are not NaN."""
        constants = self.constants._replace(resistance_factor=disturbed.resistance)
        kick = point.Kick(disturbed.position, disturbed.speed, disturbed.input)
        free = np.isnan(ordered)
        asked = demand.acceleration if free.all() else np.where(free, demand.acceleration, ordered)
        moved = self.plant.advance(constants, own, asked, self.step_s, kick)
        mean = moved.own[:, SPEED] - own[:, SPEED]
        mean /= self.step_s
        motion = Motion(moved.displacement, moved.input, mean, mean, moved.limited, moved.clipped, None, {})
        return Moved(moved.own, motion, messages, state)

    def acceleration(self, own: Floats) -> Floats:
        """Nothing acts late here, so it does not matter."""
        return np.zeros(len(own))

    def swing(self, own: Floats) -> Floats:
        """A point has no couplers."""
        return np.zeros(len(own))

    def overrun(self, own: Floats, braking: Floats) -> Floats:
        """Nothing acts late here."""
        return np.zeros(len(own))

    def climbs(self, slope: Floats) -> None:
        """Take the slope under every unit (U,), rise / run, for the coming step."""
        self.constants.slope[:] = slope

    def relinked(self, scene: Scene, constants: Any, state: State) -> State:
        """Nothing here depends on who receives from whom."""
        return state

    def turned(self, train: int, own: Floats, front: float, state: State) -> tuple[Floats, State]:
        """``own`` and state of a train that has turned round: its rear, now its front, is at ``front`` [m]."""
        own = own.copy()
        own[train, POSITION] = front
        return own, state

    def taken(self, state: State) -> tuple[Extremes | None, State]:
        """No extremes: a point has no sub-steps."""
        return None, state


class Units:
    """Trains of units, integrated jointly with observer and law; a sampled law's acceleration is shared out to them."""

    def __init__(self, p: Model, radio: Radio) -> None:
        self.p, self.radio = p, radio
        run, top = p.scenario.run, p.scenario.topology
        self.step_s, self.sub_steps = run.step_s, run.sub_steps
        self.h = self.step_s / self.sub_steps
        self.train = np.repeat(np.arange(len(p.leading)), np.diff(p.consists.first))  # (U,) of every unit
        self.law: Any = shared if p.sampled else p.law
        self.period = top.communication_period_s
        self.gradient = _slopes(p)
        self.moving = cast(UnitPlant, p.plant)
        true = p.consists._replace(mass=p.consists.mass * p.scenario.mass_factor())  # all others use what is stated
        self.plant = self.moving.constants(p.plant_params, true, self.gradient, faults=p.scenario.fault, trains=p.scenario.ids)
        self.noise_hold = p.plant.noise_hold(p.plant_params)
        self.noisy = self.noise_hold is not None
        self.pool: ThreadPoolExecutor | None = None
        self.breaks = np.unique(
            np.concatenate([p.reference.breaks[np.isfinite(p.reference.breaks)], faults.breaks(p.scenario.fault)])
        )
        self.masses = p.consists.train_mass()
        self.lag = p.assumed.lag
        self.supervised = p.supervision.mode != "off"
        self.hilly = bool(len(self.gradient)) or bool(p.net_slope.any())
        ordered = p.looks_ahead or p.braked
        # Written anew in every step before they are read, like the columns of the plant's table that disturb it.
        self.told = shared.constants(p.plant_params, p.consists, self.gradient) if p.sampled else shared.NOBODY
        self.orders = integrate.Orders(
            held=shared.constants(p.plant_params, p.consists, self.gradient) if ordered and not p.sampled else shared.NOBODY,
            lift=np.zeros(len(p.own) if self.hilly and not p.sampled else 0),
        )

    def initial(self) -> State:
        """Nothing seen, nothing heard; ``relinked`` makes the rest."""
        estimate: Floats = self.p.observer.initial(self.p.observer_params, self.p.own)
        return State(estimate, self._fresh(len(estimate)), (), (), np.zeros((0, self.law.MESSAGE)), 0.0, -1)

    def _fresh(self, units: int) -> Extremes:
        return Extremes.fresh(len(self.masses), units, len(self.law.WATCHED))

    def believed_resistance(self, own: Floats) -> Floats:
        """Running resistance and gradient of whole trains per mass [N/kg], shape (n,)."""
        c, v = self.p.consists, own[:, SPEED]
        per_unit = resistance(v, c.davis) + self._climbing(own)
        total: Floats = np.add.reduceat(c.mass * per_unit, c.first[:-1]) / self.masses
        return total

    def turned(self, train: int, own: Floats, front: float, state: State) -> tuple[Floats, State]:
        """``own`` and state of a train that has turned round, its units in the order they have run in until now.

        Its rear, now its front, is at ``front`` [m]. Couplers stay as they are. Brakes stay on, traction is let go.
        """
        first = self.p.consists.first
        rows, turned = slice(int(first[train]), int(first[train + 1])), np.arange(len(first) - 1) == train
        own, estimate = own.copy(), state.estimate.copy()
        before = own[rows, POSITION].copy()
        rears = before - self.p.consists.length[rows]
        after = front - (rears - rears[-1])
        estimate[rows] = self.p.observer.turned(self.p.observer_params, estimate[rows], before, after)[::-1]
        own[rows, POSITION] = after
        own[rows, FORCE:] = np.minimum(own[rows, FORCE:], 0.0)
        own[rows] = own[rows][::-1].copy()
        return own, state._replace(estimate=estimate, extremes=state.extremes.turned(first, turned))

    def taken(self, state: State) -> tuple[Extremes | None, State]:
        """Extremes since they were last taken."""
        return state.extremes, state._replace(extremes=self._fresh(len(state.estimate)))

    def relinked(self, scene: Scene, constants: Any, state: State) -> State:
        """Take over a new edge list; ``constants`` are the law's own (a sampled law does not run here)."""
        p, links = self.p, scene.links
        now = state._replace(
            observer=p.observer.constants(p.observer_params, scene),
            work=integrate.scratch(p.own, state.estimate, len(self.masses), p.observer.CORRECTIONS, self.law.MESSAGE),
            heard=np.zeros((len(links.sender), self.law.MESSAGE)), sent_at=0.0, counted=-1,
        )  # fmt: skip
        self.shares = self._shared(links)
        loop, received = self._loop(constants, now), self._received(now)
        references = References.one(p.reference, len(self.masses))
        self.parts = integrate.compiled(
            self.law, p.observer, p.plant,
            (loop, p.consists.first, p.consists.length, links, references, received,
             0.0, self.h, 1, self.breaks, p.own, now.estimate,
             now.work, now.extremes),
            exchanges=self.period is not None,
        )  # fmt: skip
        return now

    def _shared(self, links: Links) -> threads.Shares:
        """The trains by threads; a law that does not say what it writes into may have one only."""
        own_space: tuple[str, ...] | None = getattr(self.law, "WORK", None)
        most = 1 if own_space is None else threads.cores()
        talk = self.law.MESSAGE > 0 and self.period is None
        # What a law watches is told by the trains ahead as well, of the same instant: no block may be a step behind another.
        found = threads.shares(self.p.consists.first, links, talk or len(self.law.WATCHED) > 0, most)
        if len(found.blocks) == 1:
            return found
        if self.pool is None:
            self.pool = ThreadPoolExecutor(most - 1, "trains")
        return found._replace(space=own_space or (), pool=self.pool)

    def _loop(self, constants: Any, state: State) -> integrate.Inner:
        return integrate.Inner(self.told if self.p.sampled else constants, state.observer, self.plant, self.orders)

    def _received(self, state: State) -> integrate.Received:
        return integrate.Received(state.heard, self.period is None, self.law.ORDER == "chain", state.sent_at)

    def step(
        self, k: int, t: float, own: Floats, demand: Demand, ordered: Floats, formed: Formed, messages: Messages, state: State,
        disturbed: Disturbed, calm: bool = False,
    ) -> Moved:  # fmt: skip
        """Integrate over one simulator step; the displacement is that of the leading units. ``calm``: without the plant's noise.

        Trains with an ``ordered`` (n,) acceleration, not NaN, hold that instead of what their law demands. The arrays of ``state``
        are reused: who tries a step first hands over a ``copied`` one.
        """
        p, first, leading = self.p, self.p.consists.first, self.p.leading
        told = np.where(np.isnan(ordered), demand.acceleration, ordered) if p.sampled else ordered
        for held in (self.told, self.orders.held):
            if len(held.acceleration):
                held.acceleration[:] = told
        if len(self.orders.lift):
            self.orders.lift[:] = p.consists.mass * self._climbing(own)
        self._disturb(disturbed)
        assert formed.links is not None
        loop, received, links = (
            self._loop(formed.constants, state),
            self._received(state),
            formed.links._replace(order=self.shares.order),
        )
        moved = own.copy()
        moved[:, SPEED] += disturbed.speed[self.train]
        began = moved.copy()
        limited, estimate, counted = state.extremes.limited.copy(), state.estimate.copy(), state.counted
        demanded = None
        for begin, sub_steps in self._pieces(t):
            if self.period is not None and (number := math.floor(begin / self.period + 1e-6)) != counted:
                messages, received = self._exchange(
                    loop, formed.references, received, begin, number, counted < 0, moved, links, messages, state
                )
                counted = number
            self._make_noise(begin, calm)
            applied = integrate.advance(
                self.parts, loop, first, p.consists.length, links, formed.references, received,
                begin, self.h, sub_steps, self.breaks,
                moved, state.estimate, state.work, state.extremes, self.shares,
            )  # fmt: skip
            demanded = applied if demanded is None else demanded
        assert demanded is not None
        extras = self._extras(t, own, estimate, demanded, loop)
        force = own[:, FORCE].copy() if p.plant.STATES > FORCE else demanded
        front = own[leading, POSITION]
        travelled = moved[leading, POSITION] - front
        asked = self._asked(began, moved, np.maximum(travelled, 0.0), calm)
        displacement = travelled + disturbed.position
        clipped = displacement < 0.0
        displacement[clipped] = 0.0
        moved[:, POSITION] += (front + displacement - moved[leading, POSITION])[self.train]
        mean = (moved[leading, SPEED] - own[leading, SPEED]) / self.step_s
        motion = Motion(
            displacement=displacement, input=np.add.reduceat(force, leading) / self.masses, acceleration=mean,
            asked=asked, limited=state.extremes.limited > limited, clipped=clipped,
            force=force, extras=extras,
        )  # fmt: skip
        return Moved(moved, motion, messages, state._replace(heard=received.heard, sent_at=received.sent_at, counted=counted))

    def _asked(self, began: Floats, moved: Floats, way: Floats, calm: bool) -> Floats:
        """Acceleration that drives every train over the step [m/s2], (n,); NaN where it stops harder than full braking.

        Where no supervisor asks it is the mean.

        Where actuators lag it is what they approach; else the mean, or the one that explains the ``way`` (n,) where that is more (a
        law pulls first and brakes later within the step) or less than full braking (it brakes first). ``began`` is the state after
        the disturbance of the speed; what else disturbs, unless the step is ``calm``, is in it.
        """
        leading, full = self.p.leading, self.p.supervision.emergency_mps2
        v, after = began[leading, SPEED], moved[leading, SPEED]
        mean: Floats = (after - v) / self.step_s
        if not self.supervised:
            return mean
        hardest: float | Floats = full if calm else full + self.p.assumed.scatter
        drives = mean + (self.swing(moved) - self.swing(began)) / self.step_s
        late = self.p.plant.STATES > FORCE
        if late:
            before, now = self.acceleration(began), self.acceleration(moved)
            drives += self.lag * (np.maximum(now, 0.0) - np.maximum(before, 0.0)) / self.step_s
            # What the supervisor takes for the speed, see its note 4; it changes evenly while an order is held.
            v_late, after_late = (u + self.lag * np.maximum(a + full, 0.0) for u, a in ((v, before), (after, now)))
        else:
            v_late, after_late = v, after
        beyond = way - 0.5 * (v_late + after_late) * self.step_s
        explained = (after_late - v_late) / self.step_s + 2.0 * beyond / self.step_s**2
        swings = (np.abs(beyond) > WITHIN_M * self.step_s) & ((explained > drives) | (not late) & (explained < -hardest))
        # A step that begins and ends at a stand must not creep in between, however little: the next one could do so again.
        creeps = (v <= 0.0) & (way > CREEP_M)
        stops = np.where(creeps, way / self.step_s**2, mean)
        stops = np.where(beyond > WITHIN_M * self.step_s, np.maximum(explained, stops), stops)
        hard = (v > 0.0) & (way < 0.5 * v**2 / hardest - WITHIN_M * self.step_s)
        return np.where(after > 0.0, np.where(swings, explained, drives), np.where(hard, np.nan, stops))

    def _climbing(self, own: Floats) -> Floats:
        """Weight along the track per mass [N/kg], (U,)."""
        force: Floats = point.climbing(own[:, POSITION], self.gradient) + GRAVITY * self.plant.units[:, coupled_units.SLOPE]
        return force

    def acceleration(self, own: Floats) -> Floats:
        """Acceleration of every train now, where actuators make it a state [m/s2], (n,)."""
        if self.p.plant.STATES <= FORCE:
            return np.zeros(len(self.masses))
        c, leading = self.p.consists, self.p.leading
        force = np.add.reduceat(own[:, FORCE], leading) - self.masses * self.believed_resistance(own)
        found: Floats = force / np.add.reduceat(c.mass * c.rotating, leading)
        return np.where(own[leading, SPEED] > 0.0, found, np.maximum(found, 0.0))

    def swing(self, own: Floats) -> Floats:
        """By how much couplers, and units against each other, may still speed up every head [m/s], (n,): all of their energy.

        0 where no supervisor asks.
        """
        if not self.supervised:
            return np.zeros(len(self.masses))
        c, v = self.p.consists, own[:, SPEED]
        units = np.diff(c.first)
        mean = np.add.reduceat(c.mass * v, c.first[:-1]) / self.masses
        energy = c.mass * (v - np.repeat(mean, units)) ** 2
        stretch = own[:-1, POSITION] - own[1:, POSITION] - c.length[:-1]
        energy[:-1] += c.stiffness[:-1] * stretch**2  # 0 behind the last unit
        fastest = mean + np.sqrt(np.add.reduceat(energy, c.first[:-1]) / np.minimum.reduceat(c.mass, c.first[:-1]))
        more: Floats = np.maximum(fastest - v[self.p.leading], 0.0)
        return more

    def overrun(self, own: Floats, braking: Floats) -> Floats:
        """How much farther every train runs to standstill than by ``braking`` (n,) [m/s2] from now on, as actuators act late [m].

        Until its brakes act a train gains the speed (a + b) / r on the plan, and loses it only by braking to the end.
        """
        if self.p.plant.STATES <= FORCE:
            return np.zeros(len(self.masses))
        late = np.maximum(self.acceleration(own) / braking + 1.0, 0.0)
        found: Floats = self.lag * np.maximum(own[self.p.leading, SPEED], 0.0) * late
        return found

    def climbs(self, slope: Floats) -> None:
        """Take the slope under every unit (U,), rise / run, for the coming step."""
        for table in (self.plant.units, self.told.units, self.orders.held.units):
            if len(table):
                table[:, coupled_units.SLOPE] = slope

    def _extras(self, t: float, own: Floats, estimate: Floats, demanded: Floats, loop: integrate.Inner) -> dict[str, Floats]:
        """What actuators, faults and observers do at ``t``, for the log."""
        if not self.p.plant.COLUMNS:
            return {}
        estimated = (f(loop.observer, estimate) for f in (self.p.observer.fault_estimate, self.p.observer.acceleration_estimate))
        return dict(zip(self.p.plant.COLUMNS, self.moving.columns(self.plant, t, own, demanded, *estimated), strict=True))

    def _pieces(self, t: float) -> list[tuple[float, int]]:
        """(start, sub-steps) of the stretches of one simulator step within which messages and noise are held."""
        cuts = {0}
        for period in (self.period, self.noise_hold):
            if period is not None and period < self.step_s:
                cuts |= set(range(0, self.sub_steps, round(period / self.h)))
        starts = sorted(cuts)
        return [(t + a * self.h, b - a) for a, b in pairwise([*starts, self.sub_steps])]

    def _exchange(
        self, loop: integrate.Inner, references: References, received: integrate.Received, t: float, number: int, first_time: bool,
        own: Floats, links: Links, messages: Messages, state: State,
    ) -> tuple[Messages, integrate.Received]:  # fmt: skip
        """Send and receive at ``t``. A link opens with a message that arrives.

        On a new edge list nothing has been heard yet: the first messages are those of one common instant.
        """
        first, sent = self.p.consists.first, state.work.sent
        live = received._replace(live=True) if first_time else received
        integrate.exchange(self.parts, loop, first, links, references, live, t, own, state.estimate, state.work)
        position = own[self.p.leading, POSITION]
        place = position - references.leader(t)[POSITION]
        messages, _ = exchange.deliver(self.radio, messages, sent.copy(), position, links, number, t, place)
        fresh = ~messages.ever
        messages.heard[fresh] = sent[links.sender[fresh]]
        return messages, received._replace(heard=messages.heard.copy(), sent_at=t)

    def _make_noise(self, t: float, calm: bool) -> None:
        """Overwrite the plant's noise with the sample at ``t``, or with none."""
        if self.noise_hold is None:
            return
        sample = None if calm else math.floor(t / self.noise_hold + 1e-6)
        self.moving.make_noise(self.p.plant_params, self.plant, self.p.scenario.run.seed or 0, sample)

    def _disturb(self, disturbed: Disturbed) -> None:
        """Hand this step's disturbing forces and resistance errors to the plant."""
        table = self.plant.units
        table[:, coupled_units.PUSH] = disturbed.input[self.train]
        table[:, coupled_units.C0 : coupled_units.C2 + 1] = self.p.consists.davis * disturbed.resistance[self.train, None]


def copied(state: State) -> State:
    """The same in arrays of its own, to try a step with."""
    return state._replace(estimate=state.estimate.copy(), extremes=Extremes(*(a.copy() for a in state.extremes)))
