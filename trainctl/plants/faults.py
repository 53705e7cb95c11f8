"""Actuator faults as data: the scenario's ``[[fault]]`` tables, checked, and as the arrays a plant evaluates.

Three kinds act on the actuator ``tau' = -r tau + r eta demand + E f``: a constant and a sinusoidal rate ``E f`` [N/s], and the
effectiveness ``eta`` of the actuator (1 sound, 0 totally lost). Each has a window; on or off is fixed within an integrator step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from typing import Annotated, Literal, NamedTuple, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from trainctl.kernels import inlined
from trainctl.signals import Consists, Floats, Ints, Table

#: Keys each kind needs besides its place and window.
KEYS = {
    "constant": ("amplitude_n_per_s",),
    "sinusoid": ("amplitude_n_per_s", "omega_rad_per_s", "phase_rad"),
    "effectiveness": ("effectiveness",),
}


class Fault(Table):
    """[[fault]]: one fault of one unit's actuator in one window."""

    train: Annotated[int | str, AfterValidator(str)] = Field(description="Id of the train.")
    unit: int = Field(ge=1, description="Unit of the train, 1 is the leading one.")
    kind: Literal["constant", "sinusoid", "effectiveness"] = Field(
        description="constant: rate amplitude_n_per_s; sinusoid: amplitude_n_per_s cos(omega_rad_per_s t + phase_rad), t from the "
        "start of the run; effectiveness: share of the demanded force that the actuator gives."
    )
    start_s: float = Field(0.0, ge=0, description="First instant of the window [s].")
    end_s: float | None = Field(None, description="End of the window [s]; default the end of the run.")
    amplitude_n_per_s: float | None = Field(None, description="Rate E f of the force [N/s]; the bias is this / r.")
    omega_rad_per_s: float | None = Field(None, gt=0, description="Angular frequency [rad/s].")
    phase_rad: float | None = Field(None, description="Phase at scenario time 0 [rad].")
    effectiveness: float | None = Field(None, ge=0, le=1, description="1: sound; 0: total loss [-].")

    @model_validator(mode="after")
    def _keys_of_the_kind(self) -> Self:
        needed = KEYS[self.kind]
        others = {key for keys in KEYS.values() for key in keys} - set(needed)
        wrong = [f"{key} is missing: {self.kind} needs it" for key in needed if getattr(self, key) is None]
        wrong += [f"{key} does not belong to {self.kind}" for key in sorted(others) if getattr(self, key) is not None]
        if self.end <= self.start_s:
            wrong.append(f"end_s = {self.end_s:g}: the window ends before it starts, start_s = {self.start_s:g}")
        if wrong:
            raise ValueError("; ".join(wrong))
        return self

    @property
    def end(self) -> float:
        """End of the window [s], inf if it has none."""
        return math.inf if self.end_s is None else self.end_s


class Faults(NamedTuple):
    """Faults by unit: rows ``first[u]:first[u + 1]`` are those of unit ``u`` (all trains' units one after the other).

    Columns of ``rate``: start [s], end [s], amplitude [N/s], omega [rad/s], phase [rad]; a constant has omega = phase = 0.
    Columns of ``loss``: start [s], end [s], effectiveness.
    """

    rate_first: Ints  # (U + 1,)
    rate: Floats  # (F, 5)
    loss_first: Ints  # (U + 1,)
    loss: Floats  # (G, 3)


