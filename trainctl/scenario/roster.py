"""The trains of a SUMO configuration as the loop needs them: ways, departures and stops, on a map of the whole net."""

from __future__ import annotations

import fnmatch
import math
import tempfile
from collections.abc import Collection, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sumo_net import Line, LineError, Rails
from sumo_net.layout import Gradient
from trainctl.errors import InputError
from trainctl.railway import supervisor, turning
from trainctl.railway.authority import DRIVER_MARGIN_M
from trainctl.railway.turning import Yard
from trainctl.scenario import mixed, passages
from trainctl.scenario.tables import Scenario, TrafficTable, Train, TrainType
from trainctl.scenario.train_types import fitted, train_type
from trainctl.signals import Bools, Floats, Ints
from trainctl.traffic.choices import Choice
from trainctl.traffic.closings import Closing
from trainctl.traffic.handed import Handed, handed, read_back, trips_of_stops
from trainctl.traffic.known import of_signals
from trainctl.traffic.rail_signals import Signal
from trainctl.traffic.read import Configuration, Departure, read_traffic

#: Name of the [train_type] of all vTypes without data of their own.
REST = "*"

#: A train that stops at the end of its way, or turns there, stands this far before it [m]; nearer than 0.1 m it would have left.
STANDS_SHORT_M = turning.SHORT_M


class Stop(NamedTuple):
    """A place on a train's way where it stands."""

    place: float  # m, position of the front
    duration: float  # s
    until: float  # s, it does not leave before; -inf if it may
    name: str
    passing: float = 0.0  # m/s, it does not stand but passes with at most this speed; 0: it stands
    parks: bool = False  # it leaves the track meanwhile, and others pass
    lots: float = math.inf  # so many trains can park at the places of this name
    waits_before: float = 0.0  # m, where a train waits that finds none
    planned: float = math.nan  # s, arrival; NaN: none is planned
    edge: str = ""  # the platform: where it stands
    leg: int = 0  # number of turns before it; ``place`` counts along that part of the route

    def late(self, arrival: float, departure: float = math.nan) -> float:
        """How long after the plan a train leaves [s], or comes, where no departure is planned or none has been; NaN: no plan."""
        leaves = departure - self.until
        return leaves if math.isfinite(leaves) else arrival - self.planned


class Roster(NamedTuple):
    """All trains of a run, n of them: when and where they come, their routes and stops."""

    depart: Floats  # (n,) s
    edge: Ints  # (n,) first edge of the way
    lane_position: Floats  # (n,) m, front, at departure
    arrival: Floats  # (n,) m, front on the last edge of the way, where it leaves; inf: at its end
    speed: Floats  # (n,) m/s at departure, NaN: as fast as is safe
    like: tuple[str, ...]  # who enters as fast as is safe, but no faster than those on its edge: their "avg", the "last"; else ""
    top_speed: Floats  # (n,) m/s
    speed_factor: Floats  # (n,) share of a speed limit that a train keeps to, at most 1: no train is driven above a limit
    legs: tuple[tuple[tuple[str, ...], ...], ...]  # its route in parts, up to its turns and its end: edge ids, with internal ones
    stops: tuple[tuple[Stop, ...], ...]
    cooperates: Bools  # (n,)
    vclass: tuple[str, ...]
    patience: float  # s, who cannot enter for longer does not come; inf: all come
    followed: tuple[str, ...]  # what of the configuration is: one line for each option, element or kind
    notes: tuple[str, ...]  # what of the configuration is not followed
    signs: tuple[tuple[float, str, float], ...]  # variable speed signs: from when on [s], edge, limit [m/s]
    closings: tuple[Closing, ...]  # edges closed for a time, round which trains are led
    choices: tuple[Choice, ...]  # where trains draw another route or destination
    source: str  # the SUMO configuration; "" for [[train]] tables
    driven: Bools  # (n,) SUMO drives these itself
    signals: tuple[Signal, ...]  # rail signals of the net, where they are obeyed
    handed: Handed | None  # what SUMO is handed of the files: signals are obeyed; None: they are not
    rails: Rails
    placed: bool  # by [[train]] tables, all there from the start; else they come and go

    @property
    def routes(self) -> tuple[tuple[str, ...], ...]:
        """The ways trains begin with: up to their first turn, if they turn."""
        return tuple(legs[0] for legs in self.legs)

    @property
    def whole_routes(self) -> tuple[tuple[str, ...], ...]:
        """The edges of all legs, one after the other."""
        return tuple(tuple(edge for leg in legs for edge in leg) for legs in self.legs)

    @property
    def first_arrival(self) -> Floats:
        """``arrival`` of trains that do not turn, inf of those that do: they leave on a later leg; shape (n,)."""
        return np.where([len(legs) > 1 for legs in self.legs], np.inf, self.arrival)


