"""Who comes, stops and leaves; whose turn it is at switches and on single track; what is ahead of every train."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from trainctl.monitors import waiting
from trainctl.railway import along, aspects, authority, interlocking, signs, supervisor, zones
from trainctl.railway.authority import DRIVER_MARGIN_M, View
from trainctl.railway.interlocking import EndOfAuthority
from trainctl.railway.ways import Ways, moved, unchanged
from trainctl.record.columns import Call
from trainctl.scenario import mixed
from trainctl.scenario.model import Model
from trainctl.scenario.roster import Stop
from trainctl.signals import Bools, Floats, Ints, Seen
from trainctl.stages import calls
from trainctl.stages.calls import STANDS_MPS, STOP_BAND_M
from trainctl.stages.places import Room, meets
from trainctl.stages.record import Journal
from trainctl.stages.turns import Turn, Turns, stopping

#: A train that passes a place just before it turns has done so this far before where it may turn last [m].
PASSED_M = 0.5

#: A train enters if it can do so with this share of its speed.
ENTERS_WITH = 0.8

#: Farther than anything here [m].
FAR_M = 1e9

#: Who has been kept out by running trains for so long is let in by those that can still stop before its place [s].
PATIENCE_S = 60.0

#: Trains that must slow down, stop or wait within this time do not couple before [s].
SOON_S = 60.0


class State(NamedTuple):
    """What the traffic has come to, shape (n,)."""

    came: Bools
    entering: Bools  # they come with the step to this instant, reported when they are there
    left: Bools
    next_stop: Ints  # number of it in the roster
    stands_since: Floats  # s, while a train is at a stop, else NaN
    stands_until: Floats  # s, the same
    late: Floats  # s, by how much a train was late where that was known last, NaN: not yet
    stopping: Bools  # for its next stop
    parked: Bools  # off the track, at a stop
    waits_for: Ints  # train that each is held by at a switch, -1 if none
    kept_out: Ints  # train that keeps each from entering, -1 if none
    leg: Ints  # how often each has turned
    turns_since: Floats  # s, while a train is stopped to turn, else NaN
    kept_back: Ints  # train that keeps each from turning, -1 if none
    requests: interlocking.State

    @property
    def standing(self) -> Bools:
        """Trains that stand at a stop, or to turn."""
        stands: Bools = ~(np.isnan(self.stands_until) & np.isnan(self.turns_since))
        return stands

    def outside(self, seen: Seen) -> Bools:
        """Trains that have yet to come: also those that were to be there by now, and that signals kept out."""
        yet: Bools = ~self.came | self.entering & ~seen.present
        return yet

    def on_track(self, seen: Seen) -> Seen:
        """Trains as they are to each other: who is parked is not there."""
        return seen._replace(present=seen.present & ~self.parked) if self.parked.any() else seen


class Around(NamedTuple):
    """What this instant's traffic means to the trains."""

    entries: tuple[tuple[int, float], ...]  # trains that come with the coming step, with their speeds [m/s]
    stops: tuple[Ints, Floats]  # trains with a stop ahead, and the room to it [m]
    soon: Bools  # (n,) they stop soon
    ends: EndOfAuthority | None  # how far each may go before a place that another has; None: not needed
    kept_out: dict[int, int]  # trains that are due and cannot enter: because of whom
    view: View | None  # None: not needed
    turns: tuple[Turn, ...] = ()  # trains that turn with the coming step


def nothing(trains: int) -> Around:
    """No train comes, stops, waits or looks ahead."""
    return Around((), (np.zeros(0, np.int64), np.zeros(0)), np.zeros(trains, bool), None, {}, None)


def _late(delay: float) -> dict[str, float]:
    """What an event says of a ``delay`` [s]; nothing where nothing was planned."""
    return {} if np.isnan(delay) else {"delay_s": round(delay, 9)}


