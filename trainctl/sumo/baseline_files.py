"""What SUMO is given when it drives by itself: trains and options."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from sumo_net.netfile import content
from trainctl.errors import InputError
from trainctl.scenario.model import Model
from trainctl.signals import SPEED, Floats
from trainctl.sumo.session import OPTIONS, fcd_period, normal


class VehicleStop(NamedTuple):
    """Where a train waits."""

    edge: str
    end_m: float  # its front, from the beginning of the edge
    duration: float  # s
    until: float  # s, not before; -inf if it may
    parks: bool  # off the track


class Vehicle(NamedTuple):
    """A train as SUMO lets it in."""

    id: str
    vclass: str
    route: tuple[str, ...]  # edge ids, internal ones included
    position_m: float  # of its front on the first edge
    depart: float  # s
    speed: float | None  # m/s; None: as fast as SUMO takes for safe
    top_speed: float  # m/s
    speed_factor: float  # share of a speed limit that it keeps to
    placed: bool  # whatever SUMO thinks of it
    stops: tuple[VehicleStop, ...]
    arrival_m: float = np.inf  # where on the last edge it leaves; inf: at its end


def verify_signals(p: Model) -> None:
    """Whether a net that came as a file has the signals that fixed block needs.

    Raises
    ------
    InputError
        It has none.
    """
    if p.net is not None and p.params.block == "fixed" and b'type="rail_signal"' not in content(p.net):
        rule = 'has no rail signals; give it some, or take block = "moving"'
        raise InputError(f"{p.file}: controller.block = fixed: {p.net.name} {rule}")


def departures(p: Model) -> list[Vehicle]:
    """The trains of a scenario, one each.

    Raises
    ------
    InputError
        They cannot enter where ``entry_m`` says.
    """
    if not p.placed:
        return _coming(p)
    line, entry = p.line, p.params.entry_m
    if entry is not None and not line.begin_m <= entry < line.end_m:
        raise InputError(f"{p.file}: controller.entry_m = {entry:.10g}: off the line, {line.begin_m:.10g} .. {line.end_m:.10g} m")
    found = []
    for k, (t, top) in enumerate(zip(p.scenario.train, _top_speeds(p).tolist(), strict=True)):
        position = t.position_m if entry is None else entry
        found.append(Vehicle(
            id=t.id, vclass="rail", route=tuple(line.route(t.track, position)), position_m=float(line.locate(t.track, position)[1]),
            depart=k * p.params.entry_every_s, speed=float(t.speed_mps) if entry is None else p.params.entry_speed_mps,
            top_speed=top, speed_factor=1.0, placed=entry is None, stops=(),
        ))  # fmt: skip
    return found


def _top_speeds(p: Model) -> Floats:
    """Maximum speed of every train [m/s], shape (n,)."""
    if p.params.top_speed_mps is not None:
        return np.full(len(p.scenario.ids), p.params.top_speed_mps)
    instants = np.arange(p.scenario.run.steps + 1) * p.scenario.run.step_s
    wanted = max(p.leader(float(t))[SPEED] for t in instants)
    return np.where(np.isfinite(p.bounds.speed_upper), p.bounds.speed_upper, wanted)


def _coming(p: Model) -> list[Vehicle]:
    """The trains of a SUMO configuration, as its files have them."""
    roster, rails = p.roster, p.rails
    found = []
    for i, name in enumerate(p.scenario.ids):
        way = [rails.index[e] for e in roster.routes[i]]
        begin = rails.start_m[way[0]] + np.concatenate([[0.0], np.cumsum(rails.length_m[way])])
        stops = []
        for stop in roster.stops[i]:
            row = int(np.searchsorted(begin, stop.place, side="left")) - 1
            stops.append(VehicleStop(rails.edges[way[row]], float(stop.place - begin[row]), stop.duration, stop.until, stop.parks))
        # Whoever would start faster than it may is refused by SUMO, in the middle of the run.
        speed = min(float(roster.speed[i]), float(roster.speed_factor[i] * rails.speed_mps[way[0]]))
        top = p.params.top_speed_mps
        found.append(Vehicle(
            id=name, vclass=roster.vclass[i], route=roster.routes[i], position_m=float(roster.lane_position[i]),
            depart=float(roster.depart[i]), speed=None if np.isnan(speed) else speed,
            top_speed=float(roster.top_speed[i]) if top is None else min(top, float(roster.top_speed[i])),
            speed_factor=float(roster.speed_factor[i]), placed=False, stops=tuple(stops), arrival_m=float(roster.arrival[i]),
        ))  # fmt: skip
    return found


def write_routes(p: Model, trains: list[Vehicle], path: Path) -> None:
    """The trains as SUMO vehicles: true lengths, no randomness, driven by the ``Rail`` model."""
    lengths = np.maximum(p.consists.train_length(), 1.0).tolist()  # SUMO has no points
    keys = [(d.vclass, length, d.top_speed, d.speed_factor) for d, length in zip(trains, lengths, strict=True)]
    kinds = {key: f"train{k}" for k, key in enumerate(dict.fromkeys(keys), 1)}
    lines = ["<routes>"]
    lines += [
        f'    <vType id="{kind}" vClass="{vclass}" guiShape="rail" carFollowModel="Rail" trainType="{p.params.train_type}"'
        f' length="{length!r}" maxSpeed="{top!r}" sigma="0" speedFactor="{factor!r}" speedDev="0"/>'
        for (vclass, length, top, factor), kind in kinds.items()
    ]
    for d, key in sorted(zip(trains, keys, strict=True), key=lambda pair: pair[0].depart):
        given = {
            "id": d.id, "type": kinds[key], "depart": f"{d.depart:.3f}", "departLane": "best", "departPos": repr(d.position_m),
            "departSpeed": None if d.speed is None else repr(d.speed), "insertionChecks": "none" if d.placed else None,
            "arrivalPos": None if np.isinf(d.arrival_m) else repr(d.arrival_m),
        }  # fmt: skip
        lines.append(f'    <vehicle{_words(given)}><route edges="{" ".join(normal(d.route))}"/>')
        for stop in d.stops:
            until = None if np.isinf(stop.until) else f"{stop.until:.3f}"
            said = {
                "lane": f"{stop.edge}_0",
                "endPos": repr(stop.end_m),
                "duration": f"{stop.duration:.3f}",
                "until": until,
                "parking": "true" if stop.parks else None,
            }
            lines.append(f"        <stop{_words(said)}/>")
        lines.append("    </vehicle>")
    path.write_text("\n".join([*lines, "</routes>", ""]), encoding="utf-8")


def _words(attributes: dict[str, str | None]) -> str:
    return "".join(f" {key}={quoteattr(value)}" for key, value in attributes.items() if value is not None)


def write_configuration(p: Model, net: str, folder: Path) -> Path:
    """``run.sumocfg``: what SUMO's own programs run without us. Insertion follows SUMO's rules."""
    internal = any(edge.startswith(":") for edge in p.line.edges)
    options = {
        "net-file": net, "route-files": "trains.rou.xml", "begin": "0", "step-length": f"{p.scenario.run.step_s:g}",
        **{key: value for key, value in OPTIONS.items() if key != "insertion-checks"},
        **({"collision.check-junctions": "true"} if internal else {"no-internal-links": "true"}),
        **fcd_period(p.scenario.run.record_every_s),
        **({"railsignal-moving-block": "true"} if p.params.block == "moving" else {}),
    }  # fmt: skip
    path = folder / "run.sumocfg"
    body = "".join(f"    <{key} value={quoteattr(value)}/>\n" for key, value in options.items())
    path.write_text(f"<configuration>\n{body}</configuration>\n", encoding="utf-8")
    return path
