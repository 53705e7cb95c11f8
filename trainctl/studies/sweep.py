"""Many runs of one scenario: every combination of settings and seeds, spread over processes by Dask.

A worker runs one simulation at a time in a scratch folder and sends back one row; only the process that asked writes, so the
workers need no common file system. Each row is appended to ``rows.jsonl`` as it comes, and at the end they are sorted into one
Parquet file that does not depend on who computed what.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import os
import tempfile
import threading
import time
import tomllib
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from sumo_net.bounded import short_text
from trainctl.errors import InputError, TrainctlError
from trainctl.scenario.reading import examine, find, read, shipped
from trainctl.studies.results import COUNTS, RESULTS, reasons, wilson, write_results

FORMAT = "trainctl sweep"
INFO, ROWS, FIGURE = "sweep.json", "rows.jsonl", "summary.png"

#: A run whose worker dies is given to another one; after so many deaths it is taken for the cause.
MOST_DEATHS = 3

#: libsumo holds one simulation per process, and a worker may have several threads.
ONE_SIMULATION = threading.Lock()


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
        """Parameters of every run, in the order of the dataset."""
        axes = dict(self.settings)
        if self.seeds:
            axes["run.seed"] = list(self.seeds)
        return [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]


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


# What to run


def values(text: str) -> tuple[str, list[Any]]:
    """``KEY=a,b,c`` of the command line: the key, and each value as TOML, a bare word as text."""
    key, equals, right = text.partition("=")
    if not (key and equals and right):
        raise InputError(f"--set {text}: must be KEY=VALUE or KEY=VALUE,VALUE,...")
    try:
        return key, list(tomllib.loads(f"v = [{right}]")["v"])
    except tomllib.TOMLDecodeError:
        return key, [_value(part) for part in right.split(",")]


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        return text


def seeds(text: str) -> list[int]:
    """``0..99``, ``7`` or ``1,2,5..9``: all these seeds, each once."""
    found: list[int] = []
    for part in text.split(","):
        first, dots, last = part.strip().partition("..")
        try:
            low = int(first)
            high = int(last) if dots else low
        except ValueError:
            raise InputError(f"--seeds {text}: must be like 0..99 or 1,2,5..9") from None
        if low < 0 or high < low:
            raise InputError(f"--seeds {text}: {part.strip()} is empty or negative")
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


def jobs(plan: SweepPlan, keep: Path | None = None) -> list[Job]:
    """All runs of a plan, checked as far as that is the same for all of them.

    Raises
    ------
    InputError
        The scenario is wrong whatever the settings, or a setting is wrong in itself.
    """
    combinations = plan.combinations()
    if not combinations:
        raise InputError("sweep: a setting without values: nothing to run")
    if plan.jitter and not plan.seeds and "run.seed" not in plan.settings:
        raise InputError("--jitter: deviations are random, so the sweep needs --seeds")
    file = find(plan.scenario)
    found = []
    for number, parameters in enumerate(combinations):
        tables, _ = read(plan.scenario, parameters)
        found.append(
            Job(
                number,
                parameters,
                file.name,
                tables,
                str(file.resolve().parent),
                dict(plan.jitter),
                plan.backend,
                str(keep) if keep else None,
            )
        )
    refused: list[str] = []
    for job in {json.dumps({**j.parameters, "run.seed": 0}, default=str, sort_keys=True): j for j in reversed(found)}.values():
        _, wrong = examine(job.tables)
        if wrong:
            raise InputError([f"{file.name}: {line}" for line in wrong])
    for job in found[:20]:  # one combination that can run is enough: others may be what the sweep is to find out
        try:
            job_model(job._replace(jitter={}))
        except InputError as error:
            refused = refused or error.mistakes
        else:
            break
    else:
        raise InputError(refused)
    for key in plan.jitter:
        name = key.partition(".")[2]
        if any(not isinstance(train.get(name), int | float) for train in found[0].tables.get("train", [])):
            raise InputError(f"--jitter {key}: not every [[train]] has a number {name}")
    return found


def job_model(job: Job) -> Any:
    """The run's scenario as arrays, its starts moved by the jitter."""
    from trainctl.scenario.build import model_of

    tables = {**job.tables, "train": [dict(train) for train in job.tables.get("train", [])]}
    _move(tables, job.jitter)
    scenario, found = examine(tables)
    if scenario is None:
        raise InputError([f"{job.file}: {line}" for line in found])
    return model_of(scenario, job.file, Path(job.folder), found)


