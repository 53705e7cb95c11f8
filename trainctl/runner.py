"""A run from start to end: the folder, the network, the loop, the metrics, and what run.json says afterwards."""

from __future__ import annotations

import dataclasses
import os
import signal
import sys
import threading
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import tomli_w

import sumo_net
from sumo_net import LineError
from sumo_net.netfile import unpack
from trainctl.compiling import compiling
from trainctl.errors import InputError, SimulatorError, left_out
from trainctl.in_service import loop_of
from trainctl.loop import Loop
from trainctl.metrics.run import metrics
from trainctl.metrics.versions import VERSION
from trainctl.numeric import Numeric
from trainctl.record import checkpoint
from trainctl.record.folder import (
    INFO,
    about_run,
    finish,
    held,
    open_partial,
    ours,
    partial_of,
    plain,
    remove,
    write_info,
    write_json,
    written,
)  # fmt: skip
from trainctl.record.recorder import EVENTS
from trainctl.record.sums import sealed, sum_of, unsealed, verify
from trainctl.runs.run import DEFINITIONS_KEY, Run
from trainctl.scenario import promise, roster
from trainctl.scenario.build import model_of
from trainctl.scenario.model import Model
from trainctl.scenario.reading import examine
from trainctl.stages.record import Journal
from trainctl.steps import Steps
from trainctl.watched import Watched
from trainctl.world import SelfDriven, World

Backend = Literal["sumo", "numeric"]


def run(
    p: Model,
    out: Path,
    backend: Backend = "sumo",
    force: bool = False,
    command_line: Sequence[str] = (),
    progress: Callable[[int, int], Any] | None = None,
    gui: str | None = None,
    checkpoint_every_s: float | None = None,
) -> Run:
    """Run a scenario into the folder ``out``.

    Parameters
    ----------
    p : Model
        The scenario, checked.
    out : Path
        Run folder; written as ``out.partial`` and renamed when complete.
    backend : {"sumo", "numeric"}
        SUMO, or the same loop on plain arithmetic.
    force : bool
        Replace whatever is at ``out``.
    command_line : sequence of str
        For run.json.
    progress : callable, optional
        Called with (steps done, steps).
    gui : str, optional
        Program that shows the run, see ``open_world``.
    checkpoint_every_s : float, optional
        Scenario time between two checkpoints [s], from which ``resume`` goes on; default none.

    Returns
    -------
    Run
        The finished run folder.

    Raises
    ------
    InputError
        The folder may not be replaced, or the scenario turned out to be impossible on the way; nothing is left behind.
    TrainctlError
        The run failed; ``out.partial`` keeps what was recorded, and run.json says why and when.
    """
    if p.self_driven and (backend != "sumo" or gui is not None or checkpoint_every_s is not None):
        raise InputError("controller.law = sumo: SUMO drives the trains itself: no --backend numeric, --gui or --checkpoint-every")
    with _opened(p, out, backend, force, command_line, gui, checkpoint_every_s) as simulation:
        simulation.run(progress)
    return Run(out)


@contextmanager
def opened(
    p: Model,
    out: Path,
    backend: Backend = "sumo",
    force: bool = False,
    command_line: Sequence[str] = (),
    gui: str | None = None,
    checkpoint_every_s: float | None = None,
) -> Iterator[Loop]:
    """A run folder and the loop in it, for whoever drives it; arguments and errors as in ``run``.

    When the block ends the run is complete; when it raises, the run failed.
    """
    if p.self_driven:
        raise InputError("controller.law = sumo: SUMO drives the trains itself; `trainctl run` runs it")
    with _opened(p, out, backend, force, command_line, gui, checkpoint_every_s) as simulation:
        assert isinstance(simulation, Loop)
        yield simulation