def violations(faults: Sequence[Fault], trains: Sequence[str], consists: Consists) -> list[str]:
    """Return every mistake that needs the trains: unknown train or unit, no actuator to fail, windows that overlap themselves."""
    found = []
    for k, fault in enumerate(faults, 1):
        if fault.train not in trains:
            found.append(f"fault[{k}].train = {fault.train}: no such train; there are: {', '.join(trains)}")
            continue
        i = trains.index(fault.train)
        units = int(consists.first[i + 1] - consists.first[i])
        if fault.unit > units:
            found.append(f"fault[{k}].unit = {fault.unit}: train {fault.train} has {units} units")
        elif consists.actuator_rate[consists.first[i] + fault.unit - 1] <= 0.0:
            found.append(f"fault[{k}].unit = {fault.unit}: has no actuator, actuator_rate_per_s must be above 0")
    for (k, one), (m, other) in combinations(enumerate(faults, 1), 2):
        same = (one.train, one.unit, one.kind, one.omega_rad_per_s) == (other.train, other.unit, other.kind, other.omega_rad_per_s)
        if same and one.start_s < other.end and other.start_s < one.end:
            found.append(
                f"fault[{m}].start_s = {other.start_s:g}: this {other.kind} of train {other.train} unit {other.unit} overlaps "
                f"fault[{k}], {one.start_s:g} to {one.end:g} s"
            )
    return found


def refused(plant: str, faults: Sequence[Fault]) -> list[str]:
    """Return what a plant without actuators says of faults."""
    return [f"fault: the plant {plant} has no actuators that fail; actuated_units has"] if faults else []


def shares(faults: Sequence[Fault], trains: Sequence[str], consists: Consists) -> tuple[Floats, Floats]:
    """Share of the demanded force every unit surely gives, and the maximum bias of its force [N], shape (U,)."""
    share, bias = np.ones(len(consists.mass)), np.zeros(len(consists.mass))
    for fault in faults:
        u = int(consists.first[trains.index(fault.train)]) + fault.unit - 1
        if fault.kind == "effectiveness":
            share[u] *= fault.effectiveness or 0.0
        else:
            bias[u] += abs(fault.amplitude_n_per_s or 0.0) / consists.actuator_rate[u]
    return share, bias


def breaks(faults: Sequence[Fault]) -> Floats:
    """Ascending times [s] where a fault begins or ends: the integrator splits its steps there."""
    edges = {edge for fault in faults for edge in (fault.start_s, fault.end)}
    return np.array(sorted(edge for edge in edges if 0.0 < edge < math.inf))


def tabulated(faults: Sequence[Fault], trains: Sequence[str], consists: Consists) -> Faults:
    """Return the faults as arrays ordered by unit; none have been refused by ``violations``."""
    units = len(consists.mass)
    rate: list[list[list[float]]] = [[] for _ in range(units)]
    loss: list[list[list[float]]] = [[] for _ in range(units)]
    for fault in faults:
        u = consists.first[trains.index(fault.train)] + fault.unit - 1
        if fault.kind == "effectiveness":
            loss[u].append([fault.start_s, fault.end, fault.effectiveness or 0.0])
        else:
            amplitude, omega, phase = fault.amplitude_n_per_s, fault.omega_rad_per_s, fault.phase_rad
            rate[u].append([fault.start_s, fault.end, amplitude or 0.0, omega or 0.0, phase or 0.0])

    def stacked(rows: list[list[list[float]]], columns: int) -> tuple[Ints, Floats]:
        first = np.concatenate([[0], np.cumsum([len(r) for r in rows])]).astype(np.int64)
        return first, np.array([row for r in rows for row in r], float).reshape(-1, columns)

    return Faults(*stacked(rate, 5), *stacked(loss, 3))


@inlined()
def fault_rate(faults: Faults, u: int, t: float, inside: float) -> float:
    """E f of unit ``u`` at ``t`` [N/s]; windows are open or shut as at ``inside``."""
    total = 0.0
    for k in range(faults.rate_first[u], faults.rate_first[u + 1]):
        if faults.rate[k, 0] <= inside < faults.rate[k, 1]:
            if faults.rate[k, 3] == 0.0:
                total += faults.rate[k, 2]
            else:
                total += faults.rate[k, 2] * math.cos(faults.rate[k, 3] * t + faults.rate[k, 4])
    return total


@inlined()
def effectiveness(faults: Faults, u: int, inside: float) -> float:
    """Share of its demanded force that the actuator of unit ``u`` gives."""
    share = 1.0
    for k in range(faults.loss_first[u], faults.loss_first[u + 1]):
        if faults.loss[k, 0] <= inside < faults.loss[k, 1]:
            share *= faults.loss[k, 2]
    return share
