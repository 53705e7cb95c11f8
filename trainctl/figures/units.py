"""Figures of units: couplers, forces, differences between carriages, estimates against truth."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from trainctl.figures import style
from trainctl.figures.trains import Drawn, mark_events
from trainctl.metrics.values import at_least, at_most
from trainctl.signals import Floats, leader_over

#: Stretch of time of a magnified panel [s].
ZOOM_S = 60.0
#: Points of a fault that is drawn as the scenario states it are so far apart [s].
FAULT_S = 0.1


def couplers(drawn: Drawn) -> Figure:
    """Coupler displacements: shaded from minimum to maximum over the sub-steps, with the allowed range."""
    figure, axes = style.panels(1, drawn.width, 52.0)
    low, high = at_most(drawn.units, "coupler_min_m", "coupler_m"), at_least(drawn.units, "coupler_max_m", "coupler_m")
    most = float(np.nanmax(np.abs([low, high]), initial=0.0))
    factor, unit = (1000.0, "mm") if most < 0.01 else (1.0, "m")
    _bands(axes[0], drawn, factor * drawn.units.column("coupler_m"), factor * low, factor * high)
    style.bound(axes[0], *(factor * bound for bound in drawn.known.coupler_m))
    axes[0].set_ylabel(f"coupler displacement [{unit}]")
    style.room(axes[0], factor * 1e-3)
    return _finished(figure, axes, drawn)


def coupler_forces(drawn: Drawn) -> Figure:
    """Coupler forces at the recorded instants, positive when pulling."""
    figure, axes = style.panels(1, drawn.width, 52.0)
    force = drawn.units.column("coupler_force_n") / 1000
    _bands(axes[0], drawn, force, force, force)
    axes[0].set_ylabel("coupler force [kN]")
    style.room(axes[0], 0.1)
    return _finished(figure, axes, drawn)


def unit_forces(drawn: Drawn) -> Figure:
    """Forces of all units: shaded from minimum to maximum over the sub-steps, with the limits."""
    figure, axes = style.panels(1, drawn.width, 52.0)
    low, high = at_most(drawn.units, "force_min_n", "force_n"), at_least(drawn.units, "force_max_n", "force_n")
    _bands(axes[0], drawn, drawn.units.column("force_n") / 1000, low / 1000, high / 1000)
    limits = {limit for row in drawn.known.traction_n.values() for limit in row}
    limits |= {-limit for row in drawn.known.braking_n.values() for limit in row}
    if len(limits) <= 4:
        style.bound(axes[0], *(limit / 1000 for limit in limits), label="limit")
    axes[0].set_ylabel("unit force [kN]")
    style.focus(axes[0], drawn.units.column("time_s"), low / 1000, high / 1000)
    return _finished(figure, axes, drawn)


def positions(drawn: Drawn) -> Figure:
    """Positions of all units and of the reference."""
    return _over_time(drawn, "position_m", "position [km]", 1000.0, 0)


def speeds(drawn: Drawn) -> Figure:
    """Speeds of all units and of the reference."""
    return _over_time(drawn, "speed_mps", f"speed [{drawn.speed_unit}]", 1.0 / drawn.per_mps, 1)


def position_differences(drawn: Drawn) -> Figure:
    """Above: distance of adjacent trains, rear unit to leading unit, with bounds; below: distance of adjacent units."""
    figure, axes = style.panels(2, drawn.width)
    _between_trains(axes[0], drawn, "position_m", 1000.0)
    shift = {name: sum(length[:-1]) for name, length in drawn.known.length_m.items()}
    desired: dict[str, Any] = {"color": "black", "linestyle": ":", "label": "desired"}
    for kind in ("desired_m", "lower_m", "upper_m"):
        values = {
            float(value) - shift.get(ahead, 0.0)
            for (ahead, _), (_, rows) in zip(drawn.links.ends, drawn.links.slices(), strict=True)
            for value in np.unique(drawn.links.column(kind)[rows])
        }
        if len(values) <= 4:
            style.bound(axes[0], *(value / 1000 for value in values), **(desired if kind == "desired_m" else {}))
    axes[0].set_ylabel("between trains [km]")
    _between_units(axes[1], drawn, "position_m")
    axes[1].set_ylabel("between units [m]")
    return _finished(figure, axes, drawn)


def speed_differences(drawn: Drawn) -> Figure:
    """Above: speed of the rear unit of the train ahead minus that of the own first, with bounds; below: between adjacent units."""
    figure, axes = style.panels(2, drawn.width)
    _between_trains(axes[0], drawn, "speed_mps", 1.0)
    stated = [drawn.known.controller.get(f"speed_error_{side}_mps") for side in ("lower", "upper")]
    style.bound(axes[0], *(float(value) for value in stated if isinstance(value, int | float)))
    axes[0].set_ylabel("between trains [m/s]")
    _between_units(axes[1], drawn, "speed_mps")
    axes[1].set_ylabel("between units [m/s]")
    return _finished(figure, axes, drawn)


def unit_differences(drawn: Drawn) -> Figure:
    """Distance and speed difference of adjacent units."""
    figure, axes = style.panels(2, drawn.width)
    _between_units(axes[0], drawn, "position_m")
    axes[0].set_ylabel("distance [m]")
    _between_units(axes[1], drawn, "speed_mps")
    axes[1].set_ylabel("speed diff. [m/s]")
    return _finished(figure, axes, drawn)


def estimates(quantity: str, label: str) -> Callable[[Drawn], Figure]:
    """Make the figure of one unit's ``quantity`` and its estimate above, the error of all units below."""
    truth = {"fault": "fault_mps3", "acceleration": "acceleration_mps2"}[quantity]
    estimate = {"fault": "fault_estimate_mps3", "acceleration": "acceleration_estimate_mps2"}[quantity]

    def figure_of(drawn: Drawn) -> Figure:
        figure, axes = style.panels(3, drawn.width, 36.0, sharex=False)
        time = drawn.units.column("time_s")
        true, guess = drawn.units.column(truth), drawn.units.column(estimate)
        name, rows = drawn.units.slices()[0]
        exact = _stated_fault(drawn, name, time[rows], true[rows]) if quantity == "fault" else None
        x, y = (time[rows], true[rows]) if exact is None else exact
        options: dict[str, Any] = {"color": style.COLOURS[1], "linestyle": (0, (4, 1.5)), "label": f"estimate, unit {name}"}
        begin = _worst_after_start(time[rows], guess[rows] - true[rows]) - ZOOM_S / 3
        near, inside = ((at >= begin) & (at <= begin + ZOOM_S) for at in (x, time[rows]))
        # of the magnified stretch alone every row is drawn: of the whole log only extremes
        both_lines: list[tuple[Axes, Any, Any]] = [(axes[0], slice(None), slice(None)), (axes[1], near, inside)]
        for panel, some, seen in both_lines:
            style.draw(panel, x[some], y[some], color=style.COLOURS[0], linewidth=1.6, label=f"truth, unit {name}")
            style.draw(panel, time[rows][seen], guess[rows][seen], **options)
            panel.set_ylabel(label)
        both = np.concatenate([y[near], guess[rows][inside]])
        axes[1].set_xlim(begin, begin + ZOOM_S)
        if np.isfinite(both).any():
            spare = 0.1 * float(np.ptp(both[np.isfinite(both)])) + 1e-9
            axes[1].set_ylim(np.nanmin(both) - spare, np.nanmax(both) + spare)
        for value, colour in ((true, style.COLOURS[0]), (guess, style.COLOURS[1])):
            axes[1].plot(time[rows], value[rows], ".", color=colour, markersize=3, label="_rows")
        straight = "lines between them are straight" if exact is None else "the truth between them is what the scenario states"
        axes[1].set_title(
            f"where that estimate is worst after the start; points are rows of the log, {straight}", loc="right", fontsize=7
        )
        _bands(axes[2], drawn, guess - true, guess - true, guess - true)
        axes[2].set_ylabel("error [" + label.partition("[")[2])
        style.focus(axes[2], time, guess - true, guess - true)
        axes[0].set_xlim(drawn.instants[0], drawn.instants[-1])
        return _finished(figure, axes, drawn)

    figure_of.__doc__ = f"True {quantity} and its estimate of one unit; error of the estimate of all units."
    return figure_of


