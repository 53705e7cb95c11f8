"""Runs side by side as one scene: their trains one after the other, each run a world of its own.

Nothing links trains of two runs, so whatever is computed train by train or link by link gives every run the numbers it has alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from trainctl import draws
from trainctl.plants import disturbance
from trainctl.plants.disturbance import END as TABLE_END
from trainctl.plants.disturbance import START as TABLE_START
from trainctl.plants.disturbance import TRAIN, Signals
from trainctl.railway import supervisor
from trainctl.railway.ways import Ways, ways
from trainctl.scenario.events import Event
from trainctl.scenario.model import Model
from trainctl.signals import Bounds, Consists, Floats, Formed, Ints, Links, References, Seen
from trainctl.stages.orders import Orders
from trainctl.stages.record import Journal
from trainctl.topology import graph
from trainctl.topology.exchange import Radio


class Stack(NamedTuple):
    """R runs of n trains each, N = R n in all."""

    runs: tuple[Model, ...]
    model: Model  # of all N trains; its events, disturbances and seed count for none
    radio: Radio
    signals: Signals  # disturbances of all runs
    formed: Formed
    ways: Ways
    row: Ints  # (N,) of the edge every train starts on in the ways
    lane_position: Floats  # (N,) m, where on it

    @property
    def trains(self) -> int:
        """Trains of one run, n."""
        return len(self.model.scenario.ids) // len(self.runs)

    @property
    def links(self) -> Links:
        """Who receives from whom."""
        assert self.formed.links is not None
        return self.formed.links


def alone(p: Model) -> str | None:
    """Why a run cannot be stacked with others, in words; None if it can."""
    run = p.scenario.run
    if not p.placed:
        return "its trains come and go"
    if p.self_driven:
        return "SUMO drives its trains"
    if p.supervision.mode != "off":
        return "supervisor.mode is not off"
    if any(not _at_once(event) and event.time_s < run.duration_s for event in p.scenario.event):
        return "it has events during the run"
    if p.plant.noise_hold(p.plant_params) is not None:
        return "its plant has noise of its own"
    return None


def _at_once(event: Event) -> bool:
    """Whether another route is ordered at the start, whatever the trains do."""
    at_once = event.kind == "reroute" and event.time_s == 0.0
    return at_once and event.position_m is None and event.gap_below_m is None and event.speed_below_mps is None


def kind(p: Model) -> tuple[Any, ...]:
    """What runs must have in common to be stacked: what is one number for all trains in laws, plants, observers and messages."""
    s, reference = p.scenario, p.reference
    top = s.topology
    return (
        p.law, p.params, p.plant, p.plant_params, p.observer, p.observer_params, id(p.line),
        s.run.model_copy(update={"seed": None}), top.loss, top.delay_s, top.range_m, top.communication_period_s, s.channel, s.fault,
        p.consists.first.tobytes(), s.ids, reference.breaks.tobytes(), reference.position[:, 1:].tobytes(),
        s.bounds.coupler_lower_m, s.bounds.coupler_upper_m,
    )  # fmt: skip


def restarts(p: Model, base: Model) -> bool:
    """Whether a run was made from another one (``build.restarted``): seed and starts are all that differs."""
    return p.params is base.params


def stacked(runs: Sequence[Model]) -> Stack:
    """Lay runs of one ``kind`` side by side.

    Parameters
    ----------
    runs : sequence of Model
        At least one; ``alone`` objects to none of them.
    """
    base, count, n = runs[0], len(runs), len(runs[0].scenario.ids)
    model = _model(runs)
    radio = base.radio
    keys = np.array([draws.key(p.scenario.run.seed or 0) for p in runs], np.int64)
    radio = radio._replace(key=np.repeat(keys, n, axis=0), names=np.tile(radio.names, count))
    laid = _laid(runs, model)
    row = laid.first[:-1].copy()
    seen = laid.begin[row] + model.roster.lane_position
    formation = (_tracks(runs) + len(base.line.track_ids) * np.arange(count)[:, None]).ravel()
    order = graph.order_on_tracks(seen, formation)
    links = _links(runs, order.reshape(count, n) - n * np.arange(count)[:, None], formation.reshape(count, n))
    ahead = np.full(len(order), -1)
    follows = np.flatnonzero(formation[order[1:]] == formation[order[:-1]]) + 1
    ahead[order[follows]] = order[follows - 1]
    references = References(
        np.stack([p.reference.breaks for p in runs]), np.stack([p.reference.position for p in runs]),
        np.repeat(np.arange(count), n),
    )  # fmt: skip
    formed = Formed(links, formation, ahead, np.ones(count * n, bool), np.zeros(count * n), references, (), None)
    return Stack(tuple(runs), model, radio, _signals(runs), formed, laid, row, model.roster.lane_position)


def _tracks(runs: Sequence[Model]) -> Ints:
    """Track of every train at the start, (R, n)."""
    return np.stack([(runs[0] if restarts(p, runs[0]) else p).start_track for p in runs])


def _model(runs: Sequence[Model]) -> Model:
    """One model of all trains. Where faults name trains, their ids tell the run as well."""
    base = runs[0]
    s = base.scenario
    train = tuple(t for p in runs for t in p.scenario.train)
    if s.fault:
        train = tuple(t.model_copy(update={"id": f"{r}/{t.id}"}) for r, p in enumerate(runs) for t in p.scenario.train)
    fault = tuple(f.model_copy(update={"train": f"{r}/{f.train}"}) for r, p in enumerate(runs) for f in p.scenario.fault)
    tables = {name: getattr(s, name) for name in type(s).model_fields}
    scenario = type(s).model_construct(**{**tables, "train": train, "fault": fault, "event": (), "disturbance": ()})
    first = base.consists.first
    units = np.concatenate([[0], np.tile(np.diff(first), len(runs))]).cumsum()
    rows = zip(*(p.consists[1:] for p in runs), strict=True)
    rosters = {
        name: np.concatenate([getattr(p.roster, name) for p in runs])
        for name, value in base.roster._asdict().items()
        if isinstance(value, np.ndarray)
    }
    return replace(
        base, scenario=scenario, consists=Consists(units, *(np.concatenate(row) for row in rows)),
        own=np.concatenate([p.own for p in runs]), roster=base.roster._replace(**rosters),
        bounds=Bounds(*(np.concatenate(row) for row in zip(*(p.bounds for p in runs), strict=True))),
    )  # fmt: skip


def _laid(runs: Sequence[Model], model: Model) -> Ways:
    """The ways of all trains once the orders at the start are given, each laid out once for those that have the same."""
    line, known = runs[0].line, dict[tuple[str, ...], tuple[Ints, Floats]]()

    def laid(routes: Sequence[tuple[str, ...]]) -> list[tuple[Ints, Floats]]:
        for route in routes:
            if route not in known:
                one = ways([[line.index[e] for e in route]], line.start_m, line.length_m)
                known[route] = one.edge, one.begin
        return [known[route] for route in routes]

    routes = [p.roster.routes for p in runs]
    here = _joined([part for some in routes for part in laid(some)])
    if not any(p.scenario.event for p in runs):
        return here
    parts, first, n = list[tuple[Ints, Floats]](), runs[0], len(runs[0].scenario.ids)
    row, speed = here.first[:-1], model.speeds(model.own)
    position, edge, there = here.begin[row] + model.roster.lane_position, here.edge[row], np.ones(n, bool)
    orders, stops_in, joined = Orders(first, _Unheard()), _stops_in(first, speed), dict[tuple[int, ...], Ways]()
    for r, (p, some) in enumerate(zip(runs, routes, strict=True)):
        of = slice(r * n, (r + 1) * n)
        if p.scenario.event:
            before, like = laid(some), restarts(p, first)
            key = tuple(id(edge) for edge, _ in before)
            if key not in joined:
                joined[key] = _joined(before)
            seen = Seen(position[of], edge[of], joined[key].first[:-1], there)
            some = _ordered(
                orders if like else Orders(p, _Unheard()), some, joined[key], seen, speed[of],
                stops_in[of] if like else _stops_in(p, speed[of]),
            )  # fmt: skip
        parts += laid(some)
    return _joined(parts)


def _stops_in(p: Model, speed: Floats) -> Floats:
    """Way in which trains at these speeds [m/s] surely stop, of the same shape [m]: a switch that is nearer is locked."""
    return supervisor.way_to_stop(p.supervision, p.assumed, speed, np.zeros(len(speed)), p.scenario.run.step_s, p.step_theta)


def _joined(parts: Sequence[tuple[Ints, Floats]]) -> Ways:
    first = np.cumsum([0, *(len(edge) for edge, _ in parts)]).astype(np.int64)
    return Ways(first, np.concatenate([edge for edge, _ in parts]), np.concatenate([begin for _, begin in parts]))


def _ordered(
    orders: Orders, routes: Sequence[tuple[str, ...]], here: Ways, seen: Seen, speed: Floats, stops_in: Floats
) -> list[tuple[str, ...]]:  # fmt: skip
    """The routes of a run's trains once the orders at its start are given; the other arguments are as in ``Orders.step``."""
    found = list(routes)
    _, given = orders.step(0.0, seen, here, speed, lambda: stops_in, np.full(len(found), -1), orders.initial())
    for i, edges in given:
        found[i] = edges
    return found


