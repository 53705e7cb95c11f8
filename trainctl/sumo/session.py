"""SUMO behind the loop: start, measure, command and step through libsumo. Nothing else in the package imports libsumo."""

from __future__ import annotations

import math
import re
import sys
import threading
from collections import deque
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import Any

import libsumo
import numpy as np

from sumo_net import Line
from trainctl.errors import CouplingError, SimulatorError
from trainctl.numeric import LEAVES_M, lay_out, way_lengths
from trainctl.railway.turning import inside
from trainctl.railway.ways import Ways, rerouted, turned
from trainctl.runs.sumo_logs import elements, ended
from trainctl.signals import Bools, Floats, Ints, Links, Seen, Start
from trainctl.sumo.causes import SPEED_MODE_FREE, cause
from trainctl.sumo.commanded_files import HELD_S, LOGS, arrival_word, normal, write_configuration, write_routes
from trainctl.sumo.idling import OF_IDLING, idle_s, silent
from trainctl.sumo.preflight import objections
from trainctl.sumo.signal_box import Box, Obeyed
from trainctl.traffic.trial import tried_as_a_whole

#: What SUMO adds in one step is exact to rounding; anything beyond has another cause.
TOLERANCE_M = 1e-6

#: Closer than this to the end of its edge a train may be on the next one.
NEAR_M = 1e-3

#: Closer than this to the end of its edge, or beyond, SUMO plans the step.
PLANNED_M = 1.0

#: Held while SUMO is started: of two threads that both found none running, the second took the simulation of the first one away.
STARTING = threading.Lock()

#: Flag of a stop that a train parks at.
PARKING = 1

#: SUMO puts a train that turns so far beyond its place [m], and by the junctions under it; told to go as far before it turns, it
#: stands where it should.
TURNS_M = 1e-3


def messages(log: Path) -> list[tuple[float | None, str]]:
    """Warnings and errors SUMO wrote, with the time it named, if any."""
    if not log.is_file():
        return []
    found = []
    for text in log.read_text(encoding="utf-8", errors="replace").splitlines():
        if text.startswith(("Warning:", "Error:")):
            at = re.search(r"time[= ]([0-9.]+)", text)
            found.append((float(at.group(1).rstrip(".")) if at else None, text))
    return found


def collisions(log: Path, ids: Container[str]) -> list[dict[str, Any]]:
    """What SUMO counted as collisions, in its order: time_s, trains (the one run into first), edge, edge_m."""
    found = []
    for _, at in elements(log, "collisions", {"collision"}):
        trains = [at["victim"], at["collider"]]
        if all(name in ids for name in trains):
            edge = at["lane"].rpartition("_")[0]
            found.append({"time_s": float(at["time"]), "trains": trains, "edge": edge, "edge_m": float(at["pos"])})
    return found


