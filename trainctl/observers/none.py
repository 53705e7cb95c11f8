"""No observer: the law uses what is measured."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from trainctl.contracts import Observer
from trainctl.kernels import inlined
from trainctl.signals import Bools, Floats, Scene, Table

if TYPE_CHECKING:
    from trainctl.observers import none

    module: Observer = none

CORRECTIONS = 0


class Params(Table):
    """No keys."""


class Constants(NamedTuple):
    """Nothing to tune."""

    unused: float = 0.0


def width(params: Params) -> int:
    """No estimates."""
    return 0


def violations(params: Params, scene: Scene) -> list[str]:
    """Nothing can be wrong."""
    return []


def constants(params: Params, scene: Scene) -> Constants:
    """Nothing to prepare."""
    return Constants()


def initial(params: Params, own: Floats) -> Floats:
    """No estimates, shape (U, 0)."""
    return np.zeros((len(own), 0))


def turned(params: Params, estimate: Floats, before: Floats, after: Floats) -> Floats:
    """No estimates."""
    return estimate


@inlined()
def correction(i: int, constants: Constants, own: Floats, estimate: Floats, held: Bools, out: Floats) -> None:
    """Nothing to correct."""


@inlined()
def rate(
    i: int, constants: Constants, own: Floats, estimate: Floats, held: Bools, correction: Floats, applied: Floats, out: Floats
) -> None:
    """Nothing to estimate."""


def fault_estimate(constants: Constants, estimate: Floats) -> Floats:
    """None known, shape (U,)."""
    return np.full(len(estimate), np.nan)


def acceleration_estimate(constants: Constants, estimate: Floats) -> Floats:
    """None known, shape (U,)."""
    return np.full(len(estimate), np.nan)
