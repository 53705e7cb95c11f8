"""Rerouters of a SUMO configuration that draw a route or a destination for every train that comes by."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

from trainctl.traffic.files import bad_number, is_time, parse, seconds
from trainctl.traffic.places import YES, Tracks, unconnected

#: A train keeps its way.
KEEPS = ("keepDestination", "keepRoute")


class Choice(NamedTuple):
    """What trains that come over certain edges draw from, from then to then."""

    at: tuple[str, ...]
    begin: float  # s
    end: float  # s
    probability: float  # with which a train draws at all
    types: tuple[str, ...]  # vTypes it is meant for; (): all
    ways: tuple[tuple[str, ...], ...]  # routes; or, of one edge, destinations; () keeps the way
    weights: tuple[float, ...]


def choices(elements: list[Element], routes: Mapping[str, Element], tracks: Tracks) -> tuple[list[Choice], list[str], list[str]]:
    """What rerouters let trains draw from, what is said of that, and the mistakes in it; ``routes`` are those of the files.

    As in SUMO the routes of an interval come before its destinations. What is wrong with the rerouters themselves is told by
    ``closings``.
    """
    found, notes, wrong = list[Choice](), list[str](), list[str]()
    for rerouter in (e for e in elements if e.tag == "rerouter" and e.get("off", "false").lower() not in YES):
        who, chance = f"rerouter {rerouter.get('id', '')}", rerouter.get("probability", "1")
        source = parse(Path(rerouter.get("file", ""))) if rerouter.get("file") else rerouter
        for interval in source.iter("interval"):
            times = [interval.get("begin", "0"), interval.get("end", "1e9")]
            for tag in ("routeProbReroute", "destProbReroute"):
                ways, weights = list[tuple[str, ...]](), list[float]()
                for child in interval.iter(tag):
                    name, weight = child.get("id", ""), child.get("probability", "1")
                    edges: tuple[str, ...] = () if name in KEEPS else (name,)
                    if tag == "routeProbReroute" and edges:
                        wrong += [] if name in routes else [f"{who}: {tag} {name}: no such route"]
                        edges = tuple(routes[name].get("edges", "").split()) if name in routes else ()
                    if name == "terminateRoute":
                        wrong.append(f"{who}: {tag} {name}: no train ends at a rerouter; end its route there, or take this out")
                        continue
                    wrong += [f"{who}: {tag} {name}: {line}" for line in unconnected(list(edges), tracks)]
                    wrong += (
                        [f"{who}: {tag} {name}: probability = {weight}: must be a number, not negative"]
                        if bad_number(weight)
                        else []
                    )
                    ways.append(edges)
                    weights.append(0.0 if bad_number(weight) else float(weight))
                if not ways or wrong or bad_number(chance) or not all(map(is_time, times)):
                    continue
                if sum(w > 0.0 for w in weights) > 1:
                    notes.append(f"{who}: <{tag}>: drawn here, with random numbers other than SUMO's")
                if sum(weights) > 0.0:
                    at, types = tuple(rerouter.get("edges", "").split()), tuple(rerouter.get("vTypes", "").split())
                    begin, end = map(seconds, times)
                    found.append(Choice(at, begin, end, float(chance), types, tuple(ways), tuple(weights)))
                    break
    return found, list(dict.fromkeys(notes)), wrong
