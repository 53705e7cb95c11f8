"""From a scenario to the arrays of the loop, and everything that is wrong with it, before anything runs."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

import sumo_net
from sumo_net import Line, LineError, Rails
from trainctl import draws
from trainctl.davis import resistance
from trainctl.errors import InputError
from trainctl.laws import find_law, find_observer, find_plant, unfit
from trainctl.plants import disturbance
from trainctl.railway import supervisor
from trainctl.railway.authority import DRIVER_MARGIN_M
from trainctl.scenario import limits, placing, promise, roster
from trainctl.scenario.reading import examine, mistakes, read
from trainctl.scenario.reference import Profile
from trainctl.scenario.tables import Scenario, Traffic
from trainctl.signals import (
    POSITION,
    SPEED,
    Bounds,
    Consists,
    Floats,
    Ints,
    Links,
    Observer,
    Plant,
    Reference,
    Scene,
    leader_at,
    restrict,
)  # fmt: skip
from trainctl.topology import convoys, graph
from trainctl.topology.exchange import Radio


@dataclass(frozen=True)
class Prepared:
    """A scenario as arrays, and the modules it names. ``spec`` is the line's description, or None if it came as a net."""

    scenario: Scenario
    file: str
    law: Any
    params: Any
    plant: Plant
    plant_params: Any
    observer: Observer
    observer_params: Any
    consists: Consists
    own: Floats
    bounds: Bounds
    reference: Reference
    plan: graph.Plan
    first_links: Links
    line: Any  # Line; None only while mistakes are still being gathered
    spec: Any
    net: Path | None
    roster: Any  # Roster; None like the line

    @property
    def rails(self) -> Rails:
        """The net as a graph, its edges numbered as those of the line."""
        rails: Rails = self.roster.rails
        return rails

    @property
    def placed(self) -> bool:
        """Whether [[train]] tables place the trains: those on one track are a formation with slots. Others come and go."""
        return self.scenario.network.sumocfg is None

    @cached_property
    def supervision(self) -> supervisor.Params:
        """How trains are protected: as the scenario says, else only where they come and go.

        Where the scenario states no emergency braking, and no greatest acceleration, they are the supervisor's usual ones, or more
        if the bounds of the inputs allow the law more: it must not act on what the law may do. No braking is relied on that some
        train cannot give.
        """
        stated = self.scenario.supervisor or supervisor.Params()
        known: dict[str, Any] = {}
        if "mode" not in stated.model_fields_set and not self.placed:
            known["mode"] = "on"
        if "greatest_mps2" not in stated.model_fields_set:
            pulls = self.bounds.input_upper
            known["greatest_mps2"] = float(max([stated.greatest_mps2, *pulls[np.isfinite(pulls)]]))
        if "emergency_mps2" not in stated.model_fields_set:
            v = self.fastest
            brakes = resistance(v, self.consists.train_davis()) - self.bounds.input_lower
            wanted = math.ceil(1000.0 * max([stated.emergency_mps2, *brakes[np.isfinite(brakes)]])) / 1000.0
            known["emergency_mps2"] = min(wanted, float(np.floor(1000.0 * self.sure_braking.min())) / 1000.0)
            known["service_mps2"] = min(stated.service_mps2, known["emergency_mps2"])
        return stated.model_copy(update=known)

    @property
    def fastest(self) -> Floats:
        """Speed up to which every train is looked at [m/s], shape (n,)."""
        upper = self.bounds.speed_upper
        found: Floats = np.where(np.isfinite(upper), upper, max(self.leader(0.0)[1], 1.0))
        return found

    @cached_property
    def sure_braking(self) -> Floats:
        """Deceleration every train can give on the level at any speed it may have [m/s2], shape (n,); infinite for free points."""
        given = self.plant.sure_braking(self.plant_params, self.consists, promise.top_speed(self))
        return np.minimum(given, -self.clamps.input_lower)

    @cached_property
    def clamps(self) -> Bounds:
        """Where the plant itself clamps every train, infinite where it does not.

        It does where [plant] says so, and for a law whose model clamps: then at the train's bounds, the tightest of what is said.
        """
        everywhere = getattr(self.law, "CLAMPED", False)
        return limits.clamps(everywhere, self.plant, self.plant_params, self.bounds)

    @cached_property
    def assumed(self) -> supervisor.Assumed:
        """What the supervisor relies on of every train."""
        return promise.assume(self)

    @property
    def heads(self) -> Ints:
        """Rows of the head units in per-unit arrays, shape (n,)."""
        return self.consists.first[:-1]

    @property
    def sampled(self) -> bool:
        """Whether the law is evaluated once per control period."""
        return bool(self.law.CLOCK == "sampled")

    @property
    def self_driven(self) -> bool:
        """Whether the simulator drives the trains by itself: no law of ours, and no plant."""
        return bool(self.law.CLOCK == "none")

    @property
    def has_units(self) -> bool:
        """Whether every unit of a train moves by itself."""
        return bool(self.plant.UNITS) and not self.self_driven

    @property
    def theta(self) -> float:
        """Lead of the plant: x(k+1) = x + ((1 - theta) v(k) + theta v(k+1)) T_c under a held acceleration."""
        return self.plant.lead(self.scenario.run.held_steps)

    @property
    def step_theta(self) -> float:
        """Lead of the plant over one step of the simulator, as the supervisor counts it."""
        return self.plant.lead(1)

    @cached_property
    def driving(self) -> Traffic:
        """How trains that come and go are driven."""
        return self.scenario.traffic or Traffic()

    @cached_property
    def driver_rules(self) -> supervisor.Params:
        """By what a driver judges: he brakes as planned and keeps farther away, so that the supervisor has nothing to do."""
        rules = self.supervision
        rate = min(self.driving.deceleration_mps2, rules.emergency_mps2)
        return rules.model_copy(update={
            "mode": "on", "emergency_mps2": rate, "service_mps2": rate, "greatest_mps2": self.driving.acceleration_mps2,
            "margin_m": rules.margin_m + DRIVER_MARGIN_M, "emergency_distance_m": 0.0,
        })  # fmt: skip

    @cached_property
    def relied_on_by_driver(self) -> supervisor.Assumed:
        """What a driver relies on of every train."""
        return promise.planned(self.assumed, self.driver_rules.emergency_mps2)

    @property
    def radio(self) -> Radio:
        """How messages travel."""
        run, top = self.scenario.run, self.scenario.topology
        period = top.communication_period_s or run.control_period_s or run.step_s
        names = np.array([draws.word(name) for name in self.scenario.ids], np.int64)
        return Radio(top.loss, round(top.delay_s / period), top.range_m or np.inf, run.seed or 0, names)

    @property
    def spacing(self) -> convoys.Spacing:
        """What every link of a convoy has."""
        top = self.scenario.topology
        return convoys.Spacing(
            float(top.spacing_m or 0.0), -np.inf if top.lower_m is None else top.lower_m,
            np.inf if top.upper_m is None else top.upper_m, top.weight,
        )  # fmt: skip

    @cached_property
    def cruise(self) -> Floats:
        """Speed every driver would like to keep [m/s], shape (n,)."""
        found: Floats = np.minimum(float(self.scenario.reference.speed_mps or 0.0), self.roster.top_speed)
        return found

    @cached_property
    def band(self) -> tuple[float, float]:
        """Least and greatest speed of a convoy's reference that the law takes [m/s]; infinite where there are no convoys."""
        return speed_band(self) if not self.placed and self.roster.cooperates.sum() > 1 else (-math.inf, math.inf)

    @property
    def remembers(self) -> bool:
        """Whether the sampled law keeps a state of its own from one control instant to the next."""
        return self.sampled and hasattr(self.law, "initial")

    @cached_property
    def start_track(self) -> Ints:
        """Track of every train at the start, as index into ``line.track_ids``."""
        return np.array([self.line.track_ids.index(t.track) for t in self.scenario.train], np.int64)

    def scene(self, own: Floats, links: Links, time: float) -> Scene:
        """What the law needs to check itself and to prepare its constants."""
        run = self.scenario.run
        return Scene(
            trains=self.scenario.ids, consists=self.consists, own=own, links=links, bounds=self.bounds, reference=self.reference,
            time=time, step=run.step_s, control_period=run.control_period_s or run.step_s, lead=self.theta,
            sub_step=run.step_s / run.sub_steps if self.plant.UNITS else run.step_s,
        )  # fmt: skip

    @cached_property
    def first_scene(self) -> Scene:
        """The scene at time 0."""
        return self.scene(self.own, self.first_links, 0.0)

    @property
    def worst(self) -> disturbance.Worst | None:
        """The law's own worst disturbance of a pair of trains, if it knows one."""
        function = getattr(self.law, "worst", None)
        return None if function is None else partial(function, self.params, self.first_scene)

    def leader(self, t: float) -> Floats:
        """Position, speed, acceleration and jerk of the reference at ``t``, shape (4,)."""
        out = np.empty(4)
        leader_at(self.reference, t, t, out)
        return out


