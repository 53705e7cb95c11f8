"""The formation rule of trains placed by the scenario: those on one track are one formation, with a slot for each."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trainctl.scenario.model import Model
from trainctl.signals import Floats, Formed, Ints, Links, References, Seen
from trainctl.stages.record import Journal
from trainctl.stages.traffic import Around
from trainctl.stages.traffic import State as Traffic
from trainctl.topology import graph


class State(NamedTuple):
    """Where trains were when they were last sorted, shape (n,)."""

    track: Ints  # index into ``line.track_ids``


class Slots:
    """Trains on one track form; who changes track leaves one formation and joins another."""

    CHECKS = True  # whether a law's start condition is asked again where links changed

    def __init__(self, p: Model, journal: Journal) -> None:
        self.p, self.journal = p, journal
        self.track_of = np.array([p.line.track_ids.index(t) for t in p.line.tracks], np.int64)

    def initial(self) -> tuple[State, Formed]:
        """Every train belongs to the formation of the track it starts on."""
        n, track = len(self.p.scenario.ids), self.p.start_track.copy()
        return State(track), Formed(
            None, track.copy(), np.full(n, -1), np.ones(n, bool), np.zeros(n), References.one(self.p.reference, n), (), None
        )

    def step(
        self, t: float, seen: Seen, own: Floats, around: Around, traffic: Traffic, s: State, formed: Formed
    ) -> tuple[State, Formed, Floats, Seen, Links | None]:
        """Leave, join, sort; the links are None where nothing changed. See ``convoys.Convoys.step``."""
        track = self.track_of[seen.edge]
        moved = (track != s.track).nonzero()[0]
        names = self.p.line.track_ids
        for i in moved.tolist():
            self.journal.event(t, "leave", train=self.p.scenario.ids[i], track=names[s.track[i]])
        s = State(track)
        admitted = self._admit(t, seen, own, track, moved, formed)
        if admitted is None and formed.links is not None and graph.in_order(formed.links.order, seen.position, formed.formation):
            return s, formed, own, seen, None
        if admitted is not None:
            formed = formed._replace(formation=admitted)
        order = graph.order_on_tracks(seen.position, formed.formation)
        return s, formed, own, seen, graph.links(self.p.plan, order, formed.formation)

    def after(self, formed: Formed) -> Formed:
        """A step later: the reference of all trains is that of the scenario."""
        return formed

    def _admit(self, t: float, seen: Seen, own: Floats, track: Ints, moved: Ints, formed: Formed) -> Ints | None:
        """Let trains join the formation of their track; where the law needs its start condition, only once it holds.

        Returns the formations (n,), None where the set of members did not change.
        """
        formation = formed.formation
        outside = (formation != track).nonzero()[0]
        if not len(outside):
            return None
        careful = getattr(self.p.law, "JOIN", "always") == "start_condition"
        changed = False
        for i in outside.tolist():
            without, candidate = formation.copy(), formation.copy()
            without[i], candidate[i] = -1 - i, track[i]
            why: list[str] = []
            if careful and np.any(without == track[i]):
                known = set(self._violations(t, seen, own, without))
                why = [v for v in self._violations(t, seen, own, candidate) if v not in known]
            name, joined = self.p.scenario.ids[i], self.p.line.track_ids[track[i]]
            if not why:
                formation, changed = candidate, True
                self.journal.event(t, "join", train=name, track=joined)
            elif i in moved:
                formation, changed = without, True
                self.journal.event(t, "join_delayed", train=name, track=joined, reasons=why)
        return formation if changed else None

    def _violations(self, t: float, seen: Seen, own: Floats, formation: Ints) -> list[str]:
        """What the law would object to with these formations."""
        links = graph.links(self.p.plan, graph.order_on_tracks(seen.position, formation), formation)
        return list(self.p.law.violations(self.p.params, self.p.scene(own, links, t)))
