"""Seeded changes of a log, as a simulator, a script or a careless hand makes them, and what must be found of each."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

NUMBERS = ("x", "y", "angle", "speed", "pos", "slope", "distance")


class Mutation(NamedTuple):
    """A changed log, the causes of which one must be named, the trains that must be, and by how much."""

    log: pd.DataFrame
    causes: tuple[str, ...]
    trains: tuple[str, ...] = ()
    by: float | None = None


def read(folder: Path) -> pd.DataFrame:
    """FCD of a run, with names as in XML, rounded as SUMO writes it."""
    frame = pq.read_table(folder / "sumo" / "fcd.parquet").to_pandas()
    frame.columns = [name.removeprefix("timestep_").removeprefix("vehicle_") for name in frame.columns]
    return frame.drop(columns="edge").astype({"id": str, "lane": str, "type": str})


def write(frame: pd.DataFrame, path: Path) -> Path:
    """As XML with two decimals, CSV or Parquet."""
    if path.suffix == ".xml":
        lines = ['<?xml version="1.0" encoding="UTF-8"?>', "<fcd-export>"]
        names = [name for name in frame.columns if name != "time"]
        for time, rows in frame.groupby("time", sort=True):
            lines.append(f'    <timestep time="{time:.2f}">')
            for row in rows[names].itertuples(index=False):
                cells = " ".join(
                    f'{n}="{v:.2f}"' if isinstance(v, float) else f'{n}="{v}"' for n, v in zip(names, row, strict=True)
                )
                lines.append(f"        <vehicle {cells}/>")
            lines.append("    </timestep>")
        path.write_text("\n".join([*lines, "</fcd-export>\n"]))
        return path
    frame = frame.rename(columns={n: "timestep_time" if n == "time" else f"vehicle_{n}" for n in frame.columns})
    if path.suffix == ".csv":
        frame.to_csv(path, sep=";", index=False, float_format="%.6f")
    else:
        pq.write_table(pa.Table.from_pandas(frame, preserve_index=False), path)
    return path


def later(rows: pd.DataFrame, since: float, by: float, hold: bool) -> pd.DataFrame:
    """A train's rows: from a time on those of ``by`` before; until it has lost that it stands, or is not there."""
    before, after = rows[rows.time < since], rows[rows.time >= since]
    times = np.arange(after.time.iloc[0] + (0.0 if hold else np.ceil(by)), after.time.iloc[-1] + np.floor(by) + 0.5)
    at = np.maximum(times - by, after.time.iloc[0])
    k = np.clip(np.searchsorted(after.time.to_numpy(), at + 1e-9) - 1, 0, len(after) - 1)
    out = after.iloc[k].copy()
    for name in NUMBERS:
        out[name] = np.interp(at, after.time, after[name])
    out["time"] = times
    if hold:
        out.loc[times < since + by, "speed"] = 0.0
    return pd.concat([before, out])


def ordered(parts: list[pd.DataFrame], end: float) -> pd.DataFrame:
    return pd.concat([p[p.time <= end] for p in parts]).sort_values(["time", "id"], kind="stable").reset_index(drop=True)


