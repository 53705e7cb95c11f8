"""What trains do on the track, whoever drives them: whether two bodies overlap, and whether each keeps to the limits under it.

Everything is told from where the trains are, edge by edge, and from where they were a step ago; nothing of what a supervisor or
a driver sees is used. Two directions of one track are one place. Where tracks cross on a junction, SUMO alone tells collisions.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba import njit

from sumo_net import Line, Rails
from trainctl.kernels import keep_by_sources
from trainctl.monitors.outcome import GAP, LIMIT
from trainctl.railway.signs import Signs, in_force
from trainctl.railway.ways import Ways
from trainctl.signals import Bools, Floats, Ints

if TYPE_CHECKING:
    from trainctl.scenario.model import Model
    from trainctl.signals import Seen

keep_by_sources()  # before anything below is decorated

#: Rounding of positions on a line of some hundred kilometres, as SUMO hands them back.
ROUNDING = 1e-6


class Track(NamedTuple):
    """A railway as it is needed here, E edges."""

    length: Floats  # (E,) m
    twin: Ints  # (E,) the same track in the other direction, -1: none
    before: Ints  # (E,) where a train stands that hangs out behind the beginning of the edge, -1: nowhere, or not known
    limit: Floats  # (E,) m/s


class Overlaps(NamedTuple):
    """Pairs of trains inside one another, or that have run through one another in the last step, k of them."""

    ahead: Ints  # (k,) of two that met head-on the lower number
    behind: Ints  # (k,)
    depth: Floats  # (k,) m, track that is under both; of trains that ran through, how far
    edge: Ints  # (k,) where the front of the one behind is
    place: Floats  # (k,) m from the beginning of that edge


def track(rails: Rails, tracks: Sequence[str] | None = None) -> Track:
    """Arrays of a railway, to be made once per run; ``tracks`` names the track of every edge of a line."""
    before = np.full(len(rails.edges), -1, np.int64)
    for e, edges in enumerate(rails.before):
        lead = [b for b in edges if b != rails.twin[e]]
        straight = [b for b in lead if tracks is not None and tracks[b] == tracks[e]]
        if len(straight or lead) == 1:
            before[e] = (straight or lead)[0]
    length, limit = (np.ascontiguousarray(a, np.float64) for a in (rails.length_m, rails.speed_mps))
    return Track(length, np.ascontiguousarray(rails.twin, np.int64), before, limit)


def overlaps(track: Track, ways: Ways, row: Ints, s: Floats, length: Floats, present: Bools, moved: Floats) -> Overlaps:
    """Find trains inside one another.

    Parameters
    ----------
    track : Track
        From ``track``.
    ways : Ways
        Of all n trains.
    row, s, length, present : ndarray, shape (n,)
        Row in the ways, front [m], length [m], and whether the train is on the net.
    moved : ndarray, shape (n,)
        How far each has moved in the last step [m]; NaN: it has just come.

    Returns
    -------
    Overlaps
        Also of trains that passed through one another between two instants.
    """
    come = np.isnan(moved)
    return Overlaps(*_overlaps(track, ways, row, s, length, present, np.maximum(np.where(come, 0.0, moved), 0.0), come))


def limits(track: Track, ways: Ways, row: Ints, s: Floats, length: Floats, present: Bools) -> tuple[Floats, Ints]:
    """Lowest speed limit under every train (n,) [m/s], from its front to its rear, and the edge (n,) that has it."""
    limit, edge = _limits(track, ways, row, s, length, present)
    return limit, edge


class Watch:
    """Overlaps and overspeeds from step to step."""

    def __init__(
        self, ids: Sequence[str], length: Floats, factor: Floats, rails: Rails, line: Line, net: bool, signs: Signs
    ) -> None:
        self.ids, self.length, self.factor, self.line, self.net = ids, length, factor, line, net
        self.track, self.signs = track(rails, None if net else line.tracks), signs

    def initial(self) -> Floats:
        """Front of every train a step ago [m], shape (n,); NaN where it was not there."""
        return np.full(len(self.length), np.nan)

    def violated(self, t: float, ways: Ways, seen: Seen, speed: Floats, last: Floats) -> Iterator[dict[str, Any]]:
        """What is wrong at ``t`` [s], as fields of an event; ``seen`` counts as the ways do, ``speed`` (n,) [m/s].

        ``last`` (n,), where the fronts were a step ago, is overwritten in place.
        """
        moved = seen.position - last
        last[:] = np.where(seen.present, seen.position, np.nan)
        found = overlaps(self.track, ways, seen.row, seen.position, self.length, seen.present, moved)
        for a, b, depth, edge, place in zip(*(part.tolist() for part in found), strict=True):
            trains = [self.ids[a], self.ids[b]]
            yield {
                "bound": GAP, "who": "-".join(trains), "value": -depth, "limit": 0.0, "trains": trains,
                **located(self.line, self.net, edge, place),
            }  # fmt: skip
        shown = self.track._replace(limit=in_force(self.signs, self.track.limit, t))
        limit, edge_of = limits(shown, ways, seen.row, seen.position, self.length, seen.present)
        limit = self.factor * limit
        for i in (seen.present & (speed > limit + ROUNDING)).nonzero()[0].tolist():
            yield {
                "bound": LIMIT, "who": self.ids[i], "value": float(speed[i]), "limit": float(limit[i]),
                "edge": self.line.edges[edge_of[i]],
            }  # fmt: skip


def of(p: Model) -> Watch:
    """The watch over the trains of a scenario."""
    factor = np.where(p.roster.driven, np.inf, p.roster.speed_factor)  # SUMO's trains may exceed limits, as their types say
    return Watch(p.scenario.ids, p.consists.train_length(), factor, p.rails, p.line, not p.placed, p.signs)


def located(line: Line, net: bool, edge: int, place: float) -> dict[str, Any]:
    """A place for an event: on a line of tracks also as track and kilometrage."""
    found = {"edge": line.edges[edge], "edge_m": round(place, 6)}
    return found if net else {**found, "track": line.tracks[edge], "position_m": round(float(line.start_m[edge]) + place, 6)}


@njit(cache=True)
def _pieces(
    track: Track, ways: Ways, row: Ints, s: Floats, length: Floats, present: Bools, moved: Floats
) -> tuple[Ints, Ints, Floats, Floats]:
    """Where the bodies were over the last step: train, edge (of twins the lower number), from and to on it [m]; P pieces."""
    count = 0
    for again in range(2):
        train, edge = np.empty(count * again, np.int64), np.empty(count * again, np.int64)
        low, high = np.empty(count * again), np.empty(count * again)
        count = 0
        for i in range(len(row)):
            if not present[i]:
                continue
            k, top, bottom = row[i], s[i], s[i] - length[i] - moved[i]
            e, begin = ways.edge[k], ways.begin[k]
            while True:
                if again:
                    lo, hi = max(bottom - begin, 0.0), min(top - begin, track.length[e])
                    t = track.twin[e]
                    if 0 <= t < e:
                        train[count], edge[count], low[count], high[count] = i, t, track.length[t] - hi, track.length[t] - lo
                    else:
                        train[count], edge[count], low[count], high[count] = i, e, lo, hi
                count += 1
                if begin <= bottom:
                    break
                if k > ways.first[i]:
                    k -= 1
                    e, begin = ways.edge[k], ways.begin[k]
                else:
                    bottom = max(bottom, s[i] - length[i])  # no train has moved there
                    e = track.before[e]
                    if e < 0 or begin <= bottom:
                        break
                    begin -= track.length[e]
    return train, edge, low, high


@njit(cache=True)
def _near(n: int, train: Ints, edge: Ints, low: Floats, high: Floats) -> Ints:
    """Pairs of trains whose pieces meet, as i n + j with i < j, each once."""
    by_place = np.argsort(edge * 1e7 + low)  # no edge is that long; how ties fall does not matter
    reach = np.empty(len(by_place))  # how far this piece or one before it on the edge reaches
    count = 0
    for again in range(2):
        pairs = np.empty(count * again, np.int64)
        count = 0
        for p in range(len(by_place)):
            b = by_place[p]
            reach[p] = high[b]
            q = p - 1
            if q >= 0 and edge[by_place[q]] == edge[b]:
                reach[p] = max(reach[q], high[b])
            while q >= 0 and edge[by_place[q]] == edge[b] and reach[q] >= low[b] - ROUNDING:
                a = by_place[q]
                if high[a] >= low[b] - ROUNDING and train[a] != train[b]:
                    if again:
                        pairs[count] = min(train[a], train[b]) * n + max(train[a], train[b])
                    count += 1
                q -= 1
    return np.unique(pairs)


@njit(cache=True)
def _overlaps(
    track: Track, ways: Ways, row: Ints, s: Floats, length: Floats, present: Bools, moved: Floats, come: Bools
) -> tuple[Ints, Ints, Floats, Ints, Floats]:
    """Rows of ``Overlaps``."""
    n = len(row)
    pairs = _near(n, *_pieces(track, ways, row, s, length, present, moved))
    ahead, behind = np.empty(len(pairs), np.int64), np.empty(len(pairs), np.int64)
    depth, edge, place = np.empty(len(pairs)), np.empty(len(pairs), np.int64), np.empty(len(pairs))
    count = 0
    if len(pairs):
        train, on, low, high = _pieces(track, ways, row, s, length, present, np.zeros(n))
        first = np.searchsorted(train, np.arange(n + 1))
    for pair in pairs:
        i, j = pair // n, pair % n
        shared = 0.0
        for p in range(first[i], first[i + 1]):
            for q in range(first[j], first[j + 1]):
                if on[p] == on[q]:
                    shared += max(min(high[p], high[q]) - max(low[p], low[q]), 0.0)
        before, now = _lead(track, ways, row, s, length, moved, i, j)
        if np.isnan(before):  # the front of j is not on the way of i, but that of i may be on the way of j
            before, now = _lead(track, ways, row, s, length, moved, j, i)
            before, now = -before, -now
        a, b = (j, i) if before > 0.0 else (i, j)
        if shared <= ROUNDING:
            if come[i] or come[j] or not before * now < 0.0:
                continue
            shared = abs(now) + length[a]
        ahead[count], behind[count], depth[count] = a, b, shared
        edge[count], place[count] = ways.edge[row[b]], s[b] - ways.begin[row[b]]
        count += 1
    return ahead[:count], behind[:count], depth[:count], edge[:count], place[:count]


@njit(cache=True)
def _lead(track: Track, ways: Ways, row: Ints, s: Floats, length: Floats, moved: Floats, i: int, j: int) -> tuple[float, float]:
    """How far the front of ``j`` is ahead of that of ``i`` on the way of ``i``, a step ago and now [m]; NaN: not on it."""
    reach = length[i] + length[j] + moved[i] + moved[j]
    now = _on_way(track, ways, i, row[i], s[i] - reach, s[i] + reach, ways.edge[row[j]], s[j] - ways.begin[row[j]]) - s[i]
    k, point = row[j], s[j] - moved[j]
    while k > ways.first[j] and ways.begin[k] > point:
        k -= 1
    before = _on_way(track, ways, i, row[i], s[i] - reach, s[i] + reach, ways.edge[k], point - ways.begin[k]) - (s[i] - moved[i])
    return before, now


@njit(cache=True)
def _on_way(track: Track, ways: Ways, i: int, row: int, low: float, high: float, edge: int, place: float) -> float:
    """Where the point ``place`` of an edge is on the way of ``i`` between ``low`` and ``high`` [m]; NaN: not on it."""
    k = row
    while k > ways.first[i] and ways.begin[k] > low:
        k -= 1
    while k < ways.first[i + 1] and ways.begin[k] <= high:
        e = ways.edge[k]
        if e == edge:
            return float(ways.begin[k] + place)
        if track.twin[e] == edge:
            return float(ways.begin[k] + track.length[e] - place)
        k += 1
    return np.nan


@njit(cache=True)
def _limits(track: Track, ways: Ways, row: Ints, s: Floats, length: Floats, present: Bools) -> tuple[Floats, Ints]:
    """Lowest limit under every train, and whose edge's it is."""
    limit, edge = np.full(len(row), np.inf), np.full(len(row), -1, np.int64)
    for i in range(len(row)):
        if not present[i]:
            continue
        k = row[i]
        while True:
            e = ways.edge[k]
            if track.limit[e] < limit[i]:
                limit[i], edge[i] = track.limit[e], e
            if k == ways.first[i] or ways.begin[k] <= s[i] - length[i] + ROUNDING:
                break
            k -= 1
    return limit, edge
