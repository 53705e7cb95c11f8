"""Whether law, plant, observer, exchange and disturbances of a scenario go together."""

from __future__ import annotations

import numpy as np

from trainctl.laws import unfit
from trainctl.plants import disturbance
from trainctl.scenario.limits import room
from trainctl.scenario.model import Model
from trainctl.topology import graph


def can_brake(p: Model) -> list[str]:
    """Whether every train can do what the supervisor relies on."""
    rules = p.supervision
    if rules.mode != "off" and (off := _masses_off(p)):
        return [f"{said}: supervisor.mode must be off, since it relies on the stated masses" for said in off]
    short = np.flatnonzero(p.sure_braking < rules.emergency_mps2 - 1e-9) if rules.mode != "off" else np.zeros(0, np.int64)
    if not len(short):
        return []
    i = int(short[np.argmin(p.sure_braking[short])])
    minimum, among = p.sure_braking[i], f" (and {len(short) - 1} other trains brake too weakly, too)" if len(short) > 1 else ""
    return [
        f"supervisor.emergency_mps2 = {rules.emergency_mps2:g}: train {p.scenario.ids[i]} can brake with {minimum:.6g} m/s2 at"
        f" most{among}"
    ]


def _masses_off(p: Model) -> list[str]:
    """Masses that are not as stated, as keys and values."""
    kinds = p.scenario.train_type.items()
    return [
        f"train_type.{name}.mass_error_percent = {kind.mass_error_percent:g}" for name, kind in kinds if kind.mass_error_percent
    ]


def fits(p: Model) -> list[str]:
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
    if not p.has_units:
        found += [f"{said}: needs a plant with units" for said in _masses_off(p)]
    if not p.sampled:
        found += [
            f"train_type.{name}.force_share = installed: law {p.scenario.controller.law} gives every unit its own force"
            for name, kind in p.scenario.train_type.items() if kind.force_share == "installed"
        ]  # fmt: skip
    horizon = p.law.horizon_s(p.params, p.first_scene) if hasattr(p.law, "horizon_s") else 0.0
    if horizon > (lasts := p.scenario.run.duration_s):
        found.append(
            f"controller.horizon = {p.params.horizon}: looks {horizon:g} s ahead, and the run lasts run.duration_s = {lasts:g}"
        )
    if p.sampled:
        minimum, maximum = room(p.scenario.bounds_of_trains(), p.plant, p.consists)
        for i, t in enumerate(p.scenario.train):
            if p.bounds.input_lower[i] < minimum[i] - 1e-12:
                found.append(
                    f"train[{t.id}].input_lower_mps2 = {p.bounds.input_lower[i]:g}: its units can brake with"
                    f" {-minimum[i]:.6g} m/s2 at most"
                )
            if p.bounds.input_upper[i] > maximum[i] + 1e-12:
                found.append(
                    f"train[{t.id}].input_upper_mps2 = {p.bounds.input_upper[i]:g}: its units can give"
                    f" {maximum[i]:.6g} m/s2 at most in the speed band"
                )
    return found


def _messages_fit(p: Model) -> list[str]:
    """Exchange periods, loss and delay against the law's clock."""
    run, top, channel = p.scenario.run, p.scenario.topology, p.scenario.channel
    period = top.communication_period_s
    short = channel.too_short(period or run.control_period_s or run.step_s)
    if p.sampled:
        strange = "topology.communication_period_s: sampled laws exchange once per control period; leave it out"
        return short + ([] if period is None else [strange])
    if period is None:
        outage = any(event.kind == "outage" for event in p.scenario.event)
        instants = "topology.communication_period_s: missing; loss, delay and the channel need messages sent at instants"
        return [instants] if top.loss + top.delay_s > 0 or outage or not channel.usual else []
    if short:
        return short
    ratio = run.step_s / period
    if min(abs(ratio - round(ratio)), abs(1 / ratio - round(1 / ratio))) > 1e-9:
        return [f"topology.communication_period_s = {period:g}: must divide step_s = {run.step_s:g} or be a multiple of it"]
    h = run.step_s / run.sub_steps
    if abs(period / h - round(period / h)) > 1e-6:
        return [f"topology.communication_period_s = {period:g}: must be a multiple of the integrator's step {h:g} s"]
    return []


def _disturbances_fit(p: Model) -> list[str]:
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


def connected(p: Model) -> list[str]:
    """Assumption of every law: the graph of a formation is connected. Trains alone on a track are formations of their own."""
    links = p.first_scene.links
    groups = graph.components(len(p.scenario.train), links.sender, links.receiver)
    if p.plan.rule == "links" and len(groups) > 1:
        named = " | ".join(", ".join(p.scenario.ids[i] for i in g) for g in groups)
        return [f"topology: the graph of the [[link]] tables is not connected: {named}"]
    return []
