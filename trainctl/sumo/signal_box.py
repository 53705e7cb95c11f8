"""SUMO as a signal box: rail signals that trains of ours obey, and trains of SUMO's own among them.

Of whoever obeys SUMO's driver plans every step, so that it asks for signals, with the deceleration the train brakes with; what that
driver wants is overruled all the same. SUMO lets no train in before the block is free.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from trainctl.errors import CouplingError
from trainctl.railway.ways import Ways, rerouted
from trainctl.scenario.model import Model
from trainctl.signals import Bools, Floats, Ints, Seen
from trainctl.traffic.handed import Handed

if TYPE_CHECKING:
    from sumo_net import Rails
    from trainctl.sumo.session import Session

#: A trip that nobody makes.
NOBODY = "(nobody)"

#: Options of ours that do not hold where trains of SUMO's run, or are let in as SUMO does it.
NOT_WITH_SIGNALS = ("insertion-checks", "default.speeddev")


#: Length of the place at the end of an edge at which SUMO holds a train that is to turn [m].
HOLD_M = 0.1

#: Whoever is faster is at no stop [m/s]: SUMO takes a train for stopped from 0.1 m/s on.
SLOW_MPS = 0.2


class Obeyed(NamedTuple):
    """What a session needs to know where signals are obeyed."""

    handed: Handed
    driven: Bools  # (n,) trains that SUMO drives
    signals: tuple[tuple[str, int], ...]  # program and link of every signal, by its number
    alone: tuple[tuple[int, ...], ...]  # what ``alone_on`` says of every signal
    entries: tuple[tuple[tuple[int, tuple[int, ...]], ...], ...]  # what ``entries`` says of every signal
    braking: Floats  # (n,) m/s2, what trains of ours brake with
    rails: Rails
    legs: tuple[tuple[tuple[str, ...], ...], ...]  # routes in parts, see ``Roster``

    def way(self, train: int) -> tuple[str, ...]:
        """All edges of a train's route: signals keep others from where it comes back to."""
        return tuple(edge for leg in self.legs[train] for edge in leg)

    def hold(self, train: int, leg: int) -> tuple[str, float, float] | None:
        """Where a stop keeps SUMO from turning a train too early, at the end of this leg: edge, from and to [m]; None: nowhere.

        The train stands and turns short of that, see ``turning.SHORT_M``.
        """
        if leg + 1 >= len(self.legs[train]):
            return None
        edge = self.legs[train][leg][-1]
        end = float(self.rails.length_m[self.rails.index[edge]])
        return edge, max(end - HOLD_M, 0.0), end


def obeyed(p: Model) -> Obeyed | None:
    """The same of a scenario; None where signals are not obeyed."""
    handed = p.roster.handed
    if handed is None:
        return None
    signals = tuple((one.name, one.link) for one in p.roster.signals)
    rate = np.minimum(p.driver_rules.service_mps2, p.relied_on_by_driver.braking)
    index = p.rails.index
    at = [(index.get(one.edge, -1), index.get(one.onward, -1)) for one in p.roster.signals]
    alone = tuple(alone_on(p.rails, edge, set(at)) if edge >= 0 else () for edge, _ in at)
    number = {pair: k for k, pair in enumerate(at)}
    others = tuple(entries(p.rails, *pair, number) if min(pair) >= 0 else () for pair in at)
    return Obeyed(handed, p.roster.driven, signals, alone, others, rate, p.rails, p.roster.legs)


def alone_on(rails: Rails, edge: int, signals: Collection[tuple[int, int]]) -> tuple[int, ...]:
    """Edges from ``edge``, which ends at a signal, up to the next signal, if whoever comes there has passed the one at ``edge``.

    () where there is a switch, a crossing or a track for both directions. ``signals`` are pairs of edges with a signal between.
    """
    if rails.twin[edge] >= 0 or rails.crossing[edge]:
        return ()
    if not rails.after[edge]:
        return (edge,)
    onward = rails.after[edge][0]
    if len(rails.after[edge]) > 1 or len(rails.before[onward]) > 1:
        return ()
    rest = plain(rails, onward, signals)
    return (edge, *rest) if rest and edge not in rest else ()


