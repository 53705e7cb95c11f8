"""What the line means for a scenario: places of trains and crossovers, a reference inside its limits, slopes that leave room."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from sumo_net import Line
from trainctl.errors import InputError
from trainctl.plants import shared
from trainctl.scenario.events import Event
from trainctl.scenario.reference import Profile
from trainctl.scenario.tables import Scenario
from trainctl.signals import GRAVITY, Consists, Ints
from trainctl.topology import graph

if TYPE_CHECKING:
    from trainctl.scenario.model import Model


def places(scenario: Scenario) -> Ints:
    """Which every train is in the formation, 0 the first: by where they start, tracks aside; shape (n,).

    Trains of a SUMO configuration, which come and go, keep the order they have.
    """
    trains = scenario.train
    if scenario.network.sumocfg is not None:
        return np.arange(len(trains))
    order = sorted(range(len(trains)), key=lambda i: (-trains[i].position_m, trains[i].track))
    return np.argsort(order)


def against_the_order(scenario: Scenario, place: Ints) -> list[str]:
    """Tables of one track against the order of positions: ``same_track`` makes neighbours of them, front to rear."""
    if scenario.topology.rule != "same_track" or scenario.network.sumocfg is not None:
        return []
    found, last = [], dict[str, int]()
    for k, t in enumerate(scenario.train):
        before = last.setdefault(t.track, k)
        if place[k] < place[before]:
            other = scenario.train[before]
            found.append(
                f"train[{t.id}].position_m = {t.position_m:.10g}: ahead of train {other.id} at {other.position_m:.10g} m, whose"
                f" table comes before; the [[train]] tables of track {t.track} must go front to rear"
            )
        last[t.track] = k
    return found


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


def followed(scenario: Scenario, line: Line | None, plan: graph.Plan, consists: Consists, start: float, front: int) -> Profile:
    """Return the reference for ``follow_line``, as a table: it stands in the log without the line; ``front`` is the first train.

    Raises
    ------
    InputError
        If the line's limits cannot be kept, in words.
    """
    if line is None:
        return Profile(speed_mps=scenario.train[front].speed_mps)  # the line's own mistakes have been told
    profile, slots = scenario.reference, plan.slot
    if profile.stop_m is not None and not line.begin_m < profile.stop_m <= line.end_m:
        raise InputError(
            f"reference.stop_m = {profile.stop_m:.10g}: off the line, which is {line.begin_m:.10g} .. {line.end_m:.10g} m"
        )
    rear = float((slots - consists.train_length()).min())
    try:
        return profile.followed(limits(line), start, scenario.train[front].speed_mps, plan.first_slot, rear)
    except ValueError as error:
        raise InputError(f"reference.follow_line: {error}") from None


def steep(p: Model) -> list[str]:
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


def _rules_on_slopes(p: Model) -> list[str]:
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


def off_the_line(here: str, track: str, position: float, line: Line) -> list[str]:
    """Track and front [m] of a train that are not on the line; ``here`` is its key."""
    found = [] if track in line.track_ids else [f"{here}.track = {track}: no such track; there are: {', '.join(line.track_ids)}"]
    if not line.begin_m <= position <= line.end_m:
        found.append(f"{here}.position_m = {position:.10g}: off the line, which is {line.begin_m:.10g} .. {line.end_m:.10g} m")
    return found


def on_the_line(scenario: Scenario, line: Line) -> list[str]:
    """Trains beside the line or inside one another, crossovers that do not exist or are behind."""
    found, placed = [], []
    for t in scenario.train:
        here = f"train[{t.id}]"
        beside = off_the_line(here, t.track, t.position_m, line)
        found += beside
        if not beside:
            kind = scenario.train_type[t.type]
            length = math.fsum(kind.per_unit("unit_length_m"))
            if t.position_m - length < line.begin_m:
                tail = t.position_m - length
                found.append(
                    f"{here}.position_m = {t.position_m:.10g}: its rear at {tail:.10g} m is off the line, which begins at"
                    f" {line.begin_m:.10g} m"
                )
            placed.append((t.track, t.position_m, length, t.id))
    for (track, x, length, i), (other, y, _, j) in pairwise(sorted(placed, key=lambda p: (p[0], -p[1]))):
        if (track == other and y > x - length) or (track == other and y == x):
            found.append(
                f"train[{j}].position_m = {y:.10g}: overlaps train {i} on track {track}, whose rear is at {x - length:.10g} m"
            )
    where = {t.id: (t.track, t.position_m, t) for t in scenario.train}
    for k, event in sorted(enumerate(scenario.event, 1), key=lambda e: e[1].time_s):
        if event.kind != "reroute":
            continue
        track, at_least, t = where[event.train]
        if track in line.track_ids:
            where[event.train] = (*_reroute(f"event[{k}]", event, scenario, line, track, at_least, found), t)
    return found


def _reroute(
    here: str, event: Event, scenario: Scenario, line: Line, track: str, at_least: float, found: list[str]
) -> tuple[str, float]:
    """Check one reroute as far as it is certain before the run; where the train is afterwards, at least."""
    train = next(t for t in scenario.train if t.id == event.train)
    slowest = max(v for v in (train.speed_lower_mps, scenario.bounds.speed_lower_mps, 0.0) if v is not None)
    passed = max(at_least, train.position_m + slowest * event.time_s)
    if event.crossover is None:
        if event.to_track not in line.track_ids:
            found.append(f"{here}.to_track = {event.to_track}: no such track; there are: {', '.join(line.track_ids)}")
            return track, at_least
        on_line = line.begin_m <= passed <= line.end_m
        ahead = line.next_crossover(track, passed, str(event.to_track)) if on_line else None
        if ahead is None:
            found.append(f"{here}.to_track = {event.to_track}: no crossover from track {track} to it beyond {passed:.10g} m")
            return track, at_least
        return ahead.to_track, ahead.start_m
    named = {c.id: c for c in line.crossovers}
    if event.crossover not in named:
        near = [c.id for c in line.crossovers if c.from_track == track and c.start_m > passed][:3]
        hint = f"; next on track {track}: {', '.join(near)}" if near else ""
        found.append(f"{here}.crossover = {event.crossover}: no such crossover{hint}")
        return track, at_least
    crossover = named[event.crossover]
    if crossover.from_track != track:
        found.append(
            f"{here}.crossover = {crossover.id}: leaves track {crossover.from_track}, train {event.train} is on track {track}"
        )
    elif crossover.start_m <= passed:
        found.append(
            f"{here}.crossover = {crossover.id}: its switch at {crossover.start_m:.10g} m has been passed, train {event.train}"
            f" is at {passed:.10g} m or beyond at {event.time_s:g} s"
        )
    return crossover.to_track, max(at_least, crossover.start_m)


def long_enough(p: Model) -> list[str]:
    """Trains that would run off the line's end at the reference speed."""
    end = p.scenario.run.duration_s
    travel = p.leader(end)[0] - p.leader(0.0)[0]
    return [
        f"run.duration_s = {end:g}: at the reference speed train {t.id} reaches {t.position_m + travel:.0f} m, beyond the"
        f" line's end at {p.line.end_m:.10g} m"
        for t in p.scenario.train
        if t.position_m <= p.line.end_m < t.position_m + travel
    ]
