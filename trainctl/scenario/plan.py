"""The formation rule, the first state and the bounds of a scenario as arrays."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from trainctl.contracts import Plant
from trainctl.errors import InputError
from trainctl.scenario import placing
from trainctl.scenario.tables import Scenario
from trainctl.signals import POSITION, SPEED, Consists, Floats
from trainctl.topology import graph


def plan_of(scenario: Scenario) -> graph.Plan:
    """The topology's rule as arrays; what is missing is reported."""
    top, ids = scenario.topology, scenario.ids
    index = {name: i for i, name in enumerate(ids)}
    said: dict[tuple[int, int], graph.Stated] = {}
    found = []
    for k, link in enumerate(scenario.link, 1):
        a, b = (index[i] for i in link.ends)
        if (a, b) in said:
            found.append(f"link[{k}]: trains {', '.join(link.ends)} have a link already")
        said[a, b] = graph.Stated(link.desired_m, link.lower_m, link.upper_m, link.weight)
        if link.between:
            low, high = (None if x is None else -x for x in (link.upper_m, link.lower_m))
            said[b, a] = graph.Stated(None if link.desired_m is None else -link.desired_m, low, high, link.weight)
    place = placing.places(scenario)
    found += placing.against_the_order(scenario, place)
    rows = []
    for k, m in pairwise(np.argsort(place).tolist()):
        own = said.get((k, m), graph.Stated(None, None, None, None))
        desired = own.desired if own.desired is not None else top.spacing_m
        lower = own.lower if own.lower is not None else top.lower_m
        upper = own.upper if own.upper is not None else top.upper_m
        if desired is None:
            found.append(f"topology.spacing_m: missing, and no [[link]] states desired_m between trains {ids[k]} and {ids[m]}")
        rows.append((desired or 0.0, -math.inf if lower is None else lower, math.inf if upper is None else upper))
    if top.rule == "links" and not scenario.link and len(ids) > 1:
        found.append('topology.rule = links: there is no [[link]]; rule = "same_track" makes links by itself')
    if top.delay_s > 0:
        period = exchange_period(scenario)
        if abs(top.delay_s / period - round(top.delay_s / period)) > 1e-6:
            found.append(f"topology.delay_s = {top.delay_s:g}: must be a multiple of the exchange period {period:g} s")
    if found:
        raise InputError(found)
    table = np.array(rows, float).reshape(len(rows), 3)
    pairs = [(tuple(index[i] for i in link.ends), link) for link in scenario.link]
    both = [(a, b) for (a, b), link in pairs] + [(b, a) for (a, b), link in pairs if link.between]
    return graph.Plan(
        rule=top.rule, equal=top.desired == "equal", first_slot=top.first_slot_m,
        desired=table[:, 0].copy(), lower=table[:, 1].copy(), upper=table[:, 2].copy(), weight=top.weight, stated=said,
        extra=tuple((a, b) for (a, b), link in pairs if link.extra),
        fixed=tuple(both) if top.rule == "links" else (), place=place,
    )  # fmt: skip


def exchange_period(scenario: Scenario) -> float:
    """Time between two exchanges of messages [s]."""
    run = scenario.run
    return scenario.topology.communication_period_s or run.control_period_s or run.step_s


def initial(scenario: Scenario, plant: Plant, consists: Consists) -> Floats:
    """State of all units at time 0: couplers at rest and one speed, unless the train says otherwise. Shape (U, STATES)."""
    own = np.zeros((len(consists.length), 2))
    for i, t in enumerate(scenario.train):
        a, b = consists.first[i], consists.first[i + 1]
        back = np.concatenate([[0.0], np.cumsum(consists.length[a : b - 1] + np.asarray(t.coupler_m or 0.0))])
        own[a:b, POSITION] = t.position_m - back
        own[a:b, SPEED] = t.speed_mps if t.unit_speed_mps is None else t.unit_speed_mps
    return plant.balanced(own, consists)
