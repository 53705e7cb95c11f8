"""The railway without a simulator: plain arithmetic on the same routes (``--backend numeric``)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from sumo_net import Line
from trainctl.kernels import keep_by_sources
from trainctl.railway.ways import Ways, rerouted, turned, ways
from trainctl.signals import Floats, Ints, Links, Seen, Start

keep_by_sources()  # before anything below is decorated


def lay_out(line: Line, start: Start) -> Ways:
    """The ways of trains that start."""
    return ways([[line.index[e] for e in route] for route in start.routes], line.start_m, line.length_m)


#: A train whose front is this close to the end of its way has left the net when a step ends (SUMO's POSITION_EPS).
LEAVES_M = 0.1


def way_lengths(ways: Ways, line: Line, arrival: Floats) -> Floats:
    """Where every train leaves, from the beginning of the last edge of its way (n,) [m]."""
    return np.minimum(arrival, line.length_m[ways.edge[ways.first[1:] - 1]])


@njit(cache=True)
def go_on(ways: Ways, length_m: Floats, displacement: Floats, row: Ints, lane_position: Floats) -> None:
    """Move every train along its way: its ``row`` (n,) and how far it is on that edge [m] (n,) are overwritten."""
    for i in range(len(row)):
        lane_position[i] += displacement[i]
        while row[i] < ways.first[i + 1] - 1 and lane_position[i] > length_m[ways.edge[row[i]]]:
            lane_position[i] -= length_m[ways.edge[row[i]]]
            row[i] += 1


class Numeric:
    """The line without a simulator: trains follow their ways by addition, and leave at the end."""

    box = None  # no signals

    def __init__(self, line: Line) -> None:
        self.line = line

    def start(self, start: Start) -> None:
        """Put the trains on the line."""
        self.ways = lay_out(self.line, start)
        self.row = self.ways.first[:-1].copy()
        self.lane_position = start.lane_position.copy()
        self.present = start.present.copy()
        self.arrival = np.full(len(self.row), np.inf) if start.arrival is None else start.arrival.copy()
        self.length = start.length
        self.coming: list[int] = []
        self.turning: list[tuple[int, tuple[str, ...], float]] = []

    def measure(self) -> Seen:
        """Where every train is now."""
        edge = self.ways.edge[self.row]
        return Seen(self.ways.begin[self.row] + self.lane_position, edge, self.row.copy(), self.present.copy())

    def route(self, train: int, edges: tuple[str, ...]) -> None:
        """Give a train another route."""
        line, row = self.line, int(self.row[train])
        before = self.ways.first
        self.ways = rerouted(self.ways, train, row, [line.index[e] for e in edges], line.start_m, line.length_m)
        self.row += self.ways.first[:-1] - before[:-1]

    def insert(self, train: int, speed: float) -> None:
        """Put a train on the net."""
        self.coming.append(train)

    def park(self, train: int, off: bool) -> None:
        """It stays where it stands: here no train is in the way of another."""

    def turn(self, train: int, edges: tuple[str, ...], arrival: float) -> None:
        """Let a train turn back with the next move."""
        self.turning.append((train, edges, arrival))

    def halt(self, train: int, stands: bool) -> None:
        """No signals are set here."""

    def claim(self, claims: list[list[int]]) -> None:
        """Nor here."""

    def linked(self, links: Links, formation: Ints) -> None:
        """Nothing is shown."""

    def move(self, displacement: Floats, step: float) -> None:
        """Move every train; as in SUMO one on the very end of an edge is still on it, and one near the end of its way is gone."""
        go_on(self.ways, self.line.length_m, np.where(self.present, displacement, 0.0), self.row, self.lane_position)
        for train, edges, arrival in self.turning:
            self._turn(train, edges, arrival)
        self.turning.clear()
        ends = way_lengths(self.ways, self.line, self.arrival) - LEAVES_M
        self.present &= (self.row < self.ways.first[1:] - 1) | (self.lane_position <= ends)
        self.present[self.coming] = True
        self.coming.clear()

    def _turn(self, train: int, edges: tuple[str, ...], arrival: float) -> None:
        line, row, before = self.line, int(self.row[train]), self.ways.first
        s = float(self.ways.begin[row] + self.lane_position[train])
        self.ways, row, place = turned(
            self.ways, train, row, s, float(self.length[train]), [line.index[e] for e in edges], line.start_m, line.length_m
        )  # fmt: skip
        self.row += self.ways.first[:-1] - before[:-1]
        self.row[train], self.lane_position[train], self.arrival[train] = row, place, arrival

    def close(self) -> None:
        """Nothing to end."""

    def messages(self) -> list[tuple[float | None, str]]:
        """None."""
        return []

    def collisions(self) -> list[dict[str, Any]]:
        """None."""
        return []
