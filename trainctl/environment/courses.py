"""Where agents drive: many runs abreast (``Ensemble``), or one run on SUMO or on plain arithmetic (``Railway``).

Neither has a loop of its own: the one goes on by ``ensemble.steps.Abreast``, the other by ``Loop``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np

from trainctl import runner
from trainctl.ensemble.stack import alone, stacked
from trainctl.ensemble.steps import Abreast
from trainctl.environment.agents import Judged, columns, cut, judge, seen, touch
from trainctl.errors import InputError
from trainctl.loop import Loop
from trainctl.plants import disturbance
from trainctl.scenario.model import Model
from trainctl.signals import POSITION, SPEED, Bools, Floats, Ints, Links, Trains
from trainctl.stages.control import Exchanged
from trainctl.studies.jobs import Job, job_model
from trainctl.studies.sweep import SweepPlan, batches

Backend = Literal["ensemble", "numeric", "sumo"]
Acts = Literal["acceleration", "on_top"]

#: A run whose start is refused is drawn again, so many times as there are runs.
AGAIN = 20

Reward = Callable[[Judged], Floats]


class Asked(NamedTuple):
    """What somebody asks an environment to be."""

    scenario: str | Path
    runs: int
    backend: Backend
    acts: Acts
    limit_mps2: float
    jitter: Mapping[str, float]
    reward: Reward
    neighbours: int | None
    out: str | Path | None
    settings: Mapping[str, Any]


class Outcome(NamedTuple):
    """What a control period gives every agent, N rows."""

    seen: Floats  # (N, width)
    reward: Floats
    terminated: Bools
    truncated: Bools
    judged: Judged


class Now(NamedTuple):
    """Where trains are at a control instant."""

    exchanged: Exchanged
    position: Floats  # (N,) m
    speed: Floats  # (N,) m/s
    links: Links  # of those that were heard on in the last step
    left: Bools  # (N,) it has left the railway


class Course(Protocol):
    """Where agents drive, from ``begin`` to ``done``."""

    run: Ints  # (N,) of every agent
    first: Model  # of one run
    over: Bools  # (R,) runs in which trains touched

    def begin(self, seeds: Iterator[int]) -> None:
        """Put the trains on their tracks, of every run by a seed of its own."""

    @property
    def done(self) -> bool:
        """Whether run.duration_s is reached."""

    def go_on(self, commanded: Floats | None, added: Floats | None) -> None:
        """One control period under these accelerations (N,) [m/s2]."""

    def now(self) -> Now:
        """Where the trains are, and what they know once messages are exchanged; the course stays as it is."""

    def close(self) -> None:
        """Leave it."""


class Ensemble:
    """Runs abreast: those of one scenario that differ in seed and starts."""

    def __init__(self, job: Job, runs: int) -> None:
        self.job, self.runs, self.first = job, runs, job_model(job._replace(jitter={}))
        self.run = np.repeat(np.arange(runs), len(self.first.scenario.ids))
        self.held = self.first.scenario.run.held_steps
        why = alone(self.first)
        if self.first.scenario.event:  # who hears whom stays as it is
            why = "it has events"
        if why is not None:
            raise InputError(f'{job.file}: runs cannot go abreast: {why}; one of them can, with backend = "numeric" or "sumo"')

    def begin(self, seeds: Iterator[int]) -> None:
        """As in ``Course``; whose start is refused is drawn again."""
        models: list[Model] = []
        for _ in range(AGAIN * self.runs):
            try:
                models.append(job_model(seeded(self.job, next(seeds)), like=models[0] if models else None))
            except InputError as error:
                refused = error
            if len(models) == self.runs:
                break
        else:
            raise InputError([f"{len(models)} of {AGAIN * self.runs} starts can be, for {self.runs} runs:", *refused.mistakes])
        self.abreast = Abreast(stacked(models))
        self.state, self.over = self.abreast.initial(), np.zeros(self.runs, bool)
        self.length = self.abreast.p.consists.train_length()

    @property
    def done(self) -> bool:
        """As in ``Course``."""
        return self.state.k >= self.first.scenario.run.steps

    def go_on(self, commanded: Floats | None, added: Floats | None) -> None:
        """As in ``Course``."""
        for _ in range(self.held):
            self.state = self.abreast.after(self.state, commanded, added).state
            touch(self.state.position, self.state.formed.ahead, self.length, self.run, self.over)

    def now(self) -> Now:
        """As in ``Course``."""
        s, a = self.state, self.abreast
        t = s.k * a.p.scenario.run.step_s
        acting = disturbance.at(a.stack.signals, s.k, t, s.position)
        believed = a.plant.believed_resistance
        exchanged = a.control.exchanged(s.k, t, s.own, believed, s.formed, s.messages, s.memory, acting)
        return Now(exchanged, s.position, a.p.speeds(s.own), a.stack.links, a.left(s))

    def close(self) -> None:
        """Nothing to leave."""


class Railway:
    """One run by ``Loop``, in a run folder."""

    def __init__(self, job: Job, backend: runner.Backend, out: Path | None) -> None:
        self.job, self.backend, self.out, self.first = job, backend, out, job_model(job._replace(jitter={}))
        if not self.first.placed or self.first.self_driven:
            raise InputError(f"{job.file}: trains that come and go, or that SUMO drives, are no agents: place them by [[train]]")
        self.run = np.zeros(len(self.first.scenario.ids), np.int64)
        self.loop: Loop | None = None

    def begin(self, seeds: Iterator[int]) -> None:
        """As in ``Course``; whose start is refused is drawn again."""
        self.close()
        for _ in range(AGAIN):
            try:
                model = job_model(seeded(self.job, next(seeds)))
                break
            except InputError as error:
                refused = error
        else:
            raise refused
        with ExitStack() as stack:
            folder = self.out or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="trainctl."))) / "run"
            opened = runner.opened(model, folder, self.backend, True, ("trainctl.environment",))
            self.loop, self.over = stack.enter_context(opened), np.zeros(1, bool)
            self.stack = stack.pop_all()
        self.length = model.consists.train_length()

    @property
    def done(self) -> bool:
        """As in ``Course``."""
        return self._loop.over

    @property
    def _loop(self) -> Loop:
        assert self.loop is not None
        return self.loop

    def go_on(self, commanded: Floats | None, added: Floats | None) -> None:
        """As in ``Course``. Whatever fails the run is raised, and nothing is left behind."""
        loop = self._loop
        if commanded is not None:
            loop.command(slice(None), commanded)
        if added is not None:
            loop.add(added)
        try:
            for _ in range(loop.p.scenario.run.held_steps):
                loop.step()
                s = loop.state
                touch(loop.world.measure().position + s.formed.offset, s.formed.ahead, self.length, self.run, self.over)
        except BaseException as error:
            self.loop = None
            self.stack.__exit__(type(error), error, error.__traceback__)
            raise

    def now(self) -> Now:
        """As in ``Course``; of who hears whom it knows what the last step knew."""
        loop = self._loop
        s, p, t = loop.state, loop.p, loop.time
        own = loop.measured(s)
        formed, links, position = s.formed, s.formed.links, p.fronts(own)
        if links is None:  # before the first step
            links = p.first_links
            formed = formed._replace(links=links, constants=p.law.constants(p.params, p.scene(own, links, t)))
        acting = disturbance.at(loop.disturbances, s.k, t, position)
        believed = loop.plant.believed_resistance
        exchanged = loop.control.exchanged(s.k, t, own, believed, formed, s.messages, s.memory, acting)
        return Now(exchanged, position, p.speeds(own), links, ~loop.world.measure().present)

    def close(self) -> None:
        """End the run; its folder is complete, though the run may be shorter than it was to be."""
        if self.loop is not None:
            loop, self.loop = self.loop, None
            try:
                loop.end()
            except BaseException as error:
                self.stack.__exit__(type(error), error, error.__traceback__)
                raise
            self.stack.close()


class Agents:
    """One agent per train, on a course; what both kinds of environment are made of.

    Attributes
    ----------
    names : tuple of str
        Of the agents, N: the train's id, with several runs RUN/ID.
    columns : tuple of str
        What each sees.
    """

    def __init__(self, asked: Asked) -> None:
        self.asked = asked
        limit, wrong = asked.limit_mps2, []
        if not isinstance(asked.runs, int) or asked.runs < 1:
            wrong.append(f"runs = {asked.runs}: must be a whole number from 1 on")
        if not (np.isfinite(limit) and limit > 0):
            wrong.append(f"limit_mps2 = {limit}: must be finite and above 0")
        wrong += _unknown("backend", asked.backend, ("ensemble", "numeric", "sumo"))
        wrong += _unknown("acts", asked.acts, ("acceleration", "on_top"))
        if asked.backend != "ensemble" and asked.runs != 1:
            wrong.append(f'runs = {asked.runs}: several at once only with backend = "ensemble"')
        if asked.out is not None and asked.backend == "ensemble":
            wrong.append(f'out = {asked.out}: an ensemble leaves no run folder; backend = "numeric" or "sumo" does')
        if wrong:
            raise InputError(wrong)
        plan = SweepPlan(str(asked.scenario), {k: [v] for k, v in asked.settings.items()}, [1], asked.jitter, "numeric")
        (batch,) = batches(plan)
        self.course: Course
        if asked.backend == "ensemble":
            self.course = Ensemble(batch.job, asked.runs)
        else:
            self.course = Railway(batch.job, asked.backend, Path(asked.out) if asked.out is not None else None)
        p: Model = self.course.first
        if not p.sampled:
            raise InputError(
                f"{p.file}: controller.law = {p.scenario.controller.law}: is evaluated inside the integrator; agents act beside "
                "sampled laws only"
            )
        ids, run = p.scenario.ids, p.scenario.run
        self.period = run.held_steps * run.step_s
        self.names = ids if asked.runs == 1 else tuple(f"{r}/{name}" for r in range(asked.runs) for name in ids)
        usual = max(2, int(np.diff(p.first_links.first).max()))
        self.neighbours = usual if asked.neighbours is None else asked.neighbours
        self.columns = columns(self.neighbours, _words(p))
        self.first = np.zeros(1, np.int64)  # of the links seen last

    def begin(self, random: np.random.Generator) -> Floats:
        """A new episode; what every agent sees (N, width)."""
        self.course.begin(int(seed) for seed in iter(lambda: random.integers(2**32), None))
        now = self.course.now()
        self.speed, self.ended = now.speed, np.zeros(len(self.names), bool)
        return self._seen(now.exchanged)

    def step(self, actions: Floats) -> Outcome:
        """One control period under accelerations (N,) [m/s2], which are cut off at the limit.

        Of agents that were terminated before, everything is 0 from then on, and they stay terminated.
        """
        course, given = self.course, np.empty(len(self.names))
        if (wrong := cut(actions, self.asked.limit_mps2, given)) >= 0:
            raise InputError(f"action of agent {self.names[wrong]} = {actions[wrong]}: must be finite")
        course.go_on(*((given, None) if self.asked.acts == "acceleration" else (None, given)))
        now = course.now()
        error, margin, touches = judge(now.links, now.position, course.over, course.run)
        acceleration = (now.speed - self.speed) / self.period
        judged = Judged(error, now.speed - now.exchanged.leader[SPEED], acceleration, margin, touches)
        sight, reward = self._seen(now.exchanged), self.asked.reward(judged)
        if self.ended.any():
            sight[self.ended], reward = 0.0, np.where(self.ended, 0.0, reward)
        self.speed, self.ended = now.speed, self.ended | touches | now.left
        return Outcome(sight, reward, self.ended, np.full(len(now.speed), course.done), judged)

    def _seen(self, exchanged: Exchanged) -> Floats:
        if exchanged.links.first is not self.first:
            self.first = exchanged.links.first
            most = int(np.diff(self.first).max())
            if most > self.neighbours:
                raise InputError(f"a train receives on {most} links, an agent sees {self.neighbours}: set neighbours = {most}")
        return seen(exchanged, len(self.columns))


def _unknown(key: str, value: str, known: tuple[str, ...]) -> list[str]:
    return [] if value in known else [f"{key} = {value}: must be one of {', '.join(known)}"]


def _words(p: Model) -> int:
    """Numbers of one message."""
    scene, n = p.scene(p.own, p.first_links, 0.0), len(p.scenario.ids)
    constants = p.law.constants(p.params, scene)
    trains = Trains(p.own[p.leading, POSITION], p.own[p.leading, SPEED], np.zeros(n))
    memory = (p.law.initial(p.params, scene),) if p.remembers else ()
    return int(p.law.message(constants, trains, p.leader(0.0), *memory).shape[1])


def seeded(job: Job, seed: int) -> Job:
    """A run with another seed."""
    return job._replace(tables={**job.tables, "run": {**job.tables["run"], "seed": seed}})
