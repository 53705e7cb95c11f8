"""Trains of SUMO's own beside ours, and signals that all of them obey: what is chosen, and where it cannot be.

Where signals are obeyed they alone decide who goes first and who has single track: our interlocking then grants nothing, since two
authorities, each with a part of what two trains need, could hold both up for ever. So every place that two trains may want at once
must have a signal before it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise
from typing import Literal
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from sumo_net import Rails
from trainctl.railway.ways import Ways
from trainctl.scenario.events import Order
from trainctl.scenario.tables import TrafficTable
from trainctl.signals import Bools, Ints
from trainctl.traffic.handed import Handed
from trainctl.traffic.rail_signals import Signal

#: More edges than this are counted, not named.
MOST = 5


def chosen(
    driving: TrafficTable, together: Bools, signals: Sequence[Signal], bare: Sequence[str], again: Sequence[str] = ()
) -> tuple[Literal["ignore", "obey"], list[str], list[str]]:
    """Whether signals are obeyed, what is to be reported of that, and what is wrong with it.

    Parameters
    ----------
    driving : TrafficTable
        What the scenario says.
    together : ndarray of bool, shape (n,)
        Trains that cooperate.
    signals : sequence of Signal
        Rail signals of the net.
    bare : sequence of str
        Places without a signal before them, as ``unguarded`` names them.
    again : sequence of str
        Trains that ``laps`` names.
    """
    alone = int((~together).sum())
    sumo = driving.others == "sumo" and alone > 0
    if driving.signals == "ignore":
        wrong = (
            'traffic.signals = ignore: not with others = "sumo": SUMO\'s trains obey them and ours would not, so that two'
            " authorities could block each other for ever"
        )
        return "ignore", _in_turn(again), [wrong] if sumo else []
    if driving.signals is None and not sumo and (not signals or not (alone or again)):
        return "ignore", _in_turn(again), []
    if driving.signals is None and not sumo and bare:
        though = "not every train cooperates" if alone else f"{len(again)} trains run several rounds"
        why = f'though {though}: there is no rail signal {bare[0]}; give it one, or say signals = "obey"'
        return "ignore", [f"traffic.signals = ignore: chosen {why} to list all such places", *_in_turn(again)], []
    of = "traffic.signals = obey" if driving.signals else "traffic.others = sumo"
    wrongs = [f"{of}: there is no rail signal {one}: nothing would decide who goes first there" for one in bare]
    if driving.signals == "obey" and not signals:
        wrongs.append("traffic.signals = obey: the net has no rail signals")
    if driving.signals or wrongs:
        return "obey", [], wrongs
    why = f"SUMO drives {alone} of {len(together)} trains" if sumo else f"{alone} of {len(together)} trains do not cooperate"
    if not alone:
        why = f"{_some(again)} run more than once over single track or a crossing: our own interlocking counts all rounds at once"
    other = "" if sumo else '; signals = "ignore" is the other way'
    return "obey", [f"traffic.signals = obey: chosen since {why}{other}"], []


def laps(legs: Sequence[Sequence[Ints]], ids: Sequence[str], rails: Rails) -> list[str]:
    """Trains that come more than once, before they turn or leave, over track used both ways or a crossing of used tracks.

    Only those that share such a place with another one. The rule by which trains never wait for each other in a circle
    (``railway.deadlock``) counts all their rounds at once.
    """
    used = {e for parts in legs for part in parts for e in set(part.tolist())}
    shut = [e for e in used if any(int(f) in used for f in (rails.twin[e], *rails.crossing[e]))]
    known: dict[bytes, set[int]] = {}  # edges on which a train shuts the track more than once, by its way
    for part in (part for parts in legs for part in parts):
        if (key := part.tobytes()) not in known:
            edges, times = np.unique(part[np.isin(part, shut)], return_counts=True)
            known[key] = {f for e in edges[times > 1].tolist() for f in (e, int(rails.twin[e]), *rails.crossing[e]) if f >= 0}
    again = [set[int]().union(*(known[part.tobytes()] for part in parts)) for parts in legs]
    trains = Counter(e for edges in again for e in edges)
    return [name for name, edges in zip(ids, again, strict=True) if any(trains[e] > 1 for e in edges)]


def _in_turn(again: Sequence[str]) -> list[str]:
    """What is to be reported of trains that ``laps`` names where our turns decide."""
    if not again:
        return []
    return [
        f"network.sumocfg: {_some(again)} run more than once over single track or a crossing: all rounds of a train are counted at"
        " once, so trains are let in nearly one after another; rail signals that are obeyed let more of them run"
    ]


def of_formations(together: Bools, options: Mapping[str, str]) -> list[str]:
    """What signals do to formations of trains that cooperate (n,), where they are obeyed; ``options`` are those of the files."""
    if together.sum() < 2 or _moving(options):
        return []
    return [
        f"traffic.signals = obey: a signal lets one train at a time into its block, so it draws formations of the {together.sum()}"
        " trains that cooperate apart; SUMO's option railsignal-moving-block lets them pass together"
    ]


def at_joins(rails: Rails, options: Mapping[str, str]) -> list[str]:
    """Whether signals that are obeyed keep no trains apart at joins; ``options`` are those of the files."""
    if rails.internal.any() or not _moving(options) or all(len(before) < 2 for before in rails.before):
        return []
    return [
        "option railsignal-moving-block: on a net without internal edges SUMO's signals let trains from two tracks past a join at"
        " once: make the net with internal edges"
    ]


def _moving(options: Mapping[str, str]) -> bool:
    """Whether SUMO's signals are to be those of moving block."""
    return options.get("railsignal-moving-block", "false").lower() in ("true", "1", "yes", "on")


