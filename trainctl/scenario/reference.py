"""Reference profiles as data: what the scenario's ``[reference]`` table says, as the piecewise polynomials the loop evaluates.

Five forms, all exact: a constant speed; speeds that step where the reference itself passes a kilometrage; quintic S-curves in
speed (continuous acceleration and jerk); a table of speeds with straight lines between; the speed limits of the line, which become
such a table.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from trainctl.signals import Reference, Table

#: Forms of a profile; exactly one of these keys stands in the table.
FORMS = ("speed_mps", "speed_by_position", "s_curves", "table", "follow_line")

#: Keys that only ``follow_line`` has.
FOLLOWING = ("acceleration_mps2", "deceleration_mps2", "below_limit_mps", "margin_m", "stop_m")


def constant(speed: float, position: float) -> Reference:
    """Constant ``speed`` [m/s] from ``position`` [m] at time 0."""
    return _joined([0.0], [[position, speed]])


def by_position(steps: Sequence[tuple[float, float]], position: float) -> Reference:
    """Speeds that step where the reference passes given kilometrages, with no ramp.

    Parameters
    ----------
    steps : sequence of (from_m, speed_mps)
        Ascending kilometrages [m] and the positive speed that holds from there on [m/s]. The first speed also holds before
        its kilometrage.
    position : float
        Where the reference is at time 0 [m].

    Returns
    -------
    Reference
        One linear piece per speed still to come; the breaks are the instants of the steps.
    """
    ahead = [k for k, (from_m, _) in enumerate(steps) if from_m > position and k > 0]
    speed = steps[(ahead[0] if ahead else len(steps)) - 1][1]
    breaks, pieces = [0.0], [[position, speed]]
    for k in ahead:
        from_m, after = steps[k]
        breaks.append(breaks[-1] + (from_m - pieces[-1][0]) / speed)
        pieces.append([from_m, after])
        speed = after
    return _joined(breaks, pieces)


def s_curves(position: float, speed: float, curves: Sequence[tuple[float, float, float]]) -> Reference:
    """Quintic S-curves in speed: acceleration and its derivative are continuous and zero at both ends of each curve.

    With ``s = (t - start) / duration`` the speed is ``v_a + D (10 s^3 - 15 s^4 + 6 s^5)``; between curves it is constant.

    Parameters
    ----------
    position, speed : float
        Of the reference at time 0 [m], [m/s].
    curves : sequence of (start_s, end_s, final_speed)
        In order and without overlap [s], [s], [m/s].
    """
    breaks, pieces = [0.0], [[position, speed]]
    for start, end, final in curves:
        x, v = pieces[-1][0] + pieces[-1][1] * (start - breaks[-1]), pieces[-1][1]
        d, change = end - start, final - v
        if start == breaks[-1]:
            breaks.pop()
            pieces.pop()
        breaks += [start, end]
        pieces.append([x, v, 0.0, 0.0, 2.5 * change / d**3, -3.0 * change / d**4, change / d**5])
        pieces.append([x + v * d + 0.5 * change * d, final])
    return _joined(breaks, pieces)


def table(points: Sequence[tuple[float, float]], position: float) -> Reference:
    """Speed as straight lines between (time_s, speed_mps) points; the last speed holds for ever, two points at one time are a step.

    Parameters
    ----------
    points : sequence of (time_s, speed_mps)
        From time 0 on, ascending.
    position : float
        Of the reference at time 0 [m].
    """
    breaks: list[float] = []
    pieces: list[list[float]] = []
    for (begin, v), (end, after) in pairwise(points):
        if end > begin:
            breaks.append(begin)
            pieces.append([position, v, 0.5 * (after - v) / (end - begin)])
            position += 0.5 * (v + after) * (end - begin)
    return _joined([*breaks, points[-1][0]], [*pieces, [position, points[-1][1]]])


class Stretch(NamedTuple):
    """A piece of way on which the maximum speed squared is a straight line."""

    start: float  # m
    end: float  # m, inf for the last one
    enter: float  # m2/s2, speed squared at the start
    leave: float  # m2/s2, at the end


def obeying(
    limits: Sequence[tuple[float, float]],
    position: float,
    speed: float,
    reach: tuple[float, float],
    rates: tuple[float, float],
    cap: float = math.inf,
    below: float = 0.0,
    stop: float | None = None,
) -> list[tuple[float, float]]:
    """Fastest speeds of a reference whose whole formation obeys the line's speed limits.

    The limit in force is the lowest anywhere between ``reach``: a formation brakes before its front enters a restriction, and
    speeds up once its rear has cleared it. Acceleration and deceleration are constant, so speed squared is piecewise linear in
    position, and speed in time.

    Parameters
    ----------
    limits : sequence of (from_m, speed_mps)
        Ascending kilometrages [m]; the first limit also holds before its own, the last one for ever.
    position, speed : float
        Of the reference at time 0 [m], [m/s].
    reach : tuple of float
        Where the formation ends behind the reference and ends ahead of it, relative to it [m], in this order.
    rates : tuple of float
        Acceleration and deceleration, both positive [m/s2].
    cap : float
        Maximum speed [m/s].
    below : float
        How far to stay below the limits (not the cap) [m/s].
    stop : float, optional
        Where the reference comes to a standstill [m]; it never does if left out.

    Returns
    -------
    list of (time_s, speed_mps)
        The points of ``table``.

    Raises
    ------
    ValueError
        If it cannot be done, in words.
    """
    stretches = _braking(_allowed(limits, position, reach, cap, below, stop), rates[1], stop is not None)
    enter = stretches[0].enter
    if speed**2 > enter * (1.0 + 1e-9):
        raise ValueError(
            f"starts with {speed:.10g} m/s, but the limits ahead allow {math.sqrt(enter):.10g} m/s at {position:.10g} m when"
            f" braking with {rates[1]:g} m/s2"
        )
    t, points = 0.0, [(0.0, speed)]
    for (a, before), (b, after) in pairwise(_speeding_up(stretches, position, speed**2, rates[0])):
        v, w = math.sqrt(before), math.sqrt(after)
        if b - a > 1e-9:
            t += 2.0 * (b - a) / (v + w)
            points.append((t, w))
    return points


def _allowed(
    limits: Sequence[tuple[float, float]],
    position: float,
    reach: tuple[float, float],
    cap: float,
    below: float,
    stop: float | None,
) -> list[tuple[float, float, float]]:
    """(start, end, speed) of the stretches on which one limit is in force for the reference."""
    rear, front = reach
    end = math.inf if stop is None else stop
    if not end > position:
        raise ValueError(f"stops at {end:.10g} m, at or behind its start at {position:.10g} m")
    changes = [at - offset for at, _ in limits[1:] for offset in reach]
    starts = [position, *sorted({x for x in changes if position < x < end})]
    until = [at for at, _ in limits[1:]] + [math.inf]
    found: list[tuple[float, float, float]] = []
    for a, b in pairwise([*starts, end]):
        inside = 0.5 * (a + b) if math.isfinite(b) else a + 1.0
        # The first limit begins nowhere, the last one ends nowhere.
        force = [(v, at) for k, (at, v) in enumerate(limits) if (k == 0 or at < inside + front) and until[k] > inside + rear]
        limit, at = min(force)
        v = min(limit - below, cap)
        if v <= 0.0:
            raise ValueError(f"the limit of {limit:.10g} m/s at {at:.10g} m is not above below_limit_mps = {below:g}")
        if found and found[-1][2] == v:
            a = found.pop()[0]
        found.append((a, b, v))
    return found


def _braking(allowed: Sequence[tuple[float, float, float]], deceleration: float, stops: bool) -> list[Stretch]:
    """Lower what is allowed where the reference must brake for what comes."""
    found: list[Stretch] = []
    enter = 0.0 if stops else math.inf
    for a, b, v in reversed(allowed):
        most, leave = v * v, min(enter, v * v)
        if math.isinf(b):
            found.append(Stretch(a, b, most, most))
            enter = most
            continue
        from_here = b - (most - leave) / (2.0 * deceleration)  # where braking begins
        if from_here < b:
            enter = most if from_here > a else leave + 2.0 * deceleration * (b - a)
            found.append(Stretch(max(from_here, a), b, enter, leave))
        if from_here > a:
            enter = most
            found.append(Stretch(a, min(from_here, b), most, most))
    return found[::-1]


def _speeding_up(stretches: Sequence[Stretch], position: float, square: float, acceleration: float) -> list[tuple[float, float]]:
    """Positions and speeds squared between which it changes linearly."""
    nodes = [(position, square)]
    for a, b, enter, leave in stretches:
        square = min(square, enter)
        slope = 0.0 if math.isinf(b) else (leave - enter) / (b - a)
        if square < enter:
            meets = a + (enter - square) / (2.0 * acceleration - slope)
            if meets >= b:
                square += 2.0 * acceleration * (b - a)
                nodes.append((b, square))
                continue
            nodes.append((meets, enter + slope * (meets - a)))
        if math.isfinite(b):
            nodes.append((b, leave))
            square = leave
    return nodes


def _joined(breaks: Sequence[float], pieces: Sequence[Sequence[float]]) -> Reference:
    """Pieces of any degree as one table; the last one never ends."""
    position = np.zeros((len(pieces), max(len(p) for p in pieces)))
    for row, piece in zip(position, pieces, strict=True):
        row[: len(piece)] = piece
    return Reference(np.array([*breaks, np.inf]), position)


Pair = Annotated[tuple[float, float], Field(strict=False)]  # a TOML array is a list: lax about that, not about its numbers
Triple = Annotated[tuple[float, float, float], Field(strict=False)]


class Profile(Table):
    """The ``[reference]`` table: exactly one of the five forms, and where the reference starts."""

    position_m: float | None = Field(None, description="position of the reference at time 0 [m]; default: the first train's")
    speed_mps: float | None = Field(None, ge=0.0, description="constant speed; with follow_line the maximum speed [m/s]")
    speed_by_position: tuple[Pair, ...] | None = Field(
        None, strict=False, min_length=1, description="[[from_m, speed_mps], ...]: steps where the reference passes from_m"
    )
    s_curves: tuple[Triple, ...] | None = Field(
        None, strict=False, min_length=1, description="[[start_s, end_s, final_speed_mps], ...]: quintic S-curves in speed"
    )
    start_speed_mps: float | None = Field(
        None, ge=0.0, description="speed before the first of s_curves [m/s]; with follow_line default: the first train's"
    )
    table: tuple[Pair, ...] | None = Field(
        None, strict=False, min_length=1, description="[[time_s, speed_mps], ...]: straight lines; a repeated time is a step"
    )

    follow_line: bool | None = Field(
        None, description="true: the line's speed limits, whichever is in force for any member of the formation in its slot"
    )
    acceleration_mps2: float | None = Field(None, gt=0.0, description="follow_line: acceleration [m/s2], default 0.3")
    deceleration_mps2: float | None = Field(None, gt=0.0, description="follow_line: braking, positive [m/s2], default 0.5")
    below_limit_mps: float | None = Field(None, ge=0.0, description="follow_line: stay this far below the limits [m/s], default 0")
    margin_m: float | None = Field(
        None, ge=0.0, description="follow_line: treat the formation as this much longer at both ends [m], default 0"
    )
    stop_m: float | None = Field(
        None, description="follow_line: where the first train's slot comes to a standstill [m], default never"
    )

    @model_validator(mode="after")
    def _one_form_in_order(self) -> Self:
        """All mistakes at once: a profile is short, and its author wants the whole list."""
        given = [key for key in FORMS if getattr(self, key) is not None and getattr(self, key) is not False]
        wrong = []
        if "follow_line" in given:
            given = [key for key in given if key != "speed_mps"]  # its cap
        else:
            wrong += [f"{key} belongs to follow_line" for key in FOLLOWING if getattr(self, key) is not None]
        if len(given) != 1:
            wrong.append(f"exactly one of {', '.join(FORMS)} is needed, here {' and '.join(given) or 'none'}")
        if not self.follow_line and (self.s_curves is not None) != (self.start_speed_mps is not None):
            wrong.append("start_speed_mps belongs to s_curves, and s_curves need it")
        for k, (from_m, v) in enumerate(self.speed_by_position or ()):
            here = f"speed_by_position[{k}] = [{from_m:g}, {v:g}]"
            if v <= 0.0:
                wrong.append(f"{here}: speed must be above 0, or the next step is never reached")
            if k and from_m <= self.speed_by_position[k - 1][0]:  # type: ignore[index]
                wrong.append(f"{here}: kilometrages must ascend")
        free = 0.0
        for k, (start, end, v) in enumerate(self.s_curves or ()):
            here = f"s_curves[{k}] = [{start:g}, {end:g}, {v:g}]"
            if start < free:
                wrong.append(f"{here}: starts before {free:g} s, the {'end of the curve before' if k else 'start of the run'}")
            if end <= start:
                wrong.append(f"{here}: ends at or before its start")
            if v < 0.0:
                wrong.append(f"{here}: speed must not be below 0")
            free = max(free, end)
        for k, (t, v) in enumerate(self.table or ()):
            here = f"table[{k}] = [{t:g}, {v:g}]"
            if k == 0 and t != 0.0:
                wrong.append(f"{here}: the first time must be 0")
            if k and t < self.table[k - 1][0]:  # type: ignore[index]
                wrong.append(f"{here}: times must not descend")
            if v < 0.0:
                wrong.append(f"{here}: speed must not be below 0")
        if wrong:
            raise ValueError("; ".join(wrong))
        return self

    def followed(
        self, limits: Sequence[tuple[float, float]], start: float, speed: float, first_slot: float, rear: float
    ) -> Profile:
        """Return the same as a table, which stands without the line: what ``follow_line`` means on this one.

        Parameters
        ----------
        limits : sequence of (from_m, speed_mps)
            Of the line, see ``obeying``.
        start, speed : float
            Of the reference at time 0, if the table does not say [m], [m/s].
        first_slot, rear : float
            The slot of the first train's front, and that of the last one's rear [m].

        Raises
        ------
        ValueError
            If it cannot be done, in words.
        """
        position = start if self.position_m is None else self.position_m
        margin = self.margin_m or 0.0
        points = obeying(
            limits,
            position,
            speed if self.start_speed_mps is None else self.start_speed_mps,
            (rear - margin, first_slot + margin),
            (self.acceleration_mps2 or 0.3, self.deceleration_mps2 or 0.5),
            math.inf if self.speed_mps is None else self.speed_mps,
            self.below_limit_mps or 0.0,
            None if self.stop_m is None else self.stop_m - first_slot,
        )
        return Profile(position_m=position, table=tuple(points))

    def leader(self, start: float = 0.0) -> Reference:
        """Return the virtual leader; ``start`` [m] is where it begins if the table does not say. Not for ``follow_line``."""
        position = start if self.position_m is None else self.position_m
        if self.speed_mps is not None and not self.follow_line:
            return constant(self.speed_mps, position)
        if self.speed_by_position is not None:
            return by_position(self.speed_by_position, position)
        if self.s_curves is not None and self.start_speed_mps is not None:
            return s_curves(position, self.start_speed_mps, self.s_curves)
        assert self.table is not None  # the validator saw to it
        return table(self.table, position)
