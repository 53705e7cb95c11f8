"""Stacked runs from their start to their end: the stages of ``loop``, those left out that have nothing to do.

Nobody comes, stops, waits, is driven or protected in runs that can be stacked (``stack.alone``), and the links stay as they are.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numba import njit

from trainctl import numeric
from trainctl.ensemble import count, measures, units
from trainctl.ensemble.count import Instant
from trainctl.ensemble.measures import Columns, Recorded
from trainctl.ensemble.stack import Stack
from trainctl.monitors import on_track
from trainctl.monitors.on_track import ROUNDING
from trainctl.numeric import LEAVES_M
from trainctl.plants import disturbance
from trainctl.railway.ways import Ways
from trainctl.runs.series import INSTANT
from trainctl.scenario.model import Model
from trainctl.signals import POSITION, SPEED, Floats, Ints, Row, Seen, leader_over
from trainctl.stages import plant
from trainctl.stages.control import Control
from trainctl.topology import exchange


class Done(NamedTuple):
    """R runs at their end."""

    own: Floats  # (U, s) of all trains' units at the end
    metrics: Columns  # (R,) each
    violations: Ints  # (R,) as run.json counts them
    overspeeds: Ints  # (R,)
    why_alone: tuple[str | None, ...]  # why a run must be done by itself; its numbers mean nothing


def simulated(stack: Stack) -> Done:
    """Drive all runs of a stack to their end."""
    p = stack.model
    run, control, moving = p.scenario.run, Control(p, stack.radio), plant.of(p, stack.radio)
    fixed, chained = measures.fixed(stack)
    counts = count.nothing(fixed, len(stack.runs))
    due = [k for k in range(run.steps + 1) if k % run.recorded_steps == 0 or k == run.steps]
    instants = dict(zip(due, _instants(p, np.array(due) * run.step_s), strict=True))
    recorded = Recorded(np.array(due) * run.step_s, np.empty((len(due), len(p.leading))))
    own, row, lane_position = p.own.copy(), stack.row.copy(), stack.lane_position.copy()
    state, messages, demand, memory = moving.initial(), exchange.silent(), control.initial(), ()
    nobody, there = np.full(len(row), np.nan), np.ones(len(row), bool)
    track, length = on_track.track(p.rails, p.line.tracks), p.consists.train_length()
    lowest = float(track.limit[stack.ways.edge].min())
    formed, tallied = stack.formed, None
    for k in range(run.steps + 1):
        t, now, last = k * run.step_s, instants.get(k), k == run.steps
        position, speed = _measured(stack.ways, row, lane_position, p.consists.first, own)
        if speed.max() > lowest + ROUNDING:
            limit, _ = on_track.limits(track, stack.ways, row, position, length, there)
            counts.violated[speed > limit + ROUNDING] |= count.ABOVE_LIMIT
        if k == 0:
            scene = p.scene(own, stack.links, t)
            formed = formed._replace(constants=p.law.constants(p.params, scene))
            state = moving.relinked(scene, formed.constants, state)
            tallied = units.watched(stack, scene) if p.has_units else None
        past, state = (None, state) if now is None else moving.taken(state)
        motion, acting, force, saturated = None, None, nobody, demand.saturated
        if not last:
            acting = disturbance.at(stack.signals, k, t, position)
            if p.sampled and k % run.held_steps == 0:
                believed = moving.believed_resistance(own)
                demand, formed, messages, memory = control.evaluated(k, t, own, believed, formed, messages, memory, acting)
                demand = control.clamped(demand, own, believed)
            moved = moving.step(k, t, own, demand, nobody, formed, messages, state, acting)
            motion, messages, state = moved.motion, moved.messages, moved.state
            force, saturated = motion.input, demand.saturated | motion.limited
        count.watch(fixed, position, speed, force, not last, counts)
        if now is not None:
            count.count(fixed, now, position, speed, force, saturated, counts)
            recorded.position[now.number] = position
        if tallied is not None:
            seen = Seen(position, stack.ways.edge[row], row, there)
            instant = Row(
                t, seen, formed.formation, own, speed, formed.ahead, stack.links, motion, saturated, past, acting, formed.led
            )  # fmt: skip
            units.count(stack, tallied[0], instant, tallied[1], counts)
        if not last:
            if tallied is not None:
                units.check(tallied[0], moved.own, state.estimate, counts)
            numeric.go_on(stack.ways, p.line.length_m, moved.motion.displacement, row, lane_position)
            own = moved.own
    bits = counts.violated.reshape(len(stack.runs), -1)
    violations = _violations(stack, counts)
    if tallied is not None:
        violations += units.violations(*tallied, len(stack.runs))
    return Done(
        own, measures.metrics(stack, fixed, chained, counts, recorded, tallied), violations,
        (bits & count.ABOVE_LIMIT > 0).sum(axis=1), _why_alone(stack, counts.fate, row, lane_position),
    )  # fmt: skip


@njit(cache=True)
def _measured(ways: Ways, row: Ints, lane_position: Floats, first: Ints, own: Floats) -> tuple[Floats, Floats]:
    """Shift every train in ``own`` (U, s) onto its place, as ``loop`` does; positions [m] and speeds [m/s] of the heads, (N,)."""
    position, speed = np.empty(len(row)), np.empty(len(row))
    for i in range(len(row)):
        position[i], speed[i] = ways.begin[row[i]] + lane_position[i], own[first[i], SPEED]
        shift = position[i] - own[first[i], POSITION]
        for u in range(first[i], first[i + 1]):
            own[u, POSITION] += shift
    return position, speed


def _instants(p: Model, times: Floats) -> list[Instant]:
    """The recorded instants, as ``metrics`` takes them."""
    reference = p.reference
    speed = leader_over(reference, times)[SPEED]
    stretch = np.full(len(times), -1)  # of a constant reference speed
    for k, (begin, end) in enumerate(pairwise(reference.breaks)):
        if not np.any(reference.position[k, 2:]):
            stretch[(times >= begin - INSTANT) & (times < end - INSTANT)] = k
    dt = np.diff(times, prepend=np.nan)
    middle = np.concatenate([[np.nan], 0.5 * (dt[1:] + dt[:-1])])
    age = times - times[0]
    period = p.scenario.run.control_period_s or p.scenario.run.step_s
    counts = (age >= period - INSTANT) & (age > 0)
    return [
        Instant(
            float(times[m]), float(dt[m]), float(middle[m]), bool(counts[m]), float(speed[m]), bool(stretch[m] >= 0),
            m == 0 or bool(stretch[m] != stretch[m - 1]), m, m == len(times) - 1,
        )
        for m in range(len(times))
    ]  # fmt: skip


def _violations(stack: Stack, counts: count.Counts) -> Ints:
    """Bounds that were violated, each once per train or link that did."""
    runs, n = len(stack.runs), stack.trains
    links = stack.links
    found = np.zeros(runs, np.int64)
    for bit in (count.SLOW, count.FAST, count.BRAKES, count.PULLS, count.ABOVE_LIMIT):
        found += (counts.violated & bit > 0).reshape(runs, n).sum(axis=1)
    for bit in (count.NEAR, count.FAR):
        found += np.bincount(links.receiver[counts.link & bit > 0] // n, minlength=runs)
    return found


def _why_alone(stack: Stack, fate: Ints, row: Ints, lane_position: Floats) -> tuple[str | None, ...]:
    """Runs that cannot be told from here, and why."""
    line, n = stack.model.line, stack.trains
    ends = stack.ways.first[1:] - 1
    off = (row == ends) & (lane_position > line.length_m[stack.ways.edge[ends]] - LEAVES_M)
    track = np.array([line.track_ids.index(name) for name in line.tracks])[stack.ways.edge]
    changes = np.add.accumulate(np.concatenate([[0], np.diff(track) != 0]))  # of track, along the ways
    changed = changes[row] > changes[stack.row]
    words = {count.TOUCHES: "trains touch or pass one another", count.NOT_FINITE: "its numbers are no longer finite"}
    left = {True: "a train changes track", False: None}

    def why(r: int) -> str | None:
        of = slice(r * n, (r + 1) * n)
        return words.get(int(fate[r])) or ("a train leaves the line" if off[of].any() else left[bool(changed[of].any())])

    return tuple(why(r) for r in range(len(stack.runs)))
