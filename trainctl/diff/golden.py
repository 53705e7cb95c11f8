"""Goldens: runs and logs kept beside a test suite, thinned in time, without clocks, paths and networks, compressed.

The golden of a run is a run folder whose run.json names the thinned tables; that of SUMO's logs a folder with ``golden.json``.
"""

from __future__ import annotations

import gzip
import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from trainctl.diff.columns import floats
from trainctl.diff.sources import KINDS, sumo_log, sumo_logs_in
from trainctl.errors import InputError
from trainctl.record.folder import INFO, beside, free, installed, ours, remove, write_info, write_json
from trainctl.runs.run import Run
from trainctl.runs.sumo_logs import kind_of, opened

#: SUMO's header is in the first bytes of a log.
HEADER_BYTES = 1 << 20

#: Entry of run.json and golden.json: the logs that hold only some instants.
THINNED = "thinned"
#: Names the golden of logs, and what makes it ours.
GOLDEN, FORMAT = "golden.json", "trainctl golden"

#: Logs of SUMO's that the golden of a run keeps whole; its fcd is thinned, its summary says nothing more than these.
WHOLE = ("tripinfo", "statistics", "collisions", "vehroute")
#: Time between kept instants unless stated [s].
EVERY_S = 60.0


def golden_of_logs(folder: Path) -> bool:
    """Whether a folder is a golden of SUMO's logs."""
    try:
        return bool(json.loads((folder / GOLDEN).read_text(encoding="utf-8"))["format"] == FORMAT)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def thinned(folder: Path) -> list[str]:
    """Logs of a golden that hold only some instants; none of any other folder."""
    if golden_of_logs(folder):
        named = json.loads((folder / GOLDEN).read_text(encoding="utf-8")).get(THINNED)
    else:
        named = Run(folder).info.get(THINNED) if ours(folder) else None
    return [str(name) for name in named] if isinstance(named, list) else []


def make_golden(run: Run | Path | str, folder: Path | str, every_s: float = EVERY_S, units_every_s: float | None = None) -> Path:
    """Keep a run, a folder of SUMO's logs or one such log as a golden: thinned in time, without clocks and paths, compressed.

    Parameters
    ----------
    run : Run or Path
        A complete run, or SUMO's logs.
    folder : Path
        Where the golden is written; one that is there is replaced once the new one is whole.
    every_s : float
        Time between kept instants of trains, links and SUMO's fcd [s].
    units_every_s : float, optional
        The same for units; default five times ``every_s``.

    Raises
    ------
    InputError
        Nothing that can be a golden, or the folder holds something else.
    """
    place = Path(folder)
    if not (isinstance(every_s, int | float) and 0 < every_s < float("inf")):
        raise InputError(f"every_s = {every_s}: must be a number above 0")
    if not (free(place) or golden_of_logs(place) or thinned(place)):
        raise InputError(f"{place}: is no golden, and is not replaced by one")
    if not isinstance(run, Run) and not (Path(run) / INFO).exists():
        logs = _logs(Path(run))
        _beside(place, lambda fresh: _of_logs(logs, fresh, float(every_s)))
    else:
        source = run if isinstance(run, Run) else Run(run)
        _beside(place, lambda fresh: _of_run(source, fresh, every_s, units_every_s or 5 * every_s))
    return place


def _of_run(source: Run, place: Path, every_s: float, units_every_s: float) -> None:
    """The golden of a run."""
    if source.info.get("status") != "complete":
        raise InputError(f"{source.folder}: status {source.info.get('status')}: only a complete run can be a golden")
    (place / "sumo").mkdir()
    steps = {"trains": every_s, "links": every_s, "units": units_every_s}
    for table, every in steps.items():
        for path in source.files(table):
            _write(_kept(path, "time_s", every), place / f"{table}.parquet")
    for path in source.files("stops"):
        (place / path.name).write_bytes(path.read_bytes())
    for kind, path in sumo_logs_in(source.folder / "sumo").items():
        if kind == "fcd" and path.suffix == ".parquet":
            _write(_kept(path, "timestep_time", every_s), place / "sumo" / "fcd.parquet")
        elif kind in WHOLE and path.suffix == ".xml":
            _pack(path, place / "sumo" / f"{kind}.xml.gz")
    (place / "events.jsonl").write_bytes((source.folder / "events.jsonl").read_bytes())
    (place / "scenario.toml").write_bytes((source.folder / "scenario.toml").read_bytes())
    of_the_run = ("command_line", "wall_time_s", "files")
    write_info(place, {k: v for k, v in source.info.items() if k not in of_the_run} | {THINNED: [*steps, "fcd"]})


def _logs(source: Path) -> dict[str, Path]:
    """One of SUMO's logs, or all in a folder, by kind."""
    if source.is_dir():
        logs = sumo_logs_in(source)
    elif source.exists():
        log = sumo_log(source)
        logs = {log.name: source} if log is not None and log.name else {}
    else:
        raise InputError(f"{source}: no such file or directory")
    if not logs:
        raise InputError(f"{source}: neither a run folder nor logs of SUMO: known are {', '.join(k.name for k in KINDS)}")
    return logs


def _of_logs(logs: dict[str, Path], place: Path, every_s: float) -> None:
    """The golden of SUMO's logs."""
    for kind, path in logs.items():
        if kind == "fcd":
            _write(_kept_of_log(path, every_s), place / "fcd.parquet")
        elif kind_of(path) == "parquet":
            shutil.copyfile(path, place / f"{kind}.parquet")
        else:
            _pack(path, place / f"{kind}.{kind_of(path)}.gz")
    about: dict[str, Any] = {"format": FORMAT, "schema_version": 1, "every_s": every_s, THINNED: ["fcd"]}
    write_json(place / GOLDEN, about | {"versions": {"trainctl": installed("trainctl")}})


