"""Reroutes and braking: orders that wait for their time, place or condition, and the way found over the rails.

A switch is locked for a train that could not stop before it any more, so an order that comes later takes the next one. What cannot
be done is refused, with the reason, as an event; the train goes on as it was. Only where the trains are not supervised, an order of
the scenario that leads nowhere (its switch lies behind the train) is a mistake of its file and ends the run.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from sumo_net.line import LineCrossover
from trainctl.errors import InputError
from trainctl.railway.ways import Ways
from trainctl.scenario import mixed, promise
from trainctl.scenario.events import Event
from trainctl.scenario.model import Model
from trainctl.signals import Floats, Ints, Seen
from trainctl.stages.record import Journal


class Refused(Exception):
    """An order that cannot be followed, in words."""


class LeadsNowhere(Refused):
    """There is no such way from where the train is, braking distance or not."""


class State(NamedTuple):
    """Orders that are still to come."""

    pending: tuple[int, ...]  # their numbers
    given: list[dict[str, Any]]  # all that came from outside, as tables; their numbers follow those of the scenario
    acting: tuple[int, ...] = ()  # orders to brake, and outages, that act


class Orders:
    """Orders of a run. Those of the scenario are numbered from 1 by their tables; more may be added from outside."""

    def __init__(self, p: Model, journal: Journal) -> None:
        self.p, self.journal = p, journal
        self.length = p.consists.train_length()
        self.index = {name: i for i, name in enumerate(p.scenario.ids)}

    def initial(self) -> State:
        """The orders of the scenario, by time."""
        return State(tuple(number for number, _ in sorted(enumerate(self.p.scenario.event, 1), key=lambda e: e[1].time_s)), [])

    def added(self, event: Event, s: State) -> State:
        """One more order, from outside."""
        if event.train not in self.index:
            raise ValueError(f"train {event.train}: no such train; there are: {', '.join(self.p.scenario.ids)}")
        given = [*s.given, event.model_dump(mode="json", exclude_none=True)]
        return s._replace(pending=(*s.pending, len(self.p.scenario.event) + len(given)), given=given)

    def _event(self, number: int, s: State) -> Event:
        own = self.p.scenario.event
        return own[number - 1] if number <= len(own) else Event.model_validate(s.given[number - len(own) - 1])

    def step(
        self, t: float, seen: Seen, ways: Ways, speed: Floats, stops_in: Callable[[], Floats], ahead: Ints, s: State
    ) -> tuple[State, list[tuple[int, tuple[str, ...]]]]:
        """Orders whose time, place or condition has come: trains and their new routes.

        Parameters
        ----------
        t : float
            Now [s].
        seen : Seen
            Where every train is.
        ways : Ways
            Their ways now.
        speed, ahead : ndarray, shape (n,)
            Speed [m/s], and the train ahead in the formation, -1 if none.
        stops_in : callable
            Gives the way in which every train surely stops (n,) [m]; called only where a train is led elsewhere.
        s : State
            Orders to come.

        Returns
        -------
        State
            Orders that are still to come.
        list of (int, tuple of str)
            Train and edges from the one it is on, internal ones included.
        """
        found: list[tuple[int, tuple[str, ...]]] = []
        due = [number for number in s.pending if self._is_due(t, self._event(number, s), seen, speed, ahead)]
        s = self._acting(t, s, [number for number in due if self._event(number, s).kind != "reroute"])
        for number in due:
            event = self._event(number, s)
            if event.kind != "reroute":
                continue
            i = self.index[event.train]
            lock = float(stops_in()[i])
            try:
                if any(i == other for other, _ in found):
                    raise Refused("it has just been given another route")
                if event.to_edge is None:
                    edges, more = self._over_a_crossover(event, i, seen, speed, lock)
                else:
                    edges, more = self._to_an_edge(event, i, seen, ways, lock)
            except Refused as why:
                if isinstance(why, LeadsNowhere) and self.p.scenario.supervisor is None and number <= len(self.p.scenario.event):
                    where = f"train {event.train} is at {seen.position[i]:.3f} m on track {self.p.line.tracks[seen.edge[i]]}"
                    raise InputError(f"{self.p.file}: event[{number}]: {why}; {where} at {t:g} s") from None
                self.journal.event(
                    t, "reroute_refused", train=event.train, order=number, reason=str(why), position_m=float(seen.position[i]),
                    speed_mps=float(speed[i]),
                )  # fmt: skip
                continue
            self.journal.event(t, "reroute", train=event.train, **more)
            found.append((i, edges))
        return s._replace(pending=tuple(number for number in s.pending if number not in due)) if due else s, found

    def _acting(self, t: float, s: State, due: list[int]) -> State:
        """Orders to brake and outages that begin, and those whose time is over."""
        over = [number for number in s.acting if (self._event(number, s).until_s or np.inf) <= t + 1e-9]
        for number in over:
            event = self._event(number, s)
            self.journal.event(t, "brake_released" if event.kind == "brake" else "outage_over", train=event.train)
        for number in due:
            event = self._event(number, s)
            more = {"deceleration_mps2": self._deceleration(event)} if event.kind == "brake" else {}
            self.journal.event(t, event.kind, train=event.train, **more)
        return s._replace(acting=tuple(number for number in (*s.acting, *due) if number not in over)) if over or due else s

    def _deceleration(self, event: Event) -> float:
        return event.deceleration_mps2 or self.p.supervision.emergency_mps2

    def braking(self, speed: Floats, s: State) -> Floats:
        """Acceleration every train is ordered to brake with (n,) [m/s2], NaN where it is not; of several orders the hardest.

        Within a step it comes to a standstill at most: ``speed`` (n,) [m/s] is that of every train now.
        """
        found = np.full(len(speed), np.nan)
        if not s.acting:
            return found
        for number in s.acting:
            event = self._event(number, s)
            if event.kind == "brake":
                i = self.index[event.train]
                found[i] = np.fmin(found[i], -self._deceleration(event))
        ordered: Floats = np.maximum(found, -np.maximum(speed, 0.0) / self.p.scenario.run.step_s)
        return ordered

    def _is_due(self, t: float, event: Event, seen: Seen, speed: Floats, ahead: Ints) -> bool:
        if event.time_s > t + 1e-9:
            return False
        if event.kind == "outage":
            return True
        i = self.index[event.train]
        if not seen.present[i]:
            return False
        if event.position_m is not None and seen.position[i] < event.position_m:
            return False
        if event.speed_below_mps is not None and not speed[i] < event.speed_below_mps:
            return False
        if event.gap_below_m is None:
            return True
        j = int(ahead[i])
        return j >= 0 and bool(seen.position[j] - self.length[j] - seen.position[i] < event.gap_below_m)

    def _over_a_crossover(
        self, event: Event, i: int, seen: Seen, speeds: Floats, lock: float
    ) -> tuple[tuple[str, ...], dict[str, Any]]:
        line = self.p.line
        edge, position = int(seen.edge[i]), float(seen.position[i])
        track = line.tracks[edge]
        if track == event.to_track:
            raise Refused(f"the train is on track {track} already")
        try:
            if event.crossover is not None:
                over = line.crossover[event.crossover]
            else:
                found = line.next_crossover(track, min(position + lock, line.end_m), str(event.to_track))
                if found is None:
                    if line.next_crossover(track, position, str(event.to_track)) is None:
                        raise LeadsNowhere(f"no crossover to track {event.to_track} ahead")
                    raise Refused(
                        f"no crossover from track {track} to track {event.to_track} beyond {position + lock:.1f} m, where the train"
                        " could still stop before it"
                    )
                over = found
            if over.from_track == track and position < over.start_m < position + lock:
                raise Refused(
                    f"switch {over.id} at {over.start_m:.1f} m is locked: {over.start_m - position:.1f} m ahead, braking takes"
                    f" {lock:.1f} m"
                )
            edges = line.route_over(line.edges[edge], over.id)
        except ValueError as error:
            raise LeadsNowhere(str(error)) from None
        if self.p.supervision.mode != "on":
            self._unprotected(i, over, seen, speeds)
        more = {"crossover": over.id, "from_track": over.from_track, "to_track": over.to_track, "switch_m": over.start_m}
        return edges, more

    def _unprotected(self, i: int, over: LineCrossover, seen: Seen, speed: Floats) -> None:
        """What nothing would save the train from while there is no supervisor."""
        cure = '[supervisor] mode = "on" does'
        if over.speed_mps < speed[i]:
            raise Refused(
                f"crossover {over.id} allows {over.speed_mps:g} m/s, the train runs at {speed[i]:g} m/s and nothing would brake it:"
                f" {cure}"
            )
        join = over.start_m + over.length_m
        after = (join - float(seen.position[i])) / max(float(speed[i]), 0.1)
        then, length = (seen.position + speed * after).tolist(), self.length.tolist()
        for j, (edge, there) in enumerate(zip(seen.edge.tolist(), seen.present.tolist(), strict=True)):
            if not there or self.p.line.tracks[edge] != over.to_track:
                continue
            if then[j] - length[j] < join and then[j] > join - length[i]:
                raise Refused(
                    f"train {self.p.scenario.ids[j]} would be at the join of crossover {over.id} at {join:.1f} m at the same time,"
                    f" and nothing would keep them apart: {cure}"
                )

    def _to_an_edge(self, event: Event, i: int, seen: Seen, ways: Ways, lock: float) -> tuple[tuple[str, ...], dict[str, Any]]:
        rails = self.p.rails
        target = rails.index.get(str(event.to_edge), -1)
        if target < 0:
            raise Refused(f"edge {event.to_edge}: not on this net, or not for trains")
        row, end = int(seen.row[i]), int(ways.first[i + 1])
        way, begin = ways.edge[row:end], ways.begin[row:end]
        kept = int(np.searchsorted(begin, seen.position[i] + lock, side="right"))  # what begins beyond may still change
        for k in range(min(kept, len(way)), 0, -1):
            path = rails.path(int(way[k - 1]), target)
            if path is not None:
                break
        else:
            raise Refused(f"edge {event.to_edge} cannot be reached from edge {rails.edges[int(way[0])]}")
        if k < min(kept, len(way)):
            raise Refused(
                f"edge {event.to_edge} can only be reached from edge {rails.edges[int(way[k - 1])]}, which the train cannot leave"
                f" otherwise any more: braking takes {lock:.1f} m"
            )
        onward = rails.path(target, int(way[-1]))
        new = [*way[: k - 1].tolist(), *path.tolist(), *([] if onward is None else onward[1:].tolist())]
        if why := promise.uncovered(self.p, i, new):
            raise Refused(f"the path to edge {event.to_edge} has {why}")
        signals = self.p.roster.signals
        if self.p.obeys and (where := mixed.without_signal(ways, i, row, new, self.p.scenario.ids, rails, signals)):
            raise Refused(f"signals are obeyed, and the path to edge {event.to_edge} has none {where}")
        common = next((n for n, (a, b) in enumerate(zip(new, way.tolist(), strict=False)) if a != b), min(len(new), len(way)))
        more = {"to_edge": event.to_edge, "from_edge": rails.edges[int(way[max(common - 1, 0)])], "goes_on": onward is not None}
        return tuple(rails.edges[e] for e in new), more