def delay(log: pd.DataFrame, rng: np.random.Generator) -> Mutation:
    name = str(rng.choice(sorted(set(log.id))))
    rows, rest = log[log.id == name], log[log.id != name]
    whole = rng.random() < 0.3
    since = rows.time.iloc[0] if whole else rows.time.iloc[int(rng.integers(5, len(rows) * 2 // 3))]
    by = float(rng.choice([1.0, 2.0, 7.0, 0.5, 20.0, 61.0, 12.5]))
    return Mutation(ordered([rest, later(rows, since, by, not whole)], log.time.max()), ("late",), (name,), by)


def order(log: pd.DataFrame, rng: np.random.Generator) -> Mutation:
    """Two trains that come to the join one after the other go on as each other, or by turns one later, the other earlier."""
    into = log[log.lane == "trunk_0"].groupby("id").time.min().sort_values()
    pairs = [(a, b) for a, b in zip(into.index, into.index[1:], strict=False)]
    one, two = pairs[int(rng.integers(len(pairs)))]
    since = float(into[one])
    if rng.random() < 0.5:
        out = log.copy()
        swap = out.time >= since
        names = {one: two, two: one}
        out.loc[swap, "id"] = out.loc[swap, "id"].replace(names)
        return Mutation(ordered([out], log.time.max()), ("order",), (one, two))
    gap = float(into[two] - into[one]) + float(rng.integers(3, 12))
    first, second = log[log.id == one], log[log.id == two]
    begin = max(first.time.iloc[0], second.time.iloc[0]) + 2
    early = second[second.time >= min(begin + gap, second.time.iloc[-10])].copy()
    early["time"] -= gap
    parts = [log[~log.id.isin([one, two])], later(first, begin, gap, True), second[second.time < early.time.iloc[0]], early]
    return Mutation(ordered(parts, log.time.max()), ("order",), (one, two))


def stop(log: pd.DataFrame, rng: np.random.Generator) -> Mutation:
    """A train that stands somewhere in the reference leaves that out; where it stands, and for how long, is drawn."""
    name = str(rng.choice(sorted(set(log.id) - {"stopping"})))
    rows = log[log.id == name]
    since, by = rows.time.iloc[int(rng.integers(5, len(rows) // 2))], float(rng.integers(10, 60))
    return Mutation(ordered([log[log.id != name], later(rows, since, by, True)], log.time.max()), ("stop",), (name,), by)


def shift(log: pd.DataFrame, rng: np.random.Generator) -> Mutation:
    out, column, by = log.copy(), str(rng.choice(NUMBERS)), float(rng.choice([0.05, 1.0, -3.0, 250.0]))
    wanted = np.ones(len(out), bool)
    name = str(rng.choice(sorted(set(log.id)))) if rng.random() < 0.5 else None
    if name is not None:
        wanted &= out.id == name
    if rng.random() < 0.5:
        wanted &= out.time >= np.quantile(out.time[wanted], rng.random() * 0.8)
    out.loc[wanted, column] += by
    return Mutation(out, ("shift",), () if name is None else (name,), by)


def some_rows(log: pd.DataFrame, rng: np.random.Generator) -> np.ndarray:
    inner = log[(log.groupby("id").cumcount() > 0) & (log.groupby("id").cumcount(ascending=False) > 0)]
    if rng.random() < 0.3:
        return np.flatnonzero(log.time == rng.choice(inner.time.unique()[50:-50]))
    return np.sort(rng.choice(inner.index, int(rng.integers(1, 20)), replace=False))


def dropped(log: pd.DataFrame, rng: np.random.Generator) -> Mutation:
    rows = some_rows(log, rng)
    return Mutation(log.drop(index=log.index[rows]), ("dropped",), tuple(sorted(set(log.id.iloc[rows]))))


def doubled(log: pd.DataFrame, rng: np.random.Generator) -> Mutation:
    rows = some_rows(log, rng)
    out = pd.concat([log, log.iloc[rows]]).sort_values("time", kind="stable")
    return Mutation(out, ("doubled",), tuple(sorted(set(log.id.iloc[rows]))))


def units(log: pd.DataFrame, rng: np.random.Generator) -> Mutation:
    column, factor = [
        ("speed", 3.6),
        ("pos", 0.001),
        ("angle", np.pi / 180),
        ("distance", 0.001),
        ("speed", 2.2369363),
        ("x", -1.0),
    ][int(rng.integers(6))]
    out = log.copy()
    out[column] *= factor
    return Mutation(out, ("units",), (), factor)


def renamed(log: pd.DataFrame, rng: np.random.Generator) -> Mutation:
    name, out = str(rng.choice(sorted(set(log.id)))), log.copy()
    times = out.time[out.id == name]
    since = times.iloc[0] if rng.random() < 0.6 else times.iloc[int(rng.integers(5, len(times) - 5))]
    out.loc[(out.id == name) & (out.time >= since), "id"] = "express"
    return Mutation(out, ("renamed",), (name, "express"))


MUTATIONS = {f.__name__: f for f in (delay, order, stop, shift, dropped, doubled, units, renamed)}


def one_late_one_missing(frame: pd.DataFrame, seconds: float) -> pd.DataFrame:
    """A log of ``merging`` in which fast.1 runs so much later from its 100th row on, and fast.2 is missing."""
    rows = frame[frame.id == "fast.1"]
    late = later(rows, rows.time.iloc[100], seconds, True)
    return ordered([frame[~frame.id.isin(["fast.1", "fast.2"])], late], frame.time.max())