def placed(scenario: Scenario, line: Line, rails: Rails | None = None) -> Roster:
    """Trains that stand on a line from the start and run to its end; free of the mistakes ``placing.on_the_line`` finds.

    ``rails`` are those of the line, where they are known.
    """
    n = len(scenario.train)
    places = [line.locate(t.track, t.position_m) for t in scenario.train]
    return Roster(
        depart=np.zeros(n), edge=np.array([e for e, _ in places], np.int64), lane_position=np.array([x for _, x in places]),
        arrival=np.full(n, np.inf), speed=np.array([t.speed_mps for t in scenario.train], float), like=("",) * n,
        top_speed=np.full(n, np.inf), speed_factor=np.ones(n),
        legs=tuple((line.route(t.track, t.position_m),) for t in scenario.train), stops=((),) * n, cooperates=np.ones(n, bool),
        vclass=("rail",) * n, patience=np.inf, followed=(), notes=(), signs=(), closings=(), choices=(), source="",
        driven=np.zeros(n, bool), signals=(), handed=None, placed=True, rails=Rails.of(line) if rails is None else rails,
    )  # fmt: skip


def tables(roster: Roster) -> dict[str, Any]:
    """A roster in what JSON knows, but for its net."""
    found = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in roster._asdict().items()}
    del found["rails"], found["placed"]
    return found


def from_tables(data: Mapping[str, Any], net: Path) -> Roster:
    """Read a roster back from its ``tables`` and its net."""
    numbers = {
        name: np.array(data[name], float) for name in ("depart", "lane_position", "arrival", "speed", "top_speed", "speed_factor")
    }
    return Roster(
        **numbers,
        edge=np.array(data["edge"], np.int64),
        legs=tuple(tuple(tuple(leg) for leg in legs) for legs in data["legs"]),
        stops=tuple(tuple(Stop(*stop) for stop in stops) for stops in data["stops"]),
        cooperates=np.array(data["cooperates"], bool),
        like=tuple(data["like"]),
        vclass=tuple(data["vclass"]),
        followed=tuple(data["followed"]),
        patience=float(data["patience"]),
        notes=tuple(data["notes"]),
        signs=tuple((float(t), str(edge), float(v)) for t, edge, v in data["signs"]),
        choices=tuple(
            Choice(tuple(at), float(begin), float(end), float(share), tuple(types), tuple(map(tuple, ways)), tuple(weights))
            for at, begin, end, share, types, ways, weights in data["choices"]
        ),
        closings=tuple(
            Closing(tuple(at), str(closed), float(begin), float(end), float(share), tuple(types), tuple(classes))
            for at, closed, begin, end, share, types, classes in data["closings"]
        ),
        source=str(data["source"]),
        driven=np.array(data["driven"], bool),
        signals=tuple(Signal(*one) for one in data["signals"]),
        handed=None if data["handed"] is None else read_back(data["handed"]),
        rails=Rails.read(net, {e for legs in data["legs"] for leg in legs for e in leg}),
        placed=False,
    )


