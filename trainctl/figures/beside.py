"""Tracks that lie beside a corridor, told by where the net puts them: the other track of a double line, platforms of a station."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from sumo_net import Rails
from trainctl.signals import Floats

#: A track lies beside a corridor if both of its ends are this near to it [m].
NEAR_M = 100.0
#: And if it is at most so many times as long or as short as what it lies beside.
BESIDE = 2.0


class Scale(NamedTuple):
    """The distances of one edge: ``start_m`` at its beginning, and ``per_m`` for every metre of it; -1 in the other direction."""

    start_m: float
    per_m: float


class Corridor:
    """The places of a corridor in the plane: ``way`` are its edges, ``known`` their distances, ``shapes`` the points of edges."""

    def __init__(self, way: tuple[int, ...], known: Mapping[int, Scale], shapes: Mapping[int, Floats], rails: Rails) -> None:
        self.shapes, self.length = shapes, rails.length_m
        points, at = [np.zeros((0, 2))], [np.zeros(0)]
        for e in (e for e in way if e in shapes):
            reach = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(shapes[e], axis=0).T))])
            points.append(shapes[e])
            at.append(known[e].start_m + known[e].per_m * rails.length_m[e] * reach / max(float(reach[-1]), 1e-9))
        self.points, self.at = np.concatenate(points), np.concatenate(at)

    def scale(self, edge: int) -> Scale | None:
        """Distances of an edge that lies beside; None if it does not."""
        if edge not in self.shapes or len(self.points) < 2:
            return None
        begin, end = (self._nearest(self.shapes[edge][k]) for k in (0, -1))
        length = float(self.length[edge])
        if begin is None or end is None or not length / BESIDE <= abs(end - begin) <= length * BESIDE:
            return None
        return Scale(begin, (end - begin) / length)

    def _nearest(self, point: Floats) -> float | None:
        """Distance of the place next to a point; None if that is too far away."""
        a, step = self.points[:-1], np.diff(self.points, axis=0)
        square = np.maximum((step**2).sum(axis=1), 1e-12)
        share = np.clip(((point - a) * step).sum(axis=1) / square, 0.0, 1.0)
        away = np.hypot(*(a + share[:, None] * step - point).T)
        k = int(np.argmin(away))
        return float(self.at[k] + share[k] * (self.at[k + 1] - self.at[k])) if away[k] <= NEAR_M else None


def along(way: tuple[int, ...], known: Mapping[int, Scale], corridor: Corridor, rails: Rails) -> dict[int, Scale]:
    """Distances of stretches of another way that lie beside a corridor as a whole: until it joins the corridor, or ends."""
    found: dict[int, Scale] = {}
    rows = [*(k for k, e in enumerate(way) if e in known), len(way)]
    for a, b in zip([-1, *rows], rows, strict=False):
        stretch = way[a + 1 : b]
        normal = {e: corridor.scale(e) for e in stretch if not rails.internal[e]}
        scales = {e: scale for e, scale in normal.items() if scale is not None}
        if not normal or len(scales) < len(normal):
            continue
        found |= scales
        for k in (k for k in range(a + 1, b) if rails.internal[way[k]]):  # it fills what is between its neighbours
            before, after = (found.get(way[j]) or known.get(way[j]) for j in (max(k - 1, 0), min(k + 1, len(way) - 1)))
            if before is not None and after is not None:
                begin = before.start_m + before.per_m * float(rails.length_m[way[k - 1]])
                found[way[k]] = Scale(begin, (after.start_m - begin) / max(float(rails.length_m[way[k]]), 1e-9))
    return found
