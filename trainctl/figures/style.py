"""One style for all figures: colour-blind-safe, units on the axes, bounds dashed, legend outside the data, readable in print."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogFormatter, MultipleLocator

from trainctl.errors import visible
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

#: Labels that stand in the legend; all others stand beside their line.
COMMON = (
    "desired", "reference", "cruising speed", "bound", "limit", "minimum allowed", "median", "all bounds held", "a bound violated",
    "not settled",
)  # fmt: skip
#: Marks of lines at bounds and at events.
BOUND, EVENT = "bound", "event"
#: A bound farther from the data than so many times their range is left to the corner of the panel.
FAR = 1.5
#: Height of a line of small text, and letters of a name beside a panel.
LINE_POINTS, LETTERS = 8.4, 18
#: Ground of words on data.
PAPER: dict[str, Any] = {"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.8}
#: Steps of an axis in hours and minutes [s].
CLOCK_S = (30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400)

#: Metadata that differ from day to day or version to version, left out.
UNDATED = ("Software", "Date", "CreationDate")

#: Resolution of bitmaps [1/inch].
DPI = 300

SETTINGS: Any = {
    "font.size": 8.0, "axes.labelsize": 8.0, "axes.titlesize": 8.0, "legend.fontsize": 7.0, "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0, "lines.linewidth": 1.0, "axes.linewidth": 0.6, "axes.grid": True, "grid.linewidth": 0.3,
    "grid.color": "#cccccc", "axes.axisbelow": True, "axes.spines.top": False, "axes.spines.right": False,
    "axes.formatter.useoffset": False, "svg.hashsalt": "trainctl", "svg.fonttype": "none", "pdf.fonttype": 42,
    "text.parse_math": False,  # names are no formulas
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


def logarithmic(axes: Axes) -> None:
    """A logarithmic vertical axis; its numbers are plain text, as all words in a figure are."""
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(LogFormatter())
    axes.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.0, 0.4)))


def written_out(figure: Figure) -> None:
    """Show what steers a terminal in a name or a title as an escape."""
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        if visible(text.get_text()) != text.get_text():
            text.set_text(visible(text.get_text()))


def name_lines(figure: Figure, width: str) -> None:
    """Name the lines of every panel: trains and links beside their ends, what else there is in one legend above."""
    for line in (line for axes in figure.axes for line in axes.lines):
        line.set_label(visible(str(line.get_label())))
    shared: dict[str, Any] = {}
    for axes in figure.axes:
        fit(axes)
        beside = []
        for handle in axes.get_legend_handles_labels()[0]:
            if _is_common(str(handle.get_label())):
                shared.setdefault(str(handle.get_label()), handle)
            elif isinstance(handle, Line2D):
                beside.append(handle)
        _beside(axes, beside)
    legend(figure, width, sorted(shared.values(), key=_order))


def _beside(axes: Axes, lines: Sequence[Line2D]) -> None:
    """Labels right of a panel, each as near to the end of its line as the others let it, in its colour."""
    ends = []
    for label, line in {str(line.get_label()): line for line in lines}.items():
        parts = [part.get_data() for part in axes.lines if part.get_label() in (label, f"_{label}")]
        x, y = (np.concatenate([np.asarray(part[k], float) for part in parts]) for k in (0, 1))
        if (some := np.isfinite(x) & np.isfinite(y)).any():
            k = int(np.argmax(np.where(some, x, -np.inf)))
            share = axes.transAxes.inverted().transform(axes.transData.transform((x[k], y[k])))[1]
            ends.append((round(float(np.clip(share, 0.0, 1.0)), 2), label, line.get_color()))
    ends.sort(key=lambda end: (end[0], [-value for _, value, _ in _order_of(end[1])]))
    for place, (_, label, colour) in zip(spread([end[0] for end in ends], line_share(axes)), ends, strict=True):
        axes.annotate(
            label if len(label) <= LETTERS else f"{label[: LETTERS - 1]}…", (1.0, place), xycoords="axes fraction", xytext=(4, 0),
            textcoords="offset points", fontsize=7, va="center", color=colour, annotation_clip=False,
        )  # fmt: skip


def line_share(axes: Axes) -> float:
    """Height of a line of small text as a share of a panel's."""
    points: float = axes.get_window_extent().height * 72.0 / axes.figure.dpi
    return LINE_POINTS / points


def spread(places: Sequence[float], apart: float) -> list[float]:
    """Ascending places moved as little as needed, so that they stand ``apart`` within 0 to 1, or closer if they are too many."""
    apart = min(apart, 1.0 / max(len(places) - 1, 1))
    step = apart * np.arange(len(places))
    low = np.asarray(places, float) - step  # of evenly spaced ones all are equal
    up, down = np.maximum.accumulate(low), np.minimum.accumulate(low[::-1])[::-1]  # moved upwards only, and downwards only
    middle = np.clip(0.5 * (up + down), 0.0, 1.0 - step.max(initial=0.0))
    return list((middle + step).tolist())