def chart(rails: Rails) -> Line:
    """A whole net in the shape of a line: every normal edge is a track of its own, and takes the internal ones that lead to it."""
    tracks = [rails.edges[_leads_to(rails, e)] for e in range(len(rails.edges))]
    names = tuple(e for e, inside in zip(rails.edges, rails.internal, strict=True) if not inside)
    return Line(
        edges=rails.edges, tracks=tuple(tracks), start_m=rails.start_m, length_m=rails.length_m, speed_mps=rails.speed_mps,
        crossovers=(), gradient=Gradient(np.zeros(1), np.zeros(1)), track_ids=names, begin_m=float(rails.start_m.min()),
        end_m=float((rails.start_m + rails.length_m).max()),
    )  # fmt: skip


def _leads_to(rails: Rails, edge: int) -> int:
    while rails.internal[edge] and rails.after[edge]:
        edge = rails.after[edge][0]
    return edge


def enrol(scenario: Scenario, folder: Path) -> tuple[Scenario, Roster, Path]:
    """Read the traffic of a scenario with ``network.sumocfg``.

    Returns
    -------
    tuple
        The scenario with its trains and their types, the roster, and the file of the net.

    Raises
    ------
    InputError
        Everything that is wrong with the configuration, its net, its trains and their data.
    """
    with tempfile.TemporaryDirectory(prefix="traffic.") as work:
        traffic = read_traffic(folder / str(scenario.network.sumocfg), Path(work), scenario.run.duration_s)
    try:
        rails = Rails.read(traffic.net, {e for d in traffic.departures for e in d.edges})
    except LineError as error:
        raise InputError([f"network.sumocfg: {m}" for m in error.mistakes]) from None
    driving = scenario.traffic or TrafficTable()
    ids = [d.id for d in traffic.departures]
    together = np.array([any(fnmatch.fnmatchcase(i, p) for p in driving.cooperate) for i in ids], bool)
    driven = ~together & (driving.others == "sumo" and scenario.controller.law != "sumo")
    types, found = _types(
        scenario, traffic, {d.kind for d, other in zip(traffic.departures, driven.tolist(), strict=True) if not other}
    )
    found += [
        f"traffic.cooperate = {p}: no train of that name; there are: {', '.join(ids[:8])}{' ...' if len(ids) > 8 else ''}"
        for p in driving.cooperate
        if not any(fnmatch.fnmatchcase(i, p) for i in ids)
    ]
    found += _events(scenario, ids, rails)
    found += [
        f"event[{k}]: train {event.train} is SUMO's own and takes no orders: traffic.others = sumo"
        for k, event in enumerate(scenario.event, 1)
        if event.train in ids and driven[ids.index(event.train)]
    ]
    trains, routes, stops, arrival = list[Train](), list[tuple[tuple[str, ...], ...]](), list[tuple[Stop, ...]](), list[float]()
    edges = list[list[Ints]]()  # of the legs of all trains
    placed_m = list[float]()
    factor = np.array([min(traffic.kinds[d.kind].speed_factor, 1.0) for d in traffic.departures])
    way_of = cache(rails.way)  # many trains run over one route
    for d, share, other in zip(traffic.departures, factor.tolist(), driven.tolist(), strict=True):
        try:
            # Trains of SUMO's own turn by themselves.
            cuts = frozenset() if other else rails.reversal
            parts = [np.array(leg, np.int64) for leg in turning.legs(way_of(d.edges).tolist(), cuts)]
            begins = [rails.start_m[w[0]] + np.concatenate([[0.0], np.cumsum(rails.length_m[w[:-1]])]) for w in parts]
            yards = _yards(parts, begins, rails, types.get(d.kind))
            found += _too_long(d.id, parts, yards, rails, types.get(d.kind))
            if len(parts) > 1 and len(parts[0]) == 1 and len(yards[0].places):  # it turns where it begins
                d = d._replace(position_m=min(d.position_m, yards[0].last - float(begins[0][0])))
            way, begin = parts[-1], begins[-1]
            there = float(rails.length_m[way[-1]]) if d.arrival_m is None else d.arrival_m
            # As in SUMO a train that stops beyond the place where it is to leave leaves there.
            halts = _stops(d, rails, parts, begins, traffic.begin_s)
            end = max((s.place - float(begin[-1]) for s in halts if not s.passing and s.leg == len(parts) - 1), default=0.0)
            arrival.append(np.inf if max(there, end) >= float(rails.length_m[way[-1]]) else max(there, end))
            ends = [float(b[-1] + rails.length_m[w[-1]]) for b, w in zip(begins, parts, strict=True)]
            ends[-1] = float(begin[-1]) + min(arrival[-1], float(rails.length_m[way[-1]]))
            stops.append(_before_the_ends(halts, ends))
        except ValueError as error:
            found.append(f"network.sumocfg: train {d.id}: {error}")
            continue
        edges.append(parts)
        placed_m.append(d.position_m)
        routes.append(tuple(tuple(rails.edges[e] for e in part.tolist()) for part in parts))
        trains.append(
            Train(
                id=d.id, type=d.kind, track=d.edges[0], position_m=float(begins[0][0] + d.position_m),
                speed_mps=min(float(d.speed_mps if d.speed_mps is not None else scenario.reference.speed_mps or 0.0),
                              traffic.kinds[d.kind].max_speed_mps, share * float(rails.speed_mps[parts[0][0]])),
            )
        )  # fmt: skip
    whole = [tuple(edge for leg in legs for edge in leg) for legs in routes]
    if not found:
        found += passages.mistakes(
            scenario.order, dict(zip(ids, whole, strict=True)),
            {rails.edges[e]: rails.edges[f] for e, f in enumerate(rails.twin.tolist()) if f >= 0},
        )  # fmt: skip
    given, followed, told = None, traffic.followed, list[str]()
    if not found and scenario.controller.law != "sumo":
        bare = mixed.unguarded([way_of(d.edges) for d in traffic.departures], ids, rails, traffic.signals)
        choice, told, wrong = mixed.chosen(driving, together, traffic.signals, bare, mixed.laps(edges, ids, rails))
        found += wrong
        belonging = traffic.junctions, traffic.source.options, traffic.source.elements.others
        if choice == "obey":
            followed += tuple(of_signals(*belonging, obeyed=True).followed)
            scenario = scenario.model_copy(update={"traffic": driving.model_copy(update={"signals": "obey"})})
            own = [ids[i] for i in np.flatnonzero(driven).tolist()]
            given = handed(traffic.source, ids, own, traffic.begin_s)
            ways, trips = dict(zip(ids, whole, strict=True)), dict(zip(ids, given.trips, strict=True))
            ordered, wrong = mixed.constraints(scenario.order, ways, trips, rails, traffic.signals)
            given = given._replace(additional=(*given.additional, *ordered))
            later = trips_of_stops(traffic.source, [name for name, other in zip(ids, driven.tolist(), strict=True) if not other])
            bad, notes = mixed.unkept(traffic.source.elements.others, traffic.signals, given.trips, later)
            found, told = [*found, *wrong, *bad], [*told, *notes, *mixed.of_formations(together, traffic.source.options)]
            told += mixed.at_joins(rails, traffic.source.options)
        else:
            size = np.array([types[d.kind].per_unit("unit_length_m").sum() for d in traffic.departures])
            margin = (scenario.supervisor or supervisor.Params()).margin_m + DRIVER_MARGIN_M
            place = np.array([d.position_m for d in traffic.departures])
            led = traffic.closings or traffic.choices or any(event.kind == "reroute" for event in scenario.event)
            changes = "trains may be led another way" if led else ""
            changes = changes if traffic.patience_s == math.inf else "who cannot enter for long does not come"
            wrong, notes = passages.without_solution(scenario.order, ids, edges, rails, place, size, margin, changes)
            found, told = [*found, *wrong], [*told, *notes]
            told += of_signals(*belonging, obeyed=False).named
    if found:
        raise InputError(list(dict.fromkeys(found)))
    departures = traffic.departures
    roster = Roster(
        depart=np.array([max(d.depart_s - traffic.begin_s, 0.0) for d in departures]),
        edge=np.array([rails.index[d.edges[0]] for d in departures], np.int64),
        lane_position=np.array(placed_m),
        arrival=np.array(arrival),
        like=tuple(d.like for d in departures),
        speed=np.array([math.nan if d.speed_mps is None else d.speed_mps for d in departures]),
        top_speed=np.array([traffic.kinds[d.kind].max_speed_mps for d in departures]),
        speed_factor=factor,
        legs=tuple(routes),
        stops=tuple(stops),
        cooperates=together,
        vclass=tuple(traffic.kinds[d.kind].vclass for d in departures),
        patience=traffic.patience_s,
        followed=followed if scenario.controller.law != "sumo" else (),  # SUMO follows all of them itself
        notes=_changes(scenario, traffic)
        if scenario.controller.law == "sumo"
        else (
            *traffic.notes,
            *told,
            *fitted(kind for name, kind in traffic.kinds.items() if name not in scenario.train_type),
            *_slower(scenario, traffic, rails, whole),
        ),
        closings=tuple(c._replace(begin=c.begin - traffic.begin_s, end=c.end - traffic.begin_s) for c in traffic.closings),
        choices=tuple(c._replace(begin=c.begin - traffic.begin_s, end=c.end - traffic.begin_s) for c in traffic.choices),
        source=str((folder / str(scenario.network.sumocfg)).resolve()),
        signs=tuple((t - traffic.begin_s, edge, v) for t, edge, v in traffic.signs),
        driven=driven,
        signals=traffic.signals if given is not None else (),
        handed=given,
        rails=rails,
        placed=False,
    )
    return scenario.model_copy(update={"train": tuple(trains), "train_type": types}), roster, traffic.net


