"""The trains on a net of any shape, frame by frame: where SUMO saw them, on the net as it lies."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from sumo_net import LineError
from sumo_net.shapes import Piece, shapes
from trainctl.errors import InputError
from trainctl.figures.trains import Drawn
from trainctl.report.panels import packed
from trainctl.runs.run import check_size
from trainctl.runs.series import INSTANT
from trainctl.signals import Floats

#: What is read of SUMO's FCD log.
COLUMNS = {
    "timestep_time": "time_s", "vehicle_id": "train", "vehicle_x": "x", "vehicle_y": "y", "vehicle_lane": "lane",
}  # fmt: skip


def on_the_map(drawn: Drawn, times: Floats) -> dict[str, Any] | None:
    """The parts of ``report_animation.animation`` that say where the trains are, for a net of any shape.

    Parameters
    ----------
    drawn : Drawn
        The run.
    times : ndarray, shape (frames,)
        Frames [s].

    Returns
    -------
    dict or None
        ``map`` (x and y [m] of every track, one after the other, a NaN in between), ``tracks`` (edges that trains were on),
        ``position`` and ``lateral`` (x and y of fronts [m], frames x trains), ``edge`` (numbers of ``tracks``), ``stops`` (name,
        x, y, whether a train came). None if the run was made without SUMO, which alone knows where its net lies.
    """
    folder = drawn.run.folder / "sumo"
    nets, log = sorted(folder.glob("*.net.xml")), folder / "fcd.parquet"
    if not nets or not log.is_file():
        return None
    try:
        pieces = shapes(nets[0], set(drawn.run.trains.edge.astype(str)))
        with pq.ParquetFile(log) as file:
            check_size(log, file)
            seen = pd.DataFrame(file.read(columns=list(COLUMNS)).to_pandas()).rename(columns=COLUMNS)
        for name in ("time_s", "x", "y"):
            seen[name] = pd.to_numeric(seen[name])
    except LineError as error:
        raise InputError(error.mistakes) from None
    except (pa.ArrowException, OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{log}: cannot be read: {str(error).partition(chr(10))[0]}") from None
    stops = _stops(drawn, seen, pieces)
    number = {name: k for k, name in enumerate(drawn.trains.names)}
    seen = seen[seen["train"].isin(number)]
    frame = np.clip(np.searchsorted(times, seen["time_s"].to_numpy() - INSTANT), 0, len(times) - 1)
    shown = np.abs(times[frame] - seen["time_s"].to_numpy()) < INSTANT
    seen, frame = seen[shown], frame[shown]
    train = seen["train"].map(number).to_numpy(dtype=np.int64)
    edges = seen["lane"].astype(str).str.replace("_[^_]*$", "", regex=True).astype("category")
    grids = []
    for values in (seen["x"], seen["y"], edges.cat.codes):
        grid = np.full((len(times), len(number)), np.nan)
        grid[frame, train] = values.to_numpy(dtype=float)
        grids.append(packed(grid))
    gap = np.full((1, 2), np.nan)
    points = np.concatenate([part for piece in pieces for part in (piece.points, gap)])
    return {
        "map": [packed(points[:, 0]), packed(points[:, 1])], "tracks": [str(e) for e in edges.cat.categories],
        "position": grids[0], "lateral": grids[1], "edge": grids[2], "stops": stops,
    }  # fmt: skip


def _stops(drawn: Drawn, seen: pd.DataFrame, pieces: list[Piece]) -> list[dict[str, Any]]:
    """Where trains stopped; stops to which none came lie in the middle of their edge."""
    found: dict[str, dict[str, Any]] = {}
    for event in drawn.run.events:
        if event["kind"] == "stop_reached" and event["stop"] not in found:
            there = seen[(seen["train"] == event["train"]) & (np.abs(seen["time_s"] - event["time_s"]) < INSTANT)]
            for x, y in there[["x", "y"]].to_numpy(float)[:1].tolist():
                found[event["stop"]] = {"name": str(event["stop"]), "x": x, "y": y, "reached": True}
    middle = {piece.edge: piece.points[len(piece.points) // 2 - 1 : len(piece.points) // 2 + 1].mean(axis=0) for piece in pieces}
    calls = drawn.run.stops.astype({"stop": str, "platform": str}) if len(drawn.run.stops) else drawn.run.stops
    for row in calls.to_dict("records"):
        if row["stop"] not in found and row["platform"] in middle:
            x, y = middle[row["platform"]].tolist()
            found[row["stop"]] = {"name": row["stop"], "x": x, "y": y, "reached": bool(np.isfinite(row["arrival_s"]))}
    return list(found.values())