def open_scenario(name: str, overrides: dict[str, Any] | None = None) -> Prepared:
    """Read, check and prepare a scenario by name or path.

    Raises
    ------
    InputError
        All mistakes that could be found, one line each.
    """
    data, path = read(name, overrides)
    scenario, found = examine(data)
    if scenario is None:
        raise InputError([f"{path.name}: {line}" for line in found])
    return prepare(scenario, path.name, path.parent, found)


def prepare(
    scenario: Scenario, file: str, folder: Path, known: Sequence[str] = (), enrolled: tuple[roster.Roster, Path] | None = None
) -> Prepared:
    """Everything the loop needs, checked.

    Parameters
    ----------
    scenario : Scenario
        As read.
    file : str
        Its name, for the mistakes.
    folder : Path
        Where relative paths in it start.
    known : sequence of str
        Mistakes found before; what is found here is told together with them.
    enrolled : tuple of Roster and Path, optional
        The trains of ``network.sumocfg`` and their net, where the scenario has taken them over already.

    Raises
    ------
    InputError
        All mistakes that could be found, one line each.
    """
    found = list(known)
    trains = None

    def attempt(function: Any, *arguments: Any) -> Any:
        try:
            return function(*arguments)
        except InputError as error:
            found.extend(error.mistakes)
        except LineError as error:
            found.extend(f"network: {m}" for m in error.mistakes)
        return None

    law = attempt(find_law, scenario.controller.law, folder)
    params = attempt(_params, law.Params, scenario.controller.keys(), "controller") if law else None
    observer = attempt(find_observer, scenario.observer.kind)
    observer_params = attempt(_params, observer.Params, scenario.observer.keys(), "observer") if observer else None
    plant: Plant | None = attempt(find_plant, scenario.plant.kind)
    plant_params = attempt(_params, plant.Params, scenario.plant.keys(), "plant") if plant else None
    network: tuple[Line, Any, Path | None] | None
    if scenario.network.sumocfg is not None:
        anew = (scenario, *enrolled) if enrolled is not None else attempt(roster.enrol, scenario, folder)
        if anew is None:
            raise InputError([f"{file}: {line}" for line in found])
        scenario, trains, net = anew
        network = roster.chart(trains.rails), None, net
    else:
        signals_m = partial(law.signals_m, params) if params is not None and hasattr(law, "signals_m") else None
        network = attempt(_network, scenario, folder, signals_m)
    plan = attempt(_plan, scenario)
    misplaced = placing.on_the_line(scenario, network[0]) if network is not None and trains is None else []
    found += misplaced
    if plant is None or any(part is None for part in (law, params, observer, observer_params, plant_params, plan)):
        raise InputError([f"{file}: {line}" for line in found])

    consists = scenario.consists()
    bounds = limits.of_trains(scenario, plant, plant_params, consists)
    # Trains that come and go are checked as the one formation they could be.
    placed = scenario if trains is None else roster.in_formation(scenario, plan.slot)
    own = _initial(placed, plant, consists)
    track = np.unique([t.track for t in placed.train], return_inverse=True)[1].astype(np.int64)
    front = int(np.argmin(plan.place))
    start = own[consists.first[front], POSITION] - scenario.topology.first_slot_m
    if scenario.reference.follow_line:
        followed = attempt(placing.followed, scenario, network and network[0], plan, consists, start, front)
        scenario = scenario.model_copy(update={"reference": followed or Profile(speed_mps=scenario.train[front].speed_mps)})
    reference = scenario.reference.leader(start)
    first = graph.links(plan, graph.order_on_tracks(own[consists.first[:-1], POSITION], track), track)
    prepared = Prepared(
        scenario=limits.resolved(scenario, bounds), file=file, law=law, params=params, plant=plant, plant_params=plant_params,
        observer=observer, observer_params=observer_params, consists=consists, own=own, bounds=bounds, reference=reference,
        plan=plan, first_links=first, line=None, spec=None, net=None, roster=None,
    )  # fmt: skip
    unfit = _fits(prepared)
    found += unfit or [
        *_connected(prepared),
        *law.violations(params, prepared.first_scene),
        *observer.violations(observer_params, prepared.first_scene),
    ]  # fmt: skip
    if network is not None:
        prepared = replace(prepared, line=network[0], spec=network[1], net=network[2])
        slopes = np.column_stack([network[0].gradient.breaks, network[0].gradient.slope])
        if slopes[:, 1].any():  # actuators hold their trains where they start
            prepared = replace(prepared, own=plant.balanced(own, consists, slopes))
        if trains is not None:
            n = len(scenario.train)
            nobody = graph.links(plan, np.arange(n), np.arange(n))  # everybody alone
            start = _initial(scenario, plant, consists)
            prepared = replace(prepared, own=start, first_links=nobody, roster=trains)
        elif law.CLOCK != "none":  # such trains leave at the line's end
            found += placing.long_enough(prepared)
        found += placing.steep(prepared)
        if trains is None and not misplaced:
            prepared = replace(prepared, roster=roster.placed(scenario, network[0]))
        if prepared.roster is not None:
            found += _can_brake(prepared) or promise.refusals(prepared)
    if found:
        # What follows from a key that is wrong already is not a mistake of its own.
        wrong = [line.partition(" = ")[0].partition(":")[0].rpartition(".")[2] for line in known]
        news = [line for line in found[len(known) :] if not any(f"{key} = " in line for key in wrong)]
        raise InputError([f"{file}: {line}" for line in dict.fromkeys([*known, *news])])
    if prepared.scenario.supervisor is None and trains is None:
        return prepared
    # What it came to is logged, so that a run can go on from its log.
    stated = prepared.scenario.model_copy(update={"supervisor": prepared.supervision})
    return replace(prepared, scenario=stated)


