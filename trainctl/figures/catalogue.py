"""Which figures belong to a run, under which names, and writing them.

The example of a paper gets that paper's figures under their numbers (``fig3_positions.png``); other runs under its law get the same
figures, and whatever else applies, under their plain names.
"""

from __future__ import annotations

import textwrap
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from trainctl.errors import InputError
from trainctl.figures import platforms, style, train_graph, trains, units
from trainctl.figures.trains import Drawn, comparison, drawable
from trainctl.laws import shipped
from trainctl.runs.run import Run
from trainctl.scenario import reading

__all__ = ["FIGURES", "applicable", "comparison", "figure", "plot"]

#: Below these sizes couplers are at rest, and a figure of them would show rounding: column, and m or N.
ROUNDING = {"couplers": ("coupler_m", 1e-7), "coupler_forces": ("coupler_force_n", 1e-1)}

#: Tables of a scenario that make it a paper's example.
EXAMPLE = ("network", "reference", "topology", "link", "train_type", "train")

FORMATS = ("png", "svg", "pdf")

#: Every figure: name -> function of a drawable run.
FIGURES: dict[str, Callable[[Drawn], Figure]] = {
    "train_graph": train_graph.train_graph,
    "platforms": platforms.platforms,
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
    "fault_estimates": units.estimates("fault", "fault [m/s³]"),
    "acceleration_estimates": units.estimates("acceleration", "acceleration [m/s²]"),
}

GENERIC = ("train_graph", "platforms", "positions", "spacing", "spacing_errors", "speeds", "inputs")
OF_UNITS = ("couplers", "coupler_forces", "unit_forces")


def is_example(run: Run, law: str) -> bool:
    """Whether a run has line, trains, reference and links of its law's example in the paper: the shipped scenario of its name."""
    if law not in reading.shipped():
        return False
    scenario, _ = reading.examine(reading.read(law)[0])
    example = {} if scenario is None else tomllib.loads(scenario.toml())
    return all(run.scenario.get(key) == example.get(key) for key in EXAMPLE)


def applicable(drawn: Drawn) -> dict[str, str]:
    """Figures of a run -> their file names without ending; with the paper's numbers where the run is the paper's example."""
    law = shipped(drawn.known.law)
    paper: dict[str, str] = getattr(law, "FIGURES", {})
    numbered = law.numbered(drawn.known.controller, drawn.known.observer) if hasattr(law, "numbered") else paper
    own = is_example(drawn.run, drawn.known.law)
    wanted = [*numbered, *(name for name in (*GENERIC, *OF_UNITS, *paper) if name not in numbered)]
    if "speeds_and_inputs" in numbered:
        wanted = [name for name in wanted if name not in ("speeds", "inputs")]
    names = {}
    for name in wanted:
        if _has(drawn, name):
            number = numbered.get(name) if own else None
            names[name] = f"{number}_{name}" if number else name
    return names


def _has(drawn: Drawn, name: str) -> bool:
    """Whether the log has what a figure shows."""
    if not drawn.trains.names:
        return False
    if name == "platforms":
        return len(drawn.run.stops) > 0 and bool(drawn.run.stops["arrival_s"].notna().any())
    if name in ("spacing", "spacing_errors"):
        return bool(drawn.links.names)
    if name == "gaps":
        return bool(np.isfinite(drawn.trains.column("gap_m")).any())
    if name.endswith("_estimates"):
        columns = {"fault_estimates": "fault_estimate_mps3", "acceleration_estimates": "acceleration_estimate_mps2"}
        return columns[name] in drawn.units.numbers and bool(np.isfinite(drawn.units.column(columns[name])).any())
    if name in ("couplers", "coupler_forces", "unit_differences"):
        if not drawn.units.names or not np.isfinite(drawn.units.column("coupler_m")).any():
            return False
        column, rounding = ROUNDING.get(name, ("coupler_m", -1.0))
        return bool(np.nanmax(np.abs(drawn.units.column(column))) > rounding)
    if name.startswith("unit_") or name.endswith("_differences"):
        return bool(drawn.units.names)
    return True


def figure(run: Run, name: str, width: str = "double", *, clock: bool = False, kmh: bool = False, caption: bool = False) -> Figure:
    """One figure of a run by its plain name, see ``FIGURES``.

    Parameters
    ----------
    run : Run
        A run folder.
    name : str
        A key of ``FIGURES``.
    width : str
        "single" (85 mm, a column) or "double" (178 mm, a page).
    clock : bool
        Time in hours and minutes of the run.
    kmh : bool
        Speeds in km/h.
    caption : bool
        What the run is below the figure: title, law, version, seed.
    """
    if name not in FIGURES:
        raise InputError(f"figure {name}: not known; there are: {', '.join(FIGURES)}")
    with style.styled():
        drawn = drawable(run, width, clock, kmh)
        if not _has(drawn, name):
            raise InputError(f"{run.folder}: nothing recorded for figure {name}")
        return _captioned(FIGURES[name](drawn), drawn, caption)


def _captioned(figure: Figure, drawn: Drawn, wanted: bool) -> Figure:
    if wanted:
        words = textwrap.fill(drawn.origin, 150 if drawn.width == "double" else 70)
        figure.supxlabel(words, x=0.01, ha="left", fontsize=6, color=style.GREY)
    style.written_out(figure)
    return figure


def plot(
    run: Run,
    out_dir: Path | str,
    formats: Sequence[str] = ("png",),
    width: str = "double",
    *,
    clock: bool = False,
    kmh: bool = False,
    caption: bool = False,
) -> list[Path]:
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
    clock : bool
        Time in hours and minutes of the run.
    kmh : bool
        Speeds in km/h.
    caption : bool
        What the run is below the figure: title, law, version, seed.
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
        drawn = drawable(run, width, clock, kmh)
        for name, file in applicable(drawn).items():
            shown = _captioned(FIGURES[name](drawn), drawn, caption)
            written += style.save(shown, out / file, formats, f"{name} of {drawn.known.title or run.folder.name}", drawn.origin)
    return written
