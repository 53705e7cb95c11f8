"""The trains on their tracks as a moving picture for slides: GIF or WebP."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from trainctl.errors import InputError
from trainctl.figures import style
from trainctl.figures.trains import drawable
from trainctl.report.animation import LOWEST, animation
from trainctl.runs.run import Run
from trainctl.signals import Floats

#: Kinds of file.
KINDS = (".gif", ".webp")
#: Frames per second, pixels across, trains at most that have their names beside them.
RATE, WIDE, NAMED = 12, 960, 20
#: Tracks that are flatter than this are drawn that much higher than they are.
RAISED = 8.0


def film(run: Run, out: Path, *, seconds: float = 15.0, from_s: float | None = None, until_s: float | None = None) -> Path:
    """Write a run, or a part of it, as a moving picture.

    Parameters
    ----------
    run : Run
        A run folder.
    out : Path
        The file, .gif or .webp.
    seconds : float
        How long the picture lasts.
    from_s, until_s : float, optional
        Part of the run [s].

    Raises
    ------
    InputError
        The file is of no kind that is known, or there is nothing to draw the trains on, or nothing in that time.
    """
    if out.suffix.lower() not in KINDS:
        raise InputError(f"--out {out}: must end in {' or '.join(KINDS)}")
    drawn = drawable(run)
    if not drawn.trains.names:
        raise InputError(f"{run.folder}: no train was recorded")
    data = animation(drawn)
    if not data["time"]:
        raise InputError(f"{run.folder}: nothing to draw the trains on: a run without SUMO does not know where its net lies")
    times = np.array(data["time"])
    first, last = (times[0] if from_s is None else from_s), (times[-1] if until_s is None else until_s)
    shown = times[(times >= first - 1e-9) & (times <= last + 1e-9)]
    if len(shown) < 2:
        raise InputError(f"{run.folder}: fewer than two recorded instants between {first:g} and {last:g} s")
    wanted = np.linspace(shown[0], shown[-1], max(2, round(seconds * RATE)))
    with style.styled():
        pictures = _pictures(data, times, wanted, drawn.known.title or run.folder.name)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        pictures[0].save(
            out, save_all=True, append_images=pictures[1:], duration=round(1000 / RATE), loop=0, disposal=1, optimize=False
        )
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror or error}") from None
    return out


def unpacked(packed: dict[str, str]) -> Floats:
    """What the page reads of its numbers."""
    values = np.frombuffer(base64.b64decode(packed["bdata"]), f"<{packed['dtype']}").astype(float)
    return np.where(values == LOWEST, np.nan, values / 1000.0) if packed["dtype"] == "i2" else values


def _pictures(data: dict[str, Any], times: Floats, wanted: Floats, title: str) -> list[Image.Image]:
    """One picture per wanted time, trains between two frames where they were in between."""
    count, on_map = len(data["trains"]), "map" in data
    x, y = (unpacked(data[key]).reshape(len(times), count) for key in ("position", "lateral"))
    high = 480 if on_map else 110 + 46 * len(data["tracks"])
    figure = Figure(figsize=(WIDE / 100, high / 100), dpi=100, layout="constrained")
    canvas: Any = FigureCanvasAgg(figure)  # what of it draws fast has no types
    axes = figure.subplots()
    centre = _map(axes, data) if on_map else _tracks(axes, data, x)
    axes.set_title(title, loc="right")  # makes room for the time beside it
    clock = axes.text(0.0, 1.02, "", transform=axes.transAxes, fontsize=10, fontweight="bold", animated=True)
    colours = [train["color"] for train in data["trains"]]
    dots = axes.scatter(np.zeros(count), np.zeros(count), c=colours, s=60 if count <= 30 else 18, zorder=4, animated=True)
    dots.set(edgecolor="white", linewidth=0.8)
    names = [
        axes.annotate(train["name"], (0, 0), xytext=(6, 6 if k % 2 else -12), textcoords="offset points", fontsize=7, animated=True)
        for k, train in enumerate(data["trains"]) if count <= NAMED
    ]  # fmt: skip
    style.written_out(figure)
    canvas.draw()
    ground = canvas.copy_from_bbox(figure.bbox)
    found = []
    for at in wanted.tolist():
        k = int(np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2))
        share = (at - times[k]) / (times[k + 1] - times[k])
        now = np.column_stack([v[k] + share * (v[k + 1] - v[k]) for v in (x, y)])
        now = np.where(np.isfinite(now), now, np.column_stack([x[k], y[k]]))  # comes or goes in between
        if not on_map:
            now[:, 0] = (now[:, 0] - centre(now[:, 0])) / 1000
        canvas.restore_region(ground)
        dots.set_offsets(np.ma.masked_invalid(now))
        clock.set_text(f"t = {at:.0f} s")
        for artist in (dots, clock):
            axes.draw_artist(artist)
        for name, place in zip(names, now, strict=False):
            if np.isfinite(place).all():
                name.xy = place
                axes.draw_artist(name)
        found.append(
            Image.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3].copy()).convert("P", palette=Image.Palette.ADAPTIVE)
        )
    return found


def _map(axes: Axes, data: dict[str, Any]) -> Any:
    """The net as it lies, with its stops."""
    x, y = (unpacked(part) for part in data["map"])
    axes.plot(x, y, color=style.GREY, linewidth=1.4, zorder=1)
    flat = (np.nanmax(x) - np.nanmin(x)) / max(np.nanmax(y) - np.nanmin(y), 1.0)
    axes.set_aspect(float(np.clip(flat / 2.0, 1.0, RAISED)))
    for stop in data["stops"]:
        face = "black" if stop["reached"] else "white"
        axes.plot(stop["x"], stop["y"], "s", markersize=5, markerfacecolor=face, markeredgecolor="black", zorder=2)
        axes.annotate(
            stop["name"],
            (stop["x"], stop["y"]),
            xytext=(-7, -12),
            ha="right",
            textcoords="offset points",
            fontsize=7,
            color="#555555",
        )
    axes.axis("off")
    return lambda x: 0.0


def _tracks(axes: Axes, data: dict[str, Any], x: Floats) -> Any:
    """Tracks side by side, as long as the trains together ever were; they move with their middle."""
    reach = 1.12 * float(max(np.nanmax(x, axis=1) - np.nanmin(x, axis=1))) / 1000
    for k, name in enumerate(data["tracks"]):
        axes.axhline(k, color=style.GREY, linewidth=1.4, zorder=1)
        axes.text(-0.01, k, f"track {name}", transform=axes.get_yaxis_transform(), ha="right", va="center", fontsize=8)
    axes.set_xlim(-max(reach, 1.0) / 2, max(reach, 1.0) / 2)
    axes.set_ylim(len(data["tracks"]) - 0.4, -0.6)
    axes.set_yticks([])
    axes.set_xlabel("from the middle of the trains [km]")
    axes.spines["left"].set_visible(False)
    axes.grid(False)
    return lambda x: 0.5 * (np.nanmin(x) + np.nanmax(x))