def _can_brake(p: Prepared) -> list[str]:
    """Whether every train can do what the supervisor relies on."""
    rules = p.supervision
    short = np.flatnonzero(p.sure_braking < rules.emergency_mps2 - 1e-9) if rules.mode != "off" else np.zeros(0, np.int64)
    if not len(short):
        return []
    i = int(short[np.argmin(p.sure_braking[short])])
    least, among = p.sure_braking[i], f" (and {len(short) - 1} other trains too little)" if len(short) > 1 else ""
    return [
        f"supervisor.emergency_mps2 = {rules.emergency_mps2:g}: train {p.scenario.ids[i]} can brake with {least:.6g} m/s2 at"
        f" most{among}"
    ]


def _params(model: Any, keys: dict[str, Any], table: str) -> Any:
    try:
        return model.model_validate_json(json.dumps(keys))
    except ValidationError as error:
        raise InputError(mistakes(error, keys, table, model)) from None


def _network(scenario: Scenario, folder: Path, signals_m: Callable[[float | None], float] | None) -> tuple[Line, Any, Path | None]:
    """The line, its description and its net; ``signals_m`` is how far apart the law wants signals, from what the line states."""
    network = scenario.network
    if network.net is not None:
        path = folder / network.net
        return Line.read(path), None, path
    name = str(network.line)
    known = sumo_net.shipped()
    if name not in known and not name.endswith(".toml"):
        raise InputError(f"network.line = {name}: no such line; known: {', '.join(known)}, or the path of a line .toml")
    spec = sumo_net.read_spec(known.get(name, folder / name))
    if signals_m is not None:
        spec = spec.model_copy(update={"signals_m": signals_m(spec.signals_m)})
        spec = sumo_net.parse_spec(spec.model_dump(mode="json", by_alias=True, exclude_none=True), spec.name)
    return Line.of(spec), spec, None


