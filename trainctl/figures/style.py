"""One style for all figures: colour-blind-safe, units on the axes, bounds dashed, legend outside the data, readable in print."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from trainctl.signals import Floats

#: Okabe and Ito's colours, the ones that read well on white first.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C7A00")
GREY = "#777777"
#: Line style per track, in the order of their names.
TRACK_STYLES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1.2, 1.2)), (0, (5, 1.5, 1.2, 1.5)))

#: Column width and double width of a page in print [mm].
WIDTHS_MM = {"single": 85.0, "double": 178.0}
#: Points drawn per line at most; beyond, each stretch is drawn by its minimum and maximum value.
POINTS = 2000
CROWD = 50  # lines
#: A start so many times as large as the rest is left to the title of its panel.
FOCUS = 3.0
#: More lines than this are coloured by a scale, and only some of them named.
NAMED = len(COLOURS)

#: Resolution of bitmaps [1/inch].
DPI = 300

SETTINGS: Any = {
    "font.size": 8.0, "axes.labelsize": 8.0, "axes.titlesize": 8.0, "legend.fontsize": 7.0, "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0, "lines.linewidth": 1.0, "axes.linewidth": 0.6, "axes.grid": True, "grid.linewidth": 0.3,
    "grid.color": "#cccccc", "axes.axisbelow": True, "axes.spines.top": False, "axes.spines.right": False,
    "axes.formatter.useoffset": False, "svg.hashsalt": "trainctl", "svg.fonttype": "none", "pdf.fonttype": 42,
}  # fmt: skip


@contextmanager
def styled() -> Iterator[None]:
    """Matplotlib's settings are ours inside and as before outside."""
    with matplotlib.rc_context(SETTINGS):
        yield


def panels(rows: int, width: str, height_mm: float = 42.0, **options: Any) -> tuple[Figure, list[Axes]]:
    """Make a figure of ``rows`` panels one above the other that share the horizontal axis."""
    millimetre = 1 / 25.4
    figure = Figure(figsize=(WIDTHS_MM[width] * millimetre, (rows * height_mm + 14.0) * millimetre), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, 1, sharex=options.pop("sharex", True), squeeze=False, **options)
    return figure, list(axes[:, 0])


