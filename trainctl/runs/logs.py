"""One of SUMO's logs as a stream of tables, whatever its format (``trainctl.runs`` says what the tables hold)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from trainctl.errors import InputError
from trainctl.runs.kinds import KINDS, NAMES, Kind, kind_of_table
from trainctl.runs.sumo_logs import decoded, elements, kind_of, opened, seconds
from trainctl.runs.tables import csv_names, csv_rows, is_index, named, parquet_names, parquet_rows
from trainctl.runs.xml_rows import xml_rows
from trainctl.signals import Floats


@dataclass(frozen=True)
class Log:
    """One table of rows in time. ``batches`` begins anew at every call."""

    name: str
    path: str
    time: str | None
    keys: tuple[str, ...]
    batches: Callable[[], Iterator[pa.Table]]
    version: str | None = None


def sumo_log(path: Path) -> Log | None:
    """A log of SUMO's as a stream; None if it is none that is known, a Log without a name if it is empty.

    Raises
    ------
    InputError
        The file is damaged, or no log at all.
    """
    form = kind_of(path)
    if form == "xml":
        kind, version = _xml_kind(path)
        if kind is None:
            return None
        known = kind
        return Log(kind.name, str(path), kind.time, kind.keys, lambda: map(in_seconds, xml_rows(path, known)), version)
    names = csv_names(path)[1] if form == "csv" else parquet_names(path)
    if not names or names in ([step] for step in ("timestep_time", "time")):  # steps, and nothing in them
        return Log("", str(path), None, (), lambda: iter(()))
    logged = [name for name in names if not is_index(name)]
    found = kind_of_table(logged)
    if found is None:
        if len(set(logged)) < len(logged):
            told = "a column appears more than once: not a log of SUMO, or one with plain headers"
            raise InputError(f"{path}: {told} (then: sumo --output.column-header tag)")
        return None
    kind, called = found
    rest = iter(called)
    columns, read = ["" if is_index(name) else next(rest) for name in names], csv_rows if form == "csv" else parquet_rows
    return Log(kind.name, str(path), kind.time, kind.keys, lambda: map(in_seconds, named(read(path), columns, kind)))


def vehicles(path: Path) -> Iterator[pa.Table]:
    """Rows of the vehicles of an FCD log, in pieces of whole time steps.

    In XML they are told by their element. CSV and Parquet do not have it: what has an edge and no lane is a person or container
    there, unless the log has a column ``tag``, or no lanes at all (mesoscopic).

    Yields
    ------
    Table
        ``id`` [str], ``time`` [s], ``speed`` [m/s] and, where the log has them, ``lane`` [str] and ``pos`` [m]: float64 or null.

    Raises
    ------
    InputError
        Not an FCD log, damaged, or with numbers that are none.
    """
    return _whole_steps(path, (_numbers(path, batch) for batch in _vehicle_rows(path)))


FCD = next(kind for kind in KINDS if kind.name == "fcd")
NUMBERS = ("time", "speed", "pos")
#: What SUMO rounds to in XML and CSV where it writes float32 in Parquet.
DECIMALS = 2
#: More vehicles than this in one time step are not believed.
STEP_ROWS = 2_000_000


def _vehicle_rows(path: Path) -> Iterator[pa.Table]:
    if kind_of(path) == "xml":
        yield from map(in_seconds, xml_rows(path, FCD, ("vehicle",)))
        return
    log = sumo_log(path)
    if log is None:
        raise InputError(f"{path}: not an FCD log: no column time, id and one of x, speed, pos, lane, edge, type")
    if log.name not in ("fcd", ""):
        raise InputError(f"{path}: not an FCD log: it is one of the kind {log.name}")
    lanes: bool | None = None
    for batch in log.batches():
        names = set(batch.column_names)
        if "tag" in names:
            batch = batch.filter(pc.equal(batch["tag"], "vehicle"))
        elif {"lane", "edge"} <= names and batch.num_rows:
            persons = pc.and_(batch["edge"].is_valid(), batch["lane"].is_null())
            if pc.any(persons).as_py():
                if lanes is None:
                    lanes = any(b["lane"].null_count < b.num_rows for b in log.batches())
                batch = batch.filter(pc.invert(persons)) if lanes else batch
        yield batch


def _numbers(path: Path, batch: pa.Table) -> pa.Table:
    """The columns of vehicles that are needed, numbers as such."""
    names = set(batch.column_names)
    if not batch.num_rows:
        return batch
    if not {"id", "speed"} <= names or batch["id"].null_count or batch["speed"].null_count:
        at = batch["time"][0].as_py()
        raise InputError(f"{path}: a vehicle without id or speed near {at} s")
    columns: dict[str, pa.Array] = {"id": batch["id"].cast(pa.string())}
    for name in NUMBERS:
        if name in names:
            numbers = number_column(path, name, batch[name])
            columns[name] = pc.round(numbers, DECIMALS) if pa.types.is_float32(batch[name].type) else numbers
    if "lane" in names:
        columns["lane"] = batch["lane"].cast(pa.string())
    for name in ("time", "speed", "pos"):
        if name in columns and not pc.all(pc.is_finite(columns[name]), min_count=0).as_py():
            raise InputError(f"{path}: {name}: a number is not finite near {columns['time'][0].as_py()} s")
    if columns["time"].null_count:
        raise InputError(f"{path}: a row without a time")
    return pa.table(columns)


def number_column(path: Path, name: str, column: pa.ChunkedArray) -> pa.ChunkedArray:
    """A column as float64, null where nothing stands.

    Raises
    ------
    InputError
        It holds something that is no number.
    """
    try:
        return column.cast(pa.float64(), safe=False)
    except pa.ArrowException:
        wrong = next((text for text in column.to_pylist() if text is not None and not _is_number(str(text))), "")
        raise InputError(f"{path}: {name} = {wrong:.40}: not a number") from None


def _is_number(text: str) -> bool:
    try:
        pa.array([text], pa.string()).cast(pa.float64())
    except pa.ArrowException:
        return False
    return True


def _whole_steps(path: Path, batches: Iterator[pa.Table]) -> Iterator[pa.Table]:
    held: list[pa.Table] = []  # rows of a step that may go on in the next piece
    for batch in batches:
        if not batch.num_rows:
            continue
        time: Floats = batch["time"].to_numpy()
        cut = len(time) - int((time[::-1] != time[-1]).argmax()) if time[0] != time[-1] else 0
        if held and time[0] != held[0]["time"][-1].as_py():
            yield pa.concat_tables(held, promote_options="default")
            held = []
        if cut:
            yield pa.concat_tables([*held, batch.slice(0, cut)], promote_options="default")
            held = []
        held.append(batch.slice(cut))
        if sum(map(len, held)) > STEP_ROWS:
            raise InputError(f"{path}: more than {STEP_ROWS} vehicles at {time[-1]} s")
    if held:
        yield pa.concat_tables(held, promote_options="default")


def in_seconds(batch: pa.Table) -> pa.Table:
    """A table with human-readable times as seconds."""
    for place, name in enumerate(batch.column_names):
        column = batch[name]
        if name not in NAMES and pa.types.is_string(column.type) and pc.any(pc.match_substring(column, ":")).as_py():
            texts = pa.array([None if text is None else seconds(text) for text in column.to_pylist()], pa.string())
            batch = batch.set_column(place, name, texts)
    return batch


def _xml_kind(path: Path) -> tuple[Kind | None, str | None]:
    """Kind from the root element, version of SUMO from the header."""
    with opened(path) as stream:
        head = decoded(stream.read(1 << 18))
    version = re.search(r"by Eclipse SUMO[^\n\"<>]{0,40}? (v?[0-9][\w.+-]{0,60})", head)
    body = re.sub(r"<!--.*?-->|<\?.*?\?>", "", head, flags=re.DOTALL)
    root = re.search(r"<\s*([A-Za-z_!][\w.:-]*)", body)
    if root is None or root[1].startswith("!"):
        # Not XML, or with a document type: the strict reader says so.
        for _ in elements(path, "fcd-export", set()):
            pass
        raise InputError(f"{path}: not a log of SUMO")
    kinds = [kind for kind in KINDS if kind.root == root[1]]
    if len(kinds) > 1:  # edge or lane data
        lanes = re.search(r"<lane\s", body) is not None
        kinds = [kind for kind in kinds if (kind.rows == ("lane",)) == lanes]
    return next(iter(kinds), None), version[1] if version else None
