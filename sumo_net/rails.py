"""Any SUMO rail net as a graph of edges, the internal ones on its junctions among them.

``Rails.read`` takes it from a net file, ``Rails.of`` from a line of ours; of the same line both give the same. A train's way is a
row of edge numbers in which each edge is a successor of the one before, as SUMO drives it. ``start_m`` of an edge plus the lane
position grows along every way like the distance run.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from heapq import heappop, heappush
from itertools import combinations, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sumo_net.layout import Floats
from sumo_net.line import Ints, Line, line_of
from sumo_net.netfile import RAIL, NetEdge, NetFile, NetJunction, read_net
from sumo_net.spec import TRACK_SPACING_M, LineError

Bools = NDArray[np.bool_]
Pairs = set[tuple[int, int]]

_SHORTEST_LANE_M = 0.1  # SUMO makes every lane at least this long


@dataclass(frozen=True, eq=False)
class Rails:
    """A rail net as a graph. Normal edges come first, then the internal ones, which lie on junctions; E of them in all."""

    edges: tuple[str, ...]  # SUMO ids; internal ones begin with ":"
    internal: Bools  # (E,)
    length_m: Floats  # (E,) as SUMO uses it
    speed_mps: Floats  # (E,) limit
    start_m: Floats  # (E,) kilometrage of the beginning, see potential()
    slope: Floats  # (E,) mean rise over run, in the direction of the edge
    after: tuple[tuple[int, ...], ...]  # where each edge leads, in ascending order
    before: tuple[tuple[int, ...], ...]  # where each edge is entered from
    twin: Ints  # (E,) the same track in the other direction, -1 if there is none
    crossing: tuple[tuple[int, ...], ...]  # internal edges whose tracks cross or touch this one on its junction
    reversal: frozenset[tuple[int, int]]  # normal edges (from, to) between which a train changes its direction

    @classmethod
    def read(cls, path: str | Path) -> Rails:
        """The rail net in a net file.

        Parameters
        ----------
        path : str or Path
            A SUMO net file. Of its edges those are taken that are made for trains: with a rail class among the vehicles that
            are allowed. In a net that ``sumo_net`` built, order and kilometrage are those of ``Line.read``.

        Raises
        ------
        LineError
            If there is no such file, it is not a net, it has no rail edges, or it says no length or speed of one.
        """
        return _rails(read_net(Path(path)), str(path))

    @classmethod
    def of(cls, line: Line) -> Rails:
        """A line of parallel tracks as a graph, its edges in the same order: crossovers branch off and join."""
        lateral = {track: -TRACK_SPACING_M * k for k, track in enumerate(line.track_ids)}
        over = {c.edge: c for c in line.crossovers}
        leaves = [over[e].from_track if e in over else t for e, t in zip(line.edges, line.tracks, strict=True)]
        begin: dict[tuple[str, float], list[int]] = {}
        for k, track in enumerate(leaves):
            begin.setdefault((track, round(float(line.start_m[k]), 6)), []).append(k)
        end_m = line.start_m + line.length_m
        ends = ((t, round(float(at), 6)) for t, at in zip(line.tracks, end_m, strict=True))
        links = {(k, onward) for k, end in enumerate(ends) for onward in begin.get(end, ())}
        # Along the rail; so the run is shorter, and longer where a crossover goes across.
        angle, breaks = np.arctan(line.gradient.slope), line.gradient.breaks
        places = np.stack([line.start_m, end_m])
        piece = np.searchsorted(breaks, places, side="right") - 1
        x, z = (
            np.concatenate(([0.0], np.cumsum(np.diff(breaks) * part[:-1])))[piece] + (places - breaks[piece]) * part[piece]
            for part in (np.cos(angle), np.sin(angle))
        )
        across = np.array([lateral[b] - lateral[a] for a, b in zip(leaves, line.tracks, strict=True)])
        n = len(line.edges)
        return cls(
            edges=line.edges,
            internal=np.zeros(n, bool),
            length_m=line.length_m.copy(),
            speed_mps=line.speed_mps.copy(),
            start_m=line.start_m.copy(),
            slope=(z[1] - z[0]) / np.hypot(x[1] - x[0], across),
            after=_neighbours(n, links),
            before=_neighbours(n, {(b, a) for a, b in links}),
            twin=np.full(n, -1, np.int64),
            crossing=((),) * n,
            reversal=frozenset(),
        )

    @cached_property
    def index(self) -> dict[str, int]:
        """Number of each edge, by id."""
        return {edge: k for k, edge in enumerate(self.edges)}

    @cached_property
    def chains(self) -> dict[tuple[int, int], tuple[int, ...]]:
        """For every connection (from, to) of normal edges the internal edges between them; none where the net has none."""
        return dict(_chains(self.after, self.internal))

    @cached_property
    def onward(self) -> tuple[tuple[int, ...], ...]:
        """``after`` without the reversals: where each edge leads a train that keeps its direction."""
        return _onward(self.after, self.chains, self.reversal)

    def way(self, edges: Sequence[str]) -> Ints:
        """The edges a train runs over on a route, shape (W,).

        Parameters
        ----------
        edges : sequence of str
            A SUMO route: ids of normal edges, each connected to the next.

        Returns
        -------
        ndarray, shape (W,)
            Edge numbers, with the internal edges between.

        Raises
        ------
        ValueError
            If the route is empty, an edge of it is not on this net or not for trains, or two are not connected.
        """
        if not edges:
            raise ValueError("the route has no edges")
        for edge in edges:
            if edge not in self.index or self.internal[self.index[edge]]:
                raise ValueError(f"edge {edge}: not on this net, or not for trains")
        numbers = [self.index[edge] for edge in edges]
        found = numbers[:1]
        for a, b in pairwise(numbers):
            if (a, b) not in self.chains:
                raise ValueError(f"the route is not connected from edge {self.edges[a]} to edge {self.edges[b]}")
            found += (*self.chains[a, b], b)
        return np.array(found, np.int64)

    def path(self, start: int, end: int) -> Ints | None:
        """The shortest way from one edge to another without a change of direction, shape (W,), with both; None if there is none."""
        best, came, heap = {start: 0.0}, {start: -1}, [(0.0, start)]
        while heap:
            run, here = heappop(heap)
            if here == end:
                found = [end]
                while (previous := came[found[-1]]) >= 0:
                    found.append(previous)
                return np.array(found[::-1], np.int64)
            if run > best[here]:
                continue
            for there in self.onward[here]:
                further = run + float(self.length_m[there])
                if further < best.get(there, np.inf):
                    best[there], came[there] = further, here
                    heappush(heap, (further, there))
        return None


def potential(length_m: Floats, onward: Sequence[tuple[int, ...]]) -> Floats:
    """The kilometrage at which every edge begins [m], shape (E,), such that an edge begins where the one before it ends.

    Where two ways between the same places differ in length no such kilometrage exists: then it jumps at one connection of the
    loop. It is found breadth first from the first edge of every part of the net that is connected; the smallest in each is 0.
    """
    inward = _neighbours(len(onward), {(b, a) for a, row in enumerate(onward) for b in row})
    length, start = length_m.tolist(), np.full(len(onward), np.nan)
    for root in range(len(onward)):
        if not np.isnan(start[root]):
            continue
        found, seen = [root], {root: 0.0}
        for here in found:  # grows while it is run through
            at = seen[here]
            for there in onward[here]:
                if there not in seen:
                    seen[there] = at + length[here]
                    found.append(there)
            for there in inward[here]:
                if there not in seen:
                    seen[there] = at - length[there]
                    found.append(there)
        lowest = min(seen.values())
        start[found] = [seen[k] - lowest for k in found]
    return start


def _neighbours(n: int, links: Pairs) -> tuple[tuple[int, ...], ...]:
    found: list[list[int]] = [[] for _ in range(n)]
    for a, b in sorted(links):
        found[a].append(b)
    return tuple(tuple(row) for row in found)


def _chains(after: Sequence[tuple[int, ...]], internal: Bools) -> Iterator[tuple[tuple[int, int], tuple[int, ...]]]:
    inside = internal.tolist()
    for a, row in enumerate(after):
        if inside[a]:
            continue
        for first in row:
            here, chain = first, []
            while inside[here]:
                chain.append(here)
                here = after[here][0]
            yield (a, here), tuple(chain)


def _onward(
    after: tuple[tuple[int, ...], ...], chains: dict[tuple[int, int], tuple[int, ...]], reversal: frozenset[tuple[int, int]]
) -> tuple[tuple[int, ...], ...]:
    back = {link for a, b in reversal for link in pairwise((a, *chains[a, b], b))}
    return tuple(tuple(b for b in row if (a, b) not in back) for a, row in enumerate(after)) if back else after


class _Link(NamedTuple):
    """A connection of normal edges: their ids, and the internal lanes between."""

    begin: str
    end: str
    lanes: tuple[str, ...]
    reverses: bool


def _rail_lane(edge: NetEdge) -> dict[str, str] | None:
    """The first lane made for trains."""
    return next((lane for lane in edge.lanes if RAIL & set(lane.get("allow", "").split())), None)


def _edge_of(lane: str) -> str:
    return lane.rpartition("_")[0]


def _links(net: NetFile, lanes: set[str], file: str) -> list[_Link]:
    """The connections trains can take, once for each pair of edges."""
    onward = {
        f"{c['from']}_{c['fromLane']}": c["via"] for c in net.connections if c["from"].startswith(":") and c.get("via") in lanes
    }
    found: dict[tuple[str, str], _Link] = {}
    for c in net.connections:
        begin, end = c["from"], c["to"]
        if begin.startswith(":") or f"{begin}_{c['fromLane']}" not in lanes or f"{end}_{c['toLane']}" not in lanes:
            continue
        chain, via = [], c.get("via")
        while via is not None:
            if via not in lanes or via in chain:
                break
            chain.append(via)
            via = onward.get(via)
        if via is None:
            found.setdefault((begin, end), _Link(begin, end, tuple(chain), c.get("dir") == "t"))
    return list(found.values())


def _shape(lane: dict[str, str]) -> Floats:
    """Points of a lane [m], shape (P, 3), heights 0 if the net is flat."""
    points = [[float(v) for v in point.split(",")] for point in lane.get("shape", "").split()]
    return np.array([(p + [0.0])[:3] for p in points]).reshape(-1, 3)


def _slope(lane: dict[str, str]) -> float:
    shape = _shape(lane) if lane.get("shape", "").partition(" ")[0].count(",") == 2 else np.zeros((0, 3))
    run = float(np.hypot(*np.diff(shape[:, :2], axis=0).T).sum())
    return float(shape[-1, 2] - shape[0, 2]) / run if run > 0 else 0.0


def _rails(net: NetFile, file: str) -> Rails:
    lane_of = {e.attributes.get("id", ""): lane for e in net.edges if (lane := _rail_lane(e)) is not None}
    normal = [e for e in net.edges if e.attributes.get("function", "normal") == "normal" and e.attributes.get("id") in lane_of]
    if not normal:
        raise LineError([f"{file}: has no rail edges"])
    lanes = {lane["id"] for e in net.edges for lane in e.lanes if RAIL & set(lane.get("allow", "").split())}
    links = _links(net, lanes, file)
    used = {_edge_of(lane) for link in links for lane in link.lanes}
    line = line_of(normal, file) if all("track" in e.params for e in normal) and not used else None
    names = list(line.edges) if line else [e.attributes["id"] for e in normal]
    names += [name for e in net.edges if (name := e.attributes.get("id", "")) in used]
    values, mistakes = [], []
    for name in names:
        lane = lane_of[name]
        try:
            values.append((max(float(lane["length"]), _SHORTEST_LANE_M), float(lane["speed"]), _slope(lane)))
        except KeyError as missing:
            mistakes.append(f"{file}: edge {name}: has no {missing.args[0]}")
        except ValueError as error:
            mistakes.append(f"{file}: edge {name}: {error}")
    if mistakes:
        raise LineError(mistakes)
    length, speed, slope = np.array(values).T.copy()
    index = {name: k for k, name in enumerate(names)}
    internal = np.array([name.startswith(":") for name in names])
    ways = {link: tuple(index[e] for e in (link.begin, *map(_edge_of, link.lanes), link.end)) for link in links}
    pairs = {pair for way in ways.values() for pair in pairwise(way)}
    after = _neighbours(len(names), pairs)
    reversal = frozenset((way[0], way[-1]) for link, way in ways.items() if link.reverses)
    bidi = {e.attributes.get("id", ""): e.attributes.get("bidi", "") for e in net.edges}
    twin = np.array([index.get(bidi[name], -1) for name in names], np.int64)
    chains = dict(_chains(after, internal))
    return Rails(
        edges=tuple(names),
        internal=internal,
        length_m=length,
        speed_mps=speed,
        start_m=line.start_m.copy() if line else potential(length, _onward(after, chains, reversal)),
        slope=slope,
        after=after,
        before=_neighbours(len(names), {(b, a) for a, b in pairs}),
        twin=twin,
        crossing=_crossing(net.junctions, ways, lane_of, twin),
        reversal=reversal,
    )


def _crossing(
    junctions: list[NetJunction], ways: dict[_Link, tuple[int, ...]], lane_of: dict[str, dict[str, str]], twin: Ints
) -> tuple[tuple[int, ...], ...]:
    on = {lane: way for link, way in ways.items() for lane in link.lanes if not link.reverses}
    pairs: Pairs = set()
    for junction in junctions:
        rows = [on.get(lane) for lane in junction.attributes.get("intLanes", "").split()]
        foes = {int(r["index"]): r["foes"][::-1] for r in junction.requests}
        for (i, one), (j, other) in combinations([(i, way) for i, way in enumerate(rows) if way is not None], 2):
            if one[0] == other[0] or one[-1] == other[-1]:
                continue
            if twin[one[0]] == other[-1] and twin[one[-1]] == other[0]:
                continue
            foe = foes.get(i, "")[j : j + 1] == "1" or foes.get(j, "")[i : i + 1] == "1"
            if foe or twin[one[0]] == other[-1] or twin[one[-1]] == other[0]:
                pairs |= {(a, b) for a in one[1:-1] for b in other[1:-1]}
    return _neighbours(len(twin), pairs | {(b, a) for a, b in pairs})
