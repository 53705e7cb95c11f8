"""From a scenario to the arrays of the loop, and everything that is wrong with it, before anything runs."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

import sumo_net
from sumo_net import Line, LineError
from trainctl.contracts import Plant
from trainctl.errors import InputError
from trainctl.laws import find_law, find_observer, find_plant
from trainctl.scenario import limits, placing, promise, roster
from trainctl.scenario.fit import can_brake, connected, fits
from trainctl.scenario.model import Model
from trainctl.scenario.plan import initial, plan_of
from trainctl.scenario.reading import examine, mistakes, read
from trainctl.scenario.reference import Profile
from trainctl.scenario.tables import Network, Scenario
from trainctl.signals import POSITION, Floats
from trainctl.topology import graph


def open_scenario(name: str, overrides: dict[str, Any] | None = None) -> Model:
    """Read, check and prepare a scenario by name or path.

    Raises
    ------
    InputError
        All mistakes that could be found, one line each.
    """
    data, path = read(name, overrides)
    scenario, found = examine(data)
    if scenario is None:
        raise InputError([f"{path.name}: {line}" for line in dict.fromkeys([*found, *further(data, path.parent)])])
    return model_of(scenario, path.name, path.parent, found)


def model_of(
    scenario: Scenario, file: str, folder: Path, known: Sequence[str] = (), enrolled: tuple[roster.Roster, Path] | None = None,
    beside: Model | None = None,
) -> Model:  # fmt: skip
    """Everything the loop needs, checked.

    Parameters
    ----------
    scenario : Scenario
        As read.
    file : str
        Its name, for the mistakes.
    folder : Path
        Where relative paths in it start.
    known : sequence of str
        Mistakes found before; what is found here is reported together with them.
    enrolled : tuple of Roster and Path, optional
        The trains of ``network.sumocfg`` and their net, where the scenario has taken them over already.
    beside : Model, optional
        A run of the same law on the same line, which is then not read again.

    Raises
    ------
    InputError
        All mistakes that could be found, one line each.
    """
    found = list(known)
    trains = None

    def attempt(function: Any, *arguments: Any) -> Any:
        try:
            return function(*arguments)
        except InputError as error:
            found.extend(error.mistakes)
        except LineError as error:
            found.extend(f"network: {m}" for m in error.mistakes)
        return None

    law = attempt(find_law, scenario.controller.law, folder)
    params = attempt(_params, law.Params, scenario.controller.keys(), "controller") if law else None
    observer = attempt(find_observer, scenario.observer.kind)
    observer_params = attempt(_params, observer.Params, scenario.observer.keys(), "observer") if observer else None
    plant: Plant | None = attempt(find_plant, scenario.plant.kind)
    plant_params = attempt(_params, plant.Params, scenario.plant.keys(), "plant") if plant else None
    network: tuple[Line, Any, Path | None] | None
    if scenario.network.sumocfg is not None:
        anew = (scenario, *enrolled) if enrolled is not None else attempt(roster.enrol, scenario, folder)
        if anew is None:
            raise InputError([f"{file}: {line}" for line in found])
        scenario, trains, net = anew
        network = roster.chart(trains.rails), None, net
    elif beside is not None:
        network = beside.line, beside.spec, beside.net
    else:
        signals_m = partial(law.signals_m, params) if params is not None and hasattr(law, "signals_m") else None
        network = attempt(_network, scenario.network, folder, signals_m)
    plan = attempt(plan_of, scenario)
    misplaced = placing.on_the_line(scenario, network[0]) if network is not None and trains is None else []
    found += misplaced
    if plant is None or any(part is None for part in (law, params, observer, observer_params, plant_params, plan)):
        raise InputError([f"{file}: {line}" for line in found])

    consists = scenario.consists()
    bounds = limits.of_trains(scenario, plant, plant_params, consists)
    # Trains that come and go are checked as the one formation they could be.
    placed = scenario if trains is None else roster.in_formation(scenario, plan.slot)
    own = initial(placed, plant, consists)
    track = np.unique([t.track for t in placed.train], return_inverse=True)[1].astype(np.int64)
    front = int(np.argmin(plan.place))
    start = own[consists.first[front], POSITION] - scenario.topology.first_slot_m
    if scenario.reference.follow_line:
        followed = attempt(placing.followed, scenario, network and network[0], plan, consists, start, front)
        scenario = scenario.model_copy(update={"reference": followed or Profile(speed_mps=scenario.train[front].speed_mps)})
    reference = scenario.reference.leader(start)
    first = graph.links(plan, graph.order_on_tracks(own[consists.first[:-1], POSITION], track), track)
    model = Model(
        scenario=limits.resolved(scenario, limits.stated(scenario, plant, plant_params), bounds), file=file,
        law=law, params=params, plant=plant, plant_params=plant_params,
        observer=observer, observer_params=observer_params, consists=consists, own=own, bounds=bounds, reference=reference,
        plan=plan, first_links=first, line=None, spec=None, net=None, roster=None,
    )  # fmt: skip
    unfit = fits(model)
    found += unfit or _start(model)
    if network is not None:
        model = replace(model, line=network[0], spec=network[1], net=network[2])
        slopes = np.column_stack([network[0].gradient.breaks, network[0].gradient.slope])
        if slopes[:, 1].any():  # actuators hold their trains where they start
            model = replace(model, own=plant.balanced(own, consists, slopes))
        if trains is not None:
            n = len(scenario.train)
            nobody = graph.links(plan, np.arange(n), np.arange(n))  # everybody alone
            start = initial(scenario, plant, consists)
            model = replace(model, own=start, first_links=nobody, roster=trains)
        elif law.CLOCK != "none":  # such trains leave at the line's end
            found += placing.long_enough(model)
        found += placing.steep(model)
        if trains is None and not misplaced:
            model = replace(model, roster=roster.placed(scenario, network[0], None if beside is None else beside.rails))
        if model.roster is not None:
            found += can_brake(model) or promise.refusals(model)
    if found:
        # What follows from a key that is wrong already is not a mistake of its own.
        wrong = [line.partition(" = ")[0].partition(":")[0].rpartition(".")[2] for line in known]
        news = [line for line in found[len(known) :] if not any(f"{key} = " in line for key in wrong)]
        raise InputError([f"{file}: {line}" for line in dict.fromkeys([*known, *news])])
    if model.scenario.supervisor is None and trains is None:
        return model
    # What it came to is logged, so that a run can go on from its log.
    stated = model.scenario.model_copy(update={"supervisor": model.supervision})
    return replace(model, scenario=stated)


def restarted(p: Model, seed: int | None, position: Floats, speed: Floats) -> Model | None:
    """The run of ``p`` with another seed and other starts, where nothing else follows from them.

    Parameters
    ----------
    p : Model
        A run whose trains [[train]] tables place.
    seed : int or None
        ``[run] seed``.
    position, speed : ndarray, shape (n,)
        Of every train at the start [m], [m/s].

    Returns
    -------
    Model or None
        None: such a run is not sound, or has to be built by itself (``model_of``, which says what is wrong).
    """
    s = p.scenario
    if not p.placed or s.reference.follow_line or not (np.isfinite(position).all() and (speed >= 0.0).all()):
        return None
    trains = zip(s.train, position.tolist(), speed.tolist(), strict=True)
    train = tuple(t.model_copy(update={"position_m": x, "speed_mps": v}) for t, x, v in trains)
    scenario = s.model_copy(update={"run": s.run.model_copy(update={"seed": seed}), "train": train})
    try:
        plan = plan_of(scenario)
    except InputError:
        return None
    if placing.on_the_line(scenario, p.line):
        return None
    own = initial(scenario, p.plant, p.consists)
    slopes = np.column_stack([p.line.gradient.breaks, p.line.gradient.slope])
    if slopes[:, 1].any():
        own = p.plant.balanced(own, p.consists, slopes)
    track = np.unique([t.track for t in train], return_inverse=True)[1].astype(np.int64)
    start = own[p.consists.first[int(np.argmin(plan.place))], POSITION] - s.topology.first_slot_m
    model = replace(
        p, scenario=scenario, own=own, reference=s.reference.leader(start), plan=plan,
        first_links=graph.links(plan, graph.order_on_tracks(own[p.leading, POSITION], track), track),
        roster=roster.placed(scenario, p.line, p.rails),
    )  # fmt: skip
    wrong = _start(model) or placing.long_enough(model) or placing.steep(model)
    if p.supervision.mode != "off":
        wrong = wrong or can_brake(model) or promise.refusals(model)
    return None if wrong else model


def _start(p: Model) -> list[str]:
    """What law and observer object to at the start."""
    scene = p.first_scene
    return [*connected(p), *p.law.violations(p.params, scene), *p.observer.violations(p.observer_params, scene)]


def _params(model: Any, keys: dict[str, Any], table: str) -> Any:
    try:
        return model.model_validate_json(json.dumps(keys))
    except ValidationError as error:
        raise InputError(mistakes(error, keys, table, model)) from None


def further(data: dict[str, Any], folder: Path) -> list[str]:
    """What else is wrong where the tables themselves are: names of law, observer and plant, their keys, network, places on it."""
    found: list[str] = []
    for table, key, find in (("controller", "law", partial(find_law, folder=folder)), ("observer", "kind", find_observer),
                             ("plant", "kind", find_plant)):  # fmt: skip
        said = data.get(table)
        if isinstance(said, dict) and isinstance(said.get(key), str):
            keys = json.loads(json.dumps({k: v for k, v in said.items() if k != key}, default=str))
            try:
                _params(find(said[key]).Params, keys, table)
            except InputError as error:
                found += error.mistakes
    try:
        network = Network.model_validate(data.get("network"))
        line = _network(network, folder, None)[0] if network.sumocfg is None else None
    except ValidationError:  # told already
        return found
    except InputError as error:
        return [*found, *error.mistakes]
    except LineError as error:
        return [*found, *(f"network: {m}" for m in error.mistakes)]
    trains = data.get("train")
    for number, train in enumerate(trains if isinstance(trains, list) and line is not None else (), 1):
        if isinstance(train, dict):
            place, track = train.get("position_m", 0.0), train.get("track")
            known = isinstance(place, int | float) and isinstance(track, int | str)
            found += placing.off_the_line(f"train[{train.get('id', number)}]", str(track), place, line) if known and line else []
    return found


def _network(network: Network, folder: Path, signals_m: Callable[[float | None], float] | None) -> tuple[Line, Any, Path | None]:
    """The line, its description and its net; ``signals_m`` is how far apart the law wants signals, from what the line states."""
    if network.net is not None:
        path = folder / network.net
        return Line.read(path), None, path
    name = str(network.line)
    known = sumo_net.shipped()
    if name not in known and not name.endswith(".toml"):
        raise InputError(f"network.line = {name}: no such line; known: {', '.join(known)}, or the path of a line .toml")
    spec = sumo_net.read_spec(known.get(name, folder / name))
    if signals_m is not None:
        spec = spec.model_copy(update={"signals_m": signals_m(spec.signals_m)})
        spec = sumo_net.parse_spec(spec.model_dump(mode="json", by_alias=True, exclude_none=True), spec.name)
    return Line.of(spec), spec, None
