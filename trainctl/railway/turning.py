"""Where trains turn back: the legs of a route between two turns, and what of the track a train must be on to turn.

A train turns where its route goes over into the other direction of the track it is on. It has stopped then, with all of itself on
track that its next leg runs back over, edge by edge; its rear becomes its front, see ``ways.turned``. As in SUMO 1.28 the next leg
must have as many normal edges as there are edges under the train, those inside junctions too, and the rear must not stand inside a
junction: SUMO puts such a train somewhere else. It puts a train that reaches over junctions farther by their length; to make up for
that the train is ordered to go on by as much before it turns, so there must be room for it.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from trainctl.signals import Bools, Floats, Ints

#: A train that turns stops at least this far before the end of its edge [m]; nearer than 0.1 m SUMO would let it arrive.
SHORT_M = 0.2

#: Room that is left beyond what a train goes on by before it turns [m].
SPARE_M = 0.01

#: Rounding in positions [m].
ROUNDING_M = 1e-6


class Yard(NamedTuple):
    """Where the front of a train may stop to turn, between the ends of the edges of a leg that its next leg runs back over."""

    places: Floats  # (k, 2) m, from and to, as positions on the way; in order, none where it is too long to turn

    def next(self, front: float) -> float:
        """The nearest place at ``front`` or beyond [m]; inf: none."""
        for begin, end in self.places.tolist():
            if front <= end + ROUNDING_M:
                return max(front, float(begin))
        return float("inf")

    def aim(self, front: float, braking: float, into: float) -> float:
        """Where a train at ``front`` that could stop ``braking`` [m] farther on is to stop [m].

        It brakes as soon as it may turn; ``into`` [m] is how far into such track it aims at least, if there is room.
        """
        where = self.next(front)
        if where > self.last:
            return self.last
        begin, end = self.places[self.places[:, 1] >= where - ROUNDING_M][0].tolist()
        return min(self.next(max(where + braking, begin + min(into, 0.5 * (end - begin)))), self.last)

    def holds(self, front: float) -> bool:
        """Whether a train with its front there may turn."""
        return bool(np.any((self.places[:, 0] - ROUNDING_M <= front) & (front <= self.places[:, 1] + ROUNDING_M)))

    @property
    def last(self) -> float:
        """The farthest place [m], -inf: none."""
        return float(self.places[-1, 1]) if len(self.places) else -np.inf


def legs(edges: Sequence[int], reversal: Collection[tuple[int, int]]) -> list[list[int]]:
    """The parts of a way between two turns; ``reversal`` are the pairs of edges that are a change of direction."""
    found = [list(edges[:1])]
    for a, b in pairwise(edges):
        if (a, b) in reversal:
            found.append([])
        found[-1].append(b)
    return found


def inside(onward: Ints, front: float, internal: Bools, length_m: Floats) -> float:
    """Length of the junctions under a train that has turned [m]: its front is ``front`` [m] from the beginning of its new way."""
    begin = np.concatenate([[0.0], np.cumsum(length_m[onward])])
    behind = onward[: int(np.searchsorted(begin[1:-1], front, side="left"))]
    return float(length_m[behind[internal[behind]]].sum())


def yard(
    leg: Ints, begin: Floats, onward: Ints, twin: Ints, internal: Bools, length_m: Floats, length: float,
    before: Sequence[Sequence[int]] = (),
) -> Yard:  # fmt: skip
    """Where a train may turn.

    Parameters
    ----------
    leg : ndarray, shape (W,)
        Edges of its way up to the turn, internal ones included.
    begin : ndarray, shape (W,)
        Position at which each begins [m].
    onward : ndarray, shape (V,)
        Edges of its way after the turn.
    twin, internal, length_m : ndarray, shape (E,)
        Of the net, as in ``Rails``.
    length : float
        Of the train [m].
    before : sequence of sequences of int
        Edges that lead into each: where these are known a train may hang out behind the beginning of its way, as it enters.
    """
    leg, begin = _with_what_lies_behind(leg, begin, onward, twin, length_m, length, before)
    rows = min(len(leg), int((~internal[onward]).sum()))
    common = 0
    while common < rows and twin[leg[-1 - common]] == onward[common]:
        common += 1
    end = float(begin[-1] + length_m[leg[-1]]) - SHORT_M
    found = []
    for k in range(len(leg) - common, len(leg)):
        if internal[leg[k]]:
            continue
        inside = float(length_m[leg[k:]][internal[leg[k:]]].sum())
        first, last = max(float(begin[k]) + length, float(begin[-1]) + SPARE_M), float(begin[k] + length_m[leg[k]]) + length
        last = min(last - (inside + SPARE_M if inside else ROUNDING_M), end + SHORT_M - max(inside + SPARE_M, SHORT_M))
        if first <= last:
            found.append((first, last))
    return Yard(np.array(found).reshape(-1, 2))


def _with_what_lies_behind(
    leg: Ints, begin: Floats, onward: Ints, twin: Ints, length_m: Floats, length: float, before: Sequence[Sequence[int]]
) -> tuple[Ints, Floats]:
    """A leg on from its beginning to where the rear of a train may be, if the train runs back over all of it.

    No farther than the first switch: where SUMO takes such a train to be beyond is not known.
    """
    if not np.array_equal(twin[leg[::-1]], onward[: len(leg)]):
        return leg, begin
    end, behind, starts = float(begin[-1] + length_m[leg[-1]]), leg.tolist(), begin.tolist()
    for there in onward[len(leg) :].tolist() if len(before) else []:
        edge = int(twin[there])
        others = [e for e in before[behind[0]] if e != twin[behind[0]]]
        if starts[0] <= end - length or others != [edge]:
            break
        behind, starts = [edge, *behind], [starts[0] - float(length_m[edge]), *starts]
    return np.array(behind, np.int64), np.array(starts)