def in_formation(scenario: Scenario, slots: Floats) -> Scenario:
    """All trains on one track, every one at its slot and at the reference's speed."""
    speed = float(scenario.reference.speed_mps or 0.0)
    trains = tuple(
        t.model_copy(update={"track": "", "position_m": float(slot), "speed_mps": speed})
        for t, slot in zip(scenario.train, slots, strict=True)
    )
    return scenario.model_copy(update={"train": trains})


def _events(scenario: Scenario, ids: list[str], rails: Rails) -> list[str]:
    """Orders to trains or edges that are not there."""
    found = []
    edges = [edge for edge, inside in zip(rails.edges, rails.internal, strict=True) if not inside]
    for k, event in enumerate(scenario.event, 1):
        for key, name, known, what in (("train", event.train, ids, "train"), ("to_edge", event.to_edge, edges, "edge for trains")):
            if name is not None and name not in known and not (key == "train" and event.of_all):
                some = f"{', '.join(known[:8])}{' ...' if len(known) > 8 else ''}"
                found.append(f"event[{k}].{key} = {name}: no such {what}; there are: {some}")
    return found


def _types(scenario: Scenario, traffic: Configuration, ours: Collection[str]) -> tuple[dict[str, TrainType], list[str]]:
    """Data of every vType that runs: the scenario's own, else what the vType says of itself.

    A type that is none of ``ours`` moves no train here: where it lacks data those of another one stand for it.
    """
    types, found = {name: kind for name, kind in scenario.train_type.items() if name != REST}, []
    for name in sorted(dict.fromkeys(d.kind for d in traffic.departures), key=lambda name: name not in ours):
        if name not in types:
            kind = train_type(traffic.kinds[name], scenario.train_type.get(REST))
            if isinstance(kind, list) and name not in ours and (like := next(iter(types.values()), None)) is not None:
                kind = train_type(traffic.kinds[name], like)
            if isinstance(kind, list):
                found += kind
            else:
                types[name] = kind
        else:
            found += scenario.plant.too_many(name, types[name])
    return types, found


