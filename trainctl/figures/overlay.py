"""Several runs in one axis: a colour per run, and what would squeeze the others is clipped and said."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from trainctl.figures import style
from trainctl.figures.trains import Drawn
from trainctl.signals import Floats, leader_over

#: Share of a run's values at either end that may lie beyond the scale.
TAIL = 0.02
#: A run whose values span so many times those of the middle one does not set the scale.
WILD = 10.0
#: The scale follows the values themselves while they span at most so many times what it would be without tails and wild runs.
CLIPPED = 2.0
#: Below this a spacing error is rounding [m].
SMALLEST_M = 1e-3


class Curve(NamedTuple):
    """What one run is drawn by."""

    time: Floats  # (k,) s
    value: Floats  # (k,) or, of every train, (k, lines)
    low: Floats | None = None  # (k,) of all trains
    high: Floats | None = None


def overlay(drawn: Sequence[Drawn], names: Sequence[str], what: str) -> Figure:
    """One quantity of several runs in one axis.

    Parameters
    ----------
    drawn : sequence of Drawn
        The runs.
    names : sequence of str
        What they are called.
    what : str
        A key of ``QUANTITIES``.
    """
    curve, label, words = QUANTITIES[what]
    figure, (axes,) = style.panels(1, "double", 76.0)
    colours = style.colours(len(drawn))
    curves = [curve(one) for one in drawn]
    for one, name, colour in zip(curves, names, colours, strict=True):
        if not len(one.time):
            continue
        if one.low is not None and one.high is not None:
            axes.fill_between(one.time, one.low, one.high, color=colour, alpha=0.14, linewidth=0, gid=f"span {name}")
        for k, line in enumerate(one.value.reshape(len(one.time), -1).T):
            style.draw(axes, one.time, line, color=colour, linewidth=1.0, label=name.replace("_", " ") if k == 0 else f"_{name}")
    if what == "spacing_errors":
        style.logarithmic(axes)
        axes.set_ylim(bottom=SMALLEST_M)
    else:
        _clip(axes, curves, names)
    absent = [name.replace("_", " ") for one, name in zip(curves, names, strict=True) if not len(one.time)]
    axes.set_title(
        "; ".join([words, *([f"no {'links' if what == 'spacing_errors' else 'trains'} in {', '.join(absent)}"] if absent else [])]),
        loc="left",
    )
    relative = what == "positions" and any(one.known.reference is not None for one in drawn)
    axes.set_ylabel(f"{label[:-5]}, less the reference [km]" if relative else label, parse_math=True)
    instants = [one.instants for one in drawn if len(one.instants)]
    axes.set_xlim(min(float(at[0]) for at in instants), max(float(at[-1]) for at in instants))
    axes.set_xlabel("time [s]")
    style.name_lines(figure, "double")
    return figure


def _clip(axes: Axes, curves: Sequence[Curve], names: Sequence[str]) -> None:
    """Scale an axis to what most of the values of most of the runs span, if the rest would squeeze them, and say what is cut."""
    found: list[tuple[str, Floats]] = []
    for one, name in zip(curves, names, strict=True):
        values = np.concatenate([part.ravel() for part in (one.value, one.low, one.high) if part is not None])
        if len(values := values[np.isfinite(values)]):
            found.append((name, values))
    if not found:
        return
    low, high = scale([values for _, values in found])
    if low == high:
        return
    axes.set_ylim(low, high)
    cut = []
    for name, values in found:
        beyond = (values < low) | (values > high)
        if beyond.any():
            least, most = float(values.min()), float(values.max())
            reach = [f"down to {least:.3g}"] * (least < low) + [f"up to {most:.3g}"] * (most > high)
            cut.append(f"{name.replace('_', ' ')} {', '.join(reach)} ({100 * float(beyond.mean()):.2g} %)")
    if cut:
        axes.text(
            0.995, 0.985, "\n".join(["beyond the scale:", *cut]), transform=axes.transAxes, ha="right", va="top", fontsize=6.5,
            color=style.GREY, bbox=style.PAPER, gid="clipped",
        )  # fmt: skip


def scale(runs: Sequence[Floats]) -> tuple[float, float]:
    """Ends of an axis for the finite values of several runs, with room to spare.

    They are those of the values; where tails of single runs, or runs that span more than ``WILD`` times the middle one, would
    squeeze the rest they are left out.
    """
    full = [(float(v.min()), float(v.max())) for v in runs]
    ends = [(float(a), float(b)) for a, b in (np.quantile(v, (TAIL, 1.0 - TAIL)) for v in runs)]
    wild = [a and b for a, b in zip(_wild(full), _wild(ends), strict=True)]
    tame = [end for end, left_out in zip(ends, wild, strict=True) if not left_out]
    whole = min(a for a, _ in full), max(b for _, b in full)
    low, high = min(a for a, _ in tame), max(b for _, b in tame)
    if whole[1] - whole[0] <= CLIPPED * (high - low) or low == high:
        low, high = whole
    spare = 0.06 * (high - low)
    return low - spare, high + spare


def _wild(ends: Sequence[tuple[float, float]]) -> list[bool]:
    """Which of some ranges are so much wider than the middle one that they would squeeze the others."""
    spans = [b - a for a, b in ends]
    middle = sorted(spans)[(len(spans) - 1) // 2]
    return [span > WILD * middle for span in spans]


def _of_trains(drawn: Drawn, column: Callable[[Drawn], Floats]) -> tuple[Floats, Floats]:
    """All instants, and the value of every train there, NaN where it is not there: (k,) and (k, trains)."""
    time, value, instants = drawn.trains.column("time_s"), column(drawn), drawn.instants
    table = np.full((len(instants), len(drawn.trains.names)), np.nan)
    for k, (_, rows) in enumerate(drawn.trains.slices()):
        table[np.searchsorted(instants, time[rows]), k] = value[rows]
    return instants, table


def _span(column: Callable[[Drawn], Floats]) -> Callable[[Drawn], Curve]:
    """The mean of the trains that are there, and from the lowest to the highest of them."""

    def curve(drawn: Drawn) -> Curve:
        time, table = _of_trains(drawn, column)
        some = np.isfinite(table).any(axis=1)
        time, table = time[some], table[some]
        if not len(time):
            return Curve(time, time)
        return Curve(time, np.nanmean(table, axis=1), np.nanmin(table, axis=1), np.nanmax(table, axis=1))

    return curve


def _relative(drawn: Drawn) -> Floats:
    """Positions relative to the reference, where the trains have a common one [km]."""
    reference, position = drawn.known.reference, drawn.trains.column("position_m")
    at: Any = 0.0 if reference is None else leader_over(reference, drawn.trains.column("time_s"))[0]
    found: Floats = (position - at) / 1000
    return found


def _positions(drawn: Drawn) -> Curve:
    return Curve(*_of_trains(drawn, _relative))


def _worst(drawn: Drawn) -> Curve:
    """The largest spacing error of all links [m]."""
    if not drawn.links.names:
        return Curve(np.zeros(0), np.zeros(0))
    time, which = np.unique(drawn.links.column("time_s"), return_inverse=True)
    worst = np.zeros(len(time))
    np.maximum.at(worst, which.ravel(), np.abs(drawn.links.column("error_m")))
    return Curve(time, np.maximum(worst, SMALLEST_M / 10))


#: Figures of a comparison: what each run is drawn by, the axis, and what the lines are.
QUANTITIES: dict[str, tuple[Callable[[Drawn], Curve], str, str]] = {
    "positions": (_positions, "position [km]", "every train"),
    "spacing_errors": (_worst, r"largest $|x_{ij} - d_{ij}|$ [m]", "the worst link of each run"),
    "speeds": (_span(lambda d: d.trains.column("speed_mps")), "speed [m/s]", "mean, shaded from the slowest to the fastest train"),
    "inputs": (_span(lambda d: d.trains.column("input_mps2")), "input [m/s²]", "mean, shaded from the lowest to the highest"),
}  # fmt: skip
