"""The trains of a SUMO configuration, every one of them known before the run.

``duarouter`` expands flows into trains, trips into routes, and draws from distributions. It is handed routes, stops and times
alone: it leaves out trains with a ``line`` without a word, so everything else is taken from the files and joined by id.
"""

from __future__ import annotations

import gzip
import math
import re
import subprocess
import zlib
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from pydantic import ValidationError

from sumo_net.build import program
from sumo_net.netfile import RAIL, read_net
from sumo_net.spec import LineError
from trainctl.errors import InputError
from trainctl.scenario import TrainType

#: Seconds after which duarouter is taken for stuck.
PATIENCE_S = 300.0

#: Length [m] and greatest speed [m/s] of SUMO's vehicle classes.
_CLASS = {
    "rail": (135.0, 160 / 3.6), "rail_electric": (200.0, 220 / 3.6), "rail_fast": (200.0, 330 / 3.6),
    "rail_urban": (109.5, 100 / 3.6),
    "tram": (22.0, 80 / 3.6), "subway": (109.5, 100 / 3.6), "cable_car": (5.0, 200 / 3.6),
}  # fmt: skip


class _Built(NamedTuple):
    """What SUMO's Rail model knows of a train type, tables aside."""

    length_m: float
    speed_mps: float
    mass_kg: float
    mass_factor: float
    deceleration_mps2: float


#: Train types of SUMO's Rail model; the mass of "custom" stands for no train.
_RAIL_MODEL = {
    "NGT400": _Built(200.0, 500 / 3.6, 384e3, 1.04, 0.9),
    "NGT400_16": _Built(200.0, 430 / 3.6, 384e3, 1.04, 0.9),
    "ICE1": _Built(358.0, 250 / 3.6, 876e3, 1.1, 0.5),
    "ICE3": _Built(200.0, 300 / 3.6, 420e3, 1.04, 0.5),
    "REDosto7": _Built(207.0, 160 / 3.6, 425.5e3, 1.1, 0.5),
    "RB425": _Built(67.5, 160 / 3.6, 138e3, 1.04, 1.0),
    "RB628": _Built(46.0, 120 / 3.6, 72.2e3, 1.04, 0.5),
    "Freight": _Built(512.0, 120 / 3.6, 1440e3, 1.06, 0.3),
    "MireoPlusB": _Built(46.56, 160 / 3.6, 105.5e3, 1.05, 1.1),
    "MireoPlusH": _Built(46.56, 160 / 3.6, 105.4e3, 1.05, 1.1),
    "custom": _Built(100.0, 200 / 3.6, 100e3, 1.05, 1.0),
}

#: What SUMO calls one thing: the places a train can stop at.
_PLACES = ("trainStop", "busStop", "containerStop", "parkingArea", "chargingStation", "overheadWireSegment")
_OPTIONS = {
    "n": "net-file", "net": "net-file", "r": "route-files", "routes": "route-files", "a": "additional-files",
    "additional": "additional-files", "b": "begin", "e": "end",
}  # fmt: skip
_TRAINS = ("vehicle", "trip", "flow")
_PEOPLE = {"person": "persons", "personFlow": "persons", "container": "containers", "containerFlow": "containers"}
#: What duarouter needs of a train, a route and a stop.
_ROUTED = {
    "id", "type", "depart", "begin", "end", "period", "number", "vehsPerHour", "perHour", "probability", "route", "from", "to",
    "via", "fromJunction", "toJunction", "viaJunctions",
}  # fmt: skip
_ROUTE = {"id", "edges", "probability", "repeat", "cycleTime", "refId"}
_STOP = {"lane", "edge", "startPos", "endPos", "friendlyPos", "duration", "until", *_PLACES}
#: What SUMO takes in place of a number; the first is its default.
_WORDS = {
    "departPos": ("base", "stop", "random", "free", "random_free", "last", "splitFront"),
    "departSpeed": ("max", "desired", "speedLimit", "last", "avg", "random"),
    "arrivalPos": ("max", "random", "center"),
}
#: What a stop may say that changes nothing here.
_SILENT = {"line", "tripId", "actType", "color", "name", "arrival", "started", "ended", "posLat", "index", "parking"}


#: What a vType must say to be a plant of ours, in SUMO's units: kg, kW, kN, and kN with m/s.
_CONSTANTS = ("mass", "maxPower", "maxTraction", "resCoef_constant", "resCoef_linear", "resCoef_quadratic")


class Stop(NamedTuple):
    """Where a train waits."""

    edge: str
    position_m: float  # its front, from the beginning of the edge
    duration_s: float  # at least
    until_s: float | None  # not before
    name: str  # of the train stop, or ""


