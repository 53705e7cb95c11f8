"""A run from start to end: the folder, the network, the loop, the metrics, and what run.json says afterwards."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import sumo_net
from sumo_net import LineError
from trainctl.errors import InputError, SimulatorError
from trainctl.loop import Simulation
from trainctl.prepare import Prepared
from trainctl.record.folder import about_run, claim, finish, remove, write_info, write_json
from trainctl.record.journal import Journal
from trainctl.record.metrics import metrics
from trainctl.record.run import Run
from trainctl.world import Numeric, World

Backend = Literal["sumo", "numeric"]


def run(
    p: Prepared,
    out: Path,
    backend: Backend = "sumo",
    force: bool = False,
    command_line: Sequence[str] = (),
    progress: Callable[[int, int], Any] | None = None,
    gui: str | None = None,
) -> Run:
    """Run a scenario into the folder ``out``.

    Parameters
    ----------
    p : Prepared
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
    with opened(p, out, backend, force, command_line, gui) as simulation:
        simulation.run(progress)
    return Run(out)


@contextmanager
def opened(
    p: Prepared,
    out: Path,
    backend: Backend = "sumo",
    force: bool = False,
    command_line: Sequence[str] = (),
    gui: str | None = None,
) -> Iterator[Simulation]:
    """A run folder and the loop in it, for whoever drives it; arguments and errors as in ``run``.

    When the block ends the run is complete; when it raises, the run failed.
    """
    partial = claim(out, force)
    text = p.scenario.toml()
    (partial / "scenario.toml").write_text(text, encoding="utf-8")
    info = about_run(text, p.scenario.run.seed or 0, command_line or sys.argv, backend=backend)
    write_info(partial, info)
    began, journal, world, simulation = time.perf_counter(), None, None, None

    def ended(status: str, **more: Any) -> None:
        steps = simulation.k if simulation is not None else 0
        write_info(
            partial, {**info, "status": status, "steps": steps, "wall_time_s": round(time.perf_counter() - began, 3), **more}
        )

    try:
        journal = Journal(partial, p)
        world = open_world(p, partial, backend, gui)
        simulation = Simulation(p, world, journal)
        yield simulation
        world.close()
        for at, message in world.messages():
            journal.event(simulation.time if at is None else at, "sumo_warning", message=message)
        journal.close()
        write_json(partial / "metrics.json", metrics(Run(partial)))
        ended("complete", violations=simulation.alarms.total)
    except BaseException as error:
        for thing in (world, journal):
            if thing is not None:
                _quietly(thing.close)
        if isinstance(error, InputError):
            remove(partial)
        else:
            when = simulation.time if simulation is not None else 0.0
            status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
            _quietly(ended, status, failure={"reason": str(error) or type(error).__name__, "time_s": when})
        raise
    finish(out)


def open_world(p: Prepared, folder: Path, backend: Backend, gui: str | None = None) -> World:
    """The simulator behind the loop; SUMO's inputs and logs go to ``folder/sumo``.

    ``gui`` names a program that is driven over TraCI and shown the links instead of libsumo: "sumo-gui", or "sumo" for the same
    without a window.
    """
    if backend == "numeric":
        return Numeric(p.line)
    from trainctl.sumo.session import Sumo

    place = folder / "sumo"
    place.mkdir()
    try:
        if p.net is None:
            net = sumo_net.build(p.spec, place)
        else:
            net = place / p.net.name
            net.write_bytes(p.net.read_bytes())
    except LineError as error:
        raise SimulatorError("; ".join(error.mistakes)) from None
    if gui is not None:
        from trainctl.sumo.gui import Gui

        return Gui(p.line, net, place, p.scenario.run.step_s, p.scenario.run.steps, gui)
    return Sumo(p.line, net, place, p.scenario.run.step_s, p.scenario.run.steps)


def _quietly(function: Callable[..., None], *arguments: Any, **more: Any) -> None:
    """Do what still can be done after a failure: a second one must not hide the first."""
    try:
        function(*arguments, **more)
    except Exception as error:
        print(f"trainctl: while cleaning up: {error}", file=sys.stderr)
