"""What `trainctl check` says of a scenario that has no mistakes: the numbers that follow from it, and its law's own report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from trainctl.plants import shared
from trainctl.scenario import limits, promise
from trainctl.scenario.model import Model
from trainctl.topology import graph

#: What the facts are called in the table for people.
WORDS = {
    "links_at_start": "links at the start",
    "steps": "steps of the run",
    "step_s": "step",
    "control_period_s": "control period",
    "lead_theta": "lead of the plant, theta",
    "smallest_control_period_s": "minimum control period",
    "input_room_mps2": "input every train can give",
    "sub_step_s": "integration step",
    "cooperate": "trains that cooperate",
}

#: Units of facts that are numbers, by the ends of their names.
UNITS = {"_s": "s", "_mps2": "m/s2"}

#: More trains than this are counted, not named.
MOST = 40


def facts(p: Model) -> dict[str, Any]:
    """Facts by name; as lists of lines what is ``followed`` of SUMO's files, ``warnings`` and the law's ``report``."""
    run, scene = p.scenario.run, p.first_scene
    links = graph.edges(scene.links, p.scenario.ids)
    found: dict[str, Any] = {
        "title": p.scenario.title,
        "trains": _some(p.scenario.ids),
        "law": f"{p.scenario.controller.law} ({p.law.CLOCK})",
        "plant": p.scenario.plant.kind,
        **(
            _traffic(p)
            if not p.placed
            else {
                "line": f"{p.line.begin_m / 1000:g} .. {p.line.end_m / 1000:g} km, tracks {', '.join(p.line.track_ids)}",
                "links_at_start": " ".join(f"{a}-{b}" for a, b in links),
            }
        ),
        "steps": run.steps,
        "step_s": run.step_s,
    }
    if p.sampled:
        found |= {"control_period_s": scene.control_period, "lead_theta": p.theta}
        if (
            getattr(p.law, "BANDED", False)
            and p.plant.UNITS
            and np.all(np.isfinite(p.bounds.speed_lower) & np.isfinite(p.bounds.speed_upper))
        ):
            speed = np.full(len(p.scenario.ids), p.leader(0.0)[1])
            minimum = shared.smallest_period(p.consists, speed, p.bounds.speed_lower, p.bounds.speed_upper)
            found["smallest_control_period_s"] = round(float(np.max(minimum)), 6)
            found["input_room_mps2"] = [round(float(p.bounds.input_lower.max()), 6), round(float(p.bounds.input_upper.min()), 6)]
    else:
        found["sub_step_s"] = scene.sub_step
    if p.supervision.mode != "off" and not p.self_driven:
        found["protection"] = promise.told(p)
        found["promise"] = promise.sentences(found["protection"])
    found["followed"] = list(p.roster.followed)
    notes = [*p.roster.notes, *limits.differing(p.scenario, p.plant, p.plant_params)]
    found["warnings"] = notes + list(p.law.warnings(p.params, scene, p.start_track)) if hasattr(p.law, "warnings") else notes
    found["report"] = list(p.law.report(p.params, scene, p.scenario.disturbance)) if hasattr(p.law, "report") else []
    if hasattr(p.law, "analysis"):
        found["analysis"] = p.law.analysis(p.params, scene, p.scenario.disturbance).as_dict()
    return found


def in_words(found: dict[str, Any]) -> list[tuple[str, str]]:
    """Name and value of every fact that is no list of lines, for people."""
    rows = []
    for key, value in found.items():
        if key not in ("followed", "warnings", "report", "analysis", "protection", "promise"):
            unit = next((f" {unit}" for end, unit in UNITS.items() if key.endswith(end)), "")
            numbers = value if isinstance(value, list) else [value] if isinstance(value, float) else []
            shown = " .. ".join(f"{v:.6g}" for v in numbers) or str(value)
            rows.append((WORDS.get(key, key), f"{shown}{unit}"))
    return rows


def _traffic(p: Model) -> dict[str, Any]:
    """Facts of trains that come and go, and of their net."""
    rails, roster, rules = p.roster.rails, p.roster, p.supervision
    normal = ~rails.internal
    together = [name for name, member in zip(p.scenario.ids, roster.cooperates, strict=True) if member]
    return {
        "net": f"{int(normal.sum())} rail edges, {float(rails.length_m[normal].sum()) / 1000:g} km",
        "cooperate": "all" if len(together) == len(p.scenario.ids) else _some(together) or "none",
        "departures": f"{float(roster.depart.min()):g} .. {float(roster.depart.max()):g} s",
        "stops": sum(len(stops) for stops in roster.stops),
        "supervisor": f"{rules.mode}, emergency braking {rules.emergency_mps2:g} m/s2",
    }


def _some(names: Sequence[str]) -> str:
    more = len(names) - MOST
    return ", ".join(names[:MOST]) + (f" and {more} more" if more > 0 else "")
