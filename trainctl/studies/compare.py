"""Several runs side by side: one table, and figures with one panel per run on common axes.

``alternatives`` puts the other laws in front of the same traffic: trains, network, events, reference, bounds and links stay, the
law and what belongs to it (plant, observer, periods) changes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from trainctl.errors import InputError
from trainctl.figures import style
from trainctl.figures.trains import Drawn, draw_inputs, draw_speeds, drawable
from trainctl.laws import compared, find_plant, plants_of
from trainctl.metrics.run import DEFINITIONS, metrics
from trainctl.metrics.values import Values
from trainctl.runs.run import Run
from trainctl.signals import leader_over

#: Rows of the table, as far as they apply to any of the runs.
ROWS = (
    "bounds.broken", "bounds.spacing_lower_margin_m", "bounds.spacing_upper_margin_m", "bounds.speed_lower_margin_mps",
    "bounds.speed_upper_margin_mps", "bounds.input_lower_margin_mps2", "bounds.input_upper_margin_mps2",
    "bounds.coupler_lower_margin_m", "bounds.coupler_upper_margin_m", "bounds.first_violation_s", "formation.settling_s",
    "formation.last_link_s", "formation.final_error_m", "formation.overshoot_m",
    "formation.final_speed_error_mps", "formation.speed_overshoot_mps",
    "string.l2_gain", "units.force_min_n", "units.force_max_n", "units.coupler_stroke_m", "units.saturated_share",
    "energy.traction_kwh", "energy.net_kwh_per_train_km", "comfort.acceleration_max_mps2", "comfort.jerk_max_mps3",
    "comfort.jerk_rms_mps3", "traffic.gap_min_m", "traffic.headway_min_s", "traffic.trains_per_hour",
)  # fmt: skip

#: Panels per row of a figure.
COLUMNS = 3


def table(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """One row per metric: ``metric, unit, values`` (one per run, None where it does not apply)."""
    columns = [_values(run) for run in runs]
    return [
        {"metric": name, "unit": DEFINITIONS.get(name, ("", ""))[0], "values": [column.get(name) for column in columns]}
        for name in ROWS if any(name in column for column in columns)
    ]  # fmt: skip


def _values(run: Run) -> Values:
    return run.metrics if (run.folder / "metrics.json").exists() else metrics(run)


def names(runs: Sequence[Run]) -> list[str]:
    """A name per run: its folder's, with as much of the path as tells them apart."""
    for depth in range(1, 5):
        found = ["/".join(run.folder.resolve().parts[-depth:]) for run in runs]
        if len(set(found)) == len(found):
            return found
    return [f"{k + 1}: {run.folder.name}" for k, run in enumerate(runs)]


def figures(runs: Sequence[Run], labels: Sequence[str], out: Path, formats: Sequence[str] = ("png",)) -> list[Path]:
    """Write ``compare_<what>`` for speeds, inputs, spacing errors and positions relative to the reference."""
    out.mkdir(parents=True, exist_ok=True)
    written = []
    with style.styled():
        drawn = [drawable(run) for run in runs]
        if not any(one.trains.names for one in drawn):
            raise InputError("compare: no train was recorded in any of the runs")
        for name, paint in PANELS.items():
            figure = side_by_side(drawn, labels, paint)
            if name == "spacing_errors":
                for axes in figure.axes:
                    style.logarithmic(axes)
                    axes.set_ylim(bottom=1e-3)
            written += style.save(figure, out / f"compare_{name}", formats)
    return written


