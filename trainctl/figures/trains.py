"""Figures of whole trains: positions, spacings, speeds, inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from trainctl.figures import style
from trainctl.runs.known import Facts, facts
from trainctl.runs.run import Run
from trainctl.runs.series import INSTANT, Pairs, Series, pairs, series
from trainctl.signals import Bools, Floats, leader_over

#: Events that every panel over time marks, where trains do not come and go.
SHOWN_EVENTS = ("topology", "reroute", "join", "leave", "fault", "limit", "brake", "brake_released")
#: Trains of one panel whose numbers stand on their lines, at most; more are a crowd.
NUMBERED = 30
#: What a crowd is drawn by.
GAINED = "gained on the reference\nsince the start [km]"
#: More times than this are marked, but not named.
NAMED_EVENTS = 6


@dataclass
class Drawn:
    """A run made ready for drawing."""

    run: Run
    known: Facts
    trains: Series
    links: Pairs
    units: Series
    width: str  # "single" or "double", see style.WIDTHS_MM
    clock: bool = False  # time in hours and minutes
    kmh: bool = False  # speeds in km/h

    @property
    def per_mps(self) -> float:
        """What speeds are multiplied with before they are drawn."""
        return 3.6 if self.kmh else 1.0

    @property
    def speed_unit(self) -> str:
        """Unit of the speeds drawn."""
        return "km/h" if self.kmh else "m/s"

    @cached_property
    def origin(self) -> str:
        """What the run is: title, law, version, seed, backend, and the sum that tells its scenario from others."""
        info, versions = self.run.info, self.run.info.get("versions", {})
        words = [
            self.known.title or self.run.folder.name,
            f"law {self.known.law}" if self.known.law else "",
            f"trainctl {versions['trainctl']}" if versions.get("trainctl") else "",
            f"SUMO {versions['sumo']}" if versions.get("sumo") and info.get("backend") == "sumo" else "",
            f"backend {info['backend']}" if info.get("backend") else "",
            f"seed {info['seed']}" if info.get("seed") is not None else "",
            f"scenario {info['scenario_sha256'][:12]}" if info.get("scenario_sha256") else "",
        ]
        return ", ".join(word for word in words if word)

    @cached_property
    def instants(self) -> Floats:
        """All recorded times [s]."""
        time: Floats = np.unique(self.trains.column("time_s"))
        return time

    @cached_property
    def names(self) -> tuple[str, ...]:
        """All trains, in the order of the scenario."""
        known = self.known.trains
        return (*known, *(name for name in self.trains.names if name not in known))

    @cached_property
    def colour(self) -> dict[str, Any]:
        """Colour of each train."""
        return dict(zip(self.names, style.colours(len(self.names)), strict=True))

    @cached_property
    def look(self) -> dict[str, dict[str, Any]]:
        """Colour and line width of each train."""
        widths = style.weights(len(self.names))
        return {name: {"color": self.colour[name], "linewidth": width} for name, width in zip(self.names, widths, strict=True)}


def drawable(run: Run, width: str = "double", clock: bool = False, kmh: bool = False) -> Drawn:
    """Sort the tables of a run into series."""
    units = series(run.rows("units", missing_is_empty=True), "train", "unit")
    return Drawn(run, facts(run), series(run.rows("trains"), "train"), pairs(run.rows("links")), units, width, clock, kmh)


def to_reference(drawn: Drawn) -> tuple[Floats, bool]:
    """Positions of all rows relative to the reference [m]; of a crowd, whether it is one, what each train gained since its start.

    No one tells the lines of a crowd apart where they are, but who gains on whom.
    """
    position, reference = drawn.trains.column("position_m"), drawn.known.reference
    if reference is None:
        return position, False
    relative = position - leader_over(reference, drawn.trains.column("time_s"))[0]
    if len(drawn.trains.names) <= NUMBERED:
        return relative, False
    return relative - np.repeat(relative[drawn.trains.first[:-1]], np.diff(drawn.trains.first)), True


def positions(drawn: Drawn) -> Figure:
    """Positions against time, and below relative to the reference, see ``to_reference``."""
    reference = drawn.known.reference
    figure, axes = style.panels(1 if reference is None else 2, drawn.width)
    time, position = drawn.trains.column("time_s"), drawn.trains.column("position_m")
    inside, (relative, crowd) = in_formation(drawn), to_reference(drawn)
    for (name, rows), label in zip(drawn.trains.slices(), style.labels(drawn.trains.names, "train "), strict=True):
        for panel, value in zip(axes, (position[rows] / 1000, relative[rows] / 1000), strict=False):
            in_and_out(panel, time[rows], value, inside[rows], drawn.colour[name], label)
    if reference is not None:
        instants = drawn.instants
        style.draw(axes[0], instants, leader_over(reference, instants)[0] / 1000, color="black", linestyle=":", label="reference")
        axes[1].set_ylabel(GAINED if crowd else r"$x_i - x_r$ [km]", parse_math=True)
    axes[0].set_ylabel("position [km]")
    _finish(figure, axes, drawn)
    return figure


def spacings(drawn: Drawn) -> Figure:
    """Spacing of every link, one panel per desired spacing and bounds; bounds dashed, desired dotted."""
    groups: dict[tuple[float, float, float], list[tuple[str, Floats, Floats]]] = {}
    time, spacing = drawn.links.column("time_s"), drawn.links.column("spacing_m")
    keys = np.column_stack([drawn.links.column(name) for name in ("desired_m", "lower_m", "upper_m")])
    for name, rows in drawn.links.slices():
        kinds, which = np.unique(keys[rows], axis=0, return_inverse=True)
        for k, kind in enumerate(kinds):
            here = which.ravel() == k
            groups.setdefault(tuple(kind.tolist()), []).append((name, time[rows][here], spacing[rows][here]))
    shown = sorted(sorted(groups, key=lambda key: -len(groups[key]))[:4])
    figure, axes = style.panels(len(shown), drawn.width, 40.0)
    looks = _looks(drawn.links.names)
    for panel, key in zip(axes, shown, strict=True):
        desired, lower, upper = key
        style.bound(panel, lower / 1000, upper / 1000)
        panel.axhline(desired / 1000, color="black", linestyle=":", linewidth=0.9, label="desired", zorder=3)
        for name, at, value in groups[key]:
            style.draw(panel, at, value / 1000, **looks[name])
        panel.set_ylabel("spacing [km]")
    if len(groups) > len(shown):
        axes[-1].set_title(f"{len(groups) - len(shown)} other pairs of desired spacing and bounds not shown")
    _finish(figure, axes, drawn)
    return figure


def spacing_errors(drawn: Drawn) -> Figure:
    """Distance of every link from its desired spacing, logarithmic."""
    figure, axes = style.panels(1, drawn.width, 52.0)
    time, error = drawn.links.column("time_s"), np.abs(drawn.links.column("error_m"))
    smallest = 1e-6  # m; below it is rounding
    looks = _looks(drawn.links.names)
    for name, rows in drawn.links.slices():
        style.draw(axes[0], time[rows], np.maximum(error[rows], 1e-3 * smallest), **looks[name])
    style.logarithmic(axes[0])
    axes[0].set_ylim(bottom=max(smallest, 0.5 * error[error > 0].min(initial=np.inf)) if (error > smallest).any() else smallest)
    axes[0].set_ylabel(r"$|x_{ij} - d_{ij}|$ [m]", parse_math=True)
    _finish(figure, axes, drawn)
    return figure


def speeds(drawn: Drawn) -> Figure:
    """Speeds of the trains with bounds and reference."""
    figure, axes = style.panels(1, drawn.width, 52.0)
    draw_speeds(axes[0], drawn)
    _finish(figure, axes, drawn)
    return figure


def _draw_trains(panel: Axes, drawn: Drawn, values: Floats, drawstyle: str) -> None:
    """Draw a column of every train over time into a panel."""
    time = drawn.trains.column("time_s")
    for (name, rows), label in zip(drawn.trains.slices(), style.labels(drawn.trains.names, "train "), strict=True):
        style.draw(panel, time[rows], values[rows], label=label, drawstyle=drawstyle, **drawn.look[name])


def draw_speeds(panel: Axes, drawn: Drawn) -> None:
    """Draw speeds, bounds and reference into a panel."""
    factor = drawn.per_mps
    style.bound(panel, *(factor * v for v in _distinct(drawn.known.speed_mps.values())))
    _draw_trains(panel, drawn, factor * drawn.trains.column("speed_mps"), drawstyle="default")
    if drawn.known.reference is not None:
        instants = drawn.instants
        reference = factor * leader_over(drawn.known.reference, instants)[1]
        style.draw(panel, instants, reference, color="black", linestyle=":", label="reference", zorder=3)
    if drawn.known.cruise_mps is not None:
        style.bound(panel, factor * drawn.known.cruise_mps, label="cruising speed", color="black", linestyle=":")
    panel.set_ylabel(f"speed [{drawn.speed_unit}]")


def inputs(drawn: Drawn) -> Figure:
    """Applied inputs with bounds."""
    figure, axes = style.panels(1, drawn.width, 52.0)
    draw_inputs(axes[0], drawn)
    _finish(figure, axes, drawn)
    return figure


def draw_inputs(panel: Axes, drawn: Drawn) -> None:
    """Draw applied inputs, held until the next row, and bounds into a panel."""
    style.bound(panel, *_distinct(drawn.known.input_mps2.values()))
    _draw_trains(panel, drawn, drawn.trains.column("input_mps2"), drawstyle="steps-post")
    panel.set_ylabel("input [m/s²]")


def speeds_and_inputs(drawn: Drawn) -> Figure:
    """Speeds above, applied inputs below."""
    figure, axes = style.panels(2, drawn.width)
    draw_speeds(axes[0], drawn)
    draw_inputs(axes[1], drawn)
    _finish(figure, axes, drawn)
    return figure


def speed_over_position(drawn: Drawn) -> Figure:
    """Speed against kilometrage, with the speed of the reference where it was."""
    figure, axes = style.panels(1, drawn.width, 52.0)
    position, speed = drawn.trains.column("position_m") / 1000, drawn.per_mps * drawn.trains.column("speed_mps")
    for (name, rows), label in zip(drawn.trains.slices(), style.labels(drawn.trains.names, "train "), strict=True):
        axes[0].plot(*style.envelope(position[rows], speed[rows]), label=label, **drawn.look[name])
    if drawn.known.reference is not None:
        where, reference, *_ = leader_over(drawn.known.reference, drawn.instants)
        axes[0].plot(where / 1000, drawn.per_mps * reference, color="black", linestyle=":", label="reference", zorder=3)
    axes[0].set_xlabel("position [km]")
    axes[0].set_ylabel(f"speed [{drawn.speed_unit}]")
    style.name_lines(figure, drawn.width)
    return figure


def gaps(drawn: Drawn) -> Figure:
    """Clear distance from the rear of the train ahead, with what the links want and allow at least."""
    figure, axes = style.panels(1, drawn.width, 52.0)
    time, gap = drawn.trains.column("time_s"), drawn.trains.column("gap_m") / 1000
    for (name, rows), label in zip(drawn.trains.slices(), style.labels(drawn.trains.names, "train "), strict=True):
        if np.isfinite(gap[rows]).any():
            style.draw(axes[0], time[rows], gap[rows], label=label, **drawn.look[name])
    wanted, minimum = set(), set()
    for (ahead, _), (_, rows) in zip(drawn.links.ends, drawn.links.slices(), strict=True):
        length = sum(drawn.known.length_m.get(ahead, (0.0,)))
        wanted |= set(np.unique(drawn.links.column("desired_m")[rows] - length).tolist())
        minimum |= set(np.unique(drawn.links.column("lower_m")[rows] - length).tolist())
    emergency = drawn.known.controller.get("emergency_distance_m")
    if isinstance(emergency, int | float):
        minimum.add(float(emergency))
    if len(wanted) <= 4:
        for value in wanted:
            axes[0].axhline(value / 1000, color="black", linestyle=":", linewidth=0.9, label="desired", zorder=3)
    if len(minimum) <= 4:
        style.bound(axes[0], *(value / 1000 for value in minimum), label="minimum allowed")
    axes[0].set_ylabel("gap to the one ahead [km]")
    _finish(figure, axes, drawn)
    return figure


def comparison(runs: Sequence[Run], names: Sequence[str], width: str = "double") -> Figure:
    """Speeds of several runs, one panel each on a common scale: a law against ordinary consensus, with and without disturbance."""
    with style.styled():
        drawn = [drawable(run, width) for run in runs]
        figure, axes = style.panels(len(drawn), width, sharey=True)
        for panel, one, name in zip(axes, drawn, names, strict=True):
            draw_speeds(panel, one)
            panel.set_title(name, loc="left")
        axes[-1].set_xlabel("time [s]")
        style.name_lines(figure, width)
    return figure


def _finish(figure: Figure, axes: Sequence[Axes], drawn: Drawn) -> None:
    style.time_axis(axes, drawn.instants[0], drawn.instants[-1], drawn.clock)
    mark_events(axes, drawn)
    style.name_lines(figure, drawn.width)


def mark_events(axes: Sequence[Axes], drawn: Drawn) -> None:
    """Mark in every panel when something happened to the formation; the first panel says what. Not where trains come and go."""
    if drawn.known.traffic:
        return
    kinds: dict[float, dict[str, None]] = {}
    for event in drawn.run.events:
        if event["kind"] in SHOWN_EVENTS and event["time_s"] > drawn.instants[0]:
            kinds.setdefault(float(event["time_s"]), {})[event["kind"]] = None
    for at in kinds:
        for panel in axes:
            panel.axvline(at, color=style.GREY, linewidth=0.5, zorder=1, gid=style.EVENT)
    if len(kinds) > NAMED_EVENTS:
        return
    span, last = float(drawn.instants[-1] - drawn.instants[0]), -np.inf
    for at, words in sorted(kinds.items()):
        if at - last > 0.04 * span:  # else its words would lie on those before
            axes[0].annotate(
                ", ".join(words), (at, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 1), textcoords="offset points",
                fontsize=6, color=style.GREY, ha="center", va="bottom",
            )  # fmt: skip
            last = at


def _looks(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Colour, width and label of links."""
    rows = zip(names, style.colours(len(names)), style.weights(len(names)), style.labels(names), strict=True)
    return {name: {"color": colour, "linewidth": width, "label": label} for name, colour, width, label in rows}