@contextmanager
def _opened(
    p: Model, out: Path, backend: Backend, force: bool, command_line: Sequence[str], gui: str | None,
    checkpoint_every_s: float | None,
) -> Iterator[Steps]:  # fmt: skip
    """The same for every run, whoever drives its trains."""
    every = checkpoint_every_s
    step = p.scenario.run.step_s
    if p.obeys and (backend != "sumo" or gui is not None):
        key, way = ('others = "sumo"', "") if p.roster.driven.any() else ('signals = "obey"', '; signals = "ignore" does without')
        raise InputError(f"traffic.{key}: SUMO sets the signals: no --backend numeric, no --gui{way}")
    if every is not None and not (every >= step and abs(every / step - round(every / step)) < 1e-6):
        raise InputError(f"--checkpoint-every {every:g}: must be a multiple of step_s = {step:g}")
    if every is not None and gui is not None:
        raise InputError("--checkpoint-every: a run that is watched cannot be resumed; leave out --gui")
    if backend == "sumo" and "," in (place := str(Path(out).absolute())):
        raise InputError(f"{place}: SUMO takes a comma for the end of a file's name: choose an --out without, or --backend numeric")
    if backend == "sumo" and gui is None and find_spec("libsumo") is None:
        raise InputError(f"{left_out('libsumo')}; without it: --backend numeric")
    partial = open_partial(out, force)
    with held(partial):
        text = p.scenario.toml()
        protection = {"protection": promise.told(p)} if p.supervision.mode != "off" and not p.self_driven else {}
        info = about_run(text, p.scenario.run.seed or 0, command_line or sys.argv, backend=backend, **protection)
        write_info(partial, info)
        (partial / "scenario.toml").write_text(text, encoding="utf-8")
        keep_law(p, partial)
        if backend == "numeric" and p.net is not None:
            unpack(p.net, partial)  # where the trains were, for figures; SUMO keeps its own
        begin(partial, p, checkpoint_every_s, info)
        with _driven(p, partial, info, gui, checkpoint_every_s, None) as simulation:
            yield simulation
        finish(out)


def resume(folder: Path, progress: Callable[[int, int], Any] | None = None) -> tuple[Run, float | None]:
    """Go on with a run that was killed, interrupted or failed, from its last checkpoint.

    Parameters
    ----------
    folder : Path
        ``DIR`` or ``DIR.partial``.
    progress : callable, optional
        Called with (steps done, steps).

    Returns
    -------
    tuple of Run and float or None
        The finished run folder; the scenario time [s] from which it went on, None if all steps were done already.

    Raises
    ------
    InputError
        There is nothing to resume, or it was made by other versions.
    TrainctlError
        As ``run``.
    """
    folder = Path(os.path.abspath(folder))
    out = folder.with_name(folder.name.removesuffix(".partial")) if folder.name.endswith(".partial") else folder
    partial = partial_of(out)
    with held(partial):
        if not ours(partial):
            if ours(out) and Run(out).info["status"] == "complete":
                return Run(out), None
            raise InputError(f"{partial}: no run that could be resumed; start one with `trainctl run`")
        place = partial / checkpoint.FOLDER
        if Run(partial).info.get("status") == "complete" and not os.path.lexists(place / checkpoint.DONE):
            _whole(partial)
            _cleared(partial)
            finish(out)
            return Run(out), None
        p, every, info = again(partial)
        if os.path.lexists(place / checkpoint.DONE):
            done = unsealed(place / checkpoint.DONE)
            for name, expected in done["files"].items():
                verify(partial / name, expected)
            _complete(p, partial, info, done)
            finish(out)
            return Run(out), None
        saved = checkpoint.read(place, p)
        anew = ("segments", EVENTS) if saved is None else ()
        for name in (*anew, "metrics.json", *(path.name for path in partial.glob("*.parquet"))):
            remove(partial / name)
        remove(partial / "sumo")
        write_info(partial, info)
        with _driven(p, partial, info, None, every, saved) as simulation:
            since = simulation.time
            simulation.run(progress)
        finish(out)
    return Run(out), since


@contextmanager
def _driven(
    p: Model, partial: Path, info: dict[str, Any], gui: str | None, every_s: float | None, saved: checkpoint.Saved | None
) -> Iterator[Steps]:
    """The loop in its folder, from the beginning or from a checkpoint, and what is left to do when it has ended."""
    place = partial / checkpoint.FOLDER
    remove(place / checkpoint.RESERVE)
    # not zeros: some file systems keep no room for those
    (place / checkpoint.RESERVE).write_bytes(os.urandom(checkpoint.RESERVE_BYTES))
    began = time.perf_counter() - (saved.values["wall_time_s"] if saved else 0.0)
    journal: Journal | None = None
    world: World | SelfDriven | None = None
    simulation: Steps | None = None
    tape: checkpoint.Tape | None = None

    def elapsed() -> float:  # compiling is done once, and says nothing of the run
        return round(time.perf_counter() - began - compiled.seconds, 3)

    try:
        with compiling() as compiled, _stops() as stop:
            journal = Journal(partial, p, saved.values["recorder"] if saved else None)
            if saved is None:
                for kind, lines in (("followed", p.roster.followed), ("not_followed", p.roster.notes)):
                    for line in lines:
                        journal.event(0.0, kind, what=line)
            if p.self_driven:
                world = open_self_driven(p, partial)
                simulation = Watched(p, world, journal)
            else:
                world = open_world(p, partial, info["backend"], gui)
                if every_s is not None:
                    world = tape = checkpoint.Tape(world, place, saved)
                journal.silent = saved is not None  # what a run told when it began is written already
                simulation = loop_of(p, world, journal)
                if saved is not None and tape is not None:
                    checkpoint.restore(simulation, tape, saved)
                journal.silent = False
            simulation.between = _Between(simulation, journal, tape, place, every_s, stop, elapsed)
            stop.waits = True
            yield simulation
            stop.waits = False
            world.close()
            for at, message in world.messages():
                journal.event(simulation.time if at is None else at, "sumo_warning", message=message)
            for at, alarm in simulation.counted(world.collisions()):
                journal.event(at, "violation", **alarm)
            end = {"steps": simulation.k, **simulation.outcome()}
            logs = {name: sum_of(partial / name) for name in written(partial) if name.startswith("sumo/")}
            recorded = journal.cut(synced=every_s is not None)
            done = {"end": plain(end), "wall_time_s": elapsed(), "recorder": recorded, "files": logs}
            checkpoint.replace(place / checkpoint.DONE, sealed(done))
            _complete(p, partial, info, {**done, "wall_time_s": elapsed()}, journal)
    except BaseException as error:
        if world is not None:
            _quietly(world.close)
        if journal is not None:
            _quietly(journal.leave if tape is not None else journal.close)
        if isinstance(error, InputError) and saved is None:
            remove(partial)
        else:
            remove(place / checkpoint.RESERVE)
            failure = {"reason": str(error) or type(error).__name__, "time_s": simulation.time if simulation is not None else 0.0}
            status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
            steps = simulation.k if simulation is not None else 0
            _quietly(write_info, partial, {**info, "status": status, "steps": steps, "wall_time_s": elapsed(), "failure": failure})
        raise