class Session:
    """One libsumo simulation, from its start to its logs, whoever drives the trains in it.

    ``folder`` receives SUMO's inputs and its own logs, FCD with rows every ``record_every`` seconds. ``api`` is the module that
    talks to SUMO: libsumo, or another with the same functions.
    """

    api: Any = libsumo
    logs: Mapping[str, str] = LOGS
    ids: Sequence[str]
    ways: Ways
    seen: Seen
    since = 0.0  # s, when SUMO begins by its own clock

    def __init__(self, line: Line, net: Path, folder: Path, step: float, steps: int, record_every: float | None = None) -> None:
        self.line, self.net, self.folder, self.time_step, self.steps = line, net, folder, step, steps
        self.record_every = record_every
        self.internal = any(edge.startswith(":") for edge in line.edges)
        self.began = False

    def _ready(self) -> None:
        """Whether SUMO can be started at all."""
        if libsumo.simulation.isLoaded():
            raise SimulatorError("SUMO already runs in this process; it can hold one simulation at a time")

    def _launch(self, options: list[str]) -> None:
        with STARTING:
            self._ready()
            libsumo.start(["sumo", *options])

    def _begin(self, configuration: Path) -> None:
        """Start SUMO, which then has its first trains on the net."""
        logs = [part for key, name in self.logs.items() for part in (f"--{key}", str(self.folder / name))]
        self._call(self._launch, ["-c", str(configuration), *logs])
        self.began = True
        self._call(self.api.simulationStep)

    def route(self, train: int, edges: tuple[str, ...]) -> None:
        """Give a train another route."""
        line, row, before = self.line, int(self.seen.row[train]), self.ways.first
        # For SUMO who is between two edges is on the first of them still.
        past = normal(line.edges[e] for e in self.ways.edge[before[train] : row].tolist())[-1:] if edges[0].startswith(":") else []
        self._call(self.api.vehicle.setRoute, self.ids[train], [*past, *normal(edges)])
        self.ways = rerouted(self.ways, train, row, [line.index[e] for e in edges], line.start_m, line.length_m)
        self.seen = self.seen._replace(row=self.seen.row + self.ways.first[:-1] - before[:-1])

    def close(self) -> None:
        """End the simulation; SUMO then completes its logs."""
        if self.began:
            self.began = False
            self.api.close()
            torn = [name for key, name in self.logs.items() if key != "log" and not ended(self.folder / name)]
            if torn:
                raise SimulatorError(f"SUMO left {', '.join(torn)} incomplete and gave no reason: is the disk full?")

    def messages(self) -> list[tuple[float | None, str]]:
        """Warnings and errors SUMO wrote, with the time it named, if any."""
        found = messages(self.folder / LOGS["log"])
        return [(None if at is None else at - self.since, text) for at, text in found if not text.startswith(OF_IDLING)]

    def collisions(self) -> list[dict[str, Any]]:
        """Collisions SUMO counted, see ``World``."""
        found = collisions(self.folder / LOGS["collision-output"], self.ids)
        return [one | {"time_s": one["time_s"] - self.since} for one in found]

    def now(self) -> float:
        """Scenario time [s]."""
        return float(self.api.simulation.getTime()) - self.time_step - self.since

    def _call(self, function: Any, *arguments: Any, **more: Any) -> Any:
        """Libsumo's own errors in the project's words."""
        try:
            return function(*arguments, **more)
        except (self.api.TraCIException, self.api.FatalTraCIError) as error:
            where = f" at {self.now():.3f} s" if self.began and libsumo.simulation.isLoaded() else ""
            raise SimulatorError(f"SUMO{where}: {error}") from None


