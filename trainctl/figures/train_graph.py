"""The train graph of the trade: distance against time with places by name, train numbers on the lines, planned against actual."""

from __future__ import annotations

from typing import Any, NamedTuple

import matplotlib.patheffects as effects
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from trainctl.figures import style
from trainctl.figures.corridors import Corridor, corridors, crossovers
from trainctl.figures.occupied import Occupied, along, occupied
from trainctl.figures.trains import GAINED, NUMBERED, Drawn, in_and_out, in_formation, mark_events, to_reference
from trainctl.signals import Floats

#: Marks on a train's own line where trains come and go, and their words.
MARKS = {
    "couple": ("^", "joins a formation"), "uncouple": ("v", "leaves it"), "stop_reached": ("s", "stops"),
    "conflict": ("D", "waits for its turn"), "reroute": ("o", "new route"), "reroute_refused": ("x", "route refused"),
    "supervisor": ("|", "supervisor acts"), "brake": ("<", "ordered to brake"),
}  # fmt: skip
#: Below this share of the distance covered, a formation is a bundle in which no train is told from another.
BUNDLE = 0.3
#: A train later than this at a stop has its delay beside it [s].
LATE_S = 30.0


def train_graph(drawn: Drawn) -> Figure:
    """Time-distance diagram with the places on the way by name and train numbers on the lines.

    On a line of tracks: one colour per train, one line style per track; below, relative to the reference, where trains 5 km apart
    can be distinguished, and of many trains how far each has gained on it since the start. Where trains come and go: one
    panel per corridor, full lines for trains in formations, planned
    times dashed, and marks on the lines that say what happened.

    Of not too many trains their shades are what they occupy: blocks between signals under fixed block, else body and braking
    distance.
    """
    return _coming_and_going(drawn) if drawn.known.traffic else _on_tracks(drawn)


def _on_tracks(drawn: Drawn) -> Figure:
    reference = drawn.known.reference
    time, position = drawn.trains.column("time_s"), drawn.trains.column("position_m")
    relative, crowd = to_reference(drawn)
    bundle = crowd or (reference is not None and np.ptp(relative) < BUNDLE * np.ptp(position))
    held = occupied(drawn) if len(drawn.trains.names) <= NUMBERED else Occupied()
    ratio = [2, 1] if held.blocks else [1, 2] if bundle else [1, 1]
    figure, axes = style.panels(
        1 if reference is None else 2, drawn.width, 60.0, **({} if reference is None else {"height_ratios": ratio})
    )
    ways = {name: position[rows] for name, rows in drawn.trains.slices()}
    shown = ways if held.blocks else {name: relative[rows] for name, rows in drawn.trains.slices()}
    shades = _occupy(axes[0 if held.blocks else -1], held, shown, ways, drawn)
    track = drawn.trains.words["track"].each()
    tracks, switched = sorted(set(track), key=lambda name: (len(name), name)), False
    for (name, rows), label in zip(drawn.trains.slices(), style.labels(drawn.trains.names, "train "), strict=True):
        at, on = time[rows], track[rows]
        cuts = np.flatnonzero(on[1:] != on[:-1]) + 1
        switched |= len(cuts) > 0
        for panel, value in zip(axes, (position[rows] / 1000, relative[rows] / 1000), strict=False):
            for begin, end in zip([0, *cuts], [*cuts, len(at)], strict=True):
                line = style.TRACK_STYLES[tracks.index(on[begin]) % len(style.TRACK_STYLES)]
                style.draw(
                    panel, at[begin : end + 1], value[begin : end + 1], color=drawn.colour[name], linestyle=line, label=label
                )
            panel.plot(at[cuts], value[cuts], linestyle="none", marker="o", markersize=4, color=drawn.colour[name], zorder=4)
            for k in cuts if panel is axes[-1] else ():
                panel.annotate(
                    f"{on[k - 1]}→{on[k]}", (at[k], value[k]), xytext=(6, 0), textcoords="offset points", fontsize=6.5,
                    va="center", color=drawn.colour[name], zorder=5, bbox=style.PAPER,
                )  # fmt: skip
    axes[0].set_ylabel("position [km]")
    if reference is not None:
        axes[1].set_ylabel(GAINED if crowd else r"$x_i - x_r$ [km]", parse_math=True)
    style.time_axis(axes, drawn.instants[0], drawn.instants[-1], drawn.clock)
    mark_events(axes, drawn)
    style.name_places(axes[0], [(p.at_m / 1000, p.name, p.kind) for p in crossovers(drawn.run, drawn.trains)])
    if held.blocks:
        _number(axes[0], {name: (time[rows], position[rows] / 1000) for name, rows in drawn.trains.slices()}, drawn)
    if not crowd:
        _number(axes[-1], {name: (time[rows], relative[rows] / 1000) for name, rows in drawn.trains.slices()}, drawn)
    else:
        style.name_lines(figure, drawn.width)
    styles = [
        Line2D([], [], color=style.GREY, linestyle=style.TRACK_STYLES[k % len(style.TRACK_STYLES)], label=f"track {name}")
        for k, name in enumerate(tracks)
    ]
    if switched:
        styles.append(Line2D([], [], color=style.GREY, linestyle="none", marker="o", markersize=4, label="changes track"))
    style.legend(figure, drawn.width, [*styles, *shades])
    return figure


