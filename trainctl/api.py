"""The package from Python: run a scenario and look at it, or drive it step by step.

>>> run = trainctl.run("three_tracks", **{"run.duration_s": 60})     # doctest: +SKIP
>>> run.trains, run.metrics, run.plot.spacing()                      # doctest: +SKIP

SUMO holds one simulation per process: close one before opening the next.
"""

from __future__ import annotations

import html
import tempfile
import warnings
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import cached_property
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from pydantic import ValidationError

from trainctl import runner
from trainctl.errors import InputError
from trainctl.record.folder import place_for, run_name
from trainctl.runner import Backend
from trainctl.runs import run as recorded
from trainctl.runs.outcome import summary
from trainctl.scenario.build import open_scenario
from trainctl.scenario.events import Event
from trainctl.scenario.reading import mistakes
from trainctl.signals import POSITION, SPEED, Floats

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from trainctl import loop

#: What a run tells of itself in a notebook: metric -> words.
HEADLINES = {
    "bounds.broken": "kinds of bound violated",
    "bounds.spacing_lower_margin_m": "minimum spacing above its lower bound [m]",
    "bounds.spacing_upper_margin_m": "minimum room below the upper spacing bound [m]",
    "formation.settling_s": "all links within 1 m from this time of the run [s]",
    "formation.final_error_m": "largest spacing error at the end [m]",
}


def run(
    scenario: str | Path = "three_tracks",
    *,
    backend: Backend = "sumo",
    out: str | Path | None = None,
    force: bool = False,
    progress: Callable[[int, int], Any] | None = None,
    **settings: Any,
) -> Run:
    """Run a scenario, as `trainctl run` does.

    Parameters
    ----------
    scenario : str or Path
        Name of a shipped scenario, or path of a TOML.
    backend : {"sumo", "numeric"}
        SUMO, or the same loop without a simulator.
    out : Path, optional
        Run folder; default ``runs/NAME``, with settings ``runs/NAME+KEY=VALUE``. An earlier run is replaced, unless more than a run
        lies there: by default it then goes to ``NAME-2``.
    force : bool
        Replace whatever lies there.
    progress : callable, optional
        Called with (steps done, steps).
    **settings
        Keys of the scenario to override: ``**{"run.duration_s": 60}``.

    Returns
    -------
    Run
        Also of a run in which trains collided or blocked each other: see ``Run.ok`` and ``Run.collisions``.

    Raises
    ------
    InputError
        Everything that is wrong with the scenario.
    TrainctlError
        The run failed.
    """
    if out is None:
        folder, elsewhere = place_for(Path("runs") / run_name(scenario, [f"{key}={value}" for key, value in settings.items()]))
        if elsewhere:
            warnings.warn(elsewhere, stacklevel=2)
    else:
        folder = Path(out)
    runner.run(open_scenario(str(scenario), settings), folder, backend, force, ("trainctl.run",), progress)
    return Run(folder)


def open(folder: str | Path) -> Run:
    """Open a run folder."""
    return Run(folder)


class Run(recorded.Run):
    """A run folder in a notebook: tables as DataFrames (``trains``, ``units``, ``links``), ``events``, ``metrics``, ``plot``.

    ``ok`` says whether anything failed the run, ``collisions`` how many pairs of trains collided.
    """

    @cached_property
    def plot(self) -> Plots:
        """Figures by name: ``run.plot.spacing()``."""
        return Plots(self)

    def _repr_html_(self) -> str:
        rows = [("folder", str(self.folder)), ("status", str(self.info.get("status")))]
        if (self.folder / "scenario.toml").is_file():
            law, plant = self.scenario["controller"]["law"], self.scenario.get("plant", {}).get("kind", "point")
            rows += [
                ("scenario", self.scenario["title"]),
                ("law, plant", f"{law} on {plant}, {len(self.scenario['train'])} trains"),
            ]
        if "violations" in self.info:
            rows += [(line.title, f"FAILED: {line.text}" if line.failed else line.text) for line in summary(self)]
        if (self.folder / "metrics.json").is_file():
            known = ((words, self.metrics.get(key)) for key, words in HEADLINES.items())
            rows += [(words, f"{value:.6g}") for words, value in known if isinstance(value, int | float)]
        cells = "".join(f"<tr><th style='text-align:left'>{html.escape(a)}</th><td>{html.escape(b)}</td></tr>" for a, b in rows)
        return f"<table>{cells}</table>"


