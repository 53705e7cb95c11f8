"""The closed loop of trains on a railway. ``Loop.after`` is the whole data flow, in the order of the README's list.

Every stage is made once from the scenario; what changes lies in ``State``, which each takes and gives. Arrays in it may be reused
in place by the stage that owns them.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from trainctl.errors import LawError
from trainctl.numeric import lay_out
from trainctl.plants import disturbance
from trainctl.railway import supervisor
from trainctl.railway.ways import under
from trainctl.scenario.events import Event
from trainctl.scenario.model import Model
from trainctl.signals import POSITION, SPEED, Bools, Demand, Disturbed, Floats, Formed, Ints, Messages, Motion, Seen, Start
from trainctl.stages import control, driver, orders, plant, protect, record, rerouters, signals, topology, traffic
from trainctl.steps import Steps
from trainctl.topology import exchange
from trainctl.world import World

#: Slower than this is a stand [m/s].
STANDS = 1e-9
#: An observer whose estimates pass this has diverged, though the train it watches may still be where it should.
ASTRAY = 1e30


class State(NamedTuple):
    """All that changes from step to step: arrays in named tuples, or plain JSON. A checkpoint is its leaves."""

    k: int  # steps done
    own: Floats  # (U, 2 or 3) position [m], speed [m/s], force [N] of every unit
    orders: orders.State
    rerouters: rerouters.State
    signals: signals.State
    traffic: traffic.State
    rule: Any  # of the formation rule: ``slots.State`` or ``convoys.State``
    formed: Formed
    messages: Messages
    demand: Demand  # held over the control period
    memory: Any  # of a sampled law that keeps a state of its own, else ()
    commanded: Floats  # (n,) m/s2, accelerations set from outside, NaN where none
    added: Floats  # (n,) m/s2, added from outside to what a sampled law asks for
    plant: plant.State
    watch: record.State


class Loop(Steps):
    """The stages of one run, made once from its scenario; ``state`` is where it stands.

    Parameters
    ----------
    model : Model
        The scenario as arrays.
    world : World
        SUMO, or the numeric stand-in.
    journal : Journal
        Where rows and events go.
    goes_on : bool
        Whether the trains are on the railway already.
    """

    state: State

    def __init__(self, model: Model, world: World, journal: record.Journal, goes_on: bool = False) -> None:
        super().__init__(model, journal)
        self.world, self.built = world, model
        p, run = model, model.scenario.run
        self.ours = ~p.roster.driven
        self.all_ours = bool(self.ours.all())
        self.train = np.repeat(np.arange(len(p.leading)), np.diff(p.consists.first))  # (U,) of every unit
        self.disturbances = disturbance.signals(p.scenario.disturbance, p.scenario.ids, run.step_s, run.seed, p.worst)
        self.rerouters = rerouters.Rerouters(p, journal)
        self.orders, self.traffic = orders.Orders(p, journal), traffic.Traffic(p, journal)
        self.signals = signals.Signals(p, journal)
        self.topology = topology.Topology(p, journal)
        self.control, self.driver, self.plant = control.Control(p, p.radio), driver.of(p), plant.of(p, p.radio)
        self.protect = protect.Protect(p, journal, bool(len(self.disturbances.whole)) or self.plant.noisy)
        rule, formed = self.topology.rule.initial()
        self.state = State(
            k=0, own=p.own.copy(), orders=self.orders.initial(), rerouters=self.rerouters.initial(),
            signals=self.signals.initial(), traffic=self.traffic.initial(), rule=rule, formed=formed,
            messages=exchange.silent(), demand=self.control.initial(), memory=(),
            commanded=np.full(len(p.scenario.ids), np.nan), added=np.zeros(len(p.scenario.ids)),
            plant=self.plant.initial(), watch=self.record.initial(),
        )  # fmt: skip
        if not goes_on:
            self._start()

    def after(self, s: State) -> State:
        """The state a step later."""
        p, world, t, leading = self.p, self.world, self.time, self.p.leading

        # measure: SUMO -> where every train is on its way; its units follow, as a whole
        own = self.measured(s)
        speed = own[leading, SPEED]

        # orders: new routes first, since they change the rows of all trains
        def stops_in() -> Floats:
            acceleration = self.plant.acceleration(own)
            return supervisor.way_to_stop(p.supervision, p.assumed, speed, acceleration, p.scenario.run.step_s, p.step_theta)

        ordered, routes = self.orders.step(t, world.measure(), world.ways, speed, stops_in, s.formed.ahead, s.orders)
        stuck, led = self.rerouters.step(
            t, world.measure(), world.ways, speed, stops_in, s.rerouters, [i for i, _ in routes]
        )  # fmt: skip
        for i, edges in [*routes, *led]:
            world.route(i, edges)
        here, ways = world.measure(), world.ways

        # signals: what they show -> how far every train may go before one, where they are obeyed
        shown, red = self.signals.step(t, ways, here, speed, s.traffic, world.box, s.signals)
        if shown.aspects.claims != s.signals.aspects.claims:
            world.claim(shown.aspects.claims)

        # traffic: departures, stops -> entries; whose turn it is; what is ahead of every train, where it is needed
        late = self.plant.overrun(own, p.driver_braking)
        stopped = None if world.box is None else world.box.stopped()
        going, around = self.traffic.step(t, ways, here, speed, late, s.traffic, red=red, stopped=stopped)
        for i, v in around.entries:
            own[p.consists.first[i] : p.consists.first[i + 1], SPEED] = v
            world.insert(i, v)
        if going is not s.traffic:
            self._stop(going, s.traffic)

        # topology: -> who receives from whom, desired spacing and bounds of each link, the law's constants
        seen = here._replace(position=here.position + s.formed.offset)
        rule, formed, messages, own, seen, scene = self.topology.step(
            t, seen, own, around, going, s.rule, s.formed, s.messages
        )  # fmt: skip
        units = s.plant
        if scene is not None:
            units = self._relinked(t, scene, formed, units, s.watch)

        # control: -> what the law asks for; what a driver, or a command from outside, orders instead (NaN: the law leads)
        acting = disturbance.at(self.disturbances, s.k, t, seen.position)
        demand, formed, messages, memory = self.control.step(
            s.k, t, own, self.plant.believed_resistance, formed, messages, s.demand, s.memory, s.commanded, s.added,
            acting,
        )  # fmt: skip
        self._climb(own, formed, ways, here)
        speed, acceleration = own[leading, SPEED], self.plant.acceleration(own)
        driven, formed = self.driver.step(speed, acceleration, around, going, formed, s.commanded)
        driven = driven._replace(ordered=np.fmin(driven.ordered, self.orders.braking(speed, ordered)))  # whoever brakes hardest

        # protect, plant: the supervisor tries the step without what disturbs it; the plant then takes it with
        past, units = self.plant.taken(units) if self.record.due(s.k) else (None, units)
        stands = ~(here.present & self.ours) | driven.stands
        if around.turns:
            stands[[turn.train for turn in around.turns]] = True

        def over_the_step(ordered: Floats, disturbed: Disturbed, state: plant.State, calm: bool) -> plant.Moved:
            moved = self.plant.step(s.k, t, own, demand, ordered, formed, messages, state, disturbed, calm)
            # Whoever is ordered not to start is held by its brakes, whatever pushes it.
            if around.view is None and not self.p.braked:
                return moved
            return self._held(moved, own, stands | (speed <= 0.0) & (ordered <= 0.0), here)

        moved, acts = self.protect.step(
            t, around.view, own, acceleration, self.plant.swing(own), driven, stands, acting, units, s.watch.acting, over_the_step
        )  # fmt: skip
        self._check(t, own, demand, moved)

        # record, command and step
        watch = s.watch._replace(acting=acts)
        # Who comes back from where it was parked does so with the move, if it is let back: until then it is beside the track.
        together = s.traffic.on_track(going.on_track(here))
        told = moved.motion if self.all_ours else moved.motion._replace(input=np.where(self.ours, moved.motion.input, np.nan))
        self.record.step(s.k, t, ways, together, seen, own, formed, demand, told, past, acting, watch)
        self.record.waits(t, together, speed, going, around, self.traffic.due(t, going), watch)
        for turn in around.turns:
            world.turn(*turn)
        world.move(moved.motion.displacement, p.scenario.run.step_s)
        if world.box is not None and (kept := world.box.kept_parked()):  # they are to ask again
            going = going._replace(parked=going.parked | np.isin(np.arange(len(going.parked)), kept))
        formed = self.topology.rule.after(formed)
        if around.turns:
            moved, formed = self._turned(t, [turn.train for turn in around.turns], moved, formed, going, watch)
        return State(
            s.k + 1, moved.own, ordered, stuck, shown, going, rule, formed, moved.messages, demand, memory, s.commanded,
            s.added, moved.state, watch,
        )  # fmt: skip

    def end(self) -> None:
        """The last instant, from which no train moves on: no orders, no entries; else sorted, watched and recorded as any other."""
        s, world, t = self.state, self.world, self.time
        own, here, ways = self.measured(s), world.measure(), world.ways
        late = self.plant.overrun(own, self.p.driver_braking)
        speed = own[self.p.leading, SPEED].copy()
        _, red = self.signals.step(t, ways, here, speed, s.traffic, world.box, s.signals)
        stopped = None if world.box is None else world.box.stopped()
        going, around = self.traffic.step(t, ways, here, speed, late, s.traffic, last=True, red=red, stopped=stopped)
        seen = here._replace(position=here.position + s.formed.offset)
        rule, formed, messages, own, seen, scene = self.topology.step(
            t, seen, own, around, going, s.rule, s.formed, s.messages
        )  # fmt: skip
        units = s.plant if scene is None else self._relinked(t, scene, formed, s.plant, s.watch)
        past, units = self.plant.taken(units)
        self.record.step(s.k, t, ways, going.on_track(here), seen, own, formed, s.demand, None, past, None, s.watch)
        missing = self.traffic.missing(t, going)
        self.not_entered = len(missing)
        if missing:
            self.journal.event(t, "not_entered", trains=missing)
        self.state = s._replace(
            own=own, traffic=going, rule=rule, formed=formed, messages=messages, plant=units
        )  # fmt: skip

    def command(self, trains: list[int] | slice, acceleration: Floats | float) -> None:
        """Order accelerations [m/s2] of trains from outside, NaN: none any more."""
        commanded = self.state.commanded.copy()
        commanded[trains] = acceleration
        self.state = self.state._replace(commanded=commanded)

    def add(self, acceleration: Floats) -> None:
        """Add accelerations (n,) [m/s2] to what the law asks for, from the next control instant on."""
        self.state = self.state._replace(added=acceleration.copy())

    def order(self, event: Event) -> None:
        """Give an order from outside."""
        self.state = self.state._replace(orders=self.orders.added(event, self.state.orders))

    def outcome(self) -> dict[str, Any]:
        """What run.json says of the finished run."""
        sent, received = self.state.messages.counted.tolist()
        told = self.record.alarms.outcome(self.not_entered, self.state.watch.alarms)
        return told | ({"messages_sent": sent, "messages_received": received} if sent else {})

    def _start(self) -> None:
        """Put the trains on the railway: those that are placed, and those due at time 0."""
        p, s, first = self.p, self.state, self.p.consists.first
        speed = s.own[p.leading, SPEED].copy()
        start = Start(
            ids=p.scenario.ids, edge=p.roster.edge, lane_position=p.roster.lane_position, speed=speed,
            length=p.consists.train_length(), unit_length=[p.consists.length[a:b] for a, b in pairwise(first)],
            routes=p.roster.routes, present=s.traffic.came.copy(), vclass=p.roster.vclass,
            arrival=p.roster.first_arrival,
        )  # fmt: skip
        if due := self.traffic.due(0.0, s.traffic):
            ways = lay_out(p.line, start)
            row = ways.first[:-1]
            nobody = Seen(ways.begin[row] + start.lane_position, ways.edge[row], row, start.present)
            red = self.signals.before(ways, nobody) if p.obeys else None
            going, _, entries, _ = self.traffic.entering(0.0, ways, nobody, speed.copy(), s.traffic, due, red=red)
            for i, v in entries:
                start.present[i], start.speed[i] = True, v
                s.own[first[i] : first[i + 1], SPEED] = v
            self.state = s._replace(traffic=going)
        self.world.start(start)

    def measured(self, s: State) -> Floats:
        """SUMO owns where a train is: shift every train, as a whole, onto its measured front."""
        own = s.own.copy()
        shift = self.world.measure().position + s.formed.offset - own[self.p.leading, POSITION]
        own[:, POSITION] += shift[self.train]
        if (box := self.world.box) is not None:  # trains that SUMO drives run as a whole
            speeds = box.speeds()[self.train]
            own[:, SPEED] = np.where(np.isnan(speeds), own[:, SPEED], speeds)
        return own

    def _relinked(self, t: float, scene: Any, formed: Formed, units: plant.State, watch: record.State) -> plant.State:
        """Tell the plant, the alarms and the world who receives from whom from now on."""
        units = self.plant.relinked(scene, formed.constants, units)
        self.world.linked(scene.links, formed.formation)
        self.record.relinked(t, scene, formed, watch)
        return units

    def _turned(
        self, t: float, trains: list[int], moved: plant.Moved, formed: Formed, going: traffic.State, watch: record.State
    ) -> tuple[plant.Moved, Formed]:
        """Trains that have turned round over the step: their units in the new order, and all that is known of them."""
        own, units, offset = moved.own, moved.state, formed.offset.copy()
        offset[trains] = 0.0
        position = self.world.measure().position
        for i in trains:
            own, units = self.plant.turned(i, own, float(position[i]), units)
        formed = formed._replace(offset=offset)
        self.runs_round(going.leg, trains, watch)
        if self.p.has_units:
            assert formed.links is not None
            scene = self.p.scene(own, formed.links, t)
            constants = self.p.law.constants(self.p.params, scene)
            formed = formed._replace(constants=constants, made_of=(t, own.copy(), formed.links))
            units = self.plant.relinked(scene, constants, units)
        return moved._replace(own=own, state=units), formed

    def runs_round(self, leg: Ints, trains: list[int], watch: record.State) -> None:
        """Let the stages that know the units of trains know them as they run after so many turns (n,); ``trains`` turned now."""
        self.p = p = self.built.turned(leg % 2 == 1)
        self.record.turned(p, trains, watch)
        if p.has_units:
            self.topology, self.plant = topology.Topology(p, self.journal), plant.of(p, p.radio)

    def _stop(self, going: traffic.State, before: traffic.State) -> None:
        """Tell the world who parks and who stands, and who no longer does."""
        for i in np.flatnonzero((going.parked != before.parked) & self.ours).tolist():
            self.world.park(i, bool(going.parked[i]))
        for i in np.flatnonzero((going.standing != before.standing) & ~(going.parked | before.parked) & self.ours).tolist():
            self.world.halt(i, bool(going.standing[i]))

    def _climb(self, own: Floats, formed: Formed, ways: Any, here: Seen) -> None:
        """Tell the plant the slope of the net under every unit; that of a line it knows by the kilometrage."""
        if not self.p.net_slope.any():
            return
        first = self.p.consists.first
        places = own[:, POSITION] - np.repeat(formed.offset, np.diff(first))
        self.plant.climbs(under(ways, self.p.net_slope, here.row, first, places))

    def _held(self, moved: plant.Moved, own: Floats, stands: Bools, here: Seen) -> plant.Moved:
        """Trains that stand, or are not there, stay as they are; a stand ordered is one, rounding aside."""
        units, state, motion = np.diff(self.p.consists.first), moved.own, moved.motion
        state[np.abs(state[:, SPEED]) < STANDS, SPEED] = 0.0
        rows = np.repeat(stands, units)
        state[rows] = own[rows]
        state[np.repeat(stands & here.present, units), SPEED] = 0.0
        kept: Motion = motion._replace(
            displacement=np.where(stands, 0.0, motion.displacement), clipped=motion.clipped & ~stands,
            acceleration=np.where(stands, 0.0, motion.acceleration), asked=np.where(stands, 0.0, motion.asked),
        )  # fmt: skip
        return moved._replace(motion=kept)

    def _check(self, t: float, own: Floats, demand: Demand, moved: plant.Moved) -> None:
        """Numbers must stay finite; a train never moves backwards."""
        motion = moved.motion
        if not (np.isfinite(moved.own).all() and np.isfinite(motion.displacement).all()):
            finite = np.logical_and.reduceat(np.isfinite(moved.own).all(axis=1), self.p.leading)
            wrong = np.flatnonzero(~(finite & np.isfinite(motion.displacement))).tolist()
            names = ", ".join(self.p.scenario.ids[i] for i in wrong)
            before = [line for i in wrong if (line := self._acted(i, own, demand, motion))]
            why = "; ".join(before) or "nothing was held, limited or saturated, so the law or its step diverged by itself"
            raise LawError(f"the state of train {names} is no longer finite after {t:g} s: {why}")
        estimate = moved.state.estimate
        if estimate.size and not (np.abs(estimate) < ASTRAY).all():
            astray = np.flatnonzero(~(np.abs(estimate) < ASTRAY).all(axis=1))
            names = ", ".join(dict.fromkeys(self.p.scenario.ids[i] for i in np.searchsorted(self.p.leading, astray, "right") - 1))
            raise LawError(f"the estimates of train {names} passed {ASTRAY:g} after {t:g} s: its observer diverged")
        for i in motion.clipped.nonzero()[0].tolist():
            self.journal.event(t, "limit", train=self.p.scenario.ids[i], what="backwards", note="held at standstill")

    def _acted(self, i: int, own: Floats, demand: Demand, motion: Motion) -> str:
        """What kept train ``i`` from doing what its law asks for, in words; empty if nothing did."""
        first = self.p.consists.first
        stood = [str(u + 1) for u in np.flatnonzero(own[first[i] : first[i + 1], SPEED] <= 0.0).tolist()]
        said = [f"held at standstill (unit {', '.join(stood)})"] if stood else []
        said += ["limited by its plant"] if motion.limited[i] else []
        said += ["its law saturated"] if demand.saturated[i] else []
        return f"train {self.p.scenario.ids[i]} was {', '.join(said)}" if said else ""
