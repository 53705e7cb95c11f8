"""The figure of a sweep: how the margins to the bounds, and what the formation does, spread over its runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from trainctl.figures import style
from trainctl.figures.heat import ROUNDING, heat, two_settings
from trainctl.signals import Bools, Floats

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

#: Metrics shown, as far as the runs have them: column -> label.
SHOWN = {
    "bounds.spacing_lower_margin_m": "room above the\nlower spacing [m]",
    "bounds.spacing_upper_margin_m": "room below the\nupper spacing [m]",
    "bounds.speed_lower_margin_mps": "room above the\nlower speed [m/s]",
    "bounds.speed_upper_margin_mps": "room below the\nupper speed [m/s]",
    "bounds.coupler_lower_margin_m": "room of couplers,\ncompressed [m]",
    "bounds.coupler_upper_margin_m": "room of couplers,\nstretched [m]",
    "formation.settling_s": "all links within\n1 m from [s]",
    "formation.final_error_m": "spacing error\nat the end [m]",
}

SETTLING = "formation.settling_s"


def not_settled(done: pd.DataFrame) -> Bools:
    """Which of the complete runs have links that did not stay within their band, shape (runs,)."""
    if "formation.final_error_m" not in done.columns:
        return np.zeros(len(done), dtype=np.bool_)
    # Where no run settled the dataset has no such column.
    since = done[SETTLING].to_numpy(float) if SETTLING in done.columns else np.full(len(done), np.nan)
    out: Bools = np.isnan(since) & np.isfinite(done["formation.final_error_m"].to_numpy(float))
    return out


def _crosses(panel: Axes, at: Any) -> None:
    """Runs without a time, at the upper edge of their panel."""
    if len(at):
        panel.plot(
            at, np.full(len(at), 0.97), "x", markersize=3.5, color="black", transform=panel.get_xaxis_transform(), clip_on=False,
            label="not settled",
        )  # fmt: skip
        panel.set_title(f"{len(at)} not settled by the end", loc="right", fontsize=7)


def _scale_of_one(panel: Axes, value: Floats) -> None:
    """Where all runs have one value, up to rounding, the scale shows that value and 0; where none has a value there is no scale."""
    if not len(value):
        panel.set_yticks([])
    elif np.ptp(value) < ROUNDING:
        only = float(value[0])
        size = max(abs(only), ROUNDING)
        panel.set_ylim(min(only, 0.0) - 0.4 * size, max(only, 0.0) + 0.4 * size)
        panel.set_yticks([0.0] if size <= ROUNDING else [0.0, only])


def summary(frame: pd.DataFrame, parameters: Sequence[str], path: Path) -> None:
    """Draw the complete runs over the setting that is a number and varies, or else in order of size; violated bounds in red.

    Over two such settings there are maps, see ``figures.heat``; of more the first counts. Runs that gave nothing are counted in the
    title: what they would have shown may differ from the rest. Runs with links that did not settle are crosses above the times of
    the others, and counted.

    Parameters
    ----------
    frame : DataFrame
        The dataset of the sweep.
    parameters : sequence of str
        Its columns that are parameters.
    path : Path
        Picture file.
    """
    done = frame[frame["status"] == "complete"]
    missing = frame["status"].value_counts().drop("complete", errors="ignore").sort_index()
    runs = f"{len(done)} of {len(frame)} runs complete, {', '.join(f'{n} {status}' for status, n in missing.items())}"
    unsettled = not_settled(done)
    done = done if SETTLING in done.columns else done.assign(**{SETTLING: np.nan})
    shown = [key for key in SHOWN if key in done.columns and np.isfinite(done[key].to_numpy(float)).any()]
    if unsettled.any() and SETTLING not in shown:
        shown = [key for key in SHOWN if key in (*shown, SETTLING)]
    title = runs if len(missing) else f"all {len(frame)} runs"
    if len(done) and (both := two_settings(done, parameters)):
        with style.styled():
            figure = heat(frame, done, both, {key: SHOWN[key] for key in shown}, {SETTLING: unsettled}, title)
            style.save(figure, path.with_suffix(""), (path.suffix[1:],))
        return
    axis = next((k for k in parameters if k != "run.seed" and done[k].dtype.kind in "if" and done[k].nunique() > 1), None)
    violated = done["violations"].to_numpy(float) > 0
    with style.styled():
        figure, axes = style.panels(max(1, len(shown)), "double", 34.0)
        for panel, key in zip(axes, shown, strict=False):
            value, never = done[key].to_numpy(float), unsettled if key == SETTLING else np.zeros(len(done), bool)
            if axis is None:
                order = np.argsort(value, kind="stable")
                at, value, red, never = np.arange(1.0, len(order) + 1), value[order], violated[order], never[order]
            else:
                at, red = done[axis].to_numpy(float), violated
                places = np.unique(at)
                counted = np.where(never, np.inf, value)  # who did not settle is later than all who did
                middle = [np.nanmedian(counted[at == x]) if (~np.isnan(counted[at == x])).any() else np.nan for x in places]
                middle = [m if np.isfinite(m) else np.nan for m in middle]
                panel.plot(places, middle, color=style.GREY, label="median")
            for chosen, colour, label in ((~red, 0, "all bounds held"), (red, 1, "a bound violated")):
                if chosen.any():
                    panel.plot(at[chosen], value[chosen], ".", markersize=3, color=style.COLOURS[colour], label=label)
            _crosses(panel, at[never])
            if key.startswith("bounds."):
                panel.axhline(0.0, color="black", linestyle="--", linewidth=0.6)
            _scale_of_one(panel, value[np.isfinite(value)])
            panel.set_ylabel(SHOWN[key])
        axes[0].set_title(title, loc="left")
        axes[-1].set_xlabel("runs in order of size" if axis is None else axis)
        figure.align_ylabels(axes)
        style.legend(figure, "double")
        style.save(figure, path.with_suffix(""), (path.suffix[1:],))
