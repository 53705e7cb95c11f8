"""Which figures belong to a run, under which names, and writing them.

A run under a published law gets that paper's figures under their numbers (``fig3_positions.png``); whatever else applies comes
under its plain name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from trainctl.errors import InputError
from trainctl.figures import style, trains, units
from trainctl.figures.trains import Drawn, comparison, drawable
from trainctl.laws import shipped
from trainctl.runs.run import Run

__all__ = ["FIGURES", "applicable", "comparison", "figure", "plot"]

FORMATS = ("png", "svg", "pdf")

#: Every figure: name -> function of a drawable run.
FIGURES: dict[str, Callable[[Drawn], Figure]] = {
    "train_graph": trains.train_graph,
    "positions": trains.positions,
    "spacing": trains.spacings,
    "spacing_errors": trains.spacing_errors,
    "speeds": trains.speeds,
    "inputs": trains.inputs,
    "speeds_and_inputs": trains.speeds_and_inputs,
    "speed_over_position": trains.speed_over_position,
    "gaps": trains.gaps,
    "couplers": units.couplers,
    "coupler_forces": units.coupler_forces,
    "unit_forces": units.unit_forces,
    "unit_positions": units.positions,
    "unit_speeds": units.speeds,
    "position_differences": units.position_differences,
    "speed_differences": units.speed_differences,
    "unit_differences": units.unit_differences,
    "fault_estimates": units.estimates("fault", r"fault [m/s$^3$]"),
    "acceleration_estimates": units.estimates("acceleration", r"acceleration [m/s$^2$]"),
}

GENERIC = ("train_graph", "positions", "spacing", "spacing_errors", "speeds", "inputs")
OF_UNITS = ("couplers", "coupler_forces", "unit_forces")


def applicable(drawn: Drawn) -> dict[str, str]:
    """Figures of a run -> their file names without ending."""
    law = shipped(drawn.known.law)
    paper: dict[str, str] = getattr(law, "FIGURES", {})
    numbered = law.numbered(drawn.known.controller, drawn.known.observer) if hasattr(law, "numbered") else paper
    wanted = [*numbered, *(name for name in (*GENERIC, *OF_UNITS, *paper) if name not in numbered)]
    if "speeds_and_inputs" in numbered:
        wanted = [name for name in wanted if name not in ("speeds", "inputs")]
    names = {}
    for name in wanted:
        if _has(drawn, name):
            number = numbered.get(name)
            names[name] = f"{number}_{name}" if number else name
    return names


def _has(drawn: Drawn, name: str) -> bool:
    """Whether the log has what a figure shows."""
    if not drawn.trains.names:
        return False
    if name in ("spacing", "spacing_errors"):
        return bool(drawn.links.names)
    if name == "gaps":
        return bool(np.isfinite(drawn.trains.column("gap_m")).any())
    if name.endswith("_estimates"):
        columns = {"fault_estimates": "fault_estimate_mps3", "acceleration_estimates": "acceleration_estimate_mps2"}
        return columns[name] in drawn.units.frame.columns and bool(np.isfinite(drawn.units.column(columns[name])).any())
    if name in ("couplers", "coupler_forces", "unit_differences"):
        return bool(drawn.units.names) and bool(np.isfinite(drawn.units.column("coupler_m")).any())
    if name.startswith("unit_") or name.endswith("_differences"):
        return bool(drawn.units.names)
    return True


def figure(run: Run, name: str, width: str = "double") -> Figure:
    """One figure of a run by its plain name, see ``FIGURES``.

    Parameters
    ----------
    run : Run
        A run folder.
    name : str
        A key of ``FIGURES``.
    width : str
        "single" (85 mm, a column) or "double" (178 mm, a page).
    """
    if name not in FIGURES:
        raise InputError(f"figure {name}: not known; there are: {', '.join(FIGURES)}")
    with style.styled():
        drawn = drawable(run, width)
        if not _has(drawn, name):
            raise InputError(f"{run.folder}: nothing recorded for figure {name}")
        return FIGURES[name](drawn)


def plot(run: Run, out_dir: Path | str, formats: Sequence[str] = ("png",), width: str = "double") -> list[Path]:
    """Write every figure that applies to a run; returns the files.

    Parameters
    ----------
    run : Run
        A run folder.
    out_dir : Path
        Where to; made if it does not exist.
    formats : sequence of str
        Any of png, svg, pdf.
    width : str
        "single" (85 mm) or "double" (178 mm).
    """
    unknown = [kind for kind in formats if kind not in FORMATS]
    if unknown:
        raise InputError(f"format {', '.join(unknown)}: not known; there are: {', '.join(FORMATS)}")
    if width not in style.WIDTHS_MM:
        raise InputError(f"width {width}: not known; there are: {', '.join(style.WIDTHS_MM)}")
    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    written = []
    with style.styled():
        drawn = drawable(run, width)
        for name, file in applicable(drawn).items():
            written += style.save(FIGURES[name](drawn), out / file, formats)
    return written
