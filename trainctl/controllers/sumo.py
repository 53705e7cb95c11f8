"""SUMO's own trains: no law of ours. SUMO's ``Rail`` model drives under fixed or under moving block, the baseline to compare with.

SUMO decides on every speed (its default speed mode stays on), we only read: see ``trainctl.watched``. Of the scenario it
takes the line, the trains with their lengths, places and speeds, and the reroutes. A SUMO configuration runs as it is: with its
own files, vTypes, signals, constraints, rerouters and options; ``block`` alone may change what it says of moving block.
Masses, resistances and slopes serve to tell what the trains' motion costs; bounds are only watched; links, plant and reference
play no part, but for the top speed.

Fixed block: one train between two signals; a train enters a block only with the braking distance ahead of it reserved. Moving
block: the rear of the train ahead is the end of the authority, at the absolute braking distance plus 50 m; signals are there, but
guard only where ways meet. The braking is that of ``train_type`` (ICE3: 0.5 m/s2).
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from trainctl.signals import Scene, Table

CLOCK: Literal["none"] = "none"

#: Rows of a comparison -> the keys of [controller] that make them.
COMPARED: dict[str, dict[str, Any]] = {"sumo_fixed_block": {"block": "fixed"}, "sumo_moving_block": {"block": "moving"}}

#: Distance of signals where neither the scenario nor its line states one [m].
SIGNALS_M = 2000.0

#: What SUMO brakes its train types with, on top of the running resistance [m/s2] (``MSCFModel_Rail.h``).
BRAKING_MPS2 = {
    "Freight": 0.3, "ICE1": 0.5, "ICE3": 0.5, "MireoPlusB": 1.1, "MireoPlusH": 1.1, "NGT400": 0.9, "NGT400_16": 0.9, "RB425": 1.0,
    "RB628": 0.5, "REDosto7": 0.5,
}  # fmt: skip

#: Beyond this SUMO gives a block up.
LONGEST_BLOCK_M = 20_000.0


class Params(Table):
    """Keys of ``[controller]`` with ``law = "sumo"``."""

    block: Literal["files", "fixed", "moving"] | None = Field(
        None,
        description="fixed: one train between two signals, the default on a line; moving: up to the train ahead "
        "(--railsignal-moving-block); files: as the options of network.sumocfg have it, the default there.",
    )
    signals_m: float | None = Field(
        None, ge=10, le=LONGEST_BLOCK_M,
        description="Distance of the signals [m]; default the line's own signals_m, or 2000 where it has none.",
    )  # fmt: skip
    train_type: Literal[
        "Freight", "ICE1", "ICE3", "MireoPlusB", "MireoPlusH", "NGT400", "NGT400_16", "RB425", "RB628", "REDosto7"
    ] = Field(
        "ICE3",
        description="SUMO's table of traction, resistance, mass and braking that drives the trains; those of network.sumocfg have"
        " the vTypes of its files.",
    )
    top_speed_mps: float | None = Field(
        None,
        gt=0,
        description="Maximum speed of every train [m/s]; default its upper speed bound, else the reference's maximum; not with "
        "network.sumocfg.",
    )
    entry_m: float | None = Field(
        None, ge=0,
        description="All trains wait there [m], each on its track, and enter in the order of the [[train]] tables as soon as SUMO "
        "lets them; default: at time 0 every train is where its [[train]] table says.",
    )  # fmt: skip
    entry_speed_mps: float | None = Field(
        None, ge=0, description="With entry_m: speed at which they enter [m/s]; default as fast as SUMO takes for safe."
    )
    entry_every_s: float = Field(0.0, ge=0, description="With entry_m: the k-th train does not enter before k times this [s].")


def signals_m(params: Params, own: float | None) -> float:
    """Distance of the signals of a line that states its ``own``, or none [m]."""
    return params.signals_m or own or SIGNALS_M


def braking_mps2(params: Params) -> float:
    """What SUMO brakes these trains with [m/s2]."""
    return BRAKING_MPS2[params.train_type]


def violations(params: Params, scene: Scene) -> list[str]:
    """What these trains ask of a scenario."""
    found = []
    if params.entry_m is None and params.entry_speed_mps is not None:
        found.append(f"controller.entry_speed_mps = {params.entry_speed_mps:g}: only with entry_m")
    if params.entry_m is None and params.entry_every_s > 0.0:
        found.append(f"controller.entry_every_s = {params.entry_every_s:g}: only with entry_m")
    return found


def unfit(scenario: Any) -> list[str]:
    """Parts of a ``scenario`` (``trainctl.scenario.tables.Scenario``) that SUMO's own trains would not feel."""
    found = [f"{key}: SUMO's own trains take none" for key in ("disturbance", "fault") if getattr(scenario, key)]
    rules = {"brake": "brake by SUMO's rules alone", "outage": "have no radio"}
    events = [(k, event.kind) for k, event in enumerate(scenario.event, 1) if event.kind in rules]
    found += [f"event[{k}].kind = {kind}: SUMO's own trains {rules[kind]}" for k, kind in events]
    given, network = scenario.controller.keys(), scenario.network
    if network.line is None and given.get("signals_m") is not None:
        found.append("controller.signals_m: a net has the signals it has; name a line, or build the net with signals_m")
    if network.sumocfg is None and given.get("block") == "files":
        found.append("controller.block = files: only with network.sumocfg")
    if network.sumocfg is not None:
        found += [f"controller.{k}: the vTypes of network.sumocfg say so" for k in ("train_type", "top_speed_mps") if k in given]
        entry = [key for key in ("entry_m", "entry_speed_mps", "entry_every_s") if given.get(key)]
        found += [f"controller.{key}: network.sumocfg says where and when its trains enter" for key in entry]
    return found
