"""A picture of a line: tracks and crossovers above, speed limit and gradient below, along one kilometrage. And of any net."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sumo_net.line import Line, LineCrossover
from sumo_net.shapes import shapes
from sumo_net.spec import text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: A crossover is drawn at least this part of the picture wide, else its direction could not be seen.
_NARROWEST = 0.006

#: More ids than this in one picture cannot be read; ids that were given by hand are always shown.
_MOST_IDS = 16

#: More edges than this are not named in the picture of a net; beyond this ratio of sides it is not drawn to scale.
_MOST_EDGES, _FLAT = 40, 8.0
_BEHIND = {"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.85}

_TRACK, _CROSSOVER, _NAMED, _SPEED, _SLOPE = "#333333", "#7d8597", "#d1495b", "#00798c", "#8d6a3f"


def show(line: Line, path: str | Path, from_m: float | None = None, to_m: float | None = None, title: str = "") -> Path:
    """Draw a line, or a piece of it, into an image file whose suffix says the format; the path of the image.

    Parameters
    ----------
    line : Line
        What to draw.
    path : str or Path
        Image file, for instance ``line.png`` or ``line.svg``.
    from_m, to_m : float, optional
        Kilometrage of the ends of the piece [m]; default the whole line.
    title : str
        Headline.

    Raises
    ------
    ValueError
        If the piece holds nothing of the line.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    begin, end = line.begin_m if from_m is None else from_m, line.end_m if to_m is None else to_m
    if not begin < end or end <= line.begin_m or begin >= line.end_m:
        whole = f"{text(line.begin_m)} to {text(line.end_m)} m"
        raise ValueError(f"from {begin:g} m to {end:g} m: holds nothing of the line, which runs from {whole}")
    begin, end = max(begin, line.begin_m), min(end, line.end_m)

    figure = Figure(figsize=(14, 2.6 + 0.8 * len(line.track_ids)), layout="constrained")
    FigureCanvasAgg(figure)
    tracks, speed, slope = figure.subplots(3, 1, sharex=True, height_ratios=[0.3 + 0.8 * len(line.track_ids), 0.8, 0.8])
    _draw_tracks(tracks, line, begin, end)
    _draw_speed(speed, line, begin, end)
    _draw_slope(slope, line, begin, end)
    margin = 0.01 * (end - begin)
    slope.set_xlim((begin - margin) / 1000, (end + margin) / 1000)
    slope.set_xlabel("kilometrage [km]")
    if title:
        figure.suptitle(title)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # No date or version in the file: the same line gives the same picture.
    figure.savefig(path, dpi=120, metadata={".png": {"Software": None}, ".svg": {"Date": None}}.get(path.suffix.lower()))
    return path


