"""What the line means for a scenario: a reference that obeys its speed limits, and whether its slopes leave the laws room."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from sumo_net import Line
from trainctl.errors import InputError
from trainctl.plants import shared
from trainctl.reference import Profile
from trainctl.scenario import Scenario
from trainctl.signals import GRAVITY, Consists
from trainctl.topology import graph

if TYPE_CHECKING:
    from trainctl.prepare import Prepared


def limits(line: Line) -> list[tuple[float, float]]:
    """Speed limit of the line, (from_m, speed_mps): the lowest of all tracks, crossovers aside."""
    pieces = len(line.edges) - len(line.crossovers)
    start, speed = line.start_m[:pieces], line.speed_mps[:pieces]
    places = np.unique(start)
    lowest = np.full(len(places), np.inf)
    for track in line.track_ids:
        on = np.flatnonzero(np.array(line.tracks[:pieces]) == track)
        on = on[np.argsort(start[on])]
        lowest = np.minimum(lowest, speed[on][np.maximum(np.searchsorted(start[on], places, side="right") - 1, 0)])
    changed = np.flatnonzero(np.diff(lowest, prepend=np.nan) != 0.0)
    return [(float(places[k]), float(lowest[k])) for k in changed]


def followed(scenario: Scenario, line: Line | None, plan: graph.Plan, consists: Consists, start: float) -> Profile:
    """Return the reference for ``follow_line``, as a table: it stands in the log without the line.

    Raises
    ------
    InputError
        If the line's limits cannot be kept, in words.
    """
    if line is None:
        return Profile(speed_mps=scenario.train[0].speed_mps)  # the line's own mistakes have been told
    profile, slots = scenario.reference, plan.first_slot - np.concatenate([[0.0], np.cumsum(plan.desired)])
    if profile.stop_m is not None and not line.begin_m < profile.stop_m <= line.end_m:
        raise InputError(
            f"reference.stop_m = {profile.stop_m:.10g}: off the line, which is {line.begin_m:.10g} .. {line.end_m:.10g} m"
        )
    rear = float((slots - consists.train_length()).min())
    try:
        return profile.followed(limits(line), start, scenario.train[0].speed_mps, plan.first_slot, rear)
    except ValueError as error:
        raise InputError(f"reference.follow_line: {error}") from None


def steep(p: Prepared) -> list[str]:
    """Slopes that take too much of the input: on the steepest, what is left must do what the law asks of its bounds.

    A law that clamps must hold the reference speed there; any other sampled law relies on the room in its whole speed band, and its
    own rules (Assumption 2.4 of the fully distributed law) are asked again with the input bounds less the slope's share.
    """
    if not p.sampled or not p.line.gradient.slope.any():
        return []
    g, bounds = p.line.gradient, p.bounds
    clamped = getattr(p.law, "CLAMPED", False)
    ends = [p.leader(t)[1] for t in p.reference.breaks if math.isfinite(t)]
    found = []
    for k, side in ((int(np.argmax(g.slope)), "upper"), (int(np.argmin(g.slope)), "lower")):
        slope, up = float(g.slope[k]), side == "upper"
        bound = bounds.input_upper if up else bounds.input_lower
        band = bounds.speed_upper if up else bounds.speed_lower
        if slope == 0.0:
            continue
        speed = np.full(len(bound), max(ends) if up else min(ends)) if clamped else band
        if not np.isfinite(speed).all():
            continue
        rolling = shared.mean_resistance(p.consists, speed)
        needed = rolling + GRAVITY * slope
        broken = needed >= bound if up else needed <= bound
        for i in np.flatnonzero(broken)[:1]:
            among = f" (the first of {int(broken.sum())} trains)" if broken.sum() > 1 else ""
            found.append(
                f"train[{p.scenario.ids[i]}].input_{side}_mps2 = {bound[i]:.6g}: {1000 * slope:g} per mil at"
                f" {g.breaks[k]:.10g} m take {GRAVITY * slope:.4g} m/s2 and running resistance at {speed[i]:.6g} m/s"
                f" {rolling[i]:.4g} m/s2, so nothing is left for control{among}"
            )
    return found or _rules_on_slopes(p)


def _rules_on_slopes(p: Prepared) -> list[str]:
    """What the law objects to on the steepest slopes, and not on the level."""
    g, scene = p.line.gradient, p.first_scene
    if p.law.violations(p.params, scene):
        return []
    rise, fall = max(float(g.slope.max()), 0.0), min(float(g.slope.min()), 0.0)
    left = scene.bounds._replace(
        input_lower=scene.bounds.input_lower - GRAVITY * fall, input_upper=scene.bounds.input_upper - GRAVITY * rise
    )
    slopes = f"input bounds less {1000 * rise:g} and {1000 * fall:g} per mil, the line's steepest slopes"
    return [f"{rule} ({slopes})" for rule in p.law.violations(p.params, scene._replace(bounds=left))]
