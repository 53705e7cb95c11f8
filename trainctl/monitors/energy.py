"""Balance of energies: kinetic and coupler energy of a train may change by its integrated powers only."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from trainctl.signals import POSITION, SPEED, Floats

if TYPE_CHECKING:
    from trainctl.scenario.build import Prepared
    from trainctl.stages.record import Row

#: Signs of ``signals.POWERS`` in the balance.
SIGNS = np.array([1.0, -1.0, -1.0, -1.0, -1.0, 1.0])

#: Share of the stored energy that is rounding.
ROUNDING = 1e-9


class Balance:
    """What each train's energy changed by, less what its powers say, since the start.

    Attributes
    ----------
    stored : ndarray, shape (n,)
        Kinetic and coupler energy at the last row [J]; NaN before the first, and of trains that are not there.
    drift : ndarray, shape (n,)
        Energy that came from nowhere since the start [J].
    turnover : ndarray, shape (n,)
        Sum of all integrated powers' sizes [J].
    kicked : ndarray, shape (n,)
        Energy that speed disturbances have given since the last row [J].
    """

    #: Largest share of the turnover that may come from nowhere.
    LIMIT = 1e-3

    def __init__(self, p: Prepared) -> None:
        c, n = p.consists, len(p.scenario.train)
        self.heads, self.units = c.first[:-1], np.diff(c.first)
        self.inertia, self.stiffness, self.length = c.mass * c.rotating, c.stiffness.copy(), c.length
        self.stiffness[c.first[1:] - 1] = 0.0  # no coupler behind the last unit
        self.stored, self.drift, self.turnover, self.kicked = np.full(n, np.nan), np.zeros(n), np.zeros(n), np.zeros(n)

    def energy(self, own: Floats) -> Floats:
        """Kinetic and coupler energy of every train [J], shape (n,)."""
        each = 0.5 * self.inertia * own[:, SPEED] ** 2
        stretch = own[:-1, POSITION] - own[1:, POSITION] - self.length[:-1]
        each[:-1] += 0.5 * self.stiffness[:-1] * stretch**2
        total: Floats = np.add.reduceat(each, self.heads)
        return total

    def broken(self, row: Row) -> Iterator[tuple[int, float]]:
        """Trains out of balance now, and by which share of their turnover. Every step's row must come by."""
        if row.extremes is not None:
            now = self.energy(row.own)
            accounted = row.extremes.energy @ SIGNS + self.kicked
            known = ~np.isnan(self.stored)  # neither the first row nor a train that has just come
            self.drift[known] += (now - self.stored - accounted)[known]
            self.stored = np.where(row.seen.present, now, np.nan)
            self.kicked = np.zeros_like(now)
            self.turnover[known] += np.abs(row.extremes.energy).sum(axis=1)[known]
            out = np.abs(self.drift) > self.LIMIT * self.turnover + ROUNDING * now
            for i in np.flatnonzero(out).tolist():
                yield i, float(self.drift[i] / max(self.turnover[i], ROUNDING * now[i]))
        if row.disturbed is not None and row.disturbed.speed.any():
            kick = np.repeat(row.disturbed.speed, self.units)
            self.kicked += np.add.reduceat(self.inertia * (row.own[:, SPEED] + 0.5 * kick) * kick, self.heads)

    def arrays(self) -> tuple[Floats, ...]:
        """What it remembers."""
        return self.stored, self.drift, self.turnover, self.kicked

    def restore(self, arrays: Sequence[Floats]) -> None:
        """Remember what ``arrays`` told."""
        self.stored, self.drift, self.turnover, self.kicked = (a.copy() for a in arrays)
