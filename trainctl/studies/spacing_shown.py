"""The smallest safe spacings as a table for people, for LaTeX, and as a figure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from trainctl.studies.compare import escaped
from trainctl.studies.results import percents
from trainctl.studies.stops import REFUSED, StopsPlan, reference_lines

#: Columns of the printed table -> keys.
COLUMNS = {
    "row": "row", "spacing [m]": "spacing_m", "just below": "below", "failed of all at 95 / 100 / 105 / 110 %": "failed",
    "of as many others": "others",
    "headway [s]": "headway_s", "trains/h": "trains_per_hour", "journey [s]": "journey_time_s", "kWh/km": "energy_kwh_per_train_km",
    "jerk [m/s3]": "jerk_rms_mps3", "string gain": "string_gain", "messages/s": "messages_per_train_s",
    "law [ms]": "law_ms_per_train",
}  # fmt: skip


def cells(row: Mapping[str, Any]) -> list[Any]:
    """The values of a row in the order of ``COLUMNS``; a spacing that was not found says why not."""
    failed = " / ".join(_share(point) for point in row["checked"]) or None
    words = f"none: {row['below']}" if row["spacing_m"] is None else row["spacing_m"]
    others = _interval(row["others"]) if row["others"] else None
    shown = {**row, "others": others, "row": row["row"].replace("_", " "), "failed": failed, "spacing_m": words}
    shown["below"] = None if row["spacing_m"] is None else row["below"]
    return [shown[key] for key in COLUMNS.values()]


def _interval(point: Mapping[str, Any]) -> str:
    return f"{point['failed']} of {point['of']} ({percents(point['interval_95'])})"


def _share(point: Mapping[str, Any]) -> str:
    return REFUSED if point["what"] == REFUSED else f"{point['failed']} of {point['of']}"


def reasons(table: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line for each row: what its trains are told, with which gains, and what kept it from a smaller spacing."""
    found = []
    for row in table:
        keys = ", ".join(f"{key} = {_number(value)}" for key, value in row["keys"].items() if value is not None)
        why = f" {row['why'].rstrip('.')}." if row["why"] else ""
        found.append(f"{row['row'].replace('_', ' ')}: {row['told']}.{why} ({keys})")
    return found


def sumo_lines(table: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line for each row that was run in SUMO as well: how many stops failed at 95 % of its spacing, at it, and of the others."""
    found = []
    for row in table:
        if row["in_sumo"]:
            below, at, others = row["in_sumo"]
            words = f"{_share(below)} at 95 %, {_share(at)} at it; of others {_interval(others)}"
            found.append(f"{row['row'].replace('_', ' ')} in SUMO: failed {words}")
    return found


def _number(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def latex(table: Sequence[Mapping[str, Any]], plan: StopsPlan) -> str:
    """The table as a ``tabular`` of booktabs, a dash where there is nothing."""
    last = len(COLUMNS) - 1
    rows = [[escaped("--" if cell is None else _number(cell)) for cell in cells(row)] for row in table]
    lines = [[f"{name} braking distance", f"{value:.4g}", *[""] * (last - 1)] for name, value in reference_lines(plan).items()]
    blocks = ([[*map(escaped, COLUMNS)]], rows, lines)
    body = "\n\\midrule\n".join("\n".join(" & ".join(row) + r" \\" for row in block) for block in blocks)
    return f"% \\usepackage{{booktabs}}\n\\begin{{tabular}}{{l{'r' * last}}}\n\\toprule\n{body}\n\\bottomrule\n\\end{{tabular}}\n"


def figure(table: Sequence[Mapping[str, Any]], plan: StopsPlan, path: Path, formats: Sequence[str] = ("png",)) -> list[Path]:
    """Every spacing that was looked at, by what came of it, and the smallest safe one; dashed the two braking distances."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from trainctl.figures import style

    marks = {"safe": ("o", style.COLOURS[2]), "unsafe": ("x", style.COLOURS[1]), "refused": ("s", style.GREY)}
    with style.styled():
        drawn = Figure(figsize=(style.WIDTHS_MM["double"] / 25.4, (8.0 * len(table) + 26.0) / 25.4), layout="constrained")
        FigureCanvasAgg(drawn)
        axes = drawn.subplots()
        for place, row in enumerate(table):
            looked = [*row["points"], *row["checked"]]
            for what, (mark, colour) in marks.items():
                at = [point["spacing_m"] for point in looked if point["what"] == what]
                axes.plot(
                    at, np.full(len(at), place), mark, color=colour, markersize=3.5, label=what, linestyle="none", clip_on=False
                )
            if row["spacing_m"] is not None:
                axes.barh(
                    place, row["spacing_m"] - axes_begin(plan), left=axes_begin(plan), height=0.6, color=style.COLOURS[5], alpha=0.4
                )
                axes.annotate(
                    f"{row['spacing_m']:.4g} m, {row['headway_s']:.3g} s", (row["spacing_m"], place), xytext=(6, 6),
                    textcoords="offset points", fontsize=6.0,
                )  # fmt: skip
            else:
                axes.annotate(
                    f"none: {row['below']}", (axes_begin(plan), place), xytext=(4, 6), textcoords="offset points", fontsize=6.0
                )
        for dashes, (name, value) in zip(((5, 1.5), (1.2, 1.2)), reference_lines(plan).items(), strict=True):
            axes.axvline(value, color="black", linewidth=0.8, linestyle=(0, dashes), label=f"{name} braking distance")
        axes.set_xscale("log")
        axes.set_xlim(axes_begin(plan), plan.to_m * 1.05)
        ticks = [
            t for t in (250.0, 500.0, 1000.0, 2000.0, 4000.0, 8000.0, 16_000.0, 32_000.0) if axes_begin(plan) <= t <= plan.to_m
        ]
        axes.set_xticks(ticks, [f"{t / 1000.0:g}" for t in ticks])
        axes.minorticks_off()
        axes.set_xlabel("desired spacing, front to front [km]")
        axes.set_yticks(range(len(table)), [row["row"].replace("_", " ") for row in table])
        axes.set_ylim(len(table) - 0.4, -0.6)
        axes.grid(visible=False, axis="y")
        style.legend(drawn, "double")
        return style.save(drawn, path, formats)


def axes_begin(plan: StopsPlan) -> float:
    """Where the axis of spacings begins [m]."""
    return math.floor(plan.from_m * 0.95)
