"""Variable speed signs of a SUMO configuration."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from xml.etree.ElementTree import Element

from sumo_net.netfile import for_trains
from trainctl.traffic.files import is_number, is_time, parse, seconds
from trainctl.traffic.places import Tracks

#: A change of a speed limit: when [s], of which edge, to what [m/s].
Change = tuple[float, str, float]


def speed_signs(elements: list[Element], tracks: Tracks) -> tuple[list[Change], list[str]]:
    """The changes that signs make to the limits of tracks, and the mistakes in them, one line each.

    A sign on a lane that trains do not take changes nothing for them. A speed below 0, or none, stands for that of the first lane
    in the net, as in SUMO.
    """
    lanes = {lane.get("id", ""): lane for edge in tracks.file.edges for lane in edge.lanes}
    taken = {
        lane.get("id", ""): edge.attributes.get("id", "")
        for edge in tracks.file.edges
        for lane in [lane for lane in edge.lanes if for_trains(lane, anybody=True)][:1]
    }
    changes: list[Change] = []
    wrong = []
    for sign in (e for e in elements if e.tag == "variableSpeedSign"):
        who, on = f"variableSpeedSign {sign.get('id', '')}", sign.get("lanes", "").split()
        mistakes = [f"{who}: lane {lane}: not in the net" for lane in on if lane not in lanes]
        mistakes += [f"{who}: no lanes"] if not on else []
        steps = [step for source in (sign, _own_file(sign)) if source is not None for step in source.iter("step")]
        for step in steps:
            mistakes += [
                f"{who}: step {key} = {step.get(key)}: must be a {what}"
                for key, what, good in (("time", "time", is_time), ("speed", "number", is_number))
                if not good(step.get(key, "-1" if key == "speed" else ""))
            ]
        if not mistakes and any(a > b for a, b in pairwise(seconds(step.get("time", "0")) for step in steps)):
            mistakes.append(f"{who}: steps must be sorted by time")
        wrong += mistakes
        if mistakes:
            continue
        for step in steps:
            shown = float(step.get("speed", "-1"))
            speed = float(lanes[on[0]].get("speed", "0")) if shown < 0 else shown
            changes += [(seconds(step.get("time", "0")), taken[lane], speed) for lane in on if lane in taken]
    return changes, wrong


def _own_file(sign: Element) -> Element | None:
    return parse(Path(sign.get("file", ""))) if sign.get("file") else None
