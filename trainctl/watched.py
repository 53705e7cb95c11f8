"""Trains that the simulator drives by itself: nothing is commanded but reroutes, all is watched and recorded as in any other run.

Their rows differ in one thing: the force of a step, ``input_mps2``, is told from the motion once the step is done.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from trainctl.railway import supervisor
from trainctl.railway.ways import Ways
from trainctl.record.columns import Call
from trainctl.scenario.model import Model
from trainctl.scenario.roster import Stop
from trainctl.signals import POWERS, Bools, Extremes, Floats, Ints, Links, Motion, Observed, Row, Seen
from trainctl.stages import orders, record
from trainctl.stages.effort import Effort
from trainctl.steps import Steps
from trainctl.world import SelfDriven


class State(NamedTuple):
    """All that changes from step to step."""

    k: int  # steps done
    orders: orders.State
    entered: Bools  # (n,)
    edge: Ints  # (n,) where every train was last told of, -1: not on the net
    stops: tuple[str, ...]  # at which each train stands, "" if at none
    next_stop: Ints  # (n,) number of it in the roster
    since: Floats  # (n,) s, when each train came to stand there; NaN: it does not
    energy: Floats  # (n, 6) J since the last row, as ``POWERS``
    watch: record.State


class Watched(Steps):
    """The stages of one such run; ``state`` is where it stands.

    Parameters
    ----------
    model : Model
        The scenario as arrays.
    world : SelfDriven
        What drives the trains.
    journal : Journal
        Where rows and events go.
    """

    state: State

    def __init__(self, model: Model, world: SelfDriven, journal: record.Journal) -> None:
        super().__init__(model, journal)
        p, self.world = model, world
        # Only the simulator protects these trains: their switches are locked within its braking distance.
        self.rate = rate = p.law.braking_mps2(p.params)
        protected = supervisor.Params(mode="on", service_mps2=rate, emergency_mps2=rate)
        ruled = replace(p, scenario=p.scenario.model_copy(update={"supervisor": protected}))
        self.orders, self.effort = orders.Orders(ruled, journal), Effort(p)
        n = len(p.scenario.ids)
        self.state = State(
            k=0, orders=self.orders.initial(), entered=np.zeros(n, bool), edge=np.full(n, -1), stops=("",) * n,
            next_stop=np.zeros(n, np.int64), since=np.full(n, np.nan),
            energy=np.zeros((n, len(POWERS))),
            watch=self.record.initial(),
        )  # fmt: skip
        world.start()

    @property
    def over(self) -> bool:
        """Whether no step is left, or no train."""
        return super().over or self.world.over

    def after(self, s: State) -> State:
        """The state a step later."""
        world, now, t = self.world, self.world.measure(), self.time
        s = self._told(t, now, s)

        def stops_in() -> Floats:
            speed = np.maximum(now.speed, 0.0)
            return supervisor.stopping_distance(speed, self.rate, self.p.scenario.run.step_s, self.p.step_theta)

        ordered, routes = self.orders.step(t, now.seen, world.ways, now.speed, stops_in, now.ahead, s.orders)
        for i, edges in routes:
            world.route(i, edges)
        now, ways = world.measure(), world.ways
        world.step()
        motion, energy = self.effort.step(now, world.measure())
        due = self.record.due(s.k)
        self._record(t, ways, now, motion, due, s)
        return s._replace(k=s.k + 1, orders=ordered, energy=(0.0 if due else s.energy) + energy)

    def end(self) -> None:
        """The last instant, which nothing acts on."""
        now, t = self.world.measure(), self.time
        self.state = s = self._told(t, now, self.state)
        self._record(t, self.world.ways, now, None, True, s)
        for i, stops in enumerate(self.p.roster.stops):
            for k, stop in enumerate(stops[int(s.next_stop[i]) :], int(s.next_stop[i])):
                self._call(i, stop, k, float(s.since[i]) if k == s.next_stop[i] else np.nan, np.nan)
        missing = [self.p.scenario.ids[i] for i in np.flatnonzero(~s.entered)]
        self.not_entered = len(missing)
        if missing:
            self.journal.event(t, "not_entered", trains=missing)

    def outcome(self) -> dict[str, Any]:
        """What run.json says of the finished run."""
        return self.state.watch.alarms.tally.outcome(supervised=False, more={"not_entered": self.not_entered})

    def _told(self, t: float, now: Observed, s: State) -> State:
        """Tell of trains that came, left, or changed tracks since the last step."""
        ids, tracks, seen = self.p.scenario.ids, self.p.line.tracks, now.seen
        edge = np.where(seen.present, seen.edge, -1)
        for i in np.flatnonzero(seen.present & ~s.entered).tolist():
            planned = float(self.world.planned[i])
            self.journal.event(
                t, "depart", train=ids[i], planned_s=planned, delay_s=t - planned, track=tracks[edge[i]],
                position_m=float(seen.position[i]), speed_mps=float(now.speed[i]),
            )  # fmt: skip
        for i in np.flatnonzero((s.edge >= 0) & (edge != s.edge)).tolist():
            if edge[i] < 0:
                self.journal.event(t, "arrive", train=ids[i])
            elif tracks[s.edge[i]] != tracks[edge[i]] and self.p.placed:
                self.journal.event(t, "leave", train=ids[i], track=tracks[s.edge[i]])
                self.journal.event(t, "join", train=ids[i], track=tracks[edge[i]])
        for i, (was, now_at) in enumerate(zip(s.stops, self.world.stops, strict=True)):
            if was and was != now_at:
                self.journal.event(t, "stop_left", train=ids[i], stop=was)
            if now_at and was != now_at:
                self.journal.event(
                    t, "stop_reached", train=ids[i], stop=now_at, **({"parked": True} if self.world.parked[i] else {})
                )
        s = self._calls(t, seen, s)
        return s._replace(entered=s.entered | seen.present, edge=edge, stops=self.world.stops)

    def _calls(self, t: float, seen: Seen, s: State) -> State:
        """Record the stops that trains leave, and the waypoints that they pass."""
        next_stop, since = s.next_stop.copy(), s.since.copy()
        for i, (stops, was, now_at) in enumerate(zip(self.p.roster.stops, s.stops, self.world.stops, strict=True)):
            left = stops[int(next_stop[i]) :]
            if not left or not (seen.present[i] or was):
                continue
            for stop in left:
                if stop.passing and (seen.present[i] and seen.position[i] >= stop.place):
                    self._call(i, stop, int(next_stop[i]), t, t)
                elif not stop.passing and was and was != now_at:
                    self._call(i, stop, int(next_stop[i]), float(since[i]), t)
                    since[i], was = np.nan, ""
                else:
                    break
                next_stop[i] += 1
            if now_at and np.isnan(since[i]):
                since[i] = t
        return s._replace(next_stop=next_stop, since=since)

    def _call(self, i: int, stop: Stop, number: int, arrival: float, departure: float) -> None:
        self.journal.call(i, Call(stop, number + 1, arrival, departure), self.p.rails.index[stop.edge])

    def _record(self, t: float, ways: Ways, now: Observed, motion: Motion | None, due: bool, s: State) -> None:
        """One instant: alarms, then its row, if one is ``due``; ``motion`` is what followed."""
        n, seen = len(s.entered), now.seen
        row = Row(
            time=t, seen=seen, track=self.record.track_of[seen.edge], own=np.zeros((0, 2)), speed=now.speed, ahead=now.ahead,
            links=_nobody(n), motion=motion, saturated=np.zeros(n, bool),
            extremes=Extremes.fresh(n, 0, 0)._replace(energy=s.energy), disturbed=None, led=seen.present, spacing=now.spacing,
        )  # fmt: skip
        here = seen._replace(present=seen.present & ~self.world.parked)  # who is parked is in nobody's way
        self.record.tell(row, ways, here, due, s.watch)


def _nobody(trains: int) -> Links:
    """Links of trains that receive from none."""
    none, empty = np.zeros(0, np.int64), np.zeros(0)
    return Links(
        none, none, np.zeros(trains + 1, np.int64), empty, empty, empty, empty, np.zeros(0, bool), np.full(trains, np.nan),
        np.arange(trains),
    )  # fmt: skip
