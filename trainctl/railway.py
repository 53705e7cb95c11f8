"""Trains among each other on a net: who is ahead, whose turn it is at a switch, and what the supervisor allows.

This is the part of the loop that knows ways. Trains that come and go are in ``service``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from trainctl import lookout, supervisor
from trainctl.lookout import View
from trainctl.prepare import Prepared
from trainctl.record.journal import Journal
from trainctl.signals import Bools, Floats, Ints
from trainctl.supervisor import KINDS
from trainctl.topology import along, claims
from trainctl.topology.ways import Ways
from trainctl.world import Seen

#: What the driver keeps clear beyond the supervisor's margin, so that the latter has nothing to do [m].
DRIVER_MARGIN_M = 10.0


class Lookout:
    """Claims, and what is ahead of every train: state of the railway that all runs with ways have.

    Attributes
    ----------
    claims : claims.State
        Who has which switch and single track.
    waits_for : ndarray, shape (n,)
        Train that each is held by at a switch, -1 if none.
    """

    def __init__(self, p: Prepared) -> None:
        self.p = p
        self.rails, self.net = p.rails, along.net(p.rails)
        self.length = p.consists.train_length()
        self.factor = np.ones(len(self.length)) if p.roster is None else p.roster.speed_factor
        self.claims = claims.none()
        self.waits_for: Ints = np.full(len(self.length), -1)
        self.theta = p.step_theta
        rules = p.supervision
        planned = [rules.service_mps2] + ([p.driving.deceleration_mps2] if p.roster else [])
        self.assumed = p.assumed
        self.rate = np.minimum(self.assumed.braking, min(rules.emergency_mps2, *planned))
        self.ways: Ways | None = None

    def _reach(self, speed: Floats) -> Floats:
        """How far ahead every train claims [m]: farther than it would brake for what it must not enter."""
        assumed, step = self.assumed, self.p.scenario.run.step_s
        v = np.maximum(speed, 0.0) + assumed.drift + 2.0 * assumed.lag * self.p.supervision.emergency_mps2
        braking = supervisor.stopping_distance(v, self.rate, step, self.theta)
        clear = self.p.supervision.margin_m + 2.0 * DRIVER_MARGIN_M + 50.0 + 6.0 * assumed.uncertainty
        return braking + 4.0 * v * step + clear

    def claim(self, t: float, ways: Ways, seen: Seen, speed: Floats, journal: Journal, entering: Bools) -> claims.Held:
        """Let every train claim what lies within its reach; ``entering`` (n,) are those that ask to enter the net."""
        if self.ways is not ways:  # they changed
            self.ways, self.zones = ways, claims.zones(ways, self.net)
        self.claims, held, said = claims.claim(
            self.zones, self.claims, seen.row, seen.position, self.length, seen.present, self._reach(speed),
            self.p.supervision.margin_m + DRIVER_MARGIN_M, entering,
        )  # fmt: skip
        self._tell(journal, t, said, held)
        return held

    def look(self, ways: Ways, seen: Seen, speed: Floats, held: claims.Held) -> View:
        """What is ahead of every train."""
        horizon = float(np.max(self._reach(speed), where=seen.present, initial=0.0)) + 1000.0
        if self.p.roster is not None:
            horizon = max(horizon, self.p.driving.join_range_m)
        return lookout.look(
            ways, self.net, self.rails.speed_mps, self.factor, seen.row, seen.position, speed, self.length, seen.present, horizon,
            held.room, claims.order(self.claims),
        )  # fmt: skip

    def _tell(self, journal: Journal, t: float, said: list[claims.Decision], held: claims.Held) -> None:
        """Switches that another train has first, and those that became free."""
        ids, edges = self.p.scenario.ids, self.rails.edges
        for one in said:
            if one.by >= 0:
                journal.event(
                    t, "conflict", train=ids[one.train], first=ids[one.by], edge=edges[one.zone],
                    place="join" if one.join else "single_track",
                )  # fmt: skip
            elif one.granted and not one.join and self.waits_for[one.train] >= 0:
                journal.event(t, "switch_granted", train=ids[one.train], edge=edges[one.zone])
        self.waits_for = held.by.copy()


class Supervision:
    """The supervisor of a run: bounds accelerations, and tells when it begins and ends to do so.

    Attributes
    ----------
    acting : ndarray, shape (n,)
        Trains it acts on, or would act on.
    """

    def __init__(self, p: Prepared) -> None:
        self.p, self.rules = p, p.supervision
        self.acting: Bools = np.zeros(len(p.scenario.ids), bool)
        self.theta = p.step_theta

    def verdict(self, view: View, speed: Floats, acceleration: Floats, error: Floats) -> supervisor.Verdict:
        """What every train may do over the coming step; ``error`` (n,) is that of the measured positions [m]."""
        targets, limits = lookout.measured(view.targets, view.limits, error)
        clear = targets if view.clear is view.targets else lookout.measured(view.clear, view.limits, error)[0]
        return lookout.judge(
            self.rules, speed, targets, clear, limits, self.p.scenario.run.step_s, self.theta, self.p.assumed, acceleration
        )

    def tell(self, journal: Journal, t: float, verdict: supervisor.Verdict, acts: Bools, view: View, speed: Floats) -> None:
        """Events where it begins or ends to act."""
        ids, targets = self.p.scenario.ids, view.targets
        others, rooms = (np.concatenate(pair) for pair in ((targets.other, view.clear.other), (targets.room, view.clear.room)))
        for i in np.flatnonzero(acts & ~self.acting).tolist():
            reason, row = int(verdict.reason[i]), int(verdict.target[i])
            more: dict[str, Any] = {"reason": KINDS[reason] if reason >= 0 else "acceleration"}
            if 0 <= reason < len(KINDS) - 1:
                other = int(others[row])
                more |= {"room_m": float(rooms[row])} | ({"other": ids[other]} if other >= 0 else {})
            elif reason >= 0:
                more |= {"limit_mps": float(view.limits.speed[row]), "distance_m": float(view.limits.distance[row])}
            journal.event(
                t, "supervisor", train=ids[i], mode=self.rules.mode, emergency=bool(verdict.emergency[i]),
                speed_mps=float(speed[i]), **more,
            )  # fmt: skip
        for i in np.flatnonzero(self.acting & ~acts).tolist():
            journal.event(t, "supervisor_released", train=ids[i])
        self.acting = acts