def _complete(p: Model, partial: Path, info: dict[str, Any], done: dict[str, Any], journal: Journal | None = None) -> None:
    """Join the tables, measure, and say that the run is complete; may be done again after a kill."""
    (journal or Journal(partial, p, done["recorder"])).join()
    remove(partial / "metrics.json")
    write_json(partial / "metrics.json", {DEFINITIONS_KEY: VERSION, **metrics(Run(partial))})
    files = [path for path in written(partial) if path.partition("/")[0] not in (checkpoint.FOLDER, "segments")]
    write_info(partial, {**info, **done["end"], "status": "complete", "wall_time_s": done["wall_time_s"], "files": files})
    _cleared(partial)


def _cleared(partial: Path) -> None:
    """Remove what only a run that is going on needs; first the word that there is something left to do."""
    remove(partial / checkpoint.FOLDER / checkpoint.DONE)
    remove(partial / checkpoint.FOLDER)
    remove(partial / "segments")


def _whole(folder: Path) -> None:
    """Whether all files of a complete run are there."""
    names = Run(folder).info.get("files")
    missing = [name for name in names if not (folder / str(name)).is_file()] if isinstance(names, list) else [INFO]
    if missing:
        raise InputError([f"{folder / str(name)}: missing or damaged: run it again with `trainctl run`" for name in missing])


class _Between:
    """What happens between two steps: a checkpoint if one is due, an end if one was asked for."""

    def __init__(
        self, simulation: Steps, journal: Journal, tape: checkpoint.Tape | None, place: Path, every_s: float | None,
        stop: _Stop, elapsed: Callable[[], float],
    ) -> None:  # fmt: skip
        self.simulation, self.journal, self.tape, self.place, self.stop, self.elapsed = (
            simulation, journal, tape, place, stop, elapsed,
        )  # fmt: skip
        self.every = round(every_s / simulation.p.scenario.run.step_s) if every_s is not None else 0
        self.identity = checkpoint.identity(simulation.p) if tape is not None else {}

    def __call__(self) -> None:
        asked = self.stop.asked
        if self.tape is not None and (asked is not None or self.simulation.k % self.every == 0):
            more = {"recorder": self.journal.cut(synced=True), "tape": self.tape.save(), "wall_time_s": self.elapsed()}
            assert isinstance(self.simulation, Loop)
            checkpoint.write(self.place, self.simulation, {**self.identity, **more})
        if asked is not None:
            raise KeyboardInterrupt(f"interrupted by {asked}")


class _Stop:
    """Ctrl-C, SIGTERM and SIGHUP: while ``waits``, the first one lets the step end; otherwise they interrupt at once."""

    def __init__(self) -> None:
        self.waits, self.asked = False, None  # type: bool, str | None

    def __call__(self, number: int, frame: object) -> None:
        name = signal.Signals(number).name
        if not self.waits or self.asked is not None:
            raise KeyboardInterrupt(f"interrupted by {name}")
        self.asked = name


