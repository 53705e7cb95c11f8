"""What SUMO is given when it drives by itself: trains and options."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from sumo_net import LineError
from sumo_net.netfile import content
from trainctl.errors import InputError
from trainctl.scenario.model import Model
from trainctl.signals import SPEED, Floats
from trainctl.sumo.commanded_files import OPTIONS, fcd_period, normal
from trainctl.traffic.files import named_files, read_options

#: Options that are ours: what is written and shown, and who listens.
OURS = re.compile(r"output|log|^save-|gui|^start$|^quit-on-end$|^remote-port$|^num-clients$|^netstate|warnings$")


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


def verify_signals(p: Model) -> None:
    """Whether a net that came as a file has the signals that fixed block needs.

    Raises
    ------
    InputError
        It has none.
    """
    if p.net is not None and block(p) == "fixed" and b'type="rail_signal"' not in content(p.net):
        rule = 'has no rail signals; give it some, or take block = "moving"'
        raise InputError(f"{p.file}: controller.block = fixed: {p.net.name} {rule}")


def departures(p: Model) -> list[Vehicle]:
    """The trains of a line, one each.

    Raises
    ------
    InputError
        They cannot enter where ``entry_m`` says.
    """
    line, entry = p.line, p.params.entry_m
    if entry is not None and not line.begin_m <= entry < line.end_m:
        raise InputError(f"{p.file}: controller.entry_m = {entry:.10g}: off the line, {line.begin_m:.10g} .. {line.end_m:.10g} m")
    found = []
    for k, (t, top) in enumerate(zip(p.scenario.train, _top_speeds(p).tolist(), strict=True)):
        position = t.position_m if entry is None else entry
        found.append(Vehicle(
            id=t.id, vclass="rail", route=tuple(line.route(t.track, position)), position_m=float(line.locate(t.track, position)[1]),
            depart=k * p.params.entry_every_s, speed=float(t.speed_mps) if entry is None else p.params.entry_speed_mps,
            top_speed=top, speed_factor=1.0, placed=entry is None,
        ))  # fmt: skip
    return found


def _top_speeds(p: Model) -> Floats:
    """Maximum speed of every train [m/s], shape (n,)."""
    if p.params.top_speed_mps is not None:
        return np.full(len(p.scenario.ids), p.params.top_speed_mps)
    instants = np.arange(p.scenario.run.steps + 1) * p.scenario.run.step_s
    wanted = max(p.leader(float(t))[SPEED] for t in instants)
    return np.where(np.isfinite(p.bounds.speed_upper), p.bounds.speed_upper, wanted)


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
        }  # fmt: skip
        lines.append(f'    <vehicle{_words(given)}><route edges="{" ".join(normal(d.route))}"/></vehicle>')
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
        **({"railsignal-moving-block": "true"} if block(p) == "moving" else {}),
    }  # fmt: skip
    return _written(options, folder)


def write_own_configuration(p: Model, net: str, folder: Path) -> Path:
    """``run.sumocfg`` of a SUMO configuration as its files have it, but for outputs, and for what ``block`` says.

    Route and additional files are copied beside it, so that what they write comes to lie there; those that name others stay where
    they are.

    Raises
    ------
    InputError
        The configuration, or a file that it names, is not there any more.
    """
    source = Path(p.roster.source)
    said = read_options(source)
    kept = {key: value for key, value in said.items() if not OURS.search(key)}
    if "load-state" in kept:
        kept["load-state"] = str((source.parent / kept["load-state"]).resolve())
    for key in ("route-files", "additional-files"):
        files = [_beside(path, folder, f"{key[:5]}{k}") for k, path in enumerate(named_files(source, said, key))]
        kept |= {key: ",".join(files)} if files else {}
    logs = (
        "no-step-log",
        "fcd-output.distance",
        "tripinfo-output.write-unfinished",
        "vehroute-output.write-unfinished",
        "precision",
    )
    options = {
        **kept, "net-file": net, "step-length": f"{p.scenario.run.step_s:g}",
        **{key: OPTIONS[key] for key in (*logs, "time-to-teleport", "collision.action")},
        **fcd_period(p.scenario.run.record_every_s),
        **({} if block(p) == "files" else {"railsignal-moving-block": str(block(p) == "moving").lower()}),
    }  # fmt: skip
    return _written(options, folder)


def _beside(path: Path, folder: Path, name: str) -> str:
    """What a file is called in ``folder``: a copy, or where it is if it names other files."""
    try:
        if re.search(rb"<include |<(variableSpeedSign|rerouter|calibrator)[^>]* file=", content(path)):
            return str(path.resolve())
        shutil.copyfile(path, folder / f"{name}_{path.name}")
    except (LineError, OSError) as error:
        raise InputError(f"{path}: {error}") from None
    return f"{name}_{path.name}"


def block(p: Model) -> str:
    """How SUMO keeps its trains apart."""
    return str(p.params.block or ("fixed" if p.placed else "files"))


def _written(options: dict[str, str], folder: Path) -> Path:
    path = folder / "run.sumocfg"
    body = "".join(f"    <{key} value={quoteattr(value)}/>\n" for key, value in options.items())
    path.write_text(f"<configuration>\n{body}</configuration>\n", encoding="utf-8")
    return path
