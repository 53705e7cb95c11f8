"""The line coordinate: which edge a place on a track is, and how to go from one track to another.

``Line.of`` computes it from a line description, ``Line.read`` takes it from the net file; both give the same. The
kilometrage of a train is ``start_m`` of its edge plus its lane position, on crossovers too, so it is continuous through a
change of track.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sumo_net.layout import Floats, Gradient, edges, gradient
from sumo_net.netfile import RAIL, NetEdge, NetFile, read_net
from sumo_net.spec import LineError, LineSpec, text

Ints = NDArray[np.int64]


class LineCrossover(NamedTuple):
    """A one-way crossover; on the kilometrage it is ``start_m`` to ``start_m + length_m``."""

    id: str
    from_track: str
    to_track: str
    start_m: float
    length_m: float
    speed_mps: float
    edge: str


@dataclass(frozen=True, eq=False)
class Line:
    """Parallel tracks with one kilometrage. Edges stand track by track in lateral order, each by kilometrage, then crossovers."""

    edges: tuple[str, ...]  # ids, E of them
    tracks: tuple[str, ...]  # of each edge; a crossover belongs to the track it leads to
    start_m: Floats  # (E,) kilometrage of the beginning of each edge
    length_m: Floats  # (E,)
    speed_mps: Floats  # (E,) limit
    crossovers: tuple[LineCrossover, ...]
    gradient: Gradient
    track_ids: tuple[str, ...]  # left to right
    begin_m: float
    end_m: float

    @classmethod
    def of(cls, spec: LineSpec) -> Line:
        """The line a description stands for, without building its net."""
        pieces = edges(spec)
        crossovers = tuple(
            LineCrossover(c.name, c.from_track, c.to_track, e.start_m, e.length_m, e.speed_mps, e.id)
            for e in pieces
            if (c := e.crossover) is not None
        )
        return cls(
            edges=tuple(e.id for e in pieces),
            tracks=tuple(e.track for e in pieces),
            start_m=np.array([e.start_m for e in pieces]),
            length_m=np.array([e.length_m for e in pieces]),
            speed_mps=np.array([e.speed_mps for e in pieces]),
            crossovers=crossovers,
            gradient=gradient(spec),
            track_ids=spec.tracks,
            begin_m=spec.begin_m,
            end_m=spec.end_m,
        )

    @classmethod
    def read(cls, path: str | Path) -> Line:
        """The line in a net file.

        Raises
        ------
        LineError
            If there is no such file, or it is not a net of ours.
        """
        return line_of(rail_edges(read_net(Path(path)), path), str(path))

    @cached_property
    def index(self) -> dict[str, int]:
        """Number of each edge, by id."""
        return {edge: k for k, edge in enumerate(self.edges)}

    @cached_property
    def crossover(self) -> dict[str, LineCrossover]:
        """Crossovers by id."""
        return {c.id: c for c in self.crossovers}

    @cached_property
    def _crossover_on(self) -> dict[str, LineCrossover]:
        return {c.edge: c for c in self.crossovers}

    @cached_property
    def _pieces(self) -> dict[str, tuple[int, list[float]]]:
        """Per track the number of its first edge, and where its edges begin (crossovers aside)."""
        found: dict[str, tuple[int, list[float]]] = {}
        for k in range(len(self.edges) - len(self.crossovers)):
            found.setdefault(self.tracks[k], (k, []))[1].append(float(self.start_m[k]))
        return found

    def _on(self, track: str) -> tuple[int, list[float]]:
        try:
            return self._pieces[track]
        except KeyError:
            raise ValueError(f"track {track}: no such track; there are: {', '.join(self.track_ids)}") from None

    def locate(self, track: str, position_m: float) -> tuple[int, float]:
        """Edge number and lane position [m] of a place on a track; where two edges meet it is the second.

        Raises
        ------
        ValueError
            If there is no such track, or the place lies off the line.
        """
        first, starts = self._on(track)
        if not self.begin_m <= position_m <= self.end_m:
            raise ValueError(f"position {position_m:g} m: off the line, {text(self.begin_m)} to {text(self.end_m)} m")
        k = first + bisect_right(starts, position_m) - 1
        return k, position_m - float(self.start_m[k])

    def locate_all(self, track: str, position_m: Floats) -> tuple[Ints, Floats]:
        """``locate`` for many places on one track, shape (n,) each."""
        first, starts = self._on(track)
        off = ~((position_m >= self.begin_m) & (position_m <= self.end_m))
        if off.any():
            self.locate(track, float(position_m[off][0]))
        k = first + np.searchsorted(starts, position_m, side="right").astype(np.int64) - 1
        return k, position_m - self.start_m[k]

    def route(self, track: str, position_m: float) -> tuple[str, ...]:
        """Edges from a place to the end of the line, on the same track."""
        k, _ = self.locate(track, position_m)
        if k not in self._onward:
            first, starts = self._on(track)
            self._onward[k] = self.edges[k : first + len(starts)]
        return self._onward[k]

    @cached_property
    def _onward(self) -> dict[int, tuple[str, ...]]:
        """Routes that have been asked for, by their first edge: trains by the thousand start on the same few."""
        return {}

    def route_over(self, current_edge: str, crossover_id: str) -> tuple[str, ...]:
        """Edges from the current one over a crossover to the end of the line on the track it leads to.

        Raises
        ------
        ValueError
            If the edge or the crossover does not exist, the crossover leaves another track, or its switch lies behind.
        """
        if (current_edge, crossover_id) not in self._over:
            self._over[current_edge, crossover_id] = self._led_over(current_edge, crossover_id)
        return self._over[current_edge, crossover_id]

    @cached_property
    def _over(self) -> dict[tuple[str, str], tuple[str, ...]]:
        """Routes over crossovers that have been asked for."""
        return {}

    def _led_over(self, current_edge: str, crossover_id: str) -> tuple[str, ...]:
        if current_edge not in self.index:
            raise ValueError(f"edge {current_edge}: not on this line")
        if crossover_id not in self.crossover:
            raise ValueError(f"crossover {crossover_id}: no such crossover; there are: {_some(list(self.crossover))}")
        over = self.crossover[crossover_id]
        track, here = self.tracks[self.index[current_edge]], self.index[current_edge]
        if over.from_track != track:
            raise ValueError(f"crossover {crossover_id}: leaves track {over.from_track}, edge {current_edge} is on track {track}")
        end = float(self.start_m[here] + self.length_m[here])
        if over.start_m <= self.start_m[here] or (current_edge in self._crossover_on and over.start_m < end - 1e-6):
            raise ValueError(
                f"crossover {crossover_id}: its switch at {text(over.start_m)} m lies behind edge {current_edge},"
                f" which begins at {text(float(self.start_m[here]))} m"
            )
        way = [current_edge]
        if current_edge in self._crossover_on:
            here, _ = self.locate(track, round(end, 6))
        else:
            here += 1
        first, starts = self._on(track)
        switch = first + bisect_right(starts, over.start_m) - 1
        way += self.edges[here:switch]
        way.append(over.edge)
        return (*way, *self.route(over.to_track, round(over.start_m + over.length_m, 6)))

    def next_crossover(self, track: str, position_m: float, to_track: str) -> LineCrossover | None:
        """The first crossover ahead of a place that leads to another track; None if there is none."""
        self._on(to_track)
        self.locate(track, position_m)
        ahead = (c for c in self.crossovers if (c.from_track, c.to_track) == (track, to_track) and c.start_m > position_m)
        return min(ahead, key=lambda c: c.start_m, default=None)


def _some(names: list[str]) -> str:
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "") if names else "none"


def rail_edges(net: NetFile, path: str | Path) -> list[NetEdge]:
    """The rail edges of a net file, in its order. Internal edges are left out: nets built here have none."""
    normal = (e for e in net.edges if e.attributes.get("function", "normal") == "normal" and e.lanes)
    found = [e for e in normal if RAIL & set(e.lanes[0].get("allow", "").split())]
    if not found:
        raise LineError([f"{path}: has no rail edges"])
    return found


def line_of(found: list[NetEdge], file: str) -> Line:
    """The line its rail edges describe, if ``sumo_net`` built them."""
    if not any("track" in e.params for e in found):
        rule = "only nets built by sumo_net have it; others run with network.sumocfg"
        raise LineError([f"{file}: none of its {len(found)} rail edges has a 'track' parameter: {rule}"])
    mistakes, rows = [], []
    for e in found:
        name, lane = e.attributes.get("id", ""), e.lanes[0]
        try:
            start, length, speed = float(e.attributes.get("distance", 0.0)), float(lane["length"]), float(lane["speed"])
            side = float(lane["shape"].split()[0].split(",")[1])
            slopes = [(float(at), float(slope)) for at, slope in (piece.split(":") for piece in e.params.get("slope", "").split())]
            over, leaves = e.params.get("crossover"), e.params.get("from_track", "")
            rows.append((name, e.params["track"], start, length, speed, side, slopes, over, leaves))
        except KeyError as missing:
            mistakes.append(f"{file}: edge {name}: has no {missing.args[0]}: was it changed after sumo_net built it?")
        except (ValueError, IndexError) as error:
            mistakes.append(f"{file}: edge {name}: {error}")
    if mistakes:
        raise LineError(mistakes)
    pieces = [r for r in rows if r[7] is None]
    if not pieces:
        raise LineError([f"{file}: has crossovers but no tracks"])
    left = {r[1]: -r[5] for r in pieces}
    pieces.sort(key=lambda r: (left[r[1]], r[2]))
    switches = sorted((r for r in rows if r[7] is not None), key=lambda r: (r[2], r[0]))
    slope: list[tuple[float, float]] = []
    for at, value in (item for r in pieces if r[1] == pieces[0][1] for item in r[6]):
        if not slope or slope[-1][1] != value:
            slope.append((at, value))
    slope = slope or [(pieces[0][2], 0.0)]
    ordered = pieces + switches
    last = max(pieces, key=lambda r: r[2])
    return Line(
        edges=tuple(r[0] for r in ordered),
        tracks=tuple(r[1] for r in ordered),
        start_m=np.array([r[2] for r in ordered]),
        length_m=np.array([r[3] for r in ordered]),
        speed_mps=np.array([r[4] for r in ordered]),
        crossovers=tuple(LineCrossover(r[7] or "", r[8], r[1], r[2], r[3], r[4], r[0]) for r in switches),
        gradient=Gradient(np.array([at for at, _ in slope]), np.array([value for _, value in slope])),
        track_ids=tuple(dict.fromkeys(r[1] for r in pieces)),
        begin_m=pieces[0][2],
        end_m=round(last[2] + last[3], 6),
    )
