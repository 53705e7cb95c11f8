"""The demand of a SUMO configuration scaled, as SUMO's option ``scale`` does it."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable
from xml.etree.ElementTree import Element

from trainctl.traffic.files import is_number, seconds


def scaled(trains: list[Element], scale: float, suffix: str) -> tuple[list[Element], list[str]]:
    """Trains, trips and flows times ``scale``, and what of it is not followed.

    A flow has its trains in shorter intervals. A train comes as often as the whole number below says, its copies named
    ``suffix`` and their number; whether it comes once more SUMO draws, and nobody else can tell.
    """
    found, copies = [], int(scale)
    for train in trains:
        if train.tag == "flow":
            found.append(_flow(train, scale))
            continue
        for k in range(copies):
            one = copy.deepcopy(train)
            if k:
                one.set("id", f"{train.get('id', '')}{suffix}{k}")
            found.append(one)
    single = any(train.tag != "flow" for train in trains)
    notes = [
        f"option scale = {scale:g}: {len(trains)} trains, trips and flows become {len(found)}; flows have {scale:g} times as many"
    ]
    if single and copies != scale:
        notes.append(
            f"option scale = {scale:g}: not followed: of trains and trips {copies} each come; the rest would be drawn by SUMO"
        )
    return found, notes


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
