"""What is written of a run: its rows and events, and the alarms of what must hold."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from trainctl.monitors import bounds as monitor
from trainctl.record import columns
from trainctl.record.recorder import ENERGIES, Recorder, standard_tables
from trainctl.signals import SPEED, Bools, Demand, Disturbed, Extremes, Floats, Formed, Ints, Motion, Row, Scene, Seen
from trainctl.topology import graph

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from trainctl.railway.ways import Ways
    from trainctl.scenario.model import Model
    from trainctl.stages.traffic import Around
    from trainctl.stages.traffic import State as Traffic

#: A killed run loses at most what it recorded in this time [s].
SAVE_EVERY_S = 10.0

#: Rows of trains that are written together: of few trains each call of numpy costs more than the numbers.
TOGETHER = 256

#: Columns of trains.parquet in a run with disturbances, as in ``plants.Disturbed``.
DISTURBANCES = (
    "disturbance_position_m", "disturbance_speed_mps", "disturbance_input_mps2", "resistance_factor", "measurement_error_m",
)  # fmt: skip


class Journal:
    """The tables of one run, filled row by row."""

    def __init__(self, folder: Path, p: Model, resume: Mapping[str, Any] | None = None) -> None:
        self.p = p
        self.silent = False  # while a run that is resumed begins again
        self.has_units, self.has_energies = p.has_units, p.has_units or p.self_driven
        watched = tuple(getattr(p.law, "WATCHED", ())) if self.has_units and not p.sampled else ()
        self.watched = watched
        self.extras = p.plant.COLUMNS
        self.disturbances = DISTURBANCES if p.scenario.disturbance else ()
        self.formed = p.driven
        self.stops = tuple(dict.fromkeys(stop.name for stops in p.roster.stops for stop in stops))
        tables = standard_tables(
            p.scenario.ids, p.line.track_ids, p.line.edges, units=self.has_units, watched=watched, stops=self.stops,
            train_extras=(
                *(ENERGIES if self.has_energies else ()), *self.disturbances, *(("in_formation",) if self.formed else ()),
            ),
            unit_extras=self.extras,
        )  # fmt: skip
        self.recorder = Recorder(folder, tables, {"scenario_sha256": p.scenario.hash()}, resume=resume)
        self.saved = time.monotonic()
        self.rows: list[columns.Instant] = []  # not written yet
        self.train_of_unit = np.repeat(np.arange(len(p.scenario.train)), np.diff(p.consists.first))
        self.lengths = self.train_length = p.consists.train_length()
        self.trains = np.arange(len(self.lengths))

    def serve(self, trains: Ints | None) -> None:
        """From now on rows come of these trains (k,), of their numbers in the scenario; None: of all."""
        self._write()
        self.trains = np.arange(len(self.lengths)) if trains is None else trains
        self.train_length = self.lengths[self.trains]

    def turned(self, p: Model) -> None:
        """Take over a scenario with the units of some trains in another order."""
        self._write()
        self.p = p

    def event(self, time: float, kind: str, **fields: Any) -> None:
        """One line of events.jsonl."""
        if self.silent:
            return
        self.recorder.event(round(time, 9), kind, **fields)

    def write(self, row: Row) -> None:
        """One instant of every table. Every few seconds what was written is closed, so that a killed run keeps it."""
        if time.monotonic() - self.saved > SAVE_EVERY_S:
            self.cut()
            self.saved = time.monotonic()
        now = columns.instant(row, bool(self.disturbances))
        if self.rows and not columns.alike(now, self.rows[0]):
            self._write()
        self.rows.append(now)
        if len(self.rows) * len(now.position) >= TOGETHER:
            self._write()
        else:
            self.rows[-1] = columns.kept(now)

    def _write(self) -> None:
        """Write the instants that wait for it."""
        if not self.rows:
            return
        now, self.rows = columns.placed(columns.together(self.rows), self.train_length), []
        self._append("trains", now, now.present, self._of_trains(now))
        links: dict[str, Any] = {name: value(now) for name, value in columns.LINKS.items()}
        links |= {"sender": self.trains[now.sender], "receiver": self.trains[now.receiver], "heard": now.heard}
        self._append("links", now, np.ones(now.sender.shape, bool), links)
        if self.has_units:
            order = np.lexsort((self.p.unit, self.train_of_unit))  # as they were built, whichever way they run
            units = {name: number[..., order] for name, number in self._of_units(now).items()}
            self._append("units", now, now.present[:, self.train_of_unit[order]], units)

    def _of_trains(self, now: columns.Instant) -> dict[str, Any]:
        """Columns of the trains."""
        numbers: dict[str, Any] = {name: value(now) for name, value in columns.TRAINS.items()}
        for end, watched in (("min", now.watched_min), ("max", now.watched_max)):
            numbers |= {f"{name}_{end}": columns.finite(watched[..., q]) for q, name in enumerate(self.watched)}
        numbers |= {name: now.energy[..., q] for q, name in enumerate(ENERGIES) if self.has_energies}
        numbers |= {name: now.disturbed[:, q] for q, name in enumerate(self.disturbances)}
        if self.formed:
            numbers["in_formation"] = now.led.astype(float)
        return numbers | {"train": self.trains, "track": now.track, "edge": now.edge, "saturated": now.saturated}

    def _of_units(self, now: columns.Instant) -> dict[str, Any]:
        """Columns of the units."""
        units = columns.units(now, self.p.consists)
        numbers: dict[str, Any] = {name: value(units) for name, value in columns.UNITS.items()}
        missing = np.full(now.force.shape, np.nan)  # at the end
        numbers |= {name: now.extras[:, q] if now.extras.size else missing for q, name in enumerate(self.extras)}
        return numbers | {"train": self.train_of_unit, "unit": self.p.unit}

    def _append(self, table: str, now: columns.Instant, kept: Bools, numbers: Mapping[str, Any]) -> None:
        """Append the rows that are ``kept`` (K, rows) of ``numbers`` (K, rows) or (rows,), instant after instant."""
        if kept.any():
            rows = slice(None) if kept.all() else np.flatnonzero(kept)
            numbers = {"time_s": np.asarray(now.time)[:, None], **numbers}
            each = {name: part if part.shape == kept.shape else np.broadcast_to(part, kept.shape) for name, part in numbers.items()}
            self.recorder.write(table, **{name: part.reshape(-1)[rows] for name, part in each.items()})

    def call(self, train: int, call: columns.Call, edge: int) -> None:
        """One row of the stops: a train that has left one, or that comes no more before the end of the run."""
        numbers = {name: value(call) for name, (value, _, _) in columns.STOPS.items()}
        self.recorder.write(
            "stops", train=[int(self.trains[train])], stop=self.stops.index(call.stop.name), platform=edge, **numbers
        )

    def cut(self, synced: bool = False) -> dict[str, Any]:
        """All rows until now survive a kill, see ``Recorder.cut``."""
        self._write()
        return self.recorder.cut(synced)

    def join(self) -> None:
        """Complete the tables; the segments they are made from stay."""
        self._write()
        self.recorder.join()

    def close(self) -> None:
        """Complete the files."""
        self._write()
        self.recorder.close()

    def leave(self) -> None:
        """End, with what was written in closed segments, from which the run can be resumed."""
        try:
            self._write()
        finally:
            self.recorder.leave()


class State(NamedTuple):
    """What recording remembers."""

    alarms: monitor.State
    acting: Bools  # (n,) trains the supervisor acts on


class Record:
    """Hands every instant to the journal, and watches the bounds at every step, recorded or not."""

    def __init__(self, p: Model, journal: Journal) -> None:
        self.p, self.journal = p, journal
        self.alarms = monitor.Alarms(p)
        number = {name: k for k, name in enumerate(p.line.track_ids)}
        self.track_of = np.array([number[t] for t in p.line.tracks], np.int64)

    def initial(self) -> State:
        """Nothing seen."""
        return State(self.alarms.initial(), np.zeros(len(self.p.scenario.ids), bool))

    def turned(self, p: Model, trains: Sequence[int], s: State) -> None:
        """Take over a scenario with the units of some trains in another order; these have turned just now."""
        self.p = p
        self.journal.turned(p)
        self.alarms.turned(p, trains, s.alarms)

    def due(self, k: int) -> bool:
        """Whether a row is written at step ``k``."""
        return k % self.p.scenario.run.recorded_steps == 0 or k == self.p.scenario.run.steps

    def relinked(self, t: float, scene: Scene, formed: Formed, s: State) -> None:
        """Take over the law's bounds on new links; report a formation that is in pieces."""
        groups = graph.components(len(scene.trains), scene.links.sender, scene.links.receiver)
        for alarm in self.alarms.relinked(t, groups, formed.formation, scene, s.alarms):
            self.journal.event(t, "violation", **alarm)

    def step(
        self, k: int, t: float, ways: Ways, here: Seen, seen: Seen, own: Floats, formed: Formed, demand: Demand,
        motion: Motion | None, past: Extremes | None, disturbed: Disturbed | None, s: State,
    ) -> None:  # fmt: skip
        """One instant: alarms, then its row, if one is due.

        Parameters
        ----------
        k, t : int, float
            Step and time [s].
        ways, here : Ways, Seen
            Where the world has the trains, along their own routes.
        seen : Seen
            The same with positions along their formations.
        own, formed, demand
            State of all units, formations, what the law asked for.
        motion, disturbed
            What is applied from this instant on; None at the end.
        past : Extremes or None
            Of the sub-steps since the last row, where a row is due.
        s : State
            Its alarms are updated.
        """
        assert formed.links is not None
        row = Row(
            time=t, seen=seen, track=self.track_of[seen.edge], own=own, speed=own[self.p.leading, SPEED], ahead=formed.ahead,
            links=formed.links, motion=motion, saturated=demand.saturated if motion is None else demand.saturated | motion.limited,
            extremes=past, disturbed=disturbed, led=formed.led,
        )  # fmt: skip
        self.tell(row, ways, here, self.due(k), s)

    def tell(self, row: Row, ways: Ways, here: Seen, due: bool, s: State) -> None:
        """The alarms of one instant, then its row, if one is ``due``."""
        for alarm in self.alarms.new(row, ways, here, s.alarms):
            self.journal.event(row.time, "violation", **alarm)
        if due:
            self.journal.write(row)

    def waits(self, t: float, here: Seen, speed: Floats, traffic: Traffic, around: Around, due: Sequence[int], s: State) -> None:
        """Tell of long waits and of circles."""
        for kind, told in self.alarms.waits(t, here, speed, traffic, around, due, s.alarms):
            self.journal.event(t, kind, **told)
