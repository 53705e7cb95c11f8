"""What a SUMO net file says of edges, connections and junctions, as text; the meaning is with who reads it."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple
from xml.parsers import expat

from sumo_net import bounded
from sumo_net.spec import LineError

#: Vehicle classes that make an edge a railway.
RAIL = frozenset(("rail", "rail_electric", "rail_fast", "rail_urban", "tram", "subway", "cable_car"))


def for_trains(lane: Mapping[str, str], anybody: bool = False) -> bool:
    """Whether a lane is for trains: it allows a rail class by name, or where ``anybody`` counts does not keep them out."""
    if not RAIL.isdisjoint(lane.get("allow", "").split()):
        return True
    return anybody and lane.get("allow", "all") == "all" and not _keeps_out(lane.get("disallow", "").split())


def _keeps_out(disallowed: list[str]) -> bool:
    return "all" in disallowed or set(disallowed) >= RAIL


class NetEdge(NamedTuple):
    """An edge of any kind, with its lanes by index."""

    attributes: dict[str, str]
    lanes: list[dict[str, str]]
    params: dict[str, str]


class NetJunction(NamedTuple):
    """A junction and the rows of its right of way."""

    attributes: dict[str, str]
    requests: list[dict[str, str]]


class NetFile(NamedTuple):
    """A net file, in its order."""

    edges: list[NetEdge]
    connections: list[dict[str, str]]
    junctions: list[NetJunction]
    version: str  # of the format; "" if it says none
    others: list[str]  # tags of all other elements, those in edges and lanes among them
    restrictions: dict[str, dict[str, str]]  # by type of edge: speed limits of vehicle classes [m/s]


def content(path: Path) -> bytes:
    """What is in a net file, unpacked: SUMO's nets are often gzipped.

    Raises
    ------
    LineError
        If there is no such file, or it cannot be read.
    """
    try:
        return bounded.content(path)
    except FileNotFoundError:
        raise LineError([f"{path}: no such net file"]) from None
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise LineError([f"{path}: damaged gzip: {error}"]) from None
    except bounded.TooLong as error:
        raise LineError([f"{path}: {error}: not a net of SUMO"]) from None
    except OSError as error:
        raise LineError([f"{path}: cannot be read: {error.strerror}"]) from None


def unpack(net: Path, folder: Path) -> Path:
    """Copy a net into ``folder``, gzipped or not: ``NAME.net.xml`` there."""
    target = folder / net.name.removesuffix(".gz")
    target.write_bytes(content(net))
    return target


def read_net(path: Path) -> NetFile:
    """The net in a file, gzipped or not.

    Raises
    ------
    LineError
        If there is no such file, it cannot be read, or it is not a net.
    """
    net = NetFile([], [], [], "", [], {})
    inside: NetEdge | NetJunction | None = None
    kind = ""
    depth = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal net, inside, depth, kind
        depth += 1
        if depth == 2:
            inside, kind = None, ""
            if tag == "connection":
                net.connections.append(attributes)
            elif tag == "edge":
                net.edges.append(inside := NetEdge(attributes, [], {}))
            elif tag == "junction":
                net.junctions.append(inside := NetJunction(attributes, []))
            else:
                net.others.append(tag)
                kind = attributes.get("id", "") if tag == "type" else ""
        elif depth == 3 and kind and tag == "restriction":
            net.restrictions.setdefault(kind, {})[attributes.get("vClass", "")] = attributes.get("speed", "")
        elif depth == 4 and isinstance(inside, NetEdge) and tag != "param":
            net.others.append(tag)
        elif depth == 3 and inside is not None:
            if tag == "lane" and isinstance(inside, NetEdge):
                inside.lanes.append(attributes)
            elif tag == "param" and isinstance(inside, NetEdge):
                inside.params[attributes.get("key", "")] = attributes.get("value", "")
            elif isinstance(inside, NetEdge):
                net.others.append(tag)
            elif tag == "request" and isinstance(inside, NetJunction):
                inside.requests.append(attributes)
        elif depth == 1:
            if tag != "net":
                raise LineError([f"{path}: not a SUMO net: its root element is <{tag}>, not <net>"])
            net = net._replace(version=attributes.get("version", ""))

    def end(_: str) -> None:
        nonlocal depth
        depth -= 1

    def refuse(*_: object) -> None:
        raise LineError([f"{path}: not a SUMO net: it declares XML entities or a document type"])

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    try:
        parser.Parse(content(path), True)
    except (expat.ExpatError, LookupError, ValueError) as error:  # the latter two: an encoding that is none
        raise LineError([f"{path}: not XML: {error}"]) from None
    return net