class Traffic:
    """The traffic of a run."""

    def __init__(self, p: Model, journal: Journal) -> None:
        self.p, self.journal, self.roster = p, journal, p.roster
        self.rules, self.assumed = p.driver_rules, p.relied_on_by_driver
        self.step_s, self.theta = p.scenario.run.step_s, p.step_theta
        self.room = Room(p)
        self.net, self.length = along.net(p.rails), p.consists.train_length()
        self.looks, self.join_range_m = p.looks_ahead, p.driving.join_range_m if p.driven else 0.0
        planned = np.minimum(p.supervision.service_mps2, p.driver_braking if p.driven else p.supervision.emergency_mps2)
        self.requesting = np.minimum(p.assumed.braking, planned)  # what is requested for, and braked with at least
        number = {name: i for i, name in enumerate(p.scenario.ids)}
        self.pairs = [  # edge, who passes it first, and who comes next
            (p.rails.index[order.edge], number[a], number[b]) for order in p.scenario.order for a, b in pairwise(order.trains)
        ]
        self.yields = mixed.yielding(p.roster.handed, p.roster.edge)
        self.settles = float(np.max(supervisor.settles(p.assumed, p.assumed.braking), initial=0.0))
        self.ways: Ways | None = None
        self._limits(0.0)
        self.turns, self.stopping, self.stops = Turns(p, self.net, journal), stopping(p), list(p.roster.stops)
        self.calls = calls.calls(self.stops)

    def initial(self) -> State:
        """Before the run: trains that are placed have come."""
        n = len(self.length)
        return State(
            came=np.full(n, self.roster.placed), entering=np.zeros(n, bool), left=np.zeros(n, bool),
            next_stop=np.zeros(n, np.int64), stands_since=np.full(n, np.nan), stands_until=np.full(n, np.nan),
            late=np.full(n, np.nan), stopping=np.zeros(n, bool), parked=np.zeros(n, bool),
            waits_for=np.full(n, -1), kept_out=np.full(n, -1), leg=np.zeros(n, np.int64), turns_since=np.full(n, np.nan),
            kept_back=np.full(n, -1), requests=interlocking.none(),
        )  # fmt: skip

    def step(
        self, t: float, ways: Ways, seen: Seen, speed: Floats, overrun: Floats, s: State, last: bool = False,
        red: EndOfAuthority | None = None, stopped: Bools | None = None,
    ) -> tuple[State, Around]:  # fmt: skip
        """Arrivals, stops, entries; ``overrun`` (n,) is how much farther trains run than their brakes promise [m].

        Who is due at the end of the coming step is let in now, and is there then: in time. ``speed`` (n,) gets the speeds of trains
        that enter; at the ``last`` instant of a run none does. ``red`` is how far signals let each train go, where they decide;
        ``stopped`` (n,) which of the simulator's own trains are at a stop.
        """
        s = self.departures(t, seen, speed, self.arrivals(t, seen, s))
        if not self.looks:
            return s, nothing(len(speed))
        self._limits(t)
        self._take_over(ways, s)
        stood = s.standing & seen.present
        for i in [] if s.came.all() else np.flatnonzero(~s.came & self._given_up(t) & ~self._given_up(t - self.step_s)).tolist():
            self.journal.event(t, "given_up", train=self.p.scenario.ids[i], planned_s=float(self.roster.depart[i]))
        s, stops, soon = self._stops(t, seen, speed, stopped, overrun, s)
        if last:
            self._uncalled(s)
        later = t + self.step_s
        parked = s.parked & ~self.roster.driven & (s.stands_until <= later + 1e-9)  # who come back
        asking, reach = [] if last else [*np.flatnonzero(parked).tolist(), *self.due(later, s)], self._reach(speed)
        s, ends, entries, kept_out = self.entering(t, ways, s.on_track(seen), speed, s, asking, reach, red, self.step_s)
        present = s.on_track(seen).present.copy()
        present[[i for i, _ in entries]] = True
        reach = self._reach(speed) if entries else reach
        view = self.turns.ends(self._look(ways, seen._replace(present=present), speed, ends, s, reach), seen, overrun)
        ordered = None if self.p.obeys else lambda there, rows: self._ordered(t, there, seen._replace(row=rows), s)
        asks, known = np.flatnonzero(stood & ~np.isnan(s.turns_since) & (not last)).tolist(), (s.leg, s.turns_since, s.kept_back)
        requests, now, turns = self.turns.step(t, asks, ways, s.on_track(seen), reach, s.standing, s.requests, known, ordered)
        s = s._replace(requests=requests, leg=now[0], turns_since=now[1], kept_back=now[2])
        return s, Around(entries, stops, soon, ends, kept_out, view, turns)

    def _take_over(self, ways: Ways, s: State) -> None:
        """Work out what follows from the ways trains have now, where they changed: zones, and the places of stops and turns."""
        if self.ways is ways:
            return
        self.ways, self.zones = ways, zones.of(ways, self.net, self.turns.later)
        if self.turns.any:
            self.turns.changed(ways, s.leg)
        if self.calls.number.any():
            begun = self.turns.begun(s.leg)
            self.stops = list(self.roster.stops)
            for i in np.flatnonzero(~unchanged(begun, ways)).tolist():
                self.stops[i] = tuple(
                    one._replace(place=moved(begun, ways, i, one.place)) if one.leg == s.leg[i] else one
                    for one in self.roster.stops[i]
                )
            self.calls = calls.calls(self.stops)

    # Arrivals and entries

    def arrivals(self, t: float, seen: Seen, s: State) -> State:
        """Trains that have left at the end of their ways."""
        gone = s.came & ~seen.present & ~s.left & ~s.entering
        if not gone.any():
            return s
        for i in np.flatnonzero(gone).tolist():
            self.journal.event(t, "arrive", train=self.p.scenario.ids[i], **_late(float(s.late[i])))
        return s._replace(left=s.left | gone)

    def departures(self, t: float, seen: Seen, speed: Floats, s: State) -> State:
        """Trains that are there for the first time, and those that signals kept out: they are to ask again."""
        there = seen.present & (s.entering | (self.roster.driven & ~s.came))
        if not (there | s.entering).any():
            return s
        for i in np.flatnonzero(there).tolist():
            planned = float(self.roster.depart[i])
            self.journal.event(
                t, "depart", train=self.p.scenario.ids[i], planned_s=planned, delay_s=t - planned, speed_mps=float(speed[i])
            )  # fmt: skip
        return s._replace(came=(s.came | there) & ~(s.entering & ~there), entering=np.zeros_like(s.entering))

    def due(self, t: float, s: State) -> list[int]:
        """Trains that are to come at ``t``: of each edge the first that waits there, and the next if SUMO lets that go first."""
        if s.came.all():
            return []
        found, taken = list[int](), set[int]()
        for i in np.flatnonzero(~s.came & ~self.roster.driven & (self.roster.depart <= t + 1e-9) & ~self._given_up(t)).tolist():
            if (edge := int(self.roster.edge[i])) not in taken:
                found.append(i)
                taken |= set() if i in self.yields else {edge}
        return sorted(found, key=lambda i: (self.roster.depart[i], i))

    def _given_up(self, t: float) -> Bools:
        """Trains that would not come any more if they had not yet."""
        return np.asarray(t > self.roster.depart + self.roster.patience + 1e-9)

    def missing(self, t: float, s: State) -> list[str]:
        """Trains that were due and never came."""
        return [self.p.scenario.ids[i] for i in np.flatnonzero(~s.came & (self.roster.depart <= t + 1e-9)).tolist()]

    def entering(
        self, t: float, ways: Ways, here: Seen, speed: Floats, s: State, due: Sequence[int], reach: Floats | None = None,
        red: EndOfAuthority | None = None, after: float = 0.0,
    ) -> tuple[State, EndOfAuthority, tuple[tuple[int, float], ...], dict[int, int]]:  # fmt: skip
        """Trains of those that are ``due`` whose place is clear, with the speed they come with [m/s]; who keeps out the others.

        They are there ``after`` so many seconds.
        """
        self._take_over(ways, s)
        asking = np.zeros(len(speed), bool)
        asking[due] = True
        stands = (s.kept_out >= 0) & (np.abs(speed[s.kept_out]) < STANDS_MPS)  # one at a standstill may wait for it in turn
        if red is not None:
            s, ends = s._replace(waits_for=red.by.copy()), red
        else:
            before, reach = s.waits_for, self._reach(speed) if reach is None else reach
            s, ends = self._request(t, ways, here, reach, asking, asking & ~stands, s)
            self._let_in(t, ways, here, speed, due, np.where(np.isin(before, due), 0.0, reach), ends, s)
        s = s._replace(parked=s.parked.copy())
        present, came, entering, reach = here.present.copy(), s.came.copy(), s.entering.copy(), self._reach(speed)
        come: list[tuple[int, float]] = []
        kept_out: dict[int, int] = {}
        asking[[i for i in due if ends.room[i] <= 0.0]] = False
        together: View | None = None  # with all who ask at their places
        for i in due:
            if ends.room[i] <= 0.0:
                continue
            if together is None:
                guests = asking.copy()
                together = self._look(ways, here._replace(present=present | guests), speed, ends, s, reach)
            present[i], asking[i], view = True, False, together
            if meets(together, i, guests):  # to each of them only those are there that have come
                view = self._look(ways, here._replace(present=present), speed, ends, s, reach)
            if s.parked[i]:
                present[i] = self.room.returns(i, speed, view)
                s.parked[i] = not present[i]  # and remains for one more step, the one in which it comes back
                together = None if present[i] else together
                continue
            v = self._entering_speed(i, ways, here, speed, view, ends, s, after)
            present[i] = v is not None
            if v is None:
                kept_out[i] = waiting.kept_out(view, i)
                continue
            # Who may not come yet obstructs no other.
            present[i], came[i], entering[i], speed[i], together = i not in self.yields, True, True, v, None
            reach = self._reach(speed)
            come.append((i, v))
        keeping = np.full(len(speed), -1)
        keeping[list(kept_out)] = list(kept_out.values())
        return s._replace(came=came, entering=entering, kept_out=keeping), ends, tuple(come), kept_out

    def _let_in(
        self, t: float, ways: Ways, here: Seen, speed: Floats, due: Sequence[int], can: Floats, ends: EndOfAuthority, s: State
    ) -> None:
        """Stop those that ``can`` (n,) [m] before the place of a train that running ones have kept out for long."""
        for i in due:
            edge, place = int(self.roster.edge[i]), float(self.roster.lane_position[i] - self.length[i]) - self.rules.margin_m
            by = int(ends.by[i] if ends.room[i] <= 0.0 else s.kept_out[i])
            passes = by < 0 or (speed[by] >= STANDS_MPS and here.edge[by] == edge)
            if t - self.roster.depart[i] < PATIENCE_S or s.parked[i] or not passes:
                continue
            for j, room in zip(*authority.stop_before(ways, here.row, here.position, edge, place, can), strict=True):
                if here.present[j] and room < ends.room[j]:
                    ends.room[j], ends.zone[j], ends.by[j], s.waits_for[j] = room, edge, i, i

    def _entering_speed(
        self, i: int, ways: Ways, here: Seen, speed: Floats, view: View, ends: EndOfAuthority, s: State, after: float
    ) -> float | None:
        """Speed with which a train can enter safely; None if it has to wait. ``view`` is that with the train at its place."""
        rules, v, roster = self.rules, self.roster.speed[i], self.roster
        limit = float(roster.speed_factor[i] * self.limit[roster.edge[i]])
        on_edge = limit - self.p.driving.below_limit_mps
        wanted = float(min(self.p.cruise[i], max(on_edge, 0.0)) if np.isnan(v) else min(v, limit))
        there = np.flatnonzero(here.present & (here.edge == roster.edge[i]) & (np.arange(len(speed)) != i))
        if roster.like[i] and np.isnan(v) and len(there):
            depth = here.position[there] - ways.begin[here.row[there]]
            wanted = min(wanted, float(speed[there].mean() if roster.like[i] == "avg" else speed[there[np.argmin(depth)]]))
        rooms = [float(ends.room[i])]  # up to where it must be able to stop
        if (stop := self.stop_of(i, s)) is not None:
            place = stop.place - float(self.p.rails.start_m[roster.edge[i]]) - float(roster.lane_position[i])
            rooms.append(place + self._further(stop, i))
        if np.isfinite(last := self.turns.last_place(i)):
            rooms.append(last - float(self.p.rails.start_m[roster.edge[i]] + roster.lane_position[i]))
        for room in rooms if self.p.obeys else rooms[1:]:
            planned = float(min(rules.service_mps2, self.assumed.braking[i]))
            left = np.array([min(room, FAR_M) - wanted * self.step_s])
            wanted = min(wanted, float(supervisor.greatest_speed(left, planned, self.step_s, self.theta)[0]))
        own, fast = view.limits.train == i, np.full(len(speed), wanted)
        braking = np.minimum(rules.service_mps2, self.assumed.braking)
        limits = supervisor.Limits(*(column[own] for column in view.limits))
        kept = supervisor.speed_for_limits(self.assumed, fast, limits, braking, self.step_s, self.theta)
        wanted = float(min(wanted, *kept.tolist(), np.inf))
        ahead = authority.of(view.targets, (view.targets.train == i) & (view.targets.kind != supervisor.SIGNAL))
        stands = np.where(np.arange(len(speed)) == i, 0.0, speed)
        _, safe = supervisor.too_late(rules, self.assumed, stands, ahead, self.step_s, self.theta)
        entry = float(min(wanted, *safe.tolist(), np.inf))
        if np.any(ahead.room < rules.margin_m) or entry < (wanted - 1e-9 if not np.isnan(v) else ENTERS_WITH * wanted):
            return None
        other = int(view.ahead.train[i])
        if other >= 0 and roster.cooperates[[i, other]].all() and view.ahead.spacing[i] < self.p.spacing.desired - 1.0:
            return None
        if view.fouling[i] or self.room.under(i, speed, view, after):
            return None
        return None if self.room.startles(i, entry, speed, view) else entry

    # Stops

    def stop_of(self, i: int, s: State) -> Stop | None:
        """The next stop of a train before it turns or leaves."""
        stops, k = self.stops[i], int(s.next_stop[i])
        return stops[k] if k < len(stops) and stops[k].leg <= s.leg[i] else None

    def _full(self, stop: Stop, s: State) -> bool:
        """Whether a train that is to park at a stop finds no place."""
        if not stop.parks or np.isinf(stop.lots):
            return False
        there = (self.stop_of(j, s) for j in np.flatnonzero(s.parked).tolist())
        return sum(other is not None and other.name == stop.name for other in there) >= stop.lots

    def _place(self, stop: Stop, i: int, s: State) -> float:
        """Where train ``i`` has to stand now for a stop, or to have passed [m]: no farther than it may to turn afterwards."""
        last = self.turns.last_place(i) - (PASSED_M if stop.passing else 0.0)
        return min(stop.place, last) - (stop.waits_before if self._full(stop, s) else 0.0)

    def _further(self, stop: Stop, i: int) -> float:
        """How far beyond a stop a train comes to a standstill that passes it as fast as it may [m]; 0 if it is to stop there."""
        return float(self.stopping(np.array([i]), np.array([stop.passing]))[0]) if stop.passing else 0.0

    def _stops(
        self, t: float, seen: Seen, speed: Floats, stopped: Bools | None, overrun: Floats, s: State
    ) -> tuple[State, tuple[Ints, Floats], Bools]:  # fmt: skip
        """Arrive at and leave stops; the trains that have one ahead and the room to it [m], and who stops soon."""
        trains, rooms, n, ids = list[int](), list[float](), len(speed), self.p.scenario.ids
        if not (self.calls.number.any() or self.turns.any):
            return s, nothing(n).stops, np.zeros(n, bool)
        standing, stands = ~np.isnan(s.stands_until), calls.stand(speed, self.roster.driven, stopped)
        s = s._replace(
            next_stop=s.next_stop.copy(), stands_since=s.stands_since.copy(), stands_until=s.stands_until.copy(),
            late=s.late.copy(), stopping=s.stopping.copy(), parked=s.parked.copy(),
        )  # fmt: skip
        asked = np.flatnonzero(seen.present & (s.next_stop < self.calls.number))
        plain, ahead = calls.on_the_way(self.calls, asked, s.next_stop, s.leg, seen.position, stands, standing)
        plain &= ~np.isin(asked, list(self.turns.yards))  # who is to turn may have to stand before its stop
        for i in asked[~plain].tolist():
            stop = self.stop_of(i, s)
            while stop is not None and np.isnan(stop.place):
                self.journal.event(t, "stop_dropped", train=ids[i], stop=stop.name)
                s.next_stop[i] += 1
                stop = self.stop_of(i, s)
            if stop is None:
                s.stopping[i] = False
                continue
            room = self._place(stop, i, s) - float(seen.position[i])
            if standing[i]:
                stays = t < s.stands_until[i] - 1e-9 or s.parked[i]
                if stands[i] if self.roster.driven[i] else stays:  # SUMO ends the stops of its own trains
                    continue
                s.parked[i] = False
                late = self._called(i, stop, float(s.stands_since[i]), t, int(seen.edge[i]), s)
                self.journal.event(t, "stop_left", train=ids[i], stop=stop.name, **_late(late))
                s.stands_since[i] = s.stands_until[i] = np.nan
                stop = self.stop_of(i, s)
                if stop is None:
                    s.stopping[i] = False
                    continue
                room = self._place(stop, i, s) - float(seen.position[i])
            while stop is not None and stop.passing and room <= 0.0:
                late = self._called(i, stop, t, t, int(seen.edge[i]), s)
                self.journal.event(t, "waypoint", train=ids[i], stop=stop.name, speed_mps=float(speed[i]), **_late(late))
                stop = self.stop_of(i, s)
                room = self._place(stop, i, s) - float(seen.position[i]) if stop is not None else np.inf
            if stop is None:
                s.stopping[i] = False
                continue
            if not stop.passing and stands[i] and room < STOP_BAND_M and not self._full(stop, s):
                s.stands_since[i], s.stands_until[i] = t, max(t + stop.duration, stop.until)
                more = _late(t - stop.planned) | ({"parked": True} if stop.parks else {})
                short = stop.place - float(seen.position[i])
                self.journal.event(t, "stop_reached", train=ids[i], stop=stop.name, short_m=short, **more)
                s.parked[i] = stop.parks
                continue
            beyond = self.turns.last_place(i) - float(seen.position[i]) - float(overrun[i])
            trains.append(i)
            rooms.append(min(max(room - float(overrun[i]), 0.0) + self._further(stop, i), max(beyond, 0.0)))
        trains, rooms = calls.merged(trains, rooms, asked[plain], np.maximum(ahead[plain] - overrun[asked[plain]], 0.0))
        if self.turns.yards:
            free = np.array([self.stop_of(i, s) is None for i in range(n)])
            stand, further = self.turns.wanted(seen, speed, free, ~np.isnan(s.turns_since), self.stopping, STANDS_MPS)
            s = s._replace(turns_since=s.turns_since.copy())
            s.turns_since[[i for i in stand if np.isnan(s.turns_since[i])]] = t
            trains += [i for i, _ in further]
            rooms += [max(room - float(overrun[i]), 0.0) for i, room in further]
        found, room_to = np.array(trains, np.int64), np.array(rooms)
        braking = self.stopping(found, speed[found])
        near, soon = np.zeros(n, bool), np.zeros(n, bool)
        near[found] = room_to < braking + 10.0 * self.step_s * speed[found] + 50.0
        soon[found] = room_to < braking + SOON_S * speed[found]
        stopping = (s.stopping & seen.present | near) & (near | s.standing)
        return s._replace(stopping=stopping), (found, room_to), soon | near

    def _called(self, i: int, stop: Stop, arrival: float, departure: float, edge: int, s: State) -> float:
        """Record a stop that is done with, and turn to the next; how late the train is [s], NaN: nothing was planned."""
        self.journal.call(i, Call(stop, int(s.next_stop[i]) + 1, arrival, departure), edge)
        s.next_stop[i] += 1
        late = stop.late(arrival, departure)
        s.late[i] = s.late[i] if np.isnan(late) else late
        return late

    def _uncalled(self, s: State) -> None:
        """Record the stops that trains have not left when the run ends."""
        for i, stops in enumerate(self.roster.stops):
            for k in range(int(s.next_stop[i]), len(stops)):
                here = float(s.stands_since[i]) if k == s.next_stop[i] else np.nan
                self.journal.call(i, Call(stops[k], k + 1, here, np.nan), self.p.rails.index[stops[k].edge])

    # Turns, and what is ahead

    def _limits(self, t: float) -> None:
        """Limit of every edge (E,) [m/s] that is to be kept over the coming step."""
        # A limit that falls while a train comes near asks for more than either alone: half the braking is kept for the way there.
        rate = 0.5 * float(np.min(self.requesting, initial=np.inf))
        shown, base = self.p.signs, self.p.rails.speed_mps
        self.limit = signs.announced(shown, base, t, self.step_s, rate, self.settles)
        self.falls = signs.falling(shown, base, t, self.step_s, self.limit)

    def _reach(self, speed: Floats) -> Floats:
        """How far ahead every train requests [m]: farther than it would brake for what it must not enter."""
        assumed, rules = self.p.assumed, self.p.supervision
        v = np.maximum(speed, 0.0) + assumed.drift + 2.0 * assumed.lag * rules.emergency_mps2
        braking = supervisor.stopping_distance(v, self.requesting, self.step_s, self.theta)
        return braking + 4.0 * v * self.step_s + rules.margin_m + 2.0 * DRIVER_MARGIN_M + 50.0 + 6.0 * assumed.uncertainty

    def _ordered(self, t: float, ways: Ways, seen: Seen, s: State) -> list[zones.Ordered]:
        """Trains that must let another one pass an edge first, see ``zones.passes_first``."""
        return zones.passes_first(self.pairs, self.net, ways, seen.row, s.came, s.left | ~s.came & self._given_up(t))

    def _request(
        self, t: float, ways: Ways, seen: Seen, reach: Floats, entering: Bools, keeps: Bools, s: State
    ) -> tuple[State, EndOfAuthority]:
        """Let every train request what lies within its reach; ``entering`` (n,) are those that ask to enter the net."""
        stops = calls.own_stops(self.calls, s.came & ~s.left, s.next_stop, s.leg)
        requests, ends, said = interlocking.request(
            self.zones, s.requests, seen.row, seen.position, self.length, seen.present, reach,
            self.p.supervision.margin_m + DRIVER_MARGIN_M, entering, stops, s.standing,
            self._ordered(t, ways, seen, s), keeps, self.turns.back(s.leg),
        )  # fmt: skip
        ids, edges = self.p.scenario.ids, self.p.rails.edges
        for one in said:
            if one.by >= 0:
                self.journal.event(
                    t, "conflict", train=ids[one.train], first=ids[one.by], edge=edges[one.zone],
                    place="join" if one.join else "single_track",
                )  # fmt: skip
            elif one.granted and not one.join and s.waits_for[one.train] >= 0:
                self.journal.event(t, "switch_granted", train=ids[one.train], edge=edges[one.zone])
        everyone, inside = np.arange(len(ends.room)), self.p.rails.internal
        room = zones.short_of_junctions(ways, self.net, inside, everyone, seen.row, seen.position, ends.room)
        return s._replace(requests=requests, waits_for=ends.by.copy()), ends._replace(room=room)

    def _look(self, ways: Ways, seen: Seen, speed: Floats, ends: EndOfAuthority, s: State, reach: Floats) -> View:
        """What is ahead of every train."""
        sees = 2.0 if self.falls.any() else 1.0  # half the braking, twice the way
        horizon = max(sees * float(np.max(reach, where=seen.present, initial=0.0)) + 1000.0, self.join_range_m)
        if self.p.obeys:
            order = aspects.order(ways, self.net.joins, seen.row, seen.position, seen.present, horizon, ends.room)
        else:
            order = interlocking.order(s.requests)
        # Trains that SUMO drives may stop as they like: whoever follows one keeps his whole braking distance.
        return authority.look(
            ways, self.net, self.limit, self.falls, self.roster.speed_factor, seen.row, seen.position,
            np.where(self.roster.driven, 0.0, speed), self.length, seen.present, horizon, ends.room, order,
            self.p.rails.internal, supervisor.SIGNAL if self.p.obeys else supervisor.SWITCH, s.parked,
        )  # fmt: skip
