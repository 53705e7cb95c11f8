"""The trains of a SUMO configuration, every one of them known before the run.

``duarouter`` expands flows into trains, trips into routes, and draws from distributions. What it is not handed is taken from the
files and joined by id.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from sumo_net.netfile import RAIL
from trainctl import draws
from trainctl.errors import InputError
from trainctl.traffic import crossings
from trainctl.traffic.checks import of_files, rail_trains, refuse
from trainctl.traffic.choices import Choice, choices
from trainctl.traffic.closings import Closing, closings
from trainctl.traffic.duarouter import ROUTING, expand
from trainctl.traffic.files import (
    PLACES,
    Elements,
    bad_number,
    by_name,
    is_number,
    is_time,
    named_files,
    read_demand,
    read_options,
    routes_of,
    seconds,
)
from trainctl.traffic.handed import Source
from trainctl.traffic.kinds import Kind, default_types, kind_of
from trainctl.traffic.known import strange
from trainctl.traffic.places import (
    YES,
    Area,
    Place,
    Tracks,
    area_of,
    off_route,
    place_of,
    read_tracks,
    restricted,
    unconnected,
    unmarked,
)
from trainctl.traffic.rail_signals import Signal, rail_signals
from trainctl.traffic.scale import scaled
from trainctl.traffic.speed_signs import Change, speed_signs
from trainctl.traffic.trial import in_doubt, options_of_sumo, tried

#: What SUMO takes in place of a number; the first is its default.
_WORDS = {
    "departPos": ("base", "stop", "random", "free", "random_free", "last", "splitFront"),
    "departSpeed": ("max", "desired", "speedLimit", "last", "avg", "random"),
    "arrivalPos": ("max", "random", "center"),
}

#: What may be drawn of a train, each by its number here.
_DRAWN = ("departEdge", "arrivalEdge", "departPos", "departSpeed", "arrivalPos")

#: How long a flow lasts of which nothing is said [s].
DAY_S = 86400.0

#: How fast a train begins of which nothing is said: SUMO's own default since 1.27.
DEPART_SPEED = "avg"


class StopElement(NamedTuple):
    """Where a train waits."""

    edge: str
    position_m: float  # its front, from the beginning of the edge
    duration_s: float  # at least
    until_s: float | None  # not before
    name: str  # of the train stop, its id if it has none, or ""
    first: int  # number in the route of the earliest edge it may be on
    pass_mps: float  # it does not stand, but passes with at most this speed; 0: it stands
    parks: bool  # it leaves the track meanwhile
    area: Area | None  # where others park too
    arrival_s: float | None  # planned


class Departure(NamedTuple):
    """A train as SUMO would let it in."""

    id: str
    kind: str  # its vType
    depart_s: float
    edges: tuple[str, ...]  # its route, without internal edges
    position_m: float  # of its front on the first edge
    speed_mps: float | None  # None: as fast as allowed
    like: str  # "avg": as the trains on its edge on average, "last": as the last of them, and at most as allowed; else ""
    stops: tuple[StopElement, ...]
    arrival_m: float | None  # where on the last edge it leaves; None: at its end
    line: str


class Configuration(NamedTuple):
    """The trains of a configuration."""

    net: Path
    departures: tuple[Departure, ...]  # by time, then as in the files
    kinds: dict[str, Kind]
    begin_s: float
    end_s: float | None
    step_s: float
    patience_s: float  # after this time trains that could not enter do not come any more; inf: they always do
    followed: tuple[str, ...]  # what is; signals and what belongs to them are left out
    notes: tuple[str, ...]  # what is not followed
    signs: tuple[Change, ...]  # variable speed signs
    closings: tuple[Closing, ...]
    choices: tuple[Choice, ...]
    drawn: tuple[str, ...]  # flows whose departures are drawn
    signals: tuple[Signal, ...]  # rail signals of the net, by the tracks that they guard
    junctions: int  # so many of its junctions have some
    source: Source  # what SUMO may be handed of the files


def read_traffic(sumocfg: Path, work: Path, duration_s: float | None = None, seed: int = 42) -> Configuration:
    """What a SUMO configuration says of its trains.

    Parameters
    ----------
    sumocfg : Path
        The configuration; the files it names lie relative to its folder.
    work : Path
        Folder for what ``duarouter`` reads and writes; made if it is not there.
    duration_s : float, optional
        Departures this long after the configuration's begin, or later, are of no interest [s]; its own end holds as well.
    seed : int
        Of all that is drawn: the same seed gives the same trains.

    Raises
    ------
    InputError
        If a file is missing or is not what it should be, or trains, routes and stops do not fit the net: one line for each.
    """
    options = read_options(sumocfg)
    net, routes, more = (named_files(sumocfg, options, key) for key in ("net-file", "route-files", "additional-files"))
    others = strange(options)
    wrong = [f"{sumocfg}: option {key}: SUMO has none of this name" for key in others if key not in options_of_sumo()]
    wrong += [f"{sumocfg}: no net-file"] if not net else []
    wrong += [f"{sumocfg}: no route-files, nor additional-files with trains in them"] if not routes and not more else []
    wrong += [f"{sumocfg}: {path}: no such file" for path in (*net, *routes, *more) if not path.is_file()]
    times = {}
    for key, missing in (("begin", "0"), ("end", "-1"), ("step-length", "1")):
        said = options.get(key, missing)
        times[key] = seconds(said) if is_time(said) else math.nan
        if not (times[key] > 0 if key == "step-length" else math.isfinite(times[key])):
            wrong.append(f"{sumocfg}: {key} = {said}: must be a time{', above 0' if key == 'step-length' else ''}")
    if times["end"] not in (-1.0, math.nan) and times["end"] <= times["begin"]:
        wrong.append(f"{sumocfg}: end = {options['end']}: must be after begin = {times['begin']:g} s")
    patience, scale = options.get("max-depart-delay", "-1"), options.get("scale", "1")
    if not is_time(patience):
        wrong.append(f"{sumocfg}: max-depart-delay = {patience}: must be a time")
    if bad_number(scale):
        wrong.append(f"{sumocfg}: scale = {scale}: must be a number, not negative")
    speed = options.get("default.departspeed", DEPART_SPEED)
    if speed not in _WORDS["departSpeed"] and bad_number(speed):
        wrong.append(f"{sumocfg}: default.departspeed = {speed}: must be a speed or one of {', '.join(_WORDS['departSpeed'])}")
    routing = {key: options[key] for key in ROUTING if key in options}
    for key, said in routing.items():
        if not (is_number(said) if key == "weights.reversal-penalty" else not bad_number(said)):
            wrong.append(
                f"{sumocfg}: {key} = {said}: must be a number{'' if key == 'weights.reversal-penalty' else ', not negative'}"
            )
    if wrong:
        raise InputError(wrong)
    begin, own_end = times["begin"], times["end"] if times["end"] >= 0 else None
    ends = [e for e in (own_end, None if duration_s is None else begin + duration_s) if e is not None]
    tracks = read_tracks(net[0])
    elements = read_demand(more, routes)
    if options.get("use-stop-ended", "false").lower() in YES:
        _ended(elements)
    _bounded(elements, begin, own_end)
    wrong = [
        f"vType {name}: {key} = {element.get(key)}: must be a number, not negative"
        for name, element in elements.types.items()
        for key in ("length", "maxSpeed")
        if bad_number(element.get(key))
    ]
    if wrong:
        raise InputError(wrong)
    kinds = {name: kind_of(element) for name, element in (default_types() | elements.types).items()}
    trains, notes = rail_trains(elements, kinds)
    told = of_files(options, trains, elements, kinds, tracks.file)
    if told.refused:
        raise InputError([f"{sumocfg}: {line}" for line in told.refused])
    signs, wrong = speed_signs(elements.others, tracks)
    closed, rerouter_notes, mistakes = closings(elements.others, tracks, {k.vclass for k in kinds.values()})
    drawn, drawn_notes, wrong_draws = choices(elements.others, elements.routes, tracks)
    more_notes = [*told.named, *rerouter_notes, *drawn_notes]
    wrong += [*mistakes, *wrong_draws]
    if wrong:
        raise InputError([f"{sumocfg}: {line}" for line in wrong])
    refuse(sumocfg, net[0], trains, elements, kinds, tracks)
    if float(scale) != 1.0:
        trains, scale_notes = scaled(trains, elements.trains, float(scale), options.get("scale-suffix", "."))
        notes += scale_notes
    if in_doubt(net[0], tracks.file):
        tried(net[0])
    expanded = expand(trains, elements, net[0], work, begin, min(ends) if ends else None, seed, routing)
    order = {train.get("id", ""): k for k, train in enumerate(trains)}
    made = {vehicle.get("id", "") for vehicle in expanded}
    made |= {name.rpartition(".")[0] for name in made}
    departures = []
    handed: dict[str, tuple[Element, Element, tuple[str, ...]]] = {}
    wrong = [
        f"{'flow' if t.tag == 'flow' else 'train'} {t.get('id')}: duarouter finds no route; are all its edges open to its vClass?"
        for t in trains
        if t.get("id") not in made and _comes(t, begin, min(ends, default=math.inf))
    ]
    for vehicle in expanded:
        name = vehicle.get("id", "")
        source = trains[order[name if name in order else name.rpartition(".")[0]]]
        kind = kinds[vehicle.get("type", "DEFAULT_VEHTYPE")]
        if kind.vclass not in RAIL:
            continue
        train, mistakes = _departure(vehicle, source, kind, elements, tracks, speed, seed)
        departures.append((order[source.get("id", "")], train))
        handed[name] = vehicle, source, train.edges
        wrong += mistakes
    wrong += [f"{net[0]}: {line}" for line in restricted(((kinds[d.kind].vclass, d.edges) for _, d in departures), tracks)]
    if wrong:
        raise InputError(list(dict.fromkeys(wrong)))
    if not departures:
        until = f" and before end = {min(ends):g}" if ends else ""
        raise InputError(f"{sumocfg}: no train departs at begin = {begin:g} or later{until}")
    departures.sort(key=lambda d: (d[1].depart_s, d[0]))
    used = {d.kind for _, d in departures}
    if plain := unmarked((e for _, d in departures for e in d.edges), tracks):
        notes.append(
            f"net: {len(plain)} x edges of routes are open to all classes, to no rail class by name: taken for tracks without"
            " road traffic"
        )
    notes += _too_fast([d for _, d in departures], kinds, tracks)
    notes += crossings.told(tracks.file, [d.edges for _, d in departures])
    return Configuration(
        net=net[0],
        departures=tuple(d for _, d in departures),
        kinds={name: kind for name, kind in kinds.items() if name in used},
        begin_s=begin,
        end_s=own_end,
        step_s=times["step-length"],
        patience_s=seconds(patience) if seconds(patience) >= 0 else math.inf,
        followed=tuple(told.followed),
        notes=(*notes, *more_notes),
        signs=tuple(signs),
        closings=tuple(closed),
        choices=tuple(drawn),
        drawn=tuple(t.get("id", "") for t in trains if "probability" in t.attrib or t.get("period", "").startswith("exp")),
        signals=rail_signals(tracks.file),
        junctions=sum(j.attributes.get("type") == "rail_signal" for j in tracks.file.junctions),
        source=Source(options, elements, handed),
    )


def _departs(train: Element, begin: float) -> float:
    depart = train.get("depart", "begin")
    return begin if depart == "begin" else seconds(depart)


def _comes(train: Element, begin: float, end: float) -> bool:
    """Whether a train, or one of a flow, must depart between these times; of a flow that is drawn that is not known."""
    if train.tag != "flow":
        return begin <= _departs(train, begin) < end
    sure = train.get("number", "1") != "0" and "probability" not in train.attrib
    return sure and begin <= seconds(train.get("begin", "0")) < min(end, seconds(train.get("end", "inf")))


def _bounded(elements: Elements, begin: float, end: float | None) -> None:
    """Give flows that spread a number of trains over no stated time the end that they have in SUMO."""
    stated = {"end", "period", "vehsPerHour", "perHour", "probability"}
    for flow in (t for t in elements.trains if t.tag == "flow" and "number" in t.attrib and stated.isdisjoint(t.attrib)):
        if is_time(said := flow.get("begin", repr(begin))):
            flow.set("end", repr(end if end is not None else seconds(said) + DAY_S))


def _ended(elements: Elements) -> None:
    """Let trains stand until the time at which their stops are said to have ended, as SUMO does with ``use-stop-ended``."""
    everything = [*elements.trains, *elements.routes.values(), *elements.drawn.values()]
    for stop in (stop for element in everything for stop in element.iter("stop")):
        if (ended := stop.get("ended")) is not None and is_time(ended) and seconds(ended) >= 0:
            stop.set("until", ended)


def _lap(edges: tuple[str, ...], routes: list[Element]) -> tuple[tuple[str, ...], int, list[Element]]:
    """The edges of one lap, how many laps, and the stops in each, of a train that runs over ``edges``.

    duarouter always repeats the stops of a route that is repeated, but not always its edges.
    """
    for route in routes:
        once, repeat = tuple(route.get("edges", "").split()), route.get("repeat", "0")
        laps = (int(repeat) if repeat.isdecimal() else 0) + 1
        if edges in (once, once * laps):
            return once, laps, list(route.iter("stop"))
    return edges, 1, []


def _drawn(seed: int, train: str, key: str) -> float:
    """A number in [0, 1) for what a train has at random."""
    return float(draws.uniform(seed, draws.DEPARTURE, np.array([_DRAWN.index(key)]), np.array([[draws.word(train), 0]]))[0, 0])


def _cut(source: Element, edges: tuple[str, ...], laps: int, seed: int, train: str) -> tuple[int, int] | str:
    """Numbers of the first edge of a route that a train runs over and of the one behind the last; else what is wrong."""
    found: list[int] = []
    for key, missing in (("departEdge", 0), ("arrivalEdge", len(edges) * laps - 1)):
        said = source.get(key, str(missing))
        if said in ("random", "free"):
            lowest = found[0] if found else 0
            found.append(lowest + int(_drawn(seed, train, key) * (len(edges) * laps - lowest)))
            continue
        if not said.isdecimal() or int(said) >= len(edges) * laps:
            return f"{key} = {said}: must be the number of an edge of its route, 0 to {len(edges) * laps - 1}"
        found.append(int(said))
    first, last = found
    return (first, last + 1) if first <= last else f"arrivalEdge = {last}: lies before departEdge = {first}"


def _departure(
    vehicle: Element, source: Element, kind: Kind, elements: Elements, tracks: Tracks, default_speed: str, seed: int
) -> tuple[Departure, list[str]]:
    """A train out of what duarouter wrote and what the file said, and the mistakes in it."""
    name, route = vehicle.get("id", ""), vehicle.find("route")
    edges = () if route is None else tuple(route.get("edges", "").split())
    edges, laps, each = _lap(edges, routes_of(source, elements))
    rounds = laps if by_name(source) else 1  # stops of a route in a train are the train's own, made once
    of_lap, meant = len(each), [*each * rounds, *(e for e in source if e.tag == "stop")]
    cut = _cut(source, edges, laps, seed, name)
    first, end = (0, len(edges) * laps) if isinstance(cut, str) else cut
    firsts = [max(k // of_lap * len(edges) - first, 0) if k < rounds * of_lap else 0 for k, _ in enumerate(vehicle.iter("stop"))]
    edges = (edges * laps)[first:end]
    given = list(vehicle.iter("stop"))
    dropped = len(meant) - len(given)
    for stop, own in zip(given, meant, strict=False) if dropped == 0 else ():
        if "endPos" in own.attrib and not own.attrib.keys().isdisjoint(PLACES):  # there duarouter leaves it out
            stop.set("endPos", own.get("endPos", ""))
    places = [place_of(stop, elements, tracks) for stop in given]
    # duarouter counts ``until`` at stops of a named route from the departure, as SUMO does, but not ``arrival``.
    late = float(vehicle.get("depart", "0")) if by_name(source) else 0.0
    planned = [_planned(stop, late if k < of_lap else 0.0 if k >= rounds * of_lap else None) for k, stop in enumerate(given)]
    wrong = [f"train {name}: {m}" for m in (*unconnected(list(edges), tracks), *off_route(edges, places, firsts))]
    wrong += [f"train {name}: {cut}"] if isinstance(cut, str) else []
    wrong += (
        [f"train {name}: SUMO's duarouter drops {dropped} of its stops; let them end more than 0.1 m in on their edges"]
        if dropped > 0
        else []
    )
    # Where a stop is said to have ended, later than planned, what is planned of the next ones may lie before.
    were_late = any(stop.get("ended") for one in (source, *routes_of(source, elements)) for stop in one.iter("stop"))
    wrong += [f"train {name}: {m}" for m in (_backwards(given, planned, places) if laps == 1 and not were_late else [])]
    stops = [
        StopElement(
            edge=place.lane.rpartition("_")[0],
            position_m=place.position_m,
            duration_s=max(seconds(stop.get("duration", "0")), 0.0),
            until_s=seconds(stop.get("until", "")) if stop.get("until") else None,
            name=_called(stop, elements),
            first=at,
            pass_mps=float(stop.get("speed", "0")),
            parks=stop.get("parking", "false").lower() in YES or stop.get("parkingArea") is not None,
            area=area_of(elements.places[stop.get("parkingArea", "")], place) if stop.get("parkingArea") else None,
            arrival_s=arrival,
        )
        for stop, place, at, arrival in zip(given, places, firsts, planned, strict=True)
    ]
    departure = Departure(
        id=name,
        kind=kind.id,
        depart_s=seconds(vehicle.get("depart", "0")),
        edges=edges,
        position_m=0.0,
        speed_mps=None,
        like="",
        stops=tuple(stops),
        arrival_m=None,
        line=source.get("line", ""),
    )
    if wrong:
        return departure, wrong
    begun, ended = (tracks.length[f"{e}_0"] for e in (edges[0], edges[-1]))
    wrong = [
        f"train {name}: {key} = {source.get(key)}: must be a number or one of {', '.join(known)}"
        for key, known in _WORDS.items()
        if source.get(key, known[0]) not in known and not is_number(source.get(key, ""))
    ]
    if source.get("departSpeed", "0").startswith("-"):
        wrong.append(f"train {name}: departSpeed = {source.get('departSpeed')}: must not be negative")
    if wrong:
        return departure, wrong
    said = source.get("departPos", "base")
    position = _depart_position(said, kind.length_m, begun, departure)
    if said in ("random", "free", "random_free"):
        position = min(_drawn(seed, name, "departPos") * begun, position if stops and stops[0].edge == edges[0] else begun)
    arrival = source.get("arrivalPos", "max")
    arrival_m = {"center": ended / 2, "random": _drawn(seed, name, "arrivalPos") * ended}.get(arrival)
    if is_number(arrival):
        arrival_m = min(max(float(arrival) + (ended if float(arrival) < 0 else 0.0), 0.0), ended)  # as in SUMO
    speed = source.get("departSpeed", default_speed)
    speed_mps = float(speed) if is_number(speed) else None
    if speed == "random":
        speed_mps = _drawn(seed, name, "departSpeed") * min(kind.max_speed_mps, kind.speed_factor * tracks.speed[edges[0]])
    if not 0.0 <= position <= begun:
        wrong.append(f"train {name}: departPos = {source.get('departPos')}: off edge {edges[0]}, which is {begun:g} m long")
    if stops and stops[0].edge == edges[0] and position >= stops[0].position_m:
        speed_mps = 0.0
    like = speed if speed in ("avg", "last") else ""
    return departure._replace(position_m=position, arrival_m=arrival_m, speed_mps=speed_mps, like=like), wrong


def _too_fast(departures: list[Departure], kinds: dict[str, Kind], tracks: Tracks) -> list[str]:
    """What is said of trains that are to begin faster than their type or their edge allows."""
    found = []
    for d in departures:
        kind = kinds[d.kind]
        drawn = "(" in kind.attributes.get("speedFactor", "") or "speedDev" in kind.attributes
        limit = min(kind.max_speed_mps, math.inf if drawn else kind.speed_factor * tracks.speed[d.edges[0]])
        if d.speed_mps is not None and d.speed_mps > limit + 0.01:  # SUMO's own tolerance
            found.append(f"{d.id} ({d.speed_mps:g} m/s, allowed {limit:g})")
    some = f"{', '.join(found[:8])}{' ...' if len(found) > 8 else ''}"
    why = "they begin no faster than their vType and their edge allow, where SUMO ends with an error"
    return [f"{len(found)} x departSpeed: not followed: {why}: {some}"] if found else []


def _called(stop: Element, elements: Elements) -> str:
    """Name of the place a train stops at, or its id where it has none; "" on a lane."""
    place = next((stop.get(tag, "") for tag in PLACES if stop.get(tag)), "")
    return elements.places[place].get("name") or place if place in elements.places else place


def _planned(stop: Element, late: float | None) -> float | None:
    """Planned arrival at a stop [s], ``late`` more than its file says; None if it has none, or none in this lap."""
    said = stop.get("arrival")
    return seconds(said) + late if said is not None and late is not None and is_time(said) and seconds(said) >= 0 else None


def _backwards(stops: list[Element], arrivals: list[float | None], places: list[Place]) -> list[str]:
    """Mistakes in a timetable: planned times that lie before an earlier one on the way."""
    wrong, last = [], 0.0
    for stop, arrival, place in zip(stops, arrivals, places, strict=True):
        said = stop.get("until", "-1")
        until = seconds(said) if is_time(said) else -1.0
        for key, planned in (("arrival", arrival), ("until", until if until >= 0 else None)):
            if planned is not None and planned < last:
                edge = place.lane.rpartition("_")[0]
                wrong.append(
                    f"stop on edge {edge}: {key} = {planned:g} s: must not be before {last:g} s, planned earlier on its route"
                )
            last = max(last, planned or 0.0)
    return wrong


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