def _plan(scenario: Scenario) -> graph.Plan:
    """The topology's rule as arrays; what is missing is told."""
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
        period = _exchange_period(scenario)
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


def _exchange_period(scenario: Scenario) -> float:
    run = scenario.run
    return scenario.topology.communication_period_s or run.control_period_s or run.step_s


def _initial(scenario: Scenario, plant: Plant, consists: Consists) -> Floats:
    """State of all units at time 0: couplers at rest and one speed, unless the train says otherwise. Shape (U, STATES)."""
    own = np.zeros((len(consists.length), 2))
    for i, t in enumerate(scenario.train):
        a, b = consists.first[i], consists.first[i + 1]
        back = np.concatenate([[0.0], np.cumsum(consists.length[a : b - 1] + np.asarray(t.coupler_m or 0.0))])
        own[a:b, POSITION] = t.position_m - back
        own[a:b, SPEED] = t.speed_mps if t.unit_speed_mps is None else t.unit_speed_mps
    return plant.balanced(own, consists)


def _fits(p: Prepared) -> list[str]:
    """Law, plant and observer that do not go together, bounds no train can keep, a line that is too short."""
    found = (
        [] if p.law.CLOCK == "none" else unfit(p.law, p.scenario.controller.law, p.scenario.plant.kind, p.scenario.observer.kind)
    )
    for i, t in enumerate(p.scenario.train):
        for key, low, high in (
            ("speed", p.bounds.speed_lower[i], p.bounds.speed_upper[i]),
            ("input", p.bounds.input_lower[i], p.bounds.input_upper[i]),
        ):
            if not low < high:
                found.append(f"train[{t.id}]: {key} bounds {low:g} .. {high:g} are empty")
    if p.self_driven:
        return found + list(p.law.unfit(p.scenario))
    found += [*_messages_fit(p), *_disturbances_fit(p)]
    if p.sampled:
        least, greatest = limits.room(p.scenario.bounds_of_trains(), p.plant, p.consists)
        for i, t in enumerate(p.scenario.train):
            if p.bounds.input_lower[i] < least[i] - 1e-12:
                found.append(
                    f"train[{t.id}].input_lower_mps2 = {p.bounds.input_lower[i]:g}: its units can brake with"
                    f" {-least[i]:.6g} m/s2 at most"
                )
            if p.bounds.input_upper[i] > greatest[i] + 1e-12:
                found.append(
                    f"train[{t.id}].input_upper_mps2 = {p.bounds.input_upper[i]:g}: its units can give"
                    f" {greatest[i]:.6g} m/s2 at most in the speed band"
                )
    return found


