"""``trainctl cite``: what a run rests on, to be cited."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trainctl.cli.console import say


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command()(cite)


def cite(
    folder: Annotated[Path, typer.Argument(help="Run folder, as `trainctl run` made it.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON: works (with text and bibtex), remarks.")] = False,
) -> None:
    """Print what to cite with a run: trainctl, the paper of its law, SUMO; as text, then as BibTeX."""
    from trainctl.citation import works
    from trainctl.cli.console import show_json
    from trainctl.runs.run import Run

    run = Run(folder)
    tables = run.scenario
    law, observer = tables["controller"]["law"], tables.get("observer", {}).get("kind", "none")
    found, remarks = works(law, observer, run.info.get("versions", {}), run.info.get("backend") != "numeric")
    if as_json:
        show_json({"run": str(folder), "works": [work.plain() for work in found], "remarks": remarks})
        return
    for work in found:
        say(work.text())
    for remark in remarks:
        say(f"({remark})")
    for work in found:
        say(f"\n{work.bibtex()}")
