"""Runs side by side as one scene: their trains one after the other, each run a world of its own.

Nothing links trains of two runs, so whatever is computed train by train or link by link gives every run the numbers it has alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from trainctl.plants import disturbance
from trainctl.plants.disturbance import END as TABLE_END
from trainctl.plants.disturbance import START as TABLE_START
from trainctl.plants.disturbance import TRAIN, Signals
from trainctl.railway import supervisor
from trainctl.railway.ways import Ways, ways
from trainctl.scenario.events import Event
from trainctl.scenario.model import Model
from trainctl.signals import SPEED, Bounds, Consists, Floats, Formed, Ints, Links, References, Seen
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


def stacked(runs: Sequence[Model]) -> Stack:
    """Lay runs of one ``kind`` side by side.

    Parameters
    ----------
    runs : sequence of Model
        At least one; ``alone`` objects to none of them.
    """
    base, count, n = runs[0], len(runs), len(runs[0].scenario.ids)
    model = _model(runs)
    radios = [p.radio for p in runs]
    radio = radios[0]._replace(
        key=np.concatenate([r.key for r in radios]), names=np.concatenate([r.names for r in radios])
    )  # fmt: skip
    laid = _laid(runs)
    row = laid.first[:-1].copy()
    lane_position = np.concatenate([p.roster.lane_position for p in runs])
    seen = laid.begin[row] + lane_position
    tracks = len(base.line.track_ids)
    formation = np.concatenate([p.start_track + tracks * r for r, p in enumerate(runs)])
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
    return Stack(tuple(runs), model, radio, _signals(runs), formed, laid, row, lane_position)


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


def _laid(runs: Sequence[Model]) -> Ways:
    """The ways of all trains once the orders at the start are given, each laid out once for those that have the same."""
    line, known = runs[0].line, dict[tuple[str, ...], tuple[Ints, Floats]]()

    def laid(routes: Sequence[tuple[str, ...]]) -> list[tuple[Ints, Floats]]:
        for route in routes:
            if route not in known:
                one = ways([[line.index[e] for e in route]], line.start_m, line.length_m)
                known[route] = one.edge, one.begin
        return [known[route] for route in routes]

    parts = []
    for p in runs:
        here = laid(p.roster.routes)
        parts += laid(_ordered(p, _joined(here))) if p.scenario.event else here
    return _joined(parts)


def _joined(parts: Sequence[tuple[Ints, Floats]]) -> Ways:
    first = np.cumsum([0, *(len(edge) for edge, _ in parts)]).astype(np.int64)
    return Ways(first, np.concatenate([edge for edge, _ in parts]), np.concatenate([begin for _, begin in parts]))


def _ordered(p: Model, here: Ways) -> list[tuple[str, ...]]:
    """The routes of a run's trains once the orders at its start are given; ``here`` are their ways before."""
    routes: list[tuple[str, ...]] = list(p.roster.routes)
    row, speed, nobody = here.first[:-1], p.own[p.leading, SPEED], np.full(len(routes), -1)
    seen = Seen(here.begin[row] + p.roster.lane_position, here.edge[row], row, np.ones(len(routes), bool))
    stops_in = supervisor.way_to_stop(
        p.supervision, p.assumed, speed, np.zeros(len(routes)), p.scenario.run.step_s, p.step_theta
    )  # fmt: skip
    orders = Orders(p, _Unheard())
    _, given = orders.step(0.0, seen, here, speed, lambda: stops_in, nobody, orders.initial())
    for i, edges in given:
        routes[i] = edges
    return routes


class _Unheard(Journal):
    """Nothing is written of a stacked run."""

    def __init__(self) -> None:
        """Without a folder."""

    def event(self, time: float, kind: str, **fields: object) -> None:
        """Nothing is reported."""


def _links(runs: Sequence[Model], order: Ints, formation: Ints) -> Links:
    """The edge lists of all runs one after the other; ``order`` and ``formation`` (R, n) are those of each run."""
    each = []
    for p, o, f in zip(runs, order, formation, strict=True):
        links = p.first_links  # the same but for the order of the tracks, if the trains of each stand in the same order
        same = np.array_equal(links.order[np.argsort(f[links.order], kind="stable")], o)
        each.append(links._replace(order=o) if same else graph.links(p.plan, o, f))
    n = order.shape[1]
    count = np.array([len(links.sender) for links in each])
    shift, rows = np.repeat(n * np.arange(len(runs)), count), np.concatenate([[0], np.cumsum(count)])
    joined = Links(*(np.concatenate(column) for column in zip(*each, strict=True)))
    first = np.concatenate([*(links.first[:-1] + r for links, r in zip(each, rows[:-1], strict=True)), rows[-1:]])
    return joined._replace(
        sender=joined.sender + shift, receiver=joined.receiver + shift, first=first,
        order=joined.order + np.repeat(n * np.arange(len(runs)), n),
    )  # fmt: skip


def _signals(runs: Sequence[Model]) -> Signals:
    """The disturbances of all runs."""
    run = runs[0].scenario.run
    each = [disturbance.signals(p.scenario.disturbance, p.scenario.ids, run.step_s, p.scenario.run.seed, p.worst) for p in runs]
    n, start = len(runs[0].scenario.ids), 0
    for r, signals in enumerate(each):
        signals.whole[:, TRAIN] += r * n
        signals.whole[:, [TABLE_START, TABLE_END]] += start
        start += len(signals.table)
    whole, number, table, _ = zip(*each, strict=True)
    return Signals(np.concatenate(whole), np.concatenate(number), np.concatenate(table), n * len(runs))
