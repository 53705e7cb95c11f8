"""Driving of formations and of trains outside of them: the pace of a formation, and the acceleration of a train alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trainctl.railway import authority, supervisor
from trainctl.railway.authority import View
from trainctl.railway.supervisor import STOP
from trainctl.scenario.model import Model
from trainctl.signals import Bools, Floats, Formed
from trainctl.stages.traffic import Around
from trainctl.stages.traffic import State as Traffic
from trainctl.topology import convoys

#: Slower than this share of the cruising speed a train leads none: those behind draw up to it, so as not to block what is behind.
CRAWLS = 0.25

#: Slower than this a train that is not to accelerate is held [m/s]: its couplers must not move it.
HELD_MPS = 1e-3

#: Share of the haste to catch up with another formation that is left while a train behind is nearer to joining this one.
HASTE = 0.5

#: Share of the room between cruising speed and the maximum speed that haste may use.
ROOM_FOR_HASTE = 0.75


class Driven(NamedTuple):
    """What drivers want over the coming step."""

    ordered: Floats  # (n,) m/s2, NaN: the law drives
    stands: Bools  # (n,) the train is held where it is


def of(p: Model) -> Nobody | Driver:
    """The driver of a scenario's trains."""
    return Driver(p) if p.driven else Nobody()


class Nobody:
    """The law leads every train."""

    def step(
        self, speed: Floats, acceleration: Floats, around: Around, traffic: Traffic, formed: Formed, commanded: Floats
    ) -> tuple[Driven, Formed]:
        """No orders; see ``Driver.step``."""
        return Driven(np.full(len(speed), np.nan), np.zeros(len(speed), bool)), formed


class Driver:
    """Drives whoever no law does."""

    def __init__(self, p: Model) -> None:
        self.p, self.n = p, len(p.scenario.ids)
        self.step_s, self.theta = p.scenario.run.step_s, p.step_theta
        self.rules, self.assumed = p.driver_rules, p.relied_on_by_driver
        self.pulls, self.brakes = p.driver_acceleration, p.driver_braking
        self.maximum = p.band[1]

    def step(
        self, speed: Floats, acceleration: Floats, around: Around, traffic: Traffic, formed: Formed, commanded: Floats
    ) -> tuple[Driven, Formed]:
        """Accelerations of trains that are driven, and the pace of formations.

        Parameters
        ----------
        speed, acceleration : ndarray, shape (n,)
            Of every train now [m/s], [m/s2].
        around : Around
            What is ahead, and the stops.
        traffic : traffic.State
            Who is at a standstill.
        formed : Formed
            The formations.
        commanded : ndarray, shape (n,)
            Accelerations set from outside [m/s2], NaN where none: they take the place of the driver's; the law's are replaced in
            ``control``.

        Returns
        -------
        tuple of Driven and Formed
            The latter with the accelerations of its references.
        """
        view, references, led = around.view, formed.references, formed.led
        assert view is not None
        front = convoys.fronts(formed.ahead)
        first = front == np.arange(self.n)
        v = np.maximum(np.where(led, references.pace.speed, speed), 0.0)
        limits = view.limits._replace(speed=self.p.driving.below(view.limits.speed))
        judged = self.step_s, self.theta, self.assumed, acceleration
        by_limits = supervisor.verdict(self.rules, v, supervisor.no_targets(), limits, *judged).maximum
        targets = authority.with_targets(authority.of(view.targets, first[view.targets.train]), *around.stops, STOP)
        clear = authority.with_targets(authority.of(view.clear, first[view.clear.train]), *around.stops, STOP)
        free = authority.judge(self.rules, v, targets, clear, supervisor.no_limits(), *judged).maximum
        lowest = np.full(self.n, np.inf)
        np.minimum.at(lowest, front, np.maximum(np.minimum(by_limits, np.where(first, free, np.inf)), -self.brakes))
        pulls, brakes = np.full(self.n, np.inf), np.full(self.n, np.inf)
        np.minimum.at(pulls, front, self.pulls)
        np.minimum.at(brakes, front, self.brakes)
        wish = (self._wish(v, view, traffic, formed) - v) / self.step_s
        rate = np.minimum(np.maximum(wish, -brakes), lowest)
        rate = np.maximum(np.minimum(rate, pulls), -v / self.step_s)[front]
        rate = np.where(traffic.standing, 0.0, rate)
        halted = ~led & (np.abs(speed) < HELD_MPS) & (rate <= 0.0)
        ordered_pace = references.pace._replace(acceleration=np.where(led, rate, 0.0))
        formed = formed._replace(references=convoys.references(ordered_pace, float(references.breaks[0, 0])))
        outside = ~np.isnan(commanded)
        ordered = np.where(led, np.nan, np.where(outside, commanded, rate))
        return Driven(ordered, traffic.standing | (halted & ~(outside & (commanded > 0.0)))), formed

    def _wish(self, v: Floats, view: View, traffic: Traffic, formed: Formed) -> Floats:
        """Speed every first train would like to have: the cruising speed, or one that brings it to its place behind a formation."""
        p, other, cruise = self.p, view.ahead.train, self.p.cruise
        wish, cooperates = cruise.copy(), p.roster.cooperates
        near = np.flatnonzero(
            (other >= 0) & cooperates & cooperates[other] & ~traffic.stopping & ~traffic.stopping[other]
            & (v[other] > CRAWLS * cruise[other]) & (view.ahead.spacing <= p.driving.join_range_m) & (formed.ahead != other)
        )  # fmt: skip
        j = other[near]
        error = view.ahead.spacing[near] - p.spacing.desired
        behind = np.full(self.n, np.inf)  # how much farther apart than wanted the next one runs that wants to join
        np.minimum.at(behind, convoys.fronts(formed.ahead)[j], np.where(error > 0.0, error, np.inf))
        yields, cruising = behind[near] < error, cruise[near]
        most = np.minimum(cruising + np.where(yields, HASTE, 1.0) * p.driving.catch_up_mps, p.roster.top_speed[near])
        most = np.minimum(most, cruising + np.maximum(ROOM_FOR_HASTE * (p.bounds.speed_upper[near] - cruising), 0.0))
        most = np.where(yields | formed.led[near], np.minimum(most, self.maximum), most)
        wish[near] = np.clip(v[j] + convoys.closing_speed(error), 0.0, most)
        return wish