def plain(rails: Rails, edge: int, signals: Collection[tuple[int, int]]) -> tuple[int, ...]:
    """Edges from ``edge`` up to the next signal; () where a switch, a crossing or a track for both directions comes before it.

    Also where such a track begins right behind it: SUMO lets no train that is longer than the edges before it up to that signal
    while another comes the other way.
    """
    found = [edge]
    while True:
        here = found[-1]
        if rails.twin[here] >= 0 or rails.crossing[here]:
            return ()
        behind = tuple(_normal_after(rails, here))
        if all((here, onward) in signals for onward in behind):
            return () if any(rails.twin[onward] >= 0 for onward in behind) else tuple(found)
        if len(rails.after[here]) > 1 or len(rails.before[rails.after[here][0]]) > 1 or rails.after[here][0] in found:
            return ()
        found.append(rails.after[here][0])


def entries(
    rails: Rails, edge: int, onward: int, signals: Mapping[tuple[int, int], int]
) -> tuple[tuple[int, tuple[int, ...]], ...]:
    """Where others come onto the track behind the signal between two edges: past which signals, and over which edges to these.

    The edges go back from the signal, as far as nothing leads onto or off the track. () where nobody else comes, where
    somebody comes past no signal, and where a block is more than plain track: a switch, a crossing, a track for both directions.
    """
    if not plain(rails, onward, signals):
        return ()
    found = []
    for first in rails.before[onward]:
        from_, inside = first, []
        while rails.internal[from_]:
            inside.append(from_)
            if len(rails.before[from_]) != 1:
                return ()
            from_ = rails.before[from_][0]
        crossed = {other for here in inside for other in rails.crossing[here]}
        if rails.twin[from_] >= 0 or (from_, onward) not in signals or any(onward not in _normal_after(rails, e) for e in crossed):
            return ()
        if from_ == edge:
            continue
        back = [from_]
        while len(rails.before[back[-1]]) == 1 and rails.before[back[-1]][0] not in back:
            before = rails.before[back[-1]][0]
            if len(rails.after[before]) != 1 or rails.twin[before] >= 0 or rails.crossing[before]:
                break
            back.append(before)
        found.append((signals[from_, onward], tuple(back)))
    return tuple(found)


def _normal_after(rails: Rails, edge: int) -> Iterator[int]:
    """Edges behind one, past those on the junction between."""
    for onward in rails.after[edge]:
        while rails.internal[onward]:
            onward = rails.after[onward][0]
        yield onward


def write(obeyed: Obeyed, folder: Path) -> dict[str, str]:
    """Write the files that SUMO is handed beside our trains; its options that name them, and those of the configuration."""
    handed = obeyed.handed
    (folder / "own.rou.xml").write_text("\n".join(["<routes>", *handed.types, *handed.vehicles, "</routes>", ""]), encoding="utf-8")
    (folder / "own.add.xml").write_text("\n".join(["<additional>", *handed.additional, "</additional>", ""]), encoding="utf-8")
    return {**dict(handed.options), "route-files": "trains.rou.xml,own.rou.xml", "additional-files": "own.add.xml"}


class Read(NamedTuple):
    """Trains that SUMO drives."""

    train: Ints
    row: Ints
    position: Floats  # m
    present: Bools

    def within(self, seen: Seen, ways: Ways) -> Seen:
        """What is seen of all trains, with these."""
        for whole, part in ((seen.row, self.row), (seen.position, self.position), (seen.present, self.present)):
            whole[self.train] = part
        return seen._replace(edge=ways.edge[seen.row])


