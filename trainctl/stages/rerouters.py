"""Rerouters: trains that come over their edges are led round what is closed, or draw another route or destination.

As SUMO does with its own trains, with other random numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from trainctl import draws
from trainctl.railway.ways import Ways
from trainctl.scenario import mixed
from trainctl.scenario.model import Model
from trainctl.signals import Floats, Ints, Seen
from trainctl.stages.record import Journal
from trainctl.traffic.choices import Choice
from trainctl.traffic.closings import Closing


class State(NamedTuple):
    """What rerouters remember, shape (n,)."""

    refused: Ints  # edge on which a train has found no way round what is closed, -1: none
    asked: Ints  # edge on which it is, if it has drawn there, or had nothing to draw from; -1: not yet


class Rerouters:
    """The rerouters of a run. What a train cannot leave any more by braking stays on its way."""

    def __init__(self, p: Model, journal: Journal) -> None:
        self.p, self.journal, self.closings, self.choices = p, journal, p.roster.closings, p.roster.choices
        self.at = self._numbers(self.closings)
        self.draws = self._numbers(self.choices)

    def _numbers(self, rerouters: Sequence[Closing] | Sequence[Choice]) -> Ints:
        index = self.p.rails.index
        return np.unique(np.array([index[e] for c in rerouters for e in c.at if e in index], np.int64))

    def initial(self) -> State:
        """No train has come by."""
        nowhere = np.full(len(self.p.scenario.ids), -1)
        return State(nowhere, nowhere.copy())

    def step(
        self, t: float, seen: Seen, ways: Ways, speed: Floats, stops_in: Callable[[], Floats], s: State, busy: Collection[int] = ()
    ) -> tuple[State, list[tuple[int, tuple[str, ...]]]]:
        """Trains on an edge with a rerouter that gives them another way now, with their new routes.

        Parameters
        ----------
        t : float
            Now [s].
        seen : Seen
            Where every train is.
        ways : Ways
            Their ways now.
        speed : ndarray, shape (n,)
            Speed [m/s].
        stops_in : callable
            Gives the way in which every train surely stops (n,) [m]; called only where a train comes over a rerouter.
        s : State
            What was decided before.
        busy : collection of int
            Trains that have just been given another route.

        Returns
        -------
        State
            The same now.
        list of (int, tuple of str)
            Train and edges from the one it is on, internal ones included.
        """
        if not (len(self.at) or len(self.draws)):
            return s, []
        now = np.where(seen.present, seen.edge, -1)
        refused, routes = np.where(now == s.refused, s.refused, -1), []
        asks = np.isin(now, self.draws) & (now != s.asked)
        for i in np.flatnonzero((now != refused) & np.isin(now, self.at) | asks).tolist():
            lock = float(stops_in()[i])
            drawn = self._drawn_way(t, i, seen, ways, lock) if asks[i] and i not in busy else ()
            edges = drawn or (() if i in busy else self._around(t, i, seen, ways, float(speed[i]), lock))
            if edges is None:
                refused[i] = now[i]
            elif edges:
                routes.append((i, edges))
        return State(refused, now), routes

    def _drawn_way(self, t: float, i: int, seen: Seen, ways: Ways, lock: float) -> tuple[str, ...]:
        """The way that train ``i`` draws, which comes over a rerouter; () if it keeps its own. It stays on the next ``lock`` m."""
        rails, train, edge = self.p.rails, self.p.scenario.train[i], self.p.rails.edges[int(seen.edge[i])]
        first, row, end = int(ways.first[i]), int(seen.row[i]), int(ways.first[i + 1])
        passed = int((ways.edge[first:row] == seen.edge[i]).sum())
        way, begin = ways.edge[row:end].tolist(), ways.begin[row:end]
        kept = max(int(np.searchsorted(begin, seen.position[i] + lock, side="right")), 1)  # cannot change any more
        for k, choice in enumerate(self.choices, len(self.closings)):
            if (
                edge not in choice.at
                or not choice.begin - 1e-9 <= t < choice.end
                or (choice.types and train.type not in choice.types)
            ):
                continue
            if choice.probability < 1.0 and self._drawn(i, k, 2 * passed) >= choice.probability:
                continue
            share = np.cumsum(choice.weights) / np.sum(choice.weights)
            wanted = choice.ways[int(np.searchsorted(share, self._drawn(i, k, 2 * passed + 1), side="right"))]
            if not wanted:
                return ()
            shut = self._shut(t, i, edge)
            new, target = None, rails.index.get(wanted[-1], -1)
            if len(wanted) == 1 and target >= 0:
                part = rails.path(way[kept - 1], target, self._cost(i), shut)
                new = None if part is None else [*way[: kept - 1], *part.tolist()]
            elif edge in wanted and all(e in rails.index for e in wanted):
                onward = rails.way(wanted[wanted.index(edge) :]).tolist()
                turns = any(pair in rails.reversal for pair in pairwise(onward))
                new = onward if onward[:kept] == way[:kept] and not turns else None
            if new is None:
                self.journal.event(
                    t, "reroute_refused", train=train.id, reason=f"there is no path to edge {wanted[-1]} that it can still take",
                    position_m=float(seen.position[i]),
                )  # fmt: skip
                return ()
            if new == way:
                return ()
            if why := self._no_signal(i, ways, row, new):
                said = {"reason": why, "position_m": float(seen.position[i])}
                self.journal.event(t, "reroute_refused", train=train.id, **said)
                return ()
            self.journal.event(t, "reroute", train=train.id, to_edge=wanted[-1], from_edge=edge)
            return tuple(rails.edges[e] for e in new)
        return ()

    def _around(self, t: float, i: int, seen: Seen, ways: Ways, speed: float, lock: float) -> tuple[str, ...] | None:
        """The way of train ``i`` round what is closed; () if nothing is, None if there is none. It stays on the next ``lock`` m."""
        p, rails = self.p, self.p.rails
        train, edge = p.scenario.train[i], rails.edges[int(seen.edge[i])]
        closed = self._shut(t, i, edge)
        row, end = int(seen.row[i]), int(ways.first[i + 1])
        way, begin = ways.edge[row:end].tolist(), ways.begin[row:end]
        if closed.isdisjoint(way[1:]):
            return ()
        kept = max(int(np.searchsorted(begin, seen.position[i] + lock, side="right")), 1)  # cannot change any more
        blocked = next(e for e in way[1:] if e in closed)
        new = None if blocked in way[:kept] else self._path(i, way, kept, closed)
        said: dict[str, Any] = {"closed": rails.edges[blocked], "from_edge": edge}
        why = "" if new is None else self._no_signal(i, ways, row, new)
        if new is None or why:
            why = why or ("it cannot brake before the switch any more" if blocked in way[:kept] else "there is no other way")
            self.journal.event(
                t, "reroute_refused", train=train.id, reason=f"edge {rails.edges[blocked]} is closed; {why}",
                position_m=float(seen.position[i]), speed_mps=speed,
            )  # fmt: skip
            return None
        self.journal.event(t, "reroute", train=train.id, **said)
        return tuple(rails.edges[e] for e in new)

    def _no_signal(self, i: int, ways: Ways, row: int, edges: Sequence[int]) -> str:
        """Why train ``i`` is not led over ``edges`` where signals are obeyed; "": it is."""
        p = self.p
        where = mixed.without_signal(ways, i, row, edges, p.scenario.ids, p.rails, p.roster.signals) if p.obeys else ""
        return f"signals are obeyed, and the other route has none {where}" if where else ""

    def _shut(self, t: float, i: int, edge: str) -> set[int]:
        """Edges that are closed now to train ``i`` by the rerouters on this one."""
        rails, train = self.p.rails, self.p.scenario.train[i]
        return {
            rails.index[c.closed]
            for k, c in enumerate(self.closings)
            if edge in c.at and c.begin - 1e-9 <= t < c.end and c.closed in rails.index
            if (not c.types or train.type in c.types) and (not c.vclasses or self.p.roster.vclass[i] in c.vclasses)
            if c.probability >= 1.0 or self._drawn(i, k) < c.probability
        }

    def _cost(self, i: int) -> Floats:
        """Time train ``i`` takes over every edge (E,) [s]."""
        rails, roster = self.p.rails, self.p.roster
        found: Floats = rails.length_m / np.minimum(float(roster.top_speed[i]), float(roster.speed_factor[i]) * rails.speed_mps)
        return found

    def _path(self, i: int, way: list[int], kept: int, closed: Collection[int]) -> list[int] | None:
        """The quickest way over the edges it cannot leave any more and those of its stops that are open."""
        rails, roster = self.p.rails, self.p.roster
        cost = self._cost(i)
        halts = [e for e in (rails.index[s.edge] for s in roster.stops[i]) if e in way[kept:]]
        found = way[:kept]
        for target in [*(e for e in halts if e not in closed), way[-1]]:
            part = rails.path(found[-1], target, cost, closed)
            if part is None:
                return None
            found += part[1:].tolist()
        return found

    def _drawn(self, i: int, k: int, number: int = 0) -> float:
        """A number in [0, 1) for train ``i`` at rerouter ``k``, the closings first; of several the one of this ``number``."""
        word = draws.word(self.p.scenario.ids[i])
        return float(draws.uniform(self.p.scenario.run.seed or 0, draws.REROUTER, np.array([k]), np.array([[word, number]]))[0, 0])
