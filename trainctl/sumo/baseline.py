"""SUMO's own trains as the baseline: SUMO's ``Rail`` model drives, we read and record. Controller ``sumo``.

Nothing is commanded but reroutes, so the trains move as in SUMO run without us. The run folder is that of any other run, with a row
per train that is on the net, and no units: ``trainctl metrics``, ``report``, ``plot`` and ``compare`` read it.

What the motion costs is told from speeds and the trains' own data: the force of a step is ``m (rho a + R + g slope)`` with the
acceleration a of the step, running resistance R and slope at its beginning, mass m and rotating mass factor rho of the
``[train_type]``. SUMO's Euler step moves a train with the speed at its end; work is force times the mean of both speeds, so that it
balances with the kinetic energy. The columns ``input_mps2`` are force per mass.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import libsumo
import numpy as np

from trainctl import supervisor
from trainctl.controllers.sumo import BRAKING_MPS2
from trainctl.errors import CouplingError, InputError, SimulatorError
from trainctl.monitors import on_track
from trainctl.monitors.outcome import Tally
from trainctl.plants import point
from trainctl.prepare import Prepared
from trainctl.record.folder import about_run, claim, finish, held, remove, write_info, write_json
from trainctl.record.metrics import metrics
from trainctl.record.recorder import ENERGIES, Recorder, standard_tables
from trainctl.record.run import Run
from trainctl.reroute import Reroutes
from trainctl.signals import GRAVITY, POWERS, Bools, Floats, Ints
from trainctl.sumo.baseline_files import departures, network, write_configuration, write_routes
from trainctl.sumo.session import LOGS, TOLERANCE_M, collisions, messages, normal
from trainctl.topology.ways import rerouted, ways
from trainctl.world import Seen

#: A bound counts as broken beyond this.
ROUNDING = 1e-6

#: How far ahead SUMO is asked for the next train on a net [m].
LOOK_M = 20_000.0

#: What was recorded is closed this often [s], so that a killed run keeps it.
SAVE_EVERY_S = 10.0


class State(NamedTuple):
    """What SUMO says of all trains at one instant, shape (n,); of a train that is not on the net NaN and -1."""

    position: Floats  # m along its way, front
    speed: Floats  # m/s
    edge: Ints
    row: Ints  # of that edge in the ways
    ahead: Ints  # train ahead, -1 if none
    spacing: Floats  # m, to its front

    @property
    def present(self) -> Ints:
        """Trains on the net."""
        return np.flatnonzero(self.edge >= 0)

    @property
    def seen(self) -> Seen:
        """The same as the loop has it."""
        return Seen(self.position, self.edge, self.row, self.edge >= 0)


class Body(NamedTuple):
    """What moving a train takes, shape (n,) but for ``davis`` (n, 3), ``gradient`` (G, 2) and ``slope`` (E,)."""

    mass: Floats  # kg
    rotating: Floats  # inertia over mass
    davis: Floats
    gradient: Floats  # of a line: where a slope begins [m], rise / run
    slope: Floats | None  # of every edge of a net, rise / run; None on a line

    def resistance(self, now: State) -> Floats:
        """Running resistance per mass [N/kg]."""
        return point.resistance(now.speed, self.davis)

    def climbing(self, now: State) -> Floats:
        """Weight along the line per mass [N/kg]."""
        if self.slope is not None:
            return np.where(now.edge >= 0, GRAVITY * self.slope[now.edge], np.nan)
        return np.where(now.edge >= 0, point.climbing(np.nan_to_num(now.position), self.gradient), np.nan)

    def input(self, now: State, later: State, step: float) -> Floats:
        """Force per mass over the step from ``now`` to ``later`` [m/s2]."""
        acceleration: Floats = (later.speed - now.speed) / step
        return self.rotating * acceleration + self.resistance(now) + self.climbing(now)

    def work(self, now: State, later: State, step: float) -> Floats:
        """Energies of that step [J], shape (n, 6) as ``POWERS``; 0 where a train came or left."""
        force = self.input(now, later, step)
        way = self.mass * 0.5 * (now.speed + later.speed) * step
        parts = {
            "traction": np.maximum(force, 0.0) * way, "braking": np.maximum(-force, 0.0) * way,
            "resistance": self.resistance(now) * way, "gradient": self.climbing(now) * way,
        }  # fmt: skip
        return np.nan_to_num(np.stack([parts.get(power, 0.0 * way) for power in POWERS], axis=1))


def body(p: Prepared) -> Body:
    """Masses, resistances and slopes of a scenario."""
    c = p.consists
    mass = c.train_mass()
    slopes = np.column_stack([p.line.gradient.breaks, p.line.gradient.slope])
    return Body(
        mass=mass,
        rotating=np.add.reduceat(c.mass * c.rotating, c.first[:-1]) / mass,
        davis=point.constants(point.Params(), c).davis,
        gradient=slopes if slopes[:, 1].any() else np.zeros((0, 2)),
        slope=None if p.roster is None else p.rails.slope,
    )


def run(
    p: Prepared, out: Path, force: bool = False, command_line: Sequence[str] = (), progress: Callable[[int, int], Any] | None = None
) -> Run:
    """Run a scenario with ``law = "sumo"`` into the folder ``out``; arguments and errors as ``trainctl.runner.run``."""
    partial = claim(out, force)
    with held(partial):
        text = p.scenario.toml()
        info = about_run(text, p.scenario.run.seed or 0, command_line or sys.argv, backend="sumo")
        write_info(partial, info)
        (partial / "scenario.toml").write_text(text, encoding="utf-8")
        began, session = time.perf_counter(), None
        try:
            session = Session(p, partial)
            session.run(progress)
            missing = {"not_entered": len(session.missing)}
            end = {"steps": session.k, **session.tally.outcome(supervised=False, more=missing)}
            write_json(partial / "metrics.json", metrics(Run(partial)))
        except BaseException as error:
            if isinstance(error, InputError):
                remove(partial)
                raise
            status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
            at = session.time if session is not None else 0.0
            told = {"status": status, "steps": session.k if session is not None else 0}
            failure = {"reason": str(error) or type(error).__name__, "time_s": at}
            write_info(partial, {**info, **told, "wall_time_s": round(time.perf_counter() - began, 3), "failure": failure})
            raise
        write_info(partial, {**info, **end, "status": "complete", "wall_time_s": round(time.perf_counter() - began, 3)})
        finish(out)
    return Run(out)


class Session:
    """SUMO driving the trains of a scenario, and the record of it.

    Parameters
    ----------
    p : Prepared
        A scenario with ``law = "sumo"``.
    folder : Path
        Run folder; SUMO's inputs and logs go to ``folder/sumo``.

    Attributes
    ----------
    k : int
        Steps done.
    tally : Tally
        What has been broken.
    watch : Watch
        Trains inside one another, and too fast for their line.
    missing : list of str
        Trains that never entered.
    """

    def __init__(self, p: Prepared, folder: Path) -> None:
        self.place, self.step = folder / "sumo", p.scenario.run.step_s
        self.place.mkdir()
        self.line, self.net = network(p, self.place)
        self.p = p = replace(p, line=self.line)
        self.line_track = np.array([self.line.track_ids.index(t) for t in self.line.tracks], np.int64)
        self.number = {name: i for i, name in enumerate(p.scenario.ids)}
        self.length, self.body = p.consists.train_length(), body(p)
        self.departures = departures(p)
        self.ways = ways([[self.line.index[e] for e in d.route] for d in self.departures], self.line.start_m, self.line.length_m)
        # Nobody but SUMO protects these trains: their switches are locked within SUMO's braking distance.
        rate = BRAKING_MPS2[p.params.train_type]
        protected = supervisor.Params(mode="on", service_mps2=rate, emergency_mps2=rate)
        self.at: Ints = self.ways.first[:-1].copy()  # rows of the edges the trains were last seen on
        self.reroutes = Reroutes(replace(p, scenario=p.scenario.model_copy(update={"supervisor": protected})))
        self.entered: Bools = np.zeros(len(self.number), bool)
        self.energy = np.zeros((len(self.number), len(POWERS)))
        self.tally, self.watch = Tally(), on_track.of(p, self.line)
        self.missing: list[str] = []
        self.k = 0
        write_routes(p, self.departures, self.place / "trains.rou.xml")
        self.configuration = write_configuration(p, self.net.name, self.place)
        tables = standard_tables(p.scenario.ids, self.line.track_ids, self.line.edges, units=False, train_extras=ENERGIES)
        self.recorder = Recorder(folder, tables, {"scenario_sha256": p.scenario.hash()})

    @property
    def time(self) -> float:
        """Scenario time of the present state [s]."""
        return self.k * self.step

    def run(self, progress: Callable[[int, int], Any] | None = None) -> None:
        """All steps, or until every train has left the net; then SUMO's logs and ours are complete."""
        with self.recorder:
            try:
                self._start()
                self._drive(progress)
            finally:
                if libsumo.simulation.isLoaded():
                    libsumo.close()
            for at, message in messages(self.place / LOGS["log"]):
                self.event(self.time if at is None else at, "sumo_warning", message=message)
            for found in collisions(self.place / LOGS["collision-output"], self.number):
                for told in self.tally.counted(found["time_s"], found):
                    self.event(found["time_s"], "violation", **told)

    def _start(self) -> None:
        if libsumo.simulation.isLoaded():
            raise SimulatorError("SUMO already runs in this process; it can hold one simulation at a time")
        logs = [part for key, name in LOGS.items() for part in (f"--{key}", str(self.place / name))]
        self._call(libsumo.start, ["sumo", "-c", str(self.configuration), *logs])

    def _drive(self, progress: Callable[[int, int], Any] | None) -> None:
        steps, saved = self.p.scenario.run.steps, time.monotonic()
        every = max(1, steps // 100)
        self._call(libsumo.simulationStep)
        now = self._read()
        self._verify_placed(now)
        self._told_of_entries(now, 0.0)
        while self.k < steps and libsumo.simulation.getMinExpectedNumber() > 0:
            self._reroute(now)
            self._call(libsumo.simulationStep)
            later = self._read()
            force = self.body.input(now, later, self.step)
            self._watch(now, force)
            self._record(now, force)
            self.energy += self.body.work(now, later, self.step)
            self.k += 1
            self._told_of_entries(later, self.time)
            self._told_of_changes(now, later)
            now = later
            if time.monotonic() - saved > SAVE_EVERY_S:
                self.recorder.cut()
                saved = time.monotonic()
            if progress is not None and self.k % every == 0:
                progress(self.k, steps)
        self._watch(now, np.full(len(self.number), np.nan))
        self._record(now, np.full(len(self.number), np.nan), last=True)
        self.missing = [name for name, i in self.number.items() if not self.entered[i]]
        if self.missing:
            self.event(self.time, "not_entered", trains=self.missing)

    def _read(self) -> State:
        """Where SUMO has the trains."""
        n = len(self.number)
        missing, nobody = np.full(n, np.nan), np.full(n, -1)
        now = State(missing, missing.copy(), nobody, nobody.copy(), nobody.copy(), missing.copy())
        vehicle, there = libsumo.vehicle, libsumo.vehicle.getIDList()
        for name in there:
            i = self.number[name]
            row = self._row(i, self.line.index[vehicle.getRoadID(name)])
            now.row[i], now.edge[i] = row, self.ways.edge[row]
            now.position[i] = self.ways.begin[row] + vehicle.getLanePosition(name)
            now.speed[i] = vehicle.getSpeed(name)
        self.at = np.where(now.row >= 0, now.row, self.at)
        if self.p.roster is None:
            self._ahead_on_track(now)
        else:
            for name in there:
                self._ahead_on_way(now, name)
        return now

    def _row(self, i: int, edge: int) -> int:
        """The row of the edge a train is on, from where it was on its way."""
        row, end = int(self.at[i]), int(self.ways.first[i + 1])
        if self.ways.edge[row] == edge:
            return row
        onward = np.flatnonzero(self.ways.edge[row:end] == edge)
        if not len(onward):
            raise CouplingError(f"train {self.p.scenario.ids[i]} left its way on edge {self.line.edges[edge]} at {self.time:.3f} s")
        return row + int(onward[0])

    def _ahead_on_track(self, now: State) -> None:
        """Write the train ahead on the same track of a line."""
        there = now.present
        track = self.line_track[now.edge[there]]
        order = there[np.lexsort((-now.position[there], track))]
        beside = self.line_track[now.edge[order[:-1]]] == self.line_track[now.edge[order[1:]]]
        now.ahead[order[1:][beside]] = order[:-1][beside]
        now.spacing[order[1:][beside]] = (now.position[order[:-1]] - now.position[order[1:]])[beside]

    def _ahead_on_way(self, now: State, name: str) -> None:
        """Write the train that SUMO sees ahead on the way, wherever the net's edges begin and end."""
        found, i = libsumo.vehicle.getLeader(name, LOOK_M), self.number[name]
        if found is not None and found[0] in self.number:
            now.ahead[i] = j = self.number[found[0]]
            now.spacing[i] = found[1] + libsumo.vehicle.getMinGap(name) + max(self.length[j], 1.0)

    def _told_of_entries(self, now: State, at: float) -> None:
        """Events of trains that came."""
        for i in now.present[~self.entered[now.present]].tolist():
            self.entered[i] = True
            planned = self.departures[i].depart
            self.event(
                at, "depart", train=self.p.scenario.ids[i], planned_s=planned, delay_s=at - planned,
                track=self.line.tracks[now.edge[i]], position_m=float(now.position[i]), speed_mps=float(now.speed[i]),
            )  # fmt: skip

    def _verify_placed(self, now: State) -> None:
        """Trains that are placed stand where the scenario says, all of them."""
        wrong = []
        for i, d in enumerate(self.departures):
            if d.placed and now.edge[i] < 0:
                wrong.append(f"train {d.id} was not inserted at {d.position_m:.3f} m of edge {d.route[0]}")
            elif d.placed and abs(now.position[i] - self.ways.begin[now.row[i]] - d.position_m) > TOLERANCE_M:
                wrong.append(
                    f"train {d.id} was inserted at {now.position[i]:.6f} m on the line, not at {d.position_m:.6f} m of its edge"
                )
        if wrong:
            raise CouplingError("; ".join(wrong))

    def _reroute(self, now: State) -> None:
        """Order the reroutes whose time, place or condition has come."""
        if not self.reroutes.pending:
            return
        journal: Any = self  # takes the events
        for i, edges in self.reroutes.orders(self.time, now.seen, self.ways, now.speed, now.ahead, journal):
            self._call(libsumo.vehicle.setRoute, self.p.scenario.ids[i], normal(edges))
            onward, before = [self.line.index[e] for e in edges], self.ways.first[:-1]
            self.ways = rerouted(self.ways, i, int(now.row[i]), onward, self.line.start_m, self.line.length_m)
            shift = self.ways.first[:-1] - before
            self.at += shift
            now.row[:] = np.where(now.row >= 0, now.row + shift, now.row)

    def _told_of_changes(self, now: State, later: State) -> None:
        """Events of trains that left the net or their track in this step."""
        for i in np.flatnonzero((now.edge >= 0) & (later.edge != now.edge)).tolist():
            name = self.p.scenario.ids[i]
            if later.edge[i] < 0:
                self.event(self.time, "arrive", train=name)
                continue
            old, new = (self.line.tracks[s.edge[i]] for s in (now, later))
            if old != new and self.p.roster is None:
                self.event(self.time, "leave", train=name, track=old)
                self.event(self.time, "join", train=name, track=new)

    def _watch(self, now: State, force: Floats) -> None:
        """The scenario's bounds, collisions and speed limits; the first time anything breaks is an event, as in other runs."""
        bounds, ids = self.p.bounds, self.p.scenario.ids
        for bound, value, limit, broken in (
            ("speed_lower_mps", now.speed, bounds.speed_lower, now.speed < bounds.speed_lower - ROUNDING),
            ("speed_upper_mps", now.speed, bounds.speed_upper, now.speed > bounds.speed_upper + ROUNDING),
            ("input_lower_mps2", force, bounds.input_lower, force < bounds.input_lower - ROUNDING),
            ("input_upper_mps2", force, bounds.input_upper, force > bounds.input_upper + ROUNDING),
        ):
            for i in np.flatnonzero(broken).tolist():
                for told in self.tally.once(self.time, bound, ids[i], float(value[i]), float(limit[i])):
                    self.event(self.time, "violation", **told)
        for wrong in self.watch.broken(self.ways, now.seen, now.speed):
            for told in self.tally.once(self.time, **wrong):
                self.event(self.time, "violation", **told)

    def _record(self, now: State, force: Floats, last: bool = False) -> None:
        if self.k % self.p.scenario.run.recorded_steps and not last:
            return
        there = now.present
        columns: dict[str, Any] = {
            "position_m": now.position, "speed_mps": now.speed, "input_mps2": force, "edge": now.edge,
            "track": self.line_track[now.edge], "train": np.arange(len(self.number)), "spacing_m": now.spacing,
            "gap_m": now.spacing - self.length[now.ahead], **{name: self.energy[:, q] for q, name in enumerate(ENERGIES)},
        }  # fmt: skip
        rows = {name: column[there] for name, column in columns.items()}
        self.recorder.write("trains", time_s=self.time, saturated=np.zeros(len(there), bool), **rows)
        self.energy[there] = 0.0

    def event(self, at: float, kind: str, **fields: Any) -> None:
        """One line of events.jsonl."""
        self.recorder.event(round(at, 9), kind, **fields)

    def _call(self, function: Any, *arguments: Any) -> None:
        """Libsumo's own errors in the project's words."""
        try:
            function(*arguments)
        except (libsumo.TraCIException, libsumo.FatalTraCIError) as error:
            raise SimulatorError(f"SUMO at {self.time:.3f} s: {error}") from None
