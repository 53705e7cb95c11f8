"""SUMO's own trains as the baseline: SUMO's ``Rail`` model drives, we read and record. Controller ``sumo``.

Nothing is commanded but reroutes, so the trains move as in SUMO run without us. The run folder is that of any other run, with a row
per train that is on the net and no units: ``trainctl metrics``, ``report``, ``plot`` and ``compare`` read it.

What the motion costs is told from speeds and the trains' own data: the force of a step is ``m (rho a + R + g slope)`` with the
acceleration a of the step, running resistance R and slope at its beginning, mass m and rotating mass factor rho of the
``[train_type]``. SUMO's Euler step moves a train with the speed at its end; work is force times the mean of both speeds, so that it
balances with the kinetic energy. The columns ``input_mps2`` are force per mass.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import libsumo
import numpy as np

import sumo_net
from sumo_net import Line, LineError
from trainctl.controllers.sumo import SIGNALS_M
from trainctl.errors import CouplingError, InputError, SimulatorError
from trainctl.plants import point
from trainctl.prepare import Prepared
from trainctl.record.folder import about_run, claim, finish, held, remove, write_info, write_json
from trainctl.record.metrics import metrics
from trainctl.record.recorder import ENERGIES, Recorder, standard_tables
from trainctl.record.run import Run
from trainctl.scenario import Event
from trainctl.signals import POWERS, SPEED, Bools, Floats, Ints
from trainctl.sumo.session import LOGS, OPTIONS, TOLERANCE_M

#: A bound counts as broken beyond this.
ROUNDING = 1e-6

#: What was recorded is closed this often [s], so that a killed run keeps it.
SAVE_EVERY_S = 10.0


class State(NamedTuple):
    """What SUMO says of all trains at one instant, shape (n,); NaN (edge -1) for a train that is not on the net."""

    position: Floats  # m on the line, front
    speed: Floats  # m/s
    edge: Ints

    @property
    def present(self) -> Ints:
        """Trains on the net."""
        return np.flatnonzero(self.edge >= 0)


class Body(NamedTuple):
    """What moving a train takes, shape (n,) but for ``davis`` (n, 3) and ``gradient`` (G, 2)."""

    mass: Floats  # kg
    rotating: Floats  # inertia over mass
    davis: Floats
    gradient: Floats

    def resistance(self, now: State) -> Floats:
        """Running resistance per mass [N/kg]."""
        return point.resistance(now.speed, self.davis)

    def climbing(self, now: State) -> Floats:
        """Weight along the line per mass [N/kg]."""
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
            end = {"steps": session.k, "violations": len(session.broken), "first_violation": session.first}
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
    broken : set
        (bound, who) that have been broken.
    first : dict or None
        The first of them.
    """

    def __init__(self, p: Prepared, folder: Path) -> None:
        self.p, self.place, self.step = p, folder / "sumo", p.scenario.run.step_s
        self.place.mkdir()
        self.line, self.net = network(p, self.place)
        self.index = {e: k for k, e in enumerate(self.line.edges)}
        self.line_track = np.array([self.line.track_ids.index(t) for t in self.line.tracks], np.int64)
        self.number = {name: i for i, name in enumerate(p.scenario.ids)}
        self.length, self.body = p.consists.train_length(), body(p)
        self.pending = sorted(enumerate(p.scenario.event, 1), key=lambda e: e[1].time_s)
        self.entered: Bools = np.zeros(len(self.number), bool)
        self.energy = np.zeros((len(self.number), len(POWERS)))
        self.broken: set[tuple[str, str]] = set()
        self.first: dict[str, Any] | None = None
        self.k = 0
        write_routes(p, self.line, self.place / "trains.rou.xml")
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
                self._event(self.time if at is None else at, "sumo_warning", message=message)

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
        while self.k < steps and libsumo.simulation.getMinExpectedNumber() > 0:
            self._reroutes(now)
            self._call(libsumo.simulationStep)
            later = self._read()
            force = self.body.input(now, later, self.step)
            self._watch(now, force)
            self._record(now, force)
            self.energy += self.body.work(now, later, self.step)
            self.k += 1
            self._told_of_changes(now, later)
            now = later
            if time.monotonic() - saved > SAVE_EVERY_S:
                self.recorder.cut()
                saved = time.monotonic()
            if progress is not None and self.k % every == 0:
                progress(self.k, steps)
        self._watch(now, np.full(len(self.number), np.nan))
        self._record(now, np.full(len(self.number), np.nan), last=True)
        waiting = [name for name, i in self.number.items() if not self.entered[i]]
        if waiting:
            self._event(self.time, "not_entered", trains=waiting)

    def _read(self) -> State:
        """Where SUMO has the trains."""
        n = len(self.number)
        now = State(np.full(n, np.nan), np.full(n, np.nan), np.full(n, -1))
        vehicle = libsumo.vehicle
        for name in vehicle.getIDList():
            i, edge = self.number[name], self.index[vehicle.getRoadID(name)]
            now.edge[i] = edge
            now.position[i] = self.line.start_m[edge] + vehicle.getLanePosition(name)
            now.speed[i] = vehicle.getSpeed(name)
        for i in now.present[~self.entered[now.present]].tolist():
            self.entered[i] = True
            where = {"track": self.line.tracks[now.edge[i]], "position_m": float(now.position[i]), "speed_mps": float(now.speed[i])}
            self._event(self.time if self.k == 0 else self.time + self.step, "enter", train=self.p.scenario.ids[i], **where)
        return now

    def _verify_placed(self, now: State) -> None:
        """Trains that are placed stand where the scenario says, all of them."""
        if self.p.params.entry_m is not None:
            return
        wrong = []
        for i, t in enumerate(self.p.scenario.train):
            if now.edge[i] < 0:
                wrong.append(f"train {t.id} was not inserted at {t.position_m:.3f} m on track {t.track}")
            elif abs(now.position[i] - t.position_m) > TOLERANCE_M:
                wrong.append(f"train {t.id} was inserted at {now.position[i]:.6f} m instead of {t.position_m:.6f} m")
        if wrong:
            raise CouplingError("; ".join(wrong))

    def _reroutes(self, now: State) -> None:
        """Order the reroutes whose time has come; one of a train that has not entered yet waits for it."""
        for number, event in [e for e in self.pending if e[1].time_s <= self.time + 1e-9]:
            i = self.number[event.train]
            if now.edge[i] >= 0:
                self._reroute(number, event, int(now.edge[i]), float(now.position[i]))
            elif self.entered[i]:
                self._event(self.time, "reroute_refused", train=event.train, reason="the train has left the net")
            else:
                continue
            self.pending.remove((number, event))

    def _reroute(self, number: int, event: Event, edge: int, position: float) -> None:
        line = self.line
        try:
            if event.crossover is None:
                ahead = line.next_crossover(line.tracks[edge], position, str(event.to_track))
                if ahead is None:
                    raise ValueError(f"no crossover to track {event.to_track} ahead")
            else:
                ahead = line.crossover[event.crossover]
            edges = line.route_over(line.edges[edge], ahead.id)
        except ValueError as error:
            where = f"train {event.train} is at {position:.3f} m on track {line.tracks[edge]} at {self.time:g} s"
            raise InputError(f"{self.p.file}: event[{number}]: {error}; {where}") from None
        self._call(libsumo.vehicle.setRoute, event.train, list(edges))
        self._event(
            self.time, "reroute", train=event.train, crossover=ahead.id, from_track=ahead.from_track, to_track=ahead.to_track,
            switch_m=ahead.start_m,
        )  # fmt: skip

    def _told_of_changes(self, now: State, later: State) -> None:
        """Events of trains that left the net or their track in this step."""
        for i in np.flatnonzero((now.edge >= 0) & (later.edge != now.edge)).tolist():
            name = self.p.scenario.ids[i]
            if later.edge[i] < 0:
                self._event(self.time, "arrive", train=name)
                continue
            old, new = (self.line.tracks[s.edge[i]] for s in (now, later))
            if old != new:
                self._event(self.time, "leave", train=name, track=old)
                self._event(self.time, "join", train=name, track=new)

    def _ahead(self, now: State) -> Ints:
        """The train ahead of every train on its track, -1 if none, shape (n,)."""
        there = now.present
        track = self.line_track[now.edge[there]]
        order = there[np.lexsort((-now.position[there], track))]
        ahead = np.full(len(self.number), -1)
        beside = self.line_track[now.edge[order[:-1]]] == self.line_track[now.edge[order[1:]]]
        ahead[order[1:][beside]] = order[:-1][beside]
        return ahead

    def _watch(self, now: State, force: Floats) -> None:
        """The scenario's bounds and collisions; the first time anything breaks is an event, as in other runs."""
        bounds, ids, ahead = self.p.bounds, self.p.scenario.ids, self._ahead(now)
        gap = np.where(ahead >= 0, now.position[ahead] - self.length[ahead] - now.position, np.nan)
        for bound, value, limit, broken in (
            ("speed_lower_mps", now.speed, bounds.speed_lower, now.speed < bounds.speed_lower - ROUNDING),
            ("speed_upper_mps", now.speed, bounds.speed_upper, now.speed > bounds.speed_upper + ROUNDING),
            ("input_lower_mps2", force, bounds.input_lower, force < bounds.input_lower - ROUNDING),
            ("input_upper_mps2", force, bounds.input_upper, force > bounds.input_upper + ROUNDING),
            ("gap_m", gap, np.zeros_like(gap), gap < -ROUNDING),
        ):
            for i in np.flatnonzero(broken).tolist():
                who = f"{ids[ahead[i]]}-{ids[i]}" if bound == "gap_m" else ids[i]
                if (bound, who) not in self.broken:
                    self.broken.add((bound, who))
                    told = {"bound": bound, "who": who, "value": float(value[i]), "limit": float(limit[i])}
                    self.first = self.first or {"time_s": self.time, **told}
                    self._event(self.time, "violation", **told)

    def _record(self, now: State, force: Floats, last: bool = False) -> None:
        if self.k % self.p.scenario.run.recorded_steps and not last:
            return
        there, ahead = now.present, self._ahead(now)
        spacing = np.where(ahead >= 0, now.position[ahead] - now.position, np.nan)
        columns: dict[str, Any] = {
            "position_m": now.position, "speed_mps": now.speed, "input_mps2": force, "edge": now.edge,
            "track": self.line_track[now.edge], "train": np.arange(len(self.number)), "spacing_m": spacing,
            "gap_m": spacing - self.length[ahead], **{name: self.energy[:, q] for q, name in enumerate(ENERGIES)},
        }  # fmt: skip
        rows = {name: column[there] for name, column in columns.items()}
        self.recorder.write("trains", time_s=self.time, saturated=np.zeros(len(there), bool), **rows)
        self.energy[there] = 0.0

    def _event(self, at: float, kind: str, **fields: Any) -> None:
        self.recorder.event(round(at, 9), kind, **fields)

    def _call(self, function: Any, *arguments: Any) -> None:
        """Libsumo's own errors in the project's words."""
        try:
            function(*arguments)
        except (libsumo.TraCIException, libsumo.FatalTraCIError) as error:
            raise SimulatorError(f"SUMO at {self.time:.3f} s: {error}") from None


