"""Rerouters of a SUMO configuration that close edges."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

from trainctl.traffic.files import bad_number, is_time, parse, seconds
from trainctl.traffic.known import REROUTERS_NAMED
from trainctl.traffic.places import YES, Tracks


class Closing(NamedTuple):
    """An edge that is closed to trains that come over certain edges, from then to then."""

    at: tuple[str, ...]  # where trains are led round it
    closed: str
    begin: float  # s
    end: float  # s
    probability: float  # with which a train obeys
    types: tuple[str, ...]  # vTypes it is meant for; (): all
    vclasses: tuple[str, ...]  # classes it is closed to; (): all


def closings(elements: list[Element], tracks: Tracks, classes: set[str]) -> tuple[list[Closing], list[str], list[str]]:
    """Closed edges, what of the rerouters is not followed, and the mistakes in them; ``classes`` are those of the trains."""
    found: list[Closing] = []
    notes: list[str] = []
    wrong: list[str] = []
    for rerouter in (e for e in elements if e.tag == "rerouter"):
        who, at = f"rerouter {rerouter.get('id', '')}", tuple(rerouter.get("edges", "").split())
        mistakes = [f"{who}: edge {e}: not in the net" for e in at if e not in tracks.onward]
        chance = rerouter.get("probability", "1")
        mistakes += [f"{who}: probability = {chance}: must be a number, not negative"] if bad_number(chance) else []
        notes += [f"{who}: {key}: not followed: {why}" for key, why in (("timeThreshold", "it acts at once"),) if rerouter.get(key)]
        if rerouter.get("off", "false").lower() in YES:
            continue
        source = parse(Path(rerouter.get("file", ""))) if rerouter.get("file") else rerouter
        for interval in source.iter("interval"):
            times = [interval.get("begin", "0"), interval.get("end", "1e9")]
            mistakes += [f"{who}: interval {text}: must be a time" for text in times if not is_time(text)]
            for child in interval:
                why = REROUTERS_NAMED.get(child.tag)
                notes += [f"{who}: <{child.tag}>: not followed: {why}"] if why else []
                if child.tag != "closingReroute":
                    continue
                edge = child.get("id", "")
                mistakes += [f"{who}: closingReroute {edge}: not in the net"] if edge not in tracks.onward else []
                if not mistakes:
                    shut = _shut(child, classes)
                    if shut:
                        notes.append(
                            f"{who}: closingReroute {edge} with allow or disallow: trains that depart later are led round it, too,"
                            " where SUMO ends with an error"
                        )
                    if shut is not None:
                        span = seconds(times[0]), seconds(times[1])
                        found.append(Closing(at, edge, *span, float(chance), tuple(rerouter.get("vTypes", "").split()), shut))
        if 0.0 < float(chance if not bad_number(chance) else "1") < 1.0:
            notes.append(f"{who}: probability = {chance}: drawn here, with random numbers other than SUMO's")
        wrong += mistakes
    return found, list(dict.fromkeys(notes)), wrong


def _shut(closing: Element, classes: set[str]) -> tuple[str, ...] | None:
    """To which classes of trains an edge is closed, () to all; None: to none of them."""
    allow, disallow = closing.get("allow"), closing.get("disallow")
    if allow is None and disallow is None:
        return ()
    let = set(allow.split()) if allow is not None else None
    shut = sorted(c for c in classes if (c not in let and "all" not in let if let is not None else c in (disallow or "").split()))
    return tuple(shut) or None
