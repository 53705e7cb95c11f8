"""Gains of a law for an objective, with all bounds kept in every one of many disturbed runs.

Numeric runs side by side (``ensemble``) judge a candidate; they differ in their seeds alone: starts, disturbances, losses. The
search is scipy's differential evolution [1]_, seeded; a candidate that violates a bound is worse than any that does not, and the
fewer of its runs do the better, so that the search finds its way to where bounds are kept.

References
----------
.. [1] Storn, Price, "Differential Evolution - a Simple and Efficient Heuristic for Global Optimization over Continuous Spaces",
   Journal of Global Optimization 11 (1997).
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import tomli_w

from trainctl.errors import InputError
from trainctl.processes import processes
from trainctl.scenario.reading import find, read
from trainctl.signals import Floats
from trainctl.studies.blocks import simulate_block
from trainctl.studies.results import Part
from trainctl.studies.sweep import SweepPlan, batches

if TYPE_CHECKING:
    import pandas as pd

    from trainctl.scenario.model import Model

FORMAT = "trainctl tune"
INFO, TABLE, FIGURE, SCENARIO = "tune.json", "search.parquet", "search.png", "tuned.toml"

#: A gain whose range spans more than this factor is searched in its logarithm.
WIDE = 8.0

#: Value of a candidate of which every run violates a bound, and of one that cannot run at all: beyond any objective.
VIOLATED, REFUSED = 1e15, 3e15

#: Candidates of one generation, per gain; and at least.
PER_GAIN, FEWEST = 6, 8


def _settling(found: Part) -> Floats:
    """When the formation has settled; twice the time of a run where it has not."""
    last = found.metrics["formation.last_link_s"]
    settled = found.metrics.get("formation.settling_s", np.full(len(last), np.nan))
    return np.where(np.isnan(settled), 2.0 * last, settled)


def _margin(found: Part) -> Floats:
    """Room above the lower spacing bounds, or the gap where there are none, less than nothing: more room is better."""
    room = found.metrics.get("bounds.spacing_lower_margin_m", found.metrics["traffic.gap_min_m"])
    return -np.where(np.isnan(room), found.metrics["traffic.gap_min_m"], room)


#: Objectives: number of every run, how the runs are put together, unit; the search makes them small.
OBJECTIVES: dict[str, tuple[Callable[[Part], Floats], Callable[[Floats], Any], str]] = {
    "settling": (_settling, np.mean, "s, mean time at which all links are within 1 m"),
    "margin": (_margin, np.max, "m, minus the smallest room above a spacing bound in any run"),
    "energy": (lambda found: found.metrics["energy.net_kwh_per_train_km"], np.mean, "kWh per train-km, mean"),
    "jerk": (lambda found: found.metrics["comfort.jerk_rms_mps3"], np.mean, "m/s3, mean of the root mean square"),
}


class Gain(NamedTuple):
    """A key of ``[controller]`` and where its best value is looked for."""

    name: str
    low: float
    high: float

    @property
    def wide(self) -> bool:
        """Whether it is searched in its logarithm."""
        return self.low > 0.0 and self.high > WIDE * self.low


@dataclass(frozen=True)
class TunePlan:
    """What to look for: ``objective`` maps names of ``OBJECTIVES`` to their weights."""

    scenario: str
    gains: tuple[Gain, ...]
    objective: Mapping[str, float]
    settings: Mapping[str, Any]
    seeds: Sequence[int]
    jitter: Mapping[str, float]
    evaluations: int = 100


class Candidate(NamedTuple):
    """Gains, and what their runs gave."""

    gains: tuple[float, ...]
    value: float  # what the search makes small
    violated: int  # runs that violated a bound, collided or failed
    objectives: dict[str, float]  # every one of ``OBJECTIVES`` that the runs have
    reason: str  # why it cannot run; empty: it can


# What is asked


def gain(text: str) -> Gain:
    """``KEY=LOW..HIGH`` of the command line."""
    key, equals, span = text.partition("=")
    low, dots, high = span.partition("..")
    try:
        found = Gain(key.removeprefix("controller."), float(low), float(high))
    except ValueError:
        found = Gain("", 1.0, 0.0)
    if not (equals and dots and found.name and -np.inf < found.low < found.high < np.inf):
        raise InputError(f"--gain {text}: must be KEY=LOW..HIGH, such as h_per_s=0.1..0.9")
    return found


def objective(text: str) -> dict[str, float]:
    """``settling`` or ``settling=1,jerk=20`` of the command line."""
    found: dict[str, float] = {}
    for piece in text.split(","):
        name, equals, weight = (word.strip() for word in piece.partition("="))
        if name in found:
            raise InputError(f"--objective {name}: given twice")
        if name not in OBJECTIVES:
            raise InputError(f"--objective {name}: no such objective; known: {', '.join(OBJECTIVES)}")
        try:
            found[name] = float(weight) if equals else 1.0
        except ValueError:
            found[name] = np.nan
        if not 0.0 < found[name] < np.inf:
            raise InputError(f"--objective {piece.strip()}: a weight must be above 0")
    return found


def prepared(plan: TunePlan) -> Model:
    """The first run with the gains of the scenario, once everything asked for makes sense.

    Raises
    ------
    InputError
        The scenario is wrong, its law has no gains or not these, its runs cannot be taken side by side.
    """
    from trainctl.ensemble.stack import alone
    from trainctl.studies.jobs import job_model

    if not plan.seeds:
        raise InputError("--seeds: missing; every candidate is judged by runs with these seeds")
    if plan.evaluations < 2 * FEWEST:
        raise InputError(f"--evaluations {plan.evaluations}: at least {2 * FEWEST}, two generations of candidates")
    (batch,) = batches(_sweep(plan, {}))
    model = job_model(batch.job._replace(jitter={}))
    law = model.scenario.controller.law
    known = numbers(model)
    if not known:
        raise InputError(f"controller.law = {law}: has no gains: none of its keys is a number")
    said = ", ".join(f"{key} = {value:g}" for key, value in known.items())
    if not plan.gains:
        raise InputError(f"--gain: missing; the numbers of law {law} are {said}")
    names = [g.name for g in plan.gains]
    wrong = [f"--gain {name}: not a number of law {law}; there are: {said}" for name in names if name not in known]
    wrong += [f"--gain {name}: given more than once" for name in dict.fromkeys(names) if names.count(name) > 1]
    if wrong:
        raise InputError(wrong)
    if (why := alone(model)) is not None:
        raise InputError(f"{model.file}: its runs cannot be taken side by side: {why}")
    return model


def numbers(model: Model) -> dict[str, float]:
    """The keys of a law that are one number each, no count, and their values."""
    return {key: value for key, value in model.params.model_dump().items() if isinstance(value, float)}


def _sweep(plan: TunePlan, gains: Mapping[str, float]) -> SweepPlan:
    settings = {**plan.settings, **{f"controller.{key}": value for key, value in gains.items()}}
    return SweepPlan(plan.scenario, {key: [value] for key, value in settings.items()}, plan.seeds, plan.jitter, "numeric")


# One candidate


def judged(plan: TunePlan, gains: tuple[float, ...]) -> Candidate:
    """Run the runs of one candidate in this process."""
    try:
        (batch,) = batches(_sweep(plan, {g.name: value for g, value in zip(plan.gains, gains, strict=True)}))
    except InputError as error:
        return Candidate(gains, REFUSED, len(plan.seeds), {}, error.mistakes[0])
    found = simulate_block(batch)
    good = np.array([status == "complete" for status in found.status])
    bad = int((~good | (found.counts["violations"] > 0) | (found.counts["collisions"] > 0)).sum())
    if not good.all():
        why = next(f for f, status in zip(found.failure, found.status, strict=True) if status != "complete")
        return Candidate(gains, VIOLATED * (1.0 + bad / len(good)), bad, {}, str(why))
    objectives = {}
    for name, (number, together, _) in OBJECTIVES.items():
        try:
            objectives[name] = float(together(number(found)))
        except KeyError:
            continue
    missing = [name for name in plan.objective if not np.isfinite(objectives.get(name, np.nan))]
    if missing:
        return Candidate(gains, REFUSED, bad, objectives, f"its runs have no {missing[0]}")
    value = sum(weight * objectives[name] for name, weight in plan.objective.items())
    return Candidate(gains, value if not bad else VIOLATED * bad / len(good), bad, objectives, "")


# The search


def tune(
    plan: TunePlan,
    out: Path,
    *,
    workers: int | None = None,
    force: bool = False,
    command_line: Sequence[str] = (),
    progress: Callable[[int, int, Candidate], Any] | None = None,
) -> dict[str, Any]:
    """Search, and leave what was found in the folder ``out``.

    Parameters
    ----------
    plan : TunePlan
        What to look for.
    out : Path
        Gets ``tuned.toml``, the scenario with the best gains; ``search.parquet`` and ``search.png``, all candidates; ``tune.json``.
    workers : int, optional
        Processes; default one per core.
    force : bool
        Replace what lies there.
    command_line : sequence of str
        For tune.json.
    progress : callable, optional
        Called with (candidates done, candidates at most, the best one so far).

    Returns
    -------
    dict
        The content of tune.json.

    Raises
    ------
    InputError
        What is asked for makes no sense, or the folder cannot be used.
    """
    from trainctl.record.folder import free, held, installed, remove, write_json

    model = prepared(plan)
    with held(out):
        if not (free(out) or force):
            raise InputError(f"{out}: exists: choose another --out, or --force to replace it")
        if out.resolve() == Path.cwd() or out.resolve() in Path.cwd().parents:
            raise InputError(f"{out}: holds the current directory: choose another --out")
        try:
            remove(out)
            out.mkdir(parents=True)
        except OSError as error:
            raise InputError(f"{out}: cannot be written: {error.strerror}") from None
    began = time.perf_counter()
    with held(out):
        now = numbers(model)
        found = _searched(plan, tuple(now[g.name] for g in plan.gains), workers or os.cpu_count() or 1, progress)
        start, best = found[0], min(found, key=lambda c: c.value)
        refused = [c for c in found if c.reason]
        frame = table(plan, found)
        frame.to_parquet(out / TABLE, index=False)
        from trainctl.figures.tune import search

        search(frame, [g.name for g in plan.gains], [g.wide for g in plan.gains], " + ".join(_words(plan)), out / FIGURE)
        kept = best.violated == 0 and not best.reason
        if kept:
            (out / SCENARIO).write_text(_scenario(plan, best), encoding="utf-8")
        info = {
            "format": FORMAT, "scenario": model.file, "law": model.scenario.controller.law,
            "gains": {g.name: [g.low, g.high] for g in plan.gains}, "objective": dict(plan.objective), "set": dict(plan.settings),
            "seeds": list(plan.seeds), "jitter": dict(plan.jitter), "candidates": len(found), "bounds_kept": kept,
            "refused": len(refused), "refusal": refused[0].reason if refused else None,
            "start": _told(plan, start), "best": _told(plan, best),
            "versions": {name: installed(p) for name, p in (("trainctl", "trainctl"), ("scipy", "scipy"))},
            "command_line": list(command_line), "wall_time_s": round(time.perf_counter() - began, 3),
        }  # fmt: skip
        write_json(out / INFO, info)
    return info


def _searched(
    plan: TunePlan, start: tuple[float, ...], workers: int, progress: Callable[[int, int, Candidate], Any] | None
) -> list[Candidate]:
    """All candidates in the order they were judged; the first one is that of the scenario."""
    from scipy.optimize import differential_evolution

    found: list[Candidate] = []
    size = min(max(FEWEST, PER_GAIN * len(plan.gains)), plan.evaluations // 2)
    generations = max(1, (plan.evaluations - 1) // size)
    most = 1 + size * generations
    bounds = [(np.log(g.low), np.log(g.high)) if g.wide else (g.low, g.high) for g in plan.gains]

    def gains(x: Iterable[float]) -> tuple[float, ...]:
        return tuple(
            float(np.clip(np.exp(value) if g.wide else value, g.low, g.high)) for value, g in zip(x, plan.gains, strict=True)
        )

    with _judges(workers) as judges:

        def judge(candidates: Iterable[tuple[float, ...]]) -> list[float]:
            begun = len(found)
            for candidate in judges(partial(judged, plan), list(candidates)):
                found.append(candidate)
                if progress is not None:
                    progress(len(found), most, min(found, key=lambda c: c.value))
            return [candidate.value for candidate in found[begun:]]

        judge([start])
        differential_evolution(
            lambda x: np.nan, bounds, workers=lambda _, population: judge(map(gains, population)), updating="deferred",
            maxiter=generations - 1, popsize=1, init=_first(size, bounds), polish=False, tol=1e-3, rng=0,
        )  # fmt: skip
    return found


def _first(size: int, bounds: Sequence[tuple[float, float]]) -> Floats:
    """The first generation, spread over the ranges: a Latin hypercube."""
    from scipy.stats import qmc

    low, high = np.array(bounds).T
    spread: Floats = qmc.scale(qmc.LatinHypercube(len(bounds), rng=0).random(size), low, high)
    return spread


@contextmanager
def _judges(workers: int) -> Iterator[Callable[[Callable[[Any], Candidate], Sequence[Any]], Iterable[Candidate]]]:
    """A ``map`` over so many processes."""
    if workers == 1:
        yield map
        return
    with processes(workers) as pool:
        yield pool.map


# What was found


def table(plan: TunePlan, found: Sequence[Candidate]) -> pd.DataFrame:
    """All candidates, a row each."""
    import pandas as pd

    columns: dict[str, Any] = {"candidate": range(len(found))}
    columns |= {g.name: [c.gains[k] for c in found] for k, g in enumerate(plan.gains)}
    kept = [not c.violated and not c.reason for c in found]
    columns["objective"] = [
        sum(w * c.objectives[name] for name, w in plan.objective.items()) if not c.reason else np.nan for c in found
    ]
    columns |= {"bounds_kept": kept, "runs_violated": [c.violated for c in found]}
    columns |= {name: [c.objectives.get(name, np.nan) for c in found] for name in OBJECTIVES}
    columns["reason"] = [c.reason for c in found]
    return pd.DataFrame(columns)


def _words(plan: TunePlan) -> list[str]:
    return [name if weight == 1.0 else f"{weight:g} {name}" for name, weight in plan.objective.items()]


def _told(plan: TunePlan, c: Candidate) -> dict[str, Any]:
    gains = {g.name: value for g, value in zip(plan.gains, c.gains, strict=True)}
    value = c.value if c.value < VIOLATED / len(plan.seeds) else None
    return {"gains": gains, "objective": value, "runs_violated": c.violated, **c.objectives, "reason": c.reason or None}


def _scenario(plan: TunePlan, best: Candidate) -> str:
    """A scenario over the one that was tuned, with what was set, the best gains and the first of the seeds."""
    data, path = read(plan.scenario)
    beside = plan.scenario if Path(plan.scenario).suffix != ".toml" else str(find(plan.scenario).resolve())
    title = f"{data.get('title', path.stem)}, tuned for {' + '.join(_words(plan))}"
    tables: dict[str, Any] = {"extends": beside, "title": title}
    settings = {"run.seed": plan.seeds[0], **plan.settings}
    settings |= {f"controller.{g.name}": v for g, v in zip(plan.gains, best.gains, strict=True)}
    for key, value in settings.items():
        *parents, last = key.split(".")
        place = tables
        for parent in parents:
            place = place.setdefault(parent, {})
        place[last] = value
    head = f"# Written by trainctl tune: {len(plan.seeds)} runs, bounds kept in all of them.\n"
    return head + tomli_w.dumps(tables)