def show_net(net: str | Path, path: str | Path, title: str = "") -> Path:
    """Draw the rail edges of any SUMO net as they lie, coloured by speed limit, into an image file; the path of the image.

    Parameters
    ----------
    net : str or Path
        The net.
    path : str or Path
        Image file, for instance ``net.png`` or ``net.svg``.
    title : str
        Headline.

    Raises
    ------
    LineError
        As ``shapes``.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    pieces = [piece for piece in shapes(Path(net)) if len(piece.points) > 1]
    points = np.concatenate([piece.points for piece in pieces]) / 1000
    width, height = np.maximum(np.ptp(points, axis=0), 1e-3)
    figure = Figure(figsize=(14, float(np.clip(12.0 * height / width, 3.0, 10.0)) + 1.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    limits = np.array([piece.speed_mps for piece in pieces])
    lines = LineCollection([piece.points / 1000 for piece in pieces], array=limits, cmap="viridis", linewidths=2.0)
    lines.set_clim(0.9 * limits.min(), 1.05 * limits.max())
    axes.add_collection(lines)
    normal = [piece for piece in pieces if not piece.internal]
    for piece in normal if len(normal) <= _MOST_EDGES else ():
        across = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(piece.points, axis=0).T))])
        x, y = (float(np.interp(across[-1] / 2, across, part)) / 1000 for part in piece.points.T)
        axes.annotate(piece.edge, (x, y), ha="center", va="center", fontsize=8, color=_TRACK, bbox=_BEHIND)
    ends = np.array([piece.points[k] for piece in normal for k in (0, -1)]) / 1000
    axes.plot(*ends.T, linestyle="none", marker="o", markersize=3, color=_CROSSOVER)
    # True to scale, unless the net is so long and flat that nothing could be told apart.
    stretched = width > _FLAT * height
    axes.set_aspect("auto" if stretched else "equal", adjustable="datalim")
    axes.margins(0.03, 0.15)
    axes.set_xlabel("x [km]")
    axes.set_ylabel("y [km]" + (" (not to the scale of x)" if stretched else ""))
    axes.set_title(title or f"{Path(net).name}: {len(normal)} rail edges", loc="left", fontsize=9)
    figure.colorbar(lines, ax=axes, label="limit [m/s]", shrink=0.9)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120, metadata={".png": {"Software": None}, ".svg": {"Date": None}}.get(path.suffix.lower()))
    return path


def _draw_tracks(axes: Axes, line: Line, begin: float, end: float) -> None:
    height = {track: -k for k, track in enumerate(line.track_ids)}
    for y in height.values():
        axes.plot([begin / 1000, end / 1000], [y, y], color=_TRACK, linewidth=2.2, solid_capstyle="butt", zorder=1)
    seen = [c for c in line.crossovers if c.start_m + c.length_m >= begin and c.start_m <= end]
    named = [c for c in seen if c.id != c.edge]
    labelled = seen if len(seen) <= _MOST_IDS else named if len(named) <= _MOST_IDS else []
    narrowest = _NARROWEST * (end - begin)
    for c in sorted(seen, key=lambda c: c in named):
        middle, width = c.start_m + c.length_m / 2, max(c.length_m, narrowest)
        ends = [((middle + side * width / 2) / 1000, float(y)) for side, y in ((-1, height[c.from_track]), (1, height[c.to_track]))]
        colour = _NAMED if c in named else _CROSSOVER
        axes.annotate(
            "", xy=ends[1], xytext=ends[0], zorder=2 + (c in named),
            arrowprops={
                "arrowstyle": "-|>", "color": colour, "linewidth": 1.8 if c in named else 0.9,
                "shrinkA": 0, "shrinkB": 0, "mutation_scale": 11 if c in named else 7,
            },
        )  # fmt: skip
        if c in labelled:
            _label(axes, c, ends, at_its_end=(c.start_m - begin) < 0.1 * (end - begin), colour=colour)
    axes.set_ylim(0.5 - len(line.track_ids), 0.5)
    axes.set_yticks([*height.values()], [f"track {track}" for track in height])
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(left=False)
    if end - begin > (shortest := min((c.length_m for c in seen), default=end - begin)) / _NARROWEST:
        note = f"direction of travel \u2192   (crossovers are drawn longer than they are: the shortest has {shortest:g} m)"
    else:
        note = "direction of travel \u2192"
    axes.set_title(note, loc="left", fontsize=8, color="#666666")


def _label(axes: Axes, c: LineCrossover, ends: list[tuple[float, float]], at_its_end: bool, colour: str) -> None:
    """Id and kilometrage before the switch, so that two crossovers of one place keep apart; at the left margin behind its end."""
    near, far = ends[::-1] if at_its_end else ends
    axes.annotate(
        c.id if c.id == c.edge else f"{c.id}  {text(c.start_m / 1000)} km",
        xy=(near[0], near[1] + 0.2 * np.sign(far[1] - near[1])), xytext=(7 if at_its_end else -4, 0), textcoords="offset points",
        ha="left" if at_its_end else "right", va="center", fontsize=8, color=colour, zorder=4,
        bbox={"boxstyle": "square,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.85},
    )  # fmt: skip


def _draw_speed(axes: Axes, line: Line, begin: float, end: float) -> None:
    on_crossover = {c.edge for c in line.crossovers}
    first = [k for k, track in enumerate(line.tracks) if track == line.track_ids[0] and line.edges[k] not in on_crossover]
    places = np.append(line.start_m[first], line.end_m)
    axes.stairs(line.speed_mps[first], places / 1000, color=_SPEED, linewidth=1.6, baseline=None)
    inside = line.speed_mps[first][(places[1:] > begin) & (places[:-1] < end)]
    axes.set_ylim(0, 1.2 * float(inside.max()))
    axes.set_ylabel("limit\n[m/s]")
    axes.grid(alpha=0.3)


def _draw_slope(axes: Axes, line: Line, begin: float, end: float) -> None:
    places = np.append(line.gradient.breaks, line.end_m)
    permil = 1000 * line.gradient.slope
    axes.stairs(permil, places / 1000, color=_SLOPE, fill=True, alpha=0.35, baseline=0)
    axes.stairs(permil, places / 1000, color=_SLOPE, linewidth=1.4, baseline=None)
    largest = float(np.abs(permil[(places[1:] > begin) & (places[:-1] < end)]).max())
    axes.set_ylim(-1.2 * max(largest, 1.0), 1.2 * max(largest, 1.0))
    axes.set_ylabel("gradient\n[\u2030]")
    axes.grid(alpha=0.3)