def legend(figure: Figure, width: str, handles: Sequence[Any] | None = None) -> None:
    """Put one legend above all panels, each label once."""
    if handles is None:
        found = [handle for axes in figure.axes for handle in axes.get_legend_handles_labels()[0]]
        handles = list({str(handle.get_label()): handle for handle in found}.values())
        handles.sort(key=_order)
    if not handles:
        return
    longest = max(len(str(handle.get_label())) for handle in handles)
    points = WIDTHS_MM[width] / 25.4 * 72  # of the whole width; an entry takes about 26 and 3.9 per letter
    columns = int(np.clip(0.95 * points // (3.9 * longest + 26), 1, len(handles)))
    columns = -(-len(handles) // -(-len(handles) // columns))  # rows of about the same length
    figure.legend(
        handles=handles, loc="outside upper center", ncols=columns, frameon=False, handlelength=1.8, columnspacing=1.2,
    )  # fmt: skip


def _order(handle: Any) -> list[tuple[int, int, str]]:
    """Lines by name, numbers by size, then what belongs to all lines."""
    label = str(handle.get_label())
    parts = re.findall(r"\d+|\D+", label)
    common = label in ("desired", "reference", "cruising speed", "bound", "limit", "minimum allowed")
    return [(int(common), 0, ""), *((0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts)]


def weights(count: int) -> list[float]:
    """Line widths, the first ones wide: where lines lie on each other, the wide ones show behind the thin ones."""
    return list(np.linspace(2.0, 0.8, count)) if 1 < count <= NAMED else [0.8] * count


def colours(count: int) -> list[Any]:
    """Colours of ``count`` lines: distinct ones, or a scale if there are many."""
    if count <= NAMED:
        return list(COLOURS[:count])
    return list(matplotlib.colormaps["cividis"](np.linspace(0.0, 0.92, count)))


def labels(names: Sequence[str], what: str = "") -> list[str]:
    """Labels of lines; of many only some are named (the others begin with an underscore, which legends leave out)."""
    stride = max(1, -(-len(names) // NAMED))
    return [f"{what}{name}" if k % stride == 0 else f"_{name}" for k, name in enumerate(names)]


def draw(axes: Axes, x: Floats, y: Floats, **options: Any) -> None:
    """Draw a line, broken where the log has gaps, and downsampled so that every extreme stays."""
    points = POINTS if len(axes.lines) < CROWD else POINTS // 8  # no one tells single lines of a crowd apart
    x, y = envelope(*broken(np.asarray(x, float), np.asarray(y, float)), points)
    axes.plot(x, y, **options)


def broken(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """The line with a NaN in every gap: steps half as long again as the usual one."""
    if len(x) < 3:
        return x, y
    step = np.diff(x)
    gaps = np.flatnonzero(step > 1.5 * np.median(step)) + 1
    return np.insert(x, gaps, np.nan), np.insert(y, gaps, np.nan)


def envelope(x: Floats, y: Floats, points: int = POINTS) -> tuple[Floats, Floats]:
    """At most about ``points`` points of a line: of each of equal stretches the first, the minimum, the maximum and the last.

    Nothing is averaged, so a peak of a single row keeps its height and its place. A gap (NaN) stays a gap.
    """
    if len(x) <= points:
        return x, y
    edges = np.linspace(0, len(x), max(points // 4, 1) + 1).astype(int)
    starts, stops = edges[:-1], edges[1:] - 1
    keep = [starts, stops]
    for sign in (1.0, -1.0):
        value = np.where(np.isnan(y), np.inf, sign * y)
        minimum = np.repeat(np.minimum.reduceat(value, starts), np.diff(edges))
        hit = np.flatnonzero((value == minimum) & np.isfinite(value))
        keep.append(hit[np.unique(np.searchsorted(starts, hit, side="right"), return_index=True)[1]])
    keep.append(np.flatnonzero(np.isnan(y)))
    index = np.unique(np.concatenate(keep))
    return x[index], y[index]


def bound(axes: Axes, *values: float, label: str = "bound", **options: Any) -> None:
    """Dashed lines at the finite ones of some values."""
    for value in values:
        if np.isfinite(value):
            look: dict[str, Any] = {"color": GREY, "linestyle": (0, (5, 2)), "linewidth": 0.9, "label": label}
            axes.axhline(value, **(look | options))


def focus(axes: Axes, time: Floats, low: Floats, high: Floats, after_s: float = 20.0) -> None:
    """Scale a panel to what comes after the start if the start would hide it; how far the start goes then stands above.

    Parameters
    ----------
    axes : Axes
        The panel.
    time, low, high : ndarray, shape (k,)
        Time [s] and the minimum and maximum value drawn there.
    after_s : float
        Length of the start [s].
    """
    some = np.isfinite(low) & np.isfinite(high)
    time, low, high = time[some], low[some], high[some]
    later = time > time.min(initial=np.inf) + after_s
    if not later.any():
        return
    bottom, top = low[later].min(), high[later].max()
    if high.max() - low.min() <= FOCUS * (top - bottom) or top <= bottom:
        return
    spare = 0.12 * (top - bottom)
    axes.set_ylim(bottom - spare, top + spare)
    axes.set_title(f"beyond the scale in the first {after_s:g} s: {low.min():.4g} to {high.max():.4g}", loc="right", fontsize=7)


def room(axes: Axes, minimum: float) -> None:
    """Let the vertical axis span at least ``minimum``, so that rounding does not look like something."""
    low, high = axes.get_ylim()
    if high - low < minimum:
        middle = 0.5 * (low + high)
        axes.set_ylim(middle - 0.5 * minimum, middle + 0.5 * minimum)


def save(figure: Figure, path: Path, formats: Sequence[str]) -> list[Path]:
    """Write a figure as ``<path>.<format>`` for each format; the same figure gives the same bytes."""
    undated = {"png": {"Software": None}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}
    written = []
    for kind in formats:
        target = path.with_name(f"{path.name}.{kind}")
        with styled():
            figure.savefig(target, dpi=DPI, metadata=undated.get(kind))
        written.append(target)
    return written
