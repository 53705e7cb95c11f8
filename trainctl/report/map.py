"""The trains on a net of any shape, frame by frame: where SUMO saw them, on the net as it lies."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from sumo_net import LineError
from sumo_net.shapes import shapes
from trainctl.errors import InputError
from trainctl.figures.trains import Drawn
from trainctl.report.panels import packed
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
        ``position`` and ``lateral`` (x and y of fronts [m], frames x trains), ``edge`` (numbers of ``tracks``). None if the run
        was made without SUMO, which alone knows where its net lies.
    """
    folder = drawn.run.folder / "sumo"
    nets, log = sorted(folder.glob("*.net.xml")), folder / "fcd.parquet"
    if not nets or not log.is_file():
        return None
    try:
        pieces = shapes(nets[0], set(drawn.run.trains.edge.astype(str)))
        seen = pd.DataFrame(pq.read_table(log, columns=list(COLUMNS)).to_pandas()).rename(columns=COLUMNS)
    except LineError as error:
        raise InputError(error.mistakes) from None
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{log}: cannot be read: {str(error).partition(chr(10))[0]}") from None
    number = {name: k for k, name in enumerate(drawn.trains.names)}
    seen = seen[seen["train"].isin(number)]
    frame = np.clip(np.searchsorted(times, seen["time_s"].to_numpy() - INSTANT), 0, len(times) - 1)
    shown = np.abs(times[frame] - seen["time_s"].to_numpy()) < INSTANT
    seen, frame = seen[shown], frame[shown]
    train = seen["train"].map(number).to_numpy()
    edges = seen["lane"].astype(str).str.rpartition("_")[0].astype("category")
    grids = []
    for values in (seen["x"], seen["y"], edges.cat.codes):
        grid = np.full((len(times), len(number)), np.nan)
        grid[frame, train] = values.to_numpy(dtype=float)
        grids.append(packed(grid))
    gap = np.full((1, 2), np.nan)
    points = np.concatenate([part for piece in pieces for part in (piece.points, gap)])
    return {
        "map": [packed(points[:, 0]), packed(points[:, 1])], "tracks": [str(e) for e in edges.cat.categories],
        "position": grids[0], "lateral": grids[1], "edge": grids[2],
    }  # fmt: skip
