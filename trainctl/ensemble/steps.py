"""Stacked runs from their start to their end: the stages of ``loop``, those left out that have nothing to do.

No train comes, stops, waits, is driven or protected in runs that can be stacked (``stack.alone``), and the links stay as they are.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from trainctl import numeric
from trainctl.ensemble import count, measures, units
from trainctl.ensemble.count import Instants, Passage
from trainctl.ensemble.measures import Columns, Recorded
from trainctl.ensemble.stack import Stack
from trainctl.kernels import bare
from trainctl.monitors import on_track
from trainctl.monitors.on_track import ROUNDING
from trainctl.numeric import LEAVES_M, Places
from trainctl.plants import disturbance
from trainctl.railway.ways import Ways
from trainctl.runs.series import INSTANT
from trainctl.scenario.model import Model
from trainctl.signals import (
    POSITION,
    SPEED,
    Bools,
    Demand,
    Disturbed,
    Floats,
    Formed,
    Ints,
    Messages,
    Motion,
    Row,
    Seen,
    leader_over,
)  # fmt: skip
from trainctl.stages import plant
from trainctl.stages.control import Control
from trainctl.topology import exchange

#: Steps that are counted together.
TOGETHER = 8


#: Why a run cannot be told from a stack, beside ``count.TOUCHES`` and ``count.NOT_FINITE``, which go before.
LEAVES, CHANGES = 3, 4
WORDS = {
    count.TOUCHES: "trains touch or pass one another", count.NOT_FINITE: "its numbers are no longer finite",
    LEAVES: "a train leaves the line", CHANGES: "a train changes track",
}  # fmt: skip


class Done(NamedTuple):
    """R runs at their end."""

    own: Floats  # (U, s) of all trains' units at the end
    metrics: Columns  # (R,) each
    violations: Ints  # (R,) as run.json counts them
    overspeeds: Ints  # (R,)
    why_alone: tuple[str | None, ...]  # why a run must be done by itself; its numbers mean nothing


class State(NamedTuple):
    """All that changes from step to step, as in ``loop.State``."""

    k: int  # steps done
    own: Floats  # (U, s) of all trains' units, at the measured positions
    at: Places
    position: Floats  # (N,) m, along the way
    formed: Formed
    messages: Messages
    demand: Demand
    memory: Any
    plant: plant.State


class Stepped(NamedTuple):
    """What a step makes of the runs, and how."""

    state: State
    motion: Motion
    acting: Disturbed
    saturated: Bools  # (N,) of the law or by the plant's limits


class Abreast:
    """The stages of stacked runs, made once from the stack."""

    def __init__(self, stack: Stack) -> None:
        self.stack, self.p = stack, stack.model
        self.control, self.plant = Control(self.p, stack.radio, strict=False), plant.of(self.p, stack.radio)
        self.free, self.nothing = np.full(len(stack.row), np.nan), np.zeros(len(stack.row))

    def initial(self) -> State:
        """All runs at their start."""
        p, stack = self.p, self.stack
        own, at = p.own.copy(), numeric.placed(stack.ways, p.line.length_m, stack.row, stack.lane_position)
        position = _measured(at, p.consists.first, own)
        scene = p.scene(own, stack.links, 0.0)
        constants = p.law.constants(p.params, scene)
        units = self.plant.relinked(scene, constants, self.plant.initial())
        return State(
            0, own, at, position, stack.formed._replace(constants=constants), exchange.silent(),
            self.control.initial(), (), units,
        )  # fmt: skip

    def after(self, s: State, commanded: Floats | None = None, added: Floats | None = None) -> Stepped:
        """A step later; ``commanded`` and ``added`` (N,) [m/s2] are as in ``loop.State``."""
        p, stack, t = self.p, self.stack, s.k * self.p.scenario.run.step_s
        acting = disturbance.at(stack.signals, s.k, t, s.position)
        demand, formed, messages, memory = self.control.step(
            s.k, t, s.own, self.plant.believed_resistance, s.formed, s.messages, s.demand, s.memory,
            self.free if commanded is None else commanded, self.nothing if added is None else added, acting,
        )  # fmt: skip
        moved = self.plant.step(s.k, t, s.own, demand, self.free, formed, messages, s.plant, acting)
        own, at = moved.own, numeric.gone_on(stack.ways, p.line.length_m, moved.motion.displacement, s.at)
        position = _measured(at, p.consists.first, own)
        state = State(s.k + 1, own, at, position, formed, moved.messages, demand, memory, moved.state)
        return Stepped(state, moved.motion, acting, demand.saturated | moved.motion.limited)

    def left(self, s: State) -> Bools:
        """Trains (N,) that have left the line."""
        ends = self.stack.ways.first[1:] - 1
        gone: Bools = (s.at.row == ends) & (s.at.lane_position > self.p.line.length_m[self.stack.ways.edge[ends]] - LEAVES_M)
        return gone


def simulated(stack: Stack) -> Done:
    """Drive all runs of a stack to their end."""
    abreast, p = Abreast(stack), stack.model
    run = p.scenario.run
    fixed, chained = measures.fixed(stack)
    counts = count.nothing(fixed, len(stack.runs))
    due = [k for k in range(run.steps + 1) if k % run.recorded_steps == 0 or k == run.steps]
    numbers = {k: m for m, k in enumerate(due)}
    instants, passage, rows = _instants(p, np.array(due) * run.step_s), Passage.empty(TOGETHER, len(stack.row)), 0
    recorded = Recorded(np.array(due) * run.step_s, np.empty((len(due), len(p.leading))))
    there, track, length = np.ones(len(stack.row), bool), on_track.track(p.rails, p.line.tracks), p.consists.train_length()
    lowest = float(track.limit[np.bincount(stack.ways.edge, minlength=len(track.limit)) > 0].min())
    s = abreast.initial()
    tallied = units.watched(stack, p.scene(s.own, stack.links, 0.0)) if p.has_units else None
    while True:
        t, number, last = s.k * run.step_s, numbers.get(s.k, -1), s.k == run.steps
        speed = p.speeds(s.own)
        if speed.max() > lowest + ROUNDING:
            limit, _ = on_track.limits(track, stack.ways, s.at.row, s.position, length, there)
            counts.violated[speed > limit + ROUNDING] |= count.ABOVE_LIMIT
        past = None
        if number >= 0:
            past, taken = abreast.plant.taken(s.plant)
            s = s._replace(plant=taken)
        stepped = None if last else abreast.after(s)
        motion, acting = (None, None) if stepped is None else (stepped.motion, stepped.acting)
        saturated = s.demand.saturated if stepped is None else stepped.saturated
        passage.write(rows, s.position, speed, None if motion is None else motion.input, saturated, number)
        rows += 1
        if rows == TOGETHER or last:
            count.count(fixed, instants, passage, rows, counts)
            rows = 0
        if number >= 0:
            recorded.position[number] = s.position
        if tallied is not None:
            seen = Seen(s.position, stack.ways.edge[s.at.row], s.at.row, there)
            instant = Row(
                t, seen, s.formed.formation, s.own, speed, s.formed.ahead, stack.links, motion, saturated, past, acting,
                s.formed.led,
            )  # fmt: skip
            units.count(stack, tallied[0], instant, tallied[1], counts)
        if stepped is None:
            break
        if tallied is not None:
            units.check(tallied[0], stepped.state.own, stepped.state.plant.estimate, counts)
        s = stepped.state
    bits = counts.violated.reshape(len(stack.runs), -1)
    violations = _violations(stack, counts)
    if tallied is not None:
        violations += units.violations(*tallied, len(stack.runs))
        units.check_extremes(stack, *tallied, counts)
    return Done(
        s.own, measures.metrics(stack, fixed, chained, counts, recorded, tallied), violations,
        (bits & count.ABOVE_LIMIT > 0).sum(axis=1), _why_alone(abreast, s, counts.fate),
    )  # fmt: skip


def _measured(at: Places, first: Ints, own: Floats) -> Floats:
    """Shift every train in ``own`` (U, s) onto its place, as ``loop`` does; positions of the heads [m], (N,)."""
    position = at.position
    _shift(position, first, own)
    return position


@bare
def _shift(position: Floats, first: Ints, own: Floats) -> None:
    for i in range(len(position)):
        shift = position[i] - own[first[i], POSITION]
        for u in range(first[i], first[i + 1]):
            own[u, POSITION] += shift


def _instants(p: Model, times: Floats) -> Instants:
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
    fresh = np.diff(stretch, prepend=-2) != 0
    return Instants(times, dt, middle, counts, np.ascontiguousarray(speed), stretch >= 0, fresh)


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


def _why_alone(abreast: Abreast, s: State, fate: Ints) -> tuple[str | None, ...]:
    """Runs that cannot be told from here, and why."""
    stack, line = abreast.stack, abreast.p.line
    changed = np.zeros(len(stack.row), bool)
    _changed(stack.ways, np.array([line.track_ids.index(name) for name in line.tracks]), stack.row, s.at.row, changed)
    cause = fate.copy()
    for trains, number in ((abreast.left(s), LEAVES), (changed, CHANGES)):
        cause[(cause == count.GOES_ON) & trains.reshape(len(cause), -1).any(axis=1)] = number
    return tuple(map(WORDS.get, cause.tolist()))


@bare
def _changed(ways: Ways, track: Ints, before: Ints, now: Ints, changed: Bools) -> None:
    """Mark trains that have changed track from one row to another; ``track`` (E,) is that of every edge."""
    for i in range(len(now)):
        for k in range(before[i], now[i]):
            if track[ways.edge[k]] != track[ways.edge[k + 1]]:
                changed[i] = True