def _distinct(ranges: Any) -> list[float]:
    """The different finite bounds of all trains; none if there are too many to be told apart."""
    found = sorted({float(value) for pair in ranges for value in pair if np.isfinite(value)})
    return found if len(found) <= 6 else []


def in_formation(drawn: Drawn) -> Bools:
    """True for rows of trains in a formation: as logged, else where they have a link; for all rows if no train ever has one."""
    rows = drawn.trains
    if "in_formation" in rows.numbers:
        member: Bools = drawn.trains.column("in_formation") > 0.5
        return member
    if not drawn.links.names:
        return np.ones(len(rows), dtype=np.bool_)
    at = np.round(drawn.links.column("time_s") / INSTANT).astype(np.int64)
    linked: dict[str, set[int]] = {}
    for ends, (_, part) in zip(drawn.links.ends, drawn.links.slices(), strict=True):
        for name in ends:
            linked.setdefault(name, set()).update(at[part].tolist())
    out = np.zeros(len(rows), dtype=np.bool_)
    instants = np.round(drawn.trains.column("time_s") / INSTANT).astype(np.int64)
    for name, part in drawn.trains.slices():
        out[part] = np.isin(instants[part], list(linked.get(name, ())))
    return out


def in_and_out(panel: Axes, time: Floats, value: Floats, inside: Bools, colour: Any, label: str) -> None:
    """Full line where the train is in the formation, thin dotted where it is not."""
    style.draw(panel, time, np.where(inside, value, np.nan), color=colour, label=label)
    if not inside.all():
        outside = ~inside
        outside[1:] |= outside[:-1] & inside[1:]  # reach to the first row inside
        style.draw(
            panel, time, np.where(outside, value, np.nan), color=colour, linestyle=":", linewidth=0.7, alpha=0.8, label=f"_{label}"
        )