def unguarded(ways: Sequence[Ints], ids: Sequence[str], rails: Rails, signals: Sequence[Signal]) -> list[str]:
    """Joins and single track that two trains use, and that some train comes to without a rail signal before it.

    A train that begins there needs none: SUMO does not let it in before the place is free.
    """
    stands = {(rails.index.get(s.edge, -1), rails.index.get(s.onward, -1)) for s in signals}
    alike: dict[bytes, list[int]] = {}  # trains by their ways
    for i, way in enumerate(ways):
        alike.setdefault(way.tobytes(), []).append(i)
    users: dict[int, set[int]] = {}  # two of them, where there are as many
    over: dict[int, set[int]] = {}  # edges that lead into each, as far as trains come over them
    for trains in alike.values():
        way = ways[trains[0]]
        for edge in set(way.tolist()):
            users.setdefault(edge, set()).update(trains[:2])
        for a, b in zip(way[:-1].tolist(), way[1:].tolist(), strict=True):
            over.setdefault(b, set()).add(a)
    single = {
        e
        for e in users
        if any(len(users[e] | users[other]) > 1 for other in (int(rails.twin[e]), *rails.crossing[e]) if other in users)
    }
    bare: dict[bytes, list[int]] = {}
    for key, trains in alike.items():
        way = ways[trains[0]]
        bare[key], guarded, last = [], False, int(way[0])
        begun = last in single  # still on the stretch it begins on
        for k, edge in enumerate(way.tolist()):
            if k and not guarded:
                onward = next((e for e in way[k:].tolist() if not rails.internal[e]), -1)
                guarded = not rails.internal[last] and (last, onward) in stands
            begun &= edge in single
            shared = (k > 0 and len(over[edge]) > 1 and len(users[edge]) > 1) or edge in single
            if shared and not guarded and not begun and k > 0:
                bare[key].append(edge)
            last = edge
    found: dict[int, list[str]] = {}
    for name, way in zip(ids, ways, strict=True):
        for edge in bare[way.tobytes()]:
            found.setdefault(edge, []).append(name)
    named = [f"before edge {rails.edges[e]} for train {_some(names)}" for e, names in found.items()]
    return named if len(named) <= MOST else [*named[:MOST], f"before {len(named) - MOST} more edges"]


def without_signal(
    ways: Ways, i: int, row: int, edges: Sequence[int] | Ints, ids: Sequence[str], rails: Rails, signals: Sequence[Signal]
) -> str:
    """A place that two trains may want and that has no signal before it if ``i`` runs over ``edges`` from ``row`` on; "": none."""
    all_of_them = [ways.edge[a:b] for a, b in pairwise(ways.first.tolist())]
    all_of_them[i] = np.concatenate([ways.edge[ways.first[i] : row], np.asarray(edges, np.int64)])
    return next(iter(unguarded(all_of_them, ids, rails, signals)), "")