class Departure(NamedTuple):
    """A train as SUMO would let it in."""

    id: str
    kind: str  # its vType
    depart_s: float
    edges: tuple[str, ...]  # its route, without internal edges
    position_m: float  # of its front on the first edge
    speed_mps: float | None  # None: as fast as allowed
    stops: tuple[Stop, ...]
    arrival_m: float | None  # where on the last edge it leaves; None: at its end
    line: str


class Kind(NamedTuple):
    """A vType."""

    id: str
    vclass: str
    length_m: float
    max_speed_mps: float
    speed_factor: float
    attributes: dict[str, str]  # all attributes and params


class Traffic(NamedTuple):
    """The trains of a configuration."""

    net: Path
    departures: tuple[Departure, ...]  # by time, then as in the files
    kinds: dict[str, Kind]
    begin_s: float
    end_s: float | None
    step_s: float
    notes: tuple[str, ...]  # what is not followed


class _Tracks(NamedTuple):
    """What a net says of connections."""

    length: dict[str, float]  # of lanes [m]
    onward: dict[str, set[str]]  # from each edge


class _Place(NamedTuple):
    lane: str
    position_m: float
    wrong: str


class _Demand(NamedTuple):
    """The files of a configuration, sorted by kind."""

    types: dict[str, Element]
    mixes: dict[str, Element]
    routes: dict[str, Element]
    drawn: dict[str, Element]  # route distributions
    trains: list[Element]
    places: dict[str, Element]
    seen: dict[str, int]  # how many persons, containers, rerouters


def read_traffic(sumocfg: Path, work: Path, end_s: float | None = None, seed: int = 42) -> Traffic:
    """What a SUMO configuration says of its trains.

    Parameters
    ----------
    sumocfg : Path
        The configuration; the files it names lie relative to its folder.
    work : Path
        Folder for what ``duarouter`` reads and writes; made if it is not there.
    end_s : float, optional
        Departures from this time on are of no interest [s]; the configuration's own end holds as well.
    seed : int
        Of all that is drawn: the same seed gives the same trains.

    Raises
    ------
    InputError
        If a file is missing or is not what it should be, or trains, routes and stops do not fit the net: one line for each.
    """
    options = _options(sumocfg)
    net, routes, more = (_files(sumocfg, options, key) for key in ("net-file", "route-files", "additional-files"))
    wrong = [f"{sumocfg}: no {key}" for key, files in (("net-file", net), ("route-files", routes)) if not files]
    wrong += [f"{sumocfg}: {path}: no such file" for path in (*net, *routes, *more) if not path.is_file()]
    times = {}
    for key, missing in (("begin", "0"), ("end", "-1"), ("step-length", "1")):
        said = options.get(key, missing)
        times[key] = _seconds(said) if _is_time(said) else math.nan
        if not (times[key] > 0 if key == "step-length" else math.isfinite(times[key])):
            wrong.append(f"{sumocfg}: {key} = {said}: must be a time{', above 0' if key == 'step-length' else ''}")
    if wrong:
        raise InputError(wrong)
    begin, own_end = times["begin"], times["end"] if times["end"] >= 0 else None
    ends = [e for e in (own_end, end_s) if e is not None]
    tracks = _tracks(net[0])
    demand = _demand([*more, *routes])
    wrong = [
        f"vType {name}: {key} = {element.get(key)}: must be a number, not negative"
        for name, element in demand.types.items()
        for key in ("length", "maxSpeed")
        if _bad(element.get(key))
    ]
    if wrong:
        raise InputError(wrong)
    kinds = {name: _kind(element) for name, element in (_defaults() | demand.types).items()}
    trains, notes = _rail(demand, kinds)
    _refuse(sumocfg, trains, demand, kinds, tracks)
    expanded = _expand(trains, demand, net[0], work, begin, min(ends) if ends else None, seed)
    order = {train.get("id", ""): k for k, train in enumerate(trains)}
    made = {vehicle.get("id", "") for vehicle in expanded}
    made |= {name.rpartition(".")[0] for name in made}
    departures = []
    wrong = [
        f"{'flow' if t.tag == 'flow' else 'train'} {t.get('id')}: duarouter makes no route of it; are all its edges for its vClass?"
        for t in trains
        if t.get("id") not in made and _comes(t, begin, min(ends, default=math.inf))
    ]
    for vehicle in expanded:
        name = vehicle.get("id", "")
        source = trains[order[name if name in order else name.rpartition(".")[0]]]
        kind = kinds[vehicle.get("type", "DEFAULT_VEHTYPE")]
        if kind.vclass not in RAIL:
            continue
        train, mistakes = _departure(vehicle, source, kind, demand, tracks)
        departures.append((order[source.get("id", "")], train))
        wrong += mistakes
    if wrong:
        raise InputError(list(dict.fromkeys(wrong)))
    if not departures:
        until = f" and before end = {min(ends):g}" if ends else ""
        raise InputError(f"{sumocfg}: no train departs at begin = {begin:g} or later{until}")
    departures.sort(key=lambda d: (d[1].depart_s, d[0]))
    used = {d.kind for _, d in departures}
    return Traffic(
        net=net[0],
        departures=tuple(d for _, d in departures),
        kinds={name: kind for name, kind in kinds.items() if name in used},
        begin_s=begin,
        end_s=own_end,
        step_s=times["step-length"],
        notes=tuple(notes),
    )