def _stated_fault(drawn: Drawn, name: str, time: Floats, recorded: Floats) -> tuple[Floats, Floats] | None:
    """Rate of a unit's force per mass [m/s3] as the faults of the scenario state it, every ``FAULT_S``.

    Rows of every second are too far apart for a sinusoid of 6 s. None where the unit has no such fault, or its log says otherwise.
    """
    train, _, unit = name.rpartition(".")
    stated = drawn.run.scenario.get("fault", ()) if drawn.known.trains else ()
    faults = [f for f in stated if (str(f["train"]), str(f["unit"])) == (train, unit) and f["kind"] != "effectiveness"]
    mass = drawn.known.mass_kg.get(train, ())
    if not faults or not unit.isdigit() or int(unit) > len(mass):
        return None

    def rate(at: Floats) -> Floats:
        total: Floats = np.zeros(len(at))
        for f in faults:
            on = (at >= f.get("start_s", 0.0)) & (at < f.get("end_s", np.inf))
            phase = f.get("omega_rad_per_s", 0.0) * at + f.get("phase_rad", 0.0)
            total += np.where(on, f["amplitude_n_per_s"] * np.cos(phase), 0.0) / mass[int(unit) - 1]
        return total

    some = np.isfinite(recorded)
    if not some.any() or not np.allclose(rate(time[some]), recorded[some], rtol=1e-6, atol=1e-6):
        return None
    time = time[some]
    at = np.union1d(np.arange(time[0], time[-1], FAULT_S), time)
    return at, rate(at)


