"""What must hold is watched while a run goes on: the first violation of anything becomes an event; the metrics count afterwards.

Watched: speed and input bounds, link spacings, the constrained quantities of continuous laws, couplers, trains inside one another,
the line's speed limits, connected formations, and the balance of energies; and who waits for whom. That SUMO moved every train just
as far as it was told is watched by the world itself, and ends the run.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from trainctl.monitors import energy, on_track, waiting
from trainctl.monitors.on_track import ROUNDING
from trainctl.monitors.outcome import Tally
from trainctl.monitors.waiting import Wait, Waiting
from trainctl.signals import Floats, Ints

if TYPE_CHECKING:
    from trainctl.railway.ways import Ways
    from trainctl.scenario.model import Model
    from trainctl.signals import Row, Seen
    from trainctl.stages.traffic import Around
    from trainctl.stages.traffic import State as Traffic

Alarm = dict[str, Any]


def _alarm(bound: str, who: str, value: float, limit: float) -> Alarm:
    return {"bound": bound, "who": who, "value": value, "limit": limit}


class State(NamedTuple):
    """What has been violated so far, and what that is computed from; overwritten in place."""

    tally: Tally
    last: Floats  # (n,) m, fronts a step ago, see ``on_track``
    waiting: waiting.State
    during: Floats  # (lower and upper, n, q) bounds of constrained quantities in the interval the extremes are of
    now: Floats  # ... under the present links
    energy: energy.State | tuple[()]


class Alarms:
    """Tells what is violated for the first time. Its methods update the ``State`` they are given."""

    def __init__(self, p: Model) -> None:
        self.p = p
        self.watch = on_track.of(p)
        self.waiting = Waiting(p.scenario.ids, p.line.edges, p.driving.wait_limit_s)
        self.watched: tuple[str, ...] = tuple(getattr(p.law, "WATCHED", ())) if p.has_units and not p.sampled else ()
        self.energy = energy.Balance(p) if p.has_units else None

    def turned(self, p: Model, trains: Sequence[int], s: State) -> None:
        """Take over a scenario with the units of some trains in another order; these have turned just now."""
        self.p, self.energy = p, energy.Balance(p) if p.has_units else None
        s.last[list(trains)] = np.nan  # they are in another place of another way

    def initial(self) -> State:
        """Nothing violated yet."""
        n = len(self.p.scenario.train)
        free = np.stack([np.full((n, len(self.watched)), -np.inf), np.full((n, len(self.watched)), np.inf)])
        return State(
            Tally.empty(), self.watch.initial(), self.waiting.initial(), free, free.copy(),
            self.energy.initial() if self.energy else (),
        )  # fmt: skip

    def new(self, row: Row, ways: Ways, here: Seen, s: State) -> Iterator[Alarm]:
        """What is violated in this row for the first time, as fields of an event; ``here`` is where the world has the trains."""
        for alarm in chain(self._all(row, s), self.watch.violated(row.time, ways, here, row.speed, s.last)):
            yield from s.tally.once(row.time, **alarm)

    def counted(self, end: float, collisions: Sequence[Mapping[str, Any]], s: State) -> Iterator[tuple[float, Alarm]]:
        """Time [s] and fields of events for the collisions of ``World.collisions`` that were not told before."""
        for found in collisions:
            at = end if found["time_s"] is None else found["time_s"]
            for alarm in s.tally.counted(at, found):
                yield at, alarm

    def relinked(self, time: float, groups: Sequence[Sequence[int]], formation: Ints, scene: Any, s: State) -> Iterator[Alarm]:
        """Take over the law's bounds on new links; a formation that is in pieces is told.

        Parameters
        ----------
        time : float
            Now [s].
        groups : sequence of sequence of int
            Trains that are connected by links, directly or not.
        formation : ndarray, shape (n,)
            The formation every train belongs to.
        scene : Scene
            For the law's ``watched_bounds``.
        s : State
            Updated.
        """
        if self.watched:
            s.now[:] = np.stack(self.p.law.watched_bounds(self.p.params, scene))
            if self.p.driven:  # a train in no formation is not watched
                alone = np.bincount(scene.links.receiver, minlength=len(formation)) == 0
                s.now[0, alone], s.now[1, alone] = -np.inf, np.inf
        piece = np.empty(len(formation), np.int64)
        for k, group in enumerate(groups):
            piece[list(group)] = k
        whole = np.zeros_like(formation) if self.p.plan.rule == "links" else formation
        pairs = np.unique(np.stack([whole, piece]), axis=1)[0]
        for key in np.unique(pairs[1:][pairs[1:] == pairs[:-1]]).tolist():
            who = ",".join(self.p.scenario.ids[i] for i in np.flatnonzero(whole == key))
            yield from s.tally.once(time, bound="connected_pieces", who=who, value=float((pairs == key).sum()), limit=1.0)

    def _all(self, row: Row, s: State) -> Iterator[Alarm]:
        ids, bounds, speed, led = self.p.scenario.ids, self.p.bounds, row.speed, row.led
        yield from self._per_train("speed_lower_mps", speed, bounds.speed_lower, led & (speed < bounds.speed_lower - ROUNDING))
        yield from self._per_train("speed_upper_mps", speed, bounds.speed_upper, led & (speed > bounds.speed_upper + ROUNDING))
        if row.motion is not None:
            u = row.motion.input
            yield from self._per_train("input_lower_mps2", u, bounds.input_lower, led & (u < bounds.input_lower - ROUNDING))
            yield from self._per_train("input_upper_mps2", u, bounds.input_upper, led & (u > bounds.input_upper + ROUNDING))
        yield from self._couplers(row)
        yield from self._constrained(row, s)
        yield from self._energies(row, s)
        links = row.links
        spacing = row.seen.position[links.sender] - row.seen.position[links.receiver]
        ahead = spacing > 0.0  # each pair once
        for key, bound, violated in (
            ("spacing_lower_m", links.lower, spacing < links.lower - ROUNDING),
            ("spacing_upper_m", links.upper, spacing > links.upper + ROUNDING),
        ):
            for k in (violated & ahead).nonzero()[0].tolist():
                yield _alarm(key, f"{ids[links.sender[k]]}-{ids[links.receiver[k]]}", float(spacing[k]), float(bound[k]))

    def _couplers(self, row: Row) -> Iterator[Alarm]:
        """Couplers beyond their range in any sub-step since the last row."""
        p, x, bounds = self.p, row.extremes, self.p.scenario.bounds
        if x is None or bounds.coupler_lower_m is None or bounds.coupler_upper_m is None:
            return
        for key, value, bound, violated in (
            ("coupler_lower_m", x.coupler_min, bounds.coupler_lower_m, x.coupler_min < bounds.coupler_lower_m),
            ("coupler_upper_m", x.coupler_max, bounds.coupler_upper_m, x.coupler_max > bounds.coupler_upper_m),
        ):
            for u in violated.nonzero()[0].tolist():
                i = int(np.searchsorted(p.consists.first, u, side="right")) - 1
                yield _alarm(key, f"{p.scenario.ids[i]}.{p.unit[u]}", float(value[u]), bound)

    def _constrained(self, row: Row, s: State) -> Iterator[Alarm]:
        """The law's own constrained quantities in any sub-step since the last row, against the bounds that held then."""
        x = row.extremes
        if not self.watched:
            return
        if x is None:  # not recorded: extremes go on, perhaps under new links, so the wider bounds serve
            np.minimum(s.during[0], s.now[0], out=s.during[0])
            np.maximum(s.during[1], s.now[1], out=s.during[1])
            return
        low, high = s.during.copy()
        s.during[:] = s.now
        seen = x.watched_min <= x.watched_max
        for side, value, bound, violated in (
            ("lower", x.watched_min, low, seen & (x.watched_min < low - ROUNDING)),
            ("upper", x.watched_max, high, seen & (x.watched_max > high + ROUNDING)),
        ):
            for i, q in np.argwhere(violated).tolist():
                stem, _, unit = self.watched[q].rpartition("_")
                yield _alarm(f"{stem}_{side}_{unit}", self.p.scenario.ids[i], float(value[i, q]), float(bound[i, q]))

    def _energies(self, row: Row, s: State) -> Iterator[Alarm]:
        """Trains whose energy changes by something else than what is accounted for."""
        if self.energy is None:
            return
        assert isinstance(s.energy, energy.State)
        for i, share in self.energy.violated(row, s.energy):
            yield _alarm("energy_balance_share", self.p.scenario.ids[i], share, self.energy.LIMIT)

    def waits(
        self, t: float, here: Seen, speed: Floats, traffic: Traffic, around: Around, due: Sequence[int], s: State
    ) -> Iterator[tuple[str, Alarm]]:
        """Long waits and circles, as kind and fields of events; ``due`` are the trains that are to come now, one on each edge."""
        p, found, since = self.p, list[Wait](), dict[int, float]()
        if around.view is None or around.ends is None:
            return
        rules, assumed = (p.driver_rules, p.relied_on_by_driver) if p.driven else (p.supervision, p.assumed)
        if rules.mode == "on":  # otherwise nothing keeps a train from going on
            found = waiting.waits(
                around.view, around.ends, here, speed, rules, assumed, p.scenario.run.step_s, p.step_theta, traffic.standing
            )
        back = np.flatnonzero(traffic.kept_back >= 0).tolist()
        found += [Wait(i, int(traffic.kept_back[i]), int(here.edge[i]), waiting.TURN) for i in back]
        over = np.flatnonzero((traffic.stands_until < t - 1e-9) & ~p.roster.driven).tolist()
        found += [Wait(i, -1, int(here.edge[i]), waiting.PARKED) for i in over]
        if p.driven:  # those whom nothing keeps that is known: their driver would start them
            known = {w.train for w in found}
            stand = np.flatnonzero(waiting.standing(here, speed, traffic.standing)).tolist()
            found += [Wait(i, -1, int(here.edge[i]), None) for i in stand if i not in known]
        entries = waiting.entries(p.roster, traffic.came, due, t, around.ends, around.kept_out)
        since = {w.train: float(p.roster.depart[w.train]) for w in entries}
        yield from self.waiting.new(t, found + entries, since, s.waiting)

    def outcome(self, not_entered: int, s: State) -> dict[str, Any]:
        """What run.json says of a finished run; ``not_entered`` trains were due and never came."""
        counted = s.waiting.counted
        more = {"gridlocks": len(counted["circles"]), "waited_long": counted["long"], "not_entered": not_entered}
        return s.tally.outcome(self.p.supervision.mode == "on", more)

    def _per_train(self, key: str, value: Floats, bound: Floats, violated: Any) -> Iterator[Alarm]:
        for i in violated.nonzero()[0].tolist():
            yield _alarm(key, self.p.scenario.ids[i], float(value[i]), float(bound[i]))
