"""Where trains are, seen from the loop: SUMO (``trainctl.sumo``) or plain arithmetic on the same line (``--backend numeric``)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from sumo_net import Line
from trainctl.signals import Bools, Floats, Ints, Links
from trainctl.topology.ways import Ways, rerouted, ways


class Start(NamedTuple):
    """Trains as they are put on the line, one row per train."""

    ids: Sequence[str]
    edge: Ints  # (n,) index into line.edges
    lane_position: Floats  # (n,) m, front, from the beginning of the edge
    speed: Floats  # (n,) m/s
    length: Floats  # (n,) m
    unit_length: Sequence[Floats]  # m, of each train's units, for the picture
    routes: Sequence[tuple[str, ...]]  # edge ids from the edge a train starts on, internal ones included
    present: Bools  # (n,) the others come later
    vclass: Sequence[str]  # SUMO's class of vehicle


class Seen(NamedTuple):
    """What is measured of all trains, shape (n,). Of trains that are not there it is where they will come or have left."""

    position: Floats  # m on the line, front
    edge: Ints  # index into line.edges
    row: Ints  # of the edge it is on in the ways
    present: Bools


class World(Protocol):
    """The simulator as the loop needs it."""

    @property
    def ways(self) -> Ways:
        """The ways of all trains as they are now ordered."""

    def start(self, start: Start) -> None:
        """Put the trains on the line; afterwards ``measure`` gives their initial positions."""

    def measure(self) -> Seen:
        """Where every train is now."""

    def route(self, train: int, edges: tuple[str, ...]) -> None:
        """Give a train another route; ``edges`` begins with the edge it is on, internal ones included."""

    def insert(self, train: int, speed: float) -> None:
        """Put a train on the net where it was to start; it is there after the next ``move``."""

    def linked(self, links: Links, formation: Ints) -> None:
        """Who hears whom from now on, and which formation (n,) every train is in: for simulators that show it."""

    def move(self, displacement: Floats, step: float) -> None:
        """Let every train move by ``displacement`` (n,) [m] within one step, and end the step."""

    def close(self) -> None:
        """End the simulation and its logs."""

    def messages(self) -> list[tuple[float | None, str]]:
        """Warnings the simulator gave, with the time each names, if any; complete after ``close``."""

    def collisions(self) -> list[dict[str, Any]]:
        """Collisions the simulator counted, complete after ``close``: time_s, trains (the one run into first), edge, edge_m."""


def lay_out(line: Line, start: Start) -> Ways:
    """The ways of trains that start."""
    return ways([[line.index[e] for e in route] for route in start.routes], line.start_m, line.length_m)


class Numeric:
    """The line without a simulator: trains follow their ways by addition, and leave at the end."""

    def __init__(self, line: Line) -> None:
        self.line = line

    def start(self, start: Start) -> None:
        """Put the trains on the line."""
        self.ways = lay_out(self.line, start)
        self.row = self.ways.first[:-1].copy()
        self.lane_position = start.lane_position.copy()
        self.present = start.present.copy()
        self.coming: list[int] = []

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

    def linked(self, links: Links, formation: Ints) -> None:
        """Nobody looks."""

    def move(self, displacement: Floats, step: float) -> None:
        """Move every train; as in SUMO a train on the very end of an edge is still on it."""
        self.lane_position += np.where(self.present, displacement, 0.0)
        edge, length = self.ways.edge, self.line.length_m
        for i in np.flatnonzero(self.lane_position > length[edge[self.row]]).tolist():
            last = int(self.ways.first[i + 1]) - 1
            while self.lane_position[i] > length[edge[self.row[i]]] and self.row[i] < last:
                self.lane_position[i] -= length[edge[self.row[i]]]
                self.row[i] += 1
            self.present[i] = self.lane_position[i] <= length[edge[self.row[i]]]
        self.present[self.coming] = True
        self.coming.clear()

    def close(self) -> None:
        """Nothing to end."""

    def messages(self) -> list[tuple[float | None, str]]:
        """None."""
        return []

    def collisions(self) -> list[dict[str, Any]]:
        """None."""
        return []
