"""Which trains of a SUMO configuration are followed, what of them is not, and what makes it impossible to follow them."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from xml.etree.ElementTree import Element

from sumo_net.netfile import RAIL, NetFile
from trainctl.errors import InputError
from trainctl.traffic import known
from trainctl.traffic.files import PEOPLE, PLACES, Elements, is_time, names_of, routes_of, types_of
from trainctl.traffic.kinds import Kind
from trainctl.traffic.places import NO_RAIL, Tracks, off_route, place_of, unconnected


def rail_trains(elements: Elements, kinds: dict[str, Kind]) -> tuple[list[Element], list[str]]:
    """The trains among the vehicles, and what is left out."""
    trains, others = [], 0
    for train in elements.trains:
        name = train.get("type", "DEFAULT_VEHTYPE")
        types = types_of(elements.mixes[name]) if name in elements.mixes else [name]
        # A type that does not exist is a mistake, told later.
        rail = [t for t in types if t not in kinds or kinds[t].vclass in RAIL]
        trains += [train] * bool(rail)
        others += not rail
    counts = Counter(PEOPLE[e.tag] for e in elements.others if e.tag in PEOPLE)
    notes = [f"{n} definitions of {word} left out" for word, n in counts.items() if n]
    notes += [f"{others} vehicles, trips and flows left out: not rail"] if others else []
    if late := [train.get("id", "") for train in elements.late]:
        some = f"{', '.join(late[:8])}{' ...' if len(late) > 8 else ''}"
        notes.append(f"{len(late)} vehicles, trips and flows left out, as in SUMO: a route file goes by departure times: {some}")
    places = {t.get("departPos", "") for t in trains} & {"last", "splitFront"}
    notes += [
        f'departPos="{p}": the train begins with its rear at the beginning of the edge, as with "base"' for p in sorted(places)
    ]
    random = [
        f'{n} x {key}="{word}"'
        for key in ("departEdge", "departPos", "departSpeed", "arrivalEdge", "arrivalPos")
        for word in ("random", "free", "random_free")
        if (n := sum(t.get(key) == word for t in trains))
    ]
    notes += [f"{', '.join(random)}: drawn here, with random numbers other than SUMO's"] if random else []
    drawn = {t.get("type", "") for t in trains}
    drawn |= {member for name in drawn & set(elements.mixes) for member in types_of(elements.mixes[name])}
    for name in sorted(drawn & set(kinds)):
        if "(" in (text := kinds[name].attributes.get("speedFactor", "")):
            notes.append(f"vType {name}: speedFactor = {text}: its mean {kinds[name].speed_factor:g} for every train")
        if kinds[name].speed_factor > 1.0:
            notes.append(f"vType {name}: speedFactor = {text}: not followed: trains keep to the limits of their tracks")
    return trains, notes


def of_files(
    options: dict[str, str], trains: list[Element], elements: Elements, kinds: dict[str, Kind], net: NetFile
) -> known.Said:
    """What of the files of a configuration is followed, what is not, and what is refused; signals are left out."""
    own = {id(e) for t in trains for e in t.iter()}
    given = list({id(r): r for t in trains for r in routes_of(t, elements) if id(r) not in own}.values())
    named = {t.get("type", "DEFAULT_VEHTYPE") for t in trains}
    named |= {member for name in named & set(elements.mixes) for member in types_of(elements.mixes[name])}
    types = [e for name, e in elements.types.items() if name in named and kinds[name].vclass in RAIL]
    stops = {place for t in (*trains, *given) for s in t.iter("stop") for tag in PLACES for place in (s.get(tag),) if place}
    places = [e for name, e in elements.places.items() if name in stops]
    those = (
        known.of_options(options),
        known.of_trains([*trains, *given, *types, *places]),
        known.of_others(elements.others, elements.unread),
    )
    followed, not_followed, refused = ([line for part in those for line in part[k]] for k in range(3))
    return known.Said(followed, [*not_followed, *known.of_net(net)], refused)


def refuse(sumocfg: Path, net: Path, trains: list[Element], elements: Elements, kinds: dict[str, Kind], tracks: Tracks) -> None:
    """Refuse trains whose names, types, times, routes or stops cannot be: one line for each mistake."""
    met = {e for t in trains for key in ("from", "via", "to") for e in t.get(key, "").split()}
    met |= {e for t in trains for route in routes_of(t, elements) for e in route.get("edges", "").split()}
    if trains and not tracks.marked and not met & tracks.onward.keys():
        raise InputError(f"{net}: {NO_RAIL}")
    if not trains:
        raise InputError(f"{sumocfg}: no trains: no vehicle, trip or flow has a vType of a rail class ({', '.join(sorted(RAIL))})")
    mixes = [*elements.drawn.values(), *(mix for t in trains for mix in t.iter("routeDistribution"))]
    wrong = [
        f"routeDistribution {mix.get('id') or 'of a train'}: route {name}: no such route"
        for mix in mixes
        for name, _ in names_of(mix)
        if name not in elements.routes
    ]
    seen = Counter(train.get("id", "") for train in trains)
    for train in trains:
        who = f"{'flow' if train.tag == 'flow' else 'train'} {train.get('id', '')}"
        name = train.get("type", "DEFAULT_VEHTYPE")
        types = types_of(elements.mixes[name]) if name in elements.mixes else [name]
        wrong += [f"{who}: type = {t}: no such vType" for t in types if t not in kinds]
        if seen[train.get("id", "")] > 1:
            wrong.append(f"{who}: there are several of this id")
        depart = train.get("depart", train.get("begin", "0"))
        if depart != "begin" and not is_time(depart):
            wrong.append(f"{who}: depart = {depart}: must be a time; what a train is to wait for is not known before the run")
        routes = routes_of(train, elements)
        if train.get("route") and not routes:
            wrong.append(f"{who}: route = {train.get('route')}: no such route")
        ends = [*train.get("from", "").split(), *train.get("via", "").split(), *train.get("to", "").split()]
        wrong += [f"{who}: edge {e}: not in the net" for e in ends if e not in tracks.onward]
        own = {id(s): place_of(s, elements, tracks) for s in train.iter("stop")}
        wrong += [f"{who}: {p.wrong}" for p in own.values() if p.wrong]
        for route in routes:
            wrong += [f"{who}: {m}" for m in unconnected(route.get("edges", "").split(), tracks)]
            # Of several routes its own stops need to lie on the one that is drawn.
            stops = [*route.iter("stop"), *(s for s in train if s.tag == "stop" and len(routes) == 1)]
            places = [own.get(id(s)) or place_of(s, elements, tracks) for s in stops]
            wrong += [f"{who}: {p.wrong}" for p in places if p.wrong]
            if not {"repeat", "departEdge", "arrivalEdge"} & {*route.keys(), *train.keys()} and not any(p.wrong for p in places):
                wrong += [f"{who}: {m}" for m in off_route(tuple(route.get("edges", "").split()), places)]
    if wrong:
        raise InputError(list(dict.fromkeys(wrong)))
