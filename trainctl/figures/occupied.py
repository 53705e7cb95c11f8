"""What trains occupy in a train graph: blocks under fixed block, bodies and braking distances under moving block.

Under fixed block a train holds a block from when its braking distance reaches the signal before it until its rear has passed the
signal behind it: the stairs of blocking times. Under moving block it holds the track it stands on, and needs its braking distance
ahead of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from sumo_net import LineError, Rails
from sumo_net.netfile import read_net
from trainctl.controllers import sumo
from trainctl.figures.trains import Drawn
from trainctl.signals import Bools, Floats, Ints


class Block(NamedTuple):
    """A block while a train holds it: times [s], and where it begins and ends on the distance axis of a panel [m]."""

    begin_s: float
    end_s: float
    from_m: float
    to_m: float


@dataclass(frozen=True)
class Travelled:
    """What one train ran over, row by row, and the signals there."""

    time: Floats  # (rows,) s
    run: Floats  # (rows,) m its front has run since the first row
    reach: Floats  # (rows,) m, where it could stand, braking from that row on
    signals: Floats  # (k,) m, where the blocks on its way begin and end, ascending
    length: float  # m

    def on(self, distance: Floats) -> list[Block]:
        """The blocks it held, on the axis on which its front is at ``distance`` (rows,) [m], NaN where it is elsewhere."""
        on = np.flatnonzero(np.isfinite(distance))
        if len(on) < 2:
            return []
        found = []
        sign = np.sign(distance[on[-1]] - distance[on[0]]) or 1.0
        first = -np.inf if on[0] == 0 else self.run[on[0]]  # beyond it comes on from elsewhere
        last = np.inf if on[-1] == len(distance) - 1 else self.run[on[-1]]
        for begin, end in pairwise(self.signals):
            short = np.flatnonzero(self.reach < begin)
            a = int(short[-1]) + 1 if len(short) else 0  # a train that waits at a signal holds the block when it moves off
            clear = np.flatnonzero(self.run - self.length >= end)
            b = int(clear[0]) if len(clear) else len(self.time) - 1
            low, high = max(begin, first), min(end, last)
            if a >= b or low >= high:
                continue
            here, there = (
                float(np.interp(at, self.run[on], distance[on]))
                + sign * float(min(at - self.run[on[0]], 0.0) + max(at - self.run[on[-1]], 0.0))
                for at in (low, high)
            )
            found.append(Block(float(self.time[a]), float(self.time[b]), here, there))
        return found


def fixed_block(drawn: Drawn) -> bool:
    """Whether blocks between signals kept the trains apart: SUMO's own, and those that obey, unless options say moving block."""
    obeyed = drawn.known.traffic and drawn.run.scenario.get("traffic", {}).get("signals") == "obey"
    if drawn.known.law != "sumo" and not obeyed:
        return False
    try:
        options = ElementTree.parse(drawn.run.folder / "sumo" / "run.sumocfg").getroot()
    except (OSError, ElementTree.ParseError):
        return False
    return not any(one.get("value") in ("true", "1") for one in options.iter("railsignal-moving-block"))


def braking(drawn: Drawn) -> dict[str, float]:
    """What each train surely brakes with [m/s2]; those of which nothing is known are left out.

    SUMO's own trains by its table; others what the supervisor's service braking says, else their brakes, else their input bound.
    """
    known, scenario = drawn.known, drawn.run.scenario if (drawn.run.folder / "scenario.toml").exists() else {}
    if known.law == "sumo":  # on a net the files' own types drive
        own = 0.0 if known.traffic else sumo.BRAKING_MPS2.get(str(known.controller.get("train_type", "ICE3")), 0.0)
        return dict.fromkeys(known.trains, own) if own else {}
    service = scenario.get("supervisor", {}).get("service_mps2")
    found: dict[str, float] = {}
    for name in known.trains:
        mass, force = sum(known.mass_kg.get(name, ())), sum(known.braking_n.get(name, ()))
        bound = -known.input_mps2.get(name, (-np.inf, np.inf))[0]
        for value in (service or np.inf, force / mass if mass else np.inf, bound):
            if 0.0 < value < np.inf:
                found[name] = float(value)
                break
    return found


