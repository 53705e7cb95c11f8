"""A scenario as arrays, with the modules it names and the numbers that follow from it."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from sumo_net import Rails
from trainctl import draws
from trainctl.contracts import Observer, Plant
from trainctl.davis import resistance
from trainctl.plants import disturbance
from trainctl.railway import signs, supervisor
from trainctl.railway.authority import DRIVER_MARGIN_M
from trainctl.railway.signs import Signs
from trainctl.scenario import limits, promise
from trainctl.scenario.channel import exchanges
from trainctl.scenario.tables import Scenario, TrafficTable
from trainctl.signals import (
    POSITION,
    SPEED,
    Bools,
    Bounds,
    Consists,
    Floats,
    Ints,
    Links,
    Reference,
    Scene,
    leader_at,
    restrict,
    turned_rows,
)
from trainctl.topology import convoys, graph
from trainctl.topology.exchange import Radio

#: Arrays of a roster with one row per train.
PER_TRAIN = ("depart", "edge", "lane_position", "arrival", "speed", "top_speed", "speed_factor", "cooperates", "driven")


@dataclass(frozen=True)
class Model:
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

    @cached_property
    def signs(self) -> Signs:
        """Variable speed signs."""
        return signs.signs(self.roster.signs, self.rails.index)

    @property
    def rerouted(self) -> bool:
        """Whether trains may be given other routes than they begin with."""
        return any(event.kind == "reroute" for event in self.scenario.event) or bool(self.roster.closings or self.roster.choices)

    @cached_property
    def braked(self) -> bool:
        """Whether trains may be ordered to brake."""
        return any(event.kind == "brake" for event in self.scenario.event)

    @property
    def placed(self) -> bool:
        """Whether [[train]] tables place the trains: those on one track are a formation with slots. Others come and go."""
        return self.scenario.network.sumocfg is None

    @cached_property
    def supervision(self) -> supervisor.Params:
        """How trains are protected: as the scenario says, else only where they come and go.

        Where the scenario states no emergency braking, and no maximum acceleration, they are the supervisor's usual ones, or more
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
            own = ~self.roster.driven
            ours = self.sure_braking[own if own.any() else slice(None)].min()
            wanted = math.ceil(1000.0 * max([stated.emergency_mps2, *brakes[np.isfinite(brakes)]])) / 1000.0
            known["emergency_mps2"] = min(wanted, float(np.floor(1000.0 * ours)) / 1000.0)
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

    @cached_property
    def leading(self) -> Ints:
        """Rows of the head units in per-unit arrays, shape (n,)."""
        return self.consists.first[:-1]

    def speeds(self, own: Floats) -> Floats:
        """Speeds of the head units in ``own`` (U, s), contiguous, shape (n,) [m/s]."""
        return np.ascontiguousarray(own[:, SPEED] if len(own) == len(self.consists.first) - 1 else own[self.leading, SPEED])

    def fronts(self, own: Floats) -> Floats:
        """Positions of the head units in ``own`` (U, s), shape (n,) [m]; not to be written into."""
        return own[:, POSITION] if len(own) == len(self.consists.first) - 1 else own[self.leading, POSITION]

    @property
    def sampled(self) -> bool:
        """Whether the law is evaluated once per control period."""
        return bool(self.law.CLOCK == "sampled")

    @property
    def self_driven(self) -> bool:
        """Whether the simulator drives the trains by itself: no law of ours, and no plant."""
        return bool(self.law.CLOCK == "none")

    @property
    def obeys(self) -> bool:
        """Whether trains obey the rail signals of their net, and SUMO perhaps drives some of them."""
        return self.roster.handed is not None

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
    def driving(self) -> TrafficTable:
        """How trains that come and go are driven."""
        return self.scenario.traffic or TrafficTable()

    @cached_property
    def driver_acceleration(self) -> Floats:
        """With which a driver accelerates every train [m/s2], shape (n,)."""
        return self._driven_with("driven_acceleration_mps2", self.driving.acceleration_mps2)

    @cached_property
    def driver_braking(self) -> Floats:
        """With which a driver brakes every train [m/s2], shape (n,)."""
        return np.minimum(
            self._driven_with("driven_deceleration_mps2", self.driving.deceleration_mps2), self.supervision.emergency_mps2
        )

    def _driven_with(self, key: str, usual: float) -> Floats:
        """A key of the types of all trains, shape (n,), ``usual`` where it is not stated."""
        said = {name: getattr(kind, key) for name, kind in self.scenario.train_type.items()}
        own = [said[t.type] for t in self.scenario.train]
        return np.array([usual if value is None else value for value in own], float)

    @cached_property
    def driver_rules(self) -> supervisor.Params:
        """By what a driver judges: he brakes as planned and keeps farther away, so that the supervisor has nothing to do."""
        rules = self.supervision
        rate, pull = float(self.driver_braking.max()), float(self.driver_acceleration.max())
        return rules.model_copy(update={
            "mode": "on", "emergency_mps2": rate, "service_mps2": rate, "greatest_mps2": pull,
            "margin_m": rules.margin_m + DRIVER_MARGIN_M, "emergency_distance_m": 0.0,
        })  # fmt: skip

    @cached_property
    def relied_on_by_driver(self) -> supervisor.Assumed:
        """What a driver relies on of every train."""
        return promise.planned(self.assumed, self.driver_braking)

    @property
    def driven(self) -> bool:
        """Whether a driver drives who is in no formation; else the law leads every train, or SUMO does."""
        return not (self.placed or self.self_driven)

    @property
    def looks_ahead(self) -> bool:
        """Whether anything asks what is ahead of a train: its driver, or the supervisor."""
        return self.driven or self.supervision.mode != "off"

    @cached_property
    def net_slope(self) -> Floats:
        """Slope of every edge, rise / run, (E,); 0 on a line, whose gradient is known by the kilometrage."""
        return np.zeros_like(self.rails.slope) if self.placed else self.rails.slope

    @property
    def radio(self) -> Radio:
        """How messages travel."""
        run, top = self.scenario.run, self.scenario.topology
        period = top.communication_period_s or run.control_period_s or run.step_s
        names = np.array([draws.word(name) for name in self.scenario.ids], np.int64)
        key = np.tile(np.array(draws.key(run.seed or 0), np.int64), (len(names), 1))
        c, of = self.scenario.channel, {name: i for i, name in enumerate(self.scenario.ids)}
        outages = [(of.get(e.train, -1), e.time_s, e.until_s) for e in self.scenario.event if e.kind == "outage"]
        return Radio(
            top.loss, round(top.delay_s / period), top.range_m or np.inf, key, names, 1.0 if c.bad_loss is None else c.bad_loss,
            period / c.good_s if c.good_s else 0.0, period / c.bad_s if c.bad_s else 1.0, c.delay_spread_s / period,
            c.delay_shape == "exponential", -1.0 if c.send_beyond_m is None else c.send_beyond_m,
            exchanges(c.send_every_s or 0.0, period), np.array(outages, np.float64).reshape(-1, 3),
        )  # fmt: skip

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
        """Minimum and maximum speed of a convoy's reference that the law takes [m/s]; infinite where there are no convoys."""
        return speed_band(self) if not self.placed and self.roster.cooperates.sum() > 1 else (-math.inf, math.inf)

    @cached_property
    def remembers(self) -> bool:
        """Whether the sampled law keeps a state of its own from one control instant to the next."""
        return self.sampled and hasattr(self.law, "initial")

    @cached_property
    def start_track(self) -> Ints:
        """Track of every train at the start, as index into ``line.track_ids``."""
        number = {name: k for k, name in enumerate(self.line.track_ids)}
        return np.array([number[t.track] for t in self.scenario.train], np.int64)

    def scene(self, own: Floats, links: Links, time: float) -> Scene:
        """What the law needs to check itself and to prepare its constants."""
        run = self.scenario.run
        return Scene(
            trains=self.scenario.ids, consists=self.consists, own=own, links=links, bounds=self.bounds, reference=self.reference,
            time=time, step=run.step_s, control_period=run.control_period_s or run.step_s, lead=self.theta,
            sub_step=run.step_s / run.sub_steps if self.plant.UNITS else run.step_s,
        )  # fmt: skip

    @cached_property
    def unit(self) -> Ints:
        """Number of every unit in its train as it was built, from 1, shape (U,)."""
        first = self.consists.first
        found: Ints = np.arange(first[-1]) - np.repeat(first[:-1], np.diff(first)) + 1
        return found

    def turned(self, turned: Bools) -> Model:
        """The same with some trains (n,) turned round, their units in the opposite order; what holds of whole trains stays.

        Lists of [controller] and [observer], one number per carriage, count from the head as a train runs.
        """
        units = np.diff(self.consists.first)
        if not (turned & (units > 1)).any():
            return self
        last = {self.scenario.ids[i]: int(units[i]) for i in np.flatnonzero(turned).tolist()}
        faults = tuple(
            f.model_copy(update={"unit": last[f.train] + 1 - f.unit}) if f.train in last else f for f in self.scenario.fault
        )
        found = copy.copy(self)
        found.__dict__["consists"] = self.consists.turned(turned)
        found.__dict__["scenario"] = self.scenario.model_copy(update={"fault": faults})
        found.__dict__["unit"] = self.unit[turned_rows(self.consists.first, turned)]
        return found

    @cached_property
    def further_edges(self) -> Ints:
        """Edges that other trains of a longer roster run over."""
        return np.zeros(0, np.int64)

    def some(self, trains: Ints, further_edges: Ints) -> Model:
        """The same with these trains (k,) only, ascending, of a roster; what holds of all trains together stays.

        Disturbances, events and other tables that name trains are not followed.
        """
        whole = self.supervision, self.driver_rules, self.band, self.net_slope, self.signs  # worked out of all trains
        assert len(whole)
        members, roster = trains.tolist(), self.roster
        units = np.isin(np.repeat(np.arange(len(self.consists.first) - 1), np.diff(self.consists.first)), trains)
        first = np.concatenate([[0], np.cumsum(np.diff(self.consists.first)[trains])]).astype(np.int64)
        of_units: list[Any] = [rows[units] if len(rows) else rows for rows in self.consists[1:]]
        arrays = {name: rows[trains] for name, rows in roster._asdict().items() if name in PER_TRAIN}
        tuples = {name: tuple(getattr(roster, name)[i] for i in members) for name in ("like", "legs", "stops", "vclass")}
        scenario = self.scenario.model_copy(update={"train": tuple(self.scenario.train[i] for i in members)})
        scenario.__dict__.pop("ids", None)
        found = copy.copy(self)
        for known in ("first_scene", "leading", "sure_braking", "unit"):
            found.__dict__.pop(known, None)
        found.__dict__.update(
            scenario=scenario, consists=Consists(first, *of_units), own=self.own[units], roster=roster._replace(**arrays, **tuples),
            bounds=Bounds(*(rows[trains] for rows in self.bounds)), clamps=Bounds(*(rows[trains] for rows in self.clamps)),
            assumed=_rows(self.assumed, trains), relied_on_by_driver=_rows(self.relied_on_by_driver, trains),
            driver_acceleration=self.driver_acceleration[trains], driver_braking=self.driver_braking[trains],
            cruise=self.cruise[trains], start_track=self.start_track[trains], further_edges=further_edges,
        )  # fmt: skip
        return found

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


def _rows(assumed: supervisor.Assumed, trains: Ints) -> supervisor.Assumed:
    """What is assumed of some trains."""
    found: dict[str, Any] = {name: part[trains] for name, part in assumed._asdict().items() if isinstance(part, np.ndarray)}
    return assumed._replace(**found)


#: How exactly the band is found [m/s].
BAND_MPS = 0.05


def speed_band(p: Model) -> tuple[float, float]:
    """Minimum and maximum speed of a reference with which the law takes one train of each kind as a formation [m/s]."""
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
    own[:, POSITION] += np.repeat(slot - own[p.leading, POSITION], units)

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
