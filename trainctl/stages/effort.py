"""What a motion that was not ours has cost: force and work of every train, computed from its speeds and its own data.

The force of a step is ``m (rho a + R + g slope)`` with the acceleration a of the step, running resistance R and slope at its
beginning, mass m and rotating mass factor rho of the ``[train_type]``. SUMO's Euler step moves a train with the speed at its end;
work is force times the mean of both speeds, so that it balances with the kinetic energy.
"""

from __future__ import annotations

import numpy as np

from trainctl.plants import point
from trainctl.scenario.model import Model
from trainctl.signals import GRAVITY, POWERS, Floats, Motion, Observed


class Effort:
    """Masses, resistances and slopes of a scenario."""

    def __init__(self, p: Model) -> None:
        c, self.step_s = p.consists, p.scenario.run.step_s
        self.mass = c.train_mass()
        self.rotating = np.add.reduceat(c.mass * c.rotating, c.first[:-1]) / self.mass  # inertia over mass
        self.davis = point.constants(point.Params(), c).davis
        slopes = np.column_stack([p.line.gradient.breaks, p.line.gradient.slope])
        self.gradient = slopes if slopes[:, 1].any() else np.zeros((0, 2))
        self.slope = None if p.placed else p.rails.slope  # rise / run of every edge of a net

    def step(self, now: Observed, later: Observed) -> tuple[Motion, Floats]:
        """The motion from ``now`` to ``later``, and its energies [J], shape (n, 6) as ``POWERS``; 0 where a train came or left."""
        acceleration = (later.speed - now.speed) / self.step_s
        resistance, climbing = point.resistance(now.speed, self.davis), self._climbing(now)
        force = self.rotating * acceleration + resistance + climbing
        way = self.mass * 0.5 * (now.speed + later.speed) * self.step_s
        parts = {
            "traction": np.maximum(force, 0.0) * way, "braking": np.maximum(-force, 0.0) * way,
            "resistance": resistance * way, "gradient": climbing * way,
        }  # fmt: skip
        free = np.zeros(len(force), bool)  # no limit of ours acts
        motion = Motion(
            displacement=later.seen.position - now.seen.position, input=force, acceleration=acceleration, asked=acceleration,
            limited=free, clipped=free, force=None, extras={},
        )  # fmt: skip
        return motion, np.nan_to_num(np.stack([parts.get(power, 0.0 * way) for power in POWERS], axis=1))

    def _climbing(self, now: Observed) -> Floats:
        """Weight along the line per mass [N/kg]."""
        if self.slope is not None:
            return GRAVITY * self.slope[now.seen.edge]
        return point.climbing(now.seen.position, self.gradient)
