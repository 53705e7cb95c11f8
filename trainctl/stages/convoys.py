"""The formation rule of trains on their own routes: virtually coupled, link by link, to the next one ahead.

A train whose route leads behind another one draws near until the law may take over, then it couples; it uncouples when another
train comes between, when its route branches off, and when it has to stop.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trainctl.railway import along
from trainctl.railway.authority import View
from trainctl.railway.supervisor import SIGNAL, SWITCH
from trainctl.scenario.model import Model
from trainctl.signals import POSITION, SPEED, Bools, Floats, Formed, Ints, Links, Pace, Reference, Seen, restrict
from trainctl.stages.record import Journal
from trainctl.stages.traffic import SOON_S, Around
from trainctl.stages.traffic import State as Traffic
from trainctl.topology import convoys

#: A train that waits to couple asks its law again after this [s].
ASK_AGAIN_S = 2.0

#: A formation dissolves this share of the cruising speed above the minimum speed its law can hold; to form it needs thrice that.
DISSOLVES = 0.02

#: A train that uncoupled does not couple again to the same one within this time [s].
APART_S = 30.0


class State(NamedTuple):
    """What trains remember of coupling, shape (n,)."""

    slot: Floats  # m, wanted position relative to the formation's reference
    ask_at: Floats  # s, when each may ask again
    parted: Ints  # the train each was coupled to before, -1: none
    refused: Ints  # the train the law did not let each couple to, as was reported, -1: none


class Convoys:
    """Couple and uncouple."""

    CHECKS = False  # the law was asked before trains coupled

    def __init__(self, p: Model, journal: Journal) -> None:
        self.p, self.journal, self.roster = p, journal, p.roster
        self.n, self.step_s, self.spacing = len(p.scenario.ids), p.scenario.run.step_s, p.spacing
        self.minimum = p.band[0]

    def initial(self) -> tuple[State, Formed]:
        """Every train alone, at its own speed."""
        n, own = self.n, self.p.own[self.p.leading]
        alone = convoys.references(Pace(own[:, POSITION], own[:, SPEED], np.zeros(n)), 0.0)
        formed = Formed(None, np.arange(n), np.full(n, -1), np.zeros(n, bool), np.zeros(n), alone, (), None)
        return State(np.zeros(n), np.zeros(n), np.full(n, -1), np.full(n, -1)), formed

    def step(
        self, t: float, seen: Seen, own: Floats, around: Around, traffic: Traffic, s: State, formed: Formed
    ) -> tuple[State, Formed, Floats, Seen, Links | None]:
        """Couple and uncouple trains.

        Returns
        -------
        tuple
            State, formations, ``own`` moved so that spacings are those along the routes, ``seen`` with these positions, and the new
            links, None where no formation changed.
        """
        assert around.view is not None
        p, view, before = self.p, around.view, formed.ahead
        asks = _Asking(s, formed, own.copy())
        held = np.zeros(self.n, bool)
        held[view.targets.train[np.isin(view.targets.kind, (SWITCH, SIGNAL)) & ~view.targets.moving]] = True
        willing = seen.present & self.roster.cooperates & ~traffic.stopping & ~traffic.standing & ~held
        for i in convoys.broken(asks.ahead, view.ahead.train, willing).tolist():
            j = int(asks.ahead[i])
            self._part(i, t, _why(i, j, seen.present, view.ahead.train), asks)
        for i in self._too_slow(asks).tolist():
            self._part(i, t, "the reference falls below what the law can hold", asks)
        free = convoys.candidates(asks.ahead, view.ahead.train, along.behind(view.ahead).train, willing & ~around.soon)
        free = free[(asks.ask_at[free] <= t) & ~self._slows_soon(own, view, asks)[free]]
        for i in free[self._fits(free, view, own)].tolist():
            self._ask(i, t, view, asks)
        own = asks.own
        alone, head = ~led(asks.ahead), own[p.leading]
        asks.slot[alone] = 0.0
        asks.pace.position[alone], asks.pace.speed[alone] = head[alone, POSITION], head[alone, SPEED]
        asks.pace.acceleration[alone] = 0.0
        seen = seen._replace(position=head[:, POSITION].copy())
        links = None
        if formed.links is None or not np.array_equal(before, asks.ahead):
            order = convoys.front_to_rear(asks.ahead)
            asks.slot = convoys.slots(asks.ahead, order, self.spacing.desired, asks.slot)
            links = convoys.links(asks.ahead, order, asks.slot, self.spacing)
            formed = formed._replace(formation=convoys.fronts(asks.ahead), led=~alone)
        formed = formed._replace(ahead=asks.ahead, offset=asks.offset, references=convoys.references(asks.pace, t))
        return State(asks.slot, asks.ask_at, asks.parted, asks.refused), formed, own, seen, links

    def after(self, formed: Formed) -> Formed:
        """A step later: every formation's reference has gone on as a train would that is ordered its acceleration."""
        pace, theta = formed.references.pace, self.p.step_theta
        speed = pace.speed + pace.acceleration * self.step_s
        way = ((1.0 - theta) * pace.speed + theta * speed) * self.step_s
        gone = pace._replace(position=pace.position + way, speed=speed)
        return formed._replace(references=convoys.references(gone, float(formed.references.breaks[0, 0]) + self.step_s))

    def _ask(self, i: int, t: float, view: View, asks: _Asking) -> None:
        """Couple ``i`` to the train ahead, if its law takes it."""
        ids, j, spacing = self.p.scenario.ids, int(view.ahead.train[i]), float(view.ahead.spacing[i])
        if convoys.fronts(asks.ahead)[j] == i:
            return
        asks.ask_at[i] = t + ASK_AGAIN_S
        reasons = self._try(i, j, spacing, t, asks)
        if not reasons:
            self.journal.event(t, "couple", train=ids[i], ahead=ids[j], spacing_m=spacing)
        elif asks.refused[i] != j:
            self.journal.event(t, "join_delayed", train=ids[i], ahead=ids[j], reasons=reasons)
        asks.refused[i] = j if reasons else -1

    def _fits(self, trains: Ints, view: View, own: Floats) -> Bools:
        """Whether spacing and speeds of these trains (k,) and those ahead of them are right for coupling."""
        p, d, speed = self.p, self.p.driving, own[self.p.leading, SPEED]
        inside = (p.bounds.speed_lower < speed) & (speed < p.bounds.speed_upper)
        ahead, spacing = view.ahead.train[trains], view.ahead.spacing[trains]
        closing = speed[ahead] - speed[trains]
        predicted = spacing + closing * (p.scenario.run.control_period_s or self.step_s)
        fits: Bools = (
            inside[trains]
            & inside[ahead]
            & (np.abs(spacing - self.spacing.desired) <= d.join_band_m)
            & (self.spacing.lower <= np.minimum(spacing, predicted))
            & (np.maximum(spacing, predicted) <= self.spacing.upper)
            & (np.abs(closing) <= d.join_band_mps)
        )
        return fits

    def _try(self, i: int, j: int, spacing: float, t: float, asks: _Asking) -> list[str]:
        """Couple ``i`` to ``j`` if the law's start condition holds for the longer formation; returns what it objects to."""
        p, front, own = self.p, convoys.fronts(asks.ahead), asks.own
        behind, before = np.flatnonzero(front == front[i]), np.flatnonzero(front == front[j])
        leading = p.leading
        shift = own[leading[j], POSITION] - spacing - own[leading[i], POSITION]
        moved = own.copy()
        units = np.repeat(np.isin(np.arange(self.n), behind), np.diff(p.consists.first))
        moved[units, POSITION] += shift
        ahead = asks.ahead.copy()
        ahead[i] = j
        order = convoys.front_to_rear(ahead)
        slot = convoys.slots(ahead, order, self.spacing.desired, asks.slot)
        lead = int(front[j])
        scene = p.scene(moved, convoys.links(ahead, order, slot, self.spacing), t)._replace(
            reference=Reference(np.array([t, np.inf]), np.array([[asks.pace.position[lead], asks.pace.speed[lead], 0.0]]))
        )
        members = np.sort(np.concatenate([before, behind]))
        reasons: list[str] = p.law.violations(p.params, restrict(scene, members))
        if not reasons:
            asks.ahead, asks.slot = ahead, slot
            asks.offset[behind] += shift
            own[units, POSITION] += shift
            for part in asks.pace:
                part[behind] = part[lead]
        return reasons

    def _part(self, i: int, t: float, why: str, asks: _Asking) -> None:
        ids = self.p.scenario.ids
        self.journal.event(t, "uncouple", train=ids[i], ahead=ids[int(asks.ahead[i])], reason=why)
        asks.parted[i], asks.ask_at[i] = asks.ahead[i], t + APART_S
        asks.ahead[i] = -1

    def _too_slow(self, asks: _Asking) -> Ints:
        """Coupled trains of formations whose reference nears the minimum speed the law can hold."""
        slow = asks.pace.speed < self.minimum + DISSOLVES * self.p.cruise
        return np.flatnonzero((asks.ahead >= 0) & slow[convoys.fronts(asks.ahead)])

    def _slows_soon(self, own: Floats, view: View, asks: _Asking) -> Bools:
        """Trains that must soon run slower than a formation can, or whose train ahead must."""
        speed, lowest = own[self.p.leading, SPEED], np.full(self.n, np.inf)
        lines = view.limits
        close = lines.distance < SOON_S * np.maximum(speed, 1.0)[lines.train]
        np.minimum.at(lowest, lines.train[close], self.p.driving.below(lines.speed[close]))
        slows = lowest < self.minimum + 3.0 * DISSOLVES * self.p.cruise
        found: Bools = slows | slows[convoys.fronts(asks.ahead)][view.ahead.train]
        return found


class _Asking:
    """Who is coupled to whom while trains part and ask, one after the other, within one instant."""

    def __init__(self, s: State, formed: Formed, own: Floats) -> None:
        self.ahead, self.offset, self.own = formed.ahead.copy(), formed.offset.copy(), own
        self.pace = Pace(*(part.copy() for part in formed.references.pace))
        self.slot, self.ask_at = s.slot.copy(), s.ask_at.copy()
        self.parted, self.refused = s.parted.copy(), s.refused.copy()


def led(ahead: Ints) -> Bools:
    """Trains the law drives: members of a formation of two or more."""
    member: Bools = ahead >= 0
    member[ahead[member]] = True
    return member


def _why(i: int, j: int, present: Bools, next_ahead: Ints) -> str:
    """Why ``i`` must uncouple from ``j``."""
    if not present[j]:
        return "the train ahead has left"
    if next_ahead[i] < 0:
        return "the train ahead has gone another way"
    return "one of the two stops or waits" if next_ahead[i] == j else "another train is ahead now"
