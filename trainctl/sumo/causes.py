"""Why SUMO moved a train otherwise than commanded, in words."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

#: Speed mode 32 switches off every speed correction of SUMO's; each inserted train starts with all of them on (31).
SPEED_MODE_FREE = 32


def cause(api: Any, train: str, edge: str, way: Sequence[str]) -> str:
    """The likeliest reason that a train is not where it was sent.

    Parameters
    ----------
    api : module
        libsumo, or another with the same functions.
    train : str
        Its id.
    edge : str
        The edge it was on a step before.
    way : sequence of str
        The normal edges it was to run over from there on.
    """
    simulation, vehicle = api.simulation, api.vehicle
    if train in simulation.getStartingTeleportIDList() or train in simulation.getEndingTeleportIDList():
        return "a teleport"
    if train in simulation.getArrivedIDList():
        return f"SUMO let it arrive before the end of its route, on edge {edge}"
    if train not in vehicle.getIDList():
        return "SUMO took it off the net: a collision, or another program removed it"
    here, route = vehicle.getRoadID(train), list(vehicle.getRoute(train))
    if not edge.startswith(":") and here == api.edge.getBidiEdge(edge) and here not in way:
        return f"it reversed on edge {edge}"
    ahead = route[max(vehicle.getRouteIndex(train), 0) :]
    if len(way) and not _continues(ahead, way):
        other = next((a for a in ahead if a not in way), here)
        return f"SUMO gave it another route, over edge {other}: a rerouter, or an edge of its route is closed"
    if vehicle.getSpeedMode(train) != SPEED_MODE_FREE:
        return f"its speed mode is {vehicle.getSpeedMode(train)}, not {SPEED_MODE_FREE}: SUMO corrects its speed"
    if vehicle.isStopped(train):
        return "a stop that SUMO holds it at"
    if here.startswith(":"):
        return "unknown"
    kind, lane = vehicle.getVehicleClass(train), vehicle.getLaneID(train)
    for before, after in pairwise(way):
        # The one it stands before, or has just run over.
        if before not in (edge, here):
            continue
        lanes = [f"{after}_{k}" for k in range(api.edge.getLaneNumber(after))]
        if not any(_lets(api, one, kind) for one in lanes):
            return f"edge {after} is closed to {kind}"
        leads = {link[0] for link in api.lane.getLinks(lane)} if before == here and lane else set(lanes)
        if leads.isdisjoint(lanes):
            return f"lane {lane} does not lead on to edge {after}"
    return "unknown"


def _continues(ahead: Sequence[str], way: Sequence[str]) -> bool:
    """Whether the edges of a route are the last ones of a way."""
    return list(way[len(way) - len(ahead) :]) == list(ahead)


def _lets(api: Any, lane: str, kind: str) -> bool:
    allowed = api.lane.getAllowed(lane)
    return not allowed or kind in allowed
