"""Flows, trips and distributions made into vehicles with routes, by SUMO's ``duarouter``.

It is handed routes, stops and times alone: it leaves out trains with a ``line`` without a word.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from sumo_net.build import program
from sumo_net.spec import LineError
from trainctl.errors import InputError
from trainctl.traffic.files import PLACES, Elements, by_name, names_of, parse, routes_of, seconds

#: Seconds after which duarouter is taken for stuck.
PATIENCE_S = 300.0

#: Options of a configuration that decide which way a trip takes.
ROUTING = (
    "railway.max-train-length", "weights.reversal-penalty", "weights.turnaround-penalty", "weights.minor-penalty",
    "weights.priority-factor",
)  # fmt: skip

#: What duarouter needs of a train.
_TRAIN_KEYS = {
    "id", "type", "depart", "begin", "end", "period", "number", "vehsPerHour", "perHour", "probability", "route", "from", "to",
    "via", "fromJunction", "toJunction", "viaJunctions",
}  # fmt: skip
#: What it needs of a route.
_ROUTE_KEYS = {"id", "edges", "probability", "repeat", "cycleTime", "refId"}
#: What it needs of a stop; one that begins where it ends it would drop.
_STOP_KEYS = {"lane", "edge", "endPos", "friendlyPos", "duration", "until", "arrival", "speed", "parking", *PLACES}


def expand(
    trains: list[Element], elements: Elements, net: Path, work: Path, begin: float, end: float | None, seed: int,
    routing: Mapping[str, str],
) -> list[Element]:  # fmt: skip
    """The vehicles duarouter makes of the trains; ``routing`` are the options of ``ROUTING`` that are said."""
    work.mkdir(parents=True, exist_ok=True)
    more, routes = Element("additional"), Element("routes")
    more.extend(elements.places.values())
    named = {id(t) for mix in elements.mixes.values() for t in mix}
    more.extend(t for t in elements.types.values() if id(t) not in named)
    more.extend(elements.mixes.values())
    drawn = {id(r) for mix in elements.drawn.values() for r in mix}
    routes.extend(_route(r) for r in elements.routes.values() if id(r) not in drawn)
    for mix in elements.drawn.values():
        routes.append(_mix(mix, elements))
    for train in trains:
        # duarouter ends with an error at a flow that begins too late for it.
        if train.tag == "flow" and end is not None and "end" not in train.attrib and seconds(train.get("begin", "0")) >= end:
            continue
        bare = _bare(train, _TRAIN_KEYS)
        for child in train:
            if child.tag == "stop":
                bare.append(_stop(child))
            elif child.tag == "route":
                bare.append(_route(child))
            elif child.tag == "routeDistribution" and by_name(train):  # else the stops of all its routes would be the train's
                routes.append(_mix(child, elements))
                routes[-1].set("id", name := f"{train.get('id', '')}:routes")
                bare.set("route", name)
            elif child.tag == "routeDistribution":
                bare.append(_mix(child, elements))
        routes.append(bare)
    for name, element in (("stops.add.xml", more), ("elements.rou.xml", routes)):
        ElementTree.ElementTree(element).write(work / name, encoding="utf-8")
    options = {
        "net-file": str(net.resolve()), "additional-files": "stops.add.xml", "route-files": "elements.rou.xml",
        "output-file": "trains.rou.xml",
        "begin": f"{begin:.3f}", "seed": str(seed), "precision": "9", "xml-validation": "never", "no-step-log": "true",
        "unsorted-input": "true", "ignore-errors": "true",
        "skip-new-routes": "true",  # otherwise it draws between the route a train is given and a shorter one
        **routing,
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
    return _stops_drawn([e for e in parse(made) if e.tag == "vehicle"], trains, elements)


def _bare(element: Element, keys: set[str]) -> Element:
    return Element(element.tag, {key: value for key, value in element.items() if key in keys})


def _route(route: Element) -> Element:
    bare = _bare(route, _ROUTE_KEYS)
    bare.extend(_stop(s) for s in route.iter("stop"))
    return bare


def _stop(stop: Element) -> Element:
    """A stop for duarouter, which does not take one without a duration."""
    bare = _bare(stop, _STOP_KEYS)
    if "duration" not in bare.attrib and "until" not in bare.attrib:
        bare.set("duration", "0")
    return bare


def _mix(mix: Element, elements: Elements) -> Element:
    """A distribution with its routes in it: of routes that it only names duarouter draws each as often as the others."""
    bare = _bare(mix, {"id", "last"})
    bare.extend(_route(route) for route in mix.iter("route") if not route.get("refId"))
    for name, chance in names_of(mix):
        route = _route(elements.routes[name])
        route.attrib.pop("id")
        route.set("probability", chance)
        bare.append(route)
    if mix.get("id") or names_of(mix):  # it would give every train the stops of the first route
        for route in bare:
            route[:] = []
    return bare


def _stops_drawn(made: list[Element], trains: list[Element], elements: Elements) -> list[Element]:
    """The vehicles, those of a distribution with the stops of the route that was drawn, counted from the departure as in SUMO."""
    mixed = {t.get("id", ""): t for t in trains if t.get("route") in elements.drawn or (by_name(t) and not t.get("route"))}
    wrong = []
    for vehicle in made if mixed else ():
        name = vehicle.get("id", "")
        train, route = mixed.get(name, mixed.get(name.rpartition(".")[0])), vehicle.find("route")
        edges = "" if route is None else route.get("edges", "")
        drawn = [] if train is None else [r for r in routes_of(train, elements) if _runs(r, edges)]
        stops = list({ElementTree.tostring(s): None for s in (_stops_of(r) for r in drawn)})
        if len(stops) > 1 or (stops and drawn[0].get("repeat", "0") != "0" and len(drawn[0])):
            why = "repeated" if len(stops) == 1 else "several of the same edges"
            wrong.append(f"train {name}: stops of routes in a distribution, {why}, are not followed; give each train its route")
            continue
        for k, stop in enumerate(_stops_of(drawn[0]) if drawn else ()):
            if "until" in stop.attrib:
                stop.set("until", repr(seconds(stop.get("until", "")) + float(vehicle.get("depart", "0"))))
            vehicle.insert(k + 1, stop)
    if wrong:
        raise InputError(wrong)
    return made


def _runs(route: Element, edges: str) -> bool:
    """Whether a train that runs over these edges may have drawn a route."""
    repeat = route.get("repeat", "0")
    once = route.get("edges", "").split()
    return edges.split() in (once, once * (int(repeat) + 1 if repeat.isdecimal() else 1))


def _stops_of(route: Element) -> Element:
    """The stops of a route, as a whole."""
    found = Element("stops")
    found.extend(_stop(stop) for stop in route.iter("stop"))
    return found


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
            gap = f"no path from edge {found[1]} to edge {found[2]}"
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
