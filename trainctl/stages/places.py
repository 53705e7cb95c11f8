"""Whether there is room at the place of a train that is to come: no train is under it, and none must brake hard for it."""

from __future__ import annotations

import numpy as np

from trainctl.railway import authority, supervisor
from trainctl.railway.authority import View
from trainctl.railway.supervisor import Targets
from trainctl.scenario.model import Model
from trainctl.signals import Bools, Floats


class Room:
    """What is asked of a place; a ``view`` has the train at it."""

    def __init__(self, p: Model) -> None:
        self.rules, self.assumed = p.driver_rules, p.relied_on_by_driver
        self.step_s, self.theta, self.greatest_mps2 = p.scenario.run.step_s, p.step_theta, p.supervision.greatest_mps2

    def under(self, i: int, speed: Floats, view: View, after: float) -> bool:
        """Whether another would be under train ``i`` or its rear by the time it comes, ``after`` so many seconds.

        Until then it makes no way, whatever its speed, and whoever follows it may run on.
        """
        met = authority.of(view.clear, view.clear.other == i)
        gains = self.theta * (self.greatest_mps2 + self.assumed.scatter) * after
        way = (np.maximum(speed, 0.0) + gains + self.assumed.drift) * after
        return bool(np.any(met.room < np.where(met.kind == supervisor.TRAIN, way[met.train] + self.rules.margin_m, 0.0)))

    def startles(self, i: int, entry: float, speed: Floats, view: View) -> bool:
        """Whether others would have to brake hard for a train that comes with the speed ``entry``."""
        trial = speed.copy()
        trial[i] = entry
        behind = view.targets.other == i
        if not behind.any():
            return False
        asked, clear = (_as_fast(authority.of(t, t.other == i), entry) for t in (view.targets, view.clear))
        seen = authority.judge(
            self.rules, trial, asked, clear, supervisor.no_limits(), self.step_s, self.theta, self.assumed, np.zeros(len(speed))
        )
        return bool(np.any(seen.emergency[view.targets.train[behind]]))

    def returns(self, i: int, speed: Floats, view: View) -> bool:
        """Whether a parked train finds its place on the track free."""
        ahead = authority.of(view.targets, (view.targets.train == i) & (view.targets.other >= 0))
        if np.any(ahead.room < self.rules.margin_m) or view.fouling[i] or np.any(view.clear.room[view.clear.other == i] < 0.0):
            return False
        return not self.startles(i, 0.0, speed, view)


def _as_fast(targets: Targets, speed: float) -> Targets:
    """Rows of one train that runs with ``speed`` once it is there, whatever was believed of it before."""
    return targets._replace(speed=np.where(targets.kind == supervisor.TRAIN, speed, targets.speed))


def meets(view: View, i: int, guests: Bools) -> bool:
    """Whether what ``view`` says of train ``i`` may be owed to another one of the ``guests`` (n,)."""
    if view.fouling[i] or (view.ahead.train[i] >= 0 and guests[view.ahead.train[i]]):
        return True
    for t in (view.targets, view.clear):
        met = np.concatenate([t.other[t.train == i], t.train[t.other == i]])
        if guests[met[met >= 0]].any():
            return True
    return False
