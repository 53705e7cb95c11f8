"""Where the routes and stops of a SUMO configuration lie on its net, and why some lie nowhere."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

from sumo_net.netfile import NetFile, for_trains, read_net
from sumo_net.rails import directions
from sumo_net.spec import LineError
from trainctl.errors import InputError
from trainctl.traffic.files import PLACES, Elements, bad_number, bad_time, is_number, is_time, seconds

#: What is said of a road net.
NO_RAIL = "has no rail edges: none of its lanes allows a rail class by name, and no route runs over one that is open to all classes"


#: How SUMO's files say yes.
YES = ("1", "true", "yes", "on", "x", "t")


class Tracks(NamedTuple):
    """What a net says of connections."""

    length: dict[str, float]  # of lanes [m]
    speed: dict[str, float]  # limit of edges, on the lane that trains take [m/s]
    onward: dict[str, set[str]]  # from each edge
    file: NetFile
    marked: bool  # it has lanes that allow a rail class by name
    twin: dict[str, str]  # the same track in the other direction, of every edge; "": none


class Place(NamedTuple):
    """Where a train stops."""

    lane: str
    position_m: float  # of its front, from the beginning of the lane
    wrong: str  # why it cannot stop there, or ""


class Area(NamedTuple):
    """A parking area."""

    lots: int  # how many trains find a place
    depth_m: float  # who finds none waits this far before


def area_of(element: Element, place: Place) -> Area:
    """Of a parking area with its end at ``place``: whose capacity is not said has none beside the spaces it lists, as in SUMO."""
    said, start = element.get("roadsideCapacity", "0"), element.get("startPos", "0")
    lots = (int(said) if said.isdecimal() else 0) + len(list(element.iter("space")))
    return Area(lots, max(place.position_m - (float(start) if is_number(start) else 0.0), 0.0))


def read_tracks(net: Path) -> Tracks:
    """Lanes and connections of a net with rail edges."""
    try:
        file = read_net(net)
    except LineError as error:
        raise InputError(error.mistakes) from None
    normal = [e for e in file.edges if e.attributes.get("function", "normal") == "normal"]
    if not any(for_trains(lane, anybody=True) for edge in normal for lane in edge.lanes):
        raise InputError(f"{net}: {NO_RAIL}")
    speed = {
        edge.attributes.get("id", ""): float(lane["speed"])
        for edge in normal
        for lane in [lane for lane in edge.lanes if for_trains(lane, anybody=True)][:1]
        if is_number(lane.get("speed", ""))
    }
    onward: dict[str, set[str]] = {edge.attributes.get("id", ""): set() for edge in file.edges}
    try:
        length = {lane["id"]: float(lane["length"]) for edge in file.edges for lane in edge.lanes}
        for c in file.connections:
            onward.setdefault(c["from"], set()).add(c["to"])
    except (KeyError, ValueError) as error:
        raise InputError(f"{net}: not a SUMO net: a lane or a connection has no {error}") from None
    return Tracks(length, speed, onward, file, any(for_trains(lane) for edge in normal for lane in edge.lanes), directions(file))


def unmarked(edges: Iterable[str], tracks: Tracks) -> list[str]:
    """Edges of routes that are no track by name, but are open to all classes."""
    lanes = {e.attributes.get("id", ""): e.lanes for e in tracks.file.edges}
    return [e for e in dict.fromkeys(edges) if not any(for_trains(lane) for lane in lanes.get(e, []))]


def restricted(routes: Iterable[tuple[str, tuple[str, ...]]], tracks: Tracks) -> list[str]:
    """Mistakes: edges of routes, each with the class of its train, whose type has a speed limit of its own for that class."""
    limits, found = tracks.file.restrictions, dict[str, None]()
    types = {e.attributes.get("id", ""): e.attributes.get("type", "") for e in tracks.file.edges} if limits else {}
    for vclass, edges in set(routes) if limits else ():
        for edge in edges:
            speed = limits.get(types[edge], {}).get(vclass)
            if speed is not None and not (is_number(speed) and float(speed) == tracks.speed.get(edge)):
                line = f"edge {edge}: its type {types[edge]} has a restriction of {vclass} to {speed} m/s: limits of one class are"
                found[f"{line} not followed; give that speed to the lanes of the edge"] = None
    return list(found)


def place_of(stop: Element, elements: Elements, tracks: Tracks) -> Place:
    """Where a stop is: at a place with a name, or on a lane or an edge."""
    for tag in PLACES:
        if (name := stop.get(tag)) is not None:
            # SUMO takes a train stop for a bus stop, and duarouter writes it so.
            if name not in elements.places:
                return Place("", 0.0, f"stop at {tag} {name}: no such {tag}")
            where = elements.places[name]
            break
    else:
        where, name = stop, ""
    lane = where.get("lane") or (f"{where.get('edge')}_0" if where.get("edge") else "")
    said = f"stop at {name}" if name else f"stop on edge {lane.rpartition('_')[0]}"
    if not lane:
        return Place(lane, 0.0, "a stop names neither a lane nor an edge nor a stopping place")
    if lane not in tracks.length:
        return Place(lane, 0.0, f"{said}: lane {lane}: not in the net")
    length = tracks.length[lane]
    # A duration below 0 is none.
    said_wrong = [] if is_time(stop.get("duration", "0")) else [f"duration = {stop.get('duration')}"]
    said_wrong += [f"until = {stop.get('until')}"] if bad_time(stop.get("until", "0")) else []
    arrival = stop.get("arrival", "0")
    said_wrong += [] if is_time(arrival) else [f"arrival = {arrival}"]
    said_wrong += [f"speed = {stop.get('speed')}"] if bad_number(stop.get("speed")) else []
    end = stop.get("endPos", where.get("endPos"))  # a train may stop short of the end of a place
    try:
        position = float(length if end is None else end)
    except ValueError:
        said_wrong.append(f"endPos = {end}")
        position = 0.0
    if said_wrong:
        return Place(lane, 0.0, f"{said}: {', '.join(said_wrong)}: must be a number, a time not negative")
    position += length if position < 0 else 0.0
    if friendly := where.get("friendlyPos", "0").lower() in YES:
        position = min(max(position, 0.0), length)
    # SUMO itself lets a stop be a bit beyond the end.
    if not 0.0 <= position <= length + 0.1:
        return Place(lane, 0.0, f"{said}: endPos = {end}: off the edge, which is {length:g} m long")
    begin = where.get("startPos", "0")
    start = float(begin) if is_number(begin) else math.nan
    if not friendly and not (start + (length if start < 0 else 0.0) <= position):
        return Place(lane, 0.0, f"{said}: startPos = {begin}: must be a number, and not behind its end at {position:g} m")
    wrong = ""
    ends = seconds(stop.get("duration", "-1")) >= 0 or stop.get("until") is not None
    triggered = any(stop.get(key, "false").lower() in YES for key in ("triggered", "containerTriggered"))
    if not name and not ends and not triggered and float(stop.get("speed", "0")) == 0:
        wrong = f"{said}: neither duration nor until"
    return Place(lane, min(position, length), wrong)


def unconnected(edges: list[str], tracks: Tracks) -> list[str]:
    """Mistakes in a route: edges that are not in the net, else those that do not follow each other there."""
    unknown = [f"edge {e}: not in the net" for e in edges if e not in tracks.onward]
    return unknown or [
        f"cannot turn back from edge {a} to edge {b}: the net has no connection there"
        if tracks.twin.get(a) == b
        else f"its route is not connected: no path from edge {a} to edge {b}"
        for a, b in pairwise(edges)
        if b not in tracks.onward[a]
    ]


def off_route(edges: tuple[str, ...], places: list[Place], firsts: list[int] | None = None) -> list[str]:
    """Stops that a train does not come to, one after the other; each on the edge of this number in ``firsts`` or a later one."""
    wrong, at, behind = [], 0, 0.0
    for place, first in zip(places, firsts or [0] * len(places), strict=True):
        edge = place.lane.rpartition("_")[0]
        start = max(at + 1 if edges[at : at + 1] == (edge,) and place.position_m < behind else at, first)
        if edge in edges[start:]:
            at, behind = edges.index(edge, start), place.position_m
        elif edge in edges:
            wrong.append(f"stop on edge {edge} at {place.position_m:g} m: lies behind the stop before")
        else:
            wrong.append(f"stop on edge {edge}: not on its route")
    return wrong
