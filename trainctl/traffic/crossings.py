"""Where routes cross without a junction that says so: nothing keeps trains apart there, nor does SUMO."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sumo_net.netfile import NetFile, for_trains

#: As many places are named.
NAMED = 5
#: Tracks that far above each other are a bridge [m].
BRIDGE_M = 3.0

Points = NDArray[np.float64]


class _Track(NamedTuple):
    """An edge of a route."""

    ends: tuple[str, str]  # its junctions
    shape: Points  # (P, 3) m


def told(net: NetFile, routes: Iterable[tuple[str, ...]]) -> list[str]:
    """Lines about the places where ``routes`` cross unseen: on junctions without edges inside, and between junctions."""
    routes = list(dict.fromkeys(routes))
    tracks = _tracks(net, {e for route in routes for e in route})
    lines = []
    if on := _on_junctions(net, tracks, {pair for route in routes for pair in pairwise(route)}):
        lines.append(f"net: tracks cross on {_some(on)} without edges inside: nothing keeps trains apart there")
    if between := _between(tracks):
        lines.append(
            f"net: tracks cross without a junction at {_some(between)}: nothing keeps trains apart there; fine for bridges"
        )
    return lines


def _some(names: list[str]) -> str:
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")


def _tracks(net: NetFile, used: set[str]) -> dict[str, _Track]:
    found = {}
    for edge in net.edges:
        name = edge.attributes.get("id", "")
        lane = next((lane for lane in edge.lanes if for_trains(lane, anybody=True)), None) if name in used else None
        if lane is not None:
            points = [[float(v) for v in point.split(",")] for point in lane.get("shape", "").split()]
            shape = np.array([(*p, 0.0)[:3] for p in points]).reshape(-1, 3)
            found[name] = _Track((edge.attributes.get("from", ""), edge.attributes.get("to", "")), shape)
    return found


def _on_junctions(net: NetFile, tracks: dict[str, _Track], steps: set[tuple[str, str]]) -> list[str]:
    """Junctions without edges inside on which two ways of ``steps`` (from edge, to edge) cross."""
    through = {(c.get("from", ""), c.get("to", "")) for c in net.connections if c.get("via")}
    at: dict[str, list[tuple[str, str]]] = {}
    for a, b in sorted(steps - through):
        if a in tracks and b in tracks and tracks[a].ends[1] == tracks[b].ends[0]:
            at.setdefault(tracks[a].ends[1], []).append((a, b))
    places = {j.attributes.get("id", ""): j.attributes for j in net.junctions}
    found = []
    for junction, ways in at.items():
        middle = np.array([float(places.get(junction, {}).get(key, "nan")) for key in "xy"])

        def angle(edge: str, point: int, middle: Points = middle) -> float:
            x, y = tracks[edge].shape[point, :2] - middle
            return math.atan2(y, x)

        for (a, b), (c, d) in combinations(ways, 2):
            if a != c and b != d and _interleave(angle(a, -2), angle(b, 1), angle(c, -2), angle(d, 1)):
                found.append(f"junction {junction} ({a} to {b}, {c} to {d})")
                break
    return found


def _interleave(a: float, b: float, c: float, d: float) -> bool:
    """Whether a way between the directions a and b and one between c and d cross."""
    span = (b - a) % math.tau
    inside = [1e-6 < (other - a) % math.tau < span - 1e-6 for other in (c, d)]
    outside = [span + 1e-6 < (other - a) % math.tau < math.tau - 1e-6 for other in (c, d)]
    return (inside[0] and outside[1]) or (inside[1] and outside[0])


def _between(tracks: dict[str, _Track]) -> list[str]:
    """Pairs of edges that have no junction in common and cross."""
    names = list(tracks)
    owner = np.array([k for k, name in enumerate(names) for _ in range(len(tracks[name].shape) - 1)], np.int64)
    if not len(owner):
        return []
    begin = np.concatenate([tracks[name].shape[:-1] for name in names])
    end = np.concatenate([tracks[name].shape[1:] for name in names])
    low, high = np.minimum(begin, end), np.maximum(begin, end)
    found: dict[tuple[str, str], None] = {}
    for k in range(len(owner)):
        near = (low[k:, :2] <= high[k, :2]).all(axis=1) & (high[k:, :2] >= low[k, :2]).all(axis=1) & (owner[k:] != owner[k])
        for q in (np.flatnonzero(near) + k).tolist():
            one, other = names[owner[k]], names[owner[q]]
            level = abs(float(begin[k, 2] + end[k, 2] - begin[q, 2] - end[q, 2])) / 2.0 < BRIDGE_M
            if level and not set(tracks[one].ends) & set(tracks[other].ends) and _cross(begin[k], end[k], begin[q], end[q]):
                found[one, other] = None
    return [f"{one} and {other}" for one, other in found]


def _cross(a: Points, b: Points, c: Points, d: Points) -> bool:
    """Whether two pieces of track cross, seen from above."""

    def side(p: Points, q: Points, r: Points) -> float:
        return float((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]))

    return side(a, b, c) * side(a, b, d) < 0 and side(c, d, a) * side(c, d, b) < 0