def network(p: Prepared, folder: Path) -> tuple[Line, Path]:
    """The line with its signals, if it is to have them, and its net in ``folder``."""
    if p.net is not None:
        net = folder / p.net.name
        content = p.net.read_bytes()
        if p.params.block == "fixed" and b'type="rail_signal"' not in content:
            raise InputError(f"{p.file}: controller.block = fixed: {p.net.name} has no rail signals; build it with signals_m")
        net.write_bytes(content)
        return p.line, net
    spec = p.spec.model_copy(update={"signals_m": p.params.signals_m or p.spec.signals_m or SIGNALS_M})
    try:
        spec = sumo_net.parse_spec(spec.model_dump(mode="json", by_alias=True, exclude_none=True), spec.name)
        return Line.of(spec), sumo_net.build(spec, folder)
    except LineError as error:
        raise InputError([f"{p.file}: network: {line}" for line in error.mistakes]) from None


def top_speeds(p: Prepared) -> Floats:
    """Greatest speed of every train [m/s], shape (n,)."""
    if p.params.top_speed_mps is not None:
        return np.full(len(p.scenario.ids), p.params.top_speed_mps)
    instants = np.arange(p.scenario.run.steps + 1) * p.scenario.run.step_s
    wanted = max(p.leader(float(t))[SPEED] for t in instants)
    return np.where(np.isfinite(p.bounds.speed_upper), p.bounds.speed_upper, wanted)


