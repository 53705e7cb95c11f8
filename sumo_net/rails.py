"""Any SUMO rail net as a graph of edges, the internal ones on its junctions among them.

``Rails.read`` takes it from a net file, ``Rails.of`` from a line of ours; of the same line both give the same. A train's way is a
row of edge numbers in which each edge is a successor of the one before, as SUMO drives it. ``start_m`` of an edge plus the lane
position grows along every way like the distance run.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
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
from sumo_net.netfile import NetEdge, NetFile, NetJunction, for_trains, read_net
from sumo_net.spec import TRACK_SPACING_M, LineError

Bools = NDArray[np.bool_]
Pairs = set[tuple[int, int]]

_TOUCH_M = 1.0  # below it tracks meet; side by side they come as near as 1.6 m on the sharp curves of a junction


@dataclass(frozen=True, eq=False)
class Rails:
    """A rail net as a graph. Normal edges come first, then the internal ones, which lie on junctions; E of them in all."""

    edges: tuple[str, ...]  # SUMO ids; internal ones begin with ":"
    internal: Bools  # (E,)
    length_m: Floats  # (E,) what the net says, as SUMO does, not the length of the shape
    speed_mps: Floats  # (E,) limit
    start_m: Floats  # (E,) kilometrage of the beginning, see potential()
    slope: Floats  # (E,) mean rise over run, in the direction of the edge
    after: tuple[tuple[int, ...], ...]  # where each edge leads, in ascending order
    before: tuple[tuple[int, ...], ...]  # where each edge is entered from
    twin: Ints  # (E,) the same track in the other direction, -1 if there is none
    crossing: tuple[tuple[int, ...], ...]  # internal edges whose tracks cross or touch this one on its junction, see _crossing()
    reversal: frozenset[tuple[int, int]]  # pairs of after from an edge to its twin: there a train changes its direction

    @classmethod
    def read(cls, path: str | Path, over: Collection[str] = ()) -> Rails:
        """The rail net in a net file.

        Parameters
        ----------
        path : str or Path
            A SUMO net file. Of its edges those are taken that are made for trains: with a rail class among the vehicles that
            are allowed. In a net that ``sumo_net`` built, order and kilometrage are those of ``Line.read``.

        over : collection of str
            Edges that trains run over; they are taken too if they are open to all classes.

        Raises
        ------
        LineError
            If there is no such file, it is not a net, it has no rail edges, or it says no length or speed of one.
        """
        return _rails(read_net(Path(path)), str(path), frozenset(over))

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
        """For every connection (from, to) of normal edges the internal edges between: none on a net without, or on a reversal."""
        return dict(_chains(self.after, self.internal))

    @cached_property
    def onward(self) -> tuple[tuple[int, ...], ...]:
        """``after`` without the reversals: where each edge leads a train that keeps its direction."""
        return _onward(self.after, self.reversal)

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

    def path(self, start: int, end: int, cost: Floats | None = None, closed: Collection[int] = ()) -> Ints | None:
        """The shortest way from one edge to another without a change of direction, shape (W,), with both; None if there is none.

        ``cost`` (E,) takes the place of the lengths; no way leads over the edges that are ``closed``.
        """
        cost = self.length_m if cost is None else cost
        came, heap = {start: -1}, [(0.0, start)]
        while heap:
            run, here = heappop(heap)
            if here == end:
                found = [end]
                while (previous := came[found[-1]]) >= 0:
                    found.append(previous)
                return np.array(found[::-1], np.int64)
            for there in self.onward[here]:
                if (
                    there not in came and there not in closed
                ):  # entered first from the nearest: an edge costs the same from wherever it is entered
                    came[there] = here
                    heappush(heap, (run + float(cost[there]), there))
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


def _onward(after: tuple[tuple[int, ...], ...], reversal: frozenset[tuple[int, int]]) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(b for b in row if (a, b) not in reversal) for a, row in enumerate(after)) if reversal else after


class _Link(NamedTuple):
    """A connection of normal edges: their ids, and the internal lanes between."""

    begin: str
    end: str
    lanes: tuple[str, ...]


def _links(connections: list[dict[str, str]], lanes: dict[str, str], inside: dict[str, str], bidi: dict[str, str]) -> list[_Link]:
    """The connections between lanes over others inside junctions (id: edge) that trains can take, one for each pair of edges.

    Where a connection has a place to wait on its junction, its internal lanes are a chain. A train that reverses jumps from an
    edge to its twin (measured: SUMO 1.28 moves it over no internal edge, though the net has one).
    """
    rows = [(f"{c.get('from')}_{c.get('fromLane')}", f"{c.get('to')}_{c.get('toLane')}", c.get("via")) for c in connections]
    further = {leaves: via for leaves, _, via in rows if leaves in inside}
    found: dict[tuple[str, str], _Link] = {}
    for leaves, enters, via in rows:
        if leaves not in lanes or enters not in lanes or (lanes[leaves], lanes[enters]) in found:
            continue
        begin, end = lanes[leaves], lanes[enters]
        chain: list[str] = []
        while via is not None and via not in chain and bidi[begin] != end:
            chain.append(via)
            via = further.get(via)
        if inside.keys() >= set(chain):
            found[begin, end] = _Link(begin, end, tuple(chain))
    return list(found.values())


def directions(net: NetFile) -> dict[str, str]:
    """For every edge (id) that which is the same track in the other direction, as SUMO 1.28 pairs them; "" if there is none.

    Nets since version 1.0 say it. In older ones that say it nowhere it is an edge back between the same nodes whose lanes have
    the same shapes, point by point in reverse; of several the first.
    """
    said = {e.attributes.get("id", ""): e.attributes.get("bidi", "") for e in net.edges}
    if any(said.values()) or _newer(net.version):
        return said
    back: dict[tuple[str, str], list[NetEdge]] = {}
    normal = [e for e in net.edges if e.attributes.get("function", "normal") == "normal"]
    for e in normal:
        back.setdefault((e.attributes.get("to", ""), e.attributes.get("from", "")), []).append(e)
    for e in normal:
        others = back.get((e.attributes.get("from", ""), e.attributes.get("to", "")), ())
        same = (other.attributes.get("id", "") for other in others if _superposed(e, other))
        said[e.attributes.get("id", "")] = next(same, "")
    return said


def _newer(version: str) -> bool:
    """Whether a net's version is above 1.0, the last without ``bidi``."""
    try:
        major, minor = version.split(".")[:2]
        return (int(major), float(minor)) > (1, 0.0)
    except ValueError:
        return False