def _move(tables: dict[str, Any], jitter: Mapping[str, float]) -> None:
    """Add each train's deviation: a function of the seed, the key and the train's id."""
    import numpy as np

    from trainctl import draws

    ids = [draws.word(str(train["id"])) for train in tables["train"]]
    for key, width in jitter.items():
        name = key.partition(".")[2]
        who = np.column_stack([ids, np.full(len(ids), draws.word(name))])
        drawn = draws.uniform(int(tables["run"]["seed"]), draws.JITTER, np.zeros(1, np.int64), who)[0]
        for train, part in zip(tables["train"], drawn.tolist(), strict=True):
            train[name] = float(train[name] + width * (2.0 * part - 1.0))


# One run


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

    todo = jobs(plan, Path(os.path.abspath(out)) / "runs" if keep else None)
    identity = _identity(plan, todo[0])
    with held(out):
        rows = _open_folder(out, identity, resume, force)
    with held(out):
        return _all(plan, out, todo, identity, rows, workers, scheduler, command_line, progress)


def _all(
    plan: SweepPlan, out: Path, todo: Sequence[Job], identity: Mapping[str, Any], rows: dict[str, dict[str, Any]],
    workers: int | None, scheduler: str | None, command_line: Sequence[str], progress: Callable[[int, int, int], Any] | None,
) -> dict[str, Any]:  # fmt: skip
    """Run what of ``todo`` is not in ``rows`` yet."""
    known = {_key(job.parameters) for job in todo}
    rows = {key: row for key, row in rows.items() if key in known and row["status"] != "failed"}
    info = _about(identity, plan, todo, command_line)
    began = time.perf_counter()
    _write_info(out, info)

    def ended(status: str) -> dict[str, Any]:
        ordered = [{**rows[key], "run": job.number} for job in todo if (key := _key(job.parameters)) in rows]
        frame = write_results(ordered, out / RESULTS)
        counts = {name: sum(row["status"] == name for row in ordered) for name in ("complete", "failed", "refused")}
        number = sum(row["status"] == "complete" and row["violations"] > 0 for row in ordered)
        complete = counts["complete"]
        violated = {
            "runs": number,
            "of": complete,
            "share": number / complete if complete else None,
            "interval_95": wilson(number, complete),
        }
        if complete:
            from trainctl.figures.sweep import summary

            summary(frame, list(todo[0].parameters), out / FIGURE)
        final = {
            **info,
            "status": status,
            **counts,
            "violated": violated,
            **{f"with_{name}": sum(bool(row.get(name)) for row in ordered) for name in ("collisions", "gridlocks")},
            "reasons": reasons(ordered),
            "wall_time_s": round(time.perf_counter() - began, 3),
        }
        _write_info(out, final)
        return final

    missing = [job for job in todo if _key(job.parameters) not in rows]
    failures, skipped = 0, len(todo) - len(missing)
    try:
        with (out / ROWS).open("a", encoding="utf-8") as lines:
            for row in _scattered(missing, workers, scheduler) if missing else ():
                rows[_key(row["parameters"])] = row
                lines.write(json.dumps(row) + "\n")
                lines.flush()
                failures += row["status"] == "failed"
                if progress is not None:
                    progress(skipped := skipped + 1, len(todo), failures)
    except BaseException as error:
        ended("interrupted" if isinstance(error, KeyboardInterrupt) else "failed")
        raise
    return ended("complete")


def _scattered(todo: Sequence[Job], workers: int | None, scheduler: str | None) -> Iterator[dict[str, Any]]:
    """Rows as they come from the cluster. Dask gives what a dead worker had to another one."""
    from distributed import as_completed

    with _client(min(workers or os.cpu_count() or 1, len(todo)), scheduler) as client:
        once = uuid.uuid4().hex
        futures = client.map(simulate, todo, key=[f"trainctl-{once}-{job.number}" for job in todo], pure=False)
        whose = {future.key: job for future, job in zip(futures, todo, strict=True)}
        try:
            for future in as_completed(futures, loop=client.loop):  # type: ignore[no-untyped-call]
                job, error = whose[future.key], future.exception()
                if error is None:
                    yield future.result()
                else:
                    died = type(error).__name__ == "KilledWorker"
                    reason = f"its worker died {MOST_DEATHS} times" if died else f"{type(error).__name__}: {error}"
                    yield {"run": job.number, "parameters": job.parameters, "status": "failed", "failure": reason}
        finally:
            client.cancel(futures, force=True)


