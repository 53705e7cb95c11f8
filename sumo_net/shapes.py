"""Where the tracks of a net lie: the shapes of its rail lanes."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sumo_net.line import rail_edges
from sumo_net.netfile import for_trains, read_net
from sumo_net.spec import LineError


class Piece(NamedTuple):
    """An edge that trains can use."""

    edge: str
    internal: bool
    speed_mps: float
    points: NDArray[np.float64]  # (P, 2) m


def shapes(net: Path, over: Collection[str] = ()) -> list[Piece]:
    """The rail edges of a net in its own coordinates, in the order of the file; those of ``over`` also if open to all classes.

    Raises
    ------
    LineError
        If there is no such file, it is not a net, or it has no rail edges.
    """
    found = []
    for edge in read_net(net).edges:
        name = edge.attributes.get("id", "")
        lane = next((lane for lane in edge.lanes if for_trains(lane, name in over)), None)
        if lane is None:
            continue
        try:
            points = np.array([[float(v) for v in point.split(",")[:2]] for point in lane["shape"].split()])
            found.append(Piece(name, edge.attributes.get("function") == "internal", float(lane["speed"]), points.reshape(-1, 2)))
        except (KeyError, ValueError) as error:
            raise LineError([f"{net}: edge {name}: its shape or speed cannot be read: {error}"]) from None
    if not any(not piece.internal for piece in found):
        raise LineError([f"{net}: has no rail edges: none of its lanes allows a rail class by name"])
    return found


def built_here(net: Path) -> bool:
    """Whether a net was built by ``sumo_net``, with tracks and kilometrage in it; else it is just any rail net.

    Raises
    ------
    LineError
        If there is no such file, it is not a net, or it has no rail edges.
    """
    return any("track" in edge.params for edge in rail_edges(read_net(net), net))
