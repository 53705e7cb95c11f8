"""Balance of energies: kinetic and coupler energy of a train may change by its integrated powers only."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from trainctl.signals import POSITION, SPEED, Floats, Row

if TYPE_CHECKING:
    from trainctl.scenario.model import Model
    from trainctl.signals import Row

#: Signs of ``signals.POWERS`` in the balance.
SIGNS = np.array([1.0, -1.0, -1.0, -1.0, -1.0, 1.0])

#: Share of the stored energy that is rounding.
ROUNDING = 1e-9
#: Less energy than this is none [J].
TINY_J = 1e-6


class State(NamedTuple):
    """What is remembered, shape (n,) each; its arrays are overwritten in place."""

    stored: (
        Floats  # J, kinetic and coupler energy at the last row; NaN before the first, and of trains that are not there or not ours
    )
    drift: Floats  # J, energy that came from nowhere since the start
    turnover: Floats  # J, sum of all integrated powers' sizes
    kicked: Floats  # J, energy that speed disturbances have given since the last row


class Balance:
    """What each train's energy changed by, less what its powers say, since the start."""

    #: Largest share of the turnover that may come from nowhere.
    LIMIT = 1e-3

    def __init__(self, p: Model) -> None:
        c = p.consists
        self.leading, self.units = c.first[:-1], np.diff(c.first)
        self.inertia, self.length = c.mass * c.rotating, c.length[:-1]
        self.half_inertia, self.half_stiffness = 0.5 * self.inertia, 0.5 * c.stiffness[:-1]
        self.half_stiffness[c.first[1:-1] - 1] = 0.0  # no coupler behind the last unit
        self.ours = ~p.roster.driven

    def initial(self) -> State:
        """Nothing seen yet."""
        n = len(self.leading)
        return State(np.full(n, np.nan), np.zeros(n), np.zeros(n), np.zeros(n))

    def energy(self, own: Floats) -> Floats:
        """Kinetic and coupler energy of every train [J], shape (n,)."""
        each = self.half_inertia * own[:, SPEED] ** 2
        stretch = own[:-1, POSITION] - own[1:, POSITION] - self.length
        each[:-1] += self.half_stiffness * stretch**2
        total: Floats = np.add.reduceat(each, self.leading)
        return total

    def violated(self, row: Row, s: State) -> Iterator[tuple[int, float]]:
        """Trains out of balance now, and by which share of their turnover. Every step's row must come by."""
        if row.extremes is not None:
            now = self.energy(row.own)
            accounted = row.extremes.energy @ SIGNS + s.kicked
            known = ~np.isnan(s.stored)  # neither the first row nor a train that has just come
            np.add(s.drift, now - s.stored - accounted, out=s.drift, where=known)
            s.stored[:] = np.where(row.seen.present & self.ours, now, np.nan)
            s.kicked[:] = 0.0
            np.add(s.turnover, np.abs(row.extremes.energy).sum(axis=1), out=s.turnover, where=known)
            out = np.abs(s.drift) > self.LIMIT * s.turnover + ROUNDING * now
            for i in out.nonzero()[0].tolist():
                yield i, float(s.drift[i] / max(s.turnover[i], ROUNDING * now[i], TINY_J))
        if row.disturbed is not None and row.disturbed.speed.any():
            kick = np.repeat(row.disturbed.speed, self.units)
            s.kicked[:] += np.add.reduceat(self.inertia * (row.own[:, SPEED] + 0.5 * kick) * kick, self.leading)
