"""Rail signals, where they are obeyed: how far each train may go before one that is red to it.

They alone decide then who goes first, and who has single track: our interlocking grants nothing beside them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trainctl.railway import along, aspects, supervisor, zones
from trainctl.railway.interlocking import EndOfAuthority
from trainctl.railway.rows import tails
from trainctl.railway.ways import Ways
from trainctl.scenario.model import Model
from trainctl.signals import Bools, Floats, Ints, Seen
from trainctl.stages.record import Journal
from trainctl.stages.traffic import State as Traffic
from trainctl.world import SignalBox

#: A train that is slower is at a standstill [m/s], and at a signal if that is no farther away [m].
STANDS_MPS, AT_M = 0.05, 10.0

#: Signals are looked at so much farther ahead than the way in which a train may have to stop [m].
BEYOND_M = 1000.0


class State(NamedTuple):
    """What is remembered of signals."""

    aspects: aspects.State
    at: Ints  # (n,) red signal that every train is stopped at, as was reported, -1: none


class Signals:
    """The signals of a run."""

    def __init__(self, p: Model, journal: Journal) -> None:
        self.p, self.journal = p, journal
        index = p.rails.index
        self.numbers = {
            (index[one.edge], index[one.onward]): k
            for k, one in enumerate(p.roster.signals)
            if one.edge in index and one.onward in index
        }
        self.rate = np.minimum(p.driver_rules.service_mps2, p.relied_on_by_driver.braking)
        # How far ahead of a train that enters a signal may matter.
        self.entering = supervisor.stopping_distance(p.cruise, self.rate, p.scenario.run.step_s, p.step_theta) + BEYOND_M
        self.length, self.net = p.consists.train_length(), along.net(p.rails)
        self.ways: Ways | None = None

    def initial(self) -> State:
        """Nothing seen yet."""
        n = len(self.p.scenario.ids)
        return State(aspects.none(len(self.p.roster.signals), n), np.full(n, -1))

    def step(
        self, t: float, ways: Ways, seen: Seen, speed: Floats, traffic: Traffic, box: SignalBox | None, s: State
    ) -> tuple[State, EndOfAuthority | None]:  # fmt: skip
        """How far every train may go before a signal; None where they are not obeyed.

        Parameters
        ----------
        t : float
            Now [s].
        ways : Ways
            Of all n trains.
        seen, speed : Seen, ndarray, shape (n,)
            Where the trains are, and how fast [m/s].
        traffic : traffic.State
            Who has come, and is at a stop. Who has not may go up to the first signal on its way, once it comes.
        box : SignalBox or None
            Whoever sets the signals.
        s : State
            A step ago.
        """
        if box is None:
            return s, None
        at, seen = self._table(ways), traffic.on_track(seen)
        step, theta, v = self.p.scenario.run.step_s, self.p.step_theta, np.maximum(speed, 0.0)
        braking = supervisor.stopping_distance(v, self.rate, step, theta)
        binding = self._binding(v)
        farthest = float(np.max(braking + 10.0 * step * v, where=seen.present, initial=0.0)) + BEYOND_M
        horizon = np.where(seen.present, farthest, self.entering)
        sighted = aspects.sighted(ways, at, seen.row, seen.position, seen.present | traffic.outside(seen), horizon)
        green = np.zeros(len(sighted.train), bool)
        known = seen.present[sighted.train]
        signals, which = np.unique(sighted.signal[known], return_inverse=True)
        green[known] = box.green(signals)[which]
        self._not_yet(t, ways, at, seen, traffic, sighted, green, s.aspects.claims)
        now, ends, told = aspects.decide(
            ways, sighted, green, seen.position, seen.present, ~traffic.standing, braking, binding, s.aspects
        )  # fmt: skip
        self._keep_clear(t, ways, at, seen, traffic, sighted, now.claims, ends)
        ids, roster = self.p.scenario.ids, self.p.roster
        for one in (one for one in told if not roster.driven[one.train]):
            name = roster.signals[one.signal].name
            if one.passed:
                self.journal.event(t, "red_passed", train=ids[one.train], signal=name, speed_mps=float(speed[one.train]))
            else:
                self.journal.event(
                    t, "green_withdrawn", train=ids[one.train], signal=name, room_m=one.room, braking_m=float(braking[one.train])
                )  # fmt: skip
        stands = seen.present & (v < STANDS_MPS) & (ends.room < AT_M) & (now.red >= 0) & ~traffic.standing
        for i in np.flatnonzero(stands & (ends.by < 0)).tolist():
            ends.by[i] = box.blocker(int(now.red[i]))
        stand = np.where(stands, now.red, -1)
        for i in np.flatnonzero((stand >= 0) & (stand != s.at)).tolist():
            other = ids[ends.by[i]] if ends.by[i] >= 0 else None
            self.journal.event(t, "signal", train=ids[i], signal=roster.signals[stand[i]].name, other=other)
        return State(now, stand), ends

    def before(self, ways: Ways, seen: Seen) -> EndOfAuthority:
        """How far trains may go before anything is known of any signal: up to the first one."""
        n = len(seen.row)
        sighted = aspects.sighted(ways, self._table(ways), seen.row, seen.position, np.ones(n, bool), self.entering)
        none, nobody = np.zeros(len(sighted.train), bool), np.zeros(n, bool)
        return aspects.decide(
            ways, sighted, none, seen.position, nobody, nobody, np.zeros(n), np.zeros(n), self.initial().aspects
        )[1]  # fmt: skip

    def _not_yet(
        self, t: float, ways: Ways, at: Ints, seen: Seen, traffic: Traffic, sighted: aspects.Sighted, green: Bools,
        claims: list[list[int]],
    ) -> None:  # fmt: skip
        """Take for red what was set green while another train came onto the track behind it: it will be red in a step."""
        back = traffic.standing & ~traffic.parked & (traffic.stands_until <= t + 1e-9)  # from where it was parked, perhaps
        fresh = seen.present & (traffic.entering | back)
        if not fresh.any():
            return
        come = self._under(ways, seen, fresh)
        for k in np.flatnonzero(green).tolist():
            i, q = int(sighted.train[k]), int(sighted.signal[k])
            if [i, q] not in claims and any(come.get(e, {i}) != {i} for e in aspects.block(ways, at, int(sighted.row[k])).tolist()):
                green[k] = False

    def _under(self, ways: Ways, seen: Seen, trains: Bools) -> dict[int, set[int]]:
        """These trains, by the edges on which one of them shuts the track: under it, on the twins of those, and across."""
        found: dict[int, set[int]] = {}
        rails, length, net = self.p.rails, self.length, self.net
        behind = tails(ways, net.length, net.before_first, net.before, seen.position, length, trains)
        under = list(zip(behind[0].tolist(), behind[2].tolist(), strict=True))
        for i in np.flatnonzero(trains).tolist():
            under += [(i, int(ways.edge[k])) for k in zones.under(ways, seen.row, seen.position, length, i)]
        for i, e in under:
            for f in (e, int(rails.twin[e]), *rails.crossing[e]):
                found.setdefault(f, set()).add(i)
        return found

    def _keep_clear(
        self, t: float, ways: Ways, at: Ints, seen: Seen, traffic: Traffic, sighted: aspects.Sighted, claims: list[list[int]],
        ends: EndOfAuthority,
    ) -> None:  # fmt: skip
        """Keep trains that are not on the track off blocks that others can no longer stop before: those would get red."""
        due = self.p.roster.depart <= t + self.p.scenario.run.step_s + 1e-9
        outside = (traffic.parked | traffic.outside(seen) & due) & ~self.p.roster.driven
        if not claims or not outside.any():
            return
        places = self._under(ways, seen, outside)
        for i, q in claims:
            (k,) = sighted.row[(sighted.train == i) & (sighted.signal == q)][:1]
            for e in aspects.block(ways, at, int(k)).tolist():
                for j in places.get(e, ()):
                    ends.room[j], ends.zone[j], ends.by[j] = 0.0, e, i

    def _binding(self, speed: Floats) -> Floats:
        """Distance from here within which every train stops for certain if it is ordered to one step later [m], shape (n,)."""
        rules, relied, step = self.p.supervision, self.p.assumed, self.p.scenario.run.step_s
        top = speed + (rules.greatest_mps2 + relied.scatter) * step + relied.drift + relied.surge
        top = top + relied.lag * (rules.greatest_mps2 + rules.emergency_mps2)
        room = top * step + supervisor.stopping_distance(top, self.rate, step, self.p.step_theta)
        return room + relied.uncertainty + aspects.STANDS_BEFORE_M

    def _table(self, ways: Ways) -> Ints:
        """Signals along the ways, made anew where these have changed."""
        if self.ways is not ways:
            self.ways, self.at = ways, aspects.table(ways, self.p.rails.internal, self.numbers)
        return self.at
