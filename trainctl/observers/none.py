"""No observer: the law uses what is measured. ``WIDTH`` 0 estimates per unit, no correction."""

from __future__ import annotations

from typing import Any, NamedTuple

from numba import njit

from trainctl.signals import Floats

WIDTH = 0
CORRECTIONS = 0


class Constants(NamedTuple):
    """Nothing to tune."""

    unused: float = 0.0


@njit(cache=True)
def correction(i: int, constants: Constants, own: Floats, estimate: Floats, out: Floats) -> None:
    """Nothing to correct."""


@njit(cache=True)
def rate(
    i: int, constants: Constants, own: Floats, estimate: Floats, correction: Floats, applied: Floats, out: Floats
) -> None:
    """Nothing to estimate."""
