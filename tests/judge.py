"""A judge of runs that asks nobody else: where every train was at every step, and from that who lay upon whom.

It knows the edges of the net, their lengths, limits and twins, each train's way and length, and the place and speed of its front at
every step. It uses nothing of what the program thinks of them: no gaps, no targets, no alarms.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from trainctl.scenario.model import Model

#: Trains that touch do not overlap; rounding of positions that add up over a run [m].
TOUCH_M = 1e-3

#: Faster than the line's limit by more than this is an overspeed [m/s].
OVERSPEED_MPS = 0.1

#: Slower than this is backwards [m/s]; farther back than this in a step [m].
BACKWARDS = 1e-6

#: Trains move by less than this share of the shortest train between two looks.
LOOK = 0.45
MOST_LOOKS = 64


class Tracks(NamedTuple):
    """Where trains were at K instants on n ways: one for each train, and one more whenever it turns back."""

    time: np.ndarray  # (K,) s
    along: np.ndarray  # (K, n) m, front, from the beginning of the way
    speed: np.ndarray  # (K, n) m/s, of the front
    minimum: np.ndarray  # (K, n) m/s, of the slowest unit
    present: np.ndarray  # (K, n) whether the train is on that way
    ways: list[np.ndarray]  # edges of every way
    who: np.ndarray  # (n,) whose way it is


class Findings(NamedTuple):
    """What was found, each in words with the worst of its kind; None: nothing."""

    overlap: str | None
    overspeed: str | None
    backwards: str | None


class Recording:
    """Gathers ``Tracks`` from a simulation: ``look`` before the first step and after every one."""

    def __init__(self, p: Model) -> None:
        self.p = p
        self.rows: list[tuple[Any, ...]] = []
        self.legs: list[np.ndarray] = []
        self.ways: dict[tuple[int, int], np.ndarray] = {}  # of every train and leg, as it was in the end

    def look(self, sim: Any) -> None:
        """Write down where the fronts are, as the world measures it."""
        seen, ways = sim.world.measure(), sim.world.ways
        own, leading = sim.state.own, self.p.leading
        along = seen.position - ways.begin[ways.first[:-1]]
        minimum = np.minimum.reduceat(own[:, 1], leading)
        parked = sim.state.traffic.parked  # who is parked stands beside the track
        there = seen.present & ~parked
        if self.rows:  # SUMO's own trains leave it with the step in which they stop; the program knows a step later
            self.rows[-1][-1][:] &= ~(parked & self.p.roster.driven)
        self.rows.append((sim.time, along, own[leading, 1].copy(), minimum, there))
        self.legs.append(sim.state.traffic.leg.copy())
        for i, leg in enumerate(self.legs[-1].tolist()):
            self.ways[i, leg] = ways.edge[ways.first[i] : ways.first[i + 1]].copy()

    def tracks(self) -> Tracks:
        """All of it."""
        time, along, speed, minimum, present = (np.array(column) for column in zip(*self.rows, strict=True))
        who, leg = np.array(sorted(self.ways)).T
        on = np.array(self.legs)[:, who] == leg
        ways = [self.ways[key] for key in sorted(self.ways)]
        return Tracks(time, along[:, who], speed[:, who], minimum[:, who], present[:, who] & on, ways, who)


def judge(p: Model, tracks: Tracks) -> Findings:
    """Overlaps, overspeeds and backward motion in a run."""
    return Findings(overlap(p, tracks), overspeed(p, tracks), backwards(p, tracks))


def behind(p: Model, edge: int) -> int:
    """The edge before another one, if that is certain; -1: there is none, or several."""
    rails = p.rails
    found = [e for e in rails.before[edge] if (e, edge) not in rails.reversal]
    if p.placed:  # tracks of a line go straight on, crossovers come in from the side
        over = {rails.index[c.edge] for c in p.line.crossovers}
        found = [e for e in found if e not in over and p.line.tracks[e] == p.line.tracks[edge]]
    return found[0] if len(found) == 1 else -1


def laid(p: Model, way: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray]:
    """A way with what lies before it, as far as a train of this length hangs out, and where each of its edges begins [m]."""
    edges, hangs = way.tolist(), 0.0
    while hangs < length and (before := behind(p, edges[0])) >= 0 and len(edges) < 10_000:
        edges.insert(0, before)
        hangs += float(p.rails.length_m[before])
    begins = np.concatenate([[0.0], np.cumsum(p.rails.length_m[edges])]) - hangs
    return np.array(edges), begins


def bodies(p: Model, tracks: Tracks, frames: np.ndarray, present: np.ndarray) -> tuple[np.ndarray, ...]:
    """Frame, train, edge, from and to [m] of every piece of track under a train; of an edge and its twin the first stands for both.

    ``frames`` (F, n) are places of the fronts along the ways.
    """
    rails, lengths, parts = p.rails, p.consists.train_length()[tracks.who], []
    for i, way in enumerate(tracks.ways):
        edges, begins = laid(p, way, float(lengths[i]))
        front = frames[:, i, None]
        low, high = np.maximum(begins[:-1], front - lengths[i]), np.minimum(begins[1:], front)
        f, k = np.nonzero((high > low) & present[:, i, None])
        edge, low, high = edges[k], low[f, k] - begins[k], high[f, k] - begins[k]
        twin = rails.twin[edge]
        turned = (twin >= 0) & (twin < edge)
        size = rails.length_m[edge]
        low, high = np.where(turned, size - high, low), np.where(turned, size - low, high)
        parts.append((f, np.full(len(f), i), np.where(turned, twin, edge), low, high))
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))


def overlap(p: Model, tracks: Tracks) -> str | None:
    """The deepest overlap of two bodies, or of two on tracks that cross, with its first instant."""
    n, lengths, who = len(tracks.ways), p.consists.train_length(), tracks.who
    if n < 2 or len(tracks.time) < 2:
        return None
    moved = np.abs(np.diff(tracks.along, axis=0))[tracks.present[1:] & tracks.present[:-1]]
    shortest = float(lengths[lengths > 0.0].min(initial=np.inf))
    looks = int(np.clip(np.ceil(moved.max(initial=0.0) / (LOOK * shortest)), 1, MOST_LOOKS)) if np.isfinite(shortest) else 1
    share = np.arange(looks)[None, :, None] / looks  # between two instants everybody is taken to move evenly
    between = (tracks.along[:-1, None] * (1.0 - share) + tracks.along[1:, None] * share).reshape(-1, n)
    here = np.repeat(tracks.present[:-1] & tracks.present[1:], looks, axis=0)
    here[::looks] = tracks.present[:-1]
    frames, here = np.vstack([between, tracks.along[-1:]]), np.vstack([here, tracks.present[-1:]])
    frame, way, edge, low, high = bodies(p, tracks, frames, here)
    train = who[way]
    edges = len(p.rails.edges)
    key = frame * edges + edge
    order = np.lexsort((low, key))
    frame, train, edge, low, high, key = (column[order] for column in (frame, train, edge, low, high, key))
    hits: list[tuple[float, int, int, int, int]] = []  # depth, frame, train, train, edge
    for d in range(1, len(key)):
        same = key[:-d] == key[d:]
        if not same.any():
            break
        depth = np.minimum(high[:-d], high[d:]) - low[d:]
        for k in np.flatnonzero(same & (train[:-d] != train[d:]) & (depth > TOUCH_M)).tolist():
            hits.append((float(depth[k]), int(frame[k]), int(train[k]), int(train[k + d]), int(edge[k])))
    for a, row in enumerate(p.rails.crossing):
        for b in row:
            if a < b:
                hits += crossed(frame, train, edge, a, b)
    if not hits:
        return None
    first = min(hits, key=lambda hit: hit[1])
    deepest = max(hits)
    ids, time = p.scenario.ids, tracks.time
    at = time[min(first[1] // looks, len(time) - 1)]
    return f"{ids[first[2]]} and {ids[first[3]]} on {p.rails.edges[first[4]]} from {at:g} s on, up to {deepest[0]:.3f} m"


def crossed(
    frame: np.ndarray, train: np.ndarray, edge: np.ndarray, a: int, b: int
) -> list[tuple[float, int, int, int, int]]:  # fmt: skip
    """Two trains at once on two tracks that cross."""
    found = []
    on = [dict(zip(frame[edge == e].tolist(), train[edge == e].tolist(), strict=True)) for e in (a, b)]
    for f, t in on[0].items():
        other = on[1].get(f, t)
        if other != t:
            found.append((0.0, f, t, other, a))
    return found


def overspeed(p: Model, tracks: Tracks) -> str | None:
    """The maximum excess over the limit of any edge under a train, as signs show it, and its own share of that."""
    worst = (OVERSPEED_MPS, "")
    shown = np.tile(p.rails.speed_mps, (len(tracks.time), 1))
    for since, edge, speed in zip(*p.signs, strict=True):
        shown[tracks.time >= since - 1e-9, edge] = speed
    for i, way in enumerate(tracks.ways):
        train = int(tracks.who[i])
        if p.roster.driven[train]:  # by SUMO, as its type says
            continue
        begins = np.concatenate([[0.0], np.cumsum(p.rails.length_m[way])])
        front = tracks.along[:, i, None]
        under = (begins[:-1] < front - TOUCH_M) & (begins[1:] > front - p.consists.train_length()[train] + TOUCH_M)
        limit = np.min(np.where(under, p.roster.speed_factor[train] * shown[:, way], np.inf), axis=1)
        excess = np.where(tracks.present[:, i], tracks.speed[:, i] - limit, -np.inf)
        k = int(np.argmax(excess))
        if excess[k] > worst[0]:
            words = f"{p.scenario.ids[train]} with {tracks.speed[k, i]:.3f} m/s at {tracks.time[k]:g} s, limit {limit[k]:g}"
            worst = (float(excess[k]), words)
    return worst[1] or None


def backwards(p: Model, tracks: Tracks) -> str | None:
    """The first time that a train, or one of its units, moves backwards."""
    ids, there = p.scenario.ids, tracks.present[1:] & tracks.present[:-1]
    for what, broken, value in (
        ("place", (np.diff(tracks.along, axis=0) < -BACKWARDS) & there, np.diff(tracks.along, axis=0)),
        ("speed", (tracks.speed < -BACKWARDS) & tracks.present, tracks.speed),
        ("unit", (tracks.minimum < -1e-3) & tracks.present, tracks.minimum),
    ):
        if broken.any():
            k, i = (int(x) for x in np.argwhere(broken)[0])
            return f"{ids[tracks.who[i]]} backwards at {tracks.time[k]:g} s ({what}: {value[k, i]:.4g})"
    return None
