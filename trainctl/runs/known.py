"""What metrics and figures need to know of a scenario, taken from the resolved ``scenario.toml`` of a run folder."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from trainctl.errors import InputError
from trainctl.runs.run import Run
from trainctl.scenario.reference import Profile
from trainctl.signals import Reference

Range = tuple[float, float]
UNBOUNDED: Range = (-math.inf, math.inf)


@dataclass(frozen=True)
class Facts:
    """Bounds, masses and the reference of a run; trains are named as in its logs."""

    law: str = ""
    title: str = ""
    observer: str = ""
    controller: Mapping[str, Any] = field(default_factory=dict)  # its table
    trains: tuple[str, ...] = ()
    control_period_s: float = 0.0
    speed_mps: Mapping[str, Range] = field(default_factory=dict)
    input_mps2: Mapping[str, Range] = field(default_factory=dict)
    coupler_m: Range = UNBOUNDED
    mass_kg: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # of every unit
    length_m: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    traction_n: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # limits of every unit, inf if none
    braking_n: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    reference: Reference | None = None  # of all trains; None where every formation has its own
    traffic: bool = False  # trains come and go on a net of any shape
    cruise_mps: float | None = None  # what they drive at where nothing else holds them


def facts(run: Run) -> Facts:
    """Facts of a run folder; empty ones if it has no scenario.toml."""
    if not (run.folder / "scenario.toml").exists():
        return Facts()
    try:
        return facts_of(run.scenario)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{run.folder / 'scenario.toml'}: not a resolved scenario: {error!r:.200}") from None


def facts_of(scenario: Mapping[str, Any]) -> Facts:
    """Facts of a resolved scenario given as plain tables."""
    bounds, types = scenario.get("bounds", {}), scenario.get("train_type", {})
    trains = {str(train["id"]): train for train in scenario.get("train", ())}

    def both(name: str, lower: str, upper: str) -> Range:
        own = {**bounds, **trains.get(name, {})}
        return float(own.get(lower, -math.inf)), float(own.get(upper, math.inf))

    def per_unit(name: str, key: str, missing: float) -> tuple[float, ...]:
        kind = types.get(trains[name]["type"], {})
        row = np.broadcast_to(np.asarray(kind.get(key, missing), float), int(kind.get("units", 1)))
        return tuple(float(value) for value in row)

    controller = scenario.get("controller", {})
    # the finite-time law states its coupler range itself
    own = (-float(controller.get("coupler_compression_m", math.inf)), float(controller.get("coupler_stretch_m", math.inf)))
    stated = both("", "coupler_lower_m", "coupler_upper_m")
    masses = {name: per_unit(name, "unit_mass_kg", math.nan) for name in trains}
    timing, profile = scenario.get("run", {}), scenario.get("reference")
    traffic = "sumocfg" in scenario.get("network", {})
    start = max((float(train.get("position_m", 0.0)) for train in trains.values()), default=0.0)
    return Facts(
        law=str(controller.get("law", "")),
        observer=str(scenario.get("observer", {}).get("kind", "")),
        controller=controller,
        title=str(scenario.get("title", "")),
        trains=tuple(trains),
        control_period_s=float(timing.get("control_period_s") or timing.get("step_s") or 0.0),
        speed_mps={name: both(name, "speed_lower_mps", "speed_upper_mps") for name in trains},
        input_mps2={name: both(name, "input_lower_mps2", "input_upper_mps2") for name in trains},
        coupler_m=(max(own[0], stated[0]), min(own[1], stated[1])),
        mass_kg={name: mass for name, mass in masses.items() if not math.isnan(sum(mass))},
        length_m={name: per_unit(name, "unit_length_m", 0.0) for name in trains},
        traction_n={name: per_unit(name, "traction_n", math.inf) for name in trains},
        braking_n={name: per_unit(name, "braking_n", math.inf) for name in trains},
        reference=Profile.model_validate(profile).leader(start) if profile and not traffic else None,
        traffic=traffic,
        cruise_mps=profile.get("speed_mps") if profile and traffic else None,
    )
