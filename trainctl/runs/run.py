"""Reading a run folder, finished or not: tables as DataFrames, loaded when first asked for.

``run = Run("runs/three_tracks")`` has ``run.trains``, ``run.units``, ``run.links`` (DataFrames with the columns of the run
folder), ``run.events``, ``run.info``, ``run.metrics`` and ``run.scenario``.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.parquet as pq

from sumo_net.bounded import reason
from trainctl.errors import InputError
from trainctl.record.folder import FORMAT, INFO, SCHEMA_VERSION
from trainctl.runs.schema import INFO as FIELDS
from trainctl.runs.schema import check_table, is_event, wrong_fields

if TYPE_CHECKING:
    import pandas as pd

#: run.json, metrics.json and scenario.toml are not longer than this [bytes], nor a line of events.jsonl.
MOST_BYTES = 1 << 24
#: No run has more events.
MOST_EVENTS = 1_000_000
#: A table may take so much memory [bytes], or as many times what it takes on the disk.
TABLE_BYTES, TIMES = 1 << 28, 1000

#: Where metrics.json says by which version of the definitions it was computed.
DEFINITIONS_KEY = "definitions"


class Run:
    """A run folder of ours; a run that was killed is read as far as it was closed.

    Parameters
    ----------
    folder : Path
        ``DIR``, or ``DIR.partial`` of a run that did not complete.

    Raises
    ------
    InputError
        Not a run folder, or of a later schema; on access: a file is missing or damaged.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise InputError(f"{folder}: {'not a run folder: it is a file' if self.folder.exists() else 'no such directory'}")
        if not (self.folder / INFO).is_file():
            raise InputError(f"{folder}: not a run folder: it has no {INFO}")
        info = _json(self.folder / INFO)
        if not isinstance(info, dict) or info.get("format") != FORMAT:
            raise InputError(f"{self.folder / INFO}: not a run of trainctl")
        if info.get("schema_version") != SCHEMA_VERSION:
            raise InputError(
                f"{self.folder / INFO}: schema_version = {info.get('schema_version')}: this trainctl reads {SCHEMA_VERSION}"
            )
        if wrong := wrong_fields(info, FIELDS, False):
            raise InputError([f"{self.folder / INFO}: {key} = {str(info[key])[:60]}: not what a run has there" for key in wrong])
        self.info: dict[str, Any] = info

    def __repr__(self) -> str:
        """Folder, status and size in one line."""
        return f"Run({str(self.folder)!r}, {self.info.get('status')}, {self.info.get('steps', '?')} steps)"

    @property
    def ok(self) -> bool:
        """Whether the run is complete and nothing failed it: no collision, no gridlock, with the supervisor on no overspeed."""
        return self.info.get("status") == "complete" and not self.info.get("checks_failed")

    @property
    def collisions(self) -> int:
        """Pairs of trains that collided."""
        return int(self.info.get("collisions", 0))

    @cached_property
    def trains(self) -> pd.DataFrame:
        """One row per step and train."""
        return self.table("trains")

    @cached_property
    def units(self) -> pd.DataFrame:
        """One row per recorded instant and unit; empty if the plant has no units."""
        return self.table("units", missing_is_empty=True)

    @cached_property
    def links(self) -> pd.DataFrame:
        """One row per step and link."""
        return self.table("links")

    @cached_property
    def stops(self) -> pd.DataFrame:
        """One row per train and stop; empty if no train stops."""
        return self.table("stops", missing_is_empty=True)

    @property
    def net(self) -> Path | None:
        """The SUMO net it ran on: SUMO's copy, or that of a run without SUMO on a given net; None: a line of ours."""
        return next(iter(sorted([*(self.folder / "sumo").glob("*.net.xml"), *self.folder.glob("*.net.xml")])), None)

    @cached_property
    def events(self) -> list[dict[str, Any]]:
        """The lines of events.jsonl. A last line cut short by a kill is left out."""
        path = self.folder / "events.jsonl"
        events = []
        for number, line in enumerate(_lines(path), start=1):
            if number > MOST_EVENTS:
                raise InputError(f"{path}: more than {MOST_EVENTS} events")
            try:
                event = json.loads(line)
            except (ValueError, RecursionError):
                event = None
            if not is_event(event):
                raise InputError(f"{path}: line {number} is not an event")
            events.append(event)
        return events

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """Metrics as they stand in metrics.json, by whatever ``definitions`` they were computed."""
        return {name: value for name, value in self._measured.items() if name != DEFINITIONS_KEY}

    @property
    def definitions(self) -> int | None:
        """Version of the definitions of metrics.json, see ``metrics.versions``; None without metrics."""
        if not (self.folder / "metrics.json").exists():
            return None
        version = self._measured.get(DEFINITIONS_KEY, 1)
        if isinstance(version, bool) or not isinstance(version, int):
            raise InputError(f"{self.folder / 'metrics.json'}: {DEFINITIONS_KEY} = {version!r:.40}: must be a number of a version")
        return version

    @cached_property
    def _measured(self) -> dict[str, Any]:
        """Content of metrics.json."""
        content = _json(self.folder / "metrics.json")
        if not isinstance(content, dict):
            raise InputError(f"{self.folder / 'metrics.json'}: not a table of metrics")
        return content

    @cached_property
    def scenario(self) -> dict[str, Any]:
        """The scenario as resolved, as plain tables."""
        path = self.folder / "scenario.toml"
        try:
            return tomllib.loads(_bytes(path).decode())
        except (ValueError, RecursionError) as error:  # not TOML, not text, a number of 5000 digits
            raise InputError(f"{path}: {reason(error)}") from None

    def files(self, table: str) -> list[Path]:
        """The Parquet files of a table: one, or the closed segments of a run that was killed."""
        whole = self.folder / f"{table}.parquet"
        return [whole] if whole.exists() else sorted((self.folder / "segments").glob(f"{table}-*.parquet"))

    def batches(self, table: str, columns: list[str] | None = None, rows: int = 1 << 18) -> Iterator[pd.DataFrame]:
        """A table in pieces of at most ``rows`` rows: for logs larger than memory."""
        for path in self.files(table):
            with _parquet(path) as file:
                try:
                    for batch in file.iter_batches(batch_size=rows, columns=columns):
                        yield batch.to_pandas()
                except (pa.ArrowException, OSError) as error:
                    raise InputError(f"{path}: damaged: {_first_line(error)}") from None

    def table(self, table: str, missing_is_empty: bool = False) -> pd.DataFrame:
        """A whole table; names are categorical columns."""
        whole: pd.DataFrame = self.rows(table, missing_is_empty).to_pandas()
        return whole

    def rows(self, table: str, missing_is_empty: bool = False) -> pa.Table:
        """The same as it is in memory before it becomes a DataFrame: metrics do without pandas, which takes long to import."""
        files = self.files(table)
        if not files:
            if missing_is_empty:
                return pa.table({})
            raise InputError(f"{self.folder}: {table}.parquet is missing")
        parts = []
        for path in files:
            with _parquet(path) as file:
                try:
                    check_size(path, file)
                    parts.append(file.read())
                except (pa.ArrowException, OSError) as error:
                    raise InputError(f"{path}: damaged: {_first_line(error)}") from None
        try:
            joined = pa.concat_tables(parts).unify_dictionaries()
        except pa.ArrowException as error:
            raise InputError(f"{self.folder}: segments of {table} do not fit together: {_first_line(error)}") from None
        check_table(table, joined, self.folder)
        return joined


