"""For test suites: keep a run as a golden, and assert that later runs match it.

::

    from trainctl.testing import assert_run_matches, make_golden

    make_golden("runs/three_tracks", "tests/goldens/three_tracks")     # once, and when it is meant to change

    def test_my_law(tmp_path):
        run = trainctl.runner.run(open_scenario("my.toml"), tmp_path / "run")
        assert_run_matches(run, "tests/goldens/three_tracks", {"absolute": 1e-4, "columns": {"position_m": 1e-3}})
"""

from __future__ import annotations

import gzip
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from trainctl.diff.runs import THINNED, Report, Tolerances, diff, parse_tolerances, read_tolerances
from trainctl.diff.sources import sumo_logs_in
from trainctl.errors import InputError
from trainctl.record.folder import remove, write_info
from trainctl.record.run import Run

__all__ = ["assert_run_matches", "make_golden"]

#: Logs of SUMO's that a golden keeps whole; its fcd is thinned, its summary says nothing more than these.
WHOLE = ("tripinfo", "statistics", "collisions", "vehroute")


def assert_run_matches(
    run: Run | Path | str, golden: Run | Path | str, tolerances: Tolerances | Mapping[str, Any] | Path | str | None = None
) -> Report:
    """Assert that a run matches a golden one (or any other run).

    Parameters
    ----------
    run : Run or Path
        The run to be tested.
    golden : Run or Path
        What it must match: a run folder, whole or thinned by ``make_golden``. At the instants of a thinned one all rows must be
        there; what lies between them is not compared.
    tolerances : mapping, Path or Tolerances, optional
        As in the file of ``trainctl diff --tolerances``; a path is such a file.

    Returns
    -------
    Report
        What was compared.

    Raises
    ------
    AssertionError
        With the first difference and the largest of every column.
    InputError
        One of them is not a run folder or is damaged, or the tolerances are mistaken.
    """
    if isinstance(tolerances, Path | str):
        tolerances = read_tolerances(tolerances)
    elif isinstance(tolerances, Mapping):
        tolerances = parse_tolerances(tolerances)
    expected, found = (place if isinstance(place, Run) else Run(place) for place in (golden, run))
    report = diff(expected.folder, found.folder, tolerances)
    if not report.same:
        raise AssertionError("\n".join([f"{found.folder} does not match {expected.folder}:", *report.lines()]))
    return report


def make_golden(run: Run | Path | str, folder: Path | str, every_s: float = 60.0, units_every_s: float | None = None) -> Path:
    """Keep a run as a golden: thinned in time, without clocks, paths and networks, compressed.

    Parameters
    ----------
    run : Run or Path
        A complete run.
    folder : Path
        Where the golden is written; a run folder of ours there is replaced.
    every_s : float
        Time between kept instants of trains, links and SUMO's fcd [s].
    units_every_s : float, optional
        The same for units; default five times ``every_s``.
    """
    source, place = run if isinstance(run, Run) else Run(run), Path(folder)
    if source.info.get("status") != "complete":
        raise InputError(f"{source.folder}: status {source.info.get('status')}: only a complete run can be a golden")
    if place.exists():
        Run(place)  # refuses what is not ours
        remove(place)
    (place / "sumo").mkdir(parents=True)
    steps = {"trains": every_s, "links": every_s, "units": units_every_s or 5 * every_s}
    for table, every in steps.items():
        for path in source.files(table):
            _thinned(path, place / f"{table}.parquet", "time_s", every)
    for kind, path in sumo_logs_in(source.folder / "sumo").items():
        if kind == "fcd" and path.suffix == ".parquet":
            _thinned(path, place / "sumo" / "fcd.parquet", "timestep_time", every_s)
        elif kind in WHOLE and path.suffix == ".xml":
            # SUMO's header has the date and the folder in it.
            body = re.sub(r"<!--.*?-->\s*", "", path.read_text(encoding="utf-8"), count=1, flags=re.DOTALL)
            (place / "sumo" / f"{kind}.xml.gz").write_bytes(gzip.compress(body.encode(), 9, mtime=0))
    (place / "events.jsonl").write_bytes((source.folder / "events.jsonl").read_bytes())
    (place / "scenario.toml").write_bytes((source.folder / "scenario.toml").read_bytes())
    clocks = ("command_line", "wall_time_s")
    write_info(place, {k: v for k, v in source.info.items() if k not in clocks} | {THINNED: [*steps, "fcd"]})
    return place


def _thinned(path: Path, target: Path, time: str, every_s: float) -> None:
    """The rows at multiples of a time, and the last."""
    kept = []
    with pq.ParquetFile(path) as file:
        end = max((pc.max(b[time]).as_py() for b in file.iter_batches(columns=[time]) if b.num_rows), default=0.0)
        for batch in file.iter_batches():
            at = batch[time].to_numpy(zero_copy_only=False)
            wanted = (np.abs(at / every_s - np.round(at / every_s)) * every_s < 1e-6) | (at == end)
            kept.append(pa.Table.from_batches([batch]).filter(pa.array(wanted)))
    table = pa.concat_tables(kept).unify_dictionaries() if kept else pq.read_table(path)
    floats = [f.name for f in table.schema if pa.types.is_floating(f.type)]
    pq.write_table(
        table, target, compression="zstd", compression_level=19, use_dictionary=[n for n in table.column_names if n not in floats],
        column_encoding=dict.fromkeys(floats, "BYTE_STREAM_SPLIT"), write_statistics=False, store_schema=True,
    )  # fmt: skip