@contextmanager
def _client(workers: int, scheduler: str | None) -> Iterator[Any]:
    """A client of the scheduler at an address, or of a cluster on this machine: processes of one thread each, all spawned."""
    import dask
    from distributed import Client, LocalCluster

    with dask.config.set(
        {"distributed.scheduler.allowed-failures": MOST_DEATHS, "distributed.worker.multiprocessing-method": "spawn"}
    ):
        if scheduler is not None:
            try:
                where = {"scheduler_file": scheduler} if scheduler.endswith(".json") else {"address": scheduler}
                client = Client(**where, timeout=10, set_as_default=False)  # type: ignore[no-untyped-call]
            except (OSError, ValueError, TypeError) as error:
                raise InputError(f"--scheduler {scheduler}: no Dask scheduler answers there: {error}") from None
            with client:
                yield client
            return
        with (
            LocalCluster(  # type: ignore[no-untyped-call]
                n_workers=workers, threads_per_worker=1, processes=True, memory_limit=0, silence_logs=50,
                host="127.0.0.1", dashboard_address="127.0.0.1:0",  # nobody else's business
            ) as cluster,
            Client(cluster, set_as_default=False) as client,  # type: ignore[no-untyped-call]
        ):  # fmt: skip
            yield client


# The folder


def _key(parameters: Mapping[str, Any]) -> str:
    return json.dumps(parameters, sort_keys=True, default=str)


def _identity(plan: SweepPlan, first: Job) -> dict[str, Any]:
    """What must be the same for rows to belong to one dataset."""
    tables, _ = read(plan.scenario)
    digest = hashlib.sha256(json.dumps(tables, sort_keys=True, default=str).encode()).hexdigest()
    return {"scenario": first.file, "scenario_sha256": digest, "jitter": dict(plan.jitter), "backend": plan.backend}


def _about(identity: Mapping[str, Any], plan: SweepPlan, todo: Sequence[Job], command_line: Sequence[str]) -> dict[str, Any]:
    from trainctl.record.folder import SCHEMA_VERSION, installed

    return {
        "format": FORMAT, "schema_version": SCHEMA_VERSION, "status": "running", **identity,
        "set": {key: list(values) for key, values in plan.settings.items()}, "seeds": list(plan.seeds), "runs": len(todo),
        "versions": {name: installed(p) for name, p in (("trainctl", "trainctl"), ("sumo", "libsumo"), ("dask", "dask"))},
        "command_line": list(command_line),
    }  # fmt: skip


def _write_info(out: Path, info: Mapping[str, Any]) -> None:
    from trainctl.record.folder import write_json

    write_json(out / INFO, info)


def _open_folder(out: Path, identity: Mapping[str, Any], resume: bool, force: bool) -> dict[str, dict[str, Any]]:
    """Make the folder ready; rows that are there already, by their parameters."""
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
        return _rows(out / ROWS)
    if not (free(out) or force):
        hint = "--resume goes on with it, --force replaces it" if ours else "choose another --out, or --force to replace it"
        raise InputError(f"{out}: {'holds a sweep' if ours else 'exists and is not a sweep of trainctl'}: {hint}")
    if out.resolve() == Path.cwd() or out.resolve() in Path.cwd().parents:
        raise InputError(f"{out}: holds the current directory: choose another --out")
    try:
        remove(out)
        out.mkdir(parents=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from None
    return {}


def _rows(path: Path) -> dict[str, dict[str, Any]]:
    """What was done; the last line may have been cut by a kill, and is dropped, so that the next one begins afresh."""
    if not path.is_file():
        return {}
    found, good = {}, []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            row = json.loads(line)
            found[_key(row["parameters"])] = row
            good.append(line)
        except (ValueError, KeyError, TypeError):
            continue
    path.write_text("".join(f"{line}\n" for line in good), encoding="utf-8")
    return found
