"""What was violated in a run, how often and how far, and what of it fails the run: the one list that exit codes go by."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

#: Bounds as events name them: room to the train ahead; the line's speed limit; a collision that SUMO counted and we did not.
GAP, LIMIT, COUNTED = "gap_m", "line_speed_mps", "sumo_collision"


class Tally(NamedTuple):
    """What was violated so far, in plain JSON; updated in place."""

    violated: dict[str, dict[str, int]]  # bound -> who -> steps or rows in which it was violated; of a pair in order of its ids
    first: dict[str, Any]  # the first violation: time [s], bound, who, value, limit; empty: none
    worst: dict[str, dict[str, Any]]  # by bound, the farthest overlap and overspeed: time [s], who, value, limit
    pairs: list[list[str]]  # trains that collided

    @classmethod
    def empty(cls) -> Tally:
        """Nothing was violated."""
        return cls({}, {}, {}, [])

    def once(self, time: float, bound: str, who: str, value: float, limit: float, **more: Any) -> Iterator[dict[str, Any]]:
        """Count something violated; the first time it is given back, as fields of an event."""
        pair = sorted(more.get("trains", ()))
        counts, name = self.violated.setdefault(bound, {}), "-".join(pair) if pair else who
        seen = counts.get(name, 0)
        counts[name] = seen + 1
        told = {"who": who, "value": value, "limit": limit}
        if bound in (GAP, LIMIT):
            known = self.worst.get(bound)
            if known is None or abs(value - limit) > abs(known["value"] - known["limit"]):
                self.worst[bound] = {"time_s": time, **told}
        if not seen:
            if pair and pair not in self.pairs:
                self.pairs.append(pair)
            if not self.first or time < self.first["time_s"]:
                self.first.update({"time_s": time, "bound": bound, **told})
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
        collisions, overspeeds = len(self.pairs), len(self.violated.get(LIMIT, {}))
        failed = {
            "collision": collisions > 0, "overspeed": overspeeds > 0 and supervised, "gridlock": more.get("gridlocks", 0) > 0,
        }  # fmt: skip
        return {
            "violations": sum(map(len, self.violated.values())), "first_violation": self.first or None, "collisions": collisions,
            "overspeeds": overspeeds, **more, "worst": self.worst,
            "checks_failed": [name for name, is_so in failed.items() if is_so],
        }  # fmt: skip
