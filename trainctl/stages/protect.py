"""Protection: the supervisor tries the step without what disturbs it, and bounds what would be too much.

A law that is evaluated within the step may ask for something else once the step is taken: it sees what disturbs its train, and
that another train does what is ordered, not what it tried. So such a step is looked at again: whoever is beyond its bounds by more
than what disturbs it may add is bounded too, and the step taken anew; the second time all trains are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from trainctl.railway import authority, supervisor
from trainctl.railway.authority import View
from trainctl.railway.supervisor import KINDS, applied
from trainctl.scenario.model import Model
from trainctl.signals import SPEED, Bools, Disturbed, Floats
from trainctl.stages import plant
from trainctl.stages.driver import Driven
from trainctl.stages.record import Journal

#: The plant over this step, for ordered accelerations (n,) and what disturbs: (ordered, disturbed, state, calm).
OverTheStep = Callable[[Floats, Disturbed, plant.State, bool], plant.Moved]


class Protect:
    """The supervisor of a run: bounds accelerations, and reports when it begins and ends to do so."""

    def __init__(self, p: Model, journal: Journal, disturbing: bool) -> None:
        self.p, self.rules, self.journal = p, p.supervision, journal
        self.disturbing = disturbing
        self.reacts = not p.sampled  # the law is evaluated within the step

    def step(
        self, t: float, view: View | None, own: Floats, acceleration: Floats, swing: Floats, driven: Driven, stands: Bools,
        disturbed: Disturbed,
        state: plant.State, acting: Bools, over_the_step: OverTheStep,
    ) -> tuple[plant.Moved, Bools]:  # fmt: skip
        """The plant over one step within what the supervisor allows, and the trains (n,) it acts on.

        Parameters
        ----------
        t : float
            Now [s].
        view : View or None
            What is ahead; None: no train looks ahead or is protected.
        own : ndarray, shape (U, s)
            State of all units.
        acceleration, swing : ndarray, shape (n,)
            Of every train now [m/s2], and what its couplers may still give its head [m/s].
        driven : Driven
            What drivers order; NaN: as the law demands.
        stands : ndarray of bool, shape (n,)
            Trains that are held where they are, or are not there.
        disturbed : Disturbed
            What acts in this step. The supervisor only knows the error of a measured position as that position.
        state : plant.State
            Of the plant.
        acting : ndarray of bool, shape (n,)
            Trains it acted on in the step before.
        over_the_step : callable
            The plant.
        """
        if view is None or self.rules.mode == "off":
            return over_the_step(driven.ordered, disturbed, state, False), acting
        verdict = self._verdict(view, own[self.p.leading, SPEED], acceleration, swing, disturbed.measurement)
        calm = disturbed.calm() if self.disturbing else disturbed
        moved = over_the_step(driven.ordered, calm, plant.copied(state), True)
        within, acts = applied(verdict, moved.motion.asked)
        acts &= ~stands
        on = self.rules.mode == "on"
        if (on and acts.any()) or self.disturbing:
            ordered = np.where(acts, within, driven.ordered) if on else driven.ordered
            if on and self.reacts:
                moved, acts = self._again(verdict, ordered, driven, stands, acts, disturbed, state, over_the_step)
            else:
                moved = over_the_step(ordered, disturbed, state, False)
        self._tell(t, verdict, acts, acting, view, own[self.p.leading, SPEED])
        return moved, acts

    def _again(
        self, verdict: supervisor.Verdict, ordered: Floats, driven: Driven, stands: Bools, acts: Bools, disturbed: Disturbed,
        state: plant.State, over_the_step: OverTheStep,
    ) -> tuple[plant.Moved, Bools]:  # fmt: skip
        """The step, taken until no train that is left to its law is beyond its bounds; it and the trains (n,) acted on."""
        scatter, bounded = self.p.assumed.scatter, acts | ~np.isnan(driven.ordered) | stands
        loose = verdict._replace(
            maximum=verdict.maximum + scatter, minimum=verdict.minimum - scatter, strongest=verdict.strongest - scatter
        )
        again = False
        while True:
            moved = over_the_step(ordered, disturbed, plant.copied(state), False)
            asked = moved.motion.asked
            beyond = applied(loose, asked + disturbed.speed / self.p.scenario.run.step_s)[1] & ~bounded
            if not beyond.any():
                return moved, acts
            acts, now = acts | beyond, ~bounded if again else beyond
            ordered, bounded = np.where(now, applied(verdict, asked)[0], ordered), bounded | now
            again = True

    def _verdict(self, view: View, speed: Floats, acceleration: Floats, swing: Floats, error: Floats) -> supervisor.Verdict:
        """What every train may do over the coming step; ``error`` (n,) is that of the measured positions [m]."""
        targets, limits = authority.measured(view.targets, view.limits, error)
        clear = targets if view.clear is view.targets else authority.measured(view.clear, view.limits, error)[0]
        return authority.judge(
            self.rules, speed, targets, clear, limits, self.p.scenario.run.step_s, self.p.step_theta, self.p.assumed, acceleration,
            swing,
        )  # fmt: skip

    def _tell(self, t: float, verdict: supervisor.Verdict, acts: Bools, acting: Bools, view: View, speed: Floats) -> None:
        """Events where it begins or ends to act."""
        ids, targets = self.p.scenario.ids, view.targets
        others, rooms = (np.concatenate(pair) for pair in ((targets.other, view.clear.other), (targets.room, view.clear.room)))
        for i in np.flatnonzero(acts & ~acting).tolist():
            reason, row = int(verdict.reason[i]), int(verdict.target[i])
            more: dict[str, Any] = {"reason": KINDS[reason] if reason >= 0 else "acceleration"}
            if 0 <= reason < len(KINDS) - 1:
                other = int(others[row])
                more |= {"room_m": float(rooms[row])} | ({"other": ids[other]} if other >= 0 else {})
            elif reason >= 0:
                more |= {"limit_mps": float(view.limits.speed[row]), "distance_m": float(view.limits.distance[row])}
            self.journal.event(
                t, "supervisor", train=ids[i], mode=self.rules.mode, emergency=bool(verdict.emergency[i]),
                speed_mps=float(speed[i]), **more,
            )  # fmt: skip
        for i in np.flatnonzero(acting & ~acts).tolist():
            self.journal.event(t, "supervisor_released", train=ids[i])
