"""The interactive panels of a report, as plain data: every line downsampled so that its extremes stay.

A panel is a table that the page turns into one plot; all share their time axis. Numbers travel as 32-bit floats in base64, which
the plotting library reads as they are: 7 digits, 1.6 cm at 200 km.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from trainctl.figures import style
from trainctl.figures.corridors import Corridor, Place, corridors, crossovers
from trainctl.figures.occupied import Occupied, along, occupied
from trainctl.figures.train_graph import numbered_at, plans
from trainctl.figures.trains import NUMBERED, Drawn, in_formation, to_reference
from trainctl.metrics.driving import JOULES_PER_KWH
from trainctl.metrics.values import at_least, at_most
from trainctl.runs.series import INSTANT
from trainctl.signals import Bools, Floats, leader_over

Panel = dict[str, Any]
Trace = dict[str, Any]

#: Points of one panel at most, shared by its lines: a browser draws that many without a stutter.
POINTS_PER_PANEL = 30_000
#: Points of one line: at most, and at least however many lines there are.
POINTS = (2000, 120)
#: Points of an edge of a shade at most.
SHADED = 300
#: Dashes of the library per track, by name, as ``style.TRACK_STYLES``.
DASHES = ("solid", "8px,3px", "2px,3px", "8px,3px,2px,3px")
#: Words for them.
LOOKS = ("full", "dashed", "dotted", "dash-dotted")
#: Of panels with the reference.
THE_REFERENCE = "Dotted in the colour of the text: the reference."
#: Letters of an event at most, and of a list in it so many words in full.
LETTERS, MANY = 300, 12
#: Ends of keys that are units, longer ones first: end, unit.
UNITS = (("_mps2", "m/s²"), ("_mps", "m/s"), ("_kwh", "kWh"), ("_s", "s"), ("_m", "m"))
#: More different bounds than this in one panel are not drawn.
BOUNDS = 6


def packed(values: Floats) -> dict[str, str]:
    """Numbers as the plotting library reads them: little-endian 32-bit floats in base64."""
    return {"dtype": "f4", "bdata": base64.b64encode(np.asarray(values, "<f4").tobytes()).decode()}


def times(values: Floats) -> dict[str, str]:
    """Times likewise; whole seconds in 16 bits."""
    whole = np.asarray(values, float)
    if len(whole) and np.isfinite(whole).all() and whole.min() >= 0 and whole.max() < 65536 and not (whole % 1.0).any():
        return {"dtype": "u2", "bdata": base64.b64encode(whole.astype("<u2").tobytes()).decode()}
    return packed(whole)


def panels(drawn: Drawn) -> list[Panel]:
    """All panels that apply to a run, in the order of the page."""
    found = [*_train_graph(drawn), _speeds(drawn), *_spacings(drawn), *_errors(drawn), _inputs(drawn)]
    found += [*_unit_forces(drawn), *_couplers(drawn), *_energy(drawn), *_events(drawn)]
    for one in found:
        one["traces"].sort(key=lambda trace: natural(str(trace.get("group", ""))))  # stable: bands stay under their lines
        _set_aside(one)
    return [one for one in found if one["traces"]]


def _set_aside(one: Panel) -> None:
    """Mark the bounds of a panel that are so far from its data that they would squeeze them: ``far`` is -1 below and 1 above."""
    lines = [trace["y"]["bdata"] for trace in one["traces"] if isinstance(trace["y"], dict)]
    values = np.frombuffer(b"".join(map(base64.b64decode, lines)), "<f4").astype(float)
    values = values[np.isfinite(values)]
    if "log" in one or "least_range" in one or not len(values):
        return
    below, above = style.far(values, [bound["value"] for bound in one.get("bounds", ())])
    for bound in one.get("bounds", ()):
        bound["far"] = -1 if bound["value"] in below else int(bound["value"] in above)


def natural(name: str) -> list[tuple[int, int, str]]:
    """Key to sort names by: their numbers by size."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.findall(r"\d+|\D+", name)]


