"""A run's tables for other programs: CSV files, or one MAT file. Columns keep their names, which carry the unit."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as csv
import pyarrow.parquet as pq

from trainctl.errors import InputError
from trainctl.runs.run import Run

TABLES = ("trains", "units", "links", "stops")

#: How text begins that a spreadsheet would compute.
FORMULA = r"^[=+\-@\t\r]"

#: Rows read at once.
ROWS = 1 << 16

#: A MAT file (version 5) holds less than 2 GiB per variable; a table is one variable.
MAT_BYTES = 2**31


def to_csv(run: Run, folder: Path) -> list[Path]:
    """Write ``trains.csv``, ``units.csv``, ``links.csv`` and ``events.csv``, in pieces: memory does not grow with the run.

    What is a list in an event is JSON in its field. A name that a spreadsheet would take for a formula (``=``, ``+``, ``-``, ``@``
    first) has an apostrophe before it.
    Numbers are the shortest that give the same double again; what is not a number is an empty field.

    Parameters
    ----------
    run : Run
        A run folder.
    folder : Path
        Where to; files of these names there are replaced.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    InputError
        The folder is a file, or the run is damaged.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; CSV needs a folder")
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name in TABLES:
        if not run.files(name):
            continue
        target, new = folder / f"{name}.csv", folder / f"{name}.csv.new"
        writer = None
        for batch in _batches(run, name):
            writer = writer or csv.CSVWriter(new, batch.schema)
            writer.write_batch(batch)
        if writer is not None:
            writer.close()
            os.replace(new, target)
            written.append(target)
    if not written:
        raise InputError(f"{run.folder}: no table recorded")
    events = pd.DataFrame([{k: _field(v) for k, v in e.items()} for e in run.events])
    events.to_csv(folder / "events.csv", index=False)
    return [*written, folder / "events.csv"]


def _field(value: Any) -> Any:
    """What stands in a field of events.csv."""
    if isinstance(value, list | dict):
        return json.dumps(value)
    return f"'{value}" if isinstance(value, str) and re.match(FORMULA, value) else value


def _batches(run: Run, table: str) -> Iterator[pa.RecordBatch]:
    """A table in pieces, names as text and NaN as nothing."""
    for path in run.files(table):
        try:
            with pq.ParquetFile(path) as file:
                for batch in file.iter_batches(batch_size=ROWS):
                    yield pa.RecordBatch.from_arrays([_plain(c) for c in batch.columns], names=batch.schema.names)
        except (pa.ArrowException, OSError) as error:
            if isinstance(error, OSError) and error.filename is not None and str(error.filename) != str(path):
                raise
            raise InputError(f"{path}: damaged: {str(error).splitlines()[0]}") from None


def _plain(column: Any) -> Any:
    if pa.types.is_dictionary(column.type):
        column = column.dictionary_decode()
    if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
        return pc.if_else(pc.match_substring_regex(column, FORMULA), pc.binary_join_element_wise("'", column, ""), column)
    if pa.types.is_floating(column.type):
        return pc.if_else(pc.is_nan(column), pa.scalar(None, column.type), column)
    return column


def to_mat(run: Run, path: Path) -> Path:
    """Write one MAT file (version 5) with structs ``trains``, ``units``, ``links``, ``metrics`` and ``run``.

    A column of a table is a column vector. Columns of names (train, track, edge, sender, ...) are numbers from 1 into the cell
    array ``NAME_names`` beside them. Metrics are ``metrics.bounds_speed_lower_margin_mps``: the dot of the name as an underscore,
    values of single trains and links left out.

    Parameters
    ----------
    run : Run
        A run folder.
    path : Path
        The file; replaced if it exists. Its folder is made.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    InputError
        The path is a folder, the run is damaged, or a table is too large for this format.
    """
    from scipy.io import savemat

    if path.is_dir():
        raise InputError(f"{path}: is a folder; MAT needs a file name")
    content: dict[str, Any] = {}
    for name in TABLES:
        if run.files(name):
            content[name] = _struct(run, name)
    if not content:
        raise InputError(f"{run.folder}: no table recorded")
    if (run.folder / "metrics.json").is_file():
        content["metrics"] = {
            key.replace(".", "_"): float(value)
            for key, value in run.metrics.items()
            if "/" not in key and isinstance(value, int | float)
        }
    content["run"] = {key: str(run.info.get(key)) for key in ("status", "scenario_sha256", "backend")}
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(path.name + ".new")
    savemat(new, content, appendmat=False, long_field_names=True, do_compression=True, oned_as="column")
    os.replace(new, path)
    return path


def _struct(run: Run, name: str) -> dict[str, Any]:
    frame = run.table(name)
    if frame.size * 8 > MAT_BYTES:
        raise InputError(f"{run.folder}: {name} has {len(frame)} rows, more than a MAT file holds: use csv, or thin the run")
    struct: dict[str, Any] = {}
    for column in frame.columns:
        values = frame[column]
        if isinstance(values.dtype, pd.CategoricalDtype) or values.dtype == object or pd.api.types.is_string_dtype(values.dtype):
            names = values.astype("category").cat
            struct[str(column)] = names.codes.to_numpy(np.float64) + 1.0
            struct[f"{column}_names"] = np.array([str(n) for n in names.categories], dtype=object)
        else:
            struct[str(column)] = values.to_numpy()
    return struct