def write_routes(p: Prepared, line: Line, path: Path) -> None:
    """The trains as SUMO vehicles: true lengths, no randomness, driven by the ``Rail`` model.

    Raises
    ------
    InputError
        They cannot enter where ``entry_m`` says.
    """
    entry, trains = p.params.entry_m, p.scenario.train
    if entry is not None and not line.begin_m <= entry < line.end_m:
        raise InputError(f"{p.file}: controller.entry_m = {entry:.10g}: off the line, {line.begin_m:.10g} .. {line.end_m:.10g} m")
    lengths, tops = np.maximum(p.consists.train_length(), 1.0), top_speeds(p)  # SUMO has no points
    kinds = {key: f"train{k + 1}" for k, (key, _) in enumerate(groupby(sorted(zip(lengths.tolist(), tops.tolist(), strict=True))))}
    lines = ["<routes>"]
    lines += [
        f'    <vType id="{kind}" vClass="rail" guiShape="rail" carFollowModel="Rail" trainType="{p.params.train_type}"'
        f' length="{length!r}" maxSpeed="{top!r}" sigma="0" speedFactor="1" speedDev="0"/>'
        for (length, top), kind in kinds.items()
    ]
    for k, (t, length, top) in enumerate(zip(trains, lengths.tolist(), tops.tolist(), strict=True)):
        position = t.position_m if entry is None else entry
        _, lane = line.locate(t.track, position)
        speed = float(t.speed_mps) if entry is None else p.params.entry_speed_mps
        given = {
            "id": t.id, "type": kinds[length, top], "depart": f"{k * p.params.entry_every_s:.3f}", "departLane": "0",
            "departPos": repr(float(lane)), "departSpeed": None if speed is None else repr(speed),
            "insertionChecks": "none" if entry is None else None,
        }  # fmt: skip
        words = "".join(f" {key}={quoteattr(value)}" for key, value in given.items() if value is not None)
        lines.append(f'    <vehicle{words}><route edges="{" ".join(line.route(t.track, position))}"/></vehicle>')
    path.write_text("\n".join([*lines, "</routes>", ""]), encoding="utf-8")


def write_configuration(p: Prepared, net: str, folder: Path) -> Path:
    """``run.sumocfg``: what SUMO's own programs run without us. Insertion follows SUMO's rules."""
    timing = p.scenario.run
    options = {
        "net-file": net, "route-files": "trains.rou.xml", "begin": "0", "step-length": f"{timing.step_s:g}",
        **{key: value for key, value in OPTIONS.items() if key != "insertion-checks"},
        **({"railsignal-moving-block": "true"} if p.params.block == "moving" else {}),
    }  # fmt: skip
    path = folder / "run.sumocfg"
    body = "".join(f"    <{key} value={quoteattr(value)}/>\n" for key, value in options.items())
    path.write_text(f"<configuration>\n{body}</configuration>\n", encoding="utf-8")
    return path


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
