"""Where trains are, seen from the loop: SUMO (``trainctl.sumo``) or plain arithmetic on the same line (``--backend numeric``)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from sumo_net import Line
from trainctl.signals import Floats, Ints, Links


class Start(NamedTuple):
    """Trains as they are put on the line, one row per train."""

    ids: Sequence[str]
    edge: Ints  # (n,) index into line.edges
    lane_position: Floats  # (n,) m, front, from the beginning of the edge
    speed: Floats  # (n,) m/s
    length: Floats  # (n,) m
    unit_length: Sequence[Floats]  # m, of each train's units, for the picture
    routes: Sequence[tuple[str, ...]]  # edge ids


class Seen(NamedTuple):
    """What is measured of all trains, shape (n,)."""

    position: Floats  # m on the line, front
    edge: Ints  # index into line.edges


class World(Protocol):
    """The simulator as the loop needs it."""

    def start(self, start: Start) -> None:
        """Put the trains on the line; afterwards ``measure`` gives their initial positions."""

    def measure(self) -> Seen:
        """Where every train is now."""

    def route(self, train: int, edges: tuple[str, ...]) -> None:
        """Give a train another route; ``edges`` begins with the edge it is on."""

    def linked(self, links: Links, formation: Ints) -> None:
        """Who hears whom from now on, and which formation (n,) every train is in: for simulators that show it."""

    def move(self, displacement: Floats, step: float) -> None:
        """Let every train move by ``displacement`` (n,) [m] within one step, and end the step."""

    def close(self) -> None:
        """End the simulation and its logs."""

    def messages(self) -> list[tuple[float | None, str]]:
        """Warnings the simulator gave, with the time each names, if any; complete after ``close``."""


class Numeric:
    """The line without a simulator: trains follow their routes by addition."""

    def __init__(self, line: Line) -> None:
        self.line = line
        self.index = {e: k for k, e in enumerate(line.edges)}

    def start(self, start: Start) -> None:
        """Put the trains on the line."""
        self.edge = start.edge.copy()
        self.lane_position = start.lane_position.copy()
        self.ahead = [[self.index[e] for e in route[1:]] for route in start.routes]

    def measure(self) -> Seen:
        """Where every train is now."""
        return Seen(self.line.start_m[self.edge] + self.lane_position, self.edge.copy())

    def route(self, train: int, edges: tuple[str, ...]) -> None:
        """Give a train another route."""
        self.ahead[train] = [self.index[e] for e in edges[1:]]

    def linked(self, links: Links, formation: Ints) -> None:
        """Nobody looks."""

    def move(self, displacement: Floats, step: float) -> None:
        """Move every train; as in SUMO a train on the very end of an edge is still on it."""
        self.lane_position += displacement
        length = self.line.length_m
        for i in np.flatnonzero(self.lane_position > length[self.edge]):
            while self.lane_position[i] > length[self.edge[i]] and self.ahead[i]:
                self.lane_position[i] -= length[self.edge[i]]
                self.edge[i] = self.ahead[i].pop(0)

    def close(self) -> None:
        """Nothing to end."""

    def messages(self) -> list[tuple[float | None, str]]:
        """None."""
        return []