def _stops(departure: Departure, rails: Rails, parts: list[Ints], begins: list[Floats], begin_s: float) -> tuple[Stop, ...]:
    """Stops in the order of the way; an edge that is passed more than once has those behind the last place on its next passage."""
    found, row, last = [], 0, departure.position_m
    way, begin = np.concatenate(parts), np.concatenate(begins)
    leg = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    normal = np.flatnonzero(~rails.internal[way])
    for stop in departure.stops:
        edge = rails.index[stop.edge]
        if (lap := int(normal[stop.first])) > row:
            row, last = lap, -math.inf
        row += int(way[row] == edge and stop.position_m < last)
        ahead = np.flatnonzero(way[row:] == edge)
        if not len(ahead):
            raise ValueError(f"stop on edge {stop.edge} at {stop.position_m:g} m: lies behind the departure or the stop before")
        row, last = row + int(ahead[0]), stop.position_m
        until = -math.inf if stop.until_s is None else stop.until_s - begin_s
        planned = math.nan if stop.arrival_s is None else stop.arrival_s - begin_s
        lots, depth = (math.inf, 0.0) if stop.area is None else (float(stop.area.lots), stop.area.depth_m)
        place, name = float(begin[row] + stop.position_m), stop.name or stop.edge
        found.append(
            Stop(place, stop.duration_s, until, name, stop.pass_mps, stop.parks, lots, depth, planned, stop.edge, int(leg[row]))
        )  # fmt: skip
    return tuple(found)


