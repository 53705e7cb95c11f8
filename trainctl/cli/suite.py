"""``trainctl compare suite``."""

from __future__ import annotations

import sys
from pathlib import Path

from trainctl.cli.console import Progress, fill, listing, say, show, show_json
from trainctl.errors import InputError


def suite(
    runs: int | None, spacing_m: float | None, rows: str | None, out: Path, workers: int | None, resume: bool, as_json: bool
) -> None:
    """Run laws in situations, and show what came of it; arguments as the command has them."""
    from trainctl.studies import suite as study
    from trainctl.studies import suite_shown as shown
    from trainctl.studies.stops import ROWS

    wanted = tuple(rows.split(",")) if rows else ROWS
    if strange := [row for row in wanted if row not in ROWS]:
        raise InputError([f"--rows {row}: no such row; there are: {', '.join(ROWS)}" for row in strange])
    usual = study.SuitePlan()
    plan = usual._replace(runs=usual.runs if runs is None else runs, spacing_m=usual.spacing_m if spacing_m is None else spacing_m)
    with Progress("suite", sys.stderr.isatty()) as advance:
        cells = study.compare(plan, out, wanted, workers=workers, resume=resume, progress=advance)
    page = shown.write_page(cells, plan, out)
    if as_json:
        show_json({"cells": cells, "page": page})
        return
    names, situations, known = shown.grid(cells)
    table = listing(
        f"Runs of {plan.runs} in which trains touched or one was too fast, {plan.spacing_m:g} m apart", "row",
        *(name.replace("_", " ") for name in situations),
    )  # fmt: skip
    for row in names:
        fill(table, row.replace("_", " "), *(shown.words(known[row, name]) for name in situations))
    show(table)
    say(shown.confirmed(cells))
    for cell in cells:
        if cell["why"]:
            say(f"{cell['row']}, {cell['situation']}: {cell['why']}".replace("_", " "))
    say(page)