def _pack(path: Path, target: Path) -> None:
    """A text log compressed, without SUMO's header, which has the date and the folder in it."""
    with opened(path) as stream, target.open("wb") as raw, gzip.GzipFile("", "wb", 9, raw, mtime=0) as packed:
        packed.write(re.sub(rb"<!--.*?-->\s*", b"", stream.read(HEADER_BYTES), count=1, flags=re.DOTALL))
        shutil.copyfileobj(stream, packed, HEADER_BYTES)


def _wanted(at: Any, every_s: float, end: float) -> Any:
    return (np.abs(at / every_s - np.round(at / every_s)) * every_s < 1e-6) | (at == end)


def _kept(path: Path, time: str, every_s: float) -> pa.Table:
    """The rows at multiples of a time, and the last."""
    kept = []
    with pq.ParquetFile(path) as file:
        end = max((pc.max(b[time]).as_py() for b in file.iter_batches(columns=[time]) if b.num_rows), default=0.0)
        for batch in file.iter_batches():
            wanted = _wanted(batch[time].to_numpy(zero_copy_only=False), every_s, end)
            kept.append(pa.Table.from_batches([batch]).filter(pa.array(wanted)))
    return pa.concat_tables(kept).unify_dictionaries() if kept else pq.read_table(path)


def _kept_of_log(path: Path, every_s: float) -> pa.Table:
    """The same of an FCD log in any format, with the columns' names as in SUMO's Parquet."""
    log = sumo_log(path)
    assert log is not None and log.time is not None
    time, kept, last = log.time, [], pa.table({})
    for batch in log.batches():
        at = floats(batch[time])
        if at is None or not len(at):
            raise InputError(f"{path}: a time is missing or not a number")
        kept.append(batch.filter(pa.array(_wanted(at, every_s, np.nan))))
        # the last instant may go on in the next batch
        tail = batch.filter(pa.array(at == at[-1]))
        same = last.num_rows and floats(last[time])[-1] == at[-1] and np.all(at == at[-1])  # type: ignore[index]
        last = pa.concat_tables([last, tail], promote_options="permissive") if same else tail
    if last.num_rows and not _wanted(floats(last[time]), every_s, np.nan).all():
        kept.append(last)
    if not kept:
        raise InputError(f"{path}: has no rows")
    whole = pa.concat_tables(kept, promote_options="permissive")
    return whole.rename_columns(["timestep_time" if n == time else f"vehicle_{n}" for n in whole.column_names])


def _write(table: pa.Table, target: Path) -> None:
    floating = [f.name for f in table.schema if pa.types.is_floating(f.type)]
    pq.write_table(
        table, target, compression="zstd", compression_level=19,
        use_dictionary=[n for n in table.column_names if n not in floating],
        column_encoding=dict.fromkeys(floating, "BYTE_STREAM_SPLIT"), write_statistics=False, store_schema=True,
    )  # fmt: skip


def accept(baseline: Path | str, new: Path | str) -> None:
    """Put a new baseline in the place of an old one, in the form the old one has.

    A golden is thinned as the old one was; a run folder, or a log, is copied.

    Raises
    ------
    InputError
        They are not of one form: a log in another format, a folder for a file; or more than the old run would be lost.
    """
    old, source = Path(baseline), Path(new)
    if golden_of_logs(old) or thinned(old):
        make_golden(source, old, *_steps(old))
    elif ours(old) and ours(source):
        if others := beside(old):
            raise InputError(f"{old}: holds {', '.join(others)} beside its run: nothing was accepted")
        _beside(old, lambda fresh: shutil.copytree(source, fresh, dirs_exist_ok=True))
    elif old.is_dir() and source.is_dir():
        there, here = sumo_logs_in(source), sumo_logs_in(old)
        for kind, path in there.items():
            _copied(path, here.get(kind, old / path.name))
        for kind in here.keys() - there.keys():
            here[kind].unlink()
    elif old.is_file() and source.is_file():
        _copied(source, old)
    else:
        raise InputError(f"{old}, {source}: one is a folder, the other a file: nothing was accepted")


def _steps(golden: Path) -> tuple[float, float | None]:
    """Times between the kept instants of a golden [s]."""
    if golden_of_logs(golden):
        return float(json.loads((golden / GOLDEN).read_text(encoding="utf-8")).get("every_s", EVERY_S)), None

    def step(table: str) -> float | None:
        file = golden / f"{table}.parquet"
        times = np.unique(pq.read_table(file, columns=["time_s"])["time_s"].to_numpy()) if file.exists() else np.zeros(0)
        return float(np.round(times[1] - times[0], 9)) if len(times) > 1 else None

    return step("trains") or EVERY_S, step("units")


def _beside(place: Path, write: Callable[[Path], object]) -> None:
    """Have a folder written beside another, then put it in its place: never half of it, and none lost if that fails."""
    place.parent.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(prefix=f".{place.name}.", dir=place.parent))
    try:
        write(fresh)
        fresh.chmod(place.parent.stat().st_mode & 0o777)
        gone = fresh.with_name(f"{fresh.name}.old")
        if place.exists():
            place.rename(gone)
        fresh.rename(place)
        remove(gone)
    finally:
        remove(fresh)


def _copied(source: Path, target: Path) -> None:
    if target.exists() and (kind_of(source), _packed(source)) != (kind_of(target), _packed(target)):
        raise InputError(f"{source}: not in the format of {target}: nothing was accepted")
    fresh = target.with_name(f"{target.name}.new")
    shutil.copyfile(source, fresh)
    os.replace(fresh, target)


def _packed(path: Path) -> bool:
    with open(path, "rb") as file:
        return file.read(2) == b"\x1f\x8b"