def train_type(kind: Kind) -> TrainType | list[str]:
    """Physical data of a vType with SUMO's Rail model and constants of its own; else what it lacks, one line.

    Notes
    -----
    SUMO's Rail model takes ``maxPower`` in kW, ``maxTraction`` and ``resCoef_*`` in kN with speeds in m/s, ``mass`` in kg; the
    traction is the smaller of ``maxTraction`` and ``maxPower`` over the speed, ``decel`` is braking effort over inertia. The train
    types built into SUMO are tables of speed and force, which no key of ours can hold.
    """
    said = kind.attributes
    rail, base = said.get("carFollowModel") == "Rail", said.get("trainType", "NGT400")
    built = _RAIL_MODEL.get(base, _RAIL_MODEL["custom"])
    # Any other model takes notice of the mass alone.
    value = {key: said[key] for key in _CONSTANTS if key in said and (rail or key == "mass")}
    if rail and base != "custom" and base in _RAIL_MODEL:
        value.setdefault("mass", str(built.mass_kg))
    if lacking := [f"no {key}" for key in _CONSTANTS if key not in value]:
        why = f" (SUMO has trainType {base} as tables)" if rail and base != "custom" and base in _RAIL_MODEL else ""
        return [
            f"vType {kind.id}: {', '.join(lacking)}{why}: add [train_type.{kind.id}] to the scenario, or"
            f' carFollowModel="Rail" trainType="custom" with {", ".join(_CONSTANTS)} to the vType'
        ]
    checked = {key: said[key] for key in ("massFactor", "decel") if key in said} | value
    if mistakes := [
        f"vType {kind.id}: {key} = {text}: must be a number, not negative" for key, text in checked.items() if _bad(text)
    ]:
        return mistakes
    mass, power, traction, c0, c1, c2 = (float(value[key]) for key in _CONSTANTS)
    if mass <= 0:
        return [f"vType {kind.id}: mass = {mass:g}: must be above 0"]
    factor = float(said.get("massFactor", built.mass_factor))
    try:
        return TrainType(
            unit_length_m=kind.length_m,
            unit_mass_kg=mass,
            rotating_mass_factor=factor,
            c0_n_per_kg=1e3 * c0 / mass,
            c1_ns_per_m_kg=1e3 * c1 / mass,
            c2_ns2_per_m2_kg=1e3 * c2 / mass,
            traction_n=1e3 * traction,
            traction_power_w=1e3 * power,
            braking_n=float(said.get("decel", built.deceleration_mps2)) * mass * factor,
        )
    except ValidationError as error:
        return [f"vType {kind.id}: {e['msg'].removeprefix('Value error, ')}" for e in error.errors()]


def _bad(text: str | None) -> bool:
    """Whether a text is no number, or a negative one."""
    try:
        return text is not None and not 0.0 <= float(text) < math.inf
    except ValueError:
        return True


def _seconds(text: str) -> float:
    """A time as SUMO writes it: seconds, or [days:]hours:minutes:seconds."""
    value = 0.0
    for part, base in zip(text.split(":"), (1.0, *((24.0,) if text.count(":") == 3 else ()), 60.0, 60.0), strict=False):
        value = value * base + float(part)
    return value


def _departs(train: Element, begin: float) -> float:
    depart = train.get("depart", "begin")
    return begin if depart == "begin" else _seconds(depart)


