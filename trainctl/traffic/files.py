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
#: Short names of options, and the long ones.
_OPTIONS = {
    "n": "net-file", "net": "net-file", "r": "route-files", "routes": "route-files", "a": "additional-files",
    "additional": "additional-files", "b": "begin", "e": "end",
}  # fmt: skip
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
        return super().start(tag, attributes)

    def end(self, tag: Any, /) -> Element:
        self.depth -= 1
        return super().end(tag)

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
    """Options of a configuration, short names spelled out."""
    root = parse(sumocfg)
    if root.tag not in ("configuration", "sumoConfiguration"):
        raise InputError(f"{sumocfg}: not a SUMO configuration: it begins with <{root.tag}>, not <sumoConfiguration>")
    said = {e.tag: value for e in root.iter() if (value := e.get("value", e.get("v"))) is not None}
    return {_OPTIONS.get(key, key): value for key, value in said.items()}


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


def routes_of(train: Element, demand: Elements) -> list[Element]:
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
