"""The closed loop: measure, topology, control, protect and plant, command and step, record.

``Simulation.step`` is the whole data flow on one screen; everything else hangs off one of its words.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

from trainctl.errors import LawError
from trainctl.lookout import View
from trainctl.monitors import bounds as monitor
from trainctl.monitors import waiting
from trainctl.motion import Motion, Points, Units
from trainctl.plants import disturbance
from trainctl.plants.integrate import Extremes
from trainctl.prepare import Prepared
from trainctl.railway import Lookout, Supervision
from trainctl.record.journal import Journal, Row
from trainctl.reroute import Reroutes
from trainctl.service import Service
from trainctl.signals import POSITION, SPEED, Bools, Demand, Floats, Ints, Links, Trains
from trainctl.supervisor import applied
from trainctl.topology import convoys, graph
from trainctl.topology.exchange import Exchange
from trainctl.topology.ways import Ways, under
from trainctl.world import Seen, Start, World, lay_out

#: Slower than this is a stand [m/s].
STANDS = 1e-9


class Simulation:
    """One run, step by step.

    Parameters
    ----------
    prepared : Prepared
        The scenario as arrays.
    world : World
        SUMO, or the numeric stand-in.
    journal : Journal
        Where rows and events go.

    Attributes
    ----------
    own : ndarray, shape (U, 2) or (U, 3)
        State of every unit: position [m], speed [m/s] (and force [N]).
    track : ndarray, shape (n,)
        Track every train is on, as index into ``line.track_ids``.
    formation : ndarray, shape (n,)
        Track of the formation every train belongs to; a train whose join is delayed stands outside of all (-1 - its index).
    service : Service or None
        Trains that come and go, where they do.
    relinked : tuple or None
        Time, ``own`` and links at the last change of topology: what the constants were made of.
    between : callable or None
        Called after every step.
    """

    def __init__(self, prepared: Prepared, world: World, journal: Journal) -> None:
        self.p, self.world, self.journal = prepared, world, journal
        run, top = prepared.scenario.run, prepared.scenario.topology
        n = len(prepared.scenario.train)
        self.k = 0
        self.own = prepared.own.copy()
        self.line_track = np.array([prepared.line.track_ids.index(t) for t in prepared.line.tracks], np.int64)
        self.track = prepared.start_track.copy()
        self.formation = self.track.copy()
        self.links: Links | None = None
        self.ahead: Ints = np.full(n, -1)
        self.lookout = None if prepared.supervision.mode == "off" and prepared.roster is None else Lookout(prepared)
        self.service = None if prepared.roster is None else Service(prepared)
        self.supervision = Supervision(prepared)
        self.reroutes = Reroutes(prepared)
        self.signals = disturbance.prepare(
            prepared.scenario.disturbance, prepared.scenario.ids, run.step_s, run.seed, prepared.worst
        )
        period = top.communication_period_s or run.control_period_s or run.step_s
        self.exchange = Exchange(loss=top.loss, delay=round(top.delay_s / period), radius=top.range_m or np.inf, seed=run.seed or 0)
        self.motion: Points | Units = Points(prepared) if prepared.scenario.plant.kind == "point" else Units(prepared)
        noisy = isinstance(self.motion, Units) and self.motion.noise_hold is not None
        self.disturbing = noisy or bool(len(self.signals.whole))
        self.demand = Demand(np.zeros(n), np.zeros(n, bool))
        self.outside = np.full(n, np.nan)
        self.alarms = monitor.Alarms(prepared)
        self.kept_out: dict[int, int] = {}  # trains that cannot enter now: because of whom
        self.not_entered = 0
        self.relinked: tuple[float, Floats, Links] | None = None
        self.between: Callable[[], Any] | None = None
        self._start()

    @property
    def time(self) -> float:
        """Scenario time of the present state [s]."""
        return self.k * self.p.scenario.run.step_s

    def step(self) -> None:
        """One simulator step of the closed loop."""
        t = self.time
        seen = self._measure()
        view = self._traffic(t, seen)
        self._topology(t, seen, view)
        disturbed = disturbance.at(self.signals, self.k, t, seen.position)
        if self.p.sampled and self.k % self.p.scenario.run.held_steps == 0:
            self.demand = self._protect(self._control(t, disturbed))
        self.demand = self._from_outside(self.demand)
        before, past = self.own, self._past()
        self.own, motion = self._supervised(t, seen, view, before, disturbed)
        self._check(t, motion)
        self._record(t, seen, before, motion, past, disturbed)
        if view is not None:
            speed = before[self.p.heads, SPEED]
            for kind, told in self.alarms.waits(t, self.world.measure(), speed, view, self.held, self.service, self.kept_out):
                self.journal.event(t, kind, **told)
        if self.service is not None:
            self.service.advance()
        self.world.move(motion.displacement, self.p.scenario.run.step_s)
        self.k += 1
        if self.between is not None:
            self.between()

    def run(self, progress: Callable[[int, int], Any] | None = None) -> None:
        """All steps; ``progress(done, steps)`` is called about a hundred times."""
        steps = self.p.scenario.run.steps
        every = max(1, steps // 100)
        while self.k < steps:
            self.step()
            if progress is not None and self.k % every == 0:
                progress(self.k, steps)
        self.end()

    def end(self) -> None:
        """Record the last state, which nothing acts on."""
        seen = self._measure()
        if self.service is None:
            self._topology(self.time, seen, None)
        self._record(self.time, seen, self.own, None, self._past(), None)
        late = [] if self.service is None else self.service.missing(self.time)
        self.not_entered = len(late)
        if late:
            self.journal.event(self.time, "not_entered", trains=late)

    def _start(self) -> None:
        p, line, roster = self.p, self.p.line, self.p.roster
        ids, first, speed = p.scenario.ids, p.consists.first, self.own[p.heads, SPEED]
        places = [line.locate(t.track, t.position_m) for t in p.scenario.train] if roster is None else []
        start = Start(
            ids=ids,
            edge=np.array([e for e, _ in places], np.int64) if roster is None else roster.edge,
            lane_position=np.array([x for _, x in places]) if roster is None else roster.lane_position,
            speed=speed.copy(),
            length=p.consists.train_length(),
            unit_length=[p.consists.length[a:b] for a, b in pairwise(first)],
            routes=[line.route(t.track, t.position_m) for t in p.scenario.train] if roster is None else roster.routes,
            present=np.full(len(ids), roster is None),
            vclass=["rail"] * len(ids) if roster is None else roster.vclass,
        )
        if self.service is not None:
            ways = lay_out(line, start)
            row = ways.first[:-1]
            nobody = Seen(ways.begin[row] + start.lane_position, ways.edge[row], row, start.present)
            for i, v in self._entering(0.0, ways, nobody):
                start.present[i], start.speed[i] = True, v
        self.world.start(start)

    def _measure(self) -> Seen:
        """SUMO owns where a train is: shift every train, as a whole, onto its measured front."""
        seen = self.world.measure()
        if self.service is not None:
            seen = seen._replace(position=seen.position + self.service.offset)
        shift = seen.position - self.own[self.p.heads, POSITION]
        self.own[:, POSITION] += np.repeat(shift, np.diff(self.p.consists.first))
        return seen

    def _traffic(self, t: float, seen: Seen) -> View | None:
        """New routes, trains that come, leave and stop; returns what is ahead of every train, where anybody asks."""
        speed = self.own[self.p.heads, SPEED]
        for i, edges in self.reroutes.orders(t, self.world.measure(), self.world.ways, speed, self.ahead, self.journal):
            self.world.route(i, edges)
        if self.lookout is None:
            return None
        here, ways = self.world.measure(), self.world.ways
        if self.service is None:
            self.held = self.lookout.claim(t, ways, here, speed, self.journal, ~here.present)
            return self.lookout.look(ways, here, speed, self.held)
        self.service.arrivals(t, here.present, self.journal)
        overrun = self.motion.overrun(self.own, self.service.rules.service_mps2)
        self.stops = self.service.stops(t, here, speed, overrun, self.journal)
        present = here.present.copy()
        for i, v in self._entering(t, ways, here):
            self.world.insert(i, v)
            present[i] = True
        return self.lookout.look(ways, here._replace(present=present), self.own[self.p.heads, SPEED], self.held)

    def _entering(self, t: float, ways: Ways, here: Seen) -> list[tuple[int, float]]:
        """Trains whose time has come and whose place is clear, with the speed they come with [m/s]."""
        assert self.service is not None and self.lookout is not None
        due, speed = self.service.due(t), self.own[self.p.heads, SPEED]
        asking = np.zeros(len(speed), bool)
        asking[due] = True
        self.held = self.lookout.claim(t, ways, here, speed, self.journal, asking)
        self.kept_out.clear()
        come, present = [], here.present.copy()
        for i in due:
            if self.held.room[i] <= 0.0:
                continue
            present[i] = True
            view = self.lookout.look(ways, here._replace(present=present), speed, self.held)
            v = self.service.entering_speed(i, speed, view)
            present[i] = v is not None
            if v is not None:
                self.service.enters(i, t, v, self.journal)
                self.own[self.p.consists.first[i] : self.p.consists.first[i + 1], SPEED] = v
                speed[i] = v
                come.append((i, v))
            else:
                self.kept_out[i] = waiting.kept_out(view, i)
        return come

    def _topology(self, t: float, seen: Seen, view: View | None) -> None:
        """Who hears whom; made anew only when a track, the order or a coupling changed."""
        track = self.line_track[seen.edge]
        if self.service is not None and view is not None:
            self.track = track
            if self.service.couple(t, seen, self.own, view, self.journal) or self.links is None:
                links = self.service.links()
                self.formation = convoys.fronts(self.service.ahead)
                self._relink(t, links)
            seen.position[:] = self.own[self.p.heads, POSITION]
            return
        moved = np.flatnonzero(track != self.track)
        for i in moved.tolist():
            self.journal.event(t, "leave", train=self.p.scenario.ids[i], track=self.p.line.track_ids[self.track[i]])
        self.track = track
        waiting = self._admit(t, seen, moved)
        if self.links is None or waiting or not graph.in_order(self.links.order, seen.position, self.formation):
            order = graph.order_on_tracks(seen.position, self.formation)
            self._relink(t, graph.links(self.p.plan, order, self.formation))

    def _admit(self, t: float, seen: Seen, moved: Ints) -> bool:
        """Let trains join the formation of their track; where the law needs its start condition, only once it holds.

        Returns whether the set of members changed.
        """
        outside = np.flatnonzero(self.formation != self.track)
        if not len(outside):
            return False
        careful = getattr(self.p.law, "JOIN", "always") == "start_condition"
        changed = False
        for i in outside.tolist():
            without, candidate = self.formation.copy(), self.formation.copy()
            without[i], candidate[i] = -1 - i, self.track[i]
            why: list[str] = []
            if careful and np.any(without == self.track[i]):
                known = set(self._violations(t, seen, without))
                why = [v for v in self._violations(t, seen, candidate) if v not in known]
            name, track = self.p.scenario.ids[i], self.p.line.track_ids[self.track[i]]
            if not why:
                self.formation = candidate
                changed = True
                self.journal.event(t, "join", train=name, track=track)
            elif i in moved:
                self.formation[i] = -1 - i
                changed = True
                self.journal.event(t, "join_delayed", train=name, track=track, reasons=why)
        return changed

    def _violations(self, t: float, seen: Seen, formation: Ints) -> list[str]:
        """What the law would object to with these formations."""
        links = graph.links(self.p.plan, graph.order_on_tracks(seen.position, formation), formation)
        return list(self.p.law.violations(self.p.params, self.p.scene(self.own, links, t)))

    def _relink(self, t: float, links: Links) -> None:
        before, self.links = self.links, links
        if before is not None:
            unheard = before._replace(heard=links.heard)  # a lost message is no change of the edge list
            if all(np.array_equal(a, b) for a, b in zip(unheard, links, strict=True)):
                return
        p = self.p
        self.relinked = t, self.own.copy(), links
        scene = p.scene(self.own, links, t)
        self.constants = p.law.constants(p.params, scene)
        self.exchange.relink(before, links)
        if isinstance(self.motion, Units):
            self.motion.relink(scene, self.constants)
        rank = np.argsort(links.order)
        self.ahead = np.full(len(rank), -1)
        behind = links.order[1:][self.formation[links.order[1:]] == self.formation[links.order[:-1]]]
        self.ahead[behind] = links.order[rank[behind] - 1]
        check = before is not None and self.service is None  # the service has asked before it coupled
        self.world.linked(links, self.formation)
        groups = graph.components(len(rank), links.sender, links.receiver)
        here = self.world.measure().present
        self.journal.event(
            t,
            "topology",
            edges=graph.edges(links, p.scenario.ids),
            formations=[[p.scenario.ids[i] for i in sorted(group)] for group in groups if here[list(group)].any()],
            start_condition=p.law.violations(p.params, scene) if check else [],
        )
        for alarm in self.alarms.relinked(t, groups, self.formation, scene):
            self.journal.event(t, "violation", **alarm)

    def _control(self, t: float, disturbed: disturbance.Disturbed) -> Demand:
        """Exchange messages and evaluate the sampled law."""
        assert self.links is not None
        law = self.p.law
        leader = self.p.leader(t) if self.service is None else self.service.leader()
        heads = self.own[self.p.heads]
        own = Trains(
            position=heads[:, POSITION] + disturbed.measurement,
            speed=heads[:, SPEED],
            resistance=self.motion.believed_resistance(self.own),
        )
        sent = law.message(self.constants, own, leader)
        heard = self.exchange.deliver(sent, own.position, self.links, self.k // self.p.scenario.run.held_steps)
        demand: Demand = law.demand(self.constants, own, leader, self.links._replace(heard=heard), self.exchange.heard)
        self.links = self.links._replace(heard=heard)
        wrong = np.flatnonzero(~np.isfinite(demand.acceleration))
        if len(wrong):
            names = ", ".join(self.p.scenario.ids[i] for i in wrong)
            raise LawError(f"law {self.p.scenario.controller.law} gave a number that is not finite for train {names} at {t:g} s")
        return demand

    def _from_outside(self, demand: Demand) -> Demand:
        """Accelerations that somebody outside has set (not NaN) take the place of the law's."""
        free = np.isnan(self.outside)
        if free.all():
            return demand
        return self._protect(Demand(np.where(free, demand.acceleration, self.outside), demand.saturated & free))

    def _protect(self, demand: Demand) -> Demand:
        """Speed and input clamps of a law whose model has them, for trains of units (point trains clamp in the plant)."""
        p, bounds = self.p, self.p.bounds
        if not getattr(p.law, "CLAMPED", False) or isinstance(self.motion, Points):
            return demand
        speed, resistance = self.own[p.heads, SPEED], self.motion.believed_resistance(self.own)
        period = p.scenario.run.control_period_s or p.scenario.run.step_s
        asked = demand.acceleration
        given = np.clip(asked, bounds.input_lower - resistance, bounds.input_upper - resistance)
        given = np.clip(given, (bounds.speed_lower - speed) / period, (bounds.speed_upper - speed) / period)
        return Demand(given, demand.saturated | (given != asked))

    def _supervised(
        self, t: float, seen: Seen, view: View | None, own: Floats, disturbed: disturbance.Disturbed
    ) -> tuple[Floats, Motion]:
        """The plant over one step: as the law demands, or the driver of a train alone, within what the supervisor allows."""
        free = np.full(len(seen.position), np.nan)
        speed = own[self.p.heads, SPEED]
        if view is None:
            return self._advance(t, own, free, disturbed)
        raw = self.world.measure()
        stands = ~raw.present
        ordered = free
        if self.service is not None:
            ordered = self.service.drive(raw, speed, self.motion.acceleration(own), view, self.stops)
            if self.p.rails.slope.any():
                places = own[:, POSITION] - np.repeat(self.service.offset, np.diff(self.p.consists.first))
                self.motion.climbs(under(self.world.ways, self.p.rails.slope, raw.row, self.p.consists.first, places))
            stands = stands | self.service.standing | self.service.halted
        if self.supervision.rules.mode == "off":
            return self._advance(t, own, ordered, disturbed, stands)
        verdict = self.supervision.verdict(view, speed, self.motion.acceleration(own), disturbed.measurement)
        trial = self.motion.saved(), self.exchange.copy()
        # It judges the step as it would be without what disturbs it, which nobody knows before.
        moved, motion = self._advance(t, own, ordered, disturbed.calm(), stands, calm=True)
        within, acts = applied(verdict, motion.asked)
        acts &= ~stands
        acts_on = self.supervision.rules.mode == "on" and acts.any()
        if acts_on or self.disturbing:
            self.motion.restore(trial[0])
            self.exchange = trial[1]
            ordered = np.where(acts, within, ordered) if acts_on else ordered
            moved, motion = self._advance(t, own, ordered, disturbed, stands)
        self.supervision.tell(self.journal, t, verdict, acts, view, speed)
        return moved, motion

    def _advance(
        self, t: float, own: Floats, ordered: Floats, disturbed: disturbance.Disturbed, stands: Bools | None = None,
        calm: bool = False,
    ) -> tuple[Floats, Motion]:  # fmt: skip
        """The plant over one step; trains that stand, or are not there, stay as they are."""
        pace = None if self.service is None else self.service.leader()
        moved, motion = self.motion.advance(
            self.k, t, own, self.demand, self.links, self.exchange, disturbed, ordered, pace, calm
        )  # fmt: skip
        if stands is None:
            return moved, motion
        moved[np.abs(moved[:, SPEED]) < STANDS, SPEED] = 0.0  # a stand ordered is one, rounding aside
        rows = np.repeat(stands, np.diff(self.p.consists.first))
        moved[rows] = own[rows]
        here = self.world.measure().present
        moved[np.repeat(stands & here, np.diff(self.p.consists.first)), SPEED] = 0.0
        return moved, motion._replace(
            displacement=np.where(stands, 0.0, motion.displacement), clipped=motion.clipped & ~stands,
            acceleration=np.where(stands, 0.0, motion.acceleration), asked=np.where(stands, 0.0, motion.asked),
        )  # fmt: skip

    def _check(self, t: float, motion: Motion) -> None:
        """Numbers must stay finite; a train never moves backwards; bounds that break are told once."""
        if not (np.isfinite(self.own).all() and np.isfinite(motion.displacement).all()):
            finite = np.logical_and.reduceat(np.isfinite(self.own).all(axis=1), self.p.heads)
            wrong = np.flatnonzero(~(finite & np.isfinite(motion.displacement)))
            names = ", ".join(self.p.scenario.ids[i] for i in wrong)
            raise LawError(f"the state of train {names} is no longer finite after {t:g} s: the law or the step diverged")
        for i in np.flatnonzero(motion.clipped).tolist():
            self.journal.event(t, "limit", train=self.p.scenario.ids[i], what="backwards", note="held at standstill")

    @property
    def _recorded(self) -> bool:
        return self.k % self.p.scenario.run.recorded_steps == 0 or self.k == self.p.scenario.run.steps

    def _past(self) -> Extremes | None:
        """Extremes since the last row, if one is due now."""
        return self.motion.taken() if self._recorded and isinstance(self.motion, Units) else None

    def _record(
        self, t: float, seen: Seen, own: Floats, motion: Motion | None, past: Extremes | None,
        disturbed: disturbance.Disturbed | None,
    ) -> None:  # fmt: skip
        """Hand everything to the journal, and watch the bounds at every step, recorded or not."""
        assert self.links is not None
        heads = own[self.p.heads]
        row = Row(
            time=t, seen=seen, track=self.track, own=own, speed=heads[:, SPEED], ahead=self.ahead, links=self.links,
            motion=motion, saturated=self._saturated(motion), extremes=past, disturbed=disturbed,
            led=None if self.service is None else self.service.led,
        )  # fmt: skip
        for alarm in self.alarms.new(row, self.world.ways, self.world.measure()):
            self.journal.event(t, "violation", **alarm)
        if self._recorded:
            self.journal.write(row)

    def _saturated(self, motion: Motion | None) -> Bools:
        return self.demand.saturated if motion is None else self.demand.saturated | motion.limited
