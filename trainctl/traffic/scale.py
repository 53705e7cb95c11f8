"""The demand of a SUMO configuration scaled, as SUMO's option ``scale`` does it."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable
from xml.etree.ElementTree import Element

from trainctl.traffic.files import is_number, seconds


def scaled(trains: list[Element], everybody: list[Element], scale: float, suffix: str) -> tuple[list[Element], list[str]]:
    """Trains, trips and flows times ``scale``, and what of it is not followed.

    A flow has its trains in shorter intervals. A train comes as often as ``often`` says, its copies named ``suffix`` and their
    number; ``everybody`` are all vehicles in the order of the files, the trains among them.
    """
    found, loaded, single = [], 0, {id(train): 0 for train in trains if train.tag != "flow"}
    for before, vehicle in enumerate(v for v in everybody if v.tag != "flow"):
        loaded += 1
        times = often(scale, int(loaded / scale) if scale > 1.0 else before)
        loaded += times - 1 if scale > 1.0 else 0
        if id(vehicle) in single:
            single[id(vehicle)] = times
    for train in trains:
        if train.tag == "flow":
            found.append(_flow(train, scale))
            continue
        for k in range(single[id(train)]):
            one = copy.deepcopy(train)
            if k:
                one.set("id", f"{train.get('id', '')}{suffix}{k}")
            found.append(one)
    notes = [
        f"option scale = {scale:g}: {len(trains)} trains, trips and flows become {len(found)}; flows have {scale:g} times as many"
    ]
    if scale % 1.0 and single and any(v.tag == "flow" for v in everybody):
        notes.append(
            f"option scale = {scale:g}: not followed: SUMO counts trains of flows as well when it decides which one comes once more"
        )
    return found, notes


def often(scale: float, number: int) -> int:
    """How often a vehicle comes before which ``number`` others were loaded: SUMO spreads a fraction evenly, in thousandths."""
    whole, thousandths = int(scale), int(scale % 1.0 * 1000 + 0.5)
    return whole + (number % 1000 * thousandths % 1000 < thousandths)


def _flow(flow: Element, scale: float) -> Element:
    one = copy.deepcopy(flow)

    def change(key: str, value: Callable[[str], str]) -> None:
        if key in one.attrib:
            one.set(key, value(one.get(key, "")))

    def times(text: str) -> str:
        return repr(float(text) * scale) if is_number(text) else text

    def shorter(text: str) -> str:
        if found := re.fullmatch(r"exp\((.*)\)", text):
            return f"exp({times(found[1])})"
        return repr(seconds(text) / scale) if is_number(text) else text

    change("number", lambda text: str(int(float(text) * scale)) if is_number(text) else text)
    change("period", shorter)
    for key in ("vehsPerHour", "perHour", "probability"):
        change(key, times)
    return one