class Box:
    """The signals of a session that runs, and its trains that SUMO drives."""

    def __init__(self, session: Session, obeyed: Obeyed, state: Callable[[str], str]) -> None:
        self.session, self.obeyed, self.state = session, obeyed, state
        self.number = {name: i for i, name in enumerate(session.ids)}
        self.own = np.flatnonzero(obeyed.driven)
        self.speed, self.stands = np.full(len(session.ids), np.nan), np.zeros(len(session.ids), bool)
        self.parked: list[int] = []
        self.claims: list[list[int]] = []
        self.contested: dict[int, bool] = {}  # by signal, as far as it was asked for
        self.entries: dict[int, tuple[tuple[int, tuple[int, ...]], ...]] = {}  # by signal, as far as these were asked for
        self.held: dict[tuple[int, int], set[tuple[str, str]]] = {}  # for each claim: signal and trip of those it holds

    def green(self, signals: Ints) -> Bools:
        """Whether signals show green, by their numbers."""
        asked = [self.obeyed.signals[signal] for signal in signals.tolist()]
        shown = {name: self.state(name) for name in dict.fromkeys(name for name, _ in asked)}
        return np.array([shown[name][link] in "Gg" for name, link in asked], bool)

    def blocker(self, signal: int) -> int:
        """A train because of which a signal is red, -1 if SUMO names none."""
        name, link = self.obeyed.signals[signal]
        lights = self.session.api.trafficlight
        for ask in (lights.getBlockingVehicles, lights.getRivalVehicles, lights.getPriorityVehicles):
            for train in ask(name, link):
                if train in self.number:
                    return self.number[train]
        return -1

    def hold(self) -> None:
        """Before SUMO sets its signals: whoever might be given what a claimed signal gives is to wait, by a constraint.

        It is told to let a train pass first that does not exist, so it waits until the constraint is taken off.
        """
        lights, claims = self.session.api.trafficlight, {(i, q) for i, q in self.claims if self._contested(q)}
        for claim in self.held.keys() - claims:
            name, gone = self.obeyed.signals[claim[1]][0], self.held.pop(claim)
            # SUMO takes off all that are alike, so also what another claim at the same junction holds the same train by.
            kept = {one for (_, q), held in self.held.items() if self.obeyed.signals[q][0] == name for one in held}
            for at, trip in sorted(gone - kept):
                lights.removeConstraints(at, trip, name, NOBODY)
        given: dict[str, set[tuple[str, int]]] = {}  # by train: what it holds itself
        for i, q in self.claims if claims else ():
            given.setdefault(self.session.ids[i], set()).add(self.obeyed.signals[q])
        for claim in sorted(claims):
            name, link = self.obeyed.signals[claim[1]]
            held = self.held.setdefault(claim, set())
            if held and self._behind_held(claim[1], held):
                continue
            for rival in lights.getRivalVehicles(name, link):
                # Held at one that it holds itself, and runs past in any case, it would lose its own green.
                own = given.get(rival, ())
                ahead = [one for one in self.session.api.vehicle.getNextTLS(rival) if (one[0], one[1]) not in own]
                red = [one[0] for one in ahead if one[3] not in "Gg"]  # one that has just come has green until it is asked for
                trip = self.obeyed.handed.trips[self.number[rival]] if rival in self.number else rival
                for at in (red or [one[0] for one in ahead])[:1]:
                    if (at, trip) not in held:
                        held.add((at, trip))
                        lights.addConstraint(at, trip, name, NOBODY, 0, 1)

    def _behind_held(self, signal: int, held: set[tuple[str, str]]) -> bool:
        """Whether all that could still be given what this signal gives are behind trains that are held already.

        To ask for rivals while one is held takes SUMO a look at every train it has, for each train that holds a signal.
        """
        if (entries := self.entries.get(signal)) is None:
            edges, lanes = self.obeyed.rails.edges, self.session.api.edge.getLaneNumber
            entries = self.obeyed.entries[signal]
            entries = entries if all(lanes(edges[e]) == 1 for _, back in entries for e in back) else ()
            self.entries[signal] = entries
        return bool(entries) and all((self.obeyed.signals[at][0], self._foremost(back)) in held for at, back in entries)

    def _foremost(self, back: tuple[int, ...]) -> str:
        """Trip of the first train on these edges, which lead back from a signal; "" if there is none.

        A train that is parked is on no lane, so whoever is behind it is the first one.
        """
        edges, trips = self.session.api.edge, self.obeyed.handed.trips
        for edge in back:
            if trains := edges.getLastStepVehicleIDs(self.obeyed.rails.edges[edge]):
                foremost = trains[-1]
                return trips[self.number[foremost]] if foremost in self.number else foremost
        return ""

    def _contested(self, signal: int) -> bool:
        """Whether another train could be given what this signal gives: to ask SUMO takes longer than all the rest of a step."""
        if (known := self.contested.get(signal)) is None:
            edges, lanes = self.obeyed.alone[signal], self.session.api.edge.getLaneNumber
            known = not edges or any(lanes(self.obeyed.rails.edges[e]) > 1 for e in edges)
            self.contested[signal] = known
        return known

    def kept_parked(self) -> list[int]:
        """Trains that were to come back with the last move, and are parked still."""
        return self.parked

    def speeds(self) -> Floats:
        """Speeds of the trains that SUMO drives [m/s], NaN of the others."""
        return self.speed

    def stopped(self) -> Bools:
        """Which of the trains that SUMO drives stand at a stop, (n,): some still move as they reach it."""
        return self.stands

    def read(self) -> Read:
        """Where the trains that SUMO drives are now; the session's ways and rows follow those that it leads another way."""
        vehicle, session = self.session.api.vehicle, self.session
        there = set(vehicle.getIDList()) if len(self.own) else set()
        present = np.array([session.ids[i] in there for i in self.own.tolist()], bool)
        row, position = session.seen.row[self.own].copy(), session.seen.position[self.own].copy()
        self.speed[self.own], self.stands[self.own] = 0.0, False
        for k in np.flatnonzero(present).tolist():
            i = int(self.own[k])
            name = session.ids[i]
            row[k] = row_of(session, self.obeyed.rails, i, vehicle.getRoadID(name))
            position[k] = session.ways.begin[row[k]] + vehicle.getLanePosition(name)
            self.speed[i] = vehicle.getSpeed(name)
            self.stands[i] = self.speed[i] < SLOW_MPS and vehicle.isStopped(name)
        return Read(self.own, row, position, present)


