"""my_law: drive a little faster or slower than the reference until every spacing is right.

Symbols
-------
k        how much faster for each metre of spacing error [1/s]
h        how fast the train takes up the speed it wants [1/s]
a        maximum acceleration it asks for, up or down [m/s2]
e        spacing error to a neighbour, positive if that one is too far ahead [m]
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from trainctl.signals import Demand, Floats, Links, Scene, Table, Trains

CLOCK: Literal["sampled"] = "sampled"


class Params(Table):
    """Keys of ``[controller]``."""

    k_per_s: float = Field(0.02, gt=0.0, description="Gain of the spacing errors [1/s]")
    h_per_s: float = Field(0.1, gt=0.0, description="Gain of the speed error [1/s]")
    a_mps2: float = Field(0.15, gt=0.0, description="Maximum acceleration asked for [m/s2]")
    slower_mps: float = Field(1.0, gt=0.0, description="Most by which it wants to be slower than the reference [m/s]")
    faster_mps: float = Field(4.0, gt=0.0, description="Most by which it wants to be faster than the reference [m/s]")


def violations(params: Params, scene: Scene) -> list[str]:
    """Whatever must hold before the start, as ``key = value: rule``; empty if all is well."""
    h_T = params.h_per_s * scene.control_period
    return [f"controller.h_per_s = {params.h_per_s:g}: h T = {h_T:g} must be below 1"] if h_T >= 1.0 else []


def constants(params: Params, scene: Scene) -> Params:
    """What ``message`` and ``demand`` get; computed again when the links change."""
    return params


def message(constants: Params, own: Trains, leader: Floats) -> Floats:
    """Every train sends its place relative to the reference [m] and a 1 that tells a message from silence, shape (n, 2)."""
    return np.column_stack((own.position - leader[0], np.ones_like(own.position)))


def demand(constants: Params, own: Trains, leader: Floats, links: Links, heard: Floats) -> Demand:
    """The law: acceleration of every train [m/s2] from its own state and what its links brought last (L, 2)."""
    i = links.receiver
    e = heard[:, 0] - (own.position - leader[0])[i] - links.desired
    said = heard[:, 1] > 0.0  # nothing has come yet: the error is not known
    differ = constants.k_per_s * np.bincount(i, np.where(said, e, 0.0), minlength=len(own.speed))
    wanted = leader[1] + np.clip(differ, -constants.slower_mps, constants.faster_mps)
    asked = constants.h_per_s * (wanted - own.speed)
    return Demand(np.clip(asked, -constants.a_mps2, constants.a_mps2), np.abs(asked) > constants.a_mps2)
