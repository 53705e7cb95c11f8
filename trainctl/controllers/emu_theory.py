"""Hypotheses of Theorem 1 of the finite-time law that must hold at the start: trains, couplers, zones and links.

Masses, slots and links are what the law needs beside them. Symbols are those of ``emu_finite_time``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from trainctl.signals import POSITION, Floats, Scene

if TYPE_CHECKING:
    from trainctl.controllers.emu_finite_time import Params


def violations(params: Params, scene: Scene) -> list[str]:
    """Every rule that fails: of the zones, of every train, of every pair of trains."""
    return [*zone_violations(params), *train_violations(params, scene), *link_violations(params, scene)]


def pair_inertia(inertia: Floats) -> Floats:
    """Of every unit and the next one [kg], (U,): twice the reduced mass, the mass of either where they are equal."""
    after = np.append(inertia[1:], inertia[-1])
    return np.where(after == inertia, inertia, 2.0 * inertia * after / (inertia + after))


def zone_violations(params: Params) -> list[str]:
    """Find zones that do not fit: delta1 in (0, h1), delta2 in (0, h2)."""
    p, found = params, []
    if p.stretch_zone_m >= p.coupler_stretch_m:
        found.append(f"controller.stretch_zone_m = {p.stretch_zone_m:g}: must be below coupler_stretch_m = {p.coupler_stretch_m:g}")
    if p.compression_zone_m >= p.coupler_compression_m:
        found.append(
            f"controller.compression_zone_m = {p.compression_zone_m:g}: must be below "
            f"coupler_compression_m = {p.coupler_compression_m:g}"
        )
    return found


def train_violations(params: Params, scene: Scene) -> list[str]:
    """Find trains of unequal units, with couplers stiffer than p1 or out of range, or without a slot."""
    found = []
    c, (h1, h2) = scene.consists, (params.coupler_stretch_m, params.coupler_compression_m)
    inertia = c.mass * c.rotating
    for i, (name, a, b) in enumerate(zip(scene.trains, c.first[:-1], c.first[1:], strict=True)):
        if np.ptp(inertia[a:b]) > 1e-9 * inertia[a] and not params.weighted_by_mass:
            found.append(
                f"train {name}: unit_mass_kg times rotating_mass_factor = {inertia[a:b].min():g} to {inertia[a:b].max():g}: "
                "the units of one train must be equally heavy, or neighbours do not pull each other alike (Lemma 1); "
                "controller.weighted_by_mass = true repairs that"
            )
        k_hat = c.stiffness[a:b] / pair_inertia(inertia)[a:b]
        if k_hat.max() >= params.p_1:
            found.append(
                f"controller.p_1 = {params.p_1:g}: must exceed coupler stiffness over mass, {k_hat.max():g} 1/s2 in train {name}, "
                "or units repel each other"
            )
        stretch = scene.own[a : b - 1, POSITION] - scene.own[a + 1 : b, POSITION] - c.length[a : b - 1]
        for j, e in enumerate(stretch):
            if not -h2 < e < h1:
                found.append(f"train {name}: coupler {j + 1} = {e:.4g} m: must start inside (-{h2:g}, {h1:g}) m (Theorem 1)")
        if np.isnan(scene.links.slot[i]):
            found.append(f'topology.desired: train {name} has no slot: the law needs one for every train; use desired = "slots"')
    return found


def link_violations(params: Params, scene: Scene) -> list[str]:
    """Find pairs too near, out of their zones, against their slots, or heard one way only."""
    found = []
    links, first, length = scene.links, scene.consists.first, scene.consists.train_length()
    le, beta = params.emergency_distance_m, params.range_m
    pairs = set(zip(links.sender.tolist(), links.receiver.tolist(), strict=True))
    for p, i, desired in zip(links.sender.tolist(), links.receiver.tolist(), links.desired, strict=True):
        ahead, name = scene.trains[p], scene.trains[i]
        if (i, p) not in pairs:
            found.append(f"link {ahead} to {name}: train {ahead} must receive from train {name}, too (the graph is undirected)")
        if desired < 0.0 and (i, p) in pairs:
            continue  # said once, for the follower
        if desired == 0.0:
            found.append(f"link {ahead} to {name}: desired_m = 0: one of the two must be ahead")
            continue
        front, rear = (p, i) if desired > 0.0 else (i, p)
        where = f"trains {scene.trains[front]} and {scene.trains[rear]}"
        ls = abs(desired) - length[front]
        tail = first[front + 1] - 1
        s = scene.own[tail, POSITION] - scene.consists.length[tail] - scene.own[first[rear], POSITION]
        if not s > le:
            found.append(f"{where}: interval = {s:.1f} m: must start above emergency_distance_m = {le:g} (Theorem 1)")
        if not ls - le > params.emergency_zone_m:
            found.append(
                f"{where}: desired interval = {ls:g} m: must exceed emergency_distance_m + emergency_zone_m = "
                f"{le + params.emergency_zone_m:g}"
            )
        if not beta - ls > params.range_zone_m:
            found.append(
                f"{where}: desired interval = {ls:g} m: must be below range_m - range_zone_m = {beta - params.range_zone_m:g}"
            )
        gap = abs(scene.links.slot[front] - scene.links.slot[rear] - abs(desired))
        if gap > 1e-6:
            found.append(f"{where}: desired_m = {abs(desired):g}: differs by {gap:g} m from what their slots say")
    return found
