"""Which train is stopped at which platform, and when: the timetable of the stations, planned against actual."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from trainctl.figures import style
from trainctl.figures.trains import Drawn

#: So many platforms at most; more are the business of a table.
ROWS = 40
#: Height of a row [mm], and of a bar as a share of it.
ROW_MM, BAR = 7.0, 0.6
#: A bar shorter than this share of the time shown has its train's number beside it.
SHORT = 0.06


def platforms(drawn: Drawn) -> Figure:
    """Track occupation diagram: a row for each platform, a bar for each stop from arrival to departure, a frame for its plan.

    The busiest platforms, where there are more than can be distinguished.
    """
    stops = drawn.run.stops.astype({"train": str, "stop": str, "platform": str})
    found = stops.groupby(["stop", "platform"], sort=True).size()
    kept = sorted(found.nlargest(ROWS, keep="first").index)
    first, last = float(drawn.instants[0]), float(drawn.instants[-1])
    figure, (panel,) = style.panels(1, drawn.width, 18.0 + ROW_MM * len(kept))
    for row, place in enumerate(kept):
        calls = stops[(stops["stop"] == place[0]) & (stops["platform"] == place[1])]
        columns = ("arrival_s", "departure_s", "planned_arrival_s", "planned_departure_s")
        for name, *times in zip(calls["train"], *(calls[c].to_numpy(float) for c in columns), strict=True):
            _draw(panel, row, name, times, last, drawn)
    panel.set_yticks(range(len(kept)), [stop if stop == edge else f"{stop}, {edge}" for stop, edge in kept])
    panel.set_ylim(len(kept) - 0.4, -0.6)
    panel.grid(axis="y", visible=False)
    for row in range(1, len(kept)):
        panel.axhline(row - 0.5, color=style.GREY, linewidth=0.4)
    style.time_axis([panel], first, last, drawn.clock)
    left_out = len(found) - len(kept)
    if left_out:
        panel.set_title(f"the {len(kept)} busiest platforms; {left_out} more are in stops.parquet", fontsize=7, loc="left")
    style.legend(figure, drawn.width, [
        Patch(facecolor="#999999", alpha=0.7, label="stopped"),
        Line2D([], [], color="black", linewidth=0.9, linestyle=(0, (3, 1.5)), label="planned"),
    ])  # fmt: skip
    return figure


def _draw(panel: Axes, row: int, name: str, times: list[float], last: float, drawn: Drawn) -> None:
    """One stop: its bar, the frame of its plan, and the number of its train."""
    came, left, due, leaves = times
    bottom, colour = row - 0.5 * BAR, drawn.colour.get(name, style.GREY)
    begin, end = due if np.isfinite(due) else came, leaves if np.isfinite(leaves) else left
    if (np.isfinite(due) or np.isfinite(leaves)) and np.isfinite(begin) and np.isfinite(end) and end >= begin:
        x, y = [begin, end, end, begin, begin], [bottom, bottom, bottom + BAR, bottom + BAR, bottom]
        panel.plot(x, y, color=colour, linewidth=0.9, linestyle=(0, (3, 1.5)), gid=f"planned {name}", zorder=3)
    if not np.isfinite(came):
        return  # it did not come
    until = left if np.isfinite(left) else last
    panel.broken_barh([(came, until - came)], (bottom, BAR), facecolor=colour, alpha=0.7, linewidth=0.0, gid=f"stopped {name}")
    shown = last - float(drawn.instants[0])
    inside = until - came > SHORT * shown
    panel.text(
        came + 0.5 * (until - came) if inside else until + 0.006 * shown, row, name, fontsize=6.5, va="center",
        ha="center" if inside else "left", clip_on=True, zorder=4,
    )  # fmt: skip