def _coming_and_going(drawn: Drawn) -> Figure:
    """One panel per corridor: trains of two branches that meet nowhere do not cross in it."""
    found, left_out = corridors(drawn.run, drawn.trains)
    figure, axes = style.panels(len(found), drawn.width, 84.0 if len(found) == 1 else 66.0)
    time, inside = drawn.trains.column("time_s"), in_formation(drawn)
    rows_of = dict(drawn.trains.slices())
    planned = False
    shades: dict[Any, Patch] = {}
    held = occupied(drawn) if max(len(corridor.distance) for corridor in found) <= NUMBERED else Occupied()
    for panel, corridor in zip(axes, found, strict=True):
        shades |= {shade.get_label(): shade for shade in _occupy(panel, held, corridor.distance, corridor.distance, drawn)}
        for name, distance in corridor.distance.items():
            rows = rows_of[name]
            in_and_out(panel, time[rows], distance / 1000, inside[rows], drawn.colour[name], f"_{name}")
        planned |= _draw_plans(panel, corridor, drawn)
        panel.set_ylabel("distance [km]")
        panel.margins(y=0.03)
        if corridor.name:
            panel.set_title(corridor.name, loc="left", fontweight="bold")
        far = [f"no train came near {', '.join(corridor.beyond)}"] if corridor.beyond else []
        panel.set_title("; ".join([*far, *([left_out] if left_out and panel is axes[-1] else [])]), loc="right", fontsize=7)
        unreached = [place.at_m / 1000 for place in corridor.places if place.kind == "unreached"]
        if unreached:
            panel.update_datalim([(drawn.instants[0], at) for at in unreached])
            panel.autoscale_view()
    style.time_axis(axes, drawn.instants[0], drawn.instants[-1], drawn.clock)
    marks = [mark for kind in MARKS for mark in _marks(axes, found, drawn, kind)]
    for panel, corridor in zip(axes, found, strict=True):
        style.name_places(panel, [(p.at_m / 1000, p.name, p.kind) for p in corridor.places])
        _number(panel, {name: (time[rows_of[name]], at / 1000) for name, at in corridor.distance.items()}, drawn)
    common = [] if inside.all() else [Line2D([], [], color=style.GREY, linestyle=":", linewidth=0.7, label="in no formation")]
    if planned:
        common.append(Line2D([], [], color=style.GREY, linestyle=(0, (4, 2)), marker="o", markerfacecolor="white", markersize=3.5,
                             linewidth=0.8, label="planned"))  # fmt: skip
    if any(place.kind == "unreached" for corridor in found for place in corridor.places):
        common.append(Line2D([], [], color=style.GREY, linestyle=(0, (1, 2)), linewidth=0.7, label="stop that no train reached"))
    style.legend(figure, drawn.width, [*common, *shades.values(), *marks])
    return figure


def _occupy(
    panel: Axes, held: Occupied, distance: dict[str, Floats], ways: dict[str, Floats], drawn: Drawn
) -> list[Patch]:  # fmt: skip
    """Shade what the trains of a panel occupy; entries of the legend.

    Fronts are drawn at ``distance`` [m], NaN where they are elsewhere, and run as they do on their ``ways`` [m].
    """
    if not (held.blocks or held.length):
        return []
    time, rows_of = drawn.trains.column("time_s"), dict(drawn.trains.slices())
    for name, front in distance.items():
        colour = drawn.colour[name]
        if held.blocks:
            corners = [
                [(b.begin_s, b.from_m / 1000), (b.end_s, b.from_m / 1000), (b.end_s, b.to_m / 1000), (b.begin_s, b.to_m / 1000)]
                for b in held.blocks[name].on(front)
            ] if name in held.blocks else []  # fmt: skip
            panel.add_collection(PolyCollection(
                corners, facecolors=[(*to_rgb(colour), 0.16)], edgecolors=[(*to_rgb(colour), 0.7)], linewidths=0.4, zorder=1,
                gid=f"blocks {name}",
            ))  # fmt: skip
            continue
        x, sign = time[rows_of[name]], along(ways[name])
        rear, stand = front - sign * held.length[name], front + sign * held.braking[name]
        for low, high, alpha, what in ((front, stand, 0.16, "braking"), (rear, front, 0.55, "body")):
            panel.fill_between(x, low / 1000, high / 1000, color=colour, alpha=alpha, linewidth=0, zorder=1, gid=f"{what} {name}")
    if held.blocks:
        since = f"a braking distance before, at {held.rate} m/s²" if held.rates else "its signal on"
        return [Patch(facecolor=style.GREY, edgecolor=style.GREY, alpha=0.4, label=f"block held (from {since})")]
    found = [Patch(facecolor=style.GREY, alpha=0.7, label="train")] if any(held.length.values()) else []
    if held.rates:
        found.append(Patch(facecolor=style.GREY, alpha=0.3, label=f"braking distance at {held.rate} m/s²"))
    return found