class Sumo(Session):
    """SUMO behind the loop: trains move by what they are told."""

    idle = True  # see ``idling``; not where signals are obeyed
    box: Box | None = None

    def __init__(
        self, line: Line, net: Path, folder: Path, step: float, steps: int, record_every: float | None = None,
        obeyed: Obeyed | None = None,
    ) -> None:  # fmt: skip
        super().__init__(line, net, folder, step, steps, record_every)
        self.obeyed = obeyed
        self.since = 0.0 if obeyed is None else obeyed.handed.begin_s

    def start(self, start: Start) -> None:
        """Load the net, insert the trains, verify each of them, and take every speed correction off."""
        self._ready()
        wrong = objections(self.line, self.time_step)
        if wrong:
            raise SimulatorError("; ".join(wrong))
        self.kinds = write_routes(start, self.folder / "trains.rou.xml", self.obeyed, self.line.speed_mps[start.edge])
        end = (self.steps + 1) * self.time_step
        configuration = write_configuration(
            self.folder, self.net.name, "trains.rou.xml", self.time_step, end, self.internal, self.record_every, self.obeyed
        )
        vehicle = self.api.vehicle
        self._lane_position, self._set_speed = _direct(vehicle.getLanePosition), _direct(vehicle.setSpeed)
        self._plan = _direct(vehicle.setActionStepLength)
        self.ids, self.routes, self.departs_m = list(start.ids), list(start.routes), start.lane_position
        self.ways = lay_out(self.line, start)
        self.arrival = np.full(len(self.ids), np.inf) if start.arrival is None else start.arrival.copy()
        self.length = start.length
        self.turning: list[tuple[int, tuple[str, ...], float]] = []
        self.taken_off: set[int] = set()
        # Where signals are obeyed SUMO knows all of a route, and a stop holds who is to turn; how often each has.
        self.held: set[int] = set() if self.obeyed is None else {i for i in range(len(self.ids)) if self.obeyed.hold(i, 0)}
        self.leg = np.zeros(len(self.ids), np.int64)
        self.way_end = self._way_end()
        self.coming: list[tuple[int, float]] = []
        self.pending: dict[int, float] = {}
        self.returning: list[int] = []
        if self.obeyed is not None:  # SUMO is handed parts of the user's files
            tried_as_a_whole(configuration, self.since, "network.sumocfg")
        self._begin(configuration)
        row = self.ways.first[:-1].copy()
        everyone = np.flatnonzero(start.present)
        self.coming = list(zip(everyone.tolist(), start.speed[everyone].tolist(), strict=True))
        everyone = self._verify_insertion()
        present = np.isin(np.arange(len(self.ids)), everyone)
        self.seen = Seen(self.ways.begin[row] + start.lane_position, self.ways.edge[row], row, present)
        self.seen.position[everyone] = self.ways.begin[row[everyone]] + self._lane_positions(everyone)
        if self.obeyed is not None:
            self.idle, self.box = (
                False,
                Box(self, self.obeyed, _direct(self.api.trafficlight.getRedYellowGreenState, "trafficlight")),
            )
            self.seen = self.box.read().within(self.seen, self.ways)
        if self.idle:
            with silent():
                for kind in sorted(set(self.kinds)):
                    self._call(self.api.vehicletype.setActionStepLength, kind, idle_s(self.time_step))

    def _verify_insertion(self) -> Ints:
        """Whether the trains that come are where they were put; takes every speed correction off them. Which have come.

        Where signals are obeyed SUMO may keep them out.
        """
        vehicle = self.api.vehicle
        present = set(vehicle.getIDList())
        wrong, come = [], []
        coming, self.coming = self.coming, []
        for i, wanted_speed in coming:
            name, edge = self.ids[i], self.line.edges[self.ways.edge[self.ways.first[i]]]
            if name not in present:
                self.pending[i] = wanted_speed
                wrong += [] if self.obeyed is not None else [f"train {name} was not inserted on edge {edge}"]
                continue
            self.pending.pop(i, None)
            come.append(i)
            on, where, speed = vehicle.getRoadID(name), vehicle.getLanePosition(name), vehicle.getSpeed(name)
            if on != edge or abs(where - self.departs_m[i]) > TOLERANCE_M:
                wanted = f"{edge} at {self.departs_m[i]:.6f} m"
                wrong.append(f"train {name} was inserted on {on} at {where:.6f} m instead of {wanted}")
            elif abs(speed - wanted_speed) > TOLERANCE_M:
                wrong.append(f"train {name} was inserted at {speed:.6f} m/s instead of {wanted_speed:.6f} m/s")
            vehicle.setSpeedMode(name, SPEED_MODE_FREE)
            vehicle.setLaneChangeMode(name, 0)
        if wrong:
            raise CouplingError("; ".join(wrong))
        return np.array(come, np.int64)

    def measure(self) -> Seen:
        """Front positions on the line and edges."""
        return self.seen

    def _lane_positions(self, trains: Ints) -> Floats:
        names = self.ids if len(trains) == len(self.ids) else [self.ids[i] for i in trains.tolist()]
        return np.fromiter(map(self._lane_position, names), np.float64, len(trains))

    def _rows(self, trains: Ints) -> Ints:
        """The rows of the edges these trains are on, asked one by one."""
        road = self.api.vehicle.getRoadID
        found = np.empty(len(trains), np.int64)
        for k, i in enumerate(trains.tolist()):
            row, end = int(self.seen.row[i]), int(self.ways.first[i + 1])
            try:
                edge = self.line.index[road(self.ids[i])]
                ahead = np.flatnonzero(self.ways.edge[row:end] == edge)
                found[k] = row + ahead[0]
            except (self.api.TraCIException, KeyError, IndexError) as error:
                why = "it left its route" if isinstance(error, IndexError) else str(error)
                raise CouplingError(
                    f"train {self.ids[i]} is not on its route at {self.now():.3f} s: {why} (likely cause: {self._cause(i)})"
                ) from None
        return found

    def _read(self, wanted: Floats, left: Floats, present: Bools) -> Seen:
        """Where the trains are that should be at ``wanted`` (n,), ``left`` (n,) before the end of their edge, with one call each.

        A train that is where it should be, and not near the end of its edge, is on the edge it was on.
        """
        ways, row = self.ways, self.seen.row
        there = present.nonzero()[0]
        begin = ways.begin[row]
        try:
            lane_position = self._lane_positions(there)
        except self.api.TraCIException:
            self._rows(there)  # tells which train
            raise
        position = wanted.copy()
        position[there] = begin[there] + lane_position
        ask = (((left < NEAR_M) | ~(np.abs(position - wanted) <= TOLERANCE_M)) & present).nonzero()[0]
        if len(ask):
            row = row.copy()
            row[ask] = self._rows(ask)
            position[ask] = ways.begin[row[ask]] + lane_position[np.searchsorted(there, ask)]
        return Seen(position, ways.edge[row], row, present)

    def route(self, train: int, edges: tuple[str, ...]) -> None:
        """Give a train another route: SUMO then knows it up to the next turn only."""
        if train in self.held:
            self._let_go(train)
            self.held.remove(train)
        super().route(train, edges)
        self.way_end = self._way_end()

    def insert(self, train: int, speed: float) -> None:
        """Put a train on the net where it was to start; it is there after the next ``move``, or signals keep it out."""
        name = self.ids[train]
        self.coming.append((train, speed))
        if self.pending.get(train) == speed:  # SUMO tries again by itself
            return
        if train in self.pending:
            self._call(self.api.vehicle.remove, name)
        edge = self.line.edges[self.ways.edge[self.ways.first[train]]]
        lanes = range(self.api.edge.getLaneNumber(edge))
        if speed > max(self.api.lane.getMaxSpeed(f"{edge}_{k}") for k in lanes):  # a sign shows more than the net has
            self._call(self.api.edge.setMaxSpeed, edge, speed)
        if f"way_{name}" not in self.api.route.getIDList():
            way = self.routes[train] if self.obeyed is None else self.obeyed.way(train)
            self._call(self.api.route.add, f"way_{name}", normal(way))
        self._call(
            self.api.vehicle.add, name, f"way_{name}", typeID=self.kinds[train], depart="now", departLane="best",
            departPos=repr(float(self.departs_m[train])), departSpeed=repr(speed),
            arrivalPos=arrival_word(float(self.arrival[train])),
        )  # fmt: skip
        if self.obeyed is not None:
            self._call(self.api.vehicle.setParameter, name, "tripId", self.obeyed.handed.trips[train])
            self._hold(train)

    def park(self, train: int, off: bool) -> None:
        """Let a train that stands leave its lane, by a stop without an end, or come back to it."""
        name, vehicle = self.ids[train], self.api.vehicle
        if not off:
            self._call(vehicle.setStopParameter, name, 0, "duration", "0")
            self.returning.append(train)
            return
        if self.idle:  # a driver that never decides does not see his stop
            self._call(vehicle.setActionStepLength, name, self.time_step)
        self._stop_here(name, PARKING)

    def claim(self, claims: list[list[int]]) -> None:
        """Say which trains hold which signals from now on."""
        if self.box is not None:
            self.box.claims = claims

    def halt(self, train: int, stands: bool) -> None:
        """Let SUMO know where signals are obeyed that a train stands at a stop: it asks for no signal meanwhile."""
        if self.obeyed is None:
            return
        if stands:
            self._stop_here(self.ids[train], 0)
        elif self.api.vehicle.isStopped(self.ids[train]):  # whoever comes back from where it was parked has none any more
            self._call(self.api.vehicle.resume, self.ids[train])

    def _stop_here(self, name: str, flags: int) -> None:
        """A stop without an end where a train stands."""
        vehicle = self.api.vehicle
        edge, place = vehicle.getRoadID(name), vehicle.getLanePosition(name)
        self._call(
            vehicle.setStop, name, edge, pos=place, laneIndex=vehicle.getLaneIndex(name), duration=HELD_S, flags=flags,
            startPos=max(place - 1.0, 0.0),
        )  # fmt: skip

    def turn(self, train: int, edges: tuple[str, ...], arrival: float) -> None:
        """Let a train turn back with the next ``move``: SUMO does as soon as the route says so, if no stop holds the train."""
        name, vehicle = self.ids[train], self.api.vehicle
        if train in self.held:
            self._let_go(train)
        else:
            self._call(vehicle.setRoute, name, [self.line.edges[self.seen.edge[train]], *normal(edges)])
        self.turning.append((train, edges, arrival))

    def _hold(self, train: int) -> None:
        """Hold a train where it is to turn next."""
        if train not in self.held or self.obeyed is None or (place := self.obeyed.hold(train, int(self.leg[train]))) is None:
            return
        edge, begin, end = place
        name, lanes = self.ids[train], range(self.api.edge.getLaneNumber(edge))
        kind = self.api.vehicle.getVehicleClass(name)
        lane = next(k for k in lanes if kind in (let := self.api.lane.getAllowed(f"{edge}_{k}")) or not let)
        self._call(self.api.vehicle.setStop, name, edge, pos=end, laneIndex=lane, duration=HELD_S, startPos=begin)

    def _let_go(self, train: int) -> None:
        """Hold a train no longer: its last stop is what does."""
        name, vehicle = self.ids[train], self.api.vehicle
        if stops := len(vehicle.getStops(name)):
            self._call(vehicle.replaceStop, name, stops - 1, "")

    def linked(self, links: Links, formation: Ints) -> None:
        """Nothing is shown."""

    def move(self, displacement: Floats, step: float) -> None:
        """Command the mean speed of the step, displacement / T: SUMO's Euler update then moves the train by just that."""
        before, row, present = self.seen.position, self.seen.row, self.seen.present
        wanted = np.where(present, before + displacement, before)
        left = self.ways.begin[row] + self.line.length_m[self.ways.edge[row]] - wanted
        speeds = displacement / step
        for train, edges, _ in self.turning:
            speeds[train] = (TURNS_M + self._inside(train, edges)) / step
        ours = present if self.box is None else present & ~self.box.obeyed.driven
        self._call(self._command, ours.nonzero()[0], speeds)
        if self.idle:
            for i in (present & (left < PLANNED_M)).nonzero()[0].tolist():
                self._call(self._plan, self.ids[i], 0.0)
        if self.box is not None:
            self.box.hold()
        for i in self.pending.keys() - {i for i, _ in self.coming}:  # these are not to come now
            self._call(self.api.vehicle.remove, self.ids[i])
            del self.pending[i]
        self._call(self.api.simulationStep)
        for train, edges, arrival in self.turning:
            wanted[train], left[train] = self._turned(train, edges, arrival)
        self.turning.clear()
        own = None
        if self.box is not None:
            own, present = self.box.read(), present & ~self.box.obeyed.driven
        present = present & ~self._left(wanted, present)
        now = self._read(wanted, left, present)
        wrong = (np.abs(now.position - wanted) > TOLERANCE_M).nonzero()[0]
        if len(wrong):
            raise CouplingError("; ".join(self._explain(int(i), now, before, displacement) for i in wrong[:5]))
        self._returned()
        if self.coming:
            now.present[self._verify_insertion()] = True
        self.seen = now if own is None else own.within(now, self.ways)

    def _returned(self) -> None:
        """See who has come back from where it was parked, and end its stop; the others are parked on."""
        vehicle, kept = self.api.vehicle, []
        for i in self.returning:
            if vehicle.getLaneID(self.ids[i]):
                self._call(vehicle.resume, self.ids[i])
            else:
                kept.append(i)
                self._call(vehicle.setStopParameter, self.ids[i], 0, "duration", repr(HELD_S))
        self.returning.clear()
        if self.box is not None:
            self.box.parked = kept
        elif kept:
            raise CouplingError(f"train {self.ids[kept[0]]} is parked; SUMO does not let it back at {self.now():.3f} s")

    def _inside(self, train: int, edges: tuple[str, ...]) -> float:
        """Length of the junctions under a train once it has turned [m]."""
        size, row = self.line.length_m, int(self.seen.row[train])
        front = float(self.ways.begin[row] + size[self.ways.edge[row]] - self.seen.position[train] + self.length[train])
        numbers, within = [self.line.index[edge] for edge in edges], [edge.startswith(":") for edge in self.line.edges]
        return inside(np.array(numbers, np.int64), front, np.array(within), size)

    def _turned(self, train: int, edges: tuple[str, ...], arrival: float) -> tuple[float, float]:
        """Take over the way of a train that has turned: where its front should be now, and how far that is from its edge's end."""
        line, rows, before, onward = self.line, self.seen.row, self.ways.first, [self.line.index[e] for e in edges]
        front, length = float(self.seen.position[train]), float(self.length[train])
        self.ways, row, place = turned(self.ways, train, int(rows[train]), front, length, onward, line.start_m, line.length_m)
        rows = rows + self.ways.first[:-1] - before[:-1]
        rows[train] = row
        self.seen = self.seen._replace(row=rows)
        self.arrival[train] = arrival
        self.way_end = self._way_end()
        self.leg[train] += 1
        self._hold(train)
        if math.isfinite(arrival):  # SUMO takes a place of arrival for that of any route, so it knows of none
            self.taken_off.add(train)
        return float(self.ways.begin[row]) + place, float(line.length_m[self.ways.edge[row]]) - place

    def _left(self, wanted: Floats, present: Bools) -> Bools:
        """Which trains have left the net at the end of their way."""
        near = present & (wanted > self.way_end - LEAVES_M - TOLERANCE_M)
        if near.any():
            gone = set(self.api.simulation.getArrivedIDList())
            for i in self.taken_off.intersection(np.flatnonzero(near & (wanted > self.way_end - LEAVES_M)).tolist()):
                if self.ids[i] not in gone:
                    self._call(self.api.vehicle.remove, self.ids[i], self.api.constants.REMOVE_ARRIVED)
                    gone.add(self.ids[i])
            near &= np.array([name in gone for name in self.ids])
        return near

    def _way_end(self) -> Floats:
        """Where the way of each train ends (n,) [m]."""
        last = self.ways.first[1:] - 1
        return np.asarray(self.ways.begin[last] + way_lengths(self.ways, self.line, self.arrival))

    def _command(self, trains: Ints, speeds: Floats) -> None:
        names = self.ids if len(trains) == len(self.ids) else [self.ids[i] for i in trains.tolist()]
        deque(map(self._set_speed, names, speeds[trains].tolist()), maxlen=0)  # a loop would take a tenth longer

    def _explain(self, i: int, now: Seen, before: Floats, displacement: Floats) -> str:
        name, edge = self.ids[i], self.line.edges[now.edge[i]]
        moved = now.position[i] - before[i]
        return (
            f"train {name} on {edge} at {self.now():.3f} s moved {moved:.6f} m, commanded {displacement[i]:.6f} m:"
            f" something else moved it (likely cause: {self._cause(i)})"
        )

    def _cause(self, i: int) -> str:
        """Why SUMO did something else with a train than it was told to."""
        row, line = int(self.seen.row[i]), self.line
        edges = [line.edges[e] for e in self.ways.edge[row : self.ways.first[i + 1]].tolist()]
        return cause(self.api, self.ids[i], edges[0], normal(edges))


def _direct(function: Any, domain: str = "vehicle") -> Any:
    """Find the compiled function that a function of libsumo hands its arguments on to: handing on takes a third of a call."""
    compiled = getattr(sys.modules.get(function.__module__), "_libsumo", None)
    return getattr(compiled, f"{domain}_{function.__name__}", function)
