"""SUMO's own trains as the baseline: SUMO's ``Rail`` model drives, we read. Controller ``sumo``.

Nothing is commanded but reroutes, so the trains move as in SUMO run without us. ``trainctl.watched`` watches and records them.
"""

from __future__ import annotations

from pathlib import Path

import libsumo
import numpy as np

from trainctl.errors import CouplingError
from trainctl.railway.ways import ways
from trainctl.scenario.model import Model
from trainctl.signals import Bools, Floats, Ints, Observed, Seen
from trainctl.sumo.baseline_files import departures, verify_signals, write_configuration, write_routes
from trainctl.sumo.session import LOGS, TOLERANCE_M, Session

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
        self.p, self.ids, self.departures = p, p.scenario.ids, departures(p)
        if any(d.stops for d in self.departures):
            self.logs = LOGS | {"stop-output": "stops.xml"}
        self.number = {name: i for i, name in enumerate(self.ids)}
        self.length = p.consists.train_length()
        self.track = np.array([line.track_ids.index(t) for t in line.tracks], np.int64)
        self.ways = ways([[line.index[e] for e in d.route] for d in self.departures], line.start_m, line.length_m)
        row, there = self.ways.first[:-1].copy(), np.zeros(len(self.ids), bool)
        position = self.ways.begin[row] + np.array([d.position_m for d in self.departures])
        self.seen = Seen(position, self.ways.edge[row], row, there)  # where they will come

    @property
    def planned(self) -> Floats:
        """When every train is to enter [s], shape (n,)."""
        return np.array([d.depart for d in self.departures])

    @property
    def over(self) -> bool:
        """Whether every train has left, and nobody is still to come."""
        return bool(libsumo.simulation.getMinExpectedNumber() <= 0)

    def start(self) -> None:
        """Let the first trains in."""
        self._ready()
        write_routes(self.p, self.departures, self.folder / "trains.rou.xml")
        self._begin(write_configuration(self.p, self.net.name, self.folder))
        self._read()
        self._verify_placed()

    def step(self) -> None:
        """Go on by one step."""
        self._call(libsumo.simulationStep)
        self._read()

    def measure(self) -> Observed:
        """Where every train is now, how fast, and behind whom."""
        return Observed(self.seen, self.speed, self.ahead, self.spacing)

    def _read(self) -> None:
        """Where SUMO has the trains."""
        n, vehicle, there = len(self.ids), libsumo.vehicle, libsumo.vehicle.getIDList()
        position, row, present = self.seen.position.copy(), self.seen.row.copy(), np.zeros(n, bool)
        self.speed: Floats = np.full(n, np.nan)
        for name in there:
            i = self.number[name]
            row[i], present[i] = self._row(i, self.line.index[vehicle.getRoadID(name)]), True
            position[i] = self.ways.begin[row[i]] + vehicle.getLanePosition(name)
            self.speed[i] = vehicle.getSpeed(name)
        self.seen = Seen(position, self.ways.edge[row], row, present)
        self.ahead: Ints = np.full(n, -1)
        self.spacing: Floats = np.full(n, np.nan)
        if self.p.placed:
            self._ahead_on_track()
        else:
            for name in there:
                self._ahead_on_way(name)

    def _row(self, i: int, edge: int) -> int:
        """The row of the edge a train is on, from where it was on its way."""
        row, end = int(self.seen.row[i]), int(self.ways.first[i + 1])
        if self.ways.edge[row] == edge:
            return row
        onward = np.flatnonzero(self.ways.edge[row:end] == edge)
        if not len(onward):
            raise CouplingError(f"train {self.ids[i]} left its way on edge {self.line.edges[edge]} at {self._time():.3f} s")
        return row + int(onward[0])

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
        for i, d in enumerate(self.departures):
            at = float(self.seen.position[i])
            if d.placed and not self.seen.present[i]:
                wrong.append(f"train {d.id} was not inserted at {d.position_m:.3f} m of edge {d.route[0]}")
            elif d.placed and abs(at - self.ways.begin[self.seen.row[i]] - d.position_m) > TOLERANCE_M:
                wrong.append(f"train {d.id} was inserted at {at:.6f} m on the line, not at {d.position_m:.6f} m of its edge")
        if wrong:
            raise CouplingError("; ".join(wrong))