def _superposed(one: NetEdge, other: NetEdge) -> bool:
    """Whether two edges lie on each other in opposite directions: lane by lane, the outermost on the innermost."""
    try:
        pairs = [(_shape(a)[::-1], _shape(b)) for a, b in zip(one.lanes, reversed(other.lanes), strict=True)]
    except (KeyError, ValueError):  # not as many lanes; or a broken one, which is told where it matters
        return False
    return all(np.array_equal(a, b) for a, b in pairs)


def _shape(lane: dict[str, str]) -> Floats:
    """Points of a lane [m], shape (P, 3) with P >= 2; heights are 0 where the net has none."""
    points = [[float(v) for v in point.split(",")] for point in lane["shape"].split()]
    if len(points) < 2 or not all(len(p) in (2, 3) for p in points):
        raise ValueError(f"shape = {lane['shape']!r}: two points at least, x,y or x,y,z each")
    return np.array([(*p, 0.0)[:3] for p in points])


def _slope(shape: Floats) -> float:
    run = float(np.hypot(*np.diff(shape[:, :2], axis=0).T).sum())
    return float(shape[-1, 2] - shape[0, 2]) / run if run > 0 else 0.0


def _measure(lane: dict[str, str]) -> tuple[float, float, Floats]:
    """Length [m], limit [m/s] and shape of a lane."""
    length, speed = float(lane["length"]), float(lane["speed"])
    if not (0 < length < np.inf and 0 < speed < np.inf):
        raise ValueError(f"length = {length:g}, speed = {speed:g}: must be positive")
    return length, speed, _shape(lane)


