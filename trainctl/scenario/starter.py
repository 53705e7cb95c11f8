"""A scenario to begin with for a SUMO configuration: ``trainctl new scenario``."""

from __future__ import annotations

import json
import math
import tempfile
from pathlib import Path

import numpy as np

from sumo_net import LineError, Rails
from trainctl.errors import InputError
from trainctl.scenario.tables import TrainType
from trainctl.scenario.train_types import train_type
from trainctl.traffic.kinds import Kind
from trainctl.traffic.read import Configuration, read_traffic

#: A train of 200 t that pulls and brakes with some 1 m/s2, for vTypes that say nothing of their forces.
USUAL = TrainType(
    unit_length_m=100.0, unit_mass_kg=200e3, rotating_mass_factor=1.06, c0_n_per_kg=0.0118, c1_ns_per_m_kg=7.76e-4,
    c2_ns2_per_m2_kg=1.6e-5,
)  # fmt: skip

#: A train may wait this long for others [s].
WAITS_S = 600.0

#: Law that the scenario begins with.
LAW = "robust_constrained"


def starter(sumocfg: Path, where: Path) -> str:
    """Text of a scenario for a SUMO configuration, with comments: law, bounds and spacing fit the speeds and trains found.

    Parameters
    ----------
    sumocfg : Path
        The configuration.
    where : Path
        Folder in which the scenario will lie.

    Raises
    ------
    InputError
        What is wrong with the configuration, one line each.
    """
    with tempfile.TemporaryDirectory(prefix="traffic.") as work:
        traffic = read_traffic(sumocfg, Path(work))
    try:
        rails = Rails.read(traffic.net, {e for d in traffic.departures for e in d.edges})
        limit = dict(zip(rails.edges, rails.speed_mps.tolist(), strict=True))
        length = dict(zip(rails.edges, rails.length_m.tolist(), strict=True))
        own, time = [], []
        for d in traffic.departures:
            kind = traffic.kinds[d.kind]
            edges = [rails.edges[e] for e in rails.way(d.edges).tolist()]
            share = min(kind.speed_factor, 1.0)
            own.append(min(kind.max_speed_mps, share * max(limit[e] for e in edges)))
            rides = sum(length[e] / min(kind.max_speed_mps, share * limit[e]) for e in edges)
            time.append(_end(d.depart_s, [(s.duration_s, s.until_s) for s in d.stops]) - traffic.begin_s + 2.0 * rides + WAITS_S)
    except (LineError, ValueError) as error:
        raise InputError(f"{sumocfg}: {error}") from None
    types = {name: train_type(kind) for name, kind in traffic.kinds.items()}
    without = [name for name, kind in types.items() if isinstance(kind, list)]
    return _text(sumocfg, where, traffic, max(own), max(time), [_forces(k) for k in traffic.kinds.values()], without)


def _end(depart: float, stops: list[tuple[float, float | None]]) -> float:
    """When a train is done with its stops at the earliest [s], its rides aside."""
    for duration, until in stops:
        depart = max(depart + duration + 60.0, -math.inf if until is None else until)
    return depart


def _forces(kind: Kind) -> tuple[float, float]:
    """What a vType surely brakes and, when it starts, pulls with [m/s2]."""
    found = train_type(kind, USUAL)
    if isinstance(found, list):
        raise InputError(found)
    inertia = (found.per_unit("unit_mass_kg") * found.per_unit("rotating_mass_factor")).sum()
    brakes, pulls = found.per_unit("braking_n", np.inf).sum() / inertia, found.per_unit("traction_n", np.inf).sum() / inertia
    return float(brakes), float(pulls)


def _text(
    sumocfg: Path, where: Path, traffic: Configuration, speed: float, end: float, forces: list[tuple[float, float]],
    without: list[str],
) -> str:  # fmt: skip
    duration = end if traffic.end_s is None else min(end, traffic.end_s - traffic.begin_s)
    brakes, pulls = (min(1.0, *(pair[k] for pair in forces)) for k in (0, 1))
    cruise = math.floor(10.0 * speed) / 10.0
    planned = round(0.5 * min(brakes, 1.0), 3)
    spacing = 100.0 * max(math.ceil(cruise**2 / (2.0 * planned) / 100.0), 5)
    try:
        named = sumocfg.resolve().relative_to(where.resolve())
    except ValueError:
        named = sumocfg.resolve()
    lines = f"""# {len(traffic.departures)} trains of {named}. `trainctl check` says what of its files is followed and what is not.
#:schema ./trainctl.schema.json
schema_version = 1
title = {json.dumps(named.stem)}

[run]
duration_s = {math.ceil(max(duration, 1.0))}      # until the last train may have arrived

[network]
sumocfg = {json.dumps(named.as_posix())}      # trains, routes, stops and tracks come from its files

[reference]
speed_mps = {cruise:g}      # cruising speed, the highest that any type and track here allow; no train exceeds its own limits

[traffic]
cooperate = ["*"]      # ids of the trains that join formations; [] for none: every train is driven by itself
acceleration_mps2 = {round(min(0.4, 0.5 * pulls), 3):g}
deceleration_mps2 = {planned:g}

[topology]      # trains that run in formation, front to front
spacing_m = {spacing:g}      # the braking distance from the cruising speed
lower_m = {0.4 * spacing:g}
upper_m = {1.6 * spacing:g}
weight = 0.001

[controller]
law = "{LAW}"      # `trainctl list` names the others
h_per_s = 0.1

[plant]
kind = "point"
speed_lower_mps = 0.0
speed_upper_mps = {cruise + 3.0:g}
input_lower_mps2 = {-brakes:.4g}
input_upper_mps2 = {min(pulls, 1.0):.4g}

[bounds]
speed_lower_mps = 0.0
speed_upper_mps = {cruise + 3.0:g}
input_lower_mps2 = {-brakes:.4g}
input_upper_mps2 = {min(pulls, 1.0):.4g}
"""
    if not without:
        return lines
    kind = USUAL
    return (
        lines
        + f"""
[train_type."*"]      # {", ".join(without[:8])}{" ..." if len(without) > 8 else ""}: the files state no forces of these vTypes
unit_length_m = {kind.unit_length_m:g}      # the length is that of each vType, and mass and decel where it states them
unit_mass_kg = {kind.unit_mass_kg:g}
rotating_mass_factor = {kind.rotating_mass_factor:g}
c0_n_per_kg = {kind.c0_n_per_kg:g}
c1_ns_per_m_kg = {kind.c1_ns_per_m_kg:g}
c2_ns2_per_m2_kg = {kind.c2_ns2_per_m2_kg:g}
"""
    )
