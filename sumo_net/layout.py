"""From a line description to its edges: what the builder writes and the line coordinate indexes, decided in one place."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sumo_net.spec import SHORTEST_EDGE_M, Crossover, LineSpec, rounded, text

Floats = NDArray[np.float64]


class Edge(NamedTuple):
    """One edge of the net: a piece of track, or a crossover, which belongs to the track it leads to."""

    id: str
    track: str
    start_m: float
    end_m: float
    speed_mps: float
    crossover: Crossover | None

    @property
    def length_m(self) -> float:
        """Length along the rail, and on the kilometrage [m]."""
        return rounded(self.end_m - self.start_m)


class Gradient(NamedTuple):
    """Slope of the line: ``slope[k]`` (rise over run, rising positive) from ``breaks[k]`` [m] on; shapes (K,)."""

    breaks: Floats
    slope: Floats


def edges(spec: LineSpec) -> list[Edge]:
    """Pieces of track in lateral order and by kilometrage, then the crossovers by kilometrage."""
    found = []
    limits_from = [rounded(at) for at, _ in spec.speed]
    for track, cuts in spec.cuts().items():
        places = _split(sorted(cuts), spec.max_edge_m)
        limits = np.searchsorted(limits_from, places[:-1], side="right") - 1
        for (a, b), k in zip(pairwise(places), limits, strict=True):
            found.append(Edge(f"{track}_{text(a)}", track, a, b, _limit(spec.speed[k][1]), None))
    crossovers = [Edge(c.edge, c.to_track, c.start_m, c.end_m, _limit(c.speed_mps), c) for c in spec.all_crossovers()]
    return found + sorted(crossovers, key=lambda e: (e.start_m, e.id))


def _limit(speed_mps: float) -> float:
    """The speed as nine decimals in the net file give it back."""
    return round(speed_mps, 9)


def _split(places: list[float], longest: float) -> list[float]:
    """Cut what is too long at the whole multiples of ``longest``, unless that leaves a splinter."""
    found = [places[0]]
    for a, b in pairwise(places):
        if b - a > longest:
            multiples = (rounded(k * longest) for k in range(math.floor(a / longest) + 1, math.ceil(b / longest)))
            found += [m for m in multiples if m - a >= SHORTEST_EDGE_M and b - m >= SHORTEST_EDGE_M]
        found.append(b)
    return found


def gradient(spec: LineSpec) -> Gradient:
    """The gradient profile from the beginning of the line on, without changes that change nothing."""
    breaks, permil = [spec.begin_m], [0.0]
    for at, value in spec.gradient:
        if rounded(at) == breaks[-1]:
            permil[-1] = value
        elif value != permil[-1]:
            breaks.append(rounded(at))
            permil.append(value)
    return Gradient(np.array(breaks), np.array(permil) / 1000)
