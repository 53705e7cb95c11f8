"""What was broken in a run, how often and how far, and what of it fails the run: the one list that exit codes go by."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from trainctl.monitors.on_track import GAP, LIMIT

#: Bound of a collision that SUMO counted and we did not.
COUNTED = "sumo_collision"


class Tally:
    """Bounds broken so far.

    Attributes
    ----------
    count : dict
        (bound, who) -> number of steps or rows in which it was broken; of a pair of trains ``who`` has them in order of their ids.
    first : dict or None
        The first violation: time [s], bound, who, value, limit.
    worst : dict
        Of overlaps and overspeeds the one that went farthest beyond its limit, by bound: time [s], who, value, limit.
    pairs : list of list of str
        Trains that collided.
    """

    def __init__(self) -> None:
        self.count: dict[tuple[str, str], int] = {}
        self.first: dict[str, Any] | None = None
        self.worst: dict[str, dict[str, Any]] = {}
        self.pairs: list[list[str]] = []

    def once(self, time: float, bound: str, who: str, value: float, limit: float, **more: Any) -> Iterator[dict[str, Any]]:
        """Count something broken; the first time it is given back, as fields of an event."""
        pair = sorted(more.get("trains", ()))
        key = bound, "-".join(pair) if pair else who
        seen = self.count.get(key, 0)
        self.count[key] = seen + 1
        told = {"who": who, "value": value, "limit": limit}
        if bound in (GAP, LIMIT):
            known = self.worst.get(bound)
            if known is None or abs(value - limit) > abs(known["value"] - known["limit"]):
                self.worst[bound] = {"time_s": time, **told}
        if not seen:
            if pair and pair not in self.pairs:
                self.pairs.append(pair)
            if self.first is None or time < self.first["time_s"]:
                self.first = {"time_s": time, "bound": bound, **told}
            yield {"bound": bound, **told, **more}

    def counted(self, time: float, found: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
        """A collision that SUMO counted, as ``World.collisions`` gives it, if its pair of trains has not been told before."""
        if sorted(found["trains"]) not in self.pairs:
            place = {key: value for key, value in found.items() if key != "time_s"}
            yield from self.once(time, COUNTED, "-".join(found["trains"]), 1.0, 0.0, **place)

    def outcome(self, supervised: bool, more: Mapping[str, int]) -> dict[str, Any]:
        """What run.json says of a finished run.

        Parameters
        ----------
        supervised : bool
            Whether the supervisor was on: then no train may be too fast for its line.
        more : mapping
            Numbers of gridlocks, waits and trains that did not enter.
        """
        collisions, overspeeds = len(self.pairs), [bound for bound, _ in self.count].count(LIMIT)
        failed = {
            "collision": collisions > 0, "overspeed": overspeeds > 0 and supervised, "gridlock": more.get("gridlocks", 0) > 0,
        }  # fmt: skip
        return {
            "violations": len(self.count), "first_violation": self.first, "collisions": collisions, "overspeeds": overspeeds,
            **more, "worst": self.worst, "checks_failed": [name for name, is_so in failed.items() if is_so],
        }  # fmt: skip

    def values(self) -> dict[str, Any]:
        """What it remembers, as plain JSON."""
        count = [[*key, number] for key, number in self.count.items()]
        return {"count": count, "first": self.first, "worst": self.worst, "pairs": self.pairs}

    def restore(self, values: Mapping[str, Any]) -> None:
        """Remember what ``values`` told."""
        self.count = {(bound, who): number for bound, who, number in values["count"]}
        self.first, self.worst = values["first"], dict(values["worst"])
        self.pairs = [list(pair) for pair in values["pairs"]]