@dataclass(frozen=True)
class Occupied:
    """What the trains of a run occupy: ``blocks`` under fixed block, else lengths and braking distances; empty: nothing."""

    blocks: dict[str, Travelled] = field(default_factory=dict)
    length: dict[str, float] = field(default_factory=dict)  # m
    braking: dict[str, Floats] = field(default_factory=dict)  # (rows,) m, of every train
    rates: tuple[float, ...] = ()  # m/s2, with which they brake

    @property
    def rate(self) -> str:
        """With what they brake, in words."""
        return " to ".join(f"{rate:.3g}" for rate in sorted({min(self.rates), max(self.rates)})) if self.rates else ""

    @property
    def words(self) -> str:
        """What the shades are."""
        if self.blocks:
            since = f"a braking distance at {self.rate} m/s² before" if self.rates else "the front is at"
            return f"Shaded: blocks that trains hold, from when {since} their signal until the rear has left them."
        if not self.length:
            return ""
        return f"Shaded: train{f' and braking distance at {self.rate} m/s²' if self.rates else ''}."


def occupied(drawn: Drawn) -> Occupied:
    """What the trains of a run occupy; without a net whose signals can be read nothing under fixed block."""
    given, speed = braking(drawn), drawn.trains.column("speed_mps")
    way = {
        name: speed[rows] ** 2 / (2.0 * given[name]) if name in given else np.zeros(rows.stop - rows.start)
        for name, rows in drawn.trains.slices()
    }
    length = {name: float(sum(drawn.known.length_m.get(name, ()))) for name in drawn.trains.names}
    if fixed_block(drawn):
        return Occupied(travelled(drawn, way, length), rates=tuple(given.values()))
    return Occupied({}, length, way, tuple(given.values()))


def along(distance: Floats) -> Floats:
    """Which way a front runs along its axis at every row: 1 or -1, where it stands as before."""
    step = np.sign(np.diff(distance, prepend=distance[:1]))
    step[~np.isfinite(step)] = 0.0
    moving = np.flatnonzero(step)
    if not len(moving):
        return np.ones(len(distance))
    last = np.searchsorted(moving, np.arange(len(step)), side="right") - 1
    found: Floats = step[moving[np.maximum(last, 0)]]
    return found


def travelled(drawn: Drawn, braking: dict[str, Floats], length: dict[str, float]) -> dict[str, Travelled]:
    """What every train ran over; empty where the run's net cannot be read or has no signals."""
    edges, position = drawn.trains.words["edge"].each(), drawn.trains.column("position_m")
    if drawn.run.net is None:
        return {}
    try:
        rails, net = Rails.read(drawn.run.net, set(edges)), read_net(drawn.run.net)
    except LineError:
        return {}
    signals = {j.attributes.get("id") for j in net.junctions if j.attributes.get("type") == "rail_signal"}
    ends = np.zeros(len(rails.edges), bool)  # of edges, at a signal
    for edge in net.edges:
        if edge.attributes.get("id") in rails.index:
            ends[rails.index[edge.attributes["id"]]] = edge.attributes.get("to") in signals
    if not ends.any() or not set(edges) <= set(rails.edges):
        return {}
    time, found = drawn.trains.column("time_s"), {}
    for name, rows in drawn.trains.slices():
        number = np.array([rails.index[e] for e in edges[rows]])
        run, at = _run(number, position[rows] - rails.start_m[number], rails, ends)
        found[name] = Travelled(time[rows], run, run + braking[name], at, length[name])
    return found


def _run(number: Ints, offset: Floats, rails: Rails, ends: Bools) -> tuple[Floats, Floats]:
    """How far a train has run at every row, from its edges and its places on them, and where on that way blocks end [m]."""
    step = np.diff(offset)
    base = -float(offset[0])  # of the edge it is on: where that begins
    signals = [base]
    for k in np.flatnonzero(number[1:] != number[:-1]):
        a, b = int(number[k]), int(number[k + 1])
        between = None if rails.twin[a] == b or (a, b) in rails.reversal else rails.path(a, b)
        passed = [a, *([] if between is None else between[1:-1].tolist())]
        start = base
        for e in passed:
            base += float(rails.length_m[e])
            if ends[e]:
                signals.append(base)
        step[k] = base + offset[k + 1] - (start + offset[k])
    last = base + float(rails.length_m[int(number[-1])])
    return np.concatenate([[0.0], np.cumsum(step)]), np.array([*signals, last])
