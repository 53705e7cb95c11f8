"""One run of a sweep, complete in itself, and many that differ in their seeds alone."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from trainctl.errors import InputError, TrainctlError
from trainctl.scenario.reading import examine
from trainctl.studies.results import COUNTS

if TYPE_CHECKING:
    from trainctl.scenario.model import Model

#: Jitter of these moves starts and changes nothing else.
STARTS = {"train.position_m", "train.speed_mps"}

#: libsumo holds one simulation per process, and a worker may have several threads.
ONE_SIMULATION = threading.Lock()


class Job(NamedTuple):
    """One run, complete in itself: a worker needs no file but the line's, if that is not a shipped one."""

    number: int
    parameters: dict[str, Any]
    file: str
    tables: dict[str, Any]
    folder: str  # where relative paths in the scenario start
    jitter: dict[str, float]
    backend: str
    keep: str | None  # folder for the run folder


class Batch(NamedTuple):
    """Runs of one combination of settings: they differ in their seeds alone."""

    job: Job  # the first
    numbers: Sequence[int]  # of all in the plan
    seeds: Sequence[int]  # of all; empty: one run, with the scenario's own seed

    def parameters(self) -> list[dict[str, Any]]:
        """Of every run."""
        return [{**self.job.parameters, "run.seed": seed} for seed in self.seeds] or [self.job.parameters]

    def each(self) -> list[Job]:
        """Every run by itself."""
        if not self.seeds:
            return [self.job]
        tables = self.job.tables
        return [
            self.job._replace(number=number, parameters=parameters, tables={**tables, "run": {**tables["run"], "seed": seed}})
            for number, parameters, seed in zip(self.numbers, self.parameters(), self.seeds, strict=True)
        ]

    def of(self, places: Sequence[int]) -> Batch:
        """These of its runs."""
        if not self.seeds:
            return self
        return Batch(self.job, [self.numbers[k] for k in places], [self.seeds[k] for k in places])


def job_model(job: Job, beside: Model | None = None, like: Model | None = None) -> Model:
    """The run's scenario as arrays, its starts moved by the jitter.

    Parameters
    ----------
    job : Job
        The run.
    beside : Model, optional
        As in ``model_of``.
    like : Model, optional
        A run of the same batch: what does not follow from seed and starts is taken from it.
    """
    from trainctl.scenario.build import model_of, restarted

    tables = {**job.tables, "train": [dict(train) for train in job.tables.get("train", [])]}
    _move(tables, job.jitter)
    if like is not None and job.jitter.keys() <= STARTS:
        place, speed = (np.array([train[key] for train in tables["train"]], float) for key in ("position_m", "speed_mps"))
        if (model := restarted(like, tables["run"]["seed"], place, speed)) is not None:
            return model
        beside = like
    scenario, found = examine(tables)
    if scenario is None:
        raise InputError([f"{job.file}: {line}" for line in found])
    return model_of(scenario, job.file, Path(job.folder), found, beside=beside)


def _move(tables: dict[str, Any], jitter: Mapping[str, float]) -> None:
    """Add each train's deviation: a function of the seed, the key and the train's id."""
    from trainctl import draws

    ids = [draws.word(str(train["id"])) for train in tables["train"]]
    for key, width in jitter.items():
        name = key.partition(".")[2]
        who = np.column_stack([ids, np.full(len(ids), draws.word(name))])
        drawn = draws.uniform(int(tables["run"]["seed"]), draws.JITTER, np.zeros(1, np.int64), who)[0]
        for train, part in zip(tables["train"], drawn.tolist(), strict=True):
            train[name] = float(train[name] + width * (2.0 * part - 1.0))


def simulate(job: Job) -> dict[str, Any]:
    """Run one job in this process; its row of the dataset, and under ``_wall_s`` what is not part of it. Never raises."""
    began = time.perf_counter()
    with ONE_SIMULATION, tempfile.TemporaryDirectory(prefix="trainctl-sweep-", ignore_cleanup_errors=True) as scratch:
        folder = Path(scratch if job.keep is None else job.keep) / f"{job.number:06d}"
        outcome: dict[str, Any]
        try:
            outcome = _outcome(job, folder)
        except InputError as error:
            outcome = {"status": "refused", "failure": "; ".join(error.mistakes)}
        except Exception as error:  # whatever one run does, the rest goes on
            name = "" if isinstance(error, TrainctlError) else f"{type(error).__name__}: "
            outcome = {"status": "failed", "failure": f"{name}{error}".replace(str(folder), folder.name)}
    return {"run": job.number, "parameters": job.parameters, **outcome, "_wall_s": round(time.perf_counter() - began, 3)}


def _outcome(job: Job, folder: Path) -> dict[str, Any]:
    from trainctl import runner
    from trainctl.record.folder import plain

    p = job_model(job)
    done = runner.run(p, folder, job.backend, job.keep is not None)  # type: ignore[arg-type]
    values = {key: value for key, value in done.metrics.items() if "/" not in key and isinstance(value, int | float)}
    told = {key: done.info[key] for key in COUNTS}
    return {"status": "complete", "failure": None, **told, "metrics": plain(values)}