def _yards(parts: list[Ints], begins: list[Floats], rails: Rails, of: TrainType | None) -> list[Yard]:
    """Where a train may make its turns."""
    return [
        turning.yard(leg, begin, onward, rails.twin, rails.internal, rails.length_m, _length(of), rails.before)
        for leg, begin, onward in zip(parts, begins, parts[1:], strict=False)
    ]


def _length(of: TrainType | None) -> float:
    return 0.0 if of is None else float(of.per_unit("unit_length_m").sum())


def _too_long(train: str, parts: list[Ints], yards: list[Yard], rails: Rails, of: TrainType | None) -> list[str]:
    """Turns that a train is too long for."""
    return [
        f"network.sumocfg: train {train}: cannot turn back from edge {rails.edges[leg[-1]]} to edge"
        f" {rails.edges[onward[0]]}: its {_length(of):g} m do not fit on the track that its route runs back over"
        for leg, onward, yard in zip(parts, parts[1:], yards, strict=False)
        if not len(yard.places)
    ]


def _changes(scenario: Scenario, traffic: Configuration) -> tuple[str, ...]:
    """What SUMO's own trains do otherwise than the files of their configuration say."""
    step, block = scenario.run.step_s, scenario.controller.keys().get("block", "files")
    found = [f"option step-length = {traffic.step_s:g}: run.step_s = {step:g} instead"] if traffic.step_s != step else []
    if block != "files":
        found.append(f"option railsignal-moving-block: controller.block = {block} instead")
    if traffic.drawn:
        found.append(
            f"flows {', '.join(traffic.drawn[:8])}: SUMO draws the departures itself, so these trains have no planned time"
        )
    return (*found, "options time-to-teleport and collision.action: trains are never teleported, none is removed that collides")


def _slower(scenario: Scenario, traffic: Configuration, rails: Rails, routes: list[tuple[str, ...]]) -> list[str]:
    """What the scenario's cruising speed keeps trains from that their files let run faster."""
    cruise = scenario.reference.speed_mps
    if cruise is None:
        return []
    limit = dict(zip(rails.edges, rails.speed_mps.tolist(), strict=True))
    fastest = [
        min(kind.max_speed_mps, min(kind.speed_factor, 1.0) * max(limit[e] for e in route))
        for kind, route in zip((traffic.kinds[d.kind] for d in traffic.departures), routes, strict=True)
    ]
    slowed = [v for v in fastest if v > cruise]
    if not slowed:
        return []
    return [
        f"{len(slowed)} trains could run up to {max(slowed):.4g} m/s by their types and tracks: they cruise at"
        f" reference.speed_mps = {cruise:g}"
    ]


def _before_the_ends(stops: tuple[Stop, ...], ends: list[float]) -> tuple[Stop, ...]:
    """Stops with none so near to the end of its leg that the train would leave: SUMO's own trains stand short of it, too."""
    return tuple(s if s.passing else s._replace(place=min(s.place, ends[s.leg] - STANDS_SHORT_M)) for s in stops)
