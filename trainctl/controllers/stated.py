"""What the tables of a scenario say of its links: for laws that are put in front of traffic that was made for another."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

Tables = Mapping[str, Any]


def longest(data: Tables) -> float:
    """Length of the longest train [m]."""

    def length(kind: Tables) -> float:
        units, each = int(kind.get("units", 1)), kind.get("unit_length_m", 0.0)
        return float(sum(each)) if isinstance(each, list) else units * float(each)

    return max((length(kind) for kind in data.get("train_type", {}).values()), default=0.0)


def clear_distances(data: Tables) -> tuple[float, float, float]:
    """Minimum, wanted and maximum distance of two trains [m] from the bounds of the links, the first two less the longest train."""
    body = longest(data)
    places = [data.get("topology", {}), *data.get("link", ())]
    lower = [float(place["lower_m"]) for place in places if np.isfinite(place.get("lower_m", np.inf))]
    upper = [float(place["upper_m"]) for place in places if np.isfinite(place.get("upper_m", np.inf))]
    minimum = max(1.0, min(lower, default=1500.0 + body) - body)
    return minimum, float(data.get("topology", {}).get("spacing_m", 3000.0 + body)) - body, max([10000.0, *upper])


def errors_allowed(data: Tables) -> list[float]:
    """Bounds of the links less the desired spacing [m]."""
    topology = data.get("topology", {})
    found = []
    for place in (topology, *data.get("link", ())):
        desired = place.get("desired_m", topology.get("spacing_m"))
        if desired is not None:
            found += [float(place[key]) - float(desired) for key in ("lower_m", "upper_m") if np.isfinite(place.get(key, np.inf))]
    return found


def periods(run: Tables, wanted_s: float) -> float:
    """The multiple of the simulator's step nearest to a control period [s]."""
    return float(run["step_s"]) * max(1.0, round(wanted_s / float(run["step_s"])))