def _comes(train: Element, begin: float, end: float) -> bool:
    """Whether a train, or one of a flow, must depart between these times; of a flow that is drawn nobody can tell."""
    if train.tag != "flow":
        return begin <= _departs(train, begin) < end
    sure = train.get("number", "1") != "0" and "probability" not in train.attrib
    return sure and begin <= _seconds(train.get("begin", "0")) < min(end, _seconds(train.get("end", "inf")))


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _is_time(text: str) -> bool:
    try:
        return math.isfinite(_seconds(text))
    except ValueError:
        return False


def _bad_time(text: str) -> bool:
    return not _is_time(text) or _seconds(text) < 0


def _parse(path: Path) -> Element:
    try:
        content = path.read_bytes()
        content = gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content
        if b"<!DOCTYPE" in content:
            raise InputError(f"{path}: declares a document type, which a SUMO file does not")
        return ElementTree.fromstring(content)
    except gzip.BadGzipFile as error:
        raise InputError(f"{path}: not XML: {error}") from None
    except OSError as error:
        raise InputError(f"{path}: {'no such file' if isinstance(error, FileNotFoundError) else error.strerror}") from None
    except (ElementTree.ParseError, EOFError, LookupError, ValueError, zlib.error) as error:
        raise InputError(f"{path}: not XML: {error}") from None


def _options(sumocfg: Path) -> dict[str, str]:
    root = _parse(sumocfg)
    if root.tag not in ("configuration", "sumoConfiguration"):
        raise InputError(f"{sumocfg}: not a SUMO configuration: it begins with <{root.tag}>, not <sumoConfiguration>")
    said = {e.tag: value for e in root.iter() if (value := e.get("value", e.get("v"))) is not None}
    return {_OPTIONS.get(key, key): value for key, value in said.items()}


def _files(sumocfg: Path, options: dict[str, str], key: str) -> list[Path]:
    return [sumocfg.parent / name.strip() for name in re.split(r"[,;]", options.get(key, "")) if name.strip()]


def _tracks(net: Path) -> _Tracks:
    try:
        file = read_net(net)
    except LineError as error:
        raise InputError(error.mistakes) from None
    if not any(not RAIL.isdisjoint(lane.get("allow", "").split()) for edge in file.edges for lane in edge.lanes):
        raise InputError(f"{net}: has no rail edges: none of its lanes allows a rail class by name")
    onward: dict[str, set[str]] = {edge.attributes.get("id", ""): set() for edge in file.edges}
    try:
        length = {lane["id"]: float(lane["length"]) for edge in file.edges for lane in edge.lanes}
        for c in file.connections:
            onward.setdefault(c["from"], set()).add(c["to"])
    except (KeyError, ValueError) as error:
        raise InputError(f"{net}: not a SUMO net: a lane or a connection has no {error}") from None
    return _Tracks(length, onward)


def _elements(path: Path, within: tuple[Path, ...] = ()) -> Iterator[Element]:
    """What a file says at its top, with the files it includes."""
    if path.resolve() in within:
        raise InputError(f"{path}: includes itself")
    for element in _parse(path):
        if element.tag == "include":
            yield from _elements(path.parent / element.get("href", ""), (*within, path.resolve()))
        else:
            yield element


def _demand(files: list[Path]) -> _Demand:
    d = _Demand({}, {}, {}, {}, [], {}, {})
    named = {"vType": d.types, "vTypeDistribution": d.mixes, "route": d.routes, "routeDistribution": d.drawn}
    wrong = []
    for path in files:
        for element in _elements(path):
            tag = element.tag
            if tag in _TRAINS:
                d.trains.append(element)
            elif tag in named or tag in _PLACES:
                # The members of a distribution have a name of their own.
                members = [e for e in element if tag in ("vTypeDistribution", "routeDistribution") and not e.get("refId")]
                for e in (element, *members):
                    table, name = named.get(e.tag, d.places), e.get("id", "")
                    wrong += [f"{path}: {e.tag} {name}: there are several of this id"] if name in table else []
                    if name:
                        table[name] = e
                    elif e is element:
                        wrong.append(f"{path}: a {tag} has no id")
            elif tag in _PEOPLE or tag == "rerouter":
                d.seen[tag] = d.seen.get(tag, 0) + 1
    if wrong:
        raise InputError(list(dict.fromkeys(wrong)))
    return d


