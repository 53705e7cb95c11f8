"""Distance axes of train graphs: which trains share a corridor, how far along it they are, and what lies there by name.

On a net of any shape a position alone does not say on which branch a train is. A corridor is the way of one train over the net;
other trains are on it where they run on its edges, on the same track in the other direction, on a track that leaves it and comes
back, or on one that lies beside it in the plane, as the other track of a double line does.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

import sumo_net
from sumo_net import Line, LineError, Rails
from sumo_net.netfile import read_net
from sumo_net.shapes import shapes
from trainctl.figures import beside
from trainctl.figures.beside import BESIDE, Scale
from trainctl.runs.run import Run
from trainctl.runs.series import INSTANT, Series
from trainctl.signals import Floats

#: Corridors drawn at most.
MOST = 4
#: A stop that no train reached is drawn if it lies so near the stretch trains covered, as a share of it; else it is just named.
NEAR = 0.5
#: Junctions and crossovers named at most; beyond, only those where trains of the run part, meet or cross over.
NAMED = 12


class Place(NamedTuple):
    """What lies at a distance."""

    at_m: float
    name: str
    kind: str  # "stop", "unreached" (a stop to which no train came), "junction" or "crossover"


@dataclass(frozen=True)
class Corridor:
    """One distance axis."""

    name: str
    distance: dict[str, Floats]  # of every row of each train that is on it [m], NaN where it is elsewhere
    places: tuple[Place, ...]
    beyond: tuple[str, ...] = ()  # stops that no train came near


def line_of(run: Run) -> Line | None:
    """The line of parallel tracks of a run if it can still be read, else None."""
    place = str(run.scenario.get("network", {}).get("line", "")) if (run.folder / "scenario.toml").exists() else ""
    known = sumo_net.shipped()
    try:
        if run.net is not None:
            return Line.read(run.net)
        return Line.of(sumo_net.read_spec(known.get(place, place))) if place else None
    except (LineError, OSError):
        return None


def crossovers(run: Run, trains: Series) -> tuple[Place, ...]:
    """Crossovers of a line in the stretch that trains covered; of many only those that a train took."""
    line = line_of(run)
    if line is None:
        return ()
    position = trains.column("position_m")
    low, high = float(position.min()), float(position.max())
    found = [c for c in line.crossovers if low <= c.start_m <= high]
    if len(found) > NAMED:
        taken = set(trains.words["edge"].taken())
        found = [c for c in found if c.edge in taken]
    return tuple(Place(c.start_m, c.id, "crossover") for c in found)


def corridors(run: Run, trains: Series) -> tuple[list[Corridor], str]:
    """The corridors of a run on a net of any shape, the one with most trains first; at most ``MOST``, the rest in words.

    Parameters
    ----------
    run : Run
        The run folder; without its net there is one corridor, the kilometrage of the log.
    trains : Series
        Its trains.
    """
    edge = trains.words["edge"].each()
    position = trains.column("position_m")
    net = run.net
    try:
        rails = None if net is None else Rails.read(net, set(edge))
        pieces = () if net is None else shapes(net, set(edge))
    except (LineError, OSError):
        rails, pieces = None, ()
    if net is None or rails is None or not set(edge) <= set(rails.edges):
        return [Corridor("", {name: position[rows] for name, rows in trains.slices()}, ())], ""
    points = {rails.index[piece.edge]: piece.points for piece in pieces if piece.edge in rails.index and len(piece.points) > 1}
    visits = {name: _visits(edge[rows], rails) for name, rows in trains.slices()}
    ways = sorted({tuple(w) for v in visits.values() for w in v}, key=lambda w: (-_length(w, rails), w))
    scales: dict[tuple[int, ...], dict[int, Scale]] = {}
    for way in ways:
        if not any(_covers(known, way, rails) for known in scales.values()):
            scales[way] = _extended(way, _along(way, rails), ways, rails, points)
    number = np.array([rails.index[e] for e in edge])
    found = []
    for way, known in scales.items():
        start, per = np.full(len(rails.edges), np.nan), np.full(len(rails.edges), np.nan)
        for e, scale in known.items():
            start[e], per[e] = scale
        at = start[number] + per[number] * (position - rails.start_m[number])
        distance = {name: at[rows] for name, rows in trains.slices() if np.isfinite(at[rows]).any()}
        named = _stops(run, trains, distance)
        known_stops = {place.name for place in named}
        named += [place for place in _unreached(run, rails, start, per) if place.name not in known_stops]
        covered = np.array([v for d in distance.values() for v in (np.nanmin(d), np.nanmax(d))])
        spare = NEAR * float(np.ptp(covered))
        beyond = tuple(place.name for place in named if not covered.min() - spare <= place.at_m <= covered.max() + spare)
        named = [place for place in named if place.name not in beyond]
        ends = _ends(way, rails, [place for place in named if place.kind == "stop"], covered)
        places = tuple(sorted([*named, *_junctions(net, way, known, ways, rails)]))
        found.append(Corridor(ends, distance, places, beyond))
    found.sort(key=lambda c: -len(c.distance))
    shown = {name for corridor in found[:MOST] for name in corridor.distance}
    missing = len(trains.names) - len(shown)
    more = len(found) - MOST
    some = f", and {missing} trains with {'it' if more == 1 else 'them'}" if missing else ", whose trains stand in these"
    return found[:MOST], f"{more} more {'corridor is' if more == 1 else 'corridors are'} not shown{some}" if more > 0 else ""


def _visits(edge: Any, rails: Rails) -> list[list[int]]:
    """The ways of one train: edges in their order, those between two rows filled in; a new way where it reverses."""
    first = np.flatnonzero(np.concatenate([[True], edge[1:] != edge[:-1]]))
    numbers = [rails.index[e] for e in edge[first]]
    ways = [numbers[:1]]
    for a, b in pairwise(numbers):
        if rails.twin[a] == b or (a, b) in rails.reversal:
            ways.append([b])
            continue
        between = rails.path(a, b)
        ways[-1] += [b] if between is None else between[1:].tolist()
    return ways


def _length(way: tuple[int, ...], rails: Rails) -> float:
    return float(rails.length_m[list(way)].sum())


def _along(way: tuple[int, ...], rails: Rails) -> dict[int, Scale]:
    """Scales of the edges of a way and of their twins; it begins at the kilometrage of its first edge."""
    at = float(rails.start_m[way[0]])
    found: dict[int, Scale] = {}
    for e in way:
        found.setdefault(e, Scale(at, 1.0))
        at += float(rails.length_m[e])
        if (twin := int(rails.twin[e])) >= 0:
            found.setdefault(twin, Scale(at, -1.0))
    return found


def _extended(
    corridor: tuple[int, ...], known: dict[int, Scale], ways: list[tuple[int, ...]], rails: Rails, points: dict[int, Floats]
) -> dict[int, Scale]:
    """The same with tracks beside the corridor: stretches of other ways that leave it and come back, or lie there in the plane."""
    found: dict[int, Scale] = dict(known)
    for way in ways:
        on = [k for k, e in enumerate(way) if e in known]
        for a, b in pairwise(on):
            between = list(way[a + 1 : b])
            if not between:
                continue
            begin, per = known[way[a]]
            begin += per * float(rails.length_m[way[a]])
            passed, length = known[way[b]].start_m - begin, float(rails.length_m[between].sum())
            if not length / BESIDE <= abs(passed) <= length * BESIDE:
                continue
            for e in between:
                found.setdefault(e, Scale(begin, passed / length))
                begin += passed / length * float(rails.length_m[e])
    places = beside.Corridor(corridor, known, points, rails)
    for way in ways:
        found = beside.along(way, found, places, rails) | found
    return found


def _covers(known: dict[int, Scale], way: tuple[int, ...], rails: Rails) -> bool:
    return all(e in known for e in way if not rails.internal[e])


def _stops(run: Run, trains: Series, distance: dict[str, Floats]) -> list[Place]:
    """Where trains stopped, by name."""
    rows, time = dict(trains.slices()), trains.column("time_s")
    places: dict[str, list[float]] = {}
    for event in run.events:
        if event["kind"] in ("stop_reached", "waypoint") and event.get("train") in distance:
            train = event["train"]
            row = int(np.searchsorted(time[rows[train]], event["time_s"] - INSTANT))
            at = distance[train][min(row, len(distance[train]) - 1)]
            if np.isfinite(at):
                places.setdefault(str(event["stop"]), []).append(float(at))
    return [Place(float(np.median(at)), name, "stop") for name, at in places.items()]


def _unreached(run: Run, rails: Rails, start: Floats, per: Floats) -> list[Place]:
    """Stops on a corridor to which no train came, in the middle of their edge: no train stood there to say where."""
    if not len(run.stops):
        return []
    calls = run.stops.astype({"stop": str, "platform": str})
    found = []
    for (name, edge), rows in calls.groupby(["stop", "platform"], sort=False):
        e = rails.index.get(str(edge), -1)
        if e >= 0 and np.isfinite(start[e]) and rows["arrival_s"].isna().all():
            found.append(Place(float(start[e] + 0.5 * per[e] * rails.length_m[e]), str(name), "unreached"))
    return found


def _ends(way: tuple[int, ...], rails: Rails, stops: list[Place], reached: Floats) -> str:
    """Name of a corridor: from its first stop to its last, or its first and last edge."""
    normal = [rails.edges[e] for e in way if not rails.internal[e]] or [rails.edges[way[0]]]
    first, last = normal[0], normal[-1]
    if len(stops) > 1:
        near = 0.1 * float(np.ptp(reached))
        begin, end = min(stops), max(stops)
        first = begin.name if begin.at_m < reached.min() + near else first
        last = end.name if end.at_m > reached.max() - near else last
    return first if first == last else f"{first} to {last}"


def _junctions(net: Any, way: tuple[int, ...], known: dict[int, Scale], ways: list[tuple[int, ...]], rails: Rails) -> list[Place]:
    """Where tracks join or part on a corridor, by the name of the node."""
    to = {e.attributes.get("id", ""): e.attributes.get("to", "") for e in read_net(net).edges}
    steps = {step for w in ways for step in pairwise([e for e in w if not rails.internal[e]])}
    found: list[Place] = []
    used: list[Place] = []
    for a, b in pairwise([e for e in way if not rails.internal[e]]):
        after = {e for (x, e) in rails.chains if x == a and e != rails.twin[a]}
        before = {e for (e, x) in rails.chains if x == b and e != rails.twin[b]}
        if len(after) < 2 and len(before) < 2:
            continue
        place = Place(known[a].start_m + float(rails.length_m[a]), to[rails.edges[a]], "junction")
        found.append(place)
        if len({e for x, e in steps if x == a}) > 1 or len({e for e, x in steps if x == b}) > 1:
            used.append(place)
    return found if len(found) <= NAMED else used
