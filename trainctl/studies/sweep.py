"""Many runs of one scenario: every combination of settings and seeds, spread over processes by Dask.

A worker runs one simulation at a time in a scratch folder and sends back one row, or a block of numeric runs side by side
(``blocks``) and sends back their columns; only the process that asked writes, so the workers need no common file system. Rows are
appended to ``rows.jsonl``, blocks become files in ``parts``, as they come; at the end all are sorted into one Parquet file that
does not depend on who computed what.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import os
import time
import tomllib
import uuid
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sumo_net.bounded import short_text
from trainctl.errors import InputError
from trainctl.scenario.keys import MOST_SEED
from trainctl.scenario.reading import examine, find, read, shipped
from trainctl.studies.blocks import blocks, refusal, simulate_block
from trainctl.studies.cluster import MOST_DEATHS, client_of
from trainctl.studies.jobs import Batch, Job, job_model, simulate
from trainctl.studies.results import (
    RESULTS,
    Part,
    joined,
    part,
    read_part,
    reasons,
    wilson,
    write_part,
    write_results,
)

FORMAT = "trainctl sweep"
INFO, ROWS, PARTS, FIGURE = "sweep.json", "rows.jsonl", "parts", "summary.png"

#: Seeds of one sweep: each is kept with its result until all are written.
MOST_SEEDS = 1_000_000


@dataclass(frozen=True)
class SweepPlan:
    """What to run: every combination of ``settings`` with every seed.

    ``jitter`` maps keys of ``[[train]]`` to the half width of a uniform deviation, drawn for every train from the run's seed.
    """

    scenario: str
    settings: Mapping[str, Sequence[Any]]
    seeds: Sequence[int]
    jitter: Mapping[str, float]
    backend: str = "sumo"

    def combinations(self) -> list[dict[str, Any]]:
        """Parameters of every run, in the order of the dataset; what is given twice counts once."""
        axes = dict(self.settings)
        if self.seeds:
            axes["run.seed"] = list(self.seeds)
        found = (dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values()))
        return list({_key(parameters): parameters for parameters in found}.values())


# What to run


def values(text: str) -> tuple[str, list[Any]]:
    """``KEY=a,b,c`` of the command line: the key, and each value as TOML, a bare word as text."""
    key, equals, right = text.partition("=")
    if not (key and equals and right):
        raise InputError(f"--set {text}: must be KEY=VALUE or KEY=VALUE,VALUE,...")
    try:
        return key, list(tomllib.loads(f"v = [{right}]")["v"])
    except tomllib.TOMLDecodeError:
        return key, [_value(piece) for piece in right.split(",")]


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        return text


def seeds(text: str) -> list[int]:
    """``0..99``, ``7`` or ``1,2,5..9``: all these seeds, each once."""
    found: list[int] = []
    for piece in text.split(","):
        first, dots, last = piece.strip().partition("..")
        try:
            low = int(first)
            high = int(last) if dots else low
        except ValueError:
            raise InputError(f"--seeds {text}: must be like 0..99 or 1,2,5..9") from None
        if low < 0 or high < low:
            raise InputError(f"--seeds {text}: {piece.strip()} is empty or negative")
        if high > MOST_SEED:
            raise InputError(f"--seeds {text}: {piece.strip()}: a seed must be at most {MOST_SEED}")
        if len(found) + high - low >= MOST_SEEDS:
            raise InputError(f"--seeds {text}: more than {MOST_SEEDS} seeds")
        found += range(low, high + 1)
    return list(dict.fromkeys(found))


def half_width(text: str) -> tuple[str, float]:
    """``train.KEY=W`` of the command line."""
    key, equals, width = text.partition("=")
    try:
        number = float(width)
    except ValueError:
        number = math.nan
    if not (key.startswith("train.") and equals and number > 0 and math.isfinite(number)):
        raise InputError(f"--jitter {text}: must be train.KEY=HALF_WIDTH, such as train.position_m=500")
    return key, number


def sweeps() -> dict[str, Path]:
    """Sweeps that come with the package: name -> file."""
    folder = next(iter(shipped().values())).parent / "sweeps"
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def ready_made(name: str) -> SweepPlan | None:
    """The plan in a sweep file, given by path or as the name of a shipped one; None if ``name`` is a scenario."""
    path = Path(name)
    if path.suffix != ".toml":
        known = sweeps()
        if name not in known:
            return None
        path = known[name]
    try:
        data = tomllib.loads(short_text(path))
    except (OSError, ValueError, RecursionError):
        return None  # the scenario's reader says what is wrong
    if "scenario" not in data:
        return None
    unknown = sorted(data.keys() - {"title", "scenario", "seeds", "set", "jitter"})
    if unknown:
        raise InputError([f"{path.name}: {key}: unknown key; known: title, scenario, seeds, set, jitter" for key in unknown])
    try:
        settings = {str(k): v if isinstance(v, list) else [v] for k, v in data.get("set", {}).items()}
        jitter = dict(half_width(f"{k}={v}") for k, v in data.get("jitter", {}).items())
        beside = path.parent / str(data["scenario"])
        scenario = str(beside) if beside.suffix == ".toml" and beside.is_file() else str(data["scenario"])
        return SweepPlan(scenario, settings, seeds(str(data["seeds"])) if "seeds" in data else [], jitter)
    except (InputError, AttributeError) as error:
        raise InputError(f"{path.name}: {error}") from None


def batches(plan: SweepPlan, keep: Path | None = None) -> list[Batch]:
    """All runs of a plan by combination of settings, checked as far as that is the same for all of them.

    Raises
    ------
    InputError
        The scenario is wrong whatever the settings, or a setting is wrong in itself.
    """
    together = bool(plan.seeds) and "run.seed" not in plan.settings
    settings = replace(plan, seeds=plan.seeds[:1]) if together else plan
    combinations = settings.combinations()
    if not combinations:
        raise InputError("sweep: a setting without values: nothing to run")
    if plan.jitter and not plan.seeds and "run.seed" not in plan.settings:
        raise InputError("--jitter: deviations are random, so the sweep needs --seeds")
    file, seeds = find(plan.scenario), tuple(plan.seeds) if together else ()
    found = []
    for k, parameters in enumerate(combinations):
        tables, _ = read(plan.scenario, parameters)
        job = Job(
            k * max(len(seeds), 1), parameters, file.name, tables, str(file.resolve().parent), dict(plan.jitter), plan.backend,
            str(keep) if keep else None,
        )  # fmt: skip
        found.append(Batch(job, range(job.number, job.number + max(len(seeds), 1)), seeds))
    refused: list[str] = []
    for batch in {
        json.dumps({**b.job.parameters, "run.seed": 0}, default=str, sort_keys=True): b for b in reversed(found)
    }.values():
        _, wrong = examine(batch.job.tables)
        if wrong:
            raise InputError([f"{file.name}: {line}" for line in wrong])
    for batch in found[:20]:  # one combination that can run is enough: others may be what the sweep is to find out
        try:
            job_model(batch.job._replace(jitter={}))
        except InputError as error:
            refused = refused or error.mistakes
        else:
            break
    else:
        raise InputError(refused)
    for key in plan.jitter:
        name = key.partition(".")[2]
        if any(not isinstance(train.get(name), int | float) for train in found[0].job.tables.get("train", [])):
            raise InputError(f"--jitter {key}: not every [[train]] has a number {name}")
    return found


def jobs(plan: SweepPlan, keep: Path | None = None) -> list[Job]:
    """All runs of a plan, one by one; see ``batches``."""
    return [job for batch in batches(plan, keep) for job in batch.each()]


# All runs


def sweep(
    plan: SweepPlan,
    out: Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    force: bool = False,
    keep: bool = False,
    command_line: Sequence[str] = (),
    progress: Callable[[int, int, int], Any] | None = None,
) -> dict[str, Any]:
    """Run a plan into the folder ``out``.

    Parameters
    ----------
    plan : SweepPlan
        What to run.
    out : Path
        Folder of the sweep.
    workers : int, optional
        Processes of the local cluster; default one per core.
    scheduler : str, optional
        Address of a running Dask scheduler, or the .json file it wrote (``--scheduler-file``), instead of a local cluster.
    resume : bool
        Go on with the sweep in ``out``: only runs that are not there yet, or failed, are done.
    force : bool
        Replace a sweep in ``out``.
    keep : bool
        Keep every run folder, in ``out/runs``.
    command_line : sequence of str
        For sweep.json.
    progress : callable, optional
        Called with (runs done, runs, failures).

    Returns
    -------
    dict
        The content of sweep.json.

    Raises
    ------
    InputError
        The plan or the folder cannot be used.
    """
    from trainctl.record.folder import held

    planned = batches(plan, Path(os.path.abspath(out)) / "runs" if keep else None)
    identity = _identity(plan, planned[0].job)
    with held(out):
        before = _open_folder(out, identity, resume, force)
    with held(out):
        return _all(plan, out, planned, identity, before, workers, scheduler, command_line, progress)


def _all(
    plan: SweepPlan, out: Path, planned: Sequence[Batch], identity: Mapping[str, Any], before: Sequence[Part],
    workers: int | None, scheduler: str | None, command_line: Sequence[str], progress: Callable[[int, int, int], Any] | None,
) -> dict[str, Any]:  # fmt: skip
    """Run what of a plan is not among the results from ``before``."""
    number = {
        _key(parameters): k for batch in planned for k, parameters in zip(batch.numbers, batch.parameters(), strict=True)
    }  # fmt: skip
    parts = [_good(found, number) for found in before]
    done = {number[_key(parameters)] for found in parts for parameters in found.parameters}
    info = _about(identity, plan, len(number), command_line)
    began = time.perf_counter()
    _write_info(out, info)

    def ended(status: str) -> dict[str, Any]:
        found = joined(parts)
        numbers = [number[_key(parameters)] for parameters in found.parameters]
        found, numbers = found.kept(np.argsort(numbers).tolist()), sorted(numbers)
        frame = write_results(found, numbers, out / RESULTS)
        violated = int((found.counts["violations"] > 0).sum())
        counts = {name: sum(status == name for status in found.status) for name in ("complete", "failed", "refused")}
        complete = counts["complete"]
        if complete:
            from trainctl.figures.sweep import summary

            summary(frame, list(planned[0].parameters()[0]), out / FIGURE)
        final = {
            **info,
            "status": status,
            **counts,
            "violated": {
                "runs": violated,
                "of": complete,
                "share": violated / complete if complete else None,
                "interval_95": wilson(violated, complete),
            },
            **{f"with_{name}": int((found.counts[name] > 0).sum()) for name in ("collisions", "gridlocks")},
            "reasons": reasons(found, numbers),
            "alone": dict(Counter(why for why in found.alone if why is not None).most_common()),
            "wall_time_s": round(time.perf_counter() - began, 3),
        }
        _write_info(out, final)
        return final

    failures, skipped, name = 0, len(done), itertools.count(len(list((out / PARTS).iterdir())))
    try:
        todo, why = _tasks(planned, done, workers or os.cpu_count() or 1)
        with (out / ROWS).open("a", encoding="utf-8") as lines:
            for task, result in _scattered(todo, workers, scheduler) if todo else ():
                if isinstance(task, Batch):
                    found = result
                    write_part(found, out / PARTS / f"{next(name):06d}.parquet")
                else:
                    found = part([result], [why.get(result["run"])])
                    lines.write(json.dumps({**result, "_alone": why.get(result["run"])}) + "\n")
                    lines.flush()
                parts.append(found)
                failures += sum(status == "failed" for status in found.status)
                if progress is not None:
                    progress(skipped := skipped + len(found.status), len(number), failures)
    except BaseException as error:
        ended("interrupted" if isinstance(error, KeyboardInterrupt) else "failed")
        raise
    return ended("complete")


def _good(found: Part, number: Mapping[str, int]) -> Part:
    """What of a part belongs to the plan and need not be done again."""
    keys = [_key(parameters) for parameters in found.parameters]
    return found.kept([k for k, key in enumerate(keys) if key in number and found.status[k] != "failed"])


def _tasks(planned: Sequence[Batch], done: set[int], workers: int) -> tuple[list[Job | Batch], dict[int, str]]:
    """What is left to do, as blocks of runs side by side where that can be; else why not, by the number of the run."""
    todo: list[Job | Batch] = []
    single: list[Job] = []
    why: dict[int, str] = {}
    beside: tuple[Any, Any] = None, None
    for batch in planned:
        left = batch.of([k for k, number in enumerate(batch.numbers) if number not in done])
        if all(number in done for number in left.numbers):
            continue
        place = {key: batch.job.tables.get(key) for key in ("network", "controller")}
        # Whether they are stacked goes by the whole batch: sums of stacked runs have other last bits, however few are left.
        reason, model = refusal(batch, beside[1] if beside[0] == place else None)
        if model is not None:
            beside = place, model
        if reason is None and model is not None:
            todo += blocks(left, model, workers)
        else:
            single += left.each()
            why |= dict.fromkeys(left.numbers, reason) if reason is not None and batch.job.backend == "numeric" else {}
    return [*todo, *single], why


def _done(task: Job | Batch) -> dict[str, Any] | Part:
    """What a worker does: a row of a single run, or the results of a block."""
    return simulate(task) if isinstance(task, Job) else simulate_block(task)


def _failed(task: Job | Batch, reason: str) -> dict[str, Any] | Part:
    """What is left of a task whose worker could not do it."""
    rows = [
        {"run": job.number, "parameters": job.parameters, "status": "failed", "failure": reason}
        for job in ([task] if isinstance(task, Job) else task.each())
    ]
    return rows[0] if isinstance(task, Job) else part(rows)


def _scattered(todo: Sequence[Job | Batch], workers: int | None, scheduler: str | None) -> Iterator[tuple[Job | Batch, Any]]:
    """Tasks and what they gave, as it comes from the cluster. Dask gives what a dead worker had to another one."""
    from distributed import as_completed

    with client_of(min(workers or os.cpu_count() or 1, len(todo)), scheduler) as client:
        once = uuid.uuid4().hex
        futures = client.map(_done, todo, key=[f"trainctl-{once}-{k}" for k in range(len(todo))], pure=False)
        whose = {future.key: task for future, task in zip(futures, todo, strict=True)}
        try:
            for future in as_completed(futures, loop=client.loop):  # type: ignore[no-untyped-call]
                task, error = whose[future.key], future.exception()
                if error is None:
                    yield task, future.result()
                else:
                    died = type(error).__name__ == "KilledWorker"
                    reason = f"its worker died {MOST_DEATHS} times" if died else f"{type(error).__name__}: {error}"
                    yield task, _failed(task, reason)
                future.release()
        finally:
            client.cancel(futures, force=True)


# The folder


def _key(parameters: Mapping[str, Any]) -> str:
    return json.dumps(parameters, sort_keys=True, default=str)


def _identity(plan: SweepPlan, first: Job) -> dict[str, Any]:
    """What must be the same for rows to belong to one dataset."""
    tables, _ = read(plan.scenario)
    digest = hashlib.sha256(json.dumps(tables, sort_keys=True, default=str).encode()).hexdigest()
    return {"scenario": first.file, "scenario_sha256": digest, "jitter": dict(plan.jitter), "backend": plan.backend}


def _about(identity: Mapping[str, Any], plan: SweepPlan, runs: int, command_line: Sequence[str]) -> dict[str, Any]:
    from trainctl.record.folder import SCHEMA_VERSION, installed

    return {
        "format": FORMAT, "schema_version": SCHEMA_VERSION, "status": "running", **identity,
        "set": {key: list(values) for key, values in plan.settings.items()}, "seeds": list(plan.seeds), "runs": runs,
        "versions": {name: installed(p) for name, p in (("trainctl", "trainctl"), ("sumo", "libsumo"), ("dask", "dask"))},
        "command_line": list(command_line),
    }  # fmt: skip


def _write_info(out: Path, info: Mapping[str, Any]) -> None:
    from trainctl.record.folder import write_json

    write_json(out / INFO, info)


def _open_folder(out: Path, identity: Mapping[str, Any], resume: bool, force: bool) -> list[Part]:
    """Make the folder ready; the results that are there already."""
    from trainctl.record.folder import free, remove

    try:
        info = json.loads((out / INFO).read_text(encoding="utf-8"))
        ours = info.get("format") == FORMAT
    except (OSError, ValueError, AttributeError):
        info, ours = {}, False
    if ours and resume:
        other = [key for key, value in identity.items() if info.get(key) != value]
        if other:
            raise InputError([f"{out}: --resume: its {key} is {info.get(key)}, now it is {identity[key]}" for key in other])
        (out / PARTS).mkdir(exist_ok=True)
        return [*_rows(out / ROWS), *_parts(out / PARTS)]
    if not (free(out) or force):
        hint = "--resume goes on with it, --force replaces it" if ours else "choose another --out, or --force to replace it"
        raise InputError(f"{out}: {'holds a sweep' if ours else 'exists and is not a sweep of trainctl'}: {hint}")
    if out.resolve() == Path.cwd() or out.resolve() in Path.cwd().parents:
        raise InputError(f"{out}: holds the current directory: choose another --out")
    try:
        remove(out)
        (out / PARTS).mkdir(parents=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from None
    return []


def _parts(folder: Path) -> list[Part]:
    """What was done side by side; blocks that cannot be read, since a disk was full or the power failed, are done again."""
    found = []
    for path in sorted(folder.glob("*.parquet")):
        try:
            found.append(read_part(path))
        except (OSError, ValueError, KeyError):
            warnings.warn(f"{path}: cannot be read: its runs are done again", stacklevel=2)
    return found


def _rows(path: Path) -> list[Part]:
    """What was done run by run; the last line may have been cut by a kill, and is dropped, so that the next one begins afresh."""
    if not path.is_file():
        return []
    found, good = {}, []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            row = json.loads(line)
            found[_key(row["parameters"])] = row
            good.append(line)
        except (ValueError, KeyError, TypeError):
            continue
    path.write_text("".join(f"{line}\n" for line in good), encoding="utf-8")
    return [part(list(found.values()), [row.get("_alone") for row in found.values()])]
