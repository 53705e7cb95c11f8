"""Trains that come and go: departures, stops, driving of those that are in no formation, and coupling.

Only runs with ``network.sumocfg`` have this part of the loop; what is ahead of every train they take from ``railway``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from trainctl import lookout, promise, supervisor
from trainctl.lookout import View
from trainctl.prepare import Prepared
from trainctl.railway import DRIVER_MARGIN_M
from trainctl.record.journal import Journal
from trainctl.roster import Stop
from trainctl.signals import POSITION, SPEED, Bools, Floats, Ints, Links, Reference, restrict
from trainctl.supervisor import STOP, SWITCH
from trainctl.topology import along, convoys
from trainctl.world import Seen

#: A train that is slower and nearer to its stop than this has reached it [m/s], [m].
STANDS_MPS, STOP_BAND_M = 0.05, 2.0

#: A train that waits to couple asks its law again after this [s].
ASK_AGAIN_S = 2.0

#: A train enters if it can do so with this share of its speed.
ENTERS_WITH = 0.8

#: A formation dissolves this share of the cruising speed above the least speed its law can hold; to form it needs thrice that.
DISSOLVES = 0.02

#: Trains that must slow down, stop or wait within this time do not couple before [s].
SOON_S = 60.0

#: A train that uncoupled does not couple again to the same one within this time [s].
APART_S = 30.0

#: Slower than this share of the cruising speed a train leads nobody: those behind draw up to it, so as not to block what is behind.
CRAWLS = 0.25

#: Slower than this a train that is not to accelerate is held [m/s]: its couplers must not move it.
HELD_MPS = 1e-3

#: Share of the haste to catch up with another formation that is left while a train behind is nearer to joining this one.
HASTE = 0.5

#: Share of the room between cruising speed and the greatest speed that haste may use.
ROOM_FOR_HASTE = 0.75


class Pace(NamedTuple):
    """Reference of every train's own formation now, shape (n,)."""

    position: Floats  # m
    speed: Floats  # m/s
    acceleration: Floats  # m/s2


