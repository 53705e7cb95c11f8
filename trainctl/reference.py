"""Reference profiles as data: what the scenario's ``[reference]`` table says, as the piecewise polynomials the loop evaluates.

Four forms, all exact: a constant speed; speeds that step where the reference itself passes a kilometrage; quintic S-curves in
speed (continuous acceleration and jerk); a table of speeds with straight lines between.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from trainctl.signals import Reference, Table

#: Forms of a profile; exactly one of these keys stands in the table.
FORMS = ("speed_mps", "speed_by_position", "s_curves", "table")


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


def _joined(breaks: Sequence[float], pieces: Sequence[Sequence[float]]) -> Reference:
    """Pieces of any degree as one table; the last one never ends."""
    position = np.zeros((len(pieces), max(len(p) for p in pieces)))
    for row, piece in zip(position, pieces, strict=True):
        row[: len(piece)] = piece
    return Reference(np.array([*breaks, np.inf]), position)


Pair = Annotated[tuple[float, float], Field(strict=False)]  # a TOML array is a list: lax about that, not about its numbers
Triple = Annotated[tuple[float, float, float], Field(strict=False)]


class Profile(Table):
    """The ``[reference]`` table: exactly one of the four forms, and where the reference starts."""

    position_m: float | None = Field(None, description="position of the reference at time 0 [m]; default: the first train's")
    speed_mps: float | None = Field(None, ge=0.0, description="constant speed [m/s]")
    speed_by_position: tuple[Pair, ...] | None = Field(
        None, strict=False, min_length=1, description="[[from_m, speed_mps], ...]: steps where the reference passes from_m"
    )
    s_curves: tuple[Triple, ...] | None = Field(
        None, strict=False, min_length=1, description="[[start_s, end_s, final_speed_mps], ...]: quintic S-curves in speed"
    )
    start_speed_mps: float | None = Field(None, ge=0.0, description="speed before the first of s_curves [m/s]")
    table: tuple[Pair, ...] | None = Field(
        None, strict=False, min_length=1, description="[[time_s, speed_mps], ...]: straight lines; a repeated time is a step"
    )

    @model_validator(mode="after")
    def _one_form_in_order(self) -> Self:
        """All mistakes at once: a profile is short, and its author wants the whole list."""
        given = [key for key in FORMS if getattr(self, key) is not None]
        wrong = []
        if len(given) != 1:
            wrong.append(f"exactly one of {', '.join(FORMS)} is needed, here {' and '.join(given) or 'none'}")
        if (self.s_curves is not None) != (self.start_speed_mps is not None):
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

    def leader(self, start: float = 0.0) -> Reference:
        """Return the virtual leader; ``start`` [m] is where it begins if the table does not say."""
        position = start if self.position_m is None else self.position_m
        if self.speed_mps is not None:
            return constant(self.speed_mps, position)
        if self.speed_by_position is not None:
            return by_position(self.speed_by_position, position)
        if self.s_curves is not None and self.start_speed_mps is not None:
            return s_curves(position, self.start_speed_mps, self.s_curves)
        assert self.table is not None  # the validator saw to it
        return table(self.table, position)