def _messages_fit(p: Prepared) -> list[str]:
    """Exchange periods, loss and delay against the law's clock."""
    run, top = p.scenario.run, p.scenario.topology
    period = top.communication_period_s
    if p.sampled:
        return (
            []
            if period is None
            else ["topology.communication_period_s: sampled laws exchange once per control period; leave it out"]
        )
    if period is None:
        return (
            ["topology.communication_period_s: missing; loss and delay need messages sent at instants"]
            if top.loss + top.delay_s > 0
            else []
        )
    ratio = run.step_s / period
    if min(abs(ratio - round(ratio)), abs(1 / ratio - round(1 / ratio))) > 1e-9:
        return [f"topology.communication_period_s = {period:g}: must divide step_s = {run.step_s:g} or be a multiple of it"]
    h = run.step_s / run.sub_steps
    if abs(period / h - round(period / h)) > 1e-6:
        return [f"topology.communication_period_s = {period:g}: must be a multiple of the integrator's step {h:g} s"]
    return []


def _disturbances_fit(p: Prepared) -> list[str]:
    """Disturbances this law and plant cannot take, and what is wrong in themselves, or in the plant."""
    scenario = p.scenario
    found = disturbance.violations(scenario.disturbance, scenario.ids, scenario.run.seed, hasattr(p.law, "worst"))
    for k, entry in enumerate(scenario.disturbance, 1):
        if entry.on == "measurement" and not p.sampled:
            found.append(f"disturbance[{k}].on = measurement: needs a sampled law; a continuous one has no instants to measure at")
    found += p.plant.violations(p.plant_params, p.first_scene, scenario.fault)
    if p.plant.noise_hold(p.plant_params) is not None and scenario.run.seed is None:
        found.append("run.seed: missing; the plant's noise is random")
    return found


