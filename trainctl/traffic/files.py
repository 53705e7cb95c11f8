"""The files of a SUMO configuration: its options, the demand in them sorted by kind, and times and numbers as SUMO writes them."""

from __future__ import annotations

import gzip
import math
import re
import zlib
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from sumo_net import bounded
from trainctl.errors import InputError

#: What SUMO calls one thing: the places a train can stop at.
PLACES = ("trainStop", "busStop", "containerStop", "parkingArea", "chargingStation", "overheadWireSegment")
#: Other names of options, each with the one that SUMO itself writes.
_OPTIONS = {
    other: name
    for name, others in {
        "configuration-file": "c configuration", "save-configuration": "C save-config",
        "save-configuration.relative": "save-config.relative", "save-commented": "save-template.commented",
        "net-file": "n net", "route-files": "r routes", "additional-files": "a additional", "weight-files": "w weights",
        "weight-attribute": "x measure", "human-readable-time": "H", "netstate-dump": "ndump netstate netstate-output",
        "person-fcd-output": "person-fcd", "summary-output": "summary", "tripinfo-output": "tripinfo",
        "personinfo-output": "personinfo", "vehroute-output": "vehroutes", "personroute-output": "personroutes",
        "statistic-output": "statistics-output", "begin": "b", "end": "e", "route-steps": "s",
        "railsignal-moving-block": "railsignal.moving-block", "default.carfollowmodel": "carfollow.model",
        "device.rerouting.with-taz": "with-taz", "device.rerouting.threads": "routing-threads", "verbose": "v", "help": "?",
        "version": "V", "xml-validation": "X", "no-warnings": "W suppress-warnings", "log": "l log-file",
        "duration-log.disable": "no-duration-log", "duration-log.statistics": "t", "device.taxi.vclasses": "taxi.vclasses",
        "device.fcd-replay.files": "device.fcd-replay.file", "meso-ignore-lanes-by-vclass": "meso.ignore-lanes.by-vclass",
        "random": "abs-rand", "seed": "srand", "gui-settings-file": "g", "quit-on-end": "Q", "game": "G", "start": "S",
        "delay": "d", "breakpoints": "B", "edgedata-files": "m data-files", "alternative-net-file": "N", "demo": "D",
        "disable-textures": "T",
    }.items()
    for other in others.split()
}  # fmt: skip
#: The same of their beginnings and ends.
_BEGIN = {
    "vehroutes.": "vehroute-output.", "netstate.": "netstate-dump.", "netstate-output.": "netstate-dump.",
    "dump-": "netstate-dump.", "device.routing.": "device.rerouting.", "person-device.routing.": "person-device.rerouting.",
}  # fmt: skip
_END = {".knownveh": ".explicit"}
#: What SUMO passes over in a route file.
ADDITIONAL = frozenset(("variableSpeedSign", "rerouter", "calibrator"))
_TRAINS = ("vehicle", "trip", "flow")
#: Who else travels: only counted.
PEOPLE = {"person": "persons", "personFlow": "persons", "container": "containers", "containerFlow": "containers"}


class Elements(NamedTuple):
    """The files of a configuration, sorted by kind."""

    types: dict[str, Element]
    mixes: dict[str, Element]  # vType distributions
    routes: dict[str, Element]
    drawn: dict[str, Element]  # route distributions
    trains: list[Element]
    places: dict[str, Element]
    others: list[Element]  # persons, rerouters and whatever else there is
    unread: list[Element]  # what SUMO reads in additional files alone, in a route file
    late: list[Element]  # trains behind later ones in a route file, which SUMO passes over


#: Elements within elements; SUMO's files have up to five.
DEEPEST = 50


class _Refused(Exception):
    """XML that no file of SUMO has."""


class _Shallow(ElementTree.TreeBuilder):
    """Builds the tree of a file without a document type and without deep nesting."""

    depth = 0

    def start(self, tag: Any, attributes: Any, /) -> Element:
        self.depth += 1
        if self.depth > DEEPEST:
            raise _Refused(f"has more than {DEEPEST} elements within each other")
        return super().start(str(tag).rpartition("}")[2], attributes)  # SUMO pays no heed to namespaces

    def end(self, tag: Any, /) -> Element:
        self.depth -= 1
        return super().end(str(tag).rpartition("}")[2])

    def doctype(self, *_: object) -> None:
        raise _Refused("declares a document type")


def parse(path: Path) -> Element:
    """Root of an XML file, which may be compressed."""
    try:
        parser = ElementTree.XMLParser(target=_Shallow())
        parser.feed(bounded.content(path))
        root: Element = parser.close()
        return root
    except (_Refused, bounded.TooLong) as error:
        raise InputError(f"{path}: {error}, which a SUMO file does not") from None
    except gzip.BadGzipFile as error:
        raise InputError(f"{path}: not XML: {error}") from None
    except OSError as error:
        raise InputError(f"{path}: {'no such file' if isinstance(error, FileNotFoundError) else error.strerror}") from None
    except (ElementTree.ParseError, EOFError, LookupError, ValueError, zlib.error) as error:
        raise InputError(f"{path}: not XML: {error}") from None