def _kind(element: Element) -> Kind:
    said = dict(element.attrib) | {p.get("key", ""): p.get("value", "") for p in element.iter("param")}
    for child in element:  # the old way: <carFollowing-Rail trainType="..."/>
        if child.tag.startswith("carFollowing-"):
            said |= {"carFollowModel": child.tag.partition("-")[2], **child.attrib}
    vclass = said.get("vClass", "passenger")
    length, speed = _CLASS.get(vclass, (5.0, 200 / 3.6))
    if said.get("carFollowModel") == "Rail" and (built := _RAIL_MODEL.get(said.get("trainType", "NGT400"))) is not None:
        length, speed = built.length_m, built.speed_mps
    # A distribution, norm(mean, deviation) or normc(mean, ...): its mean.
    factor = re.search(r"[-+.\d][-+.\deE]*", said.get("speedFactor", "1"))
    return Kind(
        id=said.get("id", ""),
        vclass=vclass,
        length_m=float(said.get("length", length)),
        max_speed_mps=float(said.get("maxSpeed", speed)),
        speed_factor=float(factor[0]) if factor else 1.0,
        attributes=said,
    )


def _defaults() -> dict[str, Element]:
    """The vTypes SUMO has of its own that a train may be of."""
    return {"DEFAULT_VEHTYPE": Element("vType", id="DEFAULT_VEHTYPE"),
            "DEFAULT_RAILTYPE": Element("vType", id="DEFAULT_RAILTYPE", vClass="rail")}  # fmt: skip


def _members(mix: Element) -> list[str]:
    return [e.get("id", e.get("refId", "")) for e in mix if e.tag == "vType"] + mix.get("vTypes", "").split()


def _rail(demand: _Demand, kinds: dict[str, Kind]) -> tuple[list[Element], list[str]]:
    """The trains among the vehicles, and what is left out."""
    trains, others = [], 0
    for train in demand.trains:
        name = train.get("type", "DEFAULT_VEHTYPE")
        types = _members(demand.mixes[name]) if name in demand.mixes else [name]
        # A type that does not exist is a mistake, told later.
        rail = [t for t in types if t not in kinds or kinds[t].vclass in RAIL]
        trains += [train] * bool(rail)
        others += not rail
    counts = {word: sum(n for tag, n in demand.seen.items() if _PEOPLE.get(tag) == word) for word in ("persons", "containers")}
    notes = [f"{n} definitions of {word} left out" for word, n in counts.items() if n]
    notes += [f"{others} vehicles, trips and flows left out: not rail"] if others else []
    notes += [f"{demand.seen['rerouter']} rerouters not followed"] if demand.seen.get("rerouter") else []
    places = {t.get("departPos", "") for t in trains} & {"random", "free", "random_free", "last", "splitFront"}
    notes += [
        f'departPos="{p}": the train begins with its rear at the beginning of the edge, as with "base"' for p in sorted(places)
    ]
    speeds = {t.get("departSpeed", "") for t in trains} & {"random", "last", "avg"}
    notes += [f'departSpeed="{s}": as fast as allowed' for s in sorted(speeds)]
    if any(t.get("arrivalPos") == "random" for t in trains):
        notes.append('arrivalPos="random": at the end of the edge')
    if n := sum(t.get("arrivalSpeed") is not None for t in trains):
        notes.append(f"{n} trains, trips and flows with an arrivalSpeed: it is not followed")
    if n := sum(t.get("speedFactor") is not None for t in trains):
        notes.append(f"{n} trains, trips and flows with a speedFactor of their own: that of the vType holds")
    routed = {t.get("route", "") for t in trains}
    stops = [s for t in trains for s in t.iter("stop")] + [
        s for r in routed & set(demand.routes) for s in demand.routes[r].iter("stop")
    ]
    for key in sorted({key for s in stops for key, value in s.items() if value not in ("0", "false")} - _STOP - _SILENT):
        notes.append(f"{key} of stops is not followed")
    drawn = {t.get("type", "") for t in trains}
    drawn |= {member for name in drawn & set(demand.mixes) for member in _members(demand.mixes[name])}
    for name in sorted(drawn & set(kinds)):
        if "(" in (text := kinds[name].attributes.get("speedFactor", "")):
            notes.append(f"vType {name}: speedFactor = {text}: its mean {kinds[name].speed_factor:g} for every train")
    return trains, notes


def _routes(train: Element, demand: _Demand) -> list[Element]:
    """The routes a train is given, none for a trip."""
    own = [r for r in train.iter("route") if r.get("edges")]
    name = train.get("route", "")
    mix = demand.drawn.get(name) if name else train.find("routeDistribution")
    if mix is not None:
        own = [r for r in mix if r.get("edges")]
        own += [
            demand.routes[n] for n in (*mix.get("routes", "").split(), *(r.get("refId", "") for r in mix)) if n in demand.routes
        ]
    return own or ([demand.routes[name]] if name in demand.routes else [])