class Service:
    """Trains that come and go: departures, stops, driving outside of formations, and coupling.

    Attributes
    ----------
    ahead : ndarray, shape (n,)
        Train each is coupled to, -1 if none.
    slot : ndarray, shape (n,)
        Wanted position relative to the formation's reference [m].
    offset : ndarray, shape (n,)
        What is added to a train's measured position so that spacings in its formation are those along the way [m].
    pace : Pace
        References of the formations.
    """

    def __init__(self, p: Prepared) -> None:
        assert p.roster is not None
        self.p, self.roster = p, p.roster
        self.driving = p.driving
        rules, top = p.supervision, p.scenario.topology
        n = len(p.scenario.ids)
        self.n, self.step = n, p.scenario.run.step_s
        self.theta = p.step_theta
        self.spacing = convoys.Spacing(
            float(top.spacing_m or 0.0), -np.inf if top.lower_m is None else top.lower_m,
            np.inf if top.upper_m is None else top.upper_m, top.weight,
        )  # fmt: skip
        self.cruise = np.minimum(float(p.scenario.reference.speed_mps or 0.0), self.roster.top_speed)
        self.ahead: Ints = np.full(n, -1)
        self.slot, self.offset = np.zeros(n), np.zeros(n)
        own = p.own[p.heads]
        self.pace = Pace(own[:, POSITION].copy(), own[:, SPEED].copy(), np.zeros(n))
        self.came, self.left = np.zeros(n, bool), np.zeros(n, bool)
        self.next_stop = np.zeros(n, np.int64)
        self.stands_until = np.full(n, np.nan)  # s, while a train stands at a stop
        self.stopping, self.stops_soon, self.halted = np.zeros(n, bool), np.zeros(n, bool), np.zeros(n, bool)
        self.ask_at = np.zeros(n)
        self.parted: Ints = np.full(n, -1)  # the train each was coupled to before
        self.refused: Ints = np.full(n, -1)  # the train the law did not let each couple to, as was told
        self.least, self.greatest = _band(p, self.spacing) if self.roster.cooperates.sum() > 1 else (-np.inf, np.inf)
        # The driver brakes as planned and keeps farther away, so that the supervisor has nothing to do.
        rate = min(self.driving.deceleration_mps2, rules.emergency_mps2)
        self.assumed = promise.planned(p.assumed, rate)
        self.rules = rules.model_copy(update={
            "mode": "on", "emergency_mps2": rate, "service_mps2": rate, "greatest_mps2": self.driving.acceleration_mps2,
            "margin_m": rules.margin_m + DRIVER_MARGIN_M, "emergency_distance_m": 0.0,
        })  # fmt: skip

    def state(self) -> tuple[Any, ...]:
        """What changes from step to step."""
        return (
            self.ahead, self.slot, self.offset, self.pace, self.came, self.left, self.next_stop, self.stands_until, self.stopping,
            self.stops_soon, self.halted, self.ask_at, self.parted, self.refused,
        )  # fmt: skip

    @property
    def standing(self) -> Bools:
        """Trains that stand at a stop."""
        stands: Bools = ~np.isnan(self.stands_until)
        return stands

    @property
    def led(self) -> Bools:
        """Trains the law drives: members of a formation of two or more."""
        member: Bools = self.ahead >= 0
        member[self.ahead[member]] = True
        return member

    # Departures

    def due(self, t: float) -> list[int]:
        """Trains that are to come now: of each edge the first that waits there."""
        first: dict[int, int] = {}
        for i in np.flatnonzero(~self.came & (self.roster.depart <= t + 1e-9)).tolist():
            first.setdefault(int(self.roster.edge[i]), i)
        return sorted(first.values(), key=lambda i: (self.roster.depart[i], i))

    def missing(self, t: float) -> list[str]:
        """Trains whose time had come by ``t`` [s] and that never entered."""
        late = np.flatnonzero(~self.came & (self.roster.depart <= t + 1e-9))
        return [self.p.scenario.ids[i] for i in late.tolist()]

    def entering_speed(self, i: int, speed: Floats, view: View) -> float | None:
        """Speed with which a train can enter safely; None if it has to wait. ``view`` is that with the train at its place."""
        rules, v = self.rules, self.roster.speed[i]
        limit = float(self.roster.speed_factor[i] * self.p.rails.speed_mps[self.roster.edge[i]])
        on_edge = limit - self.driving.below_limit_mps
        wanted = float(min(self.cruise[i], max(on_edge, 0.0)) if np.isnan(v) else min(v, limit))
        if (stop := self.stop_of(i)) is not None:  # it must be able to stop there
            place = stop.place - float(self.p.rails.start_m[self.roster.edge[i]]) - float(self.roster.lane_position[i])
            room = np.array([place - wanted * self.step])
            planned = float(min(rules.service_mps2, self.assumed.braking[i]))
            wanted = min(wanted, float(supervisor.greatest_speed(room, planned, self.step, self.theta)[0]))
        ahead = lookout.of(view.targets, view.targets.train == i)
        stands = np.where(np.arange(self.n) == i, 0.0, speed)
        _, safe = supervisor.too_late(rules, self.assumed, stands, ahead, self.step, self.theta)
        entry = float(min(wanted, *safe.tolist(), np.inf))
        if np.any(ahead.room < rules.margin_m) or entry < (wanted - 1e-9 if not np.isnan(v) else ENTERS_WITH * wanted):
            return None
        other = int(view.ahead.train[i])
        if other >= 0 and self.roster.cooperates[[i, other]].all() and view.ahead.spacing[i] < self.spacing.desired - 1.0:
            return None
        trial = speed.copy()
        trial[i] = entry
        behind = view.targets.other == i
        if behind.any():
            asked = lookout.of(view.targets, behind)
            seen = supervisor.verdict(
                rules, trial, asked, supervisor.no_limits(), self.step, self.theta, self.assumed, np.zeros(self.n)
            )
            if np.any(seen.emergency[view.targets.train[behind]]):
                return None
        return entry

    def enters(self, i: int, t: float, speed: float, journal: Journal) -> None:
        """Take down that a train comes."""
        self.came[i] = True
        journal.event(
            t, "depart", train=self.p.scenario.ids[i], planned_s=float(self.roster.depart[i]),
            delay_s=t - float(self.roster.depart[i]), speed_mps=speed,
        )  # fmt: skip

    def arrivals(self, t: float, present: Bools, journal: Journal) -> None:
        """Take down trains that have left at the end of their ways."""
        gone = self.came & ~present & ~self.left
        for i in np.flatnonzero(gone).tolist():
            journal.event(t, "arrive", train=self.p.scenario.ids[i])
        self.left |= gone

    # Stops

    def stop_of(self, i: int) -> Stop | None:
        """The next stop of a train."""
        stops, k = self.roster.stops[i], int(self.next_stop[i])
        return stops[k] if k < len(stops) else None

    def stops(self, t: float, seen: Seen, speed: Floats, overrun: Floats, journal: Journal) -> tuple[Ints, Floats]:
        """Arrive at and leave stops; returns the trains that have one ahead and the room to it [m].

        ``overrun`` (n,) is how much farther each train would run than its brakes promise, as they act late [m].
        """
        trains, rooms = [], []
        for i in np.flatnonzero(seen.present & (self.next_stop < [len(s) for s in self.roster.stops])).tolist():
            stop = self.stop_of(i)
            assert stop is not None
            room = stop.place - float(seen.position[i])
            if self.standing[i]:
                if t < self.stands_until[i] - 1e-9:
                    continue
                self.stands_until[i] = np.nan
                self.next_stop[i] += 1
                journal.event(t, "stop_left", train=self.p.scenario.ids[i], stop=stop.name)
                stop = self.stop_of(i)
                if stop is None:
                    self.stopping[i] = False
                    continue
                room = stop.place - float(seen.position[i])
            if speed[i] < STANDS_MPS and room < STOP_BAND_M:
                self.stands_until[i] = max(t + stop.duration, stop.until)
                journal.event(t, "stop_reached", train=self.p.scenario.ids[i], stop=stop.name, short_m=room)
                continue
            trains.append(i)
            rooms.append(max(room - float(overrun[i]), 0.0))
        found, room_to = np.array(trains, np.int64), np.array(rooms)
        rate = np.minimum(self.rules.service_mps2, self.assumed.braking[found])
        braking = supervisor.stopping_distance(speed[found], rate, self.step, self.theta)
        near, soon = np.zeros(self.n, bool), np.zeros(self.n, bool)
        near[found] = room_to < braking + 10.0 * self.step * speed[found] + 50.0
        soon[found] = room_to < braking + SOON_S * speed[found]
        self.stops_soon = soon | near
        self.stopping = (self.stopping & seen.present | near) & (near | self.standing)
        return found, room_to

    # Formations

    def couple(self, t: float, seen: Seen, own: Floats, view: View, journal: Journal) -> bool:
        """Couple and uncouple trains; returns whether any formation changed. ``own`` is moved so that spacings agree."""
        p, ids = self.p, self.p.scenario.ids
        before = self.ahead.copy()
        held = np.zeros(self.n, bool)
        held[view.targets.train[(view.targets.kind == SWITCH) & ~view.targets.moving]] = True
        willing = seen.present & self.roster.cooperates & ~self.stopping & ~self.standing & ~held
        for i in convoys.broken(self.ahead, view.ahead.train, willing).tolist():
            j = int(self.ahead[i])
            self._part(i, t, _why(i, j, seen.present, view.ahead.train), journal)
        for i in self._too_slow().tolist():
            self._part(i, t, "the reference falls below what the law can hold", journal)
        free = convoys.candidates(self.ahead, view.ahead.train, along.behind(view.ahead).train, willing & ~self.stops_soon)
        free = free[(self.ask_at[free] <= t) & ~self._slows_soon(own, view)[free]]
        for i in free[self._fits(free, view, own)].tolist():
            j, spacing = int(view.ahead.train[i]), float(view.ahead.spacing[i])
            if convoys.fronts(self.ahead)[j] != i:
                self.ask_at[i] = t + ASK_AGAIN_S
                reasons = self._try(i, j, spacing, t, own)
                if not reasons:
                    journal.event(t, "couple", train=ids[i], ahead=ids[j], spacing_m=spacing)
                elif self.refused[i] != j:
                    journal.event(t, "join_delayed", train=ids[i], ahead=ids[j], reasons=reasons)
                self.refused[i] = j if reasons else -1
        changed = not np.array_equal(before, self.ahead)
        alone = ~self.led
        head = own[p.heads]
        self.slot[alone] = 0.0
        self.pace.position[alone], self.pace.speed[alone] = head[alone, POSITION], head[alone, SPEED]
        self.pace.acceleration[alone] = 0.0
        return changed

    def _fits(self, trains: Ints, view: View, own: Floats) -> Bools:
        """Whether spacing and speeds of these trains (k,) and those ahead of them are right for coupling."""
        p, d, speed = self.p, self.driving, own[self.p.heads, SPEED]
        inside = (p.bounds.speed_lower < speed) & (speed < p.bounds.speed_upper)
        ahead, spacing = view.ahead.train[trains], view.ahead.spacing[trains]
        closing = speed[ahead] - speed[trains]
        predicted = spacing + closing * (p.scenario.run.control_period_s or self.step)
        fits: Bools = (
            inside[trains]
            & inside[ahead]
            & (np.abs(spacing - self.spacing.desired) <= d.join_band_m)
            & (self.spacing.lower <= np.minimum(spacing, predicted))
            & (np.maximum(spacing, predicted) <= self.spacing.upper)
            & (np.abs(closing) <= d.join_band_mps)
        )
        return fits

    def _try(self, i: int, j: int, spacing: float, t: float, own: Floats) -> list[str]:
        """Couple ``i`` to ``j`` if the law's start condition holds for the longer formation; returns what it objects to."""
        p, front = self.p, convoys.fronts(self.ahead)
        behind, before = np.flatnonzero(front == front[i]), np.flatnonzero(front == front[j])
        heads = p.heads
        shift = own[heads[j], POSITION] - spacing - own[heads[i], POSITION]
        moved = own.copy()
        units = np.repeat(np.isin(np.arange(self.n), behind), np.diff(p.consists.first))
        moved[units, POSITION] += shift
        ahead = self.ahead.copy()
        ahead[i] = j
        order = convoys.front_to_rear(ahead)
        slot = convoys.slots(ahead, order, self.spacing.desired, self.slot)
        lead = int(front[j])
        scene = p.scene(moved, convoys.links(ahead, order, slot, self.spacing), t)._replace(
            reference=Reference(np.array([t, np.inf]), np.array([[self.pace.position[lead], self.pace.speed[lead], 0.0]]))
        )
        members = np.sort(np.concatenate([before, behind]))
        reasons: list[str] = p.law.violations(p.params, restrict(scene, members))
        if not reasons:
            self.ahead, self.slot = ahead, slot
            self.offset[behind] += shift
            own[units, POSITION] += shift
            for part in self.pace:
                part[behind] = part[lead]
        return reasons

    def _part(self, i: int, t: float, why: str, journal: Journal) -> None:
        ids = self.p.scenario.ids
        journal.event(t, "uncouple", train=ids[i], ahead=ids[int(self.ahead[i])], reason=why)
        self.parted[i], self.ask_at[i] = self.ahead[i], t + APART_S
        self.ahead[i] = -1

    def _too_slow(self) -> Ints:
        """Coupled trains of formations whose reference nears the least speed the law can hold."""
        slow = self.pace.speed < self.least + DISSOLVES * self.cruise
        return np.flatnonzero((self.ahead >= 0) & slow[convoys.fronts(self.ahead)])

    def _slows_soon(self, own: Floats, view: View) -> Bools:
        """Trains that must soon run slower than a formation can, or whose train ahead must."""
        speed, lowest = own[self.p.heads, SPEED], np.full(self.n, np.inf)
        lines = view.limits
        close = lines.distance < SOON_S * np.maximum(speed, 1.0)[lines.train]
        np.minimum.at(lowest, lines.train[close], self._below(lines.speed[close]))
        slows = lowest < self.least + 3.0 * DISSOLVES * self.cruise
        found: Bools = slows | slows[convoys.fronts(self.ahead)][view.ahead.train]
        return found

    def _below(self, limit: Floats) -> Floats:
        """Speed the driver keeps where the limit is ``limit`` [m/s]."""
        below: Floats = np.maximum(limit - self.driving.below_limit_mps, 0.2 * limit)
        return below

    def links(self) -> Links:
        """Who hears whom."""
        order = convoys.front_to_rear(self.ahead)
        self.slot = convoys.slots(self.ahead, order, self.spacing.desired, self.slot)
        return convoys.links(self.ahead, order, self.slot, self.spacing)

    # Driving

    def drive(self, seen: Seen, speed: Floats, acceleration: Floats, view: View, stops: tuple[Ints, Floats]) -> Floats:
        """Set the pace of formations and return the accelerations of trains that are driven [m/s2], NaN where the law drives."""
        led, front = self.led, convoys.fronts(self.ahead)
        first = front == np.arange(self.n)
        v = np.maximum(np.where(led, self.pace.speed, speed), 0.0)
        limits = view.limits._replace(speed=self._below(view.limits.speed))
        relied = self.assumed, acceleration
        by_limits = supervisor.verdict(self.rules, v, supervisor.no_targets(), limits, self.step, self.theta, *relied).greatest
        targets = lookout.with_targets(lookout.of(view.targets, first[view.targets.train]), *stops, STOP)
        clear = lookout.with_targets(lookout.of(view.clear, first[view.clear.train]), *stops, STOP)
        free = lookout.judge(self.rules, v, targets, clear, supervisor.no_limits(), self.step, self.theta, *relied).greatest
        lowest = np.full(self.n, np.inf)
        np.minimum.at(lowest, front, np.minimum(by_limits, np.where(first, free, np.inf)))
        wish = (self._wish(seen, v, view) - v) / self.step
        rate = np.minimum(np.maximum(wish, -self.driving.deceleration_mps2), lowest)
        rate = np.maximum(np.minimum(rate, self.driving.acceleration_mps2), -v / self.step)[front]
        rate = np.where(self.standing, 0.0, rate)
        self.halted = ~led & (np.abs(speed) < HELD_MPS) & (rate <= 0.0)
        self.pace.acceleration[:] = np.where(led, rate, 0.0)
        return np.where(led, np.nan, rate)

    def _wish(self, seen: Seen, v: Floats, view: View) -> Floats:
        """Speed every first train would like to have: the cruising speed, or one that brings it to its place behind a formation."""
        other, wish = view.ahead.train, self.cruise.copy()
        near = np.flatnonzero(
            (other >= 0) & self.roster.cooperates & self.roster.cooperates[other] & ~self.stopping & ~self.stopping[other]
            & (v[other] > CRAWLS * self.cruise[other]) & (view.ahead.spacing <= self.driving.join_range_m) & (self.ahead != other)
        )  # fmt: skip
        j = other[near]
        error = view.ahead.spacing[near] - self.spacing.desired
        behind = np.full(self.n, np.inf)  # how much farther apart than wanted the next one runs that wants to join
        np.minimum.at(behind, convoys.fronts(self.ahead)[j], np.where(error > 0.0, error, np.inf))
        yields, cruise = behind[near] < error, self.cruise[near]
        most = np.minimum(cruise + np.where(yields, HASTE, 1.0) * self.driving.catch_up_mps, self.roster.top_speed[near])
        most = np.minimum(most, cruise + np.maximum(ROOM_FOR_HASTE * (self.p.bounds.speed_upper[near] - cruise), 0.0))
        most = np.where(yields | self.led[near], np.minimum(most, self.greatest), most)
        wish[near] = np.clip(v[j] + convoys.closing_speed(error), 0.0, most)
        return wish

    def advance(self) -> None:
        """Let the references of all formations go on by a step."""
        v, a = self.pace.speed, self.pace.acceleration
        after = v + a * self.step
        self.pace.position[:] += ((1.0 - self.theta) * v + self.theta * after) * self.step
        self.pace.speed[:] = after

    def leader(self) -> Floats:
        """Position, speed, acceleration and jerk of every train's own reference, shape (4, n)."""
        return np.stack([*self.pace, np.zeros(self.n)])