class Plots:
    """The figures of a run: ``plot.NAME(width="double")`` is a matplotlib figure; ``dir(plot)`` lists those that apply."""

    def __init__(self, run: recorded.Run) -> None:
        self._run = run

    def __dir__(self) -> list[str]:
        from trainctl.figures import catalogue, style
        from trainctl.figures import trains as figures_trains

        with style.styled():
            return sorted(catalogue.applicable(figures_trains.drawable(self._run, "double")))

    def __getattr__(self, name: str) -> Callable[..., Figure]:
        from trainctl.figures import catalogue

        if name not in catalogue.FIGURES:
            raise AttributeError(f"no figure {name}; there are: {', '.join(catalogue.FIGURES)}")

        def draw(width: str = "double") -> Figure:
            figure = catalogue.figure(self._run, name, width)
            # A notebook shows what has this; figures made without pyplot have it not.
            figure._repr_png_ = lambda: _png(figure)  # type: ignore[attr-defined]
            return figure

        draw.__name__ = name
        draw.__doc__ = catalogue.FIGURES[name].__doc__
        return draw


def _png(figure: Figure) -> bytes:
    out = BytesIO()
    figure.savefig(out, format="png", dpi=110)
    return out.getvalue()


class Simulation:
    """A scenario step by step, for loops of your own.

    >>> with trainctl.Simulation.open("three_tracks", **{"run.duration_s": 60}) as sim:     # doctest: +SKIP
    ...     while not sim.done:
    ...         sim.command({"2": -0.05})
    ...         sim.step()

    Attributes
    ----------
    trains : tuple of str
        Ids, in the order of all arrays.
    """

    def __init__(self, stack: ExitStack, simulation: loop.Loop, out: Path | None) -> None:
        self._stack, self._loop, self._out = stack, simulation, out
        self._open = True
        self.trains: tuple[str, ...] = tuple(simulation.p.scenario.ids)

    @classmethod
    def open(
        cls,
        scenario: str | Path = "three_tracks",
        *,
        backend: Backend = "sumo",
        out: str | Path | None = None,
        force: bool = False,
        **settings: Any,
    ) -> Simulation:
        """Put the trains on the line, at time 0.

        Parameters
        ----------
        scenario, backend, force, **settings
            As in ``run``.
        out : Path, optional
            Run folder; default none: nothing is kept.
        """
        model = open_scenario(str(scenario), settings)
        with ExitStack() as stack:
            if out is None:
                folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="trainctl."))) / "run"
            else:
                folder = Path(out)
            opened = runner.opened(model, folder, backend, force, ("trainctl.Simulation",))
            simulation = stack.enter_context(opened)
            return cls(stack.pop_all(), simulation, Path(out) if out is not None else None)

    @property
    def time(self) -> float:
        """Scenario time of the present state [s]."""
        return self._loop.time

    @property
    def done(self) -> bool:
        """Whether run.duration_s is reached."""
        return self._loop.k >= self._loop.p.scenario.run.steps

    @property
    def position_m(self) -> Floats:
        """Front of every train on the line [m], shape (n,)."""
        return self._loop.world.measure().position.copy()

    @property
    def speed_mps(self) -> Floats:
        """Speed of every train's leading unit [m/s], shape (n,)."""
        return np.asarray(self._loop.state.own[self._loop.p.leading, SPEED].copy())

    @property
    def track(self) -> list[str]:
        """Track every train is on."""
        line = self._loop.p.line
        return [line.tracks[k] for k in self._loop.world.measure().edge]

    @property
    def reference(self) -> tuple[float, float]:
        """Position [m] and speed [m/s] of the scenario's reference now, which all trains share.

        Raises
        ------
        InputError
            Trains come and go: every formation has a reference of its own, see ``reference_of``.
        """
        if not self._loop.p.placed:
            raise InputError("reference: every formation of a SUMO configuration has its own: ask reference_of(train)")
        position, speed = self._loop.p.leader(self.time)[:2]
        return float(position), float(speed)

    @property
    def state(self) -> pd.DataFrame:
        """One row per train: train, track, position_m, speed_mps."""
        return pd.DataFrame({"train": self.trains, "track": self.track, "position_m": self.position_m, "speed_mps": self.speed_mps})

    @property
    def units(self) -> pd.DataFrame:
        """One row per unit: train, unit, position_m, speed_mps."""
        first, own = self._loop.p.consists.first, self._loop.state.own
        names = np.repeat(np.array(self.trains, dtype=object), np.diff(first))
        frame = pd.DataFrame({"train": names, "unit": self._loop.p.unit})
        return frame.assign(position_m=own[:, POSITION], speed_mps=own[:, SPEED])

    @property
    def links(self) -> pd.DataFrame:
        """Who received from whom in the last step: sender, receiver, spacing_m, desired_m, lower_m, upper_m, heard."""
        links = self._loop.state.formed.links
        if links is None:  # before the first step
            links = self._loop.p.first_links
        names, x = np.array(self.trains, dtype=object), self.position_m
        return pd.DataFrame(
            {
                "sender": names[links.sender], "receiver": names[links.receiver],
                "spacing_m": x[links.sender] - x[links.receiver], "desired_m": links.desired, "lower_m": links.lower,
                "upper_m": links.upper, "heard": links.heard,
            }
        )  # fmt: skip

    def reference_of(self, train: str) -> tuple[float, float]:
        """Position [m] along the train's own route and speed [m/s] of the reference it follows now.

        Where trains come and go that is the reference of its formation; a train in none is a reference of its own.
        """
        i, formed = self._number(train), self._loop.state.formed
        if not formed.led[i]:
            return float(self.position_m[i]), float(self.speed_mps[i])
        position, speed = formed.references.leader(self.time).reshape(4, -1)[:2, i if len(formed.references.breaks) > 1 else 0]
        return float(position - formed.offset[i]), float(speed)

    def step(self, steps: int = 1) -> float:
        """Advance by that many steps; returns the time [s]."""
        for _ in range(steps):
            if not self._open or self.done:
                raise InputError(f"the simulation has ended at {self.time:g} s: run.duration_s says how long it can go on")
            self._guard(self._loop.step)
        return self.time

    def command(self, acceleration_mps2: Mapping[str, float]) -> None:
        """Drive trains from outside: from the next step on they are asked for this acceleration, not for the law's.

        The limits of the plant still apply, and so do the clamps of speed and input of a law that drives the train; the supervisor
        acts as on any other train. A train in no formation is commanded like any other; one that stands at a stop stays there.

        Parameters
        ----------
        acceleration_mps2 : mapping of str to float
            By train id; stays until it is changed or released.
        """
        if not self._loop.p.sampled:
            law = self._loop.p.scenario.controller.law
            raise InputError(f"law {law} is evaluated inside the integrator: only trains under a sampled law can be commanded")
        numbers = [self._number(train) for train in acceleration_mps2]
        values = np.array([float(a) for a in acceleration_mps2.values()])
        if not np.isfinite(values).all():
            raise InputError("acceleration_mps2: must be finite")
        self._loop.command(numbers, values)

    def release(self, *trains: str) -> None:
        """Give trains back to the law, from its next control instant on; without names, all."""
        self._loop.command([self._number(t) for t in trains] if trains else slice(None), np.nan)

    def reroute(
        self,
        train: str,
        *,
        to_track: str | None = None,
        crossover: str | None = None,
        to_edge: str | None = None,
        position_m: float | None = None,
        gap_below_m: float | None = None,
        speed_below_mps: float | None = None,
    ) -> None:
        """Order a train onto another track, over the next crossover to it or over one named, or to an edge of the net.

        The order is followed at once, or where its front passes ``position_m``, or as soon as the gap to the train ahead or its
        speed is below a value. One that cannot be followed is logged as the event ``reroute_refused``, with the reason.

        Raises
        ------
        InputError
            There is no such train, track, crossover or edge.
        """
        loop, line = self._loop, self._loop.p.line
        self._number(train)
        wrong = []
        if to_track is not None and str(to_track) not in line.track_ids:
            wrong.append(f"reroute: to_track = {to_track}: no such track; there are: {', '.join(line.track_ids)}")
        if crossover is not None and crossover not in line.crossover:
            wrong.append(f"reroute: crossover = {crossover}: no such crossover")
        if to_edge is not None and to_edge not in line.index:
            wrong.append(f"reroute: to_edge = {to_edge}: no such edge")
        if wrong:
            raise InputError(wrong)
        try:
            event = Event(
                kind="reroute", train=str(train), crossover=crossover, to_track=None if to_track is None else str(to_track),
                to_edge=to_edge, time_s=self.time, position_m=position_m, gap_below_m=gap_below_m, speed_below_mps=speed_below_mps,
            )  # fmt: skip
        except ValidationError as error:
            raise InputError([f"reroute: {line}" for line in mistakes(error, {}, "", Event)]) from None
        loop.order(event)

    def close(self) -> Run | None:
        """End the simulation; the run folder, if ``out`` was given."""
        if self._open:
            self._guard(self._loop.end)
            self._open = False
            self._stack.close()
        return Run(self._out) if self._out is not None else None

    def __enter__(self) -> Simulation:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if kind is None:
            self.close()
        elif self._open:
            self._open = False
            self._stack.__exit__(kind, error, trace)

    def __repr__(self) -> str:
        """Where it stands."""
        law = self._loop.p.scenario.controller.law
        return (
            f"Simulation({self._loop.p.file}: {law}, {len(self.trains)} trains, {self.time:g} s{'' if self._open else ', closed'})"
        )

    def _number(self, train: str) -> int:
        if str(train) not in self.trains:
            raise InputError(f"train {train}: no such train; there are: {', '.join(self.trains)}")
        return self.trains.index(str(train))

    def _guard(self, action: Callable[[], Any]) -> None:
        """Do something in the loop; if it fails, the run has failed."""
        try:
            action()
        except BaseException as error:
            self._open = False
            self._stack.__exit__(type(error), error, error.__traceback__)
            raise
