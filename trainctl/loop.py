"""The closed loop: measure, topology, control, protect and plant, command and step, record.

``Simulation.step`` is the whole data flow on one screen; everything else hangs off one of its words.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

from trainctl.errors import InputError, LawError
from trainctl.monitors import bounds as monitor
from trainctl.motion import Motion, Points, Units
from trainctl.plants import disturbance
from trainctl.plants.integrate import Extremes
from trainctl.prepare import Prepared
from trainctl.record.journal import Journal, Row
from trainctl.scenario import Event
from trainctl.signals import POSITION, SPEED, Bools, Demand, Floats, Ints, Links, Trains
from trainctl.topology import graph
from trainctl.topology.exchange import Exchange
from trainctl.world import Seen, Start, World


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
        self.pending = sorted(enumerate(prepared.scenario.event, 1), key=lambda e: e[1].time_s)
        self.signals = disturbance.prepare(
            prepared.scenario.disturbance, prepared.scenario.ids, run.step_s, run.seed, prepared.worst
        )
        period = top.communication_period_s or run.control_period_s or run.step_s
        self.exchange = Exchange(loss=top.loss, delay=round(top.delay_s / period), radius=top.range_m or np.inf, seed=run.seed or 0)
        self.motion: Points | Units = Points(prepared) if prepared.scenario.plant.kind == "point" else Units(prepared)
        self.demand = Demand(np.zeros(n), np.zeros(n, bool))
        self.outside = np.full(n, np.nan)
        self.alarms = monitor.Alarms(prepared)
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
        self._order_reroutes(t, seen)
        self._topology(t, seen)
        disturbed = disturbance.at(self.signals, self.k, t, seen.position)
        if self.p.sampled and self.k % self.p.scenario.run.held_steps == 0:
            self.demand = self._protect(self._control(t, disturbed))
        self.demand = self._from_outside(self.demand)
        before, past = self.own, self._past()
        self.own, motion = self.motion.advance(self.k, t, before, self.demand, self.links, self.exchange, disturbed)
        self._check(t, motion)
        self._record(t, seen, before, motion, past, disturbed)
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
        self._topology(self.time, seen)
        self._record(self.time, seen, self.own, None, self._past(), None)

    def _start(self) -> None:
        p, line = self.p, self.p.line
        first = p.consists.first
        places = [line.locate(t.track, t.position_m) for t in p.scenario.train]
        self.world.start(
            Start(
                ids=p.scenario.ids,
                edge=np.array([e for e, _ in places], np.int64),
                lane_position=np.array([x for _, x in places]),
                speed=self.own[p.heads, SPEED],
                length=p.consists.train_length(),
                unit_length=[p.consists.length[a:b] for a, b in pairwise(first)],
                routes=[line.route(t.track, t.position_m) for t in p.scenario.train],
                present=np.ones(len(places), bool),
                vclass=["rail"] * len(places),
            )
        )

    def _measure(self) -> Seen:
        """SUMO owns where a train is: shift every train, as a whole, onto its measured front."""
        seen = self.world.measure()
        shift = seen.position - self.own[self.p.heads, POSITION]
        self.own[:, POSITION] += np.repeat(shift, np.diff(self.p.consists.first))
        return seen

    def _order_reroutes(self, t: float, seen: Seen) -> None:
        """Give trains their new routes when their time has come."""
        while self.pending and self.pending[0][1].time_s <= t + 1e-9:
            number, event = self.pending.pop(0)
            self._reroute(t, number, event, seen)

    def _reroute(self, t: float, number: int, event: Event, seen: Seen) -> None:
        i, line = self.p.scenario.ids.index(event.train), self.p.line
        edge, position = int(seen.edge[i]), float(seen.position[i])
        where = f"train {event.train} is at {position:.3f} m on track {line.tracks[edge]} at {t:g} s"
        try:
            if event.crossover is None:
                ahead = line.next_crossover(line.tracks[edge], position, str(event.to_track))
                if ahead is None:
                    raise ValueError(f"no crossover to track {event.to_track} ahead")
            else:
                ahead = line.crossover[event.crossover]
            edges = line.route_over(line.edges[edge], ahead.id)
        except ValueError as error:
            raise InputError(f"{self.p.file}: event[{number}]: {error}; {where}") from None
        self.world.route(i, edges)
        self.journal.event(
            t, "reroute", train=event.train, crossover=ahead.id, from_track=ahead.from_track, to_track=ahead.to_track,
            switch_m=ahead.start_m,
        )  # fmt: skip

    def _topology(self, t: float, seen: Seen) -> None:
        """Who hears whom; made anew only when a track or the order changed."""
        track = self.line_track[seen.edge]
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
        self.world.linked(links, self.formation)
        groups = graph.components(len(rank), links.sender, links.receiver)
        self.journal.event(
            t,
            "topology",
            edges=graph.edges(links, p.scenario.ids),
            formations=[[p.scenario.ids[i] for i in sorted(group)] for group in groups],
            start_condition=[] if before is None else p.law.violations(p.params, scene),
        )
        for alarm in self.alarms.relinked(t, groups, self.formation, scene):
            self.journal.event(t, "violation", **alarm)

    def _control(self, t: float, disturbed: disturbance.Disturbed) -> Demand:
        """Exchange messages and evaluate the sampled law."""
        assert self.links is not None
        law, leader = self.p.law, self.p.leader(t)
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

    def _check(self, t: float, motion: Motion) -> None:
        """Numbers must stay finite; a train never moves backwards; bounds that break are told once."""
        finite = np.logical_and.reduceat(np.isfinite(self.own).all(axis=1), self.p.heads)
        wrong = np.flatnonzero(~(finite & np.isfinite(motion.displacement)))
        if len(wrong):
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
        )  # fmt: skip
        for alarm in self.alarms.new(row):
            self.journal.event(t, "violation", **alarm)
        if self._recorded:
            self.journal.write(row)

    def _saturated(self, motion: Motion | None) -> Bools:
        return self.demand.saturated if motion is None else self.demand.saturated | motion.limited