def _connected(p: Prepared) -> list[str]:
    """Assumption of every law: the graph of a formation is connected. Trains alone on a track are formations of their own."""
    links = p.first_scene.links
    groups = graph.components(len(p.scenario.train), links.sender, links.receiver)
    if p.plan.rule == "links" and len(groups) > 1:
        named = " | ".join(", ".join(p.scenario.ids[i] for i in g) for g in groups)
        return [f"topology: the graph of the [[link]] tables is not connected: {named}"]
    return []


#: How exactly the band is found [m/s].
BAND_MPS = 0.05


def speed_band(p: Prepared) -> tuple[float, float]:
    """Least and greatest speed of a reference with which the law takes one train of each kind as a formation [m/s]."""
    spacing = p.spacing
    cruise = float(p.scenario.reference.speed_mps or 0.0)
    kinds = np.unique([t.type for t in p.scenario.train], return_index=True)[1]
    others = np.setdiff1d(np.arange(len(p.scenario.train)), kinds)
    members = np.sort(np.concatenate([kinds, others[: max(2 - len(kinds), 0)]]))
    ahead: Ints = np.full(len(p.scenario.train), -1)
    ahead[members[1:]] = members[:-1]
    order = convoys.front_to_rear(ahead)
    slot = convoys.slots(ahead, order, spacing.desired, np.zeros(len(ahead)))
    links = convoys.links(ahead, order, slot, spacing)
    units, own = np.diff(p.consists.first), p.own.copy()
    own[:, POSITION] += np.repeat(slot - own[p.heads, POSITION], units)

    def takes(v: float) -> bool:
        own[:, SPEED] = v
        scene = p.scene(own, links, 0.0)._replace(reference=Reference(np.array([0.0, np.inf]), np.array([[0.0, v, 0.0]])))
        return not p.law.violations(p.params, restrict(scene, members))

    def end(good: float, bad: float) -> float:
        if takes(bad):
            return bad
        while abs(good - bad) > BAND_MPS:
            middle = 0.5 * (good + bad)
            good, bad = (middle, bad) if takes(middle) else (good, middle)
        return good

    top = cruise + (p.driving).catch_up_mps
    return end(cruise, 0.0), end(cruise, top)