def _parquet(path: Path) -> pq.ParquetFile:
    """An open Parquet file, or one clear line."""
    try:
        return pq.ParquetFile(path)
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{path}: not a complete Parquet file: {_first_line(error)}") from None


def check_size(path: Path, file: pq.ParquetFile) -> None:
    """Refuse a table that is small on the disk and enormous in memory: values that repeat take no room in a file.

    Raises
    ------
    InputError
        It is one.
    """
    about = file.metadata
    groups = sum(about.row_group(k).total_byte_size for k in range(about.num_row_groups))
    size = max(8 * about.num_rows * about.num_columns, groups)
    if size > max(TABLE_BYTES, TIMES * path.stat().st_size):
        raise InputError(f"{path}: unpacks to {size >> 20} MiB, more than {TIMES} times what it is: not a table of a run")


def _bytes(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            content = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    if len(content) > MOST_BYTES:
        raise InputError(f"{path}: longer than {MOST_BYTES >> 20} MiB")
    return content


def _lines(path: Path) -> Iterator[bytes]:
    """The lines of a file; not the last one if it is cut short."""
    try:
        with path.open("rb") as file:
            while (line := file.readline(MOST_BYTES)).endswith(b"\n"):
                yield line
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    if len(line) == MOST_BYTES:
        raise InputError(f"{path}: a line longer than {MOST_BYTES >> 20} MiB")


def _json(path: Path) -> Any:
    try:
        return json.loads(_bytes(path))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON: {reason(error)}") from None


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0]
