"""Bounds watched while a run goes on: the first time each is broken becomes an event; the metrics count them afterwards."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from trainctl.signals import Floats, Ints

if TYPE_CHECKING:
    from trainctl.prepare import Prepared
    from trainctl.record.journal import Row

#: Rounding of positions on a line of some hundred kilometres, as SUMO hands them back.
ROUNDING = 1e-6


@dataclass
class Alarms:
    """Which bounds have been broken so far, and how often (steps)."""

    count: dict[tuple[str, str], int] = field(default_factory=dict)
    neighbours: Ints = field(default_factory=lambda: np.zeros((2, 0), np.int64))  # (ahead, behind) on one track, a step ago

    @property
    def total(self) -> int:
        """Number of bounds broken at least once."""
        return len(self.count)

    def new(self, p: Prepared, row: Row) -> Iterator[dict[str, Any]]:
        """Bounds broken in this row for the first time, as fields of an event."""
        ids, links = p.scenario.ids, row.links
        speed, bounds = row.speed, p.bounds
        yield from self._per_train("speed_lower_mps", speed, bounds.speed_lower, speed < bounds.speed_lower - ROUNDING, ids)
        yield from self._per_train("speed_upper_mps", speed, bounds.speed_upper, speed > bounds.speed_upper + ROUNDING, ids)
        if row.motion is not None:
            u = row.motion.input
            yield from self._per_train("input_lower_mps2", u, bounds.input_lower, u < bounds.input_lower - ROUNDING, ids)
            yield from self._per_train("input_upper_mps2", u, bounds.input_upper, u > bounds.input_upper + ROUNDING, ids)
        yield from self._couplers(p, row)
        yield from self._collisions(p, row)
        spacing = row.seen.position[links.sender] - row.seen.position[links.receiver]
        ahead = spacing > 0.0  # each pair once
        names = [f"{ids[s]}-{ids[r]}" for s, r in zip(links.sender, links.receiver, strict=True)] if len(spacing) < 64 else None
        for key, bound, broken in (
            ("spacing_lower_m", links.lower, spacing < links.lower - ROUNDING),
            ("spacing_upper_m", links.upper, spacing > links.upper + ROUNDING),
        ):
            hit = np.flatnonzero(broken & ahead)
            for k in hit.tolist():
                who = names[k] if names else f"{ids[links.sender[k]]}-{ids[links.receiver[k]]}"
                yield from self._once(key, who, float(spacing[k]), float(bound[k]))

    def _couplers(self, p: Prepared, row: Row) -> Iterator[dict[str, Any]]:
        """Couplers beyond their range in any sub-step since the last row."""
        x, bounds = row.extremes, p.scenario.bounds
        if x is None or bounds.coupler_lower_m is None or bounds.coupler_upper_m is None:
            return
        for key, value, bound, broken in (
            ("coupler_lower_m", x.coupler_min, bounds.coupler_lower_m, x.coupler_min < bounds.coupler_lower_m),
            ("coupler_upper_m", x.coupler_max, bounds.coupler_upper_m, x.coupler_max > bounds.coupler_upper_m),
        ):
            for u in np.flatnonzero(broken).tolist():
                i = int(np.searchsorted(p.consists.first, u, side="right")) - 1
                yield from self._once(key, f"{p.scenario.ids[i]}.{u - p.consists.first[i] + 1}", float(value[u]), bound)

    def _collisions(self, p: Prepared, row: Row) -> Iterator[dict[str, Any]]:
        """Trains inside one another, whatever the law: in the order of the step before, so that passing through is seen too."""
        order = np.lexsort((-row.seen.position, row.track))
        beside = row.track[order[:-1]] == row.track[order[1:]]
        now = np.stack([order[:-1][beside], order[1:][beside]])
        for a, b in (self.neighbours, now):
            gap = row.seen.position[a] - p.consists.train_length()[a] - row.seen.position[b]
            for k in np.flatnonzero((row.track[a] == row.track[b]) & (gap < -ROUNDING)).tolist():
                yield from self._once("gap_m", f"{p.scenario.ids[a[k]]}-{p.scenario.ids[b[k]]}", float(gap[k]), 0.0)
        self.neighbours = now

    def _per_train(self, key: str, value: Floats, bound: Floats, broken: Any, ids: Any) -> Iterator[dict[str, Any]]:
        for i in np.flatnonzero(broken).tolist():
            yield from self._once(key, ids[i], float(value[i]), float(bound[i]))

    def _once(self, key: str, who: str, value: float, bound: float) -> Iterator[dict[str, Any]]:
        seen = self.count.get((key, who), 0)
        self.count[key, who] = seen + 1
        if not seen:
            yield {"bound": key, "who": who, "value": value, "limit": bound}