@contextmanager
def _stops() -> Iterator[_Stop]:
    """Catch the signals that ask to stop, if this is the thread that gets them."""
    stop, before = _Stop(), {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) not in (signal.SIG_IGN, None):
                before[number] = signal.signal(number, stop)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def keep_law(p: Model, folder: Path) -> None:
    """A law that came as a file stands beside the scenario that names it."""
    if p.scenario.controller.law.endswith(".py"):
        (folder / p.scenario.controller.law).write_bytes(p.law.SOURCE)


def begin(partial: Path, p: Model, every_s: float | None, info: dict[str, Any]) -> None:
    """Put down what ``again`` needs, with the network as it was read and the run.json of the beginning."""
    place = partial / checkpoint.FOLDER
    place.mkdir()
    keep_law(p, place)
    start: dict[str, Any] = {"file": p.file, "checkpoint_every_s": every_s, "info": plain(info)}
    if p.net is not None:
        start["net"] = unpack(p.net, place).name
    else:
        start["line"] = p.spec.model_dump(mode="json", by_alias=True, exclude_none=True)
    if not p.placed:
        start["roster"] = roster.tables(p.roster)
    start["files"] = {name: sum_of(partial / name) for name in written(partial) if name != INFO}
    checkpoint.replace(place / checkpoint.START, sealed(start))


def again(partial: Path) -> tuple[Model, float | None, dict[str, Any]]:
    """The scenario of a run folder, ready to run, its ``checkpoint_every_s``, and the run.json of its beginning.

    Raises
    ------
    InputError
        It was killed before it began, or something it began with is damaged.
    """
    place = partial / checkpoint.FOLDER
    if not os.path.lexists(place / checkpoint.START):
        raise InputError(f"{partial}: it was killed before it began: start it again with `trainctl run`")
    start = unsealed(place / checkpoint.START)
    for name, expected in start["files"].items():
        verify(partial / name, expected)
    text = (partial / "scenario.toml").read_text(encoding="utf-8")
    data = tomllib.loads(text)
    network, file = data["network"], str(place / "network.toml")
    enrolled = None
    if "roster" in start:
        net = place / start["net"]
        enrolled = roster.from_tables(start["roster"], net), net
    elif "net" in start:
        data["network"] = {"net": str(place / start["net"])}
    elif network["line"].endswith(".toml"):
        remove(Path(file))
        Path(file).write_text(tomli_w.dumps(start["line"]), encoding="utf-8")
        data["network"] = {"line": file}
    scenario, found = examine(data, resolved=True)
    if scenario is None:
        raise InputError([f"{partial / 'scenario.toml'}: {line}" for line in found])
    p = model_of(scenario, start["file"], place, found, enrolled)
    original = p.scenario.model_copy(update={"network": type(p.scenario.network)(**network)})
    p = dataclasses.replace(p, scenario=original)
    if p.scenario.toml() != text:
        raise InputError(f"{partial / 'scenario.toml'}: changed since the run began, or read by another version; run it again")
    return p, start["checkpoint_every_s"], start["info"]


def open_world(p: Model, folder: Path, backend: Backend, gui: str | None = None) -> World:
    """The simulator behind the loop; SUMO's inputs and logs go to ``folder/sumo``.

    ``gui`` names a program that is driven over TraCI and shown the links instead of libsumo: "sumo-gui", or "sumo" for the same
    without a window.
    """
    if backend == "numeric":
        return Numeric(p.line)
    with ThreadPoolExecutor(1) as beside:  # netconvert takes as long as loading SUMO does
        made = beside.submit(_net, p, folder)
        from trainctl.sumo.session import Sumo
        from trainctl.sumo.signal_box import obeyed

    run, (net, place) = p.scenario.run, made.result()
    if gui is not None:
        from trainctl.sumo.gui import Gui, Map

        return (Gui if p.placed else Map)(p.line, net, place, run.step_s, run.steps, run.record_every_s, gui)
    return Sumo(p.line, net, place, run.step_s, run.steps, run.record_every_s, obeyed(p))


def open_self_driven(p: Model, folder: Path) -> SelfDriven:
    """SUMO with its own drivers; its inputs and logs go to ``folder/sumo``."""
    from trainctl.sumo.baseline import Baseline

    return Baseline(p, *_net(p, folder))


def _net(p: Model, folder: Path) -> tuple[Path, Path]:
    """The net for SUMO, and the folder it lies in."""
    place = folder / "sumo"
    place.mkdir()
    try:
        return (sumo_net.build(p.spec, place) if p.net is None else unpack(p.net, place)), place
    except LineError as error:
        raise SimulatorError("; ".join(error.mistakes)) from None


def _quietly(function: Callable[..., None], *arguments: Any, **more: Any) -> None:
    """Do what still can be done after a failure: a second one must not hide the first."""
    try:
        function(*arguments, **more)
    except Exception as error:
        print(f"trainctl: while cleaning up: {error}", file=sys.stderr)
