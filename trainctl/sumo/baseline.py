"""SUMO's own trains as the baseline: SUMO's ``Rail`` model drives, we read. Controller ``sumo``.

Nothing is commanded but reroutes, so the trains move as in SUMO run without us. ``trainctl.watched`` watches and records them.
"""

from __future__ import annotations

from pathlib import Path

import libsumo
import numpy as np

from sumo_net.netfile import RAIL
from trainctl.errors import CouplingError, InputError, SimulatorError
from trainctl.railway.ways import ways
from trainctl.scenario.model import Model
from trainctl.signals import Bools, Floats, Ints, Observed, Seen
from trainctl.sumo.baseline_files import departures, verify_signals, write_configuration, write_own_configuration, write_routes
from trainctl.sumo.commanded_files import LOGS
from trainctl.sumo.session import TOLERANCE_M, Session
from trainctl.sumo.signal_box import row_of

#: How far ahead SUMO is asked for the next train on a net [m].
LOOK_M = 20_000.0


class Baseline(Session):
    """SUMO driving the trains of a scenario.

    Parameters
    ----------
    p : Model
        A scenario with ``law = "sumo"``.
    net : Path
        Its net, in ``folder``.
    folder : Path
        For SUMO's inputs and logs.

    Raises
    ------
    InputError
        The trains cannot enter where ``entry_m`` says, or there are no signals where there must be some.
    """

    def __init__(self, p: Model, net: Path, folder: Path) -> None:
        run, line = p.scenario.run, p.line
        super().__init__(line, net, folder, run.step_s, run.steps, run.record_every_s)
        verify_signals(p)
        self.p, self.ids = p, p.scenario.ids
        self.departures = departures(p) if p.placed else []
        if any(p.roster.stops):
            self.logs = LOGS | {"stop-output": "stops.xml"}
        self.number = {name: i for i, name in enumerate(self.ids)}
        self.length = p.consists.train_length()
        self.track = np.array([line.track_ids.index(t) for t in line.tracks], np.int64)
        routes = [d.route for d in self.departures] if p.placed else p.roster.whole_routes
        self.ways = ways([[line.index[e] for e in route] for route in routes], line.start_m, line.length_m)
        row, there = self.ways.first[:-1].copy(), np.zeros(len(self.ids), bool)
        position = self.ways.begin[row] + (
            np.array([d.position_m for d in self.departures]) if p.placed else p.roster.lane_position
        )
        self.stops, self.parked = ("",) * len(self.ids), np.zeros(len(self.ids), bool)
        self.others: dict[str, str] = {}  # vClass of who runs beside the trains that are known
        self.seen = Seen(position, self.ways.edge[row], row, there)  # where they will come

    @property
    def planned(self) -> Floats:
        """When every train is to enter [s], shape (n,)."""
        return np.array([d.depart for d in self.departures]) if self.p.placed else self.p.roster.depart

    @property
    def over(self) -> bool:
        """Whether every train has left, and none is still to come."""
        return bool(libsumo.simulation.getMinExpectedNumber() <= 0)

    def start(self) -> None:
        """Let the first trains in."""
        self._ready()
        if self.p.placed:
            write_routes(self.p, self.departures, self.folder / "trains.rou.xml")
            self._begin(write_configuration(self.p, self.net.name, self.folder))
        else:
            try:
                self._begin(write_own_configuration(self.p, self.net.name, self.folder))
            except SimulatorError as error:
                raise InputError(f"{self.p.file}: network.sumocfg: {error}") from None
            self.since = self.now()
        self._read()
        self._verify_placed()

    def step(self) -> None:
        """Go on by one step."""
        self._call(libsumo.simulationStep)
        self._read()

    def measure(self) -> Observed:
        """Where every train is now, how fast, and behind whom."""
        return Observed(self.seen, self.speed, self.ahead, self.spacing)

    def messages(self) -> list[tuple[float | None, str]]:
        """As of ``World``."""
        found = super().messages()
        if trains := [name for name, vclass in self.others.items() if vclass in RAIL]:
            some = f"{', '.join(trains[:8])}{' ...' if len(trains) > 8 else ''}"
            found.append((None, f"{len(trains)} trains that SUMO draws differently from duarouter are not recorded: {some}"))
        return found

    def _read(self) -> None:
        """Where SUMO has the trains."""
        n, vehicle, rails = len(self.ids), libsumo.vehicle, None if self.p.placed else self.p.rails
        everybody = vehicle.getIDList()
        there = [name for name in everybody if name in self.number]
        self.others |= {
            name: vehicle.getVehicleClass(name) for name in everybody if name not in self.number and name not in self.others
        }
        position, row, present = self.seen.position.copy(), self.seen.row.copy(), np.zeros(n, bool)
        self.speed: Floats = np.full(n, np.nan)
        stops, parked = [""] * n, np.zeros(n, bool)
        for name in there:
            i = self.number[name]
            row[i], present[i] = row_of(self, rails, i, vehicle.getRoadID(name)), True
            position[i] = self.ways.begin[row[i]] + vehicle.getLanePosition(name)
            self.speed[i] = vehicle.getSpeed(name)
            stops[i] = _stop(name) if vehicle.isStopped(name) else ""
            parked[i] = bool(stops[i]) and vehicle.isStoppedParking(name)
        self.stops, self.parked = tuple(stops), parked
        self.seen = Seen(position, self.ways.edge[row], row, present)
        self.ahead: Ints = np.full(n, -1)
        self.spacing: Floats = np.full(n, np.nan)
        if self.p.placed:
            self._ahead_on_track()
        else:
            for name in (name for name in there if not parked[self.number[name]]):
                self._ahead_on_way(name)

    def _ahead_on_track(self) -> None:
        """Find the train ahead on the same track of a line."""
        position, track = self.seen.position, self.track[self.seen.edge]
        there = np.flatnonzero(self.seen.present)
        order = there[np.lexsort((-position[there], track[there]))]
        front, rear = order[:-1], order[1:]
        beside: Bools = track[front] == track[rear]
        self.ahead[rear[beside]] = front[beside]
        self.spacing[rear[beside]] = (position[front] - position[rear])[beside]

    def _ahead_on_way(self, name: str) -> None:
        """Find the train that SUMO sees ahead on the way, wherever the net's edges begin and end."""
        found, i = libsumo.vehicle.getLeader(name, LOOK_M), self.number[name]
        if found is not None and found[0] in self.number:
            self.ahead[i] = j = self.number[found[0]]
            self.spacing[i] = found[1] + libsumo.vehicle.getMinGap(name) + max(self.length[j], 1.0)

    def _verify_placed(self) -> None:
        """Trains that are placed stand where the scenario says, all of them."""
        wrong = []
        for i, d in enumerate(self.departures):  # those of a line
            at = float(self.seen.position[i])
            if d.placed and not self.seen.present[i]:
                wrong.append(f"train {d.id} was not inserted at {d.position_m:.3f} m of edge {d.route[0]}")
            elif d.placed and abs(at - self.ways.begin[self.seen.row[i]] - d.position_m) > TOLERANCE_M:
                wrong.append(f"train {d.id} was inserted at {at:.6f} m on the line, not at {d.position_m:.6f} m of its edge")
        if wrong:
            raise CouplingError("; ".join(wrong))


def _stop(name: str) -> str:
    """What the stop is called at which a train stands: its place, else its edge; "" if it only passes a waypoint."""
    found = libsumo.vehicle.getStops(name, 1)
    if not found or found[0].speed > 0.0:
        return ""
    return str(found[0].stoppingPlaceID or libsumo.vehicle.getRoadID(name))