def _refuse(sumocfg: Path, trains: list[Element], demand: _Demand, kinds: dict[str, Kind], tracks: _Tracks) -> None:
    if not trains:
        raise InputError(f"{sumocfg}: no trains: no vehicle, trip or flow has a vType of a rail class ({', '.join(sorted(RAIL))})")
    wrong = []
    seen = Counter(train.get("id", "") for train in trains)
    for train in trains:
        who = f"{'flow' if train.tag == 'flow' else 'train'} {train.get('id', '')}"
        name = train.get("type", "DEFAULT_VEHTYPE")
        types = _members(demand.mixes[name]) if name in demand.mixes else [name]
        wrong += [f"{who}: type = {t}: no such vType" for t in types if t not in kinds]
        if seen[train.get("id", "")] > 1:
            wrong.append(f"{who}: there are several of this id")
        depart = train.get("depart", train.get("begin", "0"))
        if depart != "begin" and not _is_time(depart):
            wrong.append(f"{who}: depart = {depart}: must be a time; what a train is to wait for is not known before the run")
        routes = _routes(train, demand)
        if train.get("route") and not routes:
            wrong.append(f"{who}: route = {train.get('route')}: no such route")
        ends = [*train.get("from", "").split(), *train.get("via", "").split(), *train.get("to", "").split()]
        wrong += [f"{who}: edge {e}: not in the net" for e in ends if e not in tracks.onward]
        wrong += [f"{who}: {m}" for s in train.iter("stop") if (m := _place(s, demand, tracks).wrong)]
        for route in routes:
            wrong += [f"{who}: {m}" for m in _unconnected(route.get("edges", "").split(), tracks)]
            stops = [*route.iter("stop"), *(s for s in train if s.tag == "stop")]
            places = [_place(s, demand, tracks) for s in stops]
            wrong += [f"{who}: {p.wrong}" for p in places if p.wrong]
            if not route.get("repeat") and not any(p.wrong for p in places):
                wrong += [f"{who}: {m}" for m in _off_route(tuple(route.get("edges", "").split()), places)]
    if wrong:
        raise InputError(list(dict.fromkeys(wrong)))


def _unconnected(edges: list[str], tracks: _Tracks) -> list[str]:
    unknown = [f"edge {e}: not in the net" for e in edges if e not in tracks.onward]
    return unknown or [
        f"its route is not connected: no way from edge {a} to edge {b}" for a, b in pairwise(edges) if b not in tracks.onward[a]
    ]


def _place(stop: Element, demand: _Demand, tracks: _Tracks) -> _Place:
    """Where a stop is; ``wrong`` says why it is nowhere."""
    for tag in _PLACES:
        if (name := stop.get(tag)) is not None:
            # SUMO takes a train stop for a bus stop, and duarouter writes it so.
            if name not in demand.places:
                return _Place("", 0.0, f"stop at {tag} {name}: no such {tag}")
            where = demand.places[name]
            break
    else:
        where, name = stop, ""
    lane = where.get("lane") or (f"{where.get('edge')}_0" if where.get("edge") else "")
    said = f"stop at {name}" if name else f"stop on edge {lane.rpartition('_')[0]}"
    if not lane:
        return _Place(lane, 0.0, "a stop has neither a lane nor an edge nor a place to stop at")
    if lane not in tracks.length:
        return _Place(lane, 0.0, f"{said}: lane {lane}: not in the net")
    length = tracks.length[lane]
    said_wrong = [f"{key} = {stop.get(key)}" for key in ("duration", "until") if _bad_time(stop.get(key, "0"))]
    try:
        position = float(where.get("endPos", length))
    except ValueError:
        said_wrong.append(f"endPos = {where.get('endPos')}")
        position = 0.0
    if said_wrong:
        return _Place(lane, 0.0, f"{said}: {', '.join(said_wrong)}: must be a number, a time not negative")
    position += length if position < 0 else 0.0
    if where.get("friendlyPos", "0").lower() in ("1", "true", "yes", "on", "x", "t"):
        position = min(max(position, 0.0), length)
    # SUMO itself lets a stop be a bit beyond the end.
    if not 0.0 <= position <= length + 0.1:
        return _Place(lane, 0.0, f"{said}: endPos = {where.get('endPos')}: off the edge, which is {length:g} m long")
    wrong = ""
    if not name and stop.get("duration") is None and stop.get("until") is None:
        wrong = f"{said}: neither duration nor until"
    return _Place(lane, min(position, length), wrong)