def constraints(
    orders: Sequence[Order], routes: Mapping[str, Sequence[str]], trips: Mapping[str, str], rails: Rails, signals: Sequence[Signal]
) -> tuple[list[str], list[str]]:
    """Orders of the scenario as constraints of SUMO's signals, and where no signal could keep them.

    Parameters
    ----------
    orders : sequence of Order
        As in the scenario, free of the mistakes ``passages`` finds.
    routes, trips : mapping
        Edges of the way of every train, internal ones included, and what constraints call it.
    rails : Rails
        The net.
    signals : sequence of Signal
        Its signals.

    Returns
    -------
    tuple of list of str
        Elements of an additional file; mistakes, one line each.
    """
    at = {(one.edge, one.onward): one.name for one in signals}
    found, wrong = [], []
    for k, order in enumerate(orders, 1):
        here = rails.index[order.edge]
        edges = {order.edge, *([rails.edges[int(rails.twin[here])]] if rails.twin[here] >= 0 else [])}
        before = {i: _before(routes[i], edges, rails, at) for i in order.trains}
        wrong += [f"order[{k}].trains: {i}: no rail signal on its route before edge {order.edge} could keep the order"
                  for i, name in before.items() if name is None]  # fmt: skip
        for a, b in pairwise(order.trains):
            if (foe := before[a]) and (own := before[b]):
                said = {"tripId": trips[b], "tl": foe, "foes": trips[a], "limit": str(len(routes))}
                element = Element("railSignalConstraints", {"id": own})
                element.append(Element("predecessor", said))
                found.append(ElementTree.tostring(element, "unicode"))
    return found, wrong


def unkept(
    elements: Sequence[Element], signals: Sequence[Signal], trips: Collection[str], later: Collection[str]
) -> tuple[list[str], list[str]]:
    """Constraints of the user's files at signals that are not there, which SUMO refuses; and of trains that do not come.

    ``trips`` is what constraints call the trains, ``later`` what stops would have trains of ours called from there on. Returns
    mistakes and notes, one line each.
    """
    names, wrong, notes = {one.name for one in signals}, [], []
    for given in (e for e in elements if e.tag == "railSignalConstraints"):
        who = f"railSignalConstraints {given.get('id', '')}"
        wrong += [f"{who}: no such rail signal"] if given.get("id", "") not in names else []
        for one in given:
            wrong += [f"{who}: {one.tag}: tl = {one.get('tl')}: no such rail signal"] if one.get("tl", "") not in names else []
            foes = [foe for foe in one.get("foes", "").split() if foe not in trips]
            renamed = [trip for trip in (one.get("tripId", ""), *foes) if trip in later and trip not in trips]
            notes += [f"{who}: {one.tag}: {trip}: not followed: no stop gives a train another tripId" for trip in renamed]
            if foes and one.get("tripId") in trips:
                notes.append(f"{who}: {one.tag}: {', '.join(foes)}: no such train: {one.get('tripId')} waits for it for ever")
    return wrong, notes


def yielding(handed: Handed | None, edge: Ints) -> set[int]:
    """Trains that constraints keep out of the net until another one has come over the same edge; ``edge`` (n,): where they come."""
    if handed is None:
        return set()
    number = {trip: i for i, trip in enumerate(handed.trips)}
    found = set()
    for element in map(ElementTree.fromstring, handed.additional):
        for one in (one for one in element if one.tag in ("insertionPredecessor", "insertionOrder")):
            i, foes = number.get(one.get("tripId", ""), -1), [number[f] for f in one.get("foes", "").split() if f in number]
            found |= {i for j in foes if i >= 0 and edge[i] == edge[j]}
    return found


def _before(route: Sequence[str], edges: Collection[str], rails: Rails, at: Mapping[tuple[str, str], str]) -> str | None:
    """The last signal on a route before the first of these edges, None if there is none."""
    normal = [e for e in route[: next(k for k, e in enumerate(route) if e in edges) + 1] if not rails.internal[rails.index[e]]]
    names = [at[pair] for pair in pairwise(normal) if pair in at]
    return names[-1] if names else None


def _some(trains: Sequence[str]) -> str:
    return trains[0] if len(trains) == 1 else f"{trains[0]} and {len(trains) - 1} more"
