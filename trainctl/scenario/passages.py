"""In which order trains pass an edge, as ``[[order]]`` has it, and what cannot be followed of that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations, pairwise

import numpy as np

from sumo_net import Rails
from trainctl.railway import along, solvable
from trainctl.railway.ways import ways as laid
from trainctl.scenario.events import Order
from trainctl.signals import Floats, Ints


def mistakes(orders: Sequence[Order], routes: Mapping[str, Sequence[str]], twin: Mapping[str, str]) -> list[str]:
    """Orders of trains that are not there or do not pass, and orders that contradict each other or the routes.

    Parameters
    ----------
    orders : sequence of Order
        As in the scenario.
    routes : mapping
        Edges of the way of every train, in the order in which trains come that enter over one edge.
    twin : mapping
        Edges that are one track in the other direction: an order holds there, too.
    """
    found, first = [], dict[tuple[str, str, str], int]()  # edge, train, train after it: by which order
    number = {train: k for k, train in enumerate(routes)}
    for k, order in enumerate(orders, 1):
        unknown = [i for i in order.trains if i not in routes]
        found += [f"order[{k}].trains: {i}: no such train" for i in unknown]
        edges = (order.edge, twin.get(order.edge, ""))
        found += [f"order[{k}].trains: {i}: does not run over edge {order.edge}" for i in order.trains
                  if i not in unknown and not set(edges) & set(routes[i])]  # fmt: skip
        known = [i for i in order.trains if set(edges) & set(routes.get(i, ()))]
        for a, b in combinations(known, 2):
            said = f"order[{k}]: {a} before {b} on edge {order.edge}"
            for edge in _together(routes[a], routes[b], edges):
                other = first.setdefault((edge, a, b), k) if (edge, b, a) not in first else first[edge, b, a]
                if (edge, b, a) in first:
                    found.append(f"{said}: order[{other}] has {b} before {a}, and they cannot change places between the two")
                if edge == routes[a][0] == routes[b][0] and number[b] < number[a]:
                    found.append(f"{said}: {b} enters first, over edge {edge}, and they cannot change places on their routes")
    return list(dict.fromkeys(found))


def without_solution(
    orders: Sequence[Order], ids: Sequence[str], legs: Sequence[Sequence[Ints]], rails: Rails, place: Floats, length: Floats,
    clearance: float, may_change: str = "",
) -> tuple[list[str], list[str]]:  # fmt: skip
    """Trains that can never all get out, whoever decides: mistakes; and what could not be decided: notes. One line each.

    Parameters
    ----------
    orders : sequence of Order
        Free of the mistakes of ``mistakes``.
    ids : sequence of str
        Names of the n trains, in the order in which they come that enter over one edge.
    legs : sequence
        Edges of the way of each, in parts where it turns.
    rails : Rails
        The net.
    place, length : ndarray, shape (n,)
        Where each enters on its first edge, and its length [m].
    clearance : float
        Room one standing train needs beyond its length [m].
    may_change : str, optional
        Why trains may run otherwise than is known now: then nothing is decided.
    """
    net = along.net(rails)
    found = list[str]()
    met = dict[tuple[float | bytes, ...], list[int]]()  # edges on which trains meet themselves, by length and way
    for i, parts in enumerate(legs):
        alike = (length[i], *(part.tobytes() for part in parts))
        if alike not in met:
            ways = laid(parts, rails.start_m, rails.length_m)
            rows = [row for _, row in solvable.meets_itself(ways, net, np.full(len(parts), length[i]))]
            met[alike] = ways.edge[rows].tolist()
        found += [
            f"network.sumocfg: train {ids[i]}: {length[i]:g} m long, meets itself on edge {rails.edges[e]}: its loop is shorter"
            for e in met[alike]
        ]
    if found or not orders:
        return ([] if may_change else found), []
    said = f"order: whether all trains can get out as the {len(orders)} orders say"
    if may_change := may_change or ("trains turn back" if any(len(parts) > 1 for parts in legs) else ""):
        return [], [f"{said} is not decided: {may_change}"]
    ways, number = laid([parts[0] for parts in legs], rails.start_m, rails.length_m), {name: i for i, name in enumerate(ids)}
    pairs = []
    for order in orders:
        here = [e for e in (rails.index[order.edge], int(rails.twin[rails.index[order.edge]])) if e >= 0]
        for a, b in pairwise(order.trains):
            first, then = (
                int(ways.first[i] + np.flatnonzero(np.isin(ways.edge[ways.first[i] : ways.first[i + 1]], here))[0])
                for i in (number[a], number[b])
            )
            pairs.append((number[b], then, number[a], first))
    start = ways.begin[ways.first[:-1]] + place
    result = solvable.search(solvable.Case(ways, net, start, length + clearance, pairs))
    if result.solution is None:
        return [], [f"{said} is not decided: {result.states} states were looked at"]
    stay = ", ".join(ids[i] for i in result.left)
    return [] if result.solution else [f"order: no solution: {stay} can never all get out if the orders are kept"], []


def _together(a: Sequence[str], b: Sequence[str], edges: tuple[str, str]) -> list[str]:
    """Edges on which two trains run behind each other up to one of ``edges``, and on, without a chance to change places."""
    i, j = (next(k for k, edge in enumerate(route) if edge in edges) for route in (a, b))
    if a[i] != b[j]:
        return list(edges)
    back = 1
    while back <= min(i, j) and a[i - back] == b[j - back]:
        back += 1
    on = 1
    while i + on < len(a) and j + on < len(b) and a[i + on] == b[j + on]:
        on += 1
    return list(a[i - back + 1 : i + on])