def row_of(session: Session, rails: Rails | None, i: int, edge: str) -> int:
    """The row of the edge a train of SUMO's is on, from where it was on its way; SUMO may have given it another.

    Then the way is taken over, and the rows in ``session.seen`` with it; ``rails`` None: it has no other.
    """
    for _ in range(2):
        row, end = int(session.seen.row[i]), int(session.ways.first[i + 1])
        onward = np.flatnonzero(session.ways.edge[row:end] == session.line.index.get(edge, -1))
        if len(onward):
            return row + int(onward[0])
        if rails is not None:
            _take_over(session, rails, i, edge)
    raise CouplingError(f"train {session.ids[i]} left its route on edge {edge} at {session.now():.3f} s")


def _take_over(session: Session, rails: Rails, i: int, edge: str) -> None:
    """The way of a train that SUMO's own rerouters, or its routing, have changed, from the edge it was on."""
    name, line, row, vehicle = session.ids[i], session.line, int(session.seen.row[i]), session.api.vehicle
    route, at = vehicle.getRoute(name), vehicle.getRouteIndex(name)
    was = line.edges[session.ways.edge[row]]
    first = max(k for k in range(at + 1) if k == 0 or route[k] == was)
    try:
        way = rails.way(route[first:])
    except ValueError as error:
        raise CouplingError(f"train {name} on edge {edge} at {session.now():.3f} s: {error}") from None
    before = session.ways.first
    session.ways = rerouted(session.ways, i, row, way, line.start_m, line.length_m)
    session.seen = session.seen._replace(row=session.seen.row + session.ways.first[:-1] - before[:-1])
