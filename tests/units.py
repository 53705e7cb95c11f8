"""Four trains of three unlike units, and one evaluation of their closed loop: what the contracts of laws, observers and plants share."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from scenes import coupled_trains

from trainctl.plants import actuated_units
from trainctl.signals import FORCE, POWERS, SPEED, Floats, Reference, Scene

TRAINS, UNITS = 4, 3
ROWS = TRAINS * UNITS
FREE = np.zeros(ROWS, bool)  # no unit is held at standstill
SPEED_MPS = 80.0
LEADER = np.array([200_000.0, SPEED_MPS, 0.0, 0.0])
SPACING = 3000.0 + 80.0 * UNITS


def modules(package: ModuleType, attribute: str) -> dict[str, Any]:
    """Modules of a package that have this attribute, by name."""
    names = [m.name for m in pkgutil.iter_modules(package.__path__)]
    found = {name: importlib.import_module(f"{package.__name__}.{name}") for name in names}
    return {name: module for name, module in found.items() if hasattr(module, attribute)}


def rows(i: int) -> slice:
    """Units of a train."""
    return slice(UNITS * i, UNITS * (i + 1))


def others(i: int) -> np.ndarray[Any, Any]:
    """Units of all trains but one, shape (U,)."""
    return np.repeat(np.arange(TRAINS) != i, UNITS)


def at_rest(states: int = 2, **consist: Any) -> Scene:
    """Every train at its slot and at the reference's speed, couplers at rest, actuators in balance."""
    mass = np.repeat([80_000.0, 70_000.0, 90_000.0, 60_000.0], UNITS)
    given = {"mass": mass, "actuator_rate": np.full(ROWS, 50.0)} | consist
    reference = Reference(np.array([0.0, 1e4]), np.array([[LEADER[0], LEADER[1]]]))
    scene = coupled_trains(tuple(LEADER[0] - SPACING * np.arange(TRAINS)), UNITS, reference, **given)
    links = scene.links
    scene = scene._replace(
        links=links._replace(
            lower=np.where(links.desired > 0.0, 1500.0, -5000.0), upper=np.where(links.desired > 0.0, 5000.0, -1500.0)
        )
    )
    return scene._replace(own=actuated_units.balanced(scene.own, scene.consists)) if states > FORCE else scene


def disturbed(scene: Scene, seed: int = 0) -> Scene:
    """A few metres and up to 1 m/s beside that, couplers a few millimetres out, forces off by some kN."""
    rng, own = np.random.default_rng(seed), scene.own.copy()
    own[:, 0] += np.repeat(rng.uniform(-20.0, 20.0, TRAINS), UNITS) + rng.uniform(-5e-3, 5e-3, ROWS)
    own[:, SPEED] += np.repeat(rng.uniform(-1.0, 1.0, TRAINS), UNITS) + rng.uniform(-1e-3, 1e-3, ROWS)
    own[:, FORCE:] += rng.uniform(-2e3, 2e3, own[:, FORCE:].shape)
    return scene._replace(own=own)


def moved(scene: Scene, i: int) -> Scene:
    """One train elsewhere, faster and heavier."""
    own, mass = scene.own.copy(), scene.consists.mass.copy()
    own[rows(i), :2] += (-77.0, 3.3)
    own[rows(i), FORCE:] += 1e3
    mass[rows(i)] *= 1.25
    return scene._replace(own=own, consists=scene.consists._replace(mass=mass))


class Instant(NamedTuple):
    """What one evaluation of the closed loop gives."""

    force: Floats  # (U,) N
    sent: Floats  # (n, w)
    correction: Floats  # (U, c)
    estimate_rate: Floats  # (U, q)
    own_rate: Floats  # (U, s)
    power: Floats  # (n, 6)


def evaluate(
    law: Any, observer: Any, plant: Any, scene: Scene, params: Any, heard: Floats | None = None, age: float = 0.0
) -> Instant:
    """One stage as ``plants.integrate`` does it, of the uncompiled shape; ``heard`` (L, w) stands for live messages."""
    links, n = scene.links, len(scene.trains)
    known = observer.Params()
    watched, seen = law.constants(params, scene), observer.constants(known, scene)
    moves = plant.constants(plant.Params(), scene.consists)
    estimate = observer.initial(known, scene.own)
    now = Instant(
        np.zeros(ROWS), np.zeros((n, law.MESSAGE)), np.zeros((ROWS, observer.CORRECTIONS)), np.zeros_like(estimate),
        np.zeros_like(scene.own), np.zeros((n, len(POWERS))),
    )  # fmt: skip

    def say(i: int) -> None:
        law.message(
            i, watched, LEADER, links.slot[i], scene.own[rows(i)], estimate[rows(i)], now.estimate_rate[rows(i)], now.sent[i]
        )

    for i in range(n):
        observer.correction(i, seen, scene.own[rows(i)], estimate[rows(i)], FREE[rows(i)], now.correction[rows(i)])
        if law.ORDER == "parallel":
            say(i)
    for i in links.order.tolist():
        hears = slice(links.first[i], links.first[i + 1])
        brought = np.ascontiguousarray(now.sent[links.sender[hears]]) if heard is None else heard[hears]
        law.demand(
            i, watched, LEADER, age, links.slot[i], scene.own[rows(i)], estimate[rows(i)], now.correction[rows(i)],
            links.desired[hears], brought, now.force[rows(i)],
        )  # fmt: skip
        plant.limit(i, moves, scene.own[rows(i)], now.force[rows(i)])
        observer.rate(
            i, seen, scene.own[rows(i)], estimate[rows(i)], FREE[rows(i)], now.correction[rows(i)], now.force[rows(i)],
            now.estimate_rate[rows(i)],
        )  # fmt: skip
        plant.rate(i, moves, 0.0, 0.0, scene.own[rows(i)], now.force[rows(i)], now.own_rate[rows(i)], now.power[i])
        if law.ORDER == "chain":
            say(i)
    return now


def arrays(thing: Any) -> Iterator[Floats]:
    """All arrays in nested tuples."""
    if isinstance(thing, np.ndarray):
        yield thing
    elif isinstance(thing, tuple):
        for part in thing:
            yield from arrays(part)
