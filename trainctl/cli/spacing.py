"""``trainctl compare spacing``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from trainctl.cli.console import Progress, fill, listing, number, say, show, show_json
from trainctl.errors import InputError


def spacing(
    given: dict[str, Any], rows: str | None, out: Path, formats: tuple[str, ...], workers: int | None, as_json: bool,
    sumo: bool, resume: bool,
) -> None:  # fmt: skip
    """Search, and show what was found.

    Parameters
    ----------
    given : dict
        Numbers of the plan that are not its usual ones.
    rows : str, optional
        Rows of the table, separated by commas; default all.
    out, formats, workers, as_json, sumo, resume
        As the command has them.
    """
    from trainctl.studies import spacing as study
    from trainctl.studies import spacing_shown as shown
    from trainctl.studies import stops

    wanted = tuple(rows.split(",")) if rows else stops.ROWS
    if strange := [row for row in wanted if row not in stops.ROWS]:
        raise InputError([f"--rows {row}: no such row; there are: {', '.join(stops.ROWS)}" for row in strange])
    plan = stops.StopsPlan(**given)
    with Progress("spacing", sys.stderr.isatty()) as advance:
        table = study.compare(plan, out, wanted, workers, sumo, resume, advance)
    pictures = shown.figure(table, plan, out / "spacing", formats)
    lines, tex = stops.reference_lines(plan), out / "spacing.tex"
    tex.write_text(shown.latex(table, plan), encoding="utf-8")
    if as_json:
        show_json({"plan": plan._asdict(), "lines": lines, "rows": table, "figures": pictures, "latex": tex})
        return
    kmh, percent = 3.6 * plan.speed_mps, 100.0 * plan.brake_scatter
    printed = listing(
        f"Smallest safe spacing of {plan.trains} trains at {kmh:.3g} km/h: the first brakes as hard as it can, {plan.stops} times;"
        f" brakes scatter by {percent:g} %", *shown.COLUMNS,
    )  # fmt: skip
    for row in table:
        fill(printed, *map(number, shown.cells(row)))
    show(printed)
    for name, value in lines.items():
        say(f"{name} braking distance: {value:.4g} m")
    for words in [*shown.sumo_lines(table), *shown.reasons(table)]:
        say(words)
    for path in [*pictures, tex]:
        say(path)