def _why(i: int, j: int, present: Bools, next_ahead: Ints) -> str:
    """Why ``i`` must uncouple from ``j``."""
    if not present[j]:
        return "the train ahead has left"
    if next_ahead[i] < 0:
        return "the train ahead has gone another way"
    return "one of the two stops or waits" if next_ahead[i] == j else "another train is ahead now"


#: How exactly the band is found [m/s].
BAND_MPS = 0.05


def _band(p: Prepared, spacing: convoys.Spacing) -> tuple[float, float]:
    """Least and greatest speed of a reference with which the law takes one train of each kind as a formation [m/s]."""
    cruise = float(p.scenario.reference.speed_mps or 0.0)
    kinds = np.unique([t.type for t in p.scenario.train], return_index=True)[1]
    others = np.setdiff1d(np.arange(len(p.scenario.train)), kinds)
    members = np.sort(np.concatenate([kinds, others[: max(2 - len(kinds), 0)]]))
    ahead: Ints = np.full(len(p.scenario.train), -1)
    ahead[members[1:]] = members[:-1]
    order = convoys.front_to_rear(ahead)
    slot = convoys.slots(ahead, order, spacing.desired, np.zeros(len(ahead)))
    links = convoys.links(ahead, order, slot, spacing)
    units, own = np.diff(p.consists.first), p.own.copy()
    own[:, POSITION] += np.repeat(slot - own[p.heads, POSITION], units)

    def takes(v: float) -> bool:
        own[:, SPEED] = v
        scene = p.scene(own, links, 0.0)._replace(reference=Reference(np.array([0.0, np.inf]), np.array([[0.0, v, 0.0]])))
        return not p.law.violations(p.params, restrict(scene, members))

    def end(good: float, bad: float) -> float:
        if takes(bad):
            return bad
        while abs(good - bad) > BAND_MPS:
            middle = 0.5 * (good + bad)
            good, bad = (middle, bad) if takes(middle) else (good, middle)
        return good

    top = cruise + (p.driving).catch_up_mps
    return end(cruise, 0.0), end(cruise, top)
