"""Who waits for whom: told when a wait grows long, and when trains wait for each other in a circle.

A train waits if it stands, not at its own stop, or is due to enter and cannot. What it waits for is what forbids it to start: the
train ahead, or whoever has the switch it stands at. It needs all of these to go first; so trains of which each waits for another
one of them never go again by themselves.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trainctl import lookout, supervisor
from trainctl.signals import Bools, Floats

if TYPE_CHECKING:
    from trainctl.lookout import View
    from trainctl.service import Service
    from trainctl.topology.claims import Held
    from trainctl.world import Seen

#: Slower than this a train stands [m/s].
STANDS_MPS = 0.05

#: What is waited at; ``Wait.place`` is one of them.
TRAIN, SWITCH, ENTRY = "train", "switch", "entry"


class Wait(NamedTuple):
    """A train and one thing it waits for."""

    train: int
    other: int  # whose it is, -1: nobody's that is known
    edge: int  # where the other one stands, or the edge that must not be entered; -1: not known
    place: str | None


def waits(
    view: View, held: Held, here: Seen, speed: Floats, rules: supervisor.Params, assumed: supervisor.Assumed, step: float,
    theta: float, own_stop: Bools,
) -> list[Wait]:  # fmt: skip
    """What forbids each train that stands to start.

    Parameters
    ----------
    view : View
        What is ahead of every train.
    held : Held
        Who is held at which switch, by whom.
    here : Seen
        Where the trains are.
    speed : ndarray, shape (n,)
        Speeds [m/s].
    rules, assumed : Params, Assumed
        By which whoever starts them judges, and what is relied on.
    step, theta : float
        Step [s] and lead of the plant, as ``lookout.judge`` takes them.
    own_stop : ndarray, shape (n,)
        Trains that stand at their own stops: they wait for nobody.
    """
    stand = here.present & ~own_stop & (np.abs(speed) < STANDS_MPS)
    if not stand.any():
        return []
    found, none = [], np.zeros_like(speed)
    for switch in (False, True):  # a train may be kept by both, then it needs both
        parts = [lookout.of(t, stand[t.train] & ((t.other < 0) == switch)) for t in (view.targets, view.clear)]
        targets, clear = parts[0], parts[0] if view.targets is view.clear else parts[1]
        verdict = lookout.judge(rules, none, targets, clear, supervisor.no_limits(), step, theta, assumed, none)
        others = np.concatenate([targets.other, clear.other])
        for i in np.flatnonzero(stand & (verdict.reason >= 0) & (verdict.greatest * step < STANDS_MPS)).tolist():
            if switch:
                found.append(Wait(i, int(held.by[i]), int(held.zone[i]), SWITCH))
            else:
                j = int(others[verdict.target[i]])
                found.append(Wait(i, j, int(here.edge[j]), TRAIN))
    return found


def kept_out(view: View, i: int) -> int:
    """The train because of which ``i`` cannot enter at its place, where ``view`` has it; -1: none."""
    t = view.targets
    ahead, behind = np.flatnonzero((t.train == i) & (t.other >= 0)), np.flatnonzero(t.other == i)
    rows = np.concatenate([ahead, behind])
    if not len(rows):
        return -1
    k = int(np.argmin(t.room[rows]))
    return int(t.other[rows[k]] if k < len(ahead) else t.train[rows[k]])


def entries(service: Service, t: float, held: Held, out: Mapping[int, int]) -> list[Wait]:
    """What trains wait for that are due and not on the net; ``out`` says who keeps out those that no switch does."""
    roster = service.roster
    late = np.flatnonzero(~service.came & (roster.depart <= t + 1e-9)).tolist()
    first = {int(roster.edge[i]): i for i in reversed(service.due(t))} if late else {}
    found = []
    for i in late:
        edge = int(roster.edge[i])
        if first.get(edge, i) != i:
            found.append(Wait(i, first[edge], edge, ENTRY))
        elif held.room[i] <= 0.0:
            found.append(Wait(i, int(held.by[i]), int(held.zone[i]), SWITCH))
        else:
            found.append(Wait(i, out.get(i, -1), edge, ENTRY))
    return found


def circles(found: Sequence[Wait]) -> list[list[int]]:
    """Trains that wait for each other: of each circle, or circles that hang together, the trains in ascending order."""
    edges = {(w.train, w.other) for w in found if w.other >= 0}
    while True:  # whoever waits for one that does not wait, or is waited for by nobody, is in no circle
        waiting, wanted = {i for i, _ in edges}, {j for _, j in edges}
        left = {(i, j) for i, j in edges if j in waiting and i in wanted}
        if left == edges:
            break
        edges = left
    if not edges:
        return []
    trains = sorted({i for i, _ in edges})
    number = {i: k for k, i in enumerate(trains)}
    reaches = np.zeros((len(trains), len(trains)), bool)
    for i, j in edges:
        reaches[number[i], number[j]] = True
    for k in range(len(trains)):
        reaches |= np.outer(reaches[:, k], reaches[k])
    both = reaches & reaches.T
    alike = {tuple(np.flatnonzero(both[k]).tolist()) for k in range(len(trains)) if both[k, k]}
    return [[trains[k] for k in one] for one in sorted(alike)]


class Waiting:
    """Waits from step to step: each is told once, a long one and a circle.

    Attributes
    ----------
    since : ndarray, shape (n,)
        Since when every train waits [s]; NaN: it does not.
    told : ndarray, shape (n,)
        Whether that has been told.
    circles : list of list of int
        Circles told so far.
    long : int
        Long waits told so far.
    """

    def __init__(self, ids: Sequence[str], edges: Sequence[str], limit_s: float) -> None:
        self.ids, self.edges, self.limit_s = ids, edges, limit_s
        self.since, self.told = np.full(len(ids), np.nan), np.zeros(len(ids), bool)
        self.circles: list[list[int]] = []
        self.long = 0

    def new(self, t: float, found: Sequence[Wait], due: Mapping[int, float]) -> Iterator[tuple[str, dict[str, Any]]]:
        """Events at ``t`` [s], as kind and fields; ``due`` has the time since which trains wait that are to enter [s]."""
        of = {w.train: w for w in reversed(found)}  # where a train waits for two, the first is told
        waits = np.zeros(len(self.ids), bool)
        waits[list(of)] = True
        self.told &= waits
        self.since = np.where(waits, np.where(np.isnan(self.since), t, self.since), np.nan)
        for i, planned in due.items():
            self.since[i] = planned
        for i in np.flatnonzero(waits & ~self.told & (t - self.since > self.limit_s)).tolist():
            self.told[i] = True
            self.long += 1
            yield "waiting", {**self._words(of[i]), "since_s": float(self.since[i])}
        for circle in circles(found):
            if circle not in self.circles:
                self.circles.append(circle)
                inside = [w for w in found if w.train in circle and w.other in circle]
                yield "gridlock", {"trains": [self.ids[i] for i in circle], "waits": [self._words(w) for w in inside]}

    def _words(self, wait: Wait) -> dict[str, Any]:
        return {
            "train": self.ids[wait.train],
            "other": self.ids[wait.other] if wait.other >= 0 else None,
            "edge": self.edges[wait.edge] if wait.edge >= 0 else None,
            "place": wait.place,
        }

    def values(self) -> dict[str, Any]:
        """What it remembers, as plain JSON; the rest is in ``arrays``."""
        return {"circles": self.circles, "long": self.long}

    def arrays(self) -> tuple[NDArray[Any], ...]:
        """Arrays it remembers."""
        return self.since, self.told

    def restore(self, values: Mapping[str, Any], arrays: Sequence[NDArray[Any]]) -> None:
        """Remember what ``values`` and ``arrays`` told."""
        self.circles, self.long = [list(one) for one in values["circles"]], values["long"]
        self.since, self.told = (a.copy() for a in arrays)
