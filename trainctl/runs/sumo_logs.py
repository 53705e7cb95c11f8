"""Reading SUMO's logs as streams, without trusting them: no document types, no entities, bounded memory, one clear line."""

from __future__ import annotations

import gzip
import math
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, cast
from xml.parsers import expat

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from trainctl.errors import InputError
from trainctl.signals import Floats

CHUNK = 1 << 18  # bytes
BATCH_ROWS = 1 << 16
#: A single element of an XML log longer than this [bytes] is not one of SUMO's.
ELEMENT_BYTES = 1 << 22
#: More vehicles than this in one time step are not believed.
STEP_ROWS = 2_000_000

#: Columns of a batch of FCD rows beside ``time_s`` and ``id``, and what they are called in CSV and Parquet.
TEXTS = {"id": "vehicle_id", "lane": "vehicle_lane"}
NUMBERS = {"time_s": "timestep_time", "speed": "vehicle_speed", "pos": "vehicle_pos"}
NEEDED = ("time_s", "id", "speed")


def find_log(folder: Path, name: str) -> Path | None:
    """The log whose file name begins with ``name`` and that is XML, gzipped or not."""
    for path in sorted(folder.glob(f"{name}*")):
        if path.name.endswith((".xml", ".xml.gz")):
            return path
    return None


def kind_of(path: Path) -> str:
    """``xml``, ``csv`` or ``parquet``, from the content."""
    with opened(path) as stream:
        head = stream.read(512)
    if head[:4] == b"PAR1":
        return "parquet"
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    return "xml" if text[:1] == b"<" else "csv"


@contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """The file, unpacked if it is gzipped; what goes wrong while it is read becomes one line."""
    try:
        with open(path, "rb") as raw:
            packed = raw.read(2) == b"\x1f\x8b"
            raw.seek(0)
            if packed:
                with gzip.open(raw) as stream:
                    yield cast(BinaryIO, stream)
            else:
                yield raw
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise InputError(f"{path}: damaged gzip: {error}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None


def elements(path: Path, root: str, wanted: set[str]) -> Iterator[tuple[str, dict[str, str]]]:
    """Tag and attributes of the wanted elements of an XML log, in order.

    Raises
    ------
    InputError
        Another root element, not well-formed, cut short, with a document type (entity bombs), or unreasonably long elements.
    """
    found: list[tuple[str, dict[str, str]]] = []
    depth = 0
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        if depth == 0 and tag != root:
            raise InputError(f"{path}: not a log of the kind <{root}>: its root is <{tag:.40}>")
        depth += 1
        if tag in wanted:
            found.append((tag, attributes))

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1

    def refuse(*_: object) -> None:
        raise InputError(f"{path}: line {parser.CurrentLineNumber}: has a document type or entities, which no log of SUMO has")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    fed = 0
    with opened(path) as stream:
        while chunk := stream.read(CHUNK):
            fed += len(chunk)
            _feed(parser, path, chunk, False)
            if fed - parser.CurrentByteIndex > ELEMENT_BYTES:
                raise InputError(f"{path}: line {parser.CurrentLineNumber}: an element longer than {ELEMENT_BYTES >> 20} MiB")
            yield from found
            found.clear()
        _feed(parser, path, b"", True)
        yield from found


def _feed(parser: expat.XMLParserType, path: Path, chunk: bytes, last: bool) -> None:
    try:
        parser.Parse(chunk, last)
    except expat.ExpatError as error:
        raise InputError(f"{path}: not well-formed XML: {error}") from None
    except (ValueError, LookupError) as error:  # an unknown encoding
        raise InputError(f"{path}: {error}") from None


def fcd_batches(path: Path) -> Iterator[pd.DataFrame]:
    """Rows of an FCD log in pieces of whole time steps.

    Yields
    ------
    DataFrame
        ``time_s, id, speed`` and, where the log has them, ``lane, pos``; finite numbers only, never empty.
    """
    kind = kind_of(path)
    pieces = {"xml": _fcd_xml, "csv": _fcd_csv, "parquet": _fcd_parquet}[kind](path)
    held: list[pd.DataFrame] = []  # rows of a step that may go on in the next piece
    for piece in pieces:
        if piece.empty:
            continue
        numbers = [name for name in NUMBERS if name in piece.columns]
        if not np.isfinite(piece[numbers].to_numpy()).all():
            raise InputError(f"{path}: a number is missing or not finite near {piece['time_s'].iloc[0]} s")
        last = piece["time_s"].to_numpy() == piece["time_s"].iloc[-1]
        cut = len(piece) - (int(np.argmin(last[::-1])) if not last.all() else len(piece))
        if cut:
            yield pd.concat([*held, piece.iloc[:cut]], ignore_index=True)
            held = []
        elif held and held[0]["time_s"].iloc[0] != piece["time_s"].iloc[0]:
            yield pd.concat(held, ignore_index=True)
            held = []
        held.append(piece.iloc[cut:])
        if sum(map(len, held)) > STEP_ROWS:
            raise InputError(f"{path}: more than {STEP_ROWS} vehicles at {piece['time_s'].iloc[-1]} s")
    if held:
        yield pd.concat(held, ignore_index=True)


def _fcd_xml(path: Path) -> Iterator[pd.DataFrame]:
    time = math.nan
    rows: dict[str, list[str]] = {"id": [], "speed": [], "lane": [], "pos": []}
    times: list[float] = []
    for tag, attributes in elements(path, "fcd-export", {"timestep", "vehicle"}):
        if tag == "timestep":
            try:
                time = float(attributes["time"])
            except (KeyError, ValueError):
                raise InputError(f"{path}: a timestep without a time") from None
            continue
        if "id" not in attributes or "speed" not in attributes:
            raise InputError(f"{path}: a vehicle without id or speed at {time:g} s")
        times.append(time)
        for name, texts in rows.items():
            texts.append(attributes.get(name, ""))
        if len(times) >= BATCH_ROWS:
            yield _from_texts(path, times, rows)
            times, rows = [], {name: [] for name in rows}
    if times:
        yield _from_texts(path, times, rows)


def _from_texts(path: Path, times: list[float], rows: dict[str, list[str]]) -> pd.DataFrame:
    columns: dict[str, object] = {"time_s": np.array(times), "id": rows["id"], "speed": _floats(path, rows["speed"], "speed")}
    if all(rows["lane"]) and all(rows["pos"]):
        columns |= {"lane": rows["lane"], "pos": _floats(path, rows["pos"], "pos")}
    return pd.DataFrame(columns)


def _floats(path: Path, texts: list[str], name: str) -> Floats:
    try:
        return np.array([float(text) for text in texts])
    except ValueError as error:
        raise InputError(f"{path}: {name}: {error}") from None


def _fcd_csv(path: Path) -> Iterator[pd.DataFrame]:
    with opened(path) as stream:
        head = stream.readline(1 << 16)
    separator = next((s for s in ";,\t" if s.encode() in head), ";")
    known = {name.strip().strip('"') for name in head.decode("utf-8", "replace").strip().split(separator)}
    names = _columns(path, known)
    with opened(path) as stream:
        try:
            reader = pd.read_csv(
                stream, sep=separator, usecols=list(names.values()), chunksize=BATCH_ROWS, dtype=dict.fromkeys(TEXTS.values(), str),
                keep_default_na=False, na_values={name: [""] for name in NUMBERS.values()}, encoding_errors="strict",
            )  # fmt: skip
            for piece in reader:
                piece = piece.rename(columns={file: ours for ours, file in names.items()})
                piece = piece[piece["id"] != ""]  # as in Parquet
                yield piece.astype({name: np.float64 for name in names if name in NUMBERS})
        except (pd.errors.ParserError, pd.errors.EmptyDataError, ValueError) as error:
            raise InputError(f"{path}: not an FCD log: {str(error).splitlines()[0] if str(error) else 'empty'}") from None


def _fcd_parquet(path: Path) -> Iterator[pd.DataFrame]:
    try:
        with pq.ParquetFile(path) as file:
            known = file.schema_arrow.names
            names = _columns(path, set(known))
            if any(known.count(theirs) > 1 for theirs in names.values()):
                raise InputError(f"{path}: not an FCD log: a column stands more than once")
            for batch in file.iter_batches(batch_size=BATCH_ROWS, columns=list(names.values())):
                piece = batch.to_pandas().rename(columns={file: ours for ours, file in names.items()})
                piece = piece[piece["id"].notna()].copy()  # a step without vehicles is a row without a vehicle
                for name in names:
                    piece[name] = piece[name].astype(np.float64 if name in NUMBERS else str)
                yield piece
    except (pa.ArrowException, OSError, ValueError, TypeError) as error:
        raise InputError(f"{path}: not an FCD log: {str(error).partition(chr(10))[0]}") from None


def _columns(path: Path, known: set[str]) -> dict[str, str]:
    """Our names of the columns that are there -> theirs."""
    names = {ours: theirs for ours, theirs in (TEXTS | NUMBERS).items() if theirs in known}
    missing = [(TEXTS | NUMBERS)[name] for name in NEEDED if name not in names]
    if missing:
        raise InputError(f"{path}: not an FCD log: no column {', '.join(missing)}")
    if not {"lane", "pos"} <= names.keys():
        names = {name: names[name] for name in NEEDED}
    return names
