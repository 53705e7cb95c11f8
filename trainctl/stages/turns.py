"""Trains that turn back: where they stop for it, whether the way back is theirs, and the way they then have.

A train turns once it has made all stops of its leg and all of it is on track that its next leg runs back over: at a stop there,
else it brakes as soon as it is. The way back is asked for like an entry; while it is another train's it waits, and asks again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from trainctl.railway import along, authority, interlocking, supervisor, turning, zones
from trainctl.railway.authority import DRIVER_MARGIN_M, View
from trainctl.railway.supervisor import STOP
from trainctl.railway.turning import Yard
from trainctl.railway.ways import Ways, turned
from trainctl.railway.ways import ways as laid
from trainctl.scenario.model import Model
from trainctl.signals import Bools, Floats, Ints, Seen
from trainctl.stages.record import Journal

#: A train aims this far into the track on which it may turn [m], if there is room.
INTO_M = 2.0

#: Who must let another train pass first: from ways and rows of trains.
Orders = Callable[[Ways, Ints], list[zones.Ordered]]


#: How often every train has turned, since when it is stopped to turn [s] (NaN: it does not), which train prevents it (-1: none).
Known = tuple[Ints, Floats, Ints]


class Turn(NamedTuple):
    """A train that turns with the coming step."""

    train: int
    edges: tuple[str, ...]  # its way from the twin of its edge on
    arrival: float  # m, where it leaves on the last of them, inf: at its end


class Asked(NamedTuple):
    """What became of the trains that asked for their ways back."""

    requests: interlocking.State
    turns: tuple[Turn, ...]
    kept: dict[int, int]  # train: because of whom it waits


class Turns:
    """The turns of a run. ``leg`` (n,) counts those that every train has made."""

    def __init__(self, p: Model, net: along.Net, journal: Journal) -> None:
        self.p, self.net, self.journal, self.length = p, net, journal, p.consists.train_length()
        index = p.line.index
        self.legs = [[np.array([index[e] for e in leg], np.int64) for leg in legs] for legs in p.roster.legs]
        self.last_leg = np.array([len(legs) - 1 for legs in self.legs], np.int64)
        self.any = bool(self.last_leg.any())
        self.later = np.unique(np.concatenate([p.further_edges, *(leg for legs in self.legs for leg in legs[1:])]))
        self.yards: dict[int, Yard] = {}

    def begun(self, leg: Ints) -> Ways:
        """The ways on which trains began their present legs."""
        line = self.p.line
        return laid([legs[k] for legs, k in zip(self.legs, leg.tolist(), strict=True)], line.start_m, line.length_m)

    def changed(self, ways: Ways, leg: Ints) -> None:
        """Take over new ways: where trains may turn on them. Who was led elsewhere than to its turn does not make it."""
        rails, self.yards = self.p.rails, {}
        for i in np.flatnonzero(leg < self.last_leg).tolist():
            rows, onward = slice(int(ways.first[i]), int(ways.first[i + 1])), self.legs[i][int(leg[i]) + 1]
            found = turning.yard(
                ways.edge[rows], ways.begin[rows], onward, rails.twin, rails.internal, rails.length_m, float(self.length[i]),
                rails.before,
            )  # fmt: skip
            if len(found.places):
                self.yards[i] = found

    def back(self, leg: Ints) -> dict[int, list[int]]:
        """Of trains that turn at the end of their ways: the edges they run over then."""
        return {i: self.legs[i][int(leg[i]) + 1].tolist() for i in self.yards if leg[i] < self.last_leg[i]}

    def wanted(
        self, seen: Seen, speed: Floats, free: Bools, waits: Bools, braking: Callable[[Ints, Floats], Floats], stands_mps: float
    ) -> tuple[list[int], list[tuple[int, float]]]:
        """Trains that stand where they may turn, and the room [m] others have to where they are to stand for it.

        Parameters
        ----------
        seen : Seen
            Where the trains are.
        speed : ndarray, shape (n,)
            [m/s].
        free : ndarray, shape (n,)
            Trains with no stop left on their legs.
        waits : ndarray, shape (n,)
            Trains that stand for their turns already.
        braking : callable
            Distance to a stand [m] of trains (k,) at speeds (k,).
        stands_mps : float
            Slower than this a train is at a standstill.
        """
        stand, rooms = [], []
        for i, yard in self.yards.items():
            if not (seen.present[i] and free[i]):
                continue
            front, v = float(seen.position[i]), np.maximum(speed[i : i + 1], 0.0)
            if waits[i] or (abs(float(speed[i])) < stands_mps and yard.holds(front)):
                stand.append(i)
                continue
            place = yard.aim(front, float(braking(np.array([i]), v)[0]), INTO_M)
            rooms.append((i, place - front))
        return stand, rooms

    def ends(self, view: View, seen: Seen, overrun: Floats) -> View:
        """``view`` with the end of its leg before every train that is to turn: none runs on over it, whatever drives it."""
        trains = [i for i in self.yards if seen.present[i]]
        if not trains:
            return view
        found, last = np.array(trains, np.int64), np.array([self.yards[i].last for i in trains])
        room = np.maximum(last + 0.25 * turning.SHORT_M - seen.position[found] - overrun[found], 0.0)
        targets = authority.with_targets(view.targets, found, room, STOP)
        clear = targets if view.clear is view.targets else authority.with_targets(view.clear, found, room, STOP)
        return view._replace(targets=targets, clear=clear)

    def last_place(self, i: int) -> float:
        """The farthest place at which a train that is to turn may stand [m]; inf: it is not to turn."""
        return self.yards[i].last if i in self.yards else float("inf")

    def step(
        self, t: float, asks: Sequence[int], ways: Ways, seen: Seen, reach: Floats, standing: Bools, requests: interlocking.State,
        known: Known, ordered: Orders | None,
    ) -> tuple[interlocking.State, Known, tuple[Turn, ...]]:  # fmt: skip
        """Let trains turn that stand for it and ask, where the way back is theirs; arguments as those of ``ask``."""
        if not asks:
            return requests, known, ()
        asked = self.ask(asks, ways, seen, reach, known[0], standing, requests, ordered)
        ids, edges = self.p.scenario.ids, self.p.rails.edges
        leg, since, kept = known[0].copy(), known[1].copy(), np.full(len(ids), -1)
        for i, j in asked.kept.items():
            kept[i] = j
            if known[2][i] != j:
                self.journal.event(t, "turn_delayed", train=ids[i], edge=edges[int(seen.edge[i])], other=ids[j] if j >= 0 else None)
        for i, onward, _ in asked.turns:
            leg[i], since[i] = leg[i] + 1, np.nan
            self.journal.event(t, "turn", train=ids[i], from_edge=edges[int(seen.edge[i])], to_edge=onward[0])
        return asked.requests, (leg, since, kept), asked.turns

    def ask(
        self, trains: Sequence[int], ways: Ways, seen: Seen, reach: Floats, leg: Ints, standing: Bools,
        requests: interlocking.State, ordered: Orders | None,
    ) -> Asked:  # fmt: skip
        """Ask for the ways back, one train after the other: each as if it were to enter the net where it is.

        Parameters
        ----------
        trains : sequence of int
            Who is stopped for its turn.
        ways, seen
            Where all trains are that are on the track.
        reach : ndarray, shape (n,)
            How far ahead they request [m].
        leg, standing : ndarray, shape (n,)
            Turns made, and who is at a stop.
        requests : interlocking.State
            Of all trains.
        ordered : callable, optional
            See ``Orders``; None: signals decide. A train has its block then, and its signal on the way back holds it.
        """
        line, arrival = self.p.line, self.p.roster.arrival
        turns, kept, leg = [], dict[int, int](), leg.copy()
        for i in trains:
            onward = self.legs[i][int(leg[i]) + 1]
            front, length = float(seen.position[i]), float(self.length[i])
            there, row, place = turned(ways, i, int(seen.row[i]), front, length, onward.tolist(), line.start_m, line.length_m)
            rows, position, present = seen.row + there.first[:-1] - ways.first[:-1], seen.position.copy(), seen.present.copy()
            rows[i], position[i], present[i] = row, there.begin[row] + place, False
            then = leg + (np.arange(len(rows)) == i)
            if ordered is not None:
                requests, by = self._requested(i, there, rows, position, present, reach, then, standing, requests, ordered)
                if by is not None:
                    kept[i] = by
                    continue
            ways, leg = there, then
            seen = Seen(position, there.edge[rows], rows, seen.present)
            leaves = float(arrival[i]) if leg[i] == self.last_leg[i] else np.inf
            turns.append(Turn(i, tuple(line.edges[e] for e in onward.tolist()), leaves))
        return Asked(requests, tuple(turns), kept)

    def _requested(
        self, i: int, there: Ways, row: Ints, position: Floats, present: Bools, reach: Floats, leg: Ints, standing: Bools,
        requests: interlocking.State, ordered: Orders,
    ) -> tuple[interlocking.State, int | None]:  # fmt: skip
        """Requests with the way back of ``i`` granted, and None; or as they were, and because of whom it is not."""
        asks, along_it = np.arange(len(row)) == i, zones.of(there, self.net, self.later)
        # It is on the track that others wait for, so it comes before whoever waits.
        begins = np.unique(along_it.begins[row[i] : there.first[i + 1]])
        first = [(i, int(there.edge[k]), False) for k in begins.tolist() if k >= 0]
        granted, ends, _ = interlocking.request(
            along_it, {**requests, "stretches": [*first, *requests["stretches"]]}, row, position, self.length, present, reach,
            self.p.supervision.margin_m + DRIVER_MARGIN_M, asks, None, standing & ~asks, ordered(there, row), asks, self.back(leg),
        )  # fmt: skip
        return (requests, int(ends.by[i])) if ends.room[i] <= 0.0 else (granted, None)


def stopping(p: Model) -> Callable[[Ints, Floats], Floats]:
    """How far trains (k,) run on that brake as planned from speeds (k,) [m]."""
    rules, assumed = p.driver_rules, p.relied_on_by_driver

    def distance(trains: Ints, speed: Floats) -> Floats:
        rate = np.minimum(rules.service_mps2, assumed.braking[trains])
        return supervisor.stopping_distance(speed, rate, p.scenario.run.step_s, p.step_theta)

    return distance
