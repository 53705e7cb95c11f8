"""In which order trains pass an edge, as ``[[order]]`` has it, and what cannot be followed of that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

from trainctl.scenario.events import Order


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