def side_by_side(drawn: Sequence[Drawn], labels: Sequence[str], paint: Callable[[Axes, Drawn], None]) -> Figure:
    """One panel per run with common axes, at most three in a row."""
    across = min(COLUMNS, len(drawn))
    down = -(-len(drawn) // across)
    millimetre = 1 / 25.4
    figure = Figure(figsize=(style.WIDTHS_MM["double"] * millimetre, (down * 48.0 + 14.0) * millimetre), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False)
    for k, (axes, one, label) in enumerate(zip(grid.flat, drawn, labels, strict=False)):
        paint(axes, one)
        axes.set_title(label.replace("_", " "), loc="left")
        if k % across:
            axes.set_ylabel("")
        if k + across >= len(drawn):  # the lowest of its column
            axes.set_xlabel("time [s]")
            axes.tick_params(labelbottom=True)
    for axes in list(grid.flat)[len(drawn) :]:
        axes.remove()
    if len({len(one.names) for one in drawn}) > 1:  # a train has not the same colour in all panels: only what all have in common
        found = [handle for axes in figure.axes for handle in axes.get_legend_handles_labels()[0]]
        common = {str(handle.get_label()): handle for handle in found if str(handle.get_label()) in style.COMMON}
        style.legend(figure, "double", list(common.values()))
    else:
        style.legend(figure, "double")
    return figure


def _relative(axes: Axes, drawn: Drawn) -> None:
    time, position = drawn.trains.column("time_s"), drawn.trains.column("position_m")
    reference = drawn.known.reference
    for (name, rows), label in zip(drawn.trains.slices(), style.labels(drawn.trains.names, "train "), strict=True):
        at = 0.0 if reference is None else leader_over(reference, time[rows])[0]
        style.draw(axes, time[rows], (position[rows] - at) / 1000, label=label, **drawn.look[name])
    axes.set_ylabel("position [km]" if reference is None else r"$x_i - x_r$ [km]")


def _errors(axes: Axes, drawn: Drawn) -> None:
    links = drawn.links
    looks = zip(links.slices(), style.colours(len(links.names)), style.labels(links.names, "link "), strict=True)
    for (_, rows), colour, label in looks:
        style.draw(axes, links.column("time_s")[rows], np.abs(links.column("error_m")[rows]).clip(1e-4), color=colour, label=label)
    if not links.names:
        axes.text(0.5, 0.5, "no links", transform=axes.transAxes, ha="center", color=style.GREY)
    axes.set_ylabel(r"$|x_{ij} - d_{ij}|$ [m]")


PANELS: dict[str, Callable[[Axes, Drawn], None]] = {
    "positions": _relative, "spacing_errors": _errors, "speeds": draw_speeds, "inputs": draw_inputs,
}  # fmt: skip


# --- the other laws on the same traffic -------------------------------------------------------------------------------------------


def alternatives(data: Mapping[str, Any], known: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The scenario under every law that there is.

    Parameters
    ----------
    data : mapping
        Tables of the scenario as they stand.
    known : sequence of str
        Names of the laws there are.

    Returns
    -------
    dict
        Name of the row -> tables of its scenario. Keys of the laws' own that have a counterpart in the scenario's bounds are
        derived from it; all others are the law's defaults (the paper's).
    """
    name = str(data["controller"]["law"])
    return {
        row: dict(data) if name == _name(law) and row == _row(law, data["controller"]) else _under(row, law, data)
        for row, law in compared().items() if _name(law) in known
    }  # fmt: skip


def _name(law: Any) -> str:
    """How a scenario names a law of ours."""
    return str(law.__name__).rpartition(".")[2]


def _row(law: Any, controller: Mapping[str, Any]) -> str:
    """The row of its law a scenario is as it stands: the last whose keys it has, else the first."""
    rows: dict[str, dict[str, Any]] = law.COMPARED
    fitting = [row for row, keys in rows.items() if all(controller.get(key) == value for key, value in keys.items())]
    return (fitting or list(rows))[-1 if fitting else 0]


def _under(row: str, law: Any, data: Mapping[str, Any]) -> dict[str, Any]:
    """The scenario under another law, on a plant the law runs on where there is one of the same sort."""
    changed: dict[str, Any] = {key: value for key, value in data.items() if key not in ("controller", "observer")}
    changed["title"] = f"{row.replace('_', ' ')} on the traffic of: {data.get('title', '')}"
    changed["run"] = {"step_s": 1.0, **{key: value for key, value in data["run"].items() if key != "control_period_s"}}
    changed["topology"] = dict(data.get("topology", {}))
    changed["controller"] = {"law": _name(law), **law.COMPARED[row]}
    plant = {"kind": "point", **data.get("plant", {})}
    module, usual = find_plant(str(plant["kind"])), plants_of(law)
    if plant["kind"] not in usual:
        plant = next(({"kind": kind} for kind in usual if find_plant(kind).UNITS == module.UNITS), plant)
    if getattr(law, "CLAMPED", False):  # its model clamps, where the plant can do so by itself it does
        clamps = find_plant(str(plant["kind"])).CLAMPS
        plant |= {key: value for key, value in data.get("bounds", {}).items() if key in clamps}
    changed["plant"] = plant
    return {**changed, **(law.alternative(changed) if hasattr(law, "alternative") else {})}
