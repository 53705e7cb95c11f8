"""Rail signals of a net: before which connections they stand."""

from __future__ import annotations

from typing import NamedTuple

from sumo_net.netfile import NetFile


class Signal(NamedTuple):
    """A rail signal, at the end of an edge, for trains that go on to another one."""

    edge: str
    onward: str  # the edge behind it
    name: str  # of its program, by which SUMO calls it
    link: int  # its place in that program


def rail_signals(net: NetFile) -> tuple[Signal, ...]:
    """All rail signals, one for each pair of edges, in the order of the net."""
    names = {j.attributes.get("id", "") for j in net.junctions if j.attributes.get("type") == "rail_signal"}
    found: dict[tuple[str, str], Signal] = {}
    for c in net.connections:
        edge, onward, name, link = (c.get(key, "") for key in ("from", "to", "tl", "linkIndex"))
        if name in names and link.isdecimal() and not edge.startswith(":"):
            found.setdefault((edge, onward), Signal(edge, onward, name, int(link)))
    return tuple(found.values())
