"""What every train must keep: the tightest of [bounds], [plant] and its own [[train]] table, and where that is a clamp."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from trainctl.contracts import Plant
from trainctl.scenario.tables import Scenario
from trainctl.signals import Bounds, Consists, Floats

#: The keys of ``Bounds``, in [bounds], [plant] and [[train]].
KEYS = ("speed_lower_mps", "speed_upper_mps", "input_lower_mps2", "input_upper_mps2")


def _tighter(key: str) -> Any:
    return np.maximum if "lower" in key else np.minimum


def stated(scenario: Scenario, plant: Plant, params: Any) -> Bounds:
    """What [bounds], [plant] where it clamps, and [[train]] say of every train; infinite where nothing is stated."""
    rows = list(scenario.bounds_of_trains())
    for k, key in enumerate(KEYS):
        clamp = getattr(params, key) if key in plant.CLAMPS else None
        if clamp is not None:
            rows[k] = _tighter(key)(rows[k], clamp)
    return Bounds(*rows)


def of_trains(scenario: Scenario, plant: Plant, params: Any, consists: Consists) -> Bounds:
    """Bounds of every train; without any of the inputs they are what its units can always give within the speed band.

    Parameters
    ----------
    scenario : Scenario
        [bounds] and [[train]].
    plant, params
        [plant]: where it clamps, ``params`` may say.
    consists : Consists
        Units of all trains.
    """
    bounds = stated(scenario, plant, params)
    minimum, maximum = room(bounds, plant, consists)
    return bounds._replace(
        input_lower=np.where(np.isfinite(bounds.input_lower), bounds.input_lower, minimum),
        input_upper=np.where(np.isfinite(bounds.input_upper), bounds.input_upper, maximum),
    )


def room(bounds: Bounds, plant: Plant, consists: Consists) -> tuple[Floats, Floats]:
    """Input the trains can give anywhere in the speed band, infinite where there is no band, shape (n,) each."""
    n = len(bounds.speed_lower)
    if not np.all(np.isfinite(bounds.speed_lower) & np.isfinite(bounds.speed_upper)):
        return np.full(n, -np.inf), np.full(n, np.inf)
    return plant.room(consists, bounds.speed_lower, bounds.speed_upper)


def clamps(everywhere: bool, plant: Plant, params: Any, bounds: Bounds) -> Bounds:
    """Where the plant itself clamps every train, U_i and V_i of robust_constrained (4); infinite where it does not.

    It does where [plant] says so; ``everywhere`` it can for a law whose model clamps.
    """
    rows = []
    for key, bound in zip(KEYS, bounds, strict=True):
        acts = key in plant.CLAMPS and (everywhere or getattr(params, key) is not None)
        rows.append(bound if acts else np.full(len(bound), -np.inf if "lower" in key else np.inf))
    return Bounds(*rows)


def differing(scenario: Scenario, plant: Plant, params: Any) -> list[str]:
    """Keys at which [bounds], [plant] and trains say different things, and which of it acts, a line per key and value."""
    found = []
    for key in KEYS:
        everywhere = {"[bounds]": getattr(scenario.bounds, key), "[plant]": getattr(params, key) if key in plant.CLAMPS else None}
        said = {place: value for place, value in everywhere.items() if value is not None}
        by_value: dict[float | None, list[str]] = {}
        for train in scenario.train:
            by_value.setdefault(getattr(train, key), []).append(train.id)
        for value, trains in by_value.items():
            values = said if value is None else {**said, "[[train]]": value}
            if len(set(values.values())) > 1:
                acts = float(_tighter(key).reduce(list(values.values())))
                who = "train" if len(trains) == 1 else "trains"
                places = ", ".join(f"{v:g} in {place}" for place, v in values.items())
                found.append(f"{key} of {who} {', '.join(trains)} = {acts:g}: {places}; the tightest acts")
    return found


def resolved(scenario: Scenario, said: Bounds, bounds: Bounds) -> Scenario:
    """The scenario as it is logged: input bounds that are not stated follow from the units, a law's file has its name alone.

    Parameters
    ----------
    scenario : Scenario
        As written.
    said, bounds : Bounds
        What ``stated`` and ``of_trains`` give.
    """
    law = scenario.controller.law
    if law.endswith(".py"):  # a copy of it stands beside the scenario
        scenario = scenario.model_copy(update={"controller": scenario.controller.model_copy(update={"law": Path(law).name})})
    for key, known, values in zip(KEYS[2:], said[2:], bounds[2:], strict=True):
        news = np.isfinite(values) & ~np.isfinite(known)
        if news.all() and np.all(values == values[0]):
            scenario = scenario.model_copy(update={"bounds": scenario.bounds.model_copy(update={key: float(values[0])})})
        elif news.any():
            own = [
                train.model_copy(update={key: value}) if new else train
                for train, new, value in zip(scenario.train, news, values.tolist(), strict=True)
            ]
            scenario = scenario.model_copy(update={"train": tuple(own)})
    return scenario
