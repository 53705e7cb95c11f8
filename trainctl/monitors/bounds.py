"""What must hold is watched while a run goes on: the first time anything breaks becomes an event; the metrics count afterwards.

Watched: speed and input bounds, link spacings, the constrained quantities of continuous laws, couplers, trains inside one another,
the line's speed limits, connected formations, and the balance of energies; and who waits for whom. That SUMO moved every train just
as far as it was told is watched by the world itself, and ends the run.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from trainctl.monitors import on_track, waiting
from trainctl.monitors.energy import Balance
from trainctl.monitors.on_track import ROUNDING
from trainctl.monitors.outcome import Tally
from trainctl.monitors.waiting import Wait, Waiting
from trainctl.signals import Floats, Ints

if TYPE_CHECKING:
    from trainctl.lookout import View
    from trainctl.prepare import Prepared
    from trainctl.record.journal import Row
    from trainctl.service import Service
    from trainctl.topology.claims import Held
    from trainctl.topology.ways import Ways
    from trainctl.world import Seen

Alarm = dict[str, Any]


def _alarm(bound: str, who: str, value: float, limit: float) -> Alarm:
    return {"bound": bound, "who": who, "value": value, "limit": limit}


class Alarms:
    """What has been broken so far, and how often (steps).

    Attributes
    ----------
    tally : Tally
        What was broken, how often, and the worst of it.
    watch : Watch
        Trains inside one another, and too fast for their line.
    waiting : Waiting
        Who waits for whom.
    """

    def __init__(self, p: Prepared) -> None:
        n = len(p.scenario.train)
        self.p = p
        self.tally = Tally()
        self.watch = on_track.of(p)
        self.waiting = Waiting(p.scenario.ids, p.line.edges, p.driving.wait_limit_s)
        units = p.scenario.plant.kind != "point"
        self.watched: tuple[str, ...] = tuple(getattr(p.law, "WATCHED", ())) if units and not p.sampled else ()
        # (lower and upper, n, q): of the interval the extremes are of, and of the present links
        free = np.stack([np.full((n, len(self.watched)), -np.inf), np.full((n, len(self.watched)), np.inf)])
        self.during, self.now = free, free.copy()
        self.energy = Balance(p) if units else None

    def new(self, row: Row, ways: Ways, here: Seen) -> Iterator[Alarm]:
        """What is broken in this row for the first time, as fields of an event; ``here`` is where the world has the trains."""
        for alarm in chain(self._all(row), self.watch.broken(ways, here, row.speed)):
            yield from self.tally.once(row.time, **alarm)

    def counted(self, end: float, collisions: Sequence[Mapping[str, Any]]) -> Iterator[tuple[float, Alarm]]:
        """Time [s] and fields of events for the collisions of ``World.collisions`` that were not told before."""
        for found in collisions:
            at = end if found["time_s"] is None else found["time_s"]
            for alarm in self.tally.counted(at, found):
                yield at, alarm

    def relinked(self, time: float, groups: Sequence[Sequence[int]], formation: Ints, scene: Any) -> Iterator[Alarm]:
        """Take over the law's bounds on new links; a formation that is in pieces is told.

        Parameters
        ----------
        time : float
            Now [s].
        groups : sequence of sequence of int
            Trains that are connected by links, directly or not.
        formation : ndarray, shape (n,)
            The formation every train belongs to.
        scene : Scene
            For the law's ``watched_bounds``.
        """
        bounds = getattr(self.p.law, "watched_bounds", None)
        if self.watched and bounds is not None:
            self.now = np.stack(bounds(self.p.params, scene))
            if self.p.roster is not None:
                alone = np.bincount(scene.links.receiver, minlength=len(formation)) == 0
                self.now[0, alone], self.now[1, alone] = -np.inf, np.inf
        piece = np.empty(len(formation), np.int64)
        for k, group in enumerate(groups):
            piece[list(group)] = k
        whole = np.zeros_like(formation) if self.p.plan.rule == "links" else formation
        pairs = np.unique(np.stack([whole, piece]), axis=1)[0]
        for key in np.unique(pairs[1:][pairs[1:] == pairs[:-1]]).tolist():
            who = ",".join(self.p.scenario.ids[i] for i in np.flatnonzero(whole == key))
            yield from self.tally.once(time, bound="connected_pieces", who=who, value=float((pairs == key).sum()), limit=1.0)

    def _all(self, row: Row) -> Iterator[Alarm]:
        ids, bounds, speed = self.p.scenario.ids, self.p.bounds, row.speed
        led = True if row.led is None else row.led
        yield from self._per_train("speed_lower_mps", speed, bounds.speed_lower, led & (speed < bounds.speed_lower - ROUNDING))
        yield from self._per_train("speed_upper_mps", speed, bounds.speed_upper, led & (speed > bounds.speed_upper + ROUNDING))
        if row.motion is not None:
            u = row.motion.input
            yield from self._per_train("input_lower_mps2", u, bounds.input_lower, led & (u < bounds.input_lower - ROUNDING))
            yield from self._per_train("input_upper_mps2", u, bounds.input_upper, led & (u > bounds.input_upper + ROUNDING))
        yield from self._couplers(row)
        yield from self._constrained(row)
        yield from self._energies(row)
        links = row.links
        spacing = row.seen.position[links.sender] - row.seen.position[links.receiver]
        ahead = spacing > 0.0  # each pair once
        for key, bound, broken in (
            ("spacing_lower_m", links.lower, spacing < links.lower - ROUNDING),
            ("spacing_upper_m", links.upper, spacing > links.upper + ROUNDING),
        ):
            for k in np.flatnonzero(broken & ahead).tolist():
                yield _alarm(key, f"{ids[links.sender[k]]}-{ids[links.receiver[k]]}", float(spacing[k]), float(bound[k]))

    def _couplers(self, row: Row) -> Iterator[Alarm]:
        """Couplers beyond their range in any sub-step since the last row."""
        p, x, bounds = self.p, row.extremes, self.p.scenario.bounds
        if x is None or bounds.coupler_lower_m is None or bounds.coupler_upper_m is None:
            return
        for key, value, bound, broken in (
            ("coupler_lower_m", x.coupler_min, bounds.coupler_lower_m, x.coupler_min < bounds.coupler_lower_m),
            ("coupler_upper_m", x.coupler_max, bounds.coupler_upper_m, x.coupler_max > bounds.coupler_upper_m),
        ):
            for u in np.flatnonzero(broken).tolist():
                i = int(np.searchsorted(p.consists.first, u, side="right")) - 1
                yield _alarm(key, f"{p.scenario.ids[i]}.{u - p.consists.first[i] + 1}", float(value[u]), bound)

    def _constrained(self, row: Row) -> Iterator[Alarm]:
        """The law's own constrained quantities in any sub-step since the last row, against the bounds that held then."""
        x = row.extremes
        if not self.watched:
            return
        if x is None:  # not recorded: extremes go on, perhaps under new links, so the wider bounds serve
            lower, upper = np.minimum(self.during[0], self.now[0]), np.maximum(self.during[1], self.now[1])
            self.during = np.stack([lower, upper])
            return
        low, high = self.during
        self.during = self.now
        seen = x.watched_min <= x.watched_max
        for side, value, bound, broken in (
            ("lower", x.watched_min, low, seen & (x.watched_min < low - ROUNDING)),
            ("upper", x.watched_max, high, seen & (x.watched_max > high + ROUNDING)),
        ):
            for i, q in np.argwhere(broken).tolist():
                stem, _, unit = self.watched[q].rpartition("_")
                yield _alarm(f"{stem}_{side}_{unit}", self.p.scenario.ids[i], float(value[i, q]), float(bound[i, q]))

    def _energies(self, row: Row) -> Iterator[Alarm]:
        """Trains whose energy changes by something else than what is accounted for."""
        if self.energy is None:
            return
        for i, share in self.energy.broken(row):
            yield _alarm("energy_balance_share", self.p.scenario.ids[i], share, self.energy.LIMIT)

    def waits(
        self, t: float, here: Seen, speed: Floats, view: View, held: Held, service: Service | None, out: Mapping[int, int]
    ) -> Iterator[tuple[str, Alarm]]:
        """Long waits and circles, as kind and fields of events; arguments as of ``waiting.waits`` and ``waiting.entries``."""
        p, found, due = self.p, list[Wait](), dict[int, float]()
        rules = p.supervision if service is None else service.rules
        own_stop = np.zeros(len(speed), bool) if service is None else service.standing
        if service is not None or rules.mode == "on":  # otherwise nothing keeps a train from going on
            assumed = p.assumed if service is None else service.assumed
            found = waiting.waits(view, held, here, speed, rules, assumed, p.scenario.run.step_s, p.step_theta, own_stop)
        if service is not None:
            entries = waiting.entries(service, t, held, out)
            due = {w.train: float(service.roster.depart[w.train]) for w in entries}
            found += entries
        yield from self.waiting.new(t, found, due)

    def outcome(self, not_entered: int) -> dict[str, Any]:
        """What run.json says of a finished run; ``not_entered`` trains were due and never came."""
        more = {"gridlocks": len(self.waiting.circles), "waited_long": self.waiting.long, "not_entered": not_entered}
        return self.tally.outcome(self.p.supervision.mode == "on", more)

    def _per_train(self, key: str, value: Floats, bound: Floats, broken: Any) -> Iterator[Alarm]:
        for i in np.flatnonzero(broken).tolist():
            yield _alarm(key, self.p.scenario.ids[i], float(value[i]), float(bound[i]))

    def values(self) -> dict[str, Any]:
        """What it remembers, as plain JSON; the rest is in ``arrays``."""
        return {"tally": self.tally.values(), "waiting": self.waiting.values()}

    def arrays(self) -> tuple[NDArray[Any], ...]:
        """Arrays it remembers."""
        return (
            self.watch.last, self.during, self.now, *self.waiting.arrays(), *(self.energy.arrays() if self.energy else ()),
        )  # fmt: skip

    def restore(self, values: dict[str, Any], arrays: Sequence[NDArray[Any]]) -> None:
        """Remember what ``values`` and ``arrays`` told."""
        self.tally.restore(values["tally"])
        self.watch.last, self.during, self.now = (a.copy() for a in arrays[:3])
        self.waiting.restore(values["waiting"], arrays[3:5])
        if self.energy is not None:
            self.energy.restore(arrays[5:])
