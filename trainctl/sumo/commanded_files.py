"""What SUMO is given where we drive the trains: their routes and types, and options.

The options below are not taste: each one switches off something of SUMO's that silently moves, holds back or removes a train
(measured on SUMO 1.28).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from itertools import count
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from trainctl.signals import Floats, Start
from trainctl.sumo.signal_box import NOT_WITH_SIGNALS, Obeyed, write

OPTIONS = {
    "time-to-teleport": "-1",  # a train held at speed 0 would teleport after 300 s
    "collision.action": "warn",  # the default removes the train; gaps are the monitors' business
    "collision.mingap-factor": "0",  # a gap below minGap is not yet a collision
    "insertion-checks": "none",  # one train per block at insertion, even without signals: the second never appears
    "default.speeddev": "0",
    "step-method.ballistic": "false",  # said aloud: an action step length would switch it on
    "no-step-log": "true",
    "fcd-output.distance": "true",
    "tripinfo-output.write-unfinished": "true",
    "vehroute-output.write-unfinished": "true",
    "precision": "9",
    "no-warnings": "false",
}

#: SUMO's own logs. Given on the command line only: who opens run.sumocfg in sumo-gui must not overwrite them.
LOGS = {
    "fcd-output": "fcd.parquet",
    "tripinfo-output": "tripinfo.xml",
    "summary-output": "summary.xml",
    "statistic-output": "statistics.xml",
    "collision-output": "collisions.xml",
    "vehroute-output": "vehroute.xml",
    "log": "messages.log",
}

#: A stop without an end [s].
HELD_S = 1e6

#: Acceleration and braking of trains whose drivers decide nothing.
_IDLE = 'accel="100" decel="100"'


def write_routes(start: Start, path: Path, obeyed: Obeyed | None = None, limit: Floats | None = None) -> list[str]:
    """The trains as SUMO vehicles: true lengths and carriages, no randomness, no limits of SUMO's own.

    Those that come later have their types here and are added when they come. Returns the type of every train. Where signals are
    ``obeyed`` a type brakes as its trains do, and SUMO lets no train in before the block is free. ``limit`` (n,) is that of the net
    where each train starts [m/s]: SUMO refuses one that is faster, as a sign may allow, but for a speed factor.
    """
    types: dict[tuple[str, tuple[float, ...], str], str] = {}
    taken = set() if obeyed is None else set(re.findall(r'<vType [^>]*id="([^"]*)"', "".join(obeyed.handed.types)))
    names = (kind for kind in map("train{}".format, count(1)) if kind not in taken)
    rows, kinds = [], []
    begin, checks = ("0", ' insertionChecks="none"') if obeyed is None else (f"{obeyed.handed.begin_s:g}", "")
    for i, name in enumerate(start.ids):
        units = tuple(float(x) for x in start.unit_length[i])
        moves = _IDLE if obeyed is None else f'accel="1" decel="{float(obeyed.braking[i])!r}"'
        key = start.vclass[i], units, moves
        types[key] = kind = types[key] if key in types else next(names)
        kinds.append(kind)
        if not start.present[i] or (obeyed is not None and obeyed.driven[i]):
            continue
        route = " ".join(normal(start.routes[i] if obeyed is None else obeyed.way(i)))
        arrival = arrival_word(np.inf if start.arrival is None else float(start.arrival[i]))
        fast = "" if limit is None or start.speed[i] <= limit[i] else f' speedFactor="{float(start.speed[i] / limit[i]) + 1e-6!r}"'
        rows.append(
            f'    <vehicle id={quoteattr(name)} type="{kind}" depart="{begin}" departLane="best"{checks}{fast}'
            f' departPos="{float(start.lane_position[i])!r}" departSpeed="{float(start.speed[i])!r}" arrivalPos="{arrival}">\n'
            f'        <route edges="{route}"/>{_hold(obeyed, i)}{_trip(obeyed, i)}\n    </vehicle>\n'
        )
    with path.open("w", encoding="utf-8") as out:
        out.write("<routes>\n")
        for (vclass, units, moves), kind in types.items():
            length = max(math.fsum(units), 1.0)  # SUMO has no points
            out.write(
                f'    <vType id="{kind}" vClass="{vclass}" guiShape="rail" length="{length!r}"'
                f' carriageLength="{max(max(units), 1.0)!r}" carriageGap="0" minGap="0" sigma="0"'
                f' speedFactor="1" speedDev="0" maxSpeed="500" {moves} emergencyDecel="1000"/>\n'
            )
        out.writelines(rows)
        out.write("</routes>\n")
    return kinds


def _hold(obeyed: Obeyed | None, i: int) -> str:
    """A stop that holds a train where it is to turn first."""
    if obeyed is None or (place := obeyed.hold(i, 0)) is None:
        return ""
    edge, begin, end = place
    return f'<stop edge={quoteattr(edge)} startPos="{begin!r}" endPos="{end!r}" duration="{HELD_S:g}"/>'


def _trip(obeyed: Obeyed | None, i: int) -> str:
    """What constraints of signals call a train, where that is not its id."""
    return f'<param key="tripId" value={quoteattr(obeyed.handed.trips[i])}/>' if obeyed is not None else ""


def arrival_word(place: float) -> str:
    """Where a train leaves, as SUMO takes it: at this place of its last edge [m], or at the end."""
    return "max" if math.isinf(place) else repr(place)


def normal(route: Iterable[str]) -> list[str]:
    """A route as SUMO takes it: without internal edges."""
    return [edge for edge in route if not edge.startswith(":")]


def write_configuration(
    folder: Path, net: str, routes: str, step: float, end: float, internal: bool = False, record_every: float | None = None,
    obeyed: Obeyed | None = None,
) -> Path:  # fmt: skip
    """``run.sumocfg``: SUMO's own sumo and sumo-gui open it.

    ``internal`` says whether the net has edges inside junctions, ``record_every`` [s] how often the FCD log is written: it takes a
    third of SUMO's time. Where signals are ``obeyed`` the options are those of the user's configuration, but for these.
    """
    options = {"net-file": net, "route-files": routes, "begin": "0", "end": f"{end:.3f}", "step-length": f"{step:g}", **OPTIONS}
    if obeyed is not None:
        begin = obeyed.handed.begin_s
        ours = {key: value for key, value in OPTIONS.items() if key not in NOT_WITH_SIGNALS}
        times = {"begin": f"{begin:.3f}", "end": f"{begin + end:.3f}", "step-length": f"{step:g}"}
        options = {**write(obeyed, folder), "net-file": net, **times, **ours}
    options |= fcd_period(record_every)
    options |= {"collision.check-junctions": "true"} if internal else {"no-internal-links": "true"}
    path = folder / "run.sumocfg"
    body = "".join(f"    <{key} value={quoteattr(value)}/>\n" for key, value in options.items())
    path.write_text(f"<configuration>\n{body}</configuration>\n", encoding="utf-8")
    return path


def fcd_period(every: float | None) -> dict[str, str]:
    """Options for an FCD log with rows every so often [s]; every step if None."""
    return {} if every is None else {"device.fcd.period": f"{every:.3f}"}