def read_options(sumocfg: Path) -> dict[str, str]:
    """Options of a configuration by the names that SUMO itself writes."""
    root = parse(sumocfg)
    if root.tag not in ("configuration", "sumoConfiguration"):
        raise InputError(f"{sumocfg}: not a SUMO configuration: it begins with <{root.tag}>, not <sumoConfiguration>")
    said: dict[str, str] = {}
    wrong = []
    for element in root.iter():
        # SUMO takes the text of an element for its value, too, but for that of a group.
        text = "" if len(element) else (element.text or "").strip()
        value = element.get("value", element.get("v", text or None))
        if value is None:
            continue
        key = _named(element.tag)
        wrong += [f"{sumocfg}: option {key} is given twice, which SUMO refuses; take one out"] if key in said else []
        said[key] = value
    if wrong:
        raise InputError(wrong)
    return said


def _named(key: str) -> str:
    """The name that SUMO itself writes of an option."""
    key = _OPTIONS.get(key, key)
    for begin, own in _BEGIN.items():
        key = own + key.removeprefix(begin) if key.startswith(begin) else key
    for end, own in _END.items():
        key = key.removesuffix(end) + own if key.endswith(end) else key
    return key


def named_files(sumocfg: Path, options: dict[str, str], key: str) -> list[Path]:
    """Files that an option of a configuration names."""
    return [sumocfg.parent / name.strip() for name in re.split(r"[,;]", options.get(key, "")) if name.strip()]


def read_demand(additional: list[Path], routes: list[Path]) -> Elements:
    """What additional files and route files say, with the files they include; a name may be given once."""
    d = Elements({}, {}, {}, {}, [], {}, [], [], [])
    named = {"vType": d.types, "vTypeDistribution": d.mixes, "route": d.routes, "routeDistribution": d.drawn}
    wrong = []
    for path in (*additional, *routes):
        last = -math.inf
        for element in _elements(path):
            tag = element.tag
            if tag in _TRAINS:
                depart = element.get("begin" if tag == "flow" else "depart", "0")
                begins = seconds(depart) if is_time(depart) else last  # what is no time is told later
                (d.late if begins < last and path not in additional else d.trains).append(element)
                last = max(last, begins)
            elif tag in named or tag in PLACES:
                # The members of a distribution have a name of their own.
                members = [e for e in element if tag in ("vTypeDistribution", "routeDistribution") and not e.get("refId")]
                for e in (element, *members):
                    table, name = named.get(e.tag, d.places), e.get("id", "")
                    wrong += [f"{path}: {e.tag} {name}: there are several of this id"] if name in table else []
                    if name:
                        table[name] = e
                    elif e is element:
                        wrong.append(f"{path}: a {tag} has no id")
            elif tag in ADDITIONAL and path not in additional:
                d.unread.append(element)
            else:
                d.others.append(element)
    if wrong:
        raise InputError(list(dict.fromkeys(wrong)))
    return d


def _elements(path: Path, within: tuple[Path, ...] = ()) -> Iterator[Element]:
    """What a file says at its top, with the files it includes."""
    if path.resolve() in within:
        raise InputError(f"{path}: includes itself")
    for element in parse(path):
        if element.tag in ("variableSpeedSign", "rerouter") and element.get("file"):
            element.set("file", str(path.parent / element.get("file", "")))
        if element.tag == "include":
            yield from _elements(path.parent / element.get("href", ""), (*within, path.resolve()))
        else:
            yield element


def types_of(mix: Element) -> list[str]:
    """Names of the vTypes in a distribution."""
    return [e.get("id", e.get("refId", "")) for e in mix if e.tag == "vType"] + mix.get("vTypes", "").split()


def names_of(mix: Element) -> list[tuple[str, str]]:
    """Names of the routes in a distribution that stand elsewhere, each with how probable it is."""
    chances = mix.get("probabilities", "").split()
    found = [(name, chances[k] if k < len(chances) else "1") for k, name in enumerate(mix.get("routes", "").split())]
    return found + [(r.get("refId", ""), r.get("probability", "1")) for r in mix.iter("route") if r.get("refId")]


def by_name(train: Element) -> bool:
    """Whether the route of a train stands elsewhere: times of its stops count from the departure."""
    mix = train.find("routeDistribution")
    return bool(train.get("route") or (mix is not None and names_of(mix)))


def routes_of(train: Element, demand: Elements) -> list[Element]:
    """The routes a train is given, none for a trip."""
    own = [r for r in train.iter("route") if r.get("edges")]
    name = train.get("route", "")
    mix = demand.drawn.get(name) if name else train.find("routeDistribution")
    if mix is not None:
        own = [r for r in mix if r.get("edges")]
        own += [demand.routes[name] for name, _ in names_of(mix) if name in demand.routes]
    return own or ([demand.routes[name]] if name in demand.routes else [])


def bad_number(text: str | None) -> bool:
    """Whether a text is no number, or a negative one."""
    try:
        return text is not None and not 0.0 <= float(text) < math.inf
    except ValueError:
        return True


def bad_time(text: str) -> bool:
    """Whether a text is no time, or a negative one."""
    return not is_time(text) or seconds(text) < 0


def is_number(text: str) -> bool:
    """Whether a text is a finite number."""
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


@lru_cache(maxsize=1 << 16)
def is_time(text: str) -> bool:
    """Whether a text is a time that ``seconds`` reads."""
    try:
        return math.isfinite(seconds(text))
    except ValueError:
        return False


@lru_cache(maxsize=1 << 16)  # of every stop of every train four are read; half of the time that took went into this
def seconds(text: str) -> float:
    """A time as SUMO writes it: seconds, or [days:]hours:minutes:seconds."""
    value = 0.0
    for part, base in zip(text.split(":"), (1.0, *((24.0,) if text.count(":") == 3 else ()), 60.0, 60.0), strict=False):
        value = value * base + float(part)
    return value
