"""counting: a sampled law with a state of its own: how often each train was asked, and the sum of what it was asked for."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np

from trainctl.signals import Demand, Floats, Links, Scene, Table, Trains

CLOCK: Literal["sampled"] = "sampled"
PLANTS = ("point", "coupled_units", "actuated_units")


class Params(Table):
    """Keys of ``[controller]``."""

    gain: float = 1e-4


class State(NamedTuple):
    """What the law remembers."""

    times: int
    total: Floats  # (n,)


def violations(params: Params, scene: Scene) -> list[str]:
    """None."""
    return []


def constants(params: Params, scene: Scene) -> Params:
    """Nothing to prepare."""
    return params


def initial(params: Params, scene: Scene) -> State:
    """Nothing asked yet."""
    return State(0, np.zeros(len(scene.trains)))


def message(constants: Params, own: Trains, leader: Floats, state: State) -> Floats:
    """Nothing to say, shape (n, 1)."""
    return np.zeros((len(own.speed), 1))


def demand(constants: Params, own: Trains, leader: Floats, links: Links, heard: Floats, state: State) -> tuple[Demand, State]:
    """An integral controller of the speed: without its state it would ask for something else."""
    total = state.total + (leader[1] - own.speed)
    none: Any = np.zeros(len(total), bool)
    return Demand(constants.gain * (state.times + 1) * total, none), State(state.times + 1, total)
