"""What SUMO is handed of the files of a configuration where its signals are obeyed, or where it drives trains of its own."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from trainctl.traffic.files import Elements, routes_of

#: Options that are ours: files, times, what is written and shown, who listens, what trains may not be done to.
_OURS = re.compile(
    r"output|log|^save-|^load-|gui|^start$|^quit-on-end$|^remote-port$|^num-clients$|^netstate|warnings$"
    r"|-files?$|^begin$|^end$|^step-|^scale|^time-to-teleport|^collision|^device\.|^default\.action-step|^precision|internal-links$"
    r"|^max-num|^sloppy-insert|^emergency-insert|^insertion-checks|^random-depart|^extrapolate|^keep-after|^lateral-|^lanechange"
)

#: Elements of additional files that signals go by, and those that trains of SUMO's own meet.
_OF_SIGNALS = ("railSignalConstraints", "tlLogic", "WAUT", "wautJunction")
_OF_TRAINS = ("variableSpeedSign", "rerouter")

#: What of a flow, a trip or a train with a route of its name is settled once it is a vehicle with a route.
_SETTLED = frozenset((
    "id", "type", "depart", "begin", "end", "period", "number", "vehsPerHour", "perHour", "probability", "route", "from", "to",
    "via", "fromJunction", "toJunction", "viaJunctions", "departEdge", "arrivalEdge", "fromTaz", "toTaz",
))  # fmt: skip


class Handed(NamedTuple):
    """What SUMO is handed."""

    options: tuple[tuple[str, str], ...]
    types: tuple[str, ...]  # vTypes of the trains that SUMO drives, as XML
    vehicles: tuple[str, ...]  # these trains, by departure
    additional: tuple[str, ...]  # constraints, signs, places to stop at
    begin_s: float  # when the simulation begins by the clock of the files
    trips: tuple[str, ...]  # what constraints call each of the n trains


class Source(NamedTuple):
    """Where it is taken from."""

    options: Mapping[str, str]
    elements: Elements
    vehicles: Mapping[str, tuple[Element, Element, tuple[str, ...]]]  # by id: as duarouter and as the file have it; its edges


def handed(source: Source, ids: Sequence[str], driven: Sequence[str], begin_s: float) -> Handed:
    """What SUMO is handed, of trains ``ids``; it drives those in ``driven``, in the order of their departures."""
    elements, own = source.elements, [source.vehicles[name] for name in driven]
    kinds = list(dict.fromkeys(made.get("type", "DEFAULT_VEHTYPE") for made, _, _ in own))
    kept = {key: value for key, value in source.options.items() if not _OURS.search(key)}
    more = [e for e in elements.others if e.tag in _OF_SIGNALS]
    if driven:
        for element in (e for e in elements.others if e.tag in _OF_TRAINS):
            meant = element.get("vTypes", "").split()
            # A rerouter of SUMO's must not lead trains of ours, which have types of their own.
            told = {"vTypes": " ".join(kind for kind in kinds if not meant or kind in meant)} if element.tag == "rerouter" else {}
            told |= {"file": str(Path(element.get("file", "")).resolve())} if element.get("file") else {}
            more.append(_like(element, element.attrib | told))
        more = [*elements.places.values(), *more]
    return Handed(
        options=tuple(kept.items()),
        types=tuple(_text(elements.types[kind]) for kind in kinds if kind in elements.types),
        vehicles=tuple(_text(_vehicle(*one)) for one in own),
        additional=tuple(_text(e) for e in more),
        begin_s=begin_s,
        trips=tuple(_trip(source.vehicles[name][1], name) for name in ids),
    )


def read_back(data: Sequence[Any]) -> Handed:
    """The same out of JSON."""
    options, types, vehicles, additional, begin_s, trips = data
    pairs = tuple((str(key), str(value)) for key, value in options)
    return Handed(pairs, tuple(types), tuple(vehicles), tuple(additional), float(begin_s), tuple(trips))


def _vehicle(made: Element, source: Element, edges: tuple[str, ...]) -> Element:
    """A train as SUMO itself would have it: as it is in its file, with the route and the stops that it comes to have."""
    said = {key: value for key, value in source.items() if key not in _SETTLED}
    vehicle = Element("vehicle", {"id": made.get("id", ""), "type": made.get("type", "DEFAULT_VEHTYPE"),
                                  "depart": made.get("depart", "0"), **said})  # fmt: skip
    vehicle.extend(e for e in source if e.tag == "param")
    vehicle.append(Element("route", {"edges": " ".join(edges)}))
    given, own = list(made.iter("stop")), list(source.iter("stop"))
    for k, stop in enumerate(given):
        told = own[k].attrib if len(own) == len(given) else {}
        vehicle.append(Element("stop", {**told, **stop.attrib}))
    return vehicle


def _trip(source: Element, name: str) -> str:
    return next((p.get("value", "") for p in source if p.tag == "param" and p.get("key") == "tripId"), name)


def trips_of_stops(source: Source, ids: Sequence[str]) -> set[str]:
    """What stops of trains ``ids`` would have them called from there on."""
    given = [source.vehicles[name][1] for name in ids]
    elements = [element for train in given for element in (train, *routes_of(train, source.elements))]
    return {stop.get("tripId", "") for element in elements for stop in element.iter("stop")} - {""}


def _like(element: Element, attributes: Mapping[str, str]) -> Element:
    other = Element(element.tag, dict(attributes))
    other.extend(element)
    return other


def _text(element: Element) -> str:
    return ElementTree.tostring(element, "unicode").strip()
