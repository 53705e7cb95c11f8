"""Runs of a sweep side by side: which can be, in blocks of how many, and what a block gives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from trainctl.errors import InputError
from trainctl.scenario.model import Model
from trainctl.studies.jobs import Batch, Job, job_model, simulate
from trainctl.studies.results import COUNTS, Part, joined, part

#: From so many runs on a batch is stacked.
SMALLEST = 10

#: Trains of one block: enough to share the fixed cost of a step, few enough for the second cache.
TRAINS = 6000

#: Trains of one block where they have units: ten runs are as fast as any number, and results come by the block.
TRAINS_OF_UNITS = 120

#: Positions a block remembers, trains times recorded instants.
REMEMBERED = 8_000_000

#: Every worker gets at least so many blocks, so that none waits long for the last one.
PER_WORKER = 4


def refusal(batch: Batch, beside: Model | None) -> tuple[str | None, Model | None]:
    """Why runs of a batch are not stacked, in words, and the model of one of them.

    Parameters
    ----------
    batch : Batch
        Free of mistakes.
    beside : Model or None
        A run on the same line under the same law.
    """
    from trainctl.ensemble.stack import alone

    if batch.job.backend != "numeric":
        return "the backend is SUMO", None
    if batch.job.keep is not None:
        return "--keep asks for its tables", None
    if len(batch.seeds) < SMALLEST:
        return f"fewer than {SMALLEST} runs differ in their seeds alone", None
    for job in batch.of(range(SMALLEST)).each():
        try:
            model = job_model(job, beside)
        except InputError:
            continue
        return alone(model), model
    return "its start is refused", None


def blocks(batch: Batch, model: Model, workers: int) -> list[Batch]:
    """A batch in blocks, for so many workers; ``model`` is one of its runs."""
    run, n, runs = model.scenario.run, len(model.scenario.ids), len(batch.seeds)
    rows = run.steps // run.recorded_steps + 2
    trains = TRAINS_OF_UNITS if model.has_units else TRAINS
    most = max(1, min(trains // n, REMEMBERED // (n * rows)))
    size = max(1, min(most, math.ceil(runs / (PER_WORKER * workers))))
    return [batch.of(piece.tolist()) for piece in np.array_split(np.arange(runs), math.ceil(runs / size))]


def simulate_block(block: Batch) -> Part:
    """Run a block in this process, results in the order of its runs. What cannot be stacked runs by itself. Never raises."""
    from trainctl.ensemble.stack import alone, kind, restarts

    jobs, models = block.each(), list[Model]()
    why: list[str | None] = []
    for job in jobs:
        model: Model | None = None
        try:
            model = job_model(job, like=models[0] if models else None)
            if models and restarts(model, models[0]):
                reason = None
            else:
                reason = alone(model) or (None if not models or kind(model) == kind(models[0]) else "it is unlike the others")
        except InputError:
            reason = "its start is refused"
        except Exception as error:  # its own run tells it
            reason = f"{type(error).__name__}: {error}"
        why.append(reason)
        if reason is None and model is not None:
            models.append(model)
    together = [k for k, reason in enumerate(why) if reason is None]
    found: Part | None = None
    if models:
        found, reasons = _stacked([jobs[k] for k in together], models)
        for k, reason in zip(together, reasons, strict=True):
            why[k] = reason
    single = {k: simulate(job) for k, job in enumerate(jobs) if why[k] is not None}
    return _in_order(jobs, together, found, single, why)


def _stacked(jobs: Sequence[Job], models: Sequence[Model]) -> tuple[Part, list[str | None]]:
    """Results of runs side by side, and why some must be done by themselves after all."""
    from trainctl.ensemble.stack import stacked
    from trainctl.ensemble.steps import simulated

    runs = len(models)
    try:
        with np.errstate(all="ignore"):  # of a run that diverges; it is done again by itself, and tells
            done = simulated(stacked(models))
    except Exception as error:  # a law that takes one run alone; its own run tells what is wrong with it
        return part([]), [f"{type(error).__name__}: {error}"] * runs
    counts = {key: np.zeros(runs) for key in COUNTS}
    counts |= {"violations": done.violations.astype(float), "overspeeds": done.overspeeds.astype(float)}
    found = Part([job.parameters for job in jobs], ["complete"] * runs, [None] * runs, counts, done.metrics, [None] * runs)
    return found, list(done.why_alone)


def _in_order(
    jobs: Sequence[Job], together: Sequence[int], found: Part | None, single: dict[int, dict[str, Any]], why: Sequence[str | None]
) -> Part:
    """Results of stacked and of single runs in one part."""
    alone = part([single[k] for k in single], [why[k] for k in single])
    kept = [m for m, k in enumerate(together) if why[k] is None]
    if found is None or not kept:
        return alone
    whole = joined([found.kept(kept), alone])
    places = [together[m] for m in kept] + list(single)
    return whole.kept(np.argsort(places).tolist())