def _marks(axes: list[Axes], found: list[Corridor], drawn: Drawn, kind: str) -> list[Line2D]:
    """Marks of one kind of event, each on the line of its train in every panel that has it there; their entry in the legend."""
    mark, words = MARKS[kind]
    look: dict[str, Any] = {"linestyle": "none", "marker": mark, "markersize": 4.5, "markeredgecolor": "black"}
    time, rows_of = drawn.trains.column("time_s"), dict(drawn.trains.slices())
    events = [e for e in drawn.run.events if e["kind"] == kind and e.get("train") in rows_of]
    for event in events:
        name = event["train"]
        for panel, corridor in zip(axes, found, strict=True):
            if name in corridor.distance:
                at = float(np.interp(event["time_s"], time[rows_of[name]], corridor.distance[name] / 1000))
                if np.isfinite(at):
                    panel.plot(event["time_s"], at, color=drawn.colour[name], markeredgewidth=0.5, zorder=6, **look)
    return [Line2D([], [], color=style.GREY, markeredgewidth=0.5, label=f"{words} ({len(events)})", **look)] if events else []


class Plan(NamedTuple):
    """Planned times of one train along a corridor, and where it was late."""

    time: list[float]  # s
    distance: list[float]  # km
    late: list[tuple[float, float, float]]  # of each stop left or reached late: when [s], where [km], by how much [s]


def plans(drawn: Drawn, corridor: Corridor) -> dict[str, Plan]:
    """The timetable of the trains of a corridor, from stops.parquet; empty without one."""
    stops = drawn.run.stops
    if not len(stops):
        return {}
    at_of = {place.name: place.at_m / 1000 for place in corridor.places if place.kind == "stop"}
    columns = ["planned_arrival_s", "planned_departure_s", "arrival_s", "departure_s", "delay_s"]
    found: dict[str, Plan] = {}
    for train, calls in stops.astype({"train": str, "stop": str}).sort_values("number").groupby("train"):
        plan = Plan([], [], [])
        for stop, (arrives, departs, came, left, late) in zip(calls["stop"], calls[columns].to_numpy(float), strict=True):
            planned = [t for t in (arrives, departs) if np.isfinite(t)] if stop in at_of else []
            plan.time.extend(planned)
            plan.distance.extend([at_of[stop]] * len(planned) if planned else [])
            if planned and late > LATE_S:
                plan.late.append((float(left if np.isfinite(left) else came), at_of[stop], float(late)))
        if plan.time and str(train) in corridor.distance:
            found[str(train)] = plan
    return found


def _draw_plans(panel: Axes, corridor: Corridor, drawn: Drawn) -> bool:
    """Planned times at the stops of a corridor, dashed from stop to stop, and delays beside them; whether there are any."""
    found = plans(drawn, corridor)
    for name, plan in found.items():
        panel.plot(
            plan.time, plan.distance, color=drawn.colour[name], linestyle=(0, (4, 2)), linewidth=0.8, marker="o", markersize=3.5,
            markerfacecolor="white", alpha=0.9, zorder=2, gid="planned",
        )  # fmt: skip
        for at, place, late in plan.late:
            panel.annotate(
                f"+{late:.0f} s", (at, place), xytext=(3, -3), textcoords="offset points", fontsize=6, va="top",
                color=drawn.colour[name], zorder=5, bbox=style.PAPER,
            )  # fmt: skip
    return bool(found)


def numbered_at(distance: Floats, k: int) -> int:
    """Row at which the number of the k-th train stands on its line; those of trains that run close together one after the other."""
    some = np.flatnonzero(np.isfinite(distance))
    way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(distance[some])))])  # where a train stands, marks and places stand too
    return int(some[np.searchsorted(way, (0.25 + 0.1 * (k % 5)) * way[-1]).clip(0, len(some) - 1)])


def _number(panel: Axes, lines: dict[str, tuple[Floats, Floats]], drawn: Drawn) -> None:
    """Train numbers along the lines; of many trains every so many-th has its own."""
    stride = -(-len(lines) // NUMBERED)
    for k, (name, (x, y)) in enumerate(lines.items()):
        some = np.flatnonzero(np.isfinite(y))
        if k % stride or len(some) < 2:
            continue
        here = numbered_at(y, k // stride)
        reach = max(1, int(0.01 * len(drawn.instants)))
        a, b = max(here - reach, some[0]), min(here + reach, some[-1])
        ends = np.array([[x[a], y[a]], [x[b], y[b]]])
        run = panel.transData.transform(ends) if np.isfinite(ends).all() else np.zeros((2, 2))
        angle = float(np.degrees(np.arctan2(run[1, 1] - run[0, 1], run[1, 0] - run[0, 0]))) if np.ptp(run) else 0.0
        panel.text(
            float(x[here]), float(y[here]), name, fontsize=6.5, color=drawn.colour[name], rotation=angle, rotation_mode="anchor",
            ha="center", va="center", zorder=7, clip_on=True, gid=f"number {name}",
            path_effects=[effects.withStroke(linewidth=2.2, foreground="white")],
        )  # fmt: skip