class _Unheard(Journal):
    """Nothing is written of a stacked run."""

    def __init__(self) -> None:
        """Without a folder."""

    def event(self, time: float, kind: str, **fields: object) -> None:
        """Nothing is reported."""


def _links(runs: Sequence[Model], order: Ints, formation: Ints) -> Links:
    """The edge lists of all runs one after the other; ``order`` and ``formation`` (R, n) are those of each run."""
    n = order.shape[1]
    known = np.stack([p.first_links.order for p in runs])
    tracks = np.argsort(np.take_along_axis(formation, known, 1), axis=1, kind="stable")
    # The same but for the order of the tracks, if the trains of each stand in the same order.
    same = (np.take_along_axis(known, tracks, 1) == order).all(axis=1)
    each = [p.first_links if same[r] else graph.links(p.plan, order[r], formation[r]) for r, p in enumerate(runs)]
    count = np.array([len(links.sender) for links in each])
    shift, rows = np.repeat(n * np.arange(len(runs)), count), np.concatenate([[0], np.cumsum(count)])
    joined = Links(*(np.concatenate(column) for column in zip(*each, strict=True)))
    first = np.concatenate([(joined.first.reshape(-1, n + 1)[:, :-1] + rows[:-1, None]).ravel(), rows[-1:]])
    return joined._replace(
        sender=joined.sender + shift, receiver=joined.receiver + shift, first=first,
        order=(order + n * np.arange(len(runs))[:, None]).ravel(),
    )  # fmt: skip


def _signals(runs: Sequence[Model]) -> Signals:
    """The disturbances of all runs."""
    step, first, n, start = runs[0].scenario.run.step_s, runs[0], len(runs[0].scenario.ids), 0

    def of(p: Model) -> Signals:
        return disturbance.signals(p.scenario.disturbance, p.scenario.ids, step, p.scenario.run.seed, p.worst)

    like = of(first)
    drawn = not any(entry.pair for entry in first.scenario.disturbance)  # else they depend on the start
    each = [
        disturbance.reseeded(like, p.scenario.run.seed) if drawn and restarts(p, first) else of(p) for p in runs
    ]  # fmt: skip
    for r, signals in enumerate(each):
        signals.whole[:, TRAIN] += r * n
        signals.whole[:, [TABLE_START, TABLE_END]] += start
        start += len(signals.table)
    whole, number, table, channels, _ = zip(*each, strict=True)
    acted = tuple(sorted({c for some in channels for c in some}))
    return Signals(np.concatenate(whole), np.concatenate(number), np.concatenate(table), acted, n * len(runs))
