"""Who waits for whom: reported when a wait grows long, and when trains wait for each other in a circle.

A train waits if it stands, not at its own stop, or is due to enter, or to come back from where it is parked, and cannot. What it
waits for is what forbids it to start: the train ahead, or whoever has the switch, or the block behind the signal it stands at. It
needs all of these to go first; so trains of which each waits for another one of them never go again by themselves.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from trainctl.railway import authority, supervisor
from trainctl.signals import Bools, Floats

if TYPE_CHECKING:
    from trainctl.railway.authority import View
    from trainctl.railway.interlocking import EndOfAuthority
    from trainctl.scenario.roster import Roster
    from trainctl.signals import Seen

#: Slower than this a train stands [m/s].
STANDS_MPS = 0.05

#: What is waited at; ``Wait.place`` is one of them.
TRAIN, SWITCH, SIGNAL, ENTRY, TURN, PARKED = "train", "switch", "signal", "entry", "turn", "parked"

#: A circle with a signal in it is reported once it has lasted so long [s]: a red that has only just come may go again by itself.
LASTS_S = 60.0


class Wait(NamedTuple):
    """A train and one thing it waits for."""

    train: int
    other: int  # whose it is, -1: not known
    edge: int  # where the other one stands, or the edge that must not be entered; -1: not known
    place: str | None  # None: it stands, and nothing that is known keeps it


def standing(here: Seen, speed: Floats, own_stop: Bools) -> Bools:
    """Trains (n,) on the net that stand, but not at their own stops."""
    stand: Bools = here.present & ~own_stop & (np.abs(speed) < STANDS_MPS)
    return stand


def waits(
    view: View, ends: EndOfAuthority, here: Seen, speed: Floats, rules: supervisor.Params, assumed: supervisor.Assumed, step: float,
    theta: float, own_stop: Bools,
) -> list[Wait]:  # fmt: skip
    """What forbids each train that stands to start.

    Parameters
    ----------
    view : View
        What is ahead of every train.
    ends : EndOfAuthority
        Where each movement authority ends, and for whom.
    here : Seen
        Where the trains are.
    speed : ndarray, shape (n,)
        Speeds [m/s].
    rules, assumed : Params, Assumed
        By which whoever starts them judges, and what is relied on.
    step, theta : float
        Step [s] and lead of the plant, as ``authority.judge`` takes them.
    own_stop : ndarray, shape (n,)
        Trains that stand at their own stops: they wait for none.
    """
    stand = standing(here, speed, own_stop)
    if not stand.any():
        return []
    found, none = [], np.zeros_like(speed)
    for switch in (False, True):  # a train may be kept by both, then it needs both
        parts = [authority.of(t, stand[t.train] & ((t.other < 0) == switch)) for t in (view.targets, view.clear)]
        # To follow what joins ahead, or to keep clear of it: either will do.
        ways = parts[:1] if view.targets is view.clear else parts
        verdicts = [authority.judge(rules, none, t, t, supervisor.no_limits(), step, theta, assumed, none) for t in ways]
        kept = np.logical_and.reduce([stand & (v.reason >= 0) & (v.maximum * step < STANDS_MPS) for v in verdicts])
        for i in np.flatnonzero(kept).tolist():
            if switch:
                at = SIGNAL if verdicts[0].reason[i] == supervisor.SIGNAL else SWITCH
                found.append(Wait(i, int(ends.by[i]), int(ends.zone[i]), at))
            else:  # it goes once one of them does, so that counts which goes by itself
                others = [int(t.other[v.target[i]]) for t, v in zip(ways, verdicts, strict=True)]
                j = min(others, key=lambda other: stand[other])
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


def entries(roster: Roster, came: Bools, due: Sequence[int], t: float, ends: EndOfAuthority, out: Mapping[int, int]) -> list[Wait]:
    """What trains wait for that are to come and have not, of those ``due`` (the first on each edge) and the ones behind them.

    ``out`` says who keeps out those that no switch does.
    """
    if came.all():
        return []
    late = np.flatnonzero(~came & (roster.depart <= t + 1e-9)).tolist()
    first = {int(roster.edge[i]): i for i in reversed(due)} if late else {}
    found = []
    for i in late:
        edge = int(roster.edge[i])
        if first.get(edge, i) != i:
            found.append(Wait(i, first[edge], edge, ENTRY))
        elif ends.room[i] <= 0.0:
            found.append(Wait(i, int(ends.by[i]), int(ends.zone[i]), SWITCH))
        else:
            found.append(Wait(i, out.get(i, -1), edge, ENTRY))
    return found


def circles(found: Sequence[Wait]) -> list[list[int]]:
    """Trains that wait for each other: of each circle, or circles that hang together, the trains in ascending order."""
    edges = {(w.train, w.other) for w in found if w.other >= 0}
    while True:  # whoever waits for one that does not wait, or that no train waits for, is in no circle
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


class State(NamedTuple):
    """Waits reported so far; overwritten in place."""

    since: Floats  # (n,) s, since when every train waits, NaN: it does not
    told: Bools  # (n,) whether that has been reported
    counted: dict[str, Any]  # circles: lists of trains; forming: since when those not told yet last [s]; long: number of long waits


class Waiting:
    """Waits from step to step: each is reported once, a long one and a circle."""

    def __init__(self, ids: Sequence[str], edges: Sequence[str], limit_s: float) -> None:
        self.ids, self.edges, self.limit_s = ids, edges, limit_s

    def initial(self) -> State:
        """No train waits yet."""
        return State(np.full(len(self.ids), np.nan), np.zeros(len(self.ids), bool), {"circles": [], "forming": {}, "long": 0})

    def new(self, t: float, found: Sequence[Wait], due: Mapping[int, float], s: State) -> Iterator[tuple[str, dict[str, Any]]]:
        """Events at ``t`` [s], as kind and fields; ``due`` has the time since which trains wait that are to enter [s]."""
        if not found and np.isnan(s.since).all():
            return
        of = {w.train: w for w in reversed(found)}  # where a train waits for two, the first is told
        waits = np.zeros(len(self.ids), bool)
        waits[list(of)] = True
        s.told[:] &= waits
        s.since[:] = np.where(waits, np.where(np.isnan(s.since), t, s.since), np.nan)
        for i, planned in due.items():
            s.since[i] = planned
        for i in np.flatnonzero(waits & ~s.told & (t - s.since > self.limit_s)).tolist():
            s.told[i] = True
            s.counted["long"] += 1
            yield "waiting", {**self._words(of[i]), "since_s": float(s.since[i])}
        forming, s.counted["forming"] = s.counted["forming"], {}
        for circle in circles(found):
            if circle in s.counted["circles"]:
                continue
            inside = [w for w in found if w.train in circle and w.other in circle]
            since = forming.get(str(circle), t)
            if any(w.place == SIGNAL for w in inside) and t - since < LASTS_S:
                s.counted["forming"][str(circle)] = since
                continue
            s.counted["circles"].append(circle)
            yield "gridlock", {"trains": [self.ids[i] for i in circle], "waits": [self._words(w) for w in inside]}

    def _words(self, wait: Wait) -> dict[str, Any]:
        return {
            "train": self.ids[wait.train],
            "other": self.ids[wait.other] if wait.other >= 0 else None,
            "edge": self.edges[wait.edge] if wait.edge >= 0 else None,
            "place": wait.place,
        }