def _rails(net: NetFile, file: str, over: frozenset[str]) -> Rails:
    by_id = {e.attributes.get("id", ""): e for e in net.edges}
    # What lies inside a junction is only taken between edges for trains.
    anybody = {name for name, e in by_id.items() if name in over or (over and e.attributes.get("function") == "internal")}
    open_lanes = {name: [lane for lane in e.lanes if for_trains(lane, name in anybody)] for name, e in by_id.items()}
    lane_of = {name: found[0] for name, found in open_lanes.items() if found}
    normal = [name for name in lane_of if by_id[name].attributes.get("function", "normal") == "normal"]
    if not normal:
        raise LineError([f"{file}: has no rail edges: none of its lanes allows a rail class by name"])
    within = [name for name in lane_of if by_id[name].attributes.get("function") == "internal"]
    lanes, inside = ({lane.get("id", ""): name for name in part for lane in open_lanes[name]} for part in (normal, within))
    bidi = directions(net)
    links = _links(net.connections, lanes, inside, bidi)
    uses = Counter(edge for link in links for edge in {inside[lane] for lane in link.lanes})
    if shared := [name for name in within if uses[name] > 1]:
        raise LineError([f"{file}: edge {name}: lies on {uses[name]} connections between different edges" for name in shared])
    ours = not uses and all("track" in by_id[name].params for name in normal)
    line = line_of([by_id[name] for name in normal], file) if ours else None
    names = [*(line.edges if line else normal), *(name for name in within if name in uses)]
    rows, mistakes = [], []
    for name in names:
        try:
            rows.append(_measure(lane_of[name]))
        except KeyError as missing:
            mistakes.append(f"{file}: edge {name}: has no {missing.args[0]}")
        except ValueError as error:
            mistakes.append(f"{file}: edge {name}: {error}")
    if mistakes:
        raise LineError(mistakes)
    index = {name: k for k, name in enumerate(names)}
    length = np.array([row[0] for row in rows])
    ways = [tuple(index[edge] for edge in (link.begin, *(inside[lane] for lane in link.lanes), link.end)) for link in links]
    pairs = {pair for way in ways for pair in pairwise(way)}
    after = _neighbours(len(names), pairs)
    reversal = frozenset((index[link.begin], index[link.end]) for link in links if bidi[link.begin] == link.end)
    twin = _twins(np.array([index.get(bidi[name], -1) for name in names], np.int64), ways)
    on = {lane: way for link, way in zip(links, ways, strict=True) for lane in link.lanes}
    return Rails(
        edges=tuple(names),
        internal=np.array([name in uses for name in names]),
        length_m=length,
        speed_mps=np.array([row[1] for row in rows]),
        start_m=line.start_m.copy() if line else potential(length, _onward(after, reversal)),
        slope=np.array([_slope(row[2]) for row in rows]),
        after=after,
        before=_neighbours(len(names), {(b, a) for a, b in pairs}),
        twin=twin,
        crossing=_crossing(net.junctions, on, [row[2] for row in rows], twin, file),
        reversal=reversal,
    )


def _twins(twin: Ints, ways: list[tuple[int, ...]]) -> Ints:
    """``twin`` with the internal edges that old nets do not pair: the way back over the twins of both ends is the same track."""
    back = {(way[0], way[-1]): way for way in ways}
    for way in ways:
        other = back.get((int(twin[way[-1]]), int(twin[way[0]])), ())
        if len(other) == len(way):
            for here, there in zip(way[1:-1], other[-2:0:-1], strict=True):
                if twin[here] < 0:
                    twin[here] = there
    return twin


def _crossing(
    junctions: list[NetJunction], on: dict[str, tuple[int, ...]], shapes: list[Floats], twin: Ints, file: str
) -> tuple[tuple[int, ...], ...]:
    """Which internal edges exclude each other without a common beginning or end.

    Two ways over a junction do if the net calls them foes or if their centre lines come within ``_TOUCH_M``. Either alone is not
    enough. netconvert calls tracks foes that cross, but only half of those that meet head on at a switch, none that only touch,
    and none at all on an unregulated junction; and some of its foes cross outside the internal edges.

    A track and its twin do not cross each other, nor do ways that branch or merge.
    """
    pairs: Pairs = set()
    for junction in junctions if on else ():
        lanes = [(k, on[lane]) for k, lane in enumerate(junction.attributes.get("intLanes", "").split()) if lane in on]
        try:
            foes = {int(row["index"]): row["foes"][::-1] for row in junction.requests}
        except (KeyError, ValueError):
            raise LineError([f"{file}: junction {junction.attributes.get('id', '')}: its requests cannot be read"]) from None
        for (i, one), (j, other) in combinations(lanes, 2):
            same = twin[one[0]] == other[-1] and twin[one[-1]] == other[0]
            if same or one[0] == other[0] or one[-1] == other[-1]:
                continue
            foe = foes.get(i, "")[j : j + 1] == "1" or foes.get(j, "")[i : i + 1] == "1"
            if foe or _apart(*(np.vstack([shapes[k] for k in way[1:-1]]) for way in (one, other))) < _TOUCH_M:
                pairs.update((a, b) for a in one[1:-1] for b in other[1:-1])
    return _neighbours(len(twin), pairs | {(b, a) for a, b in pairs})


def _apart(one: Floats, other: Floats) -> float:
    """The minimum distance of two polylines (P, 3) and (Q, 3) seen from above [m]; 0 where they cross."""
    a, b, c, d = one[:-1, None, :2], one[1:, None, :2], other[None, :-1, :2], other[None, 1:, :2]

    def side(begin: Floats, end: Floats, point: Floats) -> Floats:
        along, to = end - begin, point - begin
        return np.asarray(along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0])

    if ((side(a, b, c) * side(a, b, d) < 0) & (side(c, d, a) * side(c, d, b) < 0)).any():
        return 0.0

    def distance(point: Floats, begin: Floats, end: Floats) -> float:
        along, to = end - begin, point - begin
        part = np.clip((to * along).sum(-1) / np.maximum((along * along).sum(-1), 1e-12), 0.0, 1.0)
        return float(np.hypot(*np.moveaxis(to - part[..., None] * along, -1, 0)).min())

    return min(distance(a, c, d), distance(b, c, d), distance(c, a, b), distance(d, a, b))
