"""The railway without a simulator: plain arithmetic on the same routes (``--backend numeric``)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sumo_net import Line
from trainctl.kernels import bare, keep_by_sources
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


class Places(NamedTuple):
    """Where n trains are on their ways, (n,) each."""

    row: Ints  # of the edge in the ways
    begin: Floats  # m, where that begins on the way
    room: Floats  # m, its length; inf on the last edge
    lane_position: Floats  # m, from there

    @property
    def position(self) -> Floats:
        """On the way [m]."""
        return self.begin + self.lane_position


def placed(ways: Ways, length_m: Floats, row: Ints, lane_position: Floats) -> Places:
    """Trains in these rows of their ways, so far from the beginnings of these edges [m]; ``length_m`` (E,) is that of all edges."""
    room = np.where(row < ways.first[1:] - 1, length_m[ways.edge[row]], np.inf)
    return Places(row, ways.begin[row], room, lane_position)


def gone_on(ways: Ways, length_m: Floats, displacement: Floats, at: Places) -> Places:
    """Every train ``displacement`` (n,) [m] farther along its way; one on the very end of an edge is still on it."""
    lane_position, beyond = np.empty(len(displacement)), np.empty(len(displacement), np.int64)
    crossing = _move(at, displacement, lane_position, beyond)
    if not crossing:
        return at._replace(lane_position=lane_position)
    found = Places(at.row.copy(), at.begin.copy(), at.room.copy(), lane_position)
    _cross(ways, length_m, beyond[:crossing], found)
    return found


@bare
def _move(at: Places, displacement: Floats, lane_position: Floats, beyond: Ints) -> int:
    """Write where trains are on their edges, as if those had no ends, and who is ``beyond`` them; how many are."""
    crossing = 0
    for i in range(len(displacement)):
        lane_position[i] = at.lane_position[i] + displacement[i]
        beyond[crossing] = i
        crossing += lane_position[i] > at.room[i]
    return crossing


@bare
def _cross(ways: Ways, length_m: Floats, beyond: Ints, at: Places) -> None:
    """Trains that are ``beyond`` the ends of their edges go on to the next ones, in place."""
    for i in beyond:
        while at.lane_position[i] > at.room[i]:
            at.lane_position[i] -= at.room[i]
            at.row[i] += 1
            at.begin[i] = ways.begin[at.row[i]]
            at.room[i] = length_m[ways.edge[at.row[i]]] if at.row[i] < ways.first[i + 1] - 1 else np.inf


class Numeric:
    """The line without a simulator: trains follow their ways by addition, and leave at the end."""

    box = None  # no signals

    def __init__(self, line: Line) -> None:
        self.line = line

    def start(self, start: Start) -> None:
        """Put the trains on the line."""
        self.ways = lay_out(self.line, start)
        self.at = placed(self.ways, self.line.length_m, self.ways.first[:-1].copy(), start.lane_position)
        self.present = start.present.copy()
        self.arrival = np.full(len(self.at.row), np.inf) if start.arrival is None else start.arrival.copy()
        self.length = start.length
        self.coming: list[int] = []
        self.turning: list[tuple[int, tuple[str, ...], float]] = []

    def measure(self) -> Seen:
        """Where every train is now."""
        return Seen(self.at.position, self.ways.edge[self.at.row], self.at.row.copy(), self.present.copy())

    def route(self, train: int, edges: tuple[str, ...]) -> None:
        """Give a train another route."""
        line, row = self.line, self.at.row
        before = self.ways.first
        self.ways = rerouted(self.ways, train, int(row[train]), [line.index[e] for e in edges], line.start_m, line.length_m)
        self.at = placed(self.ways, line.length_m, row + self.ways.first[:-1] - before[:-1], self.at.lane_position)

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
        self.at = gone_on(self.ways, self.line.length_m, np.where(self.present, displacement, 0.0), self.at)
        for train, edges, arrival in self.turning:
            self._turn(train, edges, arrival)
        self.turning.clear()
        ends = way_lengths(self.ways, self.line, self.arrival) - LEAVES_M
        self.present &= (self.at.row < self.ways.first[1:] - 1) | (self.at.lane_position <= ends)
        self.present[self.coming] = True
        self.coming.clear()

    def _turn(self, train: int, edges: tuple[str, ...], arrival: float) -> None:
        line, row, before = self.line, int(self.at.row[train]), self.ways.first
        s = float(self.at.position[train])
        self.ways, row, place = turned(
            self.ways, train, row, s, float(self.length[train]), [line.index[e] for e in edges], line.start_m, line.length_m
        )  # fmt: skip
        rows, lane_position = self.at.row + self.ways.first[:-1] - before[:-1], self.at.lane_position.copy()
        rows[train], lane_position[train], self.arrival[train] = row, place, arrival
        self.at = placed(self.ways, line.length_m, rows, lane_position)

    def close(self) -> None:
        """Nothing to end."""

    def messages(self) -> list[tuple[float | None, str]]:
        """None."""
        return []

    def collisions(self) -> list[dict[str, Any]]:
        """None."""
        return []
