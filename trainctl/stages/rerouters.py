"""Closed edges: trains on an edge with a rerouter are led round what it closes, as SUMO leads its own."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np

from trainctl import draws
from trainctl.railway.ways import Ways
from trainctl.scenario.model import Model
from trainctl.signals import Floats, Ints, Seen
from trainctl.stages.record import Journal


class Rerouters:
    """The closings of a run. What a train cannot leave any more by braking stays on its way."""

    def __init__(self, p: Model, journal: Journal) -> None:
        self.p, self.journal, self.closings = p, journal, p.roster.closings
        self.at = np.unique([p.rails.index[e] for c in self.closings for e in c.at if e in p.rails.index])

    def initial(self) -> Ints:
        """Edge on which every train has found no way round, shape (n,); -1: none."""
        return np.full(len(self.p.scenario.ids), -1)

    def step(
        self, t: float, seen: Seen, ways: Ways, speed: Floats, stops_in: Floats, refused: Ints, busy: Collection[int] = ()
    ) -> tuple[Ints, list[tuple[int, tuple[str, ...]]]]:
        """Trains on an edge with a rerouter that closes something on their ways now, with their new routes.

        Parameters
        ----------
        t : float
            Now [s].
        seen : Seen
            Where every train is.
        ways : Ways
            Their ways now.
        speed, stops_in : ndarray, shape (n,)
            Speed [m/s], and the way in which it surely stops [m].
        refused : ndarray, shape (n,)
            Edge on which every train has found no way round already, -1: none.
        busy : collection of int
            Trains that have just been given another route.

        Returns
        -------
        ndarray, shape (n,)
            The same now.
        list of (int, tuple of str)
            Train and edges from the one it is on, internal ones included.
        """
        if not len(self.at):
            return refused, []
        now = np.where(seen.present, seen.edge, -1)
        refused, routes = np.where(now == refused, refused, -1), []
        for i in np.flatnonzero((now != refused) & np.isin(now, self.at)).tolist():
            edges = () if i in busy else self._around(t, i, seen, ways, float(speed[i]), float(stops_in[i]))
            if edges is None:
                refused[i] = now[i]
            elif edges:
                routes.append((i, edges))
        return refused, routes

    def _around(self, t: float, i: int, seen: Seen, ways: Ways, speed: float, stops_in: float) -> tuple[str, ...] | None:
        """The way of train ``i`` round what is closed for it; () if nothing is, None if there is no way."""
        p, rails = self.p, self.p.rails
        train, edge = p.scenario.train[i], rails.edges[int(seen.edge[i])]
        closed = {
            rails.index[c.closed]
            for k, c in enumerate(self.closings)
            if edge in c.at and c.begin - 1e-9 <= t < c.end and c.closed in rails.index
            if (not c.types or train.type in c.types) and (not c.vclasses or p.roster.vclass[i] in c.vclasses)
            if c.probability >= 1.0 or self._drawn(i, k) < c.probability
        }
        row, end = int(seen.row[i]), int(ways.first[i + 1])
        way, begin = ways.edge[row:end].tolist(), ways.begin[row:end]
        if closed.isdisjoint(way[1:]):
            return ()
        kept = max(int(np.searchsorted(begin, seen.position[i] + stops_in, side="right")), 1)  # cannot change any more
        blocked = next(e for e in way[1:] if e in closed)
        new = None if blocked in way[:kept] else self._path(i, way, kept, closed)
        said: dict[str, Any] = {"closed": rails.edges[blocked], "from_edge": edge}
        if new is None:
            why = "it cannot brake before the switch any more" if blocked in way[:kept] else "there is no other way"
            self.journal.event(
                t, "reroute_refused", train=train.id, reason=f"edge {rails.edges[blocked]} is closed; {why}",
                position_m=float(seen.position[i]), speed_mps=speed,
            )  # fmt: skip
            return None
        self.journal.event(t, "reroute", train=train.id, **said)
        return tuple(rails.edges[e] for e in new)

    def _path(self, i: int, way: list[int], kept: int, closed: Collection[int]) -> list[int] | None:
        """The quickest way over the edges it cannot leave any more and those of its stops that are open."""
        rails, roster = self.p.rails, self.p.roster
        top, share = float(roster.top_speed[i]), float(roster.speed_factor[i])
        cost = rails.length_m / np.minimum(top, share * rails.speed_mps)
        halts = [e for e in (rails.index[s.edge] for s in roster.stops[i]) if e in way[kept:]]
        found = way[:kept]
        for target in [*(e for e in halts if e not in closed), way[-1]]:
            part = rails.path(found[-1], target, cost, closed)
            if part is None:
                return None
            found += part[1:].tolist()
        return found

    def _drawn(self, i: int, k: int) -> float:
        """A number in [0, 1) for train ``i`` at closing ``k``."""
        word = draws.word(self.p.scenario.ids[i])
        return float(draws.uniform(self.p.scenario.run.seed or 0, draws.REROUTER, np.array([k]), np.array([[word, 0]]))[0, 0])
