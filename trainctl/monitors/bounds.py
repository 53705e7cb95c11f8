"""What must hold is watched while a run goes on: the first time anything breaks becomes an event; the metrics count afterwards.

Watched: speed and input bounds, link spacings, the constrained quantities of continuous laws, couplers, trains inside one another,
connected formations, and the balance of energies. That SUMO moved every train just as far as it was told is watched by the world
itself, and ends the run.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from trainctl.monitors.energy import Balance
from trainctl.signals import Floats, Ints

if TYPE_CHECKING:
    from trainctl.prepare import Prepared
    from trainctl.record.journal import Row

#: Rounding of positions on a line of some hundred kilometres, as SUMO hands them back.
ROUNDING = 1e-6

Alarm = dict[str, Any]


class Alarms:
    """Which bounds have been broken so far, and how often (steps).

    Attributes
    ----------
    count : dict
        (bound, who) -> number of steps or rows in which it was broken.
    first : dict or None
        The first violation: time [s], bound, who, value, limit.
    """

    def __init__(self, p: Prepared) -> None:
        n = len(p.scenario.train)
        self.p = p
        self.count: dict[tuple[str, str], int] = {}
        self.first: Alarm | None = None
        self.neighbours: Ints = np.zeros((2, 0), np.int64)  # (ahead, behind) on one track, a step ago
        self.length = p.consists.train_length()
        units = p.scenario.plant.kind != "point"
        self.watched: tuple[str, ...] = tuple(getattr(p.law, "WATCHED", ())) if units and not p.sampled else ()
        # (lower and upper, n, q): of the interval the extremes are of, and of the present links
        free = np.stack([np.full((n, len(self.watched)), -np.inf), np.full((n, len(self.watched)), np.inf)])
        self.during, self.now = free, free.copy()
        self.energy = Balance(p) if units else None

    @property
    def total(self) -> int:
        """Number of bounds broken at least once."""
        return len(self.count)

    def new(self, row: Row) -> Iterator[Alarm]:
        """Bounds broken in this row for the first time, as fields of an event."""
        for alarm in self._all(row):
            if self.first is None:
                self.first = {"time_s": row.time, **alarm}
            yield alarm

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
            for alarm in self._once("connected_pieces", who, float((pairs == key).sum()), 1.0):
                if self.first is None:
                    self.first = {"time_s": time, **alarm}
                yield alarm

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
        if self.p.roster is None and self.p.supervision.mode == "off":  # otherwise ``overlaps`` tells, edge by edge
            yield from self._collisions(row)
        links = row.links
        spacing = row.seen.position[links.sender] - row.seen.position[links.receiver]
        ahead = spacing > 0.0  # each pair once
        for key, bound, broken in (
            ("spacing_lower_m", links.lower, spacing < links.lower - ROUNDING),
            ("spacing_upper_m", links.upper, spacing > links.upper + ROUNDING),
        ):
            for k in np.flatnonzero(broken & ahead).tolist():
                yield from self._once(key, f"{ids[links.sender[k]]}-{ids[links.receiver[k]]}", float(spacing[k]), float(bound[k]))

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
                yield from self._once(key, f"{p.scenario.ids[i]}.{u - p.consists.first[i] + 1}", float(value[u]), bound)

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
                yield from self._once(f"{stem}_{side}_{unit}", self.p.scenario.ids[i], float(value[i, q]), float(bound[i, q]))

    def _energies(self, row: Row) -> Iterator[Alarm]:
        """Trains whose energy changes by something else than what is accounted for."""
        if self.energy is None:
            return
        for i, share in self.energy.broken(row):
            yield from self._once("energy_balance_share", self.p.scenario.ids[i], share, self.energy.LIMIT)

    def overlaps(self, time: float, room: Floats, body: Ints) -> Iterator[Alarm]:
        """Trains inside one another: ``room`` (n,) [m] from each front to the train ``body`` (n,) ahead on its way."""
        for i in np.flatnonzero(room < -ROUNDING).tolist():
            for alarm in self._once("gap_m", f"{self.p.scenario.ids[body[i]]}-{self.p.scenario.ids[i]}", float(room[i]), 0.0):
                if self.first is None:
                    self.first = {"time_s": time, **alarm}
                yield alarm

    def _collisions(self, row: Row) -> Iterator[Alarm]:
        """Trains inside one another, whatever the law: in the order of the step before, so that passing through is seen too."""
        before, self.neighbours = self.neighbours, self._neighbours(row)
        for ahead, behind in (before,) if self.neighbours is before else (before, self.neighbours):
            gap = row.seen.position[ahead] - self.length[ahead] - row.seen.position[behind]
            for k in np.flatnonzero((row.track[ahead] == row.track[behind]) & (gap < -ROUNDING)).tolist():
                yield from self._once(
                    "gap_m", f"{self.p.scenario.ids[ahead[k]]}-{self.p.scenario.ids[behind[k]]}", float(gap[k]), 0.0
                )

    def _neighbours(self, row: Row) -> Ints:
        """Pairs of trains next to each other on one track; those of the step before (the same array), where they still hold."""
        x, track, (ahead, behind) = row.seen.position, row.track, self.neighbours
        pieces, tracks = len(track) - len(ahead), np.count_nonzero(np.bincount(track))
        if pieces == tracks and (track[ahead] == track[behind]).all() and (x[ahead] >= x[behind]).all():
            return self.neighbours
        order = np.lexsort((-x, track))
        beside = track[order[:-1]] == track[order[1:]]
        return np.stack([order[:-1][beside], order[1:][beside]])

    def _per_train(self, key: str, value: Floats, bound: Floats, broken: Any) -> Iterator[Alarm]:
        for i in np.flatnonzero(broken).tolist():
            yield from self._once(key, self.p.scenario.ids[i], float(value[i]), float(bound[i]))

    def _once(self, key: str, who: str, value: float, bound: float) -> Iterator[Alarm]:
        seen = self.count.get((key, who), 0)
        self.count[key, who] = seen + 1
        if not seen:
            yield {"bound": key, "who": who, "value": value, "limit": bound}

    def values(self) -> dict[str, Any]:
        """What it remembers, as plain JSON; the rest is in ``arrays``."""
        return {"count": [[*key, number] for key, number in self.count.items()], "first": self.first}

    def arrays(self) -> tuple[NDArray[Any], ...]:
        """Arrays it remembers."""
        return (self.neighbours, self.during, self.now, *(self.energy.arrays() if self.energy else ()))

    def restore(self, values: dict[str, Any], arrays: Sequence[NDArray[Any]]) -> None:
        """Remember what ``values`` and ``arrays`` told."""
        self.count = {(key, who): number for key, who, number in values["count"]}
        self.first = values["first"]
        self.neighbours, self.during, self.now = (a.copy() for a in arrays[:3])
        if self.energy is not None:
            self.energy.restore(arrays[3:])