def _off_route(edges: tuple[str, ...], places: list[_Place]) -> list[str]:
    """Stops that a train does not come to, one after the other."""
    wrong, at, behind = [], 0, 0.0
    for place in places:
        edge = place.lane.rpartition("_")[0]
        start = at + 1 if edges[at : at + 1] == (edge,) and place.position_m < behind else at
        if edge in edges[start:]:
            at, behind = edges.index(edge, start), place.position_m
        elif edge in edges:
            wrong.append(f"stop on edge {edge} at {place.position_m:g} m: lies behind the stop before")
        else:
            wrong.append(f"stop on edge {edge}: not on its route")
    return wrong


def _bare(element: Element, keys: set[str]) -> Element:
    return Element(element.tag, {key: value for key, value in element.items() if key in keys})


def _expand(
    trains: list[Element], demand: _Demand, net: Path, work: Path, begin: float, end: float | None, seed: int
) -> list[Element]:
    """The vehicles duarouter makes of the trains."""
    work.mkdir(parents=True, exist_ok=True)
    more, routes = Element("additional"), Element("routes")
    more.extend(demand.places.values())
    named = {id(t) for mix in demand.mixes.values() for t in mix}
    more.extend(t for t in demand.types.values() if id(t) not in named)
    more.extend(demand.mixes.values())
    drawn = {id(r) for mix in demand.drawn.values() for r in mix}
    routes.extend(_route(r) for r in demand.routes.values() if id(r) not in drawn)
    for mix in demand.drawn.values():
        routes.append(_mix(mix))
    for train in trains:
        # duarouter ends with an error at a flow that begins too late for it.
        if train.tag == "flow" and end is not None and "end" not in train.attrib and _seconds(train.get("begin", "0")) >= end:
            continue
        bare = _bare(train, _ROUTED)
        for child in train:
            if child.tag == "stop":
                bare.append(_bare(child, _STOP))
            elif child.tag == "route":
                bare.append(_route(child))
            elif child.tag == "routeDistribution":
                bare.append(_mix(child))
        routes.append(bare)
    for name, element in (("stops.add.xml", more), ("demand.rou.xml", routes)):
        ElementTree.ElementTree(element).write(work / name, encoding="utf-8")
    options = {
        "net-file": str(net.resolve()), "additional-files": "stops.add.xml", "route-files": "demand.rou.xml",
        "output-file": "trains.rou.xml",
        "begin": f"{begin:.3f}", "seed": str(seed), "precision": "9", "xml-validation": "never", "no-step-log": "true",
        "unsorted-input": "true", "ignore-errors": "true",
        "skip-new-routes": "true",  # otherwise it draws between the route a train is given and a shorter one
    }  # fmt: skip
    if any(key.endswith(("Junction", "Junctions")) for train in trains for key in train.keys()):  # noqa: SIM118
        options["junction-taz"] = "true"
    if end is not None:
        options["end"] = f"{end:.3f}"
    made = work / "trains.rou.xml"
    made.unlink(missing_ok=True)
    try:
        duarouter, environment = program("duarouter")
        command = [str(duarouter), *(word for key, value in options.items() for word in (f"--{key}", value))]
        done = subprocess.run(command, cwd=work, env=environment, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    except LineError as error:
        raise InputError(error.mistakes) from None
    except subprocess.TimeoutExpired:
        raise InputError(f"duarouter: no end after {PATIENCE_S:g} s; does a flow have no end?") from None
    wrong = _told(done.stderr, {train.get("id", ""): train.tag for train in trains})
    if wrong:
        raise InputError(wrong)
    if done.returncode != 0 or not made.exists():
        if "No route input" in done.stderr:
            return []
        raise InputError(
            [f"duarouter: {line}" for line in done.stderr.splitlines() if line.startswith("Error")] or ["duarouter failed"]
        )
    return [e for e in _parse(made) if e.tag == "vehicle"]


def _route(route: Element) -> Element:
    bare = _bare(route, _ROUTE)
    bare.extend(_bare(s, _STOP) for s in route.iter("stop"))
    return bare


def _mix(mix: Element) -> Element:
    bare = _bare(mix, {"id", "routes", "probabilities", "last"})
    bare.extend(_route(r) for r in mix.iter("route"))
    return bare


def _told(words: str, tags: dict[str, str]) -> list[str]:
    """Mistakes in what duarouter says, by train: the first line of several about one says the most."""
    patterns = (
        (r"Mandatory edge '(.*)' not reachable by vehicle '(.*)'\.", "edge {0} cannot be reached"),
        (r"Vehicle '(.*)' is not allowed to (.*)\.", "is not allowed to {0}"),
        (r"The route for vehicle '(.*)' has no edges", "no route"),
        (r"The route of the vehicle '(.*)' is not known", "no route"),
        (r"The vehicle '(.*)' has no valid route", "no route"),
    )
    wrong: dict[str, str] = {}
    gap = ""
    for line in words.splitlines():
        _, _, said = line.partition(": ")
        if found := re.match(r"No connection between edge '(.*)' and edge '(.*)' found", said):
            gap = f"no way from edge {found[1]} to edge {found[2]}"
            continue
        for pattern, meaning in patterns:
            if found := re.match(pattern, said):
                name, *rest = found.groups() if not pattern.startswith("Mandatory") else found.groups()[::-1]
                name = name if name in tags else name.rpartition(".")[0]
                who = f"{'flow' if tags.get(name) == 'flow' else 'train'} {name}"
                wrong.setdefault(who, f"{who}: {gap or meaning.format(*(r.replace(chr(39), '') for r in rest))}")
                gap = ""
                break
        else:
            follows = said.startswith(("No route input", "Loading of", "Invalid parsing", "vehicle cannot be created"))
            if line.startswith("Error") and not follows:
                wrong.setdefault(said, f"duarouter: {said}")
    return list(wrong.values())


def _departure(vehicle: Element, source: Element, kind: Kind, demand: _Demand, tracks: _Tracks) -> tuple[Departure, list[str]]:
    """A train out of what duarouter wrote and what the file said, and the mistakes in it."""
    name, route = vehicle.get("id", ""), vehicle.find("route")
    edges = () if route is None else tuple(route.get("edges", "").split())
    places = [_place(stop, demand, tracks) for stop in vehicle.iter("stop")]
    wrong = [f"train {name}: {m}" for m in (*_unconnected(list(edges), tracks), *_off_route(edges, places))]
    stops = [
        Stop(
            edge=place.lane.rpartition("_")[0],
            position_m=place.position_m,
            duration_s=max(_seconds(stop.get("duration", "0")), 0.0),
            until_s=_seconds(stop.get("until", "")) if stop.get("until") else None,
            name=next((stop.get(tag, "") for tag in _PLACES if stop.get(tag)), ""),
        )
        for stop, place in zip(vehicle.iter("stop"), places, strict=True)
    ]
    departure = Departure(
        id=name,
        kind=kind.id,
        depart_s=_seconds(vehicle.get("depart", "0")),
        edges=edges,
        position_m=0.0,
        speed_mps=None,
        stops=tuple(stops),
        arrival_m=None,
        line=source.get("line", ""),
    )
    if wrong:
        return departure, wrong
    first, last = (tracks.length[f"{e}_0"] for e in (edges[0], edges[-1]))
    wrong = [
        f"train {name}: {key} = {source.get(key)}: must be a number or one of {', '.join(known)}"
        for key, known in _WORDS.items()
        if source.get(key, known[0]) not in known and not _is_number(source.get(key, ""))
    ]
    if source.get("departSpeed", "0").startswith("-"):
        wrong.append(f"train {name}: departSpeed = {source.get('departSpeed')}: must not be negative")
    if wrong:
        return departure, wrong
    position = _depart_position(source.get("departPos", "base"), kind.length_m, first, departure)
    arrival = source.get("arrivalPos", "max")
    arrival_m = last / 2 if arrival == "center" else None
    if _is_number(arrival):
        arrival_m = min(max(float(arrival) + (last if float(arrival) < 0 else 0.0), 0.0), last)  # as in SUMO
    # Without a word of it SUMO lets a train begin as fast as it may (measured; its documentation says 0).
    speed = source.get("departSpeed", "max")
    speed_mps = float(speed) if _is_number(speed) else None
    if not 0.0 <= position <= first:
        wrong.append(f"train {name}: departPos = {source.get('departPos')}: off edge {edges[0]}, which is {first:g} m long")
    if stops and stops[0].edge == edges[0] and position >= stops[0].position_m:
        speed_mps = 0.0
    return departure._replace(position_m=position, arrival_m=arrival_m, speed_mps=speed_mps), wrong


def _depart_position(said: str, length: float, first: float, departure: Departure) -> float:
    """Front of the train on its first edge [m]."""
    stop = departure.stops[0] if departure.stops and departure.stops[0].edge == departure.edges[0] else None
    if said == "stop" and stop is not None:
        return stop.position_m
    if said in _WORDS["departPos"]:
        # SUMO puts the rear a bit behind the beginning of the edge, but no farther than the first stop.
        base = min(length + 0.1, first)
        return base if stop is None else min(base, stop.position_m)
    position = float(said)
    return position + first if position < 0 else position