def _worst_after_start(time: Floats, error: Floats) -> float:
    """When the error is largest, the first 20 s left out [s]."""
    size = np.where(np.isfinite(error) & (time > time[0] + 20.0), np.abs(error), -1.0)
    return float(time[int(np.argmax(size))])


def _bands(panel: Axes, drawn: Drawn, value: Floats, low: Floats, high: Floats) -> None:
    """Lines in the colour of their train, lighter for later units, with their extremes as a shade; trains in the legend."""
    time, shown = drawn.units.column("time_s"), set()
    labels = dict(zip(drawn.names, style.labels(drawn.names, "train "), strict=True))
    for name, rows in drawn.units.slices():
        if not np.isfinite(value[rows]).any():
            continue
        train, _, unit = name.rpartition(".")
        colour = drawn.colour[train]
        label = labels[train] if train not in shown else f"_{name}"
        shown.add(train)
        if np.any(low[rows] < high[rows]):
            (x, minimum), (_, maximum) = _floor(time[rows], low[rows], -1.0), _floor(time[rows], high[rows], 1.0)
            panel.fill_between(x, minimum, maximum, color=colour, alpha=0.18, linewidth=0)
        alpha = max(1.0 - 0.15 * (int(unit) - 1), 0.4) if unit.isdigit() else 1.0
        style.draw(panel, time[rows], value[rows], color=colour, label=label, alpha=alpha, linewidth=0.8)


def _floor(x: Floats, y: Floats, sign: float) -> tuple[Floats, Floats]:
    """The maximum (or minimum) of each of equal stretches, for shading long logs."""
    stretches = max(len(x) // style.POINTS, 1)
    starts = np.arange(0, len(x), stretches)
    filled = np.where(np.isfinite(y), sign * y, -np.inf)
    extreme = sign * np.maximum.reduceat(filled, starts)
    return x[starts], np.where(np.isfinite(extreme), extreme, np.nan)


def _over_time(drawn: Drawn, column: str, label: str, scale: float, derivative: int) -> Figure:
    figure, axes = style.panels(1, drawn.width, 52.0)
    value = drawn.units.column(column) / scale
    _bands(axes[0], drawn, value, value, value)
    if drawn.known.reference is not None:
        instants = drawn.instants
        reference = leader_over(drawn.known.reference, instants)[derivative] / scale
        style.draw(axes[0], instants, reference, color="black", linestyle=":", label="reference", zorder=3)
    axes[0].set_ylabel(label)
    return _finished(figure, axes, drawn)


def _between_trains(panel: Axes, drawn: Drawn, column: str, scale: float) -> None:
    """Rear unit of the train ahead minus leading unit, for every link between them."""
    rows = dict(drawn.units.slices())
    tails: dict[str, str] = {name.rpartition(".")[0]: name for name in rows}  # units are in order: the last one stays
    value, time = drawn.units.column(column), drawn.units.column("time_s")
    count, palette = len(drawn.names), style.COLOURS
    for k, (ahead, behind) in enumerate(drawn.links.ends):
        if ahead in tails and f"{behind}.1" in rows:
            tail, head = rows[tails[ahead]], rows[f"{behind}.1"]
            _, a, b = np.intersect1d(time[tail], time[head], return_indices=True)
            difference = (value[tail][a] - value[head][b]) / scale
            colour = palette[(count + k) % len(palette)]  # not those of the trains, which stand for their units
            style.draw(panel, time[head][b], difference, color=colour, label=f"trains {ahead}-{behind}")


def _between_units(panel: Axes, drawn: Drawn, column: str) -> None:
    """Each unit minus the next one of its train."""
    difference = np.full(len(drawn.units), np.nan)
    value, parts = drawn.units.column(column), drawn.units.slices()
    for (name, rows), (after, behind) in pairwise(parts):
        if name.rpartition(".")[0] == after.rpartition(".")[0] and rows.stop - rows.start == behind.stop - behind.start:
            difference[rows] = value[rows] - value[behind]
    _bands(panel, drawn, difference, difference, difference)
    style.focus(panel, drawn.units.column("time_s"), difference, difference)


def _finished(figure: Figure, axes: list[Axes], drawn: Drawn) -> Figure:
    style.time_axis(axes, drawn.instants[0], drawn.instants[-1], drawn.clock)
    mark_events(axes, drawn)
    style.name_lines(figure, drawn.width)
    return figure