def fit(axes: Axes) -> None:
    """Scale a panel to its data and to the bounds near it; bounds farther off stand in its corner as numbers."""
    bounds = [line for line in axes.lines if line.get_gid() == BOUND]
    if not bounds or not axes.get_autoscaley_on() or axes.get_yscale() != "linear":
        return
    drawn = [np.asarray(line.get_ydata(), float) for line in axes.lines if line.get_gid() not in (BOUND, EVENT)]
    drawn += [np.asarray(path.vertices, float)[:, 1] for shade in axes.collections for path in shade.get_paths()]
    values = np.concatenate(drawn) if drawn else np.zeros(0)
    values = values[np.isfinite(values)]
    if not len(values):
        return
    at = {float(np.ravel(line.get_ydata())[0]) for line in bounds}
    below, above = far(values, at)
    if not below and not above:
        return
    near = at - {*below, *above}
    low, high = min([float(values.min()), *near]), max([float(values.max()), *near])
    spare = max(high - low, 1e-9)
    axes.set_ylim(low - (0.15 if below else 0.06) * spare, high + (0.15 if above else 0.06) * spare)
    for found, arrow, place, side in ((above, "↑", 0.97, "top"), (below, "↓", 0.03, "bottom")):
        if found:
            words = f"{arrow} bound {', '.join(f'{v:.4g}' for v in found)}"
            axes.text(0.995, place, words, transform=axes.transAxes, ha="right", va=side, fontsize=6.5, color=GREY, bbox=PAPER)


def far(values: Floats, bounds: Collection[float]) -> tuple[list[float], list[float]]:
    """Which bounds lie so far below and above finite ``values`` that they would squeeze them, each ascending."""
    low, high = float(values.min()), float(values.max())
    reach = FAR * max(high - low, 0.02 * max(abs(low), abs(high)))
    return sorted(v for v in bounds if v < low - reach), sorted(v for v in bounds if v > high + reach)


def time_axis(axes: Sequence[Axes], first: float, last: float, clock: bool) -> None:
    """The common time axis of panels: seconds of the run, or hours and minutes of it."""
    axes[-1].set_xlim(first, last)
    axes[-1].set_xlabel("time [h:min]" if clock else "time [s]")
    if clock:
        step = next((s for s in CLOCK_S if (last - first) / s <= 9), 86400)
        for panel in axes:
            panel.xaxis.set_major_locator(MultipleLocator(step))
            panel.xaxis.set_major_formatter(FuncFormatter(lambda t, _: on_the_clock(t)))


def on_the_clock(time: float) -> str:
    """Seconds of the run as hours and minutes, and seconds where there are some."""
    minutes, seconds = divmod(round(time), 60)
    return f"{minutes // 60:02d}:{minutes % 60:02d}" + (f":{seconds:02d}" if seconds else "")


def name_places(axes: Axes, places: Sequence[tuple[float, str, str]]) -> None:
    """Lines across a train graph where something lies, with its name on the right; stops come before what else is near them."""
    low, high = axes.get_ylim()
    inside = [place for place in places if low <= place[0] <= high]
    lines: dict[str, Any] = {"stop": "-", "unreached": (0, (1, 2))}
    for at, _, kind in inside:
        axes.axhline(at, color=GREY, linewidth=0.7 if kind in lines else 0.4, linestyle=lines.get(kind, ":"), zorder=0.5)
    kept: list[tuple[float, str, str]] = []
    apart = line_share(axes)
    for place in sorted(inside, key=lambda place: place[2] not in lines):
        if len(kept) < 1.0 / apart:
            kept.append(place)
    kept.sort()
    where = spread([(at - low) / (high - low) for at, _, _ in kept], apart)
    for (at, name, kind), share in zip(kept, where, strict=True):
        axes.annotate(
            name if len(name) <= LETTERS else f"{name[: LETTERS - 1]}…", xy=(1.0, (at - low) / (high - low)), xytext=(1.012, share),
            xycoords="axes fraction", textcoords="axes fraction", fontsize=7, va="center", annotation_clip=False,
            color="black" if kind == "stop" else "#555555", fontweight="bold" if kind == "stop" else "normal",
            fontstyle="italic" if kind == "unreached" else "normal",
            arrowprops={"arrowstyle": "-", "linewidth": 0.4, "color": GREY, "shrinkA": 0, "shrinkB": 0},
        )  # fmt: skip


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


def _is_common(label: str) -> bool:
    """Whether a label belongs to all lines, or to a kind of them, and not to one train or link."""
    return label in COMMON or label.startswith(("truth", "estimate"))


def _order(handle: Any) -> list[tuple[int, int, str]]:
    """Lines by name, numbers by size, then what belongs to all lines."""
    return _order_of(str(handle.get_label()))


def _order_of(label: str) -> list[tuple[int, int, str]]:
    parts = re.findall(r"\d+|\D+", label)
    return [(int(_is_common(label)), 0, ""), *((0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts)]


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
            look: dict[str, Any] = {"color": GREY, "linestyle": (0, (5, 2)), "linewidth": 0.9, "label": label, "gid": BOUND}
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
    fit(axes)
    low, high = axes.get_ylim()
    if high - low < minimum:
        middle = 0.5 * (low + high)
        axes.set_ylim(middle - 0.5 * minimum, middle + 0.5 * minimum)


def save(figure: Figure, path: Path, formats: Sequence[str], title: str = "", origin: str = "") -> list[Path]:
    """Write a figure as ``<path>.<format>`` for each format; the same figure gives the same bytes.

    ``title`` and ``origin`` (what it was drawn from) go into the metadata of the file.
    """
    undated: dict[str, dict[str, Any]] = {
        "png": {"Software": None, "Title": title or None, "Description": origin or None},
        "svg": {"Date": None, "Title": title or None, "Description": origin or None},
        "pdf": {"CreationDate": None, "Title": title or None, "Subject": origin or None},
    }
    written = []
    for kind in formats:
        target = path.with_name(f"{path.name}.{kind}")
        with styled():
            written_out(figure)
            figure.savefig(target, dpi=DPI, metadata={k: v for k, v in undated[kind].items() if v is not None or k in UNDATED})
        written.append(target)
    return written