def panel(name: str, title: str, unit: str, traces: list[Trace], **more: Any) -> Panel:
    """One panel; ``bounds`` are horizontal lines (value, name, dash)."""
    return {"id": name, "title": title, "unit": unit, "traces": traces, **more}


def _line(x: Floats, y: Floats, name: str, colour: str, lines: int, **look: Any) -> Trace:
    most, minimum = POINTS
    x, y = style.envelope(
        *style.broken(np.asarray(x, float), np.asarray(y, float)), int(np.clip(POINTS_PER_PANEL // lines, minimum, most))
    )
    return {"x": times(x), "y": packed(y), "name": name, "color": colour, **look}


def _colour(drawn: Drawn, name: str) -> str:
    return _hex(drawn.colour[name])


def _hex(colour: Any) -> str:
    if isinstance(colour, str):
        return colour
    return "#" + "".join(f"{round(255 * float(part)):02x}" for part in colour[:3])


def _limits(values: Any) -> list[dict[str, Any]]:
    found = sorted({float(v) for v in values if np.isfinite(v)})
    return [{"value": v, "name": "bound", "dash": "dash"} for v in found] if len(found) <= BOUNDS else []


def _reference(drawn: Drawn, value: Floats) -> Trace:
    return _line(drawn.instants, value, "reference", "ink", 10, dash="dot")


def _train_graph(drawn: Drawn) -> Iterator[Panel]:
    """Time against distance, one dash per track; below, relative to the reference."""
    time, position = drawn.trains.column("time_s"), drawn.trains.column("position_m")
    if drawn.known.traffic:
        yield from _corridors(drawn)
        return
    track = drawn.trains.words["track"]
    tracks, on = sorted(track.taken(), key=natural), track.each()  # as in the figures
    reference = drawn.known.reference
    kinds = [("graph", "Train graph", "position [km]")]
    relative, crowd = to_reference(drawn)
    held = _not_of_a_crowd(drawn, len(drawn.trains.names))
    if crowd:
        kinds.append(("relative", "Gained on the reference since the start", "gained [km]"))
    elif reference is not None:
        kinds.append(("relative", "Position relative to the reference", "x - x_r [km]"))
    for name, title, unit in kinds:
        traces: list[Trace] = []
        shaded = (name == "graph") == bool(held.blocks or reference is None)
        if shaded:
            shown = {train: (position if name == "graph" else relative)[rows] for train, rows in drawn.trains.slices()}
            traces += _shades(drawn, held, shown, {train: position[rows] for train, rows in drawn.trains.slices()})
        for train, rows in drawn.trains.slices():
            value = (position if name == "graph" else relative)[rows] / 1000
            for k, place in enumerate(tracks):
                here = on[rows] == place
                if not here.any():
                    continue
                reach: Bools = here.copy()
                reach[1:] |= here[:-1]  # up to the first row on the next track: the line has no hole
                traces.append(_line(
                    time[rows], np.where(reach, value, np.nan), f"train {train}, track {place}", _colour(drawn, train),
                    len(drawn.trains.names), dash=DASHES[k % len(DASHES)], group=train,
                ))  # fmt: skip
        if reference is not None and name == "graph":
            traces.append(_reference(drawn, leader_over(reference, drawn.instants)[0] / 1000))
        note = _of_tracks(tracks, reference is not None) if name == "graph" else ""
        note = f"{note} {held.words}".strip() if shaded else note
        here = _places(crossovers(drawn.run, drawn.trains)) if name == "graph" else []
        yield panel(name, title, unit, traces, note=note, places=here)


def _of_tracks(tracks: list[str], reference: bool) -> str:
    """What the lines of a train graph mean: dashes of tracks, where there are several, and the reference."""
    looks = [f"{LOOKS[k % len(LOOKS)]} on track {name}" for k, name in enumerate(tracks)]
    words = f"One colour per train: {', '.join(looks)}." if len(tracks) > 1 else "One colour per train."
    return f"{words} {THE_REFERENCE}" if reference else words


def _corridors(drawn: Drawn) -> Iterator[Panel]:
    """One train graph per corridor, with its places by name, train numbers and planned times."""
    time, rows_of = drawn.trains.column("time_s"), dict(drawn.trains.slices())
    found, left_out = corridors(drawn.run, drawn.trains)
    held = _not_of_a_crowd(drawn, max(len(corridor.distance) for corridor in found))
    for number, corridor in enumerate(found):
        value = np.full(len(time), np.nan)
        numbers: list[Trace] = []
        for k, (name, distance) in enumerate(corridor.distance.items()):
            value[rows_of[name]] = distance / 1000
            at = numbered_at(distance, k)
            numbers.append({
                "x": [float(time[rows_of[name]][at])], "y": [float(distance[at]) / 1000], "text": [name], "name": name,
                "color": _colour(drawn, name), "words": True, "group": name,
            })  # fmt: skip
        shades = _shades(drawn, held, corridor.distance, corridor.distance)
        traces = [*shades, *_in_and_out(drawn, value), *(numbers if len(numbers) <= NUMBERED else []), *_plans(drawn, corridor)]
        title = f"Train graph, {corridor.name}" if corridor.name else "Train graph"
        planned = "Rings are planned times." if any("rings" in trace for trace in traces) else ""
        note = " ".join(words for words in (IN_AND_OUT, planned, held.words) if words)
        note += f" No train came near {', '.join(corridor.beyond)}." if corridor.beyond else ""
        if corridor is found[-1] and left_out:
            note += f" {left_out[0].upper()}{left_out[1:]}."
        yield panel(f"graph{number or ''}", title, "distance [km]", traces, note=note, places=_places(corridor.places))


def _not_of_a_crowd(drawn: Drawn, lines: int) -> Occupied:
    """What the trains of a run occupy, where they are not too many to be told apart."""
    return occupied(drawn) if lines <= NUMBERED else Occupied()


def _shades(drawn: Drawn, held: Occupied, distance: dict[str, Floats], ways: dict[str, Floats]) -> Iterator[Trace]:
    """Blocks that trains hold, or their bodies and braking distances, as in the figures: bands behind the lines."""
    time, rows_of = drawn.trains.column("time_s"), dict(drawn.trains.slices())
    for name, front in distance.items():
        band: Trace = {"color": _colour(drawn, name), "group": name, "band": True}
        if held.blocks:
            found = held.blocks[name].on(front) if name in held.blocks else []
            x = [t for b in found for t in (b.begin_s, b.end_s, b.end_s, b.begin_s, b.begin_s, np.nan)]
            y = [at / 1000 for b in found for at in (b.from_m, b.from_m, b.to_m, b.to_m, b.from_m, np.nan)]
            if found:
                yield {**band, "x": packed(np.array(x)), "y": packed(np.array(y)), "name": f"blocks, train {name}", "fill": "self"}
        elif held.length:
            some = np.flatnonzero(np.isfinite(front))
            some = some[:: -(-len(some) // SHADED)]
            at, sign = times(time[rows_of[name]][some]), along(ways[name])[some]
            rear, stand = front[some] - sign * held.length[name], front[some] + sign * held.braking[name][some]
            yield {**band, "x": at, "y": packed(rear / 1000), "name": f"rear, train {name}"}
            yield {**band, "x": at, "y": packed(stand / 1000), "name": f"braking distance, train {name}", "fill": True}


def _plans(drawn: Drawn, corridor: Corridor) -> Iterator[Trace]:
    for name, (x, y, _) in plans(drawn, corridor).items():
        yield {
            "x": x, "y": y, "name": f"train {name}, planned", "color": _colour(drawn, name), "dash": "4px,3px", "rings": True,
            "group": name,
        }  # fmt: skip


def _places(found: tuple[Place, ...]) -> list[dict[str, Any]]:
    return [
        {
            "value": place.at_m / 1000,
            "name": f"{place.name} (no train came)" if place.kind == "unreached" else place.name,
            "stop": place.kind == "stop",
            **({"unreached": True} if place.kind == "unreached" else {}),
        }
        for place in found
    ]


#: Of panels of links.
OF_LINKS = "A link has the colour of its train behind."
#: Of panels of trains that come and go.
IN_AND_OUT = "Full where the train is in a formation, dotted where it is not; no line where it is not on the net."


def _in_and_out(drawn: Drawn, value: Floats) -> Iterator[Trace]:
    """A full line for the train in formations, a dotted one for the train alone."""
    time, inside = drawn.trains.column("time_s"), in_formation(drawn)
    for name, rows in drawn.trains.slices():
        inner = inside[rows]
        outer: Bools = ~inner
        outer[1:] |= outer[:-1] & inner[1:]  # up to the first row in the formation: the line has no hole
        for here, dash, words in ((inner, "solid", ""), (outer, "2px,3px", ", in no formation")):
            if here.any():
                yield _line(
                    time[rows], np.where(here, value[rows], np.nan), f"train {name}{words}", _colour(drawn, name),
                    len(drawn.trains.names), dash=dash, group=name,
                )  # fmt: skip


def _speeds(drawn: Drawn) -> Panel:
    factor = drawn.per_mps
    speed = factor * drawn.trains.column("speed_mps")
    traces = list(_in_and_out(drawn, speed)) if drawn.known.traffic else _of_trains(drawn, speed)
    if drawn.known.reference is not None:
        traces.append(_reference(drawn, factor * leader_over(drawn.known.reference, drawn.instants)[1]))
    bounds = _limits(factor * value for pair in drawn.known.speed_mps.values() for value in pair)
    if drawn.known.cruise_mps is not None:
        bounds.append({"value": factor * drawn.known.cruise_mps, "name": "cruising speed", "dash": "dot"})
    note = f"{IN_AND_OUT} Bounds are those of trains in formations." if drawn.known.traffic else ""
    if drawn.known.reference is not None:
        note = f"{note} {THE_REFERENCE}".strip()
    return panel("speeds", "Speeds against bounds", f"speed [{drawn.speed_unit}]", traces, bounds=bounds, note=note)


def _inputs(drawn: Drawn) -> Panel:
    traces = _of_trains(drawn, drawn.trains.column("input_mps2"), step=True)
    bounds = _limits(value for pair in drawn.known.input_mps2.values() for value in pair)
    note = "Applied force of the whole train per mass, held until the next row."
    return panel("inputs", "Inputs against limits", "input [m/s²]", traces, bounds=bounds, note=note)


def _of_trains(drawn: Drawn, value: Floats, **look: Any) -> list[Trace]:
    time, count = drawn.trains.column("time_s"), len(drawn.trains.names)
    return [
        _line(time[rows], value[rows], f"train {name}", _colour(drawn, name), count, group=name, **look)
        for name, rows in drawn.trains.slices() if np.isfinite(value[rows]).any()
    ]  # fmt: skip


def _spacings(drawn: Drawn) -> Iterator[Panel]:
    """Spacing of every link, one panel per desired spacing and bounds."""
    links = drawn.links
    if not links.names:
        return
    time, spacing = links.column("time_s"), links.column("spacing_m")
    keys = np.column_stack([links.column(name) for name in ("desired_m", "lower_m", "upper_m")])
    groups: dict[tuple[float, float, float], list[tuple[str, str, Any]]] = {}
    for (_, behind), (name, rows) in zip(links.ends, links.slices(), strict=True):
        kinds, which = np.unique(keys[rows], axis=0, return_inverse=True)
        for j, kind in enumerate(kinds):
            groups.setdefault(tuple(kind.tolist()), []).append((behind, name, np.flatnonzero(which.ravel() == j) + rows.start))
    shown = sorted(sorted(groups, key=lambda key: -len(groups[key]))[:4])
    for number, key in enumerate(shown):
        desired, lower, upper = key
        traces = [
            _line(time[rows], spacing[rows] / 1000, f"link {name}", _colour(drawn, behind), len(groups[key]), group=behind)
            for behind, name, rows in groups[key]
        ]
        bounds = _limits([lower / 1000, upper / 1000]) + [{"value": desired / 1000, "name": "desired", "dash": "dot"}]
        title = f"Spacing against bounds, desired {desired / 1000:g} km"
        note = (
            f"{len(groups) - len(shown)} other pairs of desired spacing and bounds are not shown."
            if len(groups) > len(shown)
            else ""
        )
        yield panel(
            f"spacing{number or ''}",
            title,
            "spacing [km]",
            traces,
            bounds=bounds,
            note=f"{OF_LINKS} {note}".strip() if number == 0 else "",
        )


def _errors(drawn: Drawn) -> Iterator[Panel]:
    links = drawn.links
    if not links.names:
        return
    time, error = links.column("time_s"), np.maximum(np.abs(links.column("error_m")), 1e-9)
    traces = [
        _line(time[rows], error[rows], f"link {name}", _colour(drawn, behind), len(links.names), group=behind)
        for (_, behind), (name, rows) in zip(links.ends, links.slices(), strict=True)
    ]
    minimum = max(1e-6, float(error.min()))
    high = max(10.0 * minimum, float(error.max()))
    yield panel(
        "errors",
        "Distance from the desired spacing",
        "|error| [m]",
        traces,
        log=[float(np.log10(minimum)), float(np.log10(2 * high))],
    )


def _unit_forces(drawn: Drawn) -> Iterator[Panel]:
    if not drawn.units.names:
        return
    low, high = at_most(drawn.units, "force_min_n", "force_n"), at_least(drawn.units, "force_max_n", "force_n")
    limits = {limit for row in drawn.known.traction_n.values() for limit in row}
    limits |= {-limit for row in drawn.known.braking_n.values() for limit in row}
    traces = _of_units(drawn, drawn.units.column("force_n") / 1000, low / 1000, high / 1000, "unit")
    bounds = _limits(limit / 1000 for limit in limits)
    note = "Shaded: minimum and maximum of all units of a train over the sub-steps since the last row."
    yield panel("forces", "Unit forces against limits", "unit force [kN]", traces, bounds=bounds, note=note)


def _couplers(drawn: Drawn) -> Iterator[Panel]:
    if not drawn.units.names or not np.isfinite(drawn.units.column("coupler_m")).any():
        return
    low, high = at_most(drawn.units, "coupler_min_m", "coupler_m"), at_least(drawn.units, "coupler_max_m", "coupler_m")
    traces = _of_units(drawn, drawn.units.column("coupler_m"), low, high, "coupler")
    yield panel(
        "couplers", "Coupler strokes against their range", "coupler stroke [m]", traces, bounds=_limits(drawn.known.coupler_m),
        note="Positive when stretched. Shaded as above.", least_range=1e-3,
    )  # fmt: skip


def _of_units(drawn: Drawn, value: Floats, low: Floats, high: Floats, what: str) -> list[Trace]:
    """A line per unit, and per train the band of the extremes of its units."""
    time, lines = drawn.units.column("time_s"), len(drawn.units.names) + 2 * len(drawn.names)
    traces, bands = [], []
    of_train: dict[str, list[slice]] = {}
    for name, rows in drawn.units.slices():
        if np.isfinite(value[rows]).any():
            train, _, unit = name.rpartition(".")
            of_train.setdefault(train, []).append(rows)
            alpha = max(1.0 - 0.15 * (int(unit) - 1), 0.4) if unit.isdigit() else 1.0
            traces.append(_line(time[rows], value[rows], f"{what} {name}", _colour(drawn, train), lines, group=train, alpha=alpha))
    for train, parts in of_train.items():
        at = np.unique(np.round(np.concatenate([time[rows] for rows in parts]) / INSTANT)) * INSTANT
        minimum, maximum = np.full(len(at), np.inf), np.full(len(at), -np.inf)
        for rows in parts:
            k = np.clip(np.searchsorted(at, time[rows] - INSTANT / 2), 0, len(at) - 1)
            minimum[k], maximum[k] = np.fmin(minimum[k], low[rows]), np.fmax(maximum[k], high[rows])
        some = np.isfinite(minimum) & np.isfinite(maximum)
        at, minimum, maximum = at[some], minimum[some], maximum[some]
        if not len(at):
            continue
        stretch = -(-len(at) // 500)
        starts = np.arange(0, len(at), stretch)
        minimum, maximum = np.minimum.reduceat(minimum, starts), np.maximum.reduceat(maximum, starts)
        band = {"color": _colour(drawn, train), "group": train, "band": True, "x": times(at[starts])}
        bands += [{**band, "y": packed(minimum), "name": f"minimum, train {train}"}]
        bands += [{**band, "y": packed(maximum), "name": f"maximum, train {train}", "fill": True}]
    return bands + traces


def _energy(drawn: Drawn) -> Iterator[Panel]:
    """Work at the wheel since the start, per train."""
    split = drawn.trains
    time, count = split.column("time_s"), 2 * len(split.names)
    unit, note = "work [kWh]", "Traction full, braking dotted; at the wheel, integrated over the sub-steps."
    if {"traction_j", "braking_j"} <= set(split.numbers):
        traction, braking = np.nan_to_num(split.column("traction_j")), np.nan_to_num(split.column("braking_j"))
    else:
        mass = {name: sum(row) for name, row in drawn.known.mass_kg.items()}
        known = set(split.names) <= set(mass)
        weight = np.repeat([mass[name] if known else 1000.0 for name in split.names], np.diff(split.first))
        moved = np.append(0.0, np.diff(split.column("position_m"))) * split.follows()
        work = np.append(0.0, np.nan_to_num(split.column("input_mps2") * weight)[:-1]) * moved
        traction, braking = np.maximum(work, 0.0), np.maximum(-work, 0.0)
        unit = unit if known else "work [kWh/t]"
        note = "Traction full, braking dotted; at the wheel, input held between rows."
    traces = []
    for name, rows in split.slices():
        for work, dash, what in ((traction, "solid", "traction"), (braking, "dot", "braking")):
            total = np.cumsum(work[rows]) / JOULES_PER_KWH
            traces.append(_line(time[rows], total, f"train {name}, {what}", _colour(drawn, name), count, dash=dash, group=name))
    yield panel("energy", "Energy", unit, traces, note=note)


def happened(drawn: Drawn) -> list[dict[str, Any]]:
    """The events of a run but for what is said of SUMO's files: that stands in the summary, and happens at no moment."""
    return [event for event in drawn.run.events if event["kind"] not in ("followed", "not_followed")]


def _events(drawn: Drawn) -> Iterator[Panel]:
    """What happened when: one row per kind."""
    by_kind: dict[str, list[tuple[float, str]]] = {}
    for event in happened(drawn):
        by_kind.setdefault(event["kind"], []).append((float(event["time_s"]), told(event)))
    most = 500
    traces = []
    for k, (kind, items) in enumerate(sorted(by_kind.items())):
        some = items if len(items) <= most else items[:: -(-len(items) // most)]
        traces.append({
            "x": [at for at, _ in some], "y": [kind] * len(some), "text": [text for _, text in some],
            "name": f"{kind} ({len(items)})",
            "color": _hex(style.COLOURS[k % len(style.COLOURS)]), "points": True,
        })  # fmt: skip
    yield panel("events", "Events", "", traces, categories=True, note="Hover for details.")


def told(event: dict[str, Any]) -> str:
    """An event in one line, without its time and kind."""
    parts = []
    for key, value in event.items():
        if key in ("time_s", "kind") or value in ([], None):
            continue
        if key == "edges":
            value = _ends(["-".join(map(str, edge)) for edge in value], " ", "links")
        elif key == "formations":
            value = _ends([_ends(list(map(str, group)), " ", "trains") for group in value], " | ", "formations")
        name, unit = next(((key.removesuffix(end), f" {unit}") for end, unit in UNITS if key.endswith(end)), (key, ""))
        shown = f"{value:.6g}" if isinstance(value, float) else str(value)
        parts.append(f"{'links' if name == 'edges' else name.replace('_', ' ')} {shown}{unit}")
    line = ", ".join(parts)
    return line if len(line) <= LETTERS else f"{line[: LETTERS - 1]}…"


def _ends(words: list[str], between: str, what: str) -> str:
    """All words, or of many the first and the last ones and how many there are."""
    if len(words) <= MANY:
        return between.join(words)
    return between.join([*words[:3], "…", *words[-2:]]) + f" ({len(words)} {what})"
