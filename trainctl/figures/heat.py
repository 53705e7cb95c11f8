"""The figure of a sweep over two settings: one map per quantity, each cell the runs of one pair of values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize, TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from trainctl.figures import style
from trainctl.signals import Bools, Floats

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

#: Maps side by side.
ACROSS = 3
#: Cells of one map at most that have their numbers in them, and values on an axis that all have their ticks.
NUMBERED, TICKS = 64, 9
#: Values that differ by less are one value.
ROUNDING = 1e-6
#: How cells without a value are told apart: of no complete run, of runs of which most did not settle.
EMPTY, NEVER = "no complete run", "most runs not settled"


def two_settings(done: pd.DataFrame, parameters: Sequence[str]) -> tuple[str, str] | None:
    """The two settings of a sweep that are numbers and vary, the one across first; None if there are not just two."""
    found = [k for k in parameters if k != "run.seed" and done[k].dtype.kind in "if" and done[k].nunique() > 1]
    return (found[0], found[1]) if len(found) == 2 else None


def heat(
    frame: pd.DataFrame, done: pd.DataFrame, axes_of: tuple[str, str], shown: dict[str, str], never: dict[str, Bools], title: str
) -> Figure:
    """One map per quantity: the median of the runs of every pair of settings.

    Parameters
    ----------
    frame, done : DataFrame
        All runs, and the complete ones.
    axes_of : tuple of str
        The settings across and upwards.
    shown : dict
        Column -> label of the quantities.
    never : dict
        Column -> which of the complete runs never had a value because they did not settle.
    title : str
        How many runs there are.
    """
    across, up = (np.unique(frame[key].to_numpy(float)) for key in axes_of)
    cell = np.searchsorted(up, done[axes_of[1]]) * len(across) + np.searchsorted(across, done[axes_of[0]])
    shape, runs = (len(up), len(across)), np.bincount(cell, minlength=len(up) * len(across))
    maps: list[tuple[str, Floats, Bools]] = []
    violated = (done["violations"].to_numpy(float) > 0).astype(float)
    maps.append(
        ("share of runs that\nviolate a bound", _cells(violated, cell, runs, np.mean).reshape(shape), np.zeros(shape, bool))
    )
    for key, label in shown.items():
        value, late = done[key].to_numpy(float), never.get(key, np.zeros(len(done), bool))
        median = _cells(np.where(late, np.inf, value), cell, runs, _median)  # who did not settle is later than all who did
        maps.append((label, np.where(np.isinf(median), np.nan, median).reshape(shape), np.isinf(median).reshape(shape)))
    wide = min(ACROSS, len(maps))
    down = -(-len(maps) // wide)
    millimetre = 1 / 25.4
    height = down * float(np.clip(14.0 + 7.0 * len(up), 38.0, 70.0)) + 16.0
    figure = Figure(figsize=(style.WIDTHS_MM["double"] * millimetre, height * millimetre), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(down, wide, sharex=True, sharey=True, squeeze=False)
    for panel, (label, value, late) in zip(grid.flat, maps, strict=False):
        _map(panel, value, late, across, up, label)
    for panel in list(grid.flat)[len(maps) :]:
        panel.remove()
    for k, panel in enumerate(list(grid.flat)[: len(maps)]):
        if k % wide == 0:
            panel.set_ylabel(axes_of[1])
        if k + wide >= len(maps):
            panel.set_xlabel(axes_of[0])
            panel.tick_params(labelbottom=True)
    counts = sorted({int(runs[runs > 0].min()), int(runs.max())})
    each = "" if counts == [1] else f"; median of {' to '.join(map(str, counts))} runs per cell"
    figure.supxlabel(f"{title}{each}", x=0.01, ha="left", fontsize=7)
    blank = [(EMPTY, "///", bool((runs == 0).any())), (NEVER, "xxx", any(late.any() for _, _, late in maps))]
    style.legend(
        figure, "double", [Patch(facecolor="white", edgecolor=style.GREY, hatch=h, label=w) for w, h, some in blank if some]
    )
    return figure


def _median(values: Floats) -> float:
    """The middle value, the later one of two; NaN if there is none."""
    values = np.sort(values[~np.isnan(values)])
    return float(values[len(values) // 2]) if len(values) else float("nan")


def _cells(value: Floats, cell: Any, runs: Any, gather: Callable[[Floats], Any]) -> Floats:
    """One number per cell, NaN where no run is complete."""
    return np.array([gather(value[cell == k]) if count else np.nan for k, count in enumerate(runs)], dtype=np.float64)


def _map(panel: Axes, value: Floats, late: Bools, across: Floats, up: Floats, label: str) -> None:
    """One map with its colour bar; margins to bounds are red where a bound is violated."""
    value = np.where(np.abs(value) < ROUNDING, 0.0, value)
    some = value[np.isfinite(value)]
    low, high = (float(some.min()), float(some.max())) if len(some) else (0.0, 1.0)
    if label.startswith("share"):
        colours, norm = "Reds", Normalize(0.0, 1.0)
    elif label.startswith("room") and low < 0.0:
        reach = max(-low, high)
        colours, norm = "RdBu", TwoSlopeNorm(0.0, -reach, reach)
    else:
        colours, norm = "cividis", Normalize(low, high)
    if high - low < ROUNDING and not label.startswith("share"):  # one value: no scale
        colours, norm = ("RdBu", Normalize(-1.0, 1.0)) if low < 0.0 else ("Greys", Normalize(low - 0.2, low + 1.0))
    drawn = panel.pcolormesh(np.arange(len(across) + 1), np.arange(len(up) + 1), value, cmap=colours, norm=norm)
    for (j, k), number in np.ndenumerate(value):
        if not np.isfinite(number):
            panel.add_patch(matplotlib.patches.Rectangle(
                (k, j), 1, 1, facecolor="white", edgecolor=style.GREY, linewidth=0, hatch="xxx" if late[j, k] else "///"
            ))  # fmt: skip
        elif value.size <= NUMBERED:
            shade = np.array(drawn.cmap(norm(number)))[:3] @ (0.299, 0.587, 0.114)
            words = f"{number:.0f}" if abs(number) >= 1e3 else f"{number:.3g}"
            colour, size = "white" if shade < 0.5 else "black", 6 if len(across) <= 6 else 5
            panel.text(k + 0.5, j + 0.5, words, ha="center", va="center", fontsize=size, color=colour)
    panel.set_xticks(*_ticks(across))
    panel.set_yticks(*_ticks(up))
    panel.grid(False)
    panel.set_title(label.replace("\n", " "), loc="left", fontsize=7)
    if len(some) and (high - low >= ROUNDING or label.startswith("share")):
        bar = panel.figure.colorbar(drawn, ax=panel, pad=0.02, aspect=14)
        bar.ax.tick_params(labelsize=6)
        bar.outline.set_linewidth(0.4)


def _ticks(values: Floats) -> tuple[Any, list[str]]:
    """Places in the middle of cells, and what they are called; of many values every so many-th."""
    which = np.arange(0, len(values), -(-len(values) // TICKS))
    return which + 0.5, [f"{values[k]:g}" for k in which]
