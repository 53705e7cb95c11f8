"""The figure of a search for gains: the objective over every gain, and how the best one improved."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.ticker import LogFormatter

from trainctl.figures import style

if TYPE_CHECKING:
    import pandas as pd


def search(frame: pd.DataFrame, gains: Sequence[str], wide: Sequence[bool], words: str, path: Path) -> None:
    """Draw all candidates of a search.

    Parameters
    ----------
    frame : DataFrame
        As ``studies.tune.table`` makes it.
    gains : sequence of str
        Its columns that are gains.
    wide : sequence of bool
        Which of them were searched in their logarithm.
    words : str
        The objective.
    path : Path
        Picture file.
    """
    value, kept = frame["objective"].to_numpy(float), frame["bounds_kept"].to_numpy(bool)
    number = np.arange(1.0, len(frame) + 1)
    so_far = np.fmin.accumulate(np.where(kept, value, np.nan))
    with style.styled():
        figure, axes = style.panels(len(gains) + 1, "double", 34.0, sharex=False)
        for panel, at, name in zip(axes, [number, *(frame[g].to_numpy(float) for g in gains)], ["", *gains], strict=True):
            for chosen, marker, colour, label in (
                (kept, ".", style.COLOURS[0], "bounds kept"), (~kept & np.isfinite(value), "x", style.GREY, "a bound violated"),
            ):  # fmt: skip
                if chosen.any():
                    panel.plot(at[chosen], value[chosen], marker, markersize=4, color=colour, label=label)
            if kept.any():
                best = int(np.nanargmin(np.where(kept, value, np.nan)))
                panel.plot(at[best], value[best], "*", markersize=9, color=style.COLOURS[1], label="best")
            panel.set_ylabel(words)
            panel.set_xlabel(name or "candidate")
        axes[0].plot(number, so_far, color=style.COLOURS[1], linewidth=0.8, label="best so far")
        for panel, log in zip(axes[1:], wide, strict=True):
            if log:
                panel.set_xscale("log")
                panel.xaxis.set_major_formatter(LogFormatter())
                panel.xaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.5, 0.8)))
        axes[0].set_title(f"{int(kept.sum())} of {len(frame)} candidates keep all bounds", loc="left")
        style.legend(figure, "double")
        style.save(figure, path.with_suffix(""), (path.suffix[1:],))
