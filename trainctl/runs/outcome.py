"""How a run ended, in lines for people: what failed it, what is to be known besides, and whether the bounds held."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from trainctl.errors import InputError
from trainctl.monitors.outcome import COUNTED, GAP, LIMIT
from trainctl.runs.run import Run


class Line(NamedTuple):
    """One line of a summary."""

    title: str
    text: str
    failed: bool  # whether it fails the run


def summary(run: Run) -> list[Line]:
    """What a run reports beside its results: collisions, overspeeds, waits, bounds; the last line is that of the bounds."""
    return [*_happened(run), Line("bounds", bounds(run.info), False)]


def bounds(info: Mapping[str, Any]) -> str:
    """Whether the bounds held."""
    if not info.get("violations"):
        return "none violated" if info.get("checks_failed") else "all held"
    where = ""
    if first := info.get("first_violation"):
        where = f", first {first['bound']} of {first['who']} at {first['time_s']:g} s"
    return f"{info['violations']} violated{where}: see kind = violation in events.jsonl"


def _happened(run: Run) -> Iterator[Line]:
    """Lines of what happened; none where nothing did."""
    info = run.info
    failed, worst = info.get("checks_failed", ()), info.get("worst", {})
    if number := info.get("collisions", 0):
        told = [e for e in _events(run, "violation") if e["bound"] in (GAP, COUNTED)] or _events(run, "violation")
        first = min(told, key=lambda event: float(event["time_s"]))
        deepest = f"; deepest {-worst[GAP]['value']:.4g} m, {worst[GAP]['who']}" if GAP in worst else ""
        yield Line(
            "collisions",
            f"{_many(number, 'pair')} of trains, first {first['who']} at {first['time_s']:g} s, {_place(first)}{deepest}",
            "collision" in failed,
        )
    if number := info.get("overspeeds", 0):
        by = ""
        if most := worst.get(LIMIT):
            by = f", by up to {most['value'] - most['limit']:.4g} m/s ({most['who']} at {most['time_s']:g} s)"
        yield Line("overspeed", f"{_many(number, 'train')} above the speed limit{by}", "overspeed" in failed)
    if info.get("gridlocks", 0):
        for event in _events(run, "gridlock"):
            each = ", ".join(f"{w['train']} for {w['other']} ({w['place']} {w['edge']})" for w in event["waits"])
            yield Line("gridlock", f"from {event['time_s']:g} s on trains wait in a circle: {each}", "gridlock" in failed)
    if number := info.get("waited_long", 0):
        first = _events(run, "waiting")[0]
        other = f" for {first['other']}" if first["other"] is not None else ""
        yield Line("waiting", f"{_many(number, 'long wait')}, first {first['train']}{other} since {first['since_s']:g} s", False)
    if info.get("not_entered", 0):
        late = _events(run, "not_entered")[0]["trains"]
        more = f" and {len(late) - 10} more" if len(late) > 10 else ""
        yield Line("not entered", f"{_many(len(late), 'train')}: {', '.join(late[:10])}{more}", False)


def _events(run: Run, kind: str) -> list[dict[str, Any]]:
    """Events of a kind that run.json counts, at least one."""
    found = [event for event in run.events if event["kind"] == kind]
    if not found:
        raise InputError(
            f"{run.folder}: run.json counts what has no event of kind {kind} in events.jsonl: one of the files is damaged"
        )
    return found


def _many(number: int, word: str) -> str:
    return f"{number} {word}{'' if number == 1 else 's'}"


def _place(event: Mapping[str, Any]) -> str:
    for way, place in (("track", "position_m"), ("edge", "edge_m")):
        if way in event and place in event:
            return f"{way} {event[way]} at {event[place]:.6g} m"
    return "place unknown"
