"""The trains on their tracks, frame by frame: positions, lateral places, links. Frames contain every event time exactly."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np

from sumo_net import Line
from trainctl.figures.corridors import line_of
from trainctl.figures.trains import Drawn
from trainctl.report.map import on_the_map
from trainctl.report.panels import _hex, happened, packed, told
from trainctl.runs.series import INSTANT
from trainctl.signals import Floats

#: Frames at most, and trains times frames at most.
FRAMES, CELLS = 2500, 100_000
#: Minimum number of frames, however many trains.
FEWEST = 300
#: Number of 16 bits that stands for none.
LOWEST = -32768
#: Events named in the page.
NAMED_EVENTS = 300


def animation(drawn: Drawn) -> dict[str, Any]:
    """Everything the page needs to draw the tracks at any frame.

    Returns
    -------
    dict
        ``tracks`` in lateral order, ``crossovers``, ``trains`` (name, colour, length), ``time`` (frames,) [s], ``position``,
        ``lateral``, ``speed`` (frames x trains, NaN where a train is not there), ``pairs`` and their ``links`` (frames x pairs:
        0 none, 1 stands but was not heard, 2 heard), ``events``. For a net of any shape see ``report_map``; ``time`` is empty
        where the run was made without SUMO, and there is nothing to draw them on.
    """
    split = drawn.trains
    if drawn.known.traffic:
        return _of_traffic(drawn)
    line = line_of(drawn.run)
    categories = split.words["track"].names
    tracks = list(line.track_ids) if line is not None and set(categories) <= set(line.track_ids) else categories
    instants = drawn.instants
    times = frames(instants, [float(event["time_s"]) for event in drawn.run.events], len(split.names))
    shape = (len(times), len(split.names))
    position, lateral, speed = np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, np.nan)
    x, v, at = split.column("position_m"), split.column("speed_mps"), split.column("time_s")
    side = _lateral(drawn, line, tracks)
    for k, (_, rows) in enumerate(split.slices()):
        frame, row = _matched(times, at[rows])
        position[frame, k], speed[frame, k], lateral[frame, k] = x[rows][row], v[rows][row], side[rows][row]
    pairs, links = _links(drawn, times)
    return {
        "tracks": tracks,
        "crossovers": [] if line is None else _crossovers(line, tracks, float(np.nanmin(x)), float(np.nanmax(x))),
        "trains": _trains(drawn),
        "time": [round(float(t), 6) for t in times],
        "position": packed(position), "lateral": _thousandths(lateral), "speed": packed(speed),
        "pairs": pairs, "links": base64.b64encode(links.tobytes()).decode(),
        **_events(drawn),
    }  # fmt: skip


def _of_traffic(drawn: Drawn) -> dict[str, Any]:
    """The same for trains that come and go."""
    times = frames(drawn.instants, [float(event["time_s"]) for event in drawn.run.events], len(drawn.trains.names))
    where = on_the_map(drawn, times)
    if where is None:
        where, times = {"tracks": []}, times[:0]
    split = drawn.trains
    at, v, speed = split.column("time_s"), split.column("speed_mps"), np.full((len(times), len(split.names)), np.nan)
    for k, (_, rows) in enumerate(split.slices() if len(times) else ()):
        frame, row = _matched(times, at[rows])
        speed[frame, k] = v[rows][row]
    pairs, links = _links(drawn, times) if len(times) else ([], np.zeros((0, 0), np.uint8))
    return {
        "crossovers": [], "trains": _trains(drawn), "time": [round(float(t), 6) for t in times], "speed": packed(speed),
        "pairs": pairs, "links": base64.b64encode(links.tobytes()).decode(), **where, **_events(drawn),
    }  # fmt: skip


def _thousandths(values: Floats) -> dict[str, str]:
    """Small numbers in 16 bits, a thousandth each; the lowest one stands for none."""
    whole = np.where(np.isfinite(values), np.round(1000.0 * np.nan_to_num(values)), float(LOWEST))
    return {"dtype": "i2", "bdata": base64.b64encode(whole.astype("<i2").tobytes()).decode()}


def _trains(drawn: Drawn) -> list[dict[str, Any]]:
    return [
        {"name": name, "color": _hex(drawn.colour[name]), "length": float(sum(drawn.known.length_m.get(name, ()))) or 0.0}
        for name in drawn.trains.names
    ]


def _events(drawn: Drawn) -> dict[str, Any]:
    events = happened(drawn)
    return {
        "events": [{"time": event["time_s"], "kind": event["kind"], "text": told(event)} for event in events[:NAMED_EVENTS]],
        "events_left_out": max(0, len(events) - NAMED_EVENTS),
    }


def frames(instants: Floats, events: Sequence[float], trains: int) -> Floats:
    """Recorded instants that are shown: evenly many, and each event's own, the one before it and the one after it."""
    most = int(np.clip(CELLS // max(trains, 1), FEWEST, FRAMES))
    keep = np.zeros(len(instants), np.bool_)
    keep[:: -(-len(instants) // most)] = True
    keep[-1] = True
    at = np.unique(np.searchsorted(instants, np.asarray(events, float) - INSTANT))[: most // 3]
    for k in (at - 1, at, at + 1):
        keep[np.clip(k, 0, len(instants) - 1)] = True
    return instants[keep]


def _lateral(drawn: Drawn, line: Line | None, tracks: list[str]) -> Floats:
    """Lateral place of every row: the number of its track, in between on a crossover."""
    track, number = drawn.trains.words["track"], {name: float(k) for k, name in enumerate(tracks)}
    side = np.array([*(number.get(name, np.nan) for name in track.names), np.nan])[track.codes]
    if line is None:
        return side
    edge, x = drawn.trains.words["edge"].each(), drawn.trains.column("position_m")
    for over in line.crossovers:
        on = edge == over.edge
        if on.any() and over.from_track in number and over.to_track in number:
            share = np.clip((x[on] - over.start_m) / over.length_m, 0.0, 1.0)
            side[on] = number[over.from_track] + share * (number[over.to_track] - number[over.from_track])
    return side


def _crossovers(line: Line, tracks: list[str], low: float, high: float) -> list[list[float]]:
    """Start [m], end [m], lateral start, lateral end of the crossovers within the stretch that trains covered."""
    return [
        [over.start_m, over.start_m + over.length_m, tracks.index(over.from_track), tracks.index(over.to_track)]
        for over in line.crossovers
        if over.start_m <= high and over.start_m + over.length_m >= low
    ]


def _matched(times: Floats, at: Floats) -> tuple[Any, Any]:
    """Frames and rows that are the same instant."""
    row = np.clip(np.searchsorted(at, times - INSTANT), 0, len(at) - 1)
    frame = np.flatnonzero(np.abs(at[row] - times) < INSTANT)
    return frame, row[frame]


def _links(drawn: Drawn, times: Floats) -> tuple[list[list[int]], Any]:
    """Directed pairs (sender, receiver as numbers of trains) and their state in every frame, uint8."""
    frame = drawn.run.links
    if frame.empty:
        return [], np.zeros((len(times), 0), np.uint8)
    place = {name: k for k, name in enumerate(drawn.trains.names)}
    ends = []
    for key in ("sender", "receiver"):
        category = frame[key].astype("category").cat
        ends.append(np.array([place.get(str(name), -1) for name in category.categories])[category.codes.to_numpy()])
    code = ends[0] * len(place) + ends[1]
    kinds, which = np.unique(code, return_inverse=True)
    k = np.clip(np.searchsorted(times, frame["time_s"].to_numpy() - INSTANT), 0, len(times) - 1)
    shown = np.abs(times[k] - frame["time_s"].to_numpy()) < INSTANT
    state = np.zeros((len(times), len(kinds)), np.uint8)
    state[k[shown], which.ravel()[shown]] = 1 + frame["heard"].to_numpy(dtype=bool)[shown]
    return [[int(kind) // len(place), int(kind) % len(place)] for kind in kinds], state
