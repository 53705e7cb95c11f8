"""``trainctl resume``: go on with a run that was killed, interrupted or failed."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from trainctl.cli.console import say


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command()(resume)


def resume(
    folder: Annotated[Path, typer.Argument(help="Run folder DIR, or DIR.partial.")],
    strict: Annotated[bool, typer.Option("--strict", help="Exit 1 if any bound was violated.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar, no summary.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for machines instead of a table.")] = False,
) -> None:
    """Resume a run that was killed, from its last checkpoint (`trainctl run --checkpoint-every S`).

    It ends with the same files, and the same exit code, as a run that was not killed. Without checkpoints it starts again from the
    beginning.
    A law that is a file is a program: it is executed.
    """
    from trainctl import runner
    from trainctl.cli.console import Progress, show_json
    from trainctl.runs.outcome import summary

    shown = not (quiet or as_json)
    with Progress(folder.name.removesuffix(".partial"), shown and sys.stderr.isatty(), not shown) as advance:
        done, since = runner.resume(folder, advance)
    if as_json:
        show_json({"folder": str(done.folder), "resumed_from_s": since, **done.info, "metrics": done.metrics})
    elif shown:
        if since is None:
            how = "all steps were done already"
        elif since > 0.0:
            how = f"resumed at {since:g} s"
        else:
            how = "there was no checkpoint: run again from the beginning"
        say(f"{done.folder}: complete, {done.info['steps']} steps ({how})")
        for line in summary(done):
            say(f"{'FAILED: ' if line.failed else ''}{line.title}: {line.text}")
    if not done.ok or (strict and done.info["violations"]):
        raise typer.Exit(1)
